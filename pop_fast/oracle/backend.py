"""The oracle as a backend: slow, exact, float64, for small scenes and for comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from pop_fast.api.plugin import BaseBackend

if TYPE_CHECKING:
    from pop_fast.oracle.stages import OracleStages


@dataclass(frozen=True)
class OracleBackend(BaseBackend):
    """Draws with `pop_ref`, whatever the precision of the tensors."""

    def stages(self) -> OracleStages:
        """Return the oracle's stages."""
        from pop_fast.oracle.stages import OracleStages

        return OracleStages()

    def open_view(self, pass_input: Any) -> Any:
        """Draw a view for passes over it."""
        from pop_fast.oracle.passes import OracleView

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
