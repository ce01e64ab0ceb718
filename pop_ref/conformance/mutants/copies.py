"""A copy of the oracle, or of the program, with one line changed, importable next to its original."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.backends import program
from pop_ref.conformance.changes import sides
from pop_ref.conformance.files import copied, folder_of

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
        text = (folder_of(self.package) / self.file).read_text(encoding="utf-8")
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


@contextmanager
def living(mutant: Mutant, dtype: str = "float32") -> Iterator[Any]:
    """Bring a mutant to life as a backend for the duration of a with statement; one lives at a time.

    Args:
        mutant: to be imported.
        dtype: the precision that a copy of the program is judged in; the oracle has one only.
    """
    # a change that cannot be made must not pass for one that breaks a law
    changed = {mutant.file: mutant.broken_source()}
    with copied(mutant.package, mutant.copy, changed):
        if mutant.package == ORACLE:
            yield OracleAdapter(mutant.copy, mutant.name)
        else:
            yield program(mutant.name, mutant.copy, "fast", dtype)
