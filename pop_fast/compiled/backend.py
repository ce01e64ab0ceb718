"""The backend with compiled stages, and the engine that takes whole steps in C++."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import pop_fast.compiled
from pop_fast.stages.backend import TorchBackend

if TYPE_CHECKING:
    from pop_fast.stages.stage_set import Stages


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

    def make_engine(self, config: Any, own_strategy: bool) -> Any:
        """Return the native step where it knows all settings, else autograd over the compiled stages."""
        from pop_fast.train.engines import native_engine, torch_engine
        from pop_fast.train.fused_settings import unsupported_setting

        if own_strategy and unsupported_setting(config) is None:
            return native_engine(self)
        return torch_engine(self)


COMPILED: Final = CompiledBackend("compiled", "cpu", ("float32", "float64"), speed=1)
