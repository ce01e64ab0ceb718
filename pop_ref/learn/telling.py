"""What a verdict says to a student: a sentence, the counterexample in numbers or drawn, a hint."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.learn.course import Stage
from pop_ref.learn.judge import Verdict
from pop_ref.learn.student import Call

_SHADES: Final = " .:-=+*#%@"
_LONGEST: Final = 12


def told(stage: Stage, verdict: Verdict) -> str:
    """Tell a verdict."""
    lines = []
    if verdict.sentence:
        lines += [f"{stage.name}: not yet.", "", verdict.sentence, ""]
        lines += _counterexample(verdict)
        lines += [
            f"hint: {verdict.hint}",
            "",
            f"{_held(verdict)}; the first that does not: {verdict.broken}.",
        ]
    elif not verdict.unwritten:
        lines += [f"{stage.name}: passed. {_held(verdict)}."]
    elif verdict.n_held:
        lines += [f"{stage.name}: right so far. {_held(verdict)}."]
    if verdict.unwritten:
        lines += [f"still to write in {stage.file}: {', '.join(verdict.unwritten)}"]
    return "\n".join(textwrap.fill(line, 100) if line[:1].strip() else line for line in lines)


def _held(verdict: Verdict) -> str:
    return "1 law holds" if verdict.n_held == 1 else f"{verdict.n_held} laws hold"


def _counterexample(verdict: Verdict) -> Iterator[str]:
    if verdict.call is not None:
        yield from _call_told(verdict.call)
    elif verdict.drawn:
        yield "the smallest input that was found:"
        for name, value in verdict.drawn.items():
            yield from _named(name, value)
        yield ""


def _call_told(call: Call) -> Iterator[str]:
    yield f"{call.function} of"
    for name, value in (*zip(call.parameters, call.given, strict=False), *call.named.items()):
        yield from _named(name, value)
    yield "gives"
    yield from _shown(*call.found)
    yield "and should give"
    yield from _shown(*call.expected)
    yield ""


def _shown(returned: Any, changed: tuple[Any, ...]) -> Iterator[str]:
    for value in (*([] if returned is None and changed else [returned]), *changed):
        yield from _named("", value)


def _named(name: str, value: Any) -> Iterator[str]:
    """Write a value in a few lines, a picture as a picture, parts by their names."""
    label = f"  {name} = " if name else "  "
    if isinstance(value, Scene):
        yield f"{label}{len(value.gaussians)} Gaussians, {value.camera.width} x {value.camera.height} px"
        for i, (mean, opacity) in enumerate(zip(value.gaussians.means, value.gaussians.opacities, strict=True)):
            yield f"    {i}: at {_numbers(mean)}, opacity {opacity:.4g}"
        return
    parts = getattr(value, "_asdict", lambda: None)() if hasattr(value, "_asdict") else None
    if parts is None and hasattr(value, "__dataclass_fields__"):
        parts = {} if hasattr(value, "alpha_floor") else {f: getattr(value, f) for f in value.__dataclass_fields__}
        if not parts:
            yield f"{label}{value.name}"
    if parts:
        yield f"{label}{type(value).__name__}"
        for each, part in parts.items():
            yield f"    {each} = {_numbers(part)}"
        return
    if parts is None:
        array = np.asarray(value) if isinstance(value, np.ndarray) else None
        if array is not None and array.ndim == 3 and min(array.shape[:2]) > 4:
            yield f"{label}a picture"
            yield from (f"    {row}" for row in drawn(array))
        else:
            yield f"{label}{_numbers(value)}"


def drawn(image: np.ndarray) -> list[str]:
    """Draw a picture in characters, two a pixel, dark to light.

    Example:
        >>> drawn(np.array([[[0.0], [0.5]], [[1.0], [0.0]]]))
        ['  ==', '@@  ']
    """
    light = np.clip(np.mean(image, axis=2), 0.0, 1.0)
    return ["".join(2 * _SHADES[round(float(x) * (len(_SHADES) - 1))] for x in row) for row in light]


def _numbers(value: Any) -> str:
    if isinstance(value, np.ndarray):
        if value.size > _LONGEST * 4:
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
