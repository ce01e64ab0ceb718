// What the kernels of one thread a Gaussian share: its row, the colour and its transpose, and everything that a splat
// passes back. `project_backward_kernel` writes what comes of it, `update_kernel` takes Adam's step with it.
#pragma once

#include <stdexcept>
#include <string>
#include <type_traits>

#include "warp_rows.cuh"

namespace pop {

// in place of a degree where there are no harmonics
constexpr int GIVEN_COLORS = -1;

// A Gaussian's coefficients: the first band in registers, the others in a row of shared memory.
struct StagedSh {
    Vec3<float> first;
    const volatile float* rest;

    __device__ __forceinline__ Vec3<float> at(int k) const {
        return k == 0 ? first : Vec3<float>{rest[3 * (k - 1)], rest[3 * (k - 1) + 1], rest[3 * (k - 1) + 2]};
    }
};

__device__ __forceinline__ Vec3<float> load3(const float* p, int i) {
    p += size_t(3) * i;
    return {p[0], p[1], p[2]};
}

__device__ __forceinline__ void store3(float* p, int i, Vec3<float> v) {
    p += size_t(3) * i;
    p[0] = v.x;
    p[1] = v.y;
    p[2] = v.z;
}

// as it is kept: logarithms and logits where raw
__device__ __forceinline__ GaussianRow<float> load_gaussian(const float* means, const float* quats, const float* scales,
                                                            const float* opacities, int i) {
    const float* q = quats + size_t(4) * i;
    return {load3(means, i), {q[0], q[1], q[2], q[3]}, load3(scales, i), opacities[i]};
}

__device__ __forceinline__ GaussianRow<float> activated(const GaussianRow<float>& raw) {
    return {raw.mean, raw.quat, scale_from_log_scale(raw.scale), opacity_from_logit(raw.opacity)};
}

__device__ __forceinline__ Camera<float> camera_of(const ViewArrays& view, const ProjectSettings& settings) {
    return camera_from_matrices(view.viewmat, view.K, view.width, view.height, settings.profile.centred);
}

// Everything that a seen Gaussian's splat passes back. The coefficients give way to their gradients, in place: `first`
// and, where bands beyond it are active, `rest`.
template <int DEGREE>
__device__ __forceinline__ GaussianVjp<float> gaussian_vjp(const GaussianRow<float>& g, const Camera<float>& camera,
                                                           const ProjectSettings& settings,
                                                           const SplatCotangents<float>& of_splat, Vec3<float> v_color,
                                                           Vec3<float>& first, float* rest,
                                                           ViewmatVjp<float>& v_viewmat) {
    Vec3<float> v_dir = {0.0f, 0.0f, 0.0f};
    if (DEGREE != GIVEN_COLORS) {
        float basis[MAX_BASIS];
        Vec3<float> v_sum;
        v_dir = color_from_sh_vjp(StagedSh{first, rest}, view_dir(g.mean, camera), DEGREE, v_color, basis, v_sum);
        first = {basis[0] * v_sum.x, basis[0] * v_sum.y, basis[0] * v_sum.z};
#pragma unroll
        for (int k = 1; k < (DEGREE + 1) * (DEGREE + 1); ++k)
            store3(rest, k - 1, {basis[k] * v_sum.x, basis[k] * v_sum.y, basis[k] * v_sum.z});
    }
    return project_one_vjp(g, camera, settings.profile, settings.options, of_splat, v_dir, v_viewmat);
}

// call with the degree as a constant; floats: of a Gaussian's coefficients of all bands that its row has
template <class Call>
void with_degree(int degree, int floats, Call call) {
    if (degree < 0 || degree > 3)
        throw std::invalid_argument("sh_degree is " + std::to_string(degree) + "; the kernels have 0 to 3");
    // the kernels go through the bands of the degree, whatever a row has
    const int given = floats / 3, needed = (degree + 1) * (degree + 1);
    if (given < needed)
        throw std::invalid_argument("sh has " + std::to_string(given) + " coefficients; degree " +
                                    std::to_string(degree) + " needs " + std::to_string(needed));
    if (degree == 0) return call(std::integral_constant<int, 0>());
    if (degree == 1) return call(std::integral_constant<int, 1>());
    if (degree == 2) return call(std::integral_constant<int, 2>());
    return call(std::integral_constant<int, 3>());
}

}  // namespace pop
