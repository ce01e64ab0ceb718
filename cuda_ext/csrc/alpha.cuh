// One splat at one pixel; the counterpart of pop_ref/alpha.py.
//
// The kernels' form folds log2(e) into the conic once per splat, so that a pair costs two fused multiply-adds, a
// subtraction and a comparison before the first that needs exp2:
//     sigma log2(e) = hA dx^2 + dy (hC dy + B dx),    hA = A log2(e) / 2, B = B log2(e), hC = C log2(e) / 2.
// That comparison is D5 as well: o 2^-x >= floor where x <= log2(o / floor), which is made once a splat.
#pragma once

#include "footprint.cuh"

namespace pop {

constexpr double LOG2_E = 1.44269504088896340736;
constexpr double LN_2 = 0.693147180559945309417;

// what the kernels ask of a profile, with every strictness turned into a number
template <class Real>
struct BlendConstants {
    Real ceiling;  // D6
    Real stop;  // D7: the pixel ends where next_T <= stop
};

template <class Real>
inline BlendConstants<Real> blend_constants(const Profile<Real>& profile) {
    const Real stop = profile.transmittance_stop;
    return {profile.alpha_ceiling, profile.stop_inclusive ? stop : Real(nextafter(stop, Real(0)))};
}

// a splat as the kernels blend it
template <class Real>
struct PackedSplat {
    Real x, y;
    Real hA, B, hC;
    Real opacity;
    Real beyond;  // the first sigma log2(e) at which alpha is under the floor; 0 where it is everywhere (D5)
};

template <class Real>
POP_HD PackedSplat<Real> packed_from_splat(Vec2<Real> mean2d, Conic<Real> conic, Real opacity, Real floor) {
    const Real half_log2_e = Real(0.5 * LOG2_E), log2_e = Real(LOG2_E);
    const Real reach = log2(opacity / floor);
    const Real beyond = reach >= Real(0) ? Real(nextafter(reach, Real(INFINITY))) : Real(0);
    return {mean2d.x, mean2d.y, conic.xx * half_log2_e, conic.xy * log2_e, conic.yy * half_log2_e, opacity, beyond};
}

// sigma log2(e), from what a column of pixels shares
template <class Real>
POP_HD Real exponent_in_column(Real squared_x, Real cross, Real hC, Real dy) {
    return fused(dy, fused(hC, dy, cross), squared_x);
}

}  // namespace pop
