"""What a file's header says, held against what another library writes; and headers that promise too much."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from pop_fast.data import load_capture
from pop_fast.io.image_header import Exif, read_exif, read_size, size_of
from pop_fast.io.images import read_image
from tests.app.captures import assert_one_line, colmap_capture, photograph

FORMATS = ("a.jpg", "a.png", "a.webp", "lossless.webp", "a.bmp", "a.tif")


def save(path: Path, orientation: int | None = None) -> Path:
    exif = Image.Exif()
    if orientation is not None:
        exif[0x10F], exif[0x110], exif[0x112] = "Maker", "Maker X", orientation
        if path.suffix != ".tif":  # Pillow copies the directory of the exposure into no TIFF
            exif[0x8769] = {0x829A: IFDRational(1, 125), 0x8827: 400, 0x920A: IFDRational(17, 4), 0xA405: 26}
    picture = Image.fromarray(photograph(0, 61, 37))
    picture.save(path, exif=exif, lossless=True) if "lossless" in path.name else picture.save(path, exif=exif)
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_the_size_is_read_of_every_format(tmp_path: Path, name: str) -> None:
    assert read_size(save(tmp_path / name)) == (61, 37)


@pytest.mark.parametrize("name", [name for name in FORMATS if not name.endswith("bmp")])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_is_read_of_every_format_that_has_it(tmp_path: Path, name: str, orientation: int) -> None:
    found = read_exif(save(tmp_path / name, orientation))
    exposure = () if name.endswith("tif") else (0.008, 400.0, 4.25, 26.0)
    assert found == Exif(orientation, "Maker X", *exposure)
    assert read_exif(save(tmp_path / name)) == Exif()


@pytest.mark.parametrize("name", FORMATS)
def test_any_damage_is_no_error_and_no_absurd_answer(tmp_path: Path, name: str) -> None:
    whole = save(tmp_path / name, 6).read_bytes()
    random = np.random.default_rng(5)
    for _ in range(300):
        data = bytearray(whole[: int(random.integers(0, len(whole)))])
        for at in random.integers(0, max(len(data), 1), 3 if data else 0):
            data[at] = random.integers(256)
        (tmp_path / "damaged").write_bytes(data)
        size = size_of(bytes(data))
        assert size is None or all(isinstance(side, int) for side in size)
        assert read_exif(tmp_path / "damaged").orientation in range(1, 9)


def bomb(path: Path, side: int) -> Path:
    """A PNG of a few kilobytes that decodes to side x side pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(1 + side // 8)
    pixels = b"".join([*(packer.compress(row) for _ in range(side)), packer.flush()])
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", pixels) + chunk(b"IEND", b""))
    return path


def test_a_photograph_of_another_shape_is_refused_before_it_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = colmap_capture(tmp_path)
    bomb(root / "images" / "02.png", 8_000)
    decoded: list[Path] = []

    def reading(path: Path) -> np.ndarray:
        decoded.append(path)
        return read_image(path)

    monkeypatch.setattr("pop_fast.data.read_images.read_image", reading)
    assert_one_line(lambda: load_capture(root), "02.png", "8000x8000 px", "another shape")
    assert root / "images" / "02.png" not in decoded


def test_more_pixels_than_any_camera_has_are_refused(tmp_path: Path) -> None:
    path = bomb(tmp_path / "a.png", 16_400)
    tracemalloc.start()
    assert_one_line(lambda: read_image(path), "a.png", "16400x16400", "million pixels")
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()
