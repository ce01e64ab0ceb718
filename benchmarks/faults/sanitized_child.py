"""In a process of its own: the compiled backend with the library of `POP_SANITIZED` in the place of its own."""

from __future__ import annotations

import os
from pathlib import Path

import torch

import pop_fast.compiled
from pop_fast import rasterization
from pop_fast.compiled import build, library
from pop_fast.data.load import load_capture
from pop_fast.train import TrainConfig, TrainingRun
from pop_ref.conformance.corpus import PLANS, corpus_scene

from .corpus import HERE


def main() -> None:
    """Put the library in, and use all of it."""
    path = Path(os.environ["POP_SANITIZED"])
    build.library_path = library.library_path = lambda: path  # type: ignore[assignment]
    if pop_fast.compiled.why_not() is not None:
        raise SystemExit("the sanitized library is not loaded")
    drawn = sum(_draw(name, dtype) for name in PLANS for dtype in (torch.float32, torch.float64))
    print(f"{drawn} renders with gradients")
    capture = load_capture(str(HERE / "colmap"))
    steps = 0
    for method in ("pop", "gsplat", "3dgs", "taming"):
        config = TrainConfig.of(
            method=method,
            preset="quick",
            max_steps=40,
            backend="compiled",
            threads=2,
            ssim_padding="same",
            test_every=3,
            progress=False,
            **{f"{method}.refine_start_iter": 2, f"{method}.refine_every": 5, f"{method}.grow_grad2d": 1e-6},
        )
        run = TrainingRun(config, capture)
        while run.step < 40:
            run.take_steps(run.step + 1)
        steps += run.step
    print(f"{steps} training steps in C++")
    loaded = Path("/proc/self/maps").read_text()
    if str(path) not in loaded or "/_blend_" in loaded:
        raise SystemExit("another library than the sanitized one was used")


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
    return 1


if __name__ == "__main__":
    main()
