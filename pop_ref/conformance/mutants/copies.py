"""A copy of the oracle with one line changed, importable beside the oracle itself."""

from __future__ import annotations

import functools
import importlib.abc
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType, ModuleType

from pop_ref.conformance.adapter import OracleAdapter

ORACLE = Path(__file__).parents[2]
PACKAGE = "pop_ref_mutant"


@dataclass(frozen=True)
class Mutant:
    """One line of the oracle, broken as somebody once broke it.

    Attributes:
        name: how tables call it.
        story: what happened, and where.
        file: the oracle's module.
        old, new: the line before and after; `old` occurs once in the file.
        law: module and name of the law that kills it, as `test_alpha:a_negative_exponent_is_skipped`.
    """

    name: str
    story: str
    file: str
    old: str
    new: str
    law: str

    def broken_source(self) -> str:
        """Return the module's text with the line changed."""
        text = (ORACLE / self.file).read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(f"mutant {self.name}: {self.old!r} occurs {text.count(self.old)} times in {self.file}")
        return text.replace(self.old, self.new)


@functools.cache
def _sound_code(file: str) -> CodeType:
    return _compiled((ORACLE / file).read_text(encoding="utf-8"), file)


def _compiled(text: str, file: str) -> CodeType:
    return compile(text.replace("pop_ref", PACKAGE), f"<{PACKAGE}/{file}>", "exec")


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports the oracle's files under another package name, one of them from a mutant."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Answer for the copy's names only."""
        if fullname == PACKAGE:
            return importlib.util.spec_from_loader(fullname, self, is_package=True)
        if fullname.startswith(f"{PACKAGE}.") and (ORACLE / self._file(fullname)).exists():
            return importlib.util.spec_from_loader(fullname, self)
        return None

    def exec_module(self, module: ModuleType) -> None:
        """Run the file's text, the mutant's if it is the file that it breaks; the package itself is empty."""
        if module.__name__ == PACKAGE:
            return
        file = self._file(module.__name__)
        code = _compiled(self.mutant.broken_source(), file) if file == self.mutant.file else _sound_code(file)
        exec(code, module.__dict__)

    @staticmethod
    def _file(fullname: str) -> str:
        return fullname.removeprefix(f"{PACKAGE}.").replace(".", "/") + ".py"


@contextmanager
def living(mutant: Mutant) -> Iterator[OracleAdapter]:
    """Bring a mutant to life as a backend for the duration of a with statement; one lives at a time."""
    finder = _Finder(mutant)
    _forget()
    sys.meta_path.insert(0, finder)
    try:
        yield OracleAdapter(PACKAGE, mutant.name)
    finally:
        sys.meta_path.remove(finder)
        _forget()


def _forget() -> None:
    for name in [n for n in sys.modules if n == PACKAGE or n.startswith(f"{PACKAGE}.")]:
        del sys.modules[name]
