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
    form = _form(cones, resolution)
    origins, directions = as_tensor(origins, "origins"), as_tensor(directions, "directions")
    depth = _depths(max_range, form, origins)
    if origins.shape[0] * depth.shape[0] * 8 > MEMORY_LIMIT:
        raise MemoryLimitError(
            f"{origins.shape[0]:,} rays of {depth.shape[0]:,} cells take more than {MEMORY_LIMIT:,} bytes; "
            "pass fewer rays per call, or use expected_range, which does not store the cells."
        )
    parts = [first_hit(o) for o in _along(form, origins, directions, depth, prior)]
    probability = torch.cat([part[0] for part in parts])
    return RayHits(depth, probability, torch.cat([part[1] for part in parts]))


def expected_range(
    cones: Cones | PointForm,
    origins: ArrayLike,
    directions: ArrayLike,
    max_range: float,
    resolution: float,
    prior: float = 1.0,
) -> ExpectedRange:
    """Expected range of a beam, Σ p_i d_i + p_none · max_range; arguments as for `hit_probability`."""
    form = _form(cones, resolution)
    origins, directions = as_tensor(origins, "origins"), as_tensor(directions, "directions")
    depth = _depths(max_range, form, origins)
    reported = depth.clamp_max(max_range)  # the last cell can extend beyond the range
    means, none = [], []
    for occupancy in _along(form, origins, directions, depth, prior):
        probability, no_hit = first_hit(occupancy)
        means.append(probability @ reported + no_hit * max_range)
        none.append(no_hit)
    return ExpectedRange(torch.cat(means), torch.cat(none))


def _form(cones: Cones | PointForm, resolution: float) -> PointForm:
    form = cones if isinstance(cones, PointForm) else PointForm(cones, resolution)
    if form.resolution != resolution:
        raise InvalidArgumentError(
            f"resolution={resolution} m differs from that of the PointForm, {form.resolution} m; "
            "make a form for this resolution."
        )
    return form


def _depths(max_range: float, form: PointForm, origins: Tensor) -> Tensor:
    """Distance (S,) of the cell centres along a beam (m)."""
    if not 0 < max_range < math.inf:
        raise InvalidArgumentError(f"max_range={max_range} must be metres above zero.")
    n_cells = math.ceil(max_range / form.resolution * (1 - 1e-12))
    if n_cells * 8 > MEMORY_LIMIT // 16:
        raise MemoryLimitError(
            f"max_range={max_range} m at resolution={form.resolution} m is {n_cells:,} cells a ray; "
            "take a larger resolution."
        )
    steps = torch.arange(n_cells, dtype=torch.float64, device=origins.device)
    return (steps + 0.5) * form.resolution


def _along(
    form: PointForm, origins: Tensor, directions: Tensor, depth: Tensor, prior: float
) -> Iterator[Tensor]:
    """Occupancy (r, S) of the cells along the rays, for chunks of r rays."""
    start, direction = origins.double(), directions.double()
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
    direction = direction / length
    n_rays = max(1, _CHUNK_CELLS // depth.shape[0])
    for begin, toward in zip(start.split(n_rays), direction.split(n_rays), strict=True):
        points = begin[:, None] + toward[:, None] * depth[:, None]
        evidence = form(points.flatten(0, 1))
        yield occupancy_probability(*evidence, prior).view(points.shape[:2])
