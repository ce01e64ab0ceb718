"""Captures: a COLMAP model, transforms.json, a folder of photographs, or the demo that the package makes itself."""

from __future__ import annotations

from pop_fast.data.capture import Capture, View
from pop_fast.data.initialize import initialize_params
from pop_fast.data.load import load_capture
from pop_fast.data.photos import run_sfm
from pop_fast.errors import CaptureError

__all__ = ["Capture", "CaptureError", "View", "initialize_params", "load_capture", "run_sfm"]
