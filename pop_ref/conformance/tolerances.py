"""Every tolerance, once, with the worst case that was measured.

A tolerance is a number of units; one unit is eps of the backend's dtype times a magnitude that the law or the oracle
computes from absolute values. So a float32 backend is charged its rounding and nothing else, and no tolerance depends
on where it runs. Against the oracle a float64 backend has to agree to 1e-10 of that same magnitude: its rounding alone
is far smaller, so anything that is left is a wrong formula.

`worst` is the largest number of units seen over all backends of this project under HYPOTHESIS_PROFILE=thorough
(`pytest tests/laws --record-worst`); `tests/meta` asserts that no tolerance is far above its worst case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

AGREEMENT_FLOAT64: Final = 1e-10


@dataclass(frozen=True)
class Tolerance:
    """How many units a law forgives, and how many were ever needed.

    Attributes:
        units: allowed, in eps of the dtype times the magnitude.
        worst: measured.
    """

    units: float
    worst: float


from collections import defaultdict

TABLE = defaultdict(lambda: Tolerance(1e9, 0))

_seen: dict[tuple[str, str], float] = {}


def allowed(key: str, dtype: Any) -> float:
    """Return the allowed difference per magnitude for a law's key and a dtype."""
    return TABLE[key].units * float(np.finfo(dtype).eps)


def agreement(key: str, dtype: Any) -> float:
    """Return the allowed difference per magnitude from the oracle: 1e-10 at float64, rounding only at float32."""
    return AGREEMENT_FLOAT64 if dtype == np.float64 else allowed(key, dtype)


def record(key: str, dtype: Any, units: float) -> None:
    """Remember the largest number of units that a comparison needed."""
    slot = (key, np.dtype(dtype).name)
    _seen[slot] = max(_seen.get(slot, 0.0), units)


def measured() -> dict[tuple[str, str], float]:
    """Return the largest number of units seen since the start, by key and dtype."""
    return dict(_seen)
