"""How a question is judged by the runs of one scale: scene by scene, under the default readings and under others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from paper_repro.evidence import (
    DATASETS,
    JUDGE,
    MOST_SEEDS,
    PSNR,
    Claim,
    Comparison,
    Evidence,
    Group,
    Groups,
    Noise,
    Told,
    Verdict,
    command,
    conditions,
    is_shortened,
    verdict_over,
)
from paper_repro.jobs import SEED
from paper_repro.paper import paper
from paper_repro.results import most_timed_on
from paper_repro.scenes import scale_named

# what a question gets on one scene: comparisons; None for one that lacks a run; why one cannot be made of its runs
Asked = Sequence[Comparison | str | None]
# makes one of these from the groups by row and the noise
Ask = Callable[[Mapping[str, Group], Noise], Comparison | str | None]
# seeds of each row where nothing is known of the noise yet
_FIRST_SEEDS: Final = 3


@dataclass(frozen=True)
class Question:
    """A claim before it is judged."""

    id: str  # short, for tables and links
    says: str  # the claim
    paper: str  # the paper's own numbers for it
    holds_if: str  # what is asked of a scene
    rows: tuple[str, ...]  # that it needs on a scene
    asks: Sequence[Ask]  # make its comparisons on one scene
    of_duration: bool = False  # whether it asks what a length of the schedule does, which no shortened schedule decides
    of_times: bool = False  # whether it compares times, which only runs on one machine allow
    datasets: tuple[str, ...] = DATASETS  # of which the paper says it
    always: tuple[str, ...] = ()  # other readings under which it is told even where nothing was run


@dataclass(frozen=True)
class Other:
    """Another reading of the paper."""

    name: str  # the label of the open question and its other answer
    # the rows that train otherwise under it, each with the row that does so, or None where there is none
    rows: Mapping[str, str | None]


_WINDOWS: Final = ("blur_3k_4k", "blur_3k_11k", "blur_3k_15k")
# the rows of the comparison of L1 and L2
SWEEP: Final = tuple(f"l1_div_{n}" for n in (1, 2, 5, 10, 20, 50, 100))


def _other(name: str, concerned: Iterable[str], trained: Mapping[str, str]) -> Other:
    return Other(name, {row: trained.get(row) for row in concerned})


OTHERS: Final = (
    # no row but Reset has resets, so that pruning by size is off in all of them under the default
    _other("A16 on", ("pop", "l2", "l2_blur", "l2_pop", *_WINDOWS, *SWEEP), {"pop": "pop_size_prune"}),
    _other(
        "A2 any view", ("pop", "l2_blur", "reset", *_WINDOWS), {"pop": "pop_any_view", "l2_blur": "l2_blur_any_view"}
    ),
    _other("A2 added up", ("pop", "l2_blur", "reset", *_WINDOWS), {"pop": "pop_sum"}),
    _other("A12 visible", ("pop", "l2_pop", *_WINDOWS), {"pop": "pop_visible"}),
)


def judge(question: Question, found: Groups, noise: Noise, scale: str) -> Claim:
    """Judge a question by the groups of one scale, under the default readings and under others that have runs."""
    default = _under("", question, found, noise, scale, {row: row for row in question.rows})
    others: list[Told] = []
    for other in OTHERS:
        rows = {row: other.rows.get(row, row) for row in question.rows}
        if None in rows.values() or all(row == name for row, name in rows.items()):
            continue
        trained = {row: name for row, name in rows.items() if name is not None}
        has_runs = any(all(name in by_row for name in trained.values()) for by_row in found.values())
        if has_runs or other.name in question.always:
            others.append(_under(other.name, question, found, noise, scale, trained))
    return Claim(question.id, question.says, question.paper, question.holds_if, default, tuple(others))


@dataclass(frozen=True)
class _At:
    """One scene: what a question uses there, what could be compared, and what lacks."""

    scene: str  # its name
    rows: Mapping[str, Group]  # the groups that are used, by the question's row
    unused: Mapping[str, set[int]]  # of each of the question's rows, seeds of the runs that are there and do not count
    asked: Asked  # what could be compared, or why not
    missing: tuple[str, ...]  # names of the rows that lack
    where: str = ""  # the machine on which further runs have to be timed; empty where any would do

    @property
    def made(self) -> tuple[Comparison, ...]:
        """The comparisons that could be made."""
        return tuple(c for c in self.asked if isinstance(c, Comparison))

    def queued(self, runs: int, is_missing: bool = False) -> int:
        """Say for how many seeds a queue has to be asked so that each row, or each that lacks, has so many runs.

        A run that is there is not trained again, whether it counts or not.
        """
        rows = [row for row in self.unused if not (is_missing and row in self.rows)]
        return max((self._queued(row, runs) for row in rows), default=runs)

    def _queued(self, row: str, runs: int) -> int:
        seeds = runs
        while len(_seeds(self.rows, row) | (set(range(SEED, SEED + seeds)) - self.unused[row])) < runs:
            seeds += 1
        return seeds


def _under(reading: str, question: Question, found: Groups, noise: Noise, scale: str, rows: Mapping[str, str]) -> Told:
    """Judge a question with the rows that stand for its own under one reading."""
    at: list[_At] = []
    for scene in _scenes(question, found, scale):
        by_row = found.get(scene, {})
        there = {row: by_row[name] for row, name in rows.items() if name in by_row}
        where, used = _on_one_machine(there) if question.of_times else ("", there)
        missing = tuple(name for row, name in rows.items() if row not in used)
        asked = [ask(used, noise) for ask in question.asks] if used else []
        unused = {row: _seeds(there, row) - _seeds(used, row) for row in rows}
        at.append(_At(scene, used, unused, asked, missing, where))
    together = sum(c.asked != "nothing" for one in at for c in one.made)
    names = tuple(rows.values())
    evidence, judged, deciders = [], list[_At](), _Deciders(scale)
    for one in at:
        if not any(one.asked) and one.missing:
            seeds = one.queued(_seeds_at_first(noise), is_missing=True)
            deciders.add(one.missing or names, one, seeds, bool(found.get(one.scene)))
            continue
        judged.append(one)
        verdict, why = _verdict(question, one, together)
        said = "; ".join(c if isinstance(c, str) else c.text(together) for c in one.asked if c is not None)
        groups = list(one.rows.values())
        runs = tuple(id for group in groups for id in group.ids)
        # what a scene has may speak against the claim although it lacks rows
        is_whole = verdict != "not decided" or not one.missing
        evidence.append(
            Evidence(one.scene, said, verdict, why, conditions(groups), runs, _nearest(one, together), is_whole)
        )
        if verdict == "not decided":
            _decide(deciders, question, one, names, together, _seeds_at_first(noise))
    is_open = [one for one, e in zip(judged, evidence, strict=True) if e.is_whole and e.verdict == "not decided"]
    commands, enough = tuple(dict.fromkeys(deciders.commands())), _enough(scale, names, is_open, together)
    # where no scene has all its runs, or none of the whole schedule, the first is as good as any
    fewest = commands[:1] if enough is None else tuple(enough)
    return Told(reading, verdict_over(e.verdict for e in evidence if e.is_whole), tuple(evidence), commands, fewest)


def _verdict(question: Question, at: _At, together: int) -> tuple[Verdict, str]:
    """Give the verdict of one scene, and what keeps it from one."""
    if question.of_duration and is_shortened(r for group in at.rows.values() for r in group.runs):
        return "not decided", "a shortened schedule decides no question of duration"
    held = [c.holds(together) for c in at.made if c.asked != "nothing"]
    if False in held:
        return "does not hold", ""
    if at.missing:
        return "not decided", f"not run: {', '.join(at.missing)}"
    if len(at.made) < len(at.asked):
        said = [c for c in at.asked if isinstance(c, str)]
        return "not decided", "; ".join(said) or "a run has no value of what is compared"
    if held and all(held):
        return "holds", ""
    if any(c.error is None for c in at.made):
        return "not decided", "no row has two seeds at this scale, and one seed decides nothing by itself"
    few = "" if _seeds_to_decide(at, together) else f", and {MOST_SEEDS} of each row would not decide it"
    return "not decided", f"within the noise of the seeds{few}"


def _undecided(at: _At, together: int) -> list[Comparison]:
    return [c for c in at.made if c.asked != "nothing" and c.holds(together) is None]


def _seeds_to_decide(at: _At, together: int) -> int | None:
    """Say how many seeds of each row would decide what is open on a scene; None for more than `MOST_SEEDS`."""
    found = [c.seeds_needed(together) for c in _undecided(at, together)]
    return None if None in found else max(n for n in found if n is not None)


def _nearest(at: _At, together: int) -> str:
    asked = [c for c in at.made if c.asked != "nothing"]
    # in units of its own noise, since dB and logarithms do not compare
    nearest = min(asked, key=lambda c: c.margin / (c.error or 1.0), default=None)
    return "" if nearest is None else nearest.text(together) + nearest.condition


def _decide(
    deciders: _Deciders, question: Question, at: _At, names: tuple[str, ...], together: int, at_first: int
) -> None:
    """Add the runs that would decide a scene; rows that lack get so many seeds at first."""
    if question.of_duration and is_shortened(r for group in at.rows.values() for r in group.runs):
        deciders.elsewhere(names, at.scene)
    elif at.missing:
        deciders.add(at.missing, at, at.queued(at_first, is_missing=True))
    elif len(at.made) == len(at.asked):
        seeds = _seeds_to_decide(at, together)
        if seeds is not None:
            deciders.add(names, at, at.queued(seeds))


def _enough(scale: str, names: tuple[str, ...], is_open: Sequence[_At], together: int) -> list[str] | None:
    """Give the fewest commands that would decide a claim, None where more seeds of what is there would not.

    A scene on which the claim fails is enough; where none looks like one, all have to be decided.
    """
    margins = {at.scene: [c.margin for c in _undecided(at, together)] for at in is_open}
    if not margins or [] in margins.values():
        return None
    needed = {at.scene: _seeds_to_decide(at, together) for at in is_open}
    queued = [(at.queued(seeds), at.scene, at.where) for at in is_open if (seeds := needed[at.scene])]
    failing = [one for one in queued if min(margins[one[1]]) < 0.0]
    if not failing and None in needed.values():
        return []
    chosen = [min(failing)] if failing else queued
    return [command(scale, names, [scene], seeds, where) for seeds, scene, where in chosen]


class _Deciders:
    """Commands that train what is missing, with the scenes put together that lack the same; begun scenes come first."""

    def __init__(self, scale: str) -> None:
        self.scale = scale
        self.begun: dict[tuple[str, tuple[str, ...], int, str], list[str]] = {}
        self.others: dict[tuple[str, tuple[str, ...], int, str], list[str]] = {}

    def add(self, rows: tuple[str, ...], at: _At, seeds: int, is_begun: bool = True) -> None:
        asked = self.begun if is_begun else self.others
        asked.setdefault((self.scale, rows, seeds, at.where), []).append(at.scene)

    def elsewhere(self, rows: tuple[str, ...], scene: str) -> None:
        """Ask for the whole schedule, at the scale that has it, on this scene or on all of its scenes."""
        scenes = tuple(scale_named(JUDGE).factors)
        for one in (scene,) if scene in scenes else scenes:
            self.begun.setdefault((JUDGE, rows, _FIRST_SEEDS, ""), []).append(one)

    def commands(self) -> list[str]:
        asked = [*self.begun.items(), *self.others.items()]
        return [command(scale, rows, dict.fromkeys(of), seeds, where) for (scale, rows, seeds, where), of in asked]


def _seeds_at_first(noise: Noise) -> int:
    """With a noise floor one seed can decide; without one every row needs several."""
    return 1 if noise.of(PSNR) is not None else _FIRST_SEEDS


def _scenes(question: Question, found: Groups, scale: str) -> list[str]:
    """List the scenes of a scale, and further ones that have results; of the paper's those that it speaks of."""
    named = [*scale_named(scale).factors, *found]
    if scale == "paper":
        spoken_of = {scene for dataset in question.datasets for scene in paper().datasets[dataset]}
        named = [scene for scene in named if scene in spoken_of]
    return list(dict.fromkeys(named))


def _on_one_machine(there: Mapping[str, Group]) -> tuple[str, dict[str, Group]]:
    """Name the machine, engine and number of threads on which most rows were timed, and keep the runs there."""
    best = most_timed_on((row, run) for row, group in there.items() for run in group.runs)
    kept = {row: tuple(r for r in group.runs if r.is_timed and r.trained_on == best) for row, group in there.items()}
    return best or "", {row: Group(runs) for row, runs in kept.items() if runs}


def _seeds(groups: Mapping[str, Group], row: str) -> set[int]:
    return {run.seed for run in groups[row].runs} if row in groups else set()
