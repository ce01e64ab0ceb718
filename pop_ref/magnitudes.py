"""What rounding may do to the numbers a render decides on: running error analysis of the stages before a pixel.

A number carries, besides its value, a bound on its absolute rounding error in units of the arithmetic's eps, to first
order: a sum inherits its operands' errors, a product inherits |y| ex + |x| ey, and each operation adds the size of its
result once, unless the operands are exact and so is the result in float32. The bound knows conditioning: a depth that
is a difference of large numbers, or the conic of a needle, carries a large one. `margins` divides distances from
thresholds by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.camera import camera_center
from pop_ref.constants import PAPER, Profile
from pop_ref.harmonics import sh_basis, sh_basis_vjp
from pop_ref.records import Camera, Gaussians


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
