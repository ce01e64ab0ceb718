"""SVG elements as strings: numbers shortened, text escaped."""

from __future__ import annotations

from html import escape


def element(tag: str, body: str = "", title: str = "", **attributes: object) -> str:
    """Write one element.

    Args:
        tag: its name.
        body: SVG inside it.
        title: shown by browsers under the pointer.
        attributes: `kind` becomes `class`, `_` becomes `-`, numbers are rounded to 0.1.
    """
    words = [tag]
    for name, value in attributes.items():
        text = f"{value:.1f}".removesuffix(".0") if isinstance(value, float) else str(value)
        words.append(f'{"class" if name == "kind" else name.replace("_", "-")}="{escape(text)}"')
    if title:
        body = f"<title>{escape(title)}</title>" + body
    return f"<{' '.join(words)}>{body}</{tag}>" if body else f"<{' '.join(words)}/>"


def text(x: float, y: float, words: str, anchor: str = "start") -> str:
    """Write a text element."""
    return element("text", escape(words), x=float(x), y=float(y), text_anchor=anchor)


def path(d: str, kind: str, title: str = "", **attributes: object) -> str:
    """Write a path element of one CSS class."""
    return element("path", "", title, kind=kind, d=d, **attributes)


def card(title: str, legend: str, width: int, height: int, body: str, kind: str = "chart", data: str = "") -> str:
    """Write a figure: a title with its legend, and an SVG drawing under it.

    Args:
        title: the heading.
        legend: HTML beside the heading.
        width: of the drawing, in its own units.
        height: likewise.
        body: the SVG.
        kind: CSS classes of the figure.
        data: JSON that the page's script reads.
    """
    extra = f' data-chart="{escape(data)}"' if data else ""
    drawing = element("svg", body, role="img", aria_label=title, viewBox=f"0 0 {width} {height}")
    caption = f'<figcaption><b>{escape(title)}</b><span class="legend">{legend}</span></figcaption>'
    return f'<figure class="{kind}"{extra}>{caption}{drawing}</figure>'
