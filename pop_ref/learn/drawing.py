"""Draw a counterexample with NumPy alone: what a student's function gives in orange, what it should give in blue.

Covariances are drawn as ellipses, rotations as the axes that they turn, the blue ones thinner and on top; pictures
as pictures, and all other numbers as bars side by side, each pair to its own scale. Over each panel stands what it
shows, and under a pair of bars which number of the result it is, in capitals of three by five squares.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.conformance.files import write_file
from pop_ref.conformance.scenes import Scene
from pop_ref.learn.judge import Verdict
from pop_ref.learn.student import Call, numbers
from pop_ref.render import render

# of a letter, which is three by five of them, and a line of text
SQUARE: Final = 2
LINE: Final = 7 * SQUARE
SIDE: Final = 240
# over each panel, for two lines
HEAD: Final = 2 * LINE
_FINER: Final = 3
_PAPER, _RULE = np.array([0.99, 0.985, 0.975]), np.array([0.8, 0.79, 0.77])
YOURS: Final = np.array([0.82, 0.38, 0.16])
ORACLES: Final = np.array([0.15, 0.39, 0.79])
_INK: Final = np.array([0.25, 0.25, 0.25])
# as many as have room for the number's place, of three digits
_MOST_BARS: Final = 6

_AS_ELLIPSES: Final = ("covars_from_quats_scales", "covars_cam_from_covars", "project_covars", "low_pass")
_AS_AXES: Final = ("rotmats_from_quats",)


def drawn_counterexample(verdict: Verdict) -> np.ndarray | None:
    """Draw what broke a law.

    Args:
        verdict: of a stage that has not passed.

    Returns:
        A picture [HEAD + SIDE, W, 3] in [0, 1]: the scene, if one was drawn, and the two results; None where there is
        nothing to draw.
    """
    scenes = [value for value in (verdict.drawn or {}).values() if isinstance(value, Scene)][:1]
    images = [render(scene.gaussians, scene.camera, scene.background).image for scene in scenes]
    panels = [_titled(_enlarged(image), ("the scene", _INK)) for image in images]
    if verdict.call is not None:
        panels += _results(verdict.call)
    if not panels:
        return None
    gap = np.broadcast_to(_PAPER, (HEAD + SIDE, 12, 3))
    return np.concatenate([part for panel in panels for part in (panel, gap)][:-1], axis=1)


def _results(call: Call) -> list[np.ndarray]:
    found, expected = call.found[0], call.expected[0]
    if call.function in _AS_ELLIPSES or call.function in _AS_AXES:
        ours, theirs = np.asarray(found, dtype=float), np.asarray(expected, dtype=float)
        if ours.shape == theirs.shape and np.all(np.isfinite(ours)):
            both = ((ours, YOURS), (theirs, ORACLES))
            drawn, what = (_ellipses, "1 sigma") if call.function in _AS_ELLIPSES else (_axes, "axes x, y, z")
            return [_titled(drawn(both), (f"yours: {what}", YOURS), (f"oracle: {what}", ORACLES))]
    pictures = [_image(value) for value in (found, expected)]
    if all(picture is not None for picture in pictures):
        titles = (("yours", YOURS), ("oracle", ORACLES))
        return [_titled(picture, title) for picture, title in zip(pictures, titles, strict=True) if picture is not None]
    a, b = numbers(call.found), numbers(call.expected)
    return [_bars(a, b)] if len(a) and len(b) else []


def _titled(panel: np.ndarray, *lines: tuple[str, np.ndarray]) -> np.ndarray:
    """Put lines of text, each in its colour, over a panel."""
    head = np.tile(_PAPER, (HEAD, SIDE, 1))
    for k, (text, color) in enumerate(lines):
        write_text(head, text, SQUARE, SQUARE + k * LINE, color)
    return np.concatenate([head, panel], axis=0)


def _canvas() -> np.ndarray:
    return np.tile(_PAPER, (SIDE * _FINER, SIDE * _FINER, 1))


def _smooth(canvas: np.ndarray) -> np.ndarray:
    return canvas.reshape(SIDE, _FINER, SIDE, _FINER, 3).mean(axis=(1, 3))


def _grid(reach: float) -> tuple[np.ndarray, np.ndarray]:
    at = reach * (2.0 * (np.arange(SIDE * _FINER) + 0.5) / (SIDE * _FINER) - 1.0)
    return np.meshgrid(at, at)


def _flattened(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project covariances [N, 3, 3] onto the planes in which they differ most; [N, 2, 2] stay as they are."""
    if a.shape[-1] == 2:
        return a, b
    values, vectors = np.linalg.eigh((a - b) + np.swapaxes(a - b, 1, 2))
    first = np.argsort(-np.abs(values), axis=1)[:, None, :2]
    planes = np.take_along_axis(vectors, first, axis=2)
    across = np.swapaxes(planes, 1, 2)
    return across @ a @ planes, across @ b @ planes


def _ellipses(both: tuple[tuple[np.ndarray, np.ndarray], ...]) -> np.ndarray:
    """Draw ellipses of one standard deviation about one centre, seen where they differ most if they are in space.

    The second kind is a thinner line on top of the first, so that both are seen where they coincide.
    """
    both = tuple(zip(_flattened(*(covars[:3] for covars, _ in both)), (color for _, color in both), strict=True))
    every = np.concatenate([covars for covars, _ in both])
    largest = float(np.sqrt(max(np.max(np.abs(every)), 1e-12)))
    x, y = _grid(1.3 * largest)
    canvas = _canvas()
    canvas[(np.abs(x) < 0.004 * largest) | (np.abs(y) < 0.004 * largest)] = _RULE
    for (covars, color), width in zip(both, (0.045, 0.02), strict=True):
        for covar in covars:
            # a flat one is drawn as thin as a line
            inverse = np.linalg.pinv(0.5 * (covar + covar.T) + 1e-4 * largest**2 * np.eye(2))
            q = inverse[0, 0] * x * x + (inverse[0, 1] + inverse[1, 0]) * x * y + inverse[1, 1] * y * y
            # the distance from the outline, to first order
            slope = np.hypot(inverse[0, 0] * x + inverse[0, 1] * y, inverse[0, 1] * x + inverse[1, 1] * y)
            canvas[np.abs(q - 1.0) < width * largest * np.maximum(slope, 1e-12)] = color
    return _smooth(canvas)


def _axes(both: tuple[tuple[np.ndarray, np.ndarray], ...]) -> np.ndarray:
    """Draw where a rotation takes the axes x (longest), y and z, seen along z; the second one's are thinner."""
    x, y = _grid(1.2)
    canvas = _canvas()
    canvas[(np.abs(x) < 0.005) | (np.abs(y) < 0.005)] = _RULE
    for (rotmats, color), width in zip(both, (0.03, 0.014), strict=True):
        for k, length in enumerate((1.0, 0.75, 0.5)):
            end = length * rotmats[0, :2, k]
            along = np.clip((x * end[0] + y * end[1]) / max(end @ end, 1e-12), 0.0, 1.0)
            canvas[np.hypot(x - along * end[0], y - along * end[1]) < width] = color
            canvas[np.hypot(x - end[0], y - end[1]) < 2.5 * width] = color
    return _smooth(canvas)


def _bars(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Draw pairs of numbers as pairs of bars; those that differ first, each pair to the larger of its two.

    The title gives the values of the first pair, and under each pair stands the place of its number in the result.
    """
    n = min(len(found), len(expected))
    a, b = (np.nan_to_num(each[:n], posinf=1e300, neginf=-1e300) for each in (found, expected))
    order = np.argsort(-np.abs(a - b), kind="stable")[:_MOST_BARS]
    size = np.maximum(np.maximum(np.abs(a), np.abs(b)), 1e-300)[order]
    canvas, middle = _canvas(), SIDE * _FINER // 2
    canvas[middle - 1 : middle + 2] = _RULE
    wide = SIDE * _FINER / len(order)
    for k in range(len(order)):
        for value, offset, color in ((a[order[k]], 0.1, YOURS), (b[order[k]], 0.5, ORACLES)):
            left, right = int((k + offset) * wide), int((k + offset + 0.38) * wide)
            # a number that is 0 next to the other is a line that can be seen
            height = np.copysign(max(abs(0.85 * middle * float(value / size[k])), 2.0 * _FINER), value)
            top = middle - round(float(height))
            canvas[min(top, middle) : max(top, middle) + 1, left:right] = color
    panel, first = _smooth(canvas), order[0]
    for k, place in enumerate(order):
        write_text(panel, f"[{place}]", int((k + 0.1) * SIDE / len(order)), SIDE - LINE, _INK)
    mine, oracles = ((f"{who} [{first}] {of[first]:.5g}") for who, of in (("yours", found), ("oracle", expected)))
    return _titled(panel, (mine, YOURS), (oracles, ORACLES))


def _image(value: Any) -> np.ndarray | None:
    if not isinstance(value, np.ndarray) or value.ndim != 3 or min(value.shape[:2]) < 5:
        return None
    return _enlarged(value)


def _enlarged(image: np.ndarray) -> np.ndarray:
    """Fit a picture into a square panel, pixels as squares."""
    times = max(1, SIDE // max(image.shape[:2]))
    shown = np.clip(np.nan_to_num(np.broadcast_to(image[..., :3], (*image.shape[:2], 3))), 0.0, 1.0)
    large = shown.repeat(times, axis=0).repeat(times, axis=1)[:SIDE, :SIDE]
    panel = np.tile(_PAPER, (SIDE, SIDE, 1))
    panel[: large.shape[0], : large.shape[1]] = large
    return panel


def write_film(path: Path, frames: Sequence[np.ndarray], seconds: float = 0.4) -> None:
    """Write pictures of one size as an animated PNG, which browsers play: once, the last one longer.

    Args:
        path: where.
        frames: [H, W, 3] in [0, 1] each.
        seconds: how long each is seen.
    """
    height, width = frames[0].shape[:2]
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))]
    parts.append((b"acTL", struct.pack(">II", len(frames), 1)))
    for k, frame in enumerate(frames):
        rows = (np.clip(np.nan_to_num(frame), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        body = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
        shown = round(1000.0 * seconds * (5 if k + 1 == len(frames) else 1))
        # both kinds of chunks are numbered together; the first frame's pixels have no number
        number = max(2 * k - 1, 0)
        parts.append((b"fcTL", struct.pack(">IIIIIHHBB", number, width, height, 0, 0, shown, 1000, 0, 0)))
        parts.append((b"fdAT", struct.pack(">I", number + 1) + body) if k else (b"IDAT", body))
    chunks = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in [*parts, (b"IEND", b"")]
    ]
    write_file(path, b"".join((b"\x89PNG\r\n\x1a\n", *chunks)))


_CHARACTERS: Final = "0123456789abcdefghijklmnopqrstuvwxyz[]-+.,: "
# of each five rows from the top, an octal digit a row, whose three bits are the squares from the left
_ROWS: Final = (
    "7555726227717477171755711747177475771111757577571725755656563444365556746477464434553557557222711152"
    "5565544447577556555525552656442556365655342167222255557555525577555255552227124764446311130070002720"
    "00002000240202000000"
)
_GLYPHS: Final = {each: _ROWS[5 * k : 5 * k + 5] for k, each in enumerate(_CHARACTERS)}


def lettered(text: str) -> np.ndarray:
    """Return a text as squares.

    Args:
        text: of letters (large and small look alike), digits, spaces and `[]-+.,:`.

    Returns:
        Which pixels [5 SQUARE, 4 SQUARE len(text)] are inked, bool.

    Raises:
        KeyError: a character has no glyph.
    """
    glyphs = [[[int(row) >> bit & 1 for bit in (2, 1, 0)] + [0] for row in _GLYPHS[each]] for each in text.lower()]
    squares = np.concatenate([np.zeros((5, 0)), *(np.array(glyph) for glyph in glyphs)], axis=1)
    return squares.repeat(SQUARE, axis=0).repeat(SQUARE, axis=1).astype(bool)


def write_text(picture: np.ndarray, text: str, x: int, y: int, color: np.ndarray) -> None:
    """Write a text into a picture; what does not fit is cut off.

    Args:
        picture: [H, W, 3], written to.
        text: as in `lettered`.
        x, y: its left and upper edge, in pixels.
        color: [3].
    """
    inked = lettered(text)[: max(0, len(picture) - y), : max(0, picture.shape[1] - x)]
    picture[y : y + inked.shape[0], x : x + inked.shape[1]][inked] = color
