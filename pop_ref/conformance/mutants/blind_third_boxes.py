"""Rasterizers of the third round, written with the laws and the tests unread; see `blind_third`."""

from __future__ import annotations

import importlib
import math
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization
from pop_ref.conformance.mutants.unseen_boxes import Breaks, Given, backwards, breaking, telling

_Told = tuple[Any, Any, Any]
_SH_C0: Final = 0.28209479177387814


def _torch() -> Any:
    return importlib.import_module("torch")


def _per_camera(given: Given) -> bool:
    plain = 1 + (given["sh_degree"] is not None)
    return given["colors"].dim() == given["means"].dim() - 1 + 1 + plain


def _rows_for_cameras(given: Given) -> Given:
    colors = given["colors"]
    batch = given["means"].dim() - 2
    if not _per_camera(given) or colors.shape[batch] != colors.shape[batch + 1]:
        return {}
    return {"colors": colors.transpose(batch, batch + 1)}


def _intrinsics_by_column(given: Given) -> Given:
    Ks = given["Ks"]
    if Ks.dim() != 4:
        return {}
    return {"Ks": Ks.transpose(0, 1).reshape(Ks.shape)}


def _degree_zero_unclamped(given: Given) -> Given:
    if given["sh_degree"] != 0:
        return {}
    return {"sh_degree": None, "colors": 0.5 + _SH_C0 * given["colors"][..., 0, :]}


def _alpha_still_beside_background(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    return images, alphas if given["backgrounds"] is None else alphas.detach(), meta


def _directions_are_constants(sound: Rasterization, given: Given) -> Any:
    degree = given["sh_degree"]
    if degree is None or degree == 0 or not given["means"].requires_grad:
        return sound(**given)
    harmonics = importlib.import_module("pop_fast.stages.harmonics")
    means, colors, viewmats = given["means"].detach(), given["colors"], given["viewmats"]
    n, cameras = means.shape[-2], viewmats.shape[-3]
    if n == 0:
        return sound(**given)
    batch = means.dim() - 2
    if not _per_camera(given):
        shape = colors.shape
        colors = colors.unsqueeze(batch).expand(*shape[:batch], cameras, *shape[batch:])
    eyes = -(viewmats[..., :3, :3].transpose(-1, -2) @ viewmats[..., :3, 3:])[..., 0]
    dirs = means[..., None, :, :] - eyes[..., :, None, :]
    flat = harmonics.colors_from_sh(colors.reshape(-1, *colors.shape[-2:]), dirs.reshape(-1, 3), degree)
    return sound(**given | {"sh_degree": None, "colors": flat.reshape(*colors.shape[:-2], 3)})


def _lengths_stretch(given: Given) -> Given:
    if given.get("covars") is not None or given["quats"] is None:
        return {}
    return {"scales": given["scales"] * (given["quats"] ** 2).sum(-1, keepdim=True)}


def _upper_half_learns(given: Given) -> Given:
    if given.get("covars") is None:
        return {}
    return {"covars": backwards(given["covars"], lambda gradient: gradient.triu())}


def _counted_over_cameras(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    if "dominant_counts" in meta:
        counts = meta["dominant_counts"]
        meta["dominant_counts"] = counts.sum(-2, keepdim=True).expand(counts.shape).clone()
    return images, alphas, meta


def _factor_of_the_default(given: Given) -> Given:
    return {"eps2d": 0.3} if given["rasterize_mode"] == "antialiased" else {}


def _expected_over_a_constant(sound: Rasterization, given: Given) -> Any:
    if not given["render_mode"].endswith("ED"):
        return sound(**given)
    torch = _torch()
    images, alphas, meta = sound(**given | {"render_mode": given["render_mode"].replace("ED", "D")})
    depth = images[..., -1:] / alphas.detach().clamp_min(1e-10)
    return torch.cat((images[..., :-1], depth), -1), alphas, meta


def _nothing_is_black(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    return images if given["means"].shape[-2] else images * 0.0, alphas, meta


def _behind_the_first_chunk(given: Given) -> Given:
    behind = given["backgrounds"]
    if behind is None:
        return {}
    first = _torch().arange(behind.shape[-1], device=behind.device) < given.get("channel_chunk", 32)
    return {"backgrounds": behind * first}


def _all_learn_by_means(given: Given) -> Given:
    if given["means"].requires_grad:
        return {}
    Tensor = _torch().Tensor
    return {name: value.detach() for name, value in given.items() if isinstance(value, Tensor)}


def _every_band(given: Given) -> Given:
    if given["sh_degree"] is None:
        return {}
    return {"sh_degree": math.isqrt(given["colors"].shape[-2]) - 1}


def _kept_intrinsics() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        Ks = given["Ks"]
        key = (given["width"], given["height"], Ks.shape, Ks.dtype)
        return sound(**given | {"Ks": kept.setdefault(key, Ks.detach().clone())})

    return breaks


_BOXES: Final = (
    (
        "rows_for_cameras",
        "colours of each camera are read [N, C] where there are as many cameras as Gaussians",
        breaking(_rows_for_cameras),
        "test_signature_cameras:where_there_are_as_many_gaussians_as_cameras_a_cameras_colours_are_its_own",
    ),
    (
        "intrinsics_by_column",
        "intrinsics of a batch are flattened cameras first",
        breaking(_intrinsics_by_column),
        "test_signature_cameras:batch_entries_do_not_know_of_each_other",
    ),
    (
        "degree_zero_unclamped",
        "harmonics of degree 0 alone are turned into colours by a shortcut without the clamp at 0",
        breaking(_degree_zero_unclamped),
        "test_agreement:antialiased_gradients_are_the_oracles",
    ),
    (
        "alpha_still_beside_background",
        "alphas have no gradient where there is a background",
        telling(_alpha_still_beside_background),
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "directions_are_constants",
        "centres learn nothing through the direction that they are seen from",
        _directions_are_constants,
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "lengths_stretch",
        "quaternions are not normalised, and their length stretches the Gaussian",
        breaking(_lengths_stretch),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "upper_half_learns",
        "the gradient of covariances has an upper half only",
        breaking(_upper_half_learns),
        "test_signature_arguments:covariances_draw_what_their_quaternions_and_scales_draw",
    ),
    (
        "counted_over_cameras",
        "dominant counts are those of all cameras together",
        telling(_counted_over_cameras),
        "test_signature_meta:every_camera_has_dominant_gaussians_and_counts_of_its_own",
    ),
    (
        "factor_of_the_default",
        "antialiased mode has the default low-pass, whatever eps2d says",
        breaking(_factor_of_the_default),
        "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws",
    ),
    (
        "expected_over_a_constant",
        "the expected depth's gradient takes the opacity that it is divided by for a constant",
        _expected_over_a_constant,
        "test_signature_depth:the_expected_depth_is_the_accumulated_one_over_the_opacity",
    ),
    (
        "nothing_is_black",
        "a call without Gaussians returns a black image, whatever is behind",
        telling(_nothing_is_black),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "behind_the_first_chunk",
        "the background lies behind the first chunk of channels only",
        breaking(_behind_the_first_chunk),
        "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike",
    ),
    (
        "all_learn_by_means",
        "nothing has a gradient where the centres need none",
        breaking(_all_learn_by_means),
        "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together",
    ),
    (
        "every_band",
        "all bands that are given are evaluated, whatever the degree",
        breaking(_every_band),
        "test_gradients:gradients_ignore_the_coefficients_of_other_bands",
    ),
    (
        "kept_intrinsics",
        "intrinsics are kept for each size of an image, and those of the first call stay",
        _kept_intrinsics(),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
)

BLIND_THIRD_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
