"""JPEG files with damaged coded pixels, which OpenCV decodes without an error."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.data import load_capture, run_sfm
from pop_fast.io.images import read_image
from pop_fast.io.jpeg import sound_jpegs
from tests.app.captures import assert_one_line, colmap_capture, photograph, write_photograph
from tests.app.conftest import Pop


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
