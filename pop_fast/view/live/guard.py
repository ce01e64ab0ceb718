"""Who may talk to the viewer's server, and how much: checked before viser hears of it.

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
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any, Final

from pop_fast.errors import PopError
from pop_fast.view.live.incoming import Rule, passed_on

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
        tell: is called with a line on what was refused of somebody who was let in.

    Attributes:
        token: a random word that stands in the address.
        rules: what the controls of all panels may be set to, by viser's names of the controls.
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
        return {
            **given,
            **ours,
            **limits,
            "ping_interval": _PATIENCE,
            "ping_timeout": _PATIENCE,
            "sock": self._listening,
        }

    def refusal(self, request: Any, arrived_at: str) -> tuple[HTTPStatus, str] | None:
        """Return why a request is refused, or None.

        Args:
            request: with `path` and `headers`, as websockets has it.
            arrived_at: the address of this machine that it came to.
        """
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        socket_asked = bool(request.headers.get_all("Upgrade"))
        allowed = self._names(arrived_at)
        if len(hosts) != 1 or hosts[0].lower() not in allowed:
            return HTTPStatus.FORBIDDEN, f"Host must be one of {', '.join(sorted(allowed))}.\n"
        # a browser leaves Origin out when it asks for a page of the same server, and never for a socket
        if (origins or socket_asked) and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
            return HTTPStatus.FORBIDDEN, "Only the viewer's own page may connect.\n"
        word = request.path.partition("?")[0].split("/")[1:2]
        if not word or not hmac.compare_digest(word[0].encode(), self.token.encode()):
            return HTTPStatus.FORBIDDEN, "Open the whole address that was printed, with the word after the port.\n"
        if socket_asked and self._views >= MOST_VIEWS:
            return HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_VIEWS} browsers are here already.\n"
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
    """Listen on an address, or on the next free port where this one is in use.

    Raises:
        PopError: it cannot be listened on; within a second or so.
    """
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
            f"the viewer cannot listen on {host!r}, which is no address of this machine; give --host another"
        )
    return found[0]
