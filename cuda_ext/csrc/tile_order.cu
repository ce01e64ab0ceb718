// Tiles by the length of their lists, longest first, so that no long list starts when the others are nearly done. Blocks
// are started in the order of their numbers, and what a tile gives depends on no other tile: only the time changes.
//
// Bounded by latency: one block counts lengths in bins of eight, sums the bins from the longest down and places the tiles.

#include "cuda_check.h"
#include "kernel_tools.cuh"

namespace pop {

namespace {

constexpr int ORDER_BLOCK = 512, BINS = 512, BIN_WIDTH = 8;
static_assert(BINS == ORDER_BLOCK, "a thread sums a bin");

// bin 0 holds the longest lists, and all that are longer than the bins tell apart
__device__ __forceinline__ int bin_of(const TileLists& lists, int tile) {
    return BINS - 1 - min((lists.tile_end[tile] - lists.tile_begin[tile]) / BIN_WIDTH, BINS - 1);
}

__global__ void __launch_bounds__(ORDER_BLOCK) tile_order_kernel(TileLists lists) {
    __shared__ int bins[BINS], sums[2][BINS];
    const int t = threadIdx.x;
    bins[t] = 0;
    __syncthreads();
    for (int tile = t; tile < lists.n_tiles; tile += ORDER_BLOCK) atomicAdd(&bins[bin_of(lists, tile)], 1);
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
    for (int tile = t; tile < lists.n_tiles; tile += ORDER_BLOCK)
        lists.tile_order[atomicAdd(&bins[bin_of(lists, tile)], 1)] = unsigned(tile);
}

}  // namespace

void order_tiles(const TileLists& lists, cudaStream_t stream) {
    tile_order_kernel<<<1, ORDER_BLOCK, 0, stream>>>(lists);
    POP_LAUNCHED("tile_order_kernel");
}

}  // namespace pop
