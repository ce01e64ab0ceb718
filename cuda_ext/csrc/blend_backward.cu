// Blending transposed, in moment form, by two families that give the same sums.
//
// columns: one warp a tile of 16 x 8 pixels, back to front; a lane owns four pixels, and a splat's sums are added over the
//     lanes by a transposed butterfly, about one shuffle a value.
// splats: one warp a bucket of 32 list entries, back to front; a lane owns a splat and keeps its sums in registers, and
//     the tile's pixels travel through the lanes. Needs the forward pass's checkpoints.
//
// A row of sums goes to its instance's slot, by exactly one warp, so nothing is added in an order that varies; or, where
// memory is short, by atomic addition to the splat.
//
// Both are bounded by the issue of instructions: columns by four pixels a lane, about four fifths, and the sums over
// lanes; splats by what a pair costs and by the steps that fill and drain a warp. sum_slots is bounded by the latency of
// memory, a few rows a splat. Counts: benchmarks/NOTES.md, `make sass`.

#include "cuda_check.h"
#include "kernel_tools.cuh"

namespace pop {

namespace {

template <int CH>
__device__ __forceinline__ float background_dot_grad(const BlendBackward& blend, const float* v_color, float v_T) {
    float dot = v_T;
    if (blend.background != nullptr)
#pragma unroll
        for (int c = 0; c < CH; ++c) dot += __ldg(blend.background + c) * v_color[c];
    return dot;
}

__device__ __forceinline__ float* row_of(const TileLists& lists, const BlendBackward& blend, const WarpTile& tile,
                                         int entry) {
    const size_t slot = lists.slots[1][entry];
    return blend.rows + RECORD * (slot * tile.parts + tile.part);
}

// Entries behind every pixel's last splat have no gradient, but their slots are read. A lane clears a row, and asks for
// the next slot without waiting for the stores.
__device__ __forceinline__ void clear_unused(const TileLists& lists, const BlendBackward& blend, const WarpTile& tile,
                                             int last, int end, int lane) {
    const float4 zero = {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll 2
    for (int entry = last + lane; entry < end; entry += WARP) {  // per 32 unused entries
        const size_t slot = __ldg(lists.slots[1] + entry);
        float4* row = reinterpret_cast<float4*>(blend.rows + RECORD * (slot * tile.parts + tile.part));
#pragma unroll
        for (int k = 0; k < RECORD / 4; ++k) row[k] = zero;
    }
}

constexpr int HALF_WARP = WARP / 2;
static_assert(HALF_WARP == WARP_TILE_W, "lanes half a warp apart share a column, and so dx");

// Sums of two records at a time: first a lane adds its column's other half, of one record each; then a half warp adds up
// its columns, with the moments along x made once a column.
template <int CH, bool ABS>
__device__ __forceinline__ float sum_of_pair(const ColumnSums<float, CH> (&pair)[2], const float (&dx)[2], int lane) {
    constexpr int N = SumsOf<CH, ABS>::count;
    const bool upper = lane & HALF_WARP;
    const auto joined = [upper](float first, float second) {
        return (upper ? second : first) + __shfl_xor_sync(FULL_WARP, upper ? first : second, HALF_WARP);
    };
    ColumnSums<float, CH> column;
#pragma unroll
    for (int c = 0; c < CH; ++c) column.v_color[c] = joined(pair[0].v_color[c], pair[1].v_color[c]);
    column.m0 = joined(pair[0].m0, pair[1].m0);
    column.my = joined(pair[0].my, pair[1].my);
    column.myy = joined(pair[0].myy, pair[1].myy);
    if (ABS) {
        column.abs_x = joined(pair[0].abs_x, pair[1].abs_x);
        column.abs_y = joined(pair[0].abs_y, pair[1].abs_y);
    }
    float sums[N];
    sums_of_column<ABS>(column, upper ? dx[1] : dx[0], sums);
    return TransposedSum<N, HALF_WARP / 2>::of(sums, lane);
}

template <int CH, bool ABS, bool PASS, bool ATOMIC>
__global__ void __launch_bounds__(WARP* WARPS_PER_BLOCK, CH < 4 && !ABS ? 7 : 0)
    columns_kernel(TileLists lists, BlendBackward blend, BlendConstants<float> constants, int n_warp_tiles) {
    constexpr int N = SumsOf<CH, ABS>::count;
    __shared__ float4 staged[WARPS_PER_BLOCK][WARP][RECORD / 4];
    __shared__ unsigned staged_rows[WARPS_PER_BLOCK][WARP];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int index = blockIdx.x * WARPS_PER_BLOCK + warp;
    if (index >= n_warp_tiles) return;
    const WarpTile tile = warp_tile(lists, index);
    const int x = tile.x + lane_x(lane), y = tile.y + lane_y(lane);
    const int rows = x < lists.grid.width ? min(COLUMN_ROWS, lists.grid.height - y) : 0;
    const float px = float(x) + 0.5f, py = float(y) + 0.5f;
    const int begin = lists.tile_begin[tile.list], end = lists.tile_end[tile.list];

    BackwardColumn<float, CH, COLUMN_ROWS> column;
    int last = 0;
#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        const bool inside = k < rows;
        const size_t pixel = inside ? size_t(y + k) * lists.grid.width + x : 0;
        column.last[k] = inside ? blend.last[pixel] : 0;
        column.T[k] = inside ? blend.T_final[pixel] : 1.0f;
#pragma unroll
        for (int c = 0; c < CH; ++c) column.v_color[k][c] = inside ? blend.v_image[CH * pixel + c] : 0.0f;
        const float v_T = inside && blend.v_T_final != nullptr ? blend.v_T_final[pixel] : 0.0f;
        column.suffix_dot_grad[k] = background_dot_grad<CH>(blend, column.v_color[k], v_T);
        last = max(last, column.last[k]);
    }
    last = begin + warp_max(last);
    if (!ATOMIC) clear_unused(lists, blend, tile, last, end, lane);

    // of a pair of records the first is summed by the lower half of the lanes, the other by the upper half
    const int place_in_warp = opaque_lane(), half = place_in_warp / HALF_WARP;
    const int own_sum = sum_index<N, HALF_WARP / 2>(place_in_warp);
    for (int top = last; top > begin; top -= WARP) {  // per 32 records
        const int count = min(WARP, top - begin);
        __syncwarp();
        // a batch that is not full ends in a splat of zeros, which reaches nothing
        Record record = {};
        if (lane < count) {
            const int entry = top - 1 - lane;
            const unsigned splat = lists.listed[entry];
            record = load_record(blend.records, splat);
            staged_rows[warp][lane] = ATOMIC ? splat : lists.slots[1][entry] * tile.parts + tile.part;
        }
        staged[warp][lane][0] = record.a;
        staged[warp][lane][1] = record.b;
        staged[warp][lane][2] = record.c;
        __syncwarp();
        // lanes without a sum of their own, or without a second splat, store nothing
        const int stored = own_sum < 0 ? 0 : count - half;
        for (int j = 0; j < count; j += 2) {  // per record
            ColumnSums<float, CH> sums[2];
            float dx[2];
            bool any[2];
#pragma unroll
            for (int g = 0; g < 2; ++g) {
                const Record record = {staged[warp][j + g][0], staged[warp][j + g][1], staged[warp][j + g][2]};
                float color[CH];
                record.color<CH>(color);
                dx[g] = add(record.a.x, -px);
                any[g] = blend_backward<ABS, PASS>(column, record.splat(), color, dx[g], py, top - 1 - j - g - begin,
                                                   constants, sums[g]);
            }
            // nearly every pair of splats reaches some pixel: asking costs more than it saves, but for atomics
            if (ATOMIC && !__any_sync(FULL_WARP, any[0] || any[1])) continue;
            const float total = sum_of_pair<CH, ABS>(sums, dx, place_in_warp);
            if (j >= stored) continue;
            float* const place = (ATOMIC ? blend.sums : blend.rows) + size_t(RECORD) * staged_rows[warp][j + half] + own_sum;
            if (ATOMIC)
                atomicAdd(place, total);
            else
                *place = total;
        }
    }
}

// A pixel of the tile as the splats of a bucket need it.
template <int CH>
struct BucketPixel {
    float v_color[CH];
    Passing<float> behind;
    int last;
};

template <int CH, bool ABS, bool PASS, bool ATOMIC>
__global__ void __launch_bounds__(WARP* WARPS_PER_BLOCK)
    splats_kernel(TileLists lists, BlendBackward blend, BlendConstants<float> constants, const DeviceState* state) {
    constexpr int N = SumsOf<CH, ABS>::count;
    __shared__ BucketPixel<CH> pixels[WARPS_PER_BLOCK][TILE_PIXELS];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int bucket = blockIdx.x * WARPS_PER_BLOCK + warp;
    if (bucket >= state->n_buckets) return;
    const int list = lists.bucket_tile[bucket];
    // lists and warp tiles coincide here
    const WarpTile tile = {list % lists.grid.tiles_x * WARP_TILE_W, list / lists.grid.tiles_x * WARP_TILE_H, list, 0, 1};
    const int begin = lists.tile_begin[list], end = lists.tile_end[list];
    const int first = (bucket - lists.bucket_begin[list]) * WARP;
    const float* checkpoint = blend.checkpoints + size_t(bucket) * (1 + CH) * TILE_PIXELS;

    int last = 0;
#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        const int x = tile.x + lane_x(lane), y = tile.y + lane_y(lane) + k;
        const bool inside = x < lists.grid.width && y < lists.grid.height;
        const size_t pixel = inside ? size_t(y) * lists.grid.width + x : 0;
        BucketPixel<CH> p = {};
        p.last = inside ? blend.last[pixel] : 0;
        if (p.last > first) {
            const bool goes_on = p.last > first + WARP;
            const float T_final = blend.T_final[pixel];
            const float v_T = blend.v_T_final == nullptr ? 0.0f : blend.v_T_final[pixel];
            float later[CH];
#pragma unroll
            for (int c = 0; c < CH; ++c) {
                p.v_color[c] = blend.v_image[CH * pixel + c];
                later[c] = checkpoint[(1 + c) * TILE_PIXELS + k * WARP + lane];
            }
            const float background_dot = background_dot_grad<CH>(blend, p.v_color, v_T);
            const float* next = checkpoint + (1 + CH) * TILE_PIXELS;
            p.behind = {T_final, background_dot};
            if (goes_on)
                p.behind = passing_after<float, CH>(next[k * WARP + lane], T_final, later, p.v_color, background_dot);
        }
        pixels[warp][k * WARP + lane] = p;
        last = max(last, p.last);
    }
    last = warp_max(last);
    __syncwarp();

    const int position = first + lane;
    const bool exists = begin + position < end;
    unsigned splat = 0;
    Record record = {};
    if (exists) {
        splat = lists.listed[begin + position];
        record = load_record(blend.records, splat);
    }
    float color[CH], sums[N];
    record.color<CH>(color);
#pragma unroll
    for (int k = 0; k < N; ++k) sums[k] = 0.0f;
    Passing<float> passing = {0.0f, 0.0f};
    if (last > first)
        for (int step = 0; step < TILE_PIXELS + WARP - 1; ++step) {  // per step
            // the pixel that the lane behind has just left
            passing.T = __shfl_down_sync(FULL_WARP, passing.T, 1);
            passing.suffix_dot_grad = __shfl_down_sync(FULL_WARP, passing.suffix_dot_grad, 1);
            const int p = step - (WARP - 1 - lane);
            if (p < 0 || p >= TILE_PIXELS) continue;
            const BucketPixel<CH>& pixel = pixels[warp][p];
            if (lane == WARP - 1) passing = pixel.behind;
            if (position >= pixel.last) continue;
            const int owner = p & (WARP - 1);
            const float px = float(tile.x + lane_x(owner)) + 0.5f;
            const float py = float(tile.y + lane_y(owner) + p / WARP) + 0.5f;
            pass_pixel<ABS, PASS, float, CH>(passing, record.splat(), color, pixel.v_color, px, py, constants, sums);
        }
    if (!exists) return;
    if (ATOMIC) {
        for (int k = 0; k < N; ++k) atomicAdd(blend.sums + size_t(RECORD) * splat + k, sums[k]);
    } else {
        float* row = row_of(lists, blend, tile, begin + position);
#pragma unroll
        for (int k = 0; k < N; ++k) row[k] = sums[k];
    }
}

// One warp a splat: eight rows at a time, three float4 a row, added in a fixed order.
__global__ void sum_slots_kernel(TileLists lists, BlendBackward blend, int parts) {
    const int splat = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, lane = threadIdx.x & (WARP - 1);
    if (splat >= lists.n) return;
    const size_t begin = size_t(lists.splat_begin[splat]) * parts;
    const size_t most = size_t(lists.capacity) * parts;
    const size_t count = size_t(lists.splat_count[splat]) * parts;
    const size_t end = begin + count < most ? begin + count : most;
    const int quarter = lane & 3;
    float4 total = {0.0f, 0.0f, 0.0f, 0.0f};
    if (quarter < RECORD / 4)
        for (size_t row = begin + lane / 4; row < end; row += WARP / 4) {  // per 8 slots
            const float4 v = reinterpret_cast<const float4*>(blend.rows + RECORD * row)[quarter];
            total = {total.x + v.x, total.y + v.y, total.z + v.z, total.w + v.w};
        }
#pragma unroll
    for (int mask = 4; mask < WARP; mask *= 2) {
        total.x += __shfl_xor_sync(FULL_WARP, total.x, mask);
        total.y += __shfl_xor_sync(FULL_WARP, total.y, mask);
        total.z += __shfl_xor_sync(FULL_WARP, total.z, mask);
        total.w += __shfl_xor_sync(FULL_WARP, total.w, mask);
    }
    if (lane < RECORD / 4) reinterpret_cast<float4*>(blend.sums + size_t(RECORD) * splat)[lane] = total;
}

template <int CH, bool ABS, bool PASS, bool ATOMIC>
void launch(const TileLists& lists, const BlendBackward& blend, const BlendConstants<float>& constants,
            const DeviceState* state, cudaStream_t stream) {
    const int threads = WARP * WARPS_PER_BLOCK;
    if (blend.backward == Backward::pixel_parallel) {
        const int tiles = n_warp_tiles(lists.grid);
        columns_kernel<CH, ABS, PASS, ATOMIC>
            <<<blocks_for(tiles, WARPS_PER_BLOCK), threads, 0, stream>>>(lists, blend, constants, tiles);
        POP_LAUNCHED("columns_kernel");
    } else {
        const int buckets = lists.capacity / WARP + lists.n_tiles;
        splats_kernel<CH, ABS, PASS, ATOMIC>
            <<<blocks_for(buckets, WARPS_PER_BLOCK), threads, 0, stream>>>(lists, blend, constants, state);
        POP_LAUNCHED("splats_kernel");
    }
    if (!ATOMIC && lists.n > 0) {
        const int parts = (lists.grid.tile_w / WARP_TILE_W) * (lists.grid.tile_h / WARP_TILE_H);
        sum_slots_kernel<<<blocks_for((long long)(lists.n) * WARP, 256), 256, 0, stream>>>(lists, blend, parts);
        POP_LAUNCHED("sum_slots_kernel");
    }
}

template <int CH, bool ABS, bool PASS>
void launch(const TileLists& lists, const BlendBackward& blend, const BlendConstants<float>& constants,
            const DeviceState* state, cudaStream_t stream) {
    if (blend.gather == Gather::atomics)
        launch<CH, ABS, PASS, true>(lists, blend, constants, state, stream);
    else
        launch<CH, ABS, PASS, false>(lists, blend, constants, state, stream);
}

template <int CH>
void launch(const TileLists& lists, const BlendBackward& blend, const Profile<float>& profile, const DeviceState* state,
            cudaStream_t stream) {
    const BlendConstants<float> constants = blend_constants(profile);
    if (blend.absolute)
        profile.pass_ceiling ? launch<CH, true, true>(lists, blend, constants, state, stream)
                             : launch<CH, true, false>(lists, blend, constants, state, stream);
    else
        profile.pass_ceiling ? launch<CH, false, true>(lists, blend, constants, state, stream)
                             : launch<CH, false, false>(lists, blend, constants, state, stream);
}

}  // namespace

void blend_backward(const TileLists& lists, const BlendBackward& blend, const Profile<float>& profile,
                    const DeviceState* state, cudaStream_t stream) {
    const bool own_tiles = lists.grid.tile_w == WARP_TILE_W && lists.grid.tile_h == WARP_TILE_H;
    if (blend.backward == Backward::gaussian_parallel && (!own_tiles || blend.checkpoints == nullptr))
        throw std::invalid_argument("blend_backward: backward gaussian_parallel needs 16 x 8 lists and checkpoints");
    switch (blend.channels) {
        case 1: return launch<1>(lists, blend, profile, state, stream);
        case 3: return launch<3>(lists, blend, profile, state, stream);
        case 4: return launch<4>(lists, blend, profile, state, stream);
        default: throw std::invalid_argument("blend_backward: channels must be 1, 3 or 4");
    }
}

}  // namespace pop
