// World covariances, Sigma = R diag(s)^2 R^T; beside pop_ref/covariance.py.
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
POP_HD Vec4<Real> rotmat_from_quat_vjp(Vec4<Real> quat, Mat3<Real> v_rotmat) {
    const Vec4<Real> u = unit_quat_from_quat(quat);
    const Real w = u.w, x = u.x, y = u.y, z = u.z, two = Real(2);
    const Real v00 = v_rotmat.m[0][0], v01 = v_rotmat.m[0][1], v02 = v_rotmat.m[0][2];
    const Real v10 = v_rotmat.m[1][0], v11 = v_rotmat.m[1][1], v12 = v_rotmat.m[1][2];
    const Real v20 = v_rotmat.m[2][0], v21 = v_rotmat.m[2][1], v22 = v_rotmat.m[2][2];
    const Vec4<Real> v_u = {
        two * (x * (v21 - v12) + y * (v02 - v20) + z * (v10 - v01)),
        two * (w * (v21 - v12) + y * (v01 + v10) + z * (v02 + v20) - two * x * (v11 + v22)),
        two * (w * (v02 - v20) + x * (v01 + v10) + z * (v12 + v21) - two * y * (v00 + v22)),
        two * (w * (v10 - v01) + x * (v02 + v20) + y * (v12 + v21) - two * z * (v00 + v11)),
    };
    return unit_quat_from_quat_vjp(quat, v_u);
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

template <class Real>
POP_HD void covar_from_quat_scale_vjp(Vec4<Real> quat, Vec3<Real> scale, Mat3<Real> v_covar, Vec4<Real>& v_quat,
                                      Vec3<Real>& v_scale) {
    const Mat3<Real> R = rotmat_from_quat(quat);
    const Mat3<Real> v_M = times(sum(v_covar, transposed(v_covar)), columns_scaled(R, scale));
    const Mat3<Real> v_R = columns_scaled(v_M, scale);
    v_scale.x = R.m[0][0] * v_M.m[0][0] + R.m[1][0] * v_M.m[1][0] + R.m[2][0] * v_M.m[2][0];
    v_scale.y = R.m[0][1] * v_M.m[0][1] + R.m[1][1] * v_M.m[1][1] + R.m[2][1] * v_M.m[2][1];
    v_scale.z = R.m[0][2] * v_M.m[0][2] + R.m[1][2] * v_M.m[1][2] + R.m[2][2] * v_M.m[2][2];
    v_quat = rotmat_from_quat_vjp(quat, v_R);
}

}  // namespace pop
