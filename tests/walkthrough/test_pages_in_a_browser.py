"""Pages in a browser: on a desktop and a phone, light and dark, nothing sticks out or complains; widgets answer.

Chapters and the contents fit their windows. Widgets appear, answer to sliders, fingers and keys. `splat.py` in the
page is asked for by a click, handed on as it is, and a sentence says where there is no network. Pyodide itself, and
NumPy for it, lie on a content network and on no package index, so a stand-in is served from this machine: it has
Pyodide's names, runs no Python, and says what it was asked. What is real here is the page, its worker, and the file
that the stand-in is handed; `test_splat.py` runs that file.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from pop_ref.learn import splat
from pop_ref.walkthrough.builder.chapter import read_chapter
from pop_ref.walkthrough.builder.layout import asset, chapter_page, index_page
from pop_ref.walkthrough.widgets import FOLDER as WIDGET_FOLDER
from pop_ref.walkthrough.widgets import PYODIDE, WIDGETS, html
from tests import browser
from tests.browser import SCREENSHOTS, Page, keep
from tests.walkthrough.conftest import CHAPTERS, ran

# how a page is opened; it is then looked at with the other preference too
OPENED = [(900, False), (400, True)]
# what is wider than its own box and neither scrolls nor is cut off there
STICKS_OUT = """[...document.querySelectorAll('main *')].filter(each => {
    const box = each.getBoundingClientRect();
    const scrolls = each.closest('pre, .wide, .math.block, svg');
    return box.width && box.right > innerWidth + 1 && !scrolls;
}).map(each => each.tagName + ' ' + each.className + ' ' + each.textContent.slice(0, 60))"""


def _looked_at(page: Page, file: Path) -> None:
    for width, dark in OPENED:
        page.open(file, width=width, dark=dark)
        # answers, too, must fit
        page.ask("document.querySelectorAll('details').forEach(each => { each.open = true; })")
        _is_sound(page, file.stem, width, dark)
        page.switch(dark=not dark)
        _is_sound(page, file.stem, width, not dark)


def _is_sound(page: Page, name: str, width: int, dark: bool) -> None:
    _wait_ms(page, 100)
    assert page.complaints == []
    assert page.ask("document.documentElement.scrollWidth") <= width, page.ask(STICKS_OUT)
    assert page.ask(STICKS_OUT) == []
    paper = page.ask("getComputedStyle(document.body).backgroundColor")
    assert (sum(int(each) for each in paper[4:-1].split(",")) < 300) == dark
    # an ink that would vanish on this paper
    assert page.ask("getComputedStyle(document.body).color") != paper
    # of a whole page it takes seconds
    if SCREENSHOTS or name == "index":
        keep(page.picture("body"), f"{name}_{width}_{'dark' if dark else 'light'}.png")


@pytest.mark.slow
@pytest.mark.parametrize("path", CHAPTERS, ids=lambda path: path.stem)
def test_a_page_fits_its_window_and_complains_of_nothing(page: Page, path: Path, tmp_path: Path) -> None:
    chapter, outcomes = ran(path)
    file = tmp_path / chapter.page
    file.write_text(chapter_page(chapter, outcomes, [read_chapter(each) for each in CHAPTERS]), encoding="utf-8")
    _looked_at(page, file)
    widgets = page.ask("[...document.querySelectorAll('.pop-widget')].map(each => each.hidden)")
    assert len(widgets) == sum(cell.text.count("{{widget: ") for cell in chapter.cells)
    assert not any(widgets)


@pytest.mark.slow
def test_a_printed_function_opens_when_its_stage_is_passed_or_at_the_second_click(page: Page, tmp_path: Path) -> None:
    chapter, outcomes = ran(CHAPTERS[2])
    written = chapter_page(chapter, outcomes, [read_chapter(each) for each in CHAPTERS])
    for name in ("first.html", "second.html"):
        (tmp_path / name).write_text(written, encoding="utf-8")
    opened = "[...document.querySelectorAll('details.yours')].map(each => [each.dataset.stage, each.open])"
    page.open(tmp_path / "first.html")
    stages = [stage for stage, _ in page.ask(opened)]
    assert set(stages) == {"activations", "optimizer"}
    assert not any(is_open for _, is_open in page.ask(opened))
    click = "document.querySelector('details.yours summary').click()"
    page.ask(click)
    assert not any(is_open for _, is_open in page.ask(opened))
    assert f"pop learn check {stages[0]}" in page.ask("document.querySelector('details.yours summary').textContent")
    page.ask(click)
    assert [is_open for _, is_open in page.ask(opened)] == [True] + [False] * (len(stages) - 1)
    # the names of passed stages, as `pop learn check` prints them behind an address
    page.open(tmp_path / "second.html", fragment="#passed=tiles,optimizer")
    assert page.ask(opened) == [[stage, stage == "optimizer"] for stage in stages]
    assert set(page.ask("[...document.querySelectorAll('nav a')].map(a => a.hash)")) == {"#passed=tiles,optimizer"}


@pytest.mark.slow
def test_the_contents_fits_its_window_and_complains_of_nothing(page: Page, tmp_path: Path) -> None:
    file = tmp_path / "index.html"
    beside = {"notebooks": "notebooks", "slides": "slides.html", "PDF": "walkthrough.pdf"}
    file.write_text(index_page([read_chapter(each) for each in CHAPTERS], beside), encoding="utf-8")
    _looked_at(page, file)


NAMES = list(WIDGETS)
SPLAT = (Path(__file__).resolve().parents[2] / "pop_ref" / "learn" / "splat.py").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("widgets")
    texts = {name: html(name) for name in NAMES} | {"all": "".join(html(name) for name in NAMES)}
    for name, text in texts.items():
        _write_page(folder / f"{name}.html", text)
    return {name: folder / f"{name}.html" for name in texts}


# whatever sticks out of its widget, but for what is clipped
BEYOND = """[...document.querySelectorAll('.pop-widget :is(dd, dt, output, button, h4, h5, p, canvas, input, text)')]
    .filter(each => !each.closest('[clip-path]'))
    .filter(each => {
        const box = each.getBoundingClientRect(), room = each.closest('.pop-widget').getBoundingClientRect();
        return box.width && (box.left < room.left - 1 || box.right > room.right + 1); })
    .map(each => each.tagName + ' ' + each.textContent)"""

# letters that stick out of the drawing that they are in
CUT = """[...document.querySelectorAll('.pop-widget svg text')].filter(each => {
    const box = each.getBoundingClientRect(), room = each.ownerSVGElement.getBoundingClientRect();
    const out = box.left < room.left - 1 || box.right > room.right + 1 || box.top < room.top - 2;
    return box.width && each.getAttribute('opacity') !== '0' && (out || box.bottom > room.bottom + 2);
}).map(each => each.textContent)"""


def _image(png: bytes) -> np.ndarray:
    return matplotlib.image.imread(io.BytesIO(png), format="png")[..., :3]


def _write_page(file: Path, text: str) -> None:
    style = f"<style>{asset('page.css')}</style>"
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width">{style}'
    file.write_text(f"<!doctype html><html><head>{head}</head><body><main>{text}</main></body></html>", "utf-8")


def _wait_ms(page: Page, ms: int) -> None:
    page.ask(f"new Promise(done => setTimeout(() => done(1), {ms}))")


def _settle(page: Page) -> None:
    page.ask("new Promise(done => setTimeout(() => requestAnimationFrame(() => done(1)), 60))")


def test_an_unknown_name_is_named() -> None:
    with pytest.raises(ValueError, match="there is no widget 'splat3d'; use one of splat2d, stack"):
        html("splat3d")


@pytest.mark.parametrize("name", NAMES)
def test_the_markup_loads_nothing_and_stays_hidden_without_scripts(name: str) -> None:
    text = html(name)
    assert ("importScripts(" in text) == (PYODIDE in text) == (name == "python")
    # what is handed to Pyodide, when a reader asks for it, is no script of the page
    for piece in (json.dumps(SPLAT), json.dumps(PYODIDE), "import runpy; "):
        text = text.replace(piece, "")
    style = "".join(re.findall(r"<style>(.*?)</style>", text, re.DOTALL))
    assert not re.search(r"@import|url\(", style)
    assert not re.search(r"\b(fetch|XMLHttpRequest|import)\b|\bsrc=|https?://(?!www\.w3\.org/2000/svg)", text)
    assert f'data-widget="{name}"' in text
    assert " hidden>" in text
    assert "<noscript>" in text
    # what is about 200 lines is read; what is longer is not
    assert len((WIDGET_FOLDER / f"{name}.js").read_text(encoding="utf-8").splitlines()) <= 260


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [900, 400])
@pytest.mark.parametrize("name", NAMES)
def test_a_widget_is_drawn_without_complaint_and_fits(
    page: Page, files: dict[str, Path], name: str, width: int, dark: bool
) -> None:
    page.open(files[name], width=width, dark=dark)
    _settle(page)
    assert page.complaints == []
    assert page.ask("document.documentElement.scrollWidth") == width
    assert page.ask(BEYOND) == []
    assert page.ask(CUT) == []
    png = page.picture(".pop-widget")
    keep(png, f"widget_{name}_{width}_{'dark' if dark else 'light'}.png")
    image = _image(png)
    ground = image[image.shape[0] // 2, 4]
    assert (ground.mean() < 0.3) == dark
    # something stands on the ground, in more than one colour
    inked = np.abs(image - ground).max(axis=-1) > 0.2
    assert 0.02 < inked.mean() < 0.9
    assert np.ptp(image[inked], axis=-1).max() > 0.3


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("train", "python")])
def test_every_slider_changes_the_picture(page: Page, files: dict[str, Path], name: str) -> None:
    page.open(files[name])
    _settle(page)
    n_sliders = page.ask("document.querySelectorAll('input[type=range]').length")
    assert n_sliders >= 1
    for i in range(n_sliders):
        page.open(files[name])
        _settle(page)
        drawn = "[...document.querySelectorAll('canvas')].map(c => c.toDataURL()).join() + " + (
            "[...document.querySelectorAll('svg')].map(s => s.innerHTML).join()"
        )
        before = page.ask(drawn)
        page.ask(f"document.querySelectorAll('input[type=range]')[{i}].focus()")
        label = page.ask("document.activeElement.getAttribute('aria-label')")
        told = page.ask("document.activeElement.getAttribute('aria-valuetext')")
        for key in ("ArrowLeft", "ArrowLeft"):
            page.press(key)
        assert page.ask("document.activeElement.getAttribute('aria-valuetext')") != told, label
        assert page.ask(drawn) != before, label
    assert page.complaints == []


@pytest.mark.parametrize("name", NAMES)
def test_what_can_be_reached_by_keyboard_has_a_name(page: Page, files: dict[str, Path], name: str) -> None:
    page.open(files[name])
    nameless = """[...document.querySelectorAll('.pop-widget :is(input, button, [tabindex])')]
        .filter(each => !(each.getAttribute('aria-label') || each.textContent.trim())).map(each => each.outerHTML)"""
    assert page.ask(nameless) == []
    assert page.ask("document.querySelector('.pop-widget').getAttribute('aria-label')") == WIDGETS[name].title


def _middle(page: Page, selector: str) -> tuple[float, float]:
    box = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
    x, y = page.ask(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
    return x, y


def _reading(page: Page, label: str) -> str:
    return page.ask(
        f"[...document.querySelectorAll('dt')].find(d => d.textContent === {json.dumps(label)}).nextSibling.textContent"
    )


def test_a_splat_is_dragged_by_mouse_finger_and_arrow_keys(page: Page, files: dict[str, Path]) -> None:
    centre = "[aria-label^='centre of the splat']"
    place = f"document.querySelector({json.dumps(centre)}).getAttribute('transform')"
    page.open(files["splat2d"])
    assert page.ask(place) == "translate(12.1 7.4)"
    x, y = _middle(page, centre)
    step = page.ask("document.querySelector('.pw-over').clientWidth") / 24
    page.drag((x, y), (x + 3 * step, y + 2 * step))
    numbers = [float(each) for each in re.findall(r"[\d.]+", page.ask(place))]
    assert np.allclose(numbers, [15.1, 9.4], atol=0.1)
    page.press("ArrowLeft")
    assert np.allclose(float(re.findall(r"[\d.]+", page.ask(place))[0]), numbers[0] - 0.25)
    page.open(files["splat2d"], width=400)
    x, y = _middle(page, centre)
    page.touch((x, y), (x - 40, y))
    assert float(re.findall(r"[\d.]+", page.ask(place))[0]) < 11
    assert page.complaints == []


def test_splats_of_a_stack_change_places_and_a_wall_ends_the_pixel(page: Page, files: dict[str, Path]) -> None:
    page.open(files["stack"])
    order = """[...document.querySelectorAll('.pw-row')].sort((a, b) => a.style.order - b.style.order)
        .map(row => row.querySelector('input').getAttribute('aria-label').replace('alpha of ', ''))"""
    assert page.ask(order) == ["red", "yellow", "green", "blue", "violet"]
    page.ask("document.querySelector('[aria-label=\"send red farther\"]').focus()")
    page.press("Enter")
    assert page.ask(order) == ["yellow", "red", "green", "blue", "violet"]
    x, y = _middle(page, ".pw-row:nth-of-type(5) .pw-swatch")
    page.drag((x, y), (x, y - 90))
    assert page.ask(order).index("violet") < 4
    page.ask("[...document.querySelectorAll('button')].find(b => b.textContent === 'two walls').click()")
    shown = page.ask("document.querySelector('.pw-wide svg').textContent")
    assert "stop" in shown
    dim = "[...document.querySelectorAll('.pw-row')].map(row => row.dataset.dim)"
    assert page.ask(dim) == ["false", "false", "true", "true", "true"]
    assert page.complaints == []


def test_a_globe_turns_and_a_gaussian_is_walked_around(page: Page, files: dict[str, Path]) -> None:
    for name, reading in (("harmonics", "direction d, camera to Gaussian"), ("orbit", "by EWA")):
        page.open(files[name])
        _settle(page)
        before = _reading(page, reading)
        page.ask("document.querySelector('[role=application]').focus()")
        page.press("ArrowRight")
        turned = _reading(page, reading)
        assert turned != before
        x, y = _middle(page, "[role=application]")
        page.drag((x, y), (x + 60, y + 20))
        assert _reading(page, reading) != turned
        # a second finger turns nothing nor ends the first one's turn, and the menu's button turns nothing
        steps = [
            ("Start", (0, 0)),
            ("Start", (0, 0), (40, 9)),
            ("Move", (0, 0), (70, 9)),
            ("Move", (0, 0)),
            ("Move", (30, 0)),
        ]
        seen = []
        for kind, *fingers in steps:
            points = [{"x": x + dx, "y": y + dy, "id": i} for i, (dx, dy) in enumerate(fingers)]
            page.call("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=points)
            _settle(page)
            seen.append(_reading(page, reading))
        assert len(set(seen[:4])) == 1
        assert seen[4] != seen[3]
        page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        before = _reading(page, reading)
        for kind, dx in (("mousePressed", 0), ("mouseMoved", 30), ("mouseReleased", 30)):
            page.call("Input.dispatchMouseEvent", type=kind, x=x + dx, y=y, button="right", buttons=2, clickCount=1)
        assert _reading(page, reading) == before
        assert page.complaints == []


def test_the_names_of_directions_stand_on_the_globe_and_not_in_its_ring(page: Page, files: dict[str, Path]) -> None:
    page.open(files["harmonics"])
    _settle(page)
    # how far the corners of each name are from the globe's middle, in its radii; the ring's is a tenth
    corners = """[...document.querySelectorAll('svg.pw-over text')].filter(each => each.getAttribute('opacity') > 0.5)
        .map(each => { const [box, globe] = [each, each.ownerSVGElement].map(one => one.getBoundingClientRect());
            const far = (x, y) => Math.hypot(x - globe.x - globe.width / 2, y - globe.y - globe.height / 2);
            const [xs, ys] = [[box.left, box.right], [box.top + 3, box.bottom - 3]];
            const all = xs.flatMap(x => ys.map(y => 2 * far(x, y) / globe.width));
            return [Math.min(...all), Math.max(...all)]; })"""
    assert len(page.ask(corners)) == 3
    for _ in range(8):
        for nearest, farthest in page.ask(corners):
            assert nearest > 0.1
            assert farthest < 1.01
        page.ask("document.querySelector('[role=application]').focus()")
        for key in ("ArrowRight", "ArrowRight", "ArrowDown"):
            page.press(key)


def _trained(page: Page, steps: int) -> list[float]:
    """Wait until the page has taken so many steps, and read the PSNRs of both trainings."""
    done = """new Promise(done => { const look = () => {
        const step = Number((document.querySelector('[role=status]').textContent.match(/step (\\d+)/) || [])[1]);
        step >= %d ? done(1) : setTimeout(look, 50); }; look(); })"""
    page.ask(done % steps)
    shown = "[...document.querySelectorAll('dt')].filter(d => d.textContent.startsWith('PSNR'))"
    return page.ask(f"{shown}.map(d => parseFloat(d.nextSibling.textContent))")


def _click(page: Page, text: str) -> None:
    page.ask(f"[...document.querySelectorAll('button')].find(b => b.textContent === {json.dumps(text)}).click()")


def test_a_page_trains_without_and_with_the_prior(page: Page, files: dict[str, Path]) -> None:
    page.open(files["train"])
    drawn = "[...document.querySelectorAll('canvas')].map(c => c.toDataURL())"
    before = _trained(page, 0)
    assert before[0] == before[1]
    grey, _, photo = page.ask(drawn)
    _click(page, "train")
    after = _trained(page, 30)
    _click(page, "pause")
    assert min(after) > max(before) + 1.0
    without, with_prior, still = page.ask(drawn)
    assert len({grey, without, with_prior, photo}) == 4
    assert still == photo
    # another side: the photograph turns, the training stays
    page.ask("document.querySelector('[aria-label=\"look from\"]').focus()")
    page.press("ArrowRight")
    _settle(page)
    _wait_ms(page, 600)
    assert page.ask(drawn)[2] != photo
    for _ in range(14):
        page.press("ArrowRight")
        _wait_ms(page, 120)
    _click(page, "start again")
    _wait_ms(page, 600)
    assert _trained(page, 0) == before
    # whoever has looked around for long still sees the training go on, a few steps at a time
    shown = "Number(document.querySelector('[role=status]').textContent.match(/step (\\d+)/)[1])"
    _click(page, "train")
    _trained(page, 2)
    assert page.ask(shown) < 300
    assert page.complaints == []


def test_what_a_slider_of_the_training_says_reaches_it(page: Page, files: dict[str, Path]) -> None:
    """Two steps with each slider at its end: the side with the prior differs from that of two steps without a touch."""
    page.open(files["train"])
    told = """(() => { const s = [...document.querySelectorAll('canvas')].map(c => c.toDataURL()).join();
        return s + [...document.querySelectorAll('dd')].map(d => d.textContent).join(); })()"""
    labels = page.ask("[...document.querySelectorAll('input')].map(i => i.getAttribute('aria-label'))")
    seen = set()
    for label in ["", *labels[:1], *labels[2:6]]:
        page.open(files["train"])
        _trained(page, 0)
        if label:
            page.ask(f"document.querySelector('[aria-label={json.dumps(label)}]').focus()")
            page.press("End")
        for step in range(1, 4):
            _click(page, "one step")
            _trained(page, step)
        seen.add(page.ask(told))
    assert len(seen) == 6, labels
    assert page.complaints == []


def test_all_stand_on_one_page_and_none_without_scripts(page: Page, files: dict[str, Path]) -> None:
    page.open(files["all"])
    _settle(page)
    assert page.complaints == []
    assert page.ask("document.querySelectorAll('.pop-widget:not([hidden]) .pw-body').length") == len(NAMES)
    ids = page.ask("[...document.querySelectorAll('[id]')].map(each => each.id)")
    assert len(ids) == len(set(ids))
    page.open(files["all"], scripts=False)
    assert page.ask("document.querySelectorAll('.pop-widget[hidden]').length") == len(NAMES)
    assert page.ask("document.body.innerText").count("where JavaScript is allowed") == len(NAMES)


# the names of Pyodide's that the worker uses; "running" prints the file that was written, then the options
STAND_IN = """
globalThis.loadPyodide = async (options) => {
  const files = {}, loaded = [];
  const stat = (name) => ({ mtime: files[name].at });
  return {
    loadPackage: async (name) => { loaded.push(name); },
    FS: {
      writeFile: (name, data) => { files[name] = { data, at: new Date(1) }; },
      readFile: (name) => files[name].data,
      analyzePath: (name) => ({ exists: name in files }),
      stat,
    },
    runPythonAsync: async (code) => {
      options.stdout(JSON.stringify({ code, loaded, index: options.indexURL, source: files["splat.py"].data }));
      if (FAILS) throw new Error("Traceback (most recent call last):\\n  ...\\nMemoryError: no room\\n");
      const png = await (await fetch(options.indexURL + "splat.png")).arrayBuffer();
      files["splat.png"] = { data: new Uint8Array(png), at: new Date(2) };
      options.stdout("step   50");
    },
  };
};
"""


class _Quiet(SimpleHTTPRequestHandler):
    asked: list[str]

    def end_headers(self) -> None:
        self.asked.append(self.path)
        self.send_header("Access-Control-Allow-Origin", "*")
        super().end_headers()

    def log_message(self, *_: object) -> None: ...


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, Path, list[str]]]:
    """Serve a folder; give its address, the folder, and the paths that are asked for."""
    handler = type("Handler", (_Quiet,), {"asked": []})
    folder = tmp_path / "served"
    folder.mkdir()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/", folder, handler.asked
    server.shutdown()
    server.server_close()
    thread.join()


def _opened(page: Page, place: Path, address: str, width: int = 900) -> None:
    markup = html("python")
    assert markup.count(json.dumps(PYODIDE)) == 1
    _write_page(place, markup.replace(json.dumps(PYODIDE), json.dumps(address)))
    page.open(place, width=width)


def _wait(told: Callable[[], bool]) -> None:
    until = time.monotonic() + 20.0
    while not told():
        assert time.monotonic() < until, "it did not happen within 20 s"
        time.sleep(0.05)


def _status(page: Page) -> str:
    return page.ask("document.querySelector('[role=status]').textContent")


def test_a_click_hands_python_the_file_as_it_is_and_shows_its_lines_and_its_picture(
    page: Page, served: tuple[str, Path, list[str]], tmp_path: Path
) -> None:
    address, folder, asked = served
    (folder / "pyodide.js").write_text(f"const FAILS = false;{STAND_IN}", encoding="utf-8")
    splat.write_png(folder / "splat.png", np.full((8, 16, 3), [0.9, 0.2, 0.1]))
    _opened(page, tmp_path / "page.html", address, width=400)
    _wait_ms(page, 300)
    assert asked == [], "nothing is loaded before the click"
    page.ask("document.querySelector('button').click()")
    _wait(lambda: _status(page) == "splat.py has ended.")
    first, last, *_ = page.ask("document.querySelector('pre').textContent").split("\n")
    told = json.loads(first)
    assert told["source"].encode() == Path(splat.__file__).read_bytes()
    assert (told["loaded"], told["index"]) == (["numpy"], address)
    # run as a program is, and nothing is added to it
    assert told["code"] == "import runpy; runpy.run_path('splat.py', run_name='__main__')"
    assert last == "step   50"
    assert page.ask("(img => !img.hidden && img.decode().then(() => img.naturalWidth))(document.images[0])") == 16
    assert sorted(asked) == ["/pyodide.js", "/splat.png"]
    assert page.complaints == []
    assert page.ask("document.documentElement.scrollWidth") == 400
    keep(page.picture(".pop-widget"), "widget_python_ran.png")


def test_where_pyodide_cannot_be_reached_a_sentence_says_so_and_what_to_do(
    page: Page, served: tuple[str, Path, list[str]], tmp_path: Path
) -> None:
    address, folder, _ = served
    _opened(page, tmp_path / "page.html", address)
    page.ask("document.querySelector('button').click()")
    _wait(lambda: "From a clone" in _status(page))
    host = address.split("/")[2]
    command = "python -m pop_ref.learn.splat"
    assert _status(page) == f"Pyodide cannot be reached at {host}. From a clone: {command}"
    # what fails in Python is said as Python says it, and the button asks again
    (folder / "pyodide.js").write_text(f"const FAILS = true;{STAND_IN}", encoding="utf-8")
    page.ask("document.querySelector('button').click()")
    _wait(lambda: "splat.py" in _status(page) and "running" not in _status(page))
    assert _status(page) == "splat.py stopped: MemoryError: no room"


def test_the_file_that_is_handed_on_runs_as_a_program_by_runpy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import runpy

    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(splat.__file__, run_name="not_main")
    params, psnr = names["train"](steps=2, size=8, n_views=2, n=5)
    assert np.isfinite(psnr)
    assert len(params["means"]) == 5
    assert (tmp_path / "splat.png").read_bytes().startswith(b"\x89PNG")


def test_a_browser_that_does_not_answer_leaves_no_pipe_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # it ends at once
    monkeypatch.setattr(browser, "find_chromium", lambda: shutil.which("true"))
    before = set(os.listdir("/proc/self/fd"))
    with pytest.raises((AssertionError, BrokenPipeError), match=r"ended|Broken pipe"), browser.browser(tmp_path):
        pass
    assert set(os.listdir("/proc/self/fd")) == before
