"""What `pop train` refuses or reports before the long work begins: settings, output folder, the run in it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pop_fast.errors import PopError
from pop_fast.train.choose import on_gpu

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.data.load import Source
    from pop_fast.train.config import TrainConfig
    from pop_fast.train.load_result import CaptureRecord
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


def check_output(folder: Path, options: Any) -> None:
    """Refuse an output folder that cannot be written to before the minutes of loading, not after.

    Raises:
        PopError: as `ResultFolder.check`, or both --resume and --overwrite were given.
    """
    if options.resume and options.overwrite:
        raise PopError("--resume and --overwrite exclude each other; choose one")
    from pop_fast.train.results import ResultFolder

    if ResultFolder(folder).check(options.resume, options.overwrite):
        print(f"note: {folder}: an --overwrite was cut short; the results that it had set aside are back")


def as_begun(folder: Path, options: Any) -> Any:
    """Read the capture of a run that is gone on with as it was read before, where the command does not say.

    Args:
        folder: the result folder.
        options: those of `pop train`; without `resume` it is returned as it is.

    Raises:
        PopError: capture.json is damaged.
    """
    from pop_fast.train.load_result import read_record

    record = read_record(folder) if options.resume else None
    if record is None:
        return options
    return replace(
        options,
        images=options.images or record.images,
        missing=record.missing if options.missing == "error" else options.missing,
        ignore_masks=options.ignore_masks or not record.masks,
        source=record.source if options.source == "auto" else options.source,
    )


def record_of(capture: Capture, options: Any) -> CaptureRecord:
    """Return what capture.json says of a capture that was read as the options of `pop train` say."""
    from pop_fast.train.load_result import CaptureRecord

    return CaptureRecord(
        images=options.images,
        missing=options.missing,
        masks=not options.ignore_masks,
        source=options.source,
        world_transform=capture.world_transform.tolist(),
    )


def resumption(folder: Path) -> str:
    """Say what a run that is gone on with begins from."""
    from pop_fast.train.checkpoint import list_checkpoints

    found = list_checkpoints(folder)
    return f"continuing from step {found[-1][0] + 1:,}" if found else f"nothing to resume in {folder}: starting anew"


def stopped(folder: Path, step: int) -> str:
    """Say where a run stopped and from which checkpoint it continues; a second Ctrl-C leaves an earlier one."""
    from pop_fast.train.checkpoint import list_checkpoints

    if step == 0:
        return "stopped before the first step; nothing was written"
    kept = [number + 1 for number, _ in list_checkpoints(folder)]
    if not kept:
        return (
            f"stopped after step {step:,}, before a checkpoint was written; the same command with --resume starts anew"
        )
    if kept[-1] == step:
        return f"stopped after step {step:,}; the same command with --resume continues"
    return f"stopped after step {step:,}; the same command with --resume continues from step {kept[-1]:,}"
