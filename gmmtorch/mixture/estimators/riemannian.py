"""RiemannianGaussianMixture: ascent of the likelihood (Hosseini & Sra, 2015 and 2020; thesis 2.1.5).

With y = [x; 1] a component is one zero-mean Gaussian with a (D+1) × (D+1) covariance S_k, which at the
optimum equals [[Σ + μμᵀ, μ], [μᵀ, 1]]. The objective, over (SPD manifold)^K and log-weights η, is

    f = Σ_n p_n log Σ_k softmax(η)_k q(x_n | S_k) / Σ_n p_n,
    log q(x | S) = ½ − D/2 log 2π − ½ log|S| − ½ (yᵀS⁻¹y + ε tr Σ⁻¹).

ε = `reg_covar` is the variance (m²) of a blur: log q is the expected log-density of a point with
isotropic noise around x, like that of a cell of points in `exact`. The blur bounds f. The M-step of f is
EM's, except that ε, which EM adds to the covariance, is also in the E-step. S_k may have a last entry
s ≠ 1; q is then a Gaussian times √(e/s) e^(−1/2s) ≤ 1, so f is a lower bound of the log-likelihood.

The metric is affine-invariant. S_k is stored as a frame H_k with H_k S_k H_kᵀ = I, and tangent vectors
as symmetric matrices Ξ in that frame. The exponential map is S ← H⁻¹ exp(Ξ) H⁻ᵀ, that is
H ← exp(−Ξ/2) H. The inner product is tr(Ξ Ξ'), and parallel transport along the geodesic is the
identity. Quasi-Newton steps on the manifold are therefore Euclidean steps on the entries of Ξ. In the
frame the gradient is ½ (H M_k Hᵀ − N_k I), M_k = Σ γ yyᵀ: it follows from the statistics of an E-step,
and is N_k/2 times the step of EM. The first guess of the inverse Hessian removes that factor. Library
optimisers assume a vector space, so `ascend` is our own (Nocedal & Wright, 2006, chapters 3, 5 and 7).
"""

from __future__ import annotations

import functools
import math
from collections import deque
from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from gmmtorch.errors import NumericalError
from gmmtorch.linalg import inverse_factor, pack_symmetric, safe_cholesky, triangle_indices, unpack_symmetric
from gmmtorch.mixture.em import by_type
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.initialization import initialize
from gmmtorch.mixture.em.loop import EMResult, OnIteration
from gmmtorch.mixture.estimator import Cloud, MixtureEstimator
from gmmtorch.mixture.validation import RandomState, as_generator

_LONGEST_GUESS = 2.0  # limit of ‖Ξ‖ for steps by the first guess of the Hessian
_LEAST_SHARE = 0.1  # smallest share of a component in that guess, relative to 1/K
_LONGEST_STEP = 4.0  # limit of ‖Ξ‖ for any step: a variance changes by e⁴ at most
_MEMORY = 10  # steps that L-BFGS stores
_ARMIJO = 1e-4  # share of the predicted gain that a step must reach
_SLOPE_LEFT = 0.9  # largest remaining share of the slope (the curvature condition)
_TRIALS = 30  # lengths tried along one direction


@dataclass(eq=False, repr=False)
class RiemannianGaussianMixture(MixtureEstimator):
    """Gaussian mixture fitted by L-BFGS on the manifold of covariances.

    Suitable for overlapping components and a small tolerance: five clusters that hide one another
    (20 000 points, tol=1e-6) take 55 iterations and 0.30 s to the likelihood that takes EM 294
    iterations and 0.76 s. On surfaces, which overlap little, it equals EM from k-means (20 000 points of
    a lidar scan, K=100: 0.7 s for both, held-out −3.48 and −3.51 nats) and is worse than EM from random
    points (PSNR2 89 and 93 dB).

    Args:
        n_components: K, at most the number of points.
        tol: converged if an iteration gains less, and an EM step would gain less too (nats per point).
        reg_covar: ε, the variance of a blur of the points, in their squared unit (m²); EM adds it to
            each variance.
        max_iter: largest number of iterations of each start.
        n_init: number of starts; the one with the best likelihood is kept.
        init_params: as in `GaussianMixture`, without "auto".
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a random seed.
        dtype: of the exponentials. With "float32" the ascent stops when gains are below 1e-8 nats.

    `lower_bounds_` contains the mean log-likelihood of the blurred points after each iteration.
    """

    n_components: int = 1
    _: KW_ONLY
    tol: float = 1e-3
    reg_covar: float = 1e-6
    max_iter: int = 100
    n_init: int = 1
    init_params: str = "kmeans"
    random_state: RandomState = None
    dtype: str = "float64"

    def _learn(self, cloud: Cloud, on_iteration: OnIteration | None) -> None:
        points, weight, center = cloud
        blur, dtype = float(self.reg_covar), em.SOFTMAX_DTYPES[self.dtype]
        likelihood = Likelihood(points, weight, blur, dtype)
        generator = as_generator(self.random_state)

        def run(report: OnIteration | None) -> EMResult[Iterate]:
            first = initialize(self.init_params, points, weight, self.n_components, blur, generator)
            start, tol = likelihood.at(first), float(self.tol)
            return EMResult(*ascend(start, tol=tol, max_iter=self.max_iter, on_iteration=report))

        best = self._best_start(run, on_iteration)
        mixture = best.parameters.parameters()
        safe_cholesky(mixture.covariances)
        if blur == 0:
            check_thickness(mixture, points)
        self._store_fit(mixture, center, best.lower_bounds, best.converged)


class Frames(NamedTuple):
    """H_k in parts: H_k [x; 1] = A_k (x − μ_k) + b_k, with Aᵀb = 0, Σ⁻¹ = AᵀA and 1/s = ‖b‖².

    linear: A (K, D+1, D); means: μ (K, D); offset: b (K, D+1).
    """

    linear: Tensor
    means: Tensor
    offset: Tensor


@dataclass(frozen=True)
class Likelihood:
    """The objective f for centred points (N, D) with weights (N,), float64. blur: ε, m²."""

    points: Tensor
    weight: Tensor
    blur: float
    softmax_dtype: torch.dtype = torch.float64

    def at(self, parameters: Parameters) -> Iterate:
        """f at a mixture: S_k of its means and covariances, with s = 1."""
        weights, means, covariances = parameters
        whiten = inverse_factor(safe_cholesky(covariances)).mT
        linear = nn.functional.pad(whiten, (0, 0, 0, 1))
        offset = nn.functional.pad(torch.zeros_like(means), (0, 1), value=1.0)
        return self.evaluate(Frames(linear, means, offset), torch.log(weights.clamp_min(1e-300)))

    def evaluate(self, frames: Frames, log_weights: Tensor) -> Iterate:
        """f and its gradient for frames of K components and log-weights η (K,), not necessarily
        normalised.
        """
        linear, means, offset = frames
        log_weights = torch.log_softmax(log_weights, 0)
        whiten = torch.linalg.qr(linear).R  # Σ⁻¹ = RᵀR
        inverse = inverse_factor(whiten.mT).contiguous()
        covariances = inverse @ inverse.mT
        length = offset.square().sum(1)
        blurred = self.blur * linear @ linear.mT
        log_factor = 0.5 * (1 + length.log() - length - blurred.diagonal(dim1=-2, dim2=-1).sum(-1))
        count, first, second, value = self._moments(
            Parameters((log_weights + log_factor).exp(), means, covariances)
        )
        # H M Hᵀ, from moments about the means.
        mixed = (linear @ first[:, :, None]) * offset[:, None, :]
        scatter = linear @ second @ linear.mT + mixed + mixed.mT
        scatter = scatter + count[:, None, None] * (offset[:, :, None] * offset[:, None, :] + blurred)
        eye = torch.eye(offset.shape[1], dtype=offset.dtype, device=offset.device)
        half_excess = 0.5 * (scatter - count[:, None, None] * eye)
        share = log_weights.exp()
        gradient = pack_tangent(half_excess, count - share)
        # 2/N_k turns the gradient into EM's step. The limit keeps steps short for components with few points.
        size = torch.stack([count, share], 1).clamp_min(_LEAST_SHARE / len(count))
        scale = torch.cat([2 / size[:, :1].expand(-1, gradient.shape[1] - 1), 1 / size.amax(1, True)], 1)
        reach = (scale * gradient)[:, :-1].norm(dim=1, keepdim=True) / _LONGEST_GUESS
        scale[:, :-1] /= reach.clamp_min(1)
        return Iterate(self, frames, covariances, log_weights, value, gradient, scale)

    def _moments(self, parameters: Parameters) -> tuple[Tensor, Tensor, Tensor, float]:
        """Moments divided by Σp: N (K,), Σγ(x−μ) (K, D), Σγ(x−μ)(x−μ)ᵀ (K, D, D); and f."""
        factors = by_type.Factors(parameters, "full")
        k, dim = parameters.means.shape
        linear = by_type.has_linear_form(k, dim, "full") and not bool(factors.lost_digits())
        given = self.points, self.weight, factors, self.softmax_dtype, linear
        sums, value = by_type.expected_moments(*given, rows=self._rows)
        (count, means, covariances), _ = sums.moments()
        offset, total = means - parameters.means, self.weight.sum()
        count = count / total
        second = count[:, None, None] * (covariances + offset[:, :, None] * offset[:, None, :])
        return count, count[:, None] * offset, second, float(value / total)

    @functools.cached_property
    def _rows(self) -> tuple[Tensor, Tensor] | None:
        return by_type.rows_of_few_dimensions(self.points, self.weight)


@dataclass(frozen=True)
class Iterate:
    """A point of the manifold, with f and its gradient. Tangent vectors are (K, 1 + (D+1)(D+2)/2).

    Each row of a tangent vector has the entries of Ξ, as in `pack_tangent`, and the change of η.
    """

    likelihood: Likelihood
    frames: Frames
    covariances: Tensor
    log_weights: Tensor
    value: float
    gradient: Tensor
    inverse_hessian: Tensor

    def bounded(self, direction: Tensor) -> Tensor:
        """The direction with a limited norm in each component.

        Outdated curvature can give an arbitrarily long step to a component that loses its points.
        """
        return direction / (direction.norm(dim=1, keepdim=True) / _LONGEST_STEP).clamp_min(1)

    def move(self, tangent: Tensor) -> Iterate:
        """H ← exp(−Ξ/2) H and η ← η + Δη; then x is taken relative to the new means."""
        matrices, change = unpack_tangent(tangent, self.frames.offset.shape[1])
        spread = torch.linalg.matrix_exp(-0.5 * matrices)
        linear = spread @ self.frames.linear
        offset = (spread @ self.frames.offset[:, :, None]).squeeze(-1)
        basis, factor = torch.linalg.qr(linear)
        along = basis.mT @ offset[:, :, None]
        shift = torch.linalg.solve_triangular(factor, along, upper=True).squeeze(-1)
        offset = offset - (basis @ along).squeeze(-1)
        frames = Frames(linear, self.frames.means - shift, offset)
        return self.likelihood.evaluate(frames, self.log_weights + change)

    def parameters(self) -> Parameters:
        """The mixture, with s = 1."""
        return Parameters(self.log_weights.exp(), self.frames.means, self.covariances)


def pack_tangent(matrices: Tensor, change: Tensor) -> Tensor:
    """Rows [Ξ, Δη] of symmetric Ξ (K, D+1, D+1) and Δη (K,). Their dot products are tr ΞΞ' + Δη Δη'."""
    rows, cols = triangle_indices(matrices.shape[-1], matrices.device)
    entries = pack_symmetric(matrices) * torch.where(rows == cols, 1.0, math.sqrt(2)).to(matrices)
    return torch.cat([entries, change[:, None]], 1)


def unpack_tangent(tangent: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Ξ (K, D+1, D+1) and Δη (K,); the inverse of `pack_tangent`. size: D + 1."""
    rows, cols = triangle_indices(size, tangent.device)
    entries = tangent[:, :-1] / torch.where(rows == cols, 1.0, math.sqrt(2)).to(tangent)
    return unpack_symmetric(entries, size), tangent[:, -1]


def check_thickness(parameters: Parameters, points: Tensor) -> None:
    """Raise `NumericalError` if a component is thinner than the rounding of the points' coordinates."""
    least = (16 * torch.finfo(points.dtype).eps * points.abs().max()) ** 2
    thin = (torch.linalg.eigvalsh(parameters.covariances)[:, 0] <= least) & (parameters.weights > 0)
    if bool(thin.any()):
        raise NumericalError(
            f"covariances[{int(thin.nonzero()[0])}] collapsed: its points do not span all dimensions; "
            "raise reg_covar (1e-6 m² is usual)."
        )


Memory = deque[tuple[Tensor, Tensor, float]]
"""The last steps, the falls of the gradient along them, and their products."""


def quasi_newton(point: Iterate, memory: Memory) -> Tensor:
    """The inverse Hessian that the memory implies, times the gradient: the two-loop recursion of L-BFGS."""
    vector, shares = point.gradient, []
    for step, fall, product in reversed(memory):
        shares.append(_dot(step, vector) / product)
        vector = vector - shares[-1] * fall
    vector = point.inverse_hessian * vector
    for (step, fall, product), share in zip(memory, reversed(shares), strict=True):
        vector = vector + (share - _dot(fall, vector) / product) * step
    return vector


def ascend(
    point: Iterate, *, tol: float, max_iter: int, on_iteration: OnIteration | None = None
) -> tuple[Iterate, list[float], bool]:
    """Climb from a point. Returns the final point, the value after each iteration, and whether it converged.

    Converged: an iteration gained less than `tol`, and a step by the first guess of the Hessian would also
    gain less, to second order; or no higher point was found, to rounding. Values never decrease.
    """
    memory, values = Memory(maxlen=_MEMORY), list[float]()
    for iteration in range(max_iter):
        found = _climb(point, memory)
        gain = found.value - point.value
        point = found
        values.append(point.value)
        if on_iteration is not None:
            on_iteration(iteration + 1, point.value)
        predicted = 0.5 * _dot(point.gradient, point.inverse_hessian * point.gradient)
        if gain == 0 or max(gain, predicted) < tol:
            return point, values, True
    return point, values, False


def _climb(point: Iterate, memory: Memory) -> Iterate:
    """A higher point, or the same point if there is none.

    Clears the memory if its direction does not ascend.
    """
    while True:
        direction = point.bounded(quasi_newton(point, memory))
        length, found = search(point, direction)
        if length > 0:
            step, fall = length * direction, point.gradient - found.gradient
            product = _dot(step, fall)
            if product > 1e-12 * math.sqrt(_dot(step, step) * _dot(fall, fall)):
                memory.append((step, fall, product))
            return found
        if not memory:
            return point
        memory.clear()


def search(point: Iterate, direction: Tensor) -> tuple[float, Iterate]:
    """Step length along a direction, and the point there; 0 and `point` if the direction does not ascend.

    Steps that gain too little are halved, and steps that leave too steep a slope are doubled, until the
    weak Wolfe conditions hold (Nocedal & Wright, 3.6).
    """
    slope = _dot(point.gradient, direction)
    best = (0.0, point)
    if not slope > 1e-16 * abs(point.value):
        return best
    low, high, length = 0.0, math.inf, 1.0
    for _ in range(_TRIALS):
        try:
            found = point.move(length * direction)
        except NumericalError:  # the point cannot be computed
            found = None
        if found is None or not found.value >= point.value + _ARMIJO * length * slope:
            high = length
        else:
            best, low = (length, found), length
            if _dot(found.gradient, direction) <= _SLOPE_LEFT * slope:
                break
        length = (low + high) / 2 if high < math.inf else 2 * low
    return best


def _dot(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum())
