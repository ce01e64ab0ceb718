"""Captures of kinds that are not among the four: what `pop train` makes of them unasked, and what its report says.

    python benchmarks/kinds.py --json benchmarks/results/kinds.json             all of them
    python benchmarks/kinds.py room walk --json benchmarks/results/kinds.json   some
    python benchmarks/kinds.py --show out/kinds                                 write the photographs, train nothing
    python benchmarks/kinds.py --json benchmarks/results/kinds.json --table     lay the rows out

A kind is boxes with painted sides, photographed as a person would: an object from all sides, a room from its middle, a
facade along a street, a walk as a video. Of the last four kinds the photographs have one fault that is known, and the
report has to name it. Cameras are searched for from the photographs alone. A row that the JSON already holds is
replaced.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import cv2
import numpy as np

from benchmarks.estimates import BY_PROCESSOR
from benchmarks.record import machine, read_json, write_json
from pop_fast.children import module_command
from pop_fast.io.images import write_png
from pop_fast.train.results import ResultFolder
from pop_fast.view.report.source import read_result

WIDTH: Final = 480
HEIGHT: Final = 360
# of processor time, so that other programs do not count
MINUTES: Final = "2"
# samples of a pixel along each axis
_SAMPLES: Final = 2
_PAINTS: Final = 12
_TEXELS: Final = 2048


@dataclass(frozen=True)
class Box:
    """A box, or with `inside` the inner sides of one. Middle and edges, world units."""

    middle: tuple[float, float, float]
    size: tuple[float, float, float]
    paint: int
    inside: bool = False


@dataclass(frozen=True)
class Photograph:
    """A camera, what stands before it, and how many stops brighter than the others it was taken."""

    viewmat: np.ndarray
    boxes: tuple[Box, ...]
    stops: float = 0.0


@dataclass(frozen=True)
class Kind:
    """Photographs, and of each finding of the report's verdict that is decided the kinds that it may be of.

    `said` are words that a finding's text has.
    """

    title: str
    photographs: Callable[[], list[Photograph]]
    expected: Mapping[str, tuple[str, ...]]
    said: Mapping[str, str]
    video: bool = False


def look_at(center: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """Stand at a point, hold the camera level and look at another. World is z up; OpenCV axes. float64 [4, 4]"""
    forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return viewmat


def _paints() -> np.ndarray:
    """Make the paints: clouds of colour with patches in them, no two places alike. uint8 [paint, S, S, 3]"""
    generator, made = np.random.default_rng(7), []
    for _ in range(_PAINTS):
        low, high = generator.uniform(0.05, 0.45, 3), generator.uniform(0.5, 0.95, 3)
        mixed = np.zeros((_TEXELS, _TEXELS), np.float32)
        for cells in (4, 16, 64, 128, 256, 512):
            coarse = generator.random((cells, cells)).astype(np.float32)
            mixed += cv2.resize(coarse, (_TEXELS, _TEXELS), interpolation=cv2.INTER_CUBIC) * cells**-0.25
        share = (mixed - mixed.min()) / np.ptp(mixed)
        paint = low + (high - low) * share[..., None]
        for _ in range(1_500):
            row, column = generator.integers(0, _TEXELS, 2)
            height, width = generator.integers(4, 40, 2)
            paint[row : row + height, column : column + width] = generator.uniform(0.0, 1.0, 3)
        made.append(np.rint(255.0 * paint).astype(np.uint8))
    return np.stack(made)


def rendered(photograph: Photograph, paints: np.ndarray) -> np.ndarray:
    """Take the picture: of each ray the nearest side's paint. uint8 [H, W, 3]"""
    rows, columns = np.mgrid[: HEIGHT * _SAMPLES, : WIDTH * _SAMPLES].astype(np.float32)
    focal = 0.9 * WIDTH
    x, y = (columns + 0.5) / _SAMPLES - 0.5 * WIDTH, (rows + 0.5) / _SAMPLES - 0.5 * HEIGHT
    R = photograph.viewmat[:3, :3]
    d = np.stack([x / focal, y / focal, np.ones_like(x)]).reshape(3, -1).T @ R
    o = -R.T @ photograph.viewmat[:3, 3]
    nearest, color = np.full(len(d), np.inf), np.full((len(d), 3), 0.8, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / d
        for box in photograph.boxes:
            half = np.array(box.size) / 2.0
            start = (o - box.middle) * inverse
            reach = np.abs(inverse) * half
            enter, leave = (-start - reach).max(axis=1), (-start + reach).min(axis=1)
            t = leave if box.inside else enter
            hit = np.flatnonzero((enter < leave) & (t > 1e-3) & (t < nearest))
            nearest[hit] = t[hit]
            color[hit] = _painted(box, o + t[hit, None] * d[hit], paints)
    picture = color.reshape(HEIGHT, _SAMPLES, WIDTH, _SAMPLES, 3).mean(axis=(1, 3)) * 2.0**photograph.stops
    return np.rint(255.0 * np.clip(picture, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)


def _painted(box: Box, points: np.ndarray, paints: np.ndarray) -> np.ndarray:
    q = (points - box.middle) / (np.array(box.size) / 2.0)
    axis = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    side = 2 * axis + (q[rows, axis] > 0.0)
    u = np.where(axis == 0, points[:, 1], points[:, 0])
    v = np.where(axis == 2, points[:, 1], points[:, 2])
    # a paint is laid over a side once, so that nothing repeats
    texels = (np.stack([u, v]) * min(256.0, _TEXELS / max(box.size)) + 997.0 * side).astype(int) % _TEXELS
    # sides of one box differ in paint and, as though by light, in brightness
    shade = np.array([0.75, 0.85, 0.7, 0.9, 0.6, 1.0], np.float32)[side] / 255.0
    return paints[(box.paint + side) % _PAINTS, texels[1], texels[0]] * shade[:, None]


_GROUND: Final = (Box((0, 0, -0.1), (14, 14, 0.2), 0), Box((0, 0, 3.0), (14, 14, 7.0), 6, inside=True))
_OBJECT: Final = (
    *_GROUND,
    Box((0, 0, 0.25), (1.0, 1.0, 0.5), 11),
    Box((0.1, 0.05, 0.75), (0.5, 0.6, 0.5), 3),
    Box((-0.7, 0.5, 0.2), (0.4, 0.3, 0.4), 15),
    Box((0.8, -0.6, 0.15), (0.3, 0.5, 0.3), 19),
)


def _ring(count: int, height: float, radius: float, first: float = 0.0) -> list[np.ndarray]:
    angles = np.radians(first + 360.0 * np.arange(count) / count)
    return [look_at((radius * np.cos(a), radius * np.sin(a), height), (0.0, 0.0, 0.4)) for a in angles]


def _around(boxes: tuple[Box, ...] = _OBJECT) -> list[Photograph]:
    return [Photograph(v, boxes) for v in (*_ring(24, 1.0, 2.2), *_ring(20, 1.9, 2.0, first=9.0))]


def _moved() -> list[Photograph]:
    """The object, next to which something the size of a cat stands in another place in every photograph."""
    generator = np.random.default_rng(3)
    return [
        Photograph(one.viewmat, (*one.boxes, Box((*generator.uniform(-1.3, 1.3, 2), 0.2), (0.35, 0.35, 0.4), 8)))
        for one in _around()
    ]


def _drifting() -> list[Photograph]:
    generator = np.random.default_rng(4)
    return [Photograph(one.viewmat, one.boxes, float(generator.uniform(-0.6, 0.0))) for one in _around()]


def _room() -> list[Photograph]:
    boxes = (
        Box((0, 0, 1.3), (5.0, 4.2, 2.6), 4, inside=True),
        Box((2.0, 1.2, 0.4), (0.8, 1.4, 0.8), 9),
        Box((-1.9, 1.5, 0.9), (0.9, 0.6, 1.8), 13),
        Box((-1.8, -1.4, 0.25), (1.2, 0.9, 0.5), 17),
        Box((1.6, -1.6, 0.6), (0.6, 0.5, 1.2), 21),
        Box((0.2, 1.9, 1.0), (1.0, 0.2, 0.7), 2),
    )
    taken = []
    for height, tilt in ((1.2, -0.1), (1.6, -0.45)):
        for angle in np.radians(np.arange(0.0, 360.0, 15.0)):
            c, s = np.cos(angle), np.sin(angle)
            # from the other side of the middle, so that neighbours look at a wall from places that differ
            taken.append(Photograph(look_at((-0.9 * c, -0.8 * s, height), (2.0 * c, 2.0 * s, height + tilt)), boxes))
    return taken


def _facade() -> list[Photograph]:
    places = itertools.product((1.2, 3.0), (-5.4, -4.0, -2.5, -1.1, 0.4, 1.8, 3.2, 4.7))
    windows = [Box((x, 0.1, z), (0.7, 0.3, 0.9), 5 + (i % 9)) for i, (z, x) in enumerate(places)]
    boxes = (Box((0, 0.5, 2.5), (14, 1, 5), 1), Box((0, -5, -0.1), (24, 14, 0.2), 0), *windows)
    return [
        Photograph(look_at((x, -4.0 - 0.4 * row, 1.5 + 0.9 * row), (x + 0.3, 0.0, 1.7 + 0.4 * row)), boxes)
        for row in range(2)
        for x in np.linspace(-4.2, 4.2, 18) + 0.2 * row
    ]


def _walk() -> list[Photograph]:
    """A walk down a lane between boxes, at 15 pictures a second, the camera swaying as a walker's does."""
    generator = np.random.default_rng(5)
    boxes = [Box((0, 5, -0.1), (14, 30, 0.2), 0), Box((0, 6, 3.0), (16, 34, 9.0), 6, inside=True)]
    for i in range(9):
        for side in (-1.0, 1.0):
            height = float(generator.uniform(0.5, 1.6))
            place = (side * float(generator.uniform(1.3, 2.2)), 1.3 * i, height / 2)
            boxes.append(Box(place, (float(generator.uniform(0.4, 0.9)), 0.6, height), int(generator.integers(24))))
    taken = []
    for i in range(120):
        y, sway = -2.0 + 6.0 * i / 120, 0.35 * np.sin(i / 9.0)
        taken.append(Photograph(look_at((sway, y, 1.3), (-0.6 * sway, y + 4.0, 0.9)), tuple(boxes)))
    return taken


_SOUND: Final = dict.fromkeys(("Quality", "Fit", "Exposure", "Photographs"), ("good",))
KINDS: Final[dict[str, Kind]] = {
    "object": Kind("an object, 44 photographs all round", _around, _SOUND, {}),
    "room": Kind("a room, 48 photographs from its middle", _room, _SOUND, {}),
    "facade": Kind("a facade, 36 photographs along it", _facade, _SOUND, {}),
    "walk": Kind("a walk, a video of 8 seconds", _walk, _SOUND, {}, video=True),
    "moved": Kind(
        "the object, next to which something moved",
        _moved,
        {"Fit": ("look", "bad"), "Exposure": ("good",)},
        {"Fit": "moved"},
    ),
    "drift": Kind("the object, exposures up to 0.6 stops apart", _drifting, _SOUND, {"Exposure": "Learned"}),
    "few": Kind(
        "the object, 7 photographs",
        lambda: [Photograph(v, _OBJECT) for v in _ring(7, 1.3, 2.1)],
        {"Photographs": ("look", "bad"), "Exposure": ("good",)},
        {"Photographs": "few"},
    ),
    "far apart": Kind(
        "the object, 14 photographs 26 degrees apart",
        lambda: [Photograph(v, _OBJECT) for v in _ring(14, 1.3, 2.1)],
        {"Photographs": ("look", "bad"), "Exposure": ("good",)},
        {"Photographs": "apart"},
    ),
}


def write_kind(kind: Kind, folder: Path) -> Path:
    """Write what a person would hand over: a folder of photographs, or a video."""
    paints = _paints()
    pictures = [rendered(photograph, paints) for photograph in kind.photographs()]
    if not kind.video:
        (folder / "photos").mkdir(parents=True)
        for i, picture in enumerate(pictures):
            write_png(folder / "photos" / f"IMG_{2041 + i}.png", picture)
        return folder / "photos"
    folder.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(folder / "walk.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 15.0, (WIDTH, HEIGHT))
    for picture in pictures:
        video.write(picture[..., ::-1])
    video.release()
    return folder / "walk.mp4"


def measured(kind: Kind) -> dict[str, Any]:
    """Train as a user would, and read the verdict."""
    with TemporaryDirectory() as folder:
        handed = write_kind(kind, Path(folder) / "capture")
        out = Path(folder) / "run"
        words = [BY_PROCESSOR, str(handed), "--minutes", MINUTES, "--out", str(out), "--threads", "1"]
        said = subprocess.run(
            module_command("benchmarks.estimates", *words), capture_output=True, text=True, check=False
        )
        if said.returncode:
            return {"failed": said.stderr.strip().splitlines()[-1].replace(folder, "")}
        report = read_result(out)
        stats = ResultFolder(out).read_stats("val", report.max_steps - 1) or {}
    return {
        "steps": report.max_steps,
        "psnr": round(stats["psnr"], 2),
        "ssim": round(stats["ssim"], 3),
        "gaussians": stats["num_GS"],
        "verdict": {found.about: [found.kind, found.text.replace(folder, "")] for found in report.verdict},
    }


def wrong(kind: Kind, row: Mapping[str, Any]) -> list[str]:
    """Say what of a row is not as it was made; empty where all is."""
    if "failed" in row:
        return [row["failed"]]
    verdict = row["verdict"]
    missed = [f"{about}: {verdict[about][0]}" for about, may in kind.expected.items() if verdict[about][0] not in may]
    return missed + [
        f"{about} does not say '{word}'" for about, word in kind.said.items() if word not in verdict[about][1]
    ]


def table_of(known: Mapping[str, Any]) -> str:
    """Lay the rows of a JSON file out."""
    lines = ["| photographs | steps | held out | Gaussians | the report's verdict |", "| --- | --- | --- | --- | --- |"]
    for name, kind in KINDS.items():
        if name not in known:
            continue
        row = known[name]
        if "failed" in row:
            lines.append(f"| {kind.title} | | | | failed: {row['failed']} |")
            continue
        off = wrong(kind, row)
        found = ", ".join(f"{about} {grade}" for about, (grade, _) in row["verdict"].items() if grade != "good")
        found = (found or "all good") + (f"; **not as it is: {'; '.join(off)}**" if off else "")
        held_out = f"{row['psnr']:.2f} dB, {row['ssim']:.3f}"
        lines.append(f"| {kind.title} | {row['steps']:,} | {held_out} | {row['gaussians']:,} | {found} |")
    return "\n".join(lines)


def main(words: list[str] | None = None) -> int:
    """Measure, a row for each kind."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", choices=[*KINDS, []], help="all without any")
    parser.add_argument("--json", type=Path, help="keep the rows here")
    parser.add_argument("--show", type=Path, help="write the photographs into this folder and stop")
    parser.add_argument("--table", action="store_true", help="lay the rows of --json out and stop")
    args = parser.parse_args(words)
    known = {} if args.json is None else read_json(args.json)
    for name in [] if args.table else args.kinds or KINDS:
        if args.show is not None:
            print(write_kind(KINDS[name], args.show / name))
            continue
        row = {"machine": machine(), **measured(KINDS[name])}
        print(f"{name}: {row}", flush=True)
        if args.json is not None:
            # another call may have written meanwhile
            write_json(args.json, {"machine": row["machine"], **read_json(args.json), name: row})
    if args.table:
        print(table_of(known))
    return 0


if __name__ == "__main__":
    sys.exit(main())
