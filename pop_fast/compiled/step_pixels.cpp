// The picture, its difference from the photograph, D-SSIM with its gradient, and the way back to the lists' entries.

#include <algorithm>
#include <cmath>

#include "step.h"

namespace pop {

// ---- blend: the picture, and its difference from the photograph

Work Stepper::blend_tiles() {
  const auto colored = blend.dominance() ? blend_tile<float, 3, true, true> : blend_tile<float, 3, true, false>;
  const auto deep = blend.dominance() ? blend_tile<float, 4, true, true> : blend_tile<float, 4, true, false>;
  const auto one_tile = given->samples ? deep : colored;
  return {blend.tiles(), 2, [=](int thread, int64_t first, int64_t last) {
            for (int64_t tile = first; tile < last; tile++) {
              one_tile(blend, pixels, tile, workers[size_t(thread)]->canvas);
              if (given->exposure) expose(tile);
              differ(tile);
            }
          }};
}

// Lay a tile of the picture over the background and map its colours, y = A c + b; what they were is kept.
void Stepper::expose(int64_t tile) {
  const StepGiven &g = *given;
  const int64_t stride = blend.channel_stride;
  const Place<float> place(blend, tile);
  place.each_row([&](int64_t, int64_t at) {
    for (int64_t x = at; x < at + place.columns(); x++) {
      float color[3];
      for (int c = 0; c < 3; c++) {
        color[c] = blend.image[c * stride + x];
        if (blend.alphas) color[c] += (1.0f - blend.alphas[x]) * float(g.background[c]);
        unexposed.get(3 * stride)[c * stride + x] = color[c];
      }
      for (int c = 0; c < 3; c++) {
        const float *const row = g.exposure + 4 * c;
        blend.image[c * stride + x] = row[0] * color[0] + row[1] * color[1] + row[2] * color[2] + row[3];
      }
    }
  });
}

// Turn a tile of the picture into its difference from the photograph, 0 where the mask leaves a pixel out, and sum up
// |d|, d^2, and d^2 of the picture clamped to [0, 1].
void Stepper::differ(int64_t tile) {
  const StepGiven &g = *given;
  const float *const alphas = blend.alphas;
  const Place<float> place(blend, tile);
  float absolute[STEP_TILE] = {}, squared[STEP_TILE] = {}, clamped_squared[STEP_TILE] = {};
  for (int channel = 0; channel < 3; channel++) {
    const float behind = g.exposure ? 0.0f : float(g.background[channel]);
    float *const plane = blend.image + channel * blend.channel_stride;
    const float *const photograph = g.target + channel * blend.channel_stride;
    place.each_row([&](int64_t, int64_t at) {
      for (int64_t x = 0; x < place.columns(); x++) {
        const float keep = !g.kept || g.kept[at + x] ? 1.0f : 0.0f, y = photograph[at + x];
        const float color = plane[at + x] + (alphas ? (1.0f - alphas[at + x]) * behind : 0.0f);
        const float d = keep * (color - y), clamped_d = keep * (clamped(color, 0.0f, 1.0f) - y);
        plane[at + x] = d;
        absolute[x] += std::fabs(d);
        squared[x] += d * d;
        clamped_squared[x] += clamped_d * clamped_d;
      }
    });
  }
  double *const sums = &tile_sums[3 * tile];
  sums[0] = sums[1] = sums[2] = 0.0;
  for (int x = 0; x < STEP_TILE; x++) {
    sums[0] += absolute[x];
    sums[1] += squared[x];
    sums[2] += clamped_squared[x];
  }
}

// ---- loss and image_gradient: D-SSIM with its gradient, and that of L1 or L2

Ssim<float> Stepper::ssim_of(int channel) {
  const StepGiven &g = *given;
  Ssim<float> of = {};
  of.height = g.height;
  of.width = g.width;
  of.channels = 1;
  of.border = g.border;
  of.stride = worker_stride;
  const int64_t n_pixels = g.width * g.height, n_maps = of.rows() * of.columns();
  of.difference = blend.image + channel * n_pixels;
  of.target = g.target + channel * n_pixels;
  of.mu_y = g.mu_y + channel * n_maps;
  of.s_yy = g.s_yy + channel * n_maps;
  of.kept = g.kept_windows;
  of.weight = g.n_windows > 0 ? g.ssim_weight / double(3 * g.n_windows) : 0.0;
  const int64_t n_partials = 3 * (g.height + Ssim<float>::REACH) * of.stride;
  of.partials = partials.get(3 * n_partials) + channel * n_partials;
  of.gradient = v_image.get(3 * n_pixels) + channel * n_pixels;
  return of;
}

Work Stepper::loss() {
  const int64_t rows = ssim[0].rows(), margin = ssim[0].margin();
  for (const auto &of : ssim)
    for (int map = 0; map < 3; map++) {
      std::fill(of.partial(map, 0), of.partial(map, margin), 0.0f);
      std::fill(of.partial(map, margin + rows), of.partial(map + 1, 0), 0.0f);
    }
  window_sums.assign(size_t(3 * parts_of(rows, WINDOW_ROWS)), 0.0);
  return {rows, WINDOW_ROWS, [this](int thread, int64_t first, int64_t last) {
            for (int channel = 0; channel < 3; channel++)
              window_sums[size_t(3 * (first / WINDOW_ROWS) + channel)] =
                  compare_rows(ssim[channel], workers[size_t(thread)]->products, first, last);
          }};
}

Work Stepper::image_gradient() {
  exposure_sums.assign(size_t(EXPOSURE * parts_of(given->height, WINDOW_ROWS)), 0.0);
  return {given->height, WINDOW_ROWS,
          [this](int thread, int64_t first, int64_t last) { image_gradient_rows(*workers[size_t(thread)], first, last); }};
}

void Stepper::image_gradient_rows(Worker &own, int64_t first, int64_t last) {
  const StepGiven &g = *given;
  const int64_t n_pixels = g.width * g.height, begin = first * g.width, end = last * g.width;
  const float unit = float(g.pixel_weight / double(3 * std::max<int64_t>(g.n_kept, 1))), twice = 2.0f * unit;
  float *const v_alpha = blend.v_alphas ? v_alphas.get(n_pixels) : nullptr;
  if (v_alpha) std::fill(v_alpha + begin, v_alpha + end, 0.0f);
  float *const v_depth = g.samples ? v_image.get(4 * n_pixels) + 3 * n_pixels : nullptr;
  if (v_depth) std::fill(v_depth + begin, v_depth + end, 0.0f);
  for (int channel = 0; channel < 3; channel++) {
    const Ssim<float> &of = ssim[channel];
    pop::gather_rows(of, own.blur, first, last);
    const float *const d = of.difference;
    for (int64_t at = begin; at < end; at++) {
      const float slope = g.l1 ? (d[at] > 0.0f ? unit : d[at] < 0.0f ? -unit : 0.0f) : twice * d[at];
      of.gradient[at] = !g.kept || g.kept[at] ? of.gradient[at] + slope : 0.0f;
    }
  }
  if (g.exposure) unexpose_gradient(begin, end, &exposure_sums[size_t(EXPOSURE * (first / WINDOW_ROWS))]);
  for (int channel = 0; v_alpha && channel < 3; channel++) {
    const float behind = float(g.background[channel]), *const v = ssim[channel].gradient;
    for (int64_t at = begin; at < end; at++) v_alpha[at] -= behind * v[at];
  }
}

// Pull the gradient of some pixels' exposed colours back: v_A += v c^T, v_b += v, and v gives way to A^T v.
void Stepper::unexpose_gradient(int64_t begin, int64_t end, double *sums) {
  const float *const e = given->exposure, *const was = unexposed.get(0);
  const int64_t n_pixels = blend.channel_stride;
  for (int64_t at = begin; at < end; at++) {
    float v[3];
    for (int c = 0; c < 3; c++) v[c] = ssim[c].gradient[at];
    for (int c = 0; c < 3; c++) {
      for (int k = 0; k < 3; k++) sums[4 * c + k] += double(v[c] * was[k * n_pixels + at]);
      sums[4 * c + 3] += double(v[c]);
      ssim[c].gradient[at] = e[c] * v[0] + e[4 + c] * v[1] + e[8 + c] * v[2];
    }
  }
}

// Hold the expected depth against the disparities of the sparse points, and give their pixels its gradient.
void Stepper::compare_depth() {
  const StepGiven &g = *given;
  const int64_t n_pixels = g.width * g.height;
  const float *const accumulated = blend.image + 3 * n_pixels, *const covered = blend.alphas;
  float *const v_depth = v_image.get(4 * n_pixels) + 3 * n_pixels, *const v_alpha = v_alphas.get(n_pixels);
  const double smallest = 1e-10, each = g.depth_weight / double(std::max<int64_t>(g.n_samples, 1));
  for (int64_t j = 0; j < g.n_samples; j++) {
    const float *const sample = g.samples + 3 * j;
    const double u = std::clamp(double(sample[0]) - 0.5, 0.0, double(g.width - 1));
    const double v = std::clamp(double(sample[1]) - 0.5, 0.0, double(g.height - 1));
    const int64_t left = int64_t(u), top = int64_t(v);
    const int64_t right = std::min(left + 1, g.width - 1), bottom = std::min(top + 1, g.height - 1);
    const double a = u - double(left), b = v - double(top);
    const int64_t around[4] = {top * g.width + left, top * g.width + right, bottom * g.width + left, bottom * g.width + right};
    const double weights[4] = {(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b};
    double sampled = 0.0;
    for (int k = 0; k < 4; k++)
      sampled += weights[k] * double(accumulated[around[k]]) / std::max(double(covered[around[k]]), smallest);
    // where nothing is rendered the disparity is 0, and a constant
    const double disparity = sampled > 0.0 ? 1.0 / sampled : 0.0, apart = disparity - double(sample[2]);
    depth_sum += std::fabs(apart);
    const double slope = (apart > 0.0 ? -each : apart < 0.0 ? each : 0.0) * disparity * disparity;
    for (int k = 0; k < 4; k++) {
      const int64_t at = around[k];
      const double opacity = covered[at], divisor = std::max(opacity, smallest), pulled = slope * weights[k] / divisor;
      v_depth[at] += float(pulled);
      if (opacity >= smallest) v_alpha[at] -= float(pulled * double(accumulated[at]) / divisor);
    }
  }
}

// ---- transpose: back to the entries

Work Stepper::transpose_tiles() {
  depth_sum = 0.0;
  if (given->samples) compare_depth();
  const auto one_tile = given->samples ? transpose_tile<float, 4, true> : transpose_tile<float, 3, true>;
  const int64_t columns = blend.columns();
  return {blend.tiles(), 2, [=](int thread, int64_t first, int64_t last) {
            for (int64_t tile = first; tile < last; tile++) {
              one_tile(blend, pixels, tile, workers[size_t(thread)]->transpose);
              // what lies behind the last pixel's stop passes nothing back
              for (int64_t entry = offsets[size_t(tile)] + n_reached[size_t(tile)]; entry < offsets[size_t(tile) + 1]; entry++)
                std::fill_n(blend.rows + columns * blend.slots[entry], columns, 0.0f);
            }
          }};
}

}  // namespace pop
