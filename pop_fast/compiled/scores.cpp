// The passes over a view, called through ctypes. Tiles are shared out to threads and each writes rows of its own, which
// are added up in the order of the lists, so that no bit depends on the number of threads.

#include "scores.h"

#include "c_api.h"

namespace pop {

namespace {

// Go through all tiles, one(pixels, tile, state) with what `make` makes, and add the rows up where there are some.
template <class Real, class Make, class Row, class Any>
void pass(const Scores<Real> &scores, Fork fork, int columns, Make make, Row rows_of_pixels, Any strips_of_pixels) {
  make_splats<Real>(scores, fork);
  const Pixels<Real> pixels(int(scores.tile_size));
  share(fork, scores.threads, scores.tiles(), TILES_AT_A_TIME, [&] { return make(pixels); },
        [&](auto &own, int64_t first, int64_t last) {
          for (int64_t tile = first; tile < last; tile++)
            pixels.strips_are_rows() ? rows_of_pixels(scores, pixels, tile, own)
                                     : strips_of_pixels(scores, pixels, tile, own);
        });
  if (columns == 0) return;
  const int64_t part = std::max<int64_t>(1, (scores.n + scores.threads - 1) / scores.threads);
  share(fork, scores.threads, scores.n, part,
        [&](int64_t first, int64_t last) { add_rows(scores, columns, first, last); });
}

}  // namespace

template <class Real> void contributions(const Scores<Real> &scores, Fork fork) {
  const auto make = [](const Pixels<Real> &pixels) { return ContributionsState<Real>(pixels); };
  pass(scores, fork, CONTRIBUTIONS, make, contributions_of_tile<Real, true>, contributions_of_tile<Real, false>);
}

template <class Real> void sensitivities(const Scores<Real> &scores, Fork fork) {
  const auto make = [](const Pixels<Real> &pixels) { return BackState<Real, 1>(pixels, SENSITIVITIES); };
  pass(scores, fork, SENSITIVITIES, make, sensitivities_of_tile<Real, true>, sensitivities_of_tile<Real, false>);
}

template <class Real> void screen_moments(const Scores<Real> &scores, Fork fork) {
  const auto make = [](const Pixels<Real> &pixels) { return BackState<Real, 3>(pixels, MOMENTS); };
  pass(scores, fork, MOMENTS, make, moments_of_tile<Real, true>, moments_of_tile<Real, false>);
}

template <class Real> void dominant_points(const Scores<Real> &scores, Fork fork) {
  const auto make = [](const Pixels<Real> &pixels) { return PointsState<Real>(pixels); };
  pass(scores, fork, 0, make, points_of_tile<Real, true>, points_of_tile<Real, false>);
}

}  // namespace pop

extern "C" {
POP_STAGE(contributions, Scores, contributions)
POP_STAGE(sensitivities, Scores, sensitivities)
POP_STAGE(screen_moments, Scores, screen_moments)
POP_STAGE(dominant_points, Scores, dominant_points)

// what `library.py` compares
int64_t pop_scores_bytes() { return int64_t(sizeof(pop::Scores<float>)); }
}
