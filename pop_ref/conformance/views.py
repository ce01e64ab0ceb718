"""Fixed scenes seen by several cameras, and the smallest call that tells whether a rasterizer offers an argument."""

from __future__ import annotations

import dis
import re
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from pop_ref.conformance import capabilities
from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.scenes import Record, Scene, pack, rigid
from pop_ref.constants import PAPER
from pop_ref.records import Camera, Gaussians

WIDTH, HEIGHT = 17, 11
NEAREST, FARTHEST = 1.0, 6.0


def cameras(count: int, centred: bool = False) -> list[Camera]:
    """Return cameras side by side, each turned and shifted a little and with intrinsics of its own.

    Args:
        count: of cameras.
        centred: whether every principal point is the middle of the image.
    """
    found, base = [], rigid((0.9, 0.2, -0.3, 0.15), (0.25, -0.5, 0.75))
    for c in range(count):
        moved = rigid((1.0, 0.03 * c, -0.05 * c, 0.02 * c), (0.125 * c, -0.0625 * c, 0.1875 * c)) @ base
        K = np.array([[18.0 + 3.0 * c, 0.0, 8.25 + c], [0.0, 16.0 + 2.0 * c, 5.75 - 0.5 * c], [0.0, 0.0, 1.0]])
        if centred:
            K[:2, 2] = 0.5 * WIDTH, 0.5 * HEIGHT
        found.append(Camera(moved, K, WIDTH, HEIGHT))
    return found


def gaussians(seed: int, degree: int = 1, count: int = 14) -> Gaussians:
    """Return Gaussians before the first camera, one of them behind it and one far outside the picture.

    Quaternions have norms other than 1, sizes along the axes differ, and coefficients of every band are there.
    """
    rng = np.random.default_rng(seed)

    def one(k: int) -> Record:
        return Record(
            x=-300.0 if k == 1 else rng.uniform(0.0, WIDTH),
            y=rng.uniform(0.0, HEIGHT),
            depth=-2.0 if k == 0 else rng.uniform(NEAREST, FARTHEST),
            size=tuple(rng.uniform(0.6, 3.0, 3)),
            quat=tuple(rng.normal(size=4) * rng.uniform(0.5, 2.0)),
            opacity=rng.uniform(0.1, 0.95),
            sh=tuple(map(tuple, rng.normal(0.0, 0.15, ((degree + 1) ** 2, 3)) + 0.25)),
        )

    return pack([one(k) for k in range(count)], cameras(1)[0])


def frames(
    backend: Any,
    seed: int = 0,
    count: int = 1,
    degree: int = 1,
    channels: int = 0,
    camera_colors: bool = False,
    black: bool = False,
) -> tuple[Frame, ...]:
    """Return the frames of one batch entry, as a backend reads them.

    Args:
        backend: whose precision and constants they take.
        seed: of the Gaussians.
        count: of cameras.
        degree: of the harmonics.
        channels: of plain colours; 0 takes harmonics.
        camera_colors: whether every camera has colours, or harmonics, of its own.
        black: without a background.
    """
    g, rng = gaussians(seed, degree), np.random.default_rng(1000 + seed)
    shared = rng.uniform(0.125, 1.0, (len(g), channels))
    found = []
    profile = backend.profile or PAPER
    # where extents are square the grid is the profile's own
    size = None if profile.extent == "square" else 4
    for c, camera in enumerate(cameras(count, profile.principal_point == "centred")):
        mixed = camera_colors * 0.125 * c
        own = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh * (1.0 - mixed))
        behind = np.zeros(channels or 3) if black else np.round(16.0 * rng.uniform(0.1, 1.0, channels or 3)) / 16.0
        scene = backend.sees(Scene(own, camera, behind, tile_size=size))
        colors = (shared * (1.0 - mixed)).astype(backend.dtype).astype(np.float64) if channels else None
        found.append(Frame(scene, colors))
    return tuple(found)


def _call(backend: Any, entries: int = 1, count: int = 1, **options: Any) -> Call:
    of_frames = {k: options.pop(k) for k in ("degree", "channels", "camera_colors", "black") if k in options}
    rows = tuple(frames(backend, seed, count, **of_frames) for seed in range(entries))
    return Call(rows, camera_colors=of_frames.get("camera_colors", False), **options)


# what a rasterizer's signature may lack, and be none the worse in what it has
ARGUMENTS: Final = ("near_plane", "far_plane", "radius_clip", "eps2d", "sh_degree", "packed", "tile_size",
                    "backgrounds", "render_mode", "sparse_grad", "absgrad", "rasterize_mode", "covars")  # fmt: skip
# by capability, a call that needs it and nothing else
ASKED: Final[dict[str, Callable[[Any], Call]]] = {
    capabilities.CAMERAS: lambda backend: _call(backend, count=2),
    capabilities.BATCHES: lambda backend: _call(backend, 2, batched=True),
    capabilities.PACKED: lambda backend: _call(backend, packed=True),
    capabilities.DEPTH: lambda backend: _call(backend, render_mode="RGB+ED"),
    capabilities.COLORS: lambda backend: _call(backend, channels=3),
    capabilities.CHANNELS: lambda backend: _call(backend, channels=4),
    capabilities.CAMERA_COLORS: lambda backend: _call(backend, count=2, channels=3, camera_colors=True),
    capabilities.COVARS: lambda backend: _call(backend, covars=True),
    capabilities.RADIUS_CLIP: lambda backend: _call(backend, radius_clip=2.5),
    capabilities.PLANES: lambda backend: _call(backend, planes={"near_plane": 2.0, "far_plane": 4.0, "eps2d": 0.5}),
    capabilities.NO_BACKGROUND: lambda backend: _call(backend, black=True, no_background=True),
    capabilities.SPARSE_GRAD: lambda backend: _call(backend, packed=True, sparse_grad=True),
}


def refusal(backend: Any, capability: str) -> str | None:
    """Ask a backend for a call that needs a capability, and return in what words it refuses; None if it does not.

    A refusal is an error that somebody raised on purpose about an argument. Any other error is a defect: the capability
    counts as offered, so that its laws run into the error and report it.

    Args:
        backend: has a method `call`.
        capability: one of ASKED.
    """
    try:
        backend.call(ASKED[capability](backend))
    except Exception as error:
        return f"{type(error).__name__}: {error}" if _on_purpose(error) else None
    return None


def _on_purpose(error: Exception) -> bool:
    text = str(error)
    if isinstance(error, NotImplementedError):
        return True
    if isinstance(error, TypeError) and "unexpected keyword argument" in text:
        return any(f"'{name}'" in text for name in ARGUMENTS)
    # compiled code cannot raise NotImplementedError through every binding, so its words decide
    if isinstance(error, RuntimeError):
        return re.search(r"unsupported|not supported|not implemented|only supports?", text, re.IGNORECASE) is not None
    return isinstance(error, (TypeError, ValueError, AssertionError)) and _was_raised(error)


def _was_raised(error: Exception) -> bool:
    """Tell whether Python code raised an error by a statement, as no failing operation of an array does."""
    at = error.__traceback__
    while at is not None and at.tb_next is not None:
        at = at.tb_next
    return at is not None and at.tb_frame.f_code.co_code[at.tb_lasti] == dis.opmap["RAISE_VARARGS"]
