// Vectors of VW floats by the compiler's vector extensions (clang and gcc), the same source for every instruction set.
// C headers only: nothing of a C++ library is compiled or linked.
#pragma once
#include <stdint.h>
#include <string.h>

#ifndef VW
#define VW 8
#endif
#if defined(_WIN32)
#define API extern "C" __declspec(dllexport)
#else
#define API extern "C" __attribute__((visibility("default")))
#endif

typedef float Vec __attribute__((vector_size(VW * 4)));
typedef int32_t Mask __attribute__((vector_size(VW * 4)));  // all bits set: true
typedef uint32_t Bits __attribute__((vector_size(VW * 4)));

static inline Vec splat(float x) { return x - Vec{}; }
static inline Vec masked(Mask m, Vec a) { return (Vec)(m & (Mask)a); }
static inline Vec select(Mask m, Vec a, Vec b) { return (Vec)((m & (Mask)a) | (~m & (Mask)b)); }

template <class V>
static inline V smaller(V a, V b) { return a < b ? a : b; }
template <class V>
static inline V larger(V a, V b) { return a > b ? a : b; }

static inline bool any(Mask m) {
#if defined(__clang__)
    return __builtin_reduce_or(m) != 0;
#else
    int32_t bits = 0;
    for (int i = 0; i < VW; i++) bits |= m[i];
    return bits != 0;
#endif
}

// One bit for each lane that is true.
template <class M>
static inline uint32_t bits(M m) {
    uint32_t result = 0;
    for (unsigned i = 0; i < sizeof(M) / 4; i++) result |= (m[i] & 1u) << i;
    return result;
}

typedef float Quad __attribute__((vector_size(16)));

// Four partial sums of the lanes.
static inline Quad quarter_sums(Vec v) {
    Quad parts[VW / 4];
    memcpy(parts, &v, sizeof v);
    for (int half = VW / 8; half > 0; half /= 2)
        for (int i = 0; i < half; i++) parts[i] += parts[i + half];
    return parts[0];
}

static inline float sum(Vec v) {
    Quad q = quarter_sums(v);
    return (q[0] + q[2]) + (q[1] + q[3]);
}

// Sums of the lanes of N vectors, four vectors at a time; one fixed order.
template <int N>
static inline void lane_sums(const Vec (&vectors)[N], float *sums) {
    for (int i = 0; i < N; i += 4) {
        Quad q[4] = {};
        for (int j = 0; j < 4 && i + j < N; j++) q[j] = quarter_sums(vectors[i + j]);
        Quad a = __builtin_shufflevector(q[0], q[1], 0, 4, 2, 6) + __builtin_shufflevector(q[0], q[1], 1, 5, 3, 7);
        Quad b = __builtin_shufflevector(q[2], q[3], 0, 4, 2, 6) + __builtin_shufflevector(q[2], q[3], 1, 5, 3, 7);
        Quad total = __builtin_shufflevector(a, b, 0, 1, 4, 5) + __builtin_shufflevector(a, b, 2, 3, 6, 7);
        memcpy(sums + i, &total, sizeof(float) * (N - i < 4 ? N - i : 4));
    }
}

template <class V>
static inline V square_root(V v) {
#if defined(__clang__)
    return __builtin_elementwise_sqrt(v);
#else
    for (unsigned i = 0; i < sizeof(V) / 4; i++) v[i] = __builtin_sqrtf(v[i]);
    return v;
#endif
}
static inline float square_root(float x) { return __builtin_sqrtf(x); }

// 2^x for x in [-126, 126], relative error 2e-7: x = n + f, the minimax polynomial of degree 5 on |f| <= 1/2, n added to the exponent bits.
static inline Vec exp2(Vec x) {
    const Vec magic = splat(12582912.f);  // 1.5 * 2^23: adding it rounds to an integer, found in the low mantissa bits
    Vec shifted = x + magic, f = x - (shifted - magic);
    Vec p = splat(1.326463674e-3f);
    p = p * f + 9.671482267e-3f;
    p = p * f + 5.550733689e-2f;
    p = p * f + 2.402224256e-1f;
    p = p * f + 6.931469778e-1f;
    p = p * f + 1.f;
    return (Vec)((Bits)p + ((Bits)shifted << 23));
}

static inline Vec exponential(Vec x) { return exp2(larger(smaller(x * 1.44269504f, splat(126.f)), splat(-126.f))); }

// log2 of positive normal numbers, absolute error 2e-7: x = m 2^e with m in [.7, 1.4], a series in (m - 1) / (m + 1).
static inline Vec log2(Vec x) {
    Mask bits = (Mask)x, exponent = (bits - 0x3f3504f3) >> 23;  // that is sqrt(1/2)
    Vec m = (Vec)(bits - (exponent << 23)), z = (m - 1.f) / (m + 1.f), zz = z * z;
    Vec p = splat(.3205988979f);
    p = p * zz + .4121985831f;
    p = p * zz + .5770780164f;
    p = p * zz + .9617966939f;
    p = p * zz + 2.8853900818f;
    return p * z + __builtin_convertvector(exponent, Vec);
}
