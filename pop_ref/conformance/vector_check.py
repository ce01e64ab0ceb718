"""A port's results held to the portable vectors, by the rules that `index.json` states and nothing else."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.corpus_answers import weighted_blocks, weighted_runs
from pop_ref.conformance.vector_schema import FORMAT, VERSION

# bytes of all arrays of a file; the largest vector has a few million
_LARGEST = 2**28
AGAIN = "write the vectors again with 'pop vectors export'"


class VectorsError(ValueError):
    """Tell what is wrong with a folder of vectors or with a port's results, in a line that names the file."""


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
        VectorsError: a folder, file or array is missing, damaged or of another version or shape; or nothing is there to
            be judged. Says which and what to do.
    """
    index = read_index(folder)
    try:
        return _check(index, folder, results, precision)
    except VectorsError:
        raise
    # what the index says is taken as it stands: where it does not fit the arrays, any step of the rules may fail
    except Exception as error:
        raise VectorsError(
            f"{folder / 'index.json'}: does not fit the vectors beside it ({error!r}); {AGAIN}"
        ) from error


def _check(index: dict[str, Any], folder: Path, results: Path, precision: str) -> Judgement:
    if not results.is_dir():
        raise VectorsError(
            f"{results}: no such folder; a port writes its results there, NAME.npz or NAME.json a vector"
        )
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
        result = read_arrays(path)
        found.strange += [f"{path.name}: {array}" for array in result if array not in outputs]
        seen |= result.keys() & outputs.keys()
        found.verdicts += verdicts_of(index, folder, name, result, precision, path)
    if not found.verdicts:
        raise VectorsError(
            f"{results}: holds nothing to judge; write one file for each vector, as "
            f"{next(iter(index['vectors']))}.npz with {', '.join(known_outputs)}"
        )
    found.absent = [array for array in known_outputs if array not in seen]
    return found


def verdicts_of(
    index: dict[str, Any], folder: Path, name: str, result: dict[str, np.ndarray], precision: str, path: Path
) -> list[Verdict]:
    """Hold a port's result for one vector to it.

    Args:
        index: that `read_index` read.
        folder: of the vectors.
        name: of the vector.
        result: arrays by name.
        precision: "float32" or "float64", that the port computes in.
        path: where the result is from, for errors.

    Raises:
        VectorsError: an array of the vector or of the result is missing, damaged or of another shape.
    """
    vector, found = index["vectors"][name], []
    arrays = index["kinds"][vector["kind"]]["arrays"]
    stored = {a: shape for a, shape in vector["shapes"].items() if arrays[a].get("stored", True)}
    wanted = _vector(folder / vector["file"], stored)
    for array, about in arrays.items():
        if about["role"] == "output" and array in result:
            _check_shape(path, array, result[array], vector["shapes"][array])
            for rule in about["compare"]:
                found.append(_judge(name, array, wanted, result[array], rule, index["tiny"], precision))
    return found


def read_index(folder: Path) -> dict[str, Any]:
    """Read the index of a folder of vectors.

    Raises:
        VectorsError: the folder or the index is missing, damaged, foreign or of another version.
    """
    path = folder / "index.json"
    if not folder.is_dir():
        raise VectorsError(f"{folder}: no such folder; write the vectors with 'pop vectors export {folder}'")
    if not path.is_file():
        raise VectorsError(f"{path}: absent, so {folder} holds no vectors; write them with 'pop vectors export'")
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise VectorsError(f"{path}: is damaged ({error}); {AGAIN}") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise VectorsError(f"{path}: format is not {FORMAT!r}, so it is no index of vectors; {AGAIN}")
    if index.get("version") != VERSION:
        raise VectorsError(f"{path}: version is {index.get('version')}, this program reads {VERSION}; {AGAIN}")
    lacks = [name for name in ("kinds", "vectors", "tiny") if name not in index]
    if lacks:
        raise VectorsError(f"{path}: {lacks[0]} is absent; {AGAIN}")
    return index


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read an npz, or a JSON file of nested lists, as arrays by name.

    Raises:
        VectorsError: the file is neither, or an array of it holds no numbers.
    """
    try:
        if path.suffix == ".json":
            return {name: np.asarray(value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _LARGEST:
            raise ValueError(f"its arrays have {size} bytes, more than any vector's")
        with np.load(path, allow_pickle=False) as stored:
            # what is no array in such a file is bytes
            return {name: np.asarray(stored[name]) for name in stored.files}
    # a damaged zip, a damaged head of an array and lists of lists that are no array end in errors of many kinds
    except Exception as error:
        kind = "JSON of number lists by name" if path.suffix == ".json" else "npz file of numbers"
        raise VectorsError(f"{path}: is no {kind} ({error}); write it again") from error


def _vector(path: Path, shapes: dict[str, list[int]]) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise VectorsError(f"{path}: absent; {AGAIN}")
    arrays = read_arrays(path)
    for name, shape in shapes.items():
        if name not in arrays:
            raise VectorsError(f"{path}: has no array {name}; {AGAIN}")
        if arrays[name].dtype.kind not in "fiub":
            raise VectorsError(f"{path}: {name} has type {arrays[name].dtype}, not numbers; {AGAIN}")
        if list(arrays[name].shape) != shape:
            raise VectorsError(f"{path}: {name} has shape {list(arrays[name].shape)}, the index says {shape}; {AGAIN}")
    return arrays


def _check_shape(path: Path, array: str, result: np.ndarray, wanted: list[int]) -> None:
    if result.dtype.kind not in "fiub":
        raise VectorsError(f"{path}: {array} has type {result.dtype}; it must hold numbers")
    if list(result.shape) != wanted:
        raise VectorsError(f"{path}: {array} has shape {list(result.shape)}; it must be {wanted}")


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
