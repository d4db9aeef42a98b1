"""GaussianMap with each rule against the contract of occupancy maps."""

from __future__ import annotations

from occupancy.protocol_contract import RESOLUTION, OccupancyMapContract

from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule


class TestGaussianMapWindowed(OccupancyMapContract):
    """With pending and with closed windows, and one origin for each component, as in the thesis."""

    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(WindowedRule(window=2, max_origins=1), resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapIncremental(OccupancyMapContract):
    """The default map."""

    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapUnderABudget(OccupancyMapContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(IncrementalRule(window=2, max_bytes=1000), resolution=RESOLUTION)
