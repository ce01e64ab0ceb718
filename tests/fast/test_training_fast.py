"""The ladder of ten losses, climbed by what trains: renderer, losses, POP term, optimizers, density control."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pop_fast.losses import photometric_pop
from pop_fast.polarization import importance_mask, pop_loss
from pop_fast.rasterization import rasterization
from pop_ref.conformance.torch_training import Rows, Statistics, Trainer
from pop_ref.density import densifies_at
from pop_ref.optimizer import learning_rates, sh_degree_at
from tests.golden import ten_losses
from tests.golden.ten_losses import RECIPE, SCENE_SCALE, SIZE, STEPS, Rung

# float64 as the oracle itself (measured: 3e-16); float32 ten times the worst rung's error
RELATIVE = {torch.float64: 1e-9, torch.float32: 1.2e-6}


def nothing_seen(params: dict[str, torch.Tensor]) -> Statistics:
    n = len(params["means"])
    counts, flags = torch.zeros(n, dtype=torch.int64), torch.zeros(n, dtype=torch.bool)
    return Statistics(torch.zeros_like(params["opacities"]), counts, 0, counts, flags)


def climb(dtype: torch.dtype) -> list[Rung]:
    first = {name: torch.tensor(array, dtype=dtype) for name, array in ten_losses.first_params().items()}
    trainer = Trainer("pop_fast")
    rows, statistics = trainer.rows_from_params(first), nothing_seen(first)
    rungs = []
    for step in range(STEPS):
        camera = ten_losses.cameras()[step % 3]
        target = torch.tensor(ten_losses.photographs()[step % 3], dtype=dtype)
        leaves = {name: value.clone().requires_grad_() for name, value in rows.params.items()}
        opacities = torch.sigmoid(leaves["opacities"])
        images, _, meta = rasterization(
            *(leaves["means"], leaves["quats"], torch.exp(leaves["scales"]), opacities),
            torch.cat([leaves["sh0"], leaves["shN"]], dim=1),
            torch.tensor(camera.viewmat, dtype=dtype)[None],
            torch.tensor(camera.K, dtype=dtype)[None],
            *(SIZE, SIZE),
            sh_degree=sh_degree_at(step, RECIPE.sh_interval, 1),
            packed=False,
        )
        meta["means2d"].retain_grad()
        counts = meta["dominant_counts"][0]
        loss = photometric_pop(images[0], target, RECIPE.lambda_ssim, RECIPE.padding)
        if RECIPE.pop_start_iter <= step < RECIPE.pop_stop_iter:
            loss = loss + RECIPE.lambda_pop * pop_loss(opacities, importance_mask(counts))
        loss.backward()
        with torch.no_grad():
            grads = {name: leaf.grad for name, leaf in leaves.items()}
            rates = learning_rates(step, SCENE_SCALE, RECIPE.max_steps)
            rows = Rows(*trainer.adam_step(rows.params, grads, rows.m, rows.v, step + 1, rates))
            seen = ((meta["radii"][0] > 0).all(-1), counts, SIZE, SIZE)
            statistics = trainer.accumulate(statistics, meta["means2d"].grad[0], *seen, RECIPE.density)
            if densifies_at(step, RECIPE.density):
                rows, statistics = trainer.densify_and_prune(
                    *(rows, statistics, SCENE_SCALE, step),
                    lambda n: torch.tensor(ten_losses.draws(n), dtype=dtype),
                    RECIPE.density,
                )
        rungs.append(Rung(loss.item(), len(rows.params["means"])))
    return rungs


@pytest.mark.parametrize("dtype", RELATIVE)
def test_ten_losses_are_the_oracles(dtype: torch.dtype) -> None:
    rungs, written = climb(dtype), ten_losses.written()
    assert [rung.n for rung in rungs] == [rung.n for rung in written]
    np.testing.assert_allclose([r.loss for r in rungs], [r.loss for r in written], rtol=RELATIVE[dtype])


def test_two_climbs_give_the_same_bits() -> None:
    assert climb(torch.float32) == climb(torch.float32)
