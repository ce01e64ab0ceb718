"""How cameras are found; what may be said of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from pop_fast.errors import CaptureError

__all__ = ["SfmOptions"]

MATCHERS: Final = ("auto", "exhaustive", "sequential")


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """How cameras are found.

    Attributes:
        max_size: longest side at which features are looked for, px; cameras are always in full size.
        camera_model: COLMAP's name of the lens model.
        single_camera: all photographs share one camera; by default when they are all of one size.
        matcher: "exhaustive" matches all photographs with all, "sequential" each with its neighbours by name; "auto"
            matches up to 60 exhaustively.
        seed: of every random choice.
    """

    max_size: int = 1600
    camera_model: str = "SIMPLE_RADIAL"
    single_camera: bool | None = None
    matcher: Literal["auto", "exhaustive", "sequential"] = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_size < 64:
            raise CaptureError(f"max_size is {self.max_size}; it must be at least 64 px, or there are no features")
        if self.matcher not in MATCHERS:
            raise CaptureError(f"matcher is {self.matcher!r}; use one of {', '.join(MATCHERS)}")
        if not 0 <= self.seed < 2**31:
            raise CaptureError(f"seed is {self.seed}; it must be a whole number from 0 to {2**31 - 1}")
