// Sums over the pixels where a splat is blended, one row an entry of the tile lists, and the rows of a splat added up.
// Meaning: `pop_ref.contributions`, `pop_ref.sensitivity`, `pop_ref.fisher`, `pop_ref.chord`.
//
// Two ways through a tile's list. Front to back, as a blend: what a pair needs of the light is its alpha and weight.
// And back to front, a chunk at a time that is blended again from the light before it, with B, the light from behind a
// pixel's entry: B <- B + alpha (c - B).
#pragma once

#include "backward.h"
#include "forward.h"

namespace pop {

// Everything of one call; what a blend is given, and eight bytes each more, in the order of `library.py`.
template <class Real> struct Scores : Blend<Real> {
  const Real *background;            // colour behind everything. [D]
  const Real *pixel_map;             // null: zeros. [H, W]
  const Real *facing;                // densest ahead of the camera along rays d of facing . d <= 0. [N, 3]
  double fx, fy, cx, cy;             // of the rays, px
  Real *T_final;                     // [H, W]
  double *totals;                    // [N, columns]
};

// What a splat's row holds.
constexpr int CONTRIBUTIONS = 4;  // T alpha, 1, the map, the distance from the pixel's centre to the splat's
constexpr int SENSITIVITIES = 1;  // (T (c - B))^2
constexpr int MOMENTS = 31;       // second moments of dC_c/d(mean2d, conic) and of T alpha

// Sums of a chunk's entries, in every lane. [columns, entries of a chunk, lanes]
template <class Real> struct LaneSums {
  Numbers<Real> kept;

  explicit LaneSums(int columns) : kept(size_t(columns) * CHUNK * LANES<Real>) {}
  Real *at(int column, int k) { return &kept[(column * CHUNK + k) * LANES<Real>]; }
  void clear() { std::fill(kept.begin(), kept.end(), Real(0)); }
  void add(int column, int k, Vec<Real> v) { store(at(column, k), load(at(column, k)) + v); }

  void write(int columns, int n, Real *rows) {
    for (int column = 0; column < columns; column++) {
      Real found[CHUNK];
      sums_of_rows(at(column, 0), found);
      for (int k = 0; k < n; k++) rows[k * columns + column] = found[k];
    }
  }
};

// The light of a tile's pixels on the way through its list.
template <class Real> struct TileState {
  Numbers<Real> T;
  Entries<Real> entries;
  Rows<Real> rows;

  explicit TileState(const Pixels<Real> &pixels) : T(pixels.padded()), rows(pixels.size) {}

  void begin(const Place<Real> &place) {
    // pixels off the image and padding have no light, as if they had stopped
    std::fill(T.begin(), T.end(), Real(0));
    place.each_row([&](int64_t pixel, int64_t) { std::fill_n(&T[pixel], place.columns(), Real(1)); });
  }
  bool lit(int strip) const { return any(load(&T[strip * LANES<Real>]) > Real(0)); }
  bool lit() const {
    for (size_t at = 0; at < T.size(); at += LANES<Real>)
      if (lit(int(at / LANES<Real>))) return true;
    return false;
  }
};

// Blend a tile's list front to back. Calls before(chunk) and after(chunk, first entry), and between the two
// pair(k, strip, alpha, weight) where an entry may reach a strip, after which reached(strip, entries that take light).
template <class Real, bool ROW, class Before, class Pair, class Reached, class After>
void walk(const Blend<Real> &blend, const Pixels<Real> &pixels, int64_t tile, TileState<Real> &state, Before before,
          Pair pair, Reached reached, After after) {
  const Place<Real> place(blend, tile);
  const Thresholds<Real> thresholds(blend);
  state.begin(place);
  int64_t chunk = 0;
  for (int64_t first = place.begin; first < place.end && state.lit(); first += CHUNK, chunk++) {
    state.entries.gather(blend, place, first, std::min<int64_t>(CHUNK, place.end - first), first + CHUNK);
    state.rows.expand(state.entries, pixels);
    state.rows.look(state.entries, pixels, thresholds);
    before(chunk);
    for (int strip = 0; strip < pixels.strips; strip++) {
      uint32_t took = 0;
      if (state.lit(strip)) {
        const int at = strip * LANES<Real>;
        const Vec<Real> x = load(&pixels.x[at]), y = load(&pixels.y[at]);
        Vec<Real> T = load(&state.T[at]);
        each_marked(state.rows.of_strip(pixels, strip), [&](int k, uint32_t bit) {
          const Vec<Real> T_before = T;
          Vec<Real> alpha, weight;
          take(thresholds, exponent<Real, ROW>(state.entries, state.rows, strip, k, x, y), T, alpha, weight);
          // also the entry at which a pixel stops, which has no weight there
          took |= any(T < T_before) ? bit : 0;
          pair(k, strip, alpha, weight);
        });
        store(&state.T[at], T);
      }
      reached(strip, took);
    }
    after(chunk, first);
  }
  blend.n_reached[tile] = std::min(chunk * CHUNK, place.end - place.begin);
}

// The square root in every lane.
template <class Real> inline Vec<Real> root_of(Vec<Real> v) {
  Real lanes[LANES<Real>];
  store(lanes, v);
  for (Real &lane : lanes) lane = std::sqrt(lane);
  return load(lanes);
}

template <class Real> struct ContributionsState {
  TileState<Real> tile;
  LaneSums<Real> sums;
  Numbers<Real> map;

  explicit ContributionsState(const Pixels<Real> &pixels) : tile(pixels), sums(CONTRIBUTIONS), map(pixels.padded()) {}
};

template <class Real, bool ROW>
void contributions_of_tile(const Scores<Real> &scores, const Pixels<Real> &pixels, int64_t tile,
                           ContributionsState<Real> &state) {
  const Place<Real> place(scores, tile);
  const Entries<Real> &entries = state.tile.entries;
  place.each_row([&](int64_t pixel, int64_t from) {
    if (scores.pixel_map) std::copy_n(scores.pixel_map + from, place.columns(), &state.map[pixel]);
  });
  const auto before = [&](int64_t) { state.sums.clear(); };
  const auto pair = [&](int k, int strip, Vec<Real> alpha, Vec<Real> weight) {
    const int at = strip * LANES<Real>;
    const Mask<Real> blended = alpha > Real(0);
    if (!any(blended)) return;
    const Vec<Real> none = {}, dx = entries.u[k] - load(&pixels.x[at]), dy = entries.v[k] - load(&pixels.y[at]);
    state.sums.add(0, k, weight);
    state.sums.add(1, k, select(blended, all(Real(1)), none));
    if (scores.pixel_map) state.sums.add(2, k, select(blended, load(&state.map[at]), none));
    state.sums.add(3, k, select(blended, root_of<Real>(fma(dx, dx, dy * dy)), none));
  };
  const auto after = [&](int64_t, int64_t first) {
    state.sums.write(CONTRIBUTIONS, entries.count, scores.rows + CONTRIBUTIONS * first);
  };
  walk<Real, ROW>(scores, pixels, tile, state.tile, before, pair, [](int, uint32_t) {}, after);
}

// What the way back needs of the way there, a chunk that is blended again, and the light from behind. D channels.
template <class Real, int D> struct BackState {
  TileState<Real> tile;
  Again<Real> again;
  LaneSums<Real> sums;
  Numbers<Real> transmittances;       // T before every chunk. [chunks, pixels]
  std::vector<uint16_t> reached;  // the same in all pieces of a strip. [chunks, strips, PIECES]
  Numbers<Real> suffix_color;       // [D, pixels]

  BackState(const Pixels<Real> &pixels, int columns)
      : tile(pixels), again(pixels), sums(columns), suffix_color(D * pixels.padded()) {}

  Real *suffix_color_of(int d, int at) { return &suffix_color[d * again.padded + at]; }
};

// Blend a tile's list, and go back through it: entry(k) for those that blend somewhere, the farthest first.
template <class Real, int D, bool ROW, class Entry>
void walk_back(const Scores<Real> &scores, const Pixels<Real> &pixels, int64_t tile, int columns,
               BackState<Real, D> &state, Entry entry) {
  const Place<Real> place(scores, tile);
  const Thresholds<Real> thresholds(scores);
  const int padded = pixels.padded(), strips = pixels.strips;
  const int64_t most = (place.end - place.begin + CHUNK - 1) / CHUNK;
  if (int64_t(state.transmittances.size()) < most * padded) {
    state.transmittances.resize(most * padded);
    state.reached.resize(most * strips * PIECES);
  }
  int64_t n_chunks = 0;
  walk<Real, ROW>(
      scores, pixels, tile, state.tile,
      [&](int64_t chunk) { std::copy(state.tile.T.begin(), state.tile.T.end(), &state.transmittances[chunk * padded]); },
      [](int, int, Vec<Real>, Vec<Real>) {},
      [&](int strip, uint32_t took) {
        std::fill_n(&state.reached[(n_chunks * strips + strip) * PIECES], PIECES, uint16_t(took));
      },
      [&](int64_t, int64_t) { n_chunks++; });
  for (int d = 0; d < D; d++) std::fill_n(state.suffix_color_of(d, 0), padded, scores.background[d]);
  const int64_t n_reached = scores.n_reached[tile];
  for (int64_t chunk = n_chunks - 1; chunk >= 0; chunk--) {
    const int64_t first = place.begin + chunk * CHUNK;
    const int n = int(std::min<int64_t>(CHUNK, place.begin + n_reached - first));
    state.again.entries.gather(scores, place, first, n, first - CHUNK);
    if (ROW) state.again.rows.expand(state.again.entries, pixels);
    state.again.template blend_again<ROW>(thresholds, pixels, &state.transmittances[chunk * padded],
                                          &state.reached[chunk * strips * PIECES]);
    state.sums.clear();
    for (int k = n - 1; k >= 0; k--)
      if (state.again.marked(k)) entry(k);
    state.sums.write(columns, n, scores.rows + columns * first);
  }
}

// One entry's squared slopes: with the channels added up before, T (c - B) is their summed slope.
template <class Real, bool ROW>
void sensitivities_of_tile(const Scores<Real> &scores, const Pixels<Real> &pixels, int64_t tile,
                           BackState<Real, 1> &state) {
  walk_back<Real, 1, ROW>(scores, pixels, tile, SENSITIVITIES, state, [&](int k) {
    const Again<Real> &again = state.again;
    const Real color = again.entries.color[k][0];
    using V = Piece<Real>;
    for (int piece = 0; piece < PIECES; piece++) {
      const int lane = piece * PIECE_LANES<Real>;
      V total = {};
      again.each_strip(k, piece, [&](int strip, V alpha, V weight) {
        Real *suffix = state.suffix_color_of(0, strip * LANES<Real> + lane);
        const V suffix_color = load_piece(suffix), q = color - suffix_color, none = {};
        store_chunk(suffix, suffix_color + alpha * q);
        const V slope = select(alpha > Real(0), q * (weight / alpha), none);
        total += slope * slope;
      });
      store_chunk(state.sums.at(0, k) + lane, total);
    }
  });
}

// One entry's moments: with s = dsigma/d(mean2d, conic) and G_c = alpha dC_c/dalpha, q_c = -G_c s.
template <class Real, bool ROW>
void moments_of_tile(const Scores<Real> &scores, const Pixels<Real> &pixels, int64_t tile, BackState<Real, 3> &state) {
  const Thresholds<Real> thresholds(scores);
  walk_back<Real, 3, ROW>(scores, pixels, tile, MOMENTS, state, [&](int k) {
    const Again<Real> &again = state.again;
    const Entries<Real> &entries = again.entries;
    const Real half = Real(0.5), ln_2 = Real(0.6931471805599453);
    // the coefficients are those of log2(alpha)
    const Real A = Real(-2) * ln_2 * entries.f[3][k], B = -ln_2 * entries.f[4][k], C = Real(-2) * ln_2 * entries.f[5][k];
    using V = Piece<Real>;
    for (int piece = 0; piece < PIECES; piece++) {
      const int lane = piece * PIECE_LANES<Real>;
      V total[MOMENTS] = {};
      again.each_strip(k, piece, [&](int strip, V alpha, V weight) {
        const int at = strip * LANES<Real> + lane;
        const V x = load_piece(&pixels.x[at]), y = load_piece(&pixels.y[at]), dx = entries.u[k] - x, dy = entries.v[k] - y;
        V through = weight;
        if (any(alpha >= thresholds.ceiling))
          through = through_ceiling<Real>(scores, thresholds.ceiling,
                                          exponent<Real, ROW>(entries, again.rows, strip, k, x, y), alpha, weight);
        const V s[5] = {fma(V{} + A, dx, B * dy), fma(V{} + B, dx, C * dy), half * dx * dx, dx * dy, half * dy * dy};
        V G[3], squares = {};
        for (int c = 0; c < 3; c++) {
          Real *suffix = state.suffix_color_of(c, at);
          const V suffix_color = load_piece(suffix), more = entries.rgb[k][c] - suffix_color;
          store_chunk(suffix, suffix_color + alpha * more);
          G[c] = through * more;
          squares += G[c] * G[c];
          G[c] *= weight;
        }
        int column = 0;
        for (int i = 0; i < 5; i++) {
          const V weighted = squares * s[i];
          for (int j = i; j < 5; j++) total[column++] += weighted * s[j];
        }
        for (int c = 0; c < 3; c++)
          for (int i = 0; i < 5; i++) total[column++] -= G[c] * s[i];
        total[column] += weight * weight;
      });
      for (int column = 0; column < MOMENTS; column++) store_chunk(state.sums.at(column, k) + lane, total[column]);
    }
  });
}

template <class Real> struct PointsState {
  TileState<Real> tile;
  Numbers<Real> across, down, best, left;  // the rays' directions in the camera's axes, z being 1; T
  Numbers<Whole<Real>> winner;
  Real facing[CHUNK][3];

  explicit PointsState(const Pixels<Real> &pixels)
      : tile(pixels), across(pixels.padded()), down(pixels.padded()), best(pixels.padded()), left(pixels.padded()),
        winner(pixels.padded()) {}
};

// The entry of the largest weight among those that are densest ahead of the camera, and the light that is left (D8).
template <class Real, bool ROW>
void points_of_tile(const Scores<Real> &scores, const Pixels<Real> &pixels, int64_t tile, PointsState<Real> &state) {
  const Place<Real> place(scores, tile);
  for (int p = 0; p < pixels.count; p++) {
    state.across[p] = Real((place.left + p % pixels.size + 0.5 - scores.cx) / scores.fx);
    state.down[p] = Real((place.top + p / pixels.size + 0.5 - scores.cy) / scores.fy);
  }
  std::fill(state.best.begin(), state.best.end(), Real(0));
  std::fill(state.left.begin(), state.left.end(), Real(1));
  std::fill(state.winner.begin(), state.winner.end(), -1);
  int64_t place_in_list = 0;
  const auto before = [&](int64_t chunk) {
    place_in_list = chunk * CHUNK;
    for (int k = 0; k < state.tile.entries.count; k++)
      std::copy_n(scores.facing + 3 * scores.ids[place.begin + place_in_list + k], 3, state.facing[k]);
  };
  const auto pair = [&](int k, int strip, Vec<Real> alpha, Vec<Real> weight) {
    const int at = strip * LANES<Real>;
    const Real *g = state.facing[k];
    const Vec<Real> along = load(&state.across[at]) * g[0] + load(&state.down[at]) * g[1] + g[2];
    const Vec<Real> best = load(&state.best[at]), left = load(&state.left[at]);
    // strictly larger: on equal weights the entry in front keeps the pixel
    const Mask<Real> wins = (weight > best) & (along <= Real(0)), winner = load_whole<Real>(&state.winner[at]);
    store(&state.best[at], select(wins, weight, best));
    store_whole<Real>(&state.winner[at], select(wins, Mask<Real>{} + Whole<Real>(place_in_list + k), winner));
    store(&state.left[at], left - left * alpha);
  };
  walk<Real, ROW>(scores, pixels, tile, state.tile, before, pair, [](int, uint32_t) {}, [](int64_t, int64_t) {});
  place.each_pixel([&](int64_t pixel, int64_t to) {
    const int64_t winner = state.winner[pixel];
    scores.dominant_ids[to] = winner < 0 ? -1 : scores.ids[place.begin + winner];
    scores.T_final[to] = state.left[pixel];
  });
}

// Add up the rows of every entry of the splats from `first` to before `last`, in the order of the lists, in double.
template <class Real> void add_rows(const Scores<Real> &scores, int columns, int64_t first, int64_t last) {
  std::fill(scores.totals + first * columns, scores.totals + last * columns, 0.0);
  for (int64_t tile = 0; tile < scores.tiles(); tile++) {
    const int64_t begin = scores.offsets[tile], end = begin + scores.n_reached[tile];
    for (int64_t entry = begin; entry < end; entry++) {
      const int64_t id = scores.ids[entry];
      if (id < first || id >= last) continue;
      const Real *row = scores.rows + entry * columns;
      double *total = scores.totals + id * columns;
      for (int j = 0; j < columns; j++) total[j] += double(row[j]);
    }
  }
}

}  // namespace pop
