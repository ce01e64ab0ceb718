"""What a law is: a sentence, the stage it speaks of, the functions it needs, and the inputs it quantifies over."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hypothesis import example, given
from hypothesis.errors import HypothesisException

from pop_ref.conformance.calls import Call
from pop_ref.conformance.capabilities import STAGES
from pop_ref.conformance.scenes import Scene


def _report(name: str, backend: Any, scenes: dict[str, Scene]) -> str:
    from pop_ref.conformance.failure_report import failure_report

    return failure_report(name, backend, scenes)


# Gaussians of a scene that a report shows
MOST_TOLD = 64

# what writes the report of a failing law: functions of its name, the backend and the scenes that were drawn
FAILURE_REPORTS: list[Callable[[str, Any, dict[str, Scene]], str]] = [_report]


@dataclass(frozen=True)
class Law:
    """A law and all that is needed to hold a backend to it.

    Attributes:
        stage: one of STAGES.
        needs: names of stage functions, or capabilities (`capabilities`); a backend without them is not judged.
        sentence: the function, whose name reads as the law; it takes `backend` and the drawn values.
        strategies: what it quantifies over, by argument name.
        first: values that it is tried on before any is drawn, each by argument name.
    """

    stage: str
    needs: tuple[str, ...]
    sentence: Callable[..., None]
    strategies: dict[str, Any]
    first: Sequence[dict[str, Any]] = ()

    @property
    def name(self) -> str:
        """Return the law's name without the test prefix."""
        return self.sentence.__name__.removeprefix("test_")

    def quantified(self, sentence: Callable[..., None]) -> Callable[..., Any]:
        """Return the sentence, or what wraps it, as a test of what is tried first and of what is drawn."""
        if not self.strategies:
            return sentence
        test = given(**self.strategies)(sentence)
        # the decorator that is applied last is tried first
        for values in reversed(self.first):
            test = example(**values)(test)
        return test


def law(
    stage: str, *needs: str, first: Sequence[dict[str, Any]] = (), **strategies: Any
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a test of a sentence, to be run over every backend that has what the law needs."""
    if stage not in STAGES:
        raise ValueError(f"stage {stage!r} is unknown; use one of {', '.join(STAGES)}")

    def decorate(sentence: Callable[..., None]) -> Callable[..., None]:
        stated = Law(stage, needs, sentence, strategies, first)
        test = _telling(sentence, stated.quantified)
        test.law = stated  # type: ignore[attr-defined]
        return test

    return decorate


def _telling(sentence: Callable[..., None], quantified: Callable[..., Any]) -> Callable[..., None]:
    """Return the law as a test whose failure says where the backend parts from the oracle, with code to paste.

    It is about the example that raised the error, and about no other: the error carries it.
    """

    @functools.wraps(sentence)
    def watched(backend: Any, **drawn: Any) -> None:
        __tracebackhide__ = True
        seen = _Watched(backend, drawn)
        try:
            sentence(seen, **drawn)
        except HypothesisException:
            # a scene that is set aside, or a misuse of a strategy: nothing about the backend
            raise
        except Exception as error:
            error.__dict__[_EXAMPLE] = seen
            raise

    test = quantified(watched)

    @functools.wraps(test)
    def reported(*args: Any, **named: Any) -> None:
        __tracebackhide__ = True
        try:
            test(*args, **named)
        except Exception as error:
            seen = _example_of(error)
            if seen is not None:
                for report in FAILURE_REPORTS:
                    error.add_note(_safely(report, sentence.__name__, seen, seen.scenes))
            raise

    return reported


# under what names an error carries the example that raised it, and that the backend itself raised it
_EXAMPLE, _RAISED_BY_BACKEND = "pop_example", "pop_raised_by_backend"


def _example_of(error: BaseException) -> _Watched | None:
    members = error.exceptions if isinstance(error, BaseExceptionGroup) else ()
    found = [error.__dict__.get(_EXAMPLE), *map(_example_of, members)]
    return next((seen for seen in found if seen is not None), None)


def is_crash(error: BaseException) -> bool:
    """Tell whether a law broke because the backend raised an error, not because of a comparison."""
    from pop_ref.conformance.pairs import RasterizerError

    return isinstance(error, RasterizerError) or bool(error.__dict__.get(_RAISED_BY_BACKEND))


class _Watched:
    """A backend that remembers what it was asked to draw, and marks the errors that it raises."""

    def __init__(self, adapter: Any, drawn: dict[str, Any]) -> None:
        self.adapter = adapter
        self._given = {name: value for name, value in drawn.items() if isinstance(value, Scene)}
        self._made: list[Scene] = []
        self.calls: list[Call] = []
        self.asked_for_gradients = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.adapter, name)

    def render(self, scene: Scene) -> Any:
        self._remember(scene)
        return _marked(self.adapter.render, scene)

    def plainly(self, scene: Scene) -> Any:
        self._remember(scene)
        return _marked(self.adapter.plainly, scene)

    def gradients(self, scene: Scene, *cotangents: Any) -> Any:
        self._remember(scene)
        self.asked_for_gradients = True
        return _marked(self.adapter.gradients, scene, *cotangents)

    def call(self, call: Call, *cotangents: Any) -> Any:
        if call.shape[2] <= MOST_TOLD:
            self.calls.append(call)
        self.asked_for_gradients |= bool(cotangents)
        return _marked(self.adapter.call, call, *cotangents)

    def stage(self, name: str) -> Any:
        return functools.partial(_marked, self.adapter.stage(name))

    def _remember(self, scene: Scene) -> None:
        # a scene of thousands is known by its name; to report about it would take the oracle minutes
        if len(scene.gaussians) <= MOST_TOLD:
            self._made.append(scene)

    @property
    def scenes(self) -> dict[str, Scene]:
        """Return, by name, the scenes that the law drew, as the backend reads them, and those that it made of them."""
        found = {name: self.adapter.sees(scene) for name, scene in self._given.items()}
        last = [frame.scene for call in self.calls[-1:] for _, _, frame in call.each]
        for scene in (*self._made, *last):
            if repr(scene) not in map(repr, found.values()):
                found[f"scene{len(found)}"] = scene
        return found


def _marked(function: Callable[..., Any], *args: Any, **named: Any) -> Any:
    """Call a backend's function; what it raises is marked as its own."""
    try:
        return function(*args, **named)
    except HypothesisException:
        raise
    except Exception as error:
        error.__dict__[_RAISED_BY_BACKEND] = True
        raise


def _safely(report: Callable[..., str], *about: Any) -> str:
    try:
        return report(*about)
    except Exception as error:
        # a broken backend may fail in the report as well; the law's own failure is what must be seen
        return f"no report: {error!r}"


def missing(backend: Any, needs: tuple[str, ...]) -> list[str]:
    """Return what the law needs and the backend lacks."""
    return [name for name in needs if not backend.has(name)]
