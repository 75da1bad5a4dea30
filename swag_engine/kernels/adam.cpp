// Adam (arXiv 1412.6980), in place.
#include "simd.h"

#include <math.h>

// Elements [begin, end) of `parameter` and its moments. step_size = rate / (1 - beta1^t), scale = 1 / sqrt(1 - beta2^t).
// weight1 = 1 - beta1 and weight2 = 1 - beta2 are computed in double: 1 - .999f is off by 1e-5.
API void adam_step(int64_t begin, int64_t end, float *__restrict parameter, const float *__restrict gradient,
                   float *__restrict mean, float *__restrict square, float step_size, float scale, float beta1,
                   float weight1, float beta2, float weight2, float epsilon) {
    for (int64_t k = begin; k < end; k++) {
        float g = gradient[k], m = beta1 * mean[k] + weight1 * g, v = beta2 * square[k] + weight2 * g * g;
        mean[k] = m;
        square[k] = v;
        parameter[k] -= step_size * m / (sqrtf(v) * scale + epsilon);
    }
}
