"""What the paper prints, read from paper.toml: five tables with their colours, and the numbers that the text states."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

from pop_fast.errors import PopError

PAPER: Final = Path(__file__).resolve().parent / "paper.toml"


@dataclass(frozen=True)
class Metric:
    """A column of the tables.

    Attributes:
        id: its name here.
        name: as printed.
        unit: "k", "s", "MB", "dB" or none.
        best: which values are good.
    """

    id: str
    name: str
    unit: str
    best: Literal["least", "most"]


@dataclass(frozen=True)
class PaperRow:
    """A line of a table.

    Attributes:
        row: its configuration here.
        name: as printed.
        values: by dataset and metric.
        marks: its printed place among the best by dataset and metric, 1 to 3; 0 without colour.
    """

    row: str
    name: str
    values: Mapping[str, Mapping[str, float]]
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
        for row in self.rows:
            if row.row == name:
                return row
        raise KeyError(name)

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
    """Cells of the published tables that cannot be compared, or not without a remark.

    Attributes:
        id: its label in protocol.md.
        why: in one clause.
        blocked: whether such a cell gets no difference at all.
        tables, datasets, rows, metrics: where it holds; empty for everywhere.
    """

    id: str
    why: str
    blocked: bool = False
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
    """All of paper.toml.

    Attributes:
        datasets: scenes by dataset.
        metrics: by id, in the order of the columns.
        tables: one to five.
        bytes_per_gaussian: of the file whose size Ckpt is, by row.
        stated: by id.
        not_comparable: in the order of protocol.md.
        exceptions: (row, dataset, metric) of what is printed differently in two tables, and why.
        lpips: the variant that a cell seems to hold, by (dataset, row).
    """

    datasets: Mapping[str, tuple[str, ...]]
    metrics: Mapping[str, Metric]
    tables: tuple[PaperTable, ...]
    bytes_per_gaussian: Mapping[str, int]
    stated: Mapping[str, Stated]
    not_comparable: tuple[NotComparable, ...]
    exceptions: Mapping[tuple[str, str, str], str]
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
