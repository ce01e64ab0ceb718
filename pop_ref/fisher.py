"""How well a Gaussian's place and size are determined by the views: the pruning score of PUP 3D-GS.

With theta = (mean, log scale), six numbers, and g = dC_c(p)/dtheta the change of channel c at pixel p, the Fisher block
of a Gaussian is F = sum over views, pixels and channels of g g^T, and its score log det F.

In one view theta acts through the screen centre, the conic and the colour only: g = J^T q_c + w k_c, where
    q_c  is dC_c/d(mean2d, conic), five numbers of the pixel and the channel,
    w    is dC_c/dcolour_c = T alpha, one number of the pixel,
    J    is d(mean2d, conic)/dtheta, and k_c is dcolour_c/dtheta by the view direction; both belong to the Gaussian.
So the pixels need to be summed once, into second moments of (q_c, w), 31 numbers a Gaussian, and
    F = J^T (sum q_c q_c^T) J + sum_c [ J^T (sum q_c w) k_c^T + its transpose + (sum w^2) k_c k_c^T ],
exactly the sum of outer products.
"""

# J is the field's symbol for a Jacobian, T for transmittance, which changes along a ray
# pyright: reportConstantRedefinition=false

from __future__ import annotations

import math
from typing import Final

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.alpha import alpha_from_sigma_vjp, sigma_at_pixel, sigma_at_pixel_vjp
from pop_ref.compositing import background_or_black
from pop_ref.constants import PAPER, Profile
from pop_ref.pixel import composite_pixel, rows_from_splats
from pop_ref.records import Camera, Gaussians, Splats
from pop_ref.splatting import project_vjp
from pop_ref.tiles import listed_pixels

_N_SCREEN: Final = 5
_UPPER: Final = np.triu_indices(_N_SCREEN)
_N_UPPER: Final = 15
_N_CHANNELS: Final = 3


def screen_moments(
    splats: Splats,
    lists: list[list[int]],
    width: int,
    height: int,
    tile_size: int,
    background: Float64[np.ndarray, "3"] | None = None,
    profile: Profile = PAPER,
) -> Float64[np.ndarray, "N 31"]:
    """Sum second moments of a view's derivatives by what the screen holds of each Gaussian.

    With q_c = dC_c/d(mean2d x, mean2d y, conic xx, xy, yy) and w = T alpha, over all pixels: the 15 entries on and
    above the diagonal of `sum_c q_c q_c^T`, row by row; `q_c w` for c = 0, 1, 2, five entries each; `w^2`.

    Source: Hanson et al. 2025 (PUP 3D-GS), the Fisher information of a view; the split into screen and Gaussian is
        this module's.
    Departs: nothing; at the alpha ceiling the profile's gradient counts (B3).

    Args:
        splats: the projected Gaussians, three colour channels.
        lists: ids front to back, one list a tile, row-major.
        width: px.
        height: px.
        tile_size: px, the one the lists were made with.
        background: colour behind everything, default black.
        profile: floor, ceiling and its gradient, stop.

    Returns:
        The moments; rows that no pixel blended are exactly zero.

    Raises:
        ValueError: the lists or the background do not fit, or there are not three channels.

    Example:
        >>> a = np.array
        >>> splats = Splats(a([[1.5, 0.5]]), a([4.0]), a([[0.0, 0.0, 0.0]]), a([0.5]), a([[1.0, 0, 0]]), a([[3, 3]]))
        >>> moments = screen_moments(splats, [[0]], 1, 1, 16)[0]
        >>> moments[[9, 17, 30]].tolist()
        [0.0625, -0.125, 0.25]
    """
    if splats.colors.shape[1] != _N_CHANNELS:
        raise ValueError(f"splats have {splats.colors.shape[1]} colour channels; they must have {_N_CHANNELS}")
    rows = rows_from_splats(splats)
    black_or_given = background_or_black(background, _N_CHANNELS)
    moments = np.zeros((len(rows.opacities), _N_UPPER + _N_CHANNELS * _N_SCREEN + 1))
    for x, y, ids in listed_pixels(lists, width, height, tile_size):
        px, py = x + 0.5, y + 0.5
        pixel = composite_pixel(ids, rows, px, py, black_or_given, profile)
        suffix_color = np.array(black_or_given)
        for i, alpha, T in zip(
            reversed(pixel.ids), reversed(pixel.alphas), reversed(pixel.transmittances), strict=True
        ):
            more = np.array(rows.colors[i]) - suffix_color
            sigma = sigma_at_pixel(rows.means2d[i], rows.conics[i], px, py)
            dsigma, _ = alpha_from_sigma_vjp(sigma, rows.opacities[i], 1.0, profile)
            v_mean2d, v_conic = sigma_at_pixel_vjp(rows.means2d[i], rows.conics[i], px, py, dsigma)
            of_alpha = np.array([*v_mean2d, *v_conic])
            moments[i] += _moments_of(T * np.outer(more, of_alpha), T * alpha)
            suffix_color = suffix_color + alpha * more
    return moments


def fisher_blocks(
    gaussians: Gaussians,
    camera: Camera,
    moments: Float64[np.ndarray, "N 31"],
    sh_degree: int | None = None,
    profile: Profile = PAPER,
) -> Float64[np.ndarray, "N 6 6"]:
    """Turn a view's screen moments into Fisher blocks by (mean xyz, log scale xyz).

    `F = J^T (sum q_c q_c^T) J + sum_c [J^T (sum q_c w) k_c^T + its transpose + (sum w^2) k_c k_c^T]`; the blocks of
    several views add.

    Source: Hanson et al. 2025 (PUP 3D-GS), the Fisher information by mean and scale.
    Departs: colours depend on the mean by the view direction, as in the code; there the first versions let that term
        leak from one channel into the next, which is not followed.

    Args:
        gaussians: activated.
        camera: the view.
        moments: as `screen_moments` gives them for this view.
        sh_degree: bands in use, default all.
        profile: as the splats were projected with.

    Returns:
        Blocks, symmetric, positive semi-definite; zero where the moments are.

    Raises:
        ValueError: the moments are not of these Gaussians.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])
        >>> moments = np.zeros((1, 31))
        >>> moments[0, 0] = 1.0  # of mean2d x
        >>> fisher_blocks(g, Camera(np.eye(4), K, 8, 8), moments)[0, 0, 0].item()
        4.0
    """
    if moments.shape != (len(gaussians), _N_UPPER + _N_CHANNELS * _N_SCREEN + 1):
        raise ValueError(f"moments has shape {list(moments.shape)}; it must be [{len(gaussians)}, 31]")
    J, k = _parameter_jacobians(gaussians, camera, sh_degree, profile)
    blocks = np.zeros((len(gaussians), 6, 6))
    for i in range(len(gaussians)):
        M = np.zeros((_N_SCREEN, _N_SCREEN))
        M[_UPPER] = moments[i, :_N_UPPER]
        M = M + M.T - np.diag(np.diag(M))
        blocks[i] = J[i].T @ M @ J[i]
        for c in range(_N_CHANNELS):
            start = _N_UPPER + c * _N_SCREEN
            cross = np.outer(J[i].T @ moments[i, start : start + _N_SCREEN], k[i, c])
            blocks[i] += cross + cross.T + moments[i, -1] * np.outer(k[i, c], k[i, c])
    # the two products round differently on either side of the diagonal
    return 0.5 * (blocks + np.transpose(blocks, (0, 2, 1)))


def log_det_scores(blocks: Float64[np.ndarray, "N 6 6"]) -> Float64[np.ndarray, " N"]:
    """Score each Gaussian by `log det F`, the sum of the logarithms of the block's singular values.

    The block is first scaled to a diagonal of ones, `F = D U D` and `log det F = log det U + 2 sum log D`, since its
    parameters differ in unit: a flat Gaussian's block spans more orders of magnitude than float64 has digits.

    Source: Hanson et al. 2025 (PUP 3D-GS), the sensitivity score.
    Departs: the code takes singular values of F itself in float32, so that rounding decides the least of them. Here a
        block is of full rank if U's least singular value is over 6 eps times its largest, NumPy's rule.

    Args:
        blocks: sums over the views, symmetric, positive semi-definite.

    Returns:
        The scores; -inf where a block is not of full rank, which is pruned first.

    Example:
        >>> log_det_scores(np.stack([np.eye(6), np.diag([1.0, 1, 1, 1, 1, 0])])).tolist()
        [0.0, -inf]
    """
    scores = np.full(len(blocks), -np.inf)
    for i in range(len(blocks)):
        diagonal = np.diag(blocks[i])
        if np.all(diagonal > 0.0):
            D = np.sqrt(diagonal)
            values = np.linalg.svd(blocks[i] / D / D[:, None], compute_uv=False).tolist()
            if values[-1] > len(D) * np.finfo(np.float64).eps * values[0]:
                scores[i] = sum(math.log(value) for value in values) + 2.0 * sum(math.log(d) for d in D.tolist())
    return scores


def _moments_of(q: Float64[np.ndarray, "3 5"], weight: float) -> Float64[np.ndarray, "31"]:
    return np.concatenate([(q.T @ q)[_UPPER], (weight * q).ravel(), [weight * weight]])


def _parameter_jacobians(
    gaussians: Gaussians, camera: Camera, sh_degree: int | None, profile: Profile
) -> tuple[Float64[np.ndarray, "N 5 6"], Float64[np.ndarray, "N 3 6"]]:
    """Differentiate (mean2d, conic) and the colours by (mean, log scale): row by row, by the projection's transpose."""
    n = len(gaussians)
    rows = np.zeros((n, _N_SCREEN + _N_CHANNELS, 6))
    for row in range(_N_SCREEN + _N_CHANNELS):
        v = np.zeros((n, _N_SCREEN + _N_CHANNELS))
        v[:, row] = 1.0
        of = project_vjp(
            gaussians, camera, v[:, :2], v[:, 2:5], np.zeros(n), v[:, 5:], sh_degree=sh_degree, profile=profile
        )
        rows[:, row, :3] = of.means
        rows[:, row, 3:] = of.scales * gaussians.scales
    return rows[:, :_N_SCREEN], rows[:, _N_SCREEN:]
