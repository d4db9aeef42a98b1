// What the beams of depth images tell about a map.
#pragma once

#include "../device.h"

namespace gmm {

// As in beam_information.py.
constexpr float REACHED = 0.05f;
constexpr double WORTHLESS = 1e-4;
constexpr double IMAGE_ODDS = 100.0;

// The sum of a block in a register: on CUDA other items add to it at the same time.
GMM_INLINE float opened(const float* sum) {
#if defined(__CUDA_ARCH__)
    return 0.0f;
#else
    return *sum;
#endif
}

GMM_INLINE void closed(float* sum, float value) {
#if defined(__CUDA_ARCH__)
    add(sum, value);
#else
    *sum = value;
#endif
}

// An item is `n_own` of the beams of a view: all on a CPU, one on CUDA. A beam visits only cells that can be
// occupied, up to the first certain one.
GMM_KERNEL information_by_block(int64_t item, const int64_t* cameras, const int64_t* yaws, int64_t nx,
                                int64_t ny, int64_t nz, int64_t n_beams, int64_t n_own, int64_t n_templates,
                                int64_t n_columns, int64_t n_steps, int64_t band, int64_t n_blocks,
                                const int64_t* lengths, const int64_t* leading, const bool* ahead,
                                const float* volumes, const float* kernel, const int32_t* offsets,
                                const float* occupancies, const int32_t* blocks, bool is_shannon,
                                double log_odds, float* scratch, float* gains, float* takens) {
    const int64_t view = item * n_own / n_beams, begin = item * n_own % n_beams;
    const int64_t* camera = cameras + 3 * view;
    const int64_t size[3] = {nx, ny, nz};
    for (int a = 0; a < 3; ++a)
        if (camera[a] < 0 || camera[a] >= size[a]) return;
    const int64_t base = (camera[0] * ny + camera[1]) * nz + camera[2];
    float* gain = gains + view * n_blocks;
    float* taken = takens + view * n_blocks;
    // p: first hits. v: those of the sharpened occupancy. kp, kv: upper halves of K p and K v.
    float* p = scratch + item * 6 * n_columns;
    float* v = p + n_columns;
    float* kp = v + n_columns;
    float* kv = kp + n_columns;
    float* met = kv + n_columns;  // the occupancies, and the sharpened ones
    float* sharpened = met + n_columns;
    for (int64_t beam = begin; beam < begin + n_own; ++beam) {
        const int64_t t = yaws[view] * n_beams + beam;
        int64_t n = lengths[t];
        for (int a = 0; a < 3; ++a) {
            const int64_t wall = ahead[a * n_templates + t] ? size[a] - 1 - camera[a] : camera[a];
            n = minimum(n, leading[(a * n_templates + t) * n_steps + minimum(wall, n_steps - 1)]);
        }
        const int32_t* offset = offsets + t * n_columns;
        const float* volume = volumes + t * n_columns;
        int64_t first = 0;  // cell that can be hit
        while (first < n && occupancies[base + offset[first]] == 0.0f) ++first;
        for (int64_t i = first; i < n; ++i) {
            met[i] = occupancies[base + offset[i]];
            if (met[i] == 1.0f) n = i + 1;  // no beam passes
        }
        for (int64_t i = first; i < n; ++i) {
            const float oo = met[i] * met[i], clear = 1.0f - met[i];
            sharpened[i] = oo / (clear * clear + oo);
        }
        float reach = 1.0f, sharp_reach = 1.0f;
        double total = 0.0, information = 0.0;
        int64_t stop = first;  // after the last cell that can be hit
        for (int64_t i = first; i < n; ++i) {
            const float o = met[i], clear = 1.0f - o, sharp = sharpened[i];
            p[i] = reach * o;
            v[i] = 0.0f;
            if (o == 0.0f) continue;
            stop = i + 1;
            v[i] = sharp_reach * sharp;
            total += clear * p[i];
            if (is_shannon && o < 1.0f) {
                const double q = clear, r = o, passed = reach * q;
                information += p[i] * (-log(r + q / IMAGE_ODDS) - log_odds * q / (r * IMAGE_ODDS + q));
                information += passed * (-log(r + q * IMAGE_ODDS) + log_odds * q / (r / IMAGE_ODDS + q));
            }
            reach *= clear;
            sharp_reach *= 1.0f - sharp;
            if (reach == 0.0f) break;
        }
        if (!(total > WORTHLESS)) continue;
        if (!is_shannon) {
            for (int64_t i = first; i < stop; ++i) {
                kp[i] = 0.5f * p[i];
                kv[i] = 0.5f * v[i];
            }
            for (int64_t s = 1; s <= band; ++s) {
                const float* diagonal = kernel + ((s - 1) * n_templates + t) * n_columns;
                for (int64_t i = first; i + s < stop; ++i) {
                    kp[i] += diagonal[i] * p[i + s];
                    kv[i] += diagonal[i] * v[i + s];
                }
            }
            double like = 0.5 * reach * reach, cross = (double)reach * sharp_reach;  // without a hit
            for (int64_t i = first; i < stop; ++i) {
                like += p[i] * kp[i];
                cross += p[i] * kv[i] + v[i] * kp[i];
            }
            information = log(2.0 * like) - 2.0 * log(cross);
        }
        const float share = (float)(maximum(information, 0.0) / total);
        // Neighbouring cells mostly share a block, whose sums stay in registers.
        int64_t block = -1;
        float gained = 0.0f, took = 0.0f;
        for (int64_t i = first; i < stop; ++i) {
            if (p[i] == 0.0f) continue;
            const int64_t next = blocks[base + offset[i]];
            if (next != block) {
                if (block >= 0) {
                    closed(gain + block, gained);
                    closed(taken + block, took);
                }
                block = next;
                gained = opened(gain + block);
                took = opened(taken + block);
            }
            const float o = met[i], clear = 1.0f - o, resolved = clear * p[i];
            gained += resolved * volume[i] * share;
            took += minimum(clear * o, resolved / REACHED) * volume[i];
        }
        if (block >= 0) {
            closed(gain + block, gained);
            closed(taken + block, took);
        }
    }
}

}  // namespace gmm
