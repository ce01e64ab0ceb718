"""What the report says to type next helps: commands are taken from reports and typed, and the results are measured."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.cli import main
from pop_fast.view.report.checks import Checks, read_checks
from pop_fast.view.report.model import Finding
from pop_fast.view.report.source import read_result
from tests.app.conftest import Pop

pytestmark = pytest.mark.slow


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


def test_more_steps_help_where_few_left_all_views_far_off_and_fewer_where_it_learned_them_by_heart(
    pop: Pop, demo: Path, tmp_path: Path
) -> None:
    # noise, which only so many steps learn by heart
    draw = np.random.default_rng(0)
    noisy = edited(demo, tmp_path / "noisy", lambda _, image: image + draw.normal(0.0, 25.0, image.shape))
    short, told = trained(pop, ["train", noisy, "--out", tmp_path / "run", "--steps-scaler", "0.002"])
    assert {told["Quality"].kind, told["Fit"].kind} == {"bad"}
    assert told["Quality"].next[:4] == told["Fit"].next[:4] == ("train", str(noisy), "--minutes", "240")
    long, told = trained(pop, told["Quality"].next)
    assert long.judged_psnr > short.judged_psnr + 1.0
    assert long.train_psnr > short.train_psnr + 3.0
    assert told["Course"].kind == "bad"
    assert told["Course"].next[:3] == ("train", str(noisy), "--steps-scaler")
    fewer, told = trained(pop, told["Course"].next)
    assert fewer.steps < long.steps
    assert fewer.judged_psnr > long.judged_psnr + 0.3
    assert "Course" not in told


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


def test_views_are_held_out_where_none_were(pop: Pop, demo: Path, tmp_path: Path) -> None:
    words = ["train", demo, "--out", tmp_path / "run", "--steps-scaler", "0.01", "--test-every", "0"]
    before, told = trained(pop, words)
    assert before.judged_psnr is None
    assert told["Overfitting"].next[:4] == ("train", str(demo), "--test-every", "8")
    after, told = trained(pop, told["Overfitting"].next)
    assert after.judged_psnr is not None
    assert "held-out views" in told["Overfitting"].text


def test_photographs_that_are_far_apart_are_looked_over_and_the_gaps_named(
    pop: Pop, demo: Path, tmp_path: Path
) -> None:
    _, told = trained(pop, ["train", demo, "--out", tmp_path / "run", "--steps-scaler", "0.002"])
    assert "neighbours 27" in told["Photographs"].text
    assert told["Photographs"].next == ("data", "check", str(demo))
    (line,) = (line for line in pop(*told["Photographs"].next).out.splitlines() if "spacing" in line)
    assert "photographs between these would help most" in line


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
