// One step of training: what it is given, and what it keeps from one step to the next.
//
// The step in order, every line shared out to the threads (`step_*.cpp`), `list` in two goes:
//     project         a Gaussian's splat, colour, and the tiles it reaches
//     list            depth order; each tile's list, front to back
//     blend           the picture tile by tile, its dominant Gaussians, its difference from the photograph
//     loss            SSIM and its derivatives by the windows' moments
//     image_gradient  the gradient of the loss with respect to the picture, and to its exposure and depth
//     transpose       tile by tile back to the entries of the lists
//     update          entries added up, back to raw parameters, the POP term, statistics of density control, Adam
// The arithmetic of one Gaussian is the one that the CUDA kernels run. Every sum is over parts that do not depend on the
// number of threads, so that no bit does.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <type_traits>
#include <vector>

#include "backward.h"
#include "cuda_ext/csrc/optimizer.cuh"
#include "cuda_ext/csrc/splatting.cuh"
#include "forward.h"
#include "row_block.h"
#include "ssim.h"
#include "threads.h"

namespace pop {

enum StepGroup { MEANS, SCALES, QUATS, OPACITIES, SH0, SHN, GROUPS };
enum StepPart { PROJECT, LIST, BLEND, LOSS, IMAGE_GRADIENT, TRANSPOSE, UPDATE, PARTS };
enum StepValue { PIXELWISE, SSIM, OBJECTIVE, SQUARE, POP, VALUES };

constexpr int STEP_TILE = LANES<float>;  // a row of a tile is one vector

// Everything of one step; eight bytes each, in the order of `native_step.py`.
struct StepGiven {
  float *params[GROUPS], *m[GROUPS], *v[GROUPS];  // raw parameters by `StepGroup`, and Adam's moments
  int64_t n, n_rest;                              // Gaussians; bands beyond the first
  const float *viewmat, *K;                       // [4, 4], [3, 3]
  const float *target, *mu_y, *s_yy;              // photograph and its moments under SSIM's windows. [3, H, W], [3, h, w]
  const uint8_t *kept;                            // nonzero for pixels that count; null: all do. [H, W]
  const float *kept_windows;                      // 1 for windows that count, else 0; null: all do. [h, w]
  int64_t width, height, n_kept, n_windows;       // pixels, windows that count
  int64_t near_inclusive, centred, inria_clamp, square, antialiased, ceiling_passes;  // see profile.cuh
  double near_plane, far_plane, eps2d, frustum_margin, extent_sigmas, alpha_floor;
  double floor_below, alpha_ceiling, stop;        // as in `Blend`
  const float *exposure;                          // of the photograph, null: none is learned. [3, 4]
  const float *samples;                           // sparse points it sees: place, px, disparity; null: no depth. [M, 3]
  int64_t n_samples;
  double background[3];
  int64_t degree, border, l1;                     // active band; black pixels around the image for SSIM; L1 instead of L2
  double pixel_weight, ssim_weight;
  double lambda_pop, lambda_entropy;              // each 0 where its term is off
  double depth_weight, opacity_reg, scale_reg;    // likewise
  int64_t dominance, pop_window, pop_visible, blur_own_view;  // dominance: counts are made
  double blur_pixels;                             // a view's count above it blurs
  double lr[GROUPS], beta1, beta2, eps;
  int64_t most_entries;                           // of all lists; a step that has more is not taken
  int64_t updates[GROUPS];                        // number of the update, from 1; 0 where a group is not moved
  float *sh_rest_sum;                             // gradients that wait for an update, null where none do. [N, n_rest, 3]
  float *grad_sum;                                // statistics of density control, each null where not asked for. [N]
  int32_t *n_visible, *dominant_sum;
  uint8_t *blurred;
  double *v_exposure;                             // where an exposure is learned. [3, 4]
  double *values;                                 // by `StepValue`
  double *seconds;                                // by `StepPart`, added to
  int64_t *bad_row;                               // first Gaussian that is not finite, or -1
};

// A Gaussian as one camera sees it, and where its entries are.
struct Seen {
  float x, y, a, b, c, opacity, limit, depth;  // screen centre, conic, effective opacity, log(opacity / floor), camera z
  int32_t x0, y0, x1, y1;                      // tiles, half open
  uint64_t tiles;                              // those of them that it reaches, where they are 64 at most
  int32_t n, first;                            // entries, -1 where it is culled; the first one's slot in its part
};

constexpr int PRIOR_SUMS = 5;       // of a part: opacities of both sides of the POP term, entropies, opacities, scales
constexpr int MOST_COLUMNS = 10;    // of an entry's row: six moments, colours, depth
constexpr int EXPOSURE = 12;        // numbers of an exposure
constexpr int64_t ROWS = 256;       // Gaussians in a part
constexpr int64_t BUCKETS = 512;    // of depths
constexpr int64_t SOME_TILES = 64;  // whose entries are added up at a time
constexpr int64_t SIDE_PARTS = 16;  // parts whose sides of the POP term are counted at a time
static_assert(ROWS % ROW_BLOCK == 0);
constexpr int SHORT = 14;           // floats of a row besides the bands beyond the first

inline int64_t parts_of(int64_t n, int64_t part) { return (n + part - 1) / part; }

// What one thread works with.
struct Worker {
  Canvas<float> canvas;
  Transpose<float> transpose;
  Products<float> products;
  Blur<float> blur;
  RowBlock block = {};
  std::vector<float> gradients;  // of ROW_BLOCK Gaussians, parameter by parameter
  Worker(const Pixels<float> &pixels, int64_t channels, int64_t stride, int64_t n_rest)
      : canvas(pixels, channels), transpose(pixels, channels), products(stride), blur(stride),
        gradients(size_t(ROW_BLOCK * (SHORT + 3 * n_rest))) {}
};

// Numbers that keep their memory while they need no more of it; what a step leaves in it means nothing to the next.
template <class T> class Buffer {
public:
  T *get(int64_t n) {
    if (n > size) {
      // an eighth more than needed: lists grow a little from step to step
      size = n + n / 8;
      numbers.reset();
      numbers.reset(static_cast<T *>(::operator new(size_t(size) * sizeof(T), std::align_val_t(64))));
    }
    return numbers.get();
  }
  const T &operator[](int64_t i) const { return numbers.get()[i]; }
  int64_t bytes() const { return size * int64_t(sizeof(T)); }

private:
  struct Free {
    void operator()(T *p) const { ::operator delete(p, std::align_val_t(64)); }
  };
  std::unique_ptr<T, Free> numbers;
  int64_t size = 0;
};

// What a step had to do, in the order of `native_step.py`.
struct StepCounts {
  int64_t visible;  // Gaussians with an entry
  int64_t entries;  // of all lists
  int64_t walked;   // of these, those before the last pixel of the tile had stopped
  int64_t chunks;   // that these make
  int64_t pairs;    // of a walked entry and a pixel of a strip in which some pixel had not stopped
  int64_t marked;   // of a walked entry and such a strip which it may reach by its parabola: blended
  int64_t reached;  // of these, those where it changed a pixel: transposed
};

// The least and the greatest of some depths, as bits in their order.
struct Depths {
  uint32_t low = ~uint32_t(0), high = 0;
};

// What has come of a part's Gaussians so far.
struct Part {
  uint64_t *keys;                       // of the visible ones
  int64_t visible = 0, slot = 0, bad = -1;  // slots given out; the first row that is not finite, or -1
  Depths depths;
};

class Stepper : public Plan {
public:
  explicit Stepper(int64_t threads) : pool(threads), pixels(STEP_TILE) {}
  // Take n steps, fewer where a row is found that is not finite or *stop is not 0 any more, and return how many.
  int64_t steps(const StepGiven *first, int64_t n, const int32_t *stop);
  bool next(Work &work) override;
  bool abandoned() const override;
  int64_t bytes() const;
  Trace &trace() { return pool.trace; }
  // of the last step; none where it was not taken to its end
  StepCounts counted() const;

private:
  Pool pool;
  Pixels<float> pixels;
  std::vector<std::unique_ptr<Worker>> workers;
  int64_t worker_stride = 0, worker_rest = -1, worker_channels = 0;
  // of Gaussians
  Buffer<Seen> seen;
  Buffer<Splat> splats;
  Buffer<int32_t> counts;
  Buffer<uint64_t> keys, sorted;
  std::vector<int64_t> part_visible, part_slots;
  std::vector<Depths> part_depths;
  // of depths: keys of each group of parts by bucket, where a bucket begins; a bucket is the depth above the lowest one,
  // without its last bits
  std::vector<int64_t> buckets, bucket_begins;
  uint32_t lowest = 0;
  int bucket_shift = 0;
  int64_t group_parts = 1;
  // of tiles and entries
  std::vector<int64_t> starts, offsets, first_chunks, n_reached;
  Buffer<int64_t> ids;
  Buffer<int32_t> slots;
  Buffer<float> transmittances, rows;
  Buffer<uint16_t> reached;
  // of pixels
  Buffer<float> difference, alphas, unexposed, partials, v_image, v_alphas;
  std::vector<double> tile_sums, window_sums, exposure_sums, pop_sums;
  std::vector<int64_t> sides;  // important and others, of each SIDE_PARTS parts
  double depth_sum = 0.0;

  // of the step that is taken
  const StepGiven *given = nullptr, *last_given = nullptr;
  // the next work of the step; the last one, the update, is `UPDATE_STAGE`
  static constexpr int UPDATE_STAGE = 12;
  std::atomic<int> stage{0};
  const int32_t *asked = nullptr;
  bool ended = false;
  std::chrono::steady_clock::time_point stage_began;
  Camera<float> camera;
  Profile<float> profile;
  ProjectOptions<float> options;
  AdamStep<float> adam_steps[GROUPS];
  Blend<float> blend;
  Ssim<float> ssim[3];
  int64_t n_visible = 0, n_important = 0, n_others = 0;

  void book_time();
  void begin();
  void make_workers();
  Work project();
  template <int DEGREE> void project_part(Worker &own, int64_t first, int64_t last);
  template <int DEGREE> void project_block(RowBlock &block, int64_t first, int64_t last, Part &part);
  template <int DEGREE> bool project_splat(const RowBlock &block, int64_t i, int64_t l, Seen &to);
  void reach_tiles(Seen &of) const;
  template <class F> void each_tile(const Seen &of, F f) const;
  bool all_finite() const;
  bool few_enough() const;
  Work count_buckets();
  template <class F> void each_key(int64_t first, int64_t last, F f) const;
  int64_t bucket_of(uint64_t key) const { return (uint32_t(key >> 32) - lowest) >> bucket_shift; }
  Work fill_buckets();
  Work sort_buckets();
  void sort_bucket(uint64_t *first, uint64_t *last, uint64_t *spare) const;
  int64_t list_part() const;
  template <class F> void each_entry(int64_t first, int64_t last, F f) const;
  Work count_entries();
  Work add_up_parts();
  Work place_entries();
  Work blend_tiles();
  void expose(int64_t tile);
  void differ(int64_t tile);
  Ssim<float> ssim_of(int channel);
  Work loss();
  Work image_gradient();
  void image_gradient_rows(Worker &own, int64_t first, int64_t last);
  void unexpose_gradient(int64_t begin, int64_t end, double *sums);
  void compare_depth();
  Work transpose_tiles();
  Work count_sides();
  int side_of(int64_t i) const;
  Work update();
  float *gradients_of(Worker &own, StepGroup group) const;
  template <int DEGREE> void update_block(Worker &own, int64_t first, int64_t last, double *pop_sum);
  template <int DEGREE> void transpose_block(Worker &own, int64_t first, int64_t last);
  template <int DEGREE> Vec3<float> transpose_entries(int64_t i, int64_t l, RowBlock &block);
  void add_up_rest(const float *gradient, int64_t first, int64_t n);
  void adam(StepGroup group, const float *gradient, int64_t first, int64_t n);
  void finish();
};

// ---- a Gaussian's row as the step keeps it, for the parts of the step that work row by row

constexpr int ROW_FLOATS[] = {3, 3, 4, 1, 3};  // of a Gaussian, by `StepGroup`; the bands beyond the first come last

inline Vec3<float> vec3_of(const float *row) { return {row[0], row[1], row[2]}; }

inline void put(float *to, Vec3<float> v) {
  to[0] = v.x;
  to[1] = v.y;
  to[2] = v.z;
}

inline GaussianRow<float> gaussian_of(const StepGiven &given, int64_t i) {
  const float *q = given.params[QUATS] + 4 * i;
  return {vec3_of(given.params[MEANS] + 3 * i),
          {q[0], q[1], q[2], q[3]},
          scale_from_log_scale(vec3_of(given.params[SCALES] + 3 * i)),
          opacity_from_logit(given.params[OPACITIES][i])};
}

inline void load_row(const StepGiven &given, int64_t i, int64_t l, RowBlock &to) {
  const GaussianRow<float> g = gaussian_of(given, i);
  put_column(g.mean, l, to.means);
  put_column<4>({g.quat.w, g.quat.x, g.quat.y, g.quat.z}, l, to.quats);
  put_column(g.scale, l, to.scales);
  to.opacities[0][l] = g.opacity;
}

inline ShRow<float> harmonics_of(const StepGiven &given, int64_t i) {
  return {given.params[SH0] + 3 * i, given.params[SHN] + 3 * given.n_rest * i};
}

// Call with the degree as a constant.
template <class Call> void with_degree(int64_t degree, Call call) {
  if (degree == 0) return call(std::integral_constant<int, 0>());
  if (degree == 1) return call(std::integral_constant<int, 1>());
  if (degree == 2) return call(std::integral_constant<int, 2>());
  call(std::integral_constant<int, 3>());
}

}  // namespace pop
