"""`pop blocks`: one part of a run in blocks, as its workflow does them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import tyro

from pop_fast.cli import EXIT_INCOMPLETE
from pop_fast.cli.arguments import parse
from pop_fast.cli.train_blocks import merged_lines, plan_lines
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically

if TYPE_CHECKING:
    from pop_fast.blocks.plan import Job
    from pop_fast.train.config import TrainConfig
    from pop_fast.train.load_result import CaptureRecord

_EXAMPLES: Final = """
    pop blocks train out/city 0_1          train one block, or resume it
    pop blocks merge out/city              put the trained blocks together, and measure the whole
    pop blocks partition out/city          divide the capture again, as the run was begun
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Do one part of a run that `pop train --blocks` has begun: what its Snakemake workflow calls, for a scheduler of
    your own.

    Attributes:
        part: divide the capture, train a block, or merge all.
        result: the result folder.
        block: which block to train, as 0_1.
    """

    part: Annotated[Literal["partition", "train", "merge"], tyro.conf.Positional]
    result: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
    block: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="BLOCK")] = None


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "blocks", examples=_EXAMPLES)
    from pop_fast.blocks.plan import read_job
    from pop_fast.train.load_result import CaptureRecord, read_record
    from pop_fast.train.results import read_config

    folder = args.result.absolute()
    job = read_job(folder)
    if job is None:
        raise PopError(f"{args.result}: is no run in blocks; start one with pop train DATA --blocks 2x2 --out DIR")
    config, record = read_config(folder), read_record(folder) or CaptureRecord()
    if args.part == "train":
        if args.block not in job.names:
            raise PopError(f"{args.result}: has no block {args.block}; its blocks are {', '.join(job.names)}")
        return _train(folder, config, args.block, argv)
    if args.block is not None:
        raise PopError(f"pop blocks {args.part} is of all blocks; leave {args.block} out")
    if args.part == "partition":
        return _partition(folder, config, record, job)
    return _merge(folder, config, record, job)


def _partition(folder: Path, config: TrainConfig, record: CaptureRecord, job: Job) -> int:
    from pop_fast.blocks.run import divide_capture
    from pop_fast.cli.progress import bars

    with bars(config.progress) as progress:
        division = divide_capture(config, record, job, progress=progress)
    division.write(folder)
    for line in plan_lines(folder):
        print(line)
    return 0


def _train(folder: Path, config: TrainConfig, block: str, argv: Sequence[str]) -> int:
    from pop_fast.blocks.plan import read_plan
    from pop_fast.blocks.run import config_of, marker_of
    from pop_fast.cli.result_folder import as_begun, check_output
    from pop_fast.cli.train import arguments, check_backend, train_capture
    from pop_fast.train.choose import choose_backend
    from pop_fast.train.load_result import read_record

    if read_plan(folder) is None:
        raise PopError(f"{folder}: its capture is not divided yet; run pop blocks partition {folder}")
    record = read_record(folder)
    own = config_of(folder, config, block)
    # what a user's own training of the block's folder would be, without what the merged result has instead
    place = Path(own.result_dir)
    again = ["--resume"] if (place / "cfg.json").is_file() else []
    _, options = arguments([own.data, "--out", own.result_dir, "--skip-sizes", "--skip-checks", *again])
    if record is not None:
        options = replace(options, images=record.images, ignore_masks=not record.masks)
    check_output(place, options)
    options = as_begun(place, options)
    own, chosen = choose_backend(own, options.resume)
    check_backend(own)
    status = train_capture(own, options, chosen, ["blocks", *argv])
    if status in (0, EXIT_INCOMPLETE):
        # what is incomplete then is the block's report, and it has been said
        write_atomically(marker_of(folder, block), lambda file: file.write(b""))
        return 0
    return status


def _merge(folder: Path, config: TrainConfig, record: CaptureRecord, job: Job) -> int:
    from pop_fast.blocks.run import marker_of, merge_capture
    from pop_fast.cli.finish import FinishOptions, finish
    from pop_fast.cli.progress import bars
    from pop_fast.cli.train import report, summary

    try:
        options = replace(FinishOptions(**job.finish), skip_checks=True)
    except TypeError as error:
        raise PopError(f"{folder}/blocks/job.json: finish is not what 'pop train' writes ({error})") from error
    with bars(config.progress) as progress:
        capture, stats = merge_capture(folder, config, record, progress)
    for line in merged_lines(stats):
        print(line)
    print(summary(stats), flush=True)
    status = finish(folder, capture, options) or report(folder)
    if status == 0:
        write_atomically(marker_of(folder, None), lambda file: file.write(b""))
        print(f"pop report {folder} --check adds what looks at all photographs", file=sys.stderr)
    return status
