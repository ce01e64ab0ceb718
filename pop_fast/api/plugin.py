"""What backends share that draw behind the one front end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

from pop_fast.errors import PopError

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.api.backend import Backend
    from pop_fast.api.meta import RenderMeta
    from pop_fast.train.steps import WholeStep


@dataclass(frozen=True)
class BaseBackend:
    """A backend by its facts; what it draws with comes from those who derive from it.

    Attributes:
        name, device, dtypes, speed, lacks: as `pop_fast.api.backend.Backend` says.
    """

    name: str
    device: str
    dtypes: tuple[str, ...]
    speed: int | None
    lacks: Mapping[str, tuple[Any, str]] = field(default_factory=dict)

    def why_not(self) -> str | None:
        """Return one sentence on why it cannot run here and what to do, or None."""
        return None

    def available(self) -> bool:
        """Tell whether it can run here."""
        return self.why_not() is None

    def holds(self, tensor: Tensor) -> bool:
        """Tell whether a tensor is where this backend reads it."""
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
        reason = self.why_not()
        if reason is not None:
            raise PopError(f"backend {self.name!r} cannot run: {reason}")
        from pop_fast.api.rasterize import rasterization

        return rasterization(*args, **kwargs, backend=cast("Backend", self))
