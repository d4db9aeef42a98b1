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
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.simd import CPU_LANES, SIMD

SKIPPED = 37.0
"""Nats below a row's largest term from which on a responsibility counts as 0: K e⁻³⁷ is below 10⁻¹² of it."""

_FEW_ROWS = 2048  # in fewer rows, their order matters little
_PARTS = 64  # most parts of the rows; each has its own sums, so that threads write apart
_GPU_THREADS = 1 << 18
"""As many as a large GPU holds at a time; each sums one component over a part of the rows."""
_GPU_ROWS = 32  # least rows of such a part

PRODUCTS = """
        vec a = x[0] * w[0], b = x[0] * w[WIDTH], c = x[0] * w[2 * WIDTH], d = x[0] * w[3 * WIDTH];
        for (int f = 1; f < WIDTH; ++f) {
            a = fused(x[f], (vec)(w[f]), a);
            b = fused(x[f], (vec)(w[WIDTH + f]), b);
            c = fused(x[f], (vec)(w[2 * WIDTH + f]), c);
            d = fused(x[f], (vec)(w[3 * WIDTH + f]), d);
        }
"""
"""Logits a, b, c, d of four components from features x and natural parameters w."""
_LOGITS = """
    // Component by component for LANES rows: what four components share is loaded once.
    const int64_t lane_rows = GMM_MIN((int64_t)LANES, stop - row);
    for (int l = 0; l < LANES; ++l) {
        const double* given = features + (row + GMM_MIN((int64_t)l, lane_rows - 1)) * WIDTH;
        for (int f = 0; f < WIDTH; ++f) set(x[f], l, given[f]);
    }
    vec peak = (vec)(-1e300);
    LIKELIEST_BEGIN
    for (int64_t k = 0; k < n_components; k += 4) {
        const double* w = natural + k * WIDTH;
        PRODUCTS
        LOGITS
    }
"""
_SUMS = """
    const int64_t begin = n_rows * item / n_parts, stop = n_rows * (item + 1) / n_parts;
    vec* logits = (vec*)(scratch + item * n_components * LANES);
    vec* sums = (vec*)(partial + item * n_components * WIDTH * LANES);
    vec x[WIDTH];
    for (int64_t row = begin; row < stop; row += LANES) {
        LOGITS_OF_ROWS
        vec norm = (vec)(0.0), p = (vec)(0.0);
        for (int l = 0; l < lane_rows; ++l) set(p, l, weight[row + l]);
        int64_t n_near = 0;
        for (int64_t k = 0; k < n_components; ++k) {
            const vec under = logits[k] - peak;
            if (!any(under > -SKIPPED)) continue;
            const vec term = under > -SKIPPED ? expo(under) : (vec)(0.0);
            norm += term;
            logits[n_near] = term;  // n_near is at most k
            near[item * n_components + n_near++] = k;
        }
        const vec share = p / norm;
        for (int64_t place = 0; place < n_near; ++place) {
            vec* sum = sums + near[item * n_components + place] * WIDTH;
            const vec gamma = logits[place] * share;
            for (int f = 0; f < WIDTH; ++f) sum[f] = fused(gamma, x[f], sum[f]);
        }
        for (int l = 0; l < lane_rows; ++l) {
            peaks[row + l] = get(peak, l);
            norms[row + l] = get(norm, l);
        }
    }
"""
_LIKELIEST = """
    const int64_t begin = n_rows * item / n_parts, stop = n_rows * (item + 1) / n_parts;
    vec x[WIDTH];
    for (int64_t row = begin; row < stop; row += LANES) {
        LOGITS_OF_ROWS
        for (int l = 0; l < lane_rows; ++l) likeliest[row + l] = (int64_t)get(first, l);
    }
"""
_NORMS_ON_GPU = """
    double x[WIDTH];
    for (int f = 0; f < WIDTH; ++f) x[f] = features[item * WIDTH + f];
    auto logit = [&](int64_t k) {
        const double* w = natural + k * WIDTH;
        double sum = x[0] * w[0];
        for (int f = 1; f < WIDTH; ++f) sum = fma(x[f], w[f], sum);
        return sum;
    };
    double peak = -1e300, norm = 0.0;
    int64_t first = 0;
    for (int64_t k = 0; k < n_components; ++k) {
        const double value = logit(k);
        if (value > peak) peak = value, first = k;
    }
    if (likeliest) {
        likeliest[item] = first;
        return;
    }
    for (int64_t k = 0; k < n_components; ++k) {
        const double under = logit(k) - peak;
        if (under > -SKIPPED) norm += exp(under);
    }
    norms[item] = peak + log(norm);
"""
_SUMS_ON_GPU = """
    const int64_t part = item / n_components, k = item % n_components;
    const int64_t begin = n_rows * part / n_parts, stop = n_rows * (part + 1) / n_parts;
    double w[WIDTH], sum[WIDTH];
    for (int f = 0; f < WIDTH; ++f) w[f] = natural[k * WIDTH + f], sum[f] = 0.0;
    for (int64_t row = begin; row < stop; ++row) {
        const double* x = features + row * WIDTH;  // the same for all threads of a warp, but for part
        double under = x[0] * w[0];
        for (int f = 1; f < WIDTH; ++f) under = fma(x[f], w[f], under);
        under -= norms[row];
        if (!(under > -SKIPPED)) continue;
        const double gamma = exp(under) * weight[row];
        for (int f = 0; f < WIDTH; ++f) sum[f] = fma(gamma, x[f], sum[f]);
    }
    for (int f = 0; f < WIDTH; ++f) partial[item * WIDTH + f] = sum[f];
"""
_STORED = """
        logits[k] = a, logits[k + 1] = b, logits[k + 2] = c, logits[k + 3] = d;
        a = a > b ? a : b;
        c = c > d ? c : d;
        a = a > c ? a : c;
        peak = a > peak ? a : peak;
"""
_BEST = "".join(
    f"first = {name} > peak ? (vec)((double)(k + {i})) : first; peak = {name} > peak ? {name} : peak;"
    for i, name in enumerate("abcd")
)


def _kernel(name: str, body: str, parameters: str, dim: int) -> FusedKernel:
    width = 1 + dim + dim * (dim + 1) // 2
    keeps = "vec first = (vec)(0.0);" if name == "most_likely" else ""
    logits = (
        _LOGITS.replace("PRODUCTS", PRODUCTS)
        .replace("LOGITS", _BEST if keeps else _STORED)
        .replace("LIKELIEST_BEGIN", keeps)
    )
    body = body.replace("LOGITS_OF_ROWS", logits)
    body = body.replace("WIDTH", str(width)).replace("SKIPPED", str(SKIPPED))
    rows = "const double* features, int64 n_rows, const double* natural, int64 n_components, int64 n_parts, "
    return FusedKernel(f"{name}_{dim}d", rows + parameters, SIMD + body)


_EXPECTATION = {
    dim: _kernel(
        "e_step",
        _SUMS,
        "const double* weight, double* scratch, int64* near, double* partial, double* peaks, double* norms",
        dim,
    )
    for dim in (1, 2, 3)
}
_MOST_LIKELY = {dim: _kernel("most_likely", _LIKELIEST, "int64* likeliest", dim) for dim in (1, 2, 3)}
_NORMS = {
    dim: _kernel("row_norms", _NORMS_ON_GPU, "double* norms, int64* likeliest", dim) for dim in (1, 2, 3)
}
_SHARES = {
    dim: _kernel(
        "component_sums", _SUMS_ON_GPU, "const double* weight, const double* norms, double* partial", dim
    )
    for dim in (1, 2, 3)
}
_DIMENSIONS = {1 + dim + dim * (dim + 1) // 2: dim for dim in _EXPECTATION}


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
