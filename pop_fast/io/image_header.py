"""What an image file states before a pixel is decoded: its size and its EXIF tags; and HEIC through pillow-heif.

A few kilobytes of header decide how much memory decoding takes, so the size is held against what is expected first.
JPEG, PNG, WebP, BMP, TIFF and HEIC are read; of any other or damaged file nothing is returned, and the decoder judges
it. pillow-heif, which reads HEIC, is optional. libheif obeys a file's own rotation, so that pixels come out upright;
the EXIF orientation that such a file repeats is not to be obeyed again.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

HEIF_SUFFIXES: Final = (".heic", ".heif", ".hif")
INSTALL: Final = "pip install pillow-heif"
_BRANDS: Final = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")

T = TypeVar("T")


def can_read_heif() -> bool:
    return find_spec("pillow_heif") is not None


def _opened(data: bytes, read: Callable[[Any], T], **how: Any) -> T:
    """Open a file and read something of it; ValueError of a damaged file."""
    try:
        return read(import_module("pillow_heif").open_heif(data, **how))
    # memory can be had again, and no damage
    except (MemoryError, ImportError):
        raise
    # libheif's findings come as errors of many kinds: SyntaxError, RuntimeError, EOFError, IndexError
    except Exception as error:
        raise ValueError(" ".join(str(error).split())) from error


def is_heif(data: bytes) -> bool:
    """Tell by a file's first 12 bytes whether it is HEIF."""
    return data[4:8] == b"ftyp" and data[8:12] in _BRANDS


def heif_size(data: bytes) -> tuple[int, int]:
    """Return width and height in px, upright, without decoding the pixels; ValueError of a damaged file."""
    width, height = _opened(data, lambda file: file.size)
    return int(width), int(height)


def decode_heif(data: bytes) -> np.ndarray:
    """Decode a file's first picture, 8 bit, upright; ValueError of a damaged file. uint8 [H, W, 3 or 4]"""
    pixels = _opened(data, lambda file: np.ascontiguousarray(np.asarray(file)), convert_hdr_to_8bit=True)
    # one channel is gray
    return np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels


def heif_exif(path: Path) -> bytes:
    """Return the TIFF block of a file's EXIF tags, empty where it has none or cannot be read."""
    try:
        block = _opened(path.read_bytes(), lambda file: file.info.get("exif")) or b""
    except (OSError, ValueError):
        return b""
    return block.removeprefix(b"Exif\0\0")


# pixels of one photograph: more than cameras have, and under 1 GiB decoded
LARGEST: Final = 2**28
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_TIFF: Final = {b"II*\0": "<", b"MM\0*": ">"}
# start-of-frame markers; the others of the range are tables
_FRAMES: Final = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
# bytes of a value, by the type of its TIFF tag
_WIDTHS: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}
_LETTERS: Final = {1: "B", 3: "H", 4: "I", 9: "i"}
_WIDTH, _HEIGHT, _MAKE, _MODEL, _ORIENTATION, _EXIF_IFD = 0x100, 0x101, 0x10F, 0x110, 0x112, 0x8769
_BITS, _SAMPLES = 0x102, 0x115
_EXPOSURE, _ISO, _FOCAL, _FOCAL_35 = 0x829A, 0x8827, 0x920A, 0xA405
# a JPEG holds its tags in segments of 64 kB before its pixels; TIFF and WebP may hold them anywhere
_HEAD: Final = 2**20


@dataclass(frozen=True)
class Exif:
    """What a camera wrote into a photograph; None where it did not."""

    # 1 as stored, 3 half a turn, 6 a quarter turn clockwise to be upright, 8 counterclockwise; 2, 4, 5 and 7
    # are mirrored
    orientation: int = 1
    camera: str | None = None  # make and model
    exposure: float | None = None  # seconds
    iso: float | None = None  # sensitivity
    focal: float | None = None  # focal length, mm
    # of the lens that sees as much on 35 mm film, mm: a digital zoom changes this one alone
    focal_35: float | None = None


def read_size(path: Path) -> tuple[int, int] | None:
    """Return width and height in px by the file's header, or None where it tells none."""
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD)
            if is_heif(head):
                return heif_size(head + file.read()) if can_read_heif() else None
            return size_of(head) or (size_of(head + file.read()) if head[:4] in _TIFF else None)
    except (OSError, ValueError):
        return None


def size_of(data: bytes) -> tuple[int, int] | None:
    """Return width and height in px by a file's first bytes, or None where they tell none."""
    try:
        if data.startswith(_PNG):
            return struct.unpack_from(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return next((size for marker, size in _jpeg(data) if marker in _FRAMES), None)
        if data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
            return width, abs(height)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size(data)
        if data[:4] in _TIFF:
            tags = _tags(data, 0)
            return int(tags[_WIDTH]), int(tags[_HEIGHT])
    except (struct.error, KeyError, ValueError, TypeError):
        return None
    return None


def bytes_per_pixel(data: bytes) -> int:
    """Return how many bytes a pixel has when it is decoded, by a file's first bytes; 4 where they tell nothing else."""
    try:
        if data.startswith(_PNG):
            depth, kind = data[24], data[25]
            return {0: 1, 2: 3, 3: 3}.get(kind, 4) * (2 if depth == 16 else 1)
        if data[:4] in _TIFF:
            tags = _tags(data, 0)
            return max(1, int(tags.get(_SAMPLES, 1))) * max(1, int(tags.get(_BITS, 8)) // 8)
    except (IndexError, struct.error, KeyError, ValueError, TypeError):
        pass
    return 4


def as_stored(data: bytes) -> bytes:
    """Return a TIFF file without its orientation, which OpenCV obeys in this format whatever it is told; others as is.

    What is damaged stays so, for the decoder to judge.
    """
    order = _TIFF.get(data[:4])
    try:
        for entry in _entries(data, 0) if order else ():
            if struct.unpack_from(f"{order}H", data, entry)[0] == _ORIENTATION:
                return data[:entry] + struct.pack(f"{order}HHIHH", _ORIENTATION, 3, 1, 1, 0) + data[entry + 12 :]
    except struct.error:
        pass
    return data


def read_exif(path: Path) -> Exif:
    """Read the EXIF tags of a photograph; those of a file without any, or a damaged one, are absent."""
    try:
        with open(path, "rb") as file:
            data = file.read(_HEAD)
            if not data.startswith(b"\xff\xd8"):
                data += file.read()
        upright = is_heif(data)
        if upright:
            data = heif_exif(path) if can_read_heif() else b""
        at = _exif_at(data)
        if at is None:
            return Exif()
        tags = _tags(data, at)
        own = _tags(data, at, int(tags[_EXIF_IFD])) if _EXIF_IFD in tags else {}
    except (OSError, struct.error, ValueError, KeyError, TypeError):
        return Exif()
    maker, model = (tags[key] if isinstance(tags.get(key), str) else "" for key in (_MAKE, _MODEL))
    camera = model if model.startswith(maker) else f"{maker} {model}".strip()
    # what libheif decodes has been turned already
    turned = 1 if upright else tags.get(_ORIENTATION, 1)
    orientation = int(turned) if turned in range(1, 9) else 1
    return Exif(orientation, camera or None, *(_number(own, key) for key in (_EXPOSURE, _ISO, _FOCAL, _FOCAL_35)))


def _number(tags: dict[int, Any], key: int) -> float | None:
    value = tags.get(key)
    return float(value) if isinstance(value, (int, float)) and 0.0 < value < math.inf else None


def _jpeg(data: bytes) -> list[tuple[int, Any]]:
    """List a JPEG's segments before its pixels: marker, and the size of a frame or else where its content begins."""
    found: list[tuple[int, Any]] = []
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            found.append((marker, (width, height)))
        else:
            found.append((marker, at + 4))
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return found


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
        return width + 1, height + 1
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _exif_at(data: bytes) -> int | None:
    """Find where the TIFF block of EXIF tags begins."""
    if data[:4] in _TIFF:
        return 0
    if data.startswith(b"\xff\xd8"):
        starts = [at for marker, at in _jpeg(data) if marker == 0xE1 and data[at : at + 6] == b"Exif\0\0"]
        return starts[0] + 6 if starts else None
    if data.startswith(_PNG):
        return _chunk(data, 8, b"eXIf", ">I", 4, 0)
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        at = _chunk(data, 12, b"EXIF", "<I", 0, 4)
        return at + 6 if at is not None and data[at : at + 6] == b"Exif\0\0" else at
    return None


def _chunk(data: bytes, at: int, name: bytes, form: str, name_at: int, length_at: int) -> int | None:
    """Find the content of a PNG's or a WebP's chunk of this name."""
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(form, data, at + length_at)
        if data[at + name_at : at + name_at + 4] == name:
            return at + 8
        # a PNG's chunk ends in a checksum, a WebP's is filled up to an even length
        at += 8 + length + (4 if name_at else length % 2)
    return None


def _entries(data: bytes, base: int, offset: int | None = None) -> range:
    """Find where the entries of one TIFF directory begin, of 12 bytes each; struct.error, KeyError where none is."""
    order = _TIFF[data[base : base + 4]]
    start = base + (struct.unpack_from(f"{order}I", data, base + 4)[0] if offset is None else offset)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    return range(start + 2, start + 2 + 12 * count, 12)


def _tags(data: bytes, base: int, offset: int | None = None) -> dict[int, Any]:
    """Read one TIFF directory: by tag, a text or the first of its numbers; struct.error, KeyError where none is."""
    order = _TIFF[data[base : base + 4]]
    found: dict[int, Any] = {}
    for entry in _entries(data, base, offset):
        tag, kind, length = struct.unpack_from(f"{order}HHI", data, entry)
        if kind not in _WIDTHS:
            continue
        inline = _WIDTHS[kind] * length <= 4
        at = entry + 8 if inline else base + struct.unpack_from(f"{order}I", data, entry + 8)[0]
        if kind == 2:
            found[tag] = data[at : at + min(length, 256)].split(b"\0")[0].decode("utf-8", "replace").strip()
        elif kind in (5, 10):
            over, under = struct.unpack_from(f"{order}{'II' if kind == 5 else 'ii'}", data, at)
            found[tag] = over / under if under else math.nan
        elif kind != 7:
            (found[tag],) = struct.unpack_from(order + _LETTERS[kind], data, at)
    return found
