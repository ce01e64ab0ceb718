"""From checked inputs to images and meta: project per image, gather as meta wants it, blend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pop_fast.api.backend import Stages
from pop_fast.api.meta import RenderMeta, intersections
from pop_fast.stages.compositing import Composite
from pop_fast.stages.dominance import dominant_counts
from pop_fast.stages.splatting import ProjectionSettings, Splats


@dataclass(frozen=True)
class Scene:
    """Gaussians and cameras, batch dimensions flattened: B scenes, I = B * cameras images.

    Attributes:
        means: [B, N, 3]
        covars: [B, N, 3, 3]
        opacities: [B, N]
        colors: [B or I, N, D] or [B or I, N, K, 3]
        per_camera: whether `colors` holds one row per image.
        viewmats: [I, 4, 4]
        Ks: [I, 3, 3]
        n_cameras: images per scene.
    """

    means: Tensor
    covars: Tensor
    opacities: Tensor
    colors: Tensor
    per_camera: bool
    viewmats: Tensor
    Ks: Tensor
    n_cameras: int


@dataclass(frozen=True)
class Rows:
    """What one image blends: rows of the tensors in meta, so that gradients pass through those.

    Attributes:
        means2d: [M, 2]
        depths: [M]
        conics: [M, 3]
        opacities: [M]
        colors: [M, D], depth as the last channel where the mode asks for it.
        radii: [M, 2]
        gaussians: the Gaussian of every row, None when row i is Gaussian i.
        absgrad: where |dL/dmeans2d| goes, or None. [M, 2]
    """

    means2d: Tensor
    depths: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    radii: Tensor
    gaussians: Tensor | None
    absgrad: Tensor | None


@dataclass(frozen=True)
class Frame:
    """One call of `rasterization`.

    Attributes:
        scene: Gaussians and cameras.
        image_shape: batch dimensions and cameras.
        view: size, profile and mode; its K is replaced per image.
        tile_size: px.
        sh_degree: bands, None for plain colours.
        render_mode: as `rasterization` takes it.
        packed: whether meta holds visible rows only.
        absgrad: whether to sum absolute gradients.
        stages: of the backend.
    """

    scene: Scene
    image_shape: tuple[int, ...]
    view: ProjectionSettings
    tile_size: int
    sh_degree: int | None
    render_mode: str
    packed: bool
    absgrad: bool
    stages: Stages

    def render(self, backgrounds: Tensor | None, dominance: bool, counts: bool) -> tuple[Tensor, Tensor, RenderMeta]:
        """Return images, alphas and meta."""
        splats = self._splats()
        visible = [(s.radii > 0).all(1).nonzero().squeeze(1) for s in splats]
        colors = self._colors(visible)
        meta, rows = self._packed(splats, visible, colors) if self.packed else self._unpacked(splats, colors)
        blends = [self._blend(r, dominance, counts) for r in rows]
        images = self._stacked([self._finish(i, blend, backgrounds) for i, blend in enumerate(blends)])
        alphas = self._stacked([blend.alphas[..., None] for blend in blends])
        meta["final_T"] = 1.0 - alphas.detach()[..., 0]
        meta["n_pairs"] = sum(blend.n_pairs for blend in blends)
        self._add_instruments(meta, rows, blends, dominance, counts)
        return images, alphas, meta

    def _splats(self) -> list[Splats]:
        scene, n = self.scene, self.scene.n_cameras
        scenes = list(zip(_items(scene.means), _items(scene.covars), _items(scene.opacities), strict=True))
        return [
            self.stages.project(*scenes[i // n], viewmat, replace(self.view, K=K))
            for i, (viewmat, K) in enumerate(zip(_items(scene.viewmats), scene.Ks, strict=True))
        ]

    def _colors(self, visible: list[Tensor]) -> list[Tensor]:
        scene, n, degree = self.scene, self.scene.n_cameras, self.sh_degree
        given = _items(scene.colors)
        colors = given if scene.per_camera else [given[i // n] for i in range(len(visible))]
        if degree is None:
            return colors
        means, viewmats = _items(scene.means), _items(scene.viewmats)
        color = self.stages.colors_of_view
        return [color(colors[i], means[i // n], viewmats[i], degree, rows) for i, rows in enumerate(visible)]

    def _unpacked(self, splats: list[Splats], colors: list[Tensor]) -> tuple[RenderMeta, list[Rows]]:
        names = ("means2d", "depths", "conics", "opacities", "radii")
        stacked = {name: self._stacked([getattr(s, name) for s in splats]) for name in names}
        meta = self._meta(stacked, {"batch_ids": None, "camera_ids": None, "gaussian_ids": None})
        sink = self._sink(meta["means2d"])
        last_outer = len(self.image_shape) - 1
        items = {name: _items(tensor.flatten(0, last_outer)) for name, tensor in stacked.items()}
        sinks = [None] * len(splats) if sink is None else _items(sink.flatten(0, last_outer))
        return meta, [
            self._rows({name: tensors[i] for name, tensors in items.items()}, colors[i], None, sinks[i])
            for i in range(len(splats))
        ]

    def _packed(
        self, splats: list[Splats], visible: list[Tensor], colors: list[Tensor]
    ) -> tuple[RenderMeta, list[Rows]]:
        names = ("means2d", "depths", "conics", "opacities", "radii")
        joined = {
            name: torch.cat([getattr(s, name)[v] for s, v in zip(splats, visible, strict=True)]) for name in names
        }
        sizes = [len(v) for v in visible]
        image = torch.repeat_interleave(torch.tensor(sizes))
        n_cameras = self.scene.n_cameras
        ids = {"batch_ids": image // n_cameras, "camera_ids": image % n_cameras, "gaussian_ids": torch.cat(visible)}
        meta = self._meta(joined, ids)
        sink = self._sink(meta["means2d"])
        ends = torch.tensor(sizes).cumsum(0).tolist()
        rows: list[Rows] = []
        for i, (end, size, gaussians) in enumerate(zip(ends, sizes, visible, strict=True)):
            part = slice(end - size, end)
            own = {name: tensor[part] for name, tensor in joined.items()}
            rows.append(self._rows(own, colors[i][gaussians], gaussians, None if sink is None else sink[part]))
        return meta, rows

    def _meta(self, splats: dict[str, Tensor], ids: dict[str, Any]) -> RenderMeta:
        view, size = self.view, self.tile_size
        tiles = {"tile_width": -(-view.width // size), "tile_height": -(-view.height // size), "tile_size": size}
        counts = {"n_batches": len(self.scene.means), "n_cameras": self.scene.n_cameras}
        return RenderMeta({**ids, **splats, **tiles, **counts, "width": view.width, "height": view.height})

    def _sink(self, means2d: Tensor) -> Tensor | None:
        if not self.absgrad:
            return None
        sink = torch.zeros_like(means2d, memory_format=torch.contiguous_format).detach()
        means2d.absgrad = sink  # type: ignore[attr-defined]
        return sink

    def _rows(self, splat: dict[str, Tensor], colors: Tensor, gaussians: Tensor | None, sink: Tensor | None) -> Rows:
        if self.render_mode != "RGB":
            depth = splat["depths"][:, None]
            colors = depth if self.render_mode in ("D", "ED") else torch.cat((colors, depth), 1)
        return Rows(**splat, colors=colors, gaussians=gaussians, absgrad=sink)

    def _blend(self, rows: Rows, dominance: bool, counts: bool) -> Composite:
        width, height, profile = self.view.width, self.view.height, self.view.profile
        # counting visited entries needs the asked-for tiles and their full lists; without it, entries that reach no
        # pixel are left out, and small splats are listed in small tiles
        exact = {} if counts else {"conics": rows.conics.detach(), "opacities": rows.opacities.detach()}
        size = self.tile_size if counts or profile.extent == "square" else self.stages.blend_tile(rows.radii)
        lists = self.stages.tile_lists(
            rows.means2d.detach(), rows.radii, rows.depths.detach(), width, height, size, profile, **exact
        )
        return self.stages.composite(
            rows.means2d,
            rows.conics,
            rows.opacities,
            rows.colors,
            lists,
            width,
            height,
            profile,
            dominance=dominance,
            counts=counts,
            absgrad_sink=rows.absgrad,
        )

    def _finish(self, i: int, blend: Composite, backgrounds: Tensor | None) -> Tensor:
        image = blend.image
        n_plain = image.shape[-1] - (self.render_mode != "RGB")
        if backgrounds is not None and n_plain > 0:
            background = backgrounds.reshape(len(self.scene.viewmats), n_plain)[i]
            behind = (1.0 - blend.alphas)[..., None] * background
            image = torch.cat((image[..., :n_plain] + behind, image[..., n_plain:]), -1)
        if self.render_mode.endswith("ED"):
            expected = image[..., -1:] / blend.alphas[..., None].clamp_min(1e-10)
            image = torch.cat((image[..., :-1], expected), -1)
        return image

    def _add_instruments(
        self, meta: RenderMeta, rows: list[Rows], blends: list[Composite], dominance: bool, counts: bool
    ) -> None:
        n = self.scene.means.shape[1]

        def dominant(of: list[Composite]) -> dict[str, Tensor]:
            ids = [_as_gaussians(blend.dominant_ids, r.gaussians) for blend, r in zip(of, rows, strict=True)]
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
            return [self._blend(r, with_dominance, not with_dominance) for r in rows]

        view, size = self.view, self.tile_size
        geometry = [(r.means2d.detach(), r.radii, r.depths.detach()) for r in rows]
        if dominance:
            meta.update(dominant(blends))
        else:
            meta.defer(("dominant_ids", "dominant_weights", "dominant_counts"), lambda: dominant(again(True)))
        if counts:
            meta.update(counted(blends))
        else:
            meta.defer(("n_contrib", "n_traversed"), lambda: counted(again(False)))
        meta.defer(
            ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"),
            lambda: intersections(geometry, self.image_shape, view.width, view.height, size, view.profile),
        )

    def _stacked(self, tensors: list[Tensor]) -> Tensor:
        joined = tensors[0][None] if len(tensors) == 1 else torch.stack(tensors)
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
