"""Structure from motion: find the cameras of a bare folder of photographs with pycolmap, on the CPU.

SIFT features, exhaustive matching of up to 60 photographs (beyond that every photograph with its neighbours by name),
incremental mapping. Every random choice is seeded and the largest model is kept.

Cameras are found for the pixels as they are stored, as COLMAP does. Which photographs a viewer would turn by their EXIF
orientation is written beside the model (`sparse/upright.json`), and `load_capture` turns these and their cameras.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pop_fast.data.capture import Progress
from pop_fast.data.colmap import quiet_colmap
from pop_fast.data.exports import photographs_of_polycam
from pop_fast.data.photo_quality import Shown, about_mixed_sizes, about_use, measure
from pop_fast.data.sfm_files import UPRIGHT, SfmOptions, recognise_result, write_list
from pop_fast.data.sfm_search import Search, check_camera_model, find_cameras
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import check_folder, folder_atomically
from pop_fast.io.image_header import HEIF_SUFFIXES, read_exif
from pop_fast.io.images import list_images, read_image, unreadable_photographs, write_png
from pop_fast.io.jpeg import sound_jpegs

__all__ = ["SfmResult", "photo_folder", "photographs", "run_sfm"]


@dataclass(frozen=True)
class SfmResult:
    """What structure from motion found.

    Attributes:
        capture: the folder that `load_capture` reads.
        registered: photographs whose camera was found.
        photographs: photographs that were given.
        points: sparse points.
        reprojection_error: mean, px.
        notes: what its owner may not know of the photographs, one line each.
    """

    capture: Path
    registered: int
    photographs: int
    points: int
    reprojection_error: float
    notes: tuple[str, ...] = ()


def photo_folder(root: Path) -> Path:
    """Find the photographs of a capture without cameras: its folder `images`, or the capture itself."""
    return root / "images" if (root / "images").is_dir() else root


def photographs(folder: Path) -> list[Path]:
    """List the photographs of a folder and its subfolders, sorted by relative name; `masks` holds none.

    Of a Polycam export only those that its cameras are of.
    """
    exported = photographs_of_polycam(folder)
    if exported is not None:
        return list_images(exported)
    return [path for path in list_images(folder) if path.relative_to(folder).parts[0] != "masks"]


def run_sfm(
    photo_dir: str | Path,
    out_dir: str | Path | None = None,
    progress: Progress | None = None,
    *,
    max_size: int = SfmOptions.max_size,
    camera_model: str = SfmOptions.camera_model,
    single_camera: bool | None = SfmOptions.single_camera,
    matcher: Literal["auto", "exhaustive", "sequential"] = SfmOptions.matcher,
    seed: int = SfmOptions.seed,
    overwrite: bool = False,
) -> SfmResult:
    """Find cameras and sparse points, and write them as a COLMAP capture, whole or not at all.

    Args:
        photo_dir: the photographs, in subfolders too.
        out_dir: the capture to make, with copies of the photographs in `images`. Without it, `sparse/0` is written
            beside the photographs: in the parent of a folder named `images`, else in `photo_dir` itself; and there too
            where `photo_dir` is given as `out_dir`.
        progress: called with (stage, done, total) while features, matches and cameras are found.
        max_size: as `SfmOptions`, and so the four below.
        camera_model: COLMAP's name.
        single_camera: all photographs share one camera; by default when they are all of one size.
        matcher: which photographs are compared.
        seed: of every random choice.
        overwrite: replace an existing result, where it is nothing but that.

    Raises:
        CaptureError: fewer than two photographs, a damaged one, no model that holds two of them, or a result that would
            take the place of photographs or of files that are not its own.
    """
    photos = Path(photo_dir)
    options = SfmOptions(
        max_size=max_size, camera_model=camera_model, single_camera=single_camera, matcher=matcher, seed=seed
    )
    if not photos.is_dir():
        raise CaptureError(f"{photos}: no such folder; give the folder with the photographs")
    check_camera_model(camera_model)
    capture, target = _place(photos, out_dir)
    names = [path.relative_to(photos) for path in photographs(photos) if not path.resolve().is_relative_to(target)]
    for name in names:
        if not _is_utf8(str(name)):
            raise CaptureError(
                f"{photos / name}: the name is not UTF-8, which COLMAP's files need; rename the photograph"
            )
    if len(names) < 2:
        hint = unreadable_photographs(photos) or "a scene needs two or more that overlap"
        raise CaptureError(f"{photos}: has {len(names)} photograph(s); {hint}")
    in_place = target != capture.resolve()
    own = recognise_result(capture.resolve(), target)
    check_folder(target, overwrite, recognise=own)
    shown = _looked_at(photos, names, progress)
    hopeless = [finding.text for finding in about_use(shown) if finding.state == "bad"]
    if hopeless:
        raise CaptureError(f"{photos}: {'; '.join(hopeless)}")
    mixed = about_mixed_sizes(shown)
    if single_camera is None:
        options = replace(options, single_camera=mixed is None)
    with folder_atomically(target, overwrite, recognise=own) as folder:
        sparse = folder if in_place else folder / "sparse"
        with tempfile.TemporaryDirectory(prefix="pop_sfm_") as work, quiet_colmap():
            job = _Job(photos, _stage(photos, names, Path(work)), Path(work), progress)
            best = _find_cameras(job, options)
            for image in best.images.values():
                image.name = names[int(Path(image.name).stem)].as_posix()
            (sparse / "0").mkdir(parents=True)
            best.write_binary(sparse / "0")
        if not in_place:
            for name in names:
                (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(photos / name, folder / "images" / name)
        _write_upright(sparse, photos, names)
        write_list(sparse, folder, "sparse/" if in_place else "")
    error = float(best.compute_mean_reprojection_error())
    notes = () if mixed is None or options.single_camera else (mixed.text,)
    return SfmResult(capture, best.num_reg_images(), len(names), best.num_points3D(), error, notes)


def _is_utf8(name: str) -> bool:
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True


def _place(photos: Path, out_dir: str | Path | None) -> tuple[Path, Path]:
    """Say where the capture is made, and which folder is replaced for it: `sparse` in place, else the whole capture."""
    given = photos.resolve()
    beside = given.parent if given.name == "images" else given
    capture = Path(out_dir) if out_dir is not None else beside
    in_place = capture.resolve() in (beside, given)
    if not in_place and given.is_relative_to(capture.resolve()):
        raise CaptureError(
            f"{capture}: holds the photographs of {photos}, which a new capture there would replace; "
            "choose another --out, or none to write sparse/0 beside them"
        )
    target = capture.resolve() / "sparse" if in_place else capture.resolve()
    return capture, target


@dataclass(frozen=True)
class _Job:
    photos: Path
    names: list[str]  # in `work / "images"`
    work: Path
    progress: Progress | None


def _stage(photos: Path, names: list[Path], work: Path) -> list[str]:
    """Give photographs plain numbers for names, because COLMAP's lists of pairs cannot hold a space."""
    (work / "images").mkdir()
    staged = [f"{i:06d}{_plain_suffix(name)}" for i, name in enumerate(names)]
    for name, plain in zip(names, staged, strict=True):
        if name.suffix.lower() in HEIF_SUFFIXES:
            # which COLMAP does not read
            write_png(work / "images" / plain, read_image(photos / name)[:, :, :3])
            continue
        try:
            (work / "images" / plain).symlink_to((photos / name).resolve())
        except OSError:  # where links need a privilege
            shutil.copyfile(photos / name, work / "images" / plain)
    return staged


def _plain_suffix(name: Path) -> str:
    suffix = name.suffix.lower()
    return ".png" if suffix in HEIF_SUFFIXES else suffix


def _looked_at(photos: Path, names: list[Path], progress: Progress | None) -> list[Shown]:
    """Read all photographs once: damaged and useless ones are found before the long work begins."""
    found: list[Shown] = []
    files = [photos / name for name in names]
    with sound_jpegs(files), ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        jobs = [
            pool.submit(lambda file, name: measure(file, read_image(file), name.as_posix()), file, name)
            for file, name in zip(files, names, strict=True)
        ]
        try:
            for job in jobs:
                found.append(job.result())
                if progress is not None:
                    progress("checking photographs", len(found), len(names))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return found


def _find_cameras(job: _Job, options: SfmOptions) -> Any:
    search = Search(
        photos=str(job.photos),
        work=str(job.work),
        names=job.names,
        camera_model=options.camera_model,
        single_camera=bool(options.single_camera),
        max_size=options.max_size,
        matcher=options.matcher,
        seed=options.seed,
    )
    return find_cameras(search, job.progress)


def _write_upright(sparse: Path, photos: Path, names: list[Path]) -> None:
    """Note which photographs their EXIF orientation asks to be turned, in quarter turns clockwise."""
    # a mirrored photograph is not what a camera sees, turned or not
    clockwise = {6: 1, 3: 2, 8: 3}
    turns = {name.as_posix(): clockwise.get(read_exif(photos / name).orientation, 0) for name in names}
    turned = {name: count for name, count in turns.items() if count}
    if turned:
        (sparse / UPRIGHT).write_text(json.dumps(turned, indent=1) + "\n", encoding="utf-8")
