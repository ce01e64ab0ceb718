"""What a run without a preset does: size, length and terms, by the photographs and the speed of this machine.

Size: photographs are shrunk by the whole number that brings their longest side nearest to `SIDES` px, in ratio.
Length: the paper's schedule, or as much of it as the minutes allow. The minutes are predicted by a model that is
measured where it is used: steps of the run's own engine, on the capture, with as many Gaussians as the run begins with,
and with as many as it is expected to have. Between these the time of a step is assumed to be linear in their number.

What is chosen goes into cfg.json with the run's settings, and is taken from there by a resumed run.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pop_fast.api.backend import get_backend
from pop_fast.errors import PopError
from pop_fast.io.heartbeat import duration
from pop_fast.train.choose import on_gpu
from pop_fast.train.config import TrainConfig
from pop_fast.train.presets import AUTOMATIC, QUICK_SCALER, Given
from pop_fast.train.steps import why_not_trained

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.data.capture import Capture

# an evening
MINUTES: Final = 120.0
# the longest side that photographs have, px, nearly: on a GPU, on a CPU, and there where less than this is allowed. A
# kitchen in 640 x 480 px, measured at that size, came out 0.2 dB better (0.4 dB with colours fitted) from 5,000 steps
# at that size than from 6,200 or 12,450 at 320 x 240, in the time of the 12,450
SIDES: Final = {"gpu": 2000, "cpu": 1100, "cpu, soon": 550}
SOON: Final = 15.0  # minutes
# of the paper's schedule; with fewer steps there is nothing to see, and more of them are another method
SHORTEST: Final = 0.01
# fewer of a step's kind do not tell how long it takes
_TIMED_STEPS: Final = 40
_TIMED_SECONDS: Final = 4.0
# Steps of a run are taken to stay as slow as those that were timed, before any training: short runs took 1.03 (fox),
# 0.97 (bear_512), 0.91 (bonsai) and 1.16 (garden) of that by processor time, a whole one 1.0 (bear_512), and one on fox
# that was followed for 15,400 of its 26,010 steps nearly as much.
# Those of a run with few steps, whose first photographs are coarse, take this share: whole runs of preset "quick" took
# 0.76 to 0.88 of what they would have if all their steps had taken what the last ones did
_COARSE: Final = 0.8
# a render of a view takes this share of a step
_RENDER: Final = 0.4
# renders that end a run: the turn about the subject, training views of the report, views of the table of sizes
_RENDERS: Final = 100
# s, for the page and the turn's film, and for a Gaussian in the formats of the table of sizes and in every render
_FILES: Final = 4.0
_WRITTEN: Final = 1.7e-4
# bytes of a Gaussian while it is trained: 59 numbers, their gradients, two moments of Adam, and what edits copy
_GAUSSIAN_BYTES: Final = 59 * 4 * 6
_PROGRAM_BYTES: Final = 450e6
# of a photograph's pixel: it, its tensor and what SSIM needs of it; fitted to fox, bear_512, bonsai and garden
_PIXEL_BYTES: Final = 42


@dataclass(frozen=True)
class Speed:
    """How fast this machine takes steps of a run."""

    # few, many: Gaussians that were trained
    few: int
    many: int
    # seconds_few, seconds_many: a step with so many took
    seconds_few: float
    seconds_many: float
    took: float = 0.0  # s, all of the measurement

    def seconds_a_step(self, gaussians: float) -> float:
        """Give the time of a step with so many Gaussians, never less than with the fewest."""
        slope = max(self.seconds_many - self.seconds_few, 0.0) / max(self.many - self.few, 1)
        return self.seconds_few + slope * max(gaussians - self.few, 0.0)


@dataclass(frozen=True)
class Choice:
    """What was chosen."""

    scaler: float  # of the paper's schedule
    gaussians: float  # expected at the end
    seconds: float  # expected of training and measuring
    memory_bytes: float  # expected of the process
    why: str | None = None  # what kept the schedule shorter than the minutes allow; None where that was nothing


def factor_for(sizes: Sequence[tuple[int, int]], gpu: bool, minutes: float) -> int:
    """Choose the whole number that photographs are shrunk by, of whose sizes, px, there may be none."""
    side = SIDES["gpu" if gpu else "cpu" if minutes >= SOON else "cpu, soon"]
    times = max([1.0, *(max(size) / side for size in sizes)])
    # f^2 + f = times^2 where the ratios to both neighbours are equal
    return math.ceil(math.sqrt(times * times + 0.25) - 0.5)


def expected_gaussians(method: str, first: int, pixels: float, photographs: int, scaler: float) -> tuple[float, float]:
    """Foretell how many Gaussians a run has at its end, and on average over its steps.

    With POP what grows follows the size of one photograph, without the prior that of all of them together.

    Args:
        pixels: of a photograph as it is trained on.
    """
    if method == "pop":
        grown = _POP_GROWS * pixels * scaler**_POP_POWER
    else:
        grown = _GRADIENT_GROWS * pixels * photographs * scaler**_GRADIENT_POWER
    return first + grown, first + _MEAN_SHARE * grown


# Fitted to POP on fox at scalers of 0.05 (8 to 25 photographs), 0.1 and 1, on bear_512, m360_garden_512 and
# m360_bonsai_800 at 0.05 and 0.1, and on 11 photographs of a castle at 0.52, each of which ended within 10 % of it; and
# to gsplat's default strategy and 3DGS on the same captures. Of those that are kept, of other methods and of later
# ones, docs/guide.md says how far off they were. Seven videos and rooms tried afterwards ended with 0.5 to 2.7 times as
# many, which neither detail nor points explain
_POP_GROWS: Final = 0.3
_POP_POWER: Final = 0.57
_GRADIENT_GROWS: Final = 0.034
_GRADIENT_POWER: Final = 0.35
_MEAN_SHARE: Final = 0.9


def choose_length(
    config: TrainConfig, speed: Speed, minutes: float, pixels: float, photographs: int, held_out: int
) -> Choice:
    """Choose as much of the paper's schedule as the minutes allow, and as few photographs bear.

    Args:
        minutes: that training, measuring and the report may take.
        photographs: there are, with those held out.
    """
    steps = TrainConfig.of(method=config.method).max_steps

    def expected(scaler: float) -> tuple[float, float]:
        return expected_gaussians(config.method, speed.few, pixels, photographs - held_out, scaler)

    def seconds(scaler: float) -> float:
        last, mean = expected(scaler)
        renders = _RENDER * speed.seconds_a_step(last) * (3 * held_out + _RENDERS)
        share = _COARSE if scaler <= QUICK_SCALER else 1.0
        written = _FILES + _WRITTEN * last
        return speed.took + share * steps * scaler * speed.seconds_a_step(mean) + renders + written

    trained = photographs - held_out
    longest = min(1.0, LOOKS * trained / (steps * config.batch_size)) if trained <= FEW else 1.0
    low, high = SHORTEST, max(longest, SHORTEST)
    if seconds(high) > 60.0 * minutes:
        for _ in range(40):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if seconds(middle) <= 60.0 * minutes else (low, middle)
        high = low
    scaler = float(f"{high:.3g}")
    gaussians = expected(scaler)[0]
    memory = _PROGRAM_BYTES + _GAUSSIAN_BYTES * gaussians + _PIXEL_BYTES * pixels * photographs
    why = None
    if scaler < 1.0 and scaler == float(f"{longest:.3g}"):
        why = f"each of {trained} photographs is seen {LOOKS} times: more steps would overfit so few photographs "
        why += "(--steps-scaler S takes more)"
    return Choice(scaler, gaussians, seconds(scaler), memory, why)


# how often each of few photographs is seen; section 8 of docs/guide.md has the runs on five captures that it rests on
LOOKS: Final = 200
# photographs to train on up to which POP holds depth to the sparse points, and the weight; measured on three captures,
# where the count told more than the angles did: benchmarks/results/few_photographs.json
DEPTH_LAMBDAS: Final = ((15, 0.1), (30, 0.01))
FEW: Final = DEPTH_LAMBDAS[-1][0]
# settings that `choose_terms` may choose
TERMS: Final = ("depth_lambda", "exposure")


@dataclass(frozen=True)
class Terms:
    """Terms of the loss that were chosen."""

    settings: Mapping[str, Any] = field(default_factory=dict)  # by name, those not given
    why: tuple[str, ...] = ()  # a sentence for each that was chosen, or that could not be


def choose_terms(capture: Capture, config: TrainConfig, stops: float | None) -> Terms:
    """Choose terms of the loss by the count and the spread of the photographs, and by the drift of their exposures.

    The drift is what the points that several photographs see tell, and what the cameras noted.

    Args:
        capture: with the points that its photographs see, where that is known.
        config: whose backend must know a term, and whose words win.
        stops: between the exposures that the cameras noted; None where they noted none.
    """
    import numpy as np

    from pop_fast.data.capture import neighbour_degrees
    from pop_fast.data.photo_quality import DRIFT_STOPS, UNEVEN, exposures_of

    trained = capture.train_views(config.test_every)
    apart = neighbour_degrees(np.stack([view.viewmat for view in trained])) if trained else None
    spread = "" if apart is None else f", neighbours {apart:.0f} degrees apart"
    wanted: list[tuple[str, Any, str]] = []
    why: list[str] = []
    weight = next((weight for most, weight in DEPTH_LAMBDAS if len(trained) <= most), None)
    if weight is not None and config.method == "pop":
        few = f"{len(trained)} photographs are few{spread}"
        if any(view.seen is not None and len(view.seen) for view in trained):
            text = f"depth is tied to the sparse points (--depth-lambda {weight:g}), because {few}"
            wanted.append(("depth_lambda", weight, text))
        elif "depth_lambda" not in _said(config):
            why.append(f"{few}, and depth is not tied to the sparse points: the capture has no tracks")
    found = exposures_of(capture).unevenness(np.stack([view.viewmat for view in capture.views]))
    drifts = []
    if found is not None and found > UNEVEN:
        drifts.append(f"by their common points they differ by {found:.2f} stops from those taken next to them")
    if stops is not None and stops > DRIFT_STOPS:
        drifts.append(f"their exposures are {stops:.1f} stops apart")
    if drifts and config.batch_size == 1:
        text = f"each photograph's exposure is learned (--exposure), because {' and '.join(drifts)}"
        wanted.append(("exposure", True, text))
    settings: dict[str, Any] = {}
    for name, value, text in wanted:
        if name in _said(config):
            continue
        reason = why_not_trained(get_backend(config.backend), replace(config, given=None, **{name: value}))
        if reason is None:
            settings[name] = value
        why.append(text if reason is None else f"{text.partition(',')[2].removeprefix(' because ')}: {reason}")
    return Terms(settings, tuple(why))


def _said(config: TrainConfig) -> Mapping[str, Any]:
    return {} if config.given is None else config.given.settings


def about_held_out(capture: Capture, config: TrainConfig) -> str | None:
    """Say what holding out costs where photographs are few and it was not requested, or that a request is void."""
    held_out, count = len(capture.test_views(config.test_every)), len(capture.views)
    asked = "test_every" in _said(config)
    if asked and capture.has_own_split:
        return (
            f"the capture's own lists hold out {held_out} of {count} photographs; --test-every {config.test_every} "
            "changes nothing, so edit these lists instead"
        )
    if capture.has_own_split or not held_out or count > FEW or asked:
        return None
    are = "is" if held_out == 1 else "are"
    return (
        f"{held_out} of {count} photographs {are} held out for measuring, {100 * held_out / count:.0f} % of what there "
        "is to learn from; --test-every 0 trains on all of them, and measures nothing"
    )


def with_choice(config: TrainConfig, scaler: float | None, terms: Mapping[str, Any]) -> TrainConfig:
    """Lay what was chosen under what the user said, which wins."""
    given = config.given
    assert given is not None
    said = {**terms, **given.settings}
    plan = {"scale_lambda_pop": given.scale_lambda_pop, "steps_scaler": scaler}
    chosen = TrainConfig.of(method=given.method, preset=given.preset, **plan, **said)
    # where it writes and which backend was found are not the user's choice
    return replace(
        chosen, data=config.data, result_dir=config.result_dir, backend=config.backend, progress=config.progress
    )


def begun(folder: Path) -> dict[str, Any] | None:
    """Read what a run in a folder was begun with, where it chose for itself: its scaler, its factor and its terms.

    Returns:
        None where there is no run, or one that had a preset; a damaged file is named by what reads all of it.
    """
    try:
        plain = json.loads((folder / "cfg.json").read_text(encoding="utf-8"))
        given, factor = plain["given"], plain["resolved"]["factor"]
        scaler = given["steps_scaler"]
        terms = {name: value for name, value in given["settings"].items() if name in TERMS}
        automatic = given["preset"] == AUTOMATIC
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    numbers = isinstance(factor, int) and isinstance(scaler, int | float) and not isinstance(scaler, bool)
    usable = numbers and all(isinstance(value, bool | int | float) for value in terms.values())
    return {"scaler": scaler, "terms": {"factor": factor, **terms}} if automatic and usable else None


def measure_speed(config: TrainConfig, capture: Capture) -> Speed:
    """Time steps of a run on this machine, which leave nothing behind.

    The many Gaussians are as many as the whole schedule has on average.

    Args:
        capture: loaded at the size that is trained on.

    Raises:
        PopError: as `TrainingRun`.
    """
    from pop_fast.data.gaussians import initialize_params
    from pop_fast.train.environment import reproducible

    start = time.perf_counter()
    first = initialize_params(capture, config.seed, config.init_opacity, config.init_scale)
    few, photographs = len(first["means"]), len(capture.train_views(config.test_every))
    many = round(expected_gaussians(config.method, few, mean_pixels(capture), photographs, 1.0)[1])
    with reproducible(config.threads):
        times = [_seconds_a_step(config, capture, params) for params in (first, _grown(first, max(many, 2 * few)))]
    return Speed(few, max(many, 2 * few), *times, took=time.perf_counter() - start)


def mean_pixels(capture: Capture) -> float:
    """Give the pixels of a photograph, on average."""
    return sum(view.width * view.height for view in capture.views) / len(capture.views)


def _grown(first: Mapping[str, Tensor], count: int) -> dict[str, Tensor]:
    """Make more Gaussians of the first, smaller by as much, each at its own place within its parent."""
    import torch

    generator = torch.Generator().manual_seed(0)
    n = len(first["means"])
    parents = torch.arange(count) % n
    grown = {name: tensor[parents].clone() for name, tensor in first.items()}
    sizes = torch.exp(grown["scales"])
    grown["means"] += sizes * torch.randn(count, 3, generator=generator, dtype=sizes.dtype)
    grown["scales"] -= math.log(count / n) / 2.0
    return grown


def _seconds_a_step(config: TrainConfig, capture: Capture, initial: Mapping[str, Tensor]) -> float:
    """Take steps with all colours, after a first one that loads what all need."""
    from pop_fast.train.schedule import segment_end
    from pop_fast.train.training_run import TrainingRun

    training = TrainingRun(replace(config, sh_interval=1, given=None), capture, initial=initial)
    training.take_steps(1)
    while training.step < config.sh_degree:
        training.take_steps(segment_end(training.config, training.strategy, training.step, 1))
    start, before = time.perf_counter(), training.step
    while True:
        longest = max(1, min(training.stepper.longest, before + _TIMED_STEPS - training.step))
        training.take_steps(segment_end(training.config, training.strategy, training.step, longest))
        steps, seconds = training.step - before, time.perf_counter() - start
        if steps >= _TIMED_STEPS or (seconds >= _TIMED_SECONDS and steps >= 3):
            return seconds / steps


def check_minutes(minutes: float | None, config: TrainConfig, automatic: bool) -> None:
    """Refuse, by PopError, minutes that cannot be or that contradict a schedule that was said."""
    if minutes is None:
        return
    if not 0.0 < minutes < math.inf:
        raise PopError(f"--minutes is {minutes}; it must be > 0 and finite")
    given = config.given or Given()
    said = {
        "--max-steps": "max_steps" in given.settings,
        "--steps-scaler": given.steps_scaler is not None,
        f"--preset {given.preset}": given.preset not in (Given.preset, AUTOMATIC),
        f"--preset {Given.preset}, --blocks or torchrun": not automatic,
    }
    for option, has_another in said.items():
        if has_another:
            raise PopError(f"--minutes chooses the schedule, but {option} has another; leave one of them out")


def line_of(choice: Choice, config: TrainConfig, size: tuple[int, int]) -> str:
    """Say before the first step what is to come."""
    where = "GPU" if on_gpu(config) else "CPU"
    shrunk = f" (photographs shrunk by {config.factor})" if config.factor > 1 else ""
    return (
        f"chosen for this {where}: {size[0]}x{size[1]} px{shrunk}, {config.max_steps:,} steps, about "
        f"{_rounded(choice.gaussians):,} Gaussians, {duration(choice.seconds)}, "
        f"{choice.memory_bytes / 1e9:.1f} GB of memory; --minutes M, --preset paper or --factor N choose otherwise"
    )


def _rounded(count: float) -> int:
    """Round to two digits, as no prediction is more exact."""
    digits = max(len(str(round(count))) - 2, 0)
    return round(count / 10**digits) * 10**digits
