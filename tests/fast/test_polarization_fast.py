"""The fast POP loss against the oracle, in both precisions, and through the sigmoid."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from pop_fast.stages.polarization import importance_mask, pop_loss, pop_loss_vjp
from pop_ref import polarization as oracle

EPS = {torch.float64: 2.0**-52, torch.float32: 2.0**-23}
# units of eps that means of a dozen opacities may need; the most that 20,000 random populations needed is 1.8
UNITS = 4.0
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
    assert abs(loss.item() - expected) <= UNITS * (EPS[dtype] * expected + SMALLEST[dtype])
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
