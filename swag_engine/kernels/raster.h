// Binning and blending of projected Gaussians, forward and backward (Kernels.blend in protocol.py), callable from Python
// through ctypes and from other kernels. The caller owns all buffers and threads; work is given as ranges [begin, end).
//
// Order of calls, with N Gaussians, V of them drawable, P (Gaussian, tile) pairs, images (height, width):
//     pack            Gaussians [0, N)
//     sort_by_depth   once
//     count_tiles     ranks [0, V) of the depth order, in one or more ranges
//     start_lists     once
//     fill_tiles      ranks [0, V), in the same ranges
//     blend_forward   tiles [0, T)
//     blend_backward  tiles [0, T)
//     gather          ranks [0, N)
// Tiles are numbered row by row, T = ceil(width / tile_width()) * ceil(height / tile_height()).
#pragma once
#include "simd.h"

struct Splat;  // a packed Gaussian: splat_bytes() bytes; arrays of them begin at a multiple of 64 bytes

API int64_t tile_width();    // pixels
API int64_t tile_height();   // pixels
API int64_t splat_bytes();
API int64_t moment_count();  // floats of geometry for each place in `gradients`

// Packs Gaussians [begin, end) and writes their depth keys (N,); those that cannot be drawn get the largest key.
// means2d (N, 2) and radii (N,) in pixels, conics (N, 3) in 1/pixel^2, opacities (N,), depths (N,).
API void pack(int64_t begin, int64_t end, const float *means2d, const float *conics, const float *opacities,
              const float *depths, const float *radii, int64_t width, int64_t height, Splat *splats, uint32_t *keys);

// Writes the indices of the drawable Gaussians by depth, equal depths by index, to `order` (N,), and those of the others after
// them; returns the number V of drawable ones. `spare` holds N indices, `spare_keys` 2 N keys.
API int64_t sort_by_depth(int64_t n, const uint32_t *keys, int32_t *order, int32_t *spare, uint32_t *spare_keys);

// For ranks [begin, end) of the depth order: how many tiles each Gaussian meets (V,), and adds to per_tile (T,), which is
// this range's own, how many of them fall in each tile.
API void count_tiles(int64_t begin, int64_t end, const Splat *splats, const int32_t *order, int64_t width, int64_t height,
                     int64_t *per_rank, int64_t *per_tile);

// Turns rank_starts (V + 1,), of which all but the first are the counts of `count_tiles`, into the first pair of each rank,
// and per_tile (ranges, T) into the place where each range's entries of each tile begin. Writes tile_starts
// (T + 1,), the first place of each tile's list. Returns P.
API int64_t start_lists(int64_t drawable, int64_t tiles, int64_t ranges, int64_t *rank_starts, int64_t *per_tile,
                        int64_t *tile_starts);

// Writes those ranks into the tile lists, `ids` (P,) the Gaussians by place, and `places` (P,) the places in these lists by
// rank. rank_starts (V + 1,): the first pair of each rank. `next` (T,): where this range's entries of each tile begin; it is
// advanced.
API void fill_tiles(int64_t begin, int64_t end, const Splat *splats, const int32_t *order, int64_t width, int64_t height,
                    const int64_t *rank_starts, int32_t *ids, int32_t *places, int64_t *next);

// Blends tiles [begin, end). channels (N, channel_count), tile_starts (T + 1,), background (channel_count,). Writes out
// (height, width, channel_count), transmittance (height, width) and endings (height, width): the place in its tile's list
// of the Gaussian before which a pixel ended, or the list's length.
API void blend_forward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, const Splat *splats,
                       const float *channels, const int32_t *ids, const int64_t *tile_starts, const float *background,
                       float *out, float *transmittance, int32_t *endings);

// Gradients of tiles [begin, end), given those by the image (height, width, channel_count) and by alpha = 1 -
// transmittance (height, width), none where that is null. Writes `gradients` (P, moment_count() + channel_count) by place in
// the tile lists, and the background's gradient by tile (T, channel_count).
API void blend_backward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, const Splat *splats,
                        const float *channels, const int32_t *ids, const int64_t *tile_starts,
                        const float *background, const float *transmittance, const int32_t *endings,
                        const float *out_gradient, const float *alpha_gradient, float *gradients,
                        float *background_gradient);

// Adds up the gradients of ranks [begin, end) in a fixed order and turns them into those of means2d, conics, opacities and
// channels, 0 for Gaussians that are not drawable.
API void gather(int64_t begin, int64_t end, int64_t drawable, int64_t channel_count, const Splat *splats, const int32_t *order,
                const int64_t *rank_starts, const int32_t *places, const float *gradients, float *means2d, float *conics,
                float *opacities, float *channels);

// Contributions of tiles [begin, end) (Kernels.contributions), for at most 8 channels. weights (height, width,
// weight_count). Writes `results` (P, 2 + weight_count): importance, error and the weighted sums by place in
// the tile lists.
API void contributions(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, int64_t weight_count,
                       const Splat *splats, const float *channels, const int32_t *ids,
                       const int64_t *tile_starts, const float *background, const float *transmittance,
                       const int32_t *endings, const float *weights, const float *out_gradient, float *results);

// Adds the results of ranks [begin, end) in a fixed order to sums (N, size).
API void gather_sums(int64_t begin, int64_t end, int64_t size, const int32_t *order, const int64_t *rank_starts,
                     const int32_t *places, const float *results, float *sums);
