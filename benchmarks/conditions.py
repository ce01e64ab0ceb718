"""Every condition and bound of the oracle and of the program, broken by itself: how many do the kit's laws notice?

    python -m benchmarks.conditions --work out/conditions     # hours; goes on with what the JSON does not know
    python -m benchmarks.conditions                           # what the JSON says

What is broken: a clause of a condition is left out, a condition holds always or never, a filter of a comprehension lets
everything through, a comparison is strict or not, one side of a minimum, maximum or clamp is left out, a rounding or
absolute value is not taken. Conditions that refuse bad input are left alone. Every law is tried with four examples,
in float32 where there are two precisions; with `--examples` what lived is tried again with more, in both.
Whether a fault that lives changes anything is found by reading; the JSON keeps that in words, under "changes nothing",
and by hand which law of later has noticed it.
"""

from __future__ import annotations

import argparse
import ast
import random
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from benchmarks.engine_mutants import in_a_child
from benchmarks.record import commit, read_json, write_json
from pop_ref.conformance.mutants.copies import ORACLE, PROGRAM, Mutant
from pop_ref.conformance.mutants.trial import alive, every_law, noticed

ROOT: Final = Path(__file__).resolve().parents[1]
RESULTS: Final = ROOT / "benchmarks" / "results" / "conditions.json"
FEW: Final = 4
# what draws and trains; not tables, sums of float errors, refusals and files
FILES: Final = {
    ORACLE: """activations alpha appearance camera chord compositing contributions covariance density density_rows
        depth dominance fisher footprint harmonics losses methods mini_splatting optimizer pixel polarization projection
        refinement regularizers render selection splatting ssim taming tight_tiles tiles training""",
    PROGRAM: """stages/appearance stages/blend stages/compositing stages/contributions stages/covariance stages/density
        stages/harmonics stages/losses stages/projection stages/regularizers stages/splatting stages/tile_groups
        stages/tiles density/control density/methods density/passes density/protocol density/rows train/appearance
        train/schedule train/steps train/torch_stepper train/views api/rasterize""",
}
_STRICT: Final = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
_SIGN: Final = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}
_OF_TWO: Final = ("min", "max", "minimum", "maximum")
_OF_ONE: Final = ("abs", "ceil", "floor", "rint", "round", "detach")


@dataclass(frozen=True)
class Site(Mutant):
    """A module with one condition broken."""

    text: str = ""  # of the module

    def broken_source(self) -> str:
        """Return the module's text."""
        return self.text


def sites() -> list[Site]:
    """Return every fault, each text once; those that read alike in one file are numbered."""
    found = [site for package, names in FILES.items() for name in names.split() for site in _of(package, f"{name}.py")]
    once, seen = {(site.package, site.file, site.text): site for site in found}, Counter[str]()
    named: list[Site] = []
    for site in once.values():
        seen[site.name] += 1
        named.append(replace(site, name=f"{site.name} ({seen[site.name]})") if seen[site.name] > 1 else site)
    return named


def _of(package: str, file: str) -> Iterator[Site]:
    source = (ROOT / package / file).read_bytes()
    tree = ast.parse(source)
    starts = [0]
    for line in source.split(b"\n"):
        starts.append(starts[-1] + len(line) + 1)
    refusing = _refusing(tree)
    for node in ast.walk(tree):
        if node in refusing:
            continue
        for of, new in _broken(node):
            begin, end = (starts[row - 1] + col for row, col in _ends(of))
            text = (source[:begin] + new.encode() + source[end:]).decode()
            old = source[begin:end].decode()
            name = f"{package}/{file}: {' '.join(old.split())} -> {' '.join(new.split())}"
            yield Site(name, "", file, old, new, "", package, text)


def _ends(node: ast.expr) -> tuple[tuple[int, int], tuple[int, int]]:
    # what has been parsed has an end
    return (node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0)


def _refusing(tree: ast.Module) -> set[ast.AST]:
    """Return the nodes of refusals, and of what a type checker alone reads."""
    found: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise | ast.Assert):
            found |= set(ast.walk(node))
        if isinstance(node, ast.If) and (
            all(isinstance(each, ast.Raise) for each in node.body) or "TYPE_CHECKING" in ast.dump(node.test)
        ):
            found |= {node, *ast.walk(node.test)}
        if isinstance(node, ast.AnnAssign):
            found |= set(ast.walk(node.annotation))
        if isinstance(node, ast.FunctionDef):
            if node.name.lstrip("_").startswith("check"):
                found |= set(ast.walk(node))
            of = (node.args, node.returns, *node.decorator_list)
            found |= {each for part in of if part is not None for each in ast.walk(part)}
    return found


def _broken(node: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Yield what is replaced at a node, and by what."""
    if isinstance(node, ast.BoolOp):
        word = " and " if isinstance(node.op, ast.And) else " or "
        for left_out in node.values:
            yield node, f"({word.join(f'({ast.unparse(each)})' for each in node.values if each is not left_out)})"
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitAnd | ast.BitOr):
        for each in (node.left, node.right):
            yield node, f"({ast.unparse(each)})"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Invert):
        yield node, f"({ast.unparse(node.operand)})"
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        yield node.test, "False"
        # what is repeated for ever says nothing
        if not isinstance(node, ast.While):
            yield node.test, "True"
    elif isinstance(node, ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp):
        yield from ((condition, "True") for of in node.generators for condition in of.ifs)
    elif isinstance(node, ast.Compare) and all(type(op) in _STRICT for op in node.ops):
        yield from _compared(node)
    elif isinstance(node, ast.Call):
        yield from ((node, new) for new in _bounded(node))


def _compared(node: ast.Compare) -> Iterator[tuple[ast.expr, str]]:
    values = [ast.unparse(value) for value in (node.left, *node.comparators)]
    for at, op in enumerate(node.ops):
        signs = [_STRICT[type(each)] if each is op else _SIGN[type(each)] for each in node.ops]
        yield node, f"({values[0]}{''.join(f' {sign} {value}' for sign, value in zip(signs, values[1:], strict=True))})"
        if len(node.ops) > 1:
            yield node, f"({values[at]} {_SIGN[type(op)]} {values[at + 1]})"


def _bounded(node: ast.Call) -> Iterator[str]:
    of, args = node.func, [ast.unparse(each) for each in node.args]
    name = of.attr if isinstance(of, ast.Attribute) else getattr(of, "id", "")
    if name in _OF_TWO and len(args) == 2 and not node.keywords:
        yield from (f"({each})" for each in args)
    elif name == "clip" and len(args) == 3:
        value, least, most = args
        yield from (f"np.minimum({value}, {most})", f"np.maximum({value}, {least})")
    elif name in ("clamp", "clamp_") and isinstance(of, ast.Attribute):
        named = dict(zip(("min", "max"), args, strict=False)) | {k.arg: ast.unparse(k.value) for k in node.keywords}
        for left_out in named:
            kept = ", ".join(f"{key}={value}" for key, value in named.items() if key != left_out)
            yield f"{ast.unparse(of)}({kept})" if kept else f"({ast.unparse(of.value)})"
    elif name in _OF_ONE and not node.keywords:
        if args:
            yield f"({args[0]})"
        elif isinstance(of, ast.Attribute):
            yield f"({ast.unparse(of.value)})"


def noticed_by(site: Site, precision: str, first: list[str], examples: int) -> str:
    """Return the first law that breaks on a fault, of the laws in an order; "" where all hold."""
    laws = every_law()
    try:
        with alive(site, precision) as backend:
            for path in first:
                broken = noticed(laws[path], backend, examples)
                if broken is not None:
                    return f"{path}: {broken[:160]}"
    except Exception as error:
        # the copy cannot be imported
        return f"no copy: {type(error).__name__}"
    return ""


def trial(work: Path, share: tuple[int, int], examples: int) -> None:
    """Try every fault, or a share of them, and keep what becomes of each in a file of `work`.

    Args:
        work: the folder.
        share: every Nth fault from the Kth, as (K, N).
        examples: of each law; what lived with fewer, and is not known to change nothing, is tried again.
    """
    kept, known = work / f"conditions_{share[0]}_of_{share[1]}.json", read_json(RESULTS).get("lives", {})
    before_this = _all_tried(work)
    tried, by_file = read_json(kept), defaultdict[str, Counter[str]](Counter)
    for name, how in before_this.items():
        by_file[name.split(":")[0]][how["by"].split(": ")[0]] += 1
    # shuffled, so that what has been tried is a sample of all
    for site in random.Random(1).sample(sites(), len(sites()))[share[0] :: share[1]]:
        before = before_this.get(site.name)
        if before is not None and (
            before["by"] or before["examples"] >= examples or "changes nothing" in known.get(site.name, {})
        ):
            continue
        of = by_file[f"{site.package}/{site.file}"]
        first = sorted(every_law(), key=lambda path, of=of, file=site.file: (-of[path], _unlikely(path, file), path))
        said = ""
        for precision in site.precisions[: 1 if examples <= FEW else None]:
            said = said or in_a_child(noticed_by, site, precision, first, examples)
        tried[site.name] = {"by": said, "examples": examples}
        write_json(kept, tried)
        print(site.name, said or "LIVES", flush=True)
        of[said.split(": ")[0]] += 1


def _unlikely(path: str, file: str) -> bool:
    """Tell whether a law is tried after others: only those of trainings see much of what trains."""
    trains = path.startswith(("test_whole_steps", "test_strategies", "test_collected", "test_few_photographs"))
    return file.startswith(("density/", "train/", "methods", "training")) != trains


def _all_tried(work: Path) -> dict[str, dict[str, Any]]:
    """Return what became of every fault that the JSON or a file of `work` knows."""
    results = read_json(RESULTS)
    tried = {name: {"by": "a law", "examples": FEW} for name in results.get("died", [])}
    tried |= {name: {"by": "", "examples": FEW} for name in results.get("lives", {})}
    for kept in sorted(work.glob("conditions_*.json")):
        tried |= read_json(kept)
    return tried


def gathered(work: Path) -> dict[str, Any]:
    """Return of all shares how many faults were tried and died, and what lives; what was found by reading stays."""
    everything = _all_tried(work)
    tried = {site.name: everything[site.name] for site in sites() if site.name in everything}
    known = read_json(RESULTS).get("lives", {})
    counts = {
        package: {
            "tried": sum(name.startswith(package) for name in tried),
            "died": sum(name.startswith(package) and how["by"] != "" for name, how in tried.items()),
        }
        for package in FILES
    }
    lives = {name: known.get(name, {}) for name, how in tried.items() if not how["by"]}
    died = sorted(name for name, how in tried.items() if how["by"])
    return {**counts, "lives": lives, "died": died, "commit": commit(ROOT)}


def told(found: dict[str, Any]) -> list[str]:
    """Return what the JSON says, a line each."""
    lines = []
    for package in FILES:
        lived = {name: how for name, how in found["lives"].items() if name.startswith(package)}
        same = sum("changes nothing" in how for how in lived.values())
        faults = found[package]["tried"] - same
        lines.append(f"{package}: {found[package]['died']} of {faults} die; {same} change nothing")
        lines += [
            f"lived: {name}{', until ' + by if (by := how.get('noticed since by')) else ''}"
            for name, how in lived.items()
            if "changes nothing" not in how
        ]
    return lines


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--work", type=Path, help="folder for what was tried")
    parser.add_argument("--examples", type=int, default=FEW, help="of each law; what lived with fewer is tried again")
    parser.add_argument("--share", type=int, nargs=2, default=(0, 1), metavar=("K", "N"), help="every Nth from the Kth")
    args = parser.parse_args()
    if args.work is not None:
        args.work.mkdir(parents=True, exist_ok=True)
        trial(args.work, tuple(args.share), args.examples)
        write_json(RESULTS, gathered(args.work))
    print("\n".join(told(read_json(RESULTS))))


if __name__ == "__main__":
    main()
