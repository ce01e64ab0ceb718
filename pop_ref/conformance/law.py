"""What a law is: a sentence, the stage it speaks of, the functions it needs, and the inputs it quantifies over."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hypothesis import given
from hypothesis.errors import HypothesisException

STAGES = (
    "activations",
    "covariance",
    "harmonics",
    "camera",
    "projection",
    "footprint",
    "tiles",
    "alpha",
    "compositing",
    "dominance",
    "gradients",
    "whole",
    "losses",
    "polarization",
    "density",
    "optimizer",
)
RENDER, GRADIENTS, DOMINANCE = "render", "gradients", "dominance"
PROFILES, DOUBLE, ROWWISE = "any profile", "double precision", "rows computed one by one"


def _tell(name: str, backend: Any, drawn: dict[str, Any]) -> str:
    from pop_ref.conformance.telling import tell

    return tell(name, backend, drawn)


# what a failing law is told by: functions of its name, the backend and the drawn values
TELL: list[Callable[[str, Any, dict[str, Any]], str]] = [_tell]


@dataclass(frozen=True)
class Law:
    """A law and all that is needed to hold a backend to it.

    Attributes:
        stage: one of STAGES.
        needs: names of stage functions, or RENDER, GRADIENTS, DOMINANCE, PROFILES, DOUBLE, ROWWISE; a backend
            without them is not judged.
        sentence: the function, whose name reads as the law; it takes `backend` and the drawn values.
        strategies: what it quantifies over, by argument name.
    """

    stage: str
    needs: tuple[str, ...]
    sentence: Callable[..., None]
    strategies: dict[str, Any]

    @property
    def name(self) -> str:
        """Return the law's name without the test prefix."""
        return self.sentence.__name__.removeprefix("test_")


def law(stage: str, *needs: str, **strategies: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a test of a sentence, to be run over every backend that has what the law needs."""
    if stage not in STAGES:
        raise ValueError(f"stage {stage!r} is unknown; use one of {', '.join(STAGES)}")

    def decorate(sentence: Callable[..., None]) -> Callable[..., None]:
        told = _telling(sentence)
        test = given(**strategies)(told) if strategies else told
        test.law = Law(stage, needs, sentence, strategies)  # type: ignore[attr-defined]
        return test

    return decorate


def _telling(sentence: Callable[..., None]) -> Callable[..., None]:
    """Return the sentence, adding to what it raises where the backend parts from the oracle and code to paste."""

    @functools.wraps(sentence)
    def told(backend: Any, **drawn: Any) -> None:
        try:
            sentence(backend, **drawn)
        except HypothesisException:
            # a scene that is set aside, or a misuse of a strategy: nothing about the backend
            raise
        except Exception as error:
            for tell in TELL:
                error.add_note(_safely(tell, sentence.__name__, backend, drawn))
            raise

    return told


def _safely(tell: Callable[..., str], *about: Any) -> str:
    try:
        return tell(*about)
    except Exception as error:
        # a broken backend may fail in the report as well; the law's own failure is what must be seen
        return f"no report: {error!r}"


def missing(backend: Any, needs: tuple[str, ...]) -> list[str]:
    """Return what the law needs and the backend lacks."""
    return [name for name in needs if not backend.has(name)]
