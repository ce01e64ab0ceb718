"""What to tell about a capture that can be trained on but may not be what its owner thinks it is."""

from __future__ import annotations

from collections.abc import Sequence
from os.path import splitext
from pathlib import Path

import numpy as np

from pop_fast.data.capture import View
from pop_fast.data.posed_images import PosedImage
from pop_fast.data.sfm import photographs

__all__ = ["about_other_models", "about_random_points", "about_unplaced"]

# the mean of the cameras' viewing directions, as unit vectors, is this long where they all look about the same way
_SAME_WAY = 0.9
# photographs that a line names
_NAMED = 12


def about_other_models(root: Path, models: Sequence[tuple[Path, int]]) -> list[str]:
    """Tell which models of a capture were passed over for the largest.

    Args:
        root: the capture's folder.
        models: folders and their numbers of images (-1: unreadable), the one that is used first.
    """
    if len(models) < 2:
        return []
    listed = [f"{path.relative_to(root)} ({count if count >= 0 else 'unreadable'})" for path, count in models]
    return [
        f"of {len(models)} COLMAP models the one with the most images is used, {listed[0]}, not {', '.join(listed[1:])}"
    ]


def about_unplaced(folder: Path, shots: Sequence[PosedImage]) -> list[str]:
    """Tell which photographs of a folder have no camera.

    Args:
        folder: where the photographs are.
        shots: what the model lists.
    """
    # by stem too, because a photograph may have been converted since the model was made
    placed = {name for shot in shots for name in (shot.file, splitext(shot.file)[0])}
    names = [path.relative_to(folder).as_posix() for path in photographs(folder)]
    left = [name for name in names if not placed & {name, splitext(name)[0]}]
    if not left:
        return []
    more = f" and {len(left) - _NAMED} more" if len(left) > _NAMED else ""
    return [
        f"{len(names) - len(left)} of {len(names)} photographs in {folder} are placed; the model has no camera for "
        f"{', '.join(left[:_NAMED])}{more}"
    ]


def about_random_points(views: Sequence[View], made: int, wanted: int) -> list[str]:
    """Tell where random points can be expected to be poor: too few, or between cameras that all look away from there.

    Args:
        views: with their cameras.
        made: points that were made.
        wanted: points that should have been.
    """
    fix = "bring points: run pop sfm on the photographs, or name a PLY file as ply_file_path"
    length = float(np.linalg.norm(np.mean([view.viewmat[2, :3] for view in views], axis=0)))
    if length > _SAME_WAY:
        return [
            f"all cameras look about the same way, so the {made:,} random points lie near them, not on the scene; {fix}"
        ]
    if made < wanted:
        return [f"only {made:,} of {wanted:,} random points lie where two cameras look; {fix}"]
    return []
