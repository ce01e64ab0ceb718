"""Errors that a user can act on: one line that names the file, the field and the fix."""

from __future__ import annotations

__all__ = ["CaptureError", "PopError"]


class PopError(ValueError):
    """Base of every error that the user, not the program, has to put right.

    The command line prints `pop: error: <message>` and exits with status 2; libraries can catch it as a ValueError.
    The message is always one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(str(message).split()))


class CaptureError(PopError):
    """Tell what is wrong with a capture: its folder, model, transforms.json, photographs or masks."""
