// Blends one scene forward and backward through the functions of raster.h, for processors that Python does not run on here.
//     raster_program SCENE RESULTS
// SCENE: int64 n, width, height, channels; floats means2d, conics, opacities, depths, radii, channels, background, and the
// gradients by the image and by alpha. RESULTS: floats image, transmittance, and the gradients by means2d, conics,
// opacities and channels.
#include "raster.h"

#include <stdio.h>
#include <stdlib.h>

static void *zeros(int64_t count, int64_t size) {
    int64_t bytes = (count * size + 63) / 64 * 64 + 64;
    return memset(aligned_alloc(64, bytes), 0, bytes);
}
static float *floats(int64_t count) { return (float *)zeros(count, 4); }

int main(int, char **files) {
    FILE *scene = fopen(files[1], "rb"), *results = fopen(files[2], "wb");
    int64_t sizes[4];
    if (fread(sizes, 8, 4, scene) != 4) return 1;
    int64_t n = sizes[0], width = sizes[1], height = sizes[2], channels = sizes[3], pixels = width * height;
    const int64_t counts[] = {2 * n, 3 * n, n, n, n, n * channels, channels, pixels * channels, pixels};
    float *given[9];
    for (int i = 0; i < 9; i++) {
        given[i] = floats(counts[i]);
        if ((int64_t)fread(given[i], 4, counts[i], scene) != counts[i]) return 1;
    }
    Splat *splats = (Splat *)zeros(n, splat_bytes());
    uint32_t *keys = (uint32_t *)zeros(n, 4), *spare_keys = (uint32_t *)zeros(2 * n, 4);
    int32_t *order = (int32_t *)zeros(n, 4), *spare = (int32_t *)zeros(n, 4);
    pack(0, n, given[0], given[1], given[2], given[3], given[4], width, height, splats, keys);
    int64_t drawable = sort_by_depth(n, keys, order, spare, spare_keys);
    int64_t tiles = ((width + tile_width() - 1) / tile_width()) * ((height + tile_height() - 1) / tile_height());
    int64_t *rank_starts = (int64_t *)zeros(drawable + 1, 8), *tile_starts = (int64_t *)zeros(tiles + 1, 8);
    int64_t *next = (int64_t *)zeros(tiles, 8);
    count_tiles(0, drawable, splats, order, width, height, rank_starts + 1, next);
    int64_t pairs = start_lists(drawable, tiles, 1, rank_starts, next, tile_starts);
    int32_t *ids = (int32_t *)zeros(pairs, 4), *places = (int32_t *)zeros(pairs, 4), *endings = (int32_t *)zeros(pixels, 4);
    fill_tiles(0, drawable, splats, order, width, height, rank_starts, ids, places, next);

    float *image = floats(pixels * channels), *transmittance = floats(pixels);
    float *gradients = floats(pairs * (moment_count() + channels)), *by_background = floats(tiles * channels);
    blend_forward(0, tiles, width, height, channels, splats, given[5], ids, tile_starts, given[6], image, transmittance, endings);
    blend_backward(0, tiles, width, height, channels, splats, given[5], ids, tile_starts, given[6], transmittance,
                   endings, given[7], given[8], gradients, by_background);
    float *means2d = floats(2 * n), *conics = floats(3 * n), *opacities = floats(n), *by_channel = floats(n * channels);
    gather(0, n, drawable, channels, splats, order, rank_starts, places, gradients, means2d, conics, opacities, by_channel);

    fwrite(image, 4, pixels * channels, results);
    fwrite(transmittance, 4, pixels, results);
    fwrite(means2d, 4, 2 * n, results);
    fwrite(conics, 4, 3 * n, results);
    fwrite(opacities, 4, n, results);
    fwrite(by_channel, 4, n * channels, results);
    return fclose(results);
}
