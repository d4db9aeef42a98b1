"""Cones: components as seen from places, which is what every form of evidence is computed from."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import safe_cholesky

CUTOFF = 5.0
"""Standard deviations beyond which a component is taken to end: evidence outside is exactly zero."""


class Cones(NamedTuple):
    """Components as seen from places: C rows, a component seen from two places takes two rows.

    means (C, D), covariances (C, D, D): the component; origins (C, D): the sensor position;
    counts (C,): its points measured from there; max_range (C,) bool: points that met no surface.
    """

    means: Tensor
    covariances: Tensor
    origins: Tensor
    counts: Tensor
    max_range: Tensor

    @property
    def dim(self) -> int:
        return self.means.shape[1]


def whitening(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """W (C, D, D), float64, with W Σ Wᵀ = I, and log √det 2πΣ (C,).

    Differences x − μ are whitened, never positions: in float32 the latter cancel (a component 5 mm
    thick seen from 10 m away has whitened coordinates in the thousands).
    """
    factors = safe_cholesky(covariances.double())
    dim = covariances.shape[-1]
    eye = torch.eye(dim, dtype=torch.float64, device=covariances.device).expand_as(factors)
    inverse = torch.linalg.solve_triangular(factors, eye, upper=False)
    log_norm = factors.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * dim * math.log(2 * math.pi)
    return inverse, log_norm
