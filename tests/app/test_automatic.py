"""What `pop train` chooses where no schedule is said, and photographs that come as a video or in an archive."""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from benchmarks import estimates
from benchmarks.few_photographs import left_of, table_of
from pop_fast.cli.train_checks import chooses_for_itself
from pop_fast.data.capture import Capture
from pop_fast.data.unpack import capture_folder, unpack
from pop_fast.errors import CaptureError
from pop_fast.io.heartbeat import duration
from pop_fast.train import TrainConfig, automatic
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.automatic import (
    DEPTH_LAMBDAS,
    FEW,
    LOOKS,
    MINUTES,
    SHORTEST,
    Choice,
    Speed,
    Terms,
    choose_length,
    choose_terms,
    expected_gaussians,
    factor_for,
)
from pop_fast.train.presets import QUICK_BETA2_UNTIL, QUICK_SCALER
from pop_fast.view.paths import VideoFile
from pop_fast.view.report.source import read_result
from tests.app.conftest import ROOT, Pop
from tests.app.damage import says
from tests.app.tiny import interrupt, tiny_capture

SPEED = Speed(few=10_000, many=40_000, seconds_few=0.02, seconds_many=0.05, took=5.0)
QUICKLY = ("--checkpoint-every", "50", "--skip-checks", "--skip-sizes", "--no-progress")


@pytest.mark.parametrize(
    ("side", "gpu", "minutes", "left"),
    [
        *((4032, True, MINUTES, 2016), (3000, True, MINUTES, 1500), (1920, True, 1.0, 1920)),
        *((4032, False, MINUTES, 1008), (1920, False, MINUTES, 960), (1920, False, 3.0, 480), (512, False, 1.0, 512)),
        *((640, False, 3.0, 640), (777, False, 3.0, 777), (778, False, 3.0, 389), (4032, False, 3.0, 576)),
    ],
)
def test_photographs_are_shrunk_to_what_the_machine_trains_on(side: int, gpu: bool, minutes: float, left: int) -> None:
    assert side // factor_for([(side, side // 2), (64, 48)], gpu, minutes) == left


def test_the_schedule_fills_the_minutes_and_is_at_most_the_papers() -> None:
    def chosen(minutes: float) -> Choice:
        return choose_length(TrainConfig.of(preset="auto"), SPEED, minutes, 1e5, 50, 7)

    choices = [chosen(minutes) for minutes in (3.0, 8.0, 15.0)]
    for minutes, choice in zip((3.0, 8.0, 15.0), choices, strict=True):
        assert 0.97 * 60.0 * minutes <= choice.seconds <= 60.0 * minutes * 1.005
    assert choices[0].scaler < choices[1].scaler < choices[2].scaler < 1.0
    assert chosen(1e4).scaler == 1.0
    # what does not fit is not said to
    assert chosen(0.01).scaler == SHORTEST
    assert chosen(0.01).seconds > 0.6
    # no minute more makes it shorter
    scalers = [chosen(minutes).scaler for minutes in np.linspace(0.2, 4.0, 60)]
    assert scalers == sorted(scalers)
    assert min(scalers) < QUICK_SCALER < max(scalers)


def test_few_photographs_are_not_looked_at_for_as_long_as_the_minutes_allow() -> None:
    config = TrainConfig.of(preset="auto")
    few = choose_length(config, SPEED, 1e4, 1e5, 11, 2)
    assert few.scaler == pytest.approx(LOOKS * 9 / 30_000, rel=1e-2)
    assert "each of 9 photographs is seen 200 times" in str(few.why)
    # four views a step are looked at four times as often
    batch = choose_length(replace(config, given=None, batch_size=4), SPEED, 1e4, 1e5, 11, 2)
    assert batch.scaler == pytest.approx(few.scaler / 4.0, rel=1e-2)
    # what the minutes cut shorter has that reason
    short = choose_length(config, SPEED, 0.5, 1e5, 11, 2)
    assert short.scaler < few.scaler
    assert short.why is None
    assert choose_length(config, SPEED, 1e4, 1e5, 34, 4).scaler == pytest.approx(LOOKS * 30 / 30_000)
    enough = choose_length(config, SPEED, 1e4, 1e5, 35, 4)
    assert (enough.scaler, enough.why) == (1.0, None)


@pytest.mark.parametrize("method", ["pop", "gsplat", "3dgs"])
def test_a_short_schedule_has_the_rates_and_the_coarse_photographs_of_quick(method: str) -> None:
    def auto(scaler: float, **said: Any) -> TrainConfig:
        return TrainConfig.of(method=method, preset="auto", steps_scaler=scaler, **said)

    quick, shorter = TrainConfig.of(method=method, preset="quick"), auto(SHORTEST)
    assert replace(auto(QUICK_SCALER), given=None) == replace(quick, given=None)
    assert auto(1.01 * QUICK_SCALER).coarse_stop_iters == ()
    assert shorter.lr == quick.lr
    assert [stop / shorter.max_steps for stop in shorter.coarse_stop_iters] == pytest.approx([1 / 6, 1 / 3], rel=0.01)
    said = auto(SHORTEST, **{"lr.sh0": 0.5, "coarse_stop_iters": ()})
    assert (said.lr.sh0, said.coarse_stop_iters) == (0.5, ())


@pytest.mark.parametrize("method", ["pop", "gsplat", "3dgs"])
def test_rates_go_from_those_of_quick_to_the_published_ones_and_no_length_jumps(method: str) -> None:
    scalers = np.geomspace(QUICK_SCALER, 1.0, 40)
    found = [TrainConfig.of(method=method, preset="auto", steps_scaler=float(by)).lr for by in scalers]
    quick, published = TrainConfig.of(method=method, preset="quick").lr, TrainConfig.of(method=method).lr
    assert (found[0], found[-1]) == (quick, published)
    for name in ("means", "scales", "quats", "sh0", "sh_rest"):
        rates = np.array([getattr(lr, name) for lr in found])
        assert (rates >= getattr(published, name)).all()
        # no rate falls faster than the schedule grows
        assert (rates[1:] <= rates[:-1]).all()
        assert (rates[1:] >= rates[:-1] * scalers[:-1] / scalers[1:] * (1.0 - 1e-9)).all()
        # all end where those of quick end or the published ones, or above
        least = min(getattr(quick, name) * quick.others_decay, getattr(published, name))
        assert (rates * [lr.others_decay for lr in found] >= 0.999 * least).all()
    assert {lr.opacities for lr in found} == {published.opacities}
    # second moments are remembered longer in longer schedules, and as usual from a quarter on
    decays = np.array([lr.beta2 for lr in found])
    assert (np.diff(decays) >= 0.0).all()
    assert np.diff(decays).max() < 0.1 * (decays[-1] - decays[0])
    assert ((decays == published.beta2) == (scalers >= QUICK_BETA2_UNTIL)).all()


def test_a_step_with_more_gaussians_takes_longer_by_as_much_as_was_measured() -> None:
    assert SPEED.seconds_a_step(10_000) == pytest.approx(0.02)
    assert SPEED.seconds_a_step(25_000) == pytest.approx(0.035)
    # a machine that was held up in the first measurement does not get faster with more
    assert Speed(10, 20, 0.5, 0.4).seconds_a_step(30) == 0.5
    last, mean = expected_gaussians("pop", 1_000, 1e4, 20, 0.1)
    assert 1_000 < mean < last


# method, Gaussians at the start, px of a photograph, photographs, scaler, Gaussians at the end: of benchmarks/results,
# paper_repro/results and runs of 11 photographs of a castle
ENDED = [
    *(("pop", 2_903, 129_600, 8, 0.05, 9_640), ("pop", 9_293, 129_600, 25, 0.05, 16_220)),
    *(("pop", 12_037, 129_600, 43, 0.1, 23_812), ("pop", 12_037, 129_600, 43, 1.0, 51_486)),
    *(("pop", 34_174, 262_144, 84, 0.05, 50_269), ("pop", 34_174, 262_144, 84, 0.1, 57_520)),
    *(("pop", 138_766, 262_144, 161, 0.05, 155_999), ("pop", 138_766, 262_144, 161, 0.1, 174_982)),
    *(("pop", 109_926, 106_400, 255, 0.05, 124_785), ("pop", 109_926, 106_400, 255, 0.1, 128_315)),
    ("pop", 8_381, 167_560, 9, 0.519, 40_437),
    *(("gsplat", 12_037, 129_600, 43, 0.1, 108_258), ("gsplat", 34_174, 262_144, 84, 0.1, 380_025)),
    *(("gsplat", 138_766, 262_144, 161, 0.1, 727_341), ("gsplat", 109_926, 106_400, 255, 0.1, 511_103)),
    ("3dgs", 12_037, 129_600, 43, 1.0, 197_012),
]


def test_gaussians_are_foretold_as_runs_had_them() -> None:
    for method, *run, ended in ENDED:
        within = 0.1 if method == "pop" else 0.15
        assert expected_gaussians(method, *run)[0] == pytest.approx(ended, rel=within), (method, run)


def test_a_run_chooses_where_no_schedule_is_said() -> None:
    for words in ("photos", "photos --minutes 3 --method gsplat"):
        assert chooses_for_itself(words.split())
    for words in ("--preset=paper", "--steps_scaler 0.1", "--max-steps 10", "--blocks 2x1"):
        assert not chooses_for_itself(["photos", *words.split()])


def test_a_run_without_options_says_what_it_chose_keeps_it_and_resumes_to_the_same_bits(
    pop: Pop, shared_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("train", shared_capture, "--minutes", "0.001", *QUICKLY)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    outcome = pop(*words, "--out", whole)
    assert outcome.status == 0, outcome.err
    line = next(line for line in outcome.out.splitlines() if line.startswith("chosen for this"))
    for part in ("40x32 px", "300 steps", "Gaussians", "GB of memory", "--preset paper"):
        assert part in line
    given = json.loads((whole / "cfg.json").read_text())["given"]
    assert (given["preset"], given["steps_scaler"]) == ("auto", SHORTEST)
    with monkeypatch.context() as patch:
        interrupt(patch, at=120)
        assert pop(*words, "--out", broken).status == 130
    # a machine that is now a thousand times as fast goes on with the schedule that was begun
    monkeypatch.setattr(automatic, "measure_speed", lambda *given: pytest.fail("a resumed run is timed"))
    resumed = pop("train", shared_capture, *QUICKLY, "--out", broken, "--resume")
    assert resumed.status == 0, resumed.err
    ours, theirs = (ckpt.load_splats(ckpt.checkpoint_path(folder, 299))[0] for folder in (whole, broken))
    assert all((ours[name] == theirs[name]).all() for name in ours)


def test_what_is_said_wins_over_what_is_chosen(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    said = ("--factor", "2", "--pop.blur-min-pixels", "3", "--log-every", "50")
    pop.done("train", shared_capture, "--out", tmp_path / "r", "--minutes", "0.001", *said, *QUICKLY)
    resolved = json.loads((tmp_path / "r" / "cfg.json").read_text())["resolved"]
    assert (resolved["factor"], resolved["log_every"], resolved["strategy"]["blur_min_pixels"]) == (2, 50, 3.0)


def with_tracks(root: Path, every: int) -> Path:
    """Let every photograph of a COLMAP capture see every so manieth point; none at 0."""
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    for number, point in enumerate(model.points3D.values()):
        images = model.images if every and number % every == 0 else ()
        point.track.elements = [pycolmap.TrackElement(image, 0) for image in images]
    model.write_binary(str(root / "sparse" / "0"))
    return root


def chosen(capture: Capture, stops: float | None = None, **said: Any) -> Terms:
    return choose_terms(capture, TrainConfig.of(preset="auto", **{"backend": "fast", **said}), stops)


def test_depth_is_held_to_sparse_points_where_photographs_are_few_and_say_which_they_see() -> None:
    few, many = tiny_capture(n_views=FEW), tiny_capture(n_views=2 * FEW)
    for capture in (few, tiny_capture()):
        terms, count = chosen(capture), len(capture.train_views())
        assert terms.settings == {"depth_lambda": next(weight for most, weight in DEPTH_LAMBDAS if count <= most)}
        assert f"{count} photographs are few, neighbours" in terms.why[0]
    assert chosen(tiny_capture()).settings["depth_lambda"] > chosen(few).settings["depth_lambda"] > 0.0
    assert chosen(many) == Terms()
    # it was not measured with other methods
    assert choose_terms(few, TrainConfig.of(preset="auto", method="gsplat", backend="fast"), None) == Terms()
    blind = replace(few, views=tuple(replace(view, seen=None) for view in few.views))
    assert chosen(blind).settings == {}
    assert "no tracks" in chosen(blind).why[0]
    assert chosen(few, depth_lambda=0.0) == chosen(blind, depth_lambda=0.0) == Terms()


def test_exposures_are_learned_where_cameras_noted_that_they_drift() -> None:
    capture = tiny_capture(n_views=2 * FEW)
    assert chosen(capture, 2.0).settings == {"exposure": True}
    assert "2.0 stops apart" in chosen(capture, 2.0).why[0]
    assert chosen(capture, 1.0) == chosen(capture, 2.0, exposure=False) == chosen(capture, 2.0, batch_size=2) == Terms()
    # a term that the backend does not know is not chosen, and that is said
    terms = chosen(tiny_capture(), 2.0, backend="cuda")
    assert terms.settings == {}
    assert ["depth_lambda" in why or "exposure" in why for why in terms.why] == [True, True]


def test_what_was_chosen_for_few_photographs_is_said_kept_reported_and_gone_on_with(
    pop: Pop, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("train", with_tracks(capture, 4), "--minutes", "0.001", "--out", tmp_path / "r", *QUICKLY)
    with monkeypatch.context() as patch:
        interrupt(patch, at=120)
        outcome = pop(*words)
    assert outcome.status == 130
    weight = DEPTH_LAMBDAS[0][1]
    assert f"(--depth-lambda {weight:g}), as 7 photographs are few" in outcome.out
    assert "1 of 8 photographs are held out" in outcome.out
    assert "--test-every 0" in outcome.out
    assert pop(*words, "--resume").status == 0
    resolved = json.loads((tmp_path / "r" / "cfg.json").read_text())["resolved"]
    assert resolved["depth_lambda"] == weight
    data = read_result(tmp_path / "r")
    assert "as 7 photographs are few" in data.config["chosen by the run"]
    # an explicit number of held-out views is not reported again
    said = pop(*words, "--overwrite", "--test-every", "4", "--depth-lambda", "0")
    assert "held out to measure by" not in said.out
    assert "--depth-lambda" not in said.out


def test_few_photographs_are_left_evenly_with_the_points_that_two_of_them_see() -> None:
    capture = tiny_capture(n_views=17)
    left = left_of(capture, 4)
    assert [view.name for view in left.test_views()] == [view.name for view in capture.test_views()]
    assert [view.name for view in left.train_views()] == ["01.png", "05.png", "11.png", "15.png"]
    assert 0 < len(left.points) < len(capture.points)
    seen = np.bincount(np.concatenate([view.seen for view in left.train_views()]), minlength=len(left.points))
    assert seen.min() >= 2
    was = {view.name: {*map(tuple, capture.points[view.seen])} for view in capture.views}
    assert all({*map(tuple, left.points[view.seen])} <= was[view.name] for view in left.views)


def test_a_table_of_settings_compares_the_same_seeds_alone() -> None:
    rows = {
        "a / 2, 8 photographs, 9 steps, seed 1: plain": {"psnr": 20.0, "ssim": 0.5},
        "a / 2, 8 photographs, 9 steps, seed 2: plain": {"psnr": 30.0, "ssim": 0.7},
        "a / 2, 8 photographs, 9 steps, seed 2: --x": {"psnr": 31.0, "ssim": 0.6},
    }
    last = table_of({"machine": {}, **rows}).splitlines()[-1]
    assert last == "| a / 2, 8 photographs, 9 steps | 25.00 / 0.600 (2) | +1.00 / -0.100 (1) |"


def test_depth_that_no_track_tells_is_warned_of(pop: Pop, capture: Path, tmp_path: Path) -> None:
    words = ("--max-steps", "2", "--out", tmp_path / "r", "--depth-lambda", "0.01", *QUICKLY)
    said = pop.done("train", with_tracks(capture, 0), *words).err
    assert "depth_lambda is 0.01, and the term does nothing" in said


def test_minutes_and_a_schedule_exclude_each_other(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    words = ("train", shared_capture, "--out", tmp_path / "r", "--minutes")
    for schedule in (("--preset", "quick"), ("--max-steps", "9"), ("--steps-scaler", "0.1")):
        says(pop(*words, "5", *schedule), "--minutes", "leave one of them out")
    says(pop(*words, "-1"), "--minutes is -1.0")


def test_an_archive_trains_without_a_second_command(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    packed = tmp_path / "toy.zip"
    with zipfile.ZipFile(packed, "w") as file:
        for part in filter(Path.is_file, shared_capture.rglob("*")):
            file.write(part, f"walk/{part.relative_to(shared_capture).as_posix()}")
        file.writestr("__MACOSX/._a.jpg", b"nothing")
    said = pop.done("train", packed, "--out", tmp_path / "r", "--max-steps", "2", *QUICKLY).out
    assert "unpacked in" in said
    folder = tmp_path / "toy_unpacked" / "walk"
    assert json.loads((tmp_path / "r" / "cfg.json").read_text())["resolved"]["data"] == str(folder)
    assert not (tmp_path / "toy_unpacked" / "__MACOSX").exists()
    # a second time it is there
    assert capture_folder(packed)[0] == folder


def test_an_archive_that_leads_out_of_its_folder_fills_the_disk_or_is_damaged_is_refused(tmp_path: Path) -> None:
    for name in ("../out.jpg", "/out.jpg", "a/../../out.jpg", "c:/out.jpg", "..\\out.jpg"):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
            file.writestr("fine.jpg", b"1")
            file.writestr(name, b"2")
        with pytest.raises(CaptureError, match="outside of its folder"):
            unpack(tmp_path / "a.zip", tmp_path / "deep" / "a")
        assert not list(tmp_path.rglob("*.jpg"))
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a.jpg", bytes(300_000_000))
    with pytest.raises(CaptureError, match=r"bomb\.zip.*MB"):
        unpack(tmp_path / "bomb.zip", tmp_path / "a")
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as file:
        file.writestr("a.jpg", b"some bytes that are checked")
    damaged = bytearray((tmp_path / "c.zip").read_bytes())
    damaged[40] ^= 0xFF
    (tmp_path / "c.zip").write_bytes(damaged)
    with pytest.raises(CaptureError, match="cannot be unpacked"):
        unpack(tmp_path / "c.zip", tmp_path / "c")
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "c").exists()
    # a copy that was cut short has lost its end, by which archives are known
    (tmp_path / "d.zip").write_bytes(damaged[:50])
    with pytest.raises(CaptureError, match=r"d\.zip: cannot be unpacked"):
        capture_folder(tmp_path / "d.zip")
    assert not (tmp_path / "d_unpacked").exists()


def test_a_video_is_a_folder_of_its_frames_the_second_time_too(tmp_path: Path) -> None:
    film = tmp_path / "walk.webm"
    rng = np.random.default_rng(0)
    with VideoFile(film, 5.0) as video:
        for _ in range(6):
            # nothing alike, or it would be a camera at rest
            video.add(np.kron(rng.integers(0, 255, (6, 8, 3)), np.ones((16, 16, 1))).astype(np.uint8))
    folder, said = capture_folder(film)
    assert folder == tmp_path / "walk_frames"
    assert said is not None
    assert "of 6 frames" in said
    taken = sorted(folder.iterdir())
    assert len(taken) >= 2
    again, said = capture_folder(film)
    assert (again, sorted(again.iterdir())) == (folder, taken)
    assert said is not None
    assert "already" in said
    os.utime(film, (folder.stat().st_mtime + 60.0,) * 2)
    with pytest.raises(CaptureError, match="is older than"):
        capture_folder(film)


def test_the_line_before_the_first_step_is_read_back_for_the_table_of_estimates() -> None:
    choice = Choice(scaler=0.01, gaussians=34_900.0, seconds=3_725.0, memory_bytes=1.27e9)
    config = TrainConfig.of(preset="auto", steps_scaler=0.01, factor=2, backend="fast")
    row = estimates.foretold(f"before\n{automatic.line_of(choice, config, (256, 512))}\n")
    foretold = {"gaussians": 35_000, "seconds": 3_720.0, "memory": 1.3}
    assert row == {"size": "256x512", "steps": 300, "foretold": foretold}
    assert estimates.seconds_of(duration(62.0)) == 62.0
    came = {"gaussians": 40_000, "seconds": 1_860.0, "memory": 1.21}
    table = estimates.table_of({"machine": {}, "toy, 60": {**row, "minutes": 60.0, "came": came}})
    assert table.splitlines()[2:] == ["| toy, 60 | 256x512, 300 | 3720 s, 1860 s | 0.50 | 35,000, 40,000 | 1.3, 1.2 |"]
    with pytest.raises(ValueError, match="no line says"):
        estimates.foretold("trained")


def test_what_was_foretold_of_four_captures_came_within_thirty_percent() -> None:
    known = json.loads((ROOT / "benchmarks" / "results" / "estimates.json").read_text(encoding="utf-8"))
    rows = [row for name, row in known.items() if name != "machine"]
    assert len(rows) == 4
    for row in rows:
        for name, said in row["foretold"].items():
            assert said / 1.3 < row["came"][name] < 1.3 * said, (row, name)
    assert "What was foretold came within 30 % on the four captures" in (ROOT / "docs" / "guide.md").read_text()
