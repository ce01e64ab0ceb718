// Tiles by the length of their lists, longest first, so that no long list starts when the others are nearly done. Blocks
// are started in the order of their numbers, and what a tile gives depends on no other tile: only the time changes.
//
// Bounded by latency: one block counts lengths in bins of four, sums the bins from the longest down and places the tiles.

#include "cuda_check.h"
#include "kernel_tools.cuh"

namespace pop {

namespace {

constexpr int ORDER_BLOCK = 1024, BINS = 1024, BIN_WIDTH = 4;
static_assert(BINS == ORDER_BLOCK, "a thread sums a bin");

// bin 0 holds the longest lists, and all that are longer than the bins tell apart
__device__ __forceinline__ int bin_of(const TileLists& lists, int tile) {
    return BINS - 1 - min((lists.tile_end[tile] - lists.tile_begin[tile]) / BIN_WIDTH, BINS - 1);
}

// visit(tile, its bin) for every tile; the lengths of several are on their way at a time
template <class Visit>
__device__ __forceinline__ void visit_bins(const TileLists& lists, Visit visit) {
    constexpr int AT_ONCE = 8;
    for (int first = threadIdx.x; first < lists.n_tiles; first += AT_ONCE * ORDER_BLOCK) {
        int bin[AT_ONCE];
#pragma unroll
        for (int j = 0; j < AT_ONCE; ++j) bin[j] = bin_of(lists, min(first + ORDER_BLOCK * j, lists.n_tiles - 1));
#pragma unroll
        for (int j = 0; j < AT_ONCE; ++j)
            if (first + ORDER_BLOCK * j < lists.n_tiles) visit(first + ORDER_BLOCK * j, bin[j]);
    }
}

__global__ void __launch_bounds__(ORDER_BLOCK) tile_order_kernel(TileLists lists) {
    __shared__ int bins[BINS], sums[2][BINS];
    const int t = threadIdx.x;
    bins[t] = 0;
    __syncthreads();
    visit_bins(lists, [&](int, int bin) { atomicAdd(&bins[bin], 1); });
    __syncthreads();
    sums[0][t] = bins[t];
    __syncthreads();
    int from = 0;
    for (int step = 1; step < BINS; step *= 2) {
        sums[1 - from][t] = sums[from][t] + (t >= step ? sums[from][t - step] : 0);
        from = 1 - from;
        __syncthreads();
    }
    // from here on: the next free place of a bin
    bins[t] = sums[from][t] - bins[t];
    __syncthreads();
    visit_bins(lists, [&](int tile, int bin) { lists.tile_order[atomicAdd(&bins[bin], 1)] = unsigned(tile); });
}

}  // namespace

void order_tiles(const TileLists& lists, cudaStream_t stream) {
    tile_order_kernel<<<1, ORDER_BLOCK, 0, stream>>>(lists);
    POP_LAUNCHED("tile_order_kernel");
}

}  // namespace pop
