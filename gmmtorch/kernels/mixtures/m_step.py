"""M-step of EM (2.4)-(2.6) with its extrapolation, and natural parameters; the twins are in `mixture.em`.

One item is one component. The results differ from the twins' by rounding: by at most 10⁻¹² of the largest
entry of a component, and for natural parameters by this times the condition number of its covariance.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

DIMENSIONS = (1, 2, 3)

_NATURAL = """
    const double *c = covariances + item * DIM * DIM, weight = weights[item];
    double l[DIM][DIM], inverse[DIM][DIM], half_log_det = 0.0, across = 0.0;
    bool good = weight >= 0.0;
    for (int j = 0; j < DIM; ++j)
        for (int i = j; i < DIM; ++i) {
            double s = c[i * DIM + j];
            for (int k = 0; k < j; ++k) s -= l[i][k] * l[j][k];
            good = good && (i > j || (s > 0.0 && s < HUGE_VAL));
            l[i][j] = i == j ? sqrt(s) : s / l[j][j];
            if (i == j) half_log_det += log(l[j][j]);
        }
    if (!good) {
        *failed = true;
        natural[item * WIDTH] = -1e300;
        for (int f = 1; f < WIDTH; ++f) natural[item * WIDTH + f] = 0.0;
        return;
    }
    for (int j = 0; j < DIM; ++j)
        for (int i = j; i < DIM; ++i) {
            double s = i == j ? 1.0 : 0.0;
            for (int k = j; k < i; ++k) s -= l[i][k] * inverse[k][j];
            inverse[i][j] = s / l[i][i];
        }
    double* w = natural + item * WIDTH;
    for (int a = 0; a < DIM; ++a) w[1 + a] = 0.0;
    for (int a = 0, f = 1 + DIM; a < DIM; ++a)
        for (int b = a; b < DIM; ++b, ++f) {
            double p = 0.0;
            for (int k = b; k < DIM; ++k) p += inverse[k][a] * inverse[k][b];
            w[f] = a == b ? -0.5 * p : -p;
            if (!means) continue;
            w[1 + a] += p * means[item * DIM + b];
            if (a != b) w[1 + b] += p * means[item * DIM + a];
        }
    if (means)
        for (int a = 0; a < DIM; ++a) across += w[1 + a] * means[item * DIM + a];
    const double log_weight = weight > 0.0 ? log(weight) : -1e30;
    w[0] = log_weight - half_log_det - 0.5 * (DIM * 1.8378770664093453 + across);
"""
_STEP = """
    const double* s = statistics + item * WIDTH;
    // Mass, mean and covariance of sums; what was there and no mass, if there are no points.
    auto maximized = [&](const double* sums, double* mass, double* mean, double* covariance) {
        const double eps = 2.220446049250313e-15, count = sums[0] + eps;
        const bool alive = !means || sums[0] > eps;
        *mass = alive ? count : 0.0;
        for (int a = 0; a < DIM; ++a) {
            mean[a] = alive && !about_means ? 0.0 : means[item * DIM + a];
            if (alive) mean[a] += sums[1 + a] / count;
        }
        const double* c = covariances + item * DIM * DIM;
        for (int a = 0, f = 1 + DIM; a < DIM; ++a)
            for (int b = a; b < DIM; ++b, ++f) {
                double x = sums[f] / count - (sums[1 + a] / count) * (sums[1 + b] / count);
                if (a == b) x = GMM_MAX(x, 0.0) + reg_covar;
                covariance[a * DIM + b] = alive ? x : c[a * DIM + b];
                covariance[b * DIM + a] = alive ? x : c[b * DIM + a];
            }
    };
    auto least_eigenvalue = [](const double* matrix) {
        double x[DIM][DIM];
        for (int a = 0; a < DIM; ++a)
            for (int b = 0; b < DIM; ++b) x[a][b] = matrix[a * DIM + b];
        for (int sweep = 0; sweep < 30; ++sweep) {  // Jacobi's rotations
            double off = 0.0, on = 0.0;
            for (int a = 0; a < DIM; ++a)
                for (int b = 0; b < DIM; ++b) (a == b ? on : off) += x[a][b] * x[a][b];
            if (!(off > 1e-32 * on)) break;
            for (int a = 0; a < DIM; ++a)
                for (int b = a + 1; b < DIM; ++b) {
                    if (x[a][b] == 0.0) continue;
                    const double w = (x[b][b] - x[a][a]) / (2.0 * x[a][b]);
                    const double t = (w < 0.0 ? -1.0 : 1.0) / (fabs(w) + sqrt(w * w + 1.0));
                    const double cosine = 1.0 / sqrt(t * t + 1.0), sine = t * cosine;
                    const double turn = t * x[a][b];
                    x[a][a] -= turn, x[b][b] += turn;
                    x[a][b] = x[b][a] = 0.0;
                    for (int k = 0; k < DIM; ++k) {
                        if (k == a || k == b) continue;
                        const double y = x[k][a], z = x[k][b];
                        x[k][a] = x[a][k] = cosine * y - sine * z;
                        x[k][b] = x[b][k] = sine * y + cosine * z;
                    }
                }
        }
        double least = x[0][0];
        for (int a = 1; a < DIM; ++a) least = GMM_MIN(least, x[a][a]);
        return least;
    };
    double* em_covariance = em_covariances + item * DIM * DIM;
    maximized(s, em_masses + item, em_means + item * DIM, em_covariance);
    if (!last) return;
    const double* old = last + item * WIDTH;
    double ahead[WIDTH], shift[DIM], before[WIDTH];
    for (int a = 0; a < DIM; ++a) shift[a] = last_means[item * DIM + a] - means[item * DIM + a];
    before[0] = old[0];
    for (int a = 0, f = 1 + DIM; a < DIM; ++a) {
        before[1 + a] = old[1 + a] + old[0] * shift[a];
        for (int b = a; b < DIM; ++b, ++f)
            before[f] = old[f] + old[1 + a] * shift[b] + shift[a] * (old[1 + b] + old[0] * shift[b]);
    }
    const bool heavy = s[0] + share * (s[0] - before[0]) > 0.2 * s[0];
    for (int f = 0; f < WIDTH; ++f) ahead[f] = heavy ? s[f] + share * (s[f] - before[f]) : s[f];
    double *mean = new_means + item * DIM, *covariance = new_covariances + item * DIM * DIM;
    maximized(ahead, new_masses + item, mean, covariance);
    trusted[item] = heavy && least_eigenvalue(covariance) > 0.3 * least_eigenvalue(em_covariance);
    if (trusted[item]) return;
    for (int a = 0; a < DIM; ++a) mean[a] = em_means[item * DIM + a];
    for (int f = 0; f < DIM * DIM; ++f) covariance[f] = em_covariance[f];
"""


def _kernels(name: str, parameters: str, body: str) -> dict[int, FusedKernel]:
    return {
        dim: FusedKernel(
            f"{name}_{dim}d",
            parameters,
            body.replace("WIDTH", str(1 + dim + dim * (dim + 1) // 2)).replace("DIM", str(dim)),
        )
        for dim in DIMENSIONS
    }


_NATURALS = _kernels(
    "natural_parameters",
    "const double* weights, const double* means, const double* covariances, double* natural, bool* failed",
    _NATURAL,
)
_STEPS = _kernels(
    "m_step",
    "const double* statistics, const double* means, const double* covariances, bool about_means,"
    " double reg_covar, const double* last, const double* last_means, double share, double* em_masses,"
    " double* em_means, double* em_covariances, double* new_masses, double* new_means,"
    " double* new_covariances, bool* trusted",
    _STEP,
)

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
    given = weights.contiguous(), None if means is None else means.contiguous(), covariances.contiguous()
    _NATURALS[dim](k, *given, natural, failed, device=weights.device)
    return natural, failed[0]


def fused_maximization(statistics: Tensor, dim: int, reg_covar: float, previous: Mixture | None) -> Mixture:
    """M-step from statistics (K, F), in their frame; components without points keep `previous` values."""
    k = statistics.shape[0]
    made = statistics.new_empty(k * (1 + dim + dim * dim))
    masses, means = made[:k], made[k : k + k * dim].view(k, dim)
    covariances = made[k + k * dim :].view(k, dim, dim)
    _, *kept = (None, None, None) if previous is None else (part.contiguous() for part in previous)
    given = statistics.contiguous(), *kept, False, reg_covar, None, None, 0.0
    _STEPS[dim](k, *given, masses, means, covariances, *[None] * 4, device=statistics.device)
    return masses / masses.sum(), means, covariances


def fused_steps(
    statistics: Tensor, before: Mixture, reg_covar: float, last: tuple[Tensor, Tensor] | None, share: float
) -> tuple[Mixture, Mixture | None]:
    """EM's own step, and the step from statistics that are extrapolated by a `share` of their last change.

    Args:
        statistics: (K, F) about the means `before`. last: the statistics (K, F) of the step before, and the
            means (K, D) that they are about; with None, nothing is extrapolated.
    """
    _, means, covariances = (part.contiguous() for part in before)
    k, dim = means.shape
    em = means.new_empty(k), torch.empty_like(means), torch.empty_like(covariances)
    given = statistics.contiguous(), means, covariances, True, reg_covar
    if last is None:
        _STEPS[dim](k, *given, None, None, share, *em, *[None] * 4, device=means.device)
        return (em[0] / em[0].sum(), *em[1:]), None
    new = torch.empty_like(em[0]), torch.empty_like(means), torch.empty_like(covariances)
    trusted = torch.empty(k, dtype=torch.bool, device=means.device)
    old = last[0].contiguous(), last[1].contiguous()
    _STEPS[dim](k, *given, *old, share, *em, *new, trusted, device=means.device)
    em_weights = em[0] / em[0].sum()
    weights = torch.where(trusted, new[0] / new[0].sum(), em_weights)
    return (em_weights, *em[1:]), (weights / weights.sum(), *new[1:])
