"""run_paced: ticks by a clock that the test has in its hands."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from exploration.replays import Clock
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.exploration.mission.node import Node, TwinError, check_number, run_paced
from gmmtorch.exploration.mission.replay import ReplayNode

if TYPE_CHECKING:
    replaying: type[Node] = ReplayNode


class Toy:
    """Notes when it is called; a tick takes as long as `takes` says."""

    def __init__(
        self, n_ticks: float = math.inf, clock: Clock | None = None, takes: dict[int, float] | None = None
    ):
        self.robot, self._n, self._clock, self._takes = 0, n_ticks, clock, takes or {}
        self.ticks: list[float] = []
        self.listened: list[float] = []
        self.records = 0
        self.news_at: list[float] = []
        self.twin: str | None = None

    def tick(self, now: float) -> None:
        if self._clock is not None:
            self._clock.time += self._takes.get(len(self.ticks), 0.0)
        self.ticks.append(now)

    def listen(self, now: float) -> None:
        self.listened.append(now)
        self.records = sum(at <= now for at in self.news_at)

    @property
    def is_over(self) -> bool:
        return len(self.ticks) >= self._n

    def status(self) -> str:
        return ""

    def scalars(self) -> dict[str, float]:
        return {"records": float(self.records)}

    def row(self) -> dict[str, object]:
        return {}

    def files(self) -> dict[str, tuple[str, Callable[[Path], object]]]:
        return {}

    def close(self) -> None:
        pass


def paced(nodes, rate, clock=None, **options):
    clock = clock or Clock()
    return run_paced(nodes, rate, clock=clock, sleep=clock.sleep, **options)


@pytest.mark.parametrize("speed", [1.0, 4.0, 0.5])
def test_ticks_come_at_their_rate_and_it_listens_in_between(speed):
    node, clock = Toy(6), Clock()
    done = paced(node, 2.0, clock, speed=speed)
    assert node.ticks == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.5], abs=1e-3 * speed)
    assert (done.ticks, done.late) == (6, 0)
    assert clock.time - 100.0 == pytest.approx(2.5 / speed, abs=1e-3)
    assert max(clock.sleeps) <= 0.02
    gaps = [b - a for a, b in zip([0.0, *node.listened], [*node.listened, 2.5], strict=True)]
    assert max(gaps) <= 0.02 * speed + 1e-9


def test_a_long_tick_delays_the_others_and_none_are_hurried():
    clock = Clock()
    node = Toy(6, clock, takes={1: 3.7, 4: 0.99})
    done = paced(node, 1.0, clock)
    assert node.ticks == pytest.approx([0, 1, 4.7, 5.7, 6.7, 7.7], abs=1e-3)
    assert (done.ticks, done.late) == (6, 1)


def test_a_robot_that_never_keeps_up_hears_all_the_same():
    clock = Clock()
    slow, quick = Toy(5, clock, takes=dict.fromkeys(range(5), 2.0)), Toy(1)
    done = paced([slow, quick], 1.0, clock)
    assert slow.ticks == pytest.approx([0, 2, 4, 6, 8])
    assert done.late == 5
    assert len(quick.ticks) == 1
    assert len(quick.listened) == 4  # while the other works on


@given(jumps=st.lists(st.floats(-1e9, 0.0), max_size=20), every=st.integers(1, 7))
def test_a_clock_that_is_set_back_delays_but_nothing_else(jumps, every):
    clock, left = Clock(), list(jumps)

    def sleep(seconds: float) -> None:
        clock.sleep(seconds)
        if left and len(clock.sleeps) % every == 0:
            clock.time += left.pop()

    node = Toy(4)
    done = run_paced(node, 5.0, clock=clock, sleep=sleep)
    assert (done.ticks, done.late) == (4, 0)
    assert node.ticks == pytest.approx([0.0, 0.2, 0.4, 0.6], abs=0.03)
    assert node.listened == sorted(node.listened)


def test_a_clock_that_leaps_makes_one_tick_late_and_not_many():
    clock = Clock()
    node = Toy(5, clock, takes={2: 1e6})  # as after a suspend
    assert paced(node, 10.0, clock).late == 1
    gaps = [b - a for a, b in zip(node.ticks, node.ticks[1:], strict=False)]
    assert gaps == pytest.approx([0.1, 0.1, 1e6, 0.1], abs=1e-3)


def test_the_time_of_day_is_not_asked_for(monkeypatch):
    for name in ("time", "time_ns", "localtime", "gmtime"):
        monkeypatch.setattr(time, name, lambda *_: pytest.fail("It asks for the time of day."))
    node = Toy(3)
    assert run_paced(node, 200.0).ticks == 3
    assert node.ticks == sorted(node.ticks)


@pytest.mark.parametrize(("duration", "n"), [(0.0, 0), (0.05, 1), (1.0, 10), (1.01, 11)])
def test_a_duration(duration, n):
    node = Toy()
    assert paced(node, 10.0, duration=duration).ticks == n
    assert len(node.ticks) == n


def test_it_goes_on_until_nothing_new_has_come_for_a_while():
    node, clock = Toy(2), Clock()
    node.news_at = [2.0, 3.5, 9.0]
    done = paced(node, 1.0, clock, settle=3.0)
    assert done.seconds == pytest.approx(6.5, abs=0.3)  # 3.5, and as long again; 9 is too late
    assert max(node.listened) > 6.0
    assert paced(Toy(2), 1.0).seconds == pytest.approx(1.0, abs=1e-3)


def test_it_stops_when_told_to_at_work_and_after_it():
    for limit, n_ticks in ((0.55, 6), (5.0, 10)):
        clock, node = Clock(), Toy(10)
        done = paced(node, 10.0, clock, settle=1e9, stop=lambda c=clock, t=limit: c.time >= 100 + t)
        assert done.ticks == len(node.ticks) == n_ticks
        assert clock.time - 100 == pytest.approx(limit, abs=0.021)


def test_an_event_stops_it_and_need_not_be_waited_for():
    stop, node = threading.Event(), Toy()
    threading.Timer(0.05, stop.set).start()
    assert run_paced(node, 1e-3, stop=stop.is_set, sleep=stop.wait).ticks == 1


def test_it_tells_how_things_are():
    told: list[tuple[Node, float]] = []
    nodes = [Toy(5), Toy(5)]
    paced(nodes, 2.0, on_status=lambda node, now: told.append((node, now)), settle=1.5)
    assert [node for node, _ in told] == nodes * 4
    assert [now for _, now in told[::2]] == pytest.approx([1.0, 2.0, 3.0, 3.5], abs=0.1)


@pytest.mark.parametrize(
    "options",
    [{"rate": 0.0}, {"rate": math.inf}, {"rate": math.nan}, {"speed": -1.0}, {"settle": -1.0},
     {"settle": math.inf}, {"duration": -1.0}, {"duration": math.nan}, {"status_every": 0.0}],
)  # fmt: skip
def test_bad_options(options):
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        run_paced(Toy(1), **{"rate": 1.0, **options})


def test_a_node_whose_number_is_taken():
    node = Toy(1)
    check_number(node)
    node.twin = "Another robot says that it is robot 0."
    with pytest.raises(TwinError, match="robot 0") as raised:
        check_number(node)
    assert isinstance(raised.value, GmmTorchError)
