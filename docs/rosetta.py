"""The Rosetta table of README.md: one row a stage, made by reading the sources (nothing is imported).

python docs/rosetta.py            print the table
python docs/rosetta.py --write    put it into README.md
python docs/rosetta.py --check    exit with 1 when README.md holds another one
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- rosetta:begin -->", "<!-- rosetta:end -->"


@dataclass(frozen=True)
class Stage:
    """A row: a step of the method, where the paper states it, the modules that hold it (same names in each room)."""

    title: str
    paper: str
    modules: tuple[str, ...]


STAGES = (
    Stage("raw parameters to scales, opacities, unit quaternions", "3.1", ("activations",)),
    Stage("covariances from rotations and scales", "3.1", ("covariance",)),
    Stage("spherical harmonics to colour", "3.1", ("harmonics",)),
    Stage("world to camera, near plane", "3.1", ("camera",)),
    Stage("projection of means and covariances (EWA)", "3.1", ("projection",)),
    Stage("low-pass, conics, extents, off-screen cull", "3.1", ("footprint",)),
    Stage("tile lists in depth order", "3.1", ("tiles",)),
    Stage("falloff and alpha of one splat at one pixel", "eq. 1, 11", ("alpha",)),
    Stage("blending with early ray termination", "eq. 1", ("compositing", "pixel")),
    Stage("dominant Gaussians", "eq. 5", ("dominance",)),
    Stage("a whole view", "eq. 1", ("render", "splatting")),
    Stage("L1, L2, SSIM and both objectives", "eq. 2, 4, 9", ("losses", "ssim")),
    Stage("importance mask and POP loss", "eq. 7, 8", ("polarization",)),
    Stage("density control", "eq. 3, 6", ("density", "density_config", "density_rows")),
    Stage("Adam and its schedules", "4.1", ("optimizer",)),
    Stage("one training step", "eq. 9", ("training",)),
    Stage("distance of every decision from flipping", "–", ("margins",)),
)


def functions(path: Path) -> dict[str, list[str]]:
    """Give the public functions of a source file, in order, each with its parameters' names."""
    if not path.is_file():
        return {}
    found = (n for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, ast.FunctionDef))
    return {f.name: [a.arg for a in (*f.args.args, *f.args.kwonlyargs)] for f in found if f.name[0] != "_"}


def room(name: str, stage: Stage) -> Iterator[Path]:
    """Give the files of a stage in one room, where they exist."""
    suffixes = (".cuh", ".cu") if name == "cuda_ext/csrc" else (".py",)
    for module in stage.modules:
        for suffix in suffixes:
            path = ROOT / name / f"{module}{suffix}"
            if path.is_file():
                yield path


def laws(stage: Stage) -> Iterator[Path]:
    """Give the law files of a stage: tests/laws/test_<module>*.py."""
    for module in stage.modules:
        yield from sorted((ROOT / "tests" / "laws").glob(f"test_{module}.py"))
        yield from sorted((ROOT / "tests" / "laws").glob(f"test_{module}_*.py"))


def table() -> str:
    """Make the table in Markdown."""
    lines = [
        "| stage | paper | functions | `pop_ref` | `pop_fast` | `cuda_ext` | laws |",
        "|---|---|---|---|---|---|---|",
    ]
    for stage in STAGES:
        names = [name for path in room("pop_ref", stage) for name in functions(path)]
        shown = [f"`{name}`" + ("ᵀ" if f"{name}_vjp" in names else "") for name in names if not name.endswith("_vjp")]
        places = [_links(room(place, stage)) for place in ("pop_ref", "pop_fast", "cuda_ext/csrc")]
        cells = [stage.title, stage.paper, ", ".join(shown), *places, _links(laws(stage))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _links(paths: Iterator[Path]) -> str:
    found = dict.fromkeys(paths)
    return ", ".join(f"[{path.name}]({path.relative_to(ROOT).as_posix()})" for path in found) or "–"


def with_table(readme: str) -> str:
    """Put the table between its marks in README.md's text."""
    before, rest = readme.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n{table()}\n{END}{after}"


def main(words: list[str]) -> int:
    """Run the script."""
    path = ROOT / "README.md"
    if "--write" not in words and "--check" not in words:
        print(table())
        return 0
    readme = path.read_text(encoding="utf-8")
    if "--write" in words:
        path.write_text(with_table(readme), encoding="utf-8")
    elif with_table(readme) != readme:
        print("README.md: the Rosetta table is not what the sources say; run 'python docs/rosetta.py --write'")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
