"""Files of splats that are damaged, cut off or of another version: named, and never read as something else."""

from __future__ import annotations

import gzip
import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pop_fast.errors import PopError
from pop_fast.io.formats import FORMATS, encoded, load_splat_file
from tests.app.clouds import many


def header(**changes: int) -> bytes:
    """An SPZ file of one Gaussian, with a field of its header changed."""
    fields = {"magic": 0x5053474E, "version": 3, "n": 1, "degree": 0, "bits": 12, "flags": 0, "reserved": 0, **changes}
    return gzip.compress(struct.pack("<IIIBBBB", *fields.values()) + bytes(20))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "is cut off in its header"),
        (b"not gzip at all!", "its gzip stream is damaged"),
        (header(magic=1), "begins with 0x1, not 0x5053474e"),
        (header(version=9), "version is 9; write it as version 2 or 3"),
        (header(degree=4), "shDegree is 4"),
        (header(bits=30), "fractionalBits is 30"),
        (header(n=2), "ends after 20 of 40 bytes"),
        (header(n=2**31), "numPoints is 2147483648, more than"),
        (struct.pack("<IIII", 0x5053474E, 4, 1, 0), "is SPZ of version 4 or later"),
    ],
    ids=["empty", "no gzip", "magic", "version", "degree", "bits", "cut off", "promise", "version 4"],
)
def test_a_damaged_spz_is_named(data: bytes, said: str) -> None:
    with pytest.raises(PopError, match=f"x.spz: {said}"):
        FORMATS["spz"].decode(data, Path("x.spz"))


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
