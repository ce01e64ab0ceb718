// One step of training on CPUs. Meaning: `pop_ref.training.train_step`; `step.h` names its parts.

#include "step.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <type_traits>
#include <utility>

#include "cuda_ext/csrc/density.cuh"
#include "cuda_ext/csrc/polarization.cuh"
#include "lists.h"

namespace pop {

namespace {

constexpr int ROW_FLOATS[] = {3, 3, 4, 1, 3};  // of a Gaussian, by `StepGroup`; the bands beyond the first come last
constexpr int COLUMNS = 9;                     // of an entry's row: six moments, colours

Vec3<float> vec3_of(const float *row) { return {row[0], row[1], row[2]}; }

void put(float *to, Vec3<float> v) {
  to[0] = v.x;
  to[1] = v.y;
  to[2] = v.z;
}

GaussianRow<float> gaussian_of(const StepGiven &given, int64_t i) {
  const float *q = given.params[QUATS] + 4 * i;
  return {vec3_of(given.params[MEANS] + 3 * i),
          {q[0], q[1], q[2], q[3]},
          scale_from_log_scale(vec3_of(given.params[SCALES] + 3 * i)),
          opacity_from_logit(given.params[OPACITIES][i])};
}

// NaN and infinity stay what they are under any sum, and a sum of finite numbers that overflows is one too
bool finite_row(const StepGiven &given, int64_t i) {
  float sum = given.params[OPACITIES][i];
  for (const StepGroup group : {MEANS, SCALES, QUATS, SH0})
    for (int k = 0; k < ROW_FLOATS[group]; k++) sum += given.params[group][ROW_FLOATS[group] * i + k];
  return std::isfinite(sum);
}

ShRow<float> harmonics_of(const StepGiven &given, int64_t i) {
  return {given.params[SH0] + 3 * i, given.params[SHN] + 3 * given.n_rest * i};
}

int64_t parts_of(int64_t n, int64_t part) { return (n + part - 1) / part; }

// Call with the degree as a constant.
template <class Call> void with_degree(int64_t degree, Call call) {
  if (degree == 0) return call(std::integral_constant<int, 0>());
  if (degree == 1) return call(std::integral_constant<int, 1>());
  if (degree == 2) return call(std::integral_constant<int, 2>());
  call(std::integral_constant<int, 3>());
}

void adam_on(float *__restrict param, float *__restrict m, float *__restrict v, const float *__restrict gradient, int64_t n,
             const AdamStep<float> &step) {
  for (int64_t k = 0; k < n; k++) adam_one(param[k], m[k], v[k], gradient[k], step);
}

// A bit pattern that is ordered as the floats are.
uint32_t ordered_bits(float x) {
  const uint32_t bits = bits_of<uint32_t>(x);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

}  // namespace

int64_t Stepper::steps(const StepGiven *first, int64_t n) {
  given = first;
  last_given = first + n;
  stage = 0;
  pool.run(*this);
  return given - first;
}

bool Stepper::next(Work &work) {
  if (given == last_given) return false;
  book_time();
  switch (stage++) {
  case 0:
    begin();
    work = see();
    return true;
  case 1:
    if (!all_finite()) return false;
    sort_by_depth();
    work = count_entries();
    return true;
  case 2:
    work = place_entries();
    return true;
  case 3:
    work = blend_tiles();
    return true;
  case 4:
    work = compare();
    return true;
  case 5:
    work = gather();
    return true;
  case 6:
    work = transpose_tiles();
    return true;
  case 7:
    count_sides();
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
  constexpr StepPart part_of[] = {SEE, LIST, LIST, BLEND, COMPARE, GATHER, TRANSPOSE, UPDATE};
  const auto now = std::chrono::steady_clock::now();
  if (stage > 0) given->seconds[part_of[stage - 1]] += std::chrono::duration<double>(now - stage_began).count();
  stage_began = now;
}

void Stepper::begin() {
  const StepGiven &g = *given;
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
  for (int k = 0; k < GROUPS; k++) adam_steps[k] = adam_step_at<float>(int(g.adam_step), g.lr[k], g.beta1, g.beta2, g.eps);

  blend = {};
  blend.n = g.n;
  blend.channels = 3;
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
  blend.image = difference.get(3 * n_pixels);
  blend.kept = g.kept;
  const bool lit_from_behind = g.background[0] != 0.0 || g.background[1] != 0.0 || g.background[2] != 0.0;
  blend.alphas = lit_from_behind ? alphas.get(n_pixels) : nullptr;
  blend.v_image = v_image.get(3 * n_pixels);
  blend.v_alphas = lit_from_behind ? v_alphas.get(n_pixels) : nullptr;
  seen.get(g.n);
  counts.get(g.n);
  if (g.dominance) blend.dominant_counts = counts.get(g.n);

  make_workers();
  for (int channel = 0; channel < 3; channel++) ssim[channel] = ssim_of(channel);
}

void Stepper::make_workers() {
  const int64_t stride = padded_line<float>(given->width + Ssim<float>::REACH);
  if (!workers.empty() && worker_stride == stride && worker_rest == given->n_rest) return;
  workers.clear();
  for (int64_t k = 0; k < pool.size(); k++)
    workers.push_back(std::make_unique<Worker>(pixels, stride, given->n_rest));
  worker_stride = stride;
  worker_rest = given->n_rest;
}

// ---- see: from raw parameters to splats and colours

Work Stepper::see() {
  const int64_t n_parts = parts_of(given->n, ROWS);
  part_visible.assign(size_t(n_parts), 0);
  part_slots.assign(size_t(n_parts), 0);
  keys.get(given->n);
  Work work = {given->n, ROWS, {}};
  with_degree(given->degree, [&](auto degree) {
    work.f = [this](int, int64_t first, int64_t last) { see_rows<decltype(degree)::value>(first, last); };
  });
  return work;
}

bool Stepper::all_finite() const {
  for (const int64_t visible : part_visible)
    if (visible < 0) {
      *given->bad_row = -visible - 1;
      return false;
    }
  return true;
}

// The visible ones' keys begin where the part's Gaussians do.
template <int DEGREE> void Stepper::see_rows(int64_t first, int64_t last) {
  Seen *const all = seen.get(given->n);
  int32_t *const count = counts.get(given->n);
  uint64_t *const key = keys.get(given->n) + first;
  int64_t visible = 0, slot = 0, bad = -1;
  for (int64_t i = first; i < last; i++) {
    Seen &row = all[i];
    row.n = -1;
    count[i] = 0;
    if (!finite_row(*given, i)) {
      if (bad < 0) bad = i;
      continue;
    }
    if (!see_row<DEGREE>(i, row)) continue;
    row.first = int32_t(slot);
    slot += row.n;
    if (row.n > 0) key[visible++] = uint64_t(ordered_bits(row.depth)) << 32 | uint64_t(i);
  }
  part_visible[first / ROWS] = bad < 0 ? visible : -bad - 1;
  part_slots[first / ROWS] = slot;
}

template <int DEGREE> [[gnu::flatten]] bool Stepper::see_row(int64_t i, Seen &to) {
  const GaussianRow<float> g = gaussian_of(*given, i);
  const SplatRow<float> splat = project_one(g, camera, profile, options);
  if (splat.radii.x <= 0) return false;
  const float mean2d[2] = {splat.mean2d.x, splat.mean2d.y}, conic[3] = {splat.conic.xx, splat.conic.xy, splat.conic.yy};
  float color[3];
  put(color, color_from_sh(harmonics_of(*given, i), view_dir(g.mean, camera), DEGREE));
  blend.splats[i] = splat_of(mean2d, conic, splat.opacity, color, 3);
  const TileGrid grid = grid_of(int(given->width), int(given->height), STEP_TILE, STEP_TILE);
  const TileRect rect = tile_rect(splat.mean2d, splat.radii, grid, profile);
  to = {mean2d[0], mean2d[1], conic[0], conic[1], conic[2], splat.opacity, 0.0f, splat.depth,
        rect.x0,   rect.y0,   rect.x1,  rect.y1,  0,        0,             0};
  reach_tiles(to);
  return true;
}

// Calls f(tile) for those of the rectangle that the splat may reach, row by row.
template <class F> void Stepper::each_tile(const Seen &of, F f) const {
  const float extent = float(STEP_TILE - 1);
  for (int32_t y = of.y0; y < of.y1; y++)
    for (int32_t x = of.x0; x < of.x1; x++) {
      const float left = float(x * STEP_TILE) + 0.5f - of.x, top = float(y * STEP_TILE) + 0.5f - of.y;
      if (profile.square || touches(of.a, of.b, of.c, of.limit, left, top, extent)) f(int64_t(y) * blend.tiles_x + x);
    }
}

void Stepper::reach_tiles(Seen &of) const {
  of.limit = std::log(of.opacity / profile.alpha_floor);
  const int64_t across = of.x1 - of.x0;
  each_tile(of, [&](int64_t tile) {
    const int64_t y = tile / blend.tiles_x, x = tile % blend.tiles_x, bit = (y - of.y0) * across + x - of.x0;
    if (bit < 64) of.tiles |= uint64_t(1) << bit;
    of.n++;
  });
}

// ---- list: tile by tile, front to back (D3, D4)

// By depth, then by row: digit by digit from the lowest of the depth's bits, each pass keeping the order before it.
void Stepper::sort_by_depth() {
  constexpr int DIGIT = 11, VALUES_OF_DIGIT = 1 << DIGIT, PASSES = 3;
  std::vector<int32_t> places(PASSES * VALUES_OF_DIGIT);
  uint64_t *from = keys.get(given->n), *to = sorted.get(given->n);
  n_visible = 0;
  for (size_t part = 0; part < part_visible.size(); part++) {
    std::memmove(from + n_visible, from + int64_t(part) * ROWS, size_t(part_visible[part]) * sizeof(uint64_t));
    n_visible += part_visible[part];
  }
  const auto digit = [](uint64_t key, int pass) { return int(key >> (32 + DIGIT * pass) & (VALUES_OF_DIGIT - 1)); };
  for (int64_t k = 0; k < n_visible; k++)
    for (int pass = 0; pass < PASSES; pass++) places[pass * VALUES_OF_DIGIT + digit(from[k], pass)]++;
  for (int pass = 0; pass < PASSES; pass++) {
    int32_t *place = &places[pass * VALUES_OF_DIGIT], before = 0;
    for (int value = 0; value < VALUES_OF_DIGIT; value++) before += std::exchange(place[value], before);
    for (int64_t k = 0; k < n_visible; k++) to[place[digit(from[k], pass)]++] = from[k];
    std::swap(from, to);
  }
  // an odd number of passes ends in `sorted`
  static_assert(PASSES % 2 == 1);
}

// Gaussians in depth order that are listed at a time; each part counts and places its own entries.
int64_t Stepper::list_part() const { return std::max<int64_t>(1, parts_of(n_visible, 4 * pool.size())); }

// Calls f(row, tile, slot) for the entries of some Gaussians, front to back.
template <class F> void Stepper::each_entry(int64_t first, int64_t last, F f) const {
  for (int64_t k = first; k < last; k++) {
    // depth order jumps about in memory: what comes soon is asked for now
    __builtin_prefetch(&seen[int64_t(uint32_t(sorted[std::min(k + 12, last - 1)]))]);
    const int64_t i = int64_t(uint32_t(sorted[k]));
    const Seen &of = seen[i];
    const int64_t across = of.x1 - of.x0;
    int64_t slot = part_slots[size_t(i / ROWS)] + of.first;
    if (across * (of.y1 - of.y0) > 64) {
      each_tile(of, [&](int64_t tile) { f(i, tile, slot++); });
      continue;
    }
    for (uint64_t bits = of.tiles; bits; bits &= bits - 1) {
      const int64_t bit = __builtin_ctzll(bits);
      f(i, (of.y0 + bit / across) * blend.tiles_x + of.x0 + bit % across, slot++);
    }
  }
}

Work Stepper::count_entries() {
  int64_t n_slots = 0;
  for (auto &slot : part_slots) n_slots += std::exchange(slot, n_slots);
  const int64_t part = list_part(), n_tiles = blend.tiles();
  starts.assign(size_t(parts_of(n_visible, part) * n_tiles), 0);
  return {n_visible, part, [=](int, int64_t first, int64_t last) {
            int64_t *const count = &starts[size_t(first / part * n_tiles)];
            each_entry(first, last, [&](int64_t, int64_t tile, int64_t) { count[tile]++; });
          }};
}

Work Stepper::place_entries() {
  const int64_t part = list_part(), n_parts = parts_of(n_visible, part), n_tiles = blend.tiles();
  int64_t total = 0, n_chunks = 0;
  for (int64_t tile = 0; tile < n_tiles; tile++) {
    offsets[size_t(tile)] = total;
    first_chunks[size_t(tile)] = n_chunks;
    for (int64_t k = 0; k < n_parts; k++) total += std::exchange(starts[size_t(k * n_tiles + tile)], total);
    n_chunks += parts_of(total - offsets[size_t(tile)], CHUNK);
  }
  offsets[size_t(n_tiles)] = total;
  int64_t *const to_ids = ids.get(total);
  int32_t *const to_slots = slots.get(total);
  blend.ids = to_ids;
  blend.slots = to_slots;
  blend.lights = lights.get(n_chunks * pixels.padded());
  blend.reached = reached.get(n_chunks * pixels.strips);
  blend.rows = rows.get(total * COLUMNS);
  return {n_visible, part, [=](int, int64_t first, int64_t last) {
            int64_t *const next = &starts[size_t(first / part * n_tiles)];
            each_entry(first, last, [&](int64_t i, int64_t tile, int64_t slot) {
              to_ids[next[tile]] = i;
              to_slots[next[tile]++] = int32_t(slot);
            });
          }};
}

// ---- blend: the picture, and its difference from the photograph

Work Stepper::blend_tiles() {
  const auto one_tile = blend.dominance() ? blend_tile<float, 3, true, true> : blend_tile<float, 3, true, false>;
  return {blend.tiles(), 2, [=](int thread, int64_t first, int64_t last) {
            for (int64_t tile = first; tile < last; tile++) {
              one_tile(blend, pixels, tile, workers[size_t(thread)]->canvas);
              differ(tile);
            }
          }};
}

// Turn a tile of the picture into its difference from the photograph, 0 where the mask leaves a pixel out, and sum up
// |d|, d^2, and d^2 of the picture clamped to [0, 1].
void Stepper::differ(int64_t tile) {
  const StepGiven &g = *given;
  const float *const alphas = blend.alphas;
  const Place<float> place(blend, tile);
  float absolute[STEP_TILE] = {}, squared[STEP_TILE] = {}, clamped_squared[STEP_TILE] = {};
  for (int channel = 0; channel < 3; channel++) {
    const float behind = float(g.background[channel]);
    float *const plane = blend.image + channel * blend.channel_stride;
    const float *const photograph = g.target + channel * blend.channel_stride;
    place.each_row([&](int64_t, int64_t at) {
      for (int64_t x = 0; x < place.columns(); x++) {
        const float keep = !g.kept || g.kept[at + x] ? 1.0f : 0.0f, y = photograph[at + x];
        const float color = plane[at + x] + (alphas ? (1.0f - alphas[at + x]) * behind : 0.0f);
        const float d = keep * (color - y), clamped_d = keep * (clamped(color, 0.0f, 1.0f) - y);
        plane[at + x] = d;
        absolute[x] += std::fabs(d);
        squared[x] += d * d;
        clamped_squared[x] += clamped_d * clamped_d;
      }
    });
  }
  double *const sums = &tile_sums[3 * tile];
  sums[0] = sums[1] = sums[2] = 0.0;
  for (int x = 0; x < STEP_TILE; x++) {
    sums[0] += absolute[x];
    sums[1] += squared[x];
    sums[2] += clamped_squared[x];
  }
}

// ---- compare and gather: D-SSIM with its gradient, and that of L1 or L2

Ssim<float> Stepper::ssim_of(int channel) {
  const StepGiven &g = *given;
  Ssim<float> of = {};
  of.height = g.height;
  of.width = g.width;
  of.channels = 1;
  of.border = g.border;
  of.stride = worker_stride;
  const int64_t n_pixels = g.width * g.height, n_maps = of.rows() * of.columns();
  of.difference = blend.image + channel * n_pixels;
  of.target = g.target + channel * n_pixels;
  of.mu_y = g.mu_y + channel * n_maps;
  of.s_yy = g.s_yy + channel * n_maps;
  of.kept = g.kept_windows;
  of.weight = g.n_windows > 0 ? g.ssim_weight / double(3 * g.n_windows) : 0.0;
  const int64_t n_partials = 3 * (g.height + Ssim<float>::REACH) * of.stride;
  of.partials = partials.get(3 * n_partials) + channel * n_partials;
  of.gradient = v_image.get(3 * n_pixels) + channel * n_pixels;
  return of;
}

Work Stepper::compare() {
  const int64_t rows = ssim[0].rows(), margin = ssim[0].margin();
  for (const auto &of : ssim)
    for (int map = 0; map < 3; map++) {
      std::fill(of.partial(map, 0), of.partial(map, margin), 0.0f);
      std::fill(of.partial(map, margin + rows), of.partial(map + 1, 0), 0.0f);
    }
  window_sums.assign(size_t(3 * parts_of(rows, WINDOW_ROWS)), 0.0);
  return {rows, WINDOW_ROWS, [this](int thread, int64_t first, int64_t last) {
            for (int channel = 0; channel < 3; channel++)
              window_sums[size_t(3 * (first / WINDOW_ROWS) + channel)] =
                  compare_rows(ssim[channel], workers[size_t(thread)]->products, first, last);
          }};
}

Work Stepper::gather() {
  return {given->height, WINDOW_ROWS,
          [this](int thread, int64_t first, int64_t last) { gather_rows(*workers[size_t(thread)], first, last); }};
}

void Stepper::gather_rows(Worker &own, int64_t first, int64_t last) {
  const StepGiven &g = *given;
  const int64_t n_pixels = g.width * g.height, begin = first * g.width, end = last * g.width;
  const float unit = float(g.pixel_weight / double(3 * std::max<int64_t>(g.n_kept, 1))), twice = 2.0f * unit;
  float *const v_alpha = blend.v_alphas ? v_alphas.get(n_pixels) : nullptr;
  if (v_alpha) std::fill(v_alpha + begin, v_alpha + end, 0.0f);
  for (int channel = 0; channel < 3; channel++) {
    const Ssim<float> &of = ssim[channel];
    pop::gather_rows(of, own.blur, first, last);
    const float behind = float(g.background[channel]), *const d = of.difference;
    for (int64_t at = begin; at < end; at++) {
      const float slope = g.l1 ? (d[at] > 0.0f ? unit : d[at] < 0.0f ? -unit : 0.0f) : twice * d[at];
      of.gradient[at] = !g.kept || g.kept[at] ? of.gradient[at] + slope : 0.0f;
    }
    for (int64_t at = begin; v_alpha && at < end; at++) v_alpha[at] -= behind * of.gradient[at];
  }
}

// ---- transpose: back to the entries

Work Stepper::transpose_tiles() {
  const auto one_tile = transpose_tile<float, 3, true>;
  return {blend.tiles(), 2, [=](int thread, int64_t first, int64_t last) {
            for (int64_t tile = first; tile < last; tile++) {
              one_tile(blend, pixels, tile, workers[size_t(thread)]->transpose);
              // what lies behind the last pixel's stop passes nothing back
              for (int64_t entry = offsets[size_t(tile)] + n_reached[size_t(tile)]; entry < offsets[size_t(tile) + 1]; entry++)
                std::fill_n(blend.rows + COLUMNS * blend.slots[entry], COLUMNS, 0.0f);
            }
          }};
}

// ---- update: per Gaussian back to raw parameters, the POP term, statistics, Adam

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

void Stepper::adam(StepGroup group, const float *gradient, int64_t first, int64_t n) {
  adam_on(given->params[group] + first, given->m[group] + first, given->v[group] + first, gradient, n, adam_steps[group]);
}

// ---- what the step was like

void Stepper::finish() {
  const StepGiven &g = *given;
  double pixels_summed[3] = {}, windows = 0.0, sides[2] = {};
  for (size_t k = 0; k < tile_sums.size(); k++) pixels_summed[k % 3] += tile_sums[k];
  for (const double sum : window_sums) windows += sum;
  for (size_t k = 0; k < pop_sums.size(); k++) sides[k % 2] += pop_sums[k];
  const double n_values = double(3 * std::max<int64_t>(g.n_kept, 1));
  const double dissimilarity = g.n_windows > 0 ? windows / double(3 * g.n_windows) : 0.0;
  g.values[PIXELWISE] = pixels_summed[g.l1 ? 0 : 1] / n_values;
  g.values[SSIM] = 1.0 - dissimilarity;
  g.values[OBJECTIVE] = g.pixel_weight * g.values[PIXELWISE] + g.ssim_weight * dissimilarity;
  g.values[SQUARE] = pixels_summed[2] / n_values;
  g.values[POP] = g.lambda_pop * (sides[0] / double(std::max<int64_t>(n_important, 1)) +
                                  sides[1] / double(std::max<int64_t>(n_others, 1)));
}

int64_t Stepper::bytes() const {
  return seen.bytes() + splats.bytes() + counts.bytes() + keys.bytes() + sorted.bytes() + ids.bytes() +
         slots.bytes() + lights.bytes() + rows.bytes() + reached.bytes() + difference.bytes() + alphas.bytes() +
         partials.bytes() + v_image.bytes() + v_alphas.bytes();
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

// how many steps were taken: fewer where a row is not finite; -1 where there is no memory
int64_t pop_stepper_steps(void *stepper, const pop::StepGiven *first, int64_t n) {
  try {
    return static_cast<pop::Stepper *>(stepper)->steps(first, n);
  } catch (...) {
    return -1;
  }
}

// the update by itself, for whoever judges it
void pop_adam(float *param, float *m, float *v, const float *gradient, int64_t n, int64_t step, double lr, double beta1,
              double beta2, double eps) {
  pop::adam_on(param, m, v, gradient, n, pop::adam_step_at<float>(int(step), lr, beta1, beta2, eps));
}

int64_t pop_stepper_bytes(const void *stepper) { return static_cast<const pop::Stepper *>(stepper)->bytes(); }

// what `native_step.py` compares
int64_t pop_step_given_bytes() { return int64_t(sizeof(pop::StepGiven)); }
}
