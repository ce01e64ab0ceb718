"""What each part of the native step has to do at least, and the time that this machine needs for that.

A floor is the larger of two times, with all threads at work all the time: of the part's vector operations, as if each
were a fused multiply-add, of which the processor was seen to do so many a second (`peak.py`); and of the bytes that it
must read and write, at the rate of a pass over an array of that size.

What is counted (`NativeTrainer.counts`, exact): Gaussians, list entries, chunks of sixteen entries, strips of sixteen
pixels that an entry is blended into. What a strip or a chunk costs is read off `pop_fast/compiled`: arithmetic,
comparisons and selections on vectors of sixteen floats; moves, broadcasts and loads are left out. What a Gaussian costs
is the arithmetic in the machine code of the CUDA kernels (`results/sass.json`), whose functions the step calls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from peak import LANES, bytes_per_s, vector_ops_per_s
from record import read_json

SASS: Final = Path(__file__).resolve().parent / "results" / "sass.json"
TILE: Final = 16
# of a strip: f3 x^2 + linear x + constant; what is left of e after its integer, six terms, the integer, the scaling;
# ceiling, floor and stop with their selections, T - T alpha, T alpha
EXPONENT, POWER, TAKE = 2, 9, 8
# whether T went down, sum of weights, three colours; comparison, two selections and the entry's number of dominance
BLENDED, DOMINANCE = 5, 4
# q from v and what is behind (4), three colours, what is behind, dx, G, the ceiling, G dx, six moments
ENTRY_SUMS = 18
# of a chunk: its coefficients in double, two vectors each, and rounded; on each row, its parabolas (3) and their maxima
GATHERED, PARABOLAS, MAXIMA = 42, 3 * TILE, 16 * TILE
# nine sums of sixteen entries by a tree: 15 additions and 30 shuffles each
COLUMNS: Final = 9
TREE = 45 * COLUMNS
# of a window or a pixel and channel: eleven taps down and across of three maps; the quotient and its derivatives; L2
TAPS, QUOTIENT, SLOPE, DIFFERENCE = 66, 32, 7, 8
ADAM = 9  # of a number
# bytes: of a Gaussian's splat and of what else is kept of it, of an entry's splat and slot, of a chunk's T and marks
SPLAT, SEEN, LISTED, CHUNK = 64, 64, 12, TILE * TILE * 4 + TILE * 2
SHORT: Final = 14  # numbers of a Gaussian without the bands beyond the first


# a part in less than this of its floor is not possible: clocks differ by less between two measurements
POSSIBLE: Final = 0.8


@dataclass(frozen=True)
class Work:
    """What a part has to do: operations on vectors of sixteen floats, and bytes moved."""

    operations: float
    bytes: float


def works(row: Mapping[str, Any]) -> dict[str, Work]:
    """Return the work of each part.

    Args:
        row: one of `steps`: Gaussians, size, degree, counts.
    """
    n, degree, did = row["num_gaussians"], row["degree"], row["counts"]
    visible, chunks, entries, walked = did["visible"], did["chunks"], did["entries"], did["walked"]
    rest = 3 * ((degree + 1) ** 2 - 1)
    pixels = row["width"] * row["height"]
    channels = 3 * pixels  # numbers of a picture
    strip = EXPONENT + POWER + TAKE
    forward = did["marked"] * (strip + BLENDED + DOMINANCE) + chunks * (GATHERED + PARABOLAS + MAXIMA)
    back = did["reached"] * (strip + ENTRY_SUMS) + chunks * (GATHERED + PARABOLAS + TREE)
    lists = walked * (SPLAT + LISTED) + chunks * CHUNK
    numbers = SHORT + rest
    adam = n * numbers * 24  # three arrays, read and written
    return {
        "project": Work(
            visible * _of_gaussian(f"project_kernel<{degree}, false>") / LANES,
            4 * (n * SHORT + visible * rest) + n * SEEN + visible * SPLAT,
        ),
        "list": Work(0, visible * (8 * 9 + 2 * SEEN) + entries * LISTED),
        "blend": Work(forward + channels * DIFFERENCE / LANES, lists + 12 * channels),
        "loss": Work(channels * (TAPS + QUOTIENT) / LANES, 28 * channels),
        "image_gradient": Work(channels * (TAPS + SLOPE) / LANES, 24 * channels),
        "transpose": Work(back, lists + 4 * COLUMNS * entries + 4 * channels),
        "update": Work(
            (visible * _of_gaussian(f"update_kernel<{degree}>") + (n - visible) * numbers * ADAM) / LANES,
            adam + n * SEEN + 4 * COLUMNS * entries,
        ),
    }


def floors(row: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return each part's time, its floor, what bounds that, and their ratio.

    Raises:
        SystemExit: a part took far less than its floor, so that the peaks are not what this processor can do.
    """
    found = {}
    for part, work in works(row).items():
        by = {
            "operations": 1e3 * work.operations / vector_ops_per_s(row["threads"]),
            "bytes": 1e3 * work.bytes / bytes_per_s(work.bytes, row["threads"]),
        }
        bound = max(by, key=lambda name: by[name])
        ms = row["parts_ms"][part]
        found[part] = {"ms": ms, "floor_ms": by[bound], "bound": bound, "ratio": ms / by[bound]}
        if ms < POSSIBLE * by[bound]:
            raise SystemExit(
                f"{part} took {ms:.2f} ms, and {bound} alone need {by[bound]:.2f}: peak.py measures too little"
            )
    return found


def _of_gaussian(kernel: str) -> int:
    """Return the arithmetic instructions that a kernel spends on a Gaussian, in machine code for sm_90."""
    found = [k for k in read_json(SASS)["kernels"] if k["kernel"] == kernel and k["arch"] == "sm_90"]
    classes = found[0]["by_class"]
    return int(classes["float"] + classes.get("special", 0))
