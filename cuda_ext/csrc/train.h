// What a fused training step adds to launch.h: the loss, the update, density statistics, rows.
#pragma once

#include "launch.h"
#include "optimizer.cuh"

namespace pop {

enum class Pixelwise : int { l2 = 0, l1 = 1 };

struct LossSettings {
    Pixelwise pixelwise;
    float pixelwise_weight;  // (1 - lambda_ssim) times the scale of the pixelwise term
    float ssim_weight;       // lambda_ssim, halved where D-SSIM is
    int margin;              // 5 for "valid", 0 for "same"
};

// Photographs stay on the device as bytes; tables have one entry a view, and state->view picks it.
struct Photographs {
    const uint8_t* const* images;   // [H, W, 3] each
    const uint8_t* const* masks;    // [H, W] each, nonzero keeps; null for none
    const float* shares;            // [views, 2]: 1 / values compared, 1 / windows compared
    float* const* moments;          // [2, 3, H, W] each: blurred y and y^2; null computes them every time
};

// What a step tells: the pixelwise mean, SSIM, the photometric objective, the mean square with the render clamped to
// [0, 1] (for PSNR), the weighted regularizers.
enum Value { V_PIXELWISE, V_SSIM, V_OBJECTIVE, V_SQUARE, V_POP, N_VALUES };

struct LossArrays {
    const float* image;   // [H, W, 3]
    float* windows;       // [3, 3, H, W]: channel, derivative
    float* partials;      // [blocks, 3]
    float* values;        // [N_VALUES]; the first four are written here
    float* v_image;       // [H, W, 3]
    int width, height;
};

struct AdamGroup {
    float *param, *m, *v;
    float* gradient;  // as param: summed over the views of a step; null where a step has one
};

enum Group { G_MEANS, G_SCALES, G_QUATS, G_OPACITIES, G_SH0, G_SHN, N_GROUPS };

struct StepConstants {
    AdamStep<float> adam[N_GROUPS];
};

struct Schedule {
    const int* views;        // [steps, n_views], the views of every step
    int n_views, place;      // views of a step; which of them is begun, from 0
    const double* rates;     // [steps, N_GROUPS], learning rates
    const int* numbers;      // [steps, N_GROUPS], of the updates, from 1; 0 where a group is not moved
    double beta1, beta2, eps;
    const float* viewmats;   // [views, 16]
    const float* Ks;         // [views, 9]
    float* viewmat;          // [16], this step's
    float* K;                // [9]
};

// What every Gaussian adds to the loss by itself, weighted by one over their number: the entropy of its opacity, its
// opacity, the sum of its scales; 0 leaves one out.
struct Regularizers {
    float entropy, opacity, scale;
};

struct UpdateArrays {
    AdamGroup groups[N_GROUPS];
    int n, n_rest;               // Gaussians; rows of harmonics beyond the first
    // views of a step, and which of them sums are of, from 0: gradients are added up, and their mean moves parameters
    // with the last one; the rest is the view's own
    int n_views, place;
    const StepConstants* constants;
    float* sh_rest_sum;          // [n, n_rest, 3], gradients that wait for an update; null where none do
    const float* sums;           // [n, RECORD]
    const int* dominant_counts;  // [n] or null
    const uint8_t* pop_sides;    // [n], a PopSide each; read where lambda_pop is not 0
    float lambda_pop;            // 0 leaves the POP term out
    Regularizers own;
    // density statistics, each may be null
    float* grad_sum;
    int* n_visible;
    int* dominant_sum;
    uint8_t* blurred;
    const float* blur_pixels;    // [views]: of state->view, a count above it blurs; read where blurred is asked for
    bool blur_own_view;          // the flag is this view's alone; else it stays up until the next densification step (A2)
};

// which Gaussians take part in the POP term, on which side, and what their terms and the regularizers come to
struct PopTerm {
    int n;
    const int* dominant_counts;  // [n]; null where the POP term is off
    const int* window_counts;    // [n], of the window's views before this one; null where this view alone decides (A1)
    const int* radii;            // [n, 2]; null where all take part, not only those that the view shows (A12)
    const float* logits;         // [n]
    const float* log_scales;     // [n, 3]
    Regularizers own;
    uint8_t* sides;              // [n], a PopSide each
    float* sums;                 // [important_blocks(n), 3]: 1 - o over the important, o over the others, regularizers
};

// what end_step keeps of a step
struct StepRecord {
    float* values;          // [N_VALUES]
    float* history;         // [steps, N_VALUES]: row `step` is written
    const float* pop_sums;  // [important_blocks(n), 3], or null where no such term is on
    int n;
    float lambda_pop;       // 0 where the POP term is off
};

int loss_blocks(int width, int height);
int important_blocks(int n);
void target_moments(const Photographs& photographs, const LossArrays& loss, const LossSettings& settings,
                    const DeviceState* state, cudaStream_t stream);
void photometric(const Photographs& photographs, const LossArrays& loss, const LossSettings& settings,
                 const DeviceState* state, cudaStream_t stream);
void begin_step(const Schedule& schedule, StepConstants* constants, DeviceState* state, cudaStream_t stream);
// also counts both sides, into state->n_important and n_others
void count_important(const PopTerm& term, DeviceState* state, cudaStream_t stream);
void update(const UpdateArrays& arrays, const ViewArrays& view, const ProjectSettings& settings,
            const SplatArrays& splats, DeviceState* state, cudaStream_t stream);
void end_step(const StepRecord& record, DeviceState* state, cudaStream_t stream);

}  // namespace pop
