"""Time the CUDA backend: rasterization, dominance, the fused step and each of its kernels; gsplat beside it.

    python benchmarks/gpu_kernels.py out.json [--cases 270k_1.6MP] [--runs out/garden_pop ...]

Correctness first: the gradients of the two backward families must agree before anything is timed. Times are medians of
CUDA events after warm-up, in milliseconds. Beside every kernel stand what it has to do at least and its floor on this
card (`gpu_floors`); `ratios` are gsplat's times over ours, on the same tensors in the same run.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from gpu_floors import Card, floors, measured_card
from gpu_gsplat import gsplat_iteration
from gpu_scenes import CASES, GpuCase, activated_scene, trained_scene
from gpu_steps import kernel_times, whole_step
from torch import Tensor

import cuda_ext
from cuda_ext.ops import rasterization

WARM_UP, REPEATS, STEPS = 5, 50, 200
LEAVES = ("means", "quats", "scales", "opacities", "sh")
FAMILIES = ("columns", "splats")


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
) -> dict[str, float]:
    """Time the forward pass alone, and forward and backward together."""
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
    return {"forward_ms": alone, "forward_backward_ms": together, "backward_ms": together - alone}


def families_agree(scene: dict[str, Any], case: GpuCase) -> dict[str, float]:
    """Compare the gradients of the two families: the largest difference over the largest gradient."""
    found: list[dict[str, Any]] = []
    for family in FAMILIES:
        leaves = {**scene, **{name: scene[name].clone().requires_grad_() for name in LEAVES}}
        draw(rasterization, leaves, case, family=family)[0].square().mean().backward()
        found.append({name: leaves[name].grad for name in LEAVES})
    apart = {name: float((found[0][name] - found[1][name]).abs().max() / found[0][name].abs().max()) for name in LEAVES}
    worst = max(apart.values())
    if not worst < 1e-2:
        raise SystemExit(f"{case.name}: the two backward families differ by {apart}; nothing is timed")
    return apart


def photograph_of(scene: dict[str, Tensor], case: GpuCase) -> Tensor:
    """Make a photograph that differs from the scene's render everywhere, so that no gradient is zero."""
    image = draw(rasterization, scene, case)[0][0]
    g = torch.Generator(device=image.device).manual_seed(1)
    noise = 0.1 * torch.randn(image.shape, generator=g, device=image.device)
    return ((image + noise).clamp(0.0, 1.0) * 255.0).to(torch.uint8)


def by_kernel(scene: dict[str, Tensor], case: GpuCase, photograph: Tensor, card: Card, family: str) -> dict[str, Any]:
    """Time every kernel of a POP step, beside its work and floor."""
    times, loads = kernel_times(scene, photograph, STEPS // 4, family=family)
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


def measure(case: GpuCase, scene: dict[str, Tensor], card: Card) -> dict[str, Any]:
    """Measure one case."""
    result: dict[str, Any] = {"families_differ": families_agree(scene, case)}
    photograph = photograph_of(scene, case)
    for family in FAMILIES:
        result[f"{family}_by_kernel"] = by_kernel(scene, case, photograph, card, family)
        for deterministic in (True, False):
            options = {"family": family, "deterministic": deterministic}
            name = f"{family}{'' if deterministic else '_atomic'}"
            result[name] = forward_backward(rasterization, scene, case, **options)
            result[name] |= whole_step(scene, photograph, STEPS, **options)
    result["with_dominance"] = forward_backward(rasterization, scene, case, dominance=True)
    ours, told = result["columns"], result["with_dominance"]
    result["dominance_share"] = told["forward_ms"] / ours["forward_ms"] - 1.0
    result["deterministic_costs_ms"] = ours["step_ms"] - result["columns_atomic"]["step_ms"]
    if importlib.util.find_spec("gsplat") is not None:
        import gsplat

        result["gsplat_version"] = gsplat.__version__
        theirs = forward_backward(gsplat.rasterization, scene, case)
        theirs |= gsplat_iteration(gsplat.rasterization, scene, case, photograph, timed)
        result["gsplat"] = theirs
        names = ("forward_ms", "backward_ms", "forward_backward_ms", "step_ms")
        result["ratios"] = {name.removesuffix("_ms"): theirs[name] / ours[name] for name in names}
    if torch.cuda.is_available():
        result["peak_MiB"] = torch.cuda.max_memory_allocated() / 2**20
        torch.cuda.reset_peak_memory_stats()
    return result


def scenes(names: list[str] | None, runs: list[Path], device: torch.device) -> Iterator[tuple[GpuCase, dict[str, Any]]]:
    """Make the scenes asked for, one at a time."""
    for case in CASES:
        if names is None or case.name in names:
            yield case, activated_scene(case, device)
    for folder in runs:
        yield trained_scene(folder, device)


def main() -> int:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="the JSON file")
    parser.add_argument("--cases", nargs="*", choices=[case.name for case in CASES], help="default: all")
    parser.add_argument("--runs", nargs="*", type=Path, default=[], help="results of `pop train`, timed as well")
    args = parser.parse_args()
    reason = cuda_ext.why_not()
    if reason is not None:
        print(f"gpu_kernels: {reason}", file=sys.stderr)
        return 2
    device = torch.device("cuda")
    card = measured_card(device)
    results: dict[str, Any] = {"gpu": torch.cuda.get_device_name(), "torch": torch.__version__, "card": asdict(card)}
    results["cases"] = {}
    for case, scene in scenes(args.cases, args.runs, device):
        results["cases"][case.name] = measure(case, scene, card)
        args.out.write_text(json.dumps(results, indent=1) + "\n")
        print(json.dumps({case.name: results["cases"][case.name]}, indent=1), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
