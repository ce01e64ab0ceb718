"""What laws are tried on before anything is drawn: enough to kill what random scenes kill by luck."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.corners import corners
from pop_ref.conformance.mutants import MUTANTS
from pop_ref.conformance.mutants.copies import living
from pop_ref.conformance.mutants.trial import every_law, law_named, obeys

IMAGE, GRADIENTS = "test_agreement:the_image_is_one_of_the_oracles_outcomes", "test_agreement:gradients_are_the_oracles"
DYING = {
    "sorted_by_distance": IMAGE,
    "gradient_of_unit_quaternions": GRADIENTS,
    "camera_in_world_axes": IMAGE,
}


@pytest.mark.parametrize(("name", "path"), DYING.items())
def test_a_mutant_dies_without_a_drawn_scene(name: str, path: str) -> None:
    (mutant,) = (each for each in MUTANTS if each.name == name)
    with living(mutant) as backend:
        assert obeys(law_named(path), backend, examples=0) is not None


def test_laws_of_rendering_and_gradients_are_tried_on_them_first() -> None:
    laws = [stated for stated in every_law().values() if "scene" in stated.strategies]
    tried = [stated for stated in laws if stated.first]
    assert len(tried) >= 35
    for stated in tried:
        for values in stated.first:
            assert set(values) == set(stated.strategies), stated.name


def test_the_scenes_hold_what_they_are_for() -> None:
    scenes = [values["scene"] for values in corners(3)]
    views = [OracleAdapter().render(scene) for scene in scenes]
    assert all(view.n_blended.max() >= 2 for view in views[1:])
    norms = np.concatenate([np.linalg.norm(scene.gaussians.quats, axis=1) for scene in scenes])
    assert norms.min() < 0.6
    assert norms.max() > 2.0
    assert all(scene.gaussians.sh.shape[1] == 16 for scene in scenes)
    assert all(not np.allclose(scene.camera.viewmat[:3, :3], np.eye(3)) for scene in scenes)
    assert any(scene.camera.width % scene.tile_size for scene in scenes)
    assert any(np.any(view.T_final < 1e-3) for view in views)


def test_depth_is_not_distance_in_the_third_of_them() -> None:
    scene = corners()[2]["scene"]
    p = scene.gaussians.means @ scene.camera.viewmat[:3, :3].T + scene.camera.viewmat[:3, 3]
    assert np.argsort(p[:, 2]).tolist() != np.argsort(np.linalg.norm(p, axis=1)).tolist()
