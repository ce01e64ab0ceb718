"""A table of the reproduction as CSV: one line a cell, numbers unrounded, every reason spelled out."""

from __future__ import annotations

import csv
import io
from typing import Final

from paper_repro.tables import Table

__all__ = ["COLUMNS", "csv_text"]

COLUMNS: Final = (
    *("table", "scale", "block", "row", "name", "metric", "value", "spread", "seeds"),
    *("ours", "paper", "difference", "missing", "runs"),
)


def csv_text(table: Table) -> str:
    """Render a table; `value` and `spread` are empty where `ours` says why there is no number or no spread."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for block in table.blocks:
        for line in block.lines:
            for metric in table.metrics:
                cell = line.cells[metric.id]
                numbers = ["" if x is None else repr(x) for x in (cell.value, cell.spread)]
                writer.writerow(
                    [
                        *(table.name, table.scale, block.title, line.row, line.name, metric.id),
                        *(*numbers, line.seeds, cell.ours, cell.paper, cell.difference),
                        *("; ".join(line.missing) or "none", "; ".join(line.runs) or "none"),
                    ]
                )
    return out.getvalue()
