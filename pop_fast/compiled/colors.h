// Harmonics to the colours of one view, and the transpose. Meaning: `pop_ref.harmonics`; the arithmetic of one Gaussian
// is the one that the CUDA kernels run.
#pragma once

#include <algorithm>
#include <cstdint>

#include "cuda_ext/csrc/camera.cuh"
#include "cuda_ext/csrc/harmonics.cuh"
#include "threads.h"

namespace pop {

// Everything of one call; eight bytes each, in the order of `library.py`.
template <class Real> struct Colors {
  const Real *sh, *means, *viewmat;    // [N, n_sh, 3], [N, 3], [4, 4]
  const int64_t *visible;              // ids of the Gaussians that are evaluated, ascending. [V]
  int64_t n, n_visible, n_sh, degree, threads;
  Real *colors;                        // [3, N]; 0 for the others
  const Real *v_colors;                // [N, 3]
  Real *v_sh, *v_dirs;                 // [N, n_sh, 3], 0 for the others and for idle bands; [N, 3], likewise

  ShRow<Real> row(int64_t i) const { return {sh + 3 * n_sh * i, sh + 3 * n_sh * i + 3}; }
  Vec3<Real> mean(int64_t i) const { return {means[3 * i], means[3 * i + 1], means[3 * i + 2]}; }
  Camera<Real> camera() const {
    const Real no_intrinsics[9] = {};
    return camera_from_matrices(viewmat, no_intrinsics, 0, 0, false);
  }
};

constexpr int64_t GAUSSIANS_AT_A_TIME = 1024;

template <class Real> void color_forward(const Colors<Real> &given, Fork fork) {
  const Camera<Real> camera = given.camera();
  const int64_t n = given.n;
  std::fill(given.colors, given.colors + 3 * n, Real(0));
  share(fork, given.threads, given.n_visible, GAUSSIANS_AT_A_TIME, [&](int64_t first, int64_t last) {
    for (int64_t k = first; k < last; k++) {
      const int64_t i = given.visible[k];
      const Vec3<Real> color = color_from_sh(given.row(i), view_dir(given.mean(i), camera), int(given.degree));
      given.colors[i] = color.x;
      given.colors[n + i] = color.y;
      given.colors[2 * n + i] = color.z;
    }
  });
}

// A part of the visible writes the rows from its first Gaussian to the one before the next part's first, so that all
// rows are written once, those of unseen Gaussians with zeros.
template <class Real> void color_backward(const Colors<Real> &given, Fork fork) {
  const Camera<Real> camera = given.camera();
  const int active = int((given.degree + 1) * (given.degree + 1)), degree = int(given.degree);
  const int64_t width = 3 * given.n_sh;
  const auto zero = [&](int64_t from, int64_t to) {
    std::fill(given.v_sh + width * from, given.v_sh + width * to, Real(0));
    std::fill(given.v_dirs + 3 * from, given.v_dirs + 3 * to, Real(0));
  };
  zero(0, given.n_visible > 0 ? given.visible[0] : given.n);
  share(fork, given.threads, given.n_visible, GAUSSIANS_AT_A_TIME, [&](int64_t first, int64_t last) {
    for (int64_t k = first; k < last; k++) {
      const int64_t i = given.visible[k], next = k + 1 < given.n_visible ? given.visible[k + 1] : given.n;
      const Real *v = given.v_colors + 3 * i;
      Real basis[MAX_BASIS];
      Vec3<Real> v_sum;
      const Vec3<Real> v_dir = color_from_sh_vjp(given.row(i), view_dir(given.mean(i), camera), degree,
                                                 Vec3<Real>{v[0], v[1], v[2]}, basis, v_sum);
      Real *v_sh = given.v_sh + width * i, *v_dirs = given.v_dirs + 3 * i;
      for (int b = 0; b < active; b++) {
        v_sh[3 * b] = basis[b] * v_sum.x;
        v_sh[3 * b + 1] = basis[b] * v_sum.y;
        v_sh[3 * b + 2] = basis[b] * v_sum.z;
      }
      std::fill(v_sh + 3 * active, v_sh + width, Real(0));
      v_dirs[0] = v_dir.x;
      v_dirs[1] = v_dir.y;
      v_dirs[2] = v_dir.z;
      zero(i + 1, next);
    }
  });
}

}  // namespace pop
