"""Whether a scene's photographs are those of the protocol: which are there, how many, how large, how they are split."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from paper_repro.jobs import Job
from paper_repro.scenes import DATASETS, PaperScene, find_folder, source_of
from pop_fast.errors import CaptureError, PopError

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train import TrainConfig

# every n-th photograph by name is measured and not trained on
HOLD_OUT: Final = 8
# a photograph that is shrunk by a whole number is cut or rounded to whole pixels
_ROUNDING: Final = 2
Status = Literal["ok", "missing", "refused"]


@dataclass(frozen=True)
class Found:
    """What was found of a scene."""

    scene: PaperScene  # the scene
    status: Status  # "ok", "missing" (not there) or "refused" (there, and not as the protocol has it)
    reason: str  # what is wrong and how to fix it; empty for nothing
    folder: Path | None = None  # where it is
    n_images: int = 0  # photographs with a known camera
    sizes: tuple[tuple[int, int], ...] = ()  # their widths and heights, px, the most frequent first

    @property
    def n_test(self) -> int:
        """Photographs that are held out."""
        return -(-self.n_images // HOLD_OUT)


def check_scene(scene: PaperScene, root: Path) -> Found:
    """Look at a scene's files under a data root, the headers of its photographs and its camera model among them."""
    try:
        folder = find_folder(scene, root)
    except PopError as error:
        return Found(scene, "missing", str(error))
    try:
        listed, own_split, cameras = _listing(folder)
        photographs = _photographs(scene, folder, listed)
        with ThreadPoolExecutor(8) as pool:
            sizes = list(pool.map(_size, photographs))
    except (CaptureError, OSError) as error:
        return Found(scene, "refused", f"{error}; it comes from {source_of(scene)}", folder)
    counted = tuple(size for size, _ in Counter(sizes).most_common())
    reason = (
        _wrong_split(scene, own_split, len(listed))
        or _wrong_ratio(scene, cameras, sizes)
        or _wrong_size(scene, counted, 1)
    )
    return Found(scene, "refused" if reason else "ok", reason or "", folder, len(listed), counted)


def check_capture(job: Job, config: TrainConfig, capture: Capture) -> None:
    """Refuse a capture that is not its scene, before it is trained on.

    Args:
        job: the training.
        config: its settings.
        capture: as it was loaded.

    Raises:
        PopError: the split, the number or the size of the photographs is not that of the protocol; names scene and fix.
    """
    held_out = [view.name for view in capture.views][::HOLD_OUT]
    own = [view.name for view in capture.test_views(config.test_every)] != held_out
    sizes = tuple(size for size, _ in Counter((view.width, view.height) for view in capture.views).most_common())
    reason = _wrong_split(job.scene, own, len(capture.views)) or _wrong_size(job.scene, sizes, job.factor)
    if reason is not None:
        raise PopError(f"{config.data}: {reason}")


def table(found: Sequence[Found], root: Path) -> list[str]:
    """Write what was found as lines for people: the scenes of a dataset together, then where the absent ones are from.

    Args:
        found: of `check_scene`.
        root: the data root.
    """
    lines: list[str] = []
    for key, dataset in DATASETS.items():
        of_it = [item for item in found if item.scene.dataset == key]
        if not of_it:
            continue
        lines += [*([""] if lines else []), dataset.name]
        for item in of_it:
            lines.append(f"  {item.scene.name:<12} {item.status:<8} {_counts(item)}")
            notes = [item.reason if item.status == "refused" else "", item.scene.note]
            lines += [f"    {note}" for note in notes if note]
        absent = [item.scene for item in of_it if item.status == "missing"]
        for source in dict.fromkeys(map(source_of, absent)):
            names = ", ".join(scene.name for scene in absent if source_of(scene) == source)
            lines.append(f"  {names}: from {source}")
        if absent:
            places = ", ".join((root / parent / "NAME").as_posix() for parent in dataset.parents)
            lines.append(f"  looked for in {places}")
    if any(not item.scene.verified for item in found):
        lines += ["", "~ recalled from the publication; not compared with the photographs for this table"]
    return lines


def _counts(item: Found) -> str:
    scene = item.scene
    if item.status == "ok":
        width, height = item.sizes[0]
        return f"{item.n_images} photographs, {item.n_test} held out, {width} x {height}  {item.folder}"
    doubt = "" if scene.verified else "~"
    width, height = scene.size
    return (
        f"expected: {doubt}{scene.n_images} photographs, {-(-scene.n_images // HOLD_OUT)} held out, {width} x {height}"
    )


def _listing(folder: Path) -> tuple[list[str], bool, list[tuple[int, int]]]:
    """Read the names that a camera model lists, whether it has a split of its own, and its images' sizes."""
    from pop_fast.data.colmap import find_model, read_model
    from pop_fast.data.exports import find_transforms, read_transforms

    model = find_model(folder)
    if model is not None:
        shots, _ = read_model(model)
    else:
        found = find_transforms(folder)
        if not found:
            raise CaptureError(f"{folder}: has no camera model in sparse/0 and no transforms.json")
        shots = read_transforms(found)[0]
    shots = sorted(shots, key=lambda shot: shot.name)
    cameras = [(int(shot.camera.width), int(shot.camera.height)) for shot in shots if shot.camera is not None]
    return [f"{shot.folder}/{shot.file}" for shot in shots], any(shot.split for shot in shots), cameras


def _photographs(scene: PaperScene, folder: Path, listed: Sequence[str]) -> list[Path]:
    from pop_fast.io.images import find_image

    if scene.images is not None:
        if not (folder / scene.images).is_dir():
            raise CaptureError(
                f"{folder / scene.images}: is absent; the protocol takes the photographs of this folder, and none that "
                "were shrunk otherwise"
            )
        listed = [f"{scene.images}/{name.split('/', 1)[1]}" for name in listed]
    found = [(name, find_image(folder, name)) for name in listed]
    absent = [name for name, path in found if path is None]
    if absent:
        raise CaptureError(
            f"{folder}: {len(absent)} of {len(listed)} photographs are absent, {absent[0]} the first, which moves the "
            "every-8th split"
        )
    return [path for _, path in found if path is not None]


def _size(path: Path) -> tuple[int, int]:
    from pop_fast.io.images import read_image

    height, width = read_image(path).shape[:2]
    return width, height


def _wrong_split(scene: PaperScene, own_split: bool, n_images: int) -> str | None:
    if own_split:
        return f"{scene.name} names a split of its own; the protocol holds out every {HOLD_OUT}th by name: remove it"
    if n_images != scene.n_images:
        return (
            f"{scene.name} has {n_images} photographs with a camera where {scene.n_images} are published"
            f"{_doubt(scene)}, so that every {HOLD_OUT}th would be others: get it again from {source_of(scene)}"
        )
    return None


def _wrong_ratio(scene: PaperScene, cameras: Sequence[tuple[int, int]], sizes: Sequence[tuple[int, int]]) -> str | None:
    for camera, size in zip(cameras, sizes, strict=False):
        if any(abs(n * scene.shrunk - m) > _ROUNDING * scene.shrunk for n, m in zip(size, camera, strict=True)):
            what = f"a photograph is {size[0]} x {size[1]} and its camera {camera[0]} x {camera[1]}"
            return (
                f"{scene.name}: {what}, and the protocol takes 1/{scene.shrunk} of that: "
                f"use {scene.images or 'the photographs'} as published"
            )
    return None


def _wrong_size(scene: PaperScene, sizes: Sequence[tuple[int, int]], factor: int) -> str | None:
    for size in sizes:
        wanted = [side / factor for side in scene.size]
        if any(abs(side - due) > _ROUNDING for side, due in zip(size, wanted, strict=True)):
            shown = " x ".join(f"{due:.0f}" for due in wanted)
            return (
                f"{scene.name} has photographs of {size[0]} x {size[1]} where the protocol has {shown}{_doubt(scene)}: "
                f"get it again from {source_of(scene)}"
            )
    return None


def _doubt(scene: PaperScene) -> str:
    return "" if scene.verified else " (recalled; not compared with the photographs here)"
