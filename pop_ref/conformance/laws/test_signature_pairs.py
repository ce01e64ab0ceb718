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


# by what is asked of every call: the rest of the law's name, and what it needs beside the signature
LAWS = {
    "images": ("draws_what_the_oracle_draws",),
    "gradients": ("has_the_oracles_gradients", GRADIENTS),
    "rows": ("shows_the_oracles_splats",),
    "dominance": ("tells_the_dominant_gaussians_of_every_camera",),
    "tiles": ("lists_tiles_front_to_back",),
    "no gradients": ("draws_the_same_without_gradients", GRADIENTS),
    "frozen means": ("has_the_oracles_gradients_where_means_have_none", GRADIENTS, "differentiate"),
    "arguments": ("leaves_the_arguments_as_they_are",),
    "types": ("is_answered_in_gsplats_shapes_and_types",),
}


def _of_every_pair(asked, name, *needs):
    def sentence(backend):
        assert_every_pair(backend, asked)

    sentence.__name__ = f"test_every_pair_of_arguments_{name}"
    return law("signature", SIGNATURE, *needs)(sentence)


for _asked, _of in LAWS.items():
    globals()[f"test_every_pair_of_arguments_{_of[0]}"] = _of_every_pair(_asked, *_of)
