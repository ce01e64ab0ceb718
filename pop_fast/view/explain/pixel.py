"""Explain one pixel: the oracle's walk through its list, the transpose of that walk, and what POP adds.

The oracle is asked about the few Gaussians of a large scene that can reach the pixel's tile.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from pop_fast.data.capture import View
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.view.explain.model import PixelExplanation, Row, Status, Triple
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
    """Blend one pixel from its tile's list and note every entry's fate.

    Args:
        scene: the view.
        splats: all that can be in the pixel's tile, in index order.
        x: column of the pixel.
        y: row of the pixel.
        profile: every constant.
    """
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
    term stand beside them.

    Args:
        scene: raw parameters, or what `explain_view` made of them; that is the dearer part when asked for many pixels.
        x: column, from 0 at the left.
        y: row, from 0 at the top.
        view: camera, photograph and mask; with raw parameters only.
        config: as in `explain_view`, likewise.
        sh_degree: as in `explain_view`, likewise.

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
    """Refuse a pixel outside the image.

    Raises:
        PopError: it is; says which coordinate, and its range.
    """
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
        return f"in this run the POP term ended with step {stop - 1}; shown is what it would do now"
    return ""


def _triple(values: object) -> Triple:
    r, g, b = (float(v) for v in values)  # type: ignore[attr-defined]
    return r, g, b
