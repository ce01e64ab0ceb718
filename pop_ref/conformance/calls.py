"""One call of a rasterizer with gsplat's signature, as arrays, and what the oracle says that comes of it.

A call is written as the images that it asks for: one `Frame` for every batch entry and camera. The oracle draws each
by itself, so a rasterizer that mixes cameras up, or ignores an argument, has nothing to hide behind.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.constants import Profile
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.depth import RenderMode
from pop_ref.records import Render
from pop_ref.render import RenderGradients, render, render_vjp
from pop_ref.splatting import project


@dataclass(frozen=True)
class Frame:
    """One image of a call.

    Attributes:
        scene: Gaussians, camera, background of as many channels as the colours, and the profile.
        colors: plain colours instead of harmonics. [N, D]
    """

    scene: Scene
    colors: np.ndarray | None = None

    @property
    def n_colors(self) -> int:
        """Return the number of colour channels."""
        return 3 if self.colors is None else self.colors.shape[1]


@dataclass(frozen=True)
class Call:
    """One call of a rasterizer.

    Attributes:
        frames: of every batch entry, its cameras. Gaussians are those of the entry's first frame.
        batched: whether tensors have a batch dimension; without it there is one entry.
        camera_colors: whether colours, or harmonics, have a camera dimension.
        render_mode: RGB, D, ED, RGB+D, RGB+ED.
        packed: whether meta holds rows of visible Gaussians only.
        radius_clip: px; splats with both extents at most this are culled.
        planes: near_plane, far_plane and eps2d where they are not the profile's.
        covars: whether covariances are given instead of quaternions and scales.
        no_background: whether the argument is left out; scenes are then black behind.
        sparse_grad: as gsplat's.
    """

    frames: tuple[tuple[Frame, ...], ...]
    batched: bool = False
    camera_colors: bool = False
    render_mode: RenderMode = "RGB"
    packed: bool = False
    radius_clip: float = 0.0
    planes: dict[str, float] = field(default_factory=dict)
    covars: bool = False
    no_background: bool = False
    sparse_grad: bool = False

    @property
    def profile(self) -> Profile:
        """Return the constants with the planes and the low-pass of the call."""
        return replace(self.frames[0][0].scene.profile, **self.planes)

    @property
    def each(self) -> Iterator[tuple[int, int, Frame]]:
        """Yield batch entry, camera and frame."""
        for b, cameras in enumerate(self.frames):
            for c, frame in enumerate(cameras):
                yield b, c, frame

    @property
    def n_channels(self) -> int:
        """Return the channels of an image."""
        colored = self.render_mode.startswith("RGB")
        return colored * self.frames[0][0].n_colors + (self.render_mode != "RGB")

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
        return found if self.batched else {name: value[0] for name, value in found.items()}

    def intrinsics(self) -> np.ndarray:
        """Return Ks. [..., C, 3, 3]"""
        found = np.array([[f.scene.camera.K for f in row] for row in self.frames])
        return found if self.batched else found[0]

    @property
    def sh_degree(self) -> int | None:
        """Return the bands to use, None for plain colours."""
        first = self.frames[0][0]
        return None if first.colors is not None else round(np.sqrt(first.scene.gaussians.sh.shape[1])) - 1


@dataclass(frozen=True)
class Called:
    """What came of a call, as arrays.

    Attributes:
        images, alphas: [B, C, H, W, X], [B, C, H, W]
        meta: by key; empty where the rasterizer tells nothing.
        gradients: by argument in its own shape, None where it got none; means2d and means2d_abs from meta.
    """

    images: np.ndarray
    alphas: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)
    gradients: dict[str, np.ndarray] = field(default_factory=dict)


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
    return {
        "background": scene.background if len(scene.background) == n else None,
        "sh_degree": scene.sh_degree,
        "profile": scene.profile,
        "tile_size": scene.tile_size,
        "antialiased": scene.antialiased,
        "colors": colors,
        "render_mode": render_mode,
    }


def unpacked(call: Call, rows: np.ndarray, meta: Any) -> np.ndarray:
    """Return rows of meta as one for each Gaussian of every frame, 0 where packed rows have none. [B, C, N, ...]

    Args:
        call: whose rows they are.
        rows: of meta, packed or not.
        meta: with the indices of packed rows.
    """
    shape = (len(call.frames), len(call.frames[0]), len(call.frames[0][0].scene.gaussians))
    if not call.packed:
        return rows.reshape(*shape, *rows.shape[2 + call.batched :])
    found = np.zeros((*shape, *rows.shape[1:]), dtype=rows.dtype)
    found[packed_index(meta)] = rows
    return found


def packed_index(meta: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the batch entry, camera and Gaussian of every packed row."""
    cameras, gaussians = np.asarray(meta["camera_ids"]), np.asarray(meta["gaussian_ids"])
    batch = np.zeros_like(cameras) if meta.get("batch_ids") is None else np.asarray(meta["batch_ids"])
    return batch, cameras, gaussians
