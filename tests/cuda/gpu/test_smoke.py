"""The first half minute on a card: an image against the oracle's, and fused steps of which no graph is made."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pop_ref.records import Camera, Gaussians
from pop_ref.render import render
from tests.cuda.gpu.scene import HEIGHT, LR, WIDTH, training_scene


@pytest.mark.parametrize("backward", ["pixel_parallel", "gaussian_parallel"])
def test_a_render_is_the_oracles(gpu, backward):
    from pop_fast.cuda import rasterization

    scene = training_scene()
    p = {name: value.to(gpu) for name, value in scene.params.items()}
    p |= {"scales": p["scales"].exp(), "opacities": torch.sigmoid(p["opacities"])}
    sh = torch.cat((p["sh0"], p["shN"]), 1)
    view = (scene.viewmats[:1].to(gpu), scene.Ks[:1].to(gpu), WIDTH, HEIGHT)
    image, alphas, _ = rasterization(
        p["means"], p["quats"], p["scales"], p["opacities"], sh, *view, sh_degree=3, backward=backward
    )
    rows = [value.cpu().double().numpy() for value in (p["means"], p["quats"], p["scales"], p["opacities"], sh)]
    camera = Camera(scene.viewmats[0].double().numpy(), scene.Ks[0].double().numpy(), WIDTH, HEIGHT)
    expected = render(Gaussians(*rows), camera)
    assert expected.image.std() > 0.1
    np.testing.assert_allclose(image[0].cpu().numpy(), expected.image, atol=2e-4)
    np.testing.assert_allclose(1.0 - alphas[0, ..., 0].cpu().numpy(), expected.T_final, atol=2e-4)


def test_fused_steps_launched_one_by_one_give_the_same_bits_twice_and_learn(gpu):
    from cuda_ext.training.step_buffers import ResidentViews
    from cuda_ext.training.train_step import FusedTrainer
    from pop_fast.train.schedule import steady_updates
    from pop_fast.train.steps import Phase, StepSettings, StepStats

    found = []
    for _ in range(2):
        scene = training_scene()
        params = {name: value.to(gpu).clone() for name, value in scene.params.items()}
        m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
        views = ResidentViews(scene.photographs, scene.viewmats, scene.Ks, None, "valid", gpu)
        trainer = FusedTrainer(params, m, v, views, [0] * 4, StepSettings(steady_updates(LR, 4), replay=False))
        trainer.run(4, Phase(3, True, True, True))
        losses = [StepStats(*values).objective for values in trainer.step_stats(0, 4)]
        assert losses[-1] < losses[0]
        found.append(params)
    for name, value in found[0].items():
        assert torch.equal(value, found[1][name]), name
