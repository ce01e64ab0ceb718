"""The shapes in the oracle's annotations are checked while tests run: the hook came before the modules."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from pop_ref.activations import scales_from_log_scales
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.losses import l2


def test_a_wrong_number_of_columns_is_told():
    with pytest.raises(TypeCheckError, match="quats"):
        covars_from_quats_scales(np.zeros((2, 3)), np.ones((2, 3)))


def test_lengths_that_share_a_letter_must_be_equal():
    with pytest.raises(TypeCheckError, match="scales"):
        covars_from_quats_scales(np.ones((2, 4)), np.ones((3, 3)))
    with pytest.raises(TypeCheckError):
        l2(np.zeros((2, 2, 3)), np.zeros((2, 3, 3)))


def test_float32_is_told():
    with pytest.raises(TypeCheckError):
        scales_from_log_scales(np.zeros((1, 3), dtype=np.float32))
