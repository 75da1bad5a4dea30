// Adam (arXiv 1412.6980), in place.
#include "common.cuh"

// One thread per number of `parameter` and its moments. step_size = rate / (1 - beta1^t); root = sqrt(1 - beta2^t);
// weight1 = 1 - beta1 and weight2 = 1 - beta2 are computed in double: 1 - .999f is off by 1e-5.
KERNEL(4)
adam_step(Index count, float *parameter, const float *gradient, float *mean, float *square, float step_size, float root,
          float weight1, float weight2, float epsilon) {
    Index i = thread_index();
    if (i >= count) return;
    float g = gradient[i], m = mean[i] + weight1 * (g - mean[i]), s = square[i] + weight2 * (g * g - square[i]);
    mean[i] = m;
    square[i] = s;
    parameter[i] -= step_size * m / (sqrtf(s) / root + epsilon);
}
