"""In a process of its own: the library of `POP_SANITIZED` in the place of the compiled backend's."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import torch

import pop_fast.compiled
from pop_fast import rasterization
from pop_fast.api.backends import COMPILED
from pop_fast.compiled import build, library
from pop_fast.compiled.native_step import NativeTrainer
from pop_fast.data.load import load_capture
from pop_fast.stages.stage_set import PassInput
from pop_fast.stages.types import Camera, Gaussians
from pop_fast.train import TrainConfig, TrainingRun
from pop_ref.conformance.corpus import PLANS, corpus_scene
from pop_ref.constants import PAPER

from .corpus import HERE

# that the native step knows, and whose passes call every function of scores.cpp between them
METHODS = ("pop", "gsplat", "3dgs", "taming", "pup", "mini-splatting", "speedy-splat")


def main() -> None:
    """Put the library in, and use all of it."""
    what, path = sys.argv[1], Path(os.environ["POP_SANITIZED"])
    _compiled(path, threads=4 if what == "threads" else 2, steps=24 if what == "threads" else 40)
    loaded = Path("/proc/self/maps").read_text()
    if str(path) not in loaded or "/_blend_" in loaded:
        raise SystemExit("another library than the sanitized one was used")


def _compiled(path: Path, threads: int, steps: int) -> None:
    build.library_path = library.library_path = lambda: path  # type: ignore[assignment]
    # threads of torch's OpenMP wait for one another where no sanitizer sees it: those of the library are its own
    library._fork = lambda: None
    if pop_fast.compiled.why_not() is not None:
        raise SystemExit("the sanitized library is not loaded")
    torch.set_num_threads(threads)
    drawn = sum(_draw(name, dtype) for name in PLANS for dtype in (torch.float32, torch.float64))
    print(f"{drawn} renders with gradients and all passes")
    capture = load_capture(str(HERE / "colmap"))
    print(f"{sum(_train(capture, method, threads, steps) for method in METHODS)} training steps in C++")


def _train(capture: object, method: str, threads: int, steps: int) -> int:
    plan = {"refine_start_iter": 2, "refine_every": 5, "grow_grad2d": 1e-6}
    config = TrainConfig.of(
        method=method,
        preset="paper",
        steps_scaler=steps / 30_000,
        backend="compiled",
        threads=threads,
        ssim_padding="same",
        test_every=3,
        progress=False,
        **{f"{method}.{name}": value for name, value in plan.items()},
    )
    run = TrainingRun(config, capture)  # type: ignore[arg-type]
    while run.step < config.max_steps:
        run.take_steps(run.step + 1)
    fused = getattr(run.stepper, "fused", None)
    if not isinstance(fused, NativeTrainer):
        raise SystemExit(f"{method} was not trained by the native step")
    if method == "pop" and not fused.counts()["entries"]:
        raise SystemExit("the last step had nothing to do")
    return run.step


def _draw(name: str, dtype: torch.dtype) -> int:
    scene = corpus_scene(name)
    gaussians, camera = scene.gaussians, scene.camera

    def tensor(array: object) -> torch.Tensor:
        return torch.as_tensor(array, dtype=dtype)

    inputs = [
        tensor(getattr(gaussians, key)).requires_grad_() for key in ("means", "quats", "scales", "opacities", "sh")
    ]
    degree = int(gaussians.sh.shape[1] ** 0.5) - 1
    image, alpha, _ = rasterization(
        **dict(zip(("means", "quats", "scales", "opacities", "colors"), inputs, strict=True)),
        viewmats=tensor(camera.viewmat)[None],
        Ks=tensor(camera.K)[None],
        width=camera.width,
        height=camera.height,
        sh_degree=degree,
        backend="compiled",
        packed=False,
        dominance=True,
    )
    (image.square().sum() + alpha.sum()).backward()
    if not all(torch.isfinite(one.grad).all() for one in inputs if one.grad is not None):
        raise SystemExit(f"{name}: a gradient is not finite")
    view = Camera(tensor(camera.viewmat), tensor(camera.K), camera.width, camera.height)
    shot = PassInput(
        Gaussians(*(one.detach() for one in inputs)), view, degree, torch.zeros(3, dtype=dtype), PAPER, False
    )
    passes = COMPILED.open_view(shot)
    passes.contributions(None)
    passes.contributions(torch.ones((camera.height, camera.width), dtype=dtype))
    passes.sensitivities()
    passes.fisher_blocks()
    passes.dominant_points()
    return 1


if __name__ == "__main__":
    main()
