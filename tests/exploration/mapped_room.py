"""Maps of components of an empty room, and what a camera sees there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from gmmtorch.exploration.robot.gmm_mapper import FrameRule, GmmMapper
from gmmtorch.exploration.robot.mapper import Memo
from gmmtorch.exploration.world.scoring import BeliefMap, BeliefRule
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.sharing.broadcast import Broadcast
from gmmtorch.sharing.messages.message_registry import decode
from gmmtorch.sharing.radio import ReceivedMessage
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.simulation.sensors.depth_camera import DepthCamera, DepthFrame

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
    """One with a `Replica`, or with a `Broadcast` in a codec."""
    local = RollingWindow(0.2, (64, 64, 32))
    local.center_on(torch.tensor([4.0, 3.0, 1.5], dtype=torch.float64))
    belief = BeliefMap(0.2, BOX, torch.ones(BOX.shape, dtype=torch.bool), BeliefRule())
    rule, memo = replace(FrameRule(), **options), Memo(256) if memo is None else memo
    shared = Replica(robot, dim=3, incarnation=0) if codec == "replica" else Broadcast(robot, codec)
    return GmmMapper(local, belief, CAMERA.width, novelty, rule, memo, shared)


def heard(*datagrams: bytes, sender: int = 0) -> list[ReceivedMessage]:
    return [ReceivedMessage(sender, datagram, decode(datagram)) for datagram in datagrams]
