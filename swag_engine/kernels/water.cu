// Colors through water; Kernels.through_water in protocol.py has the formula. One thread per Gaussian or pixel.
#include "common.cuh"
#include "constants.h"
#include "light.cuh"

constexpr int BACKGROUND_BASIS = 9;                     // SH coefficients of the background light B per channel
constexpr int COEFFICIENTS = 6 + 3 * BACKGROUND_BASIS;  // beta_D (3), beta_B (3), raw SH coefficients of B (9, 3)
constexpr float LEAST_LENGTH = 1e-37f;                  // scene units; keeps divisions by a length finite

// B of one channel; the first `count` basis functions are used, the others are 0.
__device__ inline float background_light(const float *basis, Index count, const float *coefficients, int channel) {
    float raw = 0;
#pragma unroll
    for (int k = 0; k < BACKGROUND_BASIS; k++)
        if (k < count) raw += basis[k] * coefficients[6 + 3 * k + channel];
    return 1 / (1 + expf(-raw));
}

// Unit direction of an offset (0 for none) and its length; no square overflows or vanishes.
__device__ inline float direction_of(const float *offset, float *direction) {
    float largest = fmaxf(fmaxf(fmaxf(fabsf(offset[0]), fabsf(offset[1])), fabsf(offset[2])), LEAST_LENGTH);
    float x = offset[0] / largest, y = offset[1] / largest, z = offset[2] / largest;
    float length = sqrtf(x * x + y * y + z * z), unit = length > 0 ? 1 / length : 0;
    direction[0] = x * unit, direction[1] = y * unit, direction[2] = z * unit;
    return length * largest;
}

// Direction in the world of a pixel's centre; K (3, 3), viewmat (4, 4) world to camera.
__device__ inline void pixel_direction(Index pixel, Index width, const float *viewmat, const float *K, float *direction) {
    float u = (pixel % width + .5f - K[2]) / K[0], v = (pixel / width + .5f - K[5]) / K[4];
    float inverse = 1 / sqrtf(u * u + v * v + 1);
    for (int i = 0; i < 3; i++) direction[i] = (viewmat[i] * u + viewmat[4 + i] * v + viewmat[8 + i]) * inverse;
}

// shown (N, 3) of colors J (N, 3) at offsets (N, 3) from the camera.
KERNEL(4)
water_forward(Index n, Index degree, Index linear, const float *coefficients, const float *colors,
              const float *offsets, float *shown) {
    Index i = thread_index();
    if (i >= n) return;
    float direction[3], basis[MAX_BASIS], range = direction_of(offsets + 3 * i, direction), slope;
    basis_at(direction, basis);
    for (int c = 0; c < 3; c++) {
        float J = colors[3 * i + c];
        if (linear) J = to_light(J, slope);
        float B = background_light(basis, (degree + 1) * (degree + 1), coefficients, c);
        float light = J * expf(-coefficients[c] * range) - B * expm1f(-coefficients[3 + c] * range);
        shown[3 * i + c] = linear ? to_display(light, slope) : light;
    }
}

// Gradients by colors (N, 3), by the range as gradients by offsets (N, 3) unless that is null, and those by the
// coefficients, summed per block.
KERNEL(2)
water_backward(Index n, Index degree, Index linear, const float *coefficients, const float *colors,
               const float *offsets, const float *by_shown, float *by_colors, float *by_offsets, float *sums) {
    Index i = thread_index(), count = (degree + 1) * (degree + 1);
    float given[COEFFICIENTS] = {};
    if (i < n) {
        float direction[3], basis[MAX_BASIS], range = direction_of(offsets + 3 * i, direction), by_range = 0;
        basis_at(direction, basis);
#pragma unroll
        for (int c = 0; c < 3; c++) {
            float J = colors[3 * i + c], in_slope = 1, out_slope = 1, B = background_light(basis, count, coefficients, c);
            if (linear) J = to_light(J, in_slope);
            float transmission = expf(-coefficients[c] * range), remains = expf(-coefficients[3 + c] * range);
            float gathered = -expm1f(-coefficients[3 + c] * range);
            if (linear) to_display(J * transmission + B * gathered, out_slope);
            float by_light = by_shown[3 * i + c] * out_slope;
            by_colors[3 * i + c] = by_light * transmission * in_slope;
            float by_attenuation = -by_light * J * transmission, by_backscatter = by_light * B * remains;
            given[c] = by_attenuation * range;
            given[3 + c] = by_backscatter * range;
            by_range += by_attenuation * coefficients[c] + by_backscatter * coefficients[3 + c];
            float by_raw = by_light * gathered * B * (1 - B);
#pragma unroll
            for (int k = 0; k < BACKGROUND_BASIS; k++)
                if (k < count) given[6 + 3 * k + c] = by_raw * basis[k];
        }
        for (int j = 0; by_offsets && j < 3; j++) by_offsets[3 * i + j] = by_range * direction[j];
    }
    block_sums(given, sums);
}

// Open water: B in the direction of each pixel, as display values (height, width, 3).
KERNEL(4)
open_water_forward(Index pixels, Index width, Index degree, Index linear, const float *coefficients,
                   const float *viewmat, const float *K, float *shown) {
    Index i = thread_index();
    if (i >= pixels) return;
    float direction[3], basis[MAX_BASIS], slope;
    pixel_direction(i, width, viewmat, K, direction);
    basis_at(direction, basis);
    for (int c = 0; c < 3; c++) {
        float B = background_light(basis, (degree + 1) * (degree + 1), coefficients, c);
        shown[3 * i + c] = linear ? to_display(B, slope) : B;
    }
}

// The gradients by the coefficients, summed per block.
KERNEL(2)
open_water_backward(Index pixels, Index width, Index degree, Index linear, const float *coefficients,
                    const float *viewmat, const float *K, const float *by_shown, float *sums) {
    Index i = thread_index(), count = (degree + 1) * (degree + 1);
    float given[COEFFICIENTS] = {};
    if (i < pixels) {
        float direction[3], basis[MAX_BASIS];
        pixel_direction(i, width, viewmat, K, direction);
        basis_at(direction, basis);
#pragma unroll
        for (int c = 0; c < 3; c++) {
            float B = background_light(basis, count, coefficients, c), slope = 1;
            if (linear) to_display(B, slope);
            float by_raw = by_shown[3 * i + c] * slope * B * (1 - B);
#pragma unroll
            for (int k = 0; k < BACKGROUND_BASIS; k++)
                if (k < count) given[6 + 3 * k + c] = by_raw * basis[k];
        }
    }
    block_sums(given, sums);
}

// shown (N, 3): display values (N, 3) with their linear light times e^log_gain,
// whose strides may be 0. One thread per number.
KERNEL(4)
gain_forward(Index n, Index row_stride, Index channel_stride, const float *display, const float *log_gain,
             float *shown) {
    Index i = thread_index();
    if (i >= 3 * n) return;
    float slope, factor = expf(log_gain[i / 3 * row_stride + i % 3 * channel_stride]);
    shown[i] = to_display(to_light(display[i], slope) * factor, slope);
}

// Gradients by display and by log_gain, each (N, 3).
KERNEL(4)
gain_backward(Index n, Index row_stride, Index channel_stride, const float *display, const float *log_gain,
              const float *by_shown, float *by_display, float *by_log_gain) {
    Index i = thread_index();
    if (i >= 3 * n) return;
    float light_slope, display_slope, factor = expf(log_gain[i / 3 * row_stride + i % 3 * channel_stride]);
    float light = to_light(display[i], light_slope) * factor;
    to_display(light, display_slope);
    float by_light = by_shown[i] * display_slope;
    by_display[i] = by_light * factor * light_slope;
    by_log_gain[i] = by_light * light;
}
