"""A step of the blend, pixel by pixel: weights, the light that is left and the entries passed are the oracle's."""

from __future__ import annotations

import pytest
import torch

from pop_fast.stages.blend.blend import Stop, count_passed, weights_of_alphas
from pop_ref.constants import INRIA, PAPER
from pop_ref.pixel import stops

TILES, K, PIXELS = 7, 8, 9


def alphas(share: float) -> torch.Tensor:
    """Return alphas between 0 and `share`, a fifth of them 0."""
    generator = torch.Generator().manual_seed(3)
    alpha = torch.rand(TILES, K, PIXELS, generator=generator, dtype=torch.float64)
    return torch.where(alpha < 0.2, 0.0, share * alpha)


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("share", [1.0, 0.3], ids=["many pixels stop", "one pixel stops"])
def test_weights_light_and_passed_entries_are_the_oracles(profile, share):
    alpha = alphas(share)
    alpha[2, :, 4] = 0.95
    lights = torch.full((TILES, K + 1, PIXELS), 7.0, dtype=torch.float64)
    lights[:, 0] = torch.linspace(0.0, 1.0, PIXELS)
    light, masked, stop = lights[:, 0].clone(), alpha.clone(), Stop.of(profile, alpha.dtype)
    passed = count_passed(alpha, light, stop)
    weight = weights_of_alphas(masked, lights, stop)
    rests = torch.threshold(lights[:, -1], stop.at, 0.0)
    stopped = 0
    for tile in range(TILES):
        for pixel in range(PIXELS):
            T, expected, went_past = float(light[tile, pixel]), [0.0] * K, 0
            for k in range(K):
                rest = T * (1.0 - float(alpha[tile, k, pixel]))
                if stops(rest, profile):
                    T = 0.0
                    break
                expected[k], T, went_past = T * float(alpha[tile, k, pixel]), rest, went_past + 1
            stopped += went_past < K
            assert weight[tile, :, pixel].tolist() == pytest.approx(expected, abs=1e-15)
            assert float(rests[tile, pixel]) == pytest.approx(T, abs=1e-15)
            assert int(passed[tile, pixel]) == went_past
            assert masked[tile, :went_past, pixel].tolist() == alpha[tile, :went_past, pixel].tolist()
            assert not masked[tile, went_past:, pixel].any()
    # the first pixel of each tile is dark from the beginning
    assert stopped > 20 if share == 1.0 else stopped == TILES + 1
