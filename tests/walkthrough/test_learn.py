"""Building one's own, as students do: stubs, a right student, wrong ones who get the sentence that helps, bad input."""

from __future__ import annotations

import ast
import re
import time
from pathlib import Path

import numpy as np
import pytest

from pop_fast.cli import main
from pop_ref.learn import stubs
from pop_ref.learn.course import BY_NAME, COURSE, stage_named
from pop_ref.learn.drawing import ORACLES, SIDE, YOURS, drawn_counterexample
from pop_ref.learn.judge import judge
from pop_ref.learn.mistakes import MISTAKES
from pop_ref.learn.progress import PASSED, WRITTEN, course_map, note_passed, picture, state
from pop_ref.learn.student import borrowing, read_work
from pop_ref.learn.telling import told
from pop_ref.walkthrough.builder.chapter import chapter_files, chapter_number

ROOT = Path(__file__).resolve().parents[2]
ORACLE = ROOT / "pop_ref"


def write(folder: Path, name: str, *changes: tuple[str, str]) -> Path:
    """Write the oracle's own code of a stage as a student's, with changes."""
    future = "from __future__ import annotations\n"
    modules = [(ORACLE / f"{module}.py").read_text(encoding="utf-8") for module in BY_NAME[name].functions]
    text = future + "\n\n".join(module.replace(future, "") for module in modules)
    for module in BY_NAME[name].functions:
        # what one module imports from another of the stage would hide what stands in this file
        text = re.sub(rf"from pop_ref\.{module} import (\([^)]*\)|.*)\n", "", text)
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / BY_NAME[name].file
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    folder = tmp_path / "mine"
    stubs.start(folder)
    return folder


def test_the_stubs_are_twelve_modules_with_the_oracles_names_signatures_and_no_bodies(mine: Path) -> None:
    assert len(COURSE) == 12 == len(list(mine.glob("*.py")))
    for stage in COURSE:
        found = {n.name: n for n in ast.parse((mine / stage.file).read_text()).body if isinstance(n, ast.FunctionDef)}
        assert tuple(found) == stage.names
        for module, names in stage.functions.items():
            oracle = {
                n.name: n
                for n in ast.parse((ORACLE / f"{module}.py").read_text()).body
                if isinstance(n, ast.FunctionDef)
            }
            for name in names:
                assert ast.dump(found[name].args) == ast.dump(oracle[name].args)
                docstring = ast.get_docstring(found[name]) or ""
                assert "Source:" in docstring
                assert ">>> " in docstring
                assert not any(formula in docstring for formula in stubs.formulas(module, name))
                assert len(found[name].body) == 2
                assert isinstance(found[name].body[1], ast.Raise)
    assert read_work(mine).written == {stage.name: () for stage in COURSE}


def test_nothing_that_a_student_wrote_is_written_over(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (mine / "alpha.py").write_text("# mine\n")
    (mine / "tiles.py").unlink()
    assert main(["learn", "start", str(mine)]) == 0
    assert "1 new files" in capsys.readouterr().out
    assert (mine / "alpha.py").read_text() == "# mine\n"
    assert (mine / "tiles.py").exists()


@pytest.mark.parametrize("stage", COURSE, ids=lambda stage: stage.name)
def test_who_writes_what_the_oracle_writes_passes_and_a_stub_is_not_judged(mine: Path, stage) -> None:
    untouched = judge(read_work(mine), stage)
    assert (untouched.n_held, untouched.passed, untouched.unwritten) == (0, False, stage.names)
    write(mine, stage.name)
    verdict = judge(read_work(mine), stage)
    assert verdict.passed, told(stage, verdict)
    assert verdict.n_held >= 4


WRONG = {
    "a transposed rotation": (
        "covariance",
        ("    return rotmats\n", "    return rotmats.swapaxes(1, 2).copy()\n"),
        "rotation is transposed",
    ),
    "no half before the squares": (
        "alpha",
        ("return 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy", "return A * dx * dx + C * dy * dy + B * dx * dy"),
        "half is missing",
    ),
    "no half at all": (
        "alpha",
        (
            "return 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy",
            "return A * dx * dx + C * dy * dy + 2.0 * B * dx * dy",
        ),
        "half is missing",
    ),
    "a gradient without the tail": (
        "compositing",
        ("        v_alpha = T * (color_dot_grad - suffix_dot_grad)\n", "        v_alpha = T * color_dot_grad\n"),
        "tail is missing",
    ),
    "a factor": ("losses", ("return v_l2 * 2.0 * difference", "return v_l2 * 8.0 * difference"), "4 times"),
    "no return": ("camera", ("    return means_cam\n", "    pass\n"), "return missing"),
    "an argument changed": (
        "footprint",
        ("    return covars2d + eps2d * np.eye(2)", "    covars2d += eps2d * np.eye(2)\n    return covars2d"),
        "in place",
    ),
    "a quaternion of any length": (
        "covariance",
        (
            "rotmats = np.zeros((len(quats), 3, 3))\n    for i, (w, x, y, z) in enumerate(unit_quats_from_quats(quats)",
            "rotmats = np.zeros((len(quats), 3, 3))\n    for i, (w, x, y, z) in enumerate((quats)",
        ),
        "divided by its length",
    ),
    "positive harmonics of degree 1": (
        "harmonics",
        ("-_C1 * y,\n        _C1 * z,\n        -_C1 * x,", "_C1 * y,\n        _C1 * z,\n        _C1 * x,"),
        "degree 1 have the wrong sign",
    ),
    "no half in a colour": ("harmonics", ("@ sh[i, :n_sh] + 0.5, 0.0)", "@ sh[i, :n_sh], 0.0)"), "half is missing"),
    "no correction in Adam": (
        "optimizer",
        (
            "/ np.sqrt(1.0 - beta2**t) + eps\n        new_params[name] = params[name] - lr[name] / (1.0 - beta1**t) *",
            "+ eps\n        new_params[name] = params[name] - lr[name] *",
        ),
        "not corrected",
    ),
    "the rows that should go": (
        "density",
        (
            "return _keep_and_append(rows, ~mask, {name: array[:0]",
            "return _keep_and_append(rows, mask, {name: array[:0]",
        ),
        "keep the rows",
    ),
    "an error": ("alpha", ("    return math.exp(-sigma)\n", "    return math.exp(-sigma) / 0\n"), "ZeroDivisionError"),
}


@pytest.mark.parametrize("who", WRONG)
def test_a_wrong_student_gets_the_sentence_that_helps(mine: Path, who: str) -> None:
    stage, change, sentence = WRONG[who]
    path = write(mine, stage, change)
    began = time.process_time()
    verdict = judge(read_work(mine), BY_NAME[stage])
    assert time.process_time() - began < 5.0
    assert sentence in verdict.sentence
    assert verdict.broken
    assert verdict.hint
    text = told(BY_NAME[stage], verdict)
    assert "Traceback" not in text
    if verdict.call is None:
        # the line that was changed is named
        assert f"{path}, line" in verdict.sentence
    else:
        assert f"{verdict.call.function} of" in text
        assert "and should give" in text


def _colored(image: np.ndarray, color: np.ndarray) -> int:
    return int(np.sum(np.abs(image - color).max(axis=2) < 0.02))


@pytest.mark.parametrize(
    ("stage", "change"),
    [
        ("covariance", WRONG["a transposed rotation"][1]),
        ("covariance", ("        M = rotmats[i] * scales[i]\n", "        M = rotmats[i] * scales[i] ** 2\n")),
        ("alpha", WRONG["no half at all"][1]),
        ("compositing", WRONG["a gradient without the tail"][1]),
    ],
    ids=["axes", "ellipses", "bars", "scene and bars"],
)
def test_a_counterexample_is_drawn_with_what_came_out_and_what_should(
    mine: Path, stage: str, change: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    write(mine, stage, change)
    verdict = judge(read_work(mine), BY_NAME[stage])
    image = drawn_counterexample(verdict)
    assert image is not None
    assert image.shape[0] == SIDE
    assert image.min() >= 0.0
    assert image.max() <= 1.0
    # a short line at least: how small the counterexample is made, and what it shows, depends on the time that it takes
    yours, oracles = _colored(image, YOURS), _colored(image, ORACLES)
    assert yours > 30, "what the student's function gives is seen"
    assert oracles > 30, "and what it should give"
    assert main(["learn", "check", stage, str(mine)]) == 1
    picture = mine / f"counterexample_{stage}.png"
    assert str(picture) in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")
    # who has passed has no counterexample
    write(mine, stage)
    assert main(["learn", "check", stage, str(mine)]) == 0
    assert not picture.exists()


def test_the_chapter_that_explains_a_stage_is_there() -> None:
    assert {stage.chapter for stage in COURSE} <= {chapter_number(path) for path in chapter_files()}


def test_every_mistake_that_is_known_is_one_and_of_a_function_of_the_course(mine: Path) -> None:
    names = {name for stage in COURSE for name in stage.names}
    assert {mistake.function for mistake in MISTAKES} <= names
    write(mine, "alpha", ("return 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy", "return 0.0"))
    verdict = judge(read_work(mine), BY_NAME["alpha"])
    assert verdict.sentence.startswith("sigma_at_pixel is"), "a mistake that nobody knows is told as one that is"
    assert "The formula is sigma" in verdict.hint


def test_a_function_finds_the_students_own_and_the_oracles_where_there_is_none(mine: Path) -> None:
    (mine / "alpha.py").write_text(
        "from pop_ref.constants import PAPER\n"
        "def falloff(sigma):\n    return 0.5\n"
        "def falloff_vjp(sigma, v_falloff):\n    raise NotImplementedError\n"
        "def alpha_from_sigma(sigma, opacity, profile=PAPER):\n"
        "    return opacity * falloff(sigma), falloff_vjp(0.0, 1.0)\n"
    )
    with borrowing(read_work(mine)) as borrowed:
        assert borrowed.module("alpha").alpha_from_sigma(0.0, 0.5) == (0.25, -1.0)
        assert borrowed.module("pixel").alpha_from_sigma(0.0, 0.5) == (0.25, -1.0)
        assert borrowed.oracle["falloff"](0.0) == 1.0


def test_who_stands_inside_the_folder_is_told_how_to_name_it(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mine)
    with pytest.raises(ValueError, match=r"mine has no stubs; you are in a folder that has some: write \. for it"):
        read_work(Path("mine"))


def test_the_map_turns_green_with_a_pass_and_back_with_a_change(mine: Path) -> None:
    path = write(mine, "alpha")
    stage, work = BY_NAME["alpha"], read_work(mine)
    assert state(work, stage) == WRITTEN
    note_passed(mine, stage)
    assert state(work, stage) == PASSED
    assert "1 of 12 stages have passed" in course_map(work)
    assert "\x1b[32m" in course_map(work, color=True)
    path.write_text(path.read_text() + "\n")
    assert state(read_work(mine), stage) == WRITTEN


def test_the_picture_is_the_oracles_with_the_students_stages_in_it(mine: Path) -> None:
    sound, complaints = picture(read_work(mine), 16)
    assert not complaints
    assert float(np.ptp(sound)) > 0.5
    write(mine, "alpha", ("    return math.exp(-sigma)\n", "    return 0.25 * math.exp(-sigma)\n"))
    faint, complaints = picture(read_work(mine), 16)
    assert not complaints
    assert float(np.mean(faint)) < 0.95 * float(np.mean(sound))
    write(mine, "alpha", ("    return math.exp(-sigma)\n", "    return math.exp(-sigma) / 0\n"))
    borrowed, complaints = picture(read_work(mine), 16)
    assert "ZeroDivisionError" in complaints[0]
    assert np.array_equal(borrowed, sound)


def test_the_answer_is_shown_when_asked_twice_or_after_a_pass(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["learn", "check", "optimizer", str(mine), "--answer"]
    line = "new_v[name] = beta2 * v[name]"
    assert main(asked) == 1
    assert line not in capsys.readouterr().out
    assert main(asked) == 1
    assert line in capsys.readouterr().out
    write(mine, "alpha")
    assert main(["learn", "check", "alpha", str(mine), "--answer"]) == 0
    printed = capsys.readouterr().out
    assert "alpha: passed" in printed
    assert "def falloff(" in printed


def test_who_has_written_all_trains(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for stage in COURSE:
        write(mine, stage.name)
    assert main(["learn", "train", str(mine), "--steps", "6"]) == 0
    assert "step   6" in capsys.readouterr().out
    assert (mine / "trained.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("files", "words", "message"),
    [
        ({}, ["check", "alfa"], "'alfa' is not a stage of the course; there are activations"),
        (
            {"alpha.py": "def falloff(sigma):\n    return (1\n"},
            ["check", "alpha"],
            "alpha.py, line 2: this is not Python yet",
        ),
        ({"alpha.py": "import math\nimport maths\ndef falloff(sigma):\n    return 1\n"}, ["map"], "alpha.py, line 2"),
        ({}, ["train"], "not all is written yet: activations"),
        (None, ["check", "alpha"], "has no stubs; 'pop learn start"),
        (None, ["map"], "has no stubs; 'pop learn start"),
    ],
)
def test_bad_input_gets_one_line(
    tmp_path: Path, files: dict[str, str] | None, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mine"
    if files is not None:
        stubs.start(folder)
        for name, text in files.items():
            (folder / name).write_text(text)
    assert main(["learn", *words, str(folder)]) == 2
    told_to = capsys.readouterr().err
    assert message in told_to
    assert told_to.count("\n") == 1


def test_a_stage_that_is_not_there_is_named() -> None:
    with pytest.raises(ValueError, match="'beta' is not a stage"):
        stage_named("beta")
