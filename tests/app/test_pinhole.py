"""Pinhole cameras without pycolmap: what pycolmap says of them, and captures that load where it is not installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pop_fast.data.colmap_files import model_name, parameter_count
from pop_fast.data.pinhole import PINHOLES, make_camera
from tests.app.captures import colmap_capture, transforms_capture

ROOT = Path(__file__).resolve().parents[2]
PARAMS = {"SIMPLE_PINHOLE": [31.5, 20.25, 11.0], "PINHOLE": [31.5, 30.0, 20.25, 11.0]}
# stands in for an environment without them
BLOCKED = "import sys; sys.modules.update(dict.fromkeys(('pycolmap', 'plyfile'))); "
LOAD = BLOCKED + "from pop_fast.data import load_capture; c = load_capture({!r}); print(len(c.views), len(c.points))"


@pytest.mark.parametrize("name", PINHOLES)
def test_a_pinhole_is_pycolmaps_pinhole(name):
    number = int(pycolmap.CameraModelId.__members__[name])
    assert (PINHOLES[name][0], model_name(number)) == (number, name)
    ours = make_camera(7, name, 40, 22, PARAMS[name])
    theirs = pycolmap.Camera(camera_id=7, model=name, width=40, height=22, params=PARAMS[name])
    assert not isinstance(ours, pycolmap.Camera)
    assert parameter_count(name) == len(theirs.params)
    fields = ("camera_id", "model_name", "width", "height", "focal_length_x", "focal_length_y")
    for field in (*fields, "principal_point_x", "principal_point_y"):
        assert getattr(ours, field) == getattr(theirs, field), field
    assert ours.params.tolist() == list(theirs.params)
    assert list(ours.focal_length_idxs()) == list(theirs.focal_length_idxs())
    assert ours.mean_focal_length() == theirs.mean_focal_length()
    points = np.random.default_rng(0).uniform(0.5, 3.0, (50, 3))
    np.testing.assert_allclose(ours.img_from_cam(points), theirs.img_from_cam(points), rtol=1e-14)


def test_other_models_are_pycolmaps_own():
    assert isinstance(make_camera(1, "OPENCV", 8, 8, [9.0, 9.0, 4.0, 4.0, 0.1, 0.0, 0.0, 0.0]), pycolmap.Camera)
    assert model_name(4) == "OPENCV"
    assert parameter_count("OPENCV") == 8
    assert model_name(1000) is None


def load_without_colmap(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LOAD.format(str(folder))]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_captures_of_pinholes_load_without_pycolmap_and_plyfile(tmp_path):
    for folder in (colmap_capture(tmp_path / "binary"), transforms_capture(tmp_path / "transforms")):
        done = load_without_colmap(folder)
        assert done.returncode == 0, done.stderr
        assert int(done.stdout.split()[0]) >= 2


def test_a_lens_that_needs_pycolmap_says_so(tmp_path):
    lines = {"cameras": "1 OPENCV 8 8 9 9 4 4 0.1 0 0 0\n", "images": "1 1 0 0 0 0 0 0 1 a.png\n\n", "points3D": ""}
    (tmp_path / "sparse").mkdir()
    for name, text in lines.items():
        (tmp_path / "sparse" / f"{name}.txt").write_text(text)
    done = load_without_colmap(tmp_path)
    assert done.returncode != 0
    assert "CaptureError: pycolmap cannot be imported" in done.stderr
    assert "pip install pycolmap" in done.stderr
