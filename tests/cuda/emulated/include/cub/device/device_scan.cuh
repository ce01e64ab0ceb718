// CUB's sums of all entries before each.
#pragma once

#include <cuda_runtime.h>

namespace cub {

struct DeviceScan {
    template <class T>
    static cudaError_t ExclusiveSum(void* workspace, size_t& bytes, const T* in, T* out, int n,
                                    cudaStream_t = nullptr) {
        if (workspace == nullptr) {
            bytes = 1;
            return cudaSuccess;
        }
        T total = 0;
        for (int k = 0; k < n; ++k) {
            const T value = in[k];
            out[k] = total;
            total += value;
        }
        return cudaSuccess;
    }
};

}  // namespace cub
