"""`benchmarks/`: tables from results, floors of training steps from counts, busy processes that end, pairs of runs."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import json
import math
import os
import re
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import conditions, estimates, sizes
from benchmarks.few_photographs import left_of, table_of
from benchmarks.record import read_json, write_json
from paper_repro.results import read_all
from paper_repro.scenes import SCENES
from pop_fast import compiled
from pop_fast.io.heartbeat import duration
from pop_fast.train import TrainConfig, automatic
from pop_fast.train.automatic import Choice
from pop_fast.train.presets import QUICK_RATES, QUICK_SCALER
from tests.app.conftest import ROOT
from tests.app.tiny import tiny_capture

BENCHMARKS = ROOT / "benchmarks"
PARTS = ("project", "list", "blend", "loss", "image_gradient", "transpose", "update")
COUNTS = {"visible": 90, "entries": 640, "walked": 600, "chunks": 40, "pairs": 4096, "marked": 128, "reached": 64}


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import a module of benchmarks/, and forget all of them afterwards: their names are plain words."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module
    for name in {path.stem for path in BENCHMARKS.glob("*.py")} - before:
        sys.modules.pop(name, None)


def case(name: str, **changed: Any) -> dict[str, Any]:
    ms = {"fast": 90.0, "compiled": 30.0, "native": 12.25, "native, 1 thread": 22.0}
    size = {"width": 64, "height": 32, "degree": 3, "num_gaussians": 100, "threads": 2, "target_ms": 12.0}
    return {
        "name": name,
        **size,
        "ms": {engine: {"median": value, "minimum": value - 1.0} for engine, value in ms.items()},
        "ratios": {"compiled / fast": 0.33, "native / compiled": 0.41, "efficiency": 0.9},
        "parts_ms": dict.fromkeys(PARTS, 1.5),
        "counts": dict(COUNTS),
        "working_mib": 15.0,
        "parts": {part: {"ms": 1.5, "floor_ms": 0.5, "bound": "bytes", "ratio": 3.0} for part in PARTS},
        **changed,
    }


def results() -> dict[str, Any]:
    beside = {"alone_ms": 10.0, "beside_ms": 60.0, "of_fair_share": 1.2}
    memory = {"width": 64, "height": 32, "n": 100, "before_gib": 0.5, "peak_gib": 0.75}
    busy = {"name": "64x32-100", "processes": 8, "threads": 2, "cores": 2, "fair_factor": 5.0}
    commands = {"pop --help": {"wall_s": 0.2, "cpu_s": 0.1}}
    first_step = {"capture": "fox", "factor": 4, "wall_s": 1.75, "step_s": 0.02}
    even = {"1": {"even share": 12.0, "handing over": 0.0}, "16": {"even share": 0.75, "handing over": 0.25}}
    return {
        "steps": {
            "peak": {"threads": 2, "vector_ops_per_s": 16e9, "bytes_per_s": 40e9},
            "cases": [case("64x32-100"), case("fox", degree=0, target_ms=None)],
        },
        "busy": [{**busy, "engines": {"compiled": beside, "native": beside}}],
        "first-step": {"repeats": 5, "commands": commands, "first_step": first_step},
        "cores": [{"name": "64x32-100", "num_gaussians": 100, "width": 64, "height": 32, "machines": even}],
        "memory": [
            {"what": "render", "by": "fast", **memory},
            {"what": "step", "by": "native", "working_gib": 0.25, **memory},
        ],
    }


def test_notes_hold_the_tables_of_the_results_and_the_curves_of_preset_quick(script: Any) -> None:
    assert script("results_table").main(["--check"]) == 0, "run 'python benchmarks/results_table.py --write'"
    assert script("quick_curve").main(["--json", str(BENCHMARKS / "results" / "quick.json"), "--check"]) == 0


def test_the_notes_and_the_page_of_speed_tell_in_words_what_their_tables_hold() -> None:
    timed = read_json(BENCHMARKS / "results" / "cpu.json")
    blends = [blend for case in timed["raster"] for blend in case["blend"]]
    pairs, ratios = (
        [blend[of][name] for blend in blends]
        for of, name in (("forward_backward_ns_per_pair", "fast"), ("forward_backward_ms", "compiled / fast"))
    )
    notes, speed = ((ROOT / page).read_text(encoding="utf-8") for page in ("benchmarks/NOTES.md", "docs/speed.md"))
    assert f"takes {min(pairs):.1f} to {max(pairs):.1f} ns per pair" in notes
    assert f"with {timed['machine']['capability']}; the target was 3" in notes
    assert f"compiled stages take {min(ratios):.2f} to {max(ratios):.2f} of its time" in notes
    targets = [case for case in timed["steps"]["cases"] if case["target_ms"] is not None]
    missed = [100.0 * (case["ms"]["native"]["median"] / case["target_ms"] - 1.0) for case in targets]
    assert f"the step misses all of them, by {min(missed):.0f} to {max(missed):.0f} %" in notes
    *others, bonsai = sorted(float(time) for time in re.findall(r"^\| .* dB \(.*\| (0\.\d\d) \| 0\.\d\d", notes, re.M))
    assert f"the time is {others[0]:.2f} to {others[-1]:.2f}, but {bonsai:.2f} on bonsai" in notes
    *lower, _ = sorted(float(by) for by in re.findall(r"^\| .* dB \(.*\| ([+-]0\.\d{3}) \| 0\.", notes, re.M))
    assert f"SSIM is {-lower[-1]:.3f} to {-lower[0]:.3f} lower on bear, bonsai and garden" in notes
    found = {
        name: [case["engines"][name]["of_fair_share"] for case in timed["busy"]] for name in ("native", "compiled")
    }
    assert f"a native step takes {min(found['native']):.2f} to {max(found['native']):.2f} times its fair share" in speed
    assert f"takes {min(found['compiled']):.1f} to {max(found['compiled']):.1f} times that share" in " ".join(
        speed.split()
    )
    engine = (path for path in (ROOT / "pop_fast" / "compiled").iterdir() if path.suffix in (".cpp", ".h"))
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in engine)
    assert f"(`pop_fast/compiled`, {round(lines, -2):,} lines, no dependency)" in speed
    first = timed["first-step"]
    helped, doctor = (first["commands"][f"pop {name}"]["wall_s"] for name in ("train --help", "doctor"))
    said = f"on fox takes {first['first_step']['wall_s']:.1f} s; `pop train --help` takes {helped:.1f} s and"
    assert f"{said} `pop doctor` {doctor:.1f} s" in speed


def test_every_table_says_what_was_measured_and_what_was_not(script: Any) -> None:
    tables, text = script("results_table"), (BENCHMARKS / "NOTES.md").read_text()
    assert tables.with_tables(text, {}).count(tables.NOT_YET) == len(tables.TABLES)
    notes = tables.with_tables(text, results())
    assert tables.NOT_YET not in notes
    for row in (
        "| fox, bands to 0, 64x32, 100 Gaussians |  | 12.2 ms | 22.0 ms | 0.90 | 15 MiB |",
        "| update | 1.50 (0.50b, 3.0) | 1.50 (0.50b, 3.0) |",
        "| all | 10.50 (3.50, 3.0) | 10.50 (3.50, 3.0) |",
        "| of these in strips that are blended, that change | 50%, 25% | 50%, 25% |",
        "| 64x32, 100 Gaussians | 16 | 1.00 | 12.0 | 0.75 | 0.25 |",
        "| 64x32-100 | `compiled`, native | 10.0 ms | 60.0 ms | 1.20 |",
        "| `pop train fox --factor 4 --preset quick`, to its first step | 1.75 |  |",
        "| two training steps, 64x32, 100 Gaussians | `compiled`, native | 0.50 GiB | 0.75 GiB | 0.25 GiB |",
    ):
        assert row in notes, row


def test_the_readme_takes_the_steps_with_the_renders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS.parent / "docs"))
    tables, path = importlib.import_module("tables"), tmp_path / "cpu.json"
    monkeypatch.setattr(tables, "CPU_TIMES", path)
    timed = json.loads((BENCHMARKS / "results" / "cpu.json").read_text())
    path.write_text(json.dumps(timed | {"steps": results()["steps"]}))
    assert "| 64x32, 100 Gaussians | 90 ms | 30 ms | 12.2 ms (11.2) | 0.41 |" in tables.speed()


def test_floors_follow_the_counts_and_the_machine(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = script("parts")
    monkeypatch.setattr(parts, "vector_ops_per_s", lambda threads: 2e7 * threads)
    monkeypatch.setattr(parts, "bytes_per_s", lambda moved, threads: 1e9)
    row = case("64x32-100")
    found = parts.floors(row)
    assert set(found) == set(PARTS)
    assert found["list"]["bound"] == "bytes"
    # 128 strips of 28 operations, 40 chunks of 346 and 8 a number of the picture, by two threads
    assert found["blend"]["bound"] == "operations"
    assert found["blend"]["floor_ms"] == pytest.approx((128 * 28 + 40 * 346 + 8 * 3 * 64 * 32 / 16) / 4e4)
    assert found["blend"]["ratio"] == pytest.approx(1.5 / found["blend"]["floor_ms"])
    # eight more strips change a pixel, of 37 operations
    more = parts.floors({**row, "counts": {**COUNTS, "reached": 72}})
    assert more["transpose"]["floor_ms"] - found["transpose"]["floor_ms"] == pytest.approx(8 * 37 / 4e4)
    # one band has fewer numbers than four
    assert parts.works({**row, "degree": 0})["update"].bytes < parts.works(row)["update"].bytes
    # peaks that a step surpasses are no peaks: the projection of this case alone would need 3.68 ms
    monkeypatch.setattr(parts, "vector_ops_per_s", lambda threads: 5e5 * threads)
    monkeypatch.setattr(parts, "bytes_per_s", lambda moved, threads: 1e12)
    too_little = r"project took 1.50 ms, and operations alone need .*: peak.cpp measures too little"
    with pytest.raises(SystemExit, match=too_little):
        parts.floors(row)


def test_steps_on_more_cores_are_simulated_from_what_their_parts_take(script: Any) -> None:
    cores = script("parts")
    timed = [cores.Timed(0.001, [0.004, 0.004, 0.004, 0.012])]
    assert cores.last_one_done(timed[0].parts, 1) == pytest.approx(0.024)
    # by two threads: 4 + 4 ms and 4 ms, and the second one takes the last part too
    assert cores.last_one_done(timed[0].parts, 2) == pytest.approx(0.016)
    assert cores.last_one_done(timed[0].parts, 9) == pytest.approx(0.012)
    step = [timed[0]] * len(cores.PART_OF)
    moved = dict.fromkeys(PARTS, 0.0)
    found = cores.simulated(step, 2, moved, None)
    assert sum(found.values()) == pytest.approx(1e3 * (13 * (0.001 + 0.016) + 13 * cores.HANDOVER))
    assert found["uneven parts"] == pytest.approx(1e3 * 13 * (0.016 - 0.012))
    # 1 GB in a second is more than the 32 ms of both works of the update
    slow = cores.simulated(step, 2, {**moved, "update": 1e9}, 1e9)
    assert slow["memory"] == pytest.approx(1e3 * (1.0 - 0.032))
    assert cores.simulated(step, 1, moved, None)["handing over"] == 0.0


@pytest.mark.skipif(bool(compiled.why_not()), reason=compiled.why_not() or "")
def test_a_traced_step_is_the_step_and_its_parts_are_those_that_are_booked(script: Any, tmp_path: Path) -> None:
    cores, cases = script("parts"), script("cases")
    tiny = cases.Case("64x32-300", 300, 64, 32)
    runs = [script("steps").run_of_case(tiny, str(tmp_path / name), "native") for name in ("run", "traced")]
    for training in runs:
        training.take_steps(1)
    trainers = [training.stepper.fused for training in runs]
    phase = cores.phase_at(runs[0].config, runs[0].strategy, 1)
    trainers[0].run(4, phase)
    before = trainers[1].seconds
    steps = list(cores.steps_of(trainers[1].traced(4, phase).tolist()))
    assert len(steps) == 3
    for name, tensor in trainers[0].params.items():
        assert torch.equal(trainers[1].params[name], tensor), name
    for part in PARTS:
        of_part = [
            sum(work.parts) for step in steps for name, work in zip(cores.PART_OF, step, strict=True) if name == part
        ]
        booked = trainers[1].seconds[part] - before[part]
        # what is booked has the time between two works too
        assert 0.0 < sum(of_part) <= booked, part
    assert len(list(cores.steps_of(trainers[1].traced(5, phase).tolist()))) == 1
    # and no longer
    assert len(trainers[1].traced(5, phase)) == 0


def test_the_peaks_of_this_machine_are_measured(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    peak = script("parts")
    if peak.find_compiler() is None:
        pytest.skip(peak.no_compiler())
    monkeypatch.setattr(peak, "ROUNDS", 1000)
    monkeypatch.setattr(peak, "MOVED", 1 << 20)
    # it is a rate, whatever else the machine does meanwhile
    assert 0.0 < peak.vector_ops_per_s(1) < 1e12
    assert 0.0 < peak.bytes_per_s(1 << 20, 2) < 1e13


def counting() -> int:
    """Count the busy processes that this one has started, those that ended but were not asked about too."""
    shown = subprocess.run(["ps", "-o", "args=", "--ppid", str(os.getpid())], capture_output=True, text=True)
    return len(re.findall("getppid", shown.stdout))


def test_busy_processes_end_with_their_block_and_with_who_started_them(script, monkeypatch):
    busy = script("processes")
    alone = subprocess.Popen([sys.executable, "-S", "-c", busy.LOOP, "0"])
    try:
        assert alone.wait(timeout=60) == 0
    finally:
        alone.kill()
    monkeypatch.setattr(busy.time, "sleep", lambda _: None)

    def interrupted() -> None:
        with busy.busy_processes(2):
            assert counting() > 0
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert counting() == 0
    # a fair share is that of all who want a core
    assert (busy.fair_factor(2, 2), busy.fair_factor(1, 16)) == (5.0, 1.0)


def test_nothing_is_timed_where_a_gradient_is_no_number(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = script("steps")
    exact = steps.render_vjp

    def broken(*arguments: Any) -> Any:
        v = exact(*arguments)
        return replace(v, quats=np.full_like(v.quats, np.nan))

    monkeypatch.setattr(steps, "backends", lambda: ("fast",))
    assert set(steps.gate()) == {"fast torch.float64", "fast torch.float32"}
    monkeypatch.setattr(steps, "render_vjp", broken)
    with pytest.raises(SystemExit, match="differs from the oracle by nan"):
        steps.gate()


def test_turns_change_order_and_keep_what_counts(script: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    timing, log = script("cases"), []
    clock = iter(range(1000))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    found = timing.turns({"a": lambda: log.append("a"), "b": lambda: log.append("b")}, repeats=2, warm_up=1)
    assert log == ["b", "a", "a", "b", "b", "a"]
    assert found == {"a": [1.0, 1.0], "b": [1.0, 1.0]}


# `benchmarks/ab_benchmark.py`: ratios come from pairs of runs, and nothing is timed where the images differ.


@pytest.fixture(scope="module")
def ab_benchmark():
    spec = importlib.util.spec_from_file_location("ab_benchmark", BENCHMARKS / "ab_benchmark.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def timed(seconds, log, image=None):
    remaining = iter(seconds)

    def once():
        log.append(seconds)
        return (next(remaining),)

    return once, lambda: torch.zeros(2, 2, 3) if image is None else image


def test_each_repeat_gives_one_ratio_whatever_the_machine_does_between_repeats(ab_benchmark):
    # three warm-ups, then the machine is ten times slower in every other repeat; this one takes twice as long in all
    its, log = [1.0] * 3 + [0.001, 0.010] * 4, []
    mine = [1.0] * 3 + [2.0 * t for t in its[3:]]
    found = ab_benchmark.compare(timed(mine, log), timed(its, log), ("step",), 8)["step"]
    assert found["ratio"] == pytest.approx(2.0)
    assert found["ratio_quartiles"] == pytest.approx([2.0, 2.0])
    assert found["this_ms"] == pytest.approx(2.0 * found["other_ms"])
    # a single ratio is its own quartiles
    once = ab_benchmark.compare(timed([2.0] * 4, []), timed([1.0] * 4, []), ("step",), 1)["step"]
    assert (once["ratio"], once["ratio_quartiles"]) == (2.0, [2.0, 2.0])
    # the order changes from repeat to repeat
    assert log[6:10] == [its, mine, mine, its] or log[6:10] == [mine, its, its, mine]


def test_nothing_is_timed_where_the_images_differ_or_there_is_no_checkout(ab_benchmark, tmp_path):
    log = []
    with pytest.raises(SystemExit, match=r"images differ by 5.0e-01, more than 1e-04; nothing was timed"):
        ab_benchmark.compare(timed([1.0], log), timed([1.0], log, torch.full((2, 2, 3), 0.5)), ("step",), 1)
    assert not log
    with pytest.raises(SystemExit, match=rf"{tmp_path} has no pop_fast/__init__.py"):
        ab_benchmark.Checkout(tmp_path)


def test_a_checkout_whose_modules_stand_elsewhere_is_refused_in_one_line(tmp_path):
    (tmp_path / "pop_fast").mkdir()
    (tmp_path / "pop_fast" / "__init__.py").write_text("")
    # in a process of its own: what was imported by then would keep hold of the checkout's modules
    command = [sys.executable, BENCHMARKS / "ab_benchmark.py", tmp_path, "--repeats", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert re.search(r"cannot be timed from here: No module named 'pop_fast\S+; .*commit\n$", done.stderr)


def test_what_a_function_imports_when_it_is_called_is_its_own_checkouts(ab_benchmark, tmp_path, monkeypatch):
    (tmp_path / "run.py").write_text("def name():\n    from pop_fast.late import NAME\n    return NAME\n")
    for name in ("one", "other"):
        package = tmp_path / name / "pop_fast"
        package.mkdir(parents=True)
        for file, words in {"__init__": "", "late": f"NAME = {name!r}\n"}.items():
            (package / f"{file}.py").write_text(words)
    monkeypatch.setattr(ab_benchmark, "HERE", tmp_path)
    loaded = ab_benchmark._forget()
    try:
        one, other = (ab_benchmark.Checkout(tmp_path / name) for name in ("one", "other"))
        for checkout, expected in [(one, "one"), (other, "other"), (one, "one")]:
            with checkout.imports():
                assert checkout.run.name() == expected
    finally:
        ab_benchmark._forget()
        sys.modules.update(loaded)


# Preset quick against the longer schedule: curves of held-out PSNR over seconds.


def test_a_curve_is_read_between_its_points_and_nowhere_else(script: Any) -> None:
    quick = script("quick_curve")
    points = [{"seconds": 10.0, "psnr": 20.0}, {"seconds": 20.0, "psnr": 30.0}, {"seconds": 30.0, "psnr": 29.0}]
    assert quick.psnr_at(points, 15.0) == 25.0
    assert math.isnan(quick.psnr_at(points, 5.0))
    assert math.isnan(quick.psnr_at(points, 31.0))
    assert [quick.seconds_until(points, psnr) for psnr in (19.0, 24.0, 30.0)] == [10.0, 14.0, 20.0]
    assert math.isnan(quick.seconds_until(points, 30.1))


def test_the_tables_of_quick_are_means_of_the_seeds_that_have_both(script: Any, tmp_path: Path) -> None:
    quick = script("quick_curve")
    # runs that are not there do not empty the tables
    with pytest.raises(SystemExit):
        quick.main(["--json", str(tmp_path / "quikc.json"), "--write"])

    def run(seconds: float, psnr: float) -> list[dict[str, float]]:
        rest = {"ssim": 0.5, "gaussians": 1_000}
        return [{"seconds": s * seconds, "psnr": psnr - 4.0 + 4.0 * s, **rest} for s in (0.5, 1.0)]

    seeds = {"1": {"before": run(100.0, 30.0), "now": run(40.0, 31.0)}, "2": {"before": run(100.0, 28.0)}}
    seeds["3"] = {"before": run(100.0, 32.0), "now": run(60.0, 31.0)}
    (*_, row) = quick.ends_table({"toy": seeds})
    assert row.startswith(
        "| toy, 2 | 31.00 dB, 0.500, 1,000, 100 s | 31.00 dB, 0.500, 1,000, 50 s | +0.00 dB (-1.00 to +1.00)"
    )
    # 29.9 dB of the first seed are there after 29 s; the third never comes within 0.1 dB
    assert row.endswith("| 0.50 | 0.29 (1 of 2 seeds) |")
    (*_, row) = quick.curve_table({"toy": seeds})
    assert row.startswith("| toy |  /  |")
    # after half of the time one seed of quick has ended: there is no mean
    assert "| 29.00 /  |" in row


# Settings for few photographs, and what was foretold of runs that choose for themselves.


def test_few_photographs_are_left_evenly_with_the_points_that_two_of_them_see() -> None:
    capture = tiny_capture(n_views=17)
    left = left_of(capture, 4)
    assert [view.name for view in left.test_views()] == [view.name for view in capture.test_views()]
    assert [view.name for view in left.train_views()] == ["01.png", "05.png", "11.png", "15.png"]
    assert 0 < len(left.points) < len(capture.points)
    seen = np.bincount(np.concatenate([view.seen for view in left.train_views()]), minlength=len(left.points))
    assert seen.min() >= 2
    was = {view.name: {*map(tuple, capture.points[view.seen])} for view in capture.views}
    assert all({*map(tuple, left.points[view.seen])} <= was[view.name] for view in left.views)


def test_the_guide_counts_the_runs_with_few_photographs_that_are_kept() -> None:
    known = read_json(BENCHMARKS / "results" / "few_photographs.json")
    gains = defaultdict[tuple[str, int, str], list[dict[str, float]]](list)
    for name, run in known.items():
        if (of := re.fullmatch(r"((\w+) / \d, (\d+) photographs, .*): (--.*)", name)) is not None:
            plain = known[f"{of[1]}: plain"]
            gains[of[4], int(of[3]), of[2]].append({key: run[key] - plain[key] for key in ("psnr", "ssim")})
    few, more = (
        [gain for (setting, *_), of in gains.items() if setting == f"--depth-lambda {weight}" for gain in of]
        for weight in (0.1, 0.01)
    )
    rises = [sum(gain[key] > 0.0 for gain in of) for of, key in ((few, "ssim"), (few, "psnr"), (more, "psnr"))]
    guide = " ".join((ROOT / "docs" / "guide.md").read_text(encoding="utf-8").split())
    assert rises[0] == len(few)
    assert f"raises SSIM in all {len(few)} runs and PSNR in {rises[1]} of them" in guide
    assert f"gains {fmean(gain['psnr'] for gain in more):.2f} dB on average" in guide
    assert f"(PSNR rises in {rises[2]} of {len(more)} runs)" in guide
    ssim = [
        fmean(gain["ssim"] for gain in of) for (setting, n, _), of in gains.items() if "gsplat" in setting and n >= 20
    ]
    assert f"its SSIM is higher by {min(ssim):.2f} to {max(ssim):.2f};" in guide


def test_the_notes_on_the_weight_of_the_prior_are_means_of_the_runs_that_are_kept() -> None:
    runs = defaultdict[str, list[dict[str, Any]]](list)
    for line in (BENCHMARKS / "results" / "e1.jsonl").read_text(encoding="utf-8").splitlines():
        runs[json.loads(line)["run"].rpartition("_")[0]].append(json.loads(line))
    means = {
        name: {key: fmean(run[key] for run in of) for key in ("psnr", "ssim", "num_GS")} for name, of in runs.items()
    }
    notes, guide, protocol = (
        (ROOT / page).read_text(encoding="utf-8")
        for page in ("benchmarks/NOTES.md", "docs/guide.md", "paper_repro/protocol.md")
    )
    captures = ("", "garden_half/", "bonsai_half/")
    for row in "abcdefgh":
        cells = ["{psnr:.2f}, {ssim:.4f}, {num_GS:,.0f}".format(**means[capture + row]) for capture in captures]
        assert re.search(rf"^\| {row} \| .* \| {re.escape(' | '.join(cells))} \|$", notes, re.MULTILINE), (row, cells)

    def change(row: str, other: str) -> list[tuple[float, float]]:
        pairs = [(means[capture + row], means[capture + other]) for capture in captures]
        return [(b["psnr"] - a["psnr"], 100.0 * a["num_GS"] / b["num_GS"]) for a, b in pairs]

    costs, left = zip(*change("f", "d"), strict=True)
    costs_and_left = f"{min(costs):.1f} to {max(costs):.1f} dB", f"{min(left):.0f} to {max(left):.0f}%"
    assert "(f - d) costs {} and leaves {}.".format(*costs_and_left) in notes
    assert "left {1} of the Gaussians of three captures and cost {0} (".format(*costs_and_left) in guide
    (weak, kept), (strong, few) = (change(row, "c")[0] for row in "df")
    assert f"costs {weak:.2f} dB for {100.0 - kept:.0f}% fewer Gaussians" in protocol
    assert f"ten times that weight {strong:.2f} dB for {100.0 - few:.0f}% fewer" in protocol


def test_a_table_of_settings_compares_the_same_seeds_alone() -> None:
    rows = {
        "a / 2, 8 photographs, 9 steps, seed 1: plain": {"psnr": 20.0, "ssim": 0.5},
        "a / 2, 8 photographs, 9 steps, seed 2: plain": {"psnr": 30.0, "ssim": 0.7},
        "a / 2, 8 photographs, 9 steps, seed 2: --x": {"psnr": 31.0, "ssim": 0.6},
    }
    last = table_of({"machine": {}, **rows}).splitlines()[-1]
    assert last == "| a / 2, 8 photographs, 9 steps | 25.00 / 0.600 (2) | +1.00 / -0.100 (1) |"


def test_the_line_before_the_first_step_is_read_back_for_the_table_of_estimates() -> None:
    choice = Choice(scaler=0.01, gaussians=34_900.0, seconds=3_725.0, memory_bytes=1.27e9)
    config = TrainConfig.of(preset="auto", steps_scaler=0.01, factor=2, backend="fast")
    row = estimates.foretold(f"before\n{automatic.line_of(choice, config, (256, 512))}\n")
    foretold = {"gaussians": 35_000, "seconds": 3_720.0, "memory": 1.3}
    assert row == {"size": "256x512", "steps": 300, "foretold": foretold}
    assert estimates.seconds_of(duration(62.0)) == 62.0
    came = {"gaussians": 40_000, "seconds": 1_860.0, "memory": 1.21}
    table = estimates.table_of({"machine": {}, "toy, 60": {**row, "minutes": 60.0, "came": came}})
    assert table.splitlines()[2:] == ["| toy, 60 | 256x512, 300 | 3720 s, 1860 s | 0.50 | 35,000, 40,000 | 1.3, 1.2 |"]
    with pytest.raises(ValueError, match="no line says"):
        estimates.foretold("trained")


def test_a_row_that_is_measured_again_has_its_own_machine_and_leaves_what_others_wrote(tmp_path, monkeypatch):
    path, row = tmp_path / "estimates.json", {"size": "8x8", "steps": 1, "minutes": 1.0}
    numbers = {"gaussians": 1, "seconds": 1.0, "memory": 1.0}
    row |= {"foretold": numbers, "came": numbers}
    write_json(path, {"machine": {"cpu": "old", "commit": "a"}, "one, 1": row, "two, 1": row})

    def measured(capture: Path, minutes: float) -> dict[str, Any]:
        # another call, meanwhile
        write_json(path, {**read_json(path), "two, 1": {**row, "steps": 2}})
        return row

    monkeypatch.setattr(estimates, "measured", measured)
    monkeypatch.setattr(estimates, "machine", lambda: {"cpu": "new", "commit": "b"})
    assert estimates.main(["one", "--json", str(path)]) == 0
    known = read_json(path)
    assert known["one, 1"] == {"machine": {"cpu": "new", "commit": "b"}, **row}
    assert (known["machine"]["commit"], known["two, 1"]["steps"]) == ("a", 2)


def test_sizes_that_are_kept_keep_their_machine_and_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, kept = tmp_path / "budgets.json", {"machine": {"cpu": "old"}, "steps": 7, "psnr": 20.0}
    write_json(path, {"ply_bytes": 248, "captures": {"one": kept}})
    for name, made in (
        ("measured", lambda *_: {}),
        ("read_config", lambda _: SimpleNamespace(data="two")),
        ("within_budgets", lambda *_: iter([{"psnr": 30.0}])),
        ("machine", lambda: {"cpu": "new"}),
    ):
        monkeypatch.setattr(sizes, name, made)
    monkeypatch.setattr(sys, "argv", ["sizes.py", "out", "--budgets", "--json", str(path)])
    assert sizes.main() == 0
    new = {"machine": {"cpu": "new"}, "steps": 300, "psnr": 30.0}
    assert read_json(path) == {"ply_bytes": 248, "captures": {"one": kept, "two": new}}


def test_what_was_foretold_of_four_captures_came_within_thirty_percent() -> None:
    known = json.loads((ROOT / "benchmarks" / "results" / "estimates.json").read_text(encoding="utf-8"))
    rows = [row for name, row in known.items() if name != "machine"]
    whole = [row for row in rows if row["steps"] == 30_000]
    assert len(rows) - len(whole) == 4
    for row in rows:
        for name, said in row["foretold"].items():
            # the Gaussians of whole schedules, and so their memory, are not foretold so well, which the guide says
            if name == "seconds" or row not in whole:
                assert said / 1.3 < row["came"][name] < 1.3 * said, (row, name)
    guide = (ROOT / "docs" / "guide.md").read_text(encoding="utf-8")
    assert "within 30 % of the predicted time on the four captures" in guide
    for row in whole:
        ratios = {name: row["came"][name] / said for name, said in row["foretold"].items()}
        seconds, gaussians = (f"{ratios[name]:{form}}" for name, form in (("seconds", ".2f"), ("gaussians", ".1f")))
        said = f"{seconds} times the predicted time, with {gaussians} times the Gaussians and"
        assert f"{said} {ratios['memory']:.1f} times the memory" in guide


# runs of benchmarks/results/quick.json: the capture's name among the scenes of the tables, pixels of a photograph
QUICK_RUNS = {
    "fox, factor 4": ("fox", 270 * 480),
    "bear_512": ("bear_512", 512 * 512),
    "m360_bonsai_800, factor 2": ("bonsai_800", 400 * 266),
    "m360_garden_512": ("garden_512", 512 * 512),
}


def test_the_guide_says_how_far_off_the_expected_gaussians_were() -> None:
    shares, first = defaultdict[tuple[str, str], list[float]](list), dict[str, int]()
    for run in read_all("small"):
        if run.row not in ("pop", "gsplat", "3dgs", "taming", "speedy_splat", "mini_splatting"):
            continue
        pixels = run.protocol["width"] * run.protocol["height"]
        trained = SCENES[run.scene].n_images - run.protocol["test_views"]
        begun = first[run.scene] = run.curve[0]["num_gaussians"]
        expected = automatic.expected_gaussians(run.row, begun, pixels, trained, 1.0)[0]
        shares[run.row, run.scene].append(run.num_gaussians / expected)

    def span(*rows: str) -> str:
        means = [sum(of) / len(of) for (row, _), of in shares.items() if row in rows]
        return f"with {min(means):.1f} to {max(means):.1f} times"

    guide = (ROOT / "docs" / "guide.md").read_text(encoding="utf-8")
    assert f"small images of these four captures {span('pop')} as many" in guide
    assert f"gsplat's strategy and 3DGS ended {span('gsplat', '3dgs')} as many" in guide
    assert f"or have a budget {span('taming', 'speedy_splat', 'mini_splatting')}" in guide
    until = {name: f"up to {factor * QUICK_SCALER:.1f}" for name, factor in QUICK_RATES.items()}
    assert until["scales"] == until["quats"]
    assert until["means"] == until["sh_rest"]
    assert (
        f"scales and rotations {until['scales']} of the schedule, of colours of degree 0 {until['sh0']}, and" in guide
    )
    assert f"of centres and other colours {until['means']}" in guide
    runs = read_json(BENCHMARKS / "results" / "quick.json")["runs"]
    ratios = [
        of[which][-1]["gaussians"] / automatic.expected_gaussians("pop", first[scene], pixels, 0, scaler)[0]
        for name, (scene, pixels) in QUICK_RUNS.items()
        for of in runs[name].values()
        for which, scaler in (("before", 0.1), ("now", 0.05))
    ]
    assert all(1.0 / 1.1 < ratio < 1.1 for ratio in ratios), ratios
    assert f"within 10 % for {len(ratios)} runs of POP on these four captures" in guide


def test_reports_of_captures_with_known_faults_say_what_is_known_and_the_table_marks_those_that_do_not(script):
    kinds = script("kinds")
    rows = json.loads((BENCHMARKS / "results" / "kinds.json").read_text(encoding="utf-8"))
    for name, kind in kinds.KINDS.items():
        assert kinds.wrong(kind, rows[name]) == [], name
    assert "not as it is" not in kinds.table_of(rows)
    assert kinds.table_of({**rows, "moved": rows["object"]}).count("not as it is") == 1
    row = {**rows["room"], "verdict": {**rows["room"]["verdict"], "Exposure": ["look", "It drifts"]}}
    assert kinds.wrong(kinds.KINDS["room"], row) == ["Exposure: look"]
    assert kinds.wrong(kinds.KINDS["drift"], rows["room"]) == ["Exposure does not say 'Learned'"]
    assert kinds.wrong(kinds.KINDS["room"], {"failed": "no cameras"}) == ["no cameras"]


def test_a_made_photograph_shows_what_stands_nearest_at_its_brightness(script: Any) -> None:
    kinds = script("kinds")
    paints = np.full((12, 2048, 2048, 3), 128, np.uint8)
    paints[3] = 255
    view = kinds.look_at((0.0, -4.0, 0.0), (0.0, 0.0, 0.0))
    far, near = kinds.Box((0, 2, 0), (8, 1, 8), 5), kinds.Box((0, 0, 0), (1, 1, 1), 1)
    picture = kinds.rendered(kinds.Photograph(view, (far, near)), paints)
    # the near box shows its side towards -y, number 2, by the paint after the next
    side = round(255 * 0.7 ** (1 / 2.2))
    assert picture[180, 240].tolist() == [side] * 3
    assert picture[180, 60].max() < side
    darker = kinds.rendered(kinds.Photograph(view, (far, near), stops=-1.0), paints)
    assert darker[180, 240].tolist() == [round(255 * 0.35 ** (1 / 2.2))] * 3


# of an engine that is sound: what it measures of itself, errors, and threads where it is given none
NOT_JUDGED = {"c_api.h", "counts.cpp", "threads.h"}
# lines of errors, of bytes and times that are told, and heads of templates, which compilers count for some types alone
TOLD = re.compile(
    r"catch|^}$|bytes\(|trace|^return n;$|^\*given->bad_row|^template <class Real> struct|^: size\(size\)"
)


def test_the_laws_run_every_line_of_the_engine_that_computes_what_is_trained() -> None:
    counted = json.loads((BENCHMARKS / "results" / "engine_mutants.json").read_text(encoding="utf-8"))["lines"]
    left = {Path(name).name: lines for name, lines in counted["not run"].items()}
    others = {name: lines for name, lines in left.items() if name not in NOT_JUDGED}
    assert all(TOLD.search(line) for lines in others.values() for line in lines), others
    assert counted["lines"] - counted["run"] == sum(map(len, left.values()))
    page = (ROOT / "docs" / "kit.md").read_text(encoding="utf-8")
    assert f"Of the engine's {counted['lines']:,} lines the laws run {counted['run']:,}" in page
    assert f"engine_mutants --lines`, at commit {counted['commit']})" in page


CONDITIONS = json.loads((BENCHMARKS / "results" / "conditions.json").read_text(encoding="utf-8"))


def test_every_condition_is_broken_once_and_refusals_never() -> None:
    every = conditions.sites()
    assert len({site.name for site in every}) == len({(site.package, site.file, site.text) for site in every})
    assert all(ast.parse(site.text) for site in every[::40])
    names = {site.name for site in every}
    for new in ("True", "False", "((r_x > 0))", "((r_y > 0))"):
        assert f"pop_ref/tiles.py: r_x > 0 and r_y > 0 -> {new}" in names
    assert "pop_ref/tiles.py: r_x > 0 -> (r_x >= 0)" in names
    assert not any("isfinite" in site.old for site in every if site.file == "selection.py")


def test_of_conditions_the_page_says_what_the_trial_found() -> None:
    names = {site.name for site in conditions.sites()}
    assert set(CONDITIONS["lives"]) <= names, "the sources have changed: try those anew"
    shares = re.findall(r"(\d+) of (\d+) die", "\n".join(conditions.told(CONDITIONS)))
    died, faults = (sum(int(share[k]) for share in shares) for k in range(2))
    assert died == len(CONDITIONS["died"])
    said = f"{died} of {faults} ({100 * died / faults:.0f} %"
    assert said in (ROOT / "docs" / "kit.md").read_text(encoding="utf-8"), said


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, how in CONDITIONS["lives"].items() if "noticed since by" in how])
def test_a_broken_condition_that_lived_dies_by_the_law_that_is_named(name: str) -> None:
    (site,) = (site for site in conditions.sites() if site.name == name)
    law = CONDITIONS["lives"][name]["noticed since by"]
    assert conditions.noticed_by(site, site.precisions[0], [law], conditions.FEW).startswith(f"{law}: ")
