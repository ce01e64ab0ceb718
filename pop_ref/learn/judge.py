"""Judge one stage of a student: the examples of its docstrings, the course's own inputs, then the kit's laws.

The first that fails ends it, and what is told is the smallest input that was found, in numbers or drawn, with the
sentence that helps and a hint.
"""

from __future__ import annotations

import ast
import doctest
import importlib
import textwrap
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.capabilities import ALL_BANDS, DOMINANCE, GRADIENTS, RENDER, capabilities_of
from pop_ref.conformance.capabilities import DOUBLE as IN_DOUBLE
from pop_ref.conformance.law import Law, missing
from pop_ref.conformance.laws import STANDS_IN
from pop_ref.conformance.scenes import Scene
from pop_ref.constants import PAPER, Profile
from pop_ref.density import POP, DensityConfig
from pop_ref.learn.course import DENSITY_SETTINGS, NOT_TAUGHT, Stage
from pop_ref.learn.diagnosis import diagnose, leaves, parts_named
from pop_ref.learn.probes import oracle, probes
from pop_ref.learn.stubs import formulas
from pop_ref.learn.student import PACKAGE, STOPS, Borrowed, Call, Work, borrowing, misspelt, said, same, tried_on, where
from pop_ref.recipes import RECIPES

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
        misspelt: functions of the file that are named nearly as these, by their names.
    """

    n_held: int = 0
    right: tuple[str, ...] = ()
    broken: str = ""
    sentence: str = ""
    hint: str = ""
    call: Call | None = None
    drawn: dict[str, Any] | None = None
    unwritten: tuple[str, ...] = ()
    misspelt: dict[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Tell whether the stage is written and all holds."""
        return not self.broken and not self.unwritten


# a block that may take long by a student's code, entered with the words that say what is judged in it
Watch = Callable[[str], AbstractContextManager[object]]


def judge(work: Work, stage: Stage, watch: Watch = nullcontext) -> Verdict:
    """Try a student's stage, with the oracle's functions for all others.

    Args:
        watch: surrounds the loading of the file, each function and each law.

    Raises:
        ValueError: the file is not Python or cannot be run.
    """
    written = work.written[stage.name]
    with ExitStack() as stack:
        with watch(f"{stage.file}, as it is loaded"):
            borrowed = stack.enter_context(borrowing(work, (stage,)))
        found: list[Verdict | None] = []
        for name in (name for name in stage.names if name in written):
            with watch(f"{name} of {stage.file}"):
                found.append(_function_tried(work, stage, borrowed, name))
        verdict = Verdict(
            right=tuple(name for name, wrong in zip(written, found, strict=True) if wrong is None),
            unwritten=tuple(name for name in stage.names if name not in written),
            misspelt=misspelt(work, stage),
        )
        for wrong in found:
            if wrong is not None:
                return replace(wrong, right=verdict.right, unwritten=verdict.unwritten, misspelt=verdict.misspelt)
        return _laws_tried(work, stage, borrowed, verdict, watch)


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
            except STOPS as error:
                return f"{source} stops with {said(error)}"
        if not agrees:
            return f"{source} should give {' '.join(each.want.split())} and gives {' '.join(repr(found).split())[:200]}"
    return ""


def _laws_tried(work: Work, stage: Stage, borrowed: Borrowed, verdict: Verdict, watch: Watch) -> Verdict:
    backend = _Judged(borrowed, stage, work.written[stage.name])
    laws = [law for law in _laws(stage) if not missing(backend, law.needs)]
    n_held = 0
    for law in laws:
        with watch(f"{', '.join(verdict.right)} of {stage.file} by the law '{law.name.replace('_', ' ')}'"):
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
        return need in self.written or need in (*self.able, IN_DOUBLE, ALL_BANDS) or need in capabilities_of(PAPER)

    def stage(self, name: str) -> Callable[..., Any]:
        """Return the student's function, or the oracle's where a law needs more than the stage."""
        function = self.borrowed.installed.get(name) or super().stage(name)

        def of_the_course(*given: Any, **named: Any) -> Any:
            # gsplat's option of `split_rows` is a boolean, its fourth argument
            other = name == "split_rows" and (*given[3:], named.get("revised_opacity", False))[0]
            _set_aside_unless(not other and all(map(_is_the_courses, (*given, *named.values()))))
            return function(*given, **named)

        return of_the_course

    def full_render(self, scene: Scene) -> Any:
        """Draw a scene, unless its constants are not the course's."""
        _set_aside_unless(_is_the_courses(scene.profile))
        return super().full_render(scene)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return a scene's cotangents, unless its constants are not the course's."""
        _set_aside_unless(_is_the_courses(scene.profile))
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


def _set_aside_unless(taught: bool) -> None:
    from hypothesis.errors import UnsatisfiedAssumption

    if not taught:
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


class _EnoughError(BaseException):
    """Hypothesis is to stop making a broken law's input smaller: it catches what is an Exception, and tries on."""


@dataclass
class _Failure:
    first: dict[str, Any]
    least: dict[str, Any]
    error: BaseException


def _tried(law: Law, backend: _Judged) -> tuple[_Failure | None, bool]:
    """Try a law; return the first input that broke it and the smallest that was found, and whether any was tried."""
    from hypothesis import HealthCheck, settings
    from hypothesis.errors import HypothesisException

    failure: _Failure | None = None
    until, was_tried = float("inf"), False

    def sentence(**drawn: Any) -> None:
        nonlocal failure, until, was_tried
        if time.thread_time() > until:
            raise _EnoughError
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
        (options(law.quantified(sentence)) if law.strategies else sentence)()
    except (Exception, _EnoughError):
        # set aside as a whole, or broken
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


_SHADES: Final = " .:-=+*#%@"
_LONGEST: Final = 12
# of an input; of what came out, and of what should
_MOST_LINES: Final = 14
_MOST_RESULTS: Final = 5


def told(stage: Stage, verdict: Verdict) -> str:
    """Tell a verdict."""
    lines = []
    if verdict.sentence:
        lines += [f"{stage.name}: not yet.", "", verdict.sentence, ""]
        lines += _counterexample(verdict)
        broken = verdict.broken if verdict.broken == INPUT else f"what does not hold: {verdict.broken}"
        lines += [f"hint: {verdict.hint}", "", f"{_held(stage, verdict)}; {broken}."]
    elif not verdict.unwritten:
        lines += [f"{stage.name}: passed. {_held(stage, verdict)}."]
    elif verdict.right:
        lines += [f"{stage.name}: right so far. {_held(stage, verdict)}."]
    if verdict.unwritten:
        lines += [f"still to write in {stage.file}: {', '.join(verdict.unwritten)}"]
        lines += [
            f"{stage.file} has {near}: rename it if it is meant as {name}" for name, near in verdict.misspelt.items()
        ]
    return "\n".join(textwrap.fill(line, 100) if line[:1].strip() else line for line in lines)


def _held(stage: Stage, verdict: Verdict) -> str:
    functions = f"{len(verdict.right)} of {len(stage.names)} functions give what the oracle gives"
    if len(stage.names) - len(verdict.right) - len(verdict.unwritten) > 1:
        functions += " (one that calls a wrong one is wrong with it)"
    laws = {0: "", 1: ", and 1 law holds"}.get(verdict.n_held, f", and {verdict.n_held} laws hold")
    return functions + laws


def _counterexample(verdict: Verdict) -> Iterator[str]:
    if verdict.call is not None:
        yield from _call_told(verdict.call)
    elif verdict.drawn:
        yield "the smallest input that was found:"
        yield from _capped([_named(name, value) for name, value in verdict.drawn.items()])
        yield ""


def _call_told(call: Call) -> Iterator[str]:
    yield f"{call.function} of"
    given = (*zip(call.parameters, call.given, strict=False), *call.named.items())
    yield from _capped([_named(name, value) for name, value in given])
    if call.error is None:
        found, expected = _results(call)
        yield "gives"
        yield from _capped([found], _MOST_RESULTS)
        yield "and should stop with a ValueError" if call.raises else "and should give"
        yield from _capped([] if call.raises else [expected], _MOST_RESULTS)
    yield ""


def _results(call: Call) -> tuple[list[str], list[str]]:
    """Write what came out and what should; of a result of many parts, those that differ."""
    (found, changed), (expected, meant) = call.found, call.expected
    both = leaves(call.found), leaves(call.expected)
    if len(both[0]) == len(both[1]) > 3:
        differ = [k for k in range(len(both[0])) if not same(both[0][k][1], both[1][k][1])]
        labels = parts_named(call.function, call)
        return (
            [f"  {labels[k]} = {_numbers(both[0][k][1], _LONGEST)}" for k in differ],
            [f"  {labels[k]} = {_numbers(both[1][k][1], _LONGEST)}" for k in differ],
        )
    return _shown(found, changed), _shown(expected, meant)


def _shown(returned: Any, changed: tuple[Any, ...]) -> list[str]:
    values = [*([] if returned is None and changed else [returned]), *changed]
    # several results, each by itself
    values = [each for value in values for each in (value if type(value) is tuple else (value,))]
    return [line for value in values for line in _named("", value)]


def _capped(parts: Sequence[Iterable[str]], at_most: int = _MOST_LINES) -> Iterator[str]:
    """Leave lines out where there are too many, of the longest parts: every argument is named."""
    each = [list(part) for part in parts]
    most = at_most
    while most > 1 and sum(min(len(lines), most) for lines in each) > at_most:
        most -= 1
    for lines in each:
        if len(lines) <= most:
            yield from lines
        elif most == 1:
            yield f"{lines[0]} ..."
        else:
            yield from [*lines[: most - 1], "    ..."]


def _named(name: str, value: Any) -> Iterator[str]:
    """Write a value in a few lines, a picture as a picture, parts by their names."""
    label = f"  {name} = " if name else "  "
    if isinstance(value, Scene):
        yield f"{label}{len(value.gaussians)} Gaussians, {value.camera.width} x {value.camera.height} px"
        for i, (mean, opacity) in enumerate(zip(value.gaussians.means, value.gaussians.opacities, strict=True)):
            yield f"    {i}: at {_numbers(mean)}, opacity {opacity:.4g}"
        return
    if callable(value):
        yield f"{label}a function"
        return
    parts = value if isinstance(value, dict) else _fields(value)
    if parts is not None:
        yield f"{label}{'' if isinstance(value, dict) else type(value).__name__}".rstrip()
        for each, part in parts.items():
            if isinstance(part, dict) or _fields(part) is not None:
                yield from (f"    {key} = {_numbers(inner, _LONGEST)}" for key, inner in leaves(part, each))
            else:
                yield f"    {each} = {_numbers(part, _LONGEST)}"
    elif isinstance(value, np.ndarray) and value.ndim == 3 and min(value.shape[:2]) > 4:
        yield f"{label}a picture"
        yield from (f"    {row}" for row in drawn(value))
    else:
        yield f"{label}{_numbers(value)}"


def _fields(value: Any) -> dict[str, Any] | None:
    """Return a value's parts by name; of settings those that are not the usual ones."""
    if hasattr(value, "_asdict"):
        return value._asdict()
    if not hasattr(value, "__dataclass_fields__"):
        return None
    parts = {name: getattr(value, name) for name in value.__dataclass_fields__}
    usual = {"DensityConfig": POP, "Recipe": RECIPES["POP"], "Profile": PAPER}.get(type(value).__name__)
    if usual is None:
        return parts
    # what a profile is called is of no account, and the course has one size of tile
    return {name: x for name, x in parts.items() if name != "name" and x != getattr(usual, name)}


def drawn(image: np.ndarray) -> list[str]:
    """Draw a picture in characters, two a pixel, dark to light.

    Example:
        >>> drawn(np.array([[[0.0], [0.5]], [[1.0], [0.0]]]))
        ['  ==', '@@  ']
    """
    light = np.clip(np.mean(image, axis=2), 0.0, 1.0)
    return ["".join(2 * _SHADES[round(float(x) * (len(_SHADES) - 1))] for x in row) for row in light]


def _numbers(value: Any, most: int = 4 * _LONGEST) -> str:
    if isinstance(value, np.ndarray):
        if value.size > most:
            return f"an array {list(value.shape)} from {float(np.min(value)):.4g} to {float(np.max(value)):.4g}"
        return _numbers(value.tolist())
    if isinstance(value, list | tuple):
        inner = ", ".join(_numbers(each) for each in value[:_LONGEST]) + (", ..." if len(value) > _LONGEST else "")
        return f"[{inner}]" if isinstance(value, list) else f"({inner})"
    if isinstance(value, bool | np.bool_):
        return str(bool(value))
    if isinstance(value, float | np.floating):
        return f"{float(value):.6g}"
    return str(value)
