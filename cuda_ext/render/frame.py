"""From checked inputs to images and meta: project per camera, gather as meta wants rows, list, blend."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cuda_ext.arrays import Settings, new_state
from cuda_ext.render.autograd import Blend, Project, RenderStats
from cuda_ext.render.intersections import intersections
from cuda_ext.render.lists import TileBuffers, list_tile, make_lists, splat_struct


class Meta(dict[str, Any]):
    """A dict whose costly values are computed when one of them is first read."""

    def __init__(self, ready: dict[str, Any], later: dict[tuple[str, ...], Callable[[], dict[str, Any]]]) -> None:
        super().__init__(ready)
        self._later = {key: make for keys, make in later.items() for key in keys if key not in ready}

    def __missing__(self, key: str) -> Any:
        if key not in self._later:
            raise KeyError(key)
        with torch.cuda.device_of(self["means2d"]):
            self.update(self._later[key]())
        return self[key]

    def __contains__(self, key: object) -> bool:
        return super().__contains__(key) or key in self._later

    def __iter__(self) -> Iterator[str]:
        return iter({**dict.fromkeys(super().__iter__()), **self._later})

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value, computing it if it is still to come, or `default`."""
        if key not in self:
            return default
        return self[key]


@dataclass
class Image:
    """One camera's splats, ready to be blended.

    Attributes:
        means2d, depths, conics, opacities, colors, radii: rows to blend.
        gaussians: the Gaussian of each row, None when row i is Gaussian i.
        sink: where |v_means2d| goes, or None.
        state: the device's flags.
        buffers: the lists that were blended.
    """

    means2d: Tensor
    depths: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    radii: Tensor
    gaussians: Tensor | None
    sink: Tensor | None
    state: Tensor
    buffers: TileBuffers | None

    def lists(self, settings: Settings, counted: bool) -> TileBuffers:
        """List the rows by tile."""
        tile, exact = list_tile(settings, counted)
        splats = splat_struct(
            self.means2d.detach().contiguous(),
            self.depths.detach().contiguous(),
            self.conics.detach().contiguous(),
            self.opacities.detach().contiguous(),
            self.radii.contiguous(),
            None,
        )
        return make_lists(settings, splats, len(self.depths), self.depths.device, tile, exact, self.state)


class Call:
    """One call of `rasterization`."""

    def __init__(self, settings: Settings, render_mode: str, packed: bool) -> None:
        self.settings, self.render_mode, self.packed = settings, render_mode, packed
        self.meta: dict[str, Any] = {}

    def project(
        self, scene: tuple[Tensor, ...], colors: Tensor, per_camera: bool, viewmats: Tensor, Ks: Tensor
    ) -> list[Image]:
        """Project into every camera, and gather rows as meta wants them."""
        projected: list[tuple[Tensor, ...]] = []
        for c in range(len(viewmats)):
            own = colors[c] if per_camera else colors
            sh = own if self.settings.sh_degree is not None else None
            state = new_state(own.device)
            *splat, shaded = Project.apply(*scene, sh, viewmats[c], Ks[c], self.settings, state)
            projected.append((*splat, shaded if sh is not None else own, state))
        return self._gathered(projected)

    def _gathered(self, projected: list[tuple[Tensor, ...]]) -> list[Image]:
        names = ("means2d", "depths", "conics", "opacities", "radii")
        visible = [(p[4] > 0).all(1).nonzero().squeeze(1) for p in projected] if self.packed else None
        ids = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
        if visible is None:
            joined = {name: torch.stack([p[k] for p in projected]) for k, name in enumerate(names)}
        else:
            joined = {
                name: torch.cat([p[k][v] for p, v in zip(projected, visible, strict=True)])
                for k, name in enumerate(names)
            }
            camera = torch.cat([torch.full_like(v, c) for c, v in enumerate(visible)])
            ids = {"batch_ids": torch.zeros_like(camera), "camera_ids": camera, "gaussian_ids": torch.cat(visible)}
        self.meta = {**ids, **joined}
        sink = torch.zeros_like(joined["means2d"]).detach() if self.settings.absgrad else None
        if sink is not None:
            joined["means2d"].absgrad = sink  # type: ignore[attr-defined]
        images: list[Image] = []
        start = 0
        for c, p in enumerate(projected):
            rows = None if visible is None else visible[c]
            part: Any = c if rows is None else slice(start, start + len(rows))
            start += 0 if rows is None else len(rows)
            own = {name: tensor[part] for name, tensor in joined.items()}
            shaded = self._channels(p[5] if rows is None else p[5][rows], own["depths"])
            images.append(Image(**own, colors=shaded, gaussians=rows, sink=_part(sink, part), state=p[6], buffers=None))
        return images

    def _channels(self, colors: Tensor, depths: Tensor) -> Tensor:
        if self.render_mode == "RGB":
            return colors
        return depths[:, None] if self.render_mode in ("D", "ED") else torch.cat((colors, depths[:, None]), 1)

    def blend(
        self, images: list[Image], n: int, backgrounds: Tensor | None, dominance: bool, counts: bool
    ) -> tuple[Tensor, Tensor, Meta]:
        """Blend every image and complete meta."""
        pictures: list[Tensor] = []
        left: list[Tensor] = []
        stats: list[RenderStats] = []
        for c, image in enumerate(images):
            image.buffers = image.lists(self.settings, counts)
            behind = self._behind(image, None if backgrounds is None else backgrounds[c])
            instruments = self._instruments(image) if dominance or counts else None
            picture, T_final = self._blended(image, behind, instruments)
            stats += [] if instruments is None else [instruments]
            pictures.append(self._finished(picture, T_final))
            left.append(T_final)
        T = torch.stack(left)
        ready = {**self.meta, **self._plain(len(images)), "final_T": T.detach()}
        later = self._later(images, n)
        if dominance:
            ready |= self._dominance(images, stats, n)
        if counts:
            ready |= self._counts(stats)
        return torch.stack(pictures), (1.0 - T)[..., None], Meta(ready, later)

    def _behind(self, image: Image, background: Tensor | None) -> Tensor | None:
        if background is None or self.render_mode in ("D", "ED"):
            return None
        missing = image.colors.shape[1] - len(background)
        return torch.cat((background, background.new_zeros(missing))) if missing else background

    def _blended(self, image: Image, behind: Tensor | None, stats: RenderStats | None) -> tuple[Tensor, Tensor]:
        # any number of channels, by the widths that the kernels are made for; gradients add up by themselves
        pieces: list[Tensor] = []
        T_final: Tensor | None = None
        channels = image.colors.shape[1]
        if channels > 4 and self.settings.absgrad:
            raise NotImplementedError("absgrad with more than 4 channels: absolute sums of pieces do not add up")
        for first in range(0, channels, 4):
            width = min(4, channels - first)
            colors = image.colors[:, first : first + width]
            own = None if behind is None else behind[first : first + width]
            if width == 2:
                colors = torch.cat((colors, colors.new_zeros(len(colors), 1)), 1)
                own = None if own is None else torch.cat((own, own.new_zeros(1)))
            rows = (image.means2d, image.conics, image.opacities, colors, own)
            # every piece leaves the same light; the first one carries its gradient
            instruments = stats if first == 0 else None
            picture, T = Blend.apply(*rows, image.buffers, self.settings, image.state, instruments, image.sink)
            pieces.append(picture[..., :width])
            T_final = T if T_final is None else T_final
        assert T_final is not None
        return pieces[0] if len(pieces) == 1 else torch.cat(pieces, -1), T_final

    def _finished(self, picture: Tensor, T_final: Tensor) -> Tensor:
        if not self.render_mode.endswith("ED"):
            return picture
        expected = picture[..., -1:] / (1.0 - T_final)[..., None].clamp_min(1e-10)
        return torch.cat((picture[..., :-1], expected), -1)

    def _instruments(self, image: Image) -> RenderStats:
        shape, device = (self.settings.height, self.settings.width), image.depths.device
        maps = [torch.empty(shape, dtype=torch.int32, device=device) for _ in range(3)]
        weights = torch.empty(shape, device=device)
        won = torch.zeros(max(len(image.depths), 1), dtype=torch.int32, device=device)
        return RenderStats(maps[0], weights, maps[1], maps[2], won)

    def _plain(self, n_cameras: int) -> dict[str, Any]:
        s = self.settings
        tiles = {"tile_width": -(-s.width // s.tile_size), "tile_height": -(-s.height // s.tile_size)}
        size = {"width": s.width, "height": s.height, "tile_size": s.tile_size}
        return {**tiles, **size, "n_cameras": n_cameras, "n_batches": 1}

    def _dominance(self, images: list[Image], stats: list[RenderStats], n: int) -> dict[str, Any]:
        ids: list[Tensor] = []
        won: list[Tensor] = []
        for image, found in zip(images, stats, strict=True):
            rows, total = found.dominant_ids.long(), found.dominant_counts[: len(image.depths)].long()
            if image.gaussians is not None:
                rows = torch.cat((image.gaussians, image.gaussians.new_tensor([-1])))[rows]
                total = torch.zeros(n, dtype=torch.int64, device=rows.device).index_add_(0, image.gaussians, total)
            ids.append(rows)
            won.append(total)
        weights = torch.stack([found.dominant_weights for found in stats])
        return {
            "dominant_ids": torch.stack(ids),
            "dominant_weights": weights,
            "dominant_counts": torch.stack(won),
        }

    def _counts(self, stats: list[RenderStats]) -> dict[str, Any]:
        return {**self._blended_counts(stats), "n_traversed": torch.stack([found.n_traversed for found in stats])}

    def _blended_counts(self, stats: list[RenderStats]) -> dict[str, Any]:
        # unlike the entries that are visited, those that are blended do not depend on the lists' tiles
        return {"n_contrib": torch.stack([found.n_blended for found in stats])}

    def _later(self, images: list[Image], n: int) -> dict[tuple[str, ...], Callable[[], dict[str, Any]]]:
        @torch.no_grad()
        def again(counted: bool) -> list[RenderStats]:
            stats = [self._instruments(image) for image in images]
            for image, found in zip(images, stats, strict=True):
                buffers = image.lists(self.settings, counted)
                colors = image.colors[:, :1].contiguous()
                rows = (image.means2d, image.conics, image.opacities, colors, None)
                Blend.apply(*rows, buffers, self.settings, image.state, found, None)
            return stats

        return {
            ("dominant_ids", "dominant_weights", "dominant_counts"): lambda: self._dominance(images, again(False), n),
            ("n_contrib",): lambda: self._blended_counts(again(False)),
            ("n_traversed",): lambda: self._counts(again(True)),
            ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets"): lambda: intersections(
                self.settings, images
            ),
        }


def _part(tensor: Tensor | None, part: Any) -> Tensor | None:
    return None if tensor is None else tensor[part]
