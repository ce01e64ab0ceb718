"""How the stages of one call share its seconds, so that none starves those after it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

SHORTEST = 3.0  # seconds with which a stage is begun at all
MARGIN = 3.0  # seconds that are kept for writing down the end


@dataclass(frozen=True)
class Share:
    """What a stage gets.

    Attributes:
        least: seconds that earlier stages leave to it.
        most: seconds that it may take where there are more.
    """

    least: float
    most: float


class Budget:
    """Deals out seconds to the stages of a call, in order.

    Args:
        limit: seconds for all of them.
        shares: of every stage, by name.
        order: the stages to come.
    """

    def __init__(self, limit: float, shares: Mapping[str, Share], order: Sequence[str]) -> None:
        self._end = time.monotonic() + limit - MARGIN
        self._shares, self._order = shares, list(order)
        asked = sum(shares[name].least for name in order)
        # a short call keeps less for everyone
        self._scale = min(1.0, 0.9 * max(limit - MARGIN, 0.0) / asked) if asked else 1.0

    def seconds(self, name: str) -> float:
        """Return how long the next stage may take; under `SHORTEST` it is not to be begun."""
        self._order.remove(name)
        kept = self._scale * sum(self._shares[later].least for later in self._order)
        return min(self._shares[name].most, self._end - time.monotonic() - kept)
