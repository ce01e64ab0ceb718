// Front-to-back blending of a column of pixels, and two ways back; the counterpart of pop_ref/pixel.py and compositing.py.
//
// A lane owns ROWS pixels under one another, so that what depends on x alone is computed once for all of them.
// With G = o exp(-sigma) v_alpha the cotangents of a splat are linear in six sums over pixels, its moments:
//     v_mean2d = -(A Mx + B My, B Mx + C My),   v_conic = -(Mxx / 2, Mxy, Myy / 2),   v_opacity = M0 / o,
//     M0 = sum G,  Mx = sum G dx,  My = sum G dy,  Mxx = sum G dx^2,  Mxy = sum G dx dy,  Myy = sum G dy^2.
#pragma once

#include "alpha.cuh"
#include "dominance.cuh"

namespace pop {

// positions of a splat's sums after its CH colour cotangents
enum Moment { M0, MX, MY, MXX, MXY, MYY, N_MOMENTS, ABS_X = N_MOMENTS, ABS_Y, N_WITH_ABS };

template <int CH, bool ABS>
struct SumsOf {
    static constexpr int count = CH + (ABS ? int(N_WITH_ABS) : int(N_MOMENTS));
};

template <class Real, int CH, int ROWS>
struct ForwardColumn {
    Real T[ROWS];      // transmittance behind all splats that were reached: at most the stop once one is not blended
    Real T_final[ROWS];  // behind those that were blended
    Real color[ROWS][CH];
    int last[ROWS];  // list position of the splat that stopped the pixel, or behind the last
};

// what a forward pass tells besides the image
enum class Collect { nothing, dominant, everything };

template <class Real, int ROWS>
struct RenderStats {
    Dominant<Real> best[ROWS];
    int n_blended[ROWS];  // with Collect::everything
};

template <class Real, int CH, int ROWS>
struct BackwardColumn {
    Real T[ROWS];        // transmittance behind the splat that is visited next
    Real suffix_dot_grad[ROWS];  // the colour behind that splat, dotted with the pixel's cotangent
    Real v_color[ROWS][CH];
    int last[ROWS];
};

template <Collect COLLECT, class Real, int CH, int ROWS>
POP_HD void start_forward(ForwardColumn<Real, CH, ROWS>& column, RenderStats<Real, ROWS>& stats, int rows_inside) {
    POP_UNROLL
    for (int k = 0; k < ROWS; ++k) {
        column.T[k] = k < rows_inside ? Real(1) : Real(0);
        column.T_final[k] = Real(1);
        column.last[k] = 0;
        POP_UNROLL
        for (int c = 0; c < CH; ++c) column.color[k][c] = Real(0);
        if (COLLECT != Collect::nothing) stats.best[k] = no_dominant<Real>();
        if (COLLECT == Collect::everything) stats.n_blended[k] = 0;
    }
}

template <class Real, int CH, int ROWS>
POP_HD bool is_open(const ForwardColumn<Real, CH, ROWS>& column, Real stop) {
    Real largest = column.T[0];
    POP_UNROLL
    for (int k = 1; k < ROWS; ++k) largest = most(largest, column.T[k]);
    return largest > stop;
}

// Without branches, so that the pixels' exponentials overlap: nearly every splat of a tile's list reaches some pixel of
// a row of its warp. A splat that is not within reach is blended with weight 0: its colour must be finite.
// x, y: the first pixel's centre; position: the splat's place in the list; id: what the winner of a pixel is known by.
template <Collect COLLECT, class Real, int CH, int ROWS>
POP_HD void blend_forward(ForwardColumn<Real, CH, ROWS>& column, RenderStats<Real, ROWS>& stats,
                          const PackedSplat<Real>& splat, const Real* color, int id, Real x, Real y, int position,
                          const BlendConstants<Real>& constants) {
    const Real dx = add(splat.x, -x);
    const Real squared_x = mul(mul(splat.hA, dx), dx), cross = mul(splat.B, dx);
    POP_UNROLL
    for (int k = 0; k < ROWS; ++k) {
        const Real dy = add(splat.y, -(y + Real(k)));
        const Real exponent = exponent_in_column(squared_x, cross, splat.hC, dy);
        const Real clamped = least(constants.ceiling, mul(splat.opacity, power_of_two(-exponent)));  // D6
        const Real alpha = within(exponent, splat.beyond) ? clamped : Real(0);                       // D5
        const Real T = column.T[k], weight = mul(T, alpha);
        column.T[k] = fused(-alpha, T, T);
        // D7: a splat that takes T to the stop is not blended, and none behind it is, since T never grows
        const bool goes_on = column.T[k] > constants.stop;
        if (goes_on) {
            column.T_final[k] = column.T[k];
            column.last[k] = position + 1;
            POP_UNROLL
            for (int c = 0; c < CH; ++c) column.color[k][c] = fused(weight, color[c], column.color[k][c]);
        }
        if (COLLECT == Collect::everything) stats.n_blended[k] += goes_on & (alpha > Real(0));
        if (COLLECT != Collect::nothing) compete(stats.best[k], id, weight, goes_on);
    }
}

// One splat's sums over a column, whose pixels share dx.
template <class Real, int CH>
struct ColumnSums {
    Real v_color[CH];
    Real m0, my, myy;
    Real abs_x, abs_y;
};

// The cotangent of the exponent, less its sign; where alpha is clamped it passes only if the profile says so (B3).
template <bool PASS, class Real>
POP_HD Real exponent_cotangent(Real unclamped, Real ceiling, Real weight, Real T, Real gain) {
    if (PASS) return unclamped * (T * gain);
    return unclamped > ceiling ? Real(0) : weight * gain;
}

// One splat, back to front, without branches as in blend_forward. Returns whether any pixel took part.
template <bool ABS, bool PASS, class Real, int CH, int ROWS>
POP_HD bool blend_backward(BackwardColumn<Real, CH, ROWS>& column, const PackedSplat<Real>& splat, const Real* color,
                           Real dx, Real y, int position, const BlendConstants<Real>& constants,
                           ColumnSums<Real, CH>& sums) {
    const Real squared_x = mul(mul(splat.hA, dx), dx), cross = mul(splat.B, dx);
    sums.abs_x = sums.abs_y = Real(0);
    bool any = false;
    POP_UNROLL
    for (int k = 0; k < ROWS; ++k) {
        const Real dy = add(splat.y, -(y + Real(k)));
        const Real exponent = exponent_in_column(squared_x, cross, splat.hC, dy);
        const bool reached = (position < column.last[k]) & within(exponent, splat.beyond);
        any |= reached;
        const Real unclamped = reached ? mul(splat.opacity, power_of_two(-exponent)) : Real(0);
        const Real alpha = least(constants.ceiling, unclamped);
        const Real T = column.T[k] * reciprocal(add(Real(1), -alpha));
        // an approximate 1 / 1 must not add up over the splats that do not take part
        if (reached) column.T[k] = T;
        const Real weight = T * alpha;
        Real gain = -column.suffix_dot_grad[k];
        POP_UNROLL
        for (int c = 0; c < CH; ++c) {
            gain += color[c] * column.v_color[k][c];
            const Real v_color = weight * column.v_color[k][c];
            sums.v_color[c] = k == 0 ? v_color : sums.v_color[c] + v_color;
        }
        column.suffix_dot_grad[k] += alpha * gain;
        const Real G = exponent_cotangent<PASS>(unclamped, constants.ceiling, weight, T, gain), G_dy = G * dy;
        // the first is not added to a zero, which costs as much as another
        sums.m0 = k == 0 ? G : sums.m0 + G;
        sums.my = k == 0 ? G_dy : sums.my + G_dy;
        sums.myy = k == 0 ? G_dy * dy : sums.myy + G_dy * dy;
        if (ABS) {
            sums.abs_x += fabs(G * (Real(2) * splat.hA * dx + splat.B * dy));
            sums.abs_y += fabs(G * (splat.B * dx + Real(2) * splat.hC * dy));
        }
    }
    return any;
}

// The colour cotangents, then the moments, of a column at dx.
template <bool ABS, class Real, int CH>
POP_HD void sums_of_column(const ColumnSums<Real, CH>& column, Real dx, Real* sums) {
    POP_UNROLL
    for (int c = 0; c < CH; ++c) sums[c] = column.v_color[c];
    sums[CH + M0] = column.m0;
    sums[CH + MX] = column.m0 * dx;
    sums[CH + MY] = column.my;
    sums[CH + MXX] = column.m0 * dx * dx;
    sums[CH + MXY] = column.my * dx;
    sums[CH + MYY] = column.myy;
    if (ABS) {
        sums[CH + ABS_X] = column.abs_x;
        sums[CH + ABS_Y] = column.abs_y;
    }
}

// A pixel on its way through the splats of a bucket, back to front: the other backward, one splat a lane.
template <class Real>
struct Passing {
    Real T;       // transmittance behind the splat that is visited next
    Real suffix_dot_grad;  // the colour behind that splat, dotted with the pixel's cotangent
};

// The pixel as it leaves its last splat of a bucket, by what the forward pass left at the bucket's end: transmittance,
// and the colour that later buckets blended. That colour is a sum from the back: taking what lies in front off the
// whole image would leave the rounding of all of it where little is left, and an opaque splat then divides by 1 - alpha.
template <class Real, int CH>
POP_HD Passing<Real> passing_after(Real T, Real T_final, const Real* later, const Real* v_color,
                                   Real background_dot_grad) {
    Real left = T_final * background_dot_grad;
    POP_UNROLL
    for (int c = 0; c < CH; ++c) left += later[c] * v_color[c];
    return {T, left * reciprocal(T)};
}

template <bool ABS, bool PASS, class Real, int CH>
POP_HD void pass_pixel(Passing<Real>& pixel, const PackedSplat<Real>& splat, const Real* color, const Real* v_color,
                       Real px, Real py, const BlendConstants<Real>& constants, Real* sums) {
    const Real dx = add(splat.x, -px), dy = add(splat.y, -py);
    const Real squared_x = mul(mul(splat.hA, dx), dx), cross = mul(splat.B, dx);
    const Real exponent = exponent_in_column(squared_x, cross, splat.hC, dy);
    if (!within(exponent, splat.beyond)) return;
    const Real unclamped = mul(splat.opacity, power_of_two(-exponent));
    const Real alpha = least(constants.ceiling, unclamped);
    const Real T = pixel.T * reciprocal(add(Real(1), -alpha));
    const Real weight = T * alpha;
    Real gain = -pixel.suffix_dot_grad;
    POP_UNROLL
    for (int c = 0; c < CH; ++c) {
        gain += color[c] * v_color[c];
        sums[c] += weight * v_color[c];
    }
    pixel.suffix_dot_grad += alpha * gain;
    pixel.T = T;
    const Real G = exponent_cotangent<PASS>(unclamped, constants.ceiling, weight, T, gain);
    const Real G_dx = G * dx, G_dy = G * dy;
    sums[CH + M0] += G;
    sums[CH + MX] += G_dx;
    sums[CH + MY] += G_dy;
    sums[CH + MXX] += G_dx * dx;
    sums[CH + MXY] += G_dx * dy;
    sums[CH + MYY] += G_dy * dy;
    if (ABS) {
        sums[CH + ABS_X] += fabs(G * (Real(2) * splat.hA * dx + splat.B * dy));
        sums[CH + ABS_Y] += fabs(G * (splat.B * dx + Real(2) * splat.hC * dy));
    }
}

// cotangents of a splat from its sums over pixels
template <class Real>
struct SplatVjp {
    Vec2<Real> v_mean2d, v_mean2d_abs;
    Conic<Real> v_conic;
    Real v_opacity;
};

template <bool ABS, class Real>
POP_HD SplatVjp<Real> splat_vjp_from_moments(const Real* m, Conic<Real> conic, Real opacity) {
    const Real A = conic.xx, B = conic.xy, C = conic.yy, half = Real(0.5);
    SplatVjp<Real> v;
    v.v_mean2d = {-(A * m[MX] + B * m[MY]), -(B * m[MX] + C * m[MY])};
    v.v_conic = {-half * m[MXX], -m[MXY], -half * m[MYY]};
    v.v_opacity = opacity > Real(0) ? m[M0] / opacity : Real(0);
    // the kernels' conic carries log2(e)
    v.v_mean2d_abs = ABS ? Vec2<Real>{m[ABS_X] * Real(LN_2), m[ABS_Y] * Real(LN_2)} : Vec2<Real>{Real(0), Real(0)};
    return v;
}

}  // namespace pop
