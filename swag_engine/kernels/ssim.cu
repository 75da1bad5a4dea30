// L1 and SSIM of two images (height, width, 3) and their gradient; ssim.cpp says what is computed. A block is 16 x 16
// pixels.
#include "common.cuh"
#include "constants.h"

constexpr int CHANNELS = 3;                 // of an image
constexpr int REACH = 5;                    // pixels from the centre of the window to its end
constexpr int SQUARE = 16;                  // width and height of a block, pixels
constexpr int PADDED = SQUARE + 2 * REACH;  // width and height with the neighbours, pixels
constexpr float C1 = constants::SSIM_C1;  // .01^2, keeps the ratio of means finite
constexpr float C2 = constants::SSIM_C2;  // .03^2, keeps the ratio of variances finite

// The window: a Gaussian of sigma 1.5 pixels whose 11 values sum to 1.
__device__ inline float window(int distance) {
    constexpr float WINDOW[REACH + 1] = {constants::WINDOW[0], constants::WINDOW[1], constants::WINDOW[2],
                                         constants::WINDOW[3], constants::WINDOW[4], constants::WINDOW[5]};
    return WINDOW[distance < 0 ? -distance : distance];
}

// Blurs OUT images at the block's pixels. load(offset, values) reads IN values at an offset into the images, and
// expand(values, w, sums) adds w times the OUT products of them; beyond the image all are 0.
template <int IN, int OUT, class Load, class Expand>
__device__ inline void blur(Index height, Index width, int x0, int y0, int channel, Load load, Expand expand,
                            float (&blurred)[OUT]) {
    __shared__ float pixels[IN][PADDED][PADDED];
    __shared__ float rows[OUT][PADDED][SQUARE];
    for (int i = threadIdx.x; i < PADDED * PADDED; i += THREADS) {
        int x = x0 + i % PADDED - REACH, y = y0 + i / PADDED - REACH;
        float values[IN] = {};
        if (x >= 0 && x < width && y >= 0 && y < height) load((y * width + x) * CHANNELS + channel, values);
        for (int k = 0; k < IN; k++) pixels[k][i / PADDED][i % PADDED] = values[k];
    }
    __syncthreads();
    for (int i = threadIdx.x; i < PADDED * SQUARE; i += THREADS) {
        int x = i % SQUARE, y = i / SQUARE;
        float sums[OUT] = {};
#pragma unroll
        for (int d = -REACH; d <= REACH; d++) {
            float values[IN];
            for (int k = 0; k < IN; k++) values[k] = pixels[k][y][x + REACH + d];
            expand(values, window(d), sums);
        }
        for (int k = 0; k < OUT; k++) rows[k][y][x] = sums[k];
    }
    __syncthreads();
    int x = threadIdx.x % SQUARE, y = threadIdx.x / SQUARE;
    for (int k = 0; k < OUT; k++) {
        blurred[k] = 0;
#pragma unroll
        for (int d = -REACH; d <= REACH; d++) blurred[k] += window(d) * rows[k][y + REACH + d][x];
    }
}

// sums (blocks, 2): each block's sum of |image - target| and of SSIM; derivatives (3, height, width, 3): those of SSIM
// by the blurred image, the blurred squared image and the blurred product.
KERNEL(5)
l1_ssim_forward(Index height, Index width, const float *image, const float *target, float *sums, float *derivatives) {
    int across = (int)((width + SQUARE - 1) / SQUARE);
    int x0 = blockIdx.x % across * SQUARE, y0 = blockIdx.x / across * SQUARE;
    int x = x0 + threadIdx.x % SQUARE, y = y0 + threadIdx.x / SQUARE;
    Index plane = height * width * CHANNELS;
    float l1_and_ssim[2] = {};
    for (int channel = 0; channel < CHANNELS; channel++) {
        float blurred[5];
        blur<2>(
            height, width, x0, y0, channel,
            [&](Index at, float *values) { values[0] = image[at], values[1] = target[at]; },
            [](const float *values, float w, float *sums) {
                float wa = w * values[0], wb = w * values[1];
                sums[0] += wa;
                sums[1] += wb;
                sums[2] += wa * values[0];
                sums[3] += wb * values[1];
                sums[4] += wa * values[1];
            },
            blurred);
        if (x >= width || y >= height) continue;
        float ma = blurred[0], mb = blurred[1], mab = ma * mb, mm = ma * ma + mb * mb;
        float a1 = 2 * mab + C1, a2 = 2 * (blurred[4] - mab) + C2;
        float b1 = mm + C1, b2 = blurred[2] + blurred[3] - mm + C2;
        float inverse = 1 / (b1 * b2), s = a1 * a2 * inverse;
        Index at = (y * width + x) * CHANNELS + channel;
        l1_and_ssim[0] += fabsf(image[at] - target[at]);
        l1_and_ssim[1] += s;
        derivatives[at] = 2 * inverse * (mb * (a2 - a1) + ma * s * (b1 - b2));
        derivatives[at + plane] = -s * b1 * inverse;
        derivatives[at + 2 * plane] = 2 * a1 * inverse;
    }
    __shared__ float of_warp[WARPS][2];
    int lane = threadIdx.x % WARP, value = lane_value<2>(lane);
    float total = lane_sum(l1_and_ssim, lane);
    if (value < 2) of_warp[threadIdx.x / WARP][value] = total;
    __syncthreads();
    if (threadIdx.x >= 2) return;
    total = 0;
    for (int w = 0; w < WARPS; w++) total += of_warp[w][threadIdx.x];
    sums[blockIdx.x * 2 + threadIdx.x] = total;
}

// gradient = scale (factors[0] sign(image - target) + factors[1] d(sum of SSIM)/d(image)).
KERNEL(5)
l1_ssim_backward(Index height, Index width, const float *image, const float *target, const float *derivatives,
                 const float *factors, float scale, float *gradient) {
    int across = (int)((width + SQUARE - 1) / SQUARE);
    int x0 = blockIdx.x % across * SQUARE, y0 = blockIdx.x / across * SQUARE;
    int x = x0 + threadIdx.x % SQUARE, y = y0 + threadIdx.x / SQUARE;
    Index plane = height * width * CHANNELS;
    float l1_factor = factors[0] * scale, ssim_factor = factors[1] * scale;
    for (int channel = 0; channel < CHANNELS; channel++) {
        float blurred[3];
        blur<3>(
            height, width, x0, y0, channel,
            [&](Index at, float *values) {
                for (int k = 0; k < 3; k++) values[k] = derivatives[at + k * plane];
            },
            [](const float *values, float w, float *sums) {
                for (int k = 0; k < 3; k++) sums[k] += w * values[k];
            },
            blurred);
        if (x >= width || y >= height) continue;
        Index at = (y * width + x) * CHANNELS + channel;
        float a = image[at], b = target[at], sign = (float)((a > b) - (a < b));
        gradient[at] = l1_factor * sign + ssim_factor * (blurred[0] + 2 * a * blurred[1] + b * blurred[2]);
    }
}
