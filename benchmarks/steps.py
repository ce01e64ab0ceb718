"""Renders and training steps of POP by every engine, in turns, after the gate: no speed is reported of a wrong backend.

Steps are taken as a user's run takes them, by a `TrainingRun` that asks its stepper for segments; the POP term,
dominance and the statistics of density control are on, and the Gaussians stay as they are. Of the native step it is
told where its time goes, of renders what the blend alone takes.
"""

from __future__ import annotations

import itertools
import math
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from cases import GATE_CASE, Case, capture_of, gaussians_of, median_ratio, turns, turns_ms
from torch import Tensor

from pop_fast.api.backend import backend_names, get_backend
from pop_fast.data import Capture, load_capture
from pop_fast.stages.compositing import Composite, composite
from pop_fast.stages.tiles import TileLists, tile_lists
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.environment import reproducible
from pop_fast.train.views import Rendered, ViewTensors, render_view
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render, render_vjp

# makes the run of an engine in a folder
Maker = Callable[[str, str], Any]
DEGREE = 3  # of synthetic cases: all bands, as in most of a run
STEPS, FEW_STEPS = 5, 1  # of a turn; few where a step takes long
LONG = 100_000  # Gaussians from which on it does
# ms on two cores, that the native step was built for
TARGETS = {"270x480-12k": 12.0, "270x480-40k": 20.0, "640x480-100k": 45.0, "1600x1000-300k": 250.0, "fox": 11.0}
LONE = "native, 1 thread"
# the largest relative difference from the oracle that the gate lets pass
GATE = {torch.float64: 1e-10, torch.float32: 5e-5}
SCENE = ("means", "quats", "scales", "opacities", "colors")


def engines() -> tuple[str, ...]:
    """Return what takes steps on a CPU here, slowest first: torch, autograd over compiled stages, the native step."""
    return (*backends(), "native") if "compiled" in backends() else backends()


def run_of_case(case: Case, folder: str, engine: str) -> Any:
    """Return a training run by an engine whose Gaussians are a case's."""
    return _with_gaussians(case, _run(capture_of(case), folder, DEGREE, engine=_engine(engine)))


def run_of(case: Case, folder: str, backend: str = "fast") -> Any:
    """Return a training run whose Gaussians are a case's, by what a checkout trains with for a backend's name."""
    return _with_gaussians(case, _run(capture_of(case), folder, DEGREE, backend=backend))


def first_view(training: Any, capture: Capture) -> Rendered:
    """Return the first view of a capture as a run's Gaussians are now."""
    view = ViewTensors.of(capture.views[0])
    with torch.no_grad():
        return render_view(get_backend(training.config.backend), training.params, view, training.config, 0)


def take_turn(training: Any, steps: int, threads: int) -> None:
    """Take steps of a run as its own loop does, with so many threads; 0 leaves their number as it is."""
    from pop_fast.train.schedule import segment_end

    if threads > 0:
        torch.set_num_threads(threads)
    last = training.step + steps
    while training.step < last:
        longest = min(training.stepper.longest, last - training.step)
        training.take_steps(segment_end(training.config, training.strategy, training.step, longest))


def _engine(name: str) -> Any:
    from pop_fast.train.engines import torch_engine, whole_engine

    if name == "native":
        return whole_engine()
    return torch_engine(name)


def _run(capture: Capture, folder: str, degree: int, engine: Any = None, **settings: Any) -> Any:
    # bands are activated one a step, or never
    interval = 1 if degree > 0 else 10**9
    config = TrainConfig(result_dir=folder, sh_interval=interval, log_every=10**9, progress=False, **settings)
    frozen = replace(config.strategy, refine_start_iter=config.strategy.refine_stop_iter)
    return TrainingRun(replace(config, strategy=frozen), capture, engine=engine)


def _with_gaussians(case: Case, training: Any) -> Any:
    """Give a run a case's Gaussians, of which some are opaque and their sizes differ."""
    scene = gaussians_of(case)
    with torch.no_grad():
        training.params["scales"].copy_(scene["scales"].log())
        training.params["opacities"].copy_(torch.logit(scene["opacities"].clamp(1e-4, 1.0 - 1e-4)))
    return training


def time_case(case: Case, repeats: int) -> dict[str, Any]:
    """Time steps on a synthetic capture with `case.n` Gaussians."""
    steps = FEW_STEPS if case.n > LONG else STEPS
    views = len(capture_of(case).views)
    found = _time_steps(lambda folder, engine: run_of_case(case, folder, engine), views, steps, repeats)
    return {**asdict(case), "degree": DEGREE, "target_ms": TARGETS.get(case.name), **found}


def capture_runs(path: str, factor: int, degree: int) -> tuple[Capture, Maker]:
    """Return a real capture, and what makes runs of an engine that start from its sparse points."""
    capture = load_capture(path, factor=factor)
    return capture, lambda folder, engine: _run(capture, folder, degree, engine=_engine(engine))


def time_capture(path: str, factor: int, degree: int, repeats: int) -> dict[str, Any]:
    """Time the first steps on a real capture: with colours of degree 0, as a run begins, or with all bands."""
    capture, make = capture_runs(path, factor, degree)
    view = capture.views[0]
    found = _time_steps(make, len(capture.views), STEPS, repeats)
    size = {"n": found["num_gaussians"], "width": view.width, "height": view.height}
    return {"name": capture.name, **size, "degree": degree, "target_ms": TARGETS.get(capture.name), **found}


def _time_steps(make: Maker, views: int, steps: int, repeats: int) -> dict[str, Any]:
    """Time turns of some steps by every engine; those of the native step also with one thread."""
    threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder, reproducible(threads):
        runs = {name: make(f"{folder}/{name}", name) for name in engines()}
        used = dict.fromkeys(runs, threads)
        if "native" in runs and threads > 1:
            runs[LONE], used[LONE] = make(f"{folder}/lone", "native"), 1
        takes = {name: lambda name=name: take_turn(runs[name], steps, used[name]) for name in runs}
        # what SSIM needs of a photograph is made at its first visit, so every photograph is visited once before
        turns(takes, 0, warm_up=math.ceil(views / steps) + 1)
        taken, parts = _timed_by_part(runs, takes, repeats)
        torch.set_num_threads(threads)
        found = {"num_gaussians": len(runs["fast"].params["means"]), "steps_a_turn": steps, "threads": threads}
        return {**found, **_times(taken, steps, threads), **_native_facts(runs, parts, steps)}


def _timed_by_part(
    runs: dict[str, Any], takes: dict[str, Callable[[], None]], repeats: int
) -> tuple[dict[str, list[float]], list[dict[str, float]]]:
    """Time turns, and by part those of the native step, seconds."""
    parts: list[dict[str, float]] = []

    def by_part(take: Callable[[], None]) -> None:
        trainer = runs["native"].stepper.fused
        before = trainer.seconds
        take()
        parts.append({part: after - before[part] for part, after in trainer.seconds.items()})

    if "native" in takes:
        native = takes["native"]
        takes = {**takes, "native": lambda: by_part(native)}
    return turns(takes, repeats, warm_up=0), parts


def _times(taken: dict[str, list[float]], steps: int, threads: int) -> dict[str, Any]:
    ms = {
        name: {"median": 1e3 * statistics.median(times) / steps, "minimum": 1e3 * min(times) / steps}
        for name, times in taken.items()
    }
    pairs = [("compiled", "fast"), ("native", "compiled"), ("native", "fast")]
    ratios = {f"{a} / {b}": median_ratio(taken[a], taken[b]) for a, b in pairs if a in taken}
    if LONE in taken:
        ratios["efficiency"] = median_ratio(taken[LONE], taken["native"]) / threads
    return {"ms": ms, "ratios": ratios}


def _native_facts(runs: dict[str, Any], parts: list[dict[str, float]], steps: int) -> dict[str, Any]:
    """Return what the native step's parts took, what it had to do in its last step, and what it works in."""
    if not parts:
        return {}
    trainer = runs["native"].stepper.fused
    ms = {part: 1e3 * statistics.median(turn[part] for turn in parts) / steps for part in parts[0]}
    return {"parts_ms": ms, "counts": trainer.counts(), "working_mib": trainer.bytes / 2**20}


def backends() -> tuple[str, ...]:
    """Return the CPU backends that can run here, the slowest first."""
    return tuple(name for name in ("fast", "compiled") if name in backend_names() and get_backend(name).available())


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
        found = [fast[0].detach(), *(leaf.grad for leaf in leaves.values())]
        apart = [np.abs(a.double().numpy() - b).max() / np.abs(b).max() for a, b in zip(found, expected, strict=True)]
        # unlike Python's, this maximum is none where one of them is no number
        error = float(np.max(apart))
        worst[f"{backend} {dtype}"] = error
        if not error <= bound:
            raise SystemExit(
                f"gate: {backend} {dtype} differs from the oracle by {error:.2e}, more than {bound:.0e}; "
                f"nothing was timed"
            )
    return worst
