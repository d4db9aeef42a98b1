"""A live mapper whose odometry closes a loop: its map, a teammate's, and both after a restart."""

from __future__ import annotations

import math
import shutil
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")
pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")

from localization.looping_robot import BACK, DriftingOdometry, lap, off_the_walls

from gmmtorch.datasets import LASER, Ranges, Sensor, Topic, TransformTree
from gmmtorch.live import LiveMapper, LiveScans, Node, live_scans
from gmmtorch.live.live_scans import LiveOptions
from gmmtorch.mapping import Components, GaussianMap, IncrementalRule
from gmmtorch.team.sharing import Network, Replica, SharedMap, Store
from gmmtorch.team.sharing.messages.record_messages import CorrectionMessage
from gmmtorch.team.sharing.transport.simulated_network import LinkConditions

N_SCANS = 58
NEAR = 0.15
"""Metres from the truth of poses and surfaces of the corrected map; up to 0.8 m before."""
RUN = {"of": "this test"}


class Lap(NamedTuple):
    """A robot that has driven around the block, and its teammate.

    true: poses (N, 3, 3). drifted: the map before the loop was closed. closed_at: the scan that closed it.
    superseded: records that were superseded then. checkpoint, store, kept: the files and the team's map at
    the end of the next window.
    """

    mapper: LiveMapper
    teammate: SharedMap
    true: Tensor
    drifted: Components
    closed_at: int
    superseded: int
    checkpoint: Path
    store: Path
    kept: Components


def live_scans_of(**options: Any) -> LiveScans:
    chosen = LiveOptions(poses="mixture", max_latency=None, **options)
    return LiveScans(Sensor(Topic("/scan", "", 0), LASER), TransformTree(), Ranges(), chosen)


def mapper_of(node: Node, shared: SharedMap) -> LiveMapper:
    return LiveMapper(node, live_scans_of(), GaussianMap(IncrementalRule(window=3)), shared=shared)


def corrections(shared: SharedMap) -> list[CorrectionMessage]:
    return shared.replica._records.of(CorrectionMessage)


def exchanged(*team: SharedMap) -> None:
    begin = time.monotonic()
    for step in range(80):
        for shared in team:
            shared.exchange(begin + step / 10)


def surfaces(components: Components) -> Tensor:
    """Distances of the surface components from the true walls, metres."""
    return off_the_walls(components.means[~components.max_range])


@pytest.fixture(scope="module")
def driven(tmp_path_factory) -> Lap:
    folder = tmp_path_factory.mktemp("driven")
    network = Network(2, LinkConditions(loss=0.3), seed=2)
    messages, true = lap(N_SCANS)
    closed_at, superseded = 0, 0
    drifted = kept = Components.empty(2)
    with (
        pytest.MonkeyPatch.context() as patch,
        Node("loops") as node,
        Store(folder / "robot_0.sqlite", 0, {}) as store,
    ):
        patch.setattr(live_scans, "odometry_of", lambda method: DriftingOdometry(true))
        patch.setattr(node, "publisher", lambda *_: lambda message, stamp=None: None)
        shared, teammate = SharedMap(Replica(0), network, store=store), SharedMap(Replica(1), network)
        mapper = mapper_of(node, shared)
        for number, message in enumerate(messages):
            if not closed_at and number:
                drifted = mapper.builder.map.components()
            n_dead = shared.replica._records.dead.size
            mapper._scans.receive(message, 0)
            mapper.step(0.0)
            teammate.exchange(time.monotonic())
            if not closed_at and corrections(shared):
                closed_at, superseded = number, shared.replica._records.dead.size - n_dead
            if closed_at and not len(kept) and mapper.builder.map.n_pending == 0:
                mapper.builder.save(folder / "checkpoint.safetensors", RUN)
                shutil.copytree(folder, folder / "killed")
                kept = shared.replica.components()
        mapper.finish()
        exchanged(shared, teammate)
    at_kill = folder / "killed"
    return Lap(
        mapper,
        teammate,
        true,
        drifted,
        closed_at,
        superseded,
        at_kill / "checkpoint.safetensors",
        at_kill / "robot_0.sqlite",
        kept,
    )


def test_the_map_moves_to_the_corrected_poses(driven):
    assert driven.closed_at >= BACK
    assert driven.mapper.n_corrections > 0
    off = driven.mapper.builder.poses[:, :2, 2] - driven.true[:, :2, 2]
    assert float(off.norm(dim=1).max()) < NEAR
    assert float(surfaces(driven.mapper.builder.map.components()).quantile(0.95)) < NEAR


def test_before_the_loop_is_closed_the_map_is_off_by_the_drift(driven):
    assert float(surfaces(driven.drifted).quantile(0.95)) > 2 * NEAR


def test_without_loops_no_pose_jumps(monkeypatch):
    messages, true = lap(N_SCANS)
    monkeypatch.setattr(live_scans, "odometry_of", lambda method: DriftingOdometry(true))
    scans = live_scans_of(loops=False)
    for message in messages:
        scans.receive(message, 0)
        assert scans.advance()
        assert scans.corrected_poses() is None
    assert scans.newest is not None
    assert np.linalg.norm(scans.newest.pose.translation[:2] - true[-1, :2, 2]) > 0.5


def test_a_teammate_that_loses_datagrams_holds_the_corrected_map(driven):
    shared, teammate = driven.mapper.shared, driven.teammate
    assert shared is not None
    assert shared.radio.transport.reception().lost > 0
    assert teammate.replica.digest() == shared.replica.digest()
    found, own = teammate.components(), driven.mapper.builder.map.components()
    assert len(found) == len(own)
    assert float(surfaces(found).quantile(0.95)) < NEAR
    far = torch.cdist(found.means, own.means).amin(1)
    assert float(far.max()) < 0.1  # of rounding alone: the codec rounds where the components were learned


def test_a_correction_is_one_record_for_each_window_and_sends_no_component_again(driven):
    shared = driven.mapper.shared
    assert shared is not None
    scans = [record.scan for record in corrections(shared)]
    assert 5 < len(scans) == len(set(scans))
    assert set(scans) <= set(driven.mapper.builder.windows.moved)
    assert driven.superseded == 0
    for record in corrections(shared):
        assert len(shared.replica._records.datagrams[record.key]) < 150


def test_a_robot_that_was_killed_keeps_its_corrections(driven, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(driven.store.parent, folder)
    with (
        pytest.MonkeyPatch.context() as patch,
        Node("again") as node,
        Store(folder / "robot_0.sqlite", 0, {}) as store,
    ):
        patch.setattr(node, "publisher", lambda *_: lambda message, stamp=None: None)
        replica = Replica(0)
        store.restore(replica)
        n_held = len(replica.held.numbers())
        assert torch.equal(replica.components().means, driven.kept.means)
        mapper = mapper_of(node, SharedMap(replica, Network(1), store=store))
        mapper.builder.load(folder / "checkpoint.safetensors", RUN)
        mapper._share()
        mapper._thread.shutdown()
    assert len(replica.held.numbers()) == n_held  # no record was written
    assert torch.equal(replica.components().means, driven.kept.means)
    off = mapper.builder.poses[:, :2, 2] - driven.true[: len(mapper.builder.poses), :2, 2]
    assert math.sqrt(float(off.square().sum(1).max())) < NEAR
