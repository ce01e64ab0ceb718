"""Compiling the CPU kernels, and what there is without it."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cuda_ext.toolkit import find_compiler
from pop_fast import compiled
from pop_fast.api.backend import get_backend
from pop_fast.cli.doctor import backends
from pop_fast.compiled import build as building
from pop_fast.compiled.library import open_library
from pop_fast.errors import PopError
from pop_fast.train.choose import choose_backend
from pop_fast.train.engines import renderer
from tests.app.conftest import Pop
from tests.app.damage import says
from tests.app.tiny import tiny_config

NO_GPU = "there is no GPU in this test"
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="there is no C++ compiler")


# a compiler that remembers: ten seconds for each of a dozen builds of the same sources would show nothing more. All are
# of code for any processor; that for this machine's is what every other test runs
REMEMBERING = """#!{python} -IS
import hashlib, os, shutil, subprocess, sys

words = [word for word in sys.argv[1:] if not word.startswith("-m")]
at = words.index("-o") + 1
units = [word for word in words if word.endswith(".cpp")]
folder = os.path.dirname(units[0])
asked = [word for word in words if word not in units and word != words[at]]
key = hashlib.sha256(repr((asked, list(map(os.path.basename, units)))).encode())
for name in sorted(os.listdir(folder)):
    if name.endswith((".h", ".cpp")):
        key.update(name.encode())
        key.update(open(os.path.join(folder, name), "rb").read())
kept = os.path.join({kept!r}, key.hexdigest())
if not os.path.exists(kept):
    status = subprocess.run([*{real!r}, *words]).returncode
    if status:
        sys.exit(status)
    beside = kept + "." + str(os.getpid())
    shutil.copyfile(words[at], beside)
    os.replace(beside, kept)
shutil.copyfile(kept, words[at])
"""


@pytest.fixture(scope="session")
def remembering(made_once: Callable[..., Path]) -> str | None:
    """Return a command that compiles as the compiler of this machine, the same sources once; None without one."""
    real = find_compiler()
    if real is None:
        return None

    def make(folder: Path) -> None:
        program = folder / "remembering"
        program.write_text(REMEMBERING.format(python=sys.executable, kept=str(folder), real=real))
        program.chmod(0o755)

    return str(made_once("remembered", make) / "remembering")


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, remembering: str | None) -> Path:
    """A package whose blend was never compiled."""
    if remembering is not None:
        monkeypatch.setenv("CXX", remembering)
    for name in building.SOURCES:
        (tmp_path / name).write_bytes((building.HERE / name).read_bytes())
    monkeypatch.setattr(building, "HERE", tmp_path)
    # what is compiled here is loaded and run once: optimising it would take most of these tests' time
    monkeypatch.setattr(building, "FLAGS", tuple("-O0" if flag == "-O3" else flag for flag in building.FLAGS))
    building.library_path.cache_clear()
    yield tmp_path
    building.library_path.cache_clear()


@pytest.fixture(autouse=True)
def _without_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cuda_ext.why_not", lambda: NO_GPU)
    monkeypatch.setattr("pop_fast.train.choose.has_gpu", lambda: True)


def compiler(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a program in the compiler's place."""
    path = folder / "compiler"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("CXX", str(path))


@pytest.mark.slow  # it compiles the kernels
@needs_compiler
def test_it_is_compiled_once_and_older_versions_go(fresh: Path, pop: Pop) -> None:
    assert "run `pop build-cpu`" in (compiled.why_not() or "")
    older = building.library_path().name.split("_")
    older[2] = "0123456789abcdef"
    (fresh / "_".join(older)).write_bytes(b"of an older version")
    outcome = pop("build-cpu")
    (library,) = fresh.glob("*.so")
    assert (outcome.status, outcome.out) == (0, f"{library}\n")
    assert compiled.available()
    made = library.stat().st_mtime_ns
    assert pop("build-cpu").status == 0
    assert library.stat().st_mtime_ns == made


@pytest.mark.slow  # it compiles the kernels
@needs_compiler
def test_a_run_that_has_it_loaded_goes_on_when_an_update_removes_it(fresh: Path, pop: Pop) -> None:
    assert pop("build-cpu").status == 0
    for library in fresh.glob("*.so"):
        library.unlink()
    assert compiled.available()
    assert get_backend("compiled").why_not() is None


@needs_compiler
def test_a_change_of_the_source_asks_for_a_new_build(fresh: Path) -> None:
    before = building.library_path()
    with (fresh / "lanes.h").open("a") as file:
        file.write("// changed\n")
    building.library_path.cache_clear()
    assert building.library_path() != before


@needs_compiler
def test_another_processor_asks_for_a_new_build_and_leaves_the_first_ones(
    fresh: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = building.build()
    monkeypatch.setattr(building, "processor_features", lambda: "another one")
    building.library_path.cache_clear()
    assert building.library_path() != before
    assert not compiled.available()
    assert building.build() != before
    assert before.exists()


@needs_compiler
def test_a_processor_that_nothing_is_known_of_gets_code_for_any(
    fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(building, "processor_features", lambda: None)
    building.library_path.cache_clear()
    outcome = pop.done("build-cpu", "--verbose")
    assert "=native" not in outcome.out
    assert compiled.available()


V2 = "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3"
V3 = f"{V2} avx avx2 bmi1 bmi2 f16c fma abm movbe"
V4 = f"{V3} avx512f avx512bw avx512cd avx512dq avx512vl"


@pytest.mark.parametrize(
    ("machine", "features", "levels"),
    [
        ("x86_64", V4, ["x86-64-v4", "x86-64-v3", "x86-64-v2"]),
        ("x86_64", V4.replace(" avx512dq", ""), ["x86-64-v3", "x86-64-v2"]),
        ("x86_64", V2, ["x86-64-v2"]),
        ("x86_64", V4.replace("popcnt ", ""), []),
        ("aarch64", "fp asimd evtstrm", ["armv8-a"]),
        ("riscv64", "fp asimd", []),
    ],
)
def test_a_wheel_brings_the_highest_level_that_the_processor_has(
    fresh: Path, monkeypatch: pytest.MonkeyPatch, machine: str, features: str, levels: list[str]
) -> None:
    monkeypatch.setattr(building.platform, "machine", lambda: machine)
    monkeypatch.setattr(building, "processor_features", lambda: f"{machine} flags : fpu {features}")
    assert building.supported_levels() == levels
    names = [level for of_machine in building.LEVELS.values() for level, _ in of_machine]
    for name in names:
        (fresh / building.level_name(name)).write_bytes(b"of a wheel")
    for level in levels:
        building.library_path.cache_clear()
        assert building.library_path() == fresh / building.level_name(level)
        building.library_path().unlink()
    # without any that runs here, and where one was compiled here, it is that one's place
    building.library_path.cache_clear()
    assert building.library_path() == building.native_path()


def test_what_was_compiled_here_goes_before_what_a_wheel_brought(fresh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(building, "processor_features", lambda: f"x86_64 flags : {V4}")
    for path in (fresh / building.level_name("x86-64-v4"), building.native_path()):
        path.write_bytes(b"a library")
    building.library_path.cache_clear()
    assert building.library_path() == building.native_path()


@needs_compiler
def test_a_library_that_no_longer_loads_is_compiled_again(fresh: Path, pop: Pop) -> None:
    building.library_path().write_bytes(b"of a system that is gone")
    assert "compile them again: `pop build-cpu`" in (compiled.why_not() or "")
    assert pop("build-cpu").status == 0
    assert compiled.available()


@needs_compiler
def test_the_compiler_that_is_asked_for_is_the_one_that_runs(
    fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch, remembering: str
) -> None:
    monkeypatch.setenv("CXX", "clang++-of-tomorrow")
    outcome = pop("build-cpu")
    says(outcome, "CXX is 'clang++-of-tomorrow', which is not on this machine")
    monkeypatch.setenv("CXX", f"env {remembering}")
    outcome = pop.done("build-cpu", "--verbose")
    assert outcome.out.split()[0].endswith("/env")


def test_a_compiler_that_does_not_run_is_named(fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch) -> None:
    junk = fresh / "junk"
    junk.write_bytes(bytes(64))
    junk.chmod(0o755)
    monkeypatch.setenv("CXX", str(junk))
    says(pop("build-cpu"), str(junk))
    assert not list(fresh.glob("*.so"))


def test_without_a_compiler_it_says_which_to_install(
    fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(building, "find_compiler", lambda: None)
    outcome = pop("build-cpu")
    assert outcome.status == 2
    assert outcome.err == "pop: error: no C++ compiler was found; install g++ or clang++, or set CXX to one's path\n"
    # as `make setup` calls it, where it may be missing
    monkeypatch.setattr("sys.argv", ["build", "--if-possible"])
    assert building.main() == 0
    assert "backend fast stands in: no C++ compiler was found" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", ["build"])
    assert building.main() == 1


def test_a_compiler_that_fails_is_quoted_and_leaves_nothing(
    fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler(fresh, "echo 'lanes.h:1: error: no such vectors' >&2; exit 1", monkeypatch)
    outcome = pop("build-cpu")
    says(outcome, "compiling the CPU kernels failed")
    assert "error: no such vectors" in outcome.out
    assert not list(fresh.glob("*.so"))


@needs_compiler
def test_a_compiler_that_does_not_know_the_processor_makes_code_for_any(
    fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = " ".join(find_compiler() or [])
    compiler(fresh, f'case "$*" in *=native*) echo "unknown value" >&2; exit 1;; esac; exec {real} "$@"', monkeypatch)
    outcome = pop.done("build-cpu", "--verbose")
    assert [line.count("=native") for line in outcome.out.splitlines()] == [1, 1, 1, 0, 0]
    assert compiled.available()


def test_a_library_that_does_not_load_is_a_sentence(fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler(fresh, 'while [ "$1" != "-o" ]; do shift; done; echo "no library" > "$2"', monkeypatch)
    says(pop("build-cpu"), "the compiled CPU kernels do not load")
    with pytest.raises(PopError, match="backend 'compiled' cannot run: the compiled CPU kernels do not load"):
        get_backend("compiled").rasterization()


@needs_compiler
def test_a_folder_that_cannot_be_written_to_is_named(fresh: Path, pop: Pop, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> tuple[int, str]:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(building.tempfile, "mkstemp", refuse)
    says(pop("build-cpu"), f"{fresh} cannot be written to (Permission denied); install the package for yourself")


def test_a_library_of_another_layout_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    if not compiled.available():
        pytest.skip(compiled.why_not() or "")
    monkeypatch.setattr("pop_fast.compiled.library.ctypes.sizeof", lambda _: 8)
    with pytest.raises(OSError, match="arguments of another layout"):
        open_library.__wrapped__(str(building.library_path()))


def test_auto_takes_it_where_it_is_and_says_how_to_get_it_where_it_is_not(
    fresh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen, line = choose_backend(tiny_config(tmp_path, backend="auto"))
    assert chosen.backend == "fast"
    assert line.startswith("backend fast (CPU): the CPU kernels are not compiled")
    assert line.endswith(f"run `pop build-cpu`; {NO_GPU}")
    (finding,) = (found for found in backends() if found.name == "backend compiled")
    assert finding.state == "off"
    assert "`pop build-cpu`" in finding.found
    monkeypatch.setattr("pop_fast.compiled.why_not", lambda: None)
    chosen, line = choose_backend(tiny_config(tmp_path, backend="auto"))
    assert (chosen.backend, line) == ("compiled", f"backend compiled (CPU): {NO_GPU}")


def test_results_trained_with_it_are_drawn_without_it(fresh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawing, note = renderer("compiled")
    assert drawing.name == "fast"
    assert note is not None
    assert note.startswith("backend 'fast' stands in for 'compiled': the CPU kernels are not compiled")
    monkeypatch.setattr("pop_fast.compiled.why_not", lambda: None)
    assert (renderer("compiled")[0].name, renderer("compiled")[1]) == ("compiled", None)
    assert (renderer("auto")[0].name, renderer("auto")[1]) == ("compiled", None)
    assert renderer("cuda")[1] == f"backend 'compiled' stands in for 'cuda': {NO_GPU}"
