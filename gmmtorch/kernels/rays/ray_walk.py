"""The C++ walk of one ray through a voxel grid, which the kernels of rays share.

It is the stepping loop of Amanatides & Woo, with the tie rule of the twin in `ray_traversal`. Crossing k of
an axis is at t = from + k·inverse on the ray. Crossings of two axes are one point if their t differ by at
most the sum of the axes' slacks. Then the plane of the lower axis is crossed first. Rays that are not finite,
or start 2⁵⁰ voxels or more from zero, leave nothing.
"""

from __future__ import annotations

TIE = 1e-13
"""Distance of crossings that count as one point, relative to the terms: a few hundred times their rounding
error."""

PARAMETERS = (
    "const double* starts, const double* ends, const double* lows, int64 dim, int64 size0, int64 size1,"
    " int64 size2, int64 stride0, int64 stride1, int64 stride2, double unit"
)
"""starts, ends (R, dim) and the grid's lowest voxel lows (dim,), in voxels; sizes and strides of the axes (1
and 0 for the third axis of a 2D grid); unit: 1, or 1/n if n finer voxels make a voxel and ties are theirs."""

_SETUP = """
    const double INF = 1.0 / 0.0, FARTHEST = 1125899906842624.0;  // voxels are exact to there
    const double size[3] = {(double)size0, (double)size1, (double)size2};
    const int64_t stride[3] = {stride0, stride1, stride2};
    double first[3], count[3], origin[3], away[3], inverse[3], from[3], slack[3];
    int64_t step[3], corner = 0;
    bool fits = true, misses_grid = false;
    for (int a = 0; a < 3; ++a) {
        double s = 0.0, e = 0.0, low = 0.0;
        if (a < dim) {
            s = starts[item * dim + a];
            e = ends[item * dim + a];
            low = lows[a];
        }
        misses_grid = misses_grid || !(fabs(s) < FARTHEST) || !(fabs(e) < INF);  // also NaN
        double delta = e - s, begin = floor(s) - low, end = floor(e) - low;
        s -= low;
        step[a] = stride[a];
        if (delta < 0.0) {  // mirrored, so that every ray ascends
            s = size[a] - s;
            begin = size[a] - 1.0 - begin;
            end = size[a] - 1.0 - end;
            corner += stride[a] * ((int64_t)size[a] - 1);
            step[a] = -stride[a];
        }
        fits = fits && begin >= 0.0 && end < size[a];
        misses_grid = misses_grid || end < 0.0 || begin >= size[a];
        delta = fabs(delta);  // also of −0
        first[a] = begin;
        count[a] = end - begin;
        origin[a] = s;
        away[a] = delta;
        inverse[a] = 1.0 / delta;
        from[a] = (begin + 1.0 - s) * inverse[a];
        if (!(inverse[a] < 1e290)) {  // the ray crosses one plane of this axis at most
            inverse[a] = 0.0;
            from[a] = 0.5;
        }
        slack[a] = GMM_MIN(TIE * (fabs(s) + delta + unit) / delta, 1e200);
    }
    double crossed[3] = {0.0, 0.0, 0.0};
    if (!fits && !misses_grid) {  // skip what lies more than two voxels before the grid
        double skip = 0.0;
        for (int a = 0; a < 3; ++a)
            if (count[a] > 0.0)
                skip = GMM_MAX(skip, (-2.0 - TIE * (fabs(origin[a]) + away[a]) - origin[a]) * inverse[a]);
        for (int a = 0; a < 3; ++a)
            if (skip > 0.0 && count[a] > 0.0) {
                const double planes = ceil(origin[a] + skip * away[a]) - first[a] - 1.0;
                crossed[a] = GMM_MIN(GMM_MAX(planes, 0.0), count[a]);
            }
    }
    double c0 = crossed[0], c1 = crossed[1], c2 = crossed[2];
    const double n0 = count[0], n1 = count[1], n2 = count[2];
    double t0 = c0 < n0 ? from[0] + c0 * inverse[0] : INF;
    double t1 = c1 < n1 ? from[1] + c1 * inverse[1] : INF;
    double t2 = c2 < n2 ? from[2] + c2 * inverse[2] : INF;
    double early0 = c0 < n0 ? t0 - slack[0] : INF, early1 = c1 < n1 ? t1 - slack[1] : INF;
    double late1 = t1 + slack[1], late2 = t2 + slack[2];
    int64_t voxel = corner;
"""

_ADVANCE = """
    if (early0 <= late1 && early0 <= late2) {
        c0 += 1.0;
        voxel += step[0];
        early0 = c0 < n0 ? from[0] + c0 * inverse[0] - slack[0] : INF;
    } else if (early1 <= late2) {
        c1 += 1.0;
        voxel += step[1];
        t1 = c1 < n1 ? from[1] + c1 * inverse[1] : INF;
        early1 = c1 < n1 ? t1 - slack[1] : INF;
        late1 = t1 + slack[1];
    } else {
        c2 += 1.0;
        voxel += step[2];
        late2 = c2 < n2 ? from[2] + c2 * inverse[2] + slack[2] : INF;
    }
"""


def walk(visit: str) -> str:
    """C++ that runs the statements `visit` for each `voxel` (int64) that ray `item` leaves."""
    return f"""
    const double TIE = {TIE};
    {_SETUP}
    if (fits) {{
        for (int a = 0; a < 3; ++a) voxel += step[a] * (int64_t)first[a];
        for (int64_t left = (int64_t)(n0 + n1 + n2); left > 0; --left) {{
            {visit}
            {_ADVANCE}
        }}
    }} else if (!misses_grid) {{
        while (c0 < n0 || c1 < n1 || c2 < n2) {{
            const double i = first[0] + c0, j = first[1] + c1, k = first[2] + c2;
            if (i >= size[0] || j >= size[1] || k >= size[2]) break;
            if (i >= 0.0 && j >= 0.0 && k >= 0.0) {{
                voxel = corner + step[0] * (int64_t)i + step[1] * (int64_t)j + step[2] * (int64_t)k;
                {visit}
            }}
            {_ADVANCE}
        }}
    }}
"""
