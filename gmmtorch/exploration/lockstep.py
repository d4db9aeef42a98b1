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
from gmmtorch.exploration.flying import FlyingNode
from gmmtorch.exploration.planning import Plan
from gmmtorch.exploration.traffic import Traffic

_PATIENCE = 2.0  # seconds for datagrams that are on their way
_PAUSE = 0.002
_MOST_CHARACTERS = 1 << 24  # of a line


class RobotLostError(GmmTorchError):
    """The process of a robot has ended, or says nothing sensible."""


# -- the robot's side -----------------------------------------------------------------------------


class Serving:
    """A flying robot that does what it is asked, until it is asked to finish.

    Args:
        finish: writes what the robot leaves behind, and returns its row. on_sense: hears the time of each
            frame.
    """

    def __init__(
        self, node: FlyingNode, finish: Callable[[], dict[str, Any]], on_sense: Callable[[float], None]
    ) -> None:
        self._node, self._finish, self._on_sense = node, finish, on_sense
        self.n_late = 0
        """Datagrams that had not come in time."""

    def serve(self, asked: IO[str], answered: IO[str]) -> None:
        """Answer until there is nothing more to be read."""
        while line := asked.readline(_MOST_CHARACTERS):
            request = json.loads(line)
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
            node.sense(about["now"], _rows(about["others"], 3))
            self._on_sense(about["now"])
        elif do == "listen":
            self._await(about["expected"])
            agent.listen(about["now"])
        elif do == "survey":
            agent.survey(about["now"])
        elif do == "propose":
            traffic = Traffic(
                torch.tensor(about["paths"], dtype=torch.float64).reshape(-1, about["steps"], 3),
                about["separation"],
            )
            plan = agent.propose(about["now"], about["fixed"], traffic)
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
            return {"digest": agent.digest().hex(), "status": node.status()}
        elif do == "finish":
            return {"row": {**self._finish(), "late": self.n_late}}
        else:
            raise DataError(f"do={do!r} is nothing that a robot does.")
        return None

    def _await(self, expected: int) -> None:
        """Wait until so many datagrams have come in all, or those that are missing must be lost."""
        transport = self._node.transport
        end = time.monotonic() + _PATIENCE
        while transport.received.datagrams < expected and time.monotonic() < end:
            time.sleep(_PAUSE)
        self.n_late += max(0, expected - transport.received.datagrams)


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
            raise self._lost(str(error)) from error

    def answer(self) -> dict[str, Any]:
        """What it answers to what it was asked last."""
        try:
            line = self._answered.readline(_MOST_CHARACTERS)
            answer: dict[str, Any] = json.loads(line) if line else {}
            self.n_sent = int(answer["sent"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise self._lost("it has ended" if not line else f"it answers {line[:80]!r}") from error
        return answer

    def _lost(self, why: str) -> RobotLostError:
        return RobotLostError(f"Robot {self.number} is lost: {why}; see its log in its folder.")

    def do(self, do: str, **about: Any) -> dict[str, Any]:
        """Ask, and wait for the answer."""
        self.ask(do, **about)
        return self.answer()

    # -- as a pilot -------------------------------------------------------------------------------

    def expected(self) -> int:
        """Datagrams that the others have sent it in all."""
        return sum(pilot.n_sent for pilot in self._team if pilot is not self)

    def listen(self, now: float) -> None:
        self.do("listen", now=now, expected=self.expected())

    def survey(self, now: float) -> None:
        self.do("survey", now=now)

    def propose(self, now: float, fixed: Collection[int], traffic: Traffic) -> Plan:
        paths, separation = traffic.paths, traffic.separation
        answer = self.do(
            "propose",
            now=now,
            fixed=sorted(fixed),
            paths=paths.tolist(),
            steps=paths.shape[1],
            separation=separation,
        )
        self._plan = Plan(
            path=_rows(answer["path"], 7),
            braking=_rows(answer["braking"], 7),
            views=_rows(answer["views"], 4),
            value=float(answer["value"]),
            kind=str(answer["kind"]),
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
    pilots: Sequence[RemotePilot], do: str, about: Callable[[RemotePilot], dict[str, Any]]
) -> list[dict[str, Any]]:
    """Ask all at once, so that they work at the same time; their answers."""
    for pilot in pilots:
        pilot.ask(do, **about(pilot))
    return [pilot.answer() for pilot in pilots]


def _rows(values: Any, width: int) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).reshape(-1, width)
