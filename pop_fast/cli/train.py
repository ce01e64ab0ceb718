"""`pop train`: fit a splat to a capture or a folder of photographs."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, redirect_stdout
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar

import tyro

from pop_fast.api.backend import BACKENDS, require_backend
from pop_fast.cli import EXIT_INTERRUPTED, parse, printable
from pop_fast.cli.export import FinishOptions, after_results, finish
from pop_fast.cli.options import LimitOptions
from pop_fast.cli.train_blocks import check_blocks, train_in_blocks
from pop_fast.cli.train_options import (
    PLAN,
    BlocksOptions,
    as_begun,
    check_early,
    check_output,
    chooses_for_itself,
    notes_before,
    overrides,
    plan_of,
    record_of,
    rename_aliases,
    resumption,
    stopped,
    with_length,
    with_size,
)
from pop_fast.cli.view import LiveView, check_viewer
from pop_fast.data.capture import SfmOptions, Source
from pop_fast.errors import PopError
from pop_fast.io.formats import FORMATS
from pop_fast.io.heartbeat import bars, duration
from pop_fast.train.automatic import TERMS, begun, check_minutes
from pop_fast.train.choose import check_gpus, choose_backend, is_launched
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import RECORD, read_record, record_text
from pop_fast.train.presets import ALIASES, AUTOMATIC, LOSSES, METHODS, Given
from pop_fast.train.results import COMMANDS_FILE, commands_text
from pop_fast.train.steps import why_not_trained
from pop_ref.constants import PROFILES

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train.ranks import Ranks
    from pop_fast.train.training_run import TrainingRun

T = TypeVar("T")

_EXAMPLES: Final = """
    pop train photos                         chooses size and schedule; results in out/photos_pop
    pop train walk.mp4 --minutes 10          a video, or photos.zip; about ten minutes
    pop train scene --preset paper           POP as published: 30,000 steps, photographs as they are
    pop train scene --preset quick           1,500 steps at its own rates, for a first look
    pop train scene --method gsplat          the control: gsplat's default strategy, with opacity reset
    pop train scene --method 3dgs            Inria's constants, learning rates, SSIM and rasterizer
    pop train scene --method taming          or pup, mini-splatting, speedy-splat: the paper's other methods
    pop train scene --out out/a --resume     continue from the last checkpoint
    torchrun --nproc-per-node 4 --no-python pop train scene --batch-size 4   four processes, a view of each step each
    pop train scene --backend fast           on the CPU, even with a GPU
    pop train scene --export sog html        also as a small file and as a page, in out/scene_pop/export
    pop train scene --view                   watch it in the browser while it runs
    pop train city --blocks 3x2              in blocks of the ground, for a capture larger than memory
    pop train scene --pop.lambda-pop 0.01    any setting; --help-all lists them all
"""

# settings that --help shows; --help-all shows the rest
_SHOWN: Final = frozenset(
    {
        *("data", "result_dir", "max_steps", "seed", "backend", "profile"),
        *("factor", "test_every", "antialiased", "background", "lpips_vgg", "lpips_alex"),
        *("exposure", "random_background", "refine_cameras"),
    }
)
# settings that a run chooses for itself
_CHOSEN: Final = frozenset({"max_steps", "factor", *TERMS})
# settings that are names in a registry
_NAMED: Final[dict[str, Callable[[], Iterable[str]]]] = {
    "backend": lambda: ("auto", *BACKENDS),
    "profile": lambda: PROFILES,
    "photometric": lambda: LOSSES,
}
# whose options the help lists after all others, in this order; those of limits belong to exports too
_LATER: Final = (FinishOptions, LimitOptions, BlocksOptions)
_DOCUMENTED: Final = (BlocksOptions, FinishOptions, LimitOptions, Given, TrainConfig)
# what trains, and takes longest to import
_TRAINING: Final = ("pop_fast.train.training_run", "pop_fast.compiled.native_step")


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Run(BlocksOptions, FinishOptions):
    """Fit a splat to a capture or a folder of photographs.

    DATA is a folder with a COLMAP model (the largest in sparse), with transforms.json, with what Polycam, Metashape or
    RealityCapture export, or with photographs alone; or a video, or a ZIP archive of such a folder.

    Without --preset, --steps-scaler or --max-steps the run chooses for itself: photographs are shrunk by the whole
    number that brings their longest side nearest to 2,000 px on a GPU, to 1,100 px on a CPU (to 550 px with --minutes
    under 15), and the schedule is what --minutes allow on this machine. Other numbers of steps, as --help-all tells
    them, are then those of the whole schedule, and are scaled with it.

    Attributes:
        minutes: train as much of the schedule as fits in so many, measuring and the report among them, the search for
            cameras not; 120 where neither these nor a preset nor steps are given.
        resume: continue from the last checkpoint in the output folder, to the same bits as without the interruption;
            start where there is none.
        overwrite: replace the results in the output folder, once the first step has been taken.
        missing: what to do about photographs that are listed but absent.
        images: read the photographs from this folder of the capture.
        ignore_masks: do not use the capture's masks (where white means keep).
        source: where cameras come from; "auto" takes the first that is there.
        sfm: how the cameras of bare photographs are found.
        quiet: print nothing but warnings and errors; --no-progress leaves out the bars alone.
        view: show the training in the browser while it runs, as `pop view` does, to the same bits. Needs viser.
        view_host: the address that the viewer listens on; 0.0.0.0 shows it to other machines too; see `pop view`.
        view_port: its port; where it is taken, the next free one.
    """

    minutes: float | None = None
    resume: bool = False
    overwrite: bool = False
    missing: Literal["error", "skip"] = "error"
    images: str | None = None
    ignore_masks: bool = False
    source: Source = "auto"
    sfm: SfmOptions = dataclasses.field(default_factory=SfmOptions)
    quiet: bool = False
    view: bool = False
    view_host: str = "127.0.0.1"
    view_port: int = 8080


def run(argv: Sequence[str]) -> int:
    config, options, chooses = _asked(argv)
    folder = Path(config.result_dir)
    options.check()
    check_minutes(options.minutes, config, chooses)
    for name in options.export:
        if name in FORMATS:
            FORMATS.named(name)
    check_viewer(options)
    check_blocks(config, options)
    ranks = _ranks()
    with _stdout_closed() if options.quiet or not _writes(ranks) else nullcontext():
        if _writes(ranks):
            check_output(folder, options)
        options = as_begun(folder, options)
        config = _in_turn(ranks, _in_a_folder, config)
        config, chosen = choose_backend(config, options.resume)
        check_backend(config)
        idle = check_gpus(config, 1 if ranks is None else ranks.size)
        if idle is not None and options.blocks is None:
            chosen = f"{chosen}\nnote: {idle}"
        if chooses:
            config = with_size(config, options)
        check_early(config, options.source, options.images, ranks)
        if options.blocks is not None:
            return train_in_blocks(config, options, chosen, argv)
        status = train_capture(config, options, chosen, argv, ranks, chooses)
    if ranks is not None:
        ranks.leave()
    return status


def _asked(argv: Sequence[str]) -> tuple[TrainConfig, Any, bool]:
    """Read the words; where they say no schedule, the run chooses for itself, unless it was begun with one."""
    if not chooses_for_itself(rename_aliases(argv)):
        config, options = arguments(argv)
        said = {} if config.given is None else config.given.settings
        return config, options, config.preset == AUTOMATIC and "max_steps" not in said
    config, options = arguments(["--preset", AUTOMATIC, *argv])
    folder = Path(config.result_dir)
    if options.resume and (folder / "cfg.json").exists() and begun(folder) is None:
        if options.minutes is not None:
            fix = "leave --minutes out, and give the schedule as it was begun (--max-steps, --preset, --steps-scaler)"
            raise PopError(f"--minutes chooses the schedule, but the run in {folder} was begun with another; {fix}")
        return *arguments(argv), False
    return config, options, True


def _in_a_folder(config: TrainConfig) -> TrainConfig:
    """Take photographs out of a video, or out of an archive, where the capture is one."""
    if not Path(config.data).is_file():
        return config
    from pop_fast.data.unpack import capture_folder

    with bars(config.progress) as progress:
        folder, said = capture_folder(Path(config.data), progress)
    if said is not None:
        print(printable(said))
    return replace(config, data=str(folder))


def _ranks() -> Ranks | None:
    """Meet the processes that torchrun started with this one; without any this is None, and torch stays out."""
    if not is_launched():
        return None
    from pop_fast.train.ranks import join

    return join()


def _writes(ranks: Ranks | None) -> bool:
    return ranks is None or ranks.writes


@contextmanager
def _stdout_closed() -> Iterator[None]:
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere):
        yield


def train_capture(
    config: TrainConfig,
    options: Any,
    chosen: str,
    argv: Sequence[str],
    ranks: Ranks | None = None,
    chooses: bool = False,
) -> int:
    """Train on a capture, finish the result and report on it; return the exit status.

    Args:
        config: the settings.
        options: what `arguments` returns with them.
        chosen: a line on the backend.
        argv: the words after `pop train`, for commands.json.
        ranks: the processes that train together.
        chooses: choose the schedule by the speed of this machine.
    """

    folder, start = Path(config.result_dir), time.perf_counter()
    capture = _in_turn(ranks, open_capture, config if _writes(ranks) else replace(config, progress=False), options)
    searching = capture.sfm_seconds or 0.0
    loading = time.perf_counter() - start - searching
    from pop_fast.train.environment import keep_freed_memory
    from pop_fast.train.ranks import ALONE
    from pop_fast.train.training_run import TrainingRun

    keep_freed_memory()
    if capture.sfm_seconds is not None:
        print(f"cameras found in {duration(searching)}")
    for note in capture.notes:
        print(f"note: {printable(note)}")
    config, told = with_length(config, capture, options) if chooses else (config, ())
    plan = f"{config.method}, {config.max_steps:,} steps, seed {config.seed} -> {config.result_dir}"
    print(printable(f"{capture.name}: {capture.source}; {plan}"))
    print(chosen)
    for line in told:
        print(line, flush=True)
    for note in notes_before(capture, config):
        print(f"note: {note}")
    how = {"resume": options.resume, "overwrite": options.overwrite, "loading_seconds": loading}
    how["sfm_seconds"] = searching
    commands = commands_text(folder if options.resume else None, ["pop", "train", *argv])
    before = read_record(folder) if options.resume else None
    record = record_of(capture, options, told[1:] if before is None else before.chosen)
    beside = {RECORD: record_text(record), COMMANDS_FILE: commands}
    # absolute, so that the result can be looked at from another folder too
    absolute = replace(config, data=str(Path(config.data).absolute()))
    with ExitStack() as showing:
        watch = LiveView(capture, options, showing) if options.view and _writes(ranks) else None
        training = TrainingRun(absolute, capture, beside=beside, ranks=ranks or ALONE, watch=watch, **how)
        if options.resume:
            print(resumption(folder))
        if watch is not None:
            watch.start(training)
        return _trained(training, folder, capture, options, ranks)


def _trained(training: TrainingRun, folder: Path, capture: Capture, options: Any, ranks: Ranks | None) -> int:
    try:
        stats = training.run()
    except KeyboardInterrupt:
        if _writes(ranks):
            print(f"pop: {stopped(folder, training.step)}", file=sys.stderr)
        return EXIT_INTERRUPTED
    if not _writes(ranks):
        return 0
    print(summary(stats), flush=True)
    return finish_and_report(folder, capture, options, training.config.progress)


def finish_and_report(folder: Path, capture: Capture, options: Any, progress: bool) -> int:
    """Write what surrounds a run whose results are complete; a file that cannot be written costs no report."""
    status = finish(folder, capture, options, progress)
    return status if status == EXIT_INTERRUPTED else report(folder) or status


def report(folder: Path) -> int:
    """Write the report of a run whose results are complete; see `after_results`."""

    def write() -> None:
        from pop_fast.view.report import write_report

        print(printable(f"report: {write_report(folder)}"))

    left = f"the results in {folder} are complete; pop report {quote(str(folder))} writes the report"
    return after_results(write, "writing the report", "the report could not be written: ", left)


def arguments(argv: Sequence[str]) -> tuple[TrainConfig, Any]:
    """Read the words after `pop train` into settings of the run and of what surrounds it."""
    words = rename_aliases(argv)
    short_help = "--help" in words or "-h" in words
    words = ["--help" if word in ("--help-all", "--help_all") else word for word in words]
    # method, preset and scaler first: they decide the defaults of the rest, which --help shows
    plan = plan_of(words)
    base = TrainConfig.of(**plan, result_dir="")
    args = parse(_arguments_type(base, plan, short_help), words, "train", examples=_EXAMPLES)
    config = TrainConfig.of(**{name: getattr(args, name) for name in PLAN}, **overrides(args, base, words))
    if args.quiet:
        config = replace(config, progress=False)
    if not args.result_dir:
        place = Path(config.data).resolve()
        config = replace(config, result_dir=f"out/{place.stem if place.is_file() else place.name}_{config.method}")
    return config, args


def _arguments_type(base: TrainConfig, plan: dict[str, Any], short: bool) -> type:
    """Make the class that tyro reads: every setting of `TrainConfig`, or only those that the short help shows."""
    kinds = typing.get_type_hints(Given)
    kinds["method"] = Literal[(*METHODS, *ALIASES)]
    columns: list[Any] = [(name, kinds[name], plan.get(name, getattr(Given, name))) for name in PLAN]
    hints = typing.get_type_hints(TrainConfig)
    for field in dataclasses.fields(TrainConfig):
        if field.name == "given":
            continue
        kind: Any = hints[field.name]
        default: Any = dataclasses.field(default_factory=lambda name=field.name: getattr(base, name))
        if field.name in _NAMED:
            kind = Literal[tuple(_NAMED[field.name]())]
        if field.name in _CHOSEN and plan.get("preset") == AUTOMATIC:
            kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="(default: chosen)")]
        if field.name == "strategy":
            kind = Annotated[type(base.strategy), tyro.conf.arg(name=base.method)]
        if field.name == "data":
            kind, default = Annotated[kind, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")], dataclasses.field()
        elif field.name == "result_dir":
            note, value = "where the run writes", "(default: out/<data>_<method>)"
            kind = Annotated[kind, tyro.conf.arg(name="out", metavar="DIR", help=note, help_behavior_hint=value)]
            default = ""
        elif short and field.name not in _SHOWN:
            kind = Annotated[kind, tyro.conf.Suppress]
        columns.append((field.name, kind, default))
    # the settings first: in order of inheritance the help would open with the limits of an export
    surrounding = typing.get_type_hints(_Run, include_extras=True)
    own = {field.name: field for field in dataclasses.fields(_Run)}
    later = {field.name: place for place, kind in enumerate(_LATER) for field in dataclasses.fields(kind)}
    for name in sorted(own, key=lambda name: later.get(name, -1)):
        columns.append((name, surrounding[name], own[name]))
    documented = str(_Run.__doc__) + "".join((kind.__doc__ or "").partition("Attributes:")[2] for kind in _DOCUMENTED)
    methods = {"__doc__": documented, "check": _Run.check, "any": _Run.any}
    return dataclasses.make_dataclass("TrainArguments", columns, frozen=True, kw_only=True, namespace=methods)


def check_backend(config: TrainConfig) -> None:
    """Refuse a backend that cannot run here, or not with these settings, before the minutes of loading."""
    reason = why_not_trained(require_backend(config.backend), config)
    if reason is not None:
        raise PopError(reason)


def _in_turn(ranks: Ranks | None, read: Callable[..., T], *args: Any) -> T:
    """Read in the process that writes first: it may unpack photographs or find cameras, which the others find there."""
    if ranks is None:
        return read(*args)
    if not ranks.writes:
        ranks.wait()
        return read(*args)
    found = read(*args)
    ranks.wait()
    return found


def open_capture(config: TrainConfig, options: Any) -> Capture:
    """Load the capture that a config names, with progress, while what trains is imported.

    The cameras of bare photographs are found first.
    """
    from pop_fast.data.load import load_capture
    from pop_fast.lazy import background_import

    # a folder that is not there is said at once
    modules = _TRAINING if Path(config.data).is_dir() else ()
    with background_import(*modules), bars(config.progress) as progress:
        return load_capture(
            config.data,
            factor=config.factor,
            normalize=config.normalize,
            masks=not options.ignore_masks,
            missing=options.missing,
            background=config.background,
            progress=progress,
            source=options.source,
            images=options.images,
            resize=config.resize,
            sfm=options.sfm,
            seed=config.seed,
        )


def summary(stats: dict[str, Any]) -> str:
    """Say in one line how a run ended."""
    parts: list[str] = []
    if stats.get("psnr") is not None:
        parts.append(f"PSNR {stats['psnr']:.2f} dB")
        parts += [f"with colours fitted {stats['cc_psnr']:.2f} dB"] if "cc_psnr" in stats else []
        parts += [f"SSIM {stats['ssim']:.4f}"]
    if stats.get("lpips") is not None:
        parts.append(f"LPIPS {stats['lpips']:.4f} ({stats['lpips_net']})")
    parts.append(f"{stats['num_GS']:,} Gaussians ({stats['num_GS_above_floor']:,} with opacity >= 1/255)")
    loading = f", loading {stats['seconds_loading']:.0f} s" if "seconds_loading" in stats else ""
    loading += f", finding cameras {stats['seconds_sfm']:.0f} s" if "seconds_sfm" in stats else ""
    parts.append(f"{stats['seconds']:.0f} s on {stats.get('gpu', 'the CPU')}{loading}")
    return ", ".join(parts)
