// Flux of the rays of cones through the faces of a grid, and mass of Gaussians in its cells.
#pragma once

#include "panels.h"

namespace gmm {

// Where rows of faces lie in the grid.
struct Faces {
    int64_t dim;
    int64_t axis[3];  // perpendicular to the faces, then along them; -1 for none
    double place[3];  // origin of the grid along each of these
    double side;
    double area;
    int64_t stride[3];
};

// Flux of the rays of a cone through a row, a rectangle of faces in one plane. Drops panels outside the cone.
GMM_KERNEL face_flux(int64_t item, const double* cones, const double* counts, const int64_t* cone,
                     const int64_t* plane, const bool* forward, const int64_t* first, const int64_t* number,
                     const int64_t* target, Faces grid, Quadrature quadrature, double* misses) {
    const int64_t axis0 = grid.axis[0], axis1 = grid.axis[1], axis2 = grid.axis[2];
    const double side = grid.side, cutoff = quadrature.cutoff;
    const double* c = cones + cone[item] * 16;  // W (9), origin (3), m = W(mean - origin) (3), scale
    const double *origin = c + 9, *m = c + 12;
    const int64_t i0 = first[2 * item], j0 = first[2 * item + 1];
    const int64_t n0 = number[2 * item], n1 = number[2 * item + 1], n_faces = n0 * n1;
    const double height = grid.place[0] + (double)plane[item] * side - origin[axis0];
    const double strength = (forward[item] ? height : -height) * grid.area * c[15];
    const int64_t cell0 =
        target ? target[item] : (forward[item] ? plane[item] - 1 : plane[item]) * grid.stride[0];
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
    Panels panels;
    while (panels.take(n_faces)) {
        const vec base[2] = {panels.base[0], panels.base[1]}, scale[2] = {panels.scale[0], panels.scale[1]};
        vec i = (vec)(0.0), j = (vec)(0.0);
        for (int l = 0; l < panels.n_used; ++l) {
            set(i, l, (double)(i0 + panels.index[l] / n1));
            set(j, l, (double)(j0 + panels.index[l] % n1));
        }
        vec ray[3];
        const vec along1 = grid.place[1] + (i + 0.5 + base[0]) * side - origin[axis1];
        const vec along2 =
            axis2 < 0 ? (vec)(0.0) : grid.place[2] + (j + 0.5 + base[1]) * side - origin[axis2];
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
        const vec reach = 0.5 * (edge_length[0] * scale[0] + edge_length[1] * scale[1]);
        const vec far = cutoff * (distance + reach);
        const vec across_least = crossed - 0.5 * (turned[0] * scale[0] + turned[1] * scale[1]);
        const vec behind =
            product
            - 0.5 * ((both0 < 0.0 ? -both0 : both0) * scale[0] + (both1 < 0.0 ? -both1 : both1) * scale[1]);
        const mask inside = (panels.is_used > 0.0) & (across_least <= far) & (behind <= far);
        if (!any(inside)) continue;
        const mask simple = product / distance + reach * (1.0 + crossed / square) < -6.0;
        const vec near0 = edge_length[0] * scale[0] * 2.5, near1 = edge_length[1] * scale[1] * 2.5;
        const vec stepped0 = simple ? (vec)(0.0) : step0 * scale[0];
        const vec stepped1 = simple ? (vec)(0.0) : step1 * scale[1];
        const vec turned0 = turned[0] * scale[0], turned1 = turned[1] * scale[1];
        const vec change[2] = {root(turned0 * turned0 + stepped0 * stepped0 + near0 * near0) / distance,
                               root(turned1 * turned1 + stepped1 * stepped1 + near1 * near1) / distance};
        const mask fine = panels.are_fine(change, quadrature.limit[3]);
        const mask ready = inside & fine;
        if (any(ready)) {
            const int order0 = rule_order(ready, change[0], quadrature.limit);
            const int order1 = rule_order(ready, change[1], quadrature.limit);
            const bool all_simple = !any(ready & !simple);
            vec sum = (vec)(0.0);
            for (int p = 0; p <= order0; ++p)
                for (int q = 0; q <= order1; ++q) {
                    const vec f = rule_node(order0, p) * scale[0], g = rule_node(order1, q) * scale[1];
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
                        const vec moment = grid.dim == 2 ? nearest : nearest * nearest + inverse * inverse;
                        density = 2.5066282746310002 * moment;
                    } else {
                        const vec along = (1.0 - nearest) * ww * inverse;
                        const vec gauss = expo(-0.5 * along * along);
                        const vec ratio = gauss * mills(along < 0.0 ? -along : along);
                        const vec tail = along < 0.0 ? 2.5066282746310002 - ratio : ratio;
                        density = nearest * tail + gauss * inverse;
                        if (grid.dim == 3) density = nearest * density + (gauss + tail * inverse) * inverse;
                        seen = seen & (along < cutoff);
                    }
                    density = expo(-0.5 * across) * inverse * (density < 0.0 ? (vec)(0.0) : density);
                    sum += rule_weight(order0, p) * rule_weight(order1, q) * (seen ? density : (vec)(0.0));
                }
            sum = ready ? sum * (strength * counts[cone[item]]) * scale[0] * scale[1] : (vec)(0.0);
            for (int l = 0; l < LANES; ++l) {
                const double value = get(sum, l);
                if (value != 0.0) {
                    const int64_t row = i0 + panels.index[l] / n1, column = j0 + panels.index[l] % n1;
                    add(misses + cell0 + row * grid.stride[1] + column * grid.stride[2], value);
                }
            }
        }
        panels.split(inside & !fine, change, quadrature.limit[3]);
    }
}

// Where boxes of cells lie in the grid.
struct Boxes {
    int64_t dim;
    double place[3];  // origin of the grid
    double side;
    int64_t stride[3];
};

// Mass of a component in a box of cells. All cells have the same whitened edges, so they share the edge along
// which the integral has a closed form; panels are parts of the cross-section of a cell.
GMM_KERNEL cell_mass(int64_t item, const double* cones, const double* counts, const int64_t* cone,
                     const int64_t* first, const int64_t* number, const int64_t* target, Boxes grid,
                     Quadrature quadrature, double* hits) {
    const int64_t dim = grid.dim;
    const double side = grid.side, cutoff = quadrature.cutoff;
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
    const double span = sqrt(longest);
    double d[3], edge[2][3], rise[2], turned[2], spread[2][3];
    for (int r = 0; r < 3; ++r) {
        d[r] = side_edge[chosen][r] / span;
        start[r] = -toward[r];  // W(q - mean) of the middle of the lower cross-section of cell 0
        for (int b = 0; b < dim; ++b) {
            const double middle = grid.place[b] + ((double)corner[b] + (b == chosen ? 0.0 : 0.5)) * side;
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
    Panels panels;
    while (panels.take(n_cells)) {
        const vec base[2] = {panels.base[0], panels.base[1]}, scale[2] = {panels.scale[0], panels.scale[1]};
        vec at[3] = {(vec)(0.0), (vec)(0.0), (vec)(0.0)};
        for (int l = 0; l < panels.n_used; ++l) {
            const int64_t cell = panels.index[l];
            set(at[0], l, (double)(cell / (box[1] * box[2])));
            set(at[1], l, (double)(cell / box[2] % box[1]));
            set(at[2], l, (double)(cell % box[2]));
        }
        vec o[3];
        for (int r = 0; r < 3; ++r) {
            o[r] = start[r] + base[0] * edge[0][r] + base[1] * edge[1][r];
            for (int b = 0; b < dim; ++b) o[r] += at[b] * side_edge[b][r];
        }
        const vec along = o[0] * d[0] + o[1] * d[1] + o[2] * d[2];
        const vec x = o[1] * d[2] - o[2] * d[1], y = o[2] * d[0] - o[0] * d[2], z = o[0] * d[1] - o[1] * d[0];
        const vec slope = 0.5 * (rise0 * scale[0] + rise1 * scale[1]);
        const vec across = root(x * x + y * y + z * z) - 0.5 * (turned[0] * scale[0] + turned[1] * scale[1]);
        const mask inside = (panels.is_used > 0.0) & (across <= cutoff) & (along - slope <= cutoff)
                            & (along + span + slope >= -cutoff);
        if (!any(inside)) continue;
        const vec end = along + span;
        const vec low_end = along < 0.0 ? -along : along, high_end = end < 0.0 ? -end : end;
        const mask simple = (low_end < high_end ? low_end : high_end) - slope > 6.0;
        const vec risen0 = simple ? (vec)(0.0) : rise0 * scale[0];
        const vec risen1 = simple ? (vec)(0.0) : rise1 * scale[1];
        const vec turned0 = turned[0] * scale[0], turned1 = turned[1] * scale[1];
        const vec change[2] = {root(turned0 * turned0 + risen0 * risen0),
                               root(turned1 * turned1 + risen1 * risen1)};
        const mask fine = panels.are_fine(change, quadrature.limit[3]);
        const mask ready = inside & fine;
        if (any(ready)) {
            const int order0 = rule_order(ready, change[0], quadrature.limit);
            const int order1 = rule_order(ready, change[1], quadrature.limit);
            vec sum = (vec)(0.0);
            for (int p = 0; p <= order0; ++p)
                for (int q = 0; q <= order1; ++q) {
                    const vec f = rule_node(order0, p) * scale[0], g = rule_node(order1, q) * scale[1];
                    const vec u = x + f * spread[0][0] + g * spread[1][0];
                    const vec v = y + f * spread[0][1] + g * spread[1][1];
                    const vec w = z + f * spread[0][2] + g * spread[1][2];
                    const vec far = u * u + v * v + w * w, low = along + f * rise[0] + g * rise[1];
                    vec beyond = low > -low - span ? low : -low - span;
                    beyond = beyond < 0.0 ? (vec)(0.0) : beyond;
                    const mask reached = far + beyond * beyond < cutoff * cutoff;
                    if (!any(ready & reached)) continue;
                    const vec density = expo(-0.5 * far) * normal_mass(low);
                    sum += rule_weight(order0, p) * rule_weight(order1, q) * (reached ? density : (vec)(0.0));
                }
            sum = ready ? sum * volume * scale[0] * scale[1] : (vec)(0.0);
            for (int l = 0; l < LANES; ++l) {
                const double value = get(sum, l);
                if (value == 0.0) continue;
                int64_t flat = target ? target[item] : 0, left = panels.index[l];
                for (int b = 2; b >= 0; --b) {
                    flat += (corner[b] + left % box[b]) * grid.stride[b];
                    left /= box[b];
                }
                add(hits + flat, value);
            }
        }
        panels.split(inside & !fine, change, quadrature.limit[3]);
    }
}

}  // namespace gmm
