// What the host may ask of the kernels: plain structs of device pointers, and one function a stage. No function here
// allocates or synchronises, so that a whole training step can be captured in a CUDA graph.
#pragma once

#include <cuda_runtime.h>

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>

#include "profile.cuh"
#include "splatting.cuh"

// Every CUDA call and launch goes through here: a failure throws, with the call, the place and CUDA's own words.
#define POP_CUDA(call) ::pop::check_cuda((call), #call, __FILE__, __LINE__)
// a launch reports its own errors at once; what happens inside the kernel surfaces at the next synchronisation
#define POP_LAUNCHED(kernel) ::pop::check_cuda(cudaGetLastError(), "launch of " kernel, __FILE__, __LINE__)

namespace pop {

inline void check_cuda(cudaError_t error, const char* what, const char* file, int line) {
    if (error == cudaSuccess) return;
    throw std::runtime_error(std::string("CUDA: ") + what + " failed with " + cudaGetErrorName(error) + " (" +
                             cudaGetErrorString(error) + ") at " + file + ":" + std::to_string(line));
}

constexpr int RECORD = 12;                // floats of a packed splat, and of a row of gradient sums
constexpr int WARP_TILE_W = 16, WARP_TILE_H = 8, TILE_PIXELS = WARP_TILE_W * WARP_TILE_H;
constexpr int MAX_CHANNELS = 4;

// Flags and counts that the device keeps; the host reads them one step late.
struct DeviceState {
    int overflow;            // instances where they did not fit; every later step does nothing while > 0
    int n_instances;
    int n_buckets;
    int n_important;         // Gaussians on each side of the POP term
    int bad_row;             // the first Gaussian with a value that is not finite, or INT_MAX
    int step;                // of the fused training step, from 0
    int view;                // the photograph of this step
    int n_others;
};

struct GaussianArrays {
    int n;
    const float* means;      // [n, 3]
    const float* quats;      // [n, 4]
    const float* scales;     // [n, 3], logarithms where raw
    const float* opacities;  // [n], logits where raw
    const float* sh_first;   // [n, sh_first_stride]: the first band, or all where sh_rest is null
    const float* sh_rest;    // [n, sh_rest_stride], bands beyond the first, or null
    int sh_first_stride, sh_rest_stride;  // floats a row
    bool raw;
};

// colors may be given instead of computed: then sh_first is null and project leaves them alone; where records are
// packed at once, colors may be null
struct SplatArrays {
    float* means2d;    // [n, 2]
    float* depths;     // [n]
    float* conics;     // [n, 3]
    float* opacities;  // [n]
    float* colors;     // [n, channels]
    int* radii;        // [n, 2]
    float* records;    // [n, RECORD], packed for blending where seen; null where colors are given or packed later
};

struct ViewArrays {
    const float* viewmat;  // [16]
    const float* K;        // [9]
    int width, height;
};

struct ProjectSettings {
    Profile<float> profile;
    ProjectOptions<float> options;
    int sh_degree;
};

// Lists of splats by tile. `capacity` instances fit; if there are more, nothing is listed and state->overflow counts them.
struct TileLists {
    int n, capacity, n_tiles;
    TileGrid grid;
    unsigned* depth_keys[2];   // [n]
    unsigned* order[2];        // [n], splats front to back in order[1]
    unsigned* hits;            // [hit_words(n)], a bit for each tile that was tried while counting; null if not exact
    void* tile_keys[2];        // [capacity], 16 or 32 bits
    unsigned* slots[2];        // [capacity]
    unsigned* slot_splat;      // [capacity], splat of an instance slot
    unsigned* listed;          // [capacity], splats tile by tile, front to back
    int* tile_begin;           // [n_tiles]
    int* tile_end;             // [n_tiles]
    unsigned* tile_order;      // [n_tiles], tiles by the length of their lists, longest first
    unsigned* splat_begin;     // [n], first slot of a splat
    unsigned* splat_count;     // [n], its slots
    int* bucket_begin;         // [n_tiles], first bucket of 32 list entries of a tile; null where no one asks
    int* bucket_tile;          // [capacity / 32 + n_tiles]
    uint8_t* workspace;
    size_t workspace_bytes;
    bool exact;                // drop tiles that no pixel centre reaches
};

struct BlendForward {
    int channels;
    const float* records;     // [n, RECORD]
    const float* background;  // [channels] or null
    float* image;             // [H, W, channels]
    float* T_final;           // [H, W]
    int* last;                // [H, W], list position of the splat that stopped a pixel, or the list's length
    float* checkpoints;       // [buckets, 1 + channels, TILE_PIXELS] or null
    // instruments: the dominant ones together or not at all, the counts of splats with them or not at all
    int* dominant_ids;
    float* dominant_weights;
    int* dominant_counts;     // [n], zeroed by the caller
    int* n_blended;
    int* n_traversed;
    // pixels that a mask leaves out are not counted: one mask a view [H, W], picked by state->view; null counts all
    const uint8_t* const* masks;
    const DeviceState* state;  // read with masks
};

enum class Backward : int { pixel_parallel = 0, gaussian_parallel = 1 };
enum class Gather : int { slots = 0, atomics = 1 };

struct BlendBackward {
    int channels;
    Backward backward;
    Gather gather;
    bool absolute;            // also sum |v_means2d|
    const float* records;
    const float* background;
    const float* image;       // read by backward gaussian_parallel
    const float* T_final;
    const int* last;
    const float* checkpoints; // read by backward gaussian_parallel
    const float* v_image;
    const float* v_T_final;   // or null
    float* rows;              // [capacity * tiles of a list tile, RECORD], for slots
    float* sums;              // [n, RECORD]; zeroed by the caller for atomics
};

// sums over the pixels of every splat, or what every pixel belongs to
enum class Score : int { contributions = 0, sensitivities = 1, moments = 2, points = 3 };

// A pass over a view that blend_forward has drawn. Records carry what the score reads of a splat in the place of its
// colour: nothing, the sum of its channels, its colour, or g, by which t* >= 0 is told.
struct ScoreArrays {
    const float* records;     // [n, RECORD]
    const float* background;  // [channels], for sensitivities the sum of them; read by sensitivities and moments
    const float* T_final;     // [H, W]
    const int* last;          // [H, W]
    const float* pixel_map;   // [H, W] or null, read by contributions
    float fx, fy, cx, cy;     // px, of the rays; read by points
    float* rows;              // [capacity * tiles of a list tile, score_pitch], zeros
    double* totals;           // [n, score_columns]
    int* ids;                 // [H, W], written by points
};

struct SplatGradients {
    float* v_means2d;
    float* v_means2d_abs;     // or null
    float* v_conics;
    float* v_opacities;
    float* v_colors;
};

struct GaussianGradients {
    float* v_means;
    float* v_quats;
    float* v_scales;
    float* v_opacities;
    float* v_sh;              // [n, sh_stride], or null
    int sh_stride;
    float* v_viewmat;         // [blocks, 12] partial sums, or null
};

constexpr int PROJECT_BLOCK = 128;

void project(const GaussianArrays& gaussians, const ViewArrays& view, const ProjectSettings& settings,
             const SplatArrays& splats, DeviceState* state, cudaStream_t stream);
void pack_records(int n, int channels, const SplatArrays& splats, float alpha_floor, float* records,
                  cudaStream_t stream);
size_t tile_workspace(int n, int capacity, int n_tiles);
size_t hit_words(int n);
// Two that need nothing of each other, and number_instances, which needs both; make_tile_lists continues from there.
// state->n_instances is written by number_instances where the lists have no capacity yet, else by make_tile_lists; it
// stops at INT_MAX.
void sort_by_depth(const TileLists& lists, const SplatArrays& splats, cudaStream_t stream);
void count_tiles(const TileLists& lists, const SplatArrays& splats, const Profile<float>& profile, cudaStream_t stream);
void number_instances(const TileLists& lists, DeviceState* state, cudaStream_t stream);
// dominant_counts: [n], set to zero on the way for blend_forward; null for none
void make_tile_lists(const TileLists& lists, const SplatArrays& splats, const Profile<float>& profile,
                     int* dominant_counts, DeviceState* state, cudaStream_t stream);
// fills lists.tile_order; make_tile_lists calls it
void order_tiles(const TileLists& lists, cudaStream_t stream);
void blend_forward(const TileLists& lists, const BlendForward& blend, const Profile<float>& profile,
                   cudaStream_t stream);
void blend_backward(const TileLists& lists, const BlendBackward& blend, const Profile<float>& profile,
                    const DeviceState* state, cudaStream_t stream);
void splat_gradients(int n, int channels, const SplatArrays& splats, const float* sums,
                     const SplatGradients& gradients, cudaStream_t stream);
int score_columns(Score score);
int score_pitch(Score score);
void score_view(const TileLists& lists, const ScoreArrays& scores, Score score, const Profile<float>& profile,
                cudaStream_t stream);
void project_backward(const GaussianArrays& gaussians, const ViewArrays& view, const ProjectSettings& settings,
                      const SplatArrays& splats, const SplatGradients& of, const float* v_depths,
                      const GaussianGradients& gradients, cudaStream_t stream);

}  // namespace pop
