"""Mixtures fitted to a cloud, side by side: time, likelihood, PSNR2, bytes."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.estimators import METHODS, FitOptions
from gmmtorch.evaluation.events import Event
from gmmtorch.evaluation.metrics import psnr2, psnr_terms
from gmmtorch.mixture.estimator import MixtureEstimator

Row = dict[str, Any]
OnRows = Callable[[list[Row]], object]
"""Called with all rows so far whenever there is one more, so that hours of work need not hang on the last."""


@dataclass
class FitOutcome:
    """rows: as in results.json; mixtures and lower bounds by method."""

    rows: list[Row] = field(default_factory=list)
    mixtures: dict[str, MixtureEstimator] = field(default_factory=dict)
    lower_bounds: dict[str, list[float]] = field(default_factory=dict)


class Material(NamedTuple):
    """What is learned from: points train (N, D) of a data set; and points test (M, D) held out, M ≥ 0."""

    dataset: str
    train: Tensor
    test: Tensor


def split(dataset: str, points: Tensor, test_share: float, seed: int) -> Material:
    """Hold out a random share of points (N, D).

    Raises `InvalidArgumentError` for a share outside [0, 1) or a cloud without points.
    """
    if not 0 <= test_share < 1:
        raise InvalidArgumentError(f"test_share={test_share} must be a share in [0, 1).")
    if points.shape[0] == 0:
        raise InvalidArgumentError("The chosen scans hold no points; choose others by `scans`.")
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(points.shape[0], generator=generator).to(points.device)
    n_test = int(test_share * points.shape[0])
    return Material(dataset, points[order[n_test:].sort().values], points[order[:n_test]])


def compare(
    material: Material,
    methods: Sequence[str],
    options: FitOptions,
    seed: int,
    on_event: Event,
    on_rows: OnRows = lambda rows: None,
    own: Mapping[str, Mapping[str, Any]] | None = None,
) -> FitOutcome:
    """Fit the training points by each method, and score the mixtures on the same points held out.

    `own` has, by method, options that only its estimator takes. Raises `InvalidArgumentError` for an
    unknown method, which lists the known, and for a bad option.
    """
    own = own or {}
    for method in (*methods, *own):
        if method not in METHODS:
            raise InvalidArgumentError(
                f"method={method!r} is not known; known are {', '.join(sorted(METHODS))}."
            )
    if not methods:
        raise InvalidArgumentError(f"method is empty; name at least one of {', '.join(sorted(METHODS))}.")
    options.check(material.train.shape[0], seed)
    outcome = FitOutcome()
    for method in methods:
        begin = time.perf_counter()
        mixture = METHODS[method](material.train, options, seed, on_event, **own.get(method, {}))
        seconds = time.perf_counter() - begin
        outcome.mixtures[method] = mixture
        outcome.lower_bounds[method] = mixture.lower_bounds_
        outcome.rows.append(row_of(material, method, mixture, seconds, seed))
        on_rows(outcome.rows)
    return outcome


def row_of(material: Material, method: str, mixture: MixtureEstimator, seconds: float, seed: int) -> Row:
    """How good a mixture is for what it was learned from, and for what was held out.

    `n_components_used` counts those that a training point belongs to (weights would not do: a
    prior may give weight to components that explain nothing). The points of PSNR2 are drawn with
    the seed, as many as they are compared with.
    """
    _, train, test = material
    forward, backward = psnr_terms(train, _drawn(mixture, len(train), seed))
    return {
        "dataset": material.dataset,
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
    """One row for each combination of the fields `by`: `n_seeds`, and means over the rows that share it.

    Of what is no number the value that all share, else None.
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
    """Which components (K,) are the likeliest of one of the points (N, D) at least."""
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
