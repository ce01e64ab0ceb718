"""What a law is: a sentence, the stage it speaks of, the functions it needs, and the inputs it quantifies over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hypothesis import given

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
        test = given(**strategies)(sentence) if strategies else _plain(sentence)
        test.law = Law(stage, needs, sentence, strategies)  # type: ignore[attr-defined]
        return test

    return decorate


def _plain(sentence: Callable[..., None]) -> Callable[..., None]:
    def test(backend: Any) -> None:
        sentence(backend)

    test.__name__, test.__doc__, test.__module__ = sentence.__name__, sentence.__doc__, sentence.__module__
    return test


def missing(backend: Any, needs: tuple[str, ...]) -> list[str]:
    """Return what the law needs and the backend lacks."""
    return [name for name in needs if not backend.has(name)]
