"""Lay chapters out: HTML pages that need no network, formulas as MathML and pictures inside; and a book to print."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from html import escape, unescape
from pathlib import Path
from typing import Any, Final

from latex2mathml.converter import convert
from markdown_it import MarkdownIt
from mdit_py_plugins.dollarmath import dollarmath_plugin
from pygments import highlight
from pygments.formatters.html import HtmlFormatter
from pygments.lexers.python import PythonLexer

from pop_ref.walkthrough import widgets
from pop_ref.walkthrough.builder.chapter import (
    PAGE,
    Cell,
    Chapter,
    ChapterError,
    expanded,
    names_in,
    parts,
    said_and_done,
)
from pop_ref.walkthrough.builder.glossary import GLOSSARY_PAGE, glossary
from pop_ref.walkthrough.pages import Outcome, Picture
from pop_ref.walkthrough.style import VARIABLES

TITLE: Final = "Splats with polarized opacity, step by step"
LEAD: Final = (
    "3D Gaussian Splatting and the Polarized Opacity Prior, for a reader who knows linear algebra and Python and has "
    "never heard of splats. Every chapter is a script on the oracle's own functions: what it claims is checked as it "
    "runs, and each of its exercises has an answer that runs."
)
BY_DOING: Final = (
    "To learn by doing, <code>pop learn start mine</code> writes thirteen files to fill in and judges them; the whole "
    "method in 300 lines of NumPy is <code>pop_ref/learn/splat.py</code>, and "
    "<code>python -m pop_ref.learn.splat</code> trains a small scene with it in a minute. After <code>make</code>, "
    "<code>pop</code> and <code>python</code> are in <code>.venv/bin</code>; "
    "<code>source .venv/bin/activate</code> puts them on the path."
)
_FUNCTIONS: Final = "argmax|argmin|cos|det|diag|exp|ln|log|max|min|sign|sin"
# a function's name, with its index if it has one, and whether something that is no operator stands on either side
_FUNCTION: Final = re.compile(
    rf"(</m(?!o|space)\w+>)?((?:<(msub|munder|msup)>)?)<m[io]>({_FUNCTIONS})</m[io]>((?(3).*?</\3>))(?=(<m(?!o|space)\w)?)"
)
_THIN: Final = '<mspace width="0.167em" />'
# a sign behind an operator or an opening parenthesis has one operand; MathML would set it as one between two
_SIGN: Final = re.compile(r"(<mo\b[^>]*>[^)\]}|]</mo>(?:<mspace[^>]*/>)?)<mo>([−+±])</mo>")
_BAR: Final = re.compile(r'<mo(?: stretchy="false")?>\|</mo>')
# a comma behind a formula stays on its line
_PUNCTUATED: Final = re.compile(r'<span class="math inline">((?:(?!</math>).)*</math>)</span>([,.;:)?]+)', re.DOTALL)
# labels of decisions and kinks in prose; what code quotes is left alone
_LABEL: Final = re.compile(r"(<(pre|code|a|math|h\d)\b.*?</\2>)|\b([DB][1-8])\b", re.DOTALL)
# a printed function that the course asks the reader to write
_YOURS: Final = re.compile(
    r"<p>(<code>[\w/., ]+</code>), yours to write first in <code>pop learn check (\w+)</code>:</p>\s*(<pre\b.*?</pre>)",
    re.DOTALL,
)
# the same once it is folded
_SOURCE: Final = re.compile(
    r"<details class=\"yours\"[^>]*><summary>The oracle's (<code>\w+</code>), (<code>.*?</code>).*?</summary>"
    r"(<pre\b.*?</pre>)</details>",
    re.DOTALL,
)
_TAG: Final = re.compile(r"<[^>]*>")
# as many characters of code have room in the narrowest box of a page or a book; so few lines stay on one page of a book
_LONG, _SHORT = 80, 12
_WIDGET: Final = re.compile(r"<p>\{\{widget: (\w+)\}\}</p>")
# the paper of a book
_SHEET: Final = (
    "@page { size: A4; margin: 18mm 17mm 20mm; "
    "@bottom-center { content: counter(page); font: 9pt system-ui, sans-serif; color: #777; } }\n"
)
# two pictures of a page, or two chapters of a book, may use one id for different things
_ID: Final = re.compile(r'(\bid="|\bfor="|href="#|url\(#)')


class _FormulaError(Exception):
    pass


def asset(name: str) -> str:
    """Read a style sheet or a script that lies next to this file."""
    return (Path(__file__).resolve().parent / name).read_text(encoding="utf-8")


def document(title: str, body: str, style: str, script: str = "", attributes: str = "") -> str:
    """Write a whole HTML file."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body{attributes}>{body}"
        f"{f'<script>{script}</script>' if script else ''}</body></html>\n"
    )


def chapter_page(
    chapter: Chapter, outcomes: Sequence[Outcome], chapters: Sequence[Chapter], notebook: str | None = None
) -> str:
    """Lay out one chapter.

    Args:
        chapter: the chapter.
        outcomes: what its cells did.
        chapters: all chapters, for the links to the one before and the one after.
        notebook: where its notebook lies relative to the page, None where there is none.

    Raises:
        ChapterError: a formula cannot be set; the message names the chapter's file and line.
    """
    tiers = iter(chapter.tiers)
    body = [
        _asked(f"p{i}", next(tiers), _cell(chapter, f"p{i}", outcome))
        if outcome.cell.kind == "answer"
        else _cell(chapter, f"p{i}", outcome)
        for i, outcome in enumerate(outcomes)
    ]
    at = [each.number for each in chapters].index(chapter.number)
    turn = _turn(chapters[at - 1] if at > 0 else None, "← ", "")
    turn += _turn(chapters[at + 1] if at + 1 < len(chapters) else None, "", " →")
    links = f'<a href="{notebook}" download>notebook</a> · ' if notebook else ""
    return _page(
        f"{chapter.number}. {chapter.title}",
        f'<nav><a href="index.html">{TITLE}</a><span>{chapter.minutes} minutes · {links}'
        f'<a href="{GLOSSARY_PAGE}">glossary</a></span></nav>'
        f'<article>{"".join(body)}</article><nav class="turn">{turn}</nav>'
        f"<footer>This page is <code>pop_ref/walkthrough/{chapter.path.name}</code>, run and laid out. Change it and "
        f"run it: <code>python -m {chapter.module}</code></footer>",
    )


def index_page(chapters: Sequence[Chapter], beside: Mapping[str, str] | None = None) -> str:
    """Lay out the contents: every chapter's title, minutes and opening paragraph.

    Args:
        chapters: in order.
        beside: other forms of the chapters, name to place relative to the page.
    """
    items = [
        f'<li><h2><a href="{chapter.page}">{chapter.number}. {_inline(chapter, chapter.title)}</a> '
        f"<small>{chapter.minutes} min</small></h2><p>{_inline(chapter, chapter.opening)}</p></li>"
        for chapter in chapters
    ]
    hours = sum(chapter.minutes for chapter in chapters) / 60.0
    links = {"Glossary": GLOSSARY_PAGE, **(beside or {})}
    about = f"{LEAD} All of it takes about {hours:.0f} hours. {BY_DOING} "
    about += " · ".join(f'<a href="{place}">{name}</a>' for name, place in links.items())
    return _page(TITLE, f'<h1>{TITLE}</h1><p>{about}</p><ol class="contents">{"".join(items)}</ol>')


def glossary_page() -> str:
    """Lay out the glossary, to which labels such as D5 in every chapter lead."""
    body = re.sub(r"<td>([DB]\d)</td>", r'<td id="\1">\1</td>', _MARKDOWN.render(glossary()))
    nav = f'<nav><a href="index.html">{TITLE}</a></nav>'
    return _page("Glossary", f"{nav}<h1>Glossary</h1><article>{body}</article>")


def notebook_index(chapters: Sequence[Chapter], names: Sequence[str]) -> str:
    """List the notebooks, for where a folder does not list itself, and say how to open one."""
    items = "".join(
        f'<li><a href="{name}" download>{each.number}. {escape(each.title)}</a></li>'
        for each, name in zip(chapters, names, strict=True)
    )
    return _page(
        "Notebooks",
        '<nav><a href="../index.html">Contents</a></nav><h1>Notebooks</h1><p>Every chapter as a Jupyter notebook. In a '
        "clone, <code>.venv/bin/pip install jupyterlab</code> once, then <code>.venv/bin/jupyter lab "
        "out/walkthrough/notebooks</code>. Where the package is installed from a wheel, <code>python -m "
        "pop_ref.walkthrough --notebooks notebooks</code> writes them. The first cell finds the package and names what "
        f"is missing.</p><ul>{items}</ul>",
    )


def book(told: Sequence[tuple[Chapter, Sequence[Outcome]]]) -> str:
    """Lay out chapters one after the other for the printer, with a contents at the front and the answers at the back.

    A function that the course asks the reader to write is an answer, too.

    Args:
        told: chapters in order, with what their cells did.

    Returns:
        One HTML file; widgets stand in it as they are before they are touched.

    Raises:
        ChapterError: a formula cannot be set.
    """
    lines, articles, answers = "", "", ""
    for chapter, outcomes in told:
        name, body, asked = chapter.path.stem, "", 0
        title = f"{chapter.number}. {escape(chapter.title)}"
        lines += f'<li><a href="#{name}">{title}</a></li>'
        answers += f"<h2>{title}</h2>"
        for i, outcome in enumerate(outcomes):
            # cells are numbered anew in every chapter
            shown = re.sub(rf"{_ID.pattern}(?=p\d)", rf"\g<1>{name}-", _cell(chapter, f"p{i}", outcome))
            shown = re.sub(r'href="(chapter_\w+)\.html"', r'href="#\1"', shown)
            # a label leads to the glossary of the pages, which is not here
            shown = re.sub(r'<a class="label"[^>]*>(.*?)</a>', r"\1", shown)
            if outcome.cell.kind == "answer":
                asked += 1
                answer = f"{name}-answer-{asked}"
                body += f'<p class="answered"><a href="#{answer}">The answer is at the back.</a></p>'
                answers += f'<h3 id="{answer}">Exercise {asked}</h3>{shown}'
            else:
                left, sources = _without_sources(shown, f"{name}-source-{i}")
                body, answers = body + left, answers + sources
        articles += f'<article id="{name}">{body}</article>'
    lines += '<li><a href="#answers">Answers</a></li>'
    body = (
        f'<main><header><h1>{TITLE}</h1><p>{escape(LEAD)}</p><ol class="lines">{lines}</ol></header>{articles}'
        f'<article id="answers"><h1>Answers</h1>{answers}</article></main>'
    )
    return document(TITLE, body, asset("page.css") + _SHEET, attributes=' class="book"')


def figure(chapter: Chapter, cell: Cell, name: str, picture: Picture) -> str:
    """Set a picture; `name` is what its ids begin with."""
    caption = _inline(chapter, picture.caption, cell.line)
    if picture.frames:
        return _film(name, picture, caption)
    if picture.svg is None:
        shown = (
            f'<img src="{_data(picture.png or b"")}" width="{picture.width * 100:.0f}" alt="{escape(picture.caption)}">'
        )
    else:
        shown = _ID.sub(rf"\g<1>{name}-", picture.svg[picture.svg.index("<svg") :])
        for colour, variable in VARIABLES.items():
            shown = shown.replace(colour, variable)
        shown = shown.replace("<svg", f'<svg role="img" aria-label="{escape(picture.caption)}"', 1)
    # on a phone a picture is at least so wide that its letters can be read
    least = f'style="--least:{picture.width * 80:.0f}px"'
    return f'<figure><div class="wide" {least}>{shown}</div><figcaption>{caption}</figcaption></figure>'


def prose(chapter: Chapter, text: str, line: int = 1) -> str:
    """Set markdown of a chapter; directives are expanded and widgets put in.

    Raises:
        ChapterError: a directive is not known, or a formula cannot be set.
    """
    try:
        told = expanded(text, marked=True)
    except ValueError as error:
        raise ChapterError(chapter.path, line, str(error)) from error
    try:
        rendered = _LABEL.sub(_label, _MARKDOWN.render(told))
        rendered = _PUNCTUATED.sub(r'<span class="math inline stays">\1\2</span>', rendered)
        rendered = _YOURS.sub(_folded_source, rendered)
        return _WIDGET.sub(lambda found: widgets.html(found[1]), rendered)
    except Exception as error:
        at = text.find(str(error).partition("\n")[0]) if isinstance(error, _FormulaError) else -1
        where = line + text.count("\n", 0, max(at, 0))
        raise ChapterError(chapter.path, where, f"a formula cannot be set: {error}") from error


def _page(title: str, body: str) -> str:
    return document(title, f"<main>{body}</main>", asset("page.css"), asset("page.js"))


def _turn(chapter: Chapter | None, left: str, right: str) -> str:
    if chapter is None:
        return '<a href="index.html">Contents</a>'
    return f'<a href="{chapter.page}">{left}{chapter.number}. {escape(chapter.title)}{right}</a>'


def _cell(chapter: Chapter, name: str, outcome: Outcome) -> str:
    cell = outcome.cell
    if cell.kind == "prose":
        return prose(chapter, cell.text, cell.line)
    said, code = said_and_done(cell.text) if cell.kind == "answer" else ("", cell.text)
    shown = [prose(chapter, said, cell.line)] if said else []
    by_role: dict[str, list[str]] = {"plain": [], "imports": [], "checks": [], "draws": []}
    for part in parts(code, names_in(chapter.code_after(cell))):
        by_role[part.role].append(part.text)
    plain, imports, checks, drawing = ("\n\n".join(by_role[role]) for role in by_role)
    if imports:
        shown.append(_aside("Imports", imports))
    if plain:
        shown.append(_aside("What this example is made of", plain) if cell.kind == "setup" else _code(plain))
    if outcome.printed.strip():
        # a table of long lines scrolls, since it cannot be read when its lines are broken
        long = max(map(len, outcome.printed.split("\n"))) > PAGE
        shown.append(f'<pre class="printed{" long" if long else ""}">{escape(outcome.printed.rstrip())}</pre>')
    shown += [figure(chapter, cell, f"{name}-{i}", each) for i, each in enumerate(outcome.pictures)]
    # how a picture is drawn, and what is checked, are footnotes
    if drawing:
        shown.append(_aside("The code that draws", drawing))
    if checks:
        shown.append(_aside("What was checked as this page was made", checks))
    return "".join(shown)


def _asked(name: str, tier: str, answer: str) -> str:
    """Fold an answer; where a guess is asked for, put a box for it before, which a script shows and reads."""
    folded = f"<details><summary>Answer</summary>{answer}</details>"
    if tier not in ("predict", "find the bug"):
        return folded
    asks = "Your prediction" if tier == "predict" else "Which line, and why?"
    box = (
        f'<p class="guess" hidden><label for="{name}-guess">{asks}</label> '
        f'<input id="{name}-guess" autocomplete="off"><span role="status"></span></p>'
    )
    return f'<div class="asked">{box}{folded}</div>'


def _aside(title: str, code: str) -> str:
    return f'<details class="drawing"><summary>{title}</summary>{_code(code)}</details>'


def _folded_source(found: re.Match[str]) -> str:
    """Fold a function that a reader may write first; a script opens it once its stage is passed."""
    first = f"Yours to write: pop learn check {found[2]}. Click again to see it."
    told = f'<span role="status" data-first="{first}"></span>'
    summary = f"<summary>The oracle's {_called(found[3])}, {found[1]} {told}</summary>"
    return f'<details class="yours" data-stage="{found[2]}">{summary}{found[3]}</details>'


def _called(code: str) -> str:
    """Name the function that some highlighted code defines."""
    return f"<code>{_TAG.sub('', code.partition('>def</span>')[2].partition('(')[0]).strip()}</code>"


def _without_sources(shown: str, name: str) -> tuple[str, str]:
    """Take the functions that a reader may write out of a cell; what has a mistake to be found stays."""
    taken: list[str] = []

    def to_the_back(found: re.Match[str]) -> str:
        called, file, code = found.groups()
        if "with one mistake" in file:
            return found[0]
        place = f"{name}-{len(taken)}"
        taken.append(f'<h3 id="{place}">The oracle\'s {called}, {file}</h3>{code}')
        return f'<p class="answered"><a href="#{place}">The oracle\'s {called} is at the back.</a></p>'

    return _SOURCE.sub(to_the_back, shown), "".join(taken)


def _code(text: str) -> str:
    lines = highlight(text, PythonLexer(), HtmlFormatter(nowrap=True)).splitlines(keepends=True)
    short = ' class="short"' if len(lines) <= _SHORT else ""
    return f"<pre{short}><code>{''.join(map(_hanging, lines))}</code></pre>"


def _colored(text: str, language: str, _: str) -> str:
    return _code(text) if language == "python" else escape(text)


def _hanging(line: str) -> str:
    """Let what is broken off a long line of code begin to the right of where the line begins."""
    plain = unescape(_TAG.sub("", line))
    if len(plain) <= _LONG:
        return line
    return f'<span class="hangs" style="--at:{len(plain) - len(plain.lstrip()) + 4}ch">{line}</span>'


def _data(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _film(name: str, picture: Picture, caption: str) -> str:
    """Lay frames out as a strip; a script turns the strip into one frame with a slider."""
    frames = "".join(
        f'<li><img src="{_data(png)}" alt="{escape(label)}"><span>{escape(label)}</span></li>'
        for png, label in picture.frames
    )
    controls = (
        f'<p hidden><button type="button">Play</button> <input type="range" min="0" '
        f'max="{len(picture.frames) - 1}" value="0" aria-label="frame" id="{name}-frame"> <output></output></p>'
    )
    return (
        f'<figure class="film" style="--wide:{picture.width * 100:.0f}px"><ol>{frames}</ol>{controls}'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _formula(latex: str, options: dict[str, Any]) -> str:
    mathml = convert(latex.strip(), display="block" if options["display_mode"] else "inline")
    unknown = re.search(r">(\\[a-zA-Z]+)", mathml)
    if unknown:
        raise _FormulaError(f"{latex.strip()}\n    {unknown[1]} is not known")
    # characters rather than references, but for those that mean something to HTML
    plain = re.sub(r"&#x(?!0003[CE]|00026)(\w+);", lambda found: chr(int(found[1], 16)), mathml)
    # no operator, which would have spaces around it
    plain = re.sub(r"<mo>([⊤∂∇])</mo>", r"<mi>\1</mi>", _SIGN.sub(r'\1<mo form="prefix">\2</mo>', plain))
    n_pairs, odd = divmod(len(_BAR.findall(plain)), 2)
    if not odd:
        # the bars of a norm open and close
        forms = iter(("prefix", "postfix") * n_pairs)
        plain = _BAR.sub(lambda _: f'<mo stretchy="false" form="{next(forms)}">|</mo>', plain)
    return _FUNCTION.sub(_spaced, plain)


def _spaced(found: re.Match[str]) -> str:
    """Set thin spaces around a function's name as TeX does: none next to an operator or a parenthesis."""
    before, opened, name, rest = found[1] or "", found[2], found[4], found[5]
    # an mo would be spaced as a relation is
    return f"{before}{_THIN if before else ''}{opened}<mi>{name}</mi>{rest}{_THIN if found[6] else ''}"


def _label(found: re.Match[str]) -> str:
    return found[1] or f'<a class="label" href="{GLOSSARY_PAGE}#{found[3]}">{found[3]}</a>'


def _link(self: Any, tokens: Any, at: int, options: Any, env: Any) -> str:
    # chapters name each other by file; their pages lie in one folder
    target = tokens[at].attrs.get("href", "")
    tokens[at].attrs["href"] = re.sub(r"^(chapter_\w+)\.py$", r"\1.html", target)
    return self.renderToken(tokens, at, options, env)


_MARKDOWN: Final = (
    MarkdownIt("commonmark", {"html": False, "highlight": _colored})
    .enable("table")
    .use(dollarmath_plugin, renderer=_formula)
)
_MARKDOWN.add_render_rule("link_open", _link)
_MARKDOWN.add_render_rule("table_open", lambda *_: '<div class="wide"><table>')
_MARKDOWN.add_render_rule("table_close", lambda *_: "</table></div>")


def _inline(chapter: Chapter, text: str, line: int = 1) -> str:
    try:
        return _MARKDOWN.renderInline(text)
    except Exception as error:
        raise ChapterError(chapter.path, line, f"a formula cannot be set in {text!r}: {error}") from error
