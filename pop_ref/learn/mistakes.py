"""Mistakes that everyone makes once: what they compute, and the sentence that helps.

A mistake is recognised by its numbers: it explains a wrong function if it gives what the function gave on every input
that was tried. The first that does is told.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pop_ref.learn.student import Call, same
from pop_ref.optimizer import BETAS, EPS

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


def _sigma(squares: float = 0.5, cross: float = 1.0, right: float = 0.0, down: float = 0.0) -> Callable[..., Any]:
    """Make `sigma_at_pixel` with other factors, or with the pixel's centre elsewhere."""

    def made(o: Oracle, mean2d: Any, conic: Any, px: float, py: float) -> float:
        (A, B, C), dx, dy = conic, mean2d[0] - px - right, mean2d[1] - py - down
        return squares * (A * dx * dx + C * dy * dy) + cross * B * dx * dy

    return made


def _shifted(right: float, down: float) -> Mistake:
    return Mistake(
        "sigma_at_pixel",
        _sigma(right=right, down=down),
        "Your pixel is half a pixel off: px and py are the pixel's centre already, its index + 0.5.",
        "Use d = mean2d - (px, py) as they are given; add or take away no half.",
    )


def _pixel_vjp(tail: bool) -> Callable[..., Any]:
    """Make `composite_pixel_vjp` without what is behind a splat, or with the splats behind it but no background."""

    def made(o: Oracle, pixel: Any, rows: Any, px: float, py: float, background: Any, v_color: Any, v_T_final: float,
             totals: Any, *profile: Any) -> None:  # fmt: skip
        behind = v_T_final if tail else 0.0
        totals.v_background[:] += pixel.T_final * np.array(v_color)
        for i, alpha, T in zip(
            reversed(pixel.ids), reversed(pixel.alphas), reversed(pixel.transmittances), strict=True
        ):
            color_dot_grad = float(np.dot(rows.colors[i], v_color))
            totals.v_colors[i] += T * alpha * np.array(v_color)
            v_alpha = T * (color_dot_grad - behind)
            behind += alpha * (color_dot_grad - behind) if tail else 0.0
            sigma = o["sigma_at_pixel"](rows.means2d[i], rows.conics[i], px, py)
            v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, rows.opacities[i], v_alpha, *profile)
            v_mean2d, v_conic = o["sigma_at_pixel_vjp"](rows.means2d[i], rows.conics[i], px, py, v_sigma)
            totals.v_opacities[i] += v_opacity
            totals.v_means2d[i] += v_mean2d
            totals.v_means2d_abs[i] += np.abs(v_mean2d)
            totals.v_conics[i] += v_conic

    return made


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


def _adam(first: bool = True, second: bool = True, sign: float = -1.0) -> Callable[..., Any]:
    """Make `adam_step` without the division by 1 - beta1^t or by 1 - beta2^t, or uphill."""

    def made(o: Oracle, params: Any, grads: Any, m: Any, v: Any, step: Any, lr: Any,
             betas: Any = BETAS, eps: float = EPS) -> Any:  # fmt: skip
        params, m, v = dict(params), dict(m), dict(v)
        for name, g in grads.items():
            t = step if isinstance(step, int) else step[name]
            m[name] = betas[0] * m[name] + (1.0 - betas[0]) * g
            v[name] = betas[1] * v[name] + (1.0 - betas[1]) * g * g
            mean = m[name] / (1.0 - betas[0] ** t if first else 1.0)
            size = np.sqrt(v[name] / (1.0 - betas[1] ** t if second else 1.0)) + eps
            params[name] = params[name] + sign * lr[name] * mean / size
        return params, m, v

    return made


def _pixel_by_alpha(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    """Make `composite_pixel` with alpha for a weight."""
    pixel = o["composite_pixel"](ids, rows, px, py, background, *profile)
    color = [pixel.T_final * b for b in background]
    for i, alpha in zip(pixel.ids, pixel.alphas, strict=True):
        color = [sum_ + alpha * c for sum_, c in zip(color, rows.colors[i], strict=True)]
    return pixel._replace(color=color)


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


def _split_beside(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
    """Make `split_rows` that keeps the parents."""
    kept = o["split_rows"](rows, mask, normals, *revised)
    n = int(np.sum(~mask))

    def both(old: Any, new: Any) -> Any:
        return {name: np.concatenate([old[name], new[name][n:]]) for name in old}

    return type(kept)(both(rows.params, kept.params), both(rows.m, kept.m), both(rows.v, kept.v))


def _unturned(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
    """Make `split_rows` that draws children along the world's axes."""
    upright = {**rows.params, "quats": np.tile([1.0, 0.0, 0.0, 0.0], (len(mask), 1))}
    split = o["split_rows"](type(rows)(upright, rows.m, rows.v), mask, normals, *revised)
    quats = o["split_rows"](rows, mask, normals, *revised).params["quats"]
    return type(split)({**split.params, "quats": quats}, split.m, split.v)


def _pixel(o: Oracle, ids: Any, rows: Any, px: float, py: float, background: Any, *profile: Any) -> Any:
    return o["composite_pixel"](ids, rows, px, py, [0.0] * len(background), *profile)


_TRANSPOSED: Final = (
    "It turns the world into the Gaussian's own frame, and what is wanted turns the Gaussian's axes into the world."
)
_HALF: Final = "The exponent of a Gaussian is half of d^T Q d: exp(-x^2 / 2) has a 2 under its square."

MISTAKES: Final = (
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
        "sigma_at_pixel",
        _sigma(1.0, 1.0),
        f"A half is missing before the two squares. {_HALF}",
        "The cross term has no half, because B stands twice in the symmetric matrix Q and once in the conic.",
    ),
    Mistake(
        "sigma_at_pixel",
        _sigma(1.0, 2.0),
        f"A half is missing: your exponent is twice what it should be. {_HALF}",
        "Halve the whole of A dx dx + 2 B dx dy + C dy dy.",
    ),
    Mistake(
        "sigma_at_pixel",
        _sigma(0.5, 0.5),
        "The cross term is halved once too often: B stands twice in the symmetric matrix Q, once in the conic.",
        "Write Q = [[A, B], [B, C]] and multiply d^T Q d out before you halve it.",
    ),
    Mistake(
        "falloff",
        lambda o, sigma: float(np.exp(sigma)),
        "Your falloff grows with the distance: the exponent's sign is missing.",
        "It is 1 at the centre and less everywhere else.",
    ),
    Mistake(
        "alpha_from_sigma",
        lambda o, sigma, opacity, *profile: (opacity * o["falloff"](sigma), False),
        "Your alpha has neither ceiling nor floor.",
        "Take min(profile.alpha_ceiling, ...), and skip the splat where sigma < 0 or alpha < profile.alpha_floor.",
    ),
    Mistake(
        "composite_pixel",
        _pixel,
        "The background is missing: what light is left behind the last splat shows it.",
        "Add T_final times the background to the colour.",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(tail=False),
        "The tail is missing from dC/dalpha: more alpha shows more of a splat's own colour, and hides the colour of all"
        " that is behind it. Yours has the first part only.",
        "C = T (alpha c + (1 - alpha) behind), so dC/dalpha = T (c - behind). Walk from the back: start with behind ="
        " background . v_color + v_T_final, and after each splat behind += alpha (color_dot_grad - behind).",
    ),
    Mistake(
        "composite_pixel_vjp",
        _pixel_vjp(tail=True),
        "The background is missing from the light behind the last splat.",
        "Before the walk from back to front, behind is background . v_color + v_T_final.",
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
        "adam_step",
        _adam(first=False, second=False),
        "The two running means are not corrected: both start at 0, so that the first steps have the wrong length.",
        "Divide m by 1 - beta1^t and v by 1 - beta2^t before the quotient; keep m and v themselves as they are.",
    ),
    Mistake(
        "prune_rows",
        lambda o, rows, mask: o["prune_rows"](rows, ~mask),
        "You keep the rows that are to be removed: the mask selects what goes.",
        "rows[~mask] are the survivors, in every parameter and both moments.",
    ),
    Mistake(
        "l2_vjp",
        lambda o, *given: 0.5 * o["l2_vjp"](*given),
        "A two is missing: the derivative of a square is twice its base.",
        "l2 is a mean of squares, without a half in front.",
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
    _shifted(0.5, 0.5),
    _shifted(-0.5, -0.5),
    _shifted(0.5, 0.0),
    _shifted(0.0, 0.5),
    _shifted(-0.5, 0.0),
    _shifted(0.0, -0.5),
    Mistake(
        "sigma_at_pixel",
        _sigma(0.5, 0.0),
        "The cross term is missing: a splat that is turned has B, too.",
        "sigma = (A dx dx + C dy dy) / 2 + B dx dy.",
    ),
    Mistake(
        "sigma_at_pixel",
        lambda o, mean2d, conic, px, py: o["sigma_at_pixel"](mean2d, conic, py, px),
        "The pixel's x and y are exchanged: rows stand for columns.",
        "px runs along the columns of an image, py along its rows: dx = mean2d[0] - px, dy = mean2d[1] - py.",
    ),
    Mistake(
        "alpha_from_sigma",
        lambda o, sigma, opacity, *profile: o["alpha_from_sigma"](sigma, 1.0, *profile),
        "The opacity is missing: alpha is the opacity times the falloff.",
        "alpha = min(ceiling, opacity * falloff(sigma)).",
    ),
    Mistake(
        "composite_pixel",
        _pixel_by_alpha,
        "Your weight is alpha alone: a splat gives its colour times alpha, times the light that is left, T.",
        "weight = T * alpha, with T before this splat.",
    ),
    Mistake(
        "composite_pixel",
        lambda o, ids, *given: o["composite_pixel"](list(reversed(ids)), *given),
        "You walk from back to front; the list is in order, front first.",
        "Go through ids as they come: T starts at 1 at the eye.",
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
        "adam_step",
        _adam(sign=1.0),
        "You go up the loss: the gradient points to where the loss rises, so a step is taken against it.",
        "x - lr m / sqrt(v), with a minus.",
    ),
    Mistake(
        "adam_step",
        _adam(first=False),
        "The running mean m is not divided by 1 - beta1^t: it starts at 0, so that the first steps are too short.",
        "Divide for the quotient only; what is kept and returned is m itself.",
    ),
    Mistake(
        "adam_step",
        _adam(second=False),
        "The running mean v is not divided by 1 - beta2^t: it starts at 0, so that the first steps are too long.",
        "Divide for the quotient only; what is kept and returned is v itself.",
    ),
    Mistake(
        "split_rows",
        _split_beside,
        "The parents stay; a split puts two children in the place of one parent.",
        "Keep the rows that were not selected, rows[~mask], and append both kinds of children.",
    ),
    Mistake(
        "split_rows",
        _unturned,
        "The draws are not turned: the children must lie along the parent's own axes.",
        "mean + R(q) (s * eps): scale each draw first, then turn it.",
    ),
)


def explained_by(calls: Sequence[Call], oracle: Oracle) -> Mistake | None:
    """Find the mistake that gives what a function gave, on every call, also on those that came out right.

    Args:
        calls: of one function.
        oracle: the oracle's functions by name.
    """
    for mistake in MISTAKES:
        if calls and mistake.function == calls[0].function and all(_explains(mistake, c, oracle) for c in calls):
            return mistake
    return None


def _explains(mistake: Mistake, call: Call, oracle: Oracle) -> bool:
    given = copy.deepcopy(call.given)
    try:
        made = mistake.made(oracle, *given, *call.named.values())
    except Exception:
        # a mistake that does not fit these arguments explains nothing
        return False
    changed = tuple(a for b, a in zip(call.given, given, strict=True) if repr(b) != repr(a))
    return same((made, changed), call.found)
