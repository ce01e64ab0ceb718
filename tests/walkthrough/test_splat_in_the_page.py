"""`splat.py` in the page: asked for by a click, handed on as it is, and a sentence where there is no network.

Pyodide itself, and NumPy for it, lie on a content network and on no package index, so a stand-in is served from this
machine: it has Pyodide's names, runs no Python, and says what it was asked. What is real here is the page, its worker,
and the file that the stand-in is handed; `test_splat.py` runs that file.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from pop_ref.learn import splat
from pop_ref.walkthrough.builder.layout import asset
from pop_ref.walkthrough.widgets import PYODIDE, html
from tests.walkthrough.chromium import WHY_NOT, Page, keep

pytestmark = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)

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


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with Page() as opened:
        yield opened


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
    text = markup.replace(json.dumps(PYODIDE), json.dumps(address))
    head = (
        f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><style>{asset("page.css")}</style>'
    )
    place.write_text(f"<!doctype html><html><head>{head}</head><body><main>{text}</main></body></html>")
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
    page.ask("new Promise(done => setTimeout(() => done(1), 300))")
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
