"""The two ways through a step of the blend: their bits are the same, and they are the oracle's weights."""

from __future__ import annotations

import pytest
import torch

from pop_fast.transmittance import Stop, count_passed, weights_of_alphas
from pop_ref.constants import INRIA, PAPER

TILES, K, PIXELS = 7, 8, 9


def alphas(stopping: bool) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    alpha = 0.9 * torch.rand(TILES, K, PIXELS, generator=generator, dtype=torch.float64)
    return alpha if stopping else 0.3 * alpha


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("few", [True, False], ids=["few tiles stop", "most tiles stop"])
def test_all_tiles_alike_or_only_those_that_stop_give_the_same_bits(profile, few):
    alpha = alphas(stopping=not few)
    if few:
        alpha[2, :, 4] = 0.95
    stop = Stop.of(profile, alpha.dtype)
    found = []
    for crowded in (False, True):
        a, weight, light = alpha.clone(), torch.empty_like(alpha), torch.ones(TILES, PIXELS, dtype=torch.float64)
        stopping = weights_of_alphas(a, weight, light, light.clone(), stop, crowded)
        assert (stopping is None) == (crowded or not few)
        if few and not crowded:
            assert stopping is not None
            assert stopping.tolist() == [2]
        found.append((weight, light, a[weight > 0.0]))
    assert (found[0][1] == 0.0).any()
    assert all(torch.equal(x, y) for x, y in zip(*found, strict=True))


@pytest.mark.parametrize("crowded", [False, True])
def test_weights_light_and_passed_entries_are_the_oracles(crowded):
    alpha = alphas(stopping=True)
    alpha[alpha < 0.2] = 0.0
    weight, light = torch.empty_like(alpha), torch.ones(TILES, PIXELS, dtype=torch.float64)
    stop = Stop.of(PAPER, alpha.dtype)
    passed = count_passed(alpha, light, stop)
    weights_of_alphas(alpha.clone(), weight, light, light.clone(), stop, crowded)
    for tile in range(TILES):
        for pixel in range(PIXELS):
            T, expected, went_past = 1.0, [0.0] * K, 0
            for k in range(K):
                rest = T * (1.0 - float(alpha[tile, k, pixel]))
                if rest <= PAPER.transmittance_stop:
                    T = 0.0
                    break
                expected[k], T, went_past = T * float(alpha[tile, k, pixel]), rest, went_past + 1
            assert weight[tile, :, pixel].tolist() == pytest.approx(expected, abs=1e-15)
            assert float(light[tile, pixel]) == pytest.approx(T, abs=1e-15)
            assert int(passed[tile, pixel]) == went_past
