"""What photographs themselves show: blur, exposure, copies, what their camera noted, and whether cameras can be found.

Training and `pop data check` ask here, so that both judge alike. The judgement on cameras is on the safe side: only
photographs that show nothing, and small sets of which no two show the same thing, are refused.

How much brighter a photograph is than the others is found where they see the same points, whatever its camera noted. A
point that the search for cameras has followed looks the same in all photographs that see it, but for exposure, white
balance and shine. In stops, brightness is e_i + a_j: of photograph i and of point j. Medians over points and over
photographs, in turn, find both; less than half of the points that shine or are hidden do not move them.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Final, Literal, get_args

import cv2
import numpy as np

from pop_fast.data.capture import Capture, camera_centers
from pop_fast.errors import CaptureError
from pop_fast.io.image_header import Exif, read_exif
from pop_fast.io.images import read_image

State = Literal["ok", "warn", "bad"]


def number(count: int, one: str, more: str) -> str:
    """Choose the word that goes with a number."""
    return one if count == 1 else more


@dataclass(frozen=True)
class CaptureFinding:
    """One line: how bad, about what, and what was found."""

    state: State
    about: str
    text: str


ok, warn, bad = (partial(CaptureFinding, state) for state in get_args(State))
# sharpness is compared at this size, at which two photographs of one scene look alike
_SIDE: Final = 512
# of a photograph's neighbours by name; sharpness is a variance, so a fifth of it is less than half the detail
_BLURRED: Final = 0.2
_NEIGHBOURS: Final = 4
# share of pixels at the end of the scale
_CLIPPED: Final = 0.25
# stops between the darkest and the brightest of a set
DRIFT_STOPS: Final = 1.5
_THUMB: Final = 24
_FEATURES: Final = 500
# mean difference of two thumbnails, of 255: noise and compression leave less, a step to the side more
_SAME: Final = 1.2
# photographs of a set under which there is too little to see from all sides
FEW: Final = 20


@dataclass(frozen=True)
class Shown:
    """What was measured of one photograph, with sides shrunk to up to 512 px but for size and brightness."""

    name: str  # relative file name
    size: tuple[int, int] = (0, 0)  # width and height, px; (0, 0) where it cannot be read
    problem: str = ""  # why it cannot be read
    exif: Exif = field(default_factory=Exif)  # what its camera noted
    digest: str = ""  # of the file's bytes
    sharpness: float = 0.0  # variance of the Laplacian, gray
    # of the pixels that are not transparent
    brightness: float = 0.0  # mean gray, 0 to 255
    dark: float = 0.0  # share of pixels under 4
    bright: float = 0.0  # share of pixels over 251
    # gray. float32 [24, 24]
    thumb: np.ndarray = field(default_factory=lambda: np.zeros((_THUMB, _THUMB), np.float32))
    # places, px, and descriptors of up to 500 SIFT features, gray. float32 [P, 2], uint8 [P, 128]
    features: tuple[np.ndarray, np.ndarray] = field(
        default_factory=lambda: (np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    )


def measure_file(path: Path, name: str) -> Shown:
    try:
        return measure(path, read_image(path), name)
    except CaptureError as error:
        return Shown(name, problem=str(error))


def measure(path: Path, image: np.ndarray, name: str) -> Shown:
    """Measure a photograph that was read. image: uint8 [H, W, 3 or 4]"""
    height, width = image.shape[:2]
    gray = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2GRAY)
    small = _shrunk(gray)
    # transparent pixels say nothing about the exposure
    shown = small if image.shape[2] == 3 else small[_shrunk(np.ascontiguousarray(image[:, :, 3])) > 127]
    if not shown.size:
        shown = small
    return Shown(
        name,
        (width, height),
        exif=read_exif(path),
        digest=hashlib.sha256(path.read_bytes()).hexdigest(),
        sharpness=sharpness(small),
        brightness=float(gray.mean() if image.shape[2] == 3 else shown.mean()),
        dark=float((shown < 4).mean()),
        bright=float((shown > 251).mean()),
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
    """Tell which thumbnails [P, 24, 24] differ from another by no more than noise and compression make. bool [P]"""
    return np.abs(others - thumb).mean(axis=(1, 2)) < _SAME


def _shrunk(gray: np.ndarray) -> np.ndarray:
    scale = _SIDE / max(gray.shape)
    if scale >= 1.0:
        return gray
    # one pixel at least of a strip
    height, width = gray.shape
    return cv2.resize(gray, None, fx=max(scale, 1 / width), fy=max(scale, 1 / height), interpolation=cv2.INTER_AREA)


def about_quality(shown: Sequence[Shown]) -> Iterator[CaptureFinding]:
    """Tell what may harm the search for cameras or the training: blur, exposure, copies, another lens."""
    sound = [one for one in shown if not one.problem]
    if len(sound) < 2:
        return
    yield from _about_camera(sound)
    yield from _about_blur(sound)
    yield from _about_exposure(sound)
    yield from _about_copies(sound)


def about_number(count: int) -> Iterator[CaptureFinding]:
    if count < FEW:
        fix = f"{FEW} to 200 that overlap by two thirds show a scene from all sides"
        yield warn("photographs", f"{count} {number(count, 'is', 'are')} few; {fix}")


def _about_camera(shown: Sequence[Shown]) -> Iterator[CaptureFinding]:
    kinds = Counter(one.exif.camera for one in shown if one.exif.camera)
    lenses = Counter(round(one.exif.focal, 1) for one in shown if one.exif.focal)
    if not kinds and not lenses:
        yield ok("EXIF", "no photograph records its lens or exposure")
        return
    named = ", ".join(f"{count} x {kind}" for kind, count in kinds.most_common(3))
    focal = ", ".join(f"{mm:g} mm" for mm, _ in lenses.most_common(4))
    text = f"{named or 'no camera named'}{f'; focal length {focal}' if focal else ''}"
    without = [one.name for one in shown if not one.exif.focal]
    if without:
        fix = "where photographs were edited, use the originals: cameras are found more reliably with a known lens"
        what = f"{len(without)} {number(len(without), 'has', 'have')} no focal length"
        yield warn("EXIF", f"{what}, {some(without)}; {fix}")
    if len(kinds) > 1 or len(lenses) > 1:
        yield warn("EXIF", f"{text}: several lenses or zooms; one fixed lens is placed more reliably")
    else:
        yield ok("EXIF", text)


def _about_blur(shown: Sequence[Shown]) -> Iterator[CaptureFinding]:
    values = np.array([one.sharpness for one in shown])
    # by name, photographs of one place follow one another
    around = [np.median(values[max(i - _NEIGHBOURS, 0) : i + _NEIGHBOURS + 1]) for i in range(len(values))]
    blurred = [one.name for one, median in zip(shown, around, strict=True) if one.sharpness < _BLURRED * median]
    if blurred:
        fix = "out of focus or shaken: leave them out"
        own = number(len(blurred), "is far less sharp than its", "are far less sharp than their")
        what = f"{len(blurred)} {own} neighbours"
        yield warn("blur", f"{what}, {some(blurred)}; {fix}")
    else:
        yield ok("blur", "all about as sharp as their neighbours")


def _about_exposure(shown: Sequence[Shown]) -> Iterator[CaptureFinding]:
    dark = [one.name for one in shown if one.dark > _CLIPPED]
    bright = [one.name for one in shown if one.bright > _CLIPPED]
    for names, color in ((dark, "black"), (bright, "white")):
        if names:
            what = f"{len(names)} {number(len(names), 'is', 'are')} over a quarter pure {color}"
            yield warn("exposure", f"{what}, {some(names)}")
    stops = exposure_stops([one.exif for one in shown])
    fix = "lock the exposure, or train with --exposure: without it training assumes one brightness for all"
    if stops is not None and stops > DRIFT_STOPS:
        yield warn("exposure", f"exposures differ by {stops:.1f} stops; {fix}")
    elif not dark and not bright:
        levels = [one.brightness for one in shown]
        known = "" if stops is None else f"within {stops:.1f} stops, "
        yield ok("exposure", f"{known}mean brightness {min(levels):.0f} to {max(levels):.0f} of 255")


def exposure_stops(noted: Sequence[Exif]) -> float | None:
    """Give how many stops lie between the exposures that cameras noted; None where one of them noted none."""
    taken = [exif.exposure * exif.iso for exif in noted if exif.exposure and exif.iso]
    return float(np.log2(max(taken) / min(taken))) if taken and len(taken) == len(noted) else None


def _about_copies(shown: Sequence[Shown]) -> Iterator[CaptureFinding]:
    digests = Counter(one.digest for one in shown)
    copies = [one.name for one in shown if digests[one.digest] > 1]
    if copies:
        yield warn("duplicates", f"{len(copies)} are the same file more than once, {some(copies)}; keep one")
    thumbs = np.stack([one.thumb for one in shown])
    alike: list[str] = []
    for i in range(len(shown) - 1):
        near = look_the_same(thumbs[i], thumbs[i + 1 :])
        others = [shown[i + 1 + int(j)] for j in np.flatnonzero(near)]
        alike += [f"{shown[i].name} and {other.name}" for other in others if other.digest != shown[i].digest]
    if alike:
        what = f"{len(alike)} {number(len(alike), 'pair looks', 'pairs look')} the same"
        yield warn("duplicates", f"{what}, {some(alike)}; they add nothing, from the same place")
    if not copies and not alike:
        yield ok("duplicates", "none")


def some(names: Sequence[str]) -> str:
    return "first " + ", ".join(names[:3])


FIX: Final = "take photographs that overlap by two thirds, from different places, of a scene with texture"
# standard deviation of a thumbnail, of 255, under which a photograph is of one colour
_PLAIN: Final = 1.0
# sets up to this size are compared, each photograph with each
_COMPARED: Final = 40
# features of a photograph under which a comparison proves nothing
_ENOUGH: Final = 150
# a match is as much nearer than the second nearest (Lowe 2004)
_RATIO: Final = 0.8
# of the matches of two photographs, those that one fundamental matrix explains; chance leaves about ten
_SHARED: Final = 12


def about_use(shown: Sequence[Shown]) -> Iterator[CaptureFinding]:
    """Tell what stands against finding cameras: photographs that show nothing, or nothing in common."""
    plain = [one.name for one in shown if float(one.thumb.std()) < _PLAIN]
    if plain:
        left = len(shown) - len(plain)
        are = number(len(plain), "is of one colour all over", "are of one colour all over")
        text = f"{len(plain)} of {len(shown)} photographs {are} (black, white or covered), {some(plain)}"
        if left < 2:
            yield bad("photographs", f"no cameras could be found: {text}; {FIX}")
            return
        yield warn("photographs", f"{text}; leave {number(len(plain), 'it', 'them')} out")
    useful = [one for one in shown if float(one.thumb.std()) >= _PLAIN]
    if len(useful) > 1 and len({one.digest for one in useful}) == 1:
        text = f"all {len(useful)} photographs are the same file"
        yield bad("photographs", f"no cameras could be found: {text}; {FIX}")
        return
    comparable = 2 <= len(useful) <= _COMPARED and all(len(one.features[0]) >= _ENOUGH for one in useful)
    if comparable and not any(_share_something(one, other) for one, other in combinations(useful, 2)):
        text = f"no two of the {len(useful)} photographs show the same thing"
        yield bad("photographs", f"no cameras could be found: {text}; {FIX}")


def lens_numbers(shown: Sequence[Shown]) -> list[int]:
    """Number the lenses of photographs: those of one size are of one, but for what their cameras noted. [P]"""
    kinds = [_lens(one) for one in shown]
    return [kinds.index(kind) for kind in kinds]


def _lens(one: Shown) -> tuple[object, ...]:
    focal = one.exif.focal
    return one.size, one.exif.camera, None if focal is None else round(focal, 1), one.exif.focal_35


def about_mixed_cameras(shown: Sequence[Shown]) -> CaptureFinding | None:
    """Tell that photographs of several sizes or focal lengths are taken to be of several lenses; None where of one."""
    sizes = Counter(one.size for one in shown)
    count = len(set(lens_numbers(shown)))
    if count < 2:
        return None
    if len(sizes) > 1:
        listed = ", ".join(f"{count} of {w}x{h} px" for (w, h), count in sizes.most_common(3))
        more = f" and {len(sizes) - 3} more" if len(sizes) > 3 else ""
        what = f"have {len(sizes)} sizes ({listed}{more})"
    else:
        what = f"are of {count} cameras or focal lengths by their EXIF"
    text = f"mixed cameras: the photographs {what}, each treated as another lens"
    return warn("cameras", f"{text}; one camera, not zoomed or cropped, is placed more reliably")


def _share_something(one: Shown, other: Shown) -> bool:
    """Tell whether one fundamental matrix explains enough of what looks alike in two photographs."""
    (here, mine), (there, theirs) = one.features, other.features
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(mine.astype(np.float32), theirs.astype(np.float32), k=2)
    alike = [pair[0] for pair in nearest if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance]
    if len(alike) < _SHARED:
        return False
    cv2.setRNGSeed(0)
    a = np.array([here[match.queryIdx] for match in alike])
    b = np.array([there[match.trainIdx] for match in alike])
    _, kept = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, 2.0, 0.99)
    return kept is not None and int(kept.sum()) >= _SHARED


# brightness is a mean over a square of this share of the photograph's longer side, 5 px at least
_PATCH: Final = 0.01
# what photographs do to the light, nearly: a power
GAMMA: Final = 2.2
# stops by which photographs may differ from those taken next to them; what changes slowly, as the automatic exposure
# of a video does, harmonics take up as the colour of a direction: fox drifts by 0.20 stops in this way
UNEVEN: Final = 0.15
# of full brightness: what is darker, and what lacks as much to white, tells nothing of exposure
_NEARLY_BLACK: Final = 0.06
# points of a photograph that others see too, under which nothing is said of it
_FEWEST: Final = 20
_ROUNDS: Final = 10


def levels_at(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Measure the brightness around places [M, 2] of a photograph, px with pixel centres at +0.5.

    Returns:
        Stops, 0 at white; NaN outside the photograph and where it is nearly black or white. float64 [M]
    """
    height, width = image.shape[:2]
    gray = np.ascontiguousarray(image[:, :, :3]).mean(axis=2, dtype=np.float32) / np.float32(255.0)
    side = max(5, int(_PATCH * max(height, width)) | 1)
    gray = cv2.blur(gray, (side, side))
    found = np.full(len(places), np.nan)
    inside = np.isfinite(places).all(axis=1) & ((places >= 0.0) & (places < [width, height])).all(axis=1)
    columns, rows = places[inside].astype(np.int64).T
    values = gray[rows, columns].astype(np.float64)
    telling = (values > _NEARLY_BLACK) & (values < 1.0 - _NEARLY_BLACK)
    found[np.flatnonzero(inside)[telling]] = GAMMA * np.log2(values[telling])
    return found


@dataclass(frozen=True)
class Exposures:
    """How much brighter each photograph is than the median one."""

    stops: np.ndarray  # NaN where a photograph shares fewer than 20 points with others. float64 [V]
    errors: np.ndarray  # standard errors of these, by how far the points scatter. float64 [V]

    @property
    def drift(self) -> float | None:
        """The standard deviation over the photographs, stops; None where fewer than two have an exposure."""
        return self._beyond_errors(self.stops)

    def unevenness(self, viewmats: np.ndarray) -> float | None:
        """Return the standard deviation of what differs from the median of the four photographs taken nearest, stops.

        None where fewer than five photographs have an exposure.
        """
        known = np.flatnonzero(np.isfinite(self.stops))
        if len(known) <= _NEIGHBOURS:
            return None
        apart = _apart(viewmats[known])
        nearest = np.argsort(apart, axis=1, kind="stable")[:, :_NEIGHBOURS]
        found = np.full(len(self.stops), np.nan)
        found[known] = self.stops[known] - np.median(self.stops[known][nearest], axis=1)
        return self._beyond_errors(found)

    def _beyond_errors(self, values: np.ndarray) -> float | None:
        known = np.isfinite(values)
        if known.sum() < 2:
            return None
        return float(np.sqrt(max(values[known].var() - np.mean(self.errors[known] ** 2), 0.0)))


def _apart(viewmats: np.ndarray) -> np.ndarray:
    """Return how far cameras are apart: in median distances from their middle, plus the angle in radians. [V, V]"""
    centers, axes = camera_centers(viewmats), viewmats[:, 2, :3]
    scale = np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1))
    moved = np.linalg.norm(centers[:, None] - centers, axis=2) / max(float(scale), 1e-12)
    apart = moved + np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    np.fill_diagonal(apart, np.inf)
    return apart


def exposures(levels: Sequence[np.ndarray], seen: Sequence[np.ndarray]) -> Exposures:
    """Tell how much brighter each photograph is than the median one, by the points that several see.

    `levels` are what `levels_at` gives at the points that each sees, `seen` the numbers of these points. [V] of [M]
    """
    values = np.concatenate([*levels, np.zeros(0)])
    photos = np.repeat(np.arange(len(levels)), [len(each) for each in levels])
    points = np.concatenate([*seen, np.zeros(0, np.int64)]).astype(np.int64)
    known = np.isfinite(values)
    values, photos, points = values[known], photos[known], points[known]
    shared = np.bincount(points, minlength=1)[points] > 1
    values, photos = values[shared], photos[shared]
    _, points = np.unique(points[shared], return_inverse=True)
    found, of_points = np.zeros(len(levels)), np.zeros(0)
    for _ in range(_ROUNDS):
        of_points = _medians(values - found[photos], points, int(points.max(initial=-1)) + 1)
        found = _medians(values - of_points[points], photos, len(levels))
    counts = np.bincount(photos, minlength=len(levels))
    scatter = _medians(np.abs(values - found[photos] - of_points[points]), photos, len(levels))
    # of a normal distribution: by the median of distances, and of a median
    errors = 1.4826 * 1.2533 * scatter / np.sqrt(np.maximum(counts, 1))
    found[counts < _FEWEST] = np.nan
    if np.isfinite(found).any():
        found -= np.nanmedian(found)
    return Exposures(found, errors)


def exposures_of(capture: Capture) -> Exposures:
    """Return the exposures of the photographs that the tracks of the points tell of, in the order of the views."""
    views = capture.views
    nothing = np.zeros(0, np.int64)
    seen = [nothing if view.seen is None or not view.was_read else view.seen for view in views]
    levels = []
    for view, rows in zip(views, seen, strict=True):
        points = capture.points[rows] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        depths = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        levels.append(levels_at(view.image, (points @ view.K.T)[:, :2] / depths[:, None]) if len(rows) else np.zeros(0))
    return exposures(levels, seen)


def _medians(values: np.ndarray, groups: np.ndarray, n: int) -> np.ndarray:
    """Return the median of every group; 0 of an empty one. [n]"""
    order = np.lexsort((values, groups))
    counts = np.bincount(groups, minlength=n)
    first = np.cumsum(counts) - counts
    ordered = np.append(values[order], 0.0)
    low, high = ordered[first + np.maximum(counts - 1, 0) // 2], ordered[np.minimum(first + counts // 2, len(values))]
    return np.where(counts > 0, (low + high) / 2.0, 0.0)
