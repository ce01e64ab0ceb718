"""Write the walk-through: `python -m pop_ref.walkthrough out/walkthrough`, and its other forms."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pop_ref.walkthrough.browser import BrowserError, chromium, print_pdf
from pop_ref.walkthrough.cells import (
    Chapter,
    ChapterError,
    chapter_files,
    chapter_number,
    read_chapter,
)

if TYPE_CHECKING:
    from pop_ref.walkthrough.pages import Outcome

# the mistakes that readers look for are judged by the kit, which needs hypothesis
_NEEDED = (
    "matplotlib",
    "markdown_it",
    "mdit_py_plugins",
    "latex2mathml",
    "pygments",
    "hypothesis",
)
# what `--all` writes into the folder of the pages, and what the contents calls it
NOTEBOOKS: Final = "notebooks"
SLIDES: Final = "slides.html"
BOOK: Final = "walkthrough.pdf"

_EXAMPLES: Final = """examples:
  python -m pop_ref.walkthrough out/walkthrough                  pages
  python -m pop_ref.walkthrough --notebooks out/notebooks        Jupyter notebooks, which run anew
  python -m pop_ref.walkthrough --slides out/slides.html         a lecture of ninety minutes: arrows turn, N shows notes
  python -m pop_ref.walkthrough --pdf out/walkthrough.pdf        a book for the printer, by a headless Chromium
  python -m pop_ref.walkthrough out/walkthrough --all            pages with all of these beside them
"""


@dataclass(frozen=True)
class Wanted:
    """What to write and where, None for nothing; `only` these chapters, None for all."""

    pages: Path | None = None
    notebooks: Path | None = None
    slides: Path | None = None
    pdf: Path | None = None
    only: list[str] | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the chapters and write their pages, notebooks, slides or book.

    Args:
        arguments: of the command line, default the process's own.

    Returns:
        The exit status: 0, or 2 with one line on stderr.
    """
    wanted = _parsed(arguments)
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        print(
            f"{', '.join(missing)} missing; pip install 'pop-ref[walkthrough]'",
            file=sys.stderr,
        )
        return 2
    try:
        write(wanted)
    except (ChapterError, BrowserError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _parsed(arguments: list[str] | None) -> Wanted:
    parser = argparse.ArgumentParser(
        prog="python -m pop_ref.walkthrough",
        description="Write the walk-through.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", help="where the pages go; it is made"
    )
    parser.add_argument(
        "--notebooks", type=Path, metavar="DIR", help="write one notebook a chapter"
    )
    parser.add_argument(
        "--slides",
        type=Path,
        metavar="FILE",
        help="write the lecture, chapters 0 1 2 4 5 8",
    )
    parser.add_argument(
        "--pdf",
        type=Path,
        metavar="FILE",
        help="print all chapters; needs Chromium or Chrome",
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="write the other forms into the folder too; the PDF where there is a Chromium",
    )
    parser.add_argument(
        "--only", nargs="+", metavar="N", help="run these chapters only, 4 or 4b"
    )
    given = parser.parse_args(arguments)
    if given.all and given.folder is None:
        parser.error("--all needs the folder that the pages go to")
    if given.folder is None and not (given.notebooks or given.slides or given.pdf):
        parser.error(
            "name the folder that the pages go to, or --notebooks, --slides or --pdf"
        )
    beside = given.folder if given.all else None
    return Wanted(
        given.folder,
        given.notebooks or (beside and beside / NOTEBOOKS),
        given.slides or (beside and beside / SLIDES),
        given.pdf or (beside and beside / BOOK if chromium() else None),
        given.only,
    )


def write(wanted: Wanted) -> None:
    """Write what is wanted; a chapter that several forms need is run once.

    Where only some chapters are, the contents lists what can be read: while one chapter is being written, another may
    be out of form.

    Raises:
        ChapterError: a chapter failed; pages of earlier chapters are written.
        BrowserError: the PDF cannot be printed.
    """
    chapters = [
        read_chapter(path)
        for path in chapter_files()
        if wanted.only is None or chapter_number(path) in wanted.only or _readable(path)
    ]
    chosen = [
        each for each in chapters if wanted.only is None or each.number in wanted.only
    ]
    for place in (wanted.slides, wanted.pdf):
        if place is not None:
            place.parent.mkdir(parents=True, exist_ok=True)
    if wanted.notebooks is not None:
        _write_notebooks(wanted.notebooks, chosen)
    run = _once()
    if wanted.pages is not None:
        _write_pages(wanted, chosen, chapters, run)
    if wanted.slides is not None:
        from pop_ref.walkthrough.slides import LECTURE, deck

        _write(
            wanted.slides,
            deck([(each, run(each)) for each in chosen if each.number in LECTURE]),
        )
        print(f"open {wanted.slides}")
    if wanted.pdf is not None:
        _write_book(wanted.pdf, [(each, run(each)) for each in chosen])
    if wanted.pages is not None:
        print(f"open {wanted.pages / 'index.html'}")


def _once() -> Callable[[Chapter], Sequence[Outcome]]:
    from pop_ref.walkthrough.pages import run_chapter

    ran: dict[str, Sequence[Outcome]] = {}

    def run(chapter: Chapter) -> Sequence[Outcome]:
        if chapter.number not in ran:
            start = time.perf_counter()
            ran[chapter.number] = run_chapter(chapter)
            took = time.perf_counter() - start
            print(f"{chapter.number:>3}  {chapter.title}  {took:.1f} s", flush=True)
        return ran[chapter.number]

    return run


def _write_pages(
    wanted: Wanted,
    chosen: Sequence[Chapter],
    chapters: Sequence[Chapter],
    run: Callable[[Chapter], Sequence[Outcome]],
) -> None:
    from pop_ref.walkthrough.glossary import GLOSSARY_PAGE
    from pop_ref.walkthrough.layout import chapter_page, glossary_page, index_page

    folder = wanted.pages
    assert folder is not None
    folder.mkdir(parents=True, exist_ok=True)
    for chapter in chosen:
        _write(folder / chapter.page, chapter_page(chapter, run(chapter), chapters))
    _write(folder / GLOSSARY_PAGE, glossary_page())
    places = {"notebooks": wanted.notebooks, "slides": wanted.slides, "PDF": wanted.pdf}
    beside = {
        name: place.relative_to(folder).as_posix()
        for name, place in places.items()
        if place is not None and place.is_relative_to(folder)
    }
    _write(folder / "index.html", index_page(chapters, beside))


def _write_notebooks(folder: Path, chapters: Sequence[Chapter]) -> None:
    from pop_ref.walkthrough.notebooks import notebook, notebook_index, notebook_name

    folder.mkdir(parents=True, exist_ok=True)
    for chapter in chapters:
        _write(folder / notebook_name(chapter), notebook(chapter))
    _write(folder / "index.html", notebook_index(chapters))
    print(f"jupyter lab {folder}")


def _write_book(pdf: Path, told: Sequence[tuple[Chapter, Sequence[Outcome]]]) -> None:
    from pop_ref.walkthrough.printed import book

    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "book.html"
        page.write_text(book(told), encoding="utf-8")
        print_pdf(page, pdf)
    print(f"open {pdf}")


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
