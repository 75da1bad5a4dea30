// L1 and SSIM of two images (height, width, 3) and their gradient.
//
// SSIM (Wang et al. 2004): 11 x 11 Gaussian window of sigma 1.5, zero padding. The blur is separable, vertical first, so
// that a row needs nothing from its neighbours but the images. Each row is summed on its own: the result does not depend on
// how rows are spread over threads.
#include "constants.h"
#include "simd.h"

#include <math.h>

namespace {

constexpr int CHANNELS = 3;            // of an image
constexpr int REACH = 5;               // pixels from the centre of the window to its end
constexpr int PAD = REACH * CHANNELS;  // floats of a row from the centre to the end
constexpr int BLOCK = 1920;           // floats of a row at a time: bounds the buffers; PAD neighbours on each side are computed twice
constexpr float C1 = constants::SSIM_C1;  // .01^2, keeps the ratio of means finite
constexpr float C2 = constants::SSIM_C2;  // .03^2, keeps the ratio of variances finite
// The window from the centre outwards: a Gaussian of sigma 1.5 pixels whose 11 values sum to 1.
constexpr float WINDOW[REACH + 1] = {constants::WINDOW[0], constants::WINDOW[1], constants::WINDOW[2],
                                     constants::WINDOW[3], constants::WINDOW[4], constants::WINDOW[5]};

typedef float Padded[PAD + BLOCK + PAD + VW];  // a block of one row with its neighbours; zeros beyond the image

inline float window(int k) { return WINDOW[k < 0 ? -k : k]; }

void blur_along(const Padded in, float *__restrict out, int count) {
    for (int x = 0; x < count; x++) {
        const float *centre = in + PAD + x;
        float total = WINDOW[0] * centre[0];
        for (int k = 1; k <= REACH; k++) total += WINDOW[k] * (centre[-k * CHANNELS] + centre[k * CHANNELS]);
        out[x] = total;
    }
}

// A block [begin, end) of a row of floats, and the part [low, high) of it with neighbours that lies in the image.
struct Block {
    int begin, end, low, high;
    Block(int at, int row) {
        begin = at;
        end = smaller(at + BLOCK, row);
        low = larger(begin - PAD, 0);
        high = smaller(end + PAD, row);
    }
    int count() const { return end - begin; }
};

// Rows y - REACH to y + REACH of an image, as pointers to each row's first float, and their weights. Rows beyond the image are
// row y with weight 0, so that the loops over rows have a constant length and stay in registers.
struct Rows {
    const float *at[2 * REACH + 1];
    float weight[2 * REACH + 1];

    Rows(const float *image, int64_t y, int64_t height, int64_t row) {
        for (int k = 0; k <= 2 * REACH; k++) {
            int64_t other = y + k - REACH;
            bool inside = other >= 0 && other < height;
            at[k] = image + (inside ? other : y) * row;
            weight[k] = inside ? window(k - REACH) : 0.f;
        }
    }

    // VW floats of row k from column x on, zeros beyond column `end`.
    Vec load(int k, int x, int end) const {
        Vec v = {};
        if (x + VW <= end)
            memcpy(&v, at[k] + x, sizeof v);
        else
            memcpy(&v, at[k] + x, (end - x) * sizeof(float));
        return v;
    }
};

// Sum of a row's floats.
inline float sum_of(const float *values, int count) {
    Vec total = {};
    int i = 0;
    for (; i + VW <= count; i += VW) {
        Vec v;
        memcpy(&v, values + i, sizeof v);
        total += v;
    }
    float rest = 0;
    for (; i < count; i++) rest += values[i];
    return sum(total) + rest;
}

}  // namespace

// Rows [begin, end): sums (height, 2) gets each row's sum of |image - target| and of SSIM; derivatives (3, height, width, 3)
// those of SSIM by the blurred image, the blurred squared image and the blurred product.
API void l1_ssim_forward(int64_t begin, int64_t end, int64_t height, int64_t width, const float *image, const float *target,
                         double *sums, float *derivatives) {
    int row = (int)width * CHANNELS;
    int64_t plane = height * row;
    for (int64_t y = begin; y < end; y++) {
        const Rows images(image, y, height, row), targets(target, y, height, row);
        sums[2 * y] = sums[2 * y + 1] = 0;
        for (int at = 0; at < row; at += BLOCK) {
            Block block(at, row);
            Padded vertical[4] = {};  // of both images, of the sum of their squares and of their product
            for (int x = block.low; x < block.high; x += VW) {
                Vec blur[4] = {};
                for (int k = 0; k <= 2 * REACH; k++) {
                    Vec a = images.load(k, x, block.high), b = targets.load(k, x, block.high);
                    float w = images.weight[k];
                    blur[0] += w * a;
                    blur[1] += w * b;
                    blur[2] += w * (a * a + b * b);
                    blur[3] += w * (a * b);
                }
                for (int i = 0; i < 4; i++) memcpy(vertical[i] + x - block.begin + PAD, &blur[i], sizeof blur[i]);
            }
            float blurred[4][BLOCK], ssim[BLOCK], difference[BLOCK];
            for (int i = 0; i < 4; i++) blur_along(vertical[i], blurred[i], block.count());

            int64_t offset = y * row + block.begin;
            const float *__restrict a = image + offset, *__restrict b = target + offset;
            float *__restrict by_mean = derivatives + offset, *__restrict by_square = by_mean + plane;
            float *__restrict by_product = by_square + plane;
            for (int x = 0; x < block.count(); x++) {
                float ma = blurred[0][x], mb = blurred[1][x], mab = ma * mb, mm = ma * ma + mb * mb;
                float a1 = 2 * mab + C1, a2 = 2 * (blurred[3][x] - mab) + C2;
                float b1 = mm + C1, b2 = blurred[2][x] - mm + C2;
                float inverse = 1 / (b1 * b2), s = a1 * a2 * inverse;
                ssim[x] = s;
                difference[x] = fabsf(a[x] - b[x]);
                by_mean[x] = 2 * inverse * (mb * (a2 - a1) + ma * s * (b1 - b2));
                by_square[x] = -s * b1 * inverse;
                by_product[x] = 2 * a1 * inverse;
            }
            sums[2 * y] += sum_of(difference, block.count());
            sums[2 * y + 1] += sum_of(ssim, block.count());
        }
    }
}

// Rows [begin, end) of gradient = l1_weight sign(image - target) + ssim_weight d(sum of SSIM)/d(image).
API void l1_ssim_backward(int64_t begin, int64_t end, int64_t height, int64_t width, const float *image, const float *target,
                          const float *derivatives, float l1_weight, float ssim_weight, float *gradient) {
    int row = (int)width * CHANNELS;
    int64_t plane = height * row;
    for (int64_t y = begin; y < end; y++) {
        const Rows by_mean(derivatives, y, height, row), by_square(derivatives + plane, y, height, row);
        const Rows by_product(derivatives + 2 * plane, y, height, row);
        for (int at = 0; at < row; at += BLOCK) {
            Block block(at, row);
            Padded vertical[3] = {};
            for (int x = block.low; x < block.high; x += VW) {
                Vec blur[3] = {};
                for (int k = 0; k <= 2 * REACH; k++) {
                    float w = by_mean.weight[k];
                    blur[0] += w * by_mean.load(k, x, block.high);
                    blur[1] += w * by_square.load(k, x, block.high);
                    blur[2] += w * by_product.load(k, x, block.high);
                }
                for (int i = 0; i < 3; i++) memcpy(vertical[i] + x - block.begin + PAD, &blur[i], sizeof blur[i]);
            }
            float blurred[3][BLOCK];
            for (int i = 0; i < 3; i++) blur_along(vertical[i], blurred[i], block.count());

            int64_t offset = y * row + block.begin;
            const float *__restrict a = image + offset, *__restrict b = target + offset;
            float *__restrict g = gradient + offset;
            for (int x = 0; x < block.count(); x++) {
                float sign = (float)((a[x] > b[x]) - (a[x] < b[x]));
                g[x] = l1_weight * sign + ssim_weight * (blurred[0][x] + 2 * a[x] * blurred[1][x] + b[x] * blurred[2][x]);
            }
        }
    }
}
