"""The backends of this package: torch on the CPU, C++ there, the kernels of `cuda_ext`, and the oracle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, cast

import cuda_ext
from pop_fast import compiled
from pop_fast.api.backend import require_backend
from pop_fast.train.steps import WholeStep

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.api.backend import Backend
    from pop_fast.api.rasterize import RenderMeta
    from pop_fast.cuda.stages import CudaStages
    from pop_fast.oracle import OracleStages
    from pop_fast.stages.stage_set import Stages
    from pop_fast.train.stepper import MakeFused, Task


@dataclass(frozen=True)
class BaseBackend:
    """A backend by its facts, as `pop_fast.api.backend.Backend` says; those who derive from it bring what draws."""

    name: str
    device: str
    dtypes: tuple[str, ...]
    speed: int | None
    lacks: Mapping[str, tuple[Any, str]] = field(default_factory=dict)

    def why_not(self) -> str | None:
        return None

    def available(self) -> bool:
        return self.why_not() is None

    def holds(self, tensor: Tensor) -> bool:
        return tensor.device.type == self.device

    def losses(self) -> Any:
        """Return torch's losses."""
        from pop_fast.stages import losses

        return losses

    def whole_step(self) -> WholeStep | None:
        """Return None: training takes its steps by autograd over the stages."""
        return None

    def rasterization(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, RenderMeta]:
        """Render; see `pop_fast.api.rasterize.rasterization`.

        Raises:
            PopError: it cannot run here; says why and what to do.
        """
        require_backend(cast("Backend", self))
        from pop_fast.api.rasterize import rasterization

        return rasterization(*args, **kwargs, backend=cast("Backend", self))


@dataclass(frozen=True)
class TorchBackend(BaseBackend):
    """Draws with torch on the CPU."""

    def stages(self) -> Stages:
        from pop_fast.stages.stage_set import Stages

        return Stages()

    def open_view(self, pass_input: Any) -> Any:
        from pop_fast.stages.stage_set import view_of

        return view_of(pass_input, self.stages())


FAST: Final = TorchBackend("fast", "cpu", ("float32", "float64"), speed=0)


@dataclass(frozen=True)
class CompiledBackend(TorchBackend):
    """Draws on the CPU with stages in C++; what has none there is torch's."""

    def why_not(self) -> str | None:
        return compiled.why_not()

    def stages(self) -> Stages:
        from pop_fast.compiled import compositing as own
        from pop_fast.stages.stage_set import Stages, large_tile

        drawn = (own.covariances, own.project, own.colors_of_view, own.tile_lists, own.composite)
        passes = (own.contributions, own.sensitivities, own.screen_moments, own.dominant_points)
        return Stages(*drawn, large_tile, *passes)

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


@dataclass(frozen=True)
class CudaBackend(BaseBackend):
    """Draws on the GPU that holds the tensors."""

    # which kernel goes back, a thread for some pixels or a thread for a Gaussian of a tile
    backward: Literal["pixel_parallel", "gaussian_parallel"] = "pixel_parallel"
    deterministic: bool = True  # sum gradients in one order; False adds atomically and saves 48 bytes an instance

    def why_not(self) -> str | None:
        return cuda_ext.why_not()

    def holds(self, tensor: Tensor) -> bool:
        """Tell whether kernels can read a tensor."""
        from cuda_ext import arrays

        return arrays.on_gpu(tensor)

    def stages(self) -> CudaStages:
        from pop_fast.cuda.stages import CudaStages

        return CudaStages(self.backward, self.deterministic)

    def open_view(self, pass_input: Any) -> Any:
        from pop_fast.cuda.stages import CudaView

        return CudaView(pass_input)

    def whole_step(self) -> WholeStep:
        """Return the fused step, which takes all steps on a GPU: a setting that it does not know is refused."""
        known, own = WholeStep("cuda", _make_fused, most=500), ("batch_size", "opacity_reg", "scale_reg")
        return replace(known, only={name: value for name, value in known.only.items() if name not in own})


def _make_fused(task: Task) -> MakeFused:
    from pop_fast.cuda.stages import make_fused

    return make_fused(task)


CUDA: Final = CudaBackend(
    "cuda", "cuda", ("float32",), speed=2, lacks={"covars": (None, "the kernels start from quats and scales")}
)


@dataclass(frozen=True)
class OracleBackend(BaseBackend):
    """Draws with `pop_ref`, whatever the precision of the tensors."""

    def stages(self) -> OracleStages:
        from pop_fast.oracle import OracleStages

        return OracleStages()

    def open_view(self, pass_input: Any) -> Any:
        from pop_fast.oracle import OracleView

        return OracleView(pass_input)


REF: Final = OracleBackend(
    "ref",
    "cpu",
    ("float32", "float64"),
    speed=None,
    lacks={
        "covars": (None, "the oracle starts from quats and scales; give these, or use backend 'fast'"),
        "radius_clip": (0.0, "the oracle culls by extents alone; use backend 'fast'"),
    },
)
