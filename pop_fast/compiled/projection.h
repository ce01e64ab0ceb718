// Covariances, and Gaussians as one camera sees them, with the transposes. Meaning: `pop_ref.covariance` and
// `pop_ref.splatting`; the arithmetic of one Gaussian is the one that the CUDA kernels run.
#pragma once

#include <algorithm>
#include <cstdint>

#include "cuda_ext/csrc/splatting.cuh"
#include "threads.h"

namespace pop {

constexpr int64_t ROWS_AT_A_TIME = 1024;

// Everything of one call; eight bytes each, in the order of `library.py`.
template <class Real> struct Covariances {
  const Real *quats, *scales;  // [N, 4], [N, 3]
  int64_t n, threads;
  Real *covars;                // [N, 3, 3]
  const Real *v_covars;        // [N, 3, 3]
  Real *v_quats, *v_scales;    // [N, 4], [N, 3]

  Vec4<Real> quat(int64_t i) const { return {quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]}; }
  Vec3<Real> scale(int64_t i) const { return {scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]}; }
};

template <class Real> struct Projection {
  const Real *means, *covars, *opacities, *viewmat, *K;  // [N, 3], [N, 3, 3], [N], [4, 4], [3, 3]
  int64_t n, threads, width, height, tile_size;
  int64_t near_inclusive, centred, inria_clamp, square, antialiased;  // see profile.cuh
  double near_plane, far_plane, eps2d, frustum_margin, extent_sigmas, alpha_floor, radius_clip;
  // [N, 2], [N], [N, 3], [N], [N]; factors only if antialiased
  Real *means2d, *depths, *conics, *effective_opacities, *factors;
  int32_t *radii;                                       // 0 where culled; the transpose takes them. [N, 2]
  // component rows: [2, N], [N], [3, N], [N], [N]
  const Real *v_means2d, *v_depths, *v_conics, *v_effective_opacities, *v_factors;
  Real *v_means, *v_covars, *v_opacities;                               // [N, 3], [N, 3, 3], [N]
  Real *v_viewmats;  // rows of [R | t], a sum for every ROWS_AT_A_TIME Gaussians, or null. [parts, 12]

  Vec3<Real> mean(int64_t i) const { return {means[3 * i], means[3 * i + 1], means[3 * i + 2]}; }
  Camera<Real> camera() const { return camera_from_matrices(viewmat, K, int(width), int(height), centred != 0); }
  ProjectOptions<Real> options() const { return {antialiased != 0, Real(radius_clip)}; }
  Profile<Real> profile() const {
    Profile<Real> profile = {};  // what blends is not asked here
    profile.near_plane = Real(near_plane);
    profile.far_plane = Real(far_plane);
    profile.eps2d = Real(eps2d);
    profile.frustum_margin = Real(frustum_margin);
    profile.extent_sigmas = Real(extent_sigmas);
    profile.alpha_floor = Real(alpha_floor);
    profile.tile_size = int(tile_size);
    profile.near_inclusive = near_inclusive != 0;
    profile.centred = centred != 0;
    profile.inria_clamp = inria_clamp != 0;
    profile.square = square != 0;
    return profile;
  }
};

template <class Real> inline Mat3<Real> load_mat3(const Real *from) {
  return {{{from[0], from[1], from[2]}, {from[3], from[4], from[5]}, {from[6], from[7], from[8]}}};
}

template <class Real> inline void store_mat3(Real *to, const Mat3<Real> &m) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) to[3 * i + j] = m.m[i][j];
}

template <class Real> inline void store_vec3(Real *to, Vec3<Real> v) {
  to[0] = v.x;
  to[1] = v.y;
  to[2] = v.z;
}

// One row each, with everything inlined: nothing goes through memory, and what is not asked for is not made.

template <class Real> [[gnu::flatten]] void covariance_row(const Covariances<Real> &given, int64_t i) {
  store_mat3(given.covars + 9 * i, covar_from_quat_scale(given.quat(i), given.scale(i)));
}

template <class Real> [[gnu::flatten]] void covariance_row_vjp(const Covariances<Real> &given, int64_t i) {
  Vec4<Real> v_quat;
  Vec3<Real> v_scale;
  covar_from_quat_scale_vjp(given.quat(i), given.scale(i), load_mat3(given.v_covars + 9 * i), v_quat, v_scale);
  Real *to = given.v_quats + 4 * i;
  to[0] = v_quat.w;
  to[1] = v_quat.x;
  to[2] = v_quat.y;
  to[3] = v_quat.z;
  store_vec3(given.v_scales + 3 * i, v_scale);
}

// What does not change from row to row.
template <class Real> struct Seer {
  Camera<Real> camera;
  Profile<Real> profile;
  ProjectOptions<Real> options;
  explicit Seer(const Projection<Real> &given)
      : camera(given.camera()), profile(given.profile()), options(given.options()) {}
};

template <class Real>
[[gnu::flatten]] void project_row(const Projection<Real> &given, const Seer<Real> &seer, int64_t i) {
  const Vec3<Real> mean_cam = mean_cam_from_mean(given.mean(i), seer.camera);
  const Mat3<Real> covar = load_mat3(given.covars + 9 * i);
  const Real opacity = given.opacities[i];
  const SplatRow<Real> splat =
      in_front(mean_cam.z, seer.profile)
          ? splat_in_front(mean_cam, covar, opacity, seer.camera, seer.profile, seer.options)
          : culled(mean_cam.z);
  given.means2d[2 * i] = splat.mean2d.x;
  given.means2d[2 * i + 1] = splat.mean2d.y;
  given.depths[i] = splat.depth;
  given.conics[3 * i] = splat.conic.xx;
  given.conics[3 * i + 1] = splat.conic.xy;
  given.conics[3 * i + 2] = splat.conic.yy;
  given.radii[2 * i] = splat.radii.x;
  given.radii[2 * i + 1] = splat.radii.y;
  // what is culled keeps its opacity, as gsplat has it
  given.effective_opacities[i] = seer.options.antialiased ? splat.opacity : opacity;
  if (!seer.options.antialiased) return;
  const Mat3<Real> covar_cam = covar_cam_from_covar(covar, seer.camera);
  const Mat2<Real> covar2d = project_covar(covar_cam, projection_jacobian(mean_cam, seer.camera, seer.profile));
  given.factors[i] = splat.radii.x > 0 ? compensation(covar2d, seer.profile.eps2d) : Real(0);
}

template <class Real>
[[gnu::flatten]] void project_row_vjp(const Projection<Real> &given, const Seer<Real> &seer, int64_t i,
                                      ViewmatVjp<Real> &v_viewmat) {
  const int64_t n = given.n;
  CovarVjp<Real> v = {};
  if (given.radii[2 * i] > 0) {
    const SplatCotangents<Real> of = {{given.v_means2d[i], given.v_means2d[n + i]},
                                      given.v_depths[i],
                                      {given.v_conics[i], given.v_conics[n + i], given.v_conics[2 * n + i]},
                                      given.v_effective_opacities[i],
                                      seer.options.antialiased ? given.v_factors[i] : Real(0)};
    v = splat_in_front_vjp(given.mean(i), load_mat3(given.covars + 9 * i), given.opacities[i], seer.camera,
                           seer.profile, seer.options, of, v_viewmat);
  }
  store_vec3(given.v_means + 3 * i, v.v_mean);
  store_mat3(given.v_covars + 9 * i, v.v_covar);
  given.v_opacities[i] = v.v_opacity;
}

template <class Real>
[[gnu::flatten]] void project_row_vjp(const Projection<Real> &given, const Seer<Real> &seer, int64_t i) {
  ViewmatVjp<Real> unused = {};
  project_row_vjp(given, seer, i, unused);
}

template <class Real> void covariances(const Covariances<Real> &given, Fork fork) {
  share(fork, given.threads, given.n, ROWS_AT_A_TIME, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; i++) covariance_row(given, i);
  });
}

template <class Real> void covariances_backward(const Covariances<Real> &given, Fork fork) {
  share(fork, given.threads, given.n, ROWS_AT_A_TIME, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; i++) covariance_row_vjp(given, i);
  });
}

template <class Real> void projection(const Projection<Real> &given, Fork fork) {
  const Seer<Real> seer(given);
  share(fork, given.threads, given.n, ROWS_AT_A_TIME, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; i++) project_row(given, seer, i);
  });
}

template <class Real> void projection_backward(const Projection<Real> &given, Fork fork) {
  const Seer<Real> seer(given);
  share(fork, given.threads, given.n, ROWS_AT_A_TIME, [&](int64_t first, int64_t last) {
    if (!given.v_viewmats) {
      for (int64_t i = first; i < last; i++) project_row_vjp(given, seer, i);
      return;
    }
    ViewmatVjp<Real> v = {};
    for (int64_t i = first; i < last; i++) project_row_vjp(given, seer, i, v);
    Real *to = given.v_viewmats + 12 * (first / ROWS_AT_A_TIME);
    for (int row = 0; row < 3; row++) store_vec3(to + 4 * row, {v.v_R.m[row][0], v.v_R.m[row][1], v.v_R.m[row][2]});
    to[3] = v.v_t.x;
    to[7] = v.v_t.y;
    to[11] = v.v_t.z;
  });
}

}  // namespace pop
