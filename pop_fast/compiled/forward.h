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
  Numbers<Real> T, alphas, colors, best;
  Numbers<Whole<Real>> winner, blended, traversed;
  std::vector<int32_t> won;  // pixels, by nobody and by each entry. [1 + entries]
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
  bool lit(int strip, int piece) const {
    return any(load_piece(&T[strip * LANES<Real> + piece * PIECE_LANES<Real>]) > Real(0));
  }
  bool lit() const {
    for (int strip = 0; strip * LANES<Real> < padded; strip++)
      if (lit(strip)) return true;
    return false;
  }
};

// Blend some entries into one piece of a strip, and return those that did. D channels, known to the compiler unless 0;
// COUNT where visits are counted.
template <class Real, int D, bool ROW, bool DOMINANCE, bool COUNT>
uint32_t blend_piece(const Blend<Real> &blend, const Thresholds<Real> &thresholds, const Pixels<Real> &pixels,
                    int strip, int piece, uint32_t marks, Canvas<Real> &canvas) {
  using V = Piece<Real>;
  using M = Piece<Whole<Real>>;
  const int at = strip * LANES<Real> + piece * PIECE_LANES<Real>;
  const Entries<Real> &entries = canvas.entries;
  const V x = load_piece(&pixels.x[at]), y = load_piece(&pixels.y[at]);
  V T = load_piece(&canvas.T[at]), sum_of_weights = load_piece(&canvas.alphas[at]), colors[D ? D : 1], best{};
  M winner{};
  for (int d = 0; d < D; d++) colors[d] = load_piece(&canvas.colors[d * canvas.padded + at]);
  if (DOMINANCE) {
    best = load_piece(&canvas.best[at]);
    winner = load_piece(&canvas.winner[at]);
  }
  uint32_t reached = 0;
  each_marked(marks, [&](int k, uint32_t bit) {
    if constexpr (COUNT) {
      Whole<Real> *visits = &canvas.traversed[at];
      store_chunk(visits, load_piece(visits) - (T > Real(0)));
    }
    const V before = T;
    V alpha, weight;
    take(thresholds, exponent<Real, ROW>(entries, canvas.rows, strip, k, x, y), T, alpha, weight);
    // the transpose must also meet the entry at which a pixel stops, which has no weight there
    reached |= any(T < before) ? bit : 0;
    sum_of_weights += weight;
    for (int d = 0; d < D; d++) colors[d] += weight * entries.rgb[k][d];
    for (int d = 0; !D && d < blend.channels; d++) {
      Real *sums = &canvas.colors[d * canvas.padded + at];
      store_chunk(sums, load_piece(sums) + weight * entries.color[k][d]);
    }
    if (DOMINANCE) {
      // strictly larger: on equal weights the entry in front keeps the pixel
      const M wins = weight > best, this_one = M{} + entries.places[k];
      best = select(wins, weight, best);
      winner = select(wins, this_one, winner);
    }
    if constexpr (COUNT) {
      Whole<Real> *count = &canvas.blended[at];
      store_chunk(count, load_piece(count) - (weight > Real(0)));
    }
  });
  store_chunk(&canvas.T[at], T);
  store_chunk(&canvas.alphas[at], sum_of_weights);
  for (int d = 0; d < D; d++) store_chunk(&canvas.colors[d * canvas.padded + at], colors[d]);
  if (DOMINANCE) {
    store_chunk(&canvas.best[at], best);
    store_chunk(&canvas.winner[at], winner);
  }
  return reached;
}

// Add the pixels that each splat won to its count; integers, so that the order does not matter.
template <class Real>
void count_winners(const Blend<Real> &blend, const Place<Real> &place, Canvas<Real> &canvas) {
  // counted in the tile first: a splat's own count is far away, and shared by all threads
  canvas.won.assign(size_t(blend.n_reached[place.tile]) + 1, 0);
  place.each_row([&](int64_t pixel, int64_t to) {
    for (int64_t x = 0; x < place.columns(); x++)
      canvas.won[canvas.winner[pixel + x] + 1] += !blend.kept || blend.kept[to + x];
  });
  for (size_t k = 1; k < canvas.won.size(); k++)
    if (canvas.won[k] > 0) {
      const int64_t id = blend.ids[place.begin + k - 1];
      __atomic_fetch_add(&blend.dominant_counts[id], canvas.won[k], __ATOMIC_RELAXED);
    }
}

template <class Real> void write(const Blend<Real> &blend, const Place<Real> &place, Canvas<Real> &canvas) {
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

template <class Real, int D, bool ROW, bool DOMINANCE, bool COUNT = false>
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
    // visits are counted of entries that reach no pixel too
    const uint32_t all_of_them = (uint32_t(1) << entries.count) - 1;
    for (int strip = 0; strip < pixels.strips; strip++) {
      if (canvas.lit(strip))
        pairs += int64_t(entries.count) * std::min(LANES<Real>, pixels.count - strip * LANES<Real>);
      for (int piece = 0; piece < PIECES; piece++) {
        uint32_t reached = 0;
        if (canvas.lit(strip, piece)) {
          const uint32_t marks = COUNT ? all_of_them : canvas.rows.of_piece(pixels, strip, piece);
          reached = blend_piece<Real, D, ROW, DOMINANCE, COUNT>(blend, thresholds, pixels, strip, piece, marks, canvas);
        }
        if (blend.reached) blend.reached[(chunk * pixels.strips + strip) * PIECES + piece] = uint16_t(reached);
      }
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
  if (blend.n_traversed) {
    if (blend.channels != 3) return blend_tile<Real, 0, false, true, true>;
    return pixels.strips_are_rows() ? blend_tile<Real, 3, true, true, true> : blend_tile<Real, 3, false, true, true>;
  }
  if (blend.channels != 3) return blend.dominance() ? blend_tile<Real, 0, false, true> : blend_tile<Real, 0, false, false>;
  if (pixels.strips_are_rows()) return blend.dominance() ? blend_tile<Real, 3, true, true> : blend_tile<Real, 3, true, false>;
  return blend.dominance() ? blend_tile<Real, 3, false, true> : blend_tile<Real, 3, false, false>;
}

}  // namespace pop
