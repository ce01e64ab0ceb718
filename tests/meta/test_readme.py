"""README.md and the pages of docs/ say what is true: their tables, names, paths and commands."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import json
import re
import runpy
import shlex
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.cli import COMMANDS, command, parse
from pop_fast.io.formats import FORMATS
from pop_ref.conformance.backends import ELSEWHERE, SHIPPED
from pop_ref.conformance.capabilities import STAGES as LAW_STAGES
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.plugin import pytest_addoption
from pop_ref.conformance.scorecard import outcomes
from pop_ref.constants import PROFILES
from pop_ref.polarization import importance_mask
from pop_ref.polarization import pop_loss as oracle_loss

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)

# functions whose fast twin cannot have the oracle's parameters, and why
OTHER_PARAMETERS = {
    "compositing.composite": "autograd has to see the arrays themselves, so they are not wrapped in Splats",
    "splatting.project": "the same: arrays, and what all cameras share (covariances) is made once outside",
}


def load(file: str, name: str = "") -> ModuleType:
    spec = importlib.util.spec_from_file_location(name or file, DOCS / f"{file}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name or file] = module
    spec.loader.exec_module(module)
    return module


tables = load("tables")
FAST = {
    name: given
    for path in (ROOT / "pop_fast" / "stages").glob("*.py")
    for name, given in tables.functions(path).items()
}
# Python has a module of that name
site = load("site", "site_hook")
BOTH_ROOMS = [
    (f"{module}.{name}", reference, FAST[name])
    for stage in tables.STAGES
    for module in stage.modules
    for name, reference in tables.functions(ROOT / "pop_ref" / f"{module}.py").items()
    if name in FAST
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


def test_every_stage_of_the_oracle_has_its_row() -> None:
    named = {module for stage in tables.STAGES for module in stage.modules}
    present = {path.stem for path in (ROOT / "pop_ref").glob("*.py")} - tables.NOT_STAGES
    assert present == named


@pytest.mark.parametrize("stage", tables.STAGES, ids=lambda stage: stage.title)
def test_every_stage_has_functions_and_laws(stage) -> None:
    assert any(tables.functions(path) for path in tables.files("pop_ref", stage))
    laws = list(tables.laws(stage))
    assert laws
    assert all(path.exists() for path in laws)
    assert all(path.is_file() for path in tables.files("pop_fast", stage))


@pytest.mark.parametrize(("name", "reference", "fast"), BOTH_ROOMS, ids=lambda value: value if value else "")
def test_twins_take_the_same_parameters(name: str, reference: list[str], fast: list[str]) -> None:
    """The fast twin may add parameters of its own, after the oracle's."""
    assert (fast[: len(reference)] == reference) == (name not in OTHER_PARAMETERS), (reference, fast)


def test_the_rooms_share_most_of_their_functions_and_documented_differences_are_still_there() -> None:
    assert len(BOTH_ROOMS) >= 40
    assert set(OTHER_PARAMETERS) <= {name for name, _, _ in BOTH_ROOMS}


def anchors(page: Path) -> set[str]:
    """Name the headings of a page as links do."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}


REPRODUCTION = [ROOT / "paper_repro" / name for name in ("README.md", "protocol.md", "claims.md")]


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CONTRIBUTING.md", *REPRODUCTION], ids=lambda page: f"{page.parent.name}/{page.name}"
)
def test_every_link_leads_somewhere_and_no_conflict_of_a_merge_is_left(page):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"^(<<<<<<<|>>>>>>>) ", text, re.MULTILINE)
    targets = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text)
    assert [target for target in targets if "://" in target or not (page.parent / target).exists()] == []
    places = re.findall(r"\]\(((?:[^)#]+\.md)?)#([^)]+)\)", text)
    assert [place for file, place in places if place not in anchors(page.parent / file if file else page)] == []


def test_what_contributors_are_led_to_is_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:pop_ref|pop_fast|cuda_ext|paper_repro|benchmarks|tests|docs)/[\w./-]*)`", text)
    assert len(named) > 25
    assert [name for name in named if not (ROOT / name).exists()] == []


def shell_lines() -> list[str]:
    """Give the commands of the pages' shell blocks, without comments."""
    blocks = re.findall(r"```sh\n(.*?)```", TEXT, flags=re.DOTALL)
    return [line.partition("  #")[0].strip() for block in blocks for line in block.splitlines() if line.strip()]


@pytest.mark.parametrize("line", [line for line in shell_lines() if line.startswith("pop ")])
def test_every_command_of_the_readme_is_understood(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(line)[1:]
    name = " ".join(words[:2]) if " ".join(words[:2]) in COMMANDS else words[0]
    module = sys.modules[command(name).__module__]
    kind = {"build-cpu": "CpuArgs", "build-cuda": "CudaArgs"}.get(name, "Args")
    rest = words[len(name.split()) :]
    if name == "train":
        module.arguments(rest)
    else:
        parse(getattr(module, kind), rest, name)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("line", [line for line in shell_lines() if line.startswith("pytest ")])
def test_every_option_of_the_kit_exists(line: str) -> None:
    known = pytest.Parser(_ispytest=True)
    pytest_addoption(known)
    words = shlex.split(line, comments=True)[1:]
    assert words[:2] == ["--pyargs", "pop_ref.conformance"]
    given = known.parse_known_args(words[2:])
    assert not given.file_or_dir
    assert given.profile is None or given.profile in PROFILES
    assert set(given.stage) <= set(LAW_STAGES)
    assert set(given.backend) <= {*SHIPPED, *ELSEWHERE}


@pytest.mark.parametrize("file", tables.LISTS, ids=lambda file: file.name)
def test_the_lists_of_mutants_and_of_laws_are_current(file: Path) -> None:
    assert tables.LISTS[file]() == file.read_text(encoding="utf-8"), "run 'python docs/tables.py --write'"


@pytest.mark.parametrize("file", sorted({file for file, _ in tables.JUDGED.values()}))
def test_every_law_stands_on_every_scorecard(file: str) -> None:
    expected = {(law.stage, law.name) for law in every_law().values()}
    told = tables.card(file)
    assert set(told["laws"]) == {backend for name, backend in tables.JUDGED.values() if name == file}
    for backend, stages_of in told["laws"].items():
        found = {(stage, law) for stage, laws in stages_of.items() for law in outcomes(laws)}
        assert found == expected, f"{file}: judge its backends again; CONTRIBUTING.md has the command"
        for stage, laws in stages_of.items():
            came = [outcome.split(":")[0] for outcome in outcomes(laws).values()]
            counted = {outcome: came.count(outcome) for outcome in ("passed", "failed", "skipped")}
            assert told["summary"][backend][stage] == counted
    assert told["made"]["hypothesis profile"] == "ci"


def test_our_own_backends_break_no_law() -> None:
    for file in ("pop_fast.json", "compiled.json"):
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


def test_the_pictures_are_small_and_show_no_photograph_but_of_our_own_scene() -> None:
    # those of the page of commands are that page's test's
    pictures = re.findall(r"!\[[^]]*\]\((?!commands/)([^)]+)\)", TEXT)
    # figure_1 shows no photograph
    assert set(pictures) == {"docs/demo.png", "docs/figure_1.png", "docs/page.png"}
    assert all((ROOT / picture.removeprefix("../")).stat().st_size < 300_000 for picture in pictures)


def test_the_page_of_formats_tells_every_loss() -> None:
    fields = ["centre", "scale", "rotation", "opacity", "colour", "view dependence"]
    assert all(list(format.losses) == fields for format in FORMATS.values())


# docs/commands.md shows every command of `pop` and `pop-repro`, as it was run, and nothing of the machine.

SCRIPT = runpy.run_path(str(DOCS / "commands.py"), run_name="commands")
PAGE = (DOCS / "commands.md").read_text(encoding="utf-8")


def test_every_command_was_run_and_is_shown_and_none_failed() -> None:
    assert SCRIPT["lacking"](PAGE) == [], "run 'python docs/commands.py --write'"
    assert SCRIPT["lacking"](PAGE.replace("## pop eval", "## pop evaluate")) == ["pop eval"]
    typed = [run.words for run in (*SCRIPT["RUNS"], *SCRIPT["REPRO"])]
    assert re.findall(r"^\$ (.*)$", PAGE, flags=re.MULTILINE) == typed
    outside = re.sub(r"^(`{3,})\w*\n.*?^\1$", "", PAGE, flags=re.MULTILINE | re.DOTALL)
    assert re.findall(r"^## (.*)$", outside, re.MULTILINE) == re.findall(r"^## (pop\b.*)$", PAGE, re.MULTILINE)
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


# The hook of `make site`: links of the repository lead to the same files on the site.


@pytest.mark.parametrize(
    ("path", "where"),
    [
        ("README.md", "index.md"),
        ("docs/kit.md", "kit.md"),
        ("docs/demo.png", "demo.png"),
        ("pop_ref/alpha.py", "source/pop_ref/alpha.py.md"),
        ("pop_ref/conformance/LAWS.md", "source/pop_ref/conformance/LAWS.md"),
        ("benchmarks/results/scorecards", "source/benchmarks/results/scorecards.md"),
        ("pop_ref/walkthrough/chapter_04b_tiles.py", "learn/chapter_04b_tiles.html"),
    ],
)
def test_every_file_has_its_place(path: str, where: str) -> None:
    assert site.place(path) == where


@pytest.mark.parametrize(
    ("page", "link", "turned"),
    [
        ("README.md", "docs/kit.md", "kit.md"),
        ("README.md", "pop_ref/learn/splat.py", "source/pop_ref/learn/splat.py.md"),
        ("docs/kit.md", "MUTANTS.md", "MUTANTS.md"),
        ("docs/learn.md", "../README.md", "index.md"),
        ("docs/speed.md", "../benchmarks/NOTES.md#where", "source/benchmarks/NOTES.md#where"),
        ("paper_repro/README.md", "claims.py", "claims.py.md"),
        ("docs/learn.md", "../pop_ref/walkthrough/chapter_01b_learning.py", "learn/chapter_01b_learning.html"),
        ("paper_repro/README.md", "../docs/paper.md", "../../paper.md"),
        ("docs/kit.md", "https://example.org/a.py", "https://example.org/a.py"),
    ],
)
def test_links_are_turned(page: str, link: str, turned: str) -> None:
    assert site.with_links_of_the_site(f"see [it]({link}).", page) == f"see [it]({turned})."


def test_all_that_pages_lead_to_is_there_and_pages_in_markdown_are_followed() -> None:
    made = site.linked(["README.md", "docs/paper.md"])
    assert "paper_repro/protocol.md" in made
    assert "pop_ref/settings.py" in made  # protocol.md leads there, not docs/paper.md
    assert all((ROOT / path).exists() for path in made)


def test_a_fence_is_longer_than_any_within() -> None:
    made = site.content("docs/site.py")
    inside = max(len(run) for run in re.findall(r"`+", (ROOT / "docs" / "site.py").read_text(encoding="utf-8")))
    fence = re.findall(r"^(`+)\{\.python", made, re.MULTILINE)[0]
    assert len(fence) > inside


def test_formulas_need_no_script() -> None:
    made = site.with_formulas("the mean $\\mu_i$, and `$HOME` stays")
    assert "<math" in made
    assert "\\mu" not in made
    assert "`$HOME` stays" in made


# docs/trainer.md: its code runs, its prior is the oracle's. CITATION.cff and the workflows agree with the project.

TRAINER_PAGE = (ROOT / "docs" / "trainer.md").read_text(encoding="utf-8")
STEP, PRIOR = (
    compile(code, "docs/trainer.md", "exec") for code in re.findall(r"```python\n(.*?)```", TRAINER_PAGE, re.DOTALL)
)


def names_of(code: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    exec(code, found)
    return found


def scene() -> tuple[dict[str, torch.nn.Parameter], dict[str, torch.optim.Optimizer]]:
    rng = torch.Generator().manual_seed(0)
    n = 12
    means = torch.rand(n, 3, generator=rng) - 0.5
    means[:, 2] += 3.0
    values = {
        "means": means,
        "quats": torch.rand(n, 4, generator=rng) + 0.1,
        "scales": torch.full((n, 3), -2.0),
        "opacities": torch.zeros(n),
        "sh0": torch.rand(n, 1, 3, generator=rng),
        "shN": torch.zeros(n, 15, 3),
    }
    params = {name: torch.nn.Parameter(value) for name, value in values.items()}
    return params, {name: torch.optim.Adam([value], lr=1e-2, eps=1e-15) for name, value in params.items()}


@pytest.mark.filterwarnings("error::UserWarning")
def test_the_step_of_the_page_trains_with_the_prior_and_changes_the_gaussians() -> None:
    page = names_of(STEP)
    K = torch.tensor([[16.0, 0.0, 8.0], [0.0, 16.0, 6.0], [0.0, 0.0, 1.0]])
    seen, moved = (torch.zeros(12, 16, 3), torch.eye(4), K), {}
    for prior in (True, False):
        settings = {"refine_start_iter": 0, "refine_every": 4, "grow_grad2d": 0.0, "blur_stop_iter": -1}
        strategy = type(page["strategy"])(**settings, lambda_pop=10.0 if prior else 0.0)
        page["strategy"] = strategy
        params, optimizers = scene()
        state = strategy.initialize_state(1.0)
        losses = [page["step_with_prior"](step, params, optimizers, state, *seen) for step in range(4)]
        assert losses[-1] < losses[0]
        moved[prior] = params["opacities"].detach().clone()
        page["step_with_prior"](4, params, optimizers, state, *seen)
        assert len(params["means"]) > 12
        assert {len(o.param_groups[0]["params"][0]) for o in optimizers.values()} == {len(params["means"])}
    # with the prior some opacities rise, where the black photograph alone would lower every one
    assert (moved[True] > 0).any()
    assert not (moved[False] > 0).any()


@given(st.lists(st.tuples(st.floats(0.01, 0.99), st.integers(0, 2)), min_size=1, max_size=6))
def test_the_prior_of_the_page_is_the_oracles(rows: list[tuple[float, int]]) -> None:
    opacities, counts = np.array([o for o, _ in rows]), np.array([n for _, n in rows])
    ours = names_of(PRIOR)["pop_loss"](torch.tensor(opacities, dtype=torch.float64), torch.tensor(counts))
    assert ours.item() == pytest.approx(oracle_loss(opacities, importance_mask(counts)), rel=1e-12, abs=1e-15)


def test_authors_place_and_version_are_said_once_and_repeated_rightly() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (cited["title"], cited["repository-code"]) == (project["name"], project["urls"]["Repository"])
    for key in ("version", "license", "authors"):
        assert cited[key] == project[key]
    # a file of its own: an archive of pop_ref has no folder above it that a link could lead to
    assert not (ROOT / "pop_ref" / "LICENSE").is_symlink()
    assert (ROOT / "pop_ref" / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()


@pytest.mark.parametrize("folder", ["", "pop_ref"])
def test_every_requirement_has_the_version_it_was_tested_with_and_every_python_is_tested(folder: str) -> None:
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    some = [project["dependencies"], *project["optional-dependencies"].values()]
    named = {re.split(r"[^\w-]", line)[0].lower().replace("_", "-") for lines in some for line in lines}
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").lower().replace("_", "-").splitlines()
    # triton only brings nvdisasm to `make sass`, which no test runs
    assert named - {line.partition("==")[0] for line in pinned} - {"pop-ref", "pop-splatting", "triton"} == set()
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    tested = workflow["jobs"]["versions"]["strategy"]["matrix"]["python"]
    assert re.findall(r":: (3\.\d+)", " ".join(project["classifiers"])) == tested


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.stem)
def test_every_command_of_a_workflow_is_there(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert yaml.safe_load(text)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(re.findall(r"\bmake ([a-z-]+)", text)) <= set(targets)
    assert all((ROOT / script).is_file() for script in re.findall(r"\bbash (\S+)", text))


def test_no_page_on_learning_leads_to_the_source_of_a_chapter() -> None:
    text = (ROOT / "docs" / "learn.md").read_text(encoding="utf-8")
    chapters = list((ROOT / "pop_ref" / "walkthrough").glob("chapter_*.py"))
    assert text.count("](../pop_ref/walkthrough/chapter_") == len(chapters) > 0
    links = site.LINK.findall(site.with_links_of_the_site(text, "docs/learn.md"))
    assert not [target for _, target, _ in links if target.startswith("source/pop_ref/walkthrough")]
    assert not [path for path in site.linked(["docs/learn.md"]) if path.startswith("pop_ref/walkthrough")]


def test_chapters_lead_back_to_the_site_and_have_been_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site, "WALKTHROUGH", tmp_path)
    with pytest.raises(FileNotFoundError, match="run 'make walkthrough' first"):
        site.walkthrough()
    (tmp_path / "notebooks").mkdir()
    for name in ("index.html", "notebooks/index.html"):
        (tmp_path / name).write_text("<body><main><h1>It</h1></main></body>", encoding="utf-8")
    (tmp_path / "book.pdf").write_bytes(b"%PDF-\xff")
    made = site.walkthrough()
    assert b'<main><nav><a href="../index.html">' in made["learn/index.html"]
    assert b'<a href="../../learn.html">Learn</a></nav><h1>It' in made["learn/notebooks/index.html"]
    assert made["learn/book.pdf"] == b"%PDF-\xff"


def test_the_ratios_to_gsplat_on_a_gpu_are_those_of_the_run_that_is_kept():
    kept = ROOT / "benchmarks" / "results" / "gpu"
    both = json.loads((kept / "gsplat.json").read_text(encoding="utf-8"))["cases"]
    ratios = sorted(case["ratios"]["step"] for case in both.values())
    assert f"a training step {ratios[0]:.1f} to {ratios[-1]:.1f} times as fast as gsplat's on one H100" in README
    kernels = json.loads((kept / "kernels.json").read_text(encoding="utf-8"))
    step = kernels["cases"]["270k_1.6MP"]["pixel_parallel"]
    page = " ".join((ROOT / "docs" / "cuda.md").read_text(encoding="utf-8").split())
    assert "H100" in kernels["gpu"]
    ratio = f"{both['270k_1.6MP']['ratios']['step']:.1f} times as fast as gsplat's iteration"
    assert f"takes {step['step_ms']:.2f} ms, {ratio}, and {step['step_with_pop_ms']:.2f} ms with POP's terms" in page
    assert f"The kernels of commit {kernels['commit'][:7]} have run on one NVIDIA H100" in page
    beside = both["270k_1.6MP"]["ours"]["step_ms"]
    assert (
        f"the step took {beside:.2f} ms; with 1,000,000 Gaussians it is {both['1M_1.6MP']['ratios']['step']:.1f}."
        in page
    )
    for job in (1, 2):
        stages = json.loads((kept / f"check_{job}.json").read_text(encoding="utf-8"))["stages"]
        for name in {"smoke", "laws", "laws_of_gaussian_parallel", "steps"} & set(stages):
            assert stages[name]["tests"]["failed"] == 0 < stages[name]["tests"]["passed"]
    # the first of these has two kinds of kernels
    for name, kinds in (("laws", 2), ("laws_of_gaussian_parallel", 1)):
        came = {which: stages[name]["tests"][which] // kinds for which in ("passed", "skipped")}
        assert f"{came['passed']} of the kit's then {sum(came.values())} laws on each" in page
        said = f"passed those {came['passed']} of {sum(came.values())} laws that they can be asked"
        assert said in (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"agree with the CPU's ({stages['steps']['tests']['passed']} tests)" in page
