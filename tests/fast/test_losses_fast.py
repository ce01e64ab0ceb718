"""The fast losses: their options, masks, bands and threads, and what autograd makes of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pop_fast import compiled
from pop_fast.compiled import losses as compiled_losses
from pop_fast.stages import losses, ssim
from pop_ref import ssim as oracle_ssim
from tests.fast.loss_cases import Case, bands_of, both

NAMES = ("l1", "l2", "ssim", "d_ssim", "photometric_3dgs", "photometric_pop")
COMPILED = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")
FLOAT64 = 1e-12


@pytest.mark.parametrize(("name", "scale"), [("photometric_3dgs", "l1_scale"), ("photometric_pop", "l2_scale")])
def test_every_option_of_the_objectives_means_what_it_means_in_the_oracle(name: str, scale: str) -> None:
    case = Case(13, 12)
    for options in ({"lambda_ssim": 0.5}, {"halved": True}, {scale: 0.125}, {"lambda_ssim": 0.0}, {"lambda_ssim": 1.0}):
        value, v_image, loss, grad = both(name, case, torch.float64, **options)
        assert loss == pytest.approx(value, rel=FLOAT64)
        np.testing.assert_allclose(grad, v_image, atol=FLOAT64)


@pytest.mark.parametrize("name", NAMES)
def test_transposes_are_what_autograd_does(name: str) -> None:
    x, y = Case(13, 12, seed=2).tensors(torch.float64)
    image = x.clone().requires_grad_()
    (getattr(losses, name)(image, y) * 3.0).backward()
    torch.testing.assert_close(getattr(losses, name + "_vjp")(x, y, 3.0), image.grad, rtol=1e-14, atol=1e-18)


@COMPILED
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_compiled_bits_do_not_depend_on_the_number_of_threads(dtype: torch.dtype, masked: bool) -> None:
    case, before = Case(90, 47, masked=masked), torch.get_num_threads()
    (x, y), mask = case.tensors(dtype), case.mask()
    kept = None if mask is None else torch.tensor(mask)
    results = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            image = x.clone().requires_grad_()
            loss = compiled_losses.d_ssim(image, y, mask=kept)
            loss.backward()
            results.append((loss.item(), image.grad))
    finally:
        torch.set_num_threads(before)
    assert results[0][0] > 0.01
    for value, grad in results[1:]:
        assert value == results[0][0]
        assert torch.equal(grad, results[0][1])


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_similarity_maps_are_the_oracles(padding: str) -> None:
    x, y = Case(20, 14, seed=3).images()
    with bands_of(1):
        ours = losses.ssim_map(torch.tensor(x), torch.tensor(y), padding)
    np.testing.assert_allclose(ours.numpy(), oracle_ssim.ssim_map(x, y, padding), atol=FLOAT64)


def test_window_and_constants_are_the_oracles() -> None:
    np.testing.assert_allclose(ssim.gaussian_window().numpy(), oracle_ssim.gaussian_window(), rtol=1e-15)
    for name in ("WINDOW_SIZE", "WINDOW_SIGMA", "C1", "C2"):
        assert getattr(ssim, name) == getattr(oracle_ssim, name)


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_bands_change_no_bit_of_the_gradient(padding: str) -> None:
    x, y = Case(60, 17, seed=4).tensors()
    whole = losses.photometric_pop_vjp(x, y, 1.0, padding=padding)
    for band in (1, 17 * 3 * 13, 17 * 3 * 25):
        with bands_of(band):
            assert torch.equal(losses.photometric_pop_vjp(x, y, 1.0, padding=padding), whole)


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_kept_moments_change_no_bit(padding: str) -> None:
    x, y = Case(21, 17, seed=5).tensors()
    moments = losses.target_moments(y, padding)
    for _ in range(2):
        assert torch.equal(losses.ssim(x, y, padding, moments=moments), losses.ssim(x, y, padding))
        assert torch.equal(losses.ssim_vjp(x, y, 1.0, padding, moments=moments), losses.ssim_vjp(x, y, 1.0, padding))


def test_two_runs_give_the_same_bits_and_leave_their_arguments_alone() -> None:
    x, y = Case(40, 30, seed=6).tensors()
    copies = x.clone(), y.clone()
    first, second = (losses.photometric_3dgs_vjp(x, y, 1.0) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(x, copies[0])
    assert torch.equal(y, copies[1])


def test_no_value_is_read_from_memory_that_was_never_written() -> None:
    x, y = Case(24, 19, seed=7).tensors()
    clean = [losses.photometric_pop_vjp(x, y, 1.0, padding=padding) for padding in ("valid", "same")]
    torch.use_deterministic_algorithms(True)
    try:
        # under this setting torch fills what torch.empty returns with NaN
        assert torch.utils.deterministic.fill_uninitialized_memory
        poisoned = [losses.photometric_pop_vjp(x, y, 1.0, padding=padding) for padding in ("valid", "same")]
    finally:
        torch.use_deterministic_algorithms(False)
    assert all(torch.equal(a, b) for a, b in zip(clean, poisoned, strict=True))


def test_pixels_that_are_left_out_may_be_anything() -> None:
    x, y = Case(14, 15, seed=8).tensors(torch.float64)
    mask = torch.rand(14, 15, generator=torch.Generator().manual_seed(0)) < 0.5
    poisoned = torch.where(mask[:, :, None], x, torch.nan)
    for name in NAMES:
        loss, vjp = getattr(losses, name), getattr(losses, name + "_vjp")
        assert torch.equal(loss(poisoned, y, mask=mask), loss(x, y, mask=mask))
        v_image = vjp(poisoned, y, 1.0, mask=mask)
        assert torch.all(v_image[~mask] == 0.0)
        assert torch.equal(v_image, vjp(x, y, 1.0, mask=mask))


def test_a_mask_that_keeps_nothing_leaves_no_loss_and_no_gradient() -> None:
    x, y = Case(12, 12, seed=9).tensors(torch.float64)
    nothing = torch.zeros(12, 12, dtype=torch.bool)
    assert losses.ssim(x, y, mask=nothing) == 1.0
    for name in ("l1", "l2", "d_ssim", "photometric_3dgs", "photometric_pop"):
        assert getattr(losses, name)(x, y, mask=nothing) == 0.0
        assert not torch.any(getattr(losses, name + "_vjp")(x, y, 1.0, mask=nothing))


def test_a_strided_view_of_a_render_is_taken_as_it_is() -> None:
    x, y = Case(12, 13, 4, seed=10).tensors(torch.float64)
    render = x.clone().requires_grad_()
    losses.photometric_pop(render[:, :, :3], y[:, :, :3]).backward()
    expected = losses.photometric_pop_vjp(x[:, :, :3].contiguous(), y[:, :, :3].contiguous(), 1.0)
    torch.testing.assert_close(render.grad[:, :, :3], expected, rtol=1e-14, atol=0.0)
    assert not torch.any(render.grad[:, :, 3])


def test_without_gradients_no_graph_is_made() -> None:
    x, y = Case(12, 12, seed=11).tensors(torch.float64)
    assert not losses.photometric_pop(x, y).requires_grad
    with torch.no_grad():
        assert not losses.photometric_pop(x.clone().requires_grad_(), y).requires_grad


def test_unfit_arguments_are_refused_with_the_fix() -> None:
    x = torch.zeros(12, 12, 3)
    small = torch.zeros(10, 12, 3)
    for call, message in (
        (lambda: losses.l2(x, x[:, :11]), r"image is \[12, 12, 3\] but target is \[12, 11, 3\]"),
        (lambda: losses.l1(x[0], x[0]), r"must be \[H, W, D\]"),
        (lambda: losses.ssim(small, small), "use padding='same' or a larger image"),
        (lambda: losses.ssim(x, x, "reflect"), "padding is 'reflect'"),
        (lambda: losses.l2(x, x.clone().requires_grad_()), r"pass target.detach\(\)"),
        (lambda: losses.l2(x, x, torch.ones(12, 11, dtype=torch.bool)), "mask is"),
        (lambda: losses.l2(x, x, torch.ones(12, 12)), "it must be bool"),
        (lambda: losses.ssim(x, x, moments=losses.target_moments(x, "same")), "moments are of another"),
        (lambda: losses.ssim(x, x, moments=losses.target_moments(x.double())), "moments are of another"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
