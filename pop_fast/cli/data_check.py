"""`pop data check`: check a capture before training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro

from pop_fast.cli import parse, printable
from pop_fast.data.capture import Source
from pop_fast.errors import CaptureError
from pop_fast.io.heartbeat import bars
from pop_fast.machine import memory_bytes

if TYPE_CHECKING:
    from pop_fast.data.capture import Listing
    from pop_fast.data.photo_quality import CaptureFinding

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, kw_only=True)
class Args:
    """Check a capture before training: lenses, spacing, sizes, EXIF, pairing, masks, points, reprojection, memory;
    and its photographs: blur, exposure, copies. A folder of photographs alone can be looked over too.

    Exit status 0 when nothing stands against training, 1 when something does.
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The capture; photographs of a video or a ZIP archive are extracted next to it, as pop train does."""
    images: str | None = None
    """The photographs are in this folder of the capture."""
    source: Source = "auto"
    """Which list of cameras to check, where there are several; as of pop train."""
    all: bool = False
    """Print every finding, not only the first five of a kind."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "data check")
    from pop_fast.data.unpack import capture_folder

    folder, made = capture_folder(args.capture)
    if made is not None:
        print(f"note: {printable(made)}")
    findings = look_over(folder, args.images, args.source)
    marks = {"ok": "ok", "warn": "LOOK", "bad": "BAD"}
    width = max(len(finding.about) for finding in findings) + 2
    shown: dict[tuple[str, str], int] = {}
    for finding in findings:
        kind = (finding.state, finding.about)
        shown[kind] = shown.get(kind, 0) + 1
        if args.all or shown[kind] <= 5:
            print(printable(f"{marks[finding.state]:<6}{finding.about:<{width}}{finding.text}"))
    hidden = sum(count - 5 for count in shown.values() if count > 5)
    if hidden and not args.all:
        print(f"and {hidden} more of the same kinds; --all prints them")
    bad = sum(finding.state == "bad" for finding in findings)
    verdict = f"{bad} problem{'s' if bad != 1 else ''} to fix before training"
    print(verdict if bad else "ready to train")
    return 1 if bad else 0


def look_over(root: Path, images: str | None = None, source: Source = "auto") -> list[CaptureFinding]:
    """Examine a capture, or photographs alone; all findings in reading order."""
    from pop_fast.data import check_dataset
    from pop_fast.data.load import MODEL, find_listing
    from pop_fast.data.photo_quality import CaptureFinding, about_quality, bad, measure_file, number, warn
    from pop_fast.data.read_images import find_photographs
    from pop_fast.data.sfm import photo_folder, photographs

    listing = find_listing(root, source, images)
    if listing is None:
        folder = photo_folder(root)
        files = photographs(folder)
        shown, damage = _each(files, lambda path: measure_file(path, path.relative_to(folder).as_posix()), lambda p: p)
        damaged = [bad("photographs", problem) for problem in damage]
        return [*check_dataset.about_bare(root, shown), *damaged, *about_quality(shown)]
    if listing.root != root:
        return [CaptureFinding("ok", "poses", f"a block of {listing.root}"), *look_over(listing.root, images)]
    shots, cloud = listing.shots, listing.cloud
    where = listing.path.relative_to(root).as_posix()
    inside = "" if listing.made_from == where else f" in {where}"
    what = f"{len(shots)} {number(len(shots), 'view', 'views')} from the {listing.made_from}{inside}"
    findings = [CaptureFinding("ok" if len(shots) > 1 else "bad", "poses", what)]
    findings += [warn("poses", note) for note in listing.notes]
    findings += check_dataset.about_cameras(shots)
    findings += check_dataset.about_places(shots, cloud)
    findings += check_dataset.about_split(shots)
    findings += check_dataset.about_spacing(shots)
    found = find_photographs(root, shots, images)
    paths = {id(shot): path for shot, path in zip(shots, found, strict=True)}
    photos, damage = _each(
        shots, lambda shot: check_dataset.read_photo(shot, paths[id(shot)], cloud), lambda shot: paths[id(shot)]
    )
    findings += check_dataset.about_photos(photos, root, images)
    findings += [bad("photographs", problem) for problem in damage]
    findings += about_quality([photo.shown for photo in photos if photo.shown is not None])
    findings += check_dataset.about_drift(photos)
    findings += check_dataset.about_masks(photos, root)
    findings += check_dataset.about_points(photos, cloud)
    if not cloud and all(finding.state != "bad" for finding in findings):
        findings += _about_start(root, listing, images)
    if listing.made_from == MODEL:
        findings += check_dataset.about_reprojection(root)
    findings += check_dataset.about_memory(photos, cloud, memory_bytes()[1])
    return findings


def _about_start(root: Path, listing: Listing, images: str | None) -> list[CaptureFinding]:
    """Tell what stands against the random points that training starts from, where the capture brings none."""
    from pop_fast.data.load import RANDOM_POINTS, about_random_points, load_capture, random_points
    from pop_fast.data.photo_quality import bad, warn

    views = load_capture(root, images=images, masks=False, photographs="none", listing=listing).views
    try:
        made = random_points(views)
    except CaptureError as error:
        return [bad("points", str(error))]
    return [warn("points", note) for note in about_random_points(views, len(made), RANDOM_POINTS)]


def _each(items: Sequence[T], read: Callable[[T], R], file_of: Callable[[T], Path | None]) -> tuple[list[R], list[str]]:
    """Read photographs, several at a time, with progress; what was read, and a line for each JPEG with damage."""
    from pop_fast.io.images import in_threads, jpeg_damage

    files = [path for path in map(file_of, items) if path is not None]
    with bars() as progress, jpeg_damage(files) as damage:
        found = in_threads(read, items, "looking at photographs", progress, most=4)
    return found, list(damage.values())
