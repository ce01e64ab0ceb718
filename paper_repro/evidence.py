"""What the claims share: the runs of a scene, its verdict, under which conditions, and the runs that would decide it.

A claim asks one or more comparisons of every scene. It holds on a scene when all of them hold beyond the noise of the
seeds, and does not when one of them fails beyond it; anything else is not decided. Over the scenes it does not hold
when it does not on one of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from paper_repro.noise import Group
from paper_repro.paper import Paper
from paper_repro.results import Result
from paper_repro.tables import setting

Verdict = Literal["holds", "does not hold", "not decided"]
# of the paper's schedule
STEPS: Final = 30_000
# the scale whose runs decide what others leave open
JUDGE: Final = "small"
DATASETS: Final = ("Mip-NeRF 360", "Tanks & Temples", "Deep Blending")

Groups = Mapping[str, Mapping[str, Group]]


@dataclass(frozen=True)
class Evidence:
    """What one scene says.

    Attributes:
        scene: where.
        says: the numbers, with their intervals.
        verdict: of this scene.
        why: what keeps it from being decided; empty where it is.
        under: what the runs were trained with, as far as it bears on the claim.
        runs: ids of the runs.
        nearest: of what is asked, the number that is nearest to failing or fails by most, with its interval.
        is_whole: whether it has every run, or is decided without; a scene that is not counts as one that was not run.
    """

    scene: str
    says: str
    verdict: Verdict
    why: str
    under: str
    runs: tuple[str, ...]
    nearest: str = ""
    is_whole: bool = True


@dataclass(frozen=True)
class Told:
    """A claim's verdict under one reading of the paper.

    Attributes:
        reading: its name; empty for the default of every question.
        verdict: over the scenes.
        evidence: by scene.
        deciders: commands that train what would decide the scenes that are not.
    """

    reading: str
    verdict: Verdict
    evidence: tuple[Evidence, ...]
    deciders: tuple[str, ...]

    @property
    def where(self) -> str:
        """Say the verdict with its scenes."""
        by_verdict: dict[Verdict, list[str]] = {}
        for e in self.evidence:
            by_verdict.setdefault(e.verdict, []).append(e.scene)
        parts = [f"{verdict} on {', '.join(scenes)}" for verdict, scenes in sorted(by_verdict.items())]
        return "; ".join(parts) or "not decided: no scene has all its runs"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, and what the runs of one scale say.

    Attributes:
        id: short, for tables and links.
        says: the claim.
        paper: the paper's own numbers for it.
        holds_if: what is asked of a scene.
        told: under the default reading of every question.
        others: under other readings for which there are runs.
    """

    id: str
    says: str
    paper: str
    holds_if: str
    told: Told
    others: tuple[Told, ...] = field(default=())

    @property
    def verdict(self) -> Verdict:
        """The verdict under the default readings."""
        return self.told.verdict

    @property
    def line(self) -> str:
        """Say the verdict with its scenes, and what becomes of it under other readings."""
        rest = "".join(f"; under {other.reading}: {other.where}" for other in self.others)
        return self.told.where + rest

    @property
    def under(self) -> str:
        """Say what its runs were trained with, by scene."""
        return "; ".join(f"{e.scene}: {e.under}" for e in self.told.evidence)


def told(reading: str, evidence: Iterable[Evidence], deciders: Iterable[str]) -> Told:
    """Put what the scenes say together."""
    found = tuple(evidence)
    return Told(reading, verdict_over(e.verdict for e in found if e.is_whole), found, tuple(dict.fromkeys(deciders)))


def verdict_over(verdicts: Iterable[Verdict]) -> Verdict:
    """Give the verdict over scenes that have the runs: one that fails is enough, one that is open keeps it open."""
    found = set(verdicts)
    if "does not hold" in found:
        return "does not hold"
    return "holds" if found == {"holds"} else "not decided"


def command(scale: str, rows: Iterable[str], scenes: Iterable[str], seeds: int) -> str:
    """Give the command that trains rows on scenes with so many seeds; what is finished of it is not trained again."""
    words = ["pop-repro queue", f"--scale {scale}", "--data DATA", f"--rows {' '.join(rows)}"]
    words.append(f"--scenes {' '.join(scenes)}")
    return " ".join([*words, *([f"--seeds {seeds}"] if seeds > 1 else [])])


def groups(results: Iterable[Result]) -> Groups:
    """Sort results of one scale by scene and row."""
    found: dict[str, dict[str, list[Result]]] = {}
    for r in results:
        found.setdefault(r.scene, {}).setdefault(r.row, []).append(r)
    return {
        scene: {row: Group(tuple(sorted(runs, key=lambda r: r.seed))) for row, runs in rows.items()}
        for scene, rows in sorted(found.items())
    }


def is_shortened(runs: Iterable[Result]) -> bool:
    """Say whether a run has fewer steps than the paper's schedule, or does not say how many."""
    return any((setting(r, "max_steps") or 0.0) < STEPS for r in runs)


def conditions(used: Sequence[Group]) -> str:
    """Say what else than the method bears on a comparison: image size, steps, the floor of theta_blur, and resets."""
    runs = [r for group in used for r in group.runs]
    sizes = sorted({f"{r.protocol['width']} x {r.protocol['height']} px" for r in runs})
    steps = sorted({int(s) for r in runs if (s := setting(r, "max_steps")) is not None})
    parts = [
        " and ".join(sizes),
        *([" to ".join(f"{s:,}" for s in dict.fromkeys((steps[0], steps[-1]))) + " steps"] if steps else []),
    ]
    parts += sorted({text for r in runs if (text := _theta(r))})
    parts += sorted({text for r in runs if (text := _resets(r))})
    return "; ".join(parts)


def _blur_window(run: Result) -> tuple[int, int] | None:
    """Give the steps of the blur rule of POP's strategy, or None where it never acts."""
    first, last = setting(run, "blur_start_iter"), setting(run, "blur_stop_iter")
    if run.schedule.get("method") != "pop" or first is None or last is None or last < first:
        return None
    return int(first), int(last)


def _theta(run: Result) -> str:
    share, least = setting(run, "theta_blur"), setting(run, "blur_min_pixels")
    if _blur_window(run) is None or share is None or least is None:
        return ""
    pixels = share * run.protocol["width"] * run.protocol["height"]
    if least <= pixels:
        return f"theta_blur {pixels:.1f} px, no floor"
    return f"theta_blur {least:g} px by its floor, {least / pixels:.1f} times the paper's {pixels:.1f} px at this size"


def _resets(run: Result) -> str:
    every, last = setting(run, "reset_every"), setting(run, "refine_stop_iter")
    if not every or last is None:
        return ""
    first = 0 if run.schedule.get(f"{run.schedule.get('method')}.reset_at_zero") else int(every)
    at = range(first, int(last), int(every))
    text, window = f"{run.row}: {len(at)} resets", _blur_window(run)
    if window is None:
        return text
    inside = sum(window[0] <= step <= window[1] for step in at)
    return f"{text}, {inside} of them inside the blur window {window[0]:,} to {window[1]:,}"


def paper_ratios(published: Paper, row: str, base: str) -> tuple[float, ...]:
    """Give N of a row over N of another in the paper's ablations, by data set."""
    return tuple(
        published.ablation(row, d, "num_gaussians_k") / published.ablation(base, d, "num_gaussians_k") for d in DATASETS
    )
