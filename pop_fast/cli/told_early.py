"""What `pop train` refuses or tells before the long work begins."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pop_fast.errors import PopError
from pop_fast.train.choose import on_gpu

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.data.load import Source
    from pop_fast.train.config import TrainConfig
    from pop_fast.train.ranks import Ranks

# px of a photograph from which a step takes seconds on a CPU, and the side that other trainers shrink such ones to
_LARGE: Final = 3_000_000
_USUAL_SIDE: Final = 1600


def check_early(config: TrainConfig, source: Source, images: str | None, ranks: Ranks | None) -> None:
    """Refuse what would end a run after its photographs were read, before their cameras are searched for.

    Args:
        config: the settings.
        source: where cameras come from, as `load_capture` takes it.
        images: the folder of the capture with the photographs, likewise.
        ranks: the processes that train together.

    Raises:
        PopError: names the option, and the photograph or file.
    """
    for name, files in (("--lpips-vgg", config.lpips_vgg), ("--lpips-alex", config.lpips_alex)):
        for file in files:
            if not Path(file).is_file():
                raise PopError(f"{file}: there is no such file of LPIPS weights; give {name} another, or leave it out")
    if ranks is not None or config.batch_size > 1:
        from pop_fast.train.batch_stepper import check_batch
        from pop_fast.train.ranks import ALONE

        check_batch(config, True, ranks or ALONE)
    if not Path(config.data).is_dir() or config.factor == 1:
        return
    from pop_fast.data.load import check_factor, find_listing

    # what a model lists is refused as its first photograph is read
    if source == "photos" or find_listing(Path(config.data), source, images) is None:
        check_factor(Path(config.data), config.factor)


def about_large(capture: Capture, config: TrainConfig) -> str | None:
    """Say what photographs of full size cost on a CPU, before the first step; None where they are not that large."""
    pixels = sum(view.width * view.height for view in capture.views) / len(capture.views)
    if on_gpu(config) or pixels < _LARGE:
        return None
    view = max(capture.views, key=lambda view: view.width * view.height)
    shrink = math.ceil(max(view.width, view.height) / _USUAL_SIDE)
    return (
        f"the photographs are up to {view.width}x{view.height} px, and every step draws one: seconds a step on a CPU "
        f"(the time left is told after the first ones); --factor {config.factor * shrink} takes about "
        f"1/{shrink**2} of the time, at {round(view.width / shrink)}x{round(view.height / shrink)} px"
    )
