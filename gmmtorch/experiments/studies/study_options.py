"""Options of each study, and what else it depends on: fields that are no options, for Python.

Importing this file loads no torch, so that commands can show their options at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gmmtorch.declarations import option
from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.experiments.evaluation import check_not_empty

if TYPE_CHECKING:
    from gmmtorch.mixture import SensorModel
else:
    SensorModel = Any  # its module loads torch


def _check_sizes(n_components: Sequence[int]) -> None:
    for k in n_components:
        check_whole("n_components", k, 1)


@dataclass(frozen=True)
class ApproximationErrorStudy:
    """Of `studies.approximation_error`, which has no options."""

    dims: Sequence[int] = (2, 3)
    support: float = 100.0  # rays of a component, and prior count, for which the occupancy (3.9) is computed
    prior: float = 1.0
    n_pixels: int = 24  # of the error maps along each axis
    n_components: int = 64  # of the sweep,
    n_cells: int = 8  # and cells for each of them
    n_samples: int = 1024  # Monte Carlo rays of one component, in map and sweep
    n_large_samples: int = 1 << 17  # of the large Monte Carlo in the sweep
    n_scans: int = 1  # of the map that the curve is measured on,
    resolution: float = 0.25  # metres of its cells,
    n_rays: Sequence[int] = (1 << 10, 1 << 12, 1 << 14, 1 << 16, 1 << 18)  # along the curve of Monte Carlo,
    tolerance: Sequence[float] = (0.1, 1e-2, 1e-3, 1e-4)  # and along that of flux


@dataclass(frozen=True)
class AucMemoryStudy:
    """Of `studies.map_studies`."""

    forms: Sequence[str] = ("monte_carlo", "point")  # of evidence
    n_components: Sequence[int] = option((100, 250, 500, 1000), "sizes of our map")
    bgk_points: Sequence[int] = (1555, 3095, 5010, 9472, 17011)  # sizes of the BGK map, in stored points
    others: Sequence[str] = ("occupancy_grid", "bgk", "ndt", "octomap")  # methods that have one size

    def __post_init__(self) -> None:
        _check_sizes(self.n_components)


@dataclass(frozen=True)
class MapVariantsStudy:
    """Of `studies.map_studies`. The first variant is compared with the others."""

    variants: dict[str, Any] = option({}, "for each variant, its options of the map that differ")

    def __post_init__(self) -> None:
        if not self.variants:
            raise InvalidArgumentError(
                "variants={} is empty; give at least one, such as {support: {prune: support}}."
            )
        for name, changes in self.variants.items():
            if not isinstance(changes, dict):
                raise InvalidArgumentError(
                    f"variants={{{name}: {changes!r}}} must be options of the map: {{prune: support}}."
                )


@dataclass(frozen=True)
class PoseCorrectionStudy:
    """Of `studies.map_studies`, which has no options. methods: forms of evidence."""

    methods: Sequence[str] = ("point",)


COUNTS = "counts"
"""Method of the study of thresholds: the training rays, counted in cells; no map."""


@dataclass(frozen=True)
class VarianceThresholdStudy:
    """Of `studies.variance_threshold`: one row for each combination of the lists."""

    railing: float | None = option(
        0.04, "width (m) of the bars of a simulated railing, in place of the data set; null: the data set"
    )
    railing_scans: int = 20
    method: Sequence[str] = (COUNTS, "point", "monte_carlo")
    n_components: Sequence[int] = option((200, 850), "sizes; a map is built for each")
    resolution: Sequence[float] = (0.1, 0.25)  # sides (m) of the cells
    prior: Sequence[Any] = (1.0, 0.1, None)  # N_p of counts; None: calibrated
    variance_threshold: Sequence[float] = (0.06, 0.24)  # values v of (3.10)
    test_every: int = 5  # these two as in `Protocol`
    max_beams: int = 10_000
    thin_width: float = 0.3  # metres, of thin structures in a data set: see `variance_threshold.seen_past`

    def __post_init__(self) -> None:
        check_not_empty(self, "n_components")
        _check_sizes(self.n_components)
        if self.railing is not None:
            check_number("railing", self.railing, above=True)


@dataclass(frozen=True)
class InitializationStudy:
    """Of `studies.fit_studies`: a run for each number of components, start and seed."""

    n_components: Sequence[int] = option((4, 8, 32, 64, 128, 256, 512), "numbers of components")
    init_params: Sequence[str] = ("random_points", "bounding_box", "kmeans", "kmeans_restarts", "flat_pieces")
    initial_covariance: Sequence[str] = option(
        ("tiles",),
        "covariances of random_points and bounding_box. tiles: the mean variance of the cloud, divided by "
        "K^(2/D); box: the square of the bounding box's longest side (thesis 2.1.3)",
    )
    seeds: Sequence[int] = option((0, 1, 2), "seeds of the runs")

    def __post_init__(self) -> None:
        check_not_empty(self, "n_components", "initial_covariance", "seeds")
        for seed in self.seeds:
            check_whole("seeds", seed, 0)
        for name in self.initial_covariance:
            check_choice("initial_covariance", name, ("tiles", "box"))


@dataclass(frozen=True)
class ComponentCountStudy:
    """Of `studies.fit_studies`. The test of the maps is as in `Protocol`."""

    n_components: Sequence[int] = option((16, 32, 64, 128, 256, 512, 1024), "numbers K of the curve")
    noise: float = 0.01  # standard deviation (m) of the range sensor
    multiples: Sequence[float] = (0.5, 1.0, 2.0, 4.0)  # of the noise, for the flat pieces and the trees
    bandwidths: Sequence[float] = (0.4, 0.2, 0.1)  # of the mean shift, see `count_modes`
    window: int = 20  # scans in the middle of the log that form the cloud; a map's window has as many
    window_components: Sequence[int] = (25, 50, 100, 200, 400, 800)  # of each window; empty: no maps
    resolution: float = 0.1
    test_every: int = 10
    max_beams: int = 50_000
    n_samples: int = 1_000_000  # Monte Carlo rays of a query

    def __post_init__(self) -> None:
        check_not_empty(self, "n_components")
        _check_sizes(self.n_components)


@dataclass(frozen=True)
class SensorModelStudy:
    """Of `studies.sensor_noise`. The test is as in `Protocol`."""

    sensor: SensorModel | None = None  # None: a lidar with noise of 1 cm
    n_components: Sequence[int] = option((50, 200), "sizes K")
    n_points: int = 20_000  # drawn at random from all training scans
    resolution: float = 0.1
    test_every: int = 10
    max_beams: int = 20_000
    max_iter: int = 50
    tol: float = 1e-4
    n_neighbors: int = 16  # whose normal gives the incidence angle; 0: every surface faces the sensor
    max_origins: int = 8  # sensor origins kept for a component
    n_samples: int = 1_000_000  # Monte Carlo rays of a query

    def __post_init__(self) -> None:
        check_not_empty(self, "n_components")
        _check_sizes(self.n_components)
