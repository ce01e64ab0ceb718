"""What the oracle is remembered to have answered is what it answers, and of the same scene only."""

from __future__ import annotations

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.corners import corners
from pop_ref.conformance.reference import KEPT, LARGEST, Reference, forget, remembered
from pop_ref.conformance.scenes import Scene, cotangents
from pop_ref.conformance.strategies import wide_scene
from pop_ref.constants import GSPLAT_1_6


def test_what_is_remembered_is_the_oracles() -> None:
    for values in corners(3):
        scene, v = values["scene"], cotangents(values["scene"])
        for _ in range(2):
            np.testing.assert_array_equal(Reference().render(scene).image, OracleAdapter().render(scene).image)
            found, expected = Reference().gradients(scene, *v), OracleAdapter().gradients(scene, *v)
            assert set(found) == set(expected)
            for name, value in expected.items():
                np.testing.assert_array_equal(found[name], value)


def test_another_scene_or_question_is_answered_anew() -> None:
    asked = []

    @remembered
    def answer(scene: Scene, *more: object) -> int:
        asked.append(scene)
        return len(asked)

    scene = corners(3)[2]["scene"]
    moved = scene.gaussians.means.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], 9.0)
    viewmat = scene.camera.viewmat.copy()
    viewmat[0, 3] += 2.0**-30
    others = [
        scene.with_overrides(means=moved),
        scene.with_overrides(background=[0.0, 0.0, 0.5]),
        scene.with_overrides(profile=GSPLAT_1_6),
        scene.with_overrides(tile_size=3),
        scene.with_overrides(sh_degree=0),
        scene.with_overrides(antialiased=True),
        scene.with_overrides(width=scene.camera.width + 1),
        scene.with_overrides(viewmat=viewmat),
    ]
    questions = [(scene,), *((other,) for other in others), (scene, np.float32), (scene, np.zeros(2), np.zeros(3))]
    first = [answer(*question) for question in questions]
    assert first == list(range(1, len(questions) + 1))
    assert [answer(*question) for question in questions] == first
    # the same numbers in other arrays are the same question
    assert answer(scene.with_overrides(means=scene.gaussians.means.copy())) == 1


def test_the_oldest_answers_and_large_scenes_are_forgotten() -> None:
    asked = []

    @remembered
    def answer(scene: Scene, number: int) -> None:
        asked.append(number)

    scene = corners(1)[0]["scene"]
    for number in (*range(KEPT + 1), 0):
        answer(scene, number)
    assert asked == [*range(KEPT + 1), 0]
    forget()
    answer(scene, 0)
    assert asked[-2:] == [0, 0]
    many = wide_scene(0)
    times = -(-(LARGEST + 1) // len(many.gaussians))
    large = many.rows(np.tile(np.arange(len(many.gaussians)), times))
    answer(large, -1)
    answer(large, -1)
    assert asked[-2:] == [-1, -1]
