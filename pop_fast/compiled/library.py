"""The compiled library through ctypes: the layout of what it is given, and its functions."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

_POINTER, _WHOLE, _REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


class Blend(ctypes.Structure):
    """`pop::Blend` of tile.h, where every field is explained, in its order."""

    _fields_ = (
        *((name, _POINTER) for name in ("means2d", "conics", "opacities", "colors", "ids", "offsets", "first_chunks")),
        *((name, _WHOLE) for name in ("n", "channels", "tiles_x", "tiles_y", "tile_size", "width", "height")),
        ("threads", _WHOLE),
        *((name, _REAL) for name in ("alpha_floor", "alpha_ceiling", "stop")),
        ("ceiling_passes", _WHOLE),
        *((name, _POINTER) for name in ("lights", "n_reached", "n_pairs", "image", "alphas")),
        *((name, _POINTER) for name in ("dominant_ids", "dominant_weights", "n_blended", "n_traversed")),
        *((name, _POINTER) for name in ("v_image", "v_alphas", "rows")),
        *((name, _POINTER) for name in ("v_means2d", "v_conics", "v_opacities", "v_colors", "absgrad")),
    )


@dataclass(frozen=True)
class Library:
    """The functions of the library.

    Attributes:
        forward: by the number of bytes of a float.
        backward: likewise.
        chunk: list entries after which the light is written down.
        padded_pixels: pixels of a tile of that size, padded to whole vectors of floats of so many bytes.
        fork: starts the threads, or None.
    """

    forward: dict[int, Callable[..., None]]
    backward: dict[int, Callable[..., None]]
    chunk: int
    padded_pixels: Callable[[int, int], int]
    fork: Any


@cache
def open_library(path: str) -> Library:
    """Load the library.

    Raises:
        OSError: it is missing, does not load, or was not made from the same source as this module.
    """
    loaded = ctypes.CDLL(path)
    for name in ("pop_blend_bytes", "pop_chunk", "pop_padded_pixels"):
        function = getattr(loaded, name)
        function.restype = _WHOLE
    loaded.pop_padded_pixels.argtypes = (_WHOLE, _WHOLE)
    if loaded.pop_blend_bytes() != ctypes.sizeof(Blend):
        raise OSError(f"{path} expects arguments of another layout")
    found: dict[str, dict[int, Callable[..., None]]] = {"forward": {}, "backward": {}}
    for kind, functions in found.items():
        for size in (4, 8):
            function = getattr(loaded, f"pop_{kind}_float{8 * size}")
            function.argtypes, function.restype = (ctypes.POINTER(Blend), _POINTER), None
            functions[size] = function
    return Library(found["forward"], found["backward"], loaded.pop_chunk(), loaded.pop_padded_pixels, _fork())


def _fork() -> Any:
    """Return what starts the threads of torch's own OpenMP runtime; None where that is not GNU's.

    Threads of our own would have to share the processors with torch's, which stay awake for a while after each
    operation.
    """
    if not sys.platform.startswith("linux"):
        return None
    lines = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    files = {line.split(maxsplit=5)[-1] for line in lines if "/torch/lib/" in line and "libgomp" in line}
    for file in sorted(files):
        function = getattr(ctypes.CDLL(file), "GOMP_parallel", None)
        if function is not None:
            return ctypes.cast(function, _POINTER)
    return None
