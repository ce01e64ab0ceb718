// World covariances, Sigma = R diag(s)^2 R^T; the counterpart of pop_ref/covariance.py.
#pragma once

#include "activations.cuh"

namespace pop {

template <class Real>
POP_HD Mat3<Real> rotmat_from_quat(Vec4<Real> quat) {
    const Vec4<Real> u = unit_quat_from_quat(quat);
    const Real w = u.w, x = u.x, y = u.y, z = u.z, one = Real(1), two = Real(2);
    return {{{one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)},
             {two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)},
             {two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)}}};
}

template <class Real>
POP_HD Mat3<Real> columns_scaled(Mat3<Real> a, Vec3<Real> s) {
    Mat3<Real> c;
    for (int i = 0; i < 3; ++i) {
        c.m[i][0] = a.m[i][0] * s.x;
        c.m[i][1] = a.m[i][1] * s.y;
        c.m[i][2] = a.m[i][2] * s.z;
    }
    return c;
}

template <class Real>
POP_HD Mat3<Real> covar_from_quat_scale(Vec4<Real> quat, Vec3<Real> scale) {
    const Mat3<Real> M = columns_scaled(rotmat_from_quat(quat), scale);
    return times(M, transposed(M));
}

// In the Gaussian's own axes: with S' = R^T (v_covar + v_covar^T) R the gradient with respect to a turn about axis x is
// S'_yz (s_y^2 - s_z^2). Taken by way of R, terms of the size of s^2 would cancel to that, and for round Gaussians to
// nothing but rounding.
template <class Real>
POP_HD void covar_from_quat_scale_vjp(Vec4<Real> quat, Vec3<Real> scale, Mat3<Real> v_covar, Vec4<Real>& v_quat,
                                      Vec3<Real>& v_scale) {
    const Mat3<Real> R = rotmat_from_quat(quat);
    const Mat3<Real> own = times(transposed(R), times(sum(v_covar, transposed(v_covar)), R));
    v_scale = {own.m[0][0] * scale.x, own.m[1][1] * scale.y, own.m[2][2] * scale.z};
    const Real turn_x = own.m[1][2] * ((scale.y - scale.z) * (scale.y + scale.z));
    const Real turn_y = own.m[0][2] * ((scale.z - scale.x) * (scale.z + scale.x));
    const Real turn_z = own.m[0][1] * ((scale.x - scale.y) * (scale.x + scale.y));
    // a turn by t about an axis a takes the unit quaternion u to u + u (0, a) t / 2
    const Vec4<Real> u = unit_quat_from_quat(quat);
    const Real factor = Real(2) / quat_norm(quat);
    v_quat = {-factor * (u.x * turn_x + u.y * turn_y + u.z * turn_z),
              factor * (u.w * turn_x + u.y * turn_z - u.z * turn_y),
              factor * (u.w * turn_y + u.z * turn_x - u.x * turn_z),
              factor * (u.w * turn_z + u.x * turn_y - u.y * turn_x)};
}

}  // namespace pop
