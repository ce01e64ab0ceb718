// Blend a tile's list front to back. Meaning: `pop_ref.compositing.composite`, `pop_ref.dominance`.
#pragma once

#include "threads.h"
#include "tile.h"

namespace pop {

constexpr int64_t TILES_AT_A_TIME = 4;

template <class Real> void make_splats(const Blend<Real> &blend, Fork fork) {
  share(fork, blend.threads, blend.n, 4096, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; i++)
      blend.splats[i] = splat_of(blend.means2d + 2 * i, blend.conics + 3 * i, blend.opacities[i],
                                 blend.colors + blend.channels * i, blend.channels);
  });
}

// A tile's pixels on the way through its list, every array in strips of lanes; and what is known of a chunk.
template <class Real> struct Canvas {
  const int padded;
  std::vector<Real> T, alphas, colors, best;
  std::vector<Whole<Real>> winner, blended, traversed;
  Entries<Real> entries;
  Rows<Real> rows;

  Canvas(const Pixels<Real> &pixels, int64_t channels)
      : padded(pixels.padded()), T(padded), alphas(padded), colors(channels * padded), best(padded), winner(padded),
        blended(padded), traversed(padded), rows(pixels.size) {}

  void clear(const Place<Real> &place) {
    for (auto *numbers : {&T, &alphas, &colors, &best}) std::fill(numbers->begin(), numbers->end(), Real(0));
    std::fill(winner.begin(), winner.end(), -1);
    for (auto *numbers : {&blended, &traversed}) std::fill(numbers->begin(), numbers->end(), 0);
    // pixels off the image and padding have no light, as if they had stopped
    place.each_row([&](int64_t pixel, int64_t) { std::fill_n(&T[pixel], place.columns(), Real(1)); });
  }
  bool lit(int strip) const { return any(load(&T[strip * LANES<Real>]) > Real(0)); }
  bool lit() const {
    for (int strip = 0; strip * LANES<Real> < padded; strip++)
      if (lit(strip)) return true;
    return false;
  }
};

// Blend some entries into one strip, and return those that did. D channels, known to the compiler unless 0.
template <class Real, int D, bool ROW, bool DOMINANCE>
uint32_t blend_strip(const Blend<Real> &blend, const Thresholds<Real> &thresholds, const Pixels<Real> &pixels,
                     int64_t place_in_list, int strip, uint32_t marks, Canvas<Real> &canvas) {
  const int at = strip * LANES<Real>;
  const Entries<Real> &entries = canvas.entries;
  const Vec<Real> x = load(&pixels.x[at]), y = load(&pixels.y[at]);
  Vec<Real> T = load(&canvas.T[at]), sum_of_weights = load(&canvas.alphas[at]), colors[D ? D : 1], best{};
  Mask<Real> winner{};
  for (int d = 0; d < D; d++) colors[d] = load(&canvas.colors[d * canvas.padded + at]);
  if (DOMINANCE) {
    best = load(&canvas.best[at]);
    winner = load_whole<Real>(&canvas.winner[at]);
  }
  uint32_t reached = 0;
  each_marked(marks, [&](int k) {
    if (blend.n_traversed) {
      Whole<Real> *visits = &canvas.traversed[at];
      store_whole<Real>(visits, load_whole<Real>(visits) - (T > Real(0)));
    }
    const Vec<Real> before = T;
    Vec<Real> alpha, weight;
    take(thresholds, exponent<Real, ROW>(entries, canvas.rows, strip, k, x, y), T, alpha, weight);
    // the transpose must also meet the entry at which a pixel stops, which has no weight there
    reached |= uint32_t(any(T < before)) << k;
    sum_of_weights += weight;
    for (int d = 0; d < D; d++) colors[d] += weight * entries.rgb[k][d];
    for (int d = 0; !D && d < blend.channels; d++) {
      Real *sums = &canvas.colors[d * canvas.padded + at];
      store(sums, load(sums) + weight * entries.color[k][d]);
    }
    if (DOMINANCE) {
      // strictly larger: on equal weights the entry in front keeps the pixel
      const Mask<Real> wins = weight > best, this_one = Mask<Real>{} + Whole<Real>(place_in_list + k);
      best = select(wins, weight, best);
      winner = select(wins, this_one, winner);
    }
    if (blend.n_blended) {
      Whole<Real> *count = &canvas.blended[at];
      store_whole<Real>(count, load_whole<Real>(count) - (weight > Real(0)));
    }
  });
  store(&canvas.T[at], T);
  store(&canvas.alphas[at], sum_of_weights);
  for (int d = 0; d < D; d++) store(&canvas.colors[d * canvas.padded + at], colors[d]);
  if (DOMINANCE) {
    store(&canvas.best[at], best);
    store_whole<Real>(&canvas.winner[at], winner);
  }
  return reached;
}

// Add the pixels that each splat won to its count; integers, so that the order does not matter.
template <class Real>
void count_winners(const Blend<Real> &blend, const Place<Real> &place, const Canvas<Real> &canvas) {
  int64_t last = -1;
  int32_t run = 0;
  const auto flush = [&] {
    if (last >= 0 && run > 0) __atomic_fetch_add(&blend.dominant_counts[blend.ids[place.begin + last]], run, __ATOMIC_RELAXED);
    run = 0;
  };
  place.each_pixel([&](int64_t pixel, int64_t to) {
    const int64_t winner = canvas.winner[pixel];
    if (winner != last) {
      flush();
      last = winner;
    }
    run += !blend.kept || blend.kept[to];
  });
  flush();
}

template <class Real> void write(const Blend<Real> &blend, const Place<Real> &place, const Canvas<Real> &canvas) {
  const int64_t n = place.columns();
  place.each_row([&](int64_t pixel, int64_t to) {
    if (blend.alphas) std::copy_n(&canvas.alphas[pixel], n, blend.alphas + to);
    for (int64_t d = 0; d < blend.channels; d++) {
      const Real *from = &canvas.colors[d * canvas.padded + pixel];
      Real *line = blend.image + to * blend.pixel_stride + d * blend.channel_stride;
      for (int64_t x = 0; x < n; x++) line[x * blend.pixel_stride] = from[x];
    }
  });
  if (blend.dominant_counts) count_winners(blend, place, canvas);
  if (!blend.dominant_ids && !blend.n_traversed) return;
  place.each_pixel([&](int64_t pixel, int64_t to) {
    if (blend.dominant_ids) {
      const int64_t winner = canvas.winner[pixel];
      blend.dominant_ids[to] = winner < 0 ? -1 : blend.ids[place.begin + winner];
      blend.dominant_weights[to] = canvas.best[pixel];
    }
    if (blend.n_traversed) {
      blend.n_blended[to] = int32_t(canvas.blended[pixel]);
      blend.n_traversed[to] = int32_t(canvas.traversed[pixel]);
    }
  });
}

template <class Real, int D, bool ROW, bool DOMINANCE>
void blend_tile(const Blend<Real> &blend, const Pixels<Real> &pixels, int64_t tile, Canvas<Real> &canvas) {
  const Place<Real> place(blend, tile);
  const Thresholds<Real> thresholds(blend);
  canvas.clear(place);
  Entries<Real> &entries = canvas.entries;
  int64_t at = place.begin, pairs = 0;
  for (; at < place.end && canvas.lit(); at += entries.count) {
    entries.gather(blend, place, at, std::min<int64_t>(CHUNK, place.end - at), at + CHUNK);
    canvas.rows.expand(entries, pixels);
    canvas.rows.look(entries, pixels, thresholds);
    const int64_t chunk = blend.transmittances ? blend.first_chunks[tile] + (at - place.begin) / CHUNK : 0;
    if (blend.transmittances) std::copy(canvas.T.begin(), canvas.T.end(), blend.transmittances + chunk * canvas.padded);
    for (int strip = 0; strip < pixels.strips; strip++) {
      uint32_t reached = 0;
      if (canvas.lit(strip)) {
        pairs += int64_t(entries.count) * std::min(LANES<Real>, pixels.count - strip * LANES<Real>);
        // visits are counted of entries that reach no pixel too
        const uint32_t all_of_them = (uint32_t(1) << entries.count) - 1;
        const uint32_t marks = blend.n_traversed ? all_of_them : canvas.rows.of_strip(pixels, strip);
        reached = blend_strip<Real, D, ROW, DOMINANCE>(blend, thresholds, pixels, at - place.begin, strip, marks, canvas);
      }
      if (blend.reached) blend.reached[chunk * pixels.strips + strip] = uint16_t(reached);
    }
  }
  blend.n_reached[tile] = at - place.begin;
  if (blend.n_pairs) blend.n_pairs[tile] = pairs;
  write(blend, place, canvas);
}

// The blend of one tile for what is asked for.
template <class Real>
auto blend_tile_function(const Blend<Real> &blend, const Pixels<Real> &pixels)
    -> void (*)(const Blend<Real> &, const Pixels<Real> &, int64_t, Canvas<Real> &) {
  if (blend.channels != 3) return blend.dominance() ? blend_tile<Real, 0, false, true> : blend_tile<Real, 0, false, false>;
  if (pixels.strips_are_rows()) return blend.dominance() ? blend_tile<Real, 3, true, true> : blend_tile<Real, 3, true, false>;
  return blend.dominance() ? blend_tile<Real, 3, false, true> : blend_tile<Real, 3, false, false>;
}

}  // namespace pop
