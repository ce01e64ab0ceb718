"""SSIM and D-SSIM, window by window, with their transposes.

SSIM compares a render x with a photograph y through local moments under an 11 x 11 Gaussian window w of sigma 1.5:

    mu_x = Σ w x      mu_y = Σ w y      s_xx = Σ w x² - mu_x²      s_yy = Σ w y² - mu_y²      s_xy = Σ w x y - mu_x mu_y
    A1 = 2 mu_x mu_y + C1      A2 = 2 s_xy + C2      B1 = mu_x² + mu_y² + C1      B2 = s_xx + s_yy + C2
    S = A1 A2 / (B1 B2)

S depends on the pixels of x through mu_x, Σ w x² and Σ w x y only, and its partial derivatives are

    ∂S/∂mu_x = 2 mu_y (A2 - A1) / (B1 B2) - 2 mu_x S (1/B1 - 1/B2)
    ∂S/∂Σwx² = -S / B2
    ∂S/∂Σwxy = 2 A1 / (B1 B2)

so a pixel q inside the window receives w(q) (∂S/∂mu_x + 2 x(q) ∂S/∂Σwx² + y(q) ∂S/∂Σwxy).

With a mask (True = keep) the render is first replaced by the photograph where the mask is False, and the mean runs over
the windows whose centre is kept. A pixel that is left out thus has no gradient, and a mask that keeps no window gives
SSIM 1: nothing to compare is no difference.

Label decided here: A11 (D-SSIM is 1 - SSIM).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.settings import Padding

WINDOW_SIZE: Final = 11
WINDOW_SIGMA: Final = 1.5
C1: Final = 0.01**2
C2: Final = 0.03**2


def gaussian_window() -> Float64[np.ndarray, "11 11"]:
    """Tabulate SSIM's window: `w(i, j) ∝ exp(-(i² + j²) / (2 sigma²))`, summing to 1.

    Source: Wang et al. 2004, section III.B (11 x 11, sigma 1.5).
    Departs: nothing.

    Returns:
        The window, symmetric, largest in the middle.

    Example:
        >>> w = gaussian_window()
        >>> w.shape, bool(np.isclose(w.sum(), 1.0)), bool(w[5, 5] == w.max())
        ((11, 11), True, True)
    """
    offsets = np.arange(WINDOW_SIZE) - WINDOW_SIZE // 2
    falloff = np.exp(-(offsets**2) / (2.0 * WINDOW_SIGMA**2))
    falloff = falloff / np.sum(falloff)
    return np.outer(falloff, falloff)


def ssim_map(
    image: Float64[np.ndarray, "H W D"], target: Float64[np.ndarray, "H W D"], padding: Padding = "valid"
) -> Float64[np.ndarray, "h w D"]:
    """Compare every window of two images: S as in the module's docstring, per channel.

    Source: Wang et al. 2004, eq. 13.
    Departs: D-SSIM codes differ at the border: "valid" keeps the windows that lie inside the image (fused-ssim as
        gsplat calls it), "same" lets the windows reach into zeros (Inria).

    Args:
        image: the render.
        target: the photograph.
        padding: "valid" gives a map of H - 10 by W - 10, "same" of H by W.

    Returns:
        S of each window, at most 1.

    Raises:
        ValueError: the shapes differ, the padding is unknown, or "valid" finds no whole window.

    Example:
        >>> ssim_map(np.zeros((11, 12, 1)), np.zeros((11, 12, 1))).tolist()
        [[[1.0], [1.0]]]
    """
    x, y = _padded(image, target, padding)
    rows, cols = x.shape[0] - WINDOW_SIZE + 1, x.shape[1] - WINDOW_SIZE + 1
    similarity = np.zeros((rows, cols, x.shape[2]))
    for row in range(rows):
        for col in range(cols):
            similarity[row, col] = _compare_window(x, y, row, col)[0]
    return similarity


def ssim(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> float:
    """Average the structural similarity over windows and channels.

    Source: Wang et al. 2004, eq. 13 and 16.
    Departs: see `ssim_map`.

    Args:
        image: the render.
        target: the photograph.
        padding: "valid" or "same", see `ssim_map`.
        mask: True where a pixel counts; windows centred elsewhere are left out.

    Returns:
        The similarity, 1 for equal images.

    Raises:
        ValueError: as `ssim_map`.

    Example:
        >>> ssim(np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.5))
        1.0
    """
    similarity = ssim_map(replace_left_out(image, target, mask), target, padding)
    kept = _kept_windows(image, padding, mask)
    return float(np.mean(similarity[kept])) if np.any(kept) else 1.0


def ssim_vjp(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    v_ssim: float,
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> Float64[np.ndarray, "H W D"]:
    """Pull a cotangent of `ssim` back to the render, window by window (module docstring).

    Source: derivative of Wang et al. 2004, eq. 13.
    Departs: nothing.

    Args:
        image: the render.
        target: the photograph.
        v_ssim: cotangent of the similarity.
        padding: "valid" or "same", see `ssim_map`.
        mask: True where a pixel counts.

    Returns:
        Cotangent of the render; exactly 0 where the mask is False.

    Raises:
        ValueError: as `ssim_map`.

    Example:
        >>> flat = np.full((11, 11, 1), 0.5)
        >>> bool(np.allclose(ssim_vjp(flat, flat, 1.0), 0.0))
        True
    """
    x, y = _padded(replace_left_out(image, target, mask), target, padding)
    kept: list[list[int]] = np.argwhere(_kept_windows(image, padding, mask)).tolist()
    window = gaussian_window()[:, :, None]
    v_x = np.zeros(x.shape)
    for row, col in kept:
        _, v_mu, v_xx, v_xy = _compare_window(x, y, row, col)
        here = np.s_[row : row + WINDOW_SIZE, col : col + WINDOW_SIZE]
        v_x[here] += window * (v_mu + 2.0 * x[here] * v_xx + y[here] * v_xy)
    height, width, channels = image.shape
    border = (x.shape[0] - height) // 2
    v_image = v_ssim * v_x[border : border + height, border : border + width] / (max(len(kept), 1) * channels)
    return v_image if mask is None else np.where(mask[:, :, None], v_image, 0.0)


def d_ssim(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
    halved: bool = False,
) -> float:
    """Turn similarity into a loss: `1 - ssim`, or half of it (A11).

    Source: POP paper eqs. 2 and 9, which name D-SSIM without defining it.
    Departs: the literature's DSSIM is (1 - SSIM) / 2; every 3DGS code trains with 1 - SSIM, the default here (A11).

    Args:
        image: the render.
        target: the photograph.
        padding: "valid" or "same", see `ssim_map`.
        mask: True where a pixel counts.
        halved: True takes the literature's (1 - SSIM) / 2.

    Returns:
        The loss, 0 for equal images.

    Raises:
        ValueError: as `ssim_map`.

    Example:
        >>> d_ssim(np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.5))
        0.0
    """
    return (0.5 if halved else 1.0) * (1.0 - ssim(image, target, padding, mask))


def d_ssim_vjp(
    image: Float64[np.ndarray, "H W D"],
    target: Float64[np.ndarray, "H W D"],
    v_d_ssim: float,
    padding: Padding = "valid",
    mask: Bool[np.ndarray, "H W"] | None = None,
    halved: bool = False,
) -> Float64[np.ndarray, "H W D"]:
    """Pull a cotangent of `d_ssim` back to the render: minus (half) that of `ssim`.

    Source: derivative of `d_ssim`.
    Departs: nothing.

    Args:
        image: the render.
        target: the photograph.
        v_d_ssim: cotangent of the loss.
        padding: "valid" or "same", see `ssim_map`.
        mask: True where a pixel counts.
        halved: as in `d_ssim`.

    Returns:
        Cotangent of the render.

    Example:
        >>> d_ssim_vjp(np.zeros((11, 11, 1)), np.zeros((11, 11, 1)), 1.0).shape
        (11, 11, 1)
    """
    return ssim_vjp(image, target, (-0.5 if halved else -1.0) * v_d_ssim, padding, mask)


def _compare_window(x: np.ndarray, y: np.ndarray, row: int, col: int) -> tuple[np.ndarray, ...]:
    """Return S of the window whose corner is (row, col), and its derivatives by mu_x, Σ w x² and Σ w x y."""
    here = np.s_[row : row + WINDOW_SIZE, col : col + WINDOW_SIZE]
    window = gaussian_window()[:, :, None]
    mu_x = np.sum(window * x[here], axis=(0, 1))
    mu_y = np.sum(window * y[here], axis=(0, 1))
    s_xx = np.sum(window * x[here] * x[here], axis=(0, 1)) - mu_x * mu_x
    s_yy = np.sum(window * y[here] * y[here], axis=(0, 1)) - mu_y * mu_y
    s_xy = np.sum(window * x[here] * y[here], axis=(0, 1)) - mu_x * mu_y
    A1 = 2.0 * mu_x * mu_y + C1
    A2 = 2.0 * s_xy + C2
    B1 = mu_x * mu_x + mu_y * mu_y + C1
    B2 = s_xx + s_yy + C2
    S = A1 * A2 / (B1 * B2)
    v_mu = 2.0 * mu_y * (A2 - A1) / (B1 * B2) - 2.0 * mu_x * S * (1.0 / B1 - 1.0 / B2)
    return S, v_mu, -S / B2, 2.0 * A1 / (B1 * B2)


def _padded(image: np.ndarray, target: np.ndarray, padding: Padding) -> tuple[np.ndarray, np.ndarray]:
    """Return both images with the border that `padding` gives the windows to stand on."""
    if padding not in ("valid", "same"):
        raise ValueError(f"padding is {padding!r}; it must be 'valid' or 'same'")
    height, width = image.shape[:2]
    if padding == "same":
        border = ((WINDOW_SIZE // 2, WINDOW_SIZE // 2), (WINDOW_SIZE // 2, WINDOW_SIZE // 2), (0, 0))
        return np.pad(image, border), np.pad(target, border)
    if min(height, width) < WINDOW_SIZE:
        raise ValueError(
            f"image is {height} x {width} px; SSIM with padding 'valid' needs at least "
            f"{WINDOW_SIZE} x {WINDOW_SIZE}: use padding='same' or a larger image"
        )
    return image, target


def replace_left_out(image: np.ndarray, target: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return the render with the photograph's pixels where the mask is False, after checking the shapes.

    Source: this package's meaning of a mask (module docstring).
    Departs: codes without masks keep every pixel.

    Args:
        image: the render. [H, W, D]
        target: the photograph. [H, W, D]
        mask: True where a pixel counts; None keeps all. [H, W]

    Returns:
        The render to compare. [H, W, D]

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> replace_left_out(np.ones((1, 2, 1)), np.zeros((1, 2, 1)), np.array([[True, False]])).tolist()
        [[[1.0], [0.0]]]
    """
    if image.shape != target.shape:
        raise ValueError(f"image is {list(image.shape)} but target is {list(target.shape)}; they must be equal")
    if mask is None:
        return image
    if mask.shape != image.shape[:2]:
        raise ValueError(f"mask is {list(mask.shape)}; it must be {list(image.shape[:2])}, one entry a pixel")
    return np.where(mask[:, :, None], image, target)


def _kept_windows(image: np.ndarray, padding: Padding, mask: np.ndarray | None) -> np.ndarray:
    """Tell for each window of the map whether its centre is kept. [h, w]"""
    kept = np.ones(image.shape[:2], dtype=bool) if mask is None else mask
    margin = WINDOW_SIZE // 2
    return kept[margin:-margin, margin:-margin] if padding == "valid" else kept
