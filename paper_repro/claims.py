"""The paper's claims, each as comparisons that the runs of one scale bear out or do not.

Bounds are the paper's own numbers wherever it has any; on other photographs they are a yardstick only. How a comparison
is decided is in `paper_repro.evidence`, how scenes and readings are put together in `paper_repro.judging`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from math import exp, log
from typing import Final, Literal

from paper_repro.evidence import (
    BLENDED,
    COUNT,
    DATASETS,
    PSNR,
    SECONDS,
    SSIM,
    VISITED,
    Claim,
    Comparison,
    Group,
    Noise,
    Quantity,
    compare,
    groups,
    paper_ratios,
    with_error,
)
from paper_repro.judging import SWEEP, Ask, Question, judge
from paper_repro.paper import Metric, Paper, paper
from paper_repro.results import Result
from paper_repro.tables import setting

# the claims that the paper's summary rests on, in the order in which the outcome is told
HEADLINES: Final = ("fast", "fewest", "above", "comparable", "reset")
# the methods of the main tables besides POP
METHODS: Final = (
    *("3dgs", "gsplat", "pup", "pup_star", "mini_splatting", "mini_splatting_star"),
    *("taming", "speedy_splat"),
)
# the schedules of the blur rule, the shortest first, with the step at which the window closes
WINDOWS: Final = {"blur_3k_4k": 4_000, "pop": 7_000, "blur_3k_11k": 11_000, "blur_3k_15k": 15_000}
# steps between two changes of the Gaussians in the paper
REFINE_EVERY: Final = 100

Groups = Mapping[str, Group]


def claims(scale: str, results: Iterable[Result]) -> tuple[Claim, ...]:
    """Judge every claim by the results of one scale."""
    mine = [r for r in results if r.scale == scale]
    found, noise = groups(mine), noise_of(mine)
    return tuple(judge(question, found, noise, scale) for question in questions(paper()))


def noise_of(results: Iterable[Result]) -> Noise:
    """Give the noise floor of results of one scale."""
    return Noise(group for by_row in groups(results).values() for group in by_row.values())


def questions(published: Paper) -> tuple[Question, ...]:
    """Make the questions, with their bounds from the paper's numbers."""
    return (
        _fastest(published),
        _fewest(published),
        _above(published),
        _comparable(published),
        _compact(published),
        _half(published),
        _blur(published),
        _reset(published),
        _window(published),
        _growth(published),
        _pixel(),
        _l2(),
    )


def _fastest(published: Paper) -> Question:
    saved = [
        f"{_printed(published, 'pop', d, 'time_s'):.0f} s, the next {_next(published, d, 'time_s')}" for d in DATASETS
    ]
    return Question(
        "fast",
        "POP trains the fastest of the methods",
        _by_dataset(saved),
        "the time of POP is below that of each method; runs on one machine alone are compared",
        ("pop", *METHODS),
        [_against(SECONDS, "pop", other, "at most", 0.0) for other in METHODS],
        of_times=True,
    )


def _fewest(published: Paper) -> Question:
    datasets = ("Mip-NeRF 360", "Deep Blending")
    # the starred methods were given POP's number of Gaussians
    others = tuple(row for row in METHODS if not row.endswith("_star"))

    counts = [
        f"{_printed(published, 'pop', d, 'num_gaussians_k'):.0f}k, the next {_next(published, d, 'num_gaussians_k')}"
        for d in datasets
    ]
    return Question(
        "fewest",
        "POP has the fewest Gaussians of the methods",
        _by_dataset(counts, datasets) + "; not claimed for Tanks & Temples",
        "N(pop) is below that of each method of table 1",
        ("pop", *others),
        [_against(COUNT, "pop", other, "at most", 0.0) for other in others],
        datasets=datasets,
    )


def _above(published: Paper) -> Question:
    others = ("pup", "speedy_splat")
    changes = [_change(published, other, "Mip-NeRF 360", "psnr") for other in others]
    return Question(
        "above",
        "POP has a higher PSNR than PUP-3DGS and Speedy-Splat",
        f"{_each(changes, '+.2f')} dB against PUP-3DGS and Speedy-Splat on Mip-NeRF 360, the only data set of this "
        "claim",
        "PSNR(pop) is above PSNR(pup) and PSNR(speedy_splat)",
        ("pop", *others),
        [_against(PSNR, "pop", other, "at least", 0.0) for other in others],
        datasets=("Mip-NeRF 360",),
    )


def _comparable(published: Paper) -> Question:
    psnr, ssim = ([_change(published, "3dgs", d, metric) for d in DATASETS] for metric in ("psnr", "ssim"))
    return Question(
        "comparable",
        "the quality of POP is comparable to that of 3DGS",
        f"{_each(psnr, '+.2f')} dB and {_each(ssim, '+.3f')} of SSIM against 3DGS ({', '.join(DATASETS)})",
        f"comparable is read as the paper's own tables have it: no more below 3DGS than their largest differences, "
        f"{min(psnr):+.2f} dB and {min(ssim):+.3f} of SSIM",
        ("pop", "3dgs"),
        [_against(quantity, "pop", "3dgs", "at least", min(of)) for quantity, of in ((PSNR, psnr), (SSIM, ssim))],
    )


def _compact(published: Paper) -> Question:
    shares = [
        _printed(published, "pop", d, "num_gaussians_k") / _printed(published, "gsplat", d, "num_gaussians_k")
        for d in DATASETS
    ]
    changes = [_change(published, "gsplat", d, "psnr") for d in DATASETS]
    return Question(
        "compact",
        "POP has 4 to 15 % of gsplat's Gaussians",
        f"{_each(shares, '.1%')} at {_each(changes, '+.2f')} dB",
        f"N(pop) / N(gsplat) is at most the paper's largest, {max(shares):.1%}",
        ("pop", "gsplat"),
        [_against(COUNT, "pop", "gsplat", "at most", log(max(shares))), _against(PSNR, "pop", "gsplat")],
    )


def _half(published: Paper) -> Question:
    return Question(
        "half",
        "POP cuts the number of Gaussians by half or more against L2 with the blur rule",
        f"{_each(paper_ratios(published, 'pop', 'l2_blur'), '.1%')} of L2+Blur's Gaussians ({', '.join(DATASETS)})",
        "N(pop) / N(l2_blur) is at most 50 %",
        ("pop", "l2_blur"),
        [_against(COUNT, "pop", "l2_blur", "at most", log(0.5)), _against(PSNR, "pop", "l2_blur")],
        of_duration=True,
    )


def _blur(published: Paper) -> Question:
    without, with_pop = paper_ratios(published, "l2_blur", "l2"), paper_ratios(published, "pop", "l2_pop")
    return Question(
        "blur",
        "the blur rule multiplies the number of Gaussians",
        f"x {_each(without, '.2f')} without POP, x {_each(with_pop, '.2f')} with it",
        f"at least the paper's least factors, {min(without):.2f} without POP and {min(with_pop):.2f} with it",
        ("l2_blur", "l2", "pop", "l2_pop"),
        [
            _against(COUNT, "l2_blur", "l2", "at least", log(min(without)), "factor"),
            _against(COUNT, "pop", "l2_pop", "at least", log(min(with_pop)), "factor"),
        ],
        of_duration=True,
    )


def _reset(published: Paper) -> Question:
    changes = [published.ablation("pop", d, "psnr") - published.ablation("reset", d, "psnr") for d in DATASETS]
    return Question(
        "reset",
        "POP is no worse than opacity reset in PSNR",
        f"{_each(changes, '+.2f')} dB with {_each(paper_ratios(published, 'pop', 'reset'), '.1%')} of its Gaussians",
        "PSNR(pop) is at least PSNR(reset)",
        ("pop", "reset"),
        [_against(PSNR, "pop", "reset", "at least", 0.0), _against(COUNT, "pop", "reset")],
        of_duration=True,
        always=("A16 on",),
    )


def _window(published: Paper) -> Question:
    short, pop, _, longest = WINDOWS
    low = min(paper_ratios(published, longest, pop))

    def psnr(says: str, weights: Mapping[str, float]) -> Ask:
        return lambda rows, noise: compare(says, rows, noise, PSNR, weights, "at least", 0.0)

    def line(d: str) -> str:
        psnr = [published.ablation(row, d, "psnr") for row in (short, pop, longest)]
        return f"{psnr[1] - psnr[0]:+.2f} then {psnr[2] - psnr[1]:+.2f} dB"

    return Question(
        "window",
        "the window 3k-7k of the blur rule is the trade-off: 3k-4k grows too little, 3k-15k costs two to three times "
        "the Gaussians for a PSNR that changes little",
        f"{', '.join(map(line, DATASETS))}; x {_each(paper_ratios(published, longest, pop), '.2f')} of N at 3k-15k",
        f"PSNR gains from 4k to 7k, and more than from 7k to 15k, which takes at least x {low:.2f} of N",
        (short, pop, longest),
        [
            psnr("PSNR from 4k to 7k", {pop: 1.0, short: -1.0}),
            psnr("that gain less the gain from 7k to 15k", {pop: 2.0, short: -1.0, longest: -1.0}),
            _against(COUNT, longest, pop, "at least", log(low), "factor"),
        ],
        of_duration=True,
    )


def _growth(published: Paper) -> Question:
    names = tuple(WINDOWS)

    def line(d: str) -> str:
        counts = {row: published.ablation(row, d, "num_gaussians_k") for row in names}
        return " / ".join(f"{rate:.1f}k" for rate in _rates(counts, _densifications({})))

    def ask(rows: Groups, noise: Noise) -> Comparison | str | None:
        if any(row not in rows or rows[row].n <= 0.0 for row in names):
            return None
        counts, steps = {row: rows[row].n for row in names}, _densifications(rows)
        if min(steps) <= 0.0:
            return "the windows that the runs had are not each longer than the one before"
        early, late = (counts["pop"] - counts["blur_3k_4k"]) / steps[0], counts["blur_3k_15k"] - counts["pop"]
        value = late / (steps[1] + steps[2]) - early
        # the slope along each mean of log N is N times that along N
        slopes = {
            "blur_3k_4k": counts["blur_3k_4k"] / steps[0],
            "pop": -counts["pop"] * (1.0 / steps[0] + 1.0 / (steps[1] + steps[2])),
            "blur_3k_15k": counts["blur_3k_15k"] / (steps[1] + steps[2]),
        }
        told = " / ".join(f"{rate:,.0f}" for rate in _rates(counts, steps))
        says = f"{told} Gaussians a densification step from 4k to 7k, to 11k, to 15k; after 7k less before"
        parts = [(COUNT, slope, len(rows[row].runs)) for row, slope in slopes.items()]
        return with_error(says, value, parts, noise, "at least", 0.0, "plain")

    return Question(
        "growth",
        "the blur rule keeps adding Gaussians as long as its window lasts",
        f"table 4: {', '.join(map(line, DATASETS))} Gaussians a densification step from 4k to 7k, to 11k, to 15k",
        "the growth of N a densification step by which the windows differ is no smaller from 7k to 15k than from 4k "
        "to 7k, as in all three data sets",
        names,
        [ask],
        of_duration=True,
    )


def _pixel() -> Question:
    return Question(
        "pixel",
        "POP significantly reduces the Gaussians per pixel against 3DGS",
        "a figure without numbers",
        "fewer are blended and fewer are visited a pixel",
        ("pop", "3dgs"),
        [
            _against(quantity, "pop", "3dgs", "at most", 0.0, says=f"{what}, pop / 3dgs")
            for what, quantity in (("blended", BLENDED), ("visited", VISITED))
        ],
    )


def _l2() -> Question:
    def ask(rows: Groups, noise: Noise) -> Comparison | str | None:
        sweep = {row: rows[row] for row in SWEEP if row in rows}
        return against_sweep(rows["l2"], sweep, noise) if "l2" in rows and len(sweep) > 1 else None

    return Question(
        "l2",
        "L2 has a higher PSNR than L1 / n at a comparable number of Gaussians",
        "a figure without numbers",
        "PSNR(l2) is above the curve of PSNR over log N through the runs of L1 / n, inside that curve",
        ("l2", *SWEEP),
        [ask],
    )


def against_sweep(l2: Group, sweep: Mapping[str, Group], noise: Noise) -> Comparison | str:
    """Compare L2 with the PSNR of L1 / n at as many Gaussians, linearly in log N between its neighbours by count.

    Returns:
        The difference in dB, or why there is none: N of L2 lies outside of the sweep.
    """
    at, points = log(max(l2.n, 1.0)), sorted((log(max(g.n, 1.0)), g.psnr, len(g.runs)) for g in sweep.values())
    found = next(((a, b) for a, b in pairwise(points) if a[0] <= at <= b[0]), None)
    if found is None:
        reach = f"{exp(points[0][0]):,.0f} to {exp(points[-1][0]):,.0f}"
        return f"L2 has {exp(at):,.0f} Gaussians, outside of the sweep's {reach}"
    (x0, y0, n0), (x1, y1, n1) = found
    slope, part = ((y1 - y0) / (x1 - x0), (at - x0) / (x1 - x0)) if x1 > x0 else (0.0, 0.5)
    expected = y0 + (y1 - y0) * part
    # PSNR of the three runs, and the count of each, which moves the place on the curve
    weights = ((1.0, len(l2.runs)), (part - 1.0, n0), (-part, n1))
    parts = [(PSNR, weight, n) for weight, n in weights] + [(COUNT, slope * weight, n) for weight, n in weights]
    says = f"{l2.psnr:.2f} dB at {exp(at):,.0f} Gaussians, L1 / n there {expected:.2f} dB:"
    return with_error(says, l2.psnr - expected, parts, noise, "at least", 0.0, "dB")


def _against(
    quantity: Quantity,
    row: str,
    base: str,
    asked: Literal["at least", "at most", "nothing"] = "nothing",
    bound: float = 0.0,
    shown_as: Literal["factor"] | None = None,
    says: str = "",
) -> Ask:
    """Compare a row with another, by their ratio where the quantity is compared by logarithms, else by difference."""
    name = "N" if quantity is COUNT else quantity.name
    text = says or f"{name} {row} {'/' if quantity.is_log else '-'} {base}"
    return lambda rows, noise: compare(text, rows, noise, quantity, {row: 1.0, base: -1.0}, asked, bound, shown_as)


def _densifications(rows: Groups) -> tuple[float, float, float]:
    """Count the changes of the Gaussians by which each window is longer than the one before it."""
    ends, every = [], REFINE_EVERY
    for row, published in WINDOWS.items():
        run = rows[row].runs[0] if row in rows else None
        end = setting(run, "blur_stop_iter") if run is not None else None
        ends.append(published if end is None else end)
        every = (setting(run, "refine_every") if run is not None else None) or every
    first, second, third = ((b - a) / every for a, b in pairwise(ends))
    return first, second, third


def _rates(counts: Mapping[str, float], steps: Sequence[float]) -> list[float]:
    """Give the growth a densification step between neighbouring windows."""
    return [(counts[b] - counts[a]) / n for (a, b), n in zip(pairwise(WINDOWS), steps, strict=True)]


def _printed(published: Paper, row: str, dataset: str, metric: str) -> float:
    """Give a number of the main tables."""
    return published.table(2 if dataset == "Tanks & Temples" else 1).value(row, dataset, metric)


def _change(published: Paper, base: str, dataset: str, metric: str) -> float:
    return _printed(published, "pop", dataset, metric) - _printed(published, base, dataset, metric)


def _next(published: Paper, dataset: str, metric: str) -> str:
    """Name the best of the other methods of a main table, with its number."""
    told: Metric = published.metrics[metric]
    lines = published.table(2 if dataset == "Tanks & Temples" else 1).rows
    best = min((line.values[dataset][metric], line.name) for line in lines if line.row != "pop")
    return f"{best[0]:.0f}{' ' if told.unit == 's' else ''}{told.unit} ({best[1]})"


def _by_dataset(texts: Sequence[str], datasets: Sequence[str] = DATASETS) -> str:
    return "; ".join(f"{dataset} {text}" for dataset, text in zip(datasets, texts, strict=True))


def _each(values: Iterable[float], form: str) -> str:
    return ", ".join(f"{value:{form}}" for value in values)
