"""What the GPU is timed on: synthetic scenes with the loads of trained ones, and trained scenes that were packed.

A packed scene is one npz file, which needs NumPy alone to be read: `means`, `quats`, `scales`, `opacities` and `sh` of
activated Gaussians (`sh` in half precision), `viewmats` [C, 4, 4], `Ks` [C, 3, 3] and `sizes` [C, 2] (width, height) of
its cameras, and `photograph`, the first camera's, where it was small enough to come along.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

GAUSSIANS = ("means", "quats", "scales", "opacities", "sh")
FULL_SIZE: Final = 1.6e6  # px; a smaller trained scene is timed as large as this too


@dataclass(frozen=True)
class GpuCase:
    """How much there is to draw."""

    name: str  # of the case
    n: int  # Gaussians
    # px
    width: int
    height: int
    # median of the shorter standard deviations on the screen, px; 0 for a trained scene, which is not made so
    size: float
    seen: float = 0.59  # share of the Gaussians in front of the camera's frustum; the others stand outside it
    gathered: float = 0.65  # share of the seen ones that stand in clusters, so that some tiles have many and others few

    def smaller(self, by: int) -> GpuCase:
        """Return a case of the same density and sizes in px, on an image smaller by that factor along both sides."""
        name = f"{self.name}_{by}x_smaller"
        return replace(self, name=name, n=self.n // by**2, width=self.width // by, height=self.height // by)


# the first is the one that times were predicted for: 160,000 visible, 2 million instances of 16 x 8 px tiles, 120
# evaluated and 35 contributing pairs a pixel. Counted by the emulated kernels, the whole of it: 157,934 visible,
# 2,004,926 instances, 119.2 and 35.7 pairs; tests/cuda/emulated/test_gpu_benchmark.py counts a part of it
CASES = (
    GpuCase("270k_1.6MP", 270_000, 1552, 1032, 1.05),
    GpuCase("1M_1.6MP", 1_000_000, 1552, 1032, 0.55),
    GpuCase("3M_1.6MP", 3_000_000, 1552, 1032, 0.32),
)
TINY = GpuCase("tiny", 40, 40, 24, 2.0, seen=1.0, gathered=0.0)
CLUSTERS = 24
# a case and its tensors, or None where there is nothing to be made
Scene = tuple[GpuCase, dict[str, Tensor]]
MakeScene = Callable[[], Scene | None]
LONGER = 9.5  # than the other two axes: what makes a splat reach many tiles and cover little of them


def activated_scene(case: GpuCase, device: torch.device) -> dict[str, Tensor]:
    """Return means, quats, scales, opacities, sh, viewmats and Ks on the device, activated.

    The numbers are drawn on the CPU, so that the scene that is timed is the one whose loads were counted.
    """
    g = torch.Generator().manual_seed(0)
    focal = 0.8 * case.width
    n, n_seen = case.n, round(case.n * case.seen)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=g)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=g)

    # places on the screen in widths and heights from its middle: everywhere, around centres, and off the screen
    place = uniform(n, 2) - 0.5
    centers, member = 0.8 * (uniform(CLUSTERS, 2) - 0.5), torch.randint(0, CLUSTERS, (n,), generator=g)
    n_gathered = round(n_seen * case.gathered)
    place[:n_gathered] = centers[member[:n_gathered]] + 0.06 * normal(n_gathered, 2)
    place[n_seen:, 0] += torch.where(uniform(n - n_seen) < 0.5, 1.5, -1.5)
    depth = 2.0 + 8.0 * uniform(n)
    means = torch.stack((place[:, 0] * case.width / focal * depth, place[:, 1] * case.height / focal * depth, depth), 1)
    # log-normal, in pixels at the Gaussian's depth: some are much larger than most, and all are longer than wide
    scales = case.size * torch.exp(0.6 * normal(n, 1) + 0.3 * normal(n, 3)) * (depth / focal)[:, None]
    scales[:, 0] *= LONGER
    sh = 0.1 * normal(n, 16, 3)
    sh[:, 0] = 1.5 * normal(n, 3)
    # polarised, as POP leaves them: most near one, the others low
    opacities = torch.where(uniform(n) < 0.65, 0.9 + 0.1 * uniform(n), 0.3 * uniform(n))
    K = torch.tensor([[focal, 0, case.width / 2], [0, focal, case.height / 2], [0, 0, 1.0]])
    # the order of rows in memory says nothing of where they stand
    shuffled = torch.randperm(n, generator=g)
    rows = {"means": means, "quats": normal(n, 4), "scales": scales, "opacities": opacities, "sh": sh}
    scene = {name: value[shuffled] for name, value in rows.items()}
    scene |= {"viewmats": torch.eye(4)[None], "Ks": K[None]}
    return {name: value.contiguous().to(device) for name, value in scene.items()}


def packed_scene(path: Path, device: torch.device, pixels: float | None = None) -> Scene | None:
    """Read a packed scene as its first camera sees it: at its own size, or as large as `pixels`, if that is more.

    A trained scene's lists are as unequal as real ones are, which no synthetic scene can promise.
    """
    with np.load(path) as file:
        found: dict[str, Any] = {name: file[name] for name in file.files}
    width, height = (int(side) for side in found["sizes"][0])
    scene = {name: torch.from_numpy(found[name].astype(np.float32)).to(device) for name in GAUSSIANS}
    scene |= {name: torch.from_numpy(found[name][:1].astype(np.float32)).to(device) for name in ("viewmats", "Ks")}
    n = len(scene["means"])
    if pixels is None:
        photograph = {name: torch.from_numpy(found[name]).to(device) for name in ("photograph",) if name in found}
        return GpuCase(path.stem, n, width, height, 0.0), scene | photograph
    if width * height > pixels / 2:
        return None
    by = math.sqrt(pixels / (width * height))
    wide, high = (round(by * side / 16) * 16 for side in (width, height))
    scene["Ks"][:, 0] *= wide / width
    scene["Ks"][:, 1] *= high / height
    return GpuCase(f"{path.stem}_enlarged", n, wide, high, 0.0), scene


def scenes(
    names: list[str] | None, packed: list[Path], device: torch.device, full_size: float = FULL_SIZE
) -> Iterator[tuple[str, MakeScene]]:
    """Name the scenes asked for, and how each is made: the predicted case, the packed ones, larger synthetic ones."""
    chosen = [case for case in (*CASES, TINY) if case.name in (names or [case.name for case in CASES])]

    def synthetic(case: GpuCase) -> tuple[str, MakeScene]:
        return case.name, lambda: (case, activated_scene(case, device))

    yield from map(synthetic, chosen[:1])
    for path in packed:
        yield path.stem, lambda path=path: packed_scene(path, device)
        yield f"{path.stem}_enlarged", lambda path=path: packed_scene(path, device, full_size)
    yield from map(synthetic, chosen[1:])
