"""A splat within a budget: colours of fewer bands, what is chosen by measured loss, and tuning that leaves no trace."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from pop_fast.cli.options import Output
from pop_fast.density import shrink
from pop_fast.errors import PopError
from pop_fast.io.formats import FORMATS, encoded, format_names, levels, load_splat_file
from pop_fast.stages.harmonics import lower_degree
from pop_fast.train import compact
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_ref import harmonics
from tests.app.clouds import many
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents, says

MEASURED = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "budgets.json"


def tuner_of(result: Path, steps: int, degree: int = 3, bands: float = 0.3, own: bool = False) -> compact.Tuner:
    """Return a tuner of a splat with bands that its run did not open, by photographs or by its own pictures."""
    splat = load_splat(result)
    capture, config = open_capture(splat, CaptureOptions())
    drawn = torch.randn(splat.params["shN"].shape, generator=torch.Generator().manual_seed(0))
    params = {**splat.params, "shN": bands * drawn}
    if own:
        capture, config = compact.with_pictures(capture, params, config, degree)
    return compact.Tuner(params, degree, config, capture, {}, steps, lambda *_: None)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_fast_fit_of_a_lower_degree_is_the_oracles(degree: int) -> None:
    rng = np.random.default_rng(3)
    sh, dirs, weights = rng.normal(size=(9, 16, 3)), rng.normal(size=(7, 9, 3)), rng.uniform(0.0, 50.0, size=(7, 9))
    weights[:, 2] = 0.0
    tensors = torch.from_numpy(sh), torch.from_numpy(dirs), torch.from_numpy(weights)
    found = lower_degree(*tensors, degree, uniform=1.5)
    want = harmonics.lower_degree(sh, dirs, weights, degree, uniform=1.5)
    np.testing.assert_allclose(found.numpy(), want, rtol=1e-10, atol=1e-12)


def test_colours_of_a_lower_degree_are_fitted_to_what_the_training_views_show(shared_result: Path) -> None:
    tuner = tuner_of(shared_result, 0)
    assert tuner.lowered(3) is tuner.whole
    before = tuner.psnr(tuner.whole)
    cut = {**tuner.whole, "shN": tuner.whole["shN"][:, :0]}
    assert compact.degree_of(tuner.lowered(0)) == 0
    assert abs(tuner.psnr(tuner.lowered(0)) - before) < abs(tuner.psnr(cut) - before)


@pytest.mark.parametrize("name", format_names())
def test_coarser_levels_are_smaller_and_leave_all_but_view_dependence_as_it_is(name: str) -> None:
    params = many(400)
    sizes = [len(encoded(name, params, level=level)) for level in range(levels(name))]
    assert sizes == sorted(sizes, reverse=True)
    if len(sizes) == 1:
        return
    assert sizes[-1] < sizes[0]
    decode = FORMATS[name].decode
    first, last = (decode(encoded(name, params, level=level), Path("x")) for level in (0, len(sizes) - 1))
    for field in ("means", "log_scales", "quats", "logits", "sh0"):
        np.testing.assert_array_equal(getattr(first, field), getattr(last, field))
    assert not np.array_equal(first.rest, last.rest)


@pytest.mark.parametrize("steps", [0, 12])
@pytest.mark.parametrize("name", ["spz", "ply"])
def test_a_budget_shows_training_views_no_worse_than_fewer_gaussians_alone(
    shared_result: Path, steps: int, name: str
) -> None:
    tuner, output = tuner_of(shared_result, steps), Output(name)
    scores = shrink.visibility(tuner.whole)
    most = len(output.write(tuner.whole)) // 3

    def rows(kept: torch.Tensor) -> dict[str, torch.Tensor]:
        return {key: value[kept] for key, value in tuner.whole.items()}

    fewer = rows(shrink.best_within(scores, most, lambda kept: len(output.write(rows(kept)))))
    found = compact.within(tuner, shrink.visibility, most, output)
    assert len(output.write(found.params, found.level)) <= most
    assert tuner.psnr(output.shown(found.params, found.level)) >= tuner.psnr(output.shown(fewer))


def test_bands_that_show_nothing_are_spent_before_gaussians(shared_result: Path) -> None:
    tuner = tuner_of(shared_result, 0, bands=1e-4, own=True)
    output = Output("gltf")
    most = len(output.write(tuner.whole)) * 4 // 10
    found = compact.within(tuner, shrink.visibility, most, output)
    assert found.degree == 0
    assert len(found.params["means"]) == len(tuner.whole["means"])


def test_a_budget_that_all_of_it_keeps_changes_nothing(shared_result: Path) -> None:
    tuner, output = tuner_of(shared_result, 50), Output("spz")
    found = compact.within(tuner, shrink.visibility, len(output.write(tuner.whole)), output)
    assert found.level == 0
    for key, value in tuner.whole.items():
        assert torch.equal(found.params[key], value)


def test_a_budget_without_room_for_a_gaussian_is_refused(shared_result: Path) -> None:
    with pytest.raises(PopError, match="a file without any Gaussian has"):
        compact.within(tuner_of(shared_result, 4), shrink.visibility, 10, Output("spz"))


@pytest.mark.parametrize("name", ["spz", "sog"])
def test_bits_do_not_depend_on_threads_and_the_result_is_left_as_it_was(
    pop: Pop, result: Path, tmp_path: Path, name: str
) -> None:
    before, files = contents(result), []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        try:
            pop.done("export", result, "--out", tmp_path / f"{threads}.{name}", "--target-mb", "0.012")
        finally:
            torch.set_num_threads(1)
        files.append((tmp_path / f"{threads}.{name}").read_bytes())
    assert files[0] == files[1]
    assert contents(result) == before


def test_a_number_of_gaussians_is_kept_while_what_is_left_is_tuned(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    words = ("export", shared_result, "--frame", "training", "--max-gaussians", "60", "--out")
    pop.done(*words, tmp_path / "plain.ply", "--fine-tune-steps", "0")
    pop.done(*words, tmp_path / "tuned.ply", "--fine-tune-steps", "40")
    plain, tuned = (load_splat_file(tmp_path / f"{name}.ply").params for name in ("plain", "tuned"))
    assert len(plain["means"]) == len(tuned["means"]) == 60
    tuner = tuner_of(shared_result, 0, degree=0)
    drawn = [{**params, "shN": params["shN"][:, :0]} for params in (plain, tuned)]
    assert tuner.psnr(drawn[1]) > tuner.psnr(drawn[0])


def test_what_a_box_leaves_out_is_not_grown_back(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    pop.done("export", shared_result, "--out", tmp_path / "whole.ply")
    means = load_splat_file(tmp_path / "whole.ply").params["means"]
    box = [f"{x:.6f}" for x in (*means.quantile(0.1, dim=0).tolist(), *means.quantile(0.9, dim=0).tolist())]
    words = ("--crop", *box, "--target-mb", "0.006", "--fine-tune-steps", "10")
    said = pop.done("export", shared_result, "--out", tmp_path / "box.spz", *words).out
    # the cropped splat is measured by its own pictures, rounded to bytes
    found = re.search(r"PSNR of the file in 1 held-out views: (\S+) dB, of the whole splat (\S+) dB", said)
    assert found is not None, said
    assert float(found[2]) > 50.0
    assert float(found[1]) > 25.0


def test_what_only_a_checkpoint_knows_of_photographs_is_not_guessed(
    pop: Pop, shared_capture: Path, tmp_path: Path
) -> None:
    result = tmp_path / "exposed"
    pop.done("train", shared_capture, "--out", result, *TRAIN, "--exposure", "--skip-sizes")
    small = ("--target-mb", "0.006", "--fine-tune-steps", "4", "--overwrite", "--out", tmp_path / "x.spz")
    untuned = "not fine-tuned: what the run has learned of its photographs is in its checkpoints alone"
    assert untuned not in pop.done("export", result, *small).out
    lone = result / "ply" / "point_cloud_29.ply"
    assert untuned in pop.done("export", lone, "--capture", shared_capture, *small).out


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("--target-mb", "nan"), "--target-mb nan must be over 0 and finite"),
        (("--target-mb", "inf"), "--target-mb inf must be over 0 and finite"),
        (("--target-mb", "1e-9"), "a file without any Gaussian has"),
        (("--target-mb", "1", "--fine-tune-steps", "-1"), "--fine-tune-steps -1 must be 0 to 30,000"),
        (("--target-mb", "1", "--fine-tune-steps", "30001"), "--fine-tune-steps 30001 must be 0 to 30,000"),
    ],
)
def test_a_budget_that_cannot_be_is_one_line(
    pop: Pop, shared_result: Path, tmp_path: Path, words: tuple[str, ...], part: str
) -> None:
    says(pop("export", shared_result, "--out", tmp_path / "x.spz", *words), part)
    assert list(tmp_path.iterdir()) == []


def test_the_measured_budgets_lose_at_most_half_of_what_fewer_gaussians_alone_lose() -> None:
    captures = json.loads(MEASURED.read_text(encoding="utf-8"))["captures"]
    assert len(captures) >= 4
    for found in captures.values():
        for row in found["rows"]:
            before, after = (found["psnr"] - row[kind]["psnr"] for kind in ("fewer", "tuned"))
            assert after <= 0.5 * before
            assert all(row[kind]["bytes"] <= row["bytes"] for kind in ("fewer", "spent", "tuned"))
