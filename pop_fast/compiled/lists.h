// Which splats each tile blends, front to back (D3, D4). Meaning: `pop_ref.tiles.tile_lists`.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "cuda_ext/csrc/tiles.cuh"
#include "threads.h"

namespace pop {

// Everything of one call; eight bytes each, in the order of `library.py`.
template <class Real> struct Lists {
  const Real *means2d, *conics, *opacities;  // [N, 2], [N, 3], [N]; conics null: no entry is left out
  const int64_t *rects;                      // half-open tile rectangles x0, y0, x1, y1. [4, N]
  const int64_t *order;                      // splats with a rectangle, front to back. [M]
  const int64_t *candidates;                 // tiles of the rectangles before each one's. [M + 1]
  int64_t n, m, tiles_x, tiles_y, tile_size, threads;
  double alpha_floor;
  int32_t *tiles;          // tile of every candidate, -1 where it is left out. [candidates]
  int64_t *ids, *offsets;  // the lists: [candidates], of which the last offset is used; [tiles + 1]
};

// The least exponent on the line at `fixed` from the centre, over offsets between low and high, where it is a parabola;
// and the size of the terms that cancel in it.
template <class Real> struct Least {
  Real sigma, size;
};

template <class Real>
inline Least<Real> least_on_line(Real along_fixed, Real cross, Real along_free, Real fixed, Real low, Real high) {
  const Real free = std::min(std::max(-cross * fixed / along_free, low), high);
  const Real size = Real(0.5) * (along_fixed * fixed * fixed + along_free * free * free);
  return {size + cross * fixed * free, size};
}

// Whether some pixel centre of a tile may reach the alpha floor; errs towards true. sigma is convex: its least value
// over the box of centres is 0 inside, and else lies on one of the two edges that face the splat's centre.
template <class Real>
inline bool touches(Real a, Real b, Real c, Real limit, Real left, Real top, Real extent) {
  const Real right = left + extent, bottom = top + extent, none = Real(0);
  const Real x = std::min(std::max(left, none), right), y = std::min(std::max(top, none), bottom);
  const Least<Real> vertical = least_on_line(a, b, c, x, top, bottom);
  const Least<Real> horizontal = least_on_line(c, b, a, y, left, right);
  const Real slack = Real(TILE_SLACK) + Real(TILE_SLACK_SHARE) * std::max(vertical.size, horizontal.size);
  // what overflowed on the way is not a number, and listed
  return !(vertical.sigma > limit + slack && horizontal.sigma > limit + slack);
}

// Find the tiles of the splats from `first` to before `last` in depth order, and count them by tile.
template <class Real> void find_tiles(const Lists<Real> &lists, int64_t first, int64_t last, int64_t *counts) {
  const int64_t n = lists.n;
  for (int64_t i = first; i < last; i++) {
    const int64_t id = lists.order[i];
    const int64_t x0 = lists.rects[id], y0 = lists.rects[n + id];
    const int64_t x1 = lists.rects[2 * n + id], y1 = lists.rects[3 * n + id];
    const Real x = lists.means2d[2 * id], y = lists.means2d[2 * id + 1];
    const Real *conic = lists.conics ? lists.conics + 3 * id : nullptr;
    const Real extent = Real(lists.tile_size - 1);
    const Real limit = conic ? std::log(lists.opacities[id] / Real(lists.alpha_floor)) : Real(0);
    int32_t *tile = lists.tiles + lists.candidates[i];
    for (int64_t row = y0; row < y1; row++)
      for (int64_t column = x0; column < x1; column++, tile++) {
        const Real left = Real(column * lists.tile_size) + Real(0.5) - x;
        const Real top = Real(row * lists.tile_size) + Real(0.5) - y;
        const bool listed = !conic || touches(conic[0], conic[1], conic[2], limit, left, top, extent);
        *tile = listed ? int32_t(row * lists.tiles_x + column) : -1;
        if (listed) counts[*tile]++;
      }
  }
}

// A counting sort by tile of entries that are made front to back. The splats are cut into one part a thread; where a
// part's entries of a tile begin follows from the parts before it, so that the lists do not depend on the parts.
template <class Real> void list_tiles(const Lists<Real> &lists, Fork fork) {
  const int64_t n_tiles = lists.tiles_x * lists.tiles_y, parts = std::max<int64_t>(1, lists.threads);
  std::vector<int64_t> starts(parts * n_tiles), bounds(parts + 1, lists.m);
  for (int64_t part = 0; part < parts; part++) {
    const int64_t before = lists.candidates[lists.m] / parts * part;
    bounds[part] = std::lower_bound(lists.candidates, lists.candidates + lists.m, before) - lists.candidates;
  }
  share(fork, lists.threads, parts, 1, [&](int64_t part, int64_t) {
    find_tiles(lists, bounds[part], bounds[part + 1], &starts[part * n_tiles]);
  });
  int64_t total = 0;
  for (int64_t tile = 0; tile < n_tiles; tile++) {
    lists.offsets[tile] = total;
    for (int64_t part = 0; part < parts; part++) {
      const int64_t count = starts[part * n_tiles + tile];
      starts[part * n_tiles + tile] = total;
      total += count;
    }
  }
  lists.offsets[n_tiles] = total;
  share(fork, lists.threads, parts, 1, [&](int64_t part, int64_t) {
    int64_t *next = &starts[part * n_tiles];
    for (int64_t i = bounds[part]; i < bounds[part + 1]; i++)
      for (int64_t k = lists.candidates[i]; k < lists.candidates[i + 1]; k++)
        if (lists.tiles[k] >= 0) lists.ids[next[lists.tiles[k]]++] = lists.order[i];
  });
}

}  // namespace pop
