// What frames a fused step: its view and its rates before it, what it noted after it, and the sums of what a Gaussian
// adds to the loss by itself (POP's two sides, opacities, scales).
//
// Bounded by latency: one block begins a step and one ends it; the sums read a few floats a Gaussian.

#include "cuda_check.h"
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

// three sums over a block in a fixed order; valid in thread 0
__device__ __forceinline__ Vec3<float> block_sums(Vec3<float> value) {
    __shared__ Vec3<float> shared[SUM_BLOCK];
    shared[threadIdx.x] = value;
    __syncthreads();
    for (int half = SUM_BLOCK / 2; half > 0; half /= 2) {
        if (threadIdx.x < half) {
            shared[threadIdx.x].x += shared[threadIdx.x + half].x;
            shared[threadIdx.x].y += shared[threadIdx.x + half].y;
            shared[threadIdx.x].z += shared[threadIdx.x + half].z;
        }
        __syncthreads();
    }
    return shared[0];
}

__global__ void __launch_bounds__(SUM_BLOCK) end_step_kernel(StepRecord record, DeviceState* state) {
    if (halted(state)) return;
    Vec3<float> sums = {0.0f, 0.0f, 0.0f};
    if (record.pop_sums != nullptr) {
        const int blocks = (record.n + SUM_BLOCK - 1) / SUM_BLOCK;
        for (int k = threadIdx.x; k < blocks; k += SUM_BLOCK) {
            sums.x += record.pop_sums[3 * k];
            sums.y += record.pop_sums[3 * k + 1];
            sums.z += record.pop_sums[3 * k + 2];
        }
    }
    sums = block_sums(sums);
    if (threadIdx.x > 0) return;
    const int important = state->n_important, others = state->n_others;
    record.values[V_POP] =
        record.pop_sums == nullptr
            ? 0.0f
            : record.lambda_pop * (sums.x / float(max(important, 1)) + sums.y / float(max(others, 1))) + sums.z;
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
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    PopSide side = PopSide::absent;
    if (i < term.n && term.dominant_counts != nullptr && (term.radii == nullptr || term.radii[2 * i] > 0)) {
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
    const float own = i < term.n ? regularizers_of(term, i) : 0.0f;
    const Vec3<float> sums = block_sums(important ? Vec3<float>{o, 0.0f, own} : Vec3<float>{0.0f, o, own});
    if (threadIdx.x > 0) return;
    term.sums[3 * blockIdx.x] = sums.x;
    term.sums[3 * blockIdx.x + 1] = sums.y;
    term.sums[3 * blockIdx.x + 2] = sums.z;
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
