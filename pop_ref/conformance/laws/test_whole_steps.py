"""Laws of whole steps, as a user's run takes them on photographs: every step is the oracle's from the same Gaussians.

The first laws compare parameters, moments and losses with the oracle's after every step, under each setting, rule and
method. The others say what any training does, and need no oracle. The last are of photographs that are seen coarse
first: a coarse pixel is the mean of the area that it covers, also where sizes do not divide.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, replace
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import in_precision
from pop_ref.conformance.short_training import ShortTraining, assert_steps
from pop_ref.conformance.vector_steps import (
    ASIDE,
    BANDS,
    BATCHES,
    BLURRED,
    CHANGED,
    CHANGES,
    CORNERS,
    ENTROPY,
    FEW,
    FIRST,
    HIDDEN,
    LARGE,
    MASKED,
    OF_METHODS,
    ORDER,
    OUTLASTED,
    PRIOR,
    PRUNED,
    REWOUND,
    SHORT,
    SOFTLY,
    STILL,
    UNSEEN,
    WAITING,
    WINDOW,
)
from pop_ref.methods import KEYS
from pop_ref.refinement import refined_viewmat, refined_viewmat_vjp, without_common_motion
from pop_ref.render import render_vjp
from pop_ref.settings import LearningRates
from pop_ref.short_training import Trained
from pop_ref.training import gaussians_from_params

# of band 0
SH_C0 = 0.28209479177387814


def _assert_steps(backend, short):
    return assert_steps(backend, short, backend.stage("taken_steps")(short))


@law("training", "taken_steps")
def test_every_step_is_the_oracles_under_every_setting(backend):
    for short in (PRIOR, WINDOW, ENTROPY, MASKED, HIDDEN, *LARGE, ASIDE, UNSEEN, *CORNERS):
        _assert_steps(backend, short)


@law("training", "taken_steps")
def test_every_step_is_the_oracles_under_every_rule_of_updates(backend):
    for short in (WAITING, *BANDS):
        _assert_steps(backend, short)
    # the prior reads a window that goes on after the last prune
    window = replace(WINDOW, settings={**WINDOW.settings, "final_prune_iter": 0, "final_prune_opa": 0.25})
    for short in (window, OUTLASTED):
        assert "pruned" in _assert_steps(backend, short)
    assert "cloned" in _assert_steps(backend, REWOUND)


@law("training", "taken_steps")
def test_every_step_of_every_method_is_the_oracles(backend):
    for short in OF_METHODS:
        _assert_steps(backend, short)


@law("training", "taken_steps")
def test_every_step_is_the_oracles_while_the_gaussians_change(backend):
    happened = _assert_steps(backend, CHANGED) | _assert_steps(backend, BLURRED)
    assert happened == {"cloned", "split", "pruned", "reset"}, f"{happened} only"


@law("training", "foreign_steps")
def test_every_step_is_the_oracles_by_a_strategy_of_somebody_else(backend):
    # a split is by random numbers of its own; whom nobody asks for a term has no prior
    cloned = ShortTraining("gsplat", {**CHANGES, "grow_scale3d": 100.0}, SHORT, ORDER[:4], seed=173, scene_scale=2.0)
    happened = set()
    for short in (PRIOR, cloned):
        happened |= assert_steps(backend, short, backend.stage("foreign_steps")(short))
    assert happened == {"cloned", "pruned", "reset"}, f"{happened} only"


@law("training", "foreign_draws")
def test_a_strategy_of_somebody_else_draws_other_numbers_at_every_step_and_the_same_in_every_run(backend):
    short = replace(PRIOR, order=ORDER[:3])
    (one, left), (other, _) = (backend.stage("foreign_draws")(short) for _ in range(2))
    assert len(set(one)) == short.steps, f"the steps drew {one}"
    assert one == other, f"a second run drew {other}, the first one {one}"
    assert left, "random numbers of others are not what they were"


@law("training", "taken_steps")
def test_every_step_is_the_oracles_with_terms_for_few_photographs(backend):
    for masked, scale in ((False, 4.0), (True, 0.5)):
        _assert_steps(backend, replace(FEW, masked=masked, scene_scale=scale))


@law("training", "corrected_steps")
def test_every_step_sees_from_corrected_cameras(backend):
    # pictures, the depth of sparse points, and passes that prune
    deep = ShortTraining("pop", STILL, {**SHORT, "depth_lambda": 0.5}, ORDER[:2], 40, sparse=18)
    speedy = {**STILL, "hard_prune_iters": (0, 1), "hard_prune_share": 0.4, "soft_prune_iters": ()}
    pruned = ShortTraining("speedy-splat", speedy, SHORT, (0, 1), 8, count=9, views=3)
    for short in (deep, pruned):
        viewmats = np.stack([camera.viewmat for camera in short.cameras])
        corrections = without_common_motion(np.random.default_rng(5).normal(0.0, 0.03, (short.views, 6)), viewmats)
        found, seen = backend.stage("corrected_steps")(short, corrections)
        refined = np.stack([refined_viewmat(*of) for of in zip(viewmats, corrections, strict=True)])
        size = 1.0 + np.abs(viewmats[:, :, 3:]).max(axis=1, keepdims=True)
        assert_close("agreement.refined_viewmat", seen, refined, 4.0 * size, backend.dtype, against_oracle=True)
        assert_steps(
            backend, _From(**{f.name: getattr(short, f.name) for f in fields(short)}, corrected=seen), found, least=0.0
        )


@law("training", "corrected_steps")
def test_every_camera_learns_by_its_own_picture(backend):
    # Adam's first update is as long as its rate, so that signs of gradients say all; none of these is near 0
    short, rate = ShortTraining("pop", STILL, SHORT, (0,), seed=44), 2.0**-6
    viewmats = np.stack([camera.viewmat for camera in short.cameras])
    (record,), found = backend.stage("corrected_steps")(short, np.zeros((short.views, 6)), rate)
    trained, camera, background = Trained(short), short.cameras[record["view"]], np.array(short.background)
    options = {"sh_degree": 0, "profile": trained.recipe.profile, "background": background}
    v_image = trained.look(record["view"]).v_image
    v_viewmat = render_vjp(gaussians_from_params(short.params), camera, v_image, **options).viewmat
    grads = np.zeros((short.views, 6))
    grads[record["view"]] = refined_viewmat_vjp(camera.viewmat, np.zeros(6), v_viewmat)[1]
    learned = without_common_motion(-rate * np.sign(grads), viewmats)
    expected = np.stack([refined_viewmat(*of) for of in zip(viewmats, learned, strict=True)])
    assert_close("steps.still", found, expected, 8.0 + 8.0 * np.abs(viewmats).max(), backend.dtype)


@dataclass(frozen=True)
class _From(ShortTraining):
    """A short training whose cameras are elsewhere."""

    corrected: np.ndarray | None = None

    @functools.cached_property
    def cameras(self):
        return [replace(c, viewmat=v.astype(np.float64)) for c, v in zip(super().cameras, self.corrected, strict=True)]


@law("training", "taken_steps")
def test_what_a_method_prunes_by_is_of_all_photographs(backend):
    for short in (*PRUNED, SOFTLY):
        found = backend.stage("taken_steps")(short)
        assert "pruned" in assert_steps(backend, short, found, least=0.0), short.method


@law("training", "taken_steps")
def test_gaussians_begin_anew_on_the_photographs_and_inside_their_masks(backend):
    settings = {**STILL, "reinit_iters": (1,), "reinit_points": 60, "sample_iter": 90, "prune_iter": 91}
    short = ShortTraining("mini-splatting", settings, SHORT, (0, 1), seed=6, centred=True, masked=True)
    params = backend.stage("taken_steps")(short)[-1]["params"]
    assert len(params["means"]) > short.count
    colors = 255.0 * (0.5 + SH_C0 * params["sh0"][:, 0])
    shown = np.zeros(len(colors), dtype=bool)
    for view, camera in enumerate(short.cameras):
        seen = params["means"] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        at = (seen[:, :2] / seen[:, 2:]) @ camera.K[:2, :2].T + camera.K[:2, 2] - 0.5
        pixel = np.clip(np.round(at).astype(int), 0, np.array(short.size) - 1)
        rows, columns = pixel[:, 1], pixel[:, 0]
        close = np.all(np.abs(at - pixel) < 0.01, axis=1) & short.mask(view)[rows, columns]
        shown |= close & np.all(np.abs(colors - short.photo(view)[rows, columns]) < 0.01, axis=1)
    assert np.all(shown), f"Gaussian {np.argmin(shown)} lies on no pixel that counts, or has not that pixel's colour"


@law("training", "batched_steps")
def test_a_step_of_several_views_has_their_mean_loss_and_gradient(backend):
    for short in BATCHES:
        found = backend.stage("batched_steps")(short)
        assert [sorted(record["view"]) for record in found] == [[0, 1]] * short.steps
        assert_steps(backend, short, found)


@law("training", "learned_exposures")
def test_an_exposure_learns_to_be_that_of_its_photograph(backend):
    # of bright noise behind a dark render every entry wants to grow, and of two exposures none is the first
    short = _Bright("pop", STILL, SHORT, (0,), seed=22, background=(0.05, 0.05, 0.05))
    rate = 2.0**-6
    (exposures,) = backend.stage("learned_exposures")(short, rate)
    seen = int(exposures[1, 0, 3] > exposures[0, 0, 3])
    assert_close("steps.still", exposures[seen] - exposures[1 - seen], np.full((3, 4), rate), 1.0, backend.dtype)


@law("training", "learned_exposures")
def test_a_shrunk_photograph_has_the_exposure_of_its_photograph(backend):
    short = _Bright("pop", STILL, SHORT, (0,), seed=22, background=(0.05, 0.05, 0.05))
    # the same order of views: the one that learns is the one that learns of whole photographs
    whole, shrunk = (backend.stage("learned_exposures")(short, 2.0**-6, stops)[0] for stops in ((), (5,)))
    seen = [int(exposures[1, 0, 3] > exposures[0, 0, 3]) for exposures in (whole, shrunk)]
    assert seen[0] == seen[1], f"photograph {seen[0]} was seen shrunk, and photograph {seen[1]} learned"
    # with as many places further on for each size, the last would be right by chance
    assert seen[0] < short.views - 1


@law("training", "learned_exposures")
def test_what_is_brighter_than_white_pulls_an_exposure_down(backend):
    # a render is compared as it is, not as it would be written to a file
    kinds = (_Bright, _Glaring)
    learn = [backend.stage("learned_exposures")(kind("pop", STILL, SHORT, (0,), seed=22), 2.0**-6)[0] for kind in kinds]
    up, down = int(learn[0][1, 0, 3] > learn[0][0, 0, 3]), int(learn[1][1, 0, 3] < learn[1][0, 0, 3])
    # the order of the views is the same, so that the one that rose before grey ones falls
    assert up == down, f"photograph {up} was seen, and its exposure rose"
    fallen = learn[1][down, :, 3] - learn[1][1 - down, :, 3]
    assert_close("steps.still", fallen, np.full(3, -(2.0**-6)), 1.0, backend.dtype)


class _Glaring(ShortTraining):
    """A short training of grey photographs, of which large Gaussians are much brighter and what is behind is darker."""

    def photo(self, index):
        return np.full_like(super().photo(index), 128)

    @functools.cached_property
    def params(self):
        p = super().params
        return {**p, "sh0": 0.0 * p["sh0"] + 8.0, "shN": 0.0 * p["shN"], "opacities": 0.0 * p["opacities"] + 2.0}


class _Bright(ShortTraining):
    """A short training of white photographs."""

    def photo(self, index):
        return np.full_like(super().photo(index), 255)


NONE = LearningRates(means=0.0, scales=0.0, quats=0.0, opacities=0.0, sh0=0.0, sh_rest=0.0)


@functools.cache
def _alike(rate):
    """Return a short training of two photographs that are one and the same."""
    rates = LearningRates(means=rate, scales=rate, quats=rate, opacities=rate, sh0=rate, sh_rest=rate)
    return _Alike("pop", {**STILL, "lambda_pop": 0.0}, {"max_steps": 8, "lr": rates}, (0, 1, 0, 1), seed=22)


class _Alike(ShortTraining):
    """A short training of one photograph that is there twice."""

    @property
    def cameras(self):
        return super()._every_camera[:1] * 2

    def photo(self, index):
        return super().photo(0)


@law("training", "taken_steps")
def test_at_rates_of_zero_every_look_at_a_photograph_costs_the_same(backend):
    short = replace(PRIOR, settings={**STILL, "lambda_pop": 0.0}, options={"max_steps": 8, "lr": NONE}, order=ORDER)
    costs = {}
    for record in backend.stage("taken_steps")(short):
        loss = costs.setdefault(record["view"], record["loss"])
        # a step that is recorded counts what its pixels blend, and may sum in another order
        assert_close("steps.still", record["loss"], loss, loss, backend.dtype)
        for key, value in short.params.items():
            assert_same_bits(key, record["params"][key], value)


# more than the compiled engine takes in one part, which is 4,096
CROWD = 4500


class _Crowded(ShortTraining):
    """A short training among thousands of Gaussians that lie behind its cameras."""

    @functools.cached_property
    def places(self):
        """Return the rows of those that are not behind."""
        return np.linspace(0, CROWD - 1, self.count).astype(int)

    @functools.cached_property
    def params(self):
        few, rows = super().params, {}
        for key, value in few.items():
            rows[key] = np.repeat(value[:1], CROWD, axis=0)
            rows[key][self.places] = value
        behind = np.setdiff1d(np.arange(CROWD), self.places)
        centres = [c.viewmat[:3, :3].T @ (np.array([0.0, 0.0, -9.0]) - c.viewmat[:3, 3]) for c in self.cameras]
        rows["means"][behind] = in_precision(np.mean(centres, axis=0))
        return rows


@law("training", "taken_steps")
def test_what_no_view_sees_has_no_say_in_a_step_and_in_the_prior_of_what_is_visible(backend):
    asked = {"settings": {**STILL, **FIRST, "pop_over": "visible"}, "options": PRIOR.options, "order": (0, 1)}
    few, many = ShortTraining(**asked, seed=125), _Crowded(**asked, seed=125)
    behind = np.setdiff1d(np.arange(CROWD), many.places)
    taken = zip(*map(backend.stage("taken_steps"), (few, many)), strict=True)
    for alone, among in taken:
        assert_close("steps.still", among["loss"], alone["loss"], alone["loss"], backend.dtype)
        for kind in ("params", "m"):
            for key in KEYS:
                value = alone[kind][key]
                size = np.max(np.abs(value), initial=0.0)
                assert_close("steps.still", among[kind][key][many.places], value, size, backend.dtype)
        for key in KEYS:
            assert_same_bits(f"{key} of what no view sees", among["params"][key][behind], many.params[key][behind])


@law("training", "taken_steps")
def test_small_steps_on_one_photograph_bring_the_loss_down(backend):
    losses = [record["loss"] for record in backend.stage("taken_steps")(_alike(1e-3))]
    assert losses[0] > losses[1] > losses[2] > losses[3], f"the losses are {losses}"


@law("training", "taken_steps")
def test_the_scale_of_the_scene_is_the_unit_of_the_centres_rate_and_of_nothing_else(backend):
    one, four = (
        backend.stage("taken_steps")(replace(PRIOR, scene_scale=scale, order=(0,)))[0]["params"] for scale in (1.0, 4.0)
    )
    start = PRIOR.params["means"]
    for key in KEYS:
        if key != "means":
            assert_same_bits(key, four[key], one[key])
    assert np.any(one["means"] != start)
    size = np.abs(start) + 1.0
    assert_close("steps.still", four["means"] - start, 4.0 * (one["means"] - start), size, backend.dtype)


@law("training", "taken_steps")
def test_bands_of_the_harmonics_move_from_their_own_step_on(backend):
    short = replace(PRIOR, options={"max_steps": 8, "sh_interval": 2}, order=(0, 1, 0, 1, 0))
    before = short.params["shN"]
    for step, record in enumerate(backend.stage("taken_steps")(short)):
        after = record["params"]["shN"]
        moved = [bool(np.any(after[:, a:b] != before[:, a:b])) for a, b in ((0, 3), (3, 8))]
        assert moved == [step >= 2, step >= 4], f"step {step} moves bands {moved}"
        before = after


@law("training", "whole_run")
def test_a_run_to_its_end_takes_the_steps_that_can_be_asked_for_one_by_one(backend):
    settings = {**CHANGES, "reset_every": 0}
    short = ShortTraining("pop", settings, {**SHORT, "max_steps": 4}, (0, 1, 0, 1), seed=34, held_out=1)
    last = backend.stage("taken_steps")(short)[-1]["params"]
    with TemporaryDirectory() as folder:
        whole = backend.stage("whole_run")(short, folder)
    for key, found in zip(KEYS, whole, strict=True):
        assert_same_bits(key, found, last[key])


# windows of every kind, an epoch of three views, and gradients that wait are under way where the run is interrupted
UNDER_WAY = {"refine_start_iter": 0, "refine_stop_iter": 100, "refine_every": 3, "reset_every": 0, "sh_rest_every": 4}
UNDER_WAY |= {"grow_grad2d": 0.0125, "grow_scale3d": 0.3, "prune_opa": 0.05, "pop_views": "window"}
UNDER_WAY |= {"blur_start_iter": 0, "blur_stop_iter": 100, "blur_window": "any_view", "blur_min_pixels": 14.0}
UNDER_WAY |= {"refine_scale2d_stop_iter": 100, "grow_scale2d": 0.5, "prune_scale2d": 3.0}


@law("training", "resumed_run")
def test_a_run_that_is_interrupted_within_a_window_goes_on_to_the_same_bits(backend):
    options = {"max_steps": 6, "sh_interval": 1}
    short = ShortTraining("pop", UNDER_WAY, options, (0,) * 6, seed=36, views=3, degree=3)
    with TemporaryDirectory() as folder:
        given = short, folder, 5
        whole, resumed = backend.stage("resumed_run")(*given, exposure=True, refine_cameras=True, max_renders=0)
    assert len(whole["means"]) != short.count, "no change was before the interruption"
    for name in ("grad2d", "count", "views", "dominant_sum", "blurred", "radii", "sh_rest_sum"):
        assert np.any(whole[name]), f"{name} is of nothing, which anybody would go on from"
    assert sorted(resumed) == sorted(whole), f"{sorted(set(resumed) ^ set(whole))} are known to one run alone"
    for name, expected in whole.items():
        assert_same_bits(name, resumed[name], expected)


sizes = st.tuples(st.integers(64, 150), st.integers(64, 150))
factors = st.sampled_from([2, 4])
first = [{"size": (160, 128), "factor": 4, "seed": 0}, {"size": (131, 101), "factor": 2, "seed": 1}]
# px, which no side of a coarse photograph is under
SMALLEST = 32


def _factor(size, factor):
    while factor > 1 and min(size) < SMALLEST * factor:
        factor //= 2
    return factor


def _small(size, factor):
    return tuple(round(side / factor) for side in size)


def _shares(whole, small):
    """Return what share of each coarse pixel every pixel of a row covers. [small, whole]"""
    ends = np.arange(small + 1) * (whole / small)
    left, right = np.maximum(ends[:-1, None], np.arange(whole)), np.minimum(ends[1:, None], np.arange(1, whole + 1))
    return np.maximum(right - left, 0.0) * (small / whole)


def _areas(size, factor):
    """Return the shares of rows and of columns of a photograph that is shrunk."""
    (width, height), (w, h) = size, _small(size, factor)
    return _shares(height, h), _shares(width, w)


def _photo(size, seed):
    return np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), np.uint8)


def _K(size):
    return np.array([[1.25 * size[0], 0.0, 0.4375 * size[0]], [0.0, 1.5 * size[1], 0.5625 * size[1]], [0.0, 0.0, 1.0]])


@law("training", "coarse_view", first=first, size=sizes, factor=factors, seed=st.integers(0, 99))
def test_a_coarse_photograph_is_the_mean_over_areas_of_the_whole_one(backend, size, factor, seed):
    photo, factor = _photo(size, seed), _factor(size, factor)
    found = backend.stage("coarse_view")(photo, None, _K(size), factor)
    rows, columns = _areas(size, factor)
    expected = np.einsum("yh,xw,hwc->yxc", rows, columns, photo.astype(np.float64), optimize=True)
    assert found["photo"].shape == expected.shape
    # as whole numbers
    off = np.max(np.abs(found["photo"] - expected))
    assert off <= 0.501, f"a pixel is off by {off} of 255"
    # the opacity of a photograph with transparency is its mean, too
    off = np.max(np.abs(found["alpha"].astype(np.float64) - expected[..., 0]))
    assert off <= 0.501, f"an opacity is off by {off} of 255"


@law("training", "coarse_view", first=first, size=sizes, factor=factors, seed=st.integers(0, 99))
def test_a_coarse_camera_sees_every_point_at_the_same_place_of_the_photograph(backend, size, factor, seed):
    small = _small(size, _factor(size, factor))
    found = backend.stage("coarse_view")(_photo(size, seed), None, _K(size), factor)
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (8, 3)) + np.array([0.0, 0.0, 3.0])
    ends = [(points @ K.T)[:, :2] / points[:, 2:] / np.array(of) for K, of in ((found["K"], small), (_K(size), size))]
    assert found["photo"].shape[:2] == small[::-1]
    assert_close("steps.still", *ends, 4.0, backend.dtype)


@law("training", "coarse_view", first=first, size=sizes, factor=factors, seed=st.integers(0, 99))
def test_a_pixel_of_a_coarse_mask_counts_where_half_of_its_area_does(backend, size, factor, seed):
    factor = _factor(size, factor)
    mask = np.random.default_rng(seed).random((size[1], size[0])) < 0.5
    found = backend.stage("coarse_view")(_photo(size, seed), mask, _K(size), factor)["mask"]
    rows, columns = _areas(size, factor)
    share = rows @ mask.astype(np.float64) @ columns.T
    assert found.shape == share.shape
    # where it is half to the last digits, rounding decides
    sure = (np.abs(share - 0.5) > 1e-5) | (factor == 1)
    assert np.array_equal(found[sure], (share >= 0.5)[sure])
    if all(side % factor == 0 for side in size):
        # here shares are exact
        assert np.array_equal(found, share >= 0.5)


@law("training", "coarse_view", width=st.integers(1, 2), start=st.integers(8, 100))
def test_a_thin_mask_keeps_a_photograph_from_being_so_coarse_that_nothing_counts(backend, width, start):
    # a line of one pixel, or of two, is half of a coarse one only where that is no wider than two or four
    size = (128, 128)
    mask = np.zeros(size, dtype=bool)
    mask[:, start : start + width] = True
    found = backend.stage("coarse_view")(_photo(size, 0), mask, _K(size), 4)
    for factor in (4, 2, 1):
        rows, columns = _areas(size, factor)
        kept = rows @ mask.astype(np.float64) @ columns.T >= 0.5
        if np.any(kept):
            break
    assert found["photo"].shape[:2] == kept.shape, f"{found['photo'].shape[:2]} px, expected {kept.shape}"
    assert np.array_equal(found["mask"], kept)


class _Stripes(ShortTraining):
    """A short training whose photographs are stripes of 1, 2 and 4 px, told apart by how strong they are."""

    def photo(self, index):
        width, height = self.size
        x = np.arange(width)
        stripes = 128 + sum(strength * (1 - 2 * ((x // wide) % 2)) for wide, strength in ((1, 16), (2, 32), (4, 64)))
        return np.broadcast_to(stripes[None, :, None], (height, width, 3)).astype(np.uint8)


def _costs(strengths):
    return sum((strength / 255.0) ** 2 for strength in strengths)


@law("training", "coarse_losses")
def test_every_step_sees_its_photograph_at_the_size_of_its_turn(backend):
    # nothing is drawn before a background of the stripes' mean, and every size has lost stripes of its own
    grey = (128.0 / 255.0,) * 3
    options = {"lambda_ssim": 0.0, "max_steps": 8}
    settings = {"refine_start_iter": 100, "lambda_pop": 0.0}
    whole, half, quarter = _costs((16, 32, 64)), _costs((32, 64)), _costs((64,))
    for side, batch, expected in (
        (128, 1, (quarter, quarter, half, half, half, whole)),
        (128, 2, (quarter, quarter, half)),
        (96, 1, (half, half, half, half, half, whole)),
        (48, 1, (whole,)),
    ):
        order = (0, 1, 2) * (len(expected) * batch // 3 + 1)
        short = _Stripes("pop", settings, options, order[: len(expected) * batch], 3, 2, 3, background=grey,
                          batch=batch, size=(side, side))  # fmt: skip
        found = backend.stage("coarse_losses")(short, (2, 5))
        assert_close("steps.coarse", found, expected, 1.0, backend.dtype)
