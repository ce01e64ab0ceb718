"""The backend on the CPU that draws with torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from pop_fast.api.plugin import BaseBackend

if TYPE_CHECKING:
    from pop_fast.stages.stage_set import Stages


@dataclass(frozen=True)
class TorchBackend(BaseBackend):
    """Draws with torch on the CPU."""

    def stages(self) -> Stages:
        """Return torch's stages."""
        from pop_fast.stages.stage_set import Stages

        return Stages()

    def open_view(self, pass_input: Any) -> Any:
        """Project and list a view for passes over it."""
        from pop_fast.stages.stage_set import view_of

        return view_of(pass_input, self.stages())


FAST: Final = TorchBackend("fast", "cpu", ("float32", "float64"), speed=0)
