"""The compiled library through ctypes: the layouts of what its functions are given, and how they are called.

Whether the library loads can be found out without torch; calling it takes torch's tensors.
"""

from __future__ import annotations

import ctypes
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pop_fast.compiled.build import library_path

if TYPE_CHECKING:
    import torch
    from torch import Tensor

_PRECISIONS: Final = ("float32", "float64")
POINTER, WHOLE, REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
# what projecting and culling read of `pop_ref.constants.Profile.as_numbers`
PROJECTION_CONSTANTS: Final = (
    *("near_inclusive", "near_plane", "far_plane", "eps2d", "frustum_margin", "extent_sigmas", "alpha_floor"),
    *("centred", "inria_clamp", "square"),
)


def fields_of(kind: Any, *names: str) -> tuple[tuple[str, Any], ...]:
    """Return fields of one kind, as `ctypes.Structure` takes them."""
    return tuple((name, kind) for name in names)


class Covariances(ctypes.Structure):
    """`pop::Covariances` of projection.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER, "quats", "scales"),
        *fields_of(WHOLE, "n", "threads"),
        *fields_of(POINTER, "covars", "v_covars", "v_quats", "v_scales"),
    )


class Projection(ctypes.Structure):
    """`pop::Projection` of projection.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER, "means", "covars", "opacities", "viewmat", "K"),
        *fields_of(WHOLE, "n", "threads", "width", "height", "tile_size"),
        *fields_of(WHOLE, "near_inclusive", "centred", "inria_clamp", "square", "antialiased"),
        *fields_of(REAL, "near_plane", "far_plane", "eps2d", "frustum_margin", "extent_sigmas", "alpha_floor"),
        *fields_of(REAL, "radius_clip"),
        *fields_of(POINTER, "means2d", "depths", "conics", "effective_opacities", "factors", "radii"),
        *fields_of(POINTER, "v_means2d", "v_depths", "v_conics", "v_effective_opacities", "v_factors"),
        *fields_of(POINTER, "v_means", "v_covars", "v_opacities", "v_viewmats"),
    )


class Colors(ctypes.Structure):
    """`pop::Colors` of colors.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER, "sh", "means", "viewmat", "visible"),
        *fields_of(WHOLE, "n", "n_visible", "n_sh", "degree", "threads"),
        *fields_of(POINTER, "colors", "v_colors", "v_sh", "v_dirs"),
    )


class Lists(ctypes.Structure):
    """`pop::Lists` of lists.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER, "means2d", "conics", "opacities", "rects", "order", "candidates"),
        *fields_of(WHOLE, "n", "m", "tiles_x", "tiles_y", "tile_size", "threads"),
        *fields_of(REAL, "alpha_floor"),
        *fields_of(POINTER, "tiles", "ids", "offsets"),
    )


class Blend(ctypes.Structure):
    """`pop::Blend` of tile.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER, "means2d", "conics", "opacities", "colors", "ids", "offsets", "first_chunks"),
        *fields_of(WHOLE, "n", "channels", "tiles_x", "tiles_y", "tile_size", "width", "height", "threads"),
        *fields_of(WHOLE, "pixel_stride", "channel_stride"),
        *fields_of(REAL, "alpha_floor", "alpha_ceiling", "stop"),
        *fields_of(WHOLE, "ceiling_passes"),
        *fields_of(POINTER, "splats", "transmittances", "reached", "n_reached", "n_pairs", "image", "alphas"),
        *fields_of(POINTER, "dominant_ids", "dominant_weights", "n_blended", "n_traversed"),
        *fields_of(POINTER, "v_image", "v_alphas", "rows"),
        *fields_of(POINTER, "v_means2d", "v_conics", "v_opacities", "v_colors", "absgrad"),
        *fields_of(POINTER, "slots", "dominant_counts", "kept"),
    )


class Scores(Blend):
    """`pop::Scores` of scores.h, where every field is explained, in its order: what all sums over pixels take."""

    _fields_ = (
        *fields_of(POINTER, "background", "pixel_map", "facing"),
        *fields_of(REAL, "fx", "fy", "cx", "cy"),
        *fields_of(POINTER, "T_final", "totals"),
    )


class Ssim(ctypes.Structure):
    """`pop::Ssim` of ssim.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER, "difference", "target", "mu_y", "s_yy", "kept"),
        *fields_of(WHOLE, "height", "width", "channels", "border", "stride", "threads"),
        *fields_of(REAL, "weight"),
        *fields_of(POINTER, "totals", "partials", "gradient"),
    )


class Moments(ctypes.Structure):
    """`pop::Moments` of ssim.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER, "photograph"),
        *fields_of(WHOLE, "height", "width", "border", "threads"),
        *fields_of(POINTER, "target", "mu_y", "s_yy"),
    )


# the functions by name, each in both precisions, and the layout of what each is given
_LAYOUTS: Final[dict[str, type[ctypes.Structure]]] = {
    **dict.fromkeys(("covariances", "covariances_backward"), Covariances),
    **dict.fromkeys(("projection", "projection_backward"), Projection),
    **dict.fromkeys(("colors", "colors_backward"), Colors),
    "lists": Lists,
    **dict.fromkeys(("forward", "backward"), Blend),
    **dict.fromkeys(("contributions", "sensitivities", "screen_moments", "dominant_points"), Scores),
    "ssim": Ssim,
    "moments": Moments,
}


@dataclass(frozen=True)
class Library:
    """What is in the library."""

    functions: dict[tuple[str, str], Callable[..., int]]  # by name and precision
    chunk: int  # list entries after which the blend writes down the light
    # pixels of a tile of that size, padded to whole vectors of floats of so many bytes
    padded_pixels: Callable[[int, int], int]
    splat_bytes: int  # size of what blending keeps of a splat, and its alignment
    lanes: Callable[[int], int]  # numbers of so many bytes in a vector
    window_rows: int  # rows of SSIM's windows whose total is one number
    # numbers from one row of maps to the next, for rows of that many numbers of so many bytes
    padded_line: Callable[[int, int], int]
    rows_at_a_time: int  # Gaussians whose share of the camera's gradient is one sum
    adam: Callable[..., None]  # moves so many floats by one update of Adam
    fork: Any  # starts the threads, or None


@dataclass(frozen=True)
class StepperFunctions:
    """The functions of a stepper: make one for so many threads, let go, take steps, its bytes, its counts, a trace."""

    open: Callable[[int], int | None]
    close: Callable[[int], None]
    steps: Callable[..., int]
    bytes: Callable[[int], int]
    counts: Callable[..., None]
    trace: Callable[[int, int | None, int], int]


def stepper_functions(given_bytes: int) -> StepperFunctions:
    """Return the functions that take whole training steps.

    Raises:
        OSError: the library has another layout.
    """
    path = str(library_path())
    this_library()
    loaded = ctypes.CDLL(path)
    loaded.pop_step_given_bytes.restype = WHOLE
    if loaded.pop_step_given_bytes() != given_bytes:
        raise OSError(f"{path} expects arguments of another layout")
    signatures = {
        "open": ((WHOLE,), POINTER),
        "close": ((POINTER,), None),
        "steps": ((POINTER, POINTER, WHOLE, POINTER), WHOLE),
        "bytes": ((POINTER,), WHOLE),
        "counts": ((POINTER, POINTER), None),
        "trace": ((POINTER, POINTER, WHOLE), WHOLE),
    }
    found: dict[str, Any] = {name: getattr(loaded, f"pop_stepper_{name}") for name in signatures}
    for name, signature in signatures.items():
        found[name].argtypes, found[name].restype = signature
    return StepperFunctions(**found)


def call_library(
    name: str, dtype: torch.dtype, numbers: Mapping[str, float], tensors: Mapping[str, Tensor | None]
) -> None:
    """Call a function of the library.

    Args:
        dtype: float32 or float64.
        numbers: fields of its arguments that are numbers; those that are not given are 0 or null.
        tensors: fields that are pointers; what is not contiguous is copied, and so must not be a result.

    Raises:
        MemoryError: there was none for what the threads work with.
    """
    library = this_library()
    # the arguments only point: these are what they point into, and live until the function has returned
    held = {field: tensor.contiguous() for field, tensor in tensors.items() if tensor is not None}
    arguments = _LAYOUTS[name](**numbers, **{field: tensor.data_ptr() for field, tensor in held.items()})
    if not library.functions[name, str(dtype).removeprefix("torch.")](ctypes.byref(arguments), library.fork):
        raise MemoryError(f"the compiled CPU kernels ran out of memory in stage {name}")


def this_library() -> Library:
    """Return the library of this version; `pop_fast.compiled.why_not` tells whether there is one."""
    return open_library(str(library_path()))


@cache
def open_library(path: str) -> Library:
    """Load a library to call it; torch is imported by then.

    Raises:
        OSError: it is missing, does not load, or was not made from the same source as this module.
    """
    loaded = load_library(path)
    numbers = ("chunk", "splat_bytes", "window_rows", "rows_at_a_time")
    sizes = ("padded_pixels", "lanes", "padded_line")
    for number in (*numbers, *sizes):
        getattr(loaded, f"pop_{number}").restype = WHOLE
    loaded.pop_lanes.argtypes = (WHOLE,)
    loaded.pop_padded_pixels.argtypes = loaded.pop_padded_line.argtypes = (WHOLE, WHOLE)
    loaded.pop_adam.argtypes = (*(POINTER,) * 4, *(WHOLE,) * 2, *(REAL,) * 4)
    loaded.pop_adam.restype = None
    functions: dict[tuple[str, str], Callable[..., int]] = {}
    for name in _LAYOUTS:
        for precision in _PRECISIONS:
            function = getattr(loaded, f"pop_{name}_{precision}")
            function.argtypes, function.restype = (POINTER, POINTER), ctypes.c_int
            functions[name, precision] = function
    return Library(
        functions,
        **{number: getattr(loaded, f"pop_{number}")() for number in numbers},
        **{size: getattr(loaded, f"pop_{size}") for size in sizes},
        adam=loaded.pop_adam,
        fork=_fork(),
    )


def load_library(path: str) -> ctypes.CDLL:
    """Load a library and compare its layouts of arguments with those of this module.

    Raises:
        OSError: it is missing, does not load, or was not made from the same source as this module.
    """
    loaded = ctypes.CDLL(path)
    for layout in dict.fromkeys(_LAYOUTS.values()):
        size = getattr(loaded, f"pop_{layout.__name__.lower()}_bytes")
        size.restype = WHOLE
        if size() != ctypes.sizeof(layout):
            raise OSError(f"{path} expects arguments of another layout")
    return loaded


def _fork() -> Any:
    """Return what starts the threads of torch's own OpenMP runtime; None where that is not GNU's.

    Threads of our own would have to share the processors with torch's, which stay awake for a while after each
    operation.
    """
    if not sys.platform.startswith("linux"):
        return None
    # names of files are bytes
    lines = Path("/proc/self/maps").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    # wheels keep it in torch/lib or torch.libs; other packages bring their own, whose threads would be asleep
    files = {line.split(maxsplit=5)[-1] for line in lines if re.search(r"/torch(/lib|\.libs)/libgomp", line)}
    for file in sorted(files):
        function = getattr(ctypes.CDLL(file), "GOMP_parallel", None)
        if function is not None:
            return ctypes.cast(function, POINTER)
    return None
