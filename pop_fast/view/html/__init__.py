"""A splat in one HTML file, which any browser with WebGL 2 opens."""

from pop_fast.view.html.cameras import PageCamera, cameras_of
from pop_fast.view.html.page import page_of

__all__ = ["PageCamera", "cameras_of", "page_of"]
