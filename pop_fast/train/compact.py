"""A splat in so many bytes: harmonics, rounding and Gaussians are spent where that loses least, and the rest is tuned.

What a file may hold can be saved in three ways: by a lower degree of the colours, by a coarser encoding of them, where
the format has one, and by fewer Gaussians, those of the highest scores. How well each does is not known beforehand, and
what is left can make up for most of what is gone. So every way is taken, tuned for a few steps, written, read back and
measured on training views; the best is tuned to the end. Held-out views take no part in it.

Tuning is training by the run's own engine and objective, without density control, at rates that suit few steps. Nothing
is written, and the bits are the same for any number of threads wherever those of the steps are.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, Protocol

import torch
from torch import Tensor

from pop_fast.density import shrink
from pop_fast.density.passes import Passes
from pop_fast.stages.harmonics import lower_degree
from pop_fast.train.engines import renderer
from pop_fast.train.environment import reproducible
from pop_fast.train.evaluate import evaluate
from pop_fast.train.presets import QUICK_RATES
from pop_fast.train.schedule import refining, segment_end
from pop_fast.train.training_run import TrainingRun
from pop_fast.train.views import ViewTensors, evenly, render_view
from pop_ref.settings import LearningRates

if TYPE_CHECKING:
    from pop_fast.data.capture import Capture, View
    from pop_fast.train.config import TrainConfig

Params = Mapping[str, Tensor]
# what is measured on, and what colours of a lower degree are fitted to, at most; of more views, an even selection
_MEASURED: Final = 10
_FITTED: Final = 32
# Gaussians whose colours are fitted at a time
_ROWS: Final = 8192
# of the steps, what every way is tuned for before one is chosen
TRIAL: Final = 0.25
# what the rates of `LearningRates` are multiplied by; all but those of the opacities fall to a tenth. Coefficients
# that are few, and have to show what the others did, move faster than in a training
_RATES: Final = {**QUICK_RATES, "means": 1.2, "sh_rest": 60.0, "opacities": 0.3}
_DECAY: Final = 0.1
# files grow while they are tuned, as numbers become less round; one that has become so many times what it may be is cut
# down and tuned again before it is compared
_GROWN: Final = 1.1
# Gaussians that tell whether a lower degree makes a file smaller
_SAMPLE: Final = 2000
# s of steps, after which is told how long all of them will take
_SURE_AFTER: Final = 2.0


class Coding(Protocol):
    """How raw parameters become a file."""

    @property
    def levels(self) -> int:
        """Return how many levels of coarseness view dependence is written at."""
        ...

    def write(self, params: Params, level: int = 0) -> bytes:
        """Return the file's bytes."""
        ...

    def shown(self, params: Params, level: int = 0) -> dict[str, Tensor]:
        """Return the parameters that are read from the file, in the frame of those that are written."""
        ...


@dataclass(frozen=True)
class Compact:
    """A splat that fits."""

    params: dict[str, Tensor]  # raw parameters, in the training frame
    level: int = 0  # of coarseness that it is written at

    @property
    def degree(self) -> int:
        """Highest colour band."""
        return degree_of(self.params)


@dataclass(frozen=True)
class _Trial:
    """A way to fit, tuned for a few steps."""

    compact: Compact  # what came out
    scores: Tensor  # of its Gaussians. [N]
    psnr: float  # of what is read back, in training views


def degree_of(params: Params) -> int:
    """Return the highest colour band that raw parameters have."""
    return {0: 0, 3: 1, 8: 2, 15: 3}[params["shN"].shape[1]]


class Tuner:
    """Trains and measures a splat on the photographs that it was made of.

    Attributes:
        whole: raw parameters, up to the highest active colour band.
        held_out: views that nothing here trains on or chooses by.

    Args:
        learned: what the run has learned of its photographs, as a checkpoint holds it.
        steps: that what is kept is trained for; 0 trains nothing.
        report: is called with the steps taken so far, those planned, and the seconds that all of them will take, None
            before that is known.
    """

    def __init__(
        self,
        params: Params,
        sh_degree: int,
        config: TrainConfig,
        capture: Capture,
        learned: Mapping[str, Mapping[str, Tensor]],
        steps: int,
        report: Callable[[int, int, float | None], None],
    ) -> None:
        self.backend, _ = renderer(config.backend)
        # a splat that was trained where another backend is goes on by the one that draws it here
        self.config = replace(config, given=None, backend=self.backend.name, batch_size=1, checkpoint_every=0)
        self.whole = {name: value.detach().cpu() for name, value in params.items()}
        self.whole["shN"] = self.whole["shN"][:, : (sh_degree + 1) ** 2 - 1].contiguous()
        self.steps, self._capture, self._learned, self._report = steps, capture, learned, report
        self._taken, self._planned, self._timed, self._seconds = 0, 0, 0, 0.0
        views = [ViewTensors.of(view) for view in capture.train_views(config.test_every)]
        self._train = self._run(self.whole, 1).appearance.seen(views)
        self.held_out = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]

    def plan(self, steps: int) -> None:
        """Say how many steps are still to be taken."""
        self._planned = self._taken + steps

    def tuned(self, params: Params, steps: int) -> dict[str, Tensor]:
        """Return parameters after steps that leave nothing behind; PopError where a number is no longer finite."""
        if steps == 0 or len(params["means"]) == 0:
            return dict(params)
        with reproducible(self.config.threads):
            run = self._run(params, steps)
            while run.step < steps:
                began, before = time.perf_counter(), run.step
                run.take_steps(segment_end(run.config, run.strategy, run.step, run.stepper.longest))
                self._taken += run.step - before
                if before > 0:
                    # a first step also loads what all of them need
                    self._timed += run.step - before
                    self._seconds += time.perf_counter() - began
                known = self._seconds / self._timed * self._planned if self._seconds > _SURE_AFTER else None
                self._report(self._taken, self._planned, known)
        return {name: value.detach().cpu().clone() for name, value in run.params.items()}

    def _run(self, params: Params, steps: int) -> TrainingRun:
        base, degree = LearningRates(), degree_of(params)
        rates = {name: factor * getattr(base, name) for name, factor in _RATES.items()}
        config = refining(self.config, steps)
        run = TrainingRun(
            replace(
                config,
                sh_degree=degree,
                lr=replace(base, **rates, means_decay=_DECAY, others_decay=_DECAY),
                # without a prior on the opacities, which makes fewer Gaussians of those that are left
                strategy=replace(config.strategy, sh_start_iter=-degree * steps, pop_stop_iter=0),
            ),
            self._capture,
            initial=params,
        )
        if self._learned:
            run.appearance.load_state_dict(self._learned)
        return run

    def psnr(self, params: Params, views: Sequence[ViewTensors] = ()) -> float:
        """Measure parameters in views, some for training if none is named, dB.

        To a millionth, below which the order of sums decides; nothing shown is the worst.
        """
        if len(params["means"]) == 0:
            return -math.inf
        views = views or evenly(self._train, _MEASURED)
        return round(float(evaluate(self.backend, params, views, self.config, degree_of(params))["psnr"]), 6)

    def lowered(self, degree: int) -> dict[str, Tensor]:
        """Return the whole splat with colours of a lower degree, fitted to those that the training views show."""
        whole = self.whole
        if degree >= degree_of(whole) or len(whole["means"]) == 0:
            return whole
        weights, eyes = self._weights
        sh, means = torch.cat((whole["sh0"], whole["shN"]), 1).double(), whole["means"].double()
        parts = [
            lower_degree(sh[rows], means[rows] - eyes[:, None], weights[:, rows].double(), degree)
            for rows in torch.arange(len(sh)).split(_ROWS)
        ]
        fitted = torch.cat(parts).to(whole["sh0"])
        return {**whole, "sh0": fitted[:, :1].contiguous(), "shN": fitted[:, 1:].contiguous()}

    @cached_property
    def _weights(self) -> tuple[Tensor, Tensor]:
        """Blending weights of every Gaussian in some training views [C, N], and where their cameras stand [C, 3]."""
        views = evenly(self._train, _FITTED)
        device = torch.device(self.backend.device)
        passes = Passes.of(self.backend, views, self.config, device)
        placed = {name: value.to(device) for name, value in self.whole.items()}
        degree = degree_of(self.whole)
        sums = [passes.contributions(placed, index, degree).weight_sum.cpu().float() for index in range(len(views))]
        poses = [view.viewmat[0].double() for view in views]
        return torch.stack(sums), torch.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])


def with_pictures(capture: Capture, params: Params, config: TrainConfig, sh_degree: int) -> tuple[Capture, TrainConfig]:
    """Put pictures of a splat in the place of a capture's photographs, which show what it has lost.

    Returns:
        The capture, and settings that learn nothing of single photographs.
    """
    backend, _ = renderer(config.backend)

    def picture(view: View) -> View:
        image = 255.0 * render_view(backend, params, ViewTensors.of(view), config, sh_degree).image.clamp(0.0, 1.0)
        return replace(view, image=image.round().to(torch.uint8).numpy(), mask=None, alpha=None)

    with torch.no_grad():
        drawn = replace(capture, views=[picture(view) for view in capture.views])
    return drawn, replace(config, given=None, exposure=False, refine_cameras=False)


def tuned_to_the_end(tuner: Tuner) -> dict[str, Tensor]:
    """Return all Gaussians of a splat after its steps, or as they are where these make training views no better."""
    tuner.plan(tuner.steps)
    found = tuner.tuned(tuner.whole, tuner.steps)
    return found if tuner.psnr(found) > tuner.psnr(tuner.whole) else tuner.whole


def within(tuner: Tuner, score: Callable[[Params], Tensor], most: int, coding: Coding) -> Compact:
    """Fit a splat into so many bytes.

    Returns:
        What `coding.write` makes at most so many bytes of, no worse in training views than fewer Gaussians alone.

    Raises:
        PopError: a file without any Gaussian is larger.
    """
    whole, scores = tuner.whole, score(tuner.whole)
    plain = _cut(whole, scores, most, coding, 0)
    if len(plain["means"]) == len(whole["means"]):
        return Compact(plain)
    found = _ended(tuner, score, most, coding, _chosen(tuner, scores, most, coding))
    both = (found, Compact(plain))
    return max(both, key=lambda each: tuner.psnr(coding.shown(each.params, each.level)))


def _chosen(tuner: Tuner, scores: Tensor, most: int, coding: Coding) -> _Trial:
    """Try every degree at a level in the middle, and the best one at levels between there and either end."""
    steps, middle = round(TRIAL * tuner.steps), (coding.levels - 1) // 2
    others = sorted({middle // 2, (middle + coding.levels) // 2} - {middle}) if coding.levels > 1 else []
    degrees = _degrees(tuner, scores, coding)
    tuner.plan(steps * (len(degrees) + len(others)) + tuner.steps)
    best: _Trial | None = None
    for degree in degrees:
        trial = _tried(tuner, scores, most, coding, degree, middle if degree else 0, steps)
        best = trial if best is None or trial.psnr > best.psnr else best
        if len(trial.scores) == len(scores):
            # a still lower degree would save bytes that are not needed
            break
    assert best is not None
    degree = best.compact.degree
    tuner.plan(steps * len(others if degree else ()) + tuner.steps)
    for level in others if degree else ():
        trial = _tried(tuner, scores, most, coding, degree, level, steps)
        best = trial if trial.psnr > best.psnr else best
    return best


def _degrees(tuner: Tuner, scores: Tensor, coding: Coding) -> list[int]:
    """List the degrees that colours may have, falling; of those that make no file smaller the highest and the lowest.

    PLY has room for all bands always, and `.splat` for none.
    """
    most, kept = degree_of(tuner.whole), shrink.best(scores, _SAMPLE)
    some = {name: value[kept] for name, value in tuner.whole.items()}
    sizes = [len(coding.write({**some, "shN": some["shN"][:, : (d + 1) ** 2 - 1]})) for d in range(most + 1)]
    return [d for d in range(most, -1, -1) if d in (most, 0) or sizes[d] != sizes[d + 1]]


def _tried(tuner: Tuner, scores: Tensor, most: int, coding: Coding, degree: int, level: int, steps: int) -> _Trial:
    """Fit a splat in one way, tune it a little, and measure it as it is read back."""
    start = _cut(tuner.lowered(degree), scores, most, coding, level)
    kept, params = scores[shrink.best(scores, len(start["means"]))], tuner.tuned(start, steps)
    if len(coding.write(params, level)) > _GROWN * most:
        start = _cut(params, kept, most, coding, level)
        kept, params = kept[shrink.best(kept, len(start["means"]))], tuner.tuned(start, steps)
    return _Trial(Compact(params, level), kept, tuner.psnr(coding.shown(params, level)))


def _ended(tuner: Tuner, score: Callable[[Params], Tensor], most: int, coding: Coding, trial: _Trial) -> Compact:
    """Tune what was chosen to the end, and see to it that it fits."""
    params, level = trial.compact.params, trial.compact.level
    if tuner.steps > 0:
        params = tuner.tuned(_cut(params, trial.scores, most, coding, level), tuner.steps)
    levels = range(max(level - 1, 0), min(level + 2, coding.levels)) if degree_of(params) else (level,)
    for finer in levels:
        if len(coding.write(params, finer)) <= most:
            return Compact(params, finer)
    return Compact(_cut(params, score(params), most, coding, levels[-1]), levels[-1])


def _cut(params: Params, scores: Tensor, most: int, coding: Coding, level: int) -> dict[str, Tensor]:
    """Keep as many Gaussians of the highest scores as make a file of at most so many bytes."""

    def rows(kept: Tensor) -> dict[str, Tensor]:
        return {name: value[kept] for name, value in params.items()}

    return rows(shrink.best_within(scores, most, lambda kept: len(coding.write(rows(kept), level))))
