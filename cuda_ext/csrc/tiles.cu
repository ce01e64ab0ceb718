// Lists of splats by tile, without a host synchronisation: sort splats by depth, give every (splat, tile) instance a slot,
// sort the instances by tile. Both sorts are stable, so a list is ordered by (depth, index) (D3, D4).
//
// Which tiles a splat reaches is tried while they are counted, in the order of the splats, so that it need not wait for
// the sort by depth; each tried tile leaves a bit, and listing reads the bits.
//
// Slots are numbered splat by splat, front to back; the instance sort carries them as its payload, so that the backward
// pass can write one row a slot without atomics and sum a splat's rows, which lie together. Where there are more
// instances than the buffers hold, nothing is listed and state->overflow says how many there are: the host makes room
// and repeats the step, and until then nothing is updated. Their number can pass 2^32, so that it is added up with
// saturation.

#include <thrust/iterator/permutation_iterator.h>

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

#include "kernel_tools.cuh"

namespace pop {

namespace {

constexpr int BLOCK = 256;
constexpr int HIT_WORDS = 1024;  // of a block's splats: 128 tiles a splat that are tried once and not twice

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

// what is read of a splat when its tiles are tried
struct Footprint {
    float x, y, reach;
    Exponent<float> exponent;
    int x0, y0, across;
    float rows;  // a tile is 1 / across of one
    unsigned splat;
};

__device__ __forceinline__ Footprint footprint_of(int splat, const SplatArrays& splats, const TileGrid& grid,
                                                  const Profile<float>& profile, unsigned& size) {
    const float *u = splats.means2d + 2 * size_t(splat), *q = splats.conics + 3 * size_t(splat);
    const Radii radii = {splats.radii[2 * size_t(splat)], splats.radii[2 * size_t(splat) + 1]};
    const TileRect rect = tile_rect(Vec2<float>{u[0], u[1]}, radii, grid, profile);
    const float reach = logf(splats.opacities[splat] / profile.alpha_floor) + 1e-3f;
    const int across = rect.x1 - rect.x0;
    size = unsigned(n_tiles_in(rect));
    return {u[0], u[1], reach, exponent_of(q[0], q[1], q[2]), rect.x0, rect.y0, across, 1.0f / float(across),
            unsigned(splat)};
}

// where a tile of a splat's rectangle lies, by its number there
__device__ __forceinline__ Vec2<int> tile_at(const Footprint& f, int index) {
    // index / across; rounded, it can be one off where there are millions of tiles
    int row = int((float(index) + 0.5f) * f.rows), column = index - row * f.across;
    const int off = int(column >= f.across) - int(column < 0);
    row += off, column -= off * f.across;
    return {f.x0 + column, f.y0 + row};
}

// The tiles of a block's splats put in a row, splat by splat, with a bit for each that is reached: however unequal
// rectangles are, all threads of the block have tiles to try. HIT_WORDS words of 32 tiles are in hand at a time.
struct BlockTiles {
    Footprint of[BLOCK];         // of the splats that have tiles, without gaps
    unsigned begin[BLOCK + 1];   // the first tile of each, and behind the last
    unsigned first_slot[BLOCK];  // of each, less the bits that are set before its first tile
    unsigned words[HIT_WORDS], before[HIT_WORDS + 1];  // bits, and how many are set before a word
    uint8_t owner[HIT_WORDS];    // the splat of a word's first tile
    unsigned of_warps[BLOCK / WARP];

    // bits that are set before a tile, which is numbered from the first word
    __device__ __forceinline__ unsigned set_before(unsigned tile) const {
        const unsigned word = tile / WARP, bits = (1u << (tile % WARP)) - 1u;
        return before[word] + (bits ? __popc(words[word] & bits) : 0);
    }
};
static_assert(BLOCK <= 256, "a byte numbers a block's splats");

// what a thread's splat has of them
struct OwnTiles {
    int place;            // among the splats that have tiles
    unsigned begin, end;  // numbers of its tiles
    unsigned total;       // of the block

    __device__ __forceinline__ bool any() const { return end > begin; }
};

// Sum over the threads before this one, and over all. Here as below: all threads of the block must call.
__device__ __forceinline__ unsigned sum_before(unsigned value, unsigned (&of_warps)[BLOCK / WARP], unsigned& total) {
    const int lane = threadIdx.x & (WARP - 1), warp = threadIdx.x / WARP;
    unsigned sum = value, before = 0;
#pragma unroll
    for (int step = 1; step < WARP; step *= 2) {
        const unsigned other = __shfl_up_sync(FULL_WARP, sum, step);
        if (lane >= step) sum += other;
    }
    if (lane == WARP - 1) of_warps[warp] = sum;
    __syncthreads();
    total = 0;
#pragma unroll
    for (int k = 0; k < BLOCK / WARP; ++k) {
        if (k < warp) before += of_warps[k];
        total += of_warps[k];
    }
    __syncthreads();
    return before + sum - value;
}

__device__ __forceinline__ OwnTiles put_in_a_row(BlockTiles& tiles, const Footprint& f, unsigned size) {
    unsigned splats, total;
    const unsigned place = sum_before(size > 0 ? 1u : 0u, tiles.of_warps, splats);
    const unsigned begin = sum_before(size, tiles.of_warps, total);
    if (size > 0) {
        tiles.of[place] = f;
        tiles.begin[place] = begin;
    }
    if (threadIdx.x == 0) tiles.begin[splats] = total;
    return {int(place), begin, begin + size, total};
}

// how many words the tiles from `base` on take, of those in hand
__device__ __forceinline__ unsigned words_from(unsigned base, unsigned total) {
    return min((total - base + WARP - 1) / WARP, unsigned(HIT_WORDS));
}

// Say whose the first tile of every word is. A splat of many words writes them alone, a byte each.
__device__ __forceinline__ void note_owners(BlockTiles& tiles, const OwnTiles& own, unsigned base, unsigned n_words) {
    const unsigned first = own.begin > base ? (own.begin - base + WARP - 1) / WARP : 0u;
    const unsigned last = own.end > base ? min((own.end - base + WARP - 1) / WARP, n_words) : 0u;
    for (unsigned word = first; word < last; ++word) tiles.owner[word] = uint8_t(own.place);
}

// the splat of a tile, which lies in a word; tiles behind the last have none
__device__ __forceinline__ int owner_of(const BlockTiles& tiles, unsigned tile, unsigned word) {
    int owner = tiles.owner[word];
    while (tiles.begin[owner + 1] <= tile) ++owner;
    return owner;
}

// Try the tiles from `base` on, a word to a warp at a time.
__device__ __forceinline__ void try_tiles(BlockTiles& tiles, unsigned base, unsigned n_words, unsigned total,
                                          const TileGrid& grid, bool exact) {
    const int lane = threadIdx.x & (WARP - 1);
    for (unsigned word = threadIdx.x / WARP; word < n_words; word += BLOCK / WARP) {  // per 32 tiles tried
        const unsigned tile = base + WARP * word + lane;
        bool reached = tile < total;
        if (reached && exact) {
            const int owner = owner_of(tiles, tile, word);
            const Footprint& f = tiles.of[owner];
            const Vec2<int> at = tile_at(f, int(tile - tiles.begin[owner]));
            reached = least_sigma_in_tile(Vec2<float>{f.x, f.y}, f.exponent, at.x, at.y, grid) <= f.reach;
        }
        const unsigned bits = __ballot_sync(FULL_WARP, reached);
        if (lane == 0) tiles.words[word] = bits;
    }
}

// Sum the bits before every word.
__device__ __forceinline__ void sum_words(BlockTiles& tiles, unsigned n_words) {
    constexpr int EACH = HIT_WORDS / BLOCK;
    unsigned found[EACH], sum = 0, total;
#pragma unroll
    for (int k = 0; k < EACH; ++k) {
        const unsigned word = EACH * threadIdx.x + k;
        found[k] = word < n_words ? __popc(tiles.words[word]) : 0;
        sum += found[k];
    }
    unsigned before = sum_before(sum, tiles.of_warps, total);
#pragma unroll
    for (int k = 0; k < EACH; ++k) {
        tiles.before[EACH * threadIdx.x + k] = before;
        before += found[k];
    }
    if (threadIdx.x == 0) tiles.before[HIT_WORDS] = total;
    __syncthreads();
}

// bits before the first of a splat's tiles that are in hand, and among them
struct OwnBits {
    unsigned before, found;
};

__device__ __forceinline__ OwnBits own_bits(const BlockTiles& tiles, const OwnTiles& own, unsigned base,
                                            unsigned n_words) {
    const unsigned most = WARP * n_words;
    const unsigned first = own.begin > base ? min(own.begin - base, most) : 0u;
    const unsigned last = own.end > base ? min(own.end - base, most) : 0u;
    if (!own.any() || last <= first) return {0u, 0u};
    const unsigned before = tiles.set_before(first);
    return {before, tiles.set_before(last) - before};
}

// Count the tiles of every splat, and keep the bits of a block's first words for those who list them.
__global__ void __launch_bounds__(BLOCK) count_kernel(TileLists lists, SplatArrays splats, Profile<float> profile) {
    __shared__ BlockTiles tiles;
    const int splat = blockIdx.x * BLOCK + threadIdx.x;
    Footprint f = {};
    unsigned size = 0, found = 0;
    if (splat < lists.n) f = footprint_of(splat, splats, lists.grid, profile, size);
    if (!lists.exact) {
        if (splat < lists.n) lists.splat_count[splat] = size;
        return;
    }
    const OwnTiles own = put_in_a_row(tiles, f, size);
    for (unsigned base = 0; base < own.total; base += WARP * HIT_WORDS) {
        const unsigned n_words = words_from(base, own.total);
        note_owners(tiles, own, base, n_words);
        __syncthreads();
        try_tiles(tiles, base, n_words, own.total, lists.grid, true);
        __syncthreads();
        sum_words(tiles, n_words);
        found += own_bits(tiles, own, base, n_words).found;
        for (unsigned word = threadIdx.x; base == 0 && word < n_words; word += BLOCK)
            lists.hits[size_t(HIT_WORDS) * blockIdx.x + word] = tiles.words[word];
        __syncthreads();
    }
    if (splat < lists.n) lists.splat_count[splat] = found;
}

// how many instances there are, INT_MAX for that many or more
__device__ __forceinline__ int n_instances(const TileLists& lists) {
    if (lists.n == 0) return 0;
    const unsigned last = lists.order[1][lists.n - 1];
    const unsigned total = SaturatedSum()(lists.splat_begin[last], lists.splat_count[last]);
    return int(min(total, unsigned(INT_MAX)));
}

__global__ void total_kernel(TileLists lists, DeviceState* state) { state->n_instances = n_instances(lists); }

// List a block's splats in their slots: the tiles whose bits are set.
template <class Key>
__device__ __forceinline__ void emit_tiles(const TileLists& lists, BlockTiles& tiles, const OwnTiles& own, int splat) {
    const int lane = threadIdx.x & (WARP - 1);
    unsigned slot_of_own = own.any() ? lists.splat_begin[splat] : 0u;
    Key* keys = static_cast<Key*>(lists.tile_keys[0]);
    for (unsigned base = 0; base < own.total; base += WARP * HIT_WORDS) {
        const unsigned n_words = words_from(base, own.total);
        note_owners(tiles, own, base, n_words);
        if (base == 0 && lists.exact)
            for (unsigned word = threadIdx.x; word < n_words; word += BLOCK)
                tiles.words[word] = lists.hits[size_t(HIT_WORDS) * blockIdx.x + word];
        __syncthreads();
        if (base > 0 || !lists.exact) try_tiles(tiles, base, n_words, own.total, lists.grid, lists.exact);
        __syncthreads();
        sum_words(tiles, n_words);
        const OwnBits bits = own_bits(tiles, own, base, n_words);
        if (own.any()) tiles.first_slot[own.place] = slot_of_own - bits.before;
        slot_of_own += bits.found;
        __syncthreads();
        for (unsigned word = threadIdx.x / WARP; word < n_words; word += BLOCK / WARP) {  // per 32 tiles listed
            const unsigned found = tiles.words[word], tile = base + WARP * word + lane;
            if (!((found >> lane) & 1u)) continue;
            const int owner = owner_of(tiles, tile, word);
            const Vec2<int> at = tile_at(tiles.of[owner], int(tile - tiles.begin[owner]));
            const unsigned slot = tiles.first_slot[owner] + tiles.set_before(WARP * word + lane);
            // never, unless more tiles were found than counted: then not in somebody else's memory
            if (slot >= unsigned(lists.capacity)) continue;
            keys[slot] = Key(at.y * lists.grid.tiles_x + at.x);
            lists.slots[0][slot] = slot;
            lists.slot_splat[slot] = tiles.of[owner].splat;
        }
        __syncthreads();
    }
}

// Everything that is due between scan and sort: the instances, what sorts behind every tile in the rest of the buffers,
// the tiles' empty ranges, the counts that the blend adds to, and the number of instances for the host.
template <class Key>
__global__ void __launch_bounds__(BLOCK, 6) emit_kernel(TileLists lists, SplatArrays splats, Profile<float> profile,
                                                        int* dominant_counts, DeviceState* state) {
    __shared__ BlockTiles tiles;
    const int splat = blockIdx.x * BLOCK + threadIdx.x, threads = gridDim.x * BLOCK;
    const int total = n_instances(lists);
    // after an earlier halt the view may be that of another size of image: its numbers mean nothing
    const bool before = halted(state), listed = !before && total <= lists.capacity;
    if (splat == 0 && !before) {
        state->n_instances = total;
        if (!listed) state->overflow = total;
    }
    for (int tile = splat; tile < lists.n_tiles; tile += threads) lists.tile_begin[tile] = lists.tile_end[tile] = 0;
    if (splat < lists.n && dominant_counts != nullptr) dominant_counts[splat] = 0;
    if (!listed) return;
    Key* keys = static_cast<Key*>(lists.tile_keys[0]);
    for (long long k = total + (long long)(splat); k < lists.capacity; k += threads) {
        keys[k] = Key(lists.n_tiles);
        lists.slots[0][k] = unsigned(k);
    }
    Footprint f = {};
    unsigned size = 0;
    if (splat < lists.n) f = footprint_of(splat, splats, lists.grid, profile, size);
    emit_tiles<Key>(lists, tiles, put_in_a_row(tiles, f, size), splat);
}

constexpr int EACH = 4;  // entries of a thread, which it waits for together

template <class Key>
__global__ void __launch_bounds__(BLOCK) ranges_kernel(TileLists lists, const DeviceState* state) {
    const int first = blockIdx.x * EACH * BLOCK + threadIdx.x, total = state->n_instances;
    if (first >= total || halted(state)) return;
    const Key* keys = static_cast<const Key*>(lists.tile_keys[1]);
    int before[EACH], tile[EACH], behind[EACH];
    unsigned splat[EACH];
#pragma unroll
    for (int j = 0; j < EACH; ++j) splat[j] = read_here(lists.slots[1] + min(first + BLOCK * j, total - 1));
#pragma unroll
    for (int j = 0; j < EACH; ++j) {
        const int k = min(first + BLOCK * j, total - 1);
        before[j] = k > 0 ? int(keys[k - 1]) : -1;
        tile[j] = int(keys[k]);
        behind[j] = k + 1 < total ? int(keys[k + 1]) : -1;
    }
#pragma unroll
    for (int j = 0; j < EACH; ++j) splat[j] = read_here(lists.slot_splat + splat[j]);
#pragma unroll
    for (int j = 0; j < EACH; ++j) {
        const int k = first + BLOCK * j;
        if (k >= total) return;
        lists.listed[k] = splat[j];
        if (before[j] != tile[j]) lists.tile_begin[tile[j]] = k;
        if (behind[j] != tile[j]) lists.tile_end[tile[j]] = k + 1;
    }
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

// numbers of splats, one by one in the order of their depth
auto in_order(unsigned* of_splats, const unsigned* order) { return thrust::make_permutation_iterator(of_splats, order); }

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
    ranges_kernel<Key><<<blocks_for(lists.capacity, EACH * BLOCK), BLOCK, 0, stream>>>(lists, state);
    POP_LAUNCHED("ranges_kernel");
}

// Tiles by the length of their lists, longest first, so that no long list starts when the others are nearly done. Blocks
// are started in the order of their numbers, and what a tile gives depends on no other tile: only the time changes.
// Bounded by latency: one block counts lengths in bins of eight, sums the bins from the longest down and places the tiles.
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

size_t tile_workspace(int n, int capacity, int n_tiles) {
    size_t depth = 0, tiles16 = 0, tiles32 = 0, scan = 0, buckets = 0;
    unsigned* u = nullptr;
    uint16_t* k16 = nullptr;
    int* i = nullptr;
    POP_CUDA(cub::DeviceRadixSort::SortPairs(nullptr, depth, u, u, u, u, n));
    POP_CUDA(cub::DeviceRadixSort::SortPairs(nullptr, tiles16, k16, k16, u, u, capacity));
    POP_CUDA(cub::DeviceRadixSort::SortPairs(nullptr, tiles32, u, u, u, u, capacity));
    POP_CUDA(cub::DeviceScan::ExclusiveScan(nullptr, scan, in_order(u, u), in_order(u, u), SaturatedSum(), 0u, n));
    POP_CUDA(cub::DeviceScan::ExclusiveSum(nullptr, buckets, i, i, n_tiles));
    size_t most = 1;
    for (size_t bytes : {depth, tiles16, tiles32, scan, buckets}) most = bytes > most ? bytes : most;
    return most;
}

size_t hit_words(int n) { return size_t(HIT_WORDS) * blocks_for(n, BLOCK); }

void sort_by_depth(const TileLists& lists, const SplatArrays& splats, cudaStream_t stream) {
    if (lists.n == 0) return;
    depth_keys_kernel<<<blocks_for(lists.n, BLOCK), BLOCK, 0, stream>>>(lists.n, splats, lists.depth_keys[0],
                                                                       lists.order[0]);
    POP_LAUNCHED("depth_keys_kernel");
    size_t bytes = lists.workspace_bytes;
    POP_CUDA(cub::DeviceRadixSort::SortPairs(lists.workspace, bytes, lists.depth_keys[0], lists.depth_keys[1],
                                             lists.order[0], lists.order[1], lists.n, 0, 32, stream));
}

void count_tiles(const TileLists& lists, const SplatArrays& splats, const Profile<float>& profile,
                 cudaStream_t stream) {
    if (lists.n == 0) return;
    count_kernel<<<blocks_for(lists.n, BLOCK), BLOCK, 0, stream>>>(lists, splats, profile);
    POP_LAUNCHED("count_kernel");
}

void number_instances(const TileLists& lists, DeviceState* state, cudaStream_t stream) {
    size_t bytes = lists.workspace_bytes;
    if (lists.n > 0)
        POP_CUDA(cub::DeviceScan::ExclusiveScan(lists.workspace, bytes, in_order(lists.splat_count, lists.order[1]),
                                                in_order(lists.splat_begin, lists.order[1]), SaturatedSum(), 0u,
                                                lists.n, stream));
    // a caller without buffers is about to ask how many there are; one with buffers is told when they are filled
    if (lists.n > 0 && lists.capacity > 0) return;
    total_kernel<<<1, 1, 0, stream>>>(lists, state);
    POP_LAUNCHED("total_kernel");
}

void order_tiles(const TileLists& lists, cudaStream_t stream) {
    tile_order_kernel<<<1, ORDER_BLOCK, 0, stream>>>(lists);
    POP_LAUNCHED("tile_order_kernel");
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
