"""Lists of the cones whose hulls can give evidence near a place, see `occupancy.cone_index`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.evidence.point_evidence import sum_of
from gmmtorch.kernels.simd import CPU_LANES, SIMD
from gmmtorch.linalg import ragged_index

_BODY = """
    const int64_t begin = item / parts * LANES, stop = GMM_MIN(begin + LANES, n_balls), part = item % parts;
    vec x[DIM], ball, number = (vec)(-1.0);
    double n_near[LANES];
    for (int l = 0; l < LANES; ++l) {
        const int64_t i = GMM_MIN(begin + l, stop - 1);
        for (int a = 0; a < DIM; ++a) set(x[a], l, centers[i * DIM + a]);
        set(ball, l, radii[i]);
        if (begin + l < stop) set(number, l, (double)lists[i]);
        n_near[l] = 0.0;
    }
    const vec reach = spread > 0.0 ? ball : ball + cube_reach;
    for (int first = 0; first < LANES; ++first) {  // each list of these balls once
        const double mine = get(number, first);
        if (mine < 0.0 || (first > 0 && get(number, first - 1) == mine)) continue;
        const mask active = number == mine;
        int last = first;
        while (last + 1 < LANES && get(number, last + 1) == mine) ++last;
        const int64_t list = (int64_t)mine, from = starts[list];
        for (int64_t at = from + part; at < starts[list + 1]; at += parts) {
            const double* row = rows + entries[at] * WIDTH;
            GMM_FETCH(rows + entries[GMM_MIN(at + AHEAD * parts, starts[list + 1] - 1)] * WIDTH, WIDTH);
            const double *mean = row + DIM * DIM, *origin = mean + DIM, *squares = origin + DIM;
            vec ray[DIM], y[DIM], z[DIM], distance = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) {
                ray[j] = x[j] - origin[j];
                distance += ray[j] * ray[j];
            }
            distance = root(distance);
            vec clear = distance - reach;
            clear = clear < 1e-12 ? (vec)(1e-12) : clear;
            const vec closeness = 1.0 / clear;
            vec widened = squares[DIM] * closeness;
            widened = spread * (widened < 1.0 ? (vec)(1.0) : widened);
            const vec far = squares[DIM + 1] + widened, beta = far * reach * closeness;
            // All of the ellipsoid lies within its longest half axis of the mean: a quick test.
            double mm = 0.0;
            vec along = (vec)(0.0);
            for (int j = 0; j < DIM; ++j) {
                const double seen = mean[j] - origin[j];
                mm += seen * seen;
                along += seen * ray[j];
            }
            const vec within = squares[DIM + 1] - squares[DIM] + widened + beta, square = distance * distance;
            mask close = distance <= far + reach;
            close &= (mm * (1.0 - 1e-14) - within * within) * square <= along * along;
            widened *= widened;
            if (any(active & close)) {
                for (int j = 0; j < DIM; ++j) {
                    y[j] = z[j] = (vec)(0.0);
                    for (int i = 0; i < DIM; ++i) {
                        y[j] += row[i * DIM + j] * (x[i] - mean[i]);
                        z[j] += row[i * DIM + j] * ray[i];
                    }
                }
            }
            for (int axis = DIM - 1; axis >= DIM - 2 && any(active & close); --axis) {
                vec ratio = root(squares[axis] + widened);
                ratio = beta / (ratio < 1e-12 ? (vec)(1e-12) : ratio);
                ratio = ratio < 1e-6 ? (vec)(1e-6) : ratio > 1e6 ? (vec)(1e6) : ratio;
                const vec more = 1.0 + ratio, added = more * widened + (1.0 + 1.0 / ratio) * beta * beta;
                vec aa = (vec)(0.0), bb = (vec)(0.0), cc = (vec)(0.0);
                for (int j = 0; j < DIM; ++j) {
                    const vec weight = 1.0 / (more * squares[j] + added);
                    aa += weight * z[j] * z[j];
                    bb += weight * y[j] * z[j];
                    cc += weight * y[j] * y[j];
                }
                bb = bb > 0.0 ? (vec)(0.0) : bb;
                aa = aa < 1e-300 ? (vec)(1e-300) : aa;
                close &= cc - bb * bb / aa < 1.0 + 1e-6;
            }
            close |= distance <= (reach + cube_reach) * (1.0 + 1e-9);
            const vec found = close ? (vec)(1.0) : (vec)(0.0);
            for (int l = first; l <= last; ++l) {
                const double is_near = get(found, l);
                near[firsts[begin + l] + at - from] = is_near > 0.0;
                n_near[l] += is_near;
            }
        }
    }
    for (int l = 0; l < LANES && begin + l < stop; ++l)
        if (n_near[l] > 0.0) GMM_ADD(counts + begin + l, n_near[l]);
"""
_KERNELS = {
    dim: FusedKernel(
        f"near_lists_{dim}d",
        "const double* rows, const int64* starts, const int32* entries, const int64* lists,"
        " const int64* firsts, const double* centers, const double* radii, int64 n_balls, double cube_reach,"
        " double spread, int64 parts, bool* near, double* counts",
        SIMD
        + _BODY.replace("AHEAD", "6").replace("WIDTH", str(dim * dim + 3 * dim + 2)).replace("DIM", str(dim)),
    )
    for dim in (2, 3)
}
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
    compiled: bool = False,
) -> Lists:
    """For each ball (T,), those cones of its list that can give evidence to a cube centred in the ball.

    Args:
        table: (C, n) float64, a row for each cone: its axes (D²), mean, sensor origin and squared half axes
            at the cutoff (D each), the distance between mean and origin, and that to the farthest point.
        lists: (T,) a list of `given` for each ball. Balls of one list that follow each other share its cost.
        centers, radii: (T, D), (T,) of the balls, float64.
        cube_reach: from the centre of a cube to its corners; spread: see `Hulls`; metres.
        compiled: torch.compile for the twin.
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
    test = _compiled_near() if compiled else _near_cone
    near = test(table.T, cone, centers[ball], radii[ball], cube_reach, spread)
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


@functools.cache
def _compiled_near() -> Callable[..., Tensor]:
    compiled: Callable[..., Tensor] = torch.compile(_near_cone, dynamic=True)
    return compiled
