// From a blended image to the photo that a camera would take of it, its differences from a training image, and back;
// photo.cpp says what is computed. One thread per pixel.
#include "common.cuh"
#include "light.cuh"

constexpr int TERMS = 3;   // of the vignetting's polynomial
constexpr int DEGREE = 4;  // of the beam's polynomial
constexpr int BEAM = 14;   // its coefficients

// What a camera and its lamp do to the linear light of a pixel; photo.cpp has the order of the numbers.
struct PixelGain {
    float squared, polynomial, vignetting, x, y, log_beam = 0, factor;

    __device__ PixelGain(const float *numbers, Index height, Index width, Index pixel) {
        float dx = pixel % width + .5f - numbers[6] * width, dy = pixel / width + .5f - numbers[7] * height, change = 0;
        squared = (dx * dx + dy * dy) * (4 / (float)(width * width + height * height));
        for (int j = TERMS - 1; j >= 0; j--) change = (change + numbers[3 + j]) * squared;
        polynomial = 1 + change;
        factor = vignetting = fmaxf(fminf(polynomial, numbers[9]), numbers[8]);
        float scale = 2 / sqrtf((float)(width * width + height * height)), most_beam = numbers[10 + BEAM];
        x = (pixel % width + .5f - .5f * width) * scale, y = (pixel / width + .5f - .5f * height) * scale;
        if (!most_beam) return;
        int t = 10;
        for_terms([&](float term) { log_beam += numbers[t++] * term; });
        factor *= expf(fmaxf(fminf(log_beam, most_beam), -most_beam));
    }

    // Calls visit(x^i y^j) in the order of the beam's coefficients.
    template <class Visit>
    __device__ void for_terms(Visit visit) const {
        float of_x[DEGREE + 1] = {1}, of_y[DEGREE + 1] = {1};
        for (int i = 1; i <= DEGREE; i++) of_x[i] = of_x[i - 1] * x, of_y[i] = of_y[i - 1] * y;
        for (int total = 1; total <= DEGREE; total++)
            for (int j = 0; j <= total; j++) visit(of_x[total - j] * of_y[j]);
    }
};

// A channel of a pixel before any gain.
__device__ inline float composed(const float *blended, const float *transmittance, const float *behind, Index pixel, int c) {
    return blended[3 * pixel + c] + (behind ? transmittance[pixel] * behind[3 * pixel + c] : 0);
}

// sums (blocks, 2): of |photo - target| and its square.
KERNEL(4)
photo_forward(Index pixels, Index height, Index width, const float *blended, const float *transmittance,
              const float *behind, const float *gain_numbers, const unsigned char *bytes, const unsigned char *valid,
              float *photo, float *target, float *sums) {
    Index i = thread_index();
    float errors[2] = {};
    if (i < pixels) {
        for (int c = 0; c < 3; c++) {
            float wanted = bytes[3 * i + c] / 255.f, shown = wanted, slope;
            if (valid[i]) {
                shown = composed(blended, transmittance, behind, i, c);
                if (gain_numbers) {
                    PixelGain gain(gain_numbers, height, width, i);
                    shown = to_display(to_light(shown, slope) * (gain.factor * gain_numbers[c]), slope);
                }
            }
            float error = shown - wanted;
            photo[3 * i + c] = shown;
            target[3 * i + c] = wanted;
            errors[0] += fabsf(error);
            errors[1] += error * error;
        }
    }
    block_sums(errors, sums);
}

// How sure it is that a pixel of a training image shows a surface, 0..1, by its largest difference from open water.
__device__ inline float surface_seen(const float *wanted, const float *water, float least, float most) {
    float apart = 0;
    for (int c = 0; c < 3; c++) apart = fmaxf(apart, fabsf(wanted[c] - water[c]));
    return fmaxf(fminf((apart - least) / (most - least), 1.f), 0.f);
}

// sums (blocks, 21): gradients by the logs of the gains (3), by the coefficients of the vignetting (3) and of the beam
// (14), and what Gaussians leave open of the surfaces seen.
KERNEL(2)
photo_backward(Index pixels, Index height, Index width, const float *blended, const float *transmittance,
               const float *behind, const float *gain_numbers, const unsigned char *valid, const float *photo,
               const float *target, const float *by_photo, float absolute, float square, float open, float least,
               float most, float closed, float *by_blended, float *by_alpha, float *by_behind, float *sums) {
    Index i = thread_index();
    float total[4 + TERMS + BEAM] = {};
    if (i < pixels) {
        float by[3] = {}, through_alpha = 0;
        if (valid[i])
            for (int c = 0; c < 3; c++) {
                float error = photo[3 * i + c] - target[3 * i + c];
                by[c] = (by_photo ? by_photo[3 * i + c] : 0) + square * error + absolute * (float)((error > 0) - (error < 0));
            }
        if (gain_numbers) {
            PixelGain gain(gain_numbers, height, width, i);
            float by_log_factor = 0;
            for (int c = 0; c < 3; c++) {
                float in_slope, out_slope, applied = gain.factor * gain_numbers[c];
                float light = to_light(composed(blended, transmittance, behind, i, c), in_slope) * applied;
                to_display(light, out_slope);
                float by_light = by[c] * out_slope;
                by[c] = by_light * applied * in_slope;
                total[c] = by_light * light;
                by_log_factor += by_light * light;
            }
            bool free = gain.polynomial >= gain_numbers[8] && gain.polynomial <= gain_numbers[9];
            float by_term = free ? by_log_factor / gain.vignetting : 0;
            for (int j = 0; j < TERMS; j++) total[3 + j] = by_term *= gain.squared;
            int t = 3 + TERMS;
            float most_beam = gain_numbers[10 + BEAM];
            if (most_beam && fabsf(gain.log_beam) <= most_beam) gain.for_terms([&](float term) { total[t++] = by_log_factor * term; });
        }
        if (behind) {
            const float *water = behind + 3 * i;
            for (int c = 0; c < 3; c++) {
                through_alpha -= by[c] * water[c];
                by_behind[3 * i + c] = by[c] * transmittance[i];
            }
            if (open && valid[i] && transmittance[i] > closed) {
                float surface = surface_seen(target + 3 * i, water, least, most);
                through_alpha -= open * surface;
                total[3 + TERMS + BEAM] = surface * (transmittance[i] - closed);
            }
        }
        by_alpha[i] = through_alpha;
        for (int c = 0; c < 3; c++) by_blended[3 * i + c] = by[c];
    }
    block_sums(total, sums);
}
