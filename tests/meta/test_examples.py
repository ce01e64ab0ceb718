"""The examples that tests draw are the same on every machine, whatever is installed or imported."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from pop_ref.activations import scales_from_log_scales
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.hypothesis_profiles import EXAMPLES
from pop_ref.conformance.mutants import MUTANTS
from pop_ref.conformance.mutants.copies import living
from pop_ref.conformance.mutants.trial import every_law, law_named, obeys
from pop_ref.conformance.strategies import corners
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.losses import l2

ROOT = Path(__file__).resolve().parents[2]
UNHEARD_OF = (0.1234567, -77123.25, 31.0625)


def drawn(count: int = 400) -> list[float]:
    found: list[float] = []

    @settings(max_examples=count)
    @given(st.floats(-1e6, 1e6))
    def collect(value: float) -> None:
        found.append(value)

    collect()
    return found


def test_the_constants_of_a_local_module_are_not_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = drawn()
    file = tmp_path / "a_local_module.py"
    file.write_text(f"VALUES = {UNHEARD_OF!r}\n")
    spec = importlib.util.spec_from_file_location("a_local_module", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "a_local_module", module)
    spec.loader.exec_module(module)
    after = drawn()
    assert not set(UNHEARD_OF) & set(after)
    assert after == before


@pytest.mark.parametrize("profile", [name for name in EXAMPLES if name != "explore"])
def test_every_profile_but_explore_ignores_seeds_and_what_earlier_runs_kept(profile: str) -> None:
    kept = settings.get_profile(profile)
    assert kept.derandomize
    assert kept.database is None
    assert kept.max_examples == EXAMPLES[profile]


def test_exploring_draws_by_the_seed(tmp_path: Path) -> None:
    test = tmp_path / "test_drawn.py"
    test.write_text(
        "from hypothesis import given, strategies as st\n"
        "from pop_ref.conformance.hypothesis_profiles import load_profile\n"
        "load_profile('explore')\n"
        "@given(st.integers(0, 10**9))\n"
        "def test_it(n):\n"
        "    print('drew', n)\n"
    )

    def under(seed: int) -> list[str]:
        command = [sys.executable, "-m", "pytest", "-s", "-q", f"--hypothesis-seed={seed}", str(test)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        told = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=True)
        return [line for line in told.stdout.splitlines() if "drew" in line]

    one = under(1)
    assert len(one) == EXAMPLES["explore"]
    assert under(1) == one
    assert under(2) != one


# What laws are tried on before anything is drawn: enough to kill what random scenes kill by luck.

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


# The shapes in the oracle's annotations are checked while tests run: the hook came before the modules.


def test_a_wrong_number_of_columns_is_told():
    with pytest.raises(TypeCheckError, match="quats"):
        covars_from_quats_scales(np.zeros((2, 3)), np.ones((2, 3)))


def test_lengths_that_share_a_letter_must_be_equal():
    with pytest.raises(TypeCheckError, match="scales"):
        covars_from_quats_scales(np.ones((2, 4)), np.ones((3, 3)))
    with pytest.raises(TypeCheckError):
        l2(np.zeros((2, 2, 3)), np.zeros((2, 3, 3)))


def test_float32_is_told():
    with pytest.raises(TypeCheckError):
        scales_from_log_scales(np.zeros((1, 3), dtype=np.float32))
