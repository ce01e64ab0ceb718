"""Fixed scenes seen by several cameras, and the smallest call that tells whether a rasterizer offers an argument."""

from __future__ import annotations

import dis
import math
import re
from dataclasses import replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance import capabilities
from pop_ref.conformance.calls import Call, Frame, without_backgrounds
from pop_ref.conformance.scenes import Record, Scene, in_precision, pack, rigid
from pop_ref.constants import PAPER
from pop_ref.magnitudes import constant, depths_magnitudes, distance, splat_magnitudes
from pop_ref.margins import extent_margins
from pop_ref.records import Camera, Gaussians
from pop_ref.splatting import project

SIZE = 17, 11
NEAREST, FARTHEST = 1.0, 6.0
# as far as this behind, nothing that a camera sees ahead is before it
BEHIND = 32.0


def cameras(
    count: int, centred: bool = False, size: tuple[int, int] = SIZE, blind: int | None = None, aside: float = 0.0
) -> list[Camera]:
    """Return cameras side by side, each turned and shifted a little and with intrinsics of its own.

    Args:
        count: of cameras.
        centred: whether every principal point is the middle of the image.
        size: width and height, px.
        blind: the camera that has every Gaussian behind it.
        aside: how far the first stands from where it does, in distances from one to the next.
    """
    found, base = [], rigid((0.9, 0.2, -0.3, 0.15), (0.25, -0.5, 0.75))
    larger = np.diag([size[0] / SIZE[0], size[1] / SIZE[1], 1.0])
    for number in range(count):
        c = number + aside
        moved = rigid((1.0, 0.03 * c, -0.05 * c, 0.02 * c), (0.125 * c, -0.0625 * c, 0.1875 * c)) @ base
        if number == blind:
            moved = rigid((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, -BEHIND)) @ moved
        K = larger @ np.array([[18.0 + 3.0 * c, 0.0, 8.25 + c], [0.0, 16.0 + 2.0 * c, 5.75 - 0.5 * c], [0.0, 0.0, 1.0]])
        if centred:
            K[:2, 2] = 0.5 * size[0], 0.5 * size[1]
        found.append(Camera(moved, K, *size))
    return found


def gaussians(
    seed: int, degree: int = 1, count: int = 14, size: tuple[int, int] = SIZE, *, seen_first: bool = False
) -> Gaussians:
    """Return Gaussians before the first camera, one of them behind it and one far outside the picture.

    Quaternions have norms other than 1, sizes along the axes differ, and coefficients of every band are there. The two
    that the camera does not see are the first two; with `seen_first` they are the second and third.
    """
    rng = np.random.default_rng(seed)

    def one(k: int) -> Record:
        return Record(
            x=-300.0 if k == 1 else rng.uniform(0.0, size[0]),
            y=rng.uniform(0.0, size[1]),
            depth=-2.0 if k == 0 else rng.uniform(NEAREST, FARTHEST),
            size=tuple(rng.uniform(0.6, 3.0, 3)),
            quat=tuple(rng.normal(size=4) * rng.uniform(0.5, 2.0)),
            opacity=rng.uniform(0.1, 0.95),
            sh=tuple(map(tuple, rng.normal(0.0, 0.15, ((degree + 1) ** 2, 3)) + 0.25)),
        )

    records = [one(k) for k in range(count)]
    if seen_first:
        records[:3] = records[2], records[0], records[1]
    return pack(records, cameras(1, size=size)[0])


def raw_params(g: Gaussians) -> dict[str, np.ndarray]:
    """Return what a trainer holds of Gaussians, logarithms and logits, in numbers of single precision."""
    raw = {
        "means": g.means,
        "scales": np.log(g.scales),
        "quats": g.quats,
        "opacities": np.log(g.opacities / (1.0 - g.opacities)),
        "sh0": g.sh[:, :1],
        "shN": g.sh[:, 1:],
    }
    return {name: in_precision(array) for name, array in raw.items()}


def frames(
    backend: Any,
    seed: int = 0,
    count: int = 1,
    degree: int = 1,
    channels: int = 0,
    camera_colors: bool = False,
    black: bool = False,
    sh_degree: int | None = None,
    antialiased: bool = False,
    size: tuple[int, int] = SIZE,
    tile_size: int = 4,
    blind: int | None = None,
    entry: int = 0,
) -> tuple[Frame, ...]:
    """Return the frames of one batch entry, as a backend reads them.

    Args:
        backend: whose precision and constants they take.
        seed: of the Gaussians.
        count: of cameras.
        degree: of the harmonics.
        channels: of plain colours, which may be negative and above 1; 0 takes harmonics.
        camera_colors: whether every camera has colours, or harmonics, of its own.
        black: without a background.
        sh_degree: bands that are used, None for all.
        antialiased: whether opacities make up for the low-pass.
        size: width and height, px.
        tile_size: px, where tiles change no image.
        blind: the camera that has every Gaussian behind it.
        entry: of the batch; each has cameras of its own.
    """
    g, rng = gaussians(seed, degree, size=size, seen_first=seed % 2 == 1), np.random.default_rng(1000 + seed)
    shared = rng.uniform(-0.5, 1.5, (len(g), channels))
    found = []
    profile = backend.profile or PAPER
    # where extents are square the grid is the profile's own
    side = None if profile.extent == "square" else tile_size
    for c, camera in enumerate(cameras(count, profile.principal_point == "centred", size, blind, 0.5 * entry)):
        mixed = camera_colors * 0.125 * c
        own = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh * (1.0 - mixed))
        behind = np.zeros(channels or 3) if black else np.round(16.0 * rng.uniform(-0.25, 1.25, channels or 3)) / 16.0
        scene = backend.sees(Scene(own, camera, behind, profile, side, sh_degree, antialiased))
        colors = in_precision(shared * (1.0 - mixed), backend.dtype) if channels else None
        found.append(Frame(scene, colors, c == blind))
    return tuple(found)


_OF_CALL: Final = ("batch", "render_mode", "packed", "radius_clip", "covars", "no_background", "sparse_grad", "absgrad",
                   "dominance")  # fmt: skip
_PLANES: Final = ("near_plane", "far_plane", "eps2d")


def call_for(backend: Any, seed: int = 0, **asks: Any) -> Call:
    """Return a call that asks for these options of `frames` and `Call`, and for nothing else.

    Args:
        backend: whose precision and constants it takes.
        seed: of the first entry's Gaussians; the other entries have the next ones.
        asks: options by name; planes as near_plane, far_plane, eps2d.
    """
    of_call: dict[str, Any] = {"absgrad": False} | {name: asks[name] for name in _OF_CALL if name in asks}
    of_call["planes"] = {name: asks[name] for name in _PLANES if name in asks}
    of_frames = {name: value for name, value in asks.items() if name not in (*_OF_CALL, *_PLANES)}
    of_frames["black"] = asks.get("no_background", False)
    rows = tuple(frames(backend, seed + b, **of_frames, entry=b) for b in range(math.prod(asks.get("batch", ()))))
    return Call(rows, camera_colors=asks.get("camera_colors", False), **of_call)


def clear_call(backend: Any, first_seed: int, **asks: Any) -> Call:
    """Return such a call in which planes and radius_clip cull some of what is seen, and rounding decides none of it.

    Args:
        backend: whose precision and constants it takes.
        first_seed: the first that is tried.
        asks: as of `call_for`.
    """
    for seed in range(first_seed, first_seed + 64):
        call = call_for(backend, seed, **asks)
        if _clearly_culled(call, backend.dtype):
            return call
    raise AssertionError(f"no scene from seed {first_seed} on is clear of rounding under {asks}")


def _clearly_culled(call: Call, dtype: Any) -> bool:
    culls = dict.fromkeys(
        (*(name for name in call.planes if name != "eps2d"), *["clip"] * (call.radius_clip > 0)), False
    )
    for _, _, frame in call.each:
        scene = frame.scene.with_overrides(profile=call.profile)
        unplaned = project(scene.gaussians, scene.camera, scene.sh_degree, frame.scene.profile, scene.antialiased)
        for name in culls.keys() & call.planes.keys():
            off = unplaned.depths - call.planes[name]
            if np.min(np.abs(off)) < 2.0**-8:
                return False
            culls[name] |= bool(np.any(unplaned.visible & ((off < 0.0) == (name == "near_plane"))))
        if call.radius_clip:
            radii = project(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.antialiased).radii
            if not np.all(clear_of_extents(scene, dtype)):
                return False
            # along both axes, and along one alone
            small = np.sum((radii > 0) & (radii <= call.radius_clip), axis=1)
            culls["clip"] |= bool(np.any(small == 2) and np.any(small == 1))
    return all(culls.values())


def clear_of_extents(scene: Scene, dtype: Any) -> np.ndarray:
    """Return the Gaussians whose culls, extents and tiles rounding does not decide (D1, D2, D3). [N]"""
    g, camera = scene.gaussians, scene.camera
    profile = replace(scene.profile, tile_size=scene.side)
    near, far, reach = constant(profile.near_plane), constant(profile.far_plane), 64.0 * float(np.finfo(dtype).eps)
    clear = np.zeros(len(g), dtype=bool)
    for i, depth in enumerate(depths_magnitudes(g, camera)):
        before, beyond = distance(depth, near), distance(depth, far)
        if not min(before, beyond) > reach:
            continue
        clear[i] = True
        if near.value < depth.value < far.value:
            extent = extent_margins(
                splat_magnitudes(g, i, camera, profile, scene.antialiased), camera.width, camera.height, profile
            )
            clear[i] = min(extent.visible, extent.size, extent.overlap) > reach
    return clear


# what a rasterizer's signature may lack, and be none the worse in what it has
ARGUMENTS: Final = ("near_plane", "far_plane", "radius_clip", "eps2d", "sh_degree", "packed", "tile_size",
                    "backgrounds", "render_mode", "sparse_grad", "absgrad", "rasterize_mode", "covars")  # fmt: skip
# by capability, what asks for it and for nothing else
ASKED: Final[dict[str, dict[str, Any]]] = {
    capabilities.CAMERAS: {"count": 2},
    capabilities.BATCHES: {"batch": (2,)},
    capabilities.PACKED: {"packed": True},
    capabilities.DEPTH: {"render_mode": "RGB+ED"},
    capabilities.COLORS: {"channels": 3},
    capabilities.CHANNELS: {"channels": 4},
    capabilities.CAMERA_COLORS: {"channels": 3, "camera_colors": True},
    capabilities.COVARS: {"covars": True},
    capabilities.RADIUS_CLIP: {"radius_clip": 2.5},
    capabilities.PLANES: {"near_plane": 2.0, "far_plane": 4.0, "eps2d": 0.5},
    capabilities.NO_BACKGROUND: {"no_background": True},
    capabilities.SPARSE_GRAD: {"packed": True, "sparse_grad": True},
}


def refusal(backend: Any, capability: str) -> str | None:
    """Ask a backend for a call that needs a capability, and return in what words it refuses; None if it does not.

    Args:
        backend: has a method `call`.
        capability: one of ASKED.
    """
    return refusal_of(backend, call_for(backend, **ASKED[capability]))


def refusal_of(backend: Any, call: Call) -> str | None:
    """Make a call that asks for one thing, and return in what words the backend refuses it; None if it does not.

    A refusal is an error that the backend raised on purpose about an argument where it is asked for without
    backgrounds; a rasterizer that takes it with backgrounds takes it. Where the call without backgrounds ends in any
    other error, an assertion among them, that is a defect: the argument counts as taken, so that laws run into the
    error and report it.
    What goes wrong with backgrounds alone, as packed rows in gsplat 1.5.3 (gsplat#764), is for laws of packed rows.

    Args:
        backend: has a method `call`.
        call: with backgrounds, or without.
    """
    words: list[str | None] = []
    for asked in (call, without_backgrounds(call)):
        try:
            backend.call(asked)
        except Exception as error:
            words.append(f"{type(error).__name__}: {error}" if refuses_on_purpose(error) else None)
        else:
            return None
    with_backgrounds, alone = words
    return alone and (with_backgrounds or alone)


def refuses_on_purpose(error: Exception) -> bool:
    """Tell whether an error is the statement of a backend that it does not take an argument."""
    text = str(error)
    if isinstance(error, NotImplementedError):
        return True
    if isinstance(error, TypeError) and "unexpected keyword argument" in text:
        return any(f"'{name}'" in text for name in ARGUMENTS)
    # compiled code cannot raise NotImplementedError through every binding, so its words decide
    if isinstance(error, RuntimeError):
        return re.search(r"unsupported|not supported|not implemented|only supports?", text, re.IGNORECASE) is not None
    return isinstance(error, (TypeError, ValueError)) and _was_raised(error)


def _was_raised(error: Exception) -> bool:
    """Tell whether Python code raised an error by a statement, as no failing operation of an array does."""
    at = error.__traceback__
    while at is not None and at.tb_next is not None:
        at = at.tb_next
    return at is not None and at.tb_frame.f_code.co_code[at.tb_lasti] == dis.opmap["RAISE_VARARGS"]
