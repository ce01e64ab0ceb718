"""Laws of what the steps of a training collect for density control: the engine takes them as a run does, and moves
nothing; and of what passes over its photographs sum.

Rounding decides nothing that is compared, so that counts and flags are equal exactly.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from pop_ref.appearance import background_at
from pop_ref.compositing import composite
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.error_bounds import pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import screened, sensitivity_error_bounds, weight_error_bounds
from pop_ref.conformance.law import law
from pop_ref.conformance.short_training import VIEWS, clear_watch, collected
from pop_ref.conformance.strategy_script import METHODS
from pop_ref.contributions import contributions
from pop_ref.fisher import fisher_blocks, screen_moments
from pop_ref.records import Camera
from pop_ref.sensitivity import sensitivities

ORDER = (0, 1, 2, 1)
BLUR = {"theta_blur": 0.05, "blur_start_iter": 0, "blur_stop_iter": 60}
DIVISOR = 4


@functools.cache
def _watch(first_seed, batch=1, masked=False, antialiased=False, sh_interval=2, mixed=False, **settings):
    options = {"batch": batch, "masked": masked, "antialiased": antialiased, "sh_interval": sh_interval}
    options |= {"mixed": mixed}
    return clear_watch(first_seed, order=ORDER, settings={**BLUR, **settings}, **options)


@functools.cache
def _expected(dtype, first_seed, asks):
    return collected(_watch(first_seed, **dict(asks)), dtype)


def _assert_collected(backend, first_seed, **asks):
    """Assert that gradient sums and views are the oracle's; return what was found and what was expected, by step."""
    watch = _watch(first_seed, **asks)
    found = backend.stage("collected_statistics")(watch)
    expected = _expected(backend.dtype, first_seed, tuple(asks.items()))
    for step, (got, wanted) in enumerate(zip(found, expected, strict=True)):
        at = f"after step {step}"
        bounds = wanted.error_bounds[0]
        sums = got["grad2d"], wanted.window.grad_sum
        assert_close("training.collected", *sums, bounds, backend.dtype, True, place=_row_of(f"{at}, gradient sums"))
        assert_same_bits(f"{at}: views that show each", got["count"], wanted.window.n_visible, place=_row_of(at))
        assert got["views"] == wanted.window.n_views, f"{at}: {got['views']} views, expected {wanted.window.n_views}"
    assert np.any(expected[-1].window.grad_sum > 0.0)
    return zip(found, expected, strict=True)


def _row_of(where):
    return lambda index: f"{where}, Gaussian {index[0]}"


def _assert_flags(pairs):
    flags = set()
    for step, (got, wanted) in enumerate(pairs):
        assert_same_bits(f"blur flags after step {step}", got["blurred"], wanted.window.blurred, place=_row_of("flags"))
        flags |= set(wanted.window.blurred.tolist())
    assert flags == {False, True}, "of flags that are all alike nothing can be said"


@law("training", "collected_statistics")
def test_a_training_collects_the_oracles_gradients_views_and_blur_flags(backend):
    for k, window in enumerate(("own_view", "any_view", "sum")):
        _assert_flags(_assert_collected(backend, 300 * k, blur_window=window))


@law("training", "collected_statistics")
def test_a_training_sums_the_pixels_that_each_gaussian_dominates_in_the_window(backend):
    window = {"pop_views": "window", "blur_stop_iter": -1}
    # also when nothing grows any more, as long as the POP term reads the window
    for asks in ({"blur_window": "sum"}, window, {**window, "refine_stop_iter": 1}):
        for step, (got, wanted) in enumerate(_assert_collected(backend, 0, **asks)):
            assert_same_bits(f"dominated pixels after step {step}", got["dominant_sum"], wanted.window.dominant_sum)


@law("training", "collected_statistics")
def test_pixels_that_a_mask_leaves_out_are_not_collected(backend):
    # also where no prior asks what is dominated
    for window, weight in (("own_view", 1e-3), ("sum", 0.0)):
        asks = {"blur_window": window, "lambda_pop": weight}
        pairs = list(_assert_collected(backend, 0, masked=True, theta_blur=0.08, **asks))
        _assert_flags(pairs)
        if window == "sum":
            for got, wanted in pairs:
                assert_same_bits("dominated pixels", got["dominant_sum"], wanted.window.dominant_sum)


@law("training", "collected_statistics")
def test_the_views_of_one_step_are_collected_one_after_the_other(backend):
    for window in ("own_view", "any_view", "sum"):
        _assert_flags(_assert_collected(backend, 0, batch=2, blur_window=window))
    for got, wanted in _assert_collected(backend, 0, batch=2, masked=True, blur_window="sum"):
        assert_same_bits("dominated pixels", got["dominant_sum"], wanted.window.dominant_sum)


@law("training", "collected_statistics")
def test_views_of_one_step_are_collected_at_their_own_sizes(backend):
    for masked in (False, True):
        _assert_flags(_assert_collected(backend, 0, batch=2, mixed=True, masked=masked))


@law("training", "collected_statistics")
def test_antialiased_steps_collect_antialiased_gradients(backend):
    _assert_flags(_assert_collected(backend, 0, antialiased=True))


@law("training", "collected_statistics")
def test_absolute_gradients_are_collected_where_they_are_asked_for(backend):
    for batch in (1, 2):
        asks = {"batch": batch}
        signed, absolute = (list(_assert_collected(backend, 0, absgrad=asked, **asks)) for asked in (False, True))
        assert np.any(absolute[-1][0]["grad2d"] > 1.01 * signed[-1][0]["grad2d"])


@law("training", "collected_statistics")
def test_the_largest_extent_of_the_window_is_collected_where_a_rule_reads_it(backend):
    for batch in (1, 2):
        for step, (got, wanted) in enumerate(_assert_collected(backend, 0, batch=batch, refine_scale2d_stop_iter=50)):
            bound = wanted.extents
            assert_close("training.extents", got["radii"], wanted.extents, bound, backend.dtype, True)
            assert step or np.any(got["radii"] > 0.0)


@law("training", "collected_statistics")
def test_gradients_of_upper_bands_wait_for_their_update(backend):
    for batch in (1, 2):
        asks = {"batch": batch, "sh_rest_every": 3, "sh_interval": 1}
        for step, (got, wanted) in enumerate(_assert_collected(backend, 0, **asks)):
            if step == 1:
                found, expected, bounds = got["sh_rest_sum"], wanted.waiting, wanted.error_bounds[1]
                assert np.any(expected != 0.0)
                assert_close("training.waiting", found, expected, bounds, backend.dtype, True)


@law("training", "collected_statistics")
def test_after_refinement_has_ended_nothing_is_collected(backend):
    asks = {"refine_stop_iter": 2, "blur_window": "sum"}
    watch = _watch(0, **asks)
    found = backend.stage("collected_statistics")(watch)
    assert np.any(found[1]["grad2d"] > found[0]["grad2d"])
    for later in found[2:]:
        for name in ("grad2d", "count", "dominant_sum"):
            assert_same_bits(f"{name} after the end", later[name], found[1][name])


@law("training", "collected_statistics")
def test_a_training_whose_rates_are_zero_moves_nothing(backend):
    watch = _watch(0)
    for got in backend.stage("collected_statistics")(watch):
        for name, value in watch.params.items():
            assert_same_bits(name, got["params"][name], value.astype(backend.dtype))


@law("training", "collected_statistics")
def test_the_mean_opacity_and_the_mean_scale_pull_at_opacities_and_at_scales(backend):
    watch, found = dataclasses.replace(_watch(0), order=(0,)), []
    for weight in (64.0, 192.0):
        asked = dataclasses.replace(watch, regularizers={"opacity_reg": weight, "scale_reg": 2.0 * weight})
        found.append(backend.stage("collected_statistics")(asked)[0]["first_moments"])
    p, n = watch.params, len(watch.params["means"])
    o = 1.0 / (1.0 + np.exp(-p["opacities"]))
    # a tenth of the first gradient; whatever else pulls is there both times
    slopes = {"opacities": o * (1.0 - o) / n, "scales": 2.0 * np.exp(p["scales"]) / (3.0 * n)}
    for name, slope in slopes.items():
        difference, size = found[1][name] - found[0][name], 19.2 * slope + 0.1
        assert_close("training.regularizers", difference, 12.8 * slope, size, backend.dtype)


@law("training", "written_meta")
def test_what_a_strategy_writes_into_meta_stays_whether_it_was_read_before_or_not(backend):
    # as counts inside a mask take the place of those of the whole picture
    assert backend.stage("written_meta")(_watch(0)) == []


@law("training", "blank_losses")
def test_where_nothing_is_drawn_and_a_photograph_is_clear_both_are_the_same_background(backend):
    # in the colours of the photograph, whatever its exposure
    exposure = np.array([[0.5, 0.25, 0.0, 0.125], [0.0, 0.75, 0.0, 0.25], [0.25, 0.0, 1.0, -0.125]])
    for loss in backend.stage("blank_losses")(_watch(0), exposure, 5, False):
        # the square of a rounding
        assert loss <= (8.0 * np.finfo(backend.dtype).eps) ** 2, f"a loss of {loss} is left"


@law("training", "blank_losses")
def test_every_step_draws_over_the_background_of_its_number_and_of_the_runs_seed(backend):
    # before a black photograph the loss is the mean square of what is drawn, which is the background
    for seed in (0, 5):
        found = backend.stage("blank_losses")(_watch(0), np.eye(3, 4), seed, True)
        expected = np.array([np.mean(background_at(step, seed) ** 2) for step in range(len(found))])
        assert_close("training.term", found, expected, expected, backend.dtype, against_oracle=True)


@law("training", "view_order")
def test_every_epoch_shows_every_view_once_in_an_order_of_its_own(backend):
    n, epochs = 7, 6
    drawn = backend.stage("view_order")(n, 3, n * epochs)
    orders = [tuple(drawn[n * k : n * (k + 1)]) for k in range(epochs)]
    assert all(sorted(order) == list(range(n)) for order in orders)
    # of six orders of seven views hardly two are alike
    assert len(set(orders)) >= epochs - 1
    assert backend.stage("view_order")(n, 3, n * epochs) == drawn
    assert backend.stage("view_order")(n, 4, n * epochs) != drawn


def _scaled(steps, factor):
    if isinstance(steps, tuple):
        return tuple(_scaled(step, factor) for step in steps)
    # neither -1, which is never, nor 0, the beginning, is a share of a schedule
    return max(round(steps * factor), 1) if steps > 0 else steps


@law("training", "scaled_settings")
def test_a_shorter_schedule_changes_the_gaussians_less_often_and_resets_no_sooner(backend):
    recovery = ("reset_every", "pause_refine_after_reset", "prune_too_big_after")
    for method in METHODS:
        for factor in (0.125, 0.5, 2.0):
            own, scaled = backend.stage("scaled_settings")(method, factor)
            # whatever is the number of a step, or several of them
            steps = {name for name in own if name.endswith(("_iter", "_iters"))}
            assert steps >= {"refine_start_iter", "refine_stop_iter"}
            for name in steps | {"round_steps", "round_decay_every", "means_rewind_to"}:
                assert scaled[name] == _scaled(own[name], factor), f"{name} of {method} is {scaled[name]}"
            assert scaled["refine_every"] == max(round(own["refine_every"] * factor), min(100, own["refine_every"]))
            for name in recovery:
                assert scaled[name] == max(round(own[name] * factor), own[name]), name
            for name in ("grow_grad2d", "prune_opa", "theta_blur"):
                assert scaled[name] == own[name], name


def _map(camera):
    return np.mod(np.arange(camera.height * camera.width, dtype=np.float64), 7.0).reshape(camera.height, camera.width)


def _assert_told(backend, given, found):
    """Assert that the picture, the depths and the extents that a pass tells are the oracle's."""
    image = composite(*given.view, given.scene.background, given.scene.profile).image
    bounds, shown = given.error_bounds, np.all(given.splats.radii > 0, axis=1)
    assert_close("training.passes", found["image"], image, bounds.image, backend.dtype, True, bounds.unambiguous)
    ends = found["depths"], given.splats.depths
    assert_close("training.passes", *ends, bounds.screen.e_depths, backend.dtype, True, shown, _row_of("depths"))
    assert_same_bits("extents", found["radii"], given.splats.radii)


@law("training", "view_passes")
def test_passes_over_photographs_sum_what_their_views_show(backend):
    for asks in ({}, {"masked": True}, {"antialiased": True}):
        watch = _watch(0, **asks)
        for view in range(VIEWS):
            found = backend.stage("view_passes")(watch, view, DIVISOR)
            given = screened(backend, watch.scene(view, watch.steps))
            expected, rows = contributions(*given.view, _map(watch.cameras[view]), given.scene.profile), given.sure
            _assert_told(backend, given, found)
            assert_same_bits("pixels", found["n_pixels"][rows], expected.n_pixels[rows])
            weights, distances = weight_error_bounds(given.error_bounds)
            bounds = {"weight_sum": weights, "map_sum": 7.0 * expected.n_pixels, "distance_sum": distances}
            for name, bound in bounds.items():
                ends = found[name][rows], getattr(expected, name)[rows]
                assert_close("training.passes", *ends, bound[rows], backend.dtype, True, place=_row_of(name))
            scores = sensitivities(*given.view, given.scene.background, given.scene.profile)
            bound, ends = sensitivity_error_bounds(given.error_bounds), (found["sensitivities"][rows], scores[rows])
            assert_close("training.passes", *ends, bound[rows], backend.dtype, True, place=_row_of("sensitivities"))


@law("training", "view_passes")
def test_passes_over_photographs_count_dominated_pixels_inside_the_mask(backend):
    watch = _watch(0, masked=True)
    for view in range(VIEWS):
        found = backend.stage("view_passes")(watch, view, DIVISOR)
        inside = found["ids"][watch.mask(view)]
        counts = np.bincount(inside[inside >= 0], minlength=len(found["n_pixels"]))
        assert_same_bits("dominated pixels", found["dominant_counts"], counts)


@law("training", "view_passes")
def test_fisher_blocks_are_those_of_a_smaller_photograph_of_the_same_field_of_view(backend):
    watch, judged = _watch(0), 0
    for view in range(VIEWS):
        c = watch.cameras[view]
        width, height = -(-c.width // DIVISOR), -(-c.height // DIVISOR)
        smaller = Camera(c.viewmat, np.diag([width / c.width, height / c.height, 1.0]) @ c.K, width, height)
        scene = watch.scene(view, watch.steps).with_overrides(camera=smaller)
        bounds = pixel_error_bounds(scene, np.float32)
        if not np.all(bounds.smooth):
            continue
        judged += 1
        given = screened(backend, scene)
        moments = screen_moments(*given.view, scene.background, scene.profile)
        expected = fisher_blocks(scene.gaussians, smaller, moments, scene.sh_degree, scene.profile)
        found = backend.stage("view_passes")(watch, view, DIVISOR)["blocks"]
        # of a matrix of second moments no entry is larger
        sizes = np.sqrt(np.einsum("nii->ni", expected))
        bound = sizes[:, :, None] * sizes[:, None, :] + 1e-12
        assert_close("training.blocks", found, expected, bound, backend.dtype, True, place=_row_of("blocks"))
    assert judged, "rounding decides a pixel of every smaller photograph"
