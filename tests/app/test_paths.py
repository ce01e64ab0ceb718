"""Camera paths and video files."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pop_fast.data.capture import camera_centers, focus_point, look_at_one_point, neighbour_degrees
from pop_fast.view import paths
from pop_fast.view.paths import PATHS, VideoFile, camera_path, frames_in, has_h264, interpolate, look_at, mean_up, orbit
from tests.app.captures import assert_one_line
from tests.app.conftest import in_a_child

UP, TARGET = np.array([0.0, 0.0, 1.0]), np.array([0.5, -0.25, 0.0])


def around(degrees: np.ndarray, height: float) -> np.ndarray:
    """Cameras 3 away from the target, at these angles, looking at it. [n, 4, 4]"""
    turn = np.radians(degrees)
    offsets = np.stack([3.0 * np.cos(turn), 3.0 * np.sin(turn), np.full(len(turn), height)], axis=1)
    return look_at(TARGET + offsets, TARGET, UP)


def ring(n: int = 12) -> np.ndarray:
    return around(np.linspace(0.0, 360.0, n, endpoint=False), 1.0)


def seen_from_target(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of cameras from the target, and their angles in degrees."""
    offsets = camera_centers(path) - TARGET
    return offsets, np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])) % 360.0


def steps_round(path: np.ndarray) -> np.ndarray:
    """Lengths of the steps from camera to camera, and from the last to the first."""
    centers = camera_centers(path)
    return np.linalg.norm(np.diff(np.vstack([centers, centers[:1]]), axis=0), axis=1)


@pytest.mark.parametrize("name", PATHS)
def test_every_path_has_rigid_cameras_and_as_many_as_asked(name: str) -> None:
    path = camera_path(name, ring(), 17)
    assert path.shape == (17, 4, 4)
    R = path[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (17, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    np.testing.assert_array_equal(path[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (17, 1)))
    if name != "interpolate":
        # up stays up along closed paths, which step evenly round to their start
        assert mean_up(path) @ UP > 0.5
        steps = steps_round(camera_path(name, ring(n=24), 40))
        assert steps.max() < 1.3 * steps.min()


def test_the_focus_of_a_ring_is_the_point_its_cameras_look_at_and_else_ahead_of_them() -> None:
    np.testing.assert_allclose(focus_point(ring()), TARGET, atol=1e-9)
    parallel = np.tile(np.eye(4), (3, 1, 1))
    parallel[:, 0, 3] = [-1.0, 0.0, 1.0]
    assert focus_point(parallel)[2] > 0.0
    assert np.all(np.isfinite(orbit(parallel, 5)))
    outwards = ring()[:3]
    outwards[:, :3, :] *= np.array([-1.0, 1.0, -1.0])[:, None]  # half a turn about their own y axes
    ahead = np.einsum("mj,mj->m", focus_point(outwards) - camera_centers(outwards), outwards[:, 2, :3])
    assert np.median(ahead) > 0.0


def test_an_orbit_keeps_distance_height_and_gaze_and_is_a_full_circle_where_cameras_stand_all_round() -> None:
    for n in (3, 4, 12):
        path = orbit(ring(n), 8)
        offsets, angles = seen_from_target(path)
        np.testing.assert_allclose(np.diff(np.sort(angles)), 45.0)
    np.testing.assert_allclose(np.hypot(offsets[:, 0], offsets[:, 1]), 3.0, atol=1e-9)
    np.testing.assert_allclose(offsets[:, 2], 1.0, atol=1e-9)
    gaze = np.einsum("mij,mj->mi", path[:, :3, :3], -offsets)
    np.testing.assert_allclose(gaze[:, :2], 0.0, atol=1e-9)
    assert np.all(gaze[:, 2] > 0.0)


@pytest.mark.parametrize("width", [20.0, 100.0, 190.0])
def test_an_orbit_of_a_capture_from_one_side_stays_on_that_side(width: float) -> None:
    # over the seam of the angle too
    path = orbit(around(np.linspace(-width / 2, width / 2, 9) + 170.0, 0.0), 40)
    _, angles = seen_from_target(path)
    assert angles.min() == pytest.approx(170.0 - width / 2, abs=1e-6)
    assert angles.max() == pytest.approx(170.0 + width / 2, abs=1e-6)
    assert angles[0] == pytest.approx(170.0)
    assert steps_round(path).max() < 3.0 * np.radians(width) / 2 * 2.0 * np.pi / 40


def walk(n: int = 30, turn: float = 0.0) -> np.ndarray:
    """Cameras of a walk along y that looks ahead and, by `turn` degrees, to the sides. [n, 4, 4]"""
    along = np.linspace(0.0, 10.0, n)
    centers = np.stack([0.1 * np.sin(3.0 * along), along, 0.02 * np.cos(5.0 * along)], axis=1)
    side = np.radians(turn) * np.sin(along)
    ahead = centers + np.stack([np.sin(side), np.cos(side), np.zeros(n)], axis=1)
    return np.concatenate([look_at(a[None], b, UP) for a, b in zip(centers, ahead, strict=True)])


@pytest.mark.parametrize("turn", [0.0, 15.0, 60.0, 180.0])
def test_an_orbit_of_a_walk_or_a_room_follows_the_cameras(turn: float) -> None:
    cameras = walk(turn=turn)
    assert not look_at_one_point(cameras)
    assert neighbour_degrees(cameras) is None
    path = orbit(cameras, 60)
    np.testing.assert_allclose(path[[0, -1]], cameras[[0, -1]], atol=1e-9)
    apart = np.linalg.norm(camera_centers(path)[:, None] - camera_centers(cameras), axis=2)
    assert apart.min(axis=1).max() < 0.5  # cameras stand 0.34 apart
    nearest = apart.argmin(axis=1)
    gaze = np.einsum("mj,mj->m", path[:, 2, :3], cameras[nearest, 2, :3])
    assert gaze.min() > np.cos(np.radians(40.0))


def test_an_orbit_of_a_walk_towards_what_it_looks_at_follows_the_cameras() -> None:
    along = np.linspace(0.0, 6.0, 30)
    centers = np.stack([0.35 * np.sin(3.0 * along), along, np.zeros(30)], axis=1)
    towards = np.stack([-0.6 * centers[:, 0], along + 4.0, np.full(30, -0.4)], axis=1)
    cameras = np.concatenate([look_at(a[None], b, UP) for a, b in zip(centers, towards, strict=True)])
    assert not look_at_one_point(cameras)
    np.testing.assert_allclose(orbit(cameras, 60)[[0, -1]], cameras[[0, -1]], atol=1e-9)
    # a subject from near and from far is still gone round
    near_and_far = ring(n=24)
    near_and_far[::2, :3, 3] *= 1.7
    assert look_at_one_point(near_and_far)


@pytest.mark.parametrize("seed", range(3))
def test_cameras_that_shake_still_look_at_one_point(seed: int) -> None:
    shaken = ring(n=24)
    turns = Rotation.random(24, rng=np.random.default_rng(seed)).as_rotvec()
    for camera, turn in zip(shaken, turns, strict=True):
        camera[:3] = Rotation.from_rotvec(np.radians(15.0) * turn / np.linalg.norm(turn)).as_matrix() @ camera[:3]
    assert look_at_one_point(shaken)
    assert neighbour_degrees(shaken) is not None


def test_a_single_camera_sways_and_does_not_fly_round() -> None:
    path = orbit(ring(1), 16)
    assert (path[:, 2, :3] @ ring(1)[0, 2, :3]).min() > np.cos(np.radians(6.0))


@given(st.integers(2, 6), st.integers(1, 4))
def test_interpolation_passes_through_every_given_camera(n: int, between: int) -> None:
    viewmats = ring(n=12)[:n]
    path = interpolate(viewmats, (n - 1) * between + 1)
    np.testing.assert_allclose(path[::between], viewmats, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "cameras", "frames", "told"),
    [
        ("spiral", 12, 5, "orbit, ellipse, interpolate"),
        ("orbit", 12, 0, "n_frames is 0"),
        ("interpolate", 1, 5, "at le"),
    ],
)
def test_bad_path_requests_name_the_field_and_the_choices(name: str, cameras: int, frames: int, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        camera_path(name, ring()[:cameras], frames)


def test_a_video_holds_the_frames_that_were_added(tmp_path: Path) -> None:
    path = tmp_path / "clip.webm"
    with VideoFile(path, fps=10) as film_of_grays:
        for shade in (0, 120, 240):
            film_of_grays.add(np.full((49, 64, 3), shade, np.uint8))  # an odd height loses its last row
    reader = cv2.VideoCapture(str(path))
    for shade in (0, 120, 240):
        frame = reader.read()[1]
        assert frame.shape == (48, 64, 3)
        assert abs(int(frame.mean()) - shade) < 8
    assert os.listdir(tmp_path) == ["clip.webm"]


def film(path: Path, *sizes: tuple[int, int], fps: float = 30.0) -> None:
    with VideoFile(path, fps) as clip:
        for i, (width, height) in enumerate(sizes):
            clip.add(np.random.default_rng(i).integers(0, 256, (height, width, 3), dtype=np.uint8))


@pytest.mark.parametrize("name", ["clip.webm", "clip.AVI"])
@pytest.mark.parametrize("fps", [0.5, 29.97, 600.0])
def test_every_kind_of_video_plays_to_its_last_frame(tmp_path: Path, name: str, fps: float) -> None:
    film(tmp_path / "new" / name, *[(32, 16)] * 5, fps=fps)
    assert frames_in(tmp_path / "new" / name) == 5
    assert os.listdir(tmp_path / "new") == [name]


@pytest.mark.parametrize(
    ("sizes", "told"),
    [
        ([(16, 16), (8, 16)], "frame 1 is 8 x 16 px, the first was 16 x 16 px; a video has one size: use views of one"),
        ([(1, 16)], "frames are 1 x 16 px; a video needs 2 x 2 or more"),
        ([], "no frame was added; a video needs one or more"),
    ],
    ids=["two sizes", "no size", "no frame"],
)
def test_a_video_that_fails_leaves_the_old_file(tmp_path: Path, sizes: list[tuple[int, int]], told: str) -> None:
    path = tmp_path / "clip.webm"
    path.write_bytes(b"old")
    assert_one_line(lambda: film(path, *sizes), f"{path}: {told}")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["clip.webm"]


@pytest.mark.parametrize("fps", [0.0, -1.0, 0.4, 601.0, float("nan"), float("inf")])
def test_a_rate_that_no_video_can_have_is_refused_at_once(tmp_path: Path, fps: float) -> None:
    assert_one_line(lambda: VideoFile(tmp_path / "clip.webm", fps), f"fps is {fps}", "from 0.5 to 600, such as 30")


def test_what_cannot_become_a_video_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "clip.webm").mkdir()
    assert_one_line(lambda: VideoFile(tmp_path / "clip.webm"), "clip.webm: a folder of this name is in the way")
    assert_one_line(lambda: VideoFile(tmp_path / "clip.gif"), ".mp4")
    # an MP4 would hold what players do not expect
    monkeypatch.setattr(paths, "has_h264", lambda: False)
    words = ("cannot write H.264", "name it clip.webm", "ffmpeg -i clip.webm clip.mp4")
    assert_one_line(lambda: VideoFile(tmp_path / "clip.mp4"), "clip.mp4", *words)
    assert os.listdir(tmp_path) == ["clip.webm"]
    if Path("/proc/self").is_dir():
        # nobody can write there
        told = "/proc/self/clip.webm: could not be written: "
        assert_one_line(lambda: film(Path("/proc/self/clip.webm"), (16, 16)), told, "choose another path")


_LIMITED = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from pop_fast.view.paths import VideoFile
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
with VideoFile(Path(sys.argv[1])) as video:
    for i in range(12):
        video.add(np.random.default_rng(i).integers(0, 256, (64, 64, 3), dtype=np.uint8))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX resource limits")
@pytest.mark.parametrize(("name", "room"), [("clip.webm", 0), ("clip.webm", 4096), ("clip.avi", 4096)])
def test_a_video_without_room_on_the_disk_leaves_the_old_file(tmp_path: Path, name: str, room: int) -> None:
    path = tmp_path / name
    path.write_bytes(b"old")
    done = in_a_child(_LIMITED, path, room)
    assert done.status == 1
    last = done.err.strip().splitlines()[-1]
    assert last.startswith(f"pop_fast.errors.PopError: {path}: ")
    assert "of 12 frames could be read back after writing; the disk may be full: free some space" in last
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == [name]


def test_a_video_holds_what_its_ending_promises(tmp_path: Path) -> None:
    names = {"clip.webm": ("VP90", "vp09"), "clip.avi": ("MJPG",), "clip.mp4": ("avc1", "h264")}
    for name, codecs in list(names.items())[: 3 if has_h264() else 2]:
        film(tmp_path / name, (64, 64), (64, 64))
        code = int(cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FOURCC))
        assert code.to_bytes(4, "little").decode() in codecs
