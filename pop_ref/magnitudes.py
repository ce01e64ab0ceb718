"""What rounding may do to the numbers a render decides on, and to a photometric loss: running error analysis.

A number carries, besides its value, a bound on its absolute rounding error in units of the arithmetic's eps, to first
order: a sum inherits its operands' errors, a product inherits |y| ex + |x| ey, and each operation adds the size of its
result once, unless the operands are exact and so is the result in float32. The bound knows conditioning: a depth that
is a difference of large numbers, or the conic of a needle, carries a large one. `margins` divides distances from
thresholds by it.

D-SSIM and its gradient are analysed by the same rules for whole arrays, window by window. A sum under the window is
one operation, charged with the sum of absolute values. SSIM divides by B2 = s_xx + s_yy + C2. Where the photograph is
flat, C2 = 9e-4 is all that is left of it, and what rounding leaves of the variances is compared with that: no
constant tells what is allowed there, the images do. Two ways to write the same function are analysed:

    textbook      S as in `pop_ref.ssim`: variances are differences of squares of size 1;
    difference    1 - S written in d = x - y (`pop_fast.stages.losses` derives it): rounding shrinks with d.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.camera import camera_center
from pop_ref.constants import PAPER, Profile
from pop_ref.harmonics import sh_basis, sh_basis_vjp
from pop_ref.records import Camera, Gaussians
from pop_ref.ssim import C1, C2, WINDOW_SIZE, Padding, gaussian_window, replace_left_out


class Rounded:
    """A number and a bound on its rounding error, in units of eps."""

    __slots__ = ("error", "value")

    def __init__(self, value: float, error: float = 0.0) -> None:
        self.value = value
        self.error = error

    def __repr__(self) -> str:
        return f"Rounded({self.value!r}, {self.error!r})"

    def __add__(self, other: Rounded) -> Rounded:
        return _rounded(self.value + other.value, self.error + other.error)

    def __sub__(self, other: Rounded) -> Rounded:
        return _rounded(self.value - other.value, self.error + other.error)

    def __mul__(self, other: Rounded) -> Rounded:
        return _rounded(self.value * other.value, abs(other.value) * self.error + abs(self.value) * other.error)

    def __truediv__(self, other: Rounded) -> Rounded:
        quotient = self.value / other.value
        return _rounded(quotient, (self.error + abs(quotient) * other.error) / abs(other.value))

    def __neg__(self) -> Rounded:
        return Rounded(-self.value, self.error)

    def sqrt(self) -> Rounded:
        """Take the square root; at 0 the error is that of the operand's own root."""
        root = math.sqrt(max(self.value, 0.0))
        return _rounded(root, self.error / (2.0 * root) if root > 0.0 else math.sqrt(self.error))


class Magnitudes(NamedTuple):
    """What a render compares with thresholds, one list entry per Gaussian in front of the eye (z > 0)."""

    depth: Rounded
    mean2d: tuple[Rounded, Rounded]
    ratios: tuple[Rounded, Rounded]
    blurred: tuple[Rounded, Rounded, Rounded]
    det: Rounded
    conic: tuple[Rounded, Rounded, Rounded]
    opacity: Rounded


def constant(value: float) -> Rounded:
    """Make a constant of the profile, which itself may not be exact in float32.

    Source: bookkeeping.
    Departs: nothing.

    Args:
        value: the constant.

    Returns:
        The constant, with an error of its own size unless float32 holds it.

    Example:
        >>> constant(0.5), constant(0.01)
        (Rounded(0.5, 0.0), Rounded(0.01, 0.01))
    """
    return Rounded(value) if math.isinf(value) else _rounded(value, 0.0)


def distance(operand: Rounded, threshold: Rounded) -> float:
    """Measure how far a comparison is from flipping: `|x - y| / (error x + error y)`, in units of eps.

    Source: Higham 2002, section 3.3 (running error analysis).
    Departs: nothing.

    Args:
        operand: one side.
        threshold: the other side.

    Returns:
        The distance; infinite where both sides are exact, since then the comparison cannot flip, tie or not; 0 where
        a side has overflowed, since then nothing is known.

    Example:
        >>> distance(Rounded(1.5, 0.25), Rounded(1.0)), distance(Rounded(1.0), Rounded(1.0))
        (2.0, inf)
    """
    error = operand.error + threshold.error
    if error == 0.0:
        return math.inf
    gap = abs(operand.value - threshold.value) / error
    return 0.0 if math.isnan(gap) else gap


def depths_magnitudes(gaussians: Gaussians, camera: Camera) -> list[Rounded]:
    """Bound the rounding of every depth, in front of the camera or not.

    Source: Higham 2002, section 3.3.
    Departs: nothing.

    Args:
        gaussians: activated.
        camera: the view.

    Returns:
        Camera z with its error, world units.

    Example:
        >>> g = Gaussians([[0, 0, 0.75]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> depths_magnitudes(g, Camera(np.eye(4), np.eye(3), 1, 1))
        [Rounded(0.75, 0.0)]
    """
    R, t = _exact(camera.viewmat[:3, :3]), _exact(camera.viewmat[:3, 3])
    return [(R @ mean + t)[2] for mean in _exact(gaussians.means)]


def splat_magnitudes(
    gaussians: Gaussians, i: int, camera: Camera, profile: Profile = PAPER, antialiased: bool = False
) -> Magnitudes:
    """Bound the rounding of everything on one Gaussian's way to the screen.

    Source: Higham 2002, section 3.3, applied to Kerbl et al. 2023 (3DGS), eqs. 5 and 6.
    Departs: as the stages do.

    Args:
        gaussians: activated.
        i: which one; its camera z must be > 0.
        camera: the view.
        profile: every constant.
        antialiased: as in `render`.

    Returns:
        Values as the stages compute them, with their errors.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])
        >>> m = splat_magnitudes(g, 0, Camera(np.eye(4), K, 8, 8))
        >>> m.mean2d[0], m.conic[0].error < 2.0
        (Rounded(4.0, 0.0), True)
    """
    R, t = _exact(camera.viewmat[:3, :3]), _exact(camera.viewmat[:3, 3])
    x, y, z = R @ _exact(gaussians.means[i]) + t
    fx, fy = Rounded(float(camera.K[0, 0])), Rounded(float(camera.K[1, 1]))
    centred = profile.principal_point == "centred"
    cx = Rounded(camera.width / 2.0 if centred else float(camera.K[0, 2]))
    cy = Rounded(camera.height / 2.0 if centred else float(camera.K[1, 2]))

    ratios = x / z, y / z
    slope_x = _clamped(ratios[0], fx, cx, camera.width, profile)
    slope_y = _clamped(ratios[1], fy, cy, camera.height, profile)
    zero = Rounded(0.0)
    J = np.array([[fx / z, zero, -(fx * slope_x) / z], [zero, fy / z, -(fy * slope_y) / z]], dtype=object)
    M = _rotation(gaussians.quats[i].tolist()) * _exact(gaussians.scales[i])
    a0, b, _, c0 = (J @ (R @ (M @ M.T) @ R.T) @ J.T).ravel()
    eps2d = constant(profile.eps2d)
    a, c = a0 + eps2d, c0 + eps2d
    det = a * c - b * b
    opacity = Rounded(float(gaussians.opacities[i]))
    if antialiased:
        det0 = a0 * c0 - b * b
        unknown = Rounded(0.0, det0.error / abs(det.value) if det.value != 0.0 else math.inf).sqrt()
        opacity = opacity * (det0 / det).sqrt() if det0.value > 0.0 and det.value > 0.0 else unknown
    conic = (c / det, -b / det, a / det) if det.value > 0.0 else (zero, zero, zero)
    return Magnitudes(z, (fx * ratios[0] + cx, fy * ratios[1] + cy), ratios, (a, b, c), det, conic, opacity)


def colors_magnitudes(
    gaussians: Gaussians, ids: Sequence[int], camera: Camera, degree: int
) -> tuple[Float64[np.ndarray, "V 3"], Float64[np.ndarray, "V 3"]]:
    """Evaluate colours before their clamp at 0 (B2), and bound their rounding.

    Source: Higham 2002, section 3.3.
    Departs: nothing.

    Args:
        gaussians: activated.
        ids: which ones, none of them at the camera's centre.
        camera: the view.
        degree: 0, 1, 2 or 3.

    Returns:
        `sum_k Y_k sh_k + 0.5`, and its error in units of eps, one row for each of `ids`.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> colors_magnitudes(g, [0], Camera(np.eye(4), np.eye(3), 1, 1), 0)[0]
        array([[0.5, 0.5, 0.5]])
    """
    center = camera_center(camera.viewmat)
    center_error = 4.0 * np.abs(camera.viewmat[:3, :3].T) @ np.abs(camera.viewmat[:3, 3])
    n_sh = (degree + 1) ** 2
    sums, errors = np.zeros((len(ids), 3)), np.zeros((len(ids), 3))
    for row, i in enumerate(ids):
        d = gaussians.means[i] - center
        norm = math.hypot(*d.tolist())
        unit = (d / norm)[None]
        unit_error = float(np.linalg.norm(center_error + np.abs(d))) / norm + 2.0
        sh = gaussians.sh[i, :n_sh]
        basis = sh_basis(unit, degree)[0]
        sums[row] = basis @ sh + 0.5
        for k in range(3):
            sensitivity = float(np.linalg.norm(sh_basis_vjp(unit, degree, sh[None, :, k])))
            errors[row, k] = 8.0 * (np.abs(basis) @ np.abs(sh[:, k])) + sensitivity * unit_error + abs(sums[row, k])
    return sums, errors


def _rounded(value: float, inherited: float) -> Rounded:
    if not math.isfinite(value):
        return Rounded(value, math.inf)
    exact = inherited == 0.0 and in_float32(value)
    return Rounded(value, inherited if exact else inherited + abs(value))


def in_float32(value: float) -> bool:
    """Tell whether float32 holds a number exactly.

    Source: IEEE 754.
    Departs: nothing.

    Args:
        value: finite.

    Returns:
        True where no rounding is needed.

    Example:
        >>> in_float32(0.375), in_float32(0.1), in_float32(1e300)
        (True, False, False)
    """
    return abs(value) < 1e38 and float(np.float32(value)) == value


def _exact(values: np.ndarray) -> Any:
    # an object array: numpy's own @, * and + then carry the errors along
    array = np.empty(values.shape, dtype=object)
    for index in np.ndindex(*values.shape):
        array[index] = Rounded(float(values[index]))
    return array


def _rotation(quat: list[float]) -> Any:
    squares = [Rounded(q) * Rounded(q) for q in quat]
    norm = (squares[0] + squares[1] + squares[2] + squares[3]).sqrt()
    w, x, y, z = (Rounded(q) / norm for q in quat)
    one, two = Rounded(1.0), Rounded(2.0)
    rows = [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
    return np.array(rows, dtype=object)


def _clamped(ratio: Rounded, focal: Rounded, center: Rounded, size: int, profile: Profile) -> Rounded:
    low, high = frustum_limits(focal, center, size, profile)
    return low if ratio.value < low.value else high if ratio.value > high.value else ratio


def frustum_limits(focal: Rounded, center: Rounded, size: int, profile: Profile) -> tuple[Rounded, Rounded]:
    """Repeat the frustum clamp's limits (B1) with their errors.

    Source: gsplat v1.5; diff-gaussian-rasterization.
    Departs: nothing.

    Args:
        focal: px.
        center: principal point along the same axis, px.
        size: image size along the same axis, px.
        profile: the margin.

    Returns:
        The lower and the upper limit of x/z.

    Example:
        >>> frustum_limits(Rounded(8.0), Rounded(4.0), 8, PAPER)[1].value
        0.65
    """
    margin = constant(profile.frustum_margin * 0.5) * Rounded(float(size)) / focal
    return -(center / focal + margin), (Rounded(float(size)) - center) / focal + margin


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
    d, photograph, one, two = Running(x - y, np.abs(x - y)), Running(y), _exact_running(1.0), _exact_running(2.0)
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
    render, photograph, one, two = Running(x), Running(y), _exact_running(1.0), _exact_running(2.0)
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


def _exact_running(value: float) -> Running:
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
