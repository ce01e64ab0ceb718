"""Transposes of the losses against differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pop_ref import losses
from tests.gradients.checks import assert_vjp_matches

RNG = np.random.default_rng(5)
TARGET = RNG.random((12, 13, 1))
# far from L1's kink: no difference is under 0.05
IMAGE = TARGET + RNG.choice([-1.0, 1.0], TARGET.shape) * (0.05 + 0.25 * RNG.random(TARGET.shape))
MASK = RNG.random((12, 13)) < 0.7

CASES = {
    "l1": (losses.l1, losses.l1_vjp, {}),
    "l2": (losses.l2, losses.l2_vjp, {}),
    "ssim_valid": (losses.ssim, losses.ssim_vjp, {"padding": "valid"}),
    "ssim_same": (losses.ssim, losses.ssim_vjp, {"padding": "same"}),
    "d_ssim_halved": (losses.d_ssim, losses.d_ssim_vjp, {"halved": True}),
    "photometric_3dgs": (losses.photometric_3dgs, losses.photometric_3dgs_vjp, {"l1_scale": 0.5}),
    "photometric_pop": (losses.photometric_pop, losses.photometric_pop_vjp, {"lambda_ssim": 0.25, "l2_scale": 3.0}),
}


@pytest.mark.parametrize("name", CASES)
def test_loss_transpose_matches_differences(name: str) -> None:
    loss, vjp, options = CASES[name]
    # zero padding gives every pixel a window, so a smaller picture does
    small = np.s_[:7, :8] if options.get("padding") == "same" else np.s_[:, :]
    _check(loss, vjp, options, IMAGE[small], TARGET[small])


@pytest.mark.parametrize("name", ["l1", "l2", "ssim_valid", "photometric_pop"])
def test_masked_loss_transpose_matches_differences(name: str) -> None:
    loss, vjp, options = CASES[name]
    _check(loss, vjp, {**options, "mask": MASK}, IMAGE, TARGET)


def _check(
    loss: Callable[..., float], vjp: Callable[..., np.ndarray], options: dict, image: np.ndarray, target: np.ndarray
) -> None:
    assert_vjp_matches(
        lambda x: np.array(loss(x, target, **options)), lambda x, v: vjp(x, target, float(v), **options), [image]
    )
