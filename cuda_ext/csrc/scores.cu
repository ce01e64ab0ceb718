// Passes over a blended view: sums over the pixels of every splat, and the points that pixels belong to. One warp a tile
// of 16 x 8 pixels, a lane owns a column of four, as in the blend, whose last[] and T_final[] say where pixels stopped.
//
// A row of sums goes to its instance's slot, by exactly one warp, and a warp a splat adds its rows up in double in the
// order of the slots, so nothing is added in an order that varies.

#include "kernel_tools.cuh"
#include "scores.cuh"

namespace pop {

namespace {

// a warp's tile, and the column that a lane owns
struct Column {
    WarpTile tile;
    int x, y, rows;  // px; pixels inside the image
    float px, py;
    int begin, last;  // of the list; behind the last splat that any pixel of the warp blends
    int own_last[COLUMN_ROWS];
};

__device__ __forceinline__ size_t pixel_of(const TileGrid& grid, const Column& column, int k) {
    return size_t(column.y + k) * grid.width + column.x;
}

__device__ __forceinline__ Column column_of(const TileLists& lists, const ScoreArrays& scores, int index, int lane) {
    Column column;
    column.tile = warp_tile(lists, index);
    column.x = column.tile.x + lane_x(lane);
    column.y = column.tile.y + lane_y(lane);
    column.rows = column.x < lists.grid.width ? min(COLUMN_ROWS, lists.grid.height - column.y) : 0;
    column.px = float(column.x) + 0.5f;
    column.py = float(column.y) + 0.5f;
    column.begin = lists.tile_begin[column.tile.list];
    int last = 0;
#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        column.own_last[k] = k < column.rows ? scores.last[pixel_of(lists.grid, column, k)] : 0;
        last = max(last, column.own_last[k]);
    }
    column.last = warp_max(last);
    return column;
}

template <int N>
constexpr int pitch_of() {
    return N == 1 ? 1 : N <= 4 ? 4 : WARP;
}

// Add the lanes' sums of one entry up and write its row.
template <int N>
__device__ __forceinline__ void write_row(const TileLists& lists, const ScoreArrays& scores, const Column& column,
                                          int place, float (&sums)[N], int lane, int own_sum) {
    const float total = TransposedSum<N, WARP / 2>::of(sums, lane);
    if (own_sum < 0) return;
    const size_t row = size_t(lists.slots[1][column.begin + place]) * column.tile.parts + column.tile.part;
    scores.rows[pitch_of<N>() * row + own_sum] = total;
}

// Calls visit(place in the list, splat, its colour) for the splats of the warp's list up to column.last, nearest first
// or farthest first; all lanes come along.
template <int CH, bool BACK, class Visit>
__device__ __forceinline__ void each_splat(const TileLists& lists, const ScoreArrays& scores, const Column& column,
                                           float4 (&staged)[WARP][RECORD / 4], int lane, Visit visit) {
    for (int first = 0; first < column.last; first += WARP) {  // per 32 records
        const int count = min(WARP, column.last - first);
        __syncwarp();
        if (lane < count) {
            const int place = BACK ? column.last - 1 - first - lane : first + lane;
            const Record record = load_record(scores.records, lists.listed[column.begin + place]);
            staged[lane][0] = record.a;
            staged[lane][1] = record.b;
            staged[lane][2] = record.c;
        }
        __syncwarp();
        for (int j = 0; j < count; ++j) {  // per record
            const Record record = {staged[j][0], staged[j][1], staged[j][2]};
            float color[CH];
            record.color<CH>(color);
            visit(BACK ? column.last - 1 - first - j : first + j, record.splat(), color);
        }
    }
}

__global__ void __launch_bounds__(WARP* WARPS_PER_BLOCK)
    contributions_kernel(TileLists lists, ScoreArrays scores, BlendConstants<float> constants, int n_warp_tiles) {
    __shared__ float4 staged[WARPS_PER_BLOCK][WARP][RECORD / 4];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int index = blockIdx.x * WARPS_PER_BLOCK + warp;
    if (index >= n_warp_tiles) return;
    const Column column = column_of(lists, scores, index, lane);
    const int own_sum = sum_index<N_CONTRIBUTIONS, WARP / 2>(lane);
    float T[COLUMN_ROWS], map[COLUMN_ROWS];
#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        T[k] = 1.0f;
        const bool given = scores.pixel_map != nullptr && k < column.rows;
        map[k] = given ? scores.pixel_map[pixel_of(lists.grid, column, k)] : 0.0f;
    }
    each_splat<1, false>(lists, scores, column, staged[warp], lane, [&](int place, PackedSplat<float> splat, const float*) {
        float sums[N_CONTRIBUTIONS] = {};
        const float dx = add(splat.x, -column.px);
        bool any = false;
#pragma unroll
        for (int k = 0; k < COLUMN_ROWS; ++k) {
            const float dy = add(splat.y, -(column.py + float(k)));
            const float alpha = alpha_at_pixel(splat, dx, dy, constants.ceiling).alpha;
            if (place >= column.own_last[k] || !(alpha > 0.0f)) continue;
            add_contribution(sums, mul(T[k], alpha), map[k], dx, dy);
            T[k] = fused(-alpha, T[k], T[k]);
            any = true;
        }
        if (__any_sync(FULL_WARP, any))
            write_row<N_CONTRIBUTIONS>(lists, scores, column, place, sums, lane, own_sum);
    });
}

// CH = 1: sensitivities, of the summed channels. CH = 3: moments. PASS: what is clamped lets the gradient through (B3).
template <int CH, bool PASS>
__global__ void __launch_bounds__(WARP* WARPS_PER_BLOCK)
    slopes_kernel(TileLists lists, ScoreArrays scores, BlendConstants<float> constants, int n_warp_tiles) {
    constexpr int N = CH == 1 ? N_SENSITIVITIES : N_SCREEN_MOMENTS;
    __shared__ float4 staged[WARPS_PER_BLOCK][WARP][RECORD / 4];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int index = blockIdx.x * WARPS_PER_BLOCK + warp;
    if (index >= n_warp_tiles) return;
    const Column column = column_of(lists, scores, index, lane);
    const int own_sum = sum_index<N, WARP / 2>(lane);
    Returning<float, CH> pixels[COLUMN_ROWS];
#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        pixels[k].T = k < column.rows ? scores.T_final[pixel_of(lists.grid, column, k)] : 1.0f;
#pragma unroll
        for (int c = 0; c < CH; ++c) pixels[k].suffix_color[c] = __ldg(scores.background + c);
    }
    each_splat<CH, true>(lists, scores, column, staged[warp], lane, [&](int place, PackedSplat<float> splat,
                                                                       const float* color) {
        float sums[N] = {};
        const float dx = add(splat.x, -column.px);
        bool any = false;
#pragma unroll
        for (int k = 0; k < COLUMN_ROWS; ++k) {
            const float dy = add(splat.y, -(column.py + float(k)));
            const PixelAlpha<float> at = alpha_at_pixel(splat, dx, dy, constants.ceiling);
            if (place >= column.own_last[k] || !(at.alpha > 0.0f)) continue;
            float more[CH];
            const float T = go_before(pixels[k], at.alpha, color, more);
            any = true;
            if constexpr (CH == 1) {
                const float slope = T * more[0];
                sums[0] += slope * slope;
            } else {
                float G[CH];
#pragma unroll
                for (int c = 0; c < CH; ++c)
                    G[c] = exponent_cotangent<PASS>(at.unclamped, constants.ceiling, T * at.alpha, T, more[c]);
                add_moments(sums, splat, dx, dy, T * at.alpha, G);
            }
        }
        if (__any_sync(FULL_WARP, any)) write_row<N>(lists, scores, column, place, sums, lane, own_sum);
    });
}

// The entry of the largest weight among those that are densest ahead of the camera (D8); records carry g as the colour.
__global__ void __launch_bounds__(WARP* WARPS_PER_BLOCK)
    points_kernel(TileLists lists, ScoreArrays scores, BlendConstants<float> constants, int n_warp_tiles) {
    __shared__ float4 staged[WARPS_PER_BLOCK][WARP][RECORD / 4];
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    const int index = blockIdx.x * WARPS_PER_BLOCK + warp;
    if (index >= n_warp_tiles) return;
    const Column column = column_of(lists, scores, index, lane);
    const float across = (column.px - scores.cx) / scores.fx;
    float T[COLUMN_ROWS];
    Dominant<float> best[COLUMN_ROWS];
#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k) {
        T[k] = 1.0f;
        best[k] = no_dominant<float>();
    }
    each_splat<3, false>(lists, scores, column, staged[warp], lane, [&](int place, PackedSplat<float> splat,
                                                                       const float* g) {
        const float dx = add(splat.x, -column.px);
#pragma unroll
        for (int k = 0; k < COLUMN_ROWS; ++k) {
            const float py = column.py + float(k);
            const float alpha = alpha_at_pixel(splat, dx, add(splat.y, -py), constants.ceiling).alpha;
            if (place >= column.own_last[k] || !(alpha > 0.0f)) continue;
            if (densest_ahead(g, across, (py - scores.cy) / scores.fy)) compete(best[k], place, mul(T[k], alpha));
            T[k] = fused(-alpha, T[k], T[k]);
        }
    });
#pragma unroll
    for (int k = 0; k < COLUMN_ROWS; ++k)
        if (k < column.rows)
            scores.ids[pixel_of(lists.grid, column, k)] =
                best[k].id < 0 ? -1 : int(lists.listed[column.begin + best[k].id]);
}

// One warp a splat: a lane adds up one column of every WARP / PITCH-th row, then rows are joined in a fixed order.
template <int N>
__global__ void add_rows_kernel(TileLists lists, ScoreArrays scores, int parts) {
    constexpr int PITCH = pitch_of<N>();
    const int splat = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, lane = threadIdx.x & (WARP - 1);
    if (splat >= lists.n) return;
    const size_t begin = size_t(lists.splat_begin[splat]) * parts, count = size_t(lists.splat_count[splat]) * parts;
    // where nothing is listed, nobody has written the two
    const size_t most = size_t(lists.capacity) * parts, end = begin + count < most ? begin + count : most;
    const int column = lane % PITCH;
    double total = 0.0;
    if (column < N)
        for (size_t row = begin + lane / PITCH; row < end; row += WARP / PITCH)  // per row
            total += double(scores.rows[PITCH * row + column]);
#pragma unroll
    for (int mask = PITCH; mask < WARP; mask *= 2) total += __shfl_xor_sync(FULL_WARP, total, mask);
    if (lane < N) scores.totals[size_t(N) * splat + lane] = total;
}

template <int N>
void add_rows(const TileLists& lists, const ScoreArrays& scores, cudaStream_t stream) {
    if (lists.n == 0) return;
    const int parts = warp_tiles_of_a_list(lists.grid);
    add_rows_kernel<N><<<blocks_for((long long)(lists.n) * WARP, 256), 256, 0, stream>>>(lists, scores, parts);
    POP_LAUNCHED("add_rows_kernel");
}

struct Launch {
    int tiles, blocks, threads;
};

Launch launch_of(const TileLists& lists) {
    const int tiles = n_warp_tiles(lists.grid);
    return {tiles, blocks_for(tiles, WARPS_PER_BLOCK), WARP * WARPS_PER_BLOCK};
}

template <int CH, bool PASS>
void slopes(const TileLists& lists, const ScoreArrays& scores, const BlendConstants<float>& constants,
            cudaStream_t stream) {
    const Launch at = launch_of(lists);
    slopes_kernel<CH, PASS><<<at.blocks, at.threads, 0, stream>>>(lists, scores, constants, at.tiles);
    POP_LAUNCHED("slopes_kernel");
    add_rows<CH == 1 ? N_SENSITIVITIES : N_SCREEN_MOMENTS>(lists, scores, stream);
}

}  // namespace

int score_columns(Score score) {
    switch (score) {
        case Score::contributions: return N_CONTRIBUTIONS;
        case Score::sensitivities: return N_SENSITIVITIES;
        case Score::moments: return N_SCREEN_MOMENTS;
        default: return 0;
    }
}

int score_pitch(Score score) {
    switch (score) {
        case Score::contributions: return pitch_of<N_CONTRIBUTIONS>();
        case Score::sensitivities: return pitch_of<N_SENSITIVITIES>();
        case Score::moments: return pitch_of<N_SCREEN_MOMENTS>();
        default: return 0;
    }
}

void score_view(const TileLists& lists, const ScoreArrays& scores, Score score, const Profile<float>& profile,
                cudaStream_t stream) {
    const BlendConstants<float> constants = blend_constants(profile);
    const Launch at = launch_of(lists);
    switch (score) {
        case Score::contributions:
            contributions_kernel<<<at.blocks, at.threads, 0, stream>>>(lists, scores, constants, at.tiles);
            POP_LAUNCHED("contributions_kernel");
            return add_rows<N_CONTRIBUTIONS>(lists, scores, stream);
        case Score::sensitivities: return slopes<1, false>(lists, scores, constants, stream);
        case Score::moments:
            return profile.pass_ceiling ? slopes<3, true>(lists, scores, constants, stream)
                                        : slopes<3, false>(lists, scores, constants, stream);
        case Score::points:
            points_kernel<<<at.blocks, at.threads, 0, stream>>>(lists, scores, constants, at.tiles);
            POP_LAUNCHED("points_kernel");
            return;
    }
    throw std::invalid_argument("score_view: there is no such score");
}

}  // namespace pop
