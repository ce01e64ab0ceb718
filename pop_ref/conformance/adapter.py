"""Who is judged: the protocol between the laws and an implementation, and its form for the oracle itself.

Everything crosses the border as NumPy float64 (ids int64), in the oracle's names and shapes, one camera at a time. An
adapter says with `has` what its implementation can do; laws that need more are skipped by name.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from pop_ref.conformance.law import DOMINANCE, DOUBLE, GRADIENTS, PROFILES, RENDER, ROWWISE
from pop_ref.conformance.scenes import Scene, rounded_to

STAGE_MODULES = (
    "activations",
    "covariance",
    "harmonics",
    "camera",
    "projection",
    "footprint",
    "tiles",
    "alpha",
    "pixel",
    "compositing",
    "dominance",
    "margins",
    "ssim",
    "losses",
    "polarization",
    "density_config",
    "density_rows",
    "density",
    "optimizer",
    "training",
)


@dataclass(frozen=True)
class View:
    """What a rasterizer shows of one render; None where it does not tell.

    Attributes:
        image: [H, W, 3]
        T_final: [H, W]
        dominant_ids, dominant_weights, n_blended, n_traversed: [H, W]
        dominant_counts: [N]
        radii: [N, 2]
        means2d: [N, 2]
    """

    image: Any
    T_final: Any
    dominant_ids: Any = None
    dominant_weights: Any = None
    dominant_counts: Any = None
    n_blended: Any = None
    n_traversed: Any = None
    radii: Any = None
    means2d: Any = None


class Adapter(Protocol):
    """An implementation under judgement.

    Attributes:
        name: how reports call it.
        dtype: the NumPy type of the precision it computes in; its rounding is charged in units of that type's eps.
    """

    name: str
    dtype: Any

    def has(self, need: str) -> bool:
        """Tell whether the implementation offers a stage function, or one of the abilities that `law` names.

        RENDER, GRADIENTS and DOMINANCE speak for themselves; PROFILES: any profile can be passed; DOUBLE: computes in
        float64; ROWWISE: a row's bits do not depend on the other rows, as they do where vector units split arrays.
        """
        ...

    def stage(self, name: str) -> Callable[..., Any]:
        """Return a stage function that takes and returns NumPy arrays."""
        ...

    def render(self, scene: Scene) -> View:
        """Draw a scene."""
        ...

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return cotangents by name: means, quats, scales, opacities, sh, and those of viewmat, background, means2d,
        means2d_abs that the implementation offers."""
        ...

    def sees(self, scene: Scene) -> Scene:
        """Return the scene as the implementation reads it: rounded to its dtype."""
        ...


def stage_function(package: str, name: str) -> Callable[..., Any] | None:
    """Return the public function of that name from a package's stage modules, or None."""
    for module_name in STAGE_MODULES:
        module = _module(f"{package}.{module_name}")
        function = getattr(module, name, None)
        if module and inspect.isfunction(function) and function.__module__ == module.__name__:
            return function
    return None


def _module(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        # a stage that an implementation does not have is a skipped law, a stage that fails to import is a bug
        if error.name != name:
            raise
        return None


class OracleAdapter:
    """The oracle as a backend of its own laws; also any copy of it under another package name, as mutants are."""

    def __init__(self, package: str = "pop_ref", name: str = "oracle") -> None:
        self.name = name
        self.package = package
        self.dtype = np.float64

    def has(self, need: str) -> bool:
        """Tell that the oracle can do everything its modules define."""
        return (
            need in (RENDER, GRADIENTS, DOMINANCE, PROFILES, DOUBLE, ROWWISE)
            or stage_function(self.package, need) is not None
        )

    def stage(self, name: str) -> Callable[..., Any]:
        """Return the oracle's function itself."""
        function = stage_function(self.package, name)
        if function is None:
            raise LookupError(f"{self.package} has no stage function {name}")
        return function

    def sees(self, scene: Scene) -> Scene:
        """Return the scene: the oracle computes in the precision that scenes are written in."""
        return scene

    def render(self, scene: Scene) -> View:
        """Draw a scene with `render.render`."""
        drawn = self.full_render(scene)
        common = {f.name: getattr(drawn, f.name) for f in fields(View) if hasattr(drawn, f.name)}
        return View(**common, radii=drawn.splats.radii, means2d=drawn.splats.means2d)

    def full_render(self, scene: Scene) -> Any:
        """Draw a scene and return the oracle's own `Render`, with the splats and tile lists."""
        module = importlib.import_module(f"{self.package}.render")
        return module.render(*self._own(scene), **self._options(scene))

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return the cotangents of `render.render_vjp`."""
        module = importlib.import_module(f"{self.package}.render")
        g = module.render_vjp(*self._own(scene), v_image=v_image, v_T_final=v_T_final, **self._options(scene))
        return {f.name: np.asarray(getattr(g, f.name)) for f in fields(g)}

    def _own(self, scene: Scene) -> tuple[Any, Any]:
        # a copy of the oracle has value types of its own
        types = importlib.import_module(f"{self.package}.types")
        g, c = scene.gaussians, scene.camera
        own_g = g if isinstance(g, types.Gaussians) else types.Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh)
        own_c = c if isinstance(c, types.Camera) else types.Camera(c.viewmat, c.K, c.width, c.height)
        return own_g, own_c

    def _options(self, scene: Scene) -> dict[str, Any]:
        return {
            "background": scene.background,
            "sh_degree": scene.sh_degree,
            "profile": scene.profile,
            "tile_size": scene.tile_size,
            "antialiased": scene.antialiased,
        }


def oracle_view(scene: Scene) -> View:
    """Draw a scene with the oracle."""
    return OracleAdapter().render(scene)


__all__ = ["Adapter", "OracleAdapter", "View", "oracle_view", "rounded_to", "stage_function"]
