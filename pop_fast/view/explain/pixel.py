"""Explain one pixel: every entry of its tile's list, front to back, and a table of it for a terminal.

The oracle walks the list and the transpose of that walk, for the few Gaussians of a large scene that can reach the
pixel's tile; what POP adds stands next to it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from textwrap import wrap
from typing import Any, Literal

import numpy as np
from torch import Tensor

from pop_fast.data.capture import View
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.view.explain.scene import TILE_SIZE, ExplainedView, explain_view
from pop_ref.alpha import alpha_from_sigma, alpha_from_sigma_vjp, falloff, sigma_at_pixel
from pop_ref.constants import Profile
from pop_ref.dominance import dominant_id
from pop_ref.pixel import (
    Pixel,
    SplatRows,
    composite_pixel,
    composite_pixel_vjp,
    rows_from_splats,
    stops,
    zero_gradients,
)
from pop_ref.records import Camera, Gaussians, Splats
from pop_ref.splatting import project
from pop_ref.tiles import grid_size, tile_rects

# px: extents are whole pixels and float32 may put one on the other side of a pixel's edge
_SLACK = 2.0


@dataclass(frozen=True)
class Step:
    """One entry as the walk meets it; `T` is None behind the end of the walk.

    `row` is the entry's row in the splats that were walked.
    """

    row: int
    sigma: float
    falloff: float
    alpha_raw: float
    alpha: float
    status: str
    reason: str
    T: float | None


@dataclass(frozen=True)
class Walk:
    """A pixel, its list and each entry's fate."""

    splats: Splats
    columns: SplatRows
    pixel: Pixel
    steps: tuple[Step, ...]


def candidates(info: Mapping[str, Any], x: int, y: int) -> np.ndarray:
    """List the Gaussians whose extent comes near the pixel's tile, ascending. int64 [M]"""
    means2d, radii = info["means2d"][0].double().numpy(), info["radii"][0].double().numpy()
    low = np.array([x, y]) // TILE_SIZE * TILE_SIZE - _SLACK
    reach = (means2d + radii >= low) & (means2d - radii <= low + TILE_SIZE + 2.0 * _SLACK) & (radii > 0.0)
    return np.flatnonzero(reach.all(axis=1))


def oracle_splats(scene: ExplainedView, ids: np.ndarray, profile: Profile) -> Splats:
    """Project some of the Gaussians with the oracle."""
    chosen = Gaussians(**{name: tensor[ids].numpy() for name, tensor in scene.gaussians.items()})
    view = scene.view
    camera = Camera(view.viewmat, view.K, view.width, view.height)
    return project(chosen, camera, scene.sh_degree, profile, scene.config.antialiased)


def walk(scene: ExplainedView, splats: Splats, x: int, y: int, profile: Profile) -> Walk:
    """Blend one pixel from its tile's list of splats, in index order, and note every entry's fate."""
    columns = rows_from_splats(splats)
    order = tile_list(scene, splats, x, y, profile)
    pixel = composite_pixel(order, columns, x + 0.5, y + 0.5, list(scene.config.background), profile)
    T_of = dict(zip(pixel.ids, pixel.transmittances, strict=True))
    steps: list[Step] = []
    T = 1.0
    for rank, i in enumerate(order):
        sigma = sigma_at_pixel(columns.means2d[i], columns.conics[i], x + 0.5, y + 0.5)
        alpha, skipped = alpha_from_sigma(sigma, columns.opacities[i], profile)
        G = falloff(max(sigma, 0.0))
        raw = columns.opacities[i] * G
        if rank >= pixel.n_traversed:
            status, reason = "hidden", "D7: behind the end of the walk"
        elif i in T_of:
            status, T = "blended", T_of[i]
            reason = f"D6: {raw:.5f} clamped to {profile.alpha_ceiling:g}" if raw > alpha else ""
        elif skipped:
            status = "skipped"
            reason = (
                f"D5: alpha {raw:.2g} < {profile.alpha_floor:.5f}" if sigma >= 0.0 else f"D5: sigma {sigma:.2g} < 0"
            )
        else:
            status = "stopped"
            sign = "<=" if profile.stop_inclusive else "<"
            reason = f"D7: would leave T {T * (1.0 - alpha):.2g} {sign} {profile.transmittance_stop:g}"
            assert stops(T * (1.0 - alpha), profile)
        steps.append(Step(i, sigma, G, raw, alpha, status, reason, None if status == "hidden" else T))
        if status == "blended":
            T *= 1.0 - alpha
    return Walk(splats, columns, pixel, tuple(steps))


def tile_list(scene: ExplainedView, splats: Splats, x: int, y: int, profile: Profile) -> list[int]:
    """List the rows in the pixel's tile, front to back (D3, D4)."""
    width, height = scene.view.width, scene.view.height
    rects = tile_rects(splats.means2d, splats.radii, width, height, TILE_SIZE, profile)
    tiles_x, tiles_y = grid_size(width, height, TILE_SIZE)
    column, line = x // TILE_SIZE, y // TILE_SIZE
    assert column < tiles_x
    assert line < tiles_y
    inside = (rects[:, 0] <= column) & (column < rects[:, 2]) & (rects[:, 1] <= line) & (line < rects[:, 3])
    rows = np.flatnonzero(inside)
    return rows[np.argsort(splats.depths[rows], kind="stable")].tolist()


def explain_pixel(
    scene: ExplainedView | Mapping[str, Tensor],
    x: int,
    y: int,
    view: View | None = None,
    config: TrainConfig | None = None,
    sh_degree: int | None = None,
) -> PixelExplanation:
    """Explain why a pixel looks as it does.

        explanation = explain_pixel(params, 120, 80, view=capture.views[3])
        print(explanation)

    The numbers are the oracle's, in float64. Derivatives are of the photometric loss of the view, and those of the POP
    term stand next to them.

    Args:
        scene: raw parameters, or what `explain_view` made of them; that is the dearer part when asked for many pixels.
        x: column, from 0 at the left.
        y: row, from 0 at the top.
        view: camera, photograph and mask; with raw parameters only.
        config: as in `explain_view`.
        sh_degree: as in `explain_view`.

    Raises:
        PopError: the pixel is outside the image, or raw parameters come without a view.
    """
    if not isinstance(scene, ExplainedView):
        if view is None:
            raise PopError(
                "view is None; raw parameters can only be explained in a view, so give view=capture.views[i]"
            )
        check_inside(view, x, y)
        scene = explain_view(scene, view, config, sh_degree)
    check_inside(scene.view, x, y)
    profile = scene.config.renderer
    ids = candidates(scene.info, x, y)
    walked = walk(scene, oracle_splats(scene, ids, profile), x, y, profile)
    v_alphas = _v_alphas(scene, walked, x, y, profile)
    winner = dominant_id(walked.pixel.ids, walked.pixel.weights)
    rows: list[Row] = []
    total = [0.0, 0.0, 0.0]
    for rank, step in enumerate(walked.steps):
        row = _row(scene, walked, rank, int(ids[step.row]), v_alphas.get(step.row, 0.0), winner, profile, (x, y), total)
        total = list(row.cumulative)
        rows.append(row)
    return PixelExplanation(
        view=scene.view.name,
        x=x,
        y=y,
        width=scene.view.width,
        height=scene.view.height,
        profile=profile.name,
        objective=_objective(scene.config, scene.step or 0),
        loss=scene.loss,
        lambda_pop=scene.lambda_pop,
        pop_note=_pop_note(scene),
        n_gaussians=len(scene.counts),
        n_important=int(scene.important.sum()),
        color=_triple(walked.pixel.color),
        photo=_triple([v / 255.0 for v in scene.view.image[y, x].tolist()]),
        v_color=_triple(scene.v_image[y, x].tolist()),
        background=_triple(scene.config.background),
        T_final=walked.pixel.T_final,
        dominant_id=int(ids[winner]) if winner >= 0 else -1,
        n_traversed=walked.pixel.n_traversed,
        rows=tuple(rows),
    )


def check_inside(view: View, x: int, y: int) -> None:
    """Refuse a pixel outside the image; the PopError says which coordinate, and its range."""
    for name, value, size in (("x", x, view.width), ("y", y, view.height)):
        if not 0 <= value < size:
            raise PopError(
                f"pixel {name} is {value}; view {view.name} is {view.width} x {view.height} px, "
                f"so {name} must lie in 0..{size - 1}"
            )


def _v_alphas(scene: ExplainedView, walked: Walk, x: int, y: int, profile: Profile) -> dict[int, float]:
    """Find the derivative to each blended alpha: with an open ceiling (B3), `v_opacity = falloff * v_alpha`."""
    totals = zero_gradients(len(walked.columns.opacities), 3)
    background, v_color = list(scene.config.background), scene.v_image[y, x].tolist()
    opened = replace(profile, ceiling_gradient="pass")
    composite_pixel_vjp(walked.pixel, walked.columns, x + 0.5, y + 0.5, background, v_color, 0.0, totals, opened)
    steps = {step.row: step for step in walked.steps}
    return {i: float(totals.v_opacities[i]) / steps[i].falloff for i in walked.pixel.ids}


def _row(
    scene: ExplainedView,
    walked: Walk,
    rank: int,
    gaussian: int,
    v_alpha: float,
    winner: int,
    profile: Profile,
    at: tuple[int, int],
    before: list[float],
) -> Row:
    step, columns = walked.steps[rank], walked.columns
    u, v = columns.means2d[step.row]
    opacity, blends = float(scene.gaussians["opacities"][gaussian]), columns.opacities[step.row]
    weight = step.T * step.alpha if step.T is not None and step.status == "blended" else 0.0
    color = _triple(columns.colors[step.row])
    v_blends = alpha_from_sigma_vjp(step.sigma, blends, v_alpha, profile)[1] if weight else 0.0
    status: Status = step.status  # type: ignore[assignment]
    return Row(
        rank=rank,
        id=gaussian,
        status=status,
        reason=step.reason,
        depth=float(walked.splats.depths[step.row]),
        distance=((u - at[0] - 0.5) ** 2 + (v - at[1] - 0.5) ** 2) ** 0.5,
        falloff=step.falloff,
        opacity=opacity,
        blend_opacity=blends,
        alpha_raw=step.alpha_raw,
        alpha=step.alpha,
        clamped=step.alpha_raw > profile.alpha_ceiling,
        T=step.T,
        weight=weight,
        color=color,
        cumulative=_triple([b + weight * c for b, c in zip(before, color, strict=True)]),
        dominant=step.row == winner,
        v_alpha=v_alpha,
        # antialiasing multiplies the opacity by a factor that does not depend on it
        v_opacity=v_blends * blends / opacity if v_blends else 0.0,
        v_opacity_view=float(scene.v_opacities[gaussian]),
        v_opacity_pop=float(scene.v_pop[gaussian]),
        pixels_dominated=int(scene.counts[gaussian]),
        mean2d=(u, v),
        conic=_triple(columns.conics[step.row]),
    )


def _objective(config: TrainConfig, step: int) -> str:
    objective = config.objective_at(step)
    kind, weight = objective.pixelwise, objective.lambda_ssim
    divided = "" if config.photometric_divisor == 1.0 else f"/{config.photometric_divisor:g}"
    return f"{1.0 - weight:g} {kind.upper()}{divided} + {weight:g} (1 - SSIM)"


def _pop_note(scene: ExplainedView) -> str:
    if scene.lambda_pop == 0.0:
        return "this objective has no POP term"
    stop = scene.config.strategy.pop_stop_iter
    if scene.step is not None and scene.step >= stop:
        return f"in this run the POP term ended with step {stop - 1}; the table shows what it would do now"
    return ""


def _triple(values: object) -> Triple:
    r, g, b = (float(v) for v in values)  # type: ignore[attr-defined]
    return r, g, b


FORMAT = "pop-explain/1"
Status = Literal["blended", "skipped", "stopped", "hidden"]
Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One entry of the list that the pixel walks."""

    rank: int  # place in the list, from 0 at the front
    id: int  # the Gaussian
    # "blended", "skipped" (too faint here, the walk continues), "stopped" (it would have taken T to the stop:
    # not blended, the walk ends) or "hidden" (behind the end of the walk, never visited)
    status: Status
    # the decision behind the status, with its label, operand and threshold; empty for plain blending
    reason: str
    depth: float  # camera z, world units
    distance: float  # from the pixel's centre to the splat's, px
    falloff: float  # exp(-sigma), 1 at the splat's centre
    opacity: float  # the Gaussian's activated opacity
    blend_opacity: float  # the opacity that blends; differs from `opacity` only when antialiased
    alpha_raw: float  # blend_opacity * falloff
    alpha: float  # clamped to the ceiling (D6)
    clamped: bool  # whether that changed it
    T: float | None  # transmittance in front of the entry; None where the walk did not get that far
    weight: float  # T alpha, 0 unless blended
    color: Triple  # of the splat as this camera sees it
    cumulative: Triple  # the pixel's colour up to and including this entry, without background
    dominant: bool  # whether it has the largest weight (D8)
    v_alpha: float  # derivative of the photometric loss with respect to this alpha
    v_opacity: float  # likewise to the opacity, through this pixel alone (0 where the ceiling stops it, B3)
    v_opacity_view: float  # likewise through all pixels of the view
    # derivative of the weighted POP term; negative pulls the opacity up, positive pushes it down
    v_opacity_pop: float
    pixels_dominated: int  # pixels of the view it dominates; over 0 means important to POP
    mean2d: tuple[float, float]  # screen centre, px
    conic: Triple  # inverse screen covariance (xx, xy, yy), px^-2

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
    """Why one pixel has its colour; printed, it is a table."""

    view: str  # the view's file name
    x: int  # column of the pixel, from 0
    y: int  # row of the pixel, from 0
    width: int  # of the image, px
    height: int  # of the image, px
    profile: str  # the rasterizer's constants
    objective: str  # the photometric loss in words
    loss: float  # its value for the view
    lambda_pop: float  # weight of the POP term; 0 when the objective has none
    pop_note: str  # what there is to know about that term at the splat's step; may be empty
    n_gaussians: int  # in the scene
    n_important: int  # of these, dominant at some pixel of the view
    color: Triple  # the pixel, background included, not clamped
    photo: Triple  # the photograph there
    v_color: Triple  # derivative of the photometric loss with respect to the pixel's colour
    background: Triple  # colour behind everything
    T_final: float  # share of the background
    dominant_id: int  # the Gaussian with the largest weight, -1 where nothing was blended
    n_traversed: int  # entries visited, the one that stopped the walk included
    rows: tuple[Row, ...]  # all entries of the pixel's tile, front to back

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
    """Lay out the explanation: all entries, or those that matter, and one line for each stretch of faint ones."""
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
    pull = "-".rjust(10) if row.pop == "none" else f"{row.pop:4s} {abs(row.v_opacity_pop):.0e}"
    return (
        f"{line}{number(row.T)} {number(row.weight)}  {rgb(row.color)}  {rgb(row.cumulative)} "
        f"{row.v_alpha:+9.1e} {row.v_opacity:+8.1e}{f' {pull}' * has_pop}"
    )


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
