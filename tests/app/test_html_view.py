"""The page that shows a splat: a browser without a network draws what `pop render` draws."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.api.backend import get_backend
from pop_fast.io.formats import load_splat_file, save_as
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.views import ViewTensors, render_view
from pop_fast.view.document import asset
from pop_fast.view.html import PageCamera, camera_of_points, cameras_of, first_view, page_of, view_distances
from tests.app.captures import many
from tests.app.test_render import walk
from tests.app.tiny import look_at, tiny_capture
from tests.browser import Browser, browser

WIDTH, HEIGHT = 200, 150
# of the rendered SPZ that the page holds; half floats and the card's exp differ by less than a step of 255 almost
# everywhere, and by some steps where alpha lies at the floor of 1/255 (measured: 55 to 59 dB)
DRAWN_ALIKE = 50.0


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


K = np.array([[180.0, 0.0, 93.0], [0.0, 170.0, 80.0], [0.0, 0.0, 1.0]])


def a_view(position: tuple[float, float, float] = (0.5, -1.0, -6.0)) -> ViewTensors:
    viewmat = torch.from_numpy(look_at(np.array(position))).float()
    photo = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    return ViewTensors("a view", photo, None, viewmat[None], torch.from_numpy(K).float()[None])


def page_in(folder: Path, n: int, *cameras: PageCamera, title: str = "x", **settings: Any) -> Path:
    page = folder / f"{n}.html"
    page.write_bytes(page_of(many(n), list(cameras), TrainConfig(**settings), 3, title))
    return page


def camera_of(view: ViewTensors) -> PageCamera:
    return PageCamera(view.name, view.viewmat[0].double().numpy(), view.K[0].double().numpy(), WIDTH, HEIGHT)


def shown(tab: Browser, page: Path, camera: int = 0) -> np.ndarray:
    tab.open(page, WIDTH, HEIGHT, f"#camera={camera}&bare")
    tab.wait_for(f"document.getElementById('view')?.dataset.drawn === '{camera}'")
    return tab.screenshot()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10.0 * np.log10(255.0**2 / max(((a.astype(float) - b) ** 2).mean(), 1e-9)))


def rendered(params: dict[str, torch.Tensor], view: ViewTensors, config: TrainConfig, degree: int) -> np.ndarray:
    with torch.no_grad():
        image = render_view(get_backend("fast"), params, view, config, degree).image
    return (image.clamp(0.0, 1.0) * 255.0).round().numpy()


@pytest.mark.parametrize(
    ("bands", "antialiased", "background", "profile"),
    [
        (15, False, (0.0, 0.0, 0.0), "paper"),
        (8, True, (1.0, 0.5, 0.25), "paper"),
        (3, False, (0.2, 0.2, 0.2), "gsplat_1_6"),
        (0, False, (0.0, 0.0, 0.0), "paper"),
        (15, False, (0.0, 0.0, 0.0), "inria"),
    ],
)
def test_a_browser_draws_what_is_rendered(tab, tmp_path, bands, antialiased, background, profile):
    params, degree = many(1500, bands), (0, 3, 8, 15).index(bands)
    config = TrainConfig(antialiased=antialiased, background=background, profile=profile)
    views = [a_view(), a_view((3.0, 1.0, 4.0))]
    page = tmp_path / "x.html"
    page.write_bytes(page_of(params, [camera_of(view) for view in views], config, degree, "x"))
    save_as(tmp_path / "x.spz", "spz", params, antialiased)
    held = load_splat_file(tmp_path / "x.spz").params
    for index, view in enumerate(views):
        picture = shown(tab, page, index)
        drawn = rendered(held, view, config, degree)
        # not one colour, and the two views differ
        assert drawn.std() > 10.0
        assert psnr(picture, drawn) > DRAWN_ALIKE
    assert psnr(picture, rendered(held, views[0], config, degree)) < 25.0
    assert tab.errors == []


def test_a_page_of_a_result_starts_at_a_training_camera_and_asks_for_nothing(tab, pop, shared_result, tmp_path):
    pop.done("export", shared_result, "--out", tmp_path / "x.html")
    tab.requests.clear()
    tab.open(tmp_path / "x.html", 40, 32, "#bare")
    splat = load_splat(shared_result)
    capture, config = open_capture(splat, CaptureOptions())
    views = capture.train_views(config.test_every)
    first = first_view(cameras_of(views))
    tab.wait_for(f"document.getElementById('view')?.dataset.drawn === '{first}'")
    picture = tab.screenshot()
    assert all(url.startswith(("file:", "blob:", "about:", "data:")) for url in tab.requests)
    files = {url.partition("#")[0] for url in tab.requests if url.startswith("file:")}
    assert files == {(tmp_path / "x.html").as_uri()}
    # besides what the browser changes, what SPZ loses
    assert psnr(picture, rendered(splat.params, ViewTensors.of(views[first]), config, splat.sh_degree)) > 40.0
    # nor does it refer to another file
    page = page_of(many(5), [], TrainConfig(), 3, "x").decode()
    assert not re.findall(r"""(?:src|href)\s*=|url\(|@import|fetch\(|XMLHttpRequest|WebSocket|import\(""", page)
    assert "connect-src" not in page
    assert "default-src 'none'" in page


def redrawn(tab: Browser, expression: str = "") -> np.ndarray:
    """The picture after an event and frames that were asked for now: one sorts, one draws in the new order."""
    if expression:
        tab.value(expression)
    for _ in range(3):
        tab.value("delete document.getElementById('view').dataset.drawn; window.dispatchEvent(new Event('resize'))")
        tab.wait_for("document.getElementById('view').dataset.drawn")
    return tab.screenshot()


def test_mouse_wheel_keys_and_two_fingers_move_the_camera(tab: Browser, tmp_path: Path) -> None:
    page = page_in(tmp_path, 300, camera_of(a_view()), camera_of(a_view((3.0, 1.0, 4.0))))
    start = shown(tab, page)

    def after(key: str) -> np.ndarray:
        return redrawn(tab, f"window.dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}'}}))")

    turned = after("ArrowLeft")
    assert psnr(turned, start) < 30.0
    assert psnr(after("+"), turned) < 35.0
    assert psnr(after("r"), start) > 60.0
    assert psnr(after("n"), start) < 25.0
    # with Caps Lock
    assert psnr(after("P"), start) > 60.0
    for kind, x, buttons in (("mousePressed", 60, 1), ("mouseMoved", 120, 1), ("mouseReleased", 120, 0)):
        tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=70, button="left", buttons=buttons, clickCount=1)
    dragged = redrawn(tab)
    assert psnr(dragged, start) < 30.0
    tab.call("Input.dispatchMouseEvent", type="mouseWheel", x=60, y=70, deltaX=0, deltaY=-300)
    assert psnr(redrawn(tab), dragged) < 35.0
    assert psnr(after("r"), start) > 60.0

    def touch(kind: str, *points: tuple[int, int]) -> None:
        fingers = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)

    tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    touch("touchStart", (90, 75), (110, 75))
    for step in (5, 15, 30):
        touch("touchMove", (90 - step, 75), (110 + step, 75))
    touch("touchEnd")
    tab.call("Emulation.setTouchEmulationEnabled", enabled=False)
    assert psnr(redrawn(tab), start) < 30.0


def test_who_comes_by_the_keyboard_sees_that_the_keys_go_to_the_picture(tab: Browser, tmp_path: Path) -> None:
    before = shown(tab, page_in(tmp_path, 300))
    for kind in ("rawKeyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab", windowsVirtualKeyCode=9)
    tab.wait_for("document.activeElement.id === 'view'")
    frame = np.s_[0, 20:-20]
    assert np.abs(redrawn(tab)[frame].astype(int) - before[frame]).mean() > 50.0


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (400, 780)])
def test_the_buttons_fit_into_the_window(tab: Browser, tmp_path: Path, width: int, height: int) -> None:
    tab.open(page_in(tmp_path, 300, title="a title that is rather long"), width, height)
    tab.wait_for("document.getElementById('view')?.dataset.drawn === '0'")
    assert tab.value("document.documentElement.scrollWidth <= innerWidth && document.body.scrollHeight <= innerHeight")
    boxes = tab.value(
        "JSON.stringify([...document.querySelectorAll('#panel > *, #panel button')]"
        ".map(e => e.getBoundingClientRect()).map(b => [b.left, b.top, b.right, b.bottom]))"
    )
    for left, top, right, bottom in json.loads(boxes):
        assert 0 <= left <= right <= width
        assert 0 <= top <= bottom <= height


# as much of a browser as the page's script needs: what it asks WebGL to draw is kept, and a worker sorts when asked to
WITHOUT_BROWSER = """
const elements = {}, heard = {}, frames = [], drawn = [];
let lost = false, worker;
const listen = (kind, act) => { heard[kind] = act; };
const element = (id) => elements[id] ??= {
  textContent: texts[id] ?? "", dataset: {}, clientWidth: 80, clientHeight: 60, addEventListener: listen,
  setPointerCapture() {}, getContext: () => gl,
};
const gl = new Proxy({}, { get: (_, name) => (...given) => {
  if (name === "isContextLost") return lost;
  if (name === "uniformMatrix4fv") drawn.push(given[2]);
  return 4096;
} });
globalThis.document = { getElementById: element, body: { classList: { toggle() {} } } };
globalThis.location = { hash };
globalThis.window = { addEventListener: listen };
globalThis.requestAnimationFrame = (act) => frames.push(act);
globalThis.Worker = class {
  constructor() { worker = this; }
  postMessage(data) { this.asked = data.id; }
};
const settle = () => {
  worker.onmessage({ data: { id: worker.asked, order: new Uint32Array(0) } });
  while (frames.length) frames.shift()();
};
const drag = (dy) => {
  heard.pointerdown({ pointerId: 1, clientX: 0, clientY: 0 });
  heard.pointermove({ pointerId: 1, clientX: 0, clientY: dy, buttons: 1 });
  settle();
};
"""


def without_browser(page: bytes, doings: str, fragment: str = "") -> Any:
    """Run a page's script and what is done to it under node, and return what that reports."""
    node = shutil.which("node") or pytest.skip("no node on the PATH")
    texts = dict(re.findall(r'<script id="([\w-]+)" type="[^"]+">(.*?)</script>', page.decode(), re.DOTALL))
    given = f"const texts = {json.dumps(texts)}, hash = {json.dumps(fragment)};"
    script = f"{given}{WITHOUT_BROWSER}{asset('html', 'viewer.js')}"
    script += f"const begin = () => {{ if (!worker) return setTimeout(begin, 10); settle(); {doings} }};begin();"
    found = subprocess.run([node, "-"], input=script, capture_output=True, text=True, check=True, timeout=100)
    return json.loads(found.stdout)


def test_no_drag_leaps_over_the_pole() -> None:
    page = page_of(many(5), [camera_of(a_view())], TrainConfig(), 3, "x")
    moves = [140, 70, 140, 900, -200, -900, -140]
    # how far the picture's lower edge points down: under 0 the view is upside down
    doings = f"const [x, y, z] = JSON.parse(texts.scene).up; for (const dy of {moves}) drag(dy);"
    doings += "console.log(JSON.stringify(drawn.map((m) => -x * m[1] + y * m[5] + z * m[9])))"
    upright = without_browser(page, doings)
    assert len(upright) > len(moves)
    assert min(upright) > 0.0
    assert max(upright) > 0.9


def test_three_fingers_move_as_two_do_and_turn_nothing() -> None:
    doings = "const finger = (pointerId, clientX) => ({ pointerId, clientX, clientY: 0, buttons: 1 });"
    doings += "for (const id of [1, 2, 3]) heard.pointerdown(finger(id, 40 * id));"
    doings += "for (const id of [1, 2, 3]) { heard.pointermove(finger(id, 40 * id + 10)); settle(); }"
    doings += "console.log(JSON.stringify([drawn[0], drawn.at(-1)]))"
    page = page_of(many(5), [camera_of(a_view())], TrainConfig(), 3, "x")
    before, after = np.array(without_browser(page, doings)).reshape(2, 4, 4)
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-12)
    assert np.abs(after[3] - before[3]).max() > 0.1


@pytest.mark.parametrize(
    ("asked", "found"), [("1", 1), ("-7", 2), ("4e2", 1), ("1.5", None), ("1e999", None), ("x", None)]
)
def test_any_number_of_a_camera_in_the_address_names_a_camera(asked: str, found: int | None) -> None:
    cameras = [camera_of(a_view((x, 0.0, -6.0))) for x in (0.0, 1.0, 2.0)]
    page = page_of(many(5), [replace(c, name=f"{i}") for i, c in enumerate(cameras)], TrainConfig(), 3, "x")
    doings = "console.log(JSON.stringify(elements.name.textContent))"
    expected = str(first_view(cameras) if found is None else found)
    assert without_browser(page, doings, f"#camera={asked}") == expected


def test_in_a_frame_the_wheel_scrolls_the_page_around_it_until_the_picture_is_clicked() -> None:
    doings = "let focused = false; const taken = []; document.hasFocus = () => focused;"
    doings += "for (const [parent, click] of [[{}, false], [{}, true], [window, false]]) { window.parent = parent;"
    doings += "focused = click; let mine = 0; heard.wheel({ deltaY: 9, preventDefault() { mine += 1; } });"
    doings += "taken.push(mine); } console.log(JSON.stringify(taken))"
    page = page_of(many(5), [], TrainConfig(), 3, "x")
    assert without_browser(page, doings) == [0, 1, 1]


def test_that_the_graphics_card_is_lost_is_said_until_the_page_is_loaded_again() -> None:
    page = page_of(many(5), [], TrainConfig(), 3, "x")
    doings = "const before = elements.message.textContent; lost = true; heard.webglcontextlost(); drag(20);"
    doings += "console.log(JSON.stringify([before, elements.message.textContent]))"
    before, after = without_browser(page, doings)
    assert before == ""
    assert "load it again" in after


def test_an_empty_splat_and_a_lone_one_have_pages(tab: Browser, tmp_path: Path) -> None:
    for n in (0, 1):
        assert shown(tab, page_in(tmp_path, n, background=(0.0, 1.0, 0.0)))[0, 0].tolist() == [0, 255, 0]


def test_views_turn_about_the_point_that_all_cameras_look_at_or_the_median_gaussian() -> None:
    cameras = [camera_of(a_view(place)) for place in ((0.0, -1.0, -6.0), (5.0, -1.0, 0.0), (0.0, 2.0, 3.0))]
    distances = view_distances(cameras, many(200)["means"])
    np.testing.assert_allclose(distances, [np.linalg.norm(camera.eye) for camera in cameras], rtol=1e-6)
    # cameras that look the same way
    viewmats = [np.eye(4), np.eye(4)]
    for viewmat, x in zip(viewmats, (0.0, 0.5), strict=True):
        viewmat[:3, 3] = [x, 0.0, 7.0]
    alike = [PageCamera("x", viewmat, np.eye(3), 10, 10) for viewmat in viewmats]
    assert view_distances(alike, many(2000)["means"]) == pytest.approx([7.0, 7.0], abs=0.2)


def test_a_page_of_a_walk_starts_with_its_first_camera() -> None:
    lens = np.array([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]])
    stands = [PageCamera(str(i), camera, lens, 40, 40) for i, camera in enumerate(walk())]
    assert first_view(stands) == first_view(stands[::-1]) == 0


def test_a_page_starts_where_most_photographs_stand_with_the_subject_in_the_middle() -> None:
    def stand(degrees: float, distance: float, aside: float = 0.0) -> PageCamera:
        angle = np.radians(degrees)
        viewmat = look_at(distance * np.array([np.sin(angle), 0.0, -np.cos(angle)]))
        viewmat[0, 3] += aside
        lens = np.array([[100.0, 0.0, 60.0], [0.0, 100.0, 45.0], [0.0, 0.0, 1.0]])
        return PageCamera(f"{degrees}", viewmat, lens, 120, 90)

    arc = [stand(degrees, 4.0) for degrees in (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0)]
    assert first_view(arc) == 3
    # one that stands apart does not become the first, nor one that cuts the subject, nor one that looks past it
    assert first_view([stand(160.0, 4.0), *arc]) == 4
    assert first_view([*arc, stand(0.0, 1.5)]) == 3
    assert first_view([*arc[:3], stand(0.0, 4.0, aside=1.9), *arc[4:]]) in {2, 4}
    assert first_view(arc[:1]) == 0


def test_a_splat_without_cameras_is_seen_from_the_front() -> None:
    means = many(500)["means"] + torch.tensor([4.0, 0.0, 0.0])
    camera = camera_of_points(means)
    seen = means.double().numpy() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * camera.K[0, 0] + camera.K[:2, 2]
    inside = (seen[:, 2] > 0) & (pixels >= 0).all(1) & (pixels <= [camera.width, camera.height]).all(1)
    assert inside.mean() > 0.7


def test_a_large_capture_gives_sixty_cameras_evenly() -> None:
    views = tiny_capture(n_views=200).views
    cameras = cameras_of(views)
    assert (len(cameras), cameras[0].name, cameras[-1].name) == (60, views[0].name, views[-1].name)


def test_a_name_that_is_no_text_is_a_title_with_escapes() -> None:
    assert b"<title>sc\\udce8ne</title>" in page_of(many(5), [], TrainConfig(), 3, "sc\udce8ne")
