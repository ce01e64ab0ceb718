"""D-SSIM with its gradient in the same pass. Meaning: `pop_ref.ssim`.

Everything is written in the difference d = x - y of render and photograph. With mu = Σ w d, s_dd = Σ w d² - mu² and
s_dy = Σ w d y - mu mu_y,

    B1 = mu_x² + mu_y² + C1      a = mu² / B1          that is A1 / B1 = 1 - a
    B2 = 2 s_yy + 2 s_dy + s_dd + C2     b = s_dd / B2      that is A2 / B2 = 1 - b
    1 - S = a + (1 - a) b

    ∂(1-S)/∂Σwd² = (1 - a) (1 - b) / B2      ∂(1-S)/∂Σwdy = -2 (1 - a) b / B2
    ∂(1-S)/∂mu = 2 (1 - b) ((1 - a) mu - a mu_y) / B1 - 2 (1 - a) (mu - b mu_x) / B2

so rounding is proportional to the difference and vanishes with it. The textbook form subtracts squares of size 1 and
compares the result with C2 = 9e-4: three of float32's seven digits are lost, and near convergence most of 1 - S.

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
REACH = WINDOW_SIZE - 1


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
    channels, border = target.shape[2], border_of(padding)
    # in float64: this is where the textbook form would lose its digits, and it is done once per view
    y = target.double().reshape(target.shape[0], -1)
    padded = torch.nn.functional.pad(y, (border * channels, border * channels, border, border))
    mu_y, yy = _blur(torch.stack([padded, padded * padded]), channels).unbind(0)
    s_yy = yy.addcmul_(mu_y, mu_y, value=-1.0)
    return TargetMoments(target, padding, mu_y.to(target.dtype), s_yy.to(target.dtype))


def ssim_map(image: Tensor, target: Tensor, padding: Padding = "valid") -> Tensor:
    """See `pop_ref.ssim.ssim_map`.

    Optimizations: see the module's docstring.
    """
    moments = target_moments(target.to(image.dtype), padding)
    d = (image - moments.target).reshape(image.shape[0], -1)
    bands = [_compare_rows(d, moments, band, None)[0] for band in _bands(*moments.mu_y.shape)]
    return (1.0 - torch.cat(bands)).reshape(len(moments.mu_y), -1, image.shape[2])


def mean_dissimilarity(
    difference: Tensor, moments: TargetMoments, mask: Tensor | None, weight: float | None
) -> tuple[Tensor, Tensor | None]:
    """Return the mean of 1 - S over the kept windows, and the gradient of `weight` times it by the render.

    Args:
        difference: render minus photograph, 0 where the mask is False. [H, W, D]
        moments: of the photograph.
        mask: True where a window's centre counts, or None. [H, W]
        weight: factor on the gradient only; None computes no gradient.
    """
    channels = difference.shape[2]
    d = difference.reshape(len(difference), -1)
    kept = None if mask is None else kept_windows(mask, moments.padding, channels, d.dtype)
    n = moments.mu_y.numel() if kept is None else int(kept.sum())
    if n == 0:
        return d.new_zeros(()), None if weight is None else torch.zeros_like(difference)
    total = d.new_zeros((), dtype=torch.float64)
    rows, cols = moments.mu_y.shape
    margin = REACH - border_of(moments.padding)
    partials = None if weight is None else d.new_zeros((3, rows + 2 * margin, cols + 2 * margin * channels))
    for band in _bands(rows, cols):
        dissimilarity, v_band = _compare_rows(d, moments, band, None if weight is None else weight / n)
        if kept is not None:
            dissimilarity, v_band = dissimilarity.mul_(kept[band]), [v.mul_(kept[band]) for v in v_band]
        total += dissimilarity.sum(dtype=torch.float64)
        if partials is not None:
            inner = partials[:, margin + band.start : margin + band.stop, margin * channels : margin * channels + cols]
            for plane, v in zip(inner, v_band, strict=True):
                plane.copy_(v)
    value = (total / n).to(d.dtype)
    return value, None if partials is None else _gather(d, moments.target, partials).reshape(difference.shape)


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


def border_of(padding: Padding) -> int:
    """Return how many pixels of black are put around an image."""
    return WINDOW_SIZE // 2 if padding == "same" else 0


def _bands(rows: int, cols: int) -> list[slice]:
    height = max(_BAND_VALUES // max(cols, 1), WINDOW_SIZE)
    return [slice(first, min(first + height, rows)) for first in range(0, rows, height)]


def _blur(maps: Tensor, channels: int) -> Tensor:
    """Sum maps [M, H, L] under every whole window: [M, H - 10, L - 10 channels]."""
    rows, cols = maps.shape[1] - REACH, maps.shape[2] - REACH * channels
    down = maps[:, :rows] * _TAPS[0]
    for i in range(1, WINDOW_SIZE):
        down.add_(maps[:, i : i + rows], alpha=_TAPS[i])
    across = down[:, :, :cols] * _TAPS[0]
    for i in range(1, WINDOW_SIZE):
        across.add_(down[:, :, i * channels : i * channels + cols], alpha=_TAPS[i])
    return across


def _compare_rows(
    d: Tensor, moments: TargetMoments, band: slice, weight: float | None
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return 1 - S for a band of the map's rows, and weight times its derivatives by mu, (Σ w d²) / 2 and Σ w d y."""
    mu, dd, dy = _blur(_products(d, moments, band), moments.target.shape[2]).unbind(0)
    mu_y, s_yy = moments.mu_y[band], moments.s_yy[band]
    mu_sq, mu_x = mu * mu, mu + mu_y
    s_dd, s_dy = dd.sub_(mu_sq), dy.addcmul_(mu, mu_y, value=-1.0)
    B1 = (mu_x * mu_y).mul_(2.0).add_(mu_sq).add_(C1)
    B2 = s_dy.add_(s_yy).mul_(2.0).add_(s_dd).add_(C2)
    a, b = mu_sq.div_(B1), s_dd.div_(B2)
    kept_a = 1.0 - a
    dissimilarity = torch.addcmul(a, kept_a, b)
    if weight is None:
        return dissimilarity, ()
    kept_b, slope = 1.0 - b, (kept_a / B2).mul_(2.0 * weight)
    v_half_dd = slope * kept_b
    v_mu = (kept_a.mul_(mu)).addcmul_(a, mu_y, value=-1.0).mul_(kept_b).div_(B1).mul_(2.0 * weight)
    v_mu.addcmul_(slope, mu.addcmul_(b, mu_x, value=-1.0), value=-1.0)
    return dissimilarity, (v_mu, v_half_dd, slope.mul_(b).neg_())


def _products(d: Tensor, moments: TargetMoments, band: slice) -> Tensor:
    """Return d, d² and d y on the rows that a band's windows read, with the zero border of "same". [3, ., .]"""
    border, y = border_of(moments.padding), moments.target.reshape(len(d), -1)
    side = border * moments.target.shape[2]
    top, bottom = band.start - border, band.stop - border + REACH
    first, last = max(top, 0), min(bottom, len(d))
    shape = (3, bottom - top, d.shape[1] + 2 * side)
    maps = d.new_zeros(shape) if border else d.new_empty(shape)
    inner = maps[:, first - top : last - top, side : side + d.shape[1]]
    inner[0].copy_(d[first:last])
    torch.mul(d[first:last], d[first:last], out=inner[1])
    torch.mul(d[first:last], y[first:last], out=inner[2])
    return maps


def _gather(d: Tensor, target: Tensor, partials: Tensor) -> Tensor:
    """Return the gradient: each pixel gathers from all windows over it. The window is symmetric, so this is a blur."""
    v_x, y = torch.empty_like(d), target.reshape(len(d), -1)
    for band in _bands(*d.shape):
        by_mu, by_half_dd, by_dy = _blur(partials[:, band.start : band.stop + REACH], target.shape[2]).unbind(0)
        torch.addcmul(by_mu, d[band], by_half_dd, out=v_x[band])
        v_x[band].addcmul_(y[band], by_dy)
    return v_x


def kept_windows(mask: Tensor, padding: Padding, channels: int, dtype: torch.dtype) -> Tensor:
    """Return 1 for every window and channel whose centre the mask [H, W] keeps, 0 for the others. [h, w D]"""
    margin = WINDOW_SIZE // 2
    centres = mask[margin:-margin, margin:-margin] if padding == "valid" else mask
    return centres.repeat_interleave(channels, dim=1).to(dtype)
