"""gmmtorch-ros: maps live ROS 2 topics, localises in a map, or plays a recording."""

from __future__ import annotations

from contextlib import ExitStack

from omegaconf import DictConfig

from gmmtorch.cli import set_up, start
from gmmtorch.errors import check_number
from gmmtorch.team.cli.options import team_schema


def main() -> None:
    """Entry point of the command."""
    start("ros", run, team_schema.register)


def run(config: DictConfig) -> None:
    """Run the command until Ctrl-C, or until the recording has been played."""
    from gmmtorch.team.cli.from_options.robots import shared_map
    from gmmtorch.team.cli.runs import live_topics

    device = set_up(config)
    check_number("wait", config.wait)
    check_number("period", config.period)
    with live_topics.open_node(config) as node, ExitStack() as stack:
        if config.play:
            live_topics.play(config, node)
        elif config.localize:
            live_topics.localize(config, node, device)
        else:
            live_topics.build_map(config, node, device, shared_map(config, stack))


if __name__ == "__main__":
    main()
