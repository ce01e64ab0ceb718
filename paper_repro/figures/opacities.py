"""Figure 2: the opacities of a 3DGS model, with the shares that are nearly transparent and nearly opaque."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from paper_repro.figures.data import Asked, choose_one_scene
from paper_repro.figures.foot import foot
from paper_repro.figures.sheet import Drawn, Margins, Sheet
from paper_repro.figures.style import GREY, color_of, count, darker
from paper_repro.paper import paper
from paper_repro.record import BINS

_LOW, _HIGH = 0.1, 0.9
# the capture of the paper's figure
_SCENE: Final = "kitchen"
# the shares that the paper states, by their ids in paper.toml
_STATED: Final = {"below": "kitchen_frac_opacity_lt_0.1", "above": "kitchen_frac_opacity_gt_0.9"}
_LOW_COLOR, _HIGH_COLOR, _PLAIN = color_of("gsplat"), color_of("pop"), "#b9b9b9"


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
    axes = sheet.panel(Margins(right=0.1, top=0.12))
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
