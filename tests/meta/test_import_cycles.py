"""No module imports itself by way of others: not at once, not in a function, and not by a string that is imported."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("pop_ref", "pop_fast", "cuda_ext", "paper_repro", "benchmarks", "docs", "tests")


def _modules() -> dict[str, Path]:
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    paths = {path: path.relative_to(ROOT).with_suffix("").parts for path in files}
    return {".".join(parts[:-1] if parts[-1] == "__init__" else parts): path for path, parts in paths.items()}


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    """Walk over statements, those in functions included; what is for type checkers alone is never imported."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            yield from (statement for other in child.orelse for statement in (other, *_statements(other)))
            continue
        if isinstance(child, ast.stmt):
            yield child
        yield from _statements(child)


def imports(text: str, known: Mapping[str, object], package: str = "") -> set[str]:
    """Return which of the known modules a source imports."""
    found: set[str] = set()
    for statement in _statements(ast.parse(text)):
        if isinstance(statement, ast.Import):
            found |= {alias.name for alias in statement.names}
        elif isinstance(statement, ast.ImportFrom):
            base = package.rsplit(".", statement.level)[0] if statement.level else ""
            module = ".".join(filter(None, (base, statement.module)))
            names = {f"{module}.{alias.name}" for alias in statement.names}
            found |= {name if name in known else module for name in names}
    return (found | set(_named(text, known))) & known.keys()


# a string that is imported: "a.module", or "a.module:attribute" as entry points are written
IMPORTED = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(:[A-Za-z_]\w*)?")


def _named(text: str, known: Mapping[str, object]) -> Iterator[str]:
    """Give what whole strings of a source name as a module, or as an attribute of one."""
    for node in ast.walk(ast.parse(text)):
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
    graph = {name: imports(path.read_text(encoding="utf-8"), modules, f"{name}.x") for name, path in modules.items()}
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
    assert cycles({name: imports(text, sources) for name, text in sources.items()}) == expected
