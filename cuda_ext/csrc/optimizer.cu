// The last stage of a fused step: preprocess backward, POP's pull, density statistics and dense Adam in one kernel. A
// lane owns a Gaussian while gradients are made; then the warp owns the rows of its 32 Gaussians, so that parameters
// and moments are read and written in pieces of 16 bytes. Gradients never reach memory, no warp waits for another.
//
// What bounds the update is memory: 59 floats a Gaussian with both moments, read and written, are 1,416 bytes, 0.09 ms
// for 270,000 Gaussians at 4.2 TB/s. A warp makes five trips there: what makes gradients, the short rows, and three
// times a third of the harmonics, and in each no load waits for another. That is 5 to 11 KB on their way for a warp; 16
// warps fit a multiprocessor by the registers that gradients take, and about 25 KB keep its share of the memory busy.

#include "density.cuh"
#include "gaussian_rows.cuh"
#include "polarization.cuh"
#include "train.h"

namespace pop {

namespace {

constexpr int BLOCK = 128;

// floats of a row of each parameter whose rows have a fixed length
constexpr __host__ __device__ int row_floats(int group) {
    return group == G_QUATS ? 4 : group == G_OPACITIES ? 1 : 3;
}

// of these groups, the floats of a Gaussian that lie before a group's
constexpr __host__ __device__ int floats_before(int group) {
    return group == 0 ? 0 : floats_before(group - 1) + row_floats(group - 1);
}

// What a warp keeps: the coefficients of the bands beyond the first, which give way to their gradients, and the
// gradients of the other rows as these lie in memory.
template <int DEGREE>
struct Staged {
    WarpRows<ACTIVE<DEGREE, false>> rest;
    alignas(16) float short_rows[WARP * floats_before(G_SHN)];

    __device__ __forceinline__ float* rows(int group) { return short_rows + WARP * floats_before(group); }
    __device__ __forceinline__ const float* rows(int group) const { return short_rows + WARP * floats_before(group); }
};

// by read-only loads, which no store before them holds up
__device__ __forceinline__ AdamStep<float> adam_step_of(const UpdateArrays& a, int group) {
    const AdamStep<float>* s = a.constants->adam + group;
    return {__ldg(&s->rate),  __ldg(&s->root),       __ldg(&s->beta1_rest),
            __ldg(&s->beta2), __ldg(&s->beta2_rest), __ldg(&s->eps)};
}

// one piece of a group's rows with its moments
struct Piece {
    float4 param, m, v;
};

__device__ __forceinline__ Piece load_piece(const AdamGroup& group, size_t at) {
    return {*reinterpret_cast<const float4*>(group.param + at), *reinterpret_cast<const float4*>(group.m + at),
            *reinterpret_cast<const float4*>(group.v + at)};
}

// an instruction of its own: the compiler takes some plain assignments apart into floats
__device__ __forceinline__ void store_piece(float* p, float4 v) { __stwb(reinterpret_cast<float4*>(p), v); }

__device__ __forceinline__ void adam_piece(const AdamGroup& group, size_t at, Piece p, float4 g,
                                           const AdamStep<float>& step) {
    adam_one(p.param.x, p.m.x, p.v.x, g.x, step);
    adam_one(p.param.y, p.m.y, p.v.y, g.y, step);
    adam_one(p.param.z, p.m.z, p.v.z, g.z, step);
    adam_one(p.param.w, p.m.w, p.v.w, g.w, step);
    store_piece(group.param + at, p.param);
    store_piece(group.m + at, p.m);
    store_piece(group.v + at, p.v);
}

__device__ __forceinline__ void adam_float(const AdamGroup& group, size_t at, float g, const AdamStep<float>& step) {
    float param = group.param[at], m = group.m[at], v = group.v[at];
    adam_one(param, m, v, g, step);
    group.param[at] = param;
    group.m[at] = m;
    group.v[at] = v;
}

template <bool VIEWS>
__device__ __forceinline__ bool group_in_pieces(const AdamGroup& group) {
    return in_pieces(group.param) && in_pieces(group.m) && in_pieces(group.v) && (!VIEWS || in_pieces(group.gradient));
}

__device__ __forceinline__ bool last_view(const UpdateArrays& a) { return a.place + 1 == a.n_views; }

// Add the gradients of the views before, one after the other in the order of the batch. Those of the last view become
// the mean; those of the others are kept, and nothing is moved.
__device__ __forceinline__ float with_views(const UpdateArrays& a, const float* kept, float g) {
    if (a.place > 0) g = *kept + g;
    return last_view(a) ? g / float(a.n_views) : g;
}

__device__ __forceinline__ float4 with_views(const UpdateArrays& a, const float* kept, float4 g) {
    const float4 before = a.place > 0 ? *reinterpret_cast<const float4*>(kept) : float4{};
    if (a.place > 0) g = {before.x + g.x, before.y + g.y, before.z + g.z, before.w + g.w};
    const float views = float(a.n_views);
    return last_view(a) ? float4{g.x / views, g.y / views, g.z / views, g.w / views} : g;
}

// what a lane reads of its Gaussian before anything is made of it
struct Given {
    GaussianRow<float> raw;
    Vec3<float> first;  // harmonics
    float4 sums[3];     // RECORD floats
    Conic<float> conic;
    float opacity;      // of the splat
    bool seen;
    PopSide side;
    int dominant_count, dominant_sum, n_visible;
    float grad_sum;
};

__device__ __forceinline__ Given load_given(const UpdateArrays& a, const SplatArrays& splats, int i) {
    Given given;
    given.raw = load_gaussian(a.groups[G_MEANS].param, a.groups[G_QUATS].param, a.groups[G_SCALES].param,
                              a.groups[G_OPACITIES].param, i);
    given.first = load3(a.groups[G_SH0].param, i);
    const float4* sums = reinterpret_cast<const float4*>(a.sums + size_t(RECORD) * i);
#pragma unroll
    for (int k = 0; k < 3; ++k) given.sums[k] = __ldg(sums + k);
    const Vec3<float> q = load3(splats.conics, i);
    given.conic = {q.x, q.y, q.z};
    given.opacity = splats.opacities[i];
    given.seen = splats.radii[2 * size_t(i)] > 0;
    given.side = a.lambda_pop != 0.0f ? PopSide(a.pop_sides[i]) : PopSide::absent;
    given.dominant_count = a.dominant_counts != nullptr ? a.dominant_counts[i] : 0;
    given.dominant_sum = a.dominant_sum != nullptr ? a.dominant_sum[i] : 0;
    given.n_visible = a.n_visible != nullptr ? a.n_visible[i] : 0;
    given.grad_sum = a.grad_sum != nullptr ? a.grad_sum[i] : 0.0f;
    return given;
}

__device__ __forceinline__ void note_statistics(const UpdateArrays& a, int i, const Given& given, Vec2<float> v_mean2d,
                                                const ViewArrays& view, float blur_pixels) {
    if (a.grad_sum != nullptr && given.seen) {
        a.grad_sum[i] = given.grad_sum + densification_gradient(v_mean2d, view.width, view.height);
        a.n_visible[i] = given.n_visible + 1;
    }
    if (a.dominant_counts == nullptr) return;
    if (a.dominant_sum != nullptr) a.dominant_sum[i] = given.dominant_sum + given.dominant_count;
    const bool blurred = float(given.dominant_count) > blur_pixels;
    if (a.blurred != nullptr && (blurred || a.blur_own_view)) a.blurred[i] = blurred;
}

template <int DEGREE>
__device__ __forceinline__ void make_gradients(const UpdateArrays& a, const ViewArrays& view,
                                               const ProjectSettings& settings, const Camera<float>& camera,
                                               int n_important, int n_others, float blur_pixels, int i,
                                               const Given& given, Staged<DEGREE>& staged) {
    const int lane = threadIdx.x & (WARP - 1);
    GaussianVjp<float> v = {};
    Vec3<float> v_first = {0.0f, 0.0f, 0.0f};
    Vec2<float> v_mean2d = {0.0f, 0.0f};
    float* rest = staged.rest.row(lane);
    if (given.seen) {
        const float4* s = given.sums;
        const float moments[RECORD - 3] = {s[0].w, s[1].x, s[1].y, s[1].z, s[1].w, s[2].x, s[2].y, s[2].z, s[2].w};
        const SplatVjp<float> of = splat_vjp_from_moments<false>(moments, given.conic, given.opacity);
        const SplatCotangents<float> of_splat = {of.v_mean2d, 0.0f, of.v_conic, of.v_opacity, 0.0f};
        const Vec3<float> v_color = {s[0].x, s[0].y, s[0].z};
        ViewmatVjp<float> unused = {};
        v_first = given.first;
        v = gaussian_vjp<DEGREE>(activated(given.raw), camera, settings, of_splat, v_color, v_first, rest, unused);
        v_mean2d = of.v_mean2d;
    } else {
#pragma unroll
        for (int k = 0; k < ACTIVE<DEGREE, false>; ++k) rest[k] = 0.0f;
    }
    if (a.lambda_pop != 0.0f)
        v.v_opacity += pop_loss_vjp_one(given.side, n_important, n_others, a.lambda_pop);
    note_statistics(a, i, given, v_mean2d, view, blur_pixels);
    store3(staged.rows(G_MEANS), lane, v.v_mean);
    if (a.own.scale != 0.0f)
        v.v_scale = {v.v_scale.x + a.own.scale, v.v_scale.y + a.own.scale, v.v_scale.z + a.own.scale};
    store3(staged.rows(G_SCALES), lane, scale_from_log_scale_vjp(given.raw.scale, v.v_scale));
    reinterpret_cast<float4*>(staged.rows(G_QUATS))[lane] = {v.v_quat.w, v.v_quat.x, v.v_quat.y, v.v_quat.z};
    float v_logit = opacity_from_logit_vjp(given.raw.opacity, v.v_opacity + a.own.opacity);
    if (a.own.entropy != 0.0f) v_logit += opacity_entropy_vjp_one(given.raw.opacity, a.own.entropy);
    staged.rows(G_OPACITIES)[lane] = v_logit;
    store3(staged.rows(G_SH0), lane, v_first);
}

// Adam on the five groups whose rows are short: a piece of each to a lane, all read before the first is used
template <int DEGREE, bool VIEWS>
__device__ __forceinline__ void update_short_rows(const UpdateArrays& a, int first, int rows,
                                                  const Staged<DEGREE>& staged) {
    const int lane = threadIdx.x & (WARP - 1);
    // the groups' steps differ in their rates alone, but for opacities, which a rule may leave as they are
    AdamStep<float> step = adam_step_of(a, 0);
    const bool opacities_stay = __ldg(&a.constants->adam[G_OPACITIES].beta1_rest) == 0.0f;
    float rates[G_SHN];
    bool pieces = rows == WARP;
#pragma unroll
    for (int group = 0; group < G_SHN; ++group) {
        rates[group] = __ldg(&a.constants->adam[group].rate);
        pieces = pieces && group_in_pieces<VIEWS>(a.groups[group]);
    }
    if (!pieces) {
#pragma unroll
        for (int group = 0; group < G_SHN; ++group) {
            step.rate = rates[group];
            if (group == G_OPACITIES && opacities_stay) continue;
#pragma unroll 1
            for (int at = lane; at < rows * row_floats(group); at += WARP) {
                const size_t place = size_t(first) * row_floats(group) + at;
                float g = staged.rows(group)[at];
                if constexpr (VIEWS) g = with_views(a, a.groups[group].gradient + place, g);
                if (VIEWS && !last_view(a))
                    a.groups[group].gradient[place] = g;
                else
                    adam_float(a.groups[group], place, g, step);
            }
        }
        return;
    }
    Piece held[G_SHN];
#pragma unroll
    for (int group = 0; group < G_SHN; ++group)
        if (lane < WARP / 4 * row_floats(group) && (!VIEWS || last_view(a)))
            held[group] = load_piece(a.groups[group], size_t(first) * row_floats(group) + 4 * lane);
#pragma unroll
    for (int group = 0; group < G_SHN; ++group) {
        step.rate = rates[group];
        if (lane >= WARP / 4 * row_floats(group) || (group == G_OPACITIES && opacities_stay)) continue;
        const size_t place = size_t(first) * row_floats(group) + 4 * lane;
        float4 g = reinterpret_cast<const float4*>(staged.rows(group))[lane];
        if constexpr (VIEWS) g = with_views(a, a.groups[group].gradient + place, g);
        if (VIEWS && !last_view(a))
            store_piece(a.groups[group].gradient + place, g);
        else
            adam_piece(a.groups[group], place, held[group], g, step);
    }
}

// The gradient of an update together with those that wait for it. One that is not due leaves them waiting, and its own.
__device__ __forceinline__ float with_waiting(float* sum, float g, bool due) {
    if (sum == nullptr) return g;
    g += *sum;
    *sum = due ? 0.0f : g;
    return g;
}

__device__ __forceinline__ float4 with_waiting(float* sum, float4 g, bool due) {
    if (sum == nullptr) return g;
    return {with_waiting(sum, g.x, due), with_waiting(sum + 1, g.y, due), with_waiting(sum + 2, g.z, due),
            with_waiting(sum + 3, g.w, due)};
}

// Adam on the bands beyond the first. Bands above the active degree have had no gradient yet: their moments are zero
// and Adam would not move them.
template <int DEGREE, bool VIEWS>
__device__ __forceinline__ void update_long_rows(const UpdateArrays& a, const RowStride& stride, int first, int rows,
                                                 const Staged<DEGREE>& staged) {
    constexpr int FLOATS = ACTIVE<DEGREE, false>, AT_ONCE = 4;
    static_assert(FLOATS > 0);
    const AdamGroup& group = a.groups[G_SHN];
    const AdamStep<float> step = adam_step_of(a, G_SHN);
    const bool due = step.beta1_rest != 0.0f;
    float* const waiting = a.sh_rest_sum;
    const int lane = threadIdx.x & (WARP - 1), total = rows * stride.floats;
    const size_t base = size_t(first) * stride.floats;
    if (rows < WARP || !group_in_pieces<VIEWS>(group)) {
#pragma unroll 1
        for (int at = lane; at < total; at += WARP)
            if (staged_at<FLOATS>(at, stride) >= 0) {
                float g = staged_float<FLOATS>(staged.rest, at, stride);
                if constexpr (VIEWS) g = with_views(a, group.gradient + base + at, g);
                float* const sum = waiting == nullptr ? nullptr : waiting + base + at;
                if (VIEWS && !last_view(a))
                    group.gradient[base + at] = g;
                else
                    adam_float(group, base + at, with_waiting(sum, g, due), step);
            }
        return;
    }
    for (int begin = 4 * lane; begin < total; begin += 4 * WARP * AT_ONCE) {  // per 16 floats of a lane
        Piece held[AT_ONCE];
        bool counts[AT_ONCE];
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            const int at = begin + 4 * WARP * k;
            counts[k] = at < total && piece_counts<FLOATS>(at, stride, FULL_WARP);
            if (counts[k] && (!VIEWS || last_view(a))) held[k] = load_piece(group, base + at);
        }
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            const int at = begin + 4 * WARP * k;
            if (!counts[k]) continue;
            float4 g = staged_piece<FLOATS>(staged.rest, at, stride);
            if constexpr (VIEWS) g = with_views(a, group.gradient + base + at, g);
            float* const sum = waiting == nullptr ? nullptr : waiting + base + at;
            if (VIEWS && !last_view(a))
                store_piece(group.gradient + base + at, g);
            else
                adam_piece(group, base + at, held[k], with_waiting(sum, g, due), step);
        }
    }
}

template <int DEGREE, bool VIEWS>
__device__ __forceinline__ void update_rows(const UpdateArrays& a, const ViewArrays& view,
                                            const ProjectSettings& settings, const SplatArrays& splats,
                                            const RowStride& stride, const DeviceState* state,
                                            Staged<DEGREE>* of_warps) {
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int first = blockIdx.x * BLOCK + warp * WARP, rows = min(WARP, a.n - first);
    if (rows <= 0 || halted(state)) return;
    Staged<DEGREE>& staged = of_warps[warp];
    const Camera<float> camera = camera_of(view, settings);
    const int n_important = state->n_important, n_others = state->n_others;
    const float blur_pixels = a.blurred != nullptr ? a.blur_pixels[state->view] : 0.0f;
    Given given = {};
    if (lane < rows) given = load_given(a, splats, first + lane);
    if constexpr (DEGREE > 0)
        read_rows<12>(a.groups[G_SHN].param + size_t(first) * stride.floats, stride, rows, FULL_WARP, staged.rest);
    __syncwarp();
    if (lane < rows) 
        make_gradients<DEGREE>(a, view, settings, camera, n_important, n_others, blur_pixels, first + lane, given,
                               staged);
    __syncwarp();
    update_short_rows<DEGREE, VIEWS>(a, first, rows, staged);
    if constexpr (DEGREE > 0) update_long_rows<DEGREE, VIEWS>(a, stride, first, rows, staged);
}

template <int DEGREE>
__global__ void __launch_bounds__(BLOCK, 4)
    update_kernel(UpdateArrays a, ViewArrays view, ProjectSettings settings, SplatArrays splats, RowStride stride,
                  const DeviceState* state) {
    __shared__ Staged<DEGREE> of_warps[BLOCK / WARP];
    update_rows<DEGREE, false>(a, view, settings, splats, stride, state, of_warps);
}

// one view of a step of several
template <int DEGREE>
__global__ void __launch_bounds__(BLOCK, 4)
    update_views_kernel(UpdateArrays a, ViewArrays view, ProjectSettings settings, SplatArrays splats,
                        RowStride stride, const DeviceState* state) {
    __shared__ Staged<DEGREE> of_warps[BLOCK / WARP];
    update_rows<DEGREE, true>(a, view, settings, splats, stride, state, of_warps);
}

}  // namespace

void update(const UpdateArrays& arrays, const ViewArrays& view, const ProjectSettings& settings,
            const SplatArrays& splats, DeviceState* state, cudaStream_t stream) {
    if (arrays.n == 0) return;
    const RowStride stride = row_stride(3 * arrays.n_rest);
    with_degree(settings.sh_degree, 3 + 3 * arrays.n_rest, [&](auto degree) {
        constexpr int DEGREE = decltype(degree)::value;
        const int blocks = blocks_for(arrays.n, BLOCK);
        if (arrays.n_views > 1)
            update_views_kernel<DEGREE><<<blocks, BLOCK, 0, stream>>>(arrays, view, settings, splats, stride, state);
        else
            update_kernel<DEGREE><<<blocks, BLOCK, 0, stream>>>(arrays, view, settings, splats, stride, state);
    });
    POP_LAUNCHED("update_kernel");
}

}  // namespace pop
