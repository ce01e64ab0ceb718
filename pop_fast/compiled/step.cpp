// One step of training on CPUs. Meaning: `pop_ref.training.train_step`; `step.h` names its parts, which stand in
// `step_lists.cpp`, `step_pixels.cpp` and `step_update.cpp`.

#include "step.h"

#include <algorithm>

namespace pop {

int64_t Stepper::steps(const StepGiven *first, int64_t n, const int32_t *stop) {
  asked = stop;
  given = first;
  last_given = first + n;
  stage = 0;
  pool.run(*this);
  return given - first;
}

// Nothing that outlives the call is changed before the update, which is done to its end.
bool Stepper::abandoned() const { return stage <= UPDATE_STAGE && asked && __atomic_load_n(asked, __ATOMIC_RELAXED) != 0; }

bool Stepper::next(Work &work) {
  if (given == last_given || abandoned()) return false;
  book_time();
  switch (stage++) {
  case 0:
    begin();
    work = project();
    return true;
  case 1:
    if (!all_finite() || !few_enough()) return false;
    work = count_buckets();
    return true;
  case 2:
    work = fill_buckets();
    return true;
  case 3:
    work = sort_buckets();
    return true;
  case 4:
    work = count_entries();
    return true;
  case 5:
    work = add_up_parts();
    return true;
  case 6:
    work = place_entries();
    return true;
  case 7:
    work = blend_tiles();
    return true;
  case 8:
    work = loss();
    return true;
  case 9:
    work = image_gradient();
    return true;
  case 10:
    work = transpose_tiles();
    return true;
  case 11:
    work = count_sides();
    return true;
  case UPDATE_STAGE:
    work = update();
    return true;
  default:
    finish();
    given++;
    stage = 0;
    return next(work);
  }
}

// Add the time since the last work began to what that was a part of.
void Stepper::book_time() {
  constexpr StepPart part_of[] = {PROJECT, LIST, LIST, LIST,           LIST,      LIST,   LIST,
                                  BLEND,   LOSS, IMAGE_GRADIENT, TRANSPOSE, UPDATE, UPDATE};
  static_assert(sizeof(part_of) / sizeof(part_of[0]) == UPDATE_STAGE + 1);
  const auto now = std::chrono::steady_clock::now();
  if (stage > 0) given->seconds[part_of[stage - 1]] += std::chrono::duration<double>(now - stage_began).count();
  stage_began = now;
}

void Stepper::begin() {
  const StepGiven &g = *given;
  ended = false;
  camera = camera_from_matrices(g.viewmat, g.K, int(g.width), int(g.height), g.centred != 0);
  profile = {};
  profile.near_plane = float(g.near_plane);
  profile.far_plane = float(g.far_plane);
  profile.eps2d = float(g.eps2d);
  profile.frustum_margin = float(g.frustum_margin);
  profile.extent_sigmas = float(g.extent_sigmas);
  profile.alpha_floor = float(g.alpha_floor);
  profile.tile_size = STEP_TILE;
  profile.near_inclusive = g.near_inclusive != 0;
  profile.centred = g.centred != 0;
  profile.inria_clamp = g.inria_clamp != 0;
  profile.square = g.square != 0;
  options = {g.antialiased != 0, 0.0f};
  for (int k = 0; k < GROUPS; k++) adam_steps[k] = adam_step_at<float>(int(g.updates[k]), g.lr[k], g.beta1, g.beta2, g.eps);

  blend = {};
  blend.n = g.n;
  blend.channels = g.samples ? 4 : 3;
  blend.tiles_x = parts_of(g.width, STEP_TILE);
  blend.tiles_y = parts_of(g.height, STEP_TILE);
  blend.tile_size = STEP_TILE;
  blend.width = g.width;
  blend.height = g.height;
  blend.pixel_stride = 1;
  blend.channel_stride = g.width * g.height;
  blend.alpha_floor = g.floor_below;
  blend.alpha_ceiling = g.alpha_ceiling;
  blend.stop = g.stop;
  blend.ceiling_passes = g.ceiling_passes;
  const int64_t n_tiles = blend.tiles(), n_pixels = g.width * g.height;
  offsets.resize(n_tiles + 1);
  first_chunks.resize(n_tiles);
  n_reached.resize(n_tiles);
  tile_sums.resize(3 * n_tiles);
  blend.splats = splats.get(g.n);
  blend.offsets = offsets.data();
  blend.first_chunks = first_chunks.data();
  blend.n_reached = n_reached.data();
  // the picture gives way to its difference from the photograph, tile by tile
  blend.image = difference.get(blend.channels * n_pixels);
  blend.kept = g.kept;
  const bool lit_from_behind = g.background[0] != 0.0 || g.background[1] != 0.0 || g.background[2] != 0.0;
  // depth is held against what covers a pixel
  const bool covered = lit_from_behind || g.samples;
  blend.alphas = covered ? alphas.get(n_pixels) : nullptr;
  blend.v_image = v_image.get(blend.channels * n_pixels);
  blend.v_alphas = covered ? v_alphas.get(n_pixels) : nullptr;
  if (g.exposure) unexposed.get(3 * n_pixels);
  seen.get(g.n);
  counts.get(g.n);
  if (g.dominance) blend.dominant_counts = counts.get(g.n);

  make_workers();
  for (int channel = 0; channel < 3; channel++) ssim[channel] = ssim_of(channel);
}

void Stepper::make_workers() {
  const int64_t stride = padded_line<float>(given->width + Ssim<float>::REACH);
  const bool fit = worker_stride == stride && worker_rest == given->n_rest && worker_channels == blend.channels;
  if (!workers.empty() && fit) return;
  workers.clear();
  for (int64_t k = 0; k < pool.size(); k++)
    workers.push_back(std::make_unique<Worker>(pixels, blend.channels, stride, given->n_rest));
  worker_stride = stride;
  worker_rest = given->n_rest;
  worker_channels = blend.channels;
}

// ---- what the step was like

void Stepper::finish() {
  const StepGiven &g = *given;
  double pixels_summed[3] = {}, windows = 0.0, sides[PRIOR_SUMS] = {};
  for (size_t k = 0; k < tile_sums.size(); k++) pixels_summed[k % 3] += tile_sums[k];
  for (const double sum : window_sums) windows += sum;
  for (size_t k = 0; k < pop_sums.size(); k++) sides[k % PRIOR_SUMS] += pop_sums[k];
  const double n_values = double(3 * std::max<int64_t>(g.n_kept, 1));
  const double dissimilarity = g.n_windows > 0 ? windows / double(3 * g.n_windows) : 0.0;
  g.values[PIXELWISE] = pixels_summed[g.l1 ? 0 : 1] / n_values;
  g.values[SSIM] = 1.0 - dissimilarity;
  g.values[OBJECTIVE] = g.pixel_weight * g.values[PIXELWISE] + g.ssim_weight * dissimilarity;
  g.values[SQUARE] = pixels_summed[2] / n_values;
  g.values[POP] = g.lambda_pop * (sides[0] / double(std::max<int64_t>(n_important, 1)) +
                                  sides[1] / double(std::max<int64_t>(n_others, 1))) +
                  g.lambda_entropy * sides[2] / double(std::max<int64_t>(g.n, 1)) +
                  g.opacity_reg * sides[3] / double(std::max<int64_t>(g.n, 1)) +
                  g.scale_reg * sides[4] / double(std::max<int64_t>(3 * g.n, 1)) +
                  g.depth_weight * depth_sum / double(std::max<int64_t>(g.n_samples, 1));
  for (size_t k = 0; g.exposure && k < EXPOSURE; k++) {
    g.v_exposure[k] = 0.0;
    for (size_t part = 0; part < exposure_sums.size(); part += EXPOSURE) g.v_exposure[k] += exposure_sums[part + k];
  }
  ended = true;
}

int64_t Stepper::bytes() const {
  return seen.bytes() + splats.bytes() + counts.bytes() + keys.bytes() + sorted.bytes() + ids.bytes() +
         slots.bytes() + transmittances.bytes() + rows.bytes() + reached.bytes() + difference.bytes() + alphas.bytes() +
         unexposed.bytes() + partials.bytes() + v_image.bytes() + v_alphas.bytes();
}

}  // namespace pop

extern "C" {
// null where there is no memory
void *pop_stepper_open(int64_t threads) {
  try {
    return new pop::Stepper(threads);
  } catch (...) {
    return nullptr;
  }
}

void pop_stepper_close(void *stepper) { delete static_cast<pop::Stepper *>(stepper); }

// how many steps were taken: fewer where a row is not finite, lists are too long or *stop is not 0 any more; -1 where there
// is no memory
int64_t pop_stepper_steps(void *stepper, const pop::StepGiven *first, int64_t n, const int32_t *stop) {
  try {
    return static_cast<pop::Stepper *>(stepper)->steps(first, n, stop);
  } catch (...) {
    return -1;
  }
}

int64_t pop_stepper_bytes(const void *stepper) { return static_cast<const pop::Stepper *>(stepper)->bytes(); }

// Take the next steps by the caller's thread alone and keep what each part took, in so many pairs; null: no longer. How
// many pairs there were is returned.
int64_t pop_stepper_trace(void *stepper, double *pairs, int64_t most) {
  pop::Trace &trace = static_cast<pop::Stepper *>(stepper)->trace();
  const int64_t n = trace.n;
  trace = {pairs, most, 0};
  return n;
}

// what `native_step.py` compares
int64_t pop_step_given_bytes() { return int64_t(sizeof(pop::StepGiven)); }
}
