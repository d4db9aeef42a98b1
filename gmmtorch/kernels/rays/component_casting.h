// Evidence of components in the cells of a box, from rays that are drawn from them and cast.
#pragma once

#include "../jacobi.h"
#include "ray_walk.h"

namespace gmm {

// A ratio of two polynomials, whose coefficients start with the constant.
GMM_INLINE double ratio(const double (&above)[8], const double (&below)[8], double r) {
    double a = above[7], b = below[7];
    for (int i = 6; i >= 0; --i) a = a * r + above[i], b = b * r + below[i];
    return a / b;
}

// Normal quantile: algorithm AS 241, PPND16 (Wichura 1988); relative error about 1e-16.
GMM_INLINE double quantile(double p) {
    const double a[8] = {3.3871328727963666080,    1.3314166789178437745e+2, 1.9715909503065514427e+3,
                         1.3731693765509461125e+4, 4.5921953931549871457e+4, 6.7265770927008700853e+4,
                         3.3430575583588128105e+4, 2.5090809287301226727e+3};
    const double b[8] = {1.0000000000000000000000e+0, 4.2313330701600911252e+1, 6.8718700749205790830e+2,
                         5.3941960214247511077e+3,    2.1213794301586595867e+4, 3.9307895800092710610e+4,
                         2.8729085735721942674e+4,    5.2264952788528545610e+3};
    const double c[8] = {1.42343711074968357734,    4.63033784615654529590,   5.76949722146069140550,
                         3.64784832476320460504,    1.27045825245236838258,   2.41780725177450611770e-1,
                         2.27238449892691845833e-2, 7.74545014278341407640e-4};
    const double d[8] = {1.0000000000000000000000e+0, 2.05319162663775882187,    1.67638483018380384940,
                         6.89767334985100004550e-1,   1.48103976427480074590e-1, 1.51986665636164571966e-2,
                         5.47593808499534494600e-4,   1.05075007164441684324e-9};
    const double e[8] = {6.65790464350110377720,    5.46378491116411436990,    1.78482653991729133580,
                         2.96560571828504891230e-1, 2.65321895265761230930e-2, 1.24266094738807843860e-3,
                         2.71155556874348757815e-5, 2.01033439929228813265e-7};
    const double f[8] = {1.0000000000000000000000e+0, 5.99832206555887937690e-1, 1.36929880922735805310e-1,
                         1.48753612908506148525e-2,   7.86869131145613259100e-4, 1.84631831751005468180e-5,
                         1.42151175831644588870e-7,   2.04426310338993978564e-15};
    const double q = p - 0.5;
    if (fabs(q) <= 0.425) return q * ratio(a, b, 0.180625 - q * q);
    const double r = sqrt(-log(q < 0.0 ? p : 1.0 - p));
    const double x = r <= 5.0 ? ratio(c, d, r - 1.6) : ratio(e, f, r - 5.0);
    return q < 0.0 ? -x : x;
}

// Bijective hash: the finalizer of SplitMix64.
GMM_INLINE uint64_t scrambled(uint64_t word) {
    word += 0x9E3779B97F4A7C15ull;
    word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9ull;
    word = (word ^ (word >> 27)) * 0x94D049BB133111EBull;
    return word ^ (word >> 31);
}

// Area that a Gaussian hides from the sensor, in cells; see `hidden_area`.
GMM_INLINE double hidden_area(const double* sigma, const double* mean, const double* origin, double area,
                              double resolution) {
    const double scale = maximum(maximum(sigma[0], sigma[4]), sigma[8]);
    const double xx = sigma[0] / scale, xy = sigma[1] / scale, xz = sigma[2] / scale;
    const double yy = sigma[4] / scale, yz = sigma[5] / scale, zz = sigma[8] / scale;
    double to[3], farthest = 2.2250738585072014e-308;
    for (int a = 0; a < 3; ++a) {
        to[a] = mean[a] - origin[a];
        farthest = maximum(farthest, fabs(to[a]));
    }
    const double x = to[0] / farthest, y = to[1] / farthest, z = to[2] / farthest;
    const double a = yy * zz - yz * yz, b = xx * zz - xz * xz, c = xx * yy - xy * xy;
    const double mixed =
        x * y * (xz * yz - xy * zz) + x * z * (xy * yz - xz * yy) + y * z * (xy * xz - xx * yz);
    const double length = x * x + y * y + z * z;
    const double along = (a * x * x + b * y * y + c * z * z + 2.0 * mixed) / length;
    const double determinant = maximum(length > 0.0 ? along : a + b + c, 0.0);
    return area * scale * sqrt(determinant) / (resolution * resolution);
}

// Eigenvector of the smallest eigenvalue of a covariance.
GMM_INLINE void find_thinnest(const double* sigma, double* thinnest) {
    double m[3][3], e[3][3];
    for (int i = 0; i < 9; ++i) m[i / 3][i % 3] = sigma[i];
    diagonalize<3>(m, e);
    const int least_of_two = m[1][1] < m[0][0] ? 1 : 0;
    const int column = m[2][2] < m[least_of_two][least_of_two] ? 2 : least_of_two;
    for (int k = 0; k < 3; ++k) thinnest[k] = e[k][column];
}

// An item is a part of the rays of a viewpoint. `bounds`: low and high of the box whose rays count, then of
// the window of cells.
GMM_KERNEL cast_components(int64_t item, const double* means, const double* covariances,
                           const double* origins, const bool* max_range, const int64_t* ids,
                           const int64_t* seen_by, const int64_t* seen_from, const double* seen_count,
                           const double* sobol, int64_t n_sobol, const double* shrinkage, int64_t n_radii,
                           double radius_steps, const double* bounds, int64_t parts, double resolution,
                           double tie, const double* densities, int64_t least, int64_t most,
                           const double* cutoffs, double area, double shell, int64_t hits_per_ray,
                           int64_t thinning, double* hits, double* misses, bool* failed) {
    const int64_t row = item / parts, part = item % parts, by = seen_by[row];
    const bool returns = !max_range[by];
    const double cutoff = cutoffs[returns ? 0 : 1], rays_per_cell = densities[returns ? 0 : 1];
    const double* mean = means + 3 * by;
    const double* sigma = covariances + 9 * by;
    const double* origin = origins + 3 * seen_from[row];
    const double* box = bounds;
    double near_from = 0.0, near_to = 1.0;  // the part of the rays that is near the box
    for (int a = 0; a < 3; ++a) {
        const double spread = cutoff * sqrt(sigma[4 * a]), apex = origin[a] / resolution;
        const double edge[2] = {(mean[a] - spread) / resolution, (mean[a] + spread) / resolution};
        for (int side = 0; side < 2; ++side) {
            const double sign = side ? -1.0 : 1.0;
            const double room = sign * (box[side ? a : 3 + a] - apex) + 0.5;
            const double slope = sign * (edge[side] - apex);
            if (slope > 0.0) near_to = minimum(near_to, room / slope);
            if (slope < 0.0) near_from = maximum(near_from, room / slope);
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
    const double wanted = ceil(rays_per_cell * hidden_area(sigma, mean, origin, area, resolution));
    const int64_t n_rays = (int64_t)minimum(maximum(wanted, (double)least), (double)most);
    double thinnest[3] = {0.0, 0.0, 0.0};
    if (shell > 0.0) find_thinnest(sigma, thinnest);
    double shift[3];
    const uint64_t key = scrambled(scrambled((uint64_t)ids[2 * by]) ^ (uint64_t)ids[2 * by + 1]);
    for (int a = 0; a < 3; ++a) shift[a] = (double)(scrambled(key + a + 1) >> 11) * 0x1p-53;

    const double* lows = bounds + 6;
    const double* shrinkages = shrinkage + (returns ? 0 : n_radii);
    const double CLOSEST = 0x1p-33;
    int64_t size[3];
    for (int a = 0; a < 3; ++a) size[a] = (int64_t)(bounds[9 + a] - lows[a]);
    const int64_t stride[3] = {size[1] * size[2], size[2], 1};
    const int64_t n_draws = n_rays * times, n_some = (n_rays + thinning - 1) / thinning;
    const double per_draw = seen_count[row] / (double)n_draws, per_ray = per_draw * (double)times;
    const double per_first_half = n_some ? per_ray * ((double)n_rays / (double)n_some) : 0.0;
    for (int64_t draw = part; draw < n_draws; draw += parts) {
        double normal[3], square = 0.0;
        for (int a = 0; a < 3; ++a) {
            double cube = sobol[a * n_sobol + draw] + shift[a];
            if (cube >= 1.0) cube -= 1.0;
            normal[a] = quantile(minimum(maximum(cube, CLOSEST), 1.0 - CLOSEST));
            square += normal[a] * normal[a];
        }
        const double position = sqrt(square) * radius_steps;
        const int64_t step_of = (int64_t)position;
        const double below = shrinkages[step_of];
        const double shrunk = below + (position - (double)step_of) * (shrinkages[step_of + 1] - below);
        double end[3];
        for (int i = 0; i < 3; ++i) {
            end[i] = mean[i];
            for (int j = 0; j <= i; ++j) end[i] += l[i][j] * (normal[j] * shrunk);
        }
        if (returns) {
            const double x = floor(end[0] / resolution) - lows[0], y = floor(end[1] / resolution) - lows[1];
            const double z = floor(end[2] / resolution) - lows[2];
            if (x >= 0 && y >= 0 && z >= 0 && x < size[0] && y < size[1] && z < size[2])
                add(hits + (int64_t)x * stride[0] + (int64_t)y * stride[1] + (int64_t)z, per_draw);
        }
        if (draw >= n_rays) continue;
        double closing = 0.0, share = 0.0;
        if (shell > 0.0 && returns) {
            for (int a = 0; a < 3; ++a) closing += thinnest[a] * (end[a] - origin[a]);
            share = minimum(shell / maximum(fabs(closing), 2.2250738585072014e-308), 1.0);
        }
        double cells[9];  // origin, middle, stop
        for (int a = 0; a < 3; ++a) {
            const double stop = end[a] - share * (end[a] - origin[a]);
            cells[a] = origin[a] / resolution;
            cells[3 + a] = (origin[a] + 0.5 * (stop - origin[a])) / resolution;
            cells[6 + a] = stop / resolution;
        }
        for (int half = 0; half < (draw < n_some ? 2 : 1); ++half) {
            const double* starts = cells + 3 - 3 * half;
            const double* ends = cells + 6 - 3 * half;
            const Rays ray = {
                starts, ends, lows, 3, {size[0], size[1], size[2]}, {stride[0], stride[1], stride[2]},
                tie,    1.0};
            const double weight = half ? per_first_half : per_ray;
            walk(ray, 0, [&](int64_t voxel) { add(misses + voxel, weight); });
        }
    }
}

}  // namespace gmm
