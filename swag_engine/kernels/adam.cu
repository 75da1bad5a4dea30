// Adam (arXiv 1412.6980), in place.
#include "common.cuh"

// One thread per number of `parameter` and its moments. step_size = rate / (1 - beta1^t); root = sqrt(1 - beta2^t);
// fresh1 = 1 - beta1 and fresh2 = 1 - beta2 come rounded from double: 1 - .999f is off by 1e-5.
KERNEL(4)
adam_step(Index count, float *parameter, const float *gradient, float *mean, float *square, float step_size, float root,
          float fresh1, float fresh2, float epsilon) {
    Index i = thread_index();
    if (i >= count) return;
    float g = gradient[i], m = mean[i] + fresh1 * (g - mean[i]), s = square[i] + fresh2 * (g * g - square[i]);
    mean[i] = m;
    square[i] = s;
    parameter[i] -= step_size * m / (sqrtf(s) / root + epsilon);
}
