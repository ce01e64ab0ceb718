"""`pop doctor` and `pop data check`: what they find, and what they say about it."""

from __future__ import annotations

import importlib
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.app.conftest import Pop


def test_a_whole_install_is_found_whole(pop: Pop) -> None:
    outcome = pop("doctor")
    assert outcome.status == 0
    for name in ("numpy", "torch", "pycolmap", "opencv-contrib-python-headless", "backend fast", "processor", "memory"):
        assert name in outcome.out
    assert "everything that pop needs is here" in outcome.out


@pytest.mark.parametrize(
    ("missing", "words"),
    [(None, "ok       CUDA build"), ("nvcc", "nvcc was not found; install a CUDA toolkit"), ("cmake", "[cuda-build]")],
)
def test_what_building_the_cuda_extension_lacks_is_said(
    pop: Pop, monkeypatch: pytest.MonkeyPatch, missing: str | None, words: str
) -> None:
    from cuda_ext import build, toolkit

    monkeypatch.setattr(build, "find_nvcc", lambda: None if missing == "nvcc" else "/opt/nvcc")
    monkeypatch.setattr(build, "_program", lambda name: None if name == missing else f"/bin/{name}")
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(toolkit, "nvcc_version", lambda nvcc: (13, 0))
    monkeypatch.setattr("cuda_ext.why_not", lambda: "the CUDA extension is not built")
    outcome = pop("doctor")
    assert outcome.status == 0
    line = next(line for line in outcome.out.splitlines() if "CUDA build" in line)
    assert words in line
    backend = next(line for line in outcome.out.splitlines() if "backend cuda" in line)
    assert " ".join(backend.split()) == "- backend cuda the CUDA extension is not built (optional)"


@pytest.mark.parametrize("how", ["absent", "broken"])
def test_a_missing_package_is_named_with_the_way_to_get_it(pop: Pop, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    real = importlib.import_module

    def import_module(name: str, package: str | None = None) -> Any:
        if name == "plyfile":
            raise ImportError("no such module") if how == "absent" else OSError("libxyz.so: cannot open")
        return real(name, package)

    monkeypatch.setattr("pop_fast.cli.doctor.importlib.import_module", import_module)
    if how == "absent":
        monkeypatch.setattr("pop_fast.cli.doctor._installed", lambda name: None if name == "plyfile" else "1.0")
    outcome = pop("doctor")
    assert outcome.status == 1
    line = next(line for line in outcome.out.splitlines() if "plyfile" in line)
    assert line.strip().startswith("MISSING")
    assert "pip install" in line
    assert ("libxyz.so" in line) == (how == "broken")
    assert outcome.out.rstrip().endswith("missing: plyfile")


def check(pop: Pop, folder: Path, status: int) -> list[str]:
    outcome = pop("data", "check", folder)
    assert outcome.status == status, outcome
    return outcome.out.splitlines()


def finding(lines: list[str], mark: str, about: str) -> str:
    """Give the first finding of that mark and topic."""
    return next(line for line in lines if line.split()[:2] == [mark, about])


def test_a_sound_capture_is_ready(pop: Pop, shared_capture: Path) -> None:
    lines = check(pop, shared_capture, 0)
    assert lines[-1] == "ready to train"
    assert "8 views from the COLMAP model in sparse/0" in finding(lines, "ok", "poses")
    assert "8 x PINHOLE 40x32" in finding(lines, "ok", "cameras")
    assert "8 of 40x32 px" in finding(lines, "ok", "photographs")
    assert "mean error" in finding(lines, "ok", "reprojection")
    assert "at factor 4" in finding(lines, "ok", "memory")
    assert not any(line.startswith(("LOOK", "BAD")) for line in lines)


def test_every_problem_of_a_damaged_capture_is_listed_at_once(pop: Pop, capture: Path) -> None:
    photos = sorted((capture / "images").iterdir())
    photos[1].unlink()
    photos[2].write_bytes(photos[2].read_bytes()[:200])
    cv2.imwrite(str(photos[3]), np.zeros((40, 32, 3), np.uint8))
    cv2.imwrite(str(capture / "images" / "extra.png"), np.zeros((32, 40, 3), np.uint8))
    lines = check(pop, capture, 1)
    text = "\n".join(lines)
    assert "1 of 8 listed are absent, first view_001.png" in text
    assert "view_002.png" in text
    assert "view_003.png is 32x40 px, its camera 40x32: another shape" in text
    assert "1 files in images/ are not listed, first extra.png" in finding(lines, "LOOK", "pairing")
    assert lines[-1] == "3 problems stand against training"


def test_photographs_of_half_the_size_are_fine_and_said_so(pop: Pop, capture: Path) -> None:
    for path in (capture / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (20, 16)))
    lines = check(pop, capture, 0)
    assert "K is scaled to fit" in finding(lines, "ok", "sizes")
    assert lines[-2] == "and 3 more of the same kinds; --all prints them"


def with_exif_orientation(jpeg: bytes, orientation: int) -> bytes:
    """Insert an EXIF segment that holds an orientation alone."""
    tiff = b"II*\0" + struct.pack("<IH", 8, 1) + struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0) + bytes(4)
    body = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.mark.parametrize(("orientation", "turned"), [(1, False), (3, True), (6, True)])
def test_exif_orientation_is_pointed_out(pop: Pop, capture: Path, orientation: int, turned: bool) -> None:
    path = capture / "images" / "view_000.png"
    ok, data = cv2.imencode(".jpg", cv2.imread(str(path)))
    assert ok
    path.unlink()
    path.with_suffix(".jpg").write_bytes(with_exif_orientation(data.tobytes(), orientation))
    lines = check(pop, capture, 0)
    found = [line for line in lines if line.split()[:2] == ["LOOK", "EXIF"]]
    assert len(found) == turned
    assert not turned or "1 ask to be rotated, first view_000.png" in found[0]


@pytest.mark.parametrize(("kept", "mark"), [(0.9, "ok"), (0.1, "LOOK")])
def test_masks_that_look_inverted_are_pointed_out(pop: Pop, capture: Path, kept: float, mark: str) -> None:
    (capture / "masks").mkdir()
    mask = np.zeros((32, 40), np.uint8)
    mask[: round(32 * kept)] = 255
    for path in sorted((capture / "images").iterdir())[:-1]:
        cv2.imwrite(str(capture / "masks" / path.name), mask)
    lines = check(pop, capture, 0)
    said = finding(lines, mark, "masks")
    assert "7 masks keep" in said
    assert ("inverted" in said) == (mark == "LOOK")
    assert "1 photographs have none, first view_007.png" in "\n".join(lines)


def test_a_capture_of_bare_photographs_is_told_to_find_its_cameras(pop: Pop, capture: Path) -> None:
    for path in (capture / "sparse" / "0").iterdir():
        path.unlink()
    outcome = pop("data", "check", capture)
    assert outcome.status == 0
    assert "none yet, 8 photographs: pop train finds their cameras first, or pop sfm alone" in outcome.out
