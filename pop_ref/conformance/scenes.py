"""Scenes as a person would write them down, as the rasterizer takes them, and as npz files.

A `Record` places one Gaussian on the screen: pixel, depth, size in pixels. Lists of records are what Hypothesis draws
and shrinks; `pack` turns them into `Gaussians` in the world of a camera. Every value here prints as code that makes it.
A file holds arrays by name, and everything else as one JSON string.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.constants import PAPER, PROFILES, Profile
from pop_ref.records import Camera, Gaussians

SH_C0 = 0.28209479177387814


@dataclass(frozen=True)
class Record:
    """One Gaussian, placed by what it looks like.

    Attributes:
        x, y: screen centre, px from the top left corner, pixel centres at +0.5.
        depth: camera z, world units.
        size: standard deviations along the Gaussian's own axes, px at that depth.
        quat: rotation wxyz, any norm > 0.
        opacity: in [0, 1].
        sh: coefficients by band, rows of rgb; the first row is the colour at degree 0 less one half, over C0.
    """

    x: float = 2.0
    y: float = 2.0
    depth: float = 1.0
    size: tuple[float, float, float] = (1.0, 1.0, 1.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    opacity: float = 0.5
    sh: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0),)


@dataclass(frozen=True, repr=False)
class Scene:
    """Everything that decides a render.

    Attributes:
        gaussians, camera: what is seen and from where.
        background: colour behind everything, rgb.
        profile: the constants.
        tile_size: px; None takes the profile's.
        sh_degree: bands used; None takes all that are there.
        antialiased: scale opacities by the low-pass compensation.
    """

    gaussians: Gaussians
    camera: Camera
    background: Any = field(default_factory=lambda: np.zeros(3))
    profile: Profile = PAPER
    tile_size: int | None = None
    sh_degree: int | None = None
    antialiased: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "background", np.asarray(self.background, dtype=np.float64))

    def __repr__(self) -> str:
        shown = [f"gaussians={self.gaussians!r}", f"camera={self.camera!r}"]
        for each in fields(self)[2:]:
            value = getattr(self, each.name)
            if each.name == "background" and not np.any(value):
                continue
            if each.name not in ("background", "profile") and value == each.default:
                continue
            shown.append(f"{each.name}={_code(value)}")
        return f"Scene({', '.join(shown)})"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        # Hypothesis prints dataclasses by field unless asked otherwise; a scene must paste
        printer.text(repr(self))

    @property
    def side(self) -> int:
        """Return the side of a tile, px."""
        return self.profile.tile_size if self.tile_size is None else self.tile_size

    @property
    def degree(self) -> int:
        """Return the degree of the harmonics that are used."""
        return round(np.sqrt(self.gaussians.sh.shape[1])) - 1 if self.sh_degree is None else self.sh_degree

    @property
    def options(self) -> dict[str, Any]:
        """Return, by the names of `pop_ref.render.render`, what is neither Gaussians nor camera."""
        return {f.name: getattr(self, f.name) for f in fields(self)[2:]}

    def with_overrides(self, **changes: Any) -> Scene:
        """Return this scene with some fields, of the Gaussians or the camera too, replaced."""
        gaussians = {k: changes.pop(k) for k in list(changes) if k in ("means", "quats", "scales", "opacities", "sh")}
        camera = {k: changes.pop(k) for k in list(changes) if k in ("viewmat", "K", "width", "height")}
        if gaussians:
            changes["gaussians"] = replace(self.gaussians, **gaussians)
        if camera:
            changes["camera"] = replace(self.camera, **camera)
        return replace(self, **changes)

    def rows(self, index: Any) -> Scene:
        """Return this scene with the Gaussians picked by an index array or a mask, in that order."""
        g = self.gaussians
        index = np.asarray(index)
        picked = index if index.dtype == bool else index.astype(np.int64)
        return replace(
            self,
            gaussians=Gaussians(g.means[picked], g.quats[picked], g.scales[picked], g.opacities[picked], g.sh[picked]),
        )


def _code(value: Any) -> str:
    if isinstance(value, Profile):
        if PROFILES.get(value.name) == value:
            return f"PROFILES[{value.name!r}]"
        return repr(value)
    return repr(value.tolist() if isinstance(value, np.ndarray) else value)


def scene_as_code(scene: Scene) -> str:
    """Return a script that makes the scene again when pasted."""
    return (
        "from pop_ref.conformance.scenes import Scene\n"
        "from pop_ref.constants import PROFILES, Profile\n"
        "from pop_ref.records import Camera, Gaussians\n\n"
        f"scene = {scene!r}\n"
    )


def pack(records: list[Record], camera: Camera) -> Gaussians:
    """Return the records as Gaussians in the world of a camera, padded with zero bands to one number of coefficients.

    The x extent in px is measured with fx, so a Gaussian that is round in px is round in space when fx = fy.
    """
    if not records:
        return Gaussians([], [], [], [], np.zeros((0, 1, 3)))  # type: ignore[arg-type]
    K, R, t = camera.K, camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    n_sh = max(len(r.sh) for r in records)
    means, scales, sh = [], [], np.zeros((len(records), n_sh, 3))
    for i, r in enumerate(records):
        p = np.array([(r.x - K[0, 2]) / K[0, 0], (r.y - K[1, 2]) / K[1, 1], 1.0]) * r.depth
        means.append(R.T @ (p - t))
        scales.append(np.abs(np.array(r.size) * r.depth / K[0, 0]))
        sh[i, : len(r.sh)] = r.sh
    quats, opacities = np.array([r.quat for r in records]), np.array([r.opacity for r in records])
    return Gaussians(np.array(means), quats, np.array(scales), opacities, sh)


def rigid(quat: tuple[float, ...], shift: tuple[float, ...]) -> np.ndarray:
    """Return the world -> camera matrix of a turn and a shift."""
    # written out here: the kit must not draw its inputs through the functions that it judges
    w, x, y, z = np.array(quat) / np.sqrt(sum(c * c for c in quat))
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = shift
    return viewmat


def in_precision(array: Any, dtype: Any = np.float32) -> np.ndarray:
    """Return an array of float64 whose numbers are those of a dtype."""
    return np.asarray(array, dtype=dtype).astype(np.float64)


def rounded(inputs: tuple[Any, ...], dtype: Any) -> tuple[Any, ...]:
    """Return arguments with float arrays rounded to a dtype."""
    return tuple(in_precision(a, dtype) if isinstance(a, np.ndarray) and a.dtype.kind == "f" else a for a in inputs)


def rounded_to(scene: Scene, dtype: Any) -> Scene:
    """Return the scene with every array rounded to a dtype, so that oracle and accused read the same numbers."""
    g, c = scene.gaussians, scene.camera

    def near(array: np.ndarray) -> np.ndarray:
        return in_precision(array, dtype)

    return replace(
        scene,
        gaussians=Gaussians(near(g.means), near(g.quats), near(g.scales), near(g.opacities), near(g.sh)),
        camera=Camera(near(c.viewmat), near(c.K), c.width, c.height),
        background=near(scene.background),
    )


def cotangents(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return v_image and v_T_final for a scene: dyadic, of either sign, nowhere zero, and the same on every run."""
    H, W = scene.camera.height, scene.camera.width
    k = np.arange(H * W * 3, dtype=np.float64).reshape(H, W, 3)
    v_image = (np.mod(k * 5.0 + 3.0, 16.0) - 7.5) / 8.0
    v_T_final = (np.mod(np.arange(H * W, dtype=np.float64).reshape(H, W) * 3.0, 8.0) - 3.5) / 8.0
    return v_image, v_T_final


def pattern(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return a picture of dyadic numbers in [0, 1], another for each seed."""
    k = np.arange(int(np.prod(shape)), dtype=np.float64).reshape(shape)
    return np.mod(k * (2.0 * seed + 1.0) + np.floor(k / 7.0) * seed, 17.0) / 16.0


def golden_scene() -> Scene:
    """Return a 16 x 16 scene that every backend draws, fixed for good.

    Its Gaussians are plain, opaque, needles, faint, hidden, coincident, off-screen and culled.
    """
    K = np.array([[16.0, 0.0, 7.5], [0.0, 15.0, 8.25], [0.0, 0.0, 1.0]])
    viewmat = np.array([[0.8, 0.0, -0.6, 0.25], [0.0, 1.0, 0.0, -0.5], [0.6, 0.0, 0.8, 1.0], [0.0, 0.0, 0.0, 1.0]])
    camera = Camera(viewmat, K, 16, 16)
    bands = ((0.5, -0.25, 0.75), (0.25, 0.0, -0.5), (0.0, 0.5, 0.25), (-0.25, 0.25, 0.0))
    records = [
        Record(8.0, 8.0, 2.0, (2.0, 2.0, 2.0), opacity=0.75, sh=((1.0, 0.5, -0.25),)),
        Record(4.25, 5.5, 1.5, (3.0, 1.0, 0.5), (1.0, 0.25, -0.5, 0.125), 1.0, bands),
        Record(12.0, 3.0, 4.0, (16.0, 0.125, 0.125), (1.0, 0.0, 0.0, 0.5), 0.9375, ((-0.5, 1.5, 0.25),)),
        Record(10.0, 12.5, 3.0, (1.5, 1.5, 1.5), opacity=0.015625, sh=((2.0, 2.0, 2.0),)),
        Record(10.0, 12.5, 3.0, (1.5, 1.5, 1.5), opacity=0.5, sh=((-4.0, 1.0, 0.0),)),
        Record(4.25, 5.5, 1.5, (3.0, 1.0, 0.5), (1.0, 0.25, -0.5, 0.125), 1.0, bands),
        Record(6.0, 11.0, 8.0, (64.0, 64.0, 64.0), opacity=0.3125, sh=((0.25, 0.25, 1.0),)),
        Record(-40.0, 8.0, 2.0, (1.0, 1.0, 1.0), opacity=0.5),
        Record(8.0, 8.0, -2.0, (1.0, 1.0, 1.0), opacity=0.5),
        Record(13.0, 13.0, 1.0, (1.0, 1.0, 1.0), opacity=0.001953125),
    ]
    return Scene(pack(records, camera), camera, np.array([0.125, 0.25, 0.5]))


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
