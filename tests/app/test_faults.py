"""Damaged input, a failing disk and sudden ends, at a few places each; `python -m benchmarks.faults` tries them all.

Everything that opens a file is tried by the fuzzer, or says here why not.
"""

from __future__ import annotations

import ast
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from benchmarks.faults import __main__ as command
from benchmarks.faults import runs, sanitizers
from benchmarks.faults.__main__ import KILLS
from benchmarks.faults.fuzz import FAILURES, OUTCOMES, kept
from benchmarks.faults.readers import READERS
from tests.app.conftest import ROOT, in_a_child

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="children are forked, and limited as Linux does")
STORED = ROOT / "benchmarks" / "results" / "faults.json"


def try_faults(out: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks.faults", "--quick", *words, "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, timeout=600)
    assert out.exists(), done.stderr[-3000:]
    return done


@pytest.fixture(scope="module")
def tried(made_once: Callable[..., Path]) -> dict[str, Any]:
    def make(folder: Path) -> None:
        done = try_faults(folder / "faults.json")
        assert (done.returncode == 0) == ("nothing failed" in done.stdout)

    return json.loads((made_once("faults", make) / "faults.json").read_text())


@pytest.mark.slow  # every reader in processes of its own
@pytest.mark.parametrize("reader", READERS)
def test_a_damaged_file_is_read_or_refused_in_a_line(tried: dict[str, Any], reader: str) -> None:
    found = tried["fuzz"]["readers"][reader]
    assert sum(found.values()) == 10 + len(kept(reader))
    failures = {key: value for key, value in tried["fuzz"]["failures"].items() if key.startswith(f"{reader}: ")}
    assert found["escaped"] + found["crashed"] + found["hung"] == 0, failures
    assert found["refused"] > 0 or not READERS[reader].refuses


def test_a_reader_that_is_tried_alone_replaces_its_own_results(tmp_path: Path) -> None:
    shutil.copy(STORED, tmp_path / "f.json")
    done = try_faults(tmp_path / "f.json", "--only", "fuzz", "--reader", "mask", "--seed", "5")
    assert done.returncode == 0, done.stderr
    before, after = (json.loads(path.read_text())["fuzz"] for path in (STORED, tmp_path / "f.json"))
    row = after["readers"].pop("mask")
    lost = before["readers"].pop("mask")
    assert row.pop("seed") == 5
    assert row.pop("commit")
    assert sum(row.values()) == 10 + len(kept("mask"))
    assert after.pop("inputs") == before.pop("inputs") + sum(row.values()) - sum(lost[kind] for kind in row)
    assert after == before


def faults_of(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["faults", *words])
    return command.main()


def test_what_cannot_be_tried_is_named_and_takes_nothing_from_what_is_known(tmp_path, monkeypatch, capsys) -> None:
    out, before = tmp_path / "f.json", json.loads(STORED.read_text())
    shutil.copy(STORED, out)
    monkeypatch.setattr(runs, "why_not", lambda: "there is no compiler")
    monkeypatch.setattr(sanitizers, "why_not", lambda check: "there is no compiler")
    monkeypatch.setattr(sanitizers.emulate, "why_not", lambda: "there is no compiler")
    words = [word for part in ("kills", "sanitizers") for word in ("--only", part)]
    assert faults_of(monkeypatch, *words, "--out", str(out)) == 0
    said = capsys.readouterr().out
    assert "left out: kills: runs: there is no compiler\n" in said
    assert "left out: sanitizers: compiled backend: there is no compiler\n" in said
    after = json.loads(out.read_text())
    assert {**after, "machine": None} == {**before, "machine": None}
    # a few places do not stand for all of them unasked
    monkeypatch.setattr(command, "RESULTS", tmp_path / "published.json")
    assert faults_of(monkeypatch, "--quick", *words) == 0
    assert not command.RESULTS.exists()


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ((), {"fuzz": 15.0, "native step": 5.0, "two ranks": 5.0, "blocks 2x1": 5.0}),
        (("--only", "kills"), {"native step": 10.0, "two ranks": 10.0, "blocks 2x1": 10.0}),
        (("--only", "kills", "--kind", "two ranks"), {"two ranks": 30.0}),
        (("--only", "fuzz", "--only", "crashes"), {"fuzz": 30.0}),
    ],
)
def test_minutes_are_shared_by_those_parts_that_run(tmp_path, monkeypatch, words, given) -> None:
    found, nothing = dict[str, float](), {"failures": []}

    def noted(name: str, minutes: float) -> dict[str, Any]:
        found[name] = minutes
        return {}

    monkeypatch.setattr(command.fuzz, "fuzz", lambda n, minutes, *_: nothing | noted("fuzz", minutes))
    monkeypatch.setattr(sanitizers, "sanitized", lambda **_: {"checks": {}, "failures": []})
    monkeypatch.setattr(runs, "why_not", lambda: None)
    monkeypatch.setattr(runs, "scene", nullcontext)
    monkeypatch.setattr(runs, "kill_loop", lambda kind, n, minutes, seed: nothing | noted(kind, minutes))
    for name in ("crash_points", "failing_writes"):
        monkeypatch.setattr(command.disk, name, lambda *_: {})
    monkeypatch.setattr(command.disk, "bit_flips", lambda *_: nothing)
    assert faults_of(monkeypatch, "--minutes", "30", *words, "--out", str(tmp_path / "f.json")) == 0
    assert found == given


def test_what_docs_reliability_tells_of_was_tried_of_every_reader_and_kind_of_run() -> None:
    # inputs that once broke something are kept
    assert sum(len(kept(reader)) for reader in READERS) >= 60
    stored = json.loads(STORED.read_text())
    of_readers = {name: {kind: row[kind] for kind in OUTCOMES} for name, row in stored["fuzz"]["readers"].items()}
    # one needs a package
    assert of_readers.keys() | {"photograph.heic"} == READERS.keys() | {"photograph.heic"}
    told = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    # a reader that was tried again alone has its own
    together = [of_readers[name] for name, row in stored["fuzz"]["readers"].items() if "seed" not in row]
    run = f"(seed {stored['fuzz']['seed']}, {stored['fuzz']['minutes']:.0f} minutes) gave {len(together)} readers"
    assert f"{run} {sum(sum(row.values()) for row in together):,} inputs" in told
    assert all(sum(row.values()) >= 1_000 for row in of_readers.values())
    assert sum(sum(row.values()) for row in of_readers.values()) == stored["fuzz"]["inputs"] >= 10**6
    assert not any(row[kind] for row in of_readers.values() for kind in FAILURES)
    assert stored["fuzz"]["failures"] == {}
    assert stored["kills"].keys() == KILLS.keys()
    assert all(stored["kills"][kind]["kills"] >= least for kind, least in KILLS.items())
    assert stored["crashes"].keys() == stored["writes"].keys() == JOBS.keys()
    for part in ("kills", "crashes", "writes", "flips"):
        assert all(found["failures"] == [] for found in stored[part].values()), part
    # the sanitizers have run the lines of every unit that counts them
    stored = stored["sanitizers"]
    assert stored["failures"] == []
    counted = {str(unit.relative_to(ROOT)) for check in sanitizers.CHECKS.values() for unit in check.units}
    assert set(stored["lines"]) == counted
    assert all(run >= sanitizers.LEAST_SHARE * of > 0 for run, of in stored["lines"].values())


JOBS = {
    "native step: train": 2,
    "native step: train --overwrite": 2,
    "native step: write a PLY": 2,
    "two ranks: train": 1,
    "blocks 2x1: train": 1,
}


@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("part", ["crashes", "writes"])
def test_a_sudden_end_or_a_refused_change_leaves_sound_files(tried: dict[str, Any], part: str, job: str) -> None:
    if "runs" in tried[part]:
        pytest.skip(tried[part]["runs"]["skipped"])
    assert set(tried[part]) == set(JOBS)
    found = tried[part][job]
    assert found["failures"] == []
    assert found["tried"] == JOBS[job]
    if part == "crashes":
        assert found["ended"] == found["tried"]
        assert found["points"] >= 4
    else:
        # it is told in a line; a run does without the flush of a folder
        assert found.get("told", 0) + found.get("continued", 0) == found["tried"]
        assert "told" in found or "PLY" not in job


@pytest.mark.slow
def test_a_checkpoint_with_a_flipped_bit_is_refused_or_read_as_before(tried: dict[str, Any]) -> None:
    for found in tried["flips"].values():
        # nearly all are seen; what is not lies between the members of the zip
        assert "skipped" in found or (found["failures"] == [] and found["refused"] > 80)


BITS = """
from benchmarks.faults import runs

with runs.scene("native step") as scene:
    assert scene.finish("run") is None
    one = scene.whole["splats"]["means"][0, 0]
    one.copy_(one.nextafter(one + 1.0))
    print(scene.finish("run"))
    runs.KINDS["native step"] = runs.Kind(("--refine-cameras",), 1, "native")
try:
    with runs.scene("native step"):
        pass
except RuntimeError as error:
    print(error)
"""


@pytest.mark.slow
def test_another_bit_and_another_stepper_are_noticed(tried: dict[str, Any]) -> None:
    if "runs" in tried["crashes"]:
        pytest.skip(tried["crashes"]["runs"]["skipped"])
    outcome = in_a_child(BITS)
    assert outcome.status == 0, outcome.err[-3000:]
    assert outcome.out.splitlines() == ["the bits differ", "native step: status 0, steps by torch"]


# a writer in the file's own place, and a job of which more changes were counted than it makes
DIRECT = """
import os
from contextlib import contextmanager
from benchmarks.faults import disk, runs
from pop_fast.io import atomic

jobs = disk._jobs
disk._jobs = lambda of: {"write a PLY": jobs(of)["write a PLY"]}
with runs.scene("native step") as scene:
    count = disk._count
    disk._count = lambda *words: count(*words) + 1
    found = disk.crash_points(scene, None)["write a PLY"]
    print(found["ended"] == found["points"] - 1, len(found["failures"]), found["failures"][0][-11:])
    disk._count, replace = count, os.replace
    atomic._beside = contextmanager(lambda path: (at for at in (path,)))
    os.replace = lambda a, b: a == b or replace(a, b)
    for part in (disk.crash_points, disk.failing_writes):
        print(*(failed[: failed.index(":")] for failed in part(scene, None)["write a PLY"]["failures"]))
"""


@pytest.mark.slow
def test_half_a_file_in_its_place_and_a_change_that_never_comes_are_failures() -> None:
    if (reason := runs.why_not()) is not None:
        pytest.skip(reason)
    outcome = in_a_child(DIRECT)
    assert outcome.status == 0, outcome.err[-3000:]
    never, *halves = outcome.out.splitlines()
    assert never == "True 1 status 78: "
    assert all("write a PLY, point 0" in half for half in halves)
    assert len(halves) == 2


@pytest.mark.slow
@pytest.mark.parametrize("check", [*sanitizers.CHECKS, sanitizers.EMULATION])
def test_the_units_of_cpp_are_clean_under_sanitizers(tried: dict[str, Any], check: str) -> None:
    found = tried["sanitizers"]["checks"][check]
    if "skipped" in found:
        pytest.skip(f"{found['skipped']}; python -m benchmarks.faults --only sanitizers compiles all, in minutes")
    assert found["failures"] == []
    assert found["told"]


# what is wrong, in which library, and what must be said
READ_LATE = 'extern "C" int fault(int n) { int *p = new int[n]; delete[] p; return p[1]; }'
OVERFLOW = 'extern "C" int fault(int n) { return n * 1000000000; }'
RACE = """#include <thread>
static int shared;
extern "C" int fault(int n) {
  std::thread other([n] { for (int k = 0; k < 100 * n; k++) shared++; });
  for (int k = 0; k < 100 * n; k++) shared++;
  other.join();
  return shared;
}"""
FAULTY = (
    ("compiled backend", READ_LATE, "heap-use-after-free"),
    ("compiled backend", OVERFLOW, "signed integer overflow"),
    ("compiled backend, four threads", RACE, "data race"),
)


@pytest.mark.parametrize(("check", "code", "words"), FAULTY, ids=["late", "overflow", "race"])
def test_a_sanitizer_notices_a_fault_of_its_kind(check: str, code: str, words: str, tmp_path: Path) -> None:
    made = sanitizers.CHECKS[check]
    if (reason := sanitizers.why_not(made)) is not None:
        pytest.skip(reason)
    compiler = sanitizers.find_compiler() or []
    (tmp_path / "faulty.cpp").write_text(code)
    built = [*compiler, *made.flags, "-o", str(tmp_path / "faulty.so"), str(tmp_path / "faulty.cpp")]
    subprocess.run(built, check=True, capture_output=True, cwd=tmp_path)
    script = f"import ctypes; print(ctypes.CDLL('{tmp_path}/faulty.so').fault(4))"
    _, failures = sanitizers._ran([sys.executable, "-c", script], made, compiler, {})
    assert len(failures) == 1
    assert words in failures[0]


def test_every_unit_of_cpp_is_under_a_sanitizer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {unit.name for unit in sanitizers.units()}
    assert {"blend.cpp", "scores.cpp", "step.cpp", "emulator.cpp", "bindings.cpp"} <= names
    assert sanitizers.uncovered() == []
    new = tmp_path / "new.cpp"
    monkeypatch.setattr(sanitizers, "ROOT", tmp_path)
    monkeypatch.setattr(sanitizers, "units", lambda: [new])
    assert sanitizers.uncovered() == ["new.cpp"]


BAD = """
import json, os, sys, time
from pathlib import Path
import numpy as np
from benchmarks.faults import fuzz
from benchmarks.faults.readers import READERS, Reader
from pop_fast.errors import PopError

fuzz.SECONDS = 1

def raising(error):
    def read(path):
        raise error
    return read

def named(path):
    raise PopError(f"{path}: is damaged; copy it again")

BAD = {
    "named": named, "of no file": raising(PopError("is damaged")), "a fault": raising(KeyError("x")),
    "a word": raising(PopError("the photo.png of a capture is damaged")),
    "aborts": lambda path: os.abort(), "hangs": lambda path: time.sleep(60.0),
    "takes all memory": lambda path: np.ones(2**33, np.uint8), "ends": lambda path: os._exit(0),
}
READERS.clear()
READERS.update({name: Reader("photos/photo.png", "", read) for name, read in BAD.items()})
print(json.dumps(fuzz.fuzz(2, 0.0, 0)))
"""


def test_the_fuzzer_notices_what_readers_must_not_do() -> None:
    outcome = in_a_child(BAD)
    assert outcome.status == 0, outcome.err[-3000:]
    readers = json.loads(outcome.out.splitlines()[-1])["readers"]
    found = {name: " ".join(kind for kind, n in row.items() if n == 2) for name, row in readers.items()}
    assert all(sum(row.values()) == 2 for row in readers.values())
    assert found == {
        "named": "refused",
        "of no file": "escaped",
        "a word": "escaped",
        "a fault": "escaped",
        "takes all memory": "escaped",
        "aborts": "crashed",
        "ends": "crashed",
        "hangs": "hung",
    }


def test_a_load_above_its_bound_fails(tmp_path: Path) -> None:
    script = """
import sys
from benchmarks import load
load.CASES = {"small": load.Case(3, 50, 64, 48)}
load.PROGRAM = 0.0
sys.exit(load.main(["--out", sys.argv[1]]))
"""
    (tmp_path / "load.json").write_text('{"cases": {"large": {"peak_gib": 2.0}}}')
    outcome = in_a_child(script, tmp_path / "load.json")
    assert outcome.status == 1, outcome.err[-2000:]
    assert "small: above its bound" in outcome.out
    cases = json.loads((tmp_path / "load.json").read_text())["cases"]
    # cases that are measured alone leave the others as they were
    assert cases.pop("large") == {"peak_gib": 2.0}
    found = cases["small"]
    # what torch and the program take by themselves
    assert 0.1 < found["peak_gib"] < 0.5


# Everything that opens a file is tried by the fuzzer, or says here why not.

PACKAGES = ("pop_ref", "pop_fast", "cuda_ext", "paper_repro")
# what reads a file or decodes its bytes, by the name that is called and by how it is written
CALLS = {
    *("read_text", "read_bytes", "fromfile", "memmap", "loadtxt", "genfromtxt", "imread", "imdecode", "imdecodemulti"),
    *("VideoCapture", "ZipFile", "TarFile", "open_heif", "Reconstruction", "decompressobj", "decompress", "fromstring"),
    *("fdopen", "iterparse", "PdfReader"),
}
WRITTEN = {
    *("np.load", "numpy.load", "torch.load", "torch.jit.load", "pickle.load", "json.load", "json.loads"),
    *("tomllib.load", "tomllib.loads", "ET.parse", "Image.open", "gzip.open", "os.open", "io.open", "sqlite3.connect"),
}
# what a function hands on that has only been opened: whoever takes it reads the file
RAW = {"Any", "bytes", "str", "dict[str, Any]", "dict[str, np.ndarray]", "dict[str, Any] | None", "list[str]"}
OWN = "reads what the package itself ships"
SYSTEM = "reads what the system says of itself"
EXEMPT = {
    "pop_ref.walkthrough": "reads its own chapters, and what a chapter has trained a moment before",
    "pop_ref.conformance.mutants": OWN,
    "pop_ref.conformance.corpus": OWN,
    "pop_ref.conformance.law_coverage": OWN,
    "pop_ref.conformance.vector_kills": "reads vectors that the same call has exported, and its own results",
    "pop_ref.conformance.vector_stages": OWN,
    "pop_ref.learn.stubs": OWN,
    "pop_ref.learn.grading:read_grade": "one line of a child process; its test hands it what a student may print",
    "pop_fast.cli.learn:_graded_apart": "hands read_grade what its own child process says",
    "pop_fast.view.document": OWN,
    "pop_fast.compiled.build": OWN,
    "pop_fast.compiled.library": SYSTEM,
    "pop_fast.compiled.native_step": "opens a handle of the compiled library, no file",
    "pop_fast.machine": SYSTEM,
    "pop_fast.train.environment": SYSTEM,
    "pop_fast.cli.options:_photographs": "takes what load_checkpoint has judged",
    "pop_fast.blocks.run:merge": "takes what read_round has judged",
    "paper_repro.figures.qualitative:_view": "takes what read_view has judged",
    "paper_repro.collect:publish": "takes what read_view has judged",
    "pop_fast.cli.eval:_record": "adds to what read_stats has judged",
    "pop_fast.view.report.source:_read": "puts a film into the page as it is",
    "pop_fast.io.atomic": "takes the lock of a file and reads nothing of it",
    "pop_fast.train.results:ResultFolder.open_metrics": "appends to it",
    "pop_fast.cli:_Lasting.write": "the null device",
    "pop_fast.view.paths:_no_standard_error": "the null device",
    "pop_fast.cli.explain:_explain": "parses what it has made itself",
    "pop_fast.demo.make:_write_model": "makes a model, and reads none",
    **dict.fromkeys(
        (f"pop_fast.data.sfm:{name}" for name in ("_extract", "_listen", "find_cameras", "main")),
        "reads what the search has written, and what its own child process says",
    ),
    "pop_fast.data.sfm:_stage": "tells by twelve bytes whether COLMAP reads the format; decoders judge the photograph",
    "pop_fast.io.images:main": "a child process that decodes what has been read; its end harms nobody",
    "cuda_ext.gpu_check.shared:Command._words": "the end of a log that it has written, with any bytes",
    "cuda_ext.gpu_check.stages": "shows what its own trainings and benchmarks have written",
    "cuda_ext.gpu_check.__main__:commit_of": "takes one text of a file that read_json has judged",
    "cuda_ext.host": OWN,
    "cuda_ext.machine_code": OWN,
    "paper_repro.train_row:begin_from_base": "takes what load_checkpoint has judged",
    "paper_repro.train_row:_begin": "takes one text of its own note",
    "paper_repro.methods": OWN,
    "paper_repro.verify": "reads what its own training has written",
    "paper_repro.status": "reads the pages of the clone that it writes",
}


def _module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def _functions() -> dict[tuple[str, str], ast.AST]:
    """Give every function by module and name, and what stands outside of all as the name ""."""
    found: dict[tuple[str, str], ast.AST] = {}

    def look(module: str, node: ast.AST, names: tuple[str, ...]) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                inner = (*names, child.name)
                if isinstance(child, ast.FunctionDef):
                    found[module, ".".join(inner)] = child
                look(module, child, inner)
            else:
                look(module, child, names)

    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found[_module(path), ""] = tree
            look(_module(path), tree, ())
    return found


def _own_calls(node: ast.AST) -> Iterator[ast.Call]:
    """Give the calls of a function that are not those of a function inside it."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            continue
        if isinstance(child, ast.Call):
            yield child
        yield from _own_calls(child)


def _writes(call: ast.Call, place: int) -> bool:
    mode = {word.arg: word.value for word in call.keywords}.get(
        "mode", call.args[place] if len(call.args) > place else None
    )
    return isinstance(mode, ast.Constant) and str(mode.value)[:1] in "wxa" and "+" not in str(mode.value)


def _opens(call: ast.Call) -> bool:
    match call.func:
        case ast.Name("open"):
            return not _writes(call, 1)
        case ast.Name("ZipFile") | ast.Attribute(attr="ZipFile"):
            return not _writes(call, 1)
        case ast.Name(name):
            return name in CALLS
        case ast.Attribute(attr="open") if ast.unparse(call.func) not in WRITTEN:
            return not _writes(call, 0) and not ast.unparse(call.func).startswith("archive")
        case ast.Attribute(attr=name):
            return name in CALLS or ast.unparse(call.func) in WRITTEN
    return False


@cache
def openers() -> frozenset[tuple[str, str]]:
    """Find every function that opens a file for reading, itself or through what hands on what it has opened."""
    calls = {key: list(_own_calls(node)) for key, node in _functions().items()}
    called = {key: {c.func.id for c in of if isinstance(c.func, ast.Name)} for key, of in calls.items()}
    raw = {key for key, node in _functions().items() if _hands_on(node)}
    found = {key for key, of in calls.items() if any(map(_opens, of))}
    while True:
        names = {key[1].rpartition(".")[2] for key in raw & found}
        public = {name for name in names if not name.startswith("_")}
        more = {key for key in calls if called[key] & public}
        if more <= found:
            return frozenset(found)
        found |= more


def _hands_on(node: ast.AST) -> bool:
    named = isinstance(node, ast.FunctionDef) and node.name.startswith(("read", "parse", "load"))
    return named and node.returns is not None and ast.unparse(node.returns) in RAW


TRACE = """
import json, sys, tempfile, threading
from pathlib import Path
import cv2, torch
from benchmarks.faults.fuzz import copied
from benchmarks.faults.readers import READERS

torch.set_num_threads(1)
called = set()

def note(frame, event, _):
    if event == "call":
        called.add(frame.f_code)

threading.setprofile(note)
for name, reader in READERS.items():
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(reader, Path(folder))
        sys.setprofile(note)
        try:
            reader.read(copy)
        except ValueError:
            assert name == "weights of LPIPS", name
        finally:
            sys.setprofile(None)
root = Path.cwd()
files = {code: Path(code.co_filename) for code in called if not code.co_filename.startswith("<")}
own = {code: path.relative_to(root) for code, path in files.items() if path.is_relative_to(root)}
print(json.dumps([[path.as_posix(), code.co_qualname] for code, path in own.items()]))
"""


@pytest.fixture(scope="module")
def read() -> set[tuple[str, str]]:
    outcome = in_a_child(TRACE)
    assert outcome.status == 0, outcome.err[-3000:]
    found = json.loads(outcome.out.splitlines()[-1])
    return {(_module(ROOT / path), name.replace(".<locals>", "")) for path, name in found}


def _why_not(module: str, function: str) -> str | None:
    parts = module.split(".")
    names = [f"{module}:{function}", *(".".join(parts[:n]) for n in range(len(parts), 0, -1))]
    return next((name for name in names if name in EXEMPT), None)


def test_all_that_opens_a_file_and_is_not_left_out_is_in_the_fuzzer(read: set[tuple[str, str]]) -> None:
    absent = {key for key in openers() if key not in read and _why_not(*key) is None}
    assert sorted(absent) == [], "give it a reader in benchmarks/faults/readers.py"
    # what is left out opens a file
    used = {_why_not(*key) for key in openers() if key not in read}
    assert sorted(EXEMPT.keys() - used) == []


def test_a_function_that_opens_a_file_is_noticed() -> None:
    known = openers()
    for key in (
        ("pop_fast.io.images", "_decode"),
        ("pop_fast.io.image_header", "heif_exif"),
        ("pop_fast.data.load", "read_block"),  # through read_json
        ("pop_fast.blocks.plan", "read_job"),
        ("pop_fast.train.checkpoint", "load_splats"),  # through read_torch_file
        ("pop_fast.data.unpack", "_open"),
        ("paper_repro.results", "_lines"),
    ):
        assert key in known
    assert ("pop_fast.io.images", "write_png") not in known
