"""Claims, readings and experiments on results whose answer is known by hand.

The noise floor and its intervals are held to numbers made by hand, to scipy, and to how often they decide what is
noise.
"""

from __future__ import annotations

import random
import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import count
from math import exp, inf, sqrt
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from paper_repro.claims import HEADLINES, METHODS, SWEEP, WINDOWS, against_sweep, claims, noise_of, questions
from paper_repro.cli import main
from paper_repro.evidence import (
    COUNT,
    DATASETS,
    MOST_SEEDS,
    PSNR,
    SECONDS,
    Claim,
    Comparison,
    Noise,
    compare,
    groups,
    is_shortened,
    paper_ratios,
)
from paper_repro.jobs import ROWS, job_named, load_row
from paper_repro.judging import OTHERS, judge
from paper_repro.paper import paper
from paper_repro.results import Result
from paper_repro.status import (
    READINGS,
    Answer,
    answers,
    columns,
    experiments,
    headlines,
    markdown,
    outcome,
    settled,
    telling,
)
from tests.repro.made import WHOLE, curve, whole

SCHEDULE = {
    "max_steps": 10_000,
    "strategy.blur_stop_iter": 2333,
    "strategy.refine_stop_iter": 5000,
    "strategy.lambda_pop": 0.001,
}
_OFF = ((42, -0.01), (43, 0.01))


def judged(id: str, results: list[Result], scale: str = "small") -> Claim:
    return next(claim for claim in claims(scale, results) if claim.id == id)


def two(row: str, scene: str = "fox", n: int = 100_000, psnr: float = 30.0, **changes: Any) -> list[Result]:
    """Make a row with two seeds that differ by 0.02 dB, 0.2 % of their Gaussians and 0.0002 of SSIM."""
    ssim = changes.pop("ssim", 0.9)
    return [
        whole(row, scene, seed=seed, n=round(n * (1.0 + off / 10.0)), psnr=psnr + off, ssim=ssim + off / 100, **changes)
        for seed, off in _OFF
    ]


def test_half_the_count_is_decided_beyond_the_noise_alone() -> None:
    base = two("l2_blur")
    verdicts = [judged("half", [*base, *two("pop", n=n)]).verdict for n in (49_000, 50_000, 51_000)]
    assert verdicts == ["holds", "not decided", "does not hold"]
    told = judged("half", [*base, *two("pop", n=40_000, psnr=29.5)]).told.evidence[0]
    assert re.fullmatch(
        r"N pop / l2_blur 40\.0% \(39\.8% to 40\.2%\); PSNR pop - l2_blur -0\.50 ± 0\.0\d+ dB", told.says
    )
    assert set(told.runs) == {r.run for r in [*base, *two("pop", n=40_000)]}


def test_one_scene_that_fails_is_enough_and_scenes_are_told_one_by_one() -> None:
    rows = [r for s in ("fox", "bear_512") for r in two("l2_blur", s)]
    told = judged("half", [*rows, *two("pop", "fox", n=40_000), *two("pop", "bear_512", n=60_000)])
    assert told.verdict == "does not hold"
    assert told.line == "does not hold on bear_512; holds on fox"
    assert [e.scene for e in told.told.evidence] == ["fox", "bear_512"]


def test_without_runs_nothing_is_decided_and_every_claim_names_the_runs() -> None:
    for found in ([], [whole("pop"), replace(whole("l2_blur"), scale="toy")]):
        for claim in claims("small", found):
            assert claim.verdict == "not decided", claim.id
            assert claim.told.deciders, claim.id


def test_one_seed_decides_nothing_where_no_row_has_two_and_else_beyond_the_noise() -> None:
    pop, reset = whole("pop", psnr=31.0), whole("reset", psnr=30.0)
    alone = judged("reset", [pop, reset])
    assert alone.verdict == "not decided"
    assert "no row has two seeds" in alone.told.evidence[0].why
    assert alone.told.deciders[0].endswith("--rows pop reset --scenes fox --seeds 3")
    assert judged("reset", [pop, reset, *two("l2", "bear_512")]).verdict == "holds"
    near = judged("reset", [replace(pop, psnr=30.01), reset, *two("l2", "bear_512")])
    assert (near.verdict, near.told.evidence[0].why) == ("not decided", "within the noise of the seeds")
    assert re.search(r"--rows pop reset --scenes fox --seeds \d+$", near.told.deciders[0])


def test_every_command_that_would_decide_is_one(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    # of a folder without results, so that no row which is done here is missing from the list
    empty = ["--results", str(tmp_path)]
    found = [whole("pop", psnr=30.01), whole("reset"), *two("l2"), *two("gsplat", "bear_512"), whole("pop_size_prune")]
    for claim in claims("small", found):
        for told in (claim.told, *claim.others):
            for line in told.deciders:
                words = shlex.split(line, comments=True)
                assert words[:2] == ["pop-repro", "queue"]
                assert main([*words[1:], *empty, "--list"]) == 0
                assert capsys.readouterr().out.strip(), line


def test_the_fewest_runs_that_would_decide_a_claim_are_named() -> None:
    def enough(fox: float, bear: float) -> list[str]:
        pairs = [*two("pop", psnr=30.0 + fox), *two("reset"), *two("pop", "bear_512", psnr=30.0 + bear)]
        told = judged("reset", [*pairs, *two("reset", "bear_512")]).told
        assert told.verdict == "not decided"
        return [command.partition("--scenes ")[2] for command in told.enough]

    # all scenes have to hold
    both = enough(0.01, 0.005)
    assert [command.split()[0] for command in both] == ["fox", "bear_512"]
    # one on which it does not is enough, and of several the one that takes the fewest seeds
    assert enough(0.01, -0.005) == [both[1]]
    assert enough(-0.01, -0.005) == [both[0]]
    # a scene that no number of seeds decides keeps it open, unless it fails on another
    assert enough(0.01, 0.0) == []
    assert enough(-0.01, 0.0) == [both[0]]


@pytest.mark.parametrize("id", ["half", "blur", "reset", "window", "growth"])
def test_a_shortened_schedule_decides_no_question_of_duration(id: str) -> None:
    rows = next(question.rows for question in questions(paper()) if question.id == id)
    ends = {"blur_3k_4k": 1333, "blur_3k_11k": 3667, "blur_3k_15k": 5000}
    for offset in (0.0, 5.0, -5.0):
        found = [
            r
            for i, row in enumerate(rows)
            for r in two(
                row,
                n=100_000 * (1 + 9 * (i % 2)),
                psnr=30.0 + offset * i,
                schedule={**SCHEDULE, "strategy.blur_stop_iter": ends.get(row, 2333)},
            )
        ]
        told = judged(id, found)
        assert told.verdict == "not decided"
        assert [e.why for e in told.told.evidence] == ["a shortened schedule decides no question of duration"]
        assert "--scale small" in told.told.deciders[0]
    assert is_shortened([replace(whole(), schedule={})])
    assert not is_shortened([whole(schedule={"max_steps": 30_000})])


def test_pop_against_reset_is_told_under_both_readings_of_a16() -> None:
    default = [*two("pop", psnr=30.5), *two("reset", psnr=30.0)]
    assert judged("reset", default).line.endswith("under A16 on: not decided: no scene has all its runs")
    told = judged("reset", [*default, *two("pop_size_prune", psnr=29.5)])
    assert told.line == "holds on fox; under A16 on: does not hold on fox"
    assert told.others[0].evidence[0].says.startswith("PSNR pop - reset -0.50 ± ")


def test_other_readings_are_told_where_all_rows_that_they_change_are_trained() -> None:
    found = [r for row in ("pop", "l2_blur", "pop_size_prune", "pop_any_view", "pop_sum") for r in two(row)]
    assert judged("half", found).others == ()
    told = judged("half", [*found, *two("l2_blur_any_view", n=400_000)])
    assert told.line == "does not hold on fox; under A2 any view: holds on fox"
    assert {o.reading for o in judged("compact", [*found, *two("gsplat")]).others} == {
        "A16 on", "A2 any view", "A2 added up"
    }  # fmt: skip


def test_a_reading_changes_the_rows_that_its_setting_acts_on() -> None:
    asked = {row for question in questions(paper()) for row in question.rows}
    acts = {"A16 on": set(), "A2 any view": set(), "A2 added up": set(), "A12 visible": set()}
    asked = {row for row in asked - set(SWEEP[1:]) if load_row(row).method == "pop"}
    for row in asked:
        strategy: Any = job_named(row, "fox", "small").config().strategy
        if not strategy.prune_too_big:
            acts["A16 on"].add(row)
        if strategy.blur_stop_iter >= strategy.blur_start_iter:
            acts["A2 any view"].add(row)
            acts["A2 added up"].add(row)
        if strategy.lambda_pop > 0.0:
            acts["A12 visible"].add(row)
    assert {other.name: set(other.rows) & asked for other in OTHERS} == acts
    assert {name for other in OTHERS for name in other.rows.values() if name is not None} <= set(ROWS)


@pytest.mark.parametrize(
    ("counts", "verdict"),
    [((278, 100, 191, 100), "holds"), ((150, 100, 191, 100), "does not hold"), ((278, 100, 120, 100), "does not hold")],
)
def test_the_blur_rule_has_to_multiply_with_pop_and_without(counts: tuple[int, ...], verdict: str) -> None:
    rows = zip(("l2_blur", "l2", "pop", "l2_pop"), counts, strict=True)
    assert judged("blur", [r for row, n in rows for r in two(row, n=1000 * n)]).verdict == verdict


@pytest.mark.parametrize(
    ("psnr", "longest", "verdict"),
    [
        ((29.0, 30.0, 30.1), 250, "holds"),
        ((30.5, 30.0, 30.1), 250, "does not hold"),
        ((29.9, 30.0, 30.3), 250, "does not hold"),
        ((29.0, 30.0, 30.1), 150, "does not hold"),
    ],
)
def test_the_window_is_a_trade_off(psnr: tuple[float, ...], longest: int, verdict: str) -> None:
    rows = ("blur_3k_4k", "pop", "blur_3k_15k")
    told = zip(rows, (60, 100, longest), psnr, strict=True)
    assert judged("window", [r for row, n, p in told for r in two(row, n=1000 * n, psnr=p)]).verdict == verdict


@pytest.mark.parametrize(
    ("counts", "verdict"),
    [
        ((100, 190, 310, 430), "not decided"), ((100, 160, 300, 460), "holds"),
        ((100, 190, 230, 250), "does not hold"),
    ],
)  # fmt: skip
def test_growth_is_that_of_table_4_a_densification_step(counts: tuple[int, ...], verdict: str) -> None:
    rows = ("blur_3k_4k", "pop", "blur_3k_11k", "blur_3k_15k")
    told = judged(
        "growth",
        [
            r
            for row, n in zip(rows, counts, strict=True)
            for r in two(row, n=1000 * n, schedule={**WHOLE, "pop.blur_stop_iter": WINDOWS[row]})
        ],
    )
    assert told.verdict == verdict
    rates = [1000 * (b - a) / n for a, b, n in zip(counts, counts[1:], (30, 40, 40), strict=False)]
    assert told.told.evidence[0].says.startswith(" / ".join(f"{rate:,.0f}" for rate in rates))
    # 3.1k, 3.15k and 4.2k on Mip-NeRF 360
    assert "table 4: 3.1k / 3.1k / 4.2k, 2.8k / 3.6k / 5.9k, 0.6k / 1.8k / 3.6k" in told.paper


def test_gaussians_per_pixel_need_both_counts() -> None:
    base = two("3dgs", n_blended=50.0, n_traversed=400.0)

    def verdict(**counts: Any) -> str:
        return judged("pixel", [*base, *two("pop", **counts)]).verdict

    assert verdict(n_blended=40.0, n_traversed=300.0) == "holds"
    assert verdict(n_blended=40.0, n_traversed=401.0) == "does not hold"
    assert verdict(n_blended=None, n_traversed=None) == "not decided"


def test_l2_is_compared_with_the_sweep_at_its_own_count() -> None:
    far = [r for row in SWEEP[2:] for r in two(row, n=1_000, psnr=20.0)]
    sweep = [*far, *two("l1_div_1", n=400_000, psnr=30.0), *two("l1_div_2", n=100_000, psnr=28.0)]
    above, below = (judged("l2", [*sweep, *two("l2", n=200_000, psnr=p)]) for p in (29.2, 28.8))
    # half way in log N
    assert (above.verdict, below.verdict) == ("holds", "does not hold")
    assert "L1 / n there 29.00 dB: +0.20 ± " in above.told.evidence[0].says
    near = judged("l2", [*sweep, *two("l2", n=200_000, psnr=29.01)])
    assert near.told.evidence[0].why == "within the noise of the seeds"
    # by as many further degrees of freedom as there are further runs of the three rows
    rows = groups([*sweep, *two("l2", n=200_000, psnr=29.01)])["fox"]
    nearer = against_sweep(rows.pop("l2"), rows, noise_of(r for group in rows.values() for r in group.runs))
    assert isinstance(nearer, Comparison)
    assert nearer.seeds == (2, 2, 2)
    # what no affordable number of seeds would decide is said to be so, and no command is told to decide it
    same = judged("l2", [*sweep, *two("l2", n=200_000, psnr=29.0001)])
    assert same.told.evidence[0].why == "within the noise of the seeds, and 99 of each row would not decide it"
    assert not any("--scenes fox" in command for command in same.told.deciders)
    outside = judged("l2", [*sweep, *two("l2", n=999, psnr=35.0)])
    assert outside.verdict == "not decided"
    assert "outside of the sweep's 1,000 to 400,000" in outside.told.evidence[0].why
    assert (
        judged("l2", [*two("l1_div_1"), *two("l2")])
        .told.deciders[0]
        .endswith(f"--rows {' '.join(SWEEP[1:])} --scenes fox")
    )


def test_a_method_that_is_faster_or_smaller_is_enough_and_all_of_them_are_needed() -> None:
    slow = {"load": 1.0, "evaluate": 1.0, "train": 200.0, "cpu": 200.0}
    fast = {**slow, "cpu": 50.0}
    others = [r for row in METHODS for r in two(row, n=200_000, seconds=slow)]
    pop = two("pop")
    assert [judged(id, [*pop, *others]).verdict for id in ("fast", "fewest")] == ["holds", "holds"]
    some = judged("fast", [*pop, *two("gsplat", seconds=slow)])
    assert some.verdict == "not decided"
    assert some.told.evidence[0].why.startswith("not run: 3dgs, pup, ")
    assert judged("fast", [*pop, *two("gsplat", seconds=fast)]).verdict == "does not hold"
    assert judged("fewest", [*pop, *two("gsplat", n=50_000)]).verdict == "does not hold"


def test_times_compare_on_one_machine_and_not_by_the_clock_of_a_cpu() -> None:
    fast = {"load": 1.0, "evaluate": 1.0, "train": 50.0, "cpu": 50.0}
    pop, other = two("pop"), two("gsplat", seconds=fast)
    assert judged("fast", [*pop, *other]).verdict == "does not hold"
    elsewhere = [replace(r, machine="another") for r in other]
    told = judged("fast", [*pop, *elsewhere])
    assert (told.verdict, told.told.evidence) == ("not decided", ())
    # two seeds of gsplat are there, and a queue would not train them again
    assert told.told.deciders[0].startswith("pop-repro queue --scale small --data DATA --rows 3dgs gsplat pup ")
    assert told.told.deciders[0].endswith(f"--scenes fox --seeds 3  # on {pop[0].trained_on}")
    # with as many threads as what is there was timed with
    on_two = judged("fast", [replace(r, threads=2) for r in pop] + elsewhere).told.deciders[0]
    assert on_two.endswith("--scenes fox --seeds 3 --threads 2  # on a machine (a kind), native, 2 threads")
    by_clock = [replace(r, seconds={k: v for k, v in r.seconds.items() if k != "cpu"}) for r in other]
    assert judged("fast", [*pop, *by_clock]).verdict == "not decided"


def test_the_runs_that_are_told_to_decide_which_is_faster_do_so_where_seeds_were_timed_elsewhere() -> None:
    def timed(row: str, seed: int, cpu: float) -> Result:
        return whole(row, seed=seed, seconds={"load": 1.0, "evaluate": 1.0, "train": cpu, "cpu": cpu})

    pop = [timed("pop", seed, cpu) for seed, cpu in ((42, 95.0), (43, 105.0))]
    others = [timed(row, seed, cpu) for row in METHODS for seed, cpu in ((42, 101.0), (43, 111.0))]
    # seeds that the queue finds done, and that do not count
    elsewhere = [replace(timed("taming", seed, 50.0), machine="another") for seed in range(44, 60)]
    found = [*pop, *others, *elsewhere]
    told = judged("fast", found).told
    assert (told.verdict, told.evidence[0].why) == ("not decided", "within the noise of the seeds")
    (enough,) = told.enough
    assert enough == told.deciders[0]
    line, _, where = enough.partition("  # on ")
    assert where == pop[0].trained_on
    seeds = int(line.rpartition(" --seeds ")[2])
    done = {(r.row, r.seed) for r in found}
    new = [(row, seed) for row in ("pop", *METHODS) for seed in range(42, 42 + seeds) if (row, seed) not in done]
    more = [timed(row, seed, 100.0 if row == "pop" else 106.0) for row, seed in new]
    assert judged("fast", [*found, *more]).verdict == "holds"


def test_comparable_is_read_off_the_papers_own_differences() -> None:
    base = two("3dgs", psnr=30.0, ssim=0.9)
    verdicts = [
        judged("comparable", [*base, *two("pop", psnr=30.0 + d, ssim=0.9 + s)]).verdict
        for d, s in ((-1.0, -0.01), (-1.4, -0.01), (-1.0, -0.06))
    ]
    assert verdicts == ["holds", "does not hold", "does not hold"]
    assert "-1.22 dB and -0.051 of SSIM" in judged("comparable", []).holds_if


def test_the_papers_own_numbers_bear_its_claims_out() -> None:
    told = paper()
    rounded = {
        ("pop", "l2_blur"): (0.46, 0.48, 0.40),
        ("l2_pop", "l2"): (0.67, 0.71, 0.49),
        ("l2_blur", "l2"): (2.78, 2.52, 1.54),
        ("pop", "l2_pop"): (1.91, 1.71, 1.26),
    }
    for (row, base), ratios in rounded.items():
        assert tuple(round(r, 2) for r in paper_ratios(told, row, base)) == ratios
    # a data set of the paper, judged as if it were a scene; where it sets the bound itself it lies on it
    asked = {"half", "blur", "reset", "window", "growth", "fast", "fewest", "above", "comparable", "compact"}
    on_the_bound = {
        ("blur", "Deep Blending"), ("window", "Mip-NeRF 360"), ("comparable", "Deep Blending"),
        ("comparable", "Mip-NeRF 360"), ("compact", "Tanks & Temples"),
    }  # fmt: skip
    for d in DATASETS:
        cells = {line.row: line.values[d] for t in reversed(told.tables) if d in t.datasets for line in t.rows}
        # the starred methods are in the table of Tanks & Temples alone
        cells |= {row: cells["gsplat"] for row in METHODS if row not in cells}
        runs = [
            r
            for row, v in cells.items()
            for r in two(
                row, n=round(1000 * v["num_gaussians_k"]), psnr=v["psnr"], ssim=v["ssim"],
                seconds={"load": 1.0, "evaluate": 1.0, "train": 1.0, "cpu": v["time_s"]},
                schedule={**WHOLE, "pop.blur_stop_iter": WINDOWS.get(row, 7_000)},
            )
        ]  # fmt: skip
        for id in asked:
            if d not in next(question.datasets for question in questions(told) if question.id == id):
                continue
            expected = "not decided" if (id, d) in on_the_bound else "holds"
            assert judged(id, runs).verdict == expected, (id, d, judged(id, runs).told.evidence)


def test_what_bears_on_a_comparison_besides_the_method_stands_beside_it() -> None:
    pop = {
        **WHOLE, "pop.theta_blur": 2e-5, "pop.blur_min_pixels": 10.0, "pop.reset_every": 0,
        "pop.refine_stop_iter": 15_000,
    }  # fmt: skip
    reset = {**pop, "pop.reset_every": 3000}
    told = judged("reset", [*two("pop", schedule=pop), *two("reset", schedule=reset)])
    assert told.under == (
        "fox: 270 x 480 px; 30,000 steps; theta_blur 10 px by its floor, 3.9 times the paper's 2.6 px at this size; "
        "reset: 4 resets, 2 of them inside the blur window 3,000 to 7,000"
    )
    text = markdown("small", [*two("pop", schedule=pop), *two("reset", schedule=reset)])
    line = next(line for line in text.splitlines() if line.startswith("| POP is no worse"))
    assert "within" not in line
    assert told.under in line
    free = {**pop, "pop.blur_min_pixels": 0.0}
    assert "theta_blur 2.6 px, no floor" in judged("half", [*two("pop", schedule=free), *two("l2_blur")]).under
    short = {**reset, "max_steps": 10_000, "pop.blur_stop_iter": 2333, "pop.refine_stop_iter": 5000,
             "pop.blur_start_iter": 1000}  # fmt: skip
    assert "reset: 1 resets, 0 of them inside" in judged("reset", [*two("pop"), *two("reset", schedule=short)]).under


def test_a_toy_is_said_to_tell_nothing_and_other_data_to_be_a_yardstick() -> None:
    runs = [*two("pop", n=40_000), *two("l2_blur")]
    for scale in ("toy", "shown"):
        assert "These numbers say nothing about a method" in markdown(scale, runs)
    assert telling() == ["paper", "full", "no_floor", "small"]
    text = markdown("small", runs)
    assert "NOT the paper's protocol" in text
    assert "PSNR 0.014 dB (2 degrees of freedom, 2 pairs of row and scene, on fox alone, each between" in text
    assert "scene, on bear_512, fox, each between" in markdown("small", [*runs, *two("pop", "bear_512")])
    assert "| default | fox | N pop / l2_blur 40.0% (39.8% to 40.2%)" in text
    assert text.count("```sh") >= 12
    empty = markdown("paper", [])
    assert "Noise floor: none" in empty
    assert "| verdict |" not in empty
    assert "`pop-repro claims --scale small` names the runs that would decide them" in empty
    assert "NOT the paper's" not in markdown("paper", [])


def outcome_cells(results: list[Result]) -> list[list[str]]:
    """Take the outcome's table apart: claim, scale, verdict, verdicts under other readings."""
    table = outcome(headlines(results))
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


def test_the_outcome_is_five_lines_each_with_an_interval_or_the_run_that_decides() -> None:
    lines = outcome_cells([])
    assert len(lines) == len(HEADLINES) == 5
    assert all(line[1:3] == ["small", "**not decided**"] for line in lines)
    # one for each, and one for the claim that is told under another reading even where nothing was run
    assert settled(headlines([])).count("\npop-repro queue --scale small") == len(HEADLINES) + 1
    runs = [*two("pop", psnr=30.5), *two("reset"), *two("pop_size_prune", psnr=29.5), *two("3dgs", psnr=31.0)]
    reset, comparable = outcome_cells(runs)[4], outcome_cells(runs)[3]
    assert reset[0] == "POP is no worse than opacity reset in PSNR"
    assert reset[2].startswith("**holds**<br>fox: PSNR pop - reset +0.50 ± ")
    assert reset[3].startswith("**does not hold**<br>fox: PSNR pop - reset -0.50 ± ")
    # a difference below 0 holds by the bound that it is held to
    assert re.fullmatch(
        r"\*\*holds\*\*<br>fox: PSNR pop - 3dgs -0\.50 ± \S+ dB, where at least -1\.22 dB is asked", comparable[2]
    )
    halved = judged("half", [*two("pop", n=40_000), *two("l2_blur", n=100_000)]).told.evidence
    assert halved[0].nearest.endswith("%), where at most 50.0% is asked")
    # the paper's own scale is told before others that decide too
    both = [*runs, *(replace(r, scale="paper", scene="bonsai") for r in [*two("pop"), *two("reset", psnr=29.0)])]
    assert outcome_cells(both)[4][1] == "paper"
    assert outcome_cells(both)[4][2].startswith("**holds**<br>bonsai: PSNR ")


# Readings of what the paper leaves open, and experiments, on results whose answer is known by hand.


def a12(results: list[Result]) -> Answer:
    """Answer one question by runs of both readings: `pop` and, where only what is seen is polarised, `pop_visible`."""
    return next(answer for answer in answers(results) if answer.id == "A12")


def with_curve(row: str, closing: int, end: int, scene: str = "fox", blur_stop: int = 2333, **changes: Any) -> Result:
    """Make a result whose N is known when the blur window closes and when density control ends."""
    steps = curve({0: 100, 2333: closing, 5000: end, 9999: end})
    schedule = {**SCHEDULE, "strategy.blur_stop_iter": blur_stop}
    return whole(row, scene, n=end, curve=steps, schedule=schedule, **changes)


def test_a_reading_is_judged_by_every_column_and_by_no_pair_of_rows_alone() -> None:
    # as the paper's first data set, against half as many Gaussians and a decibel less
    near, far = {"n": 268, "psnr": 27.01, "ssim": 0.760}, {"n": 134, "psnr": 26.01, "ssim": 0.700}
    base = [whole("l2_blur", n=583, psnr=27.22, ssim=0.771), whole("reset", n=548, psnr=26.82, ssim=0.780)]
    told = a12([*base, whole("pop", **near), whole("pop_visible", **far)])
    assert told.says == (
        "The runs favour the default: of 6 columns 6 are nearer to the paper's under the default, 0 under "
        "A12 visible, 0 alike, also without any one pair."
    )
    assert told.lines[0] == (
        *("small", "fox", "pop and l2_blur", "N over N", "0.460, 0.483, 0.397", "0.460", "0.230", "default"),
    )
    assert [line[2:4] for line in told.lines[1:]] == [
        *(("pop and l2_blur", column) for column in ("PSNR", "SSIM")),
        *(("pop and reset", column) for column in ("N over N", "PSNR", "SSIM")),
    ]
    swapped = a12([*base, whole("pop", **far), whole("pop_visible", **near)])
    assert swapped.says.startswith("The runs favour A12 visible: of 6 columns 0 ")
    # the pair that a claim rests on does not decide the reading under which that claim is judged
    alone = a12([base[0], whole("pop", **near), whole("pop_visible", **far)])
    assert alone.says.startswith("Not decided: of 3 columns 3 ")
    assert [a.id for a in answers([])] == [r.id for r in READINGS] == ["A2", "A2, added up", "A12", "A16"]


def test_both_readings_within_the_papers_range_are_alike() -> None:
    base = whole("l2_blur", n=1000, psnr=27.0, ssim=0.77)
    pop, other = (whole(row, n=n, psnr=26.9, ssim=0.765) for row, n in (("pop", 460), ("pop_visible", 400)))
    told = a12([base, pop, other])
    assert [line[-1] for line in told.lines] == ["alike"] * 3
    assert told.says == (
        "Not decided: of 3 columns 0 are nearer to the paper's under the default, 0 under A12 visible, 3 alike."
    )


def test_a_reading_needs_the_rows_that_it_changes() -> None:
    # any view changes L2+Blur too, which is not there under it
    found = answers([whole("pop"), whole("l2_blur"), whole("l2_pop"), whole("pop_any_view")])
    assert {line[2] for line in found[0].lines} == {"pop and l2_pop"}
    assert answers([whole("pop"), whole("l2_blur")])[0].says.startswith("Not decided: no scene")
    assert a12([replace(r, scale="toy") for r in (whole("pop"), whole("pop_visible"), whole("reset"))]).lines == ()


def test_columns_are_those_of_the_tables_and_growth_is_a_share_a_step() -> None:
    found = {(column.rows, column.quantity): column.printed for column in columns(paper())}
    assert len(found) == 9 * 3 + 3
    assert found[("pop", "gsplat"), "N over N"] == pytest.approx((268 / 3168, 269 / 1840, 118 / 3042), rel=1e-9)
    grown = found[("blur_3k_11k", "pop"), "growth a densification step over N of the shorter"]
    assert grown == pytest.approx(((394 - 268) / 268 / 40, (412 - 269) / 269 / 40, (188 - 118) / 118 / 40), rel=1e-9)


def test_a_longer_schedule_at_one_weight_answers_in_part() -> None:
    dev = [with_curve("pop", 100, 50), whole("l2_blur", n=100)]
    full = [
        replace(r, scale="full", scene="bonsai_800", schedule={**SCHEDULE, "max_steps": 30_000})
        for r in (with_curve("pop", 100, 40), whole("l2_blur", n=100))
    ]
    alone, apart = experiments(dev)[0], experiments([*dev, *full])[0]
    assert alone.says.startswith("Not decided")
    # of different scenes, so that the schedule is not all that differs
    assert apart.says.startswith("Not decided")
    assert [line[:5] for line in apart.lines] == [
        ("full", "bonsai_800", "30,000", "0.001", "40.0%"),
        ("small", "fox", "10,000", "0.001", "50.0%"),
    ]
    both = experiments([*(replace(r, scene="bonsai_800") for r in dev), *full])[0]
    assert both.says == (
        "One weight on several lengths of the schedule of bonsai_800, below. "
        "No row divides the weight by the scaler, so that rule is not judged here."
    )


def test_pruning_harder_is_told_beside_pop_and_gsplat() -> None:
    pop, pruned = whole("pop", n=100, psnr=30.0), whole("final_prune", n=70, psnr=29.9)
    told = experiments([pop, pruned, whole("gsplat", n=200)])[1]
    assert told.lines[0][:6] == ("small", "fox", "final_prune", "70.0%", "-0.10 dB", "35.0%")
    assert experiments([pruned])[1].says.startswith("Not decided")


RESET = next(question for question in questions(paper()) if question.id == "reset")


def runs(row: str, *psnr: float, scene: str = "fox", n: int = 1000) -> list[Result]:
    return [whole(row, scene, seed=seed, n=n, psnr=value) for seed, value in zip(count(42), psnr, strict=False)]


def compared(pop: list[Result], reset: list[Result], more: Sequence[Result] = ()) -> Comparison:
    found = compare(
        "PSNR", groups([*pop, *reset])["fox"], noise_of([*pop, *reset, *more]), PSNR, {"pop": 1.0, "reset": -1.0},
        "at least",
    )  # fmt: skip
    assert found is not None
    return found


def test_the_spread_is_pooled_over_rows_and_scenes_about_each_mean() -> None:
    found = noise_of([*runs("pop", 1.0, 3.0), *runs("l2", 5.0, 5.0, 8.0, scene="bear_512"), *runs("reset", 77.0)])
    spread = found.of(PSNR)
    # 2 and 6, over one and two degrees of freedom
    assert (spread.s, spread.df, spread.groups) == (pytest.approx(sqrt(8.0 / 3.0)), 3, 2)
    assert (spread.least, spread.largest) == (pytest.approx(sqrt(2.0)), pytest.approx(sqrt(3.0)))
    # no noise is no floor of zero
    assert noise_of(runs("pop", 1.0)).of(PSNR) is Noise([]).of(PSNR) is None


def test_counts_vary_by_their_ratios_and_times_on_each_machine_alone() -> None:
    two = [whole(seed=s, n=n, machine=m) for s, n, m in ((1, 1000, "a"), (2, 2000, "b"))]
    spread = noise_of(two).of(COUNT)
    assert exp(spread.s * sqrt(2.0)) == pytest.approx(2.0)
    assert noise_of(two).of(SECONDS) is None
    same = [replace(r, machine="a", seconds={**r.seconds, "cpu": 100.0 * r.seed}) for r in two]
    known = noise_of(same).of(SECONDS)
    assert exp(known.s * sqrt(2.0)) == pytest.approx(2.0)
    # a CPU's time by the clock is no time of a method
    by_clock = [replace(r, seconds={"load": 1.0, "train": 100.0 * r.seed, "evaluate": 1.0}) for r in same]
    assert noise_of(by_clock).of(SECONDS) is None
    # a budget's count is no evidence of how little counts vary that grow
    budget = [whole("taming", seed=s, n=500) for s in (1, 2, 3)]
    assert noise_of([*two, *budget]).of(COUNT) == spread
    assert noise_of([*two, *budget]).of(PSNR).df == 3


def test_the_interval_of_two_rows_is_that_of_the_t_test_with_one_variance() -> None:
    pop, reset = (30.0, 30.3, 30.1), (29.5, 29.9)
    found = compared(runs("pop", *pop), runs("reset", *reset))
    expected = stats.ttest_ind(pop, reset).confidence_interval(0.95)
    half = found.half_width(1)
    assert (found.value - half, found.value + half) == (pytest.approx(expected.low), pytest.approx(expected.high))
    # four at once: each with a quarter of the probability to miss
    wider = stats.ttest_ind(pop, reset).confidence_interval(1.0 - 0.05 / 4.0)
    assert found.half_width(4) == pytest.approx((wider.high - wider.low) / 2.0)


def test_one_seed_decides_nothing_without_a_noise_floor_and_only_beyond_it_with_one() -> None:
    bare = compared(runs("pop", 40.0), runs("reset", 30.0))
    assert (bare.holds(1), bare.half_width(1)) == (None, inf)
    assert bare.text(1) == "PSNR +10.00 dB (no interval)"
    floor = runs("l2", 30.0, 30.1, 30.2)
    # t for two degrees of freedom is 4.303, and s sqrt(2) is 0.1414
    beyond, within = (compared(runs("pop", 30.0 + d), runs("reset", 30.0), floor) for d in (0.62, 0.60))
    assert (beyond.holds(1), within.holds(1)) == (True, None)
    assert compared(runs("pop", 29.3), runs("reset", 30.0), floor).holds(1) is False
    assert beyond.text(1) == "PSNR +0.62 ± 0.61 dB"


def test_the_seeds_that_are_asked_for_decide_when_the_difference_stays() -> None:
    floor = runs("l2", 30.0, 30.1, 30.2)
    pop, reset = 30.2, 30.0
    n = compared(runs("pop", pop), runs("reset", reset), floor).seeds_needed(1)
    assert 2 < n < MOST_SEEDS

    # the same spread about the same means with so many seeds, and with one less
    def with_seeds(seeds: int) -> bool | None:
        each = [0.1 * sqrt((seeds - 1) / seeds) * (-1) ** i for i in range(seeds - seeds % 2)] + [0.0] * (seeds % 2)
        return compared(runs("pop", *(pop + e for e in each)), runs("reset", *(reset + e for e in each)), floor).holds(
            1
        )

    assert with_seeds(n) is True
    assert with_seeds(n - 2) is None
    assert compared(runs("pop", 30.0001), runs("reset", 30.0), floor).seeds_needed(1) is None
    assert compared(runs("pop", 31.0), runs("reset", 30.0)).seeds_needed(1) == 3


@cache
def made(row: str, scene: str, seed: int) -> Result:
    """Make a run once: its hashes take longer than a verdict."""
    return whole(row, scene, seed=seed)


def drawn(rng: random.Random, effects: dict[str, float], seeds: dict[str, int], sigma: float) -> list[Result]:
    """Draw results of POP, Reset and L2 on scenes, where POP is better by a scene's effect."""
    return [
        replace(made(row, scene, 42 + i), psnr=rng.gauss(30.0 + (effect if row == "pop" else 0.0), sigma))
        for scene, effect in effects.items()
        for row, n in seeds.items()
        for i in range(n)
    ]


@pytest.mark.parametrize("scenes", [("fox",), ("fox", "bear_512")])
@pytest.mark.parametrize("seeds", [{"pop": 2, "reset": 2, "l2": 2}, {"pop": 1, "reset": 1, "l2": 3}])
def test_without_a_difference_a_verdict_is_as_rare_as_stated(scenes: tuple[str, ...], seeds: dict[str, int]) -> None:
    rng, trials, decided = random.Random(7), 500, 0
    for _ in range(trials):
        found = drawn(rng, dict.fromkeys(scenes, 0.0), seeds, 0.2)
        told = judge(RESET, groups(found), noise_of(found), "small").told
        decided += any(e.verdict != "not decided" for e in told.evidence)
    # 5 %, or somewhat less where scenes share one noise floor; four standard errors are 3.9 %
    assert 0.01 < decided / trials < 0.09


@given(
    effects=st.dictionaries(
        st.sampled_from(("fox", "bear_512", "garden_512", "bonsai_800")), st.sampled_from((-40.0, 40.0)), min_size=1
    ),
    seeds=st.fixed_dictionaries({"pop": st.integers(1, 3), "reset": st.integers(1, 3), "l2": st.integers(1, 3)}),
    repeated=st.integers(5, 8),
    sigma=st.floats(0.001, 0.5),
    seed=st.integers(0, 10**6),
)
def test_a_difference_far_beyond_the_noise_is_decided_by_its_sign_in_results_of_any_shape(
    effects, seeds, repeated, sigma, seed
):
    rng = random.Random(seed)
    found = drawn(rng, {scene: effect * sigma for scene, effect in effects.items()}, seeds, sigma)
    # without this row shapes of one seed each have no noise floor
    found += [whole("gsplat", "fox", seed=42 + i, psnr=rng.gauss(31.0, sigma)) for i in range(repeated)]
    told = next(claim for claim in claims("small", found) if claim.id == "reset")
    verdicts = {e.scene: e.verdict for e in told.told.evidence}
    assert verdicts == {scene: "holds" if effect > 0.0 else "does not hold" for scene, effect in effects.items()}
    assert told.verdict == ("holds" if min(effects.values()) > 0.0 else "does not hold")
