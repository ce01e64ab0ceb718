"""One case a stage function: the inputs it is judged on, next to the oracle and next to its own transpose."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.scenes import pattern, rigid
from pop_ref.conformance.strategies import arrays_of, dyadic, opacities, quats, reals, viewmats
from pop_ref.constants import PROFILES

W, H = 8, 4
K = np.array([[8.0, 0.0, 3.0], [0.0, 16.0, 2.5], [0.0, 0.0, 1.0]])
N = 2

Inputs = st.SearchStrategy[tuple[Any, ...]]


@dataclass(frozen=True)
class Case:
    """A stage function and how to draw its positional arguments.

    Attributes:
        name: the function.
        stage: its stage.
        inputs: its arguments, without a cotangent.
        wrt: positions of the arguments that its transpose returns cotangents of; empty if it has none.
        cotangent_at: the position of v among the transpose's arguments; None puts it last.
        on_sphere: the argument is a unit vector: only the tangential part of its cotangent means anything.
        magnitude: what one unit of the value is eps times of; None measures it with `sensitivity`.
        first: arguments that are tried before any are drawn.
    """

    name: str
    stage: str
    inputs: Inputs
    wrt: tuple[int, ...] = ()
    cotangent_at: int | None = None
    magnitude: Callable[[tuple[Any, ...]], float] | None = None
    on_sphere: bool = False
    first: tuple[tuple[Any, ...], ...] = ()


def _stacked(rows: Inputs) -> st.SearchStrategy[np.ndarray]:
    return st.lists(rows, min_size=N, max_size=N).map(lambda r: np.array(r, dtype=np.float64))


def _vectors(n: int, low: float = -2.0, high: float = 2.0) -> st.SearchStrategy[np.ndarray]:
    return _stacked(st.tuples(*[reals(low, high)] * n))


def _apart_from_zero(array: np.ndarray) -> np.ndarray:
    # a direction, like a quaternion, needs a length
    short = np.sum(array * array, axis=1) < 2.0**-6
    return np.where(short[:, None], 1.0, array)


def _symmetric(n: int) -> st.SearchStrategy[np.ndarray]:
    return arrays_of((N, n, n)).map(lambda a: a @ np.swapaxes(a, 1, 2) + 2.0**-4 * np.eye(n))


profiles = st.sampled_from(sorted(PROFILES)).map(PROFILES.__getitem__)
quat_rows = _stacked(quats())
directions = _vectors(3).map(_apart_from_zero)
units = directions.map(lambda d: d / np.linalg.norm(d, axis=1, keepdims=True))
in_front = _stacked(st.tuples(reals(-4.0, 4.0), reals(-4.0, 4.0), reals(0.25, 8.0, dull=1.0)))
degrees = st.integers(0, 3)
# a pinhole's two zeros may be relied on
pinholes = arrays_of((N, 4)).map(
    lambda j: np.stack([j[:, 0], 0 * j[:, 0], j[:, 1], 0 * j[:, 0], j[:, 2], j[:, 3]], 1).reshape(N, 2, 3)
)
# 132 numbers are too many to draw one by one: a few seeds of dyadic patterns say as much
pictures = st.integers(0, 255).map(lambda k: pattern(k, (12, 11, 1)))
masks = st.lists(st.booleans(), min_size=N, max_size=N).map(np.array)
# of eight pixels, so that their means are exact
_FLAT, _SLOPING = np.full((8, 3), 0.5), np.arange(24.0).reshape(8, 3) / 32.0
pixels, rgb = st.integers(0, 255).map(lambda k: pattern(k, (9, 3))), arrays_of((3,), 0.0, 1.0)
# something is rendered everywhere: the laws of this stage try what is where nothing is
depth_maps = arrays_of((3, 4), 0.5, 8.0)
sparse_places, sparse_disparities = arrays_of((3, 2), 0.0, 3.0), arrays_of((3,), 0.125, 2.0)
pinhole_inputs = st.tuples(in_front, st.just(K), st.just(W), st.just(H), profiles)
pair = st.tuples(pictures, pictures)


def _ssim_magnitude(inputs: tuple[Any, ...]) -> float:
    # a variance is a difference of squares, divided by itself and C2 = 0.03^2 at least
    return 1.0 + sum(float(np.max(np.abs(a))) ** 2 for a in inputs[:2]) / 0.03**2


def _picture_magnitude(inputs: tuple[Any, ...]) -> float:
    return 1.0 + sum(float(np.max(np.abs(a))) for a in inputs[:2])


# rotations and translations: wide turns, hardly any, and slight ones, as large as those with series of their own may be
turns = st.sampled_from([2.0**-24, 1.0, 0.09375])
corrections = st.tuples(arrays_of((6,), -1.0, 1.0), turns).map(lambda w: w[0] * w[1])
# a slight turn about no axis, where the second term of a series counts
slight = (rigid((1.0, -2.0, 0.5, 1.5), (0.5, -1.0, 2.0)), np.array([0.0625, -0.0625, 0.03125, 2.0, -4.0, 3.0]))

CASES = (
    Case("scales_from_log_scales", "activations", st.tuples(_vectors(3, -8.0, 4.0)), (0,)),
    Case("opacities_from_logits", "activations", st.tuples(_vectors(1, -8.0, 8.0).map(np.ravel)), (0,)),
    Case("unit_quats_from_quats", "activations", st.tuples(quat_rows), (0,)),
    Case("rotmats_from_quats", "covariance", st.tuples(quat_rows), (0,)),
    Case("covars_from_quats_scales", "covariance", st.tuples(quat_rows, _vectors(3, 0.0, 4.0)), (0, 1)),
    Case("sh_basis", "harmonics", st.tuples(units, degrees), (0,), on_sphere=True),
    Case("colors_from_sh", "harmonics", st.tuples(arrays_of((N, 16, 3), -1.0, 1.0), directions, degrees), (0, 1)),
    Case("camera_center", "camera", st.tuples(viewmats()), (0,)),
    Case("view_dirs", "camera", st.tuples(_vectors(3, -4.0, 4.0), viewmats()), (0, 1)),
    Case("means_cam_from_means", "camera", st.tuples(_vectors(3, -4.0, 4.0), viewmats()), (0, 1)),
    Case("covars_cam_from_covars", "camera", st.tuples(_symmetric(3), viewmats()), (0, 1)),
    Case("project_means", "projection", pinhole_inputs, (0,), 4),
    Case("projection_jacobians", "projection", pinhole_inputs, (0,), 4),
    Case("project_covars", "projection", st.tuples(_symmetric(3), pinholes), (0, 1)),
    Case("low_pass", "footprint", st.tuples(_symmetric(2), dyadic(0.125, 1.0)), (0,)),
    Case("compensations", "footprint", st.tuples(_symmetric(2), dyadic(0.125, 1.0)), (0,)),
    Case("conics_from_covars2d", "footprint", st.tuples(_symmetric(2)), (0,)),
    Case("l1", "losses", pair, (0,), 2, magnitude=_picture_magnitude),
    Case("l2", "losses", pair, (0,), 2, magnitude=_picture_magnitude),
    Case("ssim", "losses", pair, (0,), 2, magnitude=_ssim_magnitude),
    Case("d_ssim", "losses", pair, (0,), 2, magnitude=_ssim_magnitude),
    Case("photometric_3dgs", "losses", pair, (0,), 2, magnitude=_ssim_magnitude),
    Case("photometric_pop", "losses", pair, (0,), 2, magnitude=_ssim_magnitude),
    Case("pop_loss", "polarization", st.tuples(_stacked(st.tuples(opacities())).map(np.ravel), masks), (0,)),
    Case("mean_activation", "few_photographs", st.tuples(_vectors(3, 0.0, 4.0)), (0,)),
    Case("sparse_depth_loss", "few_photographs", st.tuples(depth_maps, sparse_places, sparse_disparities), (0,)),
    Case("expose", "few_photographs", st.tuples(arrays_of((3, 2, 3)), arrays_of((3, 4))), (0, 1)),
    Case("centred_exposures", "few_photographs", st.tuples(arrays_of((3, 3, 4)))),
    # a flat render and a flat photograph have no slope
    Case(
        "color_correct",
        "few_photographs",
        st.tuples(pixels, pixels),
        first=((_FLAT, _SLOPING), (_SLOPING, _FLAT), (_FLAT, _FLAT)),
    ),
    Case("over_background", "few_photographs", st.tuples(arrays_of((2, 3, 3)), arrays_of((2, 3), 0.0, 1.0), rgb, rgb)),
    Case("refined_viewmat", "few_photographs", st.tuples(viewmats(), corrections), (0, 1), first=(slight,)),
)

BY_NAME = {case.name: case for case in CASES}


def transposed(case: Case, function: Callable[..., Any], inputs: tuple[Any, ...], v: Any) -> tuple[np.ndarray, ...]:
    """Call a transpose with its cotangent in its place; return the cotangents as a tuple."""
    at = len(inputs) if case.cotangent_at is None else case.cotangent_at
    found = function(*inputs[:at], v, *inputs[at:])
    pulled = found if isinstance(found, tuple) else (found,)
    return (tangential(pulled[0], inputs[0]),) if case.on_sphere else pulled


def tangential(v: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Return what is left of rows along the unit sphere."""
    return v - units * np.sum(v * units, axis=1, keepdims=True)


def cotangent_like(value: Any) -> Any:
    """Return dyadic cotangents of either sign for a value, a number for a number; symmetric for symmetric matrices."""
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0:
        return 0.75
    v = (np.mod(np.arange(array.size, dtype=np.float64) * 5.0 + 3.0, 16.0) - 7.5).reshape(array.shape) / 8.0
    square = array.ndim == 3 and array.shape[1] == array.shape[2] and np.array_equal(array, np.swapaxes(array, 1, 2))
    return 0.5 * (v + np.swapaxes(v, 1, 2)) if square else v


def error_bounds_of(case: Case, function: Callable[..., Any], inputs: tuple[Any, ...]) -> tuple[np.ndarray, ...]:
    """Bound the rounding of each output of a function, or of its transpose with the cotangent bound."""
    if case.magnitude is None:
        return sensitivity(function, inputs)
    size = case.magnitude(inputs)
    # a loss is a mean over pixels, so one unit of its gradient is a pixel's share
    return tuple(np.asarray(size / value.size) for value in _outputs(function(*inputs)))


def _outputs(value: Any) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(v, dtype=np.float64) for v in (value if isinstance(value, tuple) else (value,)))


def sensitivity(function: Callable[..., Any], inputs: tuple[Any, ...]) -> tuple[np.ndarray, ...]:
    """Bound rounding by how far a function's output moves when each entry of its input moves one eps, plus its size.

    This is the componentwise condition of the oracle's function, measured by differences; one array per output.
    """

    step = 2.0**-20
    here = _outputs(function(*inputs))
    error_bounds = [np.abs(h) + _row_size(h) for h in here]
    for k, argument in enumerate(inputs):
        if not (isinstance(argument, np.ndarray) and argument.dtype.kind == "f"):
            continue
        for index in zip(*np.nonzero(argument), strict=True):
            moved = argument.copy()
            moved[index] *= 1.0 + step
            there = _outputs(function(*inputs[:k], moved, *inputs[k + 1 :]))
            for error_bound, a, b in zip(error_bounds, here, there, strict=True):
                error_bound += np.abs(b - a) / step
    return tuple(error_bounds)


def _row_size(value: np.ndarray) -> np.ndarray:
    if value.ndim < 2:
        return np.abs(value)
    largest = np.max(np.abs(value), axis=tuple(range(1, value.ndim)), initial=0.0)
    return np.broadcast_to(largest.reshape(-1, *[1] * (value.ndim - 1)), value.shape)


def with_own_lists(
    function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Return a stage function's arguments with tile lists as the `TileLists` that its module knows, if it knows any."""
    own = getattr(sys.modules.get(function.__module__), "TileLists", None)
    signature = inspect.signature(function)
    if own is None or "lists" not in signature.parameters:
        return args, kwargs
    given = signature.bind(*args, **kwargs)
    named = given.arguments
    camera = named.get("camera")
    size = (named["width"], named["height"]) if camera is None else (camera.width, camera.height)
    named["lists"] = own.of(named["lists"], *size, named["tile_size"])
    return given.args, given.kwargs
