// Camera to screen: centres by the pinhole, covariances by its Jacobian; the counterpart of pop_ref/projection.py.
#pragma once

#include "profile.cuh"

namespace pop {

template <class Real>
struct Limits {
    Real low, high;
};

template <class Real>
POP_HD Vec2<Real> project_mean(Vec3<Real> p, Camera<Real> camera) {
    return {camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy};
}

template <class Real>
POP_HD Vec3<Real> project_mean_vjp(Vec3<Real> p, Camera<Real> camera, Vec2<Real> v) {
    const Real fx = camera.fx, fy = camera.fy, z = p.z;
    return {fx / z * v.x, fy / z * v.y, -(fx * p.x * v.x + fy * p.y * v.y) / (z * z)};
}

// B1: the window that x/z is clamped to, for one axis
template <class Real>
POP_HD Limits<Real> frustum_limits(Real f, Real c, int size, const Profile<Real>& profile) {
    const Real margin = profile.frustum_margin * Real(0.5) * Real(size) / f;
    return {-(c / f + margin), (Real(size) - c) / f + margin};
}

template <class Real>
POP_HD Mat23<Real> projection_jacobian(Vec3<Real> p, Camera<Real> camera, const Profile<Real>& profile) {
    const Limits<Real> limits_x = frustum_limits(camera.fx, camera.cx, camera.width, profile);
    const Limits<Real> limits_y = frustum_limits(camera.fy, camera.cy, camera.height, profile);
    const Real x = p.x, y = p.y, z = p.z, fx = camera.fx, fy = camera.fy;
    const Real tx = z * clamped(x / z, limits_x.low, limits_x.high);
    const Real ty = z * clamped(y / z, limits_y.low, limits_y.high);
    return {{{fx / z, Real(0), -fx * tx / (z * z)}, {Real(0), fy / z, -fy * ty / (z * z)}}};
}

// the transpose of (x, z) -> -fx tx / z^2, one axis of the Jacobian's last column
template <class Real>
POP_HD Vec2<Real> offset_vjp(Real x, Real z, Real fx, Limits<Real> limits, Real v_offset,
                             const Profile<Real>& profile) {
    const Real tx = z * clamped(x / z, limits.low, limits.high);
    // B1: at exactly the limit the derivative from inside is used
    if (limits.low <= x / z && x / z <= limits.high)
        return {-fx / (z * z) * v_offset, Real(2) * fx * tx / (z * z * z) * v_offset};
    if (profile.inria_clamp) return {Real(0), Real(2) * fx * tx / (z * z * z) * v_offset};
    return {Real(0), fx * tx / (z * z * z) * v_offset};
}

template <class Real>
POP_HD Vec3<Real> projection_jacobian_vjp(Vec3<Real> p, Camera<Real> camera, Mat23<Real> v_J,
                                          const Profile<Real>& profile) {
    const Limits<Real> limits_x = frustum_limits(camera.fx, camera.cx, camera.width, profile);
    const Limits<Real> limits_y = frustum_limits(camera.fy, camera.cy, camera.height, profile);
    const Vec2<Real> v_xz = offset_vjp(p.x, p.z, camera.fx, limits_x, v_J.m[0][2], profile);
    const Vec2<Real> v_yz = offset_vjp(p.y, p.z, camera.fy, limits_y, v_J.m[1][2], profile);
    const Real focal = (camera.fx * v_J.m[0][0] + camera.fy * v_J.m[1][1]) / (p.z * p.z);
    return {v_xz.x, v_yz.x, v_xz.y + v_yz.y - focal};
}

template <class Real>
POP_HD Mat2<Real> project_covar(Mat3<Real> covar_cam, Mat23<Real> J) {
    const Mat23<Real> left = times(J, covar_cam);
    Mat2<Real> covar2d;
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 2; ++j)
            covar2d.m[i][j] = left.m[i][0] * J.m[j][0] + left.m[i][1] * J.m[j][1] + left.m[i][2] * J.m[j][2];
    return covar2d;
}

template <class Real>
POP_HD Mat23<Real> times(Mat2<Real> V, Mat23<Real> J) {
    Mat23<Real> c;
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 3; ++j) c.m[i][j] = V.m[i][0] * J.m[0][j] + V.m[i][1] * J.m[1][j];
    return c;
}

template <class Real>
POP_HD void project_covar_vjp(Mat3<Real> Sigma, Mat23<Real> J, Mat2<Real> V, Mat3<Real>& v_covar_cam,
                              Mat23<Real>& v_J) {
    const Mat2<Real> Vt = {{{V.m[0][0], V.m[1][0]}, {V.m[0][1], V.m[1][1]}}};
    const Mat23<Real> VJ = times(V, J), VtJ = times(Vt, J);
    const Mat23<Real> one_way = times(VJ, transposed(Sigma)), other_way = times(VtJ, Sigma);
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 3; ++j) v_J.m[i][j] = one_way.m[i][j] + other_way.m[i][j];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) v_covar_cam.m[i][j] = J.m[0][i] * VJ.m[0][j] + J.m[1][i] * VJ.m[1][j];
}

}  // namespace pop
