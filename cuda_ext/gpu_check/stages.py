"""The stages of `gpu_check`: what each runs, and what it keeps of it.

They build, run tests (smoke, laws, steps, under compute-sanitizer), time, train as `pop train` does, and on a node of
several GPUs share steps by ranks and train blocks at once.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cuda_ext.gpu_check.outcomes import FILE, outcomes
from cuda_ext.gpu_check.shared import (
    MARGIN,
    NOTHING,
    REHEARSE,
    ROOT,
    Command,
    Share,
    StageContext,
    all_lines,
    python_path,
    read_json,
    skipped,
)
from pop_fast.children import python_command

_COMPILE = "import time; t = time.time(); from gsplat.cuda._backend import _C; print(round(time.time() - t), 's');"
_COMPILE += "assert _C is not None, 'gsplat found no CUDA toolkit'"
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
TRAIN = "from pop_fast.cli import main; raise SystemExit(main())"
# what a training run is judged by
_KEPT = ("step", "seconds", "seconds_loading", "seconds_total", "num_GS", "num_GS_above_floor", "psnr", "ssim", "views")
_KEPT += ("gpu", "gpu_memory_bytes", "instance_buffers_grown", "photograph_bytes", "photographs_passing")
_KEPT += ("received_bytes",)
# of the node in a rehearsal, and the steps that are taken there
REHEARSED, FEW = 2, 8
LAWS = ("test_laws.py",)
STEPS = tuple(f"test_{name}.py" for name in ("ten_steps", "instances", "kernels", "device_training"))
SMOKE = tuple(
    f"test_ten_steps.py::test_{name}"
    for name in (
        # replayed graphs first: nothing but a GPU can run them
        "steps_launched_anew_are_the_replayed_steps",
        "graphs_of_several_sizes_and_phases_are_replayed_in_turn",
        "two_runs_give_the_same_bits",
        "buffers_that_overflow_grow_and_nothing_is_lost",
        "ten_fused_steps_are_the_cpus_ten_steps",
        "a_render_is_the_oracles",
        "fused_steps_launched_one_by_one_give_the_same_bits_twice_and_learn",
    )
)
# no graph is captured, which cannot be where every allocation is one of the driver's
WATCHED = ("test_ten_steps.py::test_rasterization_and_its_gradients_give_the_same_bits_twice", *SMOKE[-2:])
LAWS_REHEARSED = "remaining_light_lies"


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


def counters_stage(check: StageContext) -> dict[str, Any]:
    """Ask the hardware's counters about every kernel of a step, and keep where its warps wait, line by line."""
    if shutil.which("ncu") is None:
        return skipped("ncu is not installed")
    target, lines = check.out / "gpu_counters.json", check.out / "lines.csv.gz"
    for earlier in (target, lines):
        earlier.unlink(missing_ok=True)
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
    captures = captures_of(check)
    if not captures:
        return no_capture()
    folder = captures[0].parent
    results = check.work / "paper_repro" / "results"
    words = ["-m", "paper_repro", "queue", "--scale", "toy" if check.rehearsal else "small", "--data", str(folder)]
    words += ["--results", str(results), "--work", str(check.work / "paper_repro"), "--threads", "0"]
    words += ["--backend", "auto" if check.rehearsal else "cuda", "--rows", *REPRODUCED]
    found = check.run(check.python(*words), check.seconds)
    files = sorted(results.rglob("*.jsonl"))
    if found["status"] == 130:
        note = "the time was up; the rows that were finished are under `rows`"
        found |= {"status": 0 if files else 124, "note": note}
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


def captures_of(check: StageContext) -> list[Path]:
    """List what was brought along to train on, and what was given."""
    packed = sorted((check.packed / "captures").glob("*/")) if check.packed else []
    return [*packed, *check.captures]


def no_capture() -> dict[str, Any]:
    """Return what a stage found that has nothing to train on."""
    return skipped("no captures were given (--captures DIR ...) or brought along")


def last_stats(folder: Path) -> dict[str, Any] | None:
    """Return what is kept of the last measurement of a run; `seconds_training` is its `seconds`."""
    stats = sorted((folder / "stats").glob("val_step*.json"), key=lambda file: int(file.stem.split("step")[1]))
    if not stats:
        return None
    last = read_json(stats[-1])
    return {**{name: last.get(name) for name in _KEPT}, "seconds_training": last.get("seconds")}


def train_stage(check: StageContext) -> dict[str, Any]:
    """Train POP on every capture as `pop train --backend cuda` does; seconds, Gaussians, PSNR, SSIM."""
    captures = captures_of(check)
    if not captures:
        return no_capture()
    if importlib.util.find_spec("tyro") is None and not (check.site / "tyro").is_dir():
        return skipped(
            "`pop train` needs tyro, which is neither installed nor among the wheels that were brought along"
        )
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "runs": {}}
    for k, path in enumerate(captures):
        one = train_one(check, path, (check.seconds - found["seconds"]) / (len(captures) - k))
        found["runs"][path.name] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    return found


def train_one(check: StageContext, path: Path, limit: float, backend: str = "cuda") -> dict[str, Any]:
    """Train on one capture, or continue with the training of an earlier call at the same commit."""
    folder = _folder(check, path, backend)
    words = ["--backend", backend, "--steps-scaler", str(check.steps_scaler)]
    words += ["--resume"] if (folder / "cfg.json").exists() else []
    found = _train(check, path, folder, limit, words)
    if found["status"] == 130:
        found |= {"status": 124, "note": "the time was up; where the folder survives, the next call continues"}
    return found


def _folder(check: StageContext, path: Path, name: str) -> Path:
    return check.work / f"{path.name}_{name}_{check.steps_scaler:g}_{check.commit[:12]}"


def _train(
    check: StageContext, path: Path, folder: Path, limit: float, more: Sequence[str], size: int = 1
) -> dict[str, Any]:
    """Run `pop train` by so many processes, which torchrun starts where they are several."""
    words = ["train", str(path), "--out", str(folder), "--no-progress", "--max-renders", "1"]
    command = check.python("-c", TRAIN, *words, "--skip-sizes", "--skip-checks", *more)
    if size > 1:
        launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(size), "--no-python")
        command = [*python_command(*launcher), *command]
    found, told = check.run(command, limit), last_stats(folder)
    if found["status"] == 0 and told is None:
        found["status"] = 1
    return {**(told or {}), **found}


def count_gpus(check: StageContext) -> int:
    """Return how many GPUs the node has."""
    return REHEARSED if check.rehearsal else len(all_lines(["nvidia-smi", "--list-gpus"]))


def ranks_stage(check: StageContext) -> dict[str, Any]:
    """Train on the first capture by 1, 2, 4 ... GPUs, each step of as many views as the node has GPUs.

    The bits must be the same. What a rank received of the others (`received_bytes`) stands with the seconds.
    """
    gpus, captures = count_gpus(check), captures_of(check)
    if gpus < 2:
        return skipped(f"the node has {gpus} GPU; ranks share two or more")
    if not captures:
        return no_capture()
    # of 3 GPUs too there are two to compare
    sizes = sorted({gpus, *(size for size in (1, 2, 4, 8) if gpus % size == 0)})
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "gpus": gpus, "runs": {}}
    for k, size in enumerate(sizes):
        limit = (check.seconds - found["seconds"]) / (len(sizes) - k)
        one = _train_anew(check, captures[0], f"ranks_{size}", limit, size, "--batch-size", str(gpus))
        found["runs"][str(size)] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    hashes = {one.get("sha256") for one in found["runs"].values()}
    found["same_bits"] = len(hashes) == 1 and None not in hashes
    return found | {"status": found["status"] or int(not found["same_bits"])}


def blocks_stage(check: StageContext) -> dict[str, Any]:
    """Train on the first capture in blocks, one a GPU, and as a whole: seconds and PSNR of both."""
    gpus, captures = count_gpus(check), captures_of(check)
    if not captures:
        return no_capture()
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "gpus": gpus, "runs": {}}
    start = time.monotonic()
    for name, words in (("blocks", ("--blocks", f"{max(gpus // 2, 1)}x2")), ("whole", ())):
        left = check.seconds - (time.monotonic() - start)
        one = _train_anew(check, captures[0], name, left / (2 if name == "blocks" else 1), 1, *words)
        found["runs"][name] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    return found


def _train_anew(check: StageContext, path: Path, name: str, limit: float, size: int, *more: str) -> dict[str, Any]:
    """Train by so many processes, and give the digest of the Gaussians too."""
    folder = _folder(check, path, name)
    # blocks are processes of their own, in which nothing stands for a GPU in a rehearsal
    backend = "fast" if check.rehearsal and "--blocks" in more else "cuda"
    words = ["--backend", backend, "--overwrite", "--threads", "1", *more]
    words += ["--max-steps", str(FEW)] if check.rehearsal else ["--steps-scaler", str(check.steps_scaler)]
    found = _train(check, path, folder, limit, words, size)
    # that of step 29999 is later than that of step 6999
    plies = sorted((folder / "ply").glob("point_cloud_*.ply"), key=lambda file: (len(file.name), file.name))
    if plies:
        found["sha256"] = hashlib.sha256(plies[-1].read_bytes()).hexdigest()
    return found


def steps_stage(check: StageContext) -> dict[str, Any]:
    """Compare ten training steps with the CPU's, the bits of two runs, overflows, and short trainings with the CPU's.

    And hold single kernels, rows of every place and size, and other readings of the paper, to the CPU.
    """
    few = ("-k", "twice") if check.rehearsal else ()
    return _pytest(check, "steps", STEPS, *few)


def sanitizer_stage(check: StageContext) -> dict[str, Any]:
    """Run compute-sanitizer over a render, its gradients and fused steps; note where it cannot run."""
    tool = shutil.which("compute-sanitizer")
    if tool is None:
        return skipped("compute-sanitizer is not installed")
    unsupported = "compute-sanitizer does not support this device here"
    found: dict[str, Any] = {"status": 0, "seconds": 0.0}
    kinds = ("memcheck",) if check.rehearsal else ("memcheck", "racecheck", "synccheck")
    for k, kind in enumerate(kinds):
        # torch's cache of memory hides accesses beyond an array's end; API errors are torch's own questions
        before = (tool, "--tool", kind, "--report-api-errors", "no", "--error-exitcode", "9")
        limit = (check.seconds - found["seconds"]) / (len(kinds) - k)
        name, uncached = f"sanitizer_{kind}", {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
        one = _pytest(check, name, WATCHED, before=before, limit=limit, over=uncached)
        if "Device not supported" in one["output"]:
            one = {**one, "status": 0, "skipped": unsupported}
        # no more files are brought back than a node gives back
        (check.out / f"{name}.jsonl").unlink(missing_ok=True)
        found |= {kind: one, "status": found["status"] or one["status"]}
        found["seconds"] = round(found["seconds"] + one["seconds"], 1)
        check.note(found)
    # what ran nowhere has not passed
    return found | ({"skipped": unsupported} if all("skipped" in found[kind] for kind in kinds) else {})


def _laws(check: StageContext, name: str, kinds: str) -> dict[str, Any]:
    if check.rehearsal:
        # all are collected, few are run
        few = ("-k", LAWS_REHEARSED)
        return _pytest(check, name, LAWS, *few, over={"POP_CUDA_KINDS": kinds, "POP_EMULATED_LAWS": "1"})
    # the oracle takes most of the time, so that several processes share the GPU without waiting for it
    workers = min((os.cpu_count() or 2) // 2, 8)
    several = ("-n", str(workers)) if workers > 1 and importlib.util.find_spec("xdist") else ()
    return _pytest(check, name, LAWS, *several, over={"POP_CUDA_KINDS": kinds})


def _pytest(
    check: StageContext,
    name: str,
    tests: tuple[str, ...],
    *options: str,
    before: tuple[str, ...] = (),
    limit: float | None = None,
    over: Mapping[str, str] = NOTHING,
) -> dict[str, Any]:
    """Run tests of the GPU's folder, in a rehearsal under the emulator, and add up how they ended."""
    chosen = [str(ROOT / "tests" / "cuda" / "gpu" / test) for test in tests]
    lines = check.out / f"{name}.jsonl"
    lines.unlink(missing_ok=True)
    words = python_command("-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "cuda_ext.gpu_check.outcomes")
    on = "emulated" if check.rehearsal else "cuda"
    over = {"OMP_NUM_THREADS": "1" if check.rehearsal else "4", "POP_CUDA_ON": on, FILE: str(lines), **over}
    # interrupted, pytest says what it has seen so far
    found = check.run([*before, *words, *options, *chosen], limit or check.seconds, over, signal.SIGINT)
    found["tests"] = outcomes(lines)
    # without a GPU everything is skipped, which is no pass
    return found | {"status": found["status"] or int(found["tests"]["passed"] == 0)}


STAGES: dict[str, Callable[[StageContext], dict[str, Any]]] = {
    "wheels": wheels_stage,
    "build": build_stage,
    # graphs that are replayed, buffers that overflow, ten steps by the CPU's, and an image by the oracle's
    "smoke": lambda check: _pytest(check, "smoke", SMOKE),
    # every kernel and the whole step
    "bench": lambda check: _benchmark(check, "gpu_kernels.py", check.seconds),
    "counters": counters_stage,
    "gsplat": gsplat_stage,
    # every law of the kit, gradients and thresholds among them
    "laws": lambda check: _laws(check, "laws", "pixel_parallel atomics"),
    "steps": steps_stage,
    "sanitizer": sanitizer_stage,
    "train": train_stage,
    # and by the other backward kernel, which is not the default
    "laws_of_gaussian_parallel": lambda check: _laws(check, "laws_of_gaussian_parallel", "gaussian_parallel"),
    "reproduce": reproduce_stage,
    "ranks": ranks_stage,
    "blocks": blocks_stage,
}
