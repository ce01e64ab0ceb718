"""Write small captures for tests: COLMAP models through pycolmap, transforms.json by hand."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from pop_fast.errors import PopError

WIDTH, HEIGHT = 40, 30
PINHOLE = (36.0, 35.0, 20.5, 14.25)


def photograph(seed: int, width: int = WIDTH, height: int = HEIGHT, channels: int = 3) -> np.ndarray:
    """Smooth random colours: uint8 [height, width, channels]."""
    coarse = np.random.default_rng(seed).integers(0, 256, (4, 5, channels)).astype(np.float32)
    return np.rint(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)).astype(np.uint8)


def write_photograph(path: Path, image: np.ndarray) -> None:
    """Write RGB, RGBA or gray under any extension that OpenCV knows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    code = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    stored = cv2.cvtColor(image, code[image.shape[2]]) if image.ndim == 3 else image
    assert cv2.imwrite(str(path), stored)


def look_at(center: Sequence[float] | np.ndarray, target: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> np.ndarray:
    """World -> camera at `center`, z up. float64 [4, 4]"""
    forward = np.subtract(target, center)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.asarray(center, np.float64)
    return viewmat


def ring(count: int) -> np.ndarray:
    """Cameras around the origin, 3 away and 1 up. float64 [count, 4, 4]"""
    angles = 2.0 * np.pi * np.arange(count) / count
    return np.stack([look_at((3.0 * np.cos(a), 3.0 * np.sin(a), 1.0)) for a in angles])


def cloud(count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Points around the origin, flat in z. float64 [count, 3], uint8 [count, 3]"""
    generator = np.random.default_rng(7)
    return generator.normal(0.0, 1.0, (count, 3)) * [0.6, 0.4, 0.1], generator.integers(
        0, 256, (count, 3), dtype=np.uint8
    )


def make_model(
    names: Sequence[str],
    viewmats: np.ndarray,
    cameras: Sequence[Any] | None = None,
    points: tuple[np.ndarray, np.ndarray] | None = None,
) -> Any:
    """Make a `pycolmap.Reconstruction`; one camera for all images, or one each."""
    cameras = list(cameras or [camera()])
    model = pycolmap.Reconstruction()
    for number, one in enumerate(cameras, start=1):
        one.camera_id = number
        model.add_camera_with_trivial_rig(one)
    for i, (name, viewmat) in enumerate(zip(names, viewmats, strict=True)):
        number = i + 1 if len(cameras) > 1 else 1
        image = pycolmap.Image(name=name, camera_id=number, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
    for xyz, rgb in zip(*(points or cloud()), strict=True):
        model.add_point3D(xyz, pycolmap.Track(), rgb)
    return model


def write_model(
    folder: Path, names: Sequence[str], viewmats: np.ndarray, *about: Any, binary: bool = True, **more: Any
) -> None:
    """Write the COLMAP model that `make_model` makes."""
    model = make_model(names, viewmats, *about, **more)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder) if binary else model.write_text(folder)


def camera(model: str = "PINHOLE", params: Sequence[float] = PINHOLE, width: int = WIDTH, height: int = HEIGHT) -> Any:
    return pycolmap.Camera(model=model, width=width, height=height, params=list(params))


def colmap_capture(root: Path, count: int = 4, names: Sequence[str] | None = None, **model: Any) -> Path:
    """Write `images/` and `sparse/0` with cameras on a ring."""
    names = names or [f"{i:02d}.png" for i in range(count)]
    for i, name in enumerate(names):
        write_photograph(root / "images" / name, photograph(i))
    write_model(root / "sparse" / "0", names, ring(len(names)), **model)
    return root


def opengl(viewmat: np.ndarray) -> list[list[float]]:
    """Camera-to-world matrix as transforms.json has it."""
    return (np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def transforms_capture(root: Path, count: int = 4, **fields: Any) -> Path:
    """Write `images/` and `transforms.json` with cameras on a ring; a field that is None is left out."""
    fx, fy, cx, cy = PINHOLE
    listing: dict[str, Any] = {"w": WIDTH, "h": HEIGHT, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    listing["frames"] = [
        {"file_path": f"images/{i:02d}.png", "transform_matrix": opengl(viewmat)}
        for i, viewmat in enumerate(ring(count))
    ]
    for i in range(count):
        write_photograph(root / "images" / f"{i:02d}.png", photograph(i))
    listing = {name: value for name, value in (listing | fields).items() if value is not None}
    (root / "transforms.json").write_text(json.dumps(listing))
    return root


def edit_transforms(root: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change transforms.json in place."""
    path = root / "transforms.json"
    listing = json.loads(path.read_text())
    edit(listing)
    path.write_text(json.dumps(listing))


def assert_one_line(call: Callable[[], object], *words: str) -> str:
    """Check that a call fails with one clear line that holds all of `words`, and return the line."""
    with pytest.raises(PopError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert re.search(re.escape(word), message), f"{word!r} is not in: {message}"
    return message
