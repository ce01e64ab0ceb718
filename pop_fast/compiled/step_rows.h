// A Gaussian's row as the step keeps it, for the parts of the step that work row by row.
#pragma once

#include <type_traits>

#include "step.h"

namespace pop {

constexpr int ROW_FLOATS[] = {3, 3, 4, 1, 3};  // of a Gaussian, by `StepGroup`; the bands beyond the first come last

inline Vec3<float> vec3_of(const float *row) { return {row[0], row[1], row[2]}; }

inline void put(float *to, Vec3<float> v) {
  to[0] = v.x;
  to[1] = v.y;
  to[2] = v.z;
}

inline GaussianRow<float> gaussian_of(const StepGiven &given, int64_t i) {
  const float *q = given.params[QUATS] + 4 * i;
  return {vec3_of(given.params[MEANS] + 3 * i),
          {q[0], q[1], q[2], q[3]},
          scale_from_log_scale(vec3_of(given.params[SCALES] + 3 * i)),
          opacity_from_logit(given.params[OPACITIES][i])};
}

inline void load_row(const StepGiven &given, int64_t i, int64_t l, RowBlock &to) {
  const GaussianRow<float> g = gaussian_of(given, i);
  put_column(g.mean, l, to.means);
  put_column<4>({g.quat.w, g.quat.x, g.quat.y, g.quat.z}, l, to.quats);
  put_column(g.scale, l, to.scales);
  to.opacities[0][l] = g.opacity;
}

inline ShRow<float> harmonics_of(const StepGiven &given, int64_t i) {
  return {given.params[SH0] + 3 * i, given.params[SHN] + 3 * given.n_rest * i};
}

// Call with the degree as a constant.
template <class Call> void with_degree(int64_t degree, Call call) {
  if (degree == 0) return call(std::integral_constant<int, 0>());
  if (degree == 1) return call(std::integral_constant<int, 1>());
  if (degree == 2) return call(std::integral_constant<int, 2>());
  call(std::integral_constant<int, 3>());
}

}  // namespace pop
