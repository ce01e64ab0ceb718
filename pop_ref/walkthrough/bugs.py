"""Find the bug: a function of the oracle with one line broken, and the law of the kit that notices."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any

from pop_ref.conformance.mutants import MUTANTS, Mutant, living
from pop_ref.conformance.mutants.trial import killed_by, sound


def bug_named(name: str) -> Mutant:
    """Return one of the kit's broken copies of the oracle.

    Raises:
        ValueError: there is none of that name.
    """
    for mutant in MUTANTS:
        if mutant.name == name:
            return mutant
    raise ValueError(f"the kit has no mutant {name!r}")


def broken(name: str, function: str) -> Callable[..., Any]:
    """Return a function of the oracle as a mutant has it, so that an answer can hold what it says against it."""
    with living(bug_named(name)) as backend:
        return backend.stage(function)


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
