"""The command line, `pop`: one small module a subcommand, loaded only when it is called.

`main` owns what every subcommand shares: the list of them, how words are read, one-line errors, exit statuses. A
subcommand module has one public function, `run(argv) -> int`, and prints nothing but its result; all errors travel as
exceptions.
"""

from __future__ import annotations

import atexit
import contextlib
import difflib
import errno
import importlib
import inspect
import io
import os
import re
import signal
import stat
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any, Final, NoReturn, TypeVar

from pop_fast.errors import PopError

COMMANDS: Final = {
    "train": "fit a splat to a capture or a folder of photographs",
    "eval": "measure a result, a checkpoint or a PLY on the held-out views",
    "render": "write held-out views, or a camera path as pictures or a video",
    "view": "show a splat in the browser, drawn by our own renderers (needs viser)",
    "explain": "say why a pixel looks as it does, and where two renderers differ",
    "export": "write a result as PLY, SPZ, SOG, glTF, ..., a page that shows it, or an Inria-style folder",
    "convert": "turn a splat's file into another format",
    "compare": "put several results side by side in one table",
    "report": "write report.html again from the files of a result",
    "frames": "take sharp photographs out of a video",
    "sfm": "find the cameras of a folder of photographs (pycolmap)",
    "demo": "write the built-in demo capture, made from a seed",
    "data check": "check a capture before training: sizes, pairing, masks, memory",
    "blocks": "do one part of a training in blocks: partition, train a block, merge",
    "build-cpu": "compile the CPU kernels: about four times the speed (needs a C++ compiler)",
    "build-cuda": "compile the CUDA extension (needs nvcc)",
    "learn": "build your own splatting in NumPy, judged stage by stage",
    "vectors": "write the conformance vectors for ports in other languages, and check a port's results",
    "completion": "write a shell script that completes the words of pop",
    "doctor": "say what is installed, what is missing and how to get it",
}

EXIT_INCOMPLETE: Final = 1
EXIT_BAD_INPUT: Final = 2
EXIT_INTERRUPTED: Final = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and turn what went wrong into one line and an exit status.

    Args:
        argv: the words after `pop`; the process's own when None.

    Returns:
        0, or 1 where something is missing, or 2 for bad input and bad usage, or 130 after Ctrl-C, or 143 after SIGTERM,
        or 129 after SIGHUP. A training that has stopped returns 130 after each of them, and a viewer 0 after Ctrl-C,
        which is how it ends.
    """
    return guarded("pop", _run, argv, "interrupted")


def guarded(program: str, run: Callable[[list[str]], int], argv: Sequence[str] | None, interrupted: str) -> int:
    """Call what runs a program's words; `main` says what is returned.

    Args:
        program: its name, with which an error's line begins.
        run: reads the words and returns the exit status.
        argv: the words; the process's own when None, which is then ended where it was interrupted.
        interrupted: what is said then.
    """
    if argv is not None:
        return _status(program, run, list(argv), interrupted)
    _keep_streams()
    sys.unraisablehook = _heed
    status = _status(program, run, sys.argv[1:], interrupted)
    # all is done: in the end of Python, which takes seconds, Ctrl-C would show a traceback and change the status
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if status > 128:
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


def _heed(found: sys.UnraisableHookArgs) -> None:
    """Raise a signal's exception again that came where Python lets none through, as in what is called of freed objects.

    One that a loop left its work for (`pop_fast.train.signals.Abandoned`) is known to the loop without it.
    """
    error = found.exc_value
    # Windows has no such call
    if not isinstance(error, KeyboardInterrupt) or not hasattr(signal, "pthread_kill"):
        sys.__unraisablehook__(found)
    elif type(error) in (KeyboardInterrupt, _Terminated):
        again = [threading.main_thread().ident, getattr(error, "number", signal.SIGINT)]
        threading.Timer(0.05, signal.pthread_kill, again).start()


class _Lasting(io.FileIO):
    """A standard stream that leads nowhere once its reader is gone, as in `pop train 2>&1 | head`: the work goes on."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            # of a terminal that was closed the system says EIO
            closed = error.errno == errno.EIO and stat.S_ISCHR(os.fstat(self.fileno()).st_mode)
            if error.errno != errno.EPIPE and not closed:
                raise
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return len(data)


def _keep_streams() -> None:
    """Let the process outlive the readers of what it prints, and have both streams where it was started without."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            # takes the number of the closed one, under which a library would write into a file that is opened next
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - as long as the process
            continue
        buffer = getattr(stream, "buffer", None)
        raw = getattr(buffer, "raw", buffer)
        if type(raw) is io.FileIO:
            file = _Lasting(raw.fileno(), "w", closefd=False)
            how = {"line_buffering": stream.line_buffering, "write_through": stream.write_through}
            lasting = io.TextIOWrapper(file if raw is buffer else io.BufferedWriter(file), stream.encoding, **how)
            setattr(sys, name, lasting)


def _status(program: str, run: Callable[[list[str]], int], words: list[str], interrupted: str) -> int:
    debug = "--debug" in words or os.environ.get("POP_DEBUG", "") not in ("", "0")
    words = [_at_home(word) for word in words if word != "--debug"]
    for stream in (sys.stdout, sys.stderr):
        # a name that is no text is shown with escapes
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with _terminable():
            status = run(words)
        sys.stdout.flush()
        return status
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except KeyboardInterrupt as stop:
        print(f"{program}: {interrupted}", file=sys.stderr)
        return 128 + stop.number if isinstance(stop, _Terminated) else EXIT_INTERRUPTED
    except Exception as error:
        line = describe(error)
        if debug or line is None:
            raise
        print(f"{program}: error: {message(line)}", file=sys.stderr)
        return getattr(error, "status", EXIT_BAD_INPUT)


def _at_home(word: str) -> str:
    """Read `--out=~/x` as the shell reads `--out ~/x`."""
    name, equals, path = word.partition("=")
    return f"{name}={os.path.expanduser(path)}" if equals and name.startswith("--") else word


class _Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP: as orderly an end as after Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, so that nothing half made is left, unless they are handled.

    SIGHUP that is ignored, as under nohup, stays so.
    """
    numbers: list[int] = []
    if threading.current_thread() is threading.main_thread():
        # SIGHUP is not on Windows
        known = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
        numbers = [number for number in known if signal.getsignal(number) is signal.SIG_DFL]

    def end(number: int, frame: FrameType | None) -> None:
        raise _Terminated(number)

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _run(words: list[str]) -> int:
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if words[0] in ("-V", "--version"):
        from importlib.metadata import version

        print(f"pop {version('pop-splatting')}")
        return 0
    name, rest = _split(words)
    if name is None:
        return _unknown(words)
    return command(name)(rest)


def command(name: str) -> Callable[[Sequence[str]], int]:
    """Import what runs a subcommand: `run` of the module of its name, or as of `build-cpu` `run_cpu` of `build`."""
    module, _, part = name.replace(" ", "_").partition("-")
    return getattr(importlib.import_module(f"pop_fast.cli.{module}"), f"run_{part}" if part else "run")


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
            "3D Gaussian Splatting with the Polarized Opacity Prior, on an ordinary CPU.",
            "",
            "commands:",
            *lines,
            "",
            "start here:",
            "  pop demo scene && pop train scene --minutes 2",
            "  pop train my_photos --minutes 10",
            "",
            "'pop COMMAND --help' explains one. --debug (or POP_DEBUG=1) shows the traceback of an error.",
        ]
    )


# C0 without tab and line feed, DEL, C1, and what turns the direction of a line
_CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
# of a message; both of its ends say more than the middle
_LONGEST: Final = 1_200
_END: Final = 300


def printable(text: str) -> str:
    """Write control characters, and what no text may hold, as escapes: a terminal shows them and obeys none."""
    shown = _CONTROL.sub(_escaped, text)
    return shown.encode("utf-8", "backslashreplace").decode("utf-8")


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


def message(text: str) -> str:
    """Make an error's text `printable`, and shorten it in its middle."""
    shown = printable(text)
    return shown if len(shown) <= _LONGEST else f"{shown[: _LONGEST - _END]} ... {shown[-_END:]}"


# of torch on Linux and elsewhere, and of the loader of libraries, of which some take hundreds of megabytes
_NO_MEMORY: Final = ("not enough memory", "can't allocate memory", "failed to map segment from shared object")
_PACKAGES: Final = ("/pop_fast/", "/pop_ref/", "/cuda_ext/")


def describe(error: BaseException) -> str | None:
    """Say in one line what the user can do about an error, or None when it is a fault of the program.

    A `ValueError` or `NotImplementedError` counts as the user's when the package itself raised it, because then its
    message names field and fix; one that escapes from a library below is a fault, and keeps its traceback.
    """
    if isinstance(error, PopError):
        return str(error)
    if isinstance(error, OSError):
        return _describe_os_error(error)
    if isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY):
        return "out of memory; use smaller images (--factor 2 or more) or fewer Gaussians"
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        return "the system allows no more threads; raise the limit (ulimit -u), or use fewer: --threads 1"
    frames = traceback.extract_tb(error.__traceback__)
    here = bool(frames) and any(package in frames[-1].filename.replace("\\", "/") for package in _PACKAGES)
    if isinstance(error, ValueError | NotImplementedError) and here:
        return re.sub(r"\s*\n\s*", " ", str(error))
    return None


def _describe_os_error(error: OSError) -> str | None:
    where = f"{error.filename}: " if error.filename else ""
    match error.errno:
        case errno.ENOSPC | errno.EDQUOT:
            return f"{where}the disk is full; free some space or write elsewhere with --out"
        case errno.EACCES | errno.EPERM | errno.EROFS:
            return f"{where}permission denied; change its owner or mode, or write elsewhere with --out"
        # without a name it is that of tempfile, which says in which folders it could not write
        case errno.ENOENT if not where:
            return f"{error.strerror}; let TMPDIR name a folder on a disk with room that you may write to"
        case errno.ENOENT:
            return f"{where}no such file or folder"
        case errno.EISDIR:
            return f"{where}is a folder where a file is needed"
        case errno.ENOTDIR | errno.EEXIST:
            return f"{where}a file is in the way where a folder is needed"
        case None:
            return None
        case _:
            return f"{where}{error.strerror}"


T = TypeVar("T")


def parse(kind: type[T], argv: Sequence[str], command: str, default: T | None = None, examples: str = "") -> T:
    """Read the words after `pop COMMAND` into a dataclass, whose docstring is the description.

    `default` are values that words override, for dataclasses without defaults of their own. SystemExit ends it: 0 after
    --help, 2 after bad usage, when tyro has said what is wrong.
    """
    import tyro

    about = inspect.cleandoc(kind.__doc__ or "").partition("\nAttributes:")[0].strip()
    if examples:
        about += "\n\nexamples:\n" + "\n".join(f"  {line.strip()}" for line in examples.strip().splitlines())
    start = tyro.MISSING_NONPROP if default is None else default
    # a switch is shown with its opposite, so that one sentence is right for both
    style = (tyro.conf.HelptextFromCommentsOff,)
    return tyro.cli(kind, args=list(argv), prog=f"pop {command}", description=about, default=start, config=style)
