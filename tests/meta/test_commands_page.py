"""docs/commands.md shows every command of `pop` and `pop-repro`, as it was run, and nothing of the machine."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
SCRIPT = runpy.run_path(str(DOCS / "commands.py"), run_name="commands")
PAGE = (DOCS / "commands.md").read_text(encoding="utf-8")


def test_every_command_was_run_and_is_shown() -> None:
    assert SCRIPT["lacking"](PAGE) == [], "run 'python docs/commands.py --write'"
    assert SCRIPT["lacking"](PAGE.replace("## pop eval", "## pop evaluate")) == ["pop eval"]


def test_every_command_line_of_the_script_is_on_the_page() -> None:
    typed = [run.words for run in (*SCRIPT["RUNS"], *SCRIPT["REPRO"])]
    assert re.findall(r"^\$ (.*)$", PAGE, flags=re.MULTILINE) == typed


def test_no_command_failed_and_no_path_of_the_machine_is_shown() -> None:
    assert "Traceback" not in PAGE
    assert "error:" not in PAGE
    assert not re.search(r"(^|[\s\"'(])/(tmp|home|root|work|Users)\b", PAGE)


def test_pictures_are_there_small_and_all_used() -> None:
    named = set(re.findall(r"!\[[^]]+\]\(([^)]+)\)", PAGE))
    assert named == {f"commands/{path.name}" for path in (DOCS / "commands").iterdir()}
    assert len(named) >= 8
    assert all((DOCS / name).stat().st_size < 400_000 for name in named)


def test_a_long_output_is_cut_in_the_middle() -> None:
    text = "\n".join(map(str, range(100)))
    lines = SCRIPT["shown"](text, Path("/nowhere")).splitlines()
    assert (lines[0], lines[-1], len(lines)) == ("0", "99", SCRIPT["LONGEST"] + 1)
    assert lines[SCRIPT["LONGEST"] // 2] == "... 70 lines more ..."
