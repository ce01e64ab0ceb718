"""What the claims share: results of one row and scene put together, comparisons with their noise, and verdicts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot, log, sqrt
from statistics import fmean, stdev
from typing import Final, Literal, NamedTuple

from paper_repro.paper import Paper
from paper_repro.results import Result
from paper_repro.tables import setting

__all__ = [
    "BLUR_STOP",
    "DATASETS",
    "DENSITY_STOP",
    "STEPS",
    "Claim",
    "Evidence",
    "Group",
    "Groups",
    "Verdict",
    "at_least",
    "claim",
    "decay",
    "difference",
    "groups",
    "ids",
    "implied_rates",
    "implied_shares",
    "paper_ratios",
]

Verdict = Literal["holds", "does not hold", "holds in part", "not decided"]
# the paper's schedule: the blur rule ends, density control and the POP term end, the training ends
BLUR_STOP, DENSITY_STOP, STEPS = 7_000, 15_000, 30_000
DATASETS: Final = ("Mip-NeRF 360", "Tanks & Temples", "Deep Blending")


@dataclass(frozen=True)
class Group:
    """The runs of one row on one scene, over their seeds."""

    runs: tuple[Result, ...]

    def mean(self, get: Callable[[Result], float]) -> float:
        """Average a quantity over the seeds."""
        return fmean(get(r) for r in self.runs)

    def error(self, get: Callable[[Result], float]) -> float:
        """Give the standard error of that mean; 0 with one seed, which has no spread to tell."""
        if len(self.runs) < 2:
            return 0.0
        return stdev(get(r) for r in self.runs) / sqrt(len(self.runs))

    @property
    def n(self) -> float:
        """Gaussians."""
        return self.mean(lambda r: r.num_gaussians)

    @property
    def psnr(self) -> float:
        """PSNR, dB."""
        return self.mean(lambda r: r.psnr)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the runs."""
        return tuple(r.run for r in self.runs)


Groups = Mapping[str, Mapping[str, Group]]


@dataclass(frozen=True)
class Evidence:
    """What one scene says.

    Attributes:
        scene: where.
        says: the numbers.
        holds: whether they bear the claim out; None where they do not decide.
        runs: ids of the runs that they come from.
    """

    scene: str
    says: str
    holds: bool | None
    runs: tuple[str, ...]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, or a question about it, and what the runs of one scale say.

    Attributes:
        id: short, for tables and links.
        says: the claim.
        paper: the paper's own numbers for it.
        holds_if: what is asked of a scene.
        verdict: over the scenes that decide.
        evidence: by scene.
    """

    id: str
    says: str
    paper: str
    holds_if: str
    verdict: Verdict
    evidence: tuple[Evidence, ...]

    @property
    def where(self) -> str:
        """Say on which scenes it holds, and on which it does not."""
        yes = [e.scene for e in self.evidence if e.holds]
        no = [e.scene for e in self.evidence if e.holds is False]
        parts = ([f"on {', '.join(yes)}"] if yes else []) + ([f"not on {', '.join(no)}"] if no else [])
        return "; ".join(parts) or "no runs decide"


def claim(id: str, says: str, paper: str, holds_if: str, evidence: Iterable[Evidence]) -> Claim:
    """Put a claim together; its verdict is over the scenes that decide."""
    found = tuple(evidence)
    decided = {e.holds for e in found if e.holds is not None}
    verdicts: dict[frozenset[bool], Verdict] = {
        frozenset(): "not decided",
        frozenset({True}): "holds",
        frozenset({False}): "does not hold",
        frozenset({True, False}): "holds in part",
    }
    return Claim(id, says, paper, holds_if, verdicts[frozenset(decided)], found)


def groups(results: Iterable[Result]) -> Groups:
    """Sort results of one scale by scene and row."""
    found: dict[str, dict[str, list[Result]]] = {}
    for r in results:
        found.setdefault(r.scene, {}).setdefault(r.row, []).append(r)
    return {
        scene: {row: Group(tuple(sorted(runs, key=lambda r: r.seed))) for row, runs in rows.items()}
        for scene, rows in sorted(found.items())
    }


def difference(a: Group, b: Group, get: Callable[[Result], float]) -> tuple[float, float]:
    """Give the difference of two means and its standard error."""
    return a.mean(get) - b.mean(get), hypot(a.error(get), b.error(get))


def at_least(value: float, bound: float, error: float) -> bool | None:
    """Say whether a value is at least a bound, or None where it lies within one standard error of it."""
    return None if abs(value - bound) < error else value >= bound


def ids(found: Sequence[Group]) -> tuple[str, ...]:
    """Give the ids of all runs of several groups."""
    return tuple(id for group in found for id in group.ids)


class Decay(NamedTuple):
    """What became of N from the end of the blur window to the end of density control.

    Attributes:
        closing: N as the blur window closes.
        kept: the share of it that is left as density control ends.
        steps: from the one to the other.
    """

    closing: float
    kept: float
    steps: int

    @property
    def rate(self) -> float:
        """The rate per 1,000 steps: a shortened schedule scales neither learning rates nor the weight of the prior."""
        return -log(self.kept) / (self.steps / 1000)


def decay(run: Result) -> Decay | None:
    """Read the decay of N off the curve of a run, or None without a curve."""
    steps = setting(run, "max_steps") or float(STEPS)
    closes = setting(run, "blur_stop_iter") or steps * BLUR_STOP / STEPS
    ends = setting(run, "refine_stop_iter") or steps * DENSITY_STOP / STEPS
    closing, left = run.at(round(closes)), run.at(round(ends))
    if closing is None or left is None or min(closing, left) <= 0.0 or ends <= closes:
        return None
    return Decay(closing, left / closing, round(ends) - round(closes))


def paper_ratios(published: Paper, row: str, base: str) -> tuple[float, ...]:
    """Give N of a row over N of another in the paper's ablations, by data set."""
    return tuple(
        published.ablation(row, d, "num_gaussians_k") / published.ablation(base, d, "num_gaussians_k") for d in DATASETS
    )


def implied_shares(published: Paper) -> tuple[float, ...]:
    """Give what the paper's tables imply to be left at step 15,000 of N(7,000), by data set.

    A window that lasts until density control ends shows the count at which the blur rule saturates; a shorter one
    reaches about as much, and POP takes it down from there.
    """
    return paper_ratios(published, "pop", "blur_3k_15k")


def implied_rates(published: Paper) -> tuple[float, ...]:
    """Give the rates of decay per 1,000 steps that `implied_shares` comes to, by data set."""
    return tuple(Decay(1.0, share, DENSITY_STOP - BLUR_STOP).rate for share in implied_shares(published))
