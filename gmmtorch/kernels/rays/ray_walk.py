"""The C++ walk of rays through a voxel grid, which the kernels of rays share: one ray, or eight at a time.

It is the stepping loop of Amanatides & Woo, with the tie rule of the twin in `ray_traversal`. Crossing k of
an axis is at t = from + k·inverse on the ray. Crossings of two axes are one point if their t differ by at
most the sum of the axes' slacks. Then the plane of the lower axis is crossed first. Rays that are not finite,
or start 2⁵⁰ voxels or more from zero, leave nothing.
"""

from __future__ import annotations

from gmmtorch.kernels.simd import SCALAR, VECTOR

TIE = 1e-13
"""Distance of crossings that count as one point, relative to the terms: a few hundred times their rounding
error."""

PARAMETERS = (
    "const double* starts, const double* ends, const double* lows, int64 dim, int64 size0, int64 size1,"
    " int64 size2, int64 stride0, int64 stride1, int64 stride2, double unit"
)
"""starts, ends (R, dim) and the grid's lowest voxel lows (dim,), in voxels; sizes and strides of the axes (1
and 0 for the third axis of a 2D grid); unit: 1, or 1/n if n finer voxels make a voxel and ties are theirs."""

_SETUP = f"""
    const double TIE = {TIE};
    const double INF = 1.0 / 0.0, FARTHEST = 1125899906842624.0;  // voxels are exact to there
    const double size[3] = {{(double)size0, (double)size1, (double)size2}};
    const int64_t stride[3] = {{stride0, stride1, stride2}};
    vec first[3], count[3], origin[3], away[3], inverse[3], from[3], slack[3];
    whole step[3], corner = (whole)(0);
    mask fits = (vec)(0.0) == (vec)(0.0), meets_grid = fits;  // all true
    for (int a = 0; a < 3; ++a) {{
        vec s = (vec)(0.0), e = (vec)(0.0);
        const double low = a < dim ? lows[a] : 0.0;
        for (int l = 0; l < LANES && a < dim; ++l) {{
            const bool is_ray = ray0 + l < n_rays;
            set(s, l, is_ray ? starts[(ray0 + l) * dim + a] : INF);
            set(e, l, is_ray ? ends[(ray0 + l) * dim + a] : INF);
        }}
        meets_grid &= absolute(s) < FARTHEST;  // not if it is NaN
        meets_grid &= absolute(e) < INF;
        vec delta = e - s, begin = down(s) - low, end = down(e) - low;
        s -= low;
        const mask falls = delta < 0.0;  // mirrored, so that every ray ascends
        s = falls ? size[a] - s : s;
        begin = falls ? size[a] - 1.0 - begin : begin;
        end = falls ? size[a] - 1.0 - end : end;
        step[a] = falls ? (whole)(-stride[a]) : (whole)(stride[a]);
        corner += falls ? (whole)(stride[a] * ((int64_t)size[a] - 1)) : (whole)(0);
        fits &= begin >= 0.0;
        fits &= end < size[a];
        meets_grid &= end >= 0.0;
        meets_grid &= begin < size[a];
        delta = absolute(delta);  // also of −0
        first[a] = begin;
        count[a] = end - begin;
        origin[a] = s;
        away[a] = delta;
        inverse[a] = 1.0 / delta;
        slack[a] = TIE * (absolute(s) + delta + unit) * inverse[a];
        slack[a] = slack[a] < 1e200 ? slack[a] : (vec)(1e200);
        const mask is_flat = !(inverse[a] < 1e290);  // the ray crosses one plane of this axis at most
        from[a] = is_flat ? (vec)(0.5) : (begin + 1.0 - s) * inverse[a];
        inverse[a] = is_flat ? (vec)(0.0) : inverse[a];
    }}
    fits &= meets_grid;
    // The first time at which a crossing of axis 0 or 1 can be taken, and the last one of axis 1 or 2.
    const vec from0 = from[0] - slack[0], from1 = from[1] - slack[1], from2 = from[2] + slack[2];
    const vec wide1 = 2.0 * slack[1], n0 = count[0], n1 = count[1], n2 = count[2];
"""

_BEGIN = """
    vec early0 = c0 < n0 ? from0 + c0 * inverse[0] : (vec)(INF);
    vec early1 = c1 < n1 ? from1 + c1 * inverse[1] : (vec)(INF);
    vec late1 = early1 + wide1, late2 = c2 < n2 ? from2 + c2 * inverse[2] : (vec)(INF);
"""

_ADVANCE = """
    if (early0 <= late1 && early0 <= late2) {
        c0 += 1.0;
        voxel += step[0];
        early0 = c0 < n0 ? from0 + c0 * inverse[0] : INF;
    } else if (early1 <= late2) {
        c1 += 1.0;
        voxel += step[1];
        early1 = c1 < n1 ? from1 + c1 * inverse[1] : INF;
        late1 = early1 + wide1;
    } else {
        c2 += 1.0;
        voxel += step[2];
        late2 = c2 < n2 ? from2 + c2 * inverse[2] : INF;
    }
"""

_ADVANCE_ALL = """
    const mask on0 = active & (early0 <= late1) & (early0 <= late2);
    const mask on1 = active & ~on0 & (early1 <= late2), on2 = active & ~(on0 | on1);
    c0 = on0 ? c0 + 1.0 : c0;
    c1 = on1 ? c1 + 1.0 : c1;
    c2 = on2 ? c2 + 1.0 : c2;
    voxel += (on0 & step[0]) | (on1 & step[1]) | (on2 & step[2]);
    early0 = c0 < n0 ? from0 + c0 * inverse[0] : (vec)(INF);
    early1 = c1 < n1 ? from1 + c1 * inverse[1] : (vec)(INF);
    late1 = early1 + wide1;
    late2 = c2 < n2 ? from2 + c2 * inverse[2] : (vec)(INF);
"""


def walk(visit: str, ray: str = "item") -> str:
    """C++ that runs the statements `visit` for each `voxel` (int64) that `ray` leaves."""
    return f"""
    {SCALAR}
    const int64_t ray0 = {ray}, n_rays = ray0 + 1;
    {_SETUP}
    double c0 = 0.0, c1 = 0.0, c2 = 0.0;
    whole voxel = corner;
    if (fits) {{
        for (int a = 0; a < 3; ++a) voxel += step[a] * integer(first[a]);
        {_BEGIN}
        for (int64_t left = (int64_t)(n0 + n1 + n2); left > 0; --left) {{
            {visit}
            {_ADVANCE}
        }}
    }} else if (meets_grid) {{
        double skip = 0.0, crossed[3] = {{0.0, 0.0, 0.0}};  // what lies more than two voxels before the grid
        for (int a = 0; a < 3; ++a)
            if (count[a] > 0.0)
                skip = GMM_MAX(skip, (-2.0 - TIE * (fabs(origin[a]) + away[a]) - origin[a]) * inverse[a]);
        for (int a = 0; a < 3; ++a)
            if (skip > 0.0 && count[a] > 0.0) {{
                const double planes = ceil(origin[a] + skip * away[a]) - first[a] - 1.0;
                crossed[a] = GMM_MIN(GMM_MAX(planes, 0.0), count[a]);
            }}
        c0 = crossed[0], c1 = crossed[1], c2 = crossed[2];
        {_BEGIN}
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


def walk_lanes(visits: str, one_ray: str) -> str:
    """C++ for a CPU that walks the rays from `ray0` on, one in each of LANES lanes, up to `n_rays`.

    visits: statements for each `voxel` (whole) that the rays of the lanes in `active` (mask) leave. one_ray:
    statements for each `ray` (int64) that is not all inside the grid.
    """
    return f"""
    {VECTOR}
    {_SETUP}
    for (int l = 0; l < LANES; ++l)
        if (meets_grid[l] && !fits[l]) {{
            const int64_t ray = ray0 + l;
            {one_ray}
        }}
    vec c0 = (vec)(0.0), c1 = c0, c2 = c0;
    whole voxel = corner;
    for (int a = 0; a < 3; ++a) voxel += step[a] * integer(fits ? first[a] : (vec)(0.0));
    {_BEGIN}
    const vec left = fits ? n0 + n1 + n2 : (vec)(0.0);
    for (double n = 0.0; n < largest(left); n += 1.0) {{
        const mask active = left > n;
        {visits}
        {_ADVANCE_ALL}
    }}
"""
