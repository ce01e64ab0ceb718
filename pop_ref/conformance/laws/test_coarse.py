"""Laws of coarse-to-fine trainings: how photographs, masks and cameras are shrunk, and which step sees which size.

A coarse pixel is the mean of the area that it covers, also where sizes do not divide.
"""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close
from pop_ref.conformance.law import law
from pop_ref.conformance.short_training import ShortTraining

sizes = st.tuples(st.integers(64, 150), st.integers(64, 150))
factors = st.sampled_from([2, 4])
first = [{"size": (160, 128), "factor": 4, "seed": 0}, {"size": (131, 101), "factor": 2, "seed": 1}]
# px, which no side of a coarse photograph is under
SMALLEST = 32


def _factor(size, factor):
    while factor > 1 and min(size) < SMALLEST * factor:
        factor //= 2
    return factor


def _small(size, factor):
    return tuple(round(side / factor) for side in size)


def _shares(whole, small):
    """Return what share of each coarse pixel every pixel of a row covers. [small, whole]"""
    ends = np.arange(small + 1) * (whole / small)
    left, right = np.maximum(ends[:-1, None], np.arange(whole)), np.minimum(ends[1:, None], np.arange(1, whole + 1))
    return np.maximum(right - left, 0.0) * (small / whole)


def _areas(size, factor):
    """Return the shares of rows and of columns of a photograph that is shrunk."""
    (width, height), (w, h) = size, _small(size, factor)
    return _shares(height, h), _shares(width, w)


def _photo(size, seed):
    return np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), np.uint8)


def _K(size):
    return np.array([[1.25 * size[0], 0.0, 0.4375 * size[0]], [0.0, 1.5 * size[1], 0.5625 * size[1]], [0.0, 0.0, 1.0]])


@law("training", "coarse_view", first=first, size=sizes, factor=factors, seed=st.integers(0, 99))
def test_a_coarse_photograph_is_the_mean_over_areas_of_the_whole_one(backend, size, factor, seed):
    photo, factor = _photo(size, seed), _factor(size, factor)
    found = backend.stage("coarse_view")(photo, None, _K(size), factor)
    rows, columns = _areas(size, factor)
    expected = np.einsum("yh,xw,hwc->yxc", rows, columns, photo.astype(np.float64))
    assert found["photo"].shape == expected.shape
    # as whole numbers
    off = np.max(np.abs(found["photo"] - expected))
    assert off <= 0.501, f"a pixel is off by {off} of 255"


@law("training", "coarse_view", first=first, size=sizes, factor=factors, seed=st.integers(0, 99))
def test_a_coarse_camera_sees_every_point_at_the_same_place_of_the_photograph(backend, size, factor, seed):
    small = _small(size, _factor(size, factor))
    found = backend.stage("coarse_view")(_photo(size, seed), None, _K(size), factor)
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (8, 3)) + np.array([0.0, 0.0, 3.0])
    ends = [(points @ K.T)[:, :2] / points[:, 2:] / np.array(of) for K, of in ((found["K"], small), (_K(size), size))]
    assert found["photo"].shape[:2] == small[::-1]
    assert_close("steps.still", *ends, 4.0, backend.dtype)


@law("training", "coarse_view", first=first, size=sizes, factor=factors, seed=st.integers(0, 99))
def test_a_pixel_of_a_coarse_mask_counts_where_half_of_its_area_does(backend, size, factor, seed):
    factor = _factor(size, factor)
    mask = np.random.default_rng(seed).random((size[1], size[0])) < 0.5
    found = backend.stage("coarse_view")(_photo(size, seed), mask, _K(size), factor)["mask"]
    rows, columns = _areas(size, factor)
    share = rows @ mask.astype(np.float64) @ columns.T
    assert found.shape == share.shape
    # where it is half to the last digits, rounding decides
    sure = (np.abs(share - 0.5) > 1e-5) | (factor == 1)
    assert np.array_equal(found[sure], (share >= 0.5)[sure])
    if all(side % factor == 0 for side in size):
        # here shares are exact
        assert np.array_equal(found, share >= 0.5)


class _Stripes(ShortTraining):
    """A short training whose photographs are stripes of 1, 2 and 4 px, told apart by how strong they are."""

    def photo(self, index):
        width, height = self.size
        x = np.arange(width)
        stripes = 128 + sum(strength * (1 - 2 * ((x // wide) % 2)) for wide, strength in ((1, 16), (2, 32), (4, 64)))
        return np.broadcast_to(stripes[None, :, None], (height, width, 3)).astype(np.uint8)


def _costs(strengths):
    return sum((strength / 255.0) ** 2 for strength in strengths)


@law("training", "coarse_losses")
def test_every_step_sees_its_photograph_at_the_size_of_its_turn(backend):
    # nothing is drawn before a background of the stripes' mean, and every size has lost stripes of its own
    grey = (128.0 / 255.0,) * 3
    options = {"lambda_ssim": 0.0, "max_steps": 8}
    settings = {"refine_start_iter": 100, "lambda_pop": 0.0}
    whole, half, quarter = _costs((16, 32, 64)), _costs((32, 64)), _costs((64,))
    for side, batch, expected in (
        (128, 1, (quarter, quarter, half, half, half, whole)),
        (128, 2, (quarter, quarter, half)),
        (96, 1, (half, half, half, half, half, whole)),
        (48, 1, (whole,)),
    ):
        order = (0, 1, 2) * (len(expected) * batch // 3 + 1)
        short = _Stripes("pop", settings, options, order[: len(expected) * batch], 3, 2, 3, background=grey,
                          batch=batch, size=(side, side))  # fmt: skip
        found = backend.stage("coarse_losses")(short, (2, 5))
        assert_close("steps.coarse", found, expected, 1.0, backend.dtype)
