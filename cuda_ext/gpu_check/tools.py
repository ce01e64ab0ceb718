"""Commands with a time limit, and files that are written whole: what the stages of `gpu_check` are made of."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).resolve().parents[2]
TAIL = 4000  # characters of a command's words that are kept
GRACE = 20.0  # seconds, at most, between asking a command to stop and making it


class Command:
    """A command that runs in the repository, its words going to a file.

    Args:
        words: program and arguments.
        log: what it says is added there.
        environment: is put over this process's own.
    """

    def __init__(self, words: Sequence[str], log: Path, environment: Mapping[str, str] | None = None) -> None:
        log.parent.mkdir(parents=True, exist_ok=True)
        self._log, self._start = log, time.monotonic()
        with open(log, "ab") as file:
            file.write(f"\n$ {' '.join(words)}\n".encode())
            # before the command writes: what is still in the buffer would come after its words
            file.flush()
            self._from = file.tell()
            self._process = self._begin(words, file, {**os.environ, **(environment or {})})

    @staticmethod
    def _begin(words: Sequence[str], file: IO[bytes], environment: dict[str, str]) -> subprocess.Popen[bytes]:
        def listen() -> None:
            # what a shell starts in the background ignores interruptions, and so would its children
            signal.signal(signal.SIGINT, signal.SIG_DFL)

        return subprocess.Popen(
            words,
            cwd=ROOT,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            preexec_fn=listen,
        )

    def wait(self, limit: float, stop: signal.Signals = signal.SIGTERM, grace: float | None = None) -> dict[str, Any]:
        """Wait for its end, at most `limit` seconds.

        A command whose time is up is asked to stop first, by the signal `stop`, so that it can leave a checkpoint or
        its summary; its status is its own answer, or 124. It has the last `grace` seconds of the limit to answer: a
        quarter of it and `GRACE` at most, if nothing else is said.

        Returns:
            Its `status`, its `seconds` so far and the end of its words, `output`.
        """
        grace = min(GRACE, limit / 4) if grace is None else grace
        try:
            status = self._process.wait(max(limit - grace, 0.0))
        except subprocess.TimeoutExpired:
            self._process.send_signal(stop)
            try:
                status = self._process.wait(grace)
            except subprocess.TimeoutExpired:
                status = -1
            # compilers and tests have children of their own
            self.kill()
            status = status if status > 0 else 124
        except BaseException:
            self.kill()
            raise
        return {"status": status, "seconds": round(time.monotonic() - self._start, 1), "output": self._words()}

    def kill(self) -> None:
        """End it and its children at once."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _words(self) -> str:
        with open(self._log, "rb") as file:
            file.seek(self._from)
            return file.read().decode(errors="replace")[-TAIL:]


def run(
    words: Sequence[str],
    limit: float,
    log: Path,
    environment: Mapping[str, str] | None = None,
    stop: signal.Signals = signal.SIGTERM,
) -> dict[str, Any]:
    """Run a command in the repository to its end or its time limit; see `Command.wait`."""
    return Command(words, log, environment).wait(limit, stop)


def python_path(*folders: Path) -> str:
    """Return PYTHONPATH with folders put before what it holds."""
    return os.pathsep.join(filter(None, [*map(str, folders), os.environ.get("PYTHONPATH", "")]))


def first_line(command: list[str]) -> str | None:
    """Return the first line that a command says, or None where there is no such command or it fails."""
    if shutil.which(command[0]) is None:
        return None
    done = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=False)
    lines = done.stdout.strip().splitlines()
    return lines[0] if done.returncode == 0 and lines else None


def read_json(path: Path) -> dict[str, Any]:
    """Read a file of this check; nothing where it is absent or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file whole: a call that is killed leaves what was there before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    partial.replace(path)
