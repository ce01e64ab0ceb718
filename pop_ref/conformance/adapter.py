"""What is judged: what stands between the laws and an implementation, and its form for the oracle itself.

Everything crosses the border as NumPy float64 (ids int64), in the oracle's names and shapes, one camera at a time. An
adapter says with `has` what its implementation can do; laws that need more are skipped by name.

The oracle that others are compared with (`Reference`) keeps its latest answers: laws begin with the same scenes, and
each backend is tried on those of the backend before it. The oracle that is judged itself keeps nothing.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import sys
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any, Final

import numpy as np

from pop_ref.conformance.calls import Call, Called, drawn_scene
from pop_ref.conformance.capabilities import (
    ALL_BANDS,
    ANTIALIASING,
    DETERMINISTIC,
    DOMINANCE,
    DOMINANT_COUNTS,
    DOMINANT_WEIGHTS,
    DOUBLE,
    GRADIENTS,
    RENDER,
    ROWWISE,
    SCALE,
    SIGNATURE,
    capabilities_of,
    same_constants,
)
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.scenes import Scene, golden_scene, rounded_to
from pop_ref.conformance.views import ASKED, refusal
from pop_ref.constants import PAPER, Profile
from pop_ref.records import Splats
from pop_ref.splatting import project, project_vjp
from pop_ref.tiles import tile_lists

STAGE_MODULES = (
    "activations", "covariance", "harmonics", "camera", "projection", "footprint", "tiles", "alpha", "pixel",
    "compositing", "dominance", "margins", "ssim", "losses", "polarization", "regularizers", "appearance",
    "refinement", "density_rows", "density", "optimizer", "training", "methods",
    "short_training", "contributions", "sensitivity", "fisher", "chord", "selection", "taming", "mini_splatting",
    "tight_tiles",
)  # fmt: skip
# what a view may tell of dominance, by capability
TOLD_OF_DOMINANCE = {
    DOMINANCE: "dominant_ids",
    DOMINANT_WEIGHTS: "dominant_weights",
    DOMINANT_COUNTS: "dominant_counts",
}


@dataclass(frozen=True)
class View:
    """What a rasterizer shows of one render; None where it shows nothing.

    Attributes:
        image: [H, W, 3]
        T_final: [H, W]
        dominant_ids, dominant_weights, n_blended, n_traversed: [H, W]
        dominant_counts: [N]
        radii: [N, 2]
        means2d, depths, conics: [N, 2], [N], [N, 3]; read only for the report of a failure
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
    depths: Any = None
    conics: Any = None


class Adapter:
    """An implementation under judgement; subclass it and define what the implementation has.

    A stage is judged through a method of the oracle's name and parameters, on arrays. With `composite` alone whole
    scenes are drawn from the oracle's splats and tile lists, with `composite_vjp` too they have gradients. `render`
    and `gradients` replace both. What is not defined is skipped by name.

    Attributes:
        name: how reports call it.
        dtype: the NumPy type of the precision it computes in; its rounding is bounded in units of that type's eps.
        profile: the constants that it implements; None when it takes any, which scenes then carry.
        sh_degree: of the highest harmonics that it takes; scenes are drawn without those beyond.
        able: what cannot be seen otherwise: ANTIALIASING, DETERMINISTIC, DOMINANCE, ROWWISE of `capabilities`.

    Example:
        >>> class Mine(Adapter):
        ...     name = "mine"
        ...
        ...     def falloff(self, sigma):
        ...         return float(np.exp(np.float32(-sigma)))
        >>> Mine().has("falloff"), Mine().has(RENDER)
        (True, False)
    """

    name: str = "adapter"
    dtype: Any = np.float32
    profile: Profile | None = PAPER
    sh_degree: int = 3
    able: tuple[str, ...] = ()

    def has(self, need: str) -> bool:
        """Tell whether the implementation offers a stage function, or one of the capabilities of `capabilities`."""
        if need == RENDER:
            return type(self).render is not Adapter.render or self.has("composite")
        if need == GRADIENTS:
            return type(self).gradients is not Adapter.gradients or self.has("composite_vjp")
        if need == DOUBLE:
            return bool(self.dtype == np.float64)
        if need in (DOMINANT_WEIGHTS, DOMINANT_COUNTS):
            return self.has(DOMINANCE) and self._tells(need)
        if need == SIGNATURE:
            return callable(getattr(self, "call", None))
        if need in ASKED:
            return self.has(SIGNATURE) and self.why_not(need) is None
        if need == SCALE:
            return self.has(RENDER)
        if need == ALL_BANDS:
            return self.sh_degree >= 3
        return need in self.able or need in capabilities_of(self.profile) or callable(getattr(self, need, None))

    def takes(self, argument: str) -> bool:
        """Tell whether the rasterizer has an argument that changes how it works and no image: tile_size, dominance."""
        return argument == "tile_size"

    def why_not(self, need: str) -> str | None:
        """Return in what words the rasterizer refuses an argument of gsplat's signature; None if it does not.

        It is asked once.

        Args:
            need: a capability of `views.ASKED`.
        """
        known: dict[str, str | None] = self.__dict__.setdefault("_known_refusals", {})
        if need not in known:
            known[need] = refusal(self, need)
        return known[need]

    def _tells(self, need: str) -> bool:
        """Tell whether a render shows something of dominance; one is drawn to learn it."""
        known: dict[str, bool] = self.__dict__.setdefault("_known_tellings", {})
        if not known:
            view = self.render(self.sees(golden_scene()))
            known |= {each: getattr(view, name) is not None for each, name in TOLD_OF_DOMINANCE.items()}
        return known[need]

    def stage(self, name: str) -> Callable[..., Any]:
        """Return a stage function that takes and returns NumPy arrays.

        Constants that the implementation does not offer set the example aside.
        """
        function = getattr(self, name, None)
        if not callable(function):
            raise LookupError(f"{self.name} has no stage function {name}")

        def within_its_constants(*args: Any, **kwargs: Any) -> Any:
            own = self.profile
            given = [a for a in (*args, *kwargs.values()) if isinstance(a, Profile)]
            if own is not None and not all(same_constants(each, own) for each in given):
                from hypothesis import reject

                reject()
            return function(*args, **kwargs)

        return within_its_constants

    def sees(self, scene: Scene) -> Scene:
        """Return the scene as the implementation reads it: rounded to its dtype, under the constants and with the bands
        of harmonics that it has."""
        return rounded_to(within_bands(under(scene, self.profile), self.sh_degree), self.dtype)

    def render(self, scene: Scene) -> View:
        """Draw a scene; by default the oracle projects and lists, and `composite` blends."""
        camera, size = scene.camera, scene.side
        splats, lists = projected(scene)
        drawn = self.stage("composite")(
            splats, lists, camera.width, camera.height, size, scene.background, scene.profile
        )
        found = {f.name: getattr(drawn, f.name, None) for f in fields(View)}
        return View(**{**found, **_shown(splats)})

    def plainly(self, scene: Scene) -> View:
        """Draw a scene as training does that wants nothing but an image; what is not asked for is None."""
        return self.render(scene)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return cotangents by name: means, quats, scales, opacities, sh, and those of viewmat, background, means2d,
        means2d_abs that the implementation offers; by default those of `composite_vjp`, projected by the oracle."""
        camera, size = scene.camera, scene.side
        splats, lists = projected(scene)
        v = self.stage("composite_vjp")(
            splats, lists, camera.width, camera.height, size, v_image, v_T_final, scene.background, scene.profile
        )
        of = project_vjp(
            scene.gaussians,
            camera,
            v.v_means2d,
            v.v_conics,
            v.v_opacities,
            v.v_colors,
            sh_degree=scene.sh_degree,
            profile=scene.profile,
            antialiased=scene.antialiased,
        )
        found = {name: getattr(of, name) for name in ("means", "quats", "scales", "opacities", "sh", "viewmat")}
        found |= {"background": v.v_background, "means2d": v.v_means2d}
        absolute = getattr(v, "v_means2d_abs", None)
        return found if absolute is None else {**found, "means2d_abs": absolute}


def under(scene: Scene, profile: Profile | None) -> Scene:
    """Return the scene under a profile, its own for None.

    Where the principal point is the image's centre, Gaussians are moved sideways so that they stay where they were on
    the screen; where extents are square, the grid is part of the meaning (D3) and takes the profile's tile size.
    """
    if profile is None:
        return scene
    changes: dict[str, Any] = {"profile": profile}
    if profile.extent == "square":
        changes["tile_size"] = None
    if profile.principal_point == "centred":
        K, viewmat = scene.camera.K.copy(), scene.camera.viewmat
        depths = scene.gaussians.means @ viewmat[2, :3] + viewmat[2, 3]
        centre = 0.5 * np.array([scene.camera.width, scene.camera.height])
        aside = depths[:, None] * (K[:2, 2] - centre) / np.array([K[0, 0], K[1, 1]])
        K[:2, 2] = centre
        changes |= {"K": K, "means": scene.gaussians.means + aside @ viewmat[:2, :3]}
    return scene.with_overrides(**changes)


def within_bands(scene: Scene, degree: int) -> Scene:
    """Return the scene without harmonics beyond a degree."""
    sh, used = scene.gaussians.sh[:, : (degree + 1) ** 2], scene.sh_degree
    if sh.shape == scene.gaussians.sh.shape:
        return scene
    return scene.with_overrides(sh=sh, sh_degree=None if used is None else min(used, degree))


def _shown(splats: Any) -> dict[str, Any]:
    return {name: getattr(splats, name) for name in ("radii", "means2d", "depths", "conics")}


def projected(scene: Scene) -> tuple[Splats, list[list[int]]]:
    """Project a scene and list its splats, by the oracle: what stage functions of whole views take."""
    camera = scene.camera
    size = scene.side
    # the square extent's cull reads the grid from the profile
    profile = replace(scene.profile, tile_size=size)
    splats = project(scene.gaussians, camera, scene.sh_degree, profile, scene.antialiased)
    lists = tile_lists(splats.means2d, splats.radii, splats.depths, camera.width, camera.height, size, profile)
    return splats, lists


def stage_function(package: str, name: str) -> Callable[..., Any] | None:
    """Return the public function of that name from a package's stage modules, or None."""
    for module_name in STAGE_MODULES:
        module = _module(f"{package}.{module_name}")
        function = getattr(module, name, None)
        if module and inspect.isfunction(function) and function.__module__ == module.__name__:
            return function
    return None


def _module(name: str) -> ModuleType | None:
    # a stage that an implementation does not have is a skipped law, a stage that fails to import is a bug
    return sys.modules.get(name) or (importlib.import_module(name) if _is_there(name) else None)


# every law asks again for what it needs, and to look for a file that is not there takes longer than most laws' examples
@functools.cache
def _is_there(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


class OracleAdapter(Adapter):
    """The oracle as a backend of its own laws; also any copy of it under another package name, as mutants are."""

    dtype = np.float64
    profile = None
    able = (ANTIALIASING, DETERMINISTIC, DOMINANCE, ROWWISE)

    def __init__(self, package: str = "pop_ref", name: str = "oracle") -> None:
        self.name = name
        self.package = package

    def has(self, need: str) -> bool:
        """Tell that the oracle can do everything its modules define, slowly."""
        return need != SCALE and (super().has(need) or stage_function(self.package, need) is not None)

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
        return View(**common, **_shown(drawn.splats))

    def full_render(self, scene: Scene) -> Any:
        """Draw a scene and return the oracle's own `Render`, with the splats and tile lists."""
        module = importlib.import_module(f"{self.package}.render")
        return module.render(*self._own(scene), **scene.options)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return the cotangents of `render.render_vjp`."""
        module = importlib.import_module(f"{self.package}.render")
        g = module.render_vjp(*self._own(scene), v_image=v_image, v_T_final=v_T_final, **scene.options)
        return {f.name: np.asarray(getattr(g, f.name)) for f in fields(g) if getattr(g, f.name) is not None}

    def call(self, call: Call, v_images: Any = None, v_alphas: Any = None) -> Called:
        """Draw every frame of a call by itself.

        Raises:
            NotImplementedError: the call asks for another form of arguments or of meta.
        """
        if call.packed or call.covars or call.sparse_grad:
            raise NotImplementedError("the oracle takes quaternions and scales, and has neither packed nor sparse rows")
        module = importlib.import_module(f"{self.package}.render")
        images, alphas, pulled = [], [], []
        for b, c, frame in call.each:
            scene = drawn_scene(call, frame)
            options = {**scene.options, "colors": frame.colors, "render_mode": call.render_mode}
            drawn = module.render(*self._own(scene), **options)
            images.append(drawn.image)
            alphas.append(1.0 - drawn.T_final)
            if v_images is not None:
                v = (v_images[b, c], -v_alphas[b, c])
                pulled.append(module.render_vjp(*self._own(scene), v_image=v[0], v_T_final=v[1], **options))
        shape = (len(call.frames), len(call.frames[0]))
        gradients = _gathered(call, pulled, shape) if pulled else {}
        return Called(_folded(images, shape), _folded(alphas, shape), {}, gradients)

    def _own(self, scene: Scene) -> tuple[Any, Any]:
        # a copy of the oracle has value types of its own
        types = importlib.import_module(f"{self.package}.records")
        g, c = scene.gaussians, scene.camera
        own_g = g if isinstance(g, types.Gaussians) else types.Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh)
        own_c = c if isinstance(c, types.Camera) else types.Camera(c.viewmat, c.K, c.width, c.height)
        return own_g, own_c


def _folded(rows: list[np.ndarray], shape: tuple[int, int]) -> np.ndarray:
    return np.array(rows).reshape(*shape, *rows[0].shape)


def _gathered(call: Call, pulled: list[Any], shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return the gradients of a call's arguments in their shapes: summed over the cameras that share one."""
    names = {"viewmats": "viewmat", "backgrounds": "background"}
    plain = call.sh_degree is None
    found = {}
    for name in call.tensors():
        rows = [getattr(g, "sh" if name == "colors" and not plain else names.get(name, name)) for g in pulled]
        value = _folded(rows, shape)
        own = name in names or (name == "colors" and call.camera_colors)
        value = value if own else np.sum(value, axis=1)
        found[name] = call.batched(value)
    return found | {name: _folded([getattr(g, name) for g in pulled], shape) for name in ("means2d", "means2d_abs")}


def oracle_view(scene: Scene) -> View:
    """Draw a scene with the oracle."""
    return OracleAdapter().render(scene)


__all__ = ["Adapter", "OracleAdapter", "View", "oracle_view", "projected", "rounded_to", "stage_function"]


# answers, of small images; a law has at most fifty scenes, and its backends follow each other
KEPT: Final = 192
# Gaussians of the largest scene that is remembered
LARGEST: Final = 256

# the answers of every function that keeps some
_ALL: Final[list[OrderedDict[Hashable, Any]]] = []


def forget() -> None:
    """Forget every answer; whoever breaks the oracle itself must, before and after."""
    for kept in _ALL:
        kept.clear()


def remembered(answer: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a scene and of arrays or plain values that keeps its latest answers, which are read only."""
    kept: OrderedDict[Hashable, Any] = OrderedDict()
    _ALL.append(kept)

    @functools.wraps(answer)
    def asked(scene: Scene, *more: Any) -> Any:
        if len(scene.gaussians) > LARGEST:
            return answer(scene, *more)
        key = (_scene_key(scene), *map(_key, more))
        if key not in kept:
            kept[key] = answer(scene, *more)
            if len(kept) > KEPT:
                kept.popitem(last=False)
        kept.move_to_end(key)
        return kept[key]

    return asked


def _scene_key(scene: Scene) -> Hashable:
    g, camera = scene.gaussians, scene.camera
    arrays = (g.means, g.quats, g.scales, g.opacities, g.sh, camera.viewmat, camera.K, scene.background)
    plain = (camera.width, camera.height, scene.profile, scene.tile_size, scene.sh_degree, scene.antialiased)
    return (*map(_key, arrays), *plain)


def _key(value: Any) -> Hashable:
    # the bits, in which 0.0 and -0.0 differ
    return (value.shape, value.dtype.str, value.tobytes()) if isinstance(value, np.ndarray) else value


class Reference(OracleAdapter):
    """The oracle, whose renders and gradients of a scene are computed once."""

    def render(self, scene: Scene) -> View:
        """Draw a scene, or return what was drawn of it."""
        return _render(scene)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return the cotangents of `render.render_vjp`."""
        return dict(_gradients(scene, v_image, v_T_final))


_ORACLE: Final = OracleAdapter()


@remembered
def _render(scene: Scene) -> View:
    return _ORACLE.render(scene)


@remembered
def _gradients(scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
    return _ORACLE.gradients(scene, v_image, v_T_final)


@remembered
def error_bounds_of(scene: Scene, dtype: Any) -> PixelErrorBounds:
    """Return a scene's error bounds in a precision; of square extents with the oracle's own tile lists."""
    lists = _ORACLE.full_render(scene).tile_lists if scene.profile.extent == "square" else None
    return pixel_error_bounds(scene, dtype, lists)
