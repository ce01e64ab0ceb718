"""Which world a splat is in, and how files say it: a comment in a PLY's header, an object of JSON in other formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from pop_fast.errors import PopError

__all__ = ["COMMENT", "KEY", "Frame"]

# what the comment of a PLY's header begins with, and the name of the object in JSON
COMMENT: Final = "pop-frame:"
KEY: Final = "pop_frame"


@dataclass(frozen=True)
class Frame:
    """The world that a splat is in.

    Attributes:
        name: "capture" is the capture's own, "training" the one that `pop train` moves it into.
        transform: similarity, training frame = transform @ capture's own frame; None where it is not known. [4, 4]
    """

    name: Literal["capture", "training"]
    transform: tuple[tuple[float, ...], ...] | None = None

    @classmethod
    def of_training(cls, transform: Any) -> Frame:
        """Return the frame of a training that a similarity, an array [4, 4], moved, or that None left where it was."""
        return cls("capture") if transform is None else cls("training", tuple(map(tuple, transform.tolist())))

    def comment(self) -> str:
        """Return the comment of a PLY's header, without the word "comment"."""
        rows = () if self.transform is None else self.transform
        return " ".join([COMMENT, self.name, *(f"{x:.17g}" for row in rows for x in row)])

    def entry(self) -> dict[str, Any]:
        """Return what JSON holds under the name `KEY`."""
        return {"name": self.name, **({} if self.transform is None else {"transform": self.transform})}

    @classmethod
    def of_comments(cls, comments: Sequence[str], path: Path) -> Frame | None:
        """Read the frame from the comments of a PLY's header; None where they have none, as of other programs.

        Raises:
            PopError: the comment is not one that this program writes.
        """
        for comment in comments:
            if comment.startswith(COMMENT):
                name, *numbers = comment.removeprefix(COMMENT).split() or [""]
                found = cls._checked(name, numbers or None)
                if found is None:
                    raise PopError(f"{path}: comment {comment[:60]!r} is damaged; remove it, or export the splat again")
                return found
        return None

    @classmethod
    def of_entry(cls, holder: Any, path: Path) -> Frame | None:
        """Read the frame from an object of JSON that may hold it under the name `KEY`; None where it does not.

        Raises:
            PopError: the entry is not one that this program writes.
        """
        if not isinstance(holder, Mapping) or KEY not in holder:
            return None
        entry = holder[KEY]
        found = cls._checked(entry.get("name"), entry.get("transform")) if isinstance(entry, Mapping) else None
        if found is None:
            raise PopError(f"{path}: {KEY} is {str(entry)[:60]!r}, which is damaged; export the splat again")
        return found

    @classmethod
    def _checked(cls, name: Any, numbers: Any) -> Frame | None:
        """Return the frame of a name and of 16 numbers or none, in rows or not; None where they make no frame."""
        if name not in ("capture", "training"):
            return None
        if numbers is None:
            return cls(name)
        try:
            values = np.array(numbers, np.float64).reshape(4, 4)
            # what cannot be undone moves nothing back
            sound = np.isfinite(values).all() and np.isfinite(np.linalg.inv(values)).all()
        except (ValueError, TypeError, OverflowError, np.linalg.LinAlgError):
            return None
        return cls(name, tuple(map(tuple, values.tolist()))) if sound else None
