"""Passes over training views: what density control asks of a view in addition to its image, from raw parameters.

A pass projects the Gaussians, lists them by tile and sums over the pixels where each is blended, by the stages of the
backend that trains. Nothing here is differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pop_fast.api.backend import require_backend
from pop_fast.errors import PopError
from pop_fast.stages.compositing import dominant_counts
from pop_fast.stages.contributions import Contributions
from pop_fast.stages.covariance import opacities_from_logits, scales_from_log_scales
from pop_fast.stages.stage_set import PassInput
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import Profile, profile_named

if TYPE_CHECKING:
    from pop_fast.train.config import TrainConfig
    from pop_fast.train.views import ViewTensors


@dataclass(frozen=True)
class ViewContributions(Contributions):
    """What every Gaussian contributes to a view, and the view."""

    dominant_counts: Tensor  # pixels that it dominates, of those that the view's mask keeps. [N] int64
    image: Tensor  # not clamped. [H, W, 3]
    radii: Tensor  # extents, px; 0 where culled. [N, 2] int32
    depths: Tensor  # camera z, world units. [N]

    @property
    def visible(self) -> Tensor:
        """Tell which Gaussians survived every cull. [N] bool"""
        return (self.radii > 0).all(1)


class Passes:
    """Passes over views by one backend.

    Args:
        backend: which trains, or its name: "fast", "compiled", "cuda" or "ref".
        device: where the parameters lie; the CPU by default.

    Raises:
        PopError: the backend cannot run here.
    """

    def __init__(
        self,
        backend: Any,
        views: Sequence[ViewTensors],
        profile: str | Profile = "paper",
        background: Sequence[float] = (0.0, 0.0, 0.0),
        antialiased: bool = False,
        device: torch.device | None = None,
    ) -> None:
        self._open = require_backend(backend if isinstance(backend, str) else backend.name).open_view
        self._views = views
        self._profile = profile_named(profile) if isinstance(profile, str) else profile
        self._background, self._antialiased = torch.tensor(background), antialiased
        self._device = device or torch.device("cpu")

    @classmethod
    def of(
        cls, backend: Any, views: Sequence[ViewTensors], config: TrainConfig, device: torch.device | None = None
    ) -> Passes:
        """Make passes with the settings of a run."""
        return cls(backend, views, config.renderer, config.background, config.antialiased, device)

    @property
    def n_views(self) -> int:
        """Return how many views there are."""
        return len(self._views)

    def view(self, index: int) -> ViewTensors:
        """Return a view."""
        return self._views[index]

    def photo(self, index: int) -> Tensor:
        """Return a view's photograph, where the parameters lie. uint8 [H, W, 3]"""
        return self._views[index].photo.to(self._device)

    @torch.no_grad()
    def contributions(
        self,
        params: Mapping[str, Tensor],
        index: int,
        sh_degree: int,
        pixel_map: Tensor | Callable[[Tensor], Tensor] | None = None,
    ) -> ViewContributions:
        """Sum what every Gaussian contributes to a view, and a map [H, W] or what a function makes of the image."""
        view = self._open(self._shot(params, index, sh_degree))
        seen = view.seen()
        if callable(pixel_map):
            pixel_map = pixel_map(seen.image)
        found = view.contributions(pixel_map)
        mask, ids = self._views[index].mask, seen.dominant_ids
        counts = dominant_counts(ids if mask is None else ids[mask.to(ids.device)], len(params["means"]))
        sums = (found.weight_sum, found.n_pixels, found.map_sum, found.distance_sum)
        return ViewContributions(*sums, counts, seen.image, seen.radii, seen.depths)

    @torch.no_grad()
    def image(self, params: Mapping[str, Tensor], index: int, sh_degree: int) -> Tensor:
        """Draw a view, not clamped. [H, W, 3]"""
        return self._open(self._shot(params, index, sh_degree)).seen().image

    @torch.no_grad()
    def sensitivities(self, params: Mapping[str, Tensor], index: int, sh_degree: int) -> Tensor:
        """Return Speedy-Splat's score of every Gaussian in a view. [N] float64"""
        return self._open(self._shot(params, index, sh_degree)).sensitivities()

    @torch.no_grad()
    def fisher(self, params: Mapping[str, Tensor], index: int, sh_degree: int, divisor: int = 4) -> Tensor:
        """Return PUP-3DGS's Fisher block of every Gaussian in a view by (mean, log-scale). [N, 6, 6] float64

        Args:
            divisor: of the view's width and height, rounded up; the field of view stays.

        Raises:
            PopError: antialiased, where opacities depend on the scales, which the blocks leave out.
        """
        if self._antialiased:
            raise PopError("Fisher blocks leave out how antialiased opacities depend on scales; use antialiased=False")
        return self._open(self._shot(params, index, sh_degree, divisor)).fisher_blocks()

    @torch.no_grad()
    def dominant_points(
        self, params: Mapping[str, Tensor], index: int, sh_degree: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return of every pixel of a view the point of the Gaussian that it belongs to, that Gaussian, and T_final.

        Returns:
            Points in world units [H, W, 3], ids, -1 for none [H, W], and the remaining light [H, W].
        """
        found = self._open(self._shot(params, index, sh_degree)).dominant_points()
        return found.points, found.ids, found.T_final

    def _shot(self, params: Mapping[str, Tensor], index: int, sh_degree: int, divisor: int = 1) -> PassInput:
        raw = {name: value.detach() for name, value in params.items()}
        bands = (sh_degree + 1) ** 2
        sh = torch.cat((raw["sh0"], raw["shN"][:, : bands - 1]), 1)
        scales, opacities = scales_from_log_scales(raw["scales"]), opacities_from_logits(raw["opacities"])
        gaussians = Gaussians(raw["means"], raw["quats"], scales, opacities, sh)
        camera = _smaller(self._views[index], divisor, self._device)
        background = self._background.to(raw["means"])
        return PassInput(gaussians, camera, sh_degree, background, self._profile, self._antialiased)


def _smaller(view: ViewTensors, divisor: int, device: torch.device) -> Camera:
    """Return a view's camera with its width and height divided, rounded up, and the same field of view."""
    width, height = -(-view.width // divisor), -(-view.height // divisor)
    K = view.K[0].clone()
    K[0] *= width / view.width
    K[1] *= height / view.height
    return Camera(view.viewmat[0].to(device), K.to(device), width, height)
