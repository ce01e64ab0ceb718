"""The host mirror: the laws of the stages that are mathematics of the kernels, and agreement closer than they ask."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cuda_ext.compiler import find_compiler
from pop_ref.alpha import alpha_from_sigma, sigma_at_pixel
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.backends import shipped
from pop_ref.conformance.error_bounds import pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.plugin import parametrize_backends
from pop_ref.conformance.scenes import cotangents, golden_scene
from pop_ref.conformance.strategies import scenes
from pop_ref.constants import PAPER
from pop_ref.density import accumulate, zero_statistics
from pop_ref.density_rows import rows_from_params, split_rows
from pop_ref.polarization import pop_loss_vjp
from pop_ref.tiles import tile_lists
from tests.judged import law_classes

if find_compiler() is None:
    pytest.skip("no C++ compiler: the host mirror cannot be built (install g++ or set CXX)", allow_module_level=True)

from pop_ref.conformance.mirror_adapter import FOLDER, STAGES, MirrorAdapter
from pop_ref.conformance.mirror_library import Mirror

MODULES = (
    *("activations", "agreement", "alpha", "camera", "compositing", "covariance", "dominance", "footprint"),
    *("gradients", "harmonics", "optimizer", "projection", "whole"),
)
globals().update(law_classes(MODULES))


@functools.cache
def mirrors() -> list[Any]:
    return [shipped("mirror64"), shipped("mirror32")]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    # in double the mirror is the oracle to 1e-12, for which the laws are proved already; float has to stand by itself
    agreement = metafunc.cls is not None and metafunc.cls.__name__ == "TestAgreement"
    parametrize_backends(metafunc, mirrors() if agreement else mirrors()[1:])


ORACLE = OracleAdapter()


@pytest.mark.parametrize("per_splat", [False, True], ids=["pixel_parallel", "gaussian_parallel"])
@pytest.mark.parametrize("kernel_tiles", [False, True], ids=["oracle-tiles", "kernel-tiles"])
def test_the_golden_scene_and_its_gradients_are_the_oracles(per_splat, kernel_tiles):
    mirror, scene = MirrorAdapter(FOLDER, np.float64, per_splat, kernel_tiles), golden_scene()
    drawn, expected = mirror.render(scene), ORACLE.render(scene)
    assert np.min(expected.T_final) < 0.5
    for name in ("image", "T_final", "dominant_weights", "means2d"):
        np.testing.assert_allclose(getattr(drawn, name), getattr(expected, name), rtol=0, atol=1e-13, err_msg=name)
    for name in ("dominant_ids", "dominant_counts", "n_blended", "radii"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(expected, name), err_msg=name)
    v_image, v_T_final = cotangents(scene)
    found, gradients = mirror.gradients(scene, v_image, v_T_final), ORACLE.gradients(scene, v_image, v_T_final)
    for name, value in gradients.items():
        assert np.any(value != 0.0), f"{name} has no signal"
        scale = np.max(np.abs(value))
        np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-10 * scale, err_msg=name)


# a needle on the camera's axis: what it does to its rotation is a small difference of large numbers
NEEDLE = golden_scene().with_overrides(
    means=[[-2.5, 0.078125, 0.07812500000000054], [-1.0, 0.0625, 0.0625]],
    quats=[[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 1.0, -1.0]],
    scales=[[0.3125, 0.3125, 0.3125], [8.0, 0.015625, 0.015625]],
    opacities=[0.5, 0.5],
    sh=[[[1.0, 0.5, 0.25]], [[0.0, 0.0, -0.125]]],
    sh_degree=0,
    viewmat=[[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
)
# units of rounding by which the families may part: ten times the most that 3,600 random scenes needed
APART = {"means": 0.02, "quats": 2e-4, "scales": 0.006, "opacities": 0.1, "sh": 4.0, "viewmat": 0.02}
APART |= {"means2d": 0.03, "means2d_abs": 0.1, "background": 0.1}


@given(scene=scenes(anchored=True, max_gaussians=5))
@example(scene=NEEDLE)
def test_both_backward_families_give_the_same_gradients(scene):
    v_image, v_T_final = cotangents(scene)
    columns = MirrorAdapter(FOLDER, np.float64).gradients(scene, v_image, v_T_final)
    splats = MirrorAdapter(FOLDER, np.float64, per_splat=True).gradients(scene, v_image, v_T_final)
    error_bounds = gradient_error_bounds(scene, pixel_error_bounds(scene, np.float64), v_image, v_T_final)
    for name, value in columns.items():
        unit = np.finfo(np.float64).eps * error_bounds[name]
        assert np.all(np.abs(splats[name] - value) <= APART[name] * unit), name


@given(scene=scenes(max_gaussians=5))
def test_exact_lists_of_the_kernels_own_tiles_change_no_bit_of_the_image(scene):
    for dtype in (np.float32, np.float64):
        plain = MirrorAdapter(FOLDER, dtype).render(scene)
        exact = MirrorAdapter(FOLDER, dtype, kernel_tiles=True).render(scene)
        np.testing.assert_array_equal(exact.image, plain.image)
        np.testing.assert_array_equal(exact.dominant_ids, plain.dominant_ids)


@given(
    mean=st.tuples(*[st.floats(-24.0, 40.0)] * 2),
    shape=st.tuples(st.floats(0.125, 6.0), st.floats(0.125, 6.0), st.floats(-0.95, 0.95)),
    tile=st.tuples(st.integers(0, 1), st.integers(0, 3)),
)
def test_no_pixel_of_a_tile_is_nearer_than_the_tiles_least_sigma(mean, shape, tile):
    a, c, r = shape
    conic = np.array([a, r * np.sqrt(a * c), c])
    for dtype in (np.float32, np.float64):
        least = Mirror(FOLDER, dtype).call(
            "least_sigma_in_tile", 1, [np.array(mean), conic], [(1,)], integers=(29, 27, 16, 8, *tile)
        )[0][0]
        xs, ys = np.meshgrid(
            np.arange(16 * tile[0], min(16 * tile[0] + 16, 29)) + 0.5,
            np.arange(8 * tile[1], min(8 * tile[1] + 8, 27)) + 0.5,
        )
        rounded_mean, rounded_conic = np.array(mean, dtype=dtype), conic.astype(dtype)
        dx, dy = rounded_mean[0] - xs, rounded_mean[1] - ys
        sigmas = 0.5 * (rounded_conic[0] * dx * dx + rounded_conic[2] * dy * dy) + rounded_conic[1] * dx * dy
        assert least <= np.min(sigmas) * (1.0 + 1e-12)


@given(
    mean=st.tuples(*[st.floats(0.0, 8.0)] * 2),
    opacity=st.floats(0.0, 1.0),
    conic=st.tuples(st.floats(0.05, 3.0), st.floats(-0.04, 0.04), st.floats(0.05, 3.0)),
)
def test_the_kernels_form_of_alpha_is_the_oracles(mean, opacity, conic):
    alpha, skipped = alpha_from_sigma(sigma_at_pixel(mean, conic, 2.5, 3.5), opacity, PAPER)
    found, left_out = Mirror(FOLDER, np.float64).call(
        "alpha_as_blended",
        1,
        [np.array(mean), np.array(conic), np.array([opacity])],
        [(1,)],
        [(1,)],
        numbers=(2.5, 3.5),
    )
    assert abs(found[0] - alpha) <= 1e-13
    if abs(alpha - PAPER.alpha_floor) > 1e-12:
        assert bool(left_out[0]) == skipped


@pytest.mark.parametrize("mask", [[True, False, True], [False] * 3, [True] * 3])
def test_the_pull_of_the_opacity_prior_is_the_oracles(mask):
    mirror, opacities = Mirror(FOLDER, np.float64), np.array([0.25, 0.5, 0.75])
    found = STAGES["pop_loss_vjp"](mirror, opacities, np.array(mask), 0.5)
    np.testing.assert_array_equal(found, pop_loss_vjp(opacities, np.array(mask), 0.5))


@given(seed=st.integers(0, 2**16))
def test_children_of_a_split_are_the_oracles(seed):
    rng = np.random.default_rng(seed)
    params = {"means": rng.normal(size=(3, 3)), "scales": rng.normal(size=(3, 3)), "quats": rng.normal(size=(3, 4))}
    params["opacities"] = rng.normal(size=3)
    normals = rng.normal(size=(2, 3, 3))
    expected = split_rows(rows_from_params(params), np.ones(3, dtype=bool), normals).params
    rows = [np.concatenate([params[name]] * 2) for name in ("means", "quats", "scales")]
    found = Mirror(FOLDER, np.float64).call("split_rows", 6, [*rows, normals.reshape(6, 3)], [(6, 6)], numbers=(1.6,))[
        0
    ]
    np.testing.assert_allclose(found[:, :3], expected["means"], rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(found[:, 3:], expected["scales"], rtol=1e-13, atol=1e-14)


def test_the_densification_gradient_is_the_oracles():
    v_means2d = np.array([[0.5, -0.25], [1.0, 2.0]])
    visible, counts = np.array([True, True]), np.zeros(2, dtype=np.int64)
    expected = accumulate(zero_statistics(2), v_means2d, visible, counts, 8, 4)
    found = Mirror(FOLDER, np.float64).call("densification_gradient", 2, [v_means2d], [(2,)], integers=(8, 4))[0]
    np.testing.assert_allclose(found, expected.grad_sum, rtol=1e-15)


def test_lists_name_the_oracles_tiles_where_they_are_not_exact():
    means2d, radii = np.array([[1.0, 1.0], [3.0, 1.0], [1.0, 1.0]]), np.ones((3, 2), dtype=np.int64)
    rects = STAGES["tile_rects"](Mirror(FOLDER, np.float64), means2d, radii, 4, 2, 2)
    lists = tile_lists(means2d, radii, np.array([2.0, 1.0, 2.0]), 4, 2, 2)
    for tile, ids in enumerate(lists):
        assert sorted(ids) == [i for i, (x0, y0, x1, y1) in enumerate(rects) if x0 <= tile < x1 and y0 <= 0 < y1]
