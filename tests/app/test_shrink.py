"""Fewer Gaussians in a file: who goes, and how far down a size is met."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.density import shrink
from pop_fast.density.passes import Passes
from pop_fast.errors import PopError
from pop_fast.train.views import ViewTensors
from tests.app.clouds import many
from tests.app.tiny import tiny_capture


def test_opacity_is_compared_activated() -> None:
    params = many(4)
    params["opacities"] = torch.logit(torch.tensor([0.1, 0.5, 0.049, 0.999]))
    assert shrink.opaque_enough(params, 0.05).tolist() == [True, True, False, True]
    assert shrink.opaque_enough(params, 0.0).all()


def test_a_box_keeps_what_lies_in_it_or_on_its_faces() -> None:
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.5, 0.0, 0.0], [0.5, 0.5, -0.25]])
    assert shrink.inside(means, (0, 0, 0, 1, 1, 1)).tolist() == [True, True, False, False]
    with pytest.raises(PopError, match="every lower bound must be under"):
        shrink.inside(means, (0, 0, 1, 1, 1, 0))


@given(scores=st.lists(st.integers(0, 5), max_size=20), count=st.integers(0, 25))
def test_the_best_are_those_that_none_left_out_exceeds(scores: list[int], count: int) -> None:
    values = torch.tensor(scores, dtype=torch.float64)
    kept = shrink.best(values, count)
    assert int(kept.sum()) == min(count, len(scores))
    if kept.any() and not kept.all():
        assert values[kept].min() >= values[~kept].max()


@given(
    scores=st.lists(st.floats(0.0, 10.0, width=32), min_size=1, max_size=40),
    each=st.integers(1, 9),
    most=st.integers(0, 400),
)
def test_a_size_is_kept_and_used(scores: list[float], each: int, most: int) -> None:
    values = torch.tensor(scores, dtype=torch.float64)
    sizes: list[int] = []

    def size_of(kept: torch.Tensor) -> int:
        sizes.append(7 + each * int(kept.sum()))
        return sizes[-1]

    if most < 7:
        with pytest.raises(PopError, match="a file without any Gaussian has 7 bytes"):
            shrink.best_within(values, most, size_of)
        return
    kept = shrink.best_within(values, most, size_of)
    size = 7 + each * int(kept.sum())
    assert size <= most
    assert kept.all() or size + each > most or size >= 0.98 * most
    assert len(sizes) <= 14


def test_the_least_that_make_up_a_share_go_and_so_do_the_unseen() -> None:
    scores = torch.tensor([0.0, 1.0, 100.0, 2.0, 897.0])
    assert shrink.all_but_the_least(scores, 0.0).tolist() == [False, True, True, True, True]
    assert shrink.all_but_the_least(scores, 0.002).tolist() == [False, False, True, False, True]


@pytest.mark.parametrize("score", ["contributions", "dominance", "sensitivity"])
def test_what_no_view_shows_scores_nothing(score: shrink.Score) -> None:
    capture = tiny_capture()
    views = [ViewTensors.of(view) for view in capture.views]
    params = many(30, 0)
    params["means"][:10] = torch.tensor([1e4, 1e4, 1e4])
    found = shrink.view_scores(score, Passes("fast", views), params, 0)
    assert (found[:10] == 0.0).all()
    assert (found[10:] > 0.0).any()
    assert (found >= 0.0).all()


def test_without_a_view_larger_and_more_opaque_is_more_visible() -> None:
    params = many(3)
    params["scales"] = torch.tensor([[-2.0, -2.0, -9.0], [-3.0, -3.0, -9.0], [-2.0, -2.0, -9.0]])
    params["opacities"] = torch.tensor([0.0, 0.0, -4.0])
    assert shrink.visibility(params).argsort(descending=True).tolist()[0] == 0
