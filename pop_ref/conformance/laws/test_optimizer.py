"""Laws of Adam and its schedules."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic
from pop_ref.settings import DensityConfig, LearningRates, Recipe, UpdateRules

ORACLE = OracleAdapter()

gradients = st.lists(dyadic(-2.0, 2.0), min_size=1, max_size=5)
# of what trains; a program may treat each in its own way
KEYS = ("means", "scales", "quats", "opacities", "sh0", "shN")
RATES = {key: 2.0 ** -(2 + k) for k, key in enumerate(KEYS)}
BETA1, BETA2, EPS = 0.9, 0.999, 1e-15


def recurrence(gradients, lr, first=1):
    """Follow one number; the first gradient is that of update `first`."""
    x = m = v = 0.0
    for t, g in enumerate(gradients, start=first):
        m, v = BETA1 * m + (1.0 - BETA1) * g, BETA2 * v + (1.0 - BETA2) * g * g
        x -= lr * (m / (1.0 - BETA1**t)) / (np.sqrt(v / (1.0 - BETA2**t)) + EPS)
    return x, m, v


def _walk(backend, gradients, lr=None):
    """Move one number of each parameter by the same gradients; return what became of each and of its moments."""
    x, m, v = ({key: np.zeros(1) for key in KEYS} for _ in range(3))
    for step, g in enumerate(gradients, start=1):
        given = {key: np.array([g]) for key in KEYS}
        x, m, v = backend.stage("adam_step")(x, given, m, v, step, lr or RATES)
    return {key: (x[key][0], m[key][0], v[key][0]) for key in KEYS}


@law("optimizer", "adam_step", gradients=gradients)
def test_adam_follows_the_scalar_recurrence(backend, gradients):
    found = _walk(backend, gradients)
    for key, lr in RATES.items():
        size = np.array([4.0 * lr, 2.0, 4.0]) * len(gradients)
        assert_close("optimizer.adam", found[key], recurrence(gradients, lr), size, backend.dtype)


@law("optimizer", "adam_step", gradients=gradients, power=st.integers(0, 8))
def test_adam_forgets_the_scale_of_the_loss(backend, gradients, power):
    scaled, plain = _walk(backend, [g * 2.0**power for g in gradients]), _walk(backend, gradients)
    for key, lr in RATES.items():
        size = 16.0 * lr * len(gradients)
        assert_close("optimizer.scale", scaled[key][0], plain[key][0], size, backend.dtype)


@law("optimizer", "adam_step", g=dyadic(0.125, 4.0), lr=dyadic(0.125, 1.0))
def test_the_first_step_has_the_length_of_the_learning_rate(backend, g, lr):
    for x, _, _ in _walk(backend, [g], dict.fromkeys(KEYS, lr)).values():
        assert_close("optimizer.scale", x, -lr, 4.0, backend.dtype)


@law("optimizer", "adam_step", powers=st.lists(st.integers(-33, -13), min_size=1, max_size=4), sign=st.booleans())
def test_gradients_of_any_smallness_take_whole_steps(backend, powers, sign):
    # 1e-10 to 1e-4: eps stands outside the root, and it is far below all of them
    gradients = [(-1.0 if sign else 1.0) * 2.0**power for power in powers]
    found = _walk(backend, gradients)
    for key, lr in RATES.items():
        x, m, v = recurrence(gradients, lr)
        assert_close("optimizer.adam", found[key][0], x, 4.0 * lr * len(gradients), backend.dtype)
        assert_close("optimizer.adam", found[key][1:], [m, v], np.array([abs(m), v]) * len(gradients), backend.dtype)
        assert abs(found[key][0]) > 0.25 * lr, "a small gradient took a small step"


@law("optimizer", "adam_step", values=arrays_of((3, 2)))
def test_rows_do_not_mix_and_rows_without_gradient_move_by_their_moments(backend, values):
    adam = backend.stage("adam_step")
    params, m, v = ({key: array.copy() for key in KEYS} for array in (values, np.ones((3, 2)), np.ones((3, 2))))
    grads = {key: np.zeros((3, 2)) for key in KEYS}
    for grad in grads.values():
        grad[1] = 1.0
    moved, new_m, _ = adam(params, grads, m, v, 4, RATES)
    alone, alone_m, _ = adam(*({key: d[key][1:2] for key in KEYS} for d in (params, grads, m, v)), 4, RATES)
    for key in KEYS:
        assert_same_bits(f"one row of {key} alone", moved[key][1:2], alone[key])
        assert_same_bits(f"moments of one row of {key} alone", new_m[key][1:2], alone_m[key])
        assert np.all(moved[key][0] < values[0])


@law("optimizer", "adam_steps", waits=st.integers(1, 4), gradients=gradients)
def test_harmonics_that_wait_do_not_move_and_their_counter_goes_on(backend, waits, gradients):
    zero = {key: np.zeros(1) for key in KEYS}
    others = {key: np.array([0.5]) for key in KEYS if key != "shN"}
    x, m, v = backend.stage("adam_steps")(zero, [others] * waits, RATES)
    assert_same_bits("harmonics that wait", [x["shN"], m["shN"], v["shN"]], np.zeros((3, 1)))
    active = [{**others, "shN": np.array([g])} for g in gradients]
    x, m, v = backend.stage("adam_steps")(zero, [*[others] * waits, *active], RATES)
    for key, lr in RATES.items():
        first, given = (waits + 1, gradients) if key == "shN" else (1, [0.5] * (waits + len(gradients)))
        # corrections that count the waiting make a step larger, by 10 / sqrt(1000) a wait at most
        size = np.array([4.0 * lr * (1.0 + waits), 2.0, 4.0]) * len(given)
        found = (x[key][0], m[key][0], v[key][0])
        assert_close("optimizer.adam", found, recurrence(given, lr, first), size, backend.dtype)


@law("optimizer", "means_learning_rate", step=st.integers(0, 29_999), scale=dyadic(0.5, 8.0))
def test_the_position_rate_falls_log_linearly_to_a_hundredth(backend, step, scale):
    rate = backend.stage("means_learning_rate")
    expected = 1.6e-4 * scale * 0.01 ** (step / 30_000)
    assert_close("optimizer.rate", rate(step, scale), expected, 16.0 * expected, backend.dtype)


RULES_OF_RATES = (
    # no round begins and nothing is rewound, whatever that would do
    UpdateRules(means_rewind_iter=150, means_rewind_to=50, round_decay=0.5, round_decay_every=1),
    UpdateRules(means_rewind_to=50),
    UpdateRules(means_rewind_iter=90, means_rewind_to=0),
    UpdateRules(rounds_start_iter=120, round_steps=60, round_decay=0.5, round_decay_every=20),
    UpdateRules(rounds_start_iter=100, round_steps=250, round_decay=0.875, round_decay_every=7),
    UpdateRules(rounds_start_iter=120, round_steps=30, round_decay=0.5, round_decay_every=1),
)
# of a schedule of 300 steps, those at which a rule of the above begins or ends, and those beside
TURNS = (0, 1, 49, 50, 89, 90, 99, 100, 107, 119, 120, 139, 140, 149, 150, 179, 180, 181, 239, 240, 299)
SOME_RATES = LearningRates(means=0.5, means_decay=0.25, scales=0.125, quats=0.25, opacities=0.5, sh_rest=2.0)


@law("optimizer", "learning_rates")
def test_rates_rewind_and_fall_in_rounds_as_the_rules_say(backend):
    for rules, decay, step in product(RULES_OF_RATES, (1.0, 0.25), TURNS):
        rates = replace(SOME_RATES, others_decay=decay)
        expected = ORACLE.stage("learning_rates")(step, 4.0, 300, rates, rules)
        found = backend.stage("learning_rates")(step, 4.0, 300, rates, rules)
        assert set(found) == set(expected)
        for name, rate in expected.items():
            assert_close("optimizer.rate", found[name], rate, 16.0 * rate, backend.dtype, against_oracle=True)
        # both decays are by 0.25: those that fall do so as the positions, and opacities do not
        fallen = found["means"] / (4.0 * SOME_RATES.means) if decay == 0.25 else 1.0
        stay = backend.stage("learning_rates")(step, 4.0, 300, SOME_RATES, rules)
        for name in ("scales", "quats", "sh0", "shN", "opacities"):
            asked = stay[name] * (1.0 if name == "opacities" else fallen)
            assert_close("optimizer.rate", found[name], asked, 16.0 * asked, backend.dtype)


GROWTH = {"refine_start_iter": 5, "refine_stop_iter": 40}
OFTEN = DensityConfig(refine_every=4, **GROWTH)
PAUSED = DensityConfig(refine_every=3, reset_every=10, pause_refine_after_reset=4, **GROWTH)
RECIPES = (
    Recipe(density=OFTEN, updates=UpdateRules(edits_replace_update=True)),
    Recipe(density=PAUSED, updates=UpdateRules(edits_replace_update=True, sh_rest_every=4), adam_restarts=(16,)),
    Recipe(density=OFTEN, updates=UpdateRules(sh_rest_every=7, opacities_stop_iter=20), adam_restarts=(12, 30)),
    Recipe(density=PAUSED, updates=UpdateRules(opacities_stop_iter=0)),
)
STEPS = (0, 1, 2, 3, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15, 16, 17, 19, 20, 21, 28, 30, 31, 36, 39, 40, 59)


@law("optimizer", "update_numbers")
def test_adam_counts_the_updates_that_the_rules_leave_each_parameter(backend):
    for recipe in (replace(each, max_steps=60) for each in RECIPES):
        for step in STEPS:
            expected = ORACLE.stage("update_numbers")(KEYS, step, recipe)
            found = backend.stage("update_numbers")(KEYS, step, recipe)
            assert found == expected, f"step {step}: updates {found}, expected {expected}"


@law("optimizer", "sh_degree_at", step=st.integers(0, 120), interval=st.integers(1, 9), start=st.integers(0, 60))
def test_bands_wait_for_the_step_that_they_are_counted_from(backend, step, interval, start):
    for most in (0, 2, 3):
        found = backend.stage("sh_degree_at")(step, interval, most, start)
        assert found == (0 if step < start else min((step - start) // interval, most))


@law("optimizer", "sh_degree_at", step=st.integers(0, 10_000))
def test_a_band_is_added_every_thousand_steps_up_to_the_third(backend, step):
    assert backend.stage("sh_degree_at")(step) == min(step // 1000, 3)


@law("optimizer", "learning_rates", step=st.integers(0, 29_999), scale=dyadic(0.5, 8.0))
def test_every_other_rate_stays_as_it_is(backend, step, scale):
    rates = backend.stage("learning_rates")(step, scale)
    fixed = {"scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
    assert set(rates) == {"means", *fixed}
    for name, rate in fixed.items():
        assert_close("optimizer.rate", rates[name], rate, rate, backend.dtype)
