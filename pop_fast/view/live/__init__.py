"""A splat in the browser, drawn by the package's own renderers: from a state to a picture, and the server around it."""

from pop_fast.view.live.draw import MODES, Box, Drawing, KeyCamera, Mode, RecordedPath, SplatScene, ViewState, read_path

__all__ = ["MODES", "Box", "Drawing", "KeyCamera", "Mode", "RecordedPath", "SplatScene", "ViewState", "read_path"]
