"""The explanation for a terminal: one line an entry, at most 120 columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from textwrap import wrap
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pop_fast.view.explain.model import PixelExplanation, Row

WIDTH = 120
_KEPT = 20
_HEAD = "    #      id  depth   dist     G     o alpha     T weight  colour r g b    sum r g b       dL/dalpha  dL/do"
_HEAD_POP = "        POP"


def table(explanation: PixelExplanation, everything: bool = False) -> str:
    """Lay out the explanation.

    Args:
        explanation: of one pixel.
        everything: all entries; else those that matter, and one line for each stretch of faint ones.
    """
    e = explanation
    has_pop = e.lambda_pop > 0.0
    lines = [*_above(e), "", _HEAD + _HEAD_POP * has_pop, "-" * WIDTH]
    chosen = {row.rank for row in e.rows} if everything else weighty(e)
    stretch: list[Row] = []
    for row in e.rows:
        if row.rank in chosen:
            lines += [*_folded(stretch), _line(row, has_pop)]
            stretch = []
        else:
            stretch.append(row)
    lines += _folded(stretch)
    behind = f"{'background':>44}{number(e.T_final):>7}{number(e.T_final):>6}  {rgb(e.background)}  {rgb(e.color)}"
    return "\n".join([*lines, "-" * WIDTH, behind, "", *_below(e)])


def weighty(e: PixelExplanation, most: int = _KEPT) -> set[int]:
    """Choose the entries that matter, by rank: the heaviest, those that the loss pulls at most, and the decisive."""
    heavy = sorted(e.blended, key=lambda row: -row.weight)[:most]
    pulled = sorted(e.blended, key=lambda row: -abs(row.v_alpha))[:4]
    special = [row for row in e.rows if row.dominant or row.clamped or row.status == "stopped"]
    return {row.rank for row in (*heavy, *pulled, *special) if row.status != "hidden"}


def number(value: float) -> str:
    """Write a share in five columns: .7772, or 1.000."""
    return f"{value:.4f}"[1:] if 0.0 <= value < 0.99995 else f"{value:.3f}"


def rgb(color: Sequence[float]) -> str:
    """Write a colour in fourteen columns."""
    return " ".join((f"{c:.3f}"[1:] if 0.0 <= c < 0.9995 else f"{c:.2f}").rjust(4) for c in color)


def _above(e: PixelExplanation) -> Iterator[str]:
    stop = e.stopped_by
    end = f"stopped by #{stop.rank} (D7)" if stop else "the list ran out"
    skipped = sum(row.status == "skipped" for row in e.rows)
    term = f" + {e.lambda_pop:g} L_POP" if e.lambda_pop else ""
    weights = sum(row.weight for row in e.rows)
    yield f"{e.view}, {e.width} x {e.height} px, pixel ({e.x}, {e.y}), profile {e.profile}"
    yield f"colour {rgb(e.color)}   photograph {rgb(e.photo)}   weights {weights:.6f} + T_final {e.T_final:.6f} = 1"
    yield (
        f"{len(e.rows)} entries in its tile: {len(e.blended)} blended, {skipped} skipped (D5), "
        f"{len(e.rows) - e.n_traversed} never visited; {end}"
    )
    pulls = " ".join(f"{v:+.1e}" for v in e.v_color)
    yield f"loss {e.objective}{term}; photometric part {e.loss:.3e}, dL/dcolour {pulls}"


def _line(row: Row, has_pop: bool) -> str:
    depth = f"{row.depth:.3f}" if row.depth < 100.0 else f"{row.depth:.0f}"
    line = f"{'*' if row.dominant else ' '}{row.rank:4d} {row.id:7d} {depth:>6} {row.distance:6.1f} "
    line += f"{number(row.falloff)} {number(row.opacity)} {number(row.alpha)}{'^' if row.clamped else ' '}"
    if row.T is None or row.status != "blended":
        return f"{line} {row.status}, {row.reason}"[:WIDTH]
    return (
        f"{line}{number(row.T)} {number(row.weight)}  {rgb(row.color)}  {rgb(row.cumulative)} "
        f"{row.v_alpha:+9.1e} {row.v_opacity:+8.1e}{f' {_pop(row)}' * has_pop}"
    )


def _pop(row: Row) -> str:
    return "-".rjust(10) if row.pop == "none" else f"{row.pop:4s} {abs(row.v_opacity_pop):.0e}"


def _folded(rows: Sequence[Row]) -> Iterator[str]:
    faint = [row for row in rows if row.status == "blended"]
    hidden = sum(row.status == "hidden" for row in rows)
    kinds = [f"{len(faint)} blended of weight {sum(row.weight for row in faint):.4f} in all"] if faint else []
    kinds += [f"{hidden} never visited (D7)"] if hidden else []
    # stretches that were only skipped are left to the ranks, which jump, and to the count above the table
    if kinds:
        yield f"{'':6}... {', '.join(kinds)}"


def _below(e: PixelExplanation) -> Iterator[str]:
    yield "* dominant (D8)   ^ clamped to the ceiling (D6)   G falloff   o opacity   dL/do: through this pixel alone"
    where = " POP: where it moves it, and |dL_POP/do|" if e.lambda_pop else ""
    yield f"descent moves against dL/do: a negative one raises the opacity.{where}"
    for text in (_about_dominant(e), *_about_pop(e)):
        yield from wrap(text, WIDTH)


def _about_dominant(e: PixelExplanation) -> str:
    row = next((row for row in e.rows if row.dominant), None)
    if row is None:
        return "nothing is blended here, so no Gaussian dominates"
    prior = f" and POP's {row.v_opacity_pop:+.1e}" if e.lambda_pop else ""
    return (
        f"#{row.rank} dominates here and at {row.pixels_dominated:,} pixels of the view; over the whole view its "
        f"photometric dL/do is {row.v_opacity_view:+.1e}{prior}: opacity {row.opacity:.4f} goes {row.net}"
    )


def _about_pop(e: PixelExplanation) -> Iterator[str]:
    if e.lambda_pop:
        yield (
            f"POP: {e.n_important:,} of {e.n_gaussians:,} Gaussians dominate a pixel of this view and are pulled up, "
            "the others are pushed down"
        )
    if e.pop_note:
        yield e.pop_note
