"""What a report shows, as plain values that `pop_fast.view.report.source` fills from the files of a result folder.

`verdict` says how the run went, in sentences with the numbers that they rest on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from pop_fast.view.report.checks import Checks
from pop_fast.view.report.curves import Window

# training views are always matched better, dB
_SOME_OVERFITTING: Final = 3.0
_OVERFITTED: Final = 6.0
_FELL: Final = 0.3  # dB between the best held-out measurement and the last
_FEW: Final = 20
_FAR_APART: Final = 15.0  # degrees between neighbouring cameras
_DRIFT: Final = 0.15  # stops, standard deviation over the photographs
_ONE_OFF: Final = 0.35  # stops, of a single photograph
_FLOATERS: Final = 0.01  # of the pixels

Kind = Literal["good", "look", "bad"]


@dataclass(frozen=True)
class Finding:
    """One sentence of the verdict.

    Attributes:
        kind: whether it is as it should be, worth a look, or what spoils the result.
        about: what it is about, in a word or two.
        text: the sentence.
    """

    kind: Kind
    about: str
    text: str


# held-out PSNR from which a render is called so, dB
_GRADES: Final[tuple[tuple[float, Kind, str], ...]] = (
    (30.0, "good", "very close to the photographs"),
    (25.0, "good", "close to the photographs"),
    (20.0, "look", "recognisable, with much of the detail lost"),
    (-1e9, "bad", "far from the photographs"),
)


def verdict(
    stats: Mapping[str, Any], checks: Checks | None, held_out: tuple[Sequence[float], Sequence[float]] | None
) -> list[Finding]:
    """Say how a run went.

    Args:
        stats: of the last step; `psnr` is read.
        checks: what was measured of the splat, or None where nothing was.
        held_out: steps and PSNR of the held-out views during the run, or None.
    """
    # what was measured last: of a run that was stopped, statistics are of an earlier step
    psnr = stats.get("psnr") if checks is None else checks.held_out_psnr
    found = list(_quality(psnr))
    found += _course(held_out)
    if checks is not None:
        found += [*_overfitting(checks), *_photographs(checks), *_exposure(checks), *_floating(checks)]
    return found


def _quality(psnr: float | None) -> Iterator[Finding]:
    if psnr is None:
        return
    _, kind, words = next(grade for grade in _GRADES if psnr >= grade[0])
    yield Finding(kind, "Quality", f"Views that training never saw are {words}: {psnr:.2f} dB on average.")


def _course(held_out: tuple[Sequence[float], Sequence[float]] | None) -> Iterator[Finding]:
    if held_out is None or len(held_out[1]) < 2:
        return
    steps, values = held_out
    best = int(np.argmax(values))
    if values[best] - values[-1] < _FELL:
        return
    yield Finding(
        "bad",
        "Course",
        f"Held-out PSNR fell from {values[best]:.2f} dB after {steps[best]:,.0f} steps to {values[-1]:.2f} dB after "
        f"{steps[-1]:,.0f}: what was learned since fits the training photographs alone. Fewer steps "
        f"(--steps-scaler), or more photographs.",
    )


def _overfitting(checks: Checks) -> Iterator[Finding]:
    if checks.held_out_psnr is None:
        text = "No view was held out, so that nothing says how views between the photographs look; --test-every 8 does."
        yield Finding("look", "Overfitting", text)
        return
    gap = checks.train_psnr - checks.held_out_psnr
    numbers = f"training views {checks.train_psnr:.2f} dB, held-out views {checks.held_out_psnr:.2f} dB"
    if gap < _SOME_OVERFITTING:
        yield Finding("good", "Overfitting", f"Little: {numbers}, {gap:.1f} dB apart.")
    elif gap < _OVERFITTED:
        yield Finding("look", "Overfitting", f"Some: {numbers}, {gap:.1f} dB apart.")
    else:
        text = f"Much: {numbers}, {gap:.1f} dB apart. The splat knows its photographs by heart and little in between."
        yield Finding("bad", "Overfitting", text)


def _photographs(checks: Checks) -> Iterator[Finding]:
    n, apart = checks.photographs, checks.neighbour_degrees
    gap = 0.0 if checks.held_out_psnr is None else checks.train_psnr - checks.held_out_psnr
    spacing = "" if apart is None else f", neighbours {apart:.1f} degrees apart as the subject sees them (median)"
    few, far = n < _FEW, apart is not None and apart > _FAR_APART
    if not few and not far:
        yield Finding("good", "Photographs", f"{n} trained on{spacing}: enough.")
        return
    why = "few" if few else "far apart"
    kind: Kind = "look"
    if gap >= _SOME_OVERFITTING:
        kind, why = "bad", f"too {why}"
    yield Finding(kind, "Photographs", f"{n} trained on{spacing}: {why}. Photographs between these would help most.")


def _exposure(checks: Checks) -> Iterator[Finding]:
    if len(checks.stops) < 2:
        return
    names, values = list(checks.stops), np.array(list(checks.stops.values()))
    spread, low, high = float(values.std()), int(values.argmin()), int(values.argmax())
    ends = f"{values[low]:+.2f} ({names[low]}) to {values[high]:+.2f} stops ({names[high]})"
    if spread < _DRIFT and np.abs(values).max() < _ONE_OFF:
        text = f"Even: photographs differ from the splat by {ends}, standard deviation {spread:.2f}."
        yield Finding("good", "Exposure", text)
        return
    gain = ""
    if checks.matched_psnr is not None and checks.held_out_psnr is not None:
        gain = (
            f" Scaling each held-out render to its photograph's brightness gives {checks.matched_psnr:.2f} dB instead "
            f"of {checks.held_out_psnr:.2f}."
        )
    what = "It drifts" if spread >= _DRIFT else "Even, but for some"
    text = f"{what}: photographs differ from the splat by {ends}, standard deviation {spread:.2f}.{gain}"
    yield Finding("bad" if spread > 2.0 * _DRIFT else "look", "Exposure", f"{text} Lock exposure and white balance.")


def _floating(checks: Checks) -> Iterator[Finding]:
    if not checks.floaters:
        return
    names, shares = list(checks.floaters), np.array(list(checks.floaters.values()))
    worst = int(shares.argmax())
    what = "of the pixels show floaters, Gaussians nearer to the camera than half the distance of its nearest points"
    if shares.max() < _FLOATERS:
        text = f"{100.0 * shares.mean():.2f} % {what}; at most {100.0 * shares[worst]:.2f} % of a view."
        yield Finding("good", "Floaters", text)
        return
    few = float(shares.mean()) < _FLOATERS
    text = f"{100.0 * shares.mean():.1f} % {what}; worst {names[worst]}, {100.0 * shares[worst]:.1f} %."
    fix = " pop explain shows which Gaussians these are; pop export --crop leaves out what lies outside a box."
    yield Finding("look" if few else "bad", "Floaters", text + fix)


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
