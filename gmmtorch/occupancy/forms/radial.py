"""The closed radial integrals that point, ray and face forms share.

A component's points x are measured from s: each stands for a ray s → x. Seen along a direction, the
density of where rays end is a Gaussian of the distance, so that what ends beyond a place has a closed
form with one erfc and one exponential.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_SQRT_HALF_PI = math.sqrt(math.pi / 2)


def flux_density(white_ray: Tensor, white_offset: Tensor, log_norm: Tensor) -> Tensor:
    """Rays per unit of a component's support that pass the place q and end beyond it.

    With u = q − s the expected number of rays through a face A is N ∫_A f (u·n) dA, f what is
    returned: f = ∫_1^∞ t^{D−1} N(s + tu | μ, Σ) dt. Rays through a unit area that faces them: f·|u|.
    Everything comes from *whitened differences*, so that nothing cancels, in float32 either: with
    w = W(q − s), d = W(q − μ), â = d·w/|w|, the squared distance of the ray from the mean is |d − â w/|w||².

    Args:
        white_ray: W(q − s) (…, D); not zero.
        white_offset: W(q − μ) (…, D).
        log_norm: log √det 2πΣ (…).
    """
    dim = white_ray.shape[-1]
    length = white_ray.norm(dim=-1)
    direction = white_ray / length[..., None]
    along = (white_offset * direction).sum(-1)  # a: where q is, in deviations from the ray's nearest point
    across = white_offset - along[..., None] * direction
    peak = torch.exp(-0.5 * (across * across).sum(-1) - log_norm)
    return peak * tail_moment(along, length - along, dim) / length**dim


def tail_moment(along: Tensor, depth: Tensor, dim: int) -> Tensor:
    """∫_a^∞ (w + b)^{D−1} e^{−w²/2} dw: what ends beyond a place, in the deviations of one ray.

    along: a, where the place is; depth: b, how far the ray's nearest point to the mean is from the
    sensor; any shape. With Q = √(π/2) erfc(a/√2) and g = e^{−a²/2} it is b Q + g in 2D and
    (b² + 1) Q + (2b + a) g in 3D.
    """
    tail = _SQRT_HALF_PI * torch.special.erfc(along * math.sqrt(0.5))
    edge = torch.exp(-0.5 * along * along)
    if dim == 2:
        return depth * tail + edge
    return (depth * depth + 1) * tail + (2 * depth + along) * edge
