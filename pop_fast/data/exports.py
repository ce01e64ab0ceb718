"""Cameras that other programs have exported beside the photographs: which there are, and how each is read."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal, TypeAlias

from pop_fast.data.metashape import find_metashape, read_metashape
from pop_fast.data.polycam import find_polycam, read_polycam
from pop_fast.data.posed_images import PosedImage, SparsePoints
from pop_fast.data.realitycapture import find_realitycapture, read_realitycapture
from pop_fast.data.transforms import points_beside

__all__ = ["EXPORTS", "Program", "find_export", "read_export"]

Program: TypeAlias = Literal["polycam", "metashape", "realitycapture"]
EXPORTS: Final = {
    "polycam": ("Polycam export", find_polycam, "keyframes/corrected_cameras or keyframes/cameras"),
    "metashape": ("Metashape cameras", find_metashape, "cameras as Agisoft XML"),
    "realitycapture": (
        "RealityCapture cameras",
        find_realitycapture,
        'CSV file of "Internal/External camera parameters"',
    ),
}


def find_export(root: Path, program: str = "auto") -> tuple[str, Path] | None:
    """Find what a program has exported: the program and its file or folder, or None.

    Args:
        root: the capture.
        program: look for its export alone; "auto" takes the first that is there.
    """
    for name, (_, find, _) in EXPORTS.items():
        found = find(root) if program in ("auto", name) else None
        if found is not None:
            return name, found
    return None


def read_export(
    program: str, path: Path, root: Path, images: str | None = None
) -> tuple[list[PosedImage], SparsePoints | None, list[str]]:
    """Read an export.

    Args:
        program: one of `EXPORTS`.
        path: as `find_export` found it.
        root: the capture.
        images: the folder in it with the photographs; by default `images`, or the capture itself where there is none.

    Returns:
        The shots; the points of `sparse_pc.ply` or `points3D.ply` in the capture, or None; notes.

    Raises:
        CaptureError: names the file, the field and what it should be.
    """
    folder = images or ("images" if (root / "images").is_dir() else "")
    if program == "polycam":
        return read_polycam(path, root), points_beside(root), []
    if program == "metashape":
        shots, notes = read_metashape(path, root, folder)
        return shots, points_beside(root), notes
    return read_realitycapture(path, root, folder), points_beside(root), []
