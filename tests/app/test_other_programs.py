"""Cameras of Polycam, Metashape and RealityCapture: those of the demo capture come back from each program's export."""

from __future__ import annotations

import re
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pop_fast.data import Capture, load_capture
from pop_fast.data.sfm import photographs
from pop_fast.errors import CaptureError
from tests.app import exported
from tests.app.conftest import Pop

WRITERS: dict[str, Callable[..., Path]] = {
    "polycam": exported.polycam,
    "metashape": exported.metashape,
    "realitycapture": exported.realitycapture,
}
FILES = {
    "polycam": "keyframes/corrected_cameras/view_002.json",
    "metashape": "cameras.xml",
    "realitycapture": "cameras.csv",
}


@pytest.fixture(scope="module")
def original(shared_capture: Path) -> Capture:
    return load_capture(shared_capture, normalize=False)


def write(program: str, original: Capture, shared_capture: Path, tmp_path: Path, **options: str) -> Path:
    return WRITERS[program](original, shared_capture, tmp_path / "export", **options)


def same_cameras(found: Capture, expected: Capture) -> None:
    assert [view.name for view in found.views] == [view.name for view in expected.views]
    for ours, theirs in zip(found.views, expected.views, strict=True):
        np.testing.assert_allclose(ours.viewmat, theirs.viewmat, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(ours.K, theirs.K, rtol=0.0, atol=1e-6)
        np.testing.assert_array_equal(ours.image, theirs.image)


@pytest.mark.parametrize("program", WRITERS)
@pytest.mark.parametrize("said", [True, False])
def test_the_cameras_of_an_export_are_those_it_was_made_from(
    program: str, said: bool, original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write(program, original, shared_capture, tmp_path)
    source = {"source": program} if said else {}
    found = load_capture(folder, normalize=False, points=20, **source)
    same_cameras(found, original)
    assert found.source.startswith(
        {"polycam": "Polycam", "metashape": "Metashape", "realitycapture": "RealityCapture"}[program]
    )
    assert any("not aligned and left out, first lost" in note for note in found.notes) == (program == "metashape")


def test_a_metashape_export_of_which_every_camera_is_aligned_is_read(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write("metashape", original, shared_capture, tmp_path)
    (path,) = folder.glob("*.xml")
    tree = ET.parse(path)
    for group in tree.iter("cameras"):
        for camera in [camera for camera in group.iter("camera") if camera.find("transform") is None]:
            next(parent for parent in tree.iter() if camera in list(parent)).remove(camera)
    tree.write(path)
    found = load_capture(folder, normalize=False, points=20)
    same_cameras(found, original)
    assert not any("not aligned" in note for note in found.notes)


def test_polycams_first_cameras_are_read_where_it_has_not_corrected_them(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write("polycam", original, shared_capture, tmp_path, kind="")
    same_cameras(load_capture(folder, normalize=False, points=20), original)


def test_structure_from_motion_takes_a_polycam_exports_photographs_and_nothing_else(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    folder = write("polycam", original, shared_capture, tmp_path)
    exported.photographs(shared_capture, folder / "keyframes" / "images")
    assert [path.relative_to(folder).as_posix() for path in photographs(folder)] == [
        f"keyframes/corrected_images/view_{i:03d}.png" for i in range(8)
    ]


def test_points_beside_an_export_are_read(original: Capture, shared_capture: Path, tmp_path: Path) -> None:
    folder = write("realitycapture", original, shared_capture, tmp_path)
    rows = "\n".join(f"{i} {2 * i} {i * i} 10 20 30" for i in range(12))
    names = "".join(f"property float {axis}\n" for axis in "xyz") + "".join(
        f"property uchar {color}\n" for color in ("red", "green", "blue")
    )
    (folder / "points3D.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 12\n{names}end_header\n{rows}\n")
    assert len(load_capture(folder, normalize=False).points) == 12


def test_a_metashape_lens_is_opencvs_with_its_tangential_terms_exchanged(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    from pop_fast.data.exports import read_metashape

    lens = "<k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3><p1>0.004</p1><p2>-0.005</p2>"
    folder = write("metashape", original, shared_capture, tmp_path, lens=lens)
    camera = read_metashape(folder / "cameras.xml", folder, "images")[0][0].camera
    x, y = 0.25, -0.125
    r2 = x * x + y * y
    radial = 1.0 - 0.1 * r2 + 0.02 * r2**2 + 0.003 * r2**3
    # Metashape's manual, appendix D, frame cameras
    xd = x * radial + 0.004 * (r2 + 2 * x * x) + 2 * -0.005 * x * y
    yd = y * radial + -0.005 * (r2 + 2 * y * y) + 2 * 0.004 * x * y
    K = original.views[0].K
    expected = [K[0, 0] * xd + K[0, 2], K[1, 1] * yd + K[1, 2]]
    np.testing.assert_allclose(camera.img_from_cam(np.array([[x, y, 1.0]]))[0], expected, rtol=0.0, atol=1e-9)


def test_a_metashape_fisheye_is_opencvs(original: Capture, shared_capture: Path, tmp_path: Path) -> None:
    from pop_fast.data.exports import read_metashape

    folder = write("metashape", original, shared_capture, tmp_path, lens="<k1>0.1</k1><k4>0.01</k4>", kind="fisheye")
    camera = read_metashape(folder / "cameras.xml", folder, "images")[0][0].camera
    angle = 0.5
    distorted = angle * (1.0 + 0.1 * angle**2 + 0.01 * angle**8)
    K = original.views[0].K
    seen = camera.img_from_cam(np.array([[np.tan(angle), 0.0, 1.0]]))[0]
    np.testing.assert_allclose(seen, [K[0, 0] * distorted + K[0, 2], K[1, 2]], rtol=0.0, atol=1e-9)


# what is put in the place of what, and what is said of it
DAMAGED = {
    "polycam: no JSON": ("polycam", r"\A\{", "", r"view_002\.json: is not valid JSON"),
    "polycam: field": ("polycam", '"t_12"', '"t_zz"', r"view_002\.json: t_12 is None; it must be a finite number"),
    "polycam: focal": ("polycam", r'"fx": [^,]*', '"fx": 0', r"view_002\.json: fx, fy are 0\.0.*must be > 0"),
    "polycam: size": ("polycam", '"width": 40', '"width": 0', r"view_002\.json: size is 0 x 32"),
    "polycam: rigid": ("polycam", r'"t_00": [^,]*', '"t_00": 9', r"view_002\.json: the matrix t_00 to t_23 is not"),
    "metashape: XML": ("metashape", "</document>", "", r"cameras\.xml: is not valid XML"),
    "metashape: cameras": ("metashape", "cameras>", "kameras>", r"cameras\.xml: has no chunk with cameras"),
    "metashape: sensor": ("metashape", '<sensor id="3"', '<sensor id="4"', r"camera view_000\.png: sensor_id names no"),
    "metashape: focal": ("metashape", r"<f>[0-9.]*</f><b1>", "<f>x</f><b1>", r"sensor 3: calibration: f is 'x'"),
    "metashape: skew": ("metashape", "<b1>", "<b2>3</b2><b1>", r"sensor 3: calibration: b2 is 3, a skew"),
    "metashape: k4": ("metashape", "<b1>", "<k4>3</k4><b1>", r"sensor 3: calibration has k4 = 3.*undistort"),
    "metashape: kind": ("metashape", '"frame" class="adj', '"spherical" class="adj', r"the type 'spherical'"),
    "metashape: pose": ("metashape", r"<transform>[-0-9.e]+ ", "<transform>", r"view_000\.png: transform is .*16 fin"),
    "metashape: scale": ("metashape", "<scale>2.5", "<scale>-1", r"component 0: transform/scale is -1\.0; it must"),
    "metashape: label": ("metashape", 'label="view_001"', 'label="view_000.png"', r"two cameras .* view_000\.png"),
    "realitycapture: column": ("realitycapture", "pitch", "pitsch", r"cameras\.csv: has no column pitch"),
    "realitycapture: number": ("realitycapture", r"view_001\.png,[^,]*", "view_001.png,", r"view_001\.png: x is ''"),
    "realitycapture: twice": ("realitycapture", "view_001", "view_000", r"cameras\.csv: lists view_000\.png twice"),
    "realitycapture: none": ("realitycapture", r"(?s)\nview.*", "\n", r"cameras\.csv: lists no photograph"),
    "realitycapture: names": ("realitycapture", "view_", "else_", r"cameras\.csv: none of its 8 photographs lies in"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_export_is_one_line_that_names_file_and_field(
    case: str, original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    program, pattern, instead, message = DAMAGED[case]
    folder = write(program, original, shared_capture, tmp_path)
    path = folder / FILES[program]
    text = path.read_text()
    changed = re.sub(pattern, instead, text, count=0 if program != "metashape" or "ameras>" in pattern else 1)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(folder, source=program)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("program", WRITERS)
def test_a_source_that_is_not_there_is_said(program: str, shared_capture: Path) -> None:
    with pytest.raises(CaptureError, match=r"toy: has no .*; export it there, or choose another --source"):
        load_capture(shared_capture, source=program)


def test_a_photograph_that_an_export_lists_and_that_is_absent_can_be_skipped(
    original: Capture, shared_capture: Path, tmp_path: Path
) -> None:
    for program in WRITERS:
        folder = write(program, original, shared_capture, tmp_path / program)
        next(path for path in folder.rglob("view_003.png") if "depth" not in path.parts).unlink()
        with pytest.raises(CaptureError, match="1 of them absent"):
            load_capture(folder)
        assert len(load_capture(folder, missing="skip", points=20).views) == 7
        shutil.rmtree(folder)


@pytest.mark.parametrize("program", WRITERS)
def test_data_check_looks_an_export_over(
    program: str, original: Capture, shared_capture: Path, tmp_path: Path, pop: Pop
) -> None:
    found = pop("data", "check", write(program, original, shared_capture, tmp_path))
    assert found.status == 0
    assert "8 views from the" in found.out
    assert "8 of 40x32 px" in found.out
