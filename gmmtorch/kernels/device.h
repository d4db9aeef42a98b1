// What all kernels use. A kernel is a function that starts with GMM_KERNEL: it runs once for each item of a
// launch.
#pragma once

#if !defined(CUDA_CALLABLE)  // Warp's header is absent where an editor or another compiler reads a file alone
#include <cmath>
#include <cstdint>
#define CUDA_CALLABLE
using std::atan2, std::ceil, std::cos, std::exp, std::fabs, std::floor, std::fma, std::log, std::pow,
    std::rint, std::sin, std::sqrt;
#endif

#define GMM_INLINE CUDA_CALLABLE inline __attribute__((always_inline))
#define GMM_KERNEL GMM_INLINE void
#ifdef __CUDACC__
#define GMM_CALLED GMM_INLINE
#else  // of a long function with many callers, one copy compiles in a third of the time
#define GMM_CALLED __attribute__((noinline))
#endif

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

// The threads that share one item: those of a block on CUDA, of which each passes its own `item`; on a CPU
// one does the work of all.
struct Squad {
    int64_t item;
    int lane, n;
};

constexpr int BLOCK = 64;
#if defined(__CUDA_ARCH__)
#define GMM_SHARED __shared__
constexpr int THREADS = BLOCK;
#else
#define GMM_SHARED
constexpr int THREADS = 1;
#endif

GMM_INLINE Squad squad_of(int64_t item) {
#if defined(__CUDA_ARCH__)
    return {item / THREADS, (int)threadIdx.x, THREADS};
#else
    return {item, 0, THREADS};
#endif
}

// Waits for all threads of a squad; what they wrote before can be read after.
GMM_INLINE void meet(const Squad&) {
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
}

// Calls combine(a, b) for pairs of n places, a power of two, until the result is in the first `left`.
template <typename Combine>
GMM_INLINE void reduce(const Squad& squad, int n, int left, Combine combine) {
    meet(squad);
    for (int half = n / 2; half >= left; half /= 2) {
        for (int i = squad.lane; i < half; i += squad.n) combine(i, i + half);
        meet(squad);
    }
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
