// Written by constants.py from the values of the reference, which says what they are.
#pragma once

namespace constants {
constexpr double NEAR = 0.01;
constexpr double BLUR = 0.3;
constexpr double GUARD = 0.3;
constexpr double MAX_SIGMA = 10000.0;
constexpr double MAX_EXTENT = 128.0;
constexpr double MIN_ALPHA = 0.00392156862745098;
constexpr double LOG255 = 5.541263545158426;
constexpr double MAX_ALPHA = 0.99;
constexpr double MIN_TRANSMITTANCE = 0.0001;
constexpr double SSIM_C1 = 0.0001;
constexpr double SSIM_C2 = 0.0009;
constexpr double DISPLAY_TOE = 0.04045;
constexpr double LINEAR_TOE = 0.0031308;
constexpr double SH_C0 = 0.28209479177387814;
constexpr double SH_C1 = 0.4886025119029199;
constexpr double SH_C2_0 = 1.0925484305920792;
constexpr double SH_C2_1 = 0.31539156525252005;
constexpr double SH_C2_2 = 0.5462742152960396;
constexpr double SH_C3_0 = 0.5900435899266435;
constexpr double SH_C3_1 = 2.890611442640554;
constexpr double SH_C3_2 = 0.4570457994644658;
constexpr double SH_C3_3 = 0.3731763325901154;
constexpr double SH_C3_4 = 1.445305721320277;
constexpr double WINDOW[] = {0.2660117249, 0.2130055377, 0.1093606895, 0.03600077213, 0.007598758135, 0.001028380084};
}  // namespace constants
