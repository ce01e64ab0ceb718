"""Adam against a scalar loop and against torch, and the two schedules."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_ref.activations import opacities_from_logits, opacities_from_logits_vjp
from pop_ref.optimizer import LEARNING_RATES, adam_step, learning_rates, means_learning_rate, sh_degree_at


def scalar_adam(x: float, gradients: list[float], lr: float, betas: tuple[float, float], eps: float) -> list[float]:
    """Kingma and Ba's algorithm 1, one number at a time."""
    m = v = 0.0
    path = []
    for t, g in enumerate(gradients, start=1):
        m = betas[0] * m + (1.0 - betas[0]) * g
        v = betas[1] * v + (1.0 - betas[1]) * g**2
        m_hat, v_hat = m / (1.0 - betas[0] ** t), v / (1.0 - betas[1] ** t)
        x = x - lr * m_hat / (math.sqrt(v_hat) + eps)
        path.append(x)
    return path


def run(x: np.ndarray, gradients: np.ndarray, lr: float, **options) -> list[np.ndarray]:
    params, m, v = {"x": x}, {"x": np.zeros_like(x)}, {"x": np.zeros_like(x)}
    path = []
    for t, g in enumerate(gradients, start=1):
        params, m, v = adam_step(params, {"x": g}, m, v, t, {"x": lr}, **options)
        path.append(params["x"])
    return path


gradients_st = st.lists(st.sampled_from([0.0, 1.0, -1.0, 0.5]) | st.floats(-8.0, 8.0), min_size=1, max_size=12)


@given(gradients_st, st.sampled_from([1e-15, 1e-8, 0.125]), st.sampled_from([(0.9, 0.999), (0.5, 0.75)]))
def test_adam_is_the_published_algorithm_number_by_number(
    gradients: list[float], eps: float, betas: tuple[float, float]
) -> None:
    path = run(np.array([[0.5]]), np.array(gradients).reshape(-1, 1, 1), 0.25, betas=betas, eps=eps)
    expected = scalar_adam(0.5, gradients, 0.25, betas, eps)
    np.testing.assert_allclose(np.ravel(path), expected, rtol=1e-12, atol=1e-12)


def test_adam_equals_torch_on_rows_of_several_shapes() -> None:
    rng = np.random.default_rng(3)
    params = {"means": rng.normal(size=(5, 3)), "opacities": rng.normal(size=5), "sh0": rng.normal(size=(5, 1, 3))}
    lr = {"means": 1e-3, "opacities": 0.05, "sh0": 0.0025}
    tensors = {name: torch.tensor(array, requires_grad=True) for name, array in params.items()}
    groups = [{"params": [tensors[name]], "lr": lr[name]} for name in params]
    reference = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, foreach=False)
    m = {name: np.zeros_like(array) for name, array in params.items()}
    v = {name: np.zeros_like(array) for name, array in params.items()}
    for step in range(1, 26):
        # gradients of very different sizes, some exactly zero, as training makes them
        grads = {name: rng.normal(size=a.shape) * 10.0 ** rng.integers(-12, 3, a.shape) for name, a in params.items()}
        for name, g in grads.items():
            g[step % 5] = 0.0
            tensors[name].grad = torch.tensor(g)
        params, m, v = adam_step(params, grads, m, v, step, lr)
        reference.step()
        for name in params:
            state = reference.state[tensors[name]]
            np.testing.assert_allclose(params[name], tensors[name].detach().numpy(), rtol=1e-13, atol=1e-15)
            np.testing.assert_allclose(m[name], state["exp_avg"].numpy(), rtol=1e-13, atol=1e-25)
            np.testing.assert_allclose(v[name], state["exp_avg_sq"].numpy(), rtol=1e-13, atol=1e-30)


def test_a_steady_gradient_moves_a_parameter_by_the_learning_rate_however_small_it_is() -> None:
    for size in (1.0, 1e-6, 1e-12):
        path = run(np.array([0.0]), np.full((4, 1), size), 0.25)
        np.testing.assert_allclose(np.ravel(path), [-0.25, -0.5, -0.75, -1.0], rtol=2e-3)


def test_a_parameter_that_never_had_a_gradient_keeps_its_bits() -> None:
    x = np.array([0.1, -7.25])
    assert run(x, np.zeros((3, 2)), 0.25)[-1].tolist() == x.tolist()


def test_a_parameter_without_a_gradient_coasts_on_its_moments() -> None:
    path = np.ravel(run(np.array([0.0]), np.array([[1.0], [0.0], [0.0]]), 0.25))
    assert path[0] > path[1] > path[2]


def test_adam_leaves_its_arguments_alone() -> None:
    x, g, zero = {"x": np.ones(2)}, {"x": np.ones(2)}, {"x": np.zeros(2)}
    adam_step(x, g, zero, zero, 1, {"x": 0.5})
    assert x["x"].tolist() == g["x"].tolist() == [1.0, 1.0]
    assert zero["x"].tolist() == [0.0, 0.0]


def test_adam_of_no_rows_is_no_rows() -> None:
    none = {"x": np.zeros((0, 3))}
    assert adam_step(none, none, none, none, 1, {"x": 0.5})[0]["x"].shape == (0, 3)


def test_updates_count_from_one() -> None:
    with pytest.raises(ValueError, match="step is 0"):
        adam_step({}, {}, {}, {}, 0, {})


@pytest.mark.parametrize(("opacity", "steps"), [(0.1, 130), (0.5, 380), (0.99, 430)])
def test_an_opacity_that_only_pop_touches_falls_under_the_pruning_threshold_in_so_many_steps(
    opacity: float, steps: int
) -> None:
    logit = {"o": np.log(np.array([opacity]) / (1.0 - opacity))}
    m = v = {"o": np.zeros(1)}
    taken = 0
    while opacities_from_logits(logit["o"])[0] >= 0.005:
        taken += 1
        gradient = {"o": opacities_from_logits_vjp(logit["o"], np.array([1e-3 / 40_000]))}
        logit, m, v = adam_step(logit, gradient, m, v, taken, {"o": LEARNING_RATES["opacities"]})
    assert taken == pytest.approx(steps, abs=5)


def test_positions_start_at_their_rate_and_end_at_a_hundredth_of_it() -> None:
    assert means_learning_rate(0, 3.0) == 1.6e-4 * 3.0
    assert means_learning_rate(30_000, 3.0) == pytest.approx(1.6e-6 * 3.0, rel=1e-14)
    assert means_learning_rate(99_999, 3.0) == means_learning_rate(30_000, 3.0)
    assert means_learning_rate(-1, 3.0) == means_learning_rate(0, 3.0)


@given(st.integers(0, 29_999), st.sampled_from([0.5, 1.0, 4.0]))
def test_positions_rate_falls_by_one_factor_a_step(step: int, scene_scale: float) -> None:
    ratio = means_learning_rate(step + 1, scene_scale) / means_learning_rate(step, scene_scale)
    assert ratio == pytest.approx(0.01 ** (1 / 30_000), rel=1e-12)


def test_only_the_positions_rate_changes() -> None:
    early, late = learning_rates(0, 2.0), learning_rates(20_000, 2.0)
    assert [name for name in early if early[name] != late[name]] == ["means"]
    assert early["shN"] == early["sh0"] / 20
    assert learning_rates(500, 2.0, max_steps=1000)["means"] == pytest.approx(0.1 * early["means"], rel=1e-14)


def test_harmonics_gain_a_band_each_thousand_steps_up_to_three() -> None:
    degrees = [sh_degree_at(step) for step in range(30_000)]
    assert [degrees.index(d) for d in range(4)] == [0, 1000, 2000, 3000]
    assert max(degrees) == 3
    assert [sh_degree_at(step, interval=2, max_degree=1) for step in range(5)] == [0, 0, 1, 1, 1]
