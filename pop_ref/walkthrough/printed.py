"""All chapters as one page for the printer, from which a browser makes the PDF."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from typing import Final

from pop_ref.walkthrough import layout
from pop_ref.walkthrough.cells import FOLDER, Chapter
from pop_ref.walkthrough.pages import Outcome

_ARTICLE: Final = re.compile(r"<article>(.*)</article>", re.DOTALL)
_ID: Final = re.compile(r'(\bid="|\bfor="|href="#|url\(#)(?=p\d)')
_LINK: Final = re.compile(r'href="(chapter_\w+)\.html"')
_LABEL: Final = re.compile(r'<a class="label"[^>]*>(.*?)</a>')


def book(told: Sequence[tuple[Chapter, Sequence[Outcome]]]) -> str:
    """Lay out chapters one after the other, with a contents whose lines lead to them.

    Args:
        told: chapters in order, with what their cells did.

    Returns:
        One HTML file; answers stand open in it, and widgets as they are before they are touched.

    Raises:
        ChapterError: a formula cannot be set.
    """
    chapters = [chapter for chapter, _ in told]
    lines = "".join(
        f'<li><a href="#{chapter.path.stem}">{chapter.number}. {escape(chapter.title)}</a></li>'
        for chapter in chapters
    )
    articles = "".join(_article(chapter, outcomes, chapters) for chapter, outcomes in told)
    style = "".join(
        (FOLDER / name).read_text(encoding="utf-8") for name in ("page.css", "printed.css")
    )
    title = escape(layout.TITLE)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{style}</style></head>"
        f'<body class="book"><main><header><h1>{title}</h1><p>{escape(layout.LEAD)}</p><ol class="lines">{lines}</ol>'
        f"</header>{articles}</main></body></html>\n"
    )


def _article(
    chapter: Chapter, outcomes: Sequence[Outcome], chapters: Sequence[Chapter]
) -> str:
    found = _ARTICLE.search(layout.chapter_page(chapter, outcomes, chapters))
    assert found is not None
    # cells are numbered anew in every chapter
    body = _ID.sub(rf"\g<1>{chapter.path.stem}-", found[1])
    # a label leads to the glossary of the pages, which is not here
    body = _LABEL.sub(r"\1", _LINK.sub(r'href="#\1"', body))
    return f'<article id="{chapter.path.stem}">{body}</article>'
