"""Margins: each decision aimed at in turn, and sound against float32."""

from __future__ import annotations

import ast
import importlib
import inspect
import math
from dataclasses import replace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pop_ref import INRIA, PAPER, PROFILES, Camera, Gaussians, Profile, margins, render
from pop_ref.alpha import sigma_at_pixel
from pop_ref.ambiguities import AMBIGUITIES, Ambiguity
from pop_ref.conformance import thresholds as threshold_strategies
from pop_ref.conformance.error_bounds import REACH, pixel_error_bounds
from pop_ref.conformance.scenes import Scene, rounded_to
from pop_ref.conformance.strategies import scenes
from pop_ref.density import DensityConfig
from pop_ref.magnitudes import Rounded, splat_magnitudes
from pop_ref.margins import Margins
from pop_ref.recipes import Recipe
from pop_ref.splatting import geometry
from tests.oracle.scenes import camera, dense_render, dyadic_camera, grey, random_gaussians, tilted_camera

EPS32 = 2.0**-24
TINY = 1e-9


def test_d1_is_near_for_a_gaussian_next_to_the_near_plane() -> None:
    for side in (-1.0, 1.0):
        z = PAPER.near_plane * (1.0 + side * TINY)
        got = margins(grey([0.5], means=[[0.003, 0.0, z]]), dyadic_camera(3, 3))
        assert got.gaussians["D1"][0] < 10.0 * TINY
        assert got.nearest.decision == "D1"
        assert got.nearest.where == (0,)
        # whether it is there or not, it would cover every pixel
        assert not np.any(got.safe_pixels(1e-7))


def test_d2_is_near_for_an_opacity_next_to_the_floor() -> None:
    got = margins(grey([PAPER.alpha_floor * (1.0 + TINY)]), dyadic_camera(3, 3))
    assert got.gaussians["D2"][0] < 10.0 * TINY
    assert not got.safe_gaussians(1e-7)[0]
    # in the tile's list or not: n_traversed hangs on it at every pixel, the colours at none
    assert not np.any(got.safe_pixels(1e-7))
    assert np.all(got.safe_pixels(1e-7, decisions=("D6", "D7", "D8")))


def test_d2_is_near_for_an_extent_next_to_an_integer() -> None:
    # r = k sqrt(s^2 + 0.3) with k = sqrt(2 ln 255)
    k = math.sqrt(2.0 * math.log(255.0))
    scale = math.sqrt((8.0 / k) ** 2 - 0.3)
    for side, radius in ((-1.0, 8), (1.0, 9)):
        gaussians, view = grey([1.0], scale=scale * (1.0 + side * TINY)), dyadic_camera(5, 5)
        assert render(gaussians, view).splats.radii[0].tolist() == [radius, radius]
        got = margins(gaussians, view)
        assert got.gaussians["D2"][0] < 10.0 * TINY
        # but no pixel of so small an image can tell
        assert np.all(got.safe_pixels(1e-7))
        # in tiles of 1 px the flip changes which pixels visit it, somewhere within 1 px of the extent
        safe = margins(gaussians, dyadic_camera(31, 1), tile_size=1).safe_pixels(1e-7, decisions=("D2",))
        assert np.flatnonzero(~safe[0]).tolist() == [14 - radius, 15 - radius, 15 + radius, 16 + radius]


def test_d2_is_near_for_a_splat_that_only_just_reaches_the_image() -> None:
    gaussians = grey([1.0], means=[[-2.5 - 2.0 - TINY, 0.0, 4.0]], scale=0.0)
    view = dyadic_camera(5, 5)
    assert not render(gaussians, view).splats.visible[0]
    got = margins(gaussians, view)
    assert got.gaussians["D2"][0] < 1e-7
    assert margins(grey([1.0], means=[[-60.0, 0.0, 4.0]], scale=0.0), view).gaussians["D2"][0] > 1e-2


def test_d3_is_near_for_an_extent_that_ends_at_a_tile_s_edge() -> None:
    # the middle at 8 + 2 + tiny, extent 2: the left edge next to the tile edge at 8
    gaussians, view = grey([1.0], means=[[2.0 + TINY, 0.0, 4.0]], scale=0.0), dyadic_camera(16, 16)
    assert render(gaussians, view, tile_size=8).splats.radii[0].tolist() == [2, 2]
    got = margins(gaussians, view, tile_size=8)
    assert got.gaussians["D3"][0] < 1e-7
    unsafe = ~got.safe_pixels(1e-7)
    assert np.all(unsafe[:, :8])
    assert not np.any(unsafe[:, 8:])
    assert np.all(got.safe_pixels(1e-7, decisions=("D4", "D5", "D6", "D7", "D8")))


def test_d4_is_near_for_depths_that_almost_tie() -> None:
    means = [[0.1, 0.0, 4.1], [0.0, 0.1, 4.1 + TINY], [0.0, 0.0, 8.3]]
    got = margins(grey([0.5, 0.5, 0.5], means=means), tilted_camera())
    near = [close for close in got.near if close.decision == "D4"]
    assert got.gaussians["D4"][2] > 1e-3
    assert len({frozenset(close.where) for close in near}) <= 1


def test_d4_is_infinite_for_coincident_copies_and_for_exact_ties() -> None:
    means = [[0.1, 0.0, 4.1]] * 2
    assert math.isinf(margins(grey([0.5, 0.5], means=means), tilted_camera()).gaussians["D4"][0])
    means = [[0.5, 0.0, 4.0], [0.0, 0.25, 4.0]]
    assert math.isinf(margins(grey([0.5, 0.5], means=means), dyadic_camera(3, 3)).gaussians["D4"][0])


def rolled(view: Camera, centre: np.ndarray) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = [[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]], centre
    return replace(view, viewmat=viewmat)


def test_d4_is_zero_for_a_tie_of_different_centres_that_rounding_may_break() -> None:
    means = [[0.1, 0.0, 4.1], [0.0, 0.1, 4.1]]
    view = rolled(camera(), tilted_camera().viewmat[:3, 3])
    assert margins(grey([0.5, 0.5], means=means), view).gaussians["D4"][0] == 0.0


def test_d5_is_near_where_alpha_is_next_to_the_floor() -> None:
    # isotropic with variance 1 + 0.3: alpha = o exp(-d^2 / 2.6) at d = 1
    opacity = PAPER.alpha_floor * math.exp(1.0 / 2.6) * (1.0 + TINY)
    got = margins(grey([opacity]), dyadic_camera(3, 3))
    assert got.pixels["D5"][1, 0] < 1e-7
    assert got.pixels["D5"][1, 1] > 1e-3
    aimed = [close.where for close in got.near_threshold(1e-7) if close.decision == "D5"]
    assert sorted(aimed) == [(0, 1, 0), (1, 0, 0), (1, 2, 0), (2, 1, 0)]
    assert np.argwhere(~got.safe_pixels(1e-7)).tolist() == [[0, 1], [1, 0], [1, 2], [2, 1]]


def test_d6_is_near_where_alpha_is_next_to_the_ceiling() -> None:
    got = margins(grey([PAPER.alpha_ceiling * (1.0 - TINY)]), dyadic_camera(3, 3))
    assert got.pixels["D6"][1, 1] < 1e-7
    assert got.pixels["D6"][0, 1] > 1e-3


def test_d7_is_near_where_the_next_transmittance_is_the_stop() -> None:
    # 1e-3 is left behind the first, a tenth of it behind the second
    got = margins(grey([1.0, 0.9]), dyadic_camera(1, 1))
    assert got.pixels["D7"][0, 0] < 1e-7
    assert [d.where for d in got.near_threshold(1e-7)] == [(0, 0, 1)]
    assert margins(grey([1.0, 0.8]), dyadic_camera(1, 1)).pixels["D7"][0, 0] > 1e-4


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda p: p.name)
def test_two_opaque_splats_leave_no_doubt_that_the_second_ends_the_pixel(profile: Profile) -> None:
    # at 0.99 what is left is 2e-6 of itself from the stop; float32 needs a sixteenth of that
    got = margins(grey([1.0, 1.0]), dyadic_camera(1, 1), profile=profile)
    assert got.safe_pixels(8.0 * EPS32)[0, 0]
    assert got.pixels["D7"][0, 0] > 15.0 * EPS32


def test_d8_is_near_where_two_weights_almost_tie() -> None:
    # 1/3 in front, then half of the 2/3 that are left
    got = margins(grey([1.0 / 3.0 + TINY, 0.5]), dyadic_camera(1, 1))
    assert got.pixels["D8"][0, 0] < 1e-7
    assert [(d.decision, d.where) for d in got.near_threshold(1e-7)] == [("D8", (0, 0, 0, 1))]
    assert math.isinf(margins(grey([0.5]), dyadic_camera(1, 1)).pixels["D8"][0, 0])


def test_b1_and_b2_are_near_at_their_kinks() -> None:
    view = camera()
    limit = (view.width - view.K[0, 2]) / view.K[0, 0] + 0.3 * 0.5 * view.width / view.K[0, 0]
    gaussians = grey([1.0], means=[[4.0 * limit * (1.0 + TINY), 0.0, 4.0]], scale=2.0)
    assert margins(gaussians, view).gaussians["B1"][0] < 1e-7
    dark = replace(gaussians, sh=np.full((1, 1, 3), -0.5 * math.sqrt(4.0 * math.pi) + TINY))
    assert margins(dark, view).gaussians["B2"][0] < 1e-7
    assert margins(gaussians, view).gaussians["B2"][0] > 1e-2


def test_an_empty_scene_has_nothing_near_a_threshold() -> None:
    got = margins(Gaussians([], [], [], [], []), camera())
    assert got.nearest is None
    assert np.all(got.safe_pixels(1.0))
    assert got.safe_gaussians(1.0).shape == (0,)


def test_values_under_error_analysis_are_those_of_the_stages() -> None:
    gaussians, view = random_gaussians(1), tilted_camera()
    shape = geometry(gaussians, view, antialiased=True)
    splats = render(gaussians, view, antialiased=True).splats
    for i in range(len(gaussians)):
        m = splat_magnitudes(gaussians, i, view, antialiased=True)
        np.testing.assert_allclose(m.depth.value, splats.depths[i], rtol=1e-13)
        np.testing.assert_allclose([b.value for b in m.blurred], shape.blurred[i].ravel()[[0, 1, 3]], rtol=1e-11)
        np.testing.assert_allclose(m.opacity.value, shape.opacities[i], rtol=1e-11)
        if splats.visible[i]:
            np.testing.assert_allclose([u.value for u in m.mean2d], splats.means2d[i], rtol=1e-12)
            np.testing.assert_allclose([q.value for q in m.conic], splats.conics[i], rtol=1e-10)


@given(st.floats(-8.0, 8.0, width=32), st.floats(0.125, 8.0, width=32), st.floats(-8.0, 8.0, width=32))
def test_rounded_numbers_bound_the_rounding_of_float32(x: float, y: float, z: float) -> None:
    a, b, c = Rounded(x), Rounded(y), Rounded(z)
    bound = (a * b + c) / (b + a * a) - c * (b + a * a).sqrt()
    f = [np.float32(v) for v in (x, y, z)]
    got = (f[0] * f[1] + f[2]) / (f[1] + f[0] * f[0]) - f[2] * np.sqrt(f[1] + f[0] * f[0])
    assert abs(float(got) - bound.value) <= bound.error * EPS32 * 1.01 + 1e-40


def _float32_inputs(gaussians: Gaussians) -> Gaussians:
    exact = {name: value.astype(np.float32).astype(np.float64) for name, value in gaussians.__dict__.items()}
    return Gaussians(**exact)


@pytest.mark.parametrize("seed", range(12))
def test_float32_agrees_in_every_integer_of_every_safe_pixel(seed: int) -> None:
    view = tilted_camera(11, 9)
    view = replace(view, viewmat=view.viewmat.astype(np.float32).astype(np.float64))
    gaussians = _float32_inputs(random_gaussians(seed, 16, n_sh=1))
    exact, single = render(gaussians, view), dense_render(gaussians, view, np.zeros(3), PAPER, np.float32)
    got = margins(gaussians, view)
    safe, known = got.safe_pixels(EPS32), got.safe_gaussians(EPS32)
    assert np.mean(safe) > 0.95
    assert np.mean(known) > 0.9
    assert np.array_equal(exact.splats.radii[known], single.radii[known])
    assert np.array_equal(exact.dominant_ids[safe], single.dominant_ids[safe])
    assert np.array_equal(exact.n_blended[safe], single.n_blended[safe])


def test_float32_disagrees_somewhere_when_a_threshold_is_aimed_at_and_only_where_margins_say_so() -> None:
    view = camera(5, 5)
    flips = safe_share = 0.0
    for seed in range(80):
        one = random_gaussians(seed, 1, n_sh=1)
        one = replace(one, means=one.means - [[4.0, 0.0, 0.0]], scales=one.scales * 0.3, opacities=np.ones(1))
        seen = render(one, view).splats
        sigma = sigma_at_pixel(seen.means2d[0].tolist(), seen.conics[0].tolist(), seed % 5 + 0.5, 2.5)
        aimed = _float32_inputs(replace(one, opacities=np.array([min(1.0, PAPER.alpha_floor * math.exp(sigma))])))
        exact, single = render(aimed, view), dense_render(aimed, view, np.zeros(3), PAPER, np.float32)
        differ = exact.n_blended != single.n_blended
        # the extent is aimed at as well: the splat's ellipse ends where alpha is at its floor
        safe = margins(aimed, view).safe_pixels(EPS32, decisions=("D1", "D4", "D5", "D6", "D7", "D8"))
        flips += np.sum(differ)
        safe_share += np.mean(safe) / 80
        assert not np.any(differ & safe)
    assert flips > 10
    assert safe_share > 0.9


def test_inria_s_margins_see_its_tile_edges_and_its_square() -> None:
    view = dyadic_camera(81, 1)
    assert render(grey([1.0], scale=0.0), view, profile=INRIA).splats.radii.tolist() == [[3, 3]]
    # p - r at a tile's edge: the screen centre is x + 40.5, and p = x + 40
    aimed = grey([1.0], means=[[16.0 + 3.0 - 40.0 + TINY, 0.0, 4.0]], scale=0.0)
    assert margins(aimed, view, profile=INRIA).gaussians["D3"][0] < 1e-7
    # p + r + t - 1 at a tile's edge
    aimed = grey([1.0], means=[[64.0 - 15.0 - 3.0 - 40.0 - TINY, 0.0, 4.0]], scale=0.0)
    assert margins(aimed, view, profile=INRIA).gaussians["D3"][0] < 1e-7
    away = margins(grey([1.0], means=[[0.75, 0.0, 4.0]], scale=0.0), view, profile=INRIA)
    assert away.gaussians["D3"][0] > 1e-2
    assert 1e-3 < away.gaussians["D2"][0] < math.inf


def test_rounded_numbers_inherit_errors_as_their_derivatives_say() -> None:
    # dyadic and not exact: each operation adds the size of its own result
    x, y = Rounded(3.0, 0.25), Rounded(2.0, 0.5)
    assert (x + y).error == 0.25 + 0.5 + 5.0
    assert (x - y).error == 0.25 + 0.5 + 1.0
    assert (x * y).error == 2.0 * 0.25 + 3.0 * 0.5 + 6.0
    assert (x / y).error == (0.25 + 1.5 * 0.5) / 2.0 + 1.5
    assert Rounded(4.0, 0.5).sqrt().error == 0.5 / 4.0 + 2.0
    assert Rounded(0.0, 0.25).sqrt().error == 0.5
    assert (-x).error == 0.25
    # exact in, exact out
    assert (Rounded(3.0) * Rounded(2.0)).error == 0.0
    assert (Rounded(1.0) / Rounded(3.0)).error == 1.0 / 3.0


def test_d4_touches_the_pixels_that_see_both_splats_and_not_those_that_stopped_before() -> None:
    # an inexact tie behind one opaque splat (the pixel continues) and behind two (it stops)
    tied = [[0.0, 0.1, 4.1], [0.1, 0.0, 4.1]]
    view = rolled(dyadic_camera(3, 3), np.zeros(3))
    front = [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]
    goes_on = margins(grey([1.0, 0.5, 0.5], means=front[:1] + tied, scale=8.0), view)
    assert np.all(goes_on.pixels["D4"] == 0.0)
    stopped = margins(grey([1.0, 1.0, 1.0, 0.5, 0.5], means=front + tied, scale=8.0), view)
    assert np.all(stopped.pixels["D4"] > 1e-3)
    assert stopped.gaussians["D4"][3] == stopped.gaussians["D4"][4] == 0.0


# Margins where numbers end: at the camera's centre, behind it, needles without an inverse, overflow.


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize(
    ("mean", "eye"), [([0.0] * 3, [0.0] * 3), ([0.0, 0.0, -3.0], [0.0] * 3), ([0.5, 0.25, -1.0], [0.5, 0.25, -1.0])]
)
def test_a_gaussian_at_or_behind_the_camera_is_surely_culled_and_leaves_the_others_alone(mean, eye, profile):
    moved = np.eye(4)
    moved[:3, 3] = -np.array(eye)
    view = replace(dyadic_camera(3, 3), viewmat=moved)
    # a colour of degree 1 has a direction, and at the centre there is none
    both, alone = (
        margins(replace(grey([0.5] * n, means=means), sh=np.full((n, 4, 3), 0.25)), view, profile=profile)
        for n, means in ((2, [mean, [0.0, 0.0, 4.0]]), (1, [[0.0, 0.0, 4.0]]))
    )
    assert both.safe_gaussians(EPS32)[0]
    assert math.isinf(both.gaussians["B2"][0])
    for name, found in alone.gaussians.items():
        assert both.gaussians[name][1] == found[0]
    assert np.array_equal(both.safe_pixels(EPS32), alone.safe_pixels(EPS32))


def test_a_needle_whose_determinant_rounds_to_zero_is_in_doubt_in_antialiased_mode_too() -> None:
    # turned by 45 degrees its four entries are alike: the low-pass is lost in them
    turned = [[math.cos(math.pi / 8.0), 0.0, 0.0, math.sin(math.pi / 8.0)]]
    needle = replace(grey([0.5]), quats=np.array(turned), scales=np.array([[1e9, 0.0, 0.0]]))
    assert splat_magnitudes(needle, 0, dyadic_camera(5, 5), antialiased=True).det.value == 0.0
    assert not render(needle, dyadic_camera(5, 5), antialiased=True).splats.visible[0]
    got = margins(needle, dyadic_camera(5, 5), antialiased=True)
    assert got.gaussians["D2"][0] == 0.0
    assert not np.any(got.safe_pixels(EPS32))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("power", [77, 154, 155, 300])
def test_of_a_gaussian_too_large_for_numbers_nothing_is_sure(power: int, profile: Profile, antialiased: bool) -> None:
    for view in (dyadic_camera(5, 5), tilted_camera()):
        for scales in ([1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]):
            huge = replace(grey([0.5]), scales=10.0**power * np.array([scales]), quats=np.array([[0.9, 0.1, 0.3, 0.2]]))
            with np.errstate(all="ignore"):
                image = render(huge, view, profile=profile, antialiased=antialiased)
                got = margins(huge, view, profile=profile, antialiased=antialiased)
            assert np.all(np.isfinite(image.image))
            assert not got.safe_gaussians(EPS32)[0]
            assert not np.any(got.safe_pixels(EPS32))


# The table of open questions against the code: every place exists and says so, every alternative can be chosen.

SETTINGS = {"Recipe": Recipe(), "DensityConfig": DensityConfig()}


def source_of(where: str) -> str:
    module_name, _, attribute = where.partition(":")
    module = importlib.import_module(module_name)
    place = getattr(module, attribute)
    return inspect.getsource(place if inspect.isclass(place) or inspect.isfunction(place) else module)


def parsed(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except ValueError:
        return text


def test_there_are_32_questions_in_order() -> None:
    assert [a.id for a in AMBIGUITIES] == [f"A{k}" for k in range(1, 33)]


@pytest.mark.parametrize("ambiguity", AMBIGUITIES, ids=lambda a: a.id)
def test_a_question_has_a_place_that_names_it_and_alternatives_that_are_settings(ambiguity: Ambiguity) -> None:
    assert (ambiguity.mark or ambiguity.id) in source_of(ambiguity.where)
    assert ambiguity.alternatives or ambiguity.impact != "H"
    for alternative in ambiguity.alternatives:
        setting, _, text = alternative.partition(" = ")
        owner, name = setting.split(".")
        if owner not in SETTINGS:
            place = getattr(importlib.import_module(ambiguity.where.partition(":")[0]), owner)
            assert name in inspect.signature(place).parameters
            continue
        default = getattr(SETTINGS[owner], name)
        value = PROFILES[text] if name == "profile" else parsed(text)
        assert value != default
        assert default is None or type(value) is type(default)
        choices = get_args(get_type_hints(type(SETTINGS[owner]))[name])
        assert not isinstance(value, str) or value in choices
        replace(SETTINGS[owner], **{name: value})


# The strategies that aim at thresholds hit them, and the two measures of nearness agree.

TOLERANCE = REACH * float(np.finfo(np.float32).eps)


def _margins(scene: Scene) -> Margins:
    return margins(scene.gaussians, scene.camera, scene.sh_degree, scene.profile, scene.tile_size, scene.antialiased)


# an ellipse that touches a pixel centre is a question of extent, of tiles and of the floor at once
COUNTED = {"D2": ("D2", "D3", "D5"), "D3": ("D2", "D3", "D5")}
TRIED = settings(max_examples=25, derandomize=True, database=None, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize("label", sorted(threshold_strategies.AIMS))
def test_an_aimed_scene_has_the_doubt_that_it_aims_at(label: str) -> None:
    hits = []

    @TRIED
    @given(scene=threshold_strategies.AIMS[label]())
    def count(scene: Scene) -> None:
        near_threshold = _margins(rounded_to(scene, np.float32)).near_threshold(1e-4)
        hits.append(any(close.decision in COUNTED.get(label, (label,)) for close in near_threshold))

    count()
    assert np.mean(hits) > 0.3, f"only {np.mean(hits):.0%} of the scenes have a {label} decision within rounding"


def _close(found: Margins, label: str, tolerance: float) -> np.ndarray:
    # margins call an opacity under the floor a cull (D2), error bounds a skip (D5)
    return np.logical_or.reduce([found.pixels[d] <= tolerance for d in ((label, "D2") if label == "D5" else (label,))])


@given(scene=scenes(max_gaussians=4))
def test_error_bounds_and_margins_agree_on_what_is_near_a_threshold_in_plain_scenes(scene: Scene) -> None:
    scene = rounded_to(scene, np.float32)
    error_bounds = pixel_error_bounds(scene, np.float32)
    if error_bounds.worst_condition() * error_bounds.reach >= 1.0 / 64.0:
        return
    found = _margins(scene)
    for label in ("D5", "D6", "D7", "D8"):
        unseen = (
            (found.pixels[label] <= TOLERANCE / 8.0) & ~error_bounds.near_threshold[label] & error_bounds.unambiguous
        )
        assert not np.any(unseen), f"{label}: within rounding by margins, unseen by error bounds"
    for label in ("D4", "D5", "D6", "D7"):
        near = error_bounds.near_threshold[label]
        assert np.all(_close(found, label, 8.0 * TOLERANCE)[near]), f"{label}: far from rounding by margins"


@pytest.mark.parametrize("label", ["D5", "D6", "D7", "D8"])
def test_error_bounds_mark_all_that_margins_call_close_in_aimed_scenes(label: str) -> None:
    @TRIED
    @given(scene=threshold_strategies.AIMS[label]().map(lambda s: rounded_to(s, np.float32)))
    def agree(scene: Scene) -> None:
        error_bounds = pixel_error_bounds(scene, np.float32)
        close = _margins(scene).pixels[label] <= TOLERANCE / 8.0
        # an earlier decision may end a pixel in one of the two walks and not in the other
        unseen = close & ~error_bounds.near_threshold[label] & error_bounds.unambiguous
        assert not np.any(unseen), (
            f"{label}: within rounding by margins, unseen by error_bounds, at {np.argwhere(unseen)}"
        )

    agree()
