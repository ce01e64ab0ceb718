"""The live viewer: from a state to a picture, when to draw, recorded paths, and a real browser."""

from __future__ import annotations

import re
import signal
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, PropertyMock
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
import torch

from pop_fast.cli.view import Args, make_viewer, stands_of_capture
from pop_fast.io.images import id_colors
from pop_fast.train import TrainingRun
from pop_fast.train.engines import renderer
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.views import ViewTensors, render_layers, render_view
from pop_fast.view.live import KeyCamera, RecordedPath, SplatScene, ViewState, read_path
from pop_fast.view.live.draw import (
    Box,
    Panel,
    field_of_view,
    follow,
    from_capture,
    path_of,
    pose_of_viewmat,
    scene_of,
    to_capture,
    viewmat_of_pose,
)
from pop_fast.view.live.server import Pace
from pop_fast.view.paths import frames_in
from tests.app.conftest import Pop
from tests.app.damage import says
from tests.app.test_render import ring
from tests.app.tiny import assert_same_run, tiny_capture, tiny_config
from tests.browser import browser

WORLD = np.array([[0.0, -2.0, 0.0, 3.0], [2.0, 0.0, 0.0, -1.0], [0.0, 0.0, 2.0, 0.5], [0.0, 0.0, 0.0, 1.0]])


Shown = tuple[SplatScene, ViewState, Any]


@pytest.fixture(scope="module")
def shown(shared_result: Path) -> Shown:
    """A trained splat, its first training view as a state, and its capture."""
    splat = load_splat(shared_result)
    capture, config = open_capture(splat, CaptureOptions())
    scene = SplatScene(splat.params, config, splat.sh_degree, renderer("auto")[0], capture.world_transform)
    view = capture.train_views(config.test_every)[0]
    return scene, ViewState(view.viewmat, field_of_view(view.K, view.height), view.width, view.height), capture


def test_a_training_camera_shows_what_training_renders(shown: Shown) -> None:
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


def test_modes_show_owners_opacity_and_depth(shown: Shown) -> None:
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


def test_a_gaussian_keeps_its_colour_when_others_are_left_out(shown: Shown) -> None:
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


def test_a_threshold_leaves_out_what_is_fainter_and_the_box_that_is_offered_holds_nearly_all(shown: Shown) -> None:
    scene, state, _ = shown
    opacities = torch.sigmoid(scene.params["opacities"])
    middle = float(opacities.median())
    drawn = scene.draw(replace(state, min_opacity=middle))
    assert drawn.legend.startswith(f"{int((opacities >= middle).sum()):,} of")
    empty = scene.draw(replace(state, min_opacity=1.0))
    assert empty.legend.startswith("0 of")
    assert np.ptp(empty.image) == 0
    # violet is transparent, black is nobody's, grey has no depth
    for mode, color in (("opacity", (68, 1, 84)), ("dominant", (0, 0, 0)), ("depth", (112, 112, 118))):
        empty = scene.draw(replace(state, min_opacity=1.0, mode=mode))
        assert (empty.image == color).all(), mode
    assert empty.legend.endswith("nothing here is opaque enough to have a depth")
    low, high = np.array(scene.extent()).reshape(2, 3)
    means = scene._own_means().numpy()
    assert ((means >= low) & (means <= high)).all(1).mean() > 0.9


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
    # what moves while a picture is drawn is drawn again
    pace = Pace()
    pace.begin()
    pace.moved(1.0)
    pace.drawn("sharp", 100, 0.5, 1.1)
    assert pace.due(1.1) == "quick"
    # a training is shown anew for a fifth of the time at most
    pace = Pace()
    pace.begin()
    pace.drawn("sharp", 100, 1.0, 100.0)
    pace.renewed()
    assert [pace.due(seconds) for seconds in (104.0, 105.1)] == [None, "sharp"]


def test_a_camera_moves_between_frames_and_back_and_its_pose_says_the_same() -> None:
    for viewmat in ring(5):
        np.testing.assert_allclose(viewmat_of_pose(*pose_of_viewmat(viewmat)), viewmat, atol=1e-12)
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


def test_a_result_whose_capture_is_missing_is_still_shown_in_the_frame_of_the_capture(
    shared_result: Path, shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pop_fast.view.live.server.LiveViewer", lambda scene, *_: scene)
    splat = load_splat(shared_result)
    splat = replace(splat, config=replace(splat.config, data="moved away"))
    for words, transform in (({}, shown[2].world_transform), ({"own_frame": True}, np.eye(4))):
        scene: Any = make_viewer(Args(splat=shared_result, **words), splat)
        np.testing.assert_allclose(scene.world_transform, transform)


def test_a_file_without_a_capture_is_shown_with_the_near_plane_of_its_run(
    pop: Pop, shared_result: Path, shown: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pop_fast.view.live.server.LiveViewer", lambda scene, *_: scene)
    pop.done("export", shared_result, "--out", tmp_path / "a.ply")
    scene: Any = make_viewer(Args(splat=tmp_path / "a.ply"), load_splat(tmp_path / "a.ply"))
    assert scene.config.renderer.near_plane == pytest.approx(0.01 / shown[2].world_scale, rel=1e-12)


def test_where_every_view_is_held_out_one_looks_from_all(shown: Shown) -> None:
    scene, _, capture = shown
    assert len(stands_of_capture(capture, 1, scene.params["means"])) == len(capture.views)


@pytest.mark.parametrize("box", [(448210.1, 5411850.3, 120.0, 448290.9, 5411930.2, 180.0), (-1e-5,) * 3 + (2e-5,) * 3])
def test_a_crop_is_said_exactly_in_any_unit_and_far_from_the_origin(box: Box) -> None:
    client = MagicMock()
    client.gui.add_multi_slider = lambda axis, low, high, step, ends: MagicMock(value=ends, min=low, max=high)
    panel = Panel(client, ["a"], "x", box, np.eye(4), {}, lambda call: lambda event: call())
    said = []
    type(client.gui.add_markdown.return_value).content = PropertyMock(side_effect=said.append)
    panel._update()
    assert said[0].startswith("the same in a file: `--crop ")
    crop = [float(word) for word in said[0].split("`")[1].split()[1:]]
    np.testing.assert_allclose(crop, box, rtol=0.0, atol=0.01 * (box[3] - box[0]))
    assert panel.crop == pytest.approx(crop, rel=1e-11)


@pytest.mark.parametrize(("typed", "meant"), [(5, 1.0), (-1, 0.0), (0.25, 0.25)])
def test_an_opacity_that_is_being_typed_is_brought_into_its_range(typed: float, meant: float) -> None:
    client = MagicMock()
    client.gui.add_multi_slider = lambda axis, low, high, step, ends: MagicMock(value=ends, min=low, max=high)
    client.gui.add_slider.return_value.value = typed
    panel = Panel(client, ["a"], "x", (0.0,) * 3 + (1.0,) * 3, np.eye(4), {}, lambda call: lambda event: call())
    assert panel.min_opacity == meant


def test_a_recorded_path_is_rendered(pop: Pop, shared_result: Path, shown: Shown, tmp_path: Path) -> None:
    scene, state, capture = shown
    cameras = [KeyCamera(view.viewmat, state.fov_y) for view in capture.train_views(8)[:3]]
    (tmp_path / "path.json").write_text(path_of(cameras, capture.world_transform).text())
    words = ["--path", tmp_path / "path.json", "--frames", "5", "--out", tmp_path / "r", "--video", tmp_path / "v.webm"]
    pop.done("render", shared_result, *words)
    assert frames_in(tmp_path / "v.webm") == 5
    first = cv2.imread(str(tmp_path / "r" / "path_0000.png"))[:, :, ::-1]
    assert np.abs(first.astype(int) - scene.draw(state).image).max() <= 1


def test_without_viser_one_line_says_how_to_get_it(pop, shared_result, shared_capture, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for words in (("view", shared_result), ("train", shared_capture, "--out", tmp_path / "r", "--view")):
        says(pop(*words), "pip install 'viser>=1.1,<1.2'")
    assert not (tmp_path / "r").exists()


def test_a_port_that_cannot_be_is_refused(pop: Pop, shared_result: Path, shared_capture: Path) -> None:
    for port in (0, 65536):
        says(pop("view", shared_result, "--port", port), f"port is {port}; give --port")
    says(pop("train", shared_capture, "--view", "--view-port", 0), "port is 0; give --view-port a number")


@pytest.mark.parametrize("lone", [False, True])
def test_the_command_prints_its_address_serves_it_and_ends_with_ctrl_c(pop, shared_result, tmp_path, caplog, lone):
    pytest.importorskip("viser", reason="pip install 'viser>=1.1,<1.2'")
    from pop_fast.view.live.server import LiveViewer

    served: list[bytes] = []

    def interrupted(viewer: LiveViewer) -> None:
        # as browsers do that open connections ahead
        socket.create_connection((viewer.host, viewer.port)).close()
        served.append(urlopen(viewer.url).read())
        raise KeyboardInterrupt

    file = tmp_path / "a.ply"
    if lone:
        pop.done("export", shared_result, "--out", file)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LiveViewer, "wait", interrupted)
        outcome = pop.done("view", file if lone else shared_result, "--port", 18_432)
    address = r"viewer: http://127\.0\.0\.1:\d+/[\w-]{24}/\nCtrl-C ends it\n"
    assert re.fullmatch(rf"(note: no capture is known.*\n)?{address}", outcome.out)
    assert ("note: no capture" in outcome.out) is lone
    assert b"<html" in served[0].lower()
    assert not [record for record in caplog.records if record.name.startswith("websockets")]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 0), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_what_ends_the_viewer_says_its_exit_status(pop: Pop, shared_result: Path, monkeypatch, number, status) -> None:
    monkeypatch.setattr("pop_fast.view.live.server.LiveViewer.wait", lambda viewer: signal.raise_signal(number))
    outcome = pop("view", shared_result, "--port", 18_434)
    assert outcome.status == status
    assert ("pop: interrupted" in outcome.err) is (status > 0)


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


def test_a_training_that_is_watched_has_the_same_bits_and_is_shown_as_it_is(tmp_path: Path) -> None:
    viewer, capture = Viewer(), tiny_capture()
    alone = TrainingRun(tiny_config(tmp_path / "alone"), capture)
    watch = partial(follow, viewer, world_transform=capture.world_transform)
    watched = TrainingRun(tiny_config(tmp_path / "watched"), capture, watch=watch)
    for run in (alone, watched):
        run.run()
    steps = alone.config.max_steps
    assert viewer.drawn[-1] == f"step {steps} of {steps}"
    assert len(viewer.drawn) >= steps // 5
    assert_same_run(tmp_path / "watched", tmp_path / "alone")
    files = (sorted((tmp_path / name / "ply").iterdir())[-1].read_bytes() for name in ("alone", "watched"))
    assert len(set(files)) == 1
    scene = scene_of(watched, np.eye(4))
    assert all(scene.params[key].data_ptr() == watched.params[key].data_ptr() for key in watched.params)
    assert not any(tensor.requires_grad for tensor in scene.params.values())


def test_a_browser_shows_the_first_training_camera_and_moves_on(shown, tmp_path, capsys):
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
