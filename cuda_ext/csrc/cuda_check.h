// Every CUDA call and launch goes through here: a failure throws, with the call, the place and CUDA's own words.
#pragma once

#include <cuda_runtime.h>

#include <stdexcept>
#include <string>

namespace pop {

inline void check_cuda(cudaError_t error, const char* what, const char* file, int line) {
    if (error == cudaSuccess) return;
    throw std::runtime_error(std::string("CUDA: ") + what + " failed with " + cudaGetErrorName(error) + " (" +
                             cudaGetErrorString(error) + ") at " + file + ":" + std::to_string(line));
}

}  // namespace pop

#define POP_CUDA(call) ::pop::check_cuda((call), #call, __FILE__, __LINE__)
// a launch reports its own errors at once; what happens inside the kernel surfaces at the next synchronisation
#define POP_LAUNCHED(kernel) ::pop::check_cuda(cudaGetLastError(), "launch of " kernel, __FILE__, __LINE__)
