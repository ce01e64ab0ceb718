// Losses over whole images on the host: the window functions of ssim.cuh in plain loops.
#pragma once

#include <vector>

#include "mirror.h"
#include "../csrc/ssim.cuh"

namespace pop {
namespace mirror {

template <class Real>
struct Picture {
    const Real* values;
    int height, width, channels;
    // beyond the border is black
    Real at(int y, int x, int c) const {
        const bool inside = y >= 0 && y < height && x >= 0 && x < width;
        return inside ? values[(y * width + x) * channels + c] : Real(0);
    }
};

// rows first, then columns, as the kernels add
template <class Real>
WindowMoments<Real> moments_at(const Picture<Real>& x, const Picture<Real>& y, int row, int col, int c) {
    WindowMoments<Real> w = {};
    for (int i = -SSIM_REACH; i <= SSIM_REACH; ++i) {
        WindowMoments<Real> across = {};
        for (int j = -SSIM_REACH; j <= SSIM_REACH; ++j) {
            const Real weight = ssim_weight<Real>(j);
            const Real a = x.at(row + i, col + j, c), b = y.at(row + i, col + j, c);
            across.mu_x += weight * a;
            across.mu_y += weight * b;
            across.xx += weight * a * a;
            across.yy += weight * b * b;
            across.xy += weight * a * b;
        }
        const Real weight = ssim_weight<Real>(i);
        w.mu_x += weight * across.mu_x;
        w.mu_y += weight * across.mu_y;
        w.xx += weight * across.xx;
        w.yy += weight * across.yy;
        w.xy += weight * across.xy;
    }
    return w;
}

// in: image, target; integers: width, height, channels, margin (5 for "valid", 0 for "same"); out: the mean, and its
// cotangent of every pixel for v = numbers[0]
template <class Real>
void ssim_and_vjp(Arguments<Real>& a) {
    const int width = a.integers[0], height = a.integers[1], channels = a.integers[2], margin = a.integers[3];
    const Picture<Real> x = {a.in[0], height, width, channels}, y = {a.in[1], height, width, channels};
    const double n = double(width - 2 * margin) * (height - 2 * margin) * channels;
    const Real share = a.numbers[0] / Real(n);
    double total = 0.0;
    std::vector<WindowSsim<Real>> windows(size_t(width) * height * channels, WindowSsim<Real>{});
    for (int row = margin; row < height - margin; ++row)
        for (int col = margin; col < width - margin; ++col)
            for (int c = 0; c < channels; ++c) {
                WindowSsim<Real>& w = windows[(size_t(row) * width + col) * channels + c];
                w = compare_window(moments_at(x, y, row, col, c));
                total += double(w.S);
            }
    a.out[0][0] = Real(total / n);
    for (int row = 0; row < height; ++row)
        for (int col = 0; col < width; ++col)
            for (int c = 0; c < channels; ++c) {
                Real v_mu = Real(0), v_xx = Real(0), v_xy = Real(0);
                for (int i = -SSIM_REACH; i <= SSIM_REACH; ++i)
                    for (int j = -SSIM_REACH; j <= SSIM_REACH; ++j) {
                        if (row + i < 0 || row + i >= height || col + j < 0 || col + j >= width) continue;
                        const WindowSsim<Real>& w = windows[(size_t(row + i) * width + col + j) * channels + c];
                        const Real weight = ssim_weight<Real>(i) * ssim_weight<Real>(j);
                        v_mu += weight * w.v_mu;
                        v_xx += weight * w.v_xx;
                        v_xy += weight * w.v_xy;
                    }
                const Real v = pixel_from_windows(x.at(row, col, c), y.at(row, col, c), v_mu, v_xx, v_xy);
                a.out[1][(row * width + col) * channels + c] = share * v;
            }
}

template <class Real>
const Entry<Real>* loss_table() {
    static const Entry<Real> table[] = {{"ssim", ssim_and_vjp<Real>}, {nullptr, nullptr}};
    return table;
}

}  // namespace mirror
}  // namespace pop
