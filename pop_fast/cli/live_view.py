"""`pop train --view`: the splat in the browser while it is trained."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train.training_run import TrainingRun
    from pop_fast.view.live.server import LiveViewer


class LiveView:
    """The viewer of a training; see `pop_fast.view.live.follow`."""

    def __init__(self, capture: Capture, options: Any, showing: ExitStack) -> None:
        self._capture, self._options, self._showing = capture, options, showing
        self._viewer: LiveViewer | None = None

    def start(self, run: TrainingRun) -> None:
        """Start the server, and print where it is."""
        from pop_fast.cli.view import announce, stands_of_capture
        from pop_fast.view.live.follow import scene_of
        from pop_fast.view.live.server import LiveViewer

        capture, options = self._capture, self._options
        stands = stands_of_capture(capture, run.config.test_every, run.params["means"])
        scene = scene_of(run, capture.world_transform)
        viewer = LiveViewer(scene, stands, capture.name, options.view_host, options.view_port)
        self._viewer = self._showing.enter_context(viewer)
        announce(viewer)

    def __call__(self, run: TrainingRun) -> None:
        from pop_fast.view.live.follow import follow

        if self._viewer is not None:
            follow(self._viewer, run, self._capture.world_transform)


def check_viewer(options: Any) -> None:
    """Refuse a viewer that cannot be before the minutes of loading, not after.

    Raises:
        PopError: viser is absent, or the address cannot be listened on.
    """
    if options.view:
        from pop_fast.cli.view import check_address

        check_address(options.view_host, options.view_port)
