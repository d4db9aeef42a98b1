"""TeamFlight: a mission whose robots are processes, tick by tick; see `lockstep`."""

from __future__ import annotations

import math
from typing import Any

import torch

from gmmtorch.exploration.mission.lockstep import RemotePilot, ask_all
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.team_setup import coordination_of
from gmmtorch.exploration.planning.planning_round import take_turns
from gmmtorch.exploration.world.collisions import meets_others


class TeamFlight:
    """What a `Mission` is, but for the maps, which are the robots' alone, and the network, which is real.

    Args:
        pilots: by number; their processes have started.
    """

    def __init__(self, pilots: list[RemotePilot], options: TeamOptions) -> None:
        self.pilots, self.options = pilots, options
        self.tick = 0
        self.encounters = 0
        """Ticks in which a robot met another."""
        self._coordination = coordination_of(options)
        self._generator = torch.Generator().manual_seed(options.seed)
        for pilot, answer in zip(pilots, ask_all(pilots, "start"), strict=True):
            pilot.braking = pilot.rows(answer, "braking", 7)
            pilot.position = pilot.rows(answer, "position", 3)[-1]

    @property
    def now(self) -> float:
        """Simulated seconds since the start."""
        return self.tick * self.options.tick_seconds

    @property
    def is_over(self) -> bool:
        return self.now >= self.options.duration - 1e-9

    def step(self) -> None:
        """One tick: sense, exchange, plan if it is due, fly on."""
        options, now = self.options, self.now
        places = {pilot.number: pilot.position.tolist() for pilot in self.pilots}
        ask_all(
            self.pilots,
            "sense",
            lambda pilot: {"others": [there for n, there in places.items() if n != pilot.number]},
            now=now,
        )
        self._listen(now)
        if self.tick % options.ticks_per_plan == 0:
            number = self.tick // options.ticks_per_plan
            take_turns(self.pilots, self._coordination, options, now, number, self._generator)
        begin = (self.tick % options.ticks_per_plan) * options.steps_per_tick
        answers = ask_all(self.pilots, "fly", begin=begin, stop=begin + options.steps_per_tick)
        flown = [
            pilot.rows(answer, "positions", 3) for pilot, answer in zip(self.pilots, answers, strict=True)
        ]
        for pilot, positions in zip(self.pilots, flown, strict=True):
            pilot.position = positions[-1]
        self.encounters += int(meets_others(torch.stack(flown), options.dynamics.radius).any(1).sum())
        self.tick += 1
        if self.is_over:
            self._listen(self.now)

    def converge(self, limit: float) -> float | None:
        """Robots go on talking where they are until all hold the same; returns for how many simulated
        seconds, at most `limit`, or None if that is not enough."""
        for tick in range(math.floor(limit * self.options.rate) + 1):
            if len({answer.get("digest") for answer in ask_all(self.pilots, "digest")}) == 1:
                return tick / self.options.rate
            now = self.now + tick / self.options.rate
            ask_all(self.pilots, "send", now=now)
            self._listen(now + self.options.tick_seconds)
        return None

    def finish(self) -> list[dict[str, Any]]:
        """Robots write what they leave, and end; their rows."""
        return [answer.get("row", {}) for answer in ask_all(self.pilots, "finish", now=self.now)]

    def _listen(self, now: float) -> None:
        ask_all(self.pilots, "listen", lambda pilot: {"expected": pilot.expected()}, now=now)
