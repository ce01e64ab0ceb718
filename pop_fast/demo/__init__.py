"""The demo capture: a ray-traced still life, made without a download."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.demo.make import make_demo

__all__ = ["make_demo"]

# naming the demo needs no ray tracer
__getattr__ = given_by(__name__, {"make": ("make_demo",)})
