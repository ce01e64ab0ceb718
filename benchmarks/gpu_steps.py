"""The fused training step on the GPU, whole and kernel by kernel, by events and by the profiler.

Wall times hold value checks, waits of the host and Python's own time; the profiler's sums compare kernels.
"""

from __future__ import annotations

import statistics
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import torch
from gpu_predictions import Loads
from gpu_visits import count_tried, count_visits
from torch import Tensor

from cuda_ext.render import lists
from cuda_ext.training import step_program
from cuda_ext.training.step_buffers import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.train.schedule import steady_updates
from pop_fast.train.steps import Phase, StepSettings

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
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        trainer.run((2 * k + 2) * steps, phase)
        end.record()
        end.synchronize()
        found[name] = start.elapsed_time(end) / steps
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
        int((trainer.radii > 0).all(1).sum()),
        trainer.n_instances,
        int(longest.long().sum()) * 16 * 8,
        int(stats["n_blended"].long().sum()),
        width * height,
        int(longest.max()),
        *count_visits(trainer.lists()[size], trainer.splats, stats["n_traversed"]),
        count_tried(trainer.splats["means2d"], trainer.radii, width, height),
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
