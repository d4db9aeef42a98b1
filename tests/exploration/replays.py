"""What tests of replaying robots share: a clock, logs, and what maps say."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence

import torch

from gmmtorch.datasets import load
from gmmtorch.mapping.codec.component_batch import quantized
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule
from gmmtorch.scan import Scan

RULES = {
    "per_scan": WindowedRule(window=1, max_origins=1),
    "windowed": WindowedRule(window=4, max_origins=2),  # which draws the origins that it keeps
    "incremental": IncrementalRule(window=3, n_components=40),  # which merges what was published
}


class Clock:
    """Stands still but for sleep."""

    def __init__(self) -> None:
        self.time = 100.0
        self.sleeps: list[float] = []

    def __call__(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.sleeps.append(seconds)
        self.time += seconds


@functools.cache
def log(n_scans: int) -> list[Scan]:
    """Scans of a laser in a simulated office; every sixth beam."""

    def thinned(scan: Scan) -> Scan:
        keep = torch.zeros(scan.n_beams, dtype=torch.bool)
        keep[::6] = True
        return scan.select(keep)

    return [thinned(scan) for scan in load("synthetic_building_2d", n_scans=n_scans)]


def mapped(rule: str, scans: Sequence[Scan]) -> GaussianMap:
    """The map of a robot that is alone, and never killed."""
    made = GaussianMap(RULES[rule])
    for scan in scans:
        made.insert(scan)
    return made


def content(*maps: Components) -> Counter[tuple[object, ...]]:
    """What components say, to the bit, whatever their ids and order, and how often."""
    found: Counter[tuple[object, ...]] = Counter()
    for components in maps:
        c = quantized(components)
        seen: list[list[tuple[float, ...]]] = [[] for _ in range(len(c))]
        for by, whence, count in zip(
            c.seen_by.tolist(), c.seen_from.tolist(), c.seen_count.tolist(), strict=True
        ):
            seen[by].append((*c.origins[whence].tolist(), count))
        for row in range(len(c)):
            shape = (*c.means[row].tolist(), *c.covariances[row].flatten().tolist())
            found[(shape, float(c.support[row]), bool(c.max_range[row]), tuple(sorted(seen[row])))] += 1
    return found
