"""Missions on a pretended GPU: they mix no devices, and give the results of the CPU."""

from __future__ import annotations

import pytest
import torch
from pretended_gpu import GPUTensor, pretended_gpu

from gmmtorch.cli.reporting.explore_pictures import _coverage, _team_view
from gmmtorch.exploration.mission.driver import SimulatedClock, drive
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.results import mission_row
from gmmtorch.exploration.mission.team_setup import assemble
from gmmtorch.exploration.world.world import World, open_world
from gmmtorch.kernels import kernels
from gmmtorch.simulation.sensors.depth_camera import DepthCamera


@pytest.fixture(scope="module")
def world() -> World:
    return open_world("warehouse", size=(20.0, 16.0, 5.0))


def flown(world: World, framework: str, device: str, **options):
    camera = DepthCamera(width=40, height=30)
    about = TeamOptions(
        framework=framework, size=2, duration=2.0, camera=camera, n_beams=40, device=device, **options
    )
    mission = assemble(world, about)
    drive(mission, SimulatedClock())
    row = mission_row(mission, 1.0)
    row.pop("stage_seconds")
    return mission, row


@pytest.mark.slow
@pytest.mark.parametrize(
    ("framework", "options"),
    [
        ("gmm_shared", {}),
        ("grid_shared", {"planner": "frontier", "information": "fsmi", "codecs": ("octree",)}),
    ],
)
def test_missions_on_a_gpu_give_the_results_of_the_cpu(world, framework, options):
    with kernels("torch"):
        mission, expected = flown(world, framework, "cpu", **options)
        with pretended_gpu() as gpu:
            there, row = flown(world, framework, "cuda", **options)
            assert isinstance(there.robots[0].mapper.local.counts, GPUTensor)
            assert isinstance(there.score.seen_by, GPUTensor)
            assert torch.equal(_team_view(there).image, _team_view(mission).image)
            assert torch.equal(_coverage(there), _coverage(mission))
    assert gpu.waits
    assert row == expected
    for one, other in zip(mission.trajectories, there.trajectories, strict=True):
        assert torch.equal(torch.stack(one), torch.stack(other))
