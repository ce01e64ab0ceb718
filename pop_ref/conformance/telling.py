"""Where a backend parts from the oracle: the first stage, Gaussian and pixel, and the decision that was nearest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter, View
from pop_ref.conformance.cases import sensitivity
from pop_ref.conformance.charges import REACH, charge
from pop_ref.conformance.scene_files import save_scene
from pop_ref.conformance.scenes import Scene, scene_as_code
from pop_ref.margins import margins


class Difference(NamedTuple):
    """One place where the two sides differ."""

    stage: str
    where: str
    oracle: Any
    backend: Any

    def __str__(self) -> str:
        return f"{self.stage}, {self.where}: oracle {self.oracle}, backend {self.backend}"


def _calls(scene: Scene) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Yield the stage functions in the order of a render with the oracle's own inputs; rows behind are left out."""
    oracle = OracleAdapter().stage
    camera, profile = scene.camera, scene.profile
    depths = oracle("means_cam_from_means")(scene.gaussians.means, camera.viewmat)[:, 2]
    yield "in_front", (depths, profile)
    g = scene.rows(oracle("in_front")(depths, profile)).gaussians
    pinhole = (camera.K, camera.width, camera.height, profile)
    yield "rotmats_from_quats", (g.quats,)
    yield "covars_from_quats_scales", (g.quats, g.scales)
    yield "means_cam_from_means", (g.means, camera.viewmat)
    covars = oracle("covars_from_quats_scales")(g.quats, g.scales)
    yield "covars_cam_from_covars", (covars, camera.viewmat)
    means_cam = oracle("means_cam_from_means")(g.means, camera.viewmat)
    yield "project_means", (means_cam, *pinhole)
    yield "projection_jacobians", (means_cam, *pinhole)
    covars_cam = oracle("covars_cam_from_covars")(covars, camera.viewmat)
    jacobians = oracle("projection_jacobians")(means_cam, *pinhole)
    yield "project_covars", (covars_cam, jacobians)
    covars2d = oracle("project_covars")(covars_cam, jacobians)
    yield "low_pass", (covars2d, profile.eps2d)
    blurred = oracle("low_pass")(covars2d, profile.eps2d)
    yield "conics_from_covars2d", (blurred,)
    yield "radii_from_covars2d", (blurred, g.opacities, profile)
    dirs = oracle("view_dirs")(g.means, camera.viewmat)
    degree = round(np.sqrt(g.sh.shape[1])) - 1 if scene.sh_degree is None else scene.sh_degree
    yield "colors_from_sh", (g.sh, dirs, degree)


def first_stage(backend: Any, scene: Scene) -> Difference | None:
    """Find the first stage function that differs, each called with the oracle's inputs."""
    oracle, eps = OracleAdapter(), float(np.finfo(backend.dtype).eps)
    for name, inputs in _calls(scene):
        if not backend.has(name):
            continue
        function: Callable[..., Any] = oracle.stage(name)
        expected = np.asarray(function(*inputs))
        found = np.asarray(backend.stage(name)(*inputs))
        if expected.dtype.kind in "bi":
            wrong = found != expected
        else:
            wrong = ~(np.abs(found - expected) <= REACH * eps * sensitivity(function, inputs)[0])
        if np.any(wrong):
            i = tuple(int(k) for k in np.argwhere(wrong)[0])
            return Difference(name, f"Gaussian {i[0]} of those in front, entry {list(i[1:])}", expected[i], found[i])
    return None


def first_pixel(backend: Any, scene: Scene) -> tuple[Difference, tuple[int, int]] | None:
    """Find the first pixel that differs by more than rounding, doubtful or not."""
    expected, found = OracleAdapter().render(scene), backend.render(scene)
    charges = charge(scene, backend.dtype)
    limit = charges.reach * (charges.T_final + 1.0)
    colors = charges.reach * (charges.image + charges.absolute)
    checks: list[tuple[str, Any]] = [
        ("T_final", np.abs(found.T_final - expected.T_final) > limit),
        ("image", np.any(np.abs(found.image - expected.image) > colors, axis=2)),
    ]
    for name in ("n_blended", "dominant_ids"):
        if getattr(found, name) is not None:
            checks.append((name, getattr(found, name) != getattr(expected, name)))
    for name, wrong in checks:
        if np.any(wrong):
            y, x = (int(k) for k in np.argwhere(wrong)[0])
            return _at(name, expected, found, x, y), (x, y)
    return None


def _at(name: str, expected: View, found: View, x: int, y: int) -> Difference:
    values = [np.asarray(getattr(view, name))[y, x].tolist() for view in (expected, found)]
    return Difference(name, f"pixel ({x}, {y})", *values)


def nearest_decision(scene: Scene, pixel: tuple[int, int] | None) -> str:
    """Name the decision closest to its threshold, at a pixel if one is given."""
    found = margins(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.tile_size, scene.antialiased)
    if pixel is not None:
        x, y = pixel
        label = min(found.pixels, key=lambda name: float(found.pixels[name][y, x]))
        margin = float(found.pixels[label][y, x])
        return f"nearest decision at that pixel: {label}, margin {margin:.3g} (float32 decides alike over 1e-6)"
    if found.nearest is None:
        return "no decision is near its threshold"
    doubt = found.nearest
    return f"nearest decision: {doubt.decision} of {doubt.where}, margin {doubt.margin:.3g}"


def tell(name: str, backend: Any, drawn: dict[str, Any]) -> str:
    """Write a failing law's report: what differs first, the nearest decision, and the scene as code to paste."""
    lines = [f"law {name.removeprefix('test_')} fails on {backend.name}"]
    for scene in (value for value in drawn.values() if isinstance(value, Scene)):
        seen = backend.sees(scene)
        stage = first_stage(backend, seen)
        pixel = first_pixel(backend, seen)
        if stage is not None:
            lines.append(f"first stage that differs: {stage}")
        if pixel is not None:
            lines.append(f"first pixel that differs: {pixel[0]}")
        if stage is None and pixel is None:
            lines.append("stages and pixels of this scene are the oracle's; the law breaks in what it compares")
        lines.append(nearest_decision(seen, None if pixel is None else pixel[1]))
        lines.append("scene to paste:\n" + scene_as_code(seen))
    return "\n".join(lines)


def failure_saver(folder: Path) -> Callable[[str, Any, dict[str, Any]], str]:
    """Return a teller that saves the scene of a failing law; the last one written is the shrunk one."""

    def save(name: str, backend: Any, drawn: dict[str, Any]) -> str:
        saved = []
        for key, value in drawn.items():
            if isinstance(value, Scene):
                path = folder / f"{name.removeprefix('test_')}.{backend.name.replace(':', '.')}.{key}.npz"
                save_scene(path, backend.sees(value))
                saved.append(f"saved as {path}")
        return "\n".join(saved)

    return save
