"""Pages that hold all that they show: one style, one script, a policy by which nothing else runs or is fetched, and SVG
elements as strings.
"""

from __future__ import annotations

import base64
import hashlib
from html import escape
from importlib.resources import files
from typing import Final

# pictures and videos are in the page; whatever else a text of a result or of a capture could bring along is neither
# fetched nor run
_POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; "
    "form-action 'none'; script-src {scripts}"
)
# the page that shows a splat sorts in a worker, and a frame is held to the policy of the page around it as well
_WORKERS: Final = " blob:; worker-src blob:"


def document(title: str, style: str, body: str, script: str, framed: str = "") -> str:
    """Lay out a page.

    Args:
        title: as text; it is escaped.
        style: its style sheet.
        body: what stands in `main`, as HTML.
        script: the one script that may run in it.
        framed: the one that may run in its frames, which may start workers; empty for none.
    """
    allowed = " ".join(f"'sha256-{_digest(text)}'" for text in (script, framed) if text)
    policy = _POLICY.format(scripts=allowed) + (_WORKERS if framed else "")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{escape(title)}</title><style>{style}</style></head>"
        f"<body><main>{body}</main><script>{script}</script></body></html>\n"
    )


def asset(folder: str, name: str) -> str:
    """Return a text file of a folder of this one."""
    return files("pop_fast.view").joinpath(folder, name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


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
