"""A table of the reproduction as Markdown, as CSV (one line a cell, numbers unrounded) and as LaTeX.

LaTeX needs booktabs and xcolor[table]. Its colours for the best three are those of the paper's source: bestred,
secondorange, thirdyellow; `PREAMBLE` defines them.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Final

from paper_repro.paper import Metric
from paper_repro.tables import Block, Line, Table

# so many run ids fit into a line; more are listed below the block
_IDS = 3
_LONG: Final = "not comparable: "
COLUMNS: Final = (
    *("table", "scale", "block", "row", "name", "metric", "value", "spread", "seeds"),
    *("ours", "paper", "difference", "missing", "runs"),
)
PREAMBLE: Final = r"""\usepackage{booktabs}
\usepackage{graphicx}
\usepackage[table]{xcolor}
\definecolor{bestred}{RGB}{255,120,120}
\definecolor{secondorange}{RGB}{255,190,100}
\definecolor{thirdyellow}{RGB}{255,240,100}
"""
_COLOURS: Final = ("", "bestred", "secondorange", "thirdyellow")
_ARROWS: Final = {"least": r"$\downarrow$", "most": r"$\uparrow$"}
_ESCAPES: Final = str.maketrans({**{sign: f"\\{sign}" for sign in "&%_#$"}, "±": r"$\pm$", "*": r"$^\ast$"})


class Notes:
    """Reasons of a block's cells as numbered notes below it, in the order in which cells asked for them."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def short(self, text: str) -> tuple[str, int]:
        """Give what stands in the cell, and the number of its note; 0 where the text says all itself."""
        if not text.startswith(_LONG):
            return text, 0
        why = text.removeprefix(_LONG)
        if why not in self.texts:
            self.texts.append(why)
        return _LONG.removesuffix(": "), 1 + self.texts.index(why)


def markdown(table: Table) -> str:
    """Render a table: what has to be said, one grid a data set or capture, the ratios, what cannot be compared."""
    parts = [f"## {_title(table)}", f"**{table.header[0]}**", " ".join(table.header[1:])]
    if any(line.runs for block in table.blocks for line in block.lines):
        parts.append("Best in **bold**, second and third as (2) and (3), ties alike.")
    for block in table.blocks:
        parts += _block(table, block)
    if table.ratios is not None and table.ratios.relative is not None:
        named = {line.row: line.name for block in table.blocks for line in block.lines}
        rows = [[named[row], *texts] for row, texts in table.ratios.relative.items()]
        parts += [f"### {table.ratios.title}", grid(["method", *table.ratios.columns], rows)]
    if table.remarks:
        said = "\n".join(f"- {label}: {why}." for label, why in table.remarks.items())
        parts += [f"Of the paper's numbers (protocol.md, part 2):\n\n{said}"]
    return "\n\n".join(parts) + "\n"


def grid(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Make a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)


def _block(table: Table, block: Block) -> list[str]:
    arrows = {"least": "↓", "most": "↑"}
    head = ["method", "of", *(f"{_named(m)} {arrows[m.best]}" for m in table.metrics), "runs"]
    rows: list[list[str]] = []
    notes = Notes()
    beside = table.scale == "paper" and table.name != "beyond"
    if not beside and not any(line.runs for line in block.lines):
        return [f"### {block.title}", f"{_reason(block)}: {', '.join(line.name for line in block.lines)}."]
    for line in block.lines:
        cells = [line.cells[metric.id] for metric in table.metrics]
        rows.append([line.name, "here", *(_marked(cell.ours, cell.place) for cell in cells), _runs(line)])
        if beside:
            rows.append([line.name, "paper", *(_marked(cell.paper, cell.paper_place) for cell in cells), "the paper"])
            differences = [_noted(cell.difference, notes) for cell in cells]
            rows.append([line.name, "difference", *differences, "here less the paper"])
    parts = [f"### {block.title}", grid(head, rows)]
    if notes.texts:
        parts.append("\n".join(f"{i}. not comparable: {text}" for i, text in enumerate(notes.texts, start=1)))
    many = [line for line in block.lines if len(line.runs) > _IDS]
    if many:
        parts.append("\n".join(f"- {line.name}: {'; '.join(line.runs)}" for line in many))
    missing = [line for line in block.lines if line.missing and line.runs]
    if missing:
        parts.append("\n".join(f"- {line.name}: no run of {', '.join(line.missing)}" for line in missing))
    return parts


def _title(table: Table) -> str:
    return table.title if table.name == "beyond" else f"{table.name.capitalize()}: {table.title}"


def _reason(block: Block) -> str:
    texts = dict.fromkeys(cell.ours for line in block.lines for cell in line.cells.values())
    return " or ".join(texts).capitalize()


def _noted(text: str, notes: Notes) -> str:
    short, number = notes.short(text)
    return f"{short} [{number}]" if number else short


def _named(metric: Metric) -> str:
    return f"{metric.name} ({metric.unit})" if metric.unit else metric.name


def _marked(text: str, place: int) -> str:
    return f"**{text}**" if place == 1 else f"{text} ({place})" if place > 1 else text


def _runs(line: Line) -> str:
    if not line.runs:
        return "none"
    if len(line.runs) > _IDS:
        return f"n = {line.seeds}, {len(line.runs)} runs, listed below"
    return f"n = {line.seeds}: " + ", ".join(run.split()[-1] for run in line.runs)


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


def latex(table: Table) -> str:
    """Render a table: a table* with one tabular a data set or capture, and one of ratios where there are any."""
    parts = [_caption(table), *(_tabular(table, block) for block in table.blocks)]
    if table.ratios is not None:
        parts.append(_ratios(table, table.ratios))
    body = "\n\\par\\medskip\n".join(parts)
    return f"\\begin{{table*}}[t]\n\\centering\n\\footnotesize\n{body}\n\\end{{table*}}\n"


def _caption(table: Table) -> str:
    said = [table.title + ".", *table.header, *(f"{label}: {why}." for label, why in table.remarks.items())]
    return f"\\caption{{{_plain(' '.join(said))}}}"


def _tabular(table: Table, block: Block) -> str:
    beside = table.scale == "paper" and table.name != "beyond"
    head = ["Method", "", *(f"{_plain(_named(m))} {_ARROWS[m.best]}" for m in table.metrics), "Runs"]
    lines = [
        rf"\resizebox{{\textwidth}}{{!}}{{\begin{{tabular}}{{@{{}}ll{'r' * len(table.metrics)}l@{{}}}}",
        r"\toprule",
        rf"\multicolumn{{{len(head)}}}{{@{{}}l@{{}}}}{{{_plain(block.title)}}} \\",
        " & ".join(head) + r" \\",
        r"\midrule",
    ]
    notes = Notes()
    for line in block.lines:
        cells = [line.cells[metric.id] for metric in table.metrics]
        shade = r"\rowcolor[gray]{0.95} " if line.row == "pop" else ""
        ours = [_coloured(cell.ours, cell.place) for cell in cells]
        lines.append(_row([shade + _plain(line.name), "here", *ours, _plain(_latex_runs(line))]))
        if beside:
            printed = [_coloured(cell.paper, cell.paper_place) for cell in cells]
            differences = [_latex_noted(cell.difference, notes) for cell in cells]
            lines.append(_row(["", "paper", *printed, "the paper"]))
            lines.append(_row(["", "difference", *differences, "here less the paper"]))
    lines += [r"\bottomrule", r"\end{tabular}}"]
    below = [rf"\par $^{{{i}}}$ {_plain(text)}" for i, text in enumerate(notes.texts, start=1)]
    return "\n".join([*lines, *below])


def _ratios(table: Table, block: Block) -> str:
    named = {line.row: line.name for part in table.blocks for line in part.lines}
    lines = [
        rf"\resizebox{{\textwidth}}{{!}}{{\begin{{tabular}}{{@{{}}l{'r' * len(block.columns)}@{{}}}}",
        r"\toprule",
        rf"\multicolumn{{{1 + len(block.columns)}}}{{@{{}}l@{{}}}}{{{_plain(block.title)}}} \\",
        _row(["Method", *map(_plain, block.columns)]),
        r"\midrule",
        *(_row([_plain(named[row]), *map(_plain, texts)]) for row, texts in (block.relative or {}).items()),
    ]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}"])


def _row(cells: list[str]) -> str:
    return " & ".join(cells) + r" \\"


def _latex_noted(text: str, notes: Notes) -> str:
    short, number = notes.short(text)
    return _plain(short) + (f"$^{{{number}}}$" if number else "")


def _coloured(text: str, place: int) -> str:
    return (rf"\cellcolor{{{_COLOURS[place]}}}" if place else "") + _plain(text)


def _latex_runs(line: Line) -> str:
    if not line.runs:
        return "none"
    more = f" and {len(line.runs) - _IDS} more" if len(line.runs) > _IDS else ""
    return f"n = {line.seeds}: {', '.join(run.split()[-1] for run in line.runs[:_IDS])}{more}"


def _plain(text: str) -> str:
    return text.translate(_ESCAPES)
