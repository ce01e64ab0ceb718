// Blending, front to back: one warp a tile of 16 x 8 pixels, a lane owns a column of four. No barrier crosses a warp.

#include "cuda_check.h"
#include "kernel_tools.cuh"

namespace pop {

namespace {

// entries between two looks at whether any pixel of the warp still takes splats
constexpr int LOOK_EVERY = 8;

// Where a lane's pixels keep what family "splats" reads of a bucket: T before it, then the colour that later buckets
// blended. Until the list is done, the colour is what this bucket blended.
template <int CH>
__device__ __forceinline__ float* checkpoint_of(const TileLists& lists, const BlendForward& blend, int list, int bucket,
                                                int lane) {
    return blend.checkpoints + size_t(lists.bucket_begin[list] + bucket) * (1 + CH) * TILE_PIXELS + lane;
}

// Turn what every bucket blended into what those behind it blended; `column` comes with the last one's colour and goes
// with the whole.
template <int CH>
__device__ __forceinline__ void sum_from_the_back(const TileLists& lists, const BlendForward& blend, int list,
                                                  int n_buckets, int lane, ForwardColumn<float, CH, COLUMN_ROWS>& column) {
    for (int bucket = n_buckets - 1; bucket >= 0; --bucket) {  // per bucket
        float* kept = checkpoint_of<CH>(lists, blend, list, bucket, lane) + TILE_PIXELS;
        const bool last = bucket == n_buckets - 1;
#pragma unroll
        for (int k = 0; k < COLUMN_ROWS; ++k)
#pragma unroll
            for (int c = 0; c < CH; ++c) {
                float& place = kept[c * TILE_PIXELS + k * WARP];
                const float own = last ? 0.0f : place;
                place = last ? 0.0f : column.color[k][c];
                column.color[k][c] += own;
            }
    }
}

template <int CH, bool TELL, bool CHECKPOINT>
__global__ void __launch_bounds__(WARP* WARPS_PER_BLOCK)
    blend_forward_kernel(TileLists lists, BlendForward blend, BlendConstants<float> constants, int n_warp_tiles) {
    __shared__ float4 staged[WARPS_PER_BLOCK][WARP][RECORD / 4];
    __shared__ unsigned staged_ids[TELL ? WARPS_PER_BLOCK : 1][WARP];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int index = blockIdx.x * WARPS_PER_BLOCK + warp;
    if (index >= n_warp_tiles) return;
    const WarpTile tile = warp_tile(lists.grid, index);
    const int x = tile.x + lane_x(lane), y = tile.y + lane_y(lane);
    const int rows = x < lists.grid.width ? min(COLUMN_ROWS, lists.grid.height - y) : 0;
    const float px = float(x) + 0.5f, py = float(y) + 0.5f;
    const int begin = lists.tile_begin[tile.list], end = lists.tile_end[tile.list];

    ForwardColumn<float, CH, COLUMN_ROWS> column;
    Instruments<float, COLUMN_ROWS> told;
    start_forward<TELL>(column, told, rows);
    int n_buckets = 0;
    for (int first = begin; first < end; first += WARP) {  // per 32 records
        if (!__any_sync(FULL_WARP, column.open)) break;
        if (CHECKPOINT) {
            float* here = checkpoint_of<CH>(lists, blend, tile.list, n_buckets, lane);
#pragma unroll
            for (int k = 0; k < COLUMN_ROWS; ++k) {
                here[k * WARP] = column.T[k];
                if (n_buckets == 0) continue;
                float* before = here - ptrdiff_t(1 + CH) * TILE_PIXELS;
#pragma unroll
                for (int c = 0; c < CH; ++c) {
                    before[(1 + c) * TILE_PIXELS + k * WARP] = column.color[k][c];
                    column.color[k][c] = 0.0f;
                }
            }
            ++n_buckets;
        }
        __syncwarp();
        if (first + lane < end) {
            const unsigned splat = lists.listed[first + lane];
            const Record record = load_record(blend.records, splat);
            staged[warp][lane][0] = record.a;
            staged[warp][lane][1] = record.b;
            staged[warp][lane][2] = record.c;
            if (TELL) staged_ids[warp][lane] = splat;
        }
        __syncwarp();
        const int count = min(WARP, end - first);
        for (int j = 0; j < count; ++j) {  // per record
            if (j % LOOK_EVERY == 0 && !__any_sync(FULL_WARP, column.open)) break;
            const Record record = {staged[warp][j][0], staged[warp][j][1], staged[warp][j][2]};
            float color[CH];
            record.color<CH>(color);
            const int id = TELL ? int(staged_ids[warp][j]) : 0;
            blend_forward<TELL>(column, told, record.splat(), color, id, px, py, first - begin + j, constants);
        }
    }
    if (CHECKPOINT) sum_from_the_back<CH>(lists, blend, tile.list, n_buckets, lane, column);

#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        if (k >= rows) break;
        const size_t pixel = size_t(y + k) * lists.grid.width + x;
#pragma unroll
        for (int c = 0; c < CH; ++c) {
            const float behind = blend.background == nullptr ? 0.0f : __ldg(blend.background + c);
            blend.image[CH * pixel + c] = fused(column.T[k], behind, column.color[k][c]);
        }
        blend.T_final[pixel] = column.T[k];
        blend.last[pixel] = column.last[k];
        if (TELL) {
            blend.dominant_ids[pixel] = told.best[k].id;
            blend.dominant_weights[pixel] = told.best[k].weight;
            blend.n_blended[pixel] = told.n_blended[k];
            blend.n_traversed[pixel] = told.n_traversed[k];
        }
    }
    if (TELL) {
        const bool masked = blend.masks != nullptr && !halted(blend.state);
        const uint8_t* mask = masked ? blend.masks[blend.state->view] : nullptr;
        // neighbours mostly agree on the winner: one integer addition a group of equal winners, in any order
#pragma unroll
        for (int k = 0; k < COLUMN_ROWS; ++k) {
            int id = k < rows ? told.best[k].id : -1;
            if (id >= 0 && mask != nullptr && mask[size_t(y + k) * lists.grid.width + x] == 0) id = -1;
            unsigned group = __match_any_sync(FULL_WARP, id);
            if (id >= 0 && lane == __ffs(group) - 1) atomicAdd(blend.dominant_counts + id, __popc(group));
        }
    }
}

template <int CH, bool TELL>
void launch(const TileLists& lists, const BlendForward& blend, const BlendConstants<float>& constants,
            cudaStream_t stream) {
    const int tiles = n_warp_tiles(lists.grid), blocks = blocks_for(tiles, WARPS_PER_BLOCK);
    const int threads = WARP * WARPS_PER_BLOCK;
    if (blend.checkpoints != nullptr)
        blend_forward_kernel<CH, TELL, true><<<blocks, threads, 0, stream>>>(lists, blend, constants, tiles);
    else
        blend_forward_kernel<CH, TELL, false><<<blocks, threads, 0, stream>>>(lists, blend, constants, tiles);
    POP_LAUNCHED("blend_forward_kernel");
}

template <int CH>
void launch(const TileLists& lists, const BlendForward& blend, const BlendConstants<float>& constants,
            cudaStream_t stream) {
    if (blend.dominant_ids != nullptr)
        launch<CH, true>(lists, blend, constants, stream);
    else
        launch<CH, false>(lists, blend, constants, stream);
}

}  // namespace

void blend_forward(const TileLists& lists, const BlendForward& blend, const Profile<float>& profile,
                   cudaStream_t stream) {
    const BlendConstants<float> constants = blend_constants(profile);
    switch (blend.channels) {
        case 1: return launch<1>(lists, blend, constants, stream);
        case 3: return launch<3>(lists, blend, constants, stream);
        case 4: return launch<4>(lists, blend, constants, stream);
        default: throw std::invalid_argument("blend_forward: channels must be 1, 3 or 4");
    }
}

}  // namespace pop
