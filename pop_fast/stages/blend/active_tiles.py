"""The tiles of a group that still matter: states per tile, compacted when most tiles are done."""

from __future__ import annotations

from torch import Tensor


class ActiveTiles:
    """Named states with a row per tile of a group, of which a shrinking choice is held close together.

    Attributes:
        rows: the tiles that are held, ascending; all when None.
    """

    def __init__(self, states: dict[str, Tensor]) -> None:
        self.rows: Tensor | None = None
        self._whole = states
        self._held = states

    def __getitem__(self, name: str) -> Tensor:
        return self._held[name]

    def count_below(self, reached: int) -> int:
        """Return how many of the held tiles are among the group's first `reached`."""
        return reached if self.rows is None else int((self.rows < reached).sum())

    def select(self, rows: Tensor | None) -> None:
        """Hold these tiles; what was held before is written back first."""
        if rows is self.rows:
            return
        whole = self.whole()
        self.rows = rows
        self._held = whole if rows is None else {name: state[rows] for name, state in whole.items()}

    def drop(self, n: int, transmittance: Tensor, below: float) -> None:
        """Hold only the tiles with light left, out of the first `n`, when these are less than a share of them."""
        bright = transmittance.amax(1) > 0.0
        if int(bright.sum()) < below * n:
            keep = bright.nonzero().squeeze(1)
            self.select(keep if self.rows is None else self.rows[keep])

    def whole(self) -> dict[str, Tensor]:
        """Return the states of all tiles."""
        if self.rows is not None:
            for name, state in self._held.items():
                self._whole[name].index_copy_(0, self.rows, state)
        return self._whole
