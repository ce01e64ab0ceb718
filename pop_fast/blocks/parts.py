"""The parts of a run in blocks, each a process of its own: trainings of blocks, and merges; and where each one writes.

Round 0 trains every block by itself. The rounds after it begin with the merged Gaussians: every block trains those of
its own core, among all others as they are. A round's blocks do not wait for one another; its merge waits for all of
them, and the next round for the merge.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pop_fast.blocks.plan import FOLDER, Job

__all__ = ["Part", "block_folder", "core_of", "marker_of", "parts_of", "result_of", "round_folder"]


@dataclass(frozen=True)
class Part:
    """A training of a block, or a merge.

    Attributes:
        round: which it belongs to, from 0.
        block: which is trained; None merges all.
        last: whether it is the last merge, which writes the run's result.
    """

    round: int
    block: str | None
    last: bool = False

    @property
    def name(self) -> str:
        """Return its name in the workflow."""
        own = "merge" if self.block is None else f"block_{self.block}"
        return own if self.last or (self.round == 0 and self.block) else f"round_{self.round}_{own}"

    def words(self, folder: Path) -> list[str]:
        """Return the words after `pop blocks` that do it."""
        own = ["merge", str(folder)] if self.block is None else ["train", str(folder), self.block]
        plain = self.last or (self.round == 0 and self.block is not None)
        return own if plain else [*own, "--round", str(self.round)]

    def marker(self, folder: Path) -> Path:
        """Return the file that says that it is done."""
        return marker_of(folder, self.block, None if self.last else self.round)


def parts_of(job: Job) -> list[Part]:
    """List the parts of a run, in an order in which they can be done."""
    found = []
    for number in range(job.rounds + 1):
        found += [Part(number, name) for name in job.names]
        found.append(Part(number, None, last=number == job.rounds))
    return found


def round_folder(folder: Path, number: int) -> Path:
    """Return the folder of a round: of what its merge leaves to the next one and, from round 1, of its blocks."""
    return folder / FOLDER / f"round_{number}"


def block_folder(folder: Path, name: str, number: int = 0) -> Path:
    """Return the folder of what a block is trained on or, from round 1, of what it is trained to in a round."""
    return (round_folder(folder, number) if number else folder / FOLDER) / name


def result_of(folder: Path, name: str, number: int = 0) -> Path:
    """Return the result folder of a block of the run in `folder`, in a round."""
    return block_folder(folder, name, number) / "result"


def core_of(folder: Path, name: str, number: int) -> Path:
    """Return the file of the merged Gaussians in a block's core after a round that is not the last."""
    return round_folder(folder, number) / f"{name}.pt"


def marker_of(folder: Path, name: str | None, number: int | None = 0) -> Path:
    """Return the file that says that a block is trained in a round or, of no block, that all are merged.

    Args:
        folder: the run's.
        name: of the block, or None.
        number: the round; None is the last one, of the merge.
    """
    if name is not None:
        return block_folder(folder, name, number or 0) / "trained"
    return folder / FOLDER / "merged" if number is None else round_folder(folder, number) / "merged"
