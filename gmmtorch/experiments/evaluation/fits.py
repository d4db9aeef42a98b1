"""Fits of the mixture estimators, ours and scikit-learn's, to a point cloud: pruned, compared, streamed."""

from __future__ import annotations

import inspect
import math
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch import mixture as ours
from gmmtorch.datasets import PointChunks
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.metrics import psnr2, psnr_terms
from gmmtorch.experiments.evaluation.protocol_options import FitOptions
from gmmtorch.mixture import (
    SINGLE_PROCESS,
    Checkpoint,
    GaussianMixture,
    MixtureEstimator,
    Processes,
    PruneOptions,
    SensorModel,
    fit_stream,
    measured_sensor,
    prune,
    score_stream,
    survey_all,
)
from gmmtorch.report import Event, OnRows, Row


class Views(NamedTuple):
    """Where points were seen from: the scan (N,) of each point, and the scans' sensor origins (S, D)."""

    scan: Tensor
    origins: Tensor

    def sensor(self, points: Tensor) -> SensorModel:
        """A sensor with the spacing of the beams of the largest scan; points (N, D)."""
        largest = int(torch.bincount(self.scan).argmax())
        return measured_sensor(points[self.scan == largest], self.origins[largest])


def tree_options(options: PruneOptions, points: Tensor, views: Views | None) -> dict[str, Any]:
    """The options of a `HierarchicalGaussianMixture` of points (N, D) that prune it while it grows."""
    if options.prune == "support":
        return {"min_support": options.min_support}
    if options.prune == "density":
        sensor = _known(views).sensor(points)
        return {"min_density_share": options.min_density_share, "sensor": sensor}
    return {}


def pruned(
    mixture: MixtureEstimator, options: PruneOptions, points: Tensor, views: Views | None
) -> MixtureEstimator:
    """The mixture of points (N, D) without the components that the options remove.

    Raises `InvalidArgumentError` if no component would remain, or if the sensor origins are not known.
    """
    if options.prune == "none":
        return mixture
    if options.prune == "support":
        return prune(mixture, len(points), min_support=options.min_support)[0]
    views = _known(views)
    n_scans = len(views.origins)
    owner = torch.as_tensor(mixture.predict(points), device=points.device)
    pair = owner * n_scans + views.scan
    counts = torch.bincount(pair, minlength=len(mixture.weights) * n_scans).view(-1, n_scans)
    return prune(
        mixture,
        len(points),
        min_density_share=options.min_density_share,
        sensor=views.sensor(points),
        origins=views.origins,
        counts=counts,
    )[0]


def _known(views: Views | None) -> Views:
    if views is None:
        raise InvalidArgumentError("prune='density' needs scans with sensor origins; use prune=support.")
    return views


_OURS = {
    "em": "GaussianMixture",
    "hierarchical": "HierarchicalGaussianMixture",
    "variational": "VariationalGaussianMixture",
    "riemannian": "RiemannianGaussianMixture",
    "sliced_wasserstein": "SlicedWassersteinGaussianMixture",
}
_SCIKIT_LEARN = {"scikit_learn": "GaussianMixture", "scikit_learn_bayesian": "BayesianGaussianMixture"}
ESTIMATORS = (*_OURS, *_SCIKIT_LEARN)

NO_LIKELIHOODS = frozenset({"variational", "sliced_wasserstein", "scikit_learn_bayesian"})
"""Methods whose lower bound does not bound the mean log-likelihood, so it is not comparable with others."""


def _estimator(method: str) -> Any:
    """The class of an estimator."""
    if method in _SCIKIT_LEARN:
        from sklearn import mixture  # takes half a second, which only a comparison waits for

        return getattr(mixture, _SCIKIT_LEARN[method])
    return getattr(ours, _OURS[method])


def _fit_ours(
    method: str, data: FitData, options: FitOptions, seed: int, on_event: Event, own: Mapping[str, Any]
) -> MixtureEstimator:
    mixture: Any = _estimator(method)(**_arguments(method, options, seed, own))
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
    fitted = _estimator(method)(**arguments)
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
    estimator = _estimator(method)
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


class FitOutcome(NamedTuple):
    """Rows of results.json, and the mixtures by method."""

    rows: list[Row]
    mixtures: dict[str, MixtureEstimator]


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
    _check_share(test_share)
    if points.shape[0] == 0:
        raise InvalidArgumentError("The chosen scans have no points; choose other scans by `scans`.")
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(points.shape[0], generator=generator).to(points.device)
    n_test = int(test_share * points.shape[0])
    train = order[n_test:].sort().values
    views = None if views is None else views._replace(scan=views.scan[train])
    return FitData(dataset, points[train], points[order[:n_test]], views)


def _check_share(test_share: float) -> None:
    if not 0 <= test_share < 1:
        raise InvalidArgumentError(f"test_share={test_share} must be a share in [0, 1).")


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
    outcome, pruning = FitOutcome([], {}), pruning or PruneOptions()
    for method in methods:
        begin = time.perf_counter()
        is_tree = method == "hierarchical"  # which is pruned while it grows
        more = tree_options(pruning, data.train, data.views) if is_tree else {}
        fit = _fit_ours if issubclass(_estimator(method), MixtureEstimator) else _fit_scikit_learn
        mixture = fit(method, data, options, seed, on_event, {**more, **own.get(method, {})})
        if not is_tree:
            mixture = pruned(mixture, pruning, data.train, data.views)
        seconds = time.perf_counter() - begin
        outcome.mixtures[method] = mixture
        outcome.rows.append(row_of(data, method, mixture, seconds, seed))
        on_rows(outcome.rows)
    return outcome


def row_of(data: FitData, method: str, mixture: MixtureEstimator, seconds: float, seed: int) -> Row:
    """The row of results.json of a mixture: its scores on the training and the test points.

    `n_components_used` counts the components that are the likeliest of at least one training point. The
    weights do not show this: a prior gives weight to components without points. PSNR2 compares the points
    with equally many samples, drawn with the seed.
    """
    train, test = data.train, data.test
    forward, backward = psnr_terms(train, _drawn(mixture, len(train), seed))
    with tempfile.TemporaryDirectory() as folder:
        mixture.save(Path(folder) / "mixture.safetensors")
        nbytes = (Path(folder) / "mixture.safetensors").stat().st_size
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
        "nbytes": nbytes,
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


_SPLIT_SALT = 0x5EED  # makes the split independent of the sample


def split_source(source: PointChunks, test_share: float, seed: int) -> tuple[PointChunks, PointChunks]:
    """Hold out a random share of the rows: the training and the test source.

    Raises `InvalidArgumentError` for a share outside [0, 1).
    """
    _check_share(test_share)
    seed ^= _SPLIT_SALT
    return source.random_subset(test_share, 1.0, seed), source.random_subset(0.0, test_share, seed)


def fit_streamed(
    sources: tuple[PointChunks, PointChunks],
    sample_points: int | None,
    options: FitOptions,
    seed: int,
    *,
    device: str = "cpu",
    processes: Processes = SINGLE_PROCESS,
    checkpoint: Checkpoint | None = None,
    on_event: Event = lambda stage, done, total: None,
) -> tuple[Row, GaussianMixture, FitData]:
    """Fit the training source by EM, and score the mixture on both sources. Only rank 0 returns a row.

    Also returns the mixture, and the points sampled from the sources: `sample_points` of each, all for None.

    Likelihoods are means over all points. PSNR2 and `n_components_used` are computed from the samples.
    """
    train, test = (part.shard(processes.rank, processes.size) for part in sources)
    wanted = None if sample_points is None else max(sample_points, options.n_components or 1)
    on_event("reading points", 0, 2)
    found = survey_all(train, wanted, seed, processes)
    on_event("reading points", 1, 2)
    held_out = survey_all(test, wanted, seed, processes)
    on_event("reading points", 2, 2)
    sample = FitData(sources[0].name, found.points, held_out.points)

    def on_iteration(iteration: int, lower_bound: float) -> None:
        on_event("em", min(iteration, options.max_iter), options.max_iter)

    on_event("em", 0, options.max_iter)
    mixture = GaussianMixture(**vars(options), random_state=seed)
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row contains `converged`
        fit_stream(
            mixture,
            train,
            survey=found,
            device=device,
            processes=processes,
            checkpoint=checkpoint,
            on_iteration=on_iteration,
        )
    seconds = time.perf_counter() - begin
    on_event("em", options.max_iter, options.max_iter)
    log_likelihood, n_points = score_stream(mixture, train, processes)
    held_out_log_likelihood, n_test = score_stream(mixture, test, processes)
    row: Row = {}
    if processes.rank == 0:
        row = row_of(sample, "em", mixture, seconds, seed)
        row["n_points"] = n_points
        row["log_likelihood"] = log_likelihood
        row["held_out_log_likelihood"] = held_out_log_likelihood if n_test else None
    return row, mixture, sample
