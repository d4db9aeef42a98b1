"""SharedMap: robots hold one map, each in its own frame."""

from __future__ import annotations

import math

import torch
from exploration.replays import content, log, mapped

from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing import Replica
from gmmtorch.team.sharing.shared_map import SharedMap
from gmmtorch.team.sharing.transport.link_conditions import LinkConditions
from gmmtorch.team.sharing.transport.simulated_network import Network


def of_robot(components: Components, robot: int) -> Components:
    return components.selected((components.ids[:, 0] == robot).nonzero()[:, 0])


def exchanged(team: list[SharedMap], begin: float, n_rounds: int = 60) -> None:
    for step in range(n_rounds):
        for shared in team:
            shared.exchange(begin + step / 10)


def test_robots_hold_the_components_of_all_although_datagrams_are_lost():
    network = Network(2, LinkConditions(loss=0.3), seed=1)
    team = [SharedMap(Replica(number), network) for number in range(2)]
    own = [mapped("incremental", log(12)[half]).components() for half in (slice(6), slice(6, 12))]
    for shared, components in zip(team, own, strict=True):
        before = shared.content()
        shared.replica.publish(components, whole=True)
        assert shared.content() != before
    exchanged(team, 0.0)
    assert network.reception().lost > 0
    assert team[0].replica.digest() == team[1].replica.digest()
    for shared in team:
        assert content(shared.components()) == content(*own)


def test_the_components_are_in_the_frame_of_the_robot():
    network = Network(2)
    team = [SharedMap(Replica(number, own_frame=True), network) for number in range(2)]
    components = mapped("incremental", log(6)).components()
    for shared in team:
        shared.replica.publish(components, whole=True)
    exchanged(team, 0.0)
    alone = team[1].components()
    assert set(alone.ids[:, 0].tolist()) == {1}  # the frames are unrelated yet
    cos, sin = math.cos(0.7), math.sin(0.7)
    frame = torch.tensor(
        [[cos, -sin, 5.0], [sin, cos, -2.0], [0, 0, 1]], dtype=torch.float64
    )  # robot 0's frame ← robot 1's
    team[1].replica.join(team[1].replica.other_frames[0], frame)
    exchanged(team, 10.0)
    turn, shift = frame[:2, :2], frame[:2, 2]
    expected = [alone.means @ turn.T + shift, (alone.means - shift) @ turn]
    for number, (shared, placed) in enumerate(zip(team, expected, strict=True)):
        found = shared.components()
        assert torch.allclose(of_robot(found, number).means, alone.means, atol=1e-9)
        assert torch.allclose(of_robot(found, 1 - number).means, placed, atol=1e-9)
        assert torch.allclose(
            torch.linalg.eigvalsh(of_robot(found, 1 - number).covariances),
            torch.linalg.eigvalsh(alone.covariances),
            atol=1e-9,
        )
