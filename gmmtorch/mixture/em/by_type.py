"""EM steps: each covariance type has the arithmetic that it needs.

Covariances have the shape of their type: full (K, D, D), tied (D, D), diag (K, D), spherical (K,).

 - spherical, diag: log π_k + log N(x|k) is linear in [1, x, |x|²] or [1, x, x²]: products of O(NKD).
 - tied: the same as spherical after one whitening, x ↦ L⁻¹ x.
 - full, few dimensions: linear in [1, x, x_i x_j (i ≤ j)], see `exact`; its products are the smallest. Up to
   three dimensions all types use them.
 - full, more dimensions: ‖L⁻¹x − L⁻¹μ‖², a block of components at a time. Second moments are taken about
   the component's last mean, on a CPU only of the points that it has a share in.

Arrays of components and points are (K, n): such products are the fastest. Features and responsibilities
exist for one chunk of points at a time.

The linear forms cancel digits if components are thin and far apart. A step that loses too many is taken
again in the direct form, ‖L⁻¹x − L⁻¹μ‖² for every type.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import chunk_elements, chunked, in_spatial_order, softmax
from gmmtorch.linalg import inverse_factor, safe_cholesky, unpack_symmetric
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters

_MOST_LOST = 1e-6  # nats a dimension that the log-density of the linear form may lose
_MOST_LOST_VARIANCE = 1e-5  # share of a variance that the moments of the linear form may lose
_ROWS = 1024  # points of a product of the direct form on a CPU
FEW_DIMENSIONS = 3  # up to which all types take the E-step of `exact`, whose kernels are the fastest
_NO_SHARE = 1e-16  # of the largest responsibility of a component in a chunk: such points do not count

Joint = Callable[..., Tensor]
"""From points (n, D), and their `squares` if they are known, to log π_k + log N(x|k), (K, n)."""


def has_linear_form(n_components: int, dim: int, kind: str) -> bool:
    """Whether the linear form is the fastest of a covariance type: the one place of this choice.

    For full covariances it was measured: in 50 dimensions, making the D (D + 1)/2 features of a point takes
    as long as their products with 50 components.
    """
    return kind != "full" or dim <= 20 or dim <= min(n_components, 50)


def compacted(parameters: Parameters, kind: str) -> Parameters:
    """The nearest covariances of the type, in its shape, to those (K, D, D)."""
    covariances = em.constrain(parameters.covariances, kind, parameters.weights)
    return parameters._replace(covariances=em.compact(covariances, kind))


def expanded(parameters: Parameters, kind: str) -> Parameters:
    """The parameters with covariances (K, D, D), given in the shape of their type."""
    return parameters._replace(covariances=em.expand(parameters.covariances, kind, *parameters.means.shape))


class Factors:
    """Parameters with what their log-densities need: L⁻¹ in the shape of the type, and log-constants (K,).

    With `check`, covariances that are not positive definite raise `NumericalError`. Without it, nothing
    waits for the device, and `failed` () tells.
    """

    def __init__(self, parameters: Parameters, kind: str, check: bool = True) -> None:
        self.weights, self.means, covariances = parameters
        self.kind, self.dim = kind, self.means.shape[1]
        if kind in ("full", "tied"):
            if check:
                factors = safe_cholesky(covariances.view(-1, self.dim, self.dim)).view_as(covariances)
                self.failed = torch.zeros((), dtype=torch.bool, device=self.means.device)
            else:
                factors, info = torch.linalg.cholesky_ex(covariances)
                self.failed = (info != 0).any()
            half_log_det = factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)
            self.whiten = inverse_factor(factors).mT if factors.requires_grad else _invert(factors)
        else:
            self.failed = ~(covariances > 0).all()
            if check and bool(self.failed):
                raise NumericalError(
                    f"The least variance of a component is {float(covariances.min()):.3g}, not above zero; "
                    "raise reg_covar, or use fewer components."
                )
            self.whiten = covariances.rsqrt()
            half_log_det = 0.5 * covariances.log() * (self.dim if kind == "spherical" else 1)
            half_log_det = half_log_det.sum(-1) if kind == "diag" else half_log_det
        log_weight = self.weights.log().clamp_min(em.MIN_LOG_WEIGHT)
        self.constant = log_weight - half_log_det - 0.5 * self.dim * em.LOG_2PI

    def whitened_means(self) -> Tensor:
        """L⁻¹ μ (K, D)."""
        if self.kind in ("full", "tied"):
            return (self.whiten @ self.means[:, :, None]).squeeze(-1)
        return self.means * self.whiten.view(self.means.shape[0], -1)

    def lost_digits(self) -> Tensor:
        """Whether the linear form loses too many digits near a component, (). Far from all components its
        error is small beside the log-density."""
        size = self.whitened_means().square().sum(1) * self.weights.sign()
        return size.amax() * torch.finfo(size.dtype).eps > _MOST_LOST * self.dim

    def natural(self) -> Tensor:
        """The natural parameters (K, F) of `exact`, whatever the type."""
        matrices = self.kind in ("full", "tied")
        precision = self.whiten.mT @ self.whiten if matrices else self.whiten.square()
        precision = em.expand(precision, self.kind, *self.means.shape)
        return em.natural_of_precisions(precision, self.means, self.constant)

    def linear(self) -> Joint:
        """The linear form."""
        kind, means, dim = self.kind, self.means, self.dim
        if kind == "full":
            natural = self.natural()
            constant, slope, curve = natural[:, 0], natural[:, 1 : 1 + dim], natural[:, 1 + dim :]
        elif kind == "tied":
            slope = self.whitened_means()
            constant = self.constant - 0.5 * slope.square().sum(1)
            curve = means.new_full((means.shape[0], 1), -0.5)
        else:
            precision = self.whiten.square().view(means.shape[0], -1)
            slope, curve = means * precision, -0.5 * precision
            constant = self.constant - 0.5 * (slope * means).sum(1)

        def joint(points: Tensor, square: Tensor | None = None) -> Tensor:
            points = points @ self.whiten.mT if kind == "tied" else points
            square = squares(points, "spherical" if kind == "tied" else kind) if square is None else square
            found = torch.addmm(constant[:, None], slope, points.mT)
            return torch.addmm(found, curve, square.mT)

        return joint

    def direct(self) -> Joint:
        """The direct form, a block of components at a time."""
        middle = self.whitened_means()
        k, dim = middle.shape
        width = min(dim, max(16, -(-dim // 8))) if self.kind == "full" else dim

        def block(points: Tensor, part: slice) -> Tensor:
            if self.kind == "full":
                # L⁻¹ is lower triangular: products of its parts without zeros take almost half the time.
                total = points.new_zeros(())
                for a in range(0, dim, width):
                    rows = self.whiten[part, a : a + width, : a + width]
                    bias = -middle[part, a : a + width].reshape(-1, 1)
                    z = torch.addmm(bias, rows.reshape(-1, rows.shape[2]), points[:, : a + width].mT)
                    z = z * z if z.requires_grad else z.square_()
                    total = total + z.view(*rows.shape[:2], -1).sum(1)
                return total
            if self.kind == "tied":
                z = points - middle[part, None, :]
            else:
                scale = self.whiten[part].view(-1, 1, self.whiten[0].numel())
                z = (points - self.means[part, None, :]) * scale
            return (z * z).sum(2)

        def joint(points: Tensor, square: Tensor | None = None) -> Tensor:
            points = points @ self.whiten.mT if self.kind == "tied" else points
            # Large products of full covariances gain more from their size than they lose in the cache.
            on_cpu, most = points.device.type == "cpu", chunk_elements(points.device)
            most *= 2 if on_cpu and self.kind == "full" and dim > 100 else 1
            rows = max(64, min(_ROWS if on_cpu else 1 << 16, most // dim))
            found = []
            for some in points.split(rows):
                n = max(1, most // (rows * width))
                found.append(torch.cat([block(some, slice(i, i + n)) for i in range(0, k, n)]))
            return self.constant[:, None] - 0.5 * torch.cat(found, 1)

        return joint


def _invert(lower: Tensor) -> Tensor:
    """Inverts lower triangular matrices (…, D, D) in place, by halves: products are faster than solvers."""
    half = lower.shape[-1] // 2
    if half <= 48:
        eye = torch.eye(lower.shape[-1], dtype=lower.dtype, device=lower.device)
        return lower.copy_(torch.linalg.solve_triangular(lower, eye, upper=False))
    first, last = _invert(lower[..., :half, :half]), _invert(lower[..., half:, half:])
    lower[..., half:, :half] = -last @ (lower[..., half:, :half] @ first)
    return lower


def squares(points: Tensor, kind: str) -> Tensor:
    """The quadratic features of a type: |x|² (n, 1), x² (n, D), or x_i x_j (i ≤ j)."""
    if kind == "spherical":
        return torch.linalg.vector_norm(points, dim=1, keepdim=True).square()
    return points * points if kind == "diag" else em.products(points, points)


def log_joint(parameters: Parameters, kind: str) -> Joint:
    """The fastest form with enough digits: linear about the origin, linear about the centre, or direct."""
    factors = Factors(parameters, kind)
    k, dim = parameters.means.shape
    linear = has_linear_form(k, dim, kind)
    if linear and not bool(factors.lost_digits()):
        return factors.linear()
    center = parameters.weights @ parameters.means
    factors.means = parameters.means - center
    linear = linear and not bool(factors.lost_digits())
    joint = factors.linear() if linear else factors.direct()
    return lambda points, square=None: joint(points - center)


def rows_of_chunk(n_components: int, dim: int, kind: str, device: torch.device) -> int:
    """Points of a chunk, such that its largest array is small."""
    linear = has_linear_form(n_components, dim, kind)
    width = dim * (dim + 1) // 2 if linear and kind == "full" else dim
    # The direct form looks up the points of each component, which is worthwhile in large chunks.
    most = chunk_elements(device) * (1 if linear or device.type != "cpu" else 8)
    return max(64, most // max(n_components, width))


def chunk_rows(points: Tensor) -> int:
    """Rows of a chunk of points (N, D), whatever is computed of each coordinate."""
    return max(64, chunk_elements(points.device) // points.shape[1])


def in_chunks(points: Tensor, weight: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Points (N, D) and their weights (N,), in chunks of `chunk_rows`."""
    return zip(points.split(chunk_rows(points)), weight.split(chunk_rows(points)), strict=True)


class Sums:
    """Moments of points with responsibilities, added up chunk by chunk.

    With `about` (K, D), second moments are about these points: no digits cancel if they are near the
    means. Otherwise they are sums of the linear form's features, about 0.
    """

    def __init__(self, n_components: int, like: Tensor, kind: str, about: Tensor | None = None) -> None:
        k, dim = n_components, like.shape[1]
        self._kind, self._about = kind, about
        self._count, self._first = like.new_zeros(k), like.new_zeros(k, dim)
        if kind in ("diag", "spherical"):
            self._second = like.new_zeros(k, dim if kind == "diag" else 1)
        elif about is None and kind == "full":
            self._second = like.new_zeros(k, dim * (dim + 1) // 2)
        else:
            self._second = like.new_zeros((k, dim, dim) if kind == "full" else (dim, dim))

    @classmethod
    def of(cls, statistics: Tensor, like: Tensor, kind: str) -> Sums:
        """The sums of S (K, F) of `exact`."""
        dim, second = like.shape[1], statistics[:, 1 + like.shape[1] :]
        found = cls(len(statistics), like, kind)
        found._count, found._first = statistics[:, 0], statistics[:, 1 : 1 + dim]
        if kind != "full":
            matrices = unpack_symmetric(second, dim)
            second = matrices.sum(0) if kind == "tied" else matrices.diagonal(dim1=-2, dim2=-1)
            second = second.sum(1, keepdim=True) if kind == "spherical" else second
        found._second = second.clone()
        return found

    def add(self, points: Tensor, gamma: Tensor, square: Tensor | None = None) -> None:
        """Add points (n, D) with responsibilities (K, n). `square`: their `squares`, if they are known."""
        self._count += gamma.sum(1)
        self._first.addmm_(gamma, points)
        if self._about is not None:
            self._add_about(points, gamma, self._about)
        elif self._kind == "tied":
            self._second.addmm_((points * gamma.sum(0)[:, None]).mT, points)
        else:
            self._second.addmm_(gamma, squares(points, self._kind) if square is None else square)

    def _add_about(self, points: Tensor, gamma: Tensor, about: Tensor) -> None:
        (n, dim), sparse = points.shape, points.device.type == "cpu"
        size = 1 if sparse else max(1, chunk_elements(points.device) // (n * dim))
        near = gamma > _NO_SHARE * gamma.amax(1, keepdim=True).clamp_min(1e-20) if sparse else None
        for i in range(0, gamma.shape[0], size):
            part, x, g = slice(i, i + size), points, gamma[i : i + size]
            if near is not None:
                index = near[i].nonzero().squeeze(1)
                if index.shape[0] == 0:
                    continue
                if 4 * index.shape[0] < 3 * n:
                    x, g = points.index_select(0, index), g.index_select(1, index)
            d = x - about[part, None, :]
            if self._kind in ("diag", "spherical"):
                sums = (g[:, None, :] @ d.square_()).squeeze(1)
                self._second[part] += sums if self._kind == "diag" else sums.sum(1, keepdim=True)
                continue
            scaled = (d * g[:, :, None]).mT
            if self._kind == "full":
                self._second[part].baddbmm_(scaled, d)
            else:
                self._second += (scaled @ d).sum(0)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """What is summed: tensors of equal sums may be added."""
        return self._count, self._first, self._second

    def moments(self) -> tuple[Parameters, Tensor]:
        """Number of points, mean and covariance of each component, and the second moments that the
        covariances come from: (K, D), tied (1, D), spherical (K, 1). Overwrites the sums."""
        count = self._count + 10 * torch.finfo(self._count.dtype).eps
        means, dim = self._first / count[:, None], self._first.shape[1]
        shift = means if self._about is None else means - self._about * (self._count / count)[:, None]
        if self._kind in ("diag", "spherical"):
            second, square = self._second / count[:, None], shift.square()
            if self._kind == "spherical":
                second, square = second / dim, square.mean(1, keepdim=True)
            covariances = (second - square).clamp_min_(0)
            shape = em.type_shape(self._kind, *means.shape)
            return Parameters(self._count, means, covariances.view(shape)), second
        # In place, because the matrices may be most of the memory.
        covariances = self._second
        if self._kind == "tied":
            covariances = covariances.div_(count.sum())
            second = covariances.diagonal().clone()[None]
            covariances.addmm_((shift * (count / count.sum())[:, None]).mT, shift, alpha=-1)
        else:
            covariances.div_(count.view(-1, *[1] * (covariances.ndim - 1)))
            covariances = unpack_symmetric(covariances, dim) if covariances.ndim == 2 else covariances
            second = covariances.diagonal(dim1=-2, dim2=-1).clone()
            covariances.baddbmm_(shift[:, :, None], shift[:, None, :], alpha=-1)
        covariances.diagonal(dim1=-2, dim2=-1).clamp_min_(0)
        return Parameters(self._count, means, covariances), second


def have_cancelled(second: Tensor, covariances: Tensor, kind: str, linear: bool) -> Tensor:
    """Whether covariances, as differences of second moments, lost digits that they need, ().

    Those of the linear form also if they are thin in a direction that is not an axis.
    """
    if kind in ("full", "tied"):
        diagonal = covariances.diagonal(dim1=-2, dim2=-1).view_as(second)
        scale = torch.maximum(second, diagonal).rsqrt().view(covariances.shape[:-1])
        if linear:
            factors, info = torch.linalg.cholesky_ex(covariances * scale[..., None] * scale[..., None, :])
            left = factors.diagonal(dim1=-2, dim2=-1).square().amin().masked_fill((info != 0).any(), 0.0)
        else:
            left = (diagonal * scale.view_as(second).square()).amin()
    else:
        variances = covariances.view(second.shape)
        left = (variances / torch.maximum(second, variances)).amin()
    return ~(left * _MOST_LOST_VARIANCE > torch.finfo(left.dtype).eps)


def expected_moments(
    points: Tensor,
    sample_weight: Tensor,
    factors: Factors,
    softmax_dtype: torch.dtype,
    linear: bool,
    about: Tensor | None = None,
    rows: tuple[Tensor, Tensor] | None = None,
) -> tuple[Sums, Tensor]:
    """E-step (2.3): moments of the responsibilities, and Σ_n p_n log p(x_n), ().

    Direct unless `linear`, with second moments about the last means, or `about` (K, D). `rows`: see
    `rows_of_few_dimensions`.
    """
    if points.shape[1] <= FEW_DIMENSIONS and linear:
        rows = (em.quadratic_features(points), sample_weight) if rows is None else rows
        statistics, value = em.expectation(*rows, factors.natural(), softmax_dtype)
        return Sums.of(statistics, points, factors.kind), value
    softmax_dtype = torch.float64 if points.shape[1] <= FEW_DIMENSIONS else softmax_dtype
    (n, dim), k, kind = points.shape, factors.means.shape[0], factors.kind
    joint = factors.linear() if linear else factors.direct()

    def shares(part: slice) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
        square = squares(points[part], kind) if linear and kind != "tied" else None
        return points[part], square, *softmax(joint(points[part], square), sample_weight[part], softmax_dtype)

    about = None if linear else factors.means if about is None else about
    sums = Sums(k, points, kind, about)
    total = points.new_zeros(())
    for some, square, gamma, value in chunked(n, rows_of_chunk(k, dim, kind, points.device), shares):
        sums.add(some, gamma, square)
        total += value
    return sums, total


def rows_of_few_dimensions(points: Tensor, sample_weight: Tensor) -> tuple[Tensor, Tensor] | None:
    """Features and weights of points, once for all E-steps, in the order in which these are fastest."""
    if points.shape[1] > FEW_DIMENSIONS:
        return None
    return in_spatial_order(em.quadratic_features(points), sample_weight)


def moments_of_labels(
    points: Tensor, weight: Tensor, labels: Tensor, n_components: int, kind: str
) -> Parameters:
    """Number of points, mean and covariance of the points (N, D) of each label (N,), labels below K."""
    dim = points.shape[1]
    count = weight.new_zeros(n_components).index_add_(0, labels, weight)
    means = points.new_zeros(n_components, dim)
    rows = rows_of_chunk(n_components, dim, kind, points.device)
    for some, p, own in zip(points.split(rows), weight.split(rows), labels.split(rows), strict=True):
        means.index_add_(0, own, some * p[:, None])
    sums = Sums(n_components, points, kind, means / count[:, None].clamp_min(1e-300))
    for some, p, own in zip(points.split(rows), weight.split(rows), labels.split(rows), strict=True):
        gamma = points.new_zeros(n_components, len(own)).scatter_(0, own[None], p[None])
        sums.add(some, gamma)
    return sums.moments()[0]


def maximized(moments: Parameters, reg_covar: float, previous: Parameters | None, kind: str) -> Parameters:
    """M-step (2.4)-(2.6), in place. A component that lost all its points keeps its `previous` mean and
    covariance."""
    count, means, covariances = moments
    eps = 10 * torch.finfo(count.dtype).eps
    alive, weights = count > eps, count + eps
    weights = weights / weights.sum()
    diagonal = covariances.diagonal(dim1=-2, dim2=-1) if kind in ("full", "tied") else covariances
    diagonal.add_(reg_covar)
    if previous is None:
        return Parameters(weights, means, covariances)
    if kind != "tied":
        keep = alive.view(-1, *[1] * (covariances.ndim - 1))
        into = None if covariances.requires_grad else covariances
        covariances = torch.where(keep, covariances, previous.covariances, out=into)
    means = torch.where(alive[:, None], means, previous.means)
    return Parameters(torch.where(alive, weights, 0.0), means, covariances)


class Moved(NamedTuple):
    """An EM step: points (K,), the new parameters, Σ_n p_n log p(x_n), and whether digits are lost."""

    points: Tensor
    parameters: Parameters
    value: Tensor
    lost: Tensor


Gather = Callable[[bool, Tensor | None], tuple[Sums, Tensor]]
"""An E-step, linear or not, with second moments about given points (K, D): see `expected_moments`."""


def em_step(
    gather: Gather,
    factors: Factors,
    reg_covar: float,
    previous: Parameters | None,
    linear: bool,
    about: Tensor | None = None,
) -> Moved:
    """E- and M-step in one of the forms: `gather`, `maximized`. Does not wait for the device."""
    sums, value = gather(linear, about)
    moments, second = sums.moments()
    new = maximized(moments, reg_covar, previous, factors.kind)
    lost = have_cancelled(second, new.covariances, factors.kind, linear)
    lost = lost | factors.lost_digits() if linear else lost
    return Moved(moments.weights, new, value, lost | factors.failed)


def exact_step(
    gather: Gather, factors: Factors, reg_covar: float, previous: Parameters | None, linear: bool = False
) -> Moved:
    """`em_step` in the direct form; if a component moves far, once more with moments about its new mean.

    With `linear`, the linear form is tried first, if that is the fastest.
    """
    given = (gather, factors, reg_covar, previous)
    if linear and has_linear_form(len(factors.means), factors.dim, factors.kind):
        found = em_step(*given, linear=True)
        if not bool(found.lost):
            return found
    found = em_step(*given, linear=False)
    return em_step(*given, False, found.parameters.means) if bool(found.lost) else found
