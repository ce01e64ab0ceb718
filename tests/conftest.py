"""Hypothesis profiles, and shapes checked: under test every annotation of the oracle is held to by beartype."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator

import pytest

# not the innermost loops, where the check costs more than the work, and not the dataclasses, which check themselves
SHAPES_CHECKED = tuple(
    f"pop_ref.{module}"
    for module in (
        *("activations", "covariance", "harmonics", "camera", "projection", "footprint", "tiles", "compositing"),
        *("dominance", "splatting", "render", "losses", "ssim", "polarization", "density", "density_rows"),
        *("loss_magnitudes", "optimizer", "training", "margins", "extent_margins"),
        *("contributions", "sensitivity", "fisher", "chord", "selection", "taming", "mini_splatting", "tight_tiles"),
    )
)
# nor these: called for every pixel, window, basis value or step so far by functions that are checked, they were four
# fifths of all checks, and each took several times what it checked
INNERMOST = (
    *("dominance.dominant_id", "footprint._det", "footprint._inverse", "footprint._reach", "harmonics._basis_one"),
    *("harmonics._basis_gradient_one", "harmonics._n_sh", "harmonics._enough", "margins._Book.touch"),
    *("margins._Book.note", "projection._offset_vjp", "ssim._compare_window", "ssim.gaussian_window"),
    *("tiles.tile_span", "tiles.grid_size", "optimizer.is_updated", "projection._intrinsics", "splatting._scatter"),
    *("margins._note_pixel", "harmonics._unit", "loss_magnitudes._operated", "chord._depth_on_ray"),
    *("chord.chord_midpoint", "chord._ray_direction", "fisher._moments_of", "activations.unit_quats_from_quats"),
    "covariance.rotmats_from_quats",
)
CHECKERS = ("beartype", "jaxtyping")


def _leave_innermost_unchecked() -> None:
    """Take the checks off again; nothing else can be left out of a module that is checked."""
    for path in INNERMOST:
        module, *owners, name = path.split(".")
        owner = functools.reduce(getattr, owners, importlib.import_module(f"pop_ref.{module}"))
        checked = getattr(owner, name)
        # what was imported before the hook came, as where the kit is called from here, is checked nowhere
        plain = getattr(checked, "__wrapped__", checked)
        # also where another module has imported it already
        others = [each for key, each in sys.modules.items() if key.startswith("pop_ref")]
        for each in (owner, *others):
            if vars(each).get(name) is checked:
                setattr(each, name, plain)


# a bare GPU node has neither: there the tests run unchecked, and the summary says so
UNCHECKED = [name for name in CHECKERS if importlib.util.find_spec(name) is None]
if not UNCHECKED:
    from jaxtyping import install_import_hook

    install_import_hook(SHAPES_CHECKED, "beartype.beartype")
    _leave_innermost_unchecked()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say, also under -q, that shapes were not checked."""
    if UNCHECKED:
        terminalreporter.write_line(f"shapes were NOT checked: {' and '.join(UNCHECKED)} not installed")


def pytest_configure() -> None:
    """Choose how many examples are drawn, before any test is collected."""
    # not at the top: the hook above must see pop_ref imported
    from pop_ref.conformance.hypothesis_profiles import load_profile

    load_profile(os.environ.get("HYPOTHESIS_PROFILE", "dev"))


@pytest.fixture(autouse=True)
def _threads_of_torch() -> Iterator[None]:
    """Leave to the next test as many threads as there were: results record them, and a run continues with its own."""
    torch = sys.modules.get("torch")
    before = None if torch is None else torch.get_num_threads()
    yield
    if before is not None and sys.modules["torch"].get_num_threads() != before:
        sys.modules["torch"].set_num_threads(before)
