// Colors in vectors: display values and linear light (sRGB, IEC 61966-2-1), and rows of three values as lanes.
#pragma once
#include "constants.h"
#include "simd.h"

static constexpr float DISPLAY_TOE = constants::DISPLAY_TOE;  // display value below which the sRGB curve is a straight line
static constexpr float LINEAR_TOE = constants::LINEAR_TOE;    // linear light at the same place

// The curve and its slope.
static inline Vec to_light(Vec display, Vec &slope) {
    Mask low = display <= DISPLAY_TOE;
    Vec base = (larger(display, splat(DISPLAY_TOE)) + .055f) * (1 / 1.055f), power = exp2(log2(base) * 1.4f);
    slope = select(low, splat(1 / 12.92f), power * (2.4f / 1.055f));
    return select(low, display * (1 / 12.92f), power * base);
}
static inline Vec to_display(Vec light, Vec &slope) {
    Mask low = light <= LINEAR_TOE;
    Vec base = larger(light, splat(LINEAR_TOE)), power = exp2(log2(base) * (1 / 2.4f));
    slope = select(low, splat(12.92f), power / base * (1.055f / 2.4f));
    return select(low, light * 12.92f, power * 1.055f - .055f);
}

template <int... I>
struct Indices {};
template <int N, int... I>
struct CountTo : CountTo<N - 1, N - 1, I...> {};
template <int... I>
struct CountTo<0, I...> {
    typedef Indices<I...> type;  // 0 to N - 1
};

// Channel C of VW rows of three values that lie in the vectors a, b, c.
template <int C, int... I>
static inline Vec channel_of(Vec a, Vec b, Vec c, Indices<I...>) {
    Vec early = __builtin_shufflevector(a, b, (3 * I + C < 2 * VW ? 3 * I + C : 0)...);
    return __builtin_shufflevector(early, c, (3 * I + C < 2 * VW ? I : 3 * I + C - VW)...);
}

// Floats K VW to (K + 1) VW - 1 of VW rows whose channels are x, y, z.
template <int K, int... I>
static inline Vec rows_of(Vec x, Vec y, Vec z, Indices<I...>) {
    Vec early = __builtin_shufflevector(x, y, ((K * VW + I) % 3 == 1 ? VW + (K * VW + I) / 3 : (K * VW + I) / 3)...);
    return __builtin_shufflevector(early, z, ((K * VW + I) % 3 == 2 ? VW + (K * VW + I) / 3 : I)...);
}

// Lane l of three vectors from row l of (count, 3), zeros beyond, and back.
static inline void load_rows(const float *from, int count, Vec *to) {
    Vec rows[3] = {};
    if (count == VW)
        memcpy(rows, from, sizeof rows);
    else
        memcpy(rows, from, 3 * count * sizeof(float));
    CountTo<VW>::type lanes;
    to[0] = channel_of<0>(rows[0], rows[1], rows[2], lanes);
    to[1] = channel_of<1>(rows[0], rows[1], rows[2], lanes);
    to[2] = channel_of<2>(rows[0], rows[1], rows[2], lanes);
}
static inline void store_rows(const Vec *from, int count, float *to) {
    CountTo<VW>::type lanes;
    const Vec rows[3] = {rows_of<0>(from[0], from[1], from[2], lanes), rows_of<1>(from[0], from[1], from[2], lanes),
                         rows_of<2>(from[0], from[1], from[2], lanes)};
    if (count == VW)
        memcpy(to, rows, sizeof rows);
    else
        memcpy(to, rows, 3 * count * sizeof(float));
}
