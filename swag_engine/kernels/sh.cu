// Color by direction: real spherical harmonics up to degree 3, constants and order of reference/harmonics.py. One thread
// per Gaussian and color channel.
#include "common.cuh"
#include "constants.h"

constexpr int MAX_BASIS = 16;  // basis functions of degree 3

__device__ inline void basis_at(const float *direction, float *basis) {
    float x = direction[0], y = direction[1], z = direction[2], xx = x * x, yy = y * y, zz = z * z;
    const float c1 = constants::SH_C1, c2 = constants::SH_C2_0, c3 = constants::SH_C3_0, c4 = constants::SH_C3_2;
    basis[0] = constants::SH_C0;
    basis[1] = -c1 * y;
    basis[2] = c1 * z;
    basis[3] = -c1 * x;
    basis[4] = c2 * x * y;
    basis[5] = -c2 * y * z;
    basis[6] = (float)constants::SH_C2_1 * (2 * zz - xx - yy);
    basis[7] = -c2 * x * z;
    basis[8] = (float)constants::SH_C2_2 * (xx - yy);
    basis[9] = -c3 * y * (3 * xx - yy);
    basis[10] = (float)constants::SH_C3_1 * x * y * z;
    basis[11] = -c4 * y * (4 * zz - xx - yy);
    basis[12] = (float)constants::SH_C3_3 * z * (2 * zz - 3 * xx - 3 * yy);
    basis[13] = -c4 * x * (4 * zz - xx - yy);
    basis[14] = (float)constants::SH_C3_4 * z * (xx - yy);
    basis[15] = -c3 * x * (xx - 3 * yy);
}

// colors (N, 3) = max(0, 1/2 + sum_k sh_k Y_k). sh0 (N, 3) is the constant coefficient, shN (N, higher, 3) holds the
// others, of which `degree` says how many count; directions (N, 3).
KERNEL(4)
sh_forward(Index n, Index higher, Index degree, const float *sh0, const float *shN, const float *directions,
           float *colors) {
    Index at = thread_index(), i = at / 3, c = at % 3, used = (degree + 1) * (degree + 1) - 1;
    if (i >= n) return;
    float basis[MAX_BASIS];
    basis_at(directions + 3 * i, basis);
    const float *from = shN + 3 * higher * i + c;
    float color = .5f + basis[0] * sh0[at];
#pragma unroll
    for (int k = 0; k < MAX_BASIS - 1; k++)
        if (k < used) color += basis[k + 1] * from[3 * k];
    colors[at] = color < 0 ? 0 : color;  // NaN stays NaN
}

// The gradients by sh0 and shN, zero where the color was clamped and for coefficients beyond the degree.
KERNEL(4)
sh_backward(Index n, Index higher, Index degree, const float *directions, const float *colors, const float *by_colors,
            float *by_sh0, float *by_shN) {
    Index at = thread_index(), i = at / 3, c = at % 3, used = (degree + 1) * (degree + 1) - 1;
    if (i >= n) return;
    float basis[MAX_BASIS], gradient = colors[at] == 0 ? 0 : by_colors[at];
    basis_at(directions + 3 * i, basis);
    by_sh0[at] = basis[0] * gradient;
    float *to = by_shN + 3 * higher * i + c;
#pragma unroll
    for (int k = 0; k < MAX_BASIS - 1; k++)
        if (k < higher) to[3 * k] = k < used ? basis[k + 1] * gradient : 0;
}
