"""Time the CUDA backend: rasterization, dominance, the fused step and each of its kernels.

    python benchmarks/gpu_kernels.py out.json [--cases 270k_1.6MP] [--scenes packed/scenes/garden.npz ...]

Correctness first: every case begins with the gradients of the two backward families, which must agree; where they do
not, `failed` says so. Every part of a case is written when it is there, and one that raises takes
nothing from the others. Times are medians of CUDA events after warm-up, in milliseconds; with each stands the sum of
the kernels' own times by the profiler, and with every kernel what it has to do at least and its floor on this card
(`gpu_predictions`). `gpu_gsplat.py` adds gsplat's times.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import traceback
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from gpu_predictions import Card, floors, measured_card
from gpu_scenes import CASES, FULL_SIZE, TINY, GpuCase, scenes
from gpu_steps import kernel_sums, kernel_times, step_kernels, whole_step
from torch import Tensor

import cuda_ext
from cuda_ext.gpu_check.shared import write_json
from pop_fast.cuda import rasterization

WARM_UP, REPEATS, STEPS = 5, 50, 200
LEAVES = ("means", "quats", "scales", "opacities", "sh")
BACKWARDS = ("pixel_parallel", "gaussian_parallel")
APART = 1e-2  # of the largest gradient, how far the two families may differ


def timed(run: Callable[[], Any]) -> float:
    """Return the median time of a run in ms."""
    for _ in range(WARM_UP):
        run()
    times: list[float] = []
    for _ in range(REPEATS):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        run()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def draw(function: Callable[..., Any], scene: dict[str, Any], case: GpuCase, **options: Any) -> Any:
    """Call a rasterization of gsplat's signature."""
    tensors = [scene[name] for name in (*LEAVES, "viewmats", "Ks")]
    return function(*tensors, case.width, case.height, sh_degree=3, packed=False, **options)


def forward_backward(
    function: Callable[..., Any], scene: dict[str, Any], case: GpuCase, **options: Any
) -> dict[str, Any]:
    """Time the forward pass alone, and forward and backward together, with the sums of their kernels."""
    leaves = {**scene, **{name: scene[name].clone().requires_grad_() for name in LEAVES}}
    v = torch.rand((1, case.height, case.width, 3), device=scene["means"].device)

    def forward() -> None:
        with torch.no_grad():
            draw(function, leaves, case, **options)

    def both() -> None:
        for name in LEAVES:
            leaves[name].grad = None
        (draw(function, leaves, case, **options)[0] * v).sum().backward()

    alone, together = timed(forward), timed(both)
    found: dict[str, Any] = {"forward_ms": alone, "forward_backward_ms": together, "backward_ms": together - alone}
    return found | {"forward_kernels": kernel_sums(forward), "forward_backward_kernels": kernel_sums(both)}


def families_differ(scene: dict[str, Any], case: GpuCase) -> dict[str, float]:
    """Compare the gradients of the two families: the largest difference over the largest gradient."""
    found: list[dict[str, Any]] = []
    for backward in BACKWARDS:
        leaves = {**scene, **{name: scene[name].clone().requires_grad_() for name in LEAVES}}
        draw(rasterization, leaves, case, backward=backward)[0].square().mean().backward()
        found.append({name: leaves[name].grad for name in LEAVES})
    return {name: float((found[0][name] - found[1][name]).abs().max() / found[0][name].abs().max()) for name in LEAVES}


def photograph_of(scene: dict[str, Tensor], case: GpuCase) -> Tensor:
    """Return the scene's own photograph, or make one that differs from its render, so that no gradient is zero."""
    if "photograph" in scene:
        return scene["photograph"]
    image = draw(rasterization, scene, case)[0][0]
    g = torch.Generator(device=image.device).manual_seed(1)
    noise = 0.1 * torch.randn(image.shape, generator=g, device=image.device)
    return ((image + noise).clamp(0.0, 1.0) * 255.0).to(torch.uint8)


def by_kernel(scene: dict[str, Tensor], photograph: Tensor, card: Card, backward: str) -> dict[str, Any]:
    """Time every kernel of a POP step, with its work and floor."""
    times, loads = kernel_times(scene, photograph, max(STEPS // 4, 1), backward=backward)
    least = floors(loads, card)
    pixels = loads.pixels
    return {
        "loads": asdict(loads),
        "evaluated_per_pixel": loads.evaluated / pixels,
        "contributing_per_pixel": loads.contributing / pixels,
        "kernels": {name: {"ms": ms, **least.get(name, {})} for name, ms in times.items()},
        "sum_ms": sum(times.values()),
        "floor_ms": sum(entry["floor_ms"] for entry in least.values()),
    }


class Record:
    """What has been measured of one case, written down as soon as a part of it is there.

    Args:
        result: is filled.
        write: writes the whole file.
    """

    def __init__(self, result: dict[str, Any], write: Callable[[], None]) -> None:
        self.result, self._write = result, write

    def part(self, name: str, measured: Callable[[], Any], keep: bool = True) -> Any:
        """Measure a part, or make what is not kept; what it raises is recorded under `failed`, and None returned."""
        try:
            found = measured()
            if keep:
                self.result[name] = found
        # a benchmark that ends the process takes the other parts with it no more than one that raises
        except (Exception, SystemExit) as error:
            found = None
            message = "".join(traceback.format_exception_only(error)).strip()
            self.result.setdefault("failed", {})[name] = message[:1000]
        self._write()
        return found


def measure(case: GpuCase, scene: dict[str, Tensor], card: Card, record: Record) -> None:
    """Measure one case, the parts that matter most first."""
    apart = record.part("families_differ", lambda: families_differ(scene, case))
    worst = max((apart or {}).values(), default=0.0)
    if not worst < APART:
        record.result.setdefault("failed", {})["families_differ"] = f"the backward families differ by {worst:.1e}"
    photograph = record.part("photograph", lambda: photograph_of(scene, case), keep=False)
    if photograph is None:
        return
    for backward in BACKWARDS:
        record.part(f"{backward}_by_kernel", lambda backward=backward: by_kernel(scene, photograph, card, backward))
    for deterministic in (True, False):
        for backward in BACKWARDS:
            options = {"backward": backward, "deterministic": deterministic}
            name = f"{backward}{'' if deterministic else '_atomic'}"

            def both(options: dict[str, Any] = options) -> dict[str, Any]:
                found = forward_backward(rasterization, scene, case, **options)
                found |= whole_step(scene, photograph, STEPS, **options)
                return found | {"step_kernels": step_kernels(scene, photograph, max(STEPS // 10, 1), **options)}

            record.part(name, both)
    record.part("with_dominance", lambda: forward_backward(rasterization, scene, case, dominance=True))
    record.part("shares", lambda: shares(record.result))
    record.part("peak_MiB", peak_mib)


def shares(result: dict[str, Any]) -> dict[str, float]:
    """Say what dominant Gaussians and bits that repeat cost."""
    ours, with_dominance = result["pixel_parallel"], result["with_dominance"]
    return {
        "dominance_share": with_dominance["forward_ms"] / ours["forward_ms"] - 1.0,
        "deterministic_costs_ms": ours["step_ms"] - result["pixel_parallel_atomic"]["step_ms"],
    }


def peak_mib() -> float | None:
    """Return the most memory that was in use since the last call, MiB."""
    if not torch.cuda.is_available():
        return None
    peak = torch.cuda.max_memory_allocated() / 2**20
    torch.cuda.reset_peak_memory_stats()
    return peak


def arguments(summary: str | None) -> argparse.Namespace:
    """Read which cases to time, and where to."""
    parser = argparse.ArgumentParser(description=(summary or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="the JSON file")
    names = [case.name for case in (*CASES, TINY)]
    parser.add_argument("--cases", nargs="*", choices=names, help="synthetic ones; default: all but tiny")
    parser.add_argument("--device", default="cuda", help="where tensors are; the emulated kernels take cpu")
    parser.add_argument("--full-size", type=float, default=FULL_SIZE, help="px, which smaller scenes are enlarged to")
    parser.add_argument("--scenes", nargs="*", type=Path, default=[], help="packed scenes (npz), timed as well")
    return parser.parse_args()


def main() -> int:
    """Run the benchmark from the command line."""
    args = arguments(__doc__)
    reason = cuda_ext.why_not()
    if reason is not None:
        print(f"gpu_kernels: {reason}", file=sys.stderr)
        return 2
    device = torch.device(args.device)
    results: dict[str, Any] = {"gpu": torch.cuda.get_device_name(), "torch": torch.__version__, "cases": {}}
    card = measured_card(device)
    results["card"] = asdict(card)
    return over_scenes(args, results, device, lambda case, scene, record: measure(case, scene, card, record))


def over_scenes(
    args: argparse.Namespace,
    results: dict[str, Any],
    device: torch.device,
    measured: Callable[[GpuCase, dict[str, Tensor], Record], None],
) -> int:
    """Measure one scene after the other; return the exit status, 1 where something of one failed."""
    for name, make in scenes(args.cases, args.scenes, device, args.full_size):
        result: dict[str, Any] = {}
        record = Record(result, lambda: write_json(args.out, results))
        results["cases"][name] = result
        made = record.part("scene", make, keep=False)
        if made is None and not result:
            del results["cases"][name]
            continue
        if made is not None:
            case, scene = made
            result |= {"n": case.n, "width": case.width, "height": case.height}
            record.part("case", lambda case=case, scene=scene, record=record: measured(case, scene, record), keep=False)
        print(json.dumps({name: result}), flush=True)
        if "failed" in result:
            print(f"{name}: failed: {result['failed']}", file=sys.stderr, flush=True)
    cases = results["cases"].values()
    return 1 if not cases or any("failed" in found for found in cases) else 0


if __name__ == "__main__":
    sys.exit(main())
