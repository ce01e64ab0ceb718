// How a warp moves the harmonics of its 32 Gaussians between memory and shared memory, so that a lane can go through
// its own row: in pieces of 16 bytes, neighbouring lanes at neighbouring addresses, many loads before the first use.
//
// Alignment: a piece needs an address that is a multiple of 16. A warp's rows begin 32 rows behind the last warp's, a
// multiple of 128 bytes whatever the stride, so that the first row decides for all. Rows that begin elsewhere, and the
// last warp where it is not full, go float by float.
#pragma once

#include "kernel_tools.cuh"

namespace pop {

__device__ __forceinline__ bool in_pieces(const void* p) { return (reinterpret_cast<uintptr_t>(p) & 15u) == 0; }

// floats of the bands that are active: all of them, or those beyond the first
template <int DEGREE, bool WHOLE>
constexpr int ACTIVE = 3 * ((DEGREE + 1) * (DEGREE + 1) - (WHOLE ? 0 : 1));

// Rows in memory have all bands that a model keeps, rows in shared memory the active ones, at an odd pitch: 32 lanes
// that read the same coefficient of their rows then find 32 different banks.
template <int FLOATS>
struct WarpRows {
    static constexpr int PITCH = FLOATS | 1;
    alignas(16) float staged[WARP * PITCH];

    __device__ __forceinline__ float* row(int lane) { return staged + PITCH * lane; }
};

// nothing is active beyond the first band
template <>
struct WarpRows<0> {
    __device__ __forceinline__ float* row(int) { return nullptr; }
};

struct RowStride {
    int floats;
    unsigned inverse;  // 2^32 / floats, rounded up: an index in a warp's rows is divided by a multiplication

    __device__ __forceinline__ int row(int at) const { return int(__umulhi(unsigned(at), inverse)); }
};

inline RowStride row_stride(int floats) { return {floats, floats > 1 ? 0xffffffffu / unsigned(floats) + 1u : 0u}; }

// where a float of a warp's rows in memory lies in shared memory, or -1
template <int FLOATS>
__device__ __forceinline__ int staged_at(int at, const RowStride& stride) {
    const int row = stride.row(at), k = at - row * stride.floats;
    return k < FLOATS ? row * WarpRows<FLOATS>::PITCH + k : -1;
}

// whether the four floats from `at` hold an active one of a row of the mask
template <int FLOATS>
__device__ __forceinline__ bool piece_counts(int at, const RowStride& stride, unsigned mask) {
    const int row = stride.row(at), next = stride.row(at + 3);
    return (((mask >> row) & 1u) && at - row * stride.floats < FLOATS) || (next != row && ((mask >> next) & 1u));
}

// in this case the rows lie in shared memory as they do in memory
template <int FLOATS>
__device__ __forceinline__ bool as_in_memory(const RowStride& stride) {
    return FLOATS % 2 == 1 && stride.floats == FLOATS;
}

// Read the rows of the mask; `source` is the warp's first row. All lanes must call it, and then __syncwarp.
template <int AT_ONCE, int FLOATS>
__device__ __forceinline__ void read_rows(const float* __restrict__ source, const RowStride& stride, int rows,
                                          unsigned mask, WarpRows<FLOATS>& to) {
    const int lane = threadIdx.x & (WARP - 1), total = rows * stride.floats;
    if (rows < WARP || !in_pieces(source)) {
#pragma unroll 1
        for (int at = lane; at < total; at += WARP) {
            const int place = staged_at<FLOATS>(at, stride);
            if (place >= 0) to.staged[place] = source[at];
        }
        return;
    }
    const bool plain = as_in_memory<FLOATS>(stride);
    for (int first = 4 * lane; first < total; first += 4 * WARP * AT_ONCE) {  // per pieces of a lane at once
        float4 piece[AT_ONCE];
        bool counts[AT_ONCE];
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            const int at = first + 4 * WARP * k;
            counts[k] = at < total && piece_counts<FLOATS>(at, stride, mask);
            if (counts[k]) piece[k] = __ldg(reinterpret_cast<const float4*>(source + at));
        }
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            const int at = first + 4 * WARP * k;
            if (!counts[k]) continue;
            if (plain) {
                *reinterpret_cast<float4*>(to.staged + at) = piece[k];
                continue;
            }
            const float values[4] = {piece[k].x, piece[k].y, piece[k].z, piece[k].w};
#pragma unroll
            for (int j = 0; j < 4; ++j) {
                const int place = staged_at<FLOATS>(at + j, stride);
                if (place >= 0) to.staged[place] = values[j];
            }
        }
    }
}

// a float or a piece of the rows as they lie in memory; 0 for bands that are not active
template <int FLOATS>
__device__ __forceinline__ float staged_float(const WarpRows<FLOATS>& from, int at, const RowStride& stride) {
    const int place = staged_at<FLOATS>(at, stride);
    return place >= 0 ? from.staged[place] : 0.0f;
}

template <int FLOATS>
__device__ __forceinline__ float4 staged_piece(const WarpRows<FLOATS>& from, int at, const RowStride& stride) {
    if (as_in_memory<FLOATS>(stride)) return *reinterpret_cast<const float4*>(from.staged + at);
    return {staged_float<FLOATS>(from, at, stride), staged_float<FLOATS>(from, at + 1, stride),
            staged_float<FLOATS>(from, at + 2, stride), staged_float<FLOATS>(from, at + 3, stride)};
}

// Write whole rows back, zeros where a band is not active; __syncwarp after the rows are written.
template <int FLOATS>
__device__ __forceinline__ void write_rows(const WarpRows<FLOATS>& from, float* __restrict__ target,
                                           const RowStride& stride, int rows) {
    const int lane = threadIdx.x & (WARP - 1), total = rows * stride.floats;
    if (rows < WARP || !in_pieces(target)) {
#pragma unroll 1
        for (int at = lane; at < total; at += WARP) target[at] = staged_float<FLOATS>(from, at, stride);
        return;
    }
    for (int at = 4 * lane; at < total; at += 4 * WARP)
        *reinterpret_cast<float4*>(target + at) = staged_piece<FLOATS>(from, at, stride);
}

}  // namespace pop
