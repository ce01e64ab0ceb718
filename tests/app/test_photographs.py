"""Photographs as they come: files of every kind, damaged, turned and transparent, bare folders of them, and videos."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import struct
import tracemalloc
import unicodedata
import zipfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from pop_fast.cli import main
from pop_fast.cli.data_check import look_over
from pop_fast.data import load_capture, run_sfm, sfm
from pop_fast.data.photo_quality import sharpness
from pop_fast.data.read_images import _upright, shrink_bicubic
from pop_fast.data.unpack import take_frames, unpack
from pop_fast.errors import CaptureError, PopError
from pop_fast.io import images, read_back
from pop_fast.io.image_header import Exif, can_read_heif, read_exif, read_size, size_of
from pop_fast.io.images import list_images, read_image, sound_jpegs
from pop_fast.view.paths import VideoFile
from tests.app.captures import (
    HEIGHT,
    WIDTH,
    assert_one_line,
    camera,
    colmap_capture,
    photograph,
    png_of_zeros,
    raw,
    transforms_capture,
    write_photograph,
)
from tests.app.conftest import Pop
from tests.app.damage import says


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return colmap_capture(tmp_path / "scene")


@pytest.mark.parametrize("name", ["01.png", "01.PNG.png", "01.jpg"])
def test_masks_are_found_under_all_usual_names_and_white_means_keep(tmp_path: Path, name: str) -> None:
    root = colmap_capture(tmp_path, names=["00.PNG", "01.PNG"])
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :10] = 255
    write_photograph(root / "masks" / name, mask)
    first, second = raw(root).views
    assert first.mask is None
    assert second.mask.dtype == bool
    assert np.array_equal(second.mask, mask > 0)
    assert raw(root, masks=False).views[1].mask is None
    small = raw(root, factor=2).views[1].mask
    assert np.array_equal(small, mask[::2, ::2] > 0)


def test_names_with_umlauts_are_found_whether_a_mac_wrote_the_files_or_their_list(tmp_path: Path) -> None:
    listed, stored = ([unicodedata.normalize(form, f"Tür {i}.png") for i in range(3)] for form in ("NFC", "NFD"))
    assert listed != stored
    for one, other in ((listed, stored), (stored, listed)):
        root = colmap_capture(tmp_path / one[0], names=one)
        for old, new in zip(one, other, strict=True):
            (root / "images" / old).rename(root / "images" / new)
        capture = raw(root)
        assert [view.name for view in capture.views] == one
        assert capture.unplaced == 0


def test_renders_of_a_result_among_the_photographs_are_none_of_them(tmp_path: Path) -> None:
    for name in ("1.png", "out/run/renders/1.png", "more/1.png"):
        write_photograph(tmp_path / name, photograph(1))
    for name in ("out/run/cfg.json", "out/run/capture.json", "more/capture.json"):
        (tmp_path / name).write_text("{}")
    assert [path.relative_to(tmp_path).as_posix() for path in list_images(tmp_path)] == ["1.png", "more/1.png"]
    # given itself, it is a folder as any other
    assert len(list_images(tmp_path / "out" / "run")) == 1


def test_folders_that_are_links_are_listed_once(tmp_path: Path) -> None:
    photos, disk = tmp_path / "photos", tmp_path / "disk"
    for path in (photos / "cam0" / "1.png", disk / "cam1" / "1.png", disk / ".hidden" / "1.png"):
        write_photograph(path, photograph(1))
    for name, target in {"cam1": disk / "cam1", "cam2": disk / "cam1", "own": photos / "cam0", "up": tmp_path}.items():
        (photos / name).symlink_to(target)
    (photos / "broken.png").symlink_to(tmp_path / "nothing.png")
    found = [path.relative_to(photos).as_posix() for path in list_images(photos)]
    assert found == ["cam0/1.png", "cam1/1.png"]


def test_masks_that_fit_no_photograph_or_hide_all_of_it_are_refused(root: Path) -> None:
    write_photograph(root / "masks" / "elsewhere.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert_one_line(lambda: raw(root), "masks", "no mask named like a photograph")
    write_photograph(root / "masks" / "02.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    assert_one_line(lambda: raw(root), "02.png", "hides the whole photograph", "white means keep")
    write_photograph(root / "masks" / "02.png", np.full((WIDTH, HEIGHT), 255, np.uint8))
    assert_one_line(lambda: raw(root), "02.png", "the mask is 30x40", "40x30")


def test_transparency_is_composited_over_the_background_and_is_no_mask(root: Path) -> None:
    rgba = photograph(5, channels=4)
    write_photograph(root / "images" / "00.png", rgba)
    alpha = rgba[:, :, 3:] / 255.0
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.5, 0.9)):
        view = raw(root, background=background).views[0]
        want = alpha * rgba[:, :, :3] + (1.0 - alpha) * 255.0 * np.array(background)
        assert view.mask is None
        assert np.abs(view.image - want).max() <= 0.5 + 1e-3
        np.testing.assert_array_equal(view.alpha, rgba[:, :, 3])
    assert raw(root).views[1].alpha is None


def test_transparency_is_undistorted_shrunk_and_turned_with_its_photograph(tmp_path: Path) -> None:
    """A photograph that is as bright as it is opaque, over black, is its own opacity."""
    root = colmap_capture(tmp_path, cameras=[camera("SIMPLE_RADIAL", (40.0, 20.0, 15.0, 0.1))])
    opaque = photograph(5)[:, :, :1]
    write_photograph(root / "images" / "00.png", np.concatenate([np.full_like(opaque, 255)] * 3 + [opaque], axis=2))
    for factor in (1, 2):
        view = raw(root, factor=factor).views[0]
        assert view.alpha.shape == view.image.shape[:2]
        np.testing.assert_array_equal(view.image[:, :, 0], view.alpha)
    turned = _upright(view, 1)
    np.testing.assert_array_equal(turned.image[:, :, 0], turned.alpha)


def test_gray_and_sixteen_bit_photographs_become_eight_bit_rgb(root: Path) -> None:
    gray = photograph(5)[:, :, 0]
    write_photograph(root / "images" / "00.png", gray)
    write_photograph(root / "images" / "01.png", gray.astype(np.uint16) * 257)
    for view in raw(root).views[:2]:
        assert np.array_equal(view.image, np.repeat(gray[:, :, None], 3, axis=2))


def encoded(extension: str, *options: int) -> bytes:
    return cv2.imencode(extension, photograph(3, 64, 48), options)[1].tobytes()


WHOLE = {name: encoded(f".{name}") for name in ("png", "jpg", "webp", "bmp", "tiff")}
WHOLE["progressive.jpg"] = encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)


@pytest.mark.parametrize("name", WHOLE)
@given(cut=st.floats(0.0, 1.0, exclude_max=True))
def test_a_photograph_cut_anywhere_is_named(name: str, cut: float, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("cut") / name
    path.write_bytes(WHOLE[name][: int(cut * len(WHOLE[name]))])
    assert_one_line(lambda: read_image(path), str(path))


@given(at=st.integers(8, len(WHOLE["png"]) - 1), flip=st.integers(1, 255))
def test_a_png_with_any_byte_changed_is_named(at: int, flip: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    data = bytearray(WHOLE["png"])
    data[at] ^= flip
    path = tmp_path_factory.mktemp("flip") / "x.png"
    path.write_bytes(data)
    assert_one_line(lambda: read_image(path), str(path), "PNG")


def test_reading_whole_and_bad_photographs_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, data in WHOLE.items():
        path = tmp_path / name
        path.write_bytes(data)
        plain = read_image(path)
        assert plain.shape == (48, 64, 3)
        if name.endswith("jpg"):
            # what cameras append to a JPEG does no harm
            path.write_bytes(data + bytes(100) + WHOLE["jpg"])
            assert np.array_equal(read_image(path), plain)
        path.write_bytes(data[: len(data) // 2])
        assert_one_line(lambda path=path: read_image(path))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "empty"),
        (b"no picture at all", "is not a PNG, JPEG"),
        (b"P5 2 2 255\n" + bytes(4), "is not a PNG, JPEG, WebP, TIFF, BMP or HEIC image"),
        (b"\xff\xd8\xff", "truncated"),
    ],
)
def test_what_is_no_photograph_is_named_by_the_capture_too(root: Path, content: bytes, word: str) -> None:
    (root / "images" / "02.png").write_bytes(content)
    message = assert_one_line(lambda: load_capture(root), str(root / "images" / "02.png"), word, "copy it again")
    assert ("convert it" in message) == (word[:3] == "is ")


# What a file's header says, held against what another library writes; and headers that promise too much.

FORMATS = ("a.jpg", "a.png", "a.webp", "lossless.webp", "a.bmp", "a.tif")


def save(path: Path, orientation: int | None = None) -> Path:
    exif = Image.Exif()
    if orientation is not None:
        exif[0x10F], exif[0x110], exif[0x112] = "Maker", "Maker X", orientation
        if path.suffix != ".tif":  # Pillow copies the directory of the exposure into no TIFF
            exif[0x8769] = {0x829A: IFDRational(1, 125), 0x8827: 400, 0x920A: IFDRational(17, 4), 0xA405: 26}
    lossless = {"lossless": True} if "lossless" in path.name else {}
    Image.fromarray(photograph(0, 61, 37)).save(path, exif=exif, **lossless)
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_size_and_exif_are_read_of_every_format_no_orientation_is_obeyed_and_damage_is_no_error(
    tmp_path: Path, name: str
) -> None:
    plain = save(tmp_path / name)
    assert read_size(plain) == (61, 37)
    assert read_exif(plain) == Exif()
    stored = read_image(plain)
    exposure = () if name.endswith("tif") else (0.008, 400.0, 4.25, 26.0)
    for orientation in range(1, 9):
        found = read_exif(save(tmp_path / name, orientation))
        assert found == Exif(orientation, "Maker X", *exposure) or name.endswith("bmp")
        assert np.array_equal(read_image(tmp_path / name), stored)
    whole, random = save(tmp_path / name, 6).read_bytes(), np.random.default_rng(5)
    for _ in range(300):
        data = bytearray(whole[: int(random.integers(0, len(whole)))])
        for at in random.integers(0, max(len(data), 1), 3 if data else 0):
            data[at] = random.integers(256)
        (tmp_path / "damaged").write_bytes(data)
        size = size_of(bytes(data))
        assert size is None or all(isinstance(side, int) for side in size)
        assert read_exif(tmp_path / "damaged").orientation in range(1, 9)


def test_another_shape_is_refused_before_it_is_decoded(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    png_of_zeros(root / "images" / "02.png", 8_000)
    decoded: list[Path] = []

    def reading(path: Path) -> np.ndarray:
        decoded.append(path)
        return read_image(path)

    monkeypatch.setattr("pop_fast.data.read_images.read_image", reading)
    assert_one_line(lambda: load_capture(root), "02.png", "8000x8000 px", "another shape")
    assert root / "images" / "02.png" not in decoded


def test_more_pixels_than_any_camera_has_are_refused(tmp_path: Path) -> None:
    path = png_of_zeros(tmp_path / "a.png", 16_400)
    tracemalloc.start()
    assert_one_line(lambda: read_image(path), "a.png", "16400x16400", "million pixels")
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


# HEIC photographs are read where pillow-heif is installed, and a clear line says so where it is not.

needs_heif = pytest.mark.skipif(not can_read_heif(), reason="pillow-heif is not installed (extra heif)")
# what a HEIC file begins with
HEAD = b"\x00\x00\x00\x1cftypheic" + bytes(24)


def write_heic(path: Path, image: np.ndarray, exif: bytes | None = None) -> None:
    import pillow_heif

    height, width, channels = image.shape
    file = pillow_heif.from_bytes(mode="RGBA"[:channels], size=(width, height), data=image.tobytes())
    file.save(path, quality=95, **({} if exif is None else {"exif": exif}))


def test_what_is_not_read_is_named_with_the_way_to_convert_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "can_read_heif", lambda: False)
    (tmp_path / "a.HEIC").write_bytes(HEAD)
    one = "a.HEIC: is HEIC, which needs pillow-heif: pip install pillow-heif"
    assert_one_line(lambda: read_image(tmp_path / "a.HEIC"), one)
    assert list_images(tmp_path) == []
    one = "1 file is HEIC or the like, which is not read: pip install pillow-heif"
    assert_one_line(lambda: load_capture(tmp_path), one)
    for name in ("b.HEIC", "c.dng"):
        (tmp_path / name).write_bytes(b"no JPEG")
    words = ("3 files are HEIC", "pip install pillow-heif, or convert them to JPEG", "mogrify -format jpg *.HEIC")
    assert_one_line(lambda: load_capture(tmp_path, sfm=True), "has no photographs", *words)
    assert_one_line(lambda: run_sfm(tmp_path), "has 0 photographs;", *words)
    # what browsers save, and what is an image all the same
    for kind in ("jfif", "gif"):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / f"a.{kind}").write_bytes(b"")
        one = f"1 file is {kind.upper()} or the like, which is not read: convert them to JPEG"
        assert_one_line(lambda kind=kind: load_capture(tmp_path / kind), one)


def test_links_to_photographs_that_are_gone_are_named(tmp_path: Path) -> None:
    for i in range(2):
        (tmp_path / f"{i}.jpg").symlink_to(tmp_path / "unplugged" / f"{i}.jpg")
    link, where = tmp_path / "0.jpg", tmp_path / "unplugged" / "0.jpg"
    assert_one_line(
        lambda: load_capture(tmp_path), f"2 files are links to nothing ({link} -> {where}): make what they lead"
    )
    for i in range(2, 4):
        write_photograph(tmp_path / f"{i}.png", photograph(i))
    assert "2 files are links to nothing" in " ".join(finding.text for finding in look_over(tmp_path))


def test_a_subfolder_that_cannot_be_looked_into_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photograph(tmp_path / "locked" / "a.png", photograph(1))
    scandir, stat, locked = os.scandir, os.stat, tmp_path / "locked"

    def guarded(path: Any, ask: Any = scandir, **how: Any) -> Any:
        if locked in (Path(path), Path(path).parent) and (ask is scandir or Path(path) != locked):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return ask(path, **how)

    monkeypatch.setattr(os, "scandir", guarded)
    monkeypatch.setattr(os, "stat", partial(guarded, ask=stat))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != locked)
    assert list_images(tmp_path) == []
    assert_one_line(lambda: load_capture(tmp_path), "1 folder is left out", f"({locked}: Permission denied)")
    write_photograph(tmp_path / "b.png", photograph(1))
    assert_one_line(lambda: load_capture(tmp_path), "has 1 photographs but no cameras")


@needs_heif
@pytest.mark.parametrize("channels", [3, 4])
def test_a_heic_photograph_is_read_as_others_are_and_a_damaged_one_named(tmp_path: Path, channels: int) -> None:
    image, path = photograph(3, 128, 96, channels), tmp_path / "a.HEIC"
    write_heic(path, image)
    found = read_image(path)
    assert found.shape == image.shape
    assert np.abs(found.astype(int) - image).mean() < 3.0
    assert list_images(tmp_path) == [path]
    data = path.read_bytes()
    for cut in (40, len(data) // 2):
        path.write_bytes(data[:cut])
        assert_one_line(lambda: read_image(path), "a.HEIC: the HEIC file is truncated or corrupt")


@needs_heif
def test_the_tags_of_a_heic_are_read_and_its_orientation_is_not_obeyed_twice(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x10F], exif[0x110], exif[0x112] = "Abc", "Xyz", 6
    write_heic(tmp_path / "a.heic", photograph(3, 128, 96), exif.tobytes())
    found = read_exif(tmp_path / "a.heic")
    assert (found.camera, found.orientation) == ("Abc Xyz", 1)
    # by the size, which is that of the upright picture, a run chooses how small photographs are to be
    height, width = read_image(tmp_path / "a.heic").shape[:2]
    assert read_size(tmp_path / "a.heic") == (width, height)
    (tmp_path / "a.heic").write_bytes((tmp_path / "a.heic").read_bytes()[:60])
    assert read_size(tmp_path / "a.heic") is None


@needs_heif
def test_a_capture_of_heic_photographs_loads(shared_capture: Path, capture: Path, pop: Pop) -> None:
    for path in sorted((capture / "images").glob("*.png")):
        write_heic(path.with_suffix(".heic"), read_image(path))
        path.unlink()
    for ours, theirs in zip(raw(capture).views, raw(shared_capture).views, strict=True):
        np.testing.assert_array_equal(ours.viewmat, theirs.viewmat)
        assert np.abs(ours.image.astype(int) - theirs.image).mean() < 8.0
    assert pop("data", "check", capture).status == 0


def staged_for_colmap(photos: Path, work: Path) -> list[str]:
    """Give photographs to COLMAP, and return the names that they have there."""
    work.mkdir()
    names = [path.relative_to(photos) for path in list_images(photos)]
    staged = sfm._stage(photos, names, work)
    for plain, name in zip(staged, names, strict=True):
        found = pycolmap.Bitmap.read(work / "images" / plain, True)
        assert found is not None, name
        np.testing.assert_array_equal(found.to_array(), read_image(photos / name)[..., :3])
    return staged


def test_structure_from_motion_is_given_what_colmap_can_read(tmp_path: Path) -> None:
    for name in ("a.webp", "b.png", "c.bmp", "d.tif", "e.jpg"):
        write_photograph(tmp_path / "photos" / name, photograph(3, 128, 96, 4 if name == "a.webp" else 3))
    (tmp_path / "photos" / "b.png").rename(tmp_path / "photos" / "b.jpg")
    staged = staged_for_colmap(tmp_path / "photos", tmp_path / "work")
    assert staged == ["000000.png", "000001.jpg", "000002.bmp", "000003.tif", "000004.jpg"]


@needs_heif
def test_structure_from_motion_is_given_heic_as_png_whatever_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    write_heic(tmp_path / "photos" / "a.heic", photograph(3, 128, 96))
    shutil.copy(tmp_path / "photos" / "a.heic", tmp_path / "photos" / "b.jpg")
    assert staged_for_colmap(tmp_path / "photos", tmp_path / "work") == ["000000.png", "000001.png"]


# JPEG files with damaged coded pixels, which OpenCV decodes without an error.


def jpeg(seed: int = 0, progressive: bool = False, zeroed: float | None = None) -> bytes:
    """A JPEG file, of which 400 bytes from a share of its length on may be zeros."""
    noise = np.random.default_rng(seed).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    data = cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 1.0), options)[1].tobytes()
    at = len(data) if zeroed is None else int(zeroed * len(data))
    return data[:at] + bytes(len(data[at : at + 400])) + data[at + 400 :]


def check_jpegs(*files: Path) -> None:
    with sound_jpegs(files):
        pass


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_zeros_in_the_middle_are_named_with_the_file(tmp_path: Path, share: float, progressive: bool) -> None:
    files = [tmp_path / f"{i} ü.JPG" for i in range(20)]
    for i, file in enumerate(files):
        file.write_bytes(jpeg(i, progressive, share if i in (13, 17) else None))
    read_image(files[13])  # OpenCV itself finds nothing
    assert_one_line(lambda: check_jpegs(*files), str(files[13]), "JPEG file is corrupt", "copy it again")


def test_a_jpeg_overwritten_in_the_middle_is_named_and_padding_and_other_formats_do_no_harm(tmp_path: Path) -> None:
    data = bytearray(WHOLE["jpg"])
    scan = data.index(b"\xff\xda") + 20
    data[scan : scan + 40] = b"\xff\x42" * 20
    (tmp_path / "x.jpg").write_bytes(data)
    assert_one_line(lambda: read_image(tmp_path / "x.jpg"), "x.jpg", "unexpected marker")
    (tmp_path / "a.jpg").write_bytes(jpeg()[:-2] + bytes(8) + jpeg()[-2:])
    write_photograph(tmp_path / "b.png", photograph(0))
    (tmp_path / "c.jpg").write_bytes(b"no picture")
    check_jpegs(*(tmp_path / name for name in ("a.jpg", "b.png", "c.jpg", "absent.jpg")))
    # an error of the block comes first
    (tmp_path / "a.jpg").write_bytes(jpeg(zeroed=0.5))
    with pytest.raises(KeyError), sound_jpegs([tmp_path / "a.jpg"]):
        raise KeyError


def test_such_captures_are_refused_and_looked_over(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    root = colmap_capture(tmp_path / "scene", names=["0.jpg", "1.jpeg", "2.png"])
    assert load_capture(root).notes == ()
    assert capfd.readouterr().err == ""
    first, second = root / "images" / "0.jpg", root / "images" / "1.jpeg"
    second.write_bytes(jpeg(zeroed=0.5))
    assert_one_line(lambda: load_capture(root), str(second), "corrupt", "copy it again")
    assert_one_line(lambda: run_sfm(root / "images", tmp_path / "out"), str(second), "corrupt")
    assert not (tmp_path / "out").exists()
    first.write_bytes(jpeg(zeroed=0.5))
    assert main(["data", "check", str(root)]) == 1
    out = capfd.readouterr().out
    assert all(f"{path.name}: the JPEG file is corrupt" in out for path in (first, second))


# Photographs shrunk as Pillow shrinks them, to the bit.

# of what a NumPy implementation of Pillow's filter made of the same pictures
DIGESTS = {
    (619, 411, 310, 206): "5cc1f4545686a444",
    (619, 411, 155, 103): "2107877b85251428",
    (619, 411, 77, 51): "a9cd436b0e0c5787",
    (60, 41, 7, 40): "fa46e91ac01f64f1",
    (33, 57, 60, 9): "466ee0a79398aa54",
    (5, 1, 3, 1): "baf3377d19a94e65",
    (17, 23, 17, 12): "606f5b7ecea3f805",
}


@pytest.mark.parametrize(("width", "height", "new_width", "new_height"), DIGESTS)
def test_bits_are_those_of_the_filter_by_rows_and_then_by_columns(width, height, new_width, new_height):
    # noise, with black next to white in its upper half, where a cubic overshoots on both sides
    image, size = np.random.default_rng(width).integers(0, 256, (height, width, 3), np.uint8), (new_width, new_height)
    image[: height // 2] = np.where(image[: height // 2] < 128, 0, 255)
    found = shrink_bicubic(image, size)
    assert hashlib.sha256(found.tobytes()).hexdigest()[:16] == DIGESTS[width, height, new_width, new_height]
    assert found.shape == (new_height, new_width, 3)
    assert found.flags.c_contiguous
    assert found.flags.writeable
    if width == 619:
        # the factors that captures are shrunk by are Pillow's in one call too
        in_one = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
        assert np.abs(found.astype(int) - in_one).max() <= 1


def test_a_capture_is_shrunk_by_the_filter_that_is_asked_for(tmp_path):
    root = transforms_capture(tmp_path)
    whole = raw(root).views[0].image
    shrunk = {resize: load_capture(root, factor=2, resize=resize).views[0].image for resize in ("area", "bicubic")}
    np.testing.assert_array_equal(shrunk["bicubic"], shrink_bicubic(whole, (WIDTH // 2, HEIGHT // 2)))
    assert (shrunk["area"] != shrunk["bicubic"]).any()
    with pytest.raises(CaptureError, match=r"resize is 'nearest'; it must be 'area' or 'bicubic'"):
        load_capture(root, factor=2, resize="nearest")


# Photographs out of a video: sharp ones, spread over its time, and none of a camera at rest.

# of every five frames these are sharp; two stretches of ten in the middle show the same
SHARP = (2, 4)
RESTING = range(30, 50)


def frame(number: int) -> np.ndarray:
    """A window that wanders over a texture; blurred unless the camera is held still for it."""
    coarse = np.random.default_rng(3).integers(0, 256, (24, 60, 3)).astype(np.uint8)
    texture = cv2.resize(coarse, (480, 192), interpolation=cv2.INTER_CUBIC)
    at = RESTING.start if number in RESTING else number
    window = np.ascontiguousarray(texture[20 : 20 + 96, 4 * at : 4 * at + 128])
    return window if number % 5 in SHARP else cv2.GaussianBlur(window, (0, 0), 3.0)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "walk.avi"
    with VideoFile(path, fps=30.0) as video:
        for number in range(80):
            video.add(frame(number))
    return path


def test_every_stretch_gives_a_sharp_frame_and_a_rest_gives_one(clip: Path, tmp_path: Path) -> None:
    taken = take_frames(clip, tmp_path / "out", count=8)
    assert taken.of == 80
    assert len(taken.frames) + taken.alike == 8
    assert all(number % 5 in SHARP for number in taken.frames)
    assert all(later - earlier >= 5 for earlier, later in zip(taken.frames, taken.frames[1:], strict=False))
    assert sum(number in RESTING for number in taken.frames) == 1
    assert taken.alike == 1
    files = list_images(tmp_path / "out")
    assert [path.name for path in files] == [f"walk_{number:06d}.jpg" for number in taken.frames]
    assert np.abs(read_image(files[0]).astype(int) - frame(taken.frames[0])).mean() < 6.0
    # more frames than there are give all that differ, and photographs can be made smaller
    taken = take_frames(clip, tmp_path / "all", count=1000, max_size=64)
    assert len(taken.frames) + taken.alike == 80
    assert len(taken.frames) >= 55
    assert {read_image(path).shape for path in list_images(tmp_path / "all")} == {(48, 64, 3)}


def test_frames_after_a_damaged_one_are_not_taken_which_is_said(clip: Path, tmp_path: Path, pop: Pop) -> None:
    data = bytearray(clip.read_bytes())
    at = -1
    for _ in range(41):
        at = data.index(b"00dc", at + 1)
    data[at + 8 : at + 1000] = bytes(992)
    (tmp_path / "walk.avi").write_bytes(data)
    assert take_frames(clip, tmp_path / "whole", count=8).lost == ""
    done = pop.done("frames", tmp_path / "walk.avi", "--count", "8", "--out", tmp_path / "out")
    assert "of 80 frames" in done.out
    # a decoder that works ahead may tell a frame early
    assert "; from frame 4" in done.out
    assert " on the video is damaged, and was not read: convert it" in done.out


def test_a_video_that_was_trimmed_on_a_telephone_is_not_called_damaged(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (128, 96))
    for number in range(60):
        video.write(frame(number))
    video.release()
    data = bytearray(path.read_bytes())
    # the edit list shows one second of the two, 20 frames of 512 ticks after the beginning
    at = data.index(b"elst") + 12
    data[at : at + 8] = struct.pack(">II", 1000, 20 * 512)
    path.write_bytes(data)
    taken = take_frames(path, tmp_path / "out", count=6)
    assert (taken.of, taken.decoded, taken.lost) == (30, 30, "")
    assert len(taken.frames) + taken.alike == 6


def test_sharpness_is_that_of_the_picture_shrunk_and_falls_with_blur() -> None:
    sharp, soft = (cv2.cvtColor(frame(number), cv2.COLOR_RGB2GRAY) for number in (2, 3))
    assert sharpness(sharp) > 4.0 * sharpness(soft)
    large = np.kron(sharp, np.ones((8, 8), np.uint8))
    assert sharpness(large) == pytest.approx(sharpness(cv2.resize(large, (512, 384), interpolation=cv2.INTER_AREA)))


def test_the_command_writes_next_to_the_video_and_says_what_comes_next(clip: Path, tmp_path: Path, pop: Pop) -> None:
    video, folder = Path(shutil.copy(clip, tmp_path / "walk.avi")), tmp_path / "walk_frames"
    done = pop.done("frames", video, "--count", "6")
    assert done.out.splitlines()[-1] == f"next: pop train {folder}"
    assert "of 80 frames" in done.out
    says(pop("frames", video, "--count", "4"), str(folder))
    pop.done("frames", video, "--count", "4", "--overwrite")
    for absent in (".", str(tmp_path / "no" / "walk.avi")):
        says(pop("frames", absent), f"{absent}: no such file; give a video")
    assert len(list_images(folder)) <= 4
    (folder / "mine.jpg").write_bytes(b"mine")
    assert pop("frames", video, "--overwrite").status == 2
    assert (folder / "mine.jpg").read_bytes() == b"mine"


def test_what_is_no_video_is_one_line_and_leaves_nothing(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.avi").write_bytes(clip.read_bytes()[:2000])
    (tmp_path / "text.mp4").write_text("no video")
    with VideoFile(tmp_path / "still.avi", fps=10.0) as video:
        for _ in range(12):
            video.add(frame(2))
    out = tmp_path / "out"
    for name, message in (
        *(("absent.mp4", "no such file"), ("text.mp4", "is not a video that OpenCV can read")),
        *(("still.avi", "nothing moves in it"), ("cut.avi", "")),
    ):
        assert_one_line(lambda name=name: take_frames(tmp_path / name, out, count=4), str(tmp_path / name), message)
        assert not out.exists()
    for wrong, message in (({"count": 1}, "count is 1"), ({"max_size": 8}, "max_size is 8")):
        with pytest.raises(PopError, match=message):
            take_frames(clip, out, **wrong)
    # of one that was cut short, what is there is spread over what is wanted, whatever its header states
    (tmp_path / "half.avi").write_bytes(clip.read_bytes()[: clip.stat().st_size // 2])
    taken = take_frames(tmp_path / "half.avi", out, count=8)
    assert 35 <= taken.of <= 45
    assert len(taken.frames) + taken.alike == 8
    # training on one says how to take photographs out of it
    assert_one_line(lambda: load_capture(clip), "walk.avi: is a video; ", " pop frames")


def test_folders_and_marks_of_a_zip_from_windows_are_told_from_its_files(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        for name in ("walk\\", "walk\\images\\", "__MACOSX\\walk\\._a.jpg", "walk\\desktop.ini", "walk\\images\\a.jpg"):
            file.writestr(name, b"" if name.endswith("\\") else b"some bytes")
    unpack(tmp_path / "a.zip", tmp_path / "a")
    assert [path for path in (tmp_path / "a").rglob("*") if path.is_file()] == [tmp_path / "a" / "walk/images/a.jpg"]


def test_an_archive_needs_room_on_the_disk_and_not_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr("a.jpg", b"some bytes")
    monkeypatch.setattr(read_back, "_ANY", 0)
    monkeypatch.setattr(read_back, "free_bytes", lambda: 0)
    unpack(tmp_path / "a.zip", tmp_path / "whole")
    assert (tmp_path / "whole" / "a.jpg").read_bytes() == b"some bytes"
    monkeypatch.setattr(read_back.shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    said = r"a\.zip: 'a\.jpg' and what else is in it would take .* of the disk, and 0\.0 MB are free"
    with pytest.raises(CaptureError, match=said):
        unpack(tmp_path / "a.zip", tmp_path / "none")
    assert not (tmp_path / "none").exists()
