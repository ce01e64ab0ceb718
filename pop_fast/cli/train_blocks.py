"""`pop train --blocks`: divide a capture, train its blocks, merge them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pop_fast.cli import EXIT_INTERRUPTED, printable
from pop_fast.cli.export import FinishOptions, table_lines
from pop_fast.cli.train_options import BlocksOptions
from pop_fast.errors import PopError
from pop_fast.io.atomic import FolderLock, write_file
from pop_fast.io.heartbeat import bars
from pop_fast.train.choose import is_launched
from pop_fast.train.config import TrainConfig, first_difference
from pop_fast.train.load_result import RECORD, CaptureRecord, record_text
from pop_fast.train.results import COMMANDS_FILE, ResultFolder, commands_text, read_config

if TYPE_CHECKING:
    from pop_fast.blocks.plan import Job
    from pop_fast.blocks.run import Division

# of what is written at the end, what looks at all training photographs, which the merge does not hold
_NEED_ALL = ("without_floaters", "final_prune", "max_gaussians", "target_mb")


def check_blocks(config: TrainConfig, options: Any) -> None:
    """Refuse what cannot be trained in blocks, by the option, the reason and what to do, before anything is loaded."""
    if options.blocks is None:
        _check_without(config, options)
        return
    from pop_fast.blocks.jobs import has_snakemake, profile_folder

    _job(config, options)
    if is_launched():
        raise PopError("--blocks starts its own processes, one for each block; start it without torchrun")
    if options.view:
        raise PopError(
            "--view shows one training, and --blocks trains several; leave it out, and see the result with pop view"
        )
    if config.exposure or config.refine_cameras:
        name = "--exposure" if config.exposure else "--refine-cameras"
        raise PopError(
            f"{name} would learn other values in every block that has a photograph, and so blocks would not "
            "fit together; leave it out with --blocks"
        )
    for name in _NEED_ALL:
        if getattr(options, name) not in (None, False):
            option = "--" + name.replace("_", "-")
            raise PopError(
                f"{option} needs all training photographs, which are not in memory when blocks are merged; leave it "
                f"out with --blocks, and give it to pop export {config.result_dir}"
            )
    if options.blocks_profile is not None:
        profile_folder(options.blocks_profile)
    if options.blocks_jobs < 1:
        raise PopError(f"--blocks-jobs is {options.blocks_jobs}; it must be 1 or more")
    if options.blocks_jobs > 1 and not has_snakemake():
        raise PopError(
            "--blocks-jobs over 1 needs Snakemake; install it with pip install 'pop-splatting[blocks]', or leave the "
            "option out to train the blocks one after another"
        )


def _check_without(config: TrainConfig, options: Any) -> None:
    for field in fields(BlocksOptions):
        if getattr(options, field.name) != field.default:
            option = "--" + field.name.replace("_", "-")
            raise PopError(f"{option} needs blocks; add --blocks 2x2")
    if options.resume:
        from pop_fast.blocks.plan import read_job

        begun = read_job(Path(config.result_dir))
        if begun is not None:
            raise PopError(f"{config.result_dir}: was begun in blocks; resume it with --blocks {begun.blocks}")


def _job(config: TrainConfig, options: Any) -> Job:
    """Gather what is asked for; what is not said of rounds is as a run that is resumed was begun."""
    from pop_fast.blocks.plan import DEFAULT_ROUNDS, ROUND_SHARE, Job, read_job

    begun = read_job(Path(config.result_dir)) if options.resume else None
    rounds, steps = options.blocks_rounds, options.blocks_round_steps
    if rounds is None:
        rounds = DEFAULT_ROUNDS if begun is None else begun.rounds
    if steps is not None and rounds == 0:
        raise PopError(f"--blocks-round-steps is {steps}, but there are no rounds; add --blocks-rounds 1")
    if steps is None:
        steps = (
            begun.round_steps if begun is not None and begun.rounds else max(round(config.max_steps * ROUND_SHARE), 1)
        )
    finishing = {field.name: getattr(options, field.name) for field in fields(FinishOptions)}
    dividing = {"blocks": options.blocks, "margin": options.blocks_margin, "share": options.blocks_share}
    dividing["coarse"] = options.blocks_coarse
    return Job(**dividing, rounds=rounds, round_steps=steps if rounds else 0, finish=finishing)


def train_in_blocks(config: TrainConfig, options: Any, chosen: str, argv: Sequence[str]) -> int:
    """Divide the capture where that is not done yet, do the parts of the run that are left, return the exit status."""
    from pop_fast.blocks.jobs import gpus_for, has_snakemake, marker_of, profile_folder, run_in_turn, run_workflow
    from pop_fast.blocks.plan import FOLDER, read_plan

    folder, job = Path(config.result_dir), _job(config, options)
    config = replace(config, data=str(Path(config.data).absolute()))
    begun = _begun(folder, config, job) if options.resume else None
    lock = FolderLock(folder / FOLDER)
    if begun is not None:
        lock.take()
        _extend(folder, begun, job)
        _take_threads(folder, config)
    if begun is None or read_plan(folder) is None:
        division = _divided(config, options, job)
        rounds = (
            f", then {job.rounds} round{'s' if job.rounds > 1 else ''} of {job.round_steps:,}" if job.rounds else ""
        )
        first = "from a coarse model" if job.coarse else f"{config.max_steps:,} steps each"
        print(printable(f"{config.method} in blocks {job.blocks}, {first}{rounds} -> {folder}"))
        print(chosen)
        if begun is None:
            _begin(folder, config, options, job, division, argv)
            lock.take()
        division.write(folder)
    try:
        for line in plan_lines(folder):
            print(line, flush=True)
        if marker_of(folder, None, None).is_file():
            print(f"all blocks of {folder} are trained and merged")
            return 0
        if options.blocks_profile is None and not has_snakemake():
            gpus = gpus_for(config.backend)
            if gpus > 1:
                print(f"note: blocks are trained one after the other, on 1 of {gpus} GPUs; with Snakemake one on each")
            status = run_in_turn(folder, job, options.quiet, lambda line: print(line, flush=True))
        else:
            profile = None if options.blocks_profile is None else profile_folder(options.blocks_profile)
            how = (options.blocks_jobs, config.threads, config.backend, profile, options.quiet)
            status = run_workflow(folder, job, *how)
    finally:
        lock.release()
    if status == EXIT_INTERRUPTED:
        print("pop: stopped; the same command with --resume continues", file=sys.stderr)
    return status


def _begun(folder: Path, config: TrainConfig, job: Job) -> Job | None:
    """Read what a run that is resumed was begun with, or None where nothing is there; it must not differ."""
    from pop_fast.blocks.plan import read_job
    from pop_fast.train.engines import engine_of

    before = read_job(folder)
    if before is None:
        if (folder / "cfg.json").is_file():
            raise PopError(f"{folder}: was begun without blocks; resume it without --blocks, or choose another folder")
        return None
    begun = read_config(folder)
    if config.near_plane is None and config.profile == begun.profile:
        # what the profile's comes to in the world of this capture was written down when the run began
        config = replace(config, near_plane=begun.near_plane)
    if not job.rounds and not engine_of(config).depends_on_threads:
        # between rounds torch sums what blocks have, which rounds otherwise with other threads
        begun = replace(begun, threads=config.threads)
    theirs = {**begun.binding(), **_dividing(before)}
    found = first_difference({**config.binding(), **_dividing(_no_longer(job, before))}, theirs)
    if found:
        name, ours, theirs = found
        raise PopError(
            f"{folder}: was begun with {name} = {theirs}, but this run has {name} = {ours}; use the same settings, or "
            "another result folder"
        )
    return before


def _no_longer(job: Job, before: Job) -> Job:
    """Return a job with the rounds of the one before it where it has more: rounds can be added to a run."""
    if job.rounds <= before.rounds:
        return job
    return replace(job, rounds=before.rounds, round_steps=job.round_steps if before.rounds else 0)


def _extend(folder: Path, before: Job, job: Job) -> None:
    """Let a run have more rounds than it was begun with; its merge is then the last one no more."""
    from pop_fast.blocks.jobs import marker_of
    from pop_fast.blocks.plan import JOB, job_text

    if job.rounds > before.rounds:
        marker_of(folder, None, None).unlink(missing_ok=True)
        more = replace(before, rounds=job.rounds, round_steps=job.round_steps)
        write_file(folder / JOB, job_text(more))


def _take_threads(folder: Path, config: TrainConfig) -> None:
    """Let the parts of a run that are not done yet have as many threads as are asked for now."""
    begun = read_config(folder)
    if begun.threads != config.threads:
        ResultFolder(folder).write_settings(replace(config, near_plane=begun.near_plane), {})


def _dividing(job: Job) -> dict[str, Any]:
    return {f"blocks.{name}": value for name, value in asdict(job).items() if name != "finish"}


def _divided(config: TrainConfig, options: Any, job: Job) -> Division:
    from pop_fast.blocks.run import divide_capture

    how = {"images": options.images, "missing": options.missing, "source": options.source}
    record = CaptureRecord(**how, masks=not options.ignore_masks)
    with bars(config.progress) as progress:
        division = divide_capture(config, record, job, options.sfm, progress)
    for note in division.capture.notes:
        print(f"note: {printable(note)}")
    print(printable(f"{division.capture.name}: {division.capture.source}"))
    return division


def _begin(folder: Path, config: TrainConfig, options: Any, job: Job, division: Division, argv: Sequence[str]) -> None:
    """Write what a run has from its start, in place of earlier results."""
    import numpy as np

    from pop_fast.blocks.plan import JOB, job_text
    from pop_fast.cli.train_options import record_of
    from pop_fast.train.results import ResultFolder

    record = record_text(record_of(division.capture, options))
    beside = {RECORD: record, COMMANDS_FILE: commands_text(None, ["pop", "train", *argv]), JOB: job_text(job)}
    first = np.full(len(division.capture.points), config.init_opacity)
    config = config.in_world(division.capture.world_scale)
    results = ResultFolder(folder)
    try:
        results.check(options.resume, options.overwrite)
        results.begin(config, beside, first, options.overwrite)
    finally:
        results.close()


def plan_lines(folder: Path) -> list[str]:
    """Lay out how a capture is divided, as a table."""
    from pop_fast.blocks.plan import FOLDER, read_plan

    plan = read_plan(folder)
    if plan is None:
        return []
    rows = [["block", "training views", "in its core", "held out", "points", "behind them"]]
    names = ("training_views", "in_its_core", "held_out_views", "points", "background_points")
    rows += [[entry["name"], *(f"{entry[name]:,}" for name in names)] for entry in plan[1]]
    return [*table_lines(rows), f"seen from above: {folder / FOLDER / 'map.png'}"]


def merged_lines(stats: dict[str, Any]) -> list[str]:
    """Lay out what every block came to, as a table."""
    rows = [["block", "Gaussians", "kept", "PSNR", "time", "memory"]]
    for block in stats["blocks"]:
        psnr = "-" if block["psnr"] is None else f"{block['psnr']:.2f} dB"
        memory = f"{block['memory_bytes'] / 1e9:.2f} GB"
        counts = (f"{block['num_GS']:,}", f"{block['kept']:,}")
        rows.append([block["name"], *counts, psnr, f"{block['seconds_total']:.0f} s", memory])
    return [*table_lines(rows), *round_lines(stats.get("rounds", ()))]


def round_lines(rounds: Sequence[dict[str, Any]]) -> list[str]:
    """Lay out what the merged blocks measured after every round, as a table; no lines where there are no rounds."""
    if not rounds:
        return []
    rows = [["merged after", "Gaussians", "PSNR", "SSIM", "time", "memory"]]
    for found in rounds:
        measured = ["-", "-"] if found["psnr"] is None else [f"{found['psnr']:.2f} dB", f"{found['ssim']:.4f}"]
        memory = f"{found['memory_bytes'] / 1e9:.2f} GB"
        name = f"round {found['round']}"
        rows.append([name, f"{found['num_GS']:,}", *measured, f"{found['seconds_total']:.0f} s", memory])
    return table_lines(rows)
