"""The fast losses: their options, masks, bands and threads, and what autograd makes of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from pop_fast import compiled
from pop_fast.compiled import losses as compiled_losses
from pop_fast.stages import losses
from pop_fast.stages.regularizers import importance_mask, pop_loss, pop_loss_vjp
from pop_ref import losses as oracle_losses
from pop_ref import polarization as oracle
from pop_ref import ssim as oracle_ssim
from pop_ref.magnitudes import Form, LossMagnitudes, d_ssim_magnitudes, pixelwise_magnitudes

NAMES = ("l1", "l2", "ssim", "d_ssim", "photometric_3dgs", "photometric_pop")
COMPILED = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")
FLOAT64 = 1e-12


@contextmanager
def bands_of(values: int) -> Iterator[None]:
    before = losses._BAND_VALUES
    losses._BAND_VALUES = values
    try:
        yield
    finally:
        losses._BAND_VALUES = before


class Case(NamedTuple):
    """A pair of images to compare; small when printed."""

    height: int = 12
    width: int = 12
    channels: int = 3
    kind: str = "noisy"
    seed: int = 0
    masked: bool = False
    padding: str = "valid"

    def images(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a render and a photograph whose values float32 holds exactly."""
        rng = np.random.default_rng(self.seed)
        y = rng.random((self.height, self.width, self.channels))
        if self.kind == "flat":
            y = np.full_like(y, 0.75)
        if self.kind == "black and white":
            y = np.round(y)
        noise = {"close": 1e-3, "equal": 0.0}.get(self.kind, 0.25)
        x = rng.random(y.shape) if self.kind == "unrelated" else y + noise * rng.normal(size=y.shape)
        return x.astype(np.float32).astype(np.float64), y.astype(np.float32).astype(np.float64)

    def tensors(self, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
        x, y = self.images()
        return torch.tensor(x, dtype=dtype), torch.tensor(y, dtype=dtype)

    def mask(self) -> np.ndarray | None:
        return np.random.default_rng(self.seed).random((self.height, self.width)) < 0.75 if self.masked else None

    def options(self, name: str) -> dict[str, str]:
        return {} if name in ("l1", "l2") else {"padding": self.padding}


def cases() -> st.SearchStrategy[Case]:
    common = {
        "channels": st.sampled_from([3, 1, 4]),
        "kind": st.sampled_from(["noisy", "close", "equal", "flat", "black and white", "unrelated"]),
        "seed": st.integers(0, 2**16),
        "masked": st.booleans(),
    }
    whole, any_size = st.integers(11, 24), st.integers(1, 24)
    inside = st.builds(Case, whole, whole, **common, padding=st.just("valid"))
    return inside | st.builds(Case, any_size, any_size, **common, padding=st.just("same"))


def both(
    name: str, case: Case, dtype: torch.dtype, module: ModuleType = losses, **options
) -> tuple[float, np.ndarray, float, np.ndarray]:
    """Return value and gradient of the oracle_losses, then of the fast loss."""
    options, (x, y), mask = {**case.options(name), **options}, case.images(), case.mask()
    value = getattr(oracle_losses, name)(x, y, mask=mask, **options)
    v_image = getattr(oracle_losses, name + "_vjp")(x, y, 1.0, mask=mask, **options)
    image = torch.tensor(x, dtype=dtype, requires_grad=True)
    kept = None if mask is None else torch.tensor(mask)
    loss = getattr(module, name)(image, torch.tensor(y, dtype=dtype), mask=kept, **options)
    loss.backward()
    assert loss.dtype == image.grad.dtype == dtype
    return value, v_image, loss.item(), image.grad.numpy()


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
    np.testing.assert_allclose(np.outer(losses._TAPS, losses._TAPS), oracle_ssim.gaussian_window(), rtol=1e-15)
    for name in ("WINDOW_SIZE", "WINDOW_SIGMA", "C1", "C2"):
        assert getattr(losses, name) == getattr(oracle_ssim, name)


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


# The fast losses are the oracle's to rounding, pixel by pixel, in both precisions.

PADDED = NAMES[2:]
EVERYWHERE = [
    *(pytest.param(losses, name, id=name) for name in NAMES),
    *(pytest.param(compiled_losses, name, id=f"compiled {name}", marks=COMPILED) for name in PADDED),
]
# units of rounding that value and gradient of a term may need, in both precisions: twice the worst that 3,000 random
# cases of the strategy below did, of torch and of the compiled stage alike; one unit is what `magnitudes` bounds
UNITS = {"l1": (2.5, 2.0), "l2": (2.5, 2.5), "d_ssim": (1.0, 0.5)}
# what an objective is mixed of
TERMS = {
    "l1": (("l1", 1.0),),
    "l2": (("l2", 1.0),),
    "ssim": (("d_ssim", 1.0),),
    "d_ssim": (("d_ssim", 1.0),),
    "photometric_3dgs": (("l1", 0.8), ("d_ssim", 0.2)),
    "photometric_pop": (("l2", 0.99), ("d_ssim", 0.01)),
}


def allowed(name: str, case: Case, dtype: torch.dtype) -> tuple[float, np.ndarray]:
    """Return what rounding may do to a loss and, pixel by pixel, to its gradient: in its dtype, and in the oracle."""
    eps, own = torch.finfo(dtype).eps, torch.finfo(torch.float64).eps
    # SSIM itself is rounded where it is a difference from 1
    value, gradient = (eps if name == "ssim" else 0.0), np.zeros((case.height, case.width, case.channels))
    for term, weight in TERMS[name]:
        (of_value, of_gradient), fast, oracle = (
            UNITS[term],
            bounds(term, case, "difference"),
            bounds(term, case, "textbook"),
        )
        value += weight * of_value * (eps * fast.value + own * oracle.value)
        gradient += weight * of_gradient * (eps * fast.gradient + own * oracle.gradient)
    return value, gradient


def bounds(term: str, case: Case, form: Form) -> LossMagnitudes:
    (x, y), mask = case.images(), case.mask()
    if term == "d_ssim":
        return d_ssim_magnitudes(x, y, case.padding, mask, form)
    return pixelwise_magnitudes(x, y, 1 if term == "l1" else 2, mask)


def needed(name: str, case: Case, dtype: torch.dtype, module: ModuleType = losses) -> tuple[float, float]:
    """Return which share of what is allowed a loss and its gradient need; 0 where nothing is needed."""
    value, v_image, loss, grad = both(name, case, dtype, module)
    (of_value, of_gradient), off = allowed(name, case, dtype), np.abs(grad - v_image)
    if np.any(off > of_gradient):
        return abs(loss - value) / max(of_value, 1e-300), np.inf
    shares = np.divide(off, of_gradient, out=np.zeros_like(off), where=of_gradient > 0.0)
    return abs(loss - value) / max(of_value, 1e-300), float(np.max(shares))


def assert_rounded(name: str, case: Case, dtype: torch.dtype, module: ModuleType) -> None:
    of_value, of_gradient = needed(name, case, dtype, module)
    assert of_value <= 1.0
    assert of_gradient <= 1.0


@pytest.mark.parametrize(("module", "name"), EVERYWHERE)
@given(case=cases(), band=st.sampled_from([1, 1 << 18]))
def test_loss_and_gradient_are_the_oracles_in_float64(module: ModuleType, name: str, case: Case, band: int) -> None:
    with bands_of(band):
        assert_rounded(name, case, torch.float64, module)


@pytest.mark.parametrize(("module", "name"), EVERYWHERE)
@given(case=cases())
def test_loss_and_gradient_are_the_oracles_to_rounding_in_float32(module: ModuleType, name: str, case: Case) -> None:
    assert_rounded(name, case, torch.float32, module)


@pytest.mark.parametrize("module", [losses, pytest.param(compiled_losses, marks=COMPILED, id="compiled")])
@pytest.mark.parametrize("name", ["ssim", "d_ssim"])
def test_beside_a_flat_photograph_rounding_is_charged_against_c2(module: ModuleType, name: str) -> None:
    # the variance of the photograph is 0: 2.4e-15 at most, where 1e-12 of the largest gradient is 2.3e-15
    assert_rounded(name, Case(16, 11, 4, "flat", 16), torch.float64, module)


@pytest.mark.parametrize("name", PADDED)
@pytest.mark.parametrize(("kind", "most"), [("noisy", 1e-5), ("close", 2e-6), ("unrelated", 5e-5), ("flat", 2e-3)])
def test_what_rounding_may_do_in_float32_is_small_beside_the_gradient(name: str, kind: str, most: float) -> None:
    case = Case(kind=kind, height=16, width=14, seed=3)
    gradient = both(name, case, torch.float64)[1]
    assert np.max(allowed(name, case, torch.float32)[1]) < most * np.max(np.abs(gradient))


# The fast POP loss against the oracle, in both precisions, and through the sigmoid.

EPS = {torch.float64: 2.0**-52, torch.float32: 2.0**-23}
# units of eps that means of a dozen opacities may need; the most that 20,000 random populations needed is 1.8
POP_UNITS = 4.0
# a mean of numbers at the end of the range is rounded to whole ones of these
SMALLEST = {torch.float64: 2.0**-1074, torch.float32: 2.0**-149}

opacities_st = st.sampled_from([0.5, 0.25, 0.0, 1.0]) | st.floats(0.0, 1.0, width=32)
members_st = st.lists(st.tuples(opacities_st, st.booleans(), st.booleans()), max_size=12)
dtypes = pytest.mark.parametrize("dtype", [torch.float64, torch.float32])


def unpacked(members: list[tuple[float, bool, bool]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    o, mask, visible = zip(*members, strict=True) if members else ((), (), ())
    return np.array(o, dtype=np.float64), np.array(mask, dtype=bool), np.array(visible, dtype=bool)


@dtypes
@given(members=members_st, restricted=st.booleans())
@example(members=[(0.0, False, False), (2.0**-149, False, False)], restricted=False)
def test_loss_and_gradient_are_the_oracles(
    members: list[tuple[float, bool, bool]], restricted: bool, dtype: torch.dtype
) -> None:
    o, mask, visible = unpacked(members)
    expected = oracle.pop_loss(o, mask, visible if restricted else None)
    v_opacities = oracle.pop_loss_vjp(o, mask, 1.0, visible if restricted else None)
    opacities = torch.tensor(o, dtype=dtype, requires_grad=True)
    seen = torch.tensor(visible) if restricted else None
    loss = pop_loss(opacities, torch.tensor(mask), seen)
    loss.backward()
    assert loss.dtype == dtype
    assert abs(loss.item() - expected) <= POP_UNITS * (EPS[dtype] * expected + SMALLEST[dtype])
    np.testing.assert_allclose(opacities.grad.numpy(), v_opacities, rtol=EPS[dtype], atol=0.0)
    by_hand = pop_loss_vjp(opacities.detach(), torch.tensor(mask), 1.0, seen)
    assert torch.equal(by_hand, opacities.grad)


@dtypes
@given(important=st.lists(st.booleans(), max_size=40))
def test_polarised_opacities_give_exactly_zero(important: list[bool], dtype: torch.dtype) -> None:
    mask = torch.tensor(important, dtype=torch.bool)
    assert pop_loss(mask.to(dtype), mask) == 0.0


@dtypes
def test_gradient_reaches_logits_through_the_sigmoid(dtype: torch.dtype) -> None:
    logits = torch.tensor([-2.0, 0.0, 3.0], dtype=dtype, requires_grad=True)
    o = torch.sigmoid(logits)
    mask = torch.tensor([True, False, False])
    (1e-3 * pop_loss(o, mask)).backward()
    expected = 1e-3 * torch.tensor([-1.0, 0.5, 0.5], dtype=dtype) * (o * (1.0 - o)).detach()
    torch.testing.assert_close(logits.grad, expected)


@pytest.mark.parametrize("important", [True, False])
def test_an_empty_side_and_an_empty_scene_are_finite(important: bool) -> None:
    o = torch.full((3,), 0.25, requires_grad=True)
    loss = pop_loss(o, torch.full((3,), important))
    loss.backward()
    assert loss.item() == (0.75 if important else 0.25)
    assert torch.all(torch.isfinite(o.grad))
    nobody = torch.zeros(0, requires_grad=True)
    loss = pop_loss(nobody, torch.zeros(0, dtype=torch.bool))
    loss.backward()
    assert loss.item() == 0.0


def test_nothing_flows_through_the_mask_and_no_graph_is_made_without_need() -> None:
    o = torch.tensor([0.25, 0.5])
    assert not pop_loss(o, torch.tensor([True, False])).requires_grad
    with torch.no_grad():
        assert not pop_loss(o.clone().requires_grad_(), torch.tensor([True, False])).requires_grad


def test_masks_of_several_views_are_made_at_once() -> None:
    assert importance_mask(torch.tensor([[0, 2], [1, 0]])).tolist() == [[False, True], [True, False]]
