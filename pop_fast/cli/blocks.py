"""`pop blocks`: one part of a run in blocks, as its workflow does them."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import tyro

from pop_fast.cli import EXIT_INCOMPLETE, EXIT_INTERRUPTED, parse
from pop_fast.cli.train_blocks import merged_lines, plan_lines, round_lines
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_file
from pop_fast.io.heartbeat import bars
from pop_fast.train.choose import choose_backend
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import RECORD, CaptureRecord, read_record, record_text
from pop_fast.train.results import read_config

if TYPE_CHECKING:
    from pop_fast.blocks.jobs import Part
    from pop_fast.blocks.plan import Job

_EXAMPLES: Final = """
    pop blocks train out/city 0_1            train one block, or resume it
    pop blocks merge out/city --round 0      merge the trained blocks for the next round
    pop blocks train out/city 0_1 --round 1  train the Gaussians of the block's core; all others stay fixed
    pop blocks merge out/city                the last merge: measures the result and writes its report
    pop blocks partition out/city            divide the capture again with the settings of the run
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Do one part of a run that `pop train --blocks` has begun: what its Snakemake workflow calls, for a scheduler of
    your own.

    Attributes:
        part: divide the capture, train a block, or merge all.
        result: the result folder.
        block: which block to train, as 0_1.
        round: of which round: 0 trains each block by itself, those after begin with the merged blocks of the round
            before. (default: train in round 0, merge the last one)
    """

    part: Annotated[Literal["partition", "train", "merge"], tyro.conf.Positional]
    result: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
    block: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="BLOCK")] = None
    round: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "blocks", examples=_EXAMPLES)
    from pop_fast.blocks.plan import read_job

    folder = args.result.absolute()
    job = read_job(folder)
    if job is None:
        raise PopError(f"{args.result}: is not a run in blocks; start one with pop train DATA --blocks 2x2 --out DIR")
    config, record = read_config(folder), read_record(folder) or CaptureRecord()
    if args.part != "train" and args.block is not None:
        raise PopError(f"pop blocks {args.part} applies to all blocks; leave {args.block} out")
    if args.part == "partition":
        if args.round is not None:
            raise PopError("pop blocks partition applies to all rounds; leave --round out")
        return _partition(folder, config, record, job)
    part = _part(args, job)
    if part.block is None:
        return _merge(folder, config, record, job, part)
    from pop_fast.blocks.jobs import own_gpu

    with own_gpu(folder, config.backend):
        if part.round:
            return _train_round(folder, config, record, job, part)
        return _train(folder, config, job, part.block, argv)


def _part(args: Args, job: Job) -> Part:
    """Find which part of the run is asked for; a PopError says that it has no such block or round."""
    from pop_fast.blocks.jobs import parts_of

    known = list(dict.fromkeys([*job.trained_first, *job.names]))
    if args.part == "train" and args.block not in known:
        raise PopError(f"{args.result}: has no block {args.block}; its blocks are {', '.join(known)}")
    number = (0 if args.part == "train" else job.rounds) if args.round is None else args.round
    found = [part for part in parts_of(job) if (part.round, part.block) == (number, args.block)]
    if not found and 0 <= number <= job.rounds:
        others = ", ".join(part.block for part in parts_of(job) if part.round == number and part.block is not None)
        raise PopError(
            f"{args.result}: round {number} trains {others} and not {args.block}; name one of these, or another --round"
        )
    if not found:
        raise PopError(
            f"{args.result}: has no round {number}, but rounds 0 to {job.rounds}; for more of them start pop train "
            "with --blocks-rounds and --resume"
        )
    return found[0]


def _partition(folder: Path, config: TrainConfig, record: CaptureRecord, job: Job) -> int:
    from pop_fast.blocks.run import divide_capture

    with bars(config.progress) as progress:
        division = divide_capture(config, record, job, progress=progress)
    division.write(folder)
    print("\n".join(plan_lines(folder)))
    return 0


def _train(folder: Path, config: TrainConfig, job: Job, block: str, argv: Sequence[str]) -> int:
    from pop_fast.blocks.jobs import marker_of
    from pop_fast.blocks.plan import COARSE, read_plan
    from pop_fast.blocks.run import coarse_config, config_of
    from pop_fast.cli.train import check_backend, train_capture

    if read_plan(folder) is None:
        raise PopError(f"{folder}: its capture is not divided yet; run pop blocks partition {folder}")
    own = coarse_config(folder, config, job.coarse) if block == COARSE else config_of(folder, config, block)
    options = _options(folder, own)
    own, chosen = choose_backend(own, options.resume)
    check_backend(own)
    status = train_capture(own, options, chosen, ["blocks", *argv])
    if status in (0, EXIT_INCOMPLETE):
        # what is incomplete then is the block's report, and it has been said
        write_file(marker_of(folder, block), b"")
        return 0
    return status


def _options(folder: Path, own: TrainConfig) -> Any:
    """Return the options of `pop train` that a block's training is done with.

    They are those of a user's own training of the block's folder, without what the merged result has instead.
    """
    from pop_fast.cli.train import arguments
    from pop_fast.cli.train_options import as_begun, check_output

    record, place = read_record(folder), Path(own.result_dir)
    again = ["--resume"] if (place / "cfg.json").is_file() else []
    _, options = arguments([own.data, "--out", own.result_dir, "--skip-sizes", "--skip-checks", *again])
    if record is not None:
        options = replace(options, images=record.images, ignore_masks=not record.masks)
    check_output(place, options)
    return as_begun(place, options)


def _train_round(folder: Path, config: TrainConfig, record: CaptureRecord, job: Job, part: Part) -> int:
    """Train what a block has in its core, in a round from 1, among what its views see of the other cores."""
    from pop_fast.blocks.jobs import marker_of
    from pop_fast.blocks.rounds import check_merged, read_core, read_start, write_counts, write_round_block
    from pop_fast.blocks.run import round_config
    from pop_fast.cli import printable
    from pop_fast.cli.train import check_backend, open_capture, summary
    from pop_fast.cli.train_options import record_of, resumption, stopped

    assert part.block is not None
    begun, names = time.perf_counter(), check_merged(folder, part.round)
    centers = read_core(folder, part.block, part.round)["means"].numpy()
    write_round_block(folder, config, record, names, part.block, part.round, centers)
    own = round_config(folder, config, part, job)
    options, place = _options(folder, own), Path(own.result_dir)
    own, chosen = choose_backend(own, options.resume)
    check_backend(own)
    capture = open_capture(own, options)
    start = read_start(folder, part.block, part.round, own, capture.views)
    write_counts(folder, part.block, part.round, start)
    views, seen = len(capture.train_views()), len(start.params["means"]) - start.own
    print(printable(f"{part.block}, round {part.round}: {views} views, {own.max_steps:,} steps -> {place}"))
    print(
        f"{start.own:,} Gaussians are trained; {seen:,} of the {start.merged - start.own:,} others show and are fixed"
    )
    if start.own > 0:
        from pop_fast.blocks.rounds import prepare

        print(chosen)
        beside = {RECORD: record_text(record_of(capture, options))}
        loading = time.perf_counter() - begun
        training = prepare(own, capture, start, resume=options.resume, loading_seconds=loading, beside=beside)
        if options.resume:
            print(resumption(place))
        try:
            print(summary(training.run()), flush=True)
        except KeyboardInterrupt:
            print(f"pop: {stopped(place, training.step)}", file=sys.stderr)
            return EXIT_INTERRUPTED
    write_file(marker_of(folder, part.block, part.round), b"")
    return 0


def _merge(folder: Path, config: TrainConfig, record: CaptureRecord, job: Job, part: Part) -> int:
    from pop_fast.blocks.run import merge_capture
    from pop_fast.cli.export import FinishOptions
    from pop_fast.cli.train import finish_and_report, summary

    try:
        options = replace(FinishOptions(**job.finish), skip_checks=True)
    except TypeError as error:
        raise PopError(f"{folder}/blocks/job.json: finish is not what 'pop train' writes ({error})") from error
    with bars(config.progress) as progress:
        capture, stats = merge_capture(folder, config, record, part, progress)
    if not part.last:
        for line in round_lines([stats]):
            print(line, flush=True)
        write_file(part.marker(folder), b"")
        return 0
    for line in merged_lines(stats):
        print(line)
    print(summary(stats), flush=True)
    status = finish_and_report(folder, capture, options, config.progress)
    if status == 0:
        write_file(part.marker(folder), b"")
        print(f"pop report {quote(str(folder))} --check adds the parts that need all photographs", flush=True)
    return status
