"""What `pop eval`, `render` and `export` start from: a result, a checkpoint or a PLY, and the capture it shows."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from pop_fast.data.capture import Source, camera_centers, transform_viewmats
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_ref.constants import NEAR_IN_CAPTURE_UNITS

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.data import Capture
    from pop_fast.data.capture import Listing, Progress
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
class CameraRecord:
    """The camera of one photograph as a run was given it, in the capture's own world."""

    size: list[int]  # width and height of the photograph, px
    lens: list[float]  # focal lengths and principal point, px: fx, fy, cx, cy
    viewmat: list[list[float]]  # world -> camera, rigid. [4, 4]

    def is_sound(self) -> bool:
        """Tell whether these are the numbers of a camera; ValueError, TypeError or OverflowError of what are none."""
        numbers = [np.array(part, np.float64) for part in (self.size, self.lens, self.viewmat)]
        shapes = [part.shape for part in numbers] == [(2,), (4,), (4, 4)]
        return shapes and all(np.isfinite(part).all() for part in numbers) and bool(numbers[0].min() > 0.0)


@dataclass(frozen=True)
class CaptureRecord:
    """What `pop train` leaves in capture.json: how the capture was read, its training frame, what was chosen, cameras.

    Runs of versions before this one have no cameras there.
    """

    images: str | None = None
    missing: Literal["error", "skip"] = "error"
    masks: bool = True
    source: Source = "auto"
    world_transform: list[list[float]] = field(default_factory=lambda: np.eye(4).tolist())
    chosen: list[str] = field(default_factory=list)
    cameras: dict[str, CameraRecord] = field(default_factory=dict)  # by the names of the views


def how_to_load(config: TrainConfig, record: CaptureRecord) -> dict[str, Any]:
    """Return what `load_capture` is told of a run's capture, but for progress and which photographs are read."""
    of_run = ("factor", "normalize", "background", "resize", "seed", "test_every")
    own = {name: getattr(record, name) for name in ("masks", "missing", "source", "images")}
    return {**own, **{name: getattr(config, name) for name in of_run}}


def record_text(record: CaptureRecord) -> str:
    """Return what capture.json holds, with one line for each camera."""
    entries = asdict(record)
    cameras = [f"    {json.dumps(name)}: {json.dumps(camera)}" for name, camera in entries.pop("cameras").items()]
    text = json.dumps(entries, indent=2)
    if cameras:
        text = text.removesuffix("\n}") + ',\n  "cameras": {\n' + ",\n".join(cameras) + "\n  }\n}"
    return text + "\n"


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
        return replace(record, cameras=_read_cameras(record.cameras))
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        fix = "remove it, and say again how to read the capture (--images, --missing)"
        raise PopError(f"{path}: is not what 'pop train' writes ({error}); {fix}") from error


def _read_cameras(entries: Any) -> dict[str, CameraRecord]:
    if not isinstance(entries, dict):
        raise TypeError(f"cameras is {str(entries)[:60]}")
    found: dict[str, CameraRecord] = {}
    for name, entry in entries.items():
        try:
            found[name] = CameraRecord(**entry)
            sound = found[name].is_sound()
        except (ValueError, TypeError, OverflowError):
            sound = False
        if not sound:
            raise TypeError(f"cameras.{name[:60]} is {str(entry)[:60]}")
    return found


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
    record = read_record(splat.folder) or CaptureRecord()
    data = str(options.capture or splat.config.data)
    if not data:
        raise PopError(f"{splat.path}: its capture is unknown; give --capture DIR")
    if options.capture is None and not Path(data).is_dir():
        raise PopError(f"{splat.path}: was trained on {data}, which is missing; give --capture DIR")
    asked = {"factor": options.factor, "test_every": options.test_every}
    changes: dict[str, Any] = {"data": data, **{name: value for name, value in asked.items() if value is not None}}
    if frame_of_splat(splat, options) is None:
        taken = "does not state its frame, and is taken to be in the capture's own world"
        print(f"note: {splat.path}: {taken}; that of gsplat's trainer needs --training-frame", file=sys.stderr)
    config = replace(drawn_in_frame(splat, options), **changes)
    source = record.source if options.capture is None else "auto"
    said = {"missing": options.missing or record.missing, "images": options.images or record.images, "source": source}
    fix = "give the capture as it was (--capture DIR where it lies elsewhere), or train again"
    who = str(splat.folder or splat.path)
    capture = load_as_recorded(config, replace(record, **said), who, fix, progress, photographs)
    if config.normalize:
        _check_same_frame(splat, record, capture)
    return capture, config


def load_as_recorded(
    config: TrainConfig,
    record: CaptureRecord,
    who: str,
    fix: str,
    progress: Progress | None = None,
    photographs: Photographs = "all",
    listing: Listing | None = None,
) -> Capture:
    """Load the capture `config.data` in the world that a run was trained in, by what the run recorded of its cameras.

    The training frame is the recorded one, as photographs that were added or removed since would move it. Where nothing
    is recorded of the capture's cameras, it is normalized anew.

    Args:
        who: what the run is called in messages.
        fix: what is to be done about a capture that has changed.
        listing: what it lists, where that has been read.

    Raises:
        PopError: its cameras are others than those of the run, or it cannot be read.
    """
    from pop_fast.data.load import list_capture, load_capture

    if listing is None:
        listing = list_capture(config.data, record.source, record.images, progress=progress)
    known = _recorded_as([shot.name for shot in listing.shots], record.cameras)
    if known and not _is_identity(record.world_transform):
        listing = replace(listing, transform=np.array(record.world_transform))
    given = how_to_load(config, record)
    capture = load_capture(config.data, **given, progress=progress, photographs=photographs, listing=listing)
    found = _difference(capture, record.cameras)
    if found is not None:
        raise PopError(f"{config.data}: its cameras are not those that {who} was trained with: {found}; {fix}")
    return capture


def cameras_of(capture: Capture) -> dict[str, CameraRecord]:
    """Return what is recorded of a capture's cameras."""
    viewmats = _own_viewmats(capture)
    return {
        view.name: CameraRecord([view.width, view.height], _lens(view.K), viewmat.tolist())
        for view, viewmat in zip(capture.views, viewmats, strict=True)
    }


def _own_viewmats(capture: Capture) -> np.ndarray:
    """Return the cameras in the capture's own world. [V, 4, 4]"""
    return transform_viewmats(np.linalg.inv(capture.world_transform), np.stack([v.viewmat for v in capture.views]))


def _lens(K: np.ndarray) -> list[float]:
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]


def _recorded_as(names: Iterable[str], cameras: Mapping[str, CameraRecord]) -> dict[str, str]:
    """Find the recorded name of each view that has one.

    Sources name one photograph differently, as by its folder; where no name is as recorded, the names of the files are
    compared without their folders and endings, if these tell all apart.
    """
    names = list(names)
    same = {name: name for name in names if name in cameras}
    if same:
        return same
    by_stem = {PurePosixPath(name).stem: name for name in cameras}
    stems = {name: PurePosixPath(name).stem for name in names}
    if len(by_stem) < len(cameras) or len(set(stems.values())) < len(names):
        return {}
    return {name: by_stem[stem] for name, stem in stems.items() if stem in by_stem}


# what a camera may be off by: as a share of the cameras' distance from their middle, and radians
_MOVED: Final = 1e-3
# what a focal length or a principal point may be off by, as a share of the photograph's side; one pixel is added, as
# photographs that are shrunk have whole numbers of them
_OTHER_LENS: Final = 2e-3


def _difference(capture: Capture, cameras: Mapping[str, CameraRecord]) -> str | None:
    """Say in what the cameras of a capture differ from those that were recorded of the same photographs, if they do."""
    known = _recorded_as([view.name for view in capture.views], cameras)
    if not known:
        return None
    rows = [
        (view, own, cameras[known[view.name]])
        for view, own in zip(capture.views, _own_viewmats(capture), strict=True)
        if view.name in known
    ]
    ours = np.stack([own for _, own, _ in rows])
    theirs = np.array([camera.viewmat for _, _, camera in rows])
    every = camera_centers(np.array([camera.viewmat for camera in cameras.values()]))
    apart = float(np.median(np.linalg.norm(every - np.median(every, axis=0), axis=1))) or 1.0
    moved = np.linalg.norm(camera_centers(ours) - camera_centers(theirs), axis=1) > _MOVED * apart
    # the norm of the difference of two rotations is sqrt(2) times the angle between them, where that is small
    turned = np.linalg.norm(ours[:, :3, :3] - theirs[:, :3, :3], axis=(1, 2)) > np.sqrt(2.0) * _MOVED
    sizes = np.array([[[view.width, view.height] * 2, camera.size * 2] for view, _, camera in rows], np.float64)
    lenses = np.array([[_lens(view.K), camera.lens] for view, _, camera in rows]) / sizes
    allowed = _OTHER_LENS + 1.0 / sizes.min(axis=(1, 2))
    changed = np.abs(lenses[:, 0] - lenses[:, 1]).max(axis=1) > allowed
    for wrong, what in ((moved, "stands elsewhere"), (turned, "looks elsewhere"), (changed, "has another lens")):
        if wrong.any():
            count = f"{int((moved | turned | changed).sum())} of {len(rows)} cameras differ"
            return f"that of {rows[int(wrong.argmax())][0].name} {what} ({count})"
    return None


def _is_identity(transform: Any) -> bool:
    """Tell whether a record says no training frame, as of a run that moved nothing and of versions that wrote none."""
    return bool(np.array_equal(np.array(transform), np.eye(4)))


def drawn_in_frame(splat: Splat, options: CaptureOptions) -> TrainConfig:
    """Return the settings to draw a splat by in the world that it is in.

    Their near plane is of that world, where that is not the one that the splat was trained in.

    Raises:
        PopError: see `frame_of_splat`.
    """
    config = replace(splat.config, normalize=frame_of_splat(splat, options) == "training")
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


def _check_same_frame(splat: Splat, record: CaptureRecord, capture: Capture) -> None:
    """Refuse, by PopError, a capture that is not normalized as the one that the splat was trained on."""
    known = None if splat.frame is None else splat.frame.transform
    if known is None and splat.config.normalize and not _is_identity(record.world_transform):
        known = record.world_transform
    if known is None:
        return
    theirs, ours = np.array(known), capture.world_transform
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
