"""The mixture estimators by name: ours and scikit-learn's, fitted with the same options."""

from __future__ import annotations

import inspect
import warnings
from typing import Any

from sklearn.mixture import BayesianGaussianMixture as ScikitLearnBayesianMixture
from sklearn.mixture import GaussianMixture as ScikitLearnMixture
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation.events import Event
from gmmtorch.evaluation.protocol_options import FitOptions
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.estimators.riemannian import RiemannianGaussianMixture
from gmmtorch.mixture.estimators.sliced_wasserstein import SlicedWassersteinGaussianMixture
from gmmtorch.mixture.estimators.trees.hierarchical import HierarchicalGaussianMixture
from gmmtorch.mixture.estimators.variational import VariationalGaussianMixture
from gmmtorch.mixture.gaussian_mixture import GaussianMixture

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


def fit(
    method: str, points: Tensor, options: FitOptions, seed: int, on_event: Event, **own: Any
) -> MixtureEstimator:
    """Fit the estimator of that name to points (N, D).

    Args:
        options: an estimator takes the options that its constructor has.
        own: options of this estimator only.

    Raises `InvalidArgumentError` for an unknown method or option.
    """
    if method not in ESTIMATORS:
        raise InvalidArgumentError(
            f"method={method!r} is not known; known are {', '.join(sorted(ESTIMATORS))}."
        )
    work = _fit_ours if issubclass(ESTIMATORS[method], MixtureEstimator) else _fit_scikit_learn
    return work(method, points, options, seed, on_event, own)


def _fit_ours(
    method: str, points: Tensor, options: FitOptions, seed: int, on_event: Event, own: dict[str, Any]
) -> MixtureEstimator:
    mixture: Any = ESTIMATORS[method](**_arguments(method, options, seed, own))
    on_event(method, 0, options.max_iter)

    def on_iteration(iteration: int, lower_bound: float) -> None:
        on_event(method, min(iteration, options.max_iter), options.max_iter)

    reports = "on_iteration" in inspect.signature(mixture.fit).parameters
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row contains `converged`
        mixture.fit(points, **({"on_iteration": on_iteration} if reports else {}))
    on_event(method, options.max_iter, options.max_iter)
    fitted: MixtureEstimator = mixture
    return fitted


def _fit_scikit_learn(
    method: str, points: Tensor, options: FitOptions, seed: int, on_event: Event, own: dict[str, Any]
) -> MixtureEstimator:
    """Fit from scikit-learn's own k-means start; returns the result as our mixture."""
    if options.init_params not in ("auto", "kmeans"):
        raise InvalidArgumentError(
            f"mixture.init_params={options.init_params!r}: method {method} supports only kmeans."
        )
    arguments = _arguments(method, options, seed, own)
    if options.n_components is None:
        raise InvalidArgumentError(f"mixture.n_components=null: method {method} needs a number.")
    on_event(method, 0, 1)
    fitted = ESTIMATORS[method](**arguments)
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


def _arguments(method: str, options: FitOptions, seed: int, own: dict[str, Any]) -> dict[str, Any]:
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
