"""Photographs and masks as they come: damaged, rotated, transparent, gray, of sixteen bit."""

from __future__ import annotations

import hashlib
import shutil
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from pop_fast.data import Capture, load_capture, run_sfm, sfm
from pop_fast.data.read_images import _upright, shrink_bicubic
from pop_fast.errors import CaptureError
from pop_fast.io import images
from pop_fast.io.image_header import Exif, can_read_heif, read_exif, read_size, size_of
from pop_fast.io.images import list_images, read_image, sound_jpegs
from tests.app.captures import (
    HEIGHT,
    WIDTH,
    assert_one_line,
    camera,
    colmap_capture,
    photograph,
    transforms_capture,
    write_photograph,
)
from tests.app.conftest import Pop


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


# What a file's header says, held against what another library writes; and headers that promise too much.

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


# HEIC photographs are read where pillow-heif is installed, and a clear line says so where it is not.

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


# JPEG files with damaged coded pixels, which OpenCV decodes without an error.


def jpeg(seed: int = 0, progressive: bool = False) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    return cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 1.0), options)[1].tobytes()


def zeroed(data: bytes, share: float) -> bytes:
    at = int(share * len(data))
    return data[:at] + bytes(400) + data[at + 400 :]


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_zeros_in_the_middle_are_named_with_the_file(tmp_path: Path, share: float, progressive: bool) -> None:
    files = [tmp_path / f"{i} ü.JPG" for i in range(20)]
    for i, file in enumerate(files):
        data = jpeg(i, progressive)
        file.write_bytes(zeroed(data, share) if i in (13, 17) else data)
    read_image(files[13])  # OpenCV itself finds nothing

    def read() -> None:
        with sound_jpegs(files):
            pass

    assert_one_line(read, str(files[13]), "JPEG file is corrupt", "copy it again")


def test_a_capture_with_such_a_photograph_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    root = colmap_capture(tmp_path, names=["0.jpg", "1.jpeg", "2.png"])
    assert load_capture(root).notes == ()
    assert capfd.readouterr().err == ""
    (root / "images" / "1.jpeg").write_bytes(zeroed(jpeg(), 0.5))
    assert_one_line(lambda: load_capture(root), str(root / "images" / "1.jpeg"), "corrupt", "copy it again")
    assert_one_line(lambda: run_sfm(root / "images", tmp_path / "out"), str(root / "images" / "1.jpeg"), "corrupt")
    assert not (tmp_path / "out").exists()


def test_data_check_lists_all_of_them(pop: Pop, tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, names=["0.jpg", "1.jpg", "2.png"])
    for name in ("0.jpg", "1.jpg"):
        (root / "images" / name).write_bytes(zeroed(jpeg(), 0.5))
    outcome = pop("data", "check", root)
    assert outcome.status == 1
    for name in ("0.jpg", "1.jpg"):
        assert f"{name}: the JPEG file is corrupt" in outcome.out


def test_padding_and_other_formats_do_no_harm(tmp_path: Path) -> None:
    data = jpeg()
    (tmp_path / "a.jpg").write_bytes(data[:-2] + bytes(8) + data[-2:])
    write_photograph(tmp_path / "b.png", photograph(0))
    (tmp_path / "c.jpg").write_bytes(b"no picture")
    with sound_jpegs([tmp_path / name for name in ("a.jpg", "b.png", "c.jpg", "absent.jpg")]):
        pass


def test_an_error_of_the_block_comes_first(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(zeroed(jpeg(), 0.5))
    with pytest.raises(KeyError), sound_jpegs([tmp_path / "a.jpg"]):
        raise KeyError


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


def picture(width: int, height: int) -> np.ndarray:
    """Noise, with black next to white in its upper half, where a cubic overshoots on both sides."""
    image = np.random.default_rng(width).integers(0, 256, (height, width, 3), dtype=np.uint8)
    image[: height // 2] = np.where(image[: height // 2] < 128, 0, 255)
    return image


@pytest.mark.parametrize(("width", "height", "new_width", "new_height"), DIGESTS)
def test_bits_are_those_of_the_filter_by_rows_and_then_by_columns(width, height, new_width, new_height):
    image, size = picture(width, height), (new_width, new_height)
    found = shrink_bicubic(image, size)
    assert hashlib.sha256(found.tobytes()).hexdigest()[:16] == DIGESTS[width, height, new_width, new_height]
    assert found.shape == (new_height, new_width, 3)
    assert found.flags.c_contiguous
    assert found.flags.writeable


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_the_factors_that_captures_are_shrunk_by_are_pillows_in_one_call_too(factor):
    image = picture(619, 411)
    size = (round(619 / factor), round(411 / factor))
    in_one = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC))
    assert np.abs(shrink_bicubic(image, size).astype(int) - in_one).max() <= 1


def test_a_capture_is_shrunk_by_the_filter_that_is_asked_for(tmp_path):
    root = transforms_capture(tmp_path)
    whole = load_capture(root, normalize=False).views[0].image
    size = (round(whole.shape[1] / 2), round(whole.shape[0] / 2))
    shrunk = {resize: load_capture(root, factor=2, resize=resize).views[0].image for resize in ("area", "bicubic")}
    np.testing.assert_array_equal(shrunk["bicubic"], shrink_bicubic(whole, size))
    assert (shrunk["area"] != shrunk["bicubic"]).any()
    with pytest.raises(CaptureError, match=r"resize is 'nearest'; it must be 'area' or 'bicubic'"):
        load_capture(root, factor=2, resize="nearest")
