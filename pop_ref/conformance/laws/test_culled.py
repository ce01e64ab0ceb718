"""Laws of Gaussians that cannot be drawn: nothing of them may reach an image or a gradient, as NaN least of all."""

from __future__ import annotations

import numpy as np

from pop_ref.conformance.assertions import (
    assert_same_bits,
    assert_same_image,
    assert_same_transmittance,
    assert_seen,
    with_error_bounds,
)
from pop_ref.conformance.capabilities import GRADIENTS, RENDER
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import Record, Scene, cotangents, pack
from pop_ref.records import Camera, Gaussians

CAMERA = Camera(np.eye(4), np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]]), 8, 5)
DRAWN = [Record(3.25, 2.25, 2.0, (1.5, 1.0, 0.75), (0.5, 0.25, 1.0, 0.125), 0.5), Record(5.0, 3.0, 3.0, opacity=0.75)]


def _scene(centres, opacity=1.0, scale=1.0):
    """Return two Gaussians that are drawn and, between them, one at each centre that is not."""
    g, n = pack(DRAWN, CAMERA), len(centres)

    def between(rows, more):
        return np.concatenate((rows[:1], np.broadcast_to(more, (n, *rows.shape[1:])), rows[1:]))

    return Scene(
        Gaussians(
            between(g.means, np.array(centres)),
            between(g.quats, [0.5, 0.5, -0.25, 1.0]),
            between(g.scales, scale),
            between(g.opacities, opacity),
            between(g.sh, 0.5),
        ),
        CAMERA,
        (0.25, 0.5, 0.75),
    )


def _assert_only_the_others_have_gradients(backend, scene, zero, hidden=slice(1, -1)):
    seen = backend.sees(scene)
    gradients = backend.gradients(seen, *cotangents(seen))
    assert np.any(gradients["means"][[0, -1]] != 0.0), "the Gaussians that are drawn have no gradient either"
    for name, value in gradients.items():
        assert np.all(np.isfinite(value)), f"v_{name} is not finite: {value.tolist()}"
        if name in zero:
            assert_same_bits(f"v_{name} of what is not drawn", value[hidden], np.zeros_like(value[hidden]))


EVERYTHING = ("means", "quats", "scales", "opacities", "sh", "means2d", "means2d_abs")


@law("gradients", GRADIENTS)
def test_a_centre_in_the_plane_of_the_camera_has_no_gradient(backend):
    # z = 0: 0/0 on the axis, 1/0 beside it
    scene = _scene([[0.0, 0.0, 0.0], [1.0, -0.5, 0.0], [0.0, 2.0, -0.0]])
    _assert_only_the_others_have_gradients(backend, scene, EVERYTHING)


@law("gradients", GRADIENTS)
def test_a_centre_behind_the_camera_whose_projection_overflows_has_no_gradient(backend):
    huge = 1e30 if backend.dtype == np.float32 else 1e200
    scene = _scene([[huge, 0.0, -1.0 / huge], [huge, -huge, -huge], [1.0, 1.0, -1.0 / huge]])
    _assert_only_the_others_have_gradients(backend, scene, EVERYTHING)


@law("gradients", GRADIENTS)
def test_an_opacity_of_zero_has_no_gradient(backend):
    scene = _scene([[0.0, 0.0, 2.5], [0.25, 0.0, 1.0]], opacity=0.0)
    _assert_only_the_others_have_gradients(backend, scene, EVERYTHING)


@law("gradients", GRADIENTS)
def test_a_scale_of_zero_has_no_gradient_of_shape_and_finite_others(backend):
    # a point that the low-pass widens: it is drawn, and d(s^2)/ds is 0
    scene = _scene([[0.0, 0.0, 2.5], [0.25, 0.0, 1.0]], opacity=0.5, scale=0.0)
    _assert_only_the_others_have_gradients(backend, scene, ("scales", "quats"))


@law("whole", RENDER)
def test_what_cannot_be_projected_changes_no_pixel(backend):
    huge = 1e30 if backend.dtype == np.float32 else 1e200
    centres = [[0.0, 0.0, 0.0], [1.0, -0.5, 0.0], [huge, 0.0, -1.0 / huge], [huge, -huge, -huge]]
    seen = backend.sees(_scene(centres))
    drawn, error_bounds = with_error_bounds(backend, seen.rows([0, len(centres) + 1]))
    whole, without = backend.render(seen), backend.render(drawn)
    assert_seen(without)
    assert_same_image("whole.invisible", backend, whole.image, without.image, error_bounds)
    assert_same_transmittance("whole.invisible", backend, whole.T_final, without.T_final, error_bounds)
