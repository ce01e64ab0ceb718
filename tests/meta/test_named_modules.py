"""What words in backticks name is there: modules, what lies in them, and files of source."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("pop_ref", "pop_fast", "cuda_ext", "paper_repro", "benchmarks", "tests", "docs")
SOURCES = (".py", ".h", ".cuh", ".cu", ".cpp")
FILES = [
    path
    for room in ROOMS
    for path in (ROOT / room).rglob("*")
    if path.suffix in (*SOURCES, ".md") and not {"results", "build", "corpus", Path(__file__).name} & set(path.parts)
]
DOTTED = re.compile(r"`((?:pop_ref|pop_fast|cuda_ext|paper_repro|benchmarks|tests)(?:\.\w+)+)(?:\(\))?`")
FILE = re.compile(r"`(\w+\.(?:py|h|cuh|cu|cpp))`")
# a sentence that sends its reader to one word
SENT_TO = re.compile(r"(?:[Ss]ee|\b(?:is|are|stands?) in|step of) `([a-z_]+)`")
# of any number, in words on how files are called
PATTERNS = {"chapter_NN_short_name.py"}


@cache
def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@cache
def names_of_files() -> frozenset[str]:
    return frozenset(path.name for path in FILES)


@cache
def named() -> frozenset[str]:
    """Return what a word can send its reader to: files, folders, and what is defined in Python or C++."""
    defined = re.compile(r"\b(?:def|class|struct|void|auto|Real|T|int|bool)\s+(\w+)")
    words = {word for path in FILES if path.suffix in SOURCES for word in defined.findall(text_of(path))}
    return frozenset(words | {path.stem for path in FILES} | {path.parent.name for path in FILES})


def is_there(dotted: str) -> bool:
    """Tell whether a module of that name is in the tree, or the longest part of it that is one has the rest."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:length])
        module = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if module.is_file() or place.is_dir():
            text = text_of(module) if module.is_file() else ""
            return all(re.search(rf"\b{part}\b", text) for part in parts[length:])
    return False


def missing(path: Path, text: str) -> Iterator[str]:
    yield from (found for found in DOTTED.findall(text) if not is_there(found))
    yield from (found for found in FILE.findall(text) if found not in names_of_files() | PATTERNS)
    for found in SENT_TO.findall(text):
        # a parameter is explained by its neighbours, and a setting stands as a text
        here = rf"[(,]\s*{found}[,:=)]|[\"']{found}[\"']"
        if path.suffix in SOURCES and found not in named() and not re.search(here, text):
            yield found


def test_what_is_named_in_backticks_is_there() -> None:
    gone = {str(path.relative_to(ROOT)): list(missing(path, text_of(path))) for path in FILES}
    assert not {path: names for path, names in gone.items() if names}


@pytest.mark.parametrize(
    "words",
    [
        "The arithmetic is in `blender`.",
        "Optimizations: see `blender`; what is kept",
        "a step of `blender` at a time",
        "See `pop_fast.stages.blender`.",
        "`pop_ref.training.no_such_step` has it",
        "as in `tile_of_old.h`",
    ],
)
def test_a_name_of_nothing_is_noticed(words: str) -> None:
    assert list(missing(ROOT / "pop_fast" / "stages" / "compositing.py", words))
