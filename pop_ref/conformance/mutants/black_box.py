"""Mutants as black boxes: this program's rasterizer behind gsplat's signature, with one argument ignored or mixed up.

Nothing inside is broken, and one small view is drawn rightly: only laws of the whole signature can tell.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from pop_ref.conformance.backends import function_named

Rasterization = Callable[..., Any]
Given = dict[str, Any]
Breaks = Callable[[Rasterization, Given], Any]
Told = tuple[Any, Any, Any]
Condition = Callable[[Given], bool]


@dataclass(frozen=True)
class BlackBox:
    """A rasterizer with one argument broken.

    Attributes:
        name: how tables call it.
        story: what it does.
        breaks: makes of a sound rasterizer and its arguments by name what comes of the call.
        law: that kills it.
    """

    name: str
    story: str
    breaks: Breaks
    law: str
    precisions = ("float32", "float64")

    def adapter(self, dtype: str = "float32") -> Any:
        """Return it as the kit is handed any rasterizer, in float32 or float64."""
        from pop_ref.conformance.torch_adapter import TorchAdapter

        return TorchAdapter(self.name, self.rasterization(), dtype=dtype)

    def rasterization(self) -> Rasterization:
        """Return the broken function, with the arguments that gsplat has."""
        sound = partial(function_named("pop_fast.api.rasterize:rasterization"), backend="fast")

        def rasterization(
            means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any, width: int,
            height: int, near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0,
            eps2d: float = 0.3, sh_degree: int | None = None, packed: bool = True, tile_size: int = 16,
            backgrounds: Any = None, render_mode: str = "RGB", absgrad: bool = False, rasterize_mode: str = "classic",
            covars: Any = None,
        ) -> Any:  # fmt: skip
            given = dict(locals())
            # what the function closes over is no argument
            del given["self"], given["sound"]
            return self.breaks(sound, given)

        return rasterization


def import_torch() -> Any:
    return importlib.import_module("torch")


def always(given: Given) -> bool:
    return True


def several(given: Given) -> bool:
    return bool(given["viewmats"].shape[-3] > 1)


def batched(given: Given) -> bool:
    return bool(given["means"].dim() > 2)


def one_view(given: Given) -> bool:
    return not batched(given) and not several(given)


def plain(given: Given) -> bool:
    return given["sh_degree"] is None


def harmonic(given: Given) -> bool:
    return not plain(given)


def own_colors(given: Given) -> bool:
    return bool(given["colors"].dim() - (2 if plain(given) else 3) == given["viewmats"].dim() - 2)


def packed(given: Given) -> bool:
    return bool(given["packed"])


def covars(given: Given) -> bool:
    return given["covars"] is not None


def behind(given: Given) -> bool:
    return given["backgrounds"] is not None


def antialiased(given: Given) -> bool:
    return bool(given["rasterize_mode"] == "antialiased")


def empty(given: Given) -> bool:
    return bool(given["means"].shape[-2] == 0)


def deep(given: Given) -> bool:
    return bool(given["render_mode"] != "RGB")


def flat(given: Given) -> bool:
    return not deep(given)


def expected_depth(given: Given) -> bool:
    return bool(given["render_mode"].endswith("ED"))


def depth_beside_colors(given: Given) -> bool:
    return bool(given["render_mode"].startswith("RGB+"))


def evaluated(given: Given) -> bool:
    """Hold of calls that are made without gradients."""
    return not import_torch().is_grad_enabled()


def both(*conditions: Condition) -> Condition:
    return lambda given: all(condition(given) for condition in conditions)


def frozen(*names: str) -> Condition:
    """Hold unless all of these arguments require a gradient."""
    return lambda given: not all(given[name].requires_grad for name in names)


def breaking(change: Callable[[Given], Given]) -> Breaks:
    """Break arguments: those that the change returns by name take the places of what was given."""
    return lambda sound, given: sound(**given | change(given))


def when(condition: Condition, **changed: Any) -> Breaks:
    """Break arguments where a condition holds: each is a value, or what a function makes of all of them."""
    return breaking(
        lambda given: {name: new(given) if callable(new) else new for name, new in changed.items() if condition(given)}
    )


def passing(change: Callable[[Any], Any], *names: str, condition: Condition = always) -> Breaks:
    """Break some arguments, each by itself, where a condition holds."""
    return breaking(
        lambda given: {name: change(given[name]) for name in names if condition(given) and given[name] is not None}
    )


def unfollowed(condition: Condition, *names: str) -> Breaks:
    """Have arguments without a gradient where a condition holds."""
    return passing(lambda x: x.detach(), *names, condition=condition)


def pulled(condition: Condition, change: Callable[[Given, Any], Any], *names: str) -> Breaks:
    """Break gradients of arguments where a condition holds."""
    return breaking(
        lambda given: {
            name: backwards(given[name], lambda v: change(given, v))
            for name in names
            if given[name] is not None and condition(given)
        }
    )


def hidden(condition: Condition, kept: Callable[[Given], Any]) -> Breaks:
    """Break opacities where a condition holds: those of Gaussians that are not kept are 0."""
    return when(condition, opacities=lambda given: given["opacities"] * kept(given))


def failing(condition: Condition, words: str, error: type[Exception] = RuntimeError) -> Breaks:
    """Break calls of which a condition holds: they end in an error."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        if condition(given):
            raise error(words)
        return sound(**given)

    return breaks


def then(condition: Condition, change: Callable[[Given, Any, Any, Any], Told]) -> Breaks:
    """Break what is returned where a condition holds: images, alphas and meta become what `change` makes of them."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        return change(given, images, alphas, meta) if condition(given) else (images, alphas, meta)

    return breaks


def failing_after(seen: Callable[[Given, Any, Any], bool], words: str) -> Breaks:
    """Break calls that end in an error by the opacity that they draw and by meta."""

    def change(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
        if seen(given, alphas.detach(), meta):
            raise RuntimeError(words)
        return images, alphas, meta

    return then(always, change)


def drawn(condition: Condition, change: Callable[[Given, Any, Any], Any]) -> Breaks:
    """Break images where a condition holds."""
    return then(condition, lambda given, images, alphas, meta: (change(given, images, alphas), alphas, meta))


def last_channel(condition: Condition, change: Callable[[Given, Any, Any], Any]) -> Breaks:
    """Break the last channel of images, which holds depth in modes of depth, where a condition holds."""

    def changed(given: Given, images: Any, alphas: Any) -> Any:
        return import_torch().cat((images[..., :-1], change(given, images[..., -1:], alphas)), -1)

    return drawn(condition, changed)


def shown(seen: Callable[[Given], Any]) -> Breaks:
    """Leave pixels black and transparent that are not seen."""

    def changed(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
        here = seen(given)
        return images * here, alphas * here, meta

    return then(always, changed)


def told(condition: Condition, **changed: Callable[[Given, Any], Any]) -> Breaks:
    """Break keys of meta where a condition holds."""

    def change(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
        return images, alphas, dict(meta) | {name: new(given, meta) for name, new in changed.items()}

    return then(condition, change)


def absolute_told(condition: Condition, change: Callable[[Given, Any, Any], Any]) -> Breaks:
    """Break sums of absolute gradients where a condition holds: they are what `change` makes of gradient and sums."""

    def changed(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
        centres, sums = meta["means2d"], getattr(meta["means2d"], "absgrad", None)
        if sums is not None and centres.requires_grad:
            centres.register_hook(lambda gradient: (sums.copy_(change(given, gradient.detach(), sums)), None)[1])
        return images, alphas, meta

    return then(condition, changed)


def in_camera(means: Any, viewmats: Any) -> Any:
    """Return the centres as every camera has them, [..., C, N, 3]."""
    R, t = viewmats[..., :3, :3], viewmats[..., None, :3, 3]
    return means[..., None, :, :] @ R.transpose(-1, -2) + t


def backwards(value: Any, change: Any) -> Any:
    """Return the value, through which a gradient goes as the change makes it."""
    passed = value * 1.0
    if passed.requires_grad:
        passed.register_hook(change)
    return passed


def detached(value: Any, wrong: Any) -> Any:
    """Return a value that is another one, through which gradients go as if it were not."""
    return value + (wrong - value).detach()


def numbers(count: int, like: Any) -> Any:
    return import_torch().arange(count, device=like.device)


def read_densely(x: Any) -> Any:
    """Read memory from a tensor's beginning as if its numbers lay one after the other."""
    enough = x.untyped_storage().nbytes() // x.element_size() - x.storage_offset() >= x.numel()
    strides = import_torch().empty(x.shape, device="meta").stride()
    return x.as_strided(x.shape, strides, x.storage_offset()) if enough else x.contiguous()


def first_channels(value: Any, count: int) -> Any:
    """Return a value of which the channels after the first ones are 0."""
    return import_torch().cat((value[..., :count], import_torch().zeros_like(value[..., count:])), -1)


def tile_numbers(given: Given) -> Any:
    """Return the number of each pixel's tile, [height, width, 1]."""
    torch, size = import_torch(), given["tile_size"] or 16
    rows, columns = torch.arange(given["height"]) // size, torch.arange(given["width"]) // size
    return (rows[:, None] * -(-given["width"] // size) + columns)[..., None]


def all_bands(given: Given) -> int:
    """Return the degree of the harmonics that are given."""
    return math.isqrt(given["colors"].shape[-2]) - 1


far_plane_is_a_sphere = hidden(
    lambda given: not several(given),
    lambda given: in_camera(given["means"], given["viewmats"]).norm(dim=-1).squeeze(-2).detach() <= given["far_plane"],
)


def accumulated_mode(given: Given) -> str:
    return given["render_mode"].replace("ED", "D")


def centred(given: Given) -> Any:
    """Return intrinsics whose principal point is the picture's centre."""
    Ks = given["Ks"].clone()
    Ks[..., 0, 2], Ks[..., 1, 2] = 0.5 * given["width"], 0.5 * given["height"]
    return Ks


def no_gradient(given: Given, v: Any) -> Any:
    return 0.0 * v


def mean_of_cameras(given: Given, v: Any) -> Any:
    return v / given["viewmats"].shape[-3]


def counts_of_all_cameras(given: Given, meta: Any) -> Any:
    return meta["dominant_counts"].sum(-2, keepdim=True).expand_as(meta["dominant_counts"])


def of_first_entry(name: str) -> Callable[[Given], Any]:
    """Return an argument of which every entry of a batch has the first one's."""

    def change(given: Given) -> Any:
        value, depth = given[name], given["means"].dim() - 3
        return None if value is None else value.narrow(depth, 0, 1).expand_as(value)

    return change


def of_first_camera(name: str, trailing: int) -> Callable[[Given], Any]:
    """Return an argument of which every camera has the first one's: the axis before the trailing ones is theirs."""

    def change(given: Given) -> Any:
        value = given[name]
        return None if value is None else value.narrow(-trailing - 1, 0, 1).expand_as(value)

    return change


def first_colors(given: Given) -> Any:
    return of_first_camera("colors", 2 if plain(given) else 3)(given) if own_colors(given) else given["colors"]


def drawn_in_order(given: Given, keys: Any) -> Given:
    """Return centres and sizes of a single view's Gaussians that are drawn in the order of keys.

    The sound program sorts by depth, so Gaussians before the near plane are given the depths of each other: they move
    along the ray of their pixel, with the size that they have there.
    """
    torch, means, view = import_torch(), given["means"], given["viewmats"].detach()
    eye = -(view[0, :3, :3].T @ view[0, :3, 3])
    depths = in_camera(means.detach(), view)[0, :, 2]
    seen = (depths > given["near_plane"]).nonzero()[:, 0]
    order = seen[torch.argsort(keys[seen], stable=True)]
    shift = torch.ones_like(depths)
    shift[order] = torch.sort(depths[seen]).values / depths[order]
    return {"means": eye + (means - eye) * shift[:, None], "scales": given["scales"] * shift[:, None]}


def seen_opacities(sound: Rasterization, given: Given) -> Any:
    """Return the opacities of a single view with their antialiasing factor."""
    seen = sound(**given | {"packed": False, "absgrad": False})[2]["opacities"]
    return seen.reshape(given["opacities"].shape)


def factor_is_constant(condition: Condition) -> Breaks:
    """Break the antialiasing factor of single views where a condition holds: it has no gradient."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        if not (antialiased(given) and one_view(given) and condition(given)):
            return sound(**given)
        torch, opacities = import_torch(), given["opacities"]
        with torch.no_grad():
            seen = seen_opacities(sound, given)
            factors = torch.where(opacities > 0.0, seen / opacities, torch.zeros_like(opacities))
        return sound(**given | {"rasterize_mode": "classic", "opacities": opacities * factors})

    return breaks
