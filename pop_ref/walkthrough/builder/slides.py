"""The lecture: `slides.md`, 25 slides for ninety minutes, as one HTML file that turns, with speaker notes.

Slides are parted by `---`. Each has a heading, markdown for the screen, a line `Notes, 4 minutes.` and what to say. A
line `{{picture: 4: How the weights}}` stands for the picture of chapter 4 whose caption begins so; widgets stand as in
chapters.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Final

from pop_ref.walkthrough.builder.chapter import Chapter, ChapterError
from pop_ref.walkthrough.builder.layout import asset, document, figure, prose
from pop_ref.walkthrough.pages import Outcome

FILE: Final = Path(__file__).resolve().with_name("slides.md")
_SLIDE: Final = re.compile(r"# (.+?)\n(.*)^Notes, (\d+) minutes?\.\n(.+)", re.DOTALL | re.MULTILINE)
_PICTURE: Final = re.compile(r"^\{\{picture: (\w+): (.+)\}\}$", re.MULTILINE)


@dataclass(frozen=True)
class Slide:
    """One slide: heading, markdown for the screen, minutes, markdown to say, and the line at which it begins."""

    heading: str
    body: str
    minutes: int
    notes: str
    line: int


def read_slides(text: str, path: Path = FILE) -> list[Slide]:
    """Cut the lecture into its slides.

    Raises:
        ChapterError: a slide lacks its heading, its minutes or its notes; the message names file and line.
    """
    slides, line = [], 1
    for piece in re.split(r"^---$", text, flags=re.MULTILINE):
        found = _SLIDE.fullmatch(piece.strip("\n"))
        begins = line + len(piece) - len(piece.lstrip("\n"))
        if found is None:
            raise ChapterError(path, begins, "a slide is '# Heading', markdown, a line 'Notes, 4 minutes.' and notes")
        slides.append(Slide(found[1], found[2].strip(), int(found[3]), found[4].strip(), begins))
        line += piece.count("\n")
    return slides


def chapters_of(slides: Sequence[Slide]) -> set[str]:
    """Name the chapters whose pictures the slides show."""
    return {number for slide in slides for number, _ in _PICTURE.findall(slide.body)}


def deck(slides: Sequence[Slide], run: Callable[[str], tuple[Chapter, Sequence[Outcome]]]) -> str:
    """Lay out the lecture.

    Args:
        slides: as `read_slides` gave them.
        run: gives the chapter of a number and what its cells did.

    Returns:
        One HTML file. Arrow keys, a click on the sides or a swipe turn the slides, N shows the notes; printed, each
        slide has a page with its notes below.

    Raises:
        ChapterError: a formula cannot be set, or no picture's caption begins as a slide says.
    """
    shown, minute = "", 0
    for number, slide in enumerate(slides, start=1):
        kind = "title" if number == 1 else "widget" if "{{widget: " in slide.body else "text"
        tag = "h1" if kind == "title" else "h2"
        when = f"<p><b>Minute {minute} to {minute + slide.minutes}.</b></p>"
        minute += slide.minutes
        shown += (
            f'<section class="slide {kind}" id="slide-{number}" aria-label="slide {number}"><div class="face">'
            f'<{tag}>{escape(slide.heading)}</{tag}><div class="body">{_body(slide, number, run)}</div></div>'
            f"<aside>{when}{_set(slide, slide.notes)}</aside></section>"
        )
    controls = (
        '<div class="bar" role="toolbar" aria-label="slides"><button type="button" data-go="-1" aria-label="back">'
        '\u2190</button><output></output><button type="button" data-go="1" aria-label="on">\u2192</button>'
        '<button type="button" data-notes aria-pressed="false">Notes (N)</button></div>'
    )
    return document(
        f"Gaussian splatting in {minute} minutes",
        f'<main class="deck">{shown}</main>{controls}',
        asset("page.css") + asset("slides.css"),
        asset("page.js") + asset("slides.js"),
    )


def _body(slide: Slide, number: int, run: Callable[[str], tuple[Chapter, Sequence[Outcome]]]) -> str:
    # every third piece is a chapter's number, and the next how a caption begins
    pieces = _PICTURE.split(slide.body)
    shown = _set(slide, pieces[0])
    for of, begins, text in zip(pieces[1::3], pieces[2::3], pieces[3::3], strict=True):
        chapter, outcomes = run(of)
        found = [(o.cell, each) for o in outcomes for each in o.pictures if each.caption.startswith(begins)]
        if len(found) != 1:
            told = f"{len(found)} pictures of chapter {of} have a caption that begins with {begins!r}"
            raise ChapterError(FILE, slide.line, told)
        shown += figure(chapter, found[0][0], f"s{number}", found[0][1]) + _set(slide, text)
    return shown


def _set(slide: Slide, text: str) -> str:
    shown = prose(Chapter(FILE, "", "", 0, "", ()), text, slide.line)
    # what leads to the pages would lead nowhere: they need not be here
    return re.sub(r'<a [^>]*?href="(?:chapter_|glossary)[^>]*>(.*?)</a>', r"\1", shown)
