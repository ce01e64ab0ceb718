// The photometric objective and its gradient in two passes over the image: windows and their derivatives, then pixels.
// A block owns 16 x 16 pixels and blurs in two one-dimensional passes through shared memory. The photograph's blurred
// values do not change, so they may be kept from an earlier visit.

#include "cuda_check.h"
#include "kernel_tools.cuh"
#include "ssim.cuh"
#include "train.h"

namespace pop {

namespace {

constexpr int SIDE = 16, HALO = SIDE + 2 * SSIM_REACH, THREADS = SIDE * SIDE, CHANNELS = 3;
constexpr float BYTE = 1.0f / 255.0f;
enum Blur { X, XX, XY, Y, YY, N_BLURS };

struct Photograph {
    const uint8_t *image, *mask;
    float pixel_share, window_share;
    float* moments;
};

__device__ __forceinline__ Photograph photograph_of(const Photographs& all, const DeviceState* state) {
    const int view = state->view;
    return {all.images[view], all.masks == nullptr ? nullptr : all.masks[view], all.shares[2 * view],
            all.shares[2 * view + 1], all.moments == nullptr ? nullptr : all.moments[view]};
}

__device__ __forceinline__ bool kept(const Photograph& photo, size_t pixel) {
    return photo.mask == nullptr || photo.mask[pixel] != 0;
}

// render and photograph at a pixel; black beyond the border, the photograph where the mask leaves the render out
__device__ __forceinline__ float2 compared(const Photograph& photo, const LossArrays& loss, int y, int x, int c) {
    if (y < 0 || y >= loss.height || x < 0 || x >= loss.width) return {0.0f, 0.0f};
    const size_t pixel = size_t(y) * loss.width + x;
    const float target = float(photo.image[CHANNELS * pixel + c]) * BYTE;
    return {kept(photo, pixel) ? loss.image[CHANNELS * pixel + c] : target, target};
}

// sum over a block in a fixed order; valid in thread 0
__device__ __forceinline__ float block_sum(float value, float* shared) {
    shared[threadIdx.x] = value;
    __syncthreads();
    for (int half = THREADS / 2; half > 0; half /= 2) {
        if (threadIdx.x < half) shared[threadIdx.x] += shared[threadIdx.x + half];
        __syncthreads();
    }
    const float total = shared[0];
    __syncthreads();
    return total;
}

template <bool CACHED, bool ONLY_TARGET>
__global__ void __launch_bounds__(THREADS)
    windows_kernel(Photographs photographs, LossArrays loss, LossSettings settings, const DeviceState* state) {
    constexpr int MAPS = CACHED ? int(Y) : int(N_BLURS);
    __shared__ float2 pixels[HALO][HALO + 1];
    __shared__ float rows[MAPS][HALO][SIDE];
    __shared__ float sums[THREADS];
    if (halted(state)) return;
    const Photograph photo = photograph_of(photographs, state);
    const int left = blockIdx.x * SIDE, top = blockIdx.y * SIDE;
    const int in_x = threadIdx.x % SIDE, in_y = threadIdx.x / SIDE;
    const int x = left + in_x, y = top + in_y;
    const size_t plane = size_t(loss.width) * loss.height, pixel = size_t(y) * loss.width + x;
    const bool inside = x < loss.width && y < loss.height;
    const int m = settings.margin;
    const bool counts = x >= m && x < loss.width - m && y >= m && y < loss.height - m && kept(photo, inside ? pixel : 0);
    float similarity = 0.0f, difference = 0.0f, square = 0.0f;
    for (int c = 0; c < CHANNELS; ++c) {
        for (int k = threadIdx.x; k < HALO * HALO; k += THREADS)
            pixels[k / HALO][k % HALO] =
                compared(photo, loss, top + k / HALO - SSIM_REACH, left + k % HALO - SSIM_REACH, c);
        __syncthreads();
        for (int k = threadIdx.x; k < HALO * SIDE; k += THREADS) {
            const int row = k / SIDE, col = k % SIDE;
            float blur[MAPS] = {};
#pragma unroll
            for (int i = 0; i < SSIM_WINDOW; ++i) {
                const float w = ssim_weight<float>(i - SSIM_REACH);
                const float2 p = pixels[row][col + i];
                blur[X] += w * p.x;
                blur[XX] += w * p.x * p.x;
                blur[XY] += w * p.x * p.y;
                if (!CACHED) {
                    blur[MAPS - 2] += w * p.y;
                    blur[MAPS - 1] += w * p.y * p.y;
                }
            }
#pragma unroll
            for (int map = 0; map < MAPS; ++map) rows[map][row][col] = blur[map];
        }
        __syncthreads();
        float blur[MAPS] = {};
#pragma unroll
        for (int i = 0; i < SSIM_WINDOW; ++i)
#pragma unroll
            for (int map = 0; map < MAPS; ++map)
                blur[map] += ssim_weight<float>(i - SSIM_REACH) * rows[map][in_y + i][in_x];
        if (inside) {
            WindowMoments<float> w = {blur[X], 0.0f, blur[XX], 0.0f, blur[XY]};
            w.mu_y = CACHED ? photo.moments[c * plane + pixel] : blur[MAPS - 2];
            w.yy = CACHED ? photo.moments[(CHANNELS + c) * plane + pixel] : blur[MAPS - 1];
            if (ONLY_TARGET) {
                photo.moments[c * plane + pixel] = w.mu_y;
                photo.moments[(CHANNELS + c) * plane + pixel] = w.yy;
            } else {
                const WindowSsim<float> s = counts ? compare_window(w) : WindowSsim<float>{};
                similarity += s.S;
                float* out = loss.windows + size_t(CHANNELS) * c * plane + pixel;
                out[0] = s.v_mu;
                out[plane] = s.v_xx;
                out[2 * plane] = s.v_xy;
                const float2 p = pixels[in_y + SSIM_REACH][in_x + SSIM_REACH];
                const float d = p.x - p.y;
                difference += settings.pixelwise == Pixelwise::l2 ? d * d : fabsf(d);
                const float e = clamped(p.x, 0.0f, 1.0f) - p.y;
                square += e * e;
            }
        }
        __syncthreads();
    }
    if (ONLY_TARGET) return;
    const int block = blockIdx.y * gridDim.x + blockIdx.x;
    const float d = block_sum(difference, sums), s = block_sum(similarity, sums), e = block_sum(square, sums);
    if (threadIdx.x == 0) {
        loss.partials[3 * block] = d;
        loss.partials[3 * block + 1] = s;
        loss.partials[3 * block + 2] = e;
    }
}

__global__ void __launch_bounds__(THREADS)
    pixels_kernel(Photographs photographs, LossArrays loss, LossSettings settings, const DeviceState* state) {
    __shared__ float derivatives[CHANNELS][HALO][HALO + 1];
    __shared__ float rows[CHANNELS][HALO][SIDE];
    if (halted(state)) return;
    const Photograph photo = photograph_of(photographs, state);
    const int left = blockIdx.x * SIDE, top = blockIdx.y * SIDE;
    const int in_x = threadIdx.x % SIDE, in_y = threadIdx.x / SIDE;
    const int x = left + in_x, y = top + in_y;
    const size_t plane = size_t(loss.width) * loss.height, pixel = size_t(y) * loss.width + x;
    const bool inside = x < loss.width && y < loss.height;
    for (int c = 0; c < CHANNELS; ++c) {
        const float* windows = loss.windows + size_t(CHANNELS) * c * plane;
        for (int k = threadIdx.x; k < HALO * HALO; k += THREADS) {
            const int wy = top + k / HALO - SSIM_REACH, wx = left + k % HALO - SSIM_REACH;
            const bool there = wy >= 0 && wy < loss.height && wx >= 0 && wx < loss.width;
#pragma unroll
            for (int d = 0; d < 3; ++d)
                derivatives[d][k / HALO][k % HALO] = there ? windows[d * plane + size_t(wy) * loss.width + wx] : 0.0f;
        }
        __syncthreads();
        for (int k = threadIdx.x; k < HALO * SIDE; k += THREADS)
#pragma unroll
            for (int d = 0; d < 3; ++d) {
                float blur = 0.0f;
#pragma unroll
                for (int i = 0; i < SSIM_WINDOW; ++i)
                    blur += ssim_weight<float>(i - SSIM_REACH) * derivatives[d][k / SIDE][k % SIDE + i];
                rows[d][k / SIDE][k % SIDE] = blur;
            }
        __syncthreads();
        if (inside) {
            float v[3] = {};
#pragma unroll
            for (int i = 0; i < SSIM_WINDOW; ++i)
#pragma unroll
                for (int d = 0; d < 3; ++d) v[d] += ssim_weight<float>(i - SSIM_REACH) * rows[d][in_y + i][in_x];
            const float2 p = compared(photo, loss, y, x, c);
            const float difference = p.x - p.y;
            // B4: sign(0) = 0
            const float sign = float(difference > 0.0f) - float(difference < 0.0f);
            const float of_pixel = settings.pixelwise == Pixelwise::l2 ? 2.0f * difference : sign;
            const float of_windows = pixel_from_windows(p.x, p.y, v[0], v[1], v[2]);
            const float sum = settings.pixelwise_weight * photo.pixel_share * of_pixel -
                              settings.ssim_weight * photo.window_share * of_windows;
            loss.v_image[CHANNELS * pixel + c] = kept(photo, pixel) ? sum : 0.0f;
        }
        __syncthreads();
    }
}

__global__ void __launch_bounds__(THREADS) values_kernel(Photographs photographs, LossArrays loss,
                                                         LossSettings settings, const DeviceState* state, int blocks) {
    __shared__ float sums[THREADS];
    if (halted(state)) return;
    float difference = 0.0f, similarity = 0.0f, square = 0.0f;
    for (int k = threadIdx.x; k < blocks; k += THREADS) {
        difference += loss.partials[3 * k];
        similarity += loss.partials[3 * k + 1];
        square += loss.partials[3 * k + 2];
    }
    const float d = block_sum(difference, sums), s = block_sum(similarity, sums), e = block_sum(square, sums);
    if (threadIdx.x > 0) return;
    const Photograph photo = photograph_of(photographs, state);
    // a mask that keeps no window compares nothing, and nothing differs
    const float ssim = photo.window_share > 0.0f ? s * photo.window_share : 1.0f;
    loss.values[V_PIXELWISE] = d * photo.pixel_share;
    loss.values[V_SSIM] = ssim;
    loss.values[V_OBJECTIVE] = settings.pixelwise_weight * d * photo.pixel_share + settings.ssim_weight * (1.0f - ssim);
    loss.values[V_SQUARE] = e * photo.pixel_share;
}

dim3 grid_for(const LossArrays& loss) {
    return dim3(blocks_for(loss.width, SIDE), blocks_for(loss.height, SIDE));
}

}  // namespace

int loss_blocks(int width, int height) { return blocks_for(width, SIDE) * blocks_for(height, SIDE); }

void target_moments(const Photographs& photographs, const LossArrays& loss, const LossSettings& settings,
                    const DeviceState* state, cudaStream_t stream) {
    windows_kernel<false, true><<<grid_for(loss), THREADS, 0, stream>>>(photographs, loss, settings, state);
    POP_LAUNCHED("windows_kernel");
}

void photometric(const Photographs& photographs, const LossArrays& loss, const LossSettings& settings,
                 const DeviceState* state, cudaStream_t stream) {
    const dim3 grid = grid_for(loss);
    if (photographs.moments == nullptr)
        windows_kernel<false, false><<<grid, THREADS, 0, stream>>>(photographs, loss, settings, state);
    else
        windows_kernel<true, false><<<grid, THREADS, 0, stream>>>(photographs, loss, settings, state);
    POP_LAUNCHED("windows_kernel");
    values_kernel<<<1, THREADS, 0, stream>>>(photographs, loss, settings, state, int(grid.x * grid.y));
    POP_LAUNCHED("values_kernel");
    pixels_kernel<<<grid, THREADS, 0, stream>>>(photographs, loss, settings, state);
    POP_LAUNCHED("pixels_kernel");
}

}  // namespace pop
