"""Portable vectors of single stage functions: calls that laws made, kept because a broken stage answers them wrongly.

`python -m pop_ref.conformance.vector_stages MUTANT ...` takes calls from the laws that these mutants name, for those of
them that no call of `vector_stages.json` tells from the oracle, and adds them there. What rounding may cost is
measured: inputs are moved by float32's rounding, and the answer moves by so much.
"""

from __future__ import annotations

import functools
import inspect
import json
import sys
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.adapter import OracleAdapter, stage_function
from pop_ref.conformance.files import write_file
from pop_ref.conformance.scenes import in_precision
from pop_ref.conformance.vector_check import entry, equal
from pop_ref.constants import Profile
from pop_ref.contributions import Contributions
from pop_ref.density import Statistics
from pop_ref.recipes import Recipe
from pop_ref.records import Camera, Gaussians, Splats
from pop_ref.settings import DensityConfig, LearningRates, UpdateRules

FILE: Final = Path(__file__).with_suffix(".json")
# values that a call may hold besides numbers, and what they are made of
TYPES: Final = {
    each.__name__: each
    for each in (
        Camera,
        Contributions,
        DensityConfig,
        Gaussians,
        LearningRates,
        Profile,
        Recipe,
        Splats,
        Statistics,
        UpdateRules,
    )
}
EPS: Final = float(np.finfo(np.float32).eps)
UNITS: Final = 64
_TRIALS: Final = 6
_LARGEST: Final = 6_000
_EXAMPLES: Final = 12


def plain(value: Any) -> Any:
    """Return a value as JSON holds it: arrays as type and nested lists, records by name and field, numbers by name.

    Raises:
        TypeError: it cannot be written.
    """
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "dtype": str(value.dtype), "shape": list(value.shape)}
    if isinstance(value, np.generic):
        return value.item()
    if is_dataclass(value) and type(value).__name__ in TYPES:
        return {"record": type(value).__name__, "of": {f.name: plain(getattr(value, f.name)) for f in fields(value)}}
    if isinstance(value, tuple):
        return {"tuple": [plain(each) for each in value]}
    if isinstance(value, list):
        return [plain(each) for each in value]
    if isinstance(value, dict):
        return {"by_name": {name: plain(each) for name, each in value.items()}}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} cannot be written")


def made(value: Any) -> Any:
    """Return the value that `plain` has written."""
    if isinstance(value, list):
        return [made(each) for each in value]
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return np.array(value["array"], dtype=value["dtype"]).reshape(value["shape"])
    if "tuple" in value:
        return tuple(made(each) for each in value["tuple"])
    if "by_name" in value:
        return {name: made(each) for name, each in value["by_name"].items()}
    return TYPES[value["record"]](**{name: made(each) for name, each in value["of"].items()})


def numbers(value: Any, name: str = "") -> dict[str, np.ndarray]:
    """Return the numbers of a value as arrays by name; ragged lists as their items and where each list ends.

    Places in a list are one array, and what has names tells their number, too: an answer of another length is told.
    """
    if value is None or isinstance(value, str):
        return {}
    if is_dataclass(value) or isinstance(value, SimpleNamespace):
        # other programs' records come without a type
        return _joined((f"{name}.{field}", each) for field, each in vars(value).items())
    if isinstance(value, list) and value and isinstance(value[0], list):
        ends = np.cumsum([len(each) for each in value]).astype(np.int64)
        return {
            f"{name}.items": np.array([item for each in value for item in each], dtype=np.int64),
            f"{name}.ends": ends,
        }
    if isinstance(value, dict):
        # one name too many is told by their number
        named = _joined((f"{name}.{key}", each) for key, each in value.items())
        return {**named, f"{name}.length": np.array(len(value), dtype=np.int64)}
    if isinstance(value, tuple | list) and not all(isinstance(each, int | float) for each in value):
        if isinstance(value, list) and all(isinstance(each, tuple) and set(map(type, each)) == {int} for each in value):
            # places: a list of another length is another array, not fewer of them
            return {name: np.array(value)}
        return _joined((f"{name}.{k}", each) for k, each in enumerate(value))
    array = np.asarray(value)
    return {name: array.astype({"b": np.bool_, "i": np.int64, "u": np.int64}.get(array.dtype.kind, np.float64))}


def _joined(parts: Iterable[tuple[str, Any]]) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for name, value in parts:
        found |= numbers(value, name.lstrip("."))
    return found


def moved(value: Any, change: Callable[[np.ndarray], np.ndarray]) -> Any:
    """Return a value whose arrays of floats are changed, and nothing else."""
    if isinstance(value, np.ndarray):
        return change(value) if value.dtype.kind == "f" else value
    if isinstance(value, Camera):
        # the last rows are no measurements: others are refused
        viewmat, K = (np.concatenate((change(m[:-1]), m[-1:])) for m in (value.viewmat, value.K))
        return Camera(viewmat, K, value.width, value.height)
    if type(value).__name__ in TYPES and not isinstance(
        value, Profile | DensityConfig | LearningRates | Recipe | UpdateRules
    ):
        return type(value)(**{f.name: moved(getattr(value, f.name), change) for f in fields(value)})
    if isinstance(value, tuple):
        return tuple(moved(each, change) for each in value)
    if isinstance(value, dict):
        return {name: moved(each, change) for name, each in value.items()}
    return [moved(each, change) for each in value] if isinstance(value, list) else value


def outputs(value: Any) -> dict[str, np.ndarray]:
    """Return what a stage function returned, as arrays by name; truth values as 0 and 1."""
    found = numbers(value, "value")
    return {k: v.astype(np.int64) if v.dtype.kind == "b" else v for k, v in found.items()}


@functools.cache
def recorded() -> tuple[tuple[str, list[Any]], ...]:
    """Return the calls that are kept: the name of a stage function, and its arguments."""
    return tuple((name, [made(each) for each in args]) for name, args in json.loads(FILE.read_text(encoding="utf-8")))


def expected(name: str, args: list[Any]) -> dict[str, np.ndarray]:
    """Return what the oracle answers, what rounding may cost, and which entries rounding does not decide."""
    function = OracleAdapter().stage(name)
    answer, found = outputs(function(*args)), {}
    off = {key: np.zeros(value.shape) for key, value in answer.items()}
    for trial in range(_TRIALS):
        rng = np.random.default_rng(trial)

        def change(x: np.ndarray, rng: np.random.Generator = rng) -> np.ndarray:
            return x * (1.0 + EPS * rng.choice([-1.0, 1.0], x.shape))

        again = outputs(function(*[moved(arg, change) for arg in args]))
        for key, value in answer.items():
            same = key in again and again[key].shape == value.shape
            off[key] = np.maximum(off[key], np.abs(again[key] - value)) if same else np.full(value.shape, np.inf)
    for key, value in answer.items():
        sure = off[key] == 0.0 if value.dtype.kind == "i" else off[key] <= 2.0**-10 * (1.0 + np.abs(value))
        sure &= np.isfinite(value)
        found |= {key: np.where(sure, value, 0).astype(value.dtype), f"sure_{key}": sure}
        if value.dtype.kind != "i":
            # sums of large terms cancel: the largest entry pays for all
            size = np.abs(value) + np.max(np.abs(value), initial=0.0, where=sure)
            found[f"error_bound_{key}"] = np.where(sure, off[key] / EPS + size, 0.0)
    return found


@functools.cache
def stage_vectors() -> dict[str, tuple[dict[str, np.ndarray], dict[str, Any]]]:
    """Return the answers to the recorded calls by name; what is asked stands in the options, in the form of `plain`."""
    found: dict[str, tuple[dict[str, np.ndarray], dict[str, Any]]] = {}
    for k, (name, args) in enumerate(recorded()):
        # what a call leaves out are last arguments, which have defaults
        given = {key: plain(value) for key, value in zip(_parameters(name)[: len(args)], args, strict=True)}
        found[f"stage_{k}_{name}"] = (expected(name, args), {"function": name, "arguments": given})
    return found


@functools.cache
def stage_kinds() -> dict[str, dict[str, Any]]:
    """Return what the index says of every recorded call."""
    room = tolerances.ROOM_FLOAT64 * UNITS * float(np.finfo(np.float64).eps)
    limit = {"float32": UNITS * EPS, "float64": min(tolerances.AGREEMENT_FLOAT64, room)}
    found = {}
    for name, (arrays, options) in stage_vectors().items():
        about: dict[str, Any] = {}
        for key, value in arrays.items():
            shape, dtype = f"[{', '.join(map(str, value.shape))}]", str(value.dtype)
            if key.startswith("sure_"):
                about[key] = entry("mask", shape, "rounding decides nothing of it", dtype)
            elif key.startswith("error_bound_"):
                about[key] = entry("error_bound", shape, f"what rounding may cost in {key[12:]}", dtype)
            else:
                close = {"rule": "close", "error_bound": f"error_bound_{key}", "limit": limit, "where": f"sure_{key}"}
                rule = equal(f"sure_{key}") if dtype == "int64" else close
                about[key] = entry("output", shape, "what the function returns", dtype, [rule])
        function = stage_function("pop_ref", options["function"])
        said = (inspect.getdoc(function) or "").splitlines()[0]
        found[name] = {"about": f"{options['function']}: {said}", "arrays": about}
    return found


def _parameters(name: str) -> list[str]:
    return list(inspect.signature(OracleAdapter().stage(name)).parameters)


class _Logging(OracleAdapter):
    """The oracle, which notes what it is asked."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[str, tuple[str, list[Any]]] = {}

    def stage(self, name: str) -> Callable[..., Any]:
        function = super().stage(name)

        @functools.wraps(function)
        def noted(*args: Any, **named: Any) -> Any:
            try:
                bound = inspect.signature(function).bind(*args, **named)
                bound.apply_defaults()
                written = json.dumps([name, [plain(each) for each in bound.arguments.values()]])
                if len(written) < _LARGEST:
                    self.calls.setdefault(written, (name, list(bound.arguments.values())))
            except TypeError:
                # what holds a function or random numbers cannot be kept
                pass
            return function(*args, **named)

        return noted


def record(names: Collection[str]) -> list[Any]:
    """Return the calls that are kept, as JSON holds them, and those of laws that tell mutants from the oracle.

    Args:
        names: of the mutants.
    """
    import pytest

    from pop_ref.conformance.backends import shipped
    from pop_ref.conformance.mutants import MUTANTS, PROGRAM
    from pop_ref.conformance.mutants.copies import living
    from pop_ref.conformance.mutants.trial import law_named, obeys

    sound = shipped("fast64")
    kept = list(recorded())
    found: list[Any] = [[name, [plain(each) for each in args]] for name, args in kept]
    for mutant in (m for m in (*MUTANTS, *PROGRAM) if m.name in names):
        with living(mutant) as backend:
            if any(_differs(backend, *call) for call in kept):
                continue
            asked = _Logging()
            # a law about what the oracle does not offer asks it for nothing
            with suppress(pytest.skip.Exception):
                obeys(law_named(mutant.law), asked, _EXAMPLES)
            for name, args in asked.calls.values():
                call = (name, [moved(arg, in_precision) for arg in args])
                # laws read parts of some records only, and a sound program may fill the rest otherwise
                if _differs(backend, *call) and not _differs(sound, *call):
                    kept.append(call)
                    found.append([name, [plain(each) for each in call[1]]])
                    print(f"{mutant.name}: {name}", flush=True)
                    break
    return found


def _differs(backend: Any, name: str, args: list[Any]) -> bool:
    if not backend.has(name):
        return False
    try:
        wanted = expected(name, args)
    except Exception:
        return False
    try:
        got = outputs(backend.stage(name)(*args))
    except Exception:
        return True
    for key, value in got.items():
        if key not in wanted or wanted[key].shape != value.shape:
            return True
        bound = wanted.get(f"error_bound_{key}", np.zeros(value.shape)) * 2.0 * UNITS * EPS
        if np.any((np.abs(value - wanted[key]) > bound) & wanted[f"sure_{key}"]):
            return True
    return False


def main(names: list[str]) -> int:
    """Add calls for some mutants to the file; with an unknown name, or none, it stays as it is."""
    from pop_ref.conformance.mutants import MUTANTS, PROGRAM

    strange = set(names) - {mutant.name for mutant in (*MUTANTS, *PROGRAM)}
    if strange or not names:
        said = f"there is no mutant {', '.join(sorted(strange))}" if strange else "no mutant is named"
        print(f"{said}: python -m pop_ref.conformance.vector_stages MUTANT ...; docs/MUTANTS.md lists them")
        return 2
    write_file(FILE, json.dumps(record(names)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
