"""The tables of docs/FORMATS.md, made from the program's table of file formats and from what was measured.

python docs/formats.py            print the page
python docs/formats.py --write    put them into docs/FORMATS.md, between their marks
python docs/formats.py --check    exit with 1 when the file holds something else
"""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.record import read_json, with_table
from paper_repro.table_formats import grid
from pop_fast.io.formats import FORMATS

PAGE = Path(__file__).resolve().parent / "FORMATS.md"
SIZES = PAGE.parents[1] / "benchmarks" / "results" / "sizes.json"
BUDGETS = SIZES.with_name("budgets.json")
_FIELDS = ("centre", "scale", "rotation", "opacity", "colour", "view dependence")


def page() -> str:
    """Make the page: its text, with the tables between their marks."""
    text = PAGE.read_text(encoding="utf-8")
    for name, make in TABLES.items():
        text = with_table(text, name, make())
    return text


def _sizes() -> str:
    rows = [
        ["`ply`", "`.ply`", "PLY as 3DGS writes it", "248", "248", "every program that knows splats"],
        *(
            [f"`{f.name}`", f"`{f.suffix}`", f"{f.title}, `{f.source.removeprefix('https://')}`", *f.size, f.readers]
            for f in FORMATS.values()
        ),
        ["`html`", "`.html`", "a page that shows the splat", "4/3 of `spz`", "4/3 of `spz`", "browsers with WebGL 2"],
    ]
    return grid(["format", "suffix", "what it is", "bytes a Gaussian, degree 0", "degree 3", "opened by"], rows)


def _losses() -> str:
    rows = [["`ply`", *["none"] * len(_FIELDS)]]
    rows += [[f"`{f.name}`", *(f.losses[field] for field in _FIELDS)] for f in FORMATS.values()]
    return grid(["format", *_FIELDS], rows)


def _measured() -> str:
    found = read_json(SIZES)
    captures, each = found["captures"], found["ply_bytes"]
    shares = sorted({row["final_prune"] for of in captures.values() for row in of["rows"]})
    head = ["capture", "format", *(f"`--final-prune {share:g}`" if share else "whole" for share in shares)]
    rows, sources = [], []
    for name, of in captures.items():
        whole = of["gaussians"] * each
        sources.append(f"{name}, {of['gaussians']:,} Gaussians, {whole / 1e6:.2f} MB as PLY, {of['psnr']:.2f} dB")
        cells = {
            (row["format"], row["final_prune"]): f"{row['bytes'] / 1e6:.2f} MB, 1/{whole / row['bytes']:.1f}, "
            f"{row['psnr'] - of['psnr']:+.2f} dB"
            for row in of["rows"]
        }
        formats = dict.fromkeys(row["format"] for row in of["rows"])
        rows += [[name, f"`{format}`", *(cells[format, share] for share in shares)] for format in formats]
    return f"The whole splats are {'; '.join(sources)}.\n\n{grid(head, rows)}"


def _budgets() -> str:
    rows = []
    for name, found in read_json(BUDGETS)["captures"].items():
        for row in found["rows"]:
            cells = [f"{row[kind]['psnr'] - found['psnr']:+.2f} dB" for kind in ("fewer", "spent", "tuned")]
            rows.append([name, f"`{row['format']}`", f"{row['bytes'] / 1e6:.2f} MB, 1/{row['share']}", *cells])
    steps = f"and tuned, {read_json(BUDGETS)['steps']} steps"
    return grid(["capture", "format", "bytes", "fewer Gaussians alone", "harmonics and digits too", steps], rows)


def _tuned() -> str:
    rows = [
        [name, str(of["factor"]), f"{of['gaussians']:,}", f"{of['psnr']:.2f}", f"{of['psnr_tuned']:.2f}"]
        for name, of in read_json(BUDGETS)["captures"].items()
    ]
    return grid(["capture", "photographs shrunk by", "Gaussians", "PSNR, dB", "tuned, dB"], rows)


TABLES = {"sizes": _sizes, "losses": _losses, "measured": _measured, "budgets": _budgets, "whole": _tuned}


def main() -> int:
    """Print, write or check the page."""
    made = page()
    if "--write" in sys.argv:
        PAGE.write_text(made, encoding="utf-8")
        return 0
    if "--check" in sys.argv:
        return int(PAGE.read_text(encoding="utf-8") != made)
    print(made, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
