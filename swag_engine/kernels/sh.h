// Real spherical harmonics up to degree 3: constants and order of reference/harmonics.py.
#pragma once
#include "constants.h"

#include <stdint.h>

static constexpr int MAX_BASIS = 16;  // basis functions of degree 3

// Values of the basis functions up to `degree`. F: float, or a vector of them.
template <class F>
static inline void basis_at(const F *direction, int64_t degree, F *basis) {
    F x = direction[0], y = direction[1], z = direction[2], xx = x * x, yy = y * y, zz = z * z;
    basis[0] = x - x + (float)constants::SH_C0;
    if (degree < 1) return;
    const float c1 = constants::SH_C1;
    basis[1] = -c1 * y;
    basis[2] = c1 * z;
    basis[3] = -c1 * x;
    if (degree < 2) return;
    const float c2 = constants::SH_C2_0;
    basis[4] = c2 * x * y;
    basis[5] = -c2 * y * z;
    basis[6] = (float)constants::SH_C2_1 * (2 * zz - xx - yy);
    basis[7] = -c2 * x * z;
    basis[8] = (float)constants::SH_C2_2 * (xx - yy);
    if (degree < 3) return;
    const float c3 = constants::SH_C3_0, c4 = constants::SH_C3_2;
    basis[9] = -c3 * y * (3 * xx - yy);
    basis[10] = (float)constants::SH_C3_1 * x * y * z;
    basis[11] = -c4 * y * (4 * zz - xx - yy);
    basis[12] = (float)constants::SH_C3_3 * z * (2 * zz - 3 * xx - 3 * yy);
    basis[13] = -c4 * x * (4 * zz - xx - yy);
    basis[14] = (float)constants::SH_C3_4 * z * (xx - yy);
    basis[15] = -c3 * x * (xx - 3 * yy);
}
