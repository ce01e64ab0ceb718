"""The pytest plugin: hands every law every backend, and writes down what it saw.

    pytest --pyargs pop_ref.conformance --rasterizer my.module:rasterization --profile gsplat_1_6

Nothing of the kit is imported before an option or a law asks for it: a session that judges nothing pays nothing.
"""

from __future__ import annotations

import json
import os
import re
import time
import traceback
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

import pytest

from pop_ref.conformance.capabilities import SIGNATURE, STAGES
from pop_ref.conformance.files import write_file

LAWS = "pop_ref.conformance.laws"
FAILURES = "conformance_failures"
# the lines of a failure's report that say what differs first (`failure_report`)
DIFFERENCES = re.compile(
    r"^E +((?:first|nearest|no) (?:stage|pixel|Gaussian|gradient|decision|difference|cause)\b.*|saved as .*)$",
    re.MULTILINE,
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the kit's options."""
    group = parser.getgroup("pop conformance", "judge a rasterizer by the oracle (pop_ref.conformance)")
    group.addoption("--rasterizer", metavar="MODULE:FUNCTION", help="a function with gsplat's rasterization signature")
    group.addoption(
        "--adapter",
        metavar="MODULE:CLASS",
        action="append",
        default=[],
        help="a class derived from pop_ref.conformance.Adapter",
    )
    group.addoption(
        "--strategy",
        metavar="MODULE:CLASS",
        action="append",
        default=[],
        help="a density strategy with gsplat's protocol, as gsplat.strategy:DefaultStrategy",
    )
    group.addoption(
        "--program",
        metavar="COMMAND",
        action="append",
        default=[],
        help="a program in any language that answers the protocol of pop_ref.conformance.program_adapter",
    )
    group.addoption(
        "--program-timeout", metavar="SECONDS", type=float, default=60.0, help="for each of its answers, default 60"
    )
    group.addoption("--stages", metavar="PACKAGE", help="a package whose stage modules carry the oracle's names")
    group.addoption(
        "--dtype", choices=["float32", "float64"], help="precision of --rasterizer and --strategy; default float32"
    )
    group.addoption(
        "--device", help="torch device of --rasterizer; by default the CPU, or a GPU where it draws on that alone"
    )
    group.addoption(
        "--unordered-sums",
        action="store_true",
        help="--rasterizer adds in another order on every run, as atomics do: laws of equal bits are skipped",
    )
    group.addoption(
        "--profile", help="constants that --rasterizer implements; default paper, and gsplat's own for gsplat"
    )
    group.addoption("--backend", action="append", default=[], help="judge an adapter that comes with the kit, by name")
    group.addoption(
        "--stage", action="append", default=[], choices=STAGES, help="only the laws of this stage; may be repeated"
    )
    group.addoption("--scorecard", metavar="FILE", help="write a summary by stage, as .json or .html")
    group.addoption(
        "--failures",
        metavar="DIR",
        default=FAILURES,
        help=f"save the scenes of broken laws there, as npz; default {FAILURES}",
    )
    group.addoption("--record-worst", metavar="FILE", help="write the units that each tolerance needed, as JSON")


def pytest_configure(config: pytest.Config) -> None:
    """Rewrite the laws' asserts, choose the number of examples, and start what the options ask for."""
    pytest.register_assert_rewrite(LAWS)
    if _chosen(config):
        from pop_ref.conformance.hypothesis_profiles import load_profile

        try:
            load_profile(os.environ.get("HYPOTHESIS_PROFILE", "dev"))
        except ValueError as error:
            raise pytest.UsageError(str(error)) from error
    if config.getoption("--scorecard"):
        config.pluginmanager.register(_Recorder(config), "pop-conformance-scorecard")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Make the backends that the options name, so that a wrong name is one line and not an error in every file."""
    _chosen_backends(session.config)


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Say what is judged, what is refused or not offered, and what to do next."""
    if not _chosen(config):
        return []
    from pop_ref.conformance.scorecard import introduction

    backends, option = _chosen_backends(config), config.getoption
    of_options = backends[-1] if option("--rasterizer") or option("--stages") else None
    return [line for backend in backends for line in introduction(backend, backend is of_options)]


def _chosen(config: pytest.Config) -> str:
    """Return the names of what the options choose to judge; empty for the oracle."""
    option: Any = config.getoption
    single = option("--rasterizer") or option("--stages")
    several = [each for name in ("--backend", "--adapter", "--strategy", "--program") for each in option(name)]
    return ", ".join([*several, *([single] if single else [])])


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Give the kit's own laws the backends that the options name, or the oracle."""
    if metafunc.module is not None and metafunc.module.__name__.startswith(LAWS):
        parametrize_backends(metafunc, _chosen_backends(metafunc.config))


def parametrize_backends(
    metafunc: pytest.Metafunc, backends: list[Any], marked: Mapping[str, pytest.MarkDecorator] | None = None
) -> None:
    """Run a test that takes `backend` once for each; a law whose needs a backend lacks is skipped by name.

    Args:
        metafunc: of the test.
        backends: adapters.
        marked: a mark of the tests on a backend, by its name.
    """
    from pop_ref.conformance.law import missing

    if "backend" not in metafunc.fixturenames:
        return
    stated = getattr(metafunc.function, "law", None)
    cases = []
    for backend in backends:
        lacks = missing(backend, stated.needs) if stated else []

        reason = getattr(backend, "reason", None) or f"{backend.name} has no {', '.join(_in_words(backend, lacks))}"
        marks = [pytest.mark.skip(reason=reason)] if lacks or hasattr(backend, "reason") else []
        marks += [marked[backend.name]] if marked and backend.name in marked else []
        cases.append(pytest.param(backend, id=backend.name, marks=marks))
    metafunc.parametrize("backend", cases)


def _in_words(backend: Any, lacks: list[str]) -> list[str]:
    """Return what a backend lacks, each with the words in which it refused where it was asked."""
    from pop_ref.conformance.views import ASKED

    refused = {need: backend.why_not(need) for need in lacks if need in ASKED and backend.has(SIGNATURE)}
    return [f"{need} ({words.splitlines()[0]})" if (words := refused.get(need)) else need for need in lacks]


def _chosen_backends(config: pytest.Config) -> list[Any]:
    cached = getattr(config, "_pop_backends", None)
    if cached is None:
        cached = config._pop_backends = _make_backends(config)  # type: ignore[attr-defined]
    return cached


def _require_a_reader(option: Any) -> None:
    """Raise ValueError where an option is given that nothing of what is chosen reads."""
    if option("--rasterizer") or option("--stages"):
        return
    own = ("--profile", "--device", "--unordered-sums", *([] if option("--strategy") else ["--dtype"]))
    unread = [name for name in own if option(name)]
    if unread:
        raise ValueError(f"{unread[0]} is read with --rasterizer; backends, adapters and programs say it themselves")


def _make_backends(config: pytest.Config) -> list[Any]:
    from pop_ref.conformance.backends import (
        Unavailable,
        adapter_for,
        made_by,
        require_a_picture,
        shipped,
        shipped_or_absent,
        strategy_named,
        usual,
    )
    from pop_ref.conformance.program_adapter import ProgramAdapter, ProgramError
    from pop_ref.constants import profile_named

    try:
        option: Any = config.getoption
        dtype = option("--dtype") or "float32"
        _require_a_reader(option)
        chosen = [shipped_or_absent(name) for name in option("--backend")] + [
            made_by(path) for path in option("--adapter")
        ]
        chosen += [strategy_named(path, dtype) for path in option("--strategy")]
        chosen += [ProgramAdapter(command, option("--program-timeout")) for command in option("--program")]
        path, package = option("--rasterizer"), option("--stages")
        if path or package:
            own_profile, own_device = usual(path, dtype) if path else ("paper", "cpu")
            profile = profile_named(option("--profile") or own_profile)
            name, device = path or package, option("--device") or own_device
            # whoever was found to draw on a GPU alone adds by atomics, as far as anybody knows
            ordered = not option("--unordered-sums") and (device == "cpu" or bool(option("--device")))
            chosen.append(adapter_for(path, name, package, dtype, device, profile, ordered))
            require_a_picture(chosen[-1])
    except (Unavailable, ProgramError, ValueError) as error:
        raise pytest.UsageError(str(error)) from error
    return chosen or [shipped("oracle")]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the laws of the stages asked for, and label every law for the scorecard."""
    stages = config.getoption("--stage")
    kept, dropped = [], []
    for item in items:
        stated = getattr(getattr(item, "function", None), "law", None)
        if stated is not None:
            backend = item.callspec.params["backend"].name  # type: ignore[attr-defined]
            item.user_properties.append(("law", (backend, stated.stage, stated.name)))
        (dropped if stages and (stated is None or stated.stage not in stages) else kept).append(item)
    if dropped:
        config.hook.pytest_deselected(items=dropped)
        items[:] = kept


def pytest_collection_finish(session: pytest.Session) -> None:
    """Have the scenes of failing laws saved."""
    folder = session.config.getoption("--failures")
    if folder and _chosen(session.config):
        from pop_ref.conformance.failure_report import failure_saver
        from pop_ref.conformance.law import FAILURE_REPORTS

        FAILURE_REPORTS.append(failure_saver(Path(folder)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Tell of a broken law what its report says, and where its error was raised, unless --tb is given."""
    report = yield
    usual = item.config.getoption("tbstyle") == "auto" and _chosen(item.config)
    if report.failed and call.excinfo is not None and "law" in dict(item.user_properties) and usual:
        report.longrepr = "\n".join(f"E   {line}" for line in _told(call.excinfo.value))
    return report


def _told(error: BaseException) -> list[str]:
    """Return the lines that tell of an error: its words, its notes, and the last lines of code outside the kit."""
    first, *rest = str(error).splitlines() or [""]
    lines = [f"{type(error).__name__}: {first}", *rest]
    cause = error.__cause__ or error
    inside = re.compile(re.escape(str(Path(__file__).parent)) + r"|[/\\](_pytest|pluggy|hypothesis)[/\\]")
    outside = [at for at in traceback.extract_tb(cause.__traceback__) if not inside.search(at.filename)]
    lines += [f"raised at {at.filename}:{at.lineno}: {at.line}" for at in outside[-2:]]
    return [*lines, *(line for note in getattr(error, "__notes__", ()) for line in note.splitlines())]


def _cause(text: str) -> str:
    """Return what a failure's report names as its cause, or what differs first."""
    told = dict(line.split(": ", 1) for line in DIFFERENCES.findall(text) if line.startswith("first "))
    if "first cause" in told:
        return f"{told['first cause']}: {told['first difference']}"
    first = next(iter(told.items()), None)
    return text.splitlines()[0].removeprefix("E").strip() if first is None else ": ".join(first)


def _kind_of(cause: str) -> str:
    """Return what causes of one kind share: the arguments that are needed and the gradient that differs, not where."""
    asked, _, rest = cause.partition(": ") if cause.startswith("with ") else ("", "", cause)
    gradient = re.search(r"\bv_\w+", rest)
    if gradient is None:
        return cause
    return f"{'' if asked == 'with every argument at its default' else asked} {gradient[0]}"


def _law_of(report: Any) -> str:
    return dict(report.user_properties)["law"][2].replace("_", " ")


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Say how many laws hold, and what breaks, each kind of cause once with the laws that it breaks."""
    if not _chosen(config):
        return
    of = {kind: [r for r in terminalreporter.stats.get(kind, ()) if "law" in dict(r.user_properties)]
          for kind in ("passed", "failed", "skipped")}  # fmt: skip
    causes: dict[str, tuple[str, list[str]]] = {}
    for report in of["failed"]:
        cause = _cause(report.longreprtext)
        causes.setdefault(_kind_of(cause), (cause, []))[1].append(_law_of(report))
    terminalreporter.section("conformance")
    counts = f"{len(of['passed'])} laws hold, broken {len(of['failed'])}, not judged {len(of['skipped'])}"
    terminalreporter.write_line(f"{_chosen(config)}: {counts}")
    for cause, laws in sorted(causes.values(), key=lambda pair: -len(pair[1])):
        terminalreporter.write_line(f"  {cause}")
        for name in laws:
            terminalreporter.write_line(f"      breaks: {name}")


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write what the tolerances needed."""
    path = session.config.getoption("--record-worst")
    if path:
        from pop_ref.conformance.tolerances import measured

        needed = {f"{key} {dtype}": units for (key, dtype), units in sorted(measured().items())}
        write_file(Path(path), json.dumps(needed, indent=1) + "\n")


class _Recorder:
    """Collects outcomes and writes the scorecard at the end."""

    def __init__(self, config: pytest.Config) -> None:
        from pop_ref.conformance.scorecard import Scorecard

        option: Any = config.getoption
        self.path = Path(option("--scorecard"))
        if self.path.suffix not in (".json", ".html"):
            raise pytest.UsageError(f"scorecard {self.path} must end in .json or .html")
        try:
            # what cannot be written is told before the laws run, not after
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.open("a").close()
        except OSError as error:
            raise pytest.UsageError(f"scorecard {self.path} cannot be written: {error.strerror}") from error
        single = option("--rasterizer") or option("--stages")
        profile = getattr(_chosen_backends(config)[-1], "profile", None) if single else None
        how = f", {option('--dtype') or 'float32'}, profile {profile.name if profile else 'any'}" if single else ""
        self.card = Scorecard(f"{_chosen(config) or 'oracle'}{how}")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        from pop_ref.conformance.scorecard import Entry

        named: Any = dict(report.user_properties).get("law")
        if named is None or not (report.when == "call" or report.skipped or report.failed):
            return
        detail, differences = "", ()
        if report.skipped and isinstance(report.longrepr, tuple):
            detail = str(report.longrepr[2]).removeprefix("Skipped: ")
        elif report.failed:
            crash = getattr(report.longrepr, "reprcrash", None)
            detail = str(crash.message if crash else report.longrepr).splitlines()[0].removeprefix("E   ")
            differences = tuple(DIFFERENCES.findall(report.longreprtext))
        more: dict[str, Any] = dict(report.user_properties)
        backend, stage, law = named
        outcome, cpu = ("crashed" if "crash" in more else report.outcome), more.get("cpu", 0.0)
        self.card.entries.append(Entry(backend, stage, law, outcome, detail, report.duration, differences, cpu))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, Any, Any]:
        from pop_ref.conformance.law import is_crash

        start = time.process_time()
        try:
            return (yield)
        except Exception as error:
            # an error of the rasterizer's own is no comparison that failed
            if is_crash(error):
                item.user_properties.append(("crash", True))
            raise
        finally:
            item.user_properties.append(("cpu", time.process_time() - start))

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        from pop_ref.conformance.pairs import judged_pairs
        from pop_ref.conformance.scorecard import surface_of

        judged = _chosen_backends(session.config)
        self.card.surfaces = {backend.name: surface_of(backend) for backend in judged}
        self.card.pairs = {backend.name: pairs for backend in judged if (pairs := judged_pairs(backend))}
        self.card.write(self.path)
