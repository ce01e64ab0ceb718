"""What is measured: PSNR, SSIM, counts of the Gaussians, and averages."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from pop_fast.train.metrics import average, measure, population, psnr


def pictures(seed=0, height=40, width=30):
    g = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=g)
    return (target + 0.2 * torch.randn(height, width, 3, generator=g)), target


def test_psnr_is_scikit_images_on_the_clamped_render():
    image, target = pictures()
    want = peak_signal_noise_ratio(target.double().numpy(), image.clamp(0, 1).double().numpy(), data_range=1.0)
    assert psnr(image, target) == pytest.approx(want, rel=1e-6)


def test_psnr_of_equal_pictures_is_infinite_and_of_black_on_white_zero():
    white = torch.ones(4, 4, 3)
    assert psnr(white, white) == math.inf
    assert psnr(torch.zeros(4, 4, 3), white) == 0.0


def test_ssim_is_scikit_images_over_whole_windows():
    image, target = pictures()
    clamped = image.clamp(0, 1)
    _, full = structural_similarity(
        target.double().numpy(),
        clamped.double().numpy(),
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    assert measure(image, target).ssim == pytest.approx(full[5:-5, 5:-5].mean(), rel=1e-5)


def test_masked_pixels_do_not_count():
    image, target = pictures()
    mask = torch.ones(40, 30, dtype=torch.bool)
    mask[:, 20:] = False
    spoiled = image.clone()
    spoiled[:, 20:] = 1.0 - target[:, 20:].round()
    assert measure(spoiled, target, mask) == measure(image, target, mask)
    assert measure(spoiled, target, mask).psnr == pytest.approx(psnr(image[:, :20], target[:, :20]), rel=1e-6)


def test_averages_are_over_views_and_no_view_gives_null():
    measured = [measure(*pictures(seed)) for seed in (0, 1)]
    means = average(measured, [])
    assert means["psnr"] == pytest.approx(np.mean([m.psnr for m in measured]))
    assert means["lpips"] is None
    assert "lpips_vgg" in means["lpips_reason"]
    assert average([], [])["psnr"] is None


def test_the_population_is_counted_at_both_poles_and_at_the_floor():
    counts = population(torch.tensor([0.0, 1 / 255 - 1e-6, 1 / 255, 0.1, 0.5, 0.9, 0.95, 1.0]))
    assert counts == {"num_GS": 8, "num_GS_above_floor": 6, "opacity_below_0.1": 3 / 8, "opacity_above_0.9": 2 / 8}
    assert population(torch.zeros(0))["num_GS"] == 0
