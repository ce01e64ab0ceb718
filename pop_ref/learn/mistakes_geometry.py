"""Mistakes that everyone makes once, of the stages from raw parameters to tiles; see `mistakes`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

Oracle = dict[str, Callable[..., Any]]


@dataclass(frozen=True)
class Mistake:
    """A mistake in one function.

    Attributes:
        function: which.
        made: given the oracle's functions by name and the arguments, what the mistake computes.
        sentence: what is wrong.
        hint: where to look.
    """

    function: str
    made: Callable[..., Any]
    sentence: str
    hint: str


def _turned(name: str) -> Callable[..., Any]:
    return lambda o, *given: np.swapaxes(o[name](*given), 1, 2)


def _with_transposed_camera(name: str) -> Callable[..., Any]:
    def made(o: Oracle, values: Any, viewmat: Any) -> Any:
        back = viewmat.copy()
        back[:3, :3] = viewmat[:3, :3].T
        return o[name](values, back)

    return made


def _transposed_covars(o: Oracle, quats: Any, scales: Any) -> Any:
    inverse = quats * np.array([1.0, -1.0, -1.0, -1.0])
    return o["covars_from_quats_scales"](inverse, scales)


def _without_length(o: Oracle, quats: Any) -> Any:
    w, x, y, z = quats.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _without_length_back(o: Oracle, quats: Any, v_rotmats: Any) -> Any:
    """Make `rotmats_from_quats_vjp` up to the unit quaternion; R is quadratic, so central differences are exact."""
    units = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    slopes = [0.5 * (_without_length(o, units + e) - _without_length(o, units - e)) for e in np.eye(4)]
    return np.stack([np.sum(v_rotmats * slope, axis=(1, 2)) for slope in slopes], axis=1)


def _positive_first_harmonics(o: Oracle, dirs: Any, degree: int) -> Any:
    signs = np.ones((degree + 1) ** 2)
    signs[1:4:2] = -1.0
    return signs * o["sh_basis"](dirs, degree)


def _colors(half: float, unit: bool) -> Callable[..., Any]:
    """Make `colors_from_sh` without the half, or with directions as they are given."""

    def made(o: Oracle, sh: Any, dirs: Any, degree: int) -> Any:
        basis = o["sh_basis"](dirs / np.linalg.norm(dirs, axis=1, keepdims=True) if unit else dirs, degree)
        sums = [row @ each[: basis.shape[1]] for row, each in zip(basis, sh, strict=True)]
        return np.maximum(np.array(sums) + half, 0.0)

    return made


def _lists(order: Callable[..., Any], by_column: bool = False) -> Callable[..., Any]:
    """Make `tile_lists` in another order of splats, or with the tiles of a column one after the other."""

    def made(
        o: Oracle, means2d: Any, radii: Any, depths: Any, width: int, height: int, size: int, *profile: Any
    ) -> Any:
        n_x, n_y = o["grid_size"](width, height, size)
        lists: list[list[int]] = [[] for _ in range(n_x * n_y)]
        rects = o["tile_rects"](means2d, radii, width, height, size, *profile).tolist()
        for i in sorted(range(len(depths)), key=lambda i: order(float(depths[i]), i)):
            for y in range(rects[i][1], rects[i][3]):
                for x in range(rects[i][0], rects[i][2]):
                    lists[x * n_y + y if by_column else y * n_x + x].append(i)
        return lists

    return made


def _reach(squared: bool, k: float = 0.0) -> Callable[..., Any]:
    """Make `radii_from_covars2d` without the 2 under its root, or with one reach for every opacity."""

    def made(o: Oracle, covars2d: Any, opacities: Any, *profile: Any) -> Any:
        taken = o["radii_from_covars2d"](covars2d, opacities, *profile) > 0
        with np.errstate(all="ignore"):
            reach = np.sqrt((2.0 if squared else 1.0) * np.log(255.0 * np.maximum(opacities, 1e-9)))
            reach = np.minimum(np.nan_to_num(reach), 3.33) if k == 0.0 else np.full(len(opacities), k)
            sides = reach[:, None] * np.sqrt(np.einsum("nii->ni", covars2d))
        return np.where(taken, np.ceil(sides), 0).astype(np.int64)

    return made


def _without_z_of_the_diagonal(
    o: Oracle, means_cam: Any, K: Any, width: int, height: int, v: Any, *profile: Any
) -> Any:
    """Make `projection_jacobians_vjp` that forgets that fx / z and fy / z depend on z."""
    back = o["projection_jacobians_vjp"](means_cam, K, width, height, v, *profile).copy()
    back[:, 2] += (K[0, 0] * v[:, 0, 0] + K[1, 1] * v[:, 1, 1]) / means_cam[:, 2] ** 2
    return back


_TRANSPOSED: Final = (
    "It turns the world into the Gaussian's own frame, and what is wanted turns the Gaussian's axes into the world."
)

GEOMETRY: Final = (
    Mistake(
        "rotmats_from_quats",
        _turned("rotmats_from_quats"),
        f"Your rotation is transposed. {_TRANSPOSED}",
        "Turn (1, 0, 0) by a quarter about z, q = (1, 0, 0, 1): it must land on (0, 1, 0), so the first column of R is"
        " (0, 1, 0). Exchange the signs of the terms with w.",
    ),
    Mistake(
        "rotmats_from_quats",
        lambda o, quats: o["rotmats_from_quats"](quats[:, [3, 0, 1, 2]]),
        "Your quaternion is read as (x, y, z, w); here the real part comes first, (w, x, y, z).",
        "The identity is (1, 0, 0, 0).",
    ),
    Mistake(
        "rotmats_from_quats",
        _without_length,
        "Your quaternion is used as it is given; it must be divided by its length first, since only then is it a"
        " rotation.",
        "Training moves its four numbers freely, so that its length is anything; unit_quats_from_quats divides.",
    ),
    Mistake(
        "covars_from_quats_scales",
        _transposed_covars,
        f"Your rotation is transposed: the covariance is R^T S S R and not R S S R^T. {_TRANSPOSED}",
        "With M = R diag(s) the covariance is M M^T. M^T M is another matrix.",
    ),
    Mistake(
        "covars_from_quats_scales",
        lambda o, quats, scales: o["covars_from_quats_scales"](quats, np.sqrt(scales)),
        "Your scales enter once; a covariance holds squares, because scales are standard deviations.",
        "With M = R diag(s) the covariance is M M^T, in which every scale stands twice.",
    ),
    Mistake(
        "sh_basis",
        _positive_first_harmonics,
        "Two of your harmonics of degree 1 have the wrong sign: they are (-y, z, -x) times a constant.",
        "The signs are a convention, and every file of splats follows it.",
    ),
    Mistake(
        "colors_from_sh",
        _colors(half=0.0, unit=True),
        "The half is missing: a Gaussian whose coefficients are 0 is grey, not black.",
        "c = max(sum_k Y_k h_k + 0.5, 0).",
    ),
    Mistake(
        "colors_from_sh",
        _colors(half=0.5, unit=False),
        "Your direction is used as it is given; the harmonics ask for one of length 1.",
        "Divide each direction by its length before sh_basis.",
    ),
    Mistake(
        "means_cam_from_means",
        _with_transposed_camera("means_cam_from_means"),
        "Your camera's rotation is transposed.",
        "viewmat takes the world into the camera: p = R mean + t, without a transpose.",
    ),
    Mistake(
        "covars_cam_from_covars",
        _with_transposed_camera("covars_cam_from_covars"),
        "Your camera's rotation is transposed.",
        "A linear map A turns a covariance S into A S A^T; here A is R = viewmat[:3, :3].",
    ),
    Mistake(
        "camera_center",
        lambda o, viewmat: -viewmat[:3, 3],
        "Your centre is -t, which is in the camera's frame; it is asked for in the world's.",
        "The centre is the point that viewmat takes to 0: solve R c + t = 0.",
    ),
    Mistake(
        "project_means",
        lambda o, means_cam, K, width, height, *profile: (
            o["project_means"](means_cam, K, width, height, *profile) - K[:2, 2]
        ),
        "The principal point is missing: you measure from the optical axis, pixels are counted from the corner.",
        "Add (cx, cy) = (K[0, 2], K[1, 2]).",
    ),
    Mistake(
        "conics_from_covars2d",
        lambda o, covars2d: np.where(
            np.linalg.det(covars2d)[:, None] > 0.0, covars2d.reshape(-1, 4)[:, [0, 1, 3]], 0.0
        ),
        "You return the covariance; a conic is its inverse.",
        "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
    ),
    Mistake(
        "conics_from_covars2d",
        lambda o, covars2d: o["conics_from_covars2d"](covars2d) * np.array([1.0, -1.0, 1.0]),
        "The off-diagonal of the inverse has the wrong sign.",
        "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
    ),
    Mistake(
        "conics_from_covars2d_vjp",
        lambda o, covars2d, v: o["conics_from_covars2d_vjp"](covars2d, v * np.array([1.0, 2.0, 1.0])),
        "The off-diagonal counts twice: it stands once in the conic and twice in the matrix.",
        "Give each of the matrix's two entries half of v_xy.",
    ),
    Mistake(
        "opacities_from_logits_vjp",
        lambda o, logits, v: v.copy(),
        "The sigmoid's slope is missing.",
        "o = 1 / (1 + exp(-x)) has the derivative o (1 - o).",
    ),
    Mistake(
        "covars_from_quats_scales",
        lambda o, quats, scales: np.stack([np.diag(s * s) for s in scales]),
        "The rotation has gone from your covariance, diag(s)^2 is left: you multiply M^T M where M M^T is asked for, or"
        " your M scales its rows, diag(s) R.",
        "M = R diag(s) scales columns, R * s in NumPy; a column of R is an axis of the Gaussian. Then M @ M.T.",
    ),
    Mistake(
        "covars_from_quats_scales",
        lambda o, quats, scales: o["covars_from_quats_scales"](quats, scales**2),
        "Your scales enter four times; a covariance holds squares of standard deviations, so each enters twice.",
        "With M = R diag(s), without a square, the covariance is M M^T.",
    ),
    Mistake(
        "sh_basis",
        lambda o, dirs, degree: o["sh_basis"](-dirs, degree),
        "Your direction runs from the Gaussian to the camera; it is asked for from the camera to the Gaussian.",
        "Use (x, y, z) as they are given: the harmonics of degree 1 are (-y, z, -x) times a constant.",
    ),
    Mistake(
        "camera_center",
        lambda o, viewmat: -viewmat[:3, :3] @ viewmat[:3, 3],
        "Your rotation is not transposed: the centre is -R^T t, and yours is -R t.",
        "Solve R c + t = 0; the inverse of a rotation is its transpose.",
    ),
    Mistake(
        "means_cam_from_means",
        lambda o, means, viewmat: (means + viewmat[:3, 3]) @ viewmat[:3, :3].T,
        "You add t before it turns; a point is turned first and moved then.",
        "p = R mean + t.",
    ),
    Mistake(
        "rotmats_from_quats_vjp",
        _without_length_back,
        "The division by the length is not walked back: yours is the cotangent of the unit quaternion, not of q.",
        "End with unit_quats_from_quats_vjp(quats, v_units).",
    ),
    Mistake(
        "tile_lists",
        _lists(lambda depth, i: (depth, i), by_column=True),
        "Your tiles are numbered down the columns: columns stand for rows. Tile (x, y) is number y * tiles_x + x.",
        "Row-major order: all tiles of the first row, then the second.",
    ),
    Mistake(
        "tile_lists",
        _lists(lambda depth, i: (-depth, i)),
        "Your lists run from back to front; the nearest splat comes first.",
        "Sort by (depth, index), the smaller depth first.",
    ),
    Mistake(
        "tile_lists",
        _lists(lambda depth, i: i),
        "Your lists are not sorted by depth.",
        "Go through the splats in the order of (depth, index).",
    ),
    Mistake(
        "tile_rects",
        lambda o, *given: o["tile_rects"](*given)[:, [1, 0, 3, 2]],
        "x and y are exchanged: columns stand for rows. A rectangle is (x0, y0, x1, y1).",
        "tiles_x, tiles_y = grid_size(width, height, tile_size), x first.",
    ),
    Mistake(
        "tile_rects",
        lambda o, *given: o["tile_rects"](*given)[:, [0, 2, 1, 3]],
        "Your rectangle has one axis after the other, (x0, x1, y0, y1); it is (x0, y0, x1, y1).",
        "First the corner with the smaller numbers, then the other.",
    ),
    Mistake(
        "tile_rects",
        lambda o, *given: o["tile_rects"](*given) - np.pad(o["tile_rects"](*given)[:, :2], ((0, 0), (2, 0))),
        "Your last two numbers are the number of tiles; what is asked for is one past the last tile.",
        "(x0, y0, x1, y1), half open: x1 - x0 tiles lie between.",
    ),
    Mistake(
        "scales_from_log_scales_vjp",
        lambda o, log_scales, v: log_scales * v,
        "You multiply by the logarithm; the derivative of exp(x) is exp(x).",
        "v_scales times the scales themselves.",
    ),
    Mistake(
        "scales_from_log_scales_vjp",
        lambda o, log_scales, v: v.copy(),
        "The exponential's slope is missing: the derivative of exp(x) is exp(x).",
        "v_scales times the scales themselves.",
    ),
    Mistake(
        "unit_quats_from_quats_vjp",
        lambda o, quats, v: v / np.linalg.norm(quats, axis=1, keepdims=True),
        "The part along q is still in it: a longer q is the same rotation, so the loss does not ask for it.",
        "Take u (u . v) from v before you divide by the length.",
    ),
    Mistake(
        "project_means",
        lambda o, means_cam, K, *given: o["project_means"](means_cam, K[[1, 0, 2]][:, [1, 0, 2]], *given),
        "The numbers of K for x and for y are exchanged: x goes with fx and cx, y with fy and cy.",
        "fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2].",
    ),
    Mistake(
        "unit_quats_from_quats",
        lambda o, quats: quats / np.linalg.norm(quats),
        "You divide all rows by one length, that of the whole array; each quaternion has a length of its own.",
        "np.linalg.norm(quats, axis=1, keepdims=True).",
    ),
    Mistake(
        "opacities_from_logits",
        lambda o, logits: o["opacities_from_logits"](-logits),
        "The sign of the exponent is wrong: a large logit must give an opacity near 1, and yours goes to 0.",
        "o = 1 / (1 + exp(-x)).",
    ),
    Mistake(
        "opacities_from_logits_vjp",
        lambda o, logits, v: o["opacities_from_logits"](logits) * v,
        "A part of the sigmoid's slope is missing: o (1 - o), and yours is o.",
        "Near o = 1 the sigmoid is flat, so that the gradient must vanish there, too.",
    ),
    Mistake(
        "scales_from_log_scales_vjp",
        lambda o, log_scales, v: v / np.exp(log_scales),
        "You divide by the slope; a cotangent is multiplied by it on the way back.",
        "v_scales times the scales themselves.",
    ),
    Mistake(
        "unit_quats_from_quats_vjp",
        lambda o, quats, v: o["unit_quats_from_quats_vjp"](quats, v) * np.linalg.norm(quats, axis=1, keepdims=True),
        "The division by the length is missing: twice as long a q turns half as fast.",
        "v_q = (v - u (u . v)) / |q|.",
    ),
    Mistake(
        "means_cam_from_means",
        lambda o, means, viewmat: means @ viewmat[:3, :3].T,
        "You turn the points and do not move them: t is missing.",
        "p = R mean + t, with t = viewmat[:3, 3].",
    ),
    Mistake(
        "covars_cam_from_covars",
        lambda o, covars, viewmat: viewmat[:3, :3] @ covars,
        "You turn one side of the covariance only; a matrix of second moments is turned on both.",
        "A linear map A turns a covariance S into A S A^T; here A is R = viewmat[:3, :3].",
    ),
    Mistake(
        "projection_jacobians_vjp",
        _without_z_of_the_diagonal,
        "Two terms of z are missing: fx / z and fy / z on the Jacobian's diagonal depend on z, too.",
        "Add -(fx v_xx + fy v_yy) / z^2 to the cotangent of z.",
    ),
    Mistake(
        "radii_from_covars2d",
        _reach(squared=False),
        "A 2 is missing under the root: alpha is o exp(-d^2 / 2), so that it falls to 1/255 at d^2 = 2 ln(255 o).",
        "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations.",
    ),
    Mistake(
        "radii_from_covars2d",
        _reach(squared=True, k=3.0),
        "Your reach is three standard deviations whatever the opacity; it ends where alpha falls to 1/255.",
        "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations: a faint splat ends sooner.",
    ),
    Mistake(
        "radii_from_covars2d",
        _reach(squared=True, k=3.33),
        "Your reach is 3.33 standard deviations whatever the opacity; that is its upper bound only.",
        "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations: a faint splat ends sooner.",
    ),
    Mistake(
        "tile_lists",
        _lists(lambda depth, i: (-depth, -i)),
        "Your lists run from back to front; the nearest splat comes first.",
        "Sort by (depth, index), the smaller depth first.",
    ),
    Mistake(
        "radii_from_covars2d",
        lambda o, covars2d, *given: (
            o["radii_from_covars2d"](covars2d * covars2d * np.eye(2), *given)
            * (o["radii_from_covars2d"](covars2d, *given) > 0)
        ),
        "You take variances for standard deviations: the covariance's diagonal holds squares.",
        "The reach is k times the root of the diagonal's entry.",
    ),
)
