// What a pixel adds to the sums that passes over a view make of every splat; the counterpart of pop_ref/contributions.py,
// sensitivity.py, fisher.py and chord.py.
#pragma once

#include "compositing.cuh"

namespace pop {

constexpr int N_CONTRIBUTIONS = 4;  // T alpha, 1, a map, the distance from the pixel's centre to the splat's
constexpr int N_SENSITIVITIES = 1;  // (T (c - B))^2, the channels added up in c and B
constexpr int N_SCREEN = 5;         // mean2d x, y, conic xx, xy, yy
constexpr int N_SCREEN_MOMENTS = 31;

template <class Real>
struct PixelAlpha {
    Real alpha;      // 0 where the splat does not take part (D5)
    Real unclamped;  // before the ceiling (D6)
};

// in the operations of blend_forward, so that a pass blends what a render does
template <class Real>
POP_HD PixelAlpha<Real> alpha_at_pixel(const PackedSplat<Real>& splat, Real dx, Real dy, Real ceiling) {
    const Real squared_x = mul(mul(splat.hA, dx), dx), cross = mul(splat.B, dx);
    const Real exponent = exponent_in_column(squared_x, cross, splat.hC, dy);
    const Real unclamped = within(exponent, splat.beyond) ? mul(splat.opacity, power_of_two(-exponent)) : Real(0);
    return {least(ceiling, unclamped), unclamped};
}

template <class Real>
POP_HD void add_contribution(Real* sums, Real weight, Real map, Real dx, Real dy) {
    sums[0] += weight;
    sums[1] += Real(1);
    sums[2] += map;
    sums[3] += sqrt(dx * dx + dy * dy);
}

// A pixel on its way back: transmittance behind the splat that is visited next, and the colour behind that one.
template <class Real, int CH>
struct Returning {
    Real T;
    Real suffix_color[CH];
};

// Goes before one splat and tells T there and c - B, how far its colour exceeds the light from behind: dC/dalpha / T.
template <class Real, int CH>
POP_HD Real go_before(Returning<Real, CH>& pixel, Real alpha, const Real* color, Real* more) {
    pixel.T = pixel.T * reciprocal(add(Real(1), -alpha));
    POP_UNROLL
    for (int c = 0; c < CH; ++c) {
        more[c] = color[c] - pixel.suffix_color[c];
        pixel.suffix_color[c] += alpha * more[c];
    }
    return pixel.T;
}

// With s = dsigma/d(mean2d, conic) and G_c = alpha dC_c/dalpha: dC_c/d(mean2d, conic) = -G_c s. The fifteen second
// moments row by row, the five mixed with T alpha of each channel, and (T alpha)^2.
template <class Real>
POP_HD void add_moments(Real* sums, const PackedSplat<Real>& splat, Real dx, Real dy, Real weight, const Real* G) {
    // the kernels' conic carries log2(e)
    const Real A = Real(2 * LN_2) * splat.hA, B = Real(LN_2) * splat.B, C = Real(2 * LN_2) * splat.hC, half = Real(0.5);
    const Real s[N_SCREEN] = {A * dx + B * dy, B * dx + C * dy, half * dx * dx, dx * dy, half * dy * dy};
    const Real squares = G[0] * G[0] + G[1] * G[1] + G[2] * G[2];
    int k = 0;
    POP_UNROLL
    for (int i = 0; i < N_SCREEN; ++i) {
        const Real weighted = squares * s[i];
        POP_UNROLL
        for (int j = i; j < N_SCREEN; ++j) sums[k++] += weighted * s[j];
    }
    POP_UNROLL
    for (int c = 0; c < 3; ++c) {
        const Real mixed = G[c] * weight;
        POP_UNROLL
        for (int i = 0; i < N_SCREEN; ++i) sums[k++] -= mixed * s[i];
    }
    sums[k] += weight * weight;
}

// Whether a splat is densest ahead of the camera along a ray, t* >= 0: g . d <= 0 with g = R diag(1/s)^2 R^T (o - mean)
template <class Real>
POP_HD bool densest_ahead(const Real* g, Real x, Real y) {
    return g[0] * x + g[1] * y + g[2] <= Real(0);
}

}  // namespace pop
