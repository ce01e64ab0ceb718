"""Rasterizers of the second round, written with the laws and the tests unread; see `blind_second`."""

from __future__ import annotations

import importlib
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization
from pop_ref.conformance.mutants.unseen_boxes import Breaks, Given, backwards, breaking, meta_telling, telling

_Told = tuple[Any, Any, Any]


def _torch() -> Any:
    return importlib.import_module("torch")


def _sums_pile_up() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        if given["absgrad"]:
            sums = meta["means2d"].absgrad
            key = (sums.shape, sums.dtype)
            if key in kept:
                sums.add_(kept[key])
            kept[key] = sums
        return images, alphas, meta

    return breaks


def _one_picture() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        if images.requires_grad:
            return images, alphas, meta
        buffer = kept.setdefault((images.shape, images.dtype), images)
        return buffer.copy_(images), alphas, meta

    return breaks


def _unused_bands_learn(given: Given) -> Given:
    if given["sh_degree"] is None:
        return {}
    used = (given["sh_degree"] + 1) ** 2

    def change(gradient: Any) -> Any:
        gradient = gradient.clone()
        gradient[..., used:, :] = gradient[..., :1, :]
        return gradient

    return {"colors": backwards(given["colors"], change)}


def _square_part(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    width = given["width"]
    keep = (_torch().arange(given["height"], device=images.device) < width)[:, None, None]
    return images * keep, alphas * keep, meta


def _factor_learns_nothing(sound: Rasterization, given: Given) -> Any:
    if given["rasterize_mode"] != "antialiased" or not given["opacities"].requires_grad:
        return sound(**given)
    opacities = given["opacities"]
    plain = {name: v.detach() if isinstance(v, _torch().Tensor) else v for name, v in given.items()}
    images, alphas, meta = sound(**given | {"opacities": opacities.detach()})
    more, covered, _ = sound(**plain | {"opacities": opacities, "rasterize_mode": "classic"})
    return images + (more - more.detach()), alphas + (covered - covered.detach()), meta


def _last_row_learns(given: Given) -> Given:
    def change(gradient: Any) -> Any:
        gradient = gradient.clone()
        gradient[..., 3, :] = gradient[..., :3, :].sum(-2)
        return gradient

    return {"viewmats": backwards(given["viewmats"], change)}


def _sums_of_the_first_camera(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["absgrad"] and not given["packed"]:
        sums = meta["means2d"].absgrad
        meta["means2d"].absgrad = sums.narrow(-3, 0, 1).expand_as(sums)
    return images, alphas, meta


def _near_by_distance(given: Given) -> Given:
    if given["viewmats"].shape[-3] > 1 or not given["near_plane"] > 0.0:
        return {}
    R, t = given["viewmats"][..., :3, :3], given["viewmats"][..., None, :3, 3]
    distances = (given["means"][..., None, :, :] @ R.transpose(-1, -2) + t).norm(dim=-1).squeeze(-2).detach()
    far_enough = distances >= given["near_plane"]
    return {"near_plane": 1e-6 * given["near_plane"], "opacities": given["opacities"] * far_enough}


def _four_are_rgba(given: Given) -> Given:
    colors = given["colors"]
    if given["sh_degree"] is not None or colors.shape[-1] != 4:
        return {}
    return {"colors": _torch().cat((colors[..., :3] * colors[..., 3:], colors[..., 3:]), -1)}


def _empty_tiles_black(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["backgrounds"] is None:
        return images, alphas, meta
    size, (height, width) = given["tile_size"], alphas.shape[-3:-1]
    rows, columns = -(-height // size), -(-width // size)
    padded = alphas.new_zeros((*alphas.shape[:-3], rows * size, columns * size))
    padded[..., :height, :width] = alphas.detach()[..., 0]
    drawn = (padded.reshape(*padded.shape[:-2], rows, size, columns, size) > 0.0).any(-1).any(-2)
    here = drawn.repeat_interleave(size, -2).repeat_interleave(size, -1)[..., :height, :width, None]
    return images * here, alphas, meta


def _centre_inside(given: Given) -> Given:
    Ks = given["Ks"].clone()
    Ks[..., 0, 2].clamp_(0.0, given["width"])
    Ks[..., 1, 2].clamp_(0.0, given["height"])
    return {"Ks": Ks}


def _inference_fails(sound: Rasterization, given: Given) -> Any:
    if _torch().is_inference_mode_enabled():
        raise RuntimeError("Inference tensors cannot be saved for backward")
    return sound(**given)


def _colours_divided(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["render_mode"] != "RGB+ED":
        return images, alphas, meta
    return _torch().cat((images[..., :-1] / alphas.clamp_min(1e-10), images[..., -1:]), -1), alphas, meta


def _absolute_learns(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if given["absgrad"] and meta["means2d"].requires_grad:
        meta["means2d"].register_hook(lambda gradient: gradient.abs())
    return images, alphas, meta


def _sides_exchanged(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    meta["width"], meta["height"] = given["height"], given["width"]
    return images, alphas, meta


def _all_are_cameras(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    meta["n_cameras"] = given["viewmats"][..., 0, 0].numel()
    return images, alphas, meta


_BOXES: Final = (
    (
        "absolute_gradients_pile_up",
        "sums of absolute gradients go on from call to call: a buffer that nobody clears",
        _sums_pile_up(),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "unused_bands_learn",
        "bands beyond sh_degree have the first band's gradient, where memory is not cleared",
        breaking(_unused_bands_learn),
        "test_gradients:gradients_ignore_the_coefficients_of_other_bands",
    ),
    (
        "portraits_are_cut_square",
        "rows below the width are not drawn: the grid has the width along both axes",
        telling(_square_part),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "factor_not_in_the_gradient",
        "antialiased opacities have the gradient of classic ones",
        _factor_learns_nothing,
        "test_agreement:antialiased_gradients_are_the_oracles",
    ),
    (
        "low_pass_of_zero_is_the_default",
        "eps2d=0 counts as not given",
        breaking(lambda given: {"eps2d": given["eps2d"] or 0.3}),
        "test_signature_arguments:the_low_pass_is_as_wide_as_the_call_says",
    ),
    (
        "near_plane_of_zero_is_the_default",
        "near_plane=0 counts as not given",
        breaking(lambda given: {"near_plane": given["near_plane"] or 0.01}),
        "test_signature_arguments:a_centre_on_the_far_plane_is_drawn_and_one_on_the_near_plane_as_the_profile_says",
    ),
    (
        "last_row_learns",
        "the constant last row of a view matrix has a gradient",
        breaking(_last_row_learns),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "pictures_share_a_buffer",
        "without gradients every picture of a size is written over the one before",
        _one_picture(),
        "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing",
    ),
    (
        "culled_rows_keep_an_extent",
        "unpacked rows of what is culled have radii of 1, and count as visible",
        meta_telling(radii=lambda given, r: r if given["packed"] else r.clamp_min(1)),
        "test_signature_meta:the_splats_that_meta_shows_are_the_oracles",
    ),
    (
        "absolute_gradients_of_the_first_camera",
        "all cameras have the first one's sums of absolute gradients",
        telling(_sums_of_the_first_camera),
        "test_signature_arguments:without_a_background_it_is_black",
    ),
    (
        "near_by_distance",
        "the near plane is a sphere",
        breaking(_near_by_distance),
        "test_agreement:the_image_that_training_draws_is_one_of_the_oracles_outcomes",
    ),
    (
        "four_channels_are_rgba",
        "of four channels the last one is taken for the opacity of the colour",
        breaking(_four_are_rgba),
        "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike",
    ),
    (
        "empty_tiles_stay_black",
        "tiles that nothing reaches have no background",
        telling(_empty_tiles_black),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "low_pass_ignored_with_covariances",
        "eps2d is lost where covariances are given",
        breaking(lambda given: {} if given["covars"] is None else {"eps2d": 0.3}),
        "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws",
    ),
    (
        "principal_point_inside",
        "a principal point outside the picture is moved to its edge (crops of larger pictures)",
        breaking(_centre_inside),
        "test_agreement:the_antialiased_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "inference_mode_fails",
        "under torch.inference_mode a call ends in an error, as something is saved for the backward pass",
        _inference_fails,
        "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing",
    ),
    (
        "colours_divided_like_depth",
        "beside the expected depth colours are divided by the opacity, too",
        telling(_colours_divided),
        "test_signature_depth:the_expected_depth_is_the_accumulated_one_over_the_opacity",
    ),
    (
        "means_learn_absolutely",
        "with absgrad the gradient itself loses its sign, and centres move by it",
        telling(_absolute_learns),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "sides_told_exchanged",
        "meta has the height as width",
        telling(_sides_exchanged),
        "test_signature_meta:meta_says_what_was_asked",
    ),
    (
        "cameras_told_are_images",
        "n_cameras of a batch is the number of all its images",
        telling(_all_are_cameras),
        "test_signature_pairs:every_pair_of_arguments_lists_tiles_front_to_back",
    ),
)

BLIND_SECOND_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
