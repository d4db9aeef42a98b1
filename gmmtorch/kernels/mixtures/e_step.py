"""E-step of exact EM (2.3): responsibilities of all components, summed over rows into sufficient statistics.

The fused kernels compute in float64 and skip responsibilities below e⁻³⁷ of the row's largest term: a far
component costs its log-density and nothing more. Statistics differ from the twin's with float64 exponentials
by at most 10⁻¹² of their largest entry. On a CPU one kernel works on eight rows at a time. On a GPU the first
kernel sums over the components of each row, and the second over the rows of each component; no block of
N × K numbers is written to memory.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.chunks import chunk_elements, chunked
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel

_FEW_ROWS = 2048  # in fewer rows, their order matters little
_PARTS = 64  # most parts of the rows; each has its own sums, so that threads write apart
_GPU_THREADS = 1 << 18
"""As many as a large GPU holds at a time; each sums one component over a part of the rows."""
_GPU_ROWS = 32  # least rows of such a part

_WIDTHS = {1: 3, 2: 6, 3: 10}
_SOURCE = "mixtures/e_step.h"
_EXPECTATION = {dim: FusedKernel(_SOURCE, f"e_step<{dim}>") for dim in _WIDTHS}
_MOST_LIKELY = {dim: FusedKernel(_SOURCE, f"most_likely<{dim}>") for dim in _WIDTHS}
_NORMS = {dim: FusedKernel(_SOURCE, f"row_norms<{dim}>") for dim in _WIDTHS}
_SHARES = {dim: FusedKernel(_SOURCE, f"component_sums<{dim}>") for dim in _WIDTHS}
_DIMENSIONS = {width: dim for dim, width in _WIDTHS.items()}


def expectation(
    features: Tensor, sample_weight: Tensor, natural: Tensor, softmax_dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """One E-step (2.3): sufficient statistics S (K, F) and Σ_n p_n logsumexp_k L_nk (a scalar), L = φWᵀ.

    Products are computed in the dtype of the features (float64, because the quadratic form cancels many
    digits). The twin computes exponentials in `softmax_dtype`, after subtraction of the row's maximum.

    Args:
        features: φ (N, F). sample_weight: p (N,). natural: W (K, F).
    """
    if _is_fused(features, sample_weight, natural):
        fused = _fused if features.device.type == "cpu" else _fused_on_gpu
        return fused(features, sample_weight, natural)
    return _batched(features, sample_weight, natural, softmax_dtype)


def most_likely(features: Tensor, natural: Tensor) -> Tensor:
    """The component (N,) with the largest L_nk for each row of features (N, F); natural: W (K, F)."""
    if _is_fused(features, natural):
        n, dim, device = features.shape[0], _DIMENSIONS[features.shape[1]], features.device
        likeliest = torch.empty(n, dtype=torch.int64, device=device)
        if device.type != "cpu":
            given = features.contiguous(), n, natural.contiguous(), natural.shape[0], 1
            _NORMS[dim](n, *given, None, likeliest, device=device)
            return likeliest
        n_parts = _n_parts(features)
        given = features.contiguous(), n, *_by_four(natural), n_parts
        _MOST_LIKELY[dim](n_parts, *given, likeliest, device=device)
        return likeliest
    transposed = natural.T.contiguous()
    rows = max(64, chunk_elements(features.device) // transposed.shape[1])
    parts = chunked(features.shape[0], rows, lambda part: (features[part] @ transposed).argmax(1))
    return torch.cat([features.new_empty(0, dtype=torch.int64), *parts])


def in_spatial_order(features: Tensor, sample_weight: Tensor) -> tuple[Tensor, Tensor]:
    """The rows (N, F), (N,) in an order in which neighbours follow each other, if the fused kernel runs.

    The kernel skips what all of eight rows are far from. The order is that of a Morton curve through 32 cells
    along each axis.
    """
    dim = _DIMENSIONS.get(features.shape[1], 0)
    if not _is_fused(features, sample_weight) or features.shape[0] < _FEW_ROWS:
        return features, sample_weight
    places = features[:, 1 : 1 + dim].contiguous()
    low, high = places.amin(0), places.amax(0)
    cell = ((places - low) * (31.99 / (high - low).max().clamp_min(1e-300))).long().clamp_(0, 31)
    spread = [sum((n >> b & 1) << (b * dim) for b in range(5)) for n in range(32)]
    bits = torch.tensor(spread, device=places.device)
    keys = sum((bits[cell[:, axis]] << axis for axis in range(dim)), torch.zeros_like(cell[:, 0]))
    order = keys.short().argsort(stable=True)
    return features.index_select(0, order), sample_weight.index_select(0, order)


def _is_fused(*tensors: Tensor) -> bool:
    features = tensors[0]
    fits = features.shape[1] in _DIMENSIONS
    return fits and all(t.dtype == torch.float64 for t in tensors) and is_fused(*tensors)


def _n_parts(features: Tensor) -> int:
    threads = torch.get_num_threads()
    return max(1, min(threads, _PARTS, features.shape[0] // (4 * CPU_LANES)))


def _by_four(natural: Tensor) -> tuple[Tensor, int]:
    """W with rows of impossible components added, so that four make a step; and the number of rows."""
    missing = -natural.shape[0] % 4
    if missing:
        none = natural.new_zeros(missing, natural.shape[1])
        none[:, 0] = -1e300
        natural = torch.cat([natural, none])
    return natural.contiguous(), natural.shape[0]


def _fused(features: Tensor, weight: Tensor, natural: Tensor) -> tuple[Tensor, Tensor]:
    n, width = features.shape
    padded, k = _by_four(natural)
    n_parts = _n_parts(features)
    n_scratch = n_parts * k * CPU_LANES
    work = features.new_empty(n_scratch + 2 * n)
    scratch, peaks, norms = work[:n_scratch], work[n_scratch : n_scratch + n], work[n_scratch + n :]
    near = torch.empty(n_parts, k, dtype=torch.int64)
    partial = features.new_zeros(n_parts, k, width, CPU_LANES)
    arguments = (weight.contiguous(), scratch, near, partial, peaks, norms)
    rows = features.contiguous(), n, padded, k, n_parts
    _EXPECTATION[_DIMENSIONS[width]](n_parts, *rows, *arguments, device=features.device)
    return partial.sum((0, 3))[: natural.shape[0]], torch.dot(weight, peaks + norms.log())


def _fused_on_gpu(features: Tensor, weight: Tensor, natural: Tensor) -> tuple[Tensor, Tensor]:
    (n, width), k = features.shape, natural.shape[0]
    dim, device = _DIMENSIONS[width], features.device
    n_parts = max(1, min(_GPU_THREADS // k, n // _GPU_ROWS))
    rows = features.contiguous(), n, natural.contiguous(), k, n_parts
    norms = torch.empty_like(weight, memory_format=torch.contiguous_format)
    partial = features.new_empty(n_parts, k, width)
    _NORMS[dim](n, *rows, norms, None, device=device)
    _SHARES[dim](n_parts * k, *rows, weight.contiguous(), norms, partial, device=device)
    return partial.sum(0), torch.dot(weight, norms)


def _batched(
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
