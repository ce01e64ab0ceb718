"""Claims, readings and experiments on results whose answer is known by hand."""

from __future__ import annotations

from dataclasses import replace
from math import exp, log
from typing import Any

import pytest

from paper_repro.claims import SWEEP, claims, markdown
from paper_repro.evidence import (
    DATASETS,
    Claim,
    Group,
    at_least,
    decay,
    difference,
    implied_rates,
    implied_shares,
    paper_ratios,
)
from paper_repro.paper import paper
from paper_repro.readings import READINGS, answers, experiments
from paper_repro.results import Result
from tests.repro.made import curve, result

SCHEDULE = {
    "max_steps": 10_000,
    "strategy.blur_stop_iter": 2333,
    "strategy.refine_stop_iter": 5000,
    "strategy.lambda_pop": 0.001,
}


def judged(id: str, results: list[Result], scale: str = "small") -> Claim:
    """Judge one claim."""
    return next(claim for claim in claims(scale, results) if claim.id == id)


def with_curve(row: str, closing: int, end: int, scene: str = "fox", blur_stop: int = 2333, **changes: Any) -> Result:
    """Make a result whose N is known when the blur window closes and when density control ends."""
    steps = curve({0: 100, 2333: closing, 5000: end, 9999: end})
    schedule = {**SCHEDULE, "strategy.blur_stop_iter": blur_stop}
    return result(row, scene, n=end, curve=steps, schedule=schedule, **changes)


def test_pop_at_half_the_count_holds_and_just_above_does_not() -> None:
    base = result("l2_blur", n=100_000)
    at, above = (judged("half", [base, result("pop", n=n)]) for n in (50_000, 50_001))
    assert (at.verdict, above.verdict) == ("holds", "does not hold")
    assert at.evidence[0].says == "50,000 of 100,000, 50.0%; PSNR +0.00 dB"
    assert set(at.evidence[0].runs) == {base.run, result("pop", n=50_000).run}


def test_a_claim_is_told_scene_by_scene() -> None:
    rows = [result("l2_blur", s, n=100) for s in ("bear_512", "fox", "garden_512")]
    told = judged("half", [*rows, result("pop", "fox", n=40), result("pop", "bear_512", n=60)])
    assert told.verdict == "holds in part"
    assert told.where == "on fox; not on bear_512"
    assert [e.scene for e in told.evidence] == ["bear_512", "fox"]


def test_without_runs_nothing_is_decided() -> None:
    for claim in claims("small", [result("pop"), replace(result("l2_blur"), scale="toy")]):
        assert claim.verdict == "not decided"
        assert claim.where == "no runs decide"
        assert not claim.evidence or claim.id == "decay"
    assert judged("decay", [result("pop")]).evidence[0].says == "no curve of N"


def test_what_lies_within_the_noise_of_the_seeds_is_not_decided() -> None:
    pop = [result("pop", seed=s, n=50, psnr=p) for s, p in ((1, 30.0), (2, 30.2))]
    close = [result("reset", seed=s, n=100, psnr=p) for s, p in ((1, 30.05), (2, 30.25))]
    far = [result("reset", seed=s, n=100, psnr=p) for s, p in ((1, 30.55), (2, 30.75))]
    assert judged("reset", [*pop, *close]).verdict == "not decided"
    assert judged("reset", [*pop, *far]).verdict == "does not hold"
    one = judged("reset", [pop[0], close[0]])
    assert one.verdict == "does not hold"
    assert "(one seed)" in one.evidence[0].says


def test_errors_are_those_of_the_mean() -> None:
    a = Group(tuple(result(seed=s, psnr=p) for s, p in ((1, 1.0), (2, 3.0))))
    b = Group((result(psnr=1.5),))
    assert difference(a, b, lambda r: r.psnr) == (0.5, pytest.approx(1.0))
    assert at_least(0.5, 0.0, 1.0) is None
    assert at_least(0.5, 0.0, 0.1) is True
    assert at_least(-0.5, 0.0, 0.1) is False
    assert at_least(0.0, 0.0, 0.0) is True


@pytest.mark.parametrize(
    ("counts", "verdict"),
    [((278, 100, 191, 100), "holds"), ((150, 100, 191, 100), "does not hold"), ((278, 100, 120, 100), "does not hold")],
)
def test_the_blur_rule_has_to_multiply_with_pop_and_without(counts: tuple[int, ...], verdict: str) -> None:
    rows = zip(("l2_blur", "l2", "pop", "l2_pop"), counts, strict=True)
    assert judged("blur", [result(row, n=n) for row, n in rows]).verdict == verdict


@pytest.mark.parametrize(
    ("psnr", "longest", "verdict"),
    [
        ((29.0, 30.0, 30.1, 30.1), 250, "holds"),
        ((30.5, 30.0, 30.1, 30.1), 250, "does not hold"),
        ((29.9, 30.0, 30.1, 30.3), 250, "does not hold"),
        ((29.0, 30.0, 30.1, 30.1), 150, "does not hold"),
    ],
)
def test_the_window_is_a_trade_off(psnr: tuple[float, ...], longest: int, verdict: str) -> None:
    rows = ("blur_3k_4k", "pop", "blur_3k_11k", "blur_3k_15k")
    told = [result(row, n=n, psnr=p) for row, n, p in zip(rows, (60, 100, 140, longest), psnr, strict=True)]
    assert judged("window", told).verdict == verdict


def test_the_decay_is_read_off_the_curve_where_the_schedule_says() -> None:
    run = with_curve("pop", 1000, 500)
    assert decay(run) == (1000.0, 0.5, 2667)
    told = judged("decay", [run])
    assert told.verdict == "holds"
    assert "50.0%" in told.evidence[0].says
    assert f"2,667 steps later: {log(2) / 2.667:.3f} per 1,000 steps" in told.evidence[0].says
    assert "largest 1,000 at 2,333" in told.evidence[0].says
    # in 2,667 steps a rate of 0.0775, the paper's smallest less a sixth, leaves 81.3 %
    assert judged("decay", [with_curve("pop", 1000, 810)]).verdict == "holds"
    assert judged("decay", [with_curve("pop", 1000, 820)]).verdict == "does not hold"
    assert decay(with_curve("pop", 1000, 500, blur_stop=5000)) is None
    # without settings in the result, the paper's fractions of the schedule
    plain = replace(run, schedule={}, curve=curve({0: 100, 7000: 900, 15_000: 450}))
    assert decay(plain) == (900.0, 0.5, 8000)
    assert decay(replace(run, curve=curve({0: 100, 2000: 900}))) is None


def test_gaussians_per_pixel_need_both_counts() -> None:
    base = result("3dgs", n_blended=50.0, n_traversed=400.0)
    assert judged("pixel", [base, result(n_blended=40.0, n_traversed=300.0)]).verdict == "holds"
    assert judged("pixel", [base, result(n_blended=40.0, n_traversed=401.0)]).verdict == "does not hold"
    assert judged("pixel", [base, result(n_blended=None, n_traversed=None)]).verdict == "not decided"


def test_l2_is_compared_with_the_sweep_at_its_own_count() -> None:
    sweep = [result("l1_div_1", n=400, psnr=30.0), result("l1_div_10", n=100, psnr=28.0)]
    above, below = (judged("l2", [*sweep, result("l2", n=200, psnr=p)]) for p in (29.1, 28.9))
    # half way in log N
    assert (above.verdict, below.verdict) == ("holds", "does not hold")
    assert "L1 / n there 29.00 dB: +0.10 dB" in above.evidence[0].says
    outside = judged("l2", [*sweep, result("l2", n=99, psnr=35.0)])
    assert outside.verdict == "not decided"
    assert "outside of the sweep's 100 to 400" in outside.evidence[0].says
    assert judged("l2", [sweep[0], result("l2", n=200)]).evidence == ()
    assert len(SWEEP) == 7


def test_compactness_is_held_to_the_papers_largest_share() -> None:
    base = result("gsplat", n=10_000)
    assert [judged("compact", [base, result(n=n)]).verdict for n in (1461, 1463)] == ["holds", "does not hold"]


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
    psnr = [told.ablation("pop", d, "psnr") - told.ablation("reset", d, "psnr") for d in DATASETS]
    assert [round(change, 2) for change in psnr] == [0.19, 0.71, 0.12]
    assert implied_rates(told) == tuple(-log(share) / 8 for share in implied_shares(told))
    assert all(0.09 <= rate <= 0.14 for rate in implied_rates(told))
    # a data set of the paper, judged as if it were a scene
    rows = {line.row for table in told.tables[2:] for line in table.rows}
    for d in DATASETS:
        runs = [
            result(row, n=round(1000 * told.ablation(row, d, "num_gaussians_k")), psnr=told.ablation(row, d, "psnr"))
            for row in rows
        ]
        for id in ("half", "blur", "reset", "window"):
            assert judged(id, runs).verdict == "holds", (id, d)


def test_a_toy_is_said_to_tell_nothing_and_other_data_to_be_a_yardstick() -> None:
    runs = [result("pop", n=40), result("l2_blur", n=100)]
    assert "Nothing here says anything of a method" in markdown(claims("toy", runs), "toy")
    text = markdown(claims("small", runs), "small")
    assert "NOT the paper's protocol" in text
    assert f"| fox | 40 of 100, 40.0%; PSNR +0.00 dB | yes | {runs[0].run}, {runs[1].run} |" in text
    assert "NOT the paper's" not in markdown(claims("paper", []), "paper")
    assert text.count("Not decided: no scene has the runs it needs.") == 6


def test_the_reading_whose_decay_is_the_papers_speaks_for_itself() -> None:
    goal = exp(sum(map(log, implied_rates(paper()))) / 3)
    right, wrong = round(1000 * exp(-2.667 * goal)), 900
    default = answers([with_curve("pop", 1000, right), with_curve("pop_visible", 1000, wrong)])
    other = answers([with_curve("pop", 1000, wrong), with_curve("pop_visible", 1000, right)])
    a12 = [next(a for a in told if a.id == "A12") for told in (default, other)]
    assert "is `pop`, the default, on fox (small)" in a12[0].says
    assert "is `pop_visible`, not the default, on fox (small)" in a12[1].says
    assert [line[2] for line in a12[0].lines] == ["pop", "pop_visible"]
    assert [a.id for a in default] == [r.id for r in READINGS] == ["A2", "A2, added up", "A12", "A16"]


def test_a_reading_is_not_decided_without_all_its_rows_or_their_curves() -> None:
    half = answers([with_curve("pop", 1000, 400), result("pop_any_view")])
    assert half[0].says.startswith("Not decided")
    assert len(half[0].lines) == 2
    flat = answers([result("pop"), result("pop_visible")])
    assert flat[2].says.startswith("Not decided")
    assert flat[2].lines[0][3] == "no curve"
    toy = [replace(r, scale="toy") for r in (with_curve("pop", 1000, 400), with_curve("pop_visible", 1000, 900))]
    assert answers(toy)[2].lines == ()


def test_a_longer_schedule_at_one_weight_answers_in_part() -> None:
    dev = [with_curve("pop", 100, 50), result("l2_blur", n=100)]
    full = [
        replace(r, scale="full", scene="bonsai_800", schedule={**SCHEDULE, "max_steps": 30_000})
        for r in (with_curve("pop", 100, 40), result("l2_blur", n=100))
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
    pop, pruned = result("pop", n=100, psnr=30.0), result("final_prune", n=70, psnr=29.9)
    told = experiments([pop, pruned, result("gsplat", n=200)])[1]
    assert told.lines[0][:6] == ("small", "fox", "final_prune", "70.0%", "-0.10 dB", "35.0%")
    assert experiments([pruned])[1].says.startswith("Not decided")


def test_the_reading_whose_growth_is_the_papers_speaks_for_itself() -> None:
    runs = [result("l2", n=100), result("l2_blur", n=230), result("l2_blur_any_view", n=900)]
    told = experiments(runs)[2]
    assert told.says == "Nearest to the paper's factors (x 2.78, x 2.52, x 1.54) is `l2_blur`."
    assert [line[4] for line in told.lines] == ["x 2.30", "x 9.00"]
    assert experiments([replace(runs[1], num_gaussians=240), replace(runs[2], num_gaussians=90), runs[0]])[
        2
    ].says.endswith("is `l2_blur`.")
    assert experiments(runs[:2])[2].says.startswith("Not decided")
