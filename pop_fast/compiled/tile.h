// One tile of the blend: what a call is given, what a tile keeps, and alpha, weight and light of one strip of pixels.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "lanes.h"

namespace pop {

constexpr int CHUNK = 16;  // list entries after which the light of every pixel is written down for the transpose

// What the exponent needs of a splat, once a render: log2(alpha) = log2_opacity - (a dx^2 + c dy^2) / 2 - b dx dy.
struct Splat {
  double x, y, a, b, c, log2_opacity;
};

// Everything of one call; eight bytes each, in the order of `library.py`. Null where a result is not asked for.
template <class Real> struct Blend {
  const Real *means2d, *conics, *opacities, *colors;  // [N, 2], [N, 3], [N], [N, D]
  const int64_t *ids, *offsets;                       // tile lists: splat of every entry, [tiles + 1]
  const int64_t *first_chunks;                        // chunks of all tiles before this one. [tiles]
  int64_t n, channels, tiles_x, tiles_y, tile_size, width, height, threads;
  double alpha_floor, alpha_ceiling, stop;  // alpha > floor is blended, T > stop goes on: strictness is folded in
  int64_t ceiling_passes;                   // B3: whether the gradient goes through the ceiling
  Splat *splats;                            // the forward pass makes them, and the transpose takes them. [N]
  Real *lights;                             // T before every chunk, for the transpose. [chunks, strips, lanes]
  uint64_t *strips;                         // in which strips an entry may blend, likewise: bit strip % 64. [entries]
  int64_t *n_reached, *n_pairs;             // entries blended before all pixels had stopped; pairs. [tiles]
  Real *image, *alphas;                     // [H, W, D], [H, W]
  int64_t *dominant_ids;                    // D8. [H, W]
  Real *dominant_weights;                   // [H, W]
  int32_t *n_blended, *n_traversed;         // [H, W]
  const Real *v_image, *v_alphas;           // [H, W, D], [H, W]
  Real *rows;                               // gradients of every entry: six moments, colours, absolute values
  Real *v_means2d, *v_conics, *v_opacities, *v_colors;  // [2, N], [3, N], [N], [D, N]
  Real *absgrad;                                        // [2, N]

  int64_t tiles() const { return tiles_x * tiles_y; }
  int64_t columns() const { return 6 + channels + (absgrad ? 2 : 0); }
};

// Pixel centres from the tile's centre, padded to whole strips of lanes.
template <class Real> struct Pixels {
  int count, strips;
  std::vector<Real> x, y;

  explicit Pixels(int size) : count(size * size), strips((count + LANES<Real> - 1) / LANES<Real>) {
    x.assign(strips * LANES<Real>, Real(0));
    y = x;
    for (int p = 0; p < count; p++) {
      x[p] = p % size + Real(0.5) - Real(0.5) * size;
      y[p] = p / size + Real(0.5) - Real(0.5) * size;
    }
  }
  int padded() const { return strips * LANES<Real>; }
};

// Where a tile lies in the image, and its list.
template <class Real> struct Place {
  int64_t left, top, begin, end, size, width, height;

  Place(const Blend<Real> &blend, int64_t tile)
      : left(tile % blend.tiles_x * blend.tile_size), top(tile / blend.tiles_x * blend.tile_size),
        begin(blend.offsets[tile]), end(blend.offsets[tile + 1]), size(blend.tile_size), width(blend.width),
        height(blend.height) {}

  // calls f(pixel of the tile, pixel of the image) for those that lie in the image
  template <class F> void each_pixel(F f) const {
    const int64_t right = std::min(size, width - left), below = std::min(size, height - top);
    for (int64_t y = 0; y < below; y++)
      for (int64_t x = 0; x < right; x++) f(y * size + x, (top + y) * width + left + x);
  }
};

// The coefficients of log2(alpha) = f . (1, x, y, x^2, xy, y^2) of some entries of a tile. The constant and the linear
// ones cancel for needles whose centre lies far from the tile, so they are computed in double and rounded once.
template <class Real> struct Entries {
  int count;
  Real f[CHUNK][6], u[CHUNK], v[CHUNK];  // u, v: splat's centre from the tile's
  const Real *color[CHUNK];

  void gather(const Blend<Real> &blend, const Place<Real> &place, int64_t first, int64_t n) {
    count = int(n);
    const double x = place.left + 0.5 * place.size, y = place.top + 0.5 * place.size;
    for (int k = 0; k < count; k++) {
      // the next chunk is asked for while this one is worked on
      __builtin_prefetch(&blend.splats[blend.ids[std::min(first + CHUNK + k, place.end - 1)]]);
      const int64_t id = blend.ids[first + k];
      const Splat &s = blend.splats[id];
      const double du = s.x - x, dv = s.y - y, gx = s.a * du + s.b * dv, gy = s.b * du + s.c * dv;
      const double coefficients[6] = {s.log2_opacity - 0.5 * (gx * du + gy * dv), gx, gy, -0.5 * s.a, -s.b, -0.5 * s.c};
      for (int j = 0; j < 6; j++) f[k][j] = Real(coefficients[j]);
      u[k] = Real(du);
      v[k] = Real(dv);
      color[k] = blend.colors + id * blend.channels;
    }
  }
};

template <class Real> inline Vec<Real> exponent(const Real *f, Vec<Real> x, Vec<Real> y) {
  return x * (x * f[3] + (y * f[4] + f[1])) + (y * (y * f[5] + f[2]) + f[0]);
}

// D5, D6, D7 in the type that is computed in.
template <class Real> struct Thresholds {
  Real floor, ceiling, stop, skip;

  explicit Thresholds(const Blend<Real> &blend)
      : floor(Real(blend.alpha_floor)), ceiling(Real(blend.alpha_ceiling)), stop(Real(blend.stop)),
        // surely under the floor, whatever exponent and power were rounded to
        skip(std::log2(floor) - Real(0.01)) {}
};

// Blend one entry into one strip: T goes down; alpha and weight are 0 from where a pixel stops.
// Returns false, and leaves alpha and weight alone, where the entry is under the floor in all lanes.
template <class Real>
inline bool take(const Thresholds<Real> &thresholds, const Real *f, Vec<Real> x, Vec<Real> y, Vec<Real> &T,
                 Vec<Real> &alpha, Vec<Real> &weight) {
  const Vec<Real> e = exponent(f, x, y), none = all(Real(0));
  if (!any(e > thresholds.skip)) return false;
  alpha = exp2_of(e);
  alpha = alpha > thresholds.ceiling ? all(thresholds.ceiling) : alpha;
  alpha = alpha > thresholds.floor ? alpha : none;
  const Vec<Real> next = T - T * alpha;
  const Mask<Real> lives = next > thresholds.stop;
  weight = lives ? T * alpha : none;
  alpha = lives ? alpha : none;
  T = lives ? next : none;
  return true;
}

}  // namespace pop
