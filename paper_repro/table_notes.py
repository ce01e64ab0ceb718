"""Reasons of a table's cells as numbered notes below it, so that columns stay narrow."""

from __future__ import annotations

from typing import Final

__all__ = ["Notes"]

_LONG: Final = "not comparable: "


class Notes:
    """The notes of one block, in the order in which cells asked for them."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def short(self, text: str) -> tuple[str, int]:
        """Give what stands in the cell, and the number of its note; 0 where the text says all itself."""
        if not text.startswith(_LONG):
            return text, 0
        why = text.removeprefix(_LONG)
        if why not in self.texts:
            self.texts.append(why)
        return _LONG.removesuffix(": "), 1 + self.texts.index(why)
