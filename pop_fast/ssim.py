"""SSIM with its gradient in the same pass. Meaning: `pop_ref.ssim`.

How it is made fast on a CPU:

    layout     an image [H, W, D] is the matrix [H, W D]: rows are neighbours at distance 1, columns at distance D, so
               no channel is ever moved, and every operation runs along contiguous memory;
    blur       two times eleven scaled additions of shifted views. Measured on two cores at 270 x 480 x 3 for the three
               maps of a render: 1.2 ms, against 3.3 ms for an 11 x 11 depthwise convolution, 3.0 ms for two 11-tap
               ones, and 0.8 ms for a depthwise convolution over 1440 "channels", which loses its lead to layout
               changes around it and has no fast float64 path;
    bands      the picture is worked through in bands of rows whose temporaries stay in the cache (3 times faster than
               whole-image passes at one megapixel);
    moments    Σ w y and Σ w y² of the photograph are kept by `TargetMoments`: three maps are blurred instead of five;
    gradient   the partial derivatives are at hand when S is, so backward is one more blur of three maps and is done
               right away: autograd keeps a single image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Padding = Literal["valid", "same"]

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
# values per band and map, 1 MB in float32: smaller bands are too short for the threads, larger ones leave the caches
_BAND_VALUES = 1 << 18
_REACH = WINDOW_SIZE - 1


def gaussian_window() -> Tensor:
    """See `pop_ref.ssim.gaussian_window`. [11, 11] float64"""
    return torch.outer(*[torch.tensor(_TAPS, dtype=torch.float64)] * 2)


def _taps() -> list[float]:
    offsets = torch.arange(WINDOW_SIZE, dtype=torch.float64) - WINDOW_SIZE // 2
    falloff = torch.exp(-(offsets**2) / (2.0 * WINDOW_SIGMA**2))
    return (falloff / falloff.sum()).tolist()


_TAPS = _taps()


@dataclass(frozen=True)
class TargetMoments:
    """A photograph and what SSIM needs to know about it; make it once per view with `target_moments`.

    Attributes:
        target: the photograph. [H, W, D]
        padding: "valid" or "same".
        mu_y: Σ w y. [h, w D]
        s_yy: Σ w y² - mu_y². [h, w D]
    """

    target: Tensor
    padding: Padding
    mu_y: Tensor
    s_yy: Tensor


def target_moments(target: Tensor, padding: Padding = "valid") -> TargetMoments:
    """Blur a photograph and its square, for any number of renders to be compared with it."""
    check_size(target, padding)
    channels, border = target.shape[2], _border(padding)
    y = target.reshape(target.shape[0], -1)
    padded = torch.nn.functional.pad(y, (border * channels, border * channels, border, border))
    mu_y, yy = _blur(torch.stack([padded, padded * padded]), channels).unbind(0)
    return TargetMoments(target, padding, mu_y, yy.addcmul_(mu_y, mu_y, value=-1.0))


def ssim_map(image: Tensor, target: Tensor, padding: Padding = "valid") -> Tensor:
    """See `pop_ref.ssim.ssim_map`.

    Optimizations: bands of rows, see the module's docstring.
    """
    moments = target_moments(target.to(image.dtype), padding)
    x, y = image.reshape(image.shape[0], -1), moments.target.reshape(image.shape[0], -1)
    bands = [_compare_rows(x, y, moments, band, 0.0)[0] for band in _bands(*moments.mu_y.shape)]
    return torch.cat(bands).reshape(len(moments.mu_y), -1, image.shape[2])


def mean_similarity(
    image: Tensor, moments: TargetMoments, mask: Tensor | None, weight: float, want_grad: bool
) -> tuple[Tensor, Tensor | None]:
    """Return the mean of S over the kept windows, and the gradient of `weight` times it by the image.

    Args:
        image: the render, already replaced by the photograph where the mask is False. [H, W, D]
        moments: of the photograph.
        mask: True where a window's centre counts, or None. [H, W]
        weight: factor on the gradient only.
        want_grad: False returns None as gradient.
    """
    height, channels = image.shape[0], image.shape[2]
    x, y = image.reshape(height, -1), moments.target.reshape(height, -1)
    kept = None if mask is None else _kept_windows(mask, moments.padding, channels, image.dtype)
    n = moments.mu_y.numel() if kept is None else int(kept.sum())
    if n == 0:
        return image.new_ones(()), torch.zeros_like(image) if want_grad else None
    total = image.new_zeros((), dtype=torch.float64)
    margin = _REACH - _border(moments.padding)
    rows, cols = moments.mu_y.shape
    partials = x.new_zeros((3, rows + 2 * margin, cols + 2 * margin * channels)) if want_grad else None
    for band in _bands(rows, cols):
        similarity, v_band = _compare_rows(x, y, moments, band, weight / n)
        if kept is not None:
            similarity, v_band = similarity.mul_(kept[band]), [v.mul_(kept[band]) for v in v_band]
        total += similarity.sum(dtype=torch.float64)
        if partials is not None:
            inner = partials[:, margin + band.start : margin + band.stop, margin * channels : margin * channels + cols]
            for plane, v in zip(inner, v_band, strict=True):
                plane.copy_(v)
    value = (total / n).to(image.dtype)
    return value, None if partials is None else _spread(x, y, partials, channels).reshape(image.shape)


def check_size(image: Tensor, padding: Padding) -> None:
    """Raise ValueError when `padding` is unknown, or "valid" finds no whole window."""
    if padding not in ("valid", "same"):
        raise ValueError(f"padding is {padding!r}; it must be 'valid' or 'same'")
    height, width = image.shape[:2]
    if padding == "valid" and min(height, width) < WINDOW_SIZE:
        raise ValueError(
            f"image is {height} x {width} px; SSIM with padding 'valid' needs at least "
            f"{WINDOW_SIZE} x {WINDOW_SIZE}: use padding='same' or a larger image"
        )


def _border(padding: Padding) -> int:
    return WINDOW_SIZE // 2 if padding == "same" else 0


def _bands(rows: int, cols: int) -> list[slice]:
    height = max(_BAND_VALUES // max(cols, 1), WINDOW_SIZE)
    return [slice(first, min(first + height, rows)) for first in range(0, rows, height)]


def _blur(maps: Tensor, channels: int) -> Tensor:
    """Sum maps [M, H, L] under every whole window: [M, H - 10, L - 10 channels]."""
    rows, cols = maps.shape[1] - _REACH, maps.shape[2] - _REACH * channels
    down = maps[:, :rows] * _TAPS[0]
    for i in range(1, WINDOW_SIZE):
        down.add_(maps[:, i : i + rows], alpha=_TAPS[i])
    across = down[:, :, :cols] * _TAPS[0]
    for i in range(1, WINDOW_SIZE):
        across.add_(down[:, :, i * channels : i * channels + cols], alpha=_TAPS[i])
    return across


def _compare_rows(
    x: Tensor, y: Tensor, moments: TargetMoments, band: slice, weight: float
) -> tuple[Tensor, list[Tensor]]:
    """Return S for a band of the map's rows, and weight times its derivatives by mu_x, (Σ w x²) / 2 and Σ w x y."""
    channels, border = moments.target.shape[2], _border(moments.padding)
    mu_x, xx, xy = _blur(_products(x, y, band, border, channels), channels).unbind(0)
    mu_y, s_yy = moments.mu_y[band], moments.s_yy[band]
    mu_xy, mu_xx = mu_x * mu_y, mu_x * mu_x
    A1 = torch.add(mu_xy, mu_xy).add_(C1)
    A2 = xy.sub_(mu_xy).mul_(2.0).add_(C2)
    B1 = torch.addcmul(mu_xx, mu_y, mu_y).add_(C1)
    B2 = xx.sub_(mu_xx).add_(s_yy).add_(C2)
    inverse = torch.mul(B1, B2).reciprocal_()
    v_xy = A1.mul_(inverse)
    S = v_xy * A2
    v_xy.mul_(2.0 * weight)
    v_half_xx = torch.div(S, B2).mul_(-2.0 * weight)
    # mu_y (A2 - A1) - mu_x S (B2 - B1), with A1 and B1 spelled out again because their buffers were reused
    spread = B2.sub_(B1).mul_(mu_x).mul_(S)
    A1_again = mu_xy.add_(mu_xy).add_(C1)
    v_mu = A2.sub_(A1_again).mul_(mu_y).sub_(spread).mul_(inverse).mul_(2.0 * weight)
    return S, [v_mu, v_half_xx, v_xy]


def _products(x: Tensor, y: Tensor, band: slice, border: int, channels: int) -> Tensor:
    """Return x, x² and x y on the rows that a band's windows read, with the zero border of "same". [3, ., .]"""
    top, bottom = band.start - border, band.stop - border + _REACH
    first, last = max(top, 0), min(bottom, len(x))
    shape = (3, bottom - top, x.shape[1] + 2 * border * channels)
    maps = x.new_zeros(shape) if border else x.new_empty(shape)
    inner = maps[:, first - top : last - top, border * channels : border * channels + x.shape[1]]
    inner[0].copy_(x[first:last])
    torch.mul(x[first:last], x[first:last], out=inner[1])
    torch.mul(x[first:last], y[first:last], out=inner[2])
    return maps


def _spread(x: Tensor, y: Tensor, partials: Tensor, channels: int) -> Tensor:
    """Return the gradient: each pixel gathers from all windows over it. The window is symmetric, so this is a blur."""
    v_x = torch.empty_like(x)
    for band in _bands(*x.shape):
        by_mu, by_half_xx, by_xy = _blur(partials[:, band.start : band.stop + _REACH], channels).unbind(0)
        torch.addcmul(by_mu, x[band], by_half_xx, out=v_x[band])
        v_x[band].addcmul_(y[band], by_xy)
    return v_x


def _kept_windows(mask: Tensor, padding: Padding, channels: int, dtype: torch.dtype) -> Tensor:
    margin = WINDOW_SIZE // 2
    centres = mask[margin:-margin, margin:-margin] if padding == "valid" else mask
    return centres.repeat_interleave(channels, dim=1).to(dtype)
