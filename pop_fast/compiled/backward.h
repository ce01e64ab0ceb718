// Pull the cotangent of a tile back to its entries. Meaning: `pop_ref.compositing.composite_vjp`.
//
// Alphas and weights are made anew from T before every chunk, front to back; then the chunk is gone through back to
// front with one number a pixel, B, the colour from behind dotted with the pixel's cotangent:
//     q = colour . v - B;  B += alpha q;  G = weight q = alpha dL/dalpha
// Six moments of G about the splat's centre give every geometric gradient of the splat, and can be added up over tiles.
#pragma once

#include "tile.h"

namespace pop {

// A chunk of a tile's list that is blended again from the light before it.
template <class Real> struct Again {
  const int padded, strips;
  std::vector<Real> alphas, weights;  // [entries of a chunk, pixels]
  std::vector<uint64_t> marks;        // in which strips an entry blends. [entries of a chunk, words]
  Entries<Real> entries;
  Rows<Real> rows;

  explicit Again(const Pixels<Real> &pixels)
      : padded(pixels.padded()), strips(pixels.strips), alphas(CHUNK * padded), weights(CHUNK * padded),
        marks(CHUNK * words()), rows(pixels.size) {}

  int words() const { return (strips + 63) / 64; }

  template <bool ROW>
  void blend_again(const Thresholds<Real> &thresholds, const Pixels<Real> &pixels, const Real *transmittances,
                   const uint16_t *reached) {
    std::fill(marks.begin(), marks.end(), 0);
    Real *to_alphas = alphas.data(), *to_weights = weights.data();
    for (int strip = 0; strip < strips; strip++) {
      const int at = strip * LANES<Real>;
      const Vec<Real> x = load(&pixels.x[at]), y = load(&pixels.y[at]);
      Vec<Real> T = load(transmittances + at);
      each_marked(reached[strip], [&](int k) {
        marks[k * words() + strip / 64] |= uint64_t(1) << strip % 64;
        Vec<Real> alpha, weight;
        take(thresholds, exponent<Real, ROW>(entries, rows, strip, k, x, y), T, alpha, weight);
        store(to_alphas + k * padded + at, alpha);
        store(to_weights + k * padded + at, weight);
      });
    }
  }

  bool marked(int k) const {
    for (int word = 0; word < words(); word++)
      if (marks[k * words() + word]) return true;
    return false;
  }

  // calls f(strip) for those in which entry k blends
  template <class F> void each_strip(int k, F f) const {
    for (int word = 0; word < words(); word++)
      for (uint64_t left = marks[k * words() + word]; left; left &= left - 1) f(64 * word + __builtin_ctzll(left));
  }
};

// A tile's cotangents, the colour from behind, and what a chunk's entries sum up in each lane.
template <class Real> struct Transpose : Again<Real> {
  using Again<Real>::padded;
  std::vector<Real> v, suffix_dot_grad, sums;

  Transpose(const Pixels<Real> &pixels, int64_t channels)
      : Again<Real>(pixels), v((channels + 1) * padded), suffix_dot_grad(padded),
        sums((channels + 8) * CHUNK * LANES<Real>) {}

  void begin(const Blend<Real> &blend, const Place<Real> &place) {
    const int64_t D = blend.channels, n = place.columns();
    std::fill(v.begin(), v.end(), Real(0));
    std::fill(suffix_dot_grad.begin(), suffix_dot_grad.end(), Real(0));
    place.each_row([&](int64_t pixel, int64_t from) {
      for (int64_t d = 0; blend.v_image && d < D; d++) {
        const Real *line = blend.v_image + from * blend.pixel_stride + d * blend.channel_stride;
        for (int64_t x = 0; x < n; x++) v[d * padded + pixel + x] = line[x * blend.pixel_stride];
      }
      if (blend.v_alphas) std::copy_n(blend.v_alphas + from, n, &v[D * padded + pixel]);
    });
  }

  // of one column of a chunk's rows: the sums in every lane. [entries of a chunk, lanes]
  Real *column(int64_t j) { return &sums[j * CHUNK * LANES<Real>]; }
};

// B3: what the ceiling lets through of G. G carries the clamped alpha; where the gradient passes as if nothing had been
// clamped, the chain rule wants the raw one.
template <class Real>
inline Vec<Real> through_ceiling(const Blend<Real> &blend, Real ceiling, Vec<Real> e, Vec<Real> alpha, Vec<Real> G) {
  const Mask<Real> clamped = alpha >= ceiling;
  if (!blend.ceiling_passes) return select(clamped, all(Real(0)), G);
  return select(clamped, G * (exp2_of(e) / ceiling), G);
}

// One entry's sums in every lane: moments of G, gradient to the colours, |G dlog2(alpha)/dx| and |..dy|.
template <class Real, int D, bool ROW>
void entry_sums(const Blend<Real> &blend, const Thresholds<Real> &thresholds, const Pixels<Real> &pixels, int k,
                Transpose<Real> &state) {
  const int64_t channels = D ? D : blend.channels;
  const int padded = state.padded;
  const Entries<Real> &entries = state.entries;
  const Real *color = D ? entries.rgb[k] : entries.color[k], *all_x = pixels.x.data(), *all_y = pixels.y.data();
  const Real *alphas = &state.alphas[k * padded], *weights = &state.weights[k * padded], *all_v = state.v.data();
  const Real u = entries.u[k], v_center = entries.v[k];
  Real *all_suffix_dot_grad = state.suffix_dot_grad.data();
  Vec<Real> m{}, mx{}, my{}, mxx{}, mxy{}, myy{}, along_x{}, along_y{}, colors[D ? D : 1]{};
  const auto of_strip = [&](int strip) {
    const int at = strip * LANES<Real>;
    const Vec<Real> alpha = load(alphas + at), weight = load(weights + at);
    const Vec<Real> suffix_dot_grad = load(all_suffix_dot_grad + at);
    Vec<Real> q = load(all_v + channels * padded + at) - suffix_dot_grad;
    for (int d = 0; d < D; d++) {
      const Vec<Real> v = load(all_v + d * padded + at);
      q += v * color[d];
      colors[d] += weight * v;
    }
    for (int64_t d = 0; !D && d < channels; d++) {
      const Vec<Real> v = load(all_v + d * padded + at);
      Real *sum = state.column(6 + d) + k * LANES<Real>;
      q += v * color[d];
      store(sum, load(sum) + weight * v);
    }
    store(all_suffix_dot_grad + at, suffix_dot_grad + alpha * q);
    const Vec<Real> x = load(all_x + at), y = load(all_y + at), dx = u - x;
    Vec<Real> G = weight * q;
    if (any(alpha >= thresholds.ceiling))
      G = through_ceiling(blend, thresholds.ceiling, exponent<Real, ROW>(entries, state.rows, strip, k, x, y), alpha, G);
    const Vec<Real> Gx = G * dx;
    m += G;
    mx += Gx;
    mxx += Gx * dx;
    if constexpr (ROW) {
      const Real dy = v_center - all_y[at], dy_dy = dy * dy;
      my += G * dy;
      mxy += Gx * dy;
      myy += G * dy_dy;
    } else {
      const Vec<Real> dy = v_center - y, Gy = G * dy;
      my += Gy;
      mxy += Gx * dy;
      myy += Gy * dy;
    }
    if (blend.absgrad) {
      const auto f = [&](int j) { return entries.f[j][k]; };
      const Vec<Real> by_x = G * (x * (2 * f(3)) + (y * f(4) + f(1))), by_y = G * (y * (2 * f(5)) + (x * f(4) + f(2)));
      along_x += select(by_x < Real(0), -by_x, by_x);
      along_y += select(by_y < Real(0), -by_y, by_y);
    }
  };
  state.each_strip(k, of_strip);
  const Vec<Real> *moments[6] = {&m, &mx, &my, &mxx, &mxy, &myy};
  for (int j = 0; j < 6; j++) store(state.column(j) + k * LANES<Real>, *moments[j]);
  for (int d = 0; d < D; d++) store(state.column(6 + d) + k * LANES<Real>, colors[d]);
  if (blend.absgrad) {
    store(state.column(6 + channels) + k * LANES<Real>, along_x);
    store(state.column(7 + channels) + k * LANES<Real>, along_y);
  }
}

// Write the rows of a chunk's entries from their sums in every lane; those of entries that blend nowhere are 0.
template <class Real>
void write_rows(const Blend<Real> &blend, int n, const Transpose<Real> &state, Real *const to[CHUNK]) {
  const int64_t columns = blend.columns();
  for (int64_t j = 0; j < columns; j++) {
    Real found[CHUNK];
    sums_of_rows(&state.sums[j * CHUNK * LANES<Real>], found);
    // the coefficients are those of log2(alpha)
    const Real unit = j >= 6 + blend.channels ? Real(0.6931471805599453) : Real(1);
    for (int k = 0; k < n; k++) to[k][j] = unit * found[k];
  }
}

template <class Real, int D, bool ROW>
void transpose_tile(const Blend<Real> &blend, const Pixels<Real> &pixels, int64_t tile, Transpose<Real> &state) {
  const Place<Real> place(blend, tile);
  const Thresholds<Real> thresholds(blend);
  const int64_t n_reached = blend.n_reached[tile], n_chunks = (n_reached + CHUNK - 1) / CHUNK;
  state.begin(blend, place);
  for (int64_t chunk = n_chunks - 1; chunk >= 0; chunk--) {
    const int64_t first = place.begin + chunk * CHUNK, at = blend.first_chunks[tile] + chunk;
    const int n = int(std::min<int64_t>(CHUNK, place.begin + n_reached - first));
    state.entries.gather(blend, place, first, n, first - CHUNK);
    if (ROW) state.rows.expand(state.entries, pixels);
    state.template blend_again<ROW>(thresholds, pixels, blend.transmittances + at * state.padded,
                                    blend.reached + at * state.strips);
    Real *rows[CHUNK];
    for (int k = n - 1; k >= 0; k--) {
      rows[k] = blend.rows + blend.slot(first + k) * blend.columns();
      if (!D || !state.marked(k))
        for (int64_t j = 0; j < blend.columns(); j++)
          std::fill_n(state.column(j) + k * LANES<Real>, LANES<Real>, Real(0));
      if (state.marked(k)) entry_sums<Real, D, ROW>(blend, thresholds, pixels, k, state);
    }
    write_rows(blend, n, state, rows);
  }
}

// The transpose of one tile for what is given.
template <class Real>
auto transpose_tile_function(const Blend<Real> &blend, const Pixels<Real> &pixels)
    -> void (*)(const Blend<Real> &, const Pixels<Real> &, int64_t, Transpose<Real> &) {
  if (blend.channels != 3) return transpose_tile<Real, 0, false>;
  return pixels.strips_are_rows() ? transpose_tile<Real, 3, true> : transpose_tile<Real, 3, false>;
}

// Add up the rows of every entry of the splats from `first` to before `last`, in the order of the lists, in double.
template <class Real> void add_up(const Blend<Real> &blend, int64_t first, int64_t last) {
  const int64_t columns = blend.columns(), D = blend.channels, n = blend.n;
  std::vector<double> sums((last - first) * columns);
  for (int64_t tile = 0; tile < blend.tiles(); tile++) {
    const int64_t begin = blend.offsets[tile], end = begin + blend.n_reached[tile];
    for (int64_t entry = begin; entry < end; entry++) {
      const int64_t id = blend.ids[entry];
      if (id < first || id >= last) continue;
      const Real *row = blend.rows + entry * columns;
      double *sum = &sums[(id - first) * columns];
      for (int64_t j = 0; j < columns; j++) sum[j] += row[j];
    }
  }
  for (int64_t i = first; i < last; i++) {
    const double *sum = &sums[(i - first) * columns];
    const double a = blend.conics[3 * i], b = blend.conics[3 * i + 1], c = blend.conics[3 * i + 2];
    const double opacity = blend.opacities[i];
    blend.v_means2d[i] = Real(-(a * sum[1] + b * sum[2]));
    blend.v_means2d[n + i] = Real(-(b * sum[1] + c * sum[2]));
    blend.v_conics[i] = Real(-0.5 * sum[3]);
    blend.v_conics[n + i] = Real(-sum[4]);
    blend.v_conics[2 * n + i] = Real(-0.5 * sum[5]);
    // a splat without opacity blends nothing: its moment is 0
    blend.v_opacities[i] = opacity == 0.0 ? Real(0) : Real(sum[0] / opacity);
    for (int64_t d = 0; d < D; d++) blend.v_colors[d * n + i] = Real(sum[6 + d]);
    for (int64_t j = 0; blend.absgrad && j < 2; j++) blend.absgrad[j * n + i] = Real(sum[6 + D + j]);
  }
}

}  // namespace pop
