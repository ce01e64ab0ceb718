"""A running program, asked over its standard input and output; it may not hang, end or say less than it announced."""

from __future__ import annotations

import contextlib
import os
import queue
import subprocess
import tempfile
import threading
import time
import weakref
from collections.abc import Callable
from typing import IO, Any, Final

import numpy as np

# the longest line of an answer, and how much of what a failing program wrote to standard error is shown, bytes
LONGEST_LINE: Final = 1 << 16
SHOWN: Final = 2000
MOST_DRAWN: Final = 10**6
_CHUNK: Final = 1 << 16


class ProgramError(RuntimeError):
    """The program broke the protocol: it ended, took too long, or answered what cannot be read."""


class Pipe:
    """A program that is started when it is first asked, and again after it has failed.

    Args:
        command: the program and its arguments.
        timeout: seconds from a request to the end of its answer. Once it has passed, later answers may take a second,
            or five times as long as the slowest sound one: a law that shrinks a scene asks many times.
    """

    def __init__(self, command: list[str], timeout: float) -> None:
        self.command = command
        self.timeout = timeout
        self._slowest = 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self._chunks: queue.Queue[bytes] = queue.Queue()
        self._buffer = bytearray()
        self._asked, self._asked_at, self._limit = "", 0.0, timeout

    def __str__(self) -> str:
        return f"program {' '.join(self.command)}"

    def ask(self, line: str, arrays: list[Any] | None = None, draw: Callable[[int], Any] | None = None) -> str:
        """Send a request and return its answer's line without the leading ok; arrays are read with `read_array`.

        Args:
            line: the request.
            arrays: that follow it.
            draw: answers a line `draw NUMBER` that may come before the program's own answer.

        Raises:
            ProgramError: there is no such line in time.
        """
        self._start()
        self.nothing_left()
        self._asked, self._asked_at = " ".join(line.split()[: 2 if line.startswith("call ") else 1]), time.monotonic()
        self._send(line, arrays or [])
        answer = self._line()
        if draw is not None and answer.startswith("draw "):
            number = answer.removeprefix("draw ")
            if not number.isdecimal() or int(number) > MOST_DRAWN:
                raise self._failed(f"answers {answer[:80]!r}; it must be draw and a whole number up to {MOST_DRAWN}")
            drawn = np.asarray(draw(int(number)), dtype=np.float64)
            self._send(f"{number}=[{','.join(map(str, drawn.shape))}]", [drawn])
            answer = self._line()
        first, _, words = answer.partition(" ")
        if first == "error":
            self.done()
            raise ProgramError(f"{self} refuses the request {self._asked}: {words}")
        if first != "ok":
            raise self._failed(f"answers {answer[:80]!r}, which begins neither with ok nor with error")
        return words

    def _send(self, line: str, arrays: list[Any]) -> None:
        body = b"".join(np.ascontiguousarray(a, dtype="<f8").tobytes() for a in arrays)
        # beside the reading, because a program may begin to answer before it has read everything
        threading.Thread(target=_write, args=(self._process, line.encode() + b"\n" + body), daemon=True).start()

    def _line(self) -> str:
        while b"\n" not in self._buffer:
            if len(self._buffer) > LONGEST_LINE:
                raise self._failed(f"begins its answer with {len(self._buffer)} bytes that hold no line")
            self._receive("a line")
        text, _, rest = bytes(self._buffer).partition(b"\n")
        self._buffer = bytearray(rest)
        return text.decode("utf-8", "backslashreplace").strip()

    def read_array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Read an array of the answer."""
        size = 8 * int(np.prod(shape))
        while len(self._buffer) < size:
            self._receive(f"the {size} bytes of {name} {list(shape)}")
        value = np.frombuffer(bytes(self._buffer[:size]), dtype="<f8").reshape(shape)
        del self._buffer[:size]
        return value

    def nothing_left(self) -> None:
        """Make sure that the program has written nothing that it was not asked for, as far as it is here."""
        while not self._chunks.empty():
            self._buffer += self._chunks.get_nowait()
        if self._buffer:
            raise self._failed(f"writes {len(self._buffer)} bytes more than its answer announces")

    def done(self) -> None:
        """Say that an answer has been read, and make sure that it holds no more than it announced."""
        self._slowest = max(self._slowest, time.monotonic() - self._asked_at)
        self.nothing_left()

    def stop(self) -> None:
        """End the program; the next request starts it again."""
        if self._process is not None:
            _end(self._process)
            self._process = None

    def _start(self) -> None:
        if self._process is not None:
            return
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the program
        try:
            self._process = subprocess.Popen(
                self.command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said
            )
        except OSError as error:
            raise ProgramError(f"{self} cannot be started: {error}") from error
        weakref.finalize(self, _end, self._process)
        self._chunks, self._buffer = queue.Queue(), bytearray()
        threading.Thread(target=_read, args=(self._process, self._chunks), daemon=True).start()

    def _receive(self, what: str) -> None:
        left = self._asked_at + self._limit - time.monotonic()
        try:
            chunk = self._chunks.get(timeout=max(left, 0.0))
        except queue.Empty:
            limit, self._limit = self._limit, min(self._limit, max(1.0, 5.0 * self._slowest))
            raise self._failed(f"took longer than {limit:.3g} s to answer {self._asked}, waiting for {what}") from None
        if not chunk:
            raise self._failed(f"ended{self._status()} before it had answered {self._asked}, waiting for {what}")
        self._buffer += chunk

    def _status(self) -> str:
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            return f" with status {self._process.wait(timeout=1.0)}"
        return ""

    def _failed(self, what: str) -> ProgramError:
        self.stop()
        return ProgramError(f"{self} {what}{self._last_words()}")

    def _last_words(self) -> str:
        if self._said is None:
            return ""
        self._said.seek(0, os.SEEK_END)
        self._said.seek(max(0, self._said.tell() - SHOWN))
        words = self._said.read().decode("utf-8", "backslashreplace").strip()
        return f"; it wrote to standard error: {words}" if words else ""


def _write(process: subprocess.Popen[bytes], request: bytes) -> None:
    # the reader notices a program that has ended
    with contextlib.suppress(OSError, ValueError):
        assert process.stdin is not None
        left = memoryview(request)
        while left:
            left = left[process.stdin.write(left) :]


def _read(process: subprocess.Popen[bytes], chunks: queue.Queue[bytes]) -> None:
    assert process.stdout is not None
    with contextlib.suppress(OSError, ValueError):
        while chunk := os.read(process.stdout.fileno(), _CHUNK):
            chunks.put(chunk)
    chunks.put(b"")
    process.stdout.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    # the reader closes the other end
    with contextlib.suppress(OSError):
        assert process.stdin is not None
        process.stdin.close()
