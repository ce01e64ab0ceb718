"""Time the CPU path: first the correctness gate against the oracle, then the numbers, written as one JSON file.

    python benchmarks/run.py                          all of it, results to benchmarks/results/cpu.json
    python benchmarks/run.py --only raster            one part: raster, iteration, memory, capture
    python benchmarks/run.py --capture DIR --factor 4 also training steps on a real capture

Every time is the median of `--repeats` runs in one process after warm-up, in which the backends take turns, so that the
ratios hold on a noisy machine; threads, machine and load are written beside. No speed is reported on a red gate.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent))
from cases import GATE_CASE, ITERATION_CASES, MEMORY_CASE, RASTER_CASES, Case, capture_of, gaussians_of
from timing import turns_ms

import pop_fast.train
from pop_fast.backends import backend_names, get_backend
from pop_fast.compositing import Composite, composite
from pop_fast.data import Capture, load_capture
from pop_fast.tiles import TileLists, tile_lists
from pop_fast.train import TrainConfig
from pop_fast.train.environment import keep_freed_memory, reproducible
from pop_fast.train.views import Rendered, ViewTensors, render_view
from pop_ref.render import render, render_vjp
from pop_ref.types import Camera, Gaussians

SCENE = ("means", "quats", "scales", "opacities", "colors")
GATE = {torch.float64: 1e-10, torch.float32: 5e-5}


def backends() -> tuple[str, ...]:
    """Return the CPU backends that can run here, the slowest first."""
    return tuple(name for name in ("fast", "compiled") if name in backend_names() and get_backend(name).available())


def gate() -> dict[str, float]:
    """Compare every backend's image and gradients with the oracle; raise SystemExit where they differ.

    Returns:
        The worst difference of each backend and type, relative to each array's largest entry.
    """
    exact = gaussians_of(GATE_CASE, torch.float64)
    arrays = [exact[name].numpy() for name in SCENE]
    camera = Camera(exact["viewmats"][0].numpy(), exact["Ks"][0].numpy(), GATE_CASE.width, GATE_CASE.height)
    image = render(Gaussians(*arrays), camera).image
    v_image = np.random.default_rng(1).normal(size=image.shape)
    v = render_vjp(Gaussians(*arrays), camera, v_image)
    expected = [image, v.means, v.quats, v.scales, v.opacities, v.sh]
    worst: dict[str, float] = {}
    for backend, (dtype, bound) in itertools.product(backends(), GATE.items()):
        given = {name: value.detach().to(dtype, copy=True) for name, value in exact.items()}
        leaves = {name: given[name].requires_grad_() for name in SCENE}
        size = {"width": GATE_CASE.width, "height": GATE_CASE.height, "sh_degree": 3}
        fast, _, _ = get_backend(backend).rasterization(**{**given, **leaves}, **size)
        (fast[0] * torch.tensor(v_image, dtype=dtype)).sum().backward()
        found = [fast[0].detach(), *(_gradient(leaf) for leaf in leaves.values())]
        error = max(
            float(np.abs(a.double().numpy() - b).max() / np.abs(b).max()) for a, b in zip(found, expected, strict=True)
        )
        worst[f"{backend} {dtype}"] = error
        if not error <= bound:
            raise SystemExit(
                f"gate: {backend} {dtype} differs from the oracle by {error:.2e}, more than {bound:.0e}; "
                f"nothing was timed"
            )
    return worst


def time_raster(case: Case, repeats: int) -> dict[str, Any]:
    """Time `rasterization()` and, apart from it, the blend alone in 16 and 8 pixel tiles; every backend in turns."""
    scene = gaussians_of(case)
    leaves = {name: scene[name].requires_grad_() for name in SCENE}
    arguments = {**scene, **leaves, "width": case.width, "height": case.height, "sh_degree": 3, "packed": False}

    def forward(backend: str, dominance: bool) -> Tensor:
        return get_backend(backend).rasterization(**arguments, dominance=dominance)[0]

    def both(backend: str, dominance: bool) -> None:
        forward(backend, dominance).square().mean().backward()

    def timed(what: Callable[[str, bool], Any], dominance: bool) -> dict[str, float]:
        return turns_ms({name: partial(what, name, dominance) for name in backends()}, repeats)

    meta = get_backend("fast").rasterization(**arguments, counts=True)[2]
    return {
        **asdict(case),
        "forward_ms": timed(forward, False),
        "forward_dominance_ms": timed(forward, True),
        "forward_backward_ms": timed(both, False),
        "forward_backward_dominance_ms": timed(both, True),
        "contributing_per_pixel": float(meta["n_contrib"].float().mean()),
        "list_entries_per_pixel": float(meta["n_traversed"].float().mean()),
        "visible": int((meta["radii"] > 0).all(-1).sum()),
        "blend": [time_blend(case, tile, repeats) for tile in (16, 8)],
    }


def blend_of(case: Case, tile: int, backend: str = "fast") -> tuple[TileLists, list[Tensor], Callable[[], Composite]]:
    """Return a case's tile lists, its splats, and what blends them, differentiably, and nothing else."""
    scene, size = gaussians_of(case), (case.width, case.height)
    with torch.no_grad():
        _, _, meta = get_backend("fast").rasterization(
            **scene, width=size[0], height=size[1], sh_degree=3, packed=False
        )
    names = ("means2d", "conics", "opacities")
    splats = [meta[name][0].detach().clone().requires_grad_() for name in names]
    colors = torch.rand(case.n, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    exact = {"conics": meta["conics"][0], "opacities": meta["opacities"][0]}
    lists = tile_lists(meta["means2d"][0], meta["radii"][0], meta["depths"][0], *size, tile, **exact)
    blend = composite
    if backend == "compiled":
        from pop_fast.compiled.compositing import composite as blend
    return lists, [*splats, colors], lambda: blend(*splats, colors, lists, *size)


def time_blend(case: Case, tile: int, repeats: int) -> dict[str, Any]:
    """Time blending and its transpose alone, per evaluated (Gaussian, pixel) pair; every backend in turns."""
    blends = {name: blend_of(case, tile, name) for name in backends()}

    # a cotangent that is there already: what a loss costs is not the blend's
    v_image = torch.randn((case.height, case.width, 3), generator=torch.Generator().manual_seed(1))

    def both(splats: list[Tensor], blend: Callable[[], Composite]) -> None:
        torch.autograd.grad(blend().image, splats, v_image)

    ahead = turns_ms({name: blend for name, (_, _, blend) in blends.items()}, repeats)
    whole = turns_ms({name: partial(both, splats, blend) for name, (_, splats, blend) in blends.items()}, repeats)
    pairs = {name: blend().n_pairs for name, (_, _, blend) in blends.items()}
    return {
        "tile": tile,
        "entries": len(blends["fast"][0].ids),
        "pairs_per_pixel": {name: n / (case.width * case.height) for name, n in pairs.items()},
        "forward_ms": ahead,
        "forward_backward_ms": whole,
        "forward_ns_per_pair": {name: 1e6 * ahead[name] / n for name, n in pairs.items()},
        "forward_backward_ns_per_pair": {name: 1e6 * whole[name] / n for name, n in pairs.items()},
    }


def time_iteration(case: Case, repeats: int) -> dict[str, Any]:
    """Time whole training steps of POP on a synthetic capture with `case.n` Gaussians; every backend in turns."""
    capture = capture_of(case)
    with tempfile.TemporaryDirectory() as folder:
        runs = {name: run_of(case, f"{folder}/{name}", name) for name in backends()}
        return {**asdict(case), **_time_steps(runs, capture, repeats)}


def time_capture(path: str, factor: int, repeats: int) -> dict[str, Any]:
    """Time training steps of POP from the sparse points of a real capture, all bands active."""
    capture = load_capture(path, factor=factor)
    view = capture.views[0]
    with tempfile.TemporaryDirectory() as folder:
        runs = {name: _run(capture, f"{folder}/{name}", name) for name in backends()}
        steps = _time_steps(runs, capture, repeats)
    return {"capture": capture.name, "width": view.width, "height": view.height, **steps}


def run_of(case: Case, folder: str, backend: str = "fast") -> Any:
    """Return a training run whose Gaussians are a case's, of which some are opaque and their sizes differ."""
    scene, training = gaussians_of(case), _run(capture_of(case), folder, backend)
    with torch.no_grad():
        training.params["scales"].copy_(scene["scales"].log())
        training.params["opacities"].copy_(torch.logit(scene["opacities"].clamp(1e-4, 1.0 - 1e-4)))
    return training


def stepping(training: Any) -> Callable[[], Any]:
    """Return what takes one step of a run."""
    # `turn_about` calls this of checkouts too in which a run was called a trainer
    return getattr(training, "train_step", None) or (lambda: training.take_steps(training.step + 1))


def first_view(training: Any, capture: Capture) -> Rendered:
    """Return the first view of a capture as a run's Gaussians are now."""
    view = ViewTensors.of(capture.views[0])
    with torch.no_grad():
        return render_view(get_backend(training.config.backend), training.params, view, training.config, 0)


def _run(capture: Capture, folder: str, backend: Any) -> Any:
    at = str(Path(folder) / "run")
    config = TrainConfig(result_dir=at, sh_interval=1, log_every=10**9, progress=False, backend=backend)
    kind: Any = getattr(pop_fast.train, "TrainingRun", None) or vars(pop_fast.train)["Trainer"]
    return kind(config, capture)


def _time_steps(runs: dict[str, Any], capture: Capture, repeats: int) -> dict[str, Any]:
    with reproducible(torch.get_num_threads()):
        # what SSIM needs of a photograph is made at its first visit, so every photograph is visited once before
        taken = turns_ms({name: stepping(run) for name, run in runs.items()}, repeats, warm_up=len(capture.views))
        pairs = first_view(runs["fast"], capture).info["n_pairs"]
    view = capture.views[0]
    return {
        "iteration_ms": taken,
        "num_gaussians": len(runs["fast"].params["means"]),
        "pairs_per_pixel": pairs / (view.width * view.height),
    }


def measure_memory(backend: str) -> dict[str, Any]:
    """Measure, in a process of its own, the peak memory of one render and its backward."""
    code = f"import run; run.render_once(run.MEMORY_CASE, {backend!r})"
    here = Path(__file__).resolve().parent
    done = subprocess.run([sys.executable, "-c", code], cwd=here, capture_output=True, text=True, check=True)
    return {"backend": backend, **asdict(MEMORY_CASE), **json.loads(done.stdout)}


def render_once(case: Case, backend: str) -> None:
    """Render a case and its backward once, and print the peak memory of this process as JSON."""
    scene = gaussians_of(case)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    leaves = {name: scene[name].requires_grad_() for name in SCENE}
    start = time.perf_counter()
    image, _, meta = get_backend(backend).rasterization(
        **{**scene, **leaves}, width=case.width, height=case.height, sh_degree=3, packed=False, dominance=True
    )
    image.square().mean().backward()
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    pairs = meta["n_pairs"] / (case.width * case.height)
    print(
        json.dumps(
            {"peak_gib": peak / 2**20, "before_gib": before / 2**20, "seconds": seconds, "pairs_per_pixel": pairs}
        )
    )


def machine() -> dict[str, Any]:
    """Describe what the times were taken on."""
    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        model = next(
            (line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line), model
        )
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load_before": os.getloadavg()[0],
        "torch": torch.__version__,
        "capability": torch.backends.cpu.get_cpu_capability(),
        "python": platform.python_version(),
        "commit": commit(Path(__file__).resolve().parent),
    }


def commit(checkout: Path) -> str:
    """Return the commit that a checkout is at, empty where git does not know it."""
    asked = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()


def write_json(path: Path, result: dict[str, Any]) -> None:
    """Write results beside and rename, so that a file is whole or not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".part")
    beside.write_text(json.dumps(result, indent=2) + "\n")
    os.replace(beside, path)


def _gradient(leaf: Tensor) -> Tensor:
    assert leaf.grad is not None
    return leaf.grad


def main() -> None:
    """Run what is asked for and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "results" / "cpu.json")
    parser.add_argument("--only", choices=("raster", "iteration", "memory", "capture"), default=None)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--capture", default=None)
    parser.add_argument("--factor", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    keep_freed_memory()  # as `pop train` does
    result: dict[str, Any] = {"machine": machine(), "gate": gate()}
    wanted = {given.only} if given.only else {"raster", "iteration", "memory", "capture"}
    if "raster" in wanted:
        result["raster"] = [time_raster(case, given.repeats) for case in RASTER_CASES]
    if "iteration" in wanted:
        result["iteration"] = [time_iteration(case, given.repeats) for case in ITERATION_CASES]
    if "memory" in wanted:
        result["memory"] = [measure_memory(name) for name in backends()]
    if "capture" in wanted and given.capture:
        result["capture"] = time_capture(given.capture, given.factor, given.repeats)
    write_json(given.out, result)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
