"""The host mirror as a backend of the conformance kit: stage functions, whole renders, whole gradients."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.adapter import Adapter, View
from pop_ref.conformance.capabilities import ANTIALIASING, DETERMINISTIC, DOMINANCE, ROWWISE
from pop_ref.conformance.mirror_library import Mirror
from pop_ref.conformance.mirror_stages import STAGES
from pop_ref.conformance.scenes import Scene

FOLDER: Path = importlib.import_module("cuda_ext.host.library_folder").library_folder()


def mirror(name: str) -> MirrorAdapter:
    """Return the mirror in double ("mirror64"), or in float with the kernels' own tiles ("mirror32")."""
    double = name == "mirror64"
    made = MirrorAdapter(FOLDER, np.float64 if double else np.float32, kernel_tiles=not double)
    made.name = name
    return made


class MirrorAdapter(Adapter):
    """The kernels' mathematics on the host.

    Args:
        folder: where the mirror is built.
        dtype: numpy.float32 or numpy.float64.
        per_splat: which family goes back: one splat a lane, or a column of pixels a lane.
        kernel_tiles: the kernels' own 16 x 8 tiles with exact lists, where the profile's tiles are an optimisation.
    """

    profile = None
    able = (ANTIALIASING, DETERMINISTIC, DOMINANCE, ROWWISE)

    def __init__(self, folder: Path, dtype: Any, per_splat: bool = False, kernel_tiles: bool = False) -> None:
        family = "splats" if per_splat else "columns"
        self.name = f"mirror{np.dtype(dtype).itemsize * 8}-{family}{'-exact' if kernel_tiles else ''}"
        self.dtype = dtype
        self.mirror = Mirror(folder, dtype)
        self._per_splat, self._kernel_tiles = per_splat, kernel_tiles

    def has(self, need: str) -> bool:
        """Tell what the mirror offers."""
        return super().has(need) or need in STAGES

    def stage(self, name: str) -> Callable[..., Any]:
        """Return a stage function with the oracle's signature."""
        if name not in STAGES:
            raise LookupError(f"the mirror has no stage function {name}")
        return partial(STAGES[name], self.mirror)

    def render(self, scene: Scene) -> View:
        """Draw a scene."""
        H, W, N = scene.camera.height, scene.camera.width, len(scene.gaussians)
        image, T_final, weights, means2d, _, _, _, ids, blended, traversed, counts, radii = self.mirror.call(
            "render",
            N,
            self._inputs(scene),
            [(H, W, 3), (H, W), (H, W), (N, 2), (N,), (N, 3), (N,)],
            [(H, W), (H, W), (H, W), (N,), (N, 2)],
            integers=self._integers(scene),
            profile=self._profile(scene),
        )
        visits = None if self._exact(scene) else traversed
        return View(image, T_final, ids, weights, counts, blended, visits, radii, means2d)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return every cotangent of a render."""
        g = scene.gaussians
        names = ("means", "quats", "scales", "opacities", "sh", "viewmat", "background", "means2d", "means2d_abs")
        N = len(g)
        shapes = [(N, 3), (N, 4), (N, 3), (N,), g.sh.shape, (4, 4), (3,), (N, 2), (N, 2)]
        found = self.mirror.call(
            "render_vjp",
            N,
            [*self._inputs(scene), v_image, v_T_final],
            shapes,
            integers=self._integers(scene),
            profile=self._profile(scene),
        )
        return dict(zip(names, found, strict=True))

    def _inputs(self, scene: Scene) -> list[Any]:
        g, c = scene.gaussians, scene.camera
        return [g.means, g.quats, g.scales, g.opacities, g.sh, c.viewmat, c.K, scene.background]

    def _profile(self, scene: Scene) -> Any:
        return replace(scene.profile, tile_size=scene.tile_size or scene.profile.tile_size)

    def _exact(self, scene: Scene) -> bool:
        return self._kernel_tiles and scene.profile.extent == "opacity_aware"

    def _integers(self, scene: Scene) -> tuple[int, ...]:
        n_sh = scene.gaussians.sh.shape[1]
        degree = round(np.sqrt(n_sh)) - 1 if scene.sh_degree is None else scene.sh_degree
        size = scene.tile_size or scene.profile.tile_size
        exact = self._exact(scene)
        tile = (16, 8) if exact else (size, size)
        camera = scene.camera
        return (camera.width, camera.height, n_sh, degree, *tile, scene.antialiased, exact, self._per_splat)
