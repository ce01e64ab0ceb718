"""Checks of a transpose: differences, the dot-product test, exact zeros, and a guard against checking nothing."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

Arrays = Sequence[np.ndarray]


def central_gradient(f: Callable[[np.ndarray], float], x: np.ndarray, step: float = 1e-4) -> np.ndarray:
    """Differentiate a scalar function entry by entry with fourth-order central differences.

    The step is relative to an entry's size where that exceeds 1.
    """
    gradient = np.zeros_like(x)
    for index in np.ndindex(*x.shape):
        h = step * max(1.0, abs(float(x[index])))
        values: dict[int, float] = {}
        for k in (-2, -1, 1, 2):
            moved = x.copy()
            moved[index] += k * h
            values[k] = f(moved)
        gradient[index] = (8.0 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12.0 * h)
    return gradient


def complex_step_gradient(f: Callable[[np.ndarray], complex], x: np.ndarray) -> np.ndarray:
    """Differentiate an analytic function entry by entry: `Im f(x + i h) / h`, without cancellation."""
    gradient = np.zeros(x.shape)
    for index in np.ndindex(*x.shape):
        moved = x.astype(complex)
        moved[index] += 1e-30j
        gradient[index] = f(moved).imag / 1e-30
    return gradient


def inner(vs: Arrays, ys: Arrays) -> float:
    """Sum the products of matching entries."""
    return float(sum(np.sum(v * y) for v, y in zip(vs, ys, strict=True)))


def as_arrays(value: Any) -> list[np.ndarray]:
    """Make a list of float64 arrays of one output, or of a tuple of them."""
    values = value if isinstance(value, tuple) else (value,)
    return [np.asarray(v, dtype=np.float64) for v in values]


def assert_vjp_matches(
    f: Callable[..., Any],
    vjp: Callable[..., Any],
    args: Arrays,
    rtol: float = 1e-6,
    *,
    seed: int = 0,
    step: float = 1e-4,
    zero_gradient_allowed: Collection[int] = (),
) -> None:
    """Check `vjp(*args, *v_outputs)` against `f(*args)`, both of arrays; an output or gradient may be a tuple.

    Four things must hold, with random cotangents of every output:
    every argument has a gradient that is not zero (unless its position is in `zero_gradient_allowed`);
    it equals central differences to `rtol` of its norm; `<v, J u> = <J^T v, u>` along a random direction of all
    arguments together; a zero cotangent gives exact zeros.
    """
    rng = np.random.default_rng(seed)
    args = [np.asarray(a, dtype=np.float64) for a in args]
    outputs = as_arrays(f(*args))
    vs = [rng.normal(size=y.shape) for y in outputs]
    analytic = as_arrays(vjp(*args, *vs))
    assert len(analytic) == len(args), f"{len(analytic)} gradients for {len(args)} arguments"
    assert any(np.any(y != 0.0) for y in outputs), "vacuous: every output is zero"
    flat = [g.ravel() for g in analytic]

    for k, arg in enumerate(args):

        def loss_of(moved: np.ndarray, k: int = k) -> float:
            return inner(vs, as_arrays(f(*args[:k], moved, *args[k + 1 :])))

        assert analytic[k].shape == arg.shape, f"gradient {k} has shape {analytic[k].shape}, its argument {arg.shape}"
        # an argument that is not read has no differences; harmonics beside given colours are most of all entries
        idle = k in zero_gradient_allowed and not _is_read(f, args, k, rng)
        numeric = np.zeros_like(arg) if idle else central_gradient(loss_of, arg, step)
        scale = float(np.linalg.norm(numeric))
        assert scale > 0.0 or k in zero_gradient_allowed, f"vacuous: argument {k} has no influence"
        error = float(np.linalg.norm(analytic[k] - numeric))
        limit = rtol * (scale if k not in zero_gradient_allowed else max(scale, np.linalg.norm(np.concatenate(flat))))
        assert error <= limit, f"gradient {k} is off by {error:.3e}, its norm is {scale:.3e}"

    us = [rng.normal(size=a.shape) for a in args]

    def loss_along(t: np.ndarray) -> float:
        return inner(vs, as_arrays(f(*(a + t * u for a, u in zip(args, us, strict=True)))))

    pushed = float(central_gradient(loss_along, np.array(0.0), step))
    pulled = inner(analytic, us)
    magnitude = float(sum(np.sum(np.abs(g * u)) for g, u in zip(analytic, us, strict=True)))
    assert abs(pushed - pulled) <= rtol * magnitude, f"<v, Ju> = {pushed!r} but <J^T v, u> = {pulled!r}"

    silent = as_arrays(vjp(*args, *(np.zeros_like(v) for v in vs)))
    assert all(np.all(g == 0.0) for g in silent), "a zero cotangent gives a gradient that is not zero"


def _is_read(f: Callable[..., Any], args: Arrays, k: int, rng: np.random.Generator) -> bool:
    """Tell whether any bit of the outputs changes when every entry of one argument does."""
    moved = args[k] * rng.uniform(1.001, 1.002, args[k].shape) + rng.uniform(1e-4, 2e-4, args[k].shape)
    outputs = zip(as_arrays(f(*args)), as_arrays(f(*args[:k], moved, *args[k + 1 :])), strict=True)
    return not all(np.array_equal(before, after) for before, after in outputs)
