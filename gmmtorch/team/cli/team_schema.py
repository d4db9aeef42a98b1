"""The options that gmmtorch-explore, -robot, -team and -ros share, for Hydra."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli import ViewOptions, part_of, store
from gmmtorch.cli import register as register_inputs
from gmmtorch.declarations import option, repeated
from gmmtorch.team.exploration import TeamOptions, WorldOptions

SIMULATED = (
    *(f"network.{name}" for name in ("delay", "jitter", "bandwidth", "duplication", "reach", "partitions")),
    "evaluation.codecs",
)
"""Options of a mission that only a simulated network has, or only the simulated mission measures."""


@dataclass
class MissionCommand(ViewOptions):
    """Options of a command that flies a mission, beside those of `TeamOptions`; groups with choices replace
    those of it."""

    world: Any = option(MISSING, "the world")
    team: Any = option(MISSING, "the team")
    planner: Any = option(MISSING, "the planner")


@dataclass
class LinkOptions:
    """The network of a robot."""

    listen: str | None = option(
        None,
        "address of this machine, or 0.0.0.0, and port, or an endpoint of Zenoh, as in tls/0.0.0.0:7447; a "
        "key is required except on loopback. null: 127.0.0.1:7400, or as zenoh_config says",
    )
    peers: list[str] = option([], "addresses of the others, as in [192.168.1.12:7400], or endpoints of Zenoh")
    group: str | None = option(
        None, "multicast group that all robots share, as in 239.71.77.7:7400; null: none"
    )
    interface: str = option("127.0.0.1", "this machine's address in the network of the group")
    key_file: str | None = option(
        None, "file of 64 hexadecimal digits; null: $GMMTORCH_TEAM_KEY, if it is set"
    )
    zenoh_config: str | None = option(None, "file with settings of Zenoh, such as scouting; null: none")


@dataclass
class SharingOptions:
    """What a robot tells its team."""

    loss: float = repeated(TeamOptions, "loss", 0.0)
    announce: float = repeated(TeamOptions, "announce_every", 5.0)
    budget: float | None = repeated(TeamOptions, "budget", None)


@functools.cache
def register() -> None:
    """Stores the options of teams, and those of maps and data sets."""
    register_inputs()
    groups = {
        "world": {
            "generated": part_of(WorldOptions, "world", without=("path", "bounds")),
            "mesh": part_of(WorldOptions, "world", without=("size", "seed")),
        },
        "team": {"team": part_of(TeamOptions, "team")},
        "planner": {"planner": part_of(TeamOptions, "planner")},
    }
    store({}, groups)
