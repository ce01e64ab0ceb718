"""Photographs shrunk as Pillow shrinks them, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pop_fast.data import load_capture
from pop_fast.data.resample import shrink_bicubic
from pop_fast.errors import CaptureError
from tests.app.captures import transforms_capture


def by_pillow(image, size):
    """Resize rows, then columns: one call for both takes them in an order that depends on Pillow's version."""
    rows = Image.fromarray(image).resize((size[0], image.shape[0]), Image.Resampling.BICUBIC)
    return np.asarray(rows.resize(size, Image.Resampling.BICUBIC))


@given(
    size=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    wanted=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    seed=st.integers(0, 2**16),
    extreme=st.booleans(),
)
def test_bits_are_pillows_at_any_size(size, wanted, seed, extreme):
    image = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    if extreme:
        # black next to white, where a cubic overshoots on both sides
        image = np.where(image < 128, 0, 255).astype(np.uint8)
    found = shrink_bicubic(image, wanted)
    np.testing.assert_array_equal(found, by_pillow(image, wanted))
    assert found.flags.c_contiguous


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_the_factors_that_captures_are_shrunk_by_are_pillows_in_one_call_too(factor):
    image = np.random.default_rng(factor).integers(0, 256, (411, 619, 3), dtype=np.uint8)
    size = (round(619 / factor), round(411 / factor))
    found = shrink_bicubic(image, size)
    np.testing.assert_array_equal(found, by_pillow(image, size))
    in_one = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
    assert np.abs(found.astype(int) - in_one).max() <= 1


def test_a_capture_is_shrunk_by_the_filter_that_is_asked_for(tmp_path):
    root = transforms_capture(tmp_path)
    whole = load_capture(root, normalize=False).views[0].image
    size = (round(whole.shape[1] / 2), round(whole.shape[0] / 2))
    shrunk = {resize: load_capture(root, factor=2, resize=resize).views[0].image for resize in ("area", "bicubic")}
    np.testing.assert_array_equal(shrunk["bicubic"], by_pillow(whole, size))
    assert (shrunk["area"] != shrunk["bicubic"]).any()
    with pytest.raises(CaptureError, match=r"resize is 'nearest'; it must be 'area' or 'bicubic'"):
        load_capture(root, factor=2, resize="nearest")
