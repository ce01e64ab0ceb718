"""How much of a backend the laws can reach: what it offers of all that laws ask for."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from pop_ref.conformance.capabilities import (
    ANTIALIASING,
    DETERMINISTIC,
    DOMINANCE,
    DOMINANT_COUNTS,
    DOMINANT_WEIGHTS,
    GRADIENTS,
    INSTRUMENTS,
    RENDER,
    SCALE,
    SIGNATURE,
)
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.views import ASKED

WHOLE: Final = (RENDER, GRADIENTS, DOMINANCE, DOMINANT_WEIGHTS, DOMINANT_COUNTS, ANTIALIASING, INSTRUMENTS,
                DETERMINISTIC, SCALE)  # fmt: skip


def stage_functions() -> list[str]:
    """Return the names of the stage functions that laws need."""
    needs = {need for law in every_law().values() for need in law.needs}
    return sorted(need for need in needs if need.isidentifier() and need not in (RENDER, GRADIENTS, DOMINANCE))


def surface_of(backend: Any) -> dict[str, Any]:
    """Return what a backend offers and what it does not, as a scorecard states it.

    Args:
        backend: an adapter, or an `Absent`.

    Returns:
        Constants and precision; of whole views, of gsplat's arguments and of stage functions, those offered and those
        not. Empty for who is absent.
    """
    if hasattr(backend, "reason"):
        return {}
    groups = {"whole views": WHOLE, "arguments": (SIGNATURE, *ASKED), "stage functions": stage_functions()}
    found: dict[str, Any] = {
        "profile": backend.profile.name if backend.profile else "any",
        "dtype": np.dtype(backend.dtype).name,
    }
    for group, needs in groups.items():
        offered = [need for need in needs if backend.has(need)]
        found[group] = {"offered": offered, "not": [need for need in needs if need not in offered]}
    return found
