// What all kernels use. A kernel is a function that starts with GMM_KERNEL: it runs once for each item of a
// launch.
#pragma once

#if !defined(CUDA_CALLABLE)  // Warp's header is absent where an editor or another compiler reads a file alone
#include <cmath>
#include <cstdint>
#define CUDA_CALLABLE
using std::atan2, std::ceil, std::exp, std::fabs, std::floor, std::fma, std::log, std::rint, std::sqrt;
#endif

#define GMM_INLINE CUDA_CALLABLE inline __attribute__((always_inline))
#define GMM_KERNEL GMM_INLINE void

namespace gmm {

template <typename Number>
GMM_INLINE Number minimum(Number a, Number b) {
    return a < b ? a : b;
}

template <typename Number>
GMM_INLINE Number maximum(Number a, Number b) {
    return a > b ? a : b;
}

// Adds so that items can meet in one place on CUDA. On a CPU, kernels that do so use one thread.
template <typename Number>
GMM_INLINE void add(Number* place, Number value) {
#if defined(__CUDA_ARCH__)
    atomicAdd(place, value);
#else
    *place += value;
#endif
}

// The workers of one launch, each an item, that wait for each other: a whole iteration runs on the device. A
// worker takes every n-th piece of work, from that of its item on. On a CPU there is one worker.
struct Team {
    int64_t n;
    int* arrived;  // zero at the start
    int64_t rounds;
};

// Waits for all workers; what they wrote before can be read after. All of them call it equally often.
GMM_INLINE void meet(Team& team) {
#if defined(__CUDA_ARCH__)
    __syncthreads();
    team.rounds += 1;
    if (threadIdx.x == 0) {
        __threadfence();
        atomicAdd(team.arrived, 1);
        while (*(volatile int*)team.arrived < team.rounds * gridDim.x) __nanosleep(32);
        __threadfence();
    }
    __syncthreads();
#else
    (void)team;
#endif
}

// Starts to load n numbers.
GMM_INLINE void fetch(const double* place, int n) {
#if !defined(__CUDA_ARCH__)
    for (int byte = 0; byte < n * 8; byte += 64) __builtin_prefetch((const char*)place + byte);
#endif
}

// Features 1, x_i and x_i x_j (i ≤ j) of a point.
CUDA_CALLABLE constexpr int n_features(int dim) { return 1 + dim + dim * (dim + 1) / 2; }

}  // namespace gmm
