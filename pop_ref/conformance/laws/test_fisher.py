"""Laws of Fisher blocks: second moments of the derivatives of every pixel and channel, and their determinants."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.gradient_error_bounds import parameter_error_bounds
from pop_ref.conformance.law import law
from pop_ref.conformance.laws.test_contributions import permuted, plain, shuffled
from pop_ref.conformance.score_error_bounds import moment_error_bounds, screened
from pop_ref.conformance.strategies import arrays_of, plain_sizes, scenes
from pop_ref.constants import INRIA
from pop_ref.contributions import contributions
from pop_ref.fisher import fisher_blocks, screen_moments

UPPER = [(i, j) for i in range(5) for j in range(i, 5)]
shapely = scenes(anchored=True, size=plain_sizes(), max_gaussians=4, max_degree=3)


def _moments(backend, given):
    return backend.stage("screen_moments")(*given.view, given.scene.background, given.scene.profile)


def _agree(backend, given):
    expected = screen_moments(*given.view, given.scene.background, given.scene.profile)
    rows = given.smooth
    error_bound = moment_error_bounds(given.error_bounds, 0.5 * given.tile_size)
    ends = _moments(backend, given)[rows], expected[rows]
    assert_close("agreement.screen_moments", *ends, error_bound[rows], backend.dtype, against_oracle=True)


@law("fisher", "screen_moments", scene=scenes(anchored=True, max_gaussians=5))
def test_screen_moments_are_the_oracles(backend, scene):
    _agree(backend, screened(backend, scene))


@law("fisher", "screen_moments", scene=scenes(profile=INRIA, size=plain_sizes(), max_gaussians=4, max_side=16))
def test_screen_moments_of_inrias_profile_are_the_oracles(backend, scene):
    _agree(backend, screened(backend, scene))


@law("fisher", "screen_moments", scene=scenes(anchored=True))
def test_who_is_blended_at_no_pixel_has_no_moments(backend, scene):
    given = screened(backend, scene)
    nowhere = given.sure & (contributions(*given.view, None, given.scene.profile).n_pixels == 0)
    found = _moments(backend, given)
    assert_same_bits("moments", found[nowhere], np.zeros((int(np.sum(nowhere)), 31)))
    assert np.all(found[:, [0, 5, 9, 12, 14, 30]] >= 0.0), "a square is never negative"


@law("fisher", "screen_moments", scene=plain, seed=st.randoms(use_true_random=False))
def test_moments_stay_with_their_rows(backend, scene, seed):
    given = screened(backend, scene)
    order = shuffled(seed, len(scene.gaussians))
    one, other = _moments(backend, given), _moments(backend, permuted(given, order))
    error_bound = moment_error_bounds(given.error_bounds, 0.5 * given.tile_size)[order]
    assert_close("fisher.rows", other, one[order], error_bound, backend.dtype)


def _second_moments(moments):
    """Return the six by six matrices of (q_c, w), one a channel. [N, 3, 6, 6]; that of q q^T counted thrice"""
    found = np.zeros((len(moments), 3, 6, 6))
    for k, (i, j) in enumerate(UPPER):
        found[:, :, i, j] = found[:, :, j, i] = moments[:, None, k]
    for c in range(3):
        found[:, c, :5, 5] = found[:, c, 5, :5] = moments[:, 15 + 5 * c : 20 + 5 * c]
        found[:, c, 5, 5] = moments[:, 30]
    return found


@law("fisher", "fisher_blocks", scene=shapely)
def test_fisher_blocks_are_the_oracles(backend, scene):
    given = screened(backend, scene)
    seen = given.scene
    moments = screen_moments(*given.view, seen.background, seen.profile).astype(backend.dtype).astype(np.float64)
    args = (seen.gaussians, seen.camera, moments, seen.sh_degree, seen.profile)
    expected, found = fisher_blocks(*args), backend.stage("fisher_blocks")(*args)
    assert np.any(expected != 0.0), "no block has anything in it"
    # twice the Jacobian times its error bound, about the absolute values of the moments
    J = parameter_error_bounds(seen, given.error_bounds.screen)
    seconds = np.abs(_second_moments(moments))
    error_bound = np.zeros((len(moments), 6, 6))
    for c in range(3):
        K = np.concatenate([J[:, :5], J[:, 5 + c : 6 + c]], axis=1)
        error_bound += np.swapaxes(K, 1, 2) @ seconds[:, c] @ K
    rows = ~given.error_bounds.screen.kinked & given.splats.visible
    assert_close(
        "agreement.fisher_blocks", found[rows], expected[rows], error_bound[rows], backend.dtype, against_oracle=True
    )


@law("fisher", "screen_moments", "fisher_blocks", scene=shapely)
def test_blocks_are_symmetric_and_no_direction_has_negative_information(backend, scene):
    given = screened(backend, scene)
    seen = given.scene
    blocks = backend.stage("fisher_blocks")(
        seen.gaussians, seen.camera, _moments(backend, given), seen.sh_degree, seen.profile
    )
    assert_same_bits("transposed", np.swapaxes(blocks, 1, 2), blocks)
    diagonals = np.diagonal(blocks, axis1=1, axis2=2)
    # of units that make every diagonal one, rounding may take a little from the least eigenvalue
    D = np.sqrt(np.where(diagonals > 0.0, diagonals, 1.0))
    assert np.all(diagonals >= 0.0)
    least = np.linalg.eigvalsh(blocks / D[:, :, None] / D[:, None, :])[:, :1]
    resolved = ~given.error_bounds.screen.kinked & given.splats.visible
    assert np.all(least[resolved] >= -(2.0**14) * np.finfo(backend.dtype).eps)
    assert np.all(blocks[~given.splats.visible] == 0.0)


@law("fisher", "fisher_blocks", scene=shapely)
def test_blocks_are_linear_in_the_moments(backend, scene):
    given = screened(backend, scene)
    seen, moments = given.scene, screen_moments(*given.view, given.scene.background, given.scene.profile)

    def blocks(of):
        return backend.stage("fisher_blocks")(seen.gaussians, seen.camera, of, seen.sh_degree, seen.profile)

    assert_same_bits("blocks of twice the moments", blocks(2.0 * moments), 2.0 * blocks(moments))


def _positive(rows):
    """Return blocks of full rank with conditions that any precision resolves. [2, 6, 6]"""
    return rows @ np.swapaxes(rows, 1, 2) + 2.0 * np.eye(6)


blocks = arrays_of((2, 6, 6)).map(_positive)


@law("fisher", "log_det_scores", blocks=blocks)
def test_a_score_is_the_logarithm_of_the_determinant(backend, blocks):
    expected = np.linalg.slogdet(blocks)[1]
    assert_close("fisher.log_det", backend.stage("log_det_scores")(blocks), expected, 200.0, backend.dtype)


@law("fisher", "log_det_scores", blocks=blocks, powers=st.tuples(*[st.integers(-20, 20)] * 6))
def test_units_of_the_parameters_shift_a_score_and_lose_none(backend, blocks, powers):
    units = 2.0 ** np.array(powers, dtype=np.float64)
    score = backend.stage("log_det_scores")
    shifted = score(blocks * np.outer(units, units))
    expected = score(blocks) + 2.0 * np.log(2.0) * sum(powers)
    assert_close("fisher.units", shifted, expected, 200.0 + 2.0 * float(np.sum(np.abs(powers))), backend.dtype)


@law("fisher", "log_det_scores", blocks=blocks, blind=st.integers(0, 5))
def test_a_gaussian_that_some_direction_does_not_show_scores_least(backend, blocks, blind):
    deficient = blocks.copy()
    deficient[0, blind] = deficient[0, :, blind] = 0.0
    # and one that is shown twice by the same
    deficient[1, blind] = deficient[1, blind - 1]
    deficient[1, :, blind] = deficient[1, :, blind - 1]
    scores = backend.stage("log_det_scores")(np.concatenate([deficient, np.zeros((1, 6, 6))]))
    assert np.all(scores == -np.inf)
