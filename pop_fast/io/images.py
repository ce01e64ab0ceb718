"""Photographs and masks, found by name, checked and decoded with OpenCV as COLMAP does; pictures of arrays for pages.

EXIF orientation is ignored, because COLMAP ignores it: a model's width and height are those of the stored pixels.

Decoders fill damaged pixels of a JPEG file with gray or wrong colours, and OpenCV reports nothing: libjpeg itself
prints a line on standard error, which belongs to the whole process. So a process in which nothing else happens decodes
the files in turn, and announces each on standard error by a NUL and its number: then every line can be assigned to its
file.
"""

from __future__ import annotations

import base64
import os
import re
import struct
import subprocess
import sys
import tempfile
import threading
import unicodedata
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Final, TypeVar

import cv2
import numpy as np

from pop_fast.children import module_command
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.atomic import write_file
from pop_fast.io.image_header import (
    HEIF_SUFFIXES,
    INSTALL,
    LARGEST,
    as_stored,
    bytes_per_pixel,
    can_read_heif,
    decode_heif,
    heif_size,
    is_heif,
    size_of,
)
from pop_fast.io.read_back import PICTURE, check_memory

T = TypeVar("T")
R = TypeVar("R")

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
# what cameras and other programs write and no folder is searched for: HEIF without pillow-heif, and raw formats
_RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2")
_UNREADABLE = (*_RAW, ".avif", ".jxl", ".gif", ".jfif", ".jp2", ".exr")
VIDEO_SUFFIXES = (".mov", ".mp4", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
# what `pop train` writes tells a result
_OF_A_RESULT: Final = ("cfg.json", "capture.json")
FIX = "copy it again from its source, or remove it from the capture"


def readable_suffixes() -> tuple[str, ...]:
    """Return the endings of files that hold photographs which can be read here."""
    return (*IMAGE_SUFFIXES, *HEIF_SUFFIXES) if can_read_heif() else IMAGE_SUFFIXES


def list_images(folder: Path) -> list[Path]:
    """List the photographs of a folder and its subfolders, sorted by relative name; hidden files are left out."""
    found = _files_ending(readable_suffixes(), _visible(folder))
    return sorted(found, key=lambda path: path.relative_to(folder).as_posix())


def _visible(folder: Path, denied: list[OSError] | None = None) -> list[Path]:
    """List the files of a folder and its subfolders, which may be links to elsewhere.

    Left out is what is hidden, subfolders that are results of a training, and what the system does not show; why it
    does not is added to `denied`.
    """
    known, found = [folder.resolve()], list[Path]()
    for place, folders, files in os.walk(folder, onerror=None if denied is None else denied.append, followlinks=True):
        found += [Path(place, name) for name in files if name[0] != "."]
        folders[:] = [name for name in sorted(folders) if name[0] != "." and _leads_on(Path(place, name), known)]
    return found


def _leads_on(folder: Path, known: list[Path]) -> bool:
    """Tell whether a subfolder is to be listed.

    A link into, around or again to what is `known` would list files twice. The renders of a result are no photographs,
    and may lie among them, as `pop train .` writes `out` where it is called.
    """
    if all(os.path.isfile(folder / name) for name in _OF_A_RESULT):
        return False
    if not folder.is_symlink():
        return True
    target = folder.resolve()
    if any(target.is_relative_to(other) or other.is_relative_to(target) for other in known):
        return False
    known.append(target)
    return True


def _files_ending(suffixes: Sequence[str], paths: Sequence[Path]) -> list[Path]:
    return [path for path in paths if path.suffix.lower() in suffixes and path.is_file()]


def unreadable_photographs(folder: Path) -> str | None:
    """Say what of a folder `list_images` leaves out though it may hold photographs, and what to do; None if nothing.

    That is files in a format that is not read, videos, links to nothing, as to a disk that is not there, and subfolders
    that cannot be looked into; not what is hidden.
    """
    denied: list[OSError] = []
    found = _visible(folder, denied)
    gone = [path for path in found if path.is_symlink() and not path.exists()]
    unreadable = _UNREADABLE if can_read_heif() else (*_UNREADABLE, *HEIF_SUFFIXES)
    still = [path.suffix for path in _files_ending(unreadable, found)]
    moving = _files_ending(VIDEO_SUFFIXES, found)
    changes: list[str] = []
    if still:
        kind = max(set(still), key=still.count)
        what = f"{len(still)} files are" if len(still) > 1 else "1 file is"
        install = f"{INSTALL}, or " if kind.lower() in HEIF_SUFFIXES else ""
        changes.append(
            f"{what} {kind[1:].upper()} or the like, which is not read: {install}convert them to JPEG first, "
            f"for example with ImageMagick: magick mogrify -format jpg *{kind}"
        )
    if moving:
        what = f"{len(moving)} files are videos, which are" if len(moving) > 1 else "1 file is a video, which is"
        changes.append(
            f"{what} no photographs ({moving[0].name}): take sharp frames out first, "
            f"for example with pop frames {moving[0].name} --out photos"
        )
    if gone:
        what = f"{len(gone)} files are links" if len(gone) > 1 else "1 file is a link"
        where = f"{gone[0]} -> {os.readlink(gone[0])}"
        changes.append(f"{what} to nothing ({where}): make what they lead to reachable, or remove them")
    if denied:
        what = f"{len(denied)} folders are" if len(denied) > 1 else "1 folder is"
        first = denied[0]
        changes.append(
            f"{what} left out, as the system does not show what is inside ({first.filename}: {first.strerror}): "
            "change owner or mode where photographs are there"
        )
    return "; ".join(changes) or None


def composed(name: str) -> str:
    """Write a name as everywhere but on a Mac, whose files have an umlaut as two characters: a letter and its dots."""
    return unicodedata.normalize("NFC", name)


# the photographs of folders, by the part of their names before the ending
_Listed = dict[Path, dict[str, list[Path]]]


def find_image(folder: Path, name: str, listed: _Listed | None = None) -> Path | None:
    """Find the file of an image by its relative name, under another image extension where the exact one is absent.

    Files are paired by name and never by their place in a sorted list, so one missing file cannot shift the others. A
    CaptureError says that two files of the same stem fit and neither is the exact name. What is found of folders is
    added to `listed`, by which the next call need not look again.
    """
    exact = folder / name
    if exact.is_file():
        return exact
    if not exact.parent.is_dir():
        return None
    # nerfstudio and blender name frames with and without their extension, and raw photographs have been developed
    named = exact.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES, *_UNREADABLE)
    stems = {composed(stem) for stem in ({exact.stem, exact.name} if named else {exact.name})}
    listed = {} if listed is None else listed
    if exact.parent not in listed:
        inside = listed[exact.parent] = {}
        for path in _files_ending(readable_suffixes(), list(exact.parent.iterdir())):
            inside.setdefault(composed(path.stem), []).append(path)
    found = sorted(path for stem in stems for path in listed[exact.parent].get(stem, ()))
    if len(found) > 1:
        raise CaptureError(
            f"{folder / name}: is absent, and both {found[0].name} and {found[1].name} could be meant; remove one"
        )
    return found[0] if found else None


def image_finder() -> Callable[[Path, str], Path | None]:
    """Make a `find_image` for many names in turn, which lists a folder once."""
    listed: _Listed = {}
    return lambda folder, name: find_image(folder, name, listed)


def read_image(path: Path) -> np.ndarray:
    """Read a photograph as stored: RGB or RGBA (not premultiplied), 8 bit. uint8 [H, W, 3 or 4]

    Gray becomes RGB; 16-bit samples are divided by 257 and rounded; EXIF orientation is ignored.

    Raises:
        CaptureError: the file is absent, truncated, corrupt, empty or not an image.
    """
    image = _decode(path)
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    if image.shape[2] == 4:
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)
    if image.shape[2] == 3:
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    raise CaptureError(f"{path}: has {image.shape[2]} channels; save it as gray, RGB or RGBA")


def in_threads(
    read: Callable[[T], R],
    items: Sequence[T],
    what: str,
    progress: Callable[[str, int, int], None] | None,
    most: int = 8,
) -> list[R]:
    """Read items several at a time, in their order; after an error or an interruption no further one is begun.

    `progress` is called by this thread, with what is done, how many are, and of how many.
    """
    found: list[R] = []
    with ThreadPoolExecutor(min(most, os.cpu_count() or 1)) as pool:
        jobs = [pool.submit(read, item) for item in items]
        try:
            for job in jobs:
                found.append(job.result())
                if progress is not None:
                    progress(what, len(found), len(jobs))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return found


def read_mask(path: Path) -> np.ndarray:
    """Read a mask, True (keep) where the picture is brighter than half; alpha is ignored. bool [H, W]"""
    image = read_image(path)
    return image[:, :, :3].mean(axis=2) > 127.5


def write_png(path: str | os.PathLike[str], image: np.ndarray) -> None:
    """Write uint8 [H, W, 3] or [H, W] as PNG, atomically."""
    stored = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    _, data = cv2.imencode(".png", stored)
    write_file(path, data.tobytes())


# of OpenCV's log, as a number because OpenCV 4 has no name for it in Python
_SILENT: Final = 0


def _set_log_level(level: int) -> int:
    """Set the level of OpenCV's own log, by the function's name in OpenCV 4 or in 5, and return the level before."""
    return (cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel)(level)  # type: ignore[attr-defined]


class _Quiet:
    """Keep the log of OpenCV and ffmpeg off the terminal in any thread: what matters of it is raised as one line."""

    def __init__(self) -> None:
        self._lock, self._inside, self._level = threading.Lock(), 0, 0

    def __enter__(self) -> None:
        # ffmpeg's own words about a damaged file
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        with self._lock:
            if self._inside == 0:
                self._level = _set_log_level(_SILENT)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                _set_log_level(self._level)


QUIET: Final = _Quiet()


@contextmanager
def named_for_opencv(video: Path) -> Iterator[str]:
    """Name a video to open: OpenCV crashes at what is not UTF-8, and takes what precedes a colon for a protocol."""
    name = str(video.absolute())
    with ExitStack() as stack:
        if name.encode(errors="ignore").decode() != name:
            folder, suffix = tempfile.TemporaryDirectory(prefix="pop_video_"), video.suffix
            link = Path(stack.enter_context(folder), f"link{suffix.encode(errors='ignore').decode()}")
            link.symlink_to(name)
            name = str(link)
        yield name


def _decode(path: Path) -> np.ndarray:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise CaptureError(f"{path}: the file is absent; restore it, or remove it from the capture") from None
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}; check the file's permissions") from error
    if is_heif(data):
        return _decode_heif(path, data)
    size = size_of(data)
    _check_size(path, size, len(data), bytes_per_pixel(data))
    if defect := _defect(data):
        raise CaptureError(f"{path}: {defect}; {FIX}")
    if size is None:
        # a size that nobody has seen is nobody's to judge, and OpenCV also decodes what no camera writes
        raise CaptureError(f"{path}: is not a PNG, JPEG, WebP, TIFF, BMP or HEIC image; convert it to one, or {FIX}")
    try:
        # IMREAD_UNCHANGED keeps alpha and 16 bit, and leaves the EXIF orientation alone, but for a TIFF's
        with QUIET:
            image = cv2.imdecode(np.frombuffer(as_stored(data), np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise CaptureError(f"{path}: is not an image that OpenCV can decode, or is corrupt; {FIX}")
    if image.dtype == np.uint16:
        return cv2.convertScaleAbs(image, alpha=1.0 / 257.0)
    if image.dtype != np.uint8:
        raise CaptureError(f"{path}: has samples of type {image.dtype}; save it with 8 or 16 bit per channel")
    return image


def _check_size(path: Path, size: tuple[int, int] | None, packed: int, each: int) -> None:
    if size is None:
        return
    if size[0] * size[1] > LARGEST:
        raise CaptureError(
            f"{path}: is {size[0]}x{size[1]} px by its header; more than {LARGEST // 10**6} million pixels are not "
            "decoded: make it smaller"
        )
    what = f"its header's size of {size[0]}x{size[1]} px"
    try:
        # once as it is decoded, and once in 8 bit and in our order of the channels
        check_memory(path, 2 * each * size[0] * size[1], packed, what, FIX, PICTURE)
    except PopError as error:
        raise CaptureError(str(error)) from error


def _decode_heif(path: Path, data: bytes) -> np.ndarray:
    """Decode as OpenCV would: BGR or BGRA, 8 bit."""
    if not can_read_heif():
        raise CaptureError(f"{path}: is HEIC, which needs pillow-heif: {INSTALL}, or convert it to JPEG")
    try:
        _check_size(path, heif_size(data), len(data), 4)
        image = decode_heif(data)
    except CaptureError:
        raise
    except ValueError as error:
        raise CaptureError(f"{path}: the HEIC file is truncated or corrupt ({error}); {FIX}") from error
    return cv2.cvtColor(image, cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)


def _defect(data: bytes) -> str | None:
    """Say what is wrong with a file before it is decoded: decoders fill what is missing with gray and only warn."""
    if not data:
        return "the file is empty"
    if data.startswith(b"\xff\xd8"):
        return _jpeg_defect(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_defect(data)
    if data.startswith(b"RIFF") and len(data) < 8 + int.from_bytes(data[4:8], "little"):
        return "the WebP file is truncated"
    if data.startswith(b"BM") and len(data) < int.from_bytes(data[2:6], "little"):
        return "the BMP file is truncated"
    return None


def _png_defect(data: bytes) -> str | None:
    at = 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind = data[at + 4 : at + 8]
        end = at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return f"the PNG file is corrupt: wrong checksum in chunk {kind.decode('latin-1')!r} at byte {at}"
        if kind == b"IEND":
            return None
        at = end
    return "the PNG file is truncated: it ends before its IEND chunk"


def _jpeg_defect(data: bytes) -> str | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return f"the JPEG file is corrupt: no marker at byte {at}"
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
        elif marker == 0xDA:
            return _jpeg_scan_defect(np.frombuffer(data, np.uint8), at + 2)
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return "the JPEG file is truncated: it ends before its pixels"


def _jpeg_scan_defect(data: np.ndarray, start: int) -> str | None:
    """Look through the coded pixels: only stuffed zeros, restarts and new segments may follow 0xFF, and EOI ends."""
    marks = np.flatnonzero(data[start:-1] == 0xFF) + start
    after = data[marks + 1]
    ends = marks[after == 0xD9]
    if len(ends) == 0:
        return "the JPEG file is truncated: its end-of-image marker is missing"
    # the tables between progressive scans may hold any byte, so only files with one scan can be searched further
    inside = marks < ends[0]
    if not np.any(after[inside] == 0xDA):
        inside &= (after != 0x00) & (after != 0xFF) & (after != 0xDC) & ((after < 0xD0) | (after > 0xD7))
        if np.any(inside):
            return f"the JPEG file is corrupt: unexpected marker at byte {int(marks[inside][0])}"
    return None


# a process takes as long to start as to read so many
_A_LISTENER_FOR = 64
_LISTENERS = 4
_DAMAGE = re.compile(
    rb"premature end of data segment|bad Huffman code|bad arithmetic code|found marker \w+ instead of RST\d"
    rb"|Premature end of JPEG file|(\d+) extraneous bytes before marker \w+"
)
# some cameras pad the coded pixels with a few bytes
_PADDING = 64


@contextmanager
def jpeg_damage(paths: Sequence[Path]) -> Iterator[dict[Path, str]]:
    """Listen to what libjpeg says of the JPEG files among photographs, while the block reads them or does other work.

    The files are decoded a second time, small, in up to four further processes; see `main`.

    Yields:
        One line for every damaged file, in the order of `paths`; filled in when the block ends without an error.
    """
    files = [path for path in paths if path.suffix.lower() in (".jpg", ".jpeg")]
    count = min(_LISTENERS, os.cpu_count() or 1, -(-len(files) // _A_LISTENER_FOR)) if sys.executable else 0
    shares = [files[start::count] for start in range(count)]
    found: dict[Path, str] = {}
    with ExitStack() as stack:
        logs = [stack.enter_context(tempfile.TemporaryFile()) for _ in shares]
        listeners = [_listen(stack, share, log) for share, log in zip(shares, logs, strict=True)]
        yield found
        damage: dict[Path, str] = {}
        for share, log, listener in zip(shares, logs, listeners, strict=True):
            listener.wait()
            damage |= _damage(share, log)
        for path in files:
            if path in damage:
                found[path] = f"{path}: the JPEG file is corrupt: {damage[path]}; {FIX}"


@contextmanager
def sound_jpegs(paths: Sequence[Path]) -> Iterator[None]:
    """Refuse damaged JPEG files, naming the first, when the block that reads them has ended without an error."""
    with jpeg_damage(paths) as damage:
        yield
    for message in damage.values():
        raise CaptureError(message)


def _listen(stack: ExitStack, files: Sequence[Path], log: IO[bytes]) -> subprocess.Popen[bytes]:
    command = module_command(__name__)
    # a file and not a pipe, which would have to be fed while the block runs
    with tempfile.TemporaryFile() as names:
        names.write(b"\0".join(os.fsencode(path.absolute()) for path in files))
        names.seek(0)
        listener = subprocess.Popen(command, stdin=names, stdout=subprocess.DEVNULL, stderr=log)
    stack.callback(listener.wait)
    stack.callback(listener.kill)
    return listener


def _damage(files: Sequence[Path], log: IO[bytes]) -> dict[Path, str]:
    """Read what was said of each file, and keep what means lost pixels."""
    log.seek(0)
    found: dict[Path, str] = {}
    for said in log.read().split(b"\0")[1:]:
        number, _, words = said.partition(b"\n")
        complaint = _DAMAGE.search(words)
        if complaint and int(complaint[1] or _PADDING + 1) > _PADDING:
            found[files[int(number)]] = complaint[0].decode("ascii")
    return found


def main() -> None:
    """Decode the JPEG files whose names standard input holds, separated by NUL."""
    for number, name in enumerate(sys.stdin.buffer.read().split(b"\0")):
        os.write(2, b"\0%d\n" % number)
        try:
            # an eighth of the size: all coded pixels are read, and few computed
            cv2.imdecode(np.fromfile(os.fsdecode(name), np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8)
        except (OSError, cv2.error):
            continue  # whoever reads the photograph itself says so


COLORMAP: Final = "magma"
_MAX_SIDE: Final = 640


def colormap_table(name: str = COLORMAP) -> np.ndarray:
    """Give the colours of one of matplotlib's maps; magma, which is perceptually uniform, for errors. uint8 [256, 3]"""
    from matplotlib import colormaps

    return np.round(colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3] * 255.0).astype(np.uint8)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Round an image in [0, 1] to 8 bit, clamped."""
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def error_magnitude(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Take each pixel's error: the mean over the channels of |image - photo|, in [0, 1]. [H, W] from uint8 [H, W, 3]"""
    return np.abs(image.astype(np.float32) - photo.astype(np.float32)).mean(axis=2) / 255.0


def error_scale(errors: list[np.ndarray]) -> float:
    """Choose one top of the scale for all views: their joint 99th percentile, rounded up to a step of 0.05."""
    if not errors:
        return 0.1
    top = float(np.quantile(np.concatenate([e.ravel()[:: max(1, e.size // 50_000)] for e in errors]), 0.99))
    return min(max(np.ceil(top / 0.05 - 1e-4) * 0.05, 0.05), 1.0)


def error_picture(error: np.ndarray, top: float) -> np.ndarray:
    """Colour an error map: black-violet is 0, pale yellow is `top` and more. uint8 [H, W, 3]"""
    return colormap_table()[np.clip(np.round(error / top * 255.0), 0, 255).astype(np.uint8)]


def id_colors(ids: np.ndarray) -> np.ndarray:
    """Colour Gaussian ids, int [H, W], so that one id always has one colour and neighbours differ; -1 (none) is black.

    The id is hashed (splitmix64), its bits give a hue and one of two levels of saturation and brightness.
    """
    with np.errstate(over="ignore"):
        z = ids.astype(np.int64).astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    hue = ((z & np.uint64(0xFF)) * np.uint64(180) // np.uint64(256)).astype(np.uint8)
    saturation = np.where(z & np.uint64(0x100), 120, 200).astype(np.uint8)
    value = np.where(z & np.uint64(0x200), 235, 170).astype(np.uint8)
    colors = cv2.cvtColor(np.stack([hue, saturation, value], axis=-1), cv2.COLOR_HSV2RGB)
    colors[ids < 0] = 0
    return colors


def fit(picture: np.ndarray, nearest: bool = False, max_side: int = _MAX_SIDE) -> np.ndarray:
    """Shrink a picture so that its longer side is at most `max_side` px; smaller ones stay as they are."""
    scale = max_side / max(picture.shape[:2])
    if scale >= 1.0:
        return picture
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA)


def data_uri(picture: np.ndarray, lossless: bool = False) -> str:
    """Pack an RGB picture, uint8 [H, W, 3], into a data URI: PNG when lossless, else JPEG at quality 88."""
    kind, options = ("png", [cv2.IMWRITE_PNG_COMPRESSION, 9]) if lossless else ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, 88])
    ok, data = cv2.imencode(f".{kind}", np.ascontiguousarray(picture[:, :, ::-1]), options)
    if not ok:
        raise ValueError(f"picture of shape {list(picture.shape)} cannot be written as {kind}")
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


def colorbar_css(name: str = COLORMAP) -> str:
    """Give the colours of a map as a CSS gradient from the bottom to the top of the scale."""
    stops = colormap_table(name)[np.linspace(0, 255, 12).astype(int)]
    return "linear-gradient(90deg," + ",".join(f"#{r:02x}{g:02x}{b:02x}" for r, g, b in stops) + ")"


DEPTH_COLORS: Final = "viridis_r"
_NOTHING: Final = (112, 112, 118)


def depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Choose one range for all depth maps: their joint 1st to 99th percentile, without NaN."""
    known = [depth[np.isfinite(depth)][:: max(1, depth.size // 50_000)] for depth in depths]
    joined = np.concatenate(known) if known else np.zeros(0)
    if not len(joined):
        return 0.1, 1.0
    near, far = (max(float(np.quantile(joined, q)), 1e-12) for q in (0.01, 0.99))
    return near, max(far, near * (1.0 + 1e-6))


def depth_picture(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Colour a depth map [H, W] by its logarithm, near in yellow and far in violet, grey where it is not finite.

    A garden has its background many times as far away as its table: evenly spaced colours would leave the table one.
    """
    known = np.isfinite(depth)
    level = np.log(np.clip(np.where(known, depth, near), near, far) / near) / np.log(far / near)
    picture = colormap_table(DEPTH_COLORS)[np.round(255.0 * level).astype(np.uint8)]
    picture[~known] = _NOTHING
    return picture


if __name__ == "__main__":
    main()
