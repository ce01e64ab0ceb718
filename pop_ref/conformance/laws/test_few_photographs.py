"""Laws of what training adds where photographs are few or unlike: sparse depth, exposures, backgrounds, cameras."""

from __future__ import annotations

from itertools import product

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic, viewmats
from pop_ref.records import Camera
from pop_ref.settings import AppearanceRates, Recipe
from pop_ref.training import start

ORACLE = OracleAdapter()
H, W = 4, 6
# dyadic, so that where something is rendered, and which disparity is the larger, is no matter of rounding
depths = st.lists(st.sampled_from([0.0, 0.5, 1.0, 2.0, 2.5, 4.0, 9.0]), min_size=H * W, max_size=H * W).map(
    lambda values: np.array(values).reshape(H, W)
)
places = st.tuples(dyadic(0.0, W - 0.125), dyadic(0.0, H - 0.125))
samples = st.lists(st.tuples(places, st.sampled_from([0.125, 0.25, 0.5, 0.75, 2.0])), max_size=5)


def _columns(samples):
    return np.array([place for place, _ in samples]).reshape(-1, 2), np.array([d for _, d in samples])


@law("few_photographs", "sparse_depth_loss", "sparse_depth_loss_vjp", depth=depths, samples=samples)
def test_the_depth_of_sparse_points_is_compared_as_the_oracle_compares_it(backend, depth, samples):
    at, d = _columns(samples)
    # with nothing to compare with, the mean is that of the disparities alone; squared, of the slopes
    rendered = [ORACLE.stage("sparse_depth_loss")(depth, at[k : k + 1], np.zeros(1)) for k in range(len(d))]
    expected = ORACLE.stage("sparse_depth_loss")(depth, at, d)
    found = backend.stage("sparse_depth_loss")(depth, at, d)
    size = float(np.sum(rendered) + np.sum(d)) / max(len(d), 1)
    assert_close("few_photographs.depth", found, expected, size, backend.dtype, against_oracle=True)
    expected = ORACLE.stage("sparse_depth_loss_vjp")(depth, at, d, 0.75)
    found = backend.stage("sparse_depth_loss_vjp")(depth, at, d, 0.75)
    size = float(np.sum(np.square(rendered))) / max(len(d), 1)
    assert_close("few_photographs.depth_vjp", found, expected, size, backend.dtype, against_oracle=True)


@law("few_photographs", "sparse_depth_loss", depth=depths, x=st.integers(0, W - 1), y=st.integers(0, H - 1))
def test_a_point_at_the_centre_of_a_pixel_reads_the_depth_of_that_pixel_alone(backend, depth, x, y):
    # centres lie at +0.5; where nothing is rendered the disparity is 0
    expected = 1.0 / depth[y, x] if depth[y, x] > 0.0 else 0.0
    found = backend.stage("sparse_depth_loss")(depth, np.array([[x + 0.5, y + 0.5]]), np.zeros(1))
    assert_close("few_photographs.depth", found, expected, expected, backend.dtype)


@law("few_photographs", "sparse_depth_loss", "sparse_depth_loss_vjp", samples=samples)
def test_where_nothing_is_rendered_no_depth_pulls(backend, samples):
    at, d = _columns(samples)
    nothing = np.zeros((H, W))
    found = backend.stage("sparse_depth_loss")(nothing, at, d)
    assert_close("few_photographs.depth", found, float(np.sum(d)) / max(len(d), 1), 2.0, backend.dtype)
    assert_same_bits("pull", backend.stage("sparse_depth_loss_vjp")(nothing, at, d, 1.0), nothing)


@law(
    "few_photographs",
    "depth_samples",
    viewmat=viewmats(),
    at=st.lists(
        st.tuples(dyadic(-2.0, W + 2.0, 1), dyadic(-2.0, H + 2.0, 1), st.sampled_from([-2.0, 0.25, 1.0, 4.0])),
        max_size=6,
    ),
    masked=st.booleans(),
    # beyond one side alone, and on the border of each
    first=[
        {"viewmat": np.eye(4), "at": [(x, y, z) for x, y in places for z in (1.0, 4.0)], "masked": False}
        for places in (
            [(1.0, -1.0), (1.0, H), (-1.0, 1.0), (W, 1.0)],
            [(1.0, -0.25), (1.0, H - 0.25), (-0.25, 1.0), (W - 0.25, 1.0)],
        )
    ],
)
def test_points_behind_the_camera_outside_the_picture_or_left_out_by_a_mask_have_no_depth(backend, viewmat, at, masked):
    # quarters of a pixel off the pixels' borders, where rounding decides nothing unless the camera stands in the origin
    u, v, z = (np.array([point[axis] for point in at]) for axis in range(3))
    u, v = u + 0.25, v + 0.25
    K = np.array([[4.0, 0.0, 2.5], [0.0, 2.0, 1.5], [0.0, 0.0, 1.0]])
    seen_from_camera = np.stack([(u - 2.5) / 4.0 * z, (v - 1.5) / 2.0 * z, z], 1)
    points = (seen_from_camera - viewmat[:3, 3]) @ viewmat[:3, :3]
    mask = (np.arange(W)[None] + 2 * np.arange(H)[:, None]) % 3 > 0 if masked else None
    shown = (z > 0.0) & (u >= 0.0) & (u < W) & (v >= 0.0) & (v < H)
    if mask is not None:
        shown[shown] = mask[v[shown].astype(int), u[shown].astype(int)]
    places, disparities = backend.stage("depth_samples")(points, Camera(viewmat, K, W, H), mask)
    # a point's way to the camera and back is rounded like its largest term
    size = 1.0 + np.max(np.abs(points), initial=0.0) + np.max(np.abs(viewmat[:3, 3]))
    expected = np.stack([u, v], 1)[shown]
    assert_close("few_photographs.places", places, expected, 256.0 * size, backend.dtype)
    assert_close("few_photographs.places", disparities, 1.0 / z[shown], 256.0 * size, backend.dtype)


@law("few_photographs", "train_step", scene_scale=st.sampled_from([0.25, 2.0, 8.0]))
def test_the_depth_of_sparse_points_weighs_in_units_of_the_scene(backend, scene_scale):
    # one Gaussian at depth 4, where a point says 2: |1 / 4 - 1 / 2|
    params = {
        "means": np.array([[0.0, 0.0, 4.0]]), "quats": np.array([[1.0, 0.0, 0.0, 0.0]]), "scales": np.zeros((1, 3)),
        "opacities": np.zeros(1), "sh0": np.zeros((1, 1, 3)),
    }  # fmt: skip
    camera = Camera(np.eye(4), np.array([[4.0, 0.0, 5.5], [0.0, 4.0, 5.5], [0.0, 0.0, 1.0]]), 11, 11)
    seen = (start(params), camera, np.full((11, 11, 3), 0.5), scene_scale, lambda n: np.zeros((2, n, 3)))
    losses = [
        backend.stage("train_step")(*seen, Recipe(depth_lambda=weight), np.array([[0.0, 0.0, 2.0]]))[1]
        for weight in (0.5, 1.5)
    ]
    expected = 0.25 * scene_scale
    assert_close("few_photographs.depth", losses[1] - losses[0], expected, 1.0 + expected, backend.dtype)
    # of a photograph that sees no points, and where they weigh nothing
    for weight, points in ((0.5, None), (0.0, np.array([[0.0, 0.0, 2.0]]))):
        without = backend.stage("train_step")(*seen, Recipe(depth_lambda=weight), points)[1]
        expected = 1.5 * losses[0] - 0.5 * losses[1]
        assert_close("few_photographs.depth", without, expected, 1.0 + scene_scale, backend.dtype)


@law("few_photographs", "mean_activation", "mean_activation_vjp")
def test_of_no_gaussians_the_mean_is_zero(backend):
    assert_same_bits("mean", backend.stage("mean_activation")(np.zeros((0, 3))), 0.0)
    assert backend.stage("mean_activation_vjp")(np.zeros((0, 3)), 1.0).shape == (0, 3)


@law("few_photographs", "centred_exposures", exposures=arrays_of((3, 3, 4)))
def test_centred_exposures_change_nothing_on_average_and_differ_as_before(backend, exposures):
    found = backend.stage("centred_exposures")(exposures)
    assert_close("few_photographs.exposures", np.mean(found, 0), np.eye(3, 4), 4.0, backend.dtype)
    assert_close("few_photographs.exposures", found[1:] - found[0], exposures[1:] - exposures[0], 4.0, backend.dtype)


# of a training of eight steps, in which both rates fall by powers of two and neither as the other
FALLING = AppearanceRates(exposures=2.0**-4, exposures_decay=2.0**-8, cameras=2.0**-6, cameras_decay=2.0**-16)
SHAPES = {"exposures": (3, 4), "cameras": (6,)}


@law("few_photographs", "appearance_steps")
def test_rates_of_exposures_and_cameras_fall_from_step_to_step_and_not_as_one_another(backend):
    # under a gradient that stays, each of Adam's updates is as long as its rate; opposite ones have nothing in common
    signs = np.array([1.0, -1.0])
    assert backend.stage("appearance_steps")([], np.stack([np.eye(4)] * 2), 8, FALLING) == {}
    for learned, n in product((("exposures",), ("cameras",), tuple(SHAPES)), (1, 2, 5)):
        grads = {name: np.multiply.outer(signs, np.ones(SHAPES[name])) for name in learned}
        found = backend.stage("appearance_steps")([grads] * n, np.stack([np.eye(4)] * 2), 8, FALLING)
        assert set(found) == set(learned)
        for name in learned:
            falls = 0.5 if name == "exposures" else 0.25
            length = getattr(FALLING, name) * sum(falls**step for step in range(n))
            start = np.eye(3, 4) if name == "exposures" else np.zeros(6)
            expected = start - length * grads[name]
            assert_close("few_photographs.learned", found[name], expected, 1.0 + length, backend.dtype)


@law(
    "few_photographs",
    "appearance_steps",
    viewmat=viewmats(),
    exposures=arrays_of((3, 2, 3, 4)),
    cameras=arrays_of((3, 2, 6)),
)
def test_exposures_and_cameras_learn_as_the_oracles_do(backend, viewmat, exposures, cameras):
    grads = [{"exposures": e, "cameras": c} for e, c in zip(exposures, cameras, strict=True)]
    seen = (grads, np.stack([viewmat, np.eye(4)]), 8, FALLING)
    expected, found = ORACLE.stage("appearance_steps")(*seen), backend.stage("appearance_steps")(*seen)
    # a quotient of moments is off by roundings of the largest, of which what cameras share is taken out
    size = {"exposures": 1.0, "cameras": FALLING.cameras * (1.0 + float(np.sum(viewmat[:3, 3] ** 2)))}
    for name, numbers in expected.items():
        size_of = 8.0 * size[name]
        assert_close("few_photographs.learned", found[name], numbers, size_of, backend.dtype, against_oracle=True)


@law("few_photographs", "background_at", step=st.integers(0, 2**31), seed=st.integers(0, 2**63))
def test_the_background_of_a_step_hangs_on_the_step_and_the_seed_alone(backend, step, seed):
    background = backend.stage("background_at")
    expected = ORACLE.stage("background_at")(step, seed).astype(backend.dtype)
    assert_same_bits("background", np.asarray(background(step, seed)).astype(backend.dtype), expected)
    background(step + 1, seed)
    assert_same_bits("asked again", np.asarray(background(step, seed)).astype(backend.dtype), expected)


@law("few_photographs", "without_common_motion", viewmat=viewmats(), motion=arrays_of((6,), -1.0, 1.0))
def test_corrections_that_move_all_cameras_alike_are_taken_out_and_others_stay(backend, viewmat, motion):
    K, t = viewmat[:3, :3], viewmat[:3, 3]
    # of the world by a small twist, in the axes of this camera and of one at the origin
    turned = K @ motion[:3]
    here = np.concatenate([turned, np.cross(t, turned) + K @ motion[3:]])
    cameras, common = np.stack([viewmat, np.eye(4)]), np.stack([here, motion])
    stage = backend.stage("without_common_motion")
    size = 1.0 + float(np.sum(t * t))
    assert_close("few_photographs.motion", stage(common, cameras), np.zeros((2, 6)), 8.0 * size, backend.dtype)
    of_one = np.zeros((2, 6))
    of_one[0] = motion
    expected = ORACLE.stage("without_common_motion")(of_one, cameras)
    assert_close("few_photographs.motion", stage(of_one, cameras), expected, 8.0 * size, backend.dtype)
