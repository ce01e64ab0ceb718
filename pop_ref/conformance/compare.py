"""Verdicts: assertions that say what differs, where first, by how many units, and with which scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from pop_ref.conformance import tolerances


def assert_close(
    key: str,
    actual: Any,
    expected: Any,
    magnitude: Any,
    dtype: Any,
    against_oracle: bool = False,
) -> None:
    """Assert that every entry differs by at most the key's tolerance times eps times its magnitude.

    Args:
        key: the tolerance, and the name in the message.
        actual, expected: arrays of one shape.
        magnitude: what one unit is a multiple of eps of; broadcasts.
        dtype: the precision charged.
        against_oracle: True gives a float64 backend the room of `tolerances.agreement`.
    """
    actual, expected = np.asarray(actual, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    assert actual.shape == expected.shape, f"{key}: shape {actual.shape}, expected {expected.shape}"
    if actual.size == 0:
        return
    assert np.all(np.isfinite(actual)), f"{key}: {_first(~np.isfinite(actual), actual, expected)} is not finite"
    eps = float(np.finfo(dtype).eps)
    # the smallest normal number keeps a magnitude of zero from asking for more than the format can hold
    scale = np.broadcast_to(np.asarray(magnitude, dtype=np.float64), actual.shape) + np.finfo(dtype).tiny / eps
    difference = np.abs(actual - expected)
    tolerances.record(key, dtype, float(np.max(difference / (eps * scale))))
    limit = tolerances.agreement(key, dtype) if against_oracle else tolerances.allowed(key, dtype)
    wrong = difference > limit * scale
    if np.any(wrong):
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        units = difference[where] / (eps * scale[where])
        raise AssertionError(
            f"{key}: {_first(wrong, actual, expected)}; differs by {difference[where]:.3e} = {units:.3g} units,"
            f" allowed {limit / eps:.3g} units of {eps * scale[where]:.3e}; {int(np.sum(wrong))} of {wrong.size} differ"
        )


def assert_same_bits(what: str, actual: Any, expected: Any) -> None:
    """Assert equality of every entry; 0.0 and -0.0 are the same value."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, f"{what}: shape {actual.shape}, expected {expected.shape}"
    wrong = ~((actual == expected) | (np.isnan(actual) & np.isnan(expected)))
    assert not np.any(wrong), f"{what}: {_first(wrong, actual, expected)}; must be equal exactly"


def _first(wrong: Any, actual: Any, expected: Any) -> str:
    where = tuple(int(i) for i in np.argwhere(wrong)[0])
    return f"first at {list(where)}: got {actual[where].item()!r}, expected {expected[where].item()!r}"
