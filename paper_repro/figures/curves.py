"""Figures 2, 4a, 4b, 6a and 7: what changes during the training, and the opacities at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from paper_repro.figures.data import Asked, Chosen, Curve, choose, choose_one_scene, curve_of, has
from paper_repro.figures.style import (
    GREY,
    LOSSES,
    Drawn,
    End,
    Sheet,
    color_of,
    count,
    darker,
    foot,
    label_ends,
    log_ticks,
    name_of,
    step_ticks,
)
from paper_repro.paper import paper
from paper_repro.results import BINS, Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_METHODS: Final = ("3dgs", "gsplat", "pup", "mini_splatting", "taming", "speedy_splat", "pop")
_LOSSES: Final = ("l1_div_1", "l2_without_ssim", "l2")
_TERMS: Final = {"grad_l1": "L1", "grad_ssim": "SSIM at 0.01", "grad_l2": "L2"}
# Gaussians per pixel: of the views that are rendered all along, or of the held-out views where those are measured
_OF_PROBE: Final = ("probe_traversed", "probe_blended")
_HELD_OUT: Final = ("n_traversed", "n_blended")
_BELOW: Final = "training step"
_LOW, _HIGH = 0.1, 0.9
# the capture of the paper's figure
_SCENE: Final = "kitchen"
# the shares that the paper states, by their ids in paper.toml
_STATED: Final = {"below": "kitchen_frac_opacity_lt_0.1", "above": "kitchen_frac_opacity_gt_0.9"}
_LOW_COLOR, _HIGH_COLOR, _PLAIN = color_of("gsplat"), color_of("pop"), "#b9b9b9"


def gradients_of_losses(asked: Asked) -> Drawn:
    """Figure 4a: how large the gradient of each loss with respect to the image is, as POP trains."""
    chosen = choose_one_scene(asked, ["pop"], "bicycle", lambda r: has(r, *_TERMS))
    runs = chosen.runs["pop"]
    found = {key: curve_of(runs, chosen.scenes, key) for key in _TERMS}
    note = foot(
        *(asked, chosen),
        "Mean of |∂L/∂C| over pixels and channels of three training views, in units of 1/(3HW), the slope of L1.",
    )
    sheet = Sheet(note, 1.75)
    axes = sheet.panel(right=0.82)
    for key, (steps, values) in found.items():
        axes.plot(steps, values, color=LOSSES[key])
    low, high = (float(f([values for _, values in found.values()])) for f in (np.min, np.max))
    axes.set_yscale("log")
    axes.set_ylim(low / 1.5, high * 1.5)
    log_ticks(axes.yaxis, low / 1.5, high * 1.5)
    axes.set_ylabel("mean |∂L/∂C|  (L1 = 1)")
    _finish(axes, chosen, found, {key: (name, LOSSES[key]) for key, name in _TERMS.items()})
    return Drawn(sheet.figure, *_table(chosen, {("pop", key): curve for key, curve in found.items()}))


def gaussians_per_pixel(asked: Asked) -> Drawn:
    """Figure 4b: Gaussians that a pixel blends, and that it visits until it ends, 3DGS against POP."""
    scenes, rows = asked.scenes(paper().datasets["Mip-NeRF 360"]), ("3dgs", "pop")
    probed = all(has(r, *_OF_PROBE) for r in asked.results if r.row in rows and r.scene in scenes)
    keys, where = (_OF_PROBE, None) if probed else (_HELD_OUT, "psnr_test")
    chosen = choose(asked, rows, scenes, lambda r: has(r, *keys, *([] if where is None else [where])))
    found = {(row, key): curve_of(runs, chosen.scenes, key, where) for row, runs in chosen.runs.items() for key in keys}
    views = "three training views" if probed else "the held-out views"
    note = foot(
        *(asked, chosen), f"Means over the pixels of {views}. Visited: entries of the tile's list until the pixel ends."
    )
    sheet = Sheet(note, 2.45)
    height = (sheet.height - 0.33 - 0.16 - 0.28) / 2.0
    for key, title, bottom in zip(keys, ("visited per pixel", "blended per pixel"), (0.61 + height, 0.33), strict=True):
        axes = sheet.axes(0.44, bottom, sheet.width - 0.44 - 0.42, height)
        curves = {row: found[row, key] for row in chosen.runs}
        for row, (steps, values) in curves.items():
            axes.plot(steps, values, color=color_of(row), marker=None if probed else "o", markersize=2.0)
        axes.set_ylim(0.0, 1.08 * max(float(values.max()) for _, values in curves.values()))
        axes.set_title(title)
        axes.locator_params(axis="y", nbins=4)
        _finish(axes, chosen, curves)
        if bottom > 0.33:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
    return Drawn(sheet.figure, *_table(chosen, found))


def count_under_losses(asked: Asked) -> Drawn:
    """Figure 6a: the number of Gaussians under L1 with SSIM, L2, and L2 with SSIM at 0.01."""
    scenes = asked.scenes(paper().datasets["Mip-NeRF 360"])
    chosen = choose(asked, _LOSSES, scenes, _has_counts)
    found = _counts(chosen)
    note = foot(
        *(asked, chosen),
        "SSIM has weight 0.01, L1 or L2 0.99. Growth by gradient alone: no blur rule, no prior, no reset.",
    )
    sheet = Sheet(note, 1.75)
    axes = sheet.panel(right=0.72)
    for row, (steps, values) in found.items():
        axes.plot(steps, values, color=color_of(row), drawstyle="steps-post")
    axes.set_ylim(0.0, 1.06 * max(float(values.max()) for _, values in found.values()))
    axes.yaxis.set_major_formatter(lambda n, _: count(n))
    axes.locator_params(axis="y", nbins=5)
    axes.set_ylabel("Gaussians")
    _finish(axes, chosen, found)
    return Drawn(sheet.figure, *_table(chosen, {(row, "num_gaussians"): curve for row, curve in found.items()}))


def count_of_methods(asked: Asked) -> Drawn:
    """Figure 7: the number of Gaussians of every method; PUP-3DGS prunes and refines past the others' end."""
    chosen = choose(asked, _METHODS, asked.scenes(paper().datasets["Mip-NeRF 360"]), _has_counts)
    found = _counts(chosen)
    sheet = Sheet(foot(asked, chosen), 2.3)
    axes = sheet.panel(right=0.86)
    # the method itself lies above the others
    for row in sorted(found, key=lambda row: row == "pop"):
        steps, values = found[row]
        width = 1.7 if row == "pop" else 1.0
        axes.plot(steps, values, color=color_of(row), linewidth=width, drawstyle="steps-post")
    low = min(float(values.min()) for _, values in found.values()) / 1.25
    high = max(float(values.max()) for _, values in found.values()) * 1.25
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    log_ticks(axes.yaxis, low, high)
    axes.grid(axis="y")
    axes.set_ylabel("Gaussians")
    _finish(axes, chosen, found)
    return Drawn(sheet.figure, *_table(chosen, {(row, "num_gaussians"): curve for row, curve in found.items()}))


def _finish(
    axes: Axes, chosen: Chosen, curves: Mapping[str, Curve], names: Mapping[str, tuple[str, str]] | None = None
) -> None:
    """Settle the axis of steps, and name the curves where they end: as their rows, or otherwise."""
    names = names or {row: (name_of(row), color_of(row)) for row in curves}
    axes.set_xlim(0, max(int(result.schedule["max_steps"]) for result in chosen.all))
    step_ticks(axes.xaxis)
    axes.set_xlabel(_BELOW)
    lasts = {key: (float(steps[-1]), float(values[-1])) for key, (steps, values) in curves.items()}
    label_ends(axes, [End(*lasts[key], text, color) for key, (text, color) in names.items()])


def _has_counts(result: Result) -> bool:
    return has(result, "num_gaussians")


def _counts(chosen: Chosen) -> dict[str, Curve]:
    return {row: curve_of(runs, chosen.scenes, "num_gaussians") for row, runs in chosen.runs.items()}


def _table(chosen: Chosen, curves: Mapping[tuple[str, str], Curve]) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
    """Write curves as lines of a table."""
    rows: list[Sequence[Any]] = []
    for (row, key), (steps, values) in curves.items():
        runs = " ".join(result.run for result in chosen.of(row))
        scenes = " ".join(chosen.scenes)
        rows += [(row, key, int(step), float(value), scenes, runs) for step, value in zip(steps, values, strict=True)]
    return ("row", "quantity", "step", "value", "scenes", "runs"), rows


def opacity_histogram(asked: Asked) -> Drawn:
    """Figure 2: the shares under 0.1 and over 0.9, and the two that the paper states where the capture is the same."""
    chosen = choose_one_scene(asked, ["3dgs"], _SCENE)
    runs = chosen.of("3dgs")
    # every seed counts the same, whatever its number of Gaussians
    shares = np.mean([np.array(r.opacity_histogram) / max(r.num_gaussians, 1) for r in runs], axis=0)
    below, above = share_below(shares, _LOW), share_above(shares, _HIGH)
    n = np.mean([r.num_gaussians for r in runs])
    same = chosen.scenes == (_SCENE,)
    other = "" if same else f" The paper's figure is of another capture, {_SCENE}."
    note = foot(asked, chosen, f"{count(float(n))} Gaussians in {BINS} bins.{other}")
    sheet = Sheet(note, 1.85)
    axes = sheet.panel(right=0.1, top=0.12)
    edges = np.linspace(0.0, 1.0, BINS + 1)
    colors = [_LOW_COLOR if e < _LOW - 1e-9 else _HIGH_COLOR if e >= _HIGH - 1e-9 else _PLAIN for e in edges[:-1]]
    axes.bar(edges[:-1], 100.0 * shares, width=1.0 / BINS, align="edge", color=colors, edgecolor="white", linewidth=0.3)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 112.0 * float(shares.max()))
    axes.set_xticks([0.0, _LOW, 0.5, _HIGH, 1.0], ["0", "0.1", "0.5", "0.9", "1"])
    axes.set_xlabel("opacity")
    axes.set_ylabel("share of Gaussians (%)")
    axes.locator_params(axis="y", nbins=5)
    for share, color, x, align, side, stated in (
        (below, _LOW_COLOR, _LOW, "left", "under 0.1", "below"),
        (above, _HIGH_COLOR, _HIGH, "right", "over 0.9", "above"),
    ):
        axes.axvline(x, color=color, linewidth=0.6, linestyle=(0, (3, 2)))
        inward = 1.0 if align == "left" else -1.0
        for line, size, paint in (
            (f"{100.0 * share:.1f} % {side}", 8.0, darker(color)),
            *([(f"paper: {100.0 * paper().number(_STATED[stated]):.1f} %", 6.6, GREY)] if same else []),
        ):
            axes.annotate(
                line,
                (x, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(inward * 4.0, -4.0 if paint != GREY else -15.0),
                textcoords="offset points",
                ha=align,
                va="top",
                size=size,
                color=paint,
            )
    rows: list[Sequence[object]] = [
        ("bin", float(low), float(high), float(share))
        for low, high, share in zip(edges, edges[1:], shares, strict=False)
    ]
    rows += [("ours under 0.1", 0.0, _LOW, below), ("ours over 0.9", _HIGH, 1.0, above)]
    if same:
        rows += [("paper under 0.1", 0.0, _LOW, paper().number(_STATED["below"]))]
        rows += [("paper over 0.9", _HIGH, 1.0, paper().number(_STATED["above"]))]
    return Drawn(sheet.figure, ("what", "from", "to", "share"), rows)


def share_below(shares: np.ndarray, edge: float) -> float:
    """Sum the bins under an edge between two of them."""
    return float(shares[: _bins_to(edge)].sum())


def share_above(shares: np.ndarray, edge: float) -> float:
    """Sum the bins over an edge between two of them."""
    return float(shares[_bins_to(edge) :].sum())


def _bins_to(edge: float) -> int:
    n = round(edge * BINS)
    if abs(n - edge * BINS) > 1e-9:
        raise ValueError(f"edge is {edge}; it must lie between two of {BINS} bins")
    return n
