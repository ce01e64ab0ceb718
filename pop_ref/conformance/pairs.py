"""A covering array over the whole signature of a rasterizer: every two values of two arguments meet in some call.

An error of two arguments together, as of packed rows and a camera that sees nothing, shows in no call that moves one
argument alone. A call has a level of each factor; some forty calls hold all pairs of levels. A level that the
rasterizer refuses where nothing else is asked is left out with its pairs; what it refuses only in company is a defect.

Of a call that breaks, `narrowed` takes away all that does not matter, and `cause` names the arguments that are left.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance.calls import Call, fewer_gaussians, simpler_calls, with_backgrounds
from pop_ref.conformance.signature import (
    Made,
    assert_arguments_unchanged,
    assert_dominance,
    assert_gradients,
    assert_gradients_without_that_of_means,
    assert_images,
    assert_images_without_gradients,
    assert_rows,
    assert_shapes_and_types,
    assert_tiles_where_told,
    made,
)
from pop_ref.conformance.views import call_for, clear_call, refusal_of, refuses_on_purpose


@dataclass(frozen=True)
class Level:
    """One value of an argument, as reports write it.

    Attributes:
        name: of the value.
        asks: options of `views.call_for` by name.
        needs: levels of other factors without which it means nothing, by factor.
    """

    name: str
    asks: Mapping[str, Any] = field(default_factory=dict)
    needs: Mapping[str, str] = field(default_factory=dict)


def _levels(*named: tuple[str, dict[str, Any]]) -> tuple[Level, ...]:
    return tuple(Level(name, asks) for name, asks in named)


# by argument, its values; the first is gsplat's default, or the plainest
FACTORS: Final[dict[str, tuple[Level, ...]]] = {
    "cameras": _levels(
        ("1", {}), ("2", {"count": 2}), ("3", {"count": 3}), ("2, the first sees nothing", {"count": 2, "blind": 0}),
        ("2, the last sees nothing", {"count": 2, "blind": 1}),
    ),
    "batch": _levels(("none", {}), ("[1]", {"batch": (1,)}), ("[2]", {"batch": (2,)}), ("[1, 2]", {"batch": (1, 2)})),
    "packed": _levels(("False", {}), ("True", {"packed": True})),
    "colors": _levels(
        ("harmonics of degree 1", {"degree": 1}), ("harmonics of degree 0", {"degree": 0}),
        ("harmonics of degree 3", {"degree": 3}), ("degree 1 of 3", {"degree": 3, "sh_degree": 1}),
        *((f"{n} channel{'s' * (n > 1)}", {"channels": n}) for n in (3, 1, 5, 33)),
    ),
    "colors of each camera": _levels(("no", {}), ("yes", {"camera_colors": True})),
    "render_mode": _levels(*((mode, {"render_mode": mode}) for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED"))),
    "backgrounds": _levels(("given", {}), ("None", {"no_background": True})),
    "rasterize_mode": _levels(("classic", {}), ("antialiased", {"antialiased": True})),
    "covars": _levels(("None", {}), ("given", {"covars": True})),
    "radius_clip": _levels(("0", {}), ("5.5", {"radius_clip": 5.5})),
    "near_plane, far_plane": _levels(
        ("default", {}), ("near_plane=2", {"near_plane": 2.0}), ("far_plane=4.5", {"far_plane": 4.5}),
    ),
    "eps2d": _levels(("0.3", {}), ("1.25", {"eps2d": 1.25})),
    "picture": _levels(
        ("17x11, tiles of 4", {}), ("9x7, one tile", {"size": (9, 7), "tile_size": 16}),
        ("35x33, 306 tiles", {"size": (35, 33), "tile_size": 2}),
    ),
    "absgrad": _levels(("False", {}), ("True", {"absgrad": True})),
    "sparse_grad": (Level("False"), Level("True", {"sparse_grad": True}, {"packed": "True"})),
    "dominance": _levels(("not asked", {}), ("asked", {"dominance": True})),
}  # fmt: skip

Row = tuple[str, ...]
Pair = tuple[tuple[str, str], tuple[str, str]]


def level(factor: str, name: str) -> Level:
    """Return a factor's level of that name."""
    return next(each for each in FACTORS[factor] if each.name == name)


def bare_call(backend: Any, factor: str, name: str) -> Call:
    """Return the call that asks for one level, what it needs, and nothing else."""
    one = level(factor, name)
    asks = dict(one.asks)
    for other, needed in one.needs.items():
        asks |= level(other, needed).asks
    return call_for(backend, **asks)


@dataclass(frozen=True)
class Accepted:
    """What a rasterizer takes of the signature.

    Attributes:
        levels: by factor, the names of its levels that are not refused.
        refused: "factor=level" of those that are, and in what words.
    """

    levels: dict[str, tuple[str, ...]]
    refused: dict[str, str]


def accepted(backend: Any) -> Accepted:
    """Ask a rasterizer for every level alone, once."""
    known = backend.__dict__.setdefault("_known_levels", [])
    if not known:
        known.append(_asked(backend))
    return known[0]


def _asked(backend: Any) -> Accepted:
    levels: dict[str, tuple[str, ...]] = {}
    refused: dict[str, str] = {}
    for factor, values in FACTORS.items():
        taken = []
        for one in values:
            words = (_senseless(backend, factor) or _beyond_bands(backend, one)) if one.asks else None
            if one.asks and words is None:
                words = refusal_of(backend, bare_call(backend, factor, one.name))
            if words is None:
                taken.append(one.name)
            else:
                refused[f"{factor}={one.name}"] = words
        levels[factor] = tuple(taken)
    return Accepted(levels, refused)


def _senseless(backend: Any, factor: str) -> str | None:
    """Return why a factor has one level for a rasterizer of these constants and arguments; None if it has all."""
    square = backend.profile is not None and backend.profile.extent == "square"
    if factor == "radius_clip" and square:
        return "a splat that is culled is drawn with opacity 0, which a square extent does not read"
    if factor == "picture" and (square or not backend.takes("tile_size")):
        return "the side of its tiles is fixed"
    if factor == "dominance" and not backend.takes("dominance"):
        return "it has no such argument"
    return None


def _beyond_bands(backend: Any, one: Level) -> str | None:
    """Return why a level of harmonics is none for a rasterizer that has fewer bands; None if it has them."""
    fewer = one.asks.get("degree", 0) > backend.sh_degree
    return f"it takes harmonics up to degree {backend.sh_degree}" if fewer else None


def pairs_of(rows: Iterable[Mapping[str, str]]) -> set[Pair]:
    """Return the pairs of levels that meet in rows of a level for each factor."""
    return {pair for row in rows for pair in itertools.combinations(row.items(), 2)}


def possible_pairs(levels: Mapping[str, tuple[str, ...]]) -> list[Pair]:
    """List the pairs of levels of different factors that can meet in a call."""
    found = []
    for (f, of_f), (g, of_g) in itertools.combinations(levels.items(), 2):
        found += [((f, a), (g, b)) for a in of_f for b in of_g if _fit((f, a), (g, b)) and _fit((g, b), (f, a))]
    return found


def _fit(one: tuple[str, str], other: tuple[str, str]) -> bool:
    needed = level(*one).needs.get(other[0])
    return needed is None or needed == other[1]


def covering_rows(levels: Mapping[str, tuple[str, ...]]) -> list[dict[str, str]]:
    """Return rows, of a level for each factor, in which all possible pairs of levels meet.

    Greedy, as AETG: a row begins with the first pair that has not met, and each further factor takes the level that
    brings most new pairs; the same levels give the same rows on every machine.

    Source: Cohen, Dalal, Fredman, Patton 1997, "The AETG system", IEEE Transactions on Software Engineering 23.
    """
    return [dict(row) for row in _covering_rows(tuple(levels.items()))]


@functools.cache
def _covering_rows(levels: tuple[tuple[str, tuple[str, ...]], ...]) -> tuple[dict[str, str], ...]:
    of, rows = dict(levels), []
    left = dict.fromkeys(possible_pairs(of))
    used: Counter[tuple[str, str]] = Counter()
    factors = list(of)
    while left:
        first = next(iter(left))
        row = dict(first)
        for one in first:
            row |= level(*one).needs
        # the factors of many levels first, as they have most to lose
        for factor in sorted((f for f in factors if f not in row), key=lambda f: -len(of[f])):
            fitting = [n for n in of[factor] if all(_fit((factor, n), o) and _fit(o, (factor, n)) for o in row.items())]
            gains = {n: sum(_pair(factors, (factor, n), other) in left for other in row.items()) for n in fitting}
            row[factor] = max(fitting, key=lambda n: (gains[n], -used[factor, n]))
        row = {factor: row[factor] for factor in factors}
        for pair in itertools.combinations(row.items(), 2):
            left.pop(pair, None)
        used.update(row.items())
        rows.append(row)
    return tuple(rows)


def _pair(factors: list[str], one: tuple[str, str], other: tuple[str, str]) -> Pair:
    return (one, other) if factors.index(one[0]) < factors.index(other[0]) else (other, one)


def call_of(backend: Any, row: Mapping[str, str], number: int) -> Call:
    """Return the call of a row: of Gaussians in which no decision of an argument is near its threshold.

    Args:
        backend: whose precision and constants it is written for.
        row: a level for each factor.
        number: of the row, so that no two have the same Gaussians.
    """
    asks: dict[str, Any] = {}
    for factor, name in row.items():
        asks |= level(factor, name).asks
    # what a scene is, as a backend reads it, follows from these
    # a bound method is another at every look; of a wrapper it is that of what it wraps
    reader = getattr(backend.sees, "__func__", backend.sees)
    key = (tuple(row.items()), number, np.dtype(backend.dtype).name, backend.profile, reader)
    side = getattr(backend, "own_tile_size", None) if not backend.takes("tile_size") else None
    if (*key, side) not in _calls:
        layout = _IN_MEMORY[number % len(_IN_MEMORY)]
        _calls[*key, side] = replace(clear_call(backend, first_seed=16 * number, **asks), layout=layout)
    return _calls[*key, side]


# how a row's tensors lie, in turn: every level is given otherwise than densely, too
_IN_MEMORY: Final = ("transposed", "dense", "sliced", "dense", "transposed")
# by row and reader: two mutants are asked the same
_calls: dict[tuple[Any, ...], Call] = {}


# by what a law compares of a call
CHECKS: Final[dict[str, Callable[[Any, Made], None]]] = {
    "images": assert_images,
    "gradients": assert_gradients,
    "rows": assert_rows,
    "dominance": assert_dominance,
    "tiles": assert_tiles_where_told,
    "arguments": assert_arguments_unchanged,
    "types": assert_shapes_and_types,
    "no gradients": assert_images_without_gradients,
    "frozen means": assert_gradients_without_that_of_means,
}


@dataclass(frozen=True)
class Trial:
    """What came of a row.

    Attributes:
        row: a level for each factor.
        call: that has them.
        error: what the rasterizer raised in place of an answer.
        broken: by name of a check, how it broke.
    """

    row: dict[str, str]
    call: Call
    error: Exception | None
    broken: dict[str, str]


def trials(backend: Any) -> Iterator[Trial]:
    """Yield what came of every row; each is drawn and compared once for a backend, when it is first asked for."""
    # a law hands on a backend that it watches
    judged = getattr(backend, "adapter", backend)
    known: list[Trial] = judged.__dict__.setdefault("_tried_pairs", [])
    for number, row in enumerate(covering_rows(accepted(judged).levels)):
        if number == len(known):
            known.append(_trial(judged, row, call_of(judged, row, number)))
        yield known[number]


def _trial(backend: Any, row: dict[str, str], call: Call) -> Trial:
    try:
        of = made(backend, call)
    except Exception as error:
        return Trial(row, call, error, {})
    broken = {name: words for name, check in CHECKS.items() if (words := broken_by(check, backend, of)) is not None}
    return Trial(row, call, None, broken)


def assert_every_pair(backend: Any, check: str) -> None:
    """Assert that a check holds of every row that was answered."""
    for trial in trials(backend):
        if check in trial.broken:
            # once more, for the report of the law, which narrows its last call
            words = breaks(backend, trial.call, CHECKS[check])
            assert words is None, f"{words}; the call has {', '.join(trial.call.described())}"
            raise AssertionError(f"{trial.broken[check]}; the call made again has another result")


def assert_no_pair_fails(backend: Any) -> None:
    """Assert that every row is answered: an argument that is taken alone is taken together with any other.

    Raises:
        RasterizerError: it is not; says what the rasterizer raised, and for which arguments.
    """
    for trial in trials(backend):
        if trial.error is not None:
            breaks(backend, trial.call, None)
            raise RasterizerError(
                f"the rasterizer {raised(trial.error)}; the call has {', '.join(trial.call.described())}"
            ) from trial.error


def judged_pairs(backend: Any) -> dict[str, Any]:
    """Return what a scorecard says of the pairs of levels: how many were compared, by pairs of arguments; which not.

    Empty where no law has asked for them.
    """
    if not getattr(backend, "__dict__", {}).get("_tried_pairs"):
        return {}
    of, every_trial = accepted(backend), list(trials(backend))
    met = pairs_of(trial.row for trial in every_trial if trial.error is None)
    every = possible_pairs({factor: tuple(one.name for one in values) for factor, values in FACTORS.items()})
    taken = set(possible_pairs(of.levels))
    by_arguments: dict[str, list[int]] = {}
    for pair in taken:
        counts = by_arguments.setdefault(f"{pair[0][0]} x {pair[1][0]}", [0, 0])
        counts[0] += pair in met
        counts[1] += 1
    failed = sorted(f"{f}={a} with {g}={b}" for (f, a), (g, b) in taken - met)
    return {
        "judged": len(met & taken),
        "taken": len(taken),
        "of": len(every),
        "calls": len(every_trial),
        "refused alone": of.refused,
        "only in calls that fail": failed,
        "by arguments": {name: f"{a} of {b}" for name, (a, b) in sorted(by_arguments.items())},
    }


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
