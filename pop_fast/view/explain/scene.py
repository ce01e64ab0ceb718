"""One view of a splat in float64: its render, its loss, how the loss pulls at pixels and opacities; and its maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pop_fast.api.rasterize import rasterization
from pop_fast.data.capture import View
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_json
from pop_fast.io.images import colormap_table, error_magnitude, error_scale, id_colors, to_uint8, write_png
from pop_fast.stages.covariance import opacities_from_logits, scales_from_log_scales
from pop_fast.stages.losses import photometric
from pop_fast.stages.regularizers import importance_mask, pop_loss_vjp
from pop_fast.train.config import TrainConfig
from pop_fast.train.presets import LOSSES

TILE_SIZE = 16
# of rasterization's meta
_KEPT = ("means2d", "depths", "conics", "opacities", "radii", "dominant_ids", "dominant_weights", "n_contrib")
_KEPT += ("n_traversed", "final_T", "flatten_ids", "isect_offsets")


@dataclass(frozen=True, eq=False)
class ExplainedView:
    """A rendered view and the derivatives of its loss."""

    view: View  # camera, photograph and mask
    config: TrainConfig  # profile, background, antialiasing and objective are read
    sh_degree: int  # highest active colour band
    step: int | None  # the step the splat was taken at, or None
    gaussians: dict[str, Tensor]  # activated means, quats, scales, opacities, and sh. float64
    image: Tensor  # the render, not clamped. float64 [H, W, 3]
    info: Mapping[str, Any]  # rasterization's meta, unpacked, with dominance and counts
    loss: float  # the photometric loss
    v_image: Tensor  # its derivative to the render. float64 [H, W, 3]
    v_opacities: Tensor  # its derivative to the activated opacities. float64 [N]
    counts: Tensor  # pixels inside the mask that each Gaussian dominates. int64 [N]
    lambda_pop: float  # weight of the POP term
    v_pop: Tensor  # derivative of the weighted POP term to the opacities. float64 [N]

    @property
    def background(self) -> Tensor:
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
        with torch.no_grad():
            images, _, info = draw(**given, colors=own if colors is None else colors, **settings)
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
        info={name: v.detach() if isinstance(v, Tensor) else v for name, v in info.items() if name in _KEPT},
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


def _photometric(image: Tensor, view: View, config: TrainConfig, step: int) -> Tensor:
    target = torch.from_numpy(view.image).double() / 255.0
    mask = None if view.mask is None else torch.from_numpy(view.mask)
    objective = config.objective_at(step)
    return photometric(LOSSES.named(objective.pixelwise), objective, image, target, mask)


def _counts(info: Mapping[str, Any], view: View, n: int) -> Tensor:
    ids = info["dominant_ids"][0]
    kept = ids >= 0 if view.mask is None else (ids >= 0) & torch.from_numpy(view.mask)
    return torch.bincount(ids[kept], minlength=n)


# scales end at this quantile, so that a few pixels do not set them
_TOP = 0.995
_LEAST_LIGHT = 0.01
_NONE = (70, 70, 74)
_UP, _DOWN = (255, 140, 60), (80, 140, 255)


@dataclass(frozen=True, eq=False)
class Map:
    """One picture of a view, uint8 [H, W, 3]; `scale` is None, or colours, first and last value of the scale."""

    name: str
    title: str
    about: str
    picture: np.ndarray
    scale: tuple[str, float, float] | None = None


def view_maps(scene: ExplainedView) -> list[Map]:
    info = scene.info
    render, photo = to_uint8(scene.image.numpy()), scene.view.image
    error = error_magnitude(render, photo)
    light, pull = _shares(scene)
    about_error = "mean over the channels of |render - photograph|"
    about_ids = "every pixel in the colour of the Gaussian with the largest weight (D8); black: none"
    about_light = "share of the pixel's weight from Gaussians that dominate some pixel of the view"
    about_pull = "weight of Gaussians that POP pulls up, less weight of those it pushes down"
    visited = info["n_traversed"][0].numpy()
    pulls = scaled("pop_pull", "Where POP pulls", about_pull, pull, "coolwarm", 1.0, -1.0)
    return [
        Map("render", "Render", "what the splat shows, clamped to [0, 1]", render),
        Map("photo", "Photograph", "what it should show", photo),
        scaled("error", "Error", about_error, error, "magma", error_scale([error])),
        Map("dominant_ids", "Dominant Gaussian", about_ids, id_colors(info["dominant_ids"][0].numpy())),
        _count("n_blended", "Blended", "Gaussians blended into the pixel", info["n_contrib"][0].numpy()),
        _count("n_traversed", "Traversed", "list entries visited until the pixel ended", visited),
        _termination(scene),
        _light_left(info["final_T"][0].numpy()),
        scaled("importance", "Important light", about_light, light, "viridis", 1.0),
        _dots(scene, render),
        *([pulls] if scene.lambda_pop > 0.0 else []),
    ]


def write_maps(maps: list[Map], folder: Path) -> None:
    """Write each map as PNG, pixel for pixel as large as the view, and maps.json, which tells how to read them."""
    legend = {}
    for entry in maps:
        write_png(folder / f"{entry.name}.png", entry.picture)
        scale = None if entry.scale is None else dict(zip(("colors", "low", "top"), entry.scale, strict=True))
        legend[f"{entry.name}.png"] = {"title": entry.title, "about": entry.about, "scale": scale}
    write_json(folder / "maps.json", legend)


def scaled(name: str, title: str, about: str, values: np.ndarray, colors: str, top: float, low: float = 0.0) -> Map:
    """Colour numbers [H, W] by one of matplotlib's scales; NaN is grey."""
    table = colormap_table(colors)
    known = np.isfinite(values)
    level = (np.where(known, values, low) - low) / max(top - low, 1e-12)
    picture = table[np.clip(np.round(level * 255.0), 0, 255).astype(np.uint8)]
    picture[~known] = _NONE
    return Map(name, title, about, picture, (colors, low, top))


def _count(name: str, title: str, about: str, counts: np.ndarray) -> Map:
    top = max(int(np.quantile(counts, _TOP)), 1)
    most = f", {int(counts.max()):,} at most" if counts.max() > top else ""
    return scaled(name, title, f"{about}; {counts.mean():.1f} on average{most}", counts, "viridis", top)


def _light_left(left: np.ndarray) -> Map:
    # nearly all of a good splat is opaque: a scale up to 1 would show one colour
    top = max(float(np.quantile(left, _TOP)), _LEAST_LIGHT)
    share = float((left > _LEAST_LIGHT).mean())
    about = f"T_final, the share of the background; over {_LEAST_LIGHT:g} in {share:.1%} of the pixels"
    return scaled("T_final", "Light left", about, left, "viridis", top)


def _shares(scene: ExplainedView) -> tuple[np.ndarray, np.ndarray]:
    colors = torch.stack([scene.important.double(), -torch.sign(scene.v_pop)], dim=1)
    blended, _ = scene.rasterized(colors=colors)
    return blended[..., 0].numpy(), blended[..., 1].numpy()


def termination_depths(scene: ExplainedView) -> np.ndarray:
    """Give the camera z of the entry that ended each pixel (D7); NaN where the list ran out first. [H, W]"""
    info, profile = scene.info, scene.config.renderer
    # T only falls, so a walk stops somewhere if and only if all of the list would take T to the stop
    nothing = scene.gaussians["means"].new_zeros((len(scene.counts), 1))
    endless = replace(profile, transmittance_stop=0.0)
    _, to_the_end = scene.rasterized(colors=nothing, profile=endless, dominance=False, counts=False)
    left, stop = to_the_end["final_T"][0].numpy(), profile.transmittance_stop
    ended = left <= stop if profile.stop_inclusive else left < stop
    rows, columns = np.nonzero(ended)
    first = info["isect_offsets"][0].numpy()[rows // TILE_SIZE, columns // TILE_SIZE]
    last = info["flatten_ids"].numpy()[first + info["n_traversed"][0].numpy()[ended] - 1]
    depths = np.full(ended.shape, np.nan)
    depths[ended] = info["depths"][0].numpy()[last]
    return depths


def _termination(scene: ExplainedView) -> Map:
    depths = termination_depths(scene)
    known = depths[np.isfinite(depths)]
    low, top = (float(np.quantile(known, q)) for q in (0.01, 0.99)) if len(known) else (0.0, 1.0)
    share = len(known) / depths.size
    about = f"camera z of the splat that ended the pixel (D7), which {share:.0%} have; grey: the list ran out first"
    return scaled("termination_depth", "Termination depth", about, depths, "viridis", top, low)


def _dots(scene: ExplainedView, render: np.ndarray) -> Map:
    picture = (render * 0.35).astype(np.uint8)
    means2d, shown = scene.info["means2d"][0].numpy(), (scene.info["radii"][0] > 0).all(1).numpy()
    important = scene.important.numpy()
    for chosen, color in ((shown & ~important, _DOWN), (shown & important, _UP)):
        at = np.floor(means2d[chosen]).astype(np.int64)
        at = at[((at >= 0) & (at < [scene.view.width, scene.view.height])).all(axis=1)]
        picture[at[:, 1], at[:, 0]] = color
    count = int(important.sum())
    about = f"centres of the {count:,} Gaussians that dominate a pixel in orange, of the other visible ones in blue"
    return Map("importance_gaussians", "Important Gaussians", about, picture)


def crop(picture: np.ndarray, x: int, y: int, side: int) -> tuple[np.ndarray, int, int]:
    """Cut a square around a pixel, moved inside the picture; returns it with its corner."""
    height, width = picture.shape[:2]
    left = min(max(x - side // 2, 0), max(width - side, 0))
    top = min(max(y - side // 2, 0), max(height - side, 0))
    return np.ascontiguousarray(picture[top : top + side, left : left + side]), left, top
