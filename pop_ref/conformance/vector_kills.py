"""What the portable vectors alone would have noticed: `python -m pop_ref.conformance.vector_kills FILE [--more]`.

Every mutant answers the vectors as a port would; it is killed where an array fails, or where it raises. The laws see
more: they draw scenes, compare a rasterizer with itself, and judge stages that no vector is about.

With `--more`, after vectors or mutants were added and none was changed, what the file says to be killed stays so, and
the others are tried.
"""

from __future__ import annotations

import functools
import json
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.mutants import FAMILIES
from pop_ref.conformance.mutants.trial import alive
from pop_ref.conformance.vector_answer import answered
from pop_ref.conformance.vector_check import read_index, verdicts_of
from pop_ref.conformance.vectors import export


def first_failure(folder: Path, backend: Any) -> str | None:
    """Return the first vector and array at which a backend fails, or what it raises; None where it passes.

    Args:
        folder: that `vectors.export` wrote.
        backend: an adapter.
    """
    index, precision = _index(folder), np.dtype(backend.dtype).name
    # what takes longest comes last
    for name in sorted(index["vectors"], key=lambda name: name.startswith("large_")):
        vector = index["vectors"][name]
        try:
            with np.load(folder / vector["file"]) as stored:
                result = answered(backend, vector["kind"], dict(stored), vector["options"])
            found = verdicts_of(index, folder, name, result, precision, folder / name)
        except Exception as error:
            return f"{name}: raises {type(error).__name__}"
        for verdict in found:
            if not verdict.passed:
                return f"{name}: {verdict.array}"
    return None


@functools.cache
def _index(folder: Path) -> dict[str, Any]:
    return read_index(folder)


Kills = dict[str, dict[str, str | None]]


def kills(report: Callable[[str, str | None], None] = lambda name, found: None, known: Kills | None = None) -> Kills:
    """Return by family and mutant what fails first, None for a mutant that survives; sound backends are a family, too.

    Args:
        report: is given every name and result as it comes.
        known: a mutant that is killed in these is not tried.
    """
    found: Kills = {family: {} for family in (*FAMILIES, "sound")}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "vectors"
        export(folder)
        trials: list[tuple[str, str, Callable[[], AbstractContextManager[Any]]]] = []
        for family, mutants in FAMILIES.items():
            trials += [(family, mutant.name, partial(alive, mutant)) for mutant in mutants]
        for family, name, living in trials:
            found[family][name] = (known or found).get(family, {}).get(name)
            if found[family][name] is None:
                with living() as backend:
                    found[family][name] = first_failure(folder, backend)
            report(name, found[family][name])
        for name in SHIPPED:
            found["sound"][name] = first_failure(folder, shipped(name))
    return found


def main(words: list[str]) -> int:
    """Write the results."""
    more = words[1:] == ["--more"]
    if len(words) != 1 + more or words[0].startswith("-"):
        print("usage: python -m pop_ref.conformance.vector_kills FILE [--more]")
        return 2
    known = json.loads(Path(words[0]).read_text(encoding="utf-8")) if more else None
    found = kills(lambda name, first: print(f"{name}: {first or 'survives'}", flush=True), known)
    Path(words[0]).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
