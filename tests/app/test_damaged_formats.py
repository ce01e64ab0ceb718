"""Files of splats that are damaged, cut off or of another version: named, and never read as something else."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import sys
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard

from benchmarks.faults.ksplat import ksplat_of
from pop_fast.data.unpack import take_frames
from pop_fast.errors import PopError
from pop_fast.io import read_back
from pop_fast.io.formats import FORMATS, encoded, load_splat_file
from pop_fast.io.images import read_image
from pop_fast.io.read_back import check_memory, read_arrays
from tests.app.clouds import many
from tests.app.conftest import Pop, in_a_child
from tests.app.damage import says

# 2^28 bytes in a few thousand
BOMB = zstandard.compress(bytes(2**28))


def header(**changes: int) -> bytes:
    """An SPZ file of one Gaussian, with a field of its header changed."""
    fields = {"magic": 0x5053474E, "version": 3, "n": 1, "degree": 0, "bits": 12, "flags": 0, "reserved": 0, **changes}
    return gzip.compress(struct.pack("<IIIBBBB", *fields.values()) + bytes(20))


# one Gaussian in version 3 that promises extensions
RAW_3 = struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 2, 0) + bytes(20)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "is cut off in its header"),
        (b"not gzip at all!", "its gzip stream is damaged"),
        (header(magic=1), "begins with 0x1, not 0x5053474e"),
        (header(version=9), "version is 9; write it as version 2, 3 or 4"),
        (header(degree=4), "shDegree is 4"),
        (header(bits=30), "fractionalBits is 30"),
        (header(n=2), "ends after 20 of 40 bytes"),
        (header(n=2**31), "numPoints is 2147483648, more than"),
        (header(flags=128), "holds levels of detail"),
        (header(flags=2), None),
        (gzip.compress(RAW_3 + struct.pack("<II", 7, 9)), "extension 0x7 of 9 bytes is cut off"),
        (gzip.compress(RAW_3 + struct.pack("<IIB", 0xADBE0003, 1, 2)), "its coordinates are of kind 2"),
        (gzip.compress(RAW_3 + struct.pack("<II3s", 0x504F0001, 3, b"{[}")), "extension 0x504f0001 is damaged"),
        (
            gzip.compress(RAW_3 + struct.pack("<II15s", 0x504F0001, 15, b'{"pop_frame":1}')),
            "pop_frame is '1', which is",
        ),
    ],
    ids=[
        *("empty", "no gzip", "magic", "version", "degree", "bits", "cut off", "promise", "levels", "none"),
        *("extension", "coordinates", "JSON", "frame"),
    ],
)
def test_a_damaged_spz_is_named(data: bytes, said: str | None) -> None:
    if said is None:
        assert len(FORMATS["spz"].decode(data, Path("x.spz"))) == 1
        return
    with pytest.raises(PopError, match=f"x.spz: {said}"):
        FORMATS["spz"].decode(data, Path("x.spz"))


def streams(change: Callable[[dict[str, Any]], Any], level: int = 3) -> bytes:
    """An SPZ file of version 4 with one Gaussian, with something of it changed."""
    plain = [bytes(9), bytes(1), bytes(3), bytes(3), bytes(4)]
    parts: dict[str, Any] = {"n": 1, "degree": 0, "bits": 12, "flags": 0, "extensions": b"", "version": 4, "tail": b""}
    parts["streams"] = [zstandard.compress(column, level) for column in plain]
    parts["sizes"] = [len(column) for column in plain]
    change(parts)
    table = parts.get("table", 32 + len(parts["extensions"]))
    names = ("version", "n", "degree", "bits", "flags")
    count = parts.get("count", len(parts["streams"]))
    head = struct.pack("<IIIBBBBI12x", 0x5053474E, *(parts[name] for name in names), count, table)
    sizes = zip(parts["streams"], parts["sizes"], strict=True)
    toc = b"".join(struct.pack("<QQ", len(stream), size) for stream, size in sizes)
    return head + parts["extensions"] + toc + b"".join(parts["streams"]) + parts["tail"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: p.update(version=5), "version is 5"),
        (lambda p: p.update(n=2**31), "numPoints is 2147483648, more than"),
        (lambda p: p.update(n=2), "stream 0 is to hold 9 bytes, not 18"),
        (lambda p: p.update(n=0), "numStreams is 5; its degree and count make 0"),
        (lambda p: p.update(degree=1), "numStreams is 5; its degree and count make 6"),
        (lambda p: p.update(count=4), "numStreams is 4"),
        (lambda p: p.update(table=31), "tocByteOffset is 31"),
        (lambda p: p.update(table=2**31), "tocByteOffset is 2147483648"),
        (lambda p: p["streams"].__setitem__(2, b"no Zstandard"), "stream 2 is damaged"),
        (lambda p: p["streams"].__setitem__(4, p["streams"][4][:-3]), "stream 4 (is damaged|holds other)"),
        (lambda p: p["streams"].__setitem__(1, zstandard.compress(bytes(2))), "stream 1 holds other than its 1 bytes"),
        # 2^28 bytes of zeros, of which one byte too many is made
        (lambda p: p["streams"].__setitem__(3, BOMB), "stream 3 holds other than its 3 bytes"),
        (lambda p: p.update(flags=2, extensions=struct.pack("<II", 1, 2**31)), "extension 0x1 of 2147483648 bytes"),
    ],
    ids=[
        *("version", "promise", "more", "none", "degree", "count", "table", "far table", "kind"),
        *("cut", "long", "bomb", "extension"),
    ],
)
def test_a_damaged_spz_of_version_4_is_named(change: Callable[[dict[str, Any]], Any], said: str) -> None:
    with pytest.raises(PopError, match=f"x.spz: {said}"):
        FORMATS["spz-4"].decode(streams(change), Path("x.spz"))
    assert len(FORMATS["spz-4"].decode(streams(lambda p: None), Path("x.spz"))) == 1


def test_a_file_of_version_4_that_is_cut_off_is_named() -> None:
    whole = streams(lambda p: None)
    for end in (20, 32, 100, len(whole) - 1):
        with pytest.raises(PopError, match=r"x.spz: (is cut off|tocByteOffset is 32)"):
            FORMATS["spz-4"].decode(whole[:end], Path("x.spz"))


def test_version_4_without_its_package_is_refused_by_the_package_s_name(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = encoded("spz-4", many(5))
    monkeypatch.setitem(sys.modules, "zstandard", None)
    for use in (lambda: encoded("spz-4", many(5)), lambda: FORMATS["spz-4"].decode(whole, Path("x.spz"))):
        with pytest.raises(PopError, match="pip install zstandard"):
            use()


def test_no_more_of_a_zstandard_stream_is_made_than_its_column_holds() -> None:
    data = streams(lambda p: p["streams"].__setitem__(3, BOMB))
    tracemalloc.start()
    with pytest.raises(PopError, match="stream 3 holds other than its 3 bytes"):
        FORMATS["spz-4"].decode(data, Path("x.spz"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**22


@pytest.mark.parametrize(
    ("at", "change", "said"),
    [
        (0, b"\1\0", "version is 1.0"),
        (1, b"\0", "version is 0.0"),
        (20, b"\3", "compressionLevel is 3"),
        (4, b"\xff\xff\xff\xff", "maxSectionCount is 4294967295, more than"),
        (4, b"\0\0\0\0", "splatCount is 12, and its sections hold other"),
        (16, b"\7", "splatCount is 7"),
        (4096, b"\3", "section 0: splatCount is 3, over maxSplatCount 2"),
        (4096 + 4, b"\xff\xff\xff\xff", "section 0: its rows end at byte"),
        (4096 + 12, b"\xff\xff\xff\xff", "section 0: its rows end at byte"),
        (4096 + 20, b"\x10", "section 0: bucketStorageSizeBytes is 16, not 12"),
        (4096 + 32, b"\xff\xff\xff\xff", "has 4294967295 full and 1 other buckets of 2"),
        (4096 + 36, b"\xff\xff\xff\xff", "section 0: its rows end at byte"),
        (4096 + 40, b"\4", "section 0: sphericalHarmonicsDegree is 4"),
        (4096 + 1024 + 16, b"\0\0\xc0\x7f", "means of Gaussian 2 is nan"),
        (4096 + 2 * 1024, b"\0\0\0\0", "its buckets hold 1 of 2 Gaussians"),
        (4096 + 2 * 1024 + 4 + 2 * 12 + 6, b"\0\xbc", "scale of Gaussian 0 is "),
    ],
)
def test_a_damaged_ksplat_is_named(at: int, change: bytes, said: str, tmp_path: Path) -> None:
    whole = ksplat_of(many(12, 8), 1)
    path = tmp_path / "x.ksplat"
    path.write_bytes(whole[:at] + change + whole[at + len(change) :])
    with pytest.raises(PopError, match=f"x.ksplat: {said}"):
        load_splat_file(path)
    path.write_bytes(whole)
    assert len(load_splat_file(path).params["means"]) == 12


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda folder, meta: (folder / "means_u.webp").unlink(), "means_u.webp: is absent, and meta.json names it"),
        (lambda folder, meta: (folder / "quats.webp").write_bytes(b"RIFF"), "meta.json: quats.webp is 0x0 pixels"),
        (
            lambda folder, meta: meta["sh0"].update(files=["../x.sog"]),
            "meta.json: names the file '../x.sog', which is not",
        ),
        (lambda folder, meta: meta["sh0"].update(files=["."]), "names the file '.', which is not"),
        (lambda folder, meta: meta.pop("version"), "meta.json: meta.json.version is None; write it as version 2"),
        (lambda folder, meta: meta["asset"].update(pop_frame={"name": "x"}), "meta.json: pop_frame is "),
        (lambda folder, meta: meta.update(x="y" * 2**20), "meta.json: has 10"),
    ],
    ids=["absent", "no image", "elsewhere", "folder", "version 1", "frame", "long"],
)
def test_a_damaged_sog_in_a_folder_is_named(damage: Callable[[Path, Any], Any], said: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(encoded("sog", many(9)))) as archive:
        archive.extractall(tmp_path)
    meta = json.loads((tmp_path / "meta.json").read_text())
    damage(tmp_path, meta)
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(PopError, match=said):
        load_splat_file(tmp_path / "meta.json")


def changed(change: Callable[[dict[str, Any]], Any]) -> bytes:
    """A SOG file of nine Gaussians with another meta.json."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(encoded("sog", many(9)))) as old, zipfile.ZipFile(buffer, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "meta.json":
                meta = json.loads(data)
                change(meta)
                data = json.dumps(meta).encode()
            new.writestr(name, data)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"PK nothing", "is no readable ZIP file"),
        (changed(lambda meta: meta.update(version=3)), "meta.json.version is 3"),
        (changed(lambda meta: meta.update(count=-1)), "meta.json.count is -1"),
        (changed(lambda meta: meta.update(count=10)), None),
        (changed(lambda meta: meta.update(count=1000)), "means_l.webp is 3x3 pixels; 1000 are needed"),
        (changed(lambda meta: meta.pop("sh0")), "meta.json is not that of SOG version 2"),
        (changed(lambda meta: meta["scales"].update(codebook=[1.0])), "meta.json is not that of SOG version 2"),
        (changed(lambda meta: meta["quats"].update(files=["gone.webp"])), "meta.json is not that of SOG version 2"),
        (changed(lambda meta: meta["shN"].update(bands=4)), "meta.json.shN has 9 rows of 4 bands"),
        (changed(lambda meta: meta["shN"].update(count=3)), "shN_labels names row 8 of a palette of 3"),
        (changed(lambda meta: meta["means"].update(maxs=[1e30, 1, 1])), "means of Gaussian . is"),
    ],
    ids=["zip", "version", "count", "one more", "many more", "no colour", "codes", "image", "bands", "row", "overflow"],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_damaged_sog_is_named(data: bytes, said: str | None) -> None:
    with pytest.raises(PopError, match=f"x.sog: {said or ''}"):
        FORMATS["sog"].decode(data, Path("x.sog"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda g: g["meshes"][0]["primitives"][0]["extensions"].clear(), "holds no splat"),
        (lambda g: g["nodes"][0].update(translation=[1, 2, 3]), "a node moves its splat"),
        (lambda g: g["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "no attribute POSITION"),
        (lambda g: g["accessors"][1].update(count=2**40), "ROTATION is cut off"),
        (lambda g: g["accessors"][0].update(componentType=5123), "POSITION is not stored as float32"),
        (lambda g: g["bufferViews"][0].update(byteLength=2**40), "reaches beyond the binary chunk"),
        (lambda g: g["accessors"][0].update(count=4), "attributes have different counts"),
        (lambda g: g.update(meshes=7), "does not follow glTF 2.0"),
    ],
    ids=["none", "moved", "absent", "cut off", "kind", "view", "counts", "meshes"],
)
def test_a_damaged_glb_is_named(change: Callable[[dict[str, Any]], Any], said: str) -> None:
    whole = encoded("gltf", many(5))
    length = struct.unpack("<I", whole[12:16])[0]
    content = json.loads(whole[20 : 20 + length])
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + whole[20 + length :]
    with pytest.raises(PopError, match=said):
        FORMATS["gltf"].decode(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks, Path("x.glb"))


# A small file that asks for much memory is refused by what it states, before a byte of it is unpacked.

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
from pop_fast.io import read_back
from pop_fast.io.images import read_image

for path in sys.argv[1:]:
    # the most memory so far: a later file that takes no more than an earlier one does not raise it
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        (read_image if path.endswith(".png") else load_splat_file)(Path(path))
    except PopError as error:
        print(error)
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    bombs = {tmp_path / "a.spz": _spz, tmp_path / "a.sog": _sog, tmp_path / "a.png": _png}
    for path, write in bombs.items():
        write(path)
        assert path.stat().st_size < 1.2 * MB
    lines = in_a_child(READ, *bombs).out.splitlines()
    assert len(lines) == 2 * len(bombs)
    for path, line in zip(bombs, lines[::2], strict=True):
        assert line.startswith(f"{path}: ")
        assert re.search(r"would take [0-9,.]+ MB of memory to read, and the file has [0-9.]+ MB", line)
    assert sum(map(int, lines[1::2])) < 64, "MiB that all of them took over what importing took"


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
    monkeypatch.setattr(read_back, "free_bytes", lambda: 50 * MB)
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
    monkeypatch.setattr(read_back, "free_bytes", lambda: 0)
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
    monkeypatch.setattr(read_back, "free_bytes", lambda: 50 * MB)
    with pytest.raises(
        PopError, match=r"a\.avi: its frames of 3072x3072 px would take .* and 52\.4 MB are free; convert"
    ):
        take_frames(tmp_path / "a.avi", tmp_path / "out", 3)


# Files of a result folder that no run has written so: one line that names file and entry, never a traceback.

NOT_JSON = [b"", b"{", b"\xff\xfe", b"[" * 5000, b"1" * 5000]
NO_OBJECT = [b"[]", b"3", b"null", b'"text"']
KEYS = ("num_GS", "step", "seconds", "n_blended", "opacity_above_0.9")
NO_NUMBER = ["text", [], {}, True, 10**400, 1e300]


@pytest.mark.parametrize("data", [*NOT_JSON, *NO_OBJECT], ids=range(9))
@pytest.mark.parametrize("command", ["report", "compare"])
def test_statistics_that_are_no_object_are_named(pop: Pop, result: Path, command: str, data: bytes) -> None:
    path = result / "stats" / "val_step0029.json"
    path.write_bytes(data)
    says(pop(command, result), str(path), "is not JSON" if data in NOT_JSON else "must be an object", "pop eval")


@pytest.mark.parametrize("data", [*NOT_JSON[1:], *NO_OBJECT, b"{}", b'{"step": "x"}', b'{"step": true}'], ids=range(11))
def test_a_record_that_is_no_object_with_a_step_is_named(pop: Pop, result: Path, data: bytes) -> None:
    path = result / "metrics.jsonl"
    path.write_bytes(path.read_bytes() + data + b"\n")
    number = len(path.read_bytes().splitlines())
    says(pop("report", result), f"{path}: line {number}", "remove the file, or train again")


def test_a_record_that_a_kill_cut_off_is_left_out(pop: Pop, result: Path) -> None:
    path = result / "metrics.jsonl"
    path.write_bytes(path.read_bytes() + b'{"step": 30, "view": "\xc3')
    assert pop("report", result).status == 0


# every value under one key, and one value under every other
ODD = [*(("psnr", value) for value in NO_NUMBER), *((key, "text") for key in KEYS)]


@pytest.mark.parametrize(("key", "value"), ODD, ids=range(len(ODD)))
def test_a_number_that_is_none_is_named(pop: Pop, result: Path, key: str, value: Any) -> None:
    path = result / "stats" / "val_step0029.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    for command in ("report", "compare"):
        says(pop(command, result), f"{path}: {key} is ", "it must be a number")


@pytest.mark.parametrize(("key", "value"), [("machine", 3), ("backend", []), ("versions", "2"), ("method", {})])
def test_a_text_that_is_none_is_named(pop: Pop, result: Path, key: str, value: Any) -> None:
    path = result / "stats" / "val_step0029.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    says(pop("compare", result), f"{path}: {key} is ")


def test_what_is_absent_or_null_becomes_a_dash(pop: Pop, result: Path) -> None:
    for path in (result / "stats").iterdir():
        path.write_text(json.dumps(dict.fromkeys(json.loads(path.read_text()))))
    assert pop("report", result).status == 0
    assert "–" in pop("compare", result).out


@pytest.mark.parametrize("name", ["init_scale", "max_steps", "l2_stop_iter"])
def test_a_setting_beyond_all_floats_is_named(pop: Pop, result: Path, name: str) -> None:
    path = result / "cfg.json"
    config = json.loads(path.read_text())
    config["resolved"][name] = 10**400
    path.write_text(json.dumps(config))
    says(pop("report", result), str(path), f"config.{name} is a number beyond 2^53")


@pytest.mark.parametrize(("file", "command"), [("cfg.json", "report"), ("capture.json", "eval")])
def test_settings_nested_deeper_than_python_reads_are_named(pop: Pop, result: Path, file: str, command: str) -> None:
    (result / file).write_bytes(b"[" * 5000)
    says(pop(command, result), str(result / file))


@pytest.mark.parametrize("damage", ["empty", "cut", "short", "no zip", "flipped"])
@pytest.mark.parametrize("stem", ["opacity_step-1", "val_step29_0000"])
def test_arrays_that_are_damaged_are_named(pop: Pop, result: Path, stem: str, damage: str) -> None:
    path = result / "report_data" / f"{stem}.npz"
    data = path.read_bytes()
    # in the array itself, behind the name that stands before it
    place = data.index(b"counts.npy" if "opacity" in stem else b"render.npy") + 60
    flipped = data[:place] + bytes([data[place] ^ 255]) + data[place + 1 :]
    damaged = {"empty": b"", "cut": data[: len(data) // 2], "short": data[:-1], "no zip": b"text", "flipped": flipped}
    path.write_bytes(damaged[damage])
    says(pop("report", result), f"{path}: is damaged", "remove the file, or train again")


@pytest.mark.parametrize(
    ("stem", "name", "value"),
    [
        ("opacity_step-1", "counts", None),
        ("opacity_step-1", "counts", np.zeros(3, int)),
        ("opacity_step-1", "counts", np.zeros((2, 2), int)),
        ("opacity_step-1", "counts", np.zeros(0, int)),
        ("opacity_step-1", "counts", np.array("x")),
        ("val_step29_0000", "render", None),
        ("val_step29_0000", "render", np.zeros(3, np.uint8)),
        ("val_step29_0000", "photo", np.zeros((4, 4, 3))),
        ("val_step29_0000", "psnr", np.zeros(2)),
        ("val_step29_0000", "ssim", np.array("x")),
        ("val_step29_0000", "name", np.array(3)),
        ("val_step29_0000", "dominant_ids", np.zeros((2, 2))),
        ("val_step29_0000", "dominant_ids", np.zeros((2, 2, 2), np.int32)),
    ],
)
def test_an_array_of_another_form_is_named(pop: Pop, result: Path, stem: str, name: str, value: Any) -> None:
    path = result / "report_data" / f"{stem}.npz"
    with np.load(path) as stored:
        arrays = {key: stored[key] for key in stored.files}
    arrays |= {} if value is None else {name: value}
    np.savez(path, **{key: array for key, array in arrays.items() if value is not None or key != name})
    says(pop("report", result), f"{path}: {name} ", "which no run writes")
