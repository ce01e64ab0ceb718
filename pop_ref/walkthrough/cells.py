"""Read a chapter: a script in percent format, cut into cells of prose, code and answers."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

Kind = Literal["prose", "code", "setup", "answer"]

FOLDER: Final = Path(__file__).resolve().parent

_MARKER: Final = re.compile(r"^# %%(.*)$")
_KINDS: Final[dict[str, Kind]] = {
    "": "code",
    "[markdown]": "prose",
    "setup": "setup",
    "answer": "answer",
}
_NAME: Final = re.compile(r"^chapter_(\d\d)([a-z]?)_[a-z0-9_]+$")
_TITLE: Final = re.compile(r"^# (\d+[a-z]?)\. (.+)$")
MINUTES: Final = re.compile(r"^# minutes: (\d+)$", re.MULTILINE)
_EXERCISE: Final = re.compile(r"^### Exercise (\d+): (\w[\w ]*)$", re.MULTILINE)
# in the order of a chapter: guess, then prove, then program, then read what is wrong
TIERS: Final = ("predict", "derive", "code", "find the bug")


class ChapterError(Exception):
    """A chapter cannot be read, run or laid out; the message begins with its file and line."""

    def __init__(self, path: Path, line: int, what: str) -> None:
        super().__init__(f"{path.name}:{line}: {what}")


@dataclass(frozen=True)
class Cell:
    """One cell: prose without its comment marks, or code as it stands; `line` is where `text` begins in the file."""

    kind: Kind
    text: str
    line: int


@dataclass(frozen=True)
class Chapter:
    """A chapter: its number ("4b") and title from the first heading, the paragraph under it, and all cells in order.

    Attributes:
        minutes: that a reader needs, exercises included.
    """

    path: Path
    number: str
    title: str
    minutes: int
    opening: str
    cells: tuple[Cell, ...]

    @property
    def page(self) -> str:
        """Name the file of the chapter's page."""
        return f"{self.path.stem}.html"

    @property
    def module(self) -> str:
        """Name the module that the chapter is."""
        return f"{__package__}.{self.path.stem}"

    @property
    def tiers(self) -> list[str]:
        """List what kind each exercise is of, in order."""
        return [
            found[2]
            for cell in self.cells
            if cell.kind == "prose" and (found := _EXERCISE.match(cell.text))
        ]

    def code_after(self, cell: Cell) -> list[str]:
        """List the code of all later cells."""
        return [
            each.text
            for each in self.cells
            if each.kind != "prose" and each.line > cell.line
        ]

    @property
    def n_exercises(self) -> int:
        """Count the exercises, each of which has an answer."""
        return sum(cell.kind == "answer" for cell in self.cells)


def chapter_files(folder: Path = FOLDER) -> list[Path]:
    """List the chapters' files in the order in which they are read."""
    return sorted(folder.glob("chapter_*.py"))


def chapter_number(path: Path) -> str:
    """Read a chapter's number off its file's name: "4", or "4b" for what stands between 4 and 5.

    Raises:
        ChapterError: the name is not `chapter_NN_short_name.py`.
    """
    named = _NAME.match(path.stem)
    if named is None:
        raise ChapterError(path, 1, "a chapter's file is named chapter_NN_short_name.py")
    return f"{int(named[1])}{named[2]}"


def read_chapter(path: Path, text: str | None = None) -> Chapter:
    """Read one chapter and hold it to the form that all chapters have.

    Args:
        path: the file, named `chapter_NN_short_name.py`.
        text: what the file says, default read from it.

    Raises:
        ChapterError: a cell, the title or an exercise does not have its form.
    """
    text = path.read_text(encoding="utf-8") if text is None else text
    cells = tuple(_cells(path, text))
    number = chapter_number(path)
    if not cells or cells[0].kind != "prose":
        raise ChapterError(path, 1, "the first cell must be prose, '# %% [markdown]'")
    heading, _, rest = cells[0].text.partition("\n")
    titled = _TITLE.match(heading)
    if titled is None or titled[1] != number:
        wanted = f"# # {number}. Title"
        raise ChapterError(
            path,
            cells[0].line,
            f"the first line must be {wanted!r}, it is {'# ' + heading!r}",
        )
    opening = rest.strip().split("\n\n")[0]
    if not opening or opening.startswith("#"):
        raise ChapterError(
            path,
            cells[0].line,
            "a paragraph on what the chapter teaches must follow the title",
        )
    _hold_exercises(path, cells)
    minutes = MINUTES.search(text)
    if minutes is None:
        raise ChapterError(
            path, 1, "a line '# minutes: 20' must tell how long the chapter takes"
        )
    return Chapter(path, number, titled[2], int(minutes[1]), opening, cells)


def _cells(path: Path, text: str) -> list[Cell]:
    cells: list[Cell] = []
    lines = text.splitlines()
    starts = [i for i, line in enumerate(lines) if _MARKER.match(line)]
    for i, line in enumerate(lines[: starts[0]] if starts else lines, start=1):
        if line and not line.startswith("#"):
            raise ChapterError(path, i, "code stands before the first cell")
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        word = lines[start].removeprefix("# %%").strip()
        if word not in _KINDS:
            raise ChapterError(
                path,
                start + 1,
                f"a cell is marked '# %%', '# %% [markdown]', '# %% setup' or '# %% answer', not {word!r}",
            )
        first, last = start + 1, end
        while first < last and not lines[first].strip():
            first += 1
        while last > first and not lines[last - 1].strip():
            last -= 1
        if first == last:
            raise ChapterError(path, start + 1, "the cell is empty")
        body = lines[first:last]
        if word == "[markdown]":
            body = [_prose_line(path, first + 1 + i, line) for i, line in enumerate(body)]
        cells.append(Cell(_KINDS[word], "\n".join(body), first + 1))
    return cells


def _prose_line(path: Path, number: int, line: str) -> str:
    if line != "#" and not line.startswith("# "):
        raise ChapterError(
            path, number, f"a line of prose begins with '# ', this one is {line!r}"
        )
    return line[2:]


def _hold_exercises(path: Path, cells: tuple[Cell, ...]) -> None:
    asked = 0
    for i, cell in enumerate(cells):
        exercise = _EXERCISE.match(cell.text) if cell.kind == "prose" else None
        after = cells[i + 1] if i + 1 < len(cells) else None
        if exercise is not None:
            asked += 1
            if int(exercise[1]) != asked:
                raise ChapterError(
                    path, cell.line, f"this is exercise {asked}, not {exercise[1]}"
                )
            if exercise[2] not in TIERS:
                raise ChapterError(
                    path,
                    cell.line,
                    f"exercise {asked} is one of {', '.join(TIERS)}, not {exercise[2]!r}",
                )
            if after is None or after.kind != "answer":
                raise ChapterError(
                    path,
                    cell.line,
                    f"exercise {asked} has no answer: a cell '# %% answer' must follow",
                )
        elif after is not None and after.kind == "answer":
            raise ChapterError(
                path,
                after.line,
                "an answer must follow its exercise, a prose cell '# ### Exercise k: predict'",
            )
        if cell.kind == "answer" and not any(
            _asserts(node) for node in ast.walk(_parsed(path, cell))
        ):
            raise ChapterError(
                path, cell.line, f"the answer to exercise {asked} asserts nothing"
            )


def _asserts(node: ast.AST) -> bool:
    # `caught` asserts that a law of the kit notices a mistake
    called = node.func if isinstance(node, ast.Call) else None
    return isinstance(node, ast.Assert) or (
        isinstance(called, ast.Name) and called.id == "caught"
    )


def _parsed(path: Path, cell: Cell) -> ast.Module:
    try:
        return ast.parse(cell.text)
    except SyntaxError as error:
        raise ChapterError(
            path, cell.line + (error.lineno or 1) - 1, f"SyntaxError: {error.msg}"
        ) from error
