"""Every mutant dies by the law that its entry names, that law holds on the oracle, and the kit's teeth are measured."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_ref.conformance import teeth, tolerances
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.backends import shipped
from pop_ref.conformance.capabilities import STAGES
from pop_ref.conformance.catalogue import FILE, catalogue
from pop_ref.conformance.mutants import BLACK_BOXES, FAMILIES, MUTANTS, PROGRAM, BlackBox
from pop_ref.conformance.mutants.__main__ import main
from pop_ref.conformance.mutants.copies import Mutant
from pop_ref.conformance.mutants.trial import every_law, killed_by, law_named, obeys
from tests.judged import EVERY_PRECISION

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
EVERYONE = (*MUTANTS, *PROGRAM)
# what has two precisions; the oracle has one
OUTSIDE = (*PROGRAM, *BLACK_BOXES)
# each mutant in one of them, turn and turn about
TRIED = [
    (mutant, dtype)
    for k, mutant in enumerate(OUTSIDE)
    for dtype in (mutant.precisions if EVERY_PRECISION else [mutant.precisions[k % 2]])
]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_the_named_law_kills_the_mutant(mutant: Mutant) -> None:
    assert killed_by(mutant) is not None, f"{mutant.name} survives {mutant.law}"


@pytest.mark.slow  # together they are
@pytest.mark.parametrize(("mutant", "dtype"), TRIED, ids=lambda value: getattr(value, "name", value))
def test_the_named_law_kills_the_mutant_in_either_precision(mutant: Mutant | BlackBox, dtype: str) -> None:
    assert killed_by(mutant, dtype) is not None, f"{mutant.name} survives {mutant.law} in {dtype}"


# a law that draws nothing is tried by tests/laws on the same backend with the same arguments
DRAWING = sorted({mutant.law for mutant in OUTSIDE if law_named(mutant.law).strategies})


@pytest.mark.slow  # together they are
@pytest.mark.parametrize("law", DRAWING)
def test_the_program_itself_obeys_what_its_mutants_break(law: str) -> None:
    assert obeys(law_named(law), shipped("fast32")) is None


def test_a_trial_says_who_dies_by_what(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["no_half_in_the_exponent"]) == 0
    assert capsys.readouterr().out.startswith(
        "no_half_in_the_exponent in float64: killed by "
        "test_alpha:the_exponent_is_half_the_squared_distance_in_the_conics_metric (AssertionError: alpha.sigma"
    )
    assert main(["near_plane_ignored"]) == 0
    said = capsys.readouterr().out
    assert "near_plane_ignored in float32: killed by" in said
    assert "near_plane_ignored in float64: killed by" in said
    assert "whole rasterizers: 1 of 1 killed" in said
    with pytest.raises(SystemExit):
        main(["nobody"])
    assert "there is no mutant nobody" in capsys.readouterr().err


class _Soft:
    """A mutant that its law notices in float32 alone."""

    name, law, precisions = "soft", "test_alpha:soft", ("float32", "float64")


def test_a_mutant_that_lives_in_one_precision_is_kept_as_alive(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = importlib.import_module("pop_ref.conformance.mutants.__main__")
    monkeypatch.setattr(command, "FAMILIES", {"soft ones": (_Soft,)})
    monkeypatch.setattr(command, "killed_by", lambda mutant, dtype: "broken" if dtype == "float32" else None)
    assert main(["--json", str(tmp_path / "kills.json")]) == 1
    assert capsys.readouterr().out.endswith("soft ones: 0 of 1 killed\n")
    assert json.loads((tmp_path / "kills.json").read_text()) == {
        "soft ones": {"soft": {"float32": "broken", "float64": None}}
    }


def test_named_mutants_alone_are_kept_anew_and_those_that_are_gone_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class New(_Soft):
        name = "new"

    command = importlib.import_module("pop_ref.conformance.mutants.__main__")
    monkeypatch.setattr(command, "FAMILIES", {"soft ones": (New, _Soft)})
    monkeypatch.setattr(command, "killed_by", lambda mutant, dtype: f"{mutant.name} broken")
    file, before = tmp_path / "kills.json", {"float32": "as it was", "float64": "as it was"}
    file.write_text(json.dumps({"soft ones": {"gone": before, "soft": before}}))
    assert main(["new", "--json", str(file)]) == 0
    kept = json.loads(file.read_text())
    assert kept == {"soft ones": {"new": dict.fromkeys(New.precisions, "new broken"), "soft": before}}
    assert list(kept["soft ones"]) == ["new", "soft"]


def test_what_is_published_of_kills_is_of_todays_mutants_in_every_precision_that_they_have() -> None:
    kept = json.loads((RESULTS / "kills.json").read_text(encoding="utf-8"))
    for family, mutants in FAMILIES.items():
        tried = {name: set(of) for name, of in kept[family].items()}
        assert tried == {mutant.name: set(mutant.precisions) for mutant in mutants}, "run 'make kit'"


def test_there_are_at_least_twenty_mutants_and_no_two_alike() -> None:
    assert len(MUTANTS) >= 20
    everyone = (*EVERYONE, *BLACK_BOXES)
    assert len({mutant.name for mutant in everyone}) == len(everyone)
    assert len({mutant.law for mutant in BLACK_BOXES}) >= 8
    assert len({(mutant.package, mutant.file, mutant.new) for mutant in EVERYONE}) == len(EVERYONE)


def test_each_change_is_one_place_of_one_file() -> None:
    for mutant in EVERYONE:
        assert mutant.broken_source()
        assert law_named(mutant.law).name == mutant.law.partition(":")[2]


def test_the_written_list_of_laws_is_current() -> None:
    assert FILE.read_text(encoding="utf-8") == catalogue(), "run 'python -m pop_ref.conformance.catalogue'"


def test_every_law_has_a_stage_of_its_own_and_a_sentence_for_a_name() -> None:
    laws = every_law()
    assert len({stated.name for stated in laws.values()}) == len(laws), "two laws have one name"
    for path, stated in laws.items():
        assert "_" in stated.name, f"{path} is not a sentence"
        assert stated.name == stated.name.lower(), f"{path} shouts"
    assert {stated.stage for stated in laws.values()} == set(STAGES)


KEPT = json.loads((RESULTS / "teeth.json").read_text(encoding="utf-8"))
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
