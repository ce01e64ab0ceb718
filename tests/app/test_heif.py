"""HEIC photographs are read where pillow-heif is installed, and a clear line says so where it is not."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.data import load_capture, sfm
from pop_fast.errors import CaptureError
from pop_fast.io import images
from pop_fast.io.image_header import can_read_heif, read_exif
from pop_fast.io.images import list_images, read_image
from tests.app.captures import photograph
from tests.app.conftest import Pop

needs_heif = pytest.mark.skipif(not can_read_heif(), reason="pillow-heif is not installed (extra heif)")
# what a HEIC file begins with
HEAD = b"\x00\x00\x00\x1cftypheic" + bytes(24)


def write_heic(path: Path, image: np.ndarray, exif: bytes | None = None) -> None:
    import pillow_heif

    height, width, channels = image.shape
    file = pillow_heif.from_bytes(mode="RGBA"[:channels], size=(width, height), data=image.tobytes())
    file.save(path, quality=95, **({} if exif is None else {"exif": exif}))


def test_without_pillow_heif_a_heic_photograph_is_one_line_that_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "can_read_heif", lambda: False)
    (tmp_path / "a.heic").write_bytes(HEAD)
    with pytest.raises(CaptureError, match=r"a\.heic: is HEIC, which needs pillow-heif: pip install pillow-heif"):
        read_image(tmp_path / "a.heic")
    assert list_images(tmp_path) == []
    with pytest.raises(CaptureError, match="1 file is HEIC or the like, which is not read: pip install pillow-heif"):
        load_capture(tmp_path)


@needs_heif
@pytest.mark.parametrize("channels", [3, 4])
def test_a_heic_photograph_is_read_as_others_are(tmp_path: Path, channels: int) -> None:
    image = photograph(3, 128, 96, channels)
    write_heic(tmp_path / "a.HEIC", image)
    found = read_image(tmp_path / "a.HEIC")
    assert found.shape == image.shape
    assert np.abs(found.astype(int) - image).mean() < 3.0
    assert [path.name for path in list_images(tmp_path)] == ["a.HEIC"]


@needs_heif
def test_a_damaged_heic_photograph_is_one_line(tmp_path: Path) -> None:
    write_heic(tmp_path / "a.heic", photograph(3, 128, 96))
    data = (tmp_path / "a.heic").read_bytes()
    for cut in (40, len(data) // 2):
        (tmp_path / "a.heic").write_bytes(data[:cut])
        with pytest.raises(CaptureError, match=r"a\.heic: the HEIC file is truncated or corrupt"):
            read_image(tmp_path / "a.heic")


@needs_heif
def test_the_tags_of_a_heic_are_read_and_its_orientation_is_not_obeyed_twice(tmp_path: Path) -> None:
    # a TIFF block of three tags: maker, model, orientation 6
    entries = [(0x10F, 2, 4, b"Abc\0"), (0x110, 2, 4, b"Xyz\0"), (0x112, 3, 1, b"\x06\0\0\0")]
    body = b"".join(
        tag.to_bytes(2, "little") + kind.to_bytes(2, "little") + count.to_bytes(4, "little") + value
        for tag, kind, count, value in entries
    )
    tiff = b"II*\0\x08\0\0\0" + len(entries).to_bytes(2, "little") + body + bytes(4)
    write_heic(tmp_path / "a.heic", photograph(3, 128, 96), b"Exif\0\0" + tiff)
    found = read_exif(tmp_path / "a.heic")
    assert (found.camera, found.orientation) == ("Abc Xyz", 1)


@needs_heif
def test_a_capture_whose_photographs_were_heic_loads_and_is_checked(
    shared_capture: Path, tmp_path: Path, pop: Pop
) -> None:
    folder = Path(shutil.copytree(shared_capture, tmp_path / "toy"))
    for path in sorted((folder / "images").glob("*.png")):
        write_heic(path.with_suffix(".heic"), read_image(path))
        path.unlink()
    views = load_capture(folder, normalize=False).views
    originals = load_capture(shared_capture, normalize=False).views
    for ours, theirs in zip(views, originals, strict=True):
        np.testing.assert_array_equal(ours.viewmat, theirs.viewmat)
        assert np.abs(ours.image.astype(int) - theirs.image).mean() < 8.0
    assert pop("data", "check", folder).status == 0


@needs_heif
def test_structure_from_motion_is_given_what_colmap_can_read(tmp_path: Path) -> None:
    image = photograph(3, 128, 96)
    (tmp_path / "photos").mkdir()
    (tmp_path / "work").mkdir()
    write_heic(tmp_path / "photos" / "a.heic", image)
    cv2.imwrite(str(tmp_path / "photos" / "b.png"), image)
    staged = sfm._stage(tmp_path / "photos", [Path("a.heic"), Path("b.png")], tmp_path / "work")
    assert staged == ["000000.png", "000001.png"]
    found = cv2.imread(str(tmp_path / "work" / "images" / staged[0]))
    np.testing.assert_array_equal(found[..., ::-1], read_image(tmp_path / "photos" / "a.heic"))
