"""A table of the reproduction as LaTeX, with the paper's colours for the best three; needs booktabs and xcolor[table].

The colours are those of the paper's source: bestred, secondorange, thirdyellow; `PREAMBLE` defines them.
"""

from __future__ import annotations

from typing import Final

from paper_repro.paper import Metric
from paper_repro.table_formats import Notes
from paper_repro.tables import Block, Cell, Line, Table

PREAMBLE: Final = r"""\usepackage{booktabs}
\usepackage{graphicx}
\usepackage[table]{xcolor}
\definecolor{bestred}{RGB}{255,120,120}
\definecolor{secondorange}{RGB}{255,190,100}
\definecolor{thirdyellow}{RGB}{255,240,100}
"""
_COLOURS: Final = ("", "bestred", "secondorange", "thirdyellow")
_ARROWS: Final = {"least": r"$\downarrow$", "most": r"$\uparrow$"}
_ESCAPES: Final = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "&%_#$"},
        "±": r"$\pm$",
        "*": r"$^\ast$",
    }
)


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
        lines.append(_row([shade + _plain(line.name), "here", *map(_ours, cells), _plain(_runs(line))]))
        if beside:
            lines.append(_row(["", "paper", *map(_paper, cells), "the paper"]))
            lines.append(
                _row(["", "difference", *(_noted(cell.difference, notes) for cell in cells), "here less the paper"])
            )
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


def _noted(text: str, notes: Notes) -> str:
    short, number = notes.short(text)
    return _plain(short) + (f"$^{{{number}}}$" if number else "")


def _ours(cell: Cell) -> str:
    return _coloured(cell.ours, cell.place)


def _paper(cell: Cell) -> str:
    return _coloured(cell.paper, cell.paper_place)


def _coloured(text: str, place: int) -> str:
    return (rf"\cellcolor{{{_COLOURS[place]}}}" if place else "") + _plain(text)


def _named(metric: Metric) -> str:
    return f"{metric.name} ({metric.unit})" if metric.unit else metric.name


def _runs(line: Line) -> str:
    if not line.runs:
        return "none"
    return f"n = {line.seeds}: {', '.join(run.split()[-1] for run in line.runs[:3])}" + (
        f" and {len(line.runs) - 3} more" if len(line.runs) > 3 else ""
    )


def _plain(text: str) -> str:
    return text.translate(_ESCAPES)
