"""Small missions against the true world, each other, and the CPU; and one robot each, by the wall clock."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from exploration.replays import FakeTime, Together
from exploration.rooms import SHELF, SMALL, plan_ahead, room, small_room, without_seconds
from kernels_of_gpu import kernels_of_gpu
from mapping.map_cases import assert_same_components
from pretended_gpu import GPUTensor, pretended_gpu

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.kernels import kernels
from gmmtorch.mapping.components import Components
from gmmtorch.simulation import DepthCamera, box
from gmmtorch.team.cli.explorations import _coverage, _team_view
from gmmtorch.team.exploration.mission.driver import SimulatedClock, Stopwatch, WallClock, drive, settle
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import FRAMEWORKS, THESIS, TeamOptions
from gmmtorch.team.exploration.mission.results import mission_row, with_times
from gmmtorch.team.exploration.mission.robot_view import FlyingRobotView
from gmmtorch.team.exploration.mission.trials import assemble, make_agent, start_poses
from gmmtorch.team.exploration.planning.collision_checking import PeerTrajectories
from gmmtorch.team.exploration.robot.agent import StoppingRule
from gmmtorch.team.exploration.world.world import World
from gmmtorch.team.sharing import Partition, PlanMessage, Replica, Store, UdpTransport, encode_plan

CONTRACT = """
framework seed world n_robots duration times entropy_bits entropy_bits_per_robot observable_bits
entropy_reduction_bits t50 t90 bytes_sent bytes_raw_points datagrams map_disagreement auc
cross_entropy_bits collisions path_length coverage_per_metre overlap wall_seconds
"""


@pytest.fixture(scope="module")
def world() -> World:
    crate = box((7.5, 5.5, 0.1), (8.5, 6.5, 1.0))
    return World.from_mesh(room(SHELF, crate), start=(2.0, 2.0, 1.3), cache=False, name="room")


def flown(world: World, options: TeamOptions) -> Mission:
    mission = assemble(world, options)
    drive(mission, SimulatedClock())
    return mission


@pytest.fixture(scope="module", params=list(FRAMEWORKS))
def mission(request: pytest.FixtureRequest, world: World) -> Mission:
    return flown(world, replace(SMALL, framework=request.param))


def test_a_mission_learns_the_room(mission: Mission) -> None:
    row = mission_row(mission, 1.0)
    assert row["entropy_reduction_bits"] > 0.2 * row["observable_bits"]
    assert row["observed_share"] > 0.5
    assert row["auc"] > 0.7
    assert row["times"] == [0.0, 5.0, 10.0, 15.0, 20.0]
    falls = row["entropy_bits"]
    assert falls[0] == row["observable_bits"]
    assert all(after <= before + 1 for before, after in itertools.pairwise(falls))


def test_robots_touch_nothing(mission: Mission) -> None:
    radius = mission.options.dynamics.radius
    for robot, path in zip(mission.robots, mission.trajectories, strict=True):
        assert robot.collisions == 0
        assert float(mission.world.mesh.clearance(torch.stack(path)[:, :3]).min()) >= radius
    one, other = (torch.stack(path)[:, :3] for path in mission.trajectories)
    assert float((one - other).norm(dim=1).min()) >= 2 * radius


def test_a_row_has_all_fields_as_plain_values(mission: Mission) -> None:
    row = with_times([mission_row(mission, 2.0)])[0]
    assert set(CONTRACT.split()) <= set(row)
    without_seconds(row)  # plain numbers, no NaN
    assert row["t50"] <= row["t90"] <= row["duration"]
    assert len(row["entropy_bits_per_robot"]) == 2
    union = row["entropy_bits"][-1]
    assert all(curve[-1] >= union - 0.02 * row["observable_bits"] for curve in row["entropy_bits_per_robot"])


def test_each_framework_sends_what_it_shares(mission: Mission) -> None:
    row = mission_row(mission, 1.0)
    if mission.options.framework == "grid_isolated":
        assert row["bytes_sent"] == row["datagrams"] == 0
    elif mission.options.framework == "grid_shared":
        assert row["bytes_by_kind"]["points"] > row["bytes_raw_points"]
    elif mission.options.framework == "gmm_thesis":
        sent = row["bytes_by_kind"]
        assert 0 < sent["counts"] < sent["components"] < row["bytes_raw_points"] / 10
        assert set(sent) == {"components", "counts", "plans", "views"}  # no record is announced or repaired
    else:
        assert 0 < row["bytes_by_kind"]["components"] < row["bytes_raw_points"] / 30
        assert row["map_disagreement"] <= 0.05  # few components wait for more when it ends


def test_the_team_of_the_thesis_has_its_options() -> None:
    team = replace(SMALL, framework="gmm_thesis")
    assert team.learning == THESIS
    assert team == replace(team)
    assert team.novelty.distance == SMALL.novelty.distance  # the thesis gives no number
    assert replace(SMALL).learning == TeamOptions().learning
    assert not {name for name, value in TeamOptions().learning.items() if value == THESIS[name]}
    for part in ({"frame": replace(SMALL.frame, shell=0.3)}, {"codec": "float"}):
        with pytest.raises(InvalidArgumentError, match=r"team=gmm_thesis with (shell=0.3|codec=float)"):
            replace(SMALL, framework="gmm_thesis", **part)


@pytest.mark.parametrize("framework", FRAMEWORKS)
def test_the_same_seed_gives_the_same_row(world: World, framework: str) -> None:
    options = replace(SMALL, framework=framework, duration=4.0)
    one, other = (without_seconds(mission_row(flown(world, options), 1.0)) for _ in range(2))
    assert one == other


def test_reach_depends_on_where_robots_are(world: World) -> None:
    options = replace(SMALL, framework="grid_shared", duration=4.0)
    near, far = (flown(world, replace(options, reach=reach)) for reach in (0.1, 1e3))
    row = mission_row(near, 1.0)
    assert row["reception"]["out_of_reach"] == row["datagrams"] > 0
    assert row["reception"]["datagrams"] == 0
    kept = [without_seconds(mission_row(made, 1.0)) for made in (far, flown(world, options))]
    assert [each.pop("reach") for each in kept] == [1e3, None]
    assert kept[0] == kept[1]


def test_robots_that_learn_too_little_rest(world: World) -> None:
    # A window must bring 99 % of the best one: the second brings less than the first.
    alone = replace(SMALL, framework="grid_isolated", size=1, duration=40.0)
    mission = flown(world, replace(alone, rest=StoppingRule(0.99, window=4.0)))
    assert all(robot.stopping.rests for robot in mission.robots)
    for robot, path in zip(mission.robots, mission.trajectories, strict=True):
        assert robot.state[4:].tolist() == [0, 0, 0]
        assert torch.equal(path[-1], path[-4])
        assert not torch.equal(path[0], path[-1])


def test_losses_are_repaired_to_the_bit(world: World) -> None:
    """Half of the datagrams are lost; others arrive twice, or late."""
    trouble = {"loss": 0.5, "duplication": 0.3, "jitter": 0.5, "latency": 0.3}
    mission = flown(world, replace(SMALL, size=3, duration=6.0, **trouble))
    row = mission_row(mission, 1.0)
    assert max(row["missing_share"]) > 0
    assert row["reception"]["lost"] > 0 < row["reception"]["duplicated"]
    assert row["wire_bytes_over_time"][0] == 0
    assert row["wire_bytes_over_time"][-1] == row["bytes_sent"] + 28 * row["datagrams"] == row["wire_bytes"]
    held = mission.robots[0].mapper.shared.held
    for robot in mission.robots[1:]:
        held |= robot.mapper.shared.held
    seconds = mission.converge(120)
    assert seconds is not None
    assert seconds > 0
    assert len({agent.digest() for agent in mission.agents}) == 1
    one, *others = (robot.mapper for robot in mission.robots)
    assert one.shared.held.covers(held)  # no record is gone
    first = one.components()
    hits, misses = one.belief.grid.dense(world.box)
    for other in others:
        second = other.components()
        assert isinstance(second, Components)
        assert_same_components(first, second)
        found = other.belief.grid.dense(world.box)
        torch.testing.assert_close(found[0], hits, rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(found[1], misses, rtol=1e-4, atol=1e-3)
        assert other.belief.entropy_bits == pytest.approx(one.belief.entropy_bits, rel=1e-4)


def test_converge_returns_none_for_robots_that_stay_apart(world: World) -> None:
    mission = flown(world, replace(SMALL, duration=4.0, partitions=(Partition(0.0, 1e9, ((0,), (1,))),)))
    assert mission.converge(20) is None
    assert mission_row(mission, 1.0)["missing_share"][-1] > 0.2


@pytest.mark.parametrize("coordination", ["myopic", "greedy", "distributed_greedy", "random_partition"])
def test_no_coordination_collides(world: World, coordination: str) -> None:
    mission = flown(world, replace(SMALL, size=3, duration=6.0, coordination=coordination))
    assert sum(robot.collisions for robot in mission.robots) == 0


HERE = (2.0, 2.0, 1.3, 0.0)
BAD: dict[str, dict[str, Any]] = {
    r"start\[1\].*is in a solid": {"start": (HERE, (8.0, 6.0, 0.55, 0.0))},
    r"start\[1\].*outside": {"start": (HERE, (-4.0, 4.0, 1.3, 0.0))},
    r"start\[1\].*not finite": {"start": (HERE, (float("nan"), 4.0, 1.3, 0.0))},
    "start has shape": {"start": (HERE,)},
    "size=0": {"size": 0},
    "size=99": {"size": 99},
    "duration=0.0": {"duration": 0.0},
    "team='both'": {"framework": "both"},
    "planner='best'": {"planner": "best"},
    "rate=0.7": {"rate": 0.7},
    "planning_prior=1.0": {"planning_prior": 1.0},
    "n_beams=0": {"n_beams": 0},
    "loss=1.0": {"loss": 1.0},
    "partition": {"partitions": (Partition(0.0, 1.0, ((0, 1),)),)},
    "coordination='none'": {"coordination": "none"},
    "information='all'": {"information": "all"},
    "codecs='jpeg'": {"codecs": ("jpeg",)},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_options_are_rejected_before_the_first_tick(world: World, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        assemble(world, replace(SMALL, **BAD[message]))


def test_the_window_contains_what_the_camera_sees(world: World) -> None:
    camera = DepthCamera(width=8, height=6, max_range=8.0)
    (one,) = assemble(world, replace(SMALL, size=1, camera=camera, window=(40, 40, 32))).agents
    assert one.options.window == (88, 88, 48)  # 2 (8 m / 0.2 m + 4), and 2 (20 + 4) of 8 m sin(FOV/2)


def test_a_duration_within_a_frame_is_rejected_with_the_nearest_whole_ones() -> None:
    with pytest.raises(InvalidArgumentError, match=r"duration=2.5 s .*rate=1.0 Hz; take 2 or 3\."):
        replace(SMALL, duration=2.5)
    with pytest.raises(InvalidArgumentError, match=r"duration=0.4 s .*; take 1\."):
        replace(SMALL, duration=0.4)
    with pytest.raises(InvalidArgumentError, match=r"duration=3.0 s .*rate=0.5 Hz; take 2 or 4\."):
        replace(SMALL, duration=3.0, rate=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"framework": "gmm_shared"},
        {"framework": "grid_shared", "planner": "frontier", "information": "fsmi", "codecs": ("octree",)},
    ],
)
def test_missions_on_a_gpu_give_the_results_of_the_cpu(world: World, options: dict[str, Any]) -> None:
    """On a pretended GPU; devices are not mixed."""
    team = replace(SMALL, duration=2.0, **options)
    with kernels("torch"):
        mission = flown(world, team)
        with pretended_gpu() as gpu:
            there = flown(world, replace(team, device="cuda"))
            row = without_seconds(mission_row(there, 1.0))
            assert isinstance(there.robots[0].mapper.local.counts, GPUTensor)
            assert isinstance(there.score.seen_by, GPUTensor)
            assert torch.equal(_team_view(there).image, _team_view(mission).image)
            assert torch.equal(_coverage(there), _coverage(mission))
        assert gpu.waits
        assert row == without_seconds(mission_row(mission, 1.0))
    for one, other in zip(mission.trajectories, there.trajectories, strict=True):
        assert torch.equal(torch.stack(one), torch.stack(other))


@pytest.mark.slow
def test_a_mission_runs_the_kernels_of_a_gpu(world: World) -> None:
    mission = flown(world, replace(SMALL, duration=2.0))
    with pretended_gpu(), kernels_of_gpu():
        there = flown(world, replace(SMALL, duration=2.0, device="cuda"))
        bits = there.score.union.entropy_bits
    assert bits == pytest.approx(mission.score.union.entropy_bits, rel=1e-6)
    for one, other in zip(mission.trajectories, there.trajectories, strict=True):
        assert torch.equal(torch.stack(one), torch.stack(other))


TEAM = TeamOptions(
    size=2,
    duration=4.0,
    camera=DepthCamera(width=48, height=36, max_range=4.0),
    window=(64, 64, 32),
    sample_every=2.0,
    n_beams=40,
    latency=0.0,
)


@contextmanager
def transports(n: int, **options: Any) -> Iterator[list[UdpTransport]]:
    """Transports that all send to one another."""
    with ExitStack() as stack:
        made = [stack.enter_context(UdpTransport.unicast(k, **options)) for k in range(n)]
        for one in made:
            one.peers = [other.address for other in made if other is not one]
        yield made


def mission_of(
    number: int, hall: World, options: TeamOptions, transport: UdpTransport, **about: Any
) -> Mission:
    """The mission of one robot. about: an incarnation."""
    watch, pose = Stopwatch(), start_poses(hall, options)[number]
    agent = make_agent(number, pose, hall, options, transport, watch=watch, **about)
    return Mission(hall, [agent], options, watch)


@pytest.fixture(scope="module")
def hall() -> World:
    return small_room()


def test_two_processes_hold_the_map_of_one_process_that_received_everything(hall, tmp_path, monkeypatch):
    fake, observer = FakeTime(), Replica(9, dim=3)
    clock = WallClock(clock=fake, sleep=fake.sleep)
    send = UdpTransport.send

    def observed(self: UdpTransport, sender: int, datagrams: Any, now: float, kind: str) -> None:
        send(self, sender, datagrams, now, kind)
        for datagram in datagrams:
            observer.receive(datagram)

    monkeypatch.setattr(UdpTransport, "send", observed)
    with transports(2) as links:
        options = replace(TEAM, duration=8.0)
        missions = [mission_of(k, hall, options, links[k], incarnation=7 + k) for k in range(2)]
        agents = [mission.agents[0] for mission in missions]
        assert drive(Together(*missions), clock).ticks == 8

        def are_equal() -> bool:
            return agents[0].digest() == agents[1].digest()

        settle(Together(*missions), WallClock(), 60.0, stop=are_equal)
        assert are_equal()
        assert agents[0].robot.mapper.shared.digest() == observer.digest()
        views = [FlyingRobotView(*pair) for pair in zip(missions, links, strict=True)]
        for view, agent in zip(views, agents, strict=True):
            view.check_id()
            row = view.row()
            assert row["n_components"] > 0
            assert row["collisions"] == 0
            assert 0 < row["entropy_bits_left"] < row["observable_bits"]
            assert set(agent.heard_at) == {1 - view.robot}
            assert row["bytes_sent"] == sum(row["bytes_by_kind"].values())
            assert row["socket_bytes"] == row["wire_bytes"] - 28 * row["datagrams"]
            assert view.scalars()["records"] == row["n_records"]
            files = view.files()
            assert set(files) == {"map", "trajectory"}
            for file, write in files.values():
                write(tmp_path / f"{view.robot}_{file}")
            assert "another robot" not in view.status()
        assert sum(view.row()["path_length"] for view in views) > 0


# -- plans that were heard --------------------------------------------------------------------------------


def planned_beside(
    mission: Mission, plans: list[PlanMessage], age: float, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    """The inputs of the planner of a robot that heard these plans `age` seconds ago."""
    (agent,), seen = mission.agents, {}
    propose = agent.propose

    def noted(now: float, final: Any, peers: PeerTrajectories, since: float | None = None) -> Any:
        seen.update(final=final, peers=peers, since=since)
        return propose(now, final, peers, since)

    monkeypatch.setattr(agent, "propose", noted)
    for one in plans:
        agent.robot.plans[one.sender] = one
        agent.heard_at[one.sender] = 50.0 - age
    mission.tick(50.0)
    return seen


def test_a_robot_avoids_the_paths_that_it_has_heard(hall, monkeypatch):
    with transports(1) as (link,):
        heard = [plan_ahead(10, sender=4), plan_ahead(3, sender=2)]
        seen = planned_beside(mission_of(0, hall, TEAM, link), heard, 0.4, monkeypatch)
    ahead = torch.tensor([[3.0] * 8, [3, 4, 5, 6, 7, 8, 9, 10]], dtype=torch.float64)
    assert torch.allclose(seen["peers"].paths[..., 0], ahead)
    assert seen["peers"].separation == pytest.approx(0.7)
    assert sorted(seen["final"]) == [2, 4]
    assert seen["since"] == 48.0


def test_views_are_sent_once_every_planning_period(hall, monkeypatch):
    with transports(1) as (link,):
        mission, sent = mission_of(0, hall, TEAM, link), []
        monkeypatch.setattr(mission.agents[0], "send_views", sent.append)
        for k in range(500):
            mission.exchange(0.04 * k)
    assert len(sent) == 9
    assert all(1.99 < b - a < 2.05 for a, b in itertools.pairwise([0.0, *sent]))


# -- duplicate ids, and restarts --------------------------------------------------------------------------


def test_a_duplicate_id_is_reported_with_its_address(hall, monkeypatch):
    monkeypatch.setattr("gmmtorch.team.sharing.transport.security.FRESH_SECONDS", 0.1)
    path = plan_ahead(4).path
    with UdpTransport.unicast(0) as link, UdpTransport.unicast(0, peers=[link.address]) as other:
        mission = mission_of(0, hall, TEAM, link)
        view = FlyingRobotView(mission, link)
        view.check_id()

        def is_reported() -> bool:
            other.send(0, encode_plan(0, 0, 0.0, 0.2, path), 0.0, "plans")
            return bool(link.duplicates)

        settle(mission, WallClock(), 20.0, stop=is_reported)
        with pytest.raises(GmmTorchError, match=rf"robot 0 \(127.0.0.1:{other.address[1]}.*id="):
            view.check_id()
        assert "another robot has id 0" in view.status()
        assert view.row()["refused"].keys() == {"duplicate_id"}


def test_a_restarted_robot_has_its_map(hall, tmp_path):
    with transports(2) as links:

        def started(folder: Path, number: int) -> Mission:
            mission = mission_of(0, hall, TEAM, links[number], incarnation=5 + number)
            store = Store(folder / "robot.sqlite", 0)
            store.restore(mission.agents[0].robot.mapper.shared)
            mission.agents[0].keep_in(store)
            return mission

        links[1] = links[0]
        first = started(tmp_path / "first", 0)
        for now in (0.0, 10.0, 20.0):  # so that none of its components waits to be sent
            first.tick(now)
        shutil.copytree(tmp_path / "first", tmp_path / "again")  # what the death of its process leaves
        again = started(tmp_path / "again", 1)
        before, after = (mission.robots[0].mapper for mission in (first, again))
        assert after.shared.digest() == before.shared.digest()
        assert after.belief.entropy_bits == pytest.approx(before.belief.entropy_bits)
        again.tick(0.0)
        assert not before.shared.held - after.shared.held
