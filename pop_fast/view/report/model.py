"""What a report shows: plain values, filled by `pop_fast.view.report.source` from the files of a result folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pop_fast.view.report.curves import Window
from pop_fast.view.report.verdict import Finding


@dataclass(frozen=True)
class Tile:
    """One number of the headline: what it is, its value, its unit, and a remark in small letters."""

    label: str
    value: str
    unit: str = ""
    note: str = ""


@dataclass(frozen=True)
class Histogram:
    """Opacities of all Gaussians at one moment: counts over equal bins of [0, 1]."""

    title: str
    counts: np.ndarray

    @property
    def shares(self) -> np.ndarray:
        """Give each bin's share of all Gaussians; zeros when there are none."""
        return self.counts / max(int(self.counts.sum()), 1)

    def share_between(self, low: float, high: float) -> float:
        """Give the share of Gaussians whose opacity lies in [low, high); the bounds must be bin edges."""
        n = len(self.counts)
        return float(self.shares[round(low * n) : round(high * n)].sum())


@dataclass(frozen=True)
class ReportView:
    """One held-out view: what was rendered, what was photographed, how far they are apart. uint8 RGB.

    `depth` is in units of the capture, NaN where nothing is, perhaps smaller than the picture. [H', W']
    """

    name: str
    render: np.ndarray
    photo: np.ndarray
    psnr: float | None = None
    ssim: float | None = None
    depth: np.ndarray | None = None


@dataclass(frozen=True)
class ReportData:
    """All that the page shows.

    Attributes:
        title: the result's name.
        subtitle: method, capture, date: one line.
        headline: the tiles at the top.
        curves: name -> (iterations, values); names are those of `pop_fast.view.report.page`.
        max_steps: iterations of the whole run.
        windows: shaded stretches of the schedule.
        resets: iterations of opacity resets.
        histograms: opacities at the start, in the middle, at the end.
        dominant: a view's dominant ids and its render, when they were kept.
        views: held-out views, the worst first.
        n_held_out: how many held-out views were measured.
        config: setting -> value, in reading order.
        changes: one mapping a densification step or reset.
        files: a row a file format: name, size, bytes a Gaussian, share of the PLY's size, PSNR.
        viewer: the page that shows the splat.
        verdict: how it went, in sentences.
        checked: whether what the verdict needs was measured.
        orbit: a video of a turn about the scene, and what it is called in the folder.
        commands: what was typed, and in which folder.
        links: files of the folder that are worth opening: name, path in the folder, size in bytes.
    """

    title: str
    subtitle: str
    headline: Sequence[Tile]
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    max_steps: int
    windows: Sequence[Window] = field(default_factory=tuple)
    resets: Sequence[int] = field(default_factory=tuple)
    histograms: Sequence[Histogram] = field(default_factory=tuple)
    dominant: tuple[str, np.ndarray, np.ndarray] | None = None
    views: Sequence[ReportView] = field(default_factory=tuple)
    n_held_out: int | None = None
    config: Mapping[str, Any] = field(default_factory=dict)
    changes: Sequence[Mapping[str, Any]] = field(default_factory=tuple)
    files: Sequence[Sequence[str]] = field(default_factory=tuple)
    viewer: str | None = None
    verdict: Sequence[Finding] = field(default_factory=tuple)
    checked: bool = False
    orbit: tuple[str, bytes] | None = None
    commands: Sequence[tuple[str, str]] = field(default_factory=tuple)
    links: Sequence[tuple[str, str, int]] = field(default_factory=tuple)
