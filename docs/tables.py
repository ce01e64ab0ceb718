"""The tables of README.md that are made from the sources and from runs.

python docs/tables.py            print them
python docs/tables.py --write    put them into README.md, between their marks
python docs/tables.py --check    exit with 1 when README.md holds others
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from stages import ROOT, STAGES, files, functions, laws

from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, INRIA, PAPER
from pop_ref.notation import SYMBOLS

README = ROOT / "README.md"


def rosetta() -> str:
    """Make the table of stages: the same names in every room; a raised T marks functions that have a transpose."""
    rows = []
    for stage in STAGES:
        names = [name for path in files("pop_ref", stage) for name in functions(path)]
        shown = [f"`{name}`" + ("ᵀ" if f"{name}_vjp" in names else "") for name in names if not name.endswith("_vjp")]
        places = [_links(files(room, stage)) for room in ("pop_ref", "pop_fast", "cuda_ext/csrc")]
        rows.append([stage.title, stage.paper, ", ".join(shown), *places, _links(laws(stage))])
    return _table(["stage", "paper", "functions", "`pop_ref`", "`pop_fast`", "`cuda_ext`", "laws"], rows)


def conventions() -> str:
    """Make the table of symbols from `pop_ref.notation`."""
    rows = [[f"`{s.name}`", s.shape, s.unit, s.frame, f"${s.paper}$" if s.paper else "", s.meaning] for s in SYMBOLS]
    return _table(["name", "shape", "unit", "frame", "paper", "meaning"], rows)


def profiles() -> str:
    """Make the table of constants by profile from `pop_ref.constants`."""
    named = (PAPER, GSPLAT_1_5, GSPLAT_1_6, INRIA)

    def stop(inclusive: bool, value: float) -> str:
        return f"T {'≤' if inclusive else '<'} {value:g}"

    lines: list[tuple[str, Callable[..., str]]] = [
        ("near plane", lambda p: f"z {'≤' if p.near_inclusive else '<'} {p.near_plane:g}"),
        ("extent", lambda p: f"{p.extent.replace('_', '-')}, {p.extent_sigmas:g} sigma"),
        ("alpha ceiling, its gradient", lambda p: f"{p.alpha_ceiling:g}, {p.ceiling_gradient}"),
        ("alpha floor", lambda p: f"1/{1 / p.alpha_floor:.0f}"),
        ("a pixel stops at", lambda p: stop(p.stop_inclusive, p.transmittance_stop)),
        ("principal point", lambda p: p.principal_point),
        ("gradient of the frustum clamp", lambda p: p.clamp_gradient),
    ]
    return _table(["", *(f"`{p.name}`" for p in named)], [[title, *map(show, named)] for title, show in lines])


def results() -> str:
    """Make the table of training runs, as benchmarks/results_table.py does."""
    return str(runpy.run_path(str(ROOT / "benchmarks" / "results_table.py"))["table"]())


TABLES: dict[str, Callable[[], str]] = {
    "rosetta": rosetta,
    "conventions": conventions,
    "profiles": profiles,
    "results": results,
}


def with_tables(readme: str) -> str:
    """Put every table between its marks, `<!-- NAME:begin -->` and `<!-- NAME:end -->`."""
    for name, make in TABLES.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        before, _, rest = readme.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise ValueError(f"README.md has no marks {begin} ... {end}; put them where the table belongs")
        readme = f"{before}{begin}\n{make()}\n{end}{after}"
    return readme


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def _links(paths: Iterable[Path]) -> str:
    found = dict.fromkeys(paths)
    return ", ".join(f"[{path.name}]({path.relative_to(ROOT).as_posix()})" for path in found) or "–"


def main(words: list[str]) -> int:
    """Run the script."""
    if "--write" not in words and "--check" not in words:
        print("\n\n".join(make() for make in TABLES.values()))
        return 0
    readme = README.read_text(encoding="utf-8")
    if "--write" in words:
        README.write_text(with_tables(readme), encoding="utf-8")
    elif with_tables(readme) != readme:
        print("README.md: a table is not what sources and runs say; run 'python docs/tables.py --write'")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
