// Colours through water; water/medium.py says what is computed. One thread per Gaussian or pixel.
#include "common.cuh"

constexpr int VEIL_BASIS = 9, WATER_VALUES = 6 + 3 * VEIL_BASIS;  // beta_D (3), beta_B (3), raw coefficients of B (9, 3)

// sRGB (IEC 61966-2-1), and its slope.
__device__ inline float to_light(float display, float &slope) {
    if (display <= .04045f) {
        slope = 1 / 12.92f;
        return display / 12.92f;
    }
    float base = (display + .055f) / 1.055f, power = powf(base, 1.4f);
    slope = 2.4f / 1.055f * power;
    return power * base;
}
__device__ inline float to_display(float light, float &slope) {
    if (light <= .0031308f) {
        slope = 12.92f;
        return light * 12.92f;
    }
    float power = powf(light, 1 / 2.4f);
    slope = 1.055f / 2.4f * power / light;
    return 1.055f * power - .055f;
}

// B of one channel; the first `count` basis functions are used, the others are 0.
__device__ inline float veil_at(const float *basis, Index count, const float *values, int channel) {
    float raw = 0;
#pragma unroll
    for (int k = 0; k < VEIL_BASIS; k++)
        if (k < count) raw += basis[k] * values[6 + 3 * k + channel];
    return 1 / (1 + expf(-raw));
}

// Unit direction of an offset (0 for none), and its length, which is taken in parts that neither overflow nor vanish.
__device__ inline float direction_of(const float *offset, float *direction) {
    float largest = fmaxf(fmaxf(fmaxf(fabsf(offset[0]), fabsf(offset[1])), fabsf(offset[2])), 1e-37f);
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

// sums (blocks, WATER_VALUES): the block's totals of what its threads give.
__device__ inline void block_sums(const float (&given)[WATER_VALUES], float *sums) {
    __shared__ float of_warp[WARPS][WATER_VALUES];
    int lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    for (int k = 0; k < WATER_VALUES; k++) {
        float one[1] = {given[k]}, total = lane_sum(one, lane);
        if (lane_value<1>(lane) == 0) of_warp[warp][k] = total;
    }
    __syncthreads();
    if (threadIdx.x >= WATER_VALUES) return;
    float total = 0;
    for (int w = 0; w < WARPS; w++) total += of_warp[w][threadIdx.x];
    sums[(Index)blockIdx.x * WATER_VALUES + threadIdx.x] = total;
}

// shown (N, 3) of colours J (N, 3) at offsets (N, 3) from the camera.
KERNEL(4)
water_forward(Index n, Index degree, Index linear, const float *values, const float *colors, const float *offsets,
              float *shown) {
    Index i = thread_index();
    if (i >= n) return;
    float direction[3], basis[MAX_BASIS], range = direction_of(offsets + 3 * i, direction), slope;
    basis_at(direction, basis);
    for (int c = 0; c < 3; c++) {
        float J = colors[3 * i + c];
        if (linear) J = to_light(J, slope);
        float veil = veil_at(basis, (degree + 1) * (degree + 1), values, c);
        float light = J * expf(-values[c] * range) - veil * expm1f(-values[3 + c] * range);
        shown[3 * i + c] = linear ? to_display(light, slope) : light;
    }
}

// Gradients by colours (N, 3), by the range as gradients by offsets (N, 3), and those by `values`, summed per block.
KERNEL(2)
water_backward(Index n, Index degree, Index linear, const float *values, const float *colors, const float *offsets,
               const float *by_shown, float *by_colors, float *by_offsets, float *sums) {
    Index i = thread_index(), count = (degree + 1) * (degree + 1);
    float given[WATER_VALUES] = {};
    if (i < n) {
        float direction[3], basis[MAX_BASIS], range = direction_of(offsets + 3 * i, direction), by_range = 0;
        basis_at(direction, basis);
#pragma unroll
        for (int c = 0; c < 3; c++) {
            float J = colors[3 * i + c], in_slope = 1, out_slope = 1, veil = veil_at(basis, count, values, c);
            if (linear) J = to_light(J, in_slope);
            float transmission = expf(-values[c] * range), remains = expf(-values[3 + c] * range);
            float gathered = -expm1f(-values[3 + c] * range);
            if (linear) to_display(J * transmission + veil * gathered, out_slope);
            float by_light = by_shown[3 * i + c] * out_slope;
            by_colors[3 * i + c] = by_light * transmission * in_slope;
            float by_attenuation = -by_light * J * transmission, by_backscatter = by_light * veil * remains;
            given[c] = by_attenuation * range;
            given[3 + c] = by_backscatter * range;
            by_range += by_attenuation * values[c] + by_backscatter * values[3 + c];
            float by_raw = by_light * gathered * veil * (1 - veil);
#pragma unroll
            for (int k = 0; k < VEIL_BASIS; k++)
                if (k < count) given[6 + 3 * k + c] = by_raw * basis[k];
        }
        for (int j = 0; j < 3; j++) by_offsets[3 * i + j] = by_range * direction[j];
    }
    block_sums(given, sums);
}

// Open water: B in the direction of each pixel, (height, width, 3).
KERNEL(4)
open_water_forward(Index pixels, Index width, Index degree, Index linear, const float *values, const float *viewmat,
                   const float *K, float *shown) {
    Index i = thread_index();
    if (i >= pixels) return;
    float direction[3], basis[MAX_BASIS], slope;
    pixel_direction(i, width, viewmat, K, direction);
    basis_at(direction, basis);
    for (int c = 0; c < 3; c++) {
        float veil = veil_at(basis, (degree + 1) * (degree + 1), values, c);
        shown[3 * i + c] = linear ? to_display(veil, slope) : veil;
    }
}

// The gradients by `values`, summed per block.
KERNEL(2)
open_water_backward(Index pixels, Index width, Index degree, Index linear, const float *values, const float *viewmat,
                    const float *K, const float *by_shown, float *sums) {
    Index i = thread_index(), count = (degree + 1) * (degree + 1);
    float given[WATER_VALUES] = {};
    if (i < pixels) {
        float direction[3], basis[MAX_BASIS];
        pixel_direction(i, width, viewmat, K, direction);
        basis_at(direction, basis);
#pragma unroll
        for (int c = 0; c < 3; c++) {
            float veil = veil_at(basis, count, values, c), slope = 1;
            if (linear) to_display(veil, slope);
            float by_raw = by_shown[3 * i + c] * slope * veil * (1 - veil);
#pragma unroll
            for (int k = 0; k < VEIL_BASIS; k++)
                if (k < count) given[6 + 3 * k + c] = by_raw * basis[k];
        }
    }
    block_sums(given, sums);
}

// shown (N, 3): display values (N, 3) with their light times e^log_factor, whose strides may be 0. One thread per number.
KERNEL(4)
relit_forward(Index n, Index row_stride, Index channel_stride, const float *display, const float *log_factor,
              float *shown) {
    Index i = thread_index();
    if (i >= 3 * n) return;
    float slope, factor = expf(log_factor[i / 3 * row_stride + i % 3 * channel_stride]);
    shown[i] = to_display(to_light(display[i], slope) * factor, slope);
}

// Gradients by display and by log_factor, each (N, 3).
KERNEL(4)
relit_backward(Index n, Index row_stride, Index channel_stride, const float *display, const float *log_factor,
               const float *by_shown, float *by_display, float *by_log_factor) {
    Index i = thread_index();
    if (i >= 3 * n) return;
    float light_slope, display_slope, factor = expf(log_factor[i / 3 * row_stride + i % 3 * channel_stride]);
    float light = to_light(display[i], light_slope) * factor;
    to_display(light, display_slope);
    float by_light = by_shown[i] * display_slope;
    by_display[i] = by_light * factor * light_slope;
    by_log_factor[i] = by_light * light;
}
