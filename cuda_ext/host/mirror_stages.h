// One entry a stage function: the scalar function over rows, and losses over whole images by the window functions of
// ssim.cuh in plain loops. Arguments follow the oracle's order.
#pragma once

#include <vector>

#include "../csrc/compositing.cuh"
#include "../csrc/density.cuh"
#include "mirror.h"
#include "../csrc/optimizer.cuh"
#include "../csrc/polarization.cuh"
#include "../csrc/splatting.cuh"
#include "../csrc/ssim.cuh"

namespace pop {
namespace mirror {

// ---- losses over whole images

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

// ---- stages over rows

// integers[0], integers[1] are always width and height where a stage has them
template <class Real>
Camera<Real> camera_of(const Arguments<Real>& a, const Real* viewmat, const Real* K) {
    return camera_from_matrices(viewmat, K, a.integers[0], a.integers[1], a.profile.centred);
}

constexpr double IDENTITY[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};

template <class Real>
Camera<Real> pinhole(const Arguments<Real>& a, const Real* K) {
    Real viewmat[16];
    for (int k = 0; k < 16; ++k) viewmat[k] = Real(IDENTITY[k]);
    return camera_of(a, viewmat, K);
}

template <class Real>
Camera<Real> pose(const Arguments<Real>& a, const Real* viewmat) {
    Real K[9];
    for (int k = 0; k < 9; ++k) K[k] = Real(k % 4 == 0);
    return camera_of(a, viewmat, K);
}

// a number that the kernels hold in double whatever Real is: given as what Real keeps of it, and the rest
template <class Real>
double in_two(const Arguments<Real>& a, int k) {
    return double(a.numbers[2 * k]) + double(a.numbers[2 * k + 1]);
}

// a row of a vectorised stage
#define POP_ROWS(name, ...)                                               \
    {                                                                     \
        name, [](Arguments<Real>& a) {                                    \
            for (long long i = 0; i < a.n; ++i) { __VA_ARGS__; }          \
        }                                                                 \
    }

template <class Real>
const Entry<Real>* stage_table() {
    using M2 = Mat2<Real>;
    using M23 = Mat23<Real>;
    using M3 = Mat3<Real>;
    static const Entry<Real> table[] = {
        POP_ROWS("scales_from_log_scales", put(a.out[0], i, scale_from_log_scale(vec3(a.in[0], i)))),
        POP_ROWS("scales_from_log_scales_vjp",
                 put(a.out[0], i, scale_from_log_scale_vjp(vec3(a.in[0], i), vec3(a.in[1], i)))),
        POP_ROWS("opacities_from_logits", a.out[0][i] = opacity_from_logit(a.in[0][i])),
        POP_ROWS("opacities_from_logits_vjp", a.out[0][i] = opacity_from_logit_vjp(a.in[0][i], a.in[1][i])),
        POP_ROWS("unit_quats_from_quats", put(a.out[0], i, unit_quat_from_quat(vec4(a.in[0], i)))),
        POP_ROWS("unit_quats_from_quats_vjp",
                 put(a.out[0], i, unit_quat_from_quat_vjp(vec4(a.in[0], i), vec4(a.in[1], i)))),
        POP_ROWS("rotmats_from_quats", put(a.out[0], i, rotmat_from_quat(vec4(a.in[0], i)))),
        POP_ROWS("rotmats_from_quats_vjp",
                 put(a.out[0], i, rotmat_from_quat_vjp(vec4(a.in[0], i), matrix<M3>(a.in[1], i)))),
        POP_ROWS("covars_from_quats_scales",
                 put(a.out[0], i, covar_from_quat_scale(vec4(a.in[0], i), vec3(a.in[1], i)))),
        POP_ROWS("covars_from_quats_scales_vjp", Vec4<Real> v_q; Vec3<Real> v_s;
                 covar_from_quat_scale_vjp(vec4(a.in[0], i), vec3(a.in[1], i), matrix<M3>(a.in[2], i), v_q, v_s);
                 put(a.out[0], i, v_q); put(a.out[1], i, v_s)),
        POP_ROWS("sh_basis", Real basis[MAX_BASIS]; basis_one(vec3(a.in[0], i), a.integers[2], basis);
                 for (int k = 0; k < MAX_BASIS; ++k) a.out[0][MAX_BASIS * i + k] = basis[k]),
        POP_ROWS("sh_basis_vjp",
                 put(a.out[0], i, basis_one_vjp(vec3(a.in[0], i), a.integers[2], a.in[1] + MAX_BASIS * i))),
        POP_ROWS("colors_from_sh", const Real* sh = a.in[0] + 3 * a.integers[3] * i;
                 put(a.out[0], i, color_from_sh(ShRow<Real>{sh, sh + 3}, vec3(a.in[1], i), a.integers[2]))),
        POP_ROWS("colors_from_sh_vjp", const Real* sh = a.in[0] + 3 * a.integers[3] * i; Real basis[MAX_BASIS];
                 Vec3<Real> v_sum; put(a.out[1], i, color_from_sh_vjp(ShRow<Real>{sh, sh + 3}, vec3(a.in[1], i),
                                                                      a.integers[2], vec3(a.in[2], i), basis, v_sum));
                 for (int k = 0; k < a.integers[3]; ++k)
                     put(a.out[0], a.integers[3] * i + k,
                         Vec3<Real>{basis[k] * v_sum.x, basis[k] * v_sum.y, basis[k] * v_sum.z})),
        POP_ROWS("camera_center", put(a.out[0], i, camera_center(pose(a, a.in[0])))),
        POP_ROWS("camera_center_vjp", put_viewmat(a.out[0], camera_center_vjp(pose(a, a.in[0]), vec3(a.in[1], i)))),
        POP_ROWS("view_dirs", put(a.out[0], i, view_dir(vec3(a.in[0], i), pose(a, a.in[1])))),
        POP_ROWS("means_cam_from_means", put(a.out[0], i, mean_cam_from_mean(vec3(a.in[0], i), pose(a, a.in[1])))),
        POP_ROWS("means_cam_from_means_vjp", ViewmatVjp<Real> v = zero_viewmat<Real>();
                 put(a.out[0], i, mean_cam_from_mean_vjp(vec3(a.in[0], i), pose(a, a.in[1]), vec3(a.in[2], i), v));
                 put_viewmat(a.out[1] + 16 * i, v)),
        POP_ROWS("covars_cam_from_covars",
                 put(a.out[0], i, covar_cam_from_covar(matrix<M3>(a.in[0], i), pose(a, a.in[1])))),
        POP_ROWS("covars_cam_from_covars_vjp", ViewmatVjp<Real> v = zero_viewmat<Real>();
                 put(a.out[0], i, covar_cam_from_covar_vjp(matrix<M3>(a.in[0], i), pose(a, a.in[1]),
                                                           matrix<M3>(a.in[2], i), v));
                 put_viewmat(a.out[1] + 16 * i, v)),
        POP_ROWS("in_front", a.ids[0][i] = in_front(a.in[0][i], a.profile)),
        POP_ROWS("project_means", put(a.out[0], i, project_mean(vec3(a.in[0], i), pinhole(a, a.in[1])))),
        POP_ROWS("project_means_vjp",
                 put(a.out[0], i, project_mean_vjp(vec3(a.in[0], i), pinhole(a, a.in[1]), vec2(a.in[2], i)))),
        POP_ROWS("projection_jacobians",
                 put(a.out[0], i, projection_jacobian(vec3(a.in[0], i), pinhole(a, a.in[1]), a.profile))),
        POP_ROWS("projection_jacobians_vjp",
                 put(a.out[0], i, projection_jacobian_vjp(vec3(a.in[0], i), pinhole(a, a.in[1]),
                                                          matrix<M23>(a.in[2], i), a.profile))),
        POP_ROWS("project_covars", put(a.out[0], i, project_covar(matrix<M3>(a.in[0], i), matrix<M23>(a.in[1], i)))),
        POP_ROWS("project_covars_vjp", M3 v_S; M23 v_J;
                 project_covar_vjp(matrix<M3>(a.in[0], i), matrix<M23>(a.in[1], i), matrix<M2>(a.in[2], i), v_S, v_J);
                 put(a.out[0], i, v_S); put(a.out[1], i, v_J)),
        POP_ROWS("low_pass", put(a.out[0], i, low_pass(matrix<M2>(a.in[0], i), a.numbers[0]))),
        POP_ROWS("compensations", a.out[0][i] = compensation(matrix<M2>(a.in[0], i), a.numbers[0])),
        POP_ROWS("compensations_vjp",
                 put(a.out[0], i, compensation_vjp(matrix<M2>(a.in[0], i), a.numbers[0], a.in[1][i]))),
        POP_ROWS("conics_from_covars2d", put(a.out[0], i, conic_from_covar2d(matrix<M2>(a.in[0], i)))),
        POP_ROWS("conics_from_covars2d_vjp",
                 put(a.out[0], i, conic_from_covar2d_vjp(matrix<M2>(a.in[0], i), conic(a.in[1], i)))),
        POP_ROWS("radii_from_covars2d",
                 const Radii r = radii_from_covar2d(matrix<M2>(a.in[0], i), a.in[1][i], a.profile);
                 a.ids[0][2 * i] = r.x; a.ids[0][2 * i + 1] = r.y),
        POP_ROWS("on_screen", const Radii r = {int(a.ids[1][2 * i]), int(a.ids[1][2 * i + 1])};
                 a.ids[0][i] = on_screen(vec2(a.in[0], i), r, a.integers[0], a.integers[1], a.profile)),
        POP_ROWS("tile_rects", const Radii r = {int(a.ids[1][2 * i]), int(a.ids[1][2 * i + 1])};
                 const TileGrid grid = grid_of(a.integers[0], a.integers[1], a.integers[2], a.integers[2]);
                 const TileRect rect = tile_rect(vec2(a.in[0], i), r, grid, a.profile);
                 a.ids[0][4 * i] = rect.x0; a.ids[0][4 * i + 1] = rect.y0; a.ids[0][4 * i + 2] = rect.x1;
                 a.ids[0][4 * i + 3] = rect.y1),
        POP_ROWS("sigma_at_pixel", a.out[0][i] = sigma_at_pixel(vec2(a.in[0], i), conic(a.in[1], i),
                                                                a.numbers[0], a.numbers[1])),
        POP_ROWS("sigma_at_pixel_vjp", Vec2<Real> v_mean; Conic<Real> v_conic;
                 sigma_at_pixel_vjp(vec2(a.in[0], i), conic(a.in[1], i), a.numbers[0], a.numbers[1],
                                    a.numbers[2], v_mean, v_conic);
                 put(a.out[0], i, v_mean); put(a.out[1], i, v_conic)),
        POP_ROWS("falloff", a.out[0][i] = falloff(a.in[0][i])),
        POP_ROWS("falloff_vjp", a.out[0][i] = falloff_vjp(a.in[0][i], a.in[1][i])),
        POP_ROWS("alpha_from_sigma", const Alpha<Real> alpha = alpha_from_sigma(a.in[0][i], a.in[1][i], a.profile);
                 a.out[0][i] = alpha.alpha; a.ids[0][i] = alpha.skipped),
        POP_ROWS("alpha_from_sigma_vjp",
                 put(a.out[0], i, alpha_from_sigma_vjp(a.in[0][i], a.in[1][i], a.in[2][i], a.profile))),
        POP_ROWS("alpha_as_blended", const Vec2<Real> mean2d = vec2(a.in[0], i);
                 const PackedSplat<Real> s = packed_from_splat(mean2d, conic(a.in[1], i), a.in[2][i],
                                                            a.profile.alpha_floor);
                 const Real dx = s.x - a.numbers[0]; const Real dy = s.y - a.numbers[1];
                 const Real exponent = exponent_in_column(mul(mul(s.hA, dx), dx), mul(s.B, dx), s.hC, dy);
                 const Real alpha = min_of(a.profile.alpha_ceiling, mul(s.opacity, power_of_two(-exponent)));
                 a.out[0][i] = alpha;
                 a.ids[0][i] = !within(exponent, s.beyond)),
        POP_ROWS("dominant_id", Dominant<Real> best = no_dominant<Real>();
                 for (int k = 0; k < a.integers[2]; ++k) compete(best, int(a.ids[1][k]), a.in[0][k]);
                 a.ids[0][i] = best.id),
        POP_ROWS("pop_loss_vjp",
                 a.out[0][i] = pop_loss_vjp_one(a.ids[0][i] != 0 ? PopSide::important : PopSide::other, a.integers[2],
                                                a.integers[3] - a.integers[2], a.numbers[0])),
        POP_ROWS("adam_step", const AdamStep<Real> step = adam_step_at<Real>(a.integers[2], in_two(a, 0), in_two(a, 1),
                                                                             in_two(a, 2), in_two(a, 3));
                 a.out[0][i] = a.in[0][i]; a.out[1][i] = a.in[1][i]; a.out[2][i] = a.in[2][i];
                 adam_one(a.out[0][i], a.out[1][i], a.out[2][i], a.in[3][i], step)),
        POP_ROWS("split_rows", put(a.out[0], i, split_one(vec3(a.in[0], i), vec4(a.in[1], i), vec3(a.in[2], i),
                                                          vec3(a.in[3], i), a.numbers[0]))),
        POP_ROWS("densification_gradient",
                 a.out[0][i] = densification_gradient(vec2(a.in[0], i), a.integers[0], a.integers[1])),
        POP_ROWS("least_sigma_in_tile", const Vec3<Real> c = vec3(a.in[1], i);
                 const TileGrid grid = grid_of(a.integers[0], a.integers[1], a.integers[2], a.integers[3]);
                 a.out[0][i] = least_sigma_in_tile(vec2(a.in[0], i), exponent_of(c.x, c.y, c.z), a.integers[4],
                                                   a.integers[5], grid)),
        {"ssim", ssim_and_vjp<Real>},
        {nullptr, nullptr},
    };
    return table;
}

#undef POP_ROWS

}  // namespace mirror
}  // namespace pop
