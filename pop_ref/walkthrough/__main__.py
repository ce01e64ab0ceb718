"""Write the walk-through: `python -m pop_ref.walkthrough out/walkthrough`."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from pathlib import Path

from pop_ref.walkthrough.cells import (
    ChapterError,
    chapter_files,
    chapter_number,
    read_chapter,
)

_NEEDED = ("matplotlib", "markdown_it", "mdit_py_plugins", "latex2mathml", "pygments")


def main(arguments: list[str] | None = None) -> int:
    """Run the chapters and write their pages and the contents.

    Args:
        arguments: of the command line, default the process's own.

    Returns:
        The exit status: 0, or 2 with one line on stderr.
    """
    parser = argparse.ArgumentParser(
        prog="python -m pop_ref.walkthrough", description="Write the walk-through."
    )
    parser.add_argument("folder", type=Path, help="where the pages go; it is made")
    parser.add_argument(
        "--only", nargs="+", metavar="N", help="run these chapters only, 4 or 4b"
    )
    wanted = parser.parse_args(arguments)
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        print(
            f"{', '.join(missing)} missing; pip install 'pop-splatting[walkthrough]'",
            file=sys.stderr,
        )
        return 2
    try:
        write(wanted.folder, wanted.only)
    except ChapterError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def write(folder: Path, only: list[str] | None = None) -> None:
    """Write the pages into a folder.

    Args:
        folder: made if it is not there.
        only: numbers of the chapters to run, such as 4 or 4b, default all. The contents then lists what can be
            read: while one chapter is being written, another may be out of form.

    Raises:
        ChapterError: a chapter failed; pages of earlier chapters are written.
    """
    from pop_ref.walkthrough.glossary import GLOSSARY_PAGE
    from pop_ref.walkthrough.layout import chapter_page, glossary_page, index_page
    from pop_ref.walkthrough.pages import run_chapter

    chapters = [
        read_chapter(path)
        for path in chapter_files()
        if only is None or chapter_number(path) in only or _readable(path)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    for chapter in chapters:
        if only is None or chapter.number in only:
            start = time.perf_counter()
            page = chapter_page(chapter, run_chapter(chapter), chapters)
            _write(folder / chapter.page, page)
            took = time.perf_counter() - start
            print(f"{chapter.number:>3}  {chapter.title}  {took:.1f} s", flush=True)
    _write(folder / GLOSSARY_PAGE, glossary_page())
    _write(folder / "index.html", index_page(chapters))
    print(f"open {folder / 'index.html'}")


def _readable(path: Path) -> bool:
    try:
        read_chapter(path)
    except ChapterError:
        return False
    return True


def _write(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.partial")
    beside.write_text(text, encoding="utf-8")
    os.replace(beside, path)


if __name__ == "__main__":
    sys.exit(main())
