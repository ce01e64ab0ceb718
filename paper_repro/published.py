"""What a finished training leaves to be published beside the repository: its splat, and two renders of held-out views.

They lie in `<folder>/<scale>/<row>/<scene>_<seed>/`. The result has the SHA-256 of each, by which anybody who gets the
folder from elsewhere can tell whether a picture or a splat is the result's.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from paper_repro.jobs import Job
from pop_fast.errors import PopError

_SPLAT: Final = "splat.spz"


def publish(job: Job, work: Path, folder: Path, last: int) -> dict[str, str]:
    """Write the splat as SPZ, and the first and the last render of a held-out view that the training kept as PNG.

    Args:
        job: what was trained.
        work: its result folder.
        folder: of everything that is to be published.
        last: its last step, counted from 0.

    Returns:
        The names of the files and the SHA-256 of each.

    Raises:
        PopError: the training is not finished, or a file cannot be written; names it.
    """
    from pop_fast.io.formats.files import load_splat_file, save_as
    from pop_fast.io.images import write_png
    from pop_fast.view.report.source import read_view

    place, stored = job.work(folder), load_splat_file(ply_of(work, last))
    save_as(place / _SPLAT, "spz", stored.params, stored.antialiased, stored.frame)
    names = [_SPLAT]
    kept = sorted((work / "report_data").glob(f"val_step{last}_*.npz"))
    for path in dict.fromkeys([*kept[:1], *kept[-1:]]):
        names.append(f"held_out_{path.stem.rpartition('_')[2]}.png")
        write_png(place / names[-1], read_view(path)["render"])
    return {name: file_hash(place / name) for name in names}


def ply_of(work: Path, last: int) -> Path:
    """Return the file of the Gaussians that a finished training ended with.

    Raises:
        PopError: it is absent.
    """
    path = work / "ply" / f"point_cloud_{last}.ply"
    if not path.is_file():
        raise PopError(f"{path}: is absent, so the training is not finished; run the row again")
    return path


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's content in hex digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
