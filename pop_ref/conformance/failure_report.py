"""Where a backend parts from the oracle: stage, Gaussian, pixel, gradient and nearest decision; of a call, argument."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter, View, error_bounds_of
from pop_ref.conformance.assertions import MOTIONS, along_rigid_motions
from pop_ref.conformance.calls import Call, call_as_code
from pop_ref.conformance.capabilities import GRADIENTS, RENDER
from pop_ref.conformance.cases import sensitivity
from pop_ref.conformance.error_bounds import REACH
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.pairs import CHECKS, Check, breaks, cause, narrowed
from pop_ref.conformance.scenes import Scene, cotangents, save_scene, scene_as_code
from pop_ref.margins import margins

ORACLE = OracleAdapter()
# a call of larger pictures is reported with all its Gaussians: to try without each would take minutes
MOST_PIXELS = 1200
# what a rasterizer's meta may show of the stages before the pixel, in the order of a render
SHOWN = (("depths", "means_cam_from_means"), ("means2d", "project_means"), ("conics", "conics_from_covars2d"))


class Difference(NamedTuple):
    """One place where the two sides differ."""

    what: str
    where: str
    oracle: Any
    backend: Any

    def __str__(self) -> str:
        return f"{self.what}, {self.where}: oracle {self.oracle}, backend {self.backend}"


def _calls(scene: Scene) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Yield the stage functions in the order of a render with the oracle's own inputs; rows behind are left out."""
    oracle = ORACLE.stage
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
    yield "colors_from_sh", (g.sh, dirs, scene.degree)


def first_stage(backend: Any, scene: Scene) -> Difference | None:
    """Find the first stage function that differs, each called with the oracle's inputs."""
    eps = float(np.finfo(backend.dtype).eps)
    for name, inputs in _calls(scene):
        if not backend.has(name):
            continue
        function: Callable[..., Any] = ORACLE.stage(name)
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


def first_shown(backend: Any, scene: Scene) -> Difference | list[str]:
    """Find the first stage whose result, as the rasterizer's meta shows it, differs; else the names of those shown."""
    found, expected, error_bounds = backend.render(scene), ORACLE.render(scene), error_bounds_of(scene, backend.dtype)
    alike = []
    # rows that either side culls hold nothing to compare
    drawn = np.all(expected.radii > 0, axis=1)
    if found.radii is not None:
        drawn &= np.all(found.radii > 0, axis=1)
    for name, stage in SHOWN:
        value = getattr(found, name)
        if value is None:
            continue
        wanted, units = getattr(expected, name), getattr(error_bounds.screen, f"e_{name}")
        for i in np.flatnonzero(drawn).tolist():
            limit = error_bounds.reach * (units[i] + np.abs(wanted[i]))
            if np.any(~(np.abs(value[i] - wanted[i]) <= limit)):
                what = f"{name} as its meta shows them ({stage})"
                return Difference(what, f"Gaussian {i}", np.asarray(wanted[i]).tolist(), np.asarray(value[i]).tolist())
        alike.append(name)
    return alike


def first_pixel(backend: Any, scene: Scene) -> tuple[Difference, tuple[int, int]] | None:
    """Find the first pixel that differs by more than rounding, near a threshold or not."""
    expected, found = ORACLE.render(scene), backend.render(scene)
    error_bounds = error_bounds_of(scene, backend.dtype)
    limit = error_bounds.reach * (error_bounds.T_final + 1.0)
    colors = error_bounds.reach * (error_bounds.image + error_bounds.absolute)
    checks: list[tuple[str, Any]] = [
        ("T_final", ~(np.abs(found.T_final - expected.T_final) <= limit)),
        ("image", np.any(~(np.abs(found.image - expected.image) <= colors), axis=2)),
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


def first_gaussian(backend: Any, scene: Scene) -> str | None:
    """Add Gaussians one by one from the front until a pixel differs, and say with which."""
    V = scene.camera.viewmat
    depths = scene.gaussians.means @ V[2, :3] + V[2, 3]
    order = np.lexsort((np.arange(len(depths)), depths))
    for k in range(len(order) + 1):
        found = first_pixel(backend, scene.rows(np.sort(order[:k])))
        if found is not None:
            added = f"Gaussian {int(order[k - 1])} is added to those in front of it" if k else "there is no Gaussian"
            return f"as soon as {added}: {found[0]}"
    return None


def first_gradient(backend: Any, scene: Scene) -> Difference | None:
    """Find the first gradient that differs, of the standard cotangents where no decision is near its threshold."""
    error_bounds = error_bounds_of(scene, backend.dtype)
    v_image, v_T_final = cotangents(scene)
    v_image, v_T_final = v_image * error_bounds.smooth[..., None], v_T_final * error_bounds.smooth
    expected, found = (side.gradients(scene, v_image, v_T_final) for side in (ORACLE, backend))
    bounds = gradient_error_bounds(scene, error_bounds, v_image, v_T_final)
    smooth = ~error_bounds.screen.kinked
    if "viewmat" in found:
        V = scene.camera.viewmat
        for side, sign in ((found, -1.0), (expected, -1.0), (bounds, 1.0)):
            side["viewmat"] = along_rigid_motions(V if side is not bounds else np.abs(V), side["viewmat"], sign)
    for name in ("background", "sh", "opacities", "means2d", "means2d_abs", "scales", "quats", "means", "viewmat"):
        if name not in found or (name == "viewmat" and not np.all(smooth)):
            continue
        wrong = ~(np.abs(found[name] - expected[name]) <= error_bounds.reach * bounds[name])
        if name not in ("background", "viewmat"):
            wrong[~smooth] = False
        if np.any(wrong):
            i = tuple(int(k) for k in np.argwhere(wrong)[0])
            row = "entry" if name == "background" else f"Gaussian {i[0]}, entry"
            entry = i if name == "background" else i[1:]
            where = MOTIONS[i[0]] if name == "viewmat" else f"{row} {list(entry)}"
            return Difference(f"v_{name}", where, expected[name][i], found[name][i])
    return None


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
    close = found.nearest
    return f"nearest decision: {close.decision} of {close.where}, margin {close.margin:.3g}"


def failure_report(name: str, backend: Any, scenes: dict[str, Scene]) -> str:
    """Write a failing law's report: what differs first, the nearest decision, and the scene or the call as code.

    Args:
        name: the law.
        backend: that broke it; as a law watched it, it says whether gradients were asked for, and what calls were made.
        scenes: what was drawn, by name; the first that the backend draws otherwise than the oracle is reported.
    """
    title = f"law {name.removeprefix('test_')} fails on {backend.name}"
    calls = getattr(backend, "calls", [])
    if calls:
        # a law stops at the call that breaks it
        return "\n".join([title, *call_findings(backend, calls[-1])])
    reports = [(scene, *_findings(backend, scene)) for scene in scenes.values()]
    if not reports:
        return f"{title}\nit draws no scene; what was drawn stands above"
    scene, lines, pixel = next((report for report in reports if report[1]), reports[0])
    if not lines:
        lines = [f"{_compared(backend, scene)} of its scenes are the oracle's; the law breaks in what it compares"]
    return "\n".join([title, *lines, nearest_decision(scene, pixel), f"scene to paste:\n{scene_as_code(scene)}"])


def call_findings(backend: Any, call: Call) -> list[str]:
    """Say what differs first of a call, which of its arguments it takes, and give the call as code, narrowed.

    Stages are spoken of only where the call needs no argument to break, and only of those that can be compared.
    """
    checks: dict[str, Check | None] = {"answer": None, **CHECKS}
    found = next(((what, check) for what, check in checks.items() if breaks(backend, call, check) is not None), None)
    if found is None:
        parts = ", ".join(checks if backend.has(GRADIENTS) else [what for what in checks if what != "gradients"])
        return [
            f"the {parts} of its last call are the oracle's; the law breaks in what it compares",
            f"call to paste:\n{call_as_code(call)}",
        ]
    what, check = found
    camera = call.first.scene.camera
    plain, words = narrowed(backend, call, check, gaussians=camera.width * camera.height <= MOST_PIXELS)
    lines = [f"first difference: {what}: {words}", f"first cause: {cause(backend, plain, check)}"]
    if not plain.described():
        lines += _findings(backend, plain.first.scene)[0]
    return [*lines, f"call to paste:\n{call_as_code(plain)}"]


def _compared(backend: Any, scene: Scene) -> str:
    """Name what a report has compared of a scene."""
    stages = sum(backend.has(name) for name, _ in _calls(scene))
    parts = [f"{stages} stages"] * (stages > 0) + ["pixels"] * backend.has(RENDER)
    parts += ["gradients"] * bool(getattr(backend, "asked_for_gradients", True) and backend.has(GRADIENTS))
    return " and ".join(parts) or "nothing that could be compared"


def _findings(backend: Any, scene: Scene) -> tuple[list[str], tuple[int, int] | None]:
    stage = first_stage(backend, scene)
    lines = [] if stage is None else [f"first stage that differs: {stage}"]
    pixel = first_pixel(backend, scene) if backend.has(RENDER) else None
    if pixel is not None:
        lines += _from_meta(backend, scene, pixel[0]) if stage is None else []
        lines.append(f"first pixel that differs: {pixel[0]}")
        lines.append(f"first Gaussian: {first_gaussian(backend, scene)}")
    elif getattr(backend, "asked_for_gradients", True) and backend.has(GRADIENTS):
        # a law that asked for none is not broken by one
        gradient = first_gradient(backend, scene)
        lines += [] if gradient is None else [f"first gradient that differs: {gradient}"]
    return lines, None if pixel is None else pixel[1]


def _from_meta(backend: Any, scene: Scene, pixel: Difference) -> list[str]:
    """Say what meta shows of the stages before the pixel; what follows from it, only where it shows all of them."""
    shown = first_shown(backend, scene)
    if isinstance(shown, Difference):
        return [f"first stage that differs: {shown}"]
    if len(shown) < len(SHOWN):
        return [f"no stage that its meta shows differs: {', '.join(shown)}"] if shown else []
    after = {"T_final": "so it is opacity, a cull, alpha or where a pixel ends",
             "image": "and so is T_final, so it is colours, their order or the background"}  # fmt: skip
    so = after.get(pixel.what, "and so is the image, so it is what is told of the pixel")
    return [f"no stage that its meta shows differs: {', '.join(shown)}, {so}"]


def failure_saver(folder: Path) -> Callable[[str, Any, dict[str, Scene]], str]:
    """Return a teller that saves the scenes of a failing law."""

    def save(name: str, backend: Any, scenes: dict[str, Scene]) -> str:
        saved = []
        for key, scene in scenes.items():
            path = folder / f"{name.removeprefix('test_')}.{backend.name.replace(':', '.')}.{key}.npz"
            save_scene(path, scene)
            saved.append(f"saved as {path}")
        return "\n".join(saved)

    return save
