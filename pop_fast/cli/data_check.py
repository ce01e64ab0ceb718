"""`pop data check`: look a capture over before training."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pop_fast.cli.arguments import parse

if TYPE_CHECKING:
    from pop_fast.data.check_dataset import Finding


@dataclass(frozen=True, kw_only=True)
class Args:
    """Look a capture over before training: lenses, sizes, EXIF, pairing, masks, points, reprojection, memory.

    Exit status 0 when nothing stands against training, 1 when something does.
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The capture."""
    all: bool = False
    """Print every finding, not only the first five of a kind."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "data check")
    findings = look_over(args.capture)
    marks = {"ok": "ok", "warn": "LOOK", "bad": "BAD"}
    width = max(len(finding.about) for finding in findings) + 2
    shown: dict[tuple[str, str], int] = {}
    for finding in findings:
        kind = (finding.state, finding.about)
        shown[kind] = shown.get(kind, 0) + 1
        if args.all or shown[kind] <= 5:
            print(f"{marks[finding.state]:<6}{finding.about:<{width}}{finding.text}")
    hidden = sum(count - 5 for count in shown.values() if count > 5)
    if hidden and not args.all:
        print(f"and {hidden} more of the same kinds; --all prints them")
    bad = sum(finding.state == "bad" for finding in findings)
    print(f"{bad} problem{'s' if bad != 1 else ''} stand against training" if bad else "ready to train")
    return 1 if bad else 0


def look_over(root: Path) -> list[Finding]:
    """Examine a capture; all findings in reading order."""
    from pop_fast.cli.doctor import memory_bytes
    from pop_fast.cli.progress import bars
    from pop_fast.data import check_dataset
    from pop_fast.io.jpeg import jpeg_damage

    made_from, shots, cloud = check_dataset.read_listing(root)
    posed = f"{len(shots)} views from the {made_from}"
    findings = [check_dataset.Finding("ok" if len(shots) > 1 else "bad", "poses", posed)]
    findings += check_dataset.about_cameras(shots)
    with bars() as progress, ThreadPoolExecutor(max_workers=4) as pool:
        photos: list[check_dataset.Photo] = []
        for photo in pool.map(lambda shot: check_dataset.read_photo(root, shot), shots):
            photos.append(photo)
            progress("looking at photographs", len(photos), len(shots))
    with jpeg_damage([photo.path for photo in photos if photo.path is not None]) as damage:
        findings += check_dataset.about_photos(photos, root)
    findings += [check_dataset.Finding("bad", "photographs", message) for message in damage.values()]
    findings += check_dataset.about_masks(photos, root)
    findings += check_dataset.about_points(shots, cloud)
    findings += check_dataset.about_reprojection(root)
    findings += check_dataset.about_memory(photos, cloud, memory_bytes()[1])
    return findings
