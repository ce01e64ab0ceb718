"""What the paper prints, read from paper.toml, and what can be checked of it without any training.

A check compares the tables with each other and with the text. It holds, or it fails for a known reason: timing noise,
or two versions of a base code. A test holds each check to what is said of it here, so that a known failure that begins
to hold is noticed too.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

from pop_fast.errors import PopError

PAPER: Final = Path(__file__).resolve().parent / "paper.toml"
# MiB between a printed size and bytes times the printed count, both rounded; 3DGS on Mip-NeRF 360 has 1.59
CKPT_TOLERANCE: Final = 1.6
M360, TT, DB = "Mip-NeRF 360", "Tanks & Temples", "Deep Blending"


@dataclass(frozen=True)
class Metric:
    """A column of the tables."""

    id: str  # its name here
    name: str  # as printed
    unit: str  # "k", "s", "MB", "dB" or none
    best: Literal["least", "most"]  # which values are good


@dataclass(frozen=True)
class PaperRow:
    """A line of a table."""

    row: str  # its configuration here
    name: str  # as printed
    values: Mapping[str, Mapping[str, float]]  # by dataset and metric
    # its printed place among the best by dataset and metric, 1 to 3; 0 without colour
    marks: Mapping[str, Mapping[str, int]]


@dataclass(frozen=True)
class PaperTable:
    """One of the five tables; `decimals` by metric, `marked` is how many places are coloured."""

    number: int
    label: str
    title: str
    datasets: tuple[str, ...]
    metrics: tuple[str, ...]
    decimals: Mapping[str, int]
    marked: int
    rows: tuple[PaperRow, ...]

    def row(self, name: str) -> PaperRow:
        """Give a line by its configuration.

        Raises:
            KeyError: the table has no such line.
        """
        return {row.row: row for row in self.rows}[name]

    def value(self, row: str, dataset: str, metric: str) -> float:
        """Give one printed number."""
        return self.row(row).values[dataset][metric]


@dataclass(frozen=True)
class Stated:
    """A number of the text; `quote` is where it stands in the LaTeX source."""

    id: str
    value: float | str | tuple[float, ...]
    quote: str
    about: str


@dataclass(frozen=True)
class NotComparable:
    """Cells of the published tables that cannot be compared, or not without a remark."""

    id: str  # its label in protocol.md
    why: str  # in one clause
    blocked: bool = False  # whether such a cell gets no difference at all
    # where it holds; empty for everywhere
    tables: tuple[int, ...] = ()
    datasets: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()

    def holds(self, table: int, dataset: str, row: str, metric: str) -> bool:
        """Say whether it is about this cell."""
        asked = ((table, self.tables), (dataset, self.datasets), (row, self.rows), (metric, self.metrics))
        return all(not named or value in named for value, named in asked)


@dataclass(frozen=True)
class Paper:
    """All of paper.toml."""

    datasets: Mapping[str, tuple[str, ...]]  # scenes by dataset
    metrics: Mapping[str, Metric]  # by id, in the order of the columns
    tables: tuple[PaperTable, ...]  # one to five
    bytes_per_gaussian: Mapping[str, int]  # of the file whose size Ckpt is, by row
    stated: Mapping[str, Stated]  # by id
    not_comparable: tuple[NotComparable, ...]  # in the order of protocol.md
    # (row, dataset, metric) of what is printed differently in two tables, and why
    exceptions: Mapping[tuple[str, str, str], str]
    # the variant that a cell seems to hold, by (dataset, row)
    lpips: Mapping[tuple[str, str], str] = field(default_factory=dict)

    def table(self, number: int) -> PaperTable:
        """Give a table by its number.

        Raises:
            PopError: it is not 1 to 5.
        """
        for table in self.tables:
            if table.number == number:
                return table
        raise PopError(f"table is {number}; it must be one of {', '.join(str(t.number) for t in self.tables)}")

    def ablation(self, row: str, dataset: str, metric: str) -> float:
        """Give a number from the first of the ablation tables (3 to 5) that has the row: all print two decimals."""
        for table in self.tables[2:]:
            if any(line.row == row for line in table.rows):
                return table.value(row, dataset, metric)
        raise KeyError(row)

    def number(self, stated: str) -> float:
        """Give a stated number that is a single one."""
        value = self.stated[stated].value
        if not isinstance(value, float):
            raise TypeError(f"{stated} is {value}, not one number")
        return value


@cache
def paper() -> Paper:
    """Read paper.toml, once."""
    return load(PAPER)


def load(path: Path) -> Paper:
    """Read a file like paper.toml.

    Raises:
        PopError: the file is absent or not TOML, or a table has a line of the wrong length or of an unknown dataset.
    """
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PopError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PopError(f"{path}: is not TOML ({error})") from None
    try:
        return _of_toml(found, path)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        if isinstance(error, PopError):
            raise
        raise PopError(f"{path}: an entry is absent or not what paper.toml has there ({error!r})") from error


def _of_toml(found: Mapping[str, Any], path: Path) -> Paper:
    tables = tuple(_table(table, path) for table in found["tables"])
    stated = [Stated(s["id"], _value(s["value"]), s["quote"], s["about"]) for s in found["stated"]]
    if len({s.id for s in stated}) != len(stated):
        raise PopError(f"{path}: stated has an id twice")
    return Paper(
        datasets={name: tuple(scenes) for name, scenes in found["datasets"].items()},
        metrics={id: Metric(id, **said) for id, said in found["metrics"].items()},
        tables=tables,
        bytes_per_gaussian={row: int(size) for size, rows in found["checkpoint"].items() for row in rows},
        stated={s.id: s for s in stated},
        not_comparable=tuple(_not_comparable(said) for said in found["not_comparable"]),
        exceptions={(e["row"], e["dataset"], e["metric"]): e["why"] for e in found["exceptions"]},
        lpips={(d, row): said["variant"] for said in found["lpips"] for d in said["datasets"] for row in said["rows"]},
    )


def _table(found: Mapping[str, Any], path: Path) -> PaperTable:
    where = f"{path}: table {found['number']}"
    metrics, datasets = tuple(found["metrics"]), tuple(found["datasets"])
    rows = []
    for line in found["rows"]:
        values, marks = {}, {}
        for dataset in datasets:
            if dataset not in line:
                raise PopError(f"{where}: row {line['row']} has no {dataset}")
            cells = line[dataset]
            if len(cells["values"]) != len(metrics) or len(cells["marks"]) != len(metrics):
                raise PopError(f"{where}: row {line['row']}, {dataset}: there must be {len(metrics)} values and marks")
            values[dataset] = dict(zip(metrics, map(float, cells["values"]), strict=True))
            marks[dataset] = dict(zip(metrics, cells["marks"], strict=True))
        rows.append(PaperRow(line["row"], line["name"], values, marks))
    return PaperTable(
        number=found["number"],
        label=found["label"],
        title=found["title"],
        datasets=datasets,
        metrics=metrics,
        decimals=dict(zip(metrics, found["decimals"], strict=True)),
        marked={"best three": 3, "best": 1}[found["marks"]],
        rows=tuple(rows),
    )


def _value(value: Any) -> float | str | tuple[float, ...]:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(float(v) for v in value)
    return value if isinstance(value, str) else float(value)


def _not_comparable(found: Mapping[str, Any]) -> NotComparable:
    lists: dict[str, Any] = {key: tuple(value) for key, value in found.items() if isinstance(value, list)}
    return NotComparable(id=found["id"], why=found["why"], blocked=found.get("blocked", False), **lists)


@dataclass(frozen=True)
class Statement:
    """One statement about the paper's own numbers."""

    says: str  # the statement
    found: str  # the numbers
    holds: bool  # whether they bear it out
    known: str = ""  # why it does not hold, where that is known; empty for what has to hold


def checks(paper: Paper) -> tuple[Statement, ...]:
    """Make every check."""
    return (*_checkpoints(paper), *_across_tables(paper), *_colours(paper), *_text(paper), *_order_of_times(paper))


def checkpoint_mib(num_gaussians: float, bytes_per_gaussian: int) -> float:
    """Give the size of the parameters in float32, MiB."""
    return num_gaussians * bytes_per_gaussian / 2**20


def places(values: Mapping[str, float], metric: Metric, upto: int) -> dict[str, int]:
    """Rank the best: 1 for the best, up to `upto`, 0 for the others. Equal values share a place and use up the next.

    Args:
        values: by row.
        metric: says whether the least or the most is best.
        upto: how many places there are.
    """
    sign = 1.0 if metric.best == "least" else -1.0
    place = {row: 1 + sum(sign * other < sign * value for other in values.values()) for row, value in values.items()}
    return {row: at if at <= upto else 0 for row, at in place.items()}


def _checkpoints(paper: Paper) -> Iterator[Statement]:
    exact = total = 0
    for table, dataset, row, values in _lines(paper):
        if "ckpt_mb" not in values:
            continue
        size = checkpoint_mib(1000 * values["num_gaussians_k"], paper.bytes_per_gaussian[row])
        off = values["ckpt_mb"] - size
        # Num is rounded to thousands and Ckpt to whole MiB
        slack = 0.5 + checkpoint_mib(500, paper.bytes_per_gaussian[row])
        total, exact = total + 1, exact + (abs(off) <= slack)
        yield Statement(
            f"table {table.number}, {dataset}, {row}: Ckpt is Num x {paper.bytes_per_gaussian[row]} bytes",
            f"{values['ckpt_mb']:.0f} printed, {size:.2f} MiB computed, {off:+.2f}",
            abs(off) <= CKPT_TOLERANCE,
        )
    yield Statement(
        "21 of 23 sizes agree within the rounding of both", f"{exact} of {total}", (exact, total) == (21, 23)
    )


def _lines(paper: Paper) -> Iterator[tuple[PaperTable, str, str, Mapping[str, float]]]:
    for table in paper.tables:
        for line in table.rows:
            for dataset in table.datasets:
                yield table, dataset, line.row, line.values[dataset]


def _across_tables(paper: Paper) -> Iterator[Statement]:
    printed: dict[tuple[str, str, str], list[tuple[PaperTable, float]]] = {}
    for table, dataset, row, values in _lines(paper):
        for metric, value in values.items():
            printed.setdefault((row, dataset, metric), []).append((table, value))
    for (row, dataset, metric), cells in printed.items():
        if len(cells) < 2:
            continue
        decimals = min(table.decimals[metric] for table, _ in cells)
        # a value may lie halfway, so that either neighbour is its rounding
        off = max(value for _, value in cells) - min(value for _, value in cells)
        finest = max(table.decimals[metric] for table, _ in cells)
        agree = off <= (0.5 * 10.0**-decimals + 1e-9 if finest > decimals else 1e-9)
        yield Statement(
            f"{row}, {dataset}: {metric} is the same in tables {', '.join(str(t.number) for t, _ in cells)}",
            ", ".join(f"{value:.{table.decimals[metric]}f}" for table, value in cells),
            agree,
            paper.exceptions.get((row, dataset, metric), ""),
        )


def _colours(paper: Paper) -> Iterator[Statement]:
    for table in paper.tables:
        for dataset in table.datasets:
            for metric in table.metrics:
                marks = {line.row: line.marks[dataset][metric] for line in table.rows}
                values = {line.row: line.values[dataset][metric] for line in table.rows}
                right = places(values, paper.metrics[metric], table.marked)
                yield Statement(
                    f"table {table.number}, {dataset}, {metric}: the best {table.marked} are marked",
                    ", ".join(f"{row} {mark}" for row, mark in marks.items() if mark) or "none",
                    marks == right,
                )


def _text(paper: Paper) -> Iterator[Statement]:
    main, tanks = paper.table(1), paper.table(2)
    saved = 1.0 - tanks.value("pop", TT, "time_s") / tanks.value("taming", TT, "time_s")
    least = paper.number("speedup_vs_taming_TT")
    yield Statement(f"POP saves at least {least:.0%} of Taming-3DGS's time on {TT}", f"{saved:.1%}", saved >= least)
    for table, dataset in ((main, M360), (main, DB), (tanks, TT)):
        yield _is_least(table, dataset, "time_s")
        if table is main:
            yield _is_least(table, dataset, "num_gaussians_k")
    pop = main.value("pop", M360, "psnr")
    for row in ("pup", "speedy_splat"):
        other = main.value(row, M360, "psnr")
        yield Statement(f"POP surpasses {row} in PSNR on {M360}", f"{pop:.3f} and {other:.3f} dB", pop > other)
    psnr = {line.row: line.values[TT]["psnr"] for line in tanks.rows}
    place = places(psnr, paper.metrics["psnr"], len(psnr))["pop"]
    yield Statement(f"POP has the third-best PSNR on {TT}", f"place {place}", place == paper.number("pop_psnr_rank_TT"))
    yield from _counts_in_the_text(paper, main, tanks)
    low, high = _pair(paper, "blur_3k15k_budget")
    for dataset, short in ((M360, "M360"), (TT, "TT"), (DB, "DB")):
        counts = [paper.ablation(row, dataset, "num_gaussians_k") for row in ("blur_3k_15k", "pop")]
        ratio = counts[0] / counts[1]
        yield Statement(
            f"the window 3k-15k takes {low:.0f} to {high:.0f} times the Gaussians of 3k-7k on {dataset}",
            f"{counts[0]:.0f}k / {counts[1]:.0f}k = {ratio:.2f}",
            low <= ratio <= high,
        )
        change = paper.ablation("blur_3k_15k", dataset, "psnr") - paper.ablation("pop", dataset, "psnr")
        published = paper.number(f"blur_3k15k_psnr_change_{short}")
        yield Statement(
            f"the window 3k-15k changes PSNR by {published:+.2f} dB on {dataset}",
            f"{change:+.2f} dB",
            round(change, 2) == published,
        )
        reset = paper.ablation("pop", dataset, "psnr") - paper.ablation("reset", dataset, "psnr")
        yield Statement(f"POP is no worse than opacity reset in PSNR on {dataset}", f"{reset:+.2f} dB", reset >= 0.0)


def _is_least(table: PaperTable, dataset: str, metric: str) -> Statement:
    values = {line.row: line.values[dataset][metric] for line in table.rows}
    best = min(values, key=lambda row: values[row])
    return Statement(
        f"POP has the least {metric} on {dataset}", f"{best} with {values[best]:.0f}, POP {values['pop']:.0f}",
        best == "pop" and list(values.values()).count(values[best]) == 1,
    )  # fmt: skip


def _counts_in_the_text(paper: Paper, main: PaperTable, tanks: PaperTable) -> Iterator[Statement]:
    for id, row in (("pop_num_M360_k", "pop"), ("pup_num_M360_k", "pup"), ("speedy_num_M360_k", "speedy_splat")):
        published, printed = paper.number(id), main.value(row, M360, "num_gaussians_k")
        yield Statement(
            f"the text's {published:.0f}k of {row} are the table's", f"{printed:.0f}k", published == printed
        )
    published, printed = paper.number("pop_num_TT_k"), tanks.value("pop", TT, "num_gaussians_k")
    yield Statement(
        f"the text's about {published:.0f}k on {TT} are the table's", f"{printed:.0f}k", published == round(printed, -1)
    )
    published = paper.number("pup_compression")
    for table, dataset in ((main, M360), (main, DB), (tanks, TT)):
        share = table.value("pup", dataset, "num_gaussians_k") / table.value("3dgs", dataset, "num_gaussians_k")
        yield Statement(
            f"PUP-3DGS has {published:.0%} of 3DGS's Gaussians on {dataset}",
            f"{share:.1%}",
            abs(share - published) < 0.005,
            "its base is an older version of 3DGS, with more Gaussians than the row 3DGS has (protocol.md, C2)",
        )  # fmt: skip


def _order_of_times(paper: Paper) -> Iterator[Statement]:
    main = paper.table(1)
    pup, base = (main.value(row, M360, "time_s") for row in ("pup", "3dgs"))
    why = "another version of the base code (protocol.md, C6)"
    yield Statement(
        f"PUP-3DGS takes longer than the 3DGS in it on {M360}", f"{pup:.0f} s and {base:.0f} s", pup > base, why
    )
    lines = {line.row: line.values[TT] for line in paper.table(3).rows}
    by_count = sorted(lines, key=lambda row: lines[row]["num_gaussians_k"])
    times = [lines[row]["time_s"] for row in by_count]
    yield Statement(
        f"in the module ablation more Gaussians take longer on {TT}",
        ", ".join(f"{row} {lines[row]['num_gaussians_k']:.0f}k {lines[row]['time_s']:.0f} s" for row in by_count),
        times == sorted(times),
        "timing noise (protocol.md, C5)",
    )


def _pair(paper: Paper, id: str) -> Sequence[float]:
    value = paper.stated[id].value
    if not isinstance(value, tuple):
        raise TypeError(f"{id} is {value}, not a range")
    return value
