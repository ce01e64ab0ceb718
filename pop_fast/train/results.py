"""The folder that a run writes, laid out as gsplat's trainer does.

    cfg.json                        the settings as given, and as they are run
    capture.json                    how `pop train` read the capture, and its training frame
    commands.json                   the command that began the run, and those that resumed it, with their folders
    metrics.jsonl                   one record every `log_every` steps and at every change of the Gaussians
    ckpts/ckpt_{step}_rank0.pt      checkpoints; `step` counts from 0 here and below, so 30,000 steps end at 29999
    ply/point_cloud_{step}.ply      Gaussians in Inria's layout
    stats/train_step{step}.json     Gaussians, opacities, seconds (by the clock; seconds_cpu, on a CPU, is processor
                                    time of training over all threads; seconds_sfm, of searching for cameras, where
                                    there were none), memory, machine, versions
    stats/val_step{step}.json       the same and PSNR, SSIM, LPIPS of the held-out views, and each view's own; of the
                                    last step also encodings: bytes in every file format, and the PSNR from there
    stats/appearance_step{step}.json  what was learned of each training photograph, by name: exposure, and the camera
                                    (viewmat, in the training frame); only with --exposure or --refine-cameras
    renders/val_step{step}_{i}.png        render | photograph | error
    renders/dominant_step{step}_{i}.png   every pixel in the colour of its dominant Gaussian
    report_data/opacity_step{step}.npz    counts [100] of opacities in equal bins of [0, 1]; step -1 is the start
    report_data/val_step{step}_{i}.npz    name, render, photo (uint8 [H, W, 3]), dominant_ids (int32 [H, W]), psnr, ssim
    report_data/depth_step{step}_{i}.npz  name, depth (float32 [H, W], units of the capture, NaN where nothing is)
    report_data/checks_step{step}.json    overfitting, exposure, floaters: `pop_fast.view.report.checks.Checks`
    videos/orbit_step{step}.webm    a turn about the scene
    viewer.html                     a page that shows the splat in a browser
    export/                         files that `pop train --export` asked for
    blocks/                         of a training in blocks: `pop_fast.blocks.plan` says what

A record of metrics.jsonl holds: step, view (or the names of a batch), loss, l1 or l2 (the pixel-wise term), d_ssim,
pop (weighted, absent when off), psnr (of the training view, null where they are equal), num_gaussians, n_blended and
n_traversed (per pixel; not in runs on a GPU), sh_degree, lr_means, it_per_s, seconds (training alone); after a change
of the Gaussians also cloned, split, pruned, and reset when opacities were. Statistics of runs on a GPU also hold gpu,
gpu_memory_bytes, instance_buffers_grown, photograph_bytes (on the GPU) and photographs_passing (copied there for each
of their steps); where processes train together also received_bytes, which others have sent to the one that writes.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.density.protocol import DensificationStep
from pop_fast.errors import PopError
from pop_fast.io.atomic import (
    FolderLock,
    check_place,
    is_left_behind,
    json_text,
    os_errors_name,
    write_atomically,
    write_file,
    write_json,
)
from pop_fast.io.read_back import parse_json, read_json
from pop_fast.train.config import TrainConfig
from pop_fast.train.steps import Phase, StepStats

# cfg.json is the first to step aside and the first to be written anew: where it is, the new run has begun
_OURS = (
    *("cfg.json", "metrics.jsonl", "ckpts", "ply", "stats", "renders", "report_data", "report.html", "capture.json"),
    *("viewer.html", "export", "commands.json", "videos", "blocks"),
)
# holds what a new run replaces while that is being done
_ASIDE = ".replaced"
OPACITY_BINS = 100


class ResultFolder:
    """A run's folder; every file but metrics.jsonl is written whole or not at all."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._lock = FolderLock(self.path)
        # what `check` found
        self._found_used: bool | None = None
        self._metrics: Any = None
        self._waiting: list[bytes] = []

    def check(self, resume: bool, overwrite: bool) -> bool:
        """Refuse a folder that a run may not write to; nothing is written or removed yet.

        Args:
            resume: the run continues with what is there.
            overwrite: the run replaces what is there, when it begins.

        Returns:
            True when an earlier replacement had been cut short and the results that it had set aside are back.

        Raises:
            PopError: the folder is in use and neither `resume` nor `overwrite` is set, or it is not a result folder, or
                another run is writing to it.
        """
        if os.path.lexists(self.path) and not self.path.is_dir():
            what = "a file" if self.path.exists() else "a link to nothing"
            raise PopError(f"{self.path}: is {what}; choose another result folder")
        check_place(self.path / "cfg.json" if self.path.exists() else self.path)
        if self._lock.held:
            return self._check(resume, overwrite)
        self.hold()
        try:
            return self._check(resume, overwrite)
        finally:
            self._lock.release()

    def hold(self) -> None:
        """Lock the folder until `close` where it is there, else by `begin`; PopError where another run writes to it."""
        if self.path.is_dir():
            self._lock.take()

    def _check(self, resume: bool, overwrite: bool) -> bool:
        came_back = self._recover()
        self._found_used = used = self._is_used()
        if used and not resume and not overwrite:
            raise PopError(f"{self.path}: exists and is not empty; pass --resume, --overwrite or another result folder")
        if used and not (self.path / "cfg.json").is_file():
            raise PopError(f"{self.path}: has no cfg.json, so it is not a result folder; choose another")
        return came_back

    def begin(self, config: TrainConfig, beside: Mapping[str, str], opacities: np.ndarray, overwrite: bool) -> None:
        """Write what a run has from its start, in place of earlier results: all of it, or the folder is as it was.

        Args:
            opacities: of the first Gaussians. [N]
            overwrite: earlier results go; without it nothing but a run without checkpoints may be there.

        Raises:
            PopError: the operating system refused; the folder is as it was.
        """
        exists = self.path.exists()
        self._reserve(overwrite)
        alone = overwrite or not self._is_used()
        if overwrite and exists:
            self._set_aside()
        try:
            self.write_settings(config, beside)
            self.open_metrics(keep_bytes=0)
            self.write_opacities(-1, opacities)
        except BaseException:
            self._close_metrics()
            if alone:
                for name in _OURS:
                    _remove(self.path / name)
                self._recover()
            if not exists and self.path.is_dir() and not any(self.path.iterdir()):
                self.path.rmdir()
            self._lock.release()
            raise
        # what cannot be removed now is removed by the next run in this folder
        shutil.rmtree(self.path / _ASIDE, ignore_errors=True)

    def _reserve(self, overwrite: bool) -> None:
        """Lock the folder, making it where it was not there; two runs that found none do not both get it."""
        with suppress(OSError):  # what is wrong is said by the first write
            self.path.mkdir(parents=True, exist_ok=True)
        self._lock.take()
        if self._found_used is False and not overwrite and self._is_used():
            self._lock.release()
            raise PopError(f"{self.path}: another run has begun in this folder; choose another result folder")

    def write_settings(self, config: TrainConfig, beside: Mapping[str, str]) -> None:
        """Write cfg.json, then other texts by file name."""
        for name, text in {"cfg.json": config.to_json(), **beside}.items():
            write_file(self.path / name, text)

    def _is_used(self) -> bool:
        return self.path.is_dir() and not all(is_left_behind(found) for found in self.path.iterdir())

    def _set_aside(self) -> None:
        aside = self.path / _ASIDE
        try:
            aside.mkdir()
            for name in _OURS:
                if (self.path / name).exists():
                    os.replace(self.path / name, aside / name)
        except BaseException:
            self._recover()
            raise

    def _recover(self) -> bool:
        """Undo a replacement that was cut short, or finish it; True when the old results came back."""
        aside = self.path / _ASIDE
        if not aside.is_dir():
            return False
        undo = not (self.path / "cfg.json").exists()
        if undo:
            # cfg.json comes back last, so that this too may be cut short and done again
            for name in reversed(_OURS):
                if (aside / name).exists():
                    _remove(self.path / name)
                    os.replace(aside / name, self.path / name)
        _remove(aside)
        return undo

    def open_metrics(self, keep_bytes: int) -> None:
        """Open metrics.jsonl to append, cut to what a checkpoint vouches for."""
        path = self.path / "metrics.jsonl"
        path.touch()
        have = path.stat().st_size
        if have < keep_bytes:
            raise PopError(f"{path}: has {have} bytes, fewer than the {keep_bytes} of the checkpoint; restore the file")
        # unbuffered: whoever watches the file sees a record when it is made
        self._metrics = open(path, "r+b", buffering=0)  # noqa: SIM115 - stays open as long as the run
        self._metrics.truncate(keep_bytes)
        self._metrics.seek(keep_bytes)
        self._append(b"".join(self._waiting))
        self._waiting.clear()

    def log(self, record: dict[str, Any]) -> None:
        """Append a record; before metrics.jsonl is open it waits."""
        line = json_text(record).encode()
        if self._metrics is None:
            self._waiting.append(line)
        else:
            self._append(line)

    def _append(self, data: bytes) -> None:
        with os_errors_name(self.path / "metrics.jsonl"):
            # a disk that is nearly full takes a part, and says so with the rest
            while data:
                data = data[self._metrics.write(data) :]

    def flush_metrics(self) -> int:
        """Hand all records to the operating system and return the length of the file."""
        self._metrics.flush()
        return self._metrics.tell()

    def close(self) -> None:
        """Close metrics.jsonl and give the lock back."""
        self._close_metrics()
        self._lock.release()

    def _close_metrics(self) -> None:
        if self._metrics is not None:
            self._metrics.close()
            self._metrics = None

    def write_stats(self, kind: str, step: int, stats: dict[str, Any]) -> None:
        """Write stats/{kind}_step{step}.json."""
        write_json(self.stats_path(kind, step), stats)

    def read_stats(self, kind: str, step: int) -> dict[str, Any] | None:
        """Read what `write_stats` wrote, or None."""
        path = self.stats_path(kind, step)
        return read_json(path, "remove the file to measure again") if path.is_file() else None

    def stats_path(self, kind: str, step: int) -> Path:
        """Return the name of a stats file."""
        return self.path / "stats" / f"{kind}_step{step:04d}.json"

    def write_arrays(self, stem: str, **arrays: Any) -> None:
        """Write report_data/{stem}.npz."""
        write_atomically(self.path / "report_data" / f"{stem}.npz", lambda file: np.savez_compressed(file, **arrays))

    def write_opacities(self, step: int, opacities: np.ndarray) -> None:
        """Write the histogram of opacities after a step; -1 for before the first."""
        counts, edges = np.histogram(opacities, bins=OPACITY_BINS, range=(0.0, 1.0))
        self.write_arrays(f"opacity_step{step}", step=step, counts=counts, edges=edges)


def read_config(folder: Path) -> TrainConfig:
    """Read cfg.json.

    Raises:
        PopError: it is absent or damaged, or a setting in it is unknown or out of range; names file and field.
    """
    path = folder / "cfg.json"
    if not folder.exists():
        raise PopError(f"{folder}: no such file or folder; give a result of 'pop train'")
    if not path.is_file():
        raise PopError(f"{folder}: has no cfg.json, so it is not a result of 'pop train'")
    try:
        return TrainConfig.from_json(path.read_text(encoding="utf-8"))
    except (PopError, UnicodeDecodeError) as error:
        raise PopError(f"{path}: {error}; repair the file, copy it again or train again") from error


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@dataclass(frozen=True)
class Segment:
    """Steps of one phase, taken one after the other, and the densification step after the last of them."""

    first: int  # number of the first step, from 0
    phase: Phase  # what they did
    views: list[str]  # name of the photograph of each step
    stats: list[StepStats]  # of each step
    densification: DensificationStep | None  # what density control did after the last, None where nothing was due
    before: int  # Gaussians that were trained
    after: int  # Gaussians after that
    seconds: float  # that all of it took, by the clock
    seconds_cpu: float  # of processor time, over all threads


def record_of(
    segment: Segment, step: int, config: TrainConfig, lr_means: float, seconds_before: float
) -> dict[str, Any] | None:
    """Make the record of a step, or None where none is due: every `log_every` steps there is one, and at every change.

    What the engine has not measured is left out.

    Args:
        lr_means: learning rate of the means at that step, world units.
        seconds_before: of training, before the segment.
    """
    place = step - segment.first
    stats, last = segment.stats[place], place + 1 == len(segment.stats)
    densification = segment.densification if last else None
    if step % config.log_every != 0 and densification is None:
        return None
    halved = 0.5 if segment.phase.objective.d_ssim_halved else 1.0
    measured = {
        segment.phase.objective.pixelwise: stats.pixelwise,
        "d_ssim": halved * (1.0 - stats.ssim),
        "psnr": -10.0 * math.log10(stats.square) if stats.square != 0.0 else math.inf,
        "n_blended": stats.n_blended,
        "n_traversed": stats.n_traversed,
    }
    return {
        "step": step,
        "view": segment.views[place],
        "loss": stats.objective + stats.pop,
        **{name: value for name, value in measured.items() if not math.isnan(value)},
        **({"pop": stats.pop} if segment.phase.pop or stats.pop != 0.0 else {}),
        "num_gaussians": segment.before if densification is None else segment.after,
        "sh_degree": segment.phase.sh_degree,
        "lr_means": lr_means,
        "it_per_s": len(segment.stats) / segment.seconds,
        "seconds": seconds_before + segment.seconds * (place + 1) / len(segment.stats),
        **({} if densification is None else densification.record()),
    }


@dataclass
class Times:
    """The times of a run, s."""

    loading: float = 0.0  # of reading the capture and of compiling, by the clock
    sfm: float = 0.0  # of searching for the capture's cameras before that, by the clock; 0 where they were there
    train: float = 0.0  # of steps and density control, by the clock
    cpu: float | None = 0.0  # of the same on the processor; None where a part of the run did not count it
    _started: float = 0.0

    def start(self) -> None:
        """Begin to count the total."""
        self._started = time.perf_counter()

    @property
    def total(self) -> float:
        """All since the start, by the clock, and what the run took before it was stopped."""
        return time.perf_counter() - self._started

    @contextmanager
    def is_loading(self) -> Iterator[None]:
        """Count what is done meanwhile as loading."""
        start = time.perf_counter()
        yield
        self.loading += time.perf_counter() - start

    def add(self, train: float, cpu: float) -> None:
        """Count some steps."""
        self.train += train
        if self.cpu is not None:
            self.cpu += cpu

    def facts(self, on_cpu: bool) -> dict[str, float]:
        """Give what goes with `seconds` and `seconds_total`: processor time is that of a training on a CPU."""
        counted = {"seconds_cpu": self.cpu} if on_cpu and self.cpu is not None else {}
        searched = {"seconds_sfm": self.sfm} if self.sfm else {}
        return {"seconds_loading": self.loading, **searched, **counted}

    def state_dict(self) -> dict[str, float | None]:
        """Give what a checkpoint keeps."""
        return {"train": self.train, "total": self.total, "cpu": self.cpu}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a checkpoint that `pop_fast.train.checkpoint` has let pass."""
        self.train, self.cpu = state["train"], state["cpu"]
        self._started -= state["total"]


COMMANDS_FILE: Final = "commands.json"
_FIX: Final = "remove the file: nothing but the report reads it"


def commands_text(earlier: Path | None, words: Sequence[str]) -> str:
    """Return what commands.json holds: what it held if a run is resumed, and a further command."""
    before = read_commands(earlier) if earlier is not None else []
    return json.dumps([*before, {"words": list(words), "folder": str(Path.cwd())}], indent=2) + "\n"


def read_commands(folder: Path) -> list[dict[str, Any]]:
    """Read the commands of a result folder and where they were given; PopError where commands.json is damaged."""
    path = folder / COMMANDS_FILE
    if not path.is_file():
        return []
    found = parse_json(path.read_text(encoding="utf-8", errors="replace"), f"{path}:", _FIX)
    if not isinstance(found, list) or not all(_is_command(entry) for entry in found):
        raise PopError(f"{path}: is not a list of commands, as 'pop train' writes it; {_FIX}")
    return found


def _is_command(entry: Any) -> bool:
    if not isinstance(entry, dict) or not isinstance(entry.get("folder"), str):
        return False
    words = entry.get("words")
    return isinstance(words, list) and all(isinstance(word, str) for word in words)
