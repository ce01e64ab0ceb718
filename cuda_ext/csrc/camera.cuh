// World to camera: centre, directions, points, covariances, the near-plane cull; the counterpart of pop_ref/camera.py.
#pragma once

#include "profile.cuh"

namespace pop {

// cotangent of viewmat's twelve upper entries
template <class Real>
struct ViewmatVjp {
    Mat3<Real> v_R;
    Vec3<Real> v_t;
};

template <class Real>
POP_HD Vec3<Real> camera_center(Camera<Real> camera) {
    const Vec3<Real> back = times(transposed(camera.R), camera.t);
    return {-back.x, -back.y, -back.z};
}

template <class Real>
POP_HD ViewmatVjp<Real> camera_center_vjp(Camera<Real> camera, Vec3<Real> v_center) {
    const Vec3<Real> t = camera.t, v_t = times(camera.R, v_center);
    return {outer(Vec3<Real>{-t.x, -t.y, -t.z}, v_center), {-v_t.x, -v_t.y, -v_t.z}};
}

template <class Real>
POP_HD Vec3<Real> view_dir(Vec3<Real> mean, Camera<Real> camera) {
    const Vec3<Real> center = camera_center(camera);
    return {mean.x - center.x, mean.y - center.y, mean.z - center.z};
}

template <class Real>
POP_HD Vec3<Real> mean_cam_from_mean(Vec3<Real> mean, Camera<Real> camera) {
    return sum(times(camera.R, mean), camera.t);
}

template <class Real>
POP_HD Vec3<Real> mean_cam_from_mean_vjp(Vec3<Real> mean, Camera<Real> camera, Vec3<Real> v_mean_cam,
                                         ViewmatVjp<Real>& v_viewmat) {
    v_viewmat.v_R = sum(v_viewmat.v_R, outer(v_mean_cam, mean));
    v_viewmat.v_t = sum(v_viewmat.v_t, v_mean_cam);
    return times(transposed(camera.R), v_mean_cam);
}

template <class Real>
POP_HD Mat3<Real> covar_cam_from_covar(Mat3<Real> covar, Camera<Real> camera) {
    return times(times(camera.R, covar), transposed(camera.R));
}

template <class Real>
POP_HD Mat3<Real> covar_cam_from_covar_vjp(Mat3<Real> covar, Camera<Real> camera, Mat3<Real> V,
                                           ViewmatVjp<Real>& v_viewmat) {
    const Mat3<Real> R = camera.R;
    const Mat3<Real> one_way = times(times(V, R), transposed(covar));
    const Mat3<Real> other_way = times(times(transposed(V), R), covar);
    v_viewmat.v_R = sum(v_viewmat.v_R, sum(one_way, other_way));
    return times(times(transposed(R), V), R);
}

// D1
template <class Real>
POP_HD bool in_front(Real depth, const Profile<Real>& profile) {
    const bool beyond_near = profile.near_inclusive ? depth > profile.near_plane : depth >= profile.near_plane;
    return beyond_near && depth <= profile.far_plane;
}

}  // namespace pop
