// 3D Gaussians to 2D Gaussians, forward and backward, with the formulas of reference/projection.py: LANES Gaussians at a
// time, in double so that needles and distant cameras keep their digits. What differs between perspective and orthographic
// cameras is chosen when this is compiled.
#include "constants.h"
#include "simd.h"

#include <math.h>

namespace {

// As in reference/projection.py, which has the reasons.
constexpr double NEAR = constants::NEAR;              // scene units; the near plane
constexpr double BLUR = constants::BLUR;              // pixel^2, added to the variances: a low-pass filter
constexpr double GUARD = constants::GUARD;            // fraction of the field of view beyond the edges where the linearisation holds
constexpr double MAX_SIGMA = constants::MAX_SIGMA;    // pixels; larger Gaussians are flat over any image
constexpr double MAX_EXTENT = constants::MAX_EXTENT;  // squared, in standard deviations; of no opacity in 0..1
constexpr double LN2 = .6931471805599453;

constexpr int LANES = VW / 2;
typedef double Real __attribute__((vector_size(LANES * 8)));
typedef int64_t Truth __attribute__((vector_size(LANES * 8)));  // all bits set: true

inline Real real(double x) { return x - Real{}; }
inline Real masked(Truth m, Real a) { return (Real)(m & (Truth)a); }
inline Real select(Truth m, Real a, Real b) { return (Real)((m & (Truth)a) | (~m & (Truth)b)); }
inline Truth finite(Real x) { return x - x == 0.; }

inline bool any(Truth m) {
    int64_t bits = 0;
    for (int l = 0; l < LANES; l++) bits |= m[l];
    return bits != 0;
}

inline Real root(Real x) {
#if defined(__clang__)
    return __builtin_elementwise_sqrt(x);
#else
    for (int l = 0; l < LANES; l++) x[l] = __builtin_sqrt(x[l]);
    return x;
#endif
}

// Lane l of C vectors from row l of (count, C), zeros beyond, and back, zeros where `keep` is not set. The copies have a
// constant number of lanes, so that they become shuffles.
template <int C>
inline void load(const float *from, int count, Real *to) {
    float rows[C * LANES] = {};
    if (count == LANES)
        memcpy(rows, from, sizeof rows);
    else
        memcpy(rows, from, C * count * sizeof(float));
    for (int c = 0; c < C; c++)
        for (int l = 0; l < LANES; l++) to[c][l] = rows[C * l + c];
}
template <int C>
inline void store(const Real *from, Truth keep, int count, float *to) {
    float rows[C * LANES];
    for (int c = 0; c < C; c++) {
        Real kept = masked(keep, from[c]);
        for (int l = 0; l < LANES; l++) rows[C * l + c] = (float)kept[l];
    }
    if (count == LANES)
        memcpy(to, rows, sizeof rows);
    else
        memcpy(to, rows, C * count * sizeof(float));
}

struct Camera {
    double r[3][3], t[3], fx, fy, cx, cy, left, right, top, bottom, max_sigma;  // guard band in x/z and y/z

    Camera(const float *viewmat, const float *K, double width, double height) {
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) r[i][j] = viewmat[4 * i + j];
            t[i] = viewmat[4 * i + 3];
        }
        fx = K[0], fy = K[4], cx = K[2], cy = K[5];
        double guard_x = GUARD * width / (2 * fx), guard_y = GUARD * height / (2 * fy);
        left = -cx / fx - guard_x, right = (width - cx) / fx + guard_x;
        top = -cy / fy - guard_y, bottom = (height - cy) / fy + guard_y;
        max_sigma = MAX_SIGMA / larger(fx, fy);
    }
};

// Gaussians as the camera sees them, with what the backward pass needs again.
template <bool ORTHOGRAPHIC>
struct Projected {
    Truth in_front;              // of the near plane, and finite; the other values count only there
    Real z, u, v;                // u = x/z, v = y/z; orthographic: u = x, v = y
    Truth u_held, v_held;        // beyond the guard band
    Real row[2][3];              // J R
    Real inverse_norm, w, x, y, q;  // of the quaternion; unit w, x, y, q (for z)
    Real axis[3][3];             // axis[k]: column k of the rotation matrix
    Real scale[3], sigma[3], along[2][3];  // along[d][k] = row[d] . axis[k]
    Real xx, xy, yy, det;

    // False where all are behind the near plane or not finite.
    bool from(const Camera &camera, int count, const float *means, const float *quats, const float *scales) {
        Real mean[3], quat[4], p[3];
        load<3>(means, count, mean);
        load<4>(quats, count, quat);
        load<3>(scales, count, scale);
        for (int i = 0; i < 3; i++)
            p[i] = camera.r[i][0] * mean[0] + camera.r[i][1] * mean[1] + camera.r[i][2] * mean[2] + camera.t[i];
        Real norm = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
        in_front = (p[2] > NEAR) & finite(p[0] + p[1] + p[2] + scale[0] + scale[1] + scale[2]) & finite(norm);
        if (!any(in_front)) return false;
        z = select(in_front, p[2], real(1));
        if constexpr (ORTHOGRAPHIC) {
            u = p[0], v = p[1];
            for (int i = 0; i < 3; i++) row[0][i] = real(camera.fx * camera.r[0][i]), row[1][i] = real(camera.fy * camera.r[1][i]);
        } else {
            u = p[0] / z, v = p[1] / z;
            Real held_u = smaller(larger(u, real(camera.left)), real(camera.right));
            Real held_v = smaller(larger(v, real(camera.top)), real(camera.bottom));
            u_held = held_u != u, v_held = held_v != v;
            Real fx = camera.fx / z, fy = camera.fy / z;
            for (int i = 0; i < 3; i++) {
                row[0][i] = fx * (camera.r[0][i] - held_u * camera.r[2][i]);
                row[1][i] = fy * (camera.r[1][i] - held_v * camera.r[2][i]);
            }
        }
        inverse_norm = 1. / root(larger(norm, real(1e-12)));
        w = quat[0] * inverse_norm, x = quat[1] * inverse_norm, y = quat[2] * inverse_norm, q = quat[3] * inverse_norm;
        axis[0][0] = 1. - 2. * (y * y + q * q), axis[0][1] = 2. * (x * y + w * q), axis[0][2] = 2. * (x * q - w * y);
        axis[1][0] = 2. * (x * y - w * q), axis[1][1] = 1. - 2. * (x * x + q * q), axis[1][2] = 2. * (y * q + w * x);
        axis[2][0] = 2. * (x * q + w * y), axis[2][1] = 2. * (y * q - w * x), axis[2][2] = 1. - 2. * (x * x + y * y);
        Real m[2][3];
        for (int k = 0; k < 3; k++) {
            sigma[k] = smaller(scale[k], ORTHOGRAPHIC ? real(camera.max_sigma) : camera.max_sigma * z);
            for (int d = 0; d < 2; d++) {
                along[d][k] = row[d][0] * axis[k][0] + row[d][1] * axis[k][1] + row[d][2] * axis[k][2];
                m[d][k] = along[d][k] * sigma[k];
            }
        }
        xx = m[0][0] * m[0][0] + m[0][1] * m[0][1] + m[0][2] * m[0][2];
        xy = m[0][0] * m[1][0] + m[0][1] * m[1][1] + m[0][2] * m[1][2];
        yy = m[1][0] * m[1][0] + m[1][1] * m[1][1] + m[1][2] * m[1][2];
        Real a = m[0][0] * m[1][1] - m[0][1] * m[1][0], b = m[0][0] * m[1][2] - m[0][2] * m[1][0];
        Real c = m[0][1] * m[1][2] - m[0][2] * m[1][1];
        det = a * a + b * b + c * c + BLUR * (xx + yy) + BLUR * BLUR;  // Cauchy-Binet: never negative
        xx += BLUR, yy += BLUR;
        return true;
    }
};

// Squared distance from the centre to where alpha falls below 1/255, in standard deviations: 2 ln(255 opacity).
inline Real extents(const float *opacities, int count) {
    Vec opacity = Vec{};
    memcpy(&opacity, opacities, count * sizeof(float));
    Vec logs = log2(larger(opacity * 255.f, splat(1e-30f)));
    Real extent;
    for (int l = 0; l < LANES; l++) extent[l] = 2 * LN2 * logs[l];
    return extent;
}

// Whether all channels of a Gaussian are finite.
inline Truth finite_channels(const float *channels, int64_t channel_count, int count) {
    Real total = Real{};
    for (int l = 0; l < count; l++)
        for (int64_t c = 0; c < channel_count; c++) total[l] += channels[l * channel_count + c];
    return finite(total);
}

template <bool ORTHOGRAPHIC>
void forward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count, const float *viewmat,
             const float *K, const float *means, const float *quats, const float *scales, const float *opacities,
             const float *channels, float *means2d, float *conics, float *depths, float *radii) {
    const Camera camera(viewmat, K, width, height);
    for (int64_t i = begin; i < end; i += LANES) {
        int count = (int)smaller<int64_t>(LANES, end - i);
        Projected<ORTHOGRAPHIC> p;
        Real extent = extents(opacities + i, count), center[2] = {}, conic[3] = {}, radius = {};
        Truth drawn = (extent > 0.) & (extent < MAX_EXTENT) & finite_channels(channels + i * channel_count, channel_count, count);
        if (p.from(camera, count, means + 3 * i, quats + 4 * i, scales + 3 * i)) {
            center[0] = camera.fx * p.u + camera.cx, center[1] = camera.fy * p.v + camera.cy;
            Real middle = (p.xx + p.yy) / 2., largest = middle + root(larger(middle * middle - p.det, Real{}));
            Real radius_x = root(extent * p.xx), radius_y = root(extent * p.yy), inverse = 1. / p.det;
            drawn &= p.in_front & (center[0] + radius_x > 0.) & (center[0] - radius_x < (double)width) &
                     (center[1] + radius_y > 0.) & (center[1] - radius_y < (double)height);
            conic[0] = p.yy * inverse, conic[1] = -p.xy * inverse, conic[2] = p.xx * inverse;
            radius = root(extent * largest);
        } else {
            p.z = Real{}, drawn = Truth{};
        }
        store<2>(center, drawn, count, means2d + 2 * i);
        store<3>(conic, drawn, count, conics + 3 * i);
        store<1>(&p.z, drawn, count, depths + i);
        store<1>(&radius, drawn, count, radii + i);
    }
}

template <bool ORTHOGRAPHIC>
void backward(int64_t begin, int64_t end, int64_t width, int64_t height, const float *viewmat, const float *K,
              const float *means, const float *quats, const float *scales, const float *radii, const float *by_means2d,
              const float *by_conics, float *by_means, float *by_quats, float *by_scales) {
    const Camera camera(viewmat, K, width, height);
    for (int64_t i = begin; i < end; i += LANES) {
        int count = (int)smaller<int64_t>(LANES, end - i);
        Projected<ORTHOGRAPHIC> p;
        Real radius, by_center[2], by_conic[3], by_mean[3] = {}, by_quat[4] = {}, by_scale[3] = {};
        load<1>(radii + i, count, &radius);
        Truth drawn = radius > 0.;
        if (!any(drawn) || !p.from(camera, count, means + 3 * i, quats + 4 * i, scales + 3 * i)) {
            store<3>(by_mean, drawn, count, by_means + 3 * i);
            store<4>(by_quat, drawn, count, by_quats + 4 * i);
            store<3>(by_scale, drawn, count, by_scales + 3 * i);
            continue;
        }
        load<2>(by_means2d + 2 * i, count, by_center);
        load<3>(by_conics + 3 * i, count, by_conic);
        // By the covariance: -Q G Q, with Q the conic and G its gradient as a symmetric matrix.
        Real inverse = 1. / p.det, A = p.yy * inverse, B = -p.xy * inverse, C = p.xx * inverse;
        Real ga = by_conic[0], gb = .5 * by_conic[1], gc = by_conic[2];
        Real xx = -(A * A * ga + 2. * A * B * gb + B * B * gc), yy = -(B * B * ga + 2. * B * C * gb + C * C * gc);
        Real xy = -2. * (A * B * ga + (A * C + B * B) * gb + B * C * gc);

        Real by_row[2][3] = {}, by_axis[3][3];
        for (int k = 0; k < 3; k++) {
            Real mx = p.along[0][k] * p.sigma[k], my = p.along[1][k] * p.sigma[k];
            Real by_mx = 2. * xx * mx + xy * my, by_my = 2. * yy * my + xy * mx;
            by_scale[k] = masked(p.sigma[k] == p.scale[k], by_mx * p.along[0][k] + by_my * p.along[1][k]);
            for (int j = 0; j < 3; j++) {
                by_row[0][j] += by_mx * p.sigma[k] * p.axis[k][j];
                by_row[1][j] += by_my * p.sigma[k] * p.axis[k][j];
                by_axis[k][j] = p.sigma[k] * (by_mx * p.row[0][j] + by_my * p.row[1][j]);
            }
        }

        Real by_u = camera.fx * by_center[0], by_v = camera.fy * by_center[1];
        if constexpr (ORTHOGRAPHIC) {  // the covariance does not depend on the place
            for (int j = 0; j < 3; j++) by_mean[j] = by_u * camera.r[0][j] + by_v * camera.r[1][j];
        } else {
            Real per_z = 1. / p.z, by_z = -(by_u * p.u + by_v * p.v);
            for (int j = 0; j < 3; j++) {
                Real held_u = masked(~p.u_held, -camera.fx * camera.r[2][j] * per_z * by_row[0][j]);
                Real held_v = masked(~p.v_held, -camera.fy * camera.r[2][j] * per_z * by_row[1][j]);
                by_u += held_u;
                by_v += held_v;
                by_z -= by_row[0][j] * p.row[0][j] + by_row[1][j] * p.row[1][j] + held_u * p.u + held_v * p.v;
            }
            for (int j = 0; j < 3; j++)
                by_mean[j] = (by_u * camera.r[0][j] + by_v * camera.r[1][j] + by_z * camera.r[2][j]) * per_z;
        }

        // s(i, j) and d(i, j): sums and differences of the gradient by the rotation matrix's entries (row, column).
        auto s = [&](int a, int b) { return by_axis[b][a] + by_axis[a][b]; };
        auto d = [&](int a, int b) { return by_axis[b][a] - by_axis[a][b]; };
        Real gw = 2. * (p.q * d(1, 0) + p.y * d(0, 2) + p.x * d(2, 1));
        Real gx = 2. * (p.y * s(0, 1) + p.q * s(0, 2) + p.w * d(2, 1)) - 4. * p.x * (by_axis[1][1] + by_axis[2][2]);
        Real gy = 2. * (p.x * s(0, 1) + p.q * s(1, 2) + p.w * d(0, 2)) - 4. * p.y * (by_axis[0][0] + by_axis[2][2]);
        Real gq = 2. * (p.x * s(0, 2) + p.y * s(1, 2) + p.w * d(1, 0)) - 4. * p.q * (by_axis[0][0] + by_axis[1][1]);
        // Through the normalisation; a quaternion below its lower bound is only scaled.
        Real radial = masked(p.inverse_norm < 1e6, p.w * gw + p.x * gx + p.y * gy + p.q * gq);
        by_quat[0] = p.inverse_norm * (gw - radial * p.w);
        by_quat[1] = p.inverse_norm * (gx - radial * p.x);
        by_quat[2] = p.inverse_norm * (gy - radial * p.y);
        by_quat[3] = p.inverse_norm * (gq - radial * p.q);
        store<3>(by_mean, drawn, count, by_means + 3 * i);
        store<4>(by_quat, drawn, count, by_quats + 4 * i);
        store<3>(by_scale, drawn, count, by_scales + 3 * i);
    }
}

}  // namespace

// Gaussians [begin, end): means2d (N, 2), conics (N, 3), depths (N,), radii (N,); zeros where nothing is to be drawn.
API void project_forward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count,
                         const float *viewmat, const float *K, const float *means, const float *quats,
                         const float *scales, const float *opacities, const float *channels, float *means2d,
                         float *conics, float *depths, float *radii) {
    forward<false>(begin, end, width, height, channel_count, viewmat, K, means, quats, scales, opacities, channels, means2d,
                   conics, depths, radii);
}

// The same for an orthographic camera.
API void project_orthographic_forward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count,
                                      const float *viewmat, const float *K, const float *means, const float *quats,
                                      const float *scales, const float *opacities, const float *channels,
                                      float *means2d, float *conics, float *depths, float *radii) {
    forward<true>(begin, end, width, height, channel_count, viewmat, K, means, quats, scales, opacities, channels, means2d,
                  conics, depths, radii);
}

// From gradients by means2d and conics to those by means (N, 3), quats (N, 4) and scales (N, 3).
API void project_backward(int64_t begin, int64_t end, int64_t width, int64_t height, const float *viewmat, const float *K,
                          const float *means, const float *quats, const float *scales, const float *radii,
                          const float *by_means2d, const float *by_conics, float *by_means, float *by_quats,
                          float *by_scales) {
    backward<false>(begin, end, width, height, viewmat, K, means, quats, scales, radii, by_means2d, by_conics, by_means,
                    by_quats, by_scales);
}

// The same for an orthographic camera.
API void project_orthographic_backward(int64_t begin, int64_t end, int64_t width, int64_t height, const float *viewmat,
                                       const float *K, const float *means, const float *quats, const float *scales,
                                       const float *radii, const float *by_means2d, const float *by_conics,
                                       float *by_means, float *by_quats, float *by_scales) {
    backward<true>(begin, end, width, height, viewmat, K, means, quats, scales, radii, by_means2d, by_conics, by_means,
                   by_quats, by_scales);
}
