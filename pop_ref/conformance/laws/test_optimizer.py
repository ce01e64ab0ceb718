"""Laws of Adam and its schedules."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.compare import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic

gradients = st.lists(dyadic(-2.0, 2.0), min_size=1, max_size=5)


def _walk(backend, gradients, lr=0.25):
    x, m, v = ({"x": np.zeros(1)} for _ in range(3))
    for step, g in enumerate(gradients, start=1):
        x, m, v = backend.stage("adam_step")(x, {"x": np.array([g])}, m, v, step, {"x": lr})
    return x["x"][0], m["x"][0], v["x"][0]


@law("optimizer", "adam_step", gradients=gradients)
def test_adam_follows_the_scalar_recurrence(backend, gradients):
    x = m = v = 0.0
    for step, g in enumerate(gradients, start=1):
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        x -= 0.25 * (m / (1.0 - 0.9**step)) / (np.sqrt(v / (1.0 - 0.999**step)) + 1e-15)
    found = _walk(backend, gradients)
    assert_close("optimizer.adam", found, [x, m, v], np.array([1.0, 2.0, 4.0]) * len(gradients), backend.dtype)


@law("optimizer", "adam_step", gradients=gradients, power=st.integers(0, 8))
def test_adam_forgets_the_scale_of_the_loss(backend, gradients, power):
    scaled = _walk(backend, [g * 2.0**power for g in gradients])
    assert_close("optimizer.scale", scaled[0], _walk(backend, gradients)[0], 4.0 * len(gradients), backend.dtype)


@law("optimizer", "adam_step", g=dyadic(0.125, 4.0), lr=dyadic(0.125, 1.0))
def test_the_first_step_has_the_length_of_the_learning_rate(backend, g, lr):
    assert_close("optimizer.scale", _walk(backend, [g], lr)[0], -lr, 4.0, backend.dtype)


@law("optimizer", "adam_step", values=arrays_of((3, 2)))
def test_rows_do_not_mix_and_rows_without_gradient_move_by_their_moments(backend, values):
    adam = backend.stage("adam_step")
    params, m, v = {"x": values}, {"x": np.ones((3, 2))}, {"x": np.ones((3, 2))}
    grads = {"x": np.zeros((3, 2))}
    grads["x"][1] = 1.0
    moved, new_m, _ = adam(params, grads, m, v, 4, {"x": 0.5})
    alone, alone_m, _ = adam(*({"x": d["x"][1:2]} for d in (params, grads, m, v)), 4, {"x": 0.5})
    assert_same_bits("one row alone", moved["x"][1:2], alone["x"])
    assert_same_bits("moments of one row alone", new_m["x"][1:2], alone_m["x"])
    assert np.all(moved["x"][0] < values[0])


@law("optimizer", "means_learning_rate", step=st.integers(0, 30_000), scale=dyadic(0.5, 8.0))
def test_the_position_rate_falls_log_linearly_to_a_hundredth(backend, step, scale):
    rate = backend.stage("means_learning_rate")
    expected = 1.6e-4 * scale * 0.01 ** (step / 30_000)
    assert_close("optimizer.rate", rate(step, scale), expected, 16.0 * expected, backend.dtype)


@law("optimizer", "sh_degree_at", step=st.integers(0, 10_000))
def test_a_band_is_added_every_thousand_steps_up_to_the_third(backend, step):
    assert backend.stage("sh_degree_at")(step) == min(step // 1000, 3)


@law("optimizer", "learning_rates", step=st.integers(0, 30_000), scale=dyadic(0.5, 8.0))
def test_every_other_rate_stays_as_it_is(backend, step, scale):
    rates = backend.stage("learning_rates")(step, scale)
    fixed = {"scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
    assert set(rates) == {"means", *fixed}
    for name, rate in fixed.items():
        assert_close("optimizer.rate", rates[name], rate, rate, backend.dtype)
