"""Find the bug: a function of the oracle with one line broken, and the law of the kit that notices."""

from __future__ import annotations

import ast
import difflib
from pathlib import Path

from pop_ref.conformance.mutants import MUTANTS, Mutant
from pop_ref.conformance.mutants.trial import killed_by, sound
from pop_ref.walkthrough.builder.chapter import without_docstring


def bug_named(name: str) -> Mutant:
    """Return one of the kit's broken copies of the oracle.

    Raises:
        ValueError: there is none of that name.
    """
    for mutant in MUTANTS:
        if mutant.name == name:
            return mutant
    raise ValueError(f"the kit has no mutant {name!r}")


def broken_function(name: str) -> tuple[str, str]:
    """Return the function that a mutant breaks, broken, without its docstring; and its file."""
    mutant = bug_named(name)
    sound_text = (Path(__file__).resolve().parents[1] / mutant.file).read_text(
        encoding="utf-8"
    )
    text = mutant.broken_source()
    for before, after in zip(_functions(sound_text), _functions(text), strict=True):
        old, new = without_docstring(sound_text, before), without_docstring(text, after)
        if old != new:
            return new, f"pop_ref/{mutant.file}, with one mistake"
    raise ValueError(f"mutant {name!r} breaks no function")


def caught(name: str) -> str:
    """Put a mutant on trial; tell the line, what happened, and the law that breaks on it and on nothing sound.

    Raises:
        AssertionError: the law holds on the mutant, or breaks on the oracle.
    """
    mutant = bug_named(name)
    law = mutant.law.partition(":")[2].replace("_", " ")
    assert sound(mutant.law) is None, f"the oracle breaks the law: {law}"
    assert killed_by(mutant) is not None, f"{name} survives the law: {law}"
    changed = difflib.ndiff(mutant.old.splitlines(), mutant.new.splitlines())
    lines = [line for line in changed if line[0] in "-+"]
    return "\n".join([mutant.file, *lines, f"the law that catches it: {law}"])


def _functions(text: str) -> list[ast.FunctionDef]:
    return [node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)]
