"""Transpose of the POP loss against differences."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref.polarization import pop_loss, pop_loss_vjp
from tests.gradients.checks import assert_vjp_matches

OPACITIES = np.random.default_rng(7).uniform(0.125, 0.875, 6)
MASK = np.array([True, False, True, False, False, False])


@pytest.mark.parametrize("visible", [None, np.array([True, True, True, True, False, True])])
@pytest.mark.parametrize("mask", [MASK, MASK | True, MASK & False])
def test_pop_loss_transpose_matches_differences(mask: np.ndarray, visible: np.ndarray | None) -> None:
    assert_vjp_matches(
        lambda o: np.array(pop_loss(o, mask, visible)),
        lambda o, v: pop_loss_vjp(o, mask, float(v), visible),
        [OPACITIES],
    )
