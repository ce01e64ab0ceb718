"""Build your own Gaussian splatting, stage by stage, judged by the conformance kit.

In reading order: `splat` (the whole of it in one file), `course` (the thirteen stages), `stubs` (the files to fill in),
`student` (the oracle with a student's functions in it), `judge` and `mistakes` (what a broken law says to a student),
`progress` (the map and the picture), `training`.
"""

from __future__ import annotations

from importlib.util import find_spec

__all__ = ["needs_of_judging"]


def needs_of_judging() -> None:
    """Make sure that laws can be tried here.

    Raises:
        ValueError: Hypothesis is not installed; the message says how to get it.
    """
    if find_spec("hypothesis") is None or find_spec("pytest") is None:
        raise ValueError("judging needs hypothesis and pytest: pip install 'pop-ref[conformance]'")
