// The compiled stages for float and double, called through ctypes: colours, tile lists, the blend and its transpose.
// Tiles are shared out to threads one after the other, and each writes what is its own, so that no bit depends on the
// number of threads.

#include "backward.h"
#include "colors.h"
#include "c_api.h"
#include "forward.h"
#include "lists.h"
#include "projection.h"
#include "ssim.h"
#include "threads.h"

namespace pop {

template <class Real> void forward(const Blend<Real> &blend, Fork fork) {
  make_splats(blend, fork);
  const Pixels<Real> pixels(int(blend.tile_size));
  const auto make = [&] { return Canvas<Real>(pixels, blend.channels); };
  const auto one_tile = blend_tile_function<Real>(blend, pixels);
  share(fork, blend.threads, blend.tiles(), TILES_AT_A_TIME, make, [&](Canvas<Real> &own, int64_t first, int64_t last) {
    for (int64_t tile = first; tile < last; tile++) one_tile(blend, pixels, tile, own);
  });
}

template <class Real> void backward(const Blend<Real> &blend, Fork fork) {
  const Pixels<Real> pixels(int(blend.tile_size));
  const auto make = [&] { return Transpose<Real>(pixels, blend.channels); };
  const auto one_tile = transpose_tile_function<Real>(blend, pixels);
  share(fork, blend.threads, blend.tiles(), TILES_AT_A_TIME, make,
        [&](Transpose<Real> &own, int64_t first, int64_t last) {
          for (int64_t tile = first; tile < last; tile++) one_tile(blend, pixels, tile, own);
        });
  const int64_t part = std::max<int64_t>(1, (blend.n + blend.threads - 1) / blend.threads);
  share(fork, blend.threads, blend.n, part, [&](int64_t first, int64_t last) { add_up(blend, first, last); });
}

}  // namespace pop

extern "C" {
POP_STAGE(covariances, Covariances, covariances)
POP_STAGE(covariances_backward, Covariances, covariances_backward)
POP_STAGE(projection, Projection, projection)
POP_STAGE(projection_backward, Projection, projection_backward)
POP_STAGE(colors, Colors, color_forward)
POP_STAGE(colors_backward, Colors, color_backward)
POP_STAGE(lists, Lists, list_tiles)
POP_STAGE(forward, Blend, forward)
POP_STAGE(backward, Blend, backward)
POP_STAGE(ssim, Ssim, dissimilarity)
POP_STAGE(moments, Moments, moments)

// what `library.py` compares and asks for
int64_t pop_covariances_bytes() { return int64_t(sizeof(pop::Covariances<float>)); }
int64_t pop_projection_bytes() { return int64_t(sizeof(pop::Projection<float>)); }
int64_t pop_rows_at_a_time() { return pop::ROWS_AT_A_TIME; }
int64_t pop_colors_bytes() { return int64_t(sizeof(pop::Colors<float>)); }
int64_t pop_lists_bytes() { return int64_t(sizeof(pop::Lists<float>)); }
int64_t pop_blend_bytes() { return int64_t(sizeof(pop::Blend<float>)); }
int64_t pop_moments_bytes() { return int64_t(sizeof(pop::Moments<float>)); }
int64_t pop_ssim_bytes() { return int64_t(sizeof(pop::Ssim<float>)); }
int64_t pop_window_rows() { return pop::WINDOW_ROWS; }
int64_t pop_padded_line(int64_t length, int64_t bytes) {
  return bytes == 8 ? pop::padded_line<double>(length) : pop::padded_line<float>(length);
}
int64_t pop_chunk() { return pop::CHUNK; }
int64_t pop_splat_bytes() { return int64_t(sizeof(pop::Splat)); }
int64_t pop_lanes(int64_t bytes) { return 64 / bytes; }
int64_t pop_padded_pixels(int64_t tile_size, int64_t bytes) {
  return bytes == 8 ? pop::Pixels<double>(int(tile_size)).padded() : pop::Pixels<float>(int(tile_size)).padded();
}
}
