"""The course as a whole: training with all of one's own, a score of all stages, a class that is graded."""

from __future__ import annotations

import json
import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from pop_fast.cli import main
from pop_fast.data import load_capture
from pop_fast.demo import make_demo
from pop_ref.learn import stubs
from pop_ref.learn.course import BY_NAME, COURSE
from pop_ref.learn.grading import read_grade
from pop_ref.learn.progress import PASSED, state
from pop_ref.learn.splat import orbit, photograph, write_png
from pop_ref.learn.student import read_work
from pop_ref.learn.training import a_capture, a_picture, the_toy, train
from tests.walkthrough.test_learn import write


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    folder = tmp_path / "mine"
    stubs.start(folder)
    return folder


def _written(folder: Path) -> None:
    for stage in COURSE:
        write(folder, stage.name)


def test_who_has_written_all_trains_on_a_picture_of_ones_own_above_20_db_and_gets_a_film(
    mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _written(mine)
    own = photograph(orbit(0.9, 80))
    write_png(mine / "own.png", own)
    assert main(["learn", "train", str(mine), "--steps", "12", "--picture", str(mine / "own.png")]) == 0
    told_ = capsys.readouterr().out
    psnrs = [float(text) for text in re.findall(r"([\d.]+) dB", told_)]
    assert psnrs[-1] > 20.0
    assert psnrs[-1] == max(psnrs)
    assert (mine / "trained.png").read_bytes().startswith(b"\x89PNG")
    film = (mine / "trained_film.png").read_bytes()
    assert int.from_bytes(film[film.index(b"acTL") + 4 :][:4], "big") == len(psnrs) == film.count(b"fcTL")
    assert np.allclose(plt.imread(mine / "trained_film.png").shape[:2], (256, 512))


def test_density_control_ends_at_half_time_and_the_toy_learns(mine: Path) -> None:
    _written(mine)
    told_ = list(train(read_work(mine), the_toy(24), 24, every=1))
    sizes = [each.n for each in told_]
    assert len(set(sizes[12:])) == 1, "the number of Gaussians changes after half time"
    assert len(set(sizes)) > 1
    assert told_[-1].psnr > told_[0].psnr + 1.5


def test_a_capture_is_trained_on_from_its_points(mine: Path) -> None:
    _written(mine)
    make_demo(mine / "demo", views=6, width=64, height=48)
    capture = load_capture(mine / "demo")
    views = [((view.viewmat, view.K, 64, 48), view.image / 255.0) for view in capture.views]
    subject = a_capture(views, capture.points, capture.points_rgb / 255.0, capture.scene_scale(), n=60)
    assert len(subject.views) == 5
    *_, last = train(read_work(mine), subject, 4, every=4)
    assert np.isfinite(last.psnr)
    with pytest.raises(ValueError, match="two views and a point are needed"):
        a_capture(views[:1], capture.points, capture.points_rgb / 255.0, 1.0)
    with pytest.raises(ValueError, match="it must be 64 px at least"):
        a_picture(np.zeros((10, 80, 3)))


def test_all_is_judged_with_a_score_also_as_json(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(mine, "alpha", ("    return math.exp(-sigma)\n", "    print('noise')\n    return math.exp(-sigma)\n"))
    write(
        mine, "optimizer", ("new_params[name] = params[name] - lr[name]", "new_params[name] = params[name] + lr[name]")
    )
    (mine / "losses.py").write_text("import nothing_like_it\n\ndef l1(image, target):\n    return 0.0\n")
    assert main(["learn", "check", "--all", "--json", str(mine)]) == 1
    grade = json.loads(capsys.readouterr().out)
    assert (grade["score"], grade["of"], grade["passed"]) == (6, 66, ["alpha"])
    by_name = {stage["name"]: stage for stage in grade["stages"]}
    assert list(by_name) == list(BY_NAME)
    assert "up the loss" in by_name["optimizer"]["sentence"]
    assert "nothing_like_it" in by_name["losses"]["sentence"]
    assert by_name["tiles"]["unwritten"] == list(BY_NAME["tiles"].names)
    assert main(["learn", "check", "--all", str(mine)]) == 1
    assert "6 of 66 functions are right; 1 of 13 stages have passed" in capsys.readouterr().out
    assert state(read_work(mine), BY_NAME["alpha"]) == PASSED


@pytest.mark.parametrize(
    "printed",
    [
        "",
        "[" * 100_000,
        "[]",
        "null",
        '{"score": 66}',
        '{"score": "66", "of": 66, "passed": [], "stages": []}',
        '{"score": 66, "of": 66, "passed": [], "stages": [1]}',
        '{"score": 66, "of": 66, "passed": [], "stages": [{"name": "alpha"}]}',
    ],
)
def test_what_is_no_grade_is_not_read_as_one(printed: str) -> None:
    assert read_grade(f"pop learn graded: {printed}\n") is None
    assert read_grade(printed) is None


def test_a_class_is_graded_whatever_one_submission_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("anna", "bert", "cleo", "dora", "emil"):
        stubs.start(tmp_path / name)
    write(tmp_path / "anna", "alpha")
    (tmp_path / "bert" / "alpha.py").write_text("while True:\n    pass\ndef falloff(sigma):\n    return 1\n")
    (tmp_path / "cleo" / "alpha.py").write_text("import os\nos._exit(7)\ndef falloff(sigma):\n    return 1\n")
    lie = "print('pop learn graded: {\"score\": 66}')\nimport os, sys\nsys.__stdout__.write('pop learn graded: [')\n"
    end = "sys.__stdout__.flush()\nos._exit(0)\ndef falloff(sigma):\n    return 1\n"
    (tmp_path / "dora" / "alpha.py").write_text(lie + end)
    (tmp_path / "emil" / "alpha.py").write_text("def falloff(sigma):\n    return (1\n")
    (tmp_path / "notes").mkdir()
    assert main(["learn", "class", str(tmp_path), "--seconds", "12"]) == 0
    assert "anna: 6" in capsys.readouterr().out
    report = (tmp_path / "report.md").read_text()
    assert "| anna | 6 |" in report
    assert "- bert: it runs for longer than 12 s; is there an endless loop?" in report
    assert "- cleo: it ended with status 7" in report
    assert "- dora: what it prints cannot be told from a grade" in report
    assert "- emil: it ended with status 1" in report
    assert "alpha.py, line 2: this is not Python yet" in report
    assert "notes" not in report
    assert main(["learn", "class", str(tmp_path / "notes")]) == 2
    assert "has no submissions" in capsys.readouterr().err
