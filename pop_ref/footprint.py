"""The splat on the screen: low-pass, antialiasing factor, conic, extents, off-screen cull.

For a screen covariance [[a, b], [b, c]] the conic is its inverse (c, -b, a) / (a c - b^2), kept as (xx, xy, yy) with
the off-diagonal once. Where the determinant is not positive, which rounding does to huge or needle splats, there is no
ellipse: the conic is zero and the splat is culled (D2). The `inria` profile departs from Inria's code here on purpose:
that skips a determinant of exactly 0 only and draws the hyperbola of a negative one, whose sign is rounding's choice.
"""

from __future__ import annotations

import math

import numpy as np

from pop_ref._shapes import Bool, Float64, Int64
from pop_ref.constants import PAPER, Profile
from pop_ref.tiles import tile_rects

_LARGEST_RADIUS = 2**31 - 1


def low_pass(covars2d: Float64[np.ndarray, "N 2 2"], eps2d: float) -> Float64[np.ndarray, "N 2 2"]:
    """Widen every splat by a small isotropic blur: `Sigma2d + eps2d I`.

    Source: the code bases (0.3 px^2); the idea is the reconstruction filter of Zwicker et al. 2001 (EWA), section 5.
    Departs: the 3DGS paper does not print it.

    Args:
        covars2d: screen covariances, px^2.
        eps2d: px^2.

    Returns:
        Blurred screen covariances, px^2.

    Example:
        >>> low_pass(np.array([[[1.0, 0.5], [0.5, 2.0]]]), 0.25)[0]
        array([[1.25, 0.5 ],
               [0.5 , 2.25]])
    """
    return covars2d + eps2d * np.eye(2)


def low_pass_vjp(
    covars2d: Float64[np.ndarray, "N 2 2"], eps2d: float, v_blurred: Float64[np.ndarray, "N 2 2"]
) -> Float64[np.ndarray, "N 2 2"]:
    """Pull a cotangent of blurred covariances back: the identity.

    Source: transpose of `low_pass`.
    Departs: nothing.

    Args:
        covars2d: screen covariances, px^2.
        eps2d: px^2.
        v_blurred: cotangent of the blurred covariances.

    Returns:
        Cotangent of `covars2d`.

    Example:
        >>> low_pass_vjp(np.zeros((1, 2, 2)), 0.25, np.eye(2)[None])[0]
        array([[1., 0.],
               [0., 1.]])
    """
    return v_blurred.copy()


def compensations(covars2d: Float64[np.ndarray, "N 2 2"], eps2d: float) -> Float64[np.ndarray, " N"]:
    """Find the factor that keeps a blurred splat's energy: `rho = sqrt(max(0, det Sigma2d / det(Sigma2d + eps2d I)))`.

    Multiplies the opacity in antialiased mode; classic mode does not use it.

    Source: Yu et al. 2024 (Mip-Splatting), the 2D Mip filter, as gsplat's antialiased mode.
    Departs: nothing.

    Args:
        covars2d: screen covariances before the low-pass, px^2.
        eps2d: px^2, > 0.

    Returns:
        Factors in [0, 1], 0 where a determinant is not positive.

    Example:
        >>> compensations(np.diag([0.25, 0.25])[None], 0.75)
        array([0.25])
    """
    factors = np.zeros(len(covars2d))
    blurred = low_pass(covars2d, eps2d)
    for i in range(len(covars2d)):
        det, det_blurred = _det(covars2d[i]), _det(blurred[i])
        if det > 0.0 and det_blurred > 0.0:
            factors[i] = math.sqrt(det / det_blurred)
    return factors


def compensations_vjp(
    covars2d: Float64[np.ndarray, "N 2 2"], eps2d: float, v_factors: Float64[np.ndarray, " N"]
) -> Float64[np.ndarray, "N 2 2"]:
    """Pull a cotangent of the factors back: `v_Sigma2d = v_rho rho/2 (Sigma2d^-1 - (Sigma2d + eps2d I)^-1)`.

    From log rho = (log det Sigma2d - log det blurred) / 2. Where a determinant is not positive the gradient is zero.

    Source: transpose of `compensations`.
    Departs: gsplat adds 1e-6 to rho in a denominator.

    Args:
        covars2d: screen covariances before the low-pass, px^2.
        eps2d: px^2, > 0.
        v_factors: cotangent of the factors.

    Returns:
        Cotangent of `covars2d`, symmetric.

    Example:
        >>> compensations_vjp(np.diag([0.25, 0.25])[None], 0.75, np.array([8.0]))[0]
        array([[3., 0.],
               [0., 3.]])
    """
    v_covars2d = np.zeros(covars2d.shape)
    blurred = low_pass(covars2d, eps2d)
    factors = compensations(covars2d, eps2d)
    for i in range(len(covars2d)):
        if factors[i] > 0.0:
            difference = _inverse(covars2d[i]) - _inverse(blurred[i])
            v_covars2d[i] = v_factors[i] * factors[i] / 2.0 * difference
    return v_covars2d


def conics_from_covars2d(covars2d: Float64[np.ndarray, "N 2 2"]) -> Float64[np.ndarray, "N 3"]:
    """Invert screen covariances: `(xx, xy, yy) = (c, -b, a) / (a c - b^2)` of [[a, b], [b, c]].

    Source: Kerbl et al. 2023 (3DGS), eq. 4 in two dimensions; POP paper, eq. 11.
    Departs: where the determinant is <= 0 the conic is zero (D2), in every profile; Inria's code tests only == 0.

    Args:
        covars2d: screen covariances after the low-pass, px^2.

    Returns:
        Conics (xx, xy, yy), px^-2; the off-diagonal stands once.

    Example:
        >>> conics_from_covars2d(np.array([[[2.0, 1.0], [1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]]]))
        array([[ 1., -1.,  2.],
               [ 0.,  0.,  0.]])
    """
    conics = np.zeros((len(covars2d), 3))
    for i in range(len(covars2d)):
        if _det(covars2d[i]) > 0.0:
            inverse = _inverse(covars2d[i])
            conics[i] = inverse[0, 0], inverse[0, 1], inverse[1, 1]
    return conics


def conics_from_covars2d_vjp(
    covars2d: Float64[np.ndarray, "N 2 2"], v_conics: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 2 2"]:
    """Pull a cotangent of conics back: `v_Sigma2d = -Q V Q` with Q the inverse.

    `V = [[v_xx, v_xy/2], [v_xy/2, v_yy]]`: the off-diagonal stands once in the conic but twice in the matrix.

    Source: transpose of `conics_from_covars2d`.
    Departs: nothing; Inria carries the halves elsewhere, with the same result.

    Args:
        covars2d: screen covariances after the low-pass, px^2.
        v_conics: cotangent of (xx, xy, yy).

    Returns:
        Cotangent of `covars2d`, symmetric; zero where the determinant is <= 0.

    Example:
        >>> conics_from_covars2d_vjp(np.eye(2)[None] * 0.5, np.array([[1.0, 1.0, 1.0]]))[0]
        array([[-4., -2.],
               [-2., -4.]])
    """
    v_covars2d = np.zeros(covars2d.shape)
    for i in range(len(covars2d)):
        if _det(covars2d[i]) > 0.0:
            Q = _inverse(covars2d[i])
            v_xx, v_xy, v_yy = v_conics[i].tolist()
            V = np.array([[v_xx, v_xy / 2.0], [v_xy / 2.0, v_yy]])
            v_covars2d[i] = -Q @ V @ Q
    return v_covars2d


def radii_from_covars2d(
    covars2d: Float64[np.ndarray, "N 2 2"], opacities: Float64[np.ndarray, " N"], profile: Profile = PAPER
) -> Int64[np.ndarray, "N 2"]:
    """Bound where a splat can be seen (D2).

    "opacity_aware": `r_x = ceil(k sqrt(a))`, `r_y = ceil(k sqrt(c))` with `k = min(3.33, sqrt(2 ln(o / alpha_floor)))`,
    the half-sides of the rectangle around the ellipse o exp(-sigma) = alpha_floor; no pixel with alpha >= alpha_floor
    is missed. "square": `ceil(3 sqrt(lambda_max))` on both axes, whatever the opacity, which cuts visible alpha off.

    Source: gsplat v1.5 ("opacity_aware"); Kerbl et al. 2023 (3DGS), section 6, and its code ("square").
    Departs: the paper speaks of the 99 % confidence interval; the code uses 3 standard deviations and bounds the
        discriminant of lambda_max from below by 0.1 (D2). A determinant < 0 culls in every profile, in `inria` too,
        whose own code culls only == 0: see the module's text.

    Args:
        covars2d: screen covariances after the low-pass, px^2.
        opacities: the opacities that blend.
        profile: the kind of extent, its bound and the alpha floor.

    Returns:
        Extents along x and y, px, at most 2^31 - 1; both 0 where the determinant is <= 0 or, in "opacity_aware", the
        opacity is under the floor.

    Raises:
        ValueError: "opacity_aware", with an alpha floor that is not over 0.

    Example:
        >>> radii_from_covars2d(np.diag([4.0, 1.0])[None], np.array([1.0])).tolist()
        [[7, 4]]
    """
    if profile.extent == "opacity_aware":
        profile.require_floor()
    radii = np.zeros((len(covars2d), 2), dtype=np.int64)
    for i in range(len(covars2d)):
        opacity = float(opacities[i])
        if _det(covars2d[i]) > 0.0 and (profile.extent == "square" or opacity >= profile.alpha_floor):
            reach_x, reach_y = _reach(covars2d[i], opacity, profile)
            # the smaller first: infinity has no ceiling
            radii[i] = math.ceil(min(_LARGEST_RADIUS, reach_x)), math.ceil(min(_LARGEST_RADIUS, reach_y))
    return radii


def on_screen(
    means2d: Float64[np.ndarray, "N 2"],
    radii: Int64[np.ndarray, "N 2"],
    width: int,
    height: int,
    profile: Profile = PAPER,
) -> Bool[np.ndarray, " N"]:
    """Tell which splats' extents touch the image (D2).

    "opacity_aware": `u + r > 0` and `u - r < size` on both axes. "square": the splat's tile rectangle is not empty.

    Source: gsplat v1.5 ("opacity_aware"); diff-gaussian-rasterization ("square").
    Departs: nothing.

    Args:
        means2d: screen centres, px.
        radii: extents, px; 0 is never on screen.
        width: px.
        height: px.
        profile: the kind of extent and, in "square", the tile grid.

    Returns:
        True where kept.

    Example:
        >>> on_screen(np.array([[-2.0, 1.0], [-2.0, 1.0]]), np.array([[2, 2], [3, 3]]), 4, 4).tolist()
        [False, True]
    """
    some = np.all(radii > 0, axis=1)
    if profile.extent == "square":
        rects = tile_rects(means2d, radii, width, height, profile.tile_size, profile)
        return some & (rects[:, 0] < rects[:, 2]) & (rects[:, 1] < rects[:, 3])
    return some & np.all((means2d + radii > 0.0) & (means2d - radii < [width, height]), axis=1)


def _reach(covar2d: Float64[np.ndarray, "2 2"], opacity: float, profile: Profile) -> tuple[float, float]:
    a, c = float(covar2d[0, 0]), float(covar2d[1, 1])
    if profile.extent == "square":
        middle = 0.5 * (a + c)
        largest = middle + math.sqrt(max(0.1, middle * middle - _det(covar2d)))
        return profile.extent_sigmas * math.sqrt(largest), profile.extent_sigmas * math.sqrt(largest)
    k = min(profile.extent_sigmas, math.sqrt(2.0 * math.log(opacity / profile.alpha_floor)))
    return k * math.sqrt(a), k * math.sqrt(c)


def _det(covar2d: Float64[np.ndarray, "2 2"]) -> float:
    (a, b), (b_too, c) = covar2d.tolist()
    return a * c - b * b_too


def _inverse(covar2d: Float64[np.ndarray, "2 2"]) -> Float64[np.ndarray, "2 2"]:
    (a, b), (b_too, c) = covar2d.tolist()
    # the two off-diagonals differ by rounding at most; their mean makes the inverse symmetric
    off = -0.5 * (b + b_too)
    return np.array([[c, off], [off, a]]) / _det(covar2d)
