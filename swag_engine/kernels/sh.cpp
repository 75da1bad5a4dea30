// Color by direction.
#include "sh.h"
#include "simd.h"

// colors (N, 3) = max(0, 1/2 + sum_k sh_k Y_k) of Gaussians [begin, end). sh0 (N, 3) is the constant coefficient, shN
// (N, higher, 3) holds the others, of which `degree` says how many count; directions (N, 3).
API void sh_forward(int64_t begin, int64_t end, int64_t higher, int64_t degree, const float *sh0, const float *shN,
                    const float *directions, float *colors) {
    int64_t used = (degree + 1) * (degree + 1) - 1;
    for (int64_t i = begin; i < end; i++) {
        float basis[MAX_BASIS], color[3];
        basis_at(directions + 3 * i, degree, basis);
        const float *from = shN + 3 * higher * i;
        for (int c = 0; c < 3; c++) color[c] = .5f + basis[0] * sh0[3 * i + c];
        for (int64_t k = 0; k < used; k++)
            for (int c = 0; c < 3; c++) color[c] += basis[k + 1] * from[3 * k + c];
        for (int c = 0; c < 3; c++) colors[3 * i + c] = color[c] < 0 ? 0 : color[c];  // NaN stays NaN
    }
}

// The gradients by sh0 and shN, zero where the color was clamped and for coefficients beyond the degree.
API void sh_backward(int64_t begin, int64_t end, int64_t higher, int64_t degree, const float *directions,
                     const float *colors, const float *by_colors, float *by_sh0, float *by_shN) {
    int64_t used = (degree + 1) * (degree + 1) - 1;
    for (int64_t i = begin; i < end; i++) {
        float basis[MAX_BASIS], gradient[3];
        basis_at(directions + 3 * i, degree, basis);
        for (int c = 0; c < 3; c++) {
            gradient[c] = colors[3 * i + c] == 0 ? 0 : by_colors[3 * i + c];
            by_sh0[3 * i + c] = basis[0] * gradient[c];
        }
        float *to = by_shN + 3 * higher * i;
        for (int64_t k = 0; k < used; k++)
            for (int c = 0; c < 3; c++) to[3 * k + c] = basis[k + 1] * gradient[c];
        for (int64_t k = 3 * used; k < 3 * higher; k++) to[k] = 0;
    }
}
