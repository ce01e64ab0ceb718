"""What a report shows, as plain values that `pop_fast.view.report.source` fills from the files of a result folder.

`verdict` says how the run went, in sentences with the numbers that they rest on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from pop_fast.data.capture import FAR_APART
from pop_fast.data.photo_quality import FEW
from pop_fast.train.automatic import LOOKS
from pop_fast.view.document import Window
from pop_fast.view.report.checks import Checks
from pop_ref.settings import Recipe

# training views are always matched better, dB
_SOME_OVERFITTING: Final = 3.0
_OVERFITTED: Final = 6.0
_ONE_VIEW: Final = 1.0  # dB that a single held-out view takes off the mean
_FELL: Final = 0.3  # dB between the best held-out measurement and the last
_DRIFT: Final = 0.15  # stops, standard deviation over the photographs
_ONE_OFF: Final = 0.35  # stops, of a single photograph
_FLOATERS: Final = 0.01  # of the pixels
_DEAR: Final = 0.2  # dB that held-out views may lose when floaters are left out
_VEIL: Final = 0.25  # of the pixels of a view, which is then hidden
_WON: Final = 0.5  # dB, by scaling each render to its photograph's brightness
# training views under it contradict one another, or were not trained on for long; dB
_FITS: Final = 22.0
_FITS_BADLY: Final = 19.0
_PARTS: Final = 0.006  # of a training view, on average: what does not fit where the rest does
_PARTS_BY_COLOUR: Final = 0.0025  # the same of patches that have another mean colour
_EPOCHS: Final = 30  # how often each photograph is to be seen
# the same before its detail is there: an object from 38 photographs had 25.6 dB after 45 times and 26.5 after 82, one
# next to which something moved 24.3 after 41 and 25.1 after 83
_EPOCHS_FOR_DETAIL: Final = 60
_LOST: Final = 0.1  # of the photographs, without a camera
# a run of too few steps is asked for again so many times as long at least, and so long that these are not few any more
_LONGER: Final = 3.0
_USUAL_MINUTES: Final = (1, 2, 3, 5, 10, 15, 20, 30, 45, 60, 90, 120, 180, 240, 360, 480, 720, 1440)

Kind = Literal["good", "look", "bad"]


@dataclass(frozen=True)
class Finding:
    """One sentence of the verdict."""

    kind: Kind  # whether it is as it should be, worth a look, or what spoils the result
    about: str  # what it is about, in a word or two
    text: str  # the sentence
    # what to type after `pop`, where it is not good; DATA is the capture and RESULT the result's folder
    next: tuple[str, ...] = ()


_CLOSE: Final = 25.0
# held-out PSNR from which a render is called so, dB
_GRADES: Final[tuple[tuple[float, Kind, str], ...]] = (
    (30.0, "good", "very close to the photographs"),
    (_CLOSE, "good", "close to the photographs"),
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
    psnr = stats.get("psnr") if checks is None else checks.judged_psnr
    # while exposures are learned, measurements without them fall for another reason
    course = None if checks is not None and checks.exposures_learned else held_out
    fewer = _fewer_steps(course)
    more = () if checks is None or fewer is not None else _more_steps(stats, checks, _EPOCHS)
    # where training views do not fit after as many, detail is not what is missing
    sharper = more if checks is None or checks.train_psnr < _FITS else _more_steps(stats, checks, _EPOCHS_FOR_DETAIL)
    found = [*_quality(psnr, checks, () if fewer is not None else sharper), *_course(course, fewer)]
    if checks is not None:
        found += [*_unfitting(checks, more), *_overfitting(checks, fewer, more), *_photographs(checks)]
        found += [*_exposure(checks, more), *_floating(checks)]
    return found


def _more_steps(stats: Mapping[str, Any], checks: Checks, looks: int) -> tuple[str, ...]:
    """Return the command for a longer training where each photograph was seen less often; empty where it was not.

    It says minutes where those of the run are known and the paper's schedule, which they never exceed, has more steps;
    else steps.
    """
    steps, enough = checks.steps or 0, looks * checks.photographs
    if not 0 < steps < enough:
        return ()
    longer, taken = max(_LONGER, enough / steps), stats.get("seconds_total")
    if not taken or longer * steps > Recipe.max_steps:
        return ("train", "DATA", "--steps-scaler", f"{longer * steps / Recipe.max_steps:.2g}")
    minutes = longer * taken / 60.0
    usual = next((usual for usual in _USUAL_MINUTES if usual >= minutes), 60 * math.ceil(minutes / 60.0))
    return ("train", "DATA", "--minutes", str(usual))


def _quality(psnr: float | None, checks: Checks | None, more: tuple[str, ...]) -> Iterator[Finding]:
    if psnr is None:
        return
    by_view, notes = {} if checks is None else checks.held_out, ""
    if checks is not None and checks.exposures_learned and checks.held_out_psnr is not None:
        notes += (
            " Each was scaled to its photograph's brightness, because exposures were learned for training views only; "
        )
        notes += f"{checks.held_out_psnr:.2f} dB without scaling."
    if len(by_view) > 1:
        worst = min(by_view, key=lambda name: by_view[name])
        rest = float(np.mean([value for name, value in by_view.items() if name != worst]))
        if rest - psnr >= _ONE_VIEW:
            notes += f" {worst} is the worst, {by_view[worst]:.2f} dB; the mean without it is {rest:.2f} dB."
    _, kind, words = next(grade for grade in _GRADES if psnr >= grade[0])
    next_: tuple[str, ...] = () if kind == "good" else ("data", "check", "DATA")
    # where the training views are hardly better, photographs are not what is missing
    if kind != "good" and checks is not None and more and _gap(checks) < _SOME_OVERFITTING:
        notes += f" The run had few steps, {(checks.steps or 0) / checks.photographs:.0f} a photograph."
        next_ = more
    text = f"Views that training never saw are {words}: {psnr:.2f} dB on average.{notes}"
    yield Finding(kind, "Quality", text, next_)


def _fewer_steps(held_out: tuple[Sequence[float], Sequence[float]] | None) -> float | None:
    """Give the share of the paper's schedule after which held-out views were best, if they fell since; else None."""
    if held_out is None or len(held_out[1]) < 2:
        return None
    steps, values = held_out
    best = int(np.argmax(values))
    return None if values[best] - values[-1] < _FELL else max(steps[best] / Recipe.max_steps, 1e-3)


def _course(held_out: tuple[Sequence[float], Sequence[float]] | None, fewer: float | None) -> Iterator[Finding]:
    if held_out is None or fewer is None:
        return
    steps, values = held_out
    best = int(np.argmax(values))
    text = (
        f"Held-out PSNR fell from {values[best]:.2f} dB after {steps[best]:,.0f} steps to {values[-1]:.2f} dB after "
        f"{steps[-1]:,.0f}: later steps fit only the training photographs. Use fewer steps, or more "
        "photographs."
    )
    yield Finding("bad", "Course", text, ("train", "DATA", "--steps-scaler", f"{fewer:.2g}"))


def _unfitting(checks: Checks, more: tuple[str, ...]) -> Iterator[Finding]:
    """Judge whether the training views fit: what training could not reach there is no question of views in between."""
    text = f"training views reach {checks.train_psnr:.2f} dB"
    if checks.train_psnr >= _FITS:
        yield _parts(checks, text)
        return
    short = " The run had few steps for it." if more else ""
    next_ = more or ("data", "check", "DATA")
    why = f"{text}.{short} A subject or a light that moved, or wrong cameras, make photographs contradict "
    why += "one another"
    yield Finding("bad" if checks.train_psnr < _FITS_BADLY else "look", "Fit", f"They do not all fit: {why}.", next_)


def _parts(checks: Checks, text: str) -> Finding:
    """Judge whether parts of the training views do not fit where the rest does."""
    shares, what = checks.misfits, "is far from its render where the rest is near"
    if _mean(shares) < _PARTS:
        shares, what = checks.patches, "has another colour than its render where the rest has the same"
        if _mean(shares) < _PARTS_BY_COLOUR:
            return Finding("good", "Fit", f"They fit together: {text}.")
    worst = max(shares, key=lambda name: shares[name])
    why = (
        f"They fit except for parts: {text}; {100.0 * _mean(shares):.1f} % of a photograph {what}, most in {worst}, "
        f"{100.0 * shares[worst]:.1f} %. Something moved, or reflects something that did. "
        "A mask excludes it: masks/NAME.png for photograph NAME, black where it moved, white elsewhere."
    )
    return Finding("look", "Fit", why, ("data", "check", "DATA"))


def _mean(by_view: Mapping[str, float]) -> float:
    return float(np.mean(list(by_view.values()))) if by_view else 0.0


def _gap(checks: Checks) -> float:
    return 0.0 if checks.judged_psnr is None else checks.train_psnr - checks.judged_psnr


def _is_close(checks: Checks) -> bool:
    """Tell whether held-out views are called close to the photographs: no other finding calls them missed then."""
    return checks.judged_psnr is not None and checks.judged_psnr >= _CLOSE


def _overfitting(checks: Checks, fewer: float | None, more: tuple[str, ...]) -> Iterator[Finding]:
    if checks.held_out_psnr is None:
        text = "No view was held out, so nothing measures the views between the photographs."
        yield Finding("look", "Overfitting", text, ("train", "DATA", "--test-every", "8"))
        return
    gap = _gap(checks)
    numbers = f"training views {checks.train_psnr:.2f} dB, held-out views {checks.judged_psnr:.2f} dB"
    numbers += f", {abs(gap):.1f} dB apart"
    if gap < _SOME_OVERFITTING:
        if checks.train_psnr < _FITS:
            # little of it says nothing good where the training views are missed as well
            text = f"Not the problem here: {numbers}, both low."
            yield Finding("look", "Overfitting", text, more or ("data", "check", "DATA"))
            return
        yield Finding("good", "Overfitting", f"Little: {numbers}.")
        return
    some = gap < _OVERFITTED or _is_close(checks)
    text = f"{'Some' if gap < _OVERFITTED else 'Much'}: {numbers}."
    if gap >= _OVERFITTED:
        less = "less well, though close" if _is_close(checks) else "little"
        text += f" The splat has memorised its photographs and fits the views in between {less}."
    # no two findings send to schedules of two lengths
    steps = checks.steps or Recipe.max_steps
    if fewer is None and steps <= LOOKS * checks.photographs:
        text += f" The schedule is already short, {steps / checks.photographs:.0f} steps a photograph."
        yield Finding("look" if some else "bad", "Overfitting", text, ("data", "check", "DATA"))
        return
    scaler = fewer or max(steps / 2.0, LOOKS * checks.photographs) / Recipe.max_steps
    yield Finding("look" if some else "bad", "Overfitting", text, ("train", "DATA", "--steps-scaler", f"{scaler:.2g}"))


def _photographs(checks: Checks) -> Iterator[Finding]:
    """Judge count and spacing against the gap that was found: what leaves a wide one is not enough.

    Photographs without a camera are none, and are said where they are a tenth of those that were given.
    """
    n, apart, gap = checks.photographs, checks.neighbour_degrees, _gap(checks)
    spacing = "" if apart is None else f", neighbours {apart:.1f} degrees apart as seen from the subject (median)"
    few, far = n < FEW, apart is not None and apart > FAR_APART
    missing = gap >= _OVERFITTED
    given, placed = checks.given or n, checks.placed or n
    kind: Kind
    next_: tuple[str, ...]
    lost = given - placed >= _LOST * given
    found = f"Cameras were found for {placed} of {given} photographs. " if lost else ""
    if not few and not far and not missing:
        kind, next_ = ("look", ("data", "check", "DATA")) if lost else ("good", ())
        yield Finding(kind, "Photographs", f"{found}{n} trained on{spacing}: enough.", next_)
        return
    close = _is_close(checks)
    why = "few" if few else "far apart" if far else ""
    why = why or f"not {'quite ' if close else ''}enough for this subject, as the gap of {gap:.1f} dB shows"
    kind = "look"
    if gap >= _SOME_OVERFITTING and not close:
        kind, why = "bad", f"too {why}" if few or far else why
    # where few stand close together, what is missing is not between them
    wanted = "Photographs between these" if far or missing else "More photographs, also from other sides,"
    text = f"{found}{n} trained on{spacing}: {why}. {wanted} would help most."
    yield Finding(kind, "Photographs", text, ("data", "check", "DATA"))


def _exposure(checks: Checks, more: tuple[str, ...]) -> Iterator[Finding]:
    if len(checks.stops) < 2:
        return
    names, values = list(checks.stops), np.array(list(checks.stops.values()))
    spread, low, high = float(values.std()), int(values.argmin()), int(values.argmax())
    ends = f"{values[low]:+.2f} ({names[low]}) to {values[high]:+.2f} stops ({names[high]})"
    matched, measured = checks.matched_psnr, checks.held_out_psnr
    won = 0.0 if matched is None or measured is None else matched - measured
    if spread < _DRIFT and np.abs(values).max() < _ONE_OFF and won < _WON:
        text = f"Even: photographs differ from the splat by {ends}, standard deviation {spread:.2f}."
        yield Finding("good", "Exposure", text)
        return
    differ = f"photographs differ from the splat by {ends}, standard deviation {spread:.2f}."
    gain = ""
    if matched is not None and measured is not None:
        gain = f" Scaling each held-out render to its photograph's brightness gives {matched:.2f} dB instead "
        gain += f"of {measured:.2f}."
    if checks.exposures_learned:
        text = f"Learned for each training photograph: {differ}{gain}"
        yield Finding("good", "Exposure", text)
        return
    if more and checks.train_psnr < _FITS:
        # a render without its detail is as far from a photograph's brightness as another exposure would be
        text = f"Not to be told yet, as the run had few steps: {differ}{gain}"
        yield Finding("look", "Exposure", text, more)
        return
    what = "It drifts" if spread >= _DRIFT or won >= _WON else "Even, except for some"
    text = f"{what}: {differ}{gain}"
    text += " Lock exposure and white balance next time; for these photographs, learn each exposure."
    yield Finding("bad" if spread > 2.0 * _DRIFT else "look", "Exposure", text, ("train", "DATA", "--exposure"))


def _floating(checks: Checks) -> Iterator[Finding]:
    """Judge what covers views that are photographs, and those of the turn in between."""
    shares = {**checks.floaters, **checks.orbit_floaters}
    if not shares:
        return
    names, values = list(shares), np.array(list(shares.values()))
    worst = int(values.argmax())
    what = "of the pixels show floaters, Gaussians nearer to the camera than half the distance of its nearest points"
    n = len(checks.floaters)
    where = "one photograph's view" if n == 1 else f"{n} photographs' views"
    looked = f" (looked for in {where} and {len(checks.orbit_floaters)} of the orbit)"
    if values.max() < _FLOATERS:
        text = f"{100.0 * values.mean():.2f} % {what}; at most {100.0 * values[worst]:.2f} % of a view{looked}."
        yield Finding("good", "Floaters", text)
        return
    text = f"{100.0 * values.mean():.1f} % {what}; worst {names[worst]}, {100.0 * values[worst]:.1f} %{looked}."
    judged, without = checks.judged_psnr, checks.without_floaters
    then = ""
    if judged is not None and without is not None:
        then = f"held-out views have {without:.2f} dB instead of {judged:.2f}"
        then = then if abs(judged - without) >= 0.005 else f"held-out views keep their {judged:.2f} dB"
    if judged is not None and without is not None and judged - without > _DEAR:
        text += " They represent something in the photographs, such as things that moved or light that changed: "
        text += f"without them {then}."
        yield Finding("look", "Floaters", text, ("data", "check", "DATA"))
        return
    few = float(values.mean()) < _FLOATERS and values.max() < _VEIL
    covered = [name for name, share in checks.orbit_floaters.items() if share >= _VEIL]
    if covered:
        hidden = f"one view between the photographs, {covered[0]}"
        if len(covered) > 1:
            hidden = f"{len(covered)} views between the photographs, as in {covered[0]}"
        text += f" A veil hides much of {hidden}."
    text += " Leaving out those whose centres are there removes part of it" + (f"; {then}." if then else ".")
    text += " The command also removes Gaussians that reach in from outside the pictures, and tunes the rest."
    fix = ("export", "RESULT", "--to", "html", "--without-floaters")
    yield Finding("look" if few else "bad", "Floaters", text, fix)


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
    """All that the page shows."""

    title: str  # the result's name
    subtitle: str  # method, capture, date: one line
    headline: Sequence[Tile]  # the tiles at the top
    # name -> (iterations, values); names are those of `pop_fast.view.report.page`
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    max_steps: int  # iterations of the whole run
    windows: Sequence[Window] = field(default_factory=tuple)  # shaded stretches of the schedule
    resets: Sequence[int] = field(default_factory=tuple)  # iterations of opacity resets
    # opacities at the start, in the middle, at the end
    histograms: Sequence[Histogram] = field(default_factory=tuple)
    # a view's dominant ids and its render, when they were kept
    dominant: tuple[str, np.ndarray, np.ndarray] | None = None
    views: Sequence[ReportView] = field(default_factory=tuple)  # held-out views, the worst first
    n_held_out: int | None = None  # how many held-out views were measured
    config: Mapping[str, Any] = field(default_factory=dict)  # setting -> value, in reading order
    # one mapping a densification step or reset
    changes: Sequence[Mapping[str, Any]] = field(default_factory=tuple)
    # a row a file format: name, size, bytes a Gaussian, share of the PLY's size, PSNR
    files: Sequence[Sequence[str]] = field(default_factory=tuple)
    viewer: str | None = None  # the page that shows the splat
    verdict: Sequence[Finding] = field(default_factory=tuple)  # how it went, in sentences
    checked: bool = False  # whether what the verdict needs was measured
    # a video of a turn about the scene, and what it is called in the folder
    orbit: tuple[str, bytes] | None = None
    commands: Sequence[tuple[str, str]] = field(default_factory=tuple)  # what was typed, and in which folder
    # files of the folder that are worth opening: name, path in the folder, size in bytes
    links: Sequence[tuple[str, str, int]] = field(default_factory=tuple)
