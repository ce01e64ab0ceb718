"""Whether cameras can be found for photographs at all, told before the minutes of searching.

Training and `pop data check` ask here, so that both judge alike. The judgement is on the safe side: only photographs
that show nothing, and small sets of which no two show the same thing, are refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final

import cv2
import numpy as np

from pop_fast.data.finding import Finding, number
from pop_fast.data.photo_quality import Shown, some

__all__ = ["FIX", "about_mixed_sizes", "about_use"]

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


def about_use(shown: Sequence[Shown]) -> Iterator[Finding]:
    """Tell what stands against finding cameras: photographs that show nothing, or nothing in common.

    Args:
        shown: what was measured of the photographs, without those that could not be read.
    """
    plain = [one.name for one in shown if float(one.thumb.std()) < _PLAIN]
    if plain:
        left = len(shown) - len(plain)
        are = number(len(plain), "is of one colour all over", "are of one colour all over")
        text = f"{len(plain)} of {len(shown)} photographs {are} (black, white or covered), {some(plain)}"
        if left < 2:
            yield Finding("bad", "photographs", f"no cameras could be found: {text}; {FIX}")
            return
        yield Finding("warn", "photographs", f"{text}; leave {number(len(plain), 'it', 'them')} out")
    useful = [one for one in shown if float(one.thumb.std()) >= _PLAIN]
    comparable = 2 <= len(useful) <= _COMPARED and all(len(one.features[0]) >= _ENOUGH for one in useful)
    if comparable and not any(_share_something(one, other) for one, other in combinations(useful, 2)):
        text = f"no two of the {len(useful)} photographs show the same thing"
        yield Finding("bad", "photographs", f"no cameras could be found: {text}; {FIX}")


def about_mixed_sizes(shown: Sequence[Shown]) -> Finding | None:
    """Tell that photographs of several sizes are taken to be of several cameras; None where they are of one."""
    sizes = Counter(one.size for one in shown)
    if len(sizes) < 2:
        return None
    listed = ", ".join(f"{count} of {w}x{h} px" for (w, h), count in sizes.most_common(3))
    more = f" and {len(sizes) - 3} more" if len(sizes) > 3 else ""
    text = f"mixed cameras: the photographs have {len(sizes)} sizes ({listed}{more}), and each is taken as another lens"
    return Finding("warn", "cameras", f"{text}; one camera, not zoomed or cropped, is placed more surely")


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
