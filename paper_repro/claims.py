"""The paper's claims, each as a function of the results of one scale: does it hold, where, by which numbers and runs.

A claim asks something of every scene that has the runs for it. It holds when every scene that decides says so, holds in
part when some do, and is not decided when none has the runs, or when the difference is smaller than one standard error
over seeds. Bounds are the paper's own numbers wherever it has any; on other photographs they are a yardstick only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from math import exp, log
from statistics import fmean
from typing import Final

from paper_repro.evidence import (
    DATASETS,
    Claim,
    Evidence,
    Group,
    Groups,
    at_least,
    claim,
    decay,
    difference,
    groups,
    ids,
    implied_rates,
    implied_shares,
    paper_ratios,
)
from paper_repro.paper import Paper, paper
from paper_repro.results import Result
from paper_repro.table_markdown import grid

__all__ = ["SWEEP", "claims", "markdown"]

# the rows of the comparison of L1 and L2
SWEEP: Final = tuple(f"l1_div_{n}" for n in (1, 2, 5, 10, 20, 50, 100))
# how far the counts of the paper's tables lie from one rate of decay
_SLACK: Final = 1.2


def claims(scale: str, results: Iterable[Result]) -> tuple[Claim, ...]:
    """Judge every claim by the results of one scale."""
    found, published = groups(r for r in results if r.scale == scale), paper()
    return tuple(
        make(found, published)
        for make in (
            *(halves_the_count, blur_multiplies, no_worse_than_reset, window, decay_after_the_window),
            *(fewer_per_pixel, l2_beats_scaled_l1, compact_against_gsplat),
        )
    )


def halves_the_count(found: Groups, published: Paper) -> Claim:
    """C-half: POP leaves half or less of the Gaussians of L2 and blur."""

    def ask(pop: Group, blur: Group) -> tuple[str, bool | None]:
        share = pop.n / blur.n
        text = f"{pop.n:,.0f} of {blur.n:,.0f}, {share:.1%}; PSNR {pop.psnr - blur.psnr:+.2f} dB"
        return text, _at_most(share, 0.5, _ratio_error(pop, blur))

    ratios = _percents(paper_ratios(published, "pop", "l2_blur"))
    return claim(
        "half",
        "POP cuts the number of Gaussians by half or more against L2 with the blur rule",
        f"{ratios} of L2+Blur's Gaussians ({', '.join(DATASETS)})",
        "N(pop) / N(l2_blur) is at most 50 %",
        _by_scene(found, ("pop", "l2_blur"), ask),
    )


def blur_multiplies(found: Groups, published: Paper) -> Claim:
    """C-blur: the blur rule multiplies N, with POP and without."""
    without, with_pop = paper_ratios(published, "l2_blur", "l2"), paper_ratios(published, "pop", "l2_pop")
    least = (min(without), min(with_pop))

    def ask(blur: Group, l2: Group, pop: Group, l2_pop: Group) -> tuple[str, bool | None]:
        ratios = (blur.n / l2.n, pop.n / l2_pop.n)
        return f"without POP x {ratios[0]:.2f}, with POP x {ratios[1]:.2f}", ratios[0] >= least[0] and ratios[
            1
        ] >= least[1]

    return claim(
        "blur",
        "the blur rule multiplies the number of Gaussians",
        f"x {_list(without)} without POP, x {_list(with_pop)} with it",
        f"at least the paper's least factors, {least[0]:.2f} without POP and {least[1]:.2f} with it",
        _by_scene(found, ("l2_blur", "l2", "pop", "l2_pop"), ask),
    )


def no_worse_than_reset(found: Groups, published: Paper) -> Claim:
    """C-reset: POP is no worse than opacity resets in PSNR."""

    def ask(pop: Group, reset: Group) -> tuple[str, bool | None]:
        change, error = difference(pop, reset, lambda r: r.psnr)
        share = pop.n / reset.n
        return f"{change:+.2f} dB{_noise(error)} with {share:.1%} of its Gaussians", at_least(change, 0.0, error)

    changes = [published.ablation("pop", d, "psnr") - published.ablation("reset", d, "psnr") for d in DATASETS]
    return claim(
        "reset",
        "POP is no worse than opacity reset in PSNR",
        ", ".join(f"{c:+.2f}" for c in changes)
        + f" dB with {_percents(paper_ratios(published, 'pop', 'reset'))} of its Gaussians",
        "PSNR(pop) is at least PSNR(reset)",
        _by_scene(found, ("pop", "reset"), ask),
    )


def window(found: Groups, published: Paper) -> Claim:
    """C-window: 3k-7k is the trade-off: less is too little, more costs Gaussians and brings less."""
    names = ("blur_3k_4k", "pop", "blur_3k_11k", "blur_3k_15k")
    low = min(paper_ratios(published, "blur_3k_15k", "pop"))

    def ask(short: Group, pop: Group, longer: Group, longest: Group) -> tuple[str, bool | None]:
        gain, change = pop.psnr - short.psnr, longest.psnr - pop.psnr
        growth = longest.n / pop.n
        counts = " / ".join(f"{g.n:,.0f}" for g in (short, pop, longer, longest))
        text = f"N {counts} at 4k / 7k / 11k / 15k; PSNR {gain:+.2f} dB from 4k to 7k, {change:+.2f} dB on to 15k"
        return text + f" for x {growth:.2f} of N", gain > 0.0 and gain > change and growth >= low

    def line(d: str) -> str:
        psnr = [published.ablation(row, d, "psnr") for row in names]
        return f"{psnr[1] - psnr[0]:+.2f} then {psnr[3] - psnr[1]:+.2f} dB"

    return claim(
        "window",
        "the window 3k-7k of the blur rule is the trade-off: 3k-4k grows too little, 3k-15k costs two to three times "
        "the Gaussians for a PSNR that changes little",
        f"{', '.join(map(line, DATASETS))}; x {_list(paper_ratios(published, 'blur_3k_15k', 'pop'))} of N at 3k-15k",
        f"PSNR gains from 4k to 7k, and more than from 7k to 15k, which takes at least x {low:.2f} of N",
        _by_scene(found, names, ask),
    )


def decay_after_the_window(found: Groups, published: Paper) -> Claim:
    """C-decay: N peaks when the window closes and POP takes it down from there until density control ends."""
    implied, rates = implied_shares(published), implied_rates(published)
    bound = min(rates) / _SLACK

    def ask(pop: Group) -> tuple[str, bool | None]:
        found = [seen for run in pop.runs if (seen := decay(run)) is not None]
        if not found:
            return "no curve of N", None
        closing, kept, rate = (
            fmean(values) for values in zip(*((f.closing, f.kept, f.rate) for f in found), strict=True)
        )
        top = max(pop.runs[0].curve, key=lambda point: point["num_gaussians"])
        text = f"N is {closing:,.0f} when the window closes and {kept:.1%} of that when density control ends, "
        text += f"{found[0].steps:,} steps later: {rate:.3f} per 1,000 steps; "
        text += f"largest {top['num_gaussians']:,} at {top['step']:,}"
        return text, rate >= bound

    return claim(
        "decay",
        "the number of Gaussians peaks near step 7,000 and POP about halves it by 15,000",
        f"implied by the schedules' counts: {_percents(implied)} left, a rate of {_list(rates, 3)} per 1,000 steps",
        f"a rate of {bound:.3f} per 1,000 steps or more: the smallest that the paper's tables imply, less a sixth; "
        "rates are compared, because a shortened schedule scales neither learning rates nor the weight of the prior",
        _by_scene(found, ("pop",), ask),
    )


def fewer_per_pixel(found: Groups, published: Paper) -> Claim:
    """C-pixel: POP has fewer Gaussians per pixel than 3DGS."""

    def ask(pop: Group, base: Group) -> tuple[str, bool | None]:
        sides = [_per_pixel(pop), _per_pixel(base)]
        if sides[0] is None or sides[1] is None:
            return "not counted by the engine that trained", None
        (blended, traversed), (blended_3dgs, traversed_3dgs) = sides[0], sides[1]
        text = f"blended {blended:.1f} against {blended_3dgs:.1f}, visited {traversed:.1f} against {traversed_3dgs:.1f}"
        return text, blended < blended_3dgs and traversed < traversed_3dgs

    return claim(
        "pixel",
        "POP significantly reduces the Gaussians per pixel against 3DGS",
        "a figure without numbers",
        "fewer are blended and fewer are visited a pixel",
        _by_scene(found, ("pop", "3dgs"), ask),
    )


def l2_beats_scaled_l1(found: Groups, published: Paper) -> Claim:
    """C-l2: L2 has a higher PSNR than L1 / n at as many Gaussians."""

    def evidence() -> Iterator[Evidence]:
        for scene, rows in found.items():
            sweep = [rows[row] for row in SWEEP if row in rows]
            if "l2" not in rows or len(sweep) < 2:
                continue
            used = ids([rows["l2"], *sweep])
            yield Evidence(scene, *_against_sweep(rows["l2"], sweep), used)

    return claim(
        "l2",
        "L2 has a higher PSNR than L1 / n at a comparable number of Gaussians",
        "a figure without numbers",
        "PSNR(l2) is above the curve of PSNR over log N through the runs of L1 / n, inside that curve",
        evidence(),
    )


def compact_against_gsplat(found: Groups, published: Paper) -> Claim:
    """C-compact: POP keeps 4 to 15 % of gsplat's Gaussians."""
    tables = {"Mip-NeRF 360": 1, "Tanks & Temples": 2, "Deep Blending": 1}

    def printed(row: str, dataset: str, metric: str) -> float:
        return published.table(tables[dataset]).value(row, dataset, metric)

    shares = [printed("pop", d, "num_gaussians_k") / printed("gsplat", d, "num_gaussians_k") for d in DATASETS]
    changes = [printed("pop", d, "psnr") - printed("gsplat", d, "psnr") for d in DATASETS]

    def ask(pop: Group, base: Group) -> tuple[str, bool | None]:
        share = pop.n / base.n
        text = f"{pop.n:,.0f} of {base.n:,.0f}, {share:.1%}; PSNR {pop.psnr - base.psnr:+.2f} dB"
        return text, _at_most(share, max(shares), _ratio_error(pop, base))

    return claim(
        "compact",
        "POP has 4 to 15 % of gsplat's Gaussians",
        f"{_percents(shares)} at {', '.join(f'{c:+.2f}' for c in changes)} dB",
        f"N(pop) / N(gsplat) is at most the paper's largest, {max(shares):.1%}",
        _by_scene(found, ("pop", "gsplat"), ask),
    )


def markdown(judged: Sequence[Claim], scale: str) -> str:
    """Render claims: one table of verdicts, then the numbers scene by scene with their runs."""
    parts = [f"## Claims, scale {scale}"]
    if scale == "toy":
        parts.append("**NOT the paper's protocol: a made-up scene for tests. Nothing here says anything of a method.**")
    elif scale != "paper":
        parts.append("**NOT the paper's protocol: other photographs. The paper's numbers are a yardstick here.**")
    verdicts = [[c.says, c.paper, c.verdict, c.where] for c in judged]
    parts.append(grid(["claim", "in the paper", "verdict", "where"], verdicts))
    for c in judged:
        rows = [[e.scene, e.says, _word(e.holds), ", ".join(e.runs)] for e in c.evidence]
        body = (
            grid(["scene", "found", "holds", "runs"], rows) if rows else "Not decided: no scene has the runs it needs."
        )
        parts.append(f"### {c.id}: {c.says}\n\nAsked: {c.holds_if}. In the paper: {c.paper}.\n\n{body}")
    return "\n\n".join(parts) + "\n"


def _word(holds: bool | None) -> str:
    return "not decided" if holds is None else "yes" if holds else "no"


def _by_scene(found: Groups, rows: Sequence[str], ask: Callable[..., tuple[str, bool | None]]) -> Iterator[Evidence]:
    """Ask every scene that has all the rows."""
    for scene, by_row in found.items():
        if all(row in by_row for row in rows):
            used = [by_row[row] for row in rows]
            yield Evidence(scene, *ask(*used), ids(used))


def _at_most(value: float, bound: float, error: float) -> bool | None:
    return at_least(-value, -bound, error)


def _ratio_error(a: Group, b: Group) -> float:
    """Give the standard error of a ratio of counts, relative errors added in squares."""
    relative = [g.error(lambda r: r.num_gaussians) / g.n for g in (a, b)]
    return a.n / b.n * (relative[0] ** 2 + relative[1] ** 2) ** 0.5


def _noise(error: float) -> str:
    return f" ± {error:.2f}" if error > 0.0 else " (one seed)"


def _percents(shares: Sequence[float]) -> str:
    return ", ".join(f"{share:.1%}" for share in shares)


def _list(values: Sequence[float], digits: int = 2) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _per_pixel(group: Group) -> tuple[float, float] | None:
    counted = [(r.n_blended, r.n_traversed) for r in group.runs]
    known = [(b, t) for b, t in counted if b is not None and t is not None]
    if len(known) < len(counted):
        return None
    return sum(b for b, _ in known) / len(known), sum(t for _, t in known) / len(known)


def _against_sweep(l2: Group, sweep: Sequence[Group]) -> tuple[str, bool | None]:
    """Compare with the PSNR of the sweep at the same N, linearly in log N between its neighbours."""
    points = sorted((log(group.n), group.psnr) for group in sweep)
    at = log(l2.n)
    if not points[0][0] <= at <= points[-1][0]:
        reach = f"{exp(points[0][0]):,.0f} to {exp(points[-1][0]):,.0f}"
        return f"L2 has {l2.n:,.0f} Gaussians, outside of the sweep's {reach}", None
    (x0, y0), (x1, y1) = next((a, b) for a, b in pairwise(points) if a[0] <= at <= b[0])
    expected = y0 if x1 == x0 else y0 + (y1 - y0) * (at - x0) / (x1 - x0)
    change, error = l2.psnr - expected, l2.error(lambda r: r.psnr)
    text = f"{l2.psnr:.2f} dB at {l2.n:,.0f} Gaussians, L1 / n there {expected:.2f} dB: {change:+.2f} dB{_noise(error)}"
    return text, None if abs(change) < error else change > 0.0
