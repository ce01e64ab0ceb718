// Row operations of density control, between replays of the training graph.

#include "density.cuh"
#include "kernel_tools.cuh"
#include "train.h"

namespace pop {

namespace {

constexpr int BLOCK = 256;

// index -1 makes a row of zeros: the moments of a row that is new
__global__ void gather_rows_kernel(const float* source, const long long* index, float* target, long long entries,
                                   int row_floats) {
    const long long e = (long long)(blockIdx.x) * blockDim.x + threadIdx.x;
    if (e >= entries) return;
    const long long row = index[e / row_floats];
    target[e] = row < 0 ? 0.0f : source[row * row_floats + e % row_floats];
}

__global__ void split_rows_kernel(const float* means, const float* quats, const float* log_scales, const float* normals,
                                  float shrink, float* child_means, float* child_log_scales, int n) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    const float *m = means + 3 * i, *q = quats + 4 * i, *s = log_scales + 3 * i, *z = normals + 3 * i;
    const Child<float> child =
        split_one(Vec3<float>{m[0], m[1], m[2]}, Vec4<float>{q[0], q[1], q[2], q[3]}, Vec3<float>{s[0], s[1], s[2]},
                  Vec3<float>{z[0], z[1], z[2]}, shrink);
    const float mean[3] = {child.mean.x, child.mean.y, child.mean.z};
    const float log_scale[3] = {child.log_scale.x, child.log_scale.y, child.log_scale.z};
    for (int k = 0; k < 3; ++k) {
        child_means[3 * i + k] = mean[k];
        child_log_scales[3 * i + k] = log_scale[k];
    }
}

__global__ void reset_opacities_kernel(AdamGroup opacities, int n, float logit) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    opacities.param[i] = fminf(opacities.param[i], logit);
    opacities.m[i] = 0.0f;
    opacities.v[i] = 0.0f;
}

}  // namespace

void gather_rows(const float* source, const long long* index, float* target, int n, int row_floats,
                 cudaStream_t stream) {
    const long long entries = (long long)(n) * row_floats;
    if (entries == 0) return;
    gather_rows_kernel<<<blocks_for(entries, BLOCK), BLOCK, 0, stream>>>(source, index, target, entries, row_floats);
    POP_LAUNCHED("gather_rows_kernel");
}

void split_rows(const float* means, const float* quats, const float* log_scales, const float* normals, float shrink,
                float* child_means, float* child_log_scales, int n, cudaStream_t stream) {
    if (n == 0) return;
    split_rows_kernel<<<blocks_for(n, BLOCK), BLOCK, 0, stream>>>(means, quats, log_scales, normals, shrink,
                                                                 child_means, child_log_scales, n);
    POP_LAUNCHED("split_rows_kernel");
}

void reset_opacities(AdamGroup opacities, int n, float logit, cudaStream_t stream) {
    if (n == 0) return;
    reset_opacities_kernel<<<blocks_for(n, BLOCK), BLOCK, 0, stream>>>(opacities, n, logit);
    POP_LAUNCHED("reset_opacities_kernel");
}

}  // namespace pop
