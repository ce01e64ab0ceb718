"""Every backend draws the golden image; the file does not move unless somebody means it to."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref.conformance.adapter import oracle_view
from pop_ref.conformance.assertions import assert_same_bits, assert_same_image, assert_same_transmittance
from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.error_bounds import pixel_error_bounds
from pop_ref.conformance.scenes import golden_scene
from pop_ref.conformance.thresholds import assert_one_of_the_oracles_outcomes
from tests.golden.image import written


def test_the_oracle_draws_what_is_written() -> None:
    # exp differs by a last place between mathematics libraries, so the text is not compared letter by letter
    drawn, golden = oracle_view(golden_scene()), written()
    np.testing.assert_allclose(drawn.image, golden.image, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(drawn.T_final, golden.T_final, rtol=1e-13)
    assert_same_bits("winner", drawn.dominant_ids, golden.dominant_ids)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_backend_draws_what_is_written(name: str) -> None:
    backend, golden = shipped(name), written()
    scene = backend.sees(golden_scene())
    # the file holds the scene in float64; a float32 backend is told its rounding, which these error bounds pay for
    error_bounds = pixel_error_bounds(golden_scene(), backend.dtype)
    view = backend.render(scene)
    assert_same_image("agreement.image", backend, view.image, golden.image, error_bounds, against_oracle=True)
    assert_same_transmittance(
        "agreement.T_final", backend, view.T_final, golden.T_final, error_bounds, against_oracle=True
    )
    assert_same_bits("winner", view.dominant_ids[error_bounds.decided], golden.dominant_ids[error_bounds.decided])
    assert_one_of_the_oracles_outcomes(backend, scene, pixel_error_bounds(scene, backend.dtype))


def test_the_golden_scene_has_every_kind_of_splat() -> None:
    view, scene = oracle_view(golden_scene()), golden_scene()
    assert np.any(view.T_final == 1.0) or np.min(view.n_blended) <= 1, "no pixel that hardly anything reaches"
    assert np.max(view.n_blended) >= 4
    assert np.any(view.n_traversed > view.n_blended), "nothing is skipped"
    assert np.sum(np.all(view.radii == 0, axis=1)) >= 3, "behind, off the screen, under the floor"
    assert np.any(scene.gaussians.opacities == 1.0)
    assert np.any(view.T_final < 1e-2), "no pixel ends early"
