"""Building one's own, as students do: stubs, a right student, wrong ones who get the sentence that helps, bad input.

The mistakes that are known by name are each recognised by their own numbers, and none of them is right.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import tomllib
from functools import partial
from pathlib import Path
from typing import Any, cast

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import strategies as st

from pop_fast.children import module_command
from pop_fast.cli import main
from pop_fast.data import load_capture
from pop_fast.demo import make_demo
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.law import Law
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.learn import __main__ as alone
from pop_ref.learn import stubs
from pop_ref.learn.course import BY_NAME, COURSE, NOT_TAUGHT, Stage
from pop_ref.learn.diagnosis import diagnose
from pop_ref.learn.drawing import HEAD, ORACLES, SIDE, YOURS, drawn_counterexample, lettered
from pop_ref.learn.grading import graded, read_grade
from pop_ref.learn.judge import Verdict, _tried, judge, told
from pop_ref.learn.mistakes import MISTAKES, Mistake
from pop_ref.learn.probes import oracle, probes
from pop_ref.learn.progress import PASSED, WRITTEN, course_map, note_passed, picture, state
from pop_ref.learn.splat import orbit, photograph, write_png
from pop_ref.learn.student import Call, borrowing, read_work, tried_on
from pop_ref.learn.training import a_capture, a_picture, the_toy, train
from pop_ref.walkthrough.builder.chapter import chapter_files, chapter_number

ROOT = Path(__file__).resolve().parents[2]
ORACLE = ROOT / "pop_ref"
# of each function, pieces of the right solution and what stands there instead
SOLUTIONS = tomllib.loads((Path(__file__).parent / "solutions.toml").read_text(encoding="utf-8"))
WRONG, RIGHT = SOLUTIONS["wrong"], SOLUTIONS["right"]


def functions_in(text: str) -> dict[str, ast.FunctionDef]:
    """Return the functions of a module's text by name."""
    return {node.name: node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)}


def oracles_text(name: str) -> str:
    """Write the oracle's own code of a stage in one file."""
    future = "from __future__ import annotations\n"
    modules = [(ORACLE / f"{module}.py").read_text(encoding="utf-8") for module in BY_NAME[name].functions]
    text = future + "\n\n".join(module.replace(future, "") for module in modules)
    for module in BY_NAME[name].functions:
        # what one module imports from another of the stage would hide what stands in this file
        text = re.sub(rf"from pop_ref\.{module} import (\([^)]*\)|.*)\n", "", text)
    return text


def write(folder: Path, name: str, *changes: tuple[str, str]) -> Path:
    """Write the oracle's own code of a stage as a student's, with changes."""
    text = oracles_text(name)
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / BY_NAME[name].file
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learn") / "started"
    stubs.start(folder)
    return folder


@pytest.fixture
def mine(started: Path, tmp_path: Path) -> Path:
    return shutil.copytree(started, tmp_path / "mine")


def test_the_stubs_are_thirteen_modules_with_the_oracles_names_signatures_and_no_bodies(mine: Path) -> None:
    assert len(COURSE) == 13 == len(list(mine.glob("*.py")))
    for stage in COURSE:
        found = functions_in((mine / stage.file).read_text())
        assert tuple(found) == stage.names
        for module, names in stage.functions.items():
            oracle = functions_in((ORACLE / f"{module}.py").read_text())
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
    assert verdict.right == stage.names
    assert (verdict.n_held >= 4) == (stage.name != "loop")


def _solution(stage: Stage, code: str) -> str:
    """Write a stage as the oracle does, but for the functions that some code defines."""
    names, text = functions_in(code), oracles_text(stage.name)
    lines = text.splitlines(keepends=True)
    for name, node in reversed(functions_in(text).items()):
        if name in names:
            del lines[node.lineno - 1 : node.end_lineno]
    future = "from __future__ import annotations\n"
    return "".join(lines).replace(future, f"{future}import math\nimport numpy as np\n", 1) + code


def _mistaken(stage: Stage, name: str, old: str, new: str) -> str:
    """Write a stage as the oracle does, but for one piece of one function's body."""
    text = oracles_text(stage.name)
    node = functions_in(text)[name]
    body = "".join(text.splitlines(keepends=True)[node.body[1].lineno - 1 : node.end_lineno])
    assert body.count(old) == 1, (name, old)
    return text.replace(body, body.replace(old, new))


# every second function here; the others are for `make test-all`
HALF = [name if k % 2 else pytest.param(name, marks=pytest.mark.slow) for k, name in enumerate(WRONG)]


@pytest.mark.parametrize("name", HALF)
def test_every_wrong_solution_is_refused_and_told_what_is_wrong(mine: Path, name: str) -> None:
    stage = next(stage for stage in COURSE if name in stage.names)
    for old, new, *wanted in WRONG[name]:
        path = mine / stage.file
        path.write_text(_mistaken(stage, name, old, new), encoding="utf-8")
        verdict = judge(read_work(mine), stage)
        assert not verdict.passed, new
        assert verdict.broken, new
        # the function itself is found, not one that calls it
        assert name not in verdict.right, new
        assert name in verdict.sentence or str(path) in verdict.sentence or verdict.call is not None
        if wanted:
            assert re.search(wanted[0], verdict.sentence), f"{new!r}: {verdict.sentence}"
        told_ = told(stage, verdict)
        assert "Traceback" not in told_
        assert len(told_.splitlines()) <= 40, told_


def test_there_are_wrong_solutions_of_every_function_and_right_ones_of_every_stage() -> None:
    assert set(WRONG) == {name for stage in COURSE for name in stage.names}
    assert sum(map(len, WRONG.values())) >= 150
    # nine in ten are named: the sentence holds the pattern that tells the cause
    mistakes = [each for wrong in WRONG.values() for each in wrong]
    assert sum(len(each) == 3 for each in mistakes) >= 0.9 * len(mistakes)
    assert len(RIGHT) >= 30
    assert {each["stage"] for each in RIGHT.values()} == set(BY_NAME)


@pytest.mark.parametrize("style", RIGHT)
def test_every_right_solution_in_another_style_passes(mine: Path, style: str) -> None:
    name, code = RIGHT[style]["stage"], RIGHT[style]["code"]
    (mine / BY_NAME[name].file).write_text(_solution(BY_NAME[name], code), encoding="utf-8")
    verdict = judge(read_work(mine), BY_NAME[name])
    assert verdict.passed, told(BY_NAME[name], verdict)


def test_an_example_is_tried_first_and_told_with_what_it_should_give(mine: Path) -> None:
    leaking = "return falloff_vjp(sigma, opacity * v_alpha), falloff(sigma) * v_alpha"
    stage = BY_NAME["alpha"]
    code = _mistaken(stage, "alpha_from_sigma_vjp", leaking, f"v = v_alpha\n    {leaking.replace('v_alpha', 'v')}")
    code = code.replace('and profile.ceiling_gradient == "zero"', "and False")
    (mine / stage.file).write_text(code, encoding="utf-8")
    verdict = judge(read_work(mine), stage)
    assert verdict.broken.startswith("the example in its docstring: alpha_from_sigma_vjp(0.0, 0.5, 4.0)")
    assert "should give ((-2.0, 4.0), (0.0, 0.0)) and gives" in verdict.broken
    assert "over the ceiling of 0.999" in verdict.sentence
    assert verdict.hint.endswith("chapter 5 of the walk-through explains it.")


def test_what_is_said_holds_for_every_result() -> None:
    """A factor is one only where the ratio is the same everywhere; else nothing is said of it."""

    def call(found: list[float], expected: list[float]) -> Call:
        return Call("falloff", ("sigma",), (1.0,), {}, (np.array(found), ()), (np.array(expected), ()))

    twice = [call([2.0, 4.0], [1.0, 2.0]), call([6.0], [3.0])]
    assert "is 2 times what it should be, everywhere" in diagnose(twice, Path())[0]
    other = [call([2.0, 4.0], [1.0, 2.0]), call([7.0], [3.0])]
    assert "times" not in diagnose(other, Path())[0]
    # one number alone has a ratio to anything, which says nothing
    assert "times" not in diagnose([call([0.65], [1.0])], Path())[0]
    assert "by half" in diagnose([call([1.5, 2.5], [1.0, 2.0])], Path())[0]
    assert "off by one" in diagnose([call([2.0, 4.0, 5.0], [1.0, 3.0, 4.0])], Path())[0]


def test_a_function_knows_its_chapter() -> None:
    chapters = {chapter_number(path): path.read_text(encoding="utf-8") for path in chapter_files()}
    for stage in COURSE:
        assert stage.chapter in chapters
        for name in stage.names:
            chapter = stage.chapter_of(name)
            source = f"{{{{source: pop_ref.{stage.home_of(name)}.{name}}}}}"
            shown = [number for number, text in chapters.items() if source in text]
            assert not shown or chapter in shown, f"{name} is printed in chapter {shown}, not in {chapter}"
    assert BY_NAME["compositing"].chapter_of("composite_pixel_vjp") == "5"
    assert BY_NAME["compositing"].chapter_of("dominant_id") == "7"
    assert BY_NAME["losses"].chapter_of("pop_loss_vjp") == "8"
    assert BY_NAME["projection"].chapter_of("project_covars_vjp") == "5b"


def test_the_assignments_ask_for_every_stage_once_its_chapters_are_read() -> None:
    text = (ROOT / "docs" / "teaching.md").read_text(encoding="utf-8")
    plan = re.findall(r"^\| Day.* \| (.+) \| assignment \d \|$", text, re.MULTILINE)
    asked = [
        re.findall(r"`(\w+)`", words) for words in re.findall(r"^Write (.*?)[.:]\s", text, re.MULTILINE | re.DOTALL)
    ]
    assert len(plan) == len(asked) == 4
    read = set[str]()
    for chapters, stages in zip(plan, asked, strict=True):
        read |= set(re.findall(r"\b\d+b?\b", chapters))
        for name in stages:
            missing = {each for each in map(BY_NAME[name].chapter_of, BY_NAME[name].names) if each not in read}
            assert not missing, f"{name} needs {missing}"
    assert {name for stages in asked for name in stages} == set(BY_NAME)


def test_stubs_write_labels_in_words_and_explain_the_settings_that_the_course_has() -> None:
    for stage in COURSE:
        text = stubs.stub(stage)
        assert not re.search(r"\b(?:[DB]\d|A\d+)\b(?!\.)", text.replace("appendix A2", "")), stage.name
        assert max(map(len, text.splitlines())) <= 120
        assert text.endswith('is yours to write")\n')
        # a stub has no module whose text one could see
        assert "module's text" not in text
    assert "    Pixel(color, T_final, ids, alphas, transmittances, n_traversed): " in stubs.stub(BY_NAME["compositing"])
    assert "    control(rows, statistics, scene_scale, step, normals, config): " in stubs.stub(BY_NAME["loop"])
    density = stubs.stub(BY_NAME["density"])
    for setting in ("grow_grad2d", "grow_scale3d", "blur_start_iter", "blur_stop_iter", "prune_opa"):
        assert f"`{setting}` (" in density or f"`{setting}`" in density
    assert not re.search("blur_rule|prune_too_big|grow_on_gradient|inclusive", density)
    assert not re.search("entropy|depth", stubs.stub(BY_NAME["loop"]))


def _colored(image: np.ndarray, color: np.ndarray) -> int:
    return int(np.sum(np.abs(image - color).max(axis=2) < 0.02))


@pytest.mark.parametrize(
    ("stage", "change"),
    [
        ("covariance", ("    return rotmats\n", "    return rotmats.swapaxes(1, 2).copy()\n")),
        ("covariance", ("        M = rotmats[i] * scales[i]\n", "        M = rotmats[i] * scales[i] ** 2\n")),
        ("alpha", ("return 0.5 * (A * dx * dx + C * dy * dy)", "return A * dx * dx + C * dy * dy")),
        ("tiles", ("key=lambda i: (depth_of[i], i)", "key=lambda i: (-depth_of[i], i)")),
    ],
    ids=["axes", "ellipses", "bars", "lists"],
)
def test_a_counterexample_is_drawn_with_what_came_out_and_what_should(
    mine: Path, stage: str, change: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    write(mine, stage, change)
    verdict = judge(read_work(mine), BY_NAME[stage])
    image = drawn_counterexample(verdict)
    assert image is not None
    assert image.shape[0] == HEAD + SIDE
    assert _reads(image, "yours", YOURS)
    assert _reads(image, "oracle", ORACLES)
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


def _reads(image: np.ndarray, text: str, color: np.ndarray) -> bool:
    """Tell whether a text stands anywhere in a picture in a colour."""
    inked = lettered(text)
    found = np.all(np.abs(image - color) < 1e-9, axis=2)
    places = np.lib.stride_tricks.sliding_window_view(found, inked.shape)
    return bool(np.any(np.all(places == inked, axis=(2, 3))))


def test_bars_say_which_numbers_they_are_and_the_first_ones_values() -> None:
    expected = np.arange(20.0) + 1.0
    found = expected.copy()
    found[17], found[4] = 18.25, -3.0
    call = Call("blend", (), (), {}, (found,), (expected,))
    image = drawn_counterexample(Verdict("", call=call))
    assert image is not None
    assert _reads(image, "yours [4] -3", YOURS)
    assert _reads(image, "oracle [4] 5", ORACLES)
    ink = np.array([0.25, 0.25, 0.25])
    assert _reads(image, "[17]", ink)
    assert not _reads(image, "[18]", ink), "what does not differ comes after what does"


def test_every_mistake_that_is_known_is_one_and_of_a_function_of_the_course(mine: Path) -> None:
    names = {name for stage in COURSE for name in stage.names}
    assert {mistake.function for mistake in MISTAKES} <= names
    write(mine, "alpha", ("return 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy", "return 0.0"))
    verdict = judge(read_work(mine), BY_NAME["alpha"])
    assert verdict.sentence.startswith("sigma_at_pixel is"), "a mistake that nobody knows is told as one that is"
    assert "always 0" in verdict.sentence
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
    assert "1 of 13 stages have passed" in course_map(work)
    assert "\x1b[32m" in course_map(work, color=True)
    path.write_text(path.read_text() + "\n")
    assert state(read_work(mine), stage) == WRITTEN


def test_what_has_passed_is_kept_where_a_disk_is_full(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, _content: bytes) -> None:
        path.touch()
        raise OSError(28, "No space left on device")

    write(mine, "alpha")
    note_passed(mine, BY_NAME["alpha"])
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        note_passed(mine, BY_NAME["alpha"])
    assert state(read_work(mine), BY_NAME["alpha"]) == PASSED
    assert not list(mine.glob("*.partial"))
    assert not list(mine.glob(".*.partial"))


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
    # what the pages then show unfolded
    assert " .html#passed=alpha\n" in printed
    assert "def falloff(" in printed


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
        (
            {"alpha.py": "def falloff(sigma):\n    return 1\nraise SystemExit(0)\n"},
            ["check", "alpha"],
            "alpha.py, line 3: the file cannot be run: SystemExit: 0",
        ),
        ({"alpha.py": "1 +\n"}, ["map"], "alpha.py, line 1: this is not Python yet"),
        ({}, ["train"], "not all is written yet: activations"),
        ({}, ["train", "--steps", "-5"], "--steps is -5; give 0, for the start alone, or more"),
        ({}, ["check", "alpha", "--json"], "--json belongs to --all"),
        ({}, ["check", "--all", "--answer"], "--answer is of one stage"),
        ({}, ["train", "--picture", "a.png", "--scene", "b"], "exclude each other"),
        (None, ["check", "alpha"], "has no stubs; 'pop-learn start"),
        (None, ["map"], "has no stubs; 'pop-learn start"),
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
    assert words[0] != "check" or alone.main([*words, str(folder)]) == 2


def test_ctrl_c_ends_a_check_with_a_line(mine, capsys, monkeypatch):
    def pressed(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(alone, "check", pressed)
    assert alone.main(["check", "alpha", str(mine)]) == 130
    assert capsys.readouterr().err == "pop-learn: interrupted\n"


def test_a_file_that_is_not_python_spoils_its_own_stage_only(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(mine, "activations")
    (mine / "alpha.py").write_text("def falloff(sigma):\n    return (1\n")
    assert main(["learn", "check", "activations", str(mine)]) == 0
    grade = graded(read_work(mine))
    assert grade["passed"] == ["activations"]
    (alpha,) = (stage for stage in grade["stages"] if stage["broken"])
    assert "alpha.py, line 2: this is not Python yet" in alpha["sentence"]


def test_a_file_with_a_mark_before_its_text_is_read_and_what_is_no_number_is_named(
    mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = "import math\ndef falloff(sigma):\n    return math.exp\n"
    (mine / "alpha.py").write_text(code, encoding="utf-8-sig")
    assert main(["learn", "check", "alpha", str(mine)]) == 1
    assert "falloff returns <built-in function exp>, which is not made of numbers alone.\n" in capsys.readouterr().out
    (mine / "alpha.py").write_text(code.replace("return math.exp", "raise SystemExit(0)"), encoding="utf-8")
    assert main(["learn", "check", "alpha", str(mine)]) == 1
    assert "line 3: it stops with SystemExit: 0" in " ".join(capsys.readouterr().out.split())


def _written(folder: Path) -> None:
    for stage in COURSE:
        write(folder, stage.name)


@pytest.mark.slow  # it trains in NumPy
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


@pytest.mark.slow  # it trains in NumPy
def test_density_control_ends_at_half_time_and_the_toy_learns(mine: Path) -> None:
    _written(mine)
    told_ = list(train(read_work(mine), the_toy(24), 24, every=1))
    sizes = [each.n for each in told_]
    assert len(set(sizes[12:])) == 1, "the number of Gaussians changes after half time"
    assert len(set(sizes)) > 1
    assert told_[-1].psnr > told_[0].psnr + 1.5


@pytest.mark.slow  # it trains
def test_a_capture_is_trained_on_from_its_points(mine: Path) -> None:
    _written(mine)
    make_demo(mine / "demo", views=6, width=64, height=48)
    capture = load_capture(mine / "demo")
    views = [((view.viewmat, view.K, 64, 48), view.image / 255.0) for view in capture.views]
    subject = a_capture(views, capture.points, capture.points_rgb / 255.0, capture.scene_scale(), n=60)
    assert (len(subject.views), len(subject.aside)) == (5, 1)
    # one view in eight is judged by and never trained on
    many = a_capture(views * 3, capture.points, capture.points_rgb / 255.0, capture.scene_scale(), n=60)
    assert (len(many.views), len(many.aside)) == (15, 3)
    *_, last = train(read_work(mine), subject, 4, every=4)
    assert np.isfinite(last.psnr)
    with pytest.raises(ValueError, match="two views and a point are needed"):
        a_capture(views[:1], capture.points, capture.points_rgb / 255.0, 1.0)
    with pytest.raises(ValueError, match="it must be 64 px at least"):
        a_picture(np.zeros((10, 80, 3)))


@pytest.mark.slow
def test_a_capture_of_ones_own_ends_above_20_db_and_not_by_what_came_last(
    mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _written(mine)
    # smaller than what photographs are shrunk to: they are taken as they are
    make_demo(mine / "demo", views=12, width=48, height=36)
    assert main(["learn", "train", str(mine), "--steps", "60", "--scene", str(mine / "demo")]) == 0
    told_ = capsys.readouterr().out
    psnrs = [float(text) for text in re.findall(r"([\d.]+) dB  ", told_)]
    assert psnrs[-1] > max(20.0, max(psnrs) - 1.0)
    n, mean, low, high = re.findall(
        r"(\d+) views that no step saw: ([\d.]+) dB on average, ([\d.]+) to ([\d.]+)", told_
    )[0]
    assert int(n) == 2
    assert 20.0 < float(low) <= float(mean) <= float(high)
    sizes = re.findall(r"(\d+) Gaussians", told_)
    assert len(set(sizes[3:])) == 1 < len(set(sizes)), "the number of Gaussians changes after half time"


def test_all_is_judged_with_a_score_also_as_json(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(mine, "alpha", ("    return math.exp(-sigma)\n", "    print('noise')\n    return math.exp(-sigma)\n"))
    write(
        mine, "optimizer", ("new_params[name] = params[name] - lr[name]", "new_params[name] = params[name] + lr[name]")
    )
    (mine / "losses.py").write_text("import nothing_like_it\n\ndef l1(image, target):\n    return 0.0\n")
    assert main(["learn", "check", "--all", "--json", str(mine)]) == 1
    grade = json.loads(capsys.readouterr().out)
    assert (grade["score"], grade["of"], grade["passed"]) == (6, 67, ["alpha"])
    by_name = {stage["name"]: stage for stage in grade["stages"]}
    assert list(by_name) == list(BY_NAME)
    assert "up the loss" in by_name["optimizer"]["sentence"]
    assert "nothing_like_it" in by_name["losses"]["sentence"]
    assert by_name["tiles"]["unwritten"] == list(BY_NAME["tiles"].names)
    assert main(["learn", "check", "--all", str(mine)]) == 1
    assert "6 of 67 functions are right; 1 of 13 stages have passed" in capsys.readouterr().out
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


@pytest.mark.slow  # every stage's laws, for several submissions
def test_a_class_is_graded_whatever_one_submission_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("anna", "bert", "cleo", "dora", "emil"):
        stubs.start(tmp_path / name)
    write(tmp_path / "anna", "alpha")
    (tmp_path / "bert" / "alpha.py").write_text("while True:\n    pass\ndef falloff(sigma):\n    return 1\n")
    (tmp_path / "cleo" / "alpha.py").write_text("import os\nos._exit(7)\ndef falloff(sigma):\n    return 1\n")
    lie = "print('pop learn graded: {\"score\": 66}')\nimport os, sys\nsys.__stdout__.write('pop learn graded: [')\n"
    end = "sys.__stdout__.flush()\nos._exit(0)\ndef falloff(sigma):\n    return 1\n"
    (tmp_path / "dora" / "alpha.py").write_text(lie + end)
    write(tmp_path / "emil", "activations")
    (tmp_path / "emil" / "alpha.py").write_text("def falloff(sigma):\n    return (1\n")
    (tmp_path / "notes").mkdir()
    assert main(["learn", "class", str(tmp_path), "--seconds", "12"]) == 0
    assert "anna: 6" in capsys.readouterr().out
    report = (tmp_path / "report.md").read_text()
    assert "| anna | 6 |" in report
    assert "- bert: it runs for longer than 12 s; is there an endless loop?" in report
    assert "- cleo: it ended with status 7" in report
    assert "- dora: its output cannot be distinguished from a grade" in report
    # a file that is not Python spoils its own stage only
    assert "| emil | 6 | passed |" in report
    assert "alpha.py, line 2: this is not Python yet" in report
    assert "notes" not in report
    assert main(["learn", "class", str(tmp_path / "notes")]) == 2
    assert "has no submissions" in capsys.readouterr().err


def test_a_class_is_told_of_folders_without_files_and_nobody_waits_for_input(tmp_path: Path) -> None:
    (tmp_path / "anna" / "mine").mkdir(parents=True)
    (tmp_path / "anna" / "mine" / "alpha.py").write_text("def falloff(sigma):\n    return 1\n")
    (tmp_path / "bert").mkdir()
    (tmp_path / "bert" / "alpha.py").write_text("input('go on?')\ndef falloff(sigma):\n    return 1\n")
    command = module_command("pop_fast.cli", "learn", "class", str(tmp_path), "--seconds", "60")
    # who grades sits before a terminal, on which nothing is typed
    terminal, typed = os.pipe()
    done = subprocess.run(command, stdin=terminal, capture_output=True, text=True)
    os.close(terminal)
    os.close(typed)
    assert "not graded, since no file of the course lies right inside: anna\nbert: 0\n" in done.stdout
    assert "the file cannot be run: EOFError" in (tmp_path / "report.md").read_text()


# one sentence may be of several mistakes, such as half a pixel to the left and to the right
NAMED = [f"{k}-{mistake.function}" for k, mistake in enumerate(MISTAKES)]


@pytest.mark.parametrize("mistake", MISTAKES, ids=NAMED)
def test_a_mistake_is_wrong_and_told_in_its_own_words(mistake: Mistake, tmp_path: Path) -> None:
    made, truth = partial(mistake.made, oracle()), oracle()[mistake.function]
    calls = [tried_on(made, truth, given, words) for words, given in probes(mistake.function)]
    assert not all(call.is_right for call in calls)
    assert not any(call.error for call in calls if not call.is_right)
    sentence, hint, _ = diagnose(calls, tmp_path)
    assert (sentence, hint) == (mistake.sentence, mistake.hint)


def test_a_law_that_the_course_leaves_out_is_one_of_its_stages() -> None:
    stages = {stage for each in COURSE for stage in each.laws}
    for name in NOT_TAUGHT:
        laws = [law for key, law in every_law().items() if key.partition(":")[2] == name]
        assert len(laws) == 1, name
        assert laws[0].stage in stages


def _told_of(name: str, made: Any, folder: Path) -> tuple[str, str]:
    """Try a function on its probes; return the sentence and the hint that are said of it."""
    calls = [tried_on(made, oracle()[name], given, words) for words, given in probes(name)]
    return diagnose(calls, folder)[:2]


def test_what_adam_gives_is_told_by_what_it_is(tmp_path: Path) -> None:
    def half(*given, **named):
        params, m, v = oracle()["adam_step"](*given, **named)
        return params, {name: 0.3 * x + 1.0 for name, x in m.items()}, v

    assert _told_of("adam_step", half, tmp_path)[0].startswith("the mean m in adam_step is not right yet")


def test_a_pixel_that_blends_too_few_is_told_how_many(tmp_path: Path) -> None:
    def one(ids, *given):
        return oracle()["composite_pixel"](ids[:1], *given)

    sentence, _ = _told_of("composite_pixel", one, tmp_path)
    assert sentence == "composite_pixel blends another number of splats, 1 and not 3."


def test_who_sets_a_field_of_the_totals_is_told_to_add_in_place(tmp_path: Path) -> None:
    def setting(pixel, rows, px, py, background, v_color, v_T_final, totals):
        totals.v_background += pixel.T_final

    assert "totals.v_background[:] += x" in _told_of("composite_pixel_vjp", setting, tmp_path)[1]


def test_an_argument_that_is_a_factor_too_many_or_too_few_is_named(tmp_path: Path) -> None:
    def without_v(image, target, v_l2, *mask):
        return oracle()["l2_vjp"](image, target, 1.0, *mask)

    def blurred(covars2d, eps2d, v):
        return eps2d * v

    assert _told_of("l2_vjp", without_v, tmp_path)[0] == "l2_vjp lacks the factor `v_l2`."
    sentence, _ = _told_of("low_pass_vjp", blurred, tmp_path)
    assert "has the factor `eps2d`, which does not belong there" in sentence


def test_the_translation_of_a_camera_is_named_and_no_letter(tmp_path: Path) -> None:
    def turned_back(viewmat, v_center):
        back = oracle()["camera_center_vjp"](viewmat, v_center)
        back[:3, 3] = -viewmat[:3, :3].T @ v_center
        return back

    sentence, _ = _told_of("camera_center_vjp", turned_back, tmp_path)
    assert "the last column, the translation's, only" in sentence


def test_numbers_of_another_kind_are_refused_though_their_values_are_right(tmp_path: Path) -> None:
    def floats(width, height, size):
        # raises where it must, too
        return tuple(map(float, oracle()["grid_size"](width, height, size)))

    asked = {
        "prune_mask": lambda *given: oracle()["prune_mask"](*given).astype(int),
        "importance_mask": lambda counts: (counts > 0).astype(float),
        "grid_size": floats,
    }
    for name, made in asked.items():
        kind = "whole numbers" if made is floats else "truth values"
        assert f"gives other numbers where {kind} are asked for" in _told_of(name, made, tmp_path)[0]
    # one truth value may be 1, which no list is asked for by
    for words, given in probes("stops"):
        assert tried_on(lambda next_T: int(next_T <= 1e-4), oracle()["stops"], given, words).is_right


def test_single_precision_is_told_by_its_digits_and_digits_that_are_shown_differ(tmp_path: Path) -> None:
    def single(sigma):
        return float(np.exp(np.float32(-sigma)))

    sentence, _ = _told_of("falloff", single, tmp_path)
    assert re.search(r"right to \d digits and no further.*float32", sentence), sentence
    # the call that is shown is nearly right, the other is not
    near, far = (
        Call("falloff", ("sigma",), (1.0,), {}, (np.array(found), ()), (np.array(expected), ()))
        for found, expected in (([1.37061, 5.0], [1.37058, 5.0]), ([1.0, 2.0], [3.0, 2.5]))
    )
    assert "is not right yet: 1.37061 where 1.37058 is asked for" in diagnose([near, far], Path())[0]


def test_what_is_called_right_is_right_where_many_parts_are_wrong(tmp_path: Path) -> None:
    def half_a_pixel_off(ids, rows, px, py, background):
        return oracle()["composite_pixel"](ids, rows, px + 0.5, py + 0.5, background)

    sentence, _ = _told_of("composite_pixel", half_a_pixel_off, tmp_path)
    # of six parts the splats and their number are right
    assert "`color` and `T_final` and 2 more parts in composite_pixel are not right yet" in sentence


def test_a_dictionary_is_compared_by_its_keys_and_not_by_their_order(tmp_path: Path) -> None:
    def backwards(*given):
        return dict(reversed(oracle()["params_vjp"](*given).items()))

    assert all(tried_on(backwards, oracle()["params_vjp"], given, "").is_right for _, given in probes("params_vjp"))

    def renamed(*given):
        return {name.replace("opacities", "opacity"): x for name, x in oracle()["params_vjp"](*given).items()}

    def numbered(*given):
        return {**oracle()["params_vjp"](*given), 0: np.zeros(3)}

    for other in (renamed, numbered):
        sentence, _ = _told_of("params_vjp", other, tmp_path)
        assert "other keys: the keys means, opacities, quats, scales, sh0 are asked for" in sentence


def test_what_is_off_on_some_inputs_is_not_said_to_be_off_everywhere(tmp_path: Path) -> None:
    def one_more(width, height, size):
        if size < 1:
            raise ValueError
        # right where a part of a tile is left over
        return width // size + 1, height // size + 1

    assert _told_of("grid_size", one_more, tmp_path)[0] == "grid_size is off by one on some inputs (+1)."


def test_an_argument_that_all_parts_lack_is_named(tmp_path: Path) -> None:
    def without_v(mean2d, conic, px, py, v_sigma):
        return oracle()["sigma_at_pixel_vjp"](mean2d, conic, px, py, 1.0)

    assert _told_of("sigma_at_pixel_vjp", without_v, tmp_path)[0] == "sigma_at_pixel_vjp lacks the factor `v_sigma`."


def test_a_law_is_given_up_once_patience_has_run_out(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def never(backend: Any, x: list[int]) -> None:
        raise AssertionError

    monkeypatch.setattr("pop_ref.learn.judge.PATIENCE_S", -1.0)
    strategies = {"x": st.lists(st.integers(), min_size=4).map(lambda x: drawn.append(x) or x)}
    failure, _ = _tried(Law("alpha", (), never, strategies), cast(Any, OracleAdapter()))
    # the first input, and one more at which its time is over
    assert failure is not None
    assert failure.least == failure.first
    assert len(drawn) == 2
