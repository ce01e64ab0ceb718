// SSIM of one window and its derivatives by the window's moments; the counterpart of pop_ref/ssim.py.
#pragma once

#include "real.cuh"

namespace pop {

constexpr int SSIM_WINDOW = 11;
constexpr int SSIM_REACH = SSIM_WINDOW / 2;
constexpr double SSIM_C1 = 0.01 * 0.01;
constexpr double SSIM_C2 = 0.03 * 0.03;

// exp(-i^2 / (2 1.5^2)) for i = -5..5 over their sum; the window is the outer product of this with itself
template <class Real>
POP_HD Real ssim_weight(int i) {
    constexpr double falloff[SSIM_REACH + 1] = {
        0.2660117248617943434, 0.2130055377112536999, 0.1093606895097000107,
        0.03600077212843082365, 0.007598758135239184185, 0.001028380084479109882};
    return Real(falloff[i < 0 ? -i : i]);
}

// weighted sums over a window
template <class Real>
struct WindowMoments {
    Real mu_x, mu_y, xx, yy, xy;
};

template <class Real>
struct WindowSsim {
    Real S, v_mu, v_xx, v_xy;
};

template <class Real>
POP_HD WindowSsim<Real> compare_window(const WindowMoments<Real>& w) {
    const Real C1 = Real(SSIM_C1), C2 = Real(SSIM_C2), two = Real(2);
    const Real mu_x = w.mu_x, mu_y = w.mu_y;
    const Real s_xx = w.xx - mu_x * mu_x;
    const Real s_yy = w.yy - mu_y * mu_y;
    const Real s_xy = w.xy - mu_x * mu_y;
    const Real A1 = two * mu_x * mu_y + C1;
    const Real A2 = two * s_xy + C2;
    const Real B1 = mu_x * mu_x + mu_y * mu_y + C1;
    const Real B2 = s_xx + s_yy + C2;
    // the oracle's quotients over one denominator: divisions would be most of the instructions
    const Real inverse = reciprocal(B1 * B2);
    const Real S = A1 * A2 * inverse;
    const Real v_mu = two * (mu_y * (A2 - A1) - mu_x * S * (B2 - B1)) * inverse;
    return {S, v_mu, -S * B1 * inverse, two * A1 * inverse};
}

// cotangent of a pixel x from the blurred derivatives of the windows that hold it
template <class Real>
POP_HD Real pixel_from_windows(Real x, Real y, Real v_mu, Real v_xx, Real v_xy) {
    return v_mu + Real(2) * x * v_xx + y * v_xy;
}

}  // namespace pop
