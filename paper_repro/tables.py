"""The paper's five tables, and one of what goes beyond it, from results: ours, the paper's, the difference, the runs.

At scale "paper" a cell is a mean over the scenes of a data set, as in the paper, and is followed by the paper's number.
At any other scale the photographs are others, so there is one block a capture, no difference from any number of the
paper, and in place of that ratios to one line of the same table, with the same ratios in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, stdev
from typing import Final

from paper_repro.jobs import added_rows
from paper_repro.paper import Metric, NotComparable, Paper, PaperTable, paper, places
from paper_repro.results import Result, most_timed_on
from paper_repro.scenes import SCALES, scale_named

# what a scale is meant to train; results of further scenes are shown too
SCENES_OF: Final = {name: tuple(scale.factors) for name, scale in SCALES.items() if name != "paper"}
# the line that the others of its table are compared with where the data is not the paper's
REFERENCES: Final = {1: "gsplat", 2: "gsplat", 3: "l2_blur", 4: "pop", 5: "reset"}
# lines of the table of what goes beyond the paper, which has none of their numbers, with the method itself first
BEYOND: Final = {
    "pop": "POP, the paper's method",
    "final_prune": "POP, final prune",
    "opacity_entropy": "opacity-entropy prior instead of POP",
}
OTHER_DATA: Final = "other data"
NOT_RUN: Final = "not run"
NO_DATA: Final = "no data"
NO_WEIGHTS: Final = "no weights"
BY_THE_CLOCK: Final = " (clock)"
ELSEWHERE: Final = " (elsewhere)"
NOT_IN_PAPER: Final = "not in the paper"
SEE_MAIN: Final = "see tables 1 and 2"


@dataclass(frozen=True)
class Cell:
    """One number of ours with one of the paper's; every text says something."""

    value: float | None  # ours; None where there is none
    spread: float | None  # sample standard deviation over the seeds; None with fewer than two
    ours: str  # as printed, or why there is none
    paper: str  # the paper's as printed, or why there is none
    difference: str  # ours less the paper's, or why there is none
    place: int = 0  # of ours among the best of its column, 0 without
    paper_place: int = 0  # as the paper colours it
    is_ranked: bool = True  # whether ours may have a place


@dataclass(frozen=True)
class Line:
    """One method or ablation."""

    row: str  # its configuration
    name: str  # as the paper prints it
    cells: Mapping[str, Cell]  # by metric
    seeds: int  # how many seeds every scene has; 0 without runs
    missing: tuple[str, ...]  # scenes without a run
    runs: tuple[str, ...]  # "scene seed id" of every run in it


@dataclass(frozen=True)
class Block:
    """The lines of one data set, or of one capture; `relative` has one text a line for each column of `columns`."""

    title: str
    lines: tuple[Line, ...] = ()
    columns: tuple[str, ...] = ()
    relative: Mapping[str, Sequence[str]] | None = None


@dataclass(frozen=True)
class Table:
    """A table with everything that has to be said about it."""

    name: str  # "table 1" to "table 5", or "beyond"
    scale: str  # of the runs
    title: str  # what it is about
    header: tuple[str, ...]  # sentences that stand above it; the first says whether this is the paper's protocol
    metrics: tuple[Metric, ...]  # its columns
    blocks: tuple[Block, ...]  # one a data set or capture
    ratios: Block | None  # ratios to one line, with the paper's; None at scale "paper"
    remarks: Mapping[str, str]  # what of the paper's numbers in it cannot be compared, by label


def table(number: int, scale: str, results: Iterable[Result], absent: Iterable[str] = ()) -> Table:
    """Make one of the paper's tables.

    Args:
        number: 1 to 5.
        scale: whose results to take.
        results: of any scale.
        absent: scenes whose data is known not to be there, so that a cell says "no data" and not "not run".

    Raises:
        PopError: there is no such table or scale.
    """
    published = paper()
    printed, found = published.table(number), _of_scale(scale, results)
    # the paper's own method is "Ours" in its main tables
    rows = {line.row: line.name.replace("Ours", "POP (Ours)") for line in printed.rows}
    found = [r for r in found if r.row in rows]
    metrics = tuple(published.metrics[m] for m in printed.metrics)
    groups = _groups(scale, found, {name: published.datasets[name] for name in printed.datasets})
    blocks = []
    for title, scenes in groups.items():
        where = most_timed_on((r.row, r) for r in found if r.scene in scenes)
        make = _Maker(published, printed, scale, title, scenes, frozenset(absent), where)
        lines = [make.line(row, name, found) for row, name in rows.items()]
        # places among values of different LPIPS networks would mean nothing
        mixed = scale == "paper" and len({published.lpips[title, row] for row in rows}) > 1
        ranked = [m for m in metrics if m.id != "lpips" or not mixed]
        blocks.append(Block(_titled(title, scale, found, where), _placed(lines, ranked, printed.marked)))
    remarks = {n.id: n.why for n in published.not_comparable if _touches(n, printed)} if scale == "paper" else {}
    ratios = None if scale == "paper" else _ratios(printed, groups, found)
    return Table(
        f"table {number}", scale, printed.title, _header(scale, found), metrics, tuple(blocks), ratios, remarks
    )


def beyond_rows() -> dict[str, str]:
    """Return what goes beyond the paper, by row: ours, new rows, and those of other packages."""
    return BEYOND | {row.name: row.title for row in added_rows()}


def beyond(scale: str, results: Iterable[Result], absent: Iterable[str] = ()) -> Table:
    """Make the table of what goes beyond the paper: PSNR against bytes, and the paper's method.

    Raises:
        PopError: there is no such scale.
    """
    published = paper()
    rows = beyond_rows()
    found = [r for r in _of_scale(scale, results) if r.row in rows]
    metrics = tuple(published.metrics.values())
    groups = _groups(scale, found, published.datasets)
    blocks = []
    for title, scenes in groups.items():
        where = most_timed_on((r.row, r) for r in found if r.scene in scenes)
        make = _Maker(published, None, scale, title, scenes, frozenset(absent), where)
        lines = [make.line(row, name, found) for row, name in rows.items()]
        blocks.append(Block(_titled(title, scale, found, where), _placed(lines, metrics, 1)))
    return Table("beyond", scale, "Beyond the paper", _header(scale, found, False), metrics, tuple(blocks), None, {})


def setting(result: Result, name: str) -> float | None:
    """Give a setting of a run by the last part of its dotted name, or None where it has none or several."""
    values = [value for key, value in result.schedule.items() if key.rpartition(".")[2] == name]
    return float(values[0]) if len(values) == 1 and isinstance(values[0], int | float) else None


def _of_scale(scale: str, results: Iterable[Result]) -> list[Result]:
    known = scale_named(scale).name
    return [r for r in results if r.scale == known]


def _groups(scale: str, found: Sequence[Result], datasets: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Say which scenes a block averages over: those of a data set, or one capture."""
    if scale == "paper":
        return dict(datasets)
    return {scene: (scene,) for scene in dict.fromkeys((*SCENES_OF[scale], *sorted({r.scene for r in found})))}


def _touches(said: NotComparable, printed: PaperTable) -> bool:
    return any(
        said.holds(printed.number, dataset, line.row, metric)
        for line in printed.rows
        for dataset in printed.datasets
        for metric in printed.metrics
    )


_GET: Final[Mapping[str, Callable[[Result], float]]] = {
    "num_gaussians_k": lambda r: r.num_gaussians / 1000.0,
    "time_s": lambda r: r.training_seconds,
    "ckpt_mb": lambda r: r.checkpoint_mib,
    "psnr": lambda r: r.psnr,
    "ssim": lambda r: r.ssim,
}


@dataclass(frozen=True)
class _Maker:
    """Makes the lines of one block, with times of one machine."""

    published: Paper
    printed: PaperTable | None
    scale: str
    title: str
    scenes: tuple[str, ...]
    absent: frozenset[str]
    machine: str | None

    def line(self, row: str, name: str, found: Sequence[Result]) -> Line:
        mine = [r for r in found if r.row == row and r.scene in self.scenes]
        present = {r.scene for r in mine}
        missing = tuple(scene for scene in self.scenes if scene not in present)
        metrics = self.published.metrics if self.printed is None else self.printed.metrics
        cells = {metric: self._cell(row, metric, mine, missing) for metric in metrics}
        seeds = [{r.seed for r in mine if r.scene == scene} for scene in present]
        shared = len(set.intersection(*seeds)) if seeds else 0
        runs = tuple(f"{r.scene} {r.seed} {r.run}" for r in mine)
        return Line(row, name, cells, shared, missing, runs)

    def _cell(self, row: str, metric: str, mine: Sequence[Result], missing: Sequence[str]) -> Cell:
        printed, shown, place = self._printed(row, metric)
        if not mine:
            why = NO_DATA if missing and set(missing) <= self.absent else NOT_RUN
            return Cell(None, None, why, shown, why, 0, place)
        mine, mark = self._comparable(mine) if metric == "time_s" else (mine, "")
        values = [self._value(row, metric, r) for r in mine]
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            return Cell(None, None, NO_WEIGHTS, shown, NO_WEIGHTS, 0, place)
        mean, spread = _mean_and_spread(mine, known)
        digits = self._digits(metric)
        ours = f"{mean:,.{digits}f}" + (f" ± {spread:.{digits}f}" if spread is not None else "") + mark
        if missing:
            ours += f" ({len(self.scenes) - len(missing)} of {len(self.scenes)} scenes)"
        against = self._against(row, metric, mine, missing)
        if against is None and printed is not None:
            # rounded first, so that no difference is "-0"
            against = f"{round(mean - printed, digits) + 0.0:+,.{digits}f}"
        return Cell(mean, spread, ours, shown, against or shown, 0, place, not mark)

    def _comparable(self, mine: Sequence[Result]) -> tuple[Sequence[Result], str]:
        """Choose the runs whose times compare within the block; all of them, with a mark, where a scene has none."""
        here = [r for r in mine if r.is_timed and r.trained_on == self.machine]
        if {r.scene for r in here} == {r.scene for r in mine}:
            return here, ""
        return mine, ELSEWHERE if all(r.is_timed for r in mine) else BY_THE_CLOCK

    def _printed(self, row: str, metric: str) -> tuple[float | None, str, int]:
        """Give the paper's number of a cell, how it is shown, and its colour."""
        if self.printed is None:
            return None, SEE_MAIN if row == "pop" else NOT_IN_PAPER, 0
        if self.scale != "paper":
            return None, OTHER_DATA, 0
        line = self.printed.row(row)
        value = line.values[self.title][metric]
        return value, f"{value:,.{self.printed.decimals[metric]}f}", line.marks[self.title][metric]

    def _against(self, row: str, metric: str, mine: Sequence[Result], missing: Sequence[str]) -> str | None:
        """Say why ours cannot be compared with the paper's number, or None where it can."""
        if self.printed is None:
            return SEE_MAIN if row == "pop" else NOT_IN_PAPER
        if self.scale != "paper":
            return OTHER_DATA
        blocking = [
            n
            for n in self.published.not_comparable
            if n.blocked and n.holds(self.printed.number, self.title, row, metric)
        ]
        if blocking:
            return f"not comparable: {blocking[0].why} ({blocking[0].id})"
        if metric == "lpips" and self.published.lpips[self.title, row] == "unknown":
            return "not comparable: which LPIPS the paper's number is, is not known (C1)"
        gpu = str(self.published.stated["gpu"].value)
        strangers = sorted({r.machine for r in mine if gpu not in r.machine})
        if metric == "time_s" and strangers:
            return f"not comparable: trained on {', '.join(strangers)}, the paper on {gpu} (C5)"
        if missing:
            return f"not comparable: without {', '.join(missing)}"
        return None

    def _value(self, row: str, metric: str, result: Result) -> float | None:
        if metric != "lpips":
            return _GET[metric](result)
        variant = self.published.lpips.get((self.title, row), "alex_norm")
        return result.lpips["alex_norm" if variant == "unknown" else variant]

    def _digits(self, metric: str) -> int:
        if self.scale == "paper" and self.printed is not None:
            return self.printed.decimals[metric]
        short = 1 if self.scale == "toy" else 0
        return {"num_gaussians_k": 1, "time_s": short, "ckpt_mb": 1, "psnr": 2, "ssim": 4, "lpips": 3}[metric]


def _mean_and_spread(mine: Sequence[Result], values: Sequence[float]) -> tuple[float, float | None]:
    """Average over seeds, then over scenes; the spread is that of the scenes' mean over the seeds they all have."""
    scenes: dict[str, dict[int, float]] = {}
    for result, value in zip(mine, values, strict=True):
        scenes.setdefault(result.scene, {})[result.seed] = value
    mean = fmean(fmean(by_seed.values()) for by_seed in scenes.values())
    seeds = set.intersection(*(set(by_seed) for by_seed in scenes.values()))
    if len(seeds) < 2:
        return mean, None
    return mean, stdev(fmean(by_seed[seed] for by_seed in scenes.values()) for seed in sorted(seeds))


def _placed(lines: Sequence[Line], metrics: Sequence[Metric], upto: int) -> tuple[Line, ...]:
    """Give every cell its place among the best of its column; one number alone has none."""
    placed = {line.row: dict(line.cells) for line in lines}
    for metric in metrics:
        # a mean over fewer scenes is another quantity
        whole = [line for line in lines if not line.missing]
        cells = {line.row: line.cells[metric.id] for line in whole}
        values = {row: c.value for row, c in cells.items() if c.value is not None and c.is_ranked}
        if len(values) < 2:
            continue
        for row, place in places(values, metric, upto).items():
            placed[row][metric.id] = replace(placed[row][metric.id], place=place)
    return tuple(replace(line, cells=placed[line.row]) for line in lines)


def _titled(title: str, scale: str, found: Sequence[Result], where: str | None) -> str:
    """Say of a capture that is not the paper's what it is, and on which machine its times compare."""
    mine = [r for r in found if r.scene == title]
    if scale == "paper" or not mine:
        return title
    steps = sorted({int(s) for r in mine if (s := setting(r, "max_steps")) is not None})
    facts = [
        " or ".join(sorted({f"{r.protocol['width']} x {r.protocol['height']}" for r in mine})),
        *([" or ".join(f"{s:,}" for s in steps) + " steps"] if steps else []),
        " or ".join(sorted({str(r.protocol["test_views"]) for r in mine})) + " held-out views",
        *([f"times on {where}"] if where is not None else []),
    ]
    return f"{title} ({', '.join(facts)})"


def _header(scale: str, found: Sequence[Result], has_ratios: bool = True) -> tuple[str, ...]:
    about = "Ours ± the sample standard deviation over seeds; one seed has none. n is the number of seeds."
    if scale == "paper":
        first = "Scale paper: the published protocol (protocol.md)."
    else:
        names = ", ".join(dict.fromkeys((*SCENES_OF[scale], *sorted({r.scene for r in found}))))
        what = {"toy": "a test of the program on a made-up scene, its numbers say nothing about a method",
                "shown": "a made-up scene, its numbers say nothing about a method",
                "small": "other photographs, small",
                "no_floor": "other photographs, theta_blur without a floor",
                "full": "other photographs, on the whole schedule"}[scale]  # fmt: skip
        first = (
            f"NOT the paper's protocol: scale {scale}, {what} ({names}). No number here may be compared with a number "
            f"of the paper{'; ratios within the table stand beside its own' if has_ratios else ''}."
        )
    if not found:
        return first, "No run of this table is finished."
    machines = sorted({r.trained_on for r in found})
    lpips = "the variant that the paper's cell seems to hold (protocol.md, C1)" if scale == "paper" else "alex_norm"
    about += f" LPIPS is {lpips}."
    clock = "(clock) is by the clock of a processor that may have had other work, so that it has no place. "
    timing = "" if all(r.is_timed for r in found) else clock
    if len(machines) > 1:
        timing += (
            "Those of a block are of the runs on one machine"
            + ("" if scale == "paper" else ", which its title names")
            + ": of those that timed POP, or else of all, the one that timed most of its methods. (elsewhere) is of "
            "others, so that it has no place. "
        )
    cpu = ", those of a CPU its processor time a thread" if any("cpu" in r.seconds for r in found) else ""
    return first, about, f"Seconds are of training alone{cpu}. {timing}Machines: {'; '.join(machines)}."


def _ratios(printed: PaperTable, groups: Mapping[str, tuple[str, ...]], found: Sequence[Result]) -> Block:
    """Make the block of Gaussians and PSNR relative to one line, ours by capture and the paper's by data set."""
    base = REFERENCES[printed.number]
    name = printed.row(base).name.replace("Ours", "POP (Ours)")
    relative = {}
    for line in printed.rows:
        texts = [_relative(line.row, base, [r for r in found if r.scene in scenes]) for scenes in groups.values()]
        for dataset in printed.datasets:
            here, there = line.values[dataset], printed.row(base).values[dataset]
            share = here["num_gaussians_k"] / there["num_gaussians_k"]
            texts.append(f"{share:.1%}, {here['psnr'] - there['psnr']:+.2f} dB")
        relative[line.row] = texts
    columns = (*groups, *(f"paper, {dataset}" for dataset in printed.datasets))
    return Block(f"Gaussians relative to {name}, and PSNR less its", columns=columns, relative=relative)


def _relative(row: str, base: str, found: Sequence[Result]) -> str:
    sides = [[r for r in found if r.row == name] for name in (row, base)]
    if not sides[0]:
        return NOT_RUN
    if not sides[1]:
        return f"{base} not run"
    n, psnr = ([fmean(get(r) for r in side) for side in sides] for get in (lambda r: r.num_gaussians, lambda r: r.psnr))
    return f"{n[0] / n[1]:.1%}, {psnr[0] - psnr[1]:+.2f} dB"
