"""Maps of components of an empty room, what a camera sees there, and comparisons of such maps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from gmmtorch.mapping import Components, NoveltyRule
from gmmtorch.occupancy import Box, RollingWindow
from gmmtorch.simulation.robot_camera import DepthCamera, DepthFrame
from gmmtorch.team.exploration.mission.options import THESIS, FrameRule, TeamOptions
from gmmtorch.team.exploration.robot.mapper import GmmMapper, Memo
from gmmtorch.team.exploration.world.scoring import BeliefMap, BeliefRule
from gmmtorch.team.sharing import Broadcast, ReceivedMessage, Replica, decode
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage, CountsMessage

CAMERA = DepthCamera(width=32, height=24, max_range=4.0)
NOVELTY = NoveltyRule(resolution=0.2, observed=0.5)
BOX = Box(torch.tensor([0, 0, 0]), torch.tensor([42, 32, 17]))
LOW, HIGH = torch.tensor([0.1, 0.1, 0.1]).double(), torch.tensor([8.3, 6.3, 3.1]).double()  # of a room
PLACES = [((2.0, 3.0, 1.5), 0.0), ((2.4, 2.2, 1.2), 1.7), ((5.0, 3.5, 1.6), 3.3), ((5.6, 3.0, 1.3), 5.0)]


def frame(place: tuple[float, ...], yaw: float, seed: int = 0, max_range: float = 4.0) -> DepthFrame:
    """What a camera in an empty room sees, from where its beams leave the room."""
    origin, d = torch.tensor(place, dtype=torch.float64), CAMERA.directions
    c, s = math.cos(yaw), math.sin(yaw)
    turned = torch.stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], d[:, 2]], 1)
    to_wall = torch.maximum((LOW - origin) / turned, (HIGH - origin) / turned).amin(1)
    noise = torch.randn(len(d), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    depth = (to_wall + 0.005 * noise).clamp_max(max_range)
    return DepthFrame(origin, origin + depth[:, None] * turned, depth < max_range, torch.arange(len(d)))


def mapper(
    robot: int = 0,
    codec: str = "replica",
    memo: Memo | None = None,
    novelty: NoveltyRule = NOVELTY,
    **options: Any,
) -> GmmMapper:
    """One with a `Replica`, or with a `Broadcast` in a codec; it counts every ten frames, as flights here are
    short."""
    local = RollingWindow(0.2, (64, 64, 32))
    local.center_on(torch.tensor([4.0, 3.0, 1.5], dtype=torch.float64))
    belief = BeliefMap(0.2, BOX, torch.ones(BOX.shape, dtype=torch.bool), BeliefRule())
    shared = Replica(robot, dim=3, incarnation=0) if codec == "replica" else Broadcast(robot, codec)
    team = TeamOptions(camera=CAMERA, novelty=novelty, frame=FrameRule(**{"update_every": 10, **options}))
    return GmmMapper(local, belief, team, Memo(256) if memo is None else memo, shared)


def thesis_mapper(robot: int = 0) -> GmmMapper:
    """One with the options of the thesis, which explains surfaces from anywhere and free space from near."""
    options = {name: value for name, value in THESIS.items() if name in vars(FrameRule())}
    near = replace(NOVELTY, distance=0.5, distance_for="free_space")
    return mapper(robot, "thesis", novelty=near, **options)


def heard(*datagrams: bytes, sender: int = 0) -> list[ReceivedMessage]:
    return [ReceivedMessage(sender, datagram, decode(datagram)) for datagram in datagrams]


# -- comparisons of maps ----------------------------------------------------------------------------


def by_kind(datagrams: list[bytes]) -> tuple[list[bytes], list[bytes]]:
    """Datagrams of components, and all others."""
    are = [isinstance(decode(datagram), ComponentsMessage) for datagram in datagrams]
    parts = [
        [d for d, is_one in zip(datagrams, are, strict=True) if is_one == kind] for kind in (True, False)
    ]
    return parts[0], parts[1]


def rebuilt(one: GmmMapper) -> GmmMapper:
    """A new mapper with all components of another, cast at once."""
    other = mapper(9)
    if len(one.components()):
        other._enter(one.components())
    return other


def assert_same_components(one: Components, other: Components, exact: bool = True) -> None:
    for name in ("ids", "means", "covariances", "max_range", "seen_by"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    for name in ("support", "seen_count"):
        tolerance = {} if exact else {"rtol": 1e-12, "atol": 0.0}
        torch.testing.assert_close(getattr(one, name), getattr(other, name), **tolerance)
    assert torch.equal(one.origins[one.seen_from], other.origins[other.seen_from])


def assert_same_evidence(one: GmmMapper, other: GmmMapper) -> None:
    for a, b in zip(one.belief.grid.dense(BOX), other.belief.grid.dense(BOX), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4)
    for a, b in zip(one.local.evidence(), other.local.evidence(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4)
    assert other.belief.entropy_bits == pytest.approx(one.belief.entropy_bits, abs=0.1)
    assert other.belief.n_observed == one.belief.n_observed


def counts_in(components: list[bytes], counts: list[bytes]) -> dict[tuple[int, int], float]:
    """The points of each component, by id, summed over datagrams."""
    total: dict[tuple[int, int], float] = {}
    for data in components:
        message = decode(data)
        assert isinstance(message, ComponentsMessage)
        for key, support in zip(message.components.ids.tolist(), message.components.support, strict=True):
            assert tuple(key) not in total
            total[tuple(key)] = float(support)
    for data in counts:
        message = decode(data)
        assert isinstance(message, CountsMessage)
        for key, count in message.counts.items():
            total[key] += count
    return total


def first_batch() -> tuple[GmmMapper, list[bytes]]:
    one = mapper(codec="float", length=0.6)
    one.sense(frame(*PLACES[0]))
    return one, one.shared.datagrams()
