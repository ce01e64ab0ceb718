"""Mutants at the seams of a sound rasterizer and of sound losses: autograd's contract, memory, size.

Each wraps this program's functions and does what a kernel, an extension or a port once did; nothing of the mathematics
is broken, and a small picture of dense tensors is right.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pop_ref.conformance.mutants.black_box import BlackBox, Rasterization

ALONE: Final = "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together"
WITHOUT: Final = "test_autograd:an_argument_without_a_gradient_takes_none_from_the_others"
ARGUMENTS: Final = "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"
COTANGENTS: Final = "test_autograd:how_cotangents_lie_in_memory_changes_no_gradient"
UNREAD: Final = "test_autograd:an_output_that_no_loss_reads_adds_nothing"
NO_GRAD: Final = "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"
NOTHING: Final = "test_autograd:nothing_follows_where_no_argument_requires_a_gradient"
SECOND: Final = "test_autograd:a_second_forward_pass_does_not_change_the_first_ones_gradients"
TWICE: Final = "test_autograd:a_second_backward_pass_adds_the_same_again"
PRESENT: Final = "test_autograd:gradients_are_added_to_those_that_are_there"
UNCHANGED: Final = "test_autograd:a_render_leaves_its_arguments_as_they_are"
EDITED: Final = "test_autograd:what_is_edited_between_the_passes_is_noticed_or_does_not_matter"
WRITTEN: Final = "test_autograd:what_is_written_to_an_output_is_noticed_or_does_not_matter"
LARGE: Final = "test_masked_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"
OBJECTIVES: Final = "test_masked_losses:the_objectives_of_large_pictures_beyond_black_and_white_are_the_oracles"
SEVENTY: Final = "seventy_thousand"
NEAR_EQUAL: Final = "test_scale:the_image_of_near_equal_depths_is_the_oracles"
FAR: Final = "test_scale:the_image_of_far_and_huge_is_the_oracles"

ROWS: Final = ("means", "quats", "scales", "opacities", "colors")


def _torch() -> Any:
    return importlib.import_module("torch")


def _given(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Rasterization, dict[str, Any]], Any]:
    """Break arguments: those that the change returns by name take the places of what was given."""
    return lambda sound, given: sound(**given | change(given))


def _returned(change: Callable[[Any, Any, dict[str, Any]], tuple[Any, Any]]) -> Callable[[Rasterization, Any], Any]:
    """Break what comes back: image and alphas are what the change makes of both."""

    def breaks(sound: Rasterization, given: dict[str, Any]) -> Any:
        image, alphas, meta = sound(**given)
        return *change(image, alphas, given), meta

    return breaks


def _function(forward: Callable[..., Any], backward: Callable[..., Any]) -> Callable[..., Any]:
    """Return an autograd function of these two, which take the context first."""
    body = {"forward": staticmethod(forward), "backward": staticmethod(backward)}
    return type("Broken", (_torch().autograd.Function,), body).apply


def _nowhere_unless(all_of: tuple[str, ...], dropped: tuple[str, ...]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return a change by which some arguments have no gradient unless all of others require one."""

    def change(given: dict[str, Any]) -> dict[str, Any]:
        if all(given[name].requires_grad for name in all_of):
            return {}
        return {name: given[name].detach() for name in dropped}

    return change


def _dense_strides(x: Any) -> tuple[int, ...]:
    return _torch().empty(x.shape, device="meta").stride()


def _read_densely(x: Any) -> Any:
    """Read memory from a tensor's beginning as if its numbers lay one after the other."""
    enough = x.untyped_storage().nbytes() // x.element_size() - x.storage_offset() >= x.numel()
    return x.as_strided(x.shape, _dense_strides(x), x.storage_offset()) if enough else x.contiguous()


def _from_the_storages_beginning(x: Any) -> Any:
    return x.as_strided(x.shape, x.stride(), 0)


def _cotangents_read(read: Callable[[Any], Any]) -> Callable[[Rasterization, dict[str, Any]], Any]:
    def change(image: Any, alphas: Any, given: dict[str, Any]) -> tuple[Any, Any]:
        return _function(lambda ctx, x: x.clone(), lambda ctx, v: read(v))(image), alphas

    return _returned(change)


def _first_number_alone(v: Any) -> Any:
    if 0 not in v.stride():
        return v
    found = v.new_zeros(v.shape)
    found.view(-1)[0] = v.reshape(-1)[0]
    return found


def _both_cotangents_needed(image: Any, alphas: Any, given: dict[str, Any]) -> tuple[Any, Any]:
    def forward(ctx: Any, x: Any, y: Any) -> Any:
        ctx.set_materialize_grads(False)
        return x.clone(), y.clone()

    # a kernel is handed the address of nothing
    return _function(forward, lambda ctx, v, w: (v.contiguous(), w.contiguous()))(image, alphas)


def _alpha_for_a_missing_image(image: Any, alphas: Any, given: dict[str, Any]) -> tuple[Any, Any]:
    def forward(ctx: Any, x: Any, y: Any) -> Any:
        ctx.set_materialize_grads(False)
        return x.clone(), y.clone()

    def backward(ctx: Any, v: Any, w: Any) -> Any:
        # memory that nobody has cleared
        return (_torch().full_like(image, 0.5) if v is None else v), w

    return _function(forward, backward)(image, alphas)


def _drawn_with_gradients(sound: Rasterization, given: dict[str, Any]) -> Any:
    with _torch().enable_grad():
        return sound(**given)


def _black_without_gradients(sound: Rasterization, given: dict[str, Any]) -> Any:
    if _torch().is_grad_enabled():
        return sound(**given)
    behind = given["backgrounds"]
    return sound(**given | {"backgrounds": None if behind is None else 0.0 * behind})


_WORKSPACE: dict[str, Any] = {}


def _one_workspace(sound: Rasterization, given: dict[str, Any]) -> Any:
    """Go back through what the last forward pass has left, whoever asks."""
    _WORKSPACE["opacities"] = given["opacities"].detach().clone()

    def backward(ctx: Any, v: Any) -> Any:
        last = _WORKSPACE["opacities"]
        kept = min(len(last), len(v))
        found = v.clone()
        found[kept:] = 0.0
        return found

    own = _function(lambda ctx, x: x.clone(), backward)(given["opacities"])
    return sound(**given | {"opacities": own})


def _freed_after_use(image: Any, alphas: Any, given: dict[str, Any]) -> tuple[Any, Any]:
    def backward(ctx: Any, v: Any) -> Any:
        ctx.went = getattr(ctx, "went", 0) + 1
        return v if ctx.went == 1 else 0.0 * v

    return _function(lambda ctx, x: x.clone(), backward)(image), alphas


def _assigned(given: dict[str, Any]) -> dict[str, Any]:
    means = given["means"]
    if means.requires_grad and means.is_leaf:

        def forget(v: Any) -> None:
            means.grad = None

        means.register_hook(forget)
    return {}


def _normalised_in_place(given: dict[str, Any]) -> dict[str, Any]:
    if given["quats"] is not None:
        quats = given["quats"].data
        quats /= quats.norm(dim=-1, keepdim=True)
    return {}


def _clamped_in_place(given: dict[str, Any]) -> dict[str, Any]:
    given["opacities"].data.clamp_(0.3, 0.8)
    return {}


def _read_again(sound: Rasterization, given: dict[str, Any]) -> Any:
    """Read opacities anew in the backward pass, from where they lay in the forward pass."""
    opacities = given["opacities"]
    where, then = opacities.detach(), opacities.detach().clone()
    own = _function(lambda ctx, x: x.clone(), lambda ctx, v: v * where / then)(opacities)
    # what follows is saved of a copy, so that torch sees no edit of it
    return sound(**given | {"opacities": own})


def _output_read_again(image: Any, alphas: Any, given: dict[str, Any]) -> tuple[Any, Any]:
    kept: dict[str, Any] = {}

    def forward(ctx: Any, x: Any) -> Any:
        out = x.clone()
        kept["out"], kept["then"] = out.detach(), out.detach().clone()
        return out

    def backward(ctx: Any, v: Any) -> Any:
        return v * (kept["out"] == kept["then"])

    return _function(forward, backward)(image), alphas


def _asked_of_all(given: dict[str, Any]) -> dict[str, Any]:
    for name in ("means", "opacities"):
        if given[name].is_leaf and _torch().is_grad_enabled():
            given[name].requires_grad_(True)
    return {}


def _tiles_up_to(most: int) -> Callable[[Rasterization, dict[str, Any]], Any]:
    """Leave tiles beyond a number empty: their pixels show what is behind."""

    def change(image: Any, alphas: Any, given: dict[str, Any]) -> tuple[Any, Any]:
        torch, side = _torch(), given["tile_size"]
        across = -(-given["width"] // side)
        rows, columns = torch.arange(given["height"]) // side, torch.arange(given["width"]) // side
        drawn = (rows[:, None] * across + columns < most)[..., None]
        behind = 0.0 if given["backgrounds"] is None else given["backgrounds"][..., None, None, :]
        return torch.where(drawn, image, behind), torch.where(drawn, alphas, 0.0)

    return _returned(change)


def _rows_up_to(most: int, keep_values: bool) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return a change by which Gaussians beyond a number are not seen, or have no gradients."""

    def change(given: dict[str, Any]) -> dict[str, Any]:
        torch, rows = _torch(), {name: given[name] for name in (ROWS if keep_values else ("opacities",))}
        tails = {name: x[most:].detach() * (1.0 if keep_values else 0.0) for name, x in rows.items()}
        return {name: torch.cat([x[:most], tails[name]]) for name, x in rows.items()}

    return change


def _dominant_ids_in_sixteen_bits(sound: Rasterization, given: dict[str, Any]) -> Any:
    image, alphas, meta = sound(**given)
    ids = meta["dominant_ids"]
    return image, alphas, {**meta, "dominant_ids": (ids % 2**16).where(ids >= 0, ids)}


def _depths(given: dict[str, Any]) -> Any:
    view = given["viewmats"][0]
    return given["means"].detach() @ view[2, :3].detach() + view[2, 3].detach()


def _hidden(given: dict[str, Any], gone: Any) -> dict[str, Any]:
    return {"opacities": given["opacities"].masked_fill(gone, 0.0)}


def _far_outside(given: dict[str, Any]) -> dict[str, Any]:
    view, K = given["viewmats"][0].detach(), given["Ks"][0].detach()
    camera = given["means"].detach() @ view[:3, :3].T + view[:3, 3]
    screen = camera @ K.T
    x, y = screen[:, 0] / screen[:, 2], screen[:, 1] / screen[:, 2]
    outside = (x < -64) | (y < -64) | (x > given["width"] + 64) | (y > given["height"] + 64)
    return _hidden(given, outside)


def _huge(given: dict[str, Any]) -> dict[str, Any]:
    px = given["scales"].detach().amax(-1) * given["Ks"][0, 0, 0].detach() / _depths(given)
    return _hidden(given, px > 300.0)


def _order_in_steps(steps: int, farthest: float) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return a change by which Gaussians of one step of depth are drawn as they lie in memory."""

    def change(given: dict[str, Any]) -> dict[str, Any]:
        torch, depths = _torch(), _depths(given)
        keys = (depths.clamp(0.0, farthest) / farthest * steps).floor()
        order = torch.argsort(keys, stable=True)
        # the sound program sorts by depth; it is given the depths of the Gaussians at each place
        sorted_depths = torch.sort(depths).values
        wanted = torch.empty_like(depths)
        wanted[order] = sorted_depths
        view = given["viewmats"][0].detach()
        shift = (wanted / depths)[:, None]
        centre = -(view[:3, :3].T @ view[:3, 3])
        # along the ray of the pixel, with the size that it has there
        return {"means": centre + (given["means"] - centre) * shift, "scales": given["scales"] * shift}

    return change


def _root_without_a_guard(given: dict[str, Any]) -> dict[str, Any]:
    if given["rasterize_mode"] != "antialiased":
        return {}
    return {"opacities": given["opacities"] + 0.0 * given["scales"].prod(-1).sqrt()}


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


_AUTOGRAD: Final = (
    ("gradients_if_all_are_asked_for", "unless every array requires a gradient, none has one",
     _given(_nowhere_unless(ROWS, ROWS)), ALONE),
    ("colours_follow_the_means", "colours have gradients only where means have some",
     _given(_nowhere_unless(("means",), ("colors",))), ALONE),
    ("cameras_follow_the_means", "a frozen scene gives its camera no gradient (pose refinement after training)",
     _given(_nowhere_unless(("means",), ("viewmats",))), ALONE),
    ("backgrounds_follow_the_colours", "a background learned alone has no gradient",
     _given(_nowhere_unless(("colors",), ("backgrounds",))), ALONE),
    ("quaternions_follow_the_scales", "with frozen scales quaternions have no gradient: one switch for both",
     _given(_nowhere_unless(("scales",), ("quats",))), WITHOUT),
    ("opacities_follow_the_colours", "with frozen colours the opacities' gradient lacks what they show",
     _given(_nowhere_unless(("colors",), ("opacities",))), WITHOUT),
    ("means_read_densely", "a kernel reads means one after the other, however they lie (no contiguous())",
     _given(lambda given: {"means": _read_densely(given["means"])}), ARGUMENTS),
    ("colours_read_densely", "a kernel reads colours one after the other, however they lie",
     _given(lambda given: {"colors": _read_densely(given["colors"])}), ARGUMENTS),
    ("opacities_read_densely", "a kernel reads opacities one after the other, however they lie",
     _given(lambda given: {"opacities": _read_densely(given["opacities"])}), ARGUMENTS),
    ("offset_of_the_storage_ignored", "scales are read from where their storage begins (data_ptr of the storage)",
     _given(lambda given: {"scales": _from_the_storages_beginning(given["scales"])}), ARGUMENTS),
    ("cotangents_read_densely", "the backward kernel reads the image's cotangent as if it were dense",
     _cotangents_read(_read_densely), COTANGENTS),
    ("expanded_cotangents_have_one_number", "of a cotangent without memory of its own the first number is read",
     _cotangents_read(_first_number_alone), COTANGENTS),
    ("both_outputs_must_be_used", "a loss that reads the image alone, or alpha alone, ends in an error (None)",
     _returned(_both_cotangents_needed), UNREAD),
    ("memory_for_a_missing_cotangent", "where no loss reads the image its cotangent is whatever lay there",
     _returned(_alpha_for_a_missing_image), UNREAD),
    ("no_grad_is_not_heard", "under no_grad the image still follows its arguments, and keeps their memory",
     _drawn_with_gradients, NO_GRAD),
    ("evaluation_draws_otherwise", "without gradients another path draws, which forgets the background",
     _black_without_gradients, NO_GRAD),
    ("all_require_gradients_afterwards", "a render turns requires_grad on for its arguments (retain_grad for density)",
     _given(_asked_of_all), NOTHING),
    ("one_workspace_for_all_passes", "what is kept for the backward pass is that of the last forward pass",
     _one_workspace, SECOND),
    ("workspace_freed_after_use", "a second backward pass finds its buffers cleared and adds zeros",
     _returned(_freed_after_use), TWICE),
    ("gradients_are_assigned", "gradients take the place of those that are there (micro-batches lose all but the last)",
     _given(_assigned), PRESENT),
    ("quaternions_normalised_in_place", "the program normalises the quaternions that it is given",
     _given(_normalised_in_place), UNCHANGED),
    ("opacities_clamped_in_place", "the program clamps the opacities that it is given",
     _given(_clamped_in_place), UNCHANGED),
    ("arguments_kept_without_a_version", "the backward pass reads arguments anew, as an optimizer has left them",
     _read_again, EDITED),
    ("outputs_kept_without_a_version", "the backward pass reads the image, to which a tone curve has written",
     _returned(_output_read_again), WRITTEN),
)  # fmt: skip

_SCALE: Final = (
    ("tiles_up_to_8192", "a dispatch has room for 8,192 tiles, the others stay empty",
     _tiles_up_to(8192), f"test_scale:the_image_of_{SEVENTY}_is_the_oracles"),
    ("rows_up_to_65535", "Gaussians beyond 65,535 workgroups are not drawn (WebGPU's limit of one dimension)",
     _given(_rows_up_to(65535, False)), f"test_scale:the_image_of_{SEVENTY}_is_the_oracles"),
    ("gradients_up_to_65536", "Gaussians beyond 65,536 have no gradients",
     _given(_rows_up_to(65536, True)), f"test_scale:the_gradients_of_{SEVENTY}_are_the_oracles"),
    ("dominant_ids_in_sixteen_bits", "dominant ids begin again after 65,535",
     _dominant_ids_in_sixteen_bits, f"test_scale:dominant_ids_and_counts_of_{SEVENTY}_are_the_oracles"),
    ("centres_outside_are_culled", "splats whose centre is over 64 px outside the picture are culled",
     _given(_far_outside), FAR),
    ("the_world_ends_at_100", "the far plane is at 100 where nobody says otherwise (a viewer's default)",
     _given(lambda given: {"far_plane": min(given["far_plane"], 100.0)}), FAR),
    ("the_huge_are_dropped", "splats whose standard deviation is over 300 px are dropped as outliers",
     _given(_huge), FAR),
    ("depths_in_sixteen_bits", "depth is sorted in 65,536 steps to the farthest splat (counting sorts of viewers)",
     _given(_order_in_steps(2**16, 520.0)), NEAR_EQUAL),
    ("depths_in_steps_of_a_thousandth", "depth is sorted in thousandths of a unit, as integers",
     _given(_order_in_steps(520_000, 520.0)), NEAR_EQUAL),
    ("factor_without_a_guard", "the root in the antialiasing factor has an infinite derivative at 0",
     _given(_root_without_a_guard),
     "test_gradients:antialiasing_takes_a_splat_without_area_away_with_all_its_gradients"),
)  # fmt: skip


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
    return _torch().cat([picture[:, :32], picture[:, 31:32], picture[:, 33:]], 1)


def _in_units_of_the_range(image: Any, target: Any) -> tuple[Any, Any]:
    span = (target.max() - target.min()).clamp(min=1.0)
    return image / span, target / span


def _three_channels(image: Any, target: Any) -> tuple[Any, Any]:
    return image[..., :3], target[..., :3]


_SEEN_IN_LOSSES: Final = (
    ("ssim_of_three_channels", "SSIM reads the first three channels", _three_channels, LARGE),
    ("ssim_of_a_clamped_render", "the render is clamped to [0, 1] before SSIM, as for a metric",
     lambda image, target: (_clamped(image), target), LARGE),
    ("ssim_of_clamped_pictures", "both pictures are clamped to [0, 1] before SSIM",
     lambda image, target: (_clamped(image), _clamped(target)), LARGE),
    ("ssim_of_whole_blocks_of_columns", "a grid is rounded down: columns after the last block of 16 are left out",
     _whole_blocks(1, 16), LARGE),
    ("ssim_of_whole_blocks_of_rows", "a grid is rounded down: rows after the last block of 32 are left out",
     _whole_blocks(0, 32), LARGE),
    ("ssim_with_a_seam", "at column 32, where a block begins, its neighbour is read twice",
     lambda image, target: (_seam(image), _seam(target)), LARGE),
    ("ssim_in_units_of_the_range", "values are divided by the range of the target, as skimage's data_range asks for",
     _in_units_of_the_range, LARGE),
    ("objective_of_clamped_renders", "the whole objective sees a clamped render: what is too bright is not pulled back",
     lambda image, target: (_clamped(image), target), OBJECTIVES, ("photometric_pop",)),
    ("objective_of_three_channels", "L1 and SSIM of a picture with an alpha channel leave the alpha out",
     _three_channels, OBJECTIVES, ("photometric_3dgs",)),
)  # fmt: skip

SEAMS: Final = (
    *(BlackBox(*line) for line in (*_AUTOGRAD, *_SCALE)),
    *(Loss(*line) for line in list[Any](_SEEN_IN_LOSSES)),
)
