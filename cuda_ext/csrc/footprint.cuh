// The splat on the screen: low-pass, antialiasing factor, conic, extents; the counterpart of pop_ref/footprint.py.
#pragma once

#include "profile.cuh"
#include "tiles.cuh"

namespace pop {

template <class Real>
struct Conic {
    Real xx, xy, yy;
};

constexpr double LARGEST_RADIUS = 2147483647.0, LARGEST_RADIUS_FLOAT = 2147483520.0;  // under 2^31 in each precision

template <class Real>
POP_HD Real det(Mat2<Real> s) {
    return s.m[0][0] * s.m[1][1] - s.m[0][1] * s.m[1][0];
}

template <class Real>
POP_HD Mat2<Real> inverse(Mat2<Real> s) {
    // the two off-diagonals differ by rounding at most; their mean makes the inverse symmetric
    const Real off = Real(-0.5) * (s.m[0][1] + s.m[1][0]);
    const Real d = det(s);
    return {{{s.m[1][1] / d, off / d}, {off / d, s.m[0][0] / d}}};
}

template <class Real>
POP_HD Mat2<Real> low_pass(Mat2<Real> s, Real eps2d) {
    return {{{s.m[0][0] + eps2d, s.m[0][1]}, {s.m[1][0], s.m[1][1] + eps2d}}};
}

template <class Real>
POP_HD Real compensation(Mat2<Real> s, Real eps2d) {
    const Real det_sharp = det(s), det_blurred = det(low_pass(s, eps2d));
    return det_sharp > Real(0) && det_blurred > Real(0) ? sqrt(det_sharp / det_blurred) : Real(0);
}

template <class Real>
POP_HD Mat2<Real> compensation_vjp(Mat2<Real> s, Real eps2d, Real v_factor) {
    const Real factor = compensation(s, eps2d);
    if (!(factor > Real(0))) return {{{Real(0), Real(0)}, {Real(0), Real(0)}}};
    const Mat2<Real> sharp = inverse(s), blurred = inverse(low_pass(s, eps2d));
    const Real c = v_factor * factor / Real(2);
    Mat2<Real> v;
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 2; ++j) v.m[i][j] = c * (sharp.m[i][j] - blurred.m[i][j]);
    return v;
}

// zero where the determinant is not positive
template <class Real>
POP_HD Conic<Real> conic_from_covar2d(Mat2<Real> s) {
    if (!(det(s) > Real(0))) return {Real(0), Real(0), Real(0)};
    const Mat2<Real> Q = inverse(s);
    return {Q.m[0][0], Q.m[0][1], Q.m[1][1]};
}

template <class Real>
POP_HD Mat2<Real> conic_from_covar2d_vjp(Mat2<Real> s, Conic<Real> v) {
    if (!(det(s) > Real(0))) return {{{Real(0), Real(0)}, {Real(0), Real(0)}}};
    const Mat2<Real> Q = inverse(s);
    const Real a = Q.m[0][0], b = Q.m[0][1], c = Q.m[1][1], half = v.xy / Real(2);
    const Real ax = a * v.xx + b * half, ay = a * half + b * v.yy;
    const Real bx = b * v.xx + c * half, by = b * half + c * v.yy;
    return {{{-(ax * a + ay * b), -(ax * b + ay * c)}, {-(bx * a + by * b), -(bx * b + by * c)}}};
}

template <class Real>
POP_HD int radius_from_reach(Real reach) {
    return int(min_of(ceil(reach), Real(sizeof(Real) == 4 ? LARGEST_RADIUS_FLOAT : LARGEST_RADIUS)));
}

// D2
template <class Real>
POP_HD Radii radii_from_covar2d(Mat2<Real> s, Real opacity, const Profile<Real>& profile) {
    const Real a = s.m[0][0], c = s.m[1][1], d = det(s);
    if (!(d > Real(0))) return {0, 0};
    if (profile.square) {
        const Real middle = Real(0.5) * (a + c);
        const Real largest = middle + sqrt(max_of(Real(0.1), middle * middle - d));
        const int r = radius_from_reach(profile.extent_sigmas * sqrt(largest));
        return {r, r};
    }
    if (!(opacity >= profile.alpha_floor)) return {0, 0};
    // a float's 1/255 may be rounded up: the logarithm is charged that, so that the extent still encloses
    const Real charge = sizeof(Real) == 4 ? Real(6e-8) : Real(0);
    const Real k = min_of(profile.extent_sigmas, sqrt(Real(2) * (log(opacity / profile.alpha_floor) + charge)));
    return {radius_from_reach(k * sqrt(a)), radius_from_reach(k * sqrt(c))};
}

// D2
template <class Real>
POP_HD bool on_screen(Vec2<Real> mean2d, Radii radii, int width, int height, const Profile<Real>& profile) {
    if (radii.x <= 0 || radii.y <= 0) return false;
    if (profile.square) {
        const TileGrid grid = grid_of(width, height, profile.tile_size, profile.tile_size);
        return n_tiles_in(tile_rect(mean2d, radii, grid, profile)) > 0;
    }
    const Real rx = Real(radii.x), ry = Real(radii.y);
    return mean2d.x + rx > Real(0) && mean2d.x - rx < Real(width) && mean2d.y + ry > Real(0) &&
           mean2d.y - ry < Real(height);
}

}  // namespace pop
