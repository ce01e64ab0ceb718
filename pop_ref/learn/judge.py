"""Judge one stage of a student: the examples of its docstrings, the course's own inputs, then the kit's laws.

The first that fails ends it, and what is told is the smallest input that was found, with the sentence that helps.
"""

from __future__ import annotations

import ast
import doctest
import importlib
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.capabilities import DOMINANCE, GRADIENTS, RENDER, capabilities_of
from pop_ref.conformance.capabilities import DOUBLE as IN_DOUBLE
from pop_ref.conformance.law import Law, missing
from pop_ref.conformance.laws import STANDS_IN
from pop_ref.conformance.scenes import Scene
from pop_ref.constants import PAPER, Profile
from pop_ref.density import POP, DensityConfig
from pop_ref.learn.course import DENSITY_SETTINGS, NOT_TAUGHT, Stage
from pop_ref.learn.diagnosis import diagnose
from pop_ref.learn.probes import oracle, probes
from pop_ref.learn.stubs import formulas
from pop_ref.learn.student import PACKAGE, Borrowed, Call, Work, borrowing, said, same, tried_on, where

EXAMPLES: Final = 12
# a broken law is made smaller for so long, then told as it is
PATIENCE_S: Final = 1.0
_EXAMPLE: Final = "the example in its docstring"
INPUT: Final = "on this input it gives something else than the oracle"


@dataclass(frozen=True)
class Verdict:
    """What came of judging a stage.

    Attributes:
        n_held: laws that hold; judging ends at the first that does not.
        right: functions that pass their examples and the course's inputs.
        broken: the sentence of what does not hold; empty if there is none.
        sentence: what is wrong, in words; empty if nothing is.
        hint: where to look.
        call: the smallest call on which a function is wrong, if one is.
        drawn: what the broken law was tried on.
        unwritten: functions of the stage that are still stubs.
    """

    n_held: int = 0
    right: tuple[str, ...] = ()
    broken: str = ""
    sentence: str = ""
    hint: str = ""
    call: Call | None = None
    drawn: dict[str, Any] | None = None
    unwritten: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Tell whether the stage is written and all holds."""
        return not self.broken and not self.unwritten


def judge(work: Work, stage: Stage) -> Verdict:
    """Try a student's stage, with the oracle's functions for all others.

    Raises:
        ValueError: the file cannot be run.
    """
    written = work.written[stage.name]
    with borrowing(work, (stage,)) as borrowed:
        found = [_function_tried(work, stage, borrowed, name) for name in stage.names if name in written]
        verdict = Verdict(
            right=tuple(name for name, wrong in zip(written, found, strict=True) if wrong is None),
            unwritten=tuple(name for name in stage.names if name not in written),
        )
        for wrong in found:
            if wrong is not None:
                return replace(wrong, right=verdict.right, unwritten=verdict.unwritten)
        return _laws_tried(work, stage, borrowed, verdict)


def _function_tried(work: Work, stage: Stage, borrowed: Borrowed, name: str) -> Verdict | None:
    """Try a function's examples and inputs; return what is wrong with it, if anything is."""
    example = _broken_example(borrowed, stage.home_of(name), name)
    function, truth = borrowed.installed[name], oracle()[name]
    calls = [tried_on(function, truth, given, words) for words, given in probes(name)]
    wrong = [call for call in calls if not call.is_right]
    if not wrong and not example:
        return None
    if not wrong:
        return Verdict(broken=_EXAMPLE, sentence=f"{name} fails {_EXAMPLE}: {example}", hint=_formula(stage, name))
    sentence, hint, shown = diagnose(calls, work.folder)
    broken = f"{_EXAMPLE}: {example}" if example else INPUT
    return Verdict(broken=broken.rstrip("."), sentence=sentence, hint=hint or _formula(stage, name), call=shown)


def _broken_example(borrowed: Borrowed, home: str, name: str) -> str:
    """Run the examples of a docstring with the student's function and with the oracle's; say where they part.

    Values are compared and not their text: -0 is 0, and a number is one in NumPy's clothes too.
    """
    theirs = dict(vars(importlib.import_module(f"pop_ref.{home}")))
    ours = dict(vars(borrowed.module(home)))
    for each in doctest.DocTestParser().get_examples(oracle()[name].__doc__ or ""):
        source = each.source.strip()
        is_value = isinstance(ast.parse(source).body[-1], ast.Expr)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            wanted = eval(source, theirs) if is_value else exec(source, theirs)
            try:
                found = eval(source, ours) if is_value else exec(source, ours)
                agrees = not is_value or found is wanted or same(found, wanted)
            except Exception as error:
                return f"{source} stops with {said(error)}"
        if not agrees:
            return f"{source} should give {' '.join(each.want.split())} and gives {' '.join(repr(found).split())[:200]}"
    return ""


def _laws_tried(work: Work, stage: Stage, borrowed: Borrowed, verdict: Verdict) -> Verdict:
    backend = _Judged(borrowed, stage, work.written[stage.name])
    laws = [law for law in _laws(stage) if not missing(backend, law.needs)]
    n_held = 0
    for law in laws:
        failure, was_tried = _tried(law, backend)
        if failure is not None:
            plain = replace(verdict, n_held=n_held, broken=law.name.replace("_", " "), drawn=failure.least)
            return _told(work, stage, borrowed, backend, law, failure, plain)
        n_held += was_tried
    return replace(verdict, n_held=n_held)


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
            # gsplat's option of `split_rows` is a boolean, its fourth argument
            other = name == "split_rows" and (*given[3:], named.get("revised_opacity", False))[0]
            if other or not all(map(_is_the_courses, (*given, *named.values()))):
                _set_aside()
            return function(*given, **named)

        return of_the_course

    def full_render(self, scene: Scene) -> Any:
        """Draw a scene, unless its constants are not the course's."""
        if not _is_the_courses(scene.profile):
            _set_aside()
        return super().full_render(scene)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return a scene's cotangents, unless its constants are not the course's."""
        if not _is_the_courses(scene.profile):
            _set_aside()
        return super().gradients(scene, v_image, v_T_final)


def _is_the_courses(value: Any) -> bool:
    """Tell that a value is none that the course leaves out.

    These are other profiles, settings of density control that chapter 9 does not teach, and cameras that are not rigid,
    for which two right formulas differ.
    """
    if isinstance(value, np.ndarray) and value.shape == (4, 4):
        return bool(np.allclose(value[:3, :3] @ value[:3, :3].T, np.eye(3), atol=1e-9))
    if isinstance(value, Profile):
        return replace(value, name=PAPER.name, tile_size=PAPER.tile_size) == PAPER
    if isinstance(value, DensityConfig):
        taught = {field.name: getattr(POP, field.name) for field in fields(POP) if field.name in DENSITY_SETTINGS}
        return replace(value, **taught) == POP
    return True


def _set_aside() -> None:
    from hypothesis.errors import UnsatisfiedAssumption

    raise UnsatisfiedAssumption


def _laws(stage: Stage) -> Iterator[Law]:
    """Go through the laws of a stage: those that speak of its functions first, then agreement with the oracle."""
    modules = [*(f"test_{STANDS_IN.get(name, name)}" for name in stage.laws), "test_agreement"]
    modules += ["test_gradients"] if stage.more_laws else []
    seen = set()
    for module in modules:
        for value in vars(importlib.import_module(f"pop_ref.conformance.laws.{module}")).values():
            law = getattr(value, "law", None)
            if (
                isinstance(law, Law)
                and law.name not in seen
                and law.name not in NOT_TAUGHT
                and (law.stage in stage.laws or law.name in stage.more_laws)
            ):
                seen.add(law.name)
                yield law


@dataclass
class _Failure:
    first: dict[str, Any]
    least: dict[str, Any]
    error: BaseException


def _tried(law: Law, backend: _Judged) -> tuple[_Failure | None, bool]:
    """Try a law; return the first input that broke it and the smallest that was found, and whether any was tried."""
    from hypothesis import HealthCheck, given, settings
    from hypothesis.errors import HypothesisException

    failure: _Failure | None = None
    until, was_tried = float("inf"), False

    def sentence(**drawn: Any) -> None:
        nonlocal failure, until, was_tried
        if time.thread_time() > until:
            return
        try:
            law.sentence(backend, **drawn)
            was_tried = True
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
        return failure, was_tried
    return failure, was_tried


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
    called = (least or first)[0].function
    sentence, hint, call = diagnose([each for each in (*least, *first) if each.function == called], work.folder)
    plain = replace(plain, right=tuple(name for name in plain.right if name != called))
    return replace(plain, sentence=sentence, hint=hint or _formula(stage, called), call=call)


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
    return [call for call in borrowed.calls if not call.is_right]


def _formula(stage: Stage, name: str) -> str:
    formula = "; ".join(formulas(stage.home_of(name), name))
    chapter = f"chapter {stage.chapter_of(name)} of the walk-through explains it"
    return f"The formula is {formula}; {chapter}." if formula else f"{chapter[0].upper()}{chapter[1:]}."


def _own_words(error: BaseException) -> str:
    return said(error).partition(": ")[2].split("; differs by")[0].splitlines()[0] if str(error) else "Compare by hand."
