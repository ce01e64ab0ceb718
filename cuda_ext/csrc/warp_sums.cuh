// How a warp of the backward pass adds up a splat's sums over its lanes: through shared memory, for eight visits at once.
//
// A lane leaves the sums of its column, and goes on. After eight visits every lane takes one quarter of one of them and
// adds eight columns up, one after the other, so that 32 sums are made by the instructions of one: 28 a visit, where a
// butterfly of shuffles took 46 a record. A splat's quarters are added in pairs, left and right, which two numbers do in
// either order: no bit depends on the visit in which a quarter met the splat.
//
// A warp keeps 11 KB, so that 20 of them fit a multiprocessor of sm_90 and 14 one of sm_80. Four pixels a lane are in
// flight at a time, which takes the place of more warps.
#pragma once

#include "quarters.cuh"

namespace pop {

template <int CH, bool ABS>
struct WarpSums {
    static constexpr int VISITS = QUARTER_LANES;  // between two calls of add_up
    static constexpr int N = SumsOf<CH, ABS>::count, ROW = (N + 3) / 4;
    // a column's sums, in pieces of four and, of what is left, one or two
    static constexpr int COLUMN = CH + (ABS ? 5 : 3), QUADS = (COLUMN + 1) / 4, PAIR = COLUMN > 4 * QUADS;
    static constexpr int PADDED = 4 * QUADS + 2 * PAIR;

    Batch batch;
    Queues queues;
    float4 quads[QUADS][VISITS][WARP];
    float2 pairs[PAIR ? VISITS : 1][PAIR ? WARP : 1];
    float4 rows[2][WARP][RECORD / 4];  // of the left quarters and of the right

    __device__ __forceinline__ void clear_rows(int lane) {
#pragma unroll
        for (int side = 0; side < 2; ++side)
#pragma unroll
            for (int k = 0; k < ROW; ++k) rows[side][lane][k] = {0.0f, 0.0f, 0.0f, 0.0f};
    }

    // A lane's column of a visit. One column of eight visits is read at a time: these stand in different banks.
    __device__ __forceinline__ void put(const ColumnSums<float, CH>& sums, int visit, int lane) {
        float v[PADDED] = {};
#pragma unroll
        for (int c = 0; c < CH; ++c) v[c] = sums.v_color[c];
        v[CH] = sums.m0;
        v[CH + 1] = sums.my;
        v[CH + 2] = sums.myy;
        if constexpr (ABS) {
            v[CH + 3] = sums.abs_x;
            v[CH + 4] = sums.abs_y;
        }
        const int at = lane ^ visit;
#pragma unroll
        for (int k = 0; k < QUADS; ++k) quads[k][visit][at] = {v[4 * k], v[4 * k + 1], v[4 * k + 2], v[4 * k + 3]};
        if constexpr (PAIR) pairs[visit][at] = {v[4 * QUADS], v[4 * QUADS + 1]};
    }

    __device__ __forceinline__ ColumnSums<float, CH> get(int visit, int at) const {
        float v[PADDED];
#pragma unroll
        for (int k = 0; k < QUADS; ++k) {
            const float4 quad = quads[k][visit][at];
            v[4 * k] = quad.x;
            v[4 * k + 1] = quad.y;
            v[4 * k + 2] = quad.z;
            v[4 * k + 3] = quad.w;
        }
        if constexpr (PAIR) {
            const float2 pair = pairs[visit][at];
            v[4 * QUADS] = pair.x;
            v[4 * QUADS + 1] = pair.y;
        }
        ColumnSums<float, CH> sums = {};
#pragma unroll
        for (int c = 0; c < CH; ++c) sums.v_color[c] = v[c];
        sums.m0 = v[CH];
        sums.my = v[CH + 1];
        sums.myy = v[CH + 2];
        if constexpr (ABS) {
            sums.abs_x = v[CH + 3];
            sums.abs_y = v[CH + 4];
        }
        return sums;
    }

    // Add up the eight visits from `first` of the queues; x: the first column of this lane's quarter, px. All lanes must
    // call it, after __syncwarp, and may put the next visits afterwards.
    __device__ __forceinline__ void add_up(int first, int lane, float x) {
        const int quarter = quarter_of(lane), visit = lane % VISITS, place = queues.bytes(quarter)[first + visit];
        const float dx = batch.records[place][0].x - x;
        float sums[4 * ROW] = {};
#pragma unroll
        for (int column = 0; column < QUARTER_W; ++column) {
            float of_column[N];
            sums_of_column<ABS>(get(visit, lane ^ column), dx - float(column), of_column);
#pragma unroll
            for (int k = 0; k < N; ++k) sums[k] = column == 0 ? of_column[k] : sums[k] + of_column[k];
        }
#pragma unroll
        for (int down = 0; down < 2; ++down) {
            if (quarter / 2 == down && place < WARP) add_row(rows[quarter % 2][place], sums);
            __syncwarp();
        }
    }

    static __device__ __forceinline__ void add_row(float4 (&row)[RECORD / 4], const float (&sums)[4 * ROW]) {
#pragma unroll
        for (int k = 0; k < ROW; ++k) {
            const float4 v = row[k];
            row[k] = {v.x + sums[4 * k], v.y + sums[4 * k + 1], v.z + sums[4 * k + 2], v.w + sums[4 * k + 3]};
        }
    }

    __device__ __forceinline__ float4 total(int place, int k) const {
        const float4 left = rows[0][place][k], right = rows[1][place][k];
        return {left.x + right.x, left.y + right.y, left.z + right.z, left.w + right.w};
    }
};

}  // namespace pop
