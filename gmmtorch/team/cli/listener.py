"""A listener in a team's network, for the live view: it receives what the robots say, and has no robot."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from gmmtorch.live import LiveView
from gmmtorch.team.cli.from_options import links, missions, robots
from gmmtorch.team.exploration import (
    RECEIVED,
    Agent,
    AgentMoments,
    ReplayMission,
    ReplayMoments,
    WallClock,
    make_agent,
    start_poses,
)
from gmmtorch.team.sharing import FramedTransport, Replica


def listener(
    config: DictConfig, view: LiveView | None, link: Sequence[str], stack: ExitStack
) -> Callable[[bool], None]:
    """What listens to a team and shows it, at the end or not; to be called often. Nothing without a view.

    link: the options of its address in the network, which is closed with the stack.
    """
    if view is None:
        return lambda is_last: None
    number = config.team.size
    own: Any = OmegaConf.merge(config, OmegaConf.from_dotlist(list(link)))
    transport = links.open_link(own, number)
    stack.callback(transport.close)

    def received() -> tuple[str, float]:
        return RECEIVED, transport.books(number)["wire_bytes_received"] / 1e3

    make = _of_world if config.source == "world" else _of_log
    exchange, moments = make(config, number, transport, received)
    clock = WallClock(config.speed)

    def listen(is_last: bool) -> None:
        now = clock.now()
        exchange(now)
        moments.note(now)
        (view.finish if is_last else view.offer)(functools.partial(moments, now))

    return listen


_Traffic = Callable[[], tuple[str, float]]


def _of_world(
    config: DictConfig, number: int, transport: FramedTransport, traffic: _Traffic
) -> tuple[Callable[[float], object], AgentMoments]:
    """A listener that maps what it hears as the robots do."""
    options = missions.team_options(config, config.seed, {})
    world = missions.open_world(missions.world_options(config), options)
    agent: Agent = make_agent(number, start_poses(world, options)[0], world, options, transport)
    agent.robot.mapper.center_on(agent.robot.position)

    def exchange(now: float) -> None:
        with torch.inference_mode():
            agent.listen(now)
            agent.send_map(now)  # asks for what was lost

    return exchange, AgentMoments(agent, None, traffic)


def _of_log(
    config: DictConfig, number: int, transport: FramedTransport, traffic: _Traffic
) -> tuple[Callable[[float], object], ReplayMoments]:
    """A listener that holds the team's map."""
    make_map = robots.log_map(config)
    mission = ReplayMission(Replica(number), [], transport, make_map, announce_every=config.network.announce)
    return mission.exchange, ReplayMoments(mission, traffic)
