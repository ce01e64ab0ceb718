"""A failing law's report names the right cause, and is about the example that broke the law."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pop_ref.conformance import laws
from pop_ref.conformance.adapter import OracleAdapter, View
from pop_ref.conformance.backends import shipped
from pop_ref.conformance.calls import Call, call_as_code
from pop_ref.conformance.law import is_crash
from pop_ref.conformance.mutants import BLACK_BOXES, MUTANTS, living
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.pairs import (
    FACTORS,
    accepted,
    call_of,
    covering_rows,
    judged_pairs,
    pairs_of,
    possible_pairs,
)
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.signature import made
from pop_ref.conformance.torch_adapter import TorchAdapter

BOXES = {box.name: box for box in BLACK_BOXES}


def report(path: str, backend: Any) -> str:
    """Run a law as pytest does, and return its failure with the report."""
    module, _, name = path.partition(":")
    test = getattr(importlib.import_module(f"{laws.__name__}.{module}"), f"test_{name}")
    with pytest.raises(AssertionError) as caught:
        test(backend=backend)
    return "\n".join([str(caught.value), *caught.value.__notes__])


CAUSES = {
    "near_plane_ignored": ("first difference: images", "first cause: with near_plane=2\n"),
    "eps2d_ignored": ("first difference: images", "first cause: with eps2d=0.0625\n"),
    "radius_clip_ignored": ("first difference: images", "first cause: with radius_clip=6\n"),
    "background_of_the_camera_before": ("camera 0, pixel (", "first cause: with 2 cameras and backgrounds together"),
    "intrinsics_of_the_first_camera": ("camera 1, pixel (", "first cause: with 2 cameras\n"),
    "expected_depth_not_divided": ("first difference: images", "first cause: with render_mode='ED'\n"),
    "expected_depth_of_a_constant_opacity": ("first difference: gradients", "first cause: with render_mode='ED'\n"),
    "tiles_counted_in_a_byte": ("first difference: tiles: meta tiles_per_gauss", "tiles together"),
    "dominant_packed_rows": ("first difference: dominance: meta dominant_ids", "first cause: with packed=True\n"),
    "covariances_counted_once": ("first difference: gradients", "first cause: with covars\n"),
    "white_by_default": ("pixel (0, 0), channel 0: got 1.0, expected 0.0", "first cause: with backgrounds=None\n"),
    "dominant_counts_of_the_first_camera": ("dominant_counts beside dominant_ids, camera 1", "with 2 cameras\n"),
    "packed_is_classic": ("first difference: images", "with packed=True and rasterize_mode='antialiased' together"),
    "depth_of_the_first_entry": ("batch entry 1, pixel (", "with batch dimensions [2] and render_mode="),
    "packed_fails_with_backgrounds": ("fails an assertion of its own", "packed=True and backgrounds together"),
    "packed_view_gradients_are_of_one_camera": ("agreement.v_viewmat: camera 0", "2 cameras and packed=True together"),
}


@pytest.mark.slow  # a run of the kit for each of twelve
@pytest.mark.parametrize("name", CAUSES)
def test_the_report_of_a_broken_rasterizer_names_its_cause(name: str) -> None:
    text = report(BOXES[name].law, BOXES[name].adapter())
    for words in CAUSES[name]:
        assert words in text
    # stages are spoken of where they have been compared, and these show none before the pixel but in meta
    assert "stages" not in text


@pytest.mark.parametrize(
    ("name", "law", "words"),
    [
        ("jacobian_sign", "the_image_is_one_of_the_oracles_outcomes", "first stage that differs: projection_jacobians"),
        ("conic_off_diagonal_twice", "gradients_are_the_oracles", "first gradient that differs: v_"),
    ],
)
def test_a_stage_is_blamed_where_stages_were_compared_and_it_differs(name: str, law: str, words: str) -> None:
    (mutant,) = (each for each in MUTANTS if each.name == name)
    with living(mutant) as backend:
        text = report(f"test_agreement:{law}", backend)
    assert words in text
    assert ("first stage" in text) == words.startswith("first stage")


class WrongAlone(OracleAdapter):
    """The oracle, with a gradient of scales that is wrong for a scene of one Gaussian, the first that a law tries."""

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        found = super().gradients(scene, v_image, v_T_final)
        return found | {"scales": found["scales"] * (1.0 + (len(scene.gaussians) == 1))}


def test_a_report_is_about_the_example_that_raised_the_error() -> None:
    text = report("test_agreement:gradients_are_the_oracles", WrongAlone())
    assert "first gradient that differs: v_scales, Gaussian 0" in text
    pasted: dict[str, Any] = {}
    exec(text[text.index("from pop_ref.conformance.scenes") :].partition("\nlaw ")[0], pasted)
    assert len(pasted["scene"].gaussians) == 1


class Darker(OracleAdapter):
    """The oracle with colours that are a little too dark: nothing before the pixel differs, nor does T_final."""

    def has(self, need: str) -> bool:
        return need in ("render", "gradients") or (super().has(need) and not need.isidentifier())

    def render(self, scene: Scene) -> View:
        view = super().render(scene)
        return View(**{**vars(view), "image": view.image * 0.75})


def test_what_follows_from_meta_is_said_only_as_far_as_it_follows() -> None:
    text = report("test_agreement:the_image_is_one_of_the_oracles_outcomes", Darker())
    assert "no stage that its meta shows differs: depths, means2d, conics, and so is T_final, so it is colours" in text


def test_a_printed_call_can_be_pasted() -> None:
    backend = shipped("fast32")
    rows = covering_rows(accepted(backend).levels)
    for number, row in enumerate(rows[:12]):
        call, scope = call_of(backend, row, number), {}
        exec(call_as_code(call), scope)
        pasted = scope["call"]
        assert isinstance(pasted, Call)
        assert (repr(pasted), pasted.described()) == (repr(call), call.described())
        for name, value in call.tensors().items():
            assert np.array_equal(value, pasted.tensors()[name])


def test_every_pair_of_levels_meets_in_some_row_and_every_level_moves_something() -> None:
    levels = {factor: tuple(one.name for one in values) for factor, values in FACTORS.items()}
    rows = covering_rows(levels)
    assert pairs_of(rows) >= set(possible_pairs(levels))
    assert len(rows) < 60
    backend = shipped("fast32")
    taken = covering_rows(accepted(backend).levels)
    clipped = [call_of(backend, row, k) for k, row in enumerate(taken) if row["radius_clip"] != "0"]
    assert len(clipped) > 10
    first = made(backend, clipped[0])
    assert any(np.any(~e.render.splats.visible) for _, _, e in first.each())


@pytest.mark.slow  # all pairs of arguments
def test_pairs_that_only_failing_calls_hold_are_named_and_count_as_not_judged() -> None:
    backend = BOXES["packed_fails_with_backgrounds"].adapter()
    assert judged_pairs(backend) == {}
    with pytest.raises(AssertionError) as caught:
        every_law()["test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"].sentence(backend)
    assert is_crash(caught.value)
    found = judged_pairs(backend)
    assert found["judged"] < found["taken"] <= found["of"]
    assert "packed=True with backgrounds=given" in found["only in calls that fail"]
    assert found["by arguments"]["packed x backgrounds"] == "3 of 4"


def _named(**parameters: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a function gsplat's signature, less some arguments."""
    import inspect

    from pop_fast.api.rasterize import rasterization as sound

    def named(function: Callable[..., Any]) -> Callable[..., Any]:
        taken = [p for name, p in inspect.signature(sound).parameters.items() if name not in parameters["without"]]
        function.__signature__ = inspect.Signature(taken)  # type: ignore[attr-defined]
        return function

    return named


@_named(without=("tile_size", "profile", "dominance", "counts", "backend"))
def no_tile_size(*args: Any, **options: Any) -> Any:
    return shipped("fast32")._rasterization(*args, **options)


@_named(without=("profile", "dominance", "counts", "backend"))
def no_camera_ids(*args: Any, **options: Any) -> Any:
    images, alphas, meta = shipped("fast32")._rasterization(*args, **options)
    return images, alphas, {key: meta[key] for key in meta if key not in ("camera_ids", "batch_ids")}


@pytest.mark.slow  # all laws of the signature
@pytest.mark.parametrize("rasterization", [no_tile_size, no_camera_ids])
def test_a_sound_rasterizer_without_tile_size_or_camera_ids_breaks_no_law_of_the_signature(
    rasterization: Callable[..., Any],
) -> None:
    backend = TorchAdapter("sound", rasterization, dtype="float32")
    judged = 0
    for path, stated in every_law().items():
        if path.startswith("test_signature") and not [need for need in stated.needs if not backend.has(need)]:
            with contextlib.suppress(pytest.skip.Exception):
                stated.sentence(backend)
                judged += 1
    assert judged >= 24
