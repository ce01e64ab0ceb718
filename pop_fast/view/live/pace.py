"""When a view is drawn anew, and how large: small and soon while the camera moves, sharp when it rests."""

from __future__ import annotations

from typing import Final, Literal

Kind = Literal["quick", "sharp"]
# seconds after its last movement at which a camera rests
_REST: Final = 0.25
# seconds that a picture may take while the camera moves
_QUICK: Final = 0.12
_LEAST_SIDE: Final = 96
# of the time at most, so that a training continues under a viewer
_SHARE: Final = 0.2
_LEAST_PAUSE: Final = 2.0


class Pace:
    """The times of one view; the clock is the caller's, seconds."""

    def __init__(self) -> None:
        self._moved_at = -1e9
        self._stale: bool = True  # nothing that was drawn shows the present state
        self._sharp = False
        self._renewed = False  # the Gaussians changed
        self._last: tuple[float, float] = (-1e9, 0.0)  # when the last sharp picture was ready, and what it took
        self._seconds_per_pixel: float | None = None

    def moved(self, now: float) -> None:
        """Note that the camera moved."""
        self._moved_at, self._stale = now, True

    def changed(self) -> None:
        """Note that something else is to be shown of the same Gaussians."""
        self._stale, self._moved_at = True, -1e9

    def renewed(self) -> None:
        """Note that the Gaussians have changed, as they do at every step of a training."""
        self._renewed = True

    def due(self, now: float) -> Kind | None:
        """Tell what is to be drawn now, if anything."""
        resting = now - self._moved_at >= _REST
        if self._stale:
            return "sharp" if resting else "quick"
        if resting and not self._sharp:
            return "sharp"
        ready, took = self._last
        if self._renewed and resting and now - ready >= max(_LEAST_PAUSE, took / _SHARE):
            return "sharp"
        return None

    def rests_in(self, now: float) -> float | None:
        """Give the seconds after which a sharp picture will be due; None where none is awaited."""
        return None if self._sharp and not self._stale else max(0.0, _REST - (now - self._moved_at))

    def drawn(self, kind: Kind, pixels: int, seconds: float, now: float) -> None:
        """Note a picture that was drawn of the state that `due` saw."""
        self._seconds_per_pixel = seconds / max(pixels, 1)
        self._sharp = kind == "sharp"
        if self._sharp:
            self._last, self._renewed = (now, seconds), False

    def begin(self) -> None:
        """Note that what is shown now is being drawn: what changes from here on is news."""
        self._stale = False

    def size(self, kind: Kind, width: int, height: int, longest: int) -> tuple[int, int]:
        """Choose a picture's width and height, px, of the window's shape.

        Args:
            kind: quick ones are as large as the time allows.
            width: of the window, px.
            height: likewise.
            longest: the longer side of a sharp picture, px.
        """
        width, height = max(width, 1), max(height, 1)
        scale = min(1.0, longest / max(width, height))
        if kind == "quick":
            pixels = _QUICK / self._seconds_per_pixel if self._seconds_per_pixel else 240.0 * 240.0
            scale = min(scale, (pixels / (width * height)) ** 0.5)
            scale = max(scale, min(1.0, _LEAST_SIDE / max(width, height)))
        return max(1, round(scale * width)), max(1, round(scale * height))
