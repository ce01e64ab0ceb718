"""Rasterizers of the fourth round, written with the laws and the tests unread; see `blind_fourth`."""

from __future__ import annotations

import importlib
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization
from pop_ref.conformance.mutants.unseen_boxes import Breaks, Given, backwards, breaking, telling

_Told = tuple[Any, Any, Any]
_BLOCK: Final = 256  # Gaussians that a launch takes together
_CHUNK: Final = 32  # channels that a pass takes together


def _torch() -> Any:
    return importlib.import_module("torch")


def _one_view(given: Given) -> bool:
    return given["means"].dim() == 2 and given["viewmats"].shape[-3] == 1


def _principal_point_in_whole_pixels(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., :2, 2] = Ks[..., :2, 2].round()
    return {"Ks": Ks}


def _low_pass_factor_is_a_constant(sound: Rasterization, given: Given) -> Any:
    if given["rasterize_mode"] != "antialiased" or not _one_view(given):
        return sound(**given)
    torch, opacities = _torch(), given["opacities"]
    with torch.no_grad():
        of_view = sound(**given | {"packed": False, "absgrad": False})[2]["opacities"].reshape(opacities.shape)
        factors = torch.where(opacities > 0.0, of_view / opacities, torch.zeros_like(of_view))
    return sound(**given | {"rasterize_mode": "classic", "opacities": opacities * factors})


def _absolute_gradient_of_the_sum(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    means2d = meta["means2d"]
    absolute: Any = getattr(means2d, "absgrad", None)

    def tell(gradient: Any) -> None:
        absolute.copy_(gradient.detach().abs())

    if absolute is not None and means2d.requires_grad:
        means2d.register_hook(tell)
    return images, alphas, meta


def _last_block_not_launched(given: Given) -> Given:
    opacities = given["opacities"]
    n = opacities.shape[-1]
    if n <= _BLOCK or n % _BLOCK == 0:
        return {}
    launched = _torch().arange(n, device=opacities.device) < n // _BLOCK * _BLOCK
    return {"opacities": opacities * launched}


def _one_gaussian_stays(given: Given) -> Given:
    if given["means"].shape[-2] != 1:
        return {}
    return {"means": backwards(given["means"], lambda gradient: gradient * 0.0)}


def _backgrounds_of_the_first_scene(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None or behind.dim() < 3:
        return {}
    return {"backgrounds": behind[:1].expand_as(behind)}


def _empty_pixels_are_farthest(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if not given["render_mode"].endswith("ED") or images.numel() == 0:
        return images, alphas, meta
    torch, depth = _torch(), images[..., -1:]
    depth = torch.where(alphas > 0.0, depth, depth.detach().amax())
    return torch.cat((images[..., :-1], depth), -1), alphas, meta


def _tiles_the_other_way(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    meta["tile_width"], meta["tile_height"] = meta["tile_height"], meta["tile_width"]
    return images, alphas, meta


def _far_plane_is_a_sphere(given: Given) -> Given:
    if not _one_view(given):
        return {}
    viewmat = given["viewmats"].detach().reshape(4, 4)
    distances = (given["means"].detach() @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=-1)
    return {"opacities": given["opacities"] * (distances <= given["far_plane"])}


def _intersections_forget_the_camera(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    n = given["means"].shape[-2]
    if not given["packed"] and n > 0:
        meta["flatten_ids"] = meta["flatten_ids"] % n
    return images, alphas, meta


def _blind_cameras_have_no_number(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["packed"]:
        ids = meta["camera_ids"]
        meta["camera_ids"] = _torch().unique(ids, return_inverse=True)[1].to(ids.dtype)
    return images, alphas, meta


def _averaged_over_cameras(given: Given) -> Given:
    n_cameras = given["viewmats"].shape[-3]
    if n_cameras == 1:
        return {}
    shared = {name: given.get(name) for name in ("means", "quats", "scales", "opacities", "covars")}
    return {
        name: backwards(value, lambda gradient: gradient / n_cameras)
        for name, value in shared.items()
        if value is not None
    }


def _opacities_end_at_99(given: Given) -> Given:
    return {"opacities": given["opacities"].clamp_max(0.99)}


def _only_w_made_positive(given: Given) -> Given:
    quats = given["quats"]
    if quats is None:
        return {}
    return {"quats": _torch().cat((quats[..., :1].abs(), quats[..., 1:]), -1)}


def _needles_are_thickened(given: Given) -> Given:
    scales = given["scales"]
    if scales is None:
        return {}
    return {"scales": _torch().maximum(scales, 0.01 * scales.amax(-1, keepdim=True))}


def _harmonics_end_at_white(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["sh_degree"] is None or not given["render_mode"].startswith("RGB"):
        return images, alphas, meta
    return _torch().cat((images[..., :3].clamp_max(1.0), images[..., 3:]), -1), alphas, meta


def _one_radius(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    radii = meta["radii"]
    meta["radii"] = radii.amax(-1, keepdim=True).expand_as(radii).clone()
    return images, alphas, meta


def _whole_chunks_only(given: Given) -> Given:
    colors, behind = given["colors"], given["backgrounds"]
    channels = colors.shape[-1]
    if given["sh_degree"] is not None or channels <= _CHUNK or channels % _CHUNK == 0:
        return {}
    drawn = _torch().arange(channels, device=colors.device) < channels // _CHUNK * _CHUNK
    return {"colors": colors * drawn, "backgrounds": None if behind is None else behind * drawn}


def _packed_backgrounds_stay(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None or not given["packed"]:
        return {}
    return {"backgrounds": backwards(behind, lambda gradient: gradient * 0.0)}


def _canvas_used_again() -> Breaks:
    canvases: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        key = (tuple(images.shape), images.dtype)
        if key in canvases and not canvases[key].is_inference():
            # whoever still holds the picture of the call before sees this one
            canvases[key].copy_(images.data)
        canvases[key] = images.data
        return images, alphas, meta

    return breaks


_BOXES: Final = (
    (
        "principal_point_in_whole_pixels",
        "cx and cy are kept as whole numbers, as a data loader that resizes once did",
        breaking(_principal_point_in_whole_pixels),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "low_pass_factor_is_a_constant",
        "in antialiased calls of one camera the low-pass factor has no gradient by centre and shape",
        _low_pass_factor_is_a_constant,
        "test_agreement:antialiased_gradients_are_the_oracles",
    ),
    (
        "absolute_gradient_of_the_sum",
        "absgrad is the absolute value of the gradient, not the sum of its absolute values over pixels",
        telling(_absolute_gradient_of_the_sum),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "last_block_not_launched",
        "of more than 256 Gaussians those after the last whole block of 256 are not drawn",
        breaking(_last_block_not_launched),
        "test_scale:the_image_of_hundreds_in_a_tile_is_the_oracles",
    ),
    (
        "one_gaussian_stays",
        "the centre of a Gaussian that is the only one has no gradient, as its axis was squeezed away",
        breaking(_one_gaussian_stays),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "backgrounds_of_the_first_scene",
        "every scene of a batch is drawn over the backgrounds of the first",
        breaking(_backgrounds_of_the_first_scene),
        "test_signature_cameras:batch_entries_do_not_know_of_each_other",
    ),
    (
        "empty_pixels_are_farthest",
        "the expected depth of a pixel that shows nothing is the largest of the picture, as in splatfacto",
        telling(_empty_pixels_are_farthest),
        "test_signature_depth:the_expected_depth_is_the_accumulated_one_over_the_opacity",
    ),
    (
        "tiles_the_other_way",
        "meta has tile_width and tile_height the other way round, as seen in pictures that are not square",
        telling(_tiles_the_other_way),
        "test_signature_meta:meta_says_what_was_asked",
    ),
    (
        "far_plane_is_a_sphere",
        "in calls of one camera the far plane culls by the distance from the camera, not by depth",
        breaking(_far_plane_is_a_sphere),
        "test_signature_arguments:the_far_plane_culls_by_depth_and_not_by_distance",
    ),
    (
        "intersections_forget_the_camera",
        "flatten_ids of every camera are those of the first one's rows, where rows are not packed",
        telling(_intersections_forget_the_camera),
        "test_signature_meta:the_tile_lists_that_meta_shows_run_front_to_back_and_hold_who_is_blended",
    ),
    (
        "blind_cameras_have_no_number",
        "in packed mode a camera that sees nothing is not counted, and those after it have a number too low",
        telling(_blind_cameras_have_no_number),
        "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients",
    ),
    (
        "averaged_over_cameras",
        "what several cameras of a call share gets the mean of their gradients, not the sum",
        breaking(_averaged_over_cameras),
        "test_signature_arguments:without_a_background_it_is_black",
    ),
    (
        "opacities_end_at_99",
        "opacities over 0.99 are drawn as 0.99 and learn nothing",
        breaking(_opacities_end_at_99),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "only_w_made_positive",
        "quaternions are given a positive w without turning the other three round",
        breaking(_only_w_made_positive),
        "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes",
    ),
    (
        "needles_are_thickened",
        "no Gaussian is thinner than a hundredth of its length",
        breaking(_needles_are_thickened),
        "test_thresholds:a_needle_shows_one_of_the_oracles_outcomes",
    ),
    (
        "harmonics_end_at_white",
        "pictures from harmonics are clamped at 1, and what is brighter learns nothing",
        telling(_harmonics_end_at_white),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "one_radius",
        "radii along x and y are both the larger one",
        telling(_one_radius),
        "test_signature_cameras:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same",
    ),
    (
        "whole_chunks_only",
        "of more than 32 channels those after the last whole 32 are black",
        breaking(_whole_chunks_only),
        "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike",
    ),
    (
        "packed_backgrounds_stay",
        "backgrounds have no gradient in packed mode",
        breaking(_packed_backgrounds_stay),
        "test_signature_cameras:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same",
    ),
    (
        "canvas_used_again",
        "a call draws onto the picture of the call of the same shape before it, which its holder sees change",
        _canvas_used_again(),
        "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing",
    ),
)

BLIND_FOURTH_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
