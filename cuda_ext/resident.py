"""Photographs and cameras that stay on the GPU: bytes, masks, and the blurred values that SSIM needs every time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import VIEW, empty, fill, new_state, stream_of

MARGIN = 5  # px, half of SSIM's window


class ResidentViews:
    """All training views on the device.

    Args:
        images: uint8 [H, W, 3] each, on any device.
        viewmats: world -> camera. [V, 4, 4]
        Ks: intrinsics, px. [V, 3, 3]
        masks: bool [H, W] each, True keeps, or None; one list entry a view, or None for no masks at all.
        padding: SSIM's border, "valid" or "same".
        device: the GPU.
        cache_moments: keep the photographs' blurred values, 24 bytes a pixel.

    Raises:
        ValueError: a photograph is not uint8 [H, W, 3], or too small for "valid".
        CudaMemoryError: no room.
    """

    def __init__(
        self,
        images: Sequence[Tensor],
        viewmats: Tensor,
        Ks: Tensor,
        masks: Sequence[Tensor | None] | None,
        padding: str,
        device: torch.device,
        cache_moments: bool = True,
    ) -> None:
        self.device, self._margin = device, MARGIN if padding == "valid" else 0
        self.sizes: list[tuple[int, int]] = []
        for k, image in enumerate(images):
            if image.dtype != torch.uint8 or image.dim() != 3 or image.shape[2] != 3:
                raise ValueError(f"images[{k}] is {image.dtype} {list(image.shape)}; it must be uint8 [H, W, 3]")
            if min(image.shape[:2]) <= 2 * self._margin:
                raise ValueError(f"images[{k}] is {list(image.shape[:2])} px; SSIM with padding 'valid' needs 11 x 11")
            self.sizes.append((image.shape[1], image.shape[0]))
        self.viewmats = viewmats.to(device, torch.float32).contiguous()
        self.Ks = Ks.to(device, torch.float32).contiguous()
        self._images = [image.to(device).contiguous() for image in images]
        kept = [None] * len(images) if masks is None else list(masks)
        self._masks = [self._mask(mask, image) for mask, image in zip(kept, images, strict=True)]
        self._shares = torch.tensor([self._share(mask) for mask in self._masks], dtype=torch.float32, device=device)
        self._tables = {"images": self._table(self._images)}
        if masks is not None:
            self._tables["masks"] = self._table(self._masks)
        if cache_moments:
            self._moments = [
                empty("the photographs' blurred values", "their size, or use cache_moments=False", (6, h, w), device)
                for w, h in self.sizes
            ]
            self._tables["moments"] = self._table(self._moments)
            self._fill_moments()

    def photographs(self) -> Any:
        """Return the kernels' view of the tables."""
        tables = {name: self._tables.get(name) for name in ("images", "masks", "moments")}
        return fill(load().Photographs(), shares=self._shares, **tables)

    def _mask(self, mask: Tensor | None, image: Tensor) -> Tensor:
        if mask is None:
            return torch.ones(image.shape[:2], dtype=torch.uint8, device=self.device)
        return mask.to(self.device, torch.uint8).contiguous()

    def _share(self, mask: Tensor) -> tuple[float, float]:
        m = self._margin
        windows = mask[m : mask.shape[0] - m, m : mask.shape[1] - m]
        pixels, inner = int(mask.count_nonzero()), int(windows.count_nonzero())
        return 1.0 / max(3 * pixels, 1), 1.0 / (3 * inner) if inner else 0.0

    def _table(self, tensors: Sequence[Tensor]) -> Tensor:
        return torch.tensor([tensor.data_ptr() for tensor in tensors], dtype=torch.int64, device=self.device)

    def _fill_moments(self) -> None:
        kernels, state = load(), new_state(self.device)
        settings = fill(kernels.LossSettings(), margin=self._margin)
        for k, (width, height) in enumerate(self.sizes):
            state[VIEW] = k
            # the render plays no part in the photograph's blurred values; any image of that size will do
            blank = torch.zeros((height, width, 3), device=self.device)
            loss = fill(kernels.LossArrays(), image=blank, width=width, height=height)
            kernels.target_moments(self.photographs(), loss, settings, state.data_ptr(), stream_of(self.device))
