"""Lay chapters out as pages: HTML that needs no network, with formulas as MathML and pictures inside."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final
from xml.etree import ElementTree

from latex2mathml.converter import convert
from markdown_it import MarkdownIt
from mdit_py_plugins.dollarmath import dollarmath_plugin
from pygments import highlight
from pygments.formatters.html import HtmlFormatter
from pygments.lexers.python import PythonLexer

from pop_ref.walkthrough import widgets
from pop_ref.walkthrough.cells import FOLDER, Cell, Chapter, ChapterError
from pop_ref.walkthrough.directives import expanded
from pop_ref.walkthrough.docstrings import PAGE
from pop_ref.walkthrough.folding import names_in, parts, said_and_done
from pop_ref.walkthrough.glossary import GLOSSARY_PAGE, glossary
from pop_ref.walkthrough.pages import Outcome, Picture
from pop_ref.walkthrough.style import VARIABLES

TITLE: Final = "Splats with polarized opacity, step by step"
LEAD: Final = (
    "3D Gaussian Splatting and the Polarized Opacity Prior, for a reader who knows linear algebra and Python and has "
    "never heard of splats. Every chapter is a script on the oracle's own functions: what it claims is checked as it "
    "runs, and each of its exercises has an answer that runs."
)

BY_DOING: Final = (
    "To learn by doing, <code>pop learn start mine</code> writes thirteen files to fill in and judges them; the "
    "whole method in 300 lines of NumPy is <code>pop_ref/learn/splat.py</code>, and <code>python -m "
    "pop_ref.learn.splat</code> trains a small scene with it in a minute."
)
_NAMES: Final = (
    "argmax",
    "argmin",
    "cos",
    "det",
    "diag",
    "exp",
    "ln",
    "log",
    "max",
    "min",
    "sign",
    "sin",
)
_MATHML: Final = "{http://www.w3.org/1998/Math/MathML}"
ElementTree.register_namespace("", _MATHML[1:-1])


# a comma behind a formula stays on its line
_PUNCTUATED: Final = re.compile(
    r'<span class="math inline">((?:(?!</math>).)*</math>)</span>([,.;:)?]+)', re.DOTALL
)
# labels of decisions and kinks in prose; what code quotes is left alone
_LABEL: Final = re.compile(r"(<(pre|code|a|math|h\d)\b.*?</\2>)|\b([DB][1-8])\b", re.DOTALL)
# a printed function that the course asks the reader to write
_YOURS: Final = re.compile(
    r"<p>(<code>[\w/.]+</code>), yours to write first in <code>(pop learn check \w+)</code>:</p>\s*(<pre>.*?</pre>)",
    re.DOTALL,
)
_WIDGET: Final = re.compile(r"<p>\{\{widget: (\w+)\}\}</p>")


class _FormulaError(Exception):
    pass


def chapter_page(
    chapter: Chapter, outcomes: Sequence[Outcome], chapters: Sequence[Chapter]
) -> str:
    """Lay out one chapter.

    Args:
        chapter: the chapter.
        outcomes: what its cells did.
        chapters: all chapters, for the links to the one before and the one after.

    Raises:
        ChapterError: a formula cannot be set; the message names the chapter's file and line.
    """
    tiers = iter(chapter.tiers)
    body = []
    for i, outcome in enumerate(outcomes):
        tier = next(tiers) if outcome.cell.kind == "answer" else ""
        body.append(_cell(chapter, f"p{i}", outcome, tier))
    at = [each.number for each in chapters].index(chapter.number)
    before = chapters[at - 1] if at > 0 else None
    after = chapters[at + 1] if at + 1 < len(chapters) else None
    turn = _turn(before, "← ", "") + _turn(after, "", " →")
    file = f"pop_ref/walkthrough/{chapter.path.name}"
    return _document(
        f"{chapter.number}. {chapter.title}",
        f'<nav><a href="index.html">{TITLE}</a><span>{chapter.minutes} minutes · '
        f'<a href="{GLOSSARY_PAGE}">glossary</a></span></nav>'
        f'<article>{"".join(body)}</article><nav class="turn">{turn}</nav>'
        f"<footer>This page is <code>{file}</code>, run and laid out. Change it and run it: "
        f"<code>python -m {chapter.module}</code></footer>",
    )


def index_page(chapters: Sequence[Chapter], beside: Mapping[str, str] | None = None) -> str:
    """Lay out the contents: every chapter's title, minutes and opening paragraph.

    Args:
        chapters: in order.
        beside: other forms of the chapters, name to place relative to the page.
    """
    items = [
        f'<li><h2><a href="{chapter.page}">{chapter.number}. {_inline(chapter, chapter.title)}</a> '
        f"<small>{chapter.minutes} min</small></h2>"
        f"<p>{_inline(chapter, chapter.opening)}</p></li>"
        for chapter in chapters
    ]
    hours = sum(chapter.minutes for chapter in chapters) / 60.0
    about = f'{LEAD} All of it takes about {hours:.0f} hours. {BY_DOING} <a href="{GLOSSARY_PAGE}">Glossary</a>'
    for name, place in (beside or {}).items():
        about += (
            f' · <a href="{place}{"/index.html" if name == "notebooks" else ""}">{name}</a>'
        )
    return _document(
        TITLE, f'<h1>{TITLE}</h1><p>{about}</p><ol class="contents">{"".join(items)}</ol>'
    )


def glossary_page() -> str:
    """Lay out the glossary, to which labels such as D5 in every chapter lead."""
    # where the chapters' labels lead
    body = re.sub(
        r"<td>([DB]\d)</td>", r'<td id="\1">\1</td>', _MARKDOWN.render(glossary())
    )
    return _document(
        "Glossary",
        f'<nav><a href="index.html">{TITLE}</a></nav><h1>Glossary</h1><article>{body}</article>',
    )


def _document(title: str, body: str) -> str:
    style, script = (
        (FOLDER / f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js")
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body><main>{body}</main>"
        f"<script>{script}</script></body></html>\n"
    )


def _turn(chapter: Chapter | None, left: str, right: str) -> str:
    if chapter is None:
        return '<a href="index.html">Contents</a>'
    return f'<a href="{chapter.page}">{left}{chapter.number}. {escape(chapter.title)}{right}</a>'


def _cell(chapter: Chapter, name: str, outcome: Outcome, tier: str) -> str:
    cell = outcome.cell
    if cell.kind == "prose":
        return _prose(chapter, cell)
    said, code = said_and_done(cell.text) if cell.kind == "answer" else ("", cell.text)
    shown = [_prose(chapter, Cell("prose", said, cell.line))] if said else []
    by_role: dict[str, list[str]] = {"plain": [], "imports": [], "checks": [], "draws": []}
    for part in parts(code, names_in(chapter.code_after(cell))):
        by_role[part.role].append(part.text)
    plain, imports, checks, drawing = ("\n\n".join(by_role[role]) for role in by_role)
    if imports:
        shown.append(_aside("Imports", imports))
    if plain:
        shown.append(
            _aside("What this example is made of", plain)
            if cell.kind == "setup"
            else _code(plain)
        )
    if outcome.printed.strip():
        shown.append(_printed(outcome.printed.rstrip()))
    for i, each in enumerate(outcome.pictures):
        shown.append(_figure(chapter, cell, f"{name}-{i}", each))
    # how a picture is drawn, and what is checked, are footnotes
    if drawing:
        shown.append(_aside("The code that draws", drawing))
    if checks:
        shown.append(_aside("What was checked as this page was made", checks))
    whole = "".join(shown)
    return _asked(name, tier, whole) if cell.kind == "answer" else whole


def _asked(name: str, tier: str, answer: str) -> str:
    """Fold an answer; where a guess is asked for, put a box for it before, which a script shows and reads."""
    if tier not in ("predict", "find the bug"):
        return _folded("Answer", answer)
    asks = "Your prediction" if tier == "predict" else "Which line, and why?"
    box = (
        f'<p class="guess" hidden><label for="{name}-guess">{asks}</label> '
        f'<input id="{name}-guess" autocomplete="off"><span role="status"></span></p>'
    )
    return f'<div class="asked">{box}{_folded("Answer", answer)}</div>'


def _printed(text: str) -> str:
    # a table of long lines scrolls, since it cannot be read when its lines are broken
    long = max(map(len, text.split("\n"))) > PAGE
    return f'<pre class="printed{" long" if long else ""}">{escape(text)}</pre>'


def _aside(title: str, code: str) -> str:
    return _folded(title, _code(code), ' class="drawing"')


def _folded_source(found: re.Match[str]) -> str:
    """Fold a function that a reader may write first; a script opens it at the second click."""
    told = f'<span role="status" data-first="Yours to write: {found[2]}. Click again to see it."></span>'
    return _folded(f"The oracle's, {found[1]} {told}", found[3], ' class="yours"')


def _folded(title: str, body: str, attributes: str = "") -> str:
    return f"<details{attributes}><summary>{title}</summary>{body}</details>"


def _code(text: str) -> str:
    return f"<pre><code>{_colored(text, 'python', '')}</code></pre>"


def _colored(text: str, language: str, _: str) -> str:
    return (
        highlight(text, PythonLexer(), HtmlFormatter(nowrap=True))
        if language == "python"
        else escape(text)
    )


def _figure(chapter: Chapter, cell: Cell, name: str, picture: Picture) -> str:
    caption = _inline(chapter, picture.caption, cell.line)
    if picture.frames:
        return _film(name, picture, caption)
    if picture.svg is None:
        data = base64.b64encode(picture.png or b"").decode("ascii")
        size = f'width="{picture.width * 100:.0f}"'
        shown = f'<img src="data:image/png;base64,{data}" {size} alt="{escape(picture.caption)}">'
    else:
        shown = _inline_svg(picture.svg, name, picture.caption)
    # on a phone a picture is at least so wide that its letters can be read
    least = f'style="--least:{picture.width * 80:.0f}px"'
    return f'<figure><div class="wide" {least}>{shown}</div><figcaption>{caption}</figcaption></figure>'


def _inline_svg(svg: str, name: str, caption: str) -> str:
    svg = svg[svg.index("<svg") :]
    # two pictures of a page may use one id for different things
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, variable)
    return svg.replace("<svg", f'<svg role="img" aria-label="{escape(caption)}"', 1)


def _formula(latex: str, options: dict[str, Any]) -> str:
    mathml = convert(
        latex.strip(), display="block" if options["display_mode"] else "inline"
    )
    unknown = re.search(r">(\\[a-zA-Z]+)", mathml)
    if unknown:
        raise _FormulaError(f"{latex.strip()}\n    {unknown[1]} is not known")
    return _spaced(mathml)


def _spaced(mathml: str) -> str:
    """Set thin spaces around the names of functions as TeX does: none beside an operator or a parenthesis."""
    math = ElementTree.fromstring(mathml)
    for row in math.iter(f"{_MATHML}mrow"):
        children = list(row)
        row[:] = []
        for i, child in enumerate(children):
            named = child if child.text else next(iter(child), child)
            if named.text in _NAMES:
                # an mo would be spaced as a relation is
                named.tag, named.attrib = f"{_MATHML}mi", {}
                apart = [
                    _takes_room(children[i - 1 : i]),
                    _takes_room(children[i + 1 : i + 2]),
                ]
                row.extend([_thin()] * apart[0] + [child] + [_thin()] * apart[1])
            else:
                row.append(child)
    return ElementTree.tostring(math, encoding="unicode")


def _thin() -> ElementTree.Element:
    return ElementTree.Element(f"{_MATHML}mspace", width="0.167em")


def _takes_room(neighbour: list[ElementTree.Element]) -> bool:
    return bool(neighbour) and neighbour[0].tag not in (f"{_MATHML}mo", f"{_MATHML}mspace")


def _link(self: Any, tokens: Any, at: int, options: Any, env: Any) -> str:
    target = tokens[at].attrs.get("href", "")
    # chapters name each other by file; their pages lie beside each other
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


def _prose(chapter: Chapter, cell: Cell) -> str:
    try:
        text = expanded(cell.text, marked=True)
    except ValueError as error:
        raise ChapterError(chapter.path, cell.line, str(error)) from error
    try:
        rendered = _LABEL.sub(_label, _MARKDOWN.render(text))
        rendered = _PUNCTUATED.sub(r'<span class="math inline stays">\1\2</span>', rendered)
        rendered = _YOURS.sub(_folded_source, rendered)
        return _WIDGET.sub(lambda found: widgets.html(found[1]), rendered)
    except Exception as error:
        raise ChapterError(
            chapter.path, _line_of(cell, error), f"a formula cannot be set: {error}"
        ) from error


def _label(found: re.Match[str]) -> str:
    return found[1] or f'<a class="label" href="{GLOSSARY_PAGE}#{found[3]}">{found[3]}</a>'


def _film(name: str, picture: Picture, caption: str) -> str:
    """Lay frames out as a strip; a script turns the strip into one frame with a slider."""
    frames = "".join(
        f'<li><img src="data:image/png;base64,{base64.b64encode(png).decode("ascii")}" alt="{escape(label)}">'
        f"<span>{escape(label)}</span></li>"
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


def _line_of(cell: Cell, error: Exception) -> int:
    formula = str(error).partition("\n")[0]
    at = cell.text.find(formula) if isinstance(error, _FormulaError) else -1
    return cell.line + cell.text.count("\n", 0, max(at, 0))


def _inline(chapter: Chapter, text: str, line: int = 1) -> str:
    try:
        return _MARKDOWN.renderInline(text)
    except Exception as error:
        raise ChapterError(
            chapter.path, line, f"a formula cannot be set in {text!r}: {error}"
        ) from error


def rendered(chapter: Chapter, text: str) -> str:
    """Set markdown of a chapter as its page does.

    Raises:
        ChapterError: a formula cannot be set.
    """
    return _prose(chapter, Cell("prose", text, 1))


def figure(chapter: Chapter, cell: Cell, name: str, picture: Picture) -> str:
    """Set a picture of a chapter as its page does; `name` is what its ids begin with."""
    return _figure(chapter, cell, name, picture)
