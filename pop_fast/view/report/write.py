"""Write the report into a result folder."""

from __future__ import annotations

from pathlib import Path

from pop_fast.io.atomic import write_atomically
from pop_fast.view.report.page import page
from pop_fast.view.report.source import read_result


def write_report(result_dir: str | Path) -> Path:
    """Write report.html into a result folder, from the files in it alone.

    Returns:
        The page's path.

    Raises:
        PopError: the folder is not a result of `pop train`, or one of its files cannot be read.
    """
    folder = Path(result_dir)
    # a name that is no text is shown with escapes
    html = page(read_result(folder)).encode("utf-8", "backslashreplace")
    target = folder / "report.html"
    write_atomically(target, lambda file: file.write(html))
    return target
