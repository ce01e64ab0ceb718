"""Laws of agreement: every stage function, image, integer and gradient is the oracle's."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from pop_ref.conformance.adapter import Reference
from pop_ref.conformance.assertions import (
    assert_close,
    assert_close_along_rigid_motions,
    assert_same_bits,
    assert_same_image,
    assert_same_transmittance,
    with_error_bounds,
)
from pop_ref.conformance.capabilities import (
    ALL_BANDS,
    ANTIALIASING,
    DOMINANCE,
    DOMINANT_WEIGHTS,
    DOUBLE,
    GRADIENTS,
    INRIAS,
    LOWER_CEILING,
    RENDER,
)
from pop_ref.conformance.cases import CASES, cotangent_like, error_bounds_of, tangential, transposed
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import Record, Scene, cotangents, pack, rounded
from pop_ref.conformance.strategies import corners, plain_sizes, scenes, wide_scene
from pop_ref.conformance.thresholds import assert_one_of_the_oracles_outcomes
from pop_ref.constants import GSPLAT_1_6, INRIA, Profile
from pop_ref.records import Camera

ORACLE = Reference()


def _values(value):
    return value if isinstance(value, tuple) else (value,)


def _first(case):
    return [{"inputs": inputs} for inputs in case.first]


def _needs(case):
    return (ALL_BANDS,) if case.stage == "harmonics" else ()


def _agreement(case):
    def sentence(backend, inputs):
        inputs = rounded(inputs, backend.dtype)
        function = ORACLE.stage(case.name)
        expected = _values(function(*inputs))
        found = _values(backend.stage(case.name)(*inputs))
        for a, e, c in zip(found, expected, error_bounds_of(case, function, inputs), strict=True):
            assert_close(f"agreement.{case.name}", a, e, c, backend.dtype, against_oracle=True)

    sentence.__name__ = f"test_{case.name}_is_the_oracles"
    return law(case.stage, case.name, *_needs(case), first=_first(case), inputs=case.inputs)(sentence)


def _transpose_agreement(case):
    name = f"{case.name}_vjp"

    def sentence(backend, inputs):
        inputs = rounded(inputs, backend.dtype)
        v = cotangent_like(ORACLE.stage(case.name)(*inputs))

        def oracle(*args):
            return transposed(case, ORACLE.stage(name), args, v)

        found = transposed(case, backend.stage(name), inputs, v)
        for a, e, c in zip(found, oracle(*inputs), error_bounds_of(case, oracle, inputs), strict=True):
            assert_close(f"agreement.{name}", a, e, c, backend.dtype, against_oracle=True)

    sentence.__name__ = f"test_{name}_is_the_oracles"
    return law(case.stage, name, *_needs(case), first=_first(case), inputs=case.inputs)(sentence)


def _adjoint(case):
    name = f"{case.name}_vjp"

    def sentence(backend, inputs, direction):
        inputs = tuple(_with_true_gradient(value) for value in inputs)
        function = backend.stage(case.name)
        here = np.asarray(function(*inputs), dtype=np.float64)
        v = cotangent_like(here)
        pulled = transposed(case, backend.stage(name), inputs, v)
        rng = np.random.default_rng(direction)
        steps = [np.round(8.0 * rng.uniform(-1.0, 1.0, inputs[k].shape)) / 8.0 for k in case.wrt]
        steps = [_kept_inside(case, u, inputs[k]) for u, k in zip(steps, case.wrt, strict=True)]
        slopes = [_slope(function, inputs, case.wrt, steps, v, 2.0**-k) for k in (18, 20)]
        # where the two step widths part, a kink or a pole is near; the derivative is one-sided there
        size = sum(np.sum(np.abs(p * u)) for p, u in zip(pulled, steps, strict=True)) + np.sum(np.abs(v * here)) + 1.0
        assume(abs(slopes[0] - slopes[1]) <= 1e-6 * size)
        stated = sum(np.sum(p * u) for p, u in zip(pulled, steps, strict=True))
        assert_close("adjoint", slopes[1], stated, size * 2.0**33, backend.dtype)

    sentence.__name__ = f"test_{name}_is_the_transpose"
    drawn = {"inputs": case.inputs, "direction": st.integers(0, 2**16)}
    return law(case.stage, case.name, name, DOUBLE, *_needs(case), **drawn)(sentence)


def _with_true_gradient(value):
    # inria's clamp is differentiated wrongly on purpose (B1); the same clamp has a true transpose too
    return dataclasses.replace(value, clamp_gradient="exact") if isinstance(value, Profile) else value


def _kept_inside(case, step, value):
    if case.name in ("low_pass", "compensations", "conics_from_covars2d", "covars_cam_from_covars", "project_covars"):
        symmetric = value.ndim == 3 and value.shape[1] == value.shape[2]
        return 0.5 * (step + np.swapaxes(step, 1, 2)) if symmetric else np.where(value == 0.0, 0.0, step)
    if case.on_sphere:
        return tangential(step, value)
    if value.shape == (4, 4):
        return np.vstack([step[:3], np.zeros((1, 4))])
    return step


def _slope(function, inputs, wrt, steps, v, h):
    ends = []
    for sign in (1.0, -1.0):
        moved = list(inputs)
        for k, u in zip(wrt, steps, strict=True):
            moved[k] = inputs[k] + sign * h * u
        ends.append(np.sum(v * np.asarray(function(*moved), dtype=np.float64)))
    return (ends[0] - ends[1]) / (2.0 * h)


for _case in CASES:
    for _make in (_agreement, *((_transpose_agreement, _adjoint) if _case.wrt else ())):
        _test = _make(_case)
        globals()[_test.law.sentence.__name__] = _test
del _case, _make, _test


@law("compositing", RENDER, first=corners(3), scene=scenes(max_degree=3))
def test_the_image_is_one_of_the_oracles_outcomes(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    assert_one_of_the_oracles_outcomes(backend, seen, error_bounds)


@law(
    "compositing",
    RENDER,
    first=corners(3),
    scene=st.one_of(scenes(max_degree=3), st.integers(0, 2**16).map(wide_scene)),
)
def test_the_image_that_training_draws_is_one_of_the_oracles_outcomes(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    assert_one_of_the_oracles_outcomes(backend, seen, error_bounds, backend.plainly(seen))


@law("compositing", RENDER, LOWER_CEILING, first=corners(3, profile=GSPLAT_1_6), scene=scenes(profile=GSPLAT_1_6))
def test_the_image_under_the_lower_ceiling_is_one_of_the_oracles_outcomes(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    assert_one_of_the_oracles_outcomes(backend, seen, error_bounds)


@law("compositing", RENDER, INRIAS, scene=scenes(profile=INRIA, size=plain_sizes(), max_side=16))
def test_the_image_of_inrias_profile_is_the_oracles(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    expected, view = ORACLE.render(seen), backend.render(seen)
    assert_same_image("agreement.image", backend, view.image, expected.image, error_bounds, against_oracle=True)
    assert_same_transmittance(
        "agreement.T_final", backend, view.T_final, expected.T_final, error_bounds, against_oracle=True
    )


# seen from aside, as in a crop of a larger picture: the principal point lies beyond the border
_ASIDE = {"K": np.array([[8.0, 0.0, -1.5], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]])}

# twelve white specks, one behind the other, which the low-pass dims to little more than an alpha that is skipped
_WATCHING = Camera(np.eye(4), np.array([[8.0, 0.0, 2.5], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]]), 5, 5)
_SPECK = Record(2.5, 2.5, size=(0.0375, 0.0375, 0.0375), opacity=0.9375, sh=((1.5, 1.5, 1.5),))
_SPECKS = Scene(
    pack([dataclasses.replace(_SPECK, depth=2.0 + k) for k in range(12)], _WATCHING), _WATCHING, antialiased=True
)


@law(
    "footprint",
    RENDER,
    ANTIALIASING,
    first=[*corners(1, antialiased=True), *corners(1, antialiased=True, **_ASIDE)[:2], {"scene": _SPECKS}],
    scene=scenes(max_gaussians=4, anchored=True, size=plain_sizes()).map(lambda s: s.with_overrides(antialiased=True)),
)
def test_the_antialiased_image_is_one_of_the_oracles_outcomes(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    assert_one_of_the_oracles_outcomes(backend, seen, error_bounds)


@law("dominance", RENDER, DOMINANCE, first=corners(), scene=scenes(anchored=True))
def test_dominant_ids_are_the_oracles(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    expected, view = ORACLE.render(seen), backend.render(seen)
    assert_same_bits("winner", view.dominant_ids, expected.dominant_ids, error_bounds.decided)


@law("dominance", RENDER, DOMINANCE, DOMINANT_WEIGHTS, scene=scenes(anchored=True))
def test_dominant_weights_are_the_oracles(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    expected, view = ORACLE.render(seen), backend.render(seen)
    magnitude = error_bounds.dominant_weight + 1.0
    at = error_bounds.unambiguous
    weights = (view.dominant_weights[at], expected.dominant_weights[at])
    assert_close("agreement.weight", *weights, magnitude[at], backend.dtype, against_oracle=True)


@law("gradients", GRADIENTS, first=corners(3), scene=scenes(anchored=True, max_gaussians=5, max_degree=3))
def test_gradients_are_the_oracles(backend, scene):
    _gradients_agree(backend, scene)


@law(
    "gradients",
    GRADIENTS,
    LOWER_CEILING,
    first=corners(2, profile=GSPLAT_1_6),
    scene=scenes(anchored=True, max_gaussians=4, profile=GSPLAT_1_6),
)
def test_gradients_under_the_lower_ceiling_are_the_oracles(backend, scene):
    _gradients_agree(backend, scene)


def _opaque(scene):
    """Return a scene that is opaque, so that alphas pass the ceiling near the centres."""
    return scene.with_overrides(opacities=np.ones(len(scene.gaussians.means)))


@law(
    "gradients",
    GRADIENTS,
    INRIAS,
    scene=scenes(profile=INRIA, anchored=True, max_gaussians=3, size=plain_sizes(), max_side=12).map(_opaque),
)
def test_gradients_under_inrias_ceiling_pass_through_it_as_the_oracles_do(backend, scene):
    _gradients_agree(backend, scene)


@law(
    "gradients",
    GRADIENTS,
    ANTIALIASING,
    first=corners(1, antialiased=True),
    scene=scenes(anchored=True, max_gaussians=3, size=plain_sizes()).map(lambda s: s.with_overrides(antialiased=True)),
)
def test_antialiased_gradients_are_the_oracles(backend, scene):
    _gradients_agree(backend, scene)


def _gradients_agree(backend, scene):
    """Compare every gradient where decisions are unambiguous: other pixels get no cotangent."""
    seen, error_bounds = with_error_bounds(backend, scene)
    sure = error_bounds.smooth
    v_image, v_T_final = cotangents(seen)
    v_image, v_T_final = v_image * sure[..., None], v_T_final * sure
    expected = ORACLE.gradients(seen, v_image, v_T_final)
    found = backend.gradients(seen, v_image, v_T_final)
    bounds = gradient_error_bounds(seen, error_bounds, v_image, v_T_final)
    rows = ~error_bounds.screen.kinked
    for name, value in found.items():
        pick = rows if len(rows) == len(value) and name not in ("background", "viewmat") else slice(None)
        if name == "viewmat":
            if np.all(rows):
                given = (seen.camera.viewmat, value, expected[name], bounds[name], backend.dtype)
                assert_close_along_rigid_motions("agreement.v_viewmat", *given)
            continue
        args = (value[pick], expected[name][pick], bounds[name][pick])
        assert_close(f"agreement.v_{name}", *args, backend.dtype, against_oracle=True)
