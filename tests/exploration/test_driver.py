"""drive and settle: ticks at their times, by clocks under the test's control."""

from __future__ import annotations

import math
import time

import pytest
from exploration.replays import FakeTime, Together
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration import Drivable, Stopwatch, WallClock, drive, settle
from gmmtorch.team.exploration.mission.driver import Run, SimulatedClock


class Toy:
    """A mission that records its calls. Tick n takes `takes[n]` seconds; news arrives at `news_at` (s)."""

    def __init__(
        self,
        rate: float,
        n_ticks: float = math.inf,
        fake: FakeTime | None = None,
        takes: dict[int, float] | None = None,
    ) -> None:
        self.tick_seconds = 1 / rate
        self.ticks: list[float] = []
        self.exchanges: list[float] = []
        self.news_at: list[float] = []
        self._n_ticks, self._fake, self._takes = n_ticks, fake, takes or {}

    def tick(self, now: float) -> None:
        if self._fake is not None:
            self._fake.time += self._takes.get(len(self.ticks), 0.0)
        self.ticks.append(now)

    def exchange(self, now: float) -> None:
        self.exchanges.append(now)

    def content(self) -> int:
        return sum(at <= self.exchanges[-1] for at in self.news_at) if self.exchanges else 0

    @property
    def is_over(self) -> bool:
        return len(self.ticks) >= self._n_ticks


def driven(mission: Drivable, fake: FakeTime | None = None, speed: float = 1.0) -> Run:
    fake = FakeTime() if fake is None else fake
    return drive(mission, WallClock(speed, fake, fake.sleep))


def test_simulated_clock_gives_exact_times_and_never_waits(monkeypatch):
    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("A simulated clock must not sleep."))
    toy, steps = Toy(3.0, 7), []
    assert drive(toy, SimulatedClock(), on_step=lambda: steps.append(len(toy.ticks))) == Run(7, 0, 6 / 3.0)
    assert toy.ticks == [n * (1 / 3.0) for n in range(7)]
    assert toy.exchanges == []
    assert steps == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("speed", [1.0, 4.0, 0.5])
def test_wall_clock_ticks_at_the_rate_and_exchanges_in_between(speed):
    toy, fake = Toy(2.0, 6), FakeTime()
    done = driven(toy, fake, speed)
    assert toy.ticks == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.5], abs=1e-3 * speed)
    assert (done.ticks, done.late) == (6, 0)
    assert fake.time - 100.0 == pytest.approx(2.5 / speed, abs=1e-3)
    assert max(fake.sleeps) <= 0.02
    gaps = [b - a for a, b in zip([0.0, *toy.exchanges], [*toy.exchanges, 2.5], strict=True)]
    assert max(gaps) <= 0.02 * speed + 1e-9


def test_a_long_tick_delays_all_later_ticks_and_shortens_none():
    fake = FakeTime()
    toy = Toy(1.0, 6, fake, takes={1: 3.7, 4: 0.99})
    assert driven(toy, fake)[:2] == (6, 1)
    assert toy.ticks == pytest.approx([0, 1, 4.7, 5.7, 6.7, 7.7], abs=1e-3)


def test_a_mission_that_is_always_late_still_exchanges():
    fake = FakeTime()
    slow, quick = Toy(1.0, 5, fake, takes=dict.fromkeys(range(5), 2.0)), Toy(1.0, 1)
    assert driven(Together(slow, quick), fake).late == 5
    assert slow.ticks == pytest.approx([0, 2, 4, 6, 8])
    assert (len(quick.ticks), len(quick.exchanges)) == (1, 4)


@given(jumps=st.lists(st.floats(-1e9, 0.0), max_size=20), every=st.integers(1, 7))
def test_a_clock_that_is_set_back_only_delays(jumps, every):
    fake, left = FakeTime(), list(jumps)

    def sleep(seconds: float) -> None:
        fake.sleep(seconds)
        if left and len(fake.sleeps) % every == 0:
            fake.time += left.pop()

    toy = Toy(5.0, 4)
    assert drive(toy, WallClock(1.0, fake, sleep))[:2] == (4, 0)
    assert toy.ticks == pytest.approx([0.0, 0.2, 0.4, 0.6], abs=0.03)
    assert toy.exchanges == sorted(toy.exchanges)


def test_wall_clock_does_not_read_the_time_of_day(monkeypatch):
    for name in ("time", "time_ns", "localtime", "gmtime"):
        monkeypatch.setattr(time, name, lambda *_: pytest.fail("It reads the time of day."))
    toy = Toy(200.0, 3)
    assert drive(toy, WallClock()).ticks == 3
    assert toy.ticks == sorted(toy.ticks)


def test_settle_ends_once_no_news_has_arrived_for_a_while():
    toy, fake = Toy(1.0), FakeTime()
    toy.news_at = [2.0, 3.5, 9.0]
    clock = WallClock(clock=fake, sleep=fake.sleep)
    settle(toy, clock, 3.0)
    assert clock.now() == pytest.approx(6.5, abs=0.3)  # 3.5 and 3; 9 is too late
    assert max(toy.exchanges) > 6.0
    settle(toy, clock, 0.0)
    assert clock.now() == pytest.approx(6.5, abs=0.3)


@pytest.mark.parametrize("when", [0.0, 2.5, 7.5])
def test_stop_ends_drive_and_settle(when):
    fake = FakeTime()
    toy, clock = Toy(1.0, 6), WallClock(clock=fake, sleep=fake.sleep)

    def stop() -> bool:
        return fake.time >= 100.0 + when

    assert drive(toy, clock, stop=stop).ticks == (0 if when == 0 else min(math.floor(when) + 1, 6))
    settle(toy, clock, 100.0, stop=stop)
    assert clock.now() == pytest.approx(when, abs=0.03)


def test_on_step_is_called_after_every_tick_and_exchange():
    toy, fake, steps = Toy(1.0, 3), FakeTime(), []
    clock = WallClock(clock=fake, sleep=fake.sleep)
    drive(toy, clock, on_step=lambda: steps.append(len(toy.ticks) + len(toy.exchanges)))
    settle(toy, clock, 0.5, on_step=lambda: steps.append(len(toy.ticks) + len(toy.exchanges)))
    assert steps == list(range(1, len(toy.ticks) + len(toy.exchanges) + 1))


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_bad_speeds_and_times_to_settle_are_rejected(value):
    with pytest.raises(InvalidArgumentError, match=f"speed={value}"):
        WallClock(value)
    with pytest.raises(InvalidArgumentError, match=f"settle={value}"):
        settle(Toy(1.0), SimulatedClock(), value)


def test_stopwatch_counts_a_nested_stage_for_itself_only():
    fake = FakeTime()
    watch = Stopwatch(fake)
    with watch("outer"):
        fake.sleep(1.0)
        with watch("inner"):
            fake.sleep(2.0)
        with watch("inner"):
            fake.sleep(4.0)
        fake.sleep(8.0)
    assert watch.seconds == {"inner": 6.0, "outer": 9.0}
