"""The backend on a GPU: the kernels of `cuda_ext`, float32."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import cuda_ext
from pop_fast.api.plugin import BaseBackend
from pop_fast.train.steps import WholeStep

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.cuda.stages import CudaStages
    from pop_fast.train.fused_stepper import MakeFused
    from pop_fast.train.stepper import Task


@dataclass(frozen=True)
class CudaBackend(BaseBackend):
    """Draws on the GPU that holds the tensors.

    Attributes:
        backward: which kernel goes back, a thread for some pixels or a thread for a Gaussian of a tile.
        deterministic: sum gradients in one order; False adds atomically and saves 48 bytes an instance.
    """

    backward: Literal["pixel_parallel", "gaussian_parallel"] = "pixel_parallel"
    deterministic: bool = True

    def why_not(self) -> str | None:
        """Return one sentence on why it cannot run here and what to do, or None."""
        return cuda_ext.why_not()

    def holds(self, tensor: Tensor) -> bool:
        """Tell whether kernels can read a tensor."""
        from cuda_ext import arrays

        return arrays.on_gpu(tensor)

    def stages(self) -> CudaStages:
        """Return the kernels' stages."""
        from pop_fast.cuda.stages import CudaStages

        return CudaStages(self.backward, self.deterministic)

    def open_view(self, pass_input: Any) -> Any:
        """Draw a view for passes over it."""
        from pop_fast.cuda.stages import CudaView

        return CudaView(pass_input)

    def whole_step(self) -> WholeStep:
        """Return the fused step, which takes all steps on a GPU: a setting that it does not know is refused."""
        known, own = WholeStep("cuda", _make_fused, most=500), ("batch_size", "opacity_reg", "scale_reg")
        return replace(known, only={name: value for name, value in known.only.items() if name not in own})


def _make_fused(task: Task) -> MakeFused:
    """Return what makes the fused step, with the photographs on the GPU."""
    from pop_fast.cuda.training import make_fused

    return make_fused(task)


CUDA: Final = CudaBackend(
    "cuda", "cuda", ("float32",), speed=2, lacks={"covars": (None, "the kernels start from quats and scales")}
)
