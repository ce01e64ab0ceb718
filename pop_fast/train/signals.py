"""Ctrl-C, SIGTERM and SIGHUP as a polite request: finish the step, write a checkpoint, then stop."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType


class StopRequest:
    """Whether somebody has asked for an end.

    Without a lock, unlike `threading.Event`: a handler runs in the middle of whatever the main thread is doing, and
    would wait for ever for a lock that this thread itself holds, as it does within `Event.wait`.
    """

    def __init__(self) -> None:
        self.asked = False


@contextlib.contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Turn the first Ctrl-C, SIGTERM or SIGHUP (the terminal is gone) into a word that a loop looks at between steps.

    The second one is obeyed at once. SIGHUP stays ignored where it is, as under nohup. Outside the main thread, where
    Python delivers no signals, nobody ever asks.
    """
    stop = StopRequest()
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
        stop.asked = True
        restore()

    for number in before:
        signal.signal(number, request)
    try:
        yield stop
    finally:
        restore()
