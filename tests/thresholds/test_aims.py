"""The strategies that aim at thresholds hit them, and the two measures of nearness agree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from pop_ref.conformance import threshold_strategies
from pop_ref.conformance.error_bounds import REACH, pixel_error_bounds
from pop_ref.conformance.scenes import Scene, rounded_to
from pop_ref.conformance.strategies import scenes
from pop_ref.margins import Margins, margins

TOLERANCE = REACH * float(np.finfo(np.float32).eps)


def _margins(scene: Scene) -> Margins:
    return margins(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.tile_size, scene.antialiased)


# an ellipse that touches a pixel centre is a question of extent, of tiles and of the floor at once
COUNTED = {"D2": ("D2", "D3", "D5"), "D3": ("D2", "D3", "D5")}
TRIED = settings(max_examples=25, derandomize=True, database=None, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize("label", sorted(threshold_strategies.AIMS))
def test_an_aimed_scene_has_the_doubt_that_it_aims_at(label: str) -> None:
    hits = []

    @TRIED
    @given(scene=threshold_strategies.AIMS[label]())
    def count(scene: Scene) -> None:
        near_threshold = _margins(rounded_to(scene, np.float32)).near_threshold(1e-4)
        hits.append(any(close.decision in COUNTED.get(label, (label,)) for close in near_threshold))

    count()
    assert np.mean(hits) > 0.3, f"only {np.mean(hits):.0%} of the scenes have a {label} decision within rounding"


def _close(found: Margins, label: str, tolerance: float) -> np.ndarray:
    # margins call an opacity under the floor a cull (D2), error bounds a skip (D5)
    return np.logical_or.reduce([found.pixels[d] <= tolerance for d in ((label, "D2") if label == "D5" else (label,))])


@given(scene=scenes(max_gaussians=4))
def test_error_bounds_and_margins_agree_on_what_is_near_a_threshold_in_plain_scenes(scene: Scene) -> None:
    scene = rounded_to(scene, np.float32)
    error_bounds = pixel_error_bounds(scene, np.float32)
    if error_bounds.worst_condition() * error_bounds.reach >= 1.0 / 64.0:
        return
    found = _margins(scene)
    for label in ("D5", "D6", "D7", "D8"):
        unseen = (
            (found.pixels[label] <= TOLERANCE / 8.0) & ~error_bounds.near_threshold[label] & error_bounds.unambiguous
        )
        assert not np.any(unseen), f"{label}: within rounding by margins, unseen by error bounds"
    for label in ("D4", "D5", "D6", "D7"):
        near = error_bounds.near_threshold[label]
        assert np.all(_close(found, label, 8.0 * TOLERANCE)[near]), f"{label}: far from rounding by margins"


@pytest.mark.parametrize("label", ["D5", "D6", "D7", "D8"])
def test_error_bounds_mark_all_that_margins_call_close_in_aimed_scenes(label: str) -> None:
    @TRIED
    @given(scene=threshold_strategies.AIMS[label]().map(lambda s: rounded_to(s, np.float32)))
    def agree(scene: Scene) -> None:
        error_bounds = pixel_error_bounds(scene, np.float32)
        close = _margins(scene).pixels[label] <= TOLERANCE / 8.0
        # an earlier decision may end a pixel in one of the two walks and not in the other
        unseen = close & ~error_bounds.near_threshold[label] & error_bounds.unambiguous
        assert not np.any(unseen), (
            f"{label}: within rounding by margins, unseen by error_bounds, at {np.argwhere(unseen)}"
        )

    agree()
