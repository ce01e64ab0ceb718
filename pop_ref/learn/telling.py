"""What a verdict says to a student: a sentence, the counterexample in numbers or drawn, a hint."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.constants import PAPER
from pop_ref.density import POP
from pop_ref.learn.course import Stage
from pop_ref.learn.diagnosis import leaves, parts_named
from pop_ref.learn.judge import INPUT, Verdict
from pop_ref.learn.student import Call, same
from pop_ref.recipes import RECIPES

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
