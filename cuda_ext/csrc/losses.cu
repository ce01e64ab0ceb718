// The photometric objective and its gradient in two passes over the image: windows and their derivatives, then pixels.
// A block owns 32 x 32 pixels and blurs one channel at a time in two one-dimensional passes through shared memory. The
// photograph's blurred values do not change, so they may be kept from an earlier visit.
//
// What bounds both kernels is the issue of instructions, about 410 a pixel and channel (0.06 ms for 1.6 million pixels
// of an H200), nearly half of them the blurs' multiply-adds: 33 a value down, 43 across with the surroundings of the
// block. A thread therefore makes a run of four neighbouring values in each pass, from 14 values read instead of 44,
// and finds the pixels that it reads once for all channels. Memory comes close: 46 bytes a pixel and channel, 0.05 ms,
// and so what the next channel needs is read while a channel's runs down are made.
//
// No bank of shared memory is asked twice at a time. Across, the eight threads of a quarter-warp read one row, 16 bytes
// each, 128 bytes in one piece; a pitch of 44 floats keeps the pieces of every row at multiples of 16 bytes. Down, and
// where the tile is filled, the 32 threads of a warp are at 32 neighbouring floats.

#include "kernel_tools.cuh"
#include "ssim.cuh"
#include "train.h"

namespace pop {

namespace {

constexpr int SIDE = 32, HALO = SIDE + 2 * SSIM_REACH, PITCH = 44, THREADS = 256, CHANNELS = 3;
constexpr int RUN = 4, RUNS = SIDE / RUN, RUN_INPUTS = RUN + 2 * SSIM_REACH;  // values that a thread makes and reads
constexpr int PIECES = (RUN_INPUTS + 3) / 4, SLOTS = (HALO * PITCH + THREADS - 1) / THREADS;
static_assert(PITCH % 4 == 0 && PITCH >= SIDE - RUN + 4 * PIECES, "a run is read in whole pieces of its row");
static_assert(SIDE * RUNS == THREADS, "in the pass down every thread has a run");
constexpr float BYTE = 1.0f / 255.0f;
// what is blurred of the render and of the photograph
enum OfRender { X, XX, XY, N_OF_RENDER };
enum OfTarget { Y, YY, N_OF_TARGET };

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

__device__ __forceinline__ bool kept(const Photograph& photo, unsigned pixel) {
    return photo.mask == nullptr || __ldg(photo.mask + pixel) != 0;
}

// Indices of pixels and of their values are unsigned and 32 bits wide: added to a plane that all threads share, each
// takes one instruction, a 64-bit index about three.
__device__ __forceinline__ unsigned value_of(unsigned pixel) { return unsigned(CHANNELS) * pixel; }

// A pixel of the photograph in one word: its three bytes, and LEFT_OUT where a mask leaves it out.
constexpr unsigned LEFT_OUT = 1u << 31;

__device__ __forceinline__ unsigned word_of(const Photograph& photo, unsigned pixel) {
    const uint8_t* p = photo.image + value_of(pixel);
    const unsigned bytes = unsigned(__ldg(p)) | unsigned(__ldg(p + 1)) << 8 | unsigned(__ldg(p + 2)) << 16;
    return kept(photo, pixel) ? bytes : bytes | LEFT_OUT;
}

struct Compared {
    float render, target;
};

// one channel of render and photograph; the photograph where the mask leaves the render out
__device__ __forceinline__ Compared compared(float render, unsigned word, int channel) {
    const float target = float((word >> 8 * channel) & 0xffu) * BYTE;
    return {word & LEFT_OUT ? target : render, target};
}

// The pixels of a block and around it, as a thread meets them while the tile is filled: it fills floats THREADS apart
// of rows of PITCH. Beyond the image's border, and in the columns that only fill a row up, there is none, and 0 is put.
struct Halo {
    int pixel[SLOTS];  // index in the image, or -1

    __device__ __forceinline__ Halo(int left, int top, int width, int height) {
#pragma unroll
        for (int k = 0; k < SLOTS; ++k) {
            const int at = place(k), row = at / PITCH, col = at - PITCH * row;
            const int x = left + col - SSIM_REACH, y = top + row - SSIM_REACH;
            const bool in_image = unsigned(x) < unsigned(width) && unsigned(y) < unsigned(height);
            pixel[k] = in_image && row < HALO && col < HALO ? y * width + x : -1;
        }
    }

    static __device__ __forceinline__ int place(int k) { return THREADS * k + int(threadIdx.x); }
    static __device__ __forceinline__ bool fills(int k) {
        return THREADS * (k + 1) <= HALO * PITCH || place(k) < HALO * PITCH;
    }
};

// A run across: RUN neighbouring blurred values of every map. inputs(at, values) gives four values of each map,
// those at `at` of the tile and behind it.
template <int MAPS, class Inputs>
__device__ __forceinline__ void blur_across(float (*rows)[HALO][SIDE], Inputs inputs) {
    for (int item = threadIdx.x; item < HALO * RUNS; item += THREADS) {  // per run across
        const int row = item / RUNS, col = RUN * (item % RUNS);
        float blur[MAPS][RUN] = {};
#pragma unroll
        for (int piece = 0; piece < PIECES; ++piece) {
            float values[MAPS][4];
            inputs(PITCH * row + col + 4 * piece, values);
#pragma unroll
            for (int j = 0; j < 4; ++j)
#pragma unroll
                for (int k = 0; k < RUN; ++k) {
                    const int tap = 4 * piece + j - k;
                    if (tap < 0 || tap >= SSIM_WINDOW) continue;
#pragma unroll
                    for (int map = 0; map < MAPS; ++map)
                        blur[map][k] += ssim_weight<float>(tap - SSIM_REACH) * values[map][j];
                }
        }
#pragma unroll
        for (int map = 0; map < MAPS; ++map)
            *reinterpret_cast<float4*>(&rows[map][row][col]) = {blur[map][0], blur[map][1], blur[map][2], blur[map][3]};
    }
}

// a run down: RUN blurred values of every map, below one another
template <int MAPS>
__device__ __forceinline__ void blur_down(const float (*rows)[HALO][SIDE], int col, int row, float (&blur)[MAPS][RUN]) {
#pragma unroll
    for (int i = 0; i < RUN_INPUTS; ++i)
#pragma unroll
        for (int map = 0; map < MAPS; ++map) {
            const float value = rows[map][row + i][col];
#pragma unroll
            for (int k = 0; k < RUN; ++k)
                if (i >= k && i - k < SSIM_WINDOW) blur[map][k] += ssim_weight<float>(i - k - SSIM_REACH) * value;
        }
}

__device__ __forceinline__ void four_of(const float* tile, float (&values)[4]) {
    const float4 piece = *reinterpret_cast<const float4*>(tile);
    values[0] = piece.x;
    values[1] = piece.y;
    values[2] = piece.z;
    values[3] = piece.w;
}

struct Sums {
    float difference, similarity, square;
};

// sums over a block in a fixed order; valid in thread 0
__device__ __forceinline__ Sums block_sums(Sums value) {
    __shared__ Sums of_warps[THREADS / WARP];
#pragma unroll
    for (int mask = WARP / 2; mask > 0; mask /= 2) {
        value.difference += __shfl_xor_sync(FULL_WARP, value.difference, mask);
        value.similarity += __shfl_xor_sync(FULL_WARP, value.similarity, mask);
        value.square += __shfl_xor_sync(FULL_WARP, value.square, mask);
    }
    if ((threadIdx.x & (WARP - 1)) == 0) of_warps[threadIdx.x / WARP] = value;
    __syncthreads();
    Sums total = {0.0f, 0.0f, 0.0f};
    if (threadIdx.x > 0) return total;
    for (const Sums& of_warp : of_warps) {
        total.difference += of_warp.difference;
        total.similarity += of_warp.similarity;
        total.square += of_warp.square;
    }
    return total;
}

template <bool RENDER, bool TARGET>
constexpr int N_MAPS = (RENDER ? N_OF_RENDER : 0) + (TARGET ? N_OF_TARGET : 0);

// Begin to read one channel of the render.
__device__ __forceinline__ void begin_render(const Halo& halo, const float* image, float* render) {
#pragma unroll
    for (int k = 0; k < SLOTS; ++k) {
        const bool there = halo.pixel[k] >= 0;
        if (Halo::fills(k)) begin_copy(render + Halo::place(k), image + value_of(there ? halo.pixel[k] : 0), there);
    }
}

// Read the photograph, all of its channels. Every byte is on its way before the first is waited for, so that some pixel's
// are read also where there is none.
__device__ __forceinline__ void read_photograph(const Halo& halo, const Photograph& photo, unsigned* words) {
    unsigned read[SLOTS];
#pragma unroll
    for (int k = 0; k < SLOTS; ++k) read[k] = word_of(photo, unsigned(max(halo.pixel[k], 0)));
#pragma unroll
    for (int k = 0; k < SLOTS; ++k)
        if (Halo::fills(k)) words[Halo::place(k)] = halo.pixel[k] >= 0 ? read[k] : 0u;
}

// Begin to read what is kept of one channel of the photograph: two values of each of the thread's own pixels.
__device__ __forceinline__ void begin_moments(const Photograph& photo, size_t plane, int channel, unsigned first_pixel,
                                              int width, int rows_inside, float (&moments)[N_OF_TARGET][RUN][THREADS]) {
    const float *mu_y = photo.moments + channel * plane, *yy = mu_y + CHANNELS * plane;
#pragma unroll
    for (int k = 0; k < RUN; ++k) {
        const bool there = k < rows_inside;
        const unsigned pixel = there ? first_pixel + unsigned(k * width) : 0u;
        begin_copy(&moments[Y][k][threadIdx.x], mu_y + pixel, there);
        begin_copy(&moments[YY][k][threadIdx.x], yy + pixel, there);
    }
}

// what is blurred, of four neighbouring values
template <bool RENDER, bool TARGET>
__device__ __forceinline__ void four_products(const float* render, const unsigned* words, int channel,
                                              float (&values)[N_MAPS<RENDER, TARGET>][4]) {
    constexpr int FIRST_OF_TARGET = N_MAPS<RENDER, TARGET> - N_OF_TARGET;
    float drawn[4] = {};
    if (RENDER) four_of(render, drawn);
    const uint4 piece = *reinterpret_cast<const uint4*>(words);
    const unsigned of_pixels[4] = {piece.x, piece.y, piece.z, piece.w};
#pragma unroll
    for (int j = 0; j < 4; ++j) {
        const Compared p = compared(drawn[j], of_pixels[j], channel);
        if (RENDER) {
            values[X][j] = p.render;
            values[XX][j] = p.render * p.render;
            values[XY][j] = p.render * p.target;
        }
        if (TARGET) {
            values[FIRST_OF_TARGET + Y][j] = p.target;
            values[FIRST_OF_TARGET + YY][j] = p.target * p.target;
        }
    }
}

// RENDER: compare with the render. TARGET: blur the photograph, for the comparison or, without it, to keep.
template <bool RENDER, bool TARGET>
__global__ void __launch_bounds__(THREADS, 4)
    windows_kernel(Photographs photographs, LossArrays loss, LossSettings settings, const DeviceState* state) {
    constexpr int MAPS = N_MAPS<RENDER, TARGET>, FIRST_OF_TARGET = MAPS - N_OF_TARGET;
    alignas(16) __shared__ float render[RENDER ? HALO * PITCH : 4];
    alignas(16) __shared__ unsigned words[HALO * PITCH];
    alignas(16) __shared__ float rows[MAPS][HALO][SIDE];
    // the photograph's, of this channel and the next; a thread copies those of its own pixels
    __shared__ float moments[TARGET ? 1 : 2][N_OF_TARGET][RUN][TARGET ? 1 : THREADS];
    if (halted(state)) return;
    const Photograph photo = photograph_of(photographs, state);
    const int left = blockIdx.x * SIDE, top = blockIdx.y * SIDE, m = settings.margin;
    const int col = threadIdx.x % SIDE, row = RUN * (threadIdx.x / SIDE), x = left + col;
    const size_t plane = size_t(loss.width) * loss.height;
    const unsigned first_pixel = unsigned(top + row) * loss.width + x;
    const Halo halo(left, top, loss.width, loss.height);
    const float* image = loss.image;
    const int rows_inside = x < loss.width ? min(RUN, loss.height - top - row) : 0;
    if (RENDER) begin_render(halo, image, render);
    if constexpr (!TARGET) begin_moments(photo, plane, 0, first_pixel, loss.width, rows_inside, moments[0]);
    read_photograph(halo, photo, words);
    unsigned counts = 0;
#pragma unroll
    for (int k = 0; k < RUN; ++k) {
        const int y = top + row + k;
        const bool inner = x >= m && x < loss.width - m && y >= m && y < loss.height - m;
        if (inner && kept(photo, first_pixel + unsigned(k * loss.width))) counts |= 1u << k;
    }
    Sums sums = {0.0f, 0.0f, 0.0f};
    float *v_mu = loss.windows, *v_xx = v_mu + plane, *v_xy = v_xx + plane;
    for (int c = 0; c < CHANNELS; ++c) {  // per channel of four pixels, 3 times
        if (RENDER) copies_arrive();
        __syncthreads();
        blur_across<MAPS>(rows, [&](int at, float (&values)[MAPS][4]) {
            four_products<RENDER, TARGET>(render + (RENDER ? at : 0), words + at, c, values);
        });
#pragma unroll
        for (int k = 0; RENDER && k < RUN; ++k) {
            if (k >= rows_inside) break;
            const int at = PITCH * (row + k + SSIM_REACH) + col + SSIM_REACH;
            const Compared p = compared(render[at], words[at], c);
            const float d = p.render - p.target, e = clamped(p.render, 0.0f, 1.0f) - p.target;
            sums.difference += settings.pixelwise == Pixelwise::l2 ? d * d : fabsf(d);
            sums.square += e * e;
        }
        __syncthreads();
        // what is next is on its way while this channel's runs down are made
        ++image;
        if (RENDER && c + 1 < CHANNELS) begin_render(halo, image, render);
        if constexpr (!TARGET)
            if (c + 1 < CHANNELS)
                begin_moments(photo, plane, c + 1, first_pixel, loss.width, rows_inside, moments[(c + 1) % 2]);
        float blur[MAPS][RUN] = {};
        blur_down<MAPS>(rows, col, row, blur);
#pragma unroll
        for (int k = 0; k < RUN; ++k) {
            if (k >= rows_inside) break;
            const unsigned pixel = first_pixel + unsigned(k * loss.width);
            if (!RENDER) {
                float* moments_of_pixel = photo.moments + c * plane + pixel;
                moments_of_pixel[0] = blur[FIRST_OF_TARGET + Y][k];
                moments_of_pixel[CHANNELS * plane] = blur[FIRST_OF_TARGET + YY][k];
                continue;
            }
            WindowMoments<float> w = {blur[X][k], 0.0f, blur[XX][k], 0.0f, blur[XY][k]};
            w.mu_y = TARGET ? blur[FIRST_OF_TARGET + Y][k] : moments[c % 2][Y][k][threadIdx.x];
            w.yy = TARGET ? blur[FIRST_OF_TARGET + YY][k] : moments[c % 2][YY][k][threadIdx.x];
            const bool count = (counts >> k) & 1u;
            const WindowSsim<float> s = compare_window(w);
            v_mu[pixel] = count ? s.v_mu : 0.0f;
            v_xx[pixel] = count ? s.v_xx : 0.0f;
            v_xy[pixel] = count ? s.v_xy : 0.0f;
            sums.similarity += count ? s.S : 0.0f;
        }
        v_mu += CHANNELS * plane, v_xx += CHANNELS * plane, v_xy += CHANNELS * plane;
    }
    if (!RENDER) return;
    const Sums total = block_sums(sums);
    if (threadIdx.x > 0) return;
    float* partials = loss.partials + 3 * size_t(blockIdx.y * gridDim.x + blockIdx.x);
    partials[0] = total.difference;
    partials[1] = total.similarity;
    partials[2] = total.square;
}

// what the windows' blocks found, in their order; for one block
__device__ __forceinline__ void tell_values(const Photograph& photo, const LossArrays& loss,
                                            const LossSettings& settings, int blocks) {
    Sums sums = {0.0f, 0.0f, 0.0f};
    for (int k = threadIdx.x; k < blocks; k += THREADS) {
        sums.difference += loss.partials[3 * k];
        sums.similarity += loss.partials[3 * k + 1];
        sums.square += loss.partials[3 * k + 2];
    }
    sums = block_sums(sums);
    if (threadIdx.x > 0) return;
    // a mask that keeps no window compares nothing, and nothing differs
    const float ssim = photo.window_share > 0.0f ? sums.similarity * photo.window_share : 1.0f;
    const float pixelwise = sums.difference * photo.pixel_share;
    loss.values[V_PIXELWISE] = pixelwise;
    loss.values[V_SSIM] = ssim;
    loss.values[V_OBJECTIVE] = settings.pixelwise_weight * pixelwise + settings.ssim_weight * (1.0f - ssim);
    loss.values[V_SQUARE] = sums.square * photo.pixel_share;
}

// of one channel of every map, what a block's pixels are blurred from
template <int MAPS>
__device__ __forceinline__ void begin_derivatives(const Halo& halo, const float* const (&windows)[MAPS],
                                                  float (*derivatives)[HALO * PITCH]) {
#pragma unroll
    for (int k = 0; k < SLOTS; ++k) {
        if (!Halo::fills(k)) continue;
        const bool there = halo.pixel[k] >= 0;
#pragma unroll
        for (int d = 0; d < MAPS; ++d)
            begin_copy(&derivatives[d][Halo::place(k)], windows[d] + unsigned(there ? halo.pixel[k] : 0), there);
    }
}

__global__ void __launch_bounds__(THREADS, 4)
    pixels_kernel(Photographs photographs, LossArrays loss, LossSettings settings, const DeviceState* state) {
    constexpr int MAPS = 3;
    alignas(16) __shared__ float derivatives[MAPS][HALO * PITCH];
    alignas(16) __shared__ float rows[MAPS][HALO][SIDE];
    if (halted(state)) return;
    const Photograph photo = photograph_of(photographs, state);
    // a launch of its own for the sums would cost more than one block's delay
    if (blockIdx.x == 0 && blockIdx.y == 0) tell_values(photo, loss, settings, gridDim.x * gridDim.y);
    const int left = blockIdx.x * SIDE, top = blockIdx.y * SIDE;
    const int col = threadIdx.x % SIDE, row = RUN * (threadIdx.x / SIDE), x = left + col;
    const size_t plane = size_t(loss.width) * loss.height;
    const unsigned first_pixel = unsigned(top + row) * loss.width + x;
    const int rows_inside = x < loss.width ? min(RUN, loss.height - top - row) : 0;
    const Halo halo(left, top, loss.width, loss.height);
    const float* windows[MAPS] = {loss.windows, loss.windows + plane, loss.windows + 2 * plane};
    begin_derivatives(halo, windows, derivatives);
    unsigned words[RUN];
#pragma unroll
    for (int k = 0; k < RUN; ++k)
        words[k] = word_of(photo, k < rows_inside ? first_pixel + unsigned(k * loss.width) : 0u);
    const float* image = loss.image;
    float* v_image = loss.v_image;
    for (int c = 0; c < CHANNELS; ++c) {  // per channel of four pixels, 3 times
        copies_arrive();
        __syncthreads();
        blur_across<MAPS>(rows, [&](int at, float (&values)[MAPS][4]) {
#pragma unroll
            for (int d = 0; d < MAPS; ++d) four_of(derivatives[d] + at, values[d]);
        });
        __syncthreads();
        // what is next is on its way while this channel's runs down are made
#pragma unroll
        for (int d = 0; d < MAPS; ++d) windows[d] += CHANNELS * plane;
        if (c + 1 < CHANNELS) begin_derivatives(halo, windows, derivatives);
        float drawn[RUN];
#pragma unroll
        for (int k = 0; k < RUN; ++k)
            drawn[k] = read_here(image + (k < rows_inside ? value_of(first_pixel + unsigned(k * loss.width)) : 0u));
        float v[MAPS][RUN] = {};
        blur_down<MAPS>(rows, col, row, v);
#pragma unroll
        for (int k = 0; k < RUN; ++k) {
            if (k >= rows_inside) break;
            const unsigned value = value_of(first_pixel + unsigned(k * loss.width));
            const Compared p = compared(drawn[k], words[k], c);
            const float difference = p.render - p.target;
            // B4: sign(0) = 0
            const float sign = float(difference > 0.0f) - float(difference < 0.0f);
            const float of_pixel = settings.pixelwise == Pixelwise::l2 ? 2.0f * difference : sign;
            const float of_windows = pixel_from_windows(p.render, p.target, v[0][k], v[1][k], v[2][k]);
            const float sum = settings.pixelwise_weight * photo.pixel_share * of_pixel -
                              settings.ssim_weight * photo.window_share * of_windows;
            v_image[value] = words[k] & LEFT_OUT ? 0.0f : sum;
        }
        ++image, ++v_image;
    }
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
        windows_kernel<true, true><<<grid, THREADS, 0, stream>>>(photographs, loss, settings, state);
    else
        windows_kernel<true, false><<<grid, THREADS, 0, stream>>>(photographs, loss, settings, state);
    POP_LAUNCHED("windows_kernel");
    pixels_kernel<<<grid, THREADS, 0, stream>>>(photographs, loss, settings, state);
    POP_LAUNCHED("pixels_kernel");
}

}  // namespace pop
