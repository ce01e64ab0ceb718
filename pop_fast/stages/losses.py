"""L1, L2, SSIM and the photometric objectives. Meaning, masks included: `pop_ref.losses`, `pop_ref.ssim`.

Every loss is one autograd node that makes its gradient together with its value: losses are scalars, so backward is one
product, and what is kept for it is one image. `moments=target_moments(target)` spares the part of SSIM that depends on
the photograph alone; `dissimilarity` is what computes SSIM, by default `mean_dissimilarity`. Derivatives are taken by
the render only; a target that requires a gradient is refused.

D-SSIM is written in the difference d = x - y of render and photograph. With mu = Σ w d, s_dd = Σ w d² - mu² and
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

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import torch
from torch import Tensor

from pop_fast.stages.types import once_differentiable
from pop_ref.settings import LAMBDA_SSIM_3DGS, Objective, Recipe

Padding = Literal["valid", "same"]

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
# values per band and map, 1 MB in float32: smaller bands are too short for the threads, larger ones leave the caches
_BAND_VALUES = 1 << 18
REACH = WINDOW_SIZE - 1


def _taps() -> list[float]:
    offsets = torch.arange(WINDOW_SIZE, dtype=torch.float64) - WINDOW_SIZE // 2
    falloff = torch.exp(-(offsets**2) / (2.0 * WINDOW_SIGMA**2))
    return (falloff / falloff.sum()).tolist()


_TAPS = _taps()


@dataclass(frozen=True)
class TargetMoments:
    """A photograph and what SSIM needs to know about it; make it once per view with `target_moments`."""

    target: Tensor  # the photograph. [H, W, D]
    padding: Padding  # "valid" or "same"
    mu_y: Tensor  # Σ w y. [h, w D]
    s_yy: Tensor  # Σ w y² - mu_y². [h, w D]


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
    """See `pop_ref.ssim.ssim_map`. Optimizations: see the module's docstring."""
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
        total += _total(dissimilarity, torch.float64)
        if partials is not None:
            inner = partials[:, margin + band.start : margin + band.stop, margin * channels : margin * channels + cols]
            for plane, v in zip(inner, v_band, strict=True):
                plane.copy_(v)
    value = (total / n).to(d.dtype)
    return value, None if partials is None else _gather(d, moments.target, partials).reshape(difference.shape)


def _total(values: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Sum row by row, and then the rows: a sum of all at once depends on the number of threads."""
    return values.flatten(1).sum(1, dtype=dtype).sum()


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


Dissimilarity = Callable[..., tuple[Tensor, Tensor | None]]


@dataclass(frozen=True)
class Loss:
    """What pixels of a render are compared with their photograph by, as `pop_fast.train.presets.LOSSES` names it."""

    name: str  # in the settings of a run, and in its records
    # given render and photograph [H, W, 3] and a mask [H, W] or None, a differentiable mean over the values that the
    # mask keeps
    pixelwise: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    # the name, in a backend's losses, of what weighs it against D-SSIM in one pass; None where the two are added up
    whole: str | None = None


class _Terms(NamedTuple):
    """`pixel_weight * (l1 or l2) + d_ssim_weight * (1 - ssim) + constant`; a weight of None leaves the term out."""

    pixel: Literal["l1", "l2"] = "l2"
    pixel_weight: float | None = None
    d_ssim_weight: float | None = None
    constant: float = 0.0
    dissimilarity: Dissimilarity = mean_dissimilarity


_SSIM = _Terms(d_ssim_weight=-1.0, constant=1.0)


def l1(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """See `pop_ref.losses.l1`; the derivative at equality is 0 (B4)."""
    return _loss(image, target, _Terms("l1", 1.0), "same", mask, None)


def l2(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """See `pop_ref.losses.l2`."""
    return _loss(image, target, _Terms("l2", 1.0), "same", mask, None)


def ssim(
    image: Tensor,
    target: Tensor,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.ssim.ssim`. Optimizations: see `pop_fast.stages.losses`; `moments` of the target may be passed."""
    return _loss(image, target, _SSIM._replace(dissimilarity=dissimilarity), padding, mask, moments)


def d_ssim(
    image: Tensor,
    target: Tensor,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.ssim.d_ssim`."""
    terms = _Terms(d_ssim_weight=0.5 if halved else 1.0, dissimilarity=dissimilarity)
    return _loss(image, target, terms, padding, mask, moments)


def photometric_3dgs(
    image: Tensor,
    target: Tensor,
    lambda_ssim: float = LAMBDA_SSIM_3DGS,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    l1_scale: float = 1.0,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.losses.photometric_3dgs`. Optimizations: both terms and their gradients in one autograd node."""
    weights = ((1.0 - lambda_ssim) * l1_scale, lambda_ssim * (0.5 if halved else 1.0))
    return _loss(image, target, _Terms("l1", *weights, dissimilarity=dissimilarity), padding, mask, moments)


def photometric_pop(
    image: Tensor,
    target: Tensor,
    lambda_ssim: float = Recipe.lambda_ssim,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    l2_scale: float = 1.0,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.losses.photometric_pop`. Optimizations: both terms and their gradients in one autograd node."""
    weights = ((1.0 - lambda_ssim) * l2_scale, lambda_ssim * (0.5 if halved else 1.0))
    return _loss(image, target, _Terms("l2", *weights, dissimilarity=dissimilarity), padding, mask, moments)


def _transpose_of(loss: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Make what pulls a cotangent, its third argument, back to the render; see that of the same name in `pop_ref`."""

    def transpose(image: Tensor, target: Tensor, v: Tensor | float, *args: Any, **kwargs: Any) -> Tensor:
        with torch.enable_grad():
            render = image.detach().requires_grad_()
            value = loss(render, target, *args, **kwargs)
        return torch.autograd.grad(value, render, torch.as_tensor(v, dtype=value.dtype, device=value.device))[0]

    return transpose


l1_vjp, l2_vjp, ssim_vjp, d_ssim_vjp = (_transpose_of(loss) for loss in (l1, l2, ssim, d_ssim))
photometric_3dgs_vjp, photometric_pop_vjp = _transpose_of(photometric_3dgs), _transpose_of(photometric_pop)

L1: Final = Loss("l1", l1, "photometric_3dgs")
L2: Final = Loss("l2", l2, "photometric_pop")


def photometric(
    loss: Loss,
    objective: Objective,
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    moments: TargetMoments | None = None,
    losses: Any = None,
) -> Tensor:
    """Weigh a loss between pixels against D-SSIM, in one pass where the losses have one for it.

    Args:
        image: the render. [H, W, 3]
        target: the photograph. [H, W, 3]
        mask: True where a pixel counts. [H, W]
        moments: `target_moments(target)`, where they are at hand.
        losses: a backend's, with the functions of this module; None takes this module's.
    """
    of = sys.modules[__name__] if losses is None else losses
    if loss.whole is not None:
        options = (objective.lambda_ssim, objective.padding, mask, objective.d_ssim_halved, objective.pixel_scale)
        return getattr(of, loss.whole)(image, target, *options, moments=moments)
    pixel_weight, ssim_weight = objective.weights
    d_ssim = of.d_ssim(image, target, objective.padding, mask, False, moments)
    return pixel_weight * loss.pixelwise(image, target, mask) + ssim_weight * d_ssim


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, *rest: Any) -> Tensor:  # type: ignore[override]
        value, grad = _value_and_gradient(image, *rest, want_grad=True)
        ctx.save_for_backward(grad)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return v_loss * grad, None, None, None, None, None


def _loss(
    image: Tensor, target: Tensor, terms: _Terms, padding: Padding, mask: Tensor | None, moments: TargetMoments | None
) -> Tensor:
    if image.requires_grad and torch.is_grad_enabled():
        return _Loss.apply(image, target, terms, padding, mask, moments)
    return _value_and_gradient(image, target, terms, padding, mask, moments, want_grad=False)[0]


@torch.no_grad()
def _value_and_gradient(
    image: Tensor,
    target: Tensor,
    terms: _Terms,
    padding: Padding,
    mask: Tensor | None,
    moments: TargetMoments | None,
    want_grad: bool,
) -> tuple[Tensor, Tensor | None]:
    _check(image, target, padding, mask, moments)
    target = target.to(image.dtype)
    difference = image - target
    if mask is not None:
        difference.masked_fill_(~mask[:, :, None], 0.0)
    value, grad = image.new_full((), terms.constant), None
    if terms.d_ssim_weight is not None:
        if moments is None:
            moments = target_moments(target, padding)
        weight = terms.d_ssim_weight if want_grad else None
        dissimilarity, grad = terms.dissimilarity(difference, moments, mask, weight)
        value = value + terms.d_ssim_weight * dissimilarity
    if terms.pixel_weight is not None:
        n = image.numel() if mask is None else max(int(mask.sum()), 1) * image.shape[2]
        total = _total(difference.abs() if terms.pixel == "l1" else difference * difference)
        per_value = terms.pixel_weight / n
        value = value + per_value * total
        if want_grad:
            slope = difference.sign_() if terms.pixel == "l1" else difference.mul_(2.0)
            grad = slope.mul_(per_value) if grad is None else grad.add_(slope, alpha=per_value)
    if grad is not None and mask is not None:
        grad.masked_fill_(~mask[:, :, None], 0.0)
    return value, grad


def _check(image: Tensor, target: Tensor, padding: Padding, mask: Tensor | None, moments: TargetMoments | None) -> None:
    if image.shape != target.shape:
        raise ValueError(f"image is {list(image.shape)} but target is {list(target.shape)}; they must be equal")
    if image.dim() != 3:
        raise ValueError(f"image is {list(image.shape)}; it must be [H, W, D], one view")
    if target.requires_grad:
        raise ValueError("target requires a gradient, but losses differentiate the image only; pass target.detach()")
    if mask is not None and (mask.shape != image.shape[:2] or mask.dtype != torch.bool):
        raise ValueError(f"mask is {mask.dtype} {list(mask.shape)}; it must be bool {list(image.shape[:2])}")
    check_size(image, padding)
    if moments is not None and (
        moments.padding != padding or moments.target.shape != image.shape or moments.target.dtype != image.dtype
    ):
        raise ValueError(
            "moments are of another image, padding or dtype; make them with target_moments(target, padding)"
        )
