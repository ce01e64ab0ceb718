"""What `pop eval`, `render` and `export` start from: a result, a checkpoint or a PLY, and the capture it shows."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pop_fast.data.capture import Source
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_ref.constants import NEAR_IN_CAPTURE_UNITS

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.data import Capture
    from pop_fast.data.capture import Progress
    from pop_fast.data.load import Photographs
    from pop_fast.io.ply import Frame

RECORD = "capture.json"


@dataclass(frozen=True, kw_only=True)
class Splat:
    """Gaussians and what is known about them."""

    path: Path  # the checkpoint or PLY that was read
    params: dict[str, Tensor]  # raw parameters
    config: TrainConfig  # the settings they were trained with; the defaults for a lone file
    step: int | None = None  # the last step taken, from 0; None for a lone PLY
    folder: Path | None = None  # the result folder it belongs to, if any
    frame: Frame | None = None  # the world it is in, where its file or its run says it

    @property
    def sh_degree(self) -> int:
        """The highest colour band to draw: all that the file has, or those that were active at its step."""
        degree = {0: 0, 3: 1, 8: 2, 15: 3}[self.params["shN"].shape[1]]
        if self.step is None or self.folder is None:
            return degree
        from pop_fast.train.schedule import active_sh_degree

        config = self.config
        degree = min(degree, config.sh_degree)
        return active_sh_degree(self.step, config.sh_interval, degree, config.strategy.sh_start_iter)


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Which photographs and cameras to use; what is not given is as in training."""

    capture: Path | None = None
    """The capture; by default the one it was trained on."""
    factor: int | None = None
    """Photographs are shrunk by this factor."""
    test_every: int | None = None
    """Every n-th view by file name is held out; of a capture that lists those views itself, the listed ones."""
    images: str | None = None
    """Read the photographs from this folder of the capture."""
    missing: Literal["error", "skip"] | None = None
    """What to do about photographs that are listed but absent."""
    own_frame: bool = False
    """The splat is in the capture's own world frame, whatever its file or its run says."""
    training_frame: bool = False
    """The splat is in the frame of training, as gsplat's trainer leaves it, and not in the capture's own world."""


@dataclass(frozen=True)
class CaptureRecord:
    """What `pop train` leaves in capture.json: how the capture was read, its training frame, and what was chosen."""

    images: str | None = None
    missing: Literal["error", "skip"] = "error"
    masks: bool = True
    source: Source = "auto"
    world_transform: list[list[float]] = field(default_factory=lambda: np.eye(4).tolist())
    chosen: list[str] = field(default_factory=list)


def how_to_load(config: TrainConfig, record: CaptureRecord) -> dict[str, Any]:
    """Return what `load_capture` is told of a run's capture, but for progress and which photographs are read."""
    of_run = ("factor", "normalize", "background", "resize", "seed", "test_every")
    own = {name: getattr(record, name) for name in ("masks", "missing", "source", "images")}
    return {**own, **{name: getattr(config, name) for name in of_run}}


def record_text(record: CaptureRecord) -> str:
    """Return what capture.json holds."""
    return json.dumps(asdict(record), indent=2) + "\n"


def read_record(folder: Path | None) -> CaptureRecord | None:
    """Read capture.json, or None where there is none; PopError where it is damaged."""
    path = folder / RECORD if folder else None
    if path is None or not path.is_file():
        return None
    try:
        record = CaptureRecord(**json.loads(path.read_text(encoding="utf-8")))
        if not isinstance(record.chosen, list) or not all(isinstance(line, str) for line in record.chosen):
            raise TypeError(f"chosen is {record.chosen!r}")
        transform = np.array(record.world_transform, np.float64)
        if transform.shape != (4, 4) or not np.isfinite(np.linalg.inv(transform)).all():
            raise TypeError(f"world_transform is {str(record.world_transform)[:60]}")
        return record
    except (ValueError, TypeError, RecursionError) as error:
        fix = "remove it, and say again how to read the capture (--images, --missing)"
        raise PopError(f"{path}: is not what 'pop train' writes ({error}); {fix}") from error


def load_splat(path: Path) -> Splat:
    """Read a result folder (its last checkpoint), a checkpoint (ours or gsplat's), a PLY or a splat of another format.

    Raises:
        PopError: none of these, or damaged.
    """
    from pop_fast.io.formats import is_splat_file, load_splat_file, readable_names
    from pop_fast.train.checkpoint import load_splats
    from pop_fast.train.results import read_config

    if path.is_dir():
        path = unbundled(path) or path
    if path.is_dir():
        return _from_folder(path)
    if not path.exists():
        raise PopError(f"{path}: no such file or folder; give a result folder, a checkpoint (.pt) or a PLY")
    folder = path.resolve().parent.parent
    owner = folder if (folder / "cfg.json").is_file() else None
    config = read_config(owner) if owner else TrainConfig()
    if is_splat_file(path):
        stored = load_splat_file(path)
        config = replace(config, antialiased=stored.antialiased)
        of_run = owner is not None and path.resolve().parent.name == "ply"
        frame = stored.frame or (_frame_of_run(config) if of_run else None)
        config = config if owner else drawn_as(config, stored.frame, path)
        return Splat(path=path, params=stored.params, config=config, folder=owner, frame=frame)
    if path.suffix.lower() == ".pt":
        params, step = load_splats(path)
        return Splat(path=path, params=params, config=config, step=step, folder=owner, frame=_frame_of_run(config))
    raise PopError(
        f"{path}: is neither a result folder nor a checkpoint (.pt) nor a splat ({', '.join(readable_names())})"
    )


def drawn_as(config: TrainConfig, frame: Frame | None, path: Path) -> TrainConfig:
    """Return settings to draw a lone file's splat by: the usual ones but for what it says."""
    said: Any = {} if frame is None else dict(frame.drawn)
    try:
        return replace(config, **said)
    except PopError as error:
        raise PopError(f"{path}: is to be drawn by settings that cannot be: {error}") from error


def unbundled(folder: Path) -> Path | None:
    """Return the meta.json of a folder that is SOG and no result."""
    from pop_fast.io.formats.sog import META

    return folder / META if (folder / META).is_file() and not (folder / "cfg.json").exists() else None


def _frame_of_run(config: TrainConfig) -> Frame:
    """Return the world that a run trains in."""
    from pop_fast.io.ply import Frame

    return Frame("training" if config.normalize else "capture")


def _from_folder(folder: Path) -> Splat:
    from pop_fast.io.ply import frame_of, load_ply
    from pop_fast.train.checkpoint import list_checkpoints, load_splats
    from pop_fast.train.results import read_config

    config = read_config(folder)
    checkpoints = list_checkpoints(folder)
    if checkpoints:
        params, step = load_splats(checkpoints[-1][1])
        frame = _frame_of_run(config)
        return Splat(path=checkpoints[-1][1], params=params, config=config, step=step, folder=folder, frame=frame)
    plys = sorted((folder / "ply").glob("point_cloud_*.ply"), key=lambda p: (len(p.name), p.name))
    if not plys:
        raise PopError(f"{folder}: holds no checkpoint and no PLY yet; train longer, or continue with --resume")
    frame = frame_of(plys[-1]) or _frame_of_run(config)
    return Splat(path=plys[-1], params=load_ply(plys[-1]), config=config, folder=folder, frame=frame)


def open_capture(
    splat: Splat, options: CaptureOptions, progress: Progress | None = None, photographs: Photographs = "all"
) -> tuple[Capture, TrainConfig]:
    """Load the capture that a splat shows, and give the settings to look at it with.

    Raises:
        PopError: no capture is known, or it cannot be read.
    """
    from pop_fast.data import load_capture

    record = read_record(splat.folder) or CaptureRecord()
    data = str(options.capture or splat.config.data)
    if not data:
        raise PopError(f"{splat.path}: its capture is unknown; give --capture DIR")
    if options.capture is None and not Path(data).is_dir():
        raise PopError(f"{splat.path}: was trained on {data}, which is missing; give --capture DIR")
    asked = {"factor": options.factor, "test_every": options.test_every}
    changes: dict[str, Any] = {"data": data, **{name: value for name, value in asked.items() if value is not None}}
    frame = frame_of_splat(splat, options)
    changes["normalize"] = frame == "training"
    if frame is None:
        taken = "does not state its frame, and is taken to be in the capture's own world"
        print(f"note: {splat.path}: {taken}; that of gsplat's trainer needs --training-frame", file=sys.stderr)
    config = _in_frame(replace(splat.config, **changes), splat)
    source = record.source if options.capture is None else "auto"
    said = {"missing": options.missing or record.missing, "images": options.images or record.images, "source": source}
    given = how_to_load(config, replace(record, **said))
    capture = load_capture(data, **given, progress=progress, photographs=photographs)
    if config.normalize:
        _check_same_frame(splat, capture)
    return capture, config


def _in_frame(config: TrainConfig, splat: Splat) -> TrainConfig:
    """Give the near plane of the frame that a splat is looked at in, where that is not the one it was trained in."""
    record, frame = read_record(splat.folder), splat.frame
    transform = None if frame is None else frame.transform
    if transform is None and frame is not None and record is not None and splat.config.normalize:
        transform = record.world_transform
    of_capture = config.near_plane is None and config.profile in NEAR_IN_CAPTURE_UNITS
    if config.normalize or transform is None or of_capture:
        return config
    scale = np.cbrt(np.linalg.det(np.array(transform)[:3, :3]))
    return replace(config, near_plane=config.renderer.near_plane / float(scale))


def frame_of_splat(splat: Splat, options: CaptureOptions) -> Literal["capture", "training"] | None:
    """Tell which world a splat is in: as the command says, else its file or its run.

    Returns:
        None where nothing says it; then it is taken to be in the capture's own, as every export is.

    Raises:
        PopError: the command says both.
    """
    if options.own_frame and options.training_frame:
        raise PopError("--own-frame and --training-frame exclude each other; choose one")
    if options.own_frame:
        return "capture"
    if options.training_frame:
        return "training"
    return None if splat.frame is None else splat.frame.name


def _check_same_frame(splat: Splat, capture: Capture) -> None:
    """Refuse, by PopError, a capture that is not normalized as the one that the splat was trained on."""
    if splat.frame is None or splat.frame.transform is None:
        return
    theirs, ours = np.array(splat.frame.transform), capture.world_transform
    # what a view of the scene's size would be off by, as a share of that size
    if not np.allclose(theirs, ours, rtol=1e-3, atol=1e-3):
        raise PopError(
            f"{splat.path}: was trained on a capture that normalizes differently from {capture.name}: other views, "
            "points or poses; give the capture that it was trained on, or pop export --frame capture and measure that"
        )


def paths_read(splat: Splat, root: Path, capture: Capture) -> list[Path]:
    """List what the rendering of a splat reads: it, its result folder, the capture and where its photographs lie.

    Returns:
        Files and folders; no output may take the place of one.
    """
    own = [splat.path] if splat.folder is None else [splat.path, splat.folder]
    # listed names may lead out of the capture, and so may its links
    listed = {(root / view.name).parent for view in capture.views}
    return [*own, root, *sorted(listed), *(entry for entry in sorted(root.iterdir()) if entry.is_symlink())]


def check_not_read(path: Path, splat: Splat) -> None:
    """Refuse to write in the place of a splat, or of what else was kept of its training."""
    kept = ("cfg.json", "capture.json", "metrics.jsonl", "ckpts", "ply") if splat.folder is not None else ()
    own = [splat.path, *((splat.folder or splat.path) / name for name in kept)]
    if path.exists() and any(path.resolve().is_relative_to(each.resolve()) for each in own):
        raise PopError(f"{path}: is read by this command, so it is not replaced; choose another name")
