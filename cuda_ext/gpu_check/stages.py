"""The stages of `gpu_check`: what each runs, and what it keeps of it."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cuda_ext.gpu_check.several import blocks_stage, ranks_stage
from cuda_ext.gpu_check.shared import (
    MARGIN,
    NOTHING,
    REHEARSE,
    ROOT,
    Command,
    Share,
    StageContext,
    python_path,
    read_json,
    skipped,
)
from cuda_ext.gpu_check.tests import (
    laws_of_gaussian_parallel_stage,
    laws_stage,
    sanitizer_stage,
    smoke_stage,
    steps_stage,
)
from cuda_ext.gpu_check.training import no_capture, train_stage
from pop_fast.children import python_command

_COMPILE = "import time; t = time.time(); from gsplat.cuda._backend import _C; print(round(time.time() - t), 's');"
_COMPILE += "assert _C is not None, 'gsplat found no CUDA toolkit'"


def wheels_stage(check: StageContext) -> dict[str, Any]:
    """Install the wheels that were brought along into a scratch folder; continue without what is absent.

    Where pip refuses them together, each is installed by itself, so that a damaged one costs no other.
    """
    wheels = sorted(map(str, (check.packed / "wheels").glob("*.whl"))) if check.packed else []
    if not wheels:
        return skipped("no wheels were brought along (--packed FOLDER, made by --pack)")
    pip = python_command("-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile", "--upgrade")
    into, end = [*pip, "--target", str(check.site)], time.monotonic() + check.seconds
    found = check.run([*into, *wheels], check.seconds)
    if found["status"] == 0:
        return found | {"wheels": list(map(_stem, wheels))}
    each = {wheel: check.run([*into, wheel], max(end - time.monotonic(), 1.0)) for wheel in wheels}
    bad = {_stem(wheel): one["output"][-500:] for wheel, one in each.items() if one["status"] != 0}
    sound = [_stem(wheel) for wheel in wheels if _stem(wheel) not in bad]
    return found | {"wheels": sound, "damaged": bad, "output": "\n".join(bad.values()) or found["output"]}


def build_stage(check: StageContext) -> dict[str, Any]:
    """Build the extension for this machine's GPU; what an earlier call built is only built where sources changed."""
    jobs = str(os.cpu_count() or 2)
    found = check.run(check.python("-m", "cuda_ext.build", "--jobs", jobs), check.seconds)
    if found["status"] == 0 and (check.site / "gsplat").is_dir():
        _start_gsplat(check)
    return found


def bench_stage(check: StageContext) -> dict[str, Any]:
    """Time every kernel and the whole step."""
    return _benchmark(check, "gpu_kernels.py", check.seconds)


def counters_stage(check: StageContext) -> dict[str, Any]:
    """Ask the hardware's counters about every kernel of a step, and keep where its warps wait, line by line."""
    if shutil.which("ncu") is None:
        return skipped("ncu is not installed")
    target, lines = check.out / "gpu_counters.json", check.out / "lines.csv.gz"
    limit = str(max(check.seconds / 2 - MARGIN, 1.0))
    script = str(ROOT / "benchmarks" / "gpu_counters.py")
    path = python_path(ROOT, check.site, ROOT / "benchmarks")
    words = check.python(script, str(target), "--lines", str(lines), "--limit-s", limit)
    if check.rehearsal:
        words += ["--device", "cpu", "--cases", "tiny", "--through", str(REHEARSE)]
    return check.run(words, check.seconds, {"PYTHONPATH": path}) | {"results": read_json(target)}


def gsplat_stage(check: StageContext) -> dict[str, Any]:
    """Time gsplat too, when its own compilation, begun during earlier stages, has come to an end."""
    compiling = check.beside.get("gsplat")
    if compiling is None:
        return skipped("gsplat is not among the wheels that were brought along, or nothing was built")
    start = time.monotonic()
    compiled = compiling.wait(0.6 * check.seconds)
    check.note({"status": compiled["status"], "seconds": compiled["seconds"], "compilation": compiled})
    if compiled["status"] != 0:
        reason = "gsplat was not compiled: its words are under `compilation`; name build and gsplat alone in a call"
        return skipped(reason) | {"compilation": compiled}
    left = check.seconds - (time.monotonic() - start)
    found = _benchmark(check, "gpu_gsplat.py", left, _of_gsplat(check))
    return found | {"compilation": compiled}


def reproduce_stage(check: StageContext) -> dict[str, Any]:
    """Train the rows of the paper's tables that the claims need, the cheapest first, as `pop-repro queue` does.

    Of the scenes that were brought along (--whole, --prepared), at the scale that decides claims, one after the other:
    trainings that share a card take turns and gain nothing. A row that the time ends in is begun anew by the next call,
    unless the folder survives. What was finished is one line each of rows.jsonl.
    """
    folder = check.packed / "captures" if check.packed else check.captures[0].parent if check.captures else None
    if folder is None:
        return no_capture()
    results = check.work / "paper_repro" / "results"
    words = ["-m", "paper_repro", "queue", "--scale", "toy" if check.rehearsal else "small", "--data", str(folder)]
    words += ["--results", str(results), "--work", str(check.work / "paper_repro"), "--threads", "0"]
    words += ["--backend", "auto" if check.rehearsal else "cuda", "--rows", *REPRODUCED]
    found = check.run(check.python(*words), check.seconds)
    if found["status"] == 130:
        found |= {"status": 0, "note": "the time was up; the rows that were finished are under `rows`"}
    files = sorted(results.rglob("*.jsonl"))
    # no more files are brought back than a node gives back
    (check.out / "rows.jsonl").write_text("".join(path.read_text(encoding="utf-8") for path in files), encoding="utf-8")
    return found | {"rows": [str(path.relative_to(results)) for path in files]}


def _start_gsplat(check: StageContext) -> None:
    environment = {"PYTHONPATH": python_path(ROOT, check.site), **_of_gsplat(check)}
    command = python_command("-c", _COMPILE)
    check.beside["gsplat"] = Command(command, check.work / "gsplat_compilation.log", environment)


def _of_gsplat(check: StageContext) -> dict[str, str]:
    jobs = str(max((os.cpu_count() or 2) // 2, 1))
    return {"TORCH_EXTENSIONS_DIR": str(check.work / "torch_extensions"), "MAX_JOBS": jobs}


def _benchmark(check: StageContext, script: str, limit: float, over: Mapping[str, str] = NOTHING) -> dict[str, Any]:
    target = check.out / f"{script.removesuffix('.py')}.json"
    target.unlink(missing_ok=True)
    words = [str(ROOT / "benchmarks" / script), str(target), "--scenes", *check.scenes()]
    words += ["--device", "cpu", "--cases", "tiny", "--full-size", "3000"] if check.rehearsal else []
    # they import each other by their bare names
    path = python_path(ROOT, check.site, ROOT / "benchmarks")
    found = check.run(check.python(*words), limit, {"PYTHONPATH": path, **over})
    # case by case: also what was measured before the time was up
    return found | {"results": read_json(target)}


def _stem(path: str) -> str:
    return "-".join(Path(path).name.split("-")[:2])


STAGES: dict[str, Callable[[StageContext], dict[str, Any]]] = {
    "wheels": wheels_stage,
    "build": build_stage,
    "smoke": smoke_stage,
    "bench": bench_stage,
    "counters": counters_stage,
    "gsplat": gsplat_stage,
    "laws": laws_stage,
    "steps": steps_stage,
    "sanitizer": sanitizer_stage,
    "train": train_stage,
    "laws_of_gaussian_parallel": laws_of_gaussian_parallel_stage,
    "reproduce": reproduce_stage,
    "ranks": ranks_stage,
    "blocks": blocks_stage,
}
# what the paper's claims are judged by
REPRODUCED = ("pop", "l2_blur", "reset", "l2", "l2_pop", "pop_size_prune", "blur_3k_4k", "blur_3k_11k", "blur_3k_15k")
REPRODUCED += ("gsplat", "3dgs", "taming", "speedy_splat", "mini_splatting", "mini_splatting_star", "pup", "pup_star")
SHARES = {
    "wheels": Share(5, 40),
    "build": Share(100, 300),
    "smoke": Share(30, 90),
    "bench": Share(120, 330),
    "counters": Share(40, 120),
    "gsplat": Share(60, 1e9),
    "laws": Share(90, 150),
    "steps": Share(45, 150),
    "sanitizer": Share(40, 90),
    "train": Share(90, 250),
    "laws_of_gaussian_parallel": Share(20, 1e9),
    "reproduce": Share(120, 1e9),
    "ranks": Share(150, 1e9),
    "blocks": Share(120, 1e9),
}
JOBS = {
    1: ("wheels", "build", "smoke", "bench", "counters", "gsplat"),
    2: ("wheels", "build", "laws", "steps", "sanitizer", "train", "laws_of_gaussian_parallel"),
    3: ("wheels", "build", "reproduce"),
    4: ("wheels", "build", "ranks", "blocks"),
}
