"""What the kit notices: every mutant dies, teeth and the reach of laws are measured, every public function is guarded.

A mutant dies by the law that its entry names. That the checks hold while nothing is broken tests/laws says, on the
oracle and on the program, and tests/oracle of itself, the ladder and the doctests. Every line that no law reaches has a
reason. Every public function of the oracle is reached by a check that fails when the function is broken wherever it is
used, the kit included: its results are scaled by 1 + 2^-10, integers are off by one, truths are negated. For each
function one cheap check that notices is written down here: a law on the oracle itself, a test of `tests/oracle`, the
ladder of ten losses, or the function's doctest. Laws of agreement with the oracle do not count: a broken oracle agrees
with itself.
"""

from __future__ import annotations

import doctest
import functools
import importlib
import inspect
import json
import pkgutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pop_ref
from pop_ref.conformance import teeth, tolerances
from pop_ref.conformance.adapter import OracleAdapter, forget
from pop_ref.conformance.capabilities import STAGES
from pop_ref.conformance.law_coverage import LIMITS, MODULES, PACKAGE, Log, Logged, code_lines, reason
from pop_ref.conformance.mutants import BLACK_BOXES, FAMILIES, MUTANTS, PROGRAM, BlackBox
from pop_ref.conformance.mutants import __main__ as command
from pop_ref.conformance.mutants.black_box import breaking
from pop_ref.conformance.mutants.copies import Mutant
from pop_ref.conformance.mutants.trial import every_law, killed_by, law_named, obeys
from pop_ref.conformance.pairs import accepted, call_of, covering_rows
from pop_ref.conformance.scenes import golden_scene
from pop_ref.losses import l2
from pop_ref.magnitudes import Rounded
from tests.golden import ten_losses
from tests.judged import EVERY_PRECISION

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
EVERYONE = (*MUTANTS, *PROGRAM)
# what has two precisions; the oracle has one
OUTSIDE = (*PROGRAM, *BLACK_BOXES)
# each mutant in one of them, turn and turn about
TRIED = [
    (mutant, dtype)
    for k, mutant in enumerate(OUTSIDE)
    for dtype in (mutant.precisions if EVERY_PRECISION else [mutant.precisions[k % 2]])
]


def _inverted(given: dict[str, Any]) -> dict[str, Any]:
    """Have a gradient by view matrices as it is where rotations are inverted, not transposed, and by the last row as
    gsplat's, which inverts the matrix to find the camera's centre."""
    viewmats = given["viewmats"]
    R, t = viewmats[..., :3, :3], viewmats[..., :3, 3:]
    apart = 0.5 * (torch.linalg.inv(R).mT - R)
    center = torch.cat([-R.mT @ t, torch.ones_like(t[..., :1, :])], -2).detach()
    apart = torch.nn.functional.pad(apart - apart.detach(), (0, 1, 0, 1))
    # as much of the last row as moves nothing
    row = 0.25 * (viewmats[..., 3:, :] @ center) * torch.nn.functional.pad(torch.ones_like(t), (3, 0, 0, 1))
    return {"viewmats": viewmats + apart + (row - row.detach())}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_gradient_that_differs_along_no_rigid_motion_is_sound(dtype: str) -> None:
    laws = ("test_agreement:gradients_are_the_oracles", "test_scale:the_gradients_of_fifty_are_the_oracles",
            "test_autograd:gradients_are_added_to_those_that_are_there",
            "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone")  # fmt: skip
    backend = BlackBox("inverted", "", breaking(_inverted), laws[0]).adapter(dtype)
    assert [obeys(law_named(path), backend, 4) for path in laws] == [None] * len(laws)


# every fourth here; the others are for `make test-all`
A_FOURTH = [m if k % 4 == 0 else pytest.param(m, marks=pytest.mark.slow) for k, m in enumerate(MUTANTS)]


@pytest.mark.parametrize("mutant", A_FOURTH, ids=lambda mutant: mutant.name)
def test_the_named_law_kills_the_mutant(mutant: Mutant) -> None:
    assert killed_by(mutant) is not None, f"{mutant.name} survives {mutant.law}"


@pytest.mark.slow  # together they are
@pytest.mark.parametrize(("mutant", "dtype"), TRIED, ids=lambda value: getattr(value, "name", value))
def test_the_named_law_kills_the_mutant_in_either_precision(mutant: Mutant | BlackBox, dtype: str) -> None:
    assert killed_by(mutant, dtype) is not None, f"{mutant.name} survives {mutant.law} in {dtype}"


def test_a_trial_says_who_dies_by_what(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["no_half_in_the_exponent"]) == 0
    assert capsys.readouterr().out.startswith(
        "no_half_in_the_exponent in float64: killed by "
        "test_alpha:the_exponent_is_half_the_squared_distance_in_the_conics_metric (AssertionError: alpha.sigma"
    )
    assert command.main(["near_plane_ignored"]) == 0
    said = capsys.readouterr().out
    assert [f"near_plane_ignored in float{bits}: killed by" in said for bits in (32, 64)] == [True] * 2
    assert "whole rasterizers: 1 of 1 killed" in said
    with pytest.raises(SystemExit):
        command.main(["nobody"])
    assert "there is no mutant nobody" in capsys.readouterr().err


class _Soft:
    """A mutant that its law notices in float32 alone."""

    name, law, precisions = "soft", "test_alpha:soft", ("float32", "float64")


def test_a_mutant_that_lives_in_one_precision_is_kept_as_alive(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "FAMILIES", {"soft ones": (_Soft,)})
    monkeypatch.setattr(command, "killed_by", lambda mutant, dtype: "broken" if dtype == "float32" else None)
    assert command.main(["--json", str(tmp_path / "kills.json")]) == 1
    assert capsys.readouterr().out.endswith("soft ones: 0 of 1 killed\n")
    assert json.loads((tmp_path / "kills.json").read_text()) == {
        "soft ones": {"soft": {"float32": "broken", "float64": None}}
    }


def test_named_mutants_alone_are_kept_anew_and_those_that_are_gone_are_dropped(tmp_path, monkeypatch):
    class New(_Soft):
        name = "new"

    monkeypatch.setattr(command, "FAMILIES", {"soft ones": (New, _Soft)})
    monkeypatch.setattr(command, "killed_by", lambda mutant, dtype: f"{mutant.name} broken")
    file, before = tmp_path / "kills.json", {"float32": "as it was", "float64": "as it was"}
    file.write_text(json.dumps({"soft ones": {"gone": before, "soft": before}}))
    assert command.main(["new", "--json", str(file)]) == 0
    kept = json.loads(file.read_text())
    assert kept == {"soft ones": {"new": dict.fromkeys(New.precisions, "new broken"), "soft": before}}
    assert list(kept["soft ones"]) == ["new", "soft"]


def test_what_is_published_of_kills_is_of_todays_mutants_in_every_precision_that_they_have() -> None:
    kept = json.loads((RESULTS / "kills.json").read_text(encoding="utf-8"))
    for family, mutants in FAMILIES.items():
        tried = {name: set(of) for name, of in kept[family].items()}
        known = {mutant.name: set(mutant.precisions) for mutant in mutants}
        assert tried == known, "run 'python -m pop_ref.conformance.mutants MUTANT --json benchmarks/results/kills.json'"


def test_mutants_are_many_no_two_alike_and_each_changes_one_place_of_one_file() -> None:
    assert len(MUTANTS) >= 20
    assert len({mutant.name for mutant in (*EVERYONE, *BLACK_BOXES)}) == len(EVERYONE) + len(BLACK_BOXES)
    assert len({mutant.law for mutant in BLACK_BOXES}) >= 8
    assert len({(mutant.package, mutant.file, mutant.new) for mutant in EVERYONE}) == len(EVERYONE)
    for mutant in EVERYONE:
        assert mutant.broken_source()
        assert law_named(mutant.law).name == mutant.law.partition(":")[2]


def test_every_law_has_a_stage_of_its_own_and_a_sentence_for_a_name() -> None:
    laws = every_law()
    assert len({stated.name for stated in laws.values()}) == len(laws), "two laws have one name"
    for path, stated in laws.items():
        assert "_" in stated.name, f"{path} is not a sentence"
        assert stated.name == stated.name.lower(), f"{path} shouts"
    assert {stated.stage for stated in laws.values()} == set(STAGES)


TEETH = json.loads((RESULTS / "teeth.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["float32", "float64"])
def test_what_is_kept_is_what_is_measured(name: str) -> None:
    dtype = getattr(np, name)
    again = {**teeth.image_teeth(dtype), **teeth.gradient_teeth(dtype)}
    assert set(again) == set(TEETH[name]["teeth"])
    for quantity, least in again.items():
        assert least == pytest.approx(TEETH[name]["teeth"][quantity], rel=0.06)


@pytest.mark.parametrize("key", [key for key in tolerances.TABLE if key.startswith(("agreement.", "scale."))])
def test_double_precision_is_judged_to_a_trillionth_and_to_a_few_roundings(key: str) -> None:
    limit = tolerances.agreement(key, np.float64)
    assert limit <= 1e-12
    assert limit <= 64.0 * tolerances.TABLE[key].units * np.finfo(np.float64).eps


def test_sound_backends_need_little_of_what_is_allowed() -> None:
    for kept in TEETH.values():
        assert kept["sound"]
        assert max(kept["sound"].values()) < 0.25


class _Off(OracleAdapter):
    """The oracle with a background, and a gradient of the quaternions, that are wrong by a share."""

    background = 0.0
    quats = 0.0

    def render(self, scene: Any) -> Any:
        return super().render(scene.with_overrides(background=scene.background + self.background))

    def gradients(self, scene: Any, v_image: Any, v_T_final: Any) -> Any:
        found = super().gradients(scene, v_image, v_T_final)
        return {**found, "quats": found["quats"] * (1.0 + self.quats)}


@pytest.mark.parametrize(
    ("quantity", "what", "law"),
    [
        ("background", "background", "the_image_is_one_of_the_oracles_outcomes"),
        ("v_quats", "quats", "gradients_are_the_oracles"),
    ],
)
def test_a_law_notices_twice_the_tooth_and_not_half_of_it(quantity: str, what: str, law: str) -> None:
    off, least = _Off(), TEETH["float64"]["teeth"][quantity]
    for times, noticed in ((2.0, True), (0.5, False)):
        setattr(off, what, times * least)
        assert (obeys(law_named(f"test_agreement:{law}"), off, examples=0) is not None) == noticed


COVERAGE = json.loads((RESULTS / "law_coverage.json").read_text(encoding="utf-8"))


def test_lines_that_run_are_logged_and_no_others() -> None:
    with Log() as log:
        l2(np.zeros((2, 2, 3)), np.ones((2, 2, 3)))
    of = {name: {n for n, function, _ in code_lines("losses.py") if function == name} for name in ("l2", "l1")}
    # the line that a mask would take is not among them
    assert log.lines["losses.py"] & of["l2"]
    assert not log.lines["losses.py"] & of["l1"]


def test_arguments_of_what_is_drawn_are_logged() -> None:
    log, scene = Log(), golden_scene()
    Logged(OracleAdapter(), log).render(scene)
    assert log.ranges["Gaussians"] == (len(scene.gaussians),) * 2
    assert log.ranges["width, px"] == (scene.camera.width,) * 2
    assert log.ranges["opacity"] == (scene.gaussians.opacities.min(), scene.gaussians.opacities.max())
    assert log.choices["antialiased"] == {str(scene.antialiased)}


def test_what_is_asked_by_pairs_of_arguments_is_logged() -> None:
    log, backend = Log(), OracleAdapter()
    row = covering_rows(accepted(backend).levels)[0]
    call = call_of(Logged(backend, log), row, 0)
    Logged(backend, log).call(call)
    assert log.ranges["cameras"] == (len(call.frames[0]),) * 2
    # whom nobody wraps is asked the same
    assert call_of(backend, row, 0) == call


def test_every_line_that_no_law_reaches_refuses_arguments_or_has_a_reason() -> None:
    assert set(COVERAGE["modules"]) == {f"{name}.py" for name in MODULES if (PACKAGE / f"{name}.py").exists()}
    for file, found in COVERAGE["modules"].items():
        for function, text in found["unreached"]:
            refuses = text.startswith(("raise ", 'f"'))
            assert refuses or reason(file, function), f"{file}: {function}: {text}"
    assert COVERAGE["ranges"].keys() == LIMITS.keys()


NUDGE = 1.0 + 2.0**-10


def public_functions() -> dict[str, Callable[..., Any]]:
    found = {}
    for info in pkgutil.iter_modules(pop_ref.__path__):
        if info.ispkg or info.name.startswith("_"):
            continue
        module = importlib.import_module(f"pop_ref.{info.name}")
        for name, value in vars(module).items():
            if inspect.isfunction(value) and value.__module__ == module.__name__ and not name.startswith("_"):
                found[f"{info.name}.{name}"] = value
    return found


def nudged(value: Any) -> Any:
    """Return a value that is a little wrong: numbers scaled, integers off by one, truths negated, lists cut."""
    if isinstance(value, np.ndarray):
        return _nudged_array(value)
    match value:
        case bool() | np.bool_():
            return not value
        case int() | np.integer():
            return value + 1
        case float() | np.floating():
            return value * NUDGE
        case Rounded():
            return Rounded(value.value * NUDGE, value.error * NUDGE)
        case str():
            return f"not {value}"
        case dict():
            return {key: nudged(each) for key, each in value.items()}
        case tuple():
            each = [nudged(v) for v in value]
            return type(value)(*each) if hasattr(value, "_fields") else tuple(each)
        case list():
            return [nudged(v) for v in value[:-1]]
    if is_dataclass(value) and not isinstance(value, type):
        given = {field.name: getattr(value, field.name) for field in fields(value)}
        can_be_wrong = np.ndarray | float | int | dict | tuple | str
        return replace(value, **{name: nudged(v) for name, v in given.items() if isinstance(v, can_be_wrong)})
    return value


def _nudged_array(array: np.ndarray) -> np.ndarray:
    if array.dtype == bool:
        return ~array
    if array.dtype.kind == "i":
        return array + 1
    # zeros do not scale
    return array * NUDGE if np.any(array) else array + 2.0**-10


def _broken(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def wrong(*args: Any, **kwargs: Any) -> Any:
        value = function(*args, **kwargs)
        if value is not None:
            return nudged(value)
        # it works by changing an argument: a tuple of totals
        for argument in (*args, *kwargs.values()):
            for array in argument if isinstance(argument, tuple) else ():
                if isinstance(array, np.ndarray):
                    array *= NUDGE
        return None

    return wrong


@contextmanager
def broken(function: Callable[..., Any]) -> Iterator[None]:
    """Break a function in every module that holds it, for the duration of a with statement."""
    wrong = _broken(function)
    places = [
        (module, name)
        for module in list(sys.modules.values())
        for name, value in list(getattr(module, "__dict__", {}).items())
        if value is function
    ]
    for module, name in places:
        setattr(module, name, wrong)
    forget()
    try:
        yield
    finally:
        for module, name in places:
            setattr(module, name, function)
        forget()


FUNCTIONS = public_functions()

STEP = "gradients:a_step_along_any_direction_changes_the_image_as_the_gradient_says"
FLOOR_MARGIN = "test_margins.test_d5_is_near_where_alpha_is_next_to_the_floor"
VISIBLE = "density:the_density_statistic_averages_ndc_gradients_over_the_views_that_showed_the_gaussian"
OUTCOME = "thresholds:at_a_depth_tie_the_order_is_one_of_the_two_and_by_index_where_the_tie_is_exact"
IMPORTANCE = "selection:importance_is_weight_indoors_and_weight_a_pixel_for_who_dominates_outdoors"
LINE = "test_losses.test_correction_is_the_inverse_of_the_line_that_numpy_fits_from_photograph_to_render"
SCHEDULE = "density:the_gaussians_change_every_hundred_steps_and_opacities_are_reset_where_that_is_asked_for"
COMMON_MOTION = "few_photographs:corrections_that_move_all_cameras_alike_are_taken_out_and_others_stay"
RATES = "few_photographs:rates_of_exposures_and_cameras_fall_from_step_to_step_and_not_as_one_another"
ADDED_IMPORTANCE = "selection:importance_adds_over_views_and_is_none_where_no_pixel_is_dominated"

# a function and its derivative, either of which breaks the law that one is the transpose of the other
WITH_THEIR_TRANSPOSES = {
    "camera": "camera_center view_dirs means_cam_from_means covars_cam_from_covars",
    "covariance": "rotmats_from_quats covars_from_quats_scales",
    "footprint": "low_pass conics_from_covars2d",
    "harmonics": "sh_basis colors_from_sh",
    "losses": "l1 l2 photometric_3dgs photometric_pop",
    "polarization": "pop_loss",
    "projection": "project_means projection_jacobians project_covars",
    "ssim": "ssim d_ssim",
}
LAWS = {
    **{
        f"{module}.{name}{end}": f"agreement:{name}_vjp_is_the_transpose"
        for module, names in WITH_THEIR_TRANSPOSES.items()
        for name in names.split()
        for end in ("", "_vjp")
    },
    "activations.scales_from_log_scales": "covariance:scales_are_positive_and_one_at_zero",
    "activations.scales_from_log_scales_vjp": "agreement:scales_from_log_scales_vjp_is_the_transpose",
    "activations.opacities_from_logits": "covariance:opposite_logits_give_opacities_that_sum_to_one",
    "activations.opacities_from_logits_vjp": "agreement:opacities_from_logits_vjp_is_the_transpose",
    "activations.unit_quats_from_quats": "covariance:unit_quaternions_have_norm_one_and_forget_a_power_of_two",
    "activations.unit_quats_from_quats_vjp": "agreement:unit_quats_from_quats_vjp_is_the_transpose",
    "alpha.sigma_at_pixel": "alpha:the_exponent_is_half_the_squared_distance_in_the_conics_metric",
    "alpha.sigma_at_pixel_vjp": "alpha:the_exponents_gradient_is_its_exact_change_for_a_quadratic",
    "alpha.falloff": "alpha:the_falloff_is_one_at_the_centre_and_multiplies_over_sums",
    "alpha.falloff_vjp": "alpha:the_falloffs_gradient_is_minus_itself",
    "alpha.alpha_from_sigma": "alpha:alpha_is_the_falloff_times_opacity_between_the_floor_and_the_ceiling",
    "alpha.alpha_from_sigma_vjp": "alpha:alphas_gradient_stops_at_floor_and_ceiling_and_nowhere_else",
    "camera.in_front": "camera:the_near_plane_keeps_what_lies_beyond_it_and_decides_equality_by_profile",
    "compositing.composite": "compositing:weights_and_remaining_light_sum_to_one",
    "compositing.composite_vjp": STEP,
    "density.densifies_at": SCHEDULE,
    "density.resets_at": SCHEDULE,
    "density.blurs_at": "density:the_small_are_cloned_and_the_large_are_split_by_gradient_or_blur",
    "density.zero_statistics": "density:a_densification_adds_clones_and_splits_and_takes_prunes_away",
    "density.blur_set": "density:the_blur_set_dominates_strictly_more_than_its_share_of_pixels",
    "density.accumulate": VISIBLE,
    "density.average_grads": VISIBLE,
    "density.grow_masks": "density:the_small_are_cloned_and_the_large_are_split_by_gradient_or_blur",
    "density.prune_mask": "density:the_faint_are_pruned_and_later_the_far_too_large",
    "density.densify_and_prune": "density:a_densification_adds_clones_and_splits_and_takes_prunes_away",
    "density_rows.rows_from_params": "density:new_gaussians_have_zero_moments",
    "density_rows.clone_rows": "density:clones_are_exact_copies_at_the_end_with_fresh_moments",
    "density_rows.split_rows": "density:a_split_replaces_each_parent_by_two_smaller_children_drawn_from_it",
    "density_rows.prune_rows": "density:survivors_of_pruning_keep_their_order_bits_and_moments",
    "density_rows.reset_opacities": "density:a_reset_lowers_opacities_to_the_ceiling_and_forgets_their_moments_only",
    "dominance.dominant_id": "dominance:the_largest_weight_wins_and_ties_go_to_the_front",
    "dominance.dominant_counts": "dominance:counts_and_empty_pixels_add_up_to_the_image",
    "footprint.compensations": "footprint:antialiasing_keeps_the_energy_of_a_splat",
    "footprint.compensations_vjp": "agreement:compensations_vjp_is_the_transpose",
    "footprint.radii_from_covars2d": "footprint:a_flat_covariance_has_no_conic_and_no_extent",
    "footprint.on_screen": "footprint:a_splat_is_kept_exactly_while_its_extent_overlaps_the_image",
    "optimizer.adam_step": "optimizer:adam_follows_the_scalar_recurrence",
    "optimizer.adam_steps": "optimizer:harmonics_that_wait_do_not_move_and_their_counter_goes_on",
    "optimizer.means_learning_rate": "optimizer:the_position_rate_falls_log_linearly_to_a_hundredth",
    "optimizer.learning_rates": "optimizer:every_other_rate_stays_as_it_is",
    "optimizer.sh_degree_at": "optimizer:a_band_is_added_every_thousand_steps_up_to_the_third",
    "appearance.centred_exposures": "few_photographs:centred_exposures_change_nothing_on_average_and_differ_as_before",
    "refinement.without_common_motion": COMMON_MOTION,
    "appearance.appearance_rates": RATES,
    "appearance.appearance_steps": RATES,
    "pixel.rows_from_splats": "compositing:a_round_splat_on_the_axis_looks_as_the_formula_says",
    "pixel.stops": "compositing:the_stop_itself_ends_a_pixel_where_the_profile_includes_it",
    "pixel.composite_pixel": "compositing:a_round_splat_on_the_axis_looks_as_the_formula_says",
    "pixel.composite_pixel_vjp": STEP,
    "pixel.zero_gradients": STEP,
    "polarization.importance_mask": "losses:a_gaussian_is_important_if_it_dominates_one_pixel",
    "polarization.opacity_entropy": "losses:the_entropy_of_opacities_is_the_mean_of_what_each_leaves_open",
    "polarization.opacity_entropy_vjp": "losses:the_entropy_pulls_every_opacity_to_the_pole_that_it_is_nearer_to",
    "render.render": "compositing:weights_and_remaining_light_sum_to_one",
    "render.render_vjp": STEP,
    "splatting.geometry": "compositing:a_round_splat_on_the_axis_looks_as_the_formula_says",
    "splatting.project": "compositing:a_round_splat_on_the_axis_looks_as_the_formula_says",
    "splatting.project_vjp": STEP,
    "tiles.grid_size": "tiles:the_grid_covers_the_image_and_no_tile_lies_outside",
    "tiles.tile_span": OUTCOME,
    "tiles.tile_rects": "tiles:a_tile_is_listed_exactly_if_it_overlaps_the_open_extent",
    "contributions.contributions": "contributions:weights_and_the_light_that_is_left_cover_the_image",
    "sensitivity.sensitivities": "contributions:one_splat_on_one_pixel_scores_its_opacity_times_its_contrast_squared",
    "fisher.log_det_scores": "contributions:a_score_is_the_logarithm_of_the_determinant",
    "chord.chord_midpoint": "contributions:a_gaussian_is_densest_at_the_midpoint",
    "chord.dominant_points": "contributions:points_lie_on_the_rays_through_their_pixels_and_ahead_of_the_camera",
    "selection.lowest_share": "selection:the_lowest_go_up_to_the_score_at_the_share_of_the_last_index",
    "selection.least_mass": "selection:the_least_mass_goes_with_the_first_that_exceeds_the_share",
    "selection.sample_without_replacement": "selection:a_draw_takes_the_first_arrivals_of_an_exponential_race",
    "taming.budget_at": "selection:the_budget_is_a_parabola_from_the_start_to_the_target",
    "taming.edge_map": "selection:edges_are_eight_times_the_grey_less_its_neighbours_and_the_frame_is_grey",
    "taming.pixel_weights": "selection:pixels_weigh_up_to_fifty_by_error_and_up_to_fifty_by_edge",
    "taming.scaled_to_median": "selection:a_term_is_its_weight_at_the_lower_median_of_what_is_positive",
    "taming.view_score": "selection:a_views_score_is_nine_terms_and_nothing_for_what_it_does_not_show",
    "taming.quotas": "selection:quotas_share_what_the_budget_leaves_and_never_ask_for_less_than_none",
    "mini_splatting.view_importance": IMPORTANCE,
    "mini_splatting.scene_importance": ADDED_IMPORTANCE,
    "mini_splatting.samples_per_view": "selection:views_share_the_points_and_give_no_more_than_their_pixels",
    "mini_splatting.nearest_log_scales": "selection:a_point_is_as_large_as_its_three_neighbours_are_far",
    "tight_tiles.snug_box": "tiles:the_box_touches_the_ellipse_of_what_can_be_seen_on_its_four_sides",
    "tight_tiles.accutile": "tiles:a_tile_is_kept_exactly_if_it_meets_the_ellipse_of_what_can_be_seen",
    "tight_tiles.tight_tile_lists": "tiles:tight_lists_are_parts_of_the_rectangles_in_the_same_order",
    "tiles.listed_pixels": "compositing:a_round_splat_on_the_axis_looks_as_the_formula_says",
    "compositing.background_or_black": "compositing:a_round_splat_on_the_axis_looks_as_the_formula_says",
    "tiles.tile_lists": "tiles:lists_hold_each_splat_once_in_each_tile_of_its_rectangle",
}
TESTS = {
    "optimizer.is_updated": "test_training.test_a_step_that_edits_the_population_moves_nothing_in_inrias_loop",
    "optimizer.update_numbers": "test_training.test_taming_moves_upper_bands_each_16_steps_and_opacities_until_15_000",
    "harmonics.lower_degree": "test_render.test_a_lower_degree_loses_least_where_views_show_it_and_little_elsewhere",
    "taming.taming_scores": "test_methods.test_scores_of_a_population_add_over_views_that_are_rendered_and_weighed",
    "appearance.expose": "test_losses.test_an_exposure_mixes_channels_row_by_row",
    "appearance.color_correct": LINE,
    "appearance.over_background": "test_losses.test_a_photograph_over_another_background_is_as_if_laid_over_it",
    "appearance.background_at": "test_losses.test_the_stream_is_splitmix64_by_its_published_numbers",
    "refinement.rotmat_from_vector": "test_losses.test_a_corrected_camera_is_rigid_and_moves_points_in_its_own_axes",
    "refinement.refined_viewmat": "test_losses.test_a_corrected_camera_is_rigid_and_moves_points_in_its_own_axes",
    "regularizers.depth_samples": "test_losses.test_samples_are_the_points_that_a_camera_shows_where_it_shows_them",
    "regularizers.sparse_depth_loss": "test_losses.test_depth_at_points_is_interpolated_and_compared_inverse",
    "regularizers.mean_activation": "test_losses.test_means_of_activations_are_numpys_and_none_is_zero",
    "ssim.gaussian_window": "test_losses.test_window_is_the_impulse_response_of_scipys_gaussian_filter",
    "magnitudes.in_float32": "test_margins.test_rounded_numbers_inherit_errors_as_their_derivatives_say",
    "magnitudes.frustum_limits": "test_margins.test_values_under_error_analysis_are_those_of_the_stages",
    "margins.extent_margins": "test_margins.test_d2_is_near_for_an_opacity_next_to_the_floor",
    "magnitudes.constant": FLOOR_MARGIN,
    "magnitudes.depths_magnitudes": FLOOR_MARGIN,
    "magnitudes.splat_magnitudes": FLOOR_MARGIN,
    "margins.margins": FLOOR_MARGIN,
    "margins.pixel_margins": FLOOR_MARGIN,
}
LADDER = (
    "training.start",
    "training.train_step",
    "training.look",
    "training.update",
    "training.gaussians_from_params",
    "training.params_vjp",
    "training.objective",
    "training.control",
)
DOCTESTS = (
    *("appearance.expose_vjp", "refinement.rotmat_from_vector_vjp", "refinement.refined_viewmat_vjp"),
    *("regularizers.sparse_depth_loss_vjp", "regularizers.mean_activation_vjp"),
    *("fisher.screen_moments", "fisher.fisher_blocks", "ssim.ssim_map", "ssim.replace_left_out"),
    "depth.expected_depth",
    "depth.expected_depth_vjp",
    "depth.with_depth_channel",
    *("constants.profile_named", "notation.symbol_named", "magnitudes.distance", "magnitudes.colors_magnitudes"),
    *("methods.scripted_steps", "methods.method_settings", "short_training.taken_steps"),
    *("magnitudes.d_ssim_magnitudes", "magnitudes.pixelwise_magnitudes"),
)


# imported while everything is sound: a module that is imported under breakage would keep the broken function
every_law()
OF_THE_ORACLE = {
    name: importlib.import_module(f"tests.oracle.{name}") for name in {t.partition(".")[0] for t in TESTS.values()}
}


def _hold(law: Any) -> None:
    failure = obeys(law, OracleAdapter(), examples=25)
    assert failure is None, failure


def _ladder() -> None:
    for rung, written in zip(ten_losses.ladder(), ten_losses.WRITTEN, strict=True):
        assert rung.n == written.n
        assert abs(rung.loss - written.loss) <= 1e-9 * written.loss


def _doctest(function_name: str) -> None:
    module_name, _, name = function_name.partition(".")
    module = sys.modules[f"pop_ref.{module_name}"]
    runner = doctest.DocTestRunner(verbose=False)
    for example in doctest.DocTestFinder().find(getattr(module, name), name, module, vars(module)):
        runner.run(example, out=lambda text: None)
    assert runner.tries > 0
    assert runner.failures == 0


def _check_of(name: str) -> Callable[[], object]:
    # what is not there is an error here, outside of what is expected to fail
    if name in LAWS:
        return functools.partial(_hold, law_named(f"test_{LAWS[name]}"))
    if name in TESTS:
        module, _, test = TESTS[name].partition(".")
        return getattr(OF_THE_ORACLE[module], test)
    return _ladder if name in LADDER else lambda: _doctest(name)


def test_the_list_is_complete() -> None:
    listed = [*LAWS, *TESTS, *LADDER, *DOCTESTS]
    assert len(listed) == len(set(listed)), "a function is listed twice"
    assert set(listed) == set(FUNCTIONS), f"they differ in {sorted(set(listed) ^ set(FUNCTIONS))}"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_broken_function_is_noticed(name: str) -> None:
    check = _check_of(name)
    with broken(FUNCTIONS[name]), pytest.raises(Exception):  # noqa: B017, PT011
        check()
