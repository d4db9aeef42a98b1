"""Options of the held-out test and of fits.

Importing this file does not load torch, so that commands can show their options quickly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from gmmtorch.declarations import option
from gmmtorch.errors import InvalidArgumentError, check_choice, check_resolution, check_whole

FreePoints = Literal["uniform", "near_surface", "clear"]
Removal = Literal["beams", "scans"]


def check_not_empty(options: object, *names: str) -> None:
    """Raises if one of the options with these names has no value."""
    for name in names:
        values = getattr(options, name)
        if not values:
            raise InvalidArgumentError(f"{name}={list(values)} is empty; give at least one value.")


@dataclass(frozen=True)
class Protocol:
    """The test on held-out scans; see docs/commands.md."""

    test_every: int = option(10, "scans 0, n, 2n, … are held out")
    kept: Sequence[float] = option(
        (1.0,), "shares of the training data that are used; a smaller share is a subset of a larger one"
    )
    removal: Removal = option("beams", "what is removed to keep a share: beams or scans")
    resolution: Sequence[float] = option((0.1,), "sides (m) of the cells for which occupancy is asked")
    free: FreePoints = option(
        "uniform",
        "where the free points of a beam lie. uniform: anywhere; near_surface: 0.5 to 2 cells before the "
        "hit; clear: anywhere, but not within one cell of the hit",
    )
    unknown: bool = option(False, "also ask about points 2–12 cells behind hits, which no beam observed")
    pose_noise: Sequence[float] = option(
        (0.0, 0.0), "standard deviations (m, rad) that perturb the training poses"
    )
    max_beams: int = option(1_000_000, "held-out beams, at most; a random subset is drawn from more")
    save_queries: str | None = option(None, "FILE.npz for the test points; null: none")
    save_map: str | None = option(None, "DIR for every map, as METHOD_KEPT_RESOLUTION; null: none")

    def __post_init__(self) -> None:
        check_not_empty(self, "kept", "resolution")
        for value in self.resolution:
            check_resolution(value)
        for share in self.kept:
            if not 0 < share <= 1:
                raise InvalidArgumentError(f"kept={share} must be a share in (0, 1].")
        check_choice("removal", self.removal, get_args(Removal))
        if self.test_every < 2:
            raise InvalidArgumentError(
                f"test_every={self.test_every} must be at least 2: with 1 no scan is left to learn from."
            )
        if len(self.pose_noise) != 2 or not all(math.isfinite(x) and x >= 0 for x in self.pose_noise):
            raise InvalidArgumentError(
                f"pose_noise={list(self.pose_noise)} must be two numbers ≥ 0: metres and radians."
            )
        check_choice("free", self.free, get_args(FreePoints))
        check_whole("max_beams", self.max_beams, 1)


@dataclass(frozen=True)
class FitOptions:
    """Options of every estimator, by scikit-learn's names; see `GaussianMixture`.

    An estimator takes the options that its constructor has.

    Attributes:
        max_cells: sum the points into at most this many cells; None: learn from the points.
        reg_covar: added to the variances (m²).
        n_init: initializations, of which the best is kept.
        dtype: type of the exponentials in EM, "float32" or "float64".
        compiled: without effect, because the kernels are compiled anyway.
    """

    n_components: int | None = option(100, "number of components; null (em): chosen from the surfaces")
    noise: float = option(
        0.01, "standard deviation (m) of the range sensor, which defines flat pieces for n_components=null"
    )
    init_params: str = option(
        "auto",
        "kmeans; kmeans_restarts: the best of ten runs; random_points; bounding_box; flat_pieces: recursive "
        "bisection of the cloud; auto: k-means if it is cheap, else flat pieces",
    )
    algorithm: str = option(
        "auto",
        "exact: every point with every component; truncated: every point with the components near it; auto: "
        "truncated where it is faster",
    )
    max_cells: int | None = None
    tol: float = option(1e-3, "EM ends when the mean log-likelihood grows by less (nats per point)")
    reg_covar: float = 1e-6
    max_iter: int = option(100, "EM iterations, at most")
    n_init: int = 1
    dtype: str = "float32"
    compiled: bool = False

    def check(self, n_points: int, seed: int) -> None:
        """Raises `InvalidArgumentError` for an invalid option, or one that does not fit `n_points`."""
        from gmmtorch.mixture import GaussianMixture

        GaussianMixture(**vars(self), random_state=seed).check_parameters(n_points)
