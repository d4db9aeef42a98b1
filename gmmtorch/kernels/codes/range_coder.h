// An adaptive binary range coder (Martin 1979), which writes or reads. The twin is `RangeCoder` in
// mapping/codec/range_coder.py.
#pragma once

#include "../device.h"

namespace gmm {

// chances: probability of a 0 in 1/65536, by slot; n_coded: bits that a slot has coded, up to `most_coded`.
struct Chances {
    int32_t* chances;
    int32_t* n_coded;
    const int64_t* rates;
    int64_t most_coded;
    const int64_t* first_slot;
};

// bytes: room for `size` bytes; those written, or read. most_steps: for each byte. result: bytes used; −1:
// damaged, or no room; −2: more steps.
struct Stream {
    uint8_t* bytes;
    int64_t size;
    int64_t most_steps;
    int64_t* result;
};

template <bool WRITES>
struct RangeCoder {
    Chances s;
    Stream out;
    uint64_t low;
    uint32_t range, code;
    int64_t at, pending;
    uint8_t cache;
    bool started, good;

    GMM_INLINE void begin() {
        low = 0, range = 0xFFFFFFFFu, code = 0, at = 0, pending = 0, cache = 0, started = false, good = true;
        if (!WRITES)
            for (int i = 0; i < 4; ++i) code = code << 8 | next();
    }

    // Zeros follow the stream: those at its end are not written.
    GMM_INLINE uint8_t next() {
        const uint8_t byte = at < out.size ? out.bytes[at] : 0;
        ++at;
        return byte;
    }

    GMM_INLINE void put(uint8_t byte) {
        if (at < out.size) out.bytes[at] = byte;
        good = good && at < out.size;
        ++at;
    }

    // Moves the highest byte of `low` out. A byte waits until no carry can change it; so do 0xFF after it.
    GMM_INLINE void shift() {
        if (low < 0xFF000000ull || low > 0xFFFFFFFFull) {
            const uint8_t carry = (uint8_t)(low >> 32);
            if (started) put((uint8_t)(cache + carry));
            for (; pending > 0; --pending) put((uint8_t)(0xFF + carry));
            started = true;
            cache = (uint8_t)(low >> 24);
        } else {
            ++pending;
        }
        low = (low & 0x00FFFFFFull) << 8;
    }

    GMM_INLINE void renew() {
        while (range < 1u << 24) {
            range <<= 8;
            if (WRITES)
                shift();
            else
                code = code << 8 | next();
        }
    }

    GMM_CALLED int64_t end() {
        if (WRITES) {
            uint64_t last = low;  // of the numbers that say the same, the one with most zeros at its end
            for (int n = 1; n < 32; ++n) {
                const uint64_t rounder = (low + (1ull << n) - 1) >> n << n;
                if (rounder < low + range) last = rounder;
            }
            low = last;
            for (int i = 0; i < 5; ++i) shift();
        }
        return good ? at : -1;
    }

    // One bit in a slot; `value` is it, or unused.
    GMM_INLINE int64_t bit(int64_t slot, int64_t value) {
        const uint32_t chance = (uint32_t)s.chances[slot], bound = (range >> 16) * chance;
        if (WRITES) {
            if (value) low += bound;
        } else {
            value = code >= bound;
            if (value) code -= bound;
        }
        range = value ? range - bound : bound;
        const int64_t n = s.n_coded[slot], step = ((value ? 0 : 65536) - (int64_t)chance) * s.rates[n];
        s.chances[slot] =
            (int32_t)(minimum(maximum((int64_t)chance + (step >> 16), (int64_t)64), (int64_t)65472));
        if (n < s.most_coded) s.n_coded[slot] = (int32_t)(n + 1);
        renew();
        return value;
    }

    // n bits without a model, highest first.
    GMM_CALLED int64_t raw(int64_t n, int64_t value) {
        int64_t found = 0;
        while (n > 0) {
            const int64_t width = minimum(n, (int64_t)8);
            n -= width;
            range >>= width;
            int64_t part = (value >> n) & ((1 << width) - 1);
            if (WRITES) {
                low += (uint64_t)range * (uint64_t)part;
            } else {
                part = minimum((int64_t)(code / range), (int64_t)(1 << width) - 1);
                code -= (uint32_t)part * range;
            }
            found = found << width | part;
            renew();
        }
        return found;
    }

    // n bits as a tree of 2^n slots, highest first.
    GMM_CALLED int64_t tree(int64_t first, int64_t n, int64_t value) {
        int64_t node = 1;
        for (int64_t i = n - 1; i >= 0; --i) node = node << 1 | bit(first + node, (value >> i) & 1);
        return node - (1 << n);
    }

    // A number ≥ 0 below 2^60: the length of value + 1 in unary, then its other bits; the two highest of
    // these have slots.
    GMM_CALLED int64_t number(int64_t first, int64_t value) {
        int64_t length = 0;
        const int64_t whole = value + 1;
        while (good && bit(first + 4 + minimum(length, (int64_t)11), (whole >> (length + 1)) != 0)) {
            if (++length > 60) good = false;
        }
        if (!good) return 0;
        int64_t found = 1;
        if (length > 0)
            found = 2 | bit(first + 15 + minimum(length, (int64_t)8), (whole >> (length - 1)) & 1);
        if (length > 1) {
            const int64_t slot = length < 5 ? 24 + 2 * (length - 2) + (found & 1) : 30;
            found = found << 1 | bit(first + slot, (whole >> (length - 2)) & 1);
        }
        if (length > 2) found = found << (length - 2) | raw(length - 2, whole & ((1ll << (length - 2)) - 1));
        return found - 1;
    }

    // Any whole number. side: 0, 1 or 2, the slot of its sign.
    GMM_CALLED int64_t whole(int64_t first, int64_t value, int64_t side) {
        if (!bit(first, value != 0)) return 0;
        const int64_t negative = bit(first + 1 + side, value < 0);
        const int64_t size = number(first, (value < 0 ? -value : value) - 1) + 1;
        return negative ? -size : size;
    }
};

}  // namespace gmm
