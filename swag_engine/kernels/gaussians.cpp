// From the parameters of Gaussians to what the other kernels take, and back; and the light of a lamp at the camera.
#include "light.h"
#include "simd.h"

namespace {

// Calls f on the vectors of `from` [begin, end), zeros beyond, and writes the results.
template <class F>
inline void each(int64_t begin, int64_t end, const float *from, float *to, F f) {
    int64_t i = begin;
    for (; i + VW <= end; i += VW) {
        Vec v;
        memcpy(&v, from + i, sizeof v);
        v = f(v, i);
        memcpy(to + i, &v, sizeof v);
    }
    if (i == end) return;
    Vec v = {};
    memcpy(&v, from + i, (end - i) * sizeof(float));
    v = f(v, i);
    memcpy(to + i, &v, (end - i) * sizeof(float));
}

inline Vec or_nan(Vec x, Vec result) { return select(x == x, result, x); }

inline Vec limited(Vec x, float limit) { return or_nan(x, larger(smaller(x, splat(limit)), splat(-limit))); }

inline Vec length(const Vec *v) { return square_root(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// The squared ranges of Gaussians [i, i + count) over that of the scene.
inline Vec squared_ranges(const float *offsets, int64_t i, int count, float unit_range) {
    Vec offset[3];
    load_rows(offsets + 3 * i, count, offset);
    Vec range = length(offset) / unit_range;
    return range * range;
}

}  // namespace

// Of Gaussians [begin, end): scales (N, 3) = exp(log_scales within [least, most]), opacities (N,) = sigmoid(logits), offsets
// (N, 3) from the camera's centre, each component within +-farthest, and their directions (N, 3).
API void activate(int64_t begin, int64_t end, const float *centre, const float *means, const float *log_scales,
                  const float *logits, float least, float most, float farthest, float *scales, float *opacities,
                  float *offsets, float *directions) {
    each(3 * begin, 3 * end, log_scales, scales, [=](Vec x, int64_t) {
        return or_nan(x, exponential(larger(smaller(x, splat(most)), splat(least))));
    });
    each(begin, end, logits, opacities, [](Vec x, int64_t) { return or_nan(x, 1.f / (1.f + exponential(-x))); });
    for (int64_t i = begin; i < end; i += VW) {
        int count = (int)smaller<int64_t>(VW, end - i);
        Vec offset[3], bounded[3];
        load_rows(means + 3 * i, count, offset);
        for (int j = 0; j < 3; j++) {
            offset[j] -= centre[j];
            bounded[j] = limited(offset[j], farthest);
        }
        Vec inverse = 1.f / larger(length(offset), splat(1e-12f));
        for (int j = 0; j < 3; j++) offset[j] *= inverse;
        store_rows(bounded, count, offsets + 3 * i);
        store_rows(offset, count, directions + 3 * i);
    }
}

// Gradients by scales and opacities, in place, become those by log_scales and logits.
API void activate_backward(int64_t begin, int64_t end, const float *log_scales, const float *scales, const float *opacities,
                           float least, float most, float *by_scales, float *by_opacities) {
    for (int64_t i = 3 * begin; i < 3 * end; i++)
        by_scales[i] = log_scales[i] >= least && log_scales[i] <= most ? by_scales[i] * scales[i] : 0;  // NaN: 0
    for (int64_t i = begin; i < end; i++) by_opacities[i] *= opacities[i] * (1 - opacities[i]);
}

// log_light (N,) of Gaussians [begin, end): the log of (tau + 1) / (tau + (range / unit_range)^2), as in effects/lamp.py.
API void lamp_forward(int64_t begin, int64_t end, const float *offsets, const float *tau, float unit_range,
                      float *log_light) {
    const float ln2 = .69314718f;
    for (int64_t i = begin; i < end; i += VW) {
        int count = (int)smaller<int64_t>(VW, end - i);
        Vec light = (*tau + 1) / (*tau + squared_ranges(offsets, i, count, unit_range)), logs = log2(light) * ln2;
        memcpy(log_light + i, &logs, count * sizeof(float));
    }
}

// The sum over [begin, end) of the gradient by tau, from that by the log light of each channel (N, 3).
API void lamp_backward(int64_t begin, int64_t end, const float *offsets, const float *tau, float unit_range,
                       const float *by_log_light, double *by_tau) {
    Vec total = {};
    for (int64_t i = begin; i < end; i += VW) {
        int count = (int)smaller<int64_t>(VW, end - i);
        Vec by[3], slope = 1 / (*tau + 1) - 1.f / (*tau + squared_ranges(offsets, i, count, unit_range));
        load_rows(by_log_light + 3 * i, count, by);  // 0 beyond the end: adds nothing
        total += (by[0] + by[1] + by[2]) * slope;
    }
    *by_tau = sum(total);
}
