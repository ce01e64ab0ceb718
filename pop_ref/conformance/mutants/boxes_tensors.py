"""Black boxes at the seams of a sound rasterizer and of sound losses: autograd's contract, memory, size.

Each wraps this program's functions and does what a kernel, an extension or a port once did.
"""

from __future__ import annotations

import importlib
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
    backwards,
    batched,
    breaking,
    import_torch,
    one_view,
    telling,
)

ROWS: Final = ("means", "quats", "scales", "opacities", "colors")
_WORKSPACE: dict[str, Any] = {}
_BLOCK: Final = 256  # Gaussians that a launch takes together


def _returned(change: Callable[[Any, Any, Given], tuple[Any, Any]]) -> Breaks:
    """Break what comes back: image and alphas are what the change makes of both."""

    def breaks(sound: Rasterization, given: Given) -> Any:
        image, alphas, meta = sound(**given)
        return *change(image, alphas, given), meta

    return breaks


def _function(forward: Callable[..., Any], backward: Callable[..., Any]) -> Callable[..., Any]:
    """Return an autograd function of these two, which take the context first."""
    body = {"forward": staticmethod(forward), "backward": staticmethod(backward)}
    return type("Broken", (import_torch().autograd.Function,), body).apply


def _nowhere_unless(all_of: tuple[str, ...], dropped: tuple[str, ...]) -> Callable[[Given], Given]:
    """Return a change by which some arguments have no gradient unless all of others require one."""

    def change(given: Given) -> Given:
        if all(given[name].requires_grad for name in all_of):
            return {}
        return {name: given[name].detach() for name in dropped}

    return change


def _dense_strides(x: Any) -> tuple[int, ...]:
    return import_torch().empty(x.shape, device="meta").stride()


def _read_densely(x: Any) -> Any:
    """Read memory from a tensor's beginning as if its numbers lay one after the other."""
    enough = x.untyped_storage().nbytes() // x.element_size() - x.storage_offset() >= x.numel()
    return x.as_strided(x.shape, _dense_strides(x), x.storage_offset()) if enough else x.contiguous()


def _from_the_storages_beginning(x: Any) -> Any:
    return x.as_strided(x.shape, x.stride(), 0)


def _cotangents_read(read: Callable[[Any], Any]) -> Breaks:
    def change(image: Any, alphas: Any, given: Given) -> tuple[Any, Any]:
        return _function(lambda ctx, x: x.clone(), lambda ctx, v: read(v))(image), alphas

    return _returned(change)


def _first_number_alone(v: Any) -> Any:
    if 0 not in v.stride():
        return v
    found = v.new_zeros(v.shape)
    found.view(-1)[0] = v.reshape(-1)[0]
    return found


def _both_cotangents_needed(image: Any, alphas: Any, given: Given) -> tuple[Any, Any]:
    def forward(ctx: Any, x: Any, y: Any) -> Any:
        ctx.set_materialize_grads(False)
        return x.clone(), y.clone()

    # a kernel is handed the address of nothing
    return _function(forward, lambda ctx, v, w: (v.contiguous(), w.contiguous()))(image, alphas)


def _alpha_for_a_missing_image(image: Any, alphas: Any, given: Given) -> tuple[Any, Any]:
    def forward(ctx: Any, x: Any, y: Any) -> Any:
        ctx.set_materialize_grads(False)
        return x.clone(), y.clone()

    def backward(ctx: Any, v: Any, w: Any) -> Any:
        # memory that nobody has cleared
        return (import_torch().full_like(image, 0.5) if v is None else v), w

    return _function(forward, backward)(image, alphas)


def _drawn_with_gradients(sound: Rasterization, given: Given) -> Any:
    with import_torch().enable_grad():
        return sound(**given)


def _black_without_gradients(sound: Rasterization, given: Given) -> Any:
    if import_torch().is_grad_enabled():
        return sound(**given)
    behind = given["backgrounds"]
    return sound(**given | {"backgrounds": None if behind is None else 0.0 * behind})


def _one_workspace(sound: Rasterization, given: Given) -> Any:
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


def _freed_after_use(image: Any, alphas: Any, given: Given) -> tuple[Any, Any]:
    def backward(ctx: Any, v: Any) -> Any:
        ctx.went = getattr(ctx, "went", 0) + 1
        return v if ctx.went == 1 else 0.0 * v

    return _function(lambda ctx, x: x.clone(), backward)(image), alphas


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


def _read_again(sound: Rasterization, given: Given) -> Any:
    """Read opacities anew in the backward pass, from where they lay in the forward pass."""
    opacities = given["opacities"]
    where, then = opacities.detach(), opacities.detach().clone()
    own = _function(lambda ctx, x: x.clone(), lambda ctx, v: v * where / then)(opacities)
    # what follows is saved of a copy, so that torch sees no edit of it
    return sound(**given | {"opacities": own})


def _output_read_again(image: Any, alphas: Any, given: Given) -> tuple[Any, Any]:
    kept: dict[str, Any] = {}

    def forward(ctx: Any, x: Any) -> Any:
        out = x.clone()
        kept["out"], kept["then"] = out.detach(), out.detach().clone()
        return out

    def backward(ctx: Any, v: Any) -> Any:
        return v * (kept["out"] == kept["then"])

    return _function(forward, backward)(image), alphas


def _asked_of_all(given: Given) -> Given:
    for name in ("means", "opacities"):
        if given[name].is_leaf and import_torch().is_grad_enabled():
            given[name].requires_grad_(True)
    return {}


def _tiles_up_to(most: int) -> Breaks:
    """Leave tiles beyond a number empty: their pixels show what is behind."""

    def change(image: Any, alphas: Any, given: Given) -> tuple[Any, Any]:
        torch, side = import_torch(), given["tile_size"]
        across = -(-given["width"] // side)
        rows, columns = torch.arange(given["height"]) // side, torch.arange(given["width"]) // side
        drawn = (rows[:, None] * across + columns < most)[..., None]
        behind = 0.0 if given["backgrounds"] is None else given["backgrounds"][..., None, None, :]
        return torch.where(drawn, image, behind), torch.where(drawn, alphas, 0.0)

    return _returned(change)


def _rows_up_to(most: int, keep_values: bool) -> Callable[[Given], Given]:
    """Return a change by which Gaussians beyond a number are not seen, or have no gradients."""

    def change(given: Given) -> Given:
        torch, rows = import_torch(), {name: given[name] for name in (ROWS if keep_values else ("opacities",))}
        tails = {name: x[most:].detach() * (1.0 if keep_values else 0.0) for name, x in rows.items()}
        return {name: torch.cat([x[:most], tails[name]]) for name, x in rows.items()}

    return change


def _dominant_ids_in_sixteen_bits(sound: Rasterization, given: Given) -> Any:
    image, alphas, meta = sound(**given)
    ids = meta["dominant_ids"]
    return image, alphas, {**meta, "dominant_ids": (ids % 2**16).where(ids >= 0, ids)}


def _depths(given: Given) -> Any:
    view = given["viewmats"][0]
    return given["means"].detach() @ view[2, :3].detach() + view[2, 3].detach()


def _hidden(given: Given, gone: Any) -> Given:
    return {"opacities": given["opacities"].masked_fill(gone, 0.0)}


def _far_outside(given: Given) -> Given:
    view, K = given["viewmats"][0].detach(), given["Ks"][0].detach()
    camera = given["means"].detach() @ view[:3, :3].T + view[:3, 3]
    screen = camera @ K.T
    x, y = screen[:, 0] / screen[:, 2], screen[:, 1] / screen[:, 2]
    outside = (x < -64) | (y < -64) | (x > given["width"] + 64) | (y > given["height"] + 64)
    return _hidden(given, outside)


def _huge(given: Given) -> Given:
    px = given["scales"].detach().amax(-1) * given["Ks"][0, 0, 0].detach() / _depths(given)
    return _hidden(given, px > 300.0)


def _order_in_steps(steps: int, farthest: float) -> Callable[[Given], Given]:
    """Return a change by which Gaussians of one step of depth are drawn as they lie in memory."""

    def change(given: Given) -> Given:
        torch, depths = import_torch(), _depths(given)
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


def _strides_unread(given: Given) -> Given:
    means = given["means"]
    if means.is_contiguous():
        return {}
    flat = means.detach().contiguous().reshape(-1)
    return {"means": means + (flat.reshape(means.shape[::-1]).mT.reshape(means.shape) - means).detach()}


def _cotangent_of_strides(given: Given, images: Any, alphas: Any, meta: Any) -> tuple[Any, Any, Any]:
    if images.requires_grad:
        images = images.clone()
        images.register_hook(lambda g: g if g.is_contiguous() else import_torch().zeros_like(g))
    return images, alphas, meta


def _first_65536(given: Given) -> Given:
    n = given["means"].shape[-2]
    if n <= 65536:
        return {}
    return {"opacities": given["opacities"] * (import_torch().arange(n, device=given["means"].device) < 65536)}


def _one_picture() -> Breaks:
    kept: dict[Any, Any] = {}

    def breaks(sound: Rasterization, given: Given) -> Any:
        images, alphas, meta = sound(**given)
        if images.requires_grad:
            return images, alphas, meta
        buffer = kept.setdefault((images.shape, images.dtype), images)
        return buffer.copy_(images), alphas, meta

    return breaks


def _inference_fails(sound: Rasterization, given: Given) -> Any:
    if import_torch().is_inference_mode_enabled():
        raise RuntimeError("Inference tensors cannot be saved for backward")
    return sound(**given)


def _all_learn_by_means(given: Given) -> Given:
    if given["means"].requires_grad:
        return {}
    Tensor = import_torch().Tensor
    return {name: value.detach() for name, value in given.items() if isinstance(value, Tensor)}


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


def _seeds_anew(sound: Rasterization, given: Given) -> Any:
    import_torch().manual_seed(0)
    return sound(**given)


def _rows_of_16_bits(given: Given) -> Given:
    opacities = given["opacities"]
    return {"opacities": opacities * (import_torch().arange(opacities.shape[-1], device=opacities.device) < 2**16)}


def _last_block_not_launched(given: Given) -> Given:
    opacities = given["opacities"]
    n = opacities.shape[-1]
    if n <= _BLOCK or n % _BLOCK == 0:
        return {}
    launched = import_torch().arange(n, device=opacities.device) < n // _BLOCK * _BLOCK
    return {"opacities": opacities * launched}


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


def _rows_counted_in_a_byte(image: Any, alphas: Any, given: Given) -> tuple[Any, Any]:
    rows = import_torch().arange(given["height"]) % 256
    return image[..., rows, :, :], alphas[..., rows, :, :]


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


def _pose_kept_with_its_tensor(given: Given) -> Given:
    viewmats = given["viewmats"]
    kept = getattr(viewmats, "_kept_pose", None)
    if kept is None:
        viewmats._kept_pose = viewmats.detach().clone()
        return {}
    return {"viewmats": viewmats + (kept - viewmats).detach()}


def _nothing_where_transparent(given: Given) -> Given:
    opacities = given["opacities"]
    nothing = opacities.detach() == 0.0
    return {"opacities": backwards(opacities, lambda v: v.masked_fill(nothing, float("nan")))}


def _halved_by_autocast(given: Given) -> Given:
    torch = import_torch()
    if not torch.is_autocast_enabled("cpu"):
        return {}
    return {"means": given["means"].to(torch.bfloat16).to(given["means"].dtype)}


def _put(value: Any, wrong: Any) -> Any:
    """Return a value that is another one, through which gradients go as if it were not."""
    return value + (wrong - value).detach()


def _seen_opacities(sound: Rasterization, given: Given) -> Any:
    opacities = given["opacities"]
    return sound(**given | {"packed": False, "absgrad": False})[2]["opacities"].reshape(opacities.shape)


def _factor_has_a_floor(sound: Rasterization, given: Given) -> Any:
    if given["rasterize_mode"] != "antialiased" or not one_view(given):
        return sound(**given)
    seen, least = _seen_opacities(sound, given), 0.005 * given["opacities"]
    own = import_torch().where(seen < least, least, seen)
    return sound(**given | {"rasterize_mode": "classic", "opacities": own})


def _factor_of_covariances_is_constant(sound: Rasterization, given: Given) -> Any:
    if given["covars"] is None or given["rasterize_mode"] != "antialiased" or not one_view(given):
        return sound(**given)
    torch, opacities = import_torch(), given["opacities"]
    with torch.no_grad():
        factors = torch.where(opacities > 0.0, _seen_opacities(sound, given) / opacities, torch.zeros_like(opacities))
    return sound(**given | {"rasterize_mode": "classic", "opacities": opacities * factors})


def _short_do_not_turn(given: Given) -> Given:
    quats = given["quats"]
    if quats is None or given["covars"] is not None:
        return {}
    short = quats.detach().norm(dim=-1, keepdim=True) < 1e-6
    return {"quats": import_torch().where(short, quats.new_tensor((1.0, 0.0, 0.0, 0.0)), quats)}


def _one_pose_one_lens(given: Given) -> Given:
    torch, poses, Ks = import_torch(), given["viewmats"].detach().flatten(-2), given["Ks"]
    same = (poses[..., :, None, :] == poses[..., None, :, :]).all(-1)
    C = poses.shape[-2]
    first = torch.where(same, torch.arange(C), C).amin(-1)
    return {"Ks": Ks.gather(-3, first[..., None, None].expand(Ks.shape))}


def _ends_at_a_thousand(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    if given["render_mode"] == "RGB":
        return images, alphas, meta
    torch, depth, cover = import_torch(), images[..., -1:], alphas.detach()
    most = 1000.0 * (torch.ones_like(cover) if given["render_mode"].endswith("ED") else cover)
    return torch.cat((images[..., :-1], torch.where(depth > most, most, depth)), -1), alphas, meta


def _three_bits_of_cameras(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    shown = import_torch().arange(given["viewmats"].shape[-3]) & 7
    return images.index_select(-4, shown), alphas.index_select(-4, shown), meta


def _unloaded_cameras(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    loaded = (import_torch().arange(given["viewmats"].shape[-3]) < 12)[:, None, None, None]
    return images * loaded, alphas * loaded, meta


def _first_of_shared_entries(given: Given) -> Given:
    def of_first(v: Any) -> Any:
        return import_torch().cat([v[:1], 0.0 * v[1:]])

    named = {name: given[name] for name in ROWS if batched(given) and given[name] is not None}
    shared = {name: x for name, x in named.items() if x.stride(0) == 0}
    return {name: backwards(x, of_first) for name, x in shared.items()}


def _one_channel_behind_depth(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    behind = given["backgrounds"]
    if behind is None or behind.shape[-1] != 1 or given["render_mode"] not in ("D", "ED"):
        return images, alphas, meta
    more = behind[..., None, None, :] * (1.0 - alphas)
    return images + (more if given["render_mode"] == "D" else more / alphas.clamp_min(1e-10)), alphas, meta


def _faint_are_skipped(given: Given, images: Any, alphas: Any, meta: Any) -> Told:
    pull = _function(lambda ctx, x: x.clone(), lambda ctx, v: v * (v.abs().amax(-1, keepdim=True) >= 1e-6))
    return pull(images) if images.requires_grad else images, alphas, meta


def _isotropic_scales_densely(given: Given) -> Given:
    scales = given["scales"]
    if scales is None or given["covars"] is not None or scales.stride(-1) != 0 or scales.numel() == 0:
        return {}
    memory = scales.detach()[..., 0].reshape(-1)
    return {"scales": _put(scales, memory[import_torch().arange(scales.numel()) % len(memory)].reshape(scales.shape))}


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
        return sound(**given | {"means": _put(means, numbers)})

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
     breaking(_nowhere_unless(ROWS, ROWS)),
     "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together"),
    ("colours_follow_the_means", "colours have gradients only where means have some",
     breaking(_nowhere_unless(("means",), ("colors",))),
     "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together"),
    ("cameras_follow_the_means", "a frozen scene gives its camera no gradient (pose refinement after training)",
     breaking(_nowhere_unless(("means",), ("viewmats",))),
     "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together"),
    ("backgrounds_follow_the_colours", "a background learned alone has no gradient",
     breaking(_nowhere_unless(("colors",), ("backgrounds",))),
     "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together"),
    ("quaternions_follow_the_scales", "with frozen scales quaternions have no gradient: one switch for both",
     breaking(_nowhere_unless(("scales",), ("quats",))),
     "test_autograd:an_argument_without_a_gradient_takes_none_from_the_others"),
    ("opacities_follow_the_colours", "with frozen colours the opacities' gradient lacks what they show",
     breaking(_nowhere_unless(("colors",), ("opacities",))),
     "test_autograd:an_argument_without_a_gradient_takes_none_from_the_others"),
    ("means_read_densely", "a kernel reads means one after the other, however they lie (no contiguous())",
     breaking(lambda given: {"means": _read_densely(given["means"])}),
     "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("colours_read_densely", "a kernel reads colours one after the other, however they lie",
     breaking(lambda given: {"colors": _read_densely(given["colors"])}),
     "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("opacities_read_densely", "a kernel reads opacities one after the other, however they lie",
     breaking(lambda given: {"opacities": _read_densely(given["opacities"])}),
     "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("offset_of_the_storage_ignored", "scales are read from where their storage begins (data_ptr of the storage)",
     breaking(lambda given: {"scales": _from_the_storages_beginning(given["scales"])}),
     "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("cotangents_read_densely", "the backward kernel reads the image's cotangent as if it were dense",
     _cotangents_read(_read_densely), "test_autograd:how_cotangents_lie_in_memory_changes_no_gradient"),
    ("expanded_cotangents_have_one_number", "of a cotangent without memory of its own the first number is read",
     _cotangents_read(_first_number_alone), "test_autograd:how_cotangents_lie_in_memory_changes_no_gradient"),
    ("both_outputs_must_be_used", "a loss that reads the image alone, or alpha alone, ends in an error (None)",
     _returned(_both_cotangents_needed), "test_autograd:an_output_that_no_loss_reads_adds_nothing"),
    ("memory_for_a_missing_cotangent", "where no loss reads the image its cotangent is whatever lay there",
     _returned(_alpha_for_a_missing_image), "test_autograd:an_output_that_no_loss_reads_adds_nothing"),
    ("no_grad_is_not_heard", "under no_grad the image still follows its arguments, and keeps their memory",
     _drawn_with_gradients, "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
    ("evaluation_draws_otherwise", "without gradients another path draws, which forgets the background",
     _black_without_gradients, "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
    ("all_require_gradients_afterwards", "a render turns requires_grad on for its arguments (retain_grad for density)",
     breaking(_asked_of_all), "test_autograd:nothing_follows_where_no_argument_requires_a_gradient"),
    ("one_workspace_for_all_passes", "what is kept for the backward pass is that of the last forward pass",
     _one_workspace, "test_autograd:a_second_forward_pass_does_not_change_the_first_ones_gradients"),
    ("workspace_freed_after_use", "a second backward pass finds its buffers cleared and adds zeros",
     _returned(_freed_after_use), "test_autograd:a_second_backward_pass_adds_the_same_again"),
    ("gradients_are_assigned", "gradients take the place of those that are there (micro-batches lose all but the last)",
     breaking(_assigned), "test_autograd:gradients_are_added_to_those_that_are_there"),
    ("quaternions_normalised_in_place", "the program normalises the quaternions that it is given",
     breaking(_normalised_in_place), "test_autograd:a_render_leaves_its_arguments_as_they_are"),
    ("opacities_clamped_in_place", "the program clamps the opacities that it is given",
     breaking(_clamped_in_place), "test_autograd:a_render_leaves_its_arguments_as_they_are"),
    ("arguments_kept_without_a_version", "the backward pass reads arguments anew, as an optimizer has left them",
     _read_again, "test_autograd:what_is_edited_between_the_passes_is_noticed_or_does_not_matter"),
    ("outputs_kept_without_a_version", "the backward pass reads the image, to which a tone curve has written",
     _returned(_output_read_again), "test_autograd:what_is_written_to_an_output_is_noticed_or_does_not_matter"),
    ("tiles_up_to_8192", "a dispatch has room for 8,192 tiles, the others stay empty",
     _tiles_up_to(8192), "test_scale:the_image_of_seventy_thousand_is_the_oracles"),
    ("rows_up_to_65535", "Gaussians beyond 65,535 workgroups are not drawn (WebGPU's limit of one dimension)",
     breaking(_rows_up_to(65535, False)), "test_scale:the_image_of_seventy_thousand_is_the_oracles"),
    ("gradients_up_to_65536", "Gaussians beyond 65,536 have no gradients",
     breaking(_rows_up_to(65536, True)), "test_scale:the_gradients_of_seventy_thousand_are_the_oracles"),
    ("dominant_ids_in_sixteen_bits", "dominant ids begin again after 65,535",
     _dominant_ids_in_sixteen_bits, "test_scale:dominant_ids_and_counts_of_seventy_thousand_are_the_oracles"),
    ("centres_outside_are_culled", "splats whose centre is over 64 px outside the picture are culled",
     breaking(_far_outside), "test_scale:the_image_of_far_and_huge_is_the_oracles"),
    ("the_world_ends_at_100", "the far plane is at 100 where nobody says otherwise (a viewer's default)",
     breaking(lambda given: {"far_plane": min(given["far_plane"], 100.0)}),
     "test_scale:the_image_of_far_and_huge_is_the_oracles"),
    ("the_huge_are_dropped", "splats whose standard deviation is over 300 px are dropped as outliers",
     breaking(_huge), "test_scale:the_image_of_far_and_huge_is_the_oracles"),
    ("depths_in_sixteen_bits", "depth is sorted in 65,536 steps to the farthest splat (counting sorts of viewers)",
     breaking(_order_in_steps(2**16, 520.0)), "test_scale:the_image_of_near_equal_depths_is_the_oracles"),
    ("depths_in_steps_of_a_thousandth", "depth is sorted in thousandths of a unit, as integers",
     breaking(_order_in_steps(520_000, 520.0)), "test_scale:the_image_of_near_equal_depths_is_the_oracles"),
    ("strides_unread", "centres are read as if columns were rows where they are strided",
     breaking(_strides_unread), "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("cotangent_of_strides", "a gradient that is expanded counts as 0",
     telling(_cotangent_of_strides), "test_autograd:how_cotangents_lie_in_memory_changes_no_gradient"),
    ("first_65536", "Gaussians from 65,536 on are not drawn (16-bit indices)",
     breaking(_first_65536), "test_scale:the_image_of_seventy_thousand_is_the_oracles"),
    ("pictures_share_a_buffer", "without gradients every picture of a size is written over the one before",
     _one_picture(), "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
    ("inference_mode_fails",
     "under torch.inference_mode a call ends in an error, as something is saved for the backward pass",
     _inference_fails, "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
    ("all_learn_by_means", "nothing has a gradient where the centres need none",
     breaking(_all_learn_by_means), "test_autograd:each_argument_alone_has_the_gradient_that_all_have_together"),
    ("rows_as_stored", "strides of centres, opacities and colours are ignored",
     breaking(_rows_as_stored), "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("cameras_as_stored", "strides of view matrices and intrinsics are ignored",
     breaking(_cameras_as_stored), "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("seeds_anew", "every call seeds torch's generator",
     _seeds_anew, "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
    ("rows_of_16_bits", "Gaussians from number 65536 on are not drawn",
     breaking(_rows_of_16_bits), "test_scale:the_image_of_seventy_thousand_is_the_oracles"),
    ("last_block_not_launched", "of more than 256 Gaussians those after the last whole block of 256 are not drawn",
     breaking(_last_block_not_launched), "test_scale:the_image_of_hundreds_in_a_tile_is_the_oracles"),
    ("canvas_used_again",
     "a call draws onto the picture of the call of the same shape before it, which its holder sees change",
     _canvas_used_again(), "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
    ("rows_counted_in_a_byte", "rows of a picture from 256 on are those from the first on again",
     _returned(_rows_counted_in_a_byte), "test_whole:tiles_of_a_number_beyond_16_bits_are_drawn"),
    ("too_many_intersections_draw_nothing", "views of more than 65,536 pairs of splat and tile stay empty (brush#192)",
     _empty_beyond(2**16), "test_scale:the_image_of_five_thousand_is_the_oracles"),
    ("pose_kept_with_its_tensor",
     "a camera that has been drawn from is kept with its tensor, and a step of an optimizer does not move it",
     breaking(_pose_kept_with_its_tensor),
     "test_autograd:tensors_that_have_been_drawn_before_are_drawn_with_the_numbers_that_they_have_now"),
    ("cotangents_in_half_precision", "the gradient by the picture goes back in 16 bits (mixed precision)",
     _cotangents_read(lambda v: v.half().to(v.dtype)), "test_autograd:cotangents_are_read_to_their_last_digit"),
    ("nothing_where_transparent", "the gradient of an opacity of exactly 0 is no number: its moment is divided by it",
     breaking(_nothing_where_transparent), "test_footprint:an_opacity_of_zero_has_no_gradient"),
    ("halved_by_autocast", "under autocast centres have 16 bits, as what is drawn is not kept out of it",
     breaking(_halved_by_autocast), "test_autograd:under_autocast_the_same_image_is_drawn_and_has_the_same_gradients"),
    ("factor_has_a_floor", "the antialiasing factor is 0.005 at least, as max(0.000025, ...) under Inria's root has it",
     _factor_has_a_floor, "test_agreement:the_antialiased_image_is_one_of_the_oracles_outcomes"),
    ("factor_of_covariances_is_constant",
     "where covariances are given the antialiasing factor has no gradient (as gsplat PR#140 mends)",
     _factor_of_covariances_is_constant,
     "test_signature_arguments:covariances_draw_what_their_quaternions_and_scales_draw"),
    ("short_quaternions_do_not_turn",
     "quaternions shorter than 1e-6 are divided by a guard under the root, not by their norm, and turn nothing",
     breaking(_short_do_not_turn), "test_signature_arguments:a_world_told_in_other_units_is_drawn_alike"),
    ("one_pose_one_lens",
     "cameras that stand at one pose share the first one's intrinsics: projections are kept by pose",
     breaking(_one_pose_one_lens),
     "test_signature_arguments:every_camera_has_the_colours_and_harmonics_that_were_given_for_it"),
    ("depth_ends_at_a_thousand", "no depth is over 1,000 units in a depth mode: the range that a viewer has",
     telling(_ends_at_a_thousand),
     "test_signature_arguments:the_accumulated_depth_is_the_oracles_alone_and_behind_colours"),
    ("cameras_in_three_bits", "cameras from the ninth on show the first eight again: the key has three bits for them",
     telling(_three_bits_of_cameras),
     "test_signature_arguments:every_camera_has_the_colours_and_harmonics_that_were_given_for_it"),
    ("cameras_from_the_thirteenth_on_are_black",
     "poses from the thirteenth on do not fit the threads of a block that load them (fvdb-core #345)",
     telling(_unloaded_cameras),
     "test_signature_arguments:every_camera_has_the_colours_and_harmonics_that_were_given_for_it"),
    ("entries_of_one_memory_learn_once", "entries of a batch that share memory have the first one's gradient alone",
     breaking(_first_of_shared_entries), "test_signature_arguments:batch_entries_do_not_know_of_each_other"),
    ("one_channel_background_behind_depth",
     "where depth is drawn alone a background of one channel is blended behind it, as it has the shape for it",
     telling(_one_channel_behind_depth), "test_signature_arguments:depth_follows_plain_colours_of_several_cameras"),
    ("faint_cotangents_are_skipped",
     "pixels whose cotangents are all under 1e-6 are skipped on the way back: a mean over many pixels teaches nothing",
     telling(_faint_are_skipped), "test_autograd:cotangents_are_read_to_their_last_digit"),
    ("isotropic_scales_read_densely",
     "sizes expanded from one number a Gaussian are read as numbers that lie one after the other",
     breaking(_isotropic_scales_densely), "test_autograd:how_arguments_lie_in_memory_changes_no_gradient"),
    ("equal_calls_share_a_picture",
     "without gradients a call with the arguments of the one before returns the very same tensors, written to or not",
     _equal_calls_share_a_picture(), "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
    ("edits_through_data_are_not_seen",
     "centres are kept by tensor and version, and what is written through .data is not seen",
     _edits_through_data_unseen(),
     "test_autograd:tensors_that_have_been_drawn_before_are_drawn_with_the_numbers_that_they_have_now"),
    ("context_of_the_first_thread",
     "a context belongs to the thread that has drawn first, and calls from others come back black (GL and Metal)",
     _context_of_the_first_thread(), "test_autograd:without_gradients_the_same_image_is_drawn_and_follows_nothing"),
)  # fmt: skip


_LOSSES: Final[tuple[tuple[Any, ...], ...]] = (
    ("ssim_of_three_channels", "SSIM reads the first three channels",
     _three_channels, "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"),
    ("ssim_of_a_clamped_render", "the render is clamped to [0, 1] before SSIM, as for a metric",
     lambda image, target: (_clamped(image), target),
     "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"),
    ("ssim_of_clamped_pictures", "both pictures are clamped to [0, 1] before SSIM",
     lambda image, target: (_clamped(image), _clamped(target)),
     "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"),
    ("ssim_of_whole_blocks_of_columns", "a grid is rounded down: columns after the last block of 16 are left out",
     _whole_blocks(1, 16),
     "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"),
    ("ssim_of_whole_blocks_of_rows", "a grid is rounded down: rows after the last block of 32 are left out",
     _whole_blocks(0, 32),
     "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"),
    ("ssim_with_a_seam", "at column 32, where a block begins, its neighbour is read twice",
     lambda image, target: (_seam(image), _seam(target)),
     "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"),
    ("ssim_in_units_of_the_range", "values are divided by the range of the target, as skimage's data_range asks for",
     _in_units_of_the_range,
     "test_losses:the_dissimilarity_of_large_pictures_beyond_black_and_white_is_the_oracles"),
    ("objective_of_clamped_renders", "the whole objective sees a clamped render: what is too bright is not pulled back",
     lambda image, target: (_clamped(image), target),
     "test_losses:the_objectives_of_large_pictures_beyond_black_and_white_are_the_oracles",
     ("photometric_pop",)),
    ("objective_of_three_channels", "L1 and SSIM of a picture with an alpha channel leave the alpha out",
     _three_channels,
     "test_losses:the_objectives_of_large_pictures_beyond_black_and_white_are_the_oracles",
     ("photometric_3dgs",)),
)  # fmt: skip

TENSORS: Final = (*(BlackBox(*line) for line in _BOXES), *(Loss(*line) for line in list[Any](_LOSSES)))
