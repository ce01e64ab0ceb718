// A photograph as the native step compares with it: planes of floats, and their moments under SSIM's windows. Meaning:
// `pop_fast.stages.losses.target_moments`.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "cuda_ext/csrc/ssim.cuh"
#include "threads.h"

namespace pop {

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

}  // namespace pop
