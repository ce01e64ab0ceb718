"""What one browser shows: a camera, a size, a mode and what is left out, and the picture of these.

The splat is at rest, or of a training between its steps. A recorded path of cameras is a JSON file, which
`pop render --path FILE` takes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from pop_fast.density.shrink import inside, opaque_enough
from pop_fast.errors import PopError
from pop_fast.io.pictures import colormap_table, depth_picture, depth_range, id_colors, to_uint8
from pop_fast.io.read_back import read_json
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import Layers, ViewTensors, render_layers
from pop_fast.view.paths import interpolate

if TYPE_CHECKING:
    from pop_fast.train.training_run import TrainingRun
    from pop_fast.view.live.server import LiveViewer


# what covers a pixel by less has no depth
_SEEN = 0.1


@dataclass(frozen=True, eq=False)
class Drawing:
    """A picture, uint8 [H, W, 3], and a line that says how to read it."""

    image: np.ndarray
    legend: str


class SplatScene:
    """Gaussians that are drawn again and again: raw parameters, which are not changed, by a config and a backend.

    `world_transform` is the similarity, world = world_transform @ the capture's own frame. [4, 4]
    """

    def __init__(
        self,
        params: Mapping[str, Tensor],
        config: TrainConfig,
        sh_degree: int,
        backend: Any,
        world_transform: np.ndarray | None = None,
    ) -> None:
        self.params = {name: tensor.detach() for name, tensor in params.items()}
        self.config, self.sh_degree, self._backend = config, sh_degree, backend
        self.world_transform = np.eye(4) if world_transform is None else world_transform
        self._unit = float(np.cbrt(np.linalg.det(self.world_transform[:3, :3])))
        self._chosen: tuple[tuple[float, Box | None], Tensor | None, dict[str, Tensor]] | None = None

    def draw(self, state: ViewState) -> Drawing:
        rows, params = self._selection(state.min_opacity, state.crop)
        n, whole = len(params["means"]), len(self.params["means"])
        shown = f"{n:,} Gaussians" if n == whole else f"{n:,} of {whole:,} Gaussians"
        if n == 0:
            background = np.round(np.clip(self.config.background, 0.0, 1.0) * np.float64(255.0)).astype(np.uint8)
            return Drawing(np.tile(background, (state.height, state.width, 1)), shown)
        ids = state.mode == "dominant"
        layers = render_layers(self._backend, params, state.camera(), self.config, self.sh_degree, dominance=ids)
        image, legend = self._coloured(state, layers, rows)
        return Drawing(image, f"{shown}{legend}")

    def extent(self) -> Box:
        """Give a box of the capture's own frame that holds nearly all Gaussians, without far outliers."""
        means = self._own_means().numpy()
        if not len(means):
            return (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
        low, high = np.quantile(means, [0.01, 0.99], axis=0)
        margin = 0.25 * (high - low) + 1e-6
        return (*(low - margin).tolist(), *(high + margin).tolist())

    def _coloured(self, state: ViewState, layers: Layers, rows: Tensor | None) -> tuple[np.ndarray, str]:
        if state.mode == "dominant":
            assert layers.dominant_ids is not None
            found = layers.dominant_ids
            # a Gaussian keeps its colour whatever else is left out
            whole = found if rows is None else np.append(rows.cpu().numpy(), -1)[found]
            return id_colors(whole), f"; {len(np.unique(whole[whole >= 0])):,} own a pixel, one colour each"
        if state.mode == "opacity":
            return colormap_table("viridis")[
                to_uint8(layers.alpha)
            ], f"; {layers.alpha.mean():.1%} opaque on average, yellow is all"
        if state.mode == "depth":
            depth = np.where(layers.alpha >= _SEEN, layers.depth / self._unit, np.nan)
            near, far = depth_range([depth])
            return depth_picture(depth, near, far), f"; depth {near:.3g} (yellow) to {far:.3g} units of the capture"
        return to_uint8(layers.image), ""

    def _selection(self, min_opacity: float, crop: Box | None) -> tuple[Tensor | None, dict[str, Tensor]]:
        """Return which rows are drawn, None for all, and their parameters."""
        if min_opacity <= 0.0 and crop is None:
            return None, self.params
        key = (min_opacity, crop)
        if self._chosen is None or self._chosen[0] != key:
            kept = opaque_enough(self.params, min_opacity)
            if crop is not None:
                kept = kept & inside(self._own_means(), crop).to(kept.device)
            rows = kept.nonzero().squeeze(1)
            self._chosen = (key, rows, {name: tensor[rows] for name, tensor in self.params.items()})
        return self._chosen[1], self._chosen[2]

    def _own_means(self) -> Tensor:
        back = torch.from_numpy(np.linalg.inv(self.world_transform))
        return self.params["means"].cpu().double() @ back[:3, :3].T + back[:3, 3]


# of the time at most, however many browsers there are and whatever they ask
_SHARE: Final = 0.5


def scene_of(run: TrainingRun, world_transform: np.ndarray) -> SplatScene:
    """Return the Gaussians of a run as they are now; a later step changes what this draws."""
    degree = run.sh_degree(max(run.step - 1, 0))
    return SplatScene(run.params, run.config, degree, run.backend, world_transform)


def follow(viewer: LiveViewer, run: TrainingRun, world_transform: np.ndarray) -> None:
    """Draw what is due of a run, on its own thread; call it between steps."""
    # without a browser it costs nothing
    if not viewer.watched:
        return
    note = f"step {run.step:,} of {run.config.max_steps:,}"
    viewer.show(scene_of(run, world_transform), note)
    viewer.draw_due(_SHARE)


Mode = Literal["colour", "dominant", "opacity", "depth"]
MODES: Final[tuple[Mode, ...]] = get_args(Mode)
# xmin, ymin, zmin, xmax, ymax, zmax
Box = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class ViewState:
    """A view that can be drawn."""

    viewmat: np.ndarray  # world -> camera, OpenCV. [4, 4]
    fov_y: float  # angle from the upper to the lower edge, radians
    width: int
    height: int
    # what is drawn: the render, dominant Gaussians, how opaque pixels are, or their depth
    mode: Mode = "colour"
    min_opacity: float = 0.0  # Gaussians of less are left out
    crop: Box | None = None  # those with centres outside are left out; in the capture's own frame

    @property
    def K(self) -> np.ndarray:
        """Intrinsics, px, with square pixels and the axis in the middle. [3, 3]"""
        focal = self.height / (2.0 * np.tan(self.fov_y / 2.0))
        return np.array([[focal, 0.0, self.width / 2.0], [0.0, focal, self.height / 2.0], [0.0, 0.0, 1.0]])

    def camera(self) -> ViewTensors:
        """Return the camera as renderers take it."""
        blank = torch.zeros((self.height, self.width, 3), dtype=torch.uint8)
        viewmat = torch.from_numpy(np.asarray(self.viewmat, np.float64)).float()[None]
        return ViewTensors("view", blank, None, viewmat, torch.from_numpy(self.K).float()[None])


def field_of_view(K: np.ndarray, height: int) -> float:
    """Return the angle from the upper to the lower edge of a photograph, radians."""
    return float(2.0 * np.arctan2(height / 2.0, K[1, 1]))


def viewmat_of_pose(wxyz: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return world -> camera of a camera's rotation (camera -> world, unit quaternion) and place. [4, 4]"""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ np.asarray(position, np.float64)
    return viewmat


def pose_of_viewmat(viewmat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a camera's rotation, camera -> world as a unit quaternion wxyz, and its place. [4], [3]"""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(viewmat[:3, :3].T).as_quat()
    return np.array([w, x, y, z]), -viewmat[:3, :3].T @ viewmat[:3, 3]


_KIND: Final = "pop camera path"
_FIX: Final = "record it again in 'pop view'"


@dataclass(frozen=True, eq=False)
class KeyCamera:
    """A camera to pass: world -> camera [4, 4], and the angle from the upper to the lower edge, radians."""

    viewmat: np.ndarray
    fov_y: float


@dataclass(frozen=True, eq=False)
class RecordedPath:
    """Cameras to pass in order, in the capture's own frame."""

    cameras: tuple[KeyCamera, ...]

    def text(self) -> str:
        entries = [{"viewmat": c.viewmat.tolist(), "fov_y_degrees": float(np.degrees(c.fov_y))} for c in self.cameras]
        return json.dumps({"kind": _KIND, "frame": "capture", "cameras": entries}, indent=2) + "\n"

    def along(self, n_frames: int, world_transform: np.ndarray) -> list[KeyCamera]:
        """Glide through the cameras: cubic splines through places, rotations and the logarithm of the focal length.

        The first and the last are the recorded ones, in the world; a single camera stays.
        """
        viewmats = np.stack([from_capture(c.viewmat, world_transform) for c in self.cameras])
        if len(viewmats) == 1:
            return [KeyCamera(viewmats[0], self.cameras[0].fov_y)] * n_frames
        at = np.linspace(0.0, len(viewmats) - 1.0, n_frames)
        zooms = np.interp(at, np.arange(len(viewmats)), [np.log(np.tan(c.fov_y / 2.0)) for c in self.cameras])
        path = interpolate(viewmats, n_frames)
        return [KeyCamera(v, float(2.0 * np.arctan(np.exp(zoom)))) for v, zoom in zip(path, zooms, strict=True)]


def to_capture(viewmat: np.ndarray, world_transform: np.ndarray) -> np.ndarray:
    """Express a camera of the world in the capture's own frame; it stays rigid. [4, 4]"""
    moved = viewmat @ world_transform
    moved[:3] /= np.cbrt(np.linalg.det(world_transform[:3, :3]))
    return moved


def from_capture(viewmat: np.ndarray, world_transform: np.ndarray) -> np.ndarray:
    """Express a camera of the capture's own frame in the world; it stays rigid. [4, 4]"""
    return to_capture(viewmat, np.linalg.inv(world_transform))


def read_path(path: Path) -> RecordedPath:
    """Read a recorded path; a PopError names the entry that is none of one."""
    content = read_json(path, _FIX)
    if content.get("kind") != _KIND or content.get("frame") != "capture":
        raise PopError(f"{path}: is not a camera path of 'pop view' (kind {content.get('kind')!r}); {_FIX}")
    entries = content.get("cameras")
    if not isinstance(entries, list) or not entries:
        raise PopError(f"{path}: has no cameras; {_FIX}")
    return RecordedPath(tuple(_camera(entry, f"{path}: cameras[{i}]") for i, entry in enumerate(entries)))


def _camera(entry: Any, where: str) -> KeyCamera:
    try:
        viewmat, degrees = np.array(entry["viewmat"], np.float64), float(entry["fov_y_degrees"])
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise PopError(f"{where}: needs viewmat and fov_y_degrees ({error}); {_FIX}") from error
    if viewmat.shape != (4, 4) or not np.allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-4):
        raise PopError(f"{where}: viewmat is no rigid 4 x 4 matrix; {_FIX}")
    if not np.isfinite(viewmat).all() or not np.array_equal(viewmat[3], [0.0, 0.0, 0.0, 1.0]):
        raise PopError(f"{where}: viewmat is no rigid 4 x 4 matrix; {_FIX}")
    if np.linalg.det(viewmat[:3, :3]) < 0.0:
        raise PopError(f"{where}: viewmat is mirrored, which no camera is; {_FIX}")
    if not 0.0 < degrees < 180.0:
        raise PopError(f"{where}: fov_y_degrees is {degrees:g}; it must be in (0, 180); {_FIX}")
    return KeyCamera(viewmat, float(np.radians(degrees)))


def path_of(cameras: Sequence[KeyCamera], world_transform: np.ndarray) -> RecordedPath:
    """Make a path of cameras of the world."""
    return RecordedPath(tuple(KeyCamera(to_capture(c.viewmat, world_transform), c.fov_y) for c in cameras))
