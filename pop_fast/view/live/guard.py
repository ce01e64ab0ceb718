"""Which pages may talk to the viewer's server, and how much: checked before viser hears of it.

Any page that a browser has open can send requests to this machine, and with a name that resolves to it (DNS rebinding)
read the answers. So a request must name this server (Host), come from the page that it sent (Origin) and carry the
token of the address that was printed. viser offers none of this, so it is put around the server that viser starts.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import importlib
import ipaddress
import math
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any, Final

from pop_fast.data.cameras import shortened
from pop_fast.errors import PopError

# raises PopError of a value that a control cannot have
Rule = Callable[[Any], None]

_LARGEST: Final = 1e9
_LONGEST_SIDE: Final = 16_384
# a browser counts in steps, and rounds their sum
_SLACK: Final = 1e-3
_VECTORS: Final = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
# the stock page says these too, and nobody here listens
_IDLE: Final = ("FileTransferPartAck", "GuiButtonHoldMessage")


def passed_on(data: Any, rules: Mapping[str, Rule]) -> bool:
    """Tell whether a message is for viser to read, by the rules of the controls; those are under viser's names of them.

    Raises:
        PopError: it is none that the viewer's page sends; says what is wrong with it.
    """
    message = _decoded(data)
    kind = message.pop("type", None)
    if kind in _IDLE:
        return False
    known = {"ViewerCameraMessage": _check_camera, "SceneNodeClickMessage": _check_click}
    if kind == "GuiUpdateMessage":
        _check_update(message, rules)
    elif kind in known:
        known[kind](message)
    else:
        raise PopError(f"a browser asked for {shortened(kind)}, which the viewer does not do")
    return True


def one_of(options: Sequence[str]) -> Rule:
    """Make the rule of a list to choose from, or of a row of buttons."""

    def check(value: Any) -> None:
        if not isinstance(value, str) or value not in options:
            raise PopError(f"a browser chose {shortened(value)}, which was not offered")

    return check


def number(value: Any) -> None:
    """Check what a slider with a box for its number is set to: the page sends any number while it is typed."""
    if not _is_number(value):
        raise PopError(f"a browser set a slider to {shortened(value)}; it takes a number")


def interval(low: float, high: float) -> Rule:
    """Make the rule of a slider with two ends."""

    def check(value: Any) -> None:
        whole = isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))
        if not whole or not low - _SLACK <= value[0] <= value[1] <= high + _SLACK:
            raise PopError(f"a browser set a slider to {shortened(value)}; its two ends lie from {low:g} to {high:g}")

    return check


def flag(value: Any) -> None:
    """Check what a box or a button is set to: the rule of both."""
    if not isinstance(value, bool):
        raise PopError(f"a browser set a box to {shortened(value)}")


def _decoded(data: Any) -> dict[str, Any]:
    try:
        message = importlib.import_module("msgspec.msgpack").decode(data)
    # text instead of bytes, a broken message, one that is too deep
    except (TypeError, ValueError, RecursionError) as error:
        raise PopError(f"a browser sent something that is not a message ({error})") from error
    if not isinstance(message, dict):
        raise PopError("a browser sent something that is not a message")
    return message


def _check_camera(message: dict[str, Any]) -> None:
    if message.keys() != {*_VECTORS, "fov", "near", "far", "image_height", "image_width"}:
        raise PopError("a browser sent a camera with other fields than a camera has")
    for name, length in _VECTORS.items():
        _check_vector(message[name], length, f"a camera with {name}")
    norm = math.hypot(*message["wxyz"])
    if abs(norm - 1.0) > 1e-3:
        raise PopError(f"a browser sent a camera whose quaternion wxyz has length {norm:g}; it must be 1")
    for name in ("near", "far"):
        if not _is_number(message[name]) or message[name] <= 0.0:
            raise PopError(f"a browser sent a camera with {name} {shortened(message[name])}; it must be positive")
    if not _is_number(message["fov"]) or not 0.005 < message["fov"] < 3.1:
        raise PopError(f"a browser sent a camera with fov {shortened(message['fov'])}; it must be in (0.005, 3.1)")
    for name in ("image_height", "image_width"):
        value = message[name]
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _LONGEST_SIDE:
            raise PopError(f"a browser sent a camera with {name} {shortened(value)}; it must be 0 to {_LONGEST_SIDE}")


def _check_click(message: dict[str, Any]) -> None:
    """Check a click on a training camera."""
    fields = {"name", "instance_index", "ray_origin", "ray_direction", "screen_pos", "modifier", "owner"}
    if not message.keys() <= fields or not message.keys() >= fields - {"owner"}:
        raise PopError("a browser sent a click with other fields than a click has")
    _check_vector(message["ray_origin"], 3, "a click with ray_origin")
    _check_vector(message["ray_direction"], 3, "a click with ray_direction")
    _check_vector(message["screen_pos"], 2, "a click with screen_pos")
    for name in ("name", "instance_index", "modifier", "owner"):
        value = message.get(name)
        whole = isinstance(value, int) if name == "instance_index" else isinstance(value, str) and len(value) < 256
        if not whole and (value is not None or name == "name"):
            raise PopError(f"a browser sent a click with {name} {shortened(value)}")


def _check_update(message: dict[str, Any], rules: Mapping[str, Rule]) -> None:
    """Check a value that a control was set to."""
    control, updates = message.get("uuid"), message.get("updates")
    if message.keys() != {"uuid", "updates"} or not isinstance(control, str) or control not in rules:
        raise PopError(f"a browser set {shortened(control)}, which is not a control of the viewer")
    # viser would set any field of the control that is named here
    if not isinstance(updates, dict) or updates.keys() != {"value"}:
        raise PopError("a browser set more of a control than its value")
    rules[control](updates["value"])


def _check_vector(value: Any, length: int, what: str) -> None:
    if not isinstance(value, list) or len(value) != length or not all(map(_is_number, value)):
        raise PopError(f"a browser sent {what} {shortened(value)}; it must be {length} finite numbers")


def _is_number(value: Any) -> bool:
    """Tell whether it is a number that single precision holds, squared too."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


# of one server
MOST_VIEWS: Final = 16
_MOST_SOCKETS: Final = 64
_LONGEST_MESSAGE: Final = 2**16
# a browser sends a camera for each of its frames, at most
_SECONDS_A_MESSAGE: Final = 0.005
# a browser that takes nothing for so long is gone
_PATIENCE: Final = 10.0
_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; media-src data: blob:; worker-src blob:; "
    "connect-src data: blob: ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# another program listens there
_IN_USE: Final = (errno.EADDRINUSE,)
_starting = threading.Lock()


class Guard:
    """Lets in whoever has the address that was printed.

    Args:
        host: what the server was asked to listen on.
        listening: the socket that it listens on.
        tell: is called with a line on what was refused of a connection that was let in.

    `token` is a random word that stands in the address, `rules` what the controls of all panels may be set to.
    """

    def __init__(self, host: str, listening: socket.socket, tell: Callable[[str], None]) -> None:
        self.token = secrets.token_urlsafe(18)
        self.rules: dict[str, Rule] = {}
        self._host, self._listening, self._tell = host.lower(), listening, tell
        self._views = 0

    @contextmanager
    def around_viser(self) -> Iterator[None]:
        """Put this guard around the server that viser starts in the block.

        Raises:
            PopError: viser started it in a way that is not known here, and so without a guard.
        """
        module: Any = importlib.import_module("websockets.asyncio.server")
        done = False

        def serve(handler: Any, *args: Any, **settings: Any) -> Any:
            nonlocal done
            if not str(handler.__module__).startswith("viser."):
                return given(handler, *args, **settings)
            done = True
            return given(self._counted(handler), **self._settings(module, settings))

        with _starting:
            given, module.serve = module.serve, serve
            try:
                yield
            finally:
                module.serve = given
        if not done:
            raise PopError("this version of viser cannot be guarded; pip install 'viser>=1.1,<1.2'")

    def _settings(self, websockets: Any, given: dict[str, Any]) -> dict[str, Any]:
        """Return viser's settings of the server with ours over them."""
        viser_page = given["process_request"]

        def process_request(connection: Any, request: Any) -> Any:
            refusal = self.refusal(request, str(connection.local_address[0]))
            if refusal is not None:
                return connection.respond(*refusal)
            # viser knows nothing of the token
            request.path = request.path.removeprefix(f"/{self.token}") or "/"
            answer = viser_page(connection, request)
            if answer is not None:
                answer.headers["Content-Security-Policy"] = _POLICY.format(host=request.headers["Host"])
                answer.headers["Referrer-Policy"] = "no-referrer"
                answer.headers["X-Content-Type-Options"] = "nosniff"
                answer.headers["Cache-Control"] = "no-store"
            return answer

        ours = {"process_request": process_request, "create_connection": self._connections(websockets)}
        limits = {"max_size": _LONGEST_MESSAGE, "max_queue": 4, "open_timeout": _PATIENCE, "close_timeout": 1.0}
        limits |= {"ping_interval": _PATIENCE, "ping_timeout": _PATIENCE}
        return {**given, **ours, **limits, "sock": self._listening}

    def refusal(self, request: Any, arrived_at: str) -> tuple[HTTPStatus, str] | None:
        """Return why a request, that came to an address of this machine, is refused, or None."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        socket_asked = bool(request.headers.get_all("Upgrade"))
        allowed = self._names(arrived_at)
        if len(hosts) != 1 or hosts[0].lower() not in allowed:
            return HTTPStatus.FORBIDDEN, f"Host must be one of {', '.join(sorted(allowed))}.\n"
        # a browser leaves Origin out when it asks for a page of the same server, and never for a socket
        if (origins or socket_asked) and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
            return HTTPStatus.FORBIDDEN, "Only the viewer's own page may connect.\n"
        word = request.path.partition("?")[0].split("/")[1:2]
        if not word or not hmac.compare_digest(word[0].encode(errors="surrogateescape"), self.token.encode()):
            return HTTPStatus.FORBIDDEN, "Open the whole address that was printed, with the word after the port.\n"
        if socket_asked and self._views >= MOST_VIEWS:
            return HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_VIEWS} browsers are already connected.\n"
        return None

    def _names(self, arrived_at: str) -> set[str]:
        """Return what Host may be for a request that came to this address of the machine."""
        names, local = {self._host}, ipaddress.ip_address(arrived_at.partition("%")[0])
        local = getattr(local, "ipv4_mapped", None) or local
        names.add(str(local))
        if local.is_loopback:
            names |= {"127.0.0.1", "::1", "localhost"}
        elif is_any(self._host):
            names |= {socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        port = self._listening.getsockname()[1]
        shown = {f"[{name}]" if ":" in name else name for name in names if not is_any(name)}
        return {f"{name}:{port}" for name in shown} | (shown if port == 80 else set())

    def _counted(self, handler: Any) -> Any:
        async def counted(connection: Any) -> None:
            if self._views >= MOST_VIEWS:
                await connection.close(1013, "too many browsers")
                return
            self._views += 1
            try:
                await handler(connection)
            finally:
                self._views -= 1
                if connection.protocol.close_sent is not None and connection.protocol.close_sent.code == 1009:
                    self._tell(f"a browser sent a message of more than {_LONGEST_MESSAGE} bytes")

        return counted

    def _connections(self, websockets: Any) -> Any:
        """Make the class of connections: few at a time, and each message is checked before viser decodes it."""
        guard = self

        class Connection(websockets.ServerConnection):
            refused = False

            def connection_made(self, transport: Any) -> None:
                super().connection_made(transport)
                if len(self.server.handlers) > _MOST_SOCKETS:
                    transport.abort()

            async def recv(self, decode: bool | None = None) -> Any:
                while True:
                    data = await super().recv(decode)
                    # while this waits, nothing more is read of the socket
                    await asyncio.sleep(_SECONDS_A_MESSAGE)
                    try:
                        if not self.refused and passed_on(data, guard.rules):
                            return data
                    except PopError as error:
                        self.refused = True
                        guard._tell(str(error))
                        await self.close(1008, "the message was refused")

        return Connection


def is_any(host: str) -> bool:
    """Tell whether a host stands for every address of this machine."""
    return host in ("", "0.0.0.0", "::")


def listen(host: str, port: int, tries: int = 100) -> socket.socket:
    """Listen on an address, or on the next free port where this one is in use."""
    place, family = _resolved(host), socket.AF_INET
    if ":" in place:
        family = socket.AF_INET6
    for number in range(port, min(port + tries, 65536)):
        made = socket.socket(family, socket.SOCK_STREAM)
        try:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            made.bind((place, number))
            made.listen(_MOST_SOCKETS)
        except OSError as error:
            made.close()
            if error.errno not in _IN_USE:
                said = f"the viewer cannot listen on {host}:{number} ({error.strerror or error})"
                raise PopError(f"{said}; give --host an address of this machine, and --port a free port") from error
        else:
            return made
    raise PopError(f"the viewer found no free port from {port} on at {host}; give --port another one")


def _resolved(host: str) -> str:
    """Return the first address of a host; a name server that does not answer is not waited for."""
    if is_any(host):
        return host or "0.0.0.0"
    found: list[str] = []

    def ask() -> None:
        try:
            found.append(str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0]))
        except (OSError, UnicodeError):
            return

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(0.9)
    if not found:
        raise PopError(
            f"the viewer cannot listen on {host!r}, which is not an address of this machine; give another --host"
        )
    return found[0]
