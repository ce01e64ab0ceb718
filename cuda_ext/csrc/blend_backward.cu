// Blending transposed, in moment form, by two families that give the same sums.
//
// columns: one warp a tile of 16 x 8 pixels, back to front; a lane owns four pixels, eight lanes a quarter of the tile,
//     which leaves out what does not reach it. A splat's sums are added over the lanes through shared memory.
// splats: one warp a bucket of 32 list entries, back to front; a lane owns a splat and keeps its sums in registers, and
//     the tile's pixels travel through the lanes. Needs the forward pass's checkpoints.
//
// A row of sums goes to its instance's slot, by exactly one warp, so nothing is added in an order that varies; or, where
// memory is short, by atomic addition to the splat.
//
// Both are bounded by the issue of instructions: columns by four pixels a lane, about four fifths, and the sums over
// lanes; splats by what a pair costs and by the steps that fill and drain a warp. sum_slots is bounded by the latency of
// memory, a few rows a splat. Counts: benchmarks/NOTES.md, `make sass`.

#include "warp_sums.cuh"

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

// Entries behind every pixel's last splat have no gradient, but their slots are read. A lane clears rows; the slots of a
// list's last entries are asked for before it is known which of them are behind.
struct LastSlots {
    static constexpr int EACH = 4;
    unsigned slots[EACH];

    __device__ __forceinline__ LastSlots(const TileLists& lists, int begin, int end, int lane) {
#pragma unroll
        for (int j = 0; j < EACH; ++j)
            slots[j] = end > begin ? read_here(lists.slots[1] + max(end - 1 - lane - WARP * j, begin)) : 0u;
    }

    __device__ __forceinline__ void clear_from(const TileLists& lists, const BlendBackward& blend,
                                               const WarpTile& tile, int last, int end, int lane) const {
#pragma unroll
        for (int j = 0; j < EACH; ++j)
            if (end - 1 - lane - WARP * j >= last) clear(blend, tile, slots[j]);
        for (int entry = last + lane; entry < end - EACH * WARP; entry += WARP)  // per 32 unused entries
            clear(blend, tile, __ldg(lists.slots[1] + entry));
    }

    static __device__ __forceinline__ void clear(const BlendBackward& blend, const WarpTile& tile, unsigned slot) {
        float4* row = reinterpret_cast<float4*>(blend.rows + RECORD * (size_t(slot) * tile.parts + tile.part));
#pragma unroll
        for (int k = 0; k < RECORD / 4; ++k) row[k] = {0.0f, 0.0f, 0.0f, 0.0f};
    }
};

// Read what a lane's pixels start from; returns the end of the list for them.
template <int CH>
__device__ __forceinline__ int load_column(const TileLists& lists, const BlendBackward& blend, int x, int y,
                                           BackwardColumn<float, CH, COLUMN_ROWS>& column) {
    const int rows = x < lists.grid.width ? min(COLUMN_ROWS, lists.grid.height - y) : 0;
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
    return last;
}

// two warps a block: what a warp keeps in shared memory leaves room for twenty on a multiprocessor of sm_90
constexpr int SUM_WARPS = 2;

// the end of the list for a quarter's pixels: behind the last splat that one of them blends
struct QuarterEnds {
    int last[QUARTERS];

    // all lanes must come, each with its pixels' own
    __device__ __forceinline__ explicit QuarterEnds(int own) {
#pragma unroll
        for (int mask = QUARTER_LANES / 2; mask > 0; mask /= 2) own = max(own, __shfl_xor_sync(FULL_WARP, own, mask));
#pragma unroll
        for (int q = 0; q < QUARTERS; ++q) last[q] = __shfl_sync(FULL_WARP, own, q * QUARTER_LANES);
    }
    __device__ __forceinline__ int of_tile() const { return max(max(last[0], last[1]), max(last[2], last[3])); }
    __device__ __forceinline__ unsigned quarters_behind(int position) const {
        unsigned found = 0;
#pragma unroll
        for (int q = 0; q < QUARTERS; ++q) found |= position < last[q] ? 1u << q : 0u;
        return found;
    }
};

// a splat's sums over the tile: into the slot's row, or added to the splat's
template <bool ATOMIC, int CH, bool ABS>
__device__ __forceinline__ void put_row(const WarpSums<CH, ABS>& sums, int place, float* row) {
    constexpr int N = WarpSums<CH, ABS>::N;
#pragma unroll
    for (int k = 0; k < WarpSums<CH, ABS>::ROW; ++k) {
        const float4 total = sums.total(place, k);
        if (!ATOMIC) {
            reinterpret_cast<float4*>(row)[k] = total;
            continue;
        }
        const float values[4] = {total.x, total.y, total.z, total.w};
#pragma unroll
        for (int j = 0; j < 4; ++j)
            // most splats that reach a tile but none of its pixels have none
            if (4 * k + j < N && values[j] != 0.0f) atomicAdd(row + 4 * k + j, values[j]);
    }
}

template <int CH, bool ABS, bool PASS, bool ATOMIC>
__global__ void __launch_bounds__(WARP* SUM_WARPS, CH < 4 && !ABS ? 10 : 0)
    columns_kernel(TileLists lists, BlendBackward blend, BlendConstants<float> constants, int n_warp_tiles) {
    using Sums = WarpSums<CH, ABS>;
    __shared__ Sums sums_of_warps[SUM_WARPS];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int index = blockIdx.x * SUM_WARPS + warp;
    if (index >= n_warp_tiles) return;
    Sums& sums = sums_of_warps[warp];
    const WarpTile tile = warp_tile(lists, index);
    const int x = tile.x + lane_x(lane), y = tile.y + lane_y(lane);
    const float px = float(x) + 0.5f, py = float(y) + 0.5f;
    const int begin = lists.tile_begin[tile.list], end = lists.tile_end[tile.list];
    BackwardColumn<float, CH, COLUMN_ROWS> column;
    const LastSlots last_slots(lists, begin, ATOMIC ? begin : end, lane);
    const QuarterEnds ends(load_column(lists, blend, x, y, column));
    const int last = begin + ends.of_tile();
    // of the batch to come: a record waits for its number, and this only for the batch before
    unsigned next_splat = last > begin ? read_here(lists.listed + max(last - 1 - lane, begin)) : 0u;
    if (!ATOMIC) last_slots.clear_from(lists, blend, tile, last, end, lane);
    if (lane == 0) sums.batch.put(WARP, Record{});

    const unsigned* queue = sums.queues.words + Queues::WORDS * quarter_of(lane);
    for (int top = last; top > begin; top -= WARP) {  // per 32 records
        const int entry = top - 1 - lane;
        unsigned quarters = 0;
        float* row = nullptr;
        __syncwarp();
        const unsigned splat = next_splat;
        next_splat = read_here(lists.listed + max(entry - WARP, begin));
        if (entry >= begin) {
            const Record record = load_record(blend.records, splat);
            sums.batch.put(lane, record);
            row = ATOMIC ? blend.sums + size_t(RECORD) * splat : row_of(lists, blend, tile, entry);
            quarters = ends.quarters_behind(entry - begin) &
                       quarters_reached(record.splat(), float(tile.x) + 0.5f, float(tile.y) + 0.5f);
        }
        sums.clear_rows(lane);
        const int visits = make_queues(quarters, lane, sums.queues);
        for (int first = 0; first < visits; first += Sums::VISITS) {  // per 8 visits
            for (int j = 0; j < Sums::VISITS && first + j < visits; j += Queues::A_WORD) {  // per visit
                const unsigned places = queue[(first + j) / Queues::A_WORD];
#pragma unroll
                for (int g = 0; g < Queues::A_WORD; ++g) {
                    const int at = Queues::place(places, g);
                    const Record record = sums.batch.at(at);
                    float color[CH];
                    record.color<CH>(color);
                    ColumnSums<float, CH> of_column;
                    blend_backward<ABS, PASS>(column, record.splat(), color, add(record.a.x, -px), py,
                                              top - 1 - at - begin, constants, of_column);
                    sums.put(of_column, j + g, lane);
                }
            }
            __syncwarp();
            sums.add_up(first, lane, px - float(lane % QUARTER_LANES));
        }
        if (entry >= begin) put_row<ATOMIC>(sums, lane, row);
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

constexpr int SUM_BLOCK = 256, SPLATS = 4, AT_ONCE = 2;  // splats of a warp; rounds of 8 slots that are read at once
constexpr int PIECES = RECORD / 4, SLOTS = WARP / 4;     // float4 of a row; of a round
constexpr unsigned LONG = 128;                           // slots with which a splat is a block's

__device__ __forceinline__ void add(float4& total, const float4& v) {
    total = {total.x + v.x, total.y + v.y, total.z + v.z, total.w + v.w};
}

// the rows of a splat as a lane reads them: a piece of every eighth
struct SlotRows {
    const float4* rows;
    size_t begin, end;

    __device__ __forceinline__ SlotRows(const TileLists& lists, const BlendBackward& blend, int parts, unsigned first,
                                        unsigned count) {
        const int lane = threadIdx.x & (WARP - 1);
        const size_t most = size_t(lists.capacity) * parts, past = (size_t(first) + count) * parts;
        rows = reinterpret_cast<const float4*>(blend.rows) + (lane & 3);
        begin = size_t(first) * parts + lane / 4;
        end = (lane & 3) < PIECES ? (past < most ? past : most) : 0;
    }
    __device__ __forceinline__ float4 at(size_t row) const { return read_here(rows + PIECES * row, row < end); }
};

// over the eight lanes that have the same piece
__device__ __forceinline__ void sum_over_lanes(float4& total) {
#pragma unroll
    for (int mask = 4; mask < WARP; mask *= 2) {
        total.x += __shfl_xor_sync(FULL_WARP, total.x, mask);
        total.y += __shfl_xor_sync(FULL_WARP, total.y, mask);
        total.z += __shfl_xor_sync(FULL_WARP, total.z, mask);
        total.w += __shfl_xor_sync(FULL_WARP, total.w, mask);
    }
}

// The splats of a block that have many slots, all warps on one after the other: a warp alone would be waited for.
__device__ __forceinline__ void sum_long_splats(const TileLists& lists, const BlendBackward& blend, int parts) {
    constexpr int WARPS = SUM_BLOCK / WARP;
    static_assert(WARPS * SPLATS == WARP, "a lane asks for a splat of the block");
    __shared__ float4 of_warps[WARPS][PIECES];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP, first = blockIdx.x * WARP;
    const unsigned own = first + lane < lists.n ? lists.splat_count[first + lane] : 0u;
    for (unsigned left = __ballot_sync(FULL_WARP, own >= LONG); left; left &= left - 1) {
        const int splat = first + __ffs(int(left)) - 1;
        const SlotRows rows(lists, blend, parts, lists.splat_begin[splat], lists.splat_count[splat]);
        float4 total = {0.0f, 0.0f, 0.0f, 0.0f};
        const size_t end = rows.end;
#pragma unroll 1
        for (size_t row = rows.begin + SLOTS * warp; row < end; row += 4 * WARPS * SLOTS) {  // per 32 slots
            float4 read[4];
#pragma unroll
            for (int j = 0; j < 4; ++j) read[j] = rows.at(row + WARPS * SLOTS * j);
#pragma unroll
            for (int j = 0; j < 4; ++j) add(total, read[j]);
        }
        sum_over_lanes(total);
        if (lane < PIECES) of_warps[warp][lane] = total;
        __syncthreads();
        if (threadIdx.x < PIECES) {
            for (int k = 1; k < WARPS; ++k) add(total, of_warps[k][lane]);
            reinterpret_cast<float4*>(blend.sums)[PIECES * size_t(splat) + lane] = total;
        }
        __syncthreads();
    }
}

// One warp four splats: of each eight rows at a time, three float4 a row, added in a fixed order. Most splats have few
// rows, and what is waited for is where they lie and the first of them: so the first rounds of all four are asked for
// together.
__global__ void __launch_bounds__(SUM_BLOCK, 4) sum_slots_kernel(TileLists lists, BlendBackward blend, int parts) {
    const int first = (blockIdx.x * SUM_BLOCK + threadIdx.x) / WARP * SPLATS, lane = threadIdx.x & (WARP - 1);
    float4* sums = reinterpret_cast<float4*>(blend.sums) + PIECES * size_t(first);
    unsigned begin[SPLATS], count[SPLATS];
#pragma unroll
    for (int k = 0; k < SPLATS; ++k) {
        const int splat = min(first + k, lists.n - 1);
        begin[k] = read_here(lists.splat_begin + splat);
        count[k] = read_here(lists.splat_count + splat);
    }
    float4 read[SPLATS][AT_ONCE];
#pragma unroll
    for (int k = 0; k < SPLATS; ++k) {
        const SlotRows rows(lists, blend, parts, begin[k], count[k] < LONG ? count[k] : 0u);
#pragma unroll
        for (int j = 0; j < AT_ONCE; ++j) read[k][j] = rows.at(rows.begin + SLOTS * j);
    }
#pragma unroll
    for (int k = 0; k < SPLATS; ++k) {
        float4 total = read[k][0];
#pragma unroll
        for (int j = 1; j < AT_ONCE; ++j) add(total, read[k][j]);
        if (count[k] >= LONG) continue;
        if (count[k] > 0) {
            const SlotRows rows(lists, blend, parts, begin[k], count[k]);
#pragma unroll 1
            for (size_t row = rows.begin + AT_ONCE * SLOTS; row < rows.end; row += AT_ONCE * SLOTS) {  // per 16 slots
                float4 next[AT_ONCE];
#pragma unroll
                for (int j = 0; j < AT_ONCE; ++j) next[j] = rows.at(row + SLOTS * j);
#pragma unroll
                for (int j = 0; j < AT_ONCE; ++j) add(total, next[j]);
            }
            sum_over_lanes(total);
        }
        if (first + k < lists.n && lane < PIECES) sums[PIECES * k + lane] = total;
    }
    sum_long_splats(lists, blend, parts);
}

template <int CH, bool ABS, bool PASS, bool ATOMIC>
void launch(const TileLists& lists, const BlendBackward& blend, const BlendConstants<float>& constants,
            const DeviceState* state, cudaStream_t stream) {
    const int threads = WARP * WARPS_PER_BLOCK;
    if (blend.backward == Backward::pixel_parallel) {
        const int tiles = n_warp_tiles(lists.grid);
        columns_kernel<CH, ABS, PASS, ATOMIC>
            <<<blocks_for(tiles, SUM_WARPS), WARP * SUM_WARPS, 0, stream>>>(lists, blend, constants, tiles);
        POP_LAUNCHED("columns_kernel");
    } else {
        const int buckets = lists.capacity / WARP + lists.n_tiles;
        splats_kernel<CH, ABS, PASS, ATOMIC>
            <<<blocks_for(buckets, WARPS_PER_BLOCK), threads, 0, stream>>>(lists, blend, constants, state);
        POP_LAUNCHED("splats_kernel");
    }
    if (!ATOMIC && lists.n > 0) {
        const int parts = (lists.grid.tile_w / WARP_TILE_W) * (lists.grid.tile_h / WARP_TILE_H);
        const long long warps = (lists.n + SPLATS - 1) / SPLATS;
        sum_slots_kernel<<<blocks_for(warps * WARP, SUM_BLOCK), SUM_BLOCK, 0, stream>>>(lists, blend, parts);
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
