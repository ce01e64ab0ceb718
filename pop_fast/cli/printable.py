"""Text from files and names made fit for a terminal: no control characters, and no more than can be read."""

from __future__ import annotations

import re
from typing import Final

# C0 without tab and line feed, DEL, C1, and what turns the direction of a line
_CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
# of a message; both of its ends say more than the middle
_LONGEST: Final = 1_200
_END: Final = 300


def printable(text: str) -> str:
    """Write control characters, and what no text may hold, as escapes: a terminal shows them and obeys none."""
    shown = _CONTROL.sub(_escaped, text)
    return shown.encode("utf-8", "backslashreplace").decode("utf-8")


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


def message(text: str) -> str:
    """Make an error's text `printable`, and shorten it in its middle."""
    shown = printable(text)
    return shown if len(shown) <= _LONGEST else f"{shown[: _LONGEST - _END]} ... {shown[-_END:]}"
