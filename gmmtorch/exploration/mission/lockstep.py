"""Lockstep: a simulated team whose robots are processes, in step with one another as in a `Mission`.

The team's side speaks to each robot over a pair of pipes: a line of JSON asks, a line answers. What the
robots tell each other goes over their own network. The team knows how much each has said, so that a robot
can wait until all of it has come: where nothing is lost, the mission is the one that would have been flown
in a single process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Sequence
from typing import IO, Any

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.exploration.mission.flying import FlyingNode
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.planning.planner_interface import Plan

_PATIENCE = 2.0  # seconds for datagrams that are on their way
_PAUSE = 0.002
_MOST_CHARACTERS = 1 << 24  # of a line


class RobotLostError(GmmTorchError):
    """The process of a robot, by its number, has ended, or says nothing sensible."""

    def __init__(self, robot: int, why: str) -> None:
        super().__init__(f"Robot {robot} is lost: {why}; see the log in its folder.")
        self.robot = robot


# -- the robot's side -----------------------------------------------------------------------------


class Serving:
    """A flying robot that does what it is asked, until it is asked to finish.

    Args:
        finish: given the time, writes what the robot leaves behind, and returns its row.
        on_tick: hears the time of each tick, as it begins.
    """

    def __init__(
        self,
        node: FlyingNode,
        finish: Callable[[float], dict[str, Any]],
        on_tick: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._node, self._finish, self._on_tick = node, finish, on_tick
        self._missing = 0  # datagrams that have been waited for in vain

    def serve(self, asked: IO[str], answered: IO[str]) -> None:
        """Answer until it is finished, or nobody asks any more. Raises `DataError` for what is no request."""
        while line := asked.readline(_MOST_CHARACTERS):
            request = _request(line)
            with torch.inference_mode():
                answer = self._answer(**request) or {}
            answer["sent"] = self._node.transport.traffic().datagrams
            answered.write(json.dumps(answer, allow_nan=False) + "\n")
            answered.flush()
            if request["do"] == "finish":
                return

    def _answer(self, do: str, **about: Any) -> dict[str, Any] | None:
        node, agent = self._node, self._node.agent
        if do == "start":
            return {"braking": agent.robot.braking.tolist(), "position": agent.robot.position.tolist()}
        if do == "sense":
            self._on_tick(about["now"])
            node.sense(about["now"], _rows(about["others"], 3))
        elif do == "listen":
            self._await(about["expected"])
            agent.listen(about["now"])
        elif do == "survey":
            agent.survey(about["now"])
        elif do == "propose":
            peers = PeerTrajectories(
                torch.tensor(about["paths"], dtype=torch.float64).reshape(-1, about["steps"], 3),
                about["separation"],
            )
            plan = agent.propose(about["now"], about["fixed"], peers)
            return {name: v.tolist() if isinstance(v, Tensor) else v for name, v in vars(plan).items()}
        elif do == "settle":
            agent.settle()
        elif do == "tell_plan":
            agent.tell_plan(about["now"], about["number"])
        elif do == "tell_views":
            agent.tell_views(about["now"])
        elif do == "send":
            agent.send(about["now"])
            agent.tell_views(about["now"])
        elif do == "fly":
            return {"positions": node.fly(about["begin"], about["stop"]).tolist()}
        elif do == "digest":
            return {"digest": agent.digest().hex()}
        elif do == "finish":
            return {"row": self._finish(about["now"])}
        else:
            raise DataError(f"do={do!r} is nothing that a robot does.")
        return None

    def _await(self, expected: int) -> None:
        """Wait until so many datagrams have come in all, or those that are missing must be lost.

        What has been waited for once is not waited for again.
        """
        end = time.monotonic() + _PATIENCE
        while self._arrived() < expected - self._missing and time.monotonic() < end:
            time.sleep(_PAUSE)
        missing = max(0, expected - self._arrived())
        self._node.n_late += max(0, missing - self._missing)
        self._missing = missing

    def _arrived(self) -> int:
        """Datagrams of the team: not this robot's own, which a group brings back, nor a stranger's."""
        transport = self._node.transport
        return transport.received.datagrams - sum(transport.refused.values())


def _request(line: str) -> dict[str, Any]:
    try:
        request = json.loads(line)
    except ValueError:
        request = None
    if not isinstance(request, dict) or not isinstance(request.get("do"), str):
        raise DataError(f"{line[:80]!r} is nothing that a robot can be asked.")
    return request


# -- the team's side ------------------------------------------------------------------------------


class RemotePilot:
    """A robot in another process, as a `Pilot`.

    Args:
        number: the robot's. asked, answered: what it reads from, and writes to. team: all pilots, this one
            among them, once they are made.
    """

    def __init__(self, number: int, asked: IO[str], answered: IO[str], team: list[RemotePilot]) -> None:
        self.number = number
        self._asked, self._answered, self._team = asked, answered, team
        self.n_sent = 0
        """Datagrams that it has broadcast."""
        self.braking = torch.zeros(1, 7, dtype=torch.float64)
        self.position = torch.zeros(3, dtype=torch.float64)
        self._plan: Plan | None = None

    def ask(self, do: str, **about: Any) -> None:
        """Ask, without waiting for the answer."""
        try:
            self._asked.write(json.dumps({"do": do, **about}, allow_nan=False) + "\n")
            self._asked.flush()
        except (OSError, ValueError) as error:
            raise RobotLostError(self.number, str(error)) from error

    def answer(self) -> dict[str, Any]:
        """What it answers to what it was asked last."""
        line = ""
        try:
            line = self._answered.readline(_MOST_CHARACTERS)
            answer: dict[str, Any] = json.loads(line)
            self.n_sent = int(answer["sent"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise self._lost(line) from error
        return answer

    def rows(self, answer: dict[str, Any], name: str, width: int) -> Tensor:
        """The rows (N, width) of numbers that an answer has under a name."""
        try:
            rows = _rows(answer[name], width)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise self._lost(str(answer)) from error
        if not bool(torch.isfinite(rows).all()):
            raise self._lost(str(answer))
        return rows

    def do(self, do: str, **about: Any) -> dict[str, Any]:
        """Ask, and wait for the answer."""
        self.ask(do, **about)
        return self.answer()

    def _lost(self, answer: str) -> RobotLostError:
        return RobotLostError(self.number, f"it answers {answer[:80]!r}" if answer else "it has ended")

    # -- as a pilot -------------------------------------------------------------------------------

    def expected(self) -> int:
        """Datagrams that the others have sent it in all."""
        return sum(pilot.n_sent for pilot in self._team if pilot is not self)

    def listen(self, now: float) -> None:
        self.do("listen", now=now, expected=self.expected())

    def survey(self, now: float) -> None:
        self.do("survey", now=now)

    def propose(self, now: float, fixed: Collection[int], peers: PeerTrajectories) -> Plan:
        paths, separation = peers.paths, peers.separation
        answer = self.do(
            "propose",
            now=now,
            fixed=sorted(fixed),
            paths=paths.tolist(),
            steps=paths.shape[1],
            separation=separation,
        )
        self._plan = Plan(
            path=self.rows(answer, "path", 7),
            braking=self.rows(answer, "braking", 7),
            views=self.rows(answer, "views", 4),
            value=float(self.rows(answer, "value", 1)),
            kind=str(answer.get("kind")),
        )
        return self._plan

    def settle(self) -> None:
        self.do("settle")
        if self._plan is not None:
            self.braking = self._plan.braking

    def tell_plan(self, now: float, number: int) -> None:
        self.do("tell_plan", now=now, number=number)

    def tell_views(self, now: float) -> None:
        self.do("tell_views", now=now)


def ask_all(
    pilots: Sequence[RemotePilot],
    do: str,
    own: Callable[[RemotePilot], dict[str, Any]] = lambda _: {},
    **about: Any,
) -> list[dict[str, Any]]:
    """Ask all at once, so that they work at the same time; their answers.

    own: what only one of them is told.
    """
    for pilot in pilots:
        pilot.ask(do, **about, **own(pilot))
    return [pilot.answer() for pilot in pilots]


def _rows(values: Any, width: int) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).reshape(-1, width)
