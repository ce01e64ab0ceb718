"""A flipped bit in a checkpoint or a PLY's header: the file is refused, or what is read is as it was.

Fixed seeds, in a process of its own: what a damaged file does to the interpreter is seen from outside only.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from pop_fast.errors import PopError
from pop_fast.io.ply import load_ply, save_ply
from pop_fast.io.ply_rows import read_points
from pop_fast.train import checkpoint as ckpt
from tests.app.children import in_a_child
from tests.app.conftest import Outcome

CHILD = "import sys; from tests.app.test_bit_rot import CHILDREN; CHILDREN[sys.argv[1]](*sys.argv[2:])"


def flipped(data: bytes, seed: int, times: int) -> Iterator[bytes]:
    """Flip one bit at a time, at places that a seed draws; a third of them in the last kilobytes, the list of a zip."""
    rng = random.Random(seed)
    for k in range(times):
        place = rng.randrange(max(0, len(data) - 4096), len(data)) if k % 3 == 0 else rng.randrange(len(data))
        changed = bytearray(data)
        changed[place] ^= 1 << rng.randrange(8)
        yield bytes(changed)


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    return type(a) is type(b) and a == b


def count(data: bytes, path: Path, changes: Iterator[bytes], read: Callable[[Path], Any]) -> None:
    """Tell how many changes of a file were refused, read as what it was, and read as something else."""
    path.write_bytes(data)
    whole, found = read(path), dict.fromkeys(("refused", "named", "same", "different", "finite"), 0)
    for changed in changes:
        path.write_bytes(changed)
        try:
            content = read(path)
        except PopError as error:
            found["refused"] += 1
            found["named"] += str(path) in str(error) and len(str(error)) < 1000
        else:
            found["same" if same(content, whole) else "different"] += 1
            tensors = content if isinstance(content, dict) and "splats" not in content else {}
            found["finite"] += all(torch.isfinite(value).all() for value in tensors.values())
    print(json.dumps(found))


def flip_a_checkpoint(original: str, folder: str) -> None:
    data = Path(original).read_bytes()
    count(data, Path(folder) / "ckpt_9_rank0.pt", flipped(data, 4, 600), ckpt.load_checkpoint)


def mutate_a_ply(folder: str) -> None:
    path = Path(folder) / "x.ply"
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    save_ply(path, {key: torch.randn((4, *shape), generator=generator) for key, shape in shapes.items()})
    data = path.read_bytes()

    def read(path: Path) -> dict[str, torch.Tensor]:
        # what is refused as a splat may still be read as points
        try:
            return load_ply(path)
        finally:
            with suppress(PopError):
                read_points(path)

    count(data, path, mutated(data, 5, 1500), read)


def mutated(data: bytes, seed: int, times: int) -> Iterator[bytes]:
    """Change, remove, repeat or swap words and lines of a header, or put numbers into it that nobody counts to."""
    head, rows = data.split(b"end_header\n")
    rng = random.Random(seed)
    words = [
        b"-1",
        b"0",
        b"4294967296",
        b"9" * 30,
        b"list",
        b"uchar",
        b"double",
        b"element",
        b"property",
        b"vertex",
        b"",
    ]
    words += [
        b"ascii",
        b"binary_big_endian",
        b"nan",
        b"x",
        b"end_header",
        b"comment",
        b"\xff",
        b"\r",
        b"1e9",
        b"list uchar int",
    ]
    for _ in range(times):
        lines = head.split(b"\n")
        for _ in range(rng.choice((1, 1, 2, 4))):
            at = rng.randrange(len(lines))
            match rng.randrange(5):
                case 0:
                    parts = lines[at].split(b" ")
                    parts[rng.randrange(len(parts))] = rng.choice(words)
                    lines[at] = b" ".join(parts)
                case 1:
                    del lines[at]
                    lines = lines or [b""]
                case 2:
                    lines.insert(rng.randrange(len(lines)), lines[at])
                case 3:
                    other = rng.randrange(len(lines))
                    lines[at], lines[other] = lines[other], lines[at]
                case _:
                    lines.insert(at, b"element foo " + rng.choice(words))
        yield b"\n".join(lines) + b"end_header\n" + rows[: rng.choice((len(rows), rng.randrange(len(rows))))]


CHILDREN = {"flip": flip_a_checkpoint, "mutate": mutate_a_ply}


def counts(outcome: Outcome) -> dict[str, int]:
    assert outcome.status == 0, (outcome.status, outcome.err[-3000:])
    return json.loads(outcome.out)


def test_no_flipped_bit_of_a_checkpoint_is_read_as_another_number(stopped: Path, tmp_path: Path) -> None:
    found = counts(in_a_child(CHILD, "flip", ckpt.checkpoint_path(stopped, 9), tmp_path))
    assert found["different"] == 0
    assert found["refused"] + found["same"] == 600
    # and nearly all are seen; what is not lies between the members of the zip
    assert found["named"] == found["refused"] > 500


def test_no_header_of_a_ply_ends_the_interpreter(tmp_path: Path) -> None:
    found = counts(in_a_child(CHILD, "mutate", tmp_path))
    assert found["named"] == found["refused"] > 700
    assert found["same"] + found["different"] > 20
    # names exchanged are another splat, but never one with a number that is none
    assert found["finite"] == found["same"] + found["different"]
