"""What the runs say of other readings of the paper (A2, A12, A16), and of two experiments (E2, E4).

A reading is known by what it does to the number of Gaussians: at which rate per 1,000 steps N falls from the end of the
blur window to the end of density control. The paper's tables imply that rate; the reading that comes nearest to it, on
the scenes where all were run, is named. On photographs that are not the paper's this is evidence, not proof.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import exp, log
from statistics import fmean
from typing import Final, NamedTuple

from paper_repro.claims_page import telling
from paper_repro.evidence import STEPS, Group, groups, paper_ratios
from paper_repro.paper import Paper, paper
from paper_repro.results import Result
from paper_repro.table_markdown import grid
from paper_repro.tables import setting

__all__ = ["READINGS", "Answer", "Reading", "answers", "experiments", "implied_rates", "markdown"]


@dataclass(frozen=True)
class Reading:
    """An open question of the paper with a row for each reading, the default first."""

    id: str
    asks: str
    rows: tuple[str, ...]


@dataclass(frozen=True)
class Answer:
    """What the runs say of one question.

    Attributes:
        id: of the question.
        asks: the question.
        says: the answer in a sentence.
        head: of its table.
        lines: by scene and row.
    """

    id: str
    asks: str
    says: str
    head: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]


READINGS: Final = (
    Reading("A2", "over what is a dominant count cumulative in the blur rule?", ("pop", "pop_any_view")),
    Reading("A2, added up", "or are the counts of several views added up?", ("pop", "pop_sum")),
    Reading("A12", "does the POP term sum over all Gaussians or over visible ones?", ("pop", "pop_visible")),
    Reading("A16", "are oversized Gaussians pruned although there is no reset?", ("pop", "pop_size_prune")),
)
# the paper's schedule: the blur rule ends, density control and the POP term end
_BLUR_STOP, _DENSITY_STOP = 7_000, 15_000
_HEAD: Final = ("scale", "scene", "row", "N as the window closes", "left", "rate", "N", "of L2+Blur's", "PSNR", "runs")
# L2+Blur under two readings of A2, the default first
_GROWN: Final = ("l2_blur", "l2_blur_any_view")
# the rows of E4: pruning harder at the paper's weight, in place of a tenfold weight
_PRUNED: Final = ("final_prune", "pop_prune_002")


def answers(results: Iterable[Result]) -> tuple[Answer, ...]:
    """Answer the questions about readings from the results of all scales, the paper's scale first where it decides."""
    found = list(results)
    return tuple(_answer(reading, found) for reading in READINGS)


def experiments(results: Iterable[Result]) -> tuple[Answer, ...]:
    """Answer E2, E4, and A2 without the prior, from the results of all scales."""
    found = list(results)
    return _longer_schedules(found), _pruned_harder(found), _growth(found)


def markdown(found: Sequence[Answer]) -> str:
    """Render answers: the question, what is said, the numbers."""
    parts = []
    for answer in found:
        parts.append(f"### {answer.id}: {answer.asks}\n\n{answer.says}")
        if answer.lines:
            parts.append(grid(answer.head, answer.lines))
    return "\n\n".join(parts)


def _answer(reading: Reading, results: Sequence[Result]) -> Answer:
    lines: list[tuple[str, ...]] = []
    distances: dict[str, list[float]] = {row: [] for row in reading.rows}
    scenes = []
    goal = exp(fmean(log(rate) for rate in implied_rates(paper())))
    for scale in _telling(results):
        for scene, rows in groups(r for r in results if r.scale == scale).items():
            present = [row for row in reading.rows if row in rows]
            if len(present) < 2:
                continue
            lines += [_line(scale, scene, row, rows) for row in present]
            rates = {row: _rate(rows[row]) for row in reading.rows if row in rows}
            known = {row: rate for row, rate in rates.items() if rate is not None}
            if set(known) == set(reading.rows):
                scenes.append(f"{scene} ({scale})")
                for row, rate in known.items():
                    distances[row].append(abs(rate - goal))
    says = "Not decided: no scene has a run of every reading."
    if scenes:
        nearest = min(reading.rows, key=lambda row: fmean(distances[row]))
        kind = "the default" if nearest == reading.rows[0] else "not the default"
        says = (
            f"Nearest to the paper's {goal:.3f} per 1,000 steps (the mean of what its tables imply) is `{nearest}`, "
            f"{kind}, on {', '.join(scenes)}."
        )
    return Answer(reading.id, reading.asks, says, _HEAD, tuple(lines))


def _growth(results: Sequence[Result]) -> Answer:
    """A2 without the prior: by what the blur rule multiplies the Gaussians under either reading."""
    lines: list[tuple[str, ...]] = []
    factors: dict[str, list[float]] = {row: [] for row in _GROWN}
    goal = paper_ratios(paper(), "l2_blur", "l2")
    for scale in _telling(results):
        for scene, rows in groups(r for r in results if r.scale == scale).items():
            if "l2" not in rows:
                continue
            found = {row: rows[row].n / rows["l2"].n for row in _GROWN if row in rows}
            for row, factor in found.items():
                runs = (*rows[row].ids, *rows["l2"].ids)
                lines.append((scale, scene, row, f"{rows[row].n:,.0f}", f"x {factor:.2f}", ", ".join(runs)))
            if len(found) == len(_GROWN):
                for row, factor in found.items():
                    factors[row].append(abs(log(factor) - fmean(map(log, goal))))
    printed = ", ".join(f"x {factor:.2f}" for factor in goal)
    says = "Not decided: no scene has L2 and both readings of L2+Blur."
    if factors[_GROWN[0]]:
        nearest = min(_GROWN, key=lambda row: fmean(factors[row]))
        says = f"Nearest to the paper's factors ({printed}) is `{nearest}`."
    head = ("scale", "scene", "row", "N", "of L2's", "runs")
    return Answer(
        "A2, without the prior", "by what does the blur rule multiply the Gaussians?", says, head, tuple(lines)
    )


def _telling(results: Sequence[Result]) -> list[str]:
    """List the scales that say something about a method, the paper's first: those of a made-up scene do not."""
    return [scale for scale in telling() if any(r.scale == scale for r in results)]


def _rate(group: Group) -> float | None:
    found = [seen for run in group.runs if (seen := _decay(run)) is not None]
    return fmean(seen.rate for seen in found) if found else None


def _line(scale: str, scene: str, row: str, rows: Mapping[str, Group]) -> tuple[str, ...]:
    group = rows[row]
    found = [seen for run in group.runs if (seen := _decay(run)) is not None]
    blur = rows.get("l2_blur")
    return (
        *(scale, scene, row),
        *(
            (f"{fmean(f.closing for f in found):,.0f}", f"{fmean(f.kept for f in found):.1%}", f"{_rate(group):.3f}")
            if found
            else ("no curve",) * 3
        ),
        f"{group.n:,.0f}",
        f"{group.n / blur.n:.1%}" if blur is not None else "l2_blur not run",
        f"{group.psnr:.2f}",
        ", ".join(group.ids),
    )


def _longer_schedules(results: Sequence[Result]) -> Answer:
    """E2: what POP does to N and PSNR on schedules of several lengths, by its weight."""
    lines: list[tuple[str, ...]] = []
    lengths: dict[tuple[str, float], set[float]] = {}
    for scale in _telling(results):
        for scene, rows in groups(r for r in results if r.scale == scale).items():
            if "pop" not in rows or "l2_blur" not in rows:
                continue
            pop, blur = rows["pop"], rows["l2_blur"]
            steps, weight = setting(pop.runs[0], "max_steps"), setting(pop.runs[0], "lambda_pop")
            if steps is None or weight is None:
                continue
            lengths.setdefault((scene, weight), set()).add(steps)
            shown = f"{steps:,.0f}", f"{weight:g}", f"{pop.n / blur.n:.1%}", f"{pop.psnr - blur.psnr:+.2f} dB"
            lines.append((scale, scene, *shown, ", ".join((*pop.ids, *blur.ids))))
    head = ("scale", "scene", "steps", "weight", "N(pop) / N(l2_blur)", "PSNR", "runs")
    several = sorted({scene for (scene, _), steps in lengths.items() if len(steps) > 1})
    if not several:
        says = "Not decided: one weight has to be run on two lengths of the schedule of one scene."
    else:
        weights = {weight for _, weight in lengths}
        says = f"One weight on several lengths of the schedule of {', '.join(several)}, below." + (
            "" if len(weights) > 1 else " No row divides the weight by the scaler, so that rule is not judged here."
        )
    return Answer(
        "E2", "does the weight of the POP term have to grow when the schedule shrinks?", says, head, tuple(lines)
    )


def _pruned_harder(results: Sequence[Result]) -> Answer:
    """E4: what pruning harder at the paper's weight does."""
    lines: list[tuple[str, ...]] = []
    for scale in _telling(results):
        for scene, rows in groups(r for r in results if r.scale == scale).items():
            for row in (row for row in _PRUNED if row in rows and "pop" in rows):
                pop, pruned, base = rows["pop"], rows[row], rows.get("gsplat")
                shown = f"{pruned.n / pop.n:.1%}", f"{pruned.psnr - pop.psnr:+.2f} dB"
                share = f"{pruned.n / base.n:.1%}" if base is not None else "gsplat not run"
                lines.append((scale, scene, row, *shown, share, ", ".join((*pruned.ids, *pop.ids))))
    head = ("scale", "scene", "row", "N of POP's", "PSNR less POP's", "N of gsplat's", "runs")
    says = (
        "Pruning harder at the paper's weight, below." if lines else "Not decided: no scene has POP and a harder prune."
    )
    return Answer("E4", "how compact is POP at the paper's weight if more is pruned?", says, head, tuple(lines))


class _Decay(NamedTuple):
    """What became of N from the end of the blur window to the end of density control.

    Attributes:
        closing: N as the blur window closes.
        kept: the share of it that is left as density control ends.
        steps: from the one to the other.
    """

    closing: float
    kept: float
    steps: int

    @property
    def rate(self) -> float:
        """The rate per 1,000 steps: a shortened schedule scales neither learning rates nor the weight of the prior."""
        return -log(self.kept) / (self.steps / 1000)


def _decay(run: Result) -> _Decay | None:
    """Read the decay of N off the curve of a run, or None without a curve."""
    steps = setting(run, "max_steps") or float(STEPS)
    closes = setting(run, "blur_stop_iter") or steps * _BLUR_STOP / STEPS
    ends = setting(run, "refine_stop_iter") or steps * _DENSITY_STOP / STEPS
    closing, left = run.at(round(closes)), run.at(round(ends))
    if closing is None or left is None or min(closing, left) <= 0.0 or ends <= closes:
        return None
    return _Decay(closing, left / closing, round(ends) - round(closes))


def implied_shares(published: Paper) -> tuple[float, ...]:
    """Give what the paper's tables imply to be left at step 15,000 of N(7,000), by data set.

    A window that lasts until density control ends shows the count at which the blur rule saturates; a shorter one
    reaches about as much, and POP takes it down from there.
    """
    return paper_ratios(published, "pop", "blur_3k_15k")


def implied_rates(published: Paper) -> tuple[float, ...]:
    """Give the rates of decay per 1,000 steps that `implied_shares` comes to, by data set."""
    return tuple(_Decay(1.0, share, _DENSITY_STOP - _BLUR_STOP).rate for share in implied_shares(published))
