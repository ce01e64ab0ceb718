"""Small captures: COLMAP models by pycolmap, transforms.json, cameras as other programs export them; and splats."""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pop_fast.data import Capture, load_capture
from pop_fast.data.cameras import make_camera
from pop_fast.errors import PopError

WIDTH, HEIGHT = 40, 30
PINHOLE = (36.0, 35.0, 20.5, 14.25)
# OpenCV's axes of a camera in OpenGL's, ARKit's and RealityCapture's: y up, z backward
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def raw(root: Path, **options: Any) -> Capture:
    """Load in the capture's own frame."""
    return load_capture(root, normalize=False, **options)


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


def png_of_zeros(path: Path, side: int, depth: int = 1, kind: int = 0) -> Path:
    """Write a PNG of a few kilobytes that decodes to side x side pixels, gray (kind 0) or RGB (kind 2)."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    packer, row = zlib.compressobj(9), bytes(1 + side * depth * (1 + kind) // 8)
    pixels = b"".join([*(packer.compress(row) for _ in range(side)), packer.flush()])
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, depth, kind, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", pixels) + chunk(b"IEND", b""))
    return path


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
    xyz = generator.normal(0.0, 1.0, (count, 3)) * [0.6, 0.4, 0.1]
    return xyz, generator.integers(0, 256, (count, 3), dtype=np.uint8)


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
    model = make_model(names, viewmats, *about, **more)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder) if binary else model.write_text(folder)


def camera(model: str = "PINHOLE", params: Sequence[float] = PINHOLE, width: int = WIDTH, height: int = HEIGHT) -> Any:
    if model not in pycolmap.CameraModelId.__members__:
        return make_camera(0, model, width, height, list(params))
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
    return (np.linalg.inv(viewmat) @ FLIP).tolist()


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
    path = root / "transforms.json"
    listing = json.loads(path.read_text())
    edit(listing)
    path.write_text(json.dumps(listing))


# Cameras as other programs export them, by their published conventions.


def polycam(capture: Capture, source: Path, folder: Path, kind: str = "corrected_") -> Path:
    """Write `keyframes`: one JSON a photograph, and depth maps that are no photographs."""
    for images in (f"{kind}images", "depth"):
        shutil.copytree(source / "images", folder / "keyframes" / images)
    cameras = folder / "keyframes" / f"{kind}cameras"
    cameras.mkdir()
    for view in capture.views:
        pose = np.linalg.inv(view.viewmat) @ FLIP
        fields = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        fields |= {"fx": view.K[0, 0], "fy": view.K[1, 1], "cx": view.K[0, 2], "cy": view.K[1, 2]}
        fields |= {"width": view.width, "height": view.height, "blur_score": 90.0, "neighbors": [], "timestamp": 1}
        (cameras / f"{Path(view.name).stem}.json").write_text(json.dumps(fields))
    return folder


def metashape(capture: Capture, source: Path, folder: Path, lens: str = "", kind: str = "frame") -> Path:
    """Write cameras.xml: a chunk of another scale and orientation than the world's, one camera that is not aligned."""
    shutil.copytree(source / "images", folder / "images")
    R, t, s = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([4.0, -7.0, 2.0]), 2.5
    cameras = ['<group id="0" label="walk">']
    for i, view in enumerate(capture.views):
        pose = np.linalg.inv(view.viewmat)
        pose[:3, 3] = R.T @ (pose[:3, 3] - t) / s
        pose[:3, :3] = R.T @ pose[:3, :3]
        label = Path(view.name).stem if i % 2 else view.name
        matrix = " ".join(map(repr, pose.ravel().tolist()))
        one = f'<camera id="{i}" sensor_id="3" component_id="0" label="{label}">'
        cameras.append(f"{one}<transform>{matrix}</transform></camera>")
    cameras.append('</group><camera id="98" sensor_id="3" label="lost"></camera>')
    cameras.append('<camera id="99" sensor_id="3" label="off" enabled="false"><transform>no</transform></camera>')
    view = capture.views[0]
    resolution = f'<resolution width="{view.width}" height="{view.height}"/>'
    middle = (view.K[:2, 2] - [view.width / 2, view.height / 2]).tolist()
    f, b1 = float(view.K[1, 1]), float(view.K[0, 0] - view.K[1, 1])
    adjusted = f"<f>{f!r}</f><b1>{b1!r}</b1><cx>{middle[0]!r}</cx><cy>{middle[1]!r}</cy>{lens}"
    spaced = " ".join(map(repr, R.ravel().tolist()))
    (folder / "cameras.xml").write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="4"><sensor id="3" label="phone" type="{kind}">{resolution}
<calibration type="{kind}" class="initial">{resolution}<f>1</f></calibration>
<calibration type="{kind}" class="adjusted">{resolution}{adjusted}</calibration></sensor></sensors>
<components><component id="0" label="Component 1"><transform><rotation>{spaced}</rotation>
<translation>{t[0]} {t[1]} {t[2]}</translation><scale>{s}</scale></transform></component></components>
<cameras>{"".join(cameras)}</cameras></chunk></document>
"""
    )
    return folder


def realitycapture(capture: Capture, source: Path, folder: Path) -> Path:
    """Write cameras.csv next to the photographs."""
    shutil.copytree(source / "images", folder)
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for view in capture.views:
        pose = np.linalg.inv(view.viewmat) @ FLIP
        turned, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZXY", degrees=True).tolist()
        film = 36.0 / max(view.width, view.height)
        middle = (view.K[:2, 2] - [view.width / 2, view.height / 2]) * film
        focal = float(view.K[0, 0] * film)
        numbers = [*pose[:3, 3].tolist(), -turned, pitch, roll, focal, *middle.tolist(), *[0.0] * 6]
        lines.append(",".join([view.name, *map(repr, numbers)]))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")
    return folder


def many(n: int, bands: int = 15, seed: int = 0) -> dict[str, Tensor]:
    """Make raw parameters of many Gaussians, most of them near the origin."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=random)

    return {
        "means": 2.0 * normal(n, 3),
        "scales": normal(n, 3) - 4.0,
        "quats": normal(n, 4),
        "opacities": 3.0 * normal(n),
        "sh0": normal(n, 1, 3).clamp(-1.7, 1.7),
        "shN": (0.2 * normal(n, bands, 3)).clamp(-0.9, 0.9),
    }


def assert_one_line(call: Callable[[], object], *words: str) -> str:
    """Check that a call fails with one clear line that holds all of `words`, and return the line."""
    with pytest.raises(PopError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, f"{word!r} is not in: {message}"
    return message
