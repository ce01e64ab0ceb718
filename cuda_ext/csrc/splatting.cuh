// All that happens to a Gaussian before a pixel is touched, and its transpose; the counterpart of pop_ref/splatting.py.
#pragma once

#include "camera.cuh"
#include "covariance.cuh"
#include "footprint.cuh"
#include "harmonics.cuh"
#include "projection.cuh"

namespace pop {

template <class Real>
struct GaussianRow {
    Vec3<Real> mean;
    Vec4<Real> quat;
    Vec3<Real> scale;
    Real opacity;
};

template <class Real>
struct SplatRow {
    Vec2<Real> mean2d;
    Real depth;
    Conic<Real> conic;
    Real opacity;
    Radii radii;  // both 0 where culled
};

template <class Real>
struct GaussianVjp {
    Vec3<Real> v_mean;
    Vec4<Real> v_quat;
    Vec3<Real> v_scale;
    Real v_opacity;
};

// what a trainer asks beyond the profile
template <class Real>
struct ProjectOptions {
    bool antialiased;
    Real radius_clip;  // px; both extents at most this are culled
};

template <class Real>
POP_HD SplatRow<Real> culled(Real depth) {
    const Real zero = Real(0);
    return {{zero, zero}, depth, {zero, zero, zero}, zero, {0, 0}};
}

// A Gaussian on the screen, before its extent tells whether any pixel sees it.
template <class Real>
struct ScreenGaussian {
    Vec2<Real> mean2d;
    Real depth;
    Mat2<Real> covar2d;  // after the low-pass
    Real opacity;        // effective
};

// For a Gaussian in front of the camera (D1).
template <class Real>
POP_HD ScreenGaussian<Real> screen_gaussian(Vec3<Real> mean_cam, const Mat3<Real>& covar, Real opacity,
                                            const Camera<Real>& camera, const Profile<Real>& profile,
                                            const ProjectOptions<Real>& options) {
    const Mat3<Real> covar_cam = covar_cam_from_covar(covar, camera);
    const Mat2<Real> covar2d = project_covar(covar_cam, projection_jacobian(mean_cam, camera, profile));
    const Real effective_opacity = options.antialiased ? opacity * compensation(covar2d, profile.eps2d) : opacity;
    return {project_mean(mean_cam, camera), mean_cam.z, low_pass(covar2d, profile.eps2d), effective_opacity};
}

template <class Real>
POP_HD SplatRow<Real> splat_on_screen(const ScreenGaussian<Real>& g, const Camera<Real>& camera,
                                      const Profile<Real>& profile, const ProjectOptions<Real>& options) {
    const Radii radii = radii_from_covar2d(g.covar2d, g.opacity, profile);
    const bool clipped = Real(radii.x) <= options.radius_clip && Real(radii.y) <= options.radius_clip;
    if (clipped || !on_screen(g.mean2d, radii, camera.width, camera.height, profile)) return culled(g.depth);  // D2
    return {g.mean2d, g.depth, conic_from_covar2d(g.covar2d), g.opacity, radii};
}

// For a Gaussian in front of the camera (D1).
template <class Real>
POP_HD SplatRow<Real> splat_in_front(Vec3<Real> mean_cam, const Mat3<Real>& covar, Real opacity,
                                     const Camera<Real>& camera, const Profile<Real>& profile,
                                     const ProjectOptions<Real>& options) {
    const ScreenGaussian<Real> g = screen_gaussian(mean_cam, covar, opacity, camera, profile, options);
    return splat_on_screen(g, camera, profile, options);
}

template <class Real>
POP_HD SplatRow<Real> project_one(const GaussianRow<Real>& g, const Camera<Real>& camera,
                                  const Profile<Real>& profile, const ProjectOptions<Real>& options) {
    const Vec3<Real> mean_cam = mean_cam_from_mean(g.mean, camera);
    if (!in_front(mean_cam.z, profile)) return culled(mean_cam.z);  // D1
    return splat_in_front(mean_cam, covar_from_quat_scale(g.quat, g.scale), g.opacity, camera, profile, options);
}

// cotangents of what blends; v_factor is that of the antialiasing factor itself
template <class Real>
struct SplatCotangents {
    Vec2<Real> v_mean2d;
    Real v_depth;
    Conic<Real> v_conic;
    Real v_opacity, v_factor;
};

template <class Real>
struct CovarVjp {
    Vec3<Real> v_mean;
    Mat3<Real> v_covar;
    Real v_opacity;
};

// For a Gaussian that was kept; v_viewmat is added to.
template <class Real>
POP_HD CovarVjp<Real> splat_in_front_vjp(Vec3<Real> mean, const Mat3<Real>& covar, Real opacity,
                                         const Camera<Real>& camera, const Profile<Real>& profile,
                                         const ProjectOptions<Real>& options, const SplatCotangents<Real>& given,
                                         ViewmatVjp<Real>& v_viewmat) {
    const Vec3<Real> mean_cam = mean_cam_from_mean(mean, camera);
    const Mat3<Real> covar_cam = covar_cam_from_covar(covar, camera);
    const Mat23<Real> J = projection_jacobian(mean_cam, camera, profile);
    const Mat2<Real> covar2d = project_covar(covar_cam, J);

    CovarVjp<Real> v;
    Mat2<Real> v_covar2d = conic_from_covar2d_vjp(low_pass(covar2d, profile.eps2d), given.v_conic);
    v.v_opacity = given.v_opacity;
    if (options.antialiased) {
        const Real v_factor = given.v_opacity * opacity + given.v_factor;
        const Mat2<Real> of_factor = compensation_vjp(covar2d, profile.eps2d, v_factor);
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j) v_covar2d.m[i][j] += of_factor.m[i][j];
        v.v_opacity = given.v_opacity * compensation(covar2d, profile.eps2d);
    }
    Mat3<Real> v_covar_cam;
    Mat23<Real> v_J;
    project_covar_vjp(covar_cam, J, v_covar2d, v_covar_cam, v_J);
    v.v_covar = covar_cam_from_covar_vjp(covar, camera, v_covar_cam, v_viewmat);

    Vec3<Real> v_mean_cam = projection_jacobian_vjp(mean_cam, camera, v_J, profile);
    v_mean_cam = sum(v_mean_cam, project_mean_vjp(mean_cam, camera, given.v_mean2d));
    v_mean_cam.z += given.v_depth;
    v.v_mean = mean_cam_from_mean_vjp(mean, camera, v_mean_cam, v_viewmat);
    return v;
}

// The same for project_one; v_dir is the view direction's cotangent.
template <class Real>
POP_HD GaussianVjp<Real> project_one_vjp(const GaussianRow<Real>& g, const Camera<Real>& camera,
                                         const Profile<Real>& profile, const ProjectOptions<Real>& options,
                                         const SplatCotangents<Real>& given, Vec3<Real> v_dir,
                                         ViewmatVjp<Real>& v_viewmat) {
    const Mat3<Real> covar = covar_from_quat_scale(g.quat, g.scale);
    const CovarVjp<Real> of_covar =
        splat_in_front_vjp(g.mean, covar, g.opacity, camera, profile, options, given, v_viewmat);
    GaussianVjp<Real> v;
    v.v_mean = sum(of_covar.v_mean, v_dir);
    v.v_opacity = of_covar.v_opacity;
    covar_from_quat_scale_vjp(g.quat, g.scale, of_covar.v_covar, v.v_quat, v.v_scale);
    const ViewmatVjp<Real> of_center = camera_center_vjp(camera, Vec3<Real>{-v_dir.x, -v_dir.y, -v_dir.z});
    v_viewmat = {sum(v_viewmat.v_R, of_center.v_R), sum(v_viewmat.v_t, of_center.v_t)};
    return v;
}

}  // namespace pop
