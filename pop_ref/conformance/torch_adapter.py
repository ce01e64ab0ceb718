"""Adapters for torch programs: a function with gsplat's `rasterization` signature, and stage functions on tensors.

torch is imported when an adapter is made, never when the kit is.
"""

from __future__ import annotations

import functools
import gc
import importlib
import inspect
import itertools
import sys
import weakref
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import reject

from pop_ref.conformance.adapter import TOLD_OF_DOMINANCE, Adapter, View, stage_function, under, within_bands
from pop_ref.conformance.calls import Call, Called, unpacked
from pop_ref.conformance.capabilities import (
    ANTIALIASING,
    DETERMINISTIC,
    GRADIENTS,
    INSTRUMENTS,
    RENDER,
    SIGNATURE,
    same_constants,
)
from pop_ref.conformance.cases import BY_NAME, Case, with_own_lists
from pop_ref.conformance.scenes import Scene, golden_scene, rounded_to
from pop_ref.conformance.torch_autograd import Ask, Differentiated, Laid, differentiated
from pop_ref.conformance.views import refuses_on_purpose
from pop_ref.constants import PAPER, Profile


class _CountedWhenRead(View):
    """A view whose tallies come from a second render, made when a law first reads them: most laws never do."""

    @classmethod
    def of(cls, drawn: View, again: Callable[[], View]) -> View:
        view = cls(**vars(drawn))
        vars(view)["again"] = again
        return view

    @functools.cached_property
    def _counted(self) -> View:
        again: Callable[[], View] = vars(self)["again"]
        return again()

    def __getattribute__(self, name: str) -> Any:
        if name in ("n_blended", "n_traversed"):
            return getattr(self._counted, name)
        return super().__getattribute__(name)


def _laid(call: Call, value: Any, wanted: bool) -> Laid:
    """Lay an argument of a call in memory as it asks; what has no memory of its own keeps that of the others."""
    if not value.is_contiguous():
        return Laid(value, "kept", wanted)
    # torch takes no sparse gradient back through a view
    return Laid(value, "dense" if call.sparse_grad else call.layout, wanted)


class TorchAdapter(Adapter):
    """A torch rasterizer and, when a package is named, its stage functions.

    What is not asked for may be drawn by other code. So a program that is asked for dominance and counts by arguments
    of these names is asked as POP's training asks for dominance where an image is judged, and for nothing, as any
    other training, where a gradient is and where an image is judged `plainly`. `otherwise` has every choice's.

    Args:
        name: how reports call it.
        rasterization: a function with gsplat's signature, or None to judge stage functions only.
        package: a package whose stage modules carry the oracle's names, or None.
        stages: stage functions on tensors by the oracle's names, besides those of the package.
        without_gradients: names of gradients that the program does not offer.
        dtype: "float64" or "float32".
        device: a torch device.
        profile: the profile that a function without a `profile` argument implements.
        deterministic: whether sums are taken in the same order on every run, as with atomics they are not.
        whole_signature: whether the laws of gsplat's other arguments are asked; False for a function that takes them
            for show.
    """

    def __init__(
        self,
        name: str,
        rasterization: Callable[..., Any] | None = None,
        package: str | None = None,
        dtype: str = "float64",
        device: str = "cpu",
        profile: Profile = PAPER,
        stages: Mapping[str, Callable[..., Any]] | None = None,
        without_gradients: tuple[str, ...] = (),
        deterministic: bool = True,
        whole_signature: bool = True,
    ) -> None:
        self.name = name
        self._stages, self._without = dict(stages or {}), without_gradients
        self.dtype = {"float64": np.float64, "float32": np.float32}[dtype]
        self._torch = importlib.import_module("torch")
        self._float = getattr(self._torch, dtype)
        self.device = self._device = device
        self._package = package
        self._rasterization = rasterization
        parameters = inspect.signature(rasterization).parameters if rasterization else {}
        self._takes_profile = "profile" in parameters
        # stage functions of a package take the profile that they are given
        takes_any = self._takes_profile or (rasterization is None and package is not None)
        self.profile = None if takes_any else profile
        self.able = (*(ANTIALIASING,) * ("rasterize_mode" in parameters), *(DETERMINISTIC,) * deterministic)
        self._whole_signature = whole_signature
        self._takes_anything = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        self._parameters = frozenset(parameters)
        self._takes_absgrad = "absgrad" in parameters or self._takes_anything
        self._instruments = tuple(name for name in ("dominance", "counts") if name in parameters)
        self._has_gradients: bool | None = None if rasterization else False
        self._chosen = tuple(name for name in ("absgrad", *self._instruments) if name in parameters)

    def has(self, need: str) -> bool:
        """Tell what the program offers; the rasterizer is asked once for its gradients, and for its meta."""
        if need == RENDER or need in TOLD_OF_DOMINANCE:
            return self._rasterization is not None and (need == RENDER or self._tells(need))
        if need == GRADIENTS:
            if self._has_gradients is None:
                self._has_gradients = self._asked_for_gradients()
            return self._has_gradients
        if need == INSTRUMENTS:
            return self._rasterization is not None and bool(self._chosen)
        if need == SIGNATURE:
            return self._rasterization is not None and self._whole_signature
        return super().has(need) or self._stage(need) is not None

    def takes(self, argument: str) -> bool:
        """Tell whether the rasterizer's signature has the argument."""
        return argument in self._parameters or (argument == "tile_size" and self._takes_anything)

    def sees(self, scene: Scene) -> Scene:
        """Return the scene as the rasterizer reads it: with tiles of its own side where it takes none."""
        seen = super().sees(scene)
        if self._rasterization is None or self.takes("tile_size") or seen.profile.extent == "square":
            return seen
        return seen.with_overrides(tile_size=self.own_tile_size)

    @functools.cached_property
    def sh_degree(self) -> int:  # type: ignore[override]  # other adapters state it; a rasterizer is asked when it is read
        """Give the highest degree of harmonics that the rasterizer does not refuse; it is asked once."""
        scene = under(golden_scene(), self.profile)
        sh = np.pad(scene.gaussians.sh, ((0, 0), (0, 12), (0, 0)))
        for degree in (3, 2, 1, 0) if self._rasterization is not None else ():
            asked = rounded_to(within_bands(scene.with_overrides(sh=sh), degree), self.dtype)
            try:
                self._call(asked, self._leaves(asked, grad=False), dominance=False, counts=False)
            except Exception as error:
                if refuses_on_purpose(error):
                    continue
            return degree
        # what draws nothing, or fails otherwise, is for the laws to find
        return 3

    @functools.cached_property
    def own_tile_size(self) -> int | None:
        """Give the side of the tiles of a rasterizer that takes none, as its meta tells it; None if it does not. px"""
        scene = super().sees(golden_scene())
        try:
            meta = self._call(scene, self._leaves(scene, grad=False), dominance=False, counts=False)[2]
            return int(meta["tile_size"])
        except Exception:
            # it tells nothing, or cannot draw, which the laws will find
            return None

    def first_error(self) -> Exception | None:
        """Draw one small picture, and again with gradients; return what is raised in its place, None if nothing is."""
        try:
            self._drawn(super().sees(golden_scene()), dominance=False, counts=False)
            self.has(GRADIENTS)
        except Exception as error:
            return error
        return None

    def _asked_for_gradients(self) -> bool:
        """Tell whether an image follows its Gaussians in autograd; a renderer that only draws does not."""
        scene = self.sees(golden_scene())
        try:
            image, _, _ = self._call(scene, self._leaves(scene, grad=True), dominance=False, counts=False)
        except NotImplementedError:
            return False
        except RuntimeError as error:
            # what leaves torch on its way, to NumPy or to a foreign kernel, says that a tensor requires grad; so does
            # what writes over its arguments, which is a fault
            if "requires grad" not in str(error) or "in-place" in str(error):
                raise
            return False
        return bool(image.requires_grad)

    def _stage(self, name: str) -> Callable[..., Any] | None:
        found = self._stages.get(name)
        if found is None and self._package is not None:
            found = stage_function(self._package, name)
        base = name.removesuffix("_vjp")
        if found is None and base != name and base in BY_NAME:
            forward = self._stage(base)
            return None if forward is None or not BY_NAME[base].wrt else self._by_autograd(BY_NAME[base], forward)
        return found

    def _by_autograd(self, case: Case, forward: Callable[..., Any]) -> Callable[..., Any]:
        """Return the transpose that torch derives of a stage function."""

        def pull(*args: Any) -> Any:
            at = len(args) - 1 if case.cotangent_at is None else case.cotangent_at
            inputs, v = [*args[:at], *args[at + 1 :]], args[at]
            leaves = [inputs[k].detach().clone().requires_grad_(True) for k in case.wrt]
            for k, leaf in zip(case.wrt, leaves, strict=True):
                inputs[k] = leaf
            out = forward(*inputs)
            if not out.requires_grad:
                # a constant, as degree 0 is
                grads: Any = [None] * len(leaves)
            else:
                grads = self._torch.autograd.grad(
                    out, leaves, self._torch.as_tensor(v, dtype=out.dtype), allow_unused=True
                )
            pulled: tuple[Any, ...] = tuple(
                self._torch.zeros_like(x) if g is None else g for g, x in zip(grads, leaves, strict=True)
            )
            if len(pulled) == 1:
                return pulled[0]
            return pulled

        return pull

    def stage(self, name: str) -> Callable[..., Any]:
        """Return a stage function wrapped so that arrays go in as tensors and come out as arrays.

        Constants that the implementation does not offer set the example aside.
        """
        function = self._stage(name)
        if function is None:
            raise LookupError(f"{self.name} has no stage function {name}")
        # the types of the function that a decorator has wrapped are those that it takes
        own = sys.modules.get(inspect.unwrap(function).__module__)

        def with_arrays(*args: Any, **kwargs: Any) -> Any:
            if any(isinstance(a, Profile) and not self._implements(a) for a in (*args, *kwargs.values())):
                reject()
            args, kwargs = with_own_lists(function, args, kwargs)
            tensors = {key: self._tensor(value, own) for key, value in kwargs.items()}
            return self._array(function(*[self._tensor(a, own) for a in args], **tensors))

        return with_arrays

    def _implements(self, profile: Profile) -> bool:
        return self._package is not None or self.profile is None or same_constants(profile, self.profile)

    def render(self, scene: Scene) -> View:
        """Draw a scene with one camera: as POP trains, and the tallies as where they are asked for."""
        drawn = self._drawn(scene, dominance=True, counts=False)
        if "counts" not in self._instruments:
            return drawn
        return _CountedWhenRead.of(drawn, lambda: self._drawn(scene, dominance=True, counts=True))

    def otherwise(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, tuple[View, dict[str, np.ndarray]]]:
        """Return, by what is asked for, the render and the gradients of every choice; the first is to ask for nothing
        but the absolute gradients of the screen means.

        Args:
            scene: to be drawn.
            v_image, v_T_final: cotangents.
        """
        nothing = {"dominance": False, "counts": False}
        found = {
            "absolute gradients": self._pulled(scene, v_image, v_T_final, **nothing),
            "nothing": self._pulled(scene, v_image, v_T_final, **nothing, absgrad=False),
        }
        found["an image"] = (self._drawn(scene, **nothing), found["nothing"][1])
        for asked in ("dominance", "dominance and counts") if self._instruments else ():
            chosen = {"dominance": True, "counts": "counts" in asked}
            found[asked] = self._pulled(scene, v_image, v_T_final, **chosen)
            found[f"{asked} of an image"] = (self._drawn(scene, **chosen), found[asked][1])
        return found

    def plainly(self, scene: Scene) -> View:
        """Draw a scene that gradients may follow from, and ask for nothing else."""
        return self._drawn(scene, dominance=False, counts=False, grad=True)

    def differentiate(self, scene: Scene, v_image: Any, v_T_final: Any, ask: Ask) -> Differentiated:
        """Draw a scene and pull cotangents back in an order of passes, and of arguments in a layout, as it is asked."""

        def draw(of: Scene, arguments: dict[str, Any]) -> tuple[Any, Any]:
            image, alphas, _ = self._call(of, arguments, dominance=False, counts=False, packed=ask.packed)
            return image, alphas

        def leaves(of: Scene, grad: bool) -> dict[str, Any]:
            return self._leaves(of, grad) | {"K": self._tensor(of.camera.K[None])}

        arrays = (self._tensor(v_image), self._tensor(v_T_final))
        return differentiated(scene, draw, leaves, arrays, ask, self._without)

    def forgets(self, scene: Scene) -> tuple[str, ...]:
        """Draw a scene, go back and let go of everything; draw another; return what is still there of the first."""

        def drawn(of: Scene) -> dict[str, Any]:
            leaves = self._leaves(of, grad=True)
            image, alphas, _ = self._call(of, leaves, dominance=False, counts=False)
            (image.sum() + alphas.sum()).backward()
            found = leaves | {"image": image, "alphas": alphas}
            return {name: weakref.ref(value) for name, value in found.items()}

        first = drawn(scene)
        drawn(scene.with_overrides(opacities=0.5 * scene.gaussians.opacities))
        gc.collect()
        return tuple(name for name, value in first.items() if value() is not None)

    def _drawn(self, scene: Scene, dominance: bool, counts: bool, grad: bool = False) -> View:
        leaves = self._leaves(scene, grad)
        return self._view(scene, self._call(scene, leaves, dominance, counts), dominance, counts)

    def _view(self, scene: Scene, drawn: Any, dominance: bool, counts: bool) -> View:
        image, alphas, meta = drawn
        H, W, N = scene.camera.height, scene.camera.width, len(scene.gaussians)
        if image.shape[-3:-1] != (H, W):
            raise ValueError(f"images have shape {[*image.shape]}; they must be [cameras, {H}, {W}, channels]")
        T_final = meta.get("final_T")
        shown: dict[str, Any] = {}
        # reading what was not asked for may draw anew
        if dominance or "dominance" not in self._instruments:
            shown |= {name: (name, (H, W)) for name in ("dominant_ids", "dominant_weights")}
            shown["dominant_counts"] = ("dominant_counts", (N,))
        if counts or "counts" not in self._instruments:
            shown |= {"n_blended": ("n_contrib", (H, W)), "n_traversed": ("n_traversed", (H, W))}
        shapes = {"radii": (N, 2), "means2d": (N, 2), "depths": (N,), "conics": (N, 3)}
        shown |= {name: (name, shape) for name, shape in shapes.items()}
        return View(
            image=self._array(image).reshape(H, W, -1),
            T_final=self._array(T_final if T_final is not None else 1.0 - alphas).reshape(H, W),
            **{name: self._told(meta, key, shape) for name, (key, shape) in shown.items()},
        )

    def _told(self, meta: Any, key: str, shape: tuple[int, ...]) -> np.ndarray | None:
        value = meta.get(key)
        if value is None:
            return None
        array = np.asarray(self._array(value))
        if array.size != np.prod(shape):
            raise ValueError(f"meta[{key!r}] has shape {[*array.shape]}; of one camera it must be {[1, *shape]}")
        return array.reshape(shape)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return autograd's cotangents; those of the screen means when the meta keeps them."""
        return self._pulled(scene, v_image, v_T_final, dominance=False, counts=False)[1]

    def _pulled(
        self, scene: Scene, v_image: Any, v_T_final: Any, dominance: bool, counts: bool, absgrad: bool = True
    ) -> tuple[View, dict[str, np.ndarray]]:
        leaves = self._leaves(scene, grad=True)
        asked = self._absgrad if absgrad else {}
        image, alphas, meta = drawn = self._call(scene, leaves, dominance, counts, **asked)
        view = self._view(scene, drawn, dominance, counts)
        means2d = meta.get("means2d")
        if means2d is not None and means2d.requires_grad:
            means2d.retain_grad()
        H, W = scene.camera.height, scene.camera.width
        loss = (image.reshape(H, W, -1) * self._tensor(v_image)).sum()
        loss = loss - (alphas.reshape(H, W) * self._tensor(v_T_final)).sum()
        if loss.requires_grad:
            loss.backward()
        found = {name: self._grad_of(leaf) for name, leaf in leaves.items()}
        found["background"], found["viewmat"] = found["background"].reshape(-1), found["viewmat"].reshape(4, 4)
        N = len(scene.gaussians)
        if means2d is not None:
            found["means2d"] = self._grad_of(means2d).reshape(N, 2)
            if getattr(means2d, "absgrad", None) is not None:
                found["means2d_abs"] = self._array(means2d.absgrad).reshape(N, 2)
        return view, {key: value for key, value in found.items() if key not in self._without}

    @property
    def _absgrad(self) -> dict[str, bool]:
        return {"absgrad": True} if self._takes_absgrad else {}

    def call(self, call: Call, v_images: Any = None, v_alphas: Any = None) -> Called:
        """Make a whole call as it is written, and pull cotangents of its images and alphas back.

        Args:
            call: what is asked.
            v_images, v_alphas: cotangents [B, C, H, W, X] and [B, C, H, W], or None for the images alone.
        """
        if self._rasterization is None:
            raise LookupError(f"{self.name} has no rasterization function")
        pulls, (B, C, _), camera = v_images is not None, call.shape, call.first.scene.camera
        of = {name: self._entries(call, value) for name, value in call.tensors().items()}
        laid = {name: _laid(call, value, pulls and name not in call.frozen) for name, value in of.items()}
        laid["Ks"] = _laid(call, self._tensor(call.intrinsics()), False)
        # where nothing is pulled back torch is told so, as in an evaluation
        with self._torch.set_grad_enabled(pulls):
            images, alphas, meta = self._rasterization(
                **{name: self._tensor(value) for name, value in call.without_gradients().items()}
                | {name: each.view for name, each in laid.items()},
                width=(W := camera.width),
                height=(H := camera.height),
                sh_degree=call.sh_degree,
                **self._taken(packed=call.packed, tile_size=call.tile_size, **self._asked_by(call)),
                **(self._absgrad if pulls and call.absgrad else {}),
            )
        assert images.shape[:-1] == (*call.batch, C, H, W), f"images have shape {[*images.shape]}"
        strange = self._strange(images, alphas, meta)
        images, alphas = images.reshape(B, C, H, W, -1), alphas.reshape(B, C, H, W)
        gradients: dict[str, np.ndarray] = {}
        if pulls:
            means2d = meta.get("means2d")
            if means2d is not None and means2d.requires_grad:
                means2d.retain_grad()
            loss = (images * self._tensor(v_images)).sum() + (alphas * self._tensor(v_alphas)).sum()
            # a picture of nothing over no background may follow nothing
            if loss.requires_grad:
                loss.backward()
            given = [name for name in of if name not in (*self._without, *call.frozen)]
            gradients = {name: self._grad_of(laid[name]) for name in given}
            if means2d is not None and means2d.requires_grad:
                absolute = getattr(means2d, "absgrad", None)
                of_screen = {"means2d": self._grad_of(means2d)}
                of_screen |= {} if absolute is None else {"means2d_abs": self._array(absolute)}
                rows = {name: unpacked(call, value, meta) for name, value in of_screen.items()}
                gradients |= {name: value for name, value in rows.items() if value is not None}
        shown = {name: self._array(meta[name]) for name in meta if meta[name] is not None}
        of["Ks"] = self._tensor(call.intrinsics())
        changed = tuple(name for name, each in laid.items() if not self._torch.equal(each.view.detach(), of[name]))
        return Called(self._array(images), self._array(alphas), shown, gradients, changed, strange)

    def _strange(self, images: Any, alphas: Any, meta: dict[str, Any]) -> tuple[str, ...]:
        """Say what is not as gsplat documents it: a channel of alphas, the type of the Gaussians, integers as ids."""
        said = []
        if alphas.shape != (*images.shape[:-1], 1):
            said.append(f"alphas have shape {[*alphas.shape]}; it must be {[*images.shape[:-1], 1]}")
        for name, value in (("images", images), ("alphas", alphas)):
            if value.dtype != self._float:
                said.append(f"{name} are of {value.dtype}; the Gaussians are of {self._float}")
        for name in ("batch_ids", "camera_ids", "gaussian_ids", "flatten_ids", "isect_offsets"):
            if meta.get(name) is not None and meta[name].is_floating_point():
                said.append(f"meta[{name!r}] is of {meta[name].dtype}; what numbers things must be of integers")
        return tuple(said)

    def _entries(self, call: Call, value: np.ndarray) -> Any:
        """Return an argument of a call; expanded, if it is the same in all batch entries and the call asks for that."""
        first = value[(slice(0, 1),) * len(call.batch)]
        if call.expanded and np.array_equal(np.broadcast_to(first, value.shape), value):
            return self._tensor(first).expand(value.shape)
        return self._tensor(value)

    def _asked_by(self, call: Call) -> dict[str, Any]:
        """Return the arguments of a call that are not at gsplat's defaults, and the profile where one is taken."""
        scene = call.first.scene
        asked: dict[str, Any] = {"near_plane": scene.profile.near_plane, "eps2d": scene.profile.eps2d} | call.planes
        asked |= {"render_mode": call.render_mode} if call.render_mode != "RGB" else {}
        asked |= {"radius_clip": call.radius_clip} if call.radius_clip else {}
        asked |= {"sparse_grad": True} if call.sparse_grad else {}
        asked |= {"rasterize_mode": "antialiased"} if call.antialiased else {}
        asked |= {"dominance": call.dominance} if self.takes("dominance") else {}
        return asked | ({"profile": scene.profile} if self._takes_profile else {})

    def _taken(self, **options: Any) -> dict[str, Any]:
        """Return the options without those that the rasterizer's signature lacks and that are at its own constants.

        The side of a tile is how a rasterizer works, not what it draws; where it does (square extents, D3), its
        profile has it.
        """
        unknown = set() if self._takes_anything else options.keys() - self._parameters
        constants = self.profile or PAPER
        neutral = {"packed": False, "near_plane": constants.near_plane, "eps2d": constants.eps2d}
        return {
            name: value
            for name, value in options.items()
            if name not in unknown or (name != "tile_size" and value != neutral.get(name))
        }

    def _leaves(self, scene: Scene, grad: bool) -> dict[str, Any]:
        g, c = scene.gaussians, scene.camera
        named = {
            "means": g.means,
            "quats": g.quats,
            "scales": g.scales,
            "opacities": g.opacities,
            "sh": g.sh,
            "viewmat": c.viewmat[None],
            "background": scene.background[None],
        }
        return {name: self._tensor(value).requires_grad_(grad) for name, value in named.items()}

    def _call(self, scene: Scene, leaves: dict[str, Any], dominance: bool, counts: bool, **more: Any) -> Any:
        if self._rasterization is None:
            raise LookupError(f"{self.name} has no rasterization function")
        asked = {"dominance": dominance, "counts": counts}
        options: dict[str, Any] = {"packed": False, **more, **{name: asked[name] for name in self._instruments}}
        if self._takes_profile:
            options["profile"] = scene.profile
        if scene.antialiased:
            options = {"rasterize_mode": "antialiased", **options}
        return self._rasterization(
            leaves["means"],
            leaves["quats"],
            leaves["scales"],
            leaves["opacities"],
            leaves["sh"],
            leaves["viewmat"],
            leaves["K"] if "K" in leaves else self._tensor(scene.camera.K[None]),
            scene.camera.width,
            scene.camera.height,
            sh_degree=scene.degree,
            backgrounds=leaves["background"],
            **self._taken(
                near_plane=scene.profile.near_plane,
                eps2d=scene.profile.eps2d,
                tile_size=scene.side,
                **options,
            ),
        )

    def _tensor(self, value: Any, own: ModuleType | None = None) -> Any:
        """Return a value with its arrays as tensors; value types become those that `own` calls by the same name."""
        if isinstance(value, np.ndarray):
            dtype = self._float if value.dtype.kind == "f" else None
            return self._torch.as_tensor(value.copy(), dtype=dtype, device=self._device)
        if isinstance(value, dict):
            return {key: self._tensor(each, own) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return type(value)(self._tensor(each, own) for each in value)
        if own is not None and is_dataclass(value) and hasattr(own, type(value).__name__):
            values = {f.name: self._tensor(getattr(value, f.name), own) for f in fields(value)}
            return getattr(own, type(value).__name__)(**values)
        if inspect.isfunction(value):
            return lambda *args: self._tensor(value(*args), own)
        return value

    def _grad_of(self, of: Any) -> np.ndarray:
        grad = of.gradient if isinstance(of, Laid) else of.grad
        if grad is None:
            grad = self._torch.zeros_like(of.view if isinstance(of, Laid) else of)
        return self._array(grad.to_dense() if grad.is_sparse else grad)

    def _array(self, value: Any) -> Any:
        if isinstance(value, tuple | list):
            return type(value)(self._array(each) for each in value)
        if isinstance(value, dict):
            return {key: self._array(each) for key, each in value.items()}
        if hasattr(value, "offsets") and hasattr(value, "ids"):
            ids, offsets = self._array(value.ids), self._array(value.offsets)
            return [ids[a:b].tolist() for a, b in itertools.pairwise(offsets)]
        if is_dataclass(value):
            return SimpleNamespace(**{f.name: self._array(getattr(value, f.name)) for f in fields(value)})
        if not isinstance(value, self._torch.Tensor):
            return value
        array = value.detach().cpu().numpy()
        return array.astype({"f": np.float64, "i": np.int64}.get(array.dtype.kind, array.dtype))
