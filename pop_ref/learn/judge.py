"""Hold one stage of a student to the kit's laws, and find what to say where one breaks."""

from __future__ import annotations

import importlib
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.capabilities import DOMINANCE, GRADIENTS, RENDER, capabilities_of
from pop_ref.conformance.capabilities import DOUBLE as IN_DOUBLE
from pop_ref.conformance.law import Law, missing
from pop_ref.constants import PAPER, Profile
from pop_ref.learn.course import Stage
from pop_ref.learn.mistakes import explained_by, numbers, same
from pop_ref.learn.stubs import formulas
from pop_ref.learn.student import PACKAGE, Borrowed, Call, Work, borrowing, said, where

EXAMPLES: Final = 12
# a broken law is made smaller for so long, then told as it is
PATIENCE_S: Final = 1.0


@dataclass(frozen=True)
class Verdict:
    """What came of judging a stage.

    Attributes:
        n_held: laws that hold; judging ends at the first that does not.
        broken: the sentence of that law; empty if there is none.
        sentence: what is wrong, in words; empty if nothing is.
        hint: where to look.
        call: the smallest call on which a function is wrong, if one is.
        drawn: what the broken law was tried on.
        unwritten: functions of the stage that are still stubs.
    """

    n_held: int
    broken: str = ""
    sentence: str = ""
    hint: str = ""
    call: Call | None = None
    drawn: dict[str, Any] | None = None
    unwritten: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Tell whether the stage is written and every law holds."""
        return not self.broken and not self.unwritten


def judge(work: Work, stage: Stage) -> Verdict:
    """Try a student's stage, with the oracle's functions for all others.

    Raises:
        ValueError: the file cannot be run.
    """
    unwritten = tuple(name for name in stage.names if name not in work.written[stage.name])
    with borrowing(work, (stage,)) as borrowed:
        backend = _Judged(borrowed, stage, work.written[stage.name])
        laws = [law for law in _laws(stage) if not missing(backend, law.needs)]
        for n_held, law in enumerate(laws):
            failure = _tried(law, backend)
            if failure is not None:
                plain = Verdict(n_held, law.name.replace("_", " "), unwritten=unwritten, drawn=failure.least)
                return _told(work, stage, borrowed, backend, law, failure, plain)
        return Verdict(len(laws), unwritten=unwritten)


class _Judged(OracleAdapter):
    """The copy of the oracle as a backend that offers what the student has written of one stage.

    A call under constants that are not of the course's kind sets its example aside.
    """

    profile = PAPER

    def __init__(self, borrowed: Borrowed, stage: Stage, written: tuple[str, ...]) -> None:
        super().__init__(PACKAGE, "yours")
        self.borrowed, self.course_stage, self.written = borrowed, stage, written
        self.able = ()
        if "composite_pixel" in written:
            self.able = (RENDER, GRADIENTS) if "composite_pixel_vjp" in written else (RENDER,)
            self.able += (DOMINANCE,) if {"dominant_id", "dominant_counts"} <= set(written) else ()

    def has(self, need: str) -> bool:
        """Tell that the student has written it."""
        return need in self.written or need in self.able or need == IN_DOUBLE or need in capabilities_of(PAPER)

    def stage(self, name: str) -> Callable[..., Any]:
        """Return the student's function, or the oracle's where a law needs more than the stage."""
        function = self.borrowed.installed.get(name) or super().stage(name)

        def of_the_course(*given: Any, **named: Any) -> Any:
            if any(isinstance(value, Profile) and not _is_the_courses(value) for value in (*given, *named.values())):
                _set_aside()
            return function(*given, **named)

        return of_the_course


def _is_the_courses(profile: Profile) -> bool:
    return all(
        getattr(profile, name) == getattr(PAPER, name)
        for name in (
            "extent",
            "principal_point",
            "clamp_gradient",
            "ceiling_gradient",
            "near_inclusive",
            "stop_inclusive",
        )
    )


def _set_aside() -> None:
    from hypothesis.errors import UnsatisfiedAssumption

    raise UnsatisfiedAssumption


def _laws(stage: Stage) -> Iterator[Law]:
    """Go through the laws of a stage: those that speak of its functions first, then agreement with the oracle."""
    modules = [*(f"test_{name}" for name in stage.laws), "test_agreement"]
    modules += ["test_gradients"] if stage.more_laws else []
    seen = set()
    for module in modules:
        for value in vars(importlib.import_module(f"pop_ref.conformance.laws.{module}")).values():
            law = getattr(value, "law", None)
            if (
                isinstance(law, Law)
                and law.name not in seen
                and (law.stage in stage.laws or law.name in stage.more_laws)
            ):
                seen.add(law.name)
                yield law


@dataclass
class _Failure:
    first: dict[str, Any]
    least: dict[str, Any]
    error: BaseException


def _tried(law: Law, backend: _Judged) -> _Failure | None:
    """Try a law; return the first input that broke it, and the smallest that was found."""
    from hypothesis import HealthCheck, given, settings
    from hypothesis.errors import HypothesisException

    failure: _Failure | None = None
    until = float("inf")

    def sentence(**drawn: Any) -> None:
        nonlocal failure, until
        if time.thread_time() > until:
            return
        try:
            law.sentence(backend, **drawn)
        except HypothesisException:
            raise
        except Exception as error:
            # of the processor's time: a busy machine finds the same counterexample, only later
            until = min(until, time.thread_time() + PATIENCE_S)
            failure = _Failure(drawn if failure is None else failure.first, drawn, error)
            raise

    options = settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        report_multiple_bugs=False,
        print_blob=False,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
    )
    try:
        (options(given(**law.strategies)(sentence)) if law.strategies else sentence)()
    except Exception:
        # set aside as a whole, broken, or no longer failing once patience had run out: the last is broken too
        return failure
    return failure


def _told(
    work: Work, stage: Stage, borrowed: Borrowed, backend: _Judged, law: Law, failure: _Failure, plain: Verdict
) -> Verdict:
    error = failure.error
    crashed_at = where(error, work.folder)
    if crashed_at != str(work.folder):
        return replace(
            plain, sentence=f"{crashed_at}: it stops with {said(error)}.", hint="Call it by hand with these numbers."
        )
    first, least = (_wrong_calls(borrowed, backend, law, drawn) for drawn in (failure.first, failure.least))
    if not least and not first:
        return replace(plain, sentence=f"This law does not hold: {plain.broken}.", hint=_own_words(error))
    call = (least or first)[0]
    mistake = explained_by([each for each in (*least, *first) if each.function == call.function], borrowed.oracle)
    if mistake:
        return replace(plain, sentence=mistake.sentence, hint=mistake.hint, call=call)
    return replace(plain, sentence=_general(call, plain.broken), hint=_formula(stage, call.function), call=call)


def _wrong_calls(borrowed: Borrowed, backend: _Judged, law: Law, drawn: dict[str, Any]) -> list[Call]:
    """Try a law once more on one input and return the calls of the student's functions that came out wrong."""
    borrowed.calls.clear()
    borrowed.watching = True
    try:
        with warnings.catch_warnings(), suppress(Exception):
            # that it breaks is known; the calls are what is wanted, also of an example that is then set aside
            warnings.simplefilter("ignore")
            law.sentence(backend, **drawn)
    finally:
        borrowed.watching = False
    return [call for call in borrowed.calls if not same(call.found, call.expected)]


def _general(call: Call, law: str) -> str:
    """Say what can be seen of a wrong result without knowing why it is wrong."""
    name, (found, changed), (expected, meant) = call.function, call.found, call.expected
    a, b = numbers(call.found), numbers(call.expected)
    if found is None and expected is not None:
        return f"{name} returns nothing: is a return missing?"
    if changed and not meant:
        return f"{name} changes its argument in place; work on a copy, the caller still needs what it gave."
    if a.shape != b.shape:
        return f"{name} returns {len(a)} numbers where {len(b)} are asked for: look at the shapes in its docstring."
    if not np.all(np.isfinite(a)) and np.all(np.isfinite(b)):
        return f"{name} returns a number that is not finite: is something divided by 0?"
    nonzero = np.abs(b) > 1e-9
    ratios = a[nonzero] / b[nonzero]
    if len(ratios) and np.ptp(ratios) < 1e-6 and np.allclose(a[~nonzero], 0.0, atol=1e-9):
        if abs(ratios[0] + 1.0) < 1e-6:
            return f"{name} has the wrong sign."
        return f"{name} is {ratios[0]:.4g} times what it should be: a factor is missing or one too many."
    return f"{name} is not right yet; this law does not hold: {law}."


def _formula(stage: Stage, name: str) -> str:
    module = next(home for home, names in stage.functions.items() if name in names)
    stated = formulas(module, name)
    formula = "; ".join(stated)
    chapter = f"chapter {stage.chapter} of the walk-through explains it"
    return f"The formula is {formula}; {chapter}." if formula else f"{chapter[0].upper()}{chapter[1:]}."


def _own_words(error: BaseException) -> str:
    return said(error).partition(": ")[2].split("; differs by")[0].splitlines()[0] if str(error) else "Compare by hand."
