// Blend a tile's list front to back. Meaning: `pop_ref.compositing.composite`, `pop_ref.dominance`.
#pragma once

#include "tile.h"

namespace pop {

// A tile's pixels on the way through its list; every array in strips of lanes.
template <class Real> struct Canvas {
  const int padded;
  std::vector<Real> T, alphas, colors, best;
  std::vector<Whole<Real>> winner, blended, traversed;

  Canvas(const Pixels<Real> &pixels, int64_t channels)
      : padded(pixels.padded()), T(padded), alphas(padded), colors(channels * padded), best(padded), winner(padded),
        blended(padded), traversed(padded) {}

  void clear(const Place<Real> &place) {
    for (auto *numbers : {&T, &alphas, &colors, &best}) std::fill(numbers->begin(), numbers->end(), Real(0));
    std::fill(winner.begin(), winner.end(), -1);
    for (auto *numbers : {&blended, &traversed}) std::fill(numbers->begin(), numbers->end(), 0);
    // pixels off the image and padding have no light, as if they had stopped
    place.each_pixel([&](int64_t pixel, int64_t) { T[pixel] = Real(1); });
  }
  bool lit(int strip) const { return any(load(&T[strip * LANES<Real>]) > Real(0)); }
  bool lit() const {
    for (int strip = 0; strip * LANES<Real> < padded; strip++)
      if (lit(strip)) return true;
    return false;
  }
};

// Blend some entries into one strip. D channels, known to the compiler unless 0.
template <class Real, int D>
void blend_strip(const Blend<Real> &blend, const Thresholds<Real> &thresholds, const Pixels<Real> &pixels,
                 const Entries<Real> &entries, int64_t place_in_list, int at, Canvas<Real> &canvas, uint64_t *marks) {
  const uint64_t mark = uint64_t(1) << (at / LANES<Real> % 64);
  const Vec<Real> x = load(&pixels.x[at]), y = load(&pixels.y[at]);
  Vec<Real> T = load(&canvas.T[at]), sum_of_weights = load(&canvas.alphas[at]), colors[D ? D : 1];
  for (int d = 0; d < D; d++) colors[d] = load(&canvas.colors[d * canvas.padded + at]);
  for (int k = 0; k < entries.count; k++) {
    if (blend.n_traversed) {
      Whole<Real> *visits = &canvas.traversed[at];
      store_whole<Real>(visits, load_whole<Real>(visits) - (T > Real(0)));
    }
    Vec<Real> alpha, weight;
    if (!take(thresholds, entries.f[k], x, y, T, alpha, weight)) continue;
    marks[k] |= mark;
    sum_of_weights += weight;
    for (int d = 0; d < D; d++) colors[d] += weight * entries.color[k][d];
    for (int d = 0; !D && d < blend.channels; d++) {
      Real *sums = &canvas.colors[d * canvas.padded + at];
      store(sums, load(sums) + weight * entries.color[k][d]);
    }
    if (blend.dominant_ids) {
      // strictly larger: on equal weights the entry in front keeps the pixel
      const Vec<Real> best = load(&canvas.best[at]);
      const Mask<Real> wins = weight > best, this_one = Mask<Real>{} + Whole<Real>(place_in_list + k);
      store(&canvas.best[at], wins ? weight : best);
      store_whole<Real>(&canvas.winner[at], wins ? this_one : load_whole<Real>(&canvas.winner[at]));
    }
    if (blend.n_blended) {
      Whole<Real> *count = &canvas.blended[at];
      store_whole<Real>(count, load_whole<Real>(count) - (weight > Real(0)));
    }
  }
  store(&canvas.T[at], T);
  store(&canvas.alphas[at], sum_of_weights);
  for (int d = 0; d < D; d++) store(&canvas.colors[d * canvas.padded + at], colors[d]);
}

template <class Real> void write(const Blend<Real> &blend, const Place<Real> &place, const Canvas<Real> &canvas) {
  place.each_pixel([&](int64_t pixel, int64_t to) {
    blend.alphas[to] = canvas.alphas[pixel];
    for (int64_t d = 0; d < blend.channels; d++)
      blend.image[to * blend.channels + d] = canvas.colors[d * canvas.padded + pixel];
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

template <class Real, int D>
void blend_tile(const Blend<Real> &blend, const Pixels<Real> &pixels, int64_t tile, Canvas<Real> &canvas) {
  const Place<Real> place(blend, tile);
  const Thresholds<Real> thresholds(blend);
  canvas.clear(place);
  Entries<Real> entries;
  int64_t at = place.begin, pairs = 0;
  for (; at < place.end && canvas.lit(); at += entries.count) {
    entries.gather(blend, place, at, std::min<int64_t>(CHUNK, place.end - at));
    uint64_t marks[CHUNK] = {};
    if (blend.lights) {
      const int64_t chunk = blend.first_chunks[tile] + (at - place.begin) / CHUNK;
      std::copy(canvas.T.begin(), canvas.T.end(), blend.lights + chunk * canvas.padded);
    }
    for (int strip = 0; strip < pixels.strips; strip++) {
      if (!canvas.lit(strip)) continue;
      blend_strip<Real, D>(blend, thresholds, pixels, entries, at - place.begin, strip * LANES<Real>, canvas, marks);
      pairs += int64_t(entries.count) * std::min(LANES<Real>, pixels.count - strip * LANES<Real>);
    }
    if (blend.strips) std::copy(marks, marks + entries.count, blend.strips + at);
  }
  blend.n_reached[tile] = at - place.begin;
  blend.n_pairs[tile] = pairs;
  write(blend, place, canvas);
}

}  // namespace pop
