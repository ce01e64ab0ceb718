"""Photographs shrunk as Pillow shrinks them, to the bit, whatever order of the axes its version takes."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from PIL import Image

from pop_fast.data import load_capture
from pop_fast.data.read_images import shrink_bicubic
from pop_fast.errors import CaptureError
from tests.app.captures import transforms_capture

# of what a NumPy implementation of Pillow's filter made of the same pictures
DIGESTS = {
    (619, 411, 310, 206): "5cc1f4545686a444",
    (619, 411, 155, 103): "2107877b85251428",
    (619, 411, 77, 51): "a9cd436b0e0c5787",
    (60, 41, 7, 40): "fa46e91ac01f64f1",
    (33, 57, 60, 9): "466ee0a79398aa54",
    (5, 1, 3, 1): "baf3377d19a94e65",
    (17, 23, 17, 12): "606f5b7ecea3f805",
}


def picture(width: int, height: int) -> np.ndarray:
    """Noise, with black next to white in its upper half, where a cubic overshoots on both sides."""
    image = np.random.default_rng(width).integers(0, 256, (height, width, 3), dtype=np.uint8)
    image[: height // 2] = np.where(image[: height // 2] < 128, 0, 255)
    return image


@pytest.mark.parametrize(("width", "height", "new_width", "new_height"), DIGESTS)
def test_bits_are_those_of_the_filter_by_rows_and_then_by_columns(width, height, new_width, new_height):
    image, size = picture(width, height), (new_width, new_height)
    found = shrink_bicubic(image, size)
    assert hashlib.sha256(found.tobytes()).hexdigest()[:16] == DIGESTS[width, height, new_width, new_height]
    assert found.shape == (new_height, new_width, 3)
    assert found.flags.c_contiguous
    assert found.flags.writeable


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_the_factors_that_captures_are_shrunk_by_are_pillows_in_one_call_too(factor):
    image = picture(619, 411)
    size = (round(619 / factor), round(411 / factor))
    in_one = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
    assert np.abs(shrink_bicubic(image, size).astype(int) - in_one).max() <= 1


def test_a_capture_is_shrunk_by_the_filter_that_is_asked_for(tmp_path):
    root = transforms_capture(tmp_path)
    whole = load_capture(root, normalize=False).views[0].image
    size = (round(whole.shape[1] / 2), round(whole.shape[0] / 2))
    shrunk = {resize: load_capture(root, factor=2, resize=resize).views[0].image for resize in ("area", "bicubic")}
    np.testing.assert_array_equal(shrunk["bicubic"], shrink_bicubic(whole, size))
    assert (shrunk["area"] != shrunk["bicubic"]).any()
    with pytest.raises(CaptureError, match=r"resize is 'nearest'; it must be 'area' or 'bicubic'"):
        load_capture(root, factor=2, resize="nearest")
