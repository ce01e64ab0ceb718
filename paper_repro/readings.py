"""What the runs say of other readings of the paper (A2, A12, A16), and of two experiments (E2, E4).

A reading is judged by every column of the paper's tables that its runs reach: for each pair of rows of one table N over
N, the difference of PSNR and that of SSIM, and the growth a densification step between the windows of table 4. A column
speaks for the reading whose value lies nearer to the range of the paper's three data sets; within it both are alike. A
reading is named when more columns speak for it than against it, and still so without any one pair of rows: a claim
rests on one pair, so that no claim decides the reading under which it is then judged. On photographs that are not the
paper's this is evidence, not proof.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from paper_repro.claims_page import telling
from paper_repro.evidence import DATASETS, Group, groups
from paper_repro.judging import OTHERS
from paper_repro.paper import Paper, paper
from paper_repro.results import Result
from paper_repro.table_formats import grid
from paper_repro.tables import setting


@dataclass(frozen=True)
class Reading:
    """An open question of the paper, and its other answer by its name in `judging.OTHERS`."""

    id: str
    asks: str
    other: str


class Column(NamedTuple):
    """A number that the tables print for two rows, or for the windows of table 4.

    Attributes:
        rows: that it is made of; what a reading is judged by has to hold without any one of these.
        quantity: what of them.
        printed: by data set.
    """

    rows: tuple[str, ...]
    quantity: str
    printed: tuple[float, ...]

    def apart(self, value: float) -> float:
        """Give how far a value lies from the range of the data sets; 0 within it."""
        return max(min(self.printed) - value, value - max(self.printed), 0.0)


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
    Reading("A2", "over what is a dominant count cumulative in the blur rule?", "A2 any view"),
    Reading("A2, added up", "or are the counts of several views added up?", "A2 added up"),
    Reading("A12", "does the POP term sum over all Gaussians or over visible ones?", "A12 visible"),
    Reading("A16", "are oversized Gaussians pruned although there is no reset?", "A16 on"),
)
_HEAD: Final = ("scale", "scene", "rows", "column", "in the paper", "default", "other", "nearer")
# the pairs of rows that a table of the paper sets side by side
_PAIRS: Final = (
    *(("pop", "l2_blur"), ("pop", "l2_pop"), ("l2_blur", "l2"), ("l2_pop", "l2")),
    *(("pop", "reset"), ("pop", "gsplat"), ("blur_3k_4k", "pop"), ("blur_3k_11k", "pop"), ("blur_3k_15k", "pop")),
)
# the windows of table 4 by their length, with the steps between two densification steps of the paper's schedule
_WINDOWS: Final = (("blur_3k_4k", 4_000), ("pop", 7_000), ("blur_3k_11k", 11_000), ("blur_3k_15k", 15_000))
_EVERY: Final = 100
_N: Final = "N over N"
_DIFFERENCES: Final = (("PSNR", "psnr"), ("SSIM", "ssim"))
_GROWTH: Final = "growth a densification step over N of the shorter"
# the rows of E4: pruning harder at the paper's weight, in place of a tenfold weight
_PRUNED: Final = ("final_prune", "pop_prune_002")


def answers(results: Iterable[Result]) -> tuple[Answer, ...]:
    """Answer the questions about readings from the results of all scales, the paper's scale first where it decides."""
    found = list(results)
    return tuple(_answer(reading, found) for reading in READINGS)


def experiments(results: Iterable[Result]) -> tuple[Answer, ...]:
    """Answer E2 and E4 from the results of all scales."""
    found = list(results)
    return _longer_schedules(found), _pruned_harder(found)


def markdown(found: Sequence[Answer]) -> str:
    """Render answers: the question, what is said, the numbers."""
    parts = []
    for answer in found:
        parts.append(f"### {answer.id}: {answer.asks}\n\n{answer.says}")
        if answer.lines:
            parts.append(grid(answer.head, answer.lines))
    return "\n\n".join(parts)


def columns(published: Paper) -> tuple[Column, ...]:
    """List every column that a reading is judged by, with what the paper prints."""
    found = []
    for row, base in _PAIRS:
        both = [_printed(published, dataset, row, base) for dataset in DATASETS]
        counts = tuple(ours["num_gaussians_k"] / theirs["num_gaussians_k"] for ours, theirs in both)
        found.append(Column((row, base), _N, counts))
        for name, metric in _DIFFERENCES:
            found.append(Column((row, base), name, tuple(ours[metric] - theirs[metric] for ours, theirs in both)))
    for (shorter, first), (longer, last) in pairwise(_WINDOWS):
        counts = [tuple(published.ablation(row, d, "num_gaussians_k") for row in (longer, shorter)) for d in DATASETS]
        grown = tuple(_growth(more, less, first, last) for more, less in counts)
        found.append(Column((longer, shorter), _GROWTH, grown))
    return tuple(found)


def _printed(published: Paper, dataset: str, *rows: str) -> list[Mapping[str, float]]:
    """Give the lines of rows from the first table that has them on a data set."""
    for table in published.tables:
        if dataset in table.datasets and set(rows) <= {line.row for line in table.rows}:
            return [table.row(row).values[dataset] for row in rows]
    raise KeyError(rows)


def _growth(more: float, less: float, first: int, last: int) -> float:
    return (more - less) / less / ((last - first) / _EVERY)


def _found(column: Column, rows: Mapping[str, Group], trained: Mapping[str, str | None]) -> float | None:
    """Read a column off the runs of a scene, with the rows that stand for its own; None where one is not there."""
    stand_ins = [trained.get(row, row) for row in column.rows]
    if any(row is None or row not in rows for row in stand_ins):
        return None
    ours, theirs = (rows[row] for row in stand_ins if row is not None)
    if column.quantity == _N:
        return ours.n / theirs.n
    if column.quantity == _GROWTH:
        ends = dict(_WINDOWS)
        longer, shorter = column.rows
        return _growth(ours.n, theirs.n, ends[shorter], ends[longer])
    metric = dict(_DIFFERENCES)[column.quantity]
    return _mean(ours, metric) - _mean(theirs, metric)


def _mean(group: Group, metric: str) -> float:
    return sum(getattr(run, metric) for run in group.runs) / len(group.runs)


def _answer(reading: Reading, results: Sequence[Result]) -> Answer:
    trained = next(other.rows for other in OTHERS if other.name == reading.other)
    lines: list[tuple[str, ...]] = []
    votes: list[tuple[tuple[str, ...], int]] = []
    for scale in _telling(results):
        for scene, rows in groups(r for r in results if r.scale == scale).items():
            for column in columns(paper()):
                if not set(column.rows) & trained.keys():
                    continue
                default, other = _found(column, rows, {}), _found(column, rows, trained)
                if default is None or other is None:
                    continue
                # over the default's: which is nearer, or both within the range
                ahead = column.apart(other) - column.apart(default)
                votes.append((column.rows, (ahead > 0.0) - (ahead < 0.0)))
                lines.append((scale, scene, *_shown(column, default, other), _NEARER[votes[-1][1]]))
    return Answer(reading.id, reading.asks, _says(reading, votes), _HEAD, tuple(lines))


_NEARER: Final = {1: "default", 0: "alike", -1: "other"}


def _shown(column: Column, default: float, other: float) -> tuple[str, ...]:
    form = {_N: "{:.3f}", "PSNR": "{:+.2f} dB", "SSIM": "{:+.3f}", _GROWTH: "{:+.2%}"}[column.quantity]
    printed = ", ".join(form.format(value) for value in column.printed)
    return " and ".join(column.rows), column.quantity, printed, form.format(default), form.format(other)


def _says(reading: Reading, votes: Sequence[tuple[tuple[str, ...], int]]) -> str:
    """Name the reading that more columns speak for, also without any one pair of rows."""
    if not votes:
        return "Not decided: no scene has the runs of a column under both readings."
    of_each = [sum(vote == side for _, vote in votes) for side in (1, -1, 0)]
    counted = (
        f"of {len(votes)} columns {of_each[0]} are nearer to the paper's under the default, {of_each[1]} under "
        f"{reading.other}, {of_each[2]} alike"
    )
    lead = of_each[0] - of_each[1]
    pairs = {frozenset(rows) for rows, _ in votes}
    without = [sum(vote for rows, vote in votes if set(rows) != pair) for pair in pairs]
    if lead == 0 or any(left * lead <= 0 for left in without):
        return f"Not decided: {counted}, and without one pair of rows the lead is gone."
    return f"The runs speak for {'the default' if lead > 0 else reading.other}: {counted}, also without any one pair."


def _telling(results: Sequence[Result]) -> list[str]:
    """List the scales that say something about a method, the paper's first: those of a made-up scene do not."""
    return [scale for scale in telling() if any(r.scale == scale for r in results)]


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
