// Colors through water (Kernels.through_water in protocol.py): shown = J exp(-beta_D r) + B(d) (1 - exp(-beta_B r)).
// VW Gaussians, or VW pixels of a row, at a time.
#include "light.h"
#include "sh.h"
#include "simd.h"

namespace {

constexpr int SUMS = 33;                 // gradients by beta_D (3), beta_B (3) and the raw SH coefficients of B (9, 3)
constexpr float LEAST_LENGTH = 1e-37f;   // scene units; keeps the division by the largest component finite

struct Water {
    int degree, basis_count;
    bool linear;  // whether the formula works on linear light: display values are converted and back
    float attenuation[3], backscatter[3];  // beta_D and beta_B, 1 / scene unit
    float raw_background[9][3];            // raw SH coefficients of B

    Water(int64_t degree, int64_t linear, const float *coefficients)
        : degree((int)degree), basis_count((int)((degree + 1) * (degree + 1))), linear(linear) {
        memcpy(attenuation, coefficients, sizeof attenuation);
        memcpy(backscatter, coefficients + 3, sizeof backscatter);
        memcpy(raw_background, coefficients + 6, sizeof raw_background);
    }

    // B of one channel: the sigmoid of its SH.
    Vec background_light(const Vec *basis, int channel) const {
        Vec raw = Vec{};
        for (int k = 0; k < basis_count; k++) raw += basis[k] * raw_background[k][channel];
        return 1.f / (1.f + exponential(-raw));
    }
};

inline void direction_and_range(const Vec *offset, Vec *direction, Vec &range) {
    // Divided by the largest component first, so that squares of far and near offsets neither overflow nor vanish.
    Vec largest = larger(larger(larger(offset[0], -offset[0]), larger(offset[1], -offset[1])), larger(offset[2], -offset[2]));
    largest = larger(largest, splat(LEAST_LENGTH));
    Vec inverse = 1.f / largest, x = offset[0] * inverse, y = offset[1] * inverse, z = offset[2] * inverse;
    Vec length = square_root(x * x + y * y + z * z);
    range = length * largest;
    Mask some = length > 0.f;
    Vec unit = masked(some, 1.f / select(some, length, splat(1.f)));
    direction[0] = x * unit, direction[1] = y * unit, direction[2] = z * unit;
}

// Directions in the world of the centres of pixels (x + lane, y); K (3, 3), viewmat (4, 4) world to camera.
inline void pixel_directions(int64_t x, int64_t y, const float *viewmat, const float *K, Vec *direction) {
    Vec u;
    for (int l = 0; l < VW; l++) u[l] = (float)l;
    u = (u + ((float)x + .5f - K[2])) / K[0];
    float v = (y + .5f - K[5]) / K[4];
    Vec inverse = 1.f / square_root(u * u + (v * v + 1.f));
    for (int i = 0; i < 3; i++) direction[i] = (u * viewmat[i] + (v * viewmat[4 + i] + viewmat[8 + i])) * inverse;
}

// The log gains of channel c of rows [row, row + count).
inline Vec log_gains(const float *from, int64_t row, int c, int count, int64_t row_stride, int64_t channel_stride) {
    Vec logs = Vec{};
    for (int l = 0; l < count; l++) logs[l] = from[(row + l) * row_stride + c * channel_stride];
    return logs;
}

void write_sums(const Vec *total, double *sums) {
    for (int k = 0; k < SUMS; k++) sums[k] = sum(total[k]);
}

}  // namespace

// shown (N, 3) of Gaussians [begin, end) with colors J (N, 3) at offsets (N, 3) from the camera.
API void water_forward(int64_t begin, int64_t end, int64_t degree, int64_t linear, const float *coefficients,
                       const float *colors, const float *offsets, float *shown) {
    const Water water(degree, linear, coefficients);
    for (int64_t i = begin; i < end; i += VW) {
        int count = (int)smaller<int64_t>(VW, end - i);
        Vec color[3], offset[3], direction[3], range, basis[MAX_BASIS], slope;
        load_rows(colors + 3 * i, count, color);
        load_rows(offsets + 3 * i, count, offset);
        direction_and_range(offset, direction, range);
        basis_at(direction, water.degree, basis);
        for (int c = 0; c < 3; c++) {
            Vec J = water.linear ? to_light(color[c], slope) : color[c];
            Vec light = J * exponential(range * -water.attenuation[c]) +
                        water.background_light(basis, c) * (1.f - exponential(range * -water.backscatter[c]));
            color[c] = water.linear ? to_display(light, slope) : light;
        }
        store_rows(color, count, shown + 3 * i);
    }
}

// Gradients by colors (N, 3), by the range as gradients by offsets (N, 3) unless `by_offsets` is null, and the sums over
// [begin, end) of those by the coefficients, in `sums` (33,).
API void water_backward(int64_t begin, int64_t end, int64_t degree, int64_t linear, const float *coefficients,
                        const float *colors, const float *offsets, const float *by_shown, float *by_colors,
                        float *by_offsets, double *sums) {
    const Water water(degree, linear, coefficients);
    Vec total[SUMS] = {};
    for (int64_t i = begin; i < end; i += VW) {
        int count = (int)smaller<int64_t>(VW, end - i);
        Vec color[3], offset[3], gradient[3], direction[3], range, by_range = {}, basis[MAX_BASIS];
        load_rows(colors + 3 * i, count, color);
        load_rows(offsets + 3 * i, count, offset);
        load_rows(by_shown + 3 * i, count, gradient);  // 0 beyond the end: adds nothing to the sums
        direction_and_range(offset, direction, range);
        basis_at(direction, water.degree, basis);
        for (int c = 0; c < 3; c++) {
            Vec J = color[c], in_slope = splat(1.f), out_slope = splat(1.f);
            if (water.linear) J = to_light(J, in_slope);
            Vec transmission = exponential(range * -water.attenuation[c]), B = water.background_light(basis, c);
            Vec remains = exponential(range * -water.backscatter[c]);
            if (water.linear) to_display(J * transmission + B * (1.f - remains), out_slope);
            Vec by_light = gradient[c] * out_slope;
            gradient[c] = by_light * transmission * in_slope;
            Vec by_attenuation = -by_light * J * transmission, by_backscatter = by_light * B * remains;
            total[c] += by_attenuation * range;
            total[3 + c] += by_backscatter * range;
            by_range += by_attenuation * water.attenuation[c] + by_backscatter * water.backscatter[c];
            Vec by_raw = by_light * (1.f - remains) * B * (1.f - B);
            for (int k = 0; k < water.basis_count; k++) total[6 + 3 * k + c] += by_raw * basis[k];
        }
        store_rows(gradient, count, by_colors + 3 * i);
        if (!by_offsets) continue;
        for (int j = 0; j < 3; j++) direction[j] *= by_range;
        store_rows(direction, count, by_offsets + 3 * i);
    }
    write_sums(total, sums);
}

// Open water in rows [begin, end): B in the direction of each pixel, as display values (height, width, 3).
API void open_water_forward(int64_t begin, int64_t end, int64_t width, int64_t degree, int64_t linear,
                            const float *coefficients, const float *viewmat, const float *K, float *shown) {
    const Water water(degree, linear, coefficients);
    for (int64_t y = begin; y < end; y++)
        for (int64_t x = 0; x < width; x += VW) {
            Vec direction[3], basis[MAX_BASIS], B[3], slope;
            pixel_directions(x, y, viewmat, K, direction);
            basis_at(direction, water.degree, basis);
            for (int c = 0; c < 3; c++) {
                B[c] = water.background_light(basis, c);
                if (water.linear) B[c] = to_display(B[c], slope);
            }
            store_rows(B, (int)smaller<int64_t>(VW, width - x), shown + (y * width + x) * 3);
        }
}

// The sums over rows [begin, end) of the gradients by the coefficients.
API void open_water_backward(int64_t begin, int64_t end, int64_t width, int64_t degree, int64_t linear,
                             const float *coefficients, const float *viewmat, const float *K, const float *by_shown,
                             double *sums) {
    const Water water(degree, linear, coefficients);
    Vec total[SUMS] = {};
    for (int64_t y = begin; y < end; y++)
        for (int64_t x = 0; x < width; x += VW) {
            Vec direction[3], basis[MAX_BASIS], gradient[3];
            pixel_directions(x, y, viewmat, K, direction);
            basis_at(direction, water.degree, basis);
            load_rows(by_shown + (y * width + x) * 3, (int)smaller<int64_t>(VW, width - x), gradient);
            for (int c = 0; c < 3; c++) {
                Vec B = water.background_light(basis, c), slope = splat(1.f);
                if (water.linear) to_display(B, slope);
                Vec by_raw = gradient[c] * slope * B * (1.f - B);
                for (int k = 0; k < water.basis_count; k++) total[6 + 3 * k + c] += by_raw * basis[k];
            }
        }
    write_sums(total, sums);
}

// shown (N, 3): display values (N, 3) of rows [begin, end) with their linear light times e^log_gain, whose strides
// may be 0.
API void gain_forward(int64_t begin, int64_t end, int64_t row_stride, int64_t channel_stride, const float *display,
                      const float *log_gain, float *shown) {
    for (int64_t i = begin; i < end; i += VW) {
        int count = (int)smaller<int64_t>(VW, end - i);
        Vec color[3], slope;
        load_rows(display + 3 * i, count, color);
        for (int c = 0; c < 3; c++) {
            Vec logs = log_gains(log_gain, i, c, count, row_stride, channel_stride);
            color[c] = to_display(to_light(color[c], slope) * exponential(logs), slope);
        }
        store_rows(color, count, shown + 3 * i);
    }
}

// Gradients by display and by log_gain, each (N, 3).
API void gain_backward(int64_t begin, int64_t end, int64_t row_stride, int64_t channel_stride, const float *display,
                       const float *log_gain, const float *by_shown, float *by_display, float *by_log_gain) {
    for (int64_t i = begin; i < end; i += VW) {
        int count = (int)smaller<int64_t>(VW, end - i);
        Vec color[3], by_color[3], by_log[3];
        load_rows(display + 3 * i, count, color);
        load_rows(by_shown + 3 * i, count, by_color);
        for (int c = 0; c < 3; c++) {
            Vec factor = exponential(log_gains(log_gain, i, c, count, row_stride, channel_stride));
            Vec light_slope, display_slope, light = to_light(color[c], light_slope) * factor;
            to_display(light, display_slope);
            Vec by_light = by_color[c] * display_slope;
            by_color[c] = by_light * factor * light_slope;
            by_log[c] = by_light * light;
        }
        store_rows(by_color, count, by_display + 3 * i);
        store_rows(by_log, count, by_log_gain + 3 * i);
    }
}
