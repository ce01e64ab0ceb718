"""One HTML file that shows a splat: no network, the splat inside as SPZ, drawn by WebGL 2, sorted in a worker.

Any browser with WebGL 2 opens it.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from pop_fast.data.capture import View, focus_point, look_at_one_point
from pop_fast.io.formats import encoded
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import evenly
from pop_fast.view.document import asset
from pop_fast.view.paths import mean_up

# of a larger capture, an even selection
_MOST: Final = 60


@dataclass(frozen=True)
class PageCamera:
    """A pinhole camera: its name, world -> camera [4, 4] with y down and z forward, intrinsics [3, 3] and size, px."""

    name: str
    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int

    @property
    def eye(self) -> np.ndarray:
        """Its place in the world. [3]"""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def centred(self) -> PageCamera:
        """Return it with its axis in the middle of the image."""
        lens = self.K.copy()
        lens[:2, 2] = self.width / 2.0, self.height / 2.0
        return replace(self, K=lens)

    def entry(self, distance: float) -> dict[str, Any]:
        """Return what the page reads, with the distance from the eye to the point that the view turns about."""
        lens = {"fx": self.K[0, 0], "fy": self.K[1, 1], "cx": self.K[0, 2], "cy": self.K[1, 2]}
        return {
            "name": self.name,
            "rotation": self.viewmat[:3, :3].tolist(),
            "eye": self.eye.tolist(),
            "distance": distance,
            **{key: float(value) for key, value in lens.items()},
            "width": self.width,
            "height": self.height,
        }


def cameras_of(views: Sequence[View]) -> list[PageCamera]:
    """Take over the cameras of views, at most sixty, evenly."""
    return [PageCamera(view.name, view.viewmat, view.K, view.width, view.height) for view in evenly(views, _MOST)]


def camera_of_points(means: Tensor) -> PageCamera:
    """Make a camera that sees most of some points, for a splat whose cameras are not known; y is down."""
    points = means.double().numpy() if len(means) else np.zeros((1, 3))
    middle = np.median(points, axis=0)
    radius = max(float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.7)), 1e-3)
    viewmat = np.eye(4)
    viewmat[:3, 3] = -middle + [0.0, 0.0, 2.5 * radius]
    return PageCamera("view", viewmat, np.array([[800.0, 0.0, 400.0], [0.0, 800.0, 300.0], [0.0, 0.0, 1.0]]), 800, 600)


def view_distances(cameras: Sequence[PageCamera], means: Tensor) -> list[float]:
    """Return how far ahead of every camera lies the point that its view turns about.

    It is at the depth of the point that is nearest to all optical axes, or where that is behind the camera, of the
    median Gaussian ahead of it.
    """
    focus = focus_point(np.stack([camera.viewmat for camera in cameras]))
    points = means.double().numpy()
    found = []
    for camera in cameras:
        axis, eye = camera.viewmat[2, :3], camera.eye
        depths = (points - eye) @ axis
        ahead = depths[depths > 0.0]
        typical = float(np.median(ahead)) if len(ahead) else 1.0
        depth = float((focus - eye) @ axis)
        found.append(depth if 0.1 * typical < depth < 10.0 * typical else typical)
    return found


def first_view(cameras: Sequence[PageCamera]) -> int:
    """Return the camera that a page starts with: of those that have what all look at in the middle, the most typical.

    The subject is the point that is nearest to all optical axes. In the middle is what is within a quarter of the
    image's size from its centre; where no camera has the subject there, all are asked. Of these, the half that stands
    farthest away, which cuts least of the subject, and of that half the one whose direction from the subject is nearest
    to those of all cameras: the largest sum of cosines, the first of equals. Of cameras that look at no one point, as
    on a walk or in a room, it is the first.
    """
    viewmats = np.stack([camera.viewmat for camera in cameras])
    if not look_at_one_point(viewmats):
        return 0
    focus = focus_point(viewmats)
    seen = viewmats[:, :3, :3] @ focus + viewmats[:, :3, 3]
    sizes = np.array([(camera.width, camera.height) for camera in cameras], dtype=float)
    focal = np.array([(camera.K[0, 0], camera.K[1, 1]) for camera in cameras])
    centers = np.array([camera.K[:2, 2] for camera in cameras])
    depths = np.maximum(seen[:, 2:], 1e-12)
    off = np.abs(focal * seen[:, :2] / depths + centers - sizes / 2) / sizes
    middle = (seen[:, 2] > 0.0) & (off < 0.25).all(axis=1)
    asked = np.flatnonzero(middle) if middle.any() else np.arange(len(cameras))
    offsets = np.stack([camera.eye for camera in cameras]) - focus
    distances = np.linalg.norm(offsets, axis=1)
    rays = offsets / np.maximum(distances, 1e-12)[:, None]
    typical = rays @ rays.sum(axis=0)
    far = asked[distances[asked] >= np.median(distances[asked])]
    return int(far[np.argmax(np.round(typical[far], 9))])


_KEYS: Final = "drag: turn · shift or right button: move · wheel: nearer · arrows, + −, wasd · n, p: cameras · r: back"
# nothing is fetched; the worker is made from the page's own text
_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; worker-src blob:; img-src data:"
)
_TOUCH: Final = "one finger turns, two move and zoom"


def page_of(
    params: Mapping[str, Tensor],
    cameras: Sequence[PageCamera],
    config: TrainConfig,
    sh_degree: int,
    title: str,
    level: int = 0,
) -> bytes:
    """Make the page's bytes.

    It draws as the training's rasterizer does: the same projection, low-pass, cut-offs of alpha and background, colours
    to degree 3. It loses what SPZ loses, ends no pixel early, and holds sums of layers in half precision.

    Args:
        params: raw parameters, in the frame of the cameras.
        cameras: where it may start; none makes one that sees most of the splat.
        config: profile, background and antialiasing are read.
        sh_degree: highest colour band to draw.
        title: of the page.
        level: how coarsely view dependence is written, as of SPZ.
    """
    drawn = {**params, "shN": params["shN"][:, : (sh_degree + 1) ** 2 - 1]}
    scene = _scene(params["means"].detach().cpu(), cameras, config)
    data = base64.b64encode(encoded("spz", drawn, config.antialiased, level=level)).decode("ascii")
    scripts = [
        ("scene", "application/json", json.dumps(scene).replace("<", "\\u003c")),
        ("splat", "application/octet-stream", data),
        ("splat-vert", "x-shader/x-vertex", asset("html", "splat.vert")),
        ("splat-frag", "x-shader/x-fragment", asset("html", "splat.frag")),
        ("sorter", "text/x-worker", asset("html", "sorter.js")),
    ]
    held = "\n".join(f'<script id="{name}" type="{kind}">{content}</script>' for name, kind, content in scripts)
    buttons = "".join(
        f'<button id="{name}" aria-label="{what}" title="{what} ({key})">{sign}</button>'
        for name, what, key, sign in (
            ("previous", "previous camera", "p", "◀"),
            ("reset", "back to the camera", "r", "⟲"),
            ("next", "next camera", "n", "▶"),
        )
    )
    keys = f'<span class="keys">{escape(_KEYS)}</span><span class="touch">{escape(_TOUCH)}</span>'
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f"<title>{escape(title)}</title><style>{asset('html', 'page.css')}</style></head>"
        f'<body><canvas id="view" tabindex="0" aria-label="{escape(title)}: {escape(_KEYS)}"></canvas>'
        '<div id="message" role="status"></div>'
        f'<div id="panel"><span class="buttons">{buttons}</span><span id="name" role="status"></span>'
        f'<span id="help">{keys}</span></div>'
        f"{held}<script>{asset('html', 'viewer.js')}</script></body></html>\n"
    ).encode("utf-8", "backslashreplace")  # a title that is a file's name may be no text


def _scene(means: Tensor, cameras: Sequence[PageCamera], config: TrainConfig) -> dict[str, Any]:
    profile = config.renderer
    chosen = list(cameras) or [camera_of_points(means)]
    if profile.principal_point == "centred":
        chosen = [camera.centred() for camera in chosen]
    distances = view_distances(chosen, means)
    return {
        "cameras": [camera.entry(distance) for camera, distance in zip(chosen, distances, strict=True)],
        "first": first_view(chosen),
        "up": mean_up(np.stack([camera.viewmat for camera in chosen])).tolist(),
        "extent": max(distances),
        "background": [float(value) for value in torch.tensor(config.background)],
        "antialiased": config.antialiased,
        "near": profile.near_plane,
        "eps2d": profile.eps2d,
        "margin": profile.frustum_margin,
        # a square is widened to whole tiles, which hold nearly all that is over the floor
        "sigmas": profile.extent_sigmas if profile.extent == "opacity_aware" else 1e3,
        "floor": profile.alpha_floor,
        "ceiling": profile.alpha_ceiling,
    }
