"""Mass of Gaussians in the cells of a grid; the twin is `box_mass` on all pairs of a cell and a component.

The fused kernel works on boxes of cells around a component. All cells of a grid have the same whitened edges,
so they share the edge with the closed form. Panels are cut and integrated by the rules of
`occupancy.forms.quadrature`, as in `face_flux`: results differ within the tolerance.
"""

from __future__ import annotations

import math

from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.evidence.face_flux import with_panels
from gmmtorch.kernels.simd import SIMD

_BODY = """
    const double* c = cones + cone[item] * 16;  // W (9), sensor origin (3), W(mean - origin) (3), scale
    const double *origin = c + 9, *toward = c + 12;
    double side_edge[3][3], start[3], longest = -1.0;
    int64_t box[3] = {1, 1, 1}, corner[3] = {0, 0, 0}, chosen = 0;
    for (int b = 0; b < dim; ++b) {
        corner[b] = first[item * dim + b];
        box[b] = number[item * dim + b];
        double square = 0.0;
        for (int r = 0; r < 3; ++r) {
            side_edge[b][r] = c[3 * r + b] * side;
            square += side_edge[b][r] * side_edge[b][r];
        }
        if (square > longest) longest = square, chosen = b;
    }
    const int64_t n_cells = box[0] * box[1] * box[2];
    const double span = sqrt(longest), place[3] = {place0, place1, place2};
    const int64_t stride[3] = {stride0, stride1, stride2};
    double d[3], edge[2][3], rise[2], turned[2], spread[2][3];
    for (int r = 0; r < 3; ++r) {
        d[r] = side_edge[chosen][r] / span;
        start[r] = -toward[r];  // W(q - mean) of the middle of the lower cross-section of cell 0
        for (int b = 0; b < dim; ++b) {
            const double middle = place[b] + ((double)corner[b] + (b == chosen ? 0.0 : 0.5)) * side;
            start[r] += c[3 * r + b] * (middle - origin[b]);
        }
    }
    for (int e = 0; e < 2; ++e) {
        const int64_t b = (chosen + 1 + e) % dim;
        const bool is_edge = e < dim - 1;
        for (int r = 0; r < 3; ++r) edge[e][r] = is_edge ? side_edge[b][r] : 0.0;
        const double* v = edge[e];
        rise[e] = v[0] * d[0] + v[1] * d[1] + v[2] * d[2];
        spread[e][0] = v[1] * d[2] - v[2] * d[1];
        spread[e][1] = v[2] * d[0] - v[0] * d[2];
        spread[e][2] = v[0] * d[1] - v[1] * d[0];
        const double* s = spread[e];
        turned[e] = sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    }
    const double rise0 = rise[0] < 0.0 ? -rise[0] : rise[0], rise1 = rise[1] < 0.0 ? -rise[1] : rise[1];
    double volume = c[15] * counts[cone[item]];  // over the closed edge, times (2 pi)^(1/2)
    for (int b = 0; b < dim; ++b) volume *= side;
    volume *= 2.5066282746310002 / span;
    auto upper = [&](vec x) {
        const vec tail = expo(-0.5 * x * x) * mills(x < 0.0 ? -x : x) * 0.39894228040143268;
        return x < 0.0 ? 1.0 - tail : tail;
    };
    auto normal_mass = [&](vec low) {
        if (span <= 0.1) {
            const vec middle = (low + 0.5 * span) * (low + 0.5 * span);
            const vec series = 1.0 + span * span * (middle - 1.0) / 24.0;
            return span * (expo(-0.5 * middle) * 0.39894228040143268) * series;
        }
        const vec near = 2.0 * low + span < 0.0 ? -low - span : low;
        return upper(near) - upper(near + span);
    };
    RULES
    constexpr int STACK = LANES * 15 * 27;  // panels that wait: 27 levels down to the smallest
    int64_t waiting = 0, next = 0;
    int64_t stack_index[STACK];
    double stack_panel[STACK][4];
    while (waiting > 0 || next < n_cells) {
        vec base0 = (vec)(0.0), base1 = (vec)(0.0), scale0 = (vec)(1.0), scale1 = (vec)(1.0);
        vec active_lane = (vec)(0.0), at[3] = {(vec)(0.0), (vec)(0.0), (vec)(0.0)};
        int64_t cell[LANES];
        for (int l = 0; l < LANES; ++l) {
            if (waiting > 0) {
                --waiting;
                cell[l] = stack_index[waiting];
                set(base0, l, stack_panel[waiting][0]);
                set(base1, l, stack_panel[waiting][1]);
                set(scale0, l, stack_panel[waiting][2]);
                set(scale1, l, stack_panel[waiting][3]);
            } else if (next < n_cells) {
                cell[l] = next++;
            } else {
                break;
            }
            set(active_lane, l, 1.0);
            set(at[0], l, (double)(cell[l] / (box[1] * box[2])));
            set(at[1], l, (double)(cell[l] / box[2] % box[1]));
            set(at[2], l, (double)(cell[l] % box[2]));
        }
        vec o[3];
        for (int r = 0; r < 3; ++r) {
            o[r] = start[r] + base0 * edge[0][r] + base1 * edge[1][r];
            for (int b = 0; b < dim; ++b) o[r] += at[b] * side_edge[b][r];
        }
        const vec along = o[0] * d[0] + o[1] * d[1] + o[2] * d[2];
        const vec x = o[1] * d[2] - o[2] * d[1], y = o[2] * d[0] - o[0] * d[2], z = o[0] * d[1] - o[1] * d[0];
        const vec slope = 0.5 * (rise0 * scale0 + rise1 * scale1);
        const vec across = root(x * x + y * y + z * z) - 0.5 * (turned[0] * scale0 + turned[1] * scale1);
        const mask inside = (active_lane > 0.0) & (across <= cutoff) & (along - slope <= cutoff)
                            & (along + span + slope >= -cutoff);
        if (!any(inside)) continue;
        const vec end = along + span;
        const vec low_end = along < 0.0 ? -along : along, high_end = end < 0.0 ? -end : end;
        const mask simple = (low_end < high_end ? low_end : high_end) - slope > 6.0;
        const vec risen0 = simple ? (vec)(0.0) : rise0 * scale0;
        const vec risen1 = simple ? (vec)(0.0) : rise1 * scale1;
        const vec turned0 = turned[0] * scale0, turned1 = turned[1] * scale1;
        const vec change0 = root(turned0 * turned0 + risen0 * risen0);
        const vec change1 = root(turned1 * turned1 + risen1 * risen1);
        const mask fine = ((change0 <= limit3) & (change1 <= limit3)) | (scale0 < 1e-15) | (scale1 < 1e-15);
        const mask ready = inside & fine;
        if (any(ready)) {
            ORDERS
            vec sum = (vec)(0.0);
            for (int p = 0; p <= order0; ++p)
                for (int q = 0; q <= order1; ++q) {
                    const vec f = GAUSS[order0][p] * scale0, g = GAUSS[order1][q] * scale1;
                    const vec u = x + f * spread[0][0] + g * spread[1][0];
                    const vec v = y + f * spread[0][1] + g * spread[1][1];
                    const vec w = z + f * spread[0][2] + g * spread[1][2];
                    const vec far = u * u + v * v + w * w, low = along + f * rise[0] + g * rise[1];
                    vec beyond = low > -low - span ? low : -low - span;
                    beyond = beyond < 0.0 ? (vec)(0.0) : beyond;
                    const mask reached = far + beyond * beyond < cutoff * cutoff;
                    if (!any(ready & reached)) continue;
                    const vec density = expo(-0.5 * far) * normal_mass(low);
                    sum += WEIGHT[order0][p] * WEIGHT[order1][q] * (reached ? density : (vec)(0.0));
                }
            sum = ready ? sum * volume * scale0 * scale1 : (vec)(0.0);
            for (int l = 0; l < LANES; ++l) {
                const double value = get(sum, l);
                if (value == 0.0) continue;
                int64_t flat = target ? target[item] : 0, left = cell[l];
                for (int b = 2; b >= 0; --b) {
                    flat += (corner[b] + left % box[b]) * stride[b];
                    left /= box[b];
                }
                GMM_ADD(hits + flat, value);
            }
        }
        SPLIT
    }
"""
_KERNEL = FusedKernel(
    "cell_mass",
    "const double* cones, const double* counts, const int64* cone, const int64* first, const int64* number,"
    " const int64* target, int64 dim, double place0, double place1, double place2, double side,"
    " int64 stride0, int64 stride1, int64 stride2, double cutoff,"
    " double limit0, double limit1, double limit2, double limit3, double* hits",
    SIMD + with_panels(_BODY, "cell"),
    shares=True,
)


def add_cell_mass(
    hits: Tensor,
    cones: Tensor,
    counts: Tensor,
    boxes: tuple[Tensor, Tensor, Tensor],
    grid: tuple[tuple[float, ...], float, tuple[int, ...]],
    cutoff: float,
    limits: tuple[float, ...],
    target: Tensor | None = None,
) -> None:
    """Add the mass of components in boxes of cells, times their counts, to the hits of the cells.

    Args:
        hits: (cells,) float64, row-major; or (M,), of any cells, if `target` is given.
        cones, counts: as in `face_flux.add_row_flux`.
        boxes: cone (R,) and first, number (R, D) of `culling.BallRows`.
        grid, limits, target: as in `face_flux.add_row_flux`.
    """
    cone, first, number = (part.contiguous() for part in boxes)
    origin, side, shape = grid
    dim = len(shape)
    pad = 3 - dim
    strides = [math.prod(shape[a + 1 :]) if target is None else 0 for a in range(dim)]
    _KERNEL(
        len(cone),
        cones.contiguous(),
        counts.contiguous(),
        cone,
        first,
        number,
        target,
        dim,
        *origin,
        *[0.0] * pad,
        side,
        *strides,
        *[0] * pad,
        cutoff,
        *limits,
        hits,
        device=hits.device,
    )
