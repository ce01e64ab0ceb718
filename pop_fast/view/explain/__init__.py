"""Why a pixel looks as it does: what it is blended from, what the loss and POP do to it, where two renderers differ."""

from __future__ import annotations

from pop_fast.view.explain.pixel import PixelExplanation, Row, explain_pixel
from pop_fast.view.explain.scene import ExplainedView, explain_view

__all__ = ["ExplainedView", "PixelExplanation", "Row", "explain_pixel", "explain_view"]
