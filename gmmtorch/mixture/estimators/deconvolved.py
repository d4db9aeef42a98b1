"""DeconvolvedGaussianMixture: the mixture of the noise-free positions of points with known noise.

A point is x_n = v_n + ε_n, with v_n from the mixture and ε_n ~ N(0, R_n), R_n known. So x_n has the
density Σ_k π_k N(x | μ_k, T_nk), T_nk = Σ_k + R_n, and EM learns the mixture of the noise-free
positions v (Bovy, Hogg & Roweis, 2011). Given component k, v_n has

    mean        b_nk = μ_k + Σ_k T⁻¹(x_n − μ_k) = x_n − R_n T⁻¹(x_n − μ_k)
    covariance  B_nk = Σ_k − Σ_k T⁻¹ Σ_k        = R_n T⁻¹ Σ_k

(the second forms lose no digits if R is small: with R = 0 they are x_n and 0, plain EM). The M-step
uses b in place of x and b bᵀ + B in place of x xᵀ. Moments are relative to the component's last mean.

Each of the N·K pairs has its own covariance T. Two measures keep this fast. Two plain mixtures,
evaluated as matrix products, exclude the pairs without a share in double precision. And small
matrices are stored entry by entry, so that each step of a factorisation is one tensor operation.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.linalg import check_symmetric, safe_cholesky, unpack_symmetric
from gmmtorch.mixture.em import by_type, loop
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.initialization import initialize
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.validation import Array, RandomState, as_generator

_WORTH_SHARING = 256  # points a distinct covariance from which on points are grouped by covariance
_ROUNDING = 1e-13  # of a component's largest variance: a smaller one is rounding error
_CHUNK_ELEMENTS = 1 << 16  # of an N×K block, small enough for the cache of a core
_NEGLIGIBLE = 40.0  # nats below a point's likeliest component: no share in double precision
Entries = list[list[Tensor]]
"""A batch of small matrices, as one tensor per entry."""


@dataclass(eq=False, repr=False)
class DeconvolvedGaussianMixture(MixtureEstimator):
    """Extreme deconvolution (Bovy, Hogg & Roweis, 2011): EM with the noise covariance of every point.

    The fitted mixture is that of the noise-free positions: a wall measured with 2 cm of noise becomes as
    thin as the wall. `score_samples(X)` is the density of such positions; with `noise_covariances` it is
    the density of measurements. Without noise this is plain EM.

    Args:
        n_components: K, at most the number of points.
        tol: EM stops when the mean log-likelihood changes by less (nats per point). EM is slow if noise
            exceeds a component's thickness: after t iterations about R/t of the variance R remains.
        reg_covar: smallest variance of a component in any direction, in the squared unit of the points
            (m²). It is a lower bound, not added as in plain EM: added in every iteration it would
            accumulate here.
        thickness: upper limit of a component's smallest standard deviation (m); None: no limit. With
            reg_covar = thickness² every component has exactly this thickness.
        max_iter: largest number of EM iterations.
        init_params: as in `GaussianMixture`, without "auto".
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a random seed.

    Fitted attributes: those of every `MixtureEstimator`. `lower_bound_` is the mean log-likelihood of
    the points with their noise, nats. It never decreases from one iteration to the next.
    """

    n_components: int = 1
    _: KW_ONLY
    tol: float = 1e-3
    reg_covar: float = 1e-6
    thickness: float | None = None
    max_iter: int = 100
    init_params: str = "kmeans"
    random_state: RandomState = None

    def fit(  # type: ignore[override]  # the noise comes before on_iteration
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        noise_covariances: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
    ) -> DeconvolvedGaussianMixture:
        """Fit the mixture of the noise-free positions of points X (N, D), see `MixtureEstimator.fit`.

        noise_covariances: (N, D, D), or (D, D) for all points, m², positive semi-definite; see
        `sensor_model`. None: no noise. The fit is faster if far fewer covariances than points are distinct.
        """
        points, weight, center = self._prepare(X, sample_weight)
        used = None if sample_weight is None else torch.as_tensor(sample_weight) > 0
        noise = checked_noise(noise_covariances, len(X), points)
        noise = noise[used] if used is not None and noise.ndim == 3 else noise
        least = float(self.reg_covar)
        generator = as_generator(self.random_state)
        first = initialize(self.init_params, points, weight, self.n_components, least, generator)
        first = first._replace(covariances=bound_variances(first.covariances, least, self.thickness))
        blocks = group_by_noise(points, weight, noise)
        step = deconvolution_step(blocks, least, self.thickness)
        found = loop.run_em(step, first, tol=self.tol, max_iter=self.max_iter, on_iteration=on_iteration)
        safe_cholesky(found.parameters.covariances)  # raises if a component collapsed in the last step
        self._store_fit(found.parameters, center, found.lower_bounds, found.converged)
        self._warn_unless_converged()
        return self

    def score_samples(self, X: Array, noise_covariances: Array | None = None) -> Array:
        """log p(x) of each point, (N,), nats: of noise-free positions, or of measurements with noise.

        `noise_covariances` as in `fit`. The density is then Σ_k π_k N(x_n | μ_k, Σ_k + R_n).
        """
        if noise_covariances is None:
            return super().score_samples(X)
        points = self._as_points(X)
        noise = checked_noise(noise_covariances, len(X), points)
        center = (self.weights[:, None] * self.means).sum(0)
        parameters = em.Parameters(self.weights, self.means - center, self.covariances)
        return self._as_kind_of(X, log_likelihood(points - center, noise, parameters))

    def check_parameters(self, n_points: int | None = None) -> None:
        super().check_parameters(n_points)
        thickness: object = self.thickness
        least = float(self.reg_covar) ** 0.5
        if thickness is not None and not (
            isinstance(thickness, numbers.Real)
            and 0 < float(thickness) < math.inf
            and least <= float(thickness) * (1 + 1e-9)
        ):
            raise InvalidArgumentError(
                f"thickness={thickness!r} must be None, or a finite length above zero and at least "
                f"√reg_covar = {least:g} m."
            )


def checked_noise(noise: Array | None, n: int, points: Tensor) -> Tensor:
    """Noise covariances (D, D) or (N, D, D), float64, on the device of `points`; zero if None.

    Raises `InvalidArgumentError` unless they are finite, symmetric and positive semi-definite.
    """
    dim = points.shape[1]
    if noise is None:
        return points.new_zeros(dim, dim)
    noise = as_tensor(noise, "noise_covariances", torch.float64, points.device).detach()
    if noise.shape not in ((n, dim, dim), (dim, dim)):
        raise InvalidArgumentError(
            f"noise_covariances has shape {tuple(noise.shape)}; expected ({n}, {dim}, {dim}), one per point, "
            f"or ({dim}, {dim}), the same for all points."
        )
    each = noise.reshape(-1, dim, dim)
    finite = torch.isfinite(each).flatten(1).all(1)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0])
        raise InvalidArgumentError(
            f"noise_covariances[{row}] has NaN or infinite entries; remove such points first."
        )
    check_symmetric(each, "noise_covariances")
    # Semi-definite up to rounding: the added diagonal is far below the noise itself.
    slack = 1e-9 * each.diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(1e-290)
    eye = torch.eye(dim, dtype=noise.dtype, device=noise.device)
    bad = torch.linalg.cholesky_ex(each + slack[:, None, None] * eye)[1] != 0
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"noise_covariances[{row}] = {each[row].tolist()} has a negative eigenvalue."
        )
    return noise


class Block(NamedTuple):
    """Points (n, D) with weights (n,) and either one shared noise covariance (D, D) or one each (n, D, D)."""

    points: Tensor
    weight: Tensor
    noise: Tensor


def group_by_noise(points: Tensor, weight: Tensor, noise: Tensor) -> list[Block]:
    """Points (N, D) with noise (D, D) or (N, D, D), one block per distinct covariance if there are few."""
    if noise.ndim == 2:
        return [Block(points, weight, noise)]
    distinct, group, sizes = torch.unique(noise.flatten(1), dim=0, return_inverse=True, return_counts=True)
    if distinct.shape[0] * _WORTH_SHARING > points.shape[0]:
        return [Block(points, weight, noise)]
    members = group.argsort(stable=True).split(sizes.tolist())
    return [Block(points[rows], weight[rows], noise[rows[0]]) for rows in members]


def expectation(block: Block, parameters: Parameters) -> tuple[Tensor, Tensor]:
    """One E-step: moments of the block relative to the components' means, and Σ_n p_n log p(x_n), ().

    The moments (K, 1 + D + D²) are Σγ, Σγ(b−μ) and Σγ[(b−μ)(b−μ)ᵀ + B].
    """
    if block.noise.ndim == 3:
        return _expectation_each(block, parameters)
    noisy = by_type.Factors(blurred(parameters, block.noise), "full")
    if bool(noisy.lost_digits()):
        each = block.noise.expand(len(block.points), -1, -1)
        return _expectation_each(block._replace(noise=each), parameters)
    return _expectation_shared(block, parameters, noisy)


def log_likelihood(points: Tensor, noise: Tensor, parameters: Parameters) -> Tensor:
    """log Σ_k π_k N(x_n | μ_k, Σ_k + R_n) (N,) of points (N, D) with noise (D, D) or (N, D, D)."""
    noise = noise.expand(points.shape[0], -1, -1)
    return torch.cat([pairs.log_likelihood for _, pairs in pair_chunks(points, noise, parameters)])


def maximization(
    moments: Tensor, parameters: Parameters, min_variance: float = 0.0, thickness: float | None = None
) -> Parameters:
    """M-step from moments about the means of `parameters`, with the limits of `bound_variances`.

    A component that lost all its points keeps its mean and covariance, with weight 0.
    """
    k, dim = parameters.means.shape
    mass, first, second = moments[:, 0], moments[:, 1 : 1 + dim], moments[:, 1 + dim :].view(k, dim, dim)
    alive = mass > 10 * torch.finfo(mass.dtype).eps
    count = torch.where(alive, mass, 1.0)
    shift = first / count[:, None]
    covariances = second / count[:, None, None] - shift[:, :, None] * shift[:, None, :]
    covariances = torch.where(alive[:, None, None], covariances, parameters.covariances)
    return Parameters(
        torch.where(alive, mass, 0.0) / mass.sum(),
        parameters.means + torch.where(alive[:, None], shift, 0.0),
        bound_variances(covariances, min_variance, thickness),
    )


def bound_variances(covariances: Tensor, min_variance: float = 0.0, thickness: float | None = None) -> Tensor:
    """The most likely covariances (K, D, D) within the limits, given those of the unconstrained M-step.

    Every variance is at least `min_variance` (m²), and the smallest is at most `thickness`² (thickness in
    metres).

    The M-step maximises −½N(log|Σ| + tr Σ⁻¹S), with S the unconstrained covariance. For given eigenvalues
    λ₁ ≤ … ≤ λ_D of Σ, tr Σ⁻¹S ≥ Σ s_i/λ_i (von Neumann), with equality if Σ has the eigenvectors of S in
    the same order. The remaining term Σ (log λ_i + s_i/λ_i) decreases up to λ_i = s_i and increases
    beyond it, so every λ_i is s_i clamped to its interval. The upper limit is on the smallest one, where it
    costs least. Therefore EM with these limits never decreases the likelihood. Adding a constant to Σ in
    each iteration would decrease it, and would accumulate because Σ is part of B.
    """
    variances, directions = torch.linalg.eigh(covariances)
    variances = variances.clone()
    if thickness is not None:
        variances[:, 0].clamp_(max=thickness**2)
    floor = (_ROUNDING * variances[:, -1:]).clamp_min(min_variance)
    variances = torch.maximum(variances, floor)
    return (directions * variances[:, None, :]) @ directions.transpose(-2, -1)


def deconvolution_step(
    blocks: list[Block], min_variance: float = 0.0, thickness: float | None = None
) -> Callable[[Parameters], tuple[Parameters, float]]:
    """EM steps for `loop.run_em`: improved parameters, and the mean log-likelihood of the given ones."""
    total = float(sum(block.weight.sum() for block in blocks))

    def step(parameters: Parameters) -> tuple[Parameters, float]:
        found = [expectation(block, parameters) for block in blocks]
        sums = torch.stack([moments for moments, _ in found]).sum(0)
        value = sum(float(likelihood) for _, likelihood in found)
        return maximization(sums, parameters, min_variance, thickness), value / total

    return step


def blurred(parameters: Parameters, noise: Tensor) -> Parameters:
    """The mixture of points with the noise covariance (D, D)."""
    return parameters._replace(covariances=parameters.covariances + noise)


def _expectation_shared(
    block: Block, parameters: Parameters, noisy: by_type.Factors
) -> tuple[Tensor, Tensor]:
    """Sums of plain EM with covariances T = Σ + R; b and B are linear functions of them."""
    dim = block.points.shape[1]
    features = em.quadratic_features(block.points)
    sums, value = em.expectation(features, block.weight, noisy.natural(), torch.float64)
    count, means = sums[:, 0], parameters.means
    first = sums[:, 1 : 1 + dim] - count[:, None] * means
    cross = sums[:, 1 : 1 + dim, None] * means[:, None, :]
    second = unpack_symmetric(sums[:, 1 + dim :], dim) - cross - cross.transpose(-2, -1)
    second = second + count[:, None, None] * means[:, :, None] * means[:, None, :]
    lost = block.noise @ noisy.whiten.mT @ noisy.whiten  # R T⁻¹: b − μ = (I − R T⁻¹)(x − μ)
    gain = torch.eye(dim, dtype=lost.dtype, device=lost.device) - lost
    remaining = count[:, None, None] * (lost @ parameters.covariances)
    moved = (gain @ first[:, :, None]).squeeze(-1)
    second = gain @ second @ gain.transpose(-2, -1) + _symmetric(remaining)
    return torch.cat([count[:, None], moved, second.flatten(1)], 1), value


def _symmetric(matrices: Tensor) -> Tensor:
    return (matrices + matrices.transpose(-2, -1)) / 2


def _expectation_each(block: Block, parameters: Parameters) -> tuple[Tensor, Tensor]:
    """b and B of every pair with a share, summed by component; Σγ B = (Σγ R T⁻¹) Σ."""
    k, dim = parameters.means.shape
    axes = range(dim)
    sums = parameters.means.new_zeros(k, 1 + dim + 2 * dim * dim)
    value = sums.new_zeros(())
    for part, pairs in pair_chunks(block.points, block.noise, parameters):
        value += torch.dot(block.weight[part], pairs.log_likelihood)
        noise = gather_entries(block.noise[part], pairs.row)
        share = torch.exp(pairs.joint - pairs.log_likelihood[pairs.row]) * block.weight[part][pairs.row]
        white = [dot(line, pairs.offset[: len(line)]) for line in pairs.whiten]
        upper = [[line[i] for line in pairs.whiten[i:]] for i in axes]
        pull = [dot(upper[i], white[i:]) for i in axes]  # T⁻¹(x − μ)
        moved = [pairs.offset[i] - dot(noise[i], pull) for i in axes]  # b − μ
        lower = [[dot(upper[i], upper[j][i - j :]) for j in axes[: i + 1]] for i in axes]
        precision = [[lower[max(i, j)][min(i, j)] for j in axes] for i in axes]  # T⁻¹
        columns = [torch.ones_like(share), *moved]
        columns += [moved[i] * moved[j] for i in axes for j in axes]
        columns += [dot(noise[i], precision[j]) for i in axes for j in axes]  # R T⁻¹
        sums.index_add_(0, pairs.component, torch.stack(columns, 1) * share[:, None])
    found, lost = sums.split([1 + dim + dim * dim, dim * dim], 1)
    remaining = _symmetric(lost.reshape(k, dim, dim) @ parameters.covariances)
    return torch.cat([found[:, : 1 + dim], found[:, 1 + dim :] + remaining.flatten(1)], 1), value


class Pairs(NamedTuple):
    """P pairs of one of n points and one of K components that may have a share in it.

    row (P,), component (P,). joint (P,): log π + log N(x | μ, T). log_likelihood (n,): log Σ_k over all
    pairs of a point. whiten: entries (P,) of W, with WᵀW = T⁻¹. offset: entries (P,) of x − μ.
    """

    row: Tensor
    component: Tensor
    joint: Tensor
    log_likelihood: Tensor
    whiten: Entries
    offset: list[Tensor]


def pair_chunks(points: Tensor, noise: Tensor, parameters: Parameters) -> Iterator[tuple[slice, Pairs]]:
    """Chunks of rows of the points with their pairs, without pairs certainly below e^−40 of the largest."""
    bounds = _log_bounds(noise, parameters)
    rows = max(1, _CHUNK_ELEMENTS // parameters.weights.shape[0])
    for begin in range(0, points.shape[0], rows):
        part = slice(begin, begin + rows)
        at_least, at_most = bounds(points[part].detach())
        at_most = torch.maximum(at_most, at_least)  # keeps the most likely pair despite rounding
        row, component = (at_most >= at_least.amax(1, keepdim=True) - _NEGLIGIBLE).nonzero(as_tuple=True)
        yield part, _pairs(points[part], noise[part], parameters, row, component)


def _log_bounds(noise: Tensor, parameters: Parameters) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """A function that bounds log π_k + log N(x | μ_k, Σ_k + R) (n, K) from below and above, for any of the R.

    Because low I ≼ R ≼ high I, the determinant and the quadratic form of Σ + R are between those of
    Σ + low I and Σ + high I. So two plain mixtures, which are fast to evaluate, bound every log-density.
    """
    spread = torch.linalg.eigvalsh(noise)
    low, high = spread[:, 0].amin().clamp_min(0), spread[:, -1].amax()
    eye = torch.eye(noise.shape[-1], dtype=noise.dtype, device=noise.device)
    thin, wide = (by_type.Factors(blurred(parameters, r * eye), "full") for r in (low, high))
    slack = thin.constant - wide.constant  # half the difference of the log-determinants
    if bool(thin.lost_digits()):
        below, above = thin.direct(), wide.direct()
        return lambda x: (below(x).T - slack, above(x).T + slack)
    lower, upper = thin.natural().T, wide.natural().T

    def bounds(points: Tensor) -> tuple[Tensor, Tensor]:
        features = em.quadratic_features(points)
        return features @ lower - slack, features @ upper + slack

    return bounds


def _pairs(points: Tensor, noise: Tensor, parameters: Parameters, row: Tensor, component: Tensor) -> Pairs:
    """Densities and factors of the pairs (row, component). Every row has at least one pair."""
    weights, means, covariances = parameters
    axes = range(points.shape[1])
    own, other = gather_entries(covariances, component), gather_entries(noise, row)
    whiten, half_log_det = _inverse_factor_entries(
        [[own[i][j] + other[i][j] for j in axes[: i + 1]] for i in axes]
    )
    offset = list((points.T.index_select(1, row) - means.T.index_select(1, component)).unbind())
    squared = torch.zeros_like(half_log_det)
    for line in whiten:
        squared = squared + dot(line, offset[: len(line)]).square()
    constant = torch.log(weights).clamp_min(-1e30) - 0.5 * len(axes) * math.log(2 * math.pi)
    joint = constant[component] - half_log_det - 0.5 * squared
    peak = joint.detach().new_empty(points.shape[0])
    peak.scatter_reduce_(0, row, joint.detach(), "amax", include_self=False)
    total = torch.zeros_like(peak).index_add(0, row, torch.exp(joint - peak[row]))
    likelihood = peak + torch.log(total)
    return Pairs(row, component, joint, likelihood, whiten, offset)


def gather_entries(matrices: Tensor, index: Tensor) -> Entries:
    """Entries of the matrices (M, D, D) at an index (P,), each (P,) and contiguous."""
    dim = matrices.shape[-1]
    entries = matrices.flatten(1).T.contiguous().index_select(1, index).unbind()
    return [list(entries[i * dim : (i + 1) * dim]) for i in range(dim)]


def dot(left: list[Tensor], right: list[Tensor]) -> Tensor:
    total = left[0] * right[0]
    for a, b in zip(left[1:], right[1:], strict=True):
        total = torch.addcmul(total, a, b)
    return total


def _inverse_factor_entries(lower: Entries) -> tuple[Entries, Tensor]:
    """L⁻¹ and log|L| of symmetric matrices M = LLᵀ, given by the entries of their lower triangle."""
    dim = len(lower)
    factor: Entries = []
    inverse: Entries = []
    log_det = torch.zeros_like(lower[0][0])
    for i in range(dim):
        row: list[Tensor] = []
        for j in range(i):
            rest = lower[i][j] - dot(row, factor[j][:j]) if j else lower[i][j]
            row.append(rest * inverse[j][j])
        pivot = lower[i][i] - dot(row, row) if i else lower[i][i]
        if not bool((pivot > 0).all()):  # NaN fails too
            raise NumericalError(
                "A component's covariance plus a point's noise is not positive definite; raise reg_covar "
                "(1e-6 m² is usual), and check noise_covariances."
            )
        root = pivot.rsqrt()
        log_det = log_det + 0.5 * pivot.log()
        inverse.append(
            [-dot(row[j:], [inverse[m][j] for m in range(j, i)]) * root for j in range(i)] + [root]
        )
        factor.append([*row, pivot * root])
    return inverse, log_det
