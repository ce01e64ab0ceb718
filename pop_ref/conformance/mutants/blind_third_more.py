"""More of the third round, written after its survivors were known and a few laws had been read; see `blind_third`."""

from __future__ import annotations

import importlib
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization
from pop_ref.conformance.mutants.copies import PROGRAM as PACKAGE
from pop_ref.conformance.mutants.copies import Mutant
from pop_ref.conformance.mutants.unseen_boxes import Given, breaking, telling

_Told = tuple[Any, Any, Any]

_ORACLE: Final = (
    (
        "corrected_in_the_world",
        "a correction moves the world before the camera, not the camera",
        "refinement.py",
        "return motion @ viewmat",
        "return viewmat @ motion",
        "test_agreement:refined_viewmat_is_the_oracles",
    ),
    (
        "the_threshold_stays",
        "what has exactly the threshold's score is not removed",
        "selection.py",
        "return scores <= ascending[int(share * (len(ascending) - 1))]",
        "return scores < ascending[int(share * (len(ascending) - 1))]",
        "test_selection:the_lowest_go_up_to_the_score_at_the_share_of_the_last_index",
    ),
    (
        "hidden_score_too",
        "what a view does not show scores by the terms that run over all",
        "taming.py",
        "return np.where(visible, VIEW * photometric * terms, 0.0)",
        "return VIEW * photometric * terms",
        "test_strategies:a_training_by_taming_is_the_oracles_at_every_step",
    ),
    (
        "rays_from_the_given_point",
        "rays go through the principal point that is given, where the profile has it centred",
        "chord.py",
        'if profile.principal_point == "centred":',
        'if profile.principal_point == "given":',
        "test_chord:where_the_profile_centres_the_principal_point_rays_pass_about_the_middle_of_the_picture",
    ),
    (
        "appearance_a_step_ahead",
        "the rates of exposures and cameras are those of the next step",
        "appearance.py",
        "share = step / max_steps",
        "share = (step + 1) / max_steps",
        "test_few_photographs:rates_of_exposures_and_cameras_fall_from_step_to_step_and_not_as_one_another",
    ),
    (
        "hidden_are_pushed_down",
        "the prior over what is visible pushes down what is hidden, too",
        "polarization.py",
        "mask & taking_part, ~mask & taking_part",
        "mask & taking_part, ~mask",
        "test_polarization:restricting_the_prior_to_the_visible_is_the_prior_of_the_visible",
    ),
)

_PROGRAM: Final = (
    (
        "first_share_again",
        "every round of PUP prunes the first round's share",
        "density/methods.py",
        "self.prune_shares[self.adam_restarts.index(context.step)]",
        "self.prune_shares[0]",
        "test_strategies:a_training_by_pup_is_the_oracles_at_every_step",
    ),
    (
        "points_from_masked_pixels",
        "Mini-Splatting draws points from pixels that the mask leaves out",
        "density/methods.py",
        "shown = ids >= 0 if mask is None else (ids >= 0) & mask.to(ids.device)",
        "shown = ids >= 0",
        "test_strategies:a_training_by_mini_splatting_is_the_oracles_at_every_step",
    ),
)


def _torch() -> Any:
    return importlib.import_module("torch")


def _no_tile_fits(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    size = given["tile_size"] or 16
    if given["width"] >= size and given["height"] >= size:
        return images, alphas, meta
    return images * 0.0, alphas * 0.0, meta


def _last_camera_teaches(given: Given) -> Given:
    torch, colors, batch = _torch(), given["colors"], given["means"].dim() - 2
    shared = colors.dim() == batch + 2 + (given["sh_degree"] is not None)
    cameras = given["viewmats"].shape[-3]
    if not shared or cameras < 2:
        return {}
    return {"colors": torch.stack([colors.detach()] * (cameras - 1) + [colors], batch)}


def _as_stored(value: Any) -> Any:
    strides, step = [], 1
    for size in reversed(value.shape):
        strides.insert(0, step)
        step *= size
    if value.is_contiguous() or value.untyped_storage().nbytes() < value.numel() * value.element_size():
        return value
    return value.as_strided(value.shape, strides, 0)


def _rows_as_stored(given: Given) -> Given:
    return {name: _as_stored(given[name]) for name in ("means", "opacities", "colors")}


def _cameras_as_stored(given: Given) -> Given:
    return {name: _as_stored(given[name]) for name in ("viewmats", "Ks")}


def _normalized_in_place(sound: Rasterization, given: Given) -> Any:
    torch, found = _torch(), sound(**given)
    if given["quats"] is not None:
        with torch.no_grad():
            given["quats"].data.div_(given["quats"].data.norm(dim=-1, keepdim=True))
    return found


def _seeds_anew(sound: Rasterization, given: Given) -> Any:
    _torch().manual_seed(0)
    return sound(**given)


def _tiles_of_16_bits(given: Given, images: Any, alphas: Any, meta: Any) -> _Told:
    torch, size = _torch(), given["tile_size"] or 16
    x, y = torch.arange(given["width"]) // size, torch.arange(given["height"]) // size
    there = (y[:, None] * -(-given["width"] // size) + x < 2**15)[..., None].to(images.device)
    return images * there, alphas * there, meta


def _rows_of_16_bits(given: Given) -> Given:
    opacities = given["opacities"]
    return {"opacities": opacities * (_torch().arange(opacities.shape[-1], device=opacities.device) < 2**16)}


_BOXES: Final = (
    (
        "no_tile_fits",
        "pictures smaller than a tile stay empty",
        telling(_no_tile_fits),
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
    ),
    (
        "last_camera_teaches",
        "shared colours learn from the last camera only",
        breaking(_last_camera_teaches),
        "test_signature_arguments:without_a_background_it_is_black",
    ),
    (
        "rows_as_stored",
        "strides of centres, opacities and colours are ignored",
        breaking(_rows_as_stored),
        "test_autograd:how_arguments_lie_in_memory_changes_no_gradient",
    ),
    (
        "cameras_as_stored",
        "strides of view matrices and intrinsics are ignored",
        breaking(_cameras_as_stored),
        "test_autograd:how_arguments_lie_in_memory_changes_no_gradient",
    ),
    (
        "normalized_in_place",
        "the caller's quaternions are normalised in place",
        _normalized_in_place,
        "test_agreement:gradients_are_the_oracles",
    ),
    (
        "seeds_anew",
        "every call seeds torch's generator",
        _seeds_anew,
        "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing",
    ),
    (
        "tiles_of_16_bits",
        "tiles from number 32768 on stay empty",
        telling(_tiles_of_16_bits),
        "test_whole:tiles_of_a_number_beyond_16_bits_are_drawn",
    ),
    (
        "rows_of_16_bits",
        "Gaussians from number 65536 on are not drawn",
        breaking(_rows_of_16_bits),
        "test_scale:the_image_of_seventy_thousand_is_the_oracles",
    ),
)

BLIND_THIRD_MORE: Final = tuple(Mutant(*line) for line in _ORACLE)
BLIND_THIRD_MORE_PROGRAM: Final = tuple(Mutant(*line, package=PACKAGE) for line in _PROGRAM)
BLIND_THIRD_MORE_BOXES: Final = tuple(BlackBox(*box) for box in _BOXES)
