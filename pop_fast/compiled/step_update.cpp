// The update: per Gaussian back to raw parameters, the priors on opacities, statistics of density control, Adam.

#include <algorithm>

#include "cuda_ext/csrc/density.cuh"
#include "cuda_ext/csrc/polarization.cuh"
#include "step.h"

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

Work Stepper::count_sides() {
  const int64_t part = SIDE_PARTS * ROWS, n = given->lambda_pop == 0.0 ? 0 : given->n;
  sides.assign(size_t(2 * parts_of(n, part)), 0);
  return {n, part, [=](int, int64_t first, int64_t last) {
            int64_t important = 0, others = 0;
            for (int64_t i = first; i < last; i++) {
              const int side = side_of(i);
              important += side == int(PopSide::important);
              others += side == int(PopSide::other);
            }
            sides[size_t(2 * (first / part))] = important;
            sides[size_t(2 * (first / part) + 1)] = others;
          }};
}

Work Stepper::update() {
  n_important = n_others = 0;
  for (size_t k = 0; k < sides.size(); k += 2) {
    n_important += sides[k];
    n_others += sides[k + 1];
  }
  pop_sums.assign(size_t(PRIOR_SUMS * parts_of(given->n, ROWS)), 0.0);
  Work work = {given->n, ROWS, {}};
  with_degree(given->degree, [&](auto degree) {
    work.f = [this](int thread, int64_t first, int64_t last) {
      double *const pop_sum = &pop_sums[size_t(PRIOR_SUMS * (first / ROWS))];
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
  transpose_block<DEGREE>(own, first, last);
  for (int64_t i = first; i < last; i++) {
    if (g.lambda_entropy != 0.0) {
      const float logit = g.params[OPACITIES][i];
      pop_sum[2] += opacity_entropy_one(logit);
      v_logits[i - first] += opacity_entropy_vjp_one(logit, float(g.lambda_entropy / double(g.n)));
    }
    if (g.opacity_reg != 0.0) {
      const float logit = g.params[OPACITIES][i];
      pop_sum[3] += opacity_from_logit(logit);
      v_logits[i - first] += opacity_from_logit_vjp(logit, float(g.opacity_reg / double(g.n)));
    }
    if (g.scale_reg != 0.0) {
      const Vec3<float> scale = scale_from_log_scale(vec3_of(g.params[SCALES] + 3 * i));
      const float each = float(g.scale_reg / double(3 * g.n)), of_axis[3] = {scale.x, scale.y, scale.z};
      for (int k = 0; k < 3; k++) {
        pop_sum[4] += of_axis[k];
        gradients_of(own, SCALES)[3 * (i - first) + k] += each * of_axis[k];
      }
    }
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

template <int DEGREE> void Stepper::transpose_block(Worker &own, int64_t first, int64_t last) {
  const StepGiven &g = *given;
  RowBlock &block = own.block;
  Vec3<float> v_sums[ROW_BLOCK];
  for (int64_t i = first; i < last; i++)
    if (seen[i].n >= 0) load_row(g, i, i - first, block);
  basis_rows<DEGREE>(block, camera);
  for (int64_t i = first; i < last; i++)
    if (seen[i].n >= 0) v_sums[i - first] = transpose_entries<DEGREE>(i, i - first, block);
  if (options.antialiased) project_rows_vjp<DEGREE, true>(block, camera, profile);
  else project_rows_vjp<DEGREE, false>(block, camera, profile);
  for (int64_t i = first; i < last; i++) {
    if (seen[i].n < 0) continue;
    const int64_t l = i - first;
    const Vec3<float> v_sum = v_sums[l];
    for (int k = 0; k < 3; k++) {
      gradients_of(own, MEANS)[3 * l + k] = block.v_means[k][l];
      gradients_of(own, SCALES)[3 * l + k] = block.scales[k][l] * block.v_scales[k][l];
    }
    for (int k = 0; k < 4; k++) gradients_of(own, QUATS)[4 * l + k] = block.v_quats[k][l];
    gradients_of(own, OPACITIES)[l] = opacity_from_logit_vjp(g.params[OPACITIES][i], block.v_opacities[0][l]);
    const auto put_band = [&](float *to, int k) {
      const float basis = block.basis[k][l];
      put(to, {basis * v_sum.x, basis * v_sum.y, basis * v_sum.z});
    };
    put_band(gradients_of(own, SH0) + 3 * l, 0);
    float *const v_rest = gradients_of(own, SHN) + 3 * g.n_rest * l;
    for (int k = 1; k < (DEGREE + 1) * (DEGREE + 1); k++) put_band(v_rest + 3 * (k - 1), k);
  }
}

// Add up a Gaussian's entries: what its splat's and basis's gradients are; return that of the colour before the clamp.
template <int DEGREE> [[gnu::flatten]] Vec3<float> Stepper::transpose_entries(int64_t i, int64_t l, RowBlock &block) {
  const StepGiven &g = *given;
  const Seen &of = seen[i];
  double sums[MOST_COLUMNS] = {};
  const auto add_up = [&](auto columns) {
    const float *entry = blend.rows + columns * (part_slots[size_t(i / ROWS)] + of.first);
    for (int32_t k = 0; k < of.n; k++, entry += columns)
      for (int j = 0; j < columns; j++) sums[j] += double(entry[j]);
  };
  if (g.samples) add_up(std::integral_constant<int, MOST_COLUMNS>());
  else add_up(std::integral_constant<int, MOST_COLUMNS - 1>());
  const double a = of.a, b = of.b, c = of.c;
  const Vec2<float> v_mean2d = {float(-(a * sums[1] + b * sums[2])), float(-(b * sums[1] + c * sums[2]))};
  block.v_means2d[0][l] = v_mean2d.x;
  block.v_means2d[1][l] = v_mean2d.y;
  put_column({float(-0.5 * sums[3]), float(-sums[4]), float(-0.5 * sums[5])}, l, block.v_conics);
  block.v_depths[0][l] = float(sums[9]);
  block.v_effective[0][l] = of.opacity == 0.0f ? 0.0f : float(sums[0] / double(of.opacity));
  if (g.grad_sum) {
    g.grad_sum[i] += densification_gradient(v_mean2d, int(g.width), int(g.height));
    g.n_visible[i]++;
  }
  float basis[MAX_BASIS], v_basis[MAX_BASIS];
  Vec3<float> v_sum;
  take_column(block.basis, l, basis);
  const Vec3<float> v_color = {float(sums[6]), float(sums[7]), float(sums[8])};
  color_from_basis_vjp(harmonics_of(g, i), basis, (DEGREE + 1) * (DEGREE + 1), v_color, v_sum, v_basis);
  put_column(v_basis, l, block.v_basis);
  return v_sum;
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
