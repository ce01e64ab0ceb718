// Which tiles a splat overlaps; the counterpart of pop_ref/tiles.py. The exact test is this code's own: it only drops tiles in
// which no pixel can reach the alpha floor, so that it changes no image where extents are opacity-aware.
#pragma once

#include "profile.cuh"

namespace pop {

struct Radii {
    int x, y;
};

struct TileGrid {
    int tiles_x, tiles_y;   // tiles along x and y
    int tile_w, tile_h;     // px
    int width, height;      // px
};

struct TileRect {
    int x0, y0, x1, y1;  // half open
};

POP_HD TileGrid grid_of(int width, int height, int tile_w, int tile_h) {
    return {(width + tile_w - 1) / tile_w, (height + tile_h - 1) / tile_h, tile_w, tile_h, width, height};
}

POP_HD int n_tiles_in(TileRect rect) {
    return (rect.x1 > rect.x0 && rect.y1 > rect.y0) ? (rect.x1 - rect.x0) * (rect.y1 - rect.y0) : 0;
}

struct Span {
    int first, last;
};

// a double holds every tile number exactly and bounds the conversion to int
template <class Real>
POP_HD int tile_number(Real tiles, int n_tiles) {
    return int(clamped(tiles, Real(0), Real(n_tiles)));
}

// D3, one axis
template <class Real>
POP_HD Span tile_span(Real center, int radius, int n_tiles, int size, const Profile<Real>& profile) {
    const Real r = Real(radius), t = Real(size);
    if (profile.square) {
        const Real index = center - Real(0.5);
        return {tile_number(trunc((index - r) / t), n_tiles), tile_number(trunc((index + r + t - Real(1)) / t), n_tiles)};
    }
    return {tile_number(floor((center - r) / t), n_tiles), tile_number(ceil((center + r) / t), n_tiles)};
}

template <class Real>
POP_HD TileRect tile_rect(Vec2<Real> mean2d, Radii radii, TileGrid grid, const Profile<Real>& profile) {
    if (radii.x <= 0 || radii.y <= 0) return {0, 0, 0, 0};
    const Span x = tile_span(mean2d.x, radii.x, grid.tiles_x, grid.tile_w, profile);
    const Span y = tile_span(mean2d.y, radii.y, grid.tiles_y, grid.tile_h, profile);
    return {x.first, y.first, x.last, y.last};
}

// What the test of a tile allows for rounding, of the exponent and of the terms that cancel in it: needles cancel, and a
// tile is only dropped when it is certain. pop_fast/stages/tiles.py has the same two numbers.
constexpr double TILE_SLACK = 1e-3, TILE_SLACK_SHARE = 1e-5;

// A splat's exponent sigma = (A dx^2 + C dy^2) / 2 + B dx dy, and where along an edge it is least: at dy = down dx on one
// at dx, at dx = right dy on one at dy.
template <class Real>
struct Exponent {
    Real A, B, C, down, right;
};

template <class Real>
POP_HD Exponent<Real> exponent_of(Real A, Real B, Real C) {
    // of a splat of billions of px a float's conic is 0: its exponent is 0 wherever on the edge, and 0 / 0 is nowhere
    return {A, B, C, C > Real(0) ? -B / C : Real(0), A > Real(0) ? -B / A : Real(0)};
}

// the exponent on an edge of a box at offset `fixed`, at its least over the other offset in [low, high], less the slack
template <class Real>
POP_HD Real least_on_edge(Real fixed_coefficient, Real cross, Real free_coefficient, Real slope, Real fixed, Real low,
                          Real high) {
    // rounded where it is written: the kernel that counts tiles and the one that lists them must agree to the bit
    const Real offset = clamped(mul(slope, fixed), low, high);
    const Real across = mul(mul(fixed_coefficient, fixed), fixed), along = mul(mul(free_coefficient, offset), offset);
    const Real squares = mul(Real(0.5), add(across, along)), mixed = mul(mul(cross, fixed), offset);
    const Real slack = add(Real(TILE_SLACK), mul(Real(TILE_SLACK_SHARE), squares));
    return add(add(squares, mixed), -slack);
}

// The least sigma that any pixel centre of a tile can have, or a little less. sigma is convex: outside the box of
// centres its least value lies on an edge that faces the splat's centre.
template <class Real>
POP_HD Real least_sigma_in_tile(Vec2<Real> mean2d, const Exponent<Real>& of, int tile_x, int tile_y, TileGrid grid) {
    const Real half = Real(0.5), one = Real(1);
    const Real left = Real(tile_x * grid.tile_w) + half;
    const Real top = Real(tile_y * grid.tile_h) + half;
    const Real right = Real(min_of((tile_x + 1) * grid.tile_w, grid.width)) - one + half;
    const Real bottom = Real(min_of((tile_y + 1) * grid.tile_h, grid.height)) - one + half;
    // offsets d = mean - p over the box
    const Real x_low = mean2d.x - right, x_high = mean2d.x - left;
    const Real y_low = mean2d.y - bottom, y_high = mean2d.y - top;
    const bool x_inside = x_low <= Real(0) && x_high >= Real(0), y_inside = y_low <= Real(0) && y_high >= Real(0);
    if (x_inside && y_inside) return Real(0);
    const Real none = Real(3e38);
    const Real dx = x_low > Real(0) ? x_low : x_high, dy = y_low > Real(0) ? y_low : y_high;
    const Real on_x = x_inside ? none : least_on_edge(of.A, of.B, of.C, of.down, dx, y_low, y_high);
    const Real on_y = y_inside ? none : least_on_edge(of.C, of.B, of.A, of.right, dy, x_low, x_high);
    return min_of(on_x, on_y);
}

}  // namespace pop
