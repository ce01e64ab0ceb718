"""One call of a rasterizer with gsplat's signature, as arrays, and what the oracle says that comes of it.

A call is written as the images that it asks for: one `Frame` for every batch entry and camera. The oracle draws each
by itself, so a rasterizer that mixes cameras up, or ignores an argument, has nothing to hide behind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.constants import Profile
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.depth import RenderMode
from pop_ref.records import Render
from pop_ref.render import RenderGradients, render, render_vjp
from pop_ref.splatting import project


@dataclass(frozen=True, repr=False)
class Frame:
    """One image of a call.

    Attributes:
        scene: Gaussians, camera, background of as many channels as the colours, and the profile.
        colors: plain colours instead of harmonics. [N, D]
        blind: whether its camera looks away from every Gaussian.
    """

    scene: Scene
    colors: np.ndarray | None = None
    blind: bool = False

    def __post_init__(self) -> None:
        if self.colors is not None:
            object.__setattr__(self, "colors", np.asarray(self.colors, dtype=np.float64))

    def __repr__(self) -> str:
        colors = "" if self.colors is None else f", colors={self.colors.tolist()!r}"
        return f"Frame({self.scene!r}{colors}{', blind=True' if self.blind else ''})"

    @property
    def n_colors(self) -> int:
        """Return the number of colour channels."""
        return 3 if self.colors is None else self.colors.shape[1]


@dataclass(frozen=True, repr=False)
class Call:
    """One call of a rasterizer; printed, it is code that makes it again.

    Whether it is antialiased, the side of its tiles and the bands that are used stand in the scenes.

    Attributes:
        frames: of every batch entry, its cameras. Gaussians are those of the entry's first frame.
        batch: the batch dimensions of tensors; none for a single entry.
        camera_colors: whether colours, or harmonics, have a camera dimension.
        render_mode: RGB, D, ED, RGB+D, RGB+ED.
        packed: whether meta holds rows of visible Gaussians only.
        radius_clip: px; splats with both extents at most this are culled.
        planes: near_plane, far_plane and eps2d where they are not the profile's.
        covars: whether covariances are given instead of quaternions and scales.
        overruled: with covariances, whether quaternions and scales of other Gaussians are given, too.
        expanded: whether an argument that is the same in all batch entries has memory for the first alone.
        layout: how its tensors lie in memory, as `torch_autograd.Laid` has it; others have no memory to lie in.
        frozen: names of arguments that require no gradient where others do.
        no_background: whether the argument is left out; scenes are then black behind.
        sparse_grad: as gsplat's.
        absgrad: likewise, where gradients are asked for.
        dominance: whether a backend that offers it is asked for the dominant Gaussians in the same pass.
    """

    frames: tuple[tuple[Frame, ...], ...]
    batch: tuple[int, ...] = ()
    camera_colors: bool = False
    render_mode: RenderMode = "RGB"
    packed: bool = False
    radius_clip: float = 0.0
    planes: dict[str, float] = field(default_factory=dict)
    covars: bool = False
    overruled: bool = False
    expanded: bool = False
    layout: str = "dense"
    frozen: tuple[str, ...] = ()
    no_background: bool = False
    sparse_grad: bool = False
    absgrad: bool = True
    dominance: bool = False

    def __post_init__(self) -> None:
        if math.prod(self.batch) != len(self.frames):
            raise ValueError(f"batch is {list(self.batch)}, for {len(self.frames)} entries")

    def __repr__(self) -> str:
        default = {f.name: f.default for f in fields(self)} | {"planes": {}}
        given = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self)[1:]
                 if getattr(self, f.name) != default[f.name]]  # fmt: skip
        return f"Call({', '.join([repr(self.frames), *given])})"

    @property
    def profile(self) -> Profile:
        """Return the constants with the planes and the low-pass of the call."""
        return replace(self.first.scene.profile, **self.planes)

    @property
    def first(self) -> Frame:
        """Return the first frame, whose size, degree and constants are those of all."""
        return self.frames[0][0]

    @property
    def each(self) -> Iterator[tuple[int, int, Frame]]:
        """Yield batch entry, camera and frame."""
        for b, cameras in enumerate(self.frames):
            for c, frame in enumerate(cameras):
                yield b, c, frame

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return the numbers of entries, cameras and Gaussians."""
        return len(self.frames), len(self.frames[0]), len(self.first.scene.gaussians)

    @property
    def antialiased(self) -> bool:
        """Tell whether opacities make up for the low-pass: rasterize_mode."""
        return self.first.scene.antialiased

    @property
    def tile_size(self) -> int:
        """Return the side of a tile, px."""
        return self.first.scene.side

    @property
    def n_tiles(self) -> int:
        """Return the tiles of a picture."""
        camera = self.first.scene.camera
        return -(-camera.width // self.tile_size) * -(-camera.height // self.tile_size)

    @property
    def n_channels(self) -> int:
        """Return the channels of an image."""
        colored = self.render_mode.startswith("RGB")
        return colored * self.first.n_colors + (self.render_mode != "RGB")

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the arguments that have gradients, by name, as a rasterizer takes them."""
        gaussians = [cameras[0].scene.gaussians for cameras in self.frames]
        found = {name: np.stack([getattr(g, name) for g in gaussians]) for name in ("means", "opacities")}
        if self.covars:
            found["covars"] = np.stack([covars_from_quats_scales(g.quats, g.scales) for g in gaussians])
        else:
            found |= {name: np.stack([getattr(g, name) for g in gaussians]) for name in ("quats", "scales")}
        every = [[f.scene.gaussians.sh if f.colors is None else f.colors for f in row] for row in self.frames]
        found["colors"] = np.array(every) if self.camera_colors else np.stack([row[0] for row in every])
        found["viewmats"] = np.array([[f.scene.camera.viewmat for f in row] for row in self.frames])
        if not self.no_background:
            found["backgrounds"] = np.array([[f.scene.background for f in row] for row in self.frames])
        return {name: self.batched(value) for name, value in found.items()}

    def intrinsics(self) -> np.ndarray:
        """Return Ks. [..., C, 3, 3]"""
        return self.batched(np.array([[f.scene.camera.K for f in row] for row in self.frames]))

    def batched(self, value: np.ndarray) -> np.ndarray:
        """Return an array of entries in the shape that a rasterizer takes and gives."""
        return value.reshape(*self.batch, *value.shape[1:])

    def by_entry(self, value: np.ndarray) -> np.ndarray:
        """Return a rasterizer's array with one axis of batch entries in front."""
        return value.reshape(len(self.frames), *value.shape[len(self.batch) :])

    @property
    def sh_degree(self) -> int | None:
        """Return the bands to use, None for plain colours."""
        return self.first.scene.degree if self.first.colors is None else None

    def without_gradients(self) -> dict[str, np.ndarray | None]:
        """Return the quaternions and scales of a call with covariances, which go before them: others, or None."""
        n = self.shape[2]
        if not self.overruled:
            return {"quats": None, "scales": None}
        entries = (*self.batch, n)
        return {"quats": np.full((*entries, 4), 0.5), "scales": np.full((*entries, 3), 2.0**-6)}

    def described(self) -> list[str]:
        """Name the arguments that are not at gsplat's defaults, each with its value."""
        stored, used = self.first.scene.gaussians.sh.shape[1], self.sh_degree
        of = {
            f"{len(self.frames[0])} cameras": len(self.frames[0]) > 1,
            "a camera that sees nothing": any(frame.blind for _, _, frame in self.each),
            f"batch dimensions {list(self.batch)}": bool(self.batch),
            "packed=True": self.packed,
            "colors of each camera": self.camera_colors,
            f"{self.first.n_colors} plain channels": used is None,
            f"sh_degree={used} of {stored} coefficients": used is not None and (used + 1) ** 2 != stored,
            f"render_mode={self.render_mode!r}": self.render_mode != "RGB",
            "backgrounds": not self.no_background,
            "rasterize_mode='antialiased'": self.antialiased,
            "covars": self.covars and not self.overruled,
            "covars, quats and scales": self.overruled,
            "entries without memory of their own": self.expanded,
            f"tensors that lie {self.layout} in memory": self.layout != "dense",
            f"no gradient of {', '.join(self.frozen)}": bool(self.frozen),
            f"radius_clip={self.radius_clip:g}": self.radius_clip > 0.0,
            **{f"{name}={value:g}": True for name, value in self.planes.items()},
            f"tile_size={self.tile_size}": self.tile_size != 16,
            f"{self.n_tiles} tiles": self.n_tiles > 255,
            "sparse_grad=True": self.sparse_grad,
            "dominance=True": self.dominance,
        }
        return [words for words, holds in of.items() if holds]


def call_as_code(call: Call) -> str:
    """Return a script that makes the call again when pasted."""
    return (
        "from pop_ref.conformance.calls import Call, Frame\n"
        "from pop_ref.conformance.scenes import Scene\n"
        "from pop_ref.constants import PROFILES, Profile\n"
        "from pop_ref.records import Camera, Gaussians\n\n"
        f"call = {call!r}\n"
    )


def simpler_calls(call: Call) -> Iterator[Call]:
    """Yield the calls that have one argument fewer away from gsplat's defaults."""
    if call.batch:
        yield from (replace(call, frames=(row,), batch=(), expanded=False) for row in call.frames)
    count = len(call.frames[0])
    if count > 1:
        yield from (replace(call, frames=tuple((row[c],) for row in call.frames)) for c in range(count))
    if count > 2:
        yield from (replace(call, frames=tuple(row[:c] + row[c + 1 :] for row in call.frames)) for c in range(count))
    if call.camera_colors:
        shared = tuple(tuple(_colored_as(frame, row[0]) for frame in row) for row in call.frames)
        yield replace(call, frames=shared, camera_colors=False)
    if call.first.colors is not None:
        behind = np.zeros(3) if call.no_background else np.array([0.25, 0.5, 0.75])
        yield _each_frame(call, lambda f: Frame(f.scene.with_overrides(background=behind), None, f.blind))
    for name, default in (("packed", False), ("render_mode", "RGB"), ("overruled", False), ("covars", False),
                          ("expanded", False), ("layout", "dense"), ("frozen", ()), ("radius_clip", 0.0),
                          ("sparse_grad", False), ("dominance", False), ("absgrad", False)):  # fmt: skip
        if getattr(call, name) != default and not (
            (name == "packed" and call.sparse_grad) or (name == "covars" and call.overruled)
        ):
            yield replace(call, **{name: default})  # type: ignore[arg-type]
    if not call.no_background:
        yield without_backgrounds(call)
    for name in call.planes:
        yield replace(call, planes={k: v for k, v in call.planes.items() if k != name})
    yield from _plainer_scenes(call)


def _plainer_scenes(call: Call) -> Iterator[Call]:
    scene = call.first.scene
    changes: list[dict[str, Any]] = [{"antialiased": False}] * scene.antialiased
    changes += [{"sh_degree": None}] * (scene.sh_degree is not None)
    changes += [{"tile_size": 16}] * (call.tile_size != 16 and scene.profile.extent != "square")
    width, height = scene.camera.width, scene.camera.height
    changes += [{"width": 17, "height": 11}] * (width > 17 and height > 11)
    for change in changes:
        yield _each_frame(call, lambda f, change=change: replace(f, scene=f.scene.with_overrides(**change)))


def fewer_gaussians(call: Call) -> Iterator[Call]:
    """Yield the calls that have one Gaussian fewer."""
    n = call.shape[2]
    for gone in range(n if n > 1 else 0):
        rows = np.setdiff1d(np.arange(n), [gone])

        def change(f: Frame, rows: np.ndarray = rows) -> Frame:
            return Frame(f.scene.rows(rows), None if f.colors is None else f.colors[rows], f.blind)

        yield _each_frame(call, change)


def _each_frame(call: Call, change: Callable[[Frame], Frame]) -> Call:
    return replace(call, frames=tuple(tuple(change(frame) for frame in row) for row in call.frames))


def without_backgrounds(call: Call) -> Call:
    """Return the call with its argument left out, and scenes black behind."""
    black = _each_frame(call, lambda f: replace(f, scene=f.scene.with_overrides(background=np.zeros(f.n_colors))))
    return replace(black, no_background=True)


def with_backgrounds(call: Call) -> Call:
    """Return the call with backgrounds given."""

    def change(frame: Frame) -> Frame:
        behind = np.mod(np.arange(frame.n_colors) * 3.0 + 2.0, 8.0) / 8.0
        return replace(frame, scene=frame.scene.with_overrides(background=behind))

    return replace(_each_frame(call, change), no_background=False)


def _colored_as(frame: Frame, other: Frame) -> Frame:
    return Frame(frame.scene.with_overrides(sh=other.scene.gaussians.sh), other.colors, frame.blind)


@dataclass(frozen=True)
class Called:
    """What came of a call, as arrays.

    Attributes:
        images, alphas: [B, C, H, W, X], [B, C, H, W]
        meta: by key; empty where the rasterizer tells nothing.
        gradients: by argument in its own shape, None where it got none; means2d and means2d_abs from meta.
        changed: names of arguments that are not what they were before the call.
        strange: what is not of the shape or type that gsplat documents, in words; shapes of images are not among it.
    """

    images: np.ndarray
    alphas: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)
    gradients: dict[str, np.ndarray] = field(default_factory=dict)
    changed: tuple[str, ...] = ()
    strange: tuple[str, ...] = ()


def drawn_scene(call: Call, frame: Frame) -> Scene:
    """Return what the oracle draws for a frame: under the call's constants, without what `radius_clip` culls.

    A Gaussian that is culled keeps its row; its opacity is 0, which every extent that reads opacities culls.
    """
    scene = frame.scene.with_overrides(profile=call.profile)
    if call.radius_clip <= 0.0:
        return scene
    radii = project(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.antialiased).radii
    small = np.all(radii <= call.radius_clip, axis=1)
    return scene.with_overrides(opacities=np.where(small, 0.0, scene.gaussians.opacities))


def oracle_frame(scene: Scene, colors: np.ndarray | None, render_mode: RenderMode) -> Render:
    """Draw one image with the oracle."""
    return render(scene.gaussians, scene.camera, **_options(scene, colors, render_mode))


def oracle_frame_vjp(
    scene: Scene, colors: np.ndarray | None, render_mode: RenderMode, v_image: np.ndarray, v_T_final: np.ndarray
) -> RenderGradients:
    """Pull one image's cotangents back with the oracle."""
    options = _options(scene, colors, render_mode)
    return render_vjp(scene.gaussians, scene.camera, v_image, v_T_final, **options)


def _options(scene: Scene, colors: np.ndarray | None, render_mode: RenderMode) -> dict[str, Any]:
    n = 3 if colors is None else colors.shape[1]
    behind = scene.background if len(scene.background) == n else None
    return {**scene.options, "background": behind, "colors": colors, "render_mode": render_mode}


def unpacked(call: Call, rows: np.ndarray, meta: Any) -> np.ndarray | None:
    """Return rows of meta as one for each Gaussian of every frame, 0 where packed rows have none. [B, C, N, ...]

    None where packed rows do not tell whose they are.

    Args:
        call: whose rows they are.
        rows: of meta, packed or not.
        meta: with the indices of packed rows.
    """
    if not call.packed:
        return rows.reshape(*call.shape, *rows.shape[2 + len(call.batch) :])
    index = packed_index(call, meta)
    if index is None:
        return None
    found = np.zeros((*call.shape, *rows.shape[1:]), dtype=rows.dtype)
    found[index] = rows
    return found


def packed_index(call: Call, meta: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the batch entry, camera and Gaussian of every packed row; None where meta does not tell them."""
    if meta.get("gaussian_ids") is None:
        return None
    index, gaussians = [], np.asarray(meta["gaussian_ids"])
    for name, count in (("batch_ids", len(call.frames)), ("camera_ids", len(call.frames[0]))):
        if meta.get(name) is not None:
            index.append(np.asarray(meta[name]))
        elif count == 1:
            # where there is one, nothing needs to be told
            index.append(np.zeros_like(gaussians))
        else:
            return None
    return index[0], index[1], gaussians
