"""What is known about one pixel, as plain values: every entry of its tile's list, front to back, and their sum."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
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
        from pop_fast.view.explain.table import table

        return table(self)

    def to_json(self) -> str:
        """Write everything as JSON; `format` names the layout, and field names are those of this class."""
        plain = asdict(self)
        for entry, row in zip(plain["rows"], self.rows, strict=True):
            entry |= {"pop": row.pop, "net": row.net}
        return json.dumps({"format": FORMAT, **plain}, indent=1) + "\n"
