"""Black boxes that answer a plain call rightly, and fail where one is packed, larger, empty, strided or forgotten.

Each wraps this program's rasterizer and does what a kernel, an extension or a port once did, or easily does.
"""

from __future__ import annotations

import math
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import (
    BlackBox,
    Breaks,
    Given,
    Rasterization,
    Told,
    accumulated_mode,
    always,
    backwards,
    both,
    breaking,
    deep,
    drawn,
    empty,
    evaluated,
    failing,
    failing_after,
    frozen,
    import_torch,
    packed,
    passing,
    plain,
    read_densely,
    several,
    then,
    unfollowed,
    when,
)

_LAUNCH: Final = "invalid configuration argument"


def _shifted_in_place(sound: Rasterization, given: Given) -> Any:
    answer = sound(**given)
    # from corners of pixels to their centres
    given["Ks"][..., :2, 2].sub_(0.5)
    return answer


def _lens_kept() -> Breaks:
    lenses: dict[tuple[int, ...], Any] = {}

    def change(given: Given) -> Given:
        K = given["Ks"]
        kept = lenses.setdefault((id(K), K.data_ptr(), *K.shape), (K, K.clone()))
        return {"Ks": kept[1]}

    return breaking(change)


def _one_workspace_when_packed() -> Breaks:
    workspace: list[Any] = []

    def change(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
        own = images.detach().abs().sum()
        workspace[:] = [own]
        return backwards(images, lambda v: v * (workspace[0] / own)), alphas, meta

    return then(packed, change)


def _packed_goes_back_once(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    passes: list[None] = []

    def change(v: Any) -> Any:
        passes.append(None)
        return v if len(passes) == 1 else 0.0 * v

    return backwards(images, change), alphas, meta


def _every_image_is_kept() -> Breaks:
    history: list[Any] = []

    def change(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
        history.append(images)
        return images, alphas, meta

    return then(always, change)


def _of_another_type(x: Any) -> Any:
    torch = import_torch()
    return x.to(torch.float32 if x.dtype == torch.float64 else torch.float64)


def _seen(meta: Any) -> bool:
    return bool((meta["radii"] > 0).any())


def _way_back_of_nothing_fails(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    def change(v: Any) -> Any:
        if not _seen(meta):
            raise RuntimeError(_LAUNCH)
        return v

    return backwards(images, change), alphas, meta


def _up_to(count: int, axis: int) -> Breaks:
    """Leave the image black from this number on along an axis, counted from the end."""

    def change(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
        torch = import_torch()
        kept = (torch.arange(images.shape[axis]) < count).to(images).reshape(-1, *[1] * (-axis - 1))
        shown = kept if axis < -1 else torch.ones_like(kept[:1])
        return images * kept, alphas * shown, meta

    return then(always, change)


def _numbered_by_floats(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    return images, alphas, {**meta, "flatten_ids": meta["flatten_ids"].to(images)}


_CONTRACT: Final = "test_autograd:packed_rows_keep_the_contract_too"
_NOTHING: Final = "test_signature_arguments:where_nothing_is_seen_there_is_the_background_whatever_is_asked"
_DRAWN: Final = "test_signature_pairs:every_pair_of_arguments_draws_what_the_oracle_draws"
_STILL: Final = "test_signature_pairs:every_pair_of_arguments_draws_the_same_without_gradients"
_FROZEN: Final = "test_signature_pairs:every_pair_of_arguments_has_the_oracles_gradients_where_means_have_none"
_TYPES: Final = "test_signature_pairs:every_pair_of_arguments_is_answered_in_gsplats_shapes_and_types"
_LONG: Final = "test_whole:a_picture_of_thousands_of_columns_or_rows_is_drawn_to_its_end"

_BOXES: Final[tuple[tuple[str, str, Breaks, str], ...]] = (
    ("packed_means_read_densely", "the packed kernel reads centres one after the other, however they lie",
     passing(read_densely, "means", condition=packed), _CONTRACT),
    ("packed_colours_follow_the_means", "packed colours have gradients only where means have some",
     unfollowed(both(packed, frozen("means")), "colors"), _CONTRACT),
    ("cameras_follow_the_means_where_there_are_several", "with frozen means several cameras have no gradients",
     unfollowed(both(several, frozen("means")), "viewmats"), _FROZEN),
    ("covariances_follow_the_means", "covariances have gradients only where means have some",
     unfollowed(frozen("means"), "covars"), _FROZEN),
    ("packed_workspace_for_all_passes", "what packed rows keep for the way back is that of the last call",
     _one_workspace_when_packed(), _CONTRACT),
    ("packed_rows_go_back_once", "a second way back through packed rows finds its buffers cleared",
     then(packed, _packed_goes_back_once), _CONTRACT),
    ("lenses_read_densely", "intrinsics are read row by row, however they lie (a transposed K has cx for 0)",
     passing(read_densely, "Ks"), "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("lens_kept_with_its_tensor", "intrinsics are kept with their tensor, and a zoom written into it changes nothing",
     _lens_kept(), "test_autograd:tensors_that_have_been_drawn_before_are_drawn_with_the_numbers_that_they_have_now"),
    ("lenses_shifted_in_place", "the principal point of the caller's K is shifted by half a pixel at every call",
     _shifted_in_place, "test_autograd:a_render_leaves_its_arguments_as_they_are"),
    ("covariances_read_densely", "covariances are read one after the other, however they lie",
     passing(read_densely, "covars"), _DRAWN),
    ("plain_colours_read_densely", "plain colours are read one after the other, as harmonics are not",
     passing(read_densely, "colors", condition=plain), _DRAWN),
    ("poses_of_several_cameras_read_densely", "view matrices of several cameras are read one after the other",
     passing(read_densely, "viewmats", condition=several),
     "test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"),
    ("backgrounds_of_several_cameras_read_densely", "backgrounds of several cameras are read one after the other",
     passing(read_densely, "backgrounds", condition=several), _DRAWN),
    ("packed_evaluation_is_black_behind", "without gradients packed rows are drawn over black",
     when(both(evaluated, packed), backgrounds=None), _STILL),
    ("cameras_evaluation_is_black_behind", "without gradients several cameras are drawn over black",
     when(both(evaluated, several), backgrounds=None), _STILL),
    ("evaluation_is_classic", "without gradients antialiasing is left out",
     when(evaluated, rasterize_mode="classic"), _STILL),
    ("evaluation_does_not_divide", "without gradients the expected depth is the accumulated one",
     when(evaluated, render_mode=accumulated_mode), _STILL),
    ("images_of_another_type", "images are of float64 where the Gaussians are of float32, and the other way round",
     drawn(always, lambda given, images, alphas: _of_another_type(images)), _TYPES),
    ("alphas_of_another_type", "alphas are of float64 where the Gaussians are of float32, and the other way round",
     then(always, lambda given, images, alphas, meta: (images, _of_another_type(alphas), meta)), _TYPES),
    ("alphas_without_a_channel", "alphas have no axis of one channel",
     then(always, lambda given, images, alphas, meta: (images, alphas[..., 0], meta)), _TYPES),
    ("rows_numbered_by_floats", "flatten_ids are numbers with a point, and no index",
     then(always, _numbered_by_floats), _TYPES),
    ("nothing_seen_teaches_no_background", "a call that returns early, as it sees nothing, follows no background",
     then(always, lambda given, images, alphas, meta: (images if _seen(meta) else images.detach(), alphas, meta)),
     _NOTHING),
    ("packed_nothing_fails", "a packed call of Gaussians that nobody sees launches a grid of no blocks",
     failing_after(lambda given, alphas, meta: packed(given) and not _seen(meta), _LAUNCH), _NOTHING),
    ("packed_empty_scene_fails", "a packed call without Gaussians ends in an error",
     failing(both(packed, empty), _LAUNCH), _NOTHING),
    ("depth_of_an_empty_scene_fails", "the depth of no Gaussians ends in an error",
     failing(both(deep, empty), _LAUNCH), _NOTHING),
    ("cameras_of_an_empty_scene_fail", "several cameras that look at no Gaussians end in an error",
     failing(both(several, empty), _LAUNCH), _NOTHING),
    ("way_back_of_nothing_fails", "the way back from a picture that shows nothing launches a grid of no blocks",
     then(always, _way_back_of_nothing_fails), _NOTHING),
    ("columns_up_to_2048", "columns from number 2,048 on are not drawn (a texture's width)", _up_to(2048, -2), _LONG),
    ("rows_up_to_2048", "rows from number 2,048 on are not drawn (a texture's height)", _up_to(2048, -3), _LONG),
    ("channels_up_to_128", "channels from number 128 on are black: the largest number that is compiled in",
     _up_to(128, -1), "test_signature_arguments:colours_of_any_number_of_channels_are_drawn_alike"),
    ("colours_end_at_a_hundred", "plain colours are clamped to [-100, 100], where light probes and features go on",
     breaking(lambda given: {"colors": given["colors"].clamp(-100.0, 100.0)} if plain(given) else {}),
     "test_signature_arguments:plain_colours_are_drawn_as_they_are"),
    ("no_far_plane_is_no_number", "depth is kept as a share of far_plane, and of an infinite one it is no number",
     breaking(lambda given: {"opacities": given["opacities"] * math.nan} if math.isinf(given["far_plane"]) else {}),
     "test_signature_arguments:the_near_and_the_far_plane_are_where_the_call_says"),
    ("every_image_is_kept", "a list for messages holds the image of every call, and memory fills",
     _every_image_is_kept(), "test_autograd:a_render_that_nobody_holds_any_more_gives_its_memory_back"),
)  # fmt: skip

CALLS: Final = tuple(BlackBox(*line) for line in _BOXES)
