"""The house rules that a machine can hold: who imports whom, how long things are, what docstrings say.

No module imports itself by way of others: not at once, not in a function, and not by a string that is imported."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from pop_fast.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("pop_ref", "pop_fast", "cuda_ext", "tests", "benchmarks", "paper_repro", "docs")
FILES = sorted(p for room in ROOMS for p in (ROOT / room).rglob("*.py") if "__pycache__" not in p.parts)
ORACLE = [p for p in sorted((ROOT / "pop_ref").glob("*.py")) if p.name != "__init__.py"]
# values without a formula, which every engine takes its defaults from
VALUES = {"pop_ref.constants", "pop_ref.settings", "pop_ref.recipes"}
SHARED_WITH_FAST = VALUES | {"pop_ref.notation", "pop_ref.records", "pop_ref.registry"}
# rooms of the program whose work is to show what the oracle does
SHOW_THE_ORACLE = ("pop_fast/view/explain/", "pop_fast/oracle.py", "pop_fast/cli/vectors.py", "pop_fast/cli/learn.py")


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(text_of(path))


@cache
def _nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(_tree(path)))


@cache
def _imports(path: Path) -> tuple[str, ...]:
    found: list[str] = []
    for node in _nodes(path):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            # `from pop_ref import constants` names a module too
            found += [f"{node.module}.{a.name}" if node.module == "pop_ref" else node.module for a in node.names]
    return tuple(found)


def _foreign(path: Path, allowed: set[str]) -> list[str]:
    packages = allowed | set(sys.stdlib_module_names)
    return sorted({module for module in _imports(path) if module.split(".")[0] not in packages})


def test_the_oracle_imports_numpy_only() -> None:
    for path in ORACLE:
        # array types are checked when jaxtyping is there, and the oracle runs without it
        allowed = {"numpy", "pop_ref"} | ({"jaxtyping"} if path.name == "_shapes.py" else set())
        assert not _foreign(path, allowed), f"{_name(path)} imports {_foreign(path, allowed)}"
        kit = [m for m in _imports(path) if m.startswith("pop_ref.conformance")]
        assert not kit, f"{_name(path)} imports {kit}: the judge may know the oracle, not the other way round"


def test_the_kit_adds_hypothesis_and_pytest_only() -> None:
    for path in sorted((ROOT / "pop_ref" / "conformance").rglob("*.py")):
        allowed = {"numpy", "pop_ref", "hypothesis", "pytest"}
        assert not _foreign(path, allowed), f"{_name(path)} imports {_foreign(path, allowed)}"


WALKTHROUGH = sorted((ROOT / "pop_ref" / "walkthrough").rglob("*.py"))


@pytest.mark.parametrize("path", WALKTHROUGH, ids=lambda path: path.stem)
def test_the_walk_through_adds_pictures_and_its_last_chapters_the_program(path: Path) -> None:
    allowed = {"numpy", "pop_ref", "matplotlib"}
    if not path.name.startswith("chapter_"):
        allowed |= {"markdown_it", "mdit_py_plugins", "latex2mathml", "pygments"}
    trains, last = (path.name.startswith(("chapter_10", "chapter_11", *more)) for more in ((), ("chapter_12",)))
    # the photographs that chapters begin with are made and read without torch
    capture = path.name.startswith(("chapter_00", "chapter_09b"))
    if trains or capture:
        allowed |= {"pop_fast"}
    if trains:
        allowed |= {"torch"}
    if last:
        allowed |= {"hypothesis"}
    assert not _foreign(path, allowed), f"{_name(path)} imports {_foreign(path, allowed)}"
    program = {m for m in _imports(path) if m.startswith("pop_fast")}
    assert trains or program <= {"pop_fast.data", "pop_fast.demo"}, f"{_name(path)} imports {program}"
    # the kit judges the mistakes that readers look for, and is explained at the end
    kit = [m for m in _imports(path) if m.startswith("pop_ref.conformance")]
    assert last or path.name == "bugs.py" or not kit, f"{_name(path)} imports {kit}"


def test_nothing_else_imports_the_walk_through() -> None:
    outside = [path for path in FILES if path not in WALKTHROUGH and "tests" not in path.parts]
    assert WALKTHROUGH
    for path in outside:
        taken = [m for m in _imports(path) if m.startswith("pop_ref.walkthrough")]
        assert not taken, f"{_name(path)} imports {taken}"


def test_the_course_adds_the_kit_and_what_the_kit_needs_and_is_used_by_its_command_only() -> None:
    course = sorted((ROOT / "pop_ref" / "learn").glob("*.py"))
    assert course
    for path in course:
        assert not _foreign(path, {"numpy", "pop_ref", "hypothesis"}), _name(path)
    # by the chapter that shows a whole training, by pages, which fold what a student may write, and by the fuzzer,
    # which damages a student's files
    users = (
        "pop_fast/cli/learn.py",
        "pop_ref/walkthrough/builder/chapter.py",
        "pop_ref/walkthrough/chapter_00_one_picture.py",
        "benchmarks/faults/corpus.py",
        "benchmarks/faults/readers.py",
    )
    for path in FILES:
        if path not in course and "tests" not in path.parts and _name(path) not in users:
            taken = [m for m in _imports(path) if m.startswith("pop_ref.learn")]
            assert not taken, f"{_name(path)} imports {taken}"


def test_the_program_takes_no_formula_from_the_oracle() -> None:
    for path in sorted((ROOT / "pop_fast").rglob("*.py")):
        if _name(path).startswith(SHOW_THE_ORACLE):
            continue
        taken = {m for m in _imports(path) if m.split(".")[0] == "pop_ref"} - SHARED_WITH_FAST
        assert not taken, f"{_name(path)} imports {sorted(taken)}; only {sorted(SHARED_WITH_FAST)} may be shared"


def test_the_cuda_room_takes_values_only() -> None:
    for path in sorted((ROOT / "cuda_ext").rglob("*.py")):
        taken = {m for m in _imports(path) if m.split(".")[0] == "pop_ref"} - VALUES
        assert not taken, f"{_name(path)} imports {sorted(taken)}"


def test_what_every_engine_shares_is_values_and_no_formula() -> None:
    for name in ("settings", "recipes"):
        path = ROOT / "pop_ref" / f"{name}.py"
        assert set(_imports(path)) <= {"__future__", "dataclasses", "typing", *VALUES}
        assert not _public_functions(path)


@pytest.mark.parametrize("room", ["benchmarks", "paper_repro"])
def test_users_of_the_packages_use_public_names(room: str) -> None:
    packages = ("pop_ref", "pop_fast", "cuda_ext")
    for path in sorted((ROOT / room).rglob("*.py")):
        for node in _nodes(path):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in packages:
                private = [a.name for a in node.names if a.name.startswith("_")]
                assert not private, f"{_name(path)} imports {private} from {node.module}"


def _run(script: str) -> None:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


WATCHED = """
import sys
happened = []
sys.addaudithook(lambda event, args: happened.append(event) if event in
    ("subprocess.Popen", "os.exec", "os.posix_spawn", "os.system", "socket.connect", "urllib.Request") else None)
import {package}
heavy = {heavy!r}
loaded = sorted(m for m in heavy if m in sys.modules)
assert not loaded, f"{package} loads {{loaded}}"
assert not happened, f"importing {package} does {{happened}}"
"""


@pytest.mark.parametrize(
    ("package", "heavy"),
    [
        ("pop_ref", ("torch", "scipy", "cv2", "hypothesis", "pytest", "matplotlib", "pycolmap")),
        ("pop_ref.conformance", ("torch", "scipy", "cv2", "matplotlib", "pycolmap")),
        ("pop_ref.conformance.plugin", ("torch", "scipy", "cv2", "matplotlib", "pycolmap", "hypothesis")),
        ("pop_ref.conformance.vectors", ("torch", "scipy", "cv2", "matplotlib", "pycolmap", "hypothesis", "pytest")),
        ("pop_fast", ("torch", "scipy", "cv2", "matplotlib", "pycolmap")),
        ("pop_fast.cli", ("torch", "scipy", "cv2", "matplotlib", "pycolmap")),
        ("cuda_ext", ("torch", "numpy")),
    ],
)
def test_importing_is_light_and_starts_nothing(package: str, heavy: tuple[str, ...]) -> None:
    _run(WATCHED.format(package=package, heavy=heavy))


HEAVY = ("torch", "scipy", "cv2", "matplotlib", "pycolmap", "plyfile", "tqdm")
CALLED = """
import contextlib, io, sys
from pop_fast.cli import main
for words in {calls!r}:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        status = main(words)
    assert status == {status}, (words, status)
    # what one call has loaded stays, so the first that is named is the one that loads it
    loaded = sorted(m for m in {heavy!r} if m in sys.modules)
    assert not loaded, f"pop {{' '.join(words)}} loads {{loaded}}"
"""


def _call(calls: list[list[str]], status: int, heavy: tuple[str, ...]) -> None:
    _run(CALLED.format(calls=calls, status=status, heavy=heavy))


def test_the_help_of_no_subcommand_loads_anything_heavy() -> None:
    assert len(COMMANDS) > 10
    _call([[*command.split(), "--help"] for command in COMMANDS], 0, HEAVY)


def test_a_typo_is_said_before_anything_heavy_is_loaded() -> None:
    _call([["train", "x", "--max-stepz", "3"], ["eval", "x", "--fakter", "2"], ["trian"]], 2, HEAVY)


def test_a_capture_that_is_not_there_is_said_before_torch_is_loaded() -> None:
    _call([["train", "not_there", "--backend", "fast"]], 2, ("torch", "scipy", "matplotlib", "pycolmap"))


def test_doctor_tells_of_torch_without_loading_it() -> None:
    if find_spec("cuda_ext._kernels") is not None:
        pytest.skip("the CUDA extension is built, and whether it can run here only torch knows")
    _call([["doctor"]], 0, ("torch",))


# reading settings and captures is what a first step begins with; torch's compiler takes as long to load as torch
WITHOUT = [
    ("from pop_fast.train import TrainConfig", ("torch", "cv2", "scipy")),
    ("from pop_fast.data import load_capture", ("torch", "scipy", "matplotlib")),
    (
        "import torch; from torch.nn import Parameter\n"
        "from pop_fast.train.environment import reproducible\n"
        "from pop_fast.train.model import make_optimizers\n"
        "with reproducible(): make_optimizers({'means': Parameter(torch.zeros(1, 3))})",
        ("torch._dynamo", "torch._inductor", "sympy"),
    ),
    ("import pop_fast.train.training_run", ("torch._dynamo", "matplotlib", "pycolmap", "pop_fast.view.report.page")),
]


@pytest.mark.parametrize(("script", "heavy"), WITHOUT, ids=range(len(WITHOUT)))
def test_a_run_begins_without_what_it_does_not_need(script: str, heavy: tuple[str, ...]) -> None:
    check = f"import sys; loaded = [m for m in {heavy!r} if m in sys.modules]; assert not loaded, loaded"
    _run(f"{script}\n{check}")


# where Python's path is read and no Python is started with it
NAMES_THE_PYTHON = {
    "cuda_ext/build.py": 2,  # CMake's own Python, which is told -P; a program beside it
    "docs/commands.py": 1,  # the folder of its programs
    "pop_fast/io/images.py": 1,  # whether there is one
}
STARTS_PYTHON = re.compile(r"^python[\d.]*$")


def _starts_python(nodes: Iterable[ast.AST]) -> Iterator[int]:
    """List the lines of a module that start a Python: by `sys.executable`, by its name, or without a command."""
    for node in nodes:
        if isinstance(node, ast.Attribute) and node.attr in ("executable", "_base_executable"):
            yield node.lineno
        if isinstance(node, ast.List | ast.Tuple) and node.elts and isinstance(first := node.elts[0], ast.Constant):
            yield from [node.lineno] * bool(STARTS_PYTHON.search(str(first.value)))
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            if any(name.split(".")[0] == "multiprocessing" or name == "ProcessPoolExecutor" for name in names):
                yield node.lineno


def test_one_place_makes_the_commands_of_child_pythons() -> None:
    for path in FILES:
        if path.parts[len(ROOT.parts)] == "tests" or _name(path) == "pop_fast/children.py":
            continue
        lines = list(_starts_python(_nodes(path)))
        fix = "take python_command or module_command of pop_fast.children, which leave the current folder out"
        assert len(lines) == NAMES_THE_PYTHON.get(_name(path), 0), f"{_name(path)} starts a Python at {lines}: {fix}"
    for workflow in (ROOT / "pop_fast/blocks/Snakefile", ROOT / "paper_repro/Snakefile"):
        text = text_of(workflow)
        assert "os.environ.update(SAFE_PATH)" in text
        assert "sys.executable" not in text


@pytest.mark.parametrize(
    "line", ["run([sys.executable, '-m', 'x'])", "run(['python3', '-m', 'x'])", "from multiprocessing import Pool"]
)
def test_a_python_that_is_started_elsewhere_is_seen(line: str) -> None:
    assert list(_starts_python(ast.walk(ast.parse(line))))


def _too_long(path: Path) -> Iterator[str]:
    text = text_of(path)
    # the prose of a chapter is a page's, and no code
    lines = sum(not (line.startswith("#") and path.name.startswith("chapter_")) for line in text.splitlines())
    # a module holds one idea, and is not cut by length; beyond this there are surely two. A file of tests is read
    # a test at a time, a list of mutants a mutant at a time
    limit = 1_200 if path.parent.name == "mutants" else 800 if path.name.startswith("test_") else 600
    if lines > limit:
        yield f"{_name(path)} has {lines} lines; split it by what it is about"
    for node in _nodes(path):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            length = (node.end_lineno or 0) - body[0].lineno + 1 if body else 0
            if length > 60:
                yield f"{_name(path)}: {node.name} has {length} lines without its docstring; split it at 60"


def test_files_and_functions_fit_on_their_screens() -> None:
    complaints = [complaint for path in FILES for complaint in _too_long(path)]
    assert not complaints, "\n".join(complaints)


# written in pieces, so that this file does not speak of them itself
FORBIDDEN = {
    "a path of one machine": re.compile(r"/(?:work|home|root|Users)/(?!\.)[A-Za-z_]"),
    "work that is left": re.compile(r"\b(?:TO" + r"DO|FIX" + r"ME|XX" + r"X)\b"),
    "a plan that is not part of the project": re.compile(
        r"\b(?:ARCHITEC" + r"TURE|METH" + r"ODS|INTERF" + r"ACES|KERN" + r"ELS|ANCH" + r"ORS)\.md\b"
    ),
    "a debugger": re.compile(r"\bbreak" + r"point\(\)|import p" + r"db\b"),
}
SUFFIXES = (".py", ".md", ".toml", ".cu", ".cuh", ".cpp", ".h", ".html", ".yaml", ".txt")


MADE = ("out", "build", "dist")


def _texts() -> Iterator[Path]:
    for folder, subfolders, files in os.walk(ROOT):
        # in place, so that what is not ours is not walked through
        subfolders[:] = [name for name in subfolders if not name.startswith(".") and name not in MADE]
        yield from (Path(folder, name) for name in files if name.endswith(SUFFIXES) and not name.startswith("."))


def test_nothing_is_written_that_must_not_be() -> None:
    texts = sorted(_texts())
    assert len(texts) > len(FILES)
    for path in texts:
        for number, line in enumerate(text_of(path).splitlines(), start=1):
            for what, pattern in FORBIDDEN.items():
                assert not pattern.search(line), f"{_name(path)}:{number} has {what}: {line.strip()}"


def _public_functions(path: Path) -> list[ast.FunctionDef]:
    return [n for n in _tree(path).body if isinstance(n, ast.FunctionDef) and not n.name.startswith("_")]


def _unexplained(path: Path, function: ast.FunctionDef) -> Iterator[str]:
    text = ast.get_docstring(function) or ""
    where = f"{_name(path)}: {function.name}"
    first = text.splitlines()[0] if text else ""
    # a first line may end with the formula that it introduces
    if not first.rstrip("`").endswith((".", ":")):
        yield f"{where}: the first line must be a sentence, it is {first!r}"
    for mandatory in ("Source:", "Departs:"):
        if not re.search(rf"^{mandatory} \S", text, re.MULTILINE):
            yield f"{where} has no {mandatory} line"
    if ">>> " not in text:
        yield f"{where} has no example"
    names = {a.arg for a in (*function.args.args, *function.args.kwonlyargs)}
    section = text.split("Args:\n", 1)[1].split("\n\n", 1)[0] if "Args:\n" in text else ""
    entries = re.findall(r"^ {4}(\w+(?:, \w+)*):", section, re.MULTILINE)
    explained = {name for entry in entries for name in entry.split(", ")}
    if names != explained:
        yield f"{where}: its arguments are {sorted(names)}, Args explains {sorted(explained)}"


def test_the_oracles_docstrings_name_source_departures_arguments_and_an_example() -> None:
    complaints = [c for path in ORACLE for function in _public_functions(path) for c in _unexplained(path, function)]
    assert not complaints, "\n".join(complaints)


def test_the_fast_twins_point_to_the_oracle() -> None:
    complaints = []
    twins = {f.name for path in ORACLE for f in _public_functions(path)}
    for path in sorted((ROOT / "pop_fast" / "stages").glob("*.py")):
        for function in _public_functions(path):
            if function.name in twins and "`pop_ref." not in (ast.get_docstring(function) or ""):
                complaints.append(f"{_name(path)}: {function.name} does not name its meaning in pop_ref")
    assert not complaints, "\n".join(complaints)


def _printed(path: Path) -> Iterator[str]:
    """Yield the strings of a module that are no docstrings."""
    docs = {
        id(node.body[0].value)
        for node in _nodes(path)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in _nodes(path):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield node.value


def test_what_the_program_prints_is_in_megabytes() -> None:
    printing = [p for p in FILES if _name(p).startswith(("pop_fast/", "cuda_ext/arrays"))]
    assert len(printing) > 100
    found = [f"{_name(p)}: {text}" for p in printing for text in _printed(p) if re.search(r"\b[KMG]iB\b", text)]
    assert found == []
    # the search sees what it is about
    assert any("MB" in text for text in _printed(ROOT / "pop_fast" / "cli" / "options.py"))


# What words in backticks name is there: modules, what lies in them, and files of source.

SOURCES = (".py", ".h", ".cuh", ".cu", ".cpp")
ALL_FILES = [
    path
    for room in ROOMS
    for path in (ROOT / room).rglob("*")
    if path.suffix in (*SOURCES, ".md") and not {"results", "build", "corpus", Path(__file__).name} & set(path.parts)
]
DOTTED = re.compile(r"`((?:pop_ref|pop_fast|cuda_ext|paper_repro|benchmarks|tests)(?:\.\w+)+)(?:\(\))?`")
FILE = re.compile(r"`(\w+\.(?:py|h|cuh|cu|cpp))`")
# a sentence that sends its reader to one word
SENT_TO = re.compile(r"(?:[Ss]ee|\b(?:is|are|stands?) in|step of) `([a-z_]+)`")
# of any number, in words on how files are called
PATTERNS = {"chapter_NN_short_name.py"}


@cache
def names_of_files() -> frozenset[str]:
    return frozenset(path.name for path in ALL_FILES)


@cache
def named() -> frozenset[str]:
    """Return what a word can send its reader to: files, folders, and what is defined in Python or C++."""
    defined = re.compile(r"\b(?:def|class|struct|void|auto|Real|T|int|bool)\s+(\w+)")
    words = {word for path in ALL_FILES if path.suffix in SOURCES for word in defined.findall(text_of(path))}
    return frozenset(words | {path.stem for path in ALL_FILES} | {path.parent.name for path in ALL_FILES})


def is_there(dotted: str) -> bool:
    """Tell whether a module of that name is in the tree, or the longest part of it that is one has the rest."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:length])
        module = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if module.is_file() or place.is_dir():
            text = text_of(module) if module.is_file() else ""
            return all(re.search(rf"\b{part}\b", text) for part in parts[length:])
    return False


def missing(path: Path, text: str) -> Iterator[str]:
    yield from (found for found in DOTTED.findall(text) if not is_there(found))
    yield from (found for found in FILE.findall(text) if found not in names_of_files() | PATTERNS)
    for found in SENT_TO.findall(text):
        # a parameter is explained by its neighbours, and a setting stands as a text
        here = rf"[(,]\s*{found}[,:=)]|[\"']{found}[\"']"
        if path.suffix in SOURCES and found not in named() and not re.search(here, text):
            yield found


def test_what_is_named_in_backticks_is_there() -> None:
    gone = {str(path.relative_to(ROOT)): list(missing(path, text_of(path))) for path in ALL_FILES}
    assert not {path: names for path, names in gone.items() if names}


@pytest.mark.parametrize(
    "words",
    [
        "The arithmetic is in `blender`.",
        "Optimizations: see `blender`; what is kept",
        "a step of `blender` at a time",
        "See `pop_fast.stages.blender`.",
        "`pop_ref.training.no_such_step` has it",
        "as in `tile_of_old.h`",
    ],
)
def test_a_name_of_nothing_is_noticed(words: str) -> None:
    assert list(missing(ROOT / "pop_fast" / "stages" / "compositing.py", words))


def _modules() -> dict[str, Path]:
    paths = {path: path.relative_to(ROOT).with_suffix("").parts for path in FILES}
    return {".".join(parts[:-1] if parts[-1] == "__init__" else parts): path for path, parts in paths.items()}


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    """Walk over statements, those in functions included; what is for type checkers alone is never imported."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            yield from (statement for other in child.orelse for statement in (other, *_statements(other)))
            continue
        if isinstance(child, ast.stmt):
            yield child
        # no expression holds a statement
        if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield from _statements(child)


def imports(tree: ast.Module, nodes: Iterable[ast.AST], known: Mapping[str, object], package: str = "") -> set[str]:
    """Return which of the known modules a source imports."""
    found: set[str] = set()
    for statement in _statements(tree):
        if isinstance(statement, ast.Import):
            found |= {alias.name for alias in statement.names}
        elif isinstance(statement, ast.ImportFrom):
            base = package.rsplit(".", statement.level)[0] if statement.level else ""
            module = ".".join(filter(None, (base, statement.module)))
            names = {f"{module}.{alias.name}" for alias in statement.names}
            found |= {name if name in known else module for name in names}
    return (found | set(_named(nodes, known))) & known.keys()


# a string that is imported: "a.module", or "a.module:attribute" as entry points are written
IMPORTED = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(:[A-Za-z_]\w*)?")


def _named(nodes: Iterable[ast.AST], known: Mapping[str, object]) -> Iterator[str]:
    """Give what whole strings of a source name as a module, or as an attribute of one."""
    for node in nodes:
        match = (
            IMPORTED.fullmatch(node.value) if isinstance(node, ast.Constant) and isinstance(node.value, str) else None
        )
        # a package alone is the folder of its files, as importlib.resources takes it
        if match and (match[2] or not any(name.startswith(f"{match[1]}.") for name in known)):
            yield match[1]


def cycles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the sets of nodes that lead back to themselves (Tarjan), each sorted."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    path: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        number[node] = lowest[node] = len(number)
        path.append(node)
        for other in sorted(graph[node]):
            if other not in number:
                visit(other)
            if other in path:
                lowest[node] = min(lowest[node], lowest[other])
        if lowest[node] == number[node]:
            at = path.index(node)
            ring = sorted(path[at:])
            del path[at:]
            if len(ring) > 1 or node in graph[node]:
                found.append(ring)

    for node in graph:
        if node not in number:
            visit(node)
    return found


def test_there_is_no_import_cycle() -> None:
    modules = _modules()
    assert len(modules) > 300
    graph = {name: imports(_tree(path), _nodes(path), modules, f"{name}.x") for name, path in modules.items()}
    # a package's own file names its modules only to hand on what they give
    graph = {name: found - {name} for name, found in graph.items()}
    assert cycles(graph) == []


@pytest.mark.parametrize(
    ("sources", "expected"),
    [
        ({"a": "import b", "b": "def f():\n    from c import x", "c": "if 1:\n    import a"}, [["a", "b", "c"]]),
        ({"a": "import b", "b": "if TYPE_CHECKING:\n    import a\nelse:\n    import c", "c": ""}, []),
        ({"p": "", "p.a": "from p import b", "p.b": "from p.a import x"}, [["p.a", "p.b"]]),
        ({"a": "import b\nimport c", "b": "import c", "c": "import d", "d": "import c"}, [["c", "d"]]),
        ({"p.a": "TABLE = {'x': 'p.b:X'}", "p.b": "import_module('p.a')"}, [["p.a", "p.b"]]),
        ({"p.a": "'see p.b for it'", "p.b": "import p.a"}, []),
    ],
    ids=["in a function", "for type checkers", "from a package", "off to the side", "in strings", "in prose"],
)
def test_a_cycle_is_found_wherever_it_hides(sources: dict[str, str], expected: list[list[str]]) -> None:
    trees = {name: ast.parse(text) for name, text in sources.items()}
    assert cycles({name: imports(tree, ast.walk(tree), sources) for name, tree in trees.items()}) == expected
