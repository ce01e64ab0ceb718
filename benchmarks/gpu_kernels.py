"""Time the CUDA backend: rasterization, dominance, the fused step and each of its kernels.

    python benchmarks/gpu_kernels.py out.json [--cases 270k_1.6MP] [--scenes packed/scenes/garden.npz ...]

Correctness first: every case begins with the gradients of the two backward families, which must agree; where they do
not, `failed` says so. Every part of a case is written when it is there, and one that raises takes
nothing from the others. Times are medians of CUDA events after warm-up, in milliseconds; with each stands the sum of
the kernels' own times by the profiler, and with every kernel what it has to do at least and its floor on this card
(`gpu_predictions`). Wall times of a step hold value checks, waits of the host and Python's own time; the profiler's
sums compare kernels. `gpu_gsplat.py` adds gsplat's times.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch
from gpu_predictions import Card, Loads, elapsed_ms, floors, measured_card
from gpu_scenes import CASES, FULL_SIZE, TINY, GpuCase, scenes
from gpu_visits import count_tried, count_visits
from torch import Tensor

import cuda_ext
from cuda_ext.gpu_check.__main__ import commit_of
from cuda_ext.gpu_check.shared import write_json
from cuda_ext.render import lists
from cuda_ext.training import step_program
from cuda_ext.training.step_buffers import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.cuda import rasterization
from pop_fast.train.schedule import steady_updates
from pop_fast.train.steps import Phase, StepSettings

WARM_UP, REPEATS, STEPS = 5, 50, 200
LEAVES = ("means", "quats", "scales", "opacities", "sh")
BACKWARDS = ("pixel_parallel", "gaussian_parallel")
APART = 1e-2  # of the largest gradient, how far the two families may differ
PLAIN, POP = Phase(3, False, False, False), Phase(3, True, True, True)
# what a step launches, in order (`StepProgram.launch`)
KERNELS = (
    *("begin_step", "project", "count_tiles", "sort_by_depth", "number_instances", "make_tile_lists"),
    *("blend_forward", "photometric", "blend_backward", "count_important", "update", "end_step"),
)
HEAD_START = 5_000_000  # cycles the GPU waits before a step, longer than Python needs to launch one
LARGEST: Final = 12  # kernels that are listed by name
# waits that the benchmark itself puts before a step
_OURS = ("spin_kernel", "sleep")


# The fused step.


def raw_params(scene: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the raw parameters of an activated scene."""
    return {
        "means": scene["means"].clone(),
        "scales": scene["scales"].log(),
        "quats": scene["quats"].clone(),
        "opacities": torch.logit(scene["opacities"].clamp(1e-4, 1 - 1e-4)),
        "sh0": scene["sh"][:, :1].contiguous(),
        "shN": scene["sh"][:, 1:].contiguous(),
    }


def make_trainer(scene: dict[str, Tensor], photograph: Tensor, max_steps: int, **settings: Any) -> FusedTrainer:
    """Make a trainer whose steps all see one view, with rates so small that the scene stays as it is."""
    params = raw_params(scene)
    m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
    device = scene["means"].device
    views = ResidentViews([photograph], scene["viewmats"], scene["Ks"], None, "valid", device)
    chosen = StepSettings(steady_updates(dict.fromkeys(params, 1e-9), max_steps), **settings)
    return FusedTrainer(params, m, v, views, [0] * max_steps, chosen)


def whole_step(scene: dict[str, Tensor], photograph: Tensor, steps: int, **settings: Any) -> dict[str, float]:
    """Time whole training iterations as they are run in training, with and without what POP asks for."""
    trainer = make_trainer(scene, photograph, 4 * steps, **settings)
    found: dict[str, float] = {}
    for k, (name, phase) in enumerate({"step_with_pop_ms": POP, "step_ms": PLAIN}.items()):
        trainer.run((2 * k + 1) * steps, phase)
        found[name] = elapsed_ms(partial(trainer.run, (2 * k + 2) * steps, phase)) / steps
    return found


def step_kernels(scene: dict[str, Tensor], photograph: Tensor, steps: int, **settings: Any) -> dict[str, Any]:
    """Add up the times of a replayed plain step's kernels by the profiler."""
    trainer = make_trainer(scene, photograph, 3 * steps, **settings)
    trainer.run(steps, PLAIN)
    return kernel_sums(lambda: trainer.run(trainer.step + 1, PLAIN), calls=steps)


def step_loads(trainer: FusedTrainer) -> Loads:
    """Count what the trainer's last step had to do; it must have returned dominant Gaussians and counts."""
    ((size, stats),) = trainer.render_stats().items()
    width, height = size
    tiles = torch.nn.functional.pad(stats["n_traversed"], (0, -width % 16, 0, -height % 8)).view(-(-height // 8), 8, -1)
    longest = tiles.view(tiles.shape[0], 8, -1, 16).amax((1, 3))
    return Loads(
        trainer.n,
        int((trainer.splats["radii"] > 0).all(1).sum()),
        trainer.n_instances,
        int(longest.long().sum()) * 16 * 8,
        int(stats["n_blended"].long().sum()),
        width * height,
        int(longest.max()),
        *count_visits(trainer.lists()[size], trainer.splats, stats["n_traversed"]),
        count_tried(trainer.splats["means2d"], trainer.splats["radii"], width, height),
    )


@dataclass
class _TimedKernels:
    """The kernels, each between two events."""

    kernels: Any
    spans: dict[str, list[tuple[Any, Any]]] = field(default_factory=lambda: defaultdict(list))

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.kernels, name)
        return self._timed(name, found) if name in KERNELS else found

    def _timed(self, name: str, launch: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            if name == "begin_step":
                torch.cuda._sleep(HEAD_START)
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            result = launch(*arguments)
            end.record()
            self.spans[name].append((start, end))
            return result

        return run


@contextmanager
def _timed_kernels() -> Iterator[_TimedKernels]:
    load = step_program.load
    timed = _TimedKernels(load())
    for module in (step_program, lists):
        module.load = lambda: timed
    try:
        yield timed
    finally:
        for module in (step_program, lists):
            module.load = load


def kernel_times(
    scene: dict[str, Tensor], photograph: Tensor, steps: int, **settings: Any
) -> tuple[dict[str, float], Loads]:
    """Return the median time of every kernel of a POP step in ms, launched one by one, and what the step has to do."""
    trainer = make_trainer(scene, photograph, 2 * steps, replay=False, **settings)
    trainer.run(steps, POP)
    with _timed_kernels() as timed:
        trainer.run(2 * steps, POP)
    torch.cuda.synchronize()
    calls = {name: len(spans) // steps for name, spans in timed.spans.items()}
    times = {
        name: calls[name] * statistics.median(start.elapsed_time(end) for start, end in spans)
        for name, spans in timed.spans.items()
    }
    counted = make_trainer(scene, photograph, 1, replay=False, counts=True, **settings)
    counted.run(1, POP)
    return times, step_loads(counted)


def kernel_sums(run: Callable[[], Any], calls: int = 10) -> dict[str, Any]:
    """Run a few times under the profiler.

    Returns:
        `kernels_ms`: the sum of a call's kernels, copies and fills; `launches` of a call; `largest`: ms of a call by
        kernel's name, the largest first. Where the profiler saw nothing, or cannot work here, `skipped` alone.
    """
    run()
    torch.cuda.synchronize()
    try:
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            for _ in range(calls):
                run()
            torch.cuda.synchronize()
        events = list(profile.events() or [])
    # wall times are not lost to a profiler that is not allowed on a machine
    except (RuntimeError, AssertionError) as error:
        return {"skipped": f"the profiler cannot work here: {error}"}
    return summed(events, calls)


def summed(events: Iterable[Any], calls: int) -> dict[str, Any]:
    """Add up the profiler's events of the GPU; a region's name spans kernels that are counted already."""
    times: Counter[str] = Counter()
    launches = 0
    for event in events:
        on_gpu = event.device_type == torch.autograd.DeviceType.CUDA
        if not on_gpu or getattr(event, "is_user_annotation", False) or any(name in event.name for name in _OURS):
            continue
        times[event.name] += event.time_range.elapsed_us() / 1e3 / calls
        launches += 1
    if not launches:
        return {"skipped": "the profiler saw no kernels"}
    largest = {name[:80]: ms for name, ms in times.most_common(LARGEST)}
    return {"kernels_ms": sum(times.values()), "launches": launches / calls, "largest": largest}


# Cases, and what is written of them.


def timed(run: Callable[[], Any]) -> float:
    """Return the median time of a run in ms."""
    for _ in range(WARM_UP):
        run()
    return statistics.median(elapsed_ms(run) for _ in range(REPEATS))


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
    # one by one: the largest of numbers of which one is not a number may be any of them
    off = [f"{differ:.1e} in {name}" for name, differ in (apart or {}).items() if not differ < APART]
    if off:
        record.result.setdefault("failed", {})["families_differ"] = f"the backward families differ by {', '.join(off)}"
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


def about() -> dict[str, str]:
    """Say of which commit results are, and on what they were measured."""
    return {"commit": commit_of(None), "gpu": torch.cuda.get_device_name(), "torch": torch.__version__}


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
    results: dict[str, Any] = {**about(), "cases": {}}
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
