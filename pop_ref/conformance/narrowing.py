"""Which arguments of a call break a rasterizer: those that are left when all that does not matter is taken away."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from pop_ref.conformance.calls import Call, fewer_gaussians, simpler_calls, with_backgrounds
from pop_ref.conformance.signature import Made, made
from pop_ref.conformance.views import refuses_on_purpose

Check = Callable[[Any, Made], None]


class RasterizerError(AssertionError):
    """The rasterizer raised an error where it had to answer: it was not compared with anything."""


def broken_by(check: Check, backend: Any, of: Made) -> str | None:
    """Return how a check breaks on what a rasterizer made of a call; None if it holds."""
    try:
        check(backend, of)
    except AssertionError as error:
        return str(error)
    return None


def breaks(backend: Any, call: Call, check: Check | None) -> str | None:
    """Return how a call breaks; None if it does not.

    Args:
        backend: that is judged.
        call: that it is asked for.
        check: that has to hold of its answer; None asks whether there is an answer.
    """
    try:
        of = made(backend, call)
    except Exception as error:
        return raised(error) if check is None else None
    return None if check is None else broken_by(check, backend, of)


def raised(error: Exception) -> str:
    """Say in a few words what kind of error a rasterizer raised."""
    told = f"{type(error).__name__}: {error}".splitlines()[0]
    if refuses_on_purpose(error):
        return f"refuses, though it takes each of them alone ({told})"
    return f"fails an assertion of its own ({told})" if isinstance(error, AssertionError) else f"crashes ({told})"


def narrowed(backend: Any, call: Call, check: Check | None, gaussians: bool = False) -> tuple[Call, str]:
    """Return the plainest call that breaks as well, and how it breaks.

    Args:
        backend: that is judged.
        call: that breaks.
        check: what breaks, as for `breaks`.
        gaussians: whether Gaussians that do not matter are left out, too.
    """
    words = breaks(backend, call, check)
    assert words is not None, "the call does not break a second time"
    steps: list[Callable[[Call], Iterator[Call]]] = [simpler_calls, *[fewer_gaussians] * gaussians]
    for step in steps:
        found = True
        while found:
            found = False
            for simpler in step(call):
                told = breaks(backend, simpler, check)
                if told is not None:
                    call, words, found = simpler, told, True
                    break
    return call, words


def cause(backend: Any, call: Call, check: Check | None) -> str:
    """Name the arguments on which a call that has been narrowed breaks."""
    needed = call.described()
    if call.no_background and breaks(backend, with_backgrounds(call), check) is None:
        needed.append("backgrounds=None")
    if not needed:
        return "with every argument at its default"
    if len(needed) == 1:
        return f"with {needed[0]}"
    return f"with {', '.join(needed[:-1])} and {needed[-1]} together, and not with fewer"
