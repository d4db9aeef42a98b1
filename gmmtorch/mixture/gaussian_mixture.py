"""GaussianMixture: expectation–maximisation with scikit-learn's interface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from numbers import Integral
from typing import Any, ClassVar, cast

import torch
from sklearn.utils._param_validation import Interval, StrOptions
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_number
from gmmtorch.kernels import fused_em, is_small
from gmmtorch.mixture.em import by_type, loop
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.distributed import SINGLE_PROCESS, Processes
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, Parameters
from gmmtorch.mixture.em.initialization import (
    INITIALIZATIONS,
    flat_pieces,
    initializations,
    replicated,
    surface_pieces,
)
from gmmtorch.mixture.em.loop import EMResult, OnIteration
from gmmtorch.mixture.em.partition import pool_into_cells
from gmmtorch.mixture.em.truncated import Rows, Settings, fit_truncated, nearest
from gmmtorch.mixture.estimator import ABOVE_ZERO, COUNT, Cloud, MixtureEstimator
from gmmtorch.mixture.validation import (
    Array,
    RandomState,
    as_generator,
    checked_mixing_weights,
    checked_parameter,
    checked_precisions,
)

_KMEANS_IS_CHEAP = 2_000_000  # pairs of point and component: k-means takes about a second
_MANY_COMPONENTS, _MANY_PAIRS = 48, 4_000_000  # truncated EM is faster from here on
_FEW_DIMENSIONS = 8  # up to which clouds have flat pieces, and truncated EM is faster


@dataclass(eq=False, repr=False)
class GaussianMixture(MixtureEstimator):
    """Weighted EM (thesis 2.1.1), on any device, with the interface of scikit-learn's class.

    Arrays give arrays and tensors give tensors. With `dtype="float64"`, `algorithm="exact"`,
    `max_cells=None` and equal initial responsibilities (or `weights_init`, `means_init` and
    `precisions_init`), the result equals scikit-learn's to 1e-6. Equal seeds do not give equal starts.

    Args:
        n_components: K, at most the number of points. None: determined from the cloud, which is
            partitioned into flat pieces until each is as thin as the noise explains (see `partition`).
            EM starts from these pieces, and K is `means_.shape[0]`.
        covariance_type: "full", "tied" (one covariance for all components), "diag" (diagonal) or
            "spherical" (one variance for each component). All but "full" use exact EM.
        noise: standard deviation of the sensor, in the unit of the points (m), for n_components=None.
        tol: EM stops when the mean log-likelihood changes by less (nats per point).
        reg_covar: added to each variance, in the squared unit of the points (m²).
        max_iter: largest number of EM iterations of each start. 0: the mixture is the start of EM.
        n_init: number of starts; the one with the best lower bound is kept.
        init_params: "kmeans", "k-means++", "random" (random responsibilities) and "random_from_data" are
            those of scikit-learn; further "kmeans_restarts", "random_points", "bounding_box" and
            "flat_pieces". "auto": k-means for small problems and above eight dimensions; flat pieces for
            large ones, where they are as good and take a thousandth of the time. Unused for
            n_components=None.
        weights_init, means_init, precisions_init: (K,), (K, D) and, in the shape of the covariance type,
            precisions: initial parameters that replace those of the initialization.
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a random seed.
        algorithm: "exact" compares every point with every component. "truncated" compares it with nearby
            components only, with a momentum (see `truncated`): the method for many components, whose
            `lower_bound_` is a few thousandths of a nat below the mean log-likelihood. "auto": truncated
            from 48 components and 4·10⁶ pairs of point and component on, in up to eight dimensions.
        max_cells: if given, EM runs on the moments of at most this number of cells of points (see
            `cells`; 2D and 3D): much faster for many points per component, at a slightly lower likelihood.
        dtype: of the exponentials in exact EM, and of the whole E-step in truncated EM, whose fused kernel
            (up to three dimensions) computes in float64 always. With "float32" the
            fused kernel of exact EM on a GPU computes log-densities in float32 where their error is below
            10⁻³ nats. With "float64" all computation is in float64.
        compiled: accepted for older scripts; without effect, because the kernels are compiled anyway.
        warm_start: `fit` continues from the parameters and the lower bound of the last fit.
        verbose, verbose_interval: 1 prints every `verbose_interval`-th iteration, 2 adds time and change.

    Fitted attributes: those of every `MixtureEstimator`, and `n_samples_seen_`, the number of points
    that the mixture stands for, or None if unknown.
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **MixtureEstimator._parameter_constraints,
        "n_components": [COUNT, None],
        "covariance_type": [StrOptions(set(COVARIANCE_TYPES))],
        "noise": [ABOVE_ZERO],
        "max_iter": [Interval(Integral, 0, None, closed="left")],
        "init_params": [StrOptions({"auto", *INITIALIZATIONS})],
        "algorithm": [StrOptions({"auto", "exact", "truncated"})],
        "max_cells": [COUNT, None],
        "weights_init": ["array-like", None],
        "means_init": ["array-like", None],
        "precisions_init": ["array-like", None],
        "compiled": ["boolean"],
        "warm_start": ["boolean"],
        "verbose": ["verbose"],
        "verbose_interval": [COUNT],
    }

    n_components: int | None = 1
    _: KW_ONLY
    covariance_type: str = "full"
    noise: float = 0.01
    tol: float = 1e-3
    reg_covar: float = 1e-6
    max_iter: int = 100
    n_init: int = 1
    init_params: str = "auto"
    algorithm: str = "auto"
    max_cells: int | None = None
    weights_init: Array | None = None
    means_init: Array | None = None
    precisions_init: Array | None = None
    random_state: RandomState = None
    dtype: str = "float32"
    compiled: bool = False
    warm_start: bool = False
    verbose: int = 0
    verbose_interval: int = 10

    def _learn(self, cloud: Cloud, on_iteration: OnIteration | None) -> None:
        points, weight, center = cloud
        rows, generator = self._rows(points, weight), as_generator(self.random_state)
        fused = iter(self._small_runs(rows, center, generator))

        def run(report: OnIteration) -> EMResult[Parameters]:
            return self._run(rows, center, generator, report, next(fused, None))

        best = self._best_start(run, on_iteration)
        seen = {"n_samples_seen": weight.sum()}
        self._store_fit(best.parameters, center, best.lower_bounds, best.converged, seen)

    def partial_fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        *,
        kappa: float = 0.6,
        memory: float | None = None,
    ) -> GaussianMixture:
        """Update the mixture with a batch of points X (N, D), by a step of stepwise EM (see `loop.blend`).

        The first batch gets one EM step from the starting point of `fit`. Later batches may have any size. A
        fitted or loaded mixture continues from its parameters. A batch of weight n after points of weight m
        (`n_samples_seen_`) has the share (n/(m+n))^kappa in the result. Steps are exact: `algorithm` and
        `max_cells` apply to `fit` only.

        Args:
            kappa: above 0.5, at most 1. With 1 all points count equally. Smaller values forget early batches,
                whose responsibilities were poor, and suit small batches and many passes.
            memory: upper limit of m, so that the mixture follows a changing scene. Required if m is unknown:
                for a mixture of given parameters.

        Raises `InvalidArgumentError` and `NumericalError` as in `fit`; also for another dimension or
        n_components than the mixture, and an invalid kappa or memory.
        """
        if not 0.5 < check_number("kappa", kappa) <= 1:
            raise InvalidArgumentError(f"kappa={kappa!r} must be above 0.5 and at most 1.")
        started = hasattr(self, "means")
        past = loop.weight_of_past(getattr(self, "n_samples_seen_", None) if started else 0.0, memory)
        points, weight, center = self._prepare(X, sample_weight, reset=not started)
        if started:
            previous = self._current_parameters(points, center)
        else:
            rows, generator = Rows(points, weight), as_generator(self.random_state)
            (previous,), _ = self._starts(rows, center, generator)
        kind, dtype = self.covariance_type, em.SOFTMAX_DTYPES[self.dtype]
        step = loop.em_step(Rows(points, weight), float(self.reg_covar), dtype, kind)
        update, bound = step(previous)
        seen = past + weight.sum()
        blended = loop.blend(previous, update, float(weight.sum() / seen) ** kappa, kind)
        self._store_fit(blended, center, [bound], False, {"n_samples_seen": seen})
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

    def _small_runs(
        self, rows: Rows, center: Tensor, generator: torch.Generator
    ) -> list[EMResult[Parameters]]:
        """What EM of a small table finds from each start, all in one launch; nothing for other tables."""
        k, kind, (n, dim) = self.n_components, self.covariance_type, rows.values.shape
        if k is None or not rows.are_points or self._truncates(n, k, dim):
            return []
        if not is_small(rows.values, rows.weight, k, kind):
            return []
        starts, _ = self._starts(rows, center, generator, 1 if self._continues() else self.n_init)
        stacked, last = Parameters(*map(torch.stack, zip(*starts, strict=True))), self._previous_bound()
        settings = kind, float(self.reg_covar), self.tol, self.max_iter, last
        found = fused_em(rows.values, rows.weight, stacked, *settings)
        # A run whose next iteration needs more than the kernel can do ends before it.
        ends = zip(found.weights, found.means, found.covariances, found.bounds, strict=True)
        return [
            EMResult(Parameters(*end), bounds, loop.has_converged(bounds, self.tol, last))
            for *end, bounds in ends
        ]

    def _run(
        self,
        rows: Rows,
        center: Tensor,
        generator: torch.Generator,
        on_iteration: OnIteration,
        known: EMResult[Parameters] | None,
    ) -> EMResult[Parameters]:
        """EM from one start, or from what is known of it."""
        reg, dtype = float(self.reg_covar), em.SOFTMAX_DTYPES[self.dtype]
        if known is None:
            start, owner = self._starts(rows, center, generator)
        else:
            start, owner = [known.parameters], None
            for iteration, bound in enumerate(known.lower_bounds, 1):
                on_iteration(iteration, bound)
        if not self._truncates(rows.weight.shape[0], *start[0].means.shape):
            return loop.run_em(
                loop.em_step(rows, reg, dtype, self.covariance_type),
                start.pop(),  # which may be most of the memory
                tol=self.tol,
                max_iter=self.max_iter,
                on_iteration=on_iteration,
                lower_bounds=known.lower_bounds if known else (),
                previous_bound=self._previous_bound(),
            )
        owner = nearest(rows.points, start[0].means) if owner is None else owner
        return fit_truncated(rows, owner, start[0], self._settings(on_iteration))

    def _settings(self, on_iteration: OnIteration | None, processes: Processes = SINGLE_PROCESS) -> Settings:
        """The settings of truncated EM."""
        return Settings(
            float(self.reg_covar),
            self.tol,
            self.max_iter,
            em.SOFTMAX_DTYPES[self.dtype],
            on_iteration=on_iteration,
            processes=processes,
            previous_bound=self._previous_bound(),
        )

    def _starts(
        self, rows: Rows, center: Tensor, generator: torch.Generator, n_starts: int = 1
    ) -> tuple[list[Parameters], Tensor | None]:
        """Starts of EM in the centred frame, and a likely component of each row (N,), if known."""
        if self._continues():
            return [self._current_parameters(rows.points, center)], None
        n, k, reg, owner = rows.weight.shape[0], self.n_components, float(self.reg_covar), None
        dim = rows.points.shape[1]
        features = None if rows.are_points else rows.values
        given = self._given_start(dim, center)
        if k is None:
            found, owner = surface_pieces(rows.points, rows.weight, float(self.noise), reg, features)
        elif len(given) == len(Parameters._fields):
            return [Parameters(**given)] * n_starts, None
        elif not given and self._truncates(n, k, dim) and self._initialization(n, k, dim) == "flat_pieces":
            found, owner = flat_pieces(rows.points, rows.weight, k, reg, features)
            found = replicated(found, k)
        else:
            method, kind = self._initialization(n, k, dim), self.covariance_type
            several = initializations(method, rows.points, rows.weight, k, reg, generator, kind, n_starts)
            return [one._replace(**given) for one in several], owner
        return [by_type.compacted(found, self.covariance_type)._replace(**given)] * n_starts, owner

    def _given_start(self, dim: int, center: Tensor) -> dict[str, Tensor]:
        """Those of the initial `Parameters` that were given, in the centred frame."""
        k, kind, device = cast(int, self.n_components), self.covariance_type, center.device
        given = {}
        if self.weights_init is not None:
            given["weights"] = checked_mixing_weights(self.weights_init, k, device)
        if self.means_init is not None:
            given["means"] = checked_parameter(self.means_init, (k, dim), "means_init", device) - center
        if self.precisions_init is not None:
            given["covariances"] = checked_precisions(self.precisions_init, kind, k, dim, device)
        return given

    def _initialization(self, n_rows: int, n_components: int, dim: int) -> str:
        """The initialization that `init_params` selects."""
        if self.init_params != "auto":
            return self.init_params
        many = n_rows * n_components > _KMEANS_IS_CHEAP and dim <= _FEW_DIMENSIONS
        return "flat_pieces" if many else "kmeans"

    def _truncates(self, n_rows: int, n_components: int, dim: int) -> bool:
        """Whether `algorithm` selects truncated EM."""
        if self.covariance_type != "full":
            return False
        if self.algorithm != "auto":
            return self.algorithm == "truncated"
        many = n_components >= _MANY_COMPONENTS and n_rows * n_components >= _MANY_PAIRS
        return many and dim <= _FEW_DIMENSIONS

    def _current_parameters(self, points: Tensor, center: Tensor) -> Parameters:
        """The current parameters, in the centred frame."""
        self._check_continues(points)
        given = self.weights, self.means, self._typed_covariances()
        weights, means, covariances = (value.to(points.device) for value in given)
        return Parameters(weights, means - center, covariances)

    def check_parameters(self, n_points: int | None = None) -> None:
        super().check_parameters(n_points)
        if self.algorithm == "truncated" and self.covariance_type != "full":
            raise InvalidArgumentError(
                "algorithm='truncated' has full covariances only, not "
                f"covariance_type={self.covariance_type!r}; set algorithm='exact'."
            )
        if self.n_components is not None:
            return
        for name in ("weights_init", "means_init", "precisions_init"):
            if getattr(self, name) is not None:
                raise InvalidArgumentError(
                    f"{name} is given, but n_components=None determines the components from the cloud; "
                    "set n_components to their number."
                )
