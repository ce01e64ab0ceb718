"""What photographs themselves say about how well they will do: blur, exposure, copies, and what their camera noted."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from pop_fast.data.finding import Finding, number
from pop_fast.errors import CaptureError
from pop_fast.io.image_header import Exif, read_exif
from pop_fast.io.images import read_image

# sharpness is compared at this size, at which two photographs of one scene look alike
_SIDE: Final = 512
# of a photograph's neighbours by name; sharpness is a variance, so a fifth of it is less than half the detail
_BLURRED: Final = 0.2
_NEIGHBOURS: Final = 4
# share of pixels at the end of the scale
_CLIPPED: Final = 0.25
# stops between the darkest and the brightest of a set
_STOPS: Final = 1.5
_THUMB: Final = 24
_FEATURES: Final = 500
# mean difference of two thumbnails, of 255: noise and compression leave less, a step to the side more
_SAME: Final = 1.2
# photographs of a set under which there is too little to see from all sides
_FEW: Final = 20


@dataclass(frozen=True)
class Shown:
    """What was measured of one photograph.

    Attributes:
        name: relative file name.
        size: width and height, px; (0, 0) where it cannot be read.
        problem: why it cannot be read, or "".
        exif: what its camera noted.
        digest: of the file's bytes.
        sharpness: variance of the Laplacian, of a gray picture with sides up to 512 px.
        brightness: mean gray, 0 to 255.
        dark: share of pixels under 4.
        bright: share of pixels over 251.
        thumb: gray. float32 [24, 24]
        features: places and descriptors of up to 500 SIFT features of the gray picture, sides up to 512 px; places are
            px of that picture. float32 [P, 2], uint8 [P, 128]
    """

    name: str
    size: tuple[int, int] = (0, 0)
    problem: str = ""
    exif: Exif = field(default_factory=Exif)
    digest: str = ""
    sharpness: float = 0.0
    brightness: float = 0.0
    dark: float = 0.0
    bright: float = 0.0
    thumb: np.ndarray = field(default_factory=lambda: np.zeros((_THUMB, _THUMB), np.float32))
    features: tuple[np.ndarray, np.ndarray] = field(
        default_factory=lambda: (np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    )


def measure_file(path: Path, name: str) -> Shown:
    """Decode a photograph and measure it."""
    try:
        return measure(path, read_image(path), name)
    except CaptureError as error:
        return Shown(name, problem=str(error))


def measure(path: Path, image: np.ndarray, name: str) -> Shown:
    """Measure a photograph that was read. image: uint8 [H, W, 3 or 4]"""
    height, width = image.shape[:2]
    gray = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2GRAY)
    small = _shrunk(gray)
    return Shown(
        name,
        (width, height),
        exif=read_exif(path),
        digest=hashlib.sha256(path.read_bytes()).hexdigest(),
        sharpness=sharpness(small),
        brightness=float(gray.mean()),
        dark=float((small < 4).mean()),
        bright=float((small > 251).mean()),
        thumb=thumbnail(gray),
        features=_features(small),
    )


def _features(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points, descriptors = cv2.SIFT.create(nfeatures=_FEATURES).detectAndCompute(gray, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
    return np.array([point.pt for point in points], np.float32), descriptors.astype(np.uint8)


def sharpness(gray: np.ndarray) -> float:
    """Return the variance of the Laplacian of a gray picture, shrunk to sides of up to 512 px. uint8 [H, W]"""
    return float(cv2.Laplacian(_shrunk(gray), cv2.CV_32F).var())


def thumbnail(gray: np.ndarray) -> np.ndarray:
    """Shrink a gray picture to what tells whether two look the same. float32 [24, 24]"""
    return cv2.resize(gray, (_THUMB, _THUMB), interpolation=cv2.INTER_AREA).astype(np.float32)


def look_the_same(thumb: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Tell which thumbnails look like another: they differ by no more than noise and compression make. bool [P]

    Args:
        thumb: float32 [24, 24]
        others: float32 [P, 24, 24]
    """
    return np.abs(others - thumb).mean(axis=(1, 2)) < _SAME


def _shrunk(gray: np.ndarray) -> np.ndarray:
    scale = _SIDE / max(gray.shape)
    return gray if scale >= 1.0 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def about_quality(shown: Sequence[Shown]) -> Iterator[Finding]:
    """Tell what may harm the search for cameras or the training: blur, exposure, copies, another lens."""
    sound = [one for one in shown if not one.problem]
    if len(sound) < 2:
        return
    yield from _about_camera(sound)
    yield from _about_blur(sound)
    yield from _about_exposure(sound)
    yield from _about_copies(sound)


def about_number(count: int) -> Iterator[Finding]:
    """Tell that there are few photographs."""
    if count < _FEW:
        fix = f"{_FEW} to 200 that overlap by two thirds show a scene from all sides"
        yield Finding("warn", "photographs", f"{count} {number(count, 'is', 'are')} few; {fix}")


def _about_camera(shown: Sequence[Shown]) -> Iterator[Finding]:
    kinds = Counter(one.exif.camera for one in shown if one.exif.camera)
    lenses = Counter(round(one.exif.focal, 1) for one in shown if one.exif.focal)
    if not kinds and not lenses:
        yield Finding("ok", "EXIF", "no camera noted its lens or its exposure")
        return
    named = ", ".join(f"{count} x {kind}" for kind, count in kinds.most_common(3))
    focal = ", ".join(f"{mm:g} mm" for mm, _ in lenses.most_common(4))
    text = f"{named or 'no camera named'}{f'; focal length {focal}' if focal else ''}"
    without = [one.name for one in shown if not one.exif.focal]
    if without:
        fix = "where photographs were edited, use the originals: cameras are found more surely from a known lens"
        yield Finding(
            "warn",
            "EXIF",
            f"{len(without)} {number(len(without), 'has', 'have')} no focal length, {some(without)}; {fix}",
        )
    if len(kinds) > 1 or len(lenses) > 1:
        yield Finding("warn", "EXIF", f"{text}: several lenses or zooms; one fixed lens is placed more surely")
    else:
        yield Finding("ok", "EXIF", text)


def _about_blur(shown: Sequence[Shown]) -> Iterator[Finding]:
    values = np.array([one.sharpness for one in shown])
    # by name, photographs of one place follow one another
    around = [np.median(values[max(i - _NEIGHBOURS, 0) : i + _NEIGHBOURS + 1]) for i in range(len(values))]
    blurred = [one.name for one, median in zip(shown, around, strict=True) if one.sharpness < _BLURRED * median]
    if blurred:
        fix = "out of focus or shaken: leave them out"
        what = f"{len(blurred)} {number(len(blurred), 'is', 'are')} far less sharp than those around them"
        yield Finding("warn", "blur", f"{what}, {some(blurred)}; {fix}")
    else:
        yield Finding("ok", "blur", "all about as sharp as those around them")


def _about_exposure(shown: Sequence[Shown]) -> Iterator[Finding]:
    dark = [one.name for one in shown if one.dark > _CLIPPED]
    bright = [one.name for one in shown if one.bright > _CLIPPED]
    for names, what in ((dark, "black"), (bright, "white")):
        if names:
            yield Finding(
                "warn",
                "exposure",
                f"{len(names)} {number(len(names), 'is', 'are')} over a quarter pure {what}, {some(names)}",
            )
    taken = [one.exif.exposure * one.exif.iso for one in shown if one.exif.exposure and one.exif.iso]
    stops = float(np.log2(max(taken) / min(taken))) if len(taken) == len(shown) else 0.0
    fix = "lock the exposure, or train with --exposure: without it training takes one brightness for all"
    if stops > _STOPS:
        yield Finding("warn", "exposure", f"exposures differ by {stops:.1f} stops; {fix}")
    elif not dark and not bright:
        levels = [one.brightness for one in shown]
        known = f"within {stops:.1f} stops, " if taken and len(taken) == len(shown) else ""
        yield Finding("ok", "exposure", f"{known}mean brightness {min(levels):.0f} to {max(levels):.0f} of 255")


def _about_copies(shown: Sequence[Shown]) -> Iterator[Finding]:
    digests = Counter(one.digest for one in shown)
    copies = [one.name for one in shown if digests[one.digest] > 1]
    if copies:
        yield Finding("warn", "duplicates", f"{len(copies)} are the same file more than once, {some(copies)}; keep one")
    thumbs = np.stack([one.thumb for one in shown])
    alike: list[str] = []
    for i in range(len(shown) - 1):
        near = look_the_same(thumbs[i], thumbs[i + 1 :])
        others = [shown[i + 1 + int(j)] for j in np.flatnonzero(near)]
        alike += [f"{shown[i].name} and {other.name}" for other in others if other.digest != shown[i].digest]
    if alike:
        fix = "they add nothing, from the same place"
        yield Finding(
            "warn",
            "duplicates",
            f"{len(alike)} {number(len(alike), 'pair looks', 'pairs look')} the same, {some(alike)}; {fix}",
        )
    if not copies and not alike:
        yield Finding("ok", "duplicates", "none")


def some(names: Sequence[str]) -> str:
    """Name the first of some photographs."""
    return "first " + ", ".join(names[:3])
