"""The first half minute on a card: an image against the oracle's, and fused steps of which no graph is made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pop_fast.cuda import rasterization
from pop_fast.train.steps import Phase, StepStats
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render
from tests.cuda.gpu.scene import HEIGHT, WIDTH, assert_same_bits, drawn, fused_trainer, training_scene


@pytest.mark.parametrize("backward", ["pixel_parallel", "gaussian_parallel"])
def test_a_render_is_the_oracles(gpu, backward):
    scene = training_scene()
    p = {name: value.to(gpu) for name, value in scene.params.items()}
    image, alphas, _ = drawn(rasterization, p, scene, views=[0], backward=backward)
    p |= {"scales": p["scales"].exp(), "opacities": torch.sigmoid(p["opacities"])}
    sh = torch.cat((p["sh0"], p["shN"]), 1)
    rows = [value.cpu().double().numpy() for value in (p["means"], p["quats"], p["scales"], p["opacities"], sh)]
    camera = Camera(scene.viewmats[0].double().numpy(), scene.Ks[0].double().numpy(), WIDTH, HEIGHT)
    expected = render(Gaussians(*rows), camera)
    assert expected.image.std() > 0.1
    np.testing.assert_allclose(image[0].cpu().numpy(), expected.image, atol=2e-4)
    np.testing.assert_allclose(1.0 - alphas[0, ..., 0].cpu().numpy(), expected.T_final, atol=2e-4)


def test_fused_steps_launched_one_by_one_give_the_same_bits_twice_and_learn(gpu):
    found = []
    for _ in range(2):
        scene = replace(training_scene(), order=[0] * 4)
        (params, _, _), trainer = fused_trainer(scene, gpu, steps=4, replay=False)
        trainer.run(4, Phase(3, True, True, True))
        losses = [StepStats(*values).objective for values in trainer.step_stats(0, 4)]
        assert losses[-1] < losses[0]
        found.append(params)
    assert_same_bits(*found)
