"""What is written about the kit's teeth is what it measures, and a law notices what they say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_ref.conformance import teeth, tolerances
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.mutants.trial import law_named, obeys

KEPT = json.loads((Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "teeth.json").read_text())
IMAGE, GRADIENTS = "test_agreement:the_image_is_one_of_the_oracles_outcomes", "test_agreement:gradients_are_the_oracles"


@pytest.mark.parametrize("name", ["float32", "float64"])
def test_what_is_kept_is_what_is_measured(name: str) -> None:
    dtype = getattr(np, name)
    again = {**teeth.image_teeth(dtype), **teeth.gradient_teeth(dtype)}
    assert set(again) == set(KEPT[name]["teeth"])
    for quantity, least in again.items():
        assert least == pytest.approx(KEPT[name]["teeth"][quantity], rel=0.06)


@pytest.mark.parametrize("key", [key for key in tolerances.TABLE if key.startswith(("agreement.", "scale."))])
def test_double_precision_is_judged_to_a_trillionth_and_to_a_few_roundings(key: str) -> None:
    limit = tolerances.agreement(key, np.float64)
    assert limit <= 1e-12
    assert limit <= 64.0 * tolerances.TABLE[key].units * np.finfo(np.float64).eps


def test_sound_backends_need_little_of_what_is_allowed() -> None:
    for kept in KEPT.values():
        assert kept["sound"]
        assert max(kept["sound"].values()) < 0.25


class _Off(OracleAdapter):
    """The oracle with a background, and a gradient of the quaternions, that are wrong by a share."""

    background = 0.0
    quats = 0.0

    def render(self, scene: Any) -> Any:
        return super().render(scene.with_overrides(background=scene.background + self.background))

    def gradients(self, scene: Any, v_image: Any, v_T_final: Any) -> Any:
        found = super().gradients(scene, v_image, v_T_final)
        return {**found, "quats": found["quats"] * (1.0 + self.quats)}


@pytest.mark.parametrize(
    ("quantity", "what", "path"), [("background",) * 2 + (IMAGE,), ("v_quats", "quats", GRADIENTS)]
)
def test_a_law_notices_twice_the_tooth_and_not_half_of_it(quantity: str, what: str, path: str) -> None:
    least = KEPT["float64"]["teeth"][quantity]
    off = _Off()
    setattr(off, what, 2.0 * least)
    assert obeys(law_named(path), off, examples=0) is not None
    setattr(off, what, 0.5 * least)
    assert obeys(law_named(path), off, examples=0) is None
