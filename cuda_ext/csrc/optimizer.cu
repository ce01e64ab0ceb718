// The last stage of a fused step: preprocess backward, POP's pull, density statistics and dense Adam in one kernel. A
// thread owns a Gaussian while gradients are made; then the block owns its rows, so that parameters and moments are read
// and written in whole lines. Gradients never reach memory.

#include "cuda_check.h"
#include "density.cuh"
#include "kernel_tools.cuh"
#include "polarization.cuh"
#include "train.h"

namespace pop {

namespace {

constexpr int BLOCK = 128, SUM_BLOCK = 256;

// floats of a row of each parameter whose rows have a fixed length
constexpr __host__ __device__ int row_floats(int group) {
    return group == G_QUATS ? 4 : group == G_OPACITIES ? 1 : 3;
}

__global__ void begin_step_kernel(Schedule schedule, StepConstants* constants, DeviceState* state) {
    if (halted(state)) return;
    const int k = threadIdx.x, step = state->step, view = schedule.views[step];
    if (k == 0) {
        state->view = view;
        state->n_important = state->n_others = 0;
    }
    if (k < 16) schedule.viewmat[k] = schedule.viewmats[16 * view + k];
    if (k < 9) schedule.K[k] = schedule.Ks[9 * view + k];
    if (k >= N_GROUPS) return;
    const double share = fmin(double(step) / schedule.max_steps, 1.0);
    const double decay = k == G_MEANS ? pow(schedule.means_decay, share) : 1.0;
    constants->adam[k] =
        adam_step_at<float>(step + 1, schedule.lr[k] * decay, schedule.beta1, schedule.beta2, schedule.eps);
}

// two sums over a block in a fixed order; valid in thread 0
__device__ __forceinline__ float2 block_sums(float2 value) {
    __shared__ float2 shared[SUM_BLOCK];
    shared[threadIdx.x] = value;
    __syncthreads();
    for (int half = SUM_BLOCK / 2; half > 0; half /= 2) {
        if (threadIdx.x < half) {
            shared[threadIdx.x].x += shared[threadIdx.x + half].x;
            shared[threadIdx.x].y += shared[threadIdx.x + half].y;
        }
        __syncthreads();
    }
    return shared[0];
}

__global__ void __launch_bounds__(SUM_BLOCK) end_step_kernel(StepRecord record, DeviceState* state) {
    if (halted(state)) return;
    float2 sums = {0.0f, 0.0f};
    if (record.pop_sums != nullptr) {
        const int blocks = (record.n + SUM_BLOCK - 1) / SUM_BLOCK;
        for (int k = threadIdx.x; k < blocks; k += SUM_BLOCK) {
            sums.x += record.pop_sums[2 * k];
            sums.y += record.pop_sums[2 * k + 1];
        }
    }
    sums = block_sums(sums);
    if (threadIdx.x > 0) return;
    const int important = state->n_important, others = state->n_others;
    record.values[V_POP] =
        record.pop_sums == nullptr
            ? 0.0f
            : record.lambda_pop * (sums.x / float(max(important, 1)) + sums.y / float(max(others, 1)));
    for (int k = 0; k < N_VALUES; ++k) record.history[size_t(N_VALUES) * state->step + k] = record.values[k];
    ++state->step;
}

__global__ void __launch_bounds__(SUM_BLOCK) count_important_kernel(PopTerm term, DeviceState* state) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    PopSide side = PopSide::absent;
    if (i < term.n && (term.radii == nullptr || term.radii[2 * i] > 0)) {
        const bool before = term.window_counts != nullptr && term.window_counts[i] > 0;
        side = before || term.dominant_counts[i] > 0 ? PopSide::important : PopSide::other;
    }
    if (i < term.n) term.sides[i] = uint8_t(side);
    const bool important = side == PopSide::important;
    const unsigned up = __ballot_sync(FULL_WARP, important), down = __ballot_sync(FULL_WARP, side == PopSide::other);
    // integers: the order of additions does not matter
    if ((threadIdx.x & (WARP - 1)) == 0 && up) atomicAdd(&state->n_important, __popc(up));
    if ((threadIdx.x & (WARP - 1)) == 0 && down) atomicAdd(&state->n_others, __popc(down));
    // 1 - o is the opacity of the negated logit
    const float o = side == PopSide::absent ? 0.0f : opacity_from_logit(important ? -term.logits[i] : term.logits[i]);
    const float2 sums = block_sums(important ? float2{o, 0.0f} : float2{0.0f, o});
    if (threadIdx.x > 0) return;
    term.sums[2 * blockIdx.x] = sums.x;
    term.sums[2 * blockIdx.x + 1] = sums.y;
}

// gradients of a block's rows, as its threads leave them for the update
struct Staged {
    float rows[N_GROUPS - 2][4][BLOCK];  // means, scales, quats, opacities, by component
    float basis[MAX_BASIS][BLOCK];
    float v_sum[3][BLOCK];
};

__device__ __forceinline__ void adam_at(const AdamGroup& group, size_t at, float g, const AdamStep<float>& step) {
    float param = group.param[at], m = group.m[at], v = group.v[at];
    adam_one(param, m, v, g, step);
    group.param[at] = param;
    group.m[at] = m;
    group.v[at] = v;
}

__device__ __forceinline__ void note_statistics(const UpdateArrays& a, int i, bool seen, Vec2<float> v_mean2d,
                                                const ViewArrays& view) {
    if (a.grad_sum != nullptr && seen) {
        a.grad_sum[i] += densification_gradient(v_mean2d, view.width, view.height);
        a.n_visible[i] += 1;
    }
    if (a.dominant_sum != nullptr && a.dominant_counts != nullptr) a.dominant_sum[i] += a.dominant_counts[i];
    if (a.blurred != nullptr && a.dominant_counts != nullptr) {
        const bool blurred = float(a.dominant_counts[i]) > a.blur_pixels;
        if (blurred || a.blur_own_view) a.blurred[i] = blurred;
    }
}

__device__ __forceinline__ void make_gradients(const UpdateArrays& a, const ViewArrays& view,
                                               const ProjectSettings& settings, const SplatArrays& splats,
                                               const DeviceState* state, int i, Staged& staged) {
    const int t = threadIdx.x;
    const float *mean = a.groups[G_MEANS].param + 3 * i, *quat = a.groups[G_QUATS].param + 4 * i,
                *log_scale = a.groups[G_SCALES].param + 3 * i;
    const Vec3<float> logs = {log_scale[0], log_scale[1], log_scale[2]};
    const float logit = a.groups[G_OPACITIES].param[i];
    const bool seen = splats.radii[2 * i] > 0;
    GaussianVjp<float> v = {};
    Vec3<float> v_sum = {0.0f, 0.0f, 0.0f};
    Vec2<float> v_mean2d = {0.0f, 0.0f};
    float basis[MAX_BASIS] = {};
    if (seen) {
        const GaussianRow<float> g = {{mean[0], mean[1], mean[2]},
                                      {quat[0], quat[1], quat[2], quat[3]},
                                      scale_from_log_scale(logs),
                                      opacity_from_logit(logit)};
        const Camera<float> camera =
            camera_from_matrices(view.viewmat, view.K, view.width, view.height, settings.profile.centred);
        const float *row = a.sums + size_t(RECORD) * i, *q = splats.conics + 3 * i;
        const SplatVjp<float> of =
            splat_vjp_from_moments<false>(row + 3, Conic<float>{q[0], q[1], q[2]}, splats.opacities[i]);
        const ShRow<float> sh = {a.groups[G_SH0].param + 3 * i, a.groups[G_SHN].param + size_t(3) * a.n_rest * i};
        const Vec3<float> v_dir = color_from_sh_vjp(sh, view_dir(g.mean, camera), settings.sh_degree,
                                                    Vec3<float>{row[0], row[1], row[2]}, basis, v_sum);
        ViewmatVjp<float> unused = {};
        const SplatCotangents<float> of_splat = {of.v_mean2d, 0.0f, of.v_conic, of.v_opacity, 0.0f};
        v = project_one_vjp(g, camera, settings.profile, settings.options, of_splat, v_dir, unused);
        v_mean2d = of.v_mean2d;
    }
    if (a.lambda_pop != 0.0f)
        v.v_opacity += pop_loss_vjp_one(PopSide(a.pop_sides[i]), state->n_important, state->n_others, a.lambda_pop);
    note_statistics(a, i, seen, v_mean2d, view);
    const Vec3<float> v_logs = scale_from_log_scale_vjp(logs, v.v_scale);
    const float rows[N_GROUPS - 2][4] = {{v.v_mean.x, v.v_mean.y, v.v_mean.z, 0.0f},
                                         {v_logs.x, v_logs.y, v_logs.z, 0.0f},
                                         {v.v_quat.w, v.v_quat.x, v.v_quat.y, v.v_quat.z},
                                         {opacity_from_logit_vjp(logit, v.v_opacity), 0.0f, 0.0f, 0.0f}};
#pragma unroll
    for (int group = 0; group < N_GROUPS - 2; ++group)
#pragma unroll
        for (int k = 0; k < row_floats(group); ++k) staged.rows[group][k][t] = rows[group][k];
#pragma unroll
    for (int k = 0; k < MAX_BASIS; ++k) staged.basis[k][t] = basis[k];
    staged.v_sum[0][t] = v_sum.x;
    staged.v_sum[1][t] = v_sum.y;
    staged.v_sum[2][t] = v_sum.z;
}

template <int GROUP>
__device__ __forceinline__ void update_group(const UpdateArrays& a, int first, int rows, const Staged& staged) {
    constexpr int K = row_floats(GROUP);
    const AdamStep<float> step = a.constants->adam[GROUP];
    for (int e = threadIdx.x; e < rows * K; e += BLOCK) {
        const int row = e / K, k = e % K;
        const float g = GROUP == G_SH0 ? staged.basis[0][row] * staged.v_sum[k][row] : staged.rows[GROUP % 4][k][row];
        adam_at(a.groups[GROUP], size_t(first) * K + e, g, step);
    }
}

__global__ void __launch_bounds__(BLOCK) update_kernel(UpdateArrays a, ViewArrays view, ProjectSettings settings,
                                                       SplatArrays splats, const DeviceState* state) {
    __shared__ Staged staged;
    if (halted(state)) return;
    const int first = blockIdx.x * BLOCK, i = first + threadIdx.x, rows = min(BLOCK, a.n - first);
    if (i < a.n) make_gradients(a, view, settings, splats, state, i, staged);
    __syncthreads();
    update_group<G_MEANS>(a, first, rows, staged);
    update_group<G_SCALES>(a, first, rows, staged);
    update_group<G_QUATS>(a, first, rows, staged);
    update_group<G_OPACITIES>(a, first, rows, staged);
    update_group<G_SH0>(a, first, rows, staged);
    // bands above the active degree have had no gradient yet: their moments are zero and Adam would not move them
    const int active = 3 * ((settings.sh_degree + 1) * (settings.sh_degree + 1) - 1);
    const AdamStep<float> step = a.constants->adam[G_SHN];
    for (int e = threadIdx.x; e < rows * active; e += BLOCK) {
        const int row = e / active, k = e % active;
        const float g = staged.basis[1 + k / 3][row] * staged.v_sum[k % 3][row];
        adam_at(a.groups[G_SHN], size_t(first + row) * 3 * a.n_rest + k, g, step);
    }
}

}  // namespace

void begin_step(const Schedule& schedule, StepConstants* constants, DeviceState* state, cudaStream_t stream) {
    begin_step_kernel<<<1, WARP, 0, stream>>>(schedule, constants, state);
    POP_LAUNCHED("begin_step_kernel");
}

void end_step(const StepRecord& record, DeviceState* state, cudaStream_t stream) {
    end_step_kernel<<<1, SUM_BLOCK, 0, stream>>>(record, state);
    POP_LAUNCHED("end_step_kernel");
}

int important_blocks(int n) { return blocks_for(n, SUM_BLOCK); }

void count_important(const PopTerm& term, DeviceState* state, cudaStream_t stream) {
    if (term.n == 0) return;
    count_important_kernel<<<important_blocks(term.n), SUM_BLOCK, 0, stream>>>(term, state);
    POP_LAUNCHED("count_important_kernel");
}

void update(const UpdateArrays& arrays, const ViewArrays& view, const ProjectSettings& settings,
            const SplatArrays& splats, DeviceState* state, cudaStream_t stream) {
    if (arrays.n == 0) return;
    update_kernel<<<blocks_for(arrays.n, BLOCK), BLOCK, 0, stream>>>(arrays, view, settings, splats, state);
    POP_LAUNCHED("update_kernel");
}

}  // namespace pop
