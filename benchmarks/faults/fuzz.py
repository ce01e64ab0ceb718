"""Damaged input: every reader gives a result or a sentence, and never ends, hangs, fills or surprises its process.

The damage to a file is decided by a number: bytes, words and sizes that nobody counts to, with sound checksums or not.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import mmap
import os
import random
import re
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from pop_fast.cli import describe, message
from pop_fast.errors import PopError

from .corpus import HERE, pack
from .readers import READERS, Reader
from .runs import start, wait

# of one input: seconds, bytes over what importing takes, letters of a refusal
SECONDS, MEMORY, LONGEST = 60, 2**30, 1_300
# of a reader's turn, seconds: long compared with the start of a child
TURN = 4.0
OUTCOMES = ("read", "refused", "told", "escaped", "crashed", "hung")
FAILURES = OUTCOMES[3:]
_INTEGERS = (0, 1, -1, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**63 - 1, -(2**63))
_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e38, -1e38, 1e308, float("inf"), float("-inf"), float("nan"))
_WORDS = (
    *("-1", "0", "1", "2", "999999999999999999999", "1e999", "-1e-999", "nan", "inf", "NaN", "Infinity"),
    *("null", "true"),
    *("[]", "{}", '""', '"x"', "[[1]]", "\0", "\x1b[2J", "\ufffd", "é", "../../etc/passwd", "/", "", " ", "\n", "#"),
    *("OPENCV", "PINHOLE", "9" * 400, "[" * 3000, "x" * 5000, "0x10", "1_000", "١", "1,5"),
)
_EDGES = re.compile(r'[ \n\t,:\[\]{}"]')


def fuzz(inputs: int, minutes: float, seed: int, only: str | None = None, save: bool = False) -> dict[str, Any]:
    """Give mutated files to all readers in turn.

    After its least each reader gets the same time, so that cheap readers are given more inputs than dear ones. A
    reader's inputs are numbered from 0; with the seed, a number names the same file everywhere.

    Args:
        inputs: of each reader, at least.
        minutes: in all; the least is done where it takes longer.
        seed: decides all inputs.
        only: a reader's name, or None for all.
        save: keep the smallest file of every failure among the regressions of its reader.

    Returns:
        By reader how often what came out, and every failure once by where it came from.
    """
    begin = time.monotonic()
    end = begin + 60.0 * minutes
    turns = [_Turns(name, seed) for name in READERS if only in (None, name)]
    for turn in turns:
        turn.go_on(inputs)
    while time.monotonic() < end:
        for turn in turns:
            turn.go_on(None, min(TURN, max(end - time.monotonic(), 0.0)))
    failures = {key: value for turn in turns for key, value in turn.failures.items()}
    if save:
        _save(failures)
    print(f"seed {seed}")
    for turn in turns:
        print(f"{turn.name:<44} {sum(turn.counts.values()):>9,}", flush=True)
    return {
        "seed": seed,
        "minutes": round((time.monotonic() - begin) / 60.0, 1),
        "least": inputs,
        "inputs": sum(sum(turn.counts.values()) for turn in turns),
        "readers": {turn.name: {outcome: turn.counts[outcome] for outcome in OUTCOMES} for turn in turns},
        "failures": failures,
    }


def renewed(whole: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """Put what came of some readers in the place of what came of them in a run of all.

    Args:
        whole: what `fuzz` gave for all readers; seed, minutes and commit stay its.
        part: what it gave for some, which have their own seed and commit.
    """
    own = {key: part[key] for key in ("seed", "commit")}
    again = {name: {**row, **own} for name, row in part["readers"].items()}
    readers = {**whole["readers"], **again}
    failures = {key: of for key, of in whole["failures"].items() if of["reader"] not in again} | part["failures"]
    inputs = sum(row[outcome] for row in readers.values() for outcome in OUTCOMES)
    return {**whole, "inputs": inputs, "readers": readers, "failures": failures}


@dataclass
class _Turns:
    """What has come of a reader's inputs so far; the next is `at`, and those below 0 once broke something."""

    name: str
    seed: int
    at: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    failures: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.at = -len(kept(self.name))

    def go_on(self, last: int | None, seconds: float = float("inf")) -> None:
        """Read inputs in children, a new one after each that died, up to a number or for a time."""
        until = time.monotonic() + seconds
        with tempfile.TemporaryDirectory() as folder, mmap.mmap(-1, 8 * 8) as page:
            while (last is None or self.at < last) and time.monotonic() < until:
                log, said = Path(folder) / "log", Path(folder) / "said"
                log.write_text("")
                with memoryview(page) as raw, raw.cast("q") as notes:
                    notes[:] = memoryview(bytes(8 * 8)).cast("q")
                    notes[0] = self.at
                    work = partial(self._read, notes, last, until, log)
                    status = wait(start(work, said, MEMORY))
                    self._add(notes, status, log)

    def _read(self, notes: memoryview, last: int | None, until: float, log: Path) -> None:
        """In a child: read one after the other; what is begun is noted before it is done.

        Args:
            notes: shared with the parent: the number, whether the end was reached, and how often each outcome came.
            last: the number to stop before, or None.
            until: the time on the clock to stop at.
            log: where failures are written, in the folder that the child works in.
        """
        warnings.simplefilter("ignore")
        reader, number = READERS[self.name], self.at
        copy = copied(reader, log.parent)
        target = copy / reader.file if reader.file else copy
        with open(log, "a", encoding="utf-8") as told:
            while (last is None or number < last) and time.monotonic() < until:
                notes[0] = number
                target.write_bytes(input_of(self.name, self.seed, number))
                signal.alarm(SECONDS)
                came, *more = _outcome(reader, copy)
                signal.alarm(0)
                notes[2 + OUTCOMES.index(came)] += 1
                if more:
                    site, words = more
                    line = {"number": number, "came": came, "site": site, "message": words}
                    print(json.dumps(line), file=told, flush=True)
                number += 1
                notes[0] = number
        notes[1] = 1

    def _add(self, notes: memoryview, status: int, log: Path) -> None:
        self.counts.update({outcome: notes[2 + k] for k, outcome in enumerate(OUTCOMES)})
        for line in log.read_text().splitlines():
            self._failed(**json.loads(line))
        self.at = notes[0]
        if not notes[1]:
            came = "hung" if status == -signal.SIGALRM else "crashed"
            self.counts[came] += 1
            self._failed(self.at, came, f"status {status}")
            self.at += 1

    def _failed(self, number: int, came: str, site: str, message: str = "") -> None:
        size = len(input_of(self.name, self.seed, number))
        line = {"reader": self.name, "number": number, "seed": self.seed, "bytes": size, "message": message}
        key = f"{self.name}: {came}: {site}"
        if key not in self.failures:
            print(f"{key} (seed {self.seed}, input {number}) {message}", file=sys.stderr, flush=True)
        found = self.failures.setdefault(key, {**line, "times": 0})
        # the smallest tells most
        found |= {**(line if size < found["bytes"] else {}), "times": found["times"] + 1}


def _save(failures: dict[str, dict[str, Any]]) -> None:
    for key, found in failures.items():
        folder = _folder(found["reader"])
        folder.mkdir(parents=True, exist_ok=True)
        # no suffix that a tool would look for
        name = f"{zlib.crc32(key.encode()):08x}.damaged"
        (folder / name).write_bytes(input_of(found["reader"], found["seed"], found["number"]))
    if failures:
        pack(HERE)


def _folder(name: str) -> Path:
    return HERE / "regressions" / name.replace("/", "_").replace(":", "")


def kept(name: str) -> list[Path]:
    """List the inputs that once broke something in a reader."""
    folder = _folder(name)
    return sorted(folder.iterdir()) if folder.is_dir() else []


def input_of(name: str, seed: int, number: int) -> bytes:
    """Return an input by its number; negative ones are those that once broke something."""
    reader = READERS[name]
    if number < 0:
        return kept(name)[number].read_bytes()
    data = (HERE / reader.root / reader.file).read_bytes()
    return mutated(data, reader.layer, random.Random(zlib.crc32(f"{name} {seed} {number}".encode())))


def copied(reader: Reader, folder: Path) -> Path:
    """Copy what a reader is given into a folder; return the copy."""
    whole, copy = HERE / reader.root, folder / Path(reader.root).name
    if not copy.exists():
        shutil.copytree(whole, copy) if whole.is_dir() else shutil.copy(whole, copy)
    return copy


def _outcome(reader: Reader, path: Path) -> tuple[str, ...]:
    """Read, and return what came: its name, and for a failure where and what."""
    try:
        found = reader.read(path)
    except Exception as error:
        # as the command line prints it
        line = message(str(error) if isinstance(error, PopError) else describe(error) or str(error))
        # not the name alone: "result" and "vectors" are words of many a message that names no file
        named = any(place in line for place in (str(path), f"/{HERE.name}/"))
        if isinstance(error, OSError) and describe(error) is not None and named:
            return ("told",)
        known = isinstance(error, PopError) or (isinstance(error, ValueError) and describe(error) is not None)
        if known and "\n" not in line and len(line) < LONGEST and named:
            return ("refused",)
        frames = traceback.extract_tb(error.__traceback__)
        # our own line says more than the library's that it called
        ours = [frame for frame in frames if "site-packages" not in frame.filename and "/lib/" not in frame.filename]
        frame = (ours or frames)[-1]
        site = f"{type(error).__name__} at {os.path.basename(frame.filename)}:{frame.lineno}"
        return "escaped", site, line[:200]
    bad = [key for key, value in found.items() if not torch.isfinite(value).all()] if reader.finite else []
    return ("escaped", f"not finite: {bad[0]}", "") if bad else ("read",)


def mutated(data: bytes, layer: str, rng: random.Random) -> bytes:
    """Change a file; in half of the cases what lies inside its compression, which is put on again.

    Args:
        data: the file.
        layer: "plain", "text", "gzip", "zip" or "glb".
        rng: decides.
    """
    if layer == "gzip" and rng.random() < 0.7:
        return gzip.compress(_several(gzip.decompress(data), False, rng), 1, mtime=0)
    if layer == "zip" and rng.random() < 0.7:
        return _in_a_zip(data, rng)
    if layer == "glb" and rng.random() < 0.7:
        return _in_a_glb(data, rng)
    return _several(data, layer == "text" and rng.random() < 0.8, rng)


def _several(data: bytes, words: bool, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        data = _word(data, rng) if words else _bytes(data, rng)
    return data


def _in_a_zip(data: bytes, rng: random.Random) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(written, "w") as new:
        names = old.namelist()
        chosen, how = rng.choice(names), rng.random()
        for name in names:
            content = old.read(name)
            if name == chosen:
                if how < 0.1:
                    continue
                content = _several(content, name.endswith(".json") and how < 0.8, rng)
            new.writestr(zipfile.ZipInfo(name), content)
            if name == chosen and how > 0.95:
                new.writestr(zipfile.ZipInfo(name + "x"), content)
    return written.getvalue()


def _in_a_glb(data: bytes, rng: random.Random) -> bytes:
    """Change the JSON or the binary chunk of a glTF file, with the lengths that they then have."""
    at, chunks = 12, list[tuple[bytes, bytes]]()
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "little")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 8 + length
    chosen = rng.randrange(len(chunks))
    made = b""
    for place, (kind, content) in enumerate(chunks):
        if place == chosen:
            content = _several(content, kind == b"JSON", rng)
        content += b" " * (-len(content) % 4)
        made += struct.pack("<I", len(content)) + kind + content
    return data[:8] + struct.pack("<I", 12 + len(made)) + made


def _bytes(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    if not changed:
        return rng.randbytes(rng.randrange(64))
    at = rng.randrange(min(len(changed), 64) if rng.random() < 0.4 else len(changed))
    match rng.randrange(8):
        case 0:
            changed[at] ^= 1 << rng.randrange(8)
        case 1:
            changed[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        case 2:
            form = rng.choice("hiq")
            size = struct.calcsize(form)
            value = rng.choice(_INTEGERS) % 2 ** (8 * size)
            changed[at : at + size] = value.to_bytes(size, rng.choice(("little", "big")))
        case 3:
            form = rng.choice(("<f", "<d", ">d"))
            number = rng.choice(_FLOATS)
            if form == "<f" and 3e38 < abs(number) < math.inf:
                number = 0.0
            packed = struct.pack(form, number)
            changed[at : at + len(packed)] = packed
        case 4:
            del changed[at:]
        case 5:
            del changed[at : at + rng.choice((1, 4, 8, 40))]
        case 6:
            changed[at:at] = rng.randbytes(rng.choice((1, 2, 8, 64)))
        case _:
            other = rng.randrange(len(changed))
            changed[at : at + 8] = changed[other : other + 8]
    # a PNG's chunk is read on only with a sound checksum
    return _sound_png(bytes(changed)) if rng.random() < 0.5 else bytes(changed)


def _sound_png(data: bytes) -> bytes:
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return data
    made, at = bytearray(data[:8]), 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        if at + 12 + length > len(data):
            break
        chunk = data[at + 4 : at + 8 + length]
        made += data[at : at + 4] + chunk + zlib.crc32(chunk).to_bytes(4, "big")
        at += 12 + length
    return bytes(made) + data[at:]


def _word(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    # what stands between white space, brackets, commas and quotes
    edges = [0, *(found.start() for found in _EDGES.finditer(text)), len(text)]
    place = rng.randrange(len(edges) - 1)
    start, end = edges[place], edges[place + 1]
    match rng.randrange(4):
        case 0 | 1:
            text = text[: start + 1] + rng.choice(_WORDS) + text[end:]
        case 2:
            text = text[:start] + text[end:]
        case _:
            other = rng.randrange(len(edges) - 1)
            text = text[:start] + text[edges[other] : edges[other + 1]] + text[start:]
    return text.encode("utf-8", "surrogateescape")
