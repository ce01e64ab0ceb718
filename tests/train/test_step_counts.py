"""What the native step says that it had to do is what a plain walk through the tile lists has to do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from pop_fast.api.registry import get_backend
from pop_fast.stages.tiles import TileLists, tile_lists
from pop_fast.train.schedule import steady_updates
from pop_fast.train.steps import Phase, StepSettings
from pop_ref.constants import PAPER
from pop_ref.settings import PARAMETERS

WIDTH, HEIGHT, TILE, CHUNK = 40, 24, 16, 16


@dataclass(frozen=True)
class Photo:
    """A photograph in front of which the Gaussians lie."""

    photo: torch.Tensor
    viewmat: torch.Tensor
    K: torch.Tensor
    mask: None = None


def gaussians(n: int = 400) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(5)
    z = rng.uniform(2.0, 6.0, n)
    xy = rng.uniform(-0.8, 0.8, (n, 2)) * z[:, None]
    # in the first tile they are so many and so opaque that all its pixels stop
    xy[: n // 2] = rng.uniform((-0.7, -0.5), (-0.1, 0.2), (n // 2, 2)) * z[: n // 2, None]
    opacities, scales = rng.normal(1.0, 2.0, n), rng.normal(-2.3, 0.7, (n, 3))
    opacities[: n // 2] += 4.0
    scales[: n // 2] += 1.0
    made = {
        "means": np.concatenate((xy, z[:, None]), 1),
        "scales": scales,
        "quats": rng.normal(size=(n, 4)),
        "opacities": opacities,
        "sh0": rng.normal(size=(n, 1, 3)),
        "shN": 0.1 * rng.normal(size=(n, 15, 3)),
    }
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in made.items()}


def view() -> Photo:
    K = torch.tensor([[[30.0, 0.0, WIDTH / 2], [0.0, 30.0, HEIGHT / 2], [0.0, 0.0, 1.0]]])
    photo = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    return Photo(photo, torch.eye(4)[None], K)


def listed(params: dict[str, torch.Tensor]) -> tuple[dict[str, np.ndarray], TileLists]:
    """Return splats in double precision, and their lists for the step's tiles."""
    p, seen = {name: value.double() for name, value in params.items()}, view()
    _, _, meta = get_backend("fast").rasterization(
        means=p["means"],
        quats=p["quats"],
        scales=p["scales"].exp(),
        opacities=p["opacities"].sigmoid(),
        colors=torch.cat((p["sh0"], p["shN"]), 1),
        viewmats=seen.viewmat.double(),
        Ks=seen.K.double(),
        width=WIDTH,
        height=HEIGHT,
        sh_degree=3,
        packed=False,
    )
    exact = {"conics": meta["conics"][0], "opacities": meta["opacities"][0]}
    lists = tile_lists(meta["means2d"][0], meta["radii"][0], meta["depths"][0], WIDTH, HEIGHT, TILE, **exact)
    return {name: meta[name][0].numpy() for name in ("means2d", "conics", "opacities")}, lists


def walked(splats: dict[str, np.ndarray], lists: TileLists) -> dict[str, int]:
    """Walk through the lists entry by entry, with T of every pixel."""
    did = dict.fromkeys(("walked", "chunks", "pairs", "reached"), 0)
    across = -(-WIDTH // TILE)
    for tile in range(len(lists.offsets) - 1):
        ids = lists.ids[lists.offsets[tile] : lists.offsets[tile + 1]].tolist()
        x = tile % across * TILE + np.arange(TILE) + 0.5
        y = (tile // across * TILE + np.arange(TILE) + 0.5)[:, None]
        T = np.where((x < WIDTH) & (y < HEIGHT), 1.0, 0.0)
        for first in range(0, len(ids), CHUNK):
            lit = (T > 0.0).any(1)
            if not lit.any():
                break
            chunk = ids[first : first + CHUNK]
            did["walked"] += len(chunk)
            did["chunks"] += 1
            did["pairs"] += len(chunk) * TILE * int(lit.sum())
            for i in chunk:
                dx, dy = splats["means2d"][i, 0] - x, splats["means2d"][i, 1] - y
                a, b, c = splats["conics"][i]
                raw = splats["opacities"][i] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                alpha = np.where(raw >= PAPER.alpha_floor, np.minimum(raw, PAPER.alpha_ceiling), 0.0)
                after = T * (1.0 - alpha)
                after = np.where(after > PAPER.transmittance_stop, after, 0.0)
                did["reached"] += int((after < T).any(1).sum())
                T = after
    return did


def test_counts_are_those_of_a_walk_through_the_lists() -> None:
    reason = get_backend("compiled").why_not()
    if reason is not None:
        pytest.skip(reason)
    from pop_fast.compiled.native_step import NativeTrainer

    params = gaussians()
    splats, lists = listed(params)
    expected = walked(splats, lists)
    m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
    settings = StepSettings(steady_updates(dict.fromkeys(PARAMETERS, 1e-3), 10), profile=PAPER)
    trainer = NativeTrainer(params, m, v, [view()], [0] * 10, settings, threads=2)
    assert set(trainer.counts().values()) == {0}
    trainer.run(1, Phase(3, pop=True, statistics=True, blur=True))
    found = trainer.counts()
    assert found["visible"] == len(set(lists.ids.tolist()))
    assert found["entries"] == len(lists.ids)
    assert {name: found[name] for name in expected} == expected
    # a parabola that errs lets too much through, never too little
    assert found["reached"] <= found["marked"] <= found["pairs"] // TILE
    assert found["walked"] < found["entries"]
