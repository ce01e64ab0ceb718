"""Time the CUDA backend: rasterization forward and backward by family, dominance, the fused step, and gsplat beside it.

    python benchmarks/gpu_kernels.py out.json [--cases 270k_1.6MP]

Correctness first: the gradients of the two families must agree before anything is timed. Times are medians of CUDA
events after warm-up, in milliseconds.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from gpu_scenes import CASES, GpuCase, activated_scene

import cuda_ext
from cuda_ext.ops import rasterization
from cuda_ext.resident import ResidentViews
from cuda_ext.train_settings import Phase, StepSettings
from cuda_ext.train_step import FusedTrainer

WARM_UP, REPEATS, STEPS = 5, 50, 200
LEAVES = ("means", "quats", "scales", "opacities", "sh")


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
    v = torch.rand((1, case.height, case.width, 3), device="cuda")

    def forward() -> None:
        with torch.no_grad():
            draw(function, leaves, case, **options)

    def both() -> None:
        for name in LEAVES:
            leaves[name].grad = None
        (draw(function, leaves, case, **options)[0] * v).sum().backward()

    alone, together = timed(forward), timed(both)
    return {"forward_ms": alone, "forward_backward_ms": together}


def loads(scene: dict[str, Any], case: GpuCase) -> dict[str, float]:
    """Count what there is to do: instances, splats blended and visited a pixel."""
    _, _, meta = draw(rasterization, scene, case, counts=True)
    visible = int((meta["radii"] > 0).all(-1).sum())
    return {
        "visible": visible,
        "instances_16px": len(meta["flatten_ids"]),
        "blended_per_pixel": float(meta["n_contrib"].float().mean()),
        "visited_per_pixel": float(meta["n_traversed"].float().mean()),
    }


def families_agree(scene: dict[str, Any], case: GpuCase) -> dict[str, float]:
    """Compare the gradients of the two families: the largest difference over the largest gradient."""
    found: list[dict[str, Any]] = []
    for family in ("columns", "splats"):
        leaves = {**scene, **{name: scene[name].clone().requires_grad_() for name in LEAVES}}
        draw(rasterization, leaves, case, family=family)[0].square().mean().backward()
        found.append({name: leaves[name].grad for name in LEAVES})
    apart = {name: float((found[0][name] - found[1][name]).abs().max() / found[0][name].abs().max()) for name in LEAVES}
    worst = max(apart.values())
    if not worst < 1e-2:
        raise SystemExit(f"{case.name}: the two backward families differ by {apart}; nothing is timed")
    return apart


def fused_step(scene: dict[str, Any], case: GpuCase, family: str, deterministic: bool) -> dict[str, float]:
    """Time whole training iterations at a fixed number of Gaussians, with and without dominance."""
    params = {
        "means": scene["means"].clone(),
        "scales": scene["scales"].log(),
        "quats": scene["quats"].clone(),
        "opacities": torch.logit(scene["opacities"].clamp(1e-4, 1 - 1e-4)),
        "sh0": scene["sh"][:, :1].contiguous(),
        "shN": scene["sh"][:, 1:].contiguous(),
    }
    m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
    image = (draw(rasterization, scene, case)[0][0].clamp(0, 1) * 255).to(torch.uint8)
    device = torch.device("cuda")
    views = ResidentViews([image], scene["viewmats"], scene["Ks"], None, "valid", device)
    lr = dict.fromkeys(params, 1e-6)
    settings = StepSettings(lr, 4 * STEPS, family=family, deterministic=deterministic)
    trainer = FusedTrainer(params, m, v, views, [0] * (4 * STEPS), settings)
    found: dict[str, float] = {}
    for k, tells in enumerate((True, False)):
        trainer.run((2 * k + 1) * STEPS, Phase(3, tells, tells, tells))
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        trainer.run((2 * k + 2) * STEPS, Phase(3, tells, tells, tells))
        end.record()
        end.synchronize()
        found["step_with_pop_ms" if tells else "step_ms"] = start.elapsed_time(end) / STEPS
    return found


def measure(case: GpuCase) -> dict[str, Any]:
    """Measure one case."""
    scene = activated_scene(case, torch.device("cuda"))
    result: dict[str, Any] = {"loads": loads(scene, case), "families_differ": families_agree(scene, case)}
    for family in ("columns", "splats"):
        for deterministic in (True, False):
            options = {"family": family, "deterministic": deterministic}
            name = f"{family}{'' if deterministic else '_atomic'}"
            result[name] = forward_backward(rasterization, scene, case, **options)
            result[name] |= fused_step(scene, case, family, deterministic)
    result["with_dominance"] = forward_backward(rasterization, scene, case, dominance=True)
    if importlib.util.find_spec("gsplat") is not None:
        import gsplat

        result["gsplat_version"] = gsplat.__version__
        result["gsplat"] = forward_backward(gsplat.rasterization, scene, case)
    result["peak_MiB"] = torch.cuda.max_memory_allocated() / 2**20
    return result


def main() -> int:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="the JSON file")
    parser.add_argument("--cases", nargs="+", choices=[case.name for case in CASES], help="default: all")
    args = parser.parse_args()
    reason = cuda_ext.why_not()
    if reason is not None:
        print(f"gpu_kernels: {reason}", file=sys.stderr)
        return 2
    results: dict[str, Any] = {"gpu": torch.cuda.get_device_name(), "torch": torch.__version__, "cases": {}}
    for case in CASES:
        if args.cases is None or case.name in args.cases:
            torch.cuda.reset_peak_memory_stats()
            results["cases"][case.name] = measure(case)
            args.out.write_text(json.dumps(results, indent=1) + "\n")
            print(json.dumps({case.name: results["cases"][case.name]}, indent=1), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
