"""`rasterization()`: gsplat's drop-in, on CPUs and on the GPU, judged by the oracle.

Checked inputs are projected image by image, gathered as meta wants them, and blended. What of meta costs another pass
is computed when it is first read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, Literal, ParamSpec, Self, TypeVar

import torch
from torch import Tensor

from pop_fast.api.backend import Backend, ViewStages, fastest_backend, require_backend
from pop_fast.api.checks import (
    RASTERIZE_MODES,
    RENDER_MODES,
    Checks,
    check_choice,
    check_given,
    check_numbers,
    check_sizes,
    check_supported,
    resolved_profile,
)
from pop_fast.stages.compositing import Composite, dominant_counts
from pop_fast.stages.splatting import ProjectionSettings, Splats, colors_of
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import Profile

P = ParamSpec("P")
T = TypeVar("T")


def _untraced(function: Callable[P, T]) -> Callable[P, T]:
    """Make a function that `torch.compile` calls as it is: tracing all that it calls would take minutes."""

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        run: Any = torch.compiler.disable(function) if torch.compiler.is_compiling() else function
        return run(*args, **kwargs)

    return called


@_untraced
def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = 16,
    backgrounds: Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    *,
    profile: str | Profile = "paper",
    dominance: bool = False,
    counts: bool = False,
    backend: str | Backend = "auto",
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render Gaussians into C images, with gsplat 1.5.3's signature, results and meta keys.

    Differentiable in means, quats, scales, opacities, colors, viewmats, covars and backgrounds; not in Ks.

    Args:
        means: centres, world units. [..., N, 3]
        quats: rotations wxyz, any norm > 0. [..., N, 4]
        scales: standard deviations, world units. [..., N, 3]
        opacities: in [0, 1]. [..., N]
        colors: any number of channels [..., (C,) N, D], or harmonics [..., (C,) N, K, 3] when `sh_degree` is given.
        viewmats: world -> camera, OpenCV. [..., C, 4, 4]
        Ks: intrinsics, px. [..., C, 3, 3]
        width, height: px.
        near_plane, far_plane: world units; gsplat's default value selects the profile's own.
        radius_clip: px; splats with both extents at most this are culled.
        eps2d: low-pass, px^2; gsplat's default value selects the profile's own.
        sh_degree: bands to evaluate, or None when `colors` are colours.
        packed: whether meta holds rows of visible (camera, Gaussian) pairs only.
        tile_size: px, up to 4096, None for 16; the image does not depend on it, except in profile "inria".
        backgrounds: colours behind everything, without depth. [..., C, D]
        render_mode: colours, depth (D), expected depth (ED), or colours and then depth as the last channel.
        sparse_grad, distributed, segmented, with_ut, with_eval3d: only False.
        absgrad: also sum |dL/dmeans2d| over pixels into `meta["means2d"].absgrad`.
        rasterize_mode: "antialiased" scales opacities by the factor that keeps a blurred splat's energy.
        channel_chunk: accepted and ignored; all channels are blended at once.
        camera_model: only "pinhole".
        covars: covariances instead of quats and scales. [..., N, 3, 3]
        radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, viewmats_rs: only None.
        rolling_shutter: only None, or gsplat's `RollingShutterType.GLOBAL`.
        profile: constants and strictness: "paper", "gsplat_1_5", "gsplat_1_6", "inria", "speedy_splat", the
            name of one that is registered, or a `Profile`.
        dominance: compute the dominance keys of meta in the same pass; otherwise reading them costs a second pass.
        counts: the same for n_contrib and n_traversed.
        backend: a backend, or the name of one. "fast" renders on the CPU with torch, "compiled" on the CPU with kernels
            in C++ (`pop_fast.compiled`), "cuda" on the GPU that holds the tensors (`cuda_ext`), "ref" with the
            oracle, slowly. "auto" takes "cuda" for tensors on a GPU, else "compiled" if it is built, else "fast".

    Returns:
        Images [..., C, H, W, X], not clamped; alphas [..., C, H, W, 1]; meta with gsplat's keys and `dominant_ids`
        (-1 none), `dominant_weights`, `n_contrib` (blended), `n_traversed`, `final_T` [..., C, H, W], and
        `dominant_counts` [..., C, N]; `n_pairs`, evaluated pairs of entry and pixel, where a backend counts them.

    Raises:
        ValueError: an input's shape, type or value is wrong; the message names it and its index.
        NotImplementedError: an argument is not supported, or not by this backend; says why.
        PopError: the backend is unknown or cannot run here; says why and what to do.
    """
    given = dict(locals())
    check_given(means=means, opacities=opacities, colors=colors, viewmats=viewmats, Ks=Ks)
    drawing = fastest_backend(means.device.type) if backend == "auto" else require_backend(backend)
    # gsplat's default is a member of its own enumeration, which need not be imported to be recognized
    if getattr(rolling_shutter, "name", None) == "GLOBAL":
        given["rolling_shutter"] = None
    check_supported(given, drawing)
    check_choice("render_mode", render_mode, RENDER_MODES)
    check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    check_numbers(near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d)
    if not radius_clip >= 0.0:
        raise ValueError(f"radius_clip is {radius_clip}; it must be >= 0 px")
    chosen = resolved_profile(profile, near_plane, far_plane, eps2d)
    # what gsplat's main branch means by None
    tile_size = 16 if tile_size is None else tile_size
    check_sizes(width, height, tile_size)
    if chosen.extent == "square":
        # its cull reads the grid from the profile (D3)
        chosen = replace(chosen, tile_size=tile_size)
    checks = Checks(drawing, means.dtype)
    batch = checks.gaussians(means, quats, scales, opacities, covars)
    n_cameras = checks.cameras(viewmats, Ks, width, height, tile_size, batch)
    per_camera = checks.colors(colors, sh_degree, batch, n_cameras, means.shape[-2])
    if backgrounds is not None:
        shape = (*batch, n_cameras, 3 if sh_degree is not None else colors.shape[-1])
        checks.finite("backgrounds", checks.tensor("backgrounds", backgrounds, shape))
    checks.values()
    n, n_scenes = means.shape[-2], math.prod(batch)
    n_images = n_scenes * n_cameras
    rows = {"quats": quats, "scales": scales} if covars is None else {}
    flat = {name: None if t is None else t.reshape(n_scenes, n, t.shape[-1]) for name, t in rows.items()}
    scene = BatchedScene(
        means=means.reshape(n_scenes, n, 3),
        quats=flat.get("quats"),
        scales=flat.get("scales"),
        covars=None if covars is None else covars.reshape(n_scenes, n, 3, 3),
        opacities=opacities.reshape(n_scenes, n),
        colors=colors.reshape(n_images if per_camera else n_scenes, *colors.shape[len(batch) + per_camera :]),
        per_camera=per_camera,
        viewmats=viewmats.reshape(n_images, 4, 4),
        # the way back reads them too, and may come after the caller has written others there
        Ks=Ks.detach().reshape(n_images, 3, 3).clone(),
        n_cameras=n_cameras,
    )
    settings = ProjectionSettings(Ks, width, height, chosen, rasterize_mode == "antialiased", radius_clip)
    options = (tile_size, sh_degree, render_mode, packed, absgrad)
    frame = RasterizationCall(scene, (*batch, n_cameras), settings, *options, drawing.stages())
    # where others train in mixed precision, cameras and centres keep their digits
    with torch.autocast(means.device.type, enabled=False):
        return frame.render(backgrounds, dominance, counts)


_GATHERED = ("means2d", "depths", "conics", "opacities", "radii")


@dataclass(frozen=True)
class BatchedScene:
    """Gaussians and cameras, batch dimensions flattened: B scenes, I = B * cameras images."""

    means: Tensor  # [B, N, 3]
    quats: Tensor | None  # [B, N, 4], None where covariances were given
    scales: Tensor | None  # [B, N, 3], likewise
    covars: Tensor | None  # [B, N, 3, 3], None where quaternions and scales were given
    opacities: Tensor  # [B, N]
    colors: Tensor  # [B or I, N, D] or [B or I, N, K, 3]
    per_camera: bool  # whether `colors` holds one row per image
    viewmats: Tensor  # [I, 4, 4]
    Ks: Tensor  # [I, 3, 3]
    n_cameras: int  # images per scene


@dataclass(frozen=True)
class Image:
    """What one image blends."""

    # of the tensors in meta, so that gradients pass through those; depth is the last channel of the colours where the
    # mode asks for it
    rows: Splats
    seen: Splats  # all Gaussians as the camera sees them
    settings: ProjectionSettings  # of the view
    gaussians: Tensor | None  # the Gaussian of every row, None when row i is Gaussian i
    absgrad: Tensor | None  # where |dL/dmeans2d| goes, or None. [M, 2]


@dataclass(frozen=True)
class RasterizationCall:
    """One call of `rasterization`."""

    scene: BatchedScene  # Gaussians and cameras
    image_shape: tuple[int, ...]  # batch dimensions and cameras
    settings: ProjectionSettings  # size, profile and mode; its K is replaced per image
    tile_size: int  # px
    sh_degree: int | None  # bands, None for plain colours
    render_mode: str  # as `rasterization` takes it
    packed: bool  # whether meta holds visible rows only
    absgrad: bool  # whether to sum absolute gradients
    stages: ViewStages  # of the backend

    def render(self, backgrounds: Tensor | None, dominance: bool, counts: bool) -> tuple[Tensor, Tensor, RenderMeta]:
        """Return images, alphas and meta."""
        views = [replace(self.settings, K=K) for K in self.scene.Ks]
        seen = self._seen(views)
        meta, images = self._packed(seen, views) if self.packed else self._unpacked(seen, views)
        behind = self._behind(backgrounds, images)
        blends = [
            self._blend(image, background, dominance, counts) for image, background in zip(images, behind, strict=True)
        ]
        alphas = self._stacked([blend.alphas[..., None] for blend in blends])
        meta["final_T"] = 1.0 - alphas.detach()[..., 0]
        pairs = [blend.n_pairs for blend in blends if blend.n_pairs is not None]
        if len(pairs) == len(blends):
            meta["n_pairs"] = sum(pairs)
        self._add_stats(meta, images, blends, dominance, counts)
        return self._stacked([self._finished(blend) for blend in blends]), alphas, meta

    def _seen(self, views: Sequence[ProjectionSettings]) -> list[Splats]:
        scene, n, stages = self.scene, self.scene.n_cameras, self.stages
        if scene.covars is not None:
            shapes = _items(scene.covars)
        else:
            assert scene.quats is not None
            assert scene.scales is not None
            shapes = [stages.covariances(*pair) for pair in zip(_items(scene.quats), _items(scene.scales), strict=True)]
        means, opacities, given = _items(scene.means), _items(scene.opacities), _items(scene.colors)
        return [
            stages.splats(
                *(means[i // n], shapes[i // n], opacities[i // n], given[i if scene.per_camera else i // n]),
                *(viewmat, views[i], self.sh_degree),
            )
            for i, viewmat in enumerate(_items(scene.viewmats))
        ]

    def _unpacked(self, seen: Sequence[Splats], views: Sequence[ProjectionSettings]) -> tuple[RenderMeta, list[Image]]:
        stacked = {name: self._stacked([getattr(s, name) for s in seen]) for name in _GATHERED}
        meta = self._meta(stacked, {"batch_ids": None, "camera_ids": None, "gaussian_ids": None})
        sink = self._sink(meta["means2d"])
        last_outer = len(self.image_shape) - 1
        items = {name: _items(tensor.flatten(0, last_outer)) for name, tensor in stacked.items()}
        sinks = [None] * len(seen) if sink is None else _items(sink.flatten(0, last_outer))
        rows = [{name: tensors[i] for name, tensors in items.items()} for i in range(len(seen))]
        return meta, [
            Image(self._rows(rows[i], colors_of(of)), of, views[i], None, sinks[i]) for i, of in enumerate(seen)
        ]

    def _packed(self, seen: Sequence[Splats], views: Sequence[ProjectionSettings]) -> tuple[RenderMeta, list[Image]]:
        visible = [(s.radii > 0).all(1).nonzero().squeeze(1) for s in seen]
        joined = {
            name: torch.cat([getattr(s, name)[v] for s, v in zip(seen, visible, strict=True)]) for name in _GATHERED
        }
        sizes, n_cameras = [len(v) for v in visible], self.scene.n_cameras
        image = torch.repeat_interleave(torch.tensor(sizes)).to(joined["radii"].device)
        ids = {"batch_ids": image // n_cameras, "camera_ids": image % n_cameras, "gaussian_ids": torch.cat(visible)}
        meta = self._meta(joined, ids)
        sink = self._sink(meta["means2d"])
        ends = torch.tensor(sizes).cumsum(0).tolist()
        images: list[Image] = []
        for i, (end, size, gaussians) in enumerate(zip(ends, sizes, visible, strict=True)):
            part = slice(end - size, end)
            rows = self._rows({name: tensor[part] for name, tensor in joined.items()}, colors_of(seen[i])[gaussians])
            images.append(Image(rows, seen[i], views[i], gaussians, None if sink is None else sink[part]))
        return meta, images

    def _meta(self, splats: dict[str, Tensor], ids: dict[str, Any]) -> RenderMeta:
        view, size = self.settings, self.tile_size
        tiles = {"tile_width": -(-view.width // size), "tile_height": -(-view.height // size), "tile_size": size}
        counts = {"n_batches": len(self.scene.means), "n_cameras": self.scene.n_cameras}
        return RenderMeta({**ids, **splats, **tiles, **counts, "width": view.width, "height": view.height})

    def _sink(self, means2d: Tensor) -> Tensor | None:
        if not self.absgrad:
            return None
        sink = torch.zeros_like(means2d, memory_format=torch.contiguous_format).detach()
        means2d.absgrad = sink  # type: ignore[attr-defined]
        return sink

    def _rows(self, splat: dict[str, Tensor], colors: Tensor) -> Splats:
        if self.render_mode != "RGB":
            depth = splat["depths"][:, None]
            colors = depth if self.render_mode in ("D", "ED") else torch.cat((colors, depth), 1)
        return Splats(**splat, colors=colors)

    def _behind(self, backgrounds: Tensor | None, images: Sequence[Image]) -> list[Tensor | None]:
        """Return what is behind every image: nothing is behind depth."""
        if backgrounds is None or self.render_mode in ("D", "ED"):
            return [None] * len(images)
        flat = backgrounds.reshape(len(images), backgrounds.shape[-1])
        if self.render_mode != "RGB":
            flat = torch.cat((flat, flat.new_zeros((len(images), 1))), 1)
        return list(_items(flat))

    def _blend(self, image: Image, background: Tensor | None, dominance: bool, counts: bool) -> Composite:
        return self.stages.blend(
            *(image.rows, image.seen, image.settings, self.tile_size, background),
            dominance=dominance,
            counts=counts,
            absgrad_sink=image.absgrad,
        )

    def _finished(self, blend: Composite) -> Tensor:
        if not self.render_mode.endswith("ED"):
            return blend.image
        expected = blend.image[..., -1:] / blend.alphas[..., None].clamp_min(1e-10)
        return torch.cat((blend.image[..., :-1], expected), -1)

    def _add_stats(
        self, meta: RenderMeta, images: list[Image], blends: list[Composite], dominance: bool, counts: bool
    ) -> None:
        n = self.scene.means.shape[1]

        def dominant(of: list[Composite]) -> dict[str, Tensor]:
            ids = [_as_gaussians(b.dominant_ids, image.gaussians) for b, image in zip(of, images, strict=True)]
            return {
                "dominant_ids": self._stacked(ids),
                "dominant_weights": self._stacked([_present(blend.dominant_weights) for blend in of]),
                "dominant_counts": self._stacked([dominant_counts(i, n) for i in ids]),
            }

        def counted(of: list[Composite]) -> dict[str, Tensor]:
            return {
                "n_contrib": self._stacked([_present(blend.n_blended) for blend in of]),
                "n_traversed": self._stacked([_present(blend.n_traversed) for blend in of]),
            }

        @torch.no_grad()
        @torch.autocast(self.scene.means.device.type, enabled=False)
        def again(with_dominance: bool) -> list[Composite]:
            return [self._blend(image, None, with_dominance, not with_dominance) for image in images]

        def overlaps() -> dict[str, Any]:
            lists = [self.stages.tile_lists(image.rows, image.settings, self.tile_size) for image in images]
            found = intersections(lists, [image.rows.depths for image in images], self.image_shape)
            if not self.packed:
                found["tiles_per_gauss"] = found["tiles_per_gauss"].view(*self.image_shape, n)
            return found

        if dominance:
            meta.update(dominant(blends))
        if counts:
            meta.update(counted(blends))
        meta.defer(("dominant_ids", "dominant_weights", "dominant_counts"), lambda: dominant(again(True)))
        if self.stages.counts_entries(self.tile_size):
            meta.defer(("n_contrib", "n_traversed"), lambda: counted(again(False)))
        else:
            # unlike the entries that are visited, those that are blended do not depend on the lists' tiles
            meta.defer(
                ("n_contrib",), lambda: {"n_contrib": self._stacked([_present(b.n_blended) for b in again(True)])}
            )
        meta.defer(("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"), overlaps)

    def _stacked(self, tensors: Sequence[Tensor]) -> Tensor:
        joined = tensors[0][None] if len(tensors) == 1 else torch.stack(list(tensors))
        return joined.reshape(*self.image_shape, *tensors[0].shape)


def _items(tensor: Tensor) -> list[Tensor]:
    """Take the first axis apart; a single item stays a view, whose transpose costs nothing."""
    return [tensor.squeeze(0)] if len(tensor) == 1 else list(tensor.unbind(0))


def _present(tensor: Tensor | None) -> Tensor:
    assert tensor is not None
    return tensor


def _as_gaussians(ids: Tensor | None, gaussians: Tensor | None) -> Tensor:
    rows = _present(ids)
    if gaussians is None:
        return rows
    return torch.cat((gaussians, gaussians.new_tensor([-1])))[rows]


class RenderMeta(MutableMapping[str, Any]):
    """A mapping with some values still to be computed: reading one computes it, and all that come with it, once.

    `keys`, `in`, `len` and iteration compute nothing; `items`, `values`, `dict(meta)` and `**meta` compute everything.
    """

    def __init__(self, ready: Mapping[str, Any]) -> None:
        # a key has its place from the first, computed or not
        self._values: dict[str, Any] = dict(ready)
        self._pending: dict[str, Callable[[], Mapping[str, Any]]] = {}

    def defer(self, keys: Iterable[str], compute: Callable[[], Mapping[str, Any]]) -> None:
        """Promise `keys`: `compute` returns all of them when one is read. What is there already stays."""
        for key in keys:
            if key not in self._values:
                self._values[key], self._pending[key] = None, compute

    def __getitem__(self, key: str) -> Any:
        if key in self._pending:
            for name, value in _untraced(self._pending[key])().items():
                # what has been set or computed meanwhile stays as it is
                if self._pending.pop(name, None) is not None:
                    self._values[name] = value
        return self._values[key]

    def __setitem__(self, key: str, value: Any) -> None:
        self._pending.pop(key, None)
        self._values[key] = value

    def __delitem__(self, key: str) -> None:
        self._pending.pop(key, None)
        del self._values[key]

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __or__(self, other: Mapping[str, Any]) -> dict[str, Any]:
        return {**self, **other}

    def __ror__(self, other: Mapping[str, Any]) -> dict[str, Any]:
        return {**other, **self}

    def __ior__(self, other: Mapping[str, Any]) -> Self:
        self.update(other)
        return self

    def __repr__(self) -> str:
        return f"RenderMeta({list(self)}, to be computed when read: {list(self._pending)})"

    def changed(self, change: Callable[[Any], Any]) -> RenderMeta:
        """Return a mapping with the same keys, whose values are fetched from here, and changed, when they are read."""
        made = RenderMeta({})
        for key in self:
            made.defer((key,), lambda key=key: {key: change(self[key])})
        return made


def intersections(lists: Sequence[TileLists], depths: Sequence[Tensor], image_shape: tuple[int, ...]) -> dict[str, Any]:
    """Return tile overlaps as gsplat's meta has them, from the extents alone (D3).

    Args:
        lists: of every image's rows, one after the other in the flattened order.
        depths: of the rows. [M] each
        image_shape: batch dimensions and cameras.

    Returns:
        tiles_per_gauss [all rows], isect_ids, flatten_ids, isect_offsets.
    """
    per_gauss: list[Tensor] = []
    ids: list[Tensor] = []
    flat: list[Tensor] = []
    offsets: list[Tensor] = []
    before, row = 0, 0
    for number, (found, depth) in enumerate(zip(lists, depths, strict=True)):
        per_gauss.append(torch.bincount(found.ids, minlength=len(depth)).to(torch.int32))
        ids.append(_isect_ids(found, depth, number))
        flat.append((found.ids + row).to(torch.int32))
        offsets.append((found.offsets[:-1] + before).to(torch.int32))
        before += len(found.ids)
        row += len(depth)
    return {
        "tiles_per_gauss": torch.cat(per_gauss),
        "isect_ids": torch.cat(ids),
        "flatten_ids": torch.cat(flat),
        "isect_offsets": torch.stack(offsets).reshape(*image_shape, lists[0].tiles_y, lists[0].tiles_x),
    }


def _isect_ids(lists: TileLists, depths: Tensor, image: int) -> Tensor:
    """Pack image, tile and the bits of the float32 depth into one integer, as gsplat sorts them."""
    tile_bits = math.floor(math.log2(lists.tiles_x * lists.tiles_y)) + 1
    bits = depths.detach().to(torch.float32).contiguous().view(torch.int32).to(torch.int64)[lists.ids]
    return (image << (32 + tile_bits)) | (lists.entry_tiles << 32) | bits
