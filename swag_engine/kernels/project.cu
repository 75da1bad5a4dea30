// 3D Gaussians to 2D Gaussians, forward and backward, with the formulas of reference/projection.py: one thread per
// Gaussian. Double is slow on consumer cards, so only what would lose digits in float has it: camera coordinates (distant
// origins) and, for needles, the covariance, its determinant and their gradients. What differs between perspective and
// orthographic cameras is chosen when this is compiled.
#include "common.cuh"
#include "constants.h"

// As in reference/projection.py, which has the reasons.
constexpr float NEAR = constants::NEAR;              // scene units; the near plane
constexpr float BLUR = constants::BLUR;              // pixel^2, added to the variances: a low-pass filter
constexpr float GUARD = constants::GUARD;            // fraction of the field of view beyond the edges where the linearisation holds
constexpr float MAX_SIGMA = constants::MAX_SIGMA;    // pixels; larger Gaussians are flat over any image
constexpr float MAX_EXTENT = constants::MAX_EXTENT;  // squared, in standard deviations; of no opacity in 0..1

struct Camera {
    const double *viewmat;
    float r[3][3], fx, fy, cx, cy, left, right, top, bottom, max_sigma;  // guard band in x/z and y/z

    __device__ Camera(const double *viewmat, const float *K, float width, float height) : viewmat(viewmat) {
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) r[i][j] = (float)viewmat[4 * i + j];
        fx = K[0], fy = K[4], cx = K[2], cy = K[5];
        float guard_x = GUARD * width / (2 * fx), guard_y = GUARD * height / (2 * fy);
        left = -cx / fx - guard_x, right = (width - cx) / fx + guard_x;
        top = -cy / fy - guard_y, bottom = (height - cy) / fy + guard_y;
        max_sigma = MAX_SIGMA / fmaxf(fx, fy);
    }
};

// One Gaussian as the camera sees it, with what the backward pass needs again.
template <bool ORTHOGRAPHIC>
struct Projected {
    float z, u, v;                   // u = x/z, v = y/z; orthographic: u = x, v = y
    bool u_held, v_held;             // beyond the guard band
    float row[2][3];                 // J R
    float inverse_norm, w, x, y, q;  // of the quaternion; unit w, x, y, q (for z)
    float axis[3][3];                // axis[k]: column k of the rotation matrix
    float sigma[3], along[2][3];     // along[d][k] = row[d] . axis[k]
    float xx, xy, yy;                // covariance
    double A, B, C;                  // conic

    // False where the Gaussian is behind the near plane or not finite.
    __device__ bool from(const Camera &camera, const float *mean, const float *quat, const float *scale) {
        float p[3], zero = 0;  // stays 0 while all that is added to it is finite
        for (int i = 0; i < 3; i++) {
            const double *row = camera.viewmat + 4 * i;
            p[i] = (float)(row[0] * mean[0] + row[1] * mean[1] + row[2] * mean[2] + row[3]);
            zero += 0.f * p[i] + 0.f * scale[i];
        }
        z = p[2];
        float largest = 0;
        for (int i = 0; i < 4; i++) {
            zero += 0.f * quat[i];
            largest = fmaxf(largest, fabsf(quat[i]));
        }
        if (!(z > NEAR && zero == 0)) return false;
        if constexpr (ORTHOGRAPHIC) {
            u = p[0], v = p[1];
            for (int i = 0; i < 3; i++) row[0][i] = camera.fx * camera.r[0][i], row[1][i] = camera.fy * camera.r[1][i];
        } else {
            u = p[0] / z, v = p[1] / z;
            float held_u = fminf(fmaxf(u, camera.left), camera.right);
            float held_v = fminf(fmaxf(v, camera.top), camera.bottom);
            u_held = held_u != u, v_held = held_v != v;
            for (int i = 0; i < 3; i++) {
                row[0][i] = camera.fx / z * (camera.r[0][i] - held_u * camera.r[2][i]);
                row[1][i] = camera.fy / z * (camera.r[1][i] - held_v * camera.r[2][i]);
            }
        }
        float shrink = largest > 1e15f ? 1e-20f : 1.f;  // so that the squares stay below infinity
        w = quat[0] * shrink, x = quat[1] * shrink, y = quat[2] * shrink, q = quat[3] * shrink;
        float scaling = 1 / sqrtf(fmaxf(w * w + x * x + y * y + q * q, 1e-12f));
        w *= scaling, x *= scaling, y *= scaling, q *= scaling;
        inverse_norm = scaling * shrink;
        axis[0][0] = 1 - 2 * (y * y + q * q), axis[0][1] = 2 * (x * y + w * q), axis[0][2] = 2 * (x * q - w * y);
        axis[1][0] = 2 * (x * y - w * q), axis[1][1] = 1 - 2 * (x * x + q * q), axis[1][2] = 2 * (y * q + w * x);
        axis[2][0] = 2 * (x * q + w * y), axis[2][1] = 2 * (y * q - w * x), axis[2][2] = 1 - 2 * (x * x + y * y);
        double m[2][3];
        for (int k = 0; k < 3; k++) {
            sigma[k] = fminf(scale[k], ORTHOGRAPHIC ? camera.max_sigma : camera.max_sigma * z);
            for (int d = 0; d < 2; d++) {
                along[d][k] = row[d][0] * axis[k][0] + row[d][1] * axis[k][1] + row[d][2] * axis[k][2];
                m[d][k] = along[d][k] * sigma[k];
            }
        }
        double m_xx = m[0][0] * m[0][0] + m[0][1] * m[0][1] + m[0][2] * m[0][2];
        double m_xy = m[0][0] * m[1][0] + m[0][1] * m[1][1] + m[0][2] * m[1][2];
        double m_yy = m[1][0] * m[1][0] + m[1][1] * m[1][1] + m[1][2] * m[1][2];
        double a = m[0][0] * m[1][1] - m[0][1] * m[1][0], b = m[0][0] * m[1][2] - m[0][2] * m[1][0];
        double c = m[0][1] * m[1][2] - m[0][2] * m[1][1];
        // Cauchy-Binet: never negative.
        double inverse_det = 1 / (a * a + b * b + c * c + (double)BLUR * (m_xx + m_yy) + (double)BLUR * BLUR);
        A = (m_yy + BLUR) * inverse_det, B = -m_xy * inverse_det, C = (m_xx + BLUR) * inverse_det;
        xx = (float)m_xx + BLUR, xy = (float)m_xy, yy = (float)m_yy + BLUR;
        return true;
    }
};

template <bool ORTHOGRAPHIC>
__device__ inline void project_one(Index n, Index width, Index height, Index channel_count, const double *viewmat,
                                   const float *K, const float *means, const float *quats, const float *scales,
                                   const float *opacities, const float *channels, float *means2d, float *conics,
                                   float *depths, float *radii) {
    Index i = thread_index();
    if (i >= n) return;
    const Camera camera(viewmat, K, width, height);
    Projected<ORTHOGRAPHIC> p;
    float extent = opacities[i] > 0 ? 2 * logf(255 * opacities[i]) : 0, zero = 0;
    for (Index c = 0; c < channel_count; c++) zero += 0.f * channels[i * channel_count + c];
    bool drawn =
        zero == 0 && extent > 0 && extent < MAX_EXTENT && p.from(camera, means + 3 * i, quats + 4 * i, scales + 3 * i);
    float x = 0, y = 0, radius = 0;
    if (drawn) {
        x = camera.fx * p.u + camera.cx, y = camera.fy * p.v + camera.cy;
        float half = (p.xx - p.yy) / 2, largest = (p.xx + p.yy) / 2 + sqrtf(half * half + p.xy * p.xy);
        float radius_x = sqrtf(extent * p.xx), radius_y = sqrtf(extent * p.yy);
        radius = sqrtf(extent * largest);
        drawn = x + radius_x > 0 && x - radius_x < width && y + radius_y > 0 && y - radius_y < height;
    }
    means2d[2 * i] = drawn ? x : 0;
    means2d[2 * i + 1] = drawn ? y : 0;
    conics[3 * i] = drawn ? (float)p.A : 0;
    conics[3 * i + 1] = drawn ? (float)p.B : 0;
    conics[3 * i + 2] = drawn ? (float)p.C : 0;
    depths[i] = drawn ? p.z : 0;
    radii[i] = drawn ? radius : 0;
}

template <bool ORTHOGRAPHIC>
__device__ inline void project_one_backward(Index n, Index width, Index height, const double *viewmat, const float *K,
                                            const float *means, const float *quats, const float *scales,
                                            const float *radii, const float *by_means2d, const float *by_conics,
                                            float *by_means, float *by_quats, float *by_scales) {
    Index i = thread_index();
    if (i >= n) return;
    const Camera camera(viewmat, K, width, height);
    Projected<ORTHOGRAPHIC> p;
    if (!(radii[i] > 0 && p.from(camera, means + 3 * i, quats + 4 * i, scales + 3 * i))) {
        for (int k = 0; k < 3; k++) by_means[3 * i + k] = by_scales[3 * i + k] = 0;
        for (int k = 0; k < 4; k++) by_quats[4 * i + k] = 0;
        return;
    }
    // By the covariance: -Q G Q, with Q the conic and G its gradient as a symmetric matrix.
    double A = p.A, B = p.B, C = p.C, ga = by_conics[3 * i], gb = .5f * by_conics[3 * i + 1], gc = by_conics[3 * i + 2];
    double xx = -(A * A * ga + 2 * A * B * gb + B * B * gc), yy = -(B * B * ga + 2 * B * C * gb + C * C * gc);
    double xy = -2 * (A * B * ga + (A * C + B * B) * gb + B * C * gc);

    float by_row[2][3] = {}, by_axis[3][3];
    for (int k = 0; k < 3; k++) {
        float mx = p.along[0][k] * p.sigma[k], my = p.along[1][k] * p.sigma[k];
        double exact_mx = 2 * xx * mx + xy * my, exact_my = 2 * yy * my + xy * mx;
        bool limited = p.sigma[k] != scales[3 * i + k];
        by_scales[3 * i + k] = limited ? 0 : (float)(exact_mx * p.along[0][k] + exact_my * p.along[1][k]);
        float by_mx = (float)exact_mx, by_my = (float)exact_my;
        for (int j = 0; j < 3; j++) {
            by_row[0][j] += by_mx * p.sigma[k] * p.axis[k][j];
            by_row[1][j] += by_my * p.sigma[k] * p.axis[k][j];
            by_axis[k][j] = p.sigma[k] * (by_mx * p.row[0][j] + by_my * p.row[1][j]);
        }
    }

    float by_u = camera.fx * by_means2d[2 * i], by_v = camera.fy * by_means2d[2 * i + 1];
    if constexpr (ORTHOGRAPHIC) {  // the covariance does not depend on the place
        for (int j = 0; j < 3; j++) by_means[3 * i + j] = by_u * camera.r[0][j] + by_v * camera.r[1][j];
    } else {
        float by_z = -(by_u * p.u + by_v * p.v) / p.z;
        for (int j = 0; j < 3; j++) {
            by_z -= (by_row[0][j] * p.row[0][j] + by_row[1][j] * p.row[1][j]) / p.z;
            if (!p.u_held) {
                float held = -camera.fx / p.z * by_row[0][j] * camera.r[2][j];
                by_u += held;
                by_z -= held * p.u / p.z;
            }
            if (!p.v_held) {
                float held = -camera.fy / p.z * by_row[1][j] * camera.r[2][j];
                by_v += held;
                by_z -= held * p.v / p.z;
            }
        }
        for (int j = 0; j < 3; j++)
            by_means[3 * i + j] = (by_u * camera.r[0][j] + by_v * camera.r[1][j]) / p.z + by_z * camera.r[2][j];
    }

    // s(i, j) and d(i, j): sums and differences of the gradient by the rotation matrix's entries (row, column).
    auto s = [&](int a, int b) { return by_axis[b][a] + by_axis[a][b]; };
    auto d = [&](int a, int b) { return by_axis[b][a] - by_axis[a][b]; };
    float gw = 2 * (p.q * d(1, 0) + p.y * d(0, 2) + p.x * d(2, 1));
    float gx = 2 * (p.y * s(0, 1) + p.q * s(0, 2) + p.w * d(2, 1)) - 4 * p.x * (by_axis[1][1] + by_axis[2][2]);
    float gy = 2 * (p.x * s(0, 1) + p.q * s(1, 2) + p.w * d(0, 2)) - 4 * p.y * (by_axis[0][0] + by_axis[2][2]);
    float gq = 2 * (p.x * s(0, 2) + p.y * s(1, 2) + p.w * d(1, 0)) - 4 * p.q * (by_axis[0][0] + by_axis[1][1]);
    // Through the normalisation; a quaternion below its lower bound is only scaled.
    float radial = p.inverse_norm < 1e6f ? p.w * gw + p.x * gx + p.y * gy + p.q * gq : 0;
    by_quats[4 * i] = p.inverse_norm * (gw - radial * p.w);
    by_quats[4 * i + 1] = p.inverse_norm * (gx - radial * p.x);
    by_quats[4 * i + 2] = p.inverse_norm * (gy - radial * p.y);
    by_quats[4 * i + 3] = p.inverse_norm * (gq - radial * p.q);
}

// Of n Gaussians: means2d (N, 2), conics (N, 3), depths (N,), radii (N,); zeros where nothing is to be drawn. viewmat
// is double.
KERNEL(3)
project_forward(Index n, Index width, Index height, Index channel_count, const double *viewmat, const float *K,
                const float *means, const float *quats, const float *scales, const float *opacities,
                const float *channels, float *means2d, float *conics, float *depths, float *radii) {
    project_one<false>(n, width, height, channel_count, viewmat, K, means, quats, scales, opacities, channels, means2d,
                        conics, depths, radii);
}

// The same for an orthographic camera.
KERNEL(3)
project_orthographic_forward(Index n, Index width, Index height, Index channel_count, const double *viewmat, const float *K,
                             const float *means, const float *quats, const float *scales, const float *opacities,
                             const float *channels, float *means2d, float *conics, float *depths, float *radii) {
    project_one<true>(n, width, height, channel_count, viewmat, K, means, quats, scales, opacities, channels, means2d,
                       conics, depths, radii);
}

// From gradients by means2d and conics to those by means (N, 3), quats (N, 4) and scales (N, 3).
KERNEL(3)
project_backward(Index n, Index width, Index height, const double *viewmat, const float *K, const float *means,
                 const float *quats, const float *scales, const float *radii, const float *by_means2d,
                 const float *by_conics, float *by_means, float *by_quats, float *by_scales) {
    project_one_backward<false>(n, width, height, viewmat, K, means, quats, scales, radii, by_means2d, by_conics, by_means,
                                 by_quats, by_scales);
}

// The same for an orthographic camera.
KERNEL(3)
project_orthographic_backward(Index n, Index width, Index height, const double *viewmat, const float *K, const float *means,
                              const float *quats, const float *scales, const float *radii, const float *by_means2d,
                              const float *by_conics, float *by_means, float *by_quats, float *by_scales) {
    project_one_backward<true>(n, width, height, viewmat, K, means, quats, scales, radii, by_means2d, by_conics, by_means,
                                by_quats, by_scales);
}
