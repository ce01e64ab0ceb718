"""The live viewer: from a state to a picture, when to draw, recorded paths, and a real browser."""

from __future__ import annotations

import contextlib
import http.client
import json
import math
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import cv2
import msgspec
import numpy as np
import pytest
import torch
import viser
import zstandard
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request
from websockets.sync.client import connect

from pop_fast.cli import view as cli_view
from pop_fast.cli.live_view import LiveView
from pop_fast.cli.view import stands_of_capture
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train.checkpoint import load_splats
from pop_fast.train.gpu_proxy import renderer
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.views import ViewTensors, render_view
from pop_fast.view.layers import render_layers
from pop_fast.view.live import KeyCamera, RecordedPath, SplatScene, ViewState, read_path
from pop_fast.view.live.follow import follow, scene_of
from pop_fast.view.live.guard import MOST_VIEWS, Guard, listen
from pop_fast.view.live.incoming import interval, number, one_of, passed_on
from pop_fast.view.live.pace import Pace
from pop_fast.view.live.recording import from_capture, path_of, to_capture
from pop_fast.view.live.server import LiveViewer
from pop_fast.view.live.state import field_of_view, pose_of_viewmat, viewmat_of_pose
from pop_fast.view.paths.video import frames_in
from pop_fast.view.pictures import id_colors
from tests.app.browser import browser
from tests.app.conftest import TRAIN, Pop
from tests.app.test_paths import ring
from tests.app.tiny import tiny_capture, tiny_config

WORLD = np.array([[0.0, -2.0, 0.0, 3.0], [2.0, 0.0, 0.0, -1.0], [0.0, 0.0, 2.0, 0.5], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def shown(shared_result: Path) -> tuple[SplatScene, ViewState, Any]:
    """A trained splat, its first training view as a state, and its capture."""
    splat = load_splat(shared_result)
    capture, config = open_capture(splat, CaptureOptions())
    scene = SplatScene(splat.params, config, splat.sh_degree, renderer("auto")[0], capture.world_transform)
    view = capture.train_views(config.test_every)[0]
    return scene, ViewState(view.viewmat, field_of_view(view.K, view.height), view.width, view.height), capture


def test_a_training_camera_shows_what_training_renders(shown: tuple[SplatScene, ViewState, Any]) -> None:
    scene, state, capture = shown
    # a browser's camera has its axis in the middle, the demo's nearly
    lens = torch.from_numpy(state.K).float()[None]
    view = replace(ViewTensors.of(capture.train_views(8)[0]), K=lens)
    with torch.no_grad():
        image = render_view(renderer("auto")[0], scene.params, view, scene.config, scene.sh_degree).image
    expected = (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    drawn = scene.draw(state)
    assert np.array_equal(drawn.image, expected)
    assert drawn.image.std() > 10.0
    assert drawn.legend == f"{len(scene.params['means']):,} Gaussians"


def test_modes_show_owners_opacity_and_depth(shown: tuple[SplatScene, ViewState, Any]) -> None:
    scene, state, _ = shown
    pictures = {mode: scene.draw(replace(state, mode=mode)) for mode in ("dominant", "opacity", "depth")}
    assert "own a pixel" in pictures["dominant"].legend
    assert "opaque on average" in pictures["opacity"].legend
    near, far = (float(word) for word in pictures["depth"].legend.split("depth ")[1].split() if word[0].isdigit())
    assert 0.0 < near < far
    ids = owners(scene, scene.params, state)
    assert np.array_equal(pictures["dominant"].image, id_colors(ids))
    assert len(np.unique(ids)) > 20


def owners(scene: SplatScene, params: dict[str, torch.Tensor], state: ViewState) -> np.ndarray:
    """Find the rows of `params` that own the pixels of a state."""
    found = render_layers(renderer("auto")[0], params, state.camera(), scene.config, scene.sh_degree, dominance=True)
    assert found.dominant_ids is not None
    return found.dominant_ids


def test_a_gaussian_keeps_its_colour_when_others_are_left_out(shown: tuple[SplatScene, ViewState, Any]) -> None:
    scene, state, _ = shown
    means = scene._own_means()
    centre, half = means.median(0).values, (means.max(0).values - means.min(0).values)
    box = tuple((centre - 0.3 * half).tolist() + (centre + 0.3 * half).tolist())
    cropped = scene.draw(replace(state, mode="dominant", crop=box))
    kept = ((means >= torch.tensor(box[:3])) & (means <= torch.tensor(box[3:]))).all(1).numpy()
    assert 0 < kept.sum() < len(kept)
    assert cropped.legend.startswith(f"{kept.sum():,} of {len(kept):,} Gaussians")
    rows = np.append(np.flatnonzero(kept), -1)
    few = rows[owners(scene, {name: tensor[torch.from_numpy(kept)] for name, tensor in scene.params.items()}, state)]
    same = (few == owners(scene, scene.params, state)) & (few >= 0)
    whole = scene.draw(replace(state, mode="dominant"))
    assert same.sum() > 50
    assert np.array_equal(cropped.image[same], whole.image[same])


def test_a_threshold_leaves_out_what_is_fainter(shown: tuple[SplatScene, ViewState, Any]) -> None:
    scene, state, _ = shown
    opacities = torch.sigmoid(scene.params["opacities"])
    middle = float(opacities.median())
    drawn = scene.draw(replace(state, min_opacity=middle))
    assert drawn.legend.startswith(f"{int((opacities >= middle).sum()):,} of")
    empty = scene.draw(replace(state, min_opacity=1.0))
    assert empty.legend.startswith("0 of")
    assert np.ptp(empty.image) == 0


def test_the_box_that_is_offered_holds_nearly_all(shown: tuple[SplatScene, ViewState, Any]) -> None:
    box = np.array(shown[0].extent()).reshape(2, 3)
    means = shown[0]._own_means().numpy()
    assert ((means >= box[0]) & (means <= box[1])).all(1).mean() > 0.9


def test_a_pose_and_its_matrix_say_the_same() -> None:
    for viewmat in ring(5):
        np.testing.assert_allclose(viewmat_of_pose(*pose_of_viewmat(viewmat)), viewmat, atol=1e-12)


def test_a_moving_camera_is_drawn_small_and_a_resting_one_sharp() -> None:
    pace = Pace()
    assert pace.due(0.0) == "sharp"
    pace.begin()
    pace.drawn("sharp", 960 * 640, 1.0, 1.0)
    assert pace.due(5.0) is None
    pace.moved(10.0)
    assert pace.due(10.0) == "quick"
    width, height = pace.size("quick", 1200, 800, 960)
    assert width * height / (960 * 640) == pytest.approx(0.12, rel=0.05)  # as much as 0.12 s allow
    assert pace.size("sharp", 1200, 800, 960) == (960, 640)
    pace.begin()
    pace.drawn("quick", width * height, 0.12, 10.1)
    assert pace.due(10.15) is None
    assert pace.rests_in(10.15) == pytest.approx(0.1)
    assert pace.due(10.3) == "sharp"


def test_what_moves_while_a_picture_is_drawn_is_drawn_again() -> None:
    pace = Pace()
    pace.begin()
    pace.moved(1.0)
    pace.drawn("sharp", 100, 0.5, 1.1)
    assert pace.due(1.1) == "quick"


def test_a_training_is_shown_anew_for_a_fifth_of_the_time_at_most() -> None:
    pace = Pace()
    pace.begin()
    pace.drawn("sharp", 100, 1.0, 100.0)
    pace.renewed()
    assert pace.due(104.0) is None
    assert pace.due(105.1) == "sharp"


def test_a_camera_moves_between_frames_and_back() -> None:
    viewmat = ring(3)[1]
    there = to_capture(viewmat, WORLD)
    np.testing.assert_allclose(there[:3, :3] @ there[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(from_capture(there, WORLD), viewmat, atol=1e-12)
    # the same point, at half the distance in the frame whose unit is twice as long
    point = np.array([0.3, 0.2, 0.1, 1.0])
    np.testing.assert_allclose((viewmat @ WORLD @ point)[:3], 2.0 * (there @ point)[:3], atol=1e-12)


def test_a_path_passes_its_cameras_in_any_frame(tmp_path: Path) -> None:
    cameras = [KeyCamera(viewmat, fov) for viewmat, fov in zip(ring(12)[:3], (0.5, 1.0, 0.7), strict=True)]
    file = tmp_path / "path.json"
    file.write_text(path_of(cameras, WORLD).text())
    along = read_path(file).along(5, WORLD)
    for key, found in zip(cameras, along[::2], strict=True):
        np.testing.assert_allclose(found.viewmat, key.viewmat, atol=1e-9)
        assert found.fov_y == pytest.approx(key.fov_y)
    assert 0.5 < along[1].fov_y < 1.0
    single = RecordedPath((cameras[0],)).along(3, np.eye(4))
    assert len(single) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1]", "it must be an object"),
        ('{"kind": "something"}', "is not a camera path of 'pop view' (kind 'something')"),
        ('{"kind": "pop camera path", "frame": "capture", "cameras": []}', "has no cameras"),
        ('{"kind": "pop camera path", "frame": "capture", "cameras": [{}]}', "cameras[0]: needs viewmat"),
        (
            json.dumps(
                {
                    "kind": "pop camera path",
                    "frame": "capture",
                    "cameras": [
                        {"viewmat": [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "fov_y_degrees": 50}
                    ],
                }
            ),
            "cameras[0]: viewmat is no rigid",
        ),
        (
            json.dumps(
                {
                    "kind": "pop camera path",
                    "frame": "capture",
                    "cameras": [{"viewmat": np.eye(4).tolist(), "fov_y_degrees": 180}],
                }
            ),
            "fov_y_degrees is 180",
        ),
    ],
)
def test_a_damaged_path_is_named_before_anything_is_rendered(
    pop: Pop, shared_result: Path, tmp_path: Path, text: str, said: str
) -> None:
    (tmp_path / "path.json").write_text(text)
    outcome = pop("render", shared_result, "--path", tmp_path / "path.json", "--out", tmp_path / "r")
    assert outcome.status == 2
    assert said in outcome.err
    assert not (tmp_path / "r").exists()


def test_a_path_that_is_neither_known_nor_a_file_is_refused(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    outcome = pop("render", shared_result, "--path", "spiral", "--out", tmp_path / "r")
    assert outcome.status == 2
    assert "give --path one of views, orbit, ellipse, interpolate, or a file that 'pop view' saved" in outcome.err


def test_a_recorded_path_is_rendered(
    pop: Pop, shared_result: Path, shown: tuple[SplatScene, ViewState, Any], tmp_path: Path
) -> None:
    scene, state, capture = shown
    views = capture.train_views(8)
    cameras = [KeyCamera(view.viewmat, state.fov_y) for view in views[:3]]
    (tmp_path / "path.json").write_text(path_of(cameras, capture.world_transform).text())
    words = ["--path", tmp_path / "path.json", "--frames", "5", "--out", tmp_path / "r", "--video", tmp_path / "v.webm"]
    assert pop("render", shared_result, *words).status == 0
    assert frames_in(tmp_path / "v.webm") == 5
    first = cv2.imread(str(tmp_path / "r" / "path_0000.png"))[:, :, ::-1]
    assert np.abs(first.astype(int) - scene.draw(state).image).max() <= 1


def test_without_viser_one_line_says_how_to_get_it(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    for words in (("view", shared_result), ("train", shared_capture, "--out", tmp_path / "r", "--view")):
        outcome = pop(*words)
        assert outcome.status == 2
        assert "pip install 'viser>=1.1,<1.2'" in outcome.err
        assert len(outcome.err.strip().splitlines()) == 1
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("port", [0, 65536])
def test_a_port_that_cannot_be_is_refused(pop: Pop, shared_result: Path, port: int) -> None:
    outcome = pop("view", shared_result, "--port", port)
    assert outcome.status == 2
    assert f"port is {port}; give --port" in outcome.err


@pytest.mark.parametrize("lone", [False, True])
def test_the_command_prints_its_address_serves_it_and_ends_with_ctrl_c(
    pop: Pop,
    shared_result: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    lone: bool,
) -> None:
    pytest.importorskip("viser", reason="pip install 'viser>=1.1,<1.2'")
    from pop_fast.view.live.server import LiveViewer

    served: list[bytes] = []

    def interrupted(viewer: LiveViewer) -> None:
        # as browsers do that open connections ahead
        socket.create_connection((viewer.host, viewer.port)).close()
        served.append(urlopen(viewer.url).read())
        raise KeyboardInterrupt

    monkeypatch.setattr(LiveViewer, "wait", interrupted)
    file = tmp_path / "a.ply"
    if lone:
        assert pop("export", shared_result, "--out", file).status == 0
    outcome = pop("view", file if lone else shared_result, "--port", 18_432)
    assert outcome.status == 0, outcome.err
    assert re.fullmatch(
        r"(note: no capture is known.*\n)?viewer: http://127\.0\.0\.1:\d+/[\w-]{24}/\nCtrl-C ends it\n", outcome.out
    )
    assert ("note: no capture" in outcome.out) is lone
    assert b"<html" in served[0].lower()
    assert not [record for record in caplog.records if record.name.startswith("websockets")]


class Viewer:
    """Stands in for the server: draws whenever it is asked to."""

    watched = True

    def __init__(self) -> None:
        self.drawn: list[str] = []
        self.scene: SplatScene | None = None

    def show(self, scene: SplatScene, note: str) -> None:
        self.scene = scene
        self.drawn.append(note)

    def draw_due(self, share: float) -> int:
        assert self.scene is not None
        state = ViewState(ring(1)[0], 0.9, 24, 16)
        for mode in ("colour", "dominant", "depth"):
            self.scene.draw(replace(state, mode=mode, min_opacity=0.05))
        return 1


def test_a_training_that_is_watched_has_the_same_bits(tmp_path: Path) -> None:
    viewer, capture = Viewer(), tiny_capture()
    runs = {
        "alone": TrainingRun(tiny_config(tmp_path / "alone"), capture),
        "watched": TrainingRun(
            tiny_config(tmp_path / "watched"), capture, watch=lambda run: follow(viewer, run, capture.world_transform)
        ),
    }
    for run in runs.values():
        run.run()
    steps = runs["alone"].config.max_steps
    assert viewer.drawn[-1] == f"step {steps} of {steps}"
    assert len(viewer.drawn) >= steps // 5
    for key, alone in runs["alone"].params.items():
        assert torch.equal(alone, runs["watched"].params[key]), key
    alone, watched = (sorted((tmp_path / name / "ply").iterdir())[-1].read_bytes() for name in runs)
    assert alone == watched


def test_a_watched_training_shows_the_gaussians_as_they_are(tmp_path: Path) -> None:
    run = TrainingRun(tiny_config(tmp_path / "r"), tiny_capture())
    scene = scene_of(run, np.eye(4))
    assert all(scene.params[key].data_ptr() == run.params[key].data_ptr() for key in run.params)
    assert not any(tensor.requires_grad for tensor in scene.params.values())


def test_a_browser_shows_the_first_training_camera_and_moves_on(
    shown: tuple[SplatScene, ViewState, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="pip install 'viser>=1.1,<1.2'")
    from pop_fast.view.live.server import LiveViewer

    scene, state, capture = shown
    stands = stands_of_capture(capture, 8, scene.params["means"])
    with LiveViewer(scene, stands, "toy", port=18_431) as viewer, browser(tmp_path / "browser") as tab:
        assert viewer.url.startswith("http://127.0.0.1:")
        tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path / "files"))
        tab.show(viewer.url, 900, 600)
        until = time.monotonic() + 60

        def draw_until(done: str) -> None:
            while not tab.value(done):
                assert time.monotonic() < until, (tab.errors, tab.value("document.body.innerText"))
                viewer.wait(0.05)
                viewer.draw_due()
            viewer.draw_due()

        sharp = "document.body.innerText.includes('900 x 600')"
        draw_until(sharp)
        expected = scene.draw(replace(state, width=900, height=600)).image
        assert psnr_of_left_half(tab, expected) > 28.0
        # another camera, by its button, and a screenshot of it
        click(tab, "next")
        draw_until(f"document.querySelector('input[value=\"{stands[1].camera.name}\"]') !== null && {sharp}")
        viewer.wait(0.3)
        viewer.draw_due()
        there = stands[1].camera
        moved = ViewState(there.viewmat, field_of_view(there.K, there.height), 900, 600)
        assert psnr_of_left_half(tab, scene.draw(moved).image) > 28.0
        for name in ("Add this camera", "Save", "Screenshot"):
            click(tab, name)
            viewer.wait(0.3)
            viewer.draw_due()
        while len(list((tmp_path / "files").glob("toy*"))) < 2 and time.monotonic() < until:
            viewer.wait(0.05)
            viewer.draw_due()
        saved = read_path(tmp_path / "files" / "toy_path.json").along(1, capture.world_transform)[0]
        np.testing.assert_allclose(saved.viewmat, there.viewmat, atol=1e-3)
        assert cv2.imread(str(tmp_path / "files" / "toy_001.png")).shape == (27, 40, 3)
        use_every_control(tab, lambda: draw_until("true"))
        assert viewer.watched
        assert "closed a view" not in capsys.readouterr().err
        # the page asks nobody else, and its policy forbids it nothing that it needs
        assert not [error for error in tab.errors if "Security Policy" in error], tab.errors
        assert all(url.startswith((viewer.url, "data:", "blob:", "about:", "ws:")) for url in tab.requests)


def use_every_control(tab: Any, draw: Callable[[], None]) -> None:
    """Drag, scroll, move every slider to its ends, tick every box and choose from a list."""
    place = {"x": 300, "y": 300, "button": "left", "clickCount": 1}
    for kind in ("mousePressed", "mouseMoved", "mouseReleased"):
        place |= {"x": place["x"] + 40}
        tab.call("Input.dispatchMouseEvent", type=kind, **place)
    tab.call("Input.dispatchMouseEvent", type="mouseWheel", x=300, y=300, deltaX=0, deltaY=300)
    tab.value("[...document.querySelectorAll('*')].filter(e => e.innerText === 'Crop').at(-1).click()")
    # the folder opens slowly
    time.sleep(0.5)
    tab.value("document.querySelectorAll('input[type=checkbox]').forEach(e => e.click())")
    for key in ("ArrowRight", "ArrowLeft", "End", "Home"):
        tab.value("document.querySelector('[role=slider]').focus()")
        for kind in ("rawKeyDown", "keyUp"):
            tab.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=KEYS[key])
        draw()
    # the box that is cropped to: both ends of each slider inwards, and past the end
    for k in range(6):
        thumb = f"document.querySelectorAll('.multi-slider-thumb')[{k}].getBoundingClientRect()"
        x, y = (tab.value(f"{thumb}.{name} + 4") for name in "xy")
        for kind, by in (("mousePressed", 0), ("mouseMoved", 20), ("mouseMoved", -15), ("mouseReleased", -15)):
            tab.call("Input.dispatchMouseEvent", type=kind, x=x + by, y=y, button="left", clickCount=1)
            draw()
    for name in ("dominant", "opacity", "depth"):
        tab.value("document.querySelectorAll('input[aria-haspopup=listbox]')[0].click()")
        time.sleep(0.3)
        tab.value(f"[...document.querySelectorAll('[role=option]')].find(e => e.innerText.trim() === {name!r}).click()")
        time.sleep(0.1)
        draw()
    for name in ("previous", "Remove the last"):
        click(tab, name)
        draw()
    time.sleep(0.3)
    draw()


KEYS = {"ArrowRight": 39, "ArrowLeft": 37, "End": 35, "Home": 36}


def click(tab: Any, name: str) -> None:
    """Press the button of this name."""
    found = f"[...document.querySelectorAll('button, label')].find(b => b.innerText.trim() === {name!r})"
    tab.value(f"{found}.click()")


def psnr_of_left_half(tab: Any, expected: np.ndarray) -> float:
    """Compare what a tab shows with a picture, left of the panel and under any notice, dB; the best of a few tries."""
    best, window = 0.0, (slice(200, None), slice(0, 500))
    for _ in range(20):
        error = tab.screenshot()[window].astype(float) - expected[window]
        best = max(best, float(-10.0 * np.log10(np.mean(error**2) / 255.0**2)))
        if best > 28.0:
            break
        time.sleep(0.2)
    return best


# The viewer against pages of other people: who is let in, what is read of them, and that a training never hears of
# it.

pytest.importorskip("viser", reason="pip install 'viser>=1.1,<1.2'")


CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0, 0, -4],
    "fov": 0.9,
    "near": 0.01,
    "far": 1000,
    "image_height": 24,
    "image_width": 32,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, -1.0, 0.0],
}
NAN_CAMERA = CAMERA | {"wxyz": [math.nan, 0.0, 0.0, 0.0]}
LAST = "ckpts/ckpt_29_rank0.pt"


class Client:
    """A program that says what it likes to the viewer."""

    def __init__(self, url: str, path: str | None = None, host: str = "", **options: Any) -> None:
        at = urlsplit(url)
        own = {"origin": f"http://{host or at.netloc}", "subprotocols": [f"viser-v{viser.__version__}"]}
        # the address that is dialled stays, whatever Host says
        dialled = socket.create_connection((at.hostname or "", at.port or 0), timeout=5.0)
        asked = f"ws://{host or at.netloc}{(at.path if path is None else path).rstrip('/')}"
        settings = {"sock": dialled, "max_size": None, "proxy": None, "close_timeout": 1.0, **own, **options}
        self.connection = connect(asked, **settings)

    def say(self, *messages: dict[str, Any]) -> None:
        for message in messages:
            self.connection.send(msgspec.msgpack.encode(message))

    def hear(self, kind: str, seconds: float = 10.0) -> dict[str, Any]:
        """Wait for a message of this type."""
        until = time.monotonic() + seconds
        while True:
            data = bytes(self.connection.recv(timeout=max(until - time.monotonic(), 0.0)))
            packed = data[16 : 16 + int.from_bytes(data[8:16], "little")]
            content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))
            for message in content["messages"]:
                if message["type"] == kind:
                    return message

    def end(self, seconds: float = 10.0) -> int:
        """Wait until the server closes; return its code."""
        until = time.monotonic() + seconds
        try:
            while True:
                self.connection.recv(timeout=max(until - time.monotonic(), 0.0))
        except ConnectionClosed as closed:
            return closed.rcvd.code if closed.rcvd else 0


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveViewer]:
    """A viewer that nobody draws for."""
    capture = tiny_capture()
    run = TrainingRun(tiny_config(tmp_path_factory.mktemp("run") / "r"), capture)
    stands = stands_of_capture(capture, 8, run.params["means"])
    with LiveViewer(scene_of(run, np.eye(4)), stands, "tiny", port=18_700) as made:
        yield made


@pytest.mark.parametrize(
    "options",
    [
        {"origin": "http://example.org"},
        {"origin": "null"},
        {"origin": None},
        {"origin": "http://127.0.0.1:1"},
        {"host": "rebound.example.org:{port}"},
        {"host": "127.0.0.1:1"},
        {"path": ""},
        {"path": "/wrong"},
        {"path": "/é"},
    ],
    ids=str,
)
def test_nobody_else_gets_a_socket(viewer: LiveViewer, options: dict[str, Any]) -> None:
    told = {key: value.format(port=viewer.port) if value else value for key, value in options.items()}
    if told.get("path") == "/é":
        told["path"] = "/%C3%A9"
    with pytest.raises(InvalidStatus) as refused:
        Client(viewer.url, **told)
    assert refused.value.response.status_code == 403
    assert viewer._guard.token.encode() not in refused.value.response.body


def test_nobody_is_there_to_publish_the_server(viewer: LiveViewer) -> None:
    handlers = {kind.__name__ for kind in viewer._server._websock_server._incoming_handlers}
    assert "GuiUpdateMessage" in handlers
    assert not [name for name in handlers if name.startswith("Share")]


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("", {}, 200),
        ("", {"Host": "localhost:{port}"}, 200),
        ("", {"Host": "rebound.example.org:{port}"}, 403),
        ("", {"Host": "127.0.0.1"}, 403),
        ("", {"Origin": "null"}, 403),
        ("", {"Origin": "https://example.org"}, 403),
        ("/", {}, 403),
        ("/index.html", {}, 403),
    ],
)
def test_nobody_else_gets_the_page(viewer: LiveViewer, path: str, headers: dict[str, str], status: int) -> None:
    asked = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=5.0)
    asked.request(
        "GET", path or urlsplit(viewer.url).path, headers={k: v.format(port=viewer.port) for k, v in headers.items()}
    )
    answer = asked.getresponse()
    assert answer.status == status
    if status == 200:
        assert "frame-ancestors 'none'" in (answer.headers["Content-Security-Policy"] or "")
        assert answer.headers["Referrer-Policy"] == "no-referrer"


def test_a_training_does_not_hear_of_hostile_clients_and_ends_with_the_same_bits(
    pop: Pop, shared_capture: Path, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared: list[str] = []
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(viser.ViserServer, name, lambda self, name=name: shared.append(name))
    attacks: list[Attack] = []

    def announce(viewer: LiveViewer) -> None:
        announce_as_ever(viewer)
        attacks.append(Attack(viewer.url))

    def watch(self: LiveView, run: TrainingRun) -> None:
        watch_as_ever(self, run)
        until = time.monotonic() + 60.0
        # the attack begins and ends between the same two steps, or it would depend on this machine's speed
        while run.step >= 10 and attacks[0].is_alive() and time.monotonic() < until:
            time.sleep(0.01)
            watch_as_ever(self, run)

    announce_as_ever, watch_as_ever = cli_view.announce, LiveView.__call__
    monkeypatch.setattr(cli_view, "announce", announce)
    monkeypatch.setattr(LiveView, "__call__", watch)
    words = ("train", shared_capture, "--out", tmp_path / "watched", *TRAIN, "--view", "--view-port", 18_800)
    outcome = pop(*words)
    assert outcome.status == 0, outcome.err
    assert attacks[0].error is None, attacks[0].error
    assert attacks[0].ends == {"nan": 1008, "zero": 1008, "text": 1008, "share": 1008, "long": 1009}
    assert len(attacks[0].inside) <= MOST_VIEWS
    assert attacks[0].pictures > 0
    assert not shared
    assert "Traceback" not in outcome.err
    lines = [line for line in outcome.err.splitlines() if line.startswith("note: the viewer closed a view: ")]
    for part in ("wxyz [nan", "length 0", "chose 'abc'", "ShareUrlRequest"):
        assert sum(part in line for line in lines) == 1, (part, outcome.err)
    alone, watched = (load_splats(folder / LAST)[0] for folder in (shared_result, tmp_path / "watched"))
    for name, tensor in alone.items():
        assert torch.equal(tensor, watched[name]), name


class Attack(threading.Thread):
    """What clients do who have the address, and many who come at once."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        self.url = url
        self.ends: dict[str, int] = {}
        self.pictures = 0
        self.inside: list[Client] = []
        self.error: BaseException | None = None
        self.start()

    def run(self) -> None:
        try:
            self.ends["nan"] = self.after(NAN_CAMERA)
            watching = Client(self.url)
            watching.say(CAMERA)
            mode = watching.hear("GuiDropdownMessage")["uuid"]
            watching.hear("BackgroundImageMessage", 30.0)
            self.pictures += 1
            self.ends["zero"] = self.after(CAMERA | {"wxyz": [0, 0, 0, 0]})
            self.ends["share"] = self.after(CAMERA, {"type": "ShareUrlRequest"}, {"type": "ShareUrlDisconnect"})
            long = Client(self.url)
            long.connection.send(bytes(60 * 2**20))
            self.ends["long"] = long.end()
            watching.say({"type": "GuiUpdateMessage", "uuid": mode, "updates": {"value": "abc"}})
            self.ends["text"] = watching.end()
            with ThreadPoolExecutor(16) as pool:
                list(pool.map(lambda _: self.try_to_enter(), range(200)))
        except BaseException as error:
            self.error = error

    def after(self, *messages: dict[str, Any]) -> int:
        client = Client(self.url)
        client.say(*messages)
        return client.end()

    def try_to_enter(self) -> None:
        with contextlib.suppress(InvalidStatus, ConnectionClosed, OSError, EOFError):
            self.inside.append(Client(self.url))


def test_an_error_in_a_view_closes_that_view_with_one_line(
    viewer: LiveViewer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def draw(state: Any) -> Any:
        if state.height == 31:
            raise RuntimeError("out of\nmemory")
        return draw_as_ever(state)

    draw_as_ever = viewer._scene.draw
    monkeypatch.setattr(viewer._scene, "draw", draw)
    good, bad = Client(viewer.url), Client(viewer.url)
    good.say(CAMERA)
    bad.say(CAMERA | {"image_height": 31})
    until = time.monotonic() + 20.0
    while len(viewer._views) < 2 and time.monotonic() < until:
        time.sleep(0.01)
    drawn = 0
    while (drawn < 1 or len(viewer._views) > 1) and time.monotonic() < until:
        viewer.wait(0.05)
        drawn += viewer.draw_due()
    assert good.hear("BackgroundImageMessage")
    assert bad.end() == 1011
    assert capsys.readouterr().err == "note: the viewer closed a view: RuntimeError: out of memory\n"
    good.connection.close()


def test_who_only_holds_connections_open_does_not_fill_the_process(viewer: LiveViewer) -> None:
    held = [socket.create_connection(("127.0.0.1", viewer.port)) for _ in range(150)]
    time.sleep(0.2)
    for one in held:
        one.settimeout(0.01)
    assert sum(map(is_open, held)) <= 64
    for one in held:
        one.close()
    time.sleep(0.2)
    asked = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=5.0)
    asked.request("GET", urlsplit(viewer.url).path)
    assert asked.getresponse().status == 200


def is_open(one: socket.socket) -> bool:
    try:
        return one.recv(1) != b""
    except TimeoutError:
        return True
    except OSError:
        return False


def no_message(message: dict[str, Any] | bytes | str) -> str:
    """Return why a message is refused."""
    data = msgspec.msgpack.encode(message) if isinstance(message, dict) else message
    with pytest.raises(PopError) as refused:
        passed_on(data, RULES)
    return str(refused.value)


RULES = {"mode": one_of(("colour", "depth")), "opacity": number(0.0, 1.0), "x": interval(-2.0, 3.0)}


def test_what_a_browser_sends_is_passed_on() -> None:
    updates = {"mode": "depth", "opacity": 1, "x": [-2, 2.5]}
    sent = [CAMERA, *({"type": "GuiUpdateMessage", "uuid": k, "updates": {"value": v}} for k, v in updates.items())]
    assert all(passed_on(msgspec.msgpack.encode(message), RULES) for message in sent)
    assert not passed_on(msgspec.msgpack.encode({"type": "FileTransferPartAck", "transfer_uuid": "1"}), RULES)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"wxyz": [math.nan, 0.0, 0.0, 0.0]}, "wxyz [nan"),
        ({"wxyz": [0, 0, 0, 0]}, "length 0"),
        ({"wxyz": [1, 0, 0]}, "4 finite numbers"),
        ({"wxyz": "abcd"}, "4 finite numbers"),
        ({"position": [0, math.inf, 0]}, "position [0, inf, 0]"),
        ({"position": [0, 1e300, 0]}, "position"),
        ({"position": [0, True, 0]}, "position"),
        ({"look_at": [0, math.nan, 0]}, "look_at"),
        ({"fov": 0.0}, "fov 0.0"),
        ({"fov": math.nan}, "fov nan"),
        ({"fov": 3.2}, "fov 3.2"),
        ({"near": -1.0}, "near -1.0"),
        ({"far": math.inf}, "far inf"),
        ({"image_width": 2**31}, "image_width 2147483648"),
        ({"image_height": -1}, "image_height -1"),
        ({"image_height": 24.5}, "image_height 24.5"),
        ({"more": 1}, "other fields"),
    ],
    ids=str,
)
def test_a_camera_is_checked_as_a_file_is(change: dict[str, Any], said: str) -> None:
    assert said in no_message(CAMERA | change)


@pytest.mark.parametrize(
    ("control", "value"),
    [
        ("mode", "abc"),
        ("mode", 3),
        ("opacity", "abc"),
        ("opacity", math.nan),
        ("opacity", 1.5),
        ("opacity", [0.5]),
        ("x", [3.0, -2.0]),
        ("x", [0.0]),
        ("x", [math.nan, 1.0]),
        ("x", 1.0),
        ("other", 1.0),
    ],
)
def test_a_control_is_set_to_what_it_offers(control: str, value: Any) -> None:
    assert no_message({"type": "GuiUpdateMessage", "uuid": control, "updates": {"value": value}})


@pytest.mark.parametrize(
    "message",
    [
        "text",
        b"\xc1",
        b"",
        b"\x91" * 5000,
        msgspec.msgpack.encode([1]),
        {},
        {"type": 3},
        {"type": "RunJavascriptMessage", "source": "1"},
        {"type": "FileTransferStartUpload"},
        {"type": "GuiUpdateMessage", "uuid": "mode", "updates": {"value": "depth", "update_cb": 3}},
        {"type": "GuiUpdateMessage", "uuid": ["mode"], "updates": {"value": "depth"}},
        {"type": "SceneNodeClickMessage", "name": 3},
    ],
    ids=str,
)
def test_what_is_no_message_of_the_page_is_refused(message: Any) -> None:
    assert "\n" not in no_message(message)


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid", "300.1.1.1", "é" * 70])
def test_an_address_that_is_not_ours_is_refused_within_a_second(host: str) -> None:
    begun = time.monotonic()
    with pytest.raises(PopError, match="the viewer cannot listen on"):
        listen(host, 18_900)
    assert time.monotonic() - begun < 1.5


def test_it_is_said_before_a_splat_or_photographs_are_read(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    for words in (
        ("view", "absent", "--host"),
        ("train", shared_capture, "--out", tmp_path / "r", "--view", "--view-host"),
    ):
        outcome = pop(*words, "192.0.2.1")
        assert outcome.status == 2
        assert outcome.err.startswith("pop: error: the viewer cannot listen on 192.0.2.1:8080 ("), outcome.err
        assert not outcome.out


@pytest.mark.parametrize(
    ("host", "arrived_at", "named", "status"),
    [
        ("0.0.0.0", "192.0.2.7", "192.0.2.7", None),
        ("0.0.0.0", "192.0.2.7", socket.gethostname(), None),
        ("0.0.0.0", "192.0.2.7", "localhost", 403),
        ("0.0.0.0", "127.0.0.1", "localhost", None),
        ("0.0.0.0", "127.0.0.1", "0.0.0.0", 403),
        ("::", "::ffff:192.0.2.7", "192.0.2.7", None),
        ("::", "fe80::1%eth0", "[fe80::1]", None),
        ("::1", "::1", "[::1]", None),
        ("192.0.2.7", "192.0.2.7", "192.0.2.7", None),
        ("192.0.2.7", "192.0.2.7", "192.0.2.8", 403),
        ("box.example.org", "192.0.2.7", "BOX.example.org", None),
        ("box.example.org", "192.0.2.7", "rebound.example.org", 403),
        ("192.0.2.7", "192.0.2.7", "localhost", 403),
    ],
)
def test_a_request_must_name_what_is_listened_on(host: str, arrived_at: str, named: str, status: int | None) -> None:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        guard = Guard(host, listening, print)
        port = listening.getsockname()[1]
        headers = Headers({"Host": f"{named}:{port}", "Origin": f"http://{named}:{port}", "Upgrade": "websocket"})
        refused = guard.refusal(Request(f"/{guard.token}", headers), arrived_at)
        assert (refused and refused[0]) == status
        headers["Host"] = f"{named}:{port}"
        # a second one, which others on the way may read instead of the first
        assert guard.refusal(Request(f"/{guard.token}", headers), arrived_at)


def test_a_port_that_is_in_use_is_left_to_who_has_it() -> None:
    with listen("127.0.0.1", 18_950) as first, listen("127.0.0.1", first.getsockname()[1]) as second:
        assert second.getsockname()[1] > first.getsockname()[1]
        with pytest.raises(PopError, match="no free port from"):
            listen("127.0.0.1", first.getsockname()[1], tries=1)
