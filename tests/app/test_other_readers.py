"""Other programs' readers, and a description worked out by hand, on what we write."""

from __future__ import annotations

import gzip
import importlib
import itertools
import struct
import zipfile
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import zstandard

from benchmarks.faults.ksplat import ksplat_of
from pop_fast.io.formats import FORMATS, encoded, load_splat_file
from pop_fast.io.frame import Frame
from pop_fast.train.load_result import load_splat
from tests.app.clouds import decoded, degrees, many


def reader(name: str) -> ModuleType:
    """Import another program's reader, or skip with the reason."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed ({error}); pip install 'pop-splatting[formats-test]'")


@pytest.mark.parametrize("frame", [None, Frame("capture", tuple(map(tuple, np.eye(4).tolist())))])
@pytest.mark.parametrize("name", ["compressed-ply", "spz", "spz-4", "sog"])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_gsply_reads_what_we_write(name: str, bands: int, frame: Frame | None, tmp_path: Path) -> None:
    modules = {"compressed-ply": "gsply", "spz": "gsply.spz", "spz-4": "gsply.spz", "sog": "gsply.sog_reader"}
    module = reader(modules[name])
    if name == "sog":
        reader("imagecodecs")
    _, now, data = decoded(name, many(300, bands), frame=frame)
    path = tmp_path / f"x{FORMATS[name].suffix}"
    path.write_bytes(data)
    found = {"compressed-ply": "plyread", "spz": "read_spz", "spz-4": "read_spz", "sog": "sogread"}[name]
    theirs = getattr(module, found)(path)
    # it leaves SPZ in the frame of the file
    ours = now.turned("x") if name.startswith("spz") else now
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-5)
    np.testing.assert_allclose(theirs.scales, ours.log_scales, atol=1e-5)
    assert degrees(ours.quats, np.asarray(theirs.quats)).max() < 0.01
    np.testing.assert_allclose(theirs.sh0, ours.sh0, atol=1e-5)
    opacities = 1.0 / (1.0 + np.exp(-np.asarray(theirs.opacities, np.float64)))
    np.testing.assert_allclose(opacities, ours.opacities, atol=0.0011)
    if bands:
        np.testing.assert_allclose(np.asarray(theirs.shN).reshape(ours.rest.shape), ours.rest, atol=1e-5)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_we_read_the_spz_that_gsply_writes(version: int, bands: int, tmp_path: Path) -> None:
    module = reader("gsply.spz")
    _, now, data = decoded("spz", many(300, bands))
    (tmp_path / "ours.spz").write_bytes(data)
    theirs = module.read_spz(tmp_path / "ours.spz")
    module.write_spz(tmp_path / "theirs.spz", theirs, version=version, fractional_bits=16)
    again = load_splat_file(tmp_path / "theirs.spz").params
    ours = now.params()
    torch.testing.assert_close(again["means"], ours["means"], atol=2.0**-17, rtol=0.0)
    torch.testing.assert_close(again["scales"], ours["scales"], atol=1e-5, rtol=0.0)
    assert degrees(ours["quats"].numpy(), again["quats"].numpy()).max() < 0.3
    torch.testing.assert_close(again["opacities"].sigmoid(), ours["opacities"].sigmoid(), atol=0.004, rtol=0.0)
    torch.testing.assert_close(again["sh0"], ours["sh0"], atol=0.03, rtol=0.0)
    torch.testing.assert_close(again["shN"], ours["shN"], atol=0.07, rtol=0.0)


@pytest.mark.parametrize("bands", [0, 15])
def test_pygltflib_reads_our_attributes(bands: int, tmp_path: Path) -> None:
    pygltflib = reader("pygltflib")
    was, _, data = decoded("gltf", many(20, bands))
    (tmp_path / "x.glb").write_bytes(data)
    gltf = pygltflib.GLTF2().load(str(tmp_path / "x.glb"))
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == pygltflib.POINTS
    body = gltf.binary_blob()
    attributes = {key: value for key, value in vars(primitive.attributes).items() if value is not None}
    assert len(attributes) == 6 + bands
    turned = was.turned("z")

    def values(name: str) -> np.ndarray:
        accessor = gltf.accessors[attributes[name]]
        view = gltf.bufferViews[accessor.bufferView]
        part = body[view.byteOffset : view.byteOffset + view.byteLength]
        return np.frombuffer(part, "<f4").reshape(accessor.count, -1)

    np.testing.assert_array_equal(values("POSITION"), turned.means)
    np.testing.assert_allclose(values("KHR_gaussian_splatting:SCALE"), np.exp(turned.log_scales), rtol=1e-6)
    np.testing.assert_allclose(values("KHR_gaussian_splatting:OPACITY")[:, 0], was.opacities, atol=1e-7)
    np.testing.assert_array_equal(values("KHR_gaussian_splatting:ROTATION"), turned.quats[:, [1, 2, 3, 0]])
    if bands:
        np.testing.assert_array_equal(values("KHR_gaussian_splatting:SH_DEGREE_3_COEF_6"), turned.rest[:, 14])


def test_the_bytes_of_an_spz_file_are_those_of_its_description() -> None:
    """One Gaussian, computed by hand from the description."""
    params = {
        "means": torch.tensor([[1.0, -2.0, 0.5]]),
        "scales": torch.tensor([[-10.0, -2.0, 0.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "opacities": torch.tensor([0.0]),
        "sh0": torch.tensor([[[0.0, 1.0, -1.0]]]),
        "shN": torch.zeros(1, 0, 3),
    }
    raw, later = gzip.decompress(encoded("spz", params)), encoded("spz-4", params)
    bits = 20  # of the fraction: 2^20 times 2 fits into 23 bits
    centre = b"".join(struct.pack("<i", round(value * 2**bits))[:3] for value in (1.0, 2.0, -0.5))
    # y and z change their sign; 127.5 is rounded to the even 128; 38.25 a unit of colour; the largest component is w
    rest = bytes([128]) + bytes([128, 166, 89]) + bytes([0, 128, 160]) + struct.pack("<I", 3 << 30)
    assert raw == struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, bits, 0, 0) + centre + rest
    # version 4: five streams, as there are no coefficients; the table follows the header of 32 bytes
    assert later[:32] == struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 1, 0, bits, 0, 5, 32)
    sizes = struct.unpack("<10Q", later[32:112])
    assert sizes[1::2] == (9, 1, 3, 3, 4)
    ends = np.cumsum([112, *sizes[0::2]])
    streams = [later[a:b] for a, b in itertools.pairwise(ends.tolist())]
    assert b"".join(zstandard.decompress(stream) for stream in streams) == centre + rest
    assert ends[-1] == len(later)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(("number", "axis"), [(1, "y"), (4, "x"), (6, ""), (7, "z")])
def test_an_spz_file_that_says_its_coordinates_is_turned_from_there(version: int, number: int, axis: str) -> None:
    """Adobe's extension 0xADBE0003, and one of somebody else before it, which is skipped."""
    _, now, data = decoded("spz" if version == 3 else "spz-4", many(20))
    extensions = struct.pack("<II3s", 0x12340001, 3, b"abc") + struct.pack("<III", 0xADBE0003, 4, number)
    if version == 3:
        raw = bytearray(gzip.decompress(data))
        raw[14] |= 2
        changed = gzip.compress(bytes(raw) + extensions)
    else:
        head = bytearray(data[:32])
        head[14] |= 2
        head[16:20] = struct.pack("<I", 32 + len(extensions))
        changed = bytes(head) + extensions + data[32:]
    found = FORMATS["spz"].decode(changed, Path("x.spz"))
    # what is stored is what the default frame, half a turn about x away, makes of it
    stored = now.turned("x")
    np.testing.assert_array_equal(found.means, (stored.turned(axis) if axis else stored).means)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("full", [0, 1, 2])
def test_ksplat_is_read_as_its_description_says(level: int, degree: int, full: int, tmp_path: Path) -> None:
    params = many(40, 8)
    params["means"] = params["means"].clamp(-1.0, 1.0)
    (tmp_path / "x.ksplat").write_bytes(ksplat_of(params, level, degree, full))
    stored = load_splat_file(tmp_path / "x.ksplat")
    assert stored.frame is None
    found, was = stored.params, params
    exact = level == 0
    torch.testing.assert_close(found["means"], was["means"], atol=0.0 if exact else 4e-5, rtol=0.0)
    torch.testing.assert_close(found["scales"], was["scales"], atol=1e-6 if exact else 1e-3, rtol=0.0)
    assert degrees(torch.nn.functional.normalize(was["quats"], dim=1).numpy(), found["quats"].numpy()).max() < 0.1
    torch.testing.assert_close(found["opacities"].sigmoid(), was["opacities"].sigmoid(), atol=0.0021, rtol=0.0)
    torch.testing.assert_close(found["sh0"], was["sh0"], atol=0.008, rtol=0.0)
    bands = (0, 3, 8)[degree]
    atol = (0.0, 1e-3, 0.008)[level]
    torch.testing.assert_close(found["shN"][:, :bands], was["shN"][:, :bands], atol=atol, rtol=0.0)
    assert not found["shN"][:, bands:].any()


@pytest.mark.parametrize("bands", [0, 15])
def test_sog_in_a_folder_is_what_it_is_in_one_file(bands: int, tmp_path: Path) -> None:
    frame = Frame("training", tuple(map(tuple, (2.0 * np.eye(4)).tolist())))
    (tmp_path / "x.sog").write_bytes(encoded("sog", many(30, bands), True, frame))
    with zipfile.ZipFile(tmp_path / "x.sog") as archive:
        archive.extractall(tmp_path / "x")
    bundled, found = (load_splat_file(tmp_path / name) for name in ("x.sog", "x/meta.json"))
    assert (found.antialiased, found.frame) == (True, frame)
    for name, value in bundled.params.items():
        assert torch.equal(value, found.params[name])
    # the folder itself is a splat too
    assert torch.equal(load_splat(tmp_path / "x").params["means"], found.params["means"])
