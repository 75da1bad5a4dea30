// 3D Gaussians to 2D Gaussians, forward and backward, with the formulas of reference/projection.py: one Gaussian after
// the other, in double so that needles and distant cameras keep their digits.
#include "simd.h"

#include <math.h>

namespace {

// As in reference/projection.py, which has the reasons.
constexpr double NEAR = .01;        // scene units; the near plane
constexpr double BLUR = .3;         // pixel^2, added to the variances: a low-pass filter
constexpr double GUARD = .3;        // fraction of the field of view beyond the edges where the linearisation holds
constexpr double MAX_SIGMA = 1e4;   // pixels; larger Gaussians are flat over any image
constexpr double MAX_EXTENT = 128;  // squared, in standard deviations; of no opacity in 0..1

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

// One Gaussian as the camera sees it, with what the backward pass needs again.
struct Projected {
    double z, u, v;                // u = x/z, v = y/z
    bool u_held, v_held;           // beyond the guard band
    double row[2][3];              // J R
    double inverse_norm, w, x, y, q;  // of the quaternion; unit w, x, y, q (for z)
    double axis[3][3];             // axis[k]: column k of the rotation matrix
    double sigma[3], along[2][3];  // along[d][k] = row[d] . axis[k]
    double xx, xy, yy, det;

    // False where the Gaussian is behind the near plane or not finite.
    bool from(const Camera &camera, const float *mean, const float *quat, const float *scale) {
        double p[3];
        for (int i = 0; i < 3; i++)
            p[i] = camera.r[i][0] * mean[0] + camera.r[i][1] * mean[1] + camera.r[i][2] * mean[2] + camera.t[i];
        z = p[2];
        double norm = 0, total = p[0] + p[1] + p[2] + scale[0] + scale[1] + scale[2];
        for (int i = 0; i < 4; i++) norm += (double)quat[i] * quat[i];
        if (!(z > NEAR && fabs(total) < INFINITY && norm < INFINITY)) return false;
        u = p[0] / z, v = p[1] / z;
        double held_u = smaller(larger(u, camera.left), camera.right), held_v = smaller(larger(v, camera.top), camera.bottom);
        u_held = held_u != u, v_held = held_v != v;
        for (int i = 0; i < 3; i++) {
            row[0][i] = camera.fx / z * (camera.r[0][i] - held_u * camera.r[2][i]);
            row[1][i] = camera.fy / z * (camera.r[1][i] - held_v * camera.r[2][i]);
        }
        inverse_norm = 1 / sqrt(larger(norm, 1e-12));
        w = quat[0] * inverse_norm, x = quat[1] * inverse_norm, y = quat[2] * inverse_norm, q = quat[3] * inverse_norm;
        const double columns[3][3] = {{1 - 2 * (y * y + q * q), 2 * (x * y + w * q), 2 * (x * q - w * y)},
                                      {2 * (x * y - w * q), 1 - 2 * (x * x + q * q), 2 * (y * q + w * x)},
                                      {2 * (x * q + w * y), 2 * (y * q - w * x), 1 - 2 * (x * x + y * y)}};
        memcpy(axis, columns, sizeof axis);
        double m[2][3];
        for (int k = 0; k < 3; k++) {
            sigma[k] = smaller((double)scale[k], camera.max_sigma * z);
            for (int d = 0; d < 2; d++) {
                along[d][k] = row[d][0] * axis[k][0] + row[d][1] * axis[k][1] + row[d][2] * axis[k][2];
                m[d][k] = along[d][k] * sigma[k];
            }
        }
        xx = m[0][0] * m[0][0] + m[0][1] * m[0][1] + m[0][2] * m[0][2];
        xy = m[0][0] * m[1][0] + m[0][1] * m[1][1] + m[0][2] * m[1][2];
        yy = m[1][0] * m[1][0] + m[1][1] * m[1][1] + m[1][2] * m[1][2];
        double a = m[0][0] * m[1][1] - m[0][1] * m[1][0], b = m[0][0] * m[1][2] - m[0][2] * m[1][0];
        double c = m[0][1] * m[1][2] - m[0][2] * m[1][1];
        det = a * a + b * b + c * c + BLUR * (xx + yy) + BLUR * BLUR;  // Cauchy-Binet: never negative
        xx += BLUR, yy += BLUR;
        return true;
    }
};

}  // namespace

// Gaussians [begin, end): means2d (N, 2), conics (N, 3), depths (N,), radii (N,); zeros where nothing is to be drawn.
API void project_forward(int64_t begin, int64_t end, int64_t width, int64_t height, int64_t channel_count,
                         const float *viewmat, const float *K, const float *means, const float *quats,
                         const float *scales, const float *opacities, const float *channels, float *means2d,
                         float *conics, float *depths, float *radii) {
    const Camera camera(viewmat, K, width, height);
    for (int64_t i = begin; i < end; i++) {
        Projected p;
        double extent = opacities[i] > 0 ? 2 * log(255. * opacities[i]) : 0, total = 0;
        for (int64_t c = 0; c < channel_count; c++) total += channels[i * channel_count + c];
        bool drawn = fabs(total) < INFINITY && extent > 0 && extent < MAX_EXTENT &&
                     p.from(camera, means + 3 * i, quats + 4 * i, scales + 3 * i);
        if (drawn) {
            double x = camera.fx * p.u + camera.cx, y = camera.fy * p.v + camera.cy;
            double middle = (p.xx + p.yy) / 2, largest = middle + sqrt(larger(middle * middle - p.det, 0.));
            double radius_x = sqrt(extent * p.xx), radius_y = sqrt(extent * p.yy);
            drawn = x + radius_x > 0 && x - radius_x < width && y + radius_y > 0 && y - radius_y < height;
            if (drawn) {
                means2d[2 * i] = (float)x, means2d[2 * i + 1] = (float)y;
                conics[3 * i] = (float)(p.yy / p.det);
                conics[3 * i + 1] = (float)(-p.xy / p.det);
                conics[3 * i + 2] = (float)(p.xx / p.det);
                depths[i] = (float)p.z;
                radii[i] = (float)sqrt(extent * largest);
            }
        }
        if (!drawn) {
            memset(means2d + 2 * i, 0, 2 * sizeof(float));
            memset(conics + 3 * i, 0, 3 * sizeof(float));
            depths[i] = radii[i] = 0;
        }
    }
}

// From gradients by means2d and conics to those by means (N, 3), quats (N, 4) and scales (N, 3).
API void project_backward(int64_t begin, int64_t end, int64_t width, int64_t height, const float *viewmat, const float *K,
                          const float *means, const float *quats, const float *scales, const float *radii,
                          const float *by_means2d, const float *by_conics, float *by_means, float *by_quats,
                          float *by_scales) {
    const Camera camera(viewmat, K, width, height);
    for (int64_t i = begin; i < end; i++) {
        Projected p;
        if (!(radii[i] > 0 && p.from(camera, means + 3 * i, quats + 4 * i, scales + 3 * i))) {
            memset(by_means + 3 * i, 0, 3 * sizeof(float));
            memset(by_quats + 4 * i, 0, 4 * sizeof(float));
            memset(by_scales + 3 * i, 0, 3 * sizeof(float));
            continue;
        }
        // By the covariance: -Q G Q, with Q the conic and G its gradient as a symmetric matrix.
        double A = p.yy / p.det, B = -p.xy / p.det, C = p.xx / p.det;
        double ga = by_conics[3 * i], gb = .5 * by_conics[3 * i + 1], gc = by_conics[3 * i + 2];
        double xx = -(A * A * ga + 2 * A * B * gb + B * B * gc), yy = -(B * B * ga + 2 * B * C * gb + C * C * gc);
        double xy = -2 * (A * B * ga + (A * C + B * B) * gb + B * C * gc);

        double by_row[2][3] = {}, by_axis[3][3];
        for (int k = 0; k < 3; k++) {
            double mx = p.along[0][k] * p.sigma[k], my = p.along[1][k] * p.sigma[k];
            double by_m[2] = {2 * xx * mx + xy * my, 2 * yy * my + xy * mx};
            bool limited = p.sigma[k] != (double)scales[3 * i + k];
            by_scales[3 * i + k] = limited ? 0 : (float)(by_m[0] * p.along[0][k] + by_m[1] * p.along[1][k]);
            for (int j = 0; j < 3; j++) {
                by_row[0][j] += by_m[0] * p.sigma[k] * p.axis[k][j];
                by_row[1][j] += by_m[1] * p.sigma[k] * p.axis[k][j];
                by_axis[k][j] = p.sigma[k] * (by_m[0] * p.row[0][j] + by_m[1] * p.row[1][j]);
            }
        }

        double by_u = camera.fx * by_means2d[2 * i], by_v = camera.fy * by_means2d[2 * i + 1];
        double by_z = -(by_u * p.u + by_v * p.v) / p.z;
        for (int j = 0; j < 3; j++) {
            by_z -= (by_row[0][j] * p.row[0][j] + by_row[1][j] * p.row[1][j]) / p.z;
            if (!p.u_held) {
                double held = -camera.fx / p.z * by_row[0][j] * camera.r[2][j];
                by_u += held;
                by_z -= held * p.u / p.z;
            }
            if (!p.v_held) {
                double held = -camera.fy / p.z * by_row[1][j] * camera.r[2][j];
                by_v += held;
                by_z -= held * p.v / p.z;
            }
        }
        for (int j = 0; j < 3; j++)
            by_means[3 * i + j] =
                (float)((by_u * camera.r[0][j] + by_v * camera.r[1][j]) / p.z + by_z * camera.r[2][j]);

        // s(i, j) and d(i, j): sums and differences of the gradient by the rotation matrix's entries (row, column).
        auto s = [&](int a, int b) { return by_axis[b][a] + by_axis[a][b]; };
        auto d = [&](int a, int b) { return by_axis[b][a] - by_axis[a][b]; };
        double gw = 2 * (p.q * d(1, 0) + p.y * d(0, 2) + p.x * d(2, 1));
        double gx = 2 * (p.y * s(0, 1) + p.q * s(0, 2) + p.w * d(2, 1)) - 4 * p.x * (by_axis[1][1] + by_axis[2][2]);
        double gy = 2 * (p.x * s(0, 1) + p.q * s(1, 2) + p.w * d(0, 2)) - 4 * p.y * (by_axis[0][0] + by_axis[2][2]);
        double gq = 2 * (p.x * s(0, 2) + p.y * s(1, 2) + p.w * d(1, 0)) - 4 * p.q * (by_axis[0][0] + by_axis[1][1]);
        // Through the normalisation; a quaternion below its lower bound is only scaled.
        double radial = p.inverse_norm < 1e6 ? p.w * gw + p.x * gx + p.y * gy + p.q * gq : 0;
        by_quats[4 * i] = (float)(p.inverse_norm * (gw - radial * p.w));
        by_quats[4 * i + 1] = (float)(p.inverse_norm * (gx - radial * p.x));
        by_quats[4 * i + 2] = (float)(p.inverse_norm * (gy - radial * p.y));
        by_quats[4 * i + 3] = (float)(p.inverse_norm * (gq - radial * p.q));
    }
}
