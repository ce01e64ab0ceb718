"""Run a chapter cell by cell, in one namespace, and catch what it prints and draws."""

from __future__ import annotations

import io
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from types import ModuleType
from typing import Final

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from pop_ref.walkthrough import style
from pop_ref.walkthrough.builder.chapter import Cell, Chapter, ChapterError

# an SVG of more bytes than this is worth less than a PNG
_LARGEST_SVG: Final = 400_000
_DPI: Final = 200


@dataclass(frozen=True)
class Picture:
    """A figure as it stands in a page: SVG text, or PNG bytes where the SVG would be huge; inches; a caption.

    Attributes:
        frames: of a film, PNG bytes and a label each; a film has no other picture.
    """

    svg: str | None
    png: bytes | None
    width: float
    caption: str
    frames: tuple[tuple[bytes, str], ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What a cell printed and drew; both empty for prose."""

    cell: Cell
    printed: str = ""
    pictures: tuple[Picture, ...] = ()


# where `picture` hangs figures while a chapter runs for its page; empty while it runs as a plain script
_walls: list[list[Picture]] = []


def picture(figure: Figure, caption: str) -> None:
    """Hand a figure to the page under construction, or show it in a notebook, and close it.

    Args:
        figure: a matplotlib figure.
        caption: one or two sentences of markdown, formulas allowed.
    """
    if _walls:
        _walls[-1].append(_drawn(figure, caption))
    else:
        _show_in_notebook(figure, caption)
    plt.close(figure)


def _show_in_notebook(figure: Figure, caption: str) -> None:
    """Show a figure and its caption where this runs in Jupyter, which alone has both modules and a kernel."""
    jupyter = sys.modules.get("ipykernel.zmqshell")
    shown = sys.modules.get("IPython.display")
    if jupyter is None or shown is None or not jupyter.ZMQInteractiveShell.initialized():
        return
    width = round(100 * float(figure.get_size_inches()[0]))
    shown.display(shown.Image(_png(figure), width=width), shown.Markdown(caption))


def _png(figure: Figure) -> bytes:
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=_DPI, facecolor="white")
    return png.getvalue()


def film(
    images: Sequence[np.ndarray], labels: Sequence[str], caption: str, enlarged: int = 4
) -> None:
    """Hand a sequence of images to the page under construction, which plays them; elsewhere show some as a strip.

    Args:
        images: [H, W, 3] encoded rgb each, clipped to [0, 1] here.
        labels: one an image, such as "step 20".
        caption: one or two sentences of markdown, formulas allowed.
        enlarged: how many pixels of the page an image's pixel is wide.
    """
    if _walls:
        frames = tuple(
            (_enlarged(image, enlarged), label)
            for image, label in zip(images, labels, strict=True)
        )
        _walls[-1].append(
            Picture(None, None, images[0].shape[1] * enlarged / 100.0, caption, frames)
        )
        return
    shown = [round(float(k)) for k in np.linspace(0, len(images) - 1, min(5, len(images)))]
    figure, panels = style.axes(len(shown), height=7.2 / len(shown), ticks=False)
    for panel, k in zip(np.atleast_1d(panels), shown, strict=True):
        style.show_image(panel, images[k], labels[k])
    picture(figure, caption)


def _enlarged(image: np.ndarray, times: int) -> bytes:
    file = io.BytesIO()
    plt.imsave(
        file, np.clip(image, 0.0, 1.0).repeat(times, axis=0).repeat(times, axis=1), format="png"
    )
    return file.getvalue()


def run_chapter(chapter: Chapter) -> list[Outcome]:
    """Run a chapter.

    Args:
        chapter: as `read_chapter` gave it.

    Returns:
        One outcome a cell, in order.

    Raises:
        ChapterError: a cell raised; the message names the chapter's file, the line and the error.
    """
    style.apply()
    with _module(chapter.module) as namespace:
        return [
            Outcome(cell) if cell.kind == "prose" else _run_cell(chapter, cell, namespace)
            for cell in chapter.cells
        ]


@contextmanager
def _module(name: str) -> Iterator[dict[str, object]]:
    # a module, since what is defined in a chapter is looked up by its module's name (dataclasses do)
    module = ModuleType(name)
    sys.modules[name] = module
    try:
        yield vars(module)
    finally:
        del sys.modules[name]
        plt.close("all")


def _run_cell(chapter: Chapter, cell: Cell, namespace: dict[str, object]) -> Outcome:
    printed, wall = io.StringIO(), list[Picture]()
    _walls.append(wall)
    try:
        # blank lines before it give every statement the line that it has in the file
        code = compile("\n" * (cell.line - 1) + cell.text, str(chapter.path), "exec")
        with redirect_stdout(printed):
            exec(code, namespace)
    except Exception as error:
        line, source = _place(chapter, cell, error)
        what = f"{type(error).__name__}: {error}".rstrip(": ")
        raise ChapterError(chapter.path, line, f"{what}\n    {source}") from error
    finally:
        _walls.pop()
    return Outcome(cell, printed.getvalue(), tuple(wall))


def _place(chapter: Chapter, cell: Cell, error: Exception) -> tuple[int, str]:
    line = cell.line
    if isinstance(error, SyntaxError) and error.filename == str(chapter.path):
        line = error.lineno or line
    for frame in traceback.extract_tb(error.__traceback__):
        if frame.filename == str(chapter.path):
            line = frame.lineno or line
    lines = cell.text.split("\n")
    inside = 0 <= line - cell.line < len(lines)
    return line, lines[line - cell.line].strip() if inside else ""


def _drawn(figure: Figure, caption: str) -> Picture:
    width = float(figure.get_size_inches()[0])
    # no date and a fixed salt: the same chapter makes the same bytes
    with plt.rc_context({"svg.hashsalt": "walk-through"}):
        svg = io.StringIO()
        figure.savefig(svg, format="svg", dpi=_DPI, transparent=True, metadata={"Date": None})
    if len(svg.getvalue()) <= _LARGEST_SVG:
        return Picture(svg.getvalue(), None, width, caption)
    return Picture(None, _png(figure), width, caption)
