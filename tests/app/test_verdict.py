"""The report's verdict: its numbers, no contradictions, and commands that ask for the run that was judged and help."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.cli import main, parse
from pop_fast.cli.data_check import Args as DataCheck
from pop_fast.cli.export import Args as Export
from pop_fast.cli.train import arguments as train_arguments
from pop_fast.train import TrainConfig
from pop_fast.train.load_result import CaptureRecord, record_text
from pop_fast.view.report.checks import Checks, read_checks
from pop_fast.view.report.model import Finding, verdict
from pop_fast.view.report.source import read_result, typed
from tests.app.conftest import Pop

GOOD = Checks(
    photographs=60,
    train_psnr=31.0,
    train_measured=12,
    held_out_psnr=29.5,
    matched_psnr=29.6,
    neighbour_degrees=4.0,
    stops={"a": -0.02, "b": 0.03},
    floaters={"a": 0.0, "b": 0.002},
    misfits={"a": 0.0, "b": 0.004},
)


ONE = {"a": 0.3}
SIX_APART = {"train_psnr": 24.8, "held_out_psnr": 18.6}


def orbit(shares: list[float]) -> dict[str, float]:
    return {f"frame {i}": share for i, share in enumerate(shares)}


@pytest.mark.parametrize(
    ("about", "changes", "kind", "words"),
    [
        ("Overfitting", {}, "good", "training views 31.00 dB, held-out views 29.50 dB, 1.5 dB apart"),
        (
            "Overfitting",
            {"train_psnr": 29.46},
            "good",
            "training views 29.46 dB, held-out views 29.50 dB, 0.0 dB apart.",
        ),
        ("Overfitting", {"train_psnr": 34.0}, "look", "4.5 dB apart"),
        ("Overfitting", {"train_psnr": 34.5, "held_out_psnr": 24.5}, "bad", "10.0 dB apart"),
        (
            "Overfitting",
            {"train_psnr": 39.5},
            "look",
            "memorised its photographs and fits the views in between less well, though close",
        ),
        ("Overfitting", {"train_psnr": 39.5, "steps": 9_000}, "look", "already short, 150 steps a photograph"),
        ("Overfitting", {"held_out_psnr": None, "matched_psnr": None}, "look", "No view was held out"),
        ("Photographs", {}, "good", "60 trained on, neighbours 4.0 degrees apart"),
        ("Photographs", {"photographs": 11}, "look", "few. More photographs, also from other sides, would help"),
        ("Photographs", {"photographs": 11, "train_psnr": 30.0, "held_out_psnr": 24.0}, "bad", "too few"),
        ("Photographs", {"photographs": 11, "train_psnr": 36.0}, "look", "few"),
        ("Photographs", {"train_psnr": 37.4, "held_out_psnr": 29.9}, "look", "not quite enough for this subject"),
        ("Photographs", {"neighbour_degrees": 25.0}, "look", "far apart"),
        ("Photographs", {"given": 66, "placed": 61}, "good", "60 trained on"),
        ("Photographs", {"given": 100, "placed": 68}, "look", "Cameras were found for 68 of 100 photographs. 60"),
        ("Photographs", {"photographs": 4, "given": 14, "placed": 5}, "look", "for 5 of 14 photographs. 4 trained on"),
        ("Exposure", {}, "good", "-0.02 (a) to +0.03 stops (b)"),
        ("Exposure", {"stops": {"a": -0.2, "b": 0.2}}, "look", "standard deviation 0.20"),
        ("Exposure", {"stops": {**{f"v{i}": 0.0 for i in range(40)}, "b": -0.4}}, "look", "-0.40 (b)"),
        ("Exposure", {"stops": {"a": -0.5, "b": 0.5}}, "bad", "29.60 dB instead of 29.50"),
        ("Floaters", {}, "good", "at most 0.20 % of a view"),
        ("Floaters", {"floaters": {"a": 0.0, "b": 0.015}}, "look", "worst b, 1.5 %"),
        ("Floaters", {"floaters": {"a": 0.1, "b": 0.3}}, "bad", "20.0 % of the pixels"),
        # frames of the orbit vanish, and no photograph's view shows anything
        ("Floaters", {"orbit_floaters": orbit(53 * [0.0] + 7 * [0.8])}, "bad", "hides much of 7 views"),
        ("Floaters", {"orbit_floaters": orbit(59 * [0.0] + [0.8])}, "bad", "hides much of one view between the"),
        ("Floaters", {"orbit_floaters": orbit(60 * [0.001])}, "good", "2 photographs' views and 60"),
        ("Floaters", {"floaters": {"a": 0.0}}, "good", "looked for in one photograph's view and 0"),
        ("Floaters", {"floaters": ONE, "without_floaters": 29.45}, "bad", "29.45 dB instead of 29.50"),
        ("Floaters", {"floaters": ONE, "without_floaters": 29.499}, "bad", "held-out views keep their 29.50 dB."),
        ("Floaters", {"floaters": ONE, "without_floaters": 28.0}, "look", "without them held-out views have 28.00"),
        ("Fit", {}, "good", "reach 31.00 dB"),
        ("Fit", {"misfits": {"a": 0.02, "b": 0.05}}, "look", "3.5 % of a photograph is far from its render"),
        ("Fit", {"patches": {"a": 0.0, "b": 0.004}}, "good", "reach 31.00 dB"),
        ("Fit", {"patches": {"a": 0.0, "b": 0.006}}, "look", "0.3 % of a photograph has another colour"),
        ("Fit", {"train_psnr": 21.0, "held_out_psnr": 19.0}, "look", "or wrong cameras"),
        ("Fit", {"train_psnr": 18.09, "held_out_psnr": 17.0}, "bad", "contradict one another"),
        ("Fit", {"train_psnr": 18.09, "held_out_psnr": 17.0, "steps": 90}, "bad", "few steps"),
        ("Overfitting", {"train_psnr": 18.09, "held_out_psnr": 17.0}, "look", "both low"),
        # as close as these are, 6.2 dB say that they are not close enough
        ("Photographs", SIX_APART, "bad", "not enough for this subject, as the gap of 6.2 dB"),
        # what few steps leave dark is no exposure yet
        ("Exposure", {"stops": {"a": 0.0, "b": 0.6}, "train_psnr": 20.0, "steps": 300}, "look", "Not to be told yet"),
        ("Exposure", {"stops": {"a": 0.0, "b": 0.6}, "train_psnr": 20.0, "steps": 3_000}, "look", "It drifts"),
        # hardly a drift, but 1.1 dB
        ("Exposure", {"matched_psnr": 30.6}, "look", "30.60 dB instead of 29.50"),
    ],
)
def test_the_verdict_gives_its_numbers(about: str, changes: dict, kind: str, words: str) -> None:
    found = [f for f in verdict({"psnr": 29.5}, replace(GOOD, **changes), None) if f.about == about]
    assert [f.kind for f in found] == [kind]
    assert words in found[0].text


@pytest.mark.parametrize(
    ("steps", "next_"),
    [
        (30_000, ("train", "DATA", "--steps-scaler", "0.5")),
        (15_000, ("train", "DATA", "--steps-scaler", "0.4")),
        (12_000, ("data", "check", "DATA")),
        (3_000, ("data", "check", "DATA")),
    ],
)
def test_a_schedule_that_is_short_already_is_not_called_too_long(steps: int, next_: tuple[str, ...]) -> None:
    # of 60 photographs; half of 3,360 steps on 25 photographs of a statue lost 0.4 dB of the held-out views
    found = verdict({}, replace(GOOD, train_psnr=34.0, steps=steps), None)
    assert [one.next for one in found if one.about == "Overfitting"] == [next_]


@pytest.mark.parametrize("gap", [1.5, 10.0, None])
@pytest.mark.parametrize("train", [40.0, 31.0, 24.0, 18.0])
@pytest.mark.parametrize("apart", [4.0, 30.0])
def test_no_verdict_contradicts_another_and_each_fault_ends_in_a_command(gap, train, apart):
    held_out = None if gap is None else train - gap
    measured = {"train_psnr": train, "held_out_psnr": held_out, "matched_psnr": held_out}
    faults = {"neighbour_degrees": apart, "stops": {"a": -0.5, "b": 0.5}, "floaters": {"a": 0.5}, "steps": 3_000}
    found = verdict({}, replace(GOOD, **measured, **faults), None)
    found += verdict({}, None, ([700.0, 3000.0], [20.2, 16.7]))
    kinds = {one.about: one.kind for one in found}
    assert all(bool(one.next) == (one.kind != "good") for one in found)
    if kinds["Fit"] == "bad" or kinds["Overfitting"] == "bad":
        assert "good" not in (kinds["Overfitting"], kinds.get("Quality"))
    if kinds["Overfitting"] == "bad":
        assert kinds["Photographs"] == "bad"
    for one in found:
        words = [{"DATA": "scene", "RESULT": "out/scene"}.get(word, word) for word in one.next]
        if words[:1] == ["train"]:
            train_arguments(words[1:])
        elif words:
            parse({"data": DataCheck, "export": Export}[words[0]], words[1 + (words[0] == "data") :], words[0])


@pytest.mark.parametrize(
    ("psnr", "kind", "words"),
    [(31.0, "good", "very close"), (26.0, "good", "close"), (22.0, "look", "recognisable"), (12.0, "bad", "far from")],
)
def test_the_verdict_says_how_close_the_renders_are(psnr: float, kind: str, words: str) -> None:
    (quality,) = verdict({"psnr": psnr}, None, None)
    assert (quality.about, quality.kind) == ("Quality", kind)
    assert words in quality.text


@pytest.mark.parametrize(
    ("train", "steps", "sent"),
    [
        *((25.7, 300, "train"), (25.7, 1_935, "train"), (25.7, 3_000, "data")),
        *((33.0, 300, "data"), (18.0, 300, "train"), (21.0, 1_935, "data")),
    ],
)
def test_views_that_few_steps_left_as_they_are_ask_for_more_steps(train: float, steps: int, sent: str) -> None:
    # 43 photographs of fox: 24.65 dB after 300 steps, training views 25.66; 31.09 dB after 3,120
    checks = replace(GOOD, photographs=43, train_psnr=train, held_out_psnr=min(train, 25.7) - 1.0, steps=steps)
    found = {one.about: one for one in verdict({}, checks, None)}
    assert found["Quality"].next[0] == sent
    assert (f"few steps, {steps / 43:.0f} a photograph" in found["Quality"].text) == (sent == "train")
    if train < 22.0:
        assert found["Fit"].next == found["Overfitting"].next == found["Quality"].next


@pytest.mark.parametrize(
    ("photographs", "steps", "seconds", "words"),
    [
        # three minutes of the fox, of a terrace, of a capture with almost enough
        (43, 300, 180.0, ("--minutes", "15")),
        (302, 330, 190.0, ("--minutes", "90")),
        (43, 1_289, 180.0, ("--minutes", "10")),
        # a few seconds; what a night takes
        (43, 300, 4.0, ("--minutes", "1")),
        (900, 9_000, 30_000.0, ("--minutes", "1500")),
        # minutes never choose more than the paper's 30,000 steps, and are not known of every run
        (1_200, 30_000, 7_200.0, ("--steps-scaler", "3")),
        (43, 300, None, ("--steps-scaler", "0.043")),
    ],
)
def test_a_run_of_few_steps_is_sent_to_one_that_is_several_times_as_long(photographs, steps, seconds, words):
    checks = replace(GOOD, photographs=photographs, train_psnr=18.0, held_out_psnr=17.0, steps=steps)
    stats = {} if seconds is None else {"seconds_total": seconds}
    told = {one.about: one.next for one in verdict(stats, checks, None)}
    assert told["Quality"] == told["Fit"] == ("train", "DATA", *words)


def test_a_view_that_spoils_the_mean_is_named() -> None:
    for edge, mean, named in ((8.05, 15.95, True), (19.5, 19.77, False)):
        views = {"edge": edge, "a": 19.8, "b": 20.0}
        (quality, *_) = verdict({}, replace(GOOD, held_out=views, held_out_psnr=mean), None)
        said = f"edge is the worst, {edge:.2f} dB; the mean without it is 19.90 dB."
        assert (said in quality.text, "worst" in quality.text) == (named, named)


def test_a_run_whose_held_out_views_got_worse_is_told_when_that_began() -> None:
    fell = verdict({}, None, ([700.0, 3000.0], [20.2, 16.7]))
    assert [f.kind for f in fell] == ["bad"]
    assert "fell from 20.20 dB after 700 steps to 16.70 dB after 3,000" in fell[0].text
    # and is not sent to more steps by another sentence
    checks = replace(GOOD, train_psnr=18.0, held_out_psnr=16.7, steps=900)
    told = {one.about: one.next for one in verdict({}, checks, ([700.0, 900.0], [20.2, 16.7]))}
    assert told["Course"][2:] == ("--steps-scaler", "0.023")
    assert told["Quality"] == told["Fit"] == ("data", "check", "DATA")
    assert verdict({}, None, ([700.0, 3000.0], [16.7, 20.2])) == []


def test_exposures_that_were_learned_are_no_fault_and_ask_for_nothing() -> None:
    drifting = {"stops": {"a": -0.5, "b": 0.5}, "matched_psnr": 30.6}
    for learned, kind in ((False, "bad"), (True, "good")):
        found = verdict({}, replace(GOOD, **drifting, exposures_learned=learned), None)
        (about,) = (one for one in found if one.about == "Exposure")
        assert (about.kind, bool(about.next)) == (kind, not learned)
        assert "-0.50 (a) to +0.50 stops (b)" in about.text
        assert "30.60 dB instead of 29.50" in about.text


def test_held_out_views_without_an_exposure_of_their_own_are_judged_after_scaling() -> None:
    measured = {"train_psnr": 27.0, "held_out_psnr": 16.5, "matched_psnr": 25.5, "held_out": {"a": 25.0, "b": 26.0}}
    plain, learned = (verdict({}, replace(GOOD, **measured, exposures_learned=on), None) for on in (False, True))
    kinds = [{one.about: one.kind for one in found} for found in (plain, learned)]
    assert (kinds[0]["Quality"], kinds[0]["Overfitting"]) == ("bad", "bad")
    assert (kinds[1]["Quality"], kinds[1]["Overfitting"]) == ("good", "good")
    assert "25.50 dB on average. Each was scaled to its photograph's brightness" in learned[0].text
    assert "16.50 dB without scaling" in learned[0].text
    fell = ([700.0, 3000.0], [20.2, 16.7])
    told = [verdict({}, replace(GOOD, **measured, exposures_learned=on), fell) for on in (False, True)]
    assert ["Course" in {one.about for one in found} for found in told] == [True, False]


def test_no_two_findings_send_to_schedules_of_two_lengths() -> None:
    overfitted = replace(GOOD, train_psnr=39.5, steps=15_570)
    found = verdict({}, overfitted, ([3_633.0, 15_570.0], [30.0, 29.5]))
    sent = [one.next[3] for one in found if "--steps-scaler" in one.next]
    assert sent == ["0.12", "0.12"]
    (alone,) = (one for one in verdict({}, overfitted, None) if "--steps-scaler" in one.next)
    assert alone.next[3] == "0.4"


ASKED = {
    "auto": {
        "preset": "auto",
        "steps_scaler": 0.5,
        "factor": 6,
        "depth_lambda": 0.1,
        "exposure": True,
        "test_every": 0,
    },
    "quick": {"preset": "quick", "max_steps": 900, "seed": 7, "pop.lambda_pop": 2e-3},
    "paper": {"method": "gsplat", "gsplat.refine_every": 50, "background": (1.0, 0.5, 0.0), "normalize": False},
}


@pytest.mark.parametrize("name", ASKED)
@pytest.mark.parametrize(
    ("words", "changes"),
    [
        (("--exposure",), {"exposure"}),
        (("--test-every", "8"), {"test_every"}),
        (("--steps-scaler", "0.12"), {"steps"}),
        (("--minutes", "240"), {"steps"}),
    ],
)
def test_another_training_is_asked_for_as_the_judged_one_was(name: str, words: tuple, changes: set) -> None:
    run = TrainConfig.of(**ASKED[name], data="my scene", result_dir="out/a")
    line = typed(Finding("bad", "it", "is", ("train", "DATA", *words)), run, Path("out/a")).next
    assert line[:2] == ("train", "my scene")
    again, options = train_arguments(line[1:])
    assert (again.data, again.result_dir) == ("my scene", "out/a_next")
    assert options.minutes == (240.0 if "--minutes" in words else None)
    kept = {"method", "seed", "factor", "background", "exposure", "depth_lambda", "test_every", "normalize"} - changes
    if "steps" not in changes:
        kept |= {"max_steps", "strategy", "lr"}
    assert {key: getattr(again, key) for key in kept} == {key: getattr(run, key) for key in kept}
    if "--steps-scaler" in words:
        assert again.max_steps == 3_600
        assert again.strategy.lambda_pop == run.strategy.lambda_pop
    assert "--preset" not in line or "--minutes" not in words


def test_the_capture_is_asked_for_as_it_was_read(tmp_path: Path) -> None:
    run = TrainConfig.of(method="pop", data="scene", result_dir=str(tmp_path))
    record = CaptureRecord(images="stills", missing="skip", masks=False, source="transforms")
    (tmp_path / "capture.json").write_text(record_text(record))
    lines = [
        typed(Finding("bad", "it", "is", (*words, "DATA")), run, tmp_path).next
        for words in (("data", "check"), ("train",))
    ]
    assert lines[0] == ("data", "check", "scene", "--images", "stills")
    _, options = train_arguments(lines[1][1:])
    assert (options.images, options.missing, options.source) == ("stills", "skip", "transforms")
    assert options.ignore_masks


def test_commands_name_a_capture_that_has_moved_and_a_result_that_is_called_by_a_dot(tmp_path, monkeypatch):
    run = TrainConfig.of(method="pop", data="scene", result_dir="out/a")
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    commands = (("train", "DATA"), ("export", "RESULT", "--to", "html"))
    findings = [Finding("bad", "it", "is", words) for words in commands]
    train, export = (typed(found, run, Path("."), Path("elsewhere")).next for found in findings)
    assert train == ("train", "elsewhere", "--out", f"{tmp_path / 'a'}_next")
    assert export == ("export", ".", "--to", "html", "--capture", "elsewhere")


# What the report says to type next helps: commands are taken from reports and typed, and the results are measured.


@pytest.fixture(scope="module")
def demo(made_once: Callable[..., Path]) -> Path:
    """A still life from all around, in photographs so small that whole trainings take seconds."""

    def make(folder: Path) -> None:
        assert main(["demo", str(folder / "demo"), "--views", "20", "--width", "64", "--height", "48"]) == 0

    return made_once("small_demo", make) / "demo"


def trained(pop: Pop, words: Sequence[object]) -> tuple[Checks, dict[str, Finding]]:
    """Train as was typed; what its report measured, and what it found, by subject."""
    pop.done(*words, "--no-progress")
    folder = Path(str(words[words.index("--out") + 1]))
    (path,) = (folder / "report_data").glob("checks_step*.json")
    return read_checks(path), {one.about: one for one in read_result(folder).verdict}


def edited(demo: Path, folder: Path, change: Callable[[int, np.ndarray], np.ndarray]) -> Path:
    """Copy the capture with other photographs."""
    shutil.copytree(demo, folder)
    for number, path in enumerate(sorted((folder / "images").iterdir())):
        image = change(number, cv2.imread(str(path)).astype(np.float64))
        assert cv2.imwrite(str(path), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return folder


@pytest.mark.slow
def test_more_steps_help_where_few_left_all_views_far_off_and_fewer_where_it_learned_them_by_heart(pop, demo, tmp_path):
    # noise, which only so many steps learn by heart
    draw = np.random.default_rng(0)
    noisy = edited(demo, tmp_path / "noisy", lambda _, image: image + draw.normal(0.0, 25.0, image.shape))
    short, told = trained(pop, ["train", noisy, "--out", tmp_path / "run", "--steps-scaler", "0.002"])
    assert {told["Quality"].kind, told["Fit"].kind} == {"bad"}
    assert told["Quality"].next[:4] == told["Fit"].next[:4] == ("train", str(noisy), "--minutes", "1")
    long, told = trained(pop, told["Quality"].next)
    assert long.judged_psnr > short.judged_psnr + 1.0
    assert long.train_psnr > short.train_psnr + 3.0
    assert told["Course"].kind == "bad"
    assert told["Course"].next[:3] == ("train", str(noisy), "--steps-scaler")
    fewer, told = trained(pop, told["Course"].next)
    assert fewer.steps < long.steps
    assert fewer.judged_psnr > long.judged_psnr + 0.3
    assert "Course" not in told


@pytest.mark.slow
def test_exposures_that_drift_are_learned(pop: Pop, demo: Path, tmp_path: Path) -> None:
    gains = 0.8 * np.exp2(np.random.default_rng(0).normal(0.0, 0.4, 20))
    drifting = edited(demo, tmp_path / "drifting", lambda number, image: image * gains[number])
    before, told = trained(pop, ["train", drifting, "--out", tmp_path / "run", "--steps-scaler", "0.02"])
    assert told["Exposure"].kind == "bad"
    assert "--exposure" in told["Exposure"].next
    after, told = trained(pop, told["Exposure"].next)
    # both after scaling each render to its photograph's brightness
    assert after.matched_psnr > before.matched_psnr + 0.5
    assert after.train_psnr > before.train_psnr + 2.0
    assert told["Exposure"].kind == "good"


@pytest.mark.slow
def test_views_are_held_out_where_none_were(pop: Pop, demo: Path, tmp_path: Path) -> None:
    words = ["train", demo, "--out", tmp_path / "run", "--steps-scaler", "0.01", "--test-every", "0"]
    before, told = trained(pop, words)
    assert before.judged_psnr is None
    assert told["Overfitting"].next[:4] == ("train", str(demo), "--test-every", "8")
    after, told = trained(pop, told["Overfitting"].next)
    assert after.judged_psnr is not None
    assert "held-out views" in told["Overfitting"].text


@pytest.mark.slow
def test_photographs_that_are_far_apart_are_looked_over_and_the_gaps_named(pop, demo, tmp_path):
    _, told = trained(pop, ["train", demo, "--out", tmp_path / "run", "--steps-scaler", "0.002"])
    assert "neighbours 27" in told["Photographs"].text
    assert told["Photographs"].next == ("data", "check", str(demo))
    (line,) = (line for line in pop(*told["Photographs"].next).out.splitlines() if "spacing" in line)
    assert "photographs between these would help most" in line


@pytest.mark.slow
def test_what_moved_is_left_out_by_the_masks_that_the_report_asks_for(pop: Pop, demo: Path, tmp_path: Path) -> None:
    def place(number: int) -> tuple[slice, slice]:
        return slice(18, 34), slice(4 + 2 * number, 18 + 2 * number)

    def walked(number: int, image: np.ndarray) -> np.ndarray:
        image[place(number)] = (30.0, 30.0, 220.0)
        return image

    moving = edited(demo, tmp_path / "moving", walked)
    words = ["train", moving, "--out", tmp_path / "run", "--steps-scaler", "0.05"]
    before, told = trained(pop, words)
    assert told["Fit"].kind != "good"
    assert told["Fit"].next == ("data", "check", str(moving))
    for number, path in enumerate(sorted((moving / "images").iterdir())):
        mask = np.full(cv2.imread(str(path)).shape[:2], 255, np.uint8)
        mask[place(number)] = 0
        (moving / "masks").mkdir(exist_ok=True)
        assert cv2.imwrite(str(moving / "masks" / path.name), mask)
    found = pop(*told["Fit"].next)
    assert any("masks" in line and line.startswith("ok") for line in found.out.splitlines())
    after, told = trained(pop, [*words, "--overwrite"])
    assert after.train_psnr > before.train_psnr + 2.0
    assert told["Fit"].kind == "good", told["Fit"].text
