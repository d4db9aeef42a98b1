"""GaussianMap with each rule passes the contract of `occupancy.protocol_contract`."""

from __future__ import annotations

from occupancy.protocol_contract import RESOLUTION, OccupancyMapContract

from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule


class TestGaussianMapOneOrigin(OccupancyMapContract):
    """The thesis's map: one mixture a scan, one origin a component."""

    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(WindowedRule(window=1, max_origins=1), resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapWindowed(OccupancyMapContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(WindowedRule(), resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapIncremental(OccupancyMapContract):
    """The default: merged as it grows."""

    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapUnderABudget(OccupancyMapContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(IncrementalRule(window=2, max_bytes=1000), resolution=RESOLUTION)
