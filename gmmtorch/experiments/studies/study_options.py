"""Options of each study.

Importing this file loads no torch, so that commands can show their options at once. The check functions that
need torch are imported when an object is made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gmmtorch.declarations import option
from gmmtorch.errors import (
    InvalidArgumentError,
    check_choice,
    check_number,
    check_prior,
    check_resolution,
    check_whole,
)
from gmmtorch.experiments.evaluation import check_not_empty, check_test_every
from gmmtorch.mapping import METHODS, QueryOptions, check_method


def _check_whole_numbers(options: object, *names: str) -> None:
    for name in names:
        check_whole(name, getattr(options, name), 1)


# -- studies of gmmtorch-occupancy -----------------------------------------------------------------


@dataclass(frozen=True)
class ApproximationErrorStudy:
    """Options of `studies.approximation_error`.

    Attributes:
        dims: dimensions, 2 and 3.
        support: rays of a component, for which the occupancy (3.9) is computed.
        prior: prior count, for which the occupancy (3.9) is computed.
        n_pixels: of the error maps along each axis.
        n_components: number of components of the sweep.
        n_cells: number of cells for each component of the sweep.
        n_samples: Monte Carlo rays of one component, in map and sweep.
        n_large_samples: rays of the large Monte Carlo in the sweep.
        n_scans: number of scans of the map that the curve is measured on.
        resolution: side (m) of the cells of the map that the curve is measured on.
        n_rays: numbers of Monte Carlo rays along the curve.
        tolerance: tolerances of flux along the curve.
    """

    dims: Sequence[int] = (2, 3)
    support: float = 100.0
    prior: float = 1.0
    n_pixels: int = 24
    n_components: int = 64
    n_cells: int = 8
    n_samples: int = 1024
    n_large_samples: int = 1 << 17
    n_scans: int = 1
    resolution: float = 0.25
    n_rays: Sequence[int] = (1 << 10, 1 << 12, 1 << 14, 1 << 16, 1 << 18)
    tolerance: Sequence[float] = (0.1, 1e-2, 1e-3, 1e-4)

    def __post_init__(self) -> None:
        from gmmtorch.occupancy import check_tolerance

        _check_whole_numbers(
            self, "n_pixels", "n_components", "n_cells", "n_samples", "n_large_samples", "n_scans"
        )
        check_not_empty(self, "dims", "n_rays", "tolerance")
        for dim in self.dims:
            if dim not in (2, 3):
                raise InvalidArgumentError(f"dims={dim} must be 2 or 3.")
        for n in self.n_rays:
            check_whole("n_rays", n, 1)
        for tolerance in self.tolerance:
            check_tolerance(tolerance)
        check_number("support", self.support, above=True)
        check_prior(self.prior)
        check_resolution(self.resolution)


@dataclass(frozen=True)
class AucMemoryStudy:
    """Options of `studies.map_studies`.

    Attributes:
        forms: forms of evidence that are computed from our map.
        bgk_points: sizes of the BGK map, in stored points.
        others: methods that have one size.
    """

    forms: Sequence[str] = ("monte_carlo", "point")
    n_components: Sequence[int] = option((100, 250, 500, 1000), "sizes of our map")
    bgk_points: Sequence[int] = (1555, 3095, 5010, 9472, 17011)
    others: Sequence[str] = ("occupancy_grid", "bgk", "ndt", "octomap")

    def __post_init__(self) -> None:
        for form in self.forms:
            check_method(form)
        if not (self.forms and self.n_components) and not self.bgk_points and not self.others:
            raise InvalidArgumentError(
                f"forms={list(self.forms)}, n_components={list(self.n_components)}, bgk_points=[] and "
                "others=[] select no map; give at least one."
            )


@dataclass(frozen=True)
class MapVariantsStudy:
    """Options of `studies.map_studies`. The first variant is compared with the others."""

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
    """Options of `studies.map_studies`. methods: forms of evidence."""

    methods: Sequence[str] = ("point",)

    def __post_init__(self) -> None:
        if not self.methods:
            raise InvalidArgumentError(f"methods=[] is empty; name at least one of {', '.join(METHODS)}.")
        for method in self.methods:
            check_method(method)


COUNTS = "counts"
"""Method of the study of thresholds: the training rays, counted in cells; no map."""


@dataclass(frozen=True)
class VarianceThresholdStudy:
    """Options of `studies.variance_threshold`: one row for each combination of the lists.

    Attributes:
        railing_scans: number of scans of the railing.
        method: forms of evidence, and "counts": the training rays counted in cells, without a map.
        resolution: sides (m) of the cells.
        prior: of the queries, as in `QueryOptions`: N_p of counts; None: calibrated.
        variance_threshold: values v of (3.10).
        test_every, max_beams: the test, as in `Protocol`.
        thin_width: width (m) of thin structures in a data set, see `variance_threshold.seen_past`.
    """

    railing: float | None = option(
        0.04, "width (m) of the bars of a simulated railing, in place of the data set; null: the data set"
    )
    railing_scans: int = 20
    method: Sequence[str] = (COUNTS, "point", "monte_carlo")
    n_components: Sequence[int] = option((200, 850), "sizes; a map is built for each")
    resolution: Sequence[float] = (0.1, 0.25)
    prior: Sequence[Any] = (1.0, 0.1, None)
    variance_threshold: Sequence[float] = (0.06, 0.24)
    test_every: int = 5
    max_beams: int = 10_000
    thin_width: float = 0.3

    def __post_init__(self) -> None:
        import torch

        from gmmtorch.occupancy import classify

        check_not_empty(self, "method", "n_components", "resolution", "prior")
        check_not_empty(self, "variance_threshold")
        for method in self.method:
            if method != COUNTS:
                check_method(method)
        for n in self.n_components:
            check_whole("n_components", n, 1)
        for prior in self.prior:
            QueryOptions(prior=prior)
        for threshold in self.variance_threshold:
            classify(torch.zeros(1), threshold)
        for resolution in self.resolution:
            check_resolution(resolution)
        check_whole("max_beams", self.max_beams, 1)
        check_test_every(self.test_every)
        check_number("thin_width", self.thin_width, above=True)
        check_whole("railing_scans", self.railing_scans, 2)
        if self.railing is not None:
            check_number("railing", self.railing, above=True)


# -- studies of gmmtorch-fit -----------------------------------------------------------------------


@dataclass(frozen=True)
class InitializationStudy:
    """Options of `studies.fit_studies`. The first seed is the seed of the run.

    init_params: initializations; each is run with each number of components and each seed.
    """

    n_components: Sequence[int] = option((4, 8, 32, 64, 128, 256, 512), "numbers of components")
    init_params: Sequence[str] = ("random_points", "bounding_box", "kmeans", "kmeans_restarts", "flat_pieces")
    initial_covariance: Sequence[str] = option(
        ("tiles",),
        "covariances of random_points and bounding_box. tiles: the mean variance of the cloud, divided by "
        "K^(2/D); box: the square of the bounding box's longest side (thesis 2.1.3)",
    )
    n_seeds: int = option(3, "number of runs, with the seeds seed, seed + 1, …")

    def __post_init__(self) -> None:
        from gmmtorch.mixture import INITIALIZATIONS

        check_whole("n_seeds", self.n_seeds, 1)
        check_not_empty(self, "n_components", "init_params", "initial_covariance")
        for name in self.init_params:
            check_choice("init_params", name, INITIALIZATIONS)
        for name in self.initial_covariance:
            check_choice("initial_covariance", name, ("tiles", "box"))


@dataclass(frozen=True)
class ComponentCountStudy:
    """Options of `studies.fit_studies`.

    Attributes:
        n_components: numbers K of the curve; numbers above the number of training points are left out.
        noise: standard deviation of the range sensor (m).
        multiples: multiples of the noise that are given to the flat pieces and to the trees.
        bandwidths: of the mean shift, as shares of the cloud's root mean square distance from its mean.
        window: number of scans in the middle of the log that form the cloud; a map's window has as many.
        window_components: components of each window of a map; empty: no maps are built.
        resolution: side (m) of the cells of the test of the maps.
        test_every, max_beams: the test of the maps, as in `Protocol`.
        n_samples: Monte Carlo rays of a query.
    """

    n_components: Sequence[int] = option((16, 32, 64, 128, 256, 512, 1024), "numbers K of the curve")
    noise: float = 0.01
    multiples: Sequence[float] = (0.5, 1.0, 2.0, 4.0)
    bandwidths: Sequence[float] = (0.4, 0.2, 0.1)
    window: int = 20
    window_components: Sequence[int] = (25, 50, 100, 200, 400, 800)
    resolution: float = 0.1
    test_every: int = 10
    max_beams: int = 50_000
    n_samples: int = 1_000_000

    def __post_init__(self) -> None:
        check_not_empty(self, "n_components")
        for name in ("n_components", "window_components"):
            for k in getattr(self, name):
                check_whole(name, k, 1)
        _check_whole_numbers(self, "window", "max_beams", "n_samples")
        for name in ("multiples", "bandwidths"):
            for value in getattr(self, name):
                check_number(name, value, above=True)
        check_number("noise", self.noise, above=True)
        check_test_every(self.test_every)
        check_resolution(self.resolution)


@dataclass(frozen=True)
class SensorModelStudy:
    """Options of `studies.sensor_noise`.

    Attributes:
        sensor: name of a sensor model in `sensor_noise.SENSORS`.
        n_points: training points, drawn at random from all training scans.
        resolution: side (m) of the cells of the test.
        test_every, max_beams: the test, as in `Protocol`.
        max_iter, tol: of EM.
        n_neighbors: points from which a point's normal is estimated, for the incidence angle; 0 assumes that
            every surface faces the sensor.
        max_origins: sensor origins kept for a component.
        n_samples: Monte Carlo rays of a query.
    """

    sensor: str = "lidar"
    sensor_options: dict[str, Any] = option({}, "changed options of the sensor model")
    n_components: Sequence[int] = option((50, 200), "sizes K")
    n_points: int = 20_000
    resolution: float = 0.1
    test_every: int = 10
    max_beams: int = 20_000
    max_iter: int = 50
    tol: float = 1e-4
    n_neighbors: int = 16
    max_origins: int = 8
    n_samples: int = 1_000_000

    def __post_init__(self) -> None:
        check_not_empty(self, "n_components")
        for k in self.n_components:
            check_whole("n_components", k, 1)
        _check_whole_numbers(self, "n_points", "max_beams", "max_iter", "max_origins", "n_samples")
        check_whole("n_neighbors", self.n_neighbors, 0)
        check_test_every(self.test_every)
        check_resolution(self.resolution)
