"""Chapters, each run once in a process however many tests look at what it did."""

from __future__ import annotations

import functools
from pathlib import Path

from pop_ref.walkthrough.cells import Chapter, chapter_files, read_chapter
from pop_ref.walkthrough.pages import Outcome, run_chapter

CHAPTERS = chapter_files()


@functools.cache
def ran(path: Path) -> tuple[Chapter, list[Outcome]]:
    """Read a chapter and run it."""
    chapter = read_chapter(path)
    return chapter, run_chapter(chapter)
