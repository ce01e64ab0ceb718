"""The panel of one browser: what it asks for, and the files that it is given."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, MutableMapping, Sequence
from typing import Any, Final

import cv2
import numpy as np

from pop_fast.view.live.draw import MODES, Box, KeyCamera, Mode, ViewState, path_of
from pop_fast.view.live.guard import Rule, flag, interval, number, one_of

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
        self._use(self._opacity, number(0.0, 1.0), self._update)
        self._use(self._side, one_of(tuple(map(str, _LONGEST))), self._update)
        self._use(self._cropped, flag, self._update)
        for control in self._ranges:
            self._use(control, interval(control.min, control.max), self._update)

    def close(self) -> None:
        """Forget the controls, which nobody can set any more."""
        for name in self._controls:
            self._rules.pop(name, None)

    @property
    def mode(self) -> Mode:
        return self._mode.value

    @property
    def min_opacity(self) -> float:
        """Gaussians of less are left out."""
        return float(self._opacity.value)

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
                low, high = round(box[k], 4), round(box[k + 3], 4)
                step = max((high - low) / 200.0, 1e-4)
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
        words = "" if crop is None else f"`--crop {' '.join(f'{value:.4g}' for value in crop)}`"
        self._crop_words.content = words and f"the same in a file: {words} of `pop export`"
        self.changed()
