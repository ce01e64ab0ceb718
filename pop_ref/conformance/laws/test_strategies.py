"""Laws of what trains: a strategy is driven by a script through whole trainings, and says at every step what it does.

The first laws know each method and compare it with the oracle; the others are about no method, and judge somebody
else's strategy as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategy_script import (
    EVERY_STEP,
    GROWTH,
    MEETINGS,
    METHODS,
    OWN,
    READINGS,
    RESETS,
    Script,
    script_of,
    trainings_of,
)
from pop_ref.methods import KEYS

ORACLE = OracleAdapter()


def _assert_the_oracles(backend, script):
    rows = script.rows()
    expected, found = ORACLE.stage("scripted_steps")(script, rows), backend.stage("scripted_steps")(script, rows)
    happened = set()
    for step, wanted, got in zip(script.steps, expected, found, strict=True):
        at = f"step {step} of {script.method}"
        term = abs(wanted["term"])
        assert_close("training.term", got["term"], wanted["term"], term, backend.dtype, against_oracle=True)
        assert got["done"] == wanted["done"], f"{at} did {got['done']}, expected {wanted['done']}"
        for key in KEYS:
            counter = wanted["counters"][key]
            assert got["counters"][key] == counter, f"{at}: {key} counts {got['counters'][key]} updates, not {counter}"
            for kind in ("params", "m", "v"):
                a, b = got[kind][key], wanted[kind][key]
                assert a.shape == b.shape, f"{at}: {kind} of {key} have shape {a.shape}, expected {b.shape}"
                assert_close("training.rows", a, b, np.abs(b) + 1.0, backend.dtype, against_oracle=True)
        happened |= set(wanted["done"])
    return happened


def _method(method):
    def sentence(backend):
        happened = set().union(*(_assert_the_oracles(backend, script) for script in trainings_of(method)))
        # a training in which nothing happens would say nothing
        wanted = {
            "mini-splatting": {"cloned", "split", "pruned", "replaced"},
            "pop": {"cloned", "split", "pruned"},
        }
        assert happened >= wanted.get(method, {"cloned", "split", "pruned", "reset"}), f"{happened} only"

    sentence.__name__ = f"test_a_training_by_{method.replace('-', '_')}_is_the_oracles_at_every_step"
    return law("training", "scripted_steps", "method_settings")(sentence)


for _name in METHODS:
    _test = _method(_name)
    globals()[_test.law.sentence.__name__] = _test
del _name, _test


@law("training", "scripted_steps", "method_settings")
def test_a_training_is_the_oracles_under_every_reading(backend):
    for script in (*MEETINGS, *READINGS):
        _assert_the_oracles(backend, script)


@law("training", "scripted_steps", "method_settings")
def test_second_moments_decay_as_they_are_told(backend):
    for method in ("pop", "taming"):
        script = script_of(method, steps=(1, 2, 3, 4))
        for beta2 in (0.75, 0.99):
            _assert_the_oracles(backend, replace(script, lr=replace(script.lr, beta2=beta2)))


@law("training", "scripted_steps", "method_settings")
def test_a_reset_at_step_zero_happens_where_it_is_asked_for(backend):
    for asked in (False, True):
        settings = {"reset_at_zero": asked}
        happened = _assert_the_oracles(backend, script_of("gsplat", settings=settings, steps=(0, 1, 2)))
        assert ("reset" in happened) == asked


@law("training", "scripted_steps", "method_settings")
def test_no_reset_happens_where_refinement_ends(backend):
    settings = {"refine_stop_iter": RESETS["reset_every"]}
    happened = _assert_the_oracles(backend, script_of("gsplat", settings=settings, steps=(4, 11, 12, 13)))
    assert "reset" not in happened


@law("training", "scripted_steps", "method_settings")
def test_the_prior_begins_and_ends_where_it_is_told_and_is_as_heavy_as_it_is_told(backend):
    steps = (0, 4, 5, 6, 14, 15, 16)
    for weight in (0.5, 2.0**-10):
        settings = {"lambda_pop": weight, "pop_start_iter": 5, "pop_stop_iter": 15, "refine_start_iter": 100}
        script = script_of("pop", settings=settings, steps=steps, quiet=True)
        terms = [step["term"] for step in backend.stage("scripted_steps")(script, script.rows())]
        assert [term != 0.0 for term in terms] == [False, False, True, True, True, False, False]
        _assert_the_oracles(backend, script)


@law("training", "scripted_steps", "method_settings")
def test_of_several_cameras_any_may_show_that_a_gaussian_is_important(backend):
    for pop_over in ("all", "visible"):
        settings = {"lambda_pop": 1.0, "pop_over": pop_over}
        for packed in (False, True):
            _assert_the_oracles(backend, script_of("pop", settings=settings, steps=(2, 3), cameras=3, packed=packed))


@law("training", "method_settings")
def test_every_methods_settings_are_its_recipes(backend):
    for method in METHODS:
        expected, found = ORACLE.stage("method_settings")(method), backend.stage("method_settings")(method)
        for name, value in expected.items():
            assert found[name] == value, f"{name} of {method} is {found[name]!r}, expected {value!r}"


def _of_no_method(**changes):
    """Return scripts for each of a backend's own strategies: the settings that most have, and none of a method."""
    settings = {**GROWTH, **RESETS, "pause_refine_after_reset": 0}
    return Script(settings=settings, **{"steps": EVERY_STEP[:24], "n": 12, **changes})


def _driven(backend, script):
    for method in METHODS if backend.has("method_settings") else (None,):
        own = replace(script, method=method, settings={**script.settings, **OWN.get(method, {})})
        yield method or backend.name, own, backend.stage("scripted_steps")(own, own.rows())


def _edited(script, steps):
    """Yield the number of a step after which the Gaussians were others, and its record."""
    before = script.n
    for number, step in zip(script.steps, steps, strict=True):
        if len(step["params"]["means"]) != before or step["moved"]:
            yield number, step
        before = len(step["params"]["means"])


@law("training", "scripted_steps", "optimizers")
def test_after_every_step_each_optimizer_holds_its_parameter_and_nothing_else(backend):
    for name, script, steps in _driven(backend, _of_no_method()):
        assert list(_edited(script, steps)), f"{name} never changed the Gaussians"
        for number, step in zip(script.steps, steps, strict=True):
            lost = [key for key in KEYS if not step["held"][key]]
            assert not lost, f"{name}, step {number}: the optimizer of {lost} does not hold the parameter, or not alone"


@law("training", "scripted_steps", "optimizers")
def test_edited_parameters_are_trained_as_they_were(backend):
    for name, script, steps in _driven(backend, _of_no_method()):
        for number, step in zip(script.steps, steps, strict=True):
            still = [key for key in KEYS if not step["trainable"][key]]
            assert not still, f"{name}, step {number}: {still} have no gradient any more"
            kinds = {*step["dtypes"].values()}
            assert kinds == {np.dtype(backend.dtype).name}, f"{name}, step {number}: parameters are {kinds}"


@law("training", "scripted_steps", "optimizers")
def test_an_edit_does_not_touch_the_counter_of_updates(backend):
    for name, script, steps in _driven(backend, _of_no_method(steps=EVERY_STEP[:17])):
        for number, step in zip(script.steps, steps, strict=True):
            # where all Gaussians are replaced, Adam begins anew
            if "replaced" not in step["done"]:
                assert step["counted"], f"{name}, step {number}: after the edit updates count {step['counters']}"


@law("training", "scripted_steps", "optimizers")
def test_a_row_stays_one_row_in_every_parameter_and_moment(backend):
    for name, script, steps in _driven(backend, _of_no_method(quiet=True, steps=EVERY_STEP[:16])):
        for number, step in _edited(script, steps):
            if "replaced" in step["done"]:
                break
            at = f"{name}, step {number}: "
            tags = step["params"]["sh0"][:, 0, 0]
            assert_same_bits(f"{at}tags of bands", step["params"]["shN"], np.ones((1, 15, 3)) * tags[:, None, None])
            first = script.rows().params["quats"]
            assert_same_bits(f"{at}turns", step["params"]["quats"], first[tags.astype(int) - 1].astype(backend.dtype))


@law("training", "scripted_steps", "optimizers")
def test_between_its_changes_a_strategy_moves_nothing(backend):
    for name, script, steps in _driven(backend, _of_no_method(steps=(1, 2, 3, 5, 6, 7, 9))):
        for number, step in list(zip(script.steps, steps, strict=True))[:5]:
            moved = [key for key in step["moved"] if key != "means" or not step["noisy"]]
            assert not moved, f"{name} changed {moved} at step {number}, where no change is due"


def _assert_trained_alike(backend, first, second):
    for (name, script, one), (_, _, other) in zip(_driven(backend, first), _driven(backend, second), strict=True):
        for number, a, b in zip(script.steps, one, other, strict=True):
            for key in KEYS:
                assert_same_bits(f"{name}, step {number}: {key}", b["params"][key], a["params"][key])


@law("training", "scripted_steps", "optimizers")
def test_packed_rows_are_collected_as_all_rows_are(backend):
    dense, packed = (_of_no_method(cameras=2, seed=3, packed=packed, steps=EVERY_STEP[:17]) for packed in (False, True))
    _assert_trained_alike(backend, dense, packed)


@law("training", "scripted_steps", "optimizers")
def test_a_training_leaves_nothing_to_the_next_one(backend):
    script = _of_no_method(steps=EVERY_STEP[:16])
    _assert_trained_alike(backend, script, script)
