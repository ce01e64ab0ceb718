"""Laws of autograd's contract: whatever requires a gradient, however it lies in memory, in whatever order of passes."""

from __future__ import annotations

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import (
    assert_close,
    assert_close_along_rigid_motions,
    assert_same_bits,
    with_error_bounds,
)
from pop_ref.conformance.capabilities import GRADIENTS, PACKED
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import Scene, cotangents
from pop_ref.conformance.torch_autograd import LAYOUTS, NAMES, Ask
from pop_ref.conformance.views import cameras, gaussians
from pop_ref.constants import PAPER

ORACLE = OracleAdapter()
BEHIND = (0.25, 0.5, 0.75)
# what both outputs follow
PARAMETERS = ("means", "quats", "scales", "opacities")


def _scene(backend, alike=False):
    """Return a scene as the backend reads it, its bounds, and cotangents where no decision is near its threshold.

    Args:
        backend: that reads it.
        alike: whether every Gaussian has one size along all axes.
    """
    profile = backend.profile or PAPER
    camera = cameras(1, profile.principal_point == "centred")[0]
    tile_size = None if profile.extent == "square" else 4
    scene = Scene(gaussians(16, degree=2), camera, BEHIND, profile, tile_size)
    if alike:
        scene = scene.with_overrides(scales=np.repeat(scene.gaussians.scales[:, :1], 3, axis=1))
    seen, bounds = with_error_bounds(backend, scene)
    v_image, v_T_final = cotangents(seen)
    sure = bounds.smooth
    return seen, bounds, v_image * sure[..., None], v_T_final * sure


def _assert_gradients(backend, ask, weight=1.0, plus=0.0, digits=1.0):
    """Hold the gradients of an ask, of cotangents times `digits`, to the oracle's; return what came of it."""
    seen, bounds, v_image, v_T_final = _scene(backend, ask.layout == "repeated")
    v_image, v_T_final = digits * v_image, digits * v_T_final
    if ask.cotangent == "channels":
        v_image = np.repeat(v_image[..., :1], 3, axis=2)
    if ask.cotangent == "expanded":
        assert np.all(bounds.smooth), "a decision of the scene is near its threshold; take another scene"
        v_image, v_T_final = np.full_like(v_image, v_image.flat[0]), np.full_like(v_T_final, v_T_final.flat[0])
    v_image = v_image * ("image" in ask.outputs)
    v_T_final = v_T_final * ("alpha" in ask.outputs)
    done = backend.differentiate(seen, v_image, v_T_final, ask)
    assert not done.refused, f"the backward pass fails: {done.refused}"
    wanted = ORACLE.gradients(seen, v_image, v_T_final)
    error_bounds = gradient_error_bounds(seen, bounds, np.abs(v_image), np.abs(v_T_final))
    for name in ask.wanted:
        if name not in done.gradients:
            # the program says that it has none of this argument
            continue
        found = done.gradients[name]
        assert found is not None, f"{name} requires a gradient and got none"
        expected, size = weight * wanted[name] + plus, abs(weight) * error_bounds[name] + abs(plus)
        if name == "viewmat":
            given = (seen.camera.viewmat, found, expected, size, backend.dtype)
            assert_close_along_rigid_motions("autograd.v_viewmat", *given)
        else:
            assert_close(f"autograd.v_{name}", found, expected, size, backend.dtype, against_oracle=True)
    return done


@law("autograd", GRADIENTS, "differentiate")
def test_each_argument_alone_has_the_gradient_that_all_have_together(backend):
    for name in NAMES:
        done = _assert_gradients(backend, Ask(wanted=(name,)))
        assert not done.others, f"with {name} alone, {done.others} got gradients that nobody asked for"


@law("autograd", GRADIENTS, "differentiate")
def test_an_argument_without_a_gradient_takes_none_from_the_others(backend):
    for name in NAMES:
        done = _assert_gradients(backend, Ask(wanted=tuple(other for other in NAMES if other != name)))
        assert not done.others, f"{done.others} got gradients that nobody asked for"


@law("autograd", GRADIENTS, "differentiate")
def test_how_arguments_lie_in_memory_changes_no_gradient(backend):
    for layout in LAYOUTS:
        _assert_gradients(backend, Ask(layout=layout))
    # how each is added up over axes is autograd's own
    _assert_gradients(backend, Ask(layout="repeated", wanted=tuple(name for name in NAMES if name != "scales")))


@law("autograd", GRADIENTS, "differentiate")
def test_how_cotangents_lie_in_memory_changes_no_gradient(backend):
    for layout in (*LAYOUTS, "channels", "expanded"):
        _assert_gradients(backend, Ask(cotangent=layout))


@law("autograd", GRADIENTS, "differentiate")
def test_cotangents_are_read_to_their_last_digit(backend):
    # those of the other laws have so few digits that half precision holds them, and none is as small as a mean's
    for digits in (0.7, 2.0**-30):
        _assert_gradients(backend, Ask(), digits=digits)


@law("autograd", GRADIENTS, "differentiate")
def test_an_output_that_no_loss_reads_adds_nothing(backend):
    for output in ("image", "alpha"):
        _assert_gradients(backend, Ask(outputs=(output,), wanted=PARAMETERS))


@law("autograd", GRADIENTS, "differentiate")
def test_without_gradients_the_same_image_is_drawn_and_follows_nothing(backend):
    for mode in ("no_grad", "inference_mode"):
        done = _assert_gradients(backend, Ask(before=mode))
        with_gradients, without = done.image
        assert done.follows == (True, False), (
            f"an image that was drawn under {mode} requires a gradient, or another not"
        )
        assert not done.changed, f"a call under {mode} changes {done.changed}"
        size = np.abs(with_gradients) + 1.0
        assert_close("autograd.image", without, with_gradients, size, backend.dtype)


@law("autograd", GRADIENTS, "differentiate")
def test_nothing_follows_where_no_argument_requires_a_gradient(backend):
    seen, _, v_image, v_T_final = _scene(backend)
    done = backend.differentiate(seen, v_image, v_T_final, Ask(wanted=(), outputs=()))
    assert done.follows[0] is False, "an image of arguments without gradients requires one"


@law("autograd", GRADIENTS, "differentiate")
def test_under_autocast_the_same_image_is_drawn_and_has_the_same_gradients(backend):
    # where a loss of others trains in mixed precision; the way back lies outside, as torch asks for
    plain, mixed = (_assert_gradients(backend, Ask(before=before)).image[0] for before in ("nothing", "autocast"))
    assert_close("autograd.image", mixed, plain, np.abs(plain) + 1.0, backend.dtype)


@law("autograd", GRADIENTS, "differentiate")
def test_a_second_forward_pass_does_not_change_the_first_ones_gradients(backend):
    _assert_gradients(backend, Ask(before="another"))


@law("autograd", GRADIENTS, "differentiate")
def test_tensors_that_have_been_drawn_before_are_drawn_with_the_numbers_that_they_have_now(backend):
    # an optimizer writes its steps into the tensors that it was given
    plain, moved = (_assert_gradients(backend, Ask(before=before)).image[0] for before in ("nothing", "moved"))
    assert_close("autograd.image", moved, plain, np.abs(plain) + 1.0, backend.dtype)


@law("autograd", GRADIENTS, "differentiate")
def test_a_second_backward_pass_adds_the_same_again(backend):
    _assert_gradients(backend, Ask(before="twice"), weight=2.0)


@law("autograd", GRADIENTS, "differentiate")
def test_gradients_are_added_to_those_that_are_there(backend):
    _assert_gradients(backend, Ask(before="present"), plus=1.0)


@law("autograd", GRADIENTS, "differentiate")
def test_a_render_leaves_its_arguments_as_they_are(backend):
    for layout in ("dense", "transposed"):
        done = _assert_gradients(backend, Ask(layout=layout))
        assert not done.changed, f"{done.changed} are not what they were before the render"


@law("autograd", GRADIENTS, "differentiate")
def test_what_is_edited_between_the_passes_is_noticed_or_does_not_matter(backend):
    # as an optimizer that steps too early; torch notices it of what was saved for the backward pass
    for name in ("means", "quats", "scales", "opacities", "sh"):
        ask = Ask(wanted=(name,), before="edited")
        seen, _, v_image, v_T_final = _scene(backend)
        done = backend.differentiate(seen, v_image, v_T_final, ask)
        if not done.refused:
            _assert_gradients(backend, ask)


@law("autograd", GRADIENTS, "differentiate")
def test_what_is_written_to_an_output_is_noticed_or_does_not_matter(backend):
    seen, _, v_image, v_T_final = _scene(backend)
    for output in ("image", "alpha"):
        ask = Ask(before="written", outputs=(output,), wanted=PARAMETERS)
        if not backend.differentiate(seen, v_image, v_T_final, ask).refused:
            _assert_gradients(backend, ask)


@law("autograd", GRADIENTS, PACKED, "differentiate")
def test_packed_rows_keep_the_contract_too(backend):
    # gsplat's default, and often code of its own
    orders = {"nothing": 1.0, "no_grad": 1.0, "another": 1.0, "moved": 1.0, "autocast": 1.0, "twice": 2.0}
    asks = [(Ask(before=before, packed=True), weight) for before, weight in orders.items()]
    asks += [(Ask(layout=layout, cotangent=layout, packed=True), 1.0) for layout in LAYOUTS]
    asks += [(Ask(wanted=(name,), packed=True), 1.0) for name in NAMES]
    asks += [(Ask(wanted=PARAMETERS, outputs=(output,), packed=True), 1.0) for output in ("image", "alpha")]
    for ask, weight in asks:
        done = _assert_gradients(backend, ask, weight)
        assert not done.changed, f"{done.changed} are not what they were before the render"


@law("autograd", GRADIENTS, "forgets")
def test_a_render_that_nobody_holds_any_more_gives_its_memory_back(backend):
    # what a list or a cache keeps of every call fills the memory; the last call's may stay, as buffers do
    kept = backend.forgets(_scene(backend)[0])
    assert not kept, f"{kept} of a render are still in memory after the next one, when nobody holds them"


@law("autograd", GRADIENTS, "differentiate")
def test_the_same_arguments_twice_have_the_same_gradient(backend):
    first, second = (_assert_gradients(backend, Ask(before=before)) for before in ("nothing", "no_grad"))
    for name, gradient in first.gradients.items():
        size = np.abs(gradient) + 1.0
        assert_close("autograd.image", second.gradients[name], gradient, size, backend.dtype)
    assert_same_bits("image", first.image[0].shape, second.image[0].shape)
