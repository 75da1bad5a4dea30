// Tile rasteriser for projected Gaussians, forward and backward (Kernels.blend in protocol.py). The caller owns all
// buffers and threads.
//
// A Gaussian weighs a pixel by alpha = min(.99, o exp(-s)), with (A, B, C) its conic and (dx, dy) = centre - pixel:
//     s = (A dx^2 + 2 B dx dy + C dy^2) / 2 = h dx^2 + c u^2,   u = dy + k dx,   k = B/C,  c = C/2,  h = (A - B^2/C)/2.
// The sum of two squares is never negative and loses no digits for needles. alpha < 1/255, that is s > ln(255 o), is
// skipped; so each Gaussian is an ellipse of known extent. Pixels are blended front to back,
//     out = sum_i T_i alpha_i channel_i + T_end background,   T_(i+1) = T_i (1 - alpha_i),
// and a pixel ends before the Gaussian that would take T to 1e-4 or less.
//
// A tile's pixels lie in vertical strips, STRIP columns wide; a vector holds ROWS rows of a strip. A Gaussian visits only
// the rows of a strip that its ellipse meets.
#include "simd.h"

#include <math.h>

namespace {

constexpr int TILE = 32;                    // width and height, pixels: its state in one pass, 36 kB, is about the first-level cache
constexpr int STRIP = VW < 8 ? VW : 8;      // columns of a strip
constexpr int ROWS = VW / STRIP;            // rows of a strip in one vector
constexpr int STRIPS = TILE / STRIP;        // strips of a tile
constexpr int STRIP_VECTORS = TILE / ROWS;  // vectors of a strip
constexpr int GROUP = 8;                    // channels blended in one pass: their sums stay in registers
constexpr int MOMENTS = 6;                  // sums of v times 1, dx, u, dx^2, dx u, u^2
constexpr float MAX_ALPHA = .99f;           // the backward pass divides by 1 - alpha; as in reference/blending.py
constexpr float MIN_TRANSMITTANCE = 1e-4f;  // at which a pixel ends; as in reference/blending.py
constexpr float LOG2E = 1.44269504f;        // log2(e): from e^x to 2^x
constexpr float LOG255 = 5.54126355f;       // ln(255): alpha falls below 1/255 where s > ln(255 opacity)
constexpr float ROW_MARGIN = .01f;          // pixels; for rounding, since each pixel is tested again
constexpr uint32_t NOT_DRAWN = 0xffffffffu; // depth key of Gaussians that cannot be drawn

typedef float StripF __attribute__((vector_size(STRIPS * 4)));
typedef int32_t StripI __attribute__((vector_size(STRIPS * 4)));

struct Splat {
    float x, y, k, c, h, opacity;
    float limit;                        // largest s that is not skipped; 0 or less: nothing to draw
    float half_width, half_height;      // of the ellipse s = limit
    float top;                          // x offset of the point at +half_height
};

struct Tile {
    int x, y, width, height, strips;  // corner and size in pixels, clipped to the image
};

Tile tile_at(int index, int width, int height) {
    int across = (width + TILE - 1) / TILE;
    Tile t;
    t.x = index % across * TILE;
    t.y = index / across * TILE;
    t.width = smaller(TILE, width - t.x);
    t.height = smaller(TILE, height - t.y);
    t.strips = (t.width + STRIP - 1) / STRIP;
    return t;
}

// The y offsets [low, high] that the ellipse reaches over the x offsets [left, right]; low > high where it does not.
template <class F>
inline void rows_over_columns(const Splat &g, F left, F right, F &low, F &high) {
    F zero = left - left;
    left = larger(left, zero - g.half_width);
    right = smaller(right, zero + g.half_width);
    float inverse_c = 1.f / g.c;
    F reach_left = square_root(larger((g.limit - g.h * left * left) * inverse_c, zero));
    F reach_right = square_root(larger((g.limit - g.h * right * right) * inverse_c, zero));
    low = smaller(-g.k * left - reach_left, -g.k * right - reach_right);
    high = larger(-g.k * left + reach_left, -g.k * right + reach_right);
    F top = zero + g.top;
    high = ((left <= top) & (top <= right)) ? zero + g.half_height : high;
    low = ((left <= -top) & (-top <= right)) ? zero - g.half_height : low;
    low = left <= right ? low - ROW_MARGIN : zero + 1.f;
    high = left <= right ? high + ROW_MARGIN : zero - 1.f;
}

// Calls visit(tile index) for each tile whose pixel centres the ellipse may meet.
template <class Visit>
inline void for_tiles(const Splat &g, int width, int height, Visit visit) {
    int across = (width + TILE - 1) / TILE;
    int first = (int)larger(0.f, g.x - g.half_width - .51f) / TILE;
    int last = (int)smaller(width - 1.f, g.x + g.half_width - .49f) / TILE;
    for (int tx = first; tx <= last; tx++) {
        float left = tx * TILE + .5f - g.x, low, high;
        rows_over_columns(g, left, left + (smaller(TILE, width - tx * TILE) - 1), low, high);
        low = larger(0.f, ceilf(g.y + low - .5f));
        high = smaller(height - 1.f, floorf(g.y + high - .5f));
        if (!(low <= high)) continue;
        for (int ty = (int)low / TILE; ty <= (int)high / TILE; ty++) visit(ty * across + tx);
    }
}

// First and last vector of each strip that a Gaussian visits.
inline void strip_spans(const Splat &g, const Tile &tile, StripI &first, StripI &last) {
    StripF left;
    for (int s = 0; s < STRIPS; s++) left[s] = s * STRIP;
    left += tile.x + .5f - g.x;
    StripF low, high, zero = {};
    rows_over_columns(g, left, left + (STRIP - 1.f), low, high);
    float to_row = g.y - .5f - tile.y;
    low = smaller(larger(low + to_row, zero), zero + (float)TILE);
    high = smaller(high + to_row, zero + (tile.height - 1.f));
    StripI begin = __builtin_convertvector(low, StripI);
    begin -= (__builtin_convertvector(begin, StripF) < low);  // rounds up: true is -1
    StripI end = __builtin_convertvector(larger(high, zero), StripI);
    StripI empty = (begin > end) | (high < zero);
    first = begin / ROWS;
    last = (end / ROWS) | empty;
}

// Calls visit(vector, lane, pixel of the image) for each pixel of a tile.
template <class Visit>
inline void for_pixels(const Tile &tile, int image_width, Visit visit) {
    for (int y = 0; y < tile.height; y++)
        for (int s = 0; s < tile.strips; s++) {
            int columns = smaller(STRIP, tile.width - s * STRIP), vector = s * STRIP_VECTORS + y / ROWS;
            int64_t pixel = (int64_t)(tile.y + y) * image_width + tile.x + s * STRIP;
            for (int x = 0; x < columns; x++) visit(vector, y % ROWS * STRIP + x, pixel + x);
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

// A Gaussian over one strip: what the exponent needs, in base 2.
struct Exponent {
    Vec dx, kdx, hdx2, c, limit;
    float y;  // centre to the centre of the tile's first row
    Exponent(const Splat &g, const Tile &tile, int strip) {
        dx = splat(g.x - tile.x - strip * STRIP) - load(LANES.column);
        kdx = dx * g.k - load(LANES.row);
        hdx2 = dx * dx * (-g.h * LOG2E);
        c = splat(-g.c * LOG2E);
        limit = splat(-g.limit * LOG2E);
        y = g.y - tile.y;
    }
    Vec u(int vector) const { return kdx + (y - vector * ROWS); }
    Vec operator()(Vec u) const { return c * u * u + hdx2; }
};

// 2^e needs e >= -126; below the limit the result is masked out anyway.
inline Vec opacity_at(Vec exponent, Vec opacity) { return opacity * exp2(larger(exponent, splat(-20.f))); }

template <int C>
void forward_tile(const Tile &tile, int image_width, const Splat *splats, const float *channels, int stride, const int32_t *ids,
                  int64_t begin, int64_t end, const float *background, float *out, float *transmittance,
                  int32_t *endings) {
    Mask ended[STRIPS * STRIP_VECTORS];  // rank in the tile's list of the Gaussian before which a pixel ended
    struct Pixels {
        Vec T, channel[C];  // T < 0: the pixel has ended with transmittance -T
    } pixels[STRIPS * STRIP_VECTORS];
    memset(pixels, 0, sizeof pixels);  // T = 0: outside of the image
    for_pixels(tile, image_width, [&](int vector, int lane, int64_t) { pixels[vector].T[lane] = 1; });
    for (Mask &e : ended) e = Mask{} + (int32_t)(end - begin);
    int alive[STRIPS], strips_alive = tile.strips;  // vectors with a pixel that goes on
    for (int &n : alive) n = (tile.height + ROWS - 1) / ROWS;

    int64_t i = begin;
    for (; i < end && strips_alive; i++) {
        const Splat &g = splats[ids[i]];
        const float *channel = channels + (int64_t)ids[i] * stride;
        Vec value[C], opacity = splat(g.opacity);
        for (int c = 0; c < C; c++) value[c] = splat(channel[c]);
        StripI first, last;
        strip_spans(g, tile, first, last);
        for (int s = 0; s < tile.strips; s++) {
            if (first[s] > last[s] || !alive[s]) continue;
            Exponent exponent(g, tile, s);
            Pixels *strip = pixels + s * STRIP_VECTORS;
            for (int v = first[s]; v <= last[s]; v++) {
                Vec e = exponent(exponent.u(v)), T = strip[v].T;
                Mask drawn = (e >= exponent.limit) & (T > 0.f);
                Vec alpha = smaller(opacity_at(e, opacity), splat(MAX_ALPHA));
                Vec weight = masked(drawn, alpha * T), after = T - weight;
                Mask ends = drawn & (after <= MIN_TRANSMITTANCE);
                if (__builtin_expect(any(ends), 0)) {
                    after = select(ends, -T, after);
                    weight = masked(~ends, weight);
                    Mask &e = ended[s * STRIP_VECTORS + v];
                    e = (ends & (int32_t)(i - begin)) | (~ends & e);
                    if (!any(after > 0.f) && --alive[s] == 0) strips_alive--;
                }
                for (int c = 0; c < C; c++) strip[v].channel[c] += weight * value[c];
                strip[v].T = after;
            }
        }
    }
    for_pixels(tile, image_width, [&](int vector, int lane, int64_t pixel) {
        const Pixels &p = pixels[vector];
        float T = fabsf(p.T[lane]);
        transmittance[pixel] = T;
        endings[pixel] = ended[vector][lane];
        for (int c = 0; c < C; c++) out[pixel * stride + c] = p.channel[c][lane] + T * background[c];
    });
}

// The buffers of a tile that is gone through once more: its list [begin, end) of Gaussians `ids` with the places `slots`
// of their results, and how each pixel ended.
struct Replay {
    const Splat *splats;
    const int32_t *ids, *slots;
    int64_t begin, end;
    const float *transmittance;
    const int32_t *endings;
};

// Back to front. Job says what is kept per pixel (Job::Pixels, with T, the transmittance behind the current Gaussian, and
// the rank at which the pixel ended) and what is done with a Gaussian over each strip that it meets.
// `fill(pixels, lane, pixel)` sets a pixel's lane; `finish(job, slot)` takes the result.
template <class Job, class Fill, class Finish>
void replay_tile(const Tile &tile, int image_width, const Replay &replay, const float *channels, int stride, Fill fill,
                 Finish finish) {
    typename Job::Pixels pixels[STRIPS * STRIP_VECTORS];
    memset(pixels, 0, sizeof pixels);  // ended = 0: outside of the image
    int32_t strip_ended[STRIPS] = {}, tile_ended = 0;
    for_pixels(tile, image_width, [&](int vector, int lane, int64_t pixel) {
        pixels[vector].T[lane] = replay.transmittance[pixel];
        pixels[vector].ended[lane] = replay.endings[pixel];
        fill(pixels[vector], lane, pixel);
        int32_t &last = strip_ended[vector / STRIP_VECTORS];
        last = larger(last, replay.endings[pixel]);
        tile_ended = larger(tile_ended, replay.endings[pixel]);
    });
    for (int32_t rank = tile_ended - 1; rank >= 0; rank--) {
        int32_t id = replay.ids[replay.begin + rank];
        const Splat &g = replay.splats[id];
        Job job(g, channels + (int64_t)id * stride);
        StripI first, last;
        strip_spans(g, tile, first, last);
        for (int s = 0; s < tile.strips; s++)
            if (first[s] <= last[s] && rank < strip_ended[s])
                job.strip(Exponent(g, tile, s), pixels + s * STRIP_VECTORS, first[s], last[s], rank);
        finish(job, replay.slots[replay.begin + rank]);
    }
}

// A Gaussian at the pixels of one vector. Takes their T to before it: T_i = T_(i+1) / (1 - alpha_i).
struct Sample {
    Vec u, unclamped, inverse, T, weight;  // inverse: 1 / (1 - alpha); weight: T alpha
    Mask drawn;

    template <class Pixels>
    Sample(const Exponent &exponent, Vec opacity, int vector, int32_t rank, Pixels &pixels) {
        u = exponent.u(vector);
        Vec e = exponent(u);
        drawn = (e >= exponent.limit) & (pixels.ended > rank);
        unclamped = opacity_at(e, opacity);
        Vec alpha = smaller(unclamped, splat(MAX_ALPHA));
        inverse = 1.f / (1.f - alpha);
        pixels.T = T = select(drawn, pixels.T * inverse, pixels.T);
        weight = masked(drawn, alpha * T);
    }
    Mask varies() const { return drawn & (unclamped < MAX_ALPHA); }  // not where alpha is clamped
};

// `behind` sums what the image's gradient meets behind the current Gaussian: (gradient . channel) T alpha of later ones and
// the background's part. Nothing cancels. Then dL/dalpha = T (gradient . channel) - behind / (1 - alpha), and
// v = alpha dL/dalpha = -dL/ds.
template <int C>
struct Gradients {
    struct Pixels {
        Vec T, behind;
        Mask ended;
        Vec gradient[C];
    };
    Vec value[C], by_value[C], opacity, moment[MOMENTS] = {};

    Gradients(const Splat &g, const float *channel) : opacity(splat(g.opacity)) {
        for (int c = 0; c < C; c++) value[c] = splat(channel[c]), by_value[c] = Vec{};
    }

    void strip(const Exponent &exponent, Pixels *pixels, int first, int last, int32_t rank) {
        Vec sum_v = {}, sum_vu = {}, sum_vuu = {};
        for (int v = first; v <= last; v++) {
            Sample at(exponent, opacity, v, rank, pixels[v]);
            Vec along = {}, behind = pixels[v].behind;  // along: gradient . channel
            for (int c = 0; c < C; c++) {
                Vec gradient = pixels[v].gradient[c];
                along += gradient * value[c];
                by_value[c] += at.weight * gradient;
            }
            pixels[v].behind = behind + at.weight * along;
            Vec gradient = masked(at.varies(), (at.T * along - behind * at.inverse) * at.unclamped);
            Vec gradient_u = gradient * at.u;
            sum_v += gradient;
            sum_vu += gradient_u;
            sum_vuu += gradient_u * at.u;
        }
        Vec sum_vx = sum_v * exponent.dx;
        moment[0] += sum_v;
        moment[1] += sum_vx;
        moment[2] += sum_vu;
        moment[3] += sum_vx * exponent.dx;
        moment[4] += sum_vu * exponent.dx;
        moment[5] += sum_vuu;
    }
};

template <int C>
void backward_tile(const Tile &tile, int image_width, const Replay &replay, const float *channels, int stride,
                   const float *background, const float *out_gradient, const float *alpha_gradient, int first_channel,
                   float *gradients, float *background_gradient) {
    double background_sum[C] = {};
    auto fill = [&](typename Gradients<C>::Pixels &p, int lane, int64_t pixel) {
        float T = replay.transmittance[pixel], behind = first_channel == 0 ? -alpha_gradient[pixel] * T : 0.f;
        for (int c = 0; c < C; c++) {
            float g = out_gradient[pixel * stride + c];
            p.gradient[c][lane] = g;
            behind += T * g * background[c];
            background_sum[c] += T * g;
        }
        p.behind[lane] = behind;
    };
    replay_tile<Gradients<C>>(tile, image_width, replay, channels, stride, fill, [&](Gradients<C> &job, int64_t slot) {
        float *to = gradients + slot * (MOMENTS + stride);
        for (int m = 0; m < MOMENTS; m++) to[m] += sum(job.moment[m]);
        for (int c = 0; c < C; c++) to[MOMENTS + first_channel + c] = sum(job.by_value[c]);
    });
    for (int c = 0; c < C; c++) background_gradient[c] = (float)background_sum[c];
}

// Without gradients: what a Gaussian does to the image. dC/dg, the image's change by its value g = exp(-s), is
// o T (channel - color behind it), 0 where alpha is clamped. `importance` sums |dC/dg|^2, `error` sums
// (gradient . dC/dg)^2, `weighted` T alpha times each of the weight images.
template <int C>
struct Contribution {
    struct Pixels {
        Vec T;
        Mask ended;
        Vec behind[C], gradient[C], weight[GROUP];  // behind: sum of T alpha channel of later ones, and the background
    };
    Vec value[C], opacity, importance = {}, error = {}, weighted[GROUP] = {};

    Contribution(const Splat &g, const float *channel) : opacity(splat(g.opacity)) {
        for (int c = 0; c < C; c++) value[c] = splat(channel[c]);
    }

    void strip(const Exponent &exponent, Pixels *pixels, int first, int last, int32_t rank) {
        for (int v = first; v <= last; v++) {
            Sample at(exponent, opacity, v, rank, pixels[v]);
            Vec along = {};
            for (int c = 0; c < C; c++) {
                Vec change = masked(at.varies(), opacity * (at.T * value[c] - pixels[v].behind[c] * at.inverse));
                importance += change * change;
                along += change * pixels[v].gradient[c];
                pixels[v].behind[c] += at.weight * value[c];
            }
            error += along * along;
            for (int r = 0; r < GROUP; r++) weighted[r] += at.weight * pixels[v].weight[r];
        }
    }
};

// A slot holds importance, error and one sum for each of `weight_count` weight images, of which this pass takes the GROUP
// from `first_weight` on.
template <int C>
void contributions_tile(const Tile &tile, int image_width, const Replay &replay, const float *channels,
                        const float *background, const float *weights, int weight_count, int first_weight,
                        const float *out_gradient, float *results) {
    auto fill = [&](typename Contribution<C>::Pixels &p, int lane, int64_t pixel) {
        for (int c = 0; c < C; c++) {
            p.behind[c][lane] = replay.transmittance[pixel] * background[c];
            p.gradient[c][lane] = out_gradient[pixel * C + c];
        }
        for (int r = 0; r < GROUP && first_weight + r < weight_count; r++)
            p.weight[r][lane] = weights[pixel * weight_count + first_weight + r];
    };
    replay_tile<Contribution<C>>(tile, image_width, replay, channels, C, fill, [&](Contribution<C> &job, int64_t slot) {
        float *to = results + slot * (2 + weight_count);
        to[0] = sum(job.importance);
        to[1] = sum(job.error);
        for (int r = 0; r < GROUP && first_weight + r < weight_count; r++) to[2 + first_weight + r] = sum(job.weighted[r]);
    });
}

template <int C>
struct Constant {
    static constexpr int value = C;
};

// Gaussians behind every pixel's end get no result.
void clear_slots(const Replay &replay, float *results, int64_t size) {
    for (int64_t i = replay.begin; i < replay.end; i++) memset(results + replay.slots[i] * size, 0, size * sizeof(float));
}

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

}  // namespace

API int64_t tile_size() { return TILE; }
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
        g.limit = g.opacity > 0 ? logf(g.opacity) + LOG255 : 0.f;
        keys[i] = NOT_DRAWN;
        if (!(radii[i] > 0 && depths[i] > 0 && g.limit > 0 && g.limit < 64 && a > 0 && c > 0 && det > 0)) continue;
        g.k = (float)(b / c);
        g.c = (float)(.5 * c);
        g.h = (float)(.5 * det / c);
        g.half_width = (float)sqrt(2 * g.limit * c / det);
        g.half_height = (float)sqrt(2 * g.limit * a / det);
        g.top = (float)(-b / a * g.half_height);
        bool finite = g.half_width < 1e9f && g.half_height < 1e9f && g.h > 0 && g.c < 1e9f;
        bool on_screen = g.x + g.half_width > 0 && g.x - g.half_width < width && g.y + g.half_height > 0 &&
                         g.y - g.half_height < height;
        if (finite && on_screen) memcpy(&keys[i], &depths[i], sizeof(float));
    }
}

// Indices of the drawable Gaussians by depth, equal depths by index; returns their number. Radix sort: positive floats
// order as their bits. `spare` holds n indices, `spare_keys` 2 n keys.
API int64_t sort_by_depth(int64_t n, const uint32_t *keys, int32_t *order, int32_t *spare, uint32_t *spare_keys) {
    uint32_t *from_keys = spare_keys, *to_keys = spare_keys + n;
    int32_t *from = spare, *to = order;
    int64_t drawable = 0;
    for (int64_t i = 0; i < n; i++)
        if (keys[i] != NOT_DRAWN) {
            from_keys[drawable] = keys[i];
            from[drawable++] = (int32_t)i;
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
API void count_tiles(int64_t begin, int64_t end, const Splat *splats, const int32_t *order, int64_t width, int64_t height,
                     int64_t *per_rank, int64_t *per_tile) {
    for (int64_t rank = begin; rank < end; rank++) {
        int64_t n = 0;
        for_tiles(splats[order[rank]], (int)width, (int)height, [&](int tile) { n++, per_tile[tile]++; });
        per_rank[rank] = n;
    }
}

// Writes those ranks into the tile lists: the Gaussian, and the slot its gradient in this tile goes to. `next` is where
// this range's entries of each tile begin; it is advanced.
API void fill_tiles(int64_t begin, int64_t end, const Splat *splats, const int32_t *order, int64_t width, int64_t height,
                    const int64_t *rank_starts, int32_t *ids, int32_t *slots, int64_t *next) {
    for (int64_t rank = begin; rank < end; rank++) {
        int64_t slot = rank_starts[rank];
        for_tiles(splats[order[rank]], (int)width, (int)height, [&](int tile) {
            int64_t place = next[tile]++;
            ids[place] = order[rank];
            slots[place] = (int32_t)slot++;
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

// Gradients of tiles [begin, end): a slot of moments and channel gradients per (Gaussian, tile), the background's per
// tile. Groups of channels add up, since the gradient is linear in them.
API void blend_backward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, const Splat *splats,
                        const float *channels, const int32_t *ids, const int32_t *slots, const int64_t *tile_starts,
                        const float *background, const float *transmittance, const int32_t *endings,
                        const float *out_gradient, const float *alpha_gradient, float *gradients,
                        float *background_gradient) {
    for (int64_t t = begin; t < end; t++) {
        Tile tile = tile_at((int)t, (int)width, (int)height);
        Replay replay = {splats, ids, slots, tile_starts[t], tile_starts[t + 1], transmittance, endings};
        clear_slots(replay, gradients, MOMENTS + channel_count);
        for (int c = 0; c < channel_count; c += GROUP)
            with_channels<GROUP>(smaller(GROUP, (int)channel_count - c), [&](auto count) {
                backward_tile<decltype(count)::value>(tile, width, replay, channels + c, channel_count, background + c,
                                                      out_gradient + c, alpha_gradient, c, gradients,
                                                      background_gradient + t * channel_count + c);
            });
    }
}

// Contributions of tiles [begin, end), a slot of 2 + weight_count sums per (Gaussian, tile); at most GROUP channels.
API void contributions(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, int64_t weight_count,
                       const Splat *splats, const float *channels, const int32_t *ids, const int32_t *slots,
                       const int64_t *tile_starts, const float *background, const float *transmittance,
                       const int32_t *endings, const float *weights, const float *out_gradient, float *results) {
    for (int64_t t = begin; t < end; t++) {
        Tile tile = tile_at((int)t, (int)width, (int)height);
        Replay replay = {splats, ids, slots, tile_starts[t], tile_starts[t + 1], transmittance, endings};
        clear_slots(replay, results, 2 + weight_count);
        for (int r = 0; r == 0 || r < weight_count; r += GROUP)
            with_channels<GROUP>((int)channel_count, [&](auto count) {
                contributions_tile<decltype(count)::value>(tile, width, replay, channels, background, weights, weight_count,
                                                           r, out_gradient, results);
            });
    }
}

// Sums the slots of ranks [begin, end) in their fixed order: sums (N, size).
API void gather_sums(int64_t begin, int64_t end, int64_t size, const int32_t *order, const int64_t *rank_starts,
                     const float *results, float *sums) {
    for (int64_t rank = begin; rank < end; rank++)
        for (int64_t slot = rank_starts[rank]; slot < rank_starts[rank + 1]; slot++)
            for (int64_t k = 0; k < size; k++) sums[order[rank] * size + k] += results[slot * size + k];
}

// Sums the slots of ranks [begin, end) in their fixed order and turns moments into gradients. With v = -dL/ds summed:
// ds = 2 c u (dy' + k dx' + dx k') + 2 h dx dx' + u^2 c' + dx^2 h', and c, k, h by the conic.
API void gather(int64_t begin, int64_t end, int64_t channel_count, const Splat *splats, const int32_t *order,
                const int64_t *rank_starts, const float *gradients, float *means2d, float *conics, float *opacities,
                float *channels) {
    int64_t size = MOMENTS + channel_count;
    for (int64_t rank = begin; rank < end; rank++) {
        int64_t i = order[rank];
        const Splat &g = splats[i];
        float moment[MOMENTS] = {};
        float *channel = channels + i * channel_count;
        for (int64_t slot = rank_starts[rank]; slot < rank_starts[rank + 1]; slot++) {
            const float *from = gradients + slot * size;
            for (int m = 0; m < MOMENTS; m++) moment[m] += from[m];
            for (int c = 0; c < channel_count; c++) channel[c] += from[MOMENTS + c];
        }
        float v = moment[0], vx = moment[1], vu = moment[2], vxx = moment[3], vxu = moment[4], vuu = moment[5];
        means2d[2 * i] = -2 * (g.c * g.k * vu + g.h * vx);
        means2d[2 * i + 1] = -2 * g.c * vu;
        conics[3 * i] = -.5f * vxx;
        conics[3 * i + 1] = g.k * vxx - vxu;
        conics[3 * i + 2] = g.k * vxu - .5f * (vuu + g.k * g.k * vxx);
        opacities[i] = v / g.opacity;
    }
}
