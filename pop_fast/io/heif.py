"""HEIC photographs, as telephones write them, through pillow-heif, which is optional.

libheif obeys a file's own rotation, so that pixels come out upright; the EXIF orientation that such a file repeats is
not to be obeyed again.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

__all__ = ["HEIF_SUFFIXES", "INSTALL", "can_read_heif", "decode_heif", "heif_exif", "heif_size", "is_heif"]

HEIF_SUFFIXES: Final = (".heic", ".heif", ".hif")
INSTALL: Final = "pip install pillow-heif"
_BRANDS: Final = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")

T = TypeVar("T")


def can_read_heif() -> bool:
    """Tell whether pillow-heif is installed."""
    return find_spec("pillow_heif") is not None


def _opened(data: bytes, read: Callable[[Any], T], **how: Any) -> T:
    """Open a file and read something of it.

    Raises:
        ValueError: the file is damaged.
    """
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
    """Return width and height in px, upright, without decoding the pixels.

    Raises:
        ValueError: the file is damaged.
    """
    width, height = _opened(data, lambda file: file.size)
    return int(width), int(height)


def decode_heif(data: bytes) -> np.ndarray:
    """Decode a file's first picture: RGB or RGBA, 8 bit, upright. uint8 [H, W, 3 or 4]

    Raises:
        ValueError: the file is damaged.
    """
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
