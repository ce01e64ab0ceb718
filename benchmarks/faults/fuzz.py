"""Damaged input: every reader gives a result or a sentence, and never ends, hangs or surprises its process."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import tempfile
import time
import traceback
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import torch

from pop_fast.cli.errors import describe
from pop_fast.cli.printable import message
from pop_fast.errors import PopError

from .corpus import HERE
from .forks import start, wait
from .mutate import mutated
from .readers import READERS, Reader

# of one input: seconds, bytes over what importing takes, letters of a refusal
SECONDS, MEMORY, LONGEST = 20, 2**30, 1_300
OUTCOMES = ("read", "refused", "told", "escaped", "crashed", "hung")


def fuzz(inputs: int, minutes: float, seed: int, only: str | None = None) -> dict[str, Any]:
    """Give mutated files to all readers in turn.

    Args:
        inputs: of each reader in a round.
        minutes: for rounds after the first one.
        seed: of the first round; every round has one more.
        only: a reader's name, or None for all.

    Returns:
        By reader how often what came out, and every failure once by where it came from.
    """
    end = time.monotonic() + 60.0 * minutes
    counts: dict[str, Counter[str]] = {name: Counter() for name in READERS if only in (None, name)}
    failures: dict[str, dict[str, Any]] = {}
    first = seed
    while seed == first or time.monotonic() < end:
        for name in counts:
            for line in _round(name, inputs, seed, regressions=seed == first):
                counts[name][line["came"]] += 1
                if line["came"] in ("escaped", "crashed", "hung"):
                    key = f"{name}: {line['came']} {line.get('site', '')}"
                    failures.setdefault(key, {**line, "times": 0})["times"] += 1
        seed += 1
    table = {name: {outcome: found[outcome] for outcome in OUTCOMES} for name, found in counts.items()}
    return {
        "first_seed": first,
        "rounds": seed - first,
        "inputs_a_round": inputs,
        "readers": table,
        "failures": failures,
    }


def _round(name: str, inputs: int, seed: int, regressions: bool) -> list[dict[str, Any]]:
    """Read inputs in children, a new one after each that died, and list what came of each."""
    lines: list[dict[str, Any]] = []
    at = -len(kept(name)) if regressions else 0
    with tempfile.TemporaryDirectory() as folder:
        log, said = Path(folder) / "log", Path(folder) / "said"
        while at < inputs:
            log.write_text("")
            pid = start(lambda at=at: _read_all(name, at, inputs, seed, Path(folder), log), said, MEMORY)
            status = wait(pid)
            found = [json.loads(line) for line in log.read_text().splitlines()]
            lines += [line for line in found if "came" in line]
            if status == 0 and found and found[-1] == {"end": inputs}:
                break
            at = found[-1].get("number", inputs) if found else at
            came = "hung" if status == -signal.SIGALRM else "crashed"
            lines.append({"number": at, "seed": seed, "came": came, "site": f"status {status}"})
            at += 1
    return lines


def kept(name: str) -> list[Path]:
    """List the inputs that once broke something in a reader."""
    folder = HERE / "regressions" / name.replace("/", "_").replace(":", "")
    return sorted(folder.iterdir()) if folder.is_dir() else []


def input_of(name: str, seed: int, number: int) -> bytes:
    """Return an input by its number; negative ones are those that once broke something."""
    reader = READERS[name]
    if number < 0:
        return kept(name)[number].read_bytes()
    data = (HERE / reader.root / reader.file).read_bytes()
    return mutated(data, reader.layer, random.Random(zlib.crc32(f"{name} {seed} {number}".encode())))


def _read_all(name: str, first: int, last: int, seed: int, folder: Path, log: Path) -> None:
    """In a child: read inputs one after the other; what is begun is noted before it is done."""
    reader = READERS[name]
    copy = folder / Path(reader.root).name
    if not copy.exists():
        whole = HERE / reader.root
        shutil.copytree(whole, copy) if whole.is_dir() else shutil.copy(whole, copy)
    target = copy / reader.file if reader.file else copy
    with open(log, "a", encoding="utf-8") as notes:
        for number in range(first, last):
            target.write_bytes(input_of(name, seed, number))
            print(json.dumps({"number": number}), file=notes, flush=True)
            signal.alarm(SECONDS)
            came = _outcome(reader, copy)
            signal.alarm(0)
            print(json.dumps({"number": number, "seed": seed, **came}), file=notes, flush=True)
        print(json.dumps({"end": last}), file=notes, flush=True)


def _outcome(reader: Reader, path: Path) -> dict[str, Any]:
    try:
        found = reader.read(path)
    except Exception as error:
        # as the command line prints it
        line = message(str(error))
        if isinstance(error, PopError) and "\n" not in line and len(line) < LONGEST and path.name in line:
            return {"came": "refused"}
        if isinstance(error, (MemoryError, OSError)) and describe(error) is not None:
            return {"came": "told"}
        frame = traceback.extract_tb(error.__traceback__)[-1]
        site = f"{type(error).__name__} at {os.path.basename(frame.filename)}:{frame.lineno}"
        return {"came": "escaped", "site": site, "message": line[:200]}
    bad = [key for key, value in found.items() if not torch.isfinite(value).all()] if reader.finite else []
    return {"came": "escaped", "site": f"not finite: {bad[0]}"} if bad else {"came": "read"}
