"""Laws of density control: statistics, selection, and row operations that carry moments (paper eqs. 3, 6)."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic, opacities
from pop_ref.density import GSPLAT, POP, DensityConfig, Rows, Statistics, densify_and_prune

# powers of two, so that a size in units of the scene is exact
scene_scales = st.sampled_from([0.125, 0.5, 1.0, 4.0])
counts = st.lists(st.integers(0, 9), min_size=1, max_size=6)
choices = st.lists(st.sampled_from(["keep", "clone", "split", "prune"]), min_size=1, max_size=6)
W, H = 16, 8


def tagged_rows(n):
    """Return rows whose every number tells its row: the tag is the row index plus one, in all arrays alike."""
    tag = np.arange(1.0, n + 1.0)
    params = {
        "means": tag[:, None] * np.array([1.0, 2.0, 4.0]),
        "scales": -tag[:, None] * np.array([0.25, 0.5, 0.125]),
        "quats": tag[:, None] * np.array([1.0, 0.0, 0.5, 0.0]),
        "opacities": tag * 0.25,
        "sh0": tag[:, None, None] * np.ones((1, 1, 3)),
        "shN": tag[:, None, None] * np.ones((1, 3, 3)),
    }
    m = {name: 16.0 * array for name, array in params.items()}
    v = {name: np.abs(64.0 * array) for name, array in params.items()}
    return Rows(params, m, v)


def masks_of(choices):
    return {kind: np.array([c == kind for c in choices]) for kind in ("clone", "split", "prune")}


@law("density", "clone_rows", choices=choices)
def test_clones_are_exact_copies_at_the_end_with_fresh_moments(backend, choices):
    rows, mask = tagged_rows(len(choices)), masks_of(choices)["clone"]
    grown = backend.stage("clone_rows")(rows, mask)
    n, n_new = len(choices), int(np.sum(mask))
    for name, array in rows.params.items():
        assert_same_bits(f"{name}, survivors", grown.params[name][:n], array)
        assert_same_bits(f"{name}, copies", grown.params[name][n:], array[mask])
        for kind, moments, old in (("m", grown.m, rows.m), ("v", grown.v, rows.v)):
            assert_same_bits(f"{kind}[{name}], survivors", moments[name][:n], old[name])
            assert_same_bits(f"{kind}[{name}], copies", moments[name][n:], np.zeros((n_new, *array.shape[1:])))


@law("density", "prune_rows", choices=choices)
def test_survivors_of_pruning_keep_their_order_bits_and_moments(backend, choices):
    rows, mask = tagged_rows(len(choices)), masks_of(choices)["prune"]
    left = backend.stage("prune_rows")(rows, mask)
    for name in rows.params:
        assert_same_bits(name, left.params[name], rows.params[name][~mask])
        assert_same_bits(f"m[{name}]", left.m[name], rows.m[name][~mask])
        assert_same_bits(f"v[{name}]", left.v[name], rows.v[name][~mask])


@law("density", "split_rows", choices=choices, draws=arrays_of((2, 6, 3)), revised=st.booleans())
def test_a_split_replaces_each_parent_by_two_smaller_children_drawn_from_it(backend, choices, draws, revised):
    rows, mask = tagged_rows(len(choices)), masks_of(choices)["split"]
    n_split, n_kept = int(np.sum(mask)), int(np.sum(~mask))
    normals = draws[:, :n_split].copy()
    after = backend.stage("split_rows")(rows, mask, normals, revised)
    parents = {name: array[mask] for name, array in rows.params.items()}
    w, _, y, _ = (parents["quats"] / np.linalg.norm(parents["quats"], axis=1, keepdims=True)).T
    # the tags' quaternions turn about y only
    turn = np.zeros((n_split, 3, 3))
    turn[:, 0, 0], turn[:, 0, 2], turn[:, 2, 0], turn[:, 2, 2] = 1 - 2 * y * y, 2 * w * y, -2 * w * y, 1 - 2 * y * y
    turn[:, 1, 1] = 1.0
    offset = np.einsum("nij,cnj->cni", turn, np.exp(parents["scales"]) * normals)
    for name, array in rows.params.items():
        assert_same_bits(f"{name}, survivors", after.params[name][:n_kept], array[~mask])
        children = after.params[name][n_kept:].reshape(2, n_split, *array.shape[1:])
        expected = np.repeat(parents[name][None], 2, axis=0)
        if name == "means":
            expected = expected + offset
        if name == "scales":
            expected = expected - np.log(1.6)
        if name == "opacities" and revised:
            # two coincident children let as much light through as their parent (A26)
            through = np.sqrt(1.0 / (1.0 + np.exp(expected)))
            expected = np.log((1.0 - through) / through)
        assert_close("density.split", children, expected, np.abs(expected) + 4.0, backend.dtype)
        for moments, old in ((after.m, rows.m), (after.v, rows.v)):
            assert_same_bits(f"moments of {name}, survivors", moments[name][:n_kept], old[name][~mask])
            assert_same_bits(f"moments of {name}", moments[name][n_kept:], np.zeros((2 * n_split, *array.shape[1:])))


@law("density", "split_rows")
def test_the_revised_opacity_of_children_is_a_number_however_opaque_or_clear_their_parent_is(backend):
    # 1 - sqrt(1 - o) is rounded to 0 or to 1 long before its logit is out of range
    rows = tagged_rows(6)
    rows.params["opacities"][:] = [-60.0, -40.0, -20.0, 20.0, 40.0, 60.0]
    after = backend.stage("split_rows")(rows, np.ones(6, dtype=bool), np.zeros((2, 6, 3)), True)
    log_left = -0.5 * np.logaddexp(0.0, rows.params["opacities"])
    expected = np.tile(np.log(-np.expm1(log_left)) - log_left, 2)
    assert_close("density.split", after.params["opacities"], expected, np.abs(expected) + 4.0, backend.dtype)


@law("density", "reset_opacities", opacity=st.lists(opacities(), min_size=1, max_size=6))
def test_a_reset_lowers_opacities_to_the_ceiling_and_forgets_their_moments_only(backend, opacity):
    rows = tagged_rows(len(opacity))
    o = np.clip(np.array(opacity), 1e-6, 1.0 - 1e-6)
    rows.params["opacities"][:] = np.log(o / (1.0 - o))
    after = backend.stage("reset_opacities")(rows, 0.01)
    logits = after.params["opacities"]
    # a logit of one over 2^20 of an opacity is rounded like its largest term, 14
    assert_close("density.reset", 1.0 / (1.0 + np.exp(-logits)), np.minimum(o, 0.01), 1.0, backend.dtype)
    for name in rows.params:
        if name != "opacities":
            assert_same_bits(name, after.params[name], rows.params[name])
            assert_same_bits(f"m[{name}]", after.m[name], rows.m[name])
    assert_same_bits("m of opacities", after.m["opacities"], np.zeros(len(opacity)))
    assert_same_bits("v of opacities", after.v["opacities"], np.zeros(len(opacity)))


@law("density", "rows_from_params", n=st.integers(1, 4))
def test_new_gaussians_have_zero_moments(backend, n):
    params = tagged_rows(n).params
    rows = backend.stage("rows_from_params")(dict(params))
    for name, array in params.items():
        assert_same_bits(name, rows.params[name], array)
        assert_same_bits(f"m[{name}]", rows.m[name], np.zeros_like(array))
        assert_same_bits(f"v[{name}]", rows.v[name], np.zeros_like(array))


@law(
    "density",
    "blur_set",
    # a share of one and a half pixels: two are more
    first=[{"counts": [1, 2, 3], "theta": 1 / 64, "min_pixels": 0.0, "kept": 96}],
    counts=counts,
    theta=st.sampled_from([1 / 64, 1 / 128, 1 / 32, 0.0]),
    min_pixels=st.sampled_from([0.0, 1.0, 2.5, 3.0, 8.0]),
    kept=st.sampled_from([None, W * H, 64, 32, 0]),
)
def test_the_blur_set_dominates_strictly_more_than_its_share_of_pixels(backend, counts, theta, min_pixels, kept):
    # a share of the pixels that a mask keeps
    blurred = backend.stage("blur_set")(np.array(counts, dtype=np.int64), W, H, theta, min_pixels, kept)
    n_pixels = W * H if kept is None else kept
    assert_same_bits("blurred", blurred, [c > theta * n_pixels and c > min_pixels for c in counts])


views = st.lists(
    st.tuples(dyadic(-1.0, 1.0), dyadic(-1.0, 1.0), st.booleans(), st.integers(0, 5)), min_size=1, max_size=5
)


def _window(backend, views, config=POP, kept=None):
    one = Statistics(np.zeros(1), np.zeros(1, dtype=np.int64), 0, np.zeros(1, dtype=np.int64), np.zeros(1, dtype=bool))
    for x, y, visible, count in views:
        v, shown, won = np.array([[x, y]]), np.array([visible]), np.array([count], dtype=np.int64)
        found = backend.stage("accumulate")(one, v, shown, won, W, H, config, kept)
        one = Statistics(*(getattr(found, f.name) for f in dataclasses.fields(Statistics)))
    return one


@law("density", "accumulate", "average_grads", views=views)
def test_the_density_statistic_averages_ndc_gradients_over_the_views_that_showed_the_gaussian(backend, views):
    # a px gradient times W/2, H/2; hidden views count neither above nor below the line
    shown = [np.hypot(0.5 * W * x, 0.5 * H * y) for x, y, visible, _ in views if visible]
    window = _window(backend, views)
    average = backend.stage("average_grads")(window, POP)
    assert_close("density.average", average, [np.mean(shown) if shown else 0.0], 16.0, backend.dtype)
    assert_same_bits("visible views", window.n_visible, [len(shown)])
    assert window.n_views == len(views)


several = st.lists(st.sampled_from([4, 0, 2, 5, 3]), min_size=2, max_size=4)


@law("density", "accumulate", won=several)
def test_blur_flags_combine_over_views_as_the_reading_says(backend, won):
    # A2, at a share of three pixels
    views = [(0.0, 0.0, True, count) for count in won]
    expected = {"any_view": max(won) > 3, "sum": sum(won) > 3, "own_view": won[-1] > 3}
    for reading, blurred in expected.items():
        config = DensityConfig(theta_blur=3.0 / (W * H), blur_window=reading)
        assert_same_bits(reading, _window(backend, views, config).blurred, [blurred])
        # of half the pixels, twice the share is as many
        of_half = DensityConfig(theta_blur=6.0 / (W * H), blur_window=reading)
        assert_same_bits(f"{reading}, masked", _window(backend, views, of_half, W * H // 2).blurred, [blurred])


@law(
    "density",
    "grow_masks",
    grads=st.lists(dyadic(0.0, 1.0), min_size=1, max_size=5),
    step=st.sampled_from([600, 3000, 7000, 7100]),
    scene_scale=scene_scales,
)
def test_the_small_are_cloned_and_the_large_are_split_by_gradient_or_blur(backend, grads, step, scene_scale):
    n = len(grads)
    config = DensityConfig(grow_grad2d=0.5, grow_scale3d=0.25)
    blurred = np.arange(n) % 3 == 1
    large = np.arange(n) % 2 == 1
    scales = scene_scale * np.where(large, 0.5, 0.25)[:, None] * np.array([[1.0, 0.5, 0.125]])
    window = Statistics(np.array(grads), np.ones(n, dtype=np.int64), 1, np.zeros(n, dtype=np.int64), blurred)
    clone, split = backend.stage("grow_masks")(window, scales, scene_scale, step, config)
    chosen = (np.array(grads) > 0.5) | (blurred & (3000 <= step <= 7000))
    assert_same_bits("clone", clone, chosen & ~large)
    assert_same_bits("split", split, chosen & large)


@law("density", "prune_mask", opacity=st.lists(opacities(), max_size=3), scene_scale=scene_scales)
def test_the_faint_are_pruned_and_later_the_far_too_large(backend, opacity, scene_scale):
    # besides what is drawn, a large and a small one that are not faint
    o = np.array([*opacity, 0.5, 0.5]).astype(backend.dtype).astype(np.float64)
    n = len(o)
    # the longest axis decides, whichever it is
    sizes = scene_scale * np.where(np.arange(n) % 2 == 0, 0.125, 0.0625)[:, None] * np.full((1, 3), 0.5)
    sizes[np.arange(n), np.arange(n) % 3] *= 2.0
    clear = np.abs(o - 0.005) > 1e-6
    # size pruning goes with resets, which POP has none of (A16)
    for config, by_size in ((GSPLAT, True), (POP, False)):
        for step in (600, 3000, 3001, 14_900):
            pruned = backend.stage("prune_mask")(o, sizes, scene_scale, step, config)
            expected = (o < 0.005) | (by_size & (step > 3000) & (np.arange(n) % 2 == 0))
            assert_same_bits(f"pruned at step {step}, prune_too_big {by_size}", pruned[clear], expected[clear])
    # a threshold that every precision has: what lies at it stays
    at_it, sizes = np.array([0.25, 0.125, 0.5]), np.full((3, 3), 0.0625 * scene_scale)
    config = DensityConfig(prune_opa=0.25)
    pruned = backend.stage("prune_mask")(at_it, sizes, scene_scale, 600, config)
    assert_same_bits("pruned at the threshold", pruned, [False, True, False])
    # so does what has just the size
    for bound, large in ((0.0625, False), (0.03125, True)):
        config = DensityConfig(prune_too_big=True, prune_scale3d=bound)
        pruned = backend.stage("prune_mask")(at_it, sizes, scene_scale, 5000, config)
        assert_same_bits(f"pruned at a size of {bound}", pruned, [large] * 3)


# every how many steps opacities are reset, whether at step 0, too, and how long nothing changes then; also from step 0
# on, whether that is a reset or not
_RESETS = ((0, False, 0), (0, True, 0), (3000, False, 0), (3000, True, 300), (3000, False, 900))


@law("density", "densifies_at", "resets_at", step=st.integers(0, 170).map(lambda k: 100 * k), later=st.integers(-1, 1))
def test_the_gaussians_change_every_hundred_steps_and_opacities_are_reset_where_that_is_asked_for(backend, step, later):
    # with what is drawn, both ends, which hardly anything drawn hits
    for at in (max(step + later, 0), 0, 500, 600, 14_900, 15_000):
        due = at % 100 == 0 and 500 < at < 15_000
        for reset_every, at_zero, pause in _RESETS:
            config = DensityConfig(reset_every=reset_every, reset_at_zero=at_zero, pause_refine_after_reset=pause)
            resets = reset_every > 0 and at % 3000 == 0 and at < 15_000 and (at > 0 or at_zero)
            assert backend.stage("densifies_at")(at, config) == (due and at % 3000 >= pause)
            assert backend.stage("resets_at")(at, config) == resets


@law("density", "densify_and_prune", choices=choices, scene_scale=scene_scales)
def test_a_densification_adds_clones_and_splits_and_takes_prunes_away(backend, choices, scene_scale):
    n = len(choices)
    masks = masks_of(choices)
    rows = tagged_rows(n)
    rows.params["opacities"][:] = np.where(masks["prune"], -9.0, 1.0)
    # three times as large as what is cloned at most, or a third, in units of the scene
    rows.params["scales"][:] = np.log(scene_scale * np.where(masks["split"], 0.03, 0.0033))[:, None]
    grads = np.where(masks["clone"] | masks["split"], 1.0, 0.0)
    window = Statistics(grads, np.ones(n, dtype=np.int64), 1, np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool))

    def at_the_centre(n_split):
        return np.zeros((2, n_split, 3))

    after, fresh = backend.stage("densify_and_prune")(rows, window, scene_scale, 600, at_the_centre, POP)
    expected = n + sum(int(np.sum(masks[k])) * sign for k, sign in (("clone", 1), ("split", 1), ("prune", -1)))
    sizes = {len(array) for kind in (after.params, after.m, after.v) for array in kind.values()}
    assert sizes == {expected}
    # a row's tag stays with it in every parameter: means, colours and turns tell of the same row
    tags = after.params["means"][:, 0]
    assert_same_bits("tags of colours", after.params["sh0"][:, 0, 0], tags)
    assert_same_bits("tags of turns", after.params["quats"][:, 0], tags)
    old = after.m["means"][:, 0] != 0.0
    assert_same_bits("tags of moments", after.m["means"][old, 0], 16.0 * tags[old])
    assert_same_bits("fresh window", fresh.grad_sum, np.zeros(expected))
    assert not np.any(fresh.blurred)


@law("density", "densify_and_prune")
def test_the_copy_of_a_gaussian_that_is_cloned_and_split_stays_whole(backend):
    # the first is small and moves much, and is blurred, where what is blurred is split whatever its size
    rows = tagged_rows(3)
    rows.params["scales"][:] = np.log(0.125)
    moves, blurred = np.array([1.0, 1.0, 0.0]), np.array([True, False, True])
    window = Statistics(moves, np.ones(3, dtype=np.int64), 1, np.zeros(3, dtype=np.int64), blurred)
    config = DensityConfig(grow_grad2d=0.5, grow_scale3d=0.25, blur_rule="split", grow_on_gradient_in_blur_window=True)

    def at_the_centre(n_split):
        return np.zeros((2, n_split, 3))

    after, _ = backend.stage("densify_and_prune")(rows, window, 1.0, 5000, at_the_centre, config)
    # who stays, copies, and two children each
    assert_same_bits("tags", after.params["means"][:, 0], np.array([2.0, 1.0, 2.0, 1.0, 3.0, 1.0, 3.0]))
    sizes = 0.125 / np.where(np.arange(7) < 3, 1.0, 1.6)
    assert_close("density.split", np.exp(after.params["scales"]), np.repeat(sizes[:, None], 3, 1), 1.0, backend.dtype)


readings = st.builds(
    DensityConfig,
    inclusive=st.booleans(),
    grad_denominator=st.sampled_from(["visible_views", "window"]),
    grow_on_gradient=st.booleans(),
    grow_on_gradient_in_blur_window=st.booleans(),
    prune_too_big=st.booleans(),
    # averages hit this one exactly
    grow_grad2d=st.sampled_from([0.5, 1.0]),
    # and sizes, which pass through a logarithm, keep away from these
    grow_scale3d=st.just(0.3),
    prune_scale3d=st.just(0.6),
    prune_opa=st.sampled_from([0.005, 0.125]),
    blur_rule=st.sampled_from(["by_scale", "split"]),
    revised_opacity=st.booleans(),
)


def _population_and_window(n, seed, scene_scale):
    rng = np.random.default_rng(seed)
    tags = tagged_rows(n)
    params = {name: rng.integers(-8, 9, array.shape) / 4.0 for name, array in tags.params.items()}
    params["quats"][:, 0] += 4.0
    params["scales"] = np.log(scene_scale * rng.choice([0.125, 0.25, 0.5, 0.75], (n, 3)))
    params["opacities"] = rng.choice([-9.0, -2.0, 0.0, 3.0], n)
    window = Statistics(
        grad_sum=rng.choice([0.0, 0.5, 1.0, 2.0, 4.0], n),
        n_visible=rng.choice([0, 1, 2, 4], n),
        n_views=4,
        dominant_sum=rng.integers(0, 9, n),
        blurred=rng.random(n) < 0.5,
    )
    return Rows(params, tags.m, tags.v), window


# sizes on both sides of what is pruned, in a scene that is not of one unit
_TOO_BIG = DensityConfig(prune_too_big=True, grow_grad2d=0.5, grow_scale3d=0.3, prune_scale3d=0.6, prune_opa=0.005)


@law(
    "density",
    "densify_and_prune",
    n=st.integers(1, 8),
    seed=st.integers(0, 2**16),
    config=readings,
    step=st.sampled_from([600, 3000, 5000, 7000, 7100]),
    scene_scale=scene_scales,
    first=[{"n": 8, "seed": 1, "config": _TOO_BIG, "step": 5000, "scene_scale": scale} for scale in (0.125, 4.0)],
)
def test_a_densification_step_is_the_oracles_under_every_reading(backend, n, seed, config, step, scene_scale):
    rows, window = _population_and_window(n, seed, scene_scale)

    def draws(n_split):
        return np.cos(np.arange(6.0 * n_split)).reshape(2, n_split, 3)

    expected, _ = densify_and_prune(rows, window, scene_scale, step, draws, config)
    got, fresh = backend.stage("densify_and_prune")(rows, window, scene_scale, step, draws, config)
    for kind in ("params", "m", "v"):
        for name, wanted in getattr(expected, kind).items():
            found = getattr(got, kind)[name]
            assert_close("density.step", found, wanted, np.abs(wanted) + 4.0, backend.dtype, against_oracle=True)
    assert fresh.n_views == 0
    assert_same_bits("fresh window", fresh.n_visible, np.zeros(len(fresh.grad_sum)))
    assert len(fresh.grad_sum) == len(expected)
