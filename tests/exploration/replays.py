"""Helpers for tests of robots that replay logs: a clock, a driver of several robots, logs, map contents."""

from __future__ import annotations

import functools
import shutil
from collections import Counter
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import torch

from gmmtorch.datasets import DatasetShard, load, shard_indices
from gmmtorch.mapping import Components, GaussianMap, IncrementalRule, WindowedRule, quantized
from gmmtorch.scan import Scan
from gmmtorch.team.exploration.mission.driver import Drivable, Run, WallClock, drive, settle
from gmmtorch.team.exploration.mission.replay import ReplayMission
from gmmtorch.team.sharing import Replica, Store

RULES = {
    "per_scan": WindowedRule(window=1, max_origins=1),
    "windowed": WindowedRule(window=4, max_origins=2),  # draws the origins that it keeps
    "incremental": IncrementalRule(window=3, n_components=40),  # merges published components
}


class FakeTime:
    """A system clock that only `sleep` advances."""

    def __init__(self) -> None:
        self.time = 100.0
        self.sleeps: list[float] = []

    def __call__(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.sleeps.append(seconds)
        self.time += seconds


class Together:
    """Several missions in one thread, as one mission."""

    def __init__(self, *missions: Drivable) -> None:
        self._missions = missions
        self.tick_seconds = missions[0].tick_seconds

    @property
    def is_over(self) -> bool:
        return all(mission.is_over for mission in self._missions)

    def tick(self, now: float) -> None:
        for mission in self._missions:
            (mission.exchange if mission.is_over else mission.tick)(now)

    def exchange(self, now: float) -> None:
        for mission in self._missions:
            mission.exchange(now)

    def content(self) -> Hashable:
        return tuple(mission.content() for mission in self._missions)


def run(*missions: Drivable, quiet: float = 0.0, clock: WallClock | None = None) -> Run:
    """Drives missions together, by a fake clock unless one is given, then lets them settle."""
    fake = FakeTime()
    clock = WallClock(clock=fake, sleep=fake.sleep) if clock is None else clock
    together = Together(*missions)
    done = drive(together, clock)
    settle(together, clock, quiet)
    return done


def log(n_scans: int) -> list[Scan]:
    """The first scans, at most 32, of a laser in a simulated office, with every sixth beam."""
    return _scans()[:n_scans]


@functools.cache
def _scans() -> list[Scan]:
    def thinned(scan: Scan) -> Scan:
        keep = torch.zeros(scan.n_beams, dtype=torch.bool)
        keep[::6] = True
        return scan.select(keep)

    return [thinned(scan) for scan in load("synthetic_building_2d", n_scans=32)]


def mapped(rule: str, scans: Sequence[Scan]) -> GaussianMap:
    """The map of a single robot that is never killed."""
    made = GaussianMap(RULES[rule])
    for scan in scans:
        made.insert(scan)
    return made


def content(*maps: Components) -> Counter[tuple[object, ...]]:
    """How often each content occurs among components, to the bit; independent of ids and order."""
    found: Counter[tuple[object, ...]] = Counter()
    for components in maps:
        c = quantized(components)
        seen: list[list[tuple[float, ...]]] = [[] for _ in range(len(c))]
        for by, viewpoint, count in zip(
            c.seen_by.tolist(), c.seen_from.tolist(), c.seen_count.tolist(), strict=True
        ):
            seen[by].append((*c.origins[viewpoint].tolist(), count))
        for row in range(len(c)):
            shape = (*c.means[row].tolist(), *c.covariances[row].flatten().tolist())
            found[(shape, float(c.support[row]), bool(c.max_range[row]), tuple(sorted(seen[row])))] += 1
    return found


def part(k: int, n: int, n_scans: int = 24) -> DatasetShard:
    return DatasetShard(log(n_scans), shard_indices(n_scans, k, n))


def robot(number: int, scans: Any, transport: Any, rule: str = "windowed", **options: Any) -> ReplayMission:
    made = {"rate": 10.0, **options}
    return ReplayMission(Replica(number), scans, transport, lambda: GaussianMap(RULES[rule]), **made)


def stored(folder: Path, scans: Any, transport: Any, rule: str = "windowed", **options: Any) -> ReplayMission:
    """A robot 0 with a store, which is left open."""
    replica, store = Replica(0), Store(folder / "robot.sqlite", 0)
    store.restore(replica)
    return ReplayMission(
        replica, scans, transport, lambda: GaussianMap(RULES[rule]), rate=10.0, store=store, **options
    )


def killed(folder: Path) -> Path:
    """The files that the death of a robot's process leaves."""
    copy = folder.with_name(f"{folder.name}+")
    shutil.copytree(folder, copy)
    return copy
