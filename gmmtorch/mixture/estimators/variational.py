"""VariationalGaussianMixture: a posterior over mixtures, in which components that are not needed die out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import EMResult, Parameters
from gmmtorch.mixture.em.initialization import INITIALIZATIONS, start
from gmmtorch.mixture.estimator import Cloud, MixtureEstimator, NotFittedError
from gmmtorch.mixture.estimators.gaussian_wishart import (
    Posterior,
    Prior,
    expected_weights,
    log_predictive,
    unbiased_covariance,
    update,
    variational_step,
)
from gmmtorch.mixture.validation import (
    Array,
    RandomState,
    as_generator,
    check_choice,
    check_enough,
    check_number,
    checked_parameter,
)

WEIGHT_PRIORS = ("dirichlet_process", "dirichlet_distribution")


def _kept(buffer: str, doc: str) -> Any:
    """A fitted attribute: a buffer in the kind of the points given to `fit`, or a float if it is a scalar."""

    def read(self: VariationalGaussianMixture) -> Array | float:
        self._posterior()
        value: Tensor = getattr(self, buffer)
        return self._as_fitted(value) if value.ndim else float(value)

    return property(read, doc=doc)


class VariationalGaussianMixture(MixtureEstimator):
    """Variational Bayes of a full-covariance mixture (thesis 2.1.5; Bishop, 2006, section 10.2).

    The fit is a posterior over mixtures, found as scikit-learn's `BayesianGaussianMixture` finds it.
    Components that explain too little end with hardly any weight: `n_components_used_` counts those
    left, and `gmmtorch.mixture.prune` gives the mixture without the others (and without a posterior).

    `weights_` and `means_` are expectations and `covariances_` the inverse of the expected precision;
    `score_samples`, `predict` and `sample` are those of this one mixture (scikit-learn's are of
    expected log-densities). The density that accounts for what is not known is
    `score_samples_predictive`.

    Points count as evidence against the prior, so a `sample_weight` of 2 is another fit than 1.

    Args:
        n_components: K, the most components there may be, at most the number of points.
        tol: stops when the lower bound changes by less (nats a point).
        reg_covar: added to each variance, in the square of the points' unit (m²).
        max_iter: iterations at most, in each start.
        n_init: starts; the one with the best lower bound is kept.
        init_params: "kmeans" (scikit-learn's), "random_points" or "bounding_box".
        weight_concentration_prior_type: "dirichlet_process" (stick-breaking, truncated at K) or
            "dirichlet_distribution".
        weight_concentration_prior: γ₀, the smaller the fewer components are used; None: 1/K.
        mean_precision_prior: β₀, so many points the prior mean counts for; None: 1.
        mean_prior: m₀ (D,); None: the points' mean.
        degrees_of_freedom_prior: ν₀ > D − 1, so many points the prior covariance counts for; None: D.
        covariance_prior: W₀⁻¹ (D, D), ν₀ times a typical covariance; None: the points' covariance.
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a fresh one.
        dtype: of the exponentials of the E-step, as in `GaussianMixture`.

    Fitted attributes: those of every `MixtureEstimator`; the posterior's `weight_concentration_`
    ((K,), or for sticks the pair of Beta parameters, (K,) each), `mean_precision_` (K,) and
    `degrees_of_freedom_` (K,); and the prior's `weight_concentration_prior_`,
    `mean_precision_prior_`, `mean_prior_`, `degrees_of_freedom_prior_`, `covariance_prior_`.
    `lower_bounds_` are of log p(X), all constants included (scikit-learn leaves some out, and does
    not divide by the points), nats a point, after each iteration.
    """

    _extra_names: ClassVar[tuple[str, ...]] = (
        "concentration",
        "mean_precision",
        "degrees_of_freedom",
        *(f"prior_{name}" for name in Prior._fields),
    )
    _takes_any_total_weight = True
    concentration: Tensor
    mean_precision: Tensor
    degrees_of_freedom: Tensor
    prior_mean_precision: Tensor

    def __init__(
        self,
        n_components: int = 1,
        *,
        tol: float = 1e-3,
        reg_covar: float = 1e-6,
        max_iter: int = 100,
        n_init: int = 1,
        init_params: str = "kmeans",
        weight_concentration_prior_type: str = "dirichlet_process",
        weight_concentration_prior: float | None = None,
        mean_precision_prior: float | None = None,
        mean_prior: Array | None = None,
        degrees_of_freedom_prior: float | None = None,
        covariance_prior: Array | None = None,
        random_state: RandomState = None,
        dtype: str = "float32",
    ) -> None:
        nn.Module.__init__(self)
        self.n_components = n_components
        self.tol = tol
        self.reg_covar = reg_covar
        self.max_iter = max_iter
        self.n_init = n_init
        self.init_params = init_params
        self.weight_concentration_prior_type = weight_concentration_prior_type
        self.weight_concentration_prior = weight_concentration_prior
        self.mean_precision_prior = mean_precision_prior
        self.mean_prior = mean_prior
        self.degrees_of_freedom_prior = degrees_of_freedom_prior
        self.covariance_prior = covariance_prior
        self.random_state = random_state
        self.dtype = dtype

    # -- learning ---------------------------------------------------------------------------------

    def fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
    ) -> VariationalGaussianMixture:
        """Learn the posterior given points X (N, D).

        Args:
            X: points, finite.
            y: ignored, as in scikit-learn.
            sample_weight: (N,) how many points each row stands for: not negative, not all zero.
            on_iteration: called with the iteration (from 1) and the lower bound, nats a point.

        Raises:
            InvalidArgumentError (a ValueError): a bad argument, weight or point; K above the
                number of points of non-zero weight.
            NumericalError: a covariance collapsed, as happens with reg_covar = 0.
        """
        cloud = self._prepare(X, sample_weight)
        prior = self._prior(cloud)
        process = self.weight_concentration_prior_type == "dirichlet_process"
        reg_covar, total = float(self.reg_covar), cloud.weight.sum()
        dtype = em.SOFTMAX_DTYPES[self.dtype]
        step = variational_step(cloud.points, cloud.weight, prior, process, reg_covar, dtype)
        generator = as_generator(self.random_state)
        best: EMResult | None = None
        for _ in range(self.n_init):
            first = start(
                self.init_params, cloud.points, cloud.weight, self.n_components, reg_covar, generator
            )
            # Sticks are broken in turn: the bound is best, and the frame does not matter, with the
            # largest component first.
            order = first.weights.argsort(descending=True, stable=True)
            moments = Parameters(first.weights[order] * total, first.means[order], first.covariances[order])
            found = em.run_em(step, moments, tol=self.tol, max_iter=self.max_iter, on_iteration=on_iteration)
            if best is None or found.lower_bounds[-1] > best.lower_bounds[-1]:
                best = found
        assert best is not None
        posterior = update(prior, best.parameters, process)
        mixture = Parameters(
            expected_weights(posterior.concentration), posterior.means, posterior.covariances
        )
        extra = {name: getattr(posterior, name) for name in self._extra_names[:3]}
        extra |= {f"prior_{name}": value for name, value in prior._asdict().items()}
        extra["prior_mean"] = prior.mean + cloud.center
        self._keep(mixture, cloud.center, best.lower_bounds, best.converged, extra)
        self._warn_unless_converged("The fit")
        return self

    def _prior(self, cloud: Cloud) -> Prior:
        """The prior about the cloud's centre: as given, and where it is not, the cloud's own."""
        points, weight, center = cloud
        dim = points.shape[1]
        dof = self.degrees_of_freedom_prior
        if dof is not None and dof <= dim - 1:
            raise InvalidArgumentError(
                f"degrees_of_freedom_prior={dof!r} must be above D − 1 = {dim - 1}, D the dimension of X."
            )
        mean, covariance = torch.zeros_like(center), self.covariance_prior
        if self.mean_prior is not None:
            mean = checked_parameter(self.mean_prior, (dim,), "mean_prior", points.device) - center
        if covariance is None:
            spread = unbiased_covariance(points, weight, thickness=float(self.reg_covar))
        else:
            spread = checked_parameter(covariance, (dim, dim), "covariance_prior", points.device)
            safe_cholesky(check_symmetric(spread[None], "covariance_prior"), "covariance_prior")
        gamma, beta = self.weight_concentration_prior, self.mean_precision_prior
        return Prior(
            center.new_tensor(1 / self.n_components if gamma is None else float(gamma)),
            center.new_tensor(1.0 if beta is None else float(beta)),
            mean,
            center.new_tensor(dim if dof is None else float(dof)),
            spread,
        )

    # -- the posterior ----------------------------------------------------------------------------

    def score_samples_predictive(self, X: Array) -> Array:
        """log p(x | X) of each point, (N,), nats, given all that was fitted and the prior.

        A mixture of Student-t densities: wider than `score_samples`, most of all where a component
        has seen few points.
        """
        points = self._as_points(X)
        return self._like(log_predictive(points, self._posterior()), X)

    def _posterior(self) -> Posterior:
        self._fitted()
        if "concentration" not in self._buffers:
            raise NotFittedError(
                f"This {type(self).__name__} is of given parameters and has no posterior; fit it to points."
            )
        return Posterior(
            self.concentration, self.mean_precision, self.means, self.degrees_of_freedom, self.covariances
        )

    @property
    def support_(self) -> Array:
        """Expected number of points N_k of each component, (K,)."""
        return self._as_fitted(self._posterior().mean_precision - self.prior_mean_precision)

    @property
    def n_components_used_(self) -> int:
        """How many components explain a point: N_k, rounded, is not zero."""
        return int((torch.as_tensor(self.support_).round() > 0).sum())

    @property
    def weight_concentration_(self) -> Array | tuple[Array, Array]:
        """Dirichlet parameters (K,), or the sticks' Beta parameters, (K,) each."""
        rows = [self._as_fitted(row) for row in self._posterior().concentration]
        return (rows[0], rows[1]) if len(rows) == 2 else rows[0]

    mean_precision_ = _kept("mean_precision", "β (K,).")
    degrees_of_freedom_ = _kept("degrees_of_freedom", "ν (K,).")
    weight_concentration_prior_ = _kept("prior_concentration", "γ₀.")
    mean_precision_prior_ = _kept("prior_mean_precision", "β₀.")
    mean_prior_ = _kept("prior_mean", "m₀ (D,).")
    degrees_of_freedom_prior_ = _kept("prior_degrees_of_freedom", "ν₀.")
    covariance_prior_ = _kept("prior_covariance", "W₀⁻¹ (D, D).")

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        k, dim = self.means.shape
        shapes = {
            "mean_precision": (k,),
            "degrees_of_freedom": (k,),
            "prior_mean": (dim,),
            "prior_covariance": (dim, dim),
        }
        for name in self._extra_names if tensors else ():
            if name not in tensors:
                raise InvalidArgumentError(f"The posterior lacks {name}; give all of it or nothing.")
            shape, value = tuple(tensors[name].shape), tensors[name]
            expected = [(1, k), (2, k)] if name == "concentration" else [shapes.get(name, ())]
            least = dim - 1 if "degrees_of_freedom" in name else 0
            signed = name in ("prior_mean", "prior_covariance")
            sound = bool(torch.isfinite(value).all()) and (signed or bool((value > least).all()))
            if shape not in expected or value.dtype != torch.float64 or not sound:
                raise InvalidArgumentError(
                    f"{name} is {value.dtype} {shape}; expected finite numbers above {least}, float64 "
                    f"{expected[-1]}."
                )
        super()._set_extra(tensors)

    def _moved_extra(self, rotation: Tensor, translation: Tensor) -> dict[str, Tensor]:
        extra = self._extra_tensors()
        if extra:
            extra["prior_mean"] = rotation @ extra["prior_mean"] + translation
            extra["prior_covariance"] = rotation @ extra["prior_covariance"] @ rotation.T
        return extra

    # -- arguments --------------------------------------------------------------------------------

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for a parameter that cannot be, or K above the number of points."""
        for name in ("n_components", "max_iter", "n_init"):
            check_whole(name, getattr(self, name), 1)
        for name in ("tol", "reg_covar"):
            check_number(name, getattr(self, name))
        for name in ("weight_concentration_prior", "mean_precision_prior", "degrees_of_freedom_prior"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=True)
        for name, choices in (
            ("init_params", INITIALIZATIONS),
            ("weight_concentration_prior_type", WEIGHT_PRIORS),
            ("dtype", em.SOFTMAX_DTYPES),
        ):
            check_choice(name, getattr(self, name), choices)
        as_generator(self.random_state)
        check_enough(self.n_components, n_points)
