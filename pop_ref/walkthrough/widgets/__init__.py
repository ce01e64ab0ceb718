"""Widgets for the pages: pictures that answer to a finger, a mouse or the arrow keys, with no framework.

None needs a network but "python", which runs `splat.py` in Pyodide, and asks for that when its button is pressed.

Each is one plain script next to this file. Its mathematics stands apart in `math/`, its functions named as the
oracle's; a test runs those against the oracle. The constants are those of the profile `paper`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import Final

from pop_ref.constants import PAPER

FOLDER: Final = Path(__file__).resolve().parent
# where Pyodide is fetched from, when a reader asks for it
PYODIDE: Final = "https://cdn.jsdelivr.net/pyodide/v0.27.7/full/"


@dataclass(frozen=True)
class Widget:
    """What a widget is called, what to try with it, and the file of the mathematics that it, or its worker, needs."""

    title: str
    prompt: str
    needs: str = ""
    worker: str = ""


WIDGETS: Final = {
    "splat2d": Widget(
        "One splat on the screen",
        "drag the splat over the pixels, then take its opacity down to 0.02: where does the orange edge go?",
        "splats",
    ),
    "stack": Widget(
        "A stack of splats at one pixel",
        "put a wall in the middle, then bring it to the front: which splats still have a weight, and which a gradient?",
        "splats",
    ),
    "orbit": Widget(
        "A Gaussian in space and its ellipse",
        "walk around it by dragging, then come as near as 2 world units: is the ellipse as wide as the points, and are "
        "its two sides theirs?",
        "splats",
    ),
    "harmonics": Widget(
        "Sixteen harmonics",
        "set all to zero, raise one slider at a time, and turn the globe by half a turn: which harmonics have the same "
        "value seen from opposite sides (even), which the negative (odd)?",
        "splats",
    ),
    "train": Widget(
        "Two trainings, without and with the prior",
        "train, and watch the histograms. Then make the prior ten times as heavy and start again: which opacities go, "
        "and what does the picture lose?",
        worker="training",
    ),
    "python": Widget(
        "splat.py, in this page",
        "run it, and find in its last function where a line is printed: what does it say, and of which view?",
    ),
}


def html(name: str) -> str:
    """Write a widget as markup for a page: style, script and data in one piece, nothing loaded from anywhere.

    Where scripts do not run it stays hidden, and one line says so. A page may hold several, each of them once.

    Args:
        name: one of `WIDGETS`.

    Returns:
        Elements for the body of a page. Colours are the page's own variables, where it has them.

    Raises:
        ValueError: there is no widget of that name.
    """
    if name not in WIDGETS:
        raise ValueError(f"there is no widget {name!r}; use one of {', '.join(WIDGETS)}")
    widget = WIDGETS[name]
    title = escape(widget.title)
    return (
        f'<div class="pop-widget" data-widget="{name}" role="group" aria-label="{title}" hidden>'
        f'<h4>{title}</h4><p class="pw-try"><b>Try this:</b> {escape(widget.prompt)}</p></div>'
        f'<noscript><p class="pop-widget-off">({title}: this one moves where JavaScript is allowed.)</p></noscript>'
        f"<style>{_text('widgets.css')}</style><script>{_script(name, widget)}</script>"
    )


def mathematics(file: str) -> str:
    """Read the pure functions of a file in `math/`, with the constants that they use in front."""
    constants = {key: value for key, value in asdict(PAPER).items() if isinstance(value, float)}
    return f"const PAPER = {json.dumps(constants)};\n{_text(f'math/{file}.js')}"


def _script(name: str, widget: Widget) -> str:
    # a worker begins from text, since a page that lies in a file may load nothing
    text = mathematics(widget.worker) if widget.worker else ""
    file = f"{name}_worker.js"
    worker = (
        f"const WORKER = {json.dumps(text + _text(file))};" if (FOLDER / file).exists() else ""
    )
    if name == "python":
        splat = (FOLDER.parents[1] / "learn" / "splat.py").read_text(encoding="utf-8")
        worker += (
            f"const SPLAT = {json.dumps(splat)}, PYODIDE = {json.dumps(PYODIDE)}, "
            'COMMAND = "python -m pop_ref.learn.splat";'
        )
    # whatever a page holds more than once is started once
    start = (
        f"for (const root of document.querySelectorAll('.pop-widget[data-widget=\"{name}\"][hidden]')) "
        f"{{ root.hidden = false; {name}(root); }}"
    )
    needs = mathematics(widget.needs) if widget.needs else ""
    parts = (needs, _text("kit.js"), worker, _text(f"{name}.js"), start)
    return "(() => {\n" + "\n".join(part for part in parts if part) + "\n})();"


@cache
def _text(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")
