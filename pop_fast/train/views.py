"""A capture's views as tensors, also shrunk, the one call that renders them from raw parameters, and renders in layers.

Coarse to fine: the first steps see the photographs shrunk, whose large shapes are learned at a fraction of the cost.
`coarse_stop_iters` = (a, b) shrinks by 4 until step a and by 2 until step b. What a step sees is a view like any other,
so that nothing of a step's meaning changes: its photograph is the average of the original's pixels, its camera the same
one with fewer pixels. Densification reads the gradients and the dominated pixels of the view as it is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from pop_fast.data.capture import View
from pop_fast.errors import PopError
from pop_fast.stages.appearance import over_background
from pop_fast.stages.covariance import opacities_from_logits, scales_from_log_scales
from pop_fast.stages.regularizers import depth_samples
from pop_fast.stages.types import Camera
from pop_fast.train.config import TrainConfig

V = TypeVar("V")


@dataclass(frozen=True, eq=False)
class ViewTensors:
    """One view."""

    name: str  # relative file name
    photo: Tensor  # uint8 [H, W, 3]
    mask: Tensor | None  # True where the photograph counts, or None. bool [H, W]
    viewmat: Tensor  # world -> camera, in the precision of the training. [1, 4, 4]
    K: Tensor  # intrinsics, px, likewise. [1, 3, 3]
    # opacity of a photograph with transparency, which `photo` has laid over the settings' background, of 255; None
    # where it has none. uint8 [H, W]
    alpha: Tensor | None = None
    # sparse points that it sees, world, in the precision of the camera; None where they are not known or not asked
    # for. [P, 3]
    points: Tensor | None = None

    @classmethod
    def of(cls, view: View, dtype: torch.dtype = torch.float32, points: np.ndarray | None = None) -> ViewTensors:
        """Take over a view of a capture, its camera in a precision.

        Args:
            points: the capture's, of which those that the view sees are kept; None keeps none.

        Raises:
            PopError: only the view's camera was read.
        """
        if not view.was_read:
            raise PopError(f"{view.name}: its photograph was not read; load the capture with photographs='all'")
        return cls(
            name=view.name,
            photo=torch.from_numpy(view.image),
            mask=None if view.mask is None else torch.from_numpy(view.mask),
            viewmat=torch.from_numpy(view.viewmat).to(dtype)[None],
            K=torch.from_numpy(view.K).to(dtype)[None],
            alpha=None if view.alpha is None else torch.from_numpy(view.alpha),
            points=None if points is None or view.seen is None else torch.from_numpy(points[view.seen]).to(dtype),
        )

    @property
    def height(self) -> int:
        """Height, px."""
        return self.photo.shape[0]

    @property
    def width(self) -> int:
        """Width, px."""
        return self.photo.shape[1]

    @property
    def kept_pixels(self) -> int:
        """How many pixels count: those that the mask keeps."""
        return self.height * self.width if self.mask is None else int(self.mask.count_nonzero())

    def depth_samples(self) -> tuple[Tensor, Tensor] | None:
        """Return where the photograph shows its sparse points, px [M, 2], and their disparities [M]; None without any.

        The camera is that of the view, and no gradient goes to it.
        """
        if self.points is None:
            return None
        camera = Camera(self.viewmat[0].detach(), self.K[0], self.width, self.height)
        return depth_samples(self.points, camera, self.mask)

    def target(self) -> Tensor:
        """Return the photograph as floats in [0, 1]. [H, W, 3]"""
        return self.photo.to(self.viewmat.dtype).div_(255.0)

    def target_over(self, background: Tensor, was: Tensor) -> Tensor:
        """Return the photograph over a background [3] that it was not laid over (`was` [3]) when it was read. [H, W, 3]

        One without transparency is as it is over any.
        """
        if self.alpha is None:
            return self.target()
        alpha = self.alpha.to(self.viewmat.dtype).div_(255.0)
        return over_background(self.target(), alpha, was.to(alpha), background.to(alpha))


def evenly(views: Sequence[V], most: int) -> list[V]:
    """Return at most so many of a list, evenly spread from the first to the last."""
    places = np.linspace(0, len(views) - 1, min(len(views), most)).round() if len(views) else []
    return [views[int(place)] for place in np.unique(places)]


@dataclass(frozen=True)
class Rendered:
    """A rendered view: the image [H, W, 3], the activated opacities that made it [N], and rasterization's `info`.

    `depth` is the expected depth, world units, 0 where nothing is [H, W]; None where it was not asked for.
    """

    image: Tensor
    opacities: Tensor
    info: dict[str, Any]
    depth: Tensor | None = None


def render_view(
    backend: Any,
    params: Mapping[str, Tensor],
    view: ViewTensors,
    config: TrainConfig,
    sh_degree: int,
    dominance: bool = False,
    counts: bool = False,
    absgrad: bool = False,
    background: Tensor | None = None,
    depth: bool = False,
) -> Rendered:
    """Render a view from raw parameters.

    Colour bands above `sh_degree` are left out of the graph, so that their gradient need not be made to be zero.

    Args:
        view: the camera, and the mask that `dominant_counts` are restricted to.
        dominance: dominant ids and counts will be read from `info`.
        counts: Gaussians per pixel will be read from `info`.
        absgrad: so will the gradient of the screen centres summed of absolute values.
        background: colour behind everything in the place of the config's. [3]
    """
    given = rasterization_arguments(params, view, config, sh_degree, background)
    mode = {"render_mode": "RGB+ED"} if depth else {}
    colors, _, info = backend.rasterization(**given, **mode, absgrad=absgrad, dominance=dominance, counts=counts)
    opacities = given["opacities"]
    if dominance and view.mask is not None:
        info["dominant_counts"] = _counts_inside(info["dominant_ids"], view.mask, len(opacities))
        info["kept_pixels"] = view.kept_pixels
    if depth:
        return Rendered(colors[0, ..., :3], opacities, info, colors[0, ..., 3])
    return Rendered(colors[0], opacities, info)


def rasterization_arguments(
    params: Mapping[str, Tensor],
    view: ViewTensors,
    config: TrainConfig,
    sh_degree: int,
    background: Tensor | None = None,
) -> dict[str, Any]:
    """Return what `rasterization()` is given for a view of raw parameters."""
    opacities = opacities_from_logits(params["opacities"])
    bands = (sh_degree + 1) ** 2
    sh = params["sh0"] if bands == 1 else torch.cat([params["sh0"], params["shN"][:, : bands - 1]], dim=1)
    if background is None and any(config.background):
        background = torch.tensor(config.background)
    return {
        "means": params["means"],
        "quats": params["quats"],
        "scales": scales_from_log_scales(params["scales"]),
        "opacities": opacities,
        "colors": sh,
        "viewmats": view.viewmat,
        "Ks": view.K,
        "width": view.width,
        "height": view.height,
        "sh_degree": sh_degree,
        "packed": False,
        "backgrounds": None if background is None else background.to(opacities)[None],
        "rasterize_mode": "antialiased" if config.antialiased else "classic",
        "profile": config.renderer,
    }


def _counts_inside(dominant_ids: Tensor, mask: Tensor, n: int) -> Tensor:
    """Count dominated pixels of one camera where the mask keeps them: ignored pixels say nothing about importance."""
    ids = dominant_ids[0][mask & (dominant_ids[0] >= 0)]
    return torch.bincount(ids, minlength=n)[None]


@dataclass(frozen=True, eq=False)
class Layers:
    """What one camera sees."""

    image: np.ndarray  # encoded RGB, not clamped. float32 [H, W, 3]
    alpha: np.ndarray  # 1 - T_final, how much of the background is covered. float32 [H, W]
    # mean camera z of what is blended, by weight; world units, 0 where nothing is. float32 [H, W]
    depth: np.ndarray
    # the Gaussian with the largest weight, -1 none; None where it was not asked for. int [H, W]
    dominant_ids: np.ndarray | None


@torch.no_grad()
def render_layers(
    backend: Any,
    params: Mapping[str, Tensor],
    view: ViewTensors,
    config: TrainConfig,
    sh_degree: int,
    dominance: bool = False,
) -> Layers:
    """Render colour and depth of a camera in one pass.

    Args:
        view: the camera; its photograph gives the size alone.
    """
    given = rasterization_arguments(params, view, config, sh_degree)
    drawn, alphas, info = backend.rasterization(**given, render_mode="RGB+ED", dominance=dominance)
    found = drawn[0].cpu().numpy()
    ids = info["dominant_ids"][0].cpu().numpy() if dominance else None
    return Layers(found[..., :3], alphas[0, ..., 0].cpu().numpy(), found[..., 3], ids)


# px, a side that no view is shrunk below: a few of SSIM's windows of 11
SMALLEST_SIDE: Final = 32


def coarse_to_fine(
    views: Sequence[ViewTensors], order: Sequence[int], stops: Sequence[int], size: int
) -> tuple[list[ViewTensors], list[int]]:
    """Return the views at every size that is seen, and which of them every step, of `size` views, sees."""
    return with_shrunk(views, stops), [
        index_at(place // size, index, len(views), stops) for place, index in enumerate(order)
    ]


def with_shrunk(views: Sequence[ViewTensors], stops: Sequence[int]) -> list[ViewTensors]:
    """Return the views, then all of them shrunk by 2, by 4 and so on, one power for every entry of `stops`."""
    return [shrunk(view, 2**level) for level in range(len(stops) + 1) for view in views]


def index_at(step: int, index: int, n_views: int, stops: Sequence[int]) -> int:
    """Return where the view that a step sees stands in `with_shrunk`."""
    return index + n_views * sum(step < stop for stop in stops)


def shrunk(view: ViewTensors, factor: int) -> ViewTensors:
    """Return a view with a smaller photograph, and the camera that takes it.

    Args:
        factor: power of 2, of which as much is used as leaves a side of 32 px.

    Returns:
        The view of round(H / factor) by round(W / factor) px; a pixel counts where half of what it averages does.
    """
    while factor > 1 and min(view.height, view.width) < SMALLEST_SIDE * factor:
        factor //= 2
    if factor == 1:
        return view
    height, width = round(view.height / factor), round(view.width / factor)

    def small(image: Tensor) -> Tensor:
        resized = cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_AREA)
        return torch.from_numpy(np.ascontiguousarray(resized))

    K = view.K.clone()
    K[:, 0] *= width / view.width
    K[:, 1] *= height / view.height
    mask = None if view.mask is None else small(view.mask.float()) >= 0.5
    if mask is not None and not mask.any():
        return shrunk(view, factor // 2)
    alpha = None if view.alpha is None else small(view.alpha)
    return replace(view, photo=small(view.photo), mask=mask, K=K, alpha=alpha)
