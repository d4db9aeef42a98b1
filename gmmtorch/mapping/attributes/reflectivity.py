"""The intensity of a surface as its reflectivity, and a law of the range and the incidence of the beam:

    I = ρ (r / r₀)^a |cos θ|^b,  cos² θ = dᵀ Σ⁻¹ d / tr Σ⁻¹,

where a beam of direction d and range r meets a component of covariance Σ; of a flat component that is the
squared cosine to its normal. ρ is the intensity at the range r₀ of a surface that faces the sensor.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from gmmtorch.mapping.learning.rules import IntensityLaw

_LEAST_COSINE = 0.1  # 84°: surfaces are not flatter, nor are their normals known better
_ROUNDS = 8  # of weights


def _view(rays: Tensor, white: Tensor) -> Tensor:
    """Logarithms (…, 2) of the ranges (m) and cosines of rays (…, D) that meet components with whitening
    (…, D, D), see `whitening`."""
    length = rays.norm(dim=-1).clamp_min(1e-9)
    across = (white @ rays[..., None]).squeeze(-1).norm(dim=-1) / white.flatten(-2).norm(dim=-1)
    return torch.stack([length, (across / length).clamp(_LEAST_COSINE, 1)], -1).log()


def gain(law: IntensityLaw, rays: Tensor, white: Tensor) -> Tensor:
    """The intensity (…) of surfaces of reflectivity 1, by the law; the arguments are those of `_view`."""
    exponents = law.exponents
    return torch.exp(_view(rays, white) @ rays.new_tensor(exponents) - exponents[0] * math.log(law.reference))


def estimated(
    law: IntensityLaw | None, rays: Tensor, white: Tensor, owner: Tensor, values: Tensor
) -> IntensityLaw | None:
    """The law after more intensities (N,): a regression of their logarithms on those of range and cosine,
    with a reflectivity for each component. None: no intensity is above 0. It is robust (Tukey's biweight),
    because lidars measure next to nothing very near, and logarithms of such values are far from all others.

    rays (N, D), white (N, D, D): as in `_view`. owner (N,): the component of each beam. law: before.
    """
    seen = (values > 0).nonzero().squeeze(1)  # False for NaN
    if not len(seen):
        return law
    owner, n = owner[seen], int(owner.max()) + 1
    rows = torch.cat([_view(rays[seen], white[seen]), values[seen].double().log()[:, None]], 1)
    before = law or IntensityLaw(float(f"{float(rows[:, 0].mean().exp()):.3g}"), 0, *[0.0] * 6)
    weight, found = torch.ones_like(rows[:, 0]), before
    for _ in range(_ROUNDS):
        total = rows.new_zeros(n, 4).index_add_(
            0, owner, weight[:, None] * functional.pad(rows, (0, 1), value=1)
        )
        away = rows - (total[:, :3] / total[:, 3:].clamp_min(1e-9))[owner]
        squares = ((away * weight[:, None]).T @ away).flatten()[[0, 1, 4, 2, 5, 8]].tolist()
        found = IntensityLaw(before.reference, float(weight.sum()), *squares)
        left = away @ rows.new_tensor([*found.exponents, -1])
        usual = 1.4826 * left.abs().median().clamp_min(1e-9)
        weight = (1 - (left / (4.685 * usual)).square()).clamp_min(0).square()
    summed = (float(f"{a + b:.6g}") for a, b in zip(before[1:], found[1:], strict=True))
    return IntensityLaw(before.reference, *summed)
