"""A view as maps: what dominates, how many are blended and visited, where rays end, and where POP pulls."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from pop_fast.io.atomic import write_atomically
from pop_fast.io.images import write_png
from pop_fast.io.pictures import error_magnitude, error_scale, id_colors
from pop_fast.view.explain.scene import TILE_SIZE, ExplainedView

# scales end at this quantile, so that a few pixels do not set them
_TOP = 0.995
_LEAST_LIGHT = 0.01
_NONE = (70, 70, 74)
_UP, _DOWN = (255, 140, 60), (80, 140, 255)


@dataclass(frozen=True, eq=False)
class Map:
    """One picture of a view.

    Attributes:
        name: of the file, without suffix.
        title: what it shows.
        about: how to read it.
        picture: uint8 [H, W, 3]
        scale: colours, first and last value of the scale; None where colours are not numbers.
    """

    name: str
    title: str
    about: str
    picture: np.ndarray
    scale: tuple[str, float, float] | None = None


def view_maps(scene: ExplainedView) -> list[Map]:
    """Draw all maps of a view."""
    info = scene.info
    render, photo = as_uint8(scene.image.numpy()), scene.view.image
    error = error_magnitude(render, photo)
    shares = _shares(scene)
    pulls = scaled(
        "pop_pull",
        "Where POP pulls",
        "weight of Gaussians that POP pulls up, less weight of those it pushes down",
        shares[1],
        "coolwarm",
        1.0,
        -1.0,
    )
    return [
        Map("render", "Render", "what the splat shows, clamped to [0, 1]", render),
        Map("photo", "Photograph", "what it should show", photo),
        scaled(
            "error", "Error", "mean over the channels of |render - photograph|", error, "magma", error_scale([error])
        ),
        Map(
            "dominant_ids",
            "Dominant Gaussian",
            "every pixel in the colour of the Gaussian with the largest weight (D8); black: none",
            id_colors(info["dominant_ids"][0].numpy()),
        ),
        _count("n_blended", "Blended", "Gaussians blended into the pixel", info["n_contrib"][0].numpy()),
        _count(
            "n_traversed", "Traversed", "list entries visited until the pixel ended", info["n_traversed"][0].numpy()
        ),
        _termination(scene),
        _light_left(info["final_T"][0].numpy()),
        scaled(
            "importance",
            "Important light",
            "share of the pixel's weight that is of Gaussians that dominate a pixel somewhere in the view",
            shares[0],
            "viridis",
            1.0,
        ),
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
    text = json.dumps(legend, indent=2) + "\n"
    write_atomically(folder / "maps.json", lambda file: file.write(text.encode()))


def scaled(name: str, title: str, about: str, values: np.ndarray, colors: str, top: float, low: float = 0.0) -> Map:
    """Colour numbers [H, W] by one of matplotlib's scales; NaN is grey."""
    from matplotlib import colormaps

    table = np.round(colormaps[colors](np.linspace(0.0, 1.0, 256))[:, :3] * 255.0).astype(np.uint8)
    known = np.isfinite(values)
    level = (np.where(known, values, low) - low) / max(top - low, 1e-12)
    picture = table[np.clip(np.round(level * 255.0), 0, 255).astype(np.uint8)]
    picture[~known] = _NONE
    return Map(name, title, about, picture, (colors, low, top))


def as_uint8(image: np.ndarray) -> np.ndarray:
    """Round an image in [0, 1] to 8 bit, clamped."""
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


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


def enlarged(picture: np.ndarray, factor: int) -> np.ndarray:
    """Enlarge a picture pixel by pixel."""
    return cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
