"""Laws at the thresholds D1 to D8: a backend equals one of the oracle's outcomes, whichever way rounding decides."""

from __future__ import annotations

import numpy as np
from hypothesis import assume

from pop_ref.conformance import thresholds
from pop_ref.conformance.assertions import extent_near_threshold, with_error_bounds
from pop_ref.conformance.capabilities import DOMINANCE, INRIAS, RENDER
from pop_ref.conformance.error_bounds import pixel_error_bounds
from pop_ref.conformance.law import law
from pop_ref.conformance.thresholds import assert_one_of_the_oracles_outcomes


def _holds(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    assert_one_of_the_oracles_outcomes(backend, seen, error_bounds)


@law("camera", RENDER, scene=thresholds.near_plane())
def test_at_the_near_plane_a_splat_is_wholly_there_or_wholly_gone(backend, scene):
    # D1
    seen = backend.sees(scene)
    if seen.profile.extent == "square":
        assume(not extent_near_threshold(seen, backend.dtype, ("D2", "D3")))
    assert_one_of_the_oracles_outcomes(backend, seen, pixel_error_bounds(seen, backend.dtype))


@law("footprint", RENDER, scene=thresholds.near_edge().filter(lambda s: s.profile.extent != "square"))
def test_no_pixel_is_lost_where_an_ellipse_touches_a_pixel_centre_or_a_tile_edge(backend, scene):
    # D2, D3
    _holds(backend, scene)


@law("tiles", RENDER, scene=thresholds.near_tile_edge())
def test_a_splat_that_just_reaches_the_next_tile_is_drawn_there(backend, scene):
    # D3
    _holds(backend, scene)


@law("footprint", RENDER, INRIAS, scene=thresholds.near_edge().filter(lambda s: s.profile.extent == "square"))
def test_the_square_extent_cuts_where_inrias_does(backend, scene):
    # D2, D3: here the extent is part of the meaning; where rounding decides it, nothing is said
    _holds(backend, scene)


@law("tiles", RENDER, scene=thresholds.near_depth_tie())
def test_at_a_depth_tie_the_order_is_one_of_the_two_and_by_index_where_the_tie_is_exact(backend, scene):
    # D4: seen straight on, depths are exact in every precision, and nothing is near its threshold
    _holds(backend, scene)


@law("alpha", RENDER, scene=thresholds.near_floor())
def test_at_the_alpha_floor_a_splat_is_blended_or_skipped(backend, scene):
    # D5
    _holds(backend, scene)


@law("alpha", RENDER, scene=thresholds.near_ceiling())
def test_at_the_alpha_ceiling_nothing_jumps(backend, scene):
    # D6 is continuous: the image is unambiguous
    _holds(backend, scene)


@law("compositing", RENDER, scene=thresholds.near_stop())
def test_at_the_transmittance_stop_the_pixel_ends_or_goes_on(backend, scene):
    # D7
    _holds(backend, scene)


@law("alpha", RENDER, scene=thresholds.near_flat())
def test_a_needle_shows_one_of_the_oracles_outcomes(backend, scene):
    _holds(backend, scene)


@law("dominance", RENDER, DOMINANCE, scene=thresholds.near_dominance_tie())
def test_at_a_dominance_tie_one_of_the_tied_wins(backend, scene):
    # D8
    seen, error_bounds = with_error_bounds(backend, scene)
    view = backend.render(seen)
    weights = np.zeros((len(seen.gaussians), *view.T_final.shape))
    for layer in error_bounds.layers:
        weights[layer.id] = np.where(layer.blended, layer.T * layer.alpha, 0.0)
    best = np.max(weights, axis=0)
    y, x = np.nonzero(error_bounds.unambiguous & (best > 0.0))
    winner = view.dominant_ids[y, x]
    assert np.all(winner >= 0)
    won = weights[winner, y, x]
    room = error_bounds.reach * (error_bounds.T_final + 1.0)[y, x]
    assert np.all(won >= best[y, x] - room), "a splat won that was not among the tied"
