"""Checkpoint files: whole or absent, few, safe to load, and refused where they do not belong."""

from __future__ import annotations

import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.data.capture import Capture
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train import checkpoint as ckpt
from tests.app.conftest import Pop, in_a_child, pop_in_a_child
from tests.app.damage import FORGED, INF, Content, contents, forge, latest, says, to
from tests.app.test_fused_stepper import drift_engine
from tests.app.tiny import tiny_capture, tiny_config


def resume(folder, capture=None, **changes):
    TrainingRun(tiny_config(folder, **changes), capture or tiny_capture(), resume=True).run()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 8}, r"was written with seed = 7, but this run has seed = 8"),
        ({"max_steps": 40}, r"max_steps = 30, but this run has max_steps = 40"),
        ({"method": "gsplat"}, r"method = pop, but this run has method = gsplat"),
        ({"threads": 2}, r"threads = 1, but this run has threads = 2"),
        (
            {"strategy": replace(tiny_config("x").strategy, theta_blur=0.5)},
            r"pop\.theta_blur = 0\.02, but this run has pop\.theta_blur = 0\.5",
        ),
    ],
)
def test_other_settings_are_refused_by_name(stopped, changes, message):
    before = contents(stopped)
    with pytest.raises(PopError, match=message):
        resume(stopped, **changes)
    assert contents(stopped) == before


@pytest.mark.parametrize("name", ["exposure", "gone", "near_plane"])
def test_a_checkpoint_of_a_version_with_other_settings_says_so(stopped, tmp_path, name):
    folder = shutil.copytree(stopped, tmp_path / "old")
    path = ckpt.list_checkpoints(folder)[-1][1]
    content = ckpt.load_checkpoint(path)
    config = dict(content["config"])
    changes = {"profile": "inria", "near_plane": 0.063} if name == "near_plane" else {}
    if changes:  # of the training frame, as it was
        config |= {"profile": "inria", "near_plane": None}
    elif config.pop(name, None) is None:
        config[name] = 1
    ckpt.save_checkpoint(path, {**content, "config": config})
    told = rf"is of a version with other settings than this one \({name}\); resume with the version that wrote it"
    with pytest.raises(PopError, match=told):
        resume(folder, **changes)


def _changed(what: str) -> Capture:
    capture = tiny_capture()
    view = capture.views[1]
    image = view.image.copy()
    image[0, 0, 0] ^= 1
    changes: dict[str, dict[str, Any]] = {
        "view names": {"name": "01b.png"},
        "photographs": {"image": image},
        "masks": {"mask": np.ones(image.shape[:2], dtype=bool)},
        "cameras": {"K": view.K + np.diag([1e-9, 0, 0])},
    }
    if what not in changes:
        return replace(capture, points=capture.points + 1e-12)
    return replace(capture, views=(capture.views[0], replace(view, **changes[what]), *capture.views[2:]))


@pytest.mark.parametrize("what", ["view names", "photographs", "masks", "cameras", "sparse points"])
def test_another_capture_is_refused_and_what_differs_is_named(stopped, what):
    with pytest.raises(PopError, match=f"another capture: the {what} differ"):
        resume(stopped, _changed(what))


def test_held_out_views_are_not_part_of_the_fingerprint():
    capture = tiny_capture()
    views = list(capture.views)
    views[0] = replace(views[0], image=255 - views[0].image)
    other = replace(capture, views=tuple(views))
    some, all_of_them = (replace(TrainConfig(), test_every=every) for every in (5, 0))
    assert ckpt.capture_fingerprint(capture, some) == ckpt.capture_fingerprint(other, some)
    assert ckpt.capture_fingerprint(capture, all_of_them) != ckpt.capture_fingerprint(other, all_of_them)


def test_alpha_and_tracks_are_part_of_the_fingerprint_where_they_are_used():
    capture = tiny_capture()
    plain = TrainConfig()
    view, settings = capture.views[1], {"alpha channels": {"random_background": True}, "tracks": {"depth_lambda": 0.1}}
    for what, changed in (
        ("alpha channels", replace(view, alpha=np.full(view.image.shape[:2], 254, np.uint8))),
        ("tracks", replace(view, seen=np.arange(3))),
    ):
        other = replace(capture, views=(capture.views[0], changed, *capture.views[2:]))
        assert ckpt.capture_fingerprint(capture, plain) == ckpt.capture_fingerprint(other, plain)
        ours, theirs = (ckpt.capture_fingerprint(of, replace(plain, **settings[what])) for of in (capture, other))
        assert [name for name in ours if ours[name] != theirs[name]] == [what]


CUT_OFF = r"x\.pt: cannot be read as a checkpoint; remove it"
NO_FORMAT = r"x\.pt: has no 'format', so it is not a checkpoint"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", CUT_OFF),
        (b"PK\x03\x04 cut off", CUT_OFF),
        (b"plain text", CUT_OFF),
        ({"step": 1, "splats": {}}, NO_FORMAT),
        *((content, NO_FORMAT) for content in (None, [], "text", 3, torch.zeros(3))),
    ],
    ids=repr,
)
def test_what_is_not_a_checkpoint_of_ours_is_named(tmp_path, content, message):
    path = tmp_path / "x.pt"
    with pytest.raises(PopError, match="there is no such checkpoint"):
        ckpt.load_checkpoint(path)
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(PopError, match=message):
        ckpt.load_checkpoint(path)


def test_a_checkpoint_cannot_run_code(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "boom"), "w"))

    torch.save(Bomb(), tmp_path / "x.pt")
    with pytest.raises(PopError, match="cannot be read"):
        ckpt.load_checkpoint(tmp_path / "x.pt")
    assert not (tmp_path / "boom").exists()


SAVE_UNDER_LIMITS = """
import resource, signal, sys
from pathlib import Path
import torch
from pop_fast.errors import PopError
from pop_fast.train.checkpoint import save_checkpoint
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
for limit in map(int, sys.argv[2:]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        save_checkpoint(Path(sys.argv[1]), {"a": torch.ones(1000), "b": torch.ones(100_000)})
    except PopError as error:
        print(error, [path.name for path in Path(sys.argv[1]).parent.iterdir()])
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are set as Linux has them")
def test_a_write_that_the_system_cuts_off_is_a_sentence(tmp_path):
    limits = (0, 10, 3000, 5000, 100_000, 404_900)
    path = tmp_path / "ckpts" / "ckpt_1_rank0.pt"
    ckpt.save_checkpoint(path, {"a": torch.ones(3)})
    before = path.read_bytes()
    outcome = in_a_child(SAVE_UNDER_LIMITS, path, *limits)
    assert outcome.status == 0, outcome.err
    lines = outcome.out.splitlines()
    assert len(lines) == len(limits)
    for line in lines:
        assert line.startswith(f"{path}: could not be written: the file is larger than")
        assert line.endswith(f"['{path.name}']")
    assert path.read_bytes() == before


def test_the_last_few_and_the_milestones_are_kept(tmp_path):
    for step in (4, 9, 11, 14, 19):
        ckpt.save_checkpoint(ckpt.checkpoint_path(tmp_path, step), {})
    (tmp_path / "ckpts" / "notes.txt").write_text("")
    # as a run that was resumed without its --save-steps had kept one
    (tmp_path / "ply").mkdir()
    (tmp_path / "ply" / "point_cloud_4.ply").write_text("")
    ckpt.prune_checkpoints(tmp_path, keep_last=2, keep_steps={11})
    assert [step for step, _ in ckpt.list_checkpoints(tmp_path)] == [4, 11, 14, 19]
    assert (tmp_path / "ckpts" / "notes.txt").exists()


def test_processor_time_goes_on_from_a_checkpoint_and_is_not_told_where_a_part_was_not_counted(stopped, tmp_path):
    written = []
    for name in ("counted", "older"):
        folder = shutil.copytree(stopped, tmp_path / name)
        [(_, path)] = ckpt.list_checkpoints(folder)[-1:]
        content = torch.load(path, weights_only=True)
        before = content["seconds"]["cpu"]
        assert before > 0.0
        if name == "older":
            del content["seconds"]["cpu"]
            ckpt.save_checkpoint(path, content)
        written.append(TrainingRun(tiny_config(folder), tiny_capture(), resume=True).run())
    assert written[0]["seconds_cpu"] > before
    assert "seconds_cpu" not in written[1]


# Checkpoints whose content no run can have written: each is refused before it reaches a step, file and entry named.


@pytest.fixture
def forged(stopped: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(stopped, tmp_path / "run"))


@pytest.fixture
def no_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a run that would take a step fail instead: with what it has accepted, a step may end the interpreter."""

    def accepted(*_: Any) -> None:
        raise AssertionError("the checkpoint was accepted")

    monkeypatch.setattr(TrainingRun, "_loop", accepted)


@pytest.mark.usefixtures("no_steps")
@pytest.mark.parametrize("case", FORGED)
def test_what_no_run_can_have_written_is_refused_and_named(case: str, forged: Path) -> None:
    change, parts = FORGED[case]
    forge(forged, change)
    before = contents(forged)
    with pytest.raises(PopError) as caught:
        resume(forged)
    message = str(caught.value)
    for part in parts:
        assert part in message, message
    assert len(message) < 1000
    if "metrics.jsonl" not in message:
        assert message.startswith(f"{latest(forged)}: ")
    if not message.endswith("reads format 1") and "metrics.jsonl" not in message:
        where = r"remove it to continue from ckpt_4_rank0\.pt|remove the file to continue from the one before it"
        assert re.search(where, message), message
    assert contents(forged) == before


@pytest.mark.usefixtures("no_steps")
@pytest.mark.parametrize(
    "case", ["m of another shape", "v NaN", "sums of one row", "no strategy's state", "views true"]
)
def test_a_run_on_a_device_refuses_it_likewise(case: str, forged: Path) -> None:
    change, parts = FORGED[case]
    # as a checkpoint of the CPU is read
    forge(forged, to("config.backend", "cuda"))
    trainer = TrainingRun(tiny_config(forged), tiny_capture(), engine=drift_engine(), resume=True)
    forge(forged, change)
    with pytest.raises(PopError) as caught:
        trainer.run()
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.usefixtures("no_steps")
def test_a_checkpoint_under_another_ones_name_or_of_a_step_after_the_last_is_refused(forged: Path) -> None:
    def later(content: Content) -> None:
        content["step"] = 99
        for moments in content["optimizers"].values():
            moments["step"] = torch.tensor(100.0)

    forge(forged, later)
    latest(forged).rename(ckpt.checkpoint_path(forged, 99))
    with pytest.raises(PopError, match=r"ckpt_99_rank0\.pt: step is 99; it must be at most 29, the run's last"):
        resume(forged)
    ckpt.checkpoint_path(forged, 9).write_bytes(ckpt.checkpoint_path(forged, 4).read_bytes())
    with pytest.raises(PopError, match=r"step is 4; it must be 9, as the file's name says; remove it to continue from"):
        ckpt.load_checkpoint(ckpt.checkpoint_path(forged, 9))


def test_what_a_run_can_come_to_is_accepted(forged: Path) -> None:
    def unusual(content: Content) -> None:
        # the square of a large gradient overflows, and the parameter stays where it is
        content["optimizers"]["means"]["exp_avg_sq"][0, 0] = INF
        content["splats"]["colour"] = torch.zeros(3)
        content["notes"] = "what nothing reads does no harm"
        content["splats"]["scales"] = content["splats"]["scales"].t().contiguous().t()

    forge(forged, unusual)
    content = ckpt.load_checkpoint(latest(forged))
    assert "colour" not in content["splats"]
    assert all(value.is_contiguous() for value in content["splats"].values())
    resume(forged)
    assert ckpt.list_checkpoints(forged)[-1][0] == 29


def test_pop_train_refuses_a_moment_of_another_shape_and_lives(result: Path, shared_capture: Path) -> None:
    ckpt.checkpoint_path(result, 29).unlink()
    ((step, path),) = ckpt.list_checkpoints(result)
    assert step == 6
    content = torch.load(path, weights_only=True)
    content["optimizers"]["means"]["exp_avg"] = torch.zeros(3, 3)
    torch.save(content, path)
    words = ("--steps-scaler", "0.001", "--quiet", "--pop.grow-grad2d", "1e-6", "--resume")
    outcome = pop_in_a_child("train", shared_capture, "--out", result, *words)
    says(outcome, "ckpt_6_rank0.pt: optimizers.means.exp_avg has shape [3, 3]; it must be [", "remove it")


@pytest.mark.parametrize("command", ["eval", "export", "render"])
def test_the_other_commands_refuse_a_flipped_bit(pop: Pop, result: Path, tmp_path: Path, command: str) -> None:
    path = ckpt.checkpoint_path(result, 29)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data))
    out = () if command == "eval" else ("--out", tmp_path / "o.ply")
    earlier = ckpt.checkpoint_path(result, 6)
    says(pop(command, result, *out), str(path), "does not agree with its checksum", f"use an earlier one ({earlier})")
    assert not (tmp_path / "o.ply").exists()
