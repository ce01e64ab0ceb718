// Sixty-four Gaussians next to one another: the CUDA kernels' own functions of one Gaussian, called in loops without a
// branch or a call, which compilers turn into vectors. What calls exp or log, or reads rows of bands, is done by the row.
#pragma once

#include <cstdint>

#include "cuda_ext/csrc/splatting.cuh"

namespace pop {

constexpr int64_t ROW_BLOCK = 64;

// One number of each row, or several.
template <int K> using Columns = float[K][ROW_BLOCK];

// Rows that are culled hold whatever comes of them; nobody reads it.
struct RowBlock {
  Columns<3> means, scales;
  Columns<4> quats;
  Columns<1> opacities;
  // forward
  Columns<2> means2d;
  Columns<4> covars2d;  // after the low-pass
  Columns<1> depths, effective;
  Columns<MAX_BASIS> basis;
  // backward
  Columns<2> v_means2d;
  Columns<3> v_conics, v_means, v_scales;
  Columns<1> v_depths, v_effective, v_opacities;
  Columns<4> v_quats;
  Columns<MAX_BASIS> v_basis;

  Vec3<float> mean(int64_t l) const { return {means[0][l], means[1][l], means[2][l]}; }
  GaussianRow<float> gaussian(int64_t l) const {
    return {mean(l),
            {quats[0][l], quats[1][l], quats[2][l], quats[3][l]},
            {scales[0][l], scales[1][l], scales[2][l]},
            opacities[0][l]};
  }
  ScreenGaussian<float> on_screen(int64_t l) const {
    return {{means2d[0][l], means2d[1][l]},
            depths[0][l],
            {{{covars2d[0][l], covars2d[1][l]}, {covars2d[2][l], covars2d[3][l]}}},
            effective[0][l]};
  }
};

template <int K> inline void take_column(const Columns<K> &from, int64_t l, float (&to)[K]) {
  for (int k = 0; k < K; k++) to[k] = from[k][l];
}

template <int K> inline void put_column(const float (&from)[K], int64_t l, Columns<K> &to) {
  for (int k = 0; k < K; k++) to[k][l] = from[k];
}

inline void put_column(Vec3<float> v, int64_t l, Columns<3> &to) {
  to[0][l] = v.x;
  to[1][l] = v.y;
  to[2][l] = v.z;
}

// The branch on antialiasing is taken once: vectors have none.
template <bool ANTIALIASED>
[[gnu::flatten]] inline void project_rows(RowBlock &__restrict rows, const Camera<float> camera,
                                          const Profile<float> profile) {
#pragma GCC ivdep
  for (int64_t l = 0; l < ROW_BLOCK; l++) {
    const GaussianRow<float> g = rows.gaussian(l);
    const Vec3<float> mean_cam = mean_cam_from_mean(g.mean, camera);
    const Mat3<float> covar = covar_from_quat_scale(g.quat, g.scale);
    const ProjectOptions<float> options = {ANTIALIASED, 0.0f};
    const ScreenGaussian<float> seen = screen_gaussian(mean_cam, covar, g.opacity, camera, profile, options);
    rows.means2d[0][l] = seen.mean2d.x;
    rows.means2d[1][l] = seen.mean2d.y;
    rows.depths[0][l] = seen.depth;
    for (int k = 0; k < 4; k++) rows.covars2d[k][l] = seen.covar2d.m[k / 2][k % 2];
    rows.effective[0][l] = seen.opacity;
  }
}

template <int DEGREE> [[gnu::flatten]] inline void basis_rows(RowBlock &__restrict rows, const Camera<float> camera) {
#pragma GCC ivdep
  for (int64_t l = 0; l < ROW_BLOCK; l++) {
    float basis[MAX_BASIS];
    basis_one(unit_dir(view_dir(rows.mean(l), camera)), DEGREE, basis);
#pragma GCC unroll 16
    for (int k = 0; k < MAX_BASIS; k++) rows.basis[k][l] = basis[k];
  }
}

// From the gradients with respect to what is blended, and to the basis, back to activated parameters.
template <int DEGREE, bool ANTIALIASED>
[[gnu::flatten]] inline void project_rows_vjp(RowBlock &__restrict rows, const Camera<float> camera,
                                              const Profile<float> profile) {
#pragma GCC ivdep
  for (int64_t l = 0; l < ROW_BLOCK; l++) {
    float v_basis[MAX_BASIS];
#pragma GCC unroll 16
    for (int k = 0; k < MAX_BASIS; k++) v_basis[k] = rows.v_basis[k][l];
    const GaussianRow<float> g = rows.gaussian(l);
    const Vec3<float> dir = view_dir(g.mean, camera);
    const Vec3<float> v_dir = basis_of_dir_vjp(dir, unit_dir(dir), DEGREE, v_basis);
    const SplatCotangents<float> v_splat = {{rows.v_means2d[0][l], rows.v_means2d[1][l]},
                                            rows.v_depths[0][l],
                                            {rows.v_conics[0][l], rows.v_conics[1][l], rows.v_conics[2][l]},
                                            rows.v_effective[0][l],
                                            0.0f};
    ViewmatVjp<float> unused = {};
    const ProjectOptions<float> options = {ANTIALIASED, 0.0f};
    const GaussianVjp<float> v = project_one_vjp(g, camera, profile, options, v_splat, v_dir, unused);
    put_column(v.v_mean, l, rows.v_means);
    rows.v_quats[0][l] = v.v_quat.w;
    rows.v_quats[1][l] = v.v_quat.x;
    rows.v_quats[2][l] = v.v_quat.y;
    rows.v_quats[3][l] = v.v_quat.z;
    put_column(v.v_scale, l, rows.v_scales);
    rows.v_opacities[0][l] = v.v_opacity;
  }
}

}  // namespace pop
