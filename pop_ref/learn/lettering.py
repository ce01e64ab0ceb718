"""Letters for pictures that are drawn with NumPy alone: capitals of three by five squares."""

from __future__ import annotations

from typing import Final

import numpy as np

SQUARE: Final = 2
LINE: Final = 7 * SQUARE
_CHARACTERS: Final = "0123456789abcdefghijklmnopqrstuvwxyz[]-+.,: "
# of each five rows from the top, an octal digit a row, whose three bits are the squares from the left
_ROWS: Final = (
    "7555726227717477171755711747177475771111757577571725755656563444365556746477464434553557557222711152"
    "5565544447577556555525552656442556365655342167222255557555525577555255552227124764446311130070002720"
    "00002000240202000000"
)
_GLYPHS: Final = {each: _ROWS[5 * k : 5 * k + 5] for k, each in enumerate(_CHARACTERS)}


def lettered(text: str) -> np.ndarray:
    """Return a text as squares.

    Args:
        text: of letters (large and small look alike), digits, spaces and `[]-+.,:`.

    Returns:
        Which pixels [5 SQUARE, 4 SQUARE len(text)] are inked, bool.

    Raises:
        KeyError: a character has no glyph.
    """
    glyphs = [[[int(row) >> bit & 1 for bit in (2, 1, 0)] + [0] for row in _GLYPHS[each]] for each in text.lower()]
    squares = np.concatenate([np.zeros((5, 0)), *(np.array(glyph) for glyph in glyphs)], axis=1)
    return squares.repeat(SQUARE, axis=0).repeat(SQUARE, axis=1).astype(bool)


def write_text(picture: np.ndarray, text: str, x: int, y: int, color: np.ndarray) -> None:
    """Write a text into a picture; what does not fit is cut off.

    Args:
        picture: [H, W, 3], written to.
        text: as in `lettered`.
        x, y: its left and upper edge, in pixels.
        color: [3].
    """
    inked = lettered(text)[: max(0, len(picture) - y), : max(0, picture.shape[1] - x)]
    picture[y : y + inked.shape[0], x : x + inked.shape[1]][inked] = color
