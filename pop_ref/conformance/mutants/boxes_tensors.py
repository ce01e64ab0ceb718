"""Black boxes at the seams of a sound rasterizer and of sound losses: autograd's contract, memory, size.

Each wraps this program's functions and does what a kernel, an extension or a port once did.
"""

from __future__ import annotations

import importlib
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import (
    BlackBox,
    Breaks,
    Given,
    Rasterization,
    Told,
    always,
    antialiased,
    backwards,
    batched,
    behind,
    both,
    breaking,
    covars,
    deep,
    detached,
    drawn,
    drawn_in_order,
    evaluated,
    expected_depth,
    factor_is_constant,
    failing,
    frozen,
    hidden,
    import_torch,
    in_camera,
    last_channel,
    numbers,
    one_view,
    passing,
    pulled,
    read_densely,
    seen_opacities,
    shown,
    then,
    tile_numbers,
    told,
    unfollowed,
    when,
)

ROWS: Final = ("means", "quats", "scales", "opacities", "colors")
_WORKSPACE: dict[str, Any] = {}
_BLOCK: Final = 256  # Gaussians that a launch takes together

# laws by which many of these die
_ALONE: Final = "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together"
_MEMORY: Final = "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"
_COTANGENTS: Final = "test_autograd:how_cotangents_lie_in_memory_changes_no_gradient"
_NO_GRADIENTS: Final = "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"
_MANY: Final = "test_scale:the_image_of_seventy_thousand_is_the_oracles"
_FAR: Final = "test_scale:the_image_of_far_and_huge_is_the_oracles"
_CAMERAS: Final = "test_signature_arguments:every_camera_has_the_colours_and_harmonics_that_were_given_for_it"
_LARGE: Final = "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"


def _function(forward: Callable[..., Any], backward: Callable[..., Any]) -> Callable[..., Any]:
    """Return an autograd function of these two, which take the context first."""
    body = {"forward": staticmethod(forward), "backward": staticmethod(backward)}
    return type("Broken", (import_torch().autograd.Function,), body).apply


def _copy_going_back(x: Any, backward: Callable[[Any, Any], Any]) -> Any:
    return _function(lambda ctx, x: x.clone(), backward)(x)


def _cotangents_read(read: Callable[[Any], Any]) -> Breaks:
    return drawn(always, lambda given, images, alphas: _copy_going_back(images, lambda ctx, v: read(v)))


def _first_number_alone(v: Any) -> Any:
    if 0 not in v.stride():
        return v
    found = v.new_zeros(v.shape)
    found.view(-1)[0] = v.reshape(-1)[0]
    return found


def _both_read(images: Any, alphas: Any, backward: Callable[[Any, Any, Any], Any]) -> tuple[Any, Any]:
    """Return copies of both; where no loss reads one, the way back has None for its cotangent."""

    def forward(ctx: Any, x: Any, y: Any) -> Any:
        ctx.set_materialize_grads(False)
        return x.clone(), y.clone()

    return _function(forward, backward)(images, alphas)


def _both_cotangents_needed(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    # a kernel is handed the address of nothing
    return *_both_read(images, alphas, lambda ctx, v, w: (v.contiguous(), w.contiguous())), meta


def _alpha_for_a_missing_image(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    # memory that nobody has cleared
    dirty = import_torch().full_like(images, 0.5)
    return *_both_read(images, alphas, lambda ctx, v, w: (dirty if v is None else v, w)), meta


def _drawn_with_gradients(sound: Rasterization, given: Given) -> Any:
    with import_torch().enable_grad():
        return sound(**given)


def _one_workspace(given: Given) -> Any:
    """Go back through what the last forward pass has left, whoever asks."""
    _WORKSPACE["opacities"] = given["opacities"].detach().clone()

    def backward(ctx: Any, v: Any) -> Any:
        found = v.clone()
        found[len(_WORKSPACE["opacities"]) :] = 0.0
        return found

    return _copy_going_back(given["opacities"], backward)


def _freed_after_use(given: Given, images: Any, alphas: Any) -> Any:
    def backward(ctx: Any, v: Any) -> Any:
        ctx.went = getattr(ctx, "went", 0) + 1
        return v if ctx.went == 1 else 0.0 * v

    return _copy_going_back(images, backward)


def _assigned(given: Given) -> Given:
    means = given["means"]
    if means.requires_grad and means.is_leaf:

        def forget(v: Any) -> None:
            means.grad = None

        means.register_hook(forget)
    return {}


def _normalised_in_place(given: Given) -> Given:
    if given["quats"] is not None:
        quats = given["quats"].data
        quats /= quats.norm(dim=-1, keepdim=True)
    return {}


def _clamped_in_place(given: Given) -> Given:
    given["opacities"].data.clamp_(0.3, 0.8)
    return {}


def _read_again(given: Given) -> Any:
    """Read opacities anew in the backward pass, from where they lay in the forward pass."""
    where, then = given["opacities"].detach(), given["opacities"].detach().clone()
    # what follows is saved of a copy, so that torch sees no edit of it
    return _copy_going_back(given["opacities"], lambda ctx, v: v * where / then)


def _output_read_again(given: Given, images: Any, alphas: Any) -> Any:
    kept: dict[str, Any] = {}

    def forward(ctx: Any, x: Any) -> Any:
        out = x.clone()
        kept["out"], kept["then"] = out.detach(), out.detach().clone()
        return out

    def backward(ctx: Any, v: Any) -> Any:
        return v * (kept["out"] == kept["then"])

    return _function(forward, backward)(images)


def _asked_of_all(given: Given) -> Given:
    for name in ("means", "opacities"):
        if given[name].is_leaf and import_torch().is_grad_enabled():
            given[name].requires_grad_(True)
    return {}


def _tiles_up_to_8192(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    """Leave tiles beyond a number empty: their pixels show what is behind."""
    there = tile_numbers(given) < 8192
    background = given["backgrounds"][..., None, None, :] if behind(given) else 0.0
    return *(import_torch().where(there, x, other) for x, other in ((images, background), (alphas, 0.0))), meta


def _below(most: int, given: Given) -> Any:
    return numbers(given["opacities"].shape[-1], given["opacities"]) < most


def _near_the_picture(given: Given) -> Any:
    view, K = given["viewmats"][0].detach(), given["Ks"][0].detach()
    screen = (given["means"].detach() @ view[:3, :3].T + view[:3, 3]) @ K.T
    x, y = screen[:, 0] / screen[:, 2], screen[:, 1] / screen[:, 2]
    return ~((x < -64) | (y < -64) | (x > given["width"] + 64) | (y > given["height"] + 64))


def _depths(given: Given) -> Any:
    return in_camera(given["means"].detach(), given["viewmats"].detach())[0, :, 2]


def _not_huge(given: Given) -> Any:
    return given["scales"].detach().amax(-1) * given["Ks"][0, 0, 0].detach() / _depths(given) <= 300.0


def _steps_of_depth(given: Given, steps: int) -> Any:
    return (_depths(given).clamp(0.0, 520.0) / 520.0 * steps).floor()


@dataclass(frozen=True)
class Loss(BlackBox):
    """Losses that see other pictures than they are given; `breaks` makes of render and target what they see.

    Attributes:
        stages: names of the functions that are broken.
    """

    stages: tuple[str, ...] = ("d_ssim",)

    def adapter(self, dtype: str = "float32") -> Any:
        """Return the program's losses, these broken."""
        from pop_ref.conformance.torch_adapter import TorchAdapter

        losses = importlib.import_module("pop_fast.stages.losses")

        def broken(name: str) -> Callable[..., Any]:
            sound = getattr(losses, name)
            return lambda image, target, *more: sound(*self.breaks(image, target), *more)  # type: ignore[arg-type]

        named = {name: broken(name) for name in self.stages}
        return TorchAdapter(self.name, None, "pop_fast.stages", dtype, stages=named)


def _clamped(picture: Any) -> Any:
    return picture.clamp(0.0, 1.0)


def _whole_blocks(axis: int, side: int) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Leave out what is beyond the last whole block of a picture of two blocks or more."""

    def cut(picture: Any) -> Any:
        n = picture.shape[axis]
        return picture.narrow(axis, 0, n // side * side) if n >= 2 * side else picture

    return lambda image, target: (cut(image), cut(target))


def _seam(picture: Any) -> Any:
    """Repeat the column before the 33rd in its place."""
    if picture.shape[1] <= 33:
        return picture
    return import_torch().cat([picture[:, :32], picture[:, 31:32], picture[:, 33:]], 1)


def _in_units_of_the_range(image: Any, target: Any) -> tuple[Any, Any]:
    span = (target.max() - target.min()).clamp(min=1.0)
    return image / span, target / span


def _three_channels(image: Any, target: Any) -> tuple[Any, Any]:
    return image[..., :3], target[..., :3]


def _strides_unread(means: Any) -> Any:
    numbers_in_memory = means.detach().contiguous().reshape(means.shape[::-1])
    return means if means.is_contiguous() else detached(means, numbers_in_memory.mT.reshape(means.shape))


def _one_picture() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        if images.requires_grad:
            return images, alphas, meta
        buffer = kept.setdefault((images.shape, images.dtype), images)
        return buffer.copy_(images), alphas, meta

    return breaks


def _seeds_anew(sound: Rasterization, given: Given) -> Any:
    import_torch().manual_seed(0)
    return sound(**given)


def _launched(given: Given) -> Any:
    n = given["opacities"].shape[-1]
    return numbers(n, given["opacities"]) < (n // _BLOCK * _BLOCK or n)


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


def _rows_counted_in_a_byte(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    rows = numbers(given["height"], images) % 256
    return images[..., rows, :, :], alphas[..., rows, :, :], meta


def _empty_beyond(most: int) -> Breaks:
    """Draw nothing where splats lie over more tiles, all taken together, than there is room for."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        image, alphas, meta = sound(**given)
        # no splat lies over more tiles than there are
        if meta["radii"].numel() * meta["tile_width"] * meta["tile_height"] <= 2 * most:
            return image, alphas, meta
        fits = int(meta["tiles_per_gauss"].sum()) <= most
        return image * fits, alphas * fits, meta

    return breaks


def _pose_kept_with_its_tensor(viewmats: Any) -> Any:
    kept = getattr(viewmats, "_kept_pose", None)
    if kept is None:
        viewmats._kept_pose = viewmats.detach().clone()
        return viewmats
    return detached(viewmats, kept)


def _factor_has_a_floor(sound: Rasterization, given: Given) -> Any:
    if not antialiased(given) or not one_view(given):
        return sound(**given)
    seen, least = seen_opacities(sound, given), 0.005 * given["opacities"]
    own = import_torch().where(seen < least, least, seen)
    return sound(**given | {"rasterize_mode": "classic", "opacities": own})


def _short_do_not_turn(given: Given) -> Any:
    quats = given["quats"]
    short = quats.detach().norm(dim=-1, keepdim=True) < 1e-6
    return import_torch().where(short, quats.new_tensor((1.0, 0.0, 0.0, 0.0)), quats)


def _one_pose_one_lens(given: Given) -> Any:
    torch, poses, Ks = import_torch(), given["viewmats"].detach().flatten(-2), given["Ks"]
    same = (poses[..., :, None, :] == poses[..., None, :, :]).all(-1)
    C = poses.shape[-2]
    first = torch.where(same, torch.arange(C), C).amin(-1)
    return Ks.gather(-3, first[..., None, None].expand(Ks.shape))


def _ends_at_a_thousand(given: Given, depth: Any, alphas: Any) -> Any:
    cover = alphas.detach()
    most = 1000.0 * (cover if not expected_depth(given) else import_torch().ones_like(cover))
    return import_torch().where(depth > most, most, depth)


def _three_bits_of_cameras(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    there = numbers(given["viewmats"].shape[-3], images) & 7
    return images.index_select(-4, there), alphas.index_select(-4, there), meta


def _first_of_shared_entries(given: Given) -> Given:
    def of_first(v: Any) -> Any:
        return import_torch().cat([v[:1], 0.0 * v[1:]])

    named = {name: given[name] for name in ROWS if batched(given) and given[name] is not None}
    shared = {name: x for name, x in named.items() if x.stride(0) == 0}
    return {name: backwards(x, of_first) for name, x in shared.items()}


def _one_channel_behind_depth(given: Given, images: Any, alphas: Any) -> Any:
    more = given["backgrounds"][..., None, None, :] * (1.0 - alphas)
    return images + (more / alphas.clamp_min(1e-10) if expected_depth(given) else more)


def _isotropic_scales_densely(given: Given) -> Any:
    scales = given["scales"]
    if scales is None or scales.stride(-1) != 0 or scales.numel() == 0:
        return scales
    memory = scales.detach()[..., 0].reshape(-1)
    return detached(scales, memory[numbers(scales.numel(), scales) % len(memory)].reshape(scales.shape))


def _equal_calls_share_a_picture() -> Breaks:
    kept: dict[str, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        torch = import_torch()
        tensors = {name: value for name, value in given.items() if isinstance(value, torch.Tensor)}
        if torch.is_grad_enabled() and any(value.requires_grad for value in tensors.values()):
            return sound(**given)
        others = {name: value for name, value in given.items() if name not in tensors}
        same = kept and others == kept["others"] and tensors.keys() == kept["tensors"].keys()
        if not same or not all(torch.equal(value, kept["tensors"][name]) for name, value in tensors.items()):
            kept["others"], kept["tensors"] = others, {name: value.detach().clone() for name, value in tensors.items()}
            kept["answer"] = sound(**given)
        return kept["answer"]

    return breaks


def _edits_through_data_unseen() -> Breaks:
    kept: list[Any] = []

    def breaks(sound: Rasterization, given: Given) -> Any:
        means = given["means"]
        if means.is_inference():
            return sound(**given)
        if not kept:
            kept.append(importlib.import_module("torch.utils.weak").WeakIdKeyDictionary())
        version, numbers = kept[0].get(means, (None, None))
        if version != means._version:
            numbers = means.detach().clone()
            kept[0][means] = means._version, numbers
        return sound(**given | {"means": detached(means, numbers)})

    return breaks


def _context_of_the_first_thread() -> Breaks:
    owner: list[int] = []

    def breaks(sound: Rasterization, given: Given) -> Any:
        owner.append(threading.get_ident())
        images, alphas, meta = sound(**given)
        here = float(owner[0] == owner[-1])
        return images * here, alphas * here, meta

    return breaks


_BOXES: Final[tuple[tuple[Any, ...], ...]] = (
    ("gradients_if_all_are_asked_for", "unless every array requires a gradient, none has one",
     unfollowed(frozen(*ROWS), *ROWS), _ALONE),
    ("colours_follow_the_means", "colours have gradients only where means have some",
     unfollowed(frozen("means"), "colors"), _ALONE),
    ("cameras_follow_the_means", "a frozen scene gives its camera no gradient (pose refinement after training)",
     unfollowed(frozen("means"), "viewmats"), _ALONE),
    ("backgrounds_follow_the_colours", "a background learned alone has no gradient",
     unfollowed(frozen("colors"), "backgrounds"), _ALONE),
    ("quaternions_follow_the_scales", "with frozen scales quaternions have no gradient: one switch for both",
     unfollowed(frozen("scales"), "quats"),
     "test_autograd:an_argument_without_a_gradient_takes_none_from_the_others"),
    ("opacities_follow_the_colours", "with frozen colours the opacities' gradient lacks what they show",
     unfollowed(frozen("colors"), "opacities"),
     "test_autograd:an_argument_without_a_gradient_takes_none_from_the_others"),
    ("means_read_densely", "a kernel reads means one after the other, however they lie (no contiguous())",
     passing(read_densely, "means"), _MEMORY),
    ("colours_read_densely", "a kernel reads colours one after the other, however they lie",
     passing(read_densely, "colors"), _MEMORY),
    ("opacities_read_densely", "a kernel reads opacities one after the other, however they lie",
     passing(read_densely, "opacities"), _MEMORY),
    ("offset_of_the_storage_ignored", "scales are read from where their storage begins (data_ptr of the storage)",
     passing(lambda x: x.as_strided(x.shape, x.stride(), 0), "scales"), _MEMORY),
    ("cotangents_read_densely", "the backward kernel reads the image's cotangent as if it were dense",
     _cotangents_read(read_densely), _COTANGENTS),
    ("expanded_cotangents_have_one_number", "of a cotangent without memory of its own the first number is read",
     _cotangents_read(_first_number_alone), _COTANGENTS),
    ("both_outputs_must_be_used", "a loss that reads the image alone, or alpha alone, ends in an error (None)",
     then(always, _both_cotangents_needed), "test_autograd:an_output_that_no_loss_reads_adds_nothing"),
    ("memory_for_a_missing_cotangent", "where no loss reads the image its cotangent is whatever lay there",
     then(always, _alpha_for_a_missing_image), "test_autograd:an_output_that_no_loss_reads_adds_nothing"),
    ("no_grad_is_not_heard", "under no_grad the image still follows its arguments, and keeps their memory",
     _drawn_with_gradients, _NO_GRADIENTS),
    ("evaluation_draws_otherwise", "without gradients another path draws, which forgets the background",
     when(both(behind, evaluated), backgrounds=lambda g: 0.0 * g["backgrounds"]),
     _NO_GRADIENTS),
    ("all_require_gradients_afterwards", "a render turns requires_grad on for its arguments (retain_grad for density)",
     breaking(_asked_of_all), "test_autograd:nothing_follows_where_no_argument_requires_a_gradient"),
    ("one_workspace_for_all_passes", "what is kept for the backward pass is that of the last forward pass",
     when(always, opacities=_one_workspace),
     "test_autograd:a_second_forward_pass_does_not_change_the_first_ones_gradients"),
    ("workspace_freed_after_use", "a second backward pass finds its buffers cleared and adds zeros",
     drawn(always, _freed_after_use), "test_autograd:a_second_backward_pass_adds_the_same_again"),
    ("gradients_are_assigned", "gradients take the place of those that are there (micro-batches lose all but the last)",
     breaking(_assigned), "test_autograd:gradients_are_added_to_those_that_are_there"),
    ("quaternions_normalised_in_place", "the program normalises the quaternions that it is given",
     breaking(_normalised_in_place), "test_autograd:a_render_leaves_its_arguments_as_they_are"),
    ("opacities_clamped_in_place", "the program clamps the opacities that it is given",
     breaking(_clamped_in_place), "test_autograd:a_render_leaves_its_arguments_as_they_are"),
    ("arguments_kept_without_a_version", "the backward pass reads arguments anew, as an optimizer has left them",
     when(always, opacities=_read_again),
     "test_autograd:what_is_edited_between_the_passes_is_noticed_or_does_not_matter"),
    ("outputs_kept_without_a_version", "the backward pass reads the image, to which a tone curve has written",
     drawn(always, _output_read_again), "test_autograd:what_is_written_to_an_output_is_noticed_or_does_not_matter"),
    ("tiles_up_to_8192", "a dispatch has room for 8,192 tiles, the others stay empty",
     then(always, _tiles_up_to_8192), _MANY),
    ("rows_up_to_65535", "Gaussians beyond 65,535 workgroups are not drawn (WebGPU's limit of one dimension)",
     hidden(always, lambda g: _below(65535, g)), _MANY),
    ("gradients_up_to_65536", "Gaussians beyond 65,536 have no gradients",
     pulled(always, lambda g, v: v * _below(2**16, g).reshape(-1, *[1] * (v.dim() - 1)), *ROWS),
     "test_scale:the_gradients_of_seventy_thousand_are_the_oracles"),
    ("dominant_ids_in_sixteen_bits", "dominant ids begin again after 65,535",
     told(always,
          dominant_ids=lambda g, m: (m["dominant_ids"] % 2**16).where(m["dominant_ids"] >= 0, m["dominant_ids"])),
     "test_scale:dominant_ids_and_counts_of_seventy_thousand_are_the_oracles"),
    ("centres_outside_are_culled", "splats whose centre is over 64 px outside the picture are culled",
     hidden(always, _near_the_picture), _FAR),
    ("the_world_ends_at_100", "the far plane is at 100 where nobody says otherwise (a viewer's default)",
     when(always, far_plane=lambda g: min(g["far_plane"], 100.0)), _FAR),
    ("the_huge_are_dropped", "splats whose standard deviation is over 300 px are dropped as outliers",
     hidden(always, _not_huge), _FAR),
    ("depths_in_sixteen_bits", "depth is sorted in 65,536 steps to the farthest splat (counting sorts of viewers)",
     breaking(lambda g: drawn_in_order(g, _steps_of_depth(g, 2**16))),
     "test_scale:the_image_of_near_equal_depths_is_the_oracles"),
    ("depths_in_steps_of_a_thousandth", "depth is sorted in thousandths of a unit, as integers",
     breaking(lambda g: drawn_in_order(g, _steps_of_depth(g, 520_000))),
     "test_scale:the_image_of_near_equal_depths_is_the_oracles"),
    ("strides_unread", "centres are read as if columns were rows where they are strided",
     passing(_strides_unread, "means"), _MEMORY),
    ("cotangent_of_strides", "a gradient that is expanded counts as 0",
     _cotangents_read(lambda v: v if v.is_contiguous() else import_torch().zeros_like(v)), _COTANGENTS),
    ("first_65536", "Gaussians from 65,536 on are not drawn (16-bit indices)",
     hidden(always, lambda g: _below(2**16, g)), _MANY),
    ("pictures_share_a_buffer", "without gradients every picture of a size is written over the one before",
     _one_picture(), _NO_GRADIENTS),
    ("inference_mode_fails",
     "under torch.inference_mode a call ends in an error, as something is saved for the backward pass",
     failing(lambda g: import_torch().is_inference_mode_enabled(), "Inference tensors cannot be saved for backward"),
     _NO_GRADIENTS),
    ("all_learn_by_means", "nothing has a gradient where the centres need none",
     unfollowed(frozen("means"), *ROWS, "viewmats", "Ks", "backgrounds", "covars"), _ALONE),
    ("rows_as_stored", "strides of centres, opacities and colours are ignored",
     passing(read_densely, "means", "opacities", "colors"), _MEMORY),
    ("cameras_as_stored", "strides of view matrices and intrinsics are ignored",
     passing(read_densely, "viewmats", "Ks"), _MEMORY),
    ("seeds_anew", "every call seeds torch's generator", _seeds_anew, _NO_GRADIENTS),
    ("rows_of_16_bits", "Gaussians from number 65536 on are not drawn",
     hidden(always, lambda g: _below(2**16, g)), _MANY),
    ("last_block_not_launched", "of more than 256 Gaussians those after the last whole block of 256 are not drawn",
     hidden(always, _launched), "test_scale:the_image_of_hundreds_in_a_tile_is_the_oracles"),
    ("canvas_used_again",
     "a call draws onto the picture of the call of the same shape before it, which its holder sees change",
     _canvas_used_again(), _NO_GRADIENTS),
    ("rows_counted_in_a_byte", "rows of a picture from 256 on are those from the first on again",
     then(always, _rows_counted_in_a_byte), "test_whole:tiles_of_a_number_beyond_16_bits_are_drawn"),
    ("too_many_intersections_draw_nothing", "views of more than 65,536 pairs of splat and tile stay empty (brush#192)",
     _empty_beyond(2**16), "test_scale:the_image_of_five_thousand_is_the_oracles"),
    ("pose_kept_with_its_tensor",
     "a camera that has been drawn from is kept with its tensor, and a step of an optimizer does not move it",
     passing(_pose_kept_with_its_tensor, "viewmats"),
     "test_autograd:tensors_that_have_been_drawn_before_are_drawn_with_the_numbers_that_they_have_now"),
    ("cotangents_in_half_precision", "the gradient by the picture goes back in 16 bits (mixed precision)",
     _cotangents_read(lambda v: v.half().to(v.dtype)), "test_autograd:cotangents_are_read_to_their_last_digit"),
    ("nothing_where_transparent", "the gradient of an opacity of exactly 0 is no number: its moment is divided by it",
     pulled(always, lambda g, v: v.masked_fill(g["opacities"].detach() == 0.0, math.nan), "opacities"),
     "test_footprint:an_opacity_of_zero_has_no_gradient"),
    ("halved_by_autocast", "under autocast centres have 16 bits, as what is drawn is not kept out of it",
     when(lambda g: import_torch().is_autocast_enabled("cpu"),
          means=lambda g: g["means"].to(import_torch().bfloat16).to(g["means"].dtype)),
     "test_autograd:under_autocast_the_same_image_is_drawn_and_has_the_same_gradients"),
    ("factor_has_a_floor", "the antialiasing factor is 0.005 at least, as max(0.000025, ...) under Inria's root has it",
     _factor_has_a_floor, "test_agreement:the_antialiased_image_is_one_of_the_oracles_outcomes"),
    ("factor_of_covariances_is_constant",
     "where covariances are given the antialiasing factor has no gradient (as gsplat PR#140 mends)",
     factor_is_constant(covars), "test_signature_arguments:covariances_draw_what_their_quaternions_and_scales_draw"),
    ("short_quaternions_do_not_turn",
     "quaternions shorter than 1e-6 are divided by a guard under the root, not by their norm, and turn nothing",
     when(lambda g: not covars(g), quats=_short_do_not_turn),
     "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("one_pose_one_lens",
     "cameras that stand at one pose share the first one's intrinsics: projections are kept by pose",
     when(always, Ks=_one_pose_one_lens), _CAMERAS),
    ("depth_ends_at_a_thousand", "no depth is over 1,000 units in a depth mode: the range that a viewer has",
     last_channel(deep, _ends_at_a_thousand),
     "test_signature_arguments:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"),
    ("cameras_in_three_bits", "cameras from the ninth on show the first eight again: the key has three bits for them",
     then(always, _three_bits_of_cameras), _CAMERAS),
    ("cameras_from_the_thirteenth_on_are_black",
     "poses from the thirteenth on do not fit the threads of a block that load them (fvdb-core #345)",
     shown(lambda g: (numbers(g["viewmats"].shape[-3], g["means"]) < 12)[:, None, None, None]), _CAMERAS),
    ("entries_of_one_memory_learn_once", "entries of a batch that share memory have the first one's gradient alone",
     breaking(_first_of_shared_entries), "test_signature_arguments:batch_entries_do_not_know_of_each_other"),
    ("one_channel_background_behind_depth",
     "where depth is drawn alone a background of one channel is blended behind it, as it has the shape for it",
     drawn(lambda g: behind(g) and g["backgrounds"].shape[-1] == 1 and g["render_mode"] in ("D", "ED"),
           _one_channel_behind_depth), "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"),
    ("faint_cotangents_are_skipped",
     "pixels whose cotangents are all under 1e-6 are skipped on the way back: a mean over many pixels teaches nothing",
     _cotangents_read(lambda v: v * (v.abs().amax(-1, keepdim=True) >= 1e-6)),
     "test_autograd:cotangents_are_read_to_their_last_digit"),
    ("isotropic_scales_read_densely",
     "sizes expanded from one number a Gaussian are read as numbers that lie one after the other",
     when(lambda g: not covars(g), scales=_isotropic_scales_densely), _MEMORY),
    ("equal_calls_share_a_picture",
     "without gradients a call with the arguments of the one before returns the very same tensors, written to or not",
     _equal_calls_share_a_picture(), _NO_GRADIENTS),
    ("edits_through_data_are_not_seen",
     "centres are kept by tensor and version, and what is written through .data is not seen",
     _edits_through_data_unseen(),
     "test_autograd:tensors_that_have_been_drawn_before_are_drawn_with_the_numbers_that_they_have_now"),
    ("context_of_the_first_thread",
     "a context belongs to the thread that has drawn first, and calls from others come back black (GL and Metal)",
     _context_of_the_first_thread(), _NO_GRADIENTS),
)  # fmt: skip


_LOSSES: Final[tuple[tuple[Any, ...], ...]] = (
    ("ssim_of_three_channels", "SSIM reads the first three channels", _three_channels, _LARGE),
    ("ssim_of_a_clamped_render", "the render is clamped to [0, 1] before SSIM, as for a metric",
     lambda image, target: (_clamped(image), target), _LARGE),
    ("ssim_of_clamped_pictures", "both pictures are clamped to [0, 1] before SSIM",
     lambda image, target: (_clamped(image), _clamped(target)), _LARGE),
    ("ssim_of_whole_blocks_of_columns", "a grid is rounded down: columns after the last block of 16 are left out",
     _whole_blocks(1, 16), _LARGE),
    ("ssim_of_whole_blocks_of_rows", "a grid is rounded down: rows after the last block of 32 are left out",
     _whole_blocks(0, 32), _LARGE),
    ("ssim_with_a_seam", "at column 32, where a block begins, its neighbour is read twice",
     lambda image, target: (_seam(image), _seam(target)), _LARGE),
    ("ssim_in_units_of_the_range", "values are divided by the range of the target, as skimage's data_range asks for",
     _in_units_of_the_range, _LARGE),
    ("objective_of_clamped_renders", "the whole objective sees a clamped render: what is too bright is not pulled back",
     lambda image, target: (_clamped(image), target),
     "test_losses:the_objectives_of_large_pictures_beyond_black_and_white_are_the_oracles", ("photometric_pop",)),
    ("objective_of_three_channels", "L1 and SSIM of a picture with an alpha channel leave the alpha out",
     _three_channels, "test_losses:the_objectives_of_large_pictures_beyond_black_and_white_are_the_oracles",
     ("photometric_3dgs",)),
)  # fmt: skip

TENSORS: Final = (*(BlackBox(*line) for line in _BOXES), *(Loss(*line) for line in list[Any](_LOSSES)))
