"""Load a capture, whatever made it: a COLMAP model, other programs' cameras, a bare folder of photographs; or a block.

Where a capture brings no points to start from, they are drawn: uniform in the cube around the cameras, where two look.

A block is of a capture that is too large for one training: a list of some of its photographs, and points of its own.

    block.json    the capture's folder, its training frame, and the photographs with their cameras and splits
    points.npz    xyz (float64 [P, 3], the capture's own frame) and rgb (uint8 [P, 3])

No photograph is copied, and the capture's own list is not read again, so that what a block's training needs grows with
the block alone.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from os.path import splitext
from pathlib import Path
from shlex import quote
from typing import Any, Final, Literal, TypeVar
from zipfile import is_zipfile

import numpy as np

from pop_fast.data.cameras import Numbers, check_size, make_camera
from pop_fast.data.capture import (
    Capture,
    Listing,
    PosedImage,
    Progress,
    SfmOptions,
    Source,
    SparsePoints,
    View,
    camera_centers,
    held_out,
    normalizing_transform,
    transform_points,
    transform_viewmats,
)
from pop_fast.data.colmap import find_models, read_model
from pop_fast.data.exports import EXPORTS, find_transforms, read_export, read_transforms
from pop_fast.data.read_images import PhotoOptions, read_views
from pop_fast.data.sfm import photo_folder, photographs, read_upright, run_sfm
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.atomic import write_atomically, write_json
from pop_fast.io.image_header import read_size
from pop_fast.io.images import VIDEO_SUFFIXES, composed, find_image, list_images, unreadable_photographs
from pop_fast.io.read_back import read_arrays, read_json

# the mean of the cameras' viewing directions, as unit vectors, is this long where they all look about the same way
_SAME_WAY = 0.9
# photographs that a line names
_NAMED = 12
# of the distances between cameras: beyond it, a thousandth of a pixel is all that a point moves between photographs
_OUTLIER: Final = 1e6
MODEL: Final = "COLMAP model"  # what a list is made from, as a line says it
# what a transforms.json may say besides cameras
_MORE_THAN_CAMERAS: Final = ("mask_path", "train_filenames", "val_filenames", "test_filenames")
# made where a capture brings none
RANDOM_POINTS: Final = 30_000
_ADD_POINTS: Final = "add points: run pop sfm on the photographs, or name a PLY file as ply_file_path"


def about_other_models(root: Path, models: Sequence[tuple[Path, int]]) -> list[str]:
    """Tell which models were passed over for the first, with their numbers of images (-1: unreadable)."""
    if len(models) < 2:
        return []
    listed = [f"{path.relative_to(root)} ({count if count >= 0 else 'unreadable'})" for path, count in models]
    return [
        f"of {len(models)} COLMAP models the one with the most images is used, {listed[0]}, not {', '.join(listed[1:])}"
    ]


def about_unplaced(folder: Path, shots: Sequence[PosedImage]) -> tuple[int, list[str]]:
    """Count the photographs of a folder that have no camera among the shots that the model lists, and tell which."""
    # by stem too, because a photograph may have been converted since the model was made
    placed = {composed(name) for shot in shots for name in (shot.file, splitext(shot.file)[0])}
    names = [path.relative_to(folder).as_posix() for path in photographs(folder)]
    left = [name for name in names if not placed & {composed(name), composed(splitext(name)[0])}]
    if not left:
        return 0, []
    more = f" and {len(left) - _NAMED} more" if len(left) > _NAMED else ""
    return len(left), [
        f"{len(names) - len(left)} of {len(names)} photographs in {folder} are placed; the model has no camera for "
        f"{', '.join(left[:_NAMED])}{more}"
    ]


def about_random_points(views: Sequence[View], made: int, wanted: int) -> list[str]:
    """Tell where random points can be expected to be poor: too few, or between cameras that all look away."""
    length = float(np.linalg.norm(np.mean([view.viewmat[2, :3] for view in views], axis=0)))
    if length > _SAME_WAY:
        return [
            f"all cameras look about the same way, so the {made:,} random points are near them, not on the scene; "
            f"{_ADD_POINTS}"
        ]
    if made < wanted:
        return [f"only {made:,} of {wanted:,} random points are where two cameras look; {_ADD_POINTS}"]
    return []


Photographs = Literal["all", "held out", "none"]


def load_capture(
    path: str | Path,
    factor: int = 1,
    normalize: bool = True,
    masks: bool = True,
    missing: Literal["error", "skip"] = "error",
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    progress: Progress | None = None,
    *,
    source: Source = "auto",
    images: str | None = None,
    resize: Literal["area", "bicubic"] = "area",
    sfm: bool | SfmOptions = False,
    points: int = RANDOM_POINTS,
    seed: int = 0,
    photographs: Photographs = "all",
    test_every: int = 8,
    listing: Listing | None = None,
) -> Capture:
    """Load photographs, cameras and sparse points of a capture.

    `source="auto"` takes the first that exists: a block of a larger capture (`block.json`); a COLMAP model (the
    largest in `sparse` and its subfolders, else in `colmap/sparse`, else the folder itself); `transforms.json` or
    Blender's `transforms_train.json`; the export of Polycam, Metashape (XML) or RealityCapture (CSV); a folder of
    photographs.

    Args:
        path: the capture's folder.
        factor: shrink photographs by this whole number; `images_<factor>` is read instead where it exists.
        normalize: move the world into gsplat's training frame; the way back is `Capture.world_transform`.
        masks: read `masks/<name>.png`, `masks/<name>.<ext>.png` or the list's `mask_path`; white means keep.
        missing: "error" or "skip" for photographs that are listed but absent.
        background: colour in [0, 1] behind photographs with alpha; alpha is transparency and not a mask.
        progress: called with (stage, done, total).
        source: the kind of capture to read; an error is raised if it does not exist.
        images: read photographs from this folder instead of the listed one, shrunk by `factor` unless its name ends in
            `_<factor>`.
        resize: "area" averages, "bicubic" equals Pillow's, which gsplat's example trainer uses (A32).
        sfm: find the cameras of a bare folder of photographs first, with these options, and write them to
            `<path>/sparse/0`.
        points: how many random points to make if the capture has none.
        seed: of the random points.
        photographs: which photographs are read. Of the other views only the cameras are read, which take no memory.
            With other values than "all" no random points are made.
        test_every: which views are held out; see `Capture.test_views`.
        listing: the result of an earlier `list_capture` of this capture, if there is one.

    Raises:
        CaptureError: one line that names the file, the field and the fix.
    """
    if factor < 1 or int(factor) != factor:
        raise CaptureError(f"factor is {factor}; it must be a whole number of at least 1")
    if missing not in ("error", "skip"):
        raise CaptureError(f"missing is {missing!r}; it must be 'error' or 'skip'")
    if resize not in ("area", "bicubic"):
        raise CaptureError(f"resize is {resize!r}; it must be 'area' or 'bicubic'")
    if len(background) != 3 or not all(0.0 <= c <= 1.0 for c in background):
        raise CaptureError(f"background is {tuple(background)}; it must be three numbers in [0, 1]")
    red, green, blue = map(float, background)
    listing = list_capture(path, source, images, sfm, progress) if listing is None else listing
    options = PhotoOptions(
        int(factor), masks, missing, (red, green, blue), images, resize, part=listing.made_from == BLOCK
    )

    def wanted(shots: Sequence[PosedImage]) -> list[bool]:
        if photographs == "none":
            return [False] * len(shots)
        in_order = sorted(shots, key=lambda shot: shot.name)
        out = held_out([shot.split for shot in in_order], test_every)
        names = {shot.name for shot, chosen in zip(in_order, out, strict=True) if chosen}
        return [shot.name in names for shot in shots]

    views, more = read_views(
        listing.root, listing.path, listing.shots, options, progress, None if photographs == "all" else wanted
    )
    if len(views) < 2:
        left = f"{len(views)} of {len(listing.shots)} photographs {'is' if len(views) == 1 else 'are'} left"
        raise CaptureError(f"{listing.path}: {left}; a scene needs two or more: restore them")
    whole = photographs == "all"
    listing = replace(listing, notes=[*listing.notes, *more])
    return _assemble(Path(path), listing, views, normalize, points if whole else 0, seed)


def list_capture(
    path: str | Path,
    source: Source = "auto",
    images: str | None = None,
    sfm: bool | SfmOptions = False,
    progress: Progress | None = None,
) -> Listing:
    """Read what a capture lists, and none of its photographs; see `load_capture`."""
    root = Path(path)
    listing = find_listing(root, source, images)
    if listing is None:
        listing = _without_outliers(_from_photos(root, images, sfm, progress))
    if len(listing.shots) < 2:
        count = "1 view" if listing.shots else "no views"
        raise CaptureError(f"{listing.path}: has {count} with a known camera; a scene needs two or more")
    return listing


def find_listing(root: Path, source: Source = "auto", images: str | None = None) -> Listing | None:
    """Read what says where a capture's photographs were taken, as training and `pop data check` both see it.

    Returns:
        None where nothing says so, but there are photographs that cameras can be found for.
    """
    _check_root(root)
    if source == "auto" and find_block(root):
        return read_block(root)
    listing = _read_listing(root, source, images)
    if listing is not None:
        others = _about_passed_over(root, listing) if source == "auto" else []
        return _without_outliers(replace(listing, notes=others + listing.notes))
    if source == "colmap":
        raise CaptureError(
            f"{root}: has no COLMAP model in sparse, sparse/0 or colmap/sparse/0; run pop sfm, or COLMAP"
        )
    if source == "transforms":
        raise CaptureError(f"{root}: has no transforms.json and no transforms_train.json; choose another --source")
    if source in EXPORTS:
        raise CaptureError(f"{root}: has no {EXPORTS[source][1]}; export it there, or choose another --source")
    folder = photo_folder(root)
    if source == "auto":
        refuse_several(root)
    if not photographs(folder):
        hint = unreadable_photographs(folder) or "give the folder of a capture"
        raise CaptureError(f"{root}: has no photographs, no COLMAP model and no transforms.json; {hint}")
    return None


def _read_listing(root: Path, source: Source, images: str | None) -> Listing | None:
    models = find_models(root) if source in ("auto", "colmap") else []
    if models:
        return _of_model(root, models, images)
    found = find_transforms(root) if source in ("auto", "transforms") else []
    if found:
        shots, cloud, notes = read_transforms(found)
        return Listing(root, found[0], shots, cloud, found[0].name, notes)
    return read_export(root, source, images)


def _lists(root: Path) -> dict[str, list[Path]]:
    """Find the lists of a capture's cameras, by their `source`, in the order in which "auto" takes the first."""
    found: dict[str, Sequence[Path | None]] = {
        "colmap": [path for path, _ in find_models(root)[:1]],
        "transforms": find_transforms(root),
        **{program: [find(root)] for program, (_, _, find, _) in EXPORTS.items()},
    }
    return {source: there for source, paths in found.items() if (there := [path for path in paths if path])}


def _about_passed_over(root: Path, used: Listing) -> list[str]:
    """Tell which lists of cameras "auto" has passed over, and what of theirs is left unused."""
    notes: list[str] = []
    for source, paths in list(_lists(root).items())[1:]:
        text = paths[0].read_text("utf-8", "replace") if source == "transforms" else ""
        fields = [name for name in _MORE_THAN_CAMERAS if f'"{name}"' in text]
        names = " and ".join(path.relative_to(root).as_posix() for path in paths)
        own = f" with the {', '.join(fields)} in it" if fields else ""
        notes.append(
            f"cameras are read from {used.path.relative_to(root).as_posix()}; {names} is left unused{own}: "
            f"--source {source} reads it instead"
        )
    return notes


def refuse_several(root: Path, besides: Path | None = None) -> None:
    """Refuse a folder with captures in it, whose photographs would be searched for cameras as those of one scene.

    They would be where the search takes subfolders, or where such a capture is of the photographs to be searched, as
    `dense` of a COLMAP workspace. What is written to `besides` is none of them.
    """
    photos = photo_folder(root)
    searched = {path.name for path in list_images(photos)}
    found: list[Path] = []
    for path in sorted(root.iterdir()):
        written = besides is not None and path.resolve() == besides.resolve()
        # as lost+found is, at the top of a disk
        closed = not os.access(path, os.R_OK | os.X_OK)
        if written or closed or path.name[0] == "." or not path.is_dir() or not _lists(path):
            continue
        own = {image.name for image in list_images(path)}
        if own and (photos in (root, path) or own & searched):
            found.append(path)
    if found:
        names = ", ".join(path.name for path in found[:_NAMED])
        what = f"captures in it have theirs ({names})" if len(found) > 1 else f"a capture in it has its own ({names})"
        raise CaptureError(
            f"{root}: has no cameras, but {what}; give one of these: pop train {quote(str(found[0]))}, or search all "
            "photographs as those of one scene with pop train --source photos"
        )


def _without_outliers(listing: Listing) -> Listing:
    """Leave out points that no camera can have measured, which would turn the training frame and stretch the scene."""
    if listing.cloud is None or len(listing.shots) < 2:
        return listing
    centers = camera_centers(np.stack([shot.viewmat for shot in listing.shots]))
    middle = np.median(centers, axis=0)
    spread = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    kept = np.linalg.norm(listing.cloud.xyz - middle, axis=1) <= _OUTLIER * spread
    left = len(kept) - int(kept.sum())
    if left == 0 or left == len(kept):
        return listing
    rows = np.cumsum(kept, dtype=np.int32) - 1
    seen = [None if shot.seen is None else rows[shot.seen[kept[shot.seen]]] for shot in listing.shots]
    shots = [replace(shot, seen=own) for shot, own in zip(listing.shots, seen, strict=True)]
    note = (
        f"{left:,} of {len(kept):,} sparse points left out: more than {_OUTLIER:,.0f} times as far away as the cameras "
        "are from each other"
    )
    cloud = SparsePoints(listing.cloud.xyz[kept], listing.cloud.rgb[kept])
    return replace(listing, shots=shots, cloud=cloud, notes=[*listing.notes, note])


def _check_root(root: Path) -> None:
    if root.is_dir():
        return
    if not root.exists():
        what = "file" if root.suffix.lower() in (*VIDEO_SUFFIXES, ".zip") else "folder"
        raise CaptureError(f"{root}: no such {what}; give the folder that holds the photographs")
    if root.suffix.lower() in VIDEO_SUFFIXES:
        raise CaptureError(f"{root}: is a video; take photographs out of it first: pop frames {root}")
    if is_zipfile(root):
        raise CaptureError(f"{root}: is a ZIP archive; unpack it first, and give the folder that it makes")
    raise CaptureError(f"{root}: is a file, not a folder; give the folder that holds the photographs")


def _of_model(root: Path, models: Sequence[tuple[Path, int]], images: str | None) -> Listing:
    model = models[0][0]
    listed, cloud = read_model(model)
    if len(listed) < 2:
        return Listing(root, model, listed, cloud, MODEL)
    shots = turned_upright(root, beside_the_model(root, listed, images), model)
    unplaced, which = about_unplaced(root / (images or shots[0].folder), shots)
    notes = about_other_models(root, models) + which
    return Listing(root, model, shots, cloud, MODEL, notes, unplaced=unplaced)


def beside_the_model(root: Path, shots: list[PosedImage], images: str | None) -> list[PosedImage]:
    """Look for a COLMAP model's photographs in `images`, or in the capture itself where they are not there.

    Names may begin with that folder, as `pop sfm` writes them of a capture that has one.
    """
    first = shots[0].file
    named = images is None and find_image(root / "images", first) is None and find_image(root, first) is not None
    if (root / (images or "images")).is_dir() and not named:
        return shots
    if images is None and any(find_image(root, shot.file) for shot in shots):
        return [replace(shot, folder="") for shot in shots]
    raise CaptureError(
        f"{root / (images or 'images')}: no such folder; name the one with the photographs: --images NAME"
    )


def turned_upright(root: Path, shots: list[PosedImage], model: Path) -> list[PosedImage]:
    """Note which photographs are to be turned, where the model is one that `run_sfm` made."""
    turns = read_upright(root / "sparse") if model == root / "sparse" / "0" else {}
    return [replace(shot, turns=turns.get(shot.file, 0)) for shot in shots] if turns else shots


def _from_photos(root: Path, images: str | None, sfm: bool | SfmOptions, progress: Progress | None) -> Listing:
    """Find the cameras of bare photographs, and read them."""
    photos = photo_folder(root)
    if not sfm:
        count = len(photographs(photos))
        raise CaptureError(f"{root}: has {count} photographs but no cameras; run pop sfm {root} first")
    start = time.perf_counter()
    options = sfm if isinstance(sfm, SfmOptions) else SfmOptions()
    found = run_sfm(photos, root, progress=progress, **asdict(options))
    seconds = time.perf_counter() - start
    listing = _of_model(root, [(root / "sparse" / "0", found.registered)], images)
    left = unreadable_photographs(photos)
    notes = [*found.notes, *([left] if left else []), *listing.notes]
    return replace(listing, notes=notes, sfm_seconds=seconds)


def check_factor(root: Path, factor: int, smallest: int = 1) -> None:
    """Refuse a factor that leaves nothing of bare photographs, by their headers, before their cameras are searched for.

    `smallest` is the side of the smallest photograph that can be used, px.
    """
    folder = photo_folder(root)
    if factor == 1 or (root / f"{folder.name}_{factor}").is_dir():
        return
    for path in photographs(folder):
        size = read_size(path)
        if size is not None and round(min(size) / factor) < smallest:
            raise CaptureError(
                f"{path}: is {size[0]}x{size[1]} px, too small for factor {factor}; use {min(size) // smallest} at most"
            )


def _assemble(root: Path, listing: Listing, views: list[View], normalize: bool, points: int, seed: int) -> Capture:
    cloud, made_from, notes = listing.cloud, listing.made_from, listing.notes
    try:
        transform = np.eye(4)
        if normalize:
            viewmats = np.stack([view.viewmat for view in views])
            transform = listing.transform
            if transform is None:
                transform = normalizing_transform(viewmats, cloud.xyz if cloud else None)
            moved = transform_viewmats(transform, viewmats)
            views = [replace(view, viewmat=viewmat) for view, viewmat in zip(views, moved, strict=True)]
        else:
            notes = notes + _about_origin(np.stack([view.camera_center for view in views]))
        if cloud:
            cloud = SparsePoints(transform_points(transform, cloud.xyz), cloud.rgb)
            source = f"{made_from}: {len(views)} views, {len(cloud)} points"
        elif points == 0:
            cloud = SparsePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
            source = f"{made_from}: {len(views)} views, no points"
        else:
            cloud = random_points(views, points, seed)
            notes = notes + about_random_points(views, len(cloud), points)
            source = f"{made_from}: {len(views)} views, no points: {len(cloud)} random ones (seed {seed})"
    except CaptureError as error:
        raise CaptureError(f"{listing.path}: {error}") from error
    name = root.resolve().name
    found = (listing.sfm_seconds, listing.unplaced)
    return Capture(name, tuple(views), cloud.xyz, cloud.rgb, source, transform, tuple(notes), *found)


def _about_origin(centers: np.ndarray) -> list[str]:
    """Tell that cameras stand so far from the origin that float32, in which scenes are trained, blurs their places."""
    farthest, apart = np.abs(centers).max(), np.linalg.norm(centers - np.median(centers, axis=0), axis=1).max()
    step = float(np.spacing(np.float32(farthest)))
    if step <= 1e-4 * apart:
        return []
    text = f"cameras stand {farthest:.2g} from the origin and {apart:.2g} from each other, where float32 has steps of"
    return [f"{text} {step:.2g}: leave out --no-normalize, which keeps these coordinates"]


_ROUNDS = 20


def random_points(views: Sequence[View], count: int = RANDOM_POINTS, seed: int = 0) -> SparsePoints:
    """Draw points uniformly from the cameras' bounding cube, and keep those in the pictures of two views or more.

    The cube stands around the bounding box of the camera centres, with that box's longest side. Every point gets the
    mean colour of the photographs.

    Raises:
        CaptureError: no two views look at a common part of the cube.
    """
    centers = np.stack([view.camera_center for view in views])
    middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
    half = 0.5 * float(np.ptp(centers, axis=0).max())
    generator = np.random.default_rng(seed)
    kept: list[np.ndarray] = []
    for _ in range(_ROUNDS):
        points = middle + half * generator.uniform(-1.0, 1.0, (count, 3))
        kept.append(points[sum(in_picture(points, view).astype(np.int64) for view in views) >= 2])
        if sum(map(len, kept)) >= count:
            break
    xyz = np.concatenate(kept)[:count]
    if len(xyz) == 0:
        raise CaptureError(
            "there are no points, and no two views look at the same part of the space around the cameras; correct the "
            f"poses, or {_ADD_POINTS}"
        )
    color = np.mean([view.image.mean(axis=(0, 1)) for view in views], axis=0)
    return SparsePoints(xyz, np.tile(np.rint(color).astype(np.uint8), (len(xyz), 1)))


def in_picture(points: np.ndarray, view: View) -> np.ndarray:
    """Tell which points a view has in front of it and inside its image, whatever may stand before them. bool [P]"""
    x, y, z = (points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).T
    # the image's edges as planes through the camera: no division, so points at z = 0 are harmless
    u = view.K[0, 0] * x + view.K[0, 2] * z
    v = view.K[1, 1] * y + view.K[1, 2] * z
    return (z > 0.0) & (u >= 0.0) & (u < view.width * z) & (v >= 0.0) & (v < view.height * z)


T = TypeVar("T")


BLOCK: Final = "block"  # what a list of a block says that it is made from
_BLOCK_LIST, _POINTS = "block.json", "points.npz"
_FIX: Final = "remove the folder with all blocks, and start 'pop train --blocks' again with --overwrite"


def find_block(folder: Path) -> bool:
    return (folder / _BLOCK_LIST).is_file()


def write_block(folder: Path, listing: Listing) -> None:
    """Write a block: its photographs are those of `listing.shots`, its points those of `listing.cloud`.

    All is in the capture's own frame, with the training frame of the whole capture as `listing.transform`.
    """
    cloud, transform = listing.cloud, listing.transform
    if cloud is None or transform is None:
        raise ValueError("a block has points and the training frame of its capture")
    content = {
        "capture": str(listing.root.absolute()),
        "transform": transform.tolist(),
        "photographs": [_entry(shot) for shot in listing.shots],
    }
    write_atomically(folder / _POINTS, lambda file: np.savez(file, xyz=cloud.xyz, rgb=cloud.rgb))
    # the list comes last: a folder that has it is whole
    write_json(folder / _BLOCK_LIST, content, indent=1)


def read_block(folder: Path) -> Listing:
    """Read a block; a CaptureError says that its capture is not where it was, or names a file that is damaged."""
    path, points = folder / _BLOCK_LIST, folder / _POINTS
    content = _refused_as_capture(lambda: read_json(path, _FIX))
    try:
        root = Path(content["capture"])
        transform = _matrix(content["transform"])
        shots = [_block_shot(entry) for entry in content["photographs"]]
    # pycolmap says what it does not know of a camera by errors of many kinds
    except Exception as error:
        raise CaptureError(f"{path}: is not what 'pop train --blocks' writes ({error!r}); {_FIX}") from error
    cloud = _points(points)
    # a name may be longer than the system takes, which Path's own question raises
    if not os.path.isdir(root):
        raise CaptureError(
            f"{path}: is a block of {str(root)[:200]}, which is not there; put the capture back, or {_FIX}"
        )
    return Listing(root, path, shots, cloud, BLOCK, transform=transform)


def _refused_as_capture(read: Callable[[], T]) -> T:
    try:
        return read()
    except PopError as error:
        raise CaptureError(str(error)) from error


def _points(path: Path) -> SparsePoints:
    arrays = _refused_as_capture(lambda: read_arrays(path, {"xyz": ("f", 2), "rgb": ("u", 2)}, _FIX))
    cloud = SparsePoints(arrays["xyz"].astype(np.float64), arrays["rgb"].astype(np.uint8))
    if cloud.xyz.shape[1] != 3 or cloud.rgb.shape != cloud.xyz.shape:
        shapes = f"xyz has shape {list(cloud.xyz.shape)}, rgb {list(cloud.rgb.shape)}"
        raise CaptureError(f"{path}: is not what 'pop train --blocks' writes ({shapes}); {_FIX}")
    if not np.isfinite(cloud.xyz).all():
        raise CaptureError(f"{path}: xyz has an entry that is not finite; {_FIX}")
    return cloud


def _entry(shot: PosedImage) -> dict[str, Any]:
    camera = shot.camera
    lens = None
    if camera is not None:
        size = {"width": int(camera.width), "height": int(camera.height)}
        params = list(map(float, camera.params))
        lens = {"id": int(camera.camera_id), "model": camera.model_name, **size, "params": params}
    return {
        "name": shot.name,
        "folder": shot.folder,
        "file": shot.file,
        "camera": lens,
        "viewmat": shot.viewmat.tolist(),
        "angle_x": shot.angle_x,
        "mask": None if shot.mask is None else str(shot.mask.absolute()),
        "split": shot.split,
        "turns": shot.turns,
    }


def _block_shot(entry: Any) -> PosedImage:
    lens = entry["camera"]
    camera = None
    texts = [entry[name] for name in ("name", "folder", "file")]
    if not all(isinstance(text, str) and "\0" not in text for text in texts):
        raise ValueError(f"name, folder and file are {texts}")
    if type(entry["turns"]) is not int or not 0 <= entry["turns"] <= 3:
        raise ValueError(f"turns is {entry['turns']!r}")
    if lens is not None:
        where = f"camera of {entry['name']}"
        read = Numbers(where, lens)
        width, height = check_size(where, read("width"), read("height"))
        params = [float(p) for p in lens["params"]]
        if not np.isfinite(params).all():
            raise ValueError(f"{where} has parameters that are not finite")
        camera = make_camera(lens["id"], lens["model"], width, height, params)
    shot = PosedImage(entry["name"], entry["folder"], entry["file"], camera, _matrix(entry["viewmat"]))
    mask = None if entry["mask"] is None else Path(entry["mask"])
    if entry["split"] not in ("train", "test"):
        raise ValueError(f"split is {entry['split']!r}")
    angle_x = None if entry["angle_x"] is None else Numbers(entry["name"], entry)("angle_x")
    return replace(shot, angle_x=angle_x, mask=mask, split=entry["split"], turns=entry["turns"])


def _matrix(rows: Any) -> np.ndarray:
    matrix = np.array(rows, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"a matrix has shape {list(matrix.shape)}, or entries that are not finite")
    return matrix
