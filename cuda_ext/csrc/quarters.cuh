// The four quarters of a warp's tile, 8 x 4 pixels to eight lanes each. A splat of the tile's list that does not reach
// a quarter is left out there: every quarter goes through its own queue of a batch, all four in the same instructions,
// so that a warp makes as many visits as the longest queue has splats, rounded up to four. In the case that times are
// predicted for these are 77 for 100 entries, and queues take about 8 of the 79 instructions an entry of the forward
// pass. Both are counted by benchmarks/gpu_visits.py and `make sass`.
//
// What is left out blends nothing and has no gradient, so that no bit depends on it.
#pragma once

#include "kernel_tools.cuh"

namespace pop {

constexpr int QUARTERS = 4, QUARTER_LANES = WARP / QUARTERS, QUARTER_W = 8, QUARTER_H = COLUMN_ROWS;
static_assert(QUARTER_LANES == QUARTER_W && 2 * QUARTER_W == WARP_TILE_W && 2 * QUARTER_H == WARP_TILE_H,
              "a quarter is a row of columns");

// places in a batch of 32, four to a word; WARP stands behind the last one: a splat of zeros
struct Queues {
    static constexpr int A_WORD = 4, WORDS = WARP / A_WORD;
    unsigned words[QUARTERS * WORDS];

    __device__ __forceinline__ unsigned char* bytes(int quarter) {
        return reinterpret_cast<unsigned char*>(words + WORDS * quarter);
    }
    static __device__ __forceinline__ int place(unsigned word, int k) { return (word >> 8 * k) & 0xffu; }
};

// a batch of records, and what is read where a queue has ended
struct Batch {
    float4 records[WARP + 1][RECORD / 4];

    __device__ __forceinline__ void put(int at, const Record& record) {
        records[at][0] = record.a;
        records[at][1] = record.b;
        records[at][2] = record.c;
    }
    __device__ __forceinline__ Record at(int place) const {
        return {records[place][0], records[place][1], records[place][2]};
    }
};

// The least exponent that a pixel of a box can have, or a little less, where one offset is that of the side nearest to
// the splat's centre; the other is where the exponent is least, at `free`, as far as the box allows.
__device__ __forceinline__ float least_exponent(float fixed_square, float cross, float half_free, float free, float low,
                                                float high) {
    const float offset = fminf(fmaxf(free, low), high);
    const float squares = fused(mul(half_free, offset), offset, fixed_square);
    return fused(cross, offset, squares) - 2.0f * float(TILE_SLACK_SHARE) * squares;
}

// The quarters that a splat can reach, a bit each; x, y: the centre of the tile's first pixel. The exponent is convex:
// outside a box its least value lies on an edge that faces the splat's centre.
__device__ __forceinline__ unsigned quarters_reached(const PackedSplat<float>& s, float x, float y) {
    const float limit = s.beyond + 2.0f * float(TILE_SLACK);
    const float free_y = -s.B * reciprocal(2.0f * s.hC), free_x = -s.B * reciprocal(2.0f * s.hA);
    unsigned reached = 0;
#pragma unroll
    for (int across = 0; across < 2; ++across) {
        const float right = s.x - x - float(QUARTER_W * across), left = right - float(QUARTER_W - 1);
        const float dx = fminf(fmaxf(0.0f, left), right), square_x = s.hA * dx * dx, cross_x = s.B * dx;
#pragma unroll
        for (int down = 0; down < 2; ++down) {
            const float low = s.y - y - float(QUARTER_H * down), high = low - float(QUARTER_H - 1);
            const float dy = fminf(fmaxf(0.0f, high), low);
            const float on_x = least_exponent(square_x, cross_x, s.hC, free_y * dx, high, low);
            const float on_y = least_exponent(s.hC * dy * dy, s.B * dy, s.hA, free_x * dy, left, right);
            // what is not a number stays in
            if (!(fminf(on_x, on_y) > limit)) reached |= 1u << (2 * down + across);
        }
    }
    return s.beyond > 0.0f ? reached : 0u;
}

__device__ __forceinline__ int quarter_of(int lane) { return lane / QUARTER_LANES; }

// a bit for every quarter of which a lane votes
__device__ __forceinline__ unsigned quarters_with(bool vote) {
    const unsigned lanes = __ballot_sync(FULL_WARP, vote);
    unsigned found = 0;
#pragma unroll
    for (int q = 0; q < QUARTERS; ++q)
        if ((lanes >> QUARTER_LANES * q) & ((1u << QUARTER_LANES) - 1u)) found |= 1u << q;
    return found;
}

// Queue up the splat of every lane in the quarters of its bits, in the order of the lanes; returns how many visits the
// longest queue takes. All lanes must call it; the batch may be read afterwards.
__device__ __forceinline__ int make_queues(unsigned quarters, int lane, Queues& queues) {
    static_assert(QUARTERS * Queues::WORDS == WARP, "a lane empties a word");
    __syncwarp();
    queues.words[lane] = 0x01010101u * unsigned(WARP);
    __syncwarp();
    int longest = 0;
#pragma unroll
    for (int q = 0; q < QUARTERS; ++q) {
        const bool reached = (quarters >> q) & 1u;
        const unsigned lanes = __ballot_sync(FULL_WARP, reached);
        if (reached) queues.bytes(q)[__popc(lanes & ((1u << lane) - 1u))] = (unsigned char)(lane);
        longest = max(longest, __popc(lanes));
    }
    __syncwarp();
    return longest;
}

}  // namespace pop
