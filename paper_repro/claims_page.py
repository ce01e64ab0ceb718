"""The claims for people: a page a scale, and the outcome in five lines."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import expm1
from typing import Final

from paper_repro.claims import HEADLINES, claims, noise_of
from paper_repro.evidence import JUDGE, Claim, Told
from paper_repro.noise import ALPHA, PSNR, QUANTITIES, Noise, Spread
from paper_repro.results import SCALES, Result
from paper_repro.scales import scale_named
from paper_repro.scenes import MADE
from paper_repro.table_formats import grid

_HEAD: Final = ("reading", "scene", "found, with its interval", "verdict", "trained with", "runs")


def telling() -> list[str]:
    """List the scales that say something of a method, the most telling first: those of photographs."""
    return [scale for scale in reversed(SCALES) if not set(scale_named(scale).factors) & set(MADE)]


def method() -> str:
    """Say how a claim is decided."""
    return (
        "A claim holds on a scene when all that is asked of it holds beyond the noise of the seeds, does not hold when "
        "something fails beyond it, and is not decided otherwise; over the scenes that have its runs it does not hold "
        "when it does not on one of them. Noise is the standard deviation over seeds, pooled over all rows and scenes "
        "of the scale that have several. Intervals are L ± t s √(Σ cᵢ²/nᵢ) for a combination L of means over nᵢ seeds, "
        "with Student's t at the degrees of freedom of the pooled deviation s (contrasts in a one-way analysis of "
        "variance, NIST/SEMATECH e-Handbook of Statistical Methods, 7.4.3.6); those of one claim at one scale hold "
        f"together with a probability of {1.0 - ALPHA:.0%} (Bonferroni, 7.4.7.3 there). Counts and times are compared "
        "by their logarithms. Where no row has two seeds there is no interval, and one seed decides nothing. What a "
        "length of the schedule does is decided by the whole schedule alone. The default readings are those of "
        "[protocol.md](protocol.md), part 3; a claim is judged under another one where all rows that it changes are "
        "trained under it."
    )


def markdown(scale: str, results: Iterable[Result]) -> str:
    """Render the claims of a scale: verdicts, then the numbers scene by scene with their runs."""
    mine = [r for r in results if r.scale == scale]
    judged = claims(scale, mine)
    parts = [f"## Claims, scale {scale}"]
    if scale not in telling():
        parts.append("**NOT the paper's protocol: a made-up scene. Nothing here says anything of a method.**")
    elif scale != "paper":
        parts.append("**NOT the paper's protocol: other photographs. The paper's numbers are a yardstick here.**")
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


def outcome(results: Iterable[Result]) -> str:
    """Tell the claims that the paper's summary rests on, a line each, with intervals or the run that would decide."""
    found = list(results)
    by_scale = {scale: {c.id: c for c in claims(scale, found)} for scale in telling()}
    return "\n".join(_outcome_line([(scale, by_id[id]) for scale, by_id in by_scale.items()]) for id in HEADLINES)


def deciding(by_scale: Sequence[tuple[str, Claim]]) -> tuple[str, Claim]:
    """Choose the most telling scale that decides a claim, or else the scale that is meant to."""
    decided = [(scale, c) for scale, c in by_scale if c.verdict != "not decided"]
    return decided[0] if decided else next((scale, c) for scale, c in by_scale if scale == JUDGE)


def _outcome_line(by_scale: Sequence[tuple[str, Claim]]) -> str:
    scale, claim = deciding(by_scale)
    line = f"- {claim.says[0].upper()}{claim.says[1:]}: **{claim.verdict}** at scale {scale}"
    for told in (claim.told, *claim.others):
        numbers = "; ".join(f"{e.scene} {e.nearest}" for e in told.evidence if e.is_whole and e.nearest)
        if told.reading:
            line += f"; under {told.reading} **{told.verdict}**"
        line += f" ({numbers})" if numbers else ""
        if told.verdict == "not decided" and told.deciders:
            line += f", which `{told.deciders[0]}` would decide"
    return line + "."


def _one(claim: Claim) -> str:
    parts = [f"### {claim.id}: {claim.says}", f"Asked: {claim.holds_if}. In the paper: {claim.paper}."]
    rows = [
        [
            told.reading or "default",
            e.scene,
            e.says,
            e.verdict + (f": {e.why}" if e.why else ""),
            e.under,
            ", ".join(e.runs),
        ]
        for told in (claim.told, *claim.others)
        for e in told.evidence
    ]
    parts.append(grid(_HEAD, rows) if rows else "Not decided: no scene has runs for it.")
    return "\n\n".join([*parts, *(_deciders(told) for told in (claim.told, *claim.others) if told.deciders)])


def _deciders(told: Told) -> str:
    under = f" under {told.reading}" if told.reading else ""
    return f"What is open{under} is decided by:\n\n```sh\n" + "\n".join(told.deciders) + "\n```"


def _noise(scale: str, noise: Noise) -> str:
    told = [(quantity, spread) for quantity in QUANTITIES if (spread := noise.of(quantity)) is not None]
    if not told:
        return (
            f"Noise floor: none. No row has two seeds on one scene at scale {scale}, so that nothing is decided here "
            f"by one seed."
        )
    texts = [
        f"{quantity.name} {_spread(quantity.name == PSNR.name, quantity.is_log, spread)}" for quantity, spread in told
    ]
    return f"Noise floor, one standard deviation over seeds: {'; '.join(texts)}."


def _spread(is_psnr: bool, is_log: bool, spread: Spread) -> str:
    def shown(s: float) -> str:
        return f"{expm1(s):.2%}" if is_log else f"{s:.3f} dB" if is_psnr else f"{s:.4f}"

    return (
        f"{shown(spread.s)} ({spread.df} degrees of freedom, {spread.groups} pairs of row and scene, whose own lie "
        f"between {shown(spread.least)} and {shown(spread.largest)})"
    )
