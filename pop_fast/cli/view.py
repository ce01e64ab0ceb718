"""`pop view` and `pop train --view`: a splat in the browser, drawn by the package's own renderers."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import tyro

from pop_fast.cli import parse
from pop_fast.cli.options import CaptureArguments, open_with_bars
from pop_fast.errors import PopError
from pop_fast.train.load_result import Splat, drawn_in_frame, frame_of_splat, load_splat

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train.training_run import TrainingRun
    from pop_fast.view.live.server import LiveViewer

_EXAMPLES: Final = """
    pop view out/scene_pop                        open the address that it prints
    pop view a.ply --capture scene                a file, with the cameras of a capture
    pop view out/scene_pop --port 9000 --host 0.0.0.0   for other machines too
"""
_PHOTO_SIDE: Final = 160


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Show a splat in the browser, until Ctrl-C: turn it, look from the training cameras, take pictures, record a path.

    It is drawn here, by the same renderer that trained it, and sent to the browser as pictures. Needs viser.
    """

    splat: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|CKPT|PLY")]
    """What to show."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 shows it, unencrypted, to other machines that know the whole address too."""
    port: int = 8080
    """The port; if it is taken, the next free one."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "view", examples=_EXAMPLES)
    from pop_fast.train.environment import reproducible

    check_address(args.host, args.port)
    splat = load_splat(args.splat)
    with reproducible(splat.config.threads), make_viewer(args, splat) as viewer:
        announce(viewer)
        print("Ctrl-C ends it", flush=True)
        try:
            while True:
                viewer.wait()
                viewer.draw_due()
        except KeyboardInterrupt as stop:
            # SIGTERM and SIGHUP raise a kind of it, whose status is theirs
            if type(stop) is not KeyboardInterrupt:
                raise
            return 0


def make_viewer(args: Args, splat: Splat) -> LiveViewer:
    """Start the viewer of a splat: with the cameras of its capture, or where none is known with one made up."""
    from pop_fast.cli.export import known_transform
    from pop_fast.train.engines import renderer
    from pop_fast.view.html import camera_of_points
    from pop_fast.view.live import SplatScene
    from pop_fast.view.live.server import LiveViewer, stands_of

    data = args.capture or splat.config.data
    backend, note = renderer(splat.config.backend)
    if note:
        print(f"note: {note}")
    if args.capture is None and (not data or not Path(data).is_dir()):
        print("note: no capture is known, so there are no training cameras; give --capture DIR")
        transform = known_transform(splat, args) if frame_of_splat(splat, args) == "training" else None
        config = drawn_in_frame(splat, args)
        scene = SplatScene(splat.params, config, splat.sh_degree, backend, transform)
        stands = stands_of([camera_of_points(splat.params["means"])], [None], splat.params["means"])
    else:
        capture, config = open_with_bars(splat, args)
        scene = SplatScene(splat.params, config, splat.sh_degree, backend, capture.world_transform)
        stands = stands_of_capture(capture, config.test_every, splat.params["means"])
    title = splat.folder.resolve().name if splat.folder else splat.path.resolve().stem
    return LiveViewer(scene, stands, title, args.host, args.port)


def stands_of_capture(capture: Capture, test_every: int, means: Any) -> list[Any]:
    """Make places to look from of the training views, or where there are none of all, at most sixty."""
    from pop_fast.io.images import fit
    from pop_fast.view.html import cameras_of
    from pop_fast.view.live.server import stands_of

    views = capture.train_views(test_every) or capture.views
    cameras, by_name = cameras_of(views), {view.name: view for view in views}
    photos = [fit(by_name[camera.name].image, max_side=_PHOTO_SIDE) for camera in cameras]
    return stands_of(cameras, photos, means.detach().cpu())


def announce(viewer: LiveViewer) -> None:
    from pop_fast.view.live.server import LOOPBACK

    print(f"viewer: {viewer.url}", flush=True)
    if viewer.host not in LOOPBACK:
        print("note: anyone with this address who can reach it sees the splat and its photographs", flush=True)


def check_address(host: str, port: int) -> None:
    """Refuse an address that the viewer cannot listen on, within a second or so."""
    if not 0 < port < 65536:
        raise PopError(f"port is {port}; give --port a number from 1 to 65535")
    from pop_fast.view.live.guard import listen
    from pop_fast.view.live.server import require_viser

    require_viser()
    listen(host, port).close()


class LiveView:
    """The viewer of a training; see `pop_fast.view.live.draw`."""

    def __init__(self, capture: Capture, options: Any, showing: ExitStack) -> None:
        self._capture, self._options, self._showing = capture, options, showing
        self._viewer: LiveViewer | None = None

    def start(self, run: TrainingRun) -> None:
        from pop_fast.view.live.draw import scene_of
        from pop_fast.view.live.server import LiveViewer

        capture, options = self._capture, self._options
        stands = stands_of_capture(capture, run.config.test_every, run.params["means"])
        scene = scene_of(run, capture.world_transform)
        viewer = LiveViewer(scene, stands, capture.name, options.view_host, options.view_port)
        self._viewer = self._showing.enter_context(viewer)
        announce(viewer)

    def __call__(self, run: TrainingRun) -> None:
        from pop_fast.view.live.draw import follow

        if self._viewer is not None:
            follow(self._viewer, run, self._capture.world_transform)


def check_viewer(options: Any) -> None:
    """Refuse a viewer that cannot be before the minutes of loading, not after."""
    if options.view:
        try:
            check_address(options.view_host, options.view_port)
        except PopError as error:
            # a training's options have longer names
            raise PopError(str(error).replace("--host", "--view-host").replace("--port", "--view-port")) from error
