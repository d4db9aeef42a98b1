"""Evidence of components in the cells of a box, from rays that are drawn from them and cast.

The fused kernel handles one viewpoint in one item, from its component to the cells, and keeps no list of
rays. Its twin, `component_rays` of the exploration's robots, draws with `truncated_normals` here and casts
with `count_in_grid`.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.rays.ray_walk import walk

THINNING = 4
"""Of the first halves of rays, one in this many is followed, with as much more weight."""
EFFECTIVE_AREA = 4 * math.pi
_RADII = 4096  # steps of the table of truncated radii
_FARTHEST_DRAW = 11.0  # deviations: an upper bound of every draw, because quantiles end at 6.4 on an axis
_PARTS = 32  # items that share a viewpoint on CUDA


class Seen(NamedTuple):
    """C viewpoints: rows (C,) of the components and of their origins, int64, and counts (C,) float64."""

    component: Tensor
    origin: Tensor
    rays: Tensor


_QUANTILE = """
    // Normal quantile: algorithm AS 241, PPND16 (Wichura 1988); relative error about 1e-16.
    auto quantile = [](double p) {
        const double q = p - 0.5;
        if (fabs(q) <= 0.425) {
            const double r = 0.180625 - q * q;
            return q * (((((((2.5090809287301226727e+3 * r + 3.3430575583588128105e+4) * r
                + 6.7265770927008700853e+4) * r + 4.5921953931549871457e+4) * r
                + 1.3731693765509461125e+4) * r + 1.9715909503065514427e+3) * r
                + 1.3314166789178437745e+2) * r + 3.3871328727963666080)
                / (((((((5.2264952788528545610e+3 * r + 2.8729085735721942674e+4) * r
                + 3.9307895800092710610e+4) * r + 2.1213794301586595867e+4) * r
                + 5.3941960214247511077e+3) * r + 6.8718700749205790830e+2) * r
                + 4.2313330701600911252e+1) * r + 1.0);
        }
        double r = sqrt(-log(q < 0.0 ? p : 1.0 - p)), x;
        if (r <= 5.0) {
            r -= 1.6;
            x = (((((((7.74545014278341407640e-4 * r + 2.27238449892691845833e-2) * r
                + 2.41780725177450611770e-1) * r + 1.27045825245236838258) * r
                + 3.64784832476320460504) * r + 5.76949722146069140550) * r
                + 4.63033784615654529590) * r + 1.42343711074968357734)
                / (((((((1.05075007164441684324e-9 * r + 5.47593808499534494600e-4) * r
                + 1.51986665636164571966e-2) * r + 1.48103976427480074590e-1) * r
                + 6.89767334985100004550e-1) * r + 1.67638483018380384940) * r
                + 2.05319162663775882187) * r + 1.0);
        } else {
            r -= 5.0;
            x = (((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r
                + 1.24266094738807843860e-3) * r + 2.65321895265761230930e-2) * r
                + 2.96560571828504891230e-1) * r + 1.78482653991729133580) * r
                + 5.46378491116411436990) * r + 6.65790464350110377720)
                / (((((((2.04426310338993978564e-15 * r + 1.42151175831644588870e-7) * r
                + 1.84631831751005468180e-5) * r + 7.86869131145613259100e-4) * r
                + 1.48753612908506148525e-2) * r + 1.36929880922735805310e-1) * r
                + 5.99832206555887937690e-1) * r + 1.0);
        }
        return q < 0.0 ? -x : x;
    };
    auto scrambled = [](uint64_t word) {  // as `_scrambled`
        word += 0x9E3779B97F4A7C15ull;
        word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9ull;
        word = (word ^ (word >> 27)) * 0x94D049BB133111EBull;
        return word ^ (word >> 31);
    };
"""

_COMPONENT = """
    const int64_t row = item / parts, part = item % parts, by = seen_by[row];
    const bool returns = !max_range[by];
    const double cutoff = cutoffs[returns ? 0 : 1], rays_per_cell = densities[returns ? 0 : 1];
    const double* mean = means + 3 * by;
    const double* sigma = covariances + 9 * by;
    const double* origin = origins + 3 * seen_from[row];
    const double* box = bounds;  // low and high of the box, then of the window, in cells
    double near_from = 0.0, near_to = 1.0;  // the part of the rays that is near the box
    for (int a = 0; a < 3; ++a) {
        const double spread = cutoff * sqrt(sigma[4 * a]), apex = origin[a] / resolution;
        const double edge[2] = {(mean[a] - spread) / resolution, (mean[a] + spread) / resolution};
        for (int side = 0; side < 2; ++side) {
            const double sign = side ? -1.0 : 1.0;
            const double room = sign * (box[side ? a : 3 + a] - apex) + 0.5;
            const double slope = sign * (edge[side] - apex);
            if (slope > 0.0) near_to = GMM_MIN(near_to, room / slope);
            if (slope < 0.0) near_from = GMM_MAX(near_from, room / slope);
            if (slope == 0.0 && room < 0.0) near_to = -1.0;
        }
    }
    if (near_from > near_to) return;
    const int64_t times = returns && near_to >= 1.0 ? hits_per_ray : 1;
    double l[3][3];  // Cholesky factor
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j <= i; ++j) {
            double sum = sigma[3 * i + j];
            for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
            l[i][j] = i == j ? sqrt(sum) : sum / l[j][j];
        }
        if (!(l[i][i] > 0.0) || !(l[i][i] < 1e300)) {
            failed[0] = true;
            return;
        }
    }
    int64_t n_rays;
    {  // as `hidden_area`
        const double scale = GMM_MAX(GMM_MAX(sigma[0], sigma[4]), sigma[8]);
        const double xx = sigma[0] / scale, xy = sigma[1] / scale, xz = sigma[2] / scale;
        const double yy = sigma[4] / scale, yz = sigma[5] / scale, zz = sigma[8] / scale;
        double to[3], largest = 2.2250738585072014e-308;
        for (int a = 0; a < 3; ++a) {
            to[a] = mean[a] - origin[a];
            largest = GMM_MAX(largest, fabs(to[a]));
        }
        const double x = to[0] / largest, y = to[1] / largest, z = to[2] / largest;
        const double a = yy * zz - yz * yz, b = xx * zz - xz * xz, c = xx * yy - xy * xy;
        const double mixed =
            x * y * (xz * yz - xy * zz) + x * z * (xy * yz - xz * yy) + y * z * (xy * xz - xx * yz);
        const double length = x * x + y * y + z * z;
        const double along = (a * x * x + b * y * y + c * z * z + 2.0 * mixed) / length;
        const double determinant = GMM_MAX(length > 0.0 ? along : a + b + c, 0.0);
        const double hidden = area * scale * sqrt(determinant) / (resolution * resolution);
        const double wanted = ceil(rays_per_cell * hidden);
        n_rays = (int64_t)GMM_MIN(GMM_MAX(wanted, (double)least), (double)most);
    }
    double thinnest[3] = {0.0, 0.0, 0.0};
    if (shell > 0.0) {  // the eigenvector of the smallest eigenvalue, by Jacobi rotations
        double m[3][3], e[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
        for (int i = 0; i < 9; ++i) m[i / 3][i % 3] = sigma[i];
        for (int sweep = 0; sweep < 12; ++sweep) {
            const double off = fabs(m[0][1]) + fabs(m[0][2]) + fabs(m[1][2]);
            if (off == 0.0) break;
            for (int i = 0; i < 2; ++i)
                for (int j = i + 1; j < 3; ++j) {
                    if (m[i][j] == 0.0) continue;
                    const double theta = (m[j][j] - m[i][i]) / (2.0 * m[i][j]);
                    const double t = (theta < 0.0 ? -1.0 : 1.0) / (fabs(theta) + sqrt(theta * theta + 1.0));
                    const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
                    for (int k = 0; k < 3; ++k) {
                        const double p = m[k][i], q = m[k][j];
                        m[k][i] = c * p - s * q;
                        m[k][j] = s * p + c * q;
                    }
                    for (int k = 0; k < 3; ++k) {
                        const double p = m[i][k], q = m[j][k], u = e[k][i], w = e[k][j];
                        m[i][k] = c * p - s * q;
                        m[j][k] = s * p + c * q;
                        e[k][i] = c * u - s * w;
                        e[k][j] = s * u + c * w;
                    }
                    m[i][j] = m[j][i] = 0.0;
                }
        }
        const int least_of_two = m[1][1] < m[0][0] ? 1 : 0;
        const int column = m[2][2] < m[least_of_two][least_of_two] ? 2 : least_of_two;
        for (int k = 0; k < 3; ++k) thinnest[k] = e[k][column];
    }
    double shift[3];
    const uint64_t key = scrambled(scrambled((uint64_t)ids[2 * by]) ^ (uint64_t)ids[2 * by + 1]);
    for (int a = 0; a < 3; ++a) shift[a] = (double)(scrambled(key + a + 1) >> 11) * 0x1p-53;
"""

_DRAWS = f"""
    const double* lows = bounds + 6;
    const double* shrinkages = shrinkage + (returns ? 0 : n_radii);
    const int dim = 3;
    const double unit = 1.0, CLOSEST = 0x1p-33, STEP = {_RADII / _FARTHEST_DRAW!r};
    const int64_t size0 = (int64_t)(bounds[9] - lows[0]), size1 = (int64_t)(bounds[10] - lows[1]);
    const int64_t size2 = (int64_t)(bounds[11] - lows[2]);
    const int64_t stride0 = size1 * size2, stride1 = size2, stride2 = 1;
    const int64_t n_draws = n_rays * times, n_some = thinned ? (n_rays + {THINNING - 1}) / {THINNING} : 0;
    const double per_draw = seen_count[row] / (double)n_draws, per_ray = per_draw * (double)times;
    const double per_first_half = n_some ? per_ray * ((double)n_rays / (double)n_some) : 0.0;
    for (int64_t draw = part; draw < n_draws; draw += parts) {{
        double normal[3], square = 0.0;
        for (int a = 0; a < 3; ++a) {{
            double cube = sobol[a * n_sobol + draw] + shift[a];
            if (cube >= 1.0) cube -= 1.0;
            normal[a] = quantile(GMM_MIN(GMM_MAX(cube, CLOSEST), 1.0 - CLOSEST));
            square += normal[a] * normal[a];
        }}
        const double position = sqrt(square) * STEP;
        const int64_t step_of = (int64_t)position;
        const double below = shrinkages[step_of];
        const double shrunk = below + (position - (double)step_of) * (shrinkages[step_of + 1] - below);
        double end[3];
        for (int i = 0; i < 3; ++i) {{
            end[i] = mean[i];
            for (int j = 0; j <= i; ++j) end[i] += l[i][j] * (normal[j] * shrunk);
        }}
        if (returns) {{
            const double x = floor(end[0] / resolution) - lows[0], y = floor(end[1] / resolution) - lows[1];
            const double z = floor(end[2] / resolution) - lows[2];
            if (x >= 0 && y >= 0 && z >= 0 && x < size0 && y < size1 && z < size2)
                GMM_ADD(hits + (int64_t)x * stride0 + (int64_t)y * stride1 + (int64_t)z, per_draw);
        }}
        if (draw >= n_rays) continue;
        double closing = 0.0, share = 0.0;
        if (shell > 0.0 && returns) {{
            for (int a = 0; a < 3; ++a) closing += thinnest[a] * (end[a] - origin[a]);
            share = GMM_MIN(shell / GMM_MAX(fabs(closing), 2.2250738585072014e-308), 1.0);
        }}
        double cells[9];  // origin, middle, stop
        for (int a = 0; a < 3; ++a) {{
            const double stop = end[a] - share * (end[a] - origin[a]);
            cells[a] = origin[a] / resolution;
            cells[3 + a] = (origin[a] + 0.5 * (stop - origin[a])) / resolution;
            cells[6 + a] = stop / resolution;
        }}
        for (int half = 0; half < (draw < n_some ? 2 : 1); ++half) {{
            const double* starts = cells + (thinned ? 3 - 3 * half : 0);
            const double* ends = cells + 6 - 3 * half;
            const double weight = half ? per_first_half : per_ray;
            const int64_t item = 0;  // of the walk
            {walk("GMM_ADD(misses + voxel, weight);")}
        }}
    }}
"""

_CAST = FusedKernel(
    "cast_components",
    "const double* means, const double* covariances, const double* origins, const bool* max_range,"
    " const int64* ids, const int64* seen_by, const int64* seen_from, const double* seen_count,"
    " const double* sobol, int64 n_sobol, const double* shrinkage, int64 n_radii, const double* bounds,"
    " int64 parts, double resolution, const double* densities, int64 least, int64 most,"
    " const double* cutoffs, double area,"
    " double shell, int64 hits_per_ray, bool thinned, double* hits, double* misses, bool* failed",
    _QUANTILE + _COMPONENT + _DRAWS,
    shares=True,
)


def cast_components(
    means: Tensor,
    covariances: Tensor,
    origins: Tensor,
    max_range: Tensor,
    ids: Tensor,
    seen: Seen,
    bounds: Tensor,
    *,
    resolution: float,
    rays_per_cell: tuple[float, float],
    least: int,
    most: int,
    cutoff: tuple[float, float],
    shell: float,
    hits_per_ray: int,
    thinned: bool,
) -> tuple[Tensor, Tensor] | None:
    """Hits and misses (nx, ny, nz) float64 of a window of cells; None if a covariance has no factor.

    Args:
        means: (K, 3), covariances: (K, 3, 3), origins: (V, 3), metres, float64. max_range: (K,) bool.
        ids: (K, 2) int64.
        bounds: (4, 3) float64, lowest and highest cell of the box whose rays count, and of the window.
        rays_per_cell, cutoff: of components of surfaces, and of those of no-return beams.
        shell: metres before a component's surface that rays do not count as free.

    For the others see `component_evidence`. A cell differs from the twin's by rounding, unless a ray passes
    within about 10⁻¹² cells of its edge, or if the thinnest direction of a component is not unique.
    """
    shape = (bounds[3] - bounds[2]).long().tolist()
    device = means.device
    hits, misses = torch.zeros(2, *shape, dtype=torch.float64, device=device)
    failed = torch.zeros(1, dtype=torch.bool, device=device)
    parts = 1 if device.type == "cpu" else _PARTS
    points = sobol_points(most * hits_per_ray, str(device))
    _CAST(
        len(seen.rays) * parts,
        *(value.contiguous() for value in (means, covariances, origins, max_range, ids, *seen)),
        points,
        points.shape[1],
        _shrinkages(cutoff, str(device)),
        _RADII + 2,
        bounds.contiguous(),
        parts,
        resolution,
        torch.tensor(rays_per_cell, dtype=torch.float64, device=device),
        least,
        most,
        torch.tensor(cutoff, dtype=torch.float64, device=device),
        EFFECTIVE_AREA,
        shell,
        hits_per_ray,
        thinned,
        hits,
        misses,
        failed,
        device=device,
    )
    return None if bool(failed) else (hits, misses)


# -- draws of the twin -------------------------------------------------------------------------------


def hidden_area(toward: Tensor, covariance: Tensor) -> Tensor:
    """Area (C,), m², that Gaussians hide from the sensor; `toward` (C, 3): from the sensor to the mean.

    The determinant of the covariance across a unit direction d is dᵀ adj(Σ) d.
    """
    scale = covariance.diagonal(dim1=1, dim2=2).amax(1).clamp_min(torch.finfo(torch.float64).tiny)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (
        row.unbind(1) for row in (covariance / scale[:, None, None]).unbind(1)
    )
    largest = toward.abs().amax(1).clamp_min(torch.finfo(torch.float64).tiny)
    x, y, z = (toward / largest[:, None]).unbind(1)
    a, b, c = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    mixed = x * y * (xz * yz - xy * zz) + x * z * (xy * yz - xz * yy) + y * z * (xy * xz - xx * yz)
    length = x * x + y * y + z * z
    along = (a * x * x + b * y * y + c * z * z + 2 * mixed) / length
    # From the mean itself there is no direction: take an upper bound of the area.
    determinant = torch.where(length > 0, along, a + b + c).clamp_min(0)
    return EFFECTIVE_AREA * scale * determinant.sqrt()


def truncated_normals(ids: Tensor, component: Tensor, draw: Tensor, n: int, cutoff: float) -> list[Tensor]:
    """Draws from a standard normal truncated at a radius: three coordinates, (R,) each.

    Points of one Sobol sequence, rotated on the unit cube by a hash of the component's id.

    Args:
        ids: (K, 2). component: (R,), row of the id. draw: (R,), number of the draw, below n.
        cutoff: radius in deviations.
    """
    shifts = _shifts(ids)
    points = sobol_points(n, str(shifts.device))
    normal, square = [], torch.zeros((), dtype=torch.float64, device=shifts.device)
    for axis in range(3):
        cube = points[axis][draw] + shifts[:, axis][component]
        cube = torch.where(cube >= 1, cube - 1, cube)
        normal.append(torch.special.ndtri(cube.clamp(2.0**-33, 1 - 2.0**-33)))
        square = square + normal[-1] * normal[-1]
    table = _shrinkage(cutoff, str(shifts.device))
    position = square.sqrt() * (_RADII / _FARTHEST_DRAW)
    step = position.long()
    below = table[step]
    shrunk = below + (position - step) * (table[step + 1] - below)
    return [coordinate * shrunk for coordinate in normal]


def _shifts(ids: Tensor) -> Tensor:
    """A pseudo-random point (K, 3) of the unit cube for each id (K, 2)."""
    key = _scrambled(_scrambled(ids[:, 0]) ^ ids[:, 1])
    words = torch.stack([_scrambled(key + axis) for axis in range(1, 4)], 1)
    return ((words >> 11) & (2**53 - 1)).double() * 2.0**-53


def _scrambled(word: Tensor) -> Tensor:
    """Bijective hash of int64 words: the finalizer of SplitMix64 (Steele, Lea and Flood 2014)."""
    word = word + _signed(0x9E3779B97F4A7C15)
    word = (word ^ _shifted(word, 30)) * _signed(0xBF58476D1CE4E5B9)
    word = (word ^ _shifted(word, 27)) * _signed(0x94D049BB133111EB)
    return word ^ _shifted(word, 31)


def _shifted(word: Tensor, bits: int) -> Tensor:
    """Logical shift to the right; the shift of torch keeps the sign."""
    return (word >> bits) & ((1 << (64 - bits)) - 1)


def _signed(word: int) -> int:
    return word - (1 << 64) if word >= 1 << 63 else word


@functools.cache
def sobol_points(n: int, device: str) -> Tensor:
    """The first n points of the Sobol sequence, (3, n) float64."""
    points: Tensor = torch.quasirandom.SobolEngine(3).draw(n, dtype=torch.float64)
    return points.T.contiguous().to(device)


@functools.cache
def _shrinkage(cutoff: float, device: str) -> Tensor:
    """Factors (_RADII + 2,) that truncate a normal draw of radius r, in even steps from 0, at `cutoff`:
    F⁻¹(F(r) F(cutoff))/r, with F the distribution function of χ₃."""
    radius = torch.arange(_RADII + 2, dtype=torch.float64) * (_FARTHEST_DRAW / _RADII)
    target = _chi3(radius) * _chi3(torch.tensor(cutoff, dtype=torch.float64))
    low, high = torch.zeros_like(radius), radius.clamp_max(cutoff)
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = _chi3(middle) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    shrunk = low / radius.clamp_min(1e-9)
    shrunk[:8] = shrunk[8]  # F loses its digits near 0, where the factor is constant
    return shrunk.to(device)


@functools.cache
def _shrinkages(cutoffs: tuple[float, float], device: str) -> Tensor:
    """`_shrinkage` of two cutoffs, (2, _RADII + 2)."""
    return torch.stack([_shrinkage(cutoff, device) for cutoff in cutoffs])


def _chi3(radius: Tensor) -> Tensor:
    """Mass of a standard normal in 3D within a radius."""
    return torch.erf(radius * math.sqrt(0.5)) - math.sqrt(2 / math.pi) * radius * torch.exp(-0.5 * radius**2)
