// Pull the cotangent of a tile back to its entries. Meaning: `pop_ref.compositing.composite_vjp`.
//
// Alphas and weights are made anew from the light before every chunk, front to back; then the chunk is gone through
// back to front with one number a pixel, B, the light from behind dotted with the pixel's cotangent:
//     q = colour . v - B;  B += alpha q;  G = weight q = alpha dL/dalpha
// Six moments of G about the splat's centre give every geometric gradient of the splat, and can be added up over tiles.
#pragma once

#include "tile.h"

namespace pop {

// A tile's cotangents, the light from behind, and a chunk's alphas and weights.
template <class Real> struct Transpose {
  const int padded, strips;
  std::vector<Real> v, behind, alphas, weights;
  const uint64_t *marks = nullptr;  // of the forward pass: in which strips the chunk's entries may blend

  Transpose(const Pixels<Real> &pixels, int64_t channels)
      : padded(pixels.padded()), strips(pixels.strips), v((channels + 1) * padded), behind(padded),
        alphas(CHUNK * padded), weights(CHUNK * padded) {}

  void begin(const Blend<Real> &blend, const Place<Real> &place) {
    const int64_t D = blend.channels;
    std::fill(v.begin(), v.end(), Real(0));
    std::fill(behind.begin(), behind.end(), Real(0));
    place.each_pixel([&](int64_t pixel, int64_t from) {
      for (int64_t d = 0; blend.v_image && d < D; d++) v[d * padded + pixel] = blend.v_image[from * D + d];
      if (blend.v_alphas) v[D * padded + pixel] = blend.v_alphas[from];
    });
  }

  void blend_again(const Thresholds<Real> &thresholds, const Pixels<Real> &pixels, const Entries<Real> &entries,
                   const Real *lights, const uint64_t *of_forward) {
    marks = of_forward;
    Real *to_alphas = alphas.data(), *to_weights = weights.data();
    for (int strip = 0; strip < strips; strip++) {
      const int at = strip * LANES<Real>;
      const Vec<Real> x = load(&pixels.x[at]), y = load(&pixels.y[at]);
      Vec<Real> T = load(lights + at);
      for (int k = 0; k < entries.count; k++) {
        if (!(of_forward[k] >> (strip % 64) & 1)) continue;
        Vec<Real> alpha{}, weight{};
        take(thresholds, entries.f[k], x, y, T, alpha, weight);
        store(to_alphas + k * padded + at, alpha);
        store(to_weights + k * padded + at, weight);
      }
    }
  }
};

// B3: what the ceiling lets through of G. G carries the clamped alpha; where the gradient passes as if nothing had been
// clamped, the chain rule wants the raw one.
template <class Real>
inline Vec<Real> through_ceiling(const Blend<Real> &blend, Real ceiling, const Real *f, Vec<Real> x, Vec<Real> y,
                                 Vec<Real> alpha, Vec<Real> G) {
  const Mask<Real> clamped = alpha >= ceiling;
  if (!any(clamped)) return G;
  if (!blend.ceiling_passes) return clamped ? all(Real(0)) : G;
  return clamped ? G * (exp2_of(exponent(f, x, y)) / ceiling) : G;
}

// One entry's row: moments of G, gradient to the colours, sums of |G dlog(alpha)/dx| and |..dy|. D as in blend_strip.
template <class Real, int D>
void entry_row(const Blend<Real> &blend, const Thresholds<Real> &thresholds, const Pixels<Real> &pixels,
               const Entries<Real> &entries, int k, Transpose<Real> &state, Real *row) {
  const int64_t channels = D ? D : blend.channels;
  const int padded = state.padded, strips = state.strips;
  const uint64_t marks = state.marks[k];
  if (!D || !marks) std::fill(row, row + blend.columns(), Real(0));
  if (!marks) return;
  const Real *f = entries.f[k], *color = entries.color[k], *all_x = pixels.x.data(), *all_y = pixels.y.data();
  const Real *alphas = &state.alphas[k * padded], *weights = &state.weights[k * padded], *all_v = state.v.data();
  Real *all_behind = state.behind.data();
  Vec<Real> m{}, mx{}, my{}, mxx{}, mxy{}, myy{}, along_x{}, along_y{}, colors[D ? D : 1]{};
  for (int strip = 0; strip < strips; strip++) {
    if (!(marks >> (strip % 64) & 1)) continue;
    const int at = strip * LANES<Real>;
    const Vec<Real> alpha = load(alphas + at), weight = load(weights + at), behind = load(all_behind + at);
    Vec<Real> q = load(all_v + channels * padded + at) - behind;
    for (int d = 0; d < D; d++) {
      const Vec<Real> v = load(all_v + d * padded + at);
      q += v * color[d];
      colors[d] += weight * v;
    }
    for (int64_t d = 0; !D && d < channels; d++) {
      const Vec<Real> v = load(all_v + d * padded + at);
      q += v * color[d];
      row[6 + d] += sum<Real>(weight * v);
    }
    store(all_behind + at, behind + alpha * q);
    const Vec<Real> x = load(all_x + at), y = load(all_y + at);
    const Vec<Real> G = through_ceiling(blend, thresholds.ceiling, f, x, y, alpha, weight * q);
    const Vec<Real> dx = entries.u[k] - x, dy = entries.v[k] - y;
    m += G;
    mx += G * dx;
    my += G * dy;
    mxx += G * dx * dx;
    mxy += G * dx * dy;
    myy += G * dy * dy;
    if (blend.absgrad) {
      const Vec<Real> by_x = G * (x * (2 * f[3]) + (y * f[4] + f[1])), by_y = G * (y * (2 * f[5]) + (x * f[4] + f[2]));
      along_x += by_x < Real(0) ? -by_x : by_x;
      along_y += by_y < Real(0) ? -by_y : by_y;
    }
  }
  const Vec<Real> *moments[6] = {&m, &mx, &my, &mxx, &mxy, &myy};
  for (int j = 0; j < 6; j++) row[j] = sum<Real>(*moments[j]);
  for (int d = 0; d < D; d++) row[6 + d] = sum<Real>(colors[d]);
  if (blend.absgrad) {
    const Real ln2 = Real(0.6931471805599453);  // the coefficients are those of log2(alpha)
    row[6 + channels] = ln2 * sum<Real>(along_x);
    row[7 + channels] = ln2 * sum<Real>(along_y);
  }
}

template <class Real, int D>
void transpose_tile(const Blend<Real> &blend, const Pixels<Real> &pixels, int64_t tile, Transpose<Real> &state) {
  const Place<Real> place(blend, tile);
  const Thresholds<Real> thresholds(blend);
  const int64_t reached = blend.n_reached[tile], n_chunks = (reached + CHUNK - 1) / CHUNK;
  state.begin(blend, place);
  Entries<Real> entries;
  for (int64_t chunk = n_chunks - 1; chunk >= 0; chunk--) {
    const int64_t first = place.begin + chunk * CHUNK;
    entries.gather(blend, place, first, std::min<int64_t>(CHUNK, place.begin + reached - first));
    state.blend_again(thresholds, pixels, entries, blend.lights + (blend.first_chunks[tile] + chunk) * state.padded,
                      blend.strips + first);
    for (int k = entries.count - 1; k >= 0; k--)
      entry_row<Real, D>(blend, thresholds, pixels, entries, k, state, blend.rows + (first + k) * blend.columns());
  }
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
