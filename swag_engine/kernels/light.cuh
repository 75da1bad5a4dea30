// Display values and linear light (sRGB, IEC 61966-2-1): the curve and its slope.
#pragma once
#include "constants.h"

constexpr float DISPLAY_TOE = constants::DISPLAY_TOE;  // display value below which the curve is a straight line
constexpr float LINEAR_TOE = constants::LINEAR_TOE;    // linear light at the same place

__device__ inline float to_light(float display, float &slope) {
    if (display <= DISPLAY_TOE) {
        slope = 1 / 12.92f;
        return display / 12.92f;
    }
    float base = (display + .055f) / 1.055f, power = powf(base, 1.4f);
    slope = 2.4f / 1.055f * power;
    return power * base;
}
__device__ inline float to_display(float light, float &slope) {
    if (light <= LINEAR_TOE) {
        slope = 12.92f;
        return light * 12.92f;
    }
    float power = powf(light, 1 / 2.4f);
    slope = 1.055f / 2.4f * power / light;
    return 1.055f * power - .055f;
}
