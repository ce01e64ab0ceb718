"""What claims rest on: the runs of a scene, how much seeds alone change them, and the verdicts that follow.

The variance of a quantity at a scale is pooled over all groups i (a row on a scene) that have several seeds j:

    s^2 = sum_ij (y_ij - mean_i)^2 / v,    v = sum_i (n_i - 1) degrees of freedom

A combination L = sum_i c_i mean_i of group means then has the interval L -+ t s sqrt(sum_i c_i^2 / n_i), in which n_i
may be 1, and t is the quantile 1 - alpha / (2 k) of Student's t with v degrees of freedom; k is the number of
comparisons that are made together. A claim holds on a scene when all its comparisons hold beyond that noise, and does
not when one of them fails beyond it; anything else is not decided. Over the scenes it does not hold when it does not on
one of them.

Source: contrasts of means in a one-way analysis of variance, NIST/SEMATECH e-Handbook of Statistical Methods, 7.4.3.6;
the division by k is Bonferroni's, 7.4.7.3 there.
Takes for granted: one variance for all groups of a scale, seeds that are independent, and nearly normal means. Counts,
times and entries a pixel are compared by their logarithms, because they vary in proportion to their size.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import exp, inf, log, sqrt
from statistics import fmean
from typing import Final, Literal, NamedTuple

from paper_repro.paper import Paper
from paper_repro.results import Result
from paper_repro.tables import setting

# the probability that any of the intervals that decide a claim at one scale and under one reading misses, at most
ALPHA: Final = 0.05
# with more seeds than these a difference is smaller than what anyone would train for
MOST_SEEDS: Final = 99
# a noise floor with one degree of freedom has intervals of ratios that no float holds
_LARGEST: Final = 700.0
Verdict = Literal["holds", "does not hold", "not decided"]
# of the paper's schedule
STEPS: Final = 30_000
# the scale whose runs decide what others leave open
JUDGE: Final = "small"
DATASETS: Final = ("Mip-NeRF 360", "Tanks & Temples", "Deep Blending")


@dataclass(frozen=True)
class Quantity:
    """Something that is compared between runs."""

    name: str  # for people
    # reads it off a run, on the scale on which it is compared; None where the run has none
    get: Callable[[Result], float | None]
    is_log: bool = False  # whether that is a natural logarithm


def _log(value: float | None) -> float | None:
    return log(value) if value is not None and value > 0.0 else None


PSNR: Final = Quantity("PSNR", lambda r: r.psnr)
SSIM: Final = Quantity("SSIM", lambda r: r.ssim)
COUNT: Final = Quantity("number of Gaussians", lambda r: _log(r.num_gaussians), is_log=True)
# a time by the clock of a CPU that may do other work is no measure of a method
SECONDS: Final = Quantity("time", lambda r: _log(r.training_seconds) if r.is_timed else None, is_log=True)
BLENDED: Final = Quantity("Gaussians blended a pixel", lambda r: _log(r.n_blended), is_log=True)
VISITED: Final = Quantity("Gaussians visited a pixel", lambda r: _log(r.n_traversed), is_log=True)
QUANTITIES: Final = (PSNR, SSIM, COUNT, SECONDS, BLENDED, VISITED)


@dataclass(frozen=True)
class Group:
    """The runs of one row on one scene, over their seeds."""

    runs: tuple[Result, ...]

    def values(self, quantity: Quantity) -> list[float]:
        """Read a quantity off the runs that have it."""
        return [value for r in self.runs if (value := quantity.get(r)) is not None]

    @property
    def n(self) -> float:
        """Gaussians: the geometric mean over the seeds, as they are compared by logarithms."""
        values = self.values(COUNT)
        return exp(fmean(values)) if len(values) == len(self.runs) else 0.0

    @property
    def psnr(self) -> float:
        """PSNR, dB."""
        return fmean(r.psnr for r in self.runs)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the runs."""
        return tuple(r.run for r in self.runs)


class Spread(NamedTuple):
    """The standard deviation over seeds, pooled."""

    s: float  # the standard deviation
    df: int  # its degrees of freedom
    groups: int  # how many pairs of row and scene have several seeds
    least: float  # the smallest standard deviation of one of them
    largest: float  # the largest
    scenes: tuple[str, ...]  # that they are of


class Noise:
    """The pooled spreads of one scale."""

    def __init__(self, groups: Iterable[Group]) -> None:
        """Pool over groups; those with one run, which has no spread, do not count."""
        self._groups = tuple(group for group in groups if len(group.runs) > 1)
        self._known: dict[str, Spread | None] = {}

    def of(self, quantity: Quantity) -> Spread | None:
        """Give the spread of a quantity, or None where no group has two values of it."""
        if quantity.name not in self._known:
            self._known[quantity.name] = self._pooled(quantity)
        return self._known[quantity.name]

    def _pooled(self, quantity: Quantity) -> Spread | None:
        squares, df, own, scenes = 0.0, 0, [], dict[str, None]()
        for group in self._groups:
            # times of two machines differ by more than their seeds
            apart = _by_machine(group.runs) if quantity is SECONDS else [group.runs]
            for values in (Group(tuple(runs)).values(quantity) for runs in apart):
                # counts that no seed changes are set by a budget, and say nothing of those that grow
                if len(values) > 1 and not (quantity is COUNT and min(values) == max(values)):
                    mean = fmean(values)
                    mine = sum((value - mean) ** 2 for value in values)
                    squares, df = squares + mine, df + len(values) - 1
                    own.append(sqrt(mine / (len(values) - 1)))
                    scenes[group.runs[0].scene] = None
        return Spread(sqrt(squares / df), df, len(own), min(own), max(own), tuple(scenes)) if own else None


def _by_machine(runs: Iterable[Result]) -> list[list[Result]]:
    found: dict[str, list[Result]] = {}
    for run in runs:
        found.setdefault(run.trained_on, []).append(run)
    return list(found.values())


@dataclass(frozen=True)
class Comparison:
    """A combination of group means, and what is asked of it."""

    says: str  # what is compared
    value: float  # the combination; a natural logarithm where `shown_as` is "share" or "factor"
    # "at least" or "at most" the bound, or "nothing" where the number is only told
    asked: Literal["at least", "at most", "nothing"]
    bound: float  # on the scale of `value`
    variance: float | None  # of one run of each group, sum_i c_i^2 s^2; None without a noise floor
    error: float | None  # standard error of `value` with the seeds that are there; None without a noise floor
    df: int  # degrees of freedom of the noise floor
    seeds: tuple[int, ...]  # how many runs each group has, the smallest first
    shown_as: Literal["dB", "share", "factor", "plain"]  # how the value is written

    @property
    def margin(self) -> float:
        """By how much the value has what is asked of it; negative where it has not."""
        return {"at least": 1.0, "at most": -1.0, "nothing": 0.0}[self.asked] * (self.value - self.bound)

    def half_width(self, together: int) -> float:
        """Give half of the interval's width where so many comparisons are made together; infinite without noise."""
        return inf if self.error is None else _quantile(self.df, together) * self.error

    def holds(self, together: int) -> bool | None:
        """Say whether what is asked is so; None where the interval has the bound inside, or nothing is asked."""
        off, half = self.margin, self.half_width(together)
        return None if off == 0.0 or abs(off) < half else off > 0.0

    def seeds_needed(self, together: int) -> int | None:
        """Say how many seeds of each group would decide it, if the difference that is measured is the true one.

        Returns:
            Their number, or None for more than `MOST_SEEDS`.
        """
        if self.variance is None:
            return max(3, self.seeds[-1])
        for n in range(max(self.seeds[0], 1) + 1, MOST_SEEDS + 1):
            df = self.df + sum(max(n - have, 0) for have in self.seeds)
            half = _quantile(df, together) * sqrt(self.variance / n)
            if half <= abs(self.value - self.bound):
                return n
        return None

    def text(self, together: int) -> str:
        """Write the value with its interval."""
        return f"{self.says} {self._value(self.half_width(together))}"

    @property
    def condition(self) -> str:
        """Write what is asked of the value, where the bound is another than no difference at all."""
        if self.asked == "nothing" or self.bound == 0.0:
            return ""
        form, unit = self._form
        is_ratio = self.shown_as in ("share", "factor")
        bound = self._ratio(self.bound) if is_ratio else f"{self.bound:{form}}{unit}"
        return f", where {self.asked} {bound} is asked"

    def _value(self, half: float) -> str:
        told = half < inf
        if self.shown_as in ("share", "factor"):
            ends = (self.value - half, min(self.value + half, _LARGEST))
            interval = f"({self._ratio(ends[0])} to {self._ratio(ends[1])})" if told else "(no interval)"
            return f"{self._ratio(self.value)} {interval}"
        form, unit = self._form
        return f"{self.value:{form}}" + (f" ± {half:.2g}{unit}" if told else f"{unit} (no interval)")

    @property
    def _form(self) -> tuple[str, str]:
        return ("+.2f", " dB") if self.shown_as == "dB" else ("+.4g", "")

    def _ratio(self, value: float) -> str:
        return f"{exp(value):.1%}" if self.shown_as == "share" else f"x {exp(value):.2f}"


def compare(
    says: str,
    groups: Mapping[str, Group],
    noise: Noise,
    quantity: Quantity,
    weights: Mapping[str, float],
    asked: Literal["at least", "at most", "nothing"] = "nothing",
    bound: float = 0.0,
    shown_as: Literal["dB", "share", "factor", "plain"] | None = None,
) -> Comparison | None:
    """Compare the means of groups.

    Args:
        says: what is compared.
        groups: by row.
        noise: of the scale.
        quantity: of which the means are.
        weights: of each row's mean in the combination.
        asked: what is asked of the combination.
        bound: on the scale of the quantity.
        shown_as: how it is written; None takes a share for what is compared by logarithms, dB for PSNR, else "plain".

    Returns:
        The comparison, or None where a row has no run, or a run lacks the quantity.
    """
    used = [groups[row] for row in weights if row in groups]
    values = [group.values(quantity) for group in used]
    if len(used) < len(weights) or any(len(v) < len(g.runs) for v, g in zip(values, used, strict=True)):
        return None
    pairs = list(zip(weights.values(), values, strict=True))
    value, parts = sum(c * fmean(v) for c, v in pairs), [(quantity, c, len(v)) for c, v in pairs]
    usual: Literal["dB", "share", "plain"] = "share" if quantity.is_log else "dB" if quantity is PSNR else "plain"
    return with_error(says, value, parts, noise, asked, bound, shown_as or usual)


def with_error(
    says: str,
    value: float,
    parts: Sequence[tuple[Quantity, float, int]],
    noise: Noise,
    asked: Literal["at least", "at most", "nothing"],
    bound: float,
    shown_as: Literal["dB", "share", "factor", "plain"],
) -> Comparison:
    """Give a value its error from the slopes by which it depends on group means.

    Args:
        says: what is compared.
        value: a function of group means.
        parts: of each mean, its quantity, the slope of the value along it, and the number of its runs.
        noise: of the scale.
        asked: what is asked of the value.
        bound: for the value.
        shown_as: how it is written.
    """
    spreads = [noise.of(quantity) for quantity, _, _ in parts]
    # a group has a mean of each quantity
    seeds = tuple(sorted(n for quantity, _, n in parts if quantity is parts[0][0]))
    known = [spread for spread in spreads if spread is not None]
    if len(known) < len(spreads):
        return Comparison(says, value, asked, bound, None, None, 0, seeds, shown_as)
    each = [(slope * spread.s) ** 2 for (_, slope, _), spread in zip(parts, known, strict=True)]
    error = sqrt(sum(v / n for v, (_, _, n) in zip(each, parts, strict=True)))
    df = min(spread.df for spread in known)
    return Comparison(says, value, asked, bound, sum(each), error, df, seeds, shown_as)


def _quantile(df: float, together: int) -> float:
    """Give Student's t that so many comparisons, made together, stay under with a probability of 1 - `ALPHA`."""
    # the rows and their queue are listed with NumPy alone
    from scipy.special import stdtrit

    return float(stdtrit(df, 1.0 - ALPHA / (2.0 * max(together, 1))))


Groups = Mapping[str, Mapping[str, Group]]


@dataclass(frozen=True)
class Evidence:
    """What one scene says."""

    scene: str  # where
    says: str  # the numbers, with their intervals
    verdict: Verdict  # of this scene
    why: str  # what keeps it from being decided; empty where it is
    under: str  # what the runs were trained with, as far as it bears on the claim
    runs: tuple[str, ...]  # ids of the runs
    # of what is asked, the number that is nearest to failing or fails by most, with its interval, and its bound where
    # that is not 0 or one to one
    nearest: str = ""
    # whether it has every run, or is decided without; a scene that is not counts as one that was not run
    is_whole: bool = True


@dataclass(frozen=True)
class Told:
    """A claim's verdict under one reading of the paper."""

    reading: str  # its name; empty for the default of every question
    verdict: Verdict  # over the scenes
    evidence: tuple[Evidence, ...]  # by scene
    deciders: tuple[str, ...]  # commands that train what would decide the scenes that are not
    enough: tuple[str, ...]  # the fewest of such commands that would decide the claim

    @property
    def where(self) -> str:
        """Say the verdict with its scenes."""
        by_verdict: dict[Verdict, list[str]] = {}
        for e in self.evidence:
            by_verdict.setdefault(e.verdict, []).append(e.scene)
        parts = [f"{verdict} on {', '.join(scenes)}" for verdict, scenes in sorted(by_verdict.items())]
        return "; ".join(parts) or "not decided: no scene has all its runs"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, and what the runs of one scale say."""

    id: str  # short, for tables and links
    says: str  # the claim
    paper: str  # the paper's own numbers for it
    holds_if: str  # what is asked of a scene
    told: Told  # under the default reading of every question
    others: tuple[Told, ...] = field(default=())  # under other readings for which there are runs

    @property
    def verdict(self) -> Verdict:
        """The verdict under the default readings."""
        return self.told.verdict

    @property
    def line(self) -> str:
        """Say the verdict with its scenes, and what becomes of it under other readings."""
        rest = "".join(f"; under {other.reading}: {other.where}" for other in self.others)
        return self.told.where + rest

    @property
    def under(self) -> str:
        """Say what its runs were trained with, by scene."""
        return "; ".join(f"{e.scene}: {e.under}" for e in self.told.evidence)


def verdict_over(verdicts: Iterable[Verdict]) -> Verdict:
    """Give the verdict over scenes that have the runs: one that fails is enough, one that is open keeps it open."""
    found = set(verdicts)
    if "does not hold" in found:
        return "does not hold"
    return "holds" if found == {"holds"} else "not decided"


def command(scale: str, rows: Iterable[str], scenes: Iterable[str], seeds: int, where: str = "") -> str:
    """Give the command that trains rows on scenes with so many seeds; what is finished of it is not trained again.

    `where` is the machine, engine and threads on which alone that decides something; empty where any would do.
    """
    words = f"pop-repro queue --scale {scale} --data DATA --rows {' '.join(rows)} --scenes {' '.join(scenes)}"
    # as `Result.trained_on` ends; without it a queue trains with one
    threads = re.search(r", (\d+) threads$", where)
    return (
        words
        + (f" --seeds {seeds}" if seeds > 1 else "")
        + (f" --threads {threads[1]}" if threads else "")
        + (f"  # on {where}" if where else "")
    )


def groups(results: Iterable[Result]) -> Groups:
    """Sort results of one scale by scene and row."""
    found: dict[str, dict[str, list[Result]]] = {}
    for r in results:
        found.setdefault(r.scene, {}).setdefault(r.row, []).append(r)
    return {
        scene: {row: Group(tuple(sorted(runs, key=lambda r: r.seed))) for row, runs in rows.items()}
        for scene, rows in sorted(found.items())
    }


def is_shortened(runs: Iterable[Result]) -> bool:
    """Say whether a run has fewer steps than the paper's schedule, or does not say how many."""
    return any((setting(r, "max_steps") or 0.0) < STEPS for r in runs)


def conditions(used: Sequence[Group]) -> str:
    """Say what else than the method bears on a comparison: image size, steps, the floor of theta_blur, and resets."""
    runs = [r for group in used for r in group.runs]
    sizes = sorted({f"{r.protocol['width']} x {r.protocol['height']} px" for r in runs})
    steps = sorted({int(s) for r in runs if (s := setting(r, "max_steps")) is not None})
    parts = [
        " and ".join(sizes),
        *([" to ".join(f"{s:,}" for s in dict.fromkeys((steps[0], steps[-1]))) + " steps"] if steps else []),
    ]
    parts += sorted({text for r in runs if (text := _theta(r))})
    parts += sorted({text for r in runs if (text := _resets(r))})
    return "; ".join(parts)


def _blur_window(run: Result) -> tuple[int, int] | None:
    """Give the steps of the blur rule of POP's strategy, or None where it never acts."""
    first, last = setting(run, "blur_start_iter"), setting(run, "blur_stop_iter")
    if run.schedule.get("method") != "pop" or first is None or last is None or last < first:
        return None
    return int(first), int(last)


def _theta(run: Result) -> str:
    share, least = setting(run, "theta_blur"), setting(run, "blur_min_pixels")
    if _blur_window(run) is None or share is None or least is None:
        return ""
    pixels = share * run.protocol["width"] * run.protocol["height"]
    if least <= pixels:
        return f"theta_blur {pixels:.1f} px, no floor"
    return f"theta_blur {least:g} px by its floor, {least / pixels:.1f} times the paper's {pixels:.1f} px at this size"


def _resets(run: Result) -> str:
    every, last = setting(run, "reset_every"), setting(run, "refine_stop_iter")
    if not every or last is None:
        return ""
    first = 0 if run.schedule.get(f"{run.schedule.get('method')}.reset_at_zero") else int(every)
    at = range(first, int(last), int(every))
    text, window = f"{run.row}: {len(at)} resets", _blur_window(run)
    if window is None:
        return text
    inside = sum(window[0] <= step <= window[1] for step in at)
    return f"{text}, {inside} of them inside the blur window {window[0]:,} to {window[1]:,}"


def paper_ratios(published: Paper, row: str, base: str) -> tuple[float, ...]:
    """Give N of a row over N of another in the paper's ablations, by data set."""
    return tuple(
        published.ablation(row, d, "num_gaussians_k") / published.ablation(base, d, "num_gaussians_k") for d in DATASETS
    )
