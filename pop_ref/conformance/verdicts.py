"""Comparisons of whole renders, with the charges that rounding may cost and the doubts it may turn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.charges import PixelCharges, charge
from pop_ref.conformance.compare import assert_close
from pop_ref.conformance.scenes import Scene
from pop_ref.margins import margins

# beyond this many units a conic has no digits left to compare: the scene is set aside by a computed number
WORST_CONDITION = 1.0 / 64.0


def charged(backend: Any, scene: Scene) -> tuple[Scene, PixelCharges]:
    """Return the scene as the backend reads it and its charges; set scenes aside that its precision cannot resolve."""
    seen, lists = backend.sees(scene), None
    if seen.profile.extent == "square":
        # here extents and tile lists are part of the meaning; where rounding decides them, nothing is said
        assume(not extent_in_doubt(seen, backend.dtype))
        lists = OracleAdapter().full_render(seen).tile_lists
    charges = charge(seen, backend.dtype, lists)
    assume(charges.worst_condition() * charges.reach < WORST_CONDITION)
    return seen, charges


def extent_in_doubt(scene: Scene, dtype: Any, decisions: tuple[str, ...] = ("D1", "D2", "D3")) -> bool:
    """Tell whether an extent or a tile rectangle is within reach of rounding."""
    found = margins(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.tile_size, scene.antialiased)
    return not bool(np.all(found.safe_gaussians(64.0 * float(np.finfo(dtype).eps), decisions)))


def assert_same_image(
    key: str,
    backend: Any,
    actual: Any,
    expected: Any,
    charges: PixelCharges,
    against_oracle: bool = False,
    at: Any = None,
) -> None:
    """Assert that two images agree where no decision is in doubt, within their charges."""
    where = charges.certain if at is None else charges.certain & at
    magnitude = charges.image + charges.absolute
    assert_close(key, actual[where], expected[where], magnitude[where], backend.dtype, against_oracle)


def assert_same_light(
    key: str, backend: Any, actual: Any, expected: Any, charges: PixelCharges, against_oracle: bool = False
) -> None:
    """Assert that two maps of remaining transmittance agree where no decision is in doubt."""
    where = charges.certain
    magnitude = charges.T_final + 1.0
    assert_close(key, actual[where], expected[where], magnitude[where], backend.dtype, against_oracle)


def require(backend: Any, offered: dict[str, Any], name: str) -> None:
    """Skip a law, by name, that reads a gradient which the backend does not offer."""
    if name not in offered:
        pytest.skip(f"{backend.name} has no gradient of {name}")


def assert_seen(view: Any) -> None:
    """Assert that the image is not empty: no law may pass on a blank picture."""
    assert np.min(view.T_final) < 1.0, "nothing was blended anywhere; the comparison would say nothing"
