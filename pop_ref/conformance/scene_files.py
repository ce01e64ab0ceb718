"""Scenes as npz files: arrays by name, and everything else as one JSON string."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.constants import Profile
from pop_ref.records import Camera, Gaussians

_CAMERA = ("viewmat", "K", "background")
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")


def scene_arrays(scene: Scene) -> dict[str, np.ndarray]:
    """Return the scene's arrays by name."""
    arrays = {name: getattr(scene.gaussians, name) for name in _ARRAYS}
    return {**arrays, "viewmat": scene.camera.viewmat, "K": scene.camera.K, "background": scene.background}


def scene_options(scene: Scene) -> dict[str, Any]:
    """Return everything of a scene that is not an array, as JSON can hold it."""
    return {
        "width": scene.camera.width,
        "height": scene.camera.height,
        "tile_size": scene.tile_size,
        "sh_degree": scene.sh_degree,
        "antialiased": scene.antialiased,
        "profile": dataclasses.asdict(scene.profile),
    }


def save_scene(path: Path, scene: Scene) -> None:
    """Write a scene."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {**scene_arrays(scene), "options": np.array(json.dumps(scene_options(scene)))}
    np.savez(path, **arrays)


def load_scene(path: Path) -> Scene:
    """Read a scene that `save_scene` wrote.

    Raises:
        ValueError: the file is none; names it.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: np.asarray(stored[name], np.float64) for name in (*_ARRAYS, *_CAMERA)}
            options = json.loads(str(stored["options"]))
        return scene_from(arrays, options)
    # what is damaged in a zip, in an array's head or in a scene ends in errors of many kinds
    except Exception as error:
        raise ValueError(f"{path}: is no scene of the kit ({error!r}); write it again") from error


def scene_from(arrays: dict[str, np.ndarray], options: dict[str, Any]) -> Scene:
    """Make a scene of its arrays and options."""
    return Scene(
        Gaussians(*(arrays[name] for name in _ARRAYS)),
        Camera(arrays["viewmat"], arrays["K"], options["width"], options["height"]),
        arrays["background"],
        Profile(**options["profile"]),
        options["tile_size"],
        options["sh_degree"],
        options["antialiased"],
    )
