"""The command line, `pop`: one small module a subcommand, loaded only when it is called.

`main` owns what every subcommand shares: the list of them, one-line errors, exit statuses. A subcommand module has one
public function, `run(argv) -> int`, and prints nothing but its result; all errors travel as exceptions.
"""

from __future__ import annotations

import atexit
import contextlib
import difflib
import importlib
import io
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import Final, NoReturn

from pop_fast.cli.errors import describe, message

COMMANDS: Final = {
    "train": "fit a splat to a capture or a folder of photographs",
    "eval": "measure a result, a checkpoint or a PLY on the held-out views",
    "render": "write held-out views, or a camera path as pictures or a video",
    "view": "show a splat in the browser, drawn by our own renderers (needs viser)",
    "explain": "say why a pixel looks as it does, and where two renderers part",
    "export": "write a result as PLY, SPZ, SOG, glTF, ..., a page that shows it, or an Inria-style folder",
    "convert": "turn a splat's file into another format",
    "compare": "put several results side by side in one table",
    "report": "write report.html again from the files of a result",
    "frames": "take sharp photographs out of a video",
    "sfm": "find the cameras of a folder of photographs (pycolmap)",
    "demo": "write the built-in demo capture, made from a seed",
    "data check": "look a capture over before training: sizes, pairing, masks, memory",
    "blocks": "do one part of a training in blocks: partition, train a block, merge",
    "build-cpu": "compile the CPU kernels: about three times the speed (needs a C++ compiler)",
    "build-cuda": "compile the CUDA extension (needs nvcc)",
    "learn": "build your own splatting in NumPy, judged stage by stage",
    "vectors": "write the conformance vectors for ports in other languages, and check a port's results",
    "completion": "write a script by which a shell completes the words of pop",
    "doctor": "say what is installed, what is missing and how to get it",
}

EXIT_INCOMPLETE: Final = 1
EXIT_BAD_INPUT: Final = 2
EXIT_INTERRUPTED: Final = 130
EXIT_TERMINATED: Final = 128 + signal.SIGTERM


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and turn what went wrong into one line and an exit status.

    Args:
        argv: the words after `pop`; the process's own when None.

    Returns:
        0, or 1 where something is missing, or 2 for bad input and bad usage, or 130 after Ctrl-C, or 143 after SIGTERM.
    """
    if argv is not None:
        return _status(list(argv))
    status = _status(sys.argv[1:])
    if status in (EXIT_INTERRUPTED, EXIT_TERMINATED):
        _leave(status)
    return status


def _leave(status: int) -> NoReturn:
    """End the process: what is registered for its end is done, but no object is taken apart, which takes seconds."""
    # no public function does this alone
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def _status(words: list[str]) -> int:
    debug = "--debug" in words or os.environ.get("POP_DEBUG", "") not in ("", "0")
    words = [word for word in words if word != "--debug"]
    for stream in (sys.stdout, sys.stderr):
        # a name that is no text is shown with escapes
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with _terminable():
            status = _run(words)
        sys.stdout.flush()
        return status
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except KeyboardInterrupt as stop:
        print("pop: interrupted", file=sys.stderr)
        return EXIT_TERMINATED if isinstance(stop, _Terminated) else EXIT_INTERRUPTED
    except BrokenPipeError:
        # the reader has gone, as in `pop train --help | head`: what is still buffered has nowhere to go
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        line = describe(error)
        if debug or line is None:
            raise
        print(f"pop: error: {message(line)}", file=sys.stderr)
        return EXIT_BAD_INPUT


class _Terminated(KeyboardInterrupt):
    """SIGTERM: as orderly an end as after Ctrl-C."""


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end the block as Ctrl-C does, so that nothing half made is left, unless somebody handles it."""
    here = threading.current_thread() is threading.main_thread()
    if not here or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        raise _Terminated

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_overview())
        return 0
    if words[0] in ("-V", "--version"):
        print(f"pop {_version()}")
        return 0
    name, rest = _split(words)
    if name is None:
        return _unknown(words)
    return importlib.import_module(f"pop_fast.cli.{re.sub('[ -]', '_', name)}").run(rest)


def _split(words: list[str]) -> tuple[str | None, list[str]]:
    for length in (2, 1):
        name = " ".join(words[:length])
        if name in COMMANDS:
            return name, words[length:]
    return None, words


def _unknown(words: list[str]) -> int:
    tried = " ".join(words[:2]) if words[0] == "data" else words[0]
    near = difflib.get_close_matches(tried, COMMANDS, n=1, cutoff=0.5)
    hint = f"did you mean 'pop {near[0]}'?" if near else "see 'pop --help'"
    print(f"pop: error: '{tried}' is not a subcommand; {hint}", file=sys.stderr)
    return EXIT_BAD_INPUT


def _overview() -> str:
    width = max(map(len, COMMANDS)) + 2
    lines = [f"  {name:<{width}}{summary}" for name, summary in COMMANDS.items()]
    return "\n".join(
        [
            "usage: pop COMMAND ...",
            "",
            "3D Gaussian Splatting with the Polarized Opacity Prior, on a CPU.",
            "",
            "commands:",
            *lines,
            "",
            "start here:",
            "  pop demo scene && pop train scene --minutes 2",
            "  pop train my_photos --factor 4 --out out/mine",
            "",
            "'pop COMMAND --help' explains one. --debug (or POP_DEBUG=1) shows the traceback of an error.",
        ]
    )


def _version() -> str:
    from importlib.metadata import version

    return version("pop-splatting")
