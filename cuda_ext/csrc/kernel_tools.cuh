// What several kernels share: packed splats, the warp's tile, sums over a warp.
#pragma once

#include <limits.h>

#include "compositing.cuh"
#include "launch.h"

namespace pop {

constexpr unsigned FULL_WARP = 0xffffffffu;
constexpr int WARP = 32, COLUMN_ROWS = 4, WARPS_PER_BLOCK = 4;
static_assert(WARP * COLUMN_ROWS == TILE_PIXELS, "a lane owns a column of four pixels");

// a record: x, y, hA, B | hC, opacity, beyond, c0 | c1, c2, c3, unused
struct Record {
    float4 a, b, c;

    __device__ __forceinline__ PackedSplat<float> splat() const { return {a.x, a.y, a.z, a.w, b.x, b.y, b.z}; }

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
POP_HD int warp_tiles_of_a_list(const TileGrid& grid) {
    return (grid.tile_w / WARP_TILE_W) * (grid.tile_h / WARP_TILE_H);
}

inline int n_warp_tiles(const TileGrid& grid) { return grid.tiles_x * grid.tiles_y * warp_tiles_of_a_list(grid); }

// the tile of a warp, longest lists first
__device__ __forceinline__ WarpTile warp_tile(const TileLists& lists, int index) {
    const TileGrid& grid = lists.grid;
    const int parts = warp_tiles_of_a_list(grid), across = grid.tile_w / WARP_TILE_W;
    const int list = int(lists.tile_order[index / parts]), part = index % parts;
    return {list % grid.tiles_x * grid.tile_w + part % across * WARP_TILE_W,
            list / grid.tiles_x * grid.tile_h + part / across * WARP_TILE_H, list, part, parts};
}

// the column of a lane: eight neighbouring lanes have a quarter of the tile, 8 x 4 pixels
__device__ __forceinline__ int lane_x(int lane) { return (lane & 7) + (lane & 8); }
__device__ __forceinline__ int lane_y(int lane) { return (lane / 16) * COLUMN_ROWS; }

// Keep a number that all lanes share in a register, where the compiler would make it anew at every use: it cannot see
// through a shuffle. All lanes of the warp must call it.
template <class T>
__device__ __forceinline__ T pinned(T value) {
    return __shfl_sync(FULL_WARP, value, 0);
}

// the same for an address in shared memory, which is made of four numbers on sm_90
template <class T>
__device__ __forceinline__ T* pinned_shared(T* address) {
#ifdef __CUDA_ARCH__
    return static_cast<T*>(__cvta_shared_to_generic(pinned(unsigned(__cvta_generic_to_shared(address)))));
#else
    return address;
#endif
}

// Begin to copy a float into shared memory, or 0 in its place. Where the card can (sm_80), no register holds it and the
// thread goes on; copies_arrive waits for the thread's own.
__device__ __forceinline__ void begin_copy(float* shared, const float* from, bool there) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    const unsigned to = unsigned(__cvta_generic_to_shared(shared));
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4, %2;" ::"r"(to), "l"(from), "r"(there ? 4 : 0) : "memory");
#else
    *shared = there ? __ldg(from) : 0.0f;
#endif
}

__device__ __forceinline__ void copies_arrive() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_all;" ::: "memory");
#endif
}

// Reads of what no thread writes meanwhile, made here and not later: the compiler moves a plain load down to where it is
// needed, behind a branch or the wait for another one, so that a warp waits for one after the other.
__device__ __forceinline__ float read_here(const float* from) {
#ifdef __CUDA_ARCH__
    float value;
    asm volatile("ld.global.nc.f32 %0, [%1];" : "=f"(value) : "l"(from));
    return value;
#else
    return *from;
#endif
}

__device__ __forceinline__ unsigned read_here(const unsigned* from) {
#ifdef __CUDA_ARCH__
    unsigned value;
    asm volatile("ld.global.nc.u32 %0, [%1];" : "=r"(value) : "l"(from));
    return value;
#else
    return *from;
#endif
}

// or zeros
__device__ __forceinline__ float4 read_here(const float4* from, bool there) {
#ifdef __CUDA_ARCH__
    float4 v;
    asm volatile(
        "{ .reg .pred p; setp.ne.s32 p, %5, 0; mov.f32 %0, 0f00000000; mov.f32 %1, 0f00000000; mov.f32 %2, 0f00000000; "
        "mov.f32 %3, 0f00000000; @p ld.global.nc.v4.f32 {%0, %1, %2, %3}, [%4]; }"
        : "=f"(v.x), "=f"(v.y), "=f"(v.z), "=f"(v.w)
        : "l"(from), "r"(int(there)));
    return v;
#else
    return there ? *from : float4{0.0f, 0.0f, 0.0f, 0.0f};
#endif
}

// Sum N values over 2 MASK lanes with N + about 4 shuffles: at every step half of the values go to the other half of the
// lanes, and one that is left over is summed in both. Afterwards a lane holds the sum that sum_index tells.
template <int N, int MASK>
struct TransposedSum {
    static __device__ __forceinline__ float of(float (&v)[N], int lane) {
        constexpr int KEPT = (N + 1) / 2;
        const bool upper = lane & MASK;
        float kept[KEPT];
#pragma unroll
        for (int k = 0; k < KEPT; ++k) {
            const bool paired = k + KEPT < N;
            const float high = v[paired ? k + KEPT : k];
            kept[k] = (upper ? high : v[k]) + __shfl_xor_sync(FULL_WARP, upper ? v[k] : high, MASK);
        }
        return TransposedSum<KEPT, MASK / 2>::of(kept, lane);
    }
};

template <int N>
struct TransposedSum<N, 0> {
    static __device__ __forceinline__ float of(float (&v)[N], int) {
        static_assert(N == 1, "more values than lanes");
        return v[0];
    }
};

// the value that a lane holds after TransposedSum<N, MASK>, or -1 where it holds a copy
template <int N, int MASK>
__device__ __forceinline__ int sum_index(int lane) {
    int index[N], size = N;
#pragma unroll
    for (int k = 0; k < N; ++k) index[k] = k;
#pragma unroll
    for (int mask = MASK; mask > 0; mask /= 2) {
        const int kept = (size + 1) / 2;
#pragma unroll
        for (int k = 0; k < N; ++k)
            if (k < kept && (lane & mask)) index[k] = k + kept < size ? index[k + kept] : -1;
        size = kept;
    }
    return index[0];
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
