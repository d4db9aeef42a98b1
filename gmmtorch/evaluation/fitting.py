"""Mixtures fitted to a cloud, side by side: time, likelihood, PSNR2, bytes."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.events import Event
from gmmtorch.evaluation.metrics import psnr2
from gmmtorch.mixture.gaussian_mixture import GaussianMixture


@dataclass(frozen=True)
class FitOptions:
    """The options `mixture.*`: scikit-learn's names, see `GaussianMixture`."""

    n_components: int = 100
    init_params: str = "kmeans"
    tol: float = 1e-3
    reg_covar: float = 1e-6
    max_iter: int = 100
    n_init: int = 1
    dtype: str = "float32"


@dataclass
class FitOutcome:
    """rows: as in results.json; mixtures and lower bounds by method."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    mixtures: dict[str, GaussianMixture] = field(default_factory=dict)
    lower_bounds: dict[str, list[float]] = field(default_factory=dict)


def fit_em(points: Tensor, options: FitOptions, seed: int, on_event: Event) -> GaussianMixture:
    """Our own EM."""
    on_event("em", 0, options.max_iter)

    def on_iteration(iteration: int, lower_bound: float) -> None:
        on_event("em", iteration, options.max_iter)

    mixture = GaussianMixture(**vars(options), random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whether it converged is in the row
        mixture.fit(points, on_iteration=on_iteration)
    on_event("em", options.max_iter, options.max_iter)
    return mixture


def fit_scikit_learn(points: Tensor, options: FitOptions, seed: int, on_event: Event) -> GaussianMixture:
    """scikit-learn's EM with the same options, from its own k-means start; its result as our mixture."""
    from sklearn.mixture import GaussianMixture as ScikitLearnMixture

    if options.init_params != "kmeans":
        raise InvalidArgumentError(
            f"mixture.init_params={options.init_params!r}: method scikit_learn is compared from kmeans only."
        )
    GaussianMixture(**vars(options), random_state=seed).check_parameters(points.shape[0])
    on_event("scikit_learn", 0, 1)
    peer = ScikitLearnMixture(
        options.n_components,
        tol=options.tol,
        reg_covar=options.reg_covar,
        max_iter=options.max_iter,
        n_init=options.n_init,
        random_state=seed,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        peer.fit(points.cpu().numpy())
    on_event("scikit_learn", 1, 1)
    return GaussianMixture.from_parameters(
        peer.weights_,
        peer.means_,
        peer.covariances_,
        lower_bounds=[float(x) for x in peer.lower_bounds_],
        converged=peer.converged_,
    )


METHODS: dict[str, Callable[[Tensor, FitOptions, int, Event], GaussianMixture]] = {
    "em": fit_em,
    "scikit_learn": fit_scikit_learn,
}


def compare(
    name: str,
    points: Tensor,
    methods: Sequence[str],
    options: FitOptions,
    test_share: float,
    seed: int,
    on_event: Event,
) -> FitOutcome:
    """Fit points (N, D) by each method, and score the mixtures on the same held-out share.

    Raises `InvalidArgumentError` for an unknown method, which lists the known, and for a share
    outside [0, 1) or a cloud without points.
    """
    for method in methods:
        if method not in METHODS:
            raise InvalidArgumentError(
                f"method={method!r} is not known; known are {', '.join(sorted(METHODS))}."
            )
    if not methods:
        raise InvalidArgumentError(f"method is empty; name at least one of {', '.join(sorted(METHODS))}.")
    if not 0 <= test_share < 1:
        raise InvalidArgumentError(f"test_share={test_share} must be a share in [0, 1).")
    if points.shape[0] == 0:
        raise InvalidArgumentError("The chosen scans hold no points; choose others by `scans`.")
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(points.shape[0], generator=generator).to(points.device)
    n_test = int(test_share * points.shape[0])
    test, train = points[order[:n_test]], points[order[n_test:].sort().values]
    outcome = FitOutcome()
    for method in methods:
        begin = time.perf_counter()
        mixture = METHODS[method](train, options, seed, on_event)
        seconds = time.perf_counter() - begin
        sampled, _ = mixture.sample(train.shape[0], random_state=seed)
        quality = psnr2(train, torch.as_tensor(sampled))
        outcome.mixtures[method] = mixture
        outcome.lower_bounds[method] = mixture.lower_bounds_
        outcome.rows.append(
            {
                "dataset": name,
                "method": method,
                "n_points": int(train.shape[0]),
                "n_components": int(mixture.weights.shape[0]),
                "seconds": seconds,
                "n_iterations": mixture.n_iter_,
                "converged": bool(mixture.converged_),
                "log_likelihood": mixture.score(train),
                "held_out_log_likelihood": mixture.score(test) if n_test else None,
                "psnr2_db": quality if np.isfinite(quality) else None,
                "nbytes": _file_size(mixture),
            }
        )
    return outcome


def _file_size(mixture: GaussianMixture) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mixture.safetensors"
        mixture.save(path)
        return path.stat().st_size
