"""How many instances the tile lists of each image size have room for, from what every view was last seen to need.

Sorts and ranges run over the room, not over what is in it, because a captured step cannot ask how much that is. So the
room follows the need: it grows when a step finds too little, and is brought back to `GROWTH` times the need at every
densification step, when buffers are made anew in any case. The need of a size is the most that one of its views had
when last drawn: the heaviest view counts also where the last window passed it by, and a phase of large splats is
forgotten once every view has been drawn again. A room that is not far off is kept, so that a need that varies a little
neither moves memory about nor overflows at once.
"""

from __future__ import annotations

from collections.abc import Sequence

# the kernels number instances by int, with some to spare for the threads behind the last one
MOST = 2**31 - 1024
GROWTH = 1.5
FIRST_GUESS = (8, 1024)  # instances a Gaussian, and at least
KEPT = (1.2, 2.0)  # times the need: a room within is left as it is

Size = tuple[int, int]


class Capacity:
    """Keeps the room of every image size.

    Args:
        sizes: (width, height) of every view, px.
    """

    def __init__(self, sizes: Sequence[Size]) -> None:
        self._sizes = list(sizes)
        self._seen = [0] * len(self._sizes)
        self._rooms: dict[Size, int] = {}
        self._n = 0

    def note(self, view: int, instances: int) -> None:
        """Keep how many instances a view had."""
        self._seen[view] = instances

    def overflowed(self, view: int, instances: int) -> Size:
        """Make room for a view that did not fit, and return its size."""
        self.note(view, instances)
        size = self._sizes[view]
        self._rooms[size] = _room_for(instances)
        return size

    def settle(self, n: int) -> None:
        """Bring rooms back to what is needed; the number of Gaussians is `n` from now on."""
        # clones and children of splits add to the need, in proportion at most; pruned Gaussians were hardly there
        more = max(n / self._n, 1.0) if self._n else 1.0
        self._seen = [min(round(more * seen), MOST) for seen in self._seen]
        self._n = n
        for size, room in self._rooms.items():
            need = self._need(size)
            if need and not KEPT[0] * need <= room <= KEPT[1] * need:
                self._rooms[size] = _room_for(need)

    def room(self, size: Size) -> int:
        """Return how many instances an image of that size gets room for, at least 1."""
        if size not in self._rooms:
            need = self._need(size)
            per_gaussian, least = FIRST_GUESS
            self._rooms[size] = _room_for(need) if need else max(per_gaussian * self._n, least, 1)
        return self._rooms[size]

    def _need(self, size: Size) -> int:
        """Return the most that a view of that size had, or, where none was drawn, what its pixels let expect."""
        own = max((seen for seen, other in zip(self._seen, self._sizes, strict=True) if other == size), default=0)
        if own:
            return own
        shares = [seen / (width * height) for seen, (width, height) in zip(self._seen, self._sizes, strict=True)]
        return round(max(shares, default=0.0) * size[0] * size[1])


def _room_for(need: int) -> int:
    return need if need > MOST else min(int(GROWTH * need) + 1, MOST)
