"""What `pop train` asks of the folder that it writes to, and says of the run that is there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pop_fast.errors import PopError

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train.load_result import CaptureRecord


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
