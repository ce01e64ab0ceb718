"""Everything that opens a file is tried by the fuzzer, or says here why not."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.app.conftest import ROOT, in_a_child

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
    "pop_fast.cli:_status": "the null device",
    "pop_fast.view.paths:_no_standard_error": "the null device",
    "paper_repro.cli:main": "the null device",
    "pop_fast.cli.explain:_explain": "parses what it has made itself",
    "pop_fast.demo.make:_write_model": "makes a model, and reads none",
    **dict.fromkeys(
        (f"pop_fast.data.sfm:{name}" for name in ("_extract", "_listen", "_rows", "find_cameras", "main")),
        "reads what the search has written, and what its own child process says",
    ),
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
