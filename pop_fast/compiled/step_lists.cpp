// From raw parameters to each tile's list: a Gaussian's splat and colour, the tiles it reaches, depth order.

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>
#include <utility>

#include "lists.h"
#include "step.h"

namespace pop {

namespace {

// NaN and infinity stay what they are under any sum, and a sum of finite numbers that overflows is one too
bool finite_row(const StepGiven &given, int64_t i) {
  float sum = given.params[OPACITIES][i];
  for (const StepGroup group : {MEANS, SCALES, QUATS, SH0})
    for (int k = 0; k < ROW_FLOATS[group]; k++) sum += given.params[group][ROW_FLOATS[group] * i + k];
  return std::isfinite(sum);
}

// A bit pattern that is ordered as the floats are.
uint32_t ordered_bits(float x) {
  const uint32_t bits = bits_of<uint32_t>(x);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

}  // namespace

// ---- project: from raw parameters to splats and colours

Work Stepper::project() {
  const int64_t n_parts = parts_of(given->n, ROWS);
  part_visible.assign(size_t(n_parts), 0);
  part_slots.assign(size_t(n_parts), 0);
  part_depths.resize(size_t(n_parts));
  keys.get(given->n);
  Work work = {given->n, ROWS, {}};
  with_degree(given->degree, [&](auto degree) {
    work.f = [this](int thread, int64_t first, int64_t last) {
      project_part<decltype(degree)::value>(*workers[size_t(thread)], first, last);
    };
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

// Slots are kept as numbers of 32 bits.
bool Stepper::few_enough() const {
  return std::accumulate(part_slots.begin(), part_slots.end(), int64_t(0)) <= given->most_entries;
}

// The visible ones' keys begin where the part's Gaussians do.
template <int DEGREE> void Stepper::project_part(Worker &own, int64_t first, int64_t last) {
  Part part = {keys.get(given->n) + first};
  for (int64_t block = first; block < last; block += ROW_BLOCK)
    project_block<DEGREE>(own.block, block, std::min(last, block + ROW_BLOCK), part);
  part_visible[first / ROWS] = part.bad < 0 ? part.visible : -part.bad - 1;
  part_slots[first / ROWS] = part.slot;
  part_depths[first / ROWS] = part.depths;
}

template <int DEGREE> void Stepper::project_block(RowBlock &block, int64_t first, int64_t last, Part &part) {
  Seen *const all = seen.get(given->n);
  int32_t *const count = counts.get(given->n);
  for (int64_t i = first; i < last; i++) {
    if (part.bad < 0 && !finite_row(*given, i)) part.bad = i;
    load_row(*given, i, i - first, block);
  }
  // the step ends with this part
  if (part.bad >= 0) return;
  if (options.antialiased) project_rows<true>(block, camera, profile);
  else project_rows<false>(block, camera, profile);
  basis_rows<DEGREE>(block, camera);
  for (int64_t i = first; i < last; i++) {
    Seen &row = all[i];
    row.n = -1;
    count[i] = 0;
    if (!project_splat<DEGREE>(block, i, i - first, row)) continue;
    row.first = int32_t(part.slot);
    part.slot += row.n;
    if (row.n == 0) continue;
    const uint32_t depth = ordered_bits(row.depth);
    part.depths.low = std::min(part.depths.low, depth);
    part.depths.high = std::max(part.depths.high, depth);
    part.keys[part.visible++] = uint64_t(depth) << 32 | uint64_t(i);
  }
}

template <int DEGREE> [[gnu::flatten]] bool Stepper::project_splat(const RowBlock &block, int64_t i, int64_t l, Seen &to) {
  if (!in_front(block.depths[0][l], profile)) return false;
  const SplatRow<float> splat = splat_on_screen(block.on_screen(l), camera, profile, options);
  if (splat.radii.x <= 0) return false;
  const float mean2d[2] = {splat.mean2d.x, splat.mean2d.y}, conic[3] = {splat.conic.xx, splat.conic.xy, splat.conic.yy};
  float color[3], basis[MAX_BASIS];
  take_column(block.basis, l, basis);
  put(color, color_from_basis(harmonics_of(*given, i), basis, (DEGREE + 1) * (DEGREE + 1)));
  blend.splats[i] = splat_of(mean2d, conic, splat.opacity, color, 3);
  blend.splats[i].rgb[3] = splat.depth;
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

// By depth, then by row. Depths are dealt into buckets, one group of parts to a thread, and every bucket is sorted by
// itself: no two keys are alike, so that their order depends on neither.
Work Stepper::count_buckets() {
  uint32_t high = 0;
  lowest = ~uint32_t(0);
  n_visible = 0;
  for (size_t part = 0; part < part_visible.size(); part++) {
    n_visible += part_visible[part];
    lowest = std::min(lowest, part_depths[part].low);
    high = std::max(high, part_depths[part].high);
  }
  bucket_shift = 0;
  while (n_visible > 0 && (high - lowest) >> bucket_shift >= uint32_t(BUCKETS)) bucket_shift++;
  const int64_t n_parts = int64_t(part_visible.size());
  group_parts = std::max<int64_t>(1, parts_of(n_parts, pool.size()));
  buckets.resize(size_t(parts_of(n_parts, group_parts) * BUCKETS));
  bucket_begins.assign(BUCKETS + 1, 0);
  return {n_parts, group_parts, [this](int, int64_t first, int64_t last) {
            int64_t *const count = &buckets[size_t(first / group_parts * BUCKETS)];
            std::fill(count, count + BUCKETS, 0);
            each_key(first, last, [&](uint64_t key) { count[bucket_of(key)]++; });
          }};
}

// Calls f(key) for the visible Gaussians of some parts, row by row.
template <class F> void Stepper::each_key(int64_t first, int64_t last, F f) const {
  for (int64_t part = first; part < last; part++)
    for (int64_t k = part * ROWS; k < part * ROWS + part_visible[size_t(part)]; k++) f(keys[k]);
}

Work Stepper::fill_buckets() {
  int64_t *const begin = bucket_begins.data();
  for (size_t group = 0; group < buckets.size(); group += BUCKETS)
    for (int64_t k = 0; k < BUCKETS; k++) begin[k] += std::exchange(buckets[group + size_t(k)], begin[k]);
  int64_t before = 0;
  for (int64_t k = 0; k <= BUCKETS; k++) before += std::exchange(begin[k], before);
  uint64_t *const to = sorted.get(given->n);
  return {int64_t(part_visible.size()), group_parts, [=](int, int64_t first, int64_t last) {
            int64_t *const next = &buckets[size_t(first / group_parts * BUCKETS)];
            for (int64_t k = 0; k < BUCKETS; k++) next[k] += begin[k];
            each_key(first, last, [&](uint64_t key) { to[next[bucket_of(key)]++] = key; });
          }};
}

Work Stepper::sort_buckets() {
  // the keys have been dealt out: their memory is free
  uint64_t *const spare = keys.get(given->n), *const all = sorted.get(given->n);
  return {n_visible > 0 ? BUCKETS : 0, BUCKETS / 64, [=](int, int64_t first, int64_t last) {
            for (int64_t k = first; k < last; k++)
              sort_bucket(all + bucket_begins[size_t(k)], all + bucket_begins[size_t(k + 1)], spare + bucket_begins[size_t(k)]);
          }};
}

// Digit by digit from the lowest of the bits that the depths of a bucket may differ in, each pass keeping the order
// before it, which was that of the rows.
void Stepper::sort_bucket(uint64_t *first, uint64_t *last, uint64_t *spare) const {
  constexpr int DIGIT = 9, VALUES_OF_DIGIT = 1 << DIGIT, FEW = 32;
  const int64_t n = last - first;
  if (n <= FEW) return std::sort(first, last);
  uint64_t *from = first, *to = spare;
  for (int shift = 0; shift < bucket_shift; shift += DIGIT) {
    const auto digit = [&](uint64_t key) { return (uint32_t(key >> 32) - lowest) >> shift & (VALUES_OF_DIGIT - 1); };
    int32_t places[VALUES_OF_DIGIT] = {}, before = 0;
    for (int64_t k = 0; k < n; k++) places[digit(from[k])]++;
    for (int32_t &place : places) before += std::exchange(place, before);
    for (int64_t k = 0; k < n; k++) to[places[digit(from[k])]++] = from[k];
    std::swap(from, to);
  }
  if (from != first) std::copy(from, from + n, first);
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
  starts.resize(size_t(parts_of(n_visible, part) * n_tiles));
  return {n_visible, part, [=](int, int64_t first, int64_t last) {
            int64_t *const count = &starts[size_t(first / part * n_tiles)];
            std::fill(count, count + n_tiles, 0);
            each_entry(first, last, [&](int64_t, int64_t tile, int64_t) { count[tile]++; });
          }};
}

// Tile by tile, where each part's entries begin among the tile's own.
Work Stepper::add_up_parts() {
  const int64_t n_parts = parts_of(n_visible, list_part()), n_tiles = blend.tiles();
  return {n_tiles, SOME_TILES, [=](int, int64_t first, int64_t last) {
            std::fill(offsets.begin() + first, offsets.begin() + last, 0);
            for (int64_t k = 0; k < n_parts; k++)
              for (int64_t tile = first; tile < last; tile++)
                offsets[size_t(tile)] += std::exchange(starts[size_t(k * n_tiles + tile)], offsets[size_t(tile)]);
          }};
}

Work Stepper::place_entries() {
  const int64_t part = list_part(), n_tiles = blend.tiles();
  int64_t total = 0, n_chunks = 0;
  for (int64_t tile = 0; tile < n_tiles; tile++) {
    const int64_t entries = std::exchange(offsets[size_t(tile)], total);
    first_chunks[size_t(tile)] = n_chunks;
    total += entries;
    n_chunks += parts_of(entries, CHUNK);
  }
  offsets[size_t(n_tiles)] = total;
  int64_t *const to_ids = ids.get(total);
  int32_t *const to_slots = slots.get(total);
  blend.ids = to_ids;
  blend.slots = to_slots;
  blend.transmittances = transmittances.get(n_chunks * pixels.padded());
  blend.reached = reached.get(n_chunks * pixels.strips * PIECES);
  blend.rows = rows.get(total * blend.columns());
  return {n_visible, part, [=](int, int64_t first, int64_t last) {
            int64_t *const next = &starts[size_t(first / part * n_tiles)];
            for (int64_t tile = 0; tile < n_tiles; tile++) next[tile] += offsets[size_t(tile)];
            each_entry(first, last, [&](int64_t i, int64_t tile, int64_t slot) {
              to_ids[next[tile]] = i;
              to_slots[next[tile]++] = int32_t(slot);
            });
          }};
}

}  // namespace pop
