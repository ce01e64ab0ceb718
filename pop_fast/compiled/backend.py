"""The backend with compiled stages, and the engine that takes whole steps in C++."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import pop_fast.compiled
from pop_fast.stages.backend import TorchBackend
from pop_fast.train.steps import WholeStep

if TYPE_CHECKING:
    from pop_fast.stages.stage_set import Stages
    from pop_fast.train.fused_stepper import MakeFused
    from pop_fast.train.stepper import Task


@dataclass(frozen=True)
class CompiledBackend(TorchBackend):
    """Draws on the CPU with stages in C++; what has none there is torch's."""

    def why_not(self) -> str | None:
        """Return one sentence on why it cannot run here and what to do, or None."""
        return pop_fast.compiled.why_not()

    def stages(self) -> Stages:
        """Return the compiled stages."""
        from pop_fast.compiled.compositing import composite, tile_lists
        from pop_fast.compiled.scores import contributions, dominant_points, screen_moments, sensitivities
        from pop_fast.compiled.splatting import colors_of_view, covariances, project
        from pop_fast.stages.stage_set import Stages, large_tile

        passes = (contributions, sensitivities, screen_moments, dominant_points)
        return Stages(covariances, project, colors_of_view, tile_lists, composite, large_tile, *passes)

    def losses(self) -> Any:
        """Return the losses that hold SSIM in C++, and torch's others."""
        from pop_fast.compiled import losses

        return losses

    def whole_step(self) -> WholeStep:
        """Return the step in C++."""
        step = WholeStep("native", _native_trainer, most=20, depends_on_threads=False)
        return replace(step, only={name: known for name, known in step.only.items() if name not in _LEARNED})


# settings of which the native step knows every value
_LEARNED: Final = frozenset({"exposure", "depth_lambda", "opacity_reg", "scale_reg"})


def _native_trainer(task: Task) -> MakeFused:
    """Make the native step, with what it needs of the photographs in the memory that the settings give it."""
    from pop_fast.compiled.native_step import NativeTrainer

    exposures = task.appearance if task.config.exposure else None
    return partial(NativeTrainer, cache_mb=task.config.target_cache_mb, stop=task.stop, exposures=exposures)


COMPILED: Final = CompiledBackend("compiled", "cpu", ("float32", "float64"), speed=1)
