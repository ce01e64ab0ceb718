// Lists of splats by tile, without a host synchronisation: sort splats by depth, give every (splat, tile) instance a slot,
// sort the instances by tile. Both sorts are stable, so a list is ordered by (depth, index) (D3, D4).
//
// Slots are numbered splat by splat; the instance sort carries them as its payload, so that the backward pass can write
// one row a slot without atomics and sum a splat's rows, which lie together. Where there are more instances than the
// buffers hold, nothing is listed and state->overflow says how many there are: the host makes room and repeats the step,
// and until then nothing is updated. Their number can pass 2^32, so that it is added up with saturation.

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

#include "cuda_check.h"
#include "kernel_tools.cuh"

namespace pop {

namespace {

constexpr int BLOCK = 256;

// Addition that stops at the largest number instead of beginning again at zero. Of numbers >= 0 it is associative, which
// a scan asks for, and whatever is below the limit is exact: no need to scan 64 bits.
struct SaturatedSum {
    __host__ __device__ unsigned operator()(unsigned a, unsigned b) const { return a + b < a ? UINT_MAX : a + b; }
};

__global__ void depth_keys_kernel(int n, SplatArrays splats, unsigned* keys, unsigned* order) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    // the bits of a float in the order of its value, whatever its sign; culled splats go last
    const unsigned bits = __float_as_uint(splats.depths[i]);
    const unsigned ordered = bits & 0x80000000u ? ~bits : bits | 0x80000000u;
    keys[i] = splats.radii[2 * i] > 0 ? ordered : 0xffffffffu;
    order[i] = unsigned(i);
}

// what a warp reads of its splats when it tries their tiles
struct Footprint {
    float x, y, reach;
    Exponent<float> exponent;
    int x0, y0, across;
    float rows;  // a tile is 1 / across of one
    unsigned splat;
};

__device__ __forceinline__ Footprint footprint_of(unsigned splat, const SplatArrays& splats, const TileGrid& grid,
                                                  const Profile<float>& profile, int& size) {
    const float *u = splats.means2d + 2 * size_t(splat), *q = splats.conics + 3 * size_t(splat);
    const Radii radii = {splats.radii[2 * size_t(splat)], splats.radii[2 * size_t(splat) + 1]};
    const TileRect rect = tile_rect(Vec2<float>{u[0], u[1]}, radii, grid, profile);
    const float reach = logf(splats.opacities[splat] / profile.alpha_floor) + 1e-3f;
    const int across = rect.x1 - rect.x0;
    size = n_tiles_in(rect);
    return {u[0], u[1], reach, exponent_of(q[0], q[1], q[2]), rect.x0, rect.y0, across, 1.0f / float(across), splat};
}

__device__ __forceinline__ bool reaches(const Footprint& f, int index, const TileGrid& grid, bool exact, int& tile) {
    // index / across; rounded, it can be one off where there are millions of tiles
    int row = int((float(index) + 0.5f) * f.rows), column = index - row * f.across;
    const int off = int(column >= f.across) - int(column < 0);
    row += off, column -= off * f.across;
    const int x = f.x0 + column, y = f.y0 + row;
    tile = y * grid.tiles_x + x;
    return !exact || least_sigma_in_tile(Vec2<float>{f.x, f.y}, f.exponent, x, y, grid) <= f.reach;
}

// The splats of a block's warps, and where the tiles of each begin when a warp's are put in a row.
struct WarpSplats {
    Footprint of[BLOCK];
    int begin[BLOCK];
};

// Call visit(splat, tile, number) for every tile that the splats of this warp's lanes reach, splat by splat and row by
// row, with its number among all of them; returns how many the splat of this lane reaches. However unequal rectangles
// are, every lane has a tile to try until the warp's last 32. All lanes of the warp must call it.
template <class Visit>
__device__ __forceinline__ unsigned visit_tiles(WarpSplats& shared, const Footprint& f, int size, const TileGrid& grid,
                                                bool exact, Visit visit) {
    const int lane = threadIdx.x & (WARP - 1);
    Footprint* of = shared.of + (threadIdx.x - lane);
    int* begin = shared.begin + (threadIdx.x - lane);
    int end = size;
    for (int step = 1; step < WARP; step *= 2) {
        const int before = __shfl_up_sync(FULL_WARP, end, step);
        if (lane >= step) end += before;
    }
    of[lane] = f;
    begin[lane] = end - size;
    const int total = __shfl_sync(FULL_WARP, end, WARP - 1);
    __syncwarp();
    unsigned found = 0, before = 0;
    for (int first = 0; first < total; first += WARP) {  // per 32 tiles
        const int k = first + lane;
        int owner = 0, tile = 0;
        for (int step = WARP / 2; step > 0; step /= 2)
            if (begin[owner + step] <= k) owner += step;
        const bool kept = k < total && reaches(of[owner], k - begin[owner], grid, exact, tile);
        const unsigned hits = __ballot_sync(FULL_WARP, kept);
        if (kept) visit(of[owner].splat, tile, before + __popc(hits & ((1u << lane) - 1u)));
        before += __popc(hits);
        // those of the 32 that are this lane's own splat's
        const int low = max(end - size - first, 0), high = min(end - first, WARP);
        if (low < high) found += __popc(hits >> low << (WARP - (high - low)));
    }
    return found;
}

__global__ void count_kernel(TileLists lists, SplatArrays splats, Profile<float> profile) {
    __shared__ WarpSplats shared;
    const int rank = blockIdx.x * blockDim.x + threadIdx.x;
    Footprint f = {};
    int size = 0;
    if (rank < lists.n) f = footprint_of(lists.order[1][rank], splats, lists.grid, profile, size);
    unsigned found = unsigned(size);
    if (lists.exact) found = visit_tiles(shared, f, size, lists.grid, true, [](unsigned, int, unsigned) {});
    if (rank < lists.n) lists.counts[rank] = found;
}

// how many instances there are, INT_MAX for that many or more
__device__ __forceinline__ int n_instances(const TileLists& lists) {
    if (lists.n == 0) return 0;
    const unsigned total = SaturatedSum()(lists.offsets[lists.n - 1], lists.counts[lists.n - 1]);
    return int(min(total, unsigned(INT_MAX)));
}

__global__ void total_kernel(TileLists lists, DeviceState* state) { state->n_instances = n_instances(lists); }

// Everything that is due between scan and sort: the instances, what sorts behind every tile in the rest of the buffers,
// the tiles' empty ranges, the counts that the blend adds to, and the number of instances for the host.
template <class Key>
__global__ void emit_kernel(TileLists lists, SplatArrays splats, Profile<float> profile, int* dominant_counts,
                            DeviceState* state) {
    __shared__ WarpSplats shared;
    const int rank = blockIdx.x * blockDim.x + threadIdx.x, threads = gridDim.x * blockDim.x;
    const int total = n_instances(lists);
    // after an earlier halt the view may be that of another size of image: its numbers mean nothing
    const bool before = halted(state), listed = !before && total <= lists.capacity;
    if (rank == 0 && !before) {
        state->n_instances = total;
        if (!listed) state->overflow = total;
    }
    for (int tile = rank; tile < lists.n_tiles; tile += threads) lists.tile_begin[tile] = lists.tile_end[tile] = 0;
    Key* keys = static_cast<Key*>(lists.tile_keys[0]);
    for (long long k = total + (long long)(rank); listed && k < lists.capacity; k += threads) {
        keys[k] = Key(lists.n_tiles);
        lists.slots[0][k] = unsigned(k);
    }
    Footprint f = {};
    int size = 0;
    if (rank < lists.n) {
        const unsigned splat = lists.order[1][rank];
        if (listed) f = footprint_of(splat, splats, lists.grid, profile, size);
        lists.splat_begin[splat] = listed ? lists.offsets[rank] : 0;
        lists.splat_count[splat] = listed ? lists.counts[rank] : 0;
        if (dominant_counts != nullptr) dominant_counts[splat] = 0;
    }
    // slots are numbered as the warp finds them
    const int first_rank = rank - int(threadIdx.x & (WARP - 1));
    const unsigned first_slot = first_rank < lists.n ? lists.offsets[first_rank] : 0u;
    visit_tiles(shared, f, size, lists.grid, lists.exact, [&](unsigned splat, int tile, unsigned number) {
        const unsigned slot = first_slot + number;
        // never, unless this pass saw more tiles than the one that counted: then not in somebody else's memory
        if (slot >= unsigned(lists.capacity)) return;
        keys[slot] = Key(tile);
        lists.slots[0][slot] = slot;
        lists.slot_splat[slot] = splat;
    });
}

template <class Key>
__global__ void ranges_kernel(TileLists lists, const DeviceState* state) {
    const int k = blockIdx.x * blockDim.x + threadIdx.x, total = state->n_instances;
    if (k >= total || halted(state)) return;
    const Key* keys = static_cast<const Key*>(lists.tile_keys[1]);
    const int tile = int(keys[k]);
    lists.listed[k] = lists.slot_splat[lists.slots[1][k]];
    if (k == 0 || int(keys[k - 1]) != tile) lists.tile_begin[tile] = k;
    if (k + 1 == total || int(keys[k + 1]) != tile) lists.tile_end[tile] = k + 1;
}

__global__ void buckets_kernel(TileLists lists, DeviceState* state) {
    const int tile = blockIdx.x * blockDim.x + threadIdx.x;
    if (tile >= lists.n_tiles) return;
    const int n = (lists.tile_end[tile] - lists.tile_begin[tile] + WARP - 1) / WARP;
    const int first = lists.bucket_begin[tile];
    for (int b = 0; b < n; ++b) lists.bucket_tile[first + b] = tile;
    if (tile == lists.n_tiles - 1) state->n_buckets = first + n;
}

__global__ void bucket_counts_kernel(TileLists lists) {
    const int tile = blockIdx.x * blockDim.x + threadIdx.x;
    if (tile < lists.n_tiles)
        lists.bucket_begin[tile] = (lists.tile_end[tile] - lists.tile_begin[tile] + WARP - 1) / WARP;
}

int bits_for(int largest) {
    int bits = 1;
    while ((largest >> bits) > 0) ++bits;
    return bits;
}

template <class Key>
void sort_instances(const TileLists& lists, const SplatArrays& splats, const Profile<float>& profile,
                    int* dominant_counts, DeviceState* state, cudaStream_t stream) {
    emit_kernel<Key>
        <<<blocks_for(lists.n, BLOCK), BLOCK, 0, stream>>>(lists, splats, profile, dominant_counts, state);
    POP_LAUNCHED("emit_kernel");
    size_t bytes = lists.workspace_bytes;
    POP_CUDA(cub::DeviceRadixSort::SortPairs(
        lists.workspace, bytes, static_cast<const Key*>(lists.tile_keys[0]), static_cast<Key*>(lists.tile_keys[1]),
        static_cast<const unsigned*>(lists.slots[0]), lists.slots[1], lists.capacity, 0, bits_for(lists.n_tiles),
        stream));
    ranges_kernel<Key><<<blocks_for(lists.capacity, BLOCK), BLOCK, 0, stream>>>(lists, state);
    POP_LAUNCHED("ranges_kernel");
}

void order_and_count(const TileLists& lists, const SplatArrays& splats, const Profile<float>& profile,
                     cudaStream_t stream) {
    const int blocks = blocks_for(lists.n, BLOCK);
    depth_keys_kernel<<<blocks, BLOCK, 0, stream>>>(lists.n, splats, lists.depth_keys[0], lists.order[0]);
    POP_LAUNCHED("depth_keys_kernel");
    size_t bytes = lists.workspace_bytes;
    POP_CUDA(cub::DeviceRadixSort::SortPairs(lists.workspace, bytes, lists.depth_keys[0], lists.depth_keys[1],
                                             lists.order[0], lists.order[1], lists.n, 0, 32, stream));
    count_kernel<<<blocks, BLOCK, 0, stream>>>(lists, splats, profile);
    POP_LAUNCHED("count_kernel");
    bytes = lists.workspace_bytes;
    POP_CUDA(cub::DeviceScan::ExclusiveScan(lists.workspace, bytes, lists.counts, lists.offsets, SaturatedSum(),
                                            0u, lists.n, stream));
}

}  // namespace

size_t tile_workspace(int n, int capacity, int n_tiles) {
    size_t depth = 0, tiles16 = 0, tiles32 = 0, scan = 0, buckets = 0;
    unsigned* u = nullptr;
    uint16_t* k16 = nullptr;
    int* i = nullptr;
    POP_CUDA(cub::DeviceRadixSort::SortPairs(nullptr, depth, u, u, u, u, n));
    POP_CUDA(cub::DeviceRadixSort::SortPairs(nullptr, tiles16, k16, k16, u, u, capacity));
    POP_CUDA(cub::DeviceRadixSort::SortPairs(nullptr, tiles32, u, u, u, u, capacity));
    POP_CUDA(cub::DeviceScan::ExclusiveScan(nullptr, scan, u, u, SaturatedSum(), 0u, n));
    POP_CUDA(cub::DeviceScan::ExclusiveSum(nullptr, buckets, i, i, n_tiles));
    size_t most = 1;
    for (size_t bytes : {depth, tiles16, tiles32, scan, buckets}) most = bytes > most ? bytes : most;
    return most;
}

void count_instances(const TileLists& lists, const SplatArrays& splats, const Profile<float>& profile,
                     DeviceState* state, cudaStream_t stream) {
    if (lists.n > 0) order_and_count(lists, splats, profile, stream);
    // a caller without buffers is about to ask how many there are; one with buffers is told when they are filled
    if (lists.n > 0 && lists.capacity > 0) return;
    total_kernel<<<1, 1, 0, stream>>>(lists, state);
    POP_LAUNCHED("total_kernel");
}

void make_tile_lists(const TileLists& lists, const SplatArrays& splats, const Profile<float>& profile,
                     int* dominant_counts, DeviceState* state, cudaStream_t stream) {
    if (lists.n == 0 || lists.capacity == 0) {
        POP_CUDA(cudaMemsetAsync(lists.tile_begin, 0, sizeof(int) * lists.n_tiles, stream));
        POP_CUDA(cudaMemsetAsync(lists.tile_end, 0, sizeof(int) * lists.n_tiles, stream));
    } else if (lists.n_tiles < 0xffff) {
        sort_instances<uint16_t>(lists, splats, profile, dominant_counts, state, stream);
    } else {
        sort_instances<unsigned>(lists, splats, profile, dominant_counts, state, stream);
    }
    order_tiles(lists, stream);
    if (lists.bucket_begin == nullptr) return;
    const int blocks = blocks_for(lists.n_tiles, BLOCK);
    bucket_counts_kernel<<<blocks, BLOCK, 0, stream>>>(lists);
    POP_LAUNCHED("bucket_counts_kernel");
    size_t bytes = lists.workspace_bytes;
    POP_CUDA(cub::DeviceScan::ExclusiveSum(lists.workspace, bytes, lists.bucket_begin, lists.bucket_begin,
                                           lists.n_tiles, stream));
    buckets_kernel<<<blocks, BLOCK, 0, stream>>>(lists, state);
    POP_LAUNCHED("buckets_kernel");
}

}  // namespace pop
