"""Density control: the statistic's units, what is selected under every reading, the schedule, one whole step."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from scipy.spatial.transform import Rotation

from pop_ref import density as oracle
from pop_ref.conformance.backends import shipped
from pop_ref.density import (
    GSPLAT,
    POP,
    DensityConfig,
    Rows,
    Statistics,
    accumulate,
    average_grads,
    blur_set,
    blurs_at,
    clone_rows,
    densifies_at,
    densify_and_prune,
    grow_masks,
    prune_mask,
    prune_rows,
    reset_opacities,
    resets_at,
    rows_from_params,
    split_rows,
    zero_statistics,
)
from pop_ref.optimizer import adam_step, is_updated, learning_rates, sh_degree_at, update_numbers
from pop_ref.recipes import BASELINES, RECIPES
from pop_ref.settings import Recipe, UpdateRules
from pop_ref.training import Training, update

EYE = np.array([True])
STEPS = range(30_000)
SMALL, LARGE, HUGE = 0.005, 0.05, 0.5


def population(n: int, seed: int = 0, scale: float = LARGE, opacity: float = 0.5) -> Rows:
    rng = np.random.default_rng(seed)
    params = {
        "means": rng.normal(size=(n, 3)),
        "scales": np.log(scale * rng.uniform(0.5, 1.0, (n, 3))),
        "quats": rng.normal(size=(n, 4)),
        "opacities": np.full(n, np.log(opacity / (1.0 - opacity))),
        "tag": np.arange(float(n)),
    }
    m = {name: rng.normal(size=array.shape) for name, array in params.items()}
    return Rows(params, m, {name: rng.random(array.shape) for name, array in params.items()})


def window(grads: list[float], blurred: list[bool] | None = None) -> Statistics:
    n = len(grads)
    flags = np.array([False] * n if blurred is None else blurred, dtype=bool)
    return replace(zero_statistics(n), grad_sum=np.array(grads), n_visible=np.ones(n, np.int64), blurred=flags)


def view(
    statistics: Statistics, counts: list[int], width: int = 10, height: int = 10, config: DensityConfig = POP
) -> Statistics:
    n = len(counts)
    return accumulate(statistics, np.zeros((n, 2)), np.ones(n, bool), np.array(counts), width, height, config)


def draws(n: int) -> np.ndarray:
    return np.random.default_rng(n).standard_normal((2, n, 3))


def test_gradients_are_counted_in_units_of_half_an_image() -> None:
    v_means2d = np.array([[2.0**-5, 0.0], [0.0, 2.0**-5], [2.0**-5, -(2.0**-5)]])
    s = accumulate(zero_statistics(3), v_means2d, np.ones(3, bool), np.zeros(3, np.int64), width=64, height=128)
    assert s.grad_sum.tolist() == [1.0, 2.0, np.sqrt(5.0)]


def test_only_views_that_show_a_gaussian_count_for_it() -> None:
    s = zero_statistics(2)
    for visible in ([True, False], [True, True], [True, False]):
        s = accumulate(s, np.array([[1.0, 0.0], [1.0, 0.0]]), np.array(visible), np.zeros(2, np.int64), 2, 2)
    assert s.grad_sum.tolist() == [3.0, 1.0]
    assert s.n_visible.tolist() == [3, 1]
    assert s.n_views == 3


def test_average_divides_by_visible_views_or_by_the_window() -> None:
    s = replace(zero_statistics(3), grad_sum=np.array([6.0, 2.0, 0.0]), n_visible=np.array([3, 1, 0]), n_views=4)
    assert average_grads(s).tolist() == [2.0, 2.0, 0.0]
    assert average_grads(s, replace(POP, grad_denominator="window")).tolist() == [1.5, 0.5, 0.0]
    assert average_grads(zero_statistics(1), replace(POP, grad_denominator="window")).tolist() == [0.0]


@pytest.mark.parametrize(
    ("width", "height", "least"), [(980, 545, 11), (1237, 822, 21), (1557, 1038, 33), (1264, 832, 22)]
)
def test_blur_threshold_is_two_hundred_thousandths_of_the_image(width: int, height: int, least: int) -> None:
    assert blur_set(np.array([least - 1, least]), width, height, POP.theta_blur).tolist() == [False, True]


def test_a_least_number_of_pixels_is_exceeded_too_and_changes_nothing_where_the_share_is_more() -> None:
    counts = np.array([10, 11, 20, 21])
    assert blur_set(counts, 480, 270, 2e-5, min_pixels=10.0).tolist() == [False, True, True, True]
    assert blur_set(counts, 1000, 1000, 2e-5, min_pixels=10.0).tolist() == [False, False, False, True]


@pytest.mark.parametrize("reading", ["any_view", "sum", "own_view"])
def test_where_a_mask_leaves_pixels_out_the_share_is_of_those_that_count(reading: str) -> None:
    config = DensityConfig(theta_blur=0.25, blur_window=reading, blur_min_pixels=2.0)
    nothing = (np.zeros((3, 2)), np.ones(3, bool), np.array([3, 5, 17]), 8, 8, config)
    assert accumulate(zero_statistics(3), *nothing).blurred.tolist() == [False, False, True]
    assert accumulate(zero_statistics(3), *nothing, kept_pixels=16).blurred.tolist() == [False, True, True]
    # a mask that keeps next to nothing does not make every pixel blur
    assert accumulate(zero_statistics(3), *nothing, kept_pixels=4).blurred.tolist() == [True, True, True]
    assert blur_set(np.array([2, 3]), 8, 8, 0.25, 2.0, kept_pixels=4).tolist() == [False, True]


def test_the_population_can_rest_after_a_reset() -> None:
    resting = replace(GSPLAT, pause_refine_after_reset=250)
    skipped = {step for step in STEPS if densifies_at(step, GSPLAT)} - {s for s in STEPS if densifies_at(s, resting)}
    assert skipped == {reset + rest for reset in range(3000, 15_000, 3000) for rest in (0, 100, 200)}


def test_blur_readings_part_over_a_window_of_views() -> None:
    theta = {"theta_blur": 0.055}
    seen = {}
    for reading in ("any_view", "sum", "own_view"):
        s, config = zero_statistics(4), DensityConfig(blur_window=reading, **theta)
        for counts in ([6, 0, 3, 0], [0, 6, 3, 0]):
            s = view(s, counts, config=config)
        seen[reading] = s.blurred.tolist()
    assert seen["any_view"] == [True, True, False, False]
    assert seen["sum"] == [True, True, True, False]
    assert seen["own_view"] == [False, True, False, False]


def test_blur_threshold_is_each_views_own() -> None:
    s = view(zero_statistics(1), [6], width=10, height=20, config=replace(POP, theta_blur=0.055))
    assert not s.blurred[0]
    assert view(s, [6], width=10, height=10, config=replace(POP, theta_blur=0.055)).blurred[0]


@given(
    st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), max_size=12), st.sampled_from([600, 3000, 8000])
)
def test_a_gaussian_is_cloned_or_split_by_size_and_never_both(
    members: list[tuple[bool, bool, bool]], step: int
) -> None:
    s = window([1.0 if high else 0.0 for high, _, _ in members], [blurred for _, blurred, _ in members])
    scales = np.array([[SMALL if small else LARGE] * 3 for _, _, small in members]).reshape(-1, 3)
    clone, split = grow_masks(s, scales, 1.0, step)
    selected = [high or (blurred and 3000 <= step <= 7000) for high, blurred, _ in members]
    assert clone.tolist() == [picked and small for picked, (_, _, small) in zip(selected, members, strict=True)]
    assert split.tolist() == [picked and not small for picked, (_, _, small) in zip(selected, members, strict=True)]


def test_thresholds_are_strict_as_in_gsplat_and_not_as_in_inria() -> None:
    s, scales = window([2e-4, np.nextafter(2e-4, 1.0)]), np.full((2, 3), SMALL)
    assert grow_masks(s, scales, 1.0, 600)[0].tolist() == [False, True]
    assert grow_masks(s, scales, 1.0, 600, replace(POP, inclusive=True))[0].tolist() == [True, True]


def test_largest_axis_decides_and_equality_is_small() -> None:
    scales = np.array([[0.25, 0.0, 0.0], [0.0, 0.0, np.nextafter(0.25, 1.0)]])
    clone, split = grow_masks(window([1.0, 1.0]), scales, 1.0, 600, replace(POP, grow_scale3d=0.25))
    assert (clone.tolist(), split.tolist()) == ([True, False], [False, True])


def test_scene_scale_multiplies_the_size_thresholds() -> None:
    scales = np.full((1, 3), LARGE)
    assert grow_masks(window([1.0]), scales, 1.0, 600)[1][0]
    assert grow_masks(window([1.0]), scales, 10.0, 600)[0][0]
    assert not prune_mask(np.ones(1), np.full((1, 3), HUGE), 10.0, 3001)[0]


def test_gradient_growth_beside_the_blur_rule_can_be_chosen() -> None:
    s, scales = window([1.0, 0.0], [False, True]), np.full((2, 3), SMALL)
    chosen = {
        POP: ([True, False], [True, True]),
        replace(POP, grow_on_gradient_in_blur_window=False): ([True, False], [False, True]),
        replace(POP, grow_on_gradient=False): ([False, False], [False, True]),
    }
    for config, (before, inside) in chosen.items():
        assert grow_masks(s, scales, 1.0, 2900, config)[0].tolist() == before
        assert grow_masks(s, scales, 1.0, 3000, config)[0].tolist() == inside


def test_split_only_blur_splits_small_ones_and_may_clone_them_as_well() -> None:
    s = window([1.0, 1.0, 0.0, 0.0], [True, False, True, False])
    clone, split = grow_masks(s, np.full((4, 3), SMALL), 1.0, 3000, replace(POP, blur_rule="split"))
    assert clone.tolist() == [True, True, False, False]
    assert split.tolist() == [True, False, True, False]


def test_pruning_takes_faint_ones_always_and_huge_ones_after_step_3000() -> None:
    opacities, scales = np.array([0.0, 0.005, 1.0, 1.0]), np.array([[SMALL] * 3, [SMALL] * 3, [0, 0, HUGE], [0.1] * 3])
    assert prune_mask(opacities, scales, 1.0, 3000, GSPLAT).tolist() == [True, False, False, False]
    assert prune_mask(opacities, scales, 1.0, 3001, GSPLAT).tolist() == [True, False, True, False]
    assert prune_mask(opacities, scales, 1.0, 9000, POP).tolist() == [True, *[False] * 3]


def test_schedule_has_144_densification_steps_41_with_blur_and_4_resets() -> None:
    densified = [s for s in STEPS if densifies_at(s, POP)]
    assert (len(densified), densified[0], densified[-1]) == (144, 600, 14_900)
    blurred = [s for s in densified if blurs_at(s, POP)]
    assert (len(blurred), blurred[0], blurred[-1]) == (41, 3000, 7000)
    assert [s for s in STEPS if resets_at(s, POP)] == []
    assert [s for s in STEPS if resets_at(s, GSPLAT)] == [3000, 6000, 9000, 12_000]
    assert resets_at(0, replace(GSPLAT, reset_at_zero=True))
    assert not any(blurs_at(s, GSPLAT) for s in STEPS)


def test_children_are_drawn_from_their_parent_and_1_6_times_smaller() -> None:
    rows, mask = population(4), np.array([False, True, False, True])
    eps = draws(2)
    split = split_rows(rows, mask, eps).params
    rotation = Rotation.from_quat(rows.params["quats"][mask], scalar_first=True)
    scales = np.exp(rows.params["scales"][mask])
    for child in range(2):
        here = slice(2 + 2 * child, 4 + 2 * child)
        expected = rows.params["means"][mask] + rotation.apply(scales * eps[child])
        np.testing.assert_allclose(split["means"][here], expected, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(np.exp(split["scales"][here]), scales / 1.6, rtol=1e-14)
        np.testing.assert_array_equal(split["quats"][here], rows.params["quats"][mask])
        np.testing.assert_array_equal(split["opacities"][here], rows.params["opacities"][mask])
        np.testing.assert_array_equal(split["tag"][here], [1.0, 3.0])


@given(st.sampled_from([-40.0, 0.0, 40.0]) | st.floats(-30.0, 30.0))
def test_two_revised_children_are_as_opaque_as_their_parent(logit: float) -> None:
    rows = population(1)
    rows = replace(rows, params={**rows.params, "opacities": np.array([logit])})
    child = split_rows(rows, EYE, draws(1), revised_opacity=True).params["opacities"][0]
    # 1 - o = 1 / (1 + e^logit) on both sides, in logarithms so that neither end is rounded away
    assert 2.0 * np.logaddexp(0.0, child) == pytest.approx(np.logaddexp(0.0, logit), rel=1e-12)


def test_order_after_a_densification_is_survivors_copies_first_children_second_children() -> None:
    rows = population(5)
    scales = np.log(np.array([SMALL, LARGE, SMALL, LARGE, LARGE])[:, None] * np.ones((5, 3)))
    rows = replace(rows, params={**rows.params, "scales": scales})
    after, _ = densify_and_prune(rows, window([1.0, 1.0, 1.0, 0.0, 1.0]), 1.0, 600, draws)
    assert after.params["tag"].tolist() == [0.0, 2.0, 3.0, 0.0, 2.0, 1.0, 4.0, 1.0, 4.0]
    assert np.all(after.m["tag"][3:] == 0.0)
    np.testing.assert_array_equal(after.m["tag"][:3], rows.m["tag"][[0, 2, 3]])


@pytest.mark.parametrize("n", [0, 1, 3])
def test_everything_selected_or_nothing(n: int) -> None:
    rows, everyone, nobody = population(n), np.ones(n, bool), np.zeros(n, bool)
    assert len(clone_rows(rows, everyone)) == len(split_rows(rows, everyone, draws(n))) == 2 * n
    assert len(prune_rows(rows, everyone)) == 0
    for same in (clone_rows(rows, nobody), split_rows(rows, nobody, draws(0)), prune_rows(rows, nobody)):
        for before, after in ((rows.params, same.params), (rows.m, same.m), (rows.v, same.v)):
            assert all(np.array_equal(before[name], after[name]) for name in before)


def test_a_population_that_is_pruned_to_nothing_can_go_on() -> None:
    rows, s = densify_and_prune(population(3, opacity=0.001), zero_statistics(3), 1.0, 600, draws)
    assert len(rows) == 0
    rows, s = densify_and_prune(rows, s, 1.0, 700, draws)
    assert len(rows) == len(s.grad_sum) == 0
    assert rows.params["means"].shape == (0, 3)
    assert len(reset_opacities(rows)) == 0


def test_unfit_rows_and_draws_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="lengths"):
        rows_from_params({"means": np.zeros((2, 3)), "opacities": np.zeros(3)})
    with pytest.raises(ValueError, match="at least one key"):
        rows_from_params({})
    with pytest.raises(ValueError, match=r"v\['means'\]"):
        Rows({"means": np.zeros((2, 3))}, {"means": np.zeros((2, 3))}, {"means": np.zeros((2, 2))})
    with pytest.raises(Exception, match="normals"):
        split_rows(population(2), np.array([True, False]), draws(2))


# Row operations against a model that keeps each Gaussian as one dictionary: nothing may come apart.

KEYS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": ()}
LEARNING_RATE = {name: 0.0 if name == "sh0" else 0.125 for name in KEYS}
MOST_ROWS = 24


@dataclass
class Member:
    """One Gaussian of the model."""

    params: dict[str, list[float]]
    m: dict[str, list[float]]
    v: dict[str, list[float]]

    def child(self, **changed: list[float]) -> Member:
        """Return a copy with other parameters and no history."""
        zeros = {name: [0.0] * len(value) for name, value in self.params.items()}
        return Member({**self.params, **changed}, zeros, dict(zeros))


def member(tag: int) -> Member:
    wave = [math.sin(1.0 + tag + 3 * k) for k in range(4)]
    params = {"means": wave[:3], "scales": wave[1:], "quats": wave, "opacities": [2.0 * wave[0]], "sh0": [float(tag)]}
    return Member(params, *({name: [0.0] * len(value) for name, value in params.items()} for _ in range(2)))


def rotated(quat: list[float], point: list[float]) -> list[float]:
    """Rotate by p -> p + 2 w (u x p) + 2 u x (u x p) with the unit quaternion (w, u)."""
    norm = math.sqrt(sum(c * c for c in quat))
    w, *u = (c / norm for c in quat)
    once = [u[(k + 1) % 3] * point[(k + 2) % 3] - u[(k + 2) % 3] * point[(k + 1) % 3] for k in range(3)]
    twice = [u[(k + 1) % 3] * once[(k + 2) % 3] - u[(k + 2) % 3] * once[(k + 1) % 3] for k in range(3)]
    return [point[k] + 2.0 * (w * once[k] + twice[k]) for k in range(3)]


class RowMachine(RuleBasedStateMachine):
    """Apply the same edits to arrays and to the model."""

    def operation(self, name: str) -> Any:
        return getattr(oracle, name)

    def edit(self, name: str, *args: Any) -> None:
        after = self.operation(name)(*args)
        self.rows = oracle.Rows(after.params, after.m, after.v)

    @initialize(n=st.integers(0, 4))
    def start(self, n: int) -> None:
        self.model = [member(tag) for tag in range(n)]
        self.updates = 0
        params = {
            name: np.array([g.params[name] for g in self.model], dtype=np.float64).reshape(n, *shape)
            for name, shape in KEYS.items()
        }
        self.edit("rows_from_params", params)

    def chosen(self, data: st.DataObject) -> tuple[list[bool], Any]:
        n = len(self.model)
        picks = data.draw(st.lists(st.booleans(), min_size=n, max_size=n), label="mask")
        return picks, np.array(picks, dtype=bool)

    @rule(data=st.data())
    @precondition(lambda self: len(self.model) <= MOST_ROWS)
    def clone(self, data: st.DataObject) -> None:
        picks, mask = self.chosen(data)
        self.edit("clone_rows", self.rows, mask)
        self.model += [g.child() for g, pick in zip(self.model, picks, strict=True) if pick]

    @rule(data=st.data())
    @precondition(lambda self: len(self.model) <= MOST_ROWS)
    def split(self, data: st.DataObject) -> None:
        picks, mask = self.chosen(data)
        n_split = sum(picks)
        normals = np.cos(np.arange(6.0 * n_split)).reshape(2, n_split, 3)
        self.edit("split_rows", self.rows, mask, normals)
        parents = [g for g, pick in zip(self.model, picks, strict=True) if pick]
        self.model = [g for g, pick in zip(self.model, picks, strict=True) if not pick]
        for child in range(2):
            for parent, eps in zip(parents, normals[child].tolist(), strict=True):
                log_scales, mean = parent.params["scales"], parent.params["means"]
                offset = rotated(
                    parent.params["quats"], [math.exp(s) * e for s, e in zip(log_scales, eps, strict=True)]
                )
                moved = [a + b for a, b in zip(mean, offset, strict=True)]
                self.model.append(parent.child(means=moved, scales=[s - math.log(1.6) for s in log_scales]))

    @rule(data=st.data())
    def prune(self, data: st.DataObject) -> None:
        picks, mask = self.chosen(data)
        self.edit("prune_rows", self.rows, mask)
        self.model = [g for g, pick in zip(self.model, picks, strict=True) if not pick]

    @rule(ceiling=st.sampled_from([0.01, 0.25]))
    def reset(self, ceiling: float) -> None:
        self.edit("reset_opacities", self.rows, ceiling)
        logit = math.log(ceiling / (1.0 - ceiling))
        for g in self.model:
            g.params["opacities"] = [min(g.params["opacities"][0], logit)]
            g.m["opacities"], g.v["opacities"] = [0.0], [0.0]

    @rule()
    def train(self) -> None:
        """Give every row its own gradient, so that its moments tell it from the others."""
        self.updates += 1
        arrays = [{name: np.asarray(a) for name, a in part.items()} for part in self.parts()]
        grads = {name: np.cos(array) for name, array in arrays[0].items()}
        updated = adam_step(arrays[0], grads, arrays[1], arrays[2], self.updates, LEARNING_RATE)
        self.rows = oracle.Rows(*updated)
        for g in self.model:
            lists = [{name: np.array(value) for name, value in part.items()} for part in (g.params, g.m, g.v)]
            grads = {name: np.cos(value) for name, value in lists[0].items()}
            new = adam_step(lists[0], grads, lists[1], lists[2], self.updates, LEARNING_RATE)
            g.params, g.m, g.v = ({name: value.tolist() for name, value in part.items()} for part in new)

    def parts(self) -> tuple[Any, Any, Any]:
        return self.rows.params, self.rows.m, self.rows.v

    @invariant()
    def rows_are_the_models(self) -> None:
        assert len(self.rows) == len(self.model)
        for kind, part in zip(("params", "m", "v"), self.parts(), strict=True):
            for name, shape in KEYS.items():
                expected = np.array([getattr(g, kind)[name] for g in self.model], dtype=np.float64)
                array = np.asarray(part[name])
                assert array.shape == (len(self.model), *shape)
                np.testing.assert_allclose(array, expected.reshape(array.shape), rtol=1e-10, atol=1e-12)
        # tags are never computed with, so they are exact
        assert np.asarray(self.rows.params["sh0"]).tolist() == [g.params["sh0"][0] for g in self.model]


class TrainedRowMachine(RowMachine):
    def operation(self, name: str) -> Any:
        return shipped("fast64").stage(name)


TestOracleRows = RowMachine.TestCase
TestTrainedRows = TrainedRowMachine.TestCase


# What Adam moves at which step: numbers of updates and rates of every method's schedule, against counts by hand.

NAMES = ("means", "opacities", "shN")


def moved(recipe: Recipe, name: str) -> list[int]:
    return [step for step in range(recipe.max_steps) if is_updated(name, step, recipe)]


def test_a_step_that_edits_the_population_moves_nothing_in_inrias_loop() -> None:
    quiet = sorted(set(range(30_000)) - set(moved(RECIPES["3DGS"], "means")))
    assert quiet == list(range(600, 15_000, 100))
    assert len(quiet) == 144
    assert moved(RECIPES["gsplat"], "means") == list(range(30_000))


def test_a_round_of_pup_loses_the_update_that_its_pruning_replaces_and_starts_adam_anew() -> None:
    recipe = BASELINES["PUP-3DGS"]
    late = [step for step in moved(recipe, "means") if step >= 30_000]
    assert late == [*range(30_001, 35_000), *range(35_001, 40_000)]
    assert update_numbers(NAMES, 30_001, recipe) == dict.fromkeys(NAMES, 1)
    assert update_numbers(NAMES, 34_999, recipe)["means"] == 4_999


def test_taming_moves_upper_bands_each_16_steps_and_opacities_until_15_000() -> None:
    recipe = replace(BASELINES["Taming-3DGS"], updates=replace(BASELINES["Taming-3DGS"].updates))
    bands = moved(recipe, "shN")
    assert bands[:3] == [15, 31, 47]
    assert all((step + 1) % 16 == 0 for step in bands)
    assert max(moved(recipe, "opacities")) == 14_999
    assert max(moved(recipe, "means")) == 29_999
    assert update_numbers(["shN"], 47, recipe) == {"shN": 3}


def test_the_positions_rate_of_mini_splatting_goes_back_to_what_it_was() -> None:
    rules, plain = BASELINES["Mini-Splatting"].updates, UpdateRules()
    for step, like in ((14_999, 14_999), (15_000, 5_000), (29_999, 19_999)):
        assert learning_rates(step, 1.0, rules=rules)["means"] == learning_rates(like, 1.0, rules=plain)["means"]
    steps = (14_999, 15_999, 16_000, 17_000, 18_000)
    assert [sh_degree_at(step, start=rules.sh_start_iter) for step in steps] == [0, 0, 1, 2, 3]


def test_in_a_round_of_pup_rates_fall_from_where_the_training_ended() -> None:
    rules = BASELINES["PUP-3DGS"].updates
    first, last = (learning_rates(step, 1.0, 40_000, rules=rules) for step in (30_000, 34_999))
    assert first["means"] == pytest.approx(1.6e-4 * 0.01 ** (30_001 / 35_000), rel=1e-14)
    assert last["means"] == pytest.approx(1.6e-6, rel=1e-14)
    # twelve times, 0.95 each
    assert last["scales"] / first["scales"] == pytest.approx(0.95**12, rel=1e-14)
    assert learning_rates(35_000, 1.0, 40_000, rules=rules) == first
    before = learning_rates(29_999, 1.0, 40_000, rules=rules)
    assert before["means"] == pytest.approx(1.6e-4 * 0.01 ** (29_999 / 30_000), rel=1e-14)
    assert before["scales"] == first["scales"]


def test_gradients_that_wait_are_spent_at_once() -> None:
    recipe = Recipe(updates=UpdateRules(sh_rest_every=3))
    rows = rows_from_params({"means": np.zeros((1, 3)), "shN": np.zeros((1, 3, 3))})
    state = Training(rows, zero_statistics(1))
    for step, size in enumerate((1.0, 2.0, 4.0)):
        state = replace(state, step=step)
        grads = {"means": np.ones((1, 3)), "shN": np.full((1, 3, 3), size)}
        rows, waiting = update(state.rows, grads, state, 1.0, recipe)
        state = replace(state, rows=rows, waiting=waiting)
        assert (state.rows.params["shN"] != 0.0).any() == (step == 2)
    assert not state.waiting
    # m = (1 - beta1) g of the sum of all three
    np.testing.assert_allclose(state.rows.m["shN"], 0.1 * 7.0, rtol=1e-14)
    assert (state.rows.params["means"] != 0.0).all()
