"""Robots in step over pipes, against the same mission in one process; and what goes wrong on a pipe."""

from __future__ import annotations

import io
import json
import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from exploration.flying_robots import TEAM, flying, small_room, transports

from gmmtorch.errors import DataError
from gmmtorch.exploration.mission import lockstep
from gmmtorch.exploration.mission.flying import FlyingNode
from gmmtorch.exploration.mission.lockstep import RemotePilot, RobotLostError, Serving
from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.team_flight import TeamFlight
from gmmtorch.exploration.mission.team_setup import assemble
from gmmtorch.exploration.planning.peer_trajectories import Traffic as Paths
from gmmtorch.exploration.world.world import World
from gmmtorch.sharing.transport.simulated_network import Traffic


@pytest.fixture(scope="module")
def world() -> World:
    return small_room()


@contextmanager
def in_step(nodes: list[FlyingNode]) -> Iterator[list[RemotePilot]]:
    """Each robot served by a thread, over two pipes."""
    pilots: list[RemotePilot] = []
    with ExitStack() as stack:
        threads = []
        for node in nodes:
            asked, to_ask = (os.fdopen(end, mode) for end, mode in zip(os.pipe(), "rw", strict=True))
            answers, answered = (os.fdopen(end, mode) for end, mode in zip(os.pipe(), "rw", strict=True))
            serving = Serving(node, lambda now, node=node: {**node.row(), "ended": now})
            threads.append(threading.Thread(target=serving.serve, args=(asked, answered)))
            for file in (asked, answered, answers, to_ask):
                stack.callback(file.close)
            pilots.append(RemotePilot(node.robot, to_ask, answers, pilots))
        for thread in threads:
            thread.start()
        yield pilots
        for pilot, thread in zip(pilots, threads, strict=True):
            pilot._asked.close()  # after which nobody asks any more
            thread.join(60)
            assert not thread.is_alive()


def in_process(world: World, options: TeamOptions) -> Mission:
    mission = assemble(world, options)
    while not mission.is_over:
        mission.step()
    return mission


@pytest.mark.parametrize("coordination", ["greedy", "random_partition"])
def test_the_mission_is_the_one_that_a_single_process_flies(world, coordination):
    options = replace(TEAM, coordination=coordination)
    mission = in_process(world, options)
    with transports(2) as links:
        nodes = [flying(k, world, options, links[k]) for k in range(2)]
        with in_step(nodes) as pilots:
            flight = TeamFlight(pilots, options)
            while not flight.is_over:
                flight.step()
            assert flight.converge(20.0) == mission.converge(20.0)
            rows = flight.finish()
        for node, agent, path, row in zip(nodes, mission.agents, mission.trajectories, rows, strict=True):
            assert node.agent.digest() == agent.digest()
            assert torch.equal(torch.stack(node._flown), torch.stack(path))
            sent = {
                kind: size
                for kind in row["bytes_by_kind"]
                if (size := mission.network.traffic(agent.number, kind).bytes)
            }
            assert row["bytes_by_kind"] == sent
            assert row["datagrams"] == mission.network.traffic(agent.number).datagrams
            assert row["bytes_sent"] == mission.network.traffic(agent.number).bytes > 0
            assert row["path_length"] == agent.robot.path_length
            assert (row["late"], row["refused"], row["failures"], row["ended"]) == (0, {}, {}, 4.0)
            assert json.loads(json.dumps(row, allow_nan=False)) == row
    assert sum(row["path_length"] for row in rows) > 0
    assert flight.encounters == 0
    assert rows[0]["digest"] == rows[1]["digest"]


# -- a robot that is lost -------------------------------------------------------------------------


def pilot(answers: str, number: int = 3) -> RemotePilot:
    return RemotePilot(number, io.StringIO(), io.StringIO(answers), [])


def test_a_robot_that_has_ended_is_named():
    with pytest.raises(RobotLostError, match="Robot 3 is lost: it has ended") as caught:
        pilot("").do("survey", now=0.0)
    assert caught.value.robot == 3


@pytest.mark.parametrize(
    "line", ["Segmentation fault", "[]", "7", "{}", '{"sent": null}', '{"sent": "many"}', "{"]
)
def test_what_is_no_answer_is_shown(line):
    with pytest.raises(RobotLostError, match="Robot 3 is lost: it answers") as caught:
        pilot(line + "\n").do("survey", now=0.0)
    assert line in str(caught.value)


@pytest.mark.parametrize(
    "plan",
    [
        {},
        {"path": "far"},
        {"path": [[1.0, 2.0]], "braking": [], "views": [], "value": 0.0},
        {"path": [[float("nan")] * 7], "braking": [], "views": [], "value": 0.0},
        {"path": [], "braking": [], "views": [], "value": None},
    ],
)
def test_what_is_no_plan_is_shown(plan):
    with pytest.raises(RobotLostError, match="Robot 3 is lost: it answers"):
        pilot(json.dumps({"sent": 0, **plan}) + "\n").propose(0.0, [], Paths.of([]))


def test_a_robot_that_no_longer_listens_is_named():
    there, here = os.pipe()
    os.close(there)
    asked = os.fdopen(here, "w")
    with pytest.raises(RobotLostError, match="Robot 1 is lost"):
        RemotePilot(1, asked, io.StringIO(), []).ask("survey", now=0.0)
    with pytest.raises(BrokenPipeError):
        asked.close()


# -- the robot's side -----------------------------------------------------------------------------


def served(*requests: Any, received: int = 0, refused: int = 0) -> tuple[Any, list[dict[str, Any]]]:
    """A robot that so much has come to, after these requests; and its answers."""
    agent = SimpleNamespace(listen=lambda now: None)
    transport = SimpleNamespace(
        received=Traffic(received, 0), refused={"echo": refused}, traffic=lambda: Traffic(5, 90)
    )
    node: Any = SimpleNamespace(agent=agent, transport=transport, n_late=0)
    lines = [line if isinstance(line, str) else json.dumps(line) for line in requests]
    answers = io.StringIO()
    Serving(node, lambda now: {"now": now}).serve(io.StringIO("\n".join([*lines, ""])), answers)
    return node, [json.loads(line) for line in answers.getvalue().splitlines()]


@pytest.mark.parametrize("line", ["hello", "[]", '"finish"', '{"do": 3}', "{}", '{"do": "dance"}'])
def test_a_robot_refuses_what_nobody_can_ask(line):
    with pytest.raises(DataError, match="nothing that a robot"):
        served(line)


def test_it_ends_when_it_is_finished_or_nobody_asks_any_more():
    finish, listen = {"do": "finish", "now": 2.5}, {"do": "listen", "now": 1.0, "expected": 0}
    assert served(listen, listen)[1] == [{"sent": 5}, {"sent": 5}]
    assert served(finish, "not read any more")[1] == [{"sent": 5, "row": {"now": 2.5}}]


@pytest.fixture
def naps(monkeypatch) -> list[float]:
    """How often it slept; time passes no other way."""
    slept: list[float] = []
    monkeypatch.setattr(lockstep.time, "sleep", slept.append)
    monkeypatch.setattr(lockstep.time, "monotonic", lambda: sum(slept))
    return slept


def test_what_does_not_come_is_waited_for_once_and_counted(naps):
    def listen(expected: int) -> dict[str, Any]:
        return {"do": "listen", "now": 0.0, "expected": expected}

    node, _ = served(listen(4), received=4)
    assert (node.n_late, naps) == (0, [])
    node, _ = served(listen(7), received=4)
    assert (node.n_late, sum(naps)) == (3, pytest.approx(2.0, abs=0.01))
    naps.clear()
    node, _ = served(listen(7), listen(7), listen(7), received=4)
    assert (node.n_late, sum(naps)) == (3, pytest.approx(2.0, abs=0.01))
    node, _ = served(listen(5), listen(7), received=4)
    assert node.n_late == 3


def test_what_is_not_of_the_team_is_not_waited_for_in_its_stead(naps):
    node, _ = served({"do": "listen", "now": 0.0, "expected": 6}, received=6, refused=2)
    assert node.n_late == 2


def test_what_comes_late_is_late_once_and_what_is_lost_after_it_too(naps):
    node: Any = SimpleNamespace(
        transport=SimpleNamespace(received=Traffic(0, 0), refused={}), agent=None, n_late=0
    )
    serving = Serving(node, lambda now: {})
    serving._await(2)
    node.transport.received = Traffic(2, 0)
    serving._await(2)
    assert node.n_late == 2
    serving._await(3)
    assert node.n_late == 3
