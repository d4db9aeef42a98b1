"""A stopwatch by a clock that the test turns."""

from __future__ import annotations

from gmmtorch.exploration.mission.stopwatch import Stopwatch


def test_a_stage_within_another_counts_to_itself_alone() -> None:
    now = 100.0
    watch = Stopwatch(lambda: now)
    for _ in range(2):
        with watch("planning"):
            now += 1.0
            with watch("mapping"):
                now += 2.0
                with watch("planning"):
                    now += 4.0
            now += 8.0
        now += 16.0  # of no stage
    assert watch.seconds == {"planning": 2 * (1.0 + 4.0 + 8.0), "mapping": 2 * 2.0}


def test_by_the_wall_it_goes_on() -> None:
    watch = Stopwatch()
    with watch("nothing"):
        pass
    assert watch.seconds["nothing"] > 0
