"""A result survives its file, and a damaged file is told by its name and the name of the field."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paper_repro.results import RESULTS, SCALES, read, read_all, write
from pop_fast.errors import PopError
from tests.repro.made import PLAIN, curve, result


def test_a_result_is_read_as_it_was_written(tmp_path: Path) -> None:
    steps = curve({0: 1000, 100: 1100}, psnr=[None, 20.5], n_blended=[None, 3.5])
    told = result(curve=steps, lpips={"vgg_01": 0.2, "alex_norm": None, "alex_01": None})
    path = write(told, tmp_path)
    assert path == tmp_path / "small" / "pop" / "fox_42.json"
    assert read(path) == told
    assert path.read_text(encoding="utf-8").count("\n") == 2 + 29 + 3  # braces, fields and schema, points of the curve


def test_results_of_one_scale_are_found_in_order(tmp_path: Path) -> None:
    told = [result("pop", "fox", 43), result("l2", "fox"), result("pop", "bonsai_800"), result("pop", "fox", 7)]
    for one in (*told, replace(PLAIN, scale="toy")):
        write(one, tmp_path)
    assert read_all("small", tmp_path) == (told[1], told[2], told[3], told[0])
    assert read_all("full", tmp_path) == ()
    with pytest.raises(PopError, match="scale is 'big'; it must be one of toy, small, no_floor, full, paper"):
        read_all("big", tmp_path)


def _set(field: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(found: dict[str, Any]) -> None:
        *outer, last = field.split("/")
        for name in outer:
            found = found[int(name) if isinstance(found, list) else name]
        found[last] = value

    return change


def _drop(field: str) -> Callable[[dict[str, Any]], None]:
    return lambda found: found.pop(field)


DAMAGE = [
    (_set("schema", 2), "schema must be 1"),
    (_drop("psnr"), "psnr is absent"),
    (_set("psnrr", 1.0), "psnrr is not a field of a result"),
    (_set("psnr", "30"), 'psnr is "30"; it must be a finite number'),
    (_set("psnr", float("nan")), "psnr is NaN; it must be a finite number"),
    (_set("num_gaussians", 3.5), "num_gaussians is 3.5; it must be a whole number"),
    (_set("num_gaussians", True), "num_gaussians is true"),
    (_set("num_gaussians", 999), "opacity_histogram .* whose sum is num_gaussians, 999"),
    (_set("scale", "huge"), 'scale is "huge"; it must be one of'),
    (_set("row", "POP Ours"), "row is .*lower-case"),
    (_set("run", "12345"), "run is .*twelve hex digits"),
    (_set("commit", "main"), "commit is .*a git commit or null"),
    (_set("protocol/width", 0), "protocol: width is 0; it must be a whole number of at least 1"),
    (_set("protocol/base", "pup"), 'protocol: base is "pup"; it must be twelve hex digits'),
    (_set("protocol/extra", 0), "protocol: extra is not a field"),
    (_set("seconds/train", -1.0), "seconds: train is -1.0"),
    (_set("seconds/cpu", -1.0), "seconds: cpu is -1.0"),
    (_set("lpips/vgg_01", "none"), "lpips: vgg_01"),
    (_set("lpips_reason", None), "lpips_reason is null; it must be a text, since a variant"),
    (_set("opacity_below_0.1", 1.5), "opacity_below_0.1 is 1.5; it must be a finite number from 0 to 1"),
    (_set("curve/1/step", 0), r"curve\[1\]: step is 0; it must be a whole number of at least 1"),
    (_set("curve/1/psnr", "x"), r"curve\[1\]: psnr is .*a finite number or null"),
    (_set("curve", [{"step": 0}]), r"curve\[0\]: num_gaussians is absent"),
    (_set("per_view/a.png", {"psnr": 30.0}), "per_view: a.png: ssim is absent"),
    (_set("seed", 43), "its place is small/pop/fox_43.json"),
]


@pytest.mark.parametrize(("change", "message"), DAMAGE, ids=[message[:30] for _, message in DAMAGE])
def test_a_damaged_result_is_told_by_file_and_field(
    change: Callable[[dict[str, Any]], None], message: str, tmp_path: Path
) -> None:
    path = write(result(curve=curve({0: 1000, 100: 1100}, psnr=[None, 20.5])), tmp_path)
    found = json.loads(path.read_text(encoding="utf-8"))
    change(found)
    path.write_text(json.dumps(found), encoding="utf-8")
    with pytest.raises(PopError, match=message) as error:
        read(path)
    assert str(path) in str(error.value)


def test_a_file_that_is_no_result_is_told_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with pytest.raises(PopError, match=r"a\.json: cannot be read"):
        read(path)
    path.write_text("{", encoding="utf-8")
    with pytest.raises(PopError, match=r"a\.json: is not JSON"):
        read(path)
    path.write_text("[]", encoding="utf-8")
    with pytest.raises(PopError, match=r"a\.json: is list, not an object"):
        read(path)


def test_what_cannot_be_read_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(PopError, match="psnr"):
        write(replace(PLAIN, psnr=float("inf")), tmp_path)
    assert not list(tmp_path.rglob("*.json"))


def test_a_curve_is_read_between_its_points() -> None:
    told = result(curve=curve({0: 100, 100: 200, 300: 400}, psnr=[None, 20.0, 22.0]))
    assert told.at(50) == 150.0
    assert told.at(300) == 400.0
    assert told.at(200, "psnr") == 21.0
    assert told.at(50, "psnr") is None
    assert told.at(301) is None


@pytest.mark.parametrize("scale", SCALES)
def test_every_committed_result_can_be_read(scale: str) -> None:
    found = read_all(scale, RESULTS)
    assert len(found) == len(list((RESULTS / scale).rglob("*.json")))
    assert len({(r.row, r.scene, r.seed) for r in found}) == len(found)
