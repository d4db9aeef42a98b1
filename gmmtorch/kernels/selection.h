// The smallest of many numbers, found by a team.
#pragma once

#include "device.h"

namespace gmm {

// Numbers of 128 bits up to this one.
struct Cut {
    uint64_t high, low;

    GMM_INLINE bool has(uint64_t x, uint64_t y) const { return x < high || (x == high && y <= low); }
};

GMM_INLINE int64_t bits_of(double x) {
    union {
        double x;
        int64_t bits;
    } both;
    both.x = x;
    return both.bits;
}

constexpr int DIGITS = 16;  // of 8 bits
constexpr int SELECTION_COUNTS = 256 * DIGITS;

// Finds the cut up to which there are as many numbers as `wanted(their count)`; returns how many that are.
// number(i, x, y): whether item i of n has a number, and its two halves; no number occurs twice. counts
// (SELECTION_COUNTS,): zeros. All workers call it, and have met before.
template <typename Wanted, typename Number>
GMM_INLINE int64_t select_smallest(Team& team, int64_t item, int64_t n, int* counts, Cut& cut, Wanted wanted,
                                   Number number) {
    int64_t total = 0, left = 0;
    cut.high = cut.low = 0;
    for (int q = 0; q < DIGITS; ++q) {
        const int shift = 56 - 8 * (q % 8);
        const uint64_t above = q % 8 == 0 ? 0 : ~0ull << shift << 8;  // digits that are known
        uint64_t& half = q < 8 ? cut.high : cut.low;
        int* count = counts + 256 * q;
        for (int64_t i = item; i < n; i += team.n) {
            uint64_t x = 0, y = 0;
            if (!number(i, x, y) || (q >= 8 && x != cut.high)) continue;
            const uint64_t own = q < 8 ? x : y;
            if (((own ^ half) & above) == 0) add(count + ((own >> shift) & 255), 1);
        }
        meet(team);
        if (q == 0) {
            for (int d = 0; d < 256; ++d) total += count[d];
            left = total = wanted(total);
            if (total <= 0) return 0;
        }
        int digit = 0;
        for (; left > count[digit]; ++digit) left -= count[digit];
        half |= (uint64_t)digit << shift;
        if (left == count[digit]) {  // all of them
            half |= (1ull << shift) - 1;
            if (q < 8) cut.low = ~0ull;
            break;
        }
    }
    return total;
}

}  // namespace gmm
