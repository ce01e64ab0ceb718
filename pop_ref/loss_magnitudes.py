"""What rounding may do to a photometric loss and its gradient: running error analysis of D-SSIM, window by window.

Each array carries, besides its values, a bound on their absolute rounding error in units of the arithmetic's eps, to
first order: a sum inherits its operands' errors, a product inherits |y| ex + |x| ey, and each operation adds the size
of its result once. A sum under the window is one operation, charged with the sum of absolute values.

SSIM divides by B2 = s_xx + s_yy + C2. Where the photograph is flat, C2 = 9e-4 is all that is left of it, and what
rounding leaves of the variances is compared with that: no constant tells what is allowed there, the images do. Two ways
to write the same function are analysed:

    textbook      S as in `pop_ref.ssim`: variances are differences of squares of size 1;
    difference    1 - S written in d = x - y (`pop_fast.stages.losses` derives it): rounding shrinks with d.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.ssim import C1, C2, WINDOW_SIZE, Padding, gaussian_window, replace_left_out

Form = Literal["textbook", "difference"]
REACH: Final = WINDOW_SIZE // 2


class LossMagnitudes(NamedTuple):
    """Bounds on the rounding errors of a loss, in units of eps: of its value, and of its gradient. [H, W, D]"""

    value: float
    gradient: np.ndarray


class Running:
    """An array and a bound on the rounding error of each entry, in units of eps."""

    __slots__ = ("error", "value")

    def __init__(self, value: np.ndarray, error: np.ndarray | None = None) -> None:
        self.value = value
        self.error = np.zeros_like(value) if error is None else error

    def __add__(self, other: Running) -> Running:
        return _operated(self.value + other.value, self.error + other.error)

    def __sub__(self, other: Running) -> Running:
        return _operated(self.value - other.value, self.error + other.error)

    def __mul__(self, other: Running) -> Running:
        inherited = np.abs(other.value) * self.error + np.abs(self.value) * other.error
        return _operated(self.value * other.value, inherited)

    def __truediv__(self, other: Running) -> Running:
        quotient = self.value / other.value
        return _operated(quotient, (self.error + np.abs(quotient) * other.error) / np.abs(other.value))

    def under_windows(self) -> Running:
        """Sum under every window that lies inside; the error is that of the terms, and the sum of their sizes."""
        return Running(_blurred(self.value), _blurred(np.abs(self.value) + self.error))


def pixelwise_magnitudes(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    power: Literal[1, 2],
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> LossMagnitudes:
    """Bound the rounding of L1 (power 1) or L2 (power 2): every term is charged with its own size.

    Source: Higham 2002, section 3.3 (running error analysis).
    Departs: nothing.

    Args:
        image: the render.
        target: the photograph.
        power: 1 for L1, 2 for L2.
        mask: True where a pixel counts.

    Returns:
        The bounds for a cotangent of 1.

    Example:
        >>> pixelwise_magnitudes(np.full((1, 1, 1), 0.75), np.full((1, 1, 1), 0.25), 2)
        LossMagnitudes(value=0.25, gradient=array([[[1.]]]))
    """
    d = np.abs(replace_left_out(image, target, mask) - target)
    n = max(1, (d.shape[0] * d.shape[1] if mask is None else int(np.sum(mask))) * d.shape[2])
    return LossMagnitudes(float(np.sum(d**power)) / n, power * d ** (power - 1) / n)


def d_ssim_magnitudes(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
    form: Form = "difference",
) -> LossMagnitudes:
    """Bound the rounding of `ssim.d_ssim` and of its gradient, for one way of writing it.

    Source: Higham 2002, section 3.3, applied to Wang et al. 2004, eq. 13.
    Departs: nothing.

    Args:
        image: the render.
        target: the photograph.
        padding: "valid" or "same", see `ssim.ssim_map`.
        mask: True where a pixel counts.
        form: how 1 - S is computed (module docstring).

    Returns:
        The bounds for a cotangent of 1; zeros where the mask is False.

    Example:
        >>> grey, almost = np.full((11, 11, 1), 0.5), np.full((11, 11, 1), 0.5 + 2.0**-20)
        >>> [f"{d_ssim_magnitudes(almost, grey, form=form).value:.4g}" for form in ("textbook", "difference")]
        ['5573', '9.122e-09']
    """
    border = REACH if padding == "same" else 0
    x, y = (np.pad(a, ((border, border), (border, border), (0, 0))) for a in (image, target))
    around = None if mask is None else np.pad(mask, border)
    x = replace_left_out(x, y, around)
    dissimilarity, partials, factors = (_textbook if form == "textbook" else _difference)(x, y)
    kept = np.ones(dissimilarity.value.shape) if around is None else _centres(around)[:, :, None]
    n = max(1.0, float(np.sum(np.broadcast_to(kept, dissimilarity.value.shape))))
    # a pixel sums over the windows that it lies in: each term's error, and the sizes of the terms
    sizes = [_gathered(kept * (partial.error + np.abs(partial.value))) for partial in partials]
    gradient = np.sum([factor * size for factor, size in zip(factors, sizes, strict=True)], axis=0) / n
    inside = gradient[border : border + image.shape[0], border : border + image.shape[1]]
    value = float(np.sum(kept * (dissimilarity.error + np.abs(dissimilarity.value)))) / n
    return LossMagnitudes(value, inside if mask is None else np.where(mask[:, :, None], inside, 0.0))


def _difference(x: np.ndarray, y: np.ndarray) -> tuple[Running, tuple[Running, ...], tuple[np.ndarray, ...]]:
    """Return 1 - S, its derivatives by mu, Σ w d² / 2 and Σ w d y, and what a pixel multiplies each with."""
    d, photograph, one, two = Running(x - y, np.abs(x - y)), Running(y), _exact(1.0), _exact(2.0)
    mu, dd, dy = d.under_windows(), (d * d).under_windows(), (d * photograph).under_windows()
    # the photograph's moments are made once, in float64, and rounded
    mean = _blurred(y)
    variance = _blurred(y * y) - mean * mean
    mu_y, s_yy = Running(mean, np.abs(mean)), Running(variance, np.abs(variance))
    mu_sq, mu_x = mu * mu, mu + mu_y
    s_dd, s_dy = dd - mu_sq, dy - mu * mu_y
    B1 = two * (mu_x * mu_y) + mu_sq + _constant(C1)
    B2 = two * (s_dy + s_yy) + s_dd + _constant(C2)
    a, b = mu_sq / B1, s_dd / B2
    kept_a, kept_b = one - a, one - b
    slope = two * (kept_a / B2)
    v_mu = two * ((kept_a * mu - a * mu_y) * kept_b / B1) - slope * (mu - b * mu_x)
    return a + kept_a * b, (v_mu, slope * kept_b, slope * b), (np.ones_like(x), np.abs(x - y), np.abs(y))


def _textbook(x: np.ndarray, y: np.ndarray) -> tuple[Running, tuple[Running, ...], tuple[np.ndarray, ...]]:
    """Return 1 - S, its derivatives by mu_x, Σ w x² and Σ w x y, and what a pixel multiplies each with."""
    render, photograph, one, two = Running(x), Running(y), _exact(1.0), _exact(2.0)
    mu_x, mu_y = render.under_windows(), photograph.under_windows()
    s_xx = (render * render).under_windows() - mu_x * mu_x
    s_yy = (photograph * photograph).under_windows() - mu_y * mu_y
    s_xy = (render * photograph).under_windows() - mu_x * mu_y
    A1, A2 = two * mu_x * mu_y + _constant(C1), two * s_xy + _constant(C2)
    B1, B2 = mu_x * mu_x + mu_y * mu_y + _constant(C1), s_xx + s_yy + _constant(C2)
    S = A1 * A2 / (B1 * B2)
    v_mu = two * mu_y * (A2 - A1) / (B1 * B2) - two * mu_x * S * (one / B1 - one / B2)
    return one - S, (v_mu, S / B2, two * A1 / (B1 * B2)), (np.ones_like(x), 2.0 * np.abs(x), np.abs(y))


def _operated(value: np.ndarray, inherited: np.ndarray) -> Running:
    return Running(value, inherited + np.abs(value))


def _constant(value: float) -> Running:
    return Running(np.array(value), np.array(abs(value)))


def _exact(value: float) -> Running:
    return Running(np.array(value))


def _blurred(maps: np.ndarray) -> np.ndarray:
    """Sum an array under every whole window: [H, W, D] to [H - 10, W - 10, D]."""
    taps = gaussian_window()[REACH] / np.sum(gaussian_window()[REACH])
    rows, cols = maps.shape[0] - 2 * REACH, maps.shape[1] - 2 * REACH
    down = np.zeros((rows, *maps.shape[1:]))
    across = np.zeros((rows, cols, maps.shape[2]))
    for i, tap in enumerate(taps):
        down += tap * maps[i : i + rows]
    for i, tap in enumerate(taps):
        across += tap * down[:, i : i + cols]
    return across


def _gathered(windows: np.ndarray) -> np.ndarray:
    """Sum over the windows that each pixel lies in, the transpose of `_blurred`."""
    around = ((2 * REACH, 2 * REACH), (2 * REACH, 2 * REACH), (0, 0))
    return _blurred(np.pad(windows, around))


def _centres(mask: np.ndarray) -> np.ndarray:
    return mask[REACH:-REACH, REACH:-REACH]
