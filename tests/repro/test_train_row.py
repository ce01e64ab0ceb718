"""Training a row: its result is whole, the same whether it was interrupted or not, and made once.

A row that begins from another's checkpoint, or from a capture that was prepared for a node, is the same row.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.faults.corpus import HERE as CORPUS
from paper_repro import prepared
from paper_repro import train_row as module
from paper_repro.collect import PROBE, collect, file_hash, first_change
from paper_repro.jobs import NotTrainableError, job_named, jobs_of, load_rows
from paper_repro.probe import VIEWS, ProbedRun, gradient_sizes
from paper_repro.results import read, run_id, settings_hash, write
from paper_repro.train_row import (
    BusyError,
    Options,
    base_of,
    capture_folder,
    commit,
    finished,
    load_capture_of,
    only_one,
    steps_for_others,
    train_row,
)
from pop_fast.data import load_capture
from pop_fast.errors import PopError
from pop_fast.io.formats.files import load_splat_file
from pop_fast.io.images import read_image
from pop_fast.stages import losses
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.checkpoint import capture_fingerprint
from pop_fast.train.choose import choose_backend
from tests.app.captures import colmap_capture
from tests.app.conftest import wait_until
from tests.app.tiny import interrupt, interrupted
from tests.repro.made import options, toy, values

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The options and the result of POP at toy scale, trained without an interruption."""
    folder = tmp_path_factory.mktemp("made")
    return options(folder), train_row(toy("pop"), options(folder))


def test_a_result_lies_in_its_place_and_holds_what_was_asked_for(made):
    how, result = made
    assert read(how.results / "toy" / "pop.jsonl") == (result,)
    assert (result.scale, result.row, result.scene, result.seed) == ("toy", "pop", "demo", 42)
    assert (result.threads, result.commit) == (1, commit())
    assert result.protocol["test_views"] == len(result.per_view) == 3
    assert (result.protocol["width"], result.protocol["height"], result.protocol["resize"]) == (96, 72, "none")
    assert result.schedule["pop.blur_stop_iter"] == 70
    assert not {"data", "result_dir", "seed", "backend"} & set(result.schedule)
    assert all(result.seconds[phase] > 0.0 for phase in ("load", "train", "evaluate", "cpu"))
    # one thread takes no more of the processor than the clock shows, but for the grain of the two
    assert result.training_seconds == result.seconds["cpu"] < result.seconds["train"] + 1.0
    assert result.checkpoint_mib == pytest.approx(result.num_gaussians * 236 / 2**20, rel=1e-12)
    assert result.lpips == {"vgg_01": None, "alex_norm": None, "alex_01": None}
    assert result.psnr == pytest.approx(sum(view["psnr"] for view in result.per_view.values()) / 3, rel=1e-12)
    assert str(how.data) not in toy("pop").file(how.results).read_text()


def test_seconds_of_a_machine_with_other_work_are_kept_and_not_compared(made, tmp_path, monkeypatch):
    monkeypatch.setenv("POP_COMMIT", "c0ffee1")
    how, job = options(tmp_path, untimed=True), toy("l1_div_100", steps_scaler=0.001)
    shared, alone = train_row(job, how), made[1]
    assert (alone.is_timed, shared.is_timed) == (True, False)
    assert shared.protocol["timing"].startswith(alone.protocol["timing"])
    assert shared.seconds["cpu"] > 0.0
    # that of files without their clone; what is none is told before the training, not after it
    assert shared.commit == "c0ffee1"
    monkeypatch.setenv("POP_COMMIT", "yesterday")
    with pytest.raises(PopError, match="POP_COMMIT is 'yesterday'; it must be 7 to 40 hex digits"):
        commit()


def refuse(*_) -> None:
    raise PopError("the disk is full")


def test_a_row_that_goes_on_at_another_commit_or_alone_says_how_it_began(tmp_path, monkeypatch):
    how, job = options(tmp_path, untimed=True, checkpoint_every=10), toy("l1_div_100", steps_scaler=0.001)
    monkeypatch.setenv("POP_COMMIT", "c0ffee1")
    with interrupted(at=20):
        train_row(job, how)
    alone = replace(how, untimed=False)
    monkeypatch.setenv("POP_COMMIT", "c0ffee2")
    with monkeypatch.context() as patch:
        patch.setattr(module.results, "write", refuse)
        with pytest.raises(PopError, match="the disk is full"):
            train_row(job, alone)
    # no step is left to this one
    monkeypatch.setenv("POP_COMMIT", "c0ffee3")
    result = train_row(job, alone)
    assert (result.commit, result.protocol["begun"], result.is_timed) == ("c0ffee2", "c0ffee1", False)
    assert read(job.file(how.results)) == (result,)


def test_a_curve_has_every_densification_step_and_the_held_out_views_of_every_fifteenth(made):
    curve = made[1].curve
    steps = [point["step"] for point in curve]
    assert steps == sorted(set(steps))
    assert set(range(0, 300, 10)) <= set(steps)
    measured = [point for point in curve if point.get("psnr_test") is not None]
    assert [point["step"] for point in measured] == [20 * i - 1 for i in range(1, 16)]
    assert all(point["n_blended"] > 0.0 and point["n_traversed"] >= point["n_blended"] for point in measured)
    # the counts add up: what a densification step cloned, split and pruned is the difference to the point before it
    changes = [(before, now) for before, now in pairwise(curve) if "cloned" in now]
    assert len(changes) == 14
    for before, now in changes:
        change = now["cloned"] + now["split"] - now["pruned"]
        assert now["num_gaussians"] == before["num_gaussians"] + change
    last, result = curve[-1], made[1]
    assert (last["step"], last["num_gaussians"], last["psnr_test"]) == (
        *(299, result.num_gaussians),
        # a curve keeps five digits
        pytest.approx(result.psnr, rel=5e-5),
    )


def test_a_curve_has_what_a_few_training_views_say_all_along(made):
    points = {point["step"]: point for point in made[1].curve}
    probed = [step for step, point in points.items() if point.get("grad_l2") is not None]
    assert probed == list(range(0, 300, 10))
    for step in probed:
        point = points[step]
        # no pixel of a float render equals its photograph's, and L2's slope is twice the error
        assert point["grad_l1"] == pytest.approx(1.0, rel=1e-3)
        assert 0.0 < point["grad_l2"] < 2.0
        assert point["grad_ssim"] > 0.0
        assert point["probe_traversed"] >= point["probe_blended"] > 1.0
    assert points[290]["grad_l2"] < 0.5 * points[0]["grad_l2"]


def test_a_finished_row_is_not_trained_again_and_leaves_no_bulk(made, monkeypatch):
    how, result = made
    work = toy("pop").work(how.work)
    assert not (work / "ckpts").exists()
    assert not (work / "ply").exists()
    assert (work / "metrics.jsonl").is_file()
    text = toy("pop").file(how.results).read_bytes()
    monkeypatch.setattr(TrainingRun, "__init__", lambda *_, **__: pytest.fail("trained again"))
    assert train_row(toy("pop"), how) == result
    assert toy("pop").file(how.results).read_bytes() == text


@pytest.mark.slow  # it trains
def test_a_row_that_was_interrupted_ends_with_the_same_result(made, tmp_path):
    how = options(tmp_path, work=made[0].work.parent / "again")
    with interrupted(at=150):
        train_row(toy("pop"), how)
    assert not toy("pop").is_done(how.results)
    assert (toy("pop").work(how.work) / "ckpts" / "ckpt_99_rank0.pt").is_file()
    again = train_row(toy("pop"), how)
    assert values(again) == values(made[1])


def test_what_was_asked_to_be_kept_is_kept(tmp_path):
    how = options(tmp_path, keep_ply=True, keep_checkpoints=True)
    job = toy("l1_div_10", steps_scaler=0.002)
    result = train_row(job, how)
    assert [path.name for path in (job.work(how.work) / "ply").iterdir()] == ["point_cloud_59.ply"]
    assert list((job.work(how.work) / "ckpts").iterdir())
    # a divisor is no step number, and a run of 60 steps has not become one of 300
    assert (result.schedule["max_steps"], result.schedule["photometric_divisor"]) == (60, 10.0)


@pytest.mark.parametrize("row", ["3dgs", "gsplat", "reset"])
def test_rows_of_other_methods_and_losses_are_trained(row, tmp_path, made):
    job = toy(row, steps_scaler=0.001)
    result = train_row(job, options(tmp_path))
    assert result.schedule["method"] == job.row.method
    assert {point["step"] for point in result.curve} >= {0, 29}
    assert result.run != made[1].run
    assert result.data_hash == made[1].data_hash
    loss = "l2" if row == "reset" else "l1"
    assert result.curve[0][loss] > 0.0


def test_a_run_is_known_by_settings_data_and_seed_and_not_by_how_it_ran(tmp_path):
    job = toy("pop", steps_scaler=0.001)
    one = train_row(job, options(tmp_path / "a"))
    threads = train_row(job, options(tmp_path / "b", threads=2, checkpoint_every=7, log_every=5))
    assert (threads.run, threads.config_hash, threads.data_hash) == (one.run, one.config_hash, one.data_hash)
    assert threads.threads == 2
    logged = [{point["step"] for point in result.curve if "psnr" in point} for result in (one, threads)]
    assert logged == [{0, 10, 20}, {0, 5, 10, 15, 20, 25}]
    seed = train_row(replace(job, seed=43), options(tmp_path / "c"))
    assert (seed.config_hash, seed.seed) == (one.config_hash, 43)
    assert seed.run != one.run


def test_a_result_whose_row_has_changed_is_refused_and_new_settings_are_not(made, tmp_path):
    result, job = made[1], toy("pop")
    assert finished(job, made[0].results) == result
    older = replace(result, schedule={name: v for name, v in result.schedule.items() if name != "pop.absgrad"})
    assert first_change(older, job.config()) is None
    settings = {**result.schedule, "pop.theta_blur": 3e-5}
    hashed = settings_hash(settings)
    other = replace(result, schedule=settings, config_hash=hashed, run=run_id(hashed, result.data_hash, result.seed))
    path = write(other, tmp_path / "results")
    told = r"pop\.jsonl: demo, seed 42 was trained with pop\.theta_blur = 3e-05, and the row has 2e-05 now; .* --again"
    with pytest.raises(PopError, match=told):
        train_row(job, options(tmp_path))
    assert read(path) == (other,)


def test_a_row_that_another_process_trains_is_left_to_it(tmp_path):
    job, how = toy("l2"), options(tmp_path)
    with (
        only_one(job.work(how.work).with_suffix(".lock"), "taken"),
        pytest.raises(BusyError, match="another process trains"),
    ):
        train_row(job, how)
    assert not job.work(how.work).exists()


def test_a_method_that_is_not_there_is_said_before_anything_is_read(tmp_path):
    job = toy("pop")
    strange = replace(job, row=replace(job.row, name="pop", method="telepathy"))
    with pytest.raises(NotTrainableError, match="no method 'telepathy'"):
        train_row(strange, Options(data=tmp_path, results=tmp_path / "results", work=tmp_path / "work"))
    assert not list(tmp_path.iterdir())


def test_an_unfinished_folder_is_not_collected(tmp_path, monkeypatch):
    how, job = options(tmp_path), toy("pop", steps_scaler=0.001)
    with monkeypatch.context() as patch:
        patch.setattr(module, "_remove_bulk", lambda *_: None)
        interrupt(patch, at=20)
        with pytest.raises(KeyboardInterrupt):
            train_row(job, how)
    with pytest.raises(PopError, match=r"val_step0029\.json: is absent, so the training is not finished"):
        collect(job, job.work(how.work), {})


def test_a_record_that_is_wrong_is_told_with_the_folder_that_it_lies_in(tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(CORPUS / "result", folder)
    said = json.loads((folder / "row.json").read_text())
    (folder / "row.json").write_text(json.dumps(said | {"height": -1}))
    with pytest.raises(PopError, match=rf"^{folder}: the result of pop on demo, seed 42: protocol: height is -1"):
        collect(job_named("pop", "demo", "toy"), folder, {})


def test_what_an_earlier_training_left_does_not_reach_a_result(tmp_path):
    how, job = options(tmp_path), toy("pop", steps_scaler=0.001)
    first = values(train_row(job, how))
    # measurements at steps that this training does not measure at
    stats = job.work(how.work) / "stats"
    (stats / "val_step0010.json").write_text(
        json.dumps({**json.loads((stats / "val_step0029.json").read_text()), "step": 10})
    )
    job.file(how.results).unlink()
    assert values(train_row(job, how)) == first


@pytest.mark.slow  # a row is trained twice
def test_sigterm_leaves_a_checkpoint_and_the_same_command_goes_on(made, tmp_path):
    how, job = options(tmp_path), toy("pop")
    words = ["run", "pop", "demo", "--scale", "toy", "--results", str(how.results), "--work", str(how.work)]
    command = [sys.executable, "-m", "paper_repro", *words]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=ROOT)
    metrics = job.work(how.work) / "metrics.jsonl"
    wait_until(lambda: metrics.is_file() and metrics.stat().st_size > 0, process)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=120)
    assert (process.returncode, said) == (
        130,
        "pop-repro: stopped; the same command continues from the last checkpoint\n",
    )
    assert list((job.work(how.work) / "ckpts").iterdir())
    assert not job.is_done(how.results)
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.splitlines()[-1] == str(job.file(how.results))
    assert values(job.result(how.results)) == values(made[1])


def test_a_finished_row_leaves_its_splat_and_two_renders_with_their_hashes(made):
    how, result = made
    place = how.work / "published" / "toy" / "pop" / "demo_42"
    assert {path.name: file_hash(path) for path in place.iterdir()} == result.files
    assert set(result.files) == {"splat.spz", "held_out_0000.png", "held_out_0002.png"}
    stored = load_splat_file(place / "splat.spz")
    assert (len(stored.params["means"]), stored.antialiased) == (result.num_gaussians, False)
    with np.load(toy("pop").work(how.work) / "report_data" / "val_step299_0002.npz") as kept:
        assert np.array_equal(read_image(place / "held_out_0002.png"), kept["render"])


def steps_taken(monkeypatch) -> list[int]:
    """Note from now on the steps before which runs are asked to take some."""
    steps, take = [], TrainingRun.take_steps
    monkeypatch.setattr(TrainingRun, "take_steps", lambda run, last: steps.append(run.step) or take(run, last))
    return steps


def test_a_finished_row_is_trained_again_where_that_is_asked_for_and_its_result_replaced(tmp_path, monkeypatch):
    # with its last checkpoint, from which it would continue with nothing left to do
    how, job = options(tmp_path, keep_checkpoints=True, published=tmp_path / "shown"), toy("pop", steps_scaler=0.001)
    first = train_row(job, how)
    write(replace(first, machine="another"), how.results)
    assert train_row(job, how).machine == "another"
    steps = steps_taken(monkeypatch)
    assert values(train_row(job, replace(how, again=True))) == values(first)
    assert min(steps) == 0
    assert values(job.result(how.results)) == values(first)
    assert set(first.files) == {path.name for path in job.work(tmp_path / "shown").iterdir()}


# Rows that begin where another one has got to: the same bits as alone, and only where that is so.

# of a hundredth of the schedule, another tenth or two less
SHORT = {"steps_scaler": 0.004}


@pytest.mark.parametrize(
    ("row", "base", "shared", "stop"),
    [
        pytest.param("pup", "3dgs_2023", 120, 140, marks=pytest.mark.slow),
        ("mini_splatting_star", "mini_splatting", 60, 90),
    ],
)
def test_a_row_that_begins_from_its_base_comes_to_what_it_comes_to_alone(
    row, base, shared, stop, tmp_path, monkeypatch
):
    job, of_base = toy(row, **SHORT), toy(base, **SHORT)
    alone = train_row(job, options(tmp_path / "alone"))
    assert "base" not in alone.protocol
    how = options(tmp_path / "after")
    first = train_row(of_base, how)
    kept = of_base.work(how.work) / "base" / f"ckpt_{shared - 1}_rank0.pt"
    assert [path.name for path in kept.parent.iterdir()] == [kept.name]
    assert not (of_base.work(how.work) / "ckpts").exists()

    steps = steps_taken(monkeypatch)
    with interrupted(at=stop):
        train_row(job, how)
    assert kept.is_file()
    after = train_row(job, how)
    assert min(steps) == shared

    assert after.protocol == {**alone.protocol, "base": first.run}
    # held-out views are measured at every fifteenth of the base's steps, and then of one's own
    differ = {name for name, value in values(after).items() if value != values(alone)[name]}
    assert differ <= {"protocol", "curve"}
    counts, others = ({p["step"]: p["num_gaussians"] for p in result.curve} for result in (after, alone))
    both = counts.keys() & others.keys()
    assert len(both) >= 12
    assert all(counts[step] == others[step] for step in both)
    # the time of the shared steps is in its own
    assert sum(point["seconds"] is not None for point in after.curve if point["step"] < shared) >= shared // 10
    assert after.seconds["train"] > after.at(shared - 10, "seconds") > 0.0


def test_a_checkpoint_stays_as_long_as_a_row_waits_for_it(tmp_path):
    how, job = options(tmp_path), toy("pup", steps_scaler=0.001)
    of_base = base_of(job)
    train_row(of_base, replace(how, untimed=True))
    kept = of_base.work(how.work) / "base"
    done = train_row(job, how)
    assert kept.is_dir()
    # the time of the base's steps is in its own
    assert (done.protocol["base"], done.is_timed) == (of_base.result(how.results).run, False)
    write(replace(done, row="pup_star"), how.results)
    module._remove_bulk(job, how)
    assert not kept.exists()


@pytest.mark.slow  # it trains
def test_a_base_of_another_kind_is_not_begun_from(tmp_path, monkeypatch):
    how, job = options(tmp_path, keep_checkpoints=True), toy("pup", steps_scaler=0.001)
    train_row(base_of(job), how)
    for change in ({"threads": 2}, {"log_every": 7}):
        assert "base" not in train_row(job, replace(how, **change)).protocol, change
        job.file(how.results).unlink()
        shutil.rmtree(job.work(how.work))
    with monkeypatch.context() as patch:
        patch.setattr(module, "processor_kind", lambda: "another kind")
        assert "base" not in train_row(job, how).protocol
    job.file(how.results).unlink()
    shutil.rmtree(job.work(how.work))
    assert "base" in train_row(job, how).protocol


@pytest.mark.parametrize("scale", ["toy", "small", "full", "paper"])
def test_every_row_that_names_a_base_shares_steps_with_it_on_every_scene(scale):
    named = [row for row in load_rows() if row.base is not None]
    assert {row.name for row in named} == {"pup", "pup_star", "mini_splatting_star"}
    for job in jobs_of(scale, [row.name for row in named]):
        plan = job.config().strategy
        parts = plan.rounds_start_iter if job.row.method == "pup" else plan.sample_iter
        assert steps_for_others(base_of(job)) == (parts,)


# The probe: it leaves the training alone, is taken up where a run is, and measures what it says.

STEPS = 24


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A configuration of a few steps in some folder, and the demo capture."""
    folder = tmp_path_factory.mktemp("probe")
    job = job_named("pop", "demo", "toy")
    data = str(capture_folder(job.scene, Options(data=folder, work=folder)))

    def config(name: str):
        made = job.config(data=data, result_dir=str(folder / name), max_steps=STEPS, checkpoint_every=9, threads=1)
        return choose_backend(made)[0]

    return config, load_capture_of(job, config("none"))[0]


def probed(folder_of, name: str, capture, **more) -> ProbedRun:
    run = ProbedRun(folder_of(name), capture, every=5, **more)
    run.run()
    return run


def points(run: ProbedRun) -> dict:
    return json.loads((run._results.path / PROBE).read_text())


@pytest.mark.slow  # it trains
def test_a_probed_training_is_the_same_training(short):
    config, capture = short
    plain = TrainingRun(config("plain"), capture)
    plain.run()
    run = probed(config, "probed", capture)
    for key, value in plain.params.items():
        assert torch.equal(run.params[key], value), key
    assert list(points(run)) == ["0", "5", "10", "15", "20"]


def test_a_probe_is_the_mean_over_its_views(short):
    config, capture = short
    run = ProbedRun(config("alone"), capture, every=5)
    views = capture.train_views(run.config.test_every)
    assert [view.name for view in run._probed] == [views[i].name for i in (0, len(views) // 2, len(views) - 1)]
    together = run._probe()
    everything, singles = run._probed, []
    for view in everything:
        run._probed = [view]
        singles.append(run._probe())
    assert together["num_gaussians"] == len(run.params["means"])
    for name in ("grad_l1", "grad_l2", "grad_ssim", "probe_blended", "probe_traversed"):
        assert together[name] == pytest.approx(sum(one[name] for one in singles) / VIEWS, rel=1e-12)
        assert len({one[name] for one in singles}) == VIEWS or name == "grad_l1"
    assert together["probe_traversed"] >= together["probe_blended"] > 1.0


def test_what_was_probed_before_a_stop_is_taken_up(short):
    config, capture = short
    whole = probed(config, "whole", capture)
    with interrupted(at=12):
        probed(config, "stopped", capture)
    # the checkpoint is of step 9, and what was probed after it is not of this run any more
    stale = {**points(whole), "10": {"num_gaussians": 1}}
    (whole._results.path.parent / "stopped" / PROBE).write_text(json.dumps(stale))
    again = probed(config, "stopped", capture, resume=True)
    assert points(again) == points(whole)


def test_gradients_are_those_of_autograd_in_units_of_the_slope_of_l1():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand((20, 24, 3), generator=generator, dtype=torch.float64).requires_grad_()
    photo = torch.rand((20, 24, 3), generator=generator, dtype=torch.float64)
    mask = torch.rand((20, 24), generator=generator) < 0.6
    for kept in (None, mask):
        n = image.numel() if kept is None else 3 * int(kept.sum())
        terms = {
            "grad_l1": losses.l1(image, photo, kept),
            "grad_l2": losses.l2(image, photo, kept),
            "grad_ssim": 0.01 * losses.d_ssim(image, photo, "valid", kept),
        }
        found = gradient_sizes(image.detach(), photo, kept)
        assert set(found) == set(terms)
        for name, term in terms.items():
            (gradient,) = torch.autograd.grad(term, image)
            # the mean over what counts, over 1 / (3HW) of what counts
            inside = gradient if kept is None else gradient[kept]
            assert found[name] == pytest.approx(float(inside.abs().mean()) * n, rel=1e-12), name
        assert found["grad_l1"] == pytest.approx(1.0, rel=1e-12)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture with a mask, a split of its own, tracks and notes."""
    found = load_capture(colmap_capture(tmp_path_factory.mktemp("capture") / "scene"))
    masks = [None, np.arange(found.views[1].width) < 9, *[None] * (len(found.views) - 2)]
    views = [
        replace(
            view,
            mask=None if mask is None else np.broadcast_to(mask, view.image.shape[:2]).copy(),
            split="test" if k == 2 else "train",
            seen=None if k == 0 else np.arange(k % 3, dtype=np.int32),
        )
        for k, (view, mask) in enumerate(zip(found.views, masks, strict=True))
    ]
    return replace(found, views=tuple(views), notes=("two lines", "of notes"))


def test_what_is_read_is_what_was_loaded(capture, tmp_path):
    config = TrainConfig()
    path = prepared.write(capture, config, tmp_path)
    assert path == prepared.path_of(tmp_path, config)
    assert [file.name for file in tmp_path.iterdir()] == ["prepared_1.npz"]
    found = prepared.read(path, config)
    assert capture_fingerprint(found, config) == capture_fingerprint(capture, config)
    assert (found.name, found.source, found.notes) == (capture.name, capture.source, capture.notes)
    assert np.array_equal(found.world_transform, capture.world_transform)
    for ours, theirs in zip(found.views, capture.views, strict=True):
        assert (ours.name, ours.split) == (theirs.name, theirs.split)
        assert np.array_equal(ours.image, theirs.image)
        assert (ours.mask is None) == (theirs.mask is None)
        assert (ours.seen is None) == (theirs.seen is None)
        assert ours.seen is None or np.array_equal(ours.seen, theirs.seen)


def test_a_row_that_asks_for_other_photographs_is_refused(capture, tmp_path):
    path = prepared.write(capture, TrainConfig(), tmp_path)
    with pytest.raises(PopError, match=r"prepared_1\.npz: was prepared for .*; pack it again"):
        prepared.read(path, TrainConfig(background=(1.0, 1.0, 1.0)))
    clear = replace(capture.views[0], alpha=np.full(capture.views[0].image.shape[:2], 9, np.uint8))
    with pytest.raises(PopError, match="photographs with transparency"):
        prepared.write(replace(capture, views=(clear, *capture.views[1:])), TrainConfig(), tmp_path / "clear")


def saying(arrays, **other):
    """Return what the file says in words, with some of it replaced."""
    return np.frombuffer(json.dumps(json.loads(arrays["said"].tobytes()) | other).encode(), np.uint8)


DAMAGES = {
    "sizes": lambda a: a | {"sizes": a["sizes"][:-1]},
    "residuals": lambda a: a | {"residuals": a["residuals"][:-1]},
    "splits": lambda a: a | {"said": saying(a, splits=["else"])},
    "viewmats": lambda a: a | {"viewmats": a["viewmats"][:-1]},
    "Ks": lambda a: a | {"Ks": a["Ks"].astype(np.float32)},
    "points": lambda a: a | {"points": a["points"] * np.nan},
    "points_rgb": lambda a: a | {"points_rgb": a["points_rgb"][:-1]},
    "world_transform": lambda a: a | {"world_transform": a["world_transform"][:3]},
    "masks": lambda a: a | {"masked": ~a["masked"]},
    "tracks": lambda a: a | {"tracks": a["tracks"] + 1},
    "seen": lambda a: a | {"seen": a["seen"] + 10**6},
    "said": lambda a: a | {"said": a["said"][1:]},
    "names": lambda a: a | {"said": saying(a, names=["one", "one"])},
}


@pytest.mark.parametrize("name", DAMAGES)
def test_arrays_that_do_not_fit_each_other_are_named(capture, tmp_path, name):
    path = prepared.write(capture, TrainConfig(), tmp_path)
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **DAMAGES[name](arrays))
    with pytest.raises(PopError, match=rf"prepared_1\.npz: .*\b{name}\b.*; pack it again"):
        prepared.read(path, TrainConfig())


def test_a_row_of_what_was_prepared_is_the_row_of_the_photographs(tmp_path, monkeypatch):
    how, job = options(tmp_path / "whole"), toy("l1_div_100", steps_scaler=0.001)
    before = train_row(job, how)
    folder = capture_folder(job.scene, how)
    config = job.config(data=str(folder), result_dir=str(tmp_path / "run"), progress=False)
    there = options(tmp_path / "node")
    alone = there.work / job.scene.folder
    prepared.write(load_capture_of(job, config)[0], config, alone)
    monkeypatch.setattr("pop_fast.cli.train.open_capture", lambda *words: pytest.fail("photographs were read"))
    after = train_row(job, there)
    assert (after.run, after.data_hash, after.per_view) == (before.run, before.data_hash, before.per_view)


def test_the_pack_holds_what_rows_see_of_a_scene(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import gpu_pack

    data = tmp_path / "data"
    source = colmap_capture(data / "fox")
    words = ["--no-wheels", "--data", str(data), "--prepared", "fox", "moon"]
    monkeypatch.setattr(sys, "argv", ["gpu_pack", str(tmp_path / "pack"), *words])
    assert gpu_pack.main() == 1
    told = json.loads((tmp_path / "pack" / "manifest.json").read_text())
    assert told["absent"][0].startswith("scene moon: there is no scene 'moon'")
    (path,) = (tmp_path / "pack" / "captures" / "fox").iterdir()
    found = prepared.read(path, TrainConfig(factor=int(path.stem.split("_")[1])))
    assert len(found.views) == len(load_capture(source).views)
    shutil.rmtree(data)
    assert "absent: scene moon" in capsys.readouterr().err
