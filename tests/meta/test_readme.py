"""README.md and the pages of docs/ say what is true: their tables, names, paths and commands."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from pop_fast.cli import COMMANDS
from pop_ref.conformance.backends import ELSEWHERE, SHIPPED
from pop_ref.conformance.capabilities import STAGES as LAW_STAGES
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.plugin import pytest_addoption
from pop_ref.conformance.scorecard import outcomes
from pop_ref.constants import PROFILES

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)

# functions whose fast twin cannot have the oracle's parameters, and why
OTHER_PARAMETERS = {
    "compositing.composite": "autograd has to see the arrays themselves, so they are not wrapped in Splats",
    "splatting.project": "the same: arrays, and what all cameras share (covariances) is made once outside",
}


def load(name: str) -> ModuleType:
    """Import a script of docs/ by its path."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


stages = load("stages")
tables = load("tables")
BOTH_ROOMS = [
    (f"{module}.{name}", reference, fast[name])
    for stage in stages.STAGES
    for module in stage.modules
    if (fast := stages.functions(ROOT / "pop_fast" / "stages" / f"{module}.py")) is not None
    for name, reference in stages.functions(ROOT / "pop_ref" / f"{module}.py").items()
    if name in fast
]


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_are_what_sources_and_runs_say(page: Path) -> None:
    assert tables.with_tables(page) == page.read_text(encoding="utf-8"), "run 'python docs/tables.py --write'"


def test_every_table_stands_on_one_page() -> None:
    named = [name for page in tables.PAGES for name in tables.names_of(page.read_text(encoding="utf-8"))]
    assert sorted(named) == sorted(tables.TABLES)


def test_the_readme_is_short_and_leads_to_every_page() -> None:
    assert len(README.splitlines()) < 90
    assert all(f"(docs/{page.name})" in README for page in PAGES[1:])


@pytest.mark.parametrize("text", ["<!-- nothing:begin -->\n<!-- nothing:end -->\n", "<!-- kit:begin -->\n"])
def test_marks_of_no_table_are_refused(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    with pytest.raises(ValueError, match="needs"):
        tables.with_tables(page)


def test_the_results_script_agrees_with_the_readme() -> None:
    script = ROOT / "benchmarks" / "results_table.py"
    pages = [ROOT / "README.md", ROOT / "docs" / "results.md"]
    done = subprocess.run([sys.executable, script, "--check", *pages], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_stage_of_the_oracle_has_its_row() -> None:
    named = {module for stage in stages.STAGES for module in stage.modules}
    present = {path.stem for path in (ROOT / "pop_ref").glob("*.py")} - stages.NOT_STAGES
    assert present == named


@pytest.mark.parametrize("stage", stages.STAGES, ids=lambda stage: stage.title)
def test_every_stage_has_functions_and_laws(stage) -> None:
    assert any(stages.functions(path) for path in stages.files("pop_ref", stage))
    laws = list(stages.laws(stage))
    assert laws
    assert all(path.exists() for path in laws)
    assert all(path.is_file() for path in stages.files("pop_fast", stage))


def test_the_rooms_share_most_of_their_functions() -> None:
    assert len(BOTH_ROOMS) >= 40


@pytest.mark.parametrize(("name", "reference", "fast"), BOTH_ROOMS, ids=lambda value: value if value else "")
def test_twins_take_the_same_parameters(name: str, reference: list[str], fast: list[str]) -> None:
    """The fast twin may add parameters of its own, after the oracle's."""
    assert (fast[: len(reference)] == reference) == (name not in OTHER_PARAMETERS), (reference, fast)


def test_documented_differences_are_still_there() -> None:
    assert set(OTHER_PARAMETERS) <= {name for name, _, _ in BOTH_ROOMS}


LINKS = sorted(
    {
        (page, target)
        for page in PAGES
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    }
)


@pytest.mark.parametrize(("page", "target"), LINKS, ids=lambda value: getattr(value, "name", value))
def test_every_link_leads_somewhere(page: Path, target: str) -> None:
    assert "://" not in target
    assert (page.parent / target).exists()


def shell_lines() -> list[str]:
    """Give the commands of the pages' shell blocks, without comments."""
    blocks = re.findall(r"```sh\n(.*?)```", TEXT, flags=re.DOTALL)
    return [line.partition("  #")[0].strip() for block in blocks for line in block.splitlines() if line.strip()]


@pytest.mark.parametrize("line", [line for line in shell_lines() if line.startswith("pop ")])
def test_every_command_of_the_readme_is_understood(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(line)[1:]
    name = " ".join(words[:2]) if " ".join(words[:2]) in COMMANDS else words[0]
    module = importlib.import_module(f"pop_fast.cli.{re.sub('[ -]', '_', name)}")
    rest = words[len(name.split()) :]
    if name == "train":
        module.arguments(rest)
    else:
        importlib.import_module("pop_fast.cli.arguments").parse(module.Args, rest, name)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("line", [line for line in shell_lines() if line.startswith("pytest ")])
def test_every_option_of_the_kit_exists(line: str) -> None:
    known = pytest.Parser(_ispytest=True)
    pytest_addoption(known)
    words = shlex.split(line, comments=True)[1:]
    assert words[:2] == ["--pyargs", "pop_ref.conformance"]
    given = known.parse_known_args(words[2:])
    assert not given.file_or_dir
    assert given.profile in PROFILES
    assert set(given.stage) <= set(LAW_STAGES)
    assert set(given.backend) <= {*SHIPPED, *ELSEWHERE}


def test_the_list_of_mutants_is_current() -> None:
    assert f"{tables.mutants()}\n" == tables.MUTANT_LIST.read_text(encoding="utf-8"), (
        "run 'python docs/tables.py --write'"
    )


@pytest.mark.parametrize("file", sorted({file for file, _ in tables.JUDGED.values()}))
def test_every_law_stands_on_every_scorecard(file: str) -> None:
    expected = {(law.stage, law.name) for law in every_law().values()}
    told = tables.card(file)
    assert set(told["laws"]) == {backend for name, backend in tables.JUDGED.values() if name == file}
    for backend, stages_of in told["laws"].items():
        found = {(stage, law) for stage, laws in stages_of.items() for law in outcomes(laws)}
        assert found == expected, f"{file}: judge {backend} again"
        for stage, laws in stages_of.items():
            came = [outcome.split(":")[0] for outcome in outcomes(laws).values()]
            counted = {outcome: came.count(outcome) for outcome in ("passed", "failed", "skipped")}
            assert told["summary"][backend][stage] == counted
    assert told["made"]["hypothesis profile"] == "ci"


def test_our_own_backends_break_no_law() -> None:
    for file in ("pop_fast.json", "host_mirror.json"):
        for column in tables.card(file)["summary"].values():
            assert sum(count["failed"] for count in column.values()) == 0
            assert sum(count["passed"] for count in column.values()) > 100


@pytest.mark.parametrize("line", [line for line in shell_lines() if line.startswith("make ")])
def test_every_make_target_of_the_readme_exists(line: str) -> None:
    target = line.split()[1]
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)


def test_names_in_python_blocks_resolve() -> None:
    blocks = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    imports = [node for block in blocks for node in ast.parse(block).body if isinstance(node, ast.ImportFrom)]
    assert imports
    for node in imports:
        module = importlib.import_module(str(node.module))
        for alias in node.names:
            assert hasattr(module, alias.name), alias.name


def test_the_pictures_are_small_and_made_of_our_own_scene() -> None:
    # those of the page of commands are that page's test's
    pictures = re.findall(r"!\[[^]]*\]\((?!commands/)([^)]+)\)", TEXT)
    assert set(pictures) == {"docs/demo.png"}
    assert all((ROOT / picture.removeprefix("../")).stat().st_size < 300_000 for picture in pictures)
