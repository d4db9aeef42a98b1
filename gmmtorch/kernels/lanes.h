// Vectors of numbers: `vec` has eight lanes on a CPU, one in each thread on CUDA; `single` has as many in
// single precision; `mask`, `whole`, exp, Mills' ratio.
#pragma once

#include "device.h"

#if defined(__clang__) && !defined(__CUDA_ARCH__)
#define GMM_VECTORS  // the compiler has vectors
// Without AVX-512 it warns that vectors as arguments are no ABI; a kernel calls only its own functions.
#pragma clang diagnostic ignored "-Wpsabi"
#endif

namespace gmm {

struct OneLane {
    typedef double vec;
    typedef bool mask;
    typedef int64_t whole;
    typedef float single;
    static constexpr int LANES = 1;
};

GMM_INLINE bool any(bool m) { return m; }
GMM_INLINE unsigned bits(bool m) { return m; }
GMM_INLINE double root(double x) { return sqrt(x); }
GMM_INLINE float narrow(double x) { return (float)x; }
GMM_INLINE double down(double x) { return floor(x); }
GMM_INLINE double nearby(double x) { return rint(x); }
GMM_INLINE double absolute(double x) { return fabs(x); }
GMM_INLINE int64_t integer(double x) { return (int64_t)x; }
GMM_INLINE double expo(double x) { return exp(x); }
GMM_INLINE double fused(double a, double b, double c) { return fma(a, b, c); }
GMM_INLINE double get(double v, int) { return v; }
GMM_INLINE int64_t get(int64_t v, int) { return v; }
GMM_INLINE void set(double& v, int, double x) { v = x; }
GMM_INLINE void set(float& v, int, float x) { v = x; }
GMM_INLINE double largest(double v) { return v; }

#if defined(GMM_VECTORS)
struct EightLanes {
    typedef double vec __attribute__((ext_vector_type(8)));
    typedef decltype(vec() < vec()) mask;
    typedef mask whole;
    typedef float single __attribute__((ext_vector_type(8)));
    static constexpr int LANES = 8;
};

typedef EightLanes Lanes;
#else
typedef OneLane Lanes;
#endif

typedef Lanes::vec vec;
typedef Lanes::mask mask;
typedef Lanes::single single;
typedef decltype(single() < single()) single_mask;
constexpr int LANES = Lanes::LANES;

// Takes the lowest of some bits, and returns its number.
GMM_INLINE int take_lowest(unsigned& left) {
#if defined(GMM_VECTORS)
    const int found = __builtin_ctz(left);
#else
    int found = 0;
    while (!(left >> found & 1)) ++found;
#endif
    left &= left - 1;
    return found;
}

#if defined(GMM_VECTORS)
GMM_INLINE bool any(mask m) { return __builtin_reduce_or(m) != 0; }
typedef bool flags __attribute__((ext_vector_type(8)));
GMM_INLINE unsigned bits(mask m) {
    return __builtin_bit_cast(unsigned char, __builtin_convertvector(m, flags));
}
GMM_INLINE unsigned bits(single_mask m) {
    return __builtin_bit_cast(unsigned char, __builtin_convertvector(m, flags));
}
GMM_INLINE single narrow(vec x) { return __builtin_convertvector(x, single); }
GMM_INLINE vec root(vec x) { return __builtin_elementwise_sqrt(x); }
GMM_INLINE vec down(vec x) { return __builtin_elementwise_floor(x); }
GMM_INLINE vec nearby(vec x) { return __builtin_elementwise_roundeven(x); }
GMM_INLINE vec absolute(vec x) { return __builtin_elementwise_abs(x); }
GMM_INLINE Lanes::whole integer(vec x) { return __builtin_convertvector(x, Lanes::whole); }
GMM_INLINE vec fused(vec a, vec b, vec c) { return __builtin_elementwise_fma(a, b, c); }
GMM_INLINE double get(vec v, int i) { return v[i]; }
GMM_INLINE int64_t get(Lanes::whole v, int i) { return v[i]; }
// In memory: where a loop over lanes is not unrolled, v[i] = x would copy the whole vector for each lane.
GMM_INLINE void set(vec& v, int i, double x) { ((double*)&v)[i] = x; }
GMM_INLINE void set(single& v, int i, float x) { ((float*)&v)[i] = x; }

// Four numbers of the row of each lane.
template <typename RowOf>
GMM_INLINE void load_four(const double* rows, RowOf row_of, int width, vec* x) {
    typedef double quad __attribute__((ext_vector_type(4)));
    typedef double packed __attribute__((ext_vector_type(4), aligned(8)));
    quad column[2][4];
    for (int half = 0; half < 2; ++half) {  // the transpose of four rows
        quad given[4];
        for (int l = 0; l < 4; ++l) given[l] = *(const packed*)(rows + row_of(4 * half + l) * width);
        const quad a = __builtin_shufflevector(given[0], given[1], 0, 4, 2, 6);
        const quad b = __builtin_shufflevector(given[0], given[1], 1, 5, 3, 7);
        const quad c = __builtin_shufflevector(given[2], given[3], 0, 4, 2, 6);
        const quad d = __builtin_shufflevector(given[2], given[3], 1, 5, 3, 7);
        column[half][0] = __builtin_shufflevector(a, c, 0, 1, 4, 5);
        column[half][1] = __builtin_shufflevector(b, d, 0, 1, 4, 5);
        column[half][2] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
        column[half][3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
    }
    for (int i = 0; i < 4; ++i)
        x[i] = __builtin_shufflevector(column[0][i], column[1][i], 0, 1, 2, 3, 4, 5, 6, 7);
}

GMM_INLINE double largest(vec v) {
    vec other = __builtin_shufflevector(v, v, 4, 5, 6, 7, 4, 5, 6, 7);
    v = v > other ? v : other;
    other = __builtin_shufflevector(v, v, 2, 3, 2, 3, 2, 3, 2, 3);
    v = v > other ? v : other;
    return v[0] > v[1] ? v[0] : v[1];
}

// Relative error below 4e-16 between -700 and 700, where x is clamped.
GMM_INLINE vec expo(vec x) {
    x = x < -700.0 ? (vec)(-700.0) : x;
    x = x > 700.0 ? (vec)(700.0) : x;
    const vec shifted = x * 1.4426950408889634 + 6755399441055744.0;  // n in its lowest bits
    const vec n = shifted - 6755399441055744.0;
    const vec r = fused(n, (vec)(-1.90821492927058770002e-10), fused(n, (vec)(-0.693147180369123816490), x));
    const double factorials[12] = {39916800.0, 3628800.0, 362880.0, 40320.0, 5040.0, 720.0,
                                   120.0,      24.0,      6.0,      2.0,     1.0,    1.0};
    vec p = (vec)(1.0 / 479001600.0);
    for (int i = 0; i < 12; ++i) p = fused(p, r, (vec)(1.0 / factorials[i]));
    const mask power = __builtin_bit_cast(mask, shifted) << 52;
    return __builtin_bit_cast(vec, __builtin_bit_cast(mask, p) + power);
}
#endif

// The row of each lane, of rows of WIDTH numbers.
template <int WIDTH, typename Real, typename RowOf>
GMM_INLINE void load_rows(const Real* rows, RowOf row_of, vec* x) {
    int first = 0;
#if defined(GMM_VECTORS)
    if constexpr (sizeof(Real) == sizeof(double))
        for (; first + 4 <= WIDTH; first += 4) load_four(rows + first, row_of, WIDTH, x + first);
#endif
    for (int l = 0; l < LANES; ++l) {
        const Real* given = rows + row_of(l) * WIDTH;
        for (int n = first; n < WIDTH; ++n) set(x[n], l, (double)given[n]);
    }
}

// Natural logarithm of normal numbers above 0; error below 3e-16 (1 + |log x|).
GMM_INLINE vec logarithm(vec x) {
#if defined(GMM_VECTORS)
    const mask bits = __builtin_bit_cast(mask, x);
    const vec part = __builtin_bit_cast(vec, (bits & 0xFFFFFFFFFFFFFll) | 0x3FF0000000000000ll);
    const vec power = __builtin_convertvector((bits >> 52) - 1023, vec);
#else
    int exponent;
    const vec part = 2.0 * frexp(x, &exponent), power = exponent - 1.0;
#endif
    const vec t = (part - 1.0) / (part + 1.0), tt = t * t;
    vec p = (vec)(1.0 / 21.0);
    for (int i = 19; i >= 1; i -= 2) p = fused(p, tt, (vec)(1.0 / i));
    return power * 0.693147180559945309417 + 2.0 * t * p;
}

// The angle of (x, y); error below 4e-16. Rational function of Cephes (Moshier 1989).
GMM_INLINE vec arctangent(vec y, vec x) {
#if defined(GMM_VECTORS)
    const vec ax = absolute(x), ay = absolute(y);
    const mask is_steep = ay > ax;
    vec small = is_steep ? ax : ay, large = is_steep ? ay : ax;
    large = large > 0.0 ? large : (vec)(1.0);
    const mask is_wide = small > 0.66 * large;  // beyond, the angle from 45 degrees
    const vec t = (is_wide ? small - large : small) / (is_wide ? small + large : large), z = t * t;
    vec p = (vec)(-0.8750608600031904122785), q = z + 24.85846490142306297962;
    p = fused(p, z, (vec)(-16.15753718733365076637));
    p = fused(p, z, (vec)(-75.00855792314704667340));
    p = fused(p, z, (vec)(-122.8866684490136173410));
    p = fused(p, z, (vec)(-64.85021904942025371773));
    q = fused(q, z, (vec)(165.0270098316988542046));
    q = fused(q, z, (vec)(432.8810604912902668951));
    q = fused(q, z, (vec)(485.3903996359136964868));
    q = fused(q, z, (vec)(194.5506571482613964425));
    vec angle = t + t * (z * p / q);
    angle = is_wide ? angle + 0.78539816339744830962 : angle;
    angle = is_steep ? 1.57079632679489661923 - angle : angle;
    angle = x < 0.0 ? 3.14159265358979323846 - angle : angle;
    return y < 0.0 ? -angle : angle;
#else
    return atan2(y, x);
#endif
}

// Mills' ratio R(x) = e^(x*x/2) integral of e^(-w*w/2) from x, for x >= 0. A polynomial in t = (x - 3.5)/(x
// + 3.5) interpolates (1 + x) R(x) at Chebyshev nodes in t (substitution of Shepherd & Laframboise 1981);
// relative error 2e-14.
GMM_INLINE vec mills(vec x) {
    const double c[23] = {
        1.1995549603570066,      -0.24492908847573483,    0.0019722954680675953,  0.09537120623471908,
        -0.07584057196494208,    0.026019720645055353,    0.000658739314212789,   -0.0035720573940499914,
        0.0003697001811368178,   0.0005347378018567725,   -6.178536177826783e-05, -9.796267488692001e-05,
        1.7148664092742522e-06,  1.9463951187330875e-05,  3.1954198511379135e-06, -3.523740392012662e-06,
        -1.5724856549774496e-06, 4.5897502967394406e-07,  4.802961679927754e-07,  -2.0994793053819336e-08,
        -9.765595887420525e-08,  -2.9857433243157565e-09, 1.0223231681768988e-08};
    const vec scale = 1.0 / ((x + 3.5) * (1.0 + x));
    const vec t = 1.0 - 7.0 * (1.0 + x) * scale, tt = t * t;
    vec even = (vec)(c[22]), odd = (vec)(c[21]);
    for (int i = 20; i >= 2; i -= 2) {
        even = even * tt + c[i];
        odd = odd * tt + c[i - 1];
    }
    even = even * tt + c[0];
    return (even + odd * t) * (x + 3.5) * scale;
}

}  // namespace gmm
