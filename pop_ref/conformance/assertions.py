"""Assertions that say what differs, where first, and by how many units: of arrays, and of whole renders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.adapter import error_bounds_of
from pop_ref.conformance.error_bounds import PixelErrorBounds
from pop_ref.conformance.scenes import Scene
from pop_ref.margins import margins

# beyond this many units a conic has no digits left to compare: the scene is set aside by a computed number
WORST_CONDITION = 1.0 / 64.0

MOTIONS = tuple(f"{kind} the camera's {axis}" for kind in ("shift along", "turn about") for axis in "xyz")


def assert_close(
    key: str,
    actual: Any,
    expected: Any,
    magnitude: Any,
    dtype: Any,
    against_oracle: bool = False,
    mask: Any = None,
    place: Callable[[tuple[int, ...]], str] | None = None,
) -> None:
    """Assert that every entry differs by at most the key's tolerance times eps times its magnitude.

    Args:
        key: the tolerance, and the name in the message.
        actual, expected: arrays of one shape.
        magnitude: what one unit is a multiple of eps of; broadcasts.
        dtype: the precision whose eps is meant.
        against_oracle: True gives a float64 backend the room of `tolerances.agreement`.
        mask: the entries that are compared, along the leading axes; None for all.
        place: writes where an entry is, from its index; None writes the index.
    """
    actual, expected = np.asarray(actual, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    assert actual.shape == expected.shape, f"{key}: shape {actual.shape}, expected {expected.shape}"
    compared = np.ones(actual.shape, dtype=bool)
    if mask is not None:
        compared &= np.reshape(mask, np.shape(mask) + (1,) * (actual.ndim - np.ndim(mask)))
    if not np.any(compared):
        return
    # a law compares two answers of one backend, too: either may hold no number
    strange = compared & ~(np.isfinite(actual) & np.isfinite(expected))
    assert not np.any(strange), f"{key}: {_first(strange, actual, expected, place)} is not finite"
    eps = float(np.finfo(dtype).eps)
    # the smallest normal number keeps a magnitude of zero from asking for more than the format can hold
    scale = np.where(compared, magnitude, 0.0) + np.finfo(dtype).tiny / eps
    difference = np.where(compared, np.abs(actual - expected), 0.0)
    tolerances.record(key, dtype, float(np.max(difference / (eps * scale))))
    limit = tolerances.agreement(key, dtype) if against_oracle else tolerances.allowed(key, dtype)
    wrong = ~(difference <= limit * scale)
    if np.any(wrong):
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        units = difference[where] / (eps * scale[where])
        raise AssertionError(
            f"{key}: {_first(wrong, actual, expected, place)}; differs by {difference[where]:.3e} = {units:.3g} units,"
            f" allowed {limit / eps:.3g} units of {eps * scale[where]:.3e};"
            f" {int(np.sum(wrong))} of {int(np.sum(compared))} differ"
        )


def along_rigid_motions(viewmat: Any, v_viewmat: Any, sign: float = -1.0) -> np.ndarray:
    """Return what a gradient by a view matrix says of shifts along the camera's axes and of turns about them. [6]

    Only rigid matrices are view matrices, so these six numbers are all that there is to know. The twelve entries that a
    program gives depend on how it finds the camera's centre: as `-R^T t`, or by inverting the matrix, as gsplat does.

    Args:
        viewmat, v_viewmat: the matrix and its gradient. [4, 4]
        sign: of the second term of a turn; 1 adds bounds up.
    """
    M = v_viewmat[:3] @ viewmat[:3].T
    turns = [M[2, 1] + sign * M[1, 2], M[0, 2] + sign * M[2, 0], M[1, 0] + sign * M[0, 1]]
    return np.concatenate([v_viewmat[:3, 3], turns])


def assert_close_along_rigid_motions(
    key: str, viewmat: Any, actual: Any, expected: Any, error_bound: Any, dtype: Any, where: str = ""
) -> None:
    """Assert that two gradients by a view matrix say the same of every motion of its camera, within error bounds.

    A last row that is not the expected one must be a multiple of the camera's centre (c, 1), as of an inverted matrix.
    """
    slopes = (along_rigid_motions(viewmat, actual), along_rigid_motions(viewmat, expected))
    # a matrix of float32 is rigid to eight digits; in float64 the rest is no motion, and weighs as much as it departs
    departs = np.max(np.abs(viewmat[:3, :3] @ viewmat[:3, :3].T - np.eye(3)))
    departs = departs / tolerances.agreement(key, dtype) if departs > 64.0 * np.finfo(dtype).eps else 0.0
    size = (1.0 + departs) * along_rigid_motions(np.abs(viewmat), error_bound, 1.0)
    assert_close(key, *slopes, size, dtype, True, place=lambda i: f"{where}{MOTIONS[i[0]]}")
    center = np.append(-viewmat[:3, :3].T @ viewmat[:3, 3], 1.0)
    row, reach = actual[3] - expected[3], (1.0 + np.max(np.abs(center))) ** 2
    size = np.full(4, np.sum(error_bound[:3, 3]) * reach)
    assert_close(key, row, row[3] * center, size, dtype, True, place=lambda i: f"{where}last row, entry {list(i)}")


def assert_same_bits(
    what: str, actual: Any, expected: Any, mask: Any = None, place: Callable[[tuple[int, ...]], str] | None = None
) -> None:
    """Assert equality of every entry that the mask keeps; 0.0 and -0.0 are the same value."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, f"{what}: shape {actual.shape}, expected {expected.shape}"
    wrong = ~((actual == expected) | (np.isnan(actual) & np.isnan(expected)))
    if mask is not None:
        wrong &= np.reshape(mask, np.shape(mask) + (1,) * (actual.ndim - np.ndim(mask)))
    assert not np.any(wrong), f"{what}: {_first(wrong, actual, expected, place)}; must be equal exactly"


def _first(wrong: Any, actual: Any, expected: Any, place: Callable[[tuple[int, ...]], str] | None = None) -> str:
    where = tuple(int(i) for i in np.argwhere(wrong)[0])
    at = f"first at {list(where)}" if place is None else place(where)
    return f"{at}: got {actual[where].item()!r}, expected {expected[where].item()!r}"


def with_error_bounds(backend: Any, scene: Scene) -> tuple[Scene, PixelErrorBounds]:
    """Return the scene as the backend reads it, and its error bounds; set aside what its precision cannot resolve."""
    seen = backend.sees(scene)
    if seen.profile.extent == "square":
        # here extents and tile lists are part of the meaning; where rounding decides them, nothing is said
        _set_aside_unless(not extent_near_threshold(seen, backend.dtype))
    error_bounds = error_bounds_of(seen, backend.dtype)
    _set_aside_unless(error_bounds.worst_condition() * error_bounds.reach < WORST_CONDITION)
    return seen, error_bounds


def _set_aside_unless(resolved: bool) -> None:
    """Have Hypothesis draw another scene; one that was written down must be resolved."""
    # not at the top: portable vectors are made and checked without Hypothesis
    from hypothesis import assume, currently_in_test_context

    if currently_in_test_context():
        assume(resolved)
    assert resolved, "rounding decides what is in this scene, which was written down and so should be clear"


def extent_near_threshold(scene: Scene, dtype: Any, decisions: tuple[str, ...] = ("D1", "D2", "D3")) -> bool:
    """Tell whether an extent or a tile rectangle is within reach of rounding."""
    found = margins(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.tile_size, scene.antialiased)
    return not bool(np.all(found.safe_gaussians(64.0 * float(np.finfo(dtype).eps), decisions)))


def assert_same_image(
    key: str,
    backend: Any,
    actual: Any,
    expected: Any,
    error_bounds: PixelErrorBounds,
    against_oracle: bool = False,
    at: Any = None,
) -> None:
    """Assert that two images agree where no decision is near its threshold, within their error bounds."""
    where = error_bounds.unambiguous if at is None else error_bounds.unambiguous & at
    magnitude = error_bounds.image + error_bounds.absolute
    assert_close(key, actual, expected, magnitude, backend.dtype, against_oracle, where)


def assert_same_transmittance(
    key: str, backend: Any, actual: Any, expected: Any, error_bounds: PixelErrorBounds, against_oracle: bool = False
) -> None:
    """Assert that two maps of remaining transmittance agree where no decision is near its threshold."""
    magnitude = error_bounds.T_final + 1.0
    assert_close(key, actual, expected, magnitude, backend.dtype, against_oracle, error_bounds.unambiguous)


def require(backend: Any, offered: dict[str, Any], name: str) -> None:
    """Skip a law, by name, that reads a gradient which the backend does not offer."""
    if name not in offered:
        import pytest

        pytest.skip(f"{backend.name} has no gradient of {name}")


def assert_seen(view: Any) -> None:
    """Assert that the image is not empty: no law may pass on a blank picture."""
    assert np.min(view.T_final) < 1.0, "nothing was blended anywhere; the comparison would say nothing"
