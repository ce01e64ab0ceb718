"""Scenes at scale, the same on every machine: up to 70,000 Gaussians, long lists, many tiles, tiles cut by the border.

They are made by formula, of integers and of elementwise arithmetic alone, and every number is one of float32, so that
all precisions read the same scene. What the oracle says of them is kept beside (`corpus_answers`), because the oracle
would take minutes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.constants import INRIA, PAPER, Profile
from pop_ref.records import Camera, Gaussians

# odd multipliers: i -> i M mod 2^16 visits every residue, each column of numbers in an order of its own
_MULTIPLIERS: Final = (40503, 24571, 52711, 14009, 61001, 33391, 9973, 46337, 27737, 57193, 19249, 38839)


@dataclass(frozen=True)
class Plan:
    """What a scene of the corpus is for, in numbers.

    Attributes:
        n: Gaussians.
        width, height: px.
        tile_size: px.
        sizes: least and largest standard deviation, px at their depth.
        opacities: least and largest.
        degree: of harmonics.
        turn: wxyz of the camera, of any norm.
        oblong: fy over fx.
        small: the oracle itself draws it in a second.
        profile: the constants; Inria's have the principal point in the middle and their own tiles.
        without: rows that are left out, because rounding decides their extents.
        depths: the nearest and the farthest; beyond a factor of 10 they are spread by their logarithm.
        beyond: px by which centres lie outside the image at most.
        apart: where it is not 0, rows come in pairs at one place, whose depths differ by this share.
    """

    n: int
    width: int
    height: int
    tile_size: int
    sizes: tuple[float, float]
    opacities: tuple[float, float]
    degree: int = 0
    turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    oblong: float = 1.0
    small: bool = False
    profile: Profile = PAPER
    without: tuple[int, ...] = ()
    depths: tuple[float, float] = (1.5, 6.0)
    beyond: float = 3.5
    apart: float = 0.0


# rows of hundreds_of_inria whose extents rounding decides
_UNCLEAR: Final = (
    *(25, 59, 64, 77, 93, 99, 111, 118, 131, 134, 147, 150, 158),
    *(159, 181, 202, 204, 220, 221, 236, 251, 252, 260, 275, 287),
)

# and of ten_thousand_in_a_tile
_DECIDED: Final = (4288, 5371, 7179, 9709)

PLANS: Final[dict[str, Plan]] = {
    "fifty": Plan(50, 33, 17, 16, (2.0, 9.0), (0.05, 0.8), 3, (3.0, 1.0, -2.0, 0.5), 1.25, small=True),
    "slanted": Plan(80, 96, 64, 16, (0.5, 9.0), (0.1, 0.95), 1, (0.5, -0.25, 0.125, 0.75), 1.125),
    "hundreds_in_a_tile": Plan(700, 33, 49, 16, (4.0, 12.0), (0.006, 0.03), 0, (2.0, 0.0, 1.0, 1.0)),
    "a_thousand_in_a_tile": Plan(1500, 33, 17, 16, (24.0, 72.0), (0.0045, 0.0075), 0, (1.0, 0.5, 0.0, 0.0)),
    "many_tiles": Plan(2000, 121, 90, 4, (0.75, 3.5), (0.05, 0.985), 2, (1.0, 2.0, 3.0, 4.0), 0.875),
    "five_thousand": Plan(5000, 200, 120, 4, (0.75, 4.0), (0.02, 0.95), 0, (5.0, -1.0, 0.5, 1.0), 1.0),
    "hundreds_of_tiles_a_splat": Plan(50, 121, 90, 4, (8.0, 30.0), (0.02, 0.9), 0, (3.0, -1.0, 1.0, 2.0), 1.0),
    "far_and_huge": Plan(
        16, 521, 37, 4, (8.0, 450.0), (0.05, 0.6), 0, (1.0, 0.25, -0.5, 0.25), 1.0, depths=(1.5, 3000.0), beyond=260.0
    ),
    "near_equal_depths": Plan(
        400, 64, 48, 16, (1.0, 4.0), (0.1, 0.8), 0, (1.0, 0.5, 0.25, -0.5), 1.0, depths=(0.5, 500.0), apart=4e-5
    ),
    "ten_thousand_in_a_tile": Plan(
        10_000, 16, 15, 16, (0.05, 0.4), (0.006, 0.03), 0, (1.0, 0.0, 1.0, 0.5), without=_DECIDED, beyond=0.25
    ),
    "seventy_thousand": Plan(70_000, 521, 259, 4, (0.2, 1.2), (0.05, 0.9), 0, (1.0, -0.25, 0.5, 0.25), beyond=1.5),
    "fifty_of_inria": Plan(
        60, 33, 17, 16, (2.0, 9.0), (0.05, 1.0), 3, (3.0, 1.0, -2.0, 0.5), 1.25, True, INRIA, (9, 10, 31, 36, 45, 46)
    ),
    "hundreds_of_inria": Plan(
        300, 89, 49, 16, (2.0, 6.0), (0.004, 0.2), 1, (2.0, 0.0, 1.0, 1.0), 1.0, False, INRIA, _UNCLEAR
    ),
}


def _column(n: int, k: int) -> np.ndarray:
    """Return n numbers in (0, 1), evenly spread and in an order that no other column has."""
    return (np.mod((np.arange(n, dtype=np.int64) + 1) * _MULTIPLIERS[k], 2**16) + 0.5) / 2**16


def _depths(plan: Plan) -> np.ndarray:
    """Return depths of which no two are so close to each other that rounding could exchange them."""
    low, high = plan.depths
    n = plan.n // 2 if plan.apart else plan.n
    place = np.mod(np.arange(n) * _stride(n), n) + 0.5
    found = low + (high - low) * place / n if high < 10.0 * low else low * (high / low) ** (place / n)
    if plan.apart:
        # of a pair the first in memory is as often the farther one
        farther = np.where(np.arange(n) % 2 == 0, plan.apart, -plan.apart)
        found = np.concatenate([found * (1.0 + farther), found])
    return found


def _places(plan: Plan, k: int) -> np.ndarray:
    """Return a column of places; those of a pair are one."""
    half = plan.n // 2
    return np.tile(_column(half, k), 2) if plan.apart else _column(plan.n, k)


def _between(low: float, high: float, share: np.ndarray) -> np.ndarray:
    return low + (high - low) * share


def _float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def corpus_scene(name: str) -> Scene:
    """Return the scene of that name in `PLANS`."""
    plan = PLANS[name]
    n, fx = plan.n, 64.0
    fy = fx * plan.oblong
    centred = plan.profile.principal_point == "centred"
    cx, cy = 0.5 * plan.width + (0.0 if centred else 1.25), 0.5 * plan.height - (0.0 if centred else 0.75)
    depths = _depths(plan)
    # a few pixels beyond the image on all sides, or many
    x = (_between(-plan.beyond, plan.width + plan.beyond, _places(plan, 0)) - cx) / fx * depths
    y = (_between(-plan.beyond, plan.height + plan.beyond, _places(plan, 1)) - cy) / fy * depths
    R, t = _float32(_rotation(plan.turn)), np.array([0.5, -0.25, 0.75])
    moved = np.stack([x - t[0], y - t[1], depths - t[2]])
    means = _float32(np.stack([R[0, k] * moved[0] + R[1, k] * moved[1] + R[2, k] * moved[2] for k in range(3)], 1))
    px = np.stack([_between(*plan.sizes, _column(n, k) ** 2) for k in (2, 3, 4)], 1)
    scales = _float32(px * depths[:, None] / fx)
    # of norms from a quarter to some three
    quats = np.stack([_column(n, k) - 0.5 for k in (5, 6, 7, 8)], 1)
    length = np.sqrt(np.sum(quats * quats, axis=1, keepdims=True))
    quats = _float32(quats / length * _between(0.25, 3.0, _column(n, 9))[:, None])
    opacities = _float32(_between(*plan.opacities, _column(n, 10)))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, t
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    camera = Camera(viewmat, K, plan.width, plan.height)
    g = Gaussians(means, quats, scales, opacities, _harmonics(n, plan.degree))
    size = None if plan.profile.extent == "square" else plan.tile_size
    scene = Scene(g, camera, (0.25, 0.5, 0.75), plan.profile, size)
    return scene.rows(np.setdiff1d(np.arange(n), plan.without)) if plan.without else scene


def _stride(n: int) -> int:
    # near n over the golden section, and without a common factor
    return next(k for k in range(int(0.618 * n), n) if np.gcd(k, n) == 1)


def _rotation(quat: tuple[float, float, float, float]) -> np.ndarray:
    w, x, y, z = quat
    s = w * w + x * x + y * y + z * z
    return (
        np.array(
            [
                [s - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), s - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), s - 2 * (x * x + y * y)],
            ]
        )
        / s
    )


def _harmonics(n: int, degree: int) -> np.ndarray:
    """Return coefficients in eighths; one Gaussian in sixteen is darker than black in one channel."""
    k = np.arange(n * (degree + 1) ** 2 * 3, dtype=np.int64)
    sh = (np.mod(k * 2654435761, 2**20) // 2**17 - 3.5).reshape(n, -1, 3) / 8.0
    sh[:, 0] = 3.0 * sh[:, 0] + 1.0
    rows = np.arange(0, n, 16)
    sh[rows, 0, rows % 3] = -3.0
    return sh
