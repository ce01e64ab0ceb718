"""The words of `pop train`: what they name, and what is refused or reported before the long work begins."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import tyro

from pop_fast.errors import PopError
from pop_fast.io.heartbeat import Heartbeat
from pop_fast.io.image_header import read_exif, read_size
from pop_fast.train import automatic
from pop_fast.train.choose import is_launched, on_gpu
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureRecord, cameras_of, read_record
from pop_fast.train.presets import ALIASES, METHODS, PRESETS
from pop_fast.train.results import ResultFolder

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.data.capture import Source
    from pop_fast.train.ranks import Ranks


@dataclass(frozen=True, kw_only=True)
class BlocksOptions:
    """How a capture is divided.

    Attributes:
        blocks: divide the ground of a capture that is larger than memory, as 2x2, into strips and parts of them; each
            block is trained by itself, and the blocks are merged.
        blocks_margin: what a block is trained on beyond its core, as a share of the core's size.
        blocks_share: a view from elsewhere trains a block whose core holds at least this share of the points in its
            picture.
        blocks_rounds: how often the merged blocks are trained on: each round trains what a block has in its core among
            all others as they are, and merges again. With --resume a finished run takes further rounds. (default: 2)
        blocks_round_steps: steps of a block in a round. (default: a tenth of --max-steps)
        blocks_coarse: begin from a coarse model of the whole, whose photographs are shrunk by this, as 2, instead of
            training each block by itself; 0 does not.
        blocks_jobs: how many blocks are trained at a time on the CPU of this machine; GPUs train one each. More than
            one needs Snakemake.
        blocks_profile: hand the blocks to a cluster by this Snakemake profile: slurm, or a folder of yours.
    """

    blocks: str | None = None
    blocks_margin: float = 0.2
    blocks_share: float = 0.25
    blocks_rounds: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
    blocks_round_steps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
    blocks_coarse: int = 0
    blocks_jobs: int = 1
    blocks_profile: str | None = None


# what decides the defaults of all other settings
PLAN: Final = ("method", "preset", "steps_scaler", "scale_lambda_pop")


# words of other trainers' command lines: Inria's, gsplat's
_ALIASES: Final = {
    **dict.fromkeys(("-s", "--source-path", "--data-dir", "--data"), "DATA"),
    **dict.fromkeys(("-m", "--model-path", "--result-dir", "-o"), "--out"),
    "--data-factor": "--factor",
    "--iterations": "--max-steps",
}
_SMALLER: Final = (
    "--factor 2 (4, 8) trains on photographs shrunk by that factor; --sfm.max-size only limits their size in the "
    "search for cameras"
)
# of which the nearest option by its letters is another thing
_ELSEWHERE: Final = dict.fromkeys(("--max-size", "--resolution", "-r", "--downscale", "--downscale-factor"), _SMALLER)
_IGNORED: Final = frozenset({"--eval"})  # Inria: hold out every 8th view; here the default (--test-every 0 holds none)


def rename_aliases(argv: Sequence[str]) -> list[str]:
    """Turn options of Inria's and gsplat's trainers into ours: `-s DIR` into `DIR`, `-m DIR` into `--out DIR`, ..."""
    words: list[str] = []
    rest = list(argv)
    while rest:
        word = rest.pop(0)
        if not word.startswith("-"):
            # a path may hold "="
            words.append(word)
            continue
        word = word.replace("--adc.", "--gsplat.", 1) if word.startswith("--adc.") else word
        name, equals, value = word.partition("=")
        name = name.replace("_", "-") if name.startswith("--") else name
        if name in _ELSEWHERE:
            raise PopError(f"{name} is not an option of pop train; {_ELSEWHERE[name]}")
        target = _ALIASES.get(name)
        if name in _IGNORED:
            continue
        if target == "DATA":
            words += [value] if equals else []
        else:
            words += [target or name, value] if equals else [target or word]
    return words


def plan_of(words: Sequence[str]) -> dict[str, Any]:
    """Find what decides the defaults; a value that cannot be is left out, for the parser of all words to refuse."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("method", "preset", "steps-scaler"):
        parser.add_argument(f"--{name}", nargs="?")
    parser.add_argument("--scale-lambda-pop", action="store_true")
    found = parser.parse_known_args([_dashed(word) for word in words if word != "--"])[0]
    plan: dict[str, Any] = {"scale_lambda_pop": found.scale_lambda_pop}
    plan |= {"method": found.method} if found.method in (*METHODS, *ALIASES) else {}
    plan |= {"preset": found.preset} if found.preset in PRESETS else {}
    with contextlib.suppress(TypeError, ValueError):
        plan["steps_scaler"] = float(found.steps_scaler)
    return plan


def overrides(args: Any, base: TrainConfig, words: Sequence[str]) -> dict[str, Any]:
    """Return the settings that the words name, also where what they say is the default, for `TrainConfig.of`."""
    named = {_dashed(word).partition("=")[0].removeprefix("--") for word in words if word.startswith("--")}
    found: dict[str, Any] = {}
    for name, value, default in _settings(args, base):
        group, dot, last = {"result_dir": "out"}.get(name, name).replace("_", "-").rpartition(".")
        if value != default or named & {f"{group}{dot}{last}", f"{group}{dot}no-{last}"}:
            found[name] = value
    return found


def _settings(args: Any, base: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
    """Give every setting's dotted name, its value and its default."""
    for field in dataclasses.fields(TrainConfig):
        if field.name == "given":
            continue
        value, default = getattr(args, field.name), getattr(base, field.name)
        group = base.method if field.name == "strategy" else field.name
        if not dataclasses.is_dataclass(value):
            yield group, value, default
            continue
        for inner in dataclasses.fields(value):
            yield f"{group}.{inner.name}", getattr(value, inner.name), getattr(default, inner.name)


def _dashed(word: str) -> str:
    """Spell an option's name with dashes, as tyro takes both spellings."""
    name, equals, value = word.partition("=")
    return (name.replace("_", "-") if name.startswith("--") else name) + equals + value


# px of a photograph from which a step takes seconds on a CPU, and the side that other trainers shrink such ones to
_LARGE: Final = 3_000_000
_USUAL_SIDE: Final = 1600


def check_early(config: TrainConfig, source: Source, images: str | None, ranks: Ranks | None) -> None:
    """Refuse what would end a run after its photographs were read, before their cameras are searched for."""
    for name, files in (("--lpips-vgg", config.lpips_vgg), ("--lpips-alex", config.lpips_alex)):
        for file in files:
            if not Path(file).is_file():
                raise PopError(f"{file}: there is no such file of LPIPS weights; give {name} another, or leave it out")
    if config.antialiased:
        from pop_fast.train.preflight import check_method

        check_method(config)
    if ranks is not None or config.batch_size > 1:
        from pop_fast.train.ranks import ALONE
        from pop_fast.train.torch_stepper import check_batch

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
        f"the photographs are up to {view.width}x{view.height} px, so a step takes seconds on a CPU "
        f"(the time left is shown after the first steps); --factor {config.factor * shrink} takes about "
        f"1/{shrink**2} of the time, at {round(view.width / shrink)}x{round(view.height / shrink)} px"
    )


def notes_before(capture: Capture, config: TrainConfig) -> Iterator[str]:
    """Say before the first step what large photographs, few of them and a long schedule cost."""
    for note in (about_large(capture, config), automatic.about_held_out(capture, config)):
        if note is not None:
            yield note
    if takes_hours(config):
        yield f"{config.max_steps:,} steps take hours on a CPU; --preset quick takes 1,500"


def takes_hours(config: TrainConfig) -> bool:
    """Tell whether a CPU is given the paper's schedule by default: neither a preset nor steps were given."""
    given = config.given
    said = given is None or given.steps_scaler is not None or "max_steps" in given.settings
    return not said and config.preset == "paper" and not on_gpu(config)


def check_output(folder: Path, options: Any) -> None:
    """Refuse an output folder that cannot be written to before the minutes of loading, not after."""
    if options.resume and options.overwrite:
        raise PopError("--resume and --overwrite exclude each other; choose one")
    if ResultFolder(folder).check(options.resume, options.overwrite):
        print(f"note: {folder}: an --overwrite was cut short; the results that it had set aside are back")


def as_begun(folder: Path, options: Any) -> Any:
    """Read the capture of a run that is resumed as it was read before, where the command does not say."""
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


def record_of(capture: Capture, options: Any, chosen: Sequence[str] = ()) -> CaptureRecord:
    """Return what capture.json says of a capture that was read by these options, and of what the run chose."""
    return CaptureRecord(
        images=options.images,
        missing=options.missing,
        masks=not options.ignore_masks,
        source=options.source,
        world_transform=capture.world_transform.tolist(),
        chosen=list(chosen),
        cameras=cameras_of(capture),
    )


def resumption(folder: Path) -> str:
    """Say what a resumed run begins from."""
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


# what says how long the schedule is
_SCHEDULE: Final = ("--preset", "--steps-scaler", "--max-steps")


def chooses_for_itself(words: Sequence[str]) -> bool:
    """Tell whether a command line leaves size and schedule to `pop_fast.train.automatic`.

    Blocks and processes that train together take the paper's schedule, as before.
    """
    said = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    return not set(said) & {*_SCHEDULE, "--blocks"} and not is_launched()


def with_size(config: TrainConfig, options: Any) -> TrainConfig:
    """Choose the factor of a run that chooses for itself, by the headers of its photographs, where none was said.

    A resumed run keeps its own, and its schedule.
    """
    given = config.given
    if given is None:
        return config
    before = automatic.begun(Path(config.result_dir)) if options.resume else None
    if before is not None:
        return automatic.with_choice(config, before["scaler"], before["terms"])
    if "factor" in given.settings:
        return config
    minutes = automatic.MINUTES if options.minutes is None else options.minutes
    sizes = [size for path in photographs_of(config, options) if (size := read_size(path)) is not None]
    factor = automatic.factor_for(sizes, on_gpu(config), minutes)
    return automatic.with_choice(config, None, {"factor": factor})


def photographs_of(config: TrainConfig, options: Any) -> list[Path]:
    """List the photographs that a run will read, at their full size."""
    from pop_fast.data.load import find_listing
    from pop_fast.data.read_images import find_photographs
    from pop_fast.data.sfm import photo_folder, photographs

    root = Path(config.data)
    listing = find_listing(root, options.source, options.images)
    if listing is None:
        return photographs(photo_folder(root))
    return [path for path in find_photographs(root, listing.shots, options.images) if path is not None]


def with_length(config: TrainConfig, capture: Capture, options: Any) -> tuple[TrainConfig, tuple[str, ...]]:
    """Choose terms and schedule of a run that chooses for itself, by the photographs and the speed of this machine.

    With lines that say what is to come, and why; none where the run is resumed as it was begun.
    """
    from pop_fast.data.photo_quality import exposure_stops

    given = config.given
    if given is None or given.steps_scaler is not None:
        return config, ()
    stops = exposure_stops([read_exif(path) for path in photographs_of(config, options)])
    terms = automatic.choose_terms(capture, config, stops)
    config = automatic.with_choice(config, None, {"factor": config.factor, **terms.settings})
    minutes = automatic.MINUTES if options.minutes is None else options.minutes
    with Heartbeat(config.progress) as beat:
        beat.say("timing a few steps of this capture on this machine")
        speed = automatic.measure_speed(config, capture)
    held_out = len(capture.test_views(config.test_every))
    choice = automatic.choose_length(
        config, speed, minutes, automatic.mean_pixels(capture), len(capture.views), held_out
    )
    largest = max(capture.views, key=lambda view: view.width * view.height)
    config = automatic.with_choice(config, choice.scaler, {"factor": config.factor, **terms.settings})
    why = terms.why if choice.why is None else (choice.why, *terms.why)
    return config, (automatic.line_of(choice, config, (largest.width, largest.height)), *why)
