"""The mixture estimators by name, ours and scikit-learn's, and how their fits to a point cloud compare."""

from __future__ import annotations

import inspect
import math
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from sklearn.mixture import BayesianGaussianMixture as ScikitLearnBayesianMixture
from sklearn.mixture import GaussianMixture as ScikitLearnMixture
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.events import Event, OnRows, Row
from gmmtorch.experiments.evaluation.fits.fit_pruning import Views, pruned, tree_options
from gmmtorch.experiments.evaluation.metrics import psnr2, psnr_terms
from gmmtorch.experiments.evaluation.protocol_options import FitOptions
from gmmtorch.mixture import (
    GaussianMixture,
    HierarchicalGaussianMixture,
    MixtureEstimator,
    PruneOptions,
    RiemannianGaussianMixture,
    SlicedWassersteinGaussianMixture,
    VariationalGaussianMixture,
)

ESTIMATORS: dict[str, type] = {
    "em": GaussianMixture,
    "hierarchical": HierarchicalGaussianMixture,
    "variational": VariationalGaussianMixture,
    "riemannian": RiemannianGaussianMixture,
    "sliced_wasserstein": SlicedWassersteinGaussianMixture,
    "scikit_learn": ScikitLearnMixture,
    "scikit_learn_bayesian": ScikitLearnBayesianMixture,
}

NO_LIKELIHOODS = frozenset({"variational", "sliced_wasserstein", "scikit_learn_bayesian"})
"""Methods whose lower bound does not bound the mean log-likelihood, so it is not comparable with others."""


def _fit_ours(
    method: str, data: FitData, options: FitOptions, seed: int, on_event: Event, own: Mapping[str, Any]
) -> MixtureEstimator:
    mixture: Any = ESTIMATORS[method](**_arguments(method, options, seed, own))
    on_event(method, 0, options.max_iter)

    def on_iteration(iteration: int, lower_bound: float) -> None:
        on_event(method, min(iteration, options.max_iter), options.max_iter)

    known = inspect.signature(mixture.fit).parameters
    given = {"on_iteration": on_iteration, "origins": None if data.views is None else data.views.origins}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row contains `converged`
        mixture.fit(data.train, **{name: value for name, value in given.items() if name in known})
    on_event(method, options.max_iter, options.max_iter)
    fitted: MixtureEstimator = mixture
    return fitted


def _fit_scikit_learn(
    method: str, data: FitData, options: FitOptions, seed: int, on_event: Event, own: Mapping[str, Any]
) -> MixtureEstimator:
    """Fit from scikit-learn's own k-means start; returns the result as our mixture."""
    if options.init_params not in ("auto", "kmeans"):
        raise InvalidArgumentError(
            f"init_params={options.init_params!r}: method {method} supports only kmeans."
        )
    arguments = _arguments(method, options, seed, own)
    if options.n_components is None:
        raise InvalidArgumentError(f"n_components=None: method {method} needs a number.")
    on_event(method, 0, 1)
    fitted = ESTIMATORS[method](**arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted.fit(data.train.cpu().numpy())
    on_event(method, 1, 1)
    return GaussianMixture.from_parameters(
        fitted.weights_,
        fitted.means_,
        fitted.covariances_,
        lower_bounds=[float(x) for x in fitted.lower_bounds_],
        converged=fitted.converged_,
    )


def _arguments(method: str, options: FitOptions, seed: int, own: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the estimator's constructor: the options that it has, the seed, and its own options."""
    estimator = ESTIMATORS[method]
    known = inspect.signature(estimator).parameters
    for name in own:
        if name not in known:
            raise InvalidArgumentError(
                f"method_options.{method}.{name} is not known; {method} takes {', '.join(known)}."
            )
    shared = {name: value for name, value in vars(options).items() if name in known}
    if options.init_params == "auto" and estimator is not GaussianMixture:
        shared.pop("init_params", None)  # only GaussianMixture has "auto"
    return {**shared, "random_state": seed, **own}


@dataclass
class FitOutcome:
    """Rows of results.json, and the mixtures and lower bounds by method."""

    rows: list[Row] = field(default_factory=list)
    mixtures: dict[str, MixtureEstimator] = field(default_factory=dict)
    lower_bounds: dict[str, list[float]] = field(default_factory=dict)


class FitData(NamedTuple):
    """Points of a data set: train (N, D) for the fit and test (M, D) held out, M ≥ 0; metres.

    views: of the training points, if they are known.
    """

    dataset: str
    train: Tensor
    test: Tensor
    views: Views | None = None


def split(dataset: str, points: Tensor, test_share: float, seed: int, views: Views | None = None) -> FitData:
    """Hold out a random share of points (N, D) with these views.

    Raises `InvalidArgumentError` for a share outside [0, 1) or a cloud without points.
    """
    if not 0 <= test_share < 1:
        raise InvalidArgumentError(f"test_share={test_share} must be a share in [0, 1).")
    if points.shape[0] == 0:
        raise InvalidArgumentError("The chosen scans have no points; choose other scans by `scans`.")
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(points.shape[0], generator=generator).to(points.device)
    n_test = int(test_share * points.shape[0])
    train = order[n_test:].sort().values
    views = None if views is None else views._replace(scan=views.scan[train])
    return FitData(dataset, points[train], points[order[:n_test]], views)


def compare(
    data: FitData,
    methods: Sequence[str],
    options: FitOptions,
    seed: int,
    on_event: Event,
    on_rows: OnRows = lambda rows: None,
    own: Mapping[str, Mapping[str, Any]] | None = None,
    pruning: PruneOptions | None = None,
) -> FitOutcome:
    """Fit the training points by each method, and score the mixtures on training and test points.

    An estimator takes the options that its constructor has, and its options in `own`, which are by method.
    `pruning` removes components; None removes none. Raises `InvalidArgumentError` for an unknown method or
    an invalid option.
    """
    own = own or {}
    known = ", ".join(sorted(ESTIMATORS))
    for method in (*methods, *own):
        if method not in ESTIMATORS:
            raise InvalidArgumentError(f"method={method!r} is not known; known are {known}.")
    if not methods:
        raise InvalidArgumentError(f"method is empty; name at least one of {known}.")
    options.check(data.train.shape[0], seed)
    outcome = FitOutcome()
    for method in methods:
        begin = time.perf_counter()
        mixture = _fit_and_prune(method, data, options, seed, on_event, own.get(method, {}), pruning)
        seconds = time.perf_counter() - begin
        outcome.mixtures[method] = mixture
        outcome.lower_bounds[method] = mixture.lower_bounds_
        outcome.rows.append(row_of(data, method, mixture, seconds, seed))
        on_rows(outcome.rows)
    return outcome


def _fit_and_prune(
    method: str,
    data: FitData,
    options: FitOptions,
    seed: int,
    on_event: Event,
    own: Mapping[str, Any],
    pruning: PruneOptions | None,
) -> MixtureEstimator:
    pruning = pruning or PruneOptions()
    is_tree = method == "hierarchical"
    if is_tree:
        own = {**tree_options(pruning, data.train, data.views), **own}
    fit = _fit_ours if issubclass(ESTIMATORS[method], MixtureEstimator) else _fit_scikit_learn
    mixture = fit(method, data, options, seed, on_event, own)
    return mixture if is_tree else pruned(mixture, pruning, data.train, data.views)


def row_of(data: FitData, method: str, mixture: MixtureEstimator, seconds: float, seed: int) -> Row:
    """The row of results.json of a mixture: its scores on the training and the test points.

    `n_components_used` counts the components that are the likeliest of at least one training point. The
    weights do not show this: a prior gives weight to components without points. PSNR2 compares the points
    with equally many samples, drawn with the seed.
    """
    train, test = data.train, data.test
    forward, backward = psnr_terms(train, _drawn(mixture, len(train), seed))
    return {
        "dataset": data.dataset,
        "method": method,
        "n_points": len(train),
        "n_components": len(mixture.weights),
        "n_components_used": int(in_use(mixture, train).sum()),
        "seconds": seconds,
        "n_iterations": mixture.n_iter_,
        "converged": bool(mixture.converged_),
        "log_likelihood": mixture.score(train),
        "held_out_log_likelihood": mixture.score(test) if len(test) else None,
        "psnr2_db": _finite(forward + backward),
        "psnr_forward_db": _finite(forward),
        "psnr_backward_db": _finite(backward),
        "held_out_psnr2_db": _finite(psnr2(test, _drawn(mixture, len(test), seed))) if len(test) else None,
        "nbytes": _file_size(mixture),
    }


def means(rows: Sequence[Row], by: Sequence[str]) -> list[Row]:
    """One row for each combination of the fields `by`: `n_seeds`, and the means over the rows of the group.

    A field that is not a number keeps its value if all rows agree, else it is None.
    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    return [
        {"n_seeds": len(group), **{name: _mean([row[name] for row in group]) for name in group[0]}}
        for group in groups.values()
    ]


def _mean(values: Sequence[Any]) -> Any:
    if all(value == values[0] for value in values):
        return values[0]
    return fmean(values) if all(isinstance(value, int | float) for value in values) else None


def in_use(mixture: MixtureEstimator, points: Tensor) -> Tensor:
    """Mask (K,) of the components that are the likeliest of at least one of the points (N, D)."""
    return torch.bincount(torch.as_tensor(mixture.predict(points)), minlength=len(mixture.weights)) > 0


def _drawn(mixture: MixtureEstimator, n: int, seed: int) -> Tensor:
    points, _ = mixture.sample(n, random_state=seed)
    return torch.as_tensor(points)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _file_size(mixture: MixtureEstimator) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mixture.safetensors"
        mixture.save(path)
        return path.stat().st_size
