"""The backend on a GPU: the kernels of `cuda_ext`, float32."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import cuda_ext
from pop_fast.api.plugin import BaseBackend

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.cuda.stages import CudaStages


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
        from pop_fast.cuda.passes import CudaView

        return CudaView(pass_input)

    def make_engine(self, config: Any, own_strategy: bool) -> Any:
        """Return the fused step and nothing else; a setting that it does not know is refused."""
        from pop_fast.errors import PopError
        from pop_fast.train import engines
        from pop_fast.train.fused_settings import unsupported

        reason = unsupported(config)
        if not own_strategy:
            reason = "backend 'cuda' trains with the strategies of this package only; use --backend fast"
        if reason is not None:
            raise PopError(reason)
        return engines.cuda_engine()


CUDA: Final = CudaBackend(
    "cuda", "cuda", ("float32",), speed=2, lacks={"covars": (None, "the kernels start from quats and scales")}
)
