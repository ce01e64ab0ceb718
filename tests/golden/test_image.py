"""The golden image, one 16 x 16 scene as the oracle draws it, as text: every backend draws what is written.

The file does not move unless somebody means it to; run as a module, this prints it again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pop_ref.conformance.adapter import View, oracle_view
from pop_ref.conformance.assertions import assert_same_bits, assert_same_image, assert_same_transmittance
from pop_ref.conformance.backends import SHIPPED, shipped
from pop_ref.conformance.error_bounds import pixel_error_bounds
from pop_ref.conformance.scenes import golden_scene
from pop_ref.conformance.thresholds import assert_one_of_the_oracles_outcomes

FILE = Path(__file__).with_name("image.txt")
HEADER = "# column row: red green blue, light left, Gaussian that dominates; made by python -m tests.golden.test_image"


def as_text(view: View) -> str:
    """Write a render, a pixel a line."""
    H, W = view.T_final.shape
    lines = [HEADER]
    for y in range(H):
        for x in range(W):
            numbers = [*view.image[y, x].tolist(), float(view.T_final[y, x])]
            lines.append(f"{x} {y}: {' '.join(repr(n) for n in numbers)} {int(view.dominant_ids[y, x])}")
    return "\n".join(lines) + "\n"


def written() -> View:
    """Read the file."""
    rows = [line.replace(":", "").split() for line in FILE.read_text(encoding="utf-8").splitlines()[1:]]
    camera = golden_scene().camera
    values = np.zeros((camera.height, camera.width, 5))
    for x, y, *row in rows:
        values[int(y), int(x)] = [float(number) for number in row]
    return View(values[..., :3], values[..., 3], values[..., 4].astype(np.int64))


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


if __name__ == "__main__":
    print(as_text(oracle_view(golden_scene())), end="")
