"""The loop: it learns, it keeps to its schedule, it writes what it says it writes, and it refuses what it must."""

from __future__ import annotations

import io
import json
import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.api.backends import FAST
from pop_fast.data import Capture, View
from pop_fast.data.gaussians import initialize_params
from pop_fast.errors import PopError
from pop_fast.io import heartbeat
from pop_fast.io.heartbeat import Heartbeat, bars, duration
from pop_fast.io.ply import load_ply
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.automatic import about_held_out
from pop_fast.train.evaluate import average, measure, population, psnr
from pop_fast.train.model import KEYS, adam_step, first_non_finite, make_optimizers
from pop_fast.train.schedule import steady_updates
from pop_fast.train.torch_stepper import PhotoLoss
from pop_fast.train.views import ViewTensors
from pop_ref.settings import Objective
from tests.app.captures import assert_one_line, cloud, photograph, ring
from tests.app.conftest import TRAIN, TRAIN_AND_CHECK, wait_until
from tests.app.tiny import HEIGHT, WIDTH, records, tiny_capture, tiny_config


@pytest.fixture(scope="module", params=["pop", "gsplat", "3dgs"])
def finished(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / request.param
    config = tiny_config(folder, method=request.param)
    trainer = TrainingRun(config, tiny_capture())
    stats = trainer.run()
    return trainer, stats, folder


def test_what_a_run_starts_from_stays_the_callers(tmp_path):
    given = initialize_params(tiny_capture(), 1)
    before = {key: value.clone() for key, value in given.items()}
    run = TrainingRun(tiny_config(tmp_path), tiny_capture(), initial=given)
    run.take_steps(2)
    assert all(torch.equal(given[key], before[key]) for key in KEYS)
    assert not torch.equal(run.params["means"], before["means"])


def test_the_number_of_gaussians_changes_when_the_schedule_says_and_adds_up(finished):
    trainer, stats, folder = finished
    changed = [record for record in records(folder) if "cloned" in record]
    changes = [record["step"] for record in changed if not record.get("reset") or record["step"] % 4 == 0]
    assert changes == [4, 8, 12, 16, 20]
    resets = [record["step"] for record in changed if record.get("reset")]
    assert resets == ([] if trainer.config.method == "pop" else [12])
    assert sum(record["cloned"] + record["split"] for record in changed) > 0
    n = len(tiny_capture().points)
    for record in records(folder):
        n += record.get("cloned", 0) + record.get("split", 0) - record.get("pruned", 0)
        assert record["num_gaussians"] == n
    assert stats["num_GS"] == n


def test_a_record_is_written_every_other_step_and_its_loss_is_the_sum_of_its_terms(finished):
    trainer, _, folder = finished
    pop, weight = trainer.config.method == "pop", trainer.config.objective_at(0).lambda_ssim
    assert [record["step"] for record in records(folder)] == list(range(0, 30, 2))
    assert [record["step"] for record in records(folder) if "pop" in record] == (list(range(0, 24, 2)) if pop else [])
    needed = {"view", "n_blended", "n_traversed", "sh_degree", "lr_means", "it_per_s", "seconds", "num_gaussians"}
    for record in records(folder):
        assert needed <= set(record)
        pixelwise = record["l2" if pop else "l1"]
        total = (1 - weight) * pixelwise + weight * record["d_ssim"] + record.get("pop", 0.0)
        assert record["loss"] == pytest.approx(total, rel=1e-5)


def test_the_folder_holds_what_its_docstring_lists(finished):
    trainer, _, folder = finished
    # the end of the blur rule, where the method has one
    histograms = (-1, 15, 29) if trainer.config.method == "pop" else (-1, 29)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert names == {
        "cfg.json",
        "metrics.jsonl",
        *(f"ckpts/ckpt_{step}_rank0.pt" for step in (11, 24, 29)),
        *(f"ply/point_cloud_{step}.ply" for step in (11, 29)),
        *(f"stats/{kind}_step{step:04d}.json" for kind in ("train", "val") for step in (11, 29)),
        "renders/val_step29_0000.png",
        "renders/dominant_step29_0000.png",
        "report_data/val_step29_0000.npz",
        *(f"report_data/opacity_step{step}.npz" for step in histograms),
    }


def test_statistics_are_complete(finished):
    trainer, stats, folder = finished
    assert json.loads((folder / "stats" / "val_step0029.json").read_text()) == stats
    assert stats["num_GS"] == len(trainer.params["means"]) >= stats["num_GS_above_floor"]
    assert 0.0 <= stats["opacity_below_0.1"] + stats["opacity_above_0.9"] <= 1.0
    assert stats["psnr"] > 5.0
    assert 0.0 < stats["ssim"] < 1.0
    assert stats["lpips"] is None
    assert "no weights" in stats["lpips_reason"]
    assert stats["seconds_total"] > stats["seconds"] > 0.0
    assert stats["memory_bytes"] > 2**20
    assert stats["n_traversed"] >= stats["n_blended"] > 0.0
    assert stats["versions"]["torch"] == torch.__version__
    assert list(stats["per_view"]) == ["00.png"]


def test_the_ply_the_pictures_and_the_checkpoint_are_of_the_last_parameters(finished):
    trainer, _, folder = finished
    loaded = load_ply(folder / "ply" / "point_cloud_29.ply")
    # as gsplat reads it
    content = torch.load(folder / "ckpts" / "ckpt_29_rank0.pt", weights_only=True)
    assert content["step"] == 29
    assert list(content["splats"]) == list(KEYS)
    for key in KEYS:
        assert torch.equal(loaded[key], trainer.params[key].detach())
        assert torch.equal(content["splats"][key], trainer.params[key])
    with np.load(folder / "report_data" / "val_step29_0000.npz") as arrays:
        assert arrays["render"].shape == arrays["photo"].shape == (HEIGHT, WIDTH, 3)
        assert -1 <= arrays["dominant_ids"].min() <= arrays["dominant_ids"].max() < len(trainer.params["means"])


def test_the_same_seed_gives_the_same_bits_and_another_does_not(finished, tmp_path):
    trainer, _, _ = finished
    same = TrainingRun(replace(trainer.config, result_dir=str(tmp_path / "a")), tiny_capture())
    same.run()
    assert all(torch.equal(same.params[key], trainer.params[key]) for key in KEYS)
    other = TrainingRun(replace(trainer.config, result_dir=str(tmp_path / "b"), seed=8), tiny_capture())
    other.run()
    assert not torch.equal(other.params["quats"], trainer.params["quats"])


def test_skipping_the_idle_colour_bands_is_bit_identical_to_dense_adam():
    g = torch.Generator().manual_seed(0)
    start = torch.randn(50, 15, 3, generator=g)
    start[0] = -0.0
    results = []
    for skips in (False, True):
        g.manual_seed(1)
        params = {key: torch.nn.Parameter(start.clone()) for key in KEYS}
        optimizers, updates = make_optimizers(params), steady_updates(dict.fromkeys(KEYS, 0.01), 40)
        param = params["shN"]
        for step in range(40):
            zero = None if skips else torch.zeros_like(param)
            param.grad = zero if step < 20 else torch.randn(param.shape, generator=g)
            adam_step(params, optimizers, updates, step, {})
        state = optimizers["shN"].state[param]
        results.append((param.detach(), state["exp_avg"], state["exp_avg_sq"], state["step"]))
    for dense, skipped in zip(*results, strict=True):
        assert torch.equal(dense, skipped)
        assert torch.equal(torch.signbit(dense), torch.signbit(skipped))


def test_the_target_cache_changes_no_bit(tmp_path):
    views = [ViewTensors.of(view) for view in tiny_capture().views]
    image = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    losses = []
    for megabytes in (0, 1):
        config = tiny_config(tmp_path, target_cache_mb=megabytes)
        objective = PhotoLoss(config, views, FAST.losses())
        losses.append([objective(image, i, Objective()) for i in (0, 1, 0)])
        assert len(objective._kept) == (2 if megabytes else 0)
    assert losses[0] == losses[1]


def test_a_folder_is_not_touched_without_leave(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for kind in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(PopError, match=r"choose another|another result folder"):
            TrainingRun(tiny_config(tmp_path), tiny_capture(), **kind).run()
    with pytest.raises(PopError, match="is a file"):
        TrainingRun(tiny_config(tmp_path / "notes.txt"), tiny_capture()).run()
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    folder = tmp_path / "run"
    TrainingRun(tiny_config(folder, max_steps=2), tiny_capture()).run()
    with pytest.raises(PopError, match="--resume, --overwrite"):
        TrainingRun(tiny_config(folder, max_steps=4), tiny_capture()).run()


@pytest.mark.parametrize("key", ["means", "opacities", "shN"])
def test_a_number_that_is_not_finite_is_named_and_the_last_checkpoint_kept(tmp_path, key):
    trainer = TrainingRun(tiny_config(tmp_path), tiny_capture())
    take_steps = trainer.take_steps

    def poisoned(last):
        done = take_steps(last)
        if trainer.step == 8:
            trainer.params[key].data[5] = float("nan")
        return done

    trainer.take_steps = poisoned
    with pytest.raises(PopError, match=rf"{key}\[5.*\] is nan after (8|9|10) steps; the latest checkpoint is kept"):
        trainer.run()
    assert [path.name for path in (tmp_path / "ckpts").iterdir()] == ["ckpt_4_rank0.pt"]


def test_the_first_entry_that_is_not_finite_is_found():
    good = {"a": torch.ones(3), "b": torch.full((2, 2), 3e38)}
    assert first_non_finite(good) is None
    bad = {**good, "c": torch.tensor([[0.0, 1.0], [float("-inf"), 2.0]])}
    assert first_non_finite(bad) == ("c", [1, 0], float("-inf"))


# The first Gaussians: one a point, as large as its neighbourhood.


def some_capture(points: np.ndarray, rgb: np.ndarray | None = None) -> Capture:
    views = tuple(View(f"{i}.png", photograph(i), viewmat, np.eye(3)) for i, viewmat in enumerate(ring(3)))
    colors = np.zeros((len(points), 3), np.uint8) if rgb is None else rgb
    return Capture("scene", views, np.asarray(points, np.float64), colors, "test")


def test_sizes_are_the_root_mean_square_distance_to_the_three_nearest_neighbours() -> None:
    points, rgb = cloud(30)
    params = initialize_params(some_capture(points, rgb), dtype=torch.float64)
    for i, point in enumerate(points):
        nearest = np.sort(np.linalg.norm(points - point, axis=1))[1:4]
        want = math.log(math.sqrt(np.mean(nearest**2)))
        assert params["scales"][i].tolist() == pytest.approx([want] * 3, rel=1e-12)
    wider = initialize_params(some_capture(points, rgb), init_scale=2.0, dtype=torch.float64)
    assert torch.allclose(wider["scales"], params["scales"] + math.log(2.0))


def test_colours_places_and_opacities_are_those_of_the_points_and_rotations_are_drawn() -> None:
    points, rgb = cloud(10)
    params = initialize_params(some_capture(points, rgb), init_opacity=0.25)
    shapes = [(10, 3), (10, 3), (10, 4), (10,), (10, 1, 3), (10, 15, 3)]
    assert {name: tuple(value.shape) for name, value in params.items()} == dict(zip(KEYS, shapes, strict=True))
    assert all(value.dtype == torch.float32 for value in params.values())
    assert np.allclose(params["means"].numpy(), points, atol=1e-6)
    assert torch.allclose(torch.sigmoid(params["opacities"]), torch.tensor(0.25))
    shown = 0.5 + 0.28209479177387814 * params["sh0"][:, 0]
    assert np.allclose(shown.numpy() * 255.0, rgb, atol=1e-3)
    assert not params["shN"].any()
    # rotations are uniform in the unit cube and follow the seed
    capture = some_capture(cloud(2000)[0])
    first, again, other = (initialize_params(capture, seed)["quats"] for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.min() >= 0.0
    assert first.max() < 1.0
    assert torch.allclose(first.mean(dim=0), torch.tensor(0.5), atol=0.03)


def test_points_that_coincide_and_few_points_get_a_finite_size() -> None:
    same = some_capture(np.zeros((5, 3)))
    floor = math.log(math.sqrt(1e-7) * same.scene_scale())
    for capture in (same, some_capture(np.zeros((1, 3)))):
        found = initialize_params(capture)["scales"].flatten().tolist()
        assert found == pytest.approx([floor] * (3 * len(capture.points)), rel=1e-6)
    # fewer than four use the neighbours there are
    params = initialize_params(some_capture(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])), dtype=torch.float64)
    assert params["scales"].exp().flatten().tolist() == pytest.approx([2.0] * 6)


def test_a_capture_without_points_or_views_and_an_impossible_opacity_are_refused(tmp_path) -> None:
    capture = some_capture(cloud(4)[0])
    empty = replace(capture, points=np.zeros((0, 3)), points_rgb=np.zeros((0, 3), np.uint8))
    assert_one_line(lambda: initialize_params(empty), "scene", "no points")
    assert_one_line(lambda: initialize_params(capture, init_opacity=1.0), "init_opacity", "between 0 and 1")
    all_held_out = tiny_config(tmp_path, test_every=1)
    assert_one_line(lambda: TrainingRun(all_held_out, tiny_capture()), "no view to train on", "use 8, or 0")
    # the capture's own lists go before test_every, and that is said
    views = [replace(view, split="test") for view in tiny_capture().views]
    own = replace(tiny_capture(), views=tuple(views))
    assert_one_line(lambda: TrainingRun(tiny_config(tmp_path), own), "no view to train on", "its own lists")
    given = TrainConfig.of(test_every=0)
    assert "5 of 5 photographs; --test-every 0 changes nothing" in str(about_held_out(own, given))
    assert about_held_out(own, tiny_config(tmp_path)) is None


# What is measured: PSNR, SSIM, counts of the Gaussians, and averages.


def pictures(seed=0, height=40, width=30):
    g = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=g)
    return (target + 0.2 * torch.randn(height, width, 3, generator=g)), target


def test_psnr_and_ssim_are_scikit_images_on_the_clamped_render_and_ssim_over_whole_windows():
    # here, since it takes seconds to import and every worker imports every module
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    image, target = pictures()
    given = (target.double().numpy(), image.clamp(0, 1).double().numpy())
    assert psnr(image, target) == pytest.approx(peak_signal_noise_ratio(*given, data_range=1.0), rel=1e-6)
    windows = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    _, full = structural_similarity(*given, data_range=1.0, channel_axis=2, full=True, **windows)
    assert measure(image, target).ssim == pytest.approx(full[5:-5, 5:-5].mean(), rel=1e-5)
    white = torch.ones(4, 4, 3)
    assert (psnr(white, white), psnr(torch.zeros(4, 4, 3), white)) == (math.inf, 0.0)


def test_masked_pixels_do_not_count_and_averages_are_over_views():
    image, target = pictures()
    mask = torch.ones(40, 30, dtype=torch.bool)
    mask[:, 20:] = False
    spoiled = image.clone()
    spoiled[:, 20:] = 1.0 - target[:, 20:].round()
    assert measure(spoiled, target, mask) == measure(image, target, mask)
    assert measure(spoiled, target, mask).psnr == pytest.approx(psnr(image[:, :20], target[:, :20]), rel=1e-6)
    # averages are over views, and no view gives null
    measured = [measure(*pictures(seed)) for seed in (0, 1)]
    means = average(measured, [])
    assert means["psnr"] == pytest.approx(np.mean([m.psnr for m in measured]))
    assert means["lpips"] is None
    assert "lpips_vgg" in means["lpips_reason"]
    assert average([], [])["psnr"] is None


def test_the_population_is_counted_at_both_poles_and_at_the_floor():
    counts = population(torch.tensor([0.0, 1 / 255 - 1e-6, 1 / 255, 0.1, 0.5, 0.9, 0.95, 1.0]))
    assert counts == {"num_GS": 8, "num_GS_above_floor": 6, "opacity_below_0.1": 3 / 8, "opacity_above_0.9": 2 / 8}
    assert population(torch.zeros(0))["num_GS"] == 0


# Where nobody sees a bar, what is being done is told line by line.


def wait_for_a_line(capsys: pytest.CaptureFixture[str]) -> str:
    return wait_until(lambda: capsys.readouterr().err).splitlines()[0]


def test_a_line_comes_by_itself_from_within_a_long_computation(capsys: pytest.CaptureFixture[str]) -> None:
    with Heartbeat(period=0.01) as beat:
        beat.say("finding cameras: 3 of 25")
        assert wait_for_a_line(capsys) == "pop: finding cameras: 3 of 25 (0 s)"
    capsys.readouterr()
    time.sleep(0.05)
    assert capsys.readouterr().err == ""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_stages_that_report_are_told_with_the_time_that_is_left(capsys, monkeypatch):
    monkeypatch.setattr(heartbeat, "PERIOD", 0.01)
    with bars() as report:
        report("matching photographs", 64, 1225)
        assert wait_for_a_line(capsys).startswith("pop: matching photographs: 64 of 1,225 (")
    clock = [100.0]
    monkeypatch.setattr(heartbeat.time, "monotonic", lambda: clock[0])
    with bars() as report:
        report("matching pairs of photographs", 0, 300)
        clock[0] += 60.0
        report("matching pairs of photographs", 100, 300)
        told = wait_until(lambda: told if " left" in (told := capsys.readouterr().err) else "")
    assert "pop: matching pairs of photographs: 100 of 300, 2 min 0 s left (" in told


def test_a_training_whose_steps_are_all_taken_says_what_it_does_then() -> None:
    left = "step 100 of 400, 50 Gaussians, 5.0 steps a second, 1 min 0 s left"
    assert heartbeat.so_far(100, 400, 50, 5.0, "") == left
    done = "step 400 of 400, 50 Gaussians, PSNR 21.00, measuring and writing"
    assert heartbeat.so_far(400, 400, 50, 5.0, ", PSNR 21.00") == done


def test_the_time_that_is_left_follows_from_the_latest_steps() -> None:
    # continued at step 1,000, 100 s into the training; fast at first, then four steps a second
    pace = heartbeat.Pace(1000, 100.0)
    found = [pace.steps_a_second(step, seconds) for step, seconds in ((1010, 101.0), (1200, 120.0), (1320, 150.0))]
    assert found == [10.0, 10.0, 4.0]
    assert [pace.steps_a_second(1320 + 4 * k, 150.0 + k) for k in range(1, 31)] == [4.0] * 30


@pytest.mark.parametrize("quiet", [True, False])
def test_a_terminal_and_a_quiet_run_are_told_nothing(monkeypatch: pytest.MonkeyPatch, quiet: bool) -> None:
    stream = io.StringIO() if quiet else Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    with Heartbeat(show=not quiet, period=0.001) as beat:
        beat.say("reading")
        time.sleep(0.05)
    assert stream.getvalue() == ""


def test_bars_of_long_stages_and_of_steps_that_take_long_are_drawn_anew_in_a_terminal(
    pop, shared_capture, tmp_path, monkeypatch
):
    monkeypatch.setattr("sys.stderr", stream := Terminal())
    monkeypatch.setattr(heartbeat, "TICK", 0.01)
    with bars() as report:
        report("reading photographs", 3, 10)
        wait_until(lambda: stream.getvalue().count("3/10") >= 4)
    assert "pop: " not in stream.getvalue()
    took = TrainingRun.take_steps

    def slowly(training: TrainingRun, last: int) -> Any:
        wait_until(lambda: stream.getvalue().count("0/1 [") >= 4)
        return took(training, last)

    monkeypatch.setattr(TrainingRun, "take_steps", slowly)
    words = ("--out", tmp_path / "r", "--max-steps", "1", "--skip-checks", "--skip-sizes")
    assert pop("train", shared_capture, *words).status == 0


def test_training_tells_how_far_it_is(pop, shared_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(heartbeat, "PERIOD", 0.01)
    words = [word for word in TRAIN if word != "--no-progress"]
    told = pop.done("train", shared_capture, "--out", tmp_path / "r", *words)
    steps = [line for line in told.err.splitlines() if line.startswith("pop: step ")]
    assert steps
    assert all(" of 30, " in line and " Gaussians" in line and line.endswith(" s)") for line in steps)
    # also of what comes after the last step
    words = (*TRAIN_AND_CHECK, "--max-gaussians", "50", "--fine-tune-steps", "2", "--quiet")
    assert pop("train", shared_capture, "--out", tmp_path / "q", *words).err == ""


def test_times_are_written_as_people_say_them() -> None:
    said = {0.4: "0 s", 59.4: "59 s", 59.6: "1 min 0 s", 3599: "59 min 59 s", 7860: "2 h 11 min"}
    assert {seconds: duration(seconds) for seconds in said} == said
