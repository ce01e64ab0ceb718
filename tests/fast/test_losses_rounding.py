"""The fast losses are the oracle's to rounding, pixel by pixel, in both precisions."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast import compiled
from pop_fast.compiled import losses as compiled_losses
from pop_fast.stages import losses
from pop_ref.loss_magnitudes import Form, LossMagnitudes, d_ssim_magnitudes, pixelwise_magnitudes
from tests.fast.loss_cases import Case, bands_of, both, cases

NAMES = ("l1", "l2", "ssim", "d_ssim", "photometric_3dgs", "photometric_pop")
PADDED = NAMES[2:]
COMPILED = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")
EVERYWHERE = [
    *(pytest.param(losses, name, id=name) for name in NAMES),
    *(pytest.param(compiled_losses, name, id=f"compiled {name}", marks=COMPILED) for name in PADDED),
]
# units of rounding that value and gradient of a term may need, in both precisions: twice the worst that 3,000 random
# cases of the strategy below did, of torch and of the compiled stage alike; one unit is what `loss_magnitudes` bounds
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
