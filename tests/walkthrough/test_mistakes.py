"""The mistakes that are known by name: each is recognised by its own numbers, and none of them is right."""

from __future__ import annotations

import pytest

from pop_ref.conformance.mutants.trial import every_law
from pop_ref.learn.course import COURSE, NOT_TAUGHT
from pop_ref.learn.diagnosis import diagnose
from pop_ref.learn.mistakes import MISTAKES
from pop_ref.learn.mistakes_geometry import Mistake
from pop_ref.learn.probes import oracle, probes
from pop_ref.learn.student import Call, tried_on

# one sentence may be of several mistakes, such as half a pixel to the left and to the right
NAMED = [f"{k}-{mistake.function}" for k, mistake in enumerate(MISTAKES)]


def _calls(mistake: Mistake) -> list[Call]:
    def made(*given: object) -> object:
        return mistake.made(oracle(), *given)

    truth = oracle()[mistake.function]
    return [tried_on(made, truth, given, words) for words, given in probes(mistake.function)]


@pytest.mark.parametrize("mistake", MISTAKES, ids=NAMED)
def test_a_mistake_is_wrong_and_told_in_its_own_words(mistake: Mistake, tmp_path) -> None:
    calls = _calls(mistake)
    assert not all(call.is_right for call in calls)
    assert not any(call.error for call in calls)
    sentence, hint, _ = diagnose(calls, tmp_path)
    assert (sentence, hint) == (mistake.sentence, mistake.hint)


def test_a_law_that_the_course_leaves_out_is_one_of_its_stages() -> None:
    stages = {stage for each in COURSE for stage in each.laws}
    for name in NOT_TAUGHT:
        laws = [law for key, law in every_law().items() if key.partition(":")[2] == name]
        assert len(laws) == 1, name
        assert laws[0].stage in stages


def test_what_adam_gives_is_told_by_what_it_is(tmp_path) -> None:
    def half(*given, **named):
        params, m, v = oracle()["adam_step"](*given, **named)
        return params, {name: 0.3 * x + 1.0 for name, x in m.items()}, v

    calls = [tried_on(half, oracle()["adam_step"], given, words) for words, given in probes("adam_step")]
    assert diagnose(calls, tmp_path)[0].startswith("the mean m in adam_step is not right yet")


def test_a_pixel_that_blends_too_few_is_told_how_many(tmp_path) -> None:
    def one(ids, *given):
        return oracle()["composite_pixel"](ids[:1], *given)

    calls = [tried_on(one, oracle()["composite_pixel"], given, words) for words, given in probes("composite_pixel")]
    sentence = diagnose(calls, tmp_path)[0]
    assert sentence == "composite_pixel blends another number of splats, 1 and not 3."


def test_who_sets_a_field_of_the_totals_is_told_to_add_in_place(tmp_path) -> None:
    def setting(pixel, rows, px, py, background, v_color, v_T_final, totals):
        totals.v_background += pixel.T_final

    truth = oracle()["composite_pixel_vjp"]
    calls = [tried_on(setting, truth, given, words) for words, given in probes("composite_pixel_vjp")]
    _, hint, _ = diagnose(calls, tmp_path)
    assert "totals.v_background[:] += x" in hint


def _sentence(name: str, made, tmp_path) -> str:
    calls = [tried_on(made, oracle()[name], given, words) for words, given in probes(name)]
    return diagnose(calls, tmp_path)[0]


def test_an_argument_that_is_a_factor_too_many_or_too_few_is_named(tmp_path) -> None:
    def without_v(image, target, v_l2, *mask):
        return oracle()["l2_vjp"](image, target, 1.0, *mask)

    def blurred(covars2d, eps2d, v):
        return eps2d * v

    assert _sentence("l2_vjp", without_v, tmp_path) == "l2_vjp lacks the factor `v_l2`."
    assert "has the factor `eps2d`, which does not belong there" in _sentence("low_pass_vjp", blurred, tmp_path)


def test_the_translation_of_a_camera_is_named_and_no_letter(tmp_path) -> None:
    def turned_back(viewmat, v_center):
        back = oracle()["camera_center_vjp"](viewmat, v_center)
        back[:3, 3] = -viewmat[:3, :3].T @ v_center
        return back

    assert "the last column, the translation's, only" in _sentence("camera_center_vjp", turned_back, tmp_path)
