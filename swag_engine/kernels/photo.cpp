// From a blended image (height, width, 3) to the photo that a camera would take of it, its differences from a training image,
// and back.
#include "light.h"
#include "simd.h"

namespace {

constexpr int TERMS = 3;   // of the vignetting's polynomial
constexpr int DEGREE = 4;  // of the beam's polynomial
constexpr int BEAM = 14;   // its coefficients: of x, y, x^2, xy, y^2, x^3 and so on
constexpr int SUMS = 4 + TERMS + BEAM;  // gradients by the logs of the gains (3), by both polynomials' coefficients; open surface

// What a camera and its lamp do to linear light (effects/exposure.py, vignetting.py, beam.py): a gain for each channel, times
// 1 + k1 r^2 + k2 r^4 + k3 r^6 within bounds, r from the principal point, times the exponential of a polynomial in x and y
// within bounds, from the middle of the image; r, x and y over half of its diagonal.
struct Gain {
    float gain[3] = {}, k[TERMS] = {}, beam[BEAM] = {};
    float centre_x = 0, centre_y = 0, least = 0, most = 0, most_beam = 0, middle_x = 0, middle_y = 0, scale = 0;

    // numbers: gain (3), k (3), principal point as fractions of width and height, least and most of the vignetting, beam
    // (14), most of the beam's absolute value, 0 for no beam; null for no gain.
    Gain(const float *numbers, int64_t height, int64_t width) {
        if (!numbers) return;
        memcpy(gain, numbers, sizeof gain);
        memcpy(k, numbers + 3, sizeof k);
        centre_x = numbers[6] * width, centre_y = numbers[7] * height;
        least = numbers[8], most = numbers[9];
        memcpy(beam, numbers + 10, sizeof beam);
        most_beam = numbers[10 + BEAM];
        middle_x = .5f * width, middle_y = .5f * height;
        scale = 4.f / (float)(width * width + height * height);
    }

    // The beam's coefficients of x^0 .. x^4 in a row of pixels, and powers of its y.
    struct Row {
        float of_x[DEGREE + 1] = {}, y[DEGREE + 1] = {1.f};
    };

    Row row(int64_t y) const {
        Row row;
        float at = ((float)y + .5f - middle_y) * __builtin_sqrtf(scale);
        for (int j = 1; j <= DEGREE; j++) row.y[j] = row.y[j - 1] * at;
        for (int t = 0, total = 1; total <= DEGREE; total++)
            for (int j = 0; j <= total; j++) row.of_x[total - j] += beam[t++] * row.y[j];
        return row;
    }

    // Distances of the middles of the pixels from x on to a column.
    static Vec right_of(float column, int64_t x) {
        Vec dx;
        for (int l = 0; l < VW; l++) dx[l] = (float)l;
        return dx + ((float)x + .5f - column);
    }

    Vec beam_x(int64_t x) const { return right_of(middle_x, x) * __builtin_sqrtf(scale); }

    // The log of the beam's gain before its bounds.
    Vec log_beam(const Row &row, Vec x) const {
        Vec value = splat(row.of_x[DEGREE]);
        for (int i = DEGREE - 1; i >= 0; i--) value = value * x + row.of_x[i];
        return value;
    }

    Vec beam_gain(Vec log_beam) const {
        return exponential(larger(smaller(log_beam, splat(most_beam)), splat(-most_beam)));
    }

    Vec squared_radius(int64_t x, int64_t y) const {
        Vec dx = right_of(centre_x, x);
        float dy = (float)y + .5f - centre_y;
        return (dx * dx + dy * dy) * scale;
    }

    Vec polynomial(Vec squared) const {
        Vec change = Vec{};
        for (int j = TERMS - 1; j >= 0; j--) change = (change + k[j]) * squared;
        return 1.f + change;
    }

    Vec bounded(Vec p) const { return larger(smaller(p, splat(most)), splat(least)); }
};

// VW floats from place i on, zeros beyond `end`.
inline Vec load(const float *from, int64_t i, int64_t end) {
    Vec v = {};
    if (i + VW <= end)
        memcpy(&v, from + i, sizeof v);
    else
        memcpy(&v, from + i, (end - i) * sizeof(float));
    return v;
}

// Pixels (x .. x + count, y) as the rasteriser and the water behind make them, before any gain.
inline void compose(const float *blended, const float *transmittance, const float *behind, int64_t pixel, int count,
                    Vec &T, Vec *color, Vec *water) {
    load_rows(blended + 3 * pixel, count, color);
    if (!behind) return;
    T = load(transmittance, pixel, pixel + count);
    load_rows(behind + 3 * pixel, count, water);
    for (int c = 0; c < 3; c++) color[c] += T * water[c];
}

// Calls visit(x) for each pixel of a row that is not valid.
template <class Visit>
inline void for_invalid(const uint8_t *valid, int64_t width, Visit visit) {
    if (!memchr(valid, 0, width)) return;
    for (int64_t x = 0; x < width; x++)
        if (!valid[x]) visit(x);
}

// How sure it is that pixels of a training image show a surface, 0..1: 0 where they differ from the open water behind by
// less than `least` in all channels, 1 from `most` on.
inline Vec surface_seen(const Vec *wanted, const Vec *water, float least, float most) {
    Vec apart = {};
    for (int c = 0; c < 3; c++) {
        Vec difference = wanted[c] - water[c];
        apart = larger(apart, larger(difference, -difference));
    }
    return larger(smaller((apart - least) / (most - least), splat(1.f)), splat(0.f));
}

}  // namespace

// Rows [begin, end): photo (H, W, 3) = the blended image over the open water `behind` (H, W, 3) with the gain applied, and
// equal to the target where a pixel is not valid; target (H, W, 3) from bytes; sums (2,) of |photo - target| and of its square. behind
// and gain_numbers may be null.
API void photo_forward(int64_t begin, int64_t end, int64_t height, int64_t width, const float *blended,
                       const float *transmittance, const float *behind, const float *gain_numbers, const uint8_t *pixels,
                       const uint8_t *valid, float *photo, float *target, double *sums) {
    const Gain gain(gain_numbers, height, width);
    sums[0] = sums[1] = 0;
    for (int64_t y = begin; y < end; y++) {
        int64_t first = 3 * y * width, floats = 3 * width;
        const Gain::Row beam = gain.row(y);
        float *__restrict row = photo + first, *__restrict wanted = target + first;
        for (int64_t i = 0; i < floats; i++) wanted[i] = pixels[first + i] / 255.f;
        if (!behind && !gain_numbers) memcpy(row, blended + first, floats * sizeof(float));
        for (int64_t x = 0; x < width && (behind || gain_numbers); x += VW) {
            int count = (int)smaller<int64_t>(VW, width - x);
            Vec T, color[3], water[3], slope;
            compose(blended, transmittance, behind, y * width + x, count, T, color, water);
            if (gain_numbers) {
                Vec factor = gain.bounded(gain.polynomial(gain.squared_radius(x, y)));
                if (gain.most_beam) factor *= gain.beam_gain(gain.log_beam(beam, gain.beam_x(x)));
                for (int c = 0; c < 3; c++)
                    color[c] = to_display(to_light(color[c], slope) * (factor * gain.gain[c]), slope);
            }
            store_rows(color, count, row + 3 * x);
        }
        for_invalid(valid + y * width, width, [&](int64_t x) { memcpy(row + 3 * x, wanted + 3 * x, 3 * sizeof(float)); });
        Vec absolute = {}, square = {};
        for (int64_t i = 0; i < floats; i += VW) {
            Vec error = load(row, i, floats) - load(wanted, i, floats);
            absolute += larger(error, -error);
            square += error * error;
        }
        sums[0] += sum(absolute);
        sums[1] += sum(square);
    }
}

// Rows [begin, end) of the gradients by the blended image, by alpha and by what is behind, and sums (21,) of
// those by the logs of the gains and both polynomials' coefficients, and of what Gaussians leave open of the surfaces seen
// (losses.uncovered_surface): what 1 - alpha exceeds `closed` by, times how sure it is that the target shows a surface. The
// gradient by the photo is `by_photo` (H, W, 3), if it is not null, plus `absolute` sign(error) plus `square` error; that
// by what is left open of one pixel's surface is `open`.
API void photo_backward(int64_t begin, int64_t end, int64_t height, int64_t width, const float *blended,
                        const float *transmittance, const float *behind, const float *gain_numbers, const uint8_t *valid,
                        const float *photo, const float *target, const float *by_photo, float absolute, float square,
                        float open, float least, float most, float closed, float *by_blended, float *by_alpha,
                        float *by_behind, double *sums) {
    const Gain gain(gain_numbers, height, width);
    for (int k = 0; k < SUMS; k++) sums[k] = 0;
    for (int64_t y = begin; y < end; y++) {
        int64_t first = 3 * y * width, floats = 3 * width;
        const float *__restrict seen = photo + first, *__restrict wanted = target + first;
        float *__restrict row = by_blended + first;
        if (by_photo)
            memcpy(row, by_photo + first, floats * sizeof(float));
        else
            memset(row, 0, floats * sizeof(float));
        for (int64_t i = 0; i < floats; i++) {
            float error = seen[i] - wanted[i];
            row[i] += square * error + absolute * (float)((error > 0) - (error < 0));
        }
        for_invalid(valid + y * width, width, [&](int64_t x) { memset(row + 3 * x, 0, 3 * sizeof(float)); });
        memset(by_alpha + y * width, 0, width * sizeof(float));

        Vec total[4 + TERMS] = {}, by_powers[DEGREE + 1] = {};
        const Gain::Row beam = gain.row(y);
        for (int64_t x = 0; x < width && (behind || gain_numbers); x += VW) {
            int count = (int)smaller<int64_t>(VW, width - x);
            int64_t pixel = y * width + x;
            Vec T, color[3], water[3], by[3];
            load_rows(row + 3 * x, count, by);
            compose(blended, transmittance, behind, pixel, count, T, color, water);
            if (gain_numbers) {
                Vec squared = gain.squared_radius(x, y), polynomial = gain.polynomial(squared);
                Vec vignetting = gain.bounded(polynomial), factor = vignetting, by_log_factor = {}, place = {}, log_beam = {};
                if (gain.most_beam) {
                    place = gain.beam_x(x), log_beam = gain.log_beam(beam, place);
                    factor *= gain.beam_gain(log_beam);
                }
                for (int c = 0; c < 3; c++) {
                    Vec in_slope, out_slope, applied = factor * gain.gain[c], light = to_light(color[c], in_slope) * applied;
                    to_display(light, out_slope);
                    Vec by_light = by[c] * out_slope, by_log = by_light * light;
                    by[c] = by_light * applied * in_slope;
                    total[c] += by_log;
                    by_log_factor += by_log;
                }
                Vec by_term = masked((polynomial >= gain.least) & (polynomial <= gain.most), by_log_factor / vignetting);
                for (int j = 0; j < TERMS; j++) total[3 + j] += by_term *= squared;
                if (gain.most_beam) {
                    Vec by_power = masked((log_beam >= -gain.most_beam) & (log_beam <= gain.most_beam), by_log_factor);
                    for (int i = 0; i <= DEGREE; i++, by_power *= place) by_powers[i] += by_power;
                }
                store_rows(by, count, row + 3 * x);
            }
            if (behind) {
                Vec through_alpha = {};
                for (int c = 0; c < 3; c++) {
                    through_alpha -= by[c] * water[c];
                    by[c] *= T;
                }
                if (open) {
                    load_rows(wanted + 3 * x, count, color);
                    Vec surface = masked(T > closed, surface_seen(color, water, least, most));
                    for (int l = 0; l < VW; l++)
                        if (l >= count || !valid[pixel + l]) surface[l] = 0.f;
                    through_alpha -= open * surface;
                    total[3 + TERMS] += surface * (T - closed);
                }
                if (count == VW)
                    memcpy(by_alpha + pixel, &through_alpha, sizeof through_alpha);
                else
                    memcpy(by_alpha + pixel, &through_alpha, count * sizeof(float));
                store_rows(by, count, by_behind + 3 * pixel);
            }
        }
        for (int k = 0; k < 3 + TERMS; k++) sums[k] += sum(total[k]);
        for (int t = 0, total_power = 1; total_power <= DEGREE; total_power++)
            for (int j = 0; j <= total_power; j++) sums[3 + TERMS + t++] += sum(by_powers[total_power - j]) * beam.y[j];
        sums[SUMS - 1] += sum(total[3 + TERMS]);
    }
}
