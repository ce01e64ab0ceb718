// 1 - SSIM of every window and its gradient by the render. Meaning: `pop_ref.ssim`; the formulas, which are written in
// the difference of render and photograph, are those of `pop_fast/stages/losses.py`. First stands a photograph as the
// native step compares with it. Meaning: `pop_fast.stages.losses.target_moments`.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "cuda_ext/csrc/ssim.cuh"
#include "lanes.h"
#include "threads.h"

namespace pop {

// ---- a photograph: planes of floats, and their moments under SSIM's windows

// Everything of one call; eight bytes each, in the order of `library.py`.
template <class Real> struct Moments {
  const uint8_t *photograph;            // [H, W, 3]
  int64_t height, width, border, threads;  // border: pixels of black around the image
  Real *target;                         // [3, H, W]
  Real *mu_y, *s_yy;                    // sum of w y, and of w y^2 less its square. [3, h, w]

  static constexpr int64_t REACH = SSIM_WINDOW - 1;
  int64_t rows() const { return height + 2 * border - REACH; }     // of windows
  int64_t columns() const { return width + 2 * border - REACH; }
};

// What one thread works with: a row of windows, weighed and added up down its columns.
struct Lines {
  std::vector<double> sums, squares;
  explicit Lines(int64_t length) : sums(size_t(length)), squares(size_t(length)) {}
};

// One row of windows in double: this is where squares that nearly cancel are subtracted, and it is done once a view.
template <class Real>
void moments_row(const Moments<Real> &given, int channel, int64_t row, Lines &down) {
  const int64_t columns = given.columns();
  for (auto *line : {&down.sums, &down.squares}) std::fill(line->begin(), line->end(), 0.0);
  for (int i = 0; i < SSIM_WINDOW; i++) {
    const int64_t from = row + i - given.border;
    if (from < 0 || from >= given.height) continue;
    const double weight = ssim_weight<double>(i - SSIM_REACH);
    const Real *const y = given.target + (channel * given.height + from) * given.width;
    double *const sum = down.sums.data() + given.border, *const squares = down.squares.data() + given.border;
    for (int64_t x = 0; x < given.width; x++) {
      const double value = double(y[x]), weighed = weight * value;
      sum[x] += weighed;
      squares[x] += weighed * value;
    }
  }
  const int64_t at = (channel * given.rows() + row) * columns;
  for (int64_t x = 0; x < columns; x++) {
    double mean = 0.0, square = 0.0;
    for (int i = 0; i < SSIM_WINDOW; i++) {
      const double weight = ssim_weight<double>(i - SSIM_REACH);
      mean += weight * down.sums[size_t(x + i)];
      square += weight * down.squares[size_t(x + i)];
    }
    given.mu_y[at + x] = Real(mean);
    given.s_yy[at + x] = Real(square - mean * mean);
  }
}

template <class Real> void moments(const Moments<Real> &given, Fork fork) {
  const int64_t n_pixels = given.height * given.width, padded = given.width + 2 * given.border;
  share(fork, given.threads, given.height, 16, [&](int64_t first, int64_t last) {
    for (int channel = 0; channel < 3; channel++)
      for (int64_t at = first * given.width; at < last * given.width; at++)
        given.target[channel * n_pixels + at] = Real(given.photograph[3 * at + channel]) / Real(255);
  });
  const auto lines = [&] { return Lines(padded); };
  share(fork, given.threads, 3 * given.rows(), 16, lines, [&](Lines &own, int64_t first, int64_t last) {
    for (int64_t k = first; k < last; k++) moments_row(given, int(k / given.rows()), k % given.rows(), own);
  });
}

// ---- a render beside it

// Everything of one call; eight bytes each, in the order of `library.py`. An image [H, W, D] is the matrix [H, W D].
template <class Real> struct Ssim {
  const Real *difference, *target;  // render minus photograph, 0 where it is masked; photograph. [H, W D]
  const Real *mu_y, *s_yy;          // the photograph's moments under every window. [h, w D]
  const Real *kept;                 // 1 for windows that count, 0 for others; null: all count. [h, w D]
  int64_t height, width, channels;
  int64_t border, stride, threads;  // pixels of black around the image; from one padded line to the next
  double weight;                    // factor on the gradient
  double *totals;                   // sums of 1 - S, for every WINDOW_ROWS rows of windows
  Real *partials;  // derivatives by the moments, with a margin of zeros; null: no gradient. [3, H + 10, stride]
  Real *gradient;  // [H, W D]

  static constexpr int64_t REACH = SSIM_WINDOW - 1;
  int64_t line() const { return width * channels; }
  int64_t margin() const { return REACH - border; }
  int64_t rows() const { return height + 2 * border - REACH; }                // of windows
  int64_t columns() const { return line() + (2 * border - REACH) * channels; }  // of windows
  Real *partial(int map, int64_t row) const { return partials + (map * (height + REACH) + row) * stride; }
};

// Numbers from a line of windows' borders to the next, so that whole vectors can be read at every shift of the window.
template <class Real> int64_t padded_line(int64_t length) {
  return (length + LANES<Real> - 1) / LANES<Real> * LANES<Real> + LANES<Real>;
}

constexpr int64_t WINDOW_ROWS = 16;  // at a time: few enough for what a thread works with to stay in its cache

// The first n numbers, zeros behind them.
template <class Real> inline Vec<Real> load_some(const Real *from, int64_t n) {
  if (n >= LANES<Real>) return load(from);
  Vec<Real> v = {};
  std::memcpy(&v, from, size_t(n) * sizeof(Real));
  return v;
}

template <class Real> inline void store_some(Real *to, Vec<Real> v, int64_t n) {
  if (n >= LANES<Real>) return store(to, v);
  std::memcpy(to, &v, size_t(n) * sizeof(Real));
}

template <class C> inline Chunk<double, 2 * sizeof(C)> as_double(C chunk) {
  if constexpr (2 * sizeof(C) <= WHOLE) {
    return __builtin_convertvector(chunk, Chunk<double, 2 * sizeof(C)>);
  } else {
    const auto halves = halves_of<float>(chunk);
    return {as_double(halves.low), as_double(halves.high)};
  }
}

// Added up in double precision.
inline Vec<double> widened(Vec<double> v) { return v; }
inline Vec<double> widened(Vec<float> v) {
  const auto halves = halves_of<float>(v);
  return as_double(halves.low) + as_double(halves.high);
}

// Three maps under every window of one row: blurred down into lines, then across; f(first column, blurred).
template <class Real> struct Blur {
  Numbers<Real> lines[3];
  explicit Blur(int64_t stride) {
    for (auto &line : lines) line.assign(size_t(stride), Real(0));
  }

  template <class F>
  void operator()(const Real *const maps[3], int64_t stride, int64_t channels, int64_t columns, F f) {
    for (int map = 0; map < 3; map++)
      for (int64_t k = 0; k < stride; k += LANES<Real>) {
        Vec<Real> v = {};
        for (int i = 0; i < SSIM_WINDOW; i++) v += tap(i) * load(maps[map] + i * stride + k);
        store(lines[map].data() + k, v);
      }
    for (int64_t k = 0; k < columns; k += LANES<Real>) {
      Vec<Real> v[3] = {};
      for (int i = 0; i < SSIM_WINDOW; i++)
        for (int map = 0; map < 3; map++) v[map] += tap(i) * load(lines[map].data() + k + i * channels);
      f(k, v[0], v[1], v[2]);
    }
  }

  static Real tap(int i) { return ssim_weight<Real>(i - SSIM_REACH); }
};

// What a thread works with: d, d^2 and d y on the rows that some rows of windows read.
template <class Real> struct Products {
  Numbers<Real> maps;
  int64_t rows, stride;
  Blur<Real> blur;
  explicit Products(int64_t stride)
      : maps(size_t(3 * (WINDOW_ROWS + SSIM_WINDOW - 1) * stride), Real(0)), rows(WINDOW_ROWS + SSIM_WINDOW - 1),
        stride(stride), blur(stride) {}
  Real *at(int map, int64_t row) { return maps.data() + (map * rows + row) * stride; }

  // image rows from `top`; those beyond the image are black
  void fill(const Ssim<Real> &given, int64_t top, int64_t n) {
    const int64_t width = given.line(), side = given.border * given.channels;
    for (int64_t r = 0; r < n; r++) {
      Real *d = at(0, r) + side, *dd = at(1, r) + side, *dy = at(2, r) + side;
      if (top + r < 0 || top + r >= given.height) {
        for (Real *line : {d, dd, dy}) std::fill(line, line + width + side, Real(0));
        continue;
      }
      const Real *from = given.difference + (top + r) * width, *y = given.target + (top + r) * width;
      for (int64_t k = 0; k < width; k++) {
        d[k] = from[k];
        dd[k] = from[k] * from[k];
        dy[k] = from[k] * y[k];
      }
      // a wider image may have been where the border is now
      for (Real *line : {d, dd, dy}) std::fill(line + width, line + width + side, Real(0));
    }
  }
};

template <class Real> struct Compared {
  Vec<Real> dissimilarity, v_mu, v_half_dd, v_dy;
};

template <class Real>
inline Compared<Real> compare(Vec<Real> mu, Vec<Real> dd, Vec<Real> dy, Vec<Real> mu_y, Vec<Real> s_yy, Real weight) {
  const Real one = Real(1), two = Real(2);
  const Vec<Real> mu_sq = mu * mu, mu_x = mu + mu_y;
  const Vec<Real> s_dd = dd - mu_sq, s_dy = dy - mu * mu_y;
  const Vec<Real> B1 = two * (mu_x * mu_y) + mu_sq + Real(SSIM_C1);
  const Vec<Real> B2 = two * (s_dy + s_yy) + s_dd + Real(SSIM_C2);
  const Vec<Real> a = mu_sq / B1, b = s_dd / B2, kept_a = one - a, kept_b = one - b;
  const Vec<Real> slope = (two * weight) * (kept_a / B2);
  const Vec<Real> by_mu = fms(kept_a, mu, a * mu_y) * kept_b / B1;
  const Vec<Real> v_mu = fms(all(two * weight), by_mu, slope * (mu - b * mu_x));
  return {a + kept_a * b, v_mu, slope * kept_b, -(slope * b)};
}

// Compare one part of the windows: their total, and the derivatives where a gradient is asked for.
template <class Real>
double compare_rows(const Ssim<Real> &given, Products<Real> &own, int64_t first, int64_t last) {
  const int64_t columns = given.columns(), margin = given.margin(), side = margin * given.channels;
  own.fill(given, first - given.border, last - first + given.REACH);
  Vec<double> total = {};
  for (int64_t r = first; r < last; r++) {
    const Real *const maps[3] = {own.at(0, r - first), own.at(1, r - first), own.at(2, r - first)};
    Real *out[3];
    for (int map = 0; map < 3 && given.partials; map++) {
      Real *row = given.partial(map, margin + r);
      std::fill(row, row + side, Real(0));
      std::fill(row + side + columns, row + given.stride, Real(0));
      out[map] = row + side;
    }
    own.blur(maps, own.stride, given.channels, columns, [&](int64_t k, Vec<Real> mu, Vec<Real> dd, Vec<Real> dy) {
      const int64_t at = r * columns + k, n = columns - k;
      const Vec<Real> mu_y = load_some(given.mu_y + at, n), s_yy = load_some(given.s_yy + at, n);
      Compared<Real> found = compare(mu, dd, dy, mu_y, s_yy, Real(given.weight));
      if (given.kept) {
        const Vec<Real> kept = load_some(given.kept + at, n);
        found = {found.dissimilarity * kept, found.v_mu * kept, found.v_half_dd * kept, found.v_dy * kept};
      }
      Vec<Real> counted = {};
      store_some(reinterpret_cast<Real *>(&counted), found.dissimilarity, n);
      total += widened(counted);
      if (!given.partials) return;
      store_some(out[0] + k, found.v_mu, n);
      store_some(out[1] + k, found.v_half_dd, n);
      store_some(out[2] + k, found.v_dy, n);
    });
  }
  return sum<double>(total);
}

// Each pixel gathers from all windows over it; the window is symmetric, so that this is the same blur.
template <class Real> void gather_rows(const Ssim<Real> &given, Blur<Real> &blur, int64_t first, int64_t last) {
  const int64_t width = given.line();
  for (int64_t r = first; r < last; r++) {
    const Real *const maps[3] = {given.partial(0, r), given.partial(1, r), given.partial(2, r)};
    const auto pixels = [&](int64_t k, Vec<Real> by_mu, Vec<Real> by_half_dd, Vec<Real> by_dy) {
      const int64_t at = r * width + k, n = width - k;
      const Vec<Real> d = load_some(given.difference + at, n), y = load_some(given.target + at, n);
      store_some(given.gradient + at, by_mu + d * by_half_dd + y * by_dy, n);
    };
    blur(maps, given.stride, given.channels, width, pixels);
  }
}

template <class Real> void dissimilarity(const Ssim<Real> &given, Fork fork) {
  const int64_t margin = given.margin(), rows = given.rows();
  const auto products = [&] { return Products<Real>(given.stride); };
  share(fork, given.threads, rows, WINDOW_ROWS, products, [&](Products<Real> &own, int64_t first, int64_t last) {
    given.totals[first / WINDOW_ROWS] = compare_rows(given, own, first, last);
  });
  if (!given.partials) return;
  for (int map = 0; map < 3; map++) {
    std::fill(given.partial(map, 0), given.partial(map, margin), Real(0));
    std::fill(given.partial(map, margin + rows), given.partial(map + 1, 0), Real(0));
  }
  const auto blur = [&] { return Blur<Real>(given.stride); };
  share(fork, given.threads, given.height, WINDOW_ROWS, blur,
        [&](Blur<Real> &own, int64_t first, int64_t last) { gather_rows(given, own, first, last); });
}

}  // namespace pop
