"""`pop-repro verify`: a result comes out again at its commit, and one that was altered does not.

What counts as a difference is more than noise. The noise floor and its intervals are held to numbers made by hand, to
scipy, and to how often they decide what is noise.
"""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import count
from math import exp, inf, sqrt
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from paper_repro.claims import claims, noise_of, questions
from paper_repro.cli import main
from paper_repro.evidence import COUNT, MOST_SEEDS, PSNR, SECONDS, Comparison, Noise, compare, groups
from paper_repro.jobs import job_named
from paper_repro.judging import judge
from paper_repro.paper import paper
from paper_repro.results import RESULTS, SCALES, Result, find, read_all, write
from paper_repro.train_row import commit
from paper_repro.verify import history, other_kind
from tests.repro.made import PLAIN, demo
from tests.repro.made import whole as result

FOUND = [result for scale in SCALES for result in read_all(scale, RESULTS)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with the result of POP at toy scale, trained by the command at the commit that is checked out."""
    here = commit()
    if here is None or here.endswith("-dirty"):
        pytest.skip("a result is verified at its commit, and this folder is not a clone without changes")
    folder = tmp_path_factory.mktemp("verify")
    shutil.copytree(demo(), folder / "work" / "demo")
    words = ["run", "pop", "demo", "--scale", "toy", "--results", str(folder / "results")]
    assert main([*words, "--work", str(folder / "work")]) == 0
    return folder


def verify(folder: Path, work: Path, *words: str) -> int:
    # a relative folder, since git and the training are run in others
    where = ["--results", str(folder / "results"), "--work", os.path.relpath(work)]
    return main(["verify", "pop", "demo", "--scale", "toy", *where, *words])


@pytest.mark.slow  # a row is trained several times
def test_a_result_comes_out_again_to_the_last_bit_on_the_same_machine(trained, tmp_path, capsys):
    assert verify(trained, tmp_path) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[-1] == "confirmed: all of it is equal"
    assert "300 steps were trained again; compared 45 points of the curve, the held-out views and the Gaus" in told[-2]
    # the clone and what was trained in it are gone
    assert not [path for path in (tmp_path / "verify").rglob("*") if path.is_file()]


def altered(folder: Path, to: Path, **changes) -> Result:
    """Write the folder's result with changes to another one; the result agrees with itself all the same."""
    result = find("toy", "pop", "demo", 42, folder / "results")
    assert result is not None
    write(replace(result, **changes), to / "results")
    return result


def test_a_result_that_was_altered_and_agrees_with_itself_is_not_confirmed(trained, tmp_path, capsys):
    curve = list(find("toy", "pop", "demo", 42, trained / "results").curve)
    was = curve[1]["psnr"]
    curve[1] = {**curve[1], "psnr": was + 0.1}
    altered(trained, tmp_path, curve=tuple(curve))
    assert verify(tmp_path, tmp_path / "work", "--steps", "40") == 1
    told = capsys.readouterr().out
    assert "NOT confirmed: 1 values differ" in told
    assert f"step 10: psnr is {was}, and the result has {was + 0.1}" in told


def test_another_kind_of_machine_is_held_to_the_tolerances(trained, tmp_path, capsys):
    curve = [{**point, "psnr": 1.0} for point in find("toy", "pop", "demo", 42, trained / "results").curve]
    altered(trained, tmp_path, cpu="another kind", curve=tuple(curve))
    assert verify(tmp_path, tmp_path / "work", "--steps", "40") == 0
    told = capsys.readouterr().out
    assert "another kind of machine: kind of processor is " in told
    assert "within 0.05 of num_gaussians, 0.3 of psnr_test, 0.01 of ssim" in told
    assert told.endswith("confirmed\n")


@pytest.mark.parametrize(
    ("named", "says"),
    [
        ("0" * 40, "commit 0000000000000000000000000000000000000000 is not in "),
        ("abcdef1-dirty", "its commit is abcdef1-dirty, which is no commit; train it again in a clean clone"),
        (None, "its commit is None, which is no commit"),
    ],
)
def test_a_result_whose_commit_is_not_there_is_refused(named, says, tmp_path, capsys):
    if history() is None and named is not None and "dirty" not in named:
        pytest.skip("this folder is not a clone with its history")
    write(replace(PLAIN, commit=named), tmp_path)
    assert main(["verify", "pop", "fox", "--scale", PLAIN.scale, "--results", str(tmp_path)]) == 2
    assert says in capsys.readouterr().err


def test_what_has_no_result_is_refused(tmp_path, capsys):
    assert main(["verify", "pop", "demo", "--scale", "toy", "--results", str(tmp_path)]) == 2
    assert "pop.jsonl: has no result of demo, seed 42, to verify" in capsys.readouterr().err


def test_a_machine_of_the_same_kind_differs_in_nothing():
    assert other_kind(replace(PLAIN, machine="x", cpu=None, versions={}))[0].startswith("processor is ")
    assert [words.split()[0] for words in other_kind(replace(PLAIN, versions={"torch": "0.1"}))][-1] == "torch"


@pytest.mark.parametrize("result", FOUND, ids=lambda r: f"{r.scale}-{r.row}-{r.scene}-{r.seed}")
def test_every_committed_result_names_a_commit_of_this_branch(result: Result):
    commits = history()
    if commits is None:
        pytest.skip("this folder is not a clone with its history")
    assert result.commit in commits, (
        f"{result.row} {result.scene}: {result.commit} is not in this branch; train it again"
    )


@pytest.mark.parametrize("result", FOUND, ids=lambda r: f"{r.scale}-{r.row}-{r.scene}-{r.seed}")
def test_every_committed_result_was_trained_as_its_row_is_now(result: Result):
    from paper_repro.collect import first_change

    job = job_named(result.row, result.scene, result.scale, result.seed)
    assert first_change(result, job.config()) is None


def test_a_finished_row_is_told_and_what_trains_it_again(trained, capsys, tmp_path):
    words = ["run", "pop", "demo", "--scale", "toy", "--results", str(trained / "results"), "--work", str(tmp_path)]
    assert main(words) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("pop demo --scale toy --seed 42 is finished: ")
    assert told[0].endswith(f"trained at commit {commit()[:7]}; --again trains it again")
    assert told[1] == str(trained / "results" / "toy" / "pop.jsonl")
    assert not list(tmp_path.iterdir())


RESET = next(question for question in questions(paper()) if question.id == "reset")


def runs(row: str, *psnr: float, scene: str = "fox", n: int = 1000) -> list[Result]:
    """Make the runs of a row, a seed each."""
    return [result(row, scene, seed=seed, n=n, psnr=value) for seed, value in zip(count(42), psnr, strict=False)]


def compared(pop: list[Result], reset: list[Result], more: Sequence[Result] = ()) -> Comparison:
    """Compare PSNR of two rows on fox."""
    found = compare(
        "PSNR", groups([*pop, *reset])["fox"], noise_of([*pop, *reset, *more]), PSNR, {"pop": 1.0, "reset": -1.0},
        "at least",
    )  # fmt: skip
    assert found is not None
    return found


def test_the_spread_is_pooled_over_rows_and_scenes_about_each_mean() -> None:
    found = noise_of([*runs("pop", 1.0, 3.0), *runs("l2", 5.0, 5.0, 8.0, scene="bear_512"), *runs("reset", 77.0)])
    spread = found.of(PSNR)
    assert spread is not None
    # 2 and 6, over one and two degrees of freedom
    assert (spread.s, spread.df, spread.groups) == (pytest.approx(sqrt(8.0 / 3.0)), 3, 2)
    assert (spread.least, spread.largest) == (pytest.approx(sqrt(2.0)), pytest.approx(sqrt(3.0)))
    assert noise_of(runs("pop", 1.0)).of(PSNR) is None


def test_counts_vary_by_their_ratios_and_times_on_each_machine_alone() -> None:
    two = [result(seed=s, n=n, machine=m) for s, n, m in ((1, 1000, "a"), (2, 2000, "b"))]
    spread = noise_of(two).of(COUNT)
    assert spread is not None
    assert exp(spread.s * sqrt(2.0)) == pytest.approx(2.0)
    assert noise_of(two).of(SECONDS) is None
    same = [replace(r, machine="a", seconds={**r.seconds, "cpu": 100.0 * r.seed}) for r in two]
    known = noise_of(same).of(SECONDS)
    assert known is not None
    assert exp(known.s * sqrt(2.0)) == pytest.approx(2.0)
    # a CPU's time by the clock is no time of a method
    by_clock = [replace(r, seconds={"load": 1.0, "train": 100.0 * r.seed, "evaluate": 1.0}) for r in same]
    assert noise_of(by_clock).of(SECONDS) is None


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
    assert compared(runs("pop", 30.0001), runs("reset", 30.0), floor).seeds_needed(1) == MOST_SEEDS
    assert compared(runs("pop", 31.0), runs("reset", 30.0)).seeds_needed(1) == 3


@cache
def made(row: str, scene: str, seed: int) -> Result:
    """Make a run once: its hashes take longer than a verdict."""
    return result(row, scene, seed=seed)


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
    effects: dict[str, float], seeds: dict[str, int], repeated: int, sigma: float, seed: int
) -> None:
    rng = random.Random(seed)
    found = drawn(rng, {scene: effect * sigma for scene, effect in effects.items()}, seeds, sigma)
    # without this row shapes of one seed each have no noise floor
    found += [result("gsplat", "fox", seed=42 + i, psnr=rng.gauss(31.0, sigma)) for i in range(repeated)]
    told = next(claim for claim in claims("small", found) if claim.id == "reset")
    verdicts = {e.scene: e.verdict for e in told.told.evidence}
    assert verdicts == {scene: "holds" if effect > 0.0 else "does not hold" for scene, effect in effects.items()}
    assert told.verdict == ("holds" if min(effects.values()) > 0.0 else "does not hold")


def test_no_noise_is_no_floor_of_zero() -> None:
    assert Noise([]).of(PSNR) is None
