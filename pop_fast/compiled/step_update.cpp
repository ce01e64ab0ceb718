// The update: per Gaussian back to raw parameters, the POP term, statistics of density control, Adam.

#include <algorithm>

#include "cuda_ext/csrc/density.cuh"
#include "cuda_ext/csrc/polarization.cuh"
#include "step_rows.h"

namespace pop {

namespace {

void adam_on(float *__restrict param, float *__restrict m, float *__restrict v, const float *__restrict gradient, int64_t n,
             const AdamStep<float> &step) {
  for (int64_t k = 0; k < n; k++) adam_one(param[k], m[k], v[k], gradient[k], step);
}

}  // namespace

// Where a Gaussian stands in the POP term (A1, A12).
int Stepper::side_of(int64_t i) const {
  const StepGiven &g = *given;
  if (g.pop_visible && seen[i].n < 0) return int(PopSide::absent);
  const bool before = g.pop_window && g.dominant_sum && g.dominant_sum[i] > 0;
  return int(before || blend.dominant_counts[i] > 0 ? PopSide::important : PopSide::other);
}

void Stepper::count_sides() {
  n_important = n_others = 0;
  if (given->lambda_pop == 0.0) return;
  for (int64_t i = 0; i < given->n; i++) {
    const int side = side_of(i);
    n_important += side == int(PopSide::important);
    n_others += side == int(PopSide::other);
  }
}

Work Stepper::update() {
  pop_sums.assign(size_t(2 * parts_of(given->n, ROWS)), 0.0);
  Work work = {given->n, ROWS, {}};
  with_degree(given->degree, [&](auto degree) {
    work.f = [this](int thread, int64_t first, int64_t last) {
      double *const pop_sum = &pop_sums[size_t(2 * (first / ROWS))];
      for (int64_t block = first; block < last; block += ROW_BLOCK)
        update_block<decltype(degree)::value>(*workers[size_t(thread)], block, std::min(last, block + ROW_BLOCK), pop_sum);
    };
  });
  return work;
}

// Parameter by parameter, ROW_BLOCK rows each.
float *Stepper::gradients_of(Worker &own, StepGroup group) const {
  int64_t before = 0;
  for (int k = 0; k < group; k++) before += ROW_FLOATS[k];
  return own.gradients.data() + ROW_BLOCK * before;
}

template <int DEGREE> void Stepper::update_block(Worker &own, int64_t first, int64_t last, double *pop_sum) {
  const StepGiven &g = *given;
  std::fill(own.gradients.begin(), own.gradients.end(), 0.0f);
  float *const v_logits = gradients_of(own, OPACITIES);
  for (int64_t i = first; i < last; i++) {
    if (seen[i].n >= 0) gradient_of_row<DEGREE>(i, i - first, own);
    if (blend.dominant_counts) {
      const int32_t count = blend.dominant_counts[i];
      if (g.lambda_pop != 0.0) {
        const PopSide side = PopSide(side_of(i));
        const float logit = g.params[OPACITIES][i];
        if (side == PopSide::important) pop_sum[0] += opacity_from_logit(-logit);
        if (side == PopSide::other) pop_sum[1] += opacity_from_logit(logit);
        const float v = pop_loss_vjp_one(side, int(n_important), int(n_others), float(g.lambda_pop));
        v_logits[i - first] += opacity_from_logit_vjp(logit, v);
      }
      if (g.dominant_sum) g.dominant_sum[i] += count;
      if (g.blurred) {
        const bool blurs = double(count) > g.blur_pixels;
        g.blurred[i] = uint8_t(blurs || (!g.blur_own_view && g.blurred[i]));
      }
    }
  }
  for (const StepGroup group : {MEANS, SCALES, QUATS, OPACITIES, SH0})
    adam(group, gradients_of(own, group), ROW_FLOATS[group] * first, ROW_FLOATS[group] * (last - first));
  const int64_t row = 3 * g.n_rest, active = std::min<int64_t>(row, 3 * ((g.degree + 1) * (g.degree + 1) - 1));
  if (g.sh_rest_sum) return add_up_rest(gradients_of(own, SHN), row * first, row * (last - first));
  if (active == row) return adam(SHN, gradients_of(own, SHN), row * first, row * (last - first));
  // bands that have never been active have neither gradient nor moments: Adam would leave them as they are
  for (int64_t i = first; i < last && active > 0; i++) adam(SHN, gradients_of(own, SHN) + row * (i - first), row * i, active);
}

template <int DEGREE> [[gnu::flatten]] void Stepper::gradient_of_row(int64_t i, int64_t row, Worker &own) {
  const StepGiven &g = *given;
  const Seen &of = seen[i];
  double sums[COLUMNS] = {};
  const float *entry = blend.rows + COLUMNS * (part_slots[size_t(i / ROWS)] + of.first);
  for (int32_t k = 0; k < of.n; k++, entry += COLUMNS)
    for (int j = 0; j < COLUMNS; j++) sums[j] += double(entry[j]);
  const double a = of.a, b = of.b, c = of.c;
  const SplatCotangents<float> v_splat = {
      {float(-(a * sums[1] + b * sums[2])), float(-(b * sums[1] + c * sums[2]))},
      0.0f,
      {float(-0.5 * sums[3]), float(-sums[4]), float(-0.5 * sums[5])},
      of.opacity == 0.0f ? 0.0f : float(sums[0] / double(of.opacity)),
      0.0f};
  if (g.grad_sum) {
    g.grad_sum[i] += densification_gradient(v_splat.v_mean2d, int(g.width), int(g.height));
    g.n_visible[i]++;
  }
  const GaussianRow<float> gaussian = gaussian_of(g, i);
  float basis[MAX_BASIS];
  Vec3<float> v_sum;
  const Vec3<float> v_color = {float(sums[6]), float(sums[7]), float(sums[8])};
  const Vec3<float> v_dir = color_from_sh_vjp(harmonics_of(g, i), view_dir(gaussian.mean, camera), DEGREE,
                                              v_color, basis, v_sum);
  ViewmatVjp<float> unused = {};
  const GaussianVjp<float> v = project_one_vjp(gaussian, camera, profile, options, v_splat, v_dir, unused);
  put(gradients_of(own, MEANS) + 3 * row, v.v_mean);
  put(gradients_of(own, SCALES) + 3 * row,
      {gaussian.scale.x * v.v_scale.x, gaussian.scale.y * v.v_scale.y, gaussian.scale.z * v.v_scale.z});
  float *const v_quat = gradients_of(own, QUATS) + 4 * row;
  v_quat[0] = v.v_quat.w;
  v_quat[1] = v.v_quat.x;
  v_quat[2] = v.v_quat.y;
  v_quat[3] = v.v_quat.z;
  gradients_of(own, OPACITIES)[row] = opacity_from_logit_vjp(g.params[OPACITIES][i], v.v_opacity);
  put(gradients_of(own, SH0) + 3 * row, {basis[0] * v_sum.x, basis[0] * v_sum.y, basis[0] * v_sum.z});
  float *const v_rest = gradients_of(own, SHN) + 3 * g.n_rest * row;
  for (int64_t k = 0; k < (DEGREE + 1) * (DEGREE + 1) - 1; k++)
    put(v_rest + 3 * k, {basis[k + 1] * v_sum.x, basis[k + 1] * v_sum.y, basis[k + 1] * v_sum.z});
}

// Gradients of the bands beyond the first join those that wait; with an update due all are spent.
void Stepper::add_up_rest(const float *gradient, int64_t first, int64_t n) {
  float *const sum = given->sh_rest_sum + first;
  for (int64_t k = 0; k < n; k++) sum[k] += gradient[k];
  if (given->updates[SHN] == 0) return;
  adam(SHN, sum, first, n);
  std::fill(sum, sum + n, 0.0f);
}

void Stepper::adam(StepGroup group, const float *gradient, int64_t first, int64_t n) {
  if (given->updates[group] == 0) return;
  adam_on(given->params[group] + first, given->m[group] + first, given->v[group] + first, gradient, n, adam_steps[group]);
}

}  // namespace pop

extern "C" {
// the update by itself, for whoever judges it
void pop_adam(float *param, float *m, float *v, const float *gradient, int64_t n, int64_t step, double lr, double beta1,
              double beta2, double eps) {
  pop::adam_on(param, m, v, gradient, n, pop::adam_step_at<float>(int(step), lr, beta1, beta2, eps));
}
}
