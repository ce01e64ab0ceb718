"""Faults drawn at random from the C++ engine that trains on CPUs: how many of them do the kit's laws notice?

    python -m benchmarks.engine_mutants --draw 60 --work out/engine     # goes on where it was stopped
    python -m benchmarks.engine_mutants --lines --work out/engine       # which lines no law runs, by gcov
    python -m benchmarks.engine_mutants                                 # what the JSON says

A site is an operator, a number or a statement of the engine's C++, and of the arithmetic that it shares with the CUDA
kernels. Each fault is compiled by itself, with little optimization, and every law that judges the engine is tried with
four examples: in float32, which trains, then in float64. What does not compile is drawn anew. Whether a fault that no
law notices changes anything at all is found by reading; the JSON keeps that in words, under "changes nothing", and by
hand which law of later has noticed it.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.record import commit, lines_run, read_json, write_json
from cuda_ext.toolkit import find_compiler, no_compiler
from pop_fast.children import module_command
from pop_fast.compiled import build, library
from pop_ref.conformance.backends import shipped
from pop_ref.conformance.mutants.trial import every_law, noticed

ROOT: Final = Path(__file__).resolve().parents[1]
RESULTS: Final = ROOT / "benchmarks" / "results" / "engine_mutants.json"
EXAMPLES: Final = 4
PRECISIONS: Final = ("compiled32", "compiled64")
# what takes longer hangs
SECONDS: Final = 1200.0
# they start threads, name vectors of lanes and declare functions
_LEFT_OUT: Final = ("threads.h", "c_api.h", "lanes.h", "real.cuh")
_FLAGS: Final = (*(flag for flag in build.FLAGS if flag not in ("-O3", "-shared")), "-O1", *build.TUNING[0])

_SWAPS: Final = {
    " + ": " - ", " - ": " + ", " * ": " / ", " / ": " * ", " < ": " <= ", " <= ": " < ", " > ": " >= ", " >= ": " > ",
    " == ": " != ", " != ": " == ", " && ": " || ", " || ": " && ", " += ": " = ", " -= ": " = ",
    "std::min": "std::max", "std::max": "std::min", "(!": "(", "if (": "if (!",
}  # fmt: skip
_OPERATOR: Final = re.compile("|".join(map(re.escape, sorted(_SWAPS, key=len, reverse=True))))
_NUMBER: Final = re.compile(r"(?<![\w.\[<])(\d+\.\d+|\d+)(?=f?[\s,;)\]])")
_STATEMENT: Final = re.compile(r"^\s+[\w.>\[\]*()+-]+ [+-]?= .*;$|^\s+(continue|break);$|^\s+[\w.]+\(.*\);$")
# what a compiler reads, and memory
_NOT_ARITHMETIC: Final = re.compile(
    r"^\s*(#|//|template|static_assert|using|namespace|extern)|resize|bytes\(|make_unique"
)


@dataclass(frozen=True)
class Fault:
    """One line of the engine, changed."""

    file: str  # in the checkout
    line: int  # its number, from 1
    # the line before and after
    old: str
    new: str

    @property
    def name(self) -> str:
        """Return how the JSON calls it."""
        return f"{self.file}:{self.line}: {self.old.strip()} -> {self.new.strip()}"


def faults() -> list[Fault]:
    """Return every fault that can be drawn."""
    files = [*(build.HERE / name for name in build.SOURCES), *(build.CUDA / name for name in build.SHARED)]
    return [
        Fault(str(file.relative_to(ROOT)), number, line, new)
        for file in sorted(files)
        if file.name not in _LEFT_OUT
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        if not _NOT_ARITHMETIC.search(line)
        for new in dict.fromkeys(_broken(line))
    ]


def _broken(line: str) -> Iterator[str]:
    code, mark, comment = line.partition("  //")
    for at in _OPERATOR.finditer(code):
        yield code[: at.start()] + _SWAPS[at.group()] + code[at.end() :] + mark + comment
    for at in _NUMBER.finditer(code):
        told = at.group(1)
        value = str(int(told) + 1) if told.isdigit() else f"{float(told) * 1.1 or 0.1:.6g}"
        yield code[: at.start()] + value + code[at.end() :] + mark + comment
    if _STATEMENT.match(code):
        yield "  ;"


def compiled(fault: Fault | None, work: Path) -> Path | None:
    """Compile the engine with a fault, or sound; return the library, None where that does not compile."""
    sources = work / "faulty"
    for name in (*(build.HERE / s for s in build.SOURCES), *(build.CUDA / s for s in build.SHARED)):
        to = sources / name.relative_to(ROOT)
        to.parent.mkdir(parents=True, exist_ok=True)
        lines = name.read_text(encoding="utf-8").splitlines()
        if fault is not None and str(name.relative_to(ROOT)) == fault.file:
            lines[fault.line - 1] = fault.new
        to.write_text("\n".join(lines) + "\n", encoding="utf-8")
    objects = [_object(sources, unit, fault, work) for unit in build.UNITS]
    if None in objects:
        return None
    # a name of its own, since a library that is loaded stays loaded
    made = work / f"engine_{time.monotonic_ns()}.so"
    subprocess.run([*_compiler(), "-shared", "-pthread", "-o", str(made), *map(str, objects)], check=True)
    return made


def _object(sources: Path, unit: str, fault: Fault | None, work: Path) -> Path | None:
    """Compile one unit; what does not read the faulty file is compiled once."""
    touched = fault is not None and Path(fault.file).name in _read_by(unit)
    to = work / f"{'faulty' if touched else 'sound'}_{unit}.o"
    if not touched and to.exists():
        return to
    command = [*_compiler(), *_FLAGS, f"-I{sources}", "-c", "-o", str(to), str(sources / "pop_fast/compiled" / unit)]
    return to if subprocess.run(command, capture_output=True, check=False).returncode == 0 else None


def _compiler() -> list[str]:
    found = find_compiler()
    if found is None:
        raise SystemExit(no_compiler())
    return found


def _read_by(unit: str) -> set[str]:
    """Return the names of the files that a unit includes, itself among them."""
    found, left = set[str](), [build.HERE / unit]
    while left:
        file = left.pop()
        if file.name not in found and file.exists():
            found.add(file.name)
            included = re.findall(r'#include "(.*)"', file.read_text(encoding="utf-8"))
            left += [ROOT / name if name.startswith("cuda_ext/") else file.parent / name for name in included]
    return found


def in_a_child(judge: Callable[..., str], *args: Any) -> str:
    """Return what a function of text says in a child process, "crash" or "hang" where it does not come to its end."""
    here, there = os.pipe()
    child = os.fork()
    if child == 0:
        with os.fdopen(there, "w", encoding="utf-8") as answer:
            answer.write(judge(*args))
        os._exit(0)
    os.close(there)
    with os.fdopen(here, encoding="utf-8") as answer:
        ready, _, _ = select.select([answer], [], [], SECONDS)
        if not ready:
            os.kill(child, signal.SIGKILL)
        said = answer.read()
    _, status = os.waitpid(child, 0)
    return "hang" if not ready else said if status == 0 else "crash"


def noticed_by(engine: Path) -> str:
    """Return the first law that breaks on an engine, "crash" or "hang", or "" where all laws hold."""
    return in_a_child(_judge, engine)


def _judge(engine: Path) -> str:
    # both modules name the function; the child ends with its answer, so that nothing has to be put back
    for module in (build, library):
        module.__dict__["library_path"] = lambda: engine
    for name in PRECISIONS:
        backend = shipped(name)
        for path, law in every_law().items():
            broken = noticed(law, backend, EXAMPLES)
            if broken is not None:
                return f"{path} ({name}): {broken[:160]}"
    return ""


def draw(count: int, seed: int, work: Path) -> None:
    """Draw faults until so many have been tried, and write what becomes of each into the JSON."""
    every, tried = faults(), read_json(RESULTS)
    if "sound" not in tried:
        engine = compiled(None, work)
        if engine is None or noticed_by(engine):
            raise SystemExit("the sound engine does not compile, or breaks a law: nothing can be told of faulty ones")
        tried["sound"] = {"sites": len(every), "seed": seed, "commit": commit(ROOT)}
    for fault in random.Random(seed).sample(every, len(every)):
        if len([name for name in tried if name not in ("sound", "lines")]) >= count:
            return
        if fault.name in tried or (engine := compiled(fault, work)) is None:
            continue
        tried[fault.name] = {"noticed by": noticed_by(engine)}
        engine.unlink()
        write_json(RESULTS, tried)
        print(fault.name, tried[fault.name], flush=True)


def engine_lines(work: Path) -> dict[str, Any]:
    """Return how many of the engine's lines the laws run, and those that they do not, by file.

    Raises:
        SystemExit: there is no gcov or compiler, or the sound engine breaks a law.
    """
    gcov = shutil.which("gcov")
    if gcov is None:
        raise SystemExit("there is no gcov, which comes with g++")
    with TemporaryDirectory(dir=work) as folder:
        engine = Path(folder) / "counted.so"
        units = [str(build.HERE / unit) for unit in build.UNITS]
        flags = (*_FLAGS, "--coverage", "-fprofile-update=atomic", "-shared", f"-I{ROOT}")
        subprocess.run([*_compiler(), *flags, "-o", str(engine), *units], check=True, cwd=folder)
        judge = subprocess.run(
            module_command("benchmarks.engine_mutants", "--judge", str(engine)), check=False, cwd=ROOT
        )
        if judge.returncode:
            raise SystemExit("the sound engine breaks a law: no line can be told to be judged")
        found = lines_run(gcov, Path(folder), [path.name for path in Path(folder).glob("*.gcda")], check=True)
    ran = {(str(path.relative_to(ROOT)), n): run for (path, n), run in found.items() if path.is_relative_to(ROOT)}
    left: dict[str, list[str]] = {}
    for name, number in sorted(at for at, run in ran.items() if not run):
        left.setdefault(name, []).append((ROOT / name).read_text(encoding="utf-8").splitlines()[number - 1].strip())
    return {"lines": len(ran), "run": sum(ran.values()), "not run": left, "commit": commit(ROOT)}


def told(tried: dict[str, Any]) -> list[str]:
    """Return what the JSON says, a line each: how many die, and what lives."""
    about = ("sound", "lines")
    rows = {name: row for name, row in tried.items() if name not in about and "changes nothing" not in row}
    died = [row["noticed by"] for row in rows.values() if row["noticed by"]]
    errors = sum(said in ("crash", "hang") for said in died)
    same = len([name for name in tried if name not in about]) - len(rows)
    lived = {name: row for name, row in rows.items() if not row["noticed by"]}
    lives = [
        f"lived: {name}{', until ' + by if (by := row.get('noticed since by')) else ''}" for name, row in lived.items()
    ]
    counted = tried.get("lines")
    reached = [f"laws run {counted['run']:,} of {counted['lines']:,} lines"] if counted else []
    return [f"{len(died)} of {len(rows)} die, {errors} of them by a crash; {same} change nothing", *reached, *lives]


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--draw", type=int, help="how many faults to try, those of the JSON among them")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lines", action="store_true", help="count which lines laws run")
    parser.add_argument("--judge", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--work", type=Path, default=Path("out/engine"), help="folder for what is compiled")
    args = parser.parse_args()
    if args.judge is not None:
        sys.exit(_judge(args.judge) or 0)
    if args.lines:
        args.work.mkdir(parents=True, exist_ok=True)
        write_json(RESULTS, read_json(RESULTS) | {"lines": engine_lines(args.work.resolve())})
    if args.draw is not None:
        args.work.mkdir(parents=True, exist_ok=True)
        draw(args.draw, args.seed, args.work.resolve())
    print("\n".join(told(read_json(RESULTS))))


if __name__ == "__main__":
    main()
