// From the parameters of Gaussians to what the other kernels take, and back; and the light of a lamp at the camera.
// gaussians.cpp says what is computed. One thread per Gaussian.
#include "common.cuh"

// What is not a number stays so.
__device__ inline float limited(float x, float least, float most) { return x != x ? x : fminf(fmaxf(x, least), most); }

__device__ inline float length(const float *v) { return sqrtf(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

KERNEL(4)
activate(Index n, const float *centre, const float *means, const float *log_scales, const float *logits, float least,
         float most, float farthest, float *scales, float *opacities, float *offsets, float *directions) {
    Index i = thread_index();
    if (i >= n) return;
    float offset[3];
    for (int j = 0; j < 3; j++) {
        scales[3 * i + j] = expf(limited(log_scales[3 * i + j], least, most));
        offset[j] = means[3 * i + j] - centre[j];
        offsets[3 * i + j] = limited(offset[j], -farthest, farthest);
    }
    opacities[i] = 1 / (1 + expf(-logits[i]));
    float inverse = 1 / fmaxf(length(offset), 1e-12f);
    for (int j = 0; j < 3; j++) directions[3 * i + j] = offset[j] * inverse;
}

KERNEL(4)
activate_backward(Index n, const float *log_scales, const float *scales, const float *opacities, float least, float most,
                  float *by_scales, float *by_opacities) {
    Index i = thread_index();
    if (i >= n) return;
    for (Index at = 3 * i; at < 3 * i + 3; at++)
        by_scales[at] = log_scales[at] >= least && log_scales[at] <= most ? by_scales[at] * scales[at] : 0;
    by_opacities[i] *= opacities[i] * (1 - opacities[i]);
}

// The squared range of a Gaussian over that of the scene.
__device__ inline float squared_range(const float *offset, float unit_range) {
    float range = length(offset) / unit_range;
    return range * range;
}

KERNEL(4)
lamp_forward(Index n, const float *offsets, const float *tau, float unit_range, float *log_light) {
    Index i = thread_index();
    if (i < n) log_light[i] = logf((*tau + 1) / (*tau + squared_range(offsets + 3 * i, unit_range)));
}

// sums (blocks,): of the gradient by tau.
KERNEL(4)
lamp_backward(Index n, const float *offsets, const float *tau, float unit_range, const float *by_log_light,
              float *sums) {
    Index i = thread_index();
    float by_tau[1] = {};
    if (i < n) {
        const float *by = by_log_light + 3 * i;
        by_tau[0] = (by[0] + by[1] + by[2]) * (1 / (*tau + 1) - 1 / (*tau + squared_range(offsets + 3 * i, unit_range)));
    }
    block_sums(by_tau, sums);
}
