// Rays that are listed, counted and marked in the voxels that they leave.
#pragma once

#include "ray_walk.h"

namespace gmm {

GMM_KERNEL count_visits(int64_t item, Rays rays, int64_t* n_visits) {
    int64_t n = 0;
    walk(rays, item, [&](int64_t) { ++n; });
    n_visits[item] = n;
}

GMM_KERNEL list_visits(int64_t item, int64_t first_ray, const int64_t* stops, int64_t* voxels,
                       int64_t* ray_of, Rays rays) {
    const int64_t ray = item + first_ray, before = first_ray ? stops[first_ray - 1] : 0;
    int64_t place = (ray ? stops[ray - 1] : 0) - before;
    walk(rays, ray, [&](int64_t voxel) { voxels[place] = voxel, ray_of[place] = ray, ++place; });
}

GMM_KERNEL mark_rays(int64_t item, Rays rays, bool* marked) {
    walk(rays, item, [&](int64_t voxel) { marked[voxel] = true; });
}

// All items of a launch set the same bit, so that it does not matter which of them writes last.
GMM_KERNEL mark_cells_of_rays(int64_t item, Rays rays, const bool* is_hit, int64_t bit, int32_t* marks) {
    walk(rays, item, [&](int64_t voxel) { marks[voxel] |= (int32_t)bit; });
    if (!is_hit[item]) return;
    int64_t end = 0;
    for (int a = 0; a < 3; ++a) {
        const double cell = floor(rays.ends[3 * item + a]) - rays.lows[a];
        if (!(cell >= 0.0 && cell < (double)rays.size[a])) return;
        end += rays.stride[a] * (int64_t)cell;
    }
    marks[end] |= (int32_t)bit;
}

// Adds the weight of each ray to the count, at place_of(voxel)(lane), of each voxel that it leaves. On a CPU
// an item is a group of rays, and counts are added up to 256 visits after their memory is fetched.
template <typename Number, typename PlaceOf>
GMM_INLINE void count_rays(int64_t item, [[maybe_unused]] int64_t n_rays, const Rays& rays,
                           const Number* weights, Number* counts, PlaceOf place_of) {
    auto count_ray = [=](int64_t ray) {
        const Number weight = weights ? weights[ray] : 1;
        walk(rays, ray, [=](int64_t voxel) { add(counts + place_of(voxel)(0), weight); });
    };
#if defined(GMM_VECTORS)
    constexpr int MOST = 256;
    const int64_t ray0 = item * LANES;
    Number weight[LANES], added[MOST];
    int64_t waiting[MOST];
    int n_waiting = 0;
    for (int l = 0; l < LANES; ++l) weight[l] = weights && ray0 + l < n_rays ? weights[ray0 + l] : 1;
    auto add_all = [&] {
        for (int i = 0; i < n_waiting; ++i) counts[waiting[i]] += added[i];
        n_waiting = 0;
    };
    auto visit = [&](EightLanes::whole voxel, mask active) {
        const auto place = place_of(voxel);
        for (int l = 0; l < LANES; ++l) {
            waiting[n_waiting] = place(l);
            added[n_waiting] = weight[l];
            __builtin_prefetch(counts + waiting[n_waiting], 1);
            n_waiting += active[l] != 0;
        }
        if (n_waiting > MOST - LANES) add_all();
    };
    walk_lanes(rays, ray0, n_rays, visit, count_ray);
    add_all();
#else
    count_ray(item);
#endif
}

template <typename Number>
GMM_KERNEL count_rays_in_grid(int64_t item, int64_t n_rays, Rays rays, const Number* weights,
                              Number* counts) {
    count_rays(item, n_rays, rays, weights, counts,
               [](auto voxel) { return [=](int l) { return get(voxel, l); }; });
}

// Where a packed index of a voxel has the bits of its block and of its place in the block.
struct Blocks {
    const int64_t* stored_at;  // place in the counts of the first voxel of each block
    int64_t local_bits;
    int64_t shift0;
    int64_t shift1;
    int64_t mask1;
    int64_t mask2;
    int64_t above0;
    int64_t above1;
};

template <typename Number>
GMM_KERNEL count_rays_in_blocks(int64_t item, int64_t n_rays, Rays rays, Blocks blocks, const Number* weights,
                                Number* counts) {
    const int64_t bits = blocks.local_bits, z_bits = rays.dim == 3 ? bits : 0,
                  in_block = ((int64_t)1 << bits) - 1;
    auto place_of = [=](auto voxel) {
        const auto x = voxel >> blocks.shift0, y = voxel >> blocks.shift1, z = voxel & blocks.mask2;
        const auto block =
            ((x >> bits) << blocks.above0) | (((y & blocks.mask1) >> bits) << blocks.above1) | (z >> bits);
        const auto place = ((x & in_block) << (bits + z_bits)) | ((y & in_block) << z_bits) | (z & in_block);
        return [=](int l) { return blocks.stored_at[get(block, l)] + get(place, l); };
    };
    count_rays(item, n_rays, rays, weights, counts, place_of);
}

}  // namespace gmm
