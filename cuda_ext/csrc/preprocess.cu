// Gaussians to splats, one thread a Gaussian: activations, projection, culls, harmonics; and the packing for blending.
//
// What bounds projection is memory: 44 bytes of every Gaussian and 192 of harmonics of those that are seen, 36 bytes
// written of each and a record of 48 of those seen, about 0.02 ms for 270,000 Gaussians. A warp makes three trips: the
// camera's matrices with the geometry, then the rows of harmonics that are wanted, in two parts of six pieces of 16
// bytes a lane.

#include "gaussian_rows.cuh"

namespace pop {

namespace {

__device__ __forceinline__ GaussianRow<float> load_activated(const GaussianArrays& g, int i) {
    const GaussianRow<float> row = load_gaussian(g.means, g.quats, g.scales, g.opacities, i);
    return g.raw ? activated(row) : row;
}

__device__ __forceinline__ bool all_finite(const GaussianRow<float>& g) {
    return isfinite(g.mean.x) && isfinite(g.mean.y) && isfinite(g.mean.z) && isfinite(g.quat.w) &&
           isfinite(g.quat.x) && isfinite(g.quat.y) && isfinite(g.quat.z) && isfinite(g.scale.x) &&
           isfinite(g.scale.y) && isfinite(g.scale.z) && isfinite(g.opacity);
}

__device__ __forceinline__ void store_record(float* records, int i, const PackedSplat<float>& s,
                                             const float color[MAX_CHANNELS]) {
    float4* row = reinterpret_cast<float4*>(records + size_t(RECORD) * i);
    row[0] = {s.x, s.y, s.hA, s.B};
    row[1] = {s.hC, s.opacity, s.beyond, color[0]};
    row[2] = {color[1], color[2], color[3], 0.0f};
}

// WHOLE: the first band lies in one row with the others
template <int DEGREE, bool WHOLE>
__device__ __forceinline__ Vec3<float> color_of(const GaussianArrays& gaussians, const Camera<float>& camera,
                                                Vec3<float> mean, int i, float* row) {
    const Vec3<float> first = WHOLE ? load3(row, 0) : load3(gaussians.sh_first, i);
    return color_from_sh(StagedSh{first, WHOLE ? row + 3 : row}, view_dir(mean, camera), DEGREE);
}

template <int DEGREE, bool WHOLE>
__global__ void __launch_bounds__(PROJECT_BLOCK, 8)
    project_kernel(GaussianArrays gaussians, ViewArrays view, ProjectSettings settings, SplatArrays splats,
                   RowStride stride, DeviceState* state) {
    constexpr int FLOATS = DEGREE == GIVEN_COLORS ? 0 : ACTIVE<DEGREE, WHOLE>;
    __shared__ WarpRows<FLOATS> of_warps[PROJECT_BLOCK / WARP];
    const int lane = threadIdx.x & (WARP - 1), i = blockIdx.x * PROJECT_BLOCK + threadIdx.x;
    const int first = i - lane, rows = min(WARP, gaussians.n - first);
    WarpRows<FLOATS>& staged = of_warps[threadIdx.x / WARP];
    if (rows <= 0) return;
    const Camera<float> camera = camera_of(view, settings);
    GaussianRow<float> g = {};
    SplatRow<float> s = {};
    bool finite = true;
    if (lane < rows) {
        g = load_activated(gaussians, i);
        s = project_one(g, camera, settings.profile, settings.options);
        finite = all_finite(g) && isfinite(s.depth) && isfinite(s.mean2d.x) && isfinite(s.mean2d.y) &&
                 isfinite(s.conic.xx) && isfinite(s.conic.xy) && isfinite(s.conic.yy);
        reinterpret_cast<float2*>(splats.means2d)[i] = {s.mean2d.x, s.mean2d.y};
        splats.depths[i] = s.depth;
        store3(splats.conics, i, {s.conic.xx, s.conic.xy, s.conic.yy});
        splats.opacities[i] = s.opacity;
        reinterpret_cast<int2*>(splats.radii)[i] = {s.radii.x, s.radii.y};
    }
    if constexpr (DEGREE != GIVEN_COLORS) {
        const bool seen = s.radii.x > 0;
        if constexpr (FLOATS > 0) {
            const float* source = (WHOLE ? gaussians.sh_first : gaussians.sh_rest) + size_t(first) * stride.floats;
            read_rows<6>(source, stride, rows, __ballot_sync(FULL_WARP, seen), staged);
            __syncwarp();
        }
        Vec3<float> color = {0.0f, 0.0f, 0.0f};
        if (seen) color = color_of<DEGREE, WHOLE>(gaussians, camera, g.mean, i, staged.row(lane));
        finite = finite && isfinite(color.x) && isfinite(color.y) && isfinite(color.z);
        if (splats.colors != nullptr && lane < rows) store3(splats.colors, i, color);
        if (splats.records != nullptr && seen) {
            const float channels[MAX_CHANNELS] = {color.x, color.y, color.z, 0.0f};
            store_record(splats.records, i,
                         packed_from_splat(s.mean2d, s.conic, s.opacity, settings.profile.alpha_floor), channels);
        }
    }
    // found here, before the sort: most culls are comparisons that a NaN fails, so that it would vanish without a word
    if (!finite) atomicMin(&state->bad_row, i);
}

__global__ void pack_kernel(int n, int channels, SplatArrays splats, float alpha_floor, float* records) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    const float* q = splats.conics + 3 * i;
    const PackedSplat<float> s = packed_from_splat(Vec2<float>{splats.means2d[2 * i], splats.means2d[2 * i + 1]},
                                                Conic<float>{q[0], q[1], q[2]}, splats.opacities[i], alpha_floor);
    float color[MAX_CHANNELS] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (int c = 0; c < channels; ++c) color[c] = splats.colors[size_t(channels) * i + c];
    store_record(records, i, s, color);
}

__global__ void splat_gradients_kernel(int n, int channels, SplatArrays splats, const float* sums,
                                       SplatGradients gradients) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    const float* row = sums + size_t(RECORD) * i;
    const float* q = splats.conics + 3 * i;
    const Conic<float> conic = {q[0], q[1], q[2]};
    const bool absolute = gradients.v_means2d_abs != nullptr;
    const SplatVjp<float> v = absolute ? splat_vjp_from_moments<true>(row + channels, conic, splats.opacities[i])
                                       : splat_vjp_from_moments<false>(row + channels, conic, splats.opacities[i]);
    for (int c = 0; c < channels; ++c) gradients.v_colors[size_t(channels) * i + c] = row[c];
    reinterpret_cast<float2*>(gradients.v_means2d)[i] = {v.v_mean2d.x, v.v_mean2d.y};
    if (absolute) reinterpret_cast<float2*>(gradients.v_means2d_abs)[i] = {v.v_mean2d_abs.x, v.v_mean2d_abs.y};
    store3(gradients.v_conics, i, {v.v_conic.xx, v.v_conic.xy, v.v_conic.yy});
    gradients.v_opacities[i] = v.v_opacity;
}

// v_viewmat needs a sum over all Gaussians: one partial sum a block, in a fixed order
__device__ __forceinline__ void sum_viewmat(const ViewmatVjp<float>& v, float* partials) {
    __shared__ float rows[PROJECT_BLOCK];
    const float values[12] = {v.v_R.m[0][0], v.v_R.m[0][1], v.v_R.m[0][2], v.v_R.m[1][0], v.v_R.m[1][1], v.v_R.m[1][2],
                              v.v_R.m[2][0], v.v_R.m[2][1], v.v_R.m[2][2], v.v_t.x,       v.v_t.y,       v.v_t.z};
#pragma unroll
    for (int k = 0; k < 12; ++k) {
        rows[threadIdx.x] = values[k];
        __syncthreads();
        for (int half = PROJECT_BLOCK / 2; half > 0; half /= 2) {
            if (threadIdx.x < half) rows[threadIdx.x] += rows[threadIdx.x + half];
            __syncthreads();
        }
        if (threadIdx.x == 0) partials[12 * blockIdx.x + k] = rows[0];
        __syncthreads();
    }
}

template <int DEGREE>
__global__ void __launch_bounds__(PROJECT_BLOCK)
    project_backward_kernel(GaussianArrays gaussians, ViewArrays view, ProjectSettings settings, const int* radii,
                            SplatGradients of, const float* v_depths, RowStride stride, GaussianGradients gradients) {
    constexpr int FLOATS = DEGREE == GIVEN_COLORS ? 0 : ACTIVE<DEGREE, true>;
    __shared__ WarpRows<FLOATS> of_warps[PROJECT_BLOCK / WARP];
    const int lane = threadIdx.x & (WARP - 1), i = blockIdx.x * PROJECT_BLOCK + threadIdx.x;
    const int first = i - lane, rows = min(WARP, gaussians.n - first);
    const bool row_exists = lane < rows, seen = row_exists && radii[2 * size_t(i)] > 0;
    WarpRows<FLOATS>& staged = of_warps[threadIdx.x / WARP];
    float* row = staged.row(lane);
    if constexpr (FLOATS > 0) {
        const unsigned mask = __ballot_sync(FULL_WARP, seen);
        if (mask) read_rows<6>(gaussians.sh_first + size_t(first) * stride.floats, stride, rows, mask, staged);
        __syncwarp();
    }
    ViewmatVjp<float> v_viewmat = {};
    GaussianVjp<float> v = {};
    if (seen) {
        const Vec3<float> v_conic = load3(of.v_conics, i);
        const SplatCotangents<float> of_splat = {{of.v_means2d[2 * size_t(i)], of.v_means2d[2 * size_t(i) + 1]},
                                                 v_depths == nullptr ? 0.0f : v_depths[i],
                                                 {v_conic.x, v_conic.y, v_conic.z},
                                                 of.v_opacities[i],
                                                 0.0f};
        Vec3<float> v_color = {0.0f, 0.0f, 0.0f}, band = {0.0f, 0.0f, 0.0f};
        if (DEGREE != GIVEN_COLORS) {
            v_color = load3(of.v_colors, i);
            band = load3(row, 0);
        }
        v = gaussian_vjp<DEGREE>(load_activated(gaussians, i), camera_of(view, settings), settings, of_splat, v_color,
                                 band, row + 3, v_viewmat);
        if (DEGREE != GIVEN_COLORS) store3(row, 0, band);
    } else if (row_exists) {
#pragma unroll
        for (int k = 0; k < FLOATS; ++k) row[k] = 0.0f;
    }
    if (row_exists) {
        store3(gradients.v_means, i, v.v_mean);
        reinterpret_cast<float4*>(gradients.v_quats)[i] = {v.v_quat.w, v.v_quat.x, v.v_quat.y, v.v_quat.z};
        store3(gradients.v_scales, i, v.v_scale);
        gradients.v_opacities[i] = v.v_opacity;
    }
    if constexpr (FLOATS > 0) {
        __syncwarp();
        write_rows(staged, gradients.v_sh + size_t(first) * stride.floats, stride, rows);
    }
    if (gradients.v_viewmat != nullptr) sum_viewmat(v_viewmat, gradients.v_viewmat);
}

// the coefficients' layout as constants: launch(degree or GIVEN_COLORS, whether a row holds the first band, too)
template <class Launch>
void with_harmonics(const GaussianArrays& gaussians, int degree, Launch launch) {
    if (gaussians.sh_first == nullptr) return launch(std::integral_constant<int, GIVEN_COLORS>(), std::true_type());
    const bool whole = gaussians.sh_rest == nullptr;
    const int floats = whole ? gaussians.sh_first_stride : 3 + gaussians.sh_rest_stride;
    with_degree(degree, floats, [&](auto constant) {
        if (whole)
            launch(constant, std::true_type());
        else
            launch(constant, std::false_type());
    });
}

}  // namespace

void project(const GaussianArrays& gaussians, const ViewArrays& view, const ProjectSettings& settings,
             const SplatArrays& splats, DeviceState* state, cudaStream_t stream) {
    if (gaussians.n == 0) return;
    const int blocks = blocks_for(gaussians.n, PROJECT_BLOCK);
    with_harmonics(gaussians, settings.sh_degree, [&](auto degree, auto whole) {
        constexpr int DEGREE = decltype(degree)::value;
        constexpr bool WHOLE = decltype(whole)::value;
        const RowStride stride = row_stride(WHOLE ? gaussians.sh_first_stride : gaussians.sh_rest_stride);
        project_kernel<DEGREE, WHOLE>
            <<<blocks, PROJECT_BLOCK, 0, stream>>>(gaussians, view, settings, splats, stride, state);
    });
    POP_LAUNCHED("project_kernel");
}

void pack_records(int n, int channels, const SplatArrays& splats, float alpha_floor, float* records,
                  cudaStream_t stream) {
    if (n == 0) return;
    pack_kernel<<<blocks_for(n, 256), 256, 0, stream>>>(n, channels, splats, alpha_floor, records);
    POP_LAUNCHED("pack_kernel");
}

void splat_gradients(int n, int channels, const SplatArrays& splats, const float* sums,
                     const SplatGradients& gradients, cudaStream_t stream) {
    if (n == 0) return;
    splat_gradients_kernel<<<blocks_for(n, 256), 256, 0, stream>>>(n, channels, splats, sums, gradients);
    POP_LAUNCHED("splat_gradients_kernel");
}

void project_backward(const GaussianArrays& gaussians, const ViewArrays& view, const ProjectSettings& settings,
                      const SplatArrays& splats, const SplatGradients& of, const float* v_depths,
                      const GaussianGradients& gradients, cudaStream_t stream) {
    if (gaussians.n == 0) return;
    const int blocks = blocks_for(gaussians.n, PROJECT_BLOCK);
    with_harmonics(gaussians, settings.sh_degree, [&](auto degree, auto whole) {
        constexpr int DEGREE = decltype(degree)::value;
        if (!decltype(whole)::value) throw std::invalid_argument("project_backward takes whole rows of harmonics");
        const RowStride stride = row_stride(gaussians.sh_first_stride);
        project_backward_kernel<DEGREE><<<blocks, PROJECT_BLOCK, 0, stream>>>(gaussians, view, settings, splats.radii,
                                                                              of, v_depths, stride, gradients);
    });
    POP_LAUNCHED("project_backward_kernel");
}

}  // namespace pop
