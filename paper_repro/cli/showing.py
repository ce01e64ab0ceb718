"""`pop-repro status`, `table`, `figure` and `claims`: what the results say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from paper_repro.cli import parser_of
from paper_repro.cli.options import WORK, add_data, add_results, add_scale
from pop_fast.errors import PopError

__all__ = ["claims", "figure", "status", "table"]

_SEED: Final = 42
_STATUS: Final = """
    pop-repro status --scale small
    pop-repro status --scale paper --rows pop gsplat --seeds 3
"""
_TABLE: Final = """
    pop-repro table 1 --scale small                         to read, as Markdown
    pop-repro table 1 --scale small --out out               table_1.md, table_1.tex and table_1.csv
    pop-repro table beyond --scale small                    what goes beyond the paper
"""
_FIGURE: Final = """
    pop-repro figure 7 --scale small --out out              figure_7.svg, figure_7.png and the numbers in figure_7.csv
    pop-repro figure 5 --scale small --work WORK            of the renders that finished rows keep in their work folder
    pop-repro figure 3 --scale small --data DATA            trains 1,000 steps, on the CPU, from a 3DGS model
"""
_CLAIMS: Final = """
    pop-repro claims --scale small                          each claim, its verdict, its intervals, what would decide it
"""


def status(words: Sequence[str]) -> int:
    """Print how far the runs of a scale are."""
    parser = parser_of("status", _STATUS)
    add_scale(parser)
    add_results(parser)
    parser.add_argument("--work", type=Path, default=WORK, metavar="DIR", help="the checkpoints (default: %(default)s)")
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="these rows alone (default: all)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="these scenes alone (default: the scale's)")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help=f"seeds of each: {_SEED}, {_SEED + 1}, ...")
    args = parser.parse_args(words)
    from paper_repro.jobs import jobs_of
    from paper_repro.progress import progress
    from paper_repro.results import existing_folder
    from paper_repro.rows import ROWS

    jobs = jobs_of(args.scale, args.rows or ROWS, args.scenes, range(_SEED, _SEED + args.seeds))
    print("\n".join(progress(jobs, existing_folder(args.results), args.work)))
    return 0


def table(words: Sequence[str]) -> int:
    """Print a table, or write it in three formats."""
    parser = parser_of("table", _TABLE)
    parser.add_argument("number", metavar="N", choices=("1", "2", "3", "4", "5", "beyond"), help="1 to 5, or beyond")
    add_scale(parser)
    add_results(parser)
    add_data(parser)
    note = "write table_N.md, table_N.tex and table_N.csv there instead of printing"
    parser.add_argument("--out", type=Path, metavar="DIR", help=note)
    args = parser.parse_args(words)
    from paper_repro import tables
    from paper_repro.results import existing_folder, read_all
    from paper_repro.table_latex import latex
    from paper_repro.table_markdown import csv_text, markdown

    results, absent = read_all(args.scale, existing_folder(args.results)), _absent(args.scale, args.data)
    made = (
        tables.beyond(args.scale, results, absent)
        if args.number == "beyond"
        else tables.table(int(args.number), args.scale, results, absent)
    )
    if args.out is None:
        print(markdown(made))
        return 0
    for suffix, render in (("md", markdown), ("tex", latex), ("csv", csv_text)):
        _write(args.out / f"table_{args.number}.{suffix}", render(made))
    return 0


def figure(words: Sequence[str]) -> int:
    """Draw a figure."""
    from paper_repro.figures import FIGURES, draw

    parser = parser_of("figure", _FIGURE)
    titles = "; ".join(f"{number}: {title}" for number, (_, _, title) in FIGURES.items())
    parser.add_argument("id", metavar="ID", help=f"its number in the paper: {titles}")
    add_scale(parser)
    add_results(parser)
    add_data(parser)
    parser.add_argument(
        "--work", type=Path, default=WORK, metavar="DIR", help="pictures of finished rows (%(default)s)"
    )
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="where to write (default: out)")
    args = parser.parse_args(words)
    from paper_repro.results import existing_folder

    for path in draw(args.id, args.scale, existing_folder(args.results), args.out, args.work, args.data):
        print(path)
    return 0


def claims(words: Sequence[str]) -> int:
    """Print the verdict on each claim."""
    parser = parser_of("claims", _CLAIMS)
    add_scale(parser)
    add_results(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="write claims.md there instead of printing")
    args = parser.parse_args(words)
    from paper_repro.claims_page import markdown
    from paper_repro.results import existing_folder, read_all

    text = markdown(args.scale, read_all(args.scale, existing_folder(args.results)))
    if args.out is None:
        print(text)
    else:
        _write(args.out / "claims.md", text)
    return 0


def _absent(scale: str, data: Path) -> list[str]:
    """List the scenes of a scale that are not under the data root; nothing is known where there is no root."""
    from paper_repro.scales import scale_named
    from paper_repro.scenes import MADE, SCENES, find_folder

    if not data.is_dir():
        return []
    absent: list[str] = []
    for name in scale_named(scale).factors:
        try:
            _ = name in MADE or find_folder(SCENES[name], data)
        except PopError:
            absent.append(name)
    return absent


def _write(path: Path, text: str) -> None:
    from pop_fast.io.atomic import write_atomically

    write_atomically(path, lambda file: file.write((text.rstrip("\n") + "\n").encode()))
    print(path)
