"""Options of the held-out test and of fits.

Importing this file does not load torch, so that commands can show their options quickly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from gmmtorch.errors import InvalidArgumentError, check_choice, check_resolution, check_whole

Removal = Literal["beams", "scans"]
FreePoints = Literal["uniform", "near_surface", "clear"]


def check_test_every(test_every: int) -> None:
    """Raises unless at least one scan of each `test_every` scans is left for training."""
    if test_every < 2:
        raise InvalidArgumentError(
            f"test_every={test_every} must be at least 2: with 1 every scan is held out and none is left."
        )


def check_not_empty(options: object, *names: str) -> None:
    """Raises if one of the options with these names has no value."""
    for name in names:
        values = getattr(options, name)
        if not values:
            raise InvalidArgumentError(f"{name}={list(values)} is empty; give at least one value.")


@dataclass(frozen=True)
class Protocol:
    """The test on held-out scans; see docs/commands.md.

    Attributes:
        test_every: scans 0, n, 2n, … are held out.
        kept: shares of the training data that are used, each in (0, 1].
        removal: "beams" or "scans": what is removed to keep a share.
        resolution: sides (m) of the cells for which occupancy is queried.
        free: where on a beam the free test points lie; see `queries.hit_and_free`.
        unknown: also query points that no training beam observed.
        pose_noise: standard deviations (m, rad) that perturb the training poses.
        max_beams: number of held-out beams at most; a random subset is drawn from more.
        save_queries: file for the test points; None saves none.
        save_map: folder for the maps; None saves none.
    """

    test_every: int = 10
    kept: Sequence[float] = (1.0,)
    removal: Removal = "beams"
    resolution: Sequence[float] = (0.1,)
    free: FreePoints = "uniform"
    unknown: bool = False
    pose_noise: Sequence[float] = (0.0, 0.0)
    max_beams: int = 1_000_000
    save_queries: str | None = None
    save_map: str | None = None

    def __post_init__(self) -> None:
        check_not_empty(self, "kept", "resolution")
        for value in self.resolution:
            check_resolution(value)
        for share in self.kept:
            if not 0 < share <= 1:
                raise InvalidArgumentError(f"kept={share} must be a share in (0, 1].")
        check_choice("removal", self.removal, get_args(Removal))
        check_test_every(self.test_every)
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
        n_components: number of components; None: as many as the surfaces need.
        noise: standard deviation (m) of the range sensor, for n_components=None.
        init_params: auto, kmeans, kmeans_restarts, random_points, bounding_box or flat_pieces.
        algorithm: auto, exact, or truncated: each point uses only the components near it.
        max_cells: sum the points into at most this many cells; None: learn from the points.
        tol: EM ends when the mean log-likelihood grows by less (nats per point).
        reg_covar: added to the variances (m²).
        max_iter: EM iterations, at most.
        n_init: initializations, of which the best is kept.
        dtype: type of the exponentials in EM, "float32" or "float64".
        compiled: without effect, because the kernels are compiled anyway.
    """

    n_components: int | None = 100
    noise: float = 0.01
    init_params: str = "auto"
    algorithm: str = "auto"
    max_cells: int | None = None
    tol: float = 1e-3
    reg_covar: float = 1e-6
    max_iter: int = 100
    n_init: int = 1
    dtype: str = "float32"
    compiled: bool = False

    def check(self, n_points: int, seed: int) -> None:
        """Raises `InvalidArgumentError` for an invalid option, or one that does not fit `n_points`."""
        from gmmtorch.mixture import GaussianMixture

        GaussianMixture(**vars(self), random_state=seed).check_parameters(n_points)
