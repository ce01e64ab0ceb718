"""Captures: a COLMAP model, transforms.json, or a folder of photographs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.errors import CaptureError
from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.data.capture import Capture, View
    from pop_fast.data.gaussians import apply_similarity, initialize_params, to_capture_frame
    from pop_fast.data.load import load_capture
    from pop_fast.data.sfm import run_sfm

__all__ = [
    "Capture",
    "CaptureError",
    "View",
    "apply_similarity",
    "initialize_params",
    "load_capture",
    "run_sfm",
    "to_capture_frame",
]

# a capture is read without torch, and while that is imported
__getattr__ = given_by(
    __name__,
    {
        "capture": ("Capture", "View"),
        "gaussians": ("apply_similarity", "initialize_params", "to_capture_frame"),
        "load": ("load_capture",),
        "sfm": ("run_sfm",),
    },
)
