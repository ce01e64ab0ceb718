"""A copy of the oracle, or of the program, with one line changed, importable next to its original."""

from __future__ import annotations

import functools
import importlib.abc
import importlib.util
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.backends import program
from pop_ref.conformance.changes import sides

ORACLE, PROGRAM = "pop_ref", "pop_fast"


@dataclass(frozen=True)
class Mutant:
    """One line, broken as somebody once broke it.

    Attributes:
        name: how tables call it.
        story: what happened, and where.
        file: the module, as a path in the package.
        old, new: the line before and after; `old` occurs once in the file.
        law: module and name of the law that kills it, as `test_alpha:a_negative_exponent_is_skipped`.
        package: what is copied: the oracle, or the program.
    """

    name: str
    story: str
    file: str
    old: str
    new: str
    law: str
    package: str = ORACLE

    @property
    def copy(self) -> str:
        """Return the name that the copy is imported by."""
        return f"{self.package}_mutant"

    @property
    def precisions(self) -> tuple[str, ...]:
        """Return what it is judged in; the oracle has float64 alone."""
        return ("float64",) if self.package == ORACLE else ("float32", "float64")

    def broken_source(self) -> str:
        """Return the module's text with the line changed."""
        text = (_folder(self.package) / self.file).read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(f"mutant {self.name}: {self.old!r} occurs {text.count(self.old)} times in {self.file}")
        return text.replace(self.old, self.new)


# by file: of every mutant its name, its story, the line with each change in it as «before→after», and the law that
# kills it
Lines = Mapping[str, tuple[tuple[str, str, str, str], ...]]


def mutants_of(lines: Lines, package: str = ORACLE) -> tuple[Mutant, ...]:
    """Return the mutants of a table."""
    return tuple(
        Mutant(name, story, file, *sides(line), law, package)
        for file, every in lines.items()
        for name, story, line, law in every
    )


@functools.cache
def _folder(package: str) -> Path:
    # found without importing it
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)
    return Path(spec.origin).parent


@functools.cache
def _sound_code(package: str, file: str) -> CodeType:
    return _compiled((_folder(package) / file).read_text(encoding="utf-8"), package, file)


def _compiled(text: str, package: str, file: str) -> CodeType:
    return compile(text.replace(package, f"{package}_mutant"), f"<{package}_mutant/{file}>", "exec")


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports a package's files under another package name, one of them from a mutant."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Answer for the copy's names only."""
        if fullname == self.mutant.copy:
            return importlib.util.spec_from_loader(fullname, self, is_package=True)
        if not fullname.startswith(f"{self.mutant.copy}."):
            return None
        source = _folder(self.mutant.package) / self._file(fullname)
        if not source.exists():
            return None
        # what stands next to a module is found from where it was copied
        spec = ModuleSpec(fullname, self, origin=str(source), is_package=source.name == "__init__.py")
        spec.has_location = True
        return spec

    def exec_module(self, module: ModuleType) -> None:
        """Run the file's text, the mutant's if it is the file that it breaks; the package itself is empty."""
        mutant = self.mutant
        if module.__name__ == mutant.copy:
            return
        file = self._file(module.__name__)
        if file == mutant.file:
            code = _compiled(mutant.broken_source(), mutant.package, file)
        else:
            code = _sound_code(mutant.package, file)
        exec(code, module.__dict__)

    def _file(self, fullname: str) -> str:
        stem = fullname.removeprefix(f"{self.mutant.copy}.").replace(".", "/")
        package = f"{stem}/__init__.py"
        return package if (_folder(self.mutant.package) / package).exists() else f"{stem}.py"


@contextmanager
def living(mutant: Mutant, dtype: str = "float32") -> Iterator[Any]:
    """Bring a mutant to life as a backend for the duration of a with statement; one lives at a time.

    Args:
        mutant: to be imported.
        dtype: the precision that a copy of the program is judged in; the oracle has one only.
    """
    # a change that cannot be made must not pass for one that breaks a law
    mutant.broken_source()
    finder = _Finder(mutant)
    _forget(mutant.copy)
    sys.meta_path.insert(0, finder)
    try:
        if mutant.package == ORACLE:
            yield OracleAdapter(mutant.copy, mutant.name)
        else:
            yield program(mutant.name, mutant.copy, "fast", dtype)
    finally:
        sys.meta_path.remove(finder)
        _forget(mutant.copy)


def _forget(package: str) -> None:
    for name in [n for n in sys.modules if n == package or n.startswith(f"{package}.")]:
        del sys.modules[name]
