"""Mutants as black boxes: this program's rasterizer behind gsplat's signature, with one argument ignored or mixed up.

Nothing inside is broken, and one small view is drawn rightly: only laws of the whole signature can tell.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from pop_ref.conformance.backends import function_named

Rasterization = Callable[..., Any]
Given = dict[str, Any]
Breaks = Callable[[Rasterization, Given], Any]
Told = tuple[Any, Any, Any]


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


def several(given: Given) -> bool:
    return bool(given["viewmats"].shape[-3] > 1)


def batched(given: Given) -> bool:
    return bool(given["means"].dim() > 2)


def plain(given: Given) -> bool:
    return given["sh_degree"] is None


def own_colors(given: Given) -> bool:
    return bool(given["colors"].dim() - (2 if plain(given) else 3) == given["viewmats"].dim() - 2)


def breaking(change: Callable[[Given], Given]) -> Breaks:
    """Break arguments: those that the change returns by name take the places of what was given."""
    return lambda sound, given: sound(**given | change(given))


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


def telling(change: Callable[[Given, Any, Any, Any], tuple[Any, Any, Any]]) -> Breaks:
    return lambda sound, given: change(given, *sound(**given))


def passing(change: Callable[[Any], Any], *names: str) -> Breaks:
    return breaking(lambda given: {name: change(given[name]) for name in names if given[name] is not None})


def one_view(given: Given) -> bool:
    return given["means"].dim() == 2 and given["viewmats"].shape[-3] == 1
