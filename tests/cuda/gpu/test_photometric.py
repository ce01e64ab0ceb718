"""The loss kernels beside float64: sizes around a block's 32 pixels, both borders, masks, both pixelwise terms."""

from __future__ import annotations

import pytest
import torch

SIZES = [(11, 12), (32, 32), (33, 31), (21, 70), (70, 43)]


def _photographs(height: int, width: int, masked: bool):
    g = torch.Generator().manual_seed(height + width)
    smooth = torch.linspace(0, 9, width)[None, :, None] + torch.linspace(0, 7, height)[:, None, None]
    target = (smooth.sin() * 0.4 + 0.5 + 0.1 * torch.rand((height, width, 3), generator=g)).clamp(0, 1)
    photograph = (255 * target).round().to(torch.uint8)
    # brighter than white and darker than black in places, as renders are
    image = 1.3 * (target + 0.2 * torch.randn((height, width, 3), generator=g)) - 0.1
    mask = torch.rand((height, width), generator=g) < 0.9 if masked else None
    return photograph, image, mask


def _found(device, photograph, image, mask, padding, l1, weights, cache):
    from cuda_ext import load
    from cuda_ext.arrays import fill, new_state, stream_of
    from cuda_ext.training.resident import MARGIN, ResidentViews

    kernels, (height, width) = load(), photograph.shape[:2]
    masks = None if mask is None else [mask]
    views = ResidentViews([photograph], torch.eye(4)[None], torch.eye(3)[None], masks, padding, device, cache)
    shapes = {"windows": (9, height, width), "v_image": (height, width, 3)}
    shapes |= {"partials": (kernels.loss_blocks(width, height), 3), "values": (kernels.N_VALUES,)}
    made = {name: torch.full(shape, float("nan"), device=device) for name, shape in shapes.items()}
    arrays = fill(kernels.LossArrays(), image=image.to(device), width=width, height=height, **made)
    settings = fill(kernels.LossSettings(), pixelwise_weight=weights[0], ssim_weight=weights[1])
    settings.margin = MARGIN if padding == "valid" else 0
    settings.set_pixelwise(l1)
    state = new_state(device)
    kernels.photometric(views.photographs(), arrays, settings, state.data_ptr(), stream_of(device))
    return made["values"].cpu().double()[:4], made["v_image"].cpu().double()


@pytest.mark.parametrize("cache", [True, False])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("padding", "l1"), [("valid", False), ("same", True)])
@pytest.mark.parametrize("size", SIZES)
def test_values_and_gradient_are_those_of_float64(gpu, size, padding, l1, masked, cache):
    from pop_fast.stages import losses

    photograph, image, mask = _photographs(*size, masked)
    weights = (0.7, 0.3)
    values, v_image = _found(gpu, photograph, image, mask, padding, l1, weights, cache)
    leaf, target = image.double().requires_grad_(), photograph.double() / 255.0
    pixelwise = (losses.l1 if l1 else losses.l2)(leaf, target, mask)
    ssim = losses.ssim(leaf, target, padding, mask)
    objective = weights[0] * pixelwise + weights[1] * (1.0 - ssim)
    objective.backward()
    square = losses.l2(leaf.detach().clamp(0, 1), target, mask)
    wanted = torch.stack((pixelwise, ssim, objective, square)).detach()
    torch.testing.assert_close(values, wanted, rtol=2e-6, atol=2e-6)
    torch.testing.assert_close(v_image, leaf.grad, rtol=1e-4, atol=1e-5 * float(leaf.grad.abs().max()))


def test_a_mask_that_keeps_nothing_compares_nothing(gpu):
    photograph, image, _ = _photographs(40, 40, False)
    values, v_image = _found(
        gpu, photograph, image, torch.zeros(40, 40, dtype=torch.bool), "valid", False, (1, 1), True
    )
    assert values.tolist() == [0.0, 1.0, 0.0, 0.0]
    assert not bool(v_image.any())


def test_two_runs_give_the_same_bits(gpu):
    photograph, image, mask = _photographs(70, 43, True)
    first, second = (_found(gpu, photograph, image, mask, "valid", False, (1, 1), True) for _ in range(2))
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))
