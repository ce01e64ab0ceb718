// One tile of the blend: what a call is given, which entries may reach which strips, and alpha, weight and T of a strip.
//
// A strip is as many of the tile's pixels as there are lanes, row by row; in tiles of 16 px and float it is one row.
// Sixteen list entries are taken at a time. On a row log2(alpha) is a parabola in x, whose maximum says, for sixteen
// entries at once, which of them may reach the alpha floor there, or in a piece of it: only those are blended into it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "lanes.h"

namespace pop {

constexpr int CHUNK = 16;  // list entries at a time, after which T of every pixel is written down for the transpose

// What blending needs of a splat, once a render: log2(alpha) = log2_opacity - (a dx^2 + c dy^2) / 2 - b dx dy.
struct alignas(64) Splat {
  double x, y, a, b, c, log2_opacity;
  float rgb[4];  // of three channels of floats, which lie in the same line of the cache so; the step's fourth is depth
};

template <class Real>
inline Splat splat_of(const Real *mean2d, const Real *conic, Real opacity, const Real *color, int64_t channels) {
  const double log2_e = 1.4426950408889634;
  // the logarithm of 0 is -inf: under every floor
  Splat splat = {double(mean2d[0]),          double(mean2d[1]),          log2_e * double(conic[0]),
                 log2_e * double(conic[1]), log2_e * double(conic[2]), std::log2(double(opacity)), {}};
  for (int d = 0; channels == 3 && d < 3; d++) splat.rgb[d] = float(color[d]);
  return splat;
}

// Everything of one call; eight bytes each, in the order of `library.py`. Null where a result is not asked for.
template <class Real> struct Blend {
  const Real *means2d, *conics, *opacities, *colors;  // [N, 2], [N, 3], [N], [N, D]; colours null: all in `splats`
  const int64_t *ids, *offsets;                       // tile lists: splat of every entry, [tiles + 1]
  const int64_t *first_chunks;                        // chunks of all tiles before this one. [tiles]
  int64_t n, channels, tiles_x, tiles_y, tile_size, width, height, threads;
  int64_t pixel_stride, channel_stride;  // of image and v_image: [H, W, D] has D and 1, [D, H, W] has 1 and H W
  double alpha_floor, alpha_ceiling, stop;  // alpha > floor is blended, T > stop continues: strictness is folded in
  int64_t ceiling_passes;                   // B3: whether the gradient goes through the ceiling
  Splat *splats;                            // the forward pass makes them, and the transpose takes them. [N]
  Real *transmittances;                             // T before every chunk, for the transpose. [chunks, strips, lanes]
  uint16_t *reached;                        // likewise, which entries blend in a piece. [chunks, strips, PIECES]
  int64_t *n_reached, *n_pairs;             // entries blended before all pixels had stopped; pairs. [tiles]
  Real *image, *alphas;                     // [H, W, D] or [D, H, W], [H, W]
  int64_t *dominant_ids;                    // D8. [H, W]
  Real *dominant_weights;                   // [H, W]
  int32_t *n_blended, *n_traversed;         // [H, W]
  const Real *v_image, *v_alphas;           // as the image, [H, W]
  Real *rows;                               // gradients of every entry: six moments, colours, absolute values
  Real *v_means2d, *v_conics, *v_opacities, *v_colors;  // [2, N], [3, N], [N], [D, N]
  Real *absgrad;                                        // [2, N]
  const int32_t *slots;      // where the row of an entry lies among the rows; null: in the order of the lists. [entries]
  int32_t *dominant_counts;  // added to: pixels won by every splat, where `kept`. [N]
  const uint8_t *kept;       // nonzero for pixels that count; null: all do. [H, W]

  int64_t tiles() const { return tiles_x * tiles_y; }
  int64_t columns() const { return 6 + channels + (absgrad ? 2 : 0); }
  bool dominance() const { return dominant_ids || dominant_counts; }
  int64_t slot(int64_t entry) const { return slots ? slots[entry] : entry; }
};

// Pixel centres from the tile's centre, padded to whole strips of lanes, and the rows that each strip is of.
template <class Real> struct Pixels {
  int size, count, strips;
  Numbers<Real> x, y;
  std::vector<int> first_row, last_row;

  explicit Pixels(int size)
      : size(size), count(size * size), strips((count + LANES<Real> - 1) / LANES<Real>), first_row(strips),
        last_row(strips) {
    x.assign(strips * LANES<Real>, Real(0));
    y = x;
    for (int p = 0; p < count; p++) {
      x[p] = p % size + Real(0.5) - Real(0.5) * size;
      y[p] = p / size + Real(0.5) - Real(0.5) * size;
    }
    for (int strip = 0; strip < strips; strip++) {
      first_row[strip] = strip * LANES<Real> / size;
      last_row[strip] = std::min(count - 1, (strip + 1) * LANES<Real> - 1) / size;
    }
  }
  int padded() const { return strips * LANES<Real>; }
  Real row_center(int row) const { return row + Real(0.5) - Real(0.5) * size; }
  // whether a strip is one row, so that y is one number there
  bool strips_are_rows() const { return size == LANES<Real>; }
};

// Where a tile lies in the image, and its list.
template <class Real> struct Place {
  int64_t tile, left, top, begin, end, size, width, height;

  Place(const Blend<Real> &blend, int64_t tile)
      : tile(tile), left(tile % blend.tiles_x * blend.tile_size), top(tile / blend.tiles_x * blend.tile_size),
        begin(blend.offsets[tile]), end(blend.offsets[tile + 1]), size(blend.tile_size), width(blend.width),
        height(blend.height) {}

  int64_t columns() const { return std::min(size, width - left); }

  // calls f(first pixel of the tile, first pixel of the image) for every row of those that lie in the image
  template <class F> void each_row(F f) const {
    const int64_t below = std::min(size, height - top);
    for (int64_t y = 0; y < below; y++) f(y * size, (top + y) * width + left);
  }

  // calls f(pixel of the tile, pixel of the image) for those that lie in the image
  template <class F> void each_pixel(F f) const {
    each_row([&](int64_t pixel, int64_t to) {
      for (int64_t x = 0; x < columns(); x++) f(pixel + x, to + x);
    });
  }
};

// The coefficients of log2(alpha) = f . (1, x, y, x^2, xy, y^2) of some entries of a tile. The constant and the linear
// ones cancel for needles whose centre lies far from the tile, so they are computed in double and rounded once.
template <class Real> struct Entries {
  int count;
  alignas(64) Real f[6][CHUNK], u[CHUNK], v[CHUNK];  // u, v: splat's centre from the tile's
  alignas(64) Real rgb[CHUNK][4];                    // where there are three channels, or the step's four
  Whole<Real> places[CHUNK];                         // in the tile's list
  const Real *color[CHUNK];

  // n entries from `first` on; those from `next` on are asked for while these are worked on
  void gather(const Blend<Real> &blend, const Place<Real> &place, int64_t first, int64_t n, int64_t next) {
    count = int(n);
    const double x = place.left + 0.5 * place.size, y = place.top + 0.5 * place.size;
    alignas(64) double su[CHUNK], sv[CHUNK], a[CHUNK], b[CHUNK], c[CHUNK], top[CHUNK];
    for (int k = 0; k < CHUNK; k++) {
      __builtin_prefetch(&blend.splats[blend.ids[std::clamp(next + k, place.begin, place.end - 1)]]);
      // the last chunk of a list is filled up with its last entry, and nobody looks at these
      const int64_t id = blend.ids[first + std::min<int64_t>(k, n - 1)];
      const Splat &s = blend.splats[id];
      su[k] = s.x;
      sv[k] = s.y;
      a[k] = s.a;
      b[k] = s.b;
      c[k] = s.c;
      top[k] = s.log2_opacity;
      places[k] = Whole<Real>(first - place.begin + k);
      // without channels nothing is read, and torch gives a null pointer for what is empty
      if (blend.channels == 0 || (blend.colors && blend.channels != 3)) {
        color[k] = blend.colors + id * blend.channels;
      } else if (sizeof(Real) == 4) {
        std::memcpy(rgb[k], s.rgb, sizeof s.rgb);
      } else {
        std::copy_n(blend.colors + 3 * id, 3, rgb[k]);
      }
    }
    for (int k = 0; k < CHUNK; k++) {
      const double du = su[k] - x, dv = sv[k] - y, gx = a[k] * du + b[k] * dv, gy = b[k] * du + c[k] * dv;
      f[0][k] = Real(top[k] - 0.5 * (gx * du + gy * dv));
      f[1][k] = Real(gx);
      f[2][k] = Real(gy);
      f[3][k] = Real(-0.5 * a[k]);
      f[4][k] = Real(-b[k]);
      f[5][k] = Real(-0.5 * c[k]);
      u[k] = Real(du);
      v[k] = Real(dv);
    }
  }
};

// D5, D6, D7 in the type that is computed in.
template <class Real> struct Thresholds {
  Real floor, ceiling, stop, skip;

  explicit Thresholds(const Blend<Real> &blend)
      : floor(Real(blend.alpha_floor)), ceiling(Real(blend.alpha_ceiling)), stop(Real(blend.stop)),
        // surely under the floor, whatever the power was rounded to
        skip(std::log2(floor) - Real(0.01)) {}
};

// log2(alpha) of a chunk's entries on every row of the tile: f3 x^2 + linear x + constant.
template <class Real> struct Rows {
  using Line = Real[CHUNK];
  Numbers<Real> kept;
  std::vector<uint16_t> may;  // which entries may reach the alpha floor in a piece of a row. [rows, PIECES]

  explicit Rows(int size) : kept(size_t(2 * CHUNK) * size), may(size_t(size * PIECES)) {}
  Real *linear(int row) { return kept.data() + 2 * CHUNK * row; }
  Real *constant(int row) { return linear(row) + CHUNK; }
  const Real *linear(int row) const { return kept.data() + 2 * CHUNK * row; }
  const Real *constant(int row) const { return linear(row) + CHUNK; }

  void expand(const Entries<Real> &entries, const Pixels<Real> &pixels) {
    for (int row = 0; row < pixels.size; row++)
      for (int k = 0; k < CHUNK; k += LANES<Real>) {
        const Real y = pixels.row_center(row);
        const auto f = [&](int j) { return load(&entries.f[j][k]); };
        store(linear(row) + k, y * f(4) + f(1));
        store(constant(row) + k, y * (y * f(5) + f(2)) + f(0));
      }
  }

  // errs towards true: a parabola that is none, and what is not a number, may reach anything
  void look(const Entries<Real> &entries, const Pixels<Real> &pixels, const Thresholds<Real> &thresholds) {
    const Real edge = Real(0.5) * (pixels.size - 1), digits = sizeof(Real) == 4 ? Real(1e-6) : Real(1e-14);
    const uint32_t present = (uint32_t(1) << entries.count) - 1;
    // the first and last pixel of every piece of a row; pieces of strips that are no rows are not told apart
    const int pieces = pixels.strips_are_rows() ? PIECES : 1;
    const Real width = Real(pixels.size) / pieces;
    std::fill(may.begin(), may.end(), 0);
    for (int k = 0; k < CHUNK; k += LANES<Real>) {
      const Vec<Real> f3 = load(&entries.f[3][k]), vertex = Real(-0.5) / f3;
      for (int row = 0; row < pixels.size; row++) {
        const Vec<Real> c1 = load(linear(row) + k), c0 = load(constant(row) + k);
        for (int piece = 0; piece < pieces; piece++) {
          const Real low = piece * width - edge, high = low + (width - 1);
          const Vec<Real> x = least(all(high), most(all(low), c1 * vertex));
          const Vec<Real> square = x * x * f3, mixed = x * c1, size = size_of(mixed) + size_of(c0) - square;
          const Mask<Real> under = square + mixed + c0 + digits * size < thresholds.skip;
          const uint32_t over = ~lanes_of<Real>(under & (f3 < Real(0))) & ((1 << LANES<Real>) - 1);
          may[row * PIECES + piece] |= uint16_t(over << k & present);
        }
      }
    }
  }

  uint32_t of_strip(const Pixels<Real> &pixels, int strip) const {
    uint32_t found = 0;
    for (int of = pixels.first_row[strip] * PIECES; of < (pixels.last_row[strip] + 1) * PIECES; of++) found |= may[of];
    return found;
  }
  uint32_t of_piece(const Pixels<Real> &pixels, int strip, int piece) const {
    if (pixels.strips_are_rows()) return may[strip * PIECES + piece];
    const int first = (strip * PIECES + piece) * PIECE_LANES<Real>;
    const int last = std::min(pixels.count, first + PIECE_LANES<Real>) - 1;
    uint32_t found = 0;
    for (int row = first / pixels.size; row <= last / pixels.size; row++) found |= may[row * PIECES];
    return found;
  }
};

// log2(alpha) of entry k in lanes of a strip; ROW where strips are rows.
template <class Real, bool ROW, class C>
inline C exponent(const Entries<Real> &entries, const Rows<Real> &rows, int strip, int k, C x, C y) {
  if constexpr (ROW) return x * (x * entries.f[3][k] + rows.linear(strip)[k]) + rows.constant(strip)[k];
  const C linear = y * entries.f[4][k] + entries.f[1][k];
  return x * (x * entries.f[3][k] + linear) + (y * (y * entries.f[5][k] + entries.f[2][k]) + entries.f[0][k]);
}

// Blend one entry into lanes of a strip: T goes down; alpha and weight are 0 from where a pixel stops.
template <class Real, class C>
inline void take(const Thresholds<Real> &thresholds, C e, C &T, C &alpha, C &weight) {
  const C none = {}, raw = exp2_of<Real>(e), capped = least(C{} + thresholds.ceiling, raw);
  alpha = select(raw > thresholds.floor, capped, none);
  const C next = fnma(T, alpha, T);
  const auto lives = next > thresholds.stop;
  weight = select(lives, T * alpha, none);
  alpha = select(lives, alpha, none);
  T = select(lives, next, none);
}

// Calls f(k, bit k) for the entries of a chunk that are marked, one after the other.
template <class F> inline void each_marked(uint32_t marks, F f) {
  for (; marks; marks &= marks - 1) f(__builtin_ctz(marks), marks & -marks);
}

}  // namespace pop
