"""Files of splats that are damaged, cut off or of another version: named, and never read as something else."""

from __future__ import annotations

import gzip
import io
import json
import struct
import sys
import tempfile
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.faults.ksplat import ksplat_of
from pop_fast.errors import PopError
from pop_fast.io.formats import FORMATS, encoded, load_splat_file
from tests.app.clouds import many

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


@given(level=st.integers(0, 2), data=st.data())
def test_a_ksplat_that_lost_or_changed_bytes_is_read_or_refused_by_name(level: int, data: st.DataObject) -> None:
    whole = ksplat_of(many(5, 3), level, 1)
    heads = st.one_of(st.integers(0, 47), st.integers(4096, 4138), st.integers(5120, 5162), st.integers(6144, 9999))
    at = min(data.draw(heads), len(whole) - 1)
    damaged = whole[:at] if data.draw(st.booleans()) else whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.ksplat"
        path.write_bytes(damaged)
        found, refusal = read_or_refused(path)
    assert str(path) in refusal if found is None else all(value.isfinite().all() for value in found.values())


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


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
def test_a_file_that_lost_or_changed_bytes_is_read_or_refused_by_name(name: str, data: st.DataObject) -> None:
    whole = encoded(name, many(5, 3))
    at = data.draw(st.integers(0, len(whole) - 1))
    damaged = whole[:at] if data.draw(st.booleans()) else whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"x{FORMATS[name].suffix}"
        path.write_bytes(damaged)
        found, refusal = read_or_refused(path)
    assert str(path) in refusal if found is None else all(value.isfinite().all() for value in found.values())


def read_or_refused(path: Path) -> tuple[dict[str, Tensor] | None, str]:
    try:
        return load_splat_file(path)[0], ""
    except PopError as error:
        return None, str(error)


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
