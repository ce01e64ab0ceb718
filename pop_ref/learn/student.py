"""A student's folder, and the oracle with the student's functions put in.

The oracle is copied under another package name, as mutants are, and in the copy each function that the student has
written takes the place of the oracle's. A student's `from pop_ref.alpha import falloff` means the copy's, so that it
finds the student's own function where there is one.
"""

from __future__ import annotations

import ast
import copy
import difflib
import importlib
import inspect
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np

import pop_ref
from pop_ref.conformance.files import copied
from pop_ref.learn.course import COURSE, Stage

PACKAGE: Final = "pop_yours"
# with which a student's code may stop; one that ends Python has not passed
STOPS: Final = (Exception, SystemExit)
# what two names have in common that are taken for one, misspelt; of `difflib`
_ALIKE: Final = 0.8
_ORACLE: Final = Path(pop_ref.__file__).parent


class NotNumbersError(TypeError):
    """A function returned what is not made of numbers, such as a generator or a function that was not called."""


@dataclass(frozen=True)
class Work:
    """What a student has written.

    Attributes:
        folder: of the stubs.
        written: names of the functions that have a body, by stage.
        unreadable: what is wrong with a file that is not Python, file and line among it, by stage; none is written.
    """

    folder: Path
    written: dict[str, tuple[str, ...]]
    unreadable: dict[str, str] = field(default_factory=dict)

    def is_whole(self, stage: Stage) -> bool:
        """Tell whether every function of a stage is written."""
        return set(self.written[stage.name]) == set(stage.names)


@dataclass
class Call:
    """One call of a student's function: what went in, what came out, what the oracle says to the same input.

    Attributes:
        found, expected: what was returned, and the arguments that were written to, of both.
        words: what is special about the input; empty for a plain one.
        error: with which the function stopped, if it did.
        raises: whether it must stop with a ValueError, since the input is none.
    """

    function: str
    parameters: tuple[str, ...]
    given: tuple[Any, ...]
    named: dict[str, Any]
    found: Any
    expected: Any
    words: str = ""
    error: BaseException | None = None
    raises: bool = False

    @property
    def is_right(self) -> bool:
        """Tell whether it is what the oracle says, but for rounding."""
        if self.raises or self.error:
            return self.raises and isinstance(self.error, ValueError)
        if self.function == "sh_basis_vjp" and not self.found[1]:
            # what is along the direction is removed later, and polynomials that agree on the sphere differ in it
            return same(*(_tangential(value, self.given[0]) for value, _ in (self.found, self.expected)))
        return same(self.found, self.expected) and not self.wanted

    @property
    def wanted(self) -> str:
        """Return the kind of number, or the keys, that are asked for, where others came out; empty where they fit."""
        return _wanted(self.found[0], self.expected[0])


def _wanted(found: Any, expected: Any) -> str:
    """Compare the kinds of numbers: a mask of 0 and 1 takes rows by their places, and no list has a place 1.0."""
    if type(expected) is tuple and isinstance(found, tuple | list):
        return next(filter(None, map(_wanted, found, expected)), "")
    if isinstance(expected, dict):
        keys = f"the keys {', '.join(sorted(expected))}"
        return "" if isinstance(found, dict) and found.keys() == expected.keys() else keys
    # one truth value is as good as 0 or 1
    if not isinstance(expected, np.ndarray | int) or isinstance(expected, bool):
        return ""
    kind, fits = {"b": ("truth values", "b"), "i": ("whole numbers", "iu")}.get(
        np.asarray(expected).dtype.kind, ("", "")
    )
    return kind if kind and np.asarray(found).dtype.kind not in fits else ""


@dataclass
class Borrowed:
    """The copy of the oracle that is in use.

    Attributes:
        oracle: the copy's own functions, which the student's have replaced.
        installed: the student's functions that have replaced them, as the copy calls them.
        calls: of the student's functions, while `watching`.
    """

    oracle: dict[str, Callable[..., Any]] = field(default_factory=dict)
    installed: dict[str, Callable[..., Any]] = field(default_factory=dict)
    calls: list[Call] = field(default_factory=list)
    watching: bool = False

    def module(self, name: str) -> Any:
        """Return a module of the copy."""
        return importlib.import_module(f"{PACKAGE}.{name}")


def read_work(folder: Path) -> Work:
    """Read a student's folder without running it; a file that is not Python spoils its own stage only.

    Raises:
        ValueError: the folder has no stubs.
    """
    if not any((folder / stage.file).exists() for stage in COURSE):
        if any(Path(stage.file).exists() for stage in COURSE):
            raise ValueError(f"{folder} has no stubs; you are in a folder that has some: write . for it, at the end")
        raise ValueError(f"{folder} has no stubs; 'pop-learn start {folder}' writes them")
    work = Work(folder, {stage.name: () for stage in COURSE})
    for stage in COURSE:
        try:
            work.written[stage.name] = _written(stage, folder / stage.file)
        except ValueError as error:
            work.unreadable[stage.name] = str(error)
    return work


def _written(stage: Stage, path: Path) -> tuple[str, ...]:
    if not path.exists():
        return ()
    functions = {node.name: node for node in _parsed(path).body if isinstance(node, ast.FunctionDef)}
    return tuple(name for name in stage.names if name in functions and not _is_stub(functions[name]))


def misspelt(work: Work, stage: Stage) -> dict[str, str]:
    """Find functions in a stage's file that are named nearly as ones that are still to write, by the latter's names.

    Raises:
        ValueError: the file is not Python.
    """
    path = work.folder / stage.file
    if not path.exists():
        return {}
    defined = [node.name for node in _parsed(path).body if isinstance(node, ast.FunctionDef)]
    others = [name for name in defined if name not in stage.names]
    missing = [name for name in stage.names if name not in work.written[stage.name]]
    return {near[0]: name for name in others if (near := difflib.get_close_matches(name, missing, 1, _ALIKE))}


def _is_stub(node: ast.FunctionDef) -> bool:
    body = node.body[1:] if ast.get_docstring(node) is not None else node.body
    return not body or (
        len(body) == 1 and isinstance(body[0], ast.Raise) and "NotImplementedError" in ast.dump(body[0])
    )


def _parsed(path: Path) -> ast.Module:
    try:
        # Python, too, takes the mark that some editors put before the text
        return ast.parse(path.read_text(encoding="utf-8-sig"), str(path))
    except SyntaxError as error:
        raise ValueError(f"{path}, line {error.lineno or 1}: this is not Python yet: {error.msg}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not UTF-8 text; save it as UTF-8") from None
    # which of the two comes is up to Python's version
    except (MemoryError, RecursionError):
        raise ValueError(f"{path} has more brackets in each other than Python reads; take some out") from None


@contextmanager
def borrowing(work: Work, stages: Sequence[Stage] = COURSE) -> Iterator[Borrowed]:
    """Bring the oracle to life with the student's functions of some stages in place of its own.

    Raises:
        ValueError: a file of these stages is not Python or cannot be run; the message names file and line.
    """
    for stage in stages:
        if stage.name in work.unreadable:
            raise ValueError(work.unreadable[stage.name])
    borrowed = Borrowed()
    with copied("pop_ref", PACKAGE, {}):
        modules = [borrowed.module(path.stem) for path in sorted(_ORACLE.glob("[a-z]*.py"))]
        theirs = {stage.name: _run(work.folder / stage.file) for stage in stages if work.written[stage.name]}
        modules += theirs.values()
        for stage in COURSE:
            for home, names in stage.functions.items():
                borrowed.oracle |= {name: getattr(borrowed.module(home), name) for name in names}
        for stage in stages:
            for name in stage.names if stage.name in theirs else ():
                if name in work.written[stage.name]:
                    function = getattr(theirs[stage.name], name)
                    _replace(modules, borrowed, name, function, _with_settings(function, borrowed.oracle[name]))
                else:
                    # a stub that the student's own functions call
                    setattr(theirs[stage.name], name, borrowed.oracle[name])
        yield borrowed


def _with_settings(function: Callable[..., Any], before: Callable[..., Any]) -> Callable[..., Any]:
    """Let a function without `profile` or `config` be called with one: the course has one of each."""
    theirs = list(inspect.signature(before).parameters)
    own = inspect.signature(function).parameters
    left_out = [name for name in ("profile", "config", "revised_opacity") if name in theirs and name not in own]
    if not left_out or any(p.kind is p.VAR_POSITIONAL for p in own.values()):
        return function
    places = {theirs.index(name) for name in left_out}

    def called(*given: Any, **named: Any) -> Any:
        kept = {name: value for name, value in named.items() if name not in left_out}
        return function(*(value for k, value in enumerate(given) if k not in places), **kept)

    return called


def _replace(
    modules: list[ModuleType], borrowed: Borrowed, name: str, function: Callable[..., Any], called: Callable[..., Any]
) -> None:
    """Put a student's function wherever the copy has the oracle's, and in the student's own modules."""
    before = borrowed.oracle[name]

    def watched(*given: Any, **named: Any) -> Any:
        if not borrowed.watching:
            return called(*given, **named)
        kept = copy.deepcopy((given, named))
        theirs = copy.deepcopy(kept)
        found = called(*given, **named)
        # what is added to in place is part of what came out
        expected = before(*theirs[0], **theirs[1])
        results = (found, _written_to(kept, given)), (expected, _written_to(kept, theirs[0]))
        borrowed.calls.append(Call(name, parameters_of(before), *kept, *results))
        return found

    borrowed.installed[name] = watched
    for module in modules:
        for attribute, value in list(vars(module).items()):
            if value is before or value is function:
                setattr(module, attribute, watched)


def parameters_of(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of a function's parameters."""
    return tuple(inspect.signature(function).parameters)


def tried_on(function: Callable[..., Any], truth: Callable[..., Any], given: tuple[Any, ...], words: str) -> Call:
    """Call a student's function and the oracle's on copies of the same input."""
    name, ours, theirs = truth.__name__, copy.deepcopy(given), copy.deepcopy(given)
    raises = False
    try:
        expected = truth(*theirs)
    except ValueError:
        expected, raises = None, True
    meant = expected, _written_to((given,), theirs)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            found = _numbers_alone(function(*ours))
        except STOPS as error:
            return Call(name, parameters_of(truth), given, {}, (None, ()), meant, words, error, raises)
    written = found, _written_to((given,), ours)
    return Call(name, parameters_of(truth), given, {}, written, meant, words, raises=raises)


def _numbers_alone(found: Any) -> Any:
    try:
        numbers(found)
    except (TypeError, ValueError):
        raise NotNumbersError(f"returns {repr(found)[:80]}, which is not made of numbers alone") from None
    return found


def _written_to(kept: tuple[Any, ...], after: tuple[Any, ...]) -> tuple[Any, ...]:
    # what is added to once more later must not change what is kept here
    return tuple(copy.deepcopy(a) for b, a in zip(kept[0], after, strict=True) if not _is_still(b, a))


def _is_still(before: Any, after: Any) -> bool:
    if isinstance(before, np.ndarray):
        return np.array_equal(before, after, equal_nan=before.dtype.kind == "f")
    if isinstance(before, list | tuple):
        return len(before) == len(after) and all(map(_is_still, before, after))
    if hasattr(before, "__dataclass_fields__"):
        return all(_is_still(getattr(before, name), getattr(after, name)) for name in before.__dataclass_fields__)
    if isinstance(before, dict):
        return before.keys() == after.keys() and all(_is_still(value, after[key]) for key, value in before.items())
    return bool(before == after) or before != before


def _run(path: Path) -> ModuleType:
    """Run a student's file, its imports of the oracle turned to the copy."""
    tree = _parsed(path)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "pop_ref":
            node.module = node.module.replace("pop_ref", PACKAGE, 1)
    module = ModuleType(f"{PACKAGE}.written.{path.stem}")
    module.__file__ = str(path)
    # a dataclass looks its module up
    sys.modules[module.__name__] = module
    try:
        exec(compile(tree, str(path), "exec"), module.__dict__)
    except STOPS as error:
        raise ValueError(f"{where(error, path.parent)}: the file cannot be run: {said(error)}") from None
    return module


def where(error: BaseException, folder: Path) -> str:
    """Return the innermost line of the student's files that an exception passed through, as "file, line n"."""
    found, trace = str(folder), error.__traceback__
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if Path(file).parent == folder:
            found = f"{file}, line {trace.tb_lineno}"
        trace = trace.tb_next
    return found


def said(error: BaseException) -> str:
    """Say an exception in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def numbers(value: Any) -> np.ndarray:
    """Flatten whatever a function returns into one row of numbers.

    Example:
        >>> numbers((0.5, [np.eye(2)], None))
        array([0.5, 1. , 0. , 0. , 1. ])
    """
    if value is None:
        return np.zeros(0)
    if isinstance(value, dict):
        # in whatever order it was filled
        value = tuple(value[key] for key in sorted(value, key=str))
    elif hasattr(value, "__dataclass_fields__"):
        value = tuple(getattr(value, name) for name in value.__dataclass_fields__)
    if isinstance(value, list) and any(isinstance(each, list) for each in value):
        # lists of one tile each: where one ends is part of it
        value = [part for each in value for part in (len(each), each)]
    if isinstance(value, tuple | list):
        return np.concatenate([np.zeros(0), *map(numbers, value)])
    return np.asarray(value, dtype=np.float64).ravel()


def same(one: Any, other: Any) -> bool:
    """Tell whether two results are one but for rounding."""
    a, b = numbers(one), numbers(other)
    if a.shape != b.shape:
        return False
    largest = float(np.max(np.abs(b[np.isfinite(b)]), initial=0.0))
    return bool(np.allclose(a, b, rtol=1e-8, atol=1e-11 * largest, equal_nan=True))


def _tangential(v_dirs: Any, dirs: np.ndarray) -> np.ndarray:
    v = np.asarray(v_dirs, dtype=np.float64)
    return v - dirs * np.sum(dirs * v, axis=1, keepdims=True) if v.shape == dirs.shape else v
