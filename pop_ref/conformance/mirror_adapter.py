"""The host mirror as a backend of the conformance kit: stages with the oracle's signatures, renders, gradients."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance.adapter import Adapter, View
from pop_ref.conformance.capabilities import ANTIALIASING, DETERMINISTIC, DOMINANCE, ROWWISE
from pop_ref.conformance.mirror_library import Mirror
from pop_ref.conformance.scenes import Scene
from pop_ref.constants import PAPER, Profile
from pop_ref.settings import BETAS, EPS

FOLDER: Path = importlib.import_module("cuda_ext.host.library_folder").library_folder()
_IDENTITY = np.eye(4)


def _rowwise(name: str, tails: list[tuple[int, ...]]) -> Callable[..., Any]:
    """Make a stage whose arguments are all rows, with outputs of the given shapes a row."""

    def stage(m: Mirror, *arrays: Any) -> Any:
        n = len(arrays[0])
        found = m.call(name, n, list(arrays), [(n, *tail) for tail in tails])
        return found[0] if len(found) == 1 else tuple(found)

    return stage


def _pinhole(name: str, tail: tuple[int, ...]) -> Callable[..., Any]:
    def stage(m: Mirror, rows: Any, K: Any, width: int, height: int, *rest: Any) -> Any:
        cotangent = [a for a in rest if isinstance(a, np.ndarray)]
        profile = next((a for a in rest if isinstance(a, Profile)), PAPER)
        n = len(rows)
        return m.call(name, n, [rows, K, *cotangent], [(n, *tail)], integers=(width, height), profile=profile)[0]

    return stage


def sh_basis(m: Mirror, dirs: Any, degree: int) -> Any:
    n = len(dirs)
    return m.call("sh_basis", n, [dirs], [(n, 16)], integers=(0, 0, degree))[0][:, : (degree + 1) ** 2]


def sh_basis_vjp(m: Mirror, dirs: Any, degree: int, v_basis: Any) -> Any:
    padded = np.zeros((len(dirs), 16))
    padded[:, : v_basis.shape[1]] = v_basis
    return m.call("sh_basis_vjp", len(dirs), [dirs, padded], [(len(dirs), 3)], integers=(0, 0, degree))[0]


def colors_from_sh(m: Mirror, sh: Any, dirs: Any, degree: int) -> Any:
    n, n_sh = sh.shape[:2]
    return m.call("colors_from_sh", n, [sh, dirs], [(n, 3)], integers=(0, 0, degree, n_sh))[0]


def colors_from_sh_vjp(m: Mirror, sh: Any, dirs: Any, degree: int, v_colors: Any) -> Any:
    shapes = [sh.shape, dirs.shape]
    integers = (0, 0, degree, sh.shape[1])
    return tuple(m.call("colors_from_sh_vjp", len(sh), [sh, dirs, v_colors], shapes, integers=integers))


def camera_center(m: Mirror, viewmat: Any) -> Any:
    return m.call("camera_center", 1, [viewmat], [(1, 3)])[0][0]


def camera_center_vjp(m: Mirror, viewmat: Any, v_center: Any) -> Any:
    return m.call("camera_center_vjp", 1, [viewmat, v_center], [(4, 4)])[0]


def view_dirs(m: Mirror, means: Any, viewmat: Any) -> Any:
    return m.call("view_dirs", len(means), [means, viewmat], [(len(means), 3)])[0]


def means_cam_from_means(m: Mirror, means: Any, viewmat: Any) -> Any:
    return m.call("means_cam_from_means", len(means), [means, viewmat], [(len(means), 3)])[0]


def means_cam_from_means_vjp(m: Mirror, means: Any, viewmat: Any, v: Any) -> Any:
    n = len(means)
    v_means, v_viewmats = m.call("means_cam_from_means_vjp", n, [means, viewmat, v], [(n, 3), (n, 4, 4)])
    return v_means, v_viewmats.sum(axis=0)


def covars_cam_from_covars(m: Mirror, covars: Any, viewmat: Any) -> Any:
    return m.call("covars_cam_from_covars", len(covars), [covars, viewmat], [covars.shape])[0]


def covars_cam_from_covars_vjp(m: Mirror, covars: Any, viewmat: Any, v: Any) -> Any:
    n = len(covars)
    v_covars, v_viewmats = m.call("covars_cam_from_covars_vjp", n, [covars, viewmat, v], [covars.shape, (n, 4, 4)])
    return v_covars, v_viewmats.sum(axis=0)


def in_front(m: Mirror, depths: Any, profile: Profile = PAPER) -> Any:
    return m.call("in_front", len(depths), [depths], [], [(len(depths),)], profile=profile)[0].astype(bool)


def low_pass(m: Mirror, covars2d: Any, eps2d: float) -> Any:
    return m.call("low_pass", len(covars2d), [covars2d], [covars2d.shape], numbers=(eps2d,))[0]


def low_pass_vjp(m: Mirror, covars2d: Any, eps2d: float, v_blurred: Any) -> Any:
    # the identity: the kernels leave it out
    return v_blurred.astype(m.dtype).astype(np.float64)


def compensations(m: Mirror, covars2d: Any, eps2d: float) -> Any:
    return m.call("compensations", len(covars2d), [covars2d], [(len(covars2d),)], numbers=(eps2d,))[0]


def compensations_vjp(m: Mirror, covars2d: Any, eps2d: float, v: Any) -> Any:
    return m.call("compensations_vjp", len(covars2d), [covars2d, v], [covars2d.shape], numbers=(eps2d,))[0]


def radii_from_covars2d(m: Mirror, covars2d: Any, opacities: Any, profile: Profile = PAPER) -> Any:
    n = len(covars2d)
    return m.call("radii_from_covars2d", n, [covars2d, opacities], [], [(n, 2)], profile=profile)[0]


def on_screen(m: Mirror, means2d: Any, radii: Any, width: int, height: int, profile: Profile = PAPER) -> Any:
    size = (width, height)
    kept = m.call("on_screen", len(means2d), [means2d], [], [(len(means2d),)], [radii], size, profile=profile)[0]
    return kept.astype(bool)


def tile_rects(
    m: Mirror, means2d: Any, radii: Any, width: int, height: int, tile_size: int, profile: Profile = PAPER
) -> Any:
    n, sizes = len(means2d), (width, height, tile_size)
    return m.call("tile_rects", n, [means2d], [], [(n, 4)], [radii], sizes, profile=profile)[0]


def sigma_at_pixel(m: Mirror, mean2d: Any, conic: Any, px: float, py: float) -> float:
    return float(m.call("sigma_at_pixel", 1, [mean2d, conic], [(1,)], numbers=(px, py))[0][0])


def falloff(m: Mirror, sigma: float) -> float:
    return float(m.call("falloff", 1, [np.array([sigma])], [(1,)])[0][0])


def alpha_from_sigma(m: Mirror, sigma: float, opacity: float, profile: Profile = PAPER) -> tuple[float, bool]:
    rows = [np.array([sigma]), np.array([opacity])]
    alpha, skipped = m.call("alpha_from_sigma", 1, rows, [(1,)], [(1,)], profile=profile)
    return float(alpha[0]), bool(skipped[0])


def dominant_id(m: Mirror, ids: Any, weights: Any) -> int:
    found = m.call("dominant_id", 1, [np.array(weights)], [], [(1,)], [np.array(ids)], (0, 0, len(ids)))
    return int(found[0][0])


def _ssim(m: Mirror, image: Any, target: Any, v: float, padding: str) -> tuple[float, Any]:
    height, width, channels = image.shape
    integers = (width, height, channels, 5 if padding == "valid" else 0)
    value, v_image = m.call("ssim", 1, [image, target], [(1,), image.shape], integers=integers, numbers=(v,))
    return float(value[0]), v_image


def ssim(m: Mirror, image: Any, target: Any, padding: str = "valid") -> float:
    return _ssim(m, image, target, 1.0, padding)[0]


def ssim_vjp(m: Mirror, image: Any, target: Any, v_ssim: float, padding: str = "valid") -> Any:
    return _ssim(m, image, target, v_ssim, padding)[1]


def pop_loss_vjp(m: Mirror, opacities: Any, mask: Any, v_loss: float) -> Any:
    n, n_important = len(mask), int(np.sum(mask))
    return m.call("pop_loss_vjp", n, [], [(n,)], [], [mask], (0, 0, n_important, n), (v_loss,))[0]


def adam_step(
    m: Mirror,
    params: Any,
    grads: Any,
    first: Any,
    second: Any,
    step: int,
    lr: Any,
    betas: tuple[float, float] = BETAS,
) -> Any:
    # eps is that of the fused step
    moved: tuple[dict[str, Any], ...] = (dict(params), dict(first), dict(second))
    for name, g in grads.items():
        numbers = [lr[name], *betas, EPS]
        kept = [float(m.dtype(number)) for number in numbers]
        halves = [half for number, near in zip(numbers, kept, strict=True) for half in (near, number - near)]
        rows = [params[name], first[name], second[name], g]
        found = m.call("adam_step", g.size, rows, [g.shape] * 3, integers=(0, 0, step), numbers=tuple(halves))
        for part, value in zip(moved, found, strict=True):
            part[name] = value
    return moved


def adam_steps(m: Mirror, params: Any, grads: Any, lr: Any) -> Any:
    first, second = ({name: np.zeros_like(array) for name, array in params.items()} for _ in range(2))
    for step, given in enumerate(grads, start=1):
        # a row that nothing reaches takes a step all the same, by a gradient of zero
        whole = {name: given.get(name, np.zeros_like(array)) for name, array in params.items()}
        params, first, second = adam_step(m, params, whole, first, second, step, lr)
    return params, first, second


STAGES: dict[str, Callable[..., Any]] = {
    "scales_from_log_scales": _rowwise("scales_from_log_scales", [(3,)]),
    "scales_from_log_scales_vjp": _rowwise("scales_from_log_scales_vjp", [(3,)]),
    "opacities_from_logits": _rowwise("opacities_from_logits", [()]),
    "opacities_from_logits_vjp": _rowwise("opacities_from_logits_vjp", [()]),
    "unit_quats_from_quats": _rowwise("unit_quats_from_quats", [(4,)]),
    "unit_quats_from_quats_vjp": _rowwise("unit_quats_from_quats_vjp", [(4,)]),
    "rotmats_from_quats": _rowwise("rotmats_from_quats", [(3, 3)]),
    "rotmats_from_quats_vjp": _rowwise("rotmats_from_quats_vjp", [(4,)]),
    "covars_from_quats_scales": _rowwise("covars_from_quats_scales", [(3, 3)]),
    "covars_from_quats_scales_vjp": _rowwise("covars_from_quats_scales_vjp", [(4,), (3,)]),
    "project_covars": _rowwise("project_covars", [(2, 2)]),
    "project_covars_vjp": _rowwise("project_covars_vjp", [(3, 3), (2, 3)]),
    "conics_from_covars2d": _rowwise("conics_from_covars2d", [(3,)]),
    "conics_from_covars2d_vjp": _rowwise("conics_from_covars2d_vjp", [(2, 2)]),
    "project_means": _pinhole("project_means", (2,)),
    "project_means_vjp": _pinhole("project_means_vjp", (3,)),
    "projection_jacobians": _pinhole("projection_jacobians", (2, 3)),
    "projection_jacobians_vjp": _pinhole("projection_jacobians_vjp", (3,)),
}
STAGES |= {
    f.__name__: f
    for f in (
        sh_basis,
        sh_basis_vjp,
        colors_from_sh,
        colors_from_sh_vjp,
        camera_center,
        camera_center_vjp,
        view_dirs,
        means_cam_from_means,
        means_cam_from_means_vjp,
        covars_cam_from_covars,
        covars_cam_from_covars_vjp,
        in_front,
        low_pass,
        low_pass_vjp,
        compensations,
        compensations_vjp,
        radii_from_covars2d,
        on_screen,
        tile_rects,
        sigma_at_pixel,
        falloff,
        alpha_from_sigma,
        dominant_id,
        ssim,
        ssim_vjp,
        pop_loss_vjp,
        adam_step,
        adam_steps,
    )
}


def mirror(name: str) -> MirrorAdapter:
    """Return the mirror in double ("mirror64"), or in float with the kernels' own tiles ("mirror32")."""
    double = name == "mirror64"
    made = MirrorAdapter(FOLDER, np.float64 if double else np.float32, kernel_tiles=not double)
    made.name = name
    return made


# whole trainings by a script: the rows are those of torch's strategies, and the mirror's Adam moves them
TRAININGS: Final = ("scripted_steps", "method_settings", "optimizers")


class MirrorAdapter(Adapter):
    """The kernels' mathematics on the host.

    Args:
        folder: where the mirror is built.
        dtype: numpy.float32 or numpy.float64.
        per_splat: which family goes back: one splat a lane, or a column of pixels a lane.
        kernel_tiles: the kernels' own 16 x 8 tiles with exact lists, where the profile's tiles are an optimisation.
    """

    profile = None
    able = (ANTIALIASING, DETERMINISTIC, DOMINANCE, ROWWISE)

    def __init__(self, folder: Path, dtype: Any, per_splat: bool = False, kernel_tiles: bool = False) -> None:
        family = "splats" if per_splat else "columns"
        self.name = f"mirror{np.dtype(dtype).itemsize * 8}-{family}{'-exact' if kernel_tiles else ''}"
        self.dtype = dtype
        self.mirror = Mirror(folder, dtype)
        self._per_splat, self._kernel_tiles = per_splat, kernel_tiles

    def has(self, need: str) -> bool:
        """Tell what the mirror offers."""
        return super().has(need) or need in STAGES or need in TRAININGS

    def stage(self, name: str) -> Callable[..., Any]:
        """Return a stage function with the oracle's signature; a training is moved by the fused step's Adam."""
        if name in TRAININGS:
            return self._scripted_steps if name == "scripted_steps" else getattr(self._trainer, name)
        if name not in STAGES:
            raise LookupError(f"the mirror has no stage function {name}")
        return partial(STAGES[name], self.mirror)

    @functools.cached_property
    def _trainer(self) -> Any:
        """Make the trainer whose strategies edit the rows that the mirror moves."""
        return importlib.import_module("pop_ref.conformance.torch_training").Trainer("pop_fast", self._adam)

    def _adam(self, params: Any, grads: Any, m: Any, v: Any, step: int, lr: Any, betas: Any) -> Any:
        torch: Any = importlib.import_module("torch")
        arrays = [{key: t.numpy().astype(np.float64) for key, t in of.items()} for of in (params, grads, m, v)]
        moved = adam_step(self.mirror, *arrays, step=step, lr=lr, betas=betas)
        return tuple({key: torch.as_tensor(value) for key, value in of.items()} for of in moved)

    def _scripted_steps(self, script: Any, rows: Any) -> Any:
        torch: Any = importlib.import_module("torch")
        dtype = torch.float64 if self.dtype == np.float64 else torch.float32
        given = (rows.params, rows.m, rows.v)
        of = [{key: torch.as_tensor(value).to(dtype) for key, value in part.items()} for part in given]
        return self._trainer.scripted_steps(script, importlib.import_module(type(self._trainer).__module__).Rows(*of))

    def render(self, scene: Scene) -> View:
        """Draw a scene."""
        H, W, N = scene.camera.height, scene.camera.width, len(scene.gaussians)
        image, T_final, weights, means2d, _, _, _, ids, blended, traversed, counts, radii = self.mirror.call(
            "render",
            N,
            self._inputs(scene),
            [(H, W, 3), (H, W), (H, W), (N, 2), (N,), (N, 3), (N,)],
            [(H, W), (H, W), (H, W), (N,), (N, 2)],
            integers=self._integers(scene),
            profile=self._profile(scene),
        )
        visits = None if self._exact(scene) else traversed
        return View(image, T_final, ids, weights, counts, blended, visits, radii, means2d)

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Return every cotangent of a render."""
        g = scene.gaussians
        names = ("means", "quats", "scales", "opacities", "sh", "viewmat", "background", "means2d", "means2d_abs")
        N = len(g)
        shapes = [(N, 3), (N, 4), (N, 3), (N,), g.sh.shape, (4, 4), (3,), (N, 2), (N, 2)]
        found = self.mirror.call(
            "render_vjp",
            N,
            [*self._inputs(scene), v_image, v_T_final],
            shapes,
            integers=self._integers(scene),
            profile=self._profile(scene),
        )
        return dict(zip(names, found, strict=True))

    def _inputs(self, scene: Scene) -> list[Any]:
        g, c = scene.gaussians, scene.camera
        return [g.means, g.quats, g.scales, g.opacities, g.sh, c.viewmat, c.K, scene.background]

    def _profile(self, scene: Scene) -> Any:
        return replace(scene.profile, tile_size=scene.tile_size or scene.profile.tile_size)

    def _exact(self, scene: Scene) -> bool:
        return self._kernel_tiles and scene.profile.extent == "opacity_aware"

    def _integers(self, scene: Scene) -> tuple[int, ...]:
        n_sh = scene.gaussians.sh.shape[1]
        degree = round(np.sqrt(n_sh)) - 1 if scene.sh_degree is None else scene.sh_degree
        size = scene.tile_size or scene.profile.tile_size
        exact = self._exact(scene)
        tile = (16, 8) if exact else (size, size)
        camera = scene.camera
        return (camera.width, camera.height, n_sh, degree, *tile, scene.antialiased, exact, self._per_splat)
