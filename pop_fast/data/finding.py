"""One line of what an examination found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "warn", "bad"]


def number(count: int, one: str, more: str) -> str:
    """Choose the word that goes with a number."""
    return one if count == 1 else more


@dataclass(frozen=True)
class Finding:
    """One line: how bad, about what, and what was found."""

    state: State
    about: str
    text: str
