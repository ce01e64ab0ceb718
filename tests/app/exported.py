"""Write a capture as other programs export it, by their published conventions."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pop_fast.data import Capture

# OpenCV's axes of a camera in ARKit's and RealityCapture's: y up, z backward
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def camera_to_world(viewmat: np.ndarray) -> np.ndarray:
    """Invert a rigid matrix. float64 [4, 4]"""
    return np.linalg.inv(viewmat)


def photographs(source: Path, folder: Path) -> None:
    """Copy a capture's photographs."""
    shutil.copytree(source / "images", folder)


def polycam(capture: Capture, source: Path, folder: Path, kind: str = "corrected_") -> Path:
    """Write `keyframes`: one JSON a photograph, and depth maps that are no photographs."""
    photographs(source, folder / "keyframes" / f"{kind}images")
    photographs(source, folder / "keyframes" / "depth")
    cameras = folder / "keyframes" / f"{kind}cameras"
    cameras.mkdir()
    for view in capture.views:
        pose = camera_to_world(view.viewmat) @ FLIP
        fields = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        fields |= {"fx": view.K[0, 0], "fy": view.K[1, 1], "cx": view.K[0, 2], "cy": view.K[1, 2]}
        fields |= {"width": view.width, "height": view.height, "blur_score": 90.0, "neighbors": [], "timestamp": 1}
        (cameras / f"{Path(view.name).stem}.json").write_text(json.dumps(fields))
    return folder


def metashape(capture: Capture, source: Path, folder: Path, lens: str = "", kind: str = "frame") -> Path:
    """Write cameras.xml: a chunk of another scale and orientation than the world's, one camera that is not aligned."""
    photographs(source, folder / "images")
    R, t, s = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([4.0, -7.0, 2.0]), 2.5
    cameras = ['<group id="0" label="walk">']
    for i, view in enumerate(capture.views):
        pose = camera_to_world(view.viewmat)
        pose[:3, 3] = R.T @ (pose[:3, 3] - t) / s
        pose[:3, :3] = R.T @ pose[:3, :3]
        label = Path(view.name).stem if i % 2 else view.name
        matrix = " ".join(map(repr, pose.ravel().tolist()))
        cameras.append(
            f'<camera id="{i}" sensor_id="3" component_id="0" label="{label}"><transform>{matrix}</transform></camera>'
        )
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
    """Write cameras.csv beside the photographs."""
    photographs(source, folder)
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for view in capture.views:
        pose = camera_to_world(view.viewmat) @ FLIP
        turned, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZXY", degrees=True).tolist()
        film = 36.0 / max(view.width, view.height)
        middle = (view.K[:2, 2] - [view.width / 2, view.height / 2]) * film
        numbers = [
            *pose[:3, 3].tolist(),
            -turned,
            pitch,
            roll,
            float(view.K[0, 0] * film),
            *middle.tolist(),
            *[0.0] * 6,
        ]
        lines.append(",".join([view.name, *map(repr, numbers)]))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")
    return folder
