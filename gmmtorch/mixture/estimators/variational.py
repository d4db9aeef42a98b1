"""VariationalGaussianMixture: a posterior over mixtures, in which unneeded components lose their weight.

The prior and the iterations are those of `gmmtorch.mixture.em.variational_bayes`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass
from numbers import Integral
from typing import Any, ClassVar

import torch
from sklearn.utils._param_validation import Interval, StrOptions
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mixture.density import NotFittedError
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, Parameters, compact, expand, type_shape
from gmmtorch.mixture.em.initialization import initializations
from gmmtorch.mixture.em.loop import EMResult, OnIteration, run_em
from gmmtorch.mixture.em.variational_bayes import (
    Posterior,
    Prior,
    expected_weights,
    log_predictive,
    unbiased_covariance,
    update,
    variational_step,
)
from gmmtorch.mixture.estimator import ABOVE_ZERO, COUNT, Cloud, MixtureEstimator
from gmmtorch.mixture.validation import Array, RandomState, as_generator, checked_parameter

WEIGHT_PRIORS = ("dirichlet_process", "dirichlet_distribution")


def _posterior_attribute(buffer: str, doc: str) -> Any:
    """A fitted attribute that returns a buffer: of the kind of the points given to `fit`, or a float."""

    def read(self: VariationalGaussianMixture) -> Array | float:
        self._posterior()
        value: Tensor = getattr(self, buffer)
        return self._as_fit_kind(value) if value.ndim else float(value)

    return property(read, doc=doc)


@dataclass(eq=False, repr=False)
class VariationalGaussianMixture(MixtureEstimator):
    """Variational Bayes of a mixture (thesis 2.1.5; Bishop, 2006, section 10.2).

    The fit is a posterior over mixtures, computed as in scikit-learn's `BayesianGaussianMixture`: with
    `dtype="float64"`, equal initial responsibilities and the same number of iterations, the parameters are
    equal to 1e-6. Equal seeds do not give equal starts.
    Components that explain too few points end with almost no weight. `n_components_used_` counts the
    others, and `gmmtorch.mixture.prune` returns the mixture (without posterior) of the others.

    `weights_` and `means_` are posterior expectations, and `covariances_` is the inverse of the expected
    precision. `score_samples`, `predict` and `sample` refer to this single mixture (scikit-learn's refer
    to expected log-densities). `score_samples_predictive` is the density that includes the uncertainty.

    Points are evidence against the prior, so a `sample_weight` of 2 gives another fit than 1.

    Args:
        n_components: K, the largest number of components, at most the number of points.
        covariance_type: "full", "tied", "diag" or "spherical". The posterior of each precision matrix is a
            Wishart distribution whose scale matrix has this form.
        tol: stops when the lower bound changes by less (nats per point).
        reg_covar: added to each variance, in the squared unit of the points (m²).
        max_iter: largest number of iterations of each start. 0: the posterior of the start.
        n_init: number of starts; the one with the best lower bound is kept.
        init_params: as in `GaussianMixture`, without "auto".
        weight_concentration_prior_type: "dirichlet_process" (stick-breaking, truncated at K) or
            "dirichlet_distribution".
        weight_concentration_prior: γ₀; smaller values use fewer components. None: 1/K.
        mean_precision_prior: β₀, the number of points that the prior mean counts as. None: 1.
        mean_prior: m₀ (D,). None: the mean of the points.
        degrees_of_freedom_prior: ν₀ > D − 1, the number of points that the prior covariance counts as.
            None: D.
        covariance_prior: W₀⁻¹, ν₀ times a typical covariance: (D, D), "diag" (D,), "spherical" a number.
            None: the covariance of the points.
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a random seed.
        dtype: of the exponentials of the E-step, as in `GaussianMixture`.
        warm_start: `fit` continues from the posterior and the lower bound of the last fit.
        verbose, verbose_interval: as in `GaussianMixture`.

    Fitted attributes: those of every `MixtureEstimator`; of the posterior `weight_concentration_` ((K,),
    or for a process a pair of Beta parameters, (K,) each), `mean_precision_` (K,) and
    `degrees_of_freedom_` ((K,), "tied" a number); and of the prior `weight_concentration_prior_`,
    `mean_precision_prior_`, `mean_prior_`, `degrees_of_freedom_prior_`, `covariance_prior_`.
    `lower_bounds_` are lower bounds of log p(X) with all constants, nats per point, after each iteration.
    Scikit-learn's bound omits some constants and is not divided by the number of points.
    """

    _extra_names: ClassVar[tuple[str, ...]] = (
        "concentration",
        "mean_precision",
        "degrees_of_freedom",
        *(f"prior_{name}" for name in Prior._fields),
    )
    _accepts_any_total_weight = True
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **MixtureEstimator._parameter_constraints,
        "covariance_type": [StrOptions(set(COVARIANCE_TYPES))],
        "max_iter": [Interval(Integral, 0, None, closed="left")],
        "weight_concentration_prior_type": [StrOptions(set(WEIGHT_PRIORS))],
        "weight_concentration_prior": [ABOVE_ZERO, None],
        "mean_precision_prior": [ABOVE_ZERO, None],
        "mean_prior": ["array-like", None],
        "degrees_of_freedom_prior": [ABOVE_ZERO, None],
        "covariance_prior": ["array-like", ABOVE_ZERO, None],
        "warm_start": ["boolean"],
        "verbose": ["verbose"],
        "verbose_interval": [COUNT],
    }
    concentration: ClassVar[Tensor]  # buffers, which only a fitted mixture has
    mean_precision: ClassVar[Tensor]
    degrees_of_freedom: ClassVar[Tensor]
    prior_covariance: ClassVar[Tensor]
    prior_mean_precision: ClassVar[Tensor]

    n_components: int = 1
    _: KW_ONLY
    covariance_type: str = "full"
    tol: float = 1e-3
    reg_covar: float = 1e-6
    max_iter: int = 100
    n_init: int = 1
    init_params: str = "kmeans"
    weight_concentration_prior_type: str = "dirichlet_process"
    weight_concentration_prior: float | None = None
    mean_precision_prior: float | None = None
    mean_prior: Array | None = None
    degrees_of_freedom_prior: float | None = None
    covariance_prior: Array | None = None
    random_state: RandomState = None
    dtype: str = "float32"
    warm_start: bool = False
    verbose: int = 0
    verbose_interval: int = 10

    def _learn(self, cloud: Cloud, on_iteration: OnIteration | None) -> None:
        prior, reg, generator = self._prior(cloud), float(self.reg_covar), as_generator(self.random_state)
        settings = self.n_components, reg, generator, self.covariance_type, self.n_init
        starts = initializations(self.init_params, cloud.points, cloud.weight, *settings)
        step = variational_step(
            cloud.points,
            cloud.weight,
            prior,
            self.weight_concentration_prior_type == "dirichlet_process",
            reg,
            em.SOFTMAX_DTYPES[self.dtype],
            self.covariance_type,
        )

        def run(report: OnIteration | None) -> EMResult[Posterior]:
            return run_em(
                step,
                self._first_posterior(cloud, prior, starts),
                tol=self.tol,
                max_iter=self.max_iter,
                on_iteration=report,
                previous_bound=self._previous_bound(),
            )

        best = self._best_start(run, on_iteration)
        posterior = best.parameters
        weights = expected_weights(posterior.concentration)
        mixture = Parameters(weights, posterior.means, posterior.covariances)
        extra = {name: getattr(posterior, name) for name in self._extra_names[:3]}
        extra |= {f"prior_{name}": value for name, value in prior._asdict().items()}
        extra["prior_mean"] = prior.mean + cloud.center
        self._store_fit(mixture, cloud.center, best.lower_bounds, best.converged, extra)

    def _continues(self) -> bool:
        return super()._continues() and "concentration" in self._buffers

    def _first_posterior(self, cloud: Cloud, prior: Prior, starts: Iterator[Parameters]) -> Posterior:
        """Posterior of the initial moments, or of the last fit, relative to the cloud's centre."""
        if self._continues():
            last = Posterior(*(value.to(cloud.points.device) for value in self._posterior()))
            self._check_continues(cloud.points)
            return last._replace(means=last.means - cloud.center)
        first = next(starts)
        # Stick-breaking depends on the order of components. With the largest component first the bound is
        # best and does not depend on the frame.
        order = first.weights.argsort(descending=True, stable=True)
        count = first.weights[order] * cloud.weight.sum()
        covariances = first.covariances if self.covariance_type == "tied" else first.covariances[order]
        moments = Parameters(count, first.means[order], covariances)
        process = self.weight_concentration_prior_type == "dirichlet_process"
        return update(prior, moments, process, self.covariance_type)

    def _prior(self, cloud: Cloud) -> Prior:
        """The prior relative to the cloud's centre; values not given come from the cloud."""
        points, weight, center = cloud
        dim = points.shape[1]
        dof = self.degrees_of_freedom_prior
        if dof is not None and dof <= dim - 1:
            raise InvalidArgumentError(
                f"The parameter 'degrees_of_freedom_prior' should be greater than {dim - 1}, but got "
                f"{dof:.3f}."
            )
        mean = torch.zeros_like(center)
        if self.mean_prior is not None:
            mean = checked_parameter(self.mean_prior, (dim,), "mean_prior", points.device) - center
        kind = self.covariance_type
        if self.covariance_prior is None:
            spread = unbiased_covariance(points, weight, float(self.reg_covar), kind)
        else:
            shape = (dim, dim) if kind == "full" else type_shape(kind, 1, dim)
            given = torch.as_tensor(self.covariance_prior)
            given = given[None] if kind in ("diag", "spherical") else given
            given = checked_parameter(given, shape, "covariance_prior", points.device)
            spread = expand(given, kind, 1, dim).reshape(dim, dim)
            safe_cholesky(check_symmetric(spread[None], "covariance_prior"), "covariance_prior")
        gamma, beta = self.weight_concentration_prior, self.mean_precision_prior
        return Prior(
            center.new_tensor(1 / self.n_components if gamma is None else float(gamma)),
            center.new_tensor(1.0 if beta is None else float(beta)),
            mean,
            center.new_tensor(dim if dof is None else float(dof)),
            spread,
        )

    def score_samples_predictive(self, X: Array) -> Array:
        """log p(x | X) of each point, (N,), nats, given all fitted points and the prior.

        This is a mixture of Student-t densities. It is wider than `score_samples`, above all for components
        with few points.
        """
        points = self._as_points(X)
        return self._as_kind_of(X, log_predictive(points, self._posterior(), self._fitted_type))

    def _posterior(self) -> Posterior:
        self._fitted()
        if "concentration" not in self._buffers:
            raise NotFittedError(
                f"This {type(self).__name__} has given parameters and no posterior; fit it to points first."
            )
        dof, covariances = self.degrees_of_freedom, self._typed_covariances()
        return Posterior(self.concentration, self.mean_precision, self.means, dof, covariances)

    @property
    def support_(self) -> Array:
        """Expected number of points N_k of each component, (K,)."""
        return self._as_fit_kind(self._posterior().mean_precision - self.prior_mean_precision)

    @property
    def n_components_used_(self) -> int:
        """Number of components that explain at least one point: N_k, rounded, is above zero."""
        return int((torch.as_tensor(self.support_).round() > 0).sum())

    @property
    def weight_concentration_(self) -> Array | tuple[Array, Array]:
        """Dirichlet parameters (K,), or the Beta parameters of the sticks, (K,) each."""
        rows = [self._as_fit_kind(row) for row in self._posterior().concentration]
        return (rows[0], rows[1]) if len(rows) == 2 else rows[0]

    @property
    def degrees_of_freedom_(self) -> Array | float:
        """ν (K,); of tied covariances one number."""
        value = self._posterior().degrees_of_freedom
        return float(value[0]) if self._fitted_type == "tied" else self._as_fit_kind(value)

    @property
    def covariance_prior_(self) -> Array | float:
        """W₀⁻¹: (D, D), of diagonal covariances (D,), of spherical ones a number."""
        self._posterior()
        value = compact(self.prior_covariance[None], self._fitted_type)
        value = value if self._fitted_type == "tied" else value[0]
        return self._as_fit_kind(value) if value.ndim else float(value)

    mean_precision_ = _posterior_attribute("mean_precision", "β (K,).")
    weight_concentration_prior_ = _posterior_attribute("prior_concentration", "γ₀.")
    mean_precision_prior_ = _posterior_attribute("prior_mean_precision", "β₀.")
    mean_prior_ = _posterior_attribute("prior_mean", "m₀ (D,).")
    degrees_of_freedom_prior_ = _posterior_attribute("prior_degrees_of_freedom", "ν₀.")

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        k, dim = self.means.shape
        shapes: dict[str, tuple[int, ...]] = {"mean_precision": (k,), "degrees_of_freedom": (k,)}
        shapes |= {"prior_mean": (dim,), "prior_covariance": (dim, dim)}
        for name in self._extra_names if tensors else ():
            if name not in tensors:
                raise InvalidArgumentError(f"The posterior lacks {name}; pass all of its tensors, or none.")
            shape, value = tuple(tensors[name].shape), tensors[name]
            expected = [(1, k), (2, k)] if name == "concentration" else [shapes.get(name, ())]
            least = dim - 1 if "degrees_of_freedom" in name else 0
            signed = name in ("prior_mean", "prior_covariance")
            valid = bool(torch.isfinite(value).all()) and (signed or bool((value > least).all()))
            if shape not in expected or value.dtype != torch.float64 or not valid:
                raise InvalidArgumentError(
                    f"{name} is {value.dtype} {shape}; expected finite numbers above {least}, float64 "
                    f"{expected[-1]}."
                )
        super()._set_extra(tensors)

    def _transformed_extra(self, rotation: Tensor, translation: Tensor) -> dict[str, Tensor]:
        extra = self._extra_tensors()
        if extra:
            extra["prior_mean"] = rotation @ extra["prior_mean"] + translation
            extra["prior_covariance"] = rotation @ extra["prior_covariance"] @ rotation.T
        return extra
