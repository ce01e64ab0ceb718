"""Camera paths through a capture, and the video that is made along one."""

from __future__ import annotations

from pop_fast.view.paths.cameras import PATHS, camera_path, ellipse, interpolate, orbit
from pop_fast.view.paths.video import VideoFile

__all__ = ["PATHS", "VideoFile", "camera_path", "ellipse", "interpolate", "orbit"]
