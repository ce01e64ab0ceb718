"""Checkpoint files: whole or absent, few, safe to load, and refused where they do not belong."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from pop_fast.data.capture import Capture
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from tests.app.children import in_a_child
from tests.app.tiny import tiny_capture, tiny_config


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of thirty steps, of which the checkpoint after the tenth is the last that is left."""
    folder = tmp_path_factory.mktemp("stopped")
    trainer = TrainingRun(tiny_config(folder), tiny_capture())
    trainer._milestones = _stop_after(trainer, 10)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    return folder


def _stop_after(trainer, taken):
    milestones = trainer._milestones

    def stop(step):
        milestones(step)
        if step + 1 == taken:
            raise KeyboardInterrupt

    return stop


def resume(folder, capture=None, **changes):
    TrainingRun(tiny_config(folder, **changes), capture or tiny_capture(), resume=True).run()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 8}, r"was written with seed = 7, but this run has seed = 8"),
        ({"max_steps": 40}, r"max_steps = 30, but this run has max_steps = 40"),
        ({"method": "gsplat"}, r"method = pop, but this run has method = gsplat"),
        ({"threads": 2}, r"threads = 1, but this run has threads = 2"),
    ],
)
def test_other_settings_are_refused_by_name(stopped, changes, message):
    before = {path: path.read_bytes() for path in stopped.rglob("*") if path.is_file()}
    with pytest.raises(PopError, match=message):
        resume(stopped, **changes)
    assert {path: path.read_bytes() for path in stopped.rglob("*") if path.is_file()} == before


def test_another_nested_setting_is_refused_by_name(stopped):
    config = tiny_config(stopped)
    with pytest.raises(PopError, match=r"pop\.theta_blur = 0\.02, but this run has pop\.theta_blur = 0\.5"):
        resume(stopped, strategy=replace(config.strategy, theta_blur=0.5))


def _changed(what: str) -> Capture:
    capture = tiny_capture()
    views = list(capture.views)
    if what == "view names":
        views[1] = replace(views[1], name="01b.png")
    elif what == "photographs":
        image = views[1].image.copy()
        image[0, 0, 0] ^= 1
        views[1] = replace(views[1], image=image)
    elif what == "masks":
        views[1] = replace(views[1], mask=np.ones(views[1].image.shape[:2], dtype=bool))
    elif what == "cameras":
        views[1] = replace(views[1], K=views[1].K + np.diag([1e-9, 0, 0]))
    else:
        return replace(capture, points=capture.points + 1e-12)
    return replace(capture, views=tuple(views))


@pytest.mark.parametrize("what", ["view names", "photographs", "masks", "cameras", "sparse points"])
def test_another_capture_is_refused_and_what_differs_is_named(stopped, what):
    with pytest.raises(PopError, match=f"another capture: the {what} differ"):
        resume(stopped, _changed(what))


def test_held_out_views_are_not_part_of_the_fingerprint():
    capture = tiny_capture()
    views = list(capture.views)
    views[0] = replace(views[0], image=255 - views[0].image)
    other = replace(capture, views=tuple(views))
    assert ckpt.capture_fingerprint(capture, 5) == ckpt.capture_fingerprint(other, 5)
    assert ckpt.capture_fingerprint(capture, 0) != ckpt.capture_fingerprint(other, 0)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut off", b"plain text"])
def test_a_damaged_checkpoint_is_named(tmp_path, content):
    path = tmp_path / "ckpt_4_rank0.pt"
    path.write_bytes(content)
    with pytest.raises(PopError, match=r"ckpt_4_rank0\.pt: cannot be read as a checkpoint; remove it"):
        ckpt.load_checkpoint(path)


def test_what_is_not_a_checkpoint_of_ours_is_named(tmp_path):
    path = tmp_path / "x.pt"
    with pytest.raises(PopError, match="there is no such checkpoint"):
        ckpt.load_checkpoint(path)
    torch.save({"step": 1, "splats": {}}, path)
    with pytest.raises(PopError, match="has no 'format'"):
        ckpt.load_checkpoint(path)


def test_a_checkpoint_cannot_run_code(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "boom"), "w"))

    torch.save(Bomb(), tmp_path / "x.pt")
    with pytest.raises(PopError, match="cannot be read"):
        ckpt.load_checkpoint(tmp_path / "x.pt")
    assert not (tmp_path / "boom").exists()


def test_a_newer_format_is_named(stopped, tmp_path):
    content = ckpt.load_checkpoint(ckpt.list_checkpoints(stopped)[-1][1])
    path = tmp_path / "x.pt"
    torch.save({**content, "format": 99}, path)
    with pytest.raises(PopError, match="has format 99; this version reads format 1"):
        ckpt.load_checkpoint(path)


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path):
    path = tmp_path / "ckpts" / "ckpt_1_rank0.pt"
    ckpt.save_checkpoint(path, {"a": torch.ones(3)})
    before = path.read_bytes()
    with pytest.raises(Exception, match="pickle"):
        ckpt.save_checkpoint(path, {"a": lambda: 0})
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


SAVE_UNDER_A_LIMIT = """
import resource, signal, sys
from pathlib import Path
import torch
from pop_fast.train.checkpoint import save_checkpoint
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
save_checkpoint(Path(sys.argv[1]), {"a": torch.ones(1000), "b": torch.ones(100_000)})
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are set as Linux has them")
@pytest.mark.parametrize("limit", [0, 10, 3000, 5000, 100_000, 404_900])
def test_a_write_that_the_system_cuts_off_is_a_sentence(tmp_path, limit):
    path = tmp_path / "ckpts" / "ckpt_1_rank0.pt"
    ckpt.save_checkpoint(path, {"a": torch.ones(3)})
    before = path.read_bytes()
    outcome = in_a_child(SAVE_UNDER_A_LIMIT, path, limit)
    last = outcome.err.splitlines()[-1]
    assert last.startswith(f"pop_fast.errors.PopError: {path}: could not be written: the file is larger than")
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_the_last_few_and_the_milestones_are_kept(tmp_path):
    for step in (4, 9, 11, 14, 19):
        ckpt.save_checkpoint(ckpt.checkpoint_path(tmp_path, step), {})
    (tmp_path / "ckpts" / "notes.txt").write_text("")
    ckpt.prune_checkpoints(tmp_path, keep_last=2, keep_steps={11})
    assert [step for step, _ in ckpt.list_checkpoints(tmp_path)] == [11, 14, 19]
    assert (tmp_path / "ckpts" / "notes.txt").exists()


def test_metrics_that_the_checkpoint_vouches_for_must_be_there(stopped, tmp_path):
    (tmp_path / "ckpts").mkdir()
    for _, path in ckpt.list_checkpoints(stopped):
        (tmp_path / "ckpts" / path.name).write_bytes(path.read_bytes())
    (tmp_path / "cfg.json").write_bytes((stopped / "cfg.json").read_bytes())
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    with pytest.raises(PopError, match=r"metrics\.jsonl: has 3 bytes, fewer than"):
        resume(tmp_path)


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
