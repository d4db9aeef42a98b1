"""GaussianMixture: expectation–maximisation with scikit-learn's interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.linalg import inverse_factor, safe_cholesky
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import stepwise
from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.exact import EMResult, Parameters
from gmmtorch.mixture.em.grouping import Rows, nearest
from gmmtorch.mixture.em.initialization import (
    INITIALIZATIONS,
    flat_pieces,
    initialize,
    replicated,
    surface_pieces,
)
from gmmtorch.mixture.em.truncated import Settings, fit_truncated
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.validation import Array, RandomState, as_generator, checked_parameter

_KMEANS_IS_CHEAP = 2_000_000  # pairs of point and component: k-means takes about a second
_MANY_COMPONENTS, _MANY_PAIRS = 48, 4_000_000  # truncated EM is faster from here on


class GaussianMixture(MixtureEstimator):
    """Weighted EM with full covariances (thesis 2.1.1), on any device.

    Arrays give arrays and tensors give tensors.

    Args:
        n_components: K, at most the number of points. None: determined from the cloud, which is
            partitioned into flat pieces until each is as thin as the noise explains (see `partition`).
            EM starts from these pieces, and K is `means_.shape[0]`.
        noise: standard deviation of the sensor, in the unit of the points (m), for n_components=None.
        tol: EM stops when the mean log-likelihood changes by less (nats a point).
        reg_covar: added to each variance, in the squared unit of the points (m²).
        max_iter: largest number of EM iterations of each start.
        n_init: number of starts; the one with the best lower bound is kept.
        init_params: "kmeans" (scikit-learn's), "kmeans_restarts", "random_points", "bounding_box" or
            "flat_pieces". "auto": k-means for small problems; flat pieces for large ones, where they are
            as good and take a thousandth of the time. Unused for n_components=None.
        weights_init, means_init, precisions_init: (K,), (K, D), (K, D, D): initial parameters that
            replace those of the initialization.
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a random seed.
        algorithm: "exact" compares every point with every component. "truncated" compares it with nearby
            components only, with a momentum (see `truncated`): the method for many components, whose
            `lower_bound_` is a few thousandths of a nat below the mean log-likelihood. "auto": truncated
            from 48 components and 4·10⁶ pairs of point and component on.
        max_cells: if given, EM runs on the moments of at most this number of cells of points (see
            `cells`; 2D and 3D): much faster for many points a component, at a slightly lower likelihood.
        dtype: of the exponentials in exact EM, whose products are always float64, and of the whole E-step
            in truncated EM. With "float64" all computation is in float64.
        compiled: run the E-step of truncated EM through torch.compile. The result is the same to rounding.
            Worthwhile from about 10⁵ points and 10³ components on (a tenth of the time), after about five
            seconds for the first use in a process. Needs a C++ compiler. No effect on exact EM.
        warm_start: `fit` continues from the parameters of the last fit.

    Fitted attributes: those of every `MixtureEstimator`, and `n_samples_seen_`, the number of points
    that the mixture stands for, or None if unknown.
    """

    _init_choices = ("auto", *INITIALIZATIONS)
    _optional_n_components = True
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
        """Fit the mixture to points X (N, D) by EM. Arguments and errors: see `MixtureEstimator.fit`."""
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
        self._store_fit(best.parameters, center, best.lower_bounds, best.converged, seen)
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
        """Update the mixture with a batch of points X (N, D), by a step of stepwise EM (see `stepwise`).

        The first batch gets one EM step from the starting point of `fit`. Later batches may have any size. A
        fitted or loaded mixture continues from its parameters. A batch of weight n after points of weight m
        (`n_samples_seen_`) has the share (n/(m+n))^kappa in the result. Steps are exact: `algorithm` and
        `max_cells` apply to `fit` only.

        Args:
            X, y, sample_weight: as in `fit`.
            kappa: above 0.5, at most 1. With 1 all points count equally. Smaller values forget early batches,
                whose responsibilities were poor, and suit small batches and many passes.
            memory: upper limit of m, so that the mixture follows a changing scene. Required if m is unknown:
                for a mixture of given parameters.

        Raises:
            InvalidArgumentError: as in `fit`; another dimension or n_components than the mixture; an
                invalid kappa or memory. NumericalError: as in `fit`.
        """
        stepwise.check_kappa(kappa)
        started = hasattr(self, "means")
        past = stepwise.weight_of_past(getattr(self, "n_samples_seen_", None) if started else 0.0, memory)
        points, weight, center = self._prepare(X, sample_weight, reset=not started)
        if started:
            previous = self._current_parameters(points, center)
        else:
            previous = self._start(points, weight, center, as_generator(self.random_state))
        features, dtype = em.quadratic_features(points), em.SOFTMAX_DTYPES[self.dtype]
        step = em.natural_step(features, weight, float(self.reg_covar), dtype, points)
        update, bound = step(previous)
        eta = stepwise.step_size(float(weight.sum()), past, kappa)
        blended = stepwise.blend(previous, update, eta)
        self._store_fit(blended, center, [bound], False, {"n_samples_seen": past + weight.sum()})
        return self

    # n_samples_seen is part of files and motions, but not of the state dict, which has only parameters.

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
        """Input of EM: the points, or the cells they are summed into."""
        if self.max_cells is None:
            return Rows(points, weight)
        if points.shape[1] > 3:
            raise InvalidArgumentError(
                f"max_cells={self.max_cells} needs points in at most three dimensions, not "
                f"{points.shape[1]}; set it to None."
            )
        # No cells smaller than the least standard deviation of a component: they would change nothing.
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
        first, owner = self._start_and_owner(rows, center, generator)
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
        return fit_truncated(rows, owner, first, settings)

    def _start_and_owner(
        self, rows: Rows, center: Tensor, generator: torch.Generator
    ) -> tuple[Parameters, Tensor | None]:
        """Start of EM in the centred frame, and a likely component of each row (N,), if known."""
        n, k, reg = rows.weight.shape[0], self.n_components, float(self.reg_covar)
        if self._has_free_start():
            features = None if rows.are_points else rows.values
            if k is None:
                return surface_pieces(rows.points, rows.weight, float(self.noise), reg, features)
            if self._truncates(n, k) and self._initialization(n, k) == "flat_pieces":
                found, owner = flat_pieces(rows.points, rows.weight, k, reg, features)
                return replicated(found, k)[0], owner
        return self._start(rows.points, rows.weight, center, generator), None

    def _initialization(self, n_rows: int, n_components: int) -> str:
        """The initialization that `init_params` selects."""
        if self.init_params != "auto":
            return self.init_params
        return "kmeans" if n_rows * n_components <= _KMEANS_IS_CHEAP else "flat_pieces"

    def _truncates(self, n_rows: int, n_components: int) -> bool:
        """Whether `algorithm` selects truncated EM."""
        if self.algorithm != "auto":
            return self.algorithm == "truncated"
        return n_components >= _MANY_COMPONENTS and n_rows * n_components >= _MANY_PAIRS

    def _has_free_start(self) -> bool:
        given = (self.weights_init, self.means_init, self.precisions_init)
        return not self._continues() and all(value is None for value in given)

    def _continues(self) -> bool:
        return bool(self.warm_start) and hasattr(self, "means")

    def _start(
        self, points: Tensor, weight: Tensor, center: Tensor, generator: torch.Generator
    ) -> Parameters:
        """Start of EM in the centred frame."""
        if self._continues():
            return self._current_parameters(points, center)
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
            found = initialize(method, points, weight, k, float(self.reg_covar), generator)
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

    def _current_parameters(self, points: Tensor, center: Tensor) -> Parameters:
        """The current parameters, in the centred frame."""
        k = self.means.shape[0] if self.n_components is None else self.n_components
        if self.means.shape != (k, points.shape[1]):
            raise InvalidArgumentError(
                f"warm_start=True and partial_fit continue from means of shape {tuple(self.means.shape)}, "
                f"but n_components={self.n_components} and the points have {points.shape[1]} dimensions; "
                "restore n_components, or start a new fit with warm_start=False."
            )
        means = self.means.to(points.device) - center
        return Parameters(self.weights.to(points.device), means, self.covariances.to(points.device))

    # -- arguments --------------------------------------------------------------------------------

    def check_parameters(self, n_points: int | None = None) -> None:
        super().check_parameters(n_points)
        check_number("noise", self.noise, above=True)
        check_choice("algorithm", self.algorithm, ("auto", "exact", "truncated"))
        if self.max_cells is not None:
            check_whole("max_cells", self.max_cells, 1)
        if self.n_components is None:
            self._check_no_given_start()

    def _check_no_given_start(self) -> None:
        """Raise `InvalidArgumentError` for initial parameters together with n_components=None."""
        for name in ("weights_init", "means_init", "precisions_init"):
            if getattr(self, name) is not None:
                raise InvalidArgumentError(
                    f"{name} is given, but n_components=None determines the components from the cloud; "
                    "set n_components to their number."
                )
