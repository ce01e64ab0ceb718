"""How much of a backend the laws can reach: what it offers of all that laws ask for."""

from __future__ import annotations

import textwrap
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
    STAGES,
)
from pop_ref.conformance.law import missing
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.views import ASKED

WHOLE: Final = (RENDER, GRADIENTS, DOMINANCE, DOMINANT_WEIGHTS, DOMINANT_COUNTS, ANTIALIASING, INSTRUMENTS,
                DETERMINISTIC, SCALE)  # fmt: skip


def introduction(backend: Any) -> list[str]:
    """Return the lines that a session begins with: what is judged, as what, by how many laws, and what is not."""
    if hasattr(backend, "reason"):
        return [f"conformance: {backend.name} is not judged: {backend.reason}"]
    laws = list(every_law().values())
    as_what = [np.dtype(backend.dtype).name, f"constants {backend.profile.name if backend.profile else 'any'}"]
    as_what += [f"on {backend.device}"] if hasattr(backend, "device") else []
    otherwise = "" if backend.profile is None else " (--dtype, --profile, --device say otherwise)"
    lines = [f"conformance: {backend.name}, {', '.join(as_what)}{otherwise}"]
    judged = [law for law in laws if not missing(backend, law.needs)]
    lines.append(f"  judged: {len(judged)} of {len(laws)} laws, of {_listed({law.stage for law in judged})}")
    if backend.has(SIGNATURE):
        taken = [need for need in ASKED if backend.has(need)]
        lines.append(f"  arguments taken: {'; '.join(taken) or 'none'}")
        lines += [f"  refused, and not judged: {need} ({words})" for need in ASKED if (words := backend.why_not(need))]
    idle = {law.stage for law in laws} - {law.stage for law in judged}
    if idle:
        lines.append(
            f"  no law of {_listed(idle)}: --stages, --adapter and --strategy name an implementation that offers them"
        )
    lines.append("  next: a broken law prints where, and a scene or call to paste; --scorecard card.html tells of all")
    return [part for line in lines for part in textwrap.wrap(line, 110, subsequent_indent="    ")]


def _listed(stages: set[str]) -> str:
    return ", ".join(stage for stage in STAGES if stage in stages) or "nothing"


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
        not. Empty for an `Absent`.
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
