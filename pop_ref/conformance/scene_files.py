"""Scenes as npz files: arrays by name, and everything else as one JSON string."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.constants import Profile
from pop_ref.types import Camera, Gaussians

_ARRAYS = ("means", "quats", "scales", "opacities", "sh")


def scene_arrays(scene: Scene) -> dict[str, np.ndarray]:
    """Return the scene's arrays by name; `options` is a JSON string of what is not an array."""
    g, c = scene.gaussians, scene.camera
    options = {
        "width": c.width,
        "height": c.height,
        "tile_size": scene.tile_size,
        "sh_degree": scene.sh_degree,
        "antialiased": scene.antialiased,
        "profile": dataclasses.asdict(scene.profile),
    }
    arrays = {name: getattr(g, name) for name in _ARRAYS}
    return {
        **arrays,
        "viewmat": c.viewmat,
        "K": c.K,
        "background": scene.background,
        "options": np.array(json.dumps(options)),
    }


def save_scene(path: Path, scene: Scene) -> None:
    """Write a scene."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = scene_arrays(scene)
    np.savez(path, **arrays)


def load_scene(path: Path) -> Scene:
    """Read a scene that `save_scene` wrote."""
    with np.load(path) as stored:
        options = json.loads(str(stored["options"]))
        gaussians = Gaussians(*(stored[name] for name in _ARRAYS))
        camera = Camera(stored["viewmat"], stored["K"], options["width"], options["height"])
        return Scene(
            gaussians,
            camera,
            stored["background"],
            Profile(**options["profile"]),
            options["tile_size"],
            options["sh_degree"],
            options["antialiased"],
        )
