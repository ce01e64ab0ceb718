"""Which of the intrinsics in transforms.json count: a frame's own before the file's, and all that is there."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from pop_fast.data import load_capture
from tests.app.captures import HEIGHT, PINHOLE, WIDTH, assert_one_line, edit_transforms, transforms_capture

ANGLE = 1.2
FOCAL = 0.5 * WIDTH / math.tan(0.5 * ANGLE)


def K_of(root: Path, index: int) -> list[float]:
    """Read fx, fy, cx, cy of a view."""
    K = load_capture(root, normalize=False).views[index].K
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]


@pytest.mark.parametrize(
    ("own", "want"),
    [
        ({"camera_angle_x": ANGLE}, [FOCAL, FOCAL]),
        ({"camera_angle_x": ANGLE, "fl_y": 50.0}, [FOCAL, 50.0]),
        ({"camera_angle_x": ANGLE, "fl_x": 50.0}, [50.0, 50.0]),
        ({"camera_angle_y": ANGLE}, [PINHOLE[0], 0.5 * HEIGHT / math.tan(0.5 * ANGLE)]),
    ],
)
def test_a_frames_own_field_of_view_counts_before_the_files_focal_length(
    tmp_path: Path, own: dict[str, Any], want: list[float]
) -> None:
    root = transforms_capture(tmp_path)
    edit_transforms(root, lambda listing: listing["frames"][1].update(own))
    assert K_of(root, 1) == pytest.approx([*want, *PINHOLE[2:]])
    assert K_of(root, 0) == pytest.approx(list(PINHOLE))


def test_a_principal_point_beside_a_field_of_view_counts_or_is_asked_to_be_complete(tmp_path: Path) -> None:
    fields = {"fl_x": None, "fl_y": None, "camera_angle_x": ANGLE}
    assert K_of(transforms_capture(tmp_path / "a", **fields), 0) == pytest.approx([FOCAL, FOCAL, *PINHOLE[2:]])
    root = transforms_capture(tmp_path / "b", **fields, w=None, h=None)
    assert_one_line(lambda: load_capture(root), "frames[0]", "w and h are absent", "measured in")


def test_null_counts_as_absent(tmp_path: Path) -> None:
    root = transforms_capture(tmp_path)
    edit_transforms(root, lambda listing: listing.update(val_filenames=None, ply_file_path=None))
    capture = load_capture(root, points=100)
    assert len(capture.views) == 4
    assert all(view.split is None for view in capture.views)


def test_the_mark_that_some_editors_put_before_a_file_does_no_harm(tmp_path: Path) -> None:
    path = transforms_capture(tmp_path) / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(load_capture(tmp_path, points=100).views) == 4
