"""Laws of gsplat's signature: accumulated and expected depth, alone and behind colours, with gradients."""

from __future__ import annotations

import numpy as np

from pop_ref.conformance.calls import Call
from pop_ref.conformance.capabilities import CAMERAS, COLORS, DEPTH, PACKED, SIGNATURE
from pop_ref.conformance.law import law
from pop_ref.conformance.signature import assert_call_is_the_oracles
from pop_ref.conformance.views import frames

JUDGED = (SIGNATURE,)


@law("signature", *JUDGED, DEPTH)
def test_the_accumulated_depth_is_the_oracles_alone_and_behind_colours(backend):
    for seed in (0, 1):
        for mode in ("D", "RGB+D"):
            assert_call_is_the_oracles(backend, Call((frames(backend, seed),), render_mode=mode))


@law("signature", *JUDGED, DEPTH)
def test_the_expected_depth_is_the_accumulated_one_over_the_opacity(backend):
    for seed in (0, 1):
        for mode in ("ED", "RGB+ED"):
            of = assert_call_is_the_oracles(backend, Call((frames(backend, seed),), render_mode=mode))
            assert np.any(of.wanted[0][0].render.T_final > 0.125), "no pixel is transparent; both depths would be one"


@law("signature", *JUDGED, DEPTH, COLORS, CAMERAS)
def test_depth_follows_plain_colours_of_several_cameras(backend):
    # kernels pad channels to the next number that they are compiled for, and depth comes after those that there are
    for channels, mode in ((3, "RGB+D"), (3, "RGB+ED"), (4, "RGB+D"), (2, "RGB+ED"), (6, "RGB+D")):
        assert_call_is_the_oracles(backend, Call((frames(backend, 9, 2, channels=channels),), render_mode=mode))


@law("signature", *JUDGED, DEPTH, PACKED)
def test_depth_is_the_same_of_packed_rows(backend):
    for mode in ("ED", "RGB+D"):
        assert_call_is_the_oracles(backend, Call((frames(backend, 10),), render_mode=mode, packed=True))
