// Blends tiles of projected Gaussians, forward and back to front; raster.cpp says what is computed.
//
// A block is a tile of 16 x 16 pixels, a warp a part of it of 8 x 4. The tile's Gaussians come through shared memory in
// batches. The thread that loads one finds which warps' pixels its ellipse may meet; each warp visits only its own.
#include "splat.cuh"

constexpr int BATCH = 128;                 // Gaussians in shared memory
constexpr int MOMENTS = 6;                 // sums of v times 1, dx, u, dx^2, dx u, u^2
constexpr int WEIGHTS = 6;                 // weight images of contributions in one pass: what registers hold
constexpr int PART_WIDTH = 8;              // width of a warp's pixels
constexpr int PART_HEIGHT = 4;             // height of a warp's pixels
constexpr int BANDS = TILE / PART_HEIGHT;  // warp w is in column w / BANDS, band w % BANDS

// Bit w is set where the ellipse may meet pixels of warp w of the tile with this corner.
__device__ inline unsigned warps_met(const Splat &g, int tile_x, int tile_y) {
    unsigned warps = 0;
    for (int column = 0; column < TILE / PART_WIDTH; column++) {
        float left = tile_x + column * PART_WIDTH + .5f - g.x, low, high;
        rows_over_columns(g, left, left + (PART_WIDTH - 1), low, high);
        float to_row = g.y - .5f - tile_y;
        float first = fmaxf(ceilf(low + to_row), 0), last = fminf(floorf(high + to_row), TILE - 1);
        if (first <= last)
            warps |= ((2u << (int)last / PART_HEIGHT) - (1u << (int)first / PART_HEIGHT)) << (column * BANDS);
    }
    return warps;
}

// A thread's pixel.
struct Pixel {
    int lane, warp, tile_x, tile_y, x, y;
    bool inside;
    Index index;

    __device__ Pixel(Index width, Index height) {
        int across = (int)((width + TILE - 1) / TILE);
        lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
        tile_x = blockIdx.x % across * TILE, tile_y = blockIdx.x / across * TILE;
        x = tile_x + warp / BANDS * PART_WIDTH + lane % PART_WIDTH;
        y = tile_y + warp % BANDS * PART_HEIGHT + lane / PART_WIDTH;
        inside = x < width && y < height;
        index = y * width + x;
    }
};

// The pairs by tile, and what they refer to. channels (N, stride) begin at the group's first channel, as images do.
struct Lists {
    const Splat *splats;
    const float *channels;
    Index stride;
    const int *ids;
    const Index *tile_starts;
};

// A Gaussian at a pixel: s = -exponent log(2), u = dy + k dx.
struct Sample {
    float dx, u, exponent, opacity;
    bool drawn;
    __device__ float unclamped() const { return opacity * exp2f(exponent); }
};

template <int C>
struct Batch {
    float4 place[BATCH];  // x, y, k, opacity
    float4 shape[BATCH];  // of the exponent, in base 2: c, h, limit
    float channel[BATCH][C];
    unsigned warps[BATCH];  // that it may meet

    // By all threads: the pairs [start, start + count).
    __device__ void load(const Lists &lists, Index start, int count, const Pixel &pixel) {
        int i = threadIdx.x;
        if (i < BATCH) warps[i] = 0;
        if (i < count) {
            const Splat g = lists.splats[lists.ids[start + i]];
            place[i] = make_float4(g.x, g.y, g.k, g.opacity);
            shape[i] = make_float4(-LOG2E * g.c, -LOG2E * g.h, -LOG2E * g.limit, 0);
            warps[i] = warps_met(g, pixel.tile_x, pixel.tile_y);
        }
#pragma unroll 1
        for (i = threadIdx.x; i < count * C; i += THREADS)
            channel[i / C][i % C] = lists.channels[lists.ids[start + i / C] * lists.stride + i % C];
    }

    // Forward and backward decide by the same instructions what is drawn: the fused ones are written out.
    __device__ Sample at(int i, const Pixel &pixel) const {
        float4 p = place[i], q = shape[i];
        float dx = p.x - (pixel.x + .5f), u = fmaf(p.z, dx, p.y - (pixel.y + .5f));
        float exponent = fmaf(q.x * u, u, q.y * dx * dx);
        return {dx, u, exponent, p.w, exponent >= q.z};
    }
};

// out (H, W, stride), transmittance (H, W), endings (H, W): the rank in its tile's list at which a pixel ended.
template <int C>
__device__ inline void blend_forward(Index width, Index height, const Lists &lists, const float *background, float *out,
                                     float *transmittance, int *endings) {
    __shared__ Batch<C> batch;
    const Pixel pixel(width, height);
    const Index begin = lists.tile_starts[blockIdx.x], end = lists.tile_starts[blockIdx.x + 1];
    float T = 1, color[C] = {};
    int ended = (int)(end - begin);
    bool going = pixel.inside;
    for (Index start = begin; start < end && __syncthreads_or(going); start += BATCH) {
        int count = end - start < BATCH ? (int)(end - start) : BATCH;
        batch.load(lists, start, count, pixel);
        __syncthreads();
        for (int chunk = 0; chunk < count && __any_sync(ALL_LANES, going); chunk += WARP) {
            unsigned met = __ballot_sync(ALL_LANES, batch.warps[chunk + pixel.lane] >> pixel.warp & 1);
            for (; met; met &= met - 1) {
                int i = chunk + __ffs(met) - 1;
                const Sample sample = batch.at(i, pixel);
                if (!(going && sample.drawn)) continue;
                float weight = fminf(sample.unclamped(), MAX_ALPHA) * T, after = T - weight;
                if (after <= MIN_TRANSMITTANCE) {
                    going = false;
                    ended = (int)(start - begin) + i;
                } else {
                    T = after;
                    for (int c = 0; c < C; c++) color[c] += weight * batch.channel[i][c];
                }
            }
        }
    }
    if (!pixel.inside) return;
    transmittance[pixel.index] = T;
    endings[pixel.index] = ended;
    for (int c = 0; c < C; c++) out[pixel.index * lists.stride + c] = color[c] + T * background[c];
}

// How the forward pass left a pixel; one outside of the image ended before it began.
struct Ending {
    float T;
    int rank;
    __device__ Ending(const Pixel &pixel, const float *transmittance, const int *endings) {
        T = pixel.inside ? transmittance[pixel.index] : 1;
        rank = pixel.inside ? endings[pixel.index] : 0;
    }
};

// A Gaussian at a pixel in the pass back to front: T is in front of the Gaussian, inverse = 1 / (1 - alpha).
struct Drawn {
    float dx, u, opacity, unclamped, alpha, inverse, T;
};

// The gradients by channels and, as moments, by s. `behind` sums what the gradient meets behind the current Gaussian:
// (g . channel) T alpha of later ones and the background's part. dL/dalpha = T (g . channel) - behind / (1 - alpha),
// v = alpha dL/dalpha = -dL/ds.
template <int C>
struct Gradients {
    static constexpr int CHANNELS = C, SHARED = MOMENTS, VALUES = SHARED + C;
    float gradient[C] = {}, behind = 0;

    // The gradient by alpha = 1 - T comes with the first group of channels only.
    __device__ Gradients(const Pixel &pixel, float T, Index stride, Index first_channel, const float *background,
                         const float *out_gradient, const float *alpha_gradient) {
        if (!pixel.inside) return;
        if (first_channel == 0) behind = -alpha_gradient[pixel.index] * T;
        for (int c = 0; c < C; c++) {
            gradient[c] = out_gradient[pixel.index * stride + first_channel + c];
            behind += T * gradient[c] * background[first_channel + c];
        }
    }

    __device__ void add(const Drawn &at, const float *channel, float *values) {
        float along = 0, weight = at.alpha * at.T;
        for (int c = 0; c < C; c++) {
            along += gradient[c] * channel[c];
            values[MOMENTS + c] = weight * gradient[c];
        }
        float v = at.unclamped < MAX_ALPHA ? (at.T * along - behind * at.inverse) * at.unclamped : 0;
        behind += weight * along;
        float vx = v * at.dx, vu = v * at.u;
        values[0] = v, values[1] = vx, values[2] = vu;
        values[3] = vx * at.dx, values[4] = vu * at.dx, values[5] = vu * at.u;
    }
};

// |dC/dg|^2, (image_gradient . dC/dg)^2 and T alpha times WEIGHTS weights, with dC/dg = opacity T (channel - color
// behind it), which is 0 where alpha is clamped.
template <int C>
struct Contributions {
    static constexpr int CHANNELS = C, SHARED = 2, VALUES = SHARED + WEIGHTS;
    float gradient[C] = {}, behind[C] = {}, weight[WEIGHTS] = {};

    __device__ Contributions(const Pixel &pixel, Index weight_count, Index first_weight, const float *background,
                             const float *weights, const float *image_gradient) {
        if (!pixel.inside) return;
        for (int c = 0; c < C; c++) {
            behind[c] = background[c];
            gradient[c] = image_gradient[pixel.index * C + c];
        }
        for (int r = 0; r < WEIGHTS; r++)
            if (first_weight + r < weight_count) weight[r] = weights[pixel.index * weight_count + first_weight + r];
    }

    __device__ void add(const Drawn &at, const float *channel, float *values) {
        float change = at.unclamped < MAX_ALPHA ? at.opacity * at.T : 0, importance = 0, along = 0;
        for (int c = 0; c < C; c++) {
            float difference = channel[c] - behind[c];
            importance += difference * difference;
            along += gradient[c] * difference;
            behind[c] += at.alpha * difference;
        }
        values[0] = change * change * importance;
        values[1] = change * change * along * along;
        for (int r = 0; r < WEIGHTS; r++) values[2 + r] = at.alpha * at.T * weight[r];
    }
};

// Sums a pass's VALUES over the pixels of the tile into results (P, size), a slot per pair. The first SHARED values
// come with every group of channels; the others go behind them, from `offset` on, as far as the slot has room.
struct Slots {
    const Index *slots;
    float *results;
    Index size, offset;
    bool accumulate;  // shared values add to what earlier groups left

    template <class Pass>
    __device__ void store(Index pair, int value, float total) const {
        bool shared = value < Pass::SHARED;
        Index place = shared ? value : value + offset;
        if (place >= size) return;
        float *to = results + slots[pair] * size + place;
        *to = shared && accumulate ? *to + total : total;
    }
};

// Back to front from the final transmittance: T_i = T_(i+1) / (1 - alpha_i). Nothing cancels. Warps sum their pixels,
// then the tile sums its warps in their order, so that the result is always the same to the bit.
template <class Pass>
__device__ inline void blend_backward(const Lists &lists, const Slots &slots, const Pixel &pixel, const Ending &ending,
                                      Pass &pass) {
    constexpr int VALUES = Pass::VALUES;
    __shared__ Batch<Pass::CHANNELS> batch;
    __shared__ float partial[WARPS][WARP][VALUES];
    __shared__ unsigned drawn_by[WARPS];  // bit i: the warp drew Gaussian i of the chunk
    __shared__ int tile_ended;
    const Index begin = lists.tile_starts[blockIdx.x], end = lists.tile_starts[blockIdx.x + 1];
    const int own_value = lane_value<VALUES>(pixel.lane);

    float T = ending.T;
    int warp_ended = ending.rank;
    for (int step = WARP / 2; step; step /= 2)
        warp_ended = max(warp_ended, __shfl_xor_sync(ALL_LANES, warp_ended, step));
    if (threadIdx.x == 0) tile_ended = 0;
    __syncthreads();
    if (pixel.lane == 0) atomicMax(&tile_ended, warp_ended);
    __syncthreads();
#pragma unroll 1
    for (Index i = (Index)tile_ended * VALUES + threadIdx.x; i < (end - begin) * VALUES; i += THREADS)
        slots.store<Pass>(begin + i / VALUES, i % VALUES, 0);

    for (int stop = tile_ended; stop > 0; stop -= BATCH) {
        int start = max(stop - BATCH, 0), count = stop - start;
        batch.load(lists, begin + start, count, pixel);
        __syncthreads();
        for (int chunk = (count - 1) / WARP * WARP; chunk >= 0; chunk -= WARP) {
            bool meets = batch.warps[chunk + pixel.lane] >> pixel.warp & 1;
            unsigned met = __ballot_sync(ALL_LANES, meets && start + chunk + pixel.lane < warp_ended), drew = 0;
            while (met) {
                int bit = WARP - 1 - __clz(met), i = chunk + bit;
                met ^= 1u << bit;
                const Sample sample = batch.at(i, pixel);
                bool drawn = sample.drawn && start + i < ending.rank;
                if (!__any_sync(ALL_LANES, drawn)) continue;
                float values[VALUES] = {};
                if (drawn) {
                    float unclamped = sample.unclamped(), alpha = fminf(unclamped, MAX_ALPHA);
                    float inverse = __fdividef(1, 1 - alpha);
                    T *= inverse;
                    pass.add({sample.dx, sample.u, sample.opacity, unclamped, alpha, inverse, T}, batch.channel[i],
                             values);
                }
                float total = lane_sum(values, pixel.lane);
                if (own_value < VALUES) partial[pixel.warp][bit][own_value] = total;
                drew |= 1u << bit;
            }
            if (pixel.lane == 0) drawn_by[pixel.warp] = drew;
            __syncthreads();
#pragma unroll 1
            for (int i = threadIdx.x; i < min(WARP, count - chunk) * VALUES; i += THREADS) {
                int bit = i / VALUES, value = i % VALUES;
                float total = 0;
                for (int w = 0; w < WARPS; w++)
                    if (drawn_by[w] >> bit & 1) total += partial[w][bit][value];
                slots.store<Pass>(begin + start + chunk + bit, value, total);
            }
            __syncthreads();
        }
    }
}

// Kernels for C channels from first_channel on, of channel_count.
#define BLEND(C)                                                                                                    \
    KERNEL(5)                                                                                                       \
    blend_forward_##C(Index width, Index height, Index channel_count, Index first_channel, const Splat *splats,     \
                      const float *channels, const int *ids, const Index *tile_starts, const float *background,     \
                      float *out, float *transmittance, int *endings) {                                             \
        const Lists lists = {splats, channels + first_channel, channel_count, ids, tile_starts};                    \
        blend_forward<C>(width, height, lists, background + first_channel, out + first_channel, transmittance,      \
                         endings);                                                                                  \
    }                                                                                                               \
                                                                                                                    \
    /* gradients (P, MOMENTS + channel_count). Groups of channels add up, since the gradient is linear in them. */  \
    KERNEL(5)                                                                                                       \
    blend_backward_##C(Index width, Index height, Index channel_count, Index first_channel, const Splat *splats,    \
                       const float *channels, const int *ids, const Index *tile_starts, const float *background,    \
                       const float *transmittance, const int *endings, const Index *slot_of,                        \
                       const float *out_gradient, const float *alpha_gradient, float *gradients) {                  \
        const Lists lists = {splats, channels + first_channel, channel_count, ids, tile_starts};                    \
        const Slots slots = {slot_of, gradients, MOMENTS + channel_count, first_channel, first_channel > 0};        \
        const Pixel pixel(width, height);                                                                           \
        const Ending ending(pixel, transmittance, endings);                                                         \
        Gradients<C> pass(pixel, ending.T, channel_count, first_channel, background, out_gradient, alpha_gradient); \
        blend_backward(lists, slots, pixel, ending, pass);                                                          \
    }                                                                                                               \
                                                                                                                    \
    /* results (P, 2 + weight_count): importance, error, and the sums with weights from first_weight on. */         \
    KERNEL(4)                                                                                                       \
    contributions_##C(Index width, Index height, Index weight_count, Index first_weight, const Splat *splats,       \
                      const float *channels, const int *ids, const Index *tile_starts, const float *background,     \
                      const float *transmittance, const int *endings, const Index *slot_of, const float *weights,   \
                      const float *image_gradient, float *results) {                                                \
        const Lists lists = {splats, channels, C, ids, tile_starts};                                                \
        const Slots slots = {slot_of, results, 2 + weight_count, first_weight, false};                              \
        const Pixel pixel(width, height);                                                                           \
        const Ending ending(pixel, transmittance, endings);                                                         \
        Contributions<C> pass(pixel, weight_count, first_weight, background, weights, image_gradient);              \
        blend_backward(lists, slots, pixel, ending, pass);                                                          \
    }

BLEND(1)
BLEND(2)
BLEND(3)
BLEND(4)
BLEND(5)
BLEND(6)
BLEND(7)
BLEND(8)

// A Gaussian's slots lie one after the other; a warp sums those of one rank of the depth order, a lane each number.
// Returns the sum of number `value` of `size`.
__device__ inline float slot_sum(const float *results, Index size, Index begin, Index end, Index value) {
    float total = 0;
#pragma unroll 4
    for (Index slot = begin; slot < end; slot++) total += results[slot * size + value];
    return total;
}

// sums (N, size) of results (P, size).
KERNEL(4)
gather_sums(Index n, Index size, const Index *order, const Index *rank_starts, const float *results, float *sums) {
    Index rank = thread_index() / WARP;
    if (rank >= n) return;
    for (Index value = threadIdx.x % WARP; value < size; value += WARP)
        sums[order[rank] * size + value] = slot_sum(results, size, rank_starts[rank], rank_starts[rank + 1], value);
}

// Sums of gradients (P, MOMENTS + channel_count), with moments turned into gradients. With v = -dL/ds summed:
// ds = 2 c u (dy' + k dx' + dx k') + 2 h dx dx' + u^2 c' + dx^2 h', and c, k, h by the conic.
KERNEL(4)
gather_gradients(Index n, Index channel_count, const Splat *splats, const Index *order, const Index *rank_starts,
                 const float *gradients, float *means2d, float *conics, float *opacities, float *channels) {
    Index rank = thread_index() / WARP, size = MOMENTS + channel_count;
    if (rank >= n) return;
    int lane = threadIdx.x % WARP;
    Index i = order[rank], begin = rank_starts[rank], end = rank_starts[rank + 1];
    float total = lane < size ? slot_sum(gradients, size, begin, end, lane) : 0, moment[MOMENTS];
    for (int m = 0; m < MOMENTS; m++) moment[m] = __shfl_sync(ALL_LANES, total, m);
    for (Index value = lane; value < size; value += WARP) {
        if (value >= WARP) total = slot_sum(gradients, size, begin, end, value);
        if (value >= MOMENTS) channels[i * channel_count + value - MOMENTS] = total;
    }
    if (lane > 0) return;
    Splat g = {};
    if (begin < end) g = splats[i];
    float v = moment[0], vx = moment[1], vu = moment[2], vxx = moment[3], vxu = moment[4], vuu = moment[5];
    means2d[2 * i] = -2 * (g.c * g.k * vu + g.h * vx);
    means2d[2 * i + 1] = -2 * g.c * vu;
    conics[3 * i] = -.5f * vxx;
    conics[3 * i + 1] = g.k * vxx - vxu;
    conics[3 * i + 2] = g.k * vxu - .5f * (vuu + g.k * g.k * vxx);
    opacities[i] = begin < end ? v / g.opacity : 0;
}
