"""Other programs' readers, and a description worked out by hand, on what we write."""

from __future__ import annotations

import gzip
import importlib
import struct
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from pop_fast.io.formats import FORMATS, encoded
from tests.app.clouds import decoded, degrees, many


def reader(name: str) -> ModuleType:
    """Import another program's reader, or skip with the reason."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed ({error}); pip install 'pop-splatting[formats-test]'")


@pytest.mark.parametrize("name", ["compressed-ply", "spz", "sog"])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_gsply_reads_what_we_write(name: str, bands: int, tmp_path: Path) -> None:
    module = reader({"compressed-ply": "gsply", "spz": "gsply.spz", "sog": "gsply.sog_reader"}[name])
    if name == "sog":
        reader("imagecodecs")
    _, now, data = decoded(name, many(300, bands))
    path = tmp_path / f"x{FORMATS[name].suffix}"
    path.write_bytes(data)
    found = {"compressed-ply": "plyread", "spz": "read_spz", "sog": "sogread"}[name]
    theirs = getattr(module, found)(path)
    # it leaves SPZ in the frame of the file
    ours = now.turned("x") if name == "spz" else now
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-5)
    np.testing.assert_allclose(theirs.scales, ours.log_scales, atol=1e-5)
    assert degrees(ours.quats, np.asarray(theirs.quats)).max() < 0.01
    np.testing.assert_allclose(theirs.sh0, ours.sh0, atol=1e-5)
    opacities = 1.0 / (1.0 + np.exp(-np.asarray(theirs.opacities, np.float64)))
    np.testing.assert_allclose(opacities, ours.opacities, atol=0.0011)
    if bands:
        np.testing.assert_allclose(np.asarray(theirs.shN).reshape(ours.rest.shape), ours.rest, atol=1e-5)


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
    raw = gzip.decompress(encoded("spz", params))
    bits = 20  # of the fraction: 2^20 times 2 fits into 23 bits
    centre = b"".join(struct.pack("<i", round(value * 2**bits))[:3] for value in (1.0, 2.0, -0.5))
    # y and z change their sign; 127.5 is rounded to the even 128; 38.25 a unit of colour; the largest component is w
    rest = bytes([128]) + bytes([128, 166, 89]) + bytes([0, 128, 160]) + struct.pack("<I", 3 << 30)
    assert raw == struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, bits, 0, 0) + centre + rest
