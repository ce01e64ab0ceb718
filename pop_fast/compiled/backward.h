// Pull the cotangent of a tile back to its entries. Meaning: `pop_ref.compositing.composite_vjp`.
//
// Alphas and weights are made anew from T before every chunk, front to back; then the chunk is gone through back to
// front with one number a pixel, B, the colour from behind dotted with the pixel's cotangent:
//     q = colour . v - B;  B += alpha q;  G = weight q = alpha dL/dalpha
// Six moments of G about the splat's centre give every geometric gradient of the splat, and can be added up over tiles.
#pragma once

#include "tile.h"

namespace pop {

// A chunk of a tile's list that is blended again from the light before it. What it finds lies close together in the
// order in which it is made, so that more of it stays in the nearest cache than with a place for every pair.
template <class Real> struct Again {
  // a strip in which an entry blends, and where its alphas and weights begin among the pairs
  struct Found {
    int strip, at;
  };
  const int padded, strips;
  Numbers<Real> pairs;       // [found, 2, lanes of a piece]
  std::vector<Found> found;  // of every entry and piece, strip by strip. [entries of a chunk, PIECES, strips]
  int counts[CHUNK][PIECES];
  Entries<Real> entries;
  Rows<Real> rows;

  explicit Again(const Pixels<Real> &pixels)
      : padded(pixels.padded()), strips(pixels.strips), pairs(2 * CHUNK * padded), found(CHUNK * PIECES * strips),
        rows(pixels.size) {}

  template <bool ROW>
  void blend_again(const Thresholds<Real> &thresholds, const Pixels<Real> &pixels, const Real *transmittances,
                   const uint16_t *reached) {
    std::memset(counts, 0, sizeof counts);
    int next = 0;
    for (int each = 0; each < strips * PIECES; each++) {
      const int strip = each / PIECES, piece = each % PIECES, at = each * PIECE_LANES<Real>;
      const Piece<Real> x = load_piece(&pixels.x[at]), y = load_piece(&pixels.y[at]);
      Piece<Real> T = load_piece(transmittances + at);
      each_marked(reached[each], [&](int k, uint32_t) {
        Piece<Real> alpha, weight;
        take(thresholds, exponent<Real, ROW>(entries, rows, strip, k, x, y), T, alpha, weight);
        found[(k * PIECES + piece) * strips + counts[k][piece]++] = {strip, next};
        store_chunk(&pairs[next], alpha);
        store_chunk(&pairs[next + PIECE_LANES<Real>], weight);
        next += 2 * PIECE_LANES<Real>;
      });
    }
  }

  bool marked(int k) const {
    int sum = 0;
    for (int count : counts[k]) sum += count;
    return sum > 0;
  }

  // calls f(strip, alpha, weight) for the strips in whose piece entry k blends
  template <class F> void each_strip(int k, int piece, F f) const {
    const Found *of_entry = &found[(k * PIECES + piece) * strips];
    for (int i = 0; i < counts[k][piece]; i++) {
      const Real *pair = &pairs[of_entry[i].at];
      f(of_entry[i].strip, load_piece(pair), load_piece(pair + PIECE_LANES<Real>));
    }
  }
};

// A tile's cotangents, the colour from behind, and what a chunk's entries sum up in each lane.
template <class Real> struct Transpose : Again<Real> {
  using Again<Real>::padded;
  const int64_t planes;
  Numbers<Real> v;  // of each channel, of alpha, and B. [strips, PIECES, planes, lanes of a piece]
  Numbers<Real> sums;

  Transpose(const Pixels<Real> &pixels, int64_t channels)
      : Again<Real>(pixels), planes(channels + 2), v(planes * padded), sums((channels + 8) * CHUNK * LANES<Real>) {}

  void begin(const Blend<Real> &blend, const Place<Real> &place) {
    const int64_t D = blend.channels;
    std::fill(v.begin(), v.end(), Real(0));
    constexpr int64_t lanes = PIECE_LANES<Real>;
    const auto copy = [&](int64_t plane, const Real *from, int64_t stride) {
      place.each_row([&](int64_t pixel, int64_t first) {
        const Real *line = from + first * stride;
        for (int64_t x = 0, n = 0; x < place.columns(); x += n) {
          const int64_t each = (pixel + x) / lanes, lane = (pixel + x) % lanes;
          Real *to = &v[(each * planes + plane) * lanes + lane];
          n = std::min(lanes - lane, place.columns() - x);
          if (stride == 1 && n == lanes) {
            store_chunk(to, load_piece(line + x));
          } else {
            for (int64_t i = 0; i < n; i++) to[i] = line[(x + i) * stride];
          }
        }
      });
    };
    for (int64_t d = 0; blend.v_image && d < D; d++)
      copy(d, blend.v_image + d * blend.channel_stride, blend.pixel_stride);
    if (blend.v_alphas) copy(D, blend.v_alphas, 1);
  }

  // of one column of a chunk's rows: the sums in every lane. [entries of a chunk, lanes]
  Real *column(int64_t j) { return &sums[j * CHUNK * LANES<Real>]; }
};

// B3: what the ceiling lets through of G. G carries the clamped alpha; where the gradient passes as if nothing had been
// clamped, the chain rule wants the raw one.
template <class Real, class C>
inline C through_ceiling(const Blend<Real> &blend, Real ceiling, C e, C alpha, C G) {
  const auto clamped = alpha >= ceiling;
  if (!blend.ceiling_passes) return select(clamped, C{}, G);
  return select(clamped, G * (exp2_of<Real>(e) / ceiling), G);
}

// One entry's sums in every lane of a piece: moments of G, gradient to the colours, |G dlog2(alpha)/dx| and |..dy|.
template <class Real, int D, bool ROW>
void entry_sums(const Blend<Real> &blend, const Thresholds<Real> &thresholds, const Pixels<Real> &pixels, int k,
                int piece, Transpose<Real> &state) {
  using V = Piece<Real>;
  constexpr int lanes = PIECE_LANES<Real>;
  const int64_t channels = D ? D : blend.channels, planes = channels + 2;
  const Entries<Real> &entries = state.entries;
  const Real *color = D ? entries.rgb[k] : entries.color[k], *all_x = pixels.x.data() + piece * lanes;
  const Real *all_y = pixels.y.data() + piece * lanes;
  const Real u = entries.u[k], v_center = entries.v[k];
  Real *all_v = state.v.data() + piece * planes * lanes;
  V m{}, mx{}, my{}, mxx{}, mxy{}, myy{}, along_x{}, along_y{}, colors[D ? D : 1]{};
  const int at_k = k * LANES<Real> + piece * lanes;  // among the sums of a column
  // the same on every row
  const V x_of_row = load_piece(all_x), dx_of_row = u - x_of_row;
  state.each_strip(k, piece, [&](int strip, V alpha, V weight) {
    const int at = strip * LANES<Real>;
    Real *v = all_v + strip * PIECES * planes * lanes, *suffix = v + (channels + 1) * lanes;
    const V suffix_dot_grad = load_piece(suffix);
    V q = load_piece(v + channels * lanes) - suffix_dot_grad;
    for (int d = 0; d < D; d++) {
      const V v_color = load_piece(v + d * lanes);
      q += v_color * color[d];
      colors[d] += weight * v_color;
    }
    for (int64_t d = 0; !D && d < channels; d++) {
      const V v_color = load_piece(v + d * lanes);
      Real *sum = state.column(6 + d) + at_k;
      q += v_color * color[d];
      store_chunk(sum, load_piece(sum) + weight * v_color);
    }
    store_chunk(suffix, suffix_dot_grad + alpha * q);
    const V x = ROW ? x_of_row : load_piece(all_x + at), y = load_piece(all_y + at), dx = ROW ? dx_of_row : u - x;
    V G = weight * q;
    if (any(alpha >= thresholds.ceiling))
      G = through_ceiling(blend, thresholds.ceiling, exponent<Real, ROW>(entries, state.rows, strip, k, x, y), alpha, G);
    const V Gx = G * dx;
    m += G;
    mx += Gx;
    mxx += Gx * dx;
    if constexpr (ROW) {
      const Real dy = v_center - all_y[at], dy_dy = dy * dy;
      my += G * dy;
      mxy += Gx * dy;
      myy += G * dy_dy;
    } else {
      const V dy = v_center - y, Gy = G * dy;
      my += Gy;
      mxy += Gx * dy;
      myy += Gy * dy;
    }
    if (blend.absgrad) {
      const auto f = [&](int j) { return entries.f[j][k]; };
      const V by_x = G * (x * (2 * f(3)) + (y * f(4) + f(1))), by_y = G * (y * (2 * f(5)) + (x * f(4) + f(2)));
      along_x += size_of(by_x);
      along_y += size_of(by_y);
    }
  });
  const V *moments[6] = {&m, &mx, &my, &mxx, &mxy, &myy};
  for (int j = 0; j < 6; j++) store_chunk(state.column(j) + at_k, *moments[j]);
  for (int d = 0; d < D; d++) store_chunk(state.column(6 + d) + at_k, colors[d]);
  if (blend.absgrad) {
    store_chunk(state.column(6 + channels) + at_k, along_x);
    store_chunk(state.column(7 + channels) + at_k, along_y);
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
    Real *rows[CHUNK];
    for (int k = 0; k < n; k++) {
      rows[k] = blend.rows + blend.slot(first + k) * blend.columns();
      // they lie anywhere, and are written at the end
      for (int64_t j = 0; j < blend.columns(); j += 64 / sizeof(Real)) __builtin_prefetch(rows[k] + j, 1);
    }
    if (ROW) state.rows.expand(state.entries, pixels);
    state.template blend_again<ROW>(thresholds, pixels, blend.transmittances + at * state.padded,
                                    blend.reached + at * state.strips * PIECES);
    for (int k = n - 1; k >= 0; k--) {
      if (!D || !state.marked(k))
        for (int64_t j = 0; j < blend.columns(); j++)
          std::fill_n(state.column(j) + k * LANES<Real>, LANES<Real>, Real(0));
      for (int piece = 0; state.marked(k) && piece < PIECES; piece++)
        entry_sums<Real, D, ROW>(blend, thresholds, pixels, k, piece, state);
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
