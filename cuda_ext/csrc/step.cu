// What frames a fused step: its view and its rates before it, what it noted after it, and the sums of what a Gaussian
// adds to the loss by itself (POP's two sides, opacities, scales).
//
// Bounded by latency: one block begins a step and one ends it; the sums read a few floats a Gaussian.

#include "gaussian_rows.cuh"
#include "polarization.cuh"
#include "train.h"

namespace pop {

namespace {

constexpr int SUM_BLOCK = 256;

__global__ void begin_step_kernel(Schedule schedule, StepConstants* constants, DeviceState* state) {
    if (halted(state)) return;
    const int k = threadIdx.x, step = state->step;
    const int view = schedule.views[schedule.n_views * step + schedule.place];
    if (k == 0) {
        state->view = view;
        state->n_important = state->n_others = 0;
    }
    if (k < 16) schedule.viewmat[k] = schedule.viewmats[16 * view + k];
    if (k < 9) schedule.K[k] = schedule.Ks[9 * view + k];
    if (k >= N_GROUPS) return;
    const int at = N_GROUPS * step + k;
    constants->adam[k] =
        adam_step_at<float>(schedule.numbers[at], schedule.rates[at], schedule.beta1, schedule.beta2, schedule.eps);
}

// sums over a block in a fixed order; valid in thread 0
template <int N>
__device__ __forceinline__ void sum_over_block(float (&values)[N]) {
    __shared__ float of_warps[SUM_BLOCK / WARP][N];
#pragma unroll
    for (int mask = WARP / 2; mask > 0; mask /= 2)
#pragma unroll
        for (int k = 0; k < N; ++k) values[k] += __shfl_xor_sync(FULL_WARP, values[k], mask);
    if ((threadIdx.x & (WARP - 1)) == 0)
        for (int k = 0; k < N; ++k) of_warps[threadIdx.x / WARP][k] = values[k];
    __syncthreads();
    if (threadIdx.x > 0) return;
    for (int warp = 1; warp < SUM_BLOCK / WARP; ++warp)
        for (int k = 0; k < N; ++k) values[k] += of_warps[warp][k];
}

__global__ void __launch_bounds__(SUM_BLOCK) end_step_kernel(StepRecord record, DeviceState* state) {
    if (halted(state)) return;
    float sums[3] = {};
    if (record.pop_sums != nullptr) {
        const int blocks = (record.n + SUM_BLOCK - 1) / SUM_BLOCK;
        for (int k = threadIdx.x; k < blocks; k += SUM_BLOCK)
            for (int term = 0; term < 3; ++term) sums[term] += record.pop_sums[3 * k + term];
    }
    sum_over_block(sums);
    if (threadIdx.x > 0) return;
    const int important = state->n_important, others = state->n_others;
    record.values[V_POP] =
        record.pop_sums == nullptr
            ? 0.0f
            : record.lambda_pop * (sums[0] / float(max(important, 1)) + sums[1] / float(max(others, 1))) + sums[2];
    for (int k = 0; k < N_VALUES; ++k) record.history[size_t(N_VALUES) * state->step + k] = record.values[k];
    ++state->step;
}

// what a Gaussian adds to the loss by itself
__device__ __forceinline__ float regularizers_of(const PopTerm& term, int i) {
    float sum = 0.0f;
    if (term.own.entropy != 0.0f) sum += term.own.entropy * opacity_entropy_one(term.logits[i]);
    if (term.own.opacity != 0.0f) sum += term.own.opacity * opacity_from_logit(term.logits[i]);
    if (term.own.scale != 0.0f) {
        const Vec3<float> scale = scale_from_log_scale(load3(term.log_scales, i));
        sum += term.own.scale * (scale.x + scale.y + scale.z);
    }
    return sum;
}

__global__ void __launch_bounds__(SUM_BLOCK) count_important_kernel(PopTerm term, DeviceState* state) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x, row = min(i, term.n - 1);
    // all that is read is on its way before the first of it is waited for
    const float logit = term.logits[row];
    const int count = term.dominant_counts != nullptr ? term.dominant_counts[row] : 0;
    const int before = term.window_counts != nullptr ? term.window_counts[row] : 0;
    const bool shown = term.radii == nullptr || term.radii[2 * size_t(row)] > 0;
    PopSide side = PopSide::absent;
    if (i < term.n && term.dominant_counts != nullptr && shown)
        side = before > 0 || count > 0 ? PopSide::important : PopSide::other;
    if (i < term.n) term.sides[i] = uint8_t(side);
    const bool important = side == PopSide::important, other = side == PopSide::other;
    // 1 - o is the opacity of the negated logit
    const float o = opacity_from_logit(important ? -logit : logit);
    // numbers of a block, which a float holds exactly: one addition a block, since all of them go to one address
    float sums[5] = {important ? o : 0.0f, other ? o : 0.0f, i < term.n ? regularizers_of(term, i) : 0.0f,
                     important ? 1.0f : 0.0f, other ? 1.0f : 0.0f};
    sum_over_block(sums);
    if (threadIdx.x > 0) return;
    for (int k = 0; k < 3; ++k) term.sums[3 * blockIdx.x + k] = sums[k];
    // integers: the order of additions does not matter
    if (sums[3] > 0.0f) atomicAdd(&state->n_important, int(sums[3]));
    if (sums[4] > 0.0f) atomicAdd(&state->n_others, int(sums[4]));
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

}  // namespace pop
