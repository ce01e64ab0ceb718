"""The viewer's server: viser carries cameras from browsers to us, and our pictures back.

Whoever owns the Gaussians calls `draw_due`, which draws on the calling thread: `pop view` in a loop, a training between
its steps. viser's threads only note what is wanted.
"""

from __future__ import annotations

import asyncio
import importlib
import io
import logging
import sys
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from pop_fast.errors import PopError
from pop_fast.view.html import view_distances
from pop_fast.view.live.draw import Panel, SplatScene, ViewState, field_of_view, pose_of_viewmat, viewmat_of_pose
from pop_fast.view.live.guard import Guard, is_any, listen
from pop_fast.view.paths import mean_up

if TYPE_CHECKING:
    from pop_fast.view.html import PageCamera

Kind = Literal["quick", "sharp"]
# seconds after its last movement at which a camera rests
_REST: Final = 0.25
# seconds that a picture may take while the camera moves
_QUICK: Final = 0.12
_LEAST_SIDE: Final = 96
# of the time at most, so that a training continues under a viewer
_SHARE: Final = 0.2
_LEAST_PAUSE: Final = 2.0


class Pace:
    """The times of one view; the clock is the caller's, seconds."""

    def __init__(self) -> None:
        self._moved_at = -1e9
        self._stale: bool = True  # nothing that was drawn shows the present state
        self._sharp = False
        self._renewed = False  # the Gaussians changed
        self._last: tuple[float, float] = (-1e9, 0.0)  # when the last sharp picture was ready, and what it took
        self._seconds_per_pixel: float | None = None

    def moved(self, now: float) -> None:
        self._moved_at, self._stale = now, True

    def changed(self) -> None:
        """Note that something else is to be shown of the same Gaussians."""
        self._stale, self._moved_at = True, -1e9

    def renewed(self) -> None:
        """Note that the Gaussians have changed, as they do at every step of a training."""
        self._renewed = True

    def due(self, now: float) -> Kind | None:
        """Tell what is to be drawn now, if anything."""
        resting = now - self._moved_at >= _REST
        if self._stale:
            return "sharp" if resting else "quick"
        if resting and not self._sharp:
            return "sharp"
        ready, took = self._last
        if self._renewed and resting and now - ready >= max(_LEAST_PAUSE, took / _SHARE):
            return "sharp"
        return None

    def rests_in(self, now: float) -> float | None:
        """Give the seconds after which a sharp picture will be due; None where none is awaited."""
        return None if self._sharp and not self._stale else max(0.0, _REST - (now - self._moved_at))

    def drawn(self, kind: Kind, pixels: int, seconds: float, now: float) -> None:
        """Note a picture that was drawn of the state that `due` saw."""
        self._seconds_per_pixel = seconds / max(pixels, 1)
        self._sharp = kind == "sharp"
        if self._sharp:
            self._last, self._renewed = (now, seconds), False

    def begin(self) -> None:
        """Note that what is shown now is being drawn: what changes from here on is news."""
        self._stale = False

    def size(self, kind: Kind, width: int, height: int, longest: int) -> tuple[int, int]:
        """Choose a picture's width and height, px, of the window's shape: quick ones are as large as the time allows.

        `longest` is the longer side of a sharp picture, px.
        """
        width, height = max(width, 1), max(height, 1)
        scale = min(1.0, longest / max(width, height))
        if kind == "quick":
            pixels = _QUICK / self._seconds_per_pixel if self._seconds_per_pixel else 240.0 * 240.0
            scale = min(scale, (pixels / (width * height)) ** 0.5)
            scale = max(scale, min(1.0, _LEAST_SIDE / max(width, height)))
        return max(1, round(scale * width)), max(1, round(scale * height))


LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")
_MOST_LINES: Final = 20
_FIX: Final = "pip install 'viser>=1.1,<1.2' (or pop-splatting[viewer])"


@dataclass(frozen=True, eq=False)
class Stand:
    """A place to look from: a training camera, the distance to what it looks at, and its photograph, small."""

    camera: PageCamera
    distance: float
    photo: np.ndarray | None = None


def stands_of(cameras: Sequence[PageCamera], photos: Sequence[np.ndarray | None], means: Any) -> list[Stand]:
    """Make places to look from of cameras and their photographs, uint8 [H, W, 3] or None."""
    distances = view_distances(cameras, means)
    return [Stand(*entry) for entry in zip(cameras, distances, photos, strict=True)]


def require_viser() -> Any:
    """Import viser; a PopError says how to get it where it is absent or broken."""
    try:
        # by name: type checkers run without it
        return importlib.import_module("viser")
    except ImportError as error:
        raise PopError(f"the viewer needs viser, which cannot be imported ({error}); {_FIX}") from error


class LiveViewer:
    """A viewer of one splat, for any number of browsers.

    Args:
        scene: what is shown first.
        stands: where one can look from; the first is where a browser starts.
        title: above the panel and in the names of files.
        host: the address to listen on.
        port: the next free one is taken where it is in use.

    Raises:
        PopError: viser is absent, or the address cannot be listened on.
    """

    def __init__(
        self, scene: SplatScene, stands: Sequence[Stand], title: str, host: str = "127.0.0.1", port: int = 8080
    ) -> None:
        viser = require_viser()
        listening = listen(host, port)
        self._scene, self._stands, self._title = scene, list(stands), title
        self.box = scene.extent()
        self.note = ""
        self._free_at = 0.0
        self._views: dict[int, _View] = {}
        self._lock, self._wake = threading.Lock(), threading.Event()
        # browsers open connections ahead and drop them, which is logged as an error with a traceback
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        # and leave while their panel is made
        warnings.filterwarnings("ignore", message=r"Queued a \w+ on a closed connection")
        self.host, self.port = host, int(listening.getsockname()[1])
        self._lines = 0
        self._guard = Guard(host, listening, self._tell)
        # it prints its own box, whatever `verbose` is
        with self._guard.around_viser(), redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(host=host, port=self.port, label=title, verbose=False)
        self._forget_sharing()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        upwards = mean_up(np.stack([stand.camera.viewmat for stand in self._stands]))
        self._server.scene.set_up_direction(tuple(upwards.tolist()))
        self._server.scene.world_axes.visible = False
        start = self._server.initial_camera
        position, look_at, up, fov = pose_at(self._stands[0])
        start.position, start.look_at, start.up, start.fov = position, look_at, up, fov
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    @property
    def url(self) -> str:
        """The address to open; whoever knows it sees the splat."""
        shown = "127.0.0.1" if is_any(self.host) else self.host
        return f"http://{f'[{shown}]' if ':' in shown else shown}:{self.port}/{self._guard.token}/"

    @property
    def watched(self) -> bool:
        return bool(self._views)

    def show(self, scene: SplatScene, note: str = "") -> None:
        """Show other Gaussians from now on, with a line about them."""
        self._scene, self.note = scene, note
        for view in self._present():
            view.pace.renewed()

    def wait(self, seconds: float = 1.0) -> None:
        """Sleep until something may have to be drawn."""
        now = time.monotonic()
        awaited = [rest for view in self._present() if (rest := view.pace.rests_in(now)) is not None]
        self._wake.wait(min([seconds, *awaited]))
        self._wake.clear()

    def draw_due(self, share: float = 1.0) -> int:
        """Draw what is due, at most one picture a browser, and return how many; an error closes the browser's view.

        Drawing may take a share of the time; until it is so much, nothing is drawn.
        """
        begun = time.monotonic()
        if begun < self._free_at:
            return 0
        drawn = sum(view.draw(self._scene, self.note) for view in self._present())
        self._free_at = time.monotonic() + (time.monotonic() - begun) * (1.0 / share - 1.0)
        return drawn

    def close(self) -> None:
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self) -> LiveViewer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _present(self) -> list[_View]:
        with self._lock:
            return list(self._views.values())

    def _connected(self, client: Any) -> None:
        try:
            view = _View(client, self, self._wake)
        except Exception as error:
            self._fail(client.client_id, error)
            return
        with self._lock:
            self._views[client.client_id] = view
        if client.client_id not in self._server.get_clients():
            # it has left while its panel was made
            self._disconnected(client)
        self._wake.set()

    def _disconnected(self, client: Any) -> None:
        with self._lock:
            view = self._views.pop(client.client_id, None)
        if view is not None:
            view.panel.close()

    def _fail(self, client_id: int, error: Exception) -> None:
        """Close a view that had an error; neither the other views nor whoever owns the Gaussians hear of it."""
        with self._lock:
            known = self._views.pop(client_id, None)
        if known is not None:
            known.panel.close()
        self._tell(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
        connection = self._server._websock_server._live_connections.get(client_id)
        if connection is not None:
            asyncio.run_coroutine_threadsafe(connection.close(1011, "the view had an error"), connection.loop)

    def _tell(self, why: str) -> None:
        """Print why a view was closed, a bounded number of times."""
        self._lines += 1
        if self._lines <= _MOST_LINES:
            last = "; further notes of this kind are not shown" if self._lines == _MOST_LINES else ""
            print(f"note: the viewer closed a view: {why}{last}", file=sys.stderr, flush=True)

    def _forget_sharing(self) -> None:
        """Take away what viser does when a browser asks it to publish the server by a relay on the internet."""
        messages, server = importlib.import_module("viser._messages"), self._server._websock_server
        for kind in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
            server.unregister_handler(kind)


def pose_at(stand: Stand) -> tuple[Any, Any, Any, float]:
    """Return position, look-at point, up direction and vertical angle (radians) of a place to look from."""
    camera = stand.camera
    forward, up = camera.viewmat[2, :3], -camera.viewmat[1, :3]
    return camera.eye, camera.eye + stand.distance * forward, up, field_of_view(camera.K, camera.height)


class _View:
    """One browser."""

    def __init__(self, client: Any, viewer: LiveViewer, wake: threading.Event) -> None:
        self._client, self._stands, self._wake = client, viewer._stands, wake
        self._fail = viewer._fail
        self.pace = Pace()
        self._frustums: list[Any] = []
        names = [stand.camera.name for stand in self._stands]
        transform, rules = viewer._scene.world_transform, viewer._guard.rules
        self.panel = Panel(client, names, viewer._title, viewer.box, transform, rules, self._held)
        self.panel.changed, self.panel.stand, self.panel.frustums = self._changed, self.look_from, self._show_frustums
        client.camera.on_update(self._held(self._moved))

    def look_from(self, index: int) -> None:
        """Move this browser's camera to a place to look from."""
        position, look_at, up, fov = pose_at(self._stands[index])
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction, camera.position, camera.look_at, camera.fov = up, position, look_at, fov
        self._changed()

    def draw(self, scene: SplatScene, note: str) -> int:
        """Draw what is due; returns how many pictures. An error closes the view."""
        try:
            return self._draw(scene, note)
        except Exception as error:
            self._fail(self._client.client_id, error)
            return 0

    def _held(self, call: Callable[[], None]) -> Callable[[Any], None]:
        """Return a call for viser's threads; an error in it closes the view."""

        def held(event: Any) -> None:
            try:
                call()
            except Exception as error:
                self._fail(self._client.client_id, error)

        return held

    def _draw(self, scene: SplatScene, note: str) -> int:
        now, camera = time.monotonic(), self._client.camera
        shot = self.panel.take_screenshot()
        kind = self.pace.due(now)
        if kind is None and not shot:
            return 0
        self.panel.now = self._state(camera, camera.image_width, camera.image_height)
        if shot:
            longest = max(max(stand.camera.width, stand.camera.height) for stand in self._stands)
            scale = longest / max(camera.image_width, camera.image_height, 1)
            size = (round(scale * camera.image_width), round(scale * camera.image_height))
            self.panel.send_screenshot(scene.draw(self._state(camera, *size)).image)
        if kind is None:
            return 0
        width, height = self.pace.size(kind, camera.image_width, camera.image_height, self.panel.longest)
        self.pace.begin()
        drawing = scene.draw(self._state(camera, width, height))
        # JPEG would mix the colours of neighbouring Gaussians
        form = "png" if self.panel.mode == "dominant" else "jpeg"
        self._client.scene.set_background_image(drawing.image, format=form, jpeg_quality=90 if kind == "sharp" else 70)
        self.panel.say(" · ".join(filter(None, [note, drawing.legend, f"{width} x {height}"])))
        self.pace.drawn(kind, width * height, time.monotonic() - now, time.monotonic())
        return 1

    def _state(self, camera: Any, width: int, height: int) -> ViewState:
        viewmat = viewmat_of_pose(camera.wxyz, camera.position)
        panel = self.panel
        return ViewState(
            viewmat, float(camera.fov), max(width, 1), max(height, 1), panel.mode, panel.min_opacity, panel.crop
        )

    def _moved(self) -> None:
        self.pace.moved(time.monotonic())
        self._wake.set()

    def _changed(self) -> None:
        self.pace.changed()
        self._wake.set()

    def _show_frustums(self, shown: bool) -> None:
        if shown and not self._frustums:
            self._frustums = [self._frustum(i, stand) for i, stand in enumerate(self._stands)]
        for frustum in self._frustums:
            frustum.visible = shown

    def _frustum(self, index: int, stand: Stand) -> Any:
        camera = stand.camera
        wxyz, position = pose_of_viewmat(camera.viewmat)
        added = self._client.scene.add_camera_frustum(
            f"/cameras/{index}",
            fov=field_of_view(camera.K, camera.height),
            aspect=camera.width / camera.height,
            scale=0.06 * stand.distance,
            thickness=0.001 * stand.distance,
            color=(255, 190, 70),
            image=stand.photo,
            format="jpeg",
            wxyz=tuple(wxyz.tolist()),
            position=tuple(position.tolist()),
        )
        added.on_click(self._held(lambda: self.look_from(index)))
        return added
