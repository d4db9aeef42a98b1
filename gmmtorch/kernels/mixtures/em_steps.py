"""Steps of EM: the E-step of exact and of truncated EM, the M-step, natural parameters; steps of k-means.

The fused kernels skip responsibilities below e⁻³⁷ of the row's largest term. Rows that follow each other are
a block, which lists the components that can exceed this in its box: a far component costs a bound for each
64 rows and nothing more. Statistics differ from the twin's with float64 exponentials by at most 10⁻¹² of
their largest entry. On a CPU a kernel works on eight rows at a time. On a GPU 64 threads share a block, and
nothing is stored for a pair of a row and a component.

With float32 exponentials a GPU computes in float32 within a block, from differences in a component's whitened
axes, whose rounding errors have a bound. If it can exceed 2⁻¹⁰ nats for a log-density, with thin components
and rows far apart, or with cells rather than points, the block is computed in float64.

The twins of the M-step (2.4)-(2.6) and of natural parameters are in `mixture.em`; docs/occupancy.md tells the
differences.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.chunks import chunk_elements, chunked
from gmmtorch.kernels.compiler import CPU_LANES, squad_size, templated
from gmmtorch.linalg import order_along_curve

_FEW_ROWS = 2048  # in fewer rows, their order matters little
_FEW_COMPONENTS, _FEW_PAIRS = 64, 1 << 18
"""For fewer components, or fewer pairs of a row and a component, a CPU does not search for the near ones."""
_PARTS = 64  # most parts of the rows; each has its own sums, so that threads write apart
_SQUADS = 1056  # most squads of a GPU, eight on each multiprocessor of a large one; each has its own sums
_SQUAD_SUMS = 1 << 24  # most numbers of these sums, 128 MB

_WIDTHS = {1: 3, 2: 6, 3: 10}
_E_STEP = "mixtures/exact_e_step.h"
_TABLES = templated("mixtures/near_components.h", "component_table", _WIDTHS)
_EXPECTATION = templated(_E_STEP, "e_step", _WIDTHS)
_MOST_LIKELY = templated(_E_STEP, "most_likely", _WIDTHS)
_TYPES = itertools.product(_WIDTHS, (torch.float32, torch.float64))
_IN_BLOCKS = templated(_E_STEP, "e_step_in_blocks", _TYPES)
_DIMENSIONS = {width: dim for dim, width in _WIDTHS.items()}


def expectation(
    features: Tensor, sample_weight: Tensor, natural: Tensor, softmax_dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """One E-step (2.3): sufficient statistics S (K, F) and Σ_n p_n logsumexp_k L_nk (a scalar), L = φWᵀ.

    Products are computed in the dtype of the features (float64, because the quadratic form cancels many
    digits), and exponentials in `softmax_dtype`, after subtraction of the row's maximum. The fused kernel
    computes in float64 on a CPU; with float32 exponentials, it computes in float32 on a GPU (see the module).

    Args:
        features: φ (N, F). sample_weight: p (N,). natural: W (K, F).
    """
    if not _is_e_step_fused(features, sample_weight, natural):
        return _batched_expectation(features, sample_weight, natural, softmax_dtype)
    if features.device.type != "cpu":
        return _expectation_in_blocks(features, sample_weight, natural, softmax_dtype)
    return _fused_expectation(features, sample_weight, natural)


def most_likely(features: Tensor, natural: Tensor) -> Tensor:
    """The component (N,) with the largest L_nk for each row of features (N, F); natural: W (K, F)."""
    if _is_e_step_fused(features, natural):
        n, dim, device = features.shape[0], _DIMENSIONS[features.shape[1]], features.device
        likeliest = torch.empty(n, dtype=torch.int64, device=device)
        n_parts = _n_parts(features) if device.type == "cpu" else n
        padded = _padded(natural, -len(natural) % 4)
        _MOST_LIKELY[dim](n_parts, features, n, padded, len(padded), n_parts, likeliest)
        return likeliest
    transposed = natural.T.contiguous()
    rows = max(64, chunk_elements(features.device) // transposed.shape[1])
    parts = chunked(features.shape[0], rows, lambda part: (features[part] @ transposed).argmax(1))
    return torch.cat([features.new_empty(0, dtype=torch.int64), *parts])


def in_spatial_order(features: Tensor, sample_weight: Tensor) -> tuple[Tensor, Tensor]:
    """The rows (N, F), (N,) in an order in which neighbours follow each other, if the fused kernel runs.

    The kernel skips what all of eight rows are far from.
    """
    dim = _DIMENSIONS.get(features.shape[1], 0)
    if not _is_e_step_fused(features, sample_weight) or features.shape[0] < _FEW_ROWS:
        return features, sample_weight
    order = order_along_curve(features[:, 1 : 1 + dim].contiguous())
    return features.index_select(0, order), sample_weight.index_select(0, order)


def _is_e_step_fused(*tensors: Tensor) -> bool:
    return is_m_step_fused(_DIMENSIONS.get(tensors[0].shape[1], 0), *tensors)


def lists_near_components(n_rows: int, n_components: int) -> bool:
    """Whether a CPU searches for the components near a block of rows."""
    return n_components >= _FEW_COMPONENTS and n_rows * n_components >= _FEW_PAIRS


def _n_parts(features: Tensor) -> int:
    threads = torch.get_num_threads()
    return max(1, min(threads, _PARTS, features.shape[0] // (4 * CPU_LANES)))


def _padded(natural: Tensor, missing: int) -> Tensor:
    """W with rows of impossible components added, so that those of a step are complete."""
    if missing == 0:
        return natural
    none = natural.new_zeros(missing, natural.shape[1])
    none[:, 0] = -1e300
    return torch.cat([natural, none])


def _table(natural: Tensor, n_padded: int) -> Tensor:
    """What bounds the components' logits (F, n_padded): see `component_table`."""
    table = natural.new_empty(natural.shape[1], n_padded)
    dim = _DIMENSIONS[natural.shape[1]]
    _TABLES[dim](n_padded, natural, natural.shape[0], n_padded, table)
    return table


def _fused_expectation(features: Tensor, weight: Tensor, natural: Tensor) -> tuple[Tensor, Tensor]:
    (n, width), k = features.shape, natural.shape[0]
    lists = lists_near_components(n, k)
    padded, n_parts = _padded(natural, CPU_LANES - k % CPU_LANES if lists else -k % 4), _n_parts(features)
    n_padded = len(padded)
    n_scratch = n_parts * n_padded * (CPU_LANES + 1)
    work = features.new_empty(n_scratch + 2 * n)
    scratch, peaks, norms = work[:n_scratch], work[n_scratch : n_scratch + n], work[n_scratch + n :]
    numbers = torch.empty(n_parts, 2, n_padded, dtype=torch.int64)
    partial = features.new_zeros(n_parts, n_padded, width, CPU_LANES)
    table = _table(padded, n_padded) if lists else None
    given = features, weight, n, padded, table, k, n_padded, n_parts
    results = scratch, numbers, partial, peaks, norms
    _EXPECTATION[_DIMENSIONS[width]](n_parts, *given, *results)
    return partial.sum((0, 3))[:k], torch.dot(weight, peaks + norms.log())


def _expectation_in_blocks(
    features: Tensor, weight: Tensor, natural: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """The form for a GPU, on any device."""
    (n, width), k = features.shape, natural.shape[0]
    dim, device = _DIMENSIONS[width], features.device
    n_parts = max(1, min(_SQUADS, n // 64, _SQUAD_SUMS // (k * width)))
    n_padded = k + -k % CPU_LANES
    table = _table(natural, n_padded)
    upper, norms = features.new_empty(n_parts, n_padded), features.new_empty(n)
    numbers = torch.empty(n_parts, n_padded, dtype=torch.int64, device=device)
    partial = features.new_zeros(n_parts, k, width)
    given = features, weight, n, natural, table, k, n_padded, n_parts
    n_items = n_parts * squad_size(device)
    _IN_BLOCKS[dim, dtype](n_items, *given, upper, numbers, partial, norms)
    return partial.sum(0), torch.dot(weight, norms)


def _batched_expectation(
    features: Tensor, sample_weight: Tensor, natural: Tensor, softmax_dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """The twin."""
    rows = max(64, chunk_elements(features.device) // natural.shape[0])

    def sums_of(part: slice) -> tuple[Tensor, Tensor]:
        gamma, value = softmax(natural @ features[part].T, sample_weight[part], softmax_dtype)
        return gamma @ features[part], value

    statistics = torch.zeros_like(natural)
    total = features.new_zeros(())
    for sums, value in chunked(features.shape[0], rows, sums_of):
        statistics += sums
        total += value
    return statistics, total


def nearest_centers(points: Tensor, weight: Tensor, centers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A step of R runs of k-means: the nearest center (R, N) of each point (N, D), the squared distance
    (R, N) to it, and the weight and the weighted sum of the points of each center, (R, K, 1 + D).

    Args:
        weight: (N,). centers: (R, K, D).
    """
    (n_runs, k, dim), n = centers.shape, points.shape[0]
    flat = centers.reshape(-1, dim)
    bias, offset = -0.5 * flat.square().sum(1, keepdim=True), k * torch.arange(n_runs, device=points.device)
    # A mask, because argmax along a dimension other than the last is slow.
    place = torch.arange(k, dtype=points.dtype, device=points.device)[:, None]

    def step(part: slice) -> tuple[Tensor, Tensor, Tensor]:
        some, p = points[part], weight[part, None]
        products = torch.addmm(bias, flat, some.T).view(n_runs, k, -1)
        peak = products.amax(1)
        nearest = torch.where(products == peak[:, None], place, 0).amax(1).long()
        rows = torch.cat([p, p * some], 1).expand(n_runs, -1, -1).reshape(-1, 1 + dim)
        sums = rows.new_zeros(n_runs * k, 1 + dim).index_add_(0, (nearest + offset[:, None]).flatten(), rows)
        return nearest, (some.square().sum(1) - 2 * peak).clamp_min_(0), sums

    size = max(64, chunk_elements(points.device) // max(flat.shape))
    nearest, distance, sums = zip(*chunked(n, size, step), strict=True)
    return torch.cat(nearest, 1), torch.cat(distance, 1), torch.stack(sums).sum(0).view(n_runs, k, -1)


def softmax(logits: Tensor, sample_weight: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Weighted responsibilities p_n γ_kn (K, n) of logits (K, n), which are overwritten; and
    Σ_n p_n logsumexp_k. Exponentials are computed in `dtype`.
    """
    peak = logits.amax(0)
    gamma = logits.sub_(peak).to(dtype).clamp_(min=exponent_floor(dtype)).exp_()
    norm = gamma.sum(0)
    value = torch.dot(sample_weight, peak + norm.to(peak.dtype).log())
    return gamma.mul_((sample_weight / norm).to(dtype)).to(peak.dtype), value


def exponent_floor(dtype: torch.dtype) -> float:
    """Smallest exponent whose exp is not denormal: denormals are negligible, but slow to compute."""
    return -80.0 if dtype == torch.float32 else -700.0


DIMENSIONS: tuple[int, ...] = (1, 2, 3)

_NATURALS = templated("mixtures/m_step.h", "natural_parameters", DIMENSIONS)
_STEPS = templated("mixtures/m_step.h", "m_step", DIMENSIONS)
_LABELLED = templated("mixtures/m_step.h", "label_moments", DIMENSIONS, shares=True)

Mixture = tuple[Tensor, Tensor, Tensor]
"""Weights (K,), means (K, D) and covariances (K, D, D)."""


def is_m_step_fused(dim: int, *tensors: Tensor) -> bool:
    """Whether the fused kernels compute with these tensors in `dim` dimensions."""
    return dim in DIMENSIONS and all(t.dtype == torch.float64 for t in tensors) and is_fused(*tensors)


def fused_natural_parameters(
    weights: Tensor, means: Tensor | None, covariances: Tensor
) -> tuple[Tensor, Tensor]:
    """W (K, F) such that φ(x)·W_k = log π_k + log N(x | μ_k, Σ_k); `means` None: zeros.

    Also whether (a scalar) a weight or a covariance is not positive, NaN or infinite: W is not valid then.
    """
    k, dim = covariances.shape[:2]
    natural = weights.new_empty(k, 1 + dim + dim * (dim + 1) // 2)
    failed = torch.zeros(1, dtype=torch.bool, device=weights.device)
    _NATURALS[dim](k, weights, means, covariances, natural, failed)
    return natural, failed[0]


def fused_maximization(statistics: Tensor, dim: int, reg_covar: float, previous: Mixture | None) -> Mixture:
    """M-step from statistics (K, F), in their frame; components without points keep `previous` values."""
    k = statistics.shape[0]
    made = statistics.new_empty(k * (1 + dim + dim * dim))
    masses, means = made[:k], made[k : k + k * dim].view(k, dim)
    covariances = made[k + k * dim :].view(k, dim, dim)
    _, *kept = previous or (None, None, None)
    given = statistics, *kept, False, reg_covar, None, None, 0.0
    _STEPS[dim](k, *given, masses, means, covariances, *[None] * 4)
    return masses / masses.sum(), means, covariances


def fused_label_moments(
    rows: Tensor, weight: Tensor, labels: Tensor, n_labels: int, dim: int, reg_covar: float
) -> Mixture:
    """On a CPU, weight, mean and covariance of the points (N, D) or cells (N, F) of each label (N,)."""
    k, width = n_labels, 1 + dim + dim * (dim + 1) // 2
    made = rows.new_zeros(k * (width + 1 + dim + dim * dim))
    sums, weights, means, covariances = made.split([k * width, k, k * dim, k * dim * dim])
    given = rows, rows.shape[1] == dim, weight, labels, len(rows), k
    results = sums, weights, means, covariances
    _LABELLED[dim](1, *given, reg_covar, *results)
    return weights, means.view(k, dim), covariances.view(k, dim, dim)
