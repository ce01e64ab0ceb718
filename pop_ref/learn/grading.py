"""Grade a submission, and a class of them: which stages pass, which functions are right, what is said of the rest.

A submission is a program that runs with the rights of whoever grades it. In a class each is run in a process of its own
for a limited time, so that one which never ends, or ends Python, spoils its own line only.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Final

from pop_ref.learn.course import BY_NAME, COURSE, Stage
from pop_ref.learn.judge import Verdict, Watch, judge
from pop_ref.learn.student import Work, read_work

N_FUNCTIONS: Final = sum(len(stage.names) for stage in COURSE)
# how a graded submission is told from what the submission itself prints
_MARK: Final = "pop learn graded: "


def graded(work: Work, watch: Watch = nullcontext) -> dict[str, Any]:
    """Judge every stage of a submission; what it prints goes nowhere. `judge` says what `watch` is.

    Returns:
        "score", the functions that are right, "of" so many; "passed", the stages that have; and "stages", a list of
        name, passed, right, unwritten, laws (that hold), broken and sentence.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        stages = [_stage_graded(work, stage, watch) for stage in COURSE]
    return {
        "score": sum(len(each["right"]) for each in stages),
        "of": N_FUNCTIONS,
        "passed": [each["name"] for each in stages if each["passed"]],
        "stages": stages,
    }


def _stage_graded(work: Work, stage: Stage, watch: Watch) -> dict[str, Any]:
    verdict = Verdict(unwritten=stage.names)
    if work.written[stage.name] or stage.name in work.unreadable:
        try:
            verdict = judge(work, stage, watch)
        except ValueError as error:
            verdict = Verdict(broken="the file runs", sentence=str(error))
    return {
        "name": stage.name,
        "passed": verdict.passed,
        "right": list(verdict.right),
        "unwritten": list(verdict.unwritten),
        "laws": verdict.n_held,
        "broken": verdict.broken,
        "sentence": verdict.sentence,
    }


def told_in_lines(grade: dict[str, Any]) -> str:
    """Write a grade for its student."""
    lines = []
    for stage in grade["stages"]:
        n = len(BY_NAME[stage["name"]].names)
        how = "passed" if stage["passed"] else "not yet"
        lines.append(f"{stage['name']:<12} {how:<8} {len(stage['right'])}/{n}  {stage['sentence']}".rstrip())
    passed = f"{len(grade['passed'])} of {len(COURSE)} stages have passed"
    return "\n".join([*lines, f"{grade['score']} of {grade['of']} functions are right; {passed}"])


def handed_over(grade: dict[str, Any]) -> str:
    """Write a grade as the one line that `read_grade` looks for.

    Example:
        >>> handed_over({"score": 1})
        'pop learn graded: {"score": 1}'
    """
    return _MARK + json.dumps(grade)


def submissions(folder: Path) -> tuple[list[Path], list[str]]:
    """Find the folders of a class.

    Returns:
        Those inside `folder` that hold a file of the course, and the names of those that hold none.

    Raises:
        ValueError: there is none.
    """
    inside = sorted(each for each in folder.iterdir() if each.is_dir()) if folder.is_dir() else []
    found = [each for each in inside if any((each / stage.file).exists() for stage in COURSE)]
    if not found:
        raise ValueError(
            f"{folder} has no submissions; put one folder a student into it, each with files of the course"
        )
    return found, [each.name for each in inside if each not in found and not each.name.startswith(".")]


def read_grade(printed: str) -> dict[str, Any] | None:
    """Find a grade in what a process printed that ran `main`; None where there is none that can be read.

    Example:
        >>> read_grade("pop learn graded: [") is None
        True
    """
    lines = [line for line in printed.splitlines() if line.startswith(_MARK)]
    try:
        grade = json.loads(lines[-1].removeprefix(_MARK))
        return grade if _is_grade(grade) else None
    except (IndexError, ValueError, TypeError, RecursionError):
        return None


def _is_grade(grade: Any) -> bool:
    """Tell that a value has a grade's parts, each of its kind: a submission may have printed it."""
    parts = {"name": str, "passed": bool, "right": list, "unwritten": list, "laws": int, "broken": str, "sentence": str}
    return (
        isinstance(grade, dict)
        and set(grade) == {"score", "of", "passed", "stages"}
        and isinstance(grade["score"], int)
        and isinstance(grade["passed"], list)
        and isinstance(grade["stages"], list)
        and all(isinstance(stage, dict) and set(stage) == set(parts) for stage in grade["stages"])
        and all(isinstance(stage[part], kind) for stage in grade["stages"] for part, kind in parts.items())
    )


def main() -> None:
    """Grade the folder that the command line names and print the line that `read_grade` looks for."""
    try:
        print(handed_over(graded(read_work(Path(sys.argv[1])))))
    except ValueError as error:
        sys.exit(str(error))


def stopped(why: str) -> dict[str, Any]:
    """Return the grade of a submission that did not come to an end."""
    return {"score": 0, "of": N_FUNCTIONS, "passed": [], "stages": [], "stopped": why}


def class_report(grades: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """Write a class as markdown: a line a student, a column a stage, and what is wrong most often."""
    head = f"| student | score of {N_FUNCTIONS} | {' | '.join(BY_NAME)} |"
    lines = [head, "|" + "---|" * (len(COURSE) + 2)]
    for student, grade in grades:
        by_name = {stage["name"]: stage for stage in grade["stages"]}
        cells = []
        for stage in COURSE:
            found = by_name.get(stage.name)
            right = f"{len(found['right'])}/{len(stage.names)}" if found else ""
            cells.append("passed" if found and found["passed"] else right)
        lines.append(f"| {student} | {grade['score']} | {' | '.join(cells)} |")
    stopped = [f"- {student}: {grade['stopped']}" for student, grade in grades if "stopped" in grade]
    said = Counter(stage["sentence"] for _, grade in grades for stage in grade["stages"] if stage["sentence"])
    common = [f"- {n} of {len(grades)}: {sentence}" for sentence, n in said.most_common(10)]
    parts = ["\n".join(lines)]
    parts += ["Not graded:\n\n" + "\n".join(stopped)] if stopped else []
    parts += ["Said most often:\n\n" + "\n".join(common)] if common else []
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    main()
