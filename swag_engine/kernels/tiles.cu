// Which tiles each projected Gaussian meets: packing, and the list of (Gaussian, tile) pairs that is then sorted by
// tile.
#include "splat.cuh"

// Packs n Gaussians and writes their depth keys, infinity for those that cannot be drawn. The comparisons are written
// so that NaN is never drawn.
KERNEL(4)
pack(Index n, const float *means2d, const float *conics, const float *opacities, const float *depths,
     const float *radii, Index width, Index height, Splat *splats, float *keys) {
    Index i = thread_index();
    if (i >= n) return;
    float a = conics[3 * i], b = conics[3 * i + 1], c = conics[3 * i + 2], bb = b * b;
    float det = fmaf(a, c, -bb) + fmaf(-b, b, bb);  // a c - b^2 with the rounding of b^2 put right (Kahan): for needles
    Splat g = {means2d[2 * i], means2d[2 * i + 1]};
    g.opacity = opacities[i];
    g.limit = g.opacity > 0 ? logf(g.opacity) + LOG255 : 0;
    keys[i] = __int_as_float(0x7f800000);
    if (!(radii[i] > 0 && depths[i] > 0 && g.limit > 0 && g.limit < 64 && a > 0 && c > 0 && det > 0)) return;
    g.k = b / c;
    g.c = .5f * c;
    g.h = .5f * det / c;
    g.half_width = sqrtf(2 * g.limit * c / det);
    g.half_height = sqrtf(2 * g.limit * a / det);
    g.top = -b / a * g.half_height;
    bool finite = g.half_width < 1e9f && g.half_height < 1e9f && g.h > 0 && g.c < 1e9f;
    bool on_screen =
        g.x + g.half_width > 0 && g.x - g.half_width < width && g.y + g.half_height > 0 && g.y - g.half_height < height;
    splats[i] = g;
    if (finite && on_screen) keys[i] = depths[i];
}

// Calls visit(column, first row, last row) for the tiles whose pixel centres the ellipse may meet, by columns of tiles.
template <class Visit>
__device__ inline void for_tile_columns(const Splat &g, Index width, Index height, Visit visit) {
    int first = (int)fmaxf(0, g.x - g.half_width - .51f) / TILE;
    int last = (int)fminf(width - 1, g.x + g.half_width - .49f) / TILE;
    for (int column = first; column <= last; column++) {
        float left = column * TILE + .5f - g.x, low, high;
        rows_over_columns(g, left, left + (fminf(TILE, width - column * TILE) - 1), low, high);
        low = fmaxf(0, ceilf(g.y + low - .5f));
        high = fminf(height - 1, floorf(g.y + high - .5f));
        if (low <= high) visit(column, (int)low / TILE, (int)high / TILE);
    }
}

// How many tiles the Gaussian of each of n ranks of the depth order meets; `keys` are in that order.
KERNEL(4)
count_tiles(Index n, const Splat *splats, const float *keys, const Index *order, Index width, Index height,
            Index *counts) {
    Index rank = thread_index();
    if (rank >= n) return;
    Index count = 0;
    if (keys[rank] < __int_as_float(0x7f800000))
        for_tile_columns(splats[order[rank]], width, height,
                         [&](int, int first, int last) { count += last - first + 1; });
    counts[rank] = count;
}

// Writes each rank's pairs to their slots: the tile and the Gaussian. A slot's gradients are written by its tile.
template <class Key>
__device__ inline void fill(Index n, const Splat *splats, const Index *order, Index width, Index height,
                            const Index *rank_starts, Key *tiles, int *ids) {
    Index rank = thread_index();
    if (rank >= n || rank_starts[rank] == rank_starts[rank + 1]) return;
    Index i = order[rank], slot = rank_starts[rank], across = (width + TILE - 1) / TILE;
    for_tile_columns(splats[i], width, height, [&](int column, int first, int last) {
        for (int row = first; row <= last; row++, slot++) {
            tiles[slot] = (Key)(row * across + column);
            ids[slot] = (int)i;
        }
    });
}

KERNEL(4)
fill_tiles_int16(Index n, const Splat *splats, const Index *order, Index width, Index height, const Index *rank_starts,
                 short *tiles, int *ids) {
    fill(n, splats, order, width, height, rank_starts, tiles, ids);
}

KERNEL(4)
fill_tiles_int32(Index n, const Splat *splats, const Index *order, Index width, Index height, const Index *rank_starts,
                 int *tiles, int *ids) {
    fill(n, splats, order, width, height, rank_starts, tiles, ids);
}
