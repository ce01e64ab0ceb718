"""What laws reach is logged as it runs, and every line that is left has a reason."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.law_coverage import LIMITS, MODULES, PACKAGE, Log, Logged, code_lines, reason
from pop_ref.conformance.pairs import accepted, call_of, covering_rows
from pop_ref.conformance.scenes import golden_scene
from pop_ref.losses import l2

ROOT = Path(__file__).parents[2]
KEPT = json.loads((ROOT / "benchmarks" / "results" / "law_coverage.json").read_text(encoding="utf-8"))


def test_lines_that_run_are_logged_and_no_others() -> None:
    with Log() as log:
        l2(np.zeros((2, 2, 3)), np.ones((2, 2, 3)))
    of = {name: {n for n, function, _ in code_lines("losses.py") if function == name} for name in ("l2", "l1")}
    # the line that a mask would take is not among them
    assert log.lines["losses.py"] & of["l2"]
    assert not log.lines["losses.py"] & of["l1"]


def test_arguments_of_what_is_drawn_are_logged() -> None:
    log, scene = Log(), golden_scene()
    Logged(OracleAdapter(), log).render(scene)
    assert log.ranges["Gaussians"] == (len(scene.gaussians),) * 2
    assert log.ranges["width, px"] == (scene.camera.width,) * 2
    assert log.ranges["opacity"] == (scene.gaussians.opacities.min(), scene.gaussians.opacities.max())
    assert log.choices["antialiased"] == {str(scene.antialiased)}


def test_what_is_asked_by_pairs_of_arguments_is_logged() -> None:
    log, backend = Log(), OracleAdapter()
    row = covering_rows(accepted(backend).levels)[0]
    call = call_of(Logged(backend, log), row, 0)
    Logged(backend, log).call(call)
    assert log.ranges["cameras"] == (len(call.frames[0]),) * 2
    # whom nobody wraps is asked the same
    assert call_of(backend, row, 0) == call


def test_every_line_that_no_law_reaches_refuses_arguments_or_has_a_reason() -> None:
    assert set(KEPT["modules"]) == {f"{name}.py" for name in MODULES if (PACKAGE / f"{name}.py").exists()}
    for file, found in KEPT["modules"].items():
        for function, text in found["unreached"]:
            refuses = text.startswith(("raise ", 'f"'))
            assert refuses or reason(file, function), f"{file}: {function}: {text}"
    assert KEPT["ranges"].keys() == LIMITS.keys()
