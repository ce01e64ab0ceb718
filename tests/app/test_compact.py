"""A splat within a budget: which Gaussians go, colours of fewer bands, and tuning that leaves no trace."""

from __future__ import annotations

import json
import re
import typing
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.cli.options import FormatName, Output
from pop_fast.density import shrink
from pop_fast.density.passes import Passes
from pop_fast.errors import PopError
from pop_fast.io.formats import FORMATS, encoded, format_names, levels, load_splat_file
from pop_fast.train import compact
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.views import ViewTensors
from tests.app.clouds import many
from tests.app.conftest import ROOT, TRAIN, Pop
from tests.app.damage import contents
from tests.app.tiny import tiny_capture

MEASURED = ROOT / "benchmarks" / "results" / "budgets.json"


def test_opacity_is_compared_activated_and_a_box_keeps_its_faces() -> None:
    params = many(4)
    params["opacities"] = torch.logit(torch.tensor([0.1, 0.5, 0.049, 0.999]))
    assert shrink.opaque_enough(params, 0.05).tolist() == [True, True, False, True]
    assert shrink.opaque_enough(params, 0.0).all()
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.5, 0.0, 0.0], [0.5, 0.5, -0.25]])
    assert shrink.inside(means, (0, 0, 0, 1, 1, 1)).tolist() == [True, True, False, False]
    with pytest.raises(PopError, match="every lower bound must be under"):
        shrink.inside(means, (0, 0, 1, 1, 1, 0))


@given(scores=st.lists(st.integers(0, 5), max_size=20), count=st.integers(0, 25))
def test_the_best_are_those_that_none_left_out_exceeds(scores: list[int], count: int) -> None:
    values = torch.tensor(scores, dtype=torch.float64)
    kept = shrink.best(values, count)
    assert int(kept.sum()) == min(count, len(scores))
    if kept.any() and not kept.all():
        assert values[kept].min() >= values[~kept].max()


@given(
    scores=st.lists(st.floats(0.0, 10.0, width=32), min_size=1, max_size=40),
    each=st.integers(1, 9),
    most=st.integers(0, 400),
)
def test_a_size_is_kept_and_used(scores: list[float], each: int, most: int) -> None:
    values = torch.tensor(scores, dtype=torch.float64)
    sizes: list[int] = []

    def size_of(kept: torch.Tensor) -> int:
        sizes.append(7 + each * int(kept.sum()))
        return sizes[-1]

    if most < 7:
        with pytest.raises(PopError, match="a file without any Gaussian has 7 bytes"):
            shrink.best_within(values, most, size_of)
        return
    kept = shrink.best_within(values, most, size_of)
    size = 7 + each * int(kept.sum())
    assert size <= most
    assert kept.all() or size + each > most or size >= 0.98 * most
    assert len(sizes) <= 14


def test_the_least_that_make_up_a_share_go_and_so_do_the_unseen() -> None:
    scores = torch.tensor([0.0, 1.0, 100.0, 2.0, 897.0])
    assert shrink.all_but_the_least(scores, 0.0).tolist() == [False, True, True, True, True]
    assert shrink.all_but_the_least(scores, 0.002).tolist() == [False, False, True, False, True]


@pytest.mark.parametrize("score", ["contributions", "dominance", "sensitivity"])
def test_what_no_view_shows_scores_nothing(score: shrink.Score) -> None:
    views = [ViewTensors.of(view) for view in tiny_capture().views]
    params = many(30, 0)
    params["means"][:10] = torch.tensor([1e4, 1e4, 1e4])
    found = shrink.view_scores(score, Passes("fast", views), params, 0)
    assert (found[:10] == 0.0).all()
    assert (found[10:] > 0.0).any()
    assert (found >= 0.0).all()


def test_without_a_view_larger_and_more_opaque_is_more_visible() -> None:
    params = many(3)
    params["scales"] = torch.tensor([[-2.0, -2.0, -9.0], [-3.0, -3.0, -9.0], [-2.0, -2.0, -9.0]])
    params["opacities"] = torch.tensor([0.0, 0.0, -4.0])
    assert int(shrink.visibility(params).argmax()) == 0


# What a budget is spent on: bands of colour, bits, Gaussians.


def tuner_of(result: Path, steps: int, degree: int = 3, bands: float = 0.3, own: bool = False) -> compact.Tuner:
    """Return a tuner of a splat with bands that its run did not open, by photographs or by its own pictures."""
    splat = load_splat(result)
    capture, config = open_capture(splat, CaptureOptions())
    drawn = torch.randn(splat.params["shN"].shape, generator=torch.Generator().manual_seed(0))
    params = {**splat.params, "shN": bands * drawn}
    if own:
        capture, config = compact.with_pictures(capture, params, config, degree)
    return compact.Tuner(params, degree, config, capture, {}, steps, lambda *_: None)


def test_colours_of_a_lower_degree_are_fitted_to_what_the_training_views_show(shared_result: Path) -> None:
    tuner = tuner_of(shared_result, 0)
    assert tuner.lowered(3) is tuner.whole
    before = tuner.psnr(tuner.whole)
    cut = {**tuner.whole, "shN": tuner.whole["shN"][:, :0]}
    assert compact.degree_of(tuner.lowered(0)) == 0
    assert abs(tuner.psnr(tuner.lowered(0)) - before) < abs(tuner.psnr(cut) - before)


@pytest.mark.parametrize("name", format_names())
def test_coarser_levels_are_smaller_and_leave_all_but_view_dependence_as_it_is(name: str) -> None:
    files = [encoded(name, many(400), level=level) for level in range(levels(name))]
    sizes = list(map(len, files))
    assert sizes == sorted(sizes, reverse=True)
    if len(sizes) == 1:
        return
    assert sizes[-1] < sizes[0]
    first, last = (FORMATS[name].decode(file, Path("x")) for file in (files[0], files[-1]))
    for field in ("means", "log_scales", "quats", "logits", "sh0"):
        np.testing.assert_array_equal(getattr(first, field), getattr(last, field))
    assert not np.array_equal(first.rest, last.rest)


@pytest.mark.parametrize("steps", [0, 12])
@pytest.mark.parametrize("name", ["spz", "ply"])
def test_a_budget_is_no_worse_than_fewer_gaussians(shared_result: Path, steps: int, name: str) -> None:
    tuner, output = tuner_of(shared_result, steps), Output(name)
    most = len(output.write(tuner.whole)) // 3

    def rows(kept: torch.Tensor) -> dict[str, torch.Tensor]:
        return {key: value[kept] for key, value in tuner.whole.items()}

    scores = shrink.visibility(tuner.whole)
    fewer = rows(shrink.best_within(scores, most, lambda kept: len(output.write(rows(kept)))))
    found = compact.within(tuner, shrink.visibility, most, output)
    assert len(output.write(found.params, found.level)) <= most
    assert tuner.psnr(output.shown(found.params, found.level)) >= tuner.psnr(output.shown(fewer))


def test_bands_that_show_nothing_are_spent_before_gaussians_and_nothing_where_all_fits(shared_result: Path) -> None:
    tuner, output = tuner_of(shared_result, 0, bands=1e-4, own=True), Output("gltf")
    found = compact.within(tuner, shrink.visibility, len(output.write(tuner.whole)) * 4 // 10, output)
    assert found.degree == 0
    assert len(found.params["means"]) == len(tuner.whole["means"])
    tuner, output = tuner_of(shared_result, 50), Output("spz")
    found = compact.within(tuner, shrink.visibility, len(output.write(tuner.whole)), output)
    assert found.level == 0
    assert all(torch.equal(found.params[key], value) for key, value in tuner.whole.items())


@pytest.mark.parametrize("share", [pytest.param(0.6, marks=pytest.mark.slow), 0.4])
@pytest.mark.parametrize("name", typing.get_args(FormatName))
def test_a_size_is_met_in_every_format_and_the_file_shows_what_was_told(
    pop, shared_result, shared_capture, tmp_path, name, share
):
    suffix = ".html" if name == "html" else FORMATS[name].suffix if name in FORMATS else ".ply"
    file = tmp_path / f"x{suffix}"
    words = ("export", shared_result, "--to", name, "--out", file)
    pop.done(*words)
    # most of a tiny page is its script
    whole, script = file.stat().st_size, 27_000 if name == "html" else 0
    most = script + int(share * (whole - script))
    budget = ("--target-mb", f"{most / 1e6:.6f}", "--fine-tune-steps", "8")
    said = pop.done(*words, "--overwrite", *budget).out
    assert file.stat().st_size <= most
    # with fewer bands all of them may fit, and nothing is left to spend on
    assert file.stat().st_size > 0.7 * most or " 461 of 461 Gaussians" in said
    told = re.search(r"PSNR of the file in 1 held-out view: ([0-9.]+) dB", said)
    assert told is not None, said
    if name != "html":
        pop.done("eval", file, "--capture", shared_capture, "--json", tmp_path / "e.json")
        assert f"{json.loads((tmp_path / 'e.json').read_text())['psnr']:.2f}" == told[1]


@pytest.mark.parametrize("name", ["spz", "sog"])
def test_bits_do_not_depend_on_threads(pop: Pop, result: Path, tmp_path: Path, name: str) -> None:
    before, files = contents(result), [tmp_path / f"{threads}.{name}" for threads in (1, 3)]
    for threads, file in zip((1, 3), files, strict=True):
        torch.set_num_threads(threads)
        pop.done("export", result, "--out", file, "--target-mb", "0.012")
    assert files[0].read_bytes() == files[1].read_bytes()
    assert contents(result) == before


def test_a_number_of_gaussians_is_kept_in_tuning(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    words = ("export", shared_result, "--frame", "training", "--max-gaussians", "60", "--out")
    tuner, found = tuner_of(shared_result, 0, degree=0), []
    for steps in (0, 40):
        pop.done(*words, tmp_path / f"{steps}.ply", "--fine-tune-steps", steps)
        params = load_splat_file(tmp_path / f"{steps}.ply").params
        assert len(params["means"]) == 60
        found.append(tuner.psnr({**params, "shN": params["shN"][:, :0]}))
    assert found[1] > found[0]


def test_what_a_box_leaves_out_is_not_grown_back(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    pop.done("export", shared_result, "--out", tmp_path / "whole.ply")
    means = load_splat_file(tmp_path / "whole.ply").params["means"]
    box = [f"{x:.6f}" for share in (0.1, 0.9) for x in means.quantile(share, dim=0).tolist()]
    words = ("--crop", *box, "--target-mb", "0.006", "--fine-tune-steps", "10")
    said = pop.done("export", shared_result, "--out", tmp_path / "box.spz", *words).out
    # the cropped splat is measured by its own pictures, rounded to bytes
    found = re.search(r"PSNR of the file in 1 held-out view: (\S+) dB, of the whole splat (\S+) dB", said)
    assert found is not None, said
    assert float(found[2]) > 50.0
    assert float(found[1]) > 25.0


def test_what_only_a_checkpoint_knows_is_not_guessed(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    result = tmp_path / "exposed"
    pop.done("train", shared_capture, "--out", result, *TRAIN, "--exposure", "--skip-sizes")
    small = ("--target-mb", "0.006", "--fine-tune-steps", "4", "--overwrite", "--out", tmp_path / "x.spz")
    untuned = "not fine-tuned: only the checkpoints hold what the run learned of its photographs"
    assert untuned not in pop.done("export", result, *small).out
    lone = result / "ply" / "point_cloud_29.ply"
    assert untuned in pop.done("export", lone, "--capture", shared_capture, *small).out


def test_the_measured_budgets_lose_at_most_half_of_what_fewer_gaussians_alone_lose() -> None:
    captures = json.loads(MEASURED.read_text(encoding="utf-8"))["captures"]
    assert len(captures) >= 4
    for found in captures.values():
        for row in found["rows"]:
            before, after = (found["psnr"] - row[kind]["psnr"] for kind in ("fewer", "tuned"))
            assert after <= 0.5 * before
            assert all(row[kind]["bytes"] <= row["bytes"] for kind in ("fewer", "spent", "tuned"))
