// Attributes of components that are numbers, in an adaptive binary range coder, written or read. An item is a
// channel. The twin, with the meaning of every context, is mapping/codec/number_model.py: both do the same
// operations in the same order.
#pragma once

#include "range_coder.h"

namespace gmm {

// rows (K, n): of K components the share, then A powers of √2, A means, and slopes. power: √2 to the powers
// −most … most. level, height (A,): scratch, of the components before.
struct Numbers {
    int64_t k;
    int64_t n;
    int64_t width;
    int64_t* rows;
    const double* power;
    int64_t most;
    int64_t* level;
    double* height;
};

template <bool WRITES>
struct NumberWalk {
    Numbers b;
    RangeCoder<WRITES> c;
    bool begun;

    GMM_INLINE void code(int64_t& value, int64_t field, int64_t expected, int64_t most) {
        value = expected + c.whole(c.s.first_slot[field], value - expected, 0);
        c.good = c.good && value >= -most && value <= most;
    }

    GMM_INLINE void row(int64_t* v) {
        code(v[0], 0, 8, 8);
        c.good = c.good && v[0] >= 0;
        if (!c.good || v[0] == 0) return;
        int64_t *size = v + 1, *mean = size + b.width, *slope = mean + b.width;
        for (int64_t a = 0; a < b.width && c.good; ++a) {
            int64_t expected = a > 0 ? size[a - 1] : 0;
            if (begun) {
                const int64_t shift = a > 0 ? 64 * size[a - 1] - b.level[a - 1] : 0;
                expected = (b.level[a] + shift + 32) >> 6;
            }
            code(size[a], 1 + minimum(a, (int64_t)2), expected, b.most);
        }
        for (int64_t a = 0; a < b.width && c.good; ++a) {
            const double step = b.power[size[a] + b.most];
            const double near = begun ? floor(b.height[a] / step + 0.5) : 0;
            const int64_t expected = fabs(near) < 1099511627776.0 ? (int64_t)near : 0;
            code(mean[a], a > 0 ? 5 : 4, expected, 1ll << 40);
        }
        int64_t steep = 0;
        const int64_t n_slopes = b.n - 1 - 2 * b.width, later = n_slopes / b.width;
        for (int64_t i = 0; i < n_slopes && c.good; ++i) {
            code(slope[i], (i < later ? 6 : 10) + minimum(steep, (int64_t)3), 0, 1ll << 40);
            steep += slope[i] < 0 ? -slope[i] : slope[i];
        }
        if (!c.good) return;
        for (int64_t a = 0; a < b.width; ++a) {
            const double value = mean[a] * b.power[size[a] + b.most];
            b.height[a] = begun ? b.height[a] + 0.6 * (value - b.height[a]) : value;
            b.level[a] = begun ? b.level[a] + ((64 * size[a] - b.level[a]) >> 2) : 64 * size[a];
        }
        begun = true;
    }

    GMM_INLINE int64_t run() {
        c.begin();
        for (int64_t i = 0; i < b.k && c.good; ++i) row(b.rows + i * b.n);
        return c.end();
    }
};

template <bool WRITES>
GMM_KERNEL number_coding(int64_t, Numbers numbers, Chances chances, Stream stream) {
    NumberWalk<WRITES> walk{numbers, {chances, stream, 0, 0, 0, 0, 0, 0, false, true}, false};
    *stream.result = walk.run();
}

}  // namespace gmm
