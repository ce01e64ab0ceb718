"""Sixty mutants after bugs of public rasterizers and trainers, tried before anybody changed a law for them.

`docs/kit.md` says how many were killed by the laws that there were. Some are lines of the program, others stand behind
gsplat's signature.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import torch

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization
from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant

Given = dict[str, Any]

_LINES: Final = (
    (
        "entry_forgotten_in_camera_ids",
        "packed rows of the second batch entry name cameras that do not exist (packed batches, gsplat PR#695)",
        "api/frame.py",
        '"camera_ids": image % n_cameras',
        '"camera_ids": image',
        "",
    ),
    (
        "expected_depth_of_one_in_a_hundred",
        "expected depth divides by an alpha of at least 0.01 (strands-robots#2322 divides by a guarded alpha)",
        "api/frame.py",
        "clamp_min(1e-10)",
        "clamp_min(1e-2)",
        "",
    ),
    (
        "expected_depth_with_constant_alpha",
        "expected depth is differentiated as if alpha were a constant",
        "api/frame.py",
        "blend.alphas[..., None].clamp_min",
        "blend.alphas.detach()[..., None].clamp_min",
        "",
    ),
    (
        "depth_behind_is_one",
        "behind everything lies a depth of 1 (nerfstudio PR#2824: depth of pixels that are not saturated)",
        "api/frame.py",
        "flat.new_zeros((len(images), 1))",
        "flat.new_ones((len(images), 1))",
        "",
    ),
    (
        "final_light_is_alpha",
        "meta calls alpha the light that is left",
        "api/frame.py",
        '1.0 - alphas.detach()[..., 0]',
        'alphas.detach()[..., 0]',
        "",
    ),
    (
        "entries_of_the_second_image_begin_anew",
        "flatten_ids count rows from each image's first",
        "api/meta.py",
        "(found.ids + row)",
        "found.ids",
        "",
    ),
    (
        "who_stands_at_the_far_plane_is_culled",
        "who lies exactly at the far plane is culled",
        "stages/projection.py",
        "depths <= profile.far_plane",
        "depths < profile.far_plane",
        "",
    ),
    (
        "clamp_along_y_by_x",
        "whether y was clamped is read where x was (project_cov3d_ewa_vjp, gsplat PR#139 and after)",
        "stages/projection.py",
        "1.0 + inside_y.to(z.dtype)",
        "1.0 + inside_x.to(z.dtype)",
        "",
    ),
    (
        "extents_rounded_to_the_nearest",
        "extents are rounded, not rounded up",
        "stages/projection.py",
        "radii = (torch.ceil(reach * torch.sqrt(xx)), torch.ceil(reach * torch.sqrt(yy)))",
        "radii = (torch.round(reach * torch.sqrt(xx)), torch.round(reach * torch.sqrt(yy)))",
        "",
    ),
    (
        "antialiasing_does_not_shape",
        "the antialiasing factor has no gradient by the covariance (missing v_compensation, gsplat PR#177)",
        "stages/splatting.py",
        "v_covars2d = v_covars2d + compensations_vjp(",
        "v_covars2d = v_covars2d + 0.0 * compensations_vjp(",
        "",
    ),
    (
        "depth_in_steps_of_a_thousandth",
        "depths are sorted in steps of 1 / 1024 world units (integer depth keys of web viewers, gsplat.js#48)",
        "stages/tiles.py",
        "_stable_order(depths.contiguous()",
        "_stable_order(depths.mul(1024.0).round().div(1024.0).contiguous()",
        "",
    ),
    (
        "stopping_entry_not_visited",
        "the entry that stops a pixel is not counted as visited",
        "stages/compositing.py",
        "torch.minimum(blend.n_passed + 1, lengths[:, None])",
        "torch.minimum(blend.n_passed, lengths[:, None])",
        "",
    ),
    (
        "absolute_gradients_of_the_last_backward",
        "absolute gradients of a second backward pass replace those of the first, where gradients add up",
        "stages/compositing.py",
        "self.sink.add_(",
        "self.sink.copy_(",
        "",
    ),
    (
        "third_band_does_not_move",
        "directions have no gradient by the third band",
        "stages/harmonics.py",
        "    if degree > 2:\n        g_x",
        "    if degree > 3:\n        g_x",
        "",
    ),
    (
        "masked_mean_over_all",
        "a masked loss is a mean over all pixels (nerfstudio's masks multiply both pictures)",
        "stages/losses.py",
        "n = image.numel() if mask is None else max(int(mask.sum()), 1) * image.shape[2]",
        "n = image.numel()",
        "",
    ),
    (
        "points_at_corners",
        "sparse depth is sampled half a pixel off along x",
        "stages/regularizers.py",
        "(places[:, 0] - 0.5)",
        "(places[:, 0] - 0.0)",
        "",
    ),
    (
        "entropy_of_the_undecided",
        "opacities within a thousandth of 0 and 1 have no entropy's gradient (clamps before a logarithm)",
        "density/control.py",
        "eps=torch.finfo(opacities.dtype).eps",
        "eps=1e-3",
        "",
    ),
    (
        "opacities_move_once_more",
        "opacities stop a step late",
        "train/schedule.py",
        "moved[rules.opacities_stop_iter :, ",
        "moved[rules.opacities_stop_iter + 1 :, ",
        "",
    ),
    (
        "sparse_updates_begin_at_once",
        "higher bands move after the first gradient, not after so many",
        "train/schedule.py",
        "(steps + 1) % rules.sh_rest_every",
        "steps % rules.sh_rest_every",
        "",
    ),
    (
        "opacities_tire_too",
        "where all other rates fall in rounds of refining, that of opacities falls too",
        "train/schedule.py",
        'for name in PARAMETERS if name != "opacities"]',
        "for name in PARAMETERS]",
        "",
    ),
    (
        "means_rate_without_scale",
        "the means' rate does not know the scene's scale (asked about in SuGaR#30)",
        "train/schedule.py",
        '"means": lr.means * scene_scale',
        '"means": lr.means',
        "",
    ),
    (
        "reset_at_the_end",
        "opacities are also reset at the step with which refinement ends (graphdeco's resets at 15,000)",
        "density/control.py",
        "step % self.reset_every == 0 and step < self.refine_stop_iter",
        "step % self.reset_every == 0 and step <= self.refine_stop_iter",
        "",
    ),
    (
        "reset_pause_a_step_longer",
        "the pause after a reset has one step more",
        "density/control.py",
        "step % self.reset_every < self.pause_refine_after_reset",
        "step % self.reset_every <= self.pause_refine_after_reset",
        "",
    ),
    (
        "count_survives_the_window",
        "how often Gaussians were seen is not cleared with the window (SplaTAM's accumulators)",
        "density/rows.py",
        'state["count"].zero_()\n',
        'state["count"].mul_(1.0)\n',
        "",
    ),
    (
        "extents_survive_the_window",
        "the largest extents are not cleared with the window",
        "density/rows.py",
        'state["radii"].zero_()',
        'state["radii"].mul_(1.0)',
        "",
    ),
    (
        "frozen_parameters_thaw",
        "what was not to be trained requires a gradient after an edit (nn.Parameter's default)",
        "density/rows.py",
        "requires_grad=old.requires_grad",
        "requires_grad=True",
        "",
    ),
    (
        "final_prune_by_the_usual_bound",
        "the last pruning takes the threshold of all others",
        "density/control.py",
        "< self.final_prune_opa",
        "< self.prune_opa",
        "",
    ),
    (
        "seen_once_a_step",
        "a Gaussian that two cameras of a step see counts once (the mean of gradients, fvdb-core PR#412)",
        "density/control.py",
        'state["count"].add_(visible.sum(0))',
        'state["count"].add_(visible.any(0))',
        "",
    ),
    (
        "extents_by_width",
        "extents are shares of the width, not of the longer side",
        "density/control.py",
        'max(int(info["width"]), int(info["height"]))\n    if',
        'int(info["width"])\n    if',
        "",
    ),
    (
        "seen_by_all_cameras",
        "the prior over what is seen leaves out what one camera does not see",
        "density/protocol.py",
        'visible_from_radii(info["radii"]).any(0)',
        'visible_from_radii(info["radii"]).all(0)',
        "",
    ),
    (
        "pushed_down_by_all",
        "the opacities of the unimportant are averaged over all Gaussians",
        "stages/polarization.py",
        "other.to(opacities.dtype) / other.sum().clamp_min(1)",
        "other.to(opacities.dtype) / max(len(other), 1)",
        "",
    ),
    (
        "children_along_the_world",
        "children are scaled along the world's axes (scales applied after the rotation)",
        "stages/density.py",
        '(rotmats_from_quats(params["quats"]) @ (scales * normals).unsqueeze(-1)).squeeze(-1)',
        'scales * (rotmats_from_quats(params["quats"]) @ normals.unsqueeze(-1)).squeeze(-1)',
        "",
    ),
    (
        "masked_views_blur_by_all_pixels",
        "of a masked photograph in a batch blur is a share of all pixels",
        "train/batch_stepper.py",
        'info["kept_pixels"] = view.kept_pixels',
        'info["kept_pixels"] = view.width * view.height',
        "",
    ),
    (
        "scale_term_of_logarithms",
        "the term of scales is the mean of their logarithms (gsplat's scale_reg has exp)",
        "train/torch_stepper.py",
        'config.scale_reg * mean_activation(scales_from_log_scales(self._params["scales"]))',
        'config.scale_reg * mean_activation(self._params["scales"])',
        "",
    ),
    (
        "rounds_prune_alike",
        "every round of PUP removes the first one's share",
        "density/pup.py",
        "self.prune_shares[self.adam_restarts.index(context.step)]",
        "self.prune_shares[0]",
        "",
    ),
    (
        "small_views_rounded_down",
        "views for scores are cut, not rounded up, to a quarter",
        "density/passes.py",
        "-(-view.width // divisor), -(-view.height // divisor)",
        "view.width // divisor, view.height // divisor",
        "",
    ),
    (
        "undominated_keep_importance",
        "who dominates no pixel keeps its importance",
        "density/mini_splatting.py",
        "torch.where(dominant_sum > 0, total, 0.0)",
        "total",
        "",
    ),
    (
        "epsilon_of_the_library",
        "Adam has torch's epsilon, 1e-8, not 1e-15",
        "train/model.py",
        "eps=EPS, fused=True",
        "eps=1e-8, fused=True",
        "",
    ),
)


def _given(change: Callable[[Given], Given]) -> Callable[[Rasterization, Given], Any]:
    return lambda sound, given: sound(**given | change(given))


def _told(change: Callable[[Given, Any], dict[str, Any]]) -> Callable[[Rasterization, Given], Any]:
    """Break what meta says."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        meta.update(change(given, meta))
        return images, alphas, meta

    return breaks


def _fails(when: Callable[[Given], bool], words: str) -> Callable[[Rasterization, Given], Any]:
    def breaks(sound: Rasterization, given: Given) -> Any:
        if when(given):
            raise RuntimeError(words)
        return sound(**given)

    return breaks


def _near_by_distance(given: Given) -> Given:
    if given["viewmats"].shape[-3] > 1:
        return {}
    rotation, shift = given["viewmats"].squeeze(-3)[..., :3, :3], given["viewmats"].squeeze(-3)[..., None, :3, 3]
    distance = (given["means"] @ rotation.transpose(-1, -2) + shift).norm(dim=-1)
    return {"near_plane": 0.01, "opacities": given["opacities"] * (distance >= given["near_plane"])}


def _one_principal_point(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., :2, 2] = given["Ks"][..., :1, :2, 2]
    return {"Ks": Ks}


def _translation_constant(given: Given) -> Given:
    viewmats = given["viewmats"]
    column = torch.arange(4) == 3
    return {"viewmats": torch.where(column, viewmats.detach(), viewmats)}


def _background_of_three(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None or behind.shape[-1] <= 3:
        return {}
    return {"backgrounds": torch.cat((behind[..., :3], torch.zeros_like(behind[..., 3:])), -1)}


def _upper_triangle(given: Given) -> Given:
    covars = given["covars"]
    return {} if covars is None else {"covars": covars.triu() + covars.triu(1).transpose(-1, -2)}


def _first_of_sixty_five_thousand(given: Given) -> Given:
    n = given["means"].shape[-2]
    return {"opacities": given["opacities"] * (torch.arange(n) < 65_535)}


def _colors_of_the_first_entry(given: Given) -> Given:
    colors, means = given["colors"], given["means"]
    trailing = 2 if given["sh_degree"] is not None else 1
    # a batch entry's colours of every camera
    if means.dim() < 3 or colors.dim() - trailing - 1 < means.dim() - 1:
        return {}
    return {"colors": colors[:1].expand_as(colors)}


def _seeds(sound: Rasterization, given: Given) -> Any:
    torch.manual_seed(0)
    return sound(**given)


def _grad_mode_left_on(sound: Rasterization, given: Given) -> Any:
    found = sound(**given)
    torch.set_grad_enabled(True)
    return found


def _detached_for(name: str) -> Callable[[Given], Given]:
    return lambda given: {} if given[name] is None else {name: given[name].detach()}


def _swapped_conics(given: Given, meta: Any) -> dict[str, Any]:
    return {"conics": meta["conics"][..., [2, 1, 0]]}


def _portrait(given: Given, meta: Any) -> dict[str, Any]:
    if given["height"] <= given["width"]:
        return {}
    return {"tile_width": meta["tile_height"], "tile_height": meta["tile_width"]}


def _distances(given: Given, meta: Any) -> dict[str, Any]:
    return {"depths": meta["depths"] * (1.0 + 1e-3)}


def _alphas_under_one(sound: Rasterization, given: Given) -> Any:
    images, alphas, meta = sound(**given)
    return images, alphas.clamp_max(0.999), meta


_BOXES: Final = (
    (
        "background_without_gradient",
        "a learned background does not learn",
        _given(_detached_for("backgrounds")),
        "",
    ),
    ("covariances_by_their_upper_triangle", "the gradient of covars lies above the diagonal alone (gsplat's triu)",
     _given(_upper_triangle), ""),
    ("low_pass_of_covariances_fixed", "eps2d is not read where covars are given",
     _given(lambda given: {} if given["covars"] is None else {"eps2d": 0.3}), ""),
    ("near_plane_is_a_sphere", "the near plane culls by distance (splatviz, Inria's in_frustum variants)",
     _given(_near_by_distance), ""),
    ("colours_of_the_first_entry", "colours of each camera are taken from the first batch entry (gsplat#623)",
     _given(_colors_of_the_first_entry), ""),
    ("extents_of_the_longer_axis", "both extents are told as the larger one (gsplat before 1.5)",
     _told(lambda given, meta: {"radii": meta["radii"].amax(-1, keepdim=True).expand_as(meta["radii"])}), ""),
    ("depths_a_thousandth_off", "meta's depths are distances near the axis", _told(_distances), ""),
    ("conics_turned", "meta's conics are told (yy, xy, xx)", _told(_swapped_conics), ""),
    ("tiles_of_portraits", "columns and rows of tiles change places in portraits (Babylon.js PR#17827)",
     _told(_portrait), ""),
    ("tile_size_always_sixteen", "meta's tile_size is 16 whatever was asked for",
     _told(lambda given, meta: {"tile_size": 16}), ""),
    ("alphas_under_one", "alpha is at most 0.999", _alphas_under_one, ""),
    ("translation_does_not_learn", "cameras learn to turn, not to move", _given(_translation_constant), ""),
    ("one_principal_point", "all cameras have the first one's principal point", _given(_one_principal_point), ""),
    ("seven_channels_fail", "six and seven channels are not among the kernels' (gsplat's Unsupported number of channels)",
     _fails(lambda given: given["sh_degree"] is None and given["colors"].shape[-1] in (6, 7),
            "Unsupported number of channels"), ""),
    ("background_of_three_channels", "only three channels have a background", _given(_background_of_three), ""),
    ("one_row_fails", "a picture of one row or one column ends in an error",
     _fails(lambda given: min(given["width"], given["height"]) == 1, "invalid configuration argument"), ""),
    ("sixty_five_thousand_drawn", "what comes after the first 65,535 Gaussians is not drawn (16-bit indices)",
     _given(_first_of_sixty_five_thousand), ""),
    ("thin_made_thicker", "standard deviations are at least 0.001 (clamps of splatfacto's exporters)",
     _given(lambda given: {} if given["scales"] is None else {"scales": given["scales"].clamp_min(1e-3)}), ""),
    ("opacities_at_most_ninety_nine", "opacities over 0.99 are drawn as 0.99",
     _given(lambda given: {"opacities": given["opacities"].clamp_max(0.99)}), ""),
    ("random_numbers_begin_anew", "a call seeds torch's generator", _seeds, ""),
    ("gradients_switched_on", "a call under no_grad leaves gradients switched on", _grad_mode_left_on, ""),
    ("inference_fails", "a call in inference mode ends in an error",
     _fails(lambda given: torch.is_inference_mode_enabled(), "Inference tensors cannot be saved for backward"), ""),
)  # fmt: skip

NEWCOMERS: Final = tuple(Mutant(*line, package=PACKAGE) for line in _LINES)
NEWCOMERS_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
