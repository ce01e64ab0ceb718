// Front-to-back blending of a column of pixels, and two ways back; beside pop_ref/pixel.py and compositing.py.
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
    Real T[ROWS];
    Real color[ROWS][CH];
    int last[ROWS];  // list position behind the last blended splat; 0 where none was
    unsigned open;   // bit k: pixel k still takes splats
};

// what only some instantiations keep
template <class Real, int ROWS>
struct Instruments {
    Dominant<Real> best[ROWS];
    int n_blended[ROWS], n_traversed[ROWS];
};

template <class Real, int CH, int ROWS>
struct BackwardColumn {
    Real T[ROWS];        // transmittance behind the splat that is visited next
    Real behind[ROWS];   // what the light that passes that splat is worth
    Real v_color[ROWS][CH];
    int last[ROWS];
};

template <bool TELL, class Real, int CH, int ROWS>
POP_HD void start_forward(ForwardColumn<Real, CH, ROWS>& column, Instruments<Real, ROWS>& told, int rows_inside) {
    column.open = 0u;
    POP_UNROLL
    for (int k = 0; k < ROWS; ++k) {
        column.T[k] = Real(1);
        column.last[k] = 0;
        POP_UNROLL
        for (int c = 0; c < CH; ++c) column.color[k][c] = Real(0);
        if (k < rows_inside) column.open |= 1u << k;
        if (TELL) {
            told.best[k] = no_dominant<Real>();
            told.n_blended[k] = told.n_traversed[k] = 0;
        }
    }
}

// px, py: the first pixel's centre; position: the splat's place in the list
template <bool TELL, class Real, int CH, int ROWS>
POP_HD void blend_forward(ForwardColumn<Real, CH, ROWS>& column, Instruments<Real, ROWS>& told,
                          const Blended<Real>& splat, const Real* color, int id, Real px, Real py, int position,
                          const BlendConstants<Real>& constants) {
    const Real dx = add(splat.x, -px);
    const Real squared_x = mul(mul(splat.hA, dx), dx), cross = mul(splat.B, dx);
    POP_UNROLL
    for (int k = 0; k < ROWS; ++k) {
        const bool open = (column.open >> k) & 1u;
        if (TELL && open) told.n_traversed[k] = position + 1;
        const Real dy = add(splat.y, -(py + Real(k)));
        const Real exponent = exponent_in_column(squared_x, cross, splat.hC, dy);
        if (!open || exponent > splat.reach || exponent < Real(0)) continue;
        const Real alpha = min_of(constants.ceiling, mul(splat.opacity, power_of_two(-exponent)));  // D6
        if (alpha < constants.floor) continue;                                                      // D5
        const Real T = column.T[k];
        const Real next_T = mul(T, add(Real(1), -alpha));
        if (next_T <= constants.stop) {  // D7: this splat is not blended
            column.open &= ~(1u << k);
            continue;
        }
        const Real weight = mul(T, alpha);
        POP_UNROLL
        for (int c = 0; c < CH; ++c) column.color[k][c] = fused(weight, color[c], column.color[k][c]);
        if (TELL) {
            ++told.n_blended[k];
            compete(told.best[k], id, weight);
        }
        column.last[k] = position + 1;
        column.T[k] = next_T;
    }
}

// One splat, back to front: sums[0..CH) += weight v_color, then the moments. Returns whether any pixel took part.
template <bool ABS, class Real, int CH, int ROWS>
POP_HD bool blend_backward(BackwardColumn<Real, CH, ROWS>& column, const Blended<Real>& splat, const Real* color,
                           Real px, Real py, int position, const BlendConstants<Real>& constants, Real* sums) {
    const Real dx = add(splat.x, -px);
    const Real squared_x = mul(mul(splat.hA, dx), dx), cross = mul(splat.B, dx);
    Real m0 = Real(0), my = Real(0), myy = Real(0);
    bool any = false;
    POP_UNROLL
    for (int k = 0; k < ROWS; ++k) {
        const Real dy = add(splat.y, -(py + Real(k)));
        const Real exponent = exponent_in_column(squared_x, cross, splat.hC, dy);
        if (position >= column.last[k] || exponent > splat.reach || exponent < Real(0)) continue;
        const Real unclamped = mul(splat.opacity, power_of_two(-exponent));
        const Real alpha = min_of(constants.ceiling, unclamped);
        if (alpha < constants.floor) continue;
        any = true;
        const Real T = column.T[k] * reciprocal(add(Real(1), -alpha));
        const Real weight = T * alpha;
        Real worth = Real(0);
        POP_UNROLL
        for (int c = 0; c < CH; ++c) {
            worth += color[c] * column.v_color[k][c];
            sums[c] += weight * column.v_color[k][c];
        }
        const Real gain = worth - column.behind[k];
        const Real v_alpha = T * gain;
        column.behind[k] += alpha * gain;
        column.T[k] = T;
        const Real G = unclamped > constants.gradient_ceiling ? Real(0) : unclamped * v_alpha;  // B3
        m0 += G;
        my += G * dy;
        myy += G * dy * dy;
        if (ABS) {
            sums[CH + ABS_X] += fabs(G * (Real(2) * splat.hA * dx + splat.B * dy));
            sums[CH + ABS_Y] += fabs(G * (splat.B * dx + Real(2) * splat.hC * dy));
        }
    }
    sums[CH + M0] += m0;
    sums[CH + MX] += m0 * dx;
    sums[CH + MY] += my;
    sums[CH + MXX] += m0 * dx * dx;
    sums[CH + MXY] += my * dx;
    sums[CH + MYY] += myy;
    return any;
}

// A pixel on its way through the splats of a bucket, back to front: the other family, one splat a lane.
template <class Real>
struct Passing {
    Real T;       // transmittance behind the splat that is visited next
    Real behind;  // what the light that passes that splat is worth
};

// The pixel as it leaves its last splat of a bucket, by what the forward pass left at the bucket's end: transmittance,
// and the colour that later buckets blended. That colour is a sum from the back: taking what lies in front off the
// whole image would leave the rounding of all of it where little is left, and an opaque splat then divides by 1 - alpha.
template <class Real, int CH>
POP_HD Passing<Real> passing_behind(Real T, Real T_final, const Real* later, const Real* v_color, Real worth_behind) {
    Real left = T_final * worth_behind;
    POP_UNROLL
    for (int c = 0; c < CH; ++c) left += later[c] * v_color[c];
    return {T, left * reciprocal(T)};
}

template <bool ABS, class Real, int CH>
POP_HD void pass_pixel(Passing<Real>& pixel, const Blended<Real>& splat, const Real* color, const Real* v_color,
                       Real px, Real py, const BlendConstants<Real>& constants, Real* sums) {
    const Real dx = add(splat.x, -px), dy = add(splat.y, -py);
    const Real squared_x = mul(mul(splat.hA, dx), dx), cross = mul(splat.B, dx);
    const Real exponent = exponent_in_column(squared_x, cross, splat.hC, dy);
    if (exponent > splat.reach || exponent < Real(0)) return;
    const Real unclamped = mul(splat.opacity, power_of_two(-exponent));
    const Real alpha = min_of(constants.ceiling, unclamped);
    if (alpha < constants.floor) return;
    const Real T = pixel.T * reciprocal(add(Real(1), -alpha));
    const Real weight = T * alpha;
    Real worth = Real(0);
    POP_UNROLL
    for (int c = 0; c < CH; ++c) {
        worth += color[c] * v_color[c];
        sums[c] += weight * v_color[c];
    }
    const Real gain = worth - pixel.behind;
    const Real v_alpha = T * gain;
    pixel.behind += alpha * gain;
    pixel.T = T;
    const Real G = unclamped > constants.gradient_ceiling ? Real(0) : unclamped * v_alpha;  // B3
    sums[CH + M0] += G;
    sums[CH + MX] += G * dx;
    sums[CH + MY] += G * dy;
    sums[CH + MXX] += G * dx * dx;
    sums[CH + MXY] += G * dx * dy;
    sums[CH + MYY] += G * dy * dy;
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
