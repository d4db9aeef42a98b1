"""GaussianMixture: expectation–maximisation with scikit-learn's interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.linalg import inverse_factor, safe_cholesky
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import stepwise
from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.exact import EMResult, Parameters
from gmmtorch.mixture.em.grouping import Rows, nearest
from gmmtorch.mixture.em.initialization import INITIALIZATIONS, copied, flat_pieces, start
from gmmtorch.mixture.em.surface_rule import surface_pieces
from gmmtorch.mixture.em.truncated import Settings, learn_truncated
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.validation import (
    Array,
    RandomState,
    as_generator,
    check_choice,
    check_enough,
    check_number,
    checked_parameter,
)

_KMEANS_IS_CHEAP = 2_000_000  # pairs of point and component: about a second
_MANY_COMPONENTS, _MANY_PAIRS = 48, 4_000_000  # from which on truncated EM is faster


class GaussianMixture(MixtureEstimator):
    """Weighted full-covariance EM (thesis 2.1.1) on any device.

    Arrays in, arrays out; tensors in, tensors out. Parameters are kept in float64, and
    clouds are centred while they are worked on, so points 500 km away lose no digits.

    Args:
        n_components: K, at most the number of points. None: as many as the cloud asks for, which is
            cut into flat pieces until each is as thin as the noise explains; EM starts from them
            (see `component_count`). K is then `means_.shape[0]`.
        noise: standard deviation of the sensor, in the points' unit (m), for n_components=None.
        tol: EM stops when the mean log-likelihood changes by less (nats a point).
        reg_covar: added to each variance, in the square of the points' unit (m²).
        max_iter: EM iterations at most, in each start.
        n_init: starts; the one with the best lower bound is kept.
        init_params: "kmeans" (scikit-learn's), "kmeans_restarts", "random_points", "bounding_box" or
            "flat_pieces"; "auto": k-means for small problems, flat pieces for large ones, where they
            are as good and take a thousandth of the time. Without n_components, EM starts from the
            pieces that were counted.
        weights_init, means_init, precisions_init: (K,), (K, D), (K, D, D): given parameters, in
            place of those the initialization finds.
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a fresh one.
        algorithm: "exact": every point meets every component. "truncated": only those near it, with a
            momentum (see `truncated`): the way to many components; `lower_bound_` is then a few
            thousandths of a nat below the mean log-likelihood. "auto": truncated from 48 components
            and 4·10⁶ pairs of point and component on.
        max_cells: EM runs on the moments of at most so many cells of points, not on the points: much
            faster for many points to a component, and a little less likely (see `cells`; 2D and 3D).
        dtype: of the exponentials inside exact EM, whose products always run in float64, and of the
            whole E-step of truncated EM; with "float64" nothing at all runs in float32.
        compiled: truncated EM's E-step by torch.compile: the same to rounding; it pays from some 10⁵ points
            and 10³ components on (a tenth of the time), after about five seconds for its first use in a
            process. Needs a C++ compiler. Exact EM gains nothing by it.
        warm_start: go on from the last fit's parameters.

    Fitted attributes, in the kind (array or tensor) of the points given to `fit`: `weights_` (K,),
    `means_` (K, D), `covariances_` (K, D, D), `precisions_` (K, D, D); and `lower_bound_`,
    `lower_bounds_`, `n_iter_`, `converged_`, `n_features_in_`; `n_samples_seen_`, how many points
    the mixture stands for, None if not known. The buffers `weights`, `means` and `covariances` are
    tensors always, and move with `.to(device)`.
    """

    n_samples_seen_: float | None

    def __init__(
        self,
        n_components: int | None = 1,
        *,
        noise: float = 0.01,
        tol: float = 1e-3,
        reg_covar: float = 1e-6,
        max_iter: int = 100,
        n_init: int = 1,
        init_params: str = "auto",
        algorithm: str = "auto",
        max_cells: int | None = None,
        weights_init: Array | None = None,
        means_init: Array | None = None,
        precisions_init: Array | None = None,
        random_state: RandomState = None,
        dtype: str = "float32",
        compiled: bool = False,
        warm_start: bool = False,
    ) -> None:
        nn.Module.__init__(self)
        self.n_components = n_components
        self.noise = noise
        self.tol = tol
        self.reg_covar = reg_covar
        self.max_iter = max_iter
        self.n_init = n_init
        self.init_params = init_params
        self.algorithm = algorithm
        self.max_cells = max_cells
        self.weights_init = weights_init
        self.means_init = means_init
        self.precisions_init = precisions_init
        self.random_state = random_state
        self.dtype = dtype
        self.compiled = compiled
        self.warm_start = warm_start

    # -- learning ---------------------------------------------------------------------------------

    def fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
    ) -> GaussianMixture:
        """Learn the mixture of points X (N, D).

        Args:
            X: points, finite.
            y: ignored, as in scikit-learn.
            sample_weight: (N,) how many points each row stands for: not negative, not all zero.
            on_iteration: called with the iteration (from 1) and the mean log-likelihood.

        Raises:
            InvalidArgumentError (a ValueError): a bad argument, weight or point; K above the
                number of points of non-zero weight.
            NumericalError: a component collapsed, as happens with reg_covar = 0.
        """
        points, weight, center = self._prepare(X, sample_weight)
        rows = self._rows(points, weight)
        generator = as_generator(self.random_state)
        best: EMResult | None = None
        for _ in range(1 if self._continues() else self.n_init):
            found = self._run(rows, center, generator, on_iteration)
            if best is None or found.lower_bounds[-1] > best.lower_bounds[-1]:
                best = found
        assert best is not None
        seen = {"n_samples_seen": weight.sum()}
        self._keep(best.parameters, center, best.lower_bounds, best.converged, seen)
        self._warn_unless_converged("EM")
        return self

    def partial_fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        *,
        kappa: float = 0.6,
        memory: float | None = None,
    ) -> GaussianMixture:
        """Learn from one more batch of points X (N, D) by a step of stepwise EM (see `stepwise`).

        The first batch is taken whole: one EM step from where `fit` would begin. Later ones may be of
        any size; a fitted or loaded mixture goes on from its parameters. A batch of weight n after
        points of weight m, `n_samples_seen_`, counts for (n/(m+n))^kappa, what was learned for the rest.
        Steps are exact: `algorithm` and `max_cells` are for `fit`.

        Args:
            X, y, sample_weight: as in `fit`.
            kappa: above 0.5, at most 1. With 1 all points count the same; less forgets early batches,
                whose responsibilities were poor: better for small batches, and for many passes.
            memory: what was learned counts for so many points at most (m), so that a scene that
                changes is followed. Needed where m is not known: a mixture of given parameters.

        Raises:
            InvalidArgumentError (a ValueError): as in `fit`; another dimension or n_components than
                the mixture's; a kappa or memory that cannot be. NumericalError: as in `fit`.
        """
        stepwise.check_kappa(kappa)
        started = hasattr(self, "means")
        past = stepwise.weight_of_past(getattr(self, "n_samples_seen_", None) if started else 0.0, memory)
        points, weight, center = self._prepare(X, sample_weight, reset=not started)
        if started:
            previous = self._where_left(points, center)
        else:
            previous = self._start(points, weight, center, as_generator(self.random_state))
        features, dtype = em.quadratic_features(points), em.SOFTMAX_DTYPES[self.dtype]
        step = em.natural_step(features, weight, float(self.reg_covar), dtype, points)
        update, bound = step(previous)
        eta = stepwise.step_size(float(weight.sum()), past, kappa)
        blended = stepwise.blend(previous, update, eta)
        self._keep(blended, center, [bound], False, {"n_samples_seen": past + weight.sum()})
        return self

    # How many points the mixture stands for goes with files and motions, but not with the state,
    # which is the parameters alone.

    def _extra_tensors(self) -> dict[str, Tensor]:
        seen = getattr(self, "n_samples_seen_", None)
        found = {} if seen is None else {"n_samples_seen": torch.tensor(seen, dtype=torch.float64)}
        return super()._extra_tensors() | found

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        seen = tensors.get("n_samples_seen")
        if seen is not None and not (seen.numel() == 1 and float(seen) >= 0):
            raise InvalidArgumentError(f"n_samples_seen={seen.tolist()} must be one number of at least 0.")
        super()._set_extra(tensors)
        self.n_samples_seen_ = None if seen is None else float(seen)

    def _rows(self, points: Tensor, weight: Tensor) -> Rows:
        """What EM runs on: the points, or the cells they are summed into."""
        if self.max_cells is None:
            return Rows(points, weight)
        if points.shape[1] > 3:
            raise InvalidArgumentError(
                f"max_cells={self.max_cells} is for points in at most three dimensions, not "
                f"{points.shape[1]}; leave it None."
            )
        # Cells as fine as the least deviation of a component: finer ones would change nothing.
        cells = pool_into_cells(points, self.max_cells, max(float(self.reg_covar), 1e-12) ** 0.5, weight)
        return Rows(cells.features, cells.weight, are_points=False)

    def _run(
        self,
        rows: Rows,
        center: Tensor,
        generator: torch.Generator,
        on_iteration: Callable[[int, float], None] | None,
    ) -> EMResult:
        """EM from one start."""
        reg, dtype = float(self.reg_covar), em.SOFTMAX_DTYPES[self.dtype]
        first, owner = self._begin(rows, center, generator)
        if not self._truncates(rows.weight.shape[0], first.weights.shape[0]):
            step = em.natural_step(
                rows.features(), rows.weight, reg, dtype, rows.points if rows.are_points else None
            )
            return em.run_em(step, first, tol=self.tol, max_iter=self.max_iter, on_iteration=on_iteration)
        if owner is None:
            owner = nearest(rows.points, first.means)
        settings = Settings(
            reg, self.tol, self.max_iter, dtype, on_iteration=on_iteration, compiled=bool(self.compiled)
        )
        return learn_truncated(rows, owner, first, settings)

    def _begin(
        self, rows: Rows, center: Tensor, generator: torch.Generator
    ) -> tuple[Parameters, Tensor | None]:
        """Where EM begins, in the centred frame; and a likely component of each row (N,), if known."""
        n, k, reg = rows.weight.shape[0], self.n_components, float(self.reg_covar)
        if self._is_free_to_start():
            features = None if rows.are_points else rows.values
            if k is None:
                return surface_pieces(rows.points, rows.weight, float(self.noise), reg, features)
            if self._truncates(n, k) and self._initialization(n, k) == "flat_pieces":
                found, owner = flat_pieces(rows.points, rows.weight, k, reg, features)
                return copied(found, k)[0], owner
        return self._start(rows.points, rows.weight, center, generator), None

    def _initialization(self, n_rows: int, n_components: int) -> str:
        """`init_params`, decided on."""
        if self.init_params != "auto":
            return self.init_params
        return "kmeans" if n_rows * n_components <= _KMEANS_IS_CHEAP else "flat_pieces"

    def _truncates(self, n_rows: int, n_components: int) -> bool:
        """`algorithm`, decided on."""
        if self.algorithm != "auto":
            return self.algorithm == "truncated"
        return n_components >= _MANY_COMPONENTS and n_rows * n_components >= _MANY_PAIRS

    def _is_free_to_start(self) -> bool:
        given = (self.weights_init, self.means_init, self.precisions_init)
        return not self._continues() and all(value is None for value in given)

    def _continues(self) -> bool:
        return bool(self.warm_start) and hasattr(self, "means")

    def _start(
        self, points: Tensor, weight: Tensor, center: Tensor, generator: torch.Generator
    ) -> Parameters:
        """Where EM begins, in the centred frame."""
        if self._continues():
            return self._where_left(points, center)
        if self.n_components is None:
            return surface_pieces(points, weight, float(self.noise), float(self.reg_covar))[0]
        given = (self.weights_init, self.means_init, self.precisions_init)
        k, dim = self.n_components, points.shape[1]
        shapes = ((k,), (k, dim), (k, dim, dim))
        names = ("weights_init", "means_init", "precisions_init")
        first_weights, first_means, precisions = (
            None if value is None else checked_parameter(value, shape, name, points.device)
            for value, shape, name in zip(given, shapes, names, strict=True)
        )
        if first_weights is None or first_means is None or precisions is None:
            method = self._initialization(points.shape[0], k)
            found = start(method, points, weight, k, float(self.reg_covar), generator)
        else:
            found = Parameters(first_weights, first_means, precisions)
        covariances = found.covariances
        if precisions is not None:
            whiten = inverse_factor(safe_cholesky(precisions, "precisions_init"))
            covariances = whiten @ whiten.transpose(-2, -1)
        return Parameters(
            found.weights if first_weights is None else first_weights / first_weights.sum(),
            found.means if first_means is None else first_means - center,
            covariances,
        )

    def _where_left(self, points: Tensor, center: Tensor) -> Parameters:
        """The parameters there are, in the centred frame."""
        k = self.means.shape[0] if self.n_components is None else self.n_components
        if self.means.shape != (k, points.shape[1]):
            raise InvalidArgumentError(
                f"warm_start=True and partial_fit go on from means of shape {tuple(self.means.shape)}, but "
                f"n_components={self.n_components} and the points have {points.shape[1]} dimensions; "
                "set n_components back, or fit anew with warm_start=False."
            )
        means = self.means.to(points.device) - center
        return Parameters(self.weights.to(points.device), means, self.covariances.to(points.device))

    # -- arguments --------------------------------------------------------------------------------

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for a parameter that cannot be, or K above the number of points."""
        for name in ("n_components", "max_iter", "n_init"):
            value = getattr(self, name)
            if name == "n_components" and value is None:
                self._check_found()
            else:
                check_whole(name, value, 1)
        check_number("noise", self.noise, above=True)
        for name in ("tol", "reg_covar"):
            check_number(name, getattr(self, name))
        choices = {
            "init_params": ("auto", *INITIALIZATIONS),
            "algorithm": ("auto", "exact", "truncated"),
            "dtype": tuple(em.SOFTMAX_DTYPES),
        }
        for name, known in choices.items():
            check_choice(name, getattr(self, name), known)
        if self.max_cells is not None:
            check_whole("max_cells", self.max_cells, 1)
        as_generator(self.random_state)
        if self.n_components is not None:
            check_enough(self.n_components, n_points)

    def _check_found(self) -> None:
        """Raise `InvalidArgumentError` for a start that is given where it is to be found."""
        for name in ("weights_init", "means_init", "precisions_init"):
            if getattr(self, name) is not None:
                raise InvalidArgumentError(
                    f"{name} is given, but n_components=None looks for components of its own; "
                    "set n_components to their number."
                )
