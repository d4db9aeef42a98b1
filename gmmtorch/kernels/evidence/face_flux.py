"""Flux of the rays of cones through the faces of a grid; the twin is the loop of `flux_evidence`.

The fused kernel works on rows: rectangles of faces in one plane of the grid, with one cone. It drops panels
outside the cone, cuts panels on which the integrand varies much, and integrates the others by Gauss-Legendre
rules, by the rules of `occupancy.forms.quadrature`. Panels that share a vector share the order
of the rule, the highest that one of them needs. So results differ from the twin within the tolerance.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.simd import SIMD

_RULES = """
    const double GAUSS[4][4] = {
        {0.0, 0.0, 0.0, 0.0},
        {-0.28867513459481287, 0.28867513459481287, 0.0, 0.0},
        {-0.3872983346207417, 0.0, 0.3872983346207417, 0.0},
        {-0.43056815579702629, -0.16999052179242813, 0.16999052179242813, 0.43056815579702629}};
    const double WEIGHT[4][4] = {
        {1.0, 0.0, 0.0, 0.0},
        {0.5, 0.5, 0.0, 0.0},
        {0.2777777777777778, 0.4444444444444444, 0.2777777777777778, 0.0},
        {0.17392742256872693, 0.32607257743127307, 0.32607257743127307, 0.17392742256872693}};
"""
"""C++ of the nodes and weights of the Gauss-Legendre rules with 1 to 4 nodes on [−½, ½]."""

_ORDERS = """
            const int order0 = any(ready & (change0 > limit2)) ? 3 : any(ready & (change0 > limit1)) ? 2
                               : any(ready & (change0 > limit0)) ? 1 : 0;
            const int order1 = any(ready & (change1 > limit2)) ? 3 : any(ready & (change1 > limit1)) ? 2
                               : any(ready & (change1 > limit0)) ? 1 : 0;
"""
_SPLIT = """
        const mask coarse = inside & !fine;
        if (!any(coarse)) continue;
        const vec cut = coarse ? (vec)(1.0) : (vec)(0.0);
        for (int l = 0; l < LANES; ++l) {
            if (get(cut, l) == 0.0) continue;
            const double ratio0 = ceil(get(change0, l) / limit3), ratio1 = ceil(get(change1, l) / limit3);
            const int parts0 = (int)GMM_MIN(GMM_MAX(ratio0, 1.0), 4.0);
            const int parts1 = (int)GMM_MIN(GMM_MAX(ratio1, 1.0), 4.0);
            for (int p = 0; p < parts0; ++p)
                for (int q = 0; q < parts1; ++q) {
                    if (waiting >= STACK) break;  // not reached: panels end at 1e-15
                    stack_index[waiting] = INDEX[l];
                    stack_panel[waiting][0] = get(base0, l) + get(scale0, l) * ((p + 0.5) / parts0 - 0.5);
                    stack_panel[waiting][1] = get(base1, l) + get(scale1, l) * ((q + 0.5) / parts1 - 0.5);
                    stack_panel[waiting][2] = get(scale0, l) / parts0;
                    stack_panel[waiting][3] = get(scale1, l) / parts1;
                    ++waiting;
                }
        }
"""


def with_panels(body: str, index: str) -> str:
    """The body of a kernel with the rules, their orders and the division of panels that are too large.

    `index` is the variable that holds the face or cell of each lane.
    """
    parts = {"RULES": _RULES, "ORDERS": _ORDERS, "SPLIT": _SPLIT.replace("INDEX", index)}
    for name, text in parts.items():
        body = body.replace(name, text)
    return body


_BODY = """
    const double* c = cones + cone[item] * 16;  // W (9), origin (3), m = W(mean - origin) (3), scale
    const double *origin = c + 9, *m = c + 12;
    const int64_t i0 = first[2 * item], j0 = first[2 * item + 1];
    const int64_t n0 = number[2 * item], n1 = number[2 * item + 1], n_faces = n0 * n1;
    const double height = place0 + (double)plane[item] * side - origin[axis0];
    const double strength = (forward[item] ? height : -height) * area * c[15];
    const int64_t cell0 = target ? target[item] : (forward[item] ? plane[item] - 1 : plane[item]) * stride0;
    RULES
    double edge[2][3], edge_length[2], turned[2];
    for (int b = 0; b < 2; ++b) {
        const int64_t column = b == 0 ? axis1 : axis2;  // -1: a grid of the plane has one edge
        for (int r = 0; r < 3; ++r) edge[b][r] = column < 0 ? 0.0 : c[3 * r + column] * side;
        const double* e = edge[b];
        edge_length[b] = sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]);
        const double x = e[1] * m[2] - e[2] * m[1], y = e[2] * m[0] - e[0] * m[2];
        const double z = e[0] * m[1] - e[1] * m[0];
        turned[b] = sqrt(x * x + y * y + z * z);
    }
    constexpr int STACK = LANES * 15 * 27;  // panels that wait: 27 levels down to the smallest
    int64_t waiting = 0, next = 0;
    int64_t stack_index[STACK];
    double stack_panel[STACK][4];
    while (waiting > 0 || next < n_faces) {
        vec base0 = (vec)(0.0), base1 = (vec)(0.0), scale0 = (vec)(1.0), scale1 = (vec)(1.0);
        vec active_lane = (vec)(0.0), i = (vec)(0.0), j = (vec)(0.0);
        int64_t face[LANES];
        for (int l = 0; l < LANES; ++l) {
            if (waiting > 0) {
                --waiting;
                face[l] = stack_index[waiting];
                set(base0, l, stack_panel[waiting][0]);
                set(base1, l, stack_panel[waiting][1]);
                set(scale0, l, stack_panel[waiting][2]);
                set(scale1, l, stack_panel[waiting][3]);
            } else if (next < n_faces) {
                face[l] = next++;
            } else {
                break;
            }
            set(active_lane, l, 1.0);
            set(i, l, (double)(i0 + face[l] / n1));
            set(j, l, (double)(j0 + face[l] % n1));
        }
        vec ray[3];
        const vec along1 = place1 + (i + 0.5 + base0) * side - origin[axis1];
        const vec along2 =
            axis2 < 0 ? (vec)(0.0) : place2 + (j + 0.5 + base1) * side - origin[axis2];
        for (int r = 0; r < 3; ++r) {
            ray[r] = c[3 * r + axis0] * height + c[3 * r + axis1] * along1;
            if (axis2 >= 0) ray[r] += c[3 * r + axis2] * along2;
        }
        const vec square = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2];
        const vec distance = root(square);
        const vec product = square - (m[0] * ray[0] + m[1] * ray[1] + m[2] * ray[2]);  // offset * ray
        const vec x = ray[1] * m[2] - ray[2] * m[1], y = ray[2] * m[0] - ray[0] * m[2];
        const vec z = ray[0] * m[1] - ray[1] * m[0];
        const vec crossed = root(x * x + y * y + z * z);
        const vec step0 = edge[0][0] * ray[0] + edge[0][1] * ray[1] + edge[0][2] * ray[2];
        const vec step1 = edge[1][0] * ray[0] + edge[1][1] * ray[1] + edge[1][2] * ray[2];
        const double em0 = edge[0][0] * m[0] + edge[0][1] * m[1] + edge[0][2] * m[2];
        const double em1 = edge[1][0] * m[0] + edge[1][1] * m[1] + edge[1][2] * m[2];
        const vec both0 = 2.0 * step0 - em0, both1 = 2.0 * step1 - em1;  // edge * (offset + ray)
        const vec reach = 0.5 * (edge_length[0] * scale0 + edge_length[1] * scale1);
        const vec far = cutoff * (distance + reach);
        const vec across_least = crossed - 0.5 * (turned[0] * scale0 + turned[1] * scale1);
        const vec behind = product - 0.5 * ((both0 < 0.0 ? -both0 : both0) * scale0
                                            + (both1 < 0.0 ? -both1 : both1) * scale1);
        const mask inside = (active_lane > 0.0) & (across_least <= far) & (behind <= far);
        if (!any(inside)) continue;
        const mask simple = product / distance + reach * (1.0 + crossed / square) < -6.0;
        const vec near0 = edge_length[0] * scale0 * 2.5, near1 = edge_length[1] * scale1 * 2.5;
        const vec stepped0 = simple ? (vec)(0.0) : step0 * scale0;
        const vec stepped1 = simple ? (vec)(0.0) : step1 * scale1;
        const vec turned0 = turned[0] * scale0, turned1 = turned[1] * scale1;
        const vec change0 = root(turned0 * turned0 + stepped0 * stepped0 + near0 * near0) / distance;
        const vec change1 = root(turned1 * turned1 + stepped1 * stepped1 + near1 * near1) / distance;
        const mask fine = ((change0 <= limit3) & (change1 <= limit3)) | (scale0 < 1e-15) | (scale1 < 1e-15);
        const mask ready = inside & fine;
        if (any(ready)) {
            ORDERS
            const bool all_simple = !any(ready & !simple);
            vec sum = (vec)(0.0);
            for (int p = 0; p <= order0; ++p)
                for (int q = 0; q <= order1; ++q) {
                    const vec f = GAUSS[order0][p] * scale0, g = GAUSS[order1][q] * scale1;
                    const vec u = ray[0] + f * edge[0][0] + g * edge[1][0];
                    const vec v = ray[1] + f * edge[0][1] + g * edge[1][1];
                    const vec w = ray[2] + f * edge[0][2] + g * edge[1][2];
                    vec ww = u * u + v * v + w * w;
                    ww = ww < 1e-30 ? (vec)(1e-30) : ww;
                    const vec inverse = 1.0 / root(ww);
                    const vec tx = v * m[2] - w * m[1], ty = w * m[0] - u * m[2], tz = u * m[1] - v * m[0];
                    const vec across = (tx * tx + ty * ty + tz * tz) * inverse * inverse;
                    const vec nearest = (u * m[0] + v * m[1] + w * m[2]) * inverse * inverse;
                    vec density;
                    mask seen = across < cutoff * cutoff;
                    if (all_simple) {
                        const vec moment = dim == 2 ? nearest : nearest * nearest + inverse * inverse;
                        density = 2.5066282746310002 * moment;
                    } else {
                        const vec along = (1.0 - nearest) * ww * inverse;
                        const vec gauss = expo(-0.5 * along * along);
                        const vec ratio = gauss * mills(along < 0.0 ? -along : along);
                        const vec tail = along < 0.0 ? 2.5066282746310002 - ratio : ratio;
                        density = nearest * tail + gauss * inverse;
                        if (dim == 3) density = nearest * density + (gauss + tail * inverse) * inverse;
                        seen = seen & (along < cutoff);
                    }
                    density = expo(-0.5 * across) * inverse * (density < 0.0 ? (vec)(0.0) : density);
                    sum += WEIGHT[order0][p] * WEIGHT[order1][q] * (seen ? density : (vec)(0.0));
                }
            sum = ready ? sum * (strength * counts[cone[item]]) * scale0 * scale1 : (vec)(0.0);
            for (int l = 0; l < LANES; ++l) {
                const double value = get(sum, l);
                if (value != 0.0) {
                    const int64_t row = i0 + face[l] / n1, column = j0 + face[l] % n1;
                    GMM_ADD(misses + cell0 + row * stride1 + column * stride2, value);
                }
            }
        }
        SPLIT
    }
"""
_KERNEL = FusedKernel(
    "face_flux",
    "const double* cones, const double* counts, const int64* cone, const int64* plane, const bool* forward,"
    " const int64* first, const int64* number, const int64* target,"
    " int64 dim, int64 axis0, int64 axis1, int64 axis2,"
    " double place0, double place1, double place2, double side, double area,"
    " int64 stride0, int64 stride1, int64 stride2, double cutoff,"
    " double limit0, double limit1, double limit2, double limit3, double* misses",
    SIMD + with_panels(_BODY, "face"),
    shares=True,
)


def add_row_flux(
    misses: Tensor,
    cones: Tensor,
    counts: Tensor,
    rows: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    axis: int,
    grid: tuple[tuple[float, ...], float, tuple[int, ...]],
    cutoff: float,
    limits: tuple[float, ...],
    target: Tensor | None = None,
) -> None:
    """Add the flux through rows of faces perpendicular to `axis` to the cells that the rays leave.

    Args:
        misses: (cells,) float64, row-major; or (M,), of any cells, if `target` is given.
        cones: (C, 16) float64: whitening W (3 × 3), sensor origin, W(μ − s), and 1/√det 2πΣ; zeros for the
            third coordinate in the plane. See `whitened_rows`.
        counts: (C,) float64.
        rows: cone, plane, forward (R,) and first, number (R, D − 1) of `culling.FaceRows`.
        grid: its origin (m), the side of its cells (m), and their number along each axis.
        limits: largest variation of a panel for Gauss-Legendre rules of 1, 2, 3 and 4 nodes.
        target: (R,) where in `misses` the flux of each row is added.
    """
    cone, plane, forward, first, number = rows
    origin, side, shape = grid
    dim, device = len(shape), misses.device
    if dim == 2:
        first = torch.cat([first, torch.zeros_like(first)], 1)
        number = torch.cat([number, torch.ones_like(number)], 1)
    axes = [axis, *(a for a in range(dim) if a != axis)]
    strides = [math.prod(shape[a + 1 :]) if target is None else 0 for a in axes]
    pad = 3 - dim
    _KERNEL(
        len(cone),
        cones.contiguous(),
        counts.contiguous(),
        cone.contiguous(),
        plane.contiguous(),
        forward.contiguous(),
        first.contiguous(),
        number.contiguous(),
        target,
        dim,
        *axes,
        *[-1] * pad,
        *(origin[a] for a in axes),
        *[0.0] * pad,
        side,
        side ** (dim - 1),
        *strides,
        *[0] * pad,
        cutoff,
        *limits,
        misses,
        device=device,
    )


def whitened_rows(matrix: Tensor, origin: Tensor, toward: Tensor, log_norm: Tensor) -> Tensor:
    """The rows `cones` of `add_row_flux`: matrix (D, D, C), origin and toward (D, C), log_norm (C,)."""
    dim, n = origin.shape
    rows = origin.new_zeros(n, 16)
    rows[:, :9].unflatten(1, (3, 3))[:, :dim, :dim] = matrix.permute(2, 0, 1)
    rows[:, 9 : 9 + dim] = origin.T
    rows[:, 12 : 12 + dim] = toward.T
    rows[:, 15] = torch.exp(-log_norm)
    return rows
