"""A small file that asks for much memory is refused by what it states, before a byte of it is unpacked."""

from __future__ import annotations

import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.data.video import take_frames
from pop_fast.errors import PopError
from pop_fast.io import budget
from pop_fast.io.budget import check_memory
from pop_fast.io.formats import load_splat_file
from pop_fast.io.images import read_image
from pop_fast.io.read_back import read_arrays
from tests.app.children import in_a_child
from tests.app.conftest import Pop
from tests.app.damage import says

MB = 2**20


def _deflated(head: bytes, zeros: int) -> bytes:
    """Deflate bytes and many zeros at once: between full flushes, equal input becomes equal output."""
    packer = zlib.compressobj(9, wbits=-15)
    made = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(16 * MB)) + packer.flush(zlib.Z_FULL_FLUSH)
    return made + block * (zeros // (16 * MB)) + packer.compress(bytes(zeros % (16 * MB))) + packer.flush()


def _sum(check: Callable[[bytes, int], int], head: bytes, zeros: int, start: int) -> int:
    value, block = check(head, start), bytes(16 * MB)
    for at in range(0, zeros, len(block)):
        value = check(block[: zeros - at], value)
    return value


def _spz(path: Path) -> None:
    n = 5_000_000
    head, zeros = struct.pack("<IIIBBBB", 0x5053474E, 3, n, 3, 12, 0, 0), 65 * n
    end = struct.pack("<II", _sum(zlib.crc32, head, zeros, 0), len(head) + zeros)
    path.write_bytes(b"\x1f\x8b\x08" + bytes(7) + _deflated(head, zeros) + end)


def _sog(path: Path) -> None:
    """Write a splat of nothing, of whose pictures one is a GiB of zeros."""
    name, zeros = "means_l.webp", 2**30
    entry = {"codebook": [0.0] * 256, "files": [name]}
    means = {"mins": [0, 0, 0], "maxs": [0, 0, 0], "files": [name, name]}
    meta = {"version": 2, "count": 0, "means": means, "scales": entry, "quats": entry, "sh0": entry}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        at = archive.fp.tell()  # type: ignore[union-attr]
        archive.writestr(name, _deflated(b"", zeros))
    data = bytearray(path.read_bytes())
    sums = _sum(zlib.crc32, b"", zeros, 0)
    for start, method in ((at, 8), (data.rindex(b"PK\x01\x02"), 10)):
        struct.pack_into("<H", data, start + method, zipfile.ZIP_DEFLATED)
        struct.pack_into("<I", data, start + method + 6, sums)
        struct.pack_into("<I", data, start + method + 14, zeros)
    path.write_bytes(data)
    with zipfile.ZipFile(path) as archive, archive.open(name) as member:
        assert member.read(MB) == bytes(MB)


def _png(path: Path) -> None:
    side = 8192
    zeros = side * (1 + 6 * side)
    pixels = b"\x78\xda" + _deflated(b"", zeros) + struct.pack(">I", _sum(zlib.adler32, b"", zeros, 1))
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", side, side, 16, 2, 0, 0, 0)), (b"IDAT", pixels), (b"IEND", b""))
    made = [struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in chunks]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(made))


READ = """
import resource, sys
from pathlib import Path
import numpy as np, torch
from pop_fast.errors import PopError
from pop_fast.io.formats import load_splat_file
from pop_fast.io.images import read_image

before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    (read_image if sys.argv[1].endswith(".png") else load_splat_file)(Path(sys.argv[1]))
except PopError as error:
    print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


@pytest.mark.parametrize(("name", "write"), [("a.spz", _spz), ("a.sog", _sog), ("a.png", _png)])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, name: str, write: Callable[[Path], None]) -> None:
    write(tmp_path / name)
    assert (tmp_path / name).stat().st_size < 1.2 * MB
    outcome = in_a_child(READ, tmp_path / name)
    line, taken = outcome.out.splitlines()
    assert line.startswith(f"{tmp_path / name}: ")
    assert re.search(r"would take [0-9,.]+ MB of memory to read, and the file has [0-9.]+ MB", line)
    assert int(taken) < 64, "MiB over what importing took"


def test_a_command_says_it_in_a_line(tmp_path: Path, pop: Pop) -> None:
    _spz(tmp_path / "a.spz")
    says(
        pop("convert", tmp_path / "a.spz", tmp_path / "a.ply"), "a.spz", "numPoints of 5000000", "holds no such content"
    )


def test_a_count_of_gaussians_is_held_against_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    meta = {"version": 2, "count": 10**8, "means": {"mins": [0, 0, 0], "maxs": [0, 0, 0], "files": []}}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
    with pytest.raises(PopError, match=r"a\.sog: meta\.json\.count of 100000000 would take"):
        load_splat_file(path)


def test_arrays_of_a_run_are_held_against_their_file(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", counts=np.zeros(2**24, np.int64))
    with pytest.raises(PopError, match=r"a\.npz: 'counts\.npy' and what else is in it would take 134\.2 MB"):
        read_arrays(tmp_path / "a.npz", {"counts": ("i", 1)}, "train again")


def test_what_is_not_free_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.random.default_rng(0).integers(0, 256, (3000, 4200, 3), np.uint8)
    (tmp_path / "a.bmp").write_bytes(cv2.imencode(".bmp", image)[1].tobytes())
    assert read_image(tmp_path / "a.bmp").shape == image.shape
    monkeypatch.setattr(budget, "free_bytes", lambda: 50 * MB)
    with pytest.raises(
        PopError, match=r"a\.bmp: its header's size of 4200x3000 px would take .* and 52\.4 MB are free"
    ):
        read_image(tmp_path / "a.bmp")


def test_a_limit_of_this_process_counts(tmp_path: Path) -> None:
    script = """
import resource
from pathlib import Path
from pop_fast.machine import free_bytes

have = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (have + 2**28, have + 2**28))
print(free_bytes())
"""
    outcome = in_a_child(script)
    assert 2**27 < int(outcome.out) <= 2**28, outcome.err[-500:]


def test_pictures_of_one_colour_are_no_bombs(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((6000, 6000), 255, np.uint8))
    assert (tmp_path / "mask.png").stat().st_size < 2 * 36_000_000 / 200
    assert read_image(tmp_path / "mask.png").shape == (6000, 6000, 3)


def test_a_small_need_is_never_questioned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "free_bytes", lambda: 0)
    check_memory("a", 2**26, 1, "x", "y")
    with pytest.raises(PopError, match=r"^a: x would take .* and 0\.0 MB are free; y$"):
        check_memory("a", 2**26 + 1, 2**30, "x", "y")


def test_a_picture_that_states_no_size_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"P5 2 2 255\n" + bytes(4))
    with pytest.raises(PopError, match=r"a\.png: is no image that states its size"):
        read_image(tmp_path / "a.png")


def test_a_video_whose_frames_find_no_room_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (3072, 3072))
    for shade in (50, 200):
        film.write(np.full((3072, 3072, 3), shade, np.uint8))
    film.release()
    monkeypatch.setattr(budget, "free_bytes", lambda: 50 * MB)
    with pytest.raises(
        PopError, match=r"a\.avi: its frames of 3072x3072 px would take .* and 52\.4 MB are free; convert"
    ):
        take_frames(tmp_path / "a.avi", tmp_path / "out", 3)
