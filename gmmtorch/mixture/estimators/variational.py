"""VariationalGaussianMixture: a posterior over mixtures, in which unneeded components lose their weight.

    p(μ_k, Λ_k) = N(μ_k | m₀, (β₀Λ_k)⁻¹) Wishart(Λ_k | W₀, ν₀)
    p(π)        = Dirichlet(γ₀, …, γ₀), or for a Dirichlet process π_k = v_k Π_{j<k} (1 − v_j) with
                  sticks v_k ~ Beta(1, γ₀)

Given the moments of each component's points, the posterior has the same form (`update`). Its expected
log-density is that of Gaussians with modified weights (`expected_log_density`), so variational Bayes
uses the E-step of EM, see `variational_step` (Bishop, 2006, section 10.2; Blei & Jordan, 2006).
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from numbers import Integral
from typing import Any, ClassVar, NamedTuple

import torch
from sklearn.utils._param_validation import Interval, StrOptions
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import chunk_elements
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mixture.density import NotFittedError
from gmmtorch.mixture.em import by_type, loop
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import (
    COVARIANCE_TYPES,
    LOG_2PI,
    Parameters,
    compact,
    constrain,
    expand,
    type_shape,
)
from gmmtorch.mixture.em.initialization import initialize
from gmmtorch.mixture.em.loop import EMResult, OnIteration, run_em
from gmmtorch.mixture.estimator import ABOVE_ZERO, COUNT, Cloud, MixtureEstimator
from gmmtorch.mixture.validation import Array, RandomState, as_generator, checked_parameter

WEIGHT_PRIORS = ("dirichlet_process", "dirichlet_distribution")


class Prior(NamedTuple):
    """γ₀ (), β₀ (), m₀ (D,), ν₀ () and W₀⁻¹ (D, D); a typical covariance is W₀⁻¹/ν₀."""

    concentration: Tensor
    mean_precision: Tensor
    mean: Tensor
    degrees_of_freedom: Tensor
    covariance: Tensor


class Posterior(NamedTuple):
    """Posterior of K components.

    concentration: (2, K) the Beta parameters of the sticks, or (1, K) the Dirichlet parameters.
    mean_precision: β (K,), the number of points that determine each mean. means: m (K, D).
    degrees_of_freedom: ν (K,). covariances: W⁻¹/ν, the inverse of the expected precision, in the shape of the
    covariance type.
    """

    concentration: Tensor
    mean_precision: Tensor
    means: Tensor
    degrees_of_freedom: Tensor
    covariances: Tensor


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

    # -- learning ---------------------------------------------------------------------------------

    def _learn(self, cloud: Cloud, on_iteration: OnIteration | None) -> None:
        prior = self._prior(cloud)
        generator = as_generator(self.random_state)
        step = variational_step(
            cloud.points,
            cloud.weight,
            prior,
            self.weight_concentration_prior_type == "dirichlet_process",
            float(self.reg_covar),
            em.SOFTMAX_DTYPES[self.dtype],
            self.covariance_type,
        )

        def run(report: OnIteration | None) -> EMResult[Posterior]:
            return run_em(
                step,
                self._first_posterior(cloud, prior, generator),
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

    def _first_posterior(self, cloud: Cloud, prior: Prior, generator: torch.Generator) -> Posterior:
        """Posterior of the initial moments, or of the last fit, relative to the cloud's centre."""
        if self._continues():
            last = Posterior(*(value.to(cloud.points.device) for value in self._posterior()))
            self._check_continues(cloud.points)
            return last._replace(means=last.means - cloud.center)
        k, kind, reg = self.n_components, self.covariance_type, float(self.reg_covar)
        first = initialize(self.init_params, cloud.points, cloud.weight, k, reg, generator, kind)
        # Stick-breaking depends on the order of components. With the largest component first the bound is
        # best and does not depend on the frame.
        order = first.weights.argsort(descending=True, stable=True)
        count = first.weights[order] * cloud.weight.sum()
        covariances = first.covariances if kind == "tied" else first.covariances[order]
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

    # -- the posterior ----------------------------------------------------------------------------

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


# -- the posterior, given moments -----------------------------------------------------------------


def unbiased_covariance(
    points: Tensor, weight: Tensor, thickness: float, covariance_type: str = "full"
) -> Tensor:
    """Covariance (D, D), of the type, of points whose mean is the origin.

    In directions in which the points are flat, the variance is `thickness` (m²) instead of zero.
    """
    total = float(weight.sum())
    # No unbiased estimate exists below two points; W/2 continues W − 1 continuously.
    count = max(total - 1, total / 2)
    if covariance_type in ("diag", "spherical"):
        rows = max(64, chunk_elements(points.device) // points.shape[1])
        parts = zip(points.split(rows), weight.split(rows), strict=True)
        variances = torch.stack([p @ x.square() for x, p in parts]).sum(0) / count
        flat = ~(variances > 1e-14 * variances.amax())
        variances = torch.where(flat, variances.clamp_min(thickness), variances)
        return constrain(torch.diag(variances)[None], covariance_type)[0]
    covariance = (points * weight[:, None]).T @ points / count
    variances, directions = torch.linalg.eigh(covariance)
    if float(variances[0]) > 1e-14 * float(variances[-1]):
        return covariance
    return (directions * variances.clamp_min(thickness)) @ directions.T


def update(prior: Prior, moments: Parameters, process: bool, covariance_type: str = "full") -> Posterior:
    """The posterior given the points N_k (K,) of each component, their means and their covariances.

    `moments` has N_k in place of weights, and covariances in the shape of the type. process: whether the
    weights have a Dirichlet process prior.
    Bishop (10.58)–(10.63); Blei & Jordan (18)–(19). For other types than full covariances, the Wishart
    factors are the best ones whose scale matrix is of the type: tied ones are equal.
    """
    count, mean, covariance = moments
    mean_precision = prior.mean_precision + count
    degrees_of_freedom = prior.degrees_of_freedom + count
    offset = mean - prior.mean
    pull = count * prior.mean_precision / mean_precision
    scatter = compact(prior.covariance[None], covariance_type)
    if covariance_type == "full":
        outer = offset[:, :, None] * offset[:, None, :]
        scatter = scatter + count[:, None, None] * covariance + pull[:, None, None] * outer
    elif covariance_type == "tied":
        scatter = scatter + (count.sum() * covariance + (pull[:, None] * offset).T @ offset) / len(count)
        degrees_of_freedom = degrees_of_freedom.mean().expand_as(degrees_of_freedom).clone()
    elif covariance_type == "diag":
        scatter = scatter + count[:, None] * covariance + pull[:, None] * offset.square()
    else:
        scatter = scatter + count * covariance + pull * offset.square().mean(1)
    if process:  # 1 + N_k for taking stick k, and γ₀ + Σ_{j>k} N_j for passing it
        later = torch.cat([count.flip(0).cumsum(0).flip(0)[1:], count.new_zeros(1)])
        concentration = torch.stack([1 + count, prior.concentration + later])
    else:
        concentration = (prior.concentration + count)[None]
    return Posterior(
        concentration,
        mean_precision,
        (prior.mean_precision * prior.mean + count[:, None] * mean) / mean_precision[:, None],
        degrees_of_freedom,
        scatter / _of_each(degrees_of_freedom, scatter, covariance_type),
    )


def _of_each(value: Tensor, covariances: Tensor, covariance_type: str) -> Tensor:
    """A value (K,) of each component, in a shape that broadcasts with covariances; tied: that of all."""
    return value[0] if covariance_type == "tied" else value.view(-1, *[1] * (covariances.ndim - 1))


def expected_weights(concentration: Tensor) -> Tensor:
    """E[π] (K,). For a Dirichlet process, the expected weights of the K sticks, scaled to add up to one."""
    if concentration.shape[0] == 1:
        return concentration[0] / concentration.sum()
    share = concentration / concentration.sum(0)
    passed = torch.cat([share.new_ones(1), share[1].cumprod(0)[:-1]])
    return share[0] * passed / (share[0] * passed).sum()


def expected_log_weights(concentration: Tensor) -> Tensor:
    """E[log π] (K,). Bishop (10.66); for sticks E[log v_k] + Σ_{j<k} E[log(1 − v_j)]."""
    expected = torch.digamma(concentration)
    if concentration.shape[0] == 1:
        return expected[0] - torch.digamma(concentration.sum())
    expected = expected - torch.digamma(concentration.sum(0))
    return expected[0] + torch.cat([expected.new_zeros(1), expected[1].cumsum(0)[:-1]])


def expected_log_density(posterior: Posterior) -> tuple[Tensor, Parameters]:
    """ω (K,) and Gaussians such that E[log π_k + log N(x | μ_k, Λ_k⁻¹)] = ω_k + log N(x | m_k, Σ_k).

    Σ = E[Λ]⁻¹, and ω is E[log π] + ½(E[log|Λ|] − log|E[Λ]|) − D/2β. Bishop (10.64)–(10.66).
    """
    dim = posterior.means.shape[1]
    dof = posterior.degrees_of_freedom
    steps = torch.arange(dim, dtype=dof.dtype, device=dof.device)
    log_det = torch.digamma(0.5 * (dof[:, None] - steps)).sum(1) - dim * torch.log(0.5 * dof)
    weight = expected_log_weights(posterior.concentration)
    weight = weight + 0.5 * (log_det - dim / posterior.mean_precision)
    # Log-weights a million nats below the largest have no effect, but must not be infinite.
    weight = weight.clamp_min(float(weight.max()) - 1e6)
    return weight, Parameters(torch.ones_like(weight), posterior.means, posterior.covariances)


def assigned_log_density(moments: Parameters, log_weight: Tensor, factors: by_type.Factors) -> Tensor:
    """Σ_n Σ_k γ_nk (ω_k + log N(x_n | m_k, Σ_k)), a scalar, of points with moments (N_k, x̄_k, S_k).

    Covariances have the shape of their type. factors: of weights 1, m and Σ.
    """
    count, mean, covariance = moments
    whiten, offset = factors.whiten, mean - factors.means
    if factors.kind in ("full", "tied"):
        trace = (whiten.mT @ whiten * covariance).sum((-2, -1))
        shift = whiten @ offset[:, :, None]
    else:
        n_equal = factors.dim if factors.kind == "spherical" else 1
        trace = (whiten.square() * covariance).view(len(count), -1).sum(1) * n_equal
        shift = offset * whiten.view(len(count), -1)
    squared = trace + shift.square().flatten(1).sum(1)
    return (count * (log_weight + factors.constant - 0.5 * squared)).sum()


def log_evidence(
    prior: Prior, posterior: Posterior, n_points: float, covariance_type: str = "full"
) -> Tensor:
    """log p(X | assignments) + log p(assignments), nats, of the points that `posterior` includes.

    The ratio of the normalisers of posterior and prior, times (2π)^(−ND/2). Plus the entropy of the
    responsibilities, it is the lower bound of log p(X) once q(θ) is optimal for them. For sticks it is that
    of the whole process: components beyond the K-th have no points and equal the prior.
    """
    dim = prior.mean.shape[0]
    dof = posterior.degrees_of_freedom
    log_det = _log_det(posterior.covariances, covariance_type, dim) + dim * dof.log()
    components = _log_wishart(dof, log_det, dim)
    first = _log_det(compact(prior.covariance[None], covariance_type), covariance_type, dim)
    components = components - _log_wishart(prior.degrees_of_freedom[None], first, dim)
    components = components + 0.5 * dim * torch.log(prior.mean_precision / posterior.mean_precision)
    sticks = posterior.concentration
    if sticks.shape[0] == 2:
        first = torch.stack([torch.ones_like(prior.concentration), prior.concentration])[:, None]
        weights = (_log_dirichlet(sticks) - _log_dirichlet(first)).sum()
    else:
        weights = _log_dirichlet(sticks[0]) - _log_dirichlet(prior.concentration.expand(sticks.shape[1]))
    return components.sum() + weights - 0.5 * n_points * dim * LOG_2PI


def _log_det(covariances: Tensor, kind: str, dim: int) -> Tensor:
    """log |Σ| of covariances in the shape of their type: (K,), tied (1,)."""
    if kind in ("full", "tied"):
        factors = safe_cholesky(covariances.view(-1, dim, dim))
        return 2 * torch.log(factors.diagonal(dim1=-2, dim2=-1)).sum(1)
    log = covariances.log()
    return log.sum(1) if kind == "diag" else dim * log


def _log_wishart(degrees_of_freedom: Tensor, log_det: Tensor, dim: int) -> Tensor:
    """log ∫ |Λ|^((ν−D−1)/2) exp(−½ tr W⁻¹Λ) dΛ (K,), with log |W⁻¹| (K,). Bishop (B.79)."""
    half = 0.5 * degrees_of_freedom
    return half * (dim * math.log(2) - log_det) + torch.mvlgamma(half, dim)


def _log_dirichlet(concentration: Tensor) -> Tensor:
    """Logarithm of the multivariate beta function, over the first axis."""
    return torch.lgamma(concentration).sum(0) - torch.lgamma(concentration.sum(0))


def log_predictive(points: Tensor, posterior: Posterior, covariance_type: str = "full") -> Tensor:
    """log p(x | X) (N,) of new points (N, D): Σ_k E[π_k] Student-t(x | m_k, L_k⁻¹, ν_k + 1 − D).

    The scale L_k⁻¹ is W_k⁻¹ (1 + β_k) / (β_k (ν_k + 1 − D)). Bishop (10.81)–(10.82).
    """
    k, dim = posterior.means.shape
    dof = posterior.degrees_of_freedom + 1 - dim
    ratio = posterior.degrees_of_freedom / dof * (1 + 1 / posterior.mean_precision)
    weights = expected_weights(posterior.concentration)
    factors = by_type.Factors(Parameters(weights, posterior.means, posterior.covariances), covariance_type)
    constant = torch.lgamma(0.5 * (dof + dim)) - torch.lgamma(0.5 * dof) + factors.constant
    constant = constant - 0.5 * dim * torch.log(0.5 * dof * ratio)
    joint = factors.direct()

    def log_sum(part: Tensor) -> Tensor:
        squared = 2 * (factors.constant[:, None] - joint(part))
        term = torch.log1p(squared / (ratio * dof)[:, None])
        return torch.logsumexp(constant[:, None] - 0.5 * (dof + dim)[:, None] * term, 0)

    rows = by_type.rows_of_chunk(k, dim, covariance_type, points.device)
    return torch.cat([log_sum(part) for part in points.split(rows)])


def variational_step(
    points: Tensor,
    sample_weight: Tensor,
    prior: Prior,
    process: bool,
    reg_covar: float,
    softmax_dtype: torch.dtype,
    covariance_type: str = "full",
) -> loop.Step[Posterior]:
    """One iteration for `loop.run_em`: responsibilities given a posterior, and their posterior.

    The bound (nats per point) is that of the returned posterior. Covariances of the points of a component
    include `reg_covar` (m²).
    """
    features = em.quadratic_features(points) if points.shape[1] <= 3 else None
    total = float(sample_weight.sum())
    kind = covariance_type

    def step(posterior: Posterior) -> tuple[Posterior, float]:
        log_weight, gaussians = expected_log_density(posterior)
        factors = by_type.Factors(gaussians, kind)
        if features is None:
            found, value = _typed_moments(
                points, sample_weight, log_weight, factors, reg_covar, softmax_dtype
            )
        else:
            matrices = expand(gaussians.covariances, kind, *gaussians.means.shape)
            given = log_weight, gaussians._replace(covariances=matrices), reg_covar, softmax_dtype
            found, value = _expected_moments(features, points, sample_weight, *given)
            found = by_type.compacted(found, kind)
        new = update(prior, found, process, kind)
        plain = found.covariances.clone()
        diagonal = plain.diagonal(dim1=-2, dim2=-1) if kind in ("full", "tied") else plain
        diagonal.sub_(reg_covar)
        entropy = value - assigned_log_density(found._replace(covariances=plain), log_weight, factors)
        return new, float(entropy + log_evidence(prior, new, total, kind)) / total

    return step


def _expected_moments(
    features: Tensor,
    points: Tensor,
    sample_weight: Tensor,
    log_weight: Tensor,
    gaussians: Parameters,
    reg_covar: float,
    softmax_dtype: torch.dtype,
) -> tuple[Parameters, Tensor]:
    """Moments of γ_nk ∝ exp(ω_k) N(x_n | m_k, Σ_k), and Σ_n p_n times the log of their normaliser.

    Computed as two products with `features`, or directly from `points` if the products would cancel.
    """
    weights = torch.exp(log_weight - log_weight.max())
    unnormalised = gaussians._replace(weights=weights)
    if not em.is_ill_conditioned(unnormalised):
        natural = em.natural_parameters(gaussians)
        natural[:, 0] += log_weight
        sums, value = em.expectation(features, sample_weight, natural, softmax_dtype)
        found = em.maximization(sums, reg_covar)._replace(weights=sums[:, 0])
        if not em.has_cancelled(sums, found._replace(weights=(sums[:, 0] > 1e-9).to(sums))):
            return found, value
    found, value = by_type.direct_step(points, sample_weight, unnormalised, reg_covar)
    total = sample_weight.sum()
    return found._replace(weights=found.weights * total), value + log_weight.max() * total


def _typed_moments(
    points: Tensor,
    sample_weight: Tensor,
    log_weight: Tensor,
    factors: by_type.Factors,
    reg_covar: float,
    softmax_dtype: torch.dtype,
) -> tuple[Parameters, Tensor]:
    """The same with the arithmetic of the covariance type, for many dimensions."""
    weighted = copy.copy(factors)
    weighted.constant = factors.constant + log_weight
    gather = functools.partial(by_type.expected_moments, points, sample_weight, weighted, softmax_dtype)
    found = by_type.exact_step(gather, weighted, reg_covar, None, linear=True)
    return found.parameters._replace(weights=found.points), found.value
