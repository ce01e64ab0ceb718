// A whole render and its transpose on the host, from the functions that the kernels run, in the kernels' order: project,
// sort by depth, list per tile, blend columns of four pixels, go back either way, project back.
#pragma once

#include <algorithm>
#include <array>
#include <numeric>
#include <vector>

#include "compositing.cuh"
#include "splatting.cuh"

namespace pop {
namespace host {

constexpr int N_ARRAYS = 12;

template <class Real>
struct Arguments {
    const Real* in[N_ARRAYS];
    Real* out[N_ARRAYS];
    long long* ids[N_ARRAYS];
    long long n;
    int integers[N_ARRAYS];
    Profile<Real> profile;
};

template <class Real>
Vec3<Real> vec3(const Real* p, long long i) {
    return {p[3 * i], p[3 * i + 1], p[3 * i + 2]};
}

template <class Real>
Vec4<Real> vec4(const Real* p, long long i) {
    return {p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3]};
}

// writes a struct of Reals as row i
template <class Struct, class Real>
void put(Real* p, long long i, const Struct& value) {
    constexpr int n = int(sizeof(Struct) / sizeof(Real));
    const Real* entries = reinterpret_cast<const Real*>(&value);
    for (int k = 0; k < n; ++k) p[n * i + k] = entries[k];
}

template <class Real>
void put_viewmat(Real* p, const ViewmatVjp<Real>& v) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) p[4 * i + j] = v.v_R.m[i][j];
    p[3] = v.v_t.x;
    p[7] = v.v_t.y;
    p[11] = v.v_t.z;
    for (int j = 12; j < 16; ++j) p[j] = Real(0);
}

constexpr int CH = 3, ROWS = 4, BUCKET = 32;
constexpr int N_SUMS = SumsOf<CH, true>::count;

// in: means, quats, scales, opacities, sh, viewmat, K, background, v_image, v_T_final
enum In { MEANS, QUATS, SCALES, OPACITIES, SH, VIEWMAT, K_MATRIX, BACKGROUND, V_IMAGE, V_T_FINAL };
// integers: width, height, then these
enum Integer { N_SH = 2, DEGREE, TILE_W, TILE_H, ANTIALIASED, EXACT_LISTS, PER_SPLAT };

template <class Real>
struct Frame {
    Camera<Real> camera;
    ProjectOptions<Real> options;
    BlendConstants<Real> constants;
    TileGrid grid;
    std::vector<SplatRow<Real>> splats;
    std::vector<PackedSplat<Real>> blended;
    std::vector<Vec3<Real>> colors;
    std::vector<std::vector<int>> lists;
};

template <class Real>
ShRow<Real> sh_row(const Arguments<Real>& a, long long i) {
    const Real* sh = a.in[SH] + 3 * a.integers[N_SH] * i;
    return {sh, sh + 3};
}

template <class Real>
GaussianRow<Real> gaussian(const Arguments<Real>& a, long long i) {
    return {vec3(a.in[MEANS], i), vec4(a.in[QUATS], i), vec3(a.in[SCALES], i), a.in[OPACITIES][i]};
}

template <class Real>
bool seen(const SplatRow<Real>& splat) {
    return splat.radii.x > 0;
}

template <class Real>
void list_splats(Frame<Real>& frame, const Arguments<Real>& a) {
    const TileGrid& grid = frame.grid;
    frame.lists.assign(size_t(grid.tiles_x) * grid.tiles_y, {});
    std::vector<int> order(frame.splats.size());
    std::iota(order.begin(), order.end(), 0);
    // D4: stable, so that equal depths keep index order
    std::stable_sort(order.begin(), order.end(),
                     [&](int i, int j) { return frame.splats[i].depth < frame.splats[j].depth; });
    for (int i : order) {
        const SplatRow<Real>& s = frame.splats[i];
        const TileRect rect = tile_rect(s.mean2d, s.radii, grid, a.profile);
        const Real reach = frame.blended[i].beyond * Real(LN_2) + Real(1e-3);
        const Exponent<Real> exponent = exponent_of(s.conic.xx, s.conic.xy, s.conic.yy);
        for (int y = rect.y0; y < rect.y1; ++y)
            for (int x = rect.x0; x < rect.x1; ++x) {
                if (a.integers[EXACT_LISTS] && least_sigma_in_tile(s.mean2d, exponent, x, y, grid) > reach) continue;
                frame.lists[size_t(y) * grid.tiles_x + x].push_back(i);
            }
    }
}

template <class Real>
Frame<Real> make_frame(const Arguments<Real>& a) {
    Frame<Real> frame;
    const int width = a.integers[0], height = a.integers[1];
    frame.camera = camera_from_matrices(a.in[VIEWMAT], a.in[K_MATRIX], width, height, a.profile.centred);
    frame.options = {a.integers[ANTIALIASED] != 0, Real(0)};
    frame.constants = blend_constants(a.profile);
    frame.grid = grid_of(width, height, a.integers[TILE_W], a.integers[TILE_H]);
    for (long long i = 0; i < a.n; ++i) {
        const SplatRow<Real> s = project_one(gaussian(a, i), frame.camera, a.profile, frame.options);
        const Vec3<Real> dir = view_dir(vec3(a.in[MEANS], i), frame.camera);
        const Vec3<Real> none = {Real(0), Real(0), Real(0)};
        frame.splats.push_back(s);
        frame.blended.push_back(packed_from_splat(s.mean2d, s.conic, s.opacity, a.profile.alpha_floor));
        frame.colors.push_back(seen(s) ? color_from_sh(sh_row(a, i), dir, a.integers[DEGREE]) : none);
    }
    list_splats(frame, a);
    return frame;
}

// visits every column of up to ROWS pixels: f(list, x, y, rows)
template <class Real, class F>
void for_each_column(const Frame<Real>& frame, F f) {
    const TileGrid& g = frame.grid;
    for (int tile = 0; tile < g.tiles_x * g.tiles_y; ++tile) {
        const int left = tile % g.tiles_x * g.tile_w, top = tile / g.tiles_x * g.tile_h;
        const int right = std::min(left + g.tile_w, g.width), bottom = std::min(top + g.tile_h, g.height);
        for (int y = top; y < bottom; y += ROWS)
            for (int x = left; x < right; ++x) f(frame.lists[tile], x, y, std::min(ROWS, bottom - y));
    }
}

template <class Real>
void forward_column(const Frame<Real>& frame, const std::vector<int>& list, int x, int y, int rows,
                    ForwardColumn<Real, CH, ROWS>& column, RenderStats<Real, ROWS>& stats) {
    start_forward<Collect::everything>(column, stats, rows);
    for (size_t k = 0; k < list.size() && is_open(column, frame.constants.stop); ++k)
        blend_forward<Collect::everything>(column, stats, frame.blended[list[k]], &frame.colors[list[k]].x, list[k],
                                        Real(x) + Real(0.5), Real(y) + Real(0.5), int(k), frame.constants);
}

// out: image, T_final, dominant_weights, means2d, depths, conics, opacities
// ids: dominant_ids, n_blended, n_traversed, dominant_counts, radii
template <class Real>
void render(Arguments<Real>& a) {
    const Frame<Real> frame = make_frame(a);
    for_each_column(frame, [&](const std::vector<int>& list, int x, int y, int rows) {
        ForwardColumn<Real, CH, ROWS> column;
        RenderStats<Real, ROWS> stats;
        forward_column(frame, list, x, y, rows, column, stats);
        for (int k = 0; k < rows; ++k) {
            const long long p = (long long)(y + k) * frame.grid.width + x;
            for (int c = 0; c < CH; ++c)
                a.out[0][CH * p + c] = fused(column.T_final[k], a.in[BACKGROUND][c], column.color[k][c]);
            a.out[1][p] = column.T_final[k];
            a.out[2][p] = stats.best[k].weight;
            a.ids[0][p] = stats.best[k].id;
            a.ids[1][p] = stats.n_blended[k];
            a.ids[2][p] = std::min(column.last[k] + 1, int(list.size()));
            if (stats.best[k].id >= 0) ++a.ids[3][stats.best[k].id];
        }
    });
    for (long long i = 0; i < a.n; ++i) {
        const SplatRow<Real>& s = frame.splats[i];
        put(a.out[3], i, s.mean2d);
        a.out[4][i] = s.depth;
        put(a.out[5], i, s.conic);
        a.out[6][i] = s.opacity;
        a.ids[4][2 * i] = s.radii.x;
        a.ids[4][2 * i + 1] = s.radii.y;
    }
}

template <bool PASS, class Real>
void backward_by_columns(const Frame<Real>& frame, const Arguments<Real>& a, std::vector<Real>& sums) {
    for_each_column(frame, [&](const std::vector<int>& list, int x, int y, int rows) {
        ForwardColumn<Real, CH, ROWS> forward;
        RenderStats<Real, ROWS> stats;
        forward_column(frame, list, x, y, rows, forward, stats);
        BackwardColumn<Real, CH, ROWS> column = {};
        for (int k = 0; k < rows; ++k) {
            const long long p = (long long)(y + k) * frame.grid.width + x;
            column.T[k] = forward.T_final[k];
            column.last[k] = forward.last[k];
            column.suffix_dot_grad[k] = a.in[V_T_FINAL][p];
            for (int c = 0; c < CH; ++c) {
                column.v_color[k][c] = a.in[V_IMAGE][CH * p + c];
                column.suffix_dot_grad[k] += a.in[BACKGROUND][c] * column.v_color[k][c];
            }
        }
        for (int k = int(list.size()) - 1; k >= 0; --k) {
            const PackedSplat<Real>& splat = frame.blended[list[k]];
            const Real dx = add(splat.x, -(Real(x) + Real(0.5)));
            ColumnSums<Real, CH> of_column = {};
            blend_backward<true, PASS>(column, splat, &frame.colors[list[k]].x, dx, Real(y) + Real(0.5), k,
                                       frame.constants, of_column);
            Real of_splat[N_SUMS];
            sums_of_column<true>(of_column, dx, of_splat);
            for (int j = 0; j < N_SUMS; ++j) sums[size_t(N_SUMS) * list[k] + j] += of_splat[j];
        }
    });
}

template <bool PASS, class Real>
void backward_by_splats(const Frame<Real>& frame, const Arguments<Real>& a, std::vector<Real>& sums) {
    for_each_column(frame, [&](const std::vector<int>& list, int x, int y, int rows) {
        for (int k = 0; k < rows; ++k) {
            ForwardColumn<Real, CH, 1> column;
            RenderStats<Real, 1> stats;
            const Real px = Real(x) + Real(0.5), py = Real(y + k) + Real(0.5);
            start_forward<Collect::nothing>(column, stats, 1);
            // the forward kernel's checkpoints: T before each bucket, and what the buckets behind it blended
            std::vector<Real> T;
            std::vector<std::array<Real, CH>> later;
            for (size_t j = 0; j < list.size(); ++j) {
                if (j % BUCKET == 0) {
                    T.push_back(column.T[0]);
                    later.push_back({});
                }
                blend_forward<Collect::nothing>(column, stats, frame.blended[list[j]], &frame.colors[list[j]].x, 0, px,
                                             py, int(j), frame.constants);
                if (j % BUCKET == BUCKET - 1 || j + 1 == list.size())
                    for (int c = 0; c < CH; ++c) {
                        later.back()[c] = column.color[0][c];
                        column.color[0][c] = Real(0);
                    }
            }
            std::array<Real, CH> sum = {};
            for (size_t bucket = later.size(); bucket-- > 0;)
                for (int c = 0; c < CH; ++c) {
                    const Real own = later[bucket][c];
                    later[bucket][c] = sum[c];
                    sum[c] += own;
                }
            const long long p = (long long)(y + k) * frame.grid.width + x;
            const Real* v_color = a.in[V_IMAGE] + CH * p;
            Real background_dot_grad = a.in[V_T_FINAL][p];
            for (int c = 0; c < CH; ++c) background_dot_grad += a.in[BACKGROUND][c] * v_color[c];
            Passing<Real> pixel = {column.T_final[0], background_dot_grad};
            for (int j = column.last[0] - 1; j >= 0; --j) {
                const size_t bucket = size_t(j) / BUCKET;
                if (j % BUCKET == BUCKET - 1 && j + 1 < column.last[0])
                    pixel = passing_after<Real, CH>(T[bucket + 1], column.T_final[0], later[bucket].data(), v_color,
                                                    background_dot_grad);
                pass_pixel<true, PASS, Real, CH>(pixel, frame.blended[list[j]], &frame.colors[list[j]].x, v_color, px,
                                                 py, frame.constants, &sums[size_t(N_SUMS) * list[j]]);
            }
        }
    });
}

// out: means, quats, scales, opacities, sh, viewmat, background, means2d, means2d_abs
template <class Real>
void render_vjp(Arguments<Real>& a) {
    const Frame<Real> frame = make_frame(a);
    std::vector<Real> sums(size_t(N_SUMS) * a.n, Real(0));
    if (a.integers[PER_SPLAT])
        a.profile.pass_ceiling ? backward_by_splats<true>(frame, a, sums) : backward_by_splats<false>(frame, a, sums);
    else
        a.profile.pass_ceiling ? backward_by_columns<true>(frame, a, sums) : backward_by_columns<false>(frame, a, sums);
    for_each_column(frame, [&](const std::vector<int>& list, int x, int y, int rows) {
        ForwardColumn<Real, CH, ROWS> column;
        RenderStats<Real, ROWS> stats;
        forward_column(frame, list, x, y, rows, column, stats);
        for (int k = 0; k < rows; ++k)
            for (int c = 0; c < CH; ++c)
                a.out[6][c] += column.T_final[k] * a.in[V_IMAGE][CH * ((long long)(y + k) * frame.grid.width + x) + c];
    });
    ViewmatVjp<Real> v_viewmat = {};
    for (long long i = 0; i < a.n; ++i) {
        const SplatRow<Real>& s = frame.splats[i];
        if (!seen(s)) continue;
        const Real* m = &sums[size_t(N_SUMS) * i];
        const SplatVjp<Real> v = splat_vjp_from_moments<true>(m + CH, s.conic, s.opacity);
        Real basis[MAX_BASIS];
        Vec3<Real> v_sum;
        const Vec3<Real> v_dir = color_from_sh_vjp(sh_row(a, i), view_dir(vec3(a.in[MEANS], i), frame.camera),
                                                   a.integers[DEGREE], Vec3<Real>{m[0], m[1], m[2]}, basis, v_sum);
        const SplatCotangents<Real> of_splat = {v.v_mean2d, Real(0), v.v_conic, v.v_opacity, Real(0)};
        const GaussianVjp<Real> g =
            project_one_vjp(gaussian(a, i), frame.camera, a.profile, frame.options, of_splat, v_dir, v_viewmat);
        put(a.out[0], i, g.v_mean);
        put(a.out[1], i, g.v_quat);
        put(a.out[2], i, g.v_scale);
        a.out[3][i] = g.v_opacity;
        for (int k = 0; k < a.integers[N_SH]; ++k)
            put(a.out[4], a.integers[N_SH] * i + k,
                Vec3<Real>{basis[k] * v_sum.x, basis[k] * v_sum.y, basis[k] * v_sum.z});
        put(a.out[7], i, v.v_mean2d);
        put(a.out[8], i, v.v_mean2d_abs);
    }
    put_viewmat(a.out[5], v_viewmat);
}

}  // namespace host
}  // namespace pop
