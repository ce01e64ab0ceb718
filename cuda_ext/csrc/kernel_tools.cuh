// What several kernels share: packed splats, the warp's tile, sums over a warp.
#pragma once

#include <limits.h>

#include "compositing.cuh"
#include "launch.h"

namespace pop {

constexpr unsigned FULL_WARP = 0xffffffffu;
constexpr int WARP = 32, COLUMN_ROWS = 4, WARPS_PER_BLOCK = 4;
static_assert(WARP * COLUMN_ROWS == TILE_PIXELS, "a lane owns a column of four pixels");

// a record: x, y, hA, B | hC, opacity, reach, c0 | c1, c2, c3, unused
struct Record {
    float4 a, b, c;

    __device__ __forceinline__ Blended<float> splat() const { return {a.x, a.y, a.z, a.w, b.x, b.y, b.z}; }

    template <int CH>
    __device__ __forceinline__ void color(float* out) const {
        const float all[MAX_CHANNELS] = {b.w, c.x, c.y, c.z};
#pragma unroll
        for (int k = 0; k < CH; ++k) out[k] = all[k];
    }
};

__device__ __forceinline__ Record load_record(const float* records, unsigned splat) {
    const float4* row = reinterpret_cast<const float4*>(records + size_t(RECORD) * splat);
    return {__ldg(row), __ldg(row + 1), __ldg(row + 2)};
}

// where a warp's 16 x 8 pixels lie, and the list that covers them
struct WarpTile {
    int x, y;       // px, its corner
    int list;       // tile of the lists' grid
    int part, parts;  // which of the warp tiles of that list tile this is
};

// of whole list tiles, also where they stick out of the image: every part of a list's gradient slots has its warp
__device__ __forceinline__ int warp_tiles_x(const TileGrid& grid) { return grid.tiles_x * (grid.tile_w / WARP_TILE_W); }

inline int n_warp_tiles(const TileGrid& grid) {
    return grid.tiles_x * (grid.tile_w / WARP_TILE_W) * grid.tiles_y * (grid.tile_h / WARP_TILE_H);
}

__device__ __forceinline__ WarpTile warp_tile(const TileGrid& grid, int index) {
    const int across = warp_tiles_x(grid);
    const int x = index % across * WARP_TILE_W, y = index / across * WARP_TILE_H;
    const int in_x = x % grid.tile_w / WARP_TILE_W, in_y = y % grid.tile_h / WARP_TILE_H;
    const int per_row = grid.tile_w / WARP_TILE_W;
    return {x, y, y / grid.tile_h * grid.tiles_x + x / grid.tile_w, in_y * per_row + in_x,
            per_row * (grid.tile_h / WARP_TILE_H)};
}

// the column of a lane: x across, two halves of four rows
__device__ __forceinline__ int lane_x(int lane) { return lane & (WARP_TILE_W - 1); }
__device__ __forceinline__ int lane_y(int lane) { return (lane / WARP_TILE_W) * COLUMN_ROWS; }

// Sum N values over a warp with N + about 4 shuffles: at every step half of the values go to the other half of the
// lanes. Afterwards lane `owner` of value k holds its sum; see sum_index.
template <int N, int MASK>
struct TransposedSum {
    static __device__ __forceinline__ float of(float (&v)[N], int lane) {
        constexpr int KEPT = (N + 1) / 2;
        const bool upper = lane & MASK;
        float kept[KEPT];
#pragma unroll
        for (int k = 0; k < KEPT; ++k) {
            const float low = v[k], high = k + KEPT < N ? v[k + KEPT] : 0.0f;
            kept[k] = (upper ? high : low) + __shfl_xor_sync(FULL_WARP, upper ? low : high, MASK);
        }
        return TransposedSum<KEPT, MASK / 2>::of(kept, lane);
    }
};

template <int N>
struct TransposedSum<N, 0> {
    static __device__ __forceinline__ float of(float (&v)[N], int) {
        static_assert(N == 1, "more values than a warp has lanes");
        return v[0];
    }
};

// the value that a lane holds after TransposedSum<N, 16>, or -1 where it holds a copy or padding
template <int N>
__device__ __forceinline__ int sum_index(int lane) {
    int first = 0, count = N, size = N;
    bool copy = false;
#pragma unroll
    for (int mask = WARP / 2; mask > 0; mask /= 2) {
        const int kept = (size + 1) / 2;
        const bool upper = lane & mask;
        if (size == 1) {
            copy = copy || upper;  // a plain sum from here on: both halves hold it
        } else {
            first += upper ? kept : 0;
            count = upper ? count - kept : min(count, kept);
        }
        size = kept;
    }
    return copy || count <= 0 ? -1 : first;
}

// After an overflow or a bad row a fused step does nothing until the host has seen to it: the views of the steps behind
// it may have another size than the buffers they are drawn into.
__device__ __forceinline__ bool halted(const DeviceState* state) {
    return state->overflow > 0 || state->bad_row != INT_MAX;
}

__device__ __forceinline__ int warp_max(int value) {
#if __CUDA_ARCH__ >= 800
    return __reduce_max_sync(FULL_WARP, value);
#else
#pragma unroll
    for (int mask = WARP / 2; mask > 0; mask /= 2) value = max(value, __shfl_xor_sync(FULL_WARP, value, mask));
    return value;
#endif
}

inline int blocks_for(long long n, int block) { return int((n + block - 1) / block); }

}  // namespace pop
