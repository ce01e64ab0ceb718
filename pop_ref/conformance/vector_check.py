"""A port's results held to the portable vectors, by the rules that `index.json` states and nothing else."""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.corpus_answers import weighted_blocks, weighted_runs
from pop_ref.conformance.vector_schema import FORMAT, VERSION

AGAIN = "write the vectors again with 'pop vectors export'"


@dataclass(frozen=True)
class Verdict:
    """One array of one vector.

    Attributes:
        vector, array: names.
        worst: the largest difference over its error bound; for integers the number of wrong entries.
        allowed: the largest that passes.
        where: where the worst entry is, with both values.
        unit: what `worst` and `allowed` count.
    """

    vector: str
    array: str
    worst: float
    allowed: float
    where: str = ""
    unit: str = "of its error_bound"

    @property
    def passed(self) -> bool:
        """Tell whether the array is as good as rounding lets it be."""
        return self.worst <= self.allowed


@dataclass
class Judgement:
    """Everything that was compared, and what could not be.

    Attributes:
        verdicts: one for each array of each result.
        absent: outputs that no result holds.
        missing: vectors without a result.
        strange: files and arrays of the results that the index does not know.
    """

    verdicts: list[Verdict] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    strange: list[str] = field(default_factory=list)

    @property
    def failed(self) -> list[Verdict]:
        """Return the verdicts that did not pass."""
        return [verdict for verdict in self.verdicts if not verdict.passed]


def check(folder: Path, results: Path, precision: str = "float32") -> Judgement:
    """Hold a port's results to the vectors of a folder; a result that is missing is not judged.

    Args:
        folder: that `vectors.export` wrote.
        results: holds NAME.npz or NAME.json for as many vectors as the port draws.
        precision: "float32" or "float64", that the port computes in.

    Raises:
        ValueError: a folder, file or array is missing, damaged or of another version or shape; or nothing is there to
            be judged. Says which and what to do.
    """
    index = read_index(folder)
    if not results.is_dir():
        raise ValueError(f"{results}: no such folder; a port writes its results there, NAME.npz or NAME.json a vector")
    found = Judgement()
    known = {f"{name}{suffix}" for name in index["vectors"] for suffix in (".npz", ".json")}
    found.strange = sorted(path.name for path in results.iterdir() if path.name not in known)
    seen: set[str] = set()
    known_outputs: dict[str, None] = {}
    for name, vector in index["vectors"].items():
        arrays = index["kinds"][vector["kind"]]["arrays"]
        outputs = {array: entry for array, entry in arrays.items() if entry["role"] == "output"}
        known_outputs |= dict.fromkeys(outputs)
        path = next((p for p in (results / f"{name}.npz", results / f"{name}.json") if p.exists()), None)
        if path is None:
            found.missing.append(name)
            continue
        stored = {a: shape for a, shape in vector["shapes"].items() if arrays[a].get("stored", True)}
        wanted, result = _vector(folder / vector["file"], stored), read_arrays(path)
        found.strange += [f"{path.name}: {array}" for array in result if array not in outputs]
        for array in (a for a in outputs if a in result):
            seen.add(array)
            _check_shape(path, array, result[array], vector["shapes"][array])
            for rule in outputs[array]["compare"]:
                found.verdicts.append(_judge(name, array, wanted, result[array], rule, index["tiny"], precision))
    if not found.verdicts:
        raise ValueError(
            f"{results}: holds nothing to judge; write one file for each vector, as "
            f"{next(iter(index['vectors']))}.npz with {', '.join(known_outputs)}"
        )
    found.absent = [array for array in known_outputs if array not in seen]
    return found


def read_index(folder: Path) -> dict[str, Any]:
    """Read the index of a folder of vectors.

    Raises:
        ValueError: the folder or the index is missing, damaged, foreign or of another version.
    """
    path = folder / "index.json"
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; write the vectors with 'pop vectors export {folder}'")
    if not path.is_file():
        raise ValueError(f"{path}: absent, so {folder} holds no vectors; write them with 'pop vectors export'")
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is damaged ({error}); {AGAIN}") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise ValueError(f"{path}: format is not {FORMAT!r}, so it is no index of vectors; {AGAIN}")
    if index.get("version") != VERSION:
        raise ValueError(f"{path}: version is {index.get('version')}, this program reads {VERSION}; {AGAIN}")
    lacks = [name for name in ("kinds", "vectors", "tiny") if name not in index]
    if lacks:
        raise ValueError(f"{path}: {lacks[0]} is absent; {AGAIN}")
    return index


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read an npz, or a JSON file of nested lists, as arrays by name.

    Raises:
        ValueError: the file is neither, or an array of it holds no numbers.
    """
    try:
        if path.suffix == ".json":
            arrays = {name: np.asarray(value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
        else:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
    except (ValueError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        kind = "JSON of number lists by name" if path.suffix == ".json" else "npz file of numbers"
        raise ValueError(f"{path}: is no {kind} ({error}); write it again") from error
    return arrays


def _vector(path: Path, shapes: dict[str, list[int]]) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise ValueError(f"{path}: absent; {AGAIN}")
    arrays = read_arrays(path)
    for name, shape in shapes.items():
        if name not in arrays:
            raise ValueError(f"{path}: has no array {name}; {AGAIN}")
        if list(arrays[name].shape) != shape:
            raise ValueError(f"{path}: {name} has shape {list(arrays[name].shape)}, the index says {shape}; {AGAIN}")
    return arrays


def _check_shape(path: Path, array: str, result: np.ndarray, wanted: list[int]) -> None:
    if result.dtype.kind not in "fiub":
        raise ValueError(f"{path}: {array} has type {result.dtype}; it must hold numbers")
    if list(result.shape) != wanted:
        raise ValueError(f"{path}: {array} has shape {list(result.shape)}; it must be {wanted}")


def _judge(
    vector: str,
    array: str,
    wanted: dict[str, np.ndarray],
    result: np.ndarray,
    rule: dict[str, Any],
    tiny: dict[str, float],
    precision: str,
) -> Verdict:
    expected = wanted[rule.get("expected", array)]
    mask = np.array(True) if rule["where"] is None else wanted[rule["where"]]
    if "reduce" in rule:
        result, mask = _reduced(rule["reduce"], np.asarray(result, dtype=np.float64), mask), np.array(True)
    # a mask covers the leading axes
    where = np.broadcast_to(np.reshape(mask, mask.shape + (1,) * (expected.ndim - mask.ndim)), expected.shape)
    unit = "of its error_bound"
    if rule["rule"] == "equal":
        unit = "wrong entries"
        wrong = np.asarray((result != expected) & where, dtype=np.float64)
        worst, allowed = float(np.sum(wrong)), 0.0
    else:
        allowed = rule["limit"][precision]
        # an error bound of zero leaves `tiny`
        error_bound = wanted[rule["error_bound"]] + tiny[precision] / allowed
        off = np.abs(result.astype(np.float64) - expected) / error_bound
        wrong = np.where(where, np.where(np.isfinite(off), off, np.inf), 0.0)
        worst = float(np.max(wrong, initial=0.0))
    if worst <= allowed:
        return Verdict(vector, array, worst, allowed, unit=unit)
    at = tuple(int(i) for i in np.unravel_index(np.argmax(wrong), wrong.shape))
    where = f"at {list(at)}{' of its sums' if 'reduce' in rule else ''}: got {result[at]}, expected {expected[at]}"
    return Verdict(vector, array, worst, allowed, where, unit)


def _reduced(how: str, values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Reduce a result to weighted sums, as the index says."""
    if how == "blocks":
        return weighted_blocks(values, np.broadcast_to(mask, values.shape[:2]))
    return weighted_runs(values)
