"""From checked inputs to images and meta: project per image, gather as meta wants it, blend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pop_fast.api.backend import ViewStages
from pop_fast.api.meta import RenderMeta, intersections
from pop_fast.stages.compositing import Composite, dominant_counts
from pop_fast.stages.splatting import ProjectionSettings, Splats, colors_of

_GATHERED = ("means2d", "depths", "conics", "opacities", "radii")


@dataclass(frozen=True)
class BatchedScene:
    """Gaussians and cameras, batch dimensions flattened: B scenes, I = B * cameras images.

    Attributes:
        means: [B, N, 3]
        quats: [B, N, 4], None where covariances were given.
        scales: [B, N, 3], likewise.
        covars: [B, N, 3, 3], None where quaternions and scales were given.
        opacities: [B, N]
        colors: [B or I, N, D] or [B or I, N, K, 3]
        per_camera: whether `colors` holds one row per image.
        viewmats: [I, 4, 4]
        Ks: [I, 3, 3]
        n_cameras: images per scene.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor
    per_camera: bool
    viewmats: Tensor
    Ks: Tensor
    n_cameras: int


@dataclass(frozen=True)
class Image:
    """What one image blends.

    Attributes:
        rows: of the tensors in meta, so that gradients pass through those; depth is the last channel of the colours
            where the mode asks for it.
        seen: all Gaussians as the camera sees them.
        settings: of the view.
        gaussians: the Gaussian of every row, None when row i is Gaussian i.
        absgrad: where |dL/dmeans2d| goes, or None. [M, 2]
    """

    rows: Splats
    seen: Splats
    settings: ProjectionSettings
    gaussians: Tensor | None
    absgrad: Tensor | None


@dataclass(frozen=True)
class RasterizationCall:
    """One call of `rasterization`.

    Attributes:
        scene: Gaussians and cameras.
        image_shape: batch dimensions and cameras.
        settings: size, profile and mode; its K is replaced per image.
        tile_size: px.
        sh_degree: bands, None for plain colours.
        render_mode: as `rasterization` takes it.
        packed: whether meta holds visible rows only.
        absgrad: whether to sum absolute gradients.
        stages: of the backend.
    """

    scene: BatchedScene
    image_shape: tuple[int, ...]
    settings: ProjectionSettings
    tile_size: int
    sh_degree: int | None
    render_mode: str
    packed: bool
    absgrad: bool
    stages: ViewStages

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
        def again(with_dominance: bool) -> list[Composite]:
            return [self._blend(image, None, with_dominance, not with_dominance) for image in images]

        def overlaps() -> dict[str, Any]:
            lists = [self.stages.tile_lists(image.rows, image.settings, self.tile_size) for image in images]
            return intersections(lists, [image.rows.depths for image in images], self.image_shape)

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
