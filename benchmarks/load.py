"""Captures and splats as large as people have them, in a stated amount of memory.

python -m benchmarks.load [--only CASE] [--scale S] [--out FILE]

Each case is made from a seed in a temporary folder and done by a child process whose peak is measured, its import of
torch included. The bound is stated beforehand, as bytes of a pixel, of a Gaussian and of the program:

    1,000 photographs    640 x 480, loaded and trained on for three steps
    4K photographs       24 of 3840 x 2160, loaded at full size and trained on for three steps
    3M Gaussians         a PLY of them with all colour bands, loaded and rendered at 1920 x 1080

Writes benchmarks/results/load.json, of which docs/reliability.md has the table; exit status 1 where a peak is above its
bound. A case that is done alone replaces its own result; with --scale, which makes fewer photographs and Gaussians,
results go to --out alone.
"""

from __future__ import annotations

import argparse
import json
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.record import machine, peak_bytes, read_json, write_json
from pop_fast import rasterization
from pop_fast.api.backend import get_backend
from pop_fast.children import module_command
from pop_fast.data.load import load_capture
from pop_fast.io.formats import load_splat_file
from pop_fast.io.ply import save_ply
from pop_fast.train import TrainConfig, TrainingRun

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "load.json"
STEPS, POINTS, FOCAL = 3, 5_000, 0.8
# bytes: of the program with torch; of a pixel of all photographs (kept as 8-bit colours, with room for the one that is
# decoded); of a pixel of the image that is drawn, with its gradients and what SSIM keeps; of a Gaussian that is drawn:
# 59 numbers as they are in the file, as parameters and as they are drawn, and its share of the tile lists
PROGRAM, PHOTOGRAPHS, DRAWN, TRAINED, RENDERED = 0.5 * 2**30, 3.5, 200.0, 5_000.0, 600.0


@dataclass(frozen=True)
class Case:
    """A load."""

    photographs: int  # of the capture; 0 renders a splat
    gaussians: int  # of the splat, or points of the capture
    # of a photograph or of the render, px
    width: int
    height: int

    def scaled(self, scale: float) -> Case:
        """Return the same with fewer photographs, or Gaussians where there are none."""
        if self.photographs:
            return replace(self, photographs=max(round(self.photographs * scale), 3))
        return replace(self, gaussians=round(self.gaussians * scale))

    @property
    def bound(self) -> float:
        """Return the memory that it may take at most, GiB."""
        pixels = self.width * self.height
        each = TRAINED if self.photographs else RENDERED
        return (PROGRAM + PHOTOGRAPHS * pixels * self.photographs + DRAWN * pixels + each * self.gaussians) / 2**30


CASES = {
    "1,000 photographs": Case(1_000, POINTS, 640, 480),
    "4K photographs": Case(24, POINTS, 3840, 2160),
    "3M Gaussians": Case(0, 3_000_000, 1920, 1080),
}


def make(case: Case, folder: Path) -> None:
    """Write the capture or the splat."""
    random = np.random.default_rng(0)
    if not case.photographs:
        save_ply(folder / "splat.ply", _cloud(case.gaussians))
        return
    (folder / "images").mkdir()
    (folder / "sparse" / "0").mkdir(parents=True)
    ys, xs = np.mgrid[: case.height, : case.width].astype(np.float32) / case.width
    for k in range(case.photographs):
        colors = [127.5 + 100.0 * np.sin(9.0 * xs + 5.0 * ys + channel + 0.01 * k) for channel in range(3)]
        cv2.imwrite(str(folder / "images" / f"{k:05d}.jpg"), np.stack(colors, axis=-1).astype(np.uint8))
    _write_model(case, random.uniform((-2.0, -2.0, 4.0), (2.0, 2.0, 8.0), (case.gaussians, 3)), folder / "sparse" / "0")


def _write_model(case: Case, points: np.ndarray, model: Path) -> None:
    focal, size = FOCAL * case.width, (case.width, case.height)
    camera = struct.pack("<QiiQQdddd", 1, 1, 1, *size, focal, focal, size[0] / 2, size[1] / 2)
    (model / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", case.photographs)
    for k in range(case.photographs):
        pose = (1.0, 0.0, 0.0, 0.0, np.sin(0.1 * k), np.cos(0.13 * k), 0.0)
        images += struct.pack("<i7di", k + 1, *pose, 1) + f"{k:05d}.jpg\0".encode() + struct.pack("<Q", 0)
    (model / "images.bin").write_bytes(images)
    rows = [struct.pack("<Q3d3BdQ", k, *xyz, 200, 100, 50, 0.5, 0) for k, xyz in enumerate(points, 1)]
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))


def _cloud(n: int) -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=random)

    means = 1.5 * normal(n, 3) + torch.tensor([0.0, 0.0, 6.0])
    raw = {"means": means, "scales": 0.4 * normal(n, 3) - 5.0, "quats": normal(n, 4), "opacities": 2.0 * normal(n)}
    return {**raw, "sh0": normal(n, 1, 3), "shN": 0.1 * normal(n, 15, 3)}


def do(case: Case, folder: Path) -> dict[str, Any]:
    """Do the work of a case in this process."""
    backend = "fast" if get_backend("compiled").why_not() else "compiled"
    if not case.photographs:
        return {**_render(case, folder / "splat.ply", backend), "backend": backend}
    capture = load_capture(str(folder))
    options = {"max_steps": STEPS, "backend": backend, "progress": False, "target_cache_mb": 0}
    run = TrainingRun(TrainConfig.of(preset="quick", **options), capture)
    run.take_steps(1)
    run.take_steps(STEPS)
    return {"backend": backend, "views": len(capture.views)}


@torch.no_grad()
def _render(case: Case, path: Path, backend: str) -> dict[str, Any]:
    params = load_splat_file(path).params
    focal = FOCAL * case.width
    K = torch.tensor([[[focal, 0.0, case.width / 2], [0.0, focal, case.height / 2], [0.0, 0.0, 1.0]]])
    image, alpha, meta = rasterization(
        params["means"],
        params["quats"],
        params["scales"].exp_(),
        params["opacities"].sigmoid_(),
        torch.cat([params.pop("sh0"), params.pop("shN")], dim=1),
        torch.eye(4)[None],
        K,
        case.width,
        case.height,
        sh_degree=3,
        packed=False,
        backend=backend,
    )
    if not torch.isfinite(image).all() or not alpha.mean() > 0.1:
        raise SystemExit("the render is empty or not finite")
    return {"pairs": int(meta["n_pairs"])}


def measured(name: str, case: Case) -> dict[str, Any]:
    """Do a case in a child and return its peak with its bound."""
    with tempfile.TemporaryDirectory() as folder:
        make(case, Path(folder))
        start = time.perf_counter()
        command = module_command("benchmarks.load", "--child", folder, *map(str, asdict(case).values()))
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=HERE.parent)
    if done.returncode != 0:
        raise SystemExit(f"{name}: ended with {done.returncode}: {done.stderr[-3000:]}")
    seconds = time.perf_counter() - start
    return {**asdict(case), **json.loads(done.stdout), "bound_gib": case.bound, "seconds": seconds}


def _child(folder: Path, case: Case) -> None:
    found = do(case, folder)
    print(json.dumps({**found, "peak_gib": peak_bytes() / 2**30}))


def main(words: list[str]) -> int:
    """Run from the command line."""
    if words[:1] == ["--child"]:
        _child(Path(words[1]), Case(*map(int, words[2:])))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=tuple(CASES), action="append")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--out", type=Path, help="default: the published results, where --scale is 1")
    args = parser.parse_args(words)
    now, out = machine(), args.out or (RESULTS if args.scale == 1.0 else None)
    cases = {
        name: {**measured(name, CASES[name].scaled(args.scale)), "commit": now["commit"]} for name in args.only or CASES
    }
    if out is not None:
        write_json(out, {"machine": now, "cases": {**read_json(out).get("cases", {}), **cases}})
    for name, found in cases.items():
        print(f"{name}: {found['peak_gib']:.2f} GiB of {found['bound_gib']:.2f} GiB, {found['seconds']:.0f} s")
    above = [name for name, found in cases.items() if found["peak_gib"] > found["bound_gib"]]
    for name in above:
        print(f"{name}: above its bound")
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
