// A projected Gaussian as it is blended. raster.cpp says how its numbers follow from the conic.
#pragma once
#include "common.cuh"
#include "constants.h"

constexpr int TILE = 16;                    // width and height, pixels; a tile is a block, a pixel a thread
constexpr float MAX_ALPHA = constants::MAX_ALPHA;                  // the backward pass divides by 1 - alpha
constexpr float MIN_TRANSMITTANCE = constants::MIN_TRANSMITTANCE;  // at which a pixel ends
constexpr float LOG2E = 1.44269504f;        // log2(e): from e^x to 2^x
constexpr float LOG255 = constants::LOG255;                        // ln(255): alpha falls below 1/255 where s > ln(255 opacity)
constexpr float ROW_MARGIN = .01f;          // pixels; for rounding, since each pixel is tested again

struct alignas(8) Splat {
    float x, y, k, c, h, opacity;
    float limit;                    // largest s that is not skipped
    float half_width, half_height;  // of the ellipse s = limit
    float top;                      // x offset of the point at +half_height
};

// The y offsets [low, high] that the ellipse reaches over the x offsets [left, right]; low > high where it does not.
__device__ inline void rows_over_columns(const Splat &g, float left, float right, float &low, float &high) {
    left = fmaxf(left, -g.half_width);
    right = fminf(right, g.half_width);
    float inverse_c = 1 / g.c;
    float reach_left = sqrtf(fmaxf((g.limit - g.h * left * left) * inverse_c, 0.f));
    float reach_right = sqrtf(fmaxf((g.limit - g.h * right * right) * inverse_c, 0.f));
    low = fminf(-g.k * left - reach_left, -g.k * right - reach_right);
    high = fmaxf(-g.k * left + reach_left, -g.k * right + reach_right);
    if (left <= g.top && g.top <= right) high = g.half_height;
    if (left <= -g.top && -g.top <= right) low = -g.half_height;
    low = left <= right ? low - ROW_MARGIN : 1;
    high = left <= right ? high + ROW_MARGIN : -1;
}
