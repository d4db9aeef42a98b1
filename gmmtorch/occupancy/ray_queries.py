"""Queries along rays: where a beam ends, given the occupancy of the cells on its way."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.evidence import occupancy_probability
from gmmtorch.occupancy.forms.point import PointForm
from gmmtorch.occupancy.grid import MEMORY_LIMIT

_CHUNK_CELLS = 1 << 18


class RayHits(NamedTuple):
    """Where R beams end: probability (R, S) of ending in each cell, and no_hit (R,) of ending in none.

    depth (S,): distance (m) of the cell centres from the sensor origin. A row and its no_hit sum to 1.
    """

    depth: Tensor
    probability: Tensor
    no_hit: Tensor


class ExpectedRange(NamedTuple):
    """Expected range `mean` (R,) in metres, counting no hit as `max_range`; no_hit (R,): its probability."""

    mean: Tensor
    no_hit: Tensor


def first_hit(occupancy: Tensor) -> tuple[Tensor, Tensor]:
    """o_i Π_{j<i} (1 − o_j), (…, S), for cells in the order along a beam, and Π_j (1 − o_j), (…)."""
    passed = torch.cumprod(1 - occupancy, -1)
    reached = torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], -1)
    return occupancy * reached, passed[..., -1]


def hit_probability(
    cones: Cones | PointForm,
    origins: ArrayLike,
    directions: ArrayLike,
    max_range: float,
    resolution: float,
    prior: float = 1.0,
) -> RayHits:
    """Probability that a beam ends in each cell on its way.

    Cells are cubes of side h = `resolution` with centres on the beam at (i + ½)h, up to `max_range`. Their
    occupancy comes from the point form.

    Args:
        cones: the cones, or for several calls a `PointForm` of them at this resolution.
        origins: (R, D) sensor origins, world metres.
        directions: (R, D), of any length above zero.
        max_range: range of the sensor (m).
        resolution: h (m).
        prior: N_p of thesis (3.9).

    Raises:
        InvalidArgumentError: shapes that do not match, values that are not finite, a direction of length
            zero, a range that is not above zero, or a form made for another resolution.
        MemoryLimitError: R·S cells exceed the memory limit.
    """
    depth, occupancies = _along(cones, origins, directions, max_range, resolution, prior)
    if len(origins) * depth.shape[0] * 8 > MEMORY_LIMIT:
        raise MemoryLimitError(
            f"{len(origins):,} rays of {depth.shape[0]:,} cells take more than {MEMORY_LIMIT:,} bytes; "
            "pass fewer rays per call, or use expected_range, which does not store the cells."
        )
    probability, no_hit = zip(*map(first_hit, occupancies), strict=True)
    return RayHits(depth, torch.cat(probability), torch.cat(no_hit))


def expected_range(
    cones: Cones | PointForm,
    origins: ArrayLike,
    directions: ArrayLike,
    max_range: float,
    resolution: float,
    prior: float = 1.0,
) -> ExpectedRange:
    """Expected range of a beam, Σ p_i d_i + p_none · max_range; arguments as for `hit_probability`."""
    depth, occupancies = _along(cones, origins, directions, max_range, resolution, prior)
    reported = depth.clamp_max(max_range)  # the last cell can extend beyond the range
    means, none = [], []
    for occupancy in occupancies:
        probability, no_hit = first_hit(occupancy)
        means.append(probability @ reported + no_hit * max_range)
        none.append(no_hit)
    return ExpectedRange(torch.cat(means), torch.cat(none))


def _along(
    cones: Cones | PointForm,
    origins: ArrayLike,
    directions: ArrayLike,
    max_range: float,
    resolution: float,
    prior: float,
) -> tuple[Tensor, Iterator[Tensor]]:
    """Distance (S,) of the cell centres along a beam (m), and the occupancy (r, S) of chunks of r rays.

    Raises the errors of `hit_probability`.
    """
    form = cones if isinstance(cones, PointForm) else PointForm(cones, resolution)
    if form.resolution != resolution:
        raise InvalidArgumentError(
            f"resolution={resolution} m differs from that of the PointForm, {form.resolution} m; "
            "make a form for this resolution."
        )
    if not 0 < max_range < math.inf:
        raise InvalidArgumentError(f"max_range={max_range} must be metres above zero.")
    n_cells = math.ceil(max_range / form.resolution * (1 - 1e-12))
    if n_cells * 8 > MEMORY_LIMIT // 16:
        raise MemoryLimitError(
            f"max_range={max_range} m at resolution={form.resolution} m is {n_cells:,} cells a ray; "
            "take a larger resolution."
        )
    start = as_tensor(origins, "origins", torch.float64)
    direction = as_tensor(directions, "directions", torch.float64)
    if start.shape != direction.shape or start.ndim != 2 or start.shape[1] != form.dim:
        raise InvalidArgumentError(
            f"origins {tuple(start.shape)} and directions {tuple(direction.shape)} must both be "
            f"(R, {form.dim})."
        )
    for name, value in (("origins", start), ("directions", direction)):
        if not bool(torch.isfinite(value).all()):
            raise InvalidArgumentError(
                f"{name} contains NaN or infinite values; remove such rays before the query."
            )
    length = direction.norm(dim=1, keepdim=True)
    if bool((length == 0).any()):
        raise InvalidArgumentError("directions contains a vector of length zero; give each ray a direction.")
    steps = torch.arange(n_cells, dtype=torch.float64, device=start.device)
    depth = (steps + 0.5) * form.resolution

    def occupancies() -> Iterator[Tensor]:
        n_rays = max(1, _CHUNK_CELLS // n_cells)
        for begin, toward in zip(start.split(n_rays), (direction / length).split(n_rays), strict=True):
            points = begin[:, None] + toward[:, None] * depth[:, None]
            yield occupancy_probability(*form(points.flatten(0, 1)), prior).view(points.shape[:2])

    return depth, occupancies()
