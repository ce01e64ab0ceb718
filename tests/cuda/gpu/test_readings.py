"""Ten steps on the GPU beside the CPU's under other readings of what the paper leaves open (A1, A2, A12)."""

from __future__ import annotations

import pytest
import torch

from .scene import HEIGHT, STEPS, WIDTH, training_scene
from .steps import THETA, apart, fused, fused_trainer, on_the_cpu

READINGS = (
    {"pop_over": "visible"},
    {"pop_views": "window"},
    {"pop_over": "visible", "pop_views": "window"},
    {"blur_window": "any_view"},
)


@pytest.mark.parametrize("backward", ["pixel_parallel", "gaussian_parallel"])
@pytest.mark.parametrize("reading", READINGS, ids=lambda reading: "-".join(reading.values()))
def test_ten_fused_steps_under_another_reading_are_the_cpus(gpu, reading, backward):
    scene, strong = training_scene(), {"lambda_pop": 0.05}
    # no view shows all, and one shows others than the two beside it
    scene.params["means"][:16, 2] *= -1.0
    scene.viewmats[2, 0, 3] = 1.5
    window = reading.get("pop_views") == "window"
    losses, params, trainer = fused(scene, gpu, window, backward=backward, theta_blur=THETA, **strong, **reading)
    expected, terms, wanted, state = on_the_cpu(scene, **strong, **reading)
    torch.testing.assert_close(torch.tensor(losses), torch.tensor(expected), rtol=1e-4, atol=1e-6)
    told = torch.tensor([values[4] for values in trainer.step_stats(0, STEPS)])
    torch.testing.assert_close(told, torch.tensor(terms), rtol=1e-4, atol=1e-6)
    for name, value in wanted.items():
        assert apart(params[name], value, name) < 0.01, name
    found = trainer.statistics
    assert torch.equal(found.blurred.bool().cpu(), state["blurred"])
    if window:
        assert torch.equal(found.dominant_sum.long().cpu(), state["dominant_sum"])
    # and the reading matters here
    *_, usual, usual_state = on_the_cpu(scene, **strong)
    if "blur_window" in reading:
        assert 0 < int(usual_state["blurred"].sum()) < int(state["blurred"].sum())
    else:
        assert apart(usual["opacities"], wanted["opacities"], "opacities") > 0.05


def test_the_share_that_blurs_is_of_the_pixels_that_a_view_keeps(gpu):
    from pop_fast.train.steps import Phase

    scene = training_scene()
    masks = [None if k % 2 else torch.arange(WIDTH) < WIDTH // 4 for k in range(len(scene.photographs))]
    masks = [None if mask is None else mask.expand(HEIGHT, WIDTH) for mask in masks]
    _, trainer = fused_trainer(scene, gpu, masks, theta_blur=THETA, blur_window="own_view", replay=False)
    differs = 0
    for step in range(STEPS):
        trainer.run(step + 1, Phase(3, True, True, True))
        ((_, maps),) = trainer.render_stats().items()
        counts, masked = maps["dominant_counts"].cpu(), masks[scene.order[step]] is not None
        kept = WIDTH // 4 * HEIGHT if masked else WIDTH * HEIGHT
        assert torch.equal(trainer.statistics.blurred.bool().cpu(), counts > THETA * kept), step
        differs += int((counts > THETA * kept).sum() - (counts > THETA * WIDTH * HEIGHT).sum())
    assert differs > 0
