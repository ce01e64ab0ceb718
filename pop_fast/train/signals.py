"""Ctrl-C, SIGTERM and SIGHUP as a polite request: leave the step, write a checkpoint, then stop.

Python runs a signal's handler in the main thread and between two of its instructions only, so a call of a compiled
library that takes seconds delays the handler. Such a call is made in its own thread (`heard`), and can read a flag that
says whether a stop was requested (`StopRequest.address`).
"""

from __future__ import annotations

import contextlib
import ctypes
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TypeVar

T = TypeVar("T")


class Abandoned(KeyboardInterrupt):
    """A piece of work was left because a stop was requested."""


class StopRequest:
    """Whether a stop was requested.

    Without a lock, unlike `threading.Event`: a handler runs in the middle of whatever the main thread is doing, and
    would wait for ever for a lock that this thread itself holds, as it does within `Event.wait`.
    """

    def __init__(self) -> None:
        self._flag = ctypes.c_int32(0)
        self._abandons = False

    @property
    def asked(self) -> bool:
        """Tell whether a stop was requested."""
        return bool(self._flag.value)

    @property
    def address(self) -> int:
        """Where compiled code reads it: an int32 that is not 0 any more. It lives as long as this object."""
        return ctypes.addressof(self._flag)

    def ask(self) -> None:
        """Ask for an end; within a block of `abandoning`, raise Abandoned."""
        self._flag.value = 1
        if self._abandons:
            self._abandons = False
            raise Abandoned

    @contextlib.contextmanager
    def abandoning(self, allowed: bool = True) -> Iterator[None]:
        """Let a request end the block at once, as nothing that must be kept is changed by it.

        Raises:
            Abandoned: a stop was requested, before the block or while it ran.
        """
        if not allowed:
            yield
            return
        self._abandons = True
        try:
            if self.asked:
                raise Abandoned
            yield
        finally:
            self._abandons = False


def heard(function: Callable[..., T], *args: Any) -> T:
    """Call a function that may take seconds within compiled code, so that signals are heard meanwhile.

    In the main thread it is called in its own thread, which is left behind when a signal's handler raises; the
    function must not depend on the thread that it runs in. In another thread it is only called.
    """
    if threading.current_thread() is not threading.main_thread():
        return function(*args)
    found: list[T] = []
    failed: list[BaseException] = []

    def call() -> None:
        try:
            found.append(function(*args))
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=call, name="heard", daemon=True)
    thread.start()
    thread.join()
    if failed:
        raise failed[0]
    return found[0]


@contextlib.contextmanager
def stop_requests(stop: StopRequest | None = None) -> Iterator[StopRequest]:
    """Turn the first Ctrl-C, SIGTERM or SIGHUP (the terminal is gone) into a word that a loop looks at between steps.

    The second one is obeyed at once. SIGHUP stays ignored where it is, as under nohup. Outside the main thread, where
    Python delivers no signals, nobody ever asks.
    """
    stop = StopRequest() if stop is None else stop
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    hangup = getattr(signal, "SIGHUP", None)  # not on Windows
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        before[hangup] = signal.getsignal(hangup)

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def request(number: int, frame: FrameType | None) -> None:
        restore()
        stop.ask()

    for number in before:
        signal.signal(number, request)
    try:
        yield stop
    finally:
        restore()
