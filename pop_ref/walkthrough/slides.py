"""A lecture of ninety minutes from the chapters: one HTML file of slides with the chapters' prose as speaker notes.

Each section of a chapter becomes a slide or several: the first sentence of every paragraph, formulas, lists and tables;
then each picture and each widget on a slide of its own. The whole prose is in the notes; exercises are left out.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Final

from pop_ref.walkthrough import layout
from pop_ref.walkthrough.cells import FOLDER, Chapter
from pop_ref.walkthrough.directives import expanded
from pop_ref.walkthrough.pages import Outcome

LECTURE: Final = ("0", "1", "2", "4", "5", "8")
MINUTES: Final = 90

# how full a slide may be, in lines of its text
_FULL: Final = 11.5
_CHARACTERS_A_LINE: Final = 72
_LIGHT: Final = 3.2
# code of more lines cannot be read from the last row: it is in the notes
_LONGEST_CODE: Final = 24
# a first sentence shorter than this says too little without the next
_BRIEF: Final = 48
_HEADING: Final = re.compile(r"^(#{1,3}) (.+)$")
_WIDGET: Final = re.compile(r"^\{\{widget: \w+\}\}$")
_FILE: Final = re.compile(r"^`[\w/]+\.py`:$")
_ITEM: Final = re.compile(r"^(?:[-*] |\d+\. )")
_SENTENCE_ENDS: Final = re.compile(r"[.?!:][\")\u201d*]*\s+(?=[A-Z$*`\u201c(])")
_NO_END: Final = re.compile(r"(?:\beqs?|\bet al|\be\.g|\bi\.e|\bvs|\bfigs?|\bsec)\.$")


@dataclass
class Slide:
    """One slide: its chapter's number, a heading, text and notes in markdown, and a picture as HTML."""

    chapter: str
    heading: str
    kind: str = "text"
    blocks: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    figure: str = ""

    @property
    def share(self) -> float:
        """Weigh how long the slide stays: a picture is looked at, a widget is played with."""
        return {"title": 0.6, "text": 1.0, "picture": 1.2, "widget": 2.0}[self.kind]

    @property
    def light(self) -> bool:
        """Tell whether it holds too little to stand alone."""
        return (
            self.kind == "text"
            and "$$" not in "".join(self.blocks)
            and sum(map(_lines, self.blocks)) <= _LIGHT
        )


def deck(told: Sequence[tuple[Chapter, Sequence[Outcome]]]) -> str:
    """Lay out the lecture.

    Args:
        told: chapters in order, with what their cells did.

    Returns:
        One HTML file. Arrow keys, a click on the sides or a swipe turn the slides, N shows the notes; printed, each
        slide has a page with its notes below.

    Raises:
        ChapterError: a formula cannot be set.
    """
    slides = [
        (chapter, slide)
        for chapter, outcomes in told
        for slide in _slides(chapter, outcomes)
    ]
    total = sum(slide.share for _, slide in slides)
    done, shown = 0.0, []
    for number, (chapter, slide) in enumerate(slides, start=1):
        minutes = (
            round(MINUTES * done / total),
            round(MINUTES * (done + slide.share) / total),
        )
        shown.append(_section(chapter, slide, number, minutes))
        done += slide.share
    style, script = (
        "".join((FOLDER / name).read_text(encoding="utf-8") for name in names)
        for names in (("page.css", "slides.css"), ("page.js", "slides.js"))
    )
    controls = (
        '<div class="bar" role="toolbar" aria-label="slides"><button type="button" data-go="-1" aria-label="back">'
        '\u2190</button><output></output><button type="button" data-go="1" aria-label="on">\u2192</button>'
        '<button type="button" data-notes aria-pressed="false">Notes (N)</button></div>'
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>Gaussian splatting in {MINUTES} minutes</title><style>{style}</style></head><body>"
        f'<main class="deck">{"".join(shown)}</main>{controls}<script>{script}</script></body></html>\n'
    )


def _slides(chapter: Chapter, outcomes: Sequence[Outcome]) -> list[Slide]:
    slides = [Slide(chapter.number, chapter.title, "title")]
    asking = False
    for i, outcome in enumerate(outcomes):
        cell = outcome.cell
        # an exercise and its answer end where the next section begins
        asking = asking and not cell.text.startswith("## ")
        if asking:
            continue
        if cell.kind == "prose":
            asking = not _tell(slides, expanded(cell.text))
            continue
        for j, each in enumerate(outcome.pictures):
            shown = layout.figure(chapter, cell, f"s{chapter.number}-{i}-{j}", each)
            slides.append(
                Slide(
                    chapter.number, slides[-1].heading, "picture", [], [each.caption], shown
                )
            )
    return _merged(
        [slide for slide in slides if slide.blocks or slide.kind in ("title", "picture")]
    )


def _merged(slides: list[Slide]) -> list[Slide]:
    """Let a little text stand above the picture that follows it, or be said beside the one before."""
    merged: list[Slide] = []
    for slide in slides:
        before = merged[-1] if merged else None
        if before is None or before.heading != slide.heading or before.kind == "title":
            merged.append(slide)
        elif before.light and slide.kind == "widget":
            # a widget needs the whole slide
            merged[-1] = slide
            slide.notes = before.notes + slide.notes
        elif before.light and slide.kind == "picture":
            merged[-1] = Slide(
                slide.chapter,
                slide.heading,
                slide.kind,
                before.blocks,
                before.notes + slide.notes,
                slide.figure,
            )
        elif slide.light and before.kind in ("picture", "widget"):
            before.notes += slide.notes
        else:
            merged.append(slide)
    return merged


def _tell(slides: list[Slide], text: str) -> bool:
    """Put a prose cell on slides; False where an exercise begins."""
    blocks = _blocks(text)
    for at, block in enumerate(blocks):
        heading = _HEADING.match(block)
        if heading is not None:
            if heading[1] == "###":
                return False
            if heading[1] == "##":
                slides.append(Slide(slides[-1].chapter, heading[2]))
            continue
        if _WIDGET.match(block):
            slides.append(Slide(slides[-1].chapter, slides[-1].heading, "widget", [block]))
            continue
        introduces = at + 1 < len(blocks) and not _HEADING.match(blocks[at + 1])
        _put(slides, block, _short(block, introduces))
    return True


def _put(slides: list[Slide], block: str, short: str) -> None:
    full = sum(_lines(each) for each in slides[-1].blocks) + _lines(short) > _FULL
    if slides[-1].kind in ("picture", "widget") or (full and slides[-1].blocks):
        slides.append(Slide(slides[-1].chapter, slides[-1].heading))
    if short:
        slides[-1].blocks.append(short)
    # code that is on the slide as it stands need not be read out
    if "```" not in short:
        slides[-1].notes.append(block)


def _blocks(text: str) -> list[str]:
    """Cut markdown at blank lines, except in code, and part headings from what stands right under them."""
    blocks: list[str] = []
    for piece in re.split(r"\n\s*\n", text):
        inside_code = bool(blocks) and blocks[-1].count("```") % 2 == 1
        names_its_file = (
            bool(blocks) and piece.startswith("```") and _FILE.match(blocks[-1])
        )
        if inside_code or names_its_file:
            blocks[-1] += f"\n\n{piece}"
            continue
        first, _, rest = piece.strip("\n").partition("\n")
        if _HEADING.match(first):
            blocks += [first, *([rest] if rest.strip() else [])]
        elif piece.strip():
            blocks.append(piece.strip("\n"))
    return blocks


def _short(block: str, introduces: bool) -> str:
    """Shorten a paragraph to its first sentence, and the one that leads on to what follows; keep all else.

    Of long code the name of its file is left.
    """
    if block.count("\n") > _LONGEST_CODE and "```" in block:
        return block.partition("```")[0].strip()
    if (
        _ITEM.match(block)
        or block.startswith(("$$", "|", "```", ">", "`pop_ref"))
        or "\n|" in block
    ):
        return block
    sentences = _sentences(block)
    if len(sentences) > 1 and len(sentences[0]) < _BRIEF:
        sentences[:2] = [" ".join(sentences[:2])]
    leads = introduces and len(sentences) > 1 and sentences[-1].rstrip().endswith(":")
    return " ".join([sentences[0], sentences[-1]] if leads else sentences[:1])


def _sentences(paragraph: str) -> list[str]:
    text = " ".join(paragraph.split())
    found, start = [], 0
    for end in _SENTENCE_ENDS.finditer(text):
        so_far = text[start : end.start() + 1]
        # neither inside a formula or code nor behind an abbreviation; a colon ends nothing before a formula
        if so_far.count("$") % 2 or so_far.count("`") % 2 or _NO_END.search(so_far):
            continue
        if so_far.endswith(":"):
            continue
        found.append(text[start : end.end()].strip())
        start = end.end()
    return [*found, text[start:].strip()] if text[start:].strip() else found


def _lines(block: str) -> float:
    if block.startswith("$$"):
        return 2.4
    if "```" in block:
        return 0.75 * block.count("\n")
    each = block.split("\n") if _ITEM.match(block) or "|" in block else [block]
    return 0.5 + sum(max(1.0, len(line) / _CHARACTERS_A_LINE) for line in each)


def _section(chapter: Chapter, slide: Slide, number: int, minutes: tuple[int, int]) -> str:
    when = f"<p><b>Minute {minutes[0]} to {max(minutes[1], minutes[0] + 1)}.</b></p>"
    notes = when + _rendered(chapter, "\n\n".join(slide.notes))
    if slide.kind == "title":
        head = (
            f'<p class="number">Chapter {slide.chapter}</p><h1>{escape(slide.heading)}</h1>'
        )
    else:
        head = re.sub(
            "^<p>(.*)</p>$", r"<h2>\1</h2>", _rendered(chapter, slide.heading).strip()
        )
    blocks = [_rendered(chapter, block) for block in slide.blocks] + [slide.figure]
    return (
        f'<section class="slide {slide.kind}" id="slide-{number}" aria-label="slide {number}">'
        f'<div class="face">{head}<div class="body">{"".join(blocks)}</div></div><aside>{notes}</aside></section>'
    )


def _rendered(chapter: Chapter, text: str) -> str:
    # what leads to the pages would lead nowhere: they need not be here
    return re.sub(
        r'<a [^>]*?href="(?:chapter_|glossary)[^>]*>(.*?)</a>',
        r"\1",
        layout.rendered(chapter, text),
    )
