"""Camera paths and video files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pop_fast.data.capture import camera_centers, focus_point, look_at_one_point, neighbour_degrees
from pop_fast.errors import PopError
from pop_fast.view import paths
from pop_fast.view.paths import (
    PATHS,
    VideoFile,
    camera_path,
    frames_in,
    has_h264,
    interpolate,
    look_at,
    mean_up,
    orbit,
)
from tests.app.captures import assert_one_line

UP = np.array([0.0, 0.0, 1.0])


def ring(
    n: int = 12, radius: float = 3.0, height: float = 1.0, target: tuple[float, ...] = (0.5, -0.25, 0.0)
) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    centers = np.array(target) + np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(n, height)], axis=1)
    return look_at(centers, np.array(target), UP)


@pytest.mark.parametrize("name", PATHS)
def test_every_path_has_rigid_cameras_and_as_many_as_asked(name: str) -> None:
    path = camera_path(name, ring(), 17)
    assert path.shape == (17, 4, 4)
    np.testing.assert_allclose(
        path[:, :3, :3] @ path[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (17, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(path[:, :3, :3]), 1.0, atol=1e-12)
    np.testing.assert_array_equal(path[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (17, 1)))


def test_the_focus_of_a_ring_is_the_point_its_cameras_look_at() -> None:
    np.testing.assert_allclose(focus_point(ring()), [0.5, -0.25, 0.0], atol=1e-9)


def test_parallel_cameras_focus_ahead_of_themselves_instead_of_nowhere() -> None:
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 0, 3] = [-1.0, 0.0, 1.0]
    focus = focus_point(viewmats)
    assert focus[2] > 0.0
    assert np.all(np.isfinite(orbit(viewmats, 5)))


def test_an_orbit_keeps_distance_height_and_gaze() -> None:
    path = orbit(ring(radius=3.0, height=1.0), 8)
    offsets = camera_centers(path) - [0.5, -0.25, 0.0]
    np.testing.assert_allclose(np.hypot(offsets[:, 0], offsets[:, 1]), 3.0, atol=1e-9)
    np.testing.assert_allclose(offsets[:, 2], 1.0, atol=1e-9)
    gaze = np.einsum("mij,mj->mi", path[:, :3, :3], -offsets)
    np.testing.assert_allclose(gaze[:, :2], 0.0, atol=1e-9)
    assert np.all(gaze[:, 2] > 0.0)


@pytest.mark.parametrize("width", [20.0, 100.0, 190.0])
def test_an_orbit_of_a_capture_from_one_side_stays_on_that_side(width: float) -> None:
    turn = np.radians(np.linspace(-width / 2, width / 2, 9) + 170.0)  # over the seam of the angle too
    target = np.array([0.5, -0.25, 0.0])
    centers = target + np.stack([3.0 * np.cos(turn), 3.0 * np.sin(turn), np.zeros(9)], axis=1)
    path = orbit(look_at(centers, target, UP), 40)
    offsets = camera_centers(path) - target
    angles = np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])) % 360.0
    assert angles.min() == pytest.approx(170.0 - width / 2, abs=1e-6)
    assert angles.max() == pytest.approx(170.0 + width / 2, abs=1e-6)
    assert angles[0] == pytest.approx(170.0)
    steps = np.linalg.norm(np.diff(np.vstack([offsets, offsets[:1]]), axis=0), axis=1)
    assert steps.max() < 3.0 * np.radians(width) / 2 * 2.0 * np.pi / 40


def test_an_orbit_is_a_full_circle_where_cameras_stand_all_round() -> None:
    for n in (3, 4, 12):
        offsets = camera_centers(orbit(ring(n), 8)) - [0.5, -0.25, 0.0]
        angles = np.sort(np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])) % 360.0)
        np.testing.assert_allclose(np.diff(angles), 45.0)


def walk(n: int = 30, turn: float = 0.0) -> np.ndarray:
    """Cameras of a walk along y that looks ahead and, by `turn` degrees, to the sides. [n, 4, 4]"""
    along = np.linspace(0.0, 10.0, n)
    centers = np.stack([0.1 * np.sin(3.0 * along), along, 0.02 * np.cos(5.0 * along)], axis=1)
    side = np.radians(turn) * np.sin(along)
    return np.concatenate(
        [
            look_at(center[None], center + np.array([np.sin(angle), np.cos(angle), 0.0]), UP)
            for center, angle in zip(centers, side, strict=True)
        ]
    )


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


def test_cameras_that_spread_are_given_a_focus_ahead_of_them() -> None:
    outwards = look_at(camera_centers(ring())[:3], np.array([0.5, -0.25, 0.0]), UP)
    outwards[:, :3, :] *= np.array([-1.0, 1.0, -1.0])[:, None]  # half a turn about their own y axes
    focus = focus_point(outwards)
    ahead = np.einsum("mj,mj->m", focus - camera_centers(outwards), outwards[:, 2, :3])
    assert np.median(ahead) > 0.0


def test_up_stays_up_along_closed_paths() -> None:
    for name in ("orbit", "ellipse"):
        assert mean_up(camera_path(name, ring(), 9)) @ UP > 0.5


def test_a_closed_path_steps_evenly_round_to_its_start() -> None:
    for name in ("orbit", "ellipse"):
        centers = camera_centers(camera_path(name, ring(n=24), 40))
        steps = np.linalg.norm(np.diff(np.vstack([centers, centers[:1]]), axis=0), axis=1)
        assert steps.max() < 1.3 * steps.min()


@given(st.integers(2, 6), st.integers(1, 4))
def test_interpolation_passes_through_every_given_camera(n: int, between: int) -> None:
    viewmats = ring(n=12)[:n]
    path = interpolate(viewmats, (n - 1) * between + 1)
    np.testing.assert_allclose(path[::between], viewmats, atol=1e-9)


def test_bad_path_requests_name_the_field_and_the_choices() -> None:
    with pytest.raises(ValueError, match="orbit, ellipse, interpolate"):
        camera_path("spiral", ring(), 5)
    with pytest.raises(ValueError, match="n_frames is 0"):
        camera_path("orbit", ring(), 0)
    with pytest.raises(ValueError, match="at least 2"):
        camera_path("interpolate", ring()[:1], 5)


def test_a_video_holds_the_frames_that_were_added(tmp_path: Path) -> None:
    path = tmp_path / "clip.webm"
    with VideoFile(path, fps=10) as film_of_grays:
        for shade in (0, 120, 240):
            film_of_grays.add(np.full((49, 64, 3), shade, np.uint8))  # an odd height loses its last row
    reader = cv2.VideoCapture(str(path))
    frames = [reader.read()[1] for _ in range(3)]
    assert frames[0].shape == (48, 64, 3)
    assert [abs(int(frame.mean()) - shade) < 8 for frame, shade in zip(frames, (0, 120, 240), strict=True)] == [
        True
    ] * 3
    assert [p.name for p in tmp_path.iterdir()] == ["clip.webm"]


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
def test_a_video_that_fails_half_way_leaves_the_old_file(
    tmp_path: Path, sizes: list[tuple[int, int]], told: str
) -> None:
    path = tmp_path / "clip.webm"
    path.write_bytes(b"old")
    assert_one_line(lambda: film(path, *sizes), f"{path}: {told}")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["clip.webm"]


@pytest.mark.parametrize("fps", [0.0, -1.0, 0.4, 601.0, float("nan"), float("inf")])
def test_a_rate_that_no_video_can_have_is_refused_at_once(tmp_path: Path, fps: float) -> None:
    assert_one_line(lambda: VideoFile(tmp_path / "clip.webm", fps), f"fps is {fps}", "from 0.5 to 600, such as 30")


def test_a_folder_in_the_way_of_a_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "clip.webm").mkdir()
    assert_one_line(lambda: VideoFile(tmp_path / "clip.webm"), "clip.webm: a folder of this name is in the way")


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
def test_a_video_that_the_disk_has_no_room_for_is_told_and_leaves_the_old_file(
    tmp_path: Path, name: str, room: int
) -> None:
    path = tmp_path / name
    path.write_bytes(b"old")
    words = [sys.executable, "-c", _LIMITED, str(path), str(room)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"pop_fast.errors.PopError: {path}: ")
    assert "of 12 frames could be read back after writing; the disk may be full: free some space" in last
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == [name]


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_video_in_a_folder_that_may_not_be_written_is_named_as_the_user_named_it(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    path = tmp_path / "locked" / "clip.webm"
    assert_one_line(lambda: film(path, (16, 16)), f"{path}: could not be written: permission denied")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder where nobody can write")
def test_a_video_that_cannot_be_placed_is_named_as_the_user_named_it() -> None:
    path = Path("/proc/self/clip.webm")
    assert_one_line(lambda: film(path, (16, 16)), f"{path}: could not be written: ", "choose another path")


def test_an_unknown_video_ending_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(PopError, match=r"\.mp4"):
        VideoFile(tmp_path / "clip.gif")


def test_an_mp4_that_would_hold_what_players_do_not_expect_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paths, "has_h264", lambda: False)
    words = ("cannot write H.264", "name it clip.webm", "ffmpeg -i clip.webm clip.mp4")
    assert_one_line(lambda: VideoFile(tmp_path / "clip.mp4"), "clip.mp4", *words)
    assert not os.listdir(tmp_path)


def test_a_video_holds_what_its_ending_promises(tmp_path: Path) -> None:
    names = {"clip.webm": ("VP90", "vp09"), "clip.avi": ("MJPG",)} | (
        {"clip.mp4": ("avc1", "h264")} if has_h264() else {}
    )
    for name, codecs in names.items():
        film(tmp_path / name, (64, 64), (64, 64))
        code = int(cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FOURCC))
        assert code.to_bytes(4, "little").decode() in codecs
