"""One view of a splat in float64: its render, its loss, and how the loss pulls at every pixel and every opacity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pop_fast.api.rasterize import rasterization
from pop_fast.data.capture import View
from pop_fast.errors import PopError
from pop_fast.stages.covariance import opacities_from_logits, scales_from_log_scales
from pop_fast.stages.losses import photometric
from pop_fast.stages.regularizers import importance_mask, pop_loss_vjp
from pop_fast.train.config import TrainConfig
from pop_fast.train.presets import LOSSES

TILE_SIZE = 16


@dataclass(frozen=True, eq=False)
class ExplainedView:
    """A rendered view and the derivatives of its loss.

    Attributes:
        view: camera, photograph and mask.
        config: profile, background, antialiasing and objective are read.
        sh_degree: highest active colour band.
        step: the step the splat was taken at, or None.
        gaussians: activated means, quats, scales, opacities, and sh. float64
        image: the render, not clamped. float64 [H, W, 3]
        info: rasterization's meta, unpacked, with dominance and counts.
        loss: the photometric loss.
        v_image: its derivative to the render. float64 [H, W, 3]
        v_opacities: its derivative to the activated opacities. float64 [N]
        counts: pixels inside the mask that each Gaussian dominates. int64 [N]
        lambda_pop: weight of the POP term.
        v_pop: derivative of the weighted POP term to the opacities. float64 [N]
    """

    view: View
    config: TrainConfig
    sh_degree: int
    step: int | None
    gaussians: dict[str, Tensor]
    image: Tensor
    info: Mapping[str, Any]
    loss: float
    v_image: Tensor
    v_opacities: Tensor
    counts: Tensor
    lambda_pop: float
    v_pop: Tensor

    @property
    def background(self) -> Tensor:
        """Colour behind everything. float64 [3]"""
        return torch.tensor(self.config.background, dtype=torch.float64)

    @property
    def important(self) -> Tensor:
        """Gaussians that dominate a pixel of the view. bool [N]"""
        return importance_mask(self.counts)

    def rasterized(self, dtype: torch.dtype = torch.float64, backend: Any = None, **changes: Any) -> Any:
        """Render the view again: (image [H, W, D], info), with other colours, another profile or another backend."""
        colors = changes.pop("colors", None)
        given = {name: tensor.to(dtype) for name, tensor in self.gaussians.items()}
        settings = settings_of(self.view, self.config, dtype) | changes
        draw = rasterization if backend is None else backend.rasterization
        if colors is None:
            settings["sh_degree"] = self.sh_degree
            settings["backgrounds"] = self.background.to(dtype)[None]
        own = given.pop("sh")
        drawn = own if colors is None else colors
        with torch.no_grad():
            images, _, info = draw(**given, colors=drawn, **settings)
        return images[0], info


def settings_of(view: View, config: TrainConfig, dtype: torch.dtype) -> dict[str, Any]:
    """Collect what `rasterization` is given of the camera, with dominance and counts."""
    return {
        "viewmats": torch.from_numpy(view.viewmat).to(dtype)[None],
        "Ks": torch.from_numpy(view.K).to(dtype)[None],
        "width": view.width,
        "height": view.height,
        "packed": False,
        "tile_size": TILE_SIZE,
        "rasterize_mode": "antialiased" if config.antialiased else "classic",
        "profile": config.renderer,
        "dominance": True,
        "counts": True,
    }


def explain_view(
    params: Mapping[str, Tensor],
    view: View,
    config: TrainConfig | None = None,
    sh_degree: int | None = None,
    step: int | None = None,
) -> ExplainedView:
    """Render a view in float64 and differentiate its loss.

    Args:
        params: raw parameters: means, scales, quats, opacities, sh0, shN.
        view: camera, photograph and mask.
        config: profile, background, antialiasing and objective; the defaults (POP's objective) when None.
        sh_degree: highest colour band, all of them when None.
        step: the training step the parameters are of, which decides the loss and whether POP was on.

    Raises:
        ValueError: the image is too small for SSIM, or a parameter is not finite; says which.
        PopError: there are no Gaussians.
    """
    config = TrainConfig() if config is None else config
    raw = {name: tensor.detach().double() for name, tensor in params.items()}
    if len(raw["means"]) == 0:
        raise PopError("params['means'] has no rows; there is nothing to explain in an empty splat")
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[raw["shN"].shape[1]] if sh_degree is None else sh_degree
    gaussians = {
        "means": raw["means"],
        "quats": raw["quats"],
        "scales": scales_from_log_scales(raw["scales"]),
        "opacities": opacities_from_logits(raw["opacities"]),
        "sh": torch.cat([raw["sh0"], raw["shN"]], dim=1)[:, : (degree + 1) ** 2],
    }
    leaf = gaussians["opacities"].clone().requires_grad_(True)
    given = {**gaussians, "opacities": leaf, "colors": gaussians["sh"]}
    del given["sh"]
    background = torch.tensor([config.background], dtype=torch.float64)
    settings = settings_of(view, config, torch.float64)
    images, _, info = rasterization(**given, **settings, sh_degree=degree, backgrounds=background, backend="fast")
    image = images[0]
    loss = _photometric(image, view, config, step or 0)
    v_image, v_opacities = torch.autograd.grad(loss, (image, leaf))
    counts = _counts(info, view, len(leaf))
    weight = config.strategy.lambda_pop
    visible = (info["radii"][0] > 0).all(1) if config.strategy.pop_over == "visible" else None
    v_pop = pop_loss_vjp(gaussians["opacities"], importance_mask(counts), weight, visible)
    return ExplainedView(
        view=view,
        config=config,
        sh_degree=degree,
        step=step,
        gaussians=gaussians,
        image=image.detach(),
        info={name: v.detach() if isinstance(v, Tensor) else v for name, v in _wanted(info).items()},
        loss=float(loss.detach()),
        v_image=v_image,
        v_opacities=v_opacities,
        counts=counts,
        lambda_pop=weight,
        v_pop=v_pop,
    )


def with_objective(config: TrainConfig, objective: str) -> TrainConfig:
    """Choose the loss: "run" keeps the splat's own, "pop" and "3dgs" are those of paper eqs. 9 and 2."""
    if objective == "run":
        return config
    plan = {} if config.given is None else {"preset": config.given.preset, "steps_scaler": config.given.steps_scaler}
    other = TrainConfig.of(method=objective, **plan)
    names = ("photometric", "photometric_divisor", "lambda_ssim", "l2_stop_iter", "strategy")
    return replace(config, given=None, **{name: getattr(other, name) for name in names})


def _wanted(info: Mapping[str, Any]) -> dict[str, Any]:
    names = ("means2d", "depths", "conics", "opacities", "radii", "dominant_ids", "dominant_weights", "n_contrib")
    return {name: info[name] for name in (*names, "n_traversed", "final_T", "flatten_ids", "isect_offsets")}


def _photometric(image: Tensor, view: View, config: TrainConfig, step: int) -> Tensor:
    target = torch.from_numpy(view.image).double() / 255.0
    mask = None if view.mask is None else torch.from_numpy(view.mask)
    objective = config.objective_at(step)
    return photometric(LOSSES.named(objective.pixelwise), objective, image, target, mask)


def _counts(info: Mapping[str, Any], view: View, n: int) -> Tensor:
    ids = info["dominant_ids"][0]
    kept = ids >= 0 if view.mask is None else (ids >= 0) & torch.from_numpy(view.mask)
    return torch.bincount(ids[kept], minlength=n)
