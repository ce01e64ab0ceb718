"""The torch implementation for CPUs, and the program around it: captures in, compact splats out.

What most users need is given here by its name, and loaded when it is first used:

    from pop_fast import POPStrategy, TrainConfig, TrainingRun, load_capture, load_ply, rasterization
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pop_fast.errors import PopError
from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.api import rasterization
    from pop_fast.data import Capture, load_capture, run_sfm
    from pop_fast.density import POPStrategy
    from pop_fast.io.ply import load_ply, save_ply
    from pop_fast.train import TrainConfig, TrainingRun

    __version__: str

__all__ = [
    "Capture",
    "POPStrategy",
    "PopError",
    "TrainConfig",
    "TrainingRun",
    "__version__",
    "load_capture",
    "load_ply",
    "rasterization",
    "run_sfm",
    "save_ply",
]

_given = given_by(
    __name__,
    {
        "api": ("rasterization",),
        "data": ("Capture", "load_capture", "run_sfm"),
        "density": ("POPStrategy",),
        "io.ply": ("load_ply", "save_ply"),
        "train": ("TrainConfig", "TrainingRun"),
    },
)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("pop-splatting")
        except PackageNotFoundError:  # a copy of the sources that was never installed
            return "0+unknown"
    return _given(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
