"""Mutual information between a range beam and the cells it meets: CSQMI and Shannon information.

A beam meets cells 1 … C in order. Cell i is occupied with probability o_i, independently of the others.
The beam measures the depth of the first occupied cell, or returns nothing; no return differs from every
depth. A cell of occupancy 0 has no effect: beams of different lengths are padded with such cells, or
`lengths` is given. All information is in nats.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels.rays.beam_information import banded_csqmi, first_block, shannon, sharpened

_NEGLIGIBLE = 1e-5
"""Kernel values below this count as zero."""


def first_hit(occupancy: Tensor, lengths: Tensor | None = None) -> Tensor:
    """Return the probability that each cell is the first occupied one, and that none is occupied.

    Args:
        occupancy: (..., C) in [0, 1], cells in order along each beam.
        lengths: (...,) number of cells of each beam; default C. Later cells do not exist.

    Returns:
        (..., C + 1): o_i Π_{j<i} (1 − o_j), and last Π_j (1 − o_j); rows sum to one.
    """
    return first_block(_ended(check_occupancy(occupancy), lengths))


def csqmi(
    occupancy: Tensor,
    depths: Tensor,
    sigma: float,
    *,
    band: int | None = None,
    lengths: Tensor | None = None,
) -> Tensor:
    """Compute the Cauchy–Schwarz quadratic mutual information of each beam's reading and the cells it meets.

    I = log(pᵀKp) − 2 log(pᵀKv), where p are the first hits of o, v those of `sharpened` o, and
    K_ij = exp(−(d_i − d_j)²/4σ²) (Charrow et al., ICRA 2015). Their products of squares, which underflow, are
    avoided, so that float32 is enough for beams of any length. A reading is normal about the depth of the
    cell hit.

    Args:
        occupancy: (..., C) in [0, 1].
        depths: (..., C), metres, expected depth of a hit in each cell, not decreasing; broadcastable.
        sigma: standard deviation of a reading (m), positive.
        band: number of cells on each side with a nonzero K_ij; default: those with K_ij above 10⁻⁵.
        lengths: (...,) number of cells of each beam; default C.

    Returns:
        (...,) nats, never negative.
    """
    check_sigma(sigma)
    ended = _ended(check_occupancy(occupancy), lengths)
    if not bool(torch.isfinite(depths).all()):
        raise InvalidArgumentError("depths must be finite, also those of cells beyond a beam's end.")
    depths = depths.expand_as(occupancy)
    if band is None:
        band = needed_band(depths, sigma)
    elif band < 0:
        raise InvalidArgumentError(f"band={band} must be at least 0, or None for an automatic choice.")
    kernel = depth_kernel(depths, sigma, band).to(occupancy.dtype)
    return banded_csqmi(first_block(ended), first_block(sharpened(ended)), kernel)


def needed_band(depths: Tensor, sigma: float, negligible: float = _NEGLIGIBLE) -> int:
    """Return the largest distance in cells at which K exceeds `negligible`; depths (..., C), not
    decreasing.
    """
    reach = 2 * sigma * math.sqrt(-math.log(negligible))
    n_cells = depths.shape[-1]
    for band in range(1, n_cells):
        if not bool((depths[..., band:] - depths[..., :-band] < reach).any()):
            return band - 1
    return max(n_cells - 1, 0)


def depth_kernel(depths: Tensor, sigma: float, band: int, lengths: Tensor | None = None) -> Tensor:
    """Return K_{i,i+s} for s = 1 … band as (band, ..., C + 1); zero if i + s is beyond the beam's cells.

    Args:
        depths: (..., C), metres.
        sigma: metres.
        lengths: (...,) number of cells of each beam; default C.
    """
    n_cells = depths.shape[-1]
    kernel = depths.new_zeros(band, *depths.shape[:-1], n_cells + 1)
    cell = torch.arange(n_cells, device=depths.device)
    for s in range(1, min(band, n_cells - 1) + 1):
        near = ((depths[..., s:] - depths[..., :-s]) / (2 * sigma)).square_().neg_().exp_()
        if lengths is not None:
            near = torch.where(cell[s:] < lengths[..., None], near, 0)
        kernel[s - 1, ..., : n_cells - s] = near
    return kernel


def fsmi(
    occupancy: Tensor,
    *,
    delta_occ: float = 1.5,
    delta_emp: float = 1 / 1.5,
    lengths: Tensor | None = None,
) -> Tensor:
    """Shannon mutual information of each beam's reading and the cells it meets (FSMI).

    I = Σ_j P(e_j) C_j over the events e_j that cell j is hit first,
    C_j = f(δ_occ, r_j) + Σ_{i<j} f(δ_emp, r_i), where r are the odds of a cell and f(δ, r) is the information
    gained by multiplying them by δ (Zhang et al., IJRR 2020, for noise within a cell). Without a hit
    every cell gets δ_emp. For δ_occ → ∞ and δ_emp → 0 this is the exact information of a noise-free
    sensor, the entropy of the first hit.

    Args:
        occupancy: (..., C) in [0, 1].
        delta_occ: factor on a cell's odds when it is hit, above 1.
        delta_emp: factor when it is passed through, in (0, 1).
        lengths: (...,) number of cells of each beam; default C.

    Returns:
        (...,) nats, never negative.
    """
    if not (1 < delta_occ < math.inf and 0 < delta_emp < 1):
        raise InvalidArgumentError(
            f"delta_occ={delta_occ} must be above 1 and finite, delta_emp={delta_emp} between 0 and 1."
        )
    ended = _ended(check_occupancy(occupancy), lengths)
    return shannon(first_block(ended), ended, delta_occ, delta_emp)


def check_sigma(sigma: float) -> None:
    if not 0 < sigma < math.inf:
        raise InvalidArgumentError(
            f"sigma={sigma} must be positive and finite: metres of noise of a reading."
        )


def check_occupancy(occupancy: Tensor) -> Tensor:
    """Return the occupancy after checking that it is (..., C) probabilities."""
    if occupancy.ndim < 1 or not occupancy.is_floating_point():
        raise InvalidArgumentError(
            f"occupancy of shape {tuple(occupancy.shape)} and {occupancy.dtype} must be (..., C) of floats."
        )
    lowest, highest = occupancy.aminmax() if occupancy.numel() else (0.0, 1.0)
    if not (lowest >= 0 and highest <= 1):  # also NaN
        raise InvalidArgumentError("occupancy must lie in [0, 1] everywhere; give unknown cells their prior.")
    return occupancy


def _ended(occupancy: Tensor, lengths: Tensor | None) -> Tensor:
    """Return (..., C + 1): cells beyond a beam's end set to 0, and a last cell of occupancy 1 for no
    return.
    """
    if lengths is not None:
        cell = torch.arange(occupancy.shape[-1], device=occupancy.device)
        occupancy = torch.where(cell < lengths[..., None], occupancy, 0)
    return torch.cat([occupancy, occupancy.new_ones(*occupancy.shape[:-1], 1)], -1)
