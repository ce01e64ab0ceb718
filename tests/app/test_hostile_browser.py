"""The viewer against pages of other people: who is let in, what is read of them, and that a training never hears of it.

Everything stays on the loopback interface, and counts and times are bounded.
"""

from __future__ import annotations

import contextlib
import http.client
import math
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import torch
import zstandard

pytest.importorskip("viser", reason="pip install 'viser>=1.1,<1.2'")

import viser
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request
from websockets.sync.client import connect

from pop_fast.cli import view as cli_view
from pop_fast.cli.view import LiveView, stands_of_capture
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train.checkpoint import load_splats
from pop_fast.view.live.draw import scene_of
from pop_fast.view.live.guard import MOST_VIEWS, Guard, interval, listen, number, one_of, passed_on
from pop_fast.view.live.server import LiveViewer
from tests.app.conftest import TRAIN, Outcome, Pop, wait_until
from tests.app.damage import says
from tests.app.tiny import tiny_capture, tiny_config

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
# with which code the server closes what an attack begins
ENDS = {"nan": 1008, "zero": 1008, "text": 1008, "share": 1008, "unshare": 1008, "long": 1009}
LAST = "ckpts/ckpt_29_rank0.pt"


class Client:
    """A program that says what it likes to the viewer."""

    def __init__(self, url: str, path: str | None = None, host: str = "", **options: Any) -> None:
        at = urlsplit(url)
        own = {"origin": f"http://{host or at.netloc}", "subprotocols": [f"viser-v{viser.__version__}"]}
        # the address that is dialled stays, whatever Host says
        dialled = socket.create_connection((at.hostname or "", at.port or 0), timeout=5.0)
        # a server that has nothing to say for longer is no server that has closed
        dialled.settimeout(None)
        asked = f"ws://{host or at.netloc}{(at.path if path is None else path).rstrip('/')}"
        settings = {"sock": dialled, "max_size": None, "proxy": None, "close_timeout": 1.0, **own, **options}
        self.connection = connect(asked, **settings)
        self.kept: list[dict[str, Any]] = []

    def say(self, *messages: dict[str, Any]) -> None:
        for message in messages:
            self.connection.send(msgspec.msgpack.encode(message))

    def hear(self, kind: str, seconds: float = 10.0) -> dict[str, Any]:
        """Wait for a message of this type; those that came with it or before it are kept."""
        until = time.monotonic() + seconds
        while True:
            for message in self.kept:
                if message["type"] == kind:
                    self.kept.remove(message)
                    return message
            data = bytes(self.connection.recv(timeout=max(until - time.monotonic(), 0.0)))
            packed = data[16 : 16 + int.from_bytes(data[8:16], "little")]
            content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(packed))
            self.kept += content["messages"]

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
        {"path": "/%C3%A9"},
    ],
    ids=str,
)
def test_nobody_else_gets_a_socket(viewer: LiveViewer, options: dict[str, Any]) -> None:
    told = {key: value.format(port=viewer.port) if value else value for key, value in options.items()}
    with pytest.raises(InvalidStatus) as refused:
        Client(viewer.url, **told)
    assert refused.value.response.status_code == 403
    assert viewer._guard.token.encode() not in refused.value.response.body


def test_nobody_is_there_to_publish_the_server(viewer: LiveViewer) -> None:
    handlers = {kind.__name__ for kind in viewer._server._websock_server._incoming_handlers}
    assert "GuiUpdateMessage" in handlers
    assert not [name for name in handlers if name.startswith("Share")]


def page(viewer: LiveViewer, path: str = "", **headers: str) -> http.client.HTTPResponse:
    asked = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=5.0)
    told = {key: value.format(port=viewer.port) for key, value in headers.items()}
    asked.request("GET", path or urlsplit(viewer.url).path, headers=told)
    return asked.getresponse()


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
    answer = page(viewer, path, **headers)
    assert answer.status == status
    if status == 200:
        assert "frame-ancestors 'none'" in (answer.headers["Content-Security-Policy"] or "")
        assert answer.headers["Referrer-Policy"] == "no-referrer"


def test_a_training_does_not_hear_of_hostile_clients_and_ends_with_the_same_bits(
    pop, shared_capture, shared_result, tmp_path, monkeypatch
):
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
    outcome = pop.done(*words)
    attacks[0].was_repelled(outcome)
    assert not shared
    lines = [line for line in outcome.err.splitlines() if line.startswith("note: the viewer closed a view: ")]
    for part in ("wxyz [nan", "length 0", "chose 'abc'", "ShareUrlRequest"):
        assert sum(part in line for line in lines) == 1, (part, outcome.err)
    alone, watched = (load_splats(folder / LAST)[0] for folder in (shared_result, tmp_path / "watched"))
    for name, tensor in alone.items():
        assert torch.equal(tensor, watched[name]), name


def test_the_command_that_shows_a_splat_goes_on_after_hostile_clients(pop, shared_result, monkeypatch):
    attacks: list[Attack] = []

    def wait(viewer: LiveViewer, *given: Any) -> None:
        if not attacks:
            attacks.append(Attack(viewer.url))
        if not attacks[0].is_alive():
            raise KeyboardInterrupt
        wait_as_ever(viewer, *given)

    wait_as_ever = LiveViewer.wait
    monkeypatch.setattr(LiveViewer, "wait", wait)
    outcome = pop.done("view", shared_result, "--port", 18_850)
    attacks[0].was_repelled(outcome)


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
            mode = watching.hear("GuiDropdownMessage", 30.0)["uuid"]
            watching.hear("BackgroundImageMessage", 30.0)
            self.pictures += 1
            self.ends["zero"] = self.after(CAMERA | {"wxyz": [0, 0, 0, 0]})
            # one message at a time: what is sent to a view that is closed meets nobody
            self.ends["share"] = self.after({"type": "ShareUrlRequest"})
            self.ends["unshare"] = self.after({"type": "ShareUrlDisconnect"})
            long = Client(self.url)
            with contextlib.suppress(ConnectionClosed):
                # closed while it is still being sent; what the server says last may then be lost
                long.connection.send(bytes(60 * 2**20))
            self.ends["long"] = long.end() or 1009
            watching.say({"type": "GuiUpdateMessage", "uuid": mode, "updates": {"value": "abc"}})
            self.ends["text"] = watching.end()
            with ThreadPoolExecutor(16) as pool:
                list(pool.map(lambda _: self.try_to_enter(), range(200)))
        except BaseException as error:
            self.error = error

    def was_repelled(self, outcome: Outcome) -> None:
        assert self.error is None, self.error
        assert self.ends == ENDS
        assert self.pictures > 0
        assert len(self.inside) <= MOST_VIEWS
        assert "Traceback" not in outcome.err

    def after(self, *messages: dict[str, Any]) -> int:
        client = Client(self.url)
        client.say(*messages)
        return client.end()

    def try_to_enter(self) -> None:
        with contextlib.suppress(InvalidStatus, ConnectionClosed, OSError, EOFError):
            self.inside.append(Client(self.url))


def test_an_error_in_a_view_closes_that_view_with_one_line(viewer, monkeypatch, capsys):
    def draw(state: Any) -> Any:
        if state.height == 31:
            raise RuntimeError("out of\nmemory")
        return draw_as_ever(state)

    draw_as_ever = viewer._scene.draw
    monkeypatch.setattr(viewer._scene, "draw", draw)
    good, bad = Client(viewer.url), Client(viewer.url)
    good.say(CAMERA)
    bad.say(CAMERA | {"image_height": 31})
    wait_until(lambda: len(viewer._views) == 2)
    until, drawn = time.monotonic() + 20.0, 0
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
    assert page(viewer).status == 200


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


RULES = {"mode": one_of(("colour", "depth")), "opacity": number, "x": interval(-2.0, 3.0)}


def setting(control: Any, value: Any, **more: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": control, "updates": {"value": value, **more}}


def test_what_a_browser_sends_is_passed_on() -> None:
    # a number is sent while it is typed: 5 of 50, or -1
    typed = [setting("opacity", value) for value in (1, 5, -1, 0.25)]
    for message in (CAMERA, setting("mode", "depth"), *typed, setting("x", [-2, 2.5])):
        assert passed_on(msgspec.msgpack.encode(message), RULES)
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
    "message",
    [
        *(setting("mode", value) for value in ("abc", 3)),
        *(setting("opacity", value) for value in ("abc", math.nan, 1e300, [0.5])),
        *(setting("x", value) for value in ([3.0, -2.0], [0.0], [math.nan, 1.0], 1.0)),
        setting("other", 1.0),
        setting("mode", "depth", update_cb=3),
        setting(["mode"], "depth"),
        *("text", b"\xc1", b"", b"\x91" * 5000, msgspec.msgpack.encode([1])),
        *({}, {"type": 3}, {"type": "RunJavascriptMessage", "source": "1"}, {"type": "FileTransferStartUpload"}),
        {"type": "SceneNodeClickMessage", "name": 3},
    ],
    ids=str,
)
def test_what_is_no_message_of_the_page_or_not_what_a_control_offers_is_refused(message: Any) -> None:
    assert "\n" not in no_message(message)


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid", "300.1.1.1", "é" * 70])
def test_an_address_that_is_not_ours_is_refused_within_a_second(host: str) -> None:
    begun = time.monotonic()
    with pytest.raises(PopError, match="the viewer cannot listen on"):
        listen(host, 18_900)
    assert time.monotonic() - begun < 1.5


def test_it_is_said_before_a_splat_or_photographs_are_read(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    train = ("train", shared_capture, "--out", tmp_path / "r", "--view", "--view-host")
    for words in (("view", "absent", "--host"), train):
        outcome = pop(*words, "192.0.2.1")
        says(outcome, "the viewer cannot listen on 192.0.2.1:8080 (")
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
        # a path with a byte that is no text
        assert (guard.refusal(Request("/\udce9", headers), arrived_at) or [0])[0] == 403
        headers["Host"] = f"{named}:{port}"
        # a second one, which others on the way may read instead of the first
        assert guard.refusal(Request(f"/{guard.token}", headers), arrived_at)


def test_a_port_that_is_in_use_is_left_to_who_has_it() -> None:
    with listen("127.0.0.1", 18_950) as first, listen("127.0.0.1", first.getsockname()[1]) as second:
        assert second.getsockname()[1] > first.getsockname()[1]
        with pytest.raises(PopError, match="no free port from"):
            listen("127.0.0.1", first.getsockname()[1], tries=1)
