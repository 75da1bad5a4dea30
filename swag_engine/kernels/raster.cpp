// Tile rasteriser for projected Gaussians; raster.h says what each function takes and gives.
//
// A Gaussian weighs a pixel by alpha = min(.99, o exp(-s)), with (A, B, C) its conic and (dx, dy) = centre - pixel:
//     s = (A dx^2 + 2 B dx dy + C dy^2) / 2 = h dx^2 + c u^2,   u = dy + k dx,   k = B/C,  c = C/2,  h = (A - B^2/C)/2.
// The sum of two squares is never negative and loses no digits for needles. alpha < 1/255, that is s > ln(255 o), is
// skipped; so each Gaussian is an ellipse of known extent. Pixels are blended front to back,
//     out = sum_i T_i alpha_i channel_i + T_end background,   T_(i+1) = T_i (1 - alpha_i),
// and a pixel ends before the Gaussian that would take T to 1e-4 or less.
//
// A tile's pixels lie in vertical strips, STRIP columns wide; a vector holds ROWS rows of a strip. A Gaussian visits only
// the rows of a strip that its ellipse meets: first all its alphas there are computed, then its pixels are blended.
#include "raster.h"

#include "constants.h"

#include <math.h>

struct alignas(64) Splat {
    float x, y, k, c, h, opacity;
    float half_width, half_height;  // of the ellipse s = limit, the largest s that is not skipped
    float top;                      // x offset of the point at +half_height
    float h_by_c, limit_by_c;       // h / c, limit / c
    float log_opacity;              // log2(opacity)
    float ratio, block_ratio;       // by which the ratio of neighbouring vectors' alphas changes from vector to vector, by block
    uint16_t left, right, top_row, bottom_row;  // tiles that its bounding box meets
};

namespace {

constexpr int TILE_WIDTH = 32;              // pixels; with these sizes the state of a tile, 40 kB, stays in the nearest caches
constexpr int TILE_HEIGHT = 64;             // pixels; 32 cost 6 % more: Gaussians meet more tiles
constexpr int STRIP = VW < 8 ? VW : 8;      // columns of a strip
constexpr int ROWS = VW / STRIP;            // rows of a strip in one vector
constexpr int STRIPS = TILE_WIDTH / STRIP;  // strips of a tile
constexpr int STRIP_VECTORS = TILE_HEIGHT / ROWS;  // vectors of a strip
constexpr int TILE_VECTORS = STRIPS * STRIP_VECTORS;
constexpr int BLOCK = 4;                    // vectors of alphas for which one exponential is computed
constexpr int AHEAD = 6;                    // entries of a tile's list between fetching a Gaussian from memory and its use
constexpr int ROWS_AHEAD = 8;               // rows of an image between fetching pixels from memory and their use
constexpr int GROUP = 8;                    // channels blended in one pass: their sums stay in registers
constexpr int MOMENTS = 6;                  // sums of v times 1, dx, u, dx^2, dx u, u^2
constexpr float MAX_ALPHA = constants::MAX_ALPHA;  // the backward pass divides by 1 - alpha
constexpr float MIN_ALPHA = constants::MIN_ALPHA;  // less is skipped
constexpr uint32_t MIN_TRANSMITTANCE = __builtin_bit_cast(uint32_t, (float)constants::MIN_TRANSMITTANCE);  // at which a pixel ends, as bits
constexpr float MIN_RATIO = 6.2e-5f;        // 2^-14: below it alpha may rise from under 2^-120 to 1/255 within a block
constexpr float MAX_EXPONENT = 16.f;        // of the first ratio: its rounding is multiplied by this
constexpr double LOG2E = 1.4426950408889634;  // log2(e): from e^x to 2^x
constexpr double LOG255 = constants::LOG255;  // ln(255): alpha falls below 1/255 where s > ln(255 opacity)
constexpr float MARGIN = .01f;          // pixels; for rounding, since each pixel is tested again
constexpr uint32_t NOT_DRAWN = 0xffffffffu; // depth key of Gaussians that cannot be drawn

typedef float StripF __attribute__((vector_size(STRIPS * 4)));
typedef int32_t StripI __attribute__((vector_size(STRIPS * 4)));

struct Tile {
    int x, y, width, height, strips;  // corner and size in pixels, clipped to the image
};

Tile tile_at(int index, int width, int height) {
    int across = (width + TILE_WIDTH - 1) / TILE_WIDTH;
    Tile t;
    t.x = index % across * TILE_WIDTH;
    t.y = index / across * TILE_HEIGHT;
    t.width = smaller(TILE_WIDTH, width - t.x);
    t.height = smaller(TILE_HEIGHT, height - t.y);
    t.strips = (t.width + STRIP - 1) / STRIP;
    return t;
}

// The y offsets [low, high] that the ellipse reaches over the x offsets [left, right]; low > high where it does not.
template <class F>
inline void rows_over_columns(const Splat &g, F left, F right, F &low, F &high) {
    F zero = left - left;
    left = larger(left, zero - g.half_width);
    right = smaller(right, zero + g.half_width);
    F reach_left = square_root(larger(g.limit_by_c - g.h_by_c * left * left, zero));
    F reach_right = square_root(larger(g.limit_by_c - g.h_by_c * right * right, zero));
    F middle_left = left * -g.k, middle_right = right * -g.k;
    low = smaller(middle_left - reach_left, middle_right - reach_right);
    high = larger(middle_left + reach_left, middle_right + reach_right);
    F top = zero + g.top;
    high = ((left <= top) & (top <= right)) ? zero + g.half_height : high;
    low = ((left <= -top) & (-top <= right)) ? zero - g.half_height : low;
    low = left <= right ? low - MARGIN : zero + 1.f;
    high = left <= right ? high + MARGIN : zero - 1.f;
}

// Calls visit(tile index) for each tile whose pixel centres the ellipse may meet. Where its bounding box lies in one row or
// one column of tiles, it meets all of them.
template <class Visit>
inline void for_tiles(const Splat &g, int width, Visit visit) {
    int across = (width + TILE_WIDTH - 1) / TILE_WIDTH;
    bool whole_box = g.left == g.right || g.top_row == g.bottom_row;
    for (int tx = g.left; tx <= g.right; tx++) {
        int first = g.top_row, last = g.bottom_row;
        if (!whole_box) {
            float x = tx * TILE_WIDTH + .5f - g.x, low, high;
            rows_over_columns(g, x, x + (smaller(TILE_WIDTH, width - tx * TILE_WIDTH) - 1), low, high);
            if (low > high) continue;
            first = larger(first, (int)larger(0.f, g.y + low - .5f) / TILE_HEIGHT);
            last = smaller(last, (int)larger(0.f, g.y + high - .5f) / TILE_HEIGHT);
        }
        for (int ty = first; ty <= last; ty++) visit(ty * across + tx);
    }
}

// First vector of each strip that a Gaussian visits, and their number, 0 or less for none.
inline void strip_spans(const Splat &g, const Tile &tile, StripI &first, StripI &count) {
    StripF left;
    for (int s = 0; s < STRIPS; s++) left[s] = s * STRIP;
    left += tile.x + .5f - g.x;
    StripF low, high, zero = {};
    rows_over_columns(g, left, left + (STRIP - 1.f), low, high);
    float to_row = g.y - .5f - tile.y;
    low = smaller(larger(low + to_row, zero), zero + (float)TILE_HEIGHT);
    high = smaller(larger(high + to_row, zero - 1.f), zero + (tile.height - 1.f));
    StripI begin = __builtin_convertvector(low, StripI);
    begin -= (__builtin_convertvector(begin, StripF) < low);               // rounds up: true is -1
    StripI end = __builtin_convertvector(high + 1.f, StripI);  // of rows [begin, end)
    first = begin / ROWS;
    count = end > begin ? (end + (ROWS - 1)) / ROWS - first : StripI{};
}

// The pixels of a vector that lie in the image.
struct Place {
    int64_t pixel, image_width;  // the first lane's pixel
    int columns, rows;

    // Calls visit(lane, pixel) for each; with constant loops where all lanes have a pixel.
    template <class Visit>
    inline __attribute__((always_inline)) void for_lanes(Visit visit) const {
        if (columns == STRIP && rows == ROWS) {
            for (int y = 0; y < ROWS; y++)
                for (int x = 0; x < STRIP; x++) visit(y * STRIP + x, pixel + y * image_width + x);
        } else {
            for (int y = 0; y < rows; y++)
                for (int x = 0; x < columns; x++) visit(y * STRIP + x, pixel + y * image_width + x);
        }
    }

    // One channel of an image, 0 outside.
    Vec read(const float *image, int64_t stride) const {
        fetch<0>(image, stride);
        Vec values = {};
        for_lanes([&](int lane, int64_t at) { values[lane] = image[at * stride]; });
        return values;
    }
    Mask read(const int32_t *image) const {
        fetch<0>(image, 1);
        Mask values = {};
        for_lanes([&](int lane, int64_t at) { values[lane] = image[at]; });
        return values;
    }
    void write(Vec values, float *image, int64_t stride) const {
        fetch<1>(image, stride);
        for_lanes([&](int lane, int64_t at) { image[at * stride] = values[lane]; });
    }
    void write(Mask values, int32_t *image) const {
        fetch<1>(image, 1);
        for_lanes([&](int lane, int64_t at) { image[at] = values[lane]; });
    }
    Mask inside() const {
        Mask values = {};
        for_lanes([&](int lane, int64_t) { values[lane] = -1; });
        return values;
    }

   private:
    // A tile's rows are too short for the processor to fetch the next ones by itself.
    template <int WRITES, class T>
    void fetch(const T *image, int64_t stride) const {
        int64_t first = (pixel + ROWS_AHEAD * image_width) * stride;
        __builtin_prefetch(image + first, WRITES);
        __builtin_prefetch(image + first + (STRIP - 1) * stride, WRITES);
    }
};

// Calls visit(vector, its pixels) for each vector of a tile with pixels in the image.
template <class Visit>
inline void for_vectors(const Tile &tile, int image_width, Visit visit) {
    for (int y = 0; y < tile.height; y += ROWS)
        for (int s = 0; s < tile.strips; s++) {
            int64_t pixel = (int64_t)(tile.y + y) * image_width + tile.x + s * STRIP;
            Place place = {pixel, image_width, smaller(STRIP, tile.width - s * STRIP), smaller(ROWS, tile.height - y)};
            visit(s * STRIP_VECTORS + y / ROWS, place);
        }
}

struct Lanes {
    float column[VW], row[VW];
    constexpr Lanes() : column(), row() {
        for (int i = 0; i < VW; i++) column[i] = i % STRIP + .5f, row[i] = i / STRIP + .5f;
    }
};
constexpr Lanes LANES;

inline Vec load(const float *p) {
    Vec v;
    memcpy(&v, p, sizeof v);
    return v;
}

// 0 < x <= limit for x that is not negative, given the limit's bits: they order as the floats, so one comparison does.
inline Mask positive_up_to(Vec x, uint32_t limit) { return (Bits)x - 1 < limit; }

// A Gaussian over one strip.
struct OverStrip {
    Vec dx, u;                         // u: at the first vector visited; it falls by ROWS from vector to vector
    Vec alpha[STRIP_VECTORS + BLOCK];  // by vector visited, 0 where it is skipped; whole blocks are written

    inline __attribute__((always_inline)) OverStrip(const Splat &g, const Tile &tile, int strip, int first, int count) {
        dx = splat(g.x - tile.x - strip * STRIP) - load(LANES.column);
        u = dx * g.k + (g.y - tile.y - first * ROWS) - load(LANES.row);
        Vec c = splat(-g.c * (float)LOG2E), at_middle = dx * dx * (-g.h * (float)LOG2E) + g.log_opacity;
        Vec ratio_exponent = c * ((float)(ROWS * ROWS) - (2.f * ROWS) * u);  // of the second vector by the first
        if (__builtin_expect(g.ratio < MIN_RATIO || any(ratio_exponent > MAX_EXPONENT), 0))
            by_exponentials(c, at_middle, count);
        else
            by_ratios(c, at_middle, exp2(larger(ratio_exponent, splat(-126.f))), g.ratio, g.block_ratio, count);
        if (__builtin_expect(g.opacity >= MAX_ALPHA, 0))
            for (int v = 0; v < count; v++) alpha[v] = smaller(alpha[v], splat(MAX_ALPHA));
    }

   private:
    void by_exponentials(Vec c, Vec at_middle, int count) {
        Vec u = this->u;
        for (int v = 0; v < count; v++, u -= (float)ROWS)
            alpha[v] = shown(exp2(larger(c * u * u + at_middle, splat(-126.f))));
    }

    // log2(alpha) is quadratic in u: the ratio of neighbouring vectors' alphas changes by a constant factor. An exponential
    // at the beginning of each block keeps rounding from adding up.
    void by_ratios(Vec c, Vec at_middle, Vec block_first, float ratio, float block_ratio, int count) {
        Vec u = this->u;
        for (int v = 0; v < count; v += BLOCK, u -= (float)(ROWS * BLOCK), block_first *= block_ratio) {
            Vec exponent = c * u * u + at_middle, a = masked(exponent > -120.f, exp2(exponent)), by = block_first;
            for (int i = 0; i < BLOCK; i++, a *= by, by *= ratio) alpha[v + i] = shown(a);
        }
    }

    static Vec shown(Vec alpha) { return masked(alpha >= MIN_ALPHA, alpha); }
};

// Calls visit(strip, first vector, number of vectors) for the strips that a Gaussian meets, of those whose bit is set.
template <class Visit>
inline void for_strips(const Splat &g, const Tile &tile, uint32_t strips, Visit visit) {
    StripI first, count;
    strip_spans(g, tile, first, count);
    for (uint32_t left = strips & bits(count > 0); left; left &= left - 1) {
        int s = __builtin_ctz(left);
        visit(s, first[s], count[s]);
    }
}

// Fetches from memory what is needed a few entries later.
inline void prefetch(const Splat *splats, const float *channels, int64_t stride, int32_t id) {
    __builtin_prefetch(splats + id);
    __builtin_prefetch(channels + id * stride);
}

template <int C>
void forward_tile(const Tile &tile, int image_width, const Splat *splats, const float *channels, int64_t stride,
                  const int32_t *ids, int64_t begin, int64_t end, const float *background, float *out,
                  float *transmittance, int32_t *endings) {
    struct Pixels {
        Vec T, channel[C];  // T is 0 outside of the image and where the pixel has ended
    } pixels[TILE_VECTORS];
    Vec end_T[TILE_VECTORS];     // transmittance with which a pixel ended
    Mask ended[TILE_VECTORS];    // place in the tile's list of the Gaussian before which a pixel ended
    memset(pixels, 0, sizeof pixels);
    for_vectors(tile, image_width, [&](int v, const Place &place) { pixels[v].T = masked(place.inside(), splat(1.f)); });
    for (int v = 0; v < TILE_VECTORS; v++) end_T[v] = Vec{}, ended[v] = Mask{} + (int32_t)(end - begin);
    int alive[STRIPS];  // vectors with a pixel that goes on
    for (int &n : alive) n = (tile.height + ROWS - 1) / ROWS;
    uint32_t going_on = (1u << tile.strips) - 1;  // strips with such a vector

    for (int64_t i = begin; i < end && going_on; i++) {
        if (i + AHEAD < end) prefetch(splats, channels, stride, ids[i + AHEAD]);
        const Splat &g = splats[ids[i]];
        const float *channel = channels + ids[i] * stride;
        Vec value[C];
        for (int c = 0; c < C; c++) value[c] = splat(channel[c]);
        for_strips(g, tile, going_on, [&](int s, int first, int count) {
            OverStrip over(g, tile, s, first, count);
            int at = s * STRIP_VECTORS + first;
            for (int v = 0; v < count; v++, at++) {
                Pixels &p = pixels[at];
                Vec T = p.T, weight = over.alpha[v] * T, after = T - weight;
                Mask ends = positive_up_to(after, MIN_TRANSMITTANCE);
                if (__builtin_expect(any(ends), 0)) {
                    end_T[at] = select(ends, T, end_T[at]);
                    ended[at] = (ends & (int32_t)(i - begin)) | (~ends & ended[at]);
                    after = masked(~ends, after);
                    weight = masked(~ends, weight);
                    if (!any(after > 0.f) && --alive[s] == 0) going_on &= ~(1u << s);
                }
                for (int c = 0; c < C; c++) p.channel[c] += weight * value[c];
                p.T = after;
            }
        });
    }
    for_vectors(tile, image_width, [&](int v, const Place &place) {
        const Pixels &p = pixels[v];
        Vec T = select(p.T > 0.f, p.T, end_T[v]);
        place.write(T, transmittance, 1);
        place.write(ended[v], endings);
        for (int c = 0; c < C; c++) place.write(p.channel[c] + T * background[c], out + c, stride);
    });
}

// The buffers of a tile that is gone through once more: its list [begin, end) of Gaussians `ids`, and how each pixel ended.
struct Replay {
    const Splat *splats;
    const int32_t *ids;
    int64_t begin, end;
    const float *transmittance;
    const int32_t *endings;
};

// Back to front. Job says what is kept per pixel (Job::Pixels, with T, the transmittance behind the current Gaussian) and
// what is done with a Gaussian over each strip that it meets. `fill(pixels, place)` sets the rest of a vector; the result
// of each Gaussian goes to its place in `results`, `size` floats, by `finish(job, place)`; Gaussians behind every pixel's end
// get 0.
template <class Job, class Fill, class Finish>
void replay_tile(const Tile &tile, int image_width, const Replay &replay, const float *channels, int64_t stride,
                 float *results, int64_t size, Fill fill, Finish finish) {
    typename Job::Pixels pixels[TILE_VECTORS];
    Mask ended[TILE_VECTORS];
    memset(pixels, 0, sizeof pixels);  // T = 0: outside of the image
    memset(ended, 0, sizeof ended);
    Mask first_of[STRIPS], last_of[STRIPS];  // pixel's end in a strip, by lane
    for (int s = 0; s < STRIPS; s++) first_of[s] = Mask{} + INT32_MAX, last_of[s] = Mask{};
    for_vectors(tile, image_width, [&](int v, const Place &place) {
        int s = v / STRIP_VECTORS;
        pixels[v].T = place.read(replay.transmittance, 1);
        ended[v] = place.read(replay.endings);
        fill(pixels[v], place);
        last_of[s] = larger(last_of[s], ended[v]);
        first_of[s] = smaller(first_of[s], (Mask)(ended[v] | (~place.inside() & INT32_MAX)));
    });
    int32_t tile_last = 0, strip_last[STRIPS], strip_first[STRIPS];
    for (int s = 0; s < STRIPS; s++) {
        strip_first[s] = INT32_MAX, strip_last[s] = 0;
        for (int lane = 0; lane < VW; lane++) {
            strip_first[s] = smaller(strip_first[s], first_of[s][lane]);
            strip_last[s] = larger(strip_last[s], last_of[s][lane]);
        }
        tile_last = larger(tile_last, strip_last[s]);
    }
    const int32_t *ids = replay.ids + replay.begin;
    results += replay.begin * size;
    int64_t hidden = replay.end - replay.begin - tile_last;  // behind every pixel's end
    if (hidden > 0) memset(results + tile_last * size, 0, hidden * size * sizeof(float));
    for (int32_t rank = tile_last - 1; rank >= 0; rank--) {
        if (rank >= AHEAD) prefetch(replay.splats, channels, stride, ids[rank - AHEAD]);
        const Splat &g = replay.splats[ids[rank]];
        Job job(g, channels + ids[rank] * stride);
        for_strips(g, tile, (1u << tile.strips) - 1, [&](int s, int first, int count) {
            if (rank >= strip_last[s]) return;
            OverStrip over(g, tile, s, first, count);
            int at = s * STRIP_VECTORS + first;
            const Vec *alpha = over.alpha;
            Vec shown[STRIP_VECTORS];
            if (rank >= strip_first[s]) {
                for (int v = 0; v < count; v++) shown[v] = masked(ended[at + v] > rank, alpha[v]);
                alpha = shown;
            }
            job.strip(over.dx, over.u, alpha, pixels + at, count);
        });
        finish(job, results + rank * size);
    }
}

// `behind` sums what the image's gradient meets behind the current Gaussian: (gradient . channel) T alpha of later ones and
// the background's part. Nothing cancels. Then dL/dalpha = T (gradient . channel) - behind / (1 - alpha), and
// v = alpha dL/dalpha = -dL/ds.
template <int C>
struct Gradients {
    struct Pixels {
        Vec T, behind, gradient[C];
    };
    Vec value[C], sums[MOMENTS + C] = {};
    bool clamps;  // some alphas may be clamped

    Gradients(const Splat &g, const float *channel) : clamps(g.opacity >= MAX_ALPHA) {
        for (int c = 0; c < C; c++) value[c] = splat(channel[c]);
    }

    void strip(Vec dx, Vec u, const Vec *alphas, Pixels *pixels, int count) {
        if (__builtin_expect(clamps, 0))
            add_strip<true>(dx, u, alphas, pixels, count);
        else
            add_strip<false>(dx, u, alphas, pixels, count);
    }

    template <bool CLAMPS>
    void add_strip(Vec dx, Vec u, const Vec *alphas, Pixels *pixels, int count) {
        Vec sum_v = {}, sum_vu = {}, sum_vuu = {}, by_value[C] = {};
        for (int i = 0; i < count; i++, u -= (float)ROWS) {
            Pixels &p = pixels[i];
            Vec alpha = alphas[i], inverse = 1.f / (1.f - alpha), T = p.T * inverse, weight = alpha * T;
            Vec along = p.gradient[0] * value[0], behind = p.behind;  // along: gradient . channel
            by_value[0] += weight * p.gradient[0];
            for (int c = 1; c < C; c++) {
                along += p.gradient[c] * value[c];
                by_value[c] += weight * p.gradient[c];
            }
            Vec shown = weight * along, v = shown - behind * (alpha * inverse);
            p.T = T;
            p.behind = behind + shown;
            if (CLAMPS) v = masked(alpha < MAX_ALPHA, v);  // where alpha is clamped it does not vary
            Vec vu = v * u;
            sum_v += v;
            sum_vu += vu;
            sum_vuu += vu * u;
        }
        Vec sum_vx = sum_v * dx;
        sums[0] += sum_v;
        sums[1] += sum_vx;
        sums[2] += sum_vu;
        sums[3] += sum_vx * dx;
        sums[4] += sum_vu * dx;
        sums[5] += sum_vuu;
        for (int c = 0; c < C; c++) sums[MOMENTS + c] += by_value[c];
    }
};

template <int C>
void backward_tile(const Tile &tile, int image_width, const Replay &replay, const float *channels, int64_t stride,
                   const float *background, const float *out_gradient, const float *alpha_gradient, int first_channel,
                   float *gradients, float *background_gradient) {
    double background_sum[C] = {};
    auto fill = [&](typename Gradients<C>::Pixels &p, const Place &place) {
        p.behind = first_channel == 0 && alpha_gradient ? -place.read(alpha_gradient, 1) * p.T : Vec{};
        for (int c = 0; c < C; c++) {
            p.gradient[c] = place.read(out_gradient + c, stride);
            Vec seen = p.T * p.gradient[c];
            p.behind += seen * background[c];
            background_sum[c] += sum(seen);
        }
    };
    auto finish = [&](Gradients<C> &job, float *to) {
        float sums[MOMENTS + C];
        lane_sums(job.sums, sums);
        for (int m = 0; m < MOMENTS; m++) to[m] = first_channel == 0 ? sums[m] : to[m] + sums[m];
        for (int c = 0; c < C; c++) to[MOMENTS + first_channel + c] = sums[MOMENTS + c];
    };
    replay_tile<Gradients<C>>(tile, image_width, replay, channels, stride, gradients, MOMENTS + stride, fill, finish);
    for (int c = 0; c < C; c++) background_gradient[c] = (float)background_sum[c];
}

// Without gradients: what a Gaussian does to the image. dC/dg, the image's change by its value g = exp(-s), is
// o T (channel - color behind it), 0 where alpha is clamped. `importance` sums |dC/dg|^2, `error` sums
// (gradient . dC/dg)^2, `weighted` T alpha times each of the weight images.
template <int C>
struct Contribution {
    struct Pixels {
        Vec T, behind[C], gradient[C], weight[GROUP];  // behind: sum of T alpha channel of later ones, and the background
    };
    Vec value[C], opacity, sums[2 + GROUP] = {};  // importance, error, weighted

    Contribution(const Splat &g, const float *channel) : opacity(splat(g.opacity)) {
        for (int c = 0; c < C; c++) value[c] = splat(channel[c]);
    }

    void strip(Vec, Vec, const Vec *alphas, Pixels *pixels, int count) {
        for (int v = 0; v < count; v++) {
            Pixels &p = pixels[v];
            Vec alpha = alphas[v], inverse = 1.f / (1.f - alpha), T = p.T * inverse, weight = alpha * T, along = {};
            Mask varies = (alpha > 0.f) & (alpha < MAX_ALPHA);  // not where alpha is clamped
            for (int c = 0; c < C; c++) {
                Vec change = masked(varies, opacity * (T * value[c] - p.behind[c] * inverse));
                sums[0] += change * change;
                along += change * p.gradient[c];
                p.behind[c] += weight * value[c];
            }
            sums[1] += along * along;
            for (int r = 0; r < GROUP; r++) sums[2 + r] += weight * p.weight[r];
            p.T = T;
        }
    }
};

// A place holds importance, error and one sum for each of `weight_count` weight images, of which this pass takes the GROUP
// from `first_weight` on.
template <int C>
void contributions_tile(const Tile &tile, int image_width, const Replay &replay, const float *channels,
                        const float *background, const float *weights, int weight_count, int first_weight,
                        const float *out_gradient, float *results) {
    auto fill = [&](typename Contribution<C>::Pixels &p, const Place &place) {
        for (int c = 0; c < C; c++) {
            p.behind[c] = p.T * background[c];
            p.gradient[c] = place.read(out_gradient + c, C);
        }
        for (int r = 0; r < GROUP && first_weight + r < weight_count; r++)
            p.weight[r] = place.read(weights + first_weight + r, weight_count);
    };
    auto finish = [&](Contribution<C> &job, float *to) {
        float sums[2 + GROUP];
        lane_sums(job.sums, sums);
        to[0] = sums[0];
        to[1] = sums[1];
        for (int r = 0; r < GROUP && first_weight + r < weight_count; r++) to[2 + first_weight + r] = sums[2 + r];
    };
    replay_tile<Contribution<C>>(tile, image_width, replay, channels, C, results, 2 + weight_count, fill, finish);
}

template <int C>
struct Constant {
    static constexpr int value = C;
};

// Calls a kernel template with the group's number of channels as a constant.
template <int C, class Call>
inline void with_channels(int channels, Call call) {
    if constexpr (C == 1) {
        call(Constant<1>());
    } else if (channels == C) {
        call(Constant<C>());
    } else {
        with_channels<C - 1>(channels, call);
    }
}

// Sums of C channels from `first_channel` on, and with the first of them the geometry. With v = -dL/ds summed:
// ds = 2 c u (dy' + k dx' + dx k') + 2 h dx dx' + u^2 c' + dx^2 h', and c, k, h by the conic.
template <int C>
void gather_ranks(int64_t begin, int64_t end, int64_t drawable, int64_t channel_count, int first_channel, const Splat *splats,
                  const int32_t *order, const int64_t *rank_starts, const int32_t *places, const float *gradients,
                  float *means2d, float *conics, float *opacities, float *channels) {
    int64_t size = MOMENTS + channel_count, pairs = rank_starts[drawable];
    for (int64_t rank = begin; rank < end; rank++) {
        int64_t i = order[rank];
        float sums[MOMENTS + C] = {}, k = 0, c = 0, h = 0, opacity = 1;
        if (rank < drawable) {
            if (rank + AHEAD < drawable) __builtin_prefetch(splats + order[rank + AHEAD]);
            const Splat &g = splats[i];
            k = g.k, c = g.c, h = g.h, opacity = g.opacity;
            for (int64_t pair = rank_starts[rank]; pair < rank_starts[rank + 1]; pair++) {
                if (pair + 2 * AHEAD < pairs) {
                    const float *later = gradients + places[pair + 2 * AHEAD] * size;
                    __builtin_prefetch(later);
                    __builtin_prefetch(later + size - 1);
                }
                const float *from = gradients + places[pair] * size;
                for (int m = 0; m < MOMENTS; m++) sums[m] += from[m];
                for (int j = 0; j < C; j++) sums[MOMENTS + j] += from[MOMENTS + first_channel + j];
            }
        }
        for (int j = 0; j < C; j++) channels[i * channel_count + first_channel + j] = sums[MOMENTS + j];
        if (first_channel > 0) continue;
        float v = sums[0], vx = sums[1], vu = sums[2], vxx = sums[3], vxu = sums[4], vuu = sums[5];
        means2d[2 * i] = -2 * (c * k * vu + h * vx);
        means2d[2 * i + 1] = -2 * c * vu;
        conics[3 * i] = -.5f * vxx;
        conics[3 * i + 1] = k * vxx - vxu;
        conics[3 * i + 2] = k * vxu - .5f * (vuu + k * k * vxx);
        opacities[i] = v / opacity;
    }
}

}  // namespace

API int64_t tile_width() { return TILE_WIDTH; }
API int64_t tile_height() { return TILE_HEIGHT; }
API int64_t splat_bytes() { return sizeof(Splat); }
API int64_t moment_count() { return MOMENTS; }

// Packs Gaussians [begin, end) and writes their depth keys; those that cannot be drawn get the key NOT_DRAWN. The
// comparisons are written so that NaN is never drawn.
API void pack(int64_t begin, int64_t end, const float *means2d, const float *conics, const float *opacities,
              const float *depths, const float *radii, int64_t width, int64_t height, Splat *splats, uint32_t *keys) {
    for (int64_t i = begin; i < end; i++) {
        Splat &g = splats[i];
        double a = conics[3 * i], b = conics[3 * i + 1], c = conics[3 * i + 2], det = a * c - b * b;
        g.x = means2d[2 * i];
        g.y = means2d[2 * i + 1];
        g.opacity = opacities[i];
        double log_opacity = g.opacity > 0 ? log(g.opacity) : -LOG255;
        double limit = log_opacity + LOG255;
        keys[i] = NOT_DRAWN;
        if (!(radii[i] > 0 && depths[i] > 0 && limit > 0 && limit < 64 && a > 0 && c > 0 && det > 0)) continue;
        g.k = (float)(b / c);
        g.c = (float)(.5 * c);
        g.h = (float)(.5 * det / c);
        g.half_width = (float)sqrt(2 * limit * c / det);
        g.half_height = (float)sqrt(2 * limit * a / det);
        g.top = (float)(-b / a * g.half_height);
        g.h_by_c = (float)(det / (c * c));
        g.limit_by_c = (float)(2 * limit / c);
        g.log_opacity = (float)(log_opacity * LOG2E);
        double ratio = ::exp(-c * (ROWS * ROWS));  // e^(second difference of -s in steps of ROWS)
        g.ratio = (float)ratio;
        g.block_ratio = (float)(ratio * ratio * ratio * ratio);
        bool finite = g.half_width < 1e9f && g.half_height < 1e9f && g.h > 0 && g.c < 1e9f;
        bool on_screen = g.x + g.half_width > 0 && g.x - g.half_width < width && g.y + g.half_height > 0 &&
                         g.y - g.half_height < height;
        if (!(finite && on_screen)) continue;
        float half_x = g.half_width + MARGIN, half_y = g.half_height + MARGIN, x = g.x - .5f, y = g.y - .5f;
        g.left = (uint16_t)((int)larger(0.f, x - half_x) / TILE_WIDTH);
        g.right = (uint16_t)((int)smaller(width - 1.f, larger(0.f, x + half_x)) / TILE_WIDTH);
        g.top_row = (uint16_t)((int)larger(0.f, y - half_y) / TILE_HEIGHT);
        g.bottom_row = (uint16_t)((int)smaller(height - 1.f, larger(0.f, y + half_y)) / TILE_HEIGHT);
        memcpy(&keys[i], &depths[i], sizeof(float));
    }
}

// Indices of the drawable Gaussians by depth, equal depths by index, and then of the others; returns the number of drawable
// ones. Radix sort: positive floats
// order as their bits. `spare` holds n indices, `spare_keys` 2 n keys.
API int64_t sort_by_depth(int64_t n, const uint32_t *keys, int32_t *order, int32_t *spare, uint32_t *spare_keys) {
    uint32_t *from_keys = spare_keys, *to_keys = spare_keys + n;
    int32_t *from = spare, *to = order;
    int64_t drawable = 0;
    for (int64_t i = 0; i < n; i++)
        if (keys[i] != NOT_DRAWN) {
            from_keys[drawable] = keys[i];
            from[drawable++] = (int32_t)i;
        } else {
            order[n - 1 - (i - drawable)] = (int32_t)i;  // the sort leaves these places as they are
        }
    for (int shift = 0; shift < 33; shift += 11) {
        int64_t starts[2049] = {};
        for (int64_t i = 0; i < drawable; i++) starts[((from_keys[i] >> shift) & 2047) + 1]++;
        for (int b = 0; b < 2048; b++) starts[b + 1] += starts[b];
        for (int64_t i = 0; i < drawable; i++) {
            int64_t place = starts[(from_keys[i] >> shift) & 2047]++;
            to_keys[place] = from_keys[i];
            to[place] = from[i];
        }
        uint32_t *k = from_keys;
        from_keys = to_keys;
        to_keys = k;
        int32_t *o = from;
        from = to;
        to = o;
    }
    return drawable;  // three passes: the last one wrote to `order`
}

// For ranks [begin, end) of the depth order: how many tiles each Gaussian meets, and how many of them fall in each tile.
API void count_tiles(int64_t begin, int64_t end, const Splat *splats, const int32_t *order, int64_t width, int64_t,
                     int64_t *per_rank, int64_t *per_tile) {
    for (int64_t rank = begin; rank < end; rank++) {
        if (rank + AHEAD < end) __builtin_prefetch(splats + order[rank + AHEAD]);
        int64_t n = 0;
        for_tiles(splats[order[rank]], (int)width, [&](int tile) { n++, per_tile[tile]++; });
        per_rank[rank] = n;
    }
}

// Turns the counts of `count_tiles` into places. Returns the number of pairs.
API int64_t start_lists(int64_t drawable, int64_t tiles, int64_t ranges, int64_t *rank_starts, int64_t *per_tile,
                        int64_t *tile_starts) {
    rank_starts[0] = 0;
    for (int64_t rank = 0; rank < drawable; rank++) rank_starts[rank + 1] += rank_starts[rank];
    int64_t place = 0;
    for (int64_t tile = 0; tile < tiles; tile++) {
        tile_starts[tile] = place;
        for (int64_t range = 0; range < ranges; range++) {  // depth order in a tile
            int64_t count = per_tile[range * tiles + tile];
            per_tile[range * tiles + tile] = place;
            place += count;
        }
    }
    tile_starts[tiles] = place;
    return place;
}

// Writes those ranks into the tile lists, and the places in these lists by rank. `next` is where this range's entries of
// each tile begin; it is advanced.
API void fill_tiles(int64_t begin, int64_t end, const Splat *splats, const int32_t *order, int64_t width, int64_t,
                    const int64_t *rank_starts, int32_t *ids, int32_t *places, int64_t *next) {
    for (int64_t rank = begin; rank < end; rank++) {
        if (rank + AHEAD < end) __builtin_prefetch(splats + order[rank + AHEAD]);
        int32_t *place_of = places + rank_starts[rank];
        for_tiles(splats[order[rank]], (int)width, [&](int tile) {
            int64_t place = next[tile]++;
            ids[place] = order[rank];
            *place_of++ = (int32_t)place;
        });
    }
}

// Blends tiles [begin, end). out (H, W, channels), transmittance (H, W), endings (H, W): the rank in its tile's list at
// which a pixel ended.
API void blend_forward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, const Splat *splats,
                       const float *channels, const int32_t *ids, const int64_t *tile_starts, const float *background,
                       float *out, float *transmittance, int32_t *endings) {
    for (int64_t t = begin; t < end; t++) {
        Tile tile = tile_at((int)t, (int)width, (int)height);
        for (int c = 0; c < channel_count; c += GROUP)
            with_channels<GROUP>(smaller(GROUP, (int)channel_count - c), [&](auto count) {
                forward_tile<decltype(count)::value>(tile, width, splats, channels + c, channel_count, ids, tile_starts[t],
                                                     tile_starts[t + 1], background + c, out + c, transmittance, endings);
            });
    }
}

// Gradients of tiles [begin, end): moments and channel gradients by place in the tile lists, the background's by tile.
// Groups of channels add up, since the gradient is linear in them.
API void blend_backward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, const Splat *splats,
                        const float *channels, const int32_t *ids, const int64_t *tile_starts,
                        const float *background, const float *transmittance, const int32_t *endings,
                        const float *out_gradient, const float *alpha_gradient, float *gradients,
                        float *background_gradient) {
    for (int64_t t = begin; t < end; t++) {
        Tile tile = tile_at((int)t, (int)width, (int)height);
        Replay replay = {splats, ids, tile_starts[t], tile_starts[t + 1], transmittance, endings};
        for (int c = 0; c < channel_count; c += GROUP)
            with_channels<GROUP>(smaller(GROUP, (int)channel_count - c), [&](auto count) {
                backward_tile<decltype(count)::value>(tile, width, replay, channels + c, channel_count, background + c,
                                                      out_gradient + c, alpha_gradient, c, gradients,
                                                      background_gradient + t * channel_count + c);
            });
    }
}

// Contributions of tiles [begin, end), 2 + weight_count sums by place in the tile lists; at most GROUP channels.
API void contributions(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, int64_t weight_count,
                       const Splat *splats, const float *channels, const int32_t *ids,
                       const int64_t *tile_starts, const float *background, const float *transmittance,
                       const int32_t *endings, const float *weights, const float *out_gradient, float *results) {
    for (int64_t t = begin; t < end; t++) {
        Tile tile = tile_at((int)t, (int)width, (int)height);
        Replay replay = {splats, ids, tile_starts[t], tile_starts[t + 1], transmittance, endings};
        for (int r = 0; r == 0 || r < weight_count; r += GROUP)
            with_channels<GROUP>((int)channel_count, [&](auto count) {
                contributions_tile<decltype(count)::value>(tile, width, replay, channels, background, weights, weight_count,
                                                           r, out_gradient, results);
            });
    }
}

// Adds up the results of ranks [begin, end) in a fixed order: sums (N, size).
API void gather_sums(int64_t begin, int64_t end, int64_t size, const int32_t *order, const int64_t *rank_starts,
                     const int32_t *places, const float *results, float *sums) {
    for (int64_t rank = begin; rank < end; rank++)
        for (int64_t pair = rank_starts[rank]; pair < rank_starts[rank + 1]; pair++)
            for (int64_t k = 0; k < size; k++) sums[order[rank] * size + k] += results[places[pair] * size + k];
}

// Adds up the results of ranks [begin, end) in a fixed order and turns moments into gradients.
API void gather(int64_t begin, int64_t end, int64_t drawable, int64_t channel_count, const Splat *splats, const int32_t *order,
                const int64_t *rank_starts, const int32_t *places, const float *gradients, float *means2d, float *conics,
                float *opacities, float *channels) {
    for (int c = 0; c < channel_count; c += GROUP)
        with_channels<GROUP>(smaller(GROUP, (int)channel_count - c), [&](auto count) {
            gather_ranks<decltype(count)::value>(begin, end, drawable, channel_count, c, splats, order, rank_starts, places,
                                                 gradients, means2d, conics, opacities, channels);
        });
}
