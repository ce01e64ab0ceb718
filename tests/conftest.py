"""Hypothesis profiles, and shapes checked: under test beartype holds the oracle to its annotations of arrays."""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

# before torch is imported, here and in children: workers share the cores, and threads that wait for each other would
# spin on them (a training on two threads took five times as much of the processor)
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# not `alpha` and `pixel`, where to count calls costs as much as the work
SHAPES_CHECKED = tuple(
    f"pop_ref.{module}"
    for module in (
        *("activations", "covariance", "harmonics", "camera", "projection", "footprint", "tiles", "compositing"),
        *("dominance", "splatting", "render", "losses", "ssim", "polarization", "density", "density_rows"),
        *("magnitudes", "optimizer", "training", "margins"),
        *("contributions", "sensitivity", "fisher", "chord", "selection", "taming", "mini_splatting", "tight_tiles"),
    )
)
# of a function's calls in a test the first ones are checked, and then one in so many: what is called for every pixel is
# called in the same way, and each check took several times what it checked
CHECKED_FIRST, CHECKED_THEN = 4, 16
CHECKERS = ("beartype", "jaxtyping")
_calls: list[list[int]] = []


def _sampled(check: Callable[..., Any], **options: Any) -> Callable[[Any], Any]:
    """Make the decorator that jaxtyping's import hook puts on all functions and dataclasses of a module."""

    def decorate(plain: Any) -> Any:
        if isinstance(plain, type):
            return check(**options)(plain)
        # mypy sees to the others; those of single numbers are called millions of times
        if not any("np.ndarray" in str(hint) for hint in plain.__annotations__.values()):
            return plain
        checked = check(**options)(plain)
        calls = [0]
        _calls.append(calls)

        @functools.wraps(plain)
        def call(*args: Any, **kwargs: Any) -> Any:
            n = calls[0]
            calls[0] = n + 1
            return (checked if n < CHECKED_FIRST or n % CHECKED_THEN == 0 else plain)(*args, **kwargs)

        return call

    return decorate


# a bare GPU node has neither: there the tests run unchecked, and the summary says so
UNCHECKED = [name for name in CHECKERS if importlib.util.find_spec(name) is None]
if not UNCHECKED:
    import jaxtyping

    # the modules that the hook changes look the decorator up by this name
    jaxtyping.jaxtyped = functools.partial(_sampled, jaxtyping.jaxtyped)
    jaxtyping.install_import_hook(SHAPES_CHECKED, "beartype.beartype")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say, also under -q, that shapes were not checked."""
    if UNCHECKED:
        terminalreporter.write_line(f"shapes were NOT checked: {' and '.join(UNCHECKED)} not installed")


def pytest_configure() -> None:
    """Choose how many examples are drawn, before any test is collected."""
    # not at the top: the hook above must see pop_ref imported
    from pop_ref.conformance.hypothesis_profiles import load_profile

    load_profile(os.environ.get("HYPOTHESIS_PROFILE", "dev"))


@pytest.fixture(scope="session")
def made_once(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, Callable[[Path], object]], Path]:
    """`made_once(name, make)` is a folder that tests only read, filled by `make(folder)` once for all workers."""
    import fcntl  # not at the top: Windows has none, and runs the tests that ask for nothing shared

    base = tmp_path_factory.getbasetemp()
    # a worker of xdist has a folder of its own in that of the session; a session within a worker shares nothing
    shared = base.parent if hasattr(request.config, "workerinput") else base

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder = shared / f"once-{name}"
        with (shared / f"once-{name}.lock").open("a+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            lock.seek(0)
            if lock.read() != "made":
                # of a worker that failed in it
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                lock.write("made")
        return folder

    return made


@pytest.fixture(autouse=True)
def _shapes_are_checked_anew() -> None:
    for calls in _calls:
        calls[0] = 0


@pytest.fixture(autouse=True)
def _threads_of_torch() -> Iterator[None]:
    """Leave to the next test as many threads as there were: results record them, and a run continues with its own."""
    torch = sys.modules.get("torch")
    before = None if torch is None else torch.get_num_threads()
    yield
    if before is not None and sys.modules["torch"].get_num_threads() != before:
        sys.modules["torch"].set_num_threads(before)


@pytest.fixture(params=["fast", "compiled", "native"])
def engine(request: pytest.FixtureRequest) -> Any:
    """Return what takes a run's steps on the CPU, or skip with the reason why it cannot here."""
    from pop_fast.train.engines import torch_engine, whole_engine
    from tests.app.tiny import skip_without

    skip_without("fast" if request.param == "fast" else "compiled")
    return whole_engine() if request.param == "native" else torch_engine(request.param)


@pytest.fixture
def one_thread(_threads_of_torch: None) -> None:
    import torch

    torch.set_num_threads(1)
