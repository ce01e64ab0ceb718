// Blending, front to back: one warp a tile of 16 x 8 pixels, a lane owns a column of four, and eight lanes a quarter of
// the tile, which leaves out what does not reach it. No barrier crosses a warp.
//
// Bounded by the issue of instructions: a record is read from shared memory by eight lanes at once, and what is left is
// arithmetic on registers, half of it multiplications and additions. Next to it stands the special function unit, which
// takes eight cycles for the exponentials of a warp. Counts: benchmarks/NOTES.md, `make sass`.

#include "quarters.cuh"

namespace pop {

namespace {

// visits between two looks at whether any pixel of the warp still takes splats
constexpr int GROUP = Queues::A_WORD;

// Where a lane's pixels keep what the gaussian_parallel backward reads of a bucket: T before it, then the colour that later buckets
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

// blocks that must fit a multiprocessor at a time: as many as leave every value its register
constexpr int least_blocks(int channels, Collect collect, bool checkpoint) {
    return (collect == Collect::nothing ? 7 : 6) - checkpoint - (channels == MAX_CHANNELS);
}

template <int CH, Collect COLLECT, bool CHECKPOINT>
__global__ void __launch_bounds__(WARP* WARPS_PER_BLOCK, least_blocks(CH, COLLECT, CHECKPOINT))
    blend_forward_kernel(TileLists lists, BlendForward blend, BlendConstants<float> constants, int n_warp_tiles) {
    __shared__ Batch batches[WARPS_PER_BLOCK];
    __shared__ Queues queues[WARPS_PER_BLOCK];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int index = blockIdx.x * WARPS_PER_BLOCK + warp;
    if (index >= n_warp_tiles) return;
    const WarpTile tile = warp_tile(lists, index);
    const int x = tile.x + lane_x(lane), y = tile.y + lane_y(lane);
    const int rows = x < lists.grid.width ? min(COLUMN_ROWS, lists.grid.height - y) : 0;
    const float px = float(x) + 0.5f, py = float(y) + 0.5f;
    const int begin = lists.tile_begin[tile.list], end = lists.tile_end[tile.list];

    ForwardColumn<float, CH, COLUMN_ROWS> column;
    RenderStats<float, COLUMN_ROWS> stats;
    start_forward<COLLECT>(column, stats, rows);
    const Batch* batch = pinned_shared(batches + warp);
    const unsigned* queue = queues[warp].words + Queues::WORDS * quarter_of(lane);
    if (lane == 0) batches[warp].put(WARP, Record{});
    int n_buckets = 0;
    for (int first = begin; first < end; first += WARP) {  // per 32 records
        const unsigned open = quarters_with(is_open(column, constants.stop));
        if (open == 0) break;
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
        unsigned quarters = 0;
        if (first + lane < end) {
            const Record record = load_record(blend.records, lists.listed[first + lane]);
            batches[warp].put(lane, record);
            // where splats are counted, those that are only passed count too
            quarters = COLLECT == Collect::everything
                           ? open
                           : open & quarters_reached(record.splat(), float(tile.x) + 0.5f, float(tile.y) + 0.5f);
        }
        const int visits = make_queues(quarters, lane, queues[warp]);
        for (int j = 0; j < visits; j += GROUP) {  // per visit
            if (!__any_sync(FULL_WARP, is_open(column, constants.stop))) break;
            const unsigned places = queue[j / GROUP];
#pragma unroll
            for (int g = 0; g < GROUP; ++g) {
                const int at = Queues::place(places, g);
                const Record record = batch->at(at);
                float color[CH];
                record.color<CH>(color);
                // a pixel's winner is known by its place in the list until all are blended
                const int place = first - begin + at;
                blend_forward<COLLECT>(column, stats, record.splat(), color, place, px, py, place, constants);
            }
        }
        // a pixel that is open has passed the whole batch, also what never reached it
#pragma unroll
        for (int k = 0; k < COLUMN_ROWS; ++k)
            if (column.T[k] > constants.stop) column.last[k] = first - begin + WARP;
    }
    if (CHECKPOINT) sum_from_the_back<CH>(lists, blend, tile.list, n_buckets, lane, column);

#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        if (k >= rows) break;
        const size_t pixel = size_t(y + k) * lists.grid.width + x;
        const float T = column.T_final[k];
#pragma unroll
        for (int c = 0; c < CH; ++c) {
            const float behind = blend.background == nullptr ? 0.0f : __ldg(blend.background + c);
            blend.image[CH * pixel + c] = fused(T, behind, column.color[k][c]);
        }
        blend.T_final[pixel] = T;
        blend.last[pixel] = min(column.last[k], end - begin);
        if (COLLECT != Collect::nothing) {
            if (stats.best[k].id >= 0) stats.best[k].id = int(lists.listed[begin + stats.best[k].id]);
            blend.dominant_ids[pixel] = stats.best[k].id;
            blend.dominant_weights[pixel] = stats.best[k].weight;
        }
        if (COLLECT == Collect::everything) {
            blend.n_blended[pixel] = stats.n_blended[k];
            blend.n_traversed[pixel] = min(column.last[k] + 1, end - begin);
        }
    }
    if (COLLECT != Collect::nothing) {
        const bool masked = blend.masks != nullptr && !halted(blend.state);
        const uint8_t* mask = masked ? blend.masks[blend.state->view] : nullptr;
        // neighbours mostly agree on the winner: one integer addition a group of equal winners, in any order
#pragma unroll
        for (int k = 0; k < COLUMN_ROWS; ++k) {
            int id = k < rows ? stats.best[k].id : -1;
            if (id >= 0 && mask != nullptr && mask[size_t(y + k) * lists.grid.width + x] == 0) id = -1;
            unsigned group = __match_any_sync(FULL_WARP, id);
            if (id >= 0 && lane == __ffs(group) - 1) atomicAdd(blend.dominant_counts + id, __popc(group));
        }
    }
}

template <int CH, Collect COLLECT>
void launch(const TileLists& lists, const BlendForward& blend, const BlendConstants<float>& constants,
            cudaStream_t stream) {
    const int tiles = n_warp_tiles(lists.grid), blocks = blocks_for(tiles, WARPS_PER_BLOCK);
    const int threads = WARP * WARPS_PER_BLOCK;
    if (blend.checkpoints != nullptr)
        blend_forward_kernel<CH, COLLECT, true><<<blocks, threads, 0, stream>>>(lists, blend, constants, tiles);
    else
        blend_forward_kernel<CH, COLLECT, false><<<blocks, threads, 0, stream>>>(lists, blend, constants, tiles);
    POP_LAUNCHED("blend_forward_kernel");
}

template <int CH>
void launch(const TileLists& lists, const BlendForward& blend, const BlendConstants<float>& constants,
            cudaStream_t stream) {
    if (blend.dominant_ids == nullptr)
        launch<CH, Collect::nothing>(lists, blend, constants, stream);
    else if (blend.n_blended == nullptr)
        launch<CH, Collect::dominant>(lists, blend, constants, stream);
    else
        launch<CH, Collect::everything>(lists, blend, constants, stream);
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
