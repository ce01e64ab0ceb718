// The part of CUDA that the kernels use, on the host. A block's threads are fibers that run one after another and meet at
// barriers and warp functions, in an order that is shuffled; blocks run one after another. What is not shown of a GPU:
// real concurrency (a race within one instruction, an atomic's order), memory spaces, the approximate exp2 and division.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>

#define __host__
#define __device__
#define __global__ static
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static
#define CUDART_VERSION 13000

typedef int cudaError_t;
typedef struct CUstream_st* cudaStream_t;
constexpr cudaError_t cudaSuccess = 0;
inline const char* cudaGetErrorName(cudaError_t) { return "error"; }
inline const char* cudaGetErrorString(cudaError_t) { return "error"; }
inline cudaError_t cudaGetLastError() { return cudaSuccess; }
inline cudaError_t cudaDriverGetVersion(int* version) {
    *version = CUDART_VERSION;
    return cudaSuccess;
}

struct float2 {
    float x, y;
};
struct alignas(16) float4 {
    float x, y, z, w;
};
struct alignas(16) uint4 {
    unsigned x, y, z, w;
};
struct int2 {
    int x, y;
};
struct dim3 {
    unsigned x, y, z;
    dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : x(x), y(y), z(z) {}
};

namespace emulated {

extern dim3 thread_index, block_index, block_size, grid_size;

enum class Meeting { sync, ballot, shuffle, match };

void launch(const char* name, dim3 grid, dim3 block, const std::function<void()>& kernel);
// what a CUDA graph of these calls would consist of
void count_nodes(const char* name, int times);
// wait for the lanes of the mask that have not left; everyone finds all values in `all`. Returns who took part.
unsigned meet_warp(unsigned mask, Meeting kind, uint64_t value, uint64_t* all);
void meet_block();
[[noreturn]] void fail(const char* why);

inline int lane() { return int(thread_index.x % 32); }

template <class T>
uint64_t bits_of(T value) {
    static_assert(sizeof(T) <= 8);
    uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof(T));
    return bits;
}

template <class T>
T value_of(uint64_t bits) {
    T value;
    std::memcpy(&value, &bits, sizeof(T));
    return value;
}

template <class T>
T shuffled(unsigned mask, T value, int source) {
    uint64_t all[32];
    const unsigned present = meet_warp(mask, Meeting::shuffle, bits_of(value), all);
    if (source < 0 || source > 31) return value;
    if (!(present >> source & 1)) fail("a value is read from a lane that does not take part");
    return value_of<T>(all[source]);
}

}  // namespace emulated

inline cudaError_t cudaMemsetAsync(void* data, int value, size_t bytes, cudaStream_t) {
    emulated::count_nodes("memset", 1);
    std::memset(data, value, bytes);
    return cudaSuccess;
}

#define threadIdx ::emulated::thread_index
#define blockIdx ::emulated::block_index
#define blockDim ::emulated::block_size
#define gridDim ::emulated::grid_size

inline void __syncthreads() { emulated::meet_block(); }

inline void __syncwarp(unsigned mask = 0xffffffffu) {
    uint64_t all[32];
    emulated::meet_warp(mask, emulated::Meeting::sync, 0, all);
}

inline unsigned __ballot_sync(unsigned mask, bool vote) {
    uint64_t all[32];
    const unsigned present = emulated::meet_warp(mask, emulated::Meeting::ballot, vote, all);
    unsigned found = 0;
    for (int k = 0; k < 32; ++k)
        if ((present >> k & 1) && all[k]) found |= 1u << k;
    return found;
}

inline bool __any_sync(unsigned mask, unsigned vote) { return __ballot_sync(mask, vote != 0) != 0; }

template <class T>
T __shfl_sync(unsigned mask, T value, int source) {
    return emulated::shuffled(mask, value, source & 31);
}

template <class T>
T __shfl_up_sync(unsigned mask, T value, int by) {
    return emulated::shuffled(mask, value, emulated::lane() - by);
}

template <class T>
T __shfl_down_sync(unsigned mask, T value, int by) {
    return emulated::shuffled(mask, value, emulated::lane() + by);
}

template <class T>
T __shfl_xor_sync(unsigned mask, T value, int with) {
    return emulated::shuffled(mask, value, emulated::lane() ^ with);
}

inline unsigned __match_any_sync(unsigned mask, int value) {
    uint64_t all[32];
    const unsigned present = emulated::meet_warp(mask, emulated::Meeting::match, emulated::bits_of(value), all);
    unsigned same = 0;
    for (int k = 0; k < 32; ++k)
        if ((present >> k & 1) && emulated::value_of<int>(all[k]) == value) same |= 1u << k;
    return same;
}

inline unsigned __umulhi(unsigned a, unsigned b) { return unsigned((uint64_t(a) * b) >> 32); }
inline int __popc(unsigned value) { return __builtin_popcount(value); }
inline int __ffs(unsigned value) { return __builtin_ffs(int(value)); }
inline unsigned __float_as_uint(float value) { return emulated::value_of<unsigned>(emulated::bits_of(value)); }

template <class T>
T __ldg(const T* address) {
    return *address;
}

template <class T>
void __stwb(T* address, T value) {
    *address = value;
}

template <class T>
T atomicAdd(T* address, T value) {
    const T before = *address;
    *address = before + value;
    return before;
}

inline int atomicMin(int* address, int value) {
    const int before = *address;
    *address = std::min(before, value);
    return before;
}

using std::max;
using std::min;
