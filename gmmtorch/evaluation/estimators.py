"""The estimators that can be compared on a cloud: ours and scikit-learn's, from the same options."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from sklearn.mixture import BayesianGaussianMixture as ScikitLearnBayesianMixture
from sklearn.mixture import GaussianMixture as ScikitLearnMixture
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.events import Event
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.estimators.riemannian import RiemannianGaussianMixture
from gmmtorch.mixture.estimators.sliced_wasserstein import SlicedWassersteinGaussianMixture
from gmmtorch.mixture.estimators.trees.hierarchical import HierarchicalGaussianMixture
from gmmtorch.mixture.estimators.variational import VariationalGaussianMixture
from gmmtorch.mixture.gaussian_mixture import GaussianMixture


@dataclass(frozen=True)
class FitOptions:
    """The options `mixture.*`: scikit-learn's names, see `GaussianMixture`. A method takes those it has."""

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
        """Raise `InvalidArgumentError` for an option that cannot be, or not with so many points."""
        GaussianMixture(**vars(self), random_state=seed).check_parameters(n_points)


def fit_ours(
    method: str,
    estimator: type[MixtureEstimator],
    points: Tensor,
    options: FitOptions,
    seed: int,
    on_event: Event,
    **own: Any,
) -> MixtureEstimator:
    """One of our own estimators."""
    taken = _taken(method, estimator, options, seed, own)
    on_event(method, 0, options.max_iter)

    def on_iteration(iteration: int, lower_bound: float) -> None:
        on_event(method, min(iteration, options.max_iter), options.max_iter)

    mixture: Any = estimator(**taken)
    listens = "on_iteration" in inspect.signature(mixture.fit).parameters
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whether it converged is in the row
        mixture.fit(points, **({"on_iteration": on_iteration} if listens else {}))
    on_event(method, options.max_iter, options.max_iter)
    fitted: MixtureEstimator = mixture
    return fitted


def fit_scikit_learn(
    method: str, peer: type, points: Tensor, options: FitOptions, seed: int, on_event: Event, **own: Any
) -> MixtureEstimator:
    """One of scikit-learn's, from its own k-means start; its result as our mixture."""
    if options.init_params not in ("auto", "kmeans"):
        raise InvalidArgumentError(
            f"mixture.init_params={options.init_params!r}: method {method} is compared from kmeans only."
        )
    taken = _taken(method, peer, options, seed, own)
    if options.n_components is None:
        raise InvalidArgumentError(f"mixture.n_components=null: method {method} needs a number.")
    on_event(method, 0, 1)
    fitted = peer(**taken)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted.fit(points.cpu().numpy())
    on_event(method, 1, 1)
    return GaussianMixture.from_parameters(
        fitted.weights_,
        fitted.means_,
        fitted.covariances_,
        lower_bounds=[float(x) for x in fitted.lower_bounds_],
        converged=fitted.converged_,
    )


def _taken(
    method: str, estimator: type, options: FitOptions, seed: int, own: dict[str, Any]
) -> dict[str, Any]:
    """Of the common options those that the estimator's constructor has; and its own, which it must have."""
    known = inspect.signature(estimator).parameters
    for name in own:
        if name not in known:
            raise InvalidArgumentError(
                f"method_options.{method}.{name} is not known; {method} takes {', '.join(known)}."
            )
    common = {name: value for name, value in vars(options).items() if name in known}
    if options.init_params == "auto" and estimator is not GaussianMixture:
        common.pop("init_params", None)  # only GaussianMixture chooses; the others start as they do
    return {**common, "random_state": seed, **own}


Fit = Callable[..., MixtureEstimator]
"""(points (N, D), options, seed, on_event, **own options) → a fitted mixture."""

_OURS: dict[str, type[MixtureEstimator]] = {
    "em": GaussianMixture,
    "hierarchical": HierarchicalGaussianMixture,
    "variational": VariationalGaussianMixture,
    "riemannian": RiemannianGaussianMixture,
    "sliced_wasserstein": SlicedWassersteinGaussianMixture,
}
_SCIKIT_LEARN = {
    "scikit_learn": ScikitLearnMixture,
    "scikit_learn_bayesian": ScikitLearnBayesianMixture,
}

METHODS: dict[str, Fit] = {
    **{name: partial(fit_ours, name, estimator) for name, estimator in _OURS.items()},
    **{name: partial(fit_scikit_learn, name, peer) for name, peer in _SCIKIT_LEARN.items()},
}

NO_LIKELIHOODS = frozenset({"variational", "sliced_wasserstein", "scikit_learn_bayesian"})
"""Methods whose lower bounds are not of the mean log-likelihood, and so not to be compared with others'."""
