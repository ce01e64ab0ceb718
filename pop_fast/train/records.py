"""The records of metrics.jsonl: what of a step's measurements is written, and under which names."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from pop_fast.density.protocol import DensificationStep
from pop_fast.train.config import TrainConfig
from pop_fast.train.steps import Phase, StepStats


@dataclass(frozen=True)
class Segment:
    """Steps of one phase, taken one after the other, and the densification step after the last of them.

    Attributes:
        first: number of the first step, from 0.
        phase: what they did.
        views: name of the photograph of each step.
        stats: of each step.
        densification: what density control did after the last, None where nothing was due.
        before: Gaussians that were trained.
        after: Gaussians after that.
        seconds: that all of it took, by the clock.
        seconds_cpu: of processor time, over all threads.
    """

    first: int
    phase: Phase
    views: list[str]
    stats: list[StepStats]
    densification: DensificationStep | None
    before: int
    after: int
    seconds: float
    seconds_cpu: float


def record_of(
    segment: Segment, step: int, config: TrainConfig, lr_means: float, seconds_before: float
) -> dict[str, Any] | None:
    """Make the record of a step, or None where none is due: every `log_every` steps there is one, and at every change.

    What the engine has not measured is left out.

    Args:
        segment: that the step belongs to.
        step: its number.
        config: step numbers as they are run.
        lr_means: learning rate of the means at that step, world units.
        seconds_before: of training, before the segment.
    """
    place = step - segment.first
    stats, last = segment.stats[place], place + 1 == len(segment.stats)
    densification = segment.densification if last else None
    if step % config.log_every != 0 and densification is None:
        return None
    halved = 0.5 if segment.phase.objective.d_ssim_halved else 1.0
    measured = {
        segment.phase.objective.pixelwise: stats.pixelwise,
        "d_ssim": halved * (1.0 - stats.ssim),
        "psnr": -10.0 * math.log10(stats.square) if stats.square != 0.0 else math.inf,
        "n_blended": stats.n_blended,
        "n_traversed": stats.n_traversed,
    }
    return {
        "step": step,
        "view": segment.views[place],
        "loss": stats.objective + stats.pop,
        **{name: value for name, value in measured.items() if not math.isnan(value)},
        **({"pop": stats.pop} if segment.phase.pop or stats.pop != 0.0 else {}),
        "num_gaussians": segment.before if densification is None else segment.after,
        "sh_degree": segment.phase.sh_degree,
        "lr_means": lr_means,
        "it_per_s": len(segment.stats) / segment.seconds,
        "seconds": seconds_before + segment.seconds * (place + 1) / len(segment.stats),
        **({} if densification is None else densification.record()),
    }
