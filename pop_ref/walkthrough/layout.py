"""Lay chapters out as pages: HTML that needs no network, with formulas as MathML and pictures inside."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from html import escape
from typing import Any, Final
from xml.etree import ElementTree

from latex2mathml.converter import convert
from markdown_it import MarkdownIt
from mdit_py_plugins.dollarmath import dollarmath_plugin
from pygments import highlight
from pygments.formatters.html import HtmlFormatter
from pygments.lexers.python import PythonLexer

from pop_ref.walkthrough.cells import FOLDER, Cell, Chapter, ChapterError
from pop_ref.walkthrough.folding import parts, said_and_done
from pop_ref.walkthrough.pages import Outcome, Picture
from pop_ref.walkthrough.style import VARIABLES

_TITLE: Final = "Splats with polarized opacity, step by step"
_LEAD: Final = (
    "Twelve chapters on 3D Gaussian Splatting and the Polarized Opacity Prior, for a reader who knows linear algebra "
    "and Python. Every chapter is a script on the oracle's own functions: what it claims, it asserts, and each of its "
    "exercises has an answer that runs."
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
    body = [_cell(chapter, f"p{i}", outcome) for i, outcome in enumerate(outcomes)]
    at = [each.number for each in chapters].index(chapter.number)
    before = chapters[at - 1] if at > 0 else None
    after = chapters[at + 1] if at + 1 < len(chapters) else None
    turn = _turn(before, "← ", "") + _turn(after, "", " →")
    file = f"pop_ref/walkthrough/{chapter.path.name}"
    return _document(
        f"{chapter.number}. {chapter.title}",
        f'<nav><a href="index.html">{_TITLE}</a><span>{chapter.number} of {len(chapters)}</span></nav>'
        f'<article>{"".join(body)}</article><nav class="turn">{turn}</nav>'
        f"<footer>This page is <code>{file}</code>, run and laid out. Change it and run it: "
        f"<code>python -m {chapter.module}</code></footer>",
    )


def index_page(chapters: Sequence[Chapter]) -> str:
    """Lay out the contents: every chapter's title and opening paragraph."""
    items = [
        f'<li><h2><a href="{chapter.page}">{chapter.number}. {_inline(chapter, chapter.title)}</a></h2>'
        f"<p>{_inline(chapter, chapter.opening)}</p></li>"
        for chapter in chapters
    ]
    return _document(
        _TITLE, f'<h1>{_TITLE}</h1><p>{_LEAD}</p><ol class="contents">{"".join(items)}</ol>'
    )


def _document(title: str, body: str) -> str:
    style = (FOLDER / "page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body><main>{body}</main></body></html>\n"
    )


def _turn(chapter: Chapter | None, left: str, right: str) -> str:
    if chapter is None:
        return '<a href="index.html">Contents</a>'
    return f'<a href="{chapter.page}">{left}{chapter.number}. {escape(chapter.title)}{right}</a>'


def _cell(chapter: Chapter, name: str, outcome: Outcome) -> str:
    cell = outcome.cell
    if cell.kind == "prose":
        return _prose(chapter, cell)
    said, code = said_and_done(cell.text) if cell.kind == "answer" else ("", cell.text)
    shown = [_prose(chapter, Cell("prose", said, cell.line))] if said else []
    plain, drawing = (
        "\n\n".join(part.text for part in parts(code) if part.draws is draws)
        for draws in (False, True)
    )
    if plain:
        shown.append(_code(plain))
    if outcome.printed.strip():
        shown.append(f'<pre class="printed">{escape(outcome.printed.rstrip())}</pre>')
    for i, each in enumerate(outcome.pictures):
        shown.append(_figure(chapter, cell, f"{name}-{i}", each))
    # how a picture is drawn is a footnote to it
    if drawing:
        shown.append(_folded("The code that draws", _code(drawing), ' class="drawing"'))
    whole = "".join(shown)
    return _folded("Answer", whole) if cell.kind == "answer" else whole


def _folded(title: str, body: str, attributes: str = "") -> str:
    return f"<details{attributes}><summary>{title}</summary>{body}</details>"


def _code(text: str) -> str:
    return f"<pre><code>{highlight(text, PythonLexer(), HtmlFormatter(nowrap=True))}</code></pre>"


def _figure(chapter: Chapter, cell: Cell, name: str, picture: Picture) -> str:
    caption = _inline(chapter, picture.caption, cell.line)
    if picture.svg is None:
        data = base64.b64encode(picture.png or b"").decode("ascii")
        size = f'width="{picture.width * 100:.0f}"'
        shown = f'<img src="data:image/png;base64,{data}" {size} alt="{escape(picture.caption)}">'
    else:
        shown = _inline_svg(picture.svg, name, picture.caption)
    return f"<figure>{shown}<figcaption>{caption}</figcaption></figure>"


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
    MarkdownIt("commonmark", {"html": False})
    .enable("table")
    .use(dollarmath_plugin, renderer=_formula)
)
_MARKDOWN.add_render_rule("link_open", _link)


def _prose(chapter: Chapter, cell: Cell) -> str:
    try:
        return _MARKDOWN.render(cell.text)
    except Exception as error:
        raise ChapterError(
            chapter.path, _line_of(cell, error), f"a formula cannot be set: {error}"
        ) from error


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
