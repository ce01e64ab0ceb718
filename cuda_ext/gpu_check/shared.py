"""What the stages of `gpu_check` share: where things lie, how long there is, and how a command is run."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

from pop_fast.children import python_command

ROOT = Path(__file__).resolve().parents[2]
# what puts the emulator in the GPU's place before it runs a command
REHEARSE = ROOT / "tests" / "cuda" / "emulated" / "rehearse.py"
COMMIT = "POP_COMMIT"  # the variable that says of which commit this is, where git cannot
UNKNOWN = "unknown"  # the commit, where nothing says it
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
            Its `status`, its `seconds` so far and the end of its words, `output`; `note` where its time was up.
        """
        grace = min(GRACE, limit / 4) if grace is None else grace
        note: dict[str, Any] = {}
        try:
            status = self._process.wait(max(limit - grace, 0.0))
        except subprocess.TimeoutExpired:
            self._process.send_signal(stop)
            note = {"note": f"its time, {limit:.0f} s, was up"}
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
        found = {"status": status, "seconds": round(time.monotonic() - self._start, 1), "output": self._words()}
        return found | note

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


def all_lines(command: list[str]) -> list[str]:
    """Return the lines that a command says, none where there is no such command, or it fails or takes a minute."""
    if shutil.which(command[0]) is None:
        return []
    try:
        done = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=False, timeout=QUERY_LIMIT_S)
    except subprocess.TimeoutExpired:  # nvidia-smi waits for a driver that hangs
        return []
    return done.stdout.strip().splitlines() if done.returncode == 0 else []


def first_line(command: list[str]) -> str | None:
    """Return the first line that a command says, or None where it says nothing; see `all_lines`."""
    lines = all_lines(command)
    return lines[0] if lines else None


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


SHORTEST = 3.0  # seconds with which a stage is begun at all
QUERY_LIMIT_S = 60.0  # for a question to the machine, such as the card's name
MARGIN = 3.0  # seconds that are kept for writing down the end


@dataclass(frozen=True)
class Share:
    """What a stage gets."""

    least: float  # seconds that earlier stages leave to it
    most: float  # seconds that it may take where there are more


class Budget:
    """Deals out seconds to the stages of a call, in order.

    Args:
        limit: seconds for all of them.
        shares: of every stage, by name.
        order: the stages to come.
    """

    def __init__(self, limit: float, shares: Mapping[str, Share], order: Sequence[str]) -> None:
        self._end = time.monotonic() + limit - MARGIN
        self._shares, self._order = shares, list(order)
        asked = sum(shares[name].least for name in order)
        # a short call keeps less for everyone
        self._scale = min(1.0, 0.9 * max(limit - MARGIN, 0.0) / asked) if asked else 1.0

    def seconds(self, name: str) -> float:
        """Return how long the next stage may take; under `SHORTEST` it is not to be begun."""
        self._order.remove(name)
        kept = self._scale * sum(self._shares[later].least for later in self._order)
        return min(self._shares[name].most, self._end - time.monotonic() - kept)


NOTHING: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class StageContext:
    """What the stages share."""

    seconds: float  # that this stage may take
    out: Path  # the folder of results
    work: Path  # a folder for what is not brought back
    log: Path  # what commands say goes there
    packed: Path | None  # what was brought along (`--pack`), if anything
    captures: tuple[Path, ...]  # folders to train on, besides those that were packed
    steps_scaler: float  # of the paper's 30,000 steps
    commit: str  # names trainings that may be resumed
    rehearsal: bool  # the emulator takes the GPU's place, with tiny cases
    note: Callable[[dict[str, Any]], None]  # keeps what a stage has found so far
    beside: dict[str, Command] = field(default_factory=dict)  # commands that run along with the stages, by name

    @property
    def site(self) -> Path:
        """Where packed wheels are installed."""
        return self.work / "site"

    def python(self, *words: str) -> list[str]:
        """Return the command that runs Python's `words`, with the emulator in the GPU's place in a rehearsal."""
        rehearse = [str(REHEARSE)] if self.rehearsal else []
        return python_command(*rehearse, *words)

    def run(
        self, words: list[str], limit: float, over: Mapping[str, str] = NOTHING, stop: signal.Signals = signal.SIGTERM
    ) -> dict[str, Any]:
        """Run a command that finds the repository and the packed wheels, with `over` put over its environment."""
        path = python_path(ROOT, self.site)
        told = self.commit != UNKNOWN and not (ROOT / ".git").exists()
        known = {COMMIT: self.commit} if told else {}
        return run(words, limit, self.log, {"PYTHONPATH": path, "PYTHONUNBUFFERED": "1", **known, **over}, stop)

    def scenes(self) -> list[str]:
        """List the packed scenes."""
        return sorted(map(str, (self.packed / "scenes").glob("*.npz"))) if self.packed else []


def skipped(reason: str) -> dict[str, Any]:
    """Return what a stage found that had nothing to do, which is no failure."""
    return {"status": 0, "seconds": 0.0, "skipped": reason}
