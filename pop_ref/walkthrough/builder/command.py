"""Write the walk-through: `python -m pop_ref.walkthrough out/walkthrough`, and its other forms."""

from __future__ import annotations

import argparse
import functools
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pop_ref.walkthrough.builder.chapter import Chapter, ChapterError, chapter_files, chapter_number, read_chapter

if TYPE_CHECKING:
    from pop_ref.walkthrough.pages import Outcome

# the mistakes that readers look for are judged by the kit, which needs hypothesis
_NEEDED: Final = ("matplotlib", "markdown_it", "mdit_py_plugins", "latex2mathml", "pygments", "hypothesis")
_BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# inside a container Chromium may neither make its sandbox nor rely on /dev/shm
CHROMIUM_OPTIONS: Final = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--force-color-profile=srgb",
)
_EXAMPLES: Final = """examples:
  python -m pop_ref.walkthrough out/walkthrough                  pages
  python -m pop_ref.walkthrough --notebooks out/notebooks        Jupyter notebooks, which run anew
  python -m pop_ref.walkthrough --slides out/slides.html         a lecture of ninety minutes: arrows turn, N shows notes
  python -m pop_ref.walkthrough --pdf out/walkthrough.pdf        a book for the printer, by a headless Chromium
  python -m pop_ref.walkthrough out/walkthrough --all            pages with all of these next to them
"""


class BrowserError(Exception):
    """There is no Chromium, or it wrote nothing; the message says what to do."""


def main(arguments: list[str] | None = None) -> int:
    """Run the chapters and write their pages, notebooks, slides or book.

    Args:
        arguments: of the command line, default the process's own.

    Returns:
        The exit status: 0, or 2 with one line on stderr.
    """
    wanted = _wanted(arguments)
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        print(f"{', '.join(missing)} missing; pip install 'pop-ref[walkthrough]'", file=sys.stderr)
        return 2
    try:
        write(wanted)
    except (ChapterError, BrowserError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _wanted(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m pop_ref.walkthrough",
        description="Write the walk-through.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, nargs="?", help="where the pages go; it is made")
    parser.add_argument("--notebooks", type=Path, metavar="DIR", help="write one notebook a chapter")
    parser.add_argument("--slides", type=Path, metavar="FILE", help="write the lecture")
    parser.add_argument("--pdf", type=Path, metavar="FILE", help="print all chapters; needs Chromium or Chrome")
    also = "write the other forms into the folder too; the PDF where there is a Chromium"
    parser.add_argument("--all", action="store_true", help=also)
    parser.add_argument("--only", nargs="+", metavar="N", help="run these chapters only, 4 or 4b; no slides with --all")
    given = parser.parse_args(arguments)
    if given.folder is None and not (given.all or given.notebooks or given.slides or given.pdf):
        parser.error("name the folder that the pages go to, or --notebooks, --slides or --pdf")
    numbers = [chapter_number(path) for path in chapter_files()]
    unknown = [each for each in given.only or [] if each not in numbers]
    if unknown:
        parser.error(f"--only: there is no chapter {', '.join(unknown)}; there are {' '.join(numbers)}")
    if given.all:
        if given.folder is None:
            parser.error("--all needs the folder that the pages go to")
        folder = Path(given.folder)
        given.notebooks = given.notebooks or folder / "notebooks"
        given.slides = given.slides or (None if given.only else folder / "slides.html")
        given.pdf = given.pdf or (folder / "walkthrough.pdf" if chromium() else None)
    return given


def write(wanted: argparse.Namespace) -> None:
    """Write what is wanted; a chapter that several forms need is run once.

    Args:
        wanted: `folder`, `notebooks`, `slides`, `pdf`: where each goes, None for nothing; `only`: numbers of chapters,
            None for all. Where only some chapters are, the contents lists what can be read: while one chapter is being
            written, another may be out of form.

    Raises:
        ChapterError: a chapter failed; pages of earlier chapters are written.
        BrowserError: the PDF cannot be printed.
    """
    from pop_ref.walkthrough.builder import layout, notebooks, slides

    only = wanted.only
    chapters = [
        read_chapter(path) for path in chapter_files() if not only or chapter_number(path) in only or _readable(path)
    ]
    chosen = [each for each in chapters if not only or each.number in only]
    if wanted.notebooks:
        names = [notebooks.notebook_name(each) for each in chosen]
        for chapter, name in zip(chosen, names, strict=True):
            _write(wanted.notebooks / name, notebooks.notebook(chapter))
        _write(wanted.notebooks / "index.html", layout.notebook_index(chosen, names))
    if wanted.folder:
        _write_pages(wanted, chosen, chapters)
    if wanted.slides:
        told = slides.read_slides(slides.FILE.read_text(encoding="utf-8"))
        numbered = {each.number: each for each in chapters}
        _write(wanted.slides, slides.deck(told, lambda number: (numbered[number], _run(numbered[number]))))
    if wanted.pdf:
        _write(wanted.pdf, _printed(layout.book([(each, _run(each)) for each in chosen])))
    opened = [wanted.folder and wanted.folder / "index.html", wanted.slides, wanted.pdf]
    print("\n".join(f"open {each}" for each in opened if each))
    if wanted.notebooks:
        print(f"jupyter lab {wanted.notebooks}")


def _write_pages(wanted: argparse.Namespace, chosen: Sequence[Chapter], chapters: Sequence[Chapter]) -> None:
    from pop_ref.walkthrough.builder import glossary, layout, notebooks

    folder: Path = wanted.folder
    folder.mkdir(parents=True, exist_ok=True)
    forms = {
        "notebooks": wanted.notebooks and wanted.notebooks / "index.html",
        "slides": wanted.slides,
        "PDF": wanted.pdf,
    }
    beside = {
        name: place.relative_to(folder).as_posix()
        for name, place in forms.items()
        if place and place.is_relative_to(folder)
    }
    for chapter in chosen:
        near = (
            f"{Path(beside['notebooks']).parent}/{notebooks.notebook_name(chapter)}" if "notebooks" in beside else None
        )
        _write(folder / chapter.page, layout.chapter_page(chapter, _run(chapter), chapters, near))
    _write(folder / glossary.GLOSSARY_PAGE, layout.glossary_page())
    _write(folder / "index.html", layout.index_page(chapters, beside))


@functools.cache
def _run(chapter: Chapter) -> Sequence[Outcome]:
    from pop_ref.walkthrough.pages import run_chapter

    start = time.perf_counter()
    outcomes = run_chapter(chapter)
    print(f"{chapter.number:>3}  {chapter.title}  {time.perf_counter() - start:.1f} s", flush=True)
    return outcomes


def _readable(path: Path) -> bool:
    try:
        read_chapter(path)
    except ChapterError:
        return False
    return True


def chromium() -> str | None:
    """Find the browser's program: the environment's `CHROMIUM`, or one of its usual names on the path."""
    wanted = os.environ.get("CHROMIUM")
    if wanted:
        return shutil.which(wanted)
    return next((found for name in _BROWSERS if (found := shutil.which(name))), None)


def _printed(page: str) -> bytes:
    """Print a page to PDF.

    Raises:
        BrowserError: there is no Chromium, or it printed nothing.
    """
    program = chromium()
    if program is None:
        raise BrowserError(
            "a PDF needs Chromium or Chrome: install it (apt install chromium) or set CHROMIUM to its path"
        )
    with tempfile.TemporaryDirectory() as folder:
        source, printed = Path(folder) / "book.html", Path(folder) / "printed.pdf"
        source.write_text(page, encoding="utf-8")
        to = [f"--user-data-dir={folder}/profile", "--no-pdf-header-footer", f"--print-to-pdf={printed}"]
        command = [program, *CHROMIUM_OPTIONS, *to, source.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True)
        if not printed.exists():
            why = f"(exit status {done.returncode}): {done.stderr.strip()[-400:]}"
            raise BrowserError(f"{program} printed nothing {why}")
        return printed.read_bytes()


def _write(path: Path, what: str | bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(what.encode() if isinstance(what, str) else what)
    os.replace(partial, path)
