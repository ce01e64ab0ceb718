"""What is known about one pixel: every entry of its tile's list, front to back, and a table of it for a terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from textwrap import wrap
from typing import Literal

FORMAT = "pop-explain/1"
Status = Literal["blended", "skipped", "stopped", "hidden"]
Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One entry of the list that the pixel walks.

    Attributes:
        rank: place in the list, from 0 at the front.
        id: the Gaussian.
        status: "blended", "skipped" (too faint here, the walk continues), "stopped" (it would have taken T to the stop:
            not blended, the walk ends) or "hidden" (behind the end of the walk, never visited).
        reason: the decision behind the status, with its label, operand and threshold; empty for plain blending.
        depth: camera z, world units.
        distance: from the pixel's centre to the splat's, px.
        falloff: exp(-sigma), 1 at the splat's centre.
        opacity: the Gaussian's activated opacity.
        blend_opacity: the opacity that blends; differs from `opacity` only when antialiased.
        alpha_raw: blend_opacity * falloff.
        alpha: clamped to the ceiling (D6).
        clamped: whether that changed it.
        T: transmittance in front of the entry; None where the walk did not get that far.
        weight: T alpha, 0 unless blended.
        color: of the splat as this camera sees it.
        cumulative: the pixel's colour up to and including this entry, without background.
        dominant: whether it has the largest weight (D8).
        v_alpha: derivative of the photometric loss with respect to this alpha.
        v_opacity: likewise to the opacity, through this pixel alone (0 where the ceiling stops it, B3).
        v_opacity_view: likewise through all pixels of the view.
        v_opacity_pop: derivative of the weighted POP term; negative pulls the opacity up, positive pushes it down.
        pixels_dominated: pixels of the view it dominates; over 0 means important to POP.
        mean2d: screen centre, px.
        conic: inverse screen covariance (xx, xy, yy), px^-2.
    """

    rank: int
    id: int
    status: Status
    reason: str
    depth: float
    distance: float
    falloff: float
    opacity: float
    blend_opacity: float
    alpha_raw: float
    alpha: float
    clamped: bool
    T: float | None
    weight: float
    color: Triple
    cumulative: Triple
    dominant: bool
    v_alpha: float
    v_opacity: float
    v_opacity_view: float
    v_opacity_pop: float
    pixels_dominated: int
    mean2d: tuple[float, float]
    conic: Triple

    @property
    def pop(self) -> Literal["up", "down", "none"]:
        """What the POP term does to the opacity when the loss is descended."""
        return "none" if self.v_opacity_pop == 0.0 else "up" if self.v_opacity_pop < 0.0 else "down"

    @property
    def net(self) -> Literal["up", "down", "none"]:
        """What the whole loss of the view, POP included, does to the opacity."""
        total = self.v_opacity_view + self.v_opacity_pop
        return "none" if total == 0.0 else "up" if total < 0.0 else "down"


@dataclass(frozen=True, kw_only=True)
class PixelExplanation:
    """Why one pixel has its colour; printed, it is a table.

    Attributes:
        view: the view's file name.
        x: column of the pixel, from 0.
        y: row of the pixel, from 0.
        width: of the image, px.
        height: of the image, px.
        profile: the rasterizer's constants.
        objective: the photometric loss in words.
        loss: its value for the view.
        lambda_pop: weight of the POP term; 0 when the objective has none.
        pop_note: what there is to know about that term at the splat's step; may be empty.
        n_gaussians: in the scene.
        n_important: of these, dominant at some pixel of the view.
        color: the pixel, background included, not clamped.
        photo: the photograph there.
        v_color: derivative of the photometric loss with respect to the pixel's colour.
        background: colour behind everything.
        T_final: share of the background.
        dominant_id: the Gaussian with the largest weight, -1 where nothing was blended.
        n_traversed: entries visited, the one that stopped the walk included.
        rows: all entries of the pixel's tile, front to back.
    """

    view: str
    x: int
    y: int
    width: int
    height: int
    profile: str
    objective: str
    loss: float
    lambda_pop: float
    pop_note: str
    n_gaussians: int
    n_important: int
    color: Triple
    photo: Triple
    v_color: Triple
    background: Triple
    T_final: float
    dominant_id: int
    n_traversed: int
    rows: tuple[Row, ...]

    @property
    def blended(self) -> tuple[Row, ...]:
        """The entries that make the pixel's colour, front to back."""
        return tuple(row for row in self.rows if row.status == "blended")

    @property
    def stopped_by(self) -> Row | None:
        """The entry that ended the walk (D7), or None where the list ran out first."""
        return next((row for row in self.rows if row.status == "stopped"), None)

    def __str__(self) -> str:

        return table(self)

    def to_json(self) -> str:
        """Write everything as JSON; `format` names the layout, and field names are those of this class."""
        plain = asdict(self)
        for entry, row in zip(plain["rows"], self.rows, strict=True):
            entry |= {"pop": row.pop, "net": row.net}
        return json.dumps({"format": FORMAT, **plain}, indent=1) + "\n"


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
