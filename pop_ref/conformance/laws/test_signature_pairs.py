"""Laws of gsplat's signature: whatever two arguments are asked for together, everything is what the oracle says.

Every two values of two arguments that the rasterizer takes alone meet in some call of a covering array (`pairs`).
"""

from __future__ import annotations

from pop_ref.conformance.capabilities import GRADIENTS, SIGNATURE
from pop_ref.conformance.law import law
from pop_ref.conformance.pairs import assert_every_pair, assert_no_pair_fails


@law("signature", SIGNATURE)
def test_arguments_that_are_taken_alone_are_taken_together(backend):
    assert_no_pair_fails(backend)


@law("signature", SIGNATURE)
def test_every_pair_of_arguments_draws_what_the_oracle_draws(backend):
    assert_every_pair(backend, "images")


@law("signature", SIGNATURE, GRADIENTS)
def test_every_pair_of_arguments_has_the_oracles_gradients(backend):
    assert_every_pair(backend, "gradients")


@law("signature", SIGNATURE)
def test_every_pair_of_arguments_shows_the_oracles_splats(backend):
    assert_every_pair(backend, "rows")


@law("signature", SIGNATURE)
def test_every_pair_of_arguments_tells_the_dominant_gaussians_of_every_camera(backend):
    assert_every_pair(backend, "dominance")


@law("signature", SIGNATURE)
def test_every_pair_of_arguments_lists_tiles_front_to_back(backend):
    assert_every_pair(backend, "tiles")


@law("signature", SIGNATURE, GRADIENTS)
def test_every_pair_of_arguments_draws_the_same_without_gradients(backend):
    assert_every_pair(backend, "no gradients")


@law("signature", SIGNATURE, GRADIENTS, "differentiate")
def test_every_pair_of_arguments_has_the_oracles_gradients_where_means_have_none(backend):
    assert_every_pair(backend, "frozen means")


@law("signature", SIGNATURE)
def test_every_pair_of_arguments_leaves_the_arguments_as_they_are(backend):
    assert_every_pair(backend, "arguments")


@law("signature", SIGNATURE)
def test_every_pair_of_arguments_is_answered_in_gsplats_shapes_and_types(backend):
    assert_every_pair(backend, "types")
