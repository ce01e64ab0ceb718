"""Photographs and masks as they come: damaged, rotated, transparent, gray, of sixteen bit."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.data import Capture, load_capture
from pop_fast.data.read_images import _upright
from pop_fast.io.images import read_image
from tests.app.captures import HEIGHT, WIDTH, assert_one_line, camera, colmap_capture, photograph, write_photograph


def raw(root: Path, **options) -> Capture:
    """Load in the capture's own frame."""
    return load_capture(root, normalize=False, **options)


def test_exif_orientation_is_ignored_as_colmap_ignores_it(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, names=["a.jpg", "b.jpg"])
    plain = raw(root).views[0].image
    data = (root / "images" / "a.jpg").read_bytes()
    rotate = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 6, 0)
    (root / "images" / "a.jpg").write_bytes(
        data[:2] + b"\xff\xe1" + struct.pack(">H", len(rotate) + 2) + rotate + data[2:]
    )
    assert cv2.imread(str(root / "images" / "a.jpg")).shape[:2] == (WIDTH, HEIGHT)
    assert np.array_equal(raw(root).views[0].image, plain)


@pytest.mark.parametrize("name", ["01.png", "01.PNG.png", "01.jpg"])
def test_masks_are_found_under_all_usual_names_and_white_means_keep(tmp_path: Path, name: str) -> None:
    root = colmap_capture(tmp_path, names=["00.PNG", "01.PNG"])
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :10] = 255
    write_photograph(root / "masks" / name, mask)
    first, second = raw(root).views
    assert first.mask is None
    assert second.mask is not None
    assert second.mask.dtype == bool
    assert np.array_equal(second.mask, mask > 0)
    assert raw(root, masks=False).views[1].mask is None
    small = raw(root, factor=2).views[1].mask
    assert small is not None
    assert np.array_equal(small, mask[::2, ::2] > 0)


def test_masks_that_fit_no_photograph_or_hide_all_of_it_are_refused(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    write_photograph(root / "masks" / "elsewhere.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert_one_line(lambda: raw(root), "masks", "no mask named as a photograph")
    write_photograph(root / "masks" / "02.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    assert_one_line(lambda: raw(root), "02.png", "hides the whole photograph", "white means keep")
    write_photograph(root / "masks" / "02.png", np.full((WIDTH, HEIGHT), 255, np.uint8))
    assert_one_line(lambda: raw(root), "02.png", "the mask is 30x40", "40x30")


def test_transparency_is_composited_over_the_background_and_is_no_mask(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
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


def test_gray_and_sixteen_bit_photographs_become_eight_bit_rgb(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    gray = photograph(5)[:, :, 0]
    write_photograph(root / "images" / "00.png", gray)
    write_photograph(root / "images" / "01.png", gray.astype(np.uint16) * 257)
    for view in raw(root).views[:2]:
        assert np.array_equal(view.image, np.repeat(gray[:, :, None], 3, axis=2))


def encoded(extension: str) -> bytes:
    return cv2.imencode(extension, photograph(3, 64, 48))[1].tobytes()


PROGRESSIVE = cv2.imencode(".jpg", photograph(3, 64, 48), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
WHOLE = {
    "png": encoded(".png"),
    "jpg": encoded(".jpg"),
    "progressive.jpg": PROGRESSIVE,
    "webp": encoded(".webp"),
    "bmp": encoded(".bmp"),
    "tiff": encoded(".tiff"),
}


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_photograph_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(WHOLE[name])
    assert read_image(tmp_path / name).shape == (48, 64, 3)


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


def test_a_jpeg_overwritten_in_the_middle_is_named(tmp_path: Path) -> None:
    data = bytearray(WHOLE["jpg"])
    scan = data.index(b"\xff\xda") + 20
    data[scan : scan + 40] = b"\xff\x42" * 20
    (tmp_path / "x.jpg").write_bytes(data)
    assert_one_line(lambda: read_image(tmp_path / "x.jpg"), "x.jpg", "unexpected marker")


@pytest.mark.parametrize("name", ["jpg", "progressive.jpg"])
def test_what_cameras_append_to_a_jpeg_does_no_harm(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(WHOLE[name])
    plain = read_image(tmp_path / name)
    (tmp_path / name).write_bytes(WHOLE[name] + bytes(100) + WHOLE["jpg"])
    assert np.array_equal(read_image(tmp_path / name), plain)


@pytest.mark.parametrize(
    ("content", "word"), [(b"", "empty"), (b"no picture at all", "is no image"), (b"\xff\xd8\xff", "truncated")]
)
def test_what_is_no_photograph_is_named_by_the_capture_too(tmp_path: Path, content: bytes, word: str) -> None:
    root = colmap_capture(tmp_path)
    (root / "images" / "02.png").write_bytes(content)
    assert_one_line(lambda: load_capture(root), str(root / "images" / "02.png"), word, "copy it again")


def test_reading_bad_photographs_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, data in WHOLE.items():
        (tmp_path / name).write_bytes(data[: len(data) // 2])
        assert_one_line(lambda path=tmp_path / name: read_image(path))
    out, err = capfd.readouterr()
    assert out == ""
    assert err == ""
