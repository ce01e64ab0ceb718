"""Structure from motion on a bare folder of photographs."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.data import load_capture, run_sfm
from pop_fast.data.sfm_search import pairs_of
from pop_fast.demo.scene import make_scene
from pop_fast.demo.tracer import render_view
from tests.app.captures import assert_one_line, look_at, photograph, write_photograph

K = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
CENTERS = [(4.0 * np.cos(a), 4.0 * np.sin(a), 1.5 + 0.2 * (i % 2)) for i, a in enumerate(np.linspace(0.3, 1.3, 7))]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    scene = make_scene(0)
    for i, center in enumerate(CENTERS):
        write_photograph(folder / f"walk {i}.png", render_view(scene, look_at(center, (0.0, 0.0, 0.4)), K, 320, 240))
    return folder


@pytest.fixture(scope="module")
def found(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sfm") / "capture"
    result = run_sfm(photographs, out)
    assert result.capture == out
    assert result.registered == result.photographs == len(CENTERS)
    assert result.points >= 50
    assert result.reprojection_error < 1.0
    return out


def test_cameras_are_found_where_the_photographs_were_taken(found: Path) -> None:
    views = load_capture(found, normalize=False).views
    assert [view.name for view in views] == [f"walk {i}.png" for i in range(len(CENTERS))]
    centers = np.stack([view.camera_center for view in views])
    truth = np.array(CENTERS)
    # up to a similarity: align by the singular value decomposition of the covariance (Umeyama)
    a, b = centers - centers.mean(axis=0), truth - truth.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    aligned = (np.trace(np.diag(S) @ mirror) / (a**2).sum()) * a @ (U @ mirror @ Vt).T
    assert np.abs(aligned - b).max() < 0.05
    assert views[0].K[0, 0] == pytest.approx(300.0, rel=0.05)


def test_photographs_are_copied_beside_the_model(found: Path, photographs: Path) -> None:
    for file in photographs.iterdir():
        assert (found / "images" / file.name).read_bytes() == file.read_bytes()


def test_the_same_photographs_give_the_same_bytes_and_progress_is_told(
    found: Path, photographs: Path, tmp_path: Path
) -> None:
    told: list[tuple[str, int, int]] = []
    (tmp_path / "in").mkdir()
    for file in photographs.iterdir():
        shutil.copy(file, tmp_path / "in")
    # in place this time: the model comes to lie beside the photographs
    result = run_sfm(tmp_path / "in", progress=lambda *what: told.append(what))
    assert result.capture == (tmp_path / "in").resolve()
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "in" / "sparse" / "0" / name).read_bytes() == (found / "sparse" / "0" / name).read_bytes()
    n = len(CENTERS)
    assert {stage for stage, _, _ in told} == {
        "checking photographs",
        "finding features in photographs",
        "matching pairs of photographs",
        "finding cameras of photographs",
    }
    assert ("finding features in photographs", n, n) in told
    assert ("matching pairs of photographs", n * (n - 1) // 2, n * (n - 1) // 2) in told
    assert ("finding cameras of photographs", n, n) in told
    assert all(0 <= done <= total for _, done, total in told)
    assert len(load_capture(tmp_path / "in").views) == n
    assert_one_line(lambda: run_sfm(tmp_path / "in"), "sparse", "--overwrite")


def test_a_bare_folder_is_loaded_only_when_sfm_is_asked_for(photographs: Path, tmp_path: Path) -> None:
    shutil.copytree(photographs, tmp_path / "scene" / "images")
    assert_one_line(lambda: load_capture(tmp_path / "scene"), "7 photographs", "pop sfm")
    assert sorted(file.name for file in (tmp_path / "scene").iterdir()) == ["images"]
    capture = load_capture(tmp_path / "scene", sfm=True)
    assert len(capture.views) == len(CENTERS)
    assert (tmp_path / "scene" / "sparse" / "0" / "cameras.bin").is_file()
    assert len(load_capture(tmp_path / "scene").views) == len(CENTERS)


def test_photographs_without_anything_in_common_give_one_line_and_no_output(tmp_path: Path) -> None:
    for i in range(3):
        write_photograph(tmp_path / "in" / f"{i}.png", photograph(i, 64, 48))
    assert_one_line(lambda: run_sfm(tmp_path / "in", tmp_path / "out"), "in", "no cameras could be found", "overlap")
    assert [file.name for file in tmp_path.iterdir()] == ["in"]


def test_fewer_than_two_photographs_are_refused(tmp_path: Path) -> None:
    assert_one_line(lambda: run_sfm(tmp_path / "absent"), "absent", "no such folder")
    assert_one_line(lambda: run_sfm(tmp_path), "has 0 photograph")
    write_photograph(tmp_path / "a.png", photograph(0))
    write_photograph(tmp_path / "masks" / "a.png", photograph(0))
    assert_one_line(lambda: run_sfm(tmp_path), "has 1 photograph")


def test_a_damaged_photograph_is_found_before_the_long_work_begins(tmp_path: Path) -> None:
    write_photograph(tmp_path / "a.png", photograph(0))
    _, data = cv2.imencode(".jpg", photograph(1))
    (tmp_path / "b.jpg").write_bytes(data.tobytes()[:-40])
    assert_one_line(lambda: run_sfm(tmp_path), "b.jpg", "truncated")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.png", "b.jpg"]


def test_an_unknown_camera_model_is_refused(tmp_path: Path) -> None:
    for i in range(2):
        write_photograph(tmp_path / f"{i}.png", photograph(i))
    assert_one_line(lambda: run_sfm(tmp_path, camera_model="PINHOLES"), "'PINHOLES'", "SIMPLE_RADIAL")


def test_few_photographs_are_all_matched_and_many_with_their_neighbours() -> None:
    assert len(pairs_of(60, "auto")) == 60 * 59 // 2
    assert len(pairs_of(200, "exhaustive")) == 200 * 199 // 2
    assert pairs_of(30, "sequential") == [pair for pair in pairs_of(200, "auto") if pair[1] < 30]
    many = pairs_of(200, "auto")
    assert len(many) < 200 * 20
    assert {(0, 1), (0, 10), (0, 16), (0, 128), (198, 199)} <= set(many)
    assert all(i < j < 200 for i, j in many)
