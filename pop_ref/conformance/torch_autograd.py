"""A render as autograd is asked for it by people: layouts of arguments and cotangents, and orders of passes.

What is asked is a value (`Ask`), so that a law says which one it speaks of; the gradients always belong to the same
arguments, and the oracle knows them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance.scenes import Scene

NAMES: Final = ("means", "quats", "scales", "opacities", "sh", "viewmat", "background")
# how a tensor may lie in memory, other than densely from its beginning
LAYOUTS: Final = ("transposed", "offset", "sliced", "reversed")


@dataclass(frozen=True)
class Ask:
    """How a render is differentiated.

    Attributes:
        wanted: names of the arguments that require a gradient.
        layout: of the arguments in memory: "dense", one of LAYOUTS, or "repeated": each Gaussian's first size along all
            axes, without memory for the others.
        cotangent: of the outputs: "dense", one of LAYOUTS, "channels", a pixel's first number in all of its channels
            without memory for the others, or "expanded", the first number everywhere likewise.
        outputs: which of "image" and "alpha" have a cotangent.
        packed: whether packed rows are drawn.
        before: what else is done: "nothing"; "no_grad" and "inference_mode" draw twice under torch's mode of that name,
            the former in another thread, and write to the first image in between; "another" draws another scene between
            the forward and the backward pass; "twice" goes back twice and draws another scene in between; "present"
            leaves ones as gradients from before; "edited" changes the arguments in place between the passes, "written"
            the outputs; "moved" draws the same tensors with other numbers first, and puts these back without autograd's
            notice; "autocast" draws where torch would have matrix products in half precision.
    """

    wanted: tuple[str, ...] = NAMES
    layout: str = "dense"
    cotangent: str = "dense"
    outputs: tuple[str, ...] = ("image", "alpha")
    packed: bool = False
    before: str = "nothing"


@dataclass(frozen=True)
class Differentiated:
    """What came of it.

    Attributes:
        gradients: of the wanted arguments by name, None for one that got none.
        others: names of arguments that got a gradient without asking.
        changed: names of arguments, and of what torch keeps for everybody, that are not what they were.
        refused: what torch or the program said where it would not go back; empty where it did.
        follows: whether the image follows its arguments, and whether one drawn without gradients does.
        image: the image, and the one drawn without gradients.
    """

    gradients: dict[str, Any]
    others: tuple[str, ...]
    changed: tuple[str, ...]
    refused: str
    follows: tuple[bool, bool]
    image: tuple[Any, Any]


class Laid:
    """A value in a layout: `base` is what is stored and may have a gradient, `view` what is handed over."""

    def __init__(self, value: Any, layout: str, wanted: bool = False) -> None:
        torch = importlib.import_module("torch")
        self._layout, self._shape = layout, value.shape
        self._axes = tuple(reversed(range(value.dim())))
        if layout == "transposed":
            base = value.permute(self._axes).contiguous()
        elif layout == "offset":
            base = torch.cat(
                [value.new_full((3,), float("nan")), value.reshape(-1), value.new_full((2,), float("nan"))]
            )
        elif layout == "sliced":
            base = torch.stack([value, torch.full_like(value, float("nan"))], dim=-1)
        elif layout == "reversed":
            # rows in an order of their own, of which every second is somebody else's
            base = torch.stack([torch.full_like(value, float("nan")), value], dim=0)
        elif layout == "repeated":
            base = value[..., :1].clone()
        elif layout == "kept":
            base = value
        else:
            base = value.clone(memory_format=torch.contiguous_format)
        self.base = base.requires_grad_(wanted)
        self.view = self._of(self.base)

    def _of(self, base: Any) -> Any:
        if self._layout == "transposed":
            return base.permute(self._axes)
        if self._layout == "offset":
            return base[3:-2].view(self._shape)
        if self._layout == "sliced":
            return base[..., 0]
        if self._layout == "repeated":
            return base.expand(self._shape)
        return base[1] if self._layout == "reversed" else base

    @property
    def gradient(self) -> Any:
        """Return the gradient of the value, None where there is none."""
        return None if self.base.grad is None else self._of(self.base.grad)


def differentiated(
    scene: Scene,
    draw: Callable[[Scene, dict[str, Any]], Sequence[Any]],
    leaves: Callable[[Scene, bool], dict[str, Any]],
    cotangents: tuple[Any, Any],
    ask: Ask,
    without: Sequence[str] = (),
) -> Differentiated:
    """Draw a scene and go back as it is asked.

    Args:
        scene: with one camera.
        draw: given a scene and its arguments by name, an image and alphas.
        leaves: the arguments of a scene by name, which require gradients or not.
        cotangents: of the image and of the remaining transmittance. [H, W, 3], [H, W]
        ask: how.
        without: names of gradients that the program does not offer.
    """

    def other() -> Any:
        smaller = scene.rows(np.arange(len(scene.gaussians) // 2))
        fainter = scene.with_overrides(opacities=0.5 * scene.gaussians.opacities)
        # memory of any size that the scene itself takes is taken by one or the other
        return [draw(each, leaves(each, True)) for each in (fainter, smaller)]

    H, W = scene.camera.height, scene.camera.width
    v_image, v_alpha = cotangents[0].reshape(1, H, W, -1), -cotangents[1].reshape(1, H, W, 1)
    found = _differentiate(lambda given: draw(scene, given), leaves(scene, False), other, v_image, v_alpha, ask)
    shapes = {"viewmat": (4, 4), "background": (-1,)}
    gradients = {
        name: None if value is None else _array(value).reshape(shapes.get(name, tuple(value.shape)))
        for name, value in found.gradients.items()
        if name not in without
    }
    image, still = (None if each is None else _array(each) for each in found.image)
    return replace(found, gradients=gradients, image=(image, still))


def _array(tensor: Any) -> Any:
    return tensor.detach().cpu().numpy().astype(np.float64)


def _differentiate(
    draw: Callable[[dict[str, Any]], Sequence[Any]],
    values: dict[str, Any],
    other: Callable[[], Any],
    v_image: Any,
    v_alpha: Any,
    ask: Ask,
) -> Differentiated:
    """Draw, and go back as it is asked.

    Args:
        draw: given the arguments by name, an image and alphas.
        values: tensors by name, without gradients.
        other: draws other scenes, with gradients.
        v_image, v_alpha: cotangents, in the outputs' shapes.
        ask: how.
    """
    torch = importlib.import_module("torch")
    of = {name: "dense" if ask.layout == "repeated" and name != "scales" else ask.layout for name in values}
    laid = {name: Laid(value, of[name], name in ask.wanted) for name, value in values.items()}
    arguments = {name: each.view for name, each in laid.items()}
    unsettled: set[str] = set()

    def drawn() -> Sequence[Any]:
        # a state that no seed leaves
        torch.rand(1)
        settings = _settings_of_torch()
        with torch.autocast(v_image.device.type, enabled=ask.before == "autocast"):
            found = draw(arguments)
        unsettled.update(name for name, value in _settings_of_torch().items() if value != settings[name])
        return found

    still = None
    if ask.before in ("no_grad", "inference_mode"):
        still = _unfollowed(ask.before, drawn, other)
    if ask.before == "moved":
        _moved(laid, values, drawn)
    outputs: dict[str, Any] = dict(zip(("image", "alpha"), drawn(), strict=True))
    image = outputs["image"].detach().clone()
    if ask.before == "another":
        other()
    if ask.before == "present":
        for name in ask.wanted:
            laid[name].base.grad = torch.ones_like(laid[name].base)
    refused = _went_back(outputs, {"image": v_image, "alpha": v_alpha}, laid, other, ask)
    kept = () if ask.before == "edited" else tuple(laid)
    return Differentiated(
        gradients={name: None if laid[name].gradient is None else laid[name].gradient.clone() for name in ask.wanted},
        others=tuple(name for name in laid if name not in ask.wanted and laid[name].base.grad is not None),
        changed=(*sorted(unsettled), *(n for n in kept if not torch.equal(laid[n].view.detach(), values[n]))),
        refused=refused,
        follows=(bool(outputs["image"].requires_grad), still is not None and bool(still.requires_grad)),
        image=(image, still),
    )


def _unfollowed(mode: str, drawn: Callable[[], Sequence[Any]], other: Callable[[], Any]) -> Any:
    """Return the second of two images that are drawn under a mode, the first of which is written to."""

    def found() -> Any:
        with getattr(importlib.import_module("torch"), mode)():
            drawn()[0].zero_()
            image = drawn()[0]
            # what is drawn after it is no matter of its
            other()
        return image

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(found).result() if mode == "no_grad" else found()


def _moved(laid: dict[str, Laid], values: dict[str, Any], draw: Callable[[], Any]) -> None:
    """Draw with other numbers in the same tensors, as they are between two steps of an optimizer, and put them back."""
    with importlib.import_module("torch").no_grad():
        for name, each in laid.items():
            if name == "viewmat":
                # a rotation stays one
                each.view[..., :3, 3].add_(0.25)
            elif name == "K":
                each.view[..., :2, :].mul_(0.75)
            else:
                each.view.mul_(0.75)
    draw()
    with importlib.import_module("torch").no_grad():
        for name, each in laid.items():
            # as some optimizers write, so that no version of the tensor tells
            each.view.data.copy_(values[name])


def _settings_of_torch() -> dict[str, Any]:
    """Return, by name, what a call has to leave as it was."""
    torch = importlib.import_module("torch")
    return {
        "the random numbers": torch.random.get_rng_state().numpy().tobytes(),
        "the default type of numbers": torch.get_default_dtype(),
        "the number of threads": torch.get_num_threads(),
        "whether gradients are taken": torch.is_grad_enabled(),
    }


def _went_back(
    outputs: dict[str, Any], cotangents: dict[str, Any], laid: dict[str, Laid], other: Callable[[], Any], ask: Ask
) -> str:
    """Hold the backward pass, and return why not, or an empty text."""
    torch = importlib.import_module("torch")
    # alphas do not follow a background; where nothing else reaches them, gradients lack a part
    names = [name for name in ask.outputs if outputs[name].requires_grad]
    chosen = [outputs[name] for name in names]
    given = [_cotangent(cotangents[name], ask.cotangent) for name in names]
    try:
        with torch.no_grad():
            if ask.before == "edited":
                for name in ask.wanted:
                    laid[name].base.mul_(1.5).add_(0.25)
            if ask.before == "written":
                for each in chosen:
                    each.detach().mul_(0.5)
        if ask.before == "twice":
            torch.autograd.backward(chosen, given, retain_graph=True)
            # which may write where the first pass has read
            other()
        torch.autograd.backward(chosen, given)
    except RuntimeError as error:
        return str(error)
    return ""


def _cotangent(value: Any, layout: str) -> Any:
    if layout == "channels":
        return value[..., :1].expand(value.shape)
    if layout == "expanded":
        return value.reshape(-1)[0].expand(value.shape)
    return Laid(value, layout).view
