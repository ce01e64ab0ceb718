"""Read the photographs that a model or a transforms.json lists, and make pinhole views of them.

A photograph is decoded, composited over the background where it has alpha, undistorted at its stored size, and then
shrunk by averaging areas. K follows exactly: K of a photograph stored at another size than its camera's is scaled by
the ratio of the two, each photograph by its own, and K of the shrunk image by the ratio of the sizes in whole pixels.

A photograph of any camera model becomes one of a pinhole camera with the same principal point. For a pixel centre p of
the new image, d = K^-1 p is its ray and x = camera.img_from_cam(d) is where the photograph shows it; the new image is
the photograph sampled there (bilinear, as COLMAP and gsplat). The new K keeps the principal point exactly and both
focal lengths' ratio; one zoom factor is applied to them, the smallest one with which every new pixel is inside the
photograph. It is 1, and the photograph is returned as it is, bit for bit, where there is no distortion. Pixel centres
are at +0.5, as COLMAP's are.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from os.path import splitext
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from PIL import Image

from pop_fast.data.camera_models import known_model
from pop_fast.data.cameras import make_camera
from pop_fast.data.capture import PosedImage, Progress, View
from pop_fast.errors import CaptureError
from pop_fast.io.image_header import read_size
from pop_fast.io.images import IMAGE_SUFFIXES, find_image, image_finder, in_threads, read_image, read_mask, sound_jpegs


@dataclass(frozen=True)
class PhotoOptions:
    """How photographs are read; see `pop_fast.data.load_capture`."""

    factor: int = 1
    masks: bool = True
    missing: Literal["error", "skip"] = "error"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    images: str | None = None
    resize: Literal["area", "bicubic"] = "area"
    # the list is a part of what its folder holds, so that masks may be there and none of them be its own
    part: bool = False


@dataclass(frozen=True)
class _Photo:
    shot: PosedImage
    path: Path
    mask: Path | None
    shrink: int


Wanted = Callable[[Sequence[PosedImage]], Sequence[bool]]


def read_views(
    root: Path,
    listing: Path,
    shots: Sequence[PosedImage],
    options: PhotoOptions,
    progress: Progress | None,
    wanted: Wanted | None = None,
) -> tuple[list[View], list[str]]:
    """Read all photographs of a list, several at a time.

    Args:
        root: the capture's folder.
        listing: the file that lists them, for messages.
        shots: what is listed.
        options: how to read them.
        progress: called after every photograph.
        wanted: tells whose photographs are read, None of all; of the others only the cameras are, and take no memory.

    Returns:
        Views in the order of the shots, and notes.
    """
    photos, notes = _locate(root, listing, shots, options)
    rectify = _rectifier()
    chosen = [True] * len(photos) if wanted is None else wanted([photo.shot for photo in photos])
    read = [photo.path for photo, out in zip(photos, chosen, strict=True) if out]
    what = "reading photographs" if read else "reading cameras"
    pairs = list(zip(photos, chosen, strict=True))
    with sound_jpegs(read):
        views = in_threads(
            lambda one: _read(one[0], options, rectify) if one[1] else _camera_alone(one[0], rectify),
            pairs,
            what,
            progress,
        )
    return views, notes


def _locate(
    root: Path, listing: Path, shots: Sequence[PosedImage], options: PhotoOptions
) -> tuple[list[_Photo], list[str]]:
    """Pair every listed name with its file and its mask, by name."""
    photos: list[_Photo] = []
    absent: list[tuple[PosedImage, Path]] = []
    folder = root / "masks" if options.masks and (root / "masks").is_dir() else None
    masks = find_masks(folder, shots) if options.masks else [None] * len(shots)
    elsewhere = names_elsewhere(shots)
    folders, find = _image_folders(root, shots, options), image_finder()
    for shot, mask in zip(shots, masks, strict=True):
        chosen, shrink = folders[shot.folder]
        names = [shot.file] if options.images is None else elsewhere(shot)
        path = _find_first(find, root / chosen, names)
        if path is None:
            absent.append((shot, root / chosen / names[-1]))
            continue
        photos.append(_Photo(shot, path, mask, shrink))
    twice = listed_twice([photo.shot for photo in photos], [photo.path for photo in photos])
    if twice is not None:
        raise CaptureError(f"{listing}: {twice}")
    if absent and (options.missing == "error" or not photos):
        raise CaptureError(
            f"{listing}: lists {len(shots)} images, {len(absent)} of them absent, first {absent[0][1]}; "
            f"{fix_of_absent(root, [shot for shot, _ in absent], shots)}"
        )
    if folder and not options.part and not any(photo.mask for photo in photos):
        raise CaptureError(
            f"{folder}: holds no mask named like a photograph (<name>.png or <name>.jpg.png); rename them"
        )
    notes = [f"{len(absent)} of {len(shots)} listed images are absent and were skipped"] if absent else []
    notes += _about_folders(root, shots, options)
    unmasked = [photo.path for photo in photos if photo.mask is None]
    if 0 < len(unmasked) < len(photos):
        notes.append(
            f"{len(unmasked)} of {len(photos)} photographs have no mask and count in full, first {unmasked[0]}"
        )
    return photos, notes


def names_elsewhere(shots: Sequence[PosedImage]) -> Callable[[PosedImage], list[str]]:
    """Tell under which names the mask of a shot of a list, or a copy of its photograph, is looked for in its folder.

    That of the file alone, where it is in one folder of the list only: cameras with a folder each name their
    photographs alike. Else, or besides, behind its folder's own name.
    """

    def stem(shot: PosedImage) -> str:
        # an extension is what files are not told apart by
        return splitext(shot.file)[0] if shot.file.lower().endswith(IMAGE_SUFFIXES) else shot.file

    folders = Counter(name for _, name in {(shot.folder, stem(shot)) for shot in shots})

    def names(shot: PosedImage) -> list[str]:
        last = Path(shot.folder).name
        alone = folders[stem(shot)] < 2 or not last
        return [*([shot.file] if alone else []), *([f"{last}/{shot.file}"] if last not in ("", "..") else [])]

    return names


def _find_first(find: Callable[[Path, str], Path | None], folder: Path, names: Sequence[str]) -> Path | None:
    return next((path for name in names if (path := find(folder, name)) is not None), None)


def find_photographs(root: Path, shots: Sequence[PosedImage], images: str | None = None) -> list[Path | None]:
    """Find the photographs of a list at their full size, in the folder `images` in place of the listed ones if given.

    None where one is absent.
    """
    find = image_finder()
    if images is None:
        return [find(root / shot.folder, shot.file) for shot in shots]
    elsewhere = names_elsewhere(shots)
    return [_find_first(find, root / images, elsewhere(shot)) for shot in shots]


def listed_twice(shots: Sequence[PosedImage], paths: Sequence[Path | None]) -> str | None:
    """Tell which photograph is listed under two names, as with its ending and without; None where there is none."""
    names: dict[Path, str] = {}
    for shot, path in zip(shots, paths, strict=True):
        if path is not None and names.setdefault(path, shot.name) != shot.name:
            return f"{names[path]} and {shot.name} are one photograph, {path}; remove one of them from the list"
    return None


def find_masks(folder: Path | None, shots: Sequence[PosedImage]) -> list[Path | None]:
    """Find the mask of each shot of a list: the one that the list names, else one in a folder of masks, if any."""
    elsewhere, find = names_elsewhere(shots), image_finder()
    return [shot.mask or (_find_first(find, folder, elsewhere(shot)) if folder else None) for shot in shots]


def fix_of_absent(root: Path, absent: Sequence[PosedImage], shots: Sequence[PosedImage]) -> str:
    """Say what helps against photographs that are not where their list says, of all shots that it lists.

    Where all are absent, the folder that holds one of that name: the capture's own, or one in it.
    """
    if len(absent) < len(shots):
        return "restore them or pass --missing skip"
    names = names_elsewhere(shots)(absent[0])
    for folder in (root, *sorted(path for path in root.iterdir() if path.is_dir())):
        if _find_first(find_image, folder, names) is not None:
            return f"{absent[0].file} lies in {folder}: pass --images {folder.relative_to(root).as_posix()}"
    return "restore them"


def _about_folders(root: Path, shots: Sequence[PosedImage], options: PhotoOptions) -> list[str]:
    """Tell which photographs a factor is met by: those that were made smaller before, or the large ones."""
    if options.factor == 1:
        return []
    read = set(_image_folders(root, shots, options).values())
    names = ", ".join(sorted(f"{chosen}/" for chosen, _ in read if chosen))
    whose = f"the photographs of {names}" if names else "the photographs"
    if all(shrink == 1 for _, shrink in read):
        return [f"{whose} are used, which were shrunk earlier; --images chooses others"]
    return [f"{whose} are shrunk by {options.factor} here"]


def _image_folders(root: Path, shots: Sequence[PosedImage], options: PhotoOptions) -> dict[str, tuple[str, int]]:
    """Choose the folder to read in place of each listed one, and by how much its photographs are still to be shrunk.

    The folder that was asked for; else `<folder>_<factor>` where it exists, unless the list has photographs of its own
    in there; else the listed folder, shrunk here.
    """
    factor, listed = options.factor, {shot.folder for shot in shots}
    # a shell that completes names ends them with a slash
    asked = Path(options.images).as_posix() if options.images else None
    found: dict[str, tuple[str, int]] = {}
    for folder in listed:
        small = f"{folder}_{factor}"
        shrunk_before = bool(folder) and factor > 1 and small not in listed and (root / small).is_dir()
        chosen = asked or (small if shrunk_before else folder)
        # the last letters of a listed folder's own name say nothing: `cam_2` is that of the second camera
        done = factor > 1 and (asked.endswith(f"_{factor}") if asked else shrunk_before)
        found[folder] = chosen, 1 if done else factor
    return found


def _rectifier() -> Any:
    """Make a function (camera, width, height) -> Undistortion that remembers the last few."""

    @lru_cache(maxsize=8)
    def remembered(
        model: str, params: tuple[float, ...], size: tuple[int, int], stored: tuple[int, int]
    ) -> Undistortion:
        return undistortion(make_camera(0, model, *size, list(params)), *stored)

    # the threads that read photographs of one camera would all begin with the same plan
    one_at_a_time = threading.Lock()

    def rectify(camera: Any, width: int, height: int) -> Undistortion:
        with one_at_a_time:
            return remembered(camera.model_name, tuple(camera.params), (camera.width, camera.height), (width, height))

    return rectify


def _read(photo: _Photo, options: PhotoOptions, rectify: Any) -> View:
    _check_header(photo)
    image = read_image(photo.path)
    height, width = image.shape[:2]
    rectification, size, K = _placed(photo, (width, height), rectify)
    alpha = None
    if image.shape[2] == 4:
        image, alpha = _over(image, options.background), np.ascontiguousarray(image[:, :, 3])
        alpha = rectification.image(alpha)
    image = rectification.image(image)
    mask = None
    if photo.mask is not None:
        mask = rectification.mask(read_fitting_mask(photo.mask, (width, height), photo.shot.turns))
        mask = _check_mask(photo.mask, _resize_mask(mask, size))
    if size != (width, height):
        image = _shrunk(image, size, options.resize)
        alpha = None if alpha is None else _shrunk(alpha, size, options.resize)
    view = View(photo.shot.name, image, photo.shot.viewmat, K, mask, photo.shot.split, alpha, seen=photo.shot.seen)
    return _upright(view, photo.shot.turns)


def camera_of(shot: PosedImage, stored: tuple[int, int]) -> Any:
    """Give the camera of a shot; by its field of view, where that alone is known, and its photograph's stored size."""
    if shot.camera is not None:
        return shot.camera
    width, height = stored
    focal = 0.5 * width / math.tan(0.5 * (shot.angle_x or 1.0))
    return make_camera(0, "PINHOLE", width, height, [focal, focal, width / 2, height / 2])


def _placed(photo: _Photo, stored: tuple[int, int], rectify: Any) -> tuple[Undistortion, tuple[int, int], np.ndarray]:
    """Find how a photograph of a stored size is undistorted, the size that it is used in, and K of that."""
    width, height = stored
    camera = camera_of(photo.shot, stored)
    _check_shape(photo.path, "the photograph", stored, "its camera", (camera.width, camera.height))
    try:
        rectification = rectify(camera, width, height)
    except ValueError as error:
        raise CaptureError(f"{photo.path}: its camera {camera.camera_id} {error}") from error
    size = (round(width / photo.shrink), round(height / photo.shrink))
    if min(size) < 1:
        raise CaptureError(f"{photo.path}: is {width}x{height} px, too small for factor {photo.shrink}; lower it")
    K = rectification.K.copy()
    if size != stored:
        K[:2] *= np.array([size[0] / width, size[1] / height])[:, None]
    return rectification, size, K


def _camera_alone(photo: _Photo, rectify: Any) -> View:
    """Make the view of a photograph whose header alone is read: its camera, and an image that takes no memory."""
    stored = read_size(photo.path)
    if stored is None:
        height, width = read_image(photo.path).shape[:2]
        stored = (width, height)
    _, (width, height), K = _placed(photo, stored, rectify)
    view = _upright(View(photo.shot.name, _blank(width, height), photo.shot.viewmat, K), photo.shot.turns)
    return replace(
        view, image=_blank(view.width, view.height), split=photo.shot.split, was_read=False, seen=photo.shot.seen
    )


def _blank(width: int, height: int) -> np.ndarray:
    return np.broadcast_to(np.zeros(3, np.uint8), (height, width, 3))


def _check_header(photo: _Photo) -> None:
    """Refuse a photograph or mask of another shape before it is decoded, which may take gigabytes."""
    size, camera = read_size(photo.path), photo.shot.camera
    if size is None:
        return
    if camera is not None and camera.width > 0 and camera.height > 0:
        _check_shape(photo.path, "the photograph", size, "its camera", (camera.width, camera.height))
    masked = None if photo.mask is None else read_size(photo.mask)
    if photo.mask is None or masked is None:
        return
    turned = photo.shot.turns % 2 == 1 and _same_shape((masked[1], masked[0]), size)
    if not turned:
        _check_shape(photo.mask, "the mask", masked, "its photograph", size)


def _upright(view: View, turns: int) -> View:
    """Turn a view clockwise by quarters: pixel (u, v) of an image of height H becomes (H - v, u)."""
    for _ in range(turns):
        K = view.K
        turned = np.array([[K[1, 1], 0.0, view.height - K[1, 2]], [0.0, K[0, 0], K[0, 2]], [0.0, 0.0, 1.0]])
        x, y, *rest = view.viewmat
        pixels = {name: getattr(view, name) for name in ("image", "mask", "alpha")}
        upright = {name: None if a is None else np.ascontiguousarray(np.rot90(a, -1)) for name, a in pixels.items()}
        view = replace(view, **upright, K=turned, viewmat=np.stack([-y, x, *rest]))
    return view


def _check_shape(path: Path, what: str, size: tuple[int, int], whose: str, other: tuple[int, int]) -> None:
    """Accept another size, but only of the same shape to within a pixel of rounding."""
    if not _same_shape(size, other):
        raise CaptureError(
            f"{path}: {what} is {size[0]}x{size[1]} px but {whose} is {other[0]}x{other[1]}, another shape; "
            "use the photographs that the poses were made from, neither cropped nor rotated"
        )


def _same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    off_width = abs(size[0] - other[0] * size[1] / max(other[1], 1))
    off_height = abs(size[1] - other[1] * size[0] / max(other[0], 1))
    return min(off_width, off_height) <= 1.0


def _over(rgba: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """Composite over the background: alpha * rgb + (1 - alpha) * background, rounded. uint8 [H, W, 3]"""
    alpha = rgba[:, :, 3:].astype(np.float32) / 255.0
    mixed = alpha * rgba[:, :, :3] + (1.0 - alpha) * (255.0 * np.asarray(background, np.float32))
    return np.rint(mixed).astype(np.uint8)


def read_fitting_mask(path: Path, stored: tuple[int, int], turns: int) -> np.ndarray:
    """Read the mask of a photograph of a stored size; a CaptureError says that it does not fit, or hides everything."""
    mask = read_mask(path)
    height, width = mask.shape
    if turns % 2 and not _same_shape((width, height), stored) and _same_shape((height, width), stored):
        # drawn over the photograph as viewers show it
        mask = np.ascontiguousarray(np.rot90(mask, turns))
    _check_shape(path, "the mask", (mask.shape[1], mask.shape[0]), "its photograph", stored)
    return _check_mask(path, _resize_mask(mask, stored))


def _check_mask(path: Path, mask: np.ndarray) -> np.ndarray:
    if not mask.any():
        raise CaptureError(
            f"{path}: the mask hides the whole photograph; white means keep (255, not 1): invert it or remove it"
        )
    return mask


def shrink_bicubic(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize uint8 [H, W, C] as Pillow does, and so gsplat's example trainer for the photographs of Mip-NeRF 360 (A32).

    Rows are resized first, and rounded to bytes before columns are: which of the two one call of Pillow takes first
    depends on its version and the sizes, and a few values with it by one level.
    """
    rows = Image.fromarray(image).resize((size[0], image.shape[0]), Image.Resampling.BICUBIC)
    return np.array(rows.resize(size, Image.Resampling.BICUBIC))


def _shrunk(image: np.ndarray, size: tuple[int, int], resize: Literal["area", "bicubic"]) -> np.ndarray:
    if resize == "bicubic":
        return shrink_bicubic(image, size)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _resize_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5


# a wide lens may be opened up to twice its focal length's field of view, a strong pincushion closed to a quarter
_ZOOMS = (0.5, 4.0)
# what counts as no distortion at all, px, and as inside the photograph, in widths or heights of it
_IDENTITY = 1e-7
_SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class Undistortion:
    """A resampling of photographs of one camera at one size."""

    K: np.ndarray  # intrinsics of the pinhole camera, px. float64 [3, 3]
    # where to sample the photograph, px with centres at integers; None for the identity. 2 x float32 [H, W]
    maps: tuple[np.ndarray, np.ndarray] | None

    def image(self, image: np.ndarray) -> np.ndarray:
        """Resample a photograph. uint8 [H, W, D] -> uint8 [H, W, D]"""
        if self.maps is None:
            return image
        return cv2.remap(image, *self.maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Resample a mask: the nearest pixel decides. bool [H, W] -> bool [H, W]"""
        if self.maps is None:
            return mask
        near = cv2.remap(
            mask.astype(np.uint8), *self.maps, interpolation=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
        )
        return near.astype(bool)


def intrinsics(camera: Any) -> np.ndarray:
    """Read the pinhole part of a camera: focal lengths and principal point, px. float64 [3, 3]"""
    K = np.eye(3)
    K[0, 0], K[1, 1] = camera.focal_length_x, camera.focal_length_y
    K[0, 2], K[1, 2] = camera.principal_point_x, camera.principal_point_y
    return K


def undistortion(camera: Any, width: int, height: int) -> Undistortion:
    """Plan the undistortion of photographs stored at width x height px, whatever size the camera was calibrated at.

    Raises:
        ValueError: a model that is refused, or no zoom between 0.5 and 4 keeps the new image inside the photograph. The
            message continues "camera <id> ...".
    """
    known = known_model(camera.model_name)
    if known is not None and known.refusal is not None:
        raise ValueError(f"is {known.name}, {known.refusal}")
    resize = np.array([width / camera.width, height / camera.height])
    K = intrinsics(camera)
    K[:2] *= resize[:, None]

    def source(points: np.ndarray, zoom: float) -> np.ndarray:
        rays = np.ones((len(points), 3))
        rays[:, :2] = (points - K[:2, 2]) / (np.array([K[0, 0], K[1, 1]]) * zoom)
        return camera.img_from_cam(rays) * resize

    fan = _fan(width, height, K[:2, 2])
    if np.abs(source(fan.reshape(-1, 2), 1.0) - fan.reshape(-1, 2)).max() < _IDENTITY:
        return Undistortion(K, None)
    zoom = _smallest_zoom(lambda z: _fits(source(fan.reshape(-1, 2), z).reshape(fan.shape), K[:2, 2], width, height))
    if zoom is None:
        raise ValueError(
            f"({camera.model_name}) has distortion {camera.params.tolist()} that folds the image over itself; "
            "calibrate it again, or undistort the photographs first"
        )
    maps = np.empty((2, height, width), np.float32)
    points = np.empty((width, 2))
    points[:, 0] = np.arange(width) + 0.5
    # row by row, which stays in the processor's cache
    for row in range(height):
        points[:, 1] = row + 0.5
        # opencv's remap puts pixel centres at integers
        maps[:, row] = (source(points, zoom) - 0.5).T
    K[0, 0] *= zoom
    K[1, 1] *= zoom
    return Undistortion(K, (maps[0], maps[1]))


def _fan(width: int, height: int, center: np.ndarray, steps: int = 48, along: int = 24) -> np.ndarray:
    """Points on straight lines from the principal point to the outline, corners included. float64 [along, M, 2]"""
    s = np.linspace(0.0, 1.0, steps + 1)
    o, one = np.zeros_like(s), np.ones_like(s)
    sides = [np.stack(side, axis=1) for side in ((s, o), (s, one), (o, s), (one, s))]
    outline = np.concatenate(sides) * np.array([width, height])
    fractions = np.linspace(0.0, 1.0, along + 1)[1:, None, None]
    return center + fractions * (outline - center)


def _fits(fan: np.ndarray, center: np.ndarray, width: int, height: int) -> bool:
    """Tell whether a fan's image is inside the photograph and never turns back towards the centre.

    Without the second condition a polynomial that bends back far outside, as they all do somewhere, would look inside.
    """
    outline = fan[-1] / np.array([width, height])
    # a comparison with NaN is false: rays that the model cannot project do not fit
    inside = np.all((outline >= -_SLACK) & (outline <= 1.0 + _SLACK))
    radii = np.linalg.norm(fan - center, axis=-1)
    return bool(inside and np.all(np.diff(radii, axis=0) >= 0.0))


def _smallest_zoom(fits: Callable[[float], bool], steps: int = 40) -> float | None:
    low, high = _ZOOMS
    if fits(low):
        return low
    if not fits(high):
        return None
    for _ in range(steps):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
