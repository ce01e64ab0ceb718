// Gaussians to splats, one thread a Gaussian: activations, projection, culls, harmonics; and the packing for blending.

#include "cuda_check.h"
#include "kernel_tools.cuh"

namespace pop {

namespace {

__device__ __forceinline__ GaussianRow<float> load_gaussian(const GaussianArrays& g, int i) {
    const float *m = g.means + 3 * i, *q = g.quats + 4 * i, *s = g.scales + 3 * i;
    GaussianRow<float> row = {{m[0], m[1], m[2]}, {q[0], q[1], q[2], q[3]}, {s[0], s[1], s[2]}, g.opacities[i]};
    if (g.raw) {
        row.scale = scale_from_log_scale(row.scale);
        row.opacity = opacity_from_logit(row.opacity);
    }
    return row;
}

__device__ __forceinline__ bool all_finite(const GaussianRow<float>& g) {
    return isfinite(g.mean.x) && isfinite(g.mean.y) && isfinite(g.mean.z) && isfinite(g.quat.w) &&
           isfinite(g.quat.x) && isfinite(g.quat.y) && isfinite(g.quat.z) && isfinite(g.scale.x) &&
           isfinite(g.scale.y) && isfinite(g.scale.z) && isfinite(g.opacity);
}

__device__ __forceinline__ ShRow<float> load_sh(const GaussianArrays& g, int i) {
    return {g.sh_first + size_t(g.sh_first_stride) * i, g.sh_rest + size_t(g.sh_rest_stride) * i};
}

__global__ void __launch_bounds__(PROJECT_BLOCK) project_kernel(GaussianArrays gaussians, ViewArrays view,
                                                                ProjectSettings settings, SplatArrays splats,
                                                                DeviceState* state) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= gaussians.n) return;
    const Camera<float> camera =
        camera_from_matrices(view.viewmat, view.K, view.width, view.height, settings.profile.centred);
    const GaussianRow<float> g = load_gaussian(gaussians, i);
    const SplatRow<float> s = project_one(g, camera, settings.profile, settings.options);
    bool finite = all_finite(g) && isfinite(s.depth) && isfinite(s.mean2d.x) && isfinite(s.mean2d.y) &&
                  isfinite(s.conic.xx) && isfinite(s.conic.xy) && isfinite(s.conic.yy);
    reinterpret_cast<float2*>(splats.means2d)[i] = {s.mean2d.x, s.mean2d.y};
    splats.depths[i] = s.depth;
    splats.conics[3 * i] = s.conic.xx;
    splats.conics[3 * i + 1] = s.conic.xy;
    splats.conics[3 * i + 2] = s.conic.yy;
    splats.opacities[i] = s.opacity;
    reinterpret_cast<int2*>(splats.radii)[i] = {s.radii.x, s.radii.y};
    if (gaussians.sh_first != nullptr) {
        Vec3<float> color = {0.0f, 0.0f, 0.0f};
        if (s.radii.x > 0) color = color_from_sh(load_sh(gaussians, i), view_dir(g.mean, camera), settings.sh_degree);
        finite = finite && isfinite(color.x) && isfinite(color.y) && isfinite(color.z);
        splats.colors[3 * i] = color.x;
        splats.colors[3 * i + 1] = color.y;
        splats.colors[3 * i + 2] = color.z;
    }
    // found here, before the sort: most culls are comparisons that a NaN fails, so that it would vanish without a word
    if (!finite) atomicMin(&state->bad_row, i);
}

__global__ void pack_kernel(int n, int channels, SplatArrays splats, float alpha_floor, float* records) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    const float* q = splats.conics + 3 * i;
    const Blended<float> s = blended_from_splat(Vec2<float>{splats.means2d[2 * i], splats.means2d[2 * i + 1]},
                                                Conic<float>{q[0], q[1], q[2]}, splats.opacities[i], alpha_floor);
    float color[MAX_CHANNELS] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (int c = 0; c < channels; ++c) color[c] = splats.colors[size_t(channels) * i + c];
    float4* row = reinterpret_cast<float4*>(records + size_t(RECORD) * i);
    row[0] = {s.x, s.y, s.hA, s.B};
    row[1] = {s.hC, s.opacity, s.beyond, color[0]};
    row[2] = {color[1], color[2], color[3], 0.0f};
}

__device__ __forceinline__ void store3(float* p, int i, Vec3<float> v) {
    p[3 * i] = v.x;
    p[3 * i + 1] = v.y;
    p[3 * i + 2] = v.z;
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

__global__ void __launch_bounds__(PROJECT_BLOCK)
    project_backward_kernel(GaussianArrays gaussians, ViewArrays view, ProjectSettings settings, const int* radii,
                            SplatGradients of, const float* v_depths, GaussianGradients gradients) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    const bool row_exists = i < gaussians.n;
    const bool seen = row_exists && radii[2 * i] > 0;
    ViewmatVjp<float> v_viewmat = {};
    GaussianVjp<float> v = {};
    Vec3<float> v_sum = {0.0f, 0.0f, 0.0f}, v_dir = {0.0f, 0.0f, 0.0f};
    float basis[MAX_BASIS] = {};
    if (seen) {
        const Camera<float> camera =
            camera_from_matrices(view.viewmat, view.K, view.width, view.height, settings.profile.centred);
        const GaussianRow<float> g = load_gaussian(gaussians, i);
        if (gradients.v_sh != nullptr) {
            const float* c = of.v_colors + 3 * i;
            v_dir = color_from_sh_vjp(load_sh(gaussians, i), view_dir(g.mean, camera), settings.sh_degree,
                                      Vec3<float>{c[0], c[1], c[2]}, basis, v_sum);
        }
        const float *u = of.v_means2d + 2 * i, *q = of.v_conics + 3 * i;
        const SplatCotangents<float> of_splat = {
            {u[0], u[1]}, v_depths == nullptr ? 0.0f : v_depths[i], {q[0], q[1], q[2]}, of.v_opacities[i], 0.0f};
        v = project_one_vjp(g, camera, settings.profile, settings.options, of_splat, v_dir, v_viewmat);
    }
    if (row_exists) {
        store3(gradients.v_means, i, v.v_mean);
        reinterpret_cast<float4*>(gradients.v_quats)[i] = {v.v_quat.w, v.v_quat.x, v.v_quat.y, v.v_quat.z};
        store3(gradients.v_scales, i, v.v_scale);
        gradients.v_opacities[i] = v.v_opacity;
        const int n_rows = gradients.sh_stride / 3;
        if (gradients.v_sh != nullptr)
            for (int k = 0; k < n_rows; ++k) {
                const float weight = k < MAX_BASIS ? basis[k] : 0.0f;
                store3(gradients.v_sh + size_t(gradients.sh_stride) * i, k,
                       {weight * v_sum.x, weight * v_sum.y, weight * v_sum.z});
            }
    }
    if (gradients.v_viewmat != nullptr) sum_viewmat(v_viewmat, gradients.v_viewmat);
}

}  // namespace

void project(const GaussianArrays& gaussians, const ViewArrays& view, const ProjectSettings& settings,
             const SplatArrays& splats, DeviceState* state, cudaStream_t stream) {
    if (gaussians.n == 0) return;
    project_kernel<<<blocks_for(gaussians.n, PROJECT_BLOCK), PROJECT_BLOCK, 0, stream>>>(gaussians, view, settings,
                                                                                        splats, state);
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
    project_backward_kernel<<<blocks_for(gaussians.n, PROJECT_BLOCK), PROJECT_BLOCK, 0, stream>>>(
        gaussians, view, settings, splats.radii, of, v_depths, gradients);
    POP_LAUNCHED("project_backward_kernel");
}

}  // namespace pop
