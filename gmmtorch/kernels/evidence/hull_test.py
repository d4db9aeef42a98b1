"""Lists of the cones whose hulls can give evidence near a place, see `occupancy.cone_index`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel
from gmmtorch.kernels.evidence.point_evidence import sum_of
from gmmtorch.linalg import ragged_index

_KERNELS = {dim: FusedKernel("evidence/near_lists.h", f"near_lists<{dim}>") for dim in (2, 3)}
_PARTS = 32  # of a list, on a device with many threads


class Lists(NamedTuple):
    """Lists of cones: list i holds `entries[starts[i] : starts[i + 1]]`. starts int64, entries int32."""

    starts: Tensor
    entries: Tensor

    @classmethod
    def of(cls, lengths: Tensor, entries: Tensor) -> Lists:
        """Lists of these lengths, one after the other."""
        return cls(torch.cat([lengths.new_zeros(1), lengths.cumsum(0)]), entries)

    def lengths(self) -> Tensor:
        """Number of cones in each list."""
        return self.starts[1:] - self.starts[:-1]

    def taken(self, lists: Tensor) -> tuple[Tensor, Tensor]:
        """All entries of some lists (T,), in order: position in `lists` (P,) and cone (P,), int64."""
        place, within = ragged_index(self.lengths()[lists])
        return place, self.entries[self.starts[lists][place] + within].long()


def near_lists(
    table: Tensor,
    given: Lists,
    lists: Tensor,
    centers: Tensor,
    radii: Tensor,
    cube_reach: float,
    spread: float,
) -> Lists:
    """For each ball (T,), those cones of its list that can give evidence to a cube centred in the ball.

    Args:
        table: (C, n) float64, a row for each cone: its axes (D²), mean, sensor origin and squared half axes
            at the cutoff (D each), the distance between mean and origin, and that to the farthest point.
        lists: (T,) a list of `given` for each ball. Balls of one list that follow each other share its cost.
        centers, radii: (T, D), (T,) of the balls, float64.
        cube_reach: from the centre of a cube to its corners; spread: see `Hulls`; metres.
    """
    lengths = given.lengths()[lists]
    if is_fused(table, given.entries, lists, centers):
        ends = lengths.cumsum(0)
        firsts, counts = ends - lengths, torch.zeros_like(lengths, dtype=torch.float64)
        near = torch.empty(int(ends[-1]) if len(ends) else 0, dtype=torch.bool, device=table.device)
        lanes, parts = (CPU_LANES, 1) if table.device.type == "cpu" else (1, _PARTS)
        arguments = (table, *given, lists, firsts, centers.contiguous(), radii.contiguous(), len(lists))
        sizes = (cube_reach, spread, parts)
        n_items = (len(lists) + lanes - 1) // lanes * parts
        _KERNELS[centers.shape[1]](n_items, *arguments, *sizes, near, counts, device=table.device)
        counts = counts.long()
        shift = torch.repeat_interleave(given.starts[lists] - firsts, counts)
        return Lists.of(counts, given.entries[near.nonzero().squeeze(1) + shift])
    ball, cone = given.taken(lists)
    near = _near_cone(table.T, cone, centers[ball], radii[ball], cube_reach, spread)
    return Lists.of(torch.bincount(ball[near], minlength=len(lists)), cone[near].int())


def _near_cone(
    table: Tensor, cone: Tensor, centers: Tensor, radius: Tensor, cube_reach: float, spread: float
) -> Tensor:
    """Whether each cone (P,) meets its ball; the twin. The cones are columns of the table.

    Let y, within R of the centre x, lie on the segment from the sensor origin s to a point p of the
    ellipsoid E. Then the ray from s through x passes, beyond x, within R |p − s|/|y − s| ≤ β of p, with β =
    R·far/(|x − s| − R). So from x on this ray meets the sum of E and a ball of radius β. The ellipsoid (1 +
    ε)E + (1 + 1/ε)β²I contains that sum for every ε > 0. The test uses two values of ε, which are tight
    along the two longest axes. In the smoothed case E is widened first.
    """
    dim = centers.shape[1]
    columns = [column[cone] for column in table]
    mean, origin, squares = (columns[dim * dim + i * dim :][:dim] for i in range(3))
    whole, far = columns[-2:]
    axes = [columns[i * dim : (i + 1) * dim] for i in range(dim)]  # axes[i][j]: entry i of axis j
    x = centers.unbind(1)
    ray = [a - s for a, s in zip(x, origin, strict=True)]
    offset = [a - m for a, m in zip(x, mean, strict=True)]
    y = [sum_of(axes[i][j] * offset[i] for i in range(dim)) for j in range(dim)]
    z = [sum_of(axes[i][j] * ray[i] for i in range(dim)) for j in range(dim)]
    distance = sum_of(r * r for r in ray).sqrt()
    reach = radius if spread > 0 else radius + cube_reach
    clear = (distance - reach).clamp_min(1e-12)
    widened = (spread * (whole / clear).clamp_min(1)) ** 2  # added variance, of the rays and of the component
    far = far + widened.sqrt()
    beta = far * reach / clear
    near = distance <= far + reach
    for axis in (-1, -2):
        ratio = (beta / (squares[axis] + widened).sqrt().clamp_min(1e-12)).clamp(1e-6, 1e6)
        added = (1 + ratio) * widened + (1 + 1 / ratio) * beta**2
        weight = [1 / ((1 + ratio) * square + added) for square in squares]
        cc = sum_of(w * a * a for w, a in zip(weight, y, strict=True))
        bb = sum_of(w * a * b for w, a, b in zip(weight, y, z, strict=True))
        aa = sum_of(w * b * b for w, b in zip(weight, z, strict=True))
        # Squared Mahalanobis distance to the inflated ellipsoid, at x or at the nearest point of the ray
        # beyond x.
        near = near & (cc - bb.clamp_max(0) ** 2 / aa.clamp_min(1e-300) < 1 + 1e-6)
    # The bound does not hold where the cube contains the sensor origin: these cones count as near.
    return near | (distance <= (reach + cube_reach) * (1 + 1e-9))
