// Cells that are listed, found and changed in dense blocks and in sparse stores.
#pragma once

#include "../device.h"

namespace gmm {

// An item is a block. Without `cells`, its number of counted cells is written to n_before.
GMM_KERNEL list_counted_cells(int64_t item, int64_t nx, int64_t ny, int64_t nz, int64_t blocks_y,
                              int64_t blocks_z, int64_t bits, const double* hits, const double* misses,
                              const int64_t* low, int64_t* n_before, int64_t* cells, float* listed_hits,
                              float* listed_misses) {
    const int64_t block[3] = {item / (blocks_y * blocks_z), item / blocks_z % blocks_y, item % blocks_z};
    const int64_t size[3] = {nx, ny, nz};
    int64_t first[3], stop[3], n = cells ? n_before[item] : 0;
    for (int a = 0; a < 3; ++a) {
        const int64_t begin = (((low[a] >> bits) + block[a]) << bits) - low[a];
        first[a] = maximum(begin, (int64_t)0);
        stop[a] = minimum(begin + ((int64_t)1 << bits), size[a]);
    }
    for (int64_t x = first[0]; x < stop[0]; ++x)
        for (int64_t y = first[1]; y < stop[1]; ++y) {
            const double *h = hits + (x * ny + y) * nz, *m = misses + (x * ny + y) * nz;
            for (int64_t z = first[2]; z < stop[2]; ++z) {
                if (!(h[z] > 0.0 || m[z] > 0.0)) continue;
                if (cells) {
                    cells[3 * n] = x + low[0];
                    cells[3 * n + 1] = y + low[1];
                    cells[3 * n + 2] = z + low[2];
                    listed_hits[n] = (float)h[z];
                    listed_misses[n] = (float)m[z];
                }
                ++n;
            }
        }
    if (!cells) n_before[item] = n;
}

// An item is a run of cells.
GMM_KERNEL add_counts(int64_t item, int64_t n_cells, int64_t run, const int64_t* index,
                      const float* more_hits, const float* more_misses, int64_t n_stored, float* counts,
                      float* before) {
    const int64_t stop = minimum(n_cells, (item + 1) * run);
    for (int64_t c = item * run; c < stop; ++c) {
        float *hits = counts + index[c], *misses = hits + n_stored;
        before[c] = *hits;
        before[n_cells + c] = *misses;
        if (index[c] == 0) continue;
        *hits += more_hits[c];
        *misses += more_misses[c];
    }
}

GMM_KERNEL flags_of_cells(int64_t item, int64_t n_cells, int64_t run, const int64_t* cells,
                          const int64_t* low, int64_t nx, int64_t ny, int64_t nz, const bool* flags,
                          bool* found) {
    const int64_t stop = minimum(n_cells, (item + 1) * run);
    for (int64_t c = item * run; c < stop; ++c) {
        const int64_t x = cells[3 * c] - low[0], y = cells[3 * c + 1] - low[1], z = cells[3 * c + 2] - low[2];
        const bool inside = x >= 0 && x < nx && y >= 0 && y < ny && z >= 0 && z < nz;
        found[c] = inside && flags[(x * ny + y) * nz + z];
    }
}

GMM_KERNEL cell_index(int64_t item, const int64_t* cells, int64_t n_cells, int64_t dim, int64_t run,
                      const int64_t* keys, const int64_t* slots, int64_t n_keys, const int64_t* bounds,
                      int64_t local_bits, int64_t axis_bits, int64_t* index) {
    const int64_t in_block = ((int64_t)1 << local_bits) - 1, half = (int64_t)1 << (axis_bits - 1);
    const int64_t stop = minimum(n_cells, (item + 1) * run);
    int64_t last = -1, first = -1;
    for (int64_t c = item * run; c < stop; ++c) {
        int64_t key = 0, place = 0;
        bool inside = true;
        for (int64_t a = 0; a < dim; ++a) {
            const int64_t cell = cells[c * dim + a], column = cell - bounds[a];
            inside = inside && cell >= bounds[dim + a] && cell < bounds[2 * dim + a];
            key = (key << axis_bits) | ((column >> local_bits) + half);
            place = (place << local_bits) | (column & in_block);
        }
        if (!inside) {
            index[c] = 0;
            continue;
        }
        if (key != last) {
            int64_t low = 0, high = n_keys;
            while (low < high) {
                const int64_t middle = (low + high) / 2;
                if (keys[middle] < key)
                    low = middle + 1;
                else
                    high = middle;
            }
            last = key;
            first = low < n_keys && keys[low] == key ? slots[low] << (local_bits * dim) : -1;
        }
        index[c] = first < 0 ? -1 : first + place;
    }
}

}  // namespace gmm
