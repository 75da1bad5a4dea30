// Colour by direction: real spherical harmonics up to degree 3, the constants and order of gaussians/sh.py.
#include "simd.h"

namespace {

constexpr int MAX_BASIS = 16;

void basis_at(const float *direction, int64_t degree, float *basis) {
    float x = direction[0], y = direction[1], z = direction[2], xx = x * x, yy = y * y, zz = z * z;
    basis[0] = .28209479177387814f;
    if (degree < 1) return;
    const float c1 = .4886025119029199f;
    basis[1] = -c1 * y;
    basis[2] = c1 * z;
    basis[3] = -c1 * x;
    if (degree < 2) return;
    const float c2 = 1.0925484305920792f;
    basis[4] = c2 * x * y;
    basis[5] = -c2 * y * z;
    basis[6] = .31539156525252005f * (2 * zz - xx - yy);
    basis[7] = -c2 * x * z;
    basis[8] = .5462742152960396f * (xx - yy);
    if (degree < 3) return;
    const float c3 = .5900435899266435f, c4 = .4570457994644658f;
    basis[9] = -c3 * y * (3 * xx - yy);
    basis[10] = 2.890611442640554f * x * y * z;
    basis[11] = -c4 * y * (4 * zz - xx - yy);
    basis[12] = .3731763325901154f * z * (2 * zz - 3 * xx - 3 * yy);
    basis[13] = -c4 * x * (4 * zz - xx - yy);
    basis[14] = 1.445305721320277f * z * (xx - yy);
    basis[15] = -c3 * x * (xx - 3 * yy);
}

}  // namespace

// colors (N, 3) = max(0, 1/2 + sum_k sh_k Y_k) of Gaussians [begin, end); sh (N, coefficients, 3), directions (N, 3).
API void sh_forward(int64_t begin, int64_t end, int64_t coefficients, int64_t degree, const float *sh,
                    const float *directions, float *colors) {
    int64_t used = (degree + 1) * (degree + 1);
    for (int64_t i = begin; i < end; i++) {
        float basis[MAX_BASIS], color[3] = {.5f, .5f, .5f};
        basis_at(directions + 3 * i, degree, basis);
        const float *from = sh + 3 * coefficients * i;
        for (int64_t k = 0; k < used; k++)
            for (int c = 0; c < 3; c++) color[c] += basis[k] * from[3 * k + c];
        for (int c = 0; c < 3; c++) colors[3 * i + c] = color[c] < 0 ? 0 : color[c];  // NaN stays NaN
    }
}

// The gradient by sh (N, coefficients, 3), zero where the colour was clamped and for coefficients beyond the degree.
API void sh_backward(int64_t begin, int64_t end, int64_t coefficients, int64_t degree, const float *directions,
                     const float *colors, const float *color_gradients, float *sh_gradients) {
    int64_t used = (degree + 1) * (degree + 1);
    for (int64_t i = begin; i < end; i++) {
        float basis[MAX_BASIS], gradient[3];
        basis_at(directions + 3 * i, degree, basis);
        for (int c = 0; c < 3; c++) gradient[c] = colors[3 * i + c] == 0 ? 0 : color_gradients[3 * i + c];
        float *to = sh_gradients + 3 * coefficients * i;
        for (int64_t k = 0; k < used; k++)
            for (int c = 0; c < 3; c++) to[3 * k + c] = basis[k] * gradient[c];
        memset(to + 3 * used, 0, (coefficients - used) * 3 * sizeof(float));
    }
}
