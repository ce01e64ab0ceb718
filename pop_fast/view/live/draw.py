"""What one browser shows: a camera, a size, a mode and what is left out, their picture, and the panel next to it.

The splat is at rest, or of a training between its steps. A recorded path of cameras is a JSON file, which
`pop render --path FILE` takes.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import cv2
import numpy as np
import torch
from torch import Tensor

from pop_fast.data.cameras import affine
from pop_fast.density.shrink import inside, opaque_enough
from pop_fast.errors import PopError
from pop_fast.io.images import colormap_table, depth_picture, depth_range, id_colors, to_uint8
from pop_fast.io.read_back import read_json
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import Layers, ViewTensors, render_layers
from pop_fast.view.live.guard import Rule, flag, interval, number, one_of
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
            image = colormap_table("viridis")[to_uint8(layers.alpha)]
            return image, f"; {layers.alpha.mean():.1%} opaque on average, yellow is all"
        if state.mode == "depth":
            depth = np.where(layers.alpha >= _SEEN, layers.depth / self._unit, np.nan)
            near, far = depth_range([depth])
            if not np.isfinite(depth).any():
                return depth_picture(depth, near, far), "; nothing here is opaque enough to have a depth"
            ends = f"{near:.3g} (yellow) to {far:.3g} (violet) units of the capture"
            return depth_picture(depth, near, far), f"; depth {ends}, logarithmic, grey where nothing is"
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
    return affine(rotation.T, -rotation.T @ np.asarray(position, np.float64))


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
        """Glide through the cameras: cubic splines through places and rotations, the focal length in even ratios.

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
    whole = viewmat.shape == (4, 4) and np.isfinite(viewmat).all() and np.array_equal(viewmat[3], [0.0, 0.0, 0.0, 1.0])
    if not whole or not np.allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-4):
        raise PopError(f"{where}: viewmat is not a rigid 4 x 4 matrix; {_FIX}")
    if np.linalg.det(viewmat[:3, :3]) < 0.0:
        raise PopError(f"{where}: viewmat is mirrored, which no camera is; {_FIX}")
    if not 0.0 < degrees < 180.0:
        raise PopError(f"{where}: fov_y_degrees is {degrees:g}; it must be in (0, 180); {_FIX}")
    return KeyCamera(viewmat, float(np.radians(degrees)))


def path_of(cameras: Sequence[KeyCamera], world_transform: np.ndarray) -> RecordedPath:
    """Make a path of cameras of the world."""
    return RecordedPath(tuple(KeyCamera(to_capture(c.viewmat, world_transform), c.fov_y) for c in cameras))


_LONGEST: Final = (480, 720, 960, 1280, 1920)
_AXES: Final = ("x", "y", "z")
# files that a browser is given in so many seconds at most: those that it does not take wait in memory
_FILES, _FILES_IN = 8, 10.0
_LONGEST_PATH: Final = 500


class Panel:
    """Controls next to the picture.

    Args:
        client: viser's handle of the browser.
        names: of the places to look from.
        title: in the names of files.
        box: what holds nearly all Gaussians, in the capture's own frame.
        world_transform: world = world_transform @ the capture's own frame. [4, 4]
        rules: is given what each control may be set to; see `pop_fast.view.live.guard`.
        held: wraps what is called when a control is used, and deals with its errors.
    """

    def __init__(
        self,
        client: Any,
        names: Sequence[str],
        title: str,
        box: Box,
        world_transform: np.ndarray,
        rules: MutableMapping[str, Rule],
        held: Callable[[Callable[[], None]], Callable[[Any], None]],
    ) -> None:
        self._rules, self._held, self._controls = rules, held, list[str]()
        self._sent: deque[float] = deque(maxlen=_FILES)
        self._client, self._title, self._names = client, title, list(names)
        self._world_transform = world_transform
        # called when something else is to be shown, with a place to look from, and to show training cameras or not
        self.changed: Callable[[], None] = lambda: None
        self.stand: Callable[[int], None] = lambda index: None
        self.frustums: Callable[[bool], None] = lambda shown: None
        self._wanted = False
        self._taken = 0
        self._path: list[KeyCamera] = []
        # what is shown at present, for the path; None before the first picture
        self.now: ViewState | None = None
        gui = client.gui
        self._status = gui.add_markdown("drawing ...")
        self._mode = gui.add_dropdown("show", MODES, initial_value=MODES[0])
        self._opacity = gui.add_slider("opacity at least", 0.0, 1.0, 0.005, 0.0)
        self._side = gui.add_dropdown("longest side, px", tuple(map(str, _LONGEST)), initial_value="960")
        self._add_crop(gui, box)
        self._add_cameras(gui)
        self._add_files(gui)
        self._use(self._mode, one_of(MODES), self._update)
        self._use(self._opacity, number, self._update)
        self._use(self._side, one_of(tuple(map(str, _LONGEST))), self._update)
        self._use(self._cropped, flag, self._update)
        for control in self._ranges:
            self._use(control, interval(control.min, control.max), self._update)

    def close(self) -> None:
        """Forget the controls, which can no longer be set."""
        for name in self._controls:
            self._rules.pop(name, None)

    @property
    def mode(self) -> Mode:
        return self._mode.value

    @property
    def min_opacity(self) -> float:
        """Gaussians of less are left out; in [0, 1], whatever is being typed."""
        return min(max(float(self._opacity.value), 0.0), 1.0)

    @property
    def longest(self) -> int:
        """The longer side of a sharp picture, px."""
        return int(self._side.value)

    @property
    def crop(self) -> Box | None:
        """The box outside of which Gaussians are left out, in the capture's own frame."""
        if not self._cropped.value:
            return None
        (x0, x1), (y0, y1), (z0, z1) = (tuple(map(float, control.value)) for control in self._ranges)
        return (x0, y0, z0, x1, y1, z1)

    def say(self, text: str) -> None:
        self._status.content = text

    def take_screenshot(self) -> bool:
        wanted, self._wanted = self._wanted, False
        return wanted

    def send_screenshot(self, image: np.ndarray) -> None:
        """Hand a picture to the browser as a PNG. uint8 [H, W, 3]"""
        done, data = cv2.imencode(".png", np.ascontiguousarray(image[:, :, ::-1]))
        assert done
        self._taken += 1
        self._send(f"{self._title}_{self._taken:03d}.png", data.tobytes())

    def record(self) -> None:
        if self.now is not None and len(self._path) < _LONGEST_PATH:
            self._path.append(KeyCamera(self.now.viewmat, self.now.fov_y))
        self._count()

    def save_path(self) -> None:
        if self._path:
            self._send(f"{self._title}_path.json", path_of(self._path, self._world_transform).text().encode())

    def _use(self, control: Any, rule: Rule, call: Callable[[], None]) -> None:
        """Call this when a control was set to a value that the rule allows."""
        name = control._impl.uuid  # viser tells it nowhere else
        self._controls.append(name)
        self._rules[name] = rule
        (control.on_click if hasattr(control, "on_click") else control.on_update)(self._held(call))

    def _send(self, name: str, data: bytes) -> None:
        now = time.monotonic()
        if len(self._sent) == _FILES and now - self._sent[0] < _FILES_IN:
            return
        self._sent.append(now)
        self._client.send_file_download(name, data, save_immediately=True)

    def _add_crop(self, gui: Any, box: Box) -> None:
        with gui.add_folder("Crop", expand_by_default=False):
            self._cropped = gui.add_checkbox("leave out what is outside", False)
            self._ranges = []
            for k, axis in enumerate(_AXES):
                # a round step of the box's own size: captures are of any unit, and far from their origin
                step = float(f"{(box[k + 3] - box[k]) / 200.0:.1g}") or 1e-4
                low, high = (round(value / step) * step for value in (box[k], box[k + 3]))
                self._ranges.append(gui.add_multi_slider(axis, low, high, step, (low, high)))
            self._crop_words = gui.add_markdown("")

    def _add_cameras(self, gui: Any) -> None:
        with gui.add_folder("Training cameras"):
            choice = gui.add_dropdown("look from", tuple(self._names), initial_value=self._names[0])
            step = gui.add_button_group("", ("previous", "next"))
            shown = gui.add_checkbox("show cameras and photographs", False)
        self._use(choice, one_of(self._names), lambda: self.stand(self._names.index(choice.value)))

        def move() -> None:
            by = 1 if step.value == "next" else -1
            # which looks from there
            choice.value = self._names[(self._names.index(choice.value) + by) % len(self._names)]

        self._use(step, one_of(("previous", "next")), move)
        self._use(shown, flag, lambda: self.frustums(shown.value))

    def _add_files(self, gui: Any) -> None:
        self._use(gui.add_button("Screenshot"), flag, self._ask)
        with gui.add_folder("Path"):
            self._use(gui.add_button("Add this camera"), flag, self.record)
            self._use(gui.add_button("Remove the last"), flag, self._forget)
            self._use(gui.add_button("Save"), flag, self.save_path)
            self._path_words = gui.add_markdown("")
        self._count()

    def _ask(self) -> None:
        self._wanted = True
        self.changed()

    def _forget(self) -> None:
        del self._path[-1:]
        self._count()

    def _count(self) -> None:
        n = len(self._path)
        self._path_words.content = f"{n} camera{'' if n == 1 else 's'}; film it with `pop render RESULT --path FILE`"

    def _update(self) -> None:
        crop = self.crop
        words = "" if crop is None else f"`--crop {' '.join(f'{value:.12g}' for value in crop)}`"
        self._crop_words.content = words and f"the same in a file: {words} of `pop export`"
        self.changed()
