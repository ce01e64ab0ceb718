"""The methods' tables: every setting that decides a training, with its value and where its authors' code says so.

Each method has its own file, whose values are literals: no default of one method can change another.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

FOLDER: Final = Path(__file__).resolve().parent
# TOML has no null
NONE: Final = "none"

Cited = tuple[Any, str]


@dataclass(frozen=True, kw_only=True)
class Pinned:
    """A method's table; every value names the place that it is from."""

    method: str  # its name for `pop train --method`
    sources: tuple[str, ...]  # the code, and the commit, whose files and lines are meant
    settings: Mapping[str, Cited]  # of a run of the whole schedule
    order: Mapping[str, Cited]  # of what happens to the Gaussians, by kind of step
    rows: Mapping[str, Mapping[str, Cited]]  # in which settings a row differs from the method, by row
    scenes: Mapping[str, Mapping[str, Cited]]  # in which settings a scene of the paper does, by scene


def load_pinned(method: str) -> Pinned:
    """Read a method's table."""
    found = tomllib.loads((FOLDER / f"{method}.toml").read_text(encoding="utf-8"))
    return Pinned(
        method=found["method"],
        sources=tuple(found["sources"]),
        settings=_cited(found["settings"]),
        order=_cited(found["order"]),
        rows={name: _cited(row) for name, row in found.get("rows", {}).items()},
        scenes={name: _cited(scene) for name, scene in found.get("scenes", {}).items()},
    )


def _cited(table: Mapping[str, Any]) -> dict[str, Cited]:
    return {name: (None if value == NONE else value, source) for name, (value, source) in table.items()}
