"""The arguments that say which photographs and cameras `pop eval`, `render`, `export` and `explain` look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pop_fast.train.load_result import CaptureOptions, Splat, open_capture

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.data.load import Photographs
    from pop_fast.train.config import TrainConfig


@dataclass(frozen=True, kw_only=True)
class CaptureArguments(CaptureOptions):
    """Which photographs and cameras to use; what is not given is as in training."""

    capture: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """The capture; by default the one it was trained on."""


def open_with_bars(
    splat: Splat, options: CaptureOptions, photographs: Photographs = "all"
) -> tuple[Capture, TrainConfig]:
    """Load the capture that a splat shows under progress bars; see `pop_fast.train.load_result.open_capture`."""
    from pop_fast.cli.progress import bars

    with bars() as progress:
        return open_capture(splat, options, progress, photographs)
