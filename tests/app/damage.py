"""Ways to damage a capture, and what a clean refusal looks like."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.app.conftest import Outcome

Damage = Callable[[Path], None]


def says(outcome: Outcome, *parts: str) -> None:
    """Assert that the outcome is one clean line of error with all of these parts."""
    assert outcome.status == 2, outcome
    lines = outcome.err.strip().splitlines()
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith("pop: error: ")
    for part in parts:
        assert part in lines[0], (part, lines[0])


def photo(folder: Path, number: int = 0) -> Path:
    return folder / "images" / f"view_{number:03d}.png"


def truncate(path: Path, share: float = 0.5) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def patch_bytes(path: Path, at: int, data: bytes) -> None:
    content = bytearray(path.read_bytes())
    content[at : at + len(data)] = data
    path.write_bytes(bytes(content))


def contents(folder: Path) -> dict[Path, bytes]:
    """Read every file under a folder, to see that nothing changed."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
