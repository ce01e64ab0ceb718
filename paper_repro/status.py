"""What is reproduced so far: the status table of README.md and docs/paper.md, claims.md, and what protocol.md says.

python -m paper_repro.status            print the status table
python -m paper_repro.status --write    write all of them, from the results that are there
python -m paper_repro.status --check    exit with 1 when a file holds something else

They say the claims of a scale, their outcome in five lines, and other readings of the paper. A reading (A2, A12, A16;
likewise the experiments E2 and E4) is judged by every column of the paper's tables that its runs reach: for each pair
of rows of one table N over N, the difference of PSNR and that of SSIM, and the growth a densification step between the
windows of table 4. A column speaks for the reading whose value lies nearer to the range of the paper's three data sets;
within it both are alike. A reading is named when more columns speak for it than against it, and still so without any
one pair of rows: a claim rests on one pair, so that no claim decides the reading under which it is then judged. On
photographs that are not the paper's this is evidence, not proof.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import expm1
from pathlib import Path
from typing import Final, NamedTuple

from paper_repro.claims import HEADLINES, REFINE_EVERY, WINDOWS, claims, noise_of
from paper_repro.evidence import ALPHA, DATASETS, JUDGE, PSNR, QUANTITIES, Claim, Group, Noise, Spread, Told, groups
from paper_repro.judging import OTHERS
from paper_repro.paper import Paper, paper
from paper_repro.results import RESULTS, SCALES, Result, read_all
from paper_repro.scenes import MADE, scale_named
from paper_repro.table_formats import grid
from paper_repro.tables import SCENES_OF, beyond_rows, setting
from pop_fast.errors import PopError
from pop_ref.ambiguities import AMBIGUITIES

HERE: Final = Path(__file__).resolve().parent
_MADE: Final = "<!-- made by python -m paper_repro.status --write -->"
_WRITE: Final = "run 'python -m paper_repro.status --write'"
_HEAD: Final = ("reading", "scene", "found, with its interval", "verdict", "trained with", "runs")
_COLUMNS: Final = ("scale", "scene", "rows", "column", "in the paper", "default", "other", "nearer")
# the pairs of rows that a table of the paper sets side by side
_PAIRS: Final = (
    *(("pop", "l2_blur"), ("pop", "l2_pop"), ("l2_blur", "l2"), ("l2_pop", "l2")),
    *(("pop", "reset"), ("pop", "gsplat"), ("blur_3k_4k", "pop"), ("blur_3k_11k", "pop"), ("blur_3k_15k", "pop")),
)
_N: Final = "N over N"
_DIFFERENCES: Final = (("PSNR", "psnr"), ("SSIM", "ssim"))
_GROWTH: Final = "growth a densification step over N of the shorter"
# the rows of E4: pruning harder at the paper's weight, in place of a tenfold weight
_PRUNED: Final = ("final_prune", "pop_prune_002")
_NEARER: Final = {1: "default", 0: "alike", -1: "other"}


def telling() -> list[str]:
    """List the scales that say something of a method, the most telling first: those of photographs."""
    return [scale for scale in reversed(SCALES) if not set(scale_named(scale).factors) & set(MADE)]


def method() -> str:
    """Say how a claim is decided."""
    return (
        "A claim holds on a scene if all of its conditions hold beyond the noise of the seeds. It does not hold if "
        "one of them fails beyond that noise. Otherwise it is not decided. Over all scenes that have its runs, it "
        "does not hold if it does not hold on one of them. Noise is the standard deviation over seeds, pooled over "
        "all rows and scenes of the scale that have several seeds. Intervals are L ± t s √(Σ cᵢ²/nᵢ) for a "
        "combination L of means over nᵢ seeds, with Student's t at the degrees of freedom of the pooled deviation s "
        "(contrasts in a one-way analysis of variance, NIST/SEMATECH e-Handbook of Statistical Methods, 7.4.3.6). "
        "The intervals that decide a claim at one scale and under one reading hold together with a probability of "
        f"{1.0 - ALPHA:.0%} (Bonferroni, 7.4.7.3 there). Counts and times are compared by their logarithms. A count "
        "that is the same with every seed is set by a budget, and does not enter the noise of counts. If no row has "
        "two seeds there is no interval, and one seed decides nothing. Only the whole schedule decides questions "
        "about the length of the schedule. [protocol.md](protocol.md), part 3, lists the default readings of the "
        "paper. A claim is judged under another reading if all rows that it changes are trained under it."
    )


def markdown(scale: str, results: Iterable[Result]) -> str:
    """Render the claims of a scale: verdicts, then the numbers scene by scene with their runs."""
    mine = [r for r in results if r.scale == scale]
    judged = claims(scale, mine)
    parts = [f"## Claims, scale {scale}"]
    if scale not in telling():
        parts.append("**NOT the paper's protocol: a made-up scene. These numbers say nothing about a method.**")
    elif scale != "paper":
        parts.append("**NOT the paper's protocol: other photographs. The paper's numbers are only a reference here.**")
    parts.append(_noise(scale, noise_of(mine)))
    if scale != JUDGE:
        open_ = [c.id for c in judged if not any(told.evidence for told in (c.told, *c.others))]
        judged = tuple(c for c in judged if c.id not in open_)
        if open_:
            decided_by = f"`pop-repro claims --scale {JUDGE}` names the runs that would decide them"
            parts.append(f"No scene has runs for: {', '.join(open_)}; {decided_by}.")
    verdicts = [[c.says, c.paper, c.verdict, c.line, c.under or "nothing"] for c in judged]
    head = ["claim", "in the paper", "verdict", "where, and under other readings", "trained with"]
    parts += [grid(head, verdicts)] if verdicts else []
    parts += [_one(c) for c in judged]
    return "\n\n".join(parts) + "\n"


def headlines(results: Iterable[Result]) -> list[tuple[str, Claim]]:
    """Give the claims that the paper's summary rests on, each with the scale that says most about it."""
    found = list(results)
    by_scale = {scale: {c.id: c for c in claims(scale, found)} for scale in telling()}
    return [deciding([(scale, by_id[id]) for scale, by_id in by_scale.items()]) for id in HEADLINES]


def outcome(told: Sequence[tuple[str, Claim]]) -> str:
    """Lay `headlines` out, a line each: a verdict with, of each scene, the number nearest to its bound."""
    readings = sorted({other.reading for _, claim in told for other in claim.others})
    lines = [
        [f"{claim.says[0].upper()}{claim.says[1:]}", scale, _outcome_cell(claim.told)]
        + [next((_outcome_cell(other) for other in claim.others if other.reading == name), "–") for name in readings]
        for scale, claim in told
    ]
    return grid(["claim", "scale", "verdict", *(f"under {name}" for name in readings)], lines)


def settled(told: Sequence[tuple[str, Claim]]) -> str:
    """Lay `headlines` out, with the runs that would decide what is not decided."""
    commands = dict.fromkeys(
        command
        for _, claim in told
        for answer in (claim.told, *claim.others)
        if answer.verdict == "not decided"
        for command in answer.enough
    )
    parts = [outcome(told)]
    if commands:
        lines = "\n".join(["```sh", *commands, "```"])
        parts += ["These runs would decide what is not decided, if the differences stay what they are now:", lines]
    return "\n\n".join(parts)


def _outcome_cell(told: Told) -> str:
    numbers = [f"{e.scene}: {e.nearest}" for e in told.evidence if e.is_whole and e.nearest]
    return "<br>".join([f"**{told.verdict}**", *numbers])


def deciding(by_scale: Sequence[tuple[str, Claim]]) -> tuple[str, Claim]:
    """Choose the most telling scale that decides a claim, or else the scale that is meant to."""
    decided = [(scale, c) for scale, c in by_scale if c.verdict != "not decided"]
    return decided[0] if decided else next((scale, c) for scale, c in by_scale if scale == JUDGE)


def _one(claim: Claim) -> str:
    parts = [f"### {claim.id}: {claim.says}", f"Condition: {claim.holds_if}. In the paper: {claim.paper}."]
    rows = []
    for told in (claim.told, *claim.others):
        for e in told.evidence:
            verdict = e.verdict + (f": {e.why}" if e.why else "")
            rows.append([told.reading or "default", e.scene, e.says, verdict, e.under, ", ".join(e.runs)])
    parts.append(grid(_HEAD, rows) if rows else "Not decided: no scene has runs for it.")
    return "\n\n".join([*parts, *(_deciders(told) for told in (claim.told, *claim.others) if told.deciders)])


def _deciders(told: Told) -> str:
    under = f" under {told.reading}" if told.reading else ""
    return (
        f"These runs would decide what is open{under}, if the differences stay what they are now:\n\n```sh\n"
        + "\n".join(told.deciders)
        + "\n```"
    )


def _noise(scale: str, noise: Noise) -> str:
    told = [(quantity, spread) for quantity in QUANTITIES if (spread := noise.of(quantity)) is not None]
    if not told:
        return (
            f"Noise floor: none. No row has two seeds on one scene at scale {scale}, so nothing is decided here: "
            f"one seed decides nothing."
        )
    texts = [
        f"{quantity.name} {_spread(quantity.name == PSNR.name, quantity.is_log, spread)}" for quantity, spread in told
    ]
    return f"Noise floor, one standard deviation over seeds: {'; '.join(texts)}."


def _spread(is_psnr: bool, is_log: bool, spread: Spread) -> str:
    def shown(s: float) -> str:
        return f"{expm1(s):.2%}" if is_log else f"{s:.3f} dB" if is_psnr else f"{s:.4f}"

    where = ", ".join(spread.scenes) + (" alone" if len(spread.scenes) == 1 else "")
    return (
        f"{shown(spread.s)} ({spread.df} degrees of freedom, {spread.groups} pairs of row and scene, on {where}, each "
        f"between {shown(spread.least)} and {shown(spread.largest)})"
    )


@dataclass(frozen=True)
class Reading:
    """An open question of the paper, and its other answer by its name in `judging.OTHERS`."""

    id: str
    asks: str
    other: str


class Column(NamedTuple):
    """A number that the tables print for two rows, or for the windows of table 4."""

    rows: tuple[str, ...]  # that it is made of; what a reading is judged by has to hold without any one of these
    quantity: str  # what of them
    printed: tuple[float, ...]  # by data set

    def apart(self, value: float) -> float:
        """Give how far a value lies from the range of the data sets; 0 within it."""
        return max(min(self.printed) - value, value - max(self.printed), 0.0)


@dataclass(frozen=True)
class Answer:
    """What the runs say of one question."""

    id: str  # of the question
    asks: str  # the question
    says: str  # the answer in a sentence
    head: tuple[str, ...]  # of its table
    lines: tuple[tuple[str, ...], ...]  # by scene and row


READINGS: Final = (
    Reading("A2", "over what is a dominant count cumulative in the blur rule?", "A2 any view"),
    Reading("A2, added up", "or are the counts of several views added up?", "A2 added up"),
    Reading("A12", "does the POP term sum over all Gaussians or over visible ones?", "A12 visible"),
    Reading("A16", "are oversized Gaussians pruned although there is no reset?", "A16 on"),
)


def answers(results: Iterable[Result]) -> tuple[Answer, ...]:
    """Answer the questions about readings from the results of all scales, the paper's scale first where it decides."""
    found = list(results)
    return tuple(_answer(reading, found) for reading in READINGS)


def experiments(results: Iterable[Result]) -> tuple[Answer, ...]:
    """Answer E2 and E4 from the results of all scales."""
    found = list(results)
    return _longer_schedules(found), _pruned_harder(found)


def answers_markdown(found: Sequence[Answer]) -> str:
    """Render answers: the question, what is said, the numbers."""
    parts = []
    for answer in found:
        parts.append(f"### {answer.id}: {answer.asks}\n\n{answer.says}")
        if answer.lines:
            parts.append(grid(answer.head, answer.lines))
    return "\n\n".join(parts)


def columns(published: Paper) -> tuple[Column, ...]:
    """List every column that a reading is judged by, with what the paper prints."""
    found = []
    for row, base in _PAIRS:
        both = [_printed(published, dataset, row, base) for dataset in DATASETS]
        counts = tuple(ours["num_gaussians_k"] / theirs["num_gaussians_k"] for ours, theirs in both)
        found.append(Column((row, base), _N, counts))
        for name, metric in _DIFFERENCES:
            found.append(Column((row, base), name, tuple(ours[metric] - theirs[metric] for ours, theirs in both)))
    for (shorter, first), (longer, last) in pairwise(WINDOWS.items()):
        counts = [tuple(published.ablation(row, d, "num_gaussians_k") for row in (longer, shorter)) for d in DATASETS]
        grown = tuple(_growth(more, less, first, last) for more, less in counts)
        found.append(Column((longer, shorter), _GROWTH, grown))
    return tuple(found)


def _printed(published: Paper, dataset: str, *rows: str) -> list[Mapping[str, float]]:
    """Give the lines of rows from the first table that has them on a data set."""
    for table in published.tables:
        if dataset in table.datasets and set(rows) <= {line.row for line in table.rows}:
            return [table.row(row).values[dataset] for row in rows]
    raise KeyError(rows)


def _growth(more: float, less: float, first: int, last: int) -> float:
    return (more - less) / less / ((last - first) / REFINE_EVERY)


def _found(column: Column, rows: Mapping[str, Group], trained: Mapping[str, str | None]) -> float | None:
    """Read a column off the runs of a scene, with the rows that stand for its own; None where one is not there."""
    stand_ins = [trained.get(row, row) for row in column.rows]
    if any(row is None or row not in rows for row in stand_ins):
        return None
    ours, theirs = (rows[row] for row in stand_ins if row is not None)
    if column.quantity == _N:
        return ours.n / theirs.n
    if column.quantity == _GROWTH:
        longer, shorter = column.rows
        return _growth(ours.n, theirs.n, WINDOWS[shorter], WINDOWS[longer])
    metric = dict(_DIFFERENCES)[column.quantity]
    return _mean(ours, metric) - _mean(theirs, metric)


def _mean(group: Group, metric: str) -> float:
    return sum(getattr(run, metric) for run in group.runs) / len(group.runs)


def _answer(reading: Reading, results: Sequence[Result]) -> Answer:
    trained = next(other.rows for other in OTHERS if other.name == reading.other)
    lines: list[tuple[str, ...]] = []
    votes: list[tuple[tuple[str, ...], int]] = []
    concerned = [column for column in columns(paper()) if set(column.rows) & trained.keys()]
    for scale, scene, rows in _scenes(results):
        for column in concerned:
            default, other = _found(column, rows, {}), _found(column, rows, trained)
            if default is None or other is None:
                continue
            # over the default's: which is nearer, or both within the range
            ahead = column.apart(other) - column.apart(default)
            votes.append((column.rows, (ahead > 0.0) - (ahead < 0.0)))
            lines.append((scale, scene, *_shown(column, default, other), _NEARER[votes[-1][1]]))
    return Answer(reading.id, reading.asks, _says(reading, votes), _COLUMNS, tuple(lines))


def _shown(column: Column, default: float, other: float) -> tuple[str, ...]:
    form = {_N: "{:.3f}", "PSNR": "{:+.2f} dB", "SSIM": "{:+.3f}", _GROWTH: "{:+.2%}"}[column.quantity]
    printed = ", ".join(form.format(value) for value in column.printed)
    return " and ".join(column.rows), column.quantity, printed, form.format(default), form.format(other)


def _says(reading: Reading, votes: Sequence[tuple[tuple[str, ...], int]]) -> str:
    """Name the reading that more columns speak for, also without any one pair of rows."""
    if not votes:
        return "Not decided: no scene has the runs of a column under both readings."
    of_each = [sum(vote == side for _, vote in votes) for side in (1, -1, 0)]
    counted = (
        f"of {len(votes)} columns {of_each[0]} are nearer to the paper's under the default, {of_each[1]} under "
        f"{reading.other}, {of_each[2]} alike"
    )
    lead = of_each[0] - of_each[1]
    if lead == 0:
        return f"Not decided: {counted}."
    pairs = {frozenset(rows) for rows, _ in votes}
    without = [sum(vote for rows, vote in votes if set(rows) != pair) for pair in pairs]
    if any(left * lead <= 0 for left in without):
        return f"Not decided: {counted}, and the lead is gone without one pair of rows."
    return f"The runs favour {'the default' if lead > 0 else reading.other}: {counted}, also without any one pair."


def _scenes(results: Sequence[Result]) -> Iterator[tuple[str, str, Mapping[str, Group]]]:
    """Give scale, scene and groups by row at the scales that say something about a method, the paper's first."""
    for scale in telling():
        for scene, rows in groups(r for r in results if r.scale == scale).items():
            yield scale, scene, rows


def _longer_schedules(results: Sequence[Result]) -> Answer:
    """E2: what POP does to N and PSNR on schedules of several lengths, by its weight."""
    lines: list[tuple[str, ...]] = []
    lengths: dict[tuple[str, float], set[float]] = {}
    for scale, scene, rows in _scenes(results):
        if "pop" not in rows or "l2_blur" not in rows:
            continue
        pop, blur = rows["pop"], rows["l2_blur"]
        steps, weight = (setting(pop.runs[0], name) for name in ("max_steps", "lambda_pop"))
        if steps is None or weight is None:
            continue
        lengths.setdefault((scene, weight), set()).add(steps)
        shown = f"{steps:,.0f}", f"{weight:g}", f"{pop.n / blur.n:.1%}", f"{pop.psnr - blur.psnr:+.2f} dB"
        lines.append((scale, scene, *shown, ", ".join((*pop.ids, *blur.ids))))
    head = ("scale", "scene", "steps", "weight", "N(pop) / N(l2_blur)", "PSNR", "runs")
    several = sorted({scene for (scene, _), steps in lengths.items() if len(steps) > 1})
    if not several:
        says = "Not decided: one weight has to be run on two lengths of the schedule of one scene."
    else:
        weights = {weight for _, weight in lengths}
        says = f"One weight on several lengths of the schedule of {', '.join(several)}, below." + (
            "" if len(weights) > 1 else " No row divides the weight by the scaler, so that rule is not judged here."
        )
    return Answer(
        "E2", "does the weight of the POP term have to grow when the schedule shrinks?", says, head, tuple(lines)
    )


def _pruned_harder(results: Sequence[Result]) -> Answer:
    """E4: what pruning harder at the paper's weight does."""
    lines: list[tuple[str, ...]] = []
    for scale, scene, rows in _scenes(results):
        for row in (row for row in _PRUNED if row in rows and "pop" in rows):
            pop, pruned, base = rows["pop"], rows[row], rows.get("gsplat")
            shown = f"{pruned.n / pop.n:.1%}", f"{pruned.psnr - pop.psnr:+.2f} dB"
            share = f"{pruned.n / base.n:.1%}" if base is not None else "gsplat not run"
            lines.append((scale, scene, row, *shown, share, ", ".join((*pruned.ids, *pop.ids))))
    head = ("scale", "scene", "row", "N of POP's", "PSNR less POP's", "N of gsplat's", "runs")
    says = (
        "Pruning harder at the paper's weight, below." if lines else "Not decided: no scene has POP and a harder prune."
    )
    return Answer("E4", "how compact is POP at the paper's weight if more is pruned?", says, head, tuple(lines))


# The pages.


def status_table(results: Iterable[Result]) -> str:
    """Make the status table: every claim by all scales that decide it, every table by the cells that are run."""
    found = list(results)
    rows = [_claim_row(by_scale, found) for by_scale in zip(*(claims(s, found) for s in telling()), strict=True)]
    for table in paper().tables:
        lines = [line.row for line in table.rows]
        what, cells = f"table {table.number}: {table.title}", f"{len(lines)} rows, {', '.join(table.datasets)}"
        rows.append([what, cells, *_table_row(str(table.number), lines, table.datasets, found)])
    beyond = [row for row in beyond_rows() if row != "pop"]
    rows.append(["beyond the paper", "not in the paper", *_table_row("beyond", beyond, DATASETS, found)])
    return grid(["claim or table", "paper", "ours", "command", "commits"], rows)


def _table_row(table: str, rows: Sequence[str], datasets: Sequence[str], found: Iterable[Result]) -> list[str]:
    used = [r for r in found if r.row in rows]
    return [_progress(rows, datasets, used), f"`pop-repro table {table} --scale small`", _commits(used)]


def files(results: Iterable[Result], folder: Path = HERE) -> dict[Path, str]:
    """Give the text that each generated file should have.

    Raises:
        PopError: a file has no marks for its part.
    """
    found = list(results)
    protocol = _read(folder / "protocol.md")
    protocol = with_part(protocol, "ambiguities", _ambiguities())
    answered = (*answers(found), *experiments(found))
    protocol = with_part(protocol, "readings", answers_markdown(answered))
    table = status_table(found)
    made = {
        folder / "README.md": with_part(_read(folder / "README.md"), "status", table),
        folder / "protocol.md": protocol,
        folder / "claims.md": _claims(found),
    }
    page, front = folder.parent / "docs" / "paper.md", folder.parent / "README.md"
    # only a clone has them
    if page.is_file():
        told = headlines(found)
        made[page] = with_part(with_part(_read(page), "reproduction", table), "settled", settled(told))
        made[front] = with_part(_read(front), "outcome", outcome(told))
    return made


def stale_files(results: Iterable[Result]) -> dict[Path, str]:
    """Give those of the generated files that hold something else, with the text that they should have.

    Raises:
        PopError: as `files`.
    """
    return {path: text for path, text in files(results).items() if not path.is_file() or _read(path) != text}


def everything() -> list[Result]:
    """Read the results of all scales that the package holds."""
    return [r for scale in SCALES for r in read_all(scale, RESULTS)]


def with_part(text: str, name: str, part: str) -> str:
    """Put a part between its marks, `<!-- NAME:begin -->` and `<!-- NAME:end -->`.

    Raises:
        PopError: the text has no such marks.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, _, rest = text.partition(begin)
    _, marked, after = rest.partition(end)
    if not marked:
        raise PopError(f"there are no marks {begin} ... {end}; put them where the part belongs")
    return f"{before}{begin}\n{part}\n{end}{after}"


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise PopError(f"{path}: cannot be read ({error.strerror})") from None


def _claim_row(by_scale: Sequence[Claim], found: Sequence[Result]) -> list[str]:
    """Say of one claim what each scale decides: a verdict of one scale alone would hide that another disagrees."""
    named = list(zip(telling(), by_scale, strict=True))
    judged = [(scale, c) for scale, c in named if c.verdict != "not decided"]
    ours = "; ".join(f"{c.verdict} at scale {scale}: {c.line}" for scale, c in judged)
    scale, told = deciding(named)
    # where nothing that is known would decide it, the claims say why
    command = next(iter([] if judged else told.told.enough), f"pop-repro claims --scale {scale}")
    readings = [reading for _, c in judged or [(scale, told)] for reading in (c.told, *c.others)]
    runs = {run for reading in readings for e in reading.evidence for run in e.runs}
    used = [r for r in found if r.run in runs]
    return [told.says, told.paper, ours or f"not decided: {told.line}", f"`{command}`", _commits(used)]


def _commits(used: Iterable[Result]) -> str:
    known = sorted({r.commit[:7] for r in used if r.commit is not None})
    return ", ".join(known) or "none"


def _progress(rows: Sequence[str], datasets: Sequence[str], used: Sequence[Result]) -> str:
    """Say for each scale how many of its pairs of row and scene have a run; the data sets are the paper's scale's."""
    counts = []
    for scale in telling():
        scenes = SCENES_OF.get(scale) or [s for d in datasets for s in paper().datasets[d]]
        done = {(r.row, r.scene) for r in used if r.scale == scale and r.scene in scenes}
        counts.append(f"{scale}: {len(done)} of {len(rows) * len(scenes)}" if done else f"{scale}: not run")
    return "; ".join(counts)


def _ambiguities() -> str:
    rows = [
        [a.id, a.impact, a.question, a.default, ", ".join(f"`{other}`" for other in a.alternatives) or "none"]
        for a in AMBIGUITIES
    ]
    return grid(["label", "impact", "question", "default here", "other choices"], rows)


def _claims(found: Sequence[Result]) -> str:
    about = "The conditions are in [claims.py](claims.py), the comparisons in [protocol.md](protocol.md)."
    parts = ["# The paper's claims", _MADE, about, method()]
    # the scale that is meant to decide says which runs it lacks even where it has none
    scales = [scale for scale in telling() if scale == JUDGE or any(r.scale == scale for r in found)]
    parts += [markdown(scale, found).strip() for scale in scales]
    return "\n\n".join(parts) + "\n"


def main(words: Sequence[str]) -> int:
    """Run the script."""
    found = everything()
    if "--write" not in words and "--check" not in words:
        print(status_table(found))
        return 0
    stale = stale_files(found)
    for path, text in stale.items():
        if "--write" in words:
            path.write_text(text, encoding="utf-8")
        else:
            print(f"{path.name}: is not what the results say; {_WRITE}")
    return 0 if "--write" in words or not stale else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
