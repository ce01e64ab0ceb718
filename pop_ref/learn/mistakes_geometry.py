"""Mistakes that everyone makes once, from raw parameters to the screen; see `mistakes`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from pop_ref.learn.probes import Oracle
from pop_ref.learn.splat import rotmats_from_quats

# of one function, by what is wrong: where to look, and what each such mistake computes
Known = dict[str, tuple[str, *tuple[Callable[..., Any], ...]]]


def with_turned_rotation(viewmat: np.ndarray) -> np.ndarray:
    """Transpose a camera's rotation."""
    turned = viewmat.copy()
    turned[:3, :3] = viewmat[:3, :3].T
    return turned


def _without_length_back(o: Oracle, quats: Any, v_rotmats: Any) -> Any:
    """Make `rotmats_from_quats_vjp` up to the unit quaternion; R is quadratic, so central differences are exact."""
    units = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    slopes = [0.5 * (rotmats_from_quats(units + e) - rotmats_from_quats(units - e)) for e in np.eye(4)]
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


def _along_q(o: Oracle, quats: Any, v: Any) -> Any:
    """Make `unit_quats_from_quats_vjp` that takes the part along u out as a multiple of q."""
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    return (v - quats * np.sum(quats / length * v, axis=1, keepdims=True)) / length


def _covars_back(widths: bool = True, turned: bool = True) -> Callable[..., Any]:
    """Make `covars_from_quats_scales_vjp` without the widths in the cotangent of R, or without R in that of s."""

    def made(o: Oracle, quats: Any, scales: Any, v_covars: Any) -> Any:
        R = o["rotmats_from_quats"](quats)
        v_M = (v_covars + np.swapaxes(v_covars, 1, 2)) @ (R * scales[:, None, :])
        v_R = v_M * scales[:, None, :] if widths else v_M
        v_s = np.sum(R * v_M, axis=1) if turned else np.sum(v_M, axis=1)
        return o["rotmats_from_quats_vjp"](quats, v_R), v_s

    return made


def _colors_back(divided: bool) -> Callable[..., Any]:
    """Make `colors_from_sh_vjp` that keeps the part along the direction, divided by the length or not."""

    def made(o: Oracle, sh: Any, dirs: Any, degree: int, v_colors: Any) -> Any:
        length = np.linalg.norm(dirs, axis=1, keepdims=True)
        n = (degree + 1) ** 2
        lit = o["colors_from_sh"](sh, dirs, degree) > 0.0
        v_basis = np.einsum("nkc,nc->nk", sh[:, :n], np.where(lit, v_colors, 0.0))
        v_units = o["sh_basis_vjp"](dirs / length, degree, v_basis)
        return o["colors_from_sh_vjp"](sh, dirs, degree, v_colors)[0], v_units / length if divided else v_units

    return made


def _first_degree(x: float, y: float, z: float) -> Callable[..., Any]:
    """Make `sh_basis` whose harmonics of degree 1 stand in the order x, y, z, with these signs."""

    def made(o: Oracle, dirs: Any, degree: int) -> Any:
        basis = o["sh_basis"](dirs, degree)
        if degree > 0:
            basis[:, 1:4] = np.sqrt(3.0 / (4.0 * np.pi)) * np.array([x, y, z]) * dirs
        return basis

    return made


def _point_over_z(o: Oracle, means_cam: Any, K: Any, *given: Any) -> Any:
    """Make `project_means` that divides the principal point by z, too."""
    focal = np.array([K[0, 0], K[1, 1]])
    return (means_cam[:, :2] * focal + K[:2, 2]) / means_cam[:, 2:]


def _once_by_z(o: Oracle, means_cam: Any, K: Any, width: int, height: int, v: Any, *profile: Any) -> Any:
    """Make `projection_jacobians_vjp` that divides an offset by z once where it should by z^2."""
    back = o["projection_jacobians_vjp"](means_cam, K, width, height, v, *profile).copy()
    z = means_cam[:, 2]
    entries = o["projection_jacobians"](means_cam, K, width, height, *profile)
    for axis in (0, 1):
        free = K[axis, axis] * means_cam[:, axis] / z**2
        inside = np.isclose(entries[:, axis, 2], -free, rtol=1e-12, atol=0.0)
        back[:, 2] -= np.where(inside, free / z, 0.0) * v[:, axis, 2]
    return back


def _turned_back(name: str) -> Callable[..., Any]:
    """Make a camera's vjp whose first result has R where R^T is asked for, or the reverse."""

    def made(o: Oracle, values: Any, viewmat: Any, v: Any) -> Any:
        (wrong, *_), (_, *right) = (o[name](values, each, v) for each in (with_turned_rotation(viewmat), viewmat))
        return wrong, *right

    return made


def _two_of_one(o: Oracle, quats: Any, v_rotmats: Any, *, half: int) -> Any:
    """Make `rotmats_from_quats_vjp` with one number of the unit quaternion's cotangent halved."""
    v_units = _without_length_back(o, quats, v_rotmats)
    v_units[:, half] *= 0.5
    return o["unit_quats_from_quats_vjp"](quats, v_units)


def _rotation_left(name: str, formula: str) -> Known:
    return {
        "R stands where R^T is asked for: what the camera turned is turned back.": (
            f"The way forward turns by R, the way back by its transpose: {formula}.",
            _turned_back(f"{name}_vjp"),
        )
    }


GEOMETRY: Final[dict[str, Known]] = {
    "scales_from_log_scales": {
        "The exponential is missing: what is kept is the logarithm of the width.": (
            "exp(log_scales), entry by entry.",
            lambda o, log_scales: log_scales,
        ),
    },
    "scales_from_log_scales_vjp": {
        "You multiply by the logarithm; the derivative of exp(x) is exp(x).": (
            "v_scales times the scales themselves.",
            lambda o, log_scales, v: log_scales * v,
        ),
        "The exponential's slope is missing: the derivative of exp(x) is exp(x).": (
            "v_scales times the scales themselves.",
            lambda o, log_scales, v: v.copy(),
        ),
        "You divide by the slope; a cotangent is multiplied by it on the way back.": (
            "v_scales times the scales themselves.",
            lambda o, log_scales, v: v / np.exp(log_scales),
        ),
    },
    "opacities_from_logits": {
        "The sign of the exponent is wrong: a large logit must give an opacity near 1, and yours goes to 0.": (
            "o = 1 / (1 + exp(-x)).",
            lambda o, logits: o["opacities_from_logits"](-logits),
        ),
        "The logit's sign is lost: no opacity of yours is below a half.": (
            "Where the logit is negative the opacity is exp(logit) / (1 + exp(logit)).",
            lambda o, logits: 1.0 / (1.0 + np.exp(-np.abs(logits))),
        ),
    },
    "opacities_from_logits_vjp": {
        "The sigmoid's slope is missing.": (
            "o = 1 / (1 + exp(-x)) has the derivative o (1 - o).",
            lambda o, logits, v: v.copy(),
        ),
        "A part of the sigmoid's slope is missing: o (1 - o), and yours is o.": (
            "Near o = 1 the sigmoid is flat, so that the gradient must vanish there, too.",
            lambda o, logits, v: o["opacities_from_logits"](logits) * v,
        ),
        "You multiply o by itself: the slope of the sigmoid is o (1 - o).": (
            "1 - o is the sigmoid of -logit.",
            lambda o, logits, v: o["opacities_from_logits"](logits) ** 2 * v,
        ),
    },
    "unit_quats_from_quats": {
        "You divide all rows by one length, that of the whole array; each quaternion has a length of its own.": (
            "np.linalg.norm(quats, axis=1, keepdims=True).",
            lambda o, quats: quats / np.linalg.norm(quats),
        ),
        "You divide each column by its own length; a quaternion is a row.": (
            "np.linalg.norm(quats, axis=1, keepdims=True).",
            lambda o, quats: quats / np.linalg.norm(quats, axis=0),
        ),
        "You divide by the square of the length: the root is missing.": (
            "|q| is the root of the sum of the squares.",
            lambda o, quats: quats / np.sum(quats * quats, axis=1, keepdims=True),
        ),
        "You divide by the largest entry; a unit quaternion has the length 1.": (
            "|q| is the root of the sum of the squares.",
            lambda o, quats: quats / np.max(np.abs(quats), axis=1, keepdims=True),
        ),
    },
    "unit_quats_from_quats_vjp": {
        "The part along q is still in it: a longer q is the same rotation, so the loss does not ask for it.": (
            "Take u (u . v) from v before you divide by the length.",
            lambda o, quats, v: v / np.linalg.norm(quats, axis=1, keepdims=True),
        ),
        "The division by the length is missing: twice as long a q turns half as fast.": (
            "v_q = (v - u (u . v)) / |q|.",
            lambda o, quats, v: o["unit_quats_from_quats_vjp"](quats, v) * np.linalg.norm(quats, axis=1, keepdims=True),
        ),
        "The part along q is taken out with q itself, whose length is not 1; it must be taken out with u = q / |q|.": (
            "v_q = (v - u (u . v)) / |q|: both u have length 1.",
            _along_q,
        ),
        "The part along q is added where it must be taken away.": (
            "v_q = (v - u (u . v)) / |q|, with a minus.",
            lambda o, quats, v: (
                2.0 * v / np.linalg.norm(quats, axis=1, keepdims=True) - o["unit_quats_from_quats_vjp"](quats, v)
            ),
        ),
    },
    "rotmats_from_quats": {
        f"Your rotation is transposed. {_TRANSPOSED}": (
            "Turn (1, 0, 0) by a quarter about z, q = (1, 0, 0, 1): it must land on (0, 1, 0), so the first column of R"
            " is (0, 1, 0). Exchange the signs of the terms with w.",
            lambda o, quats: np.swapaxes(o["rotmats_from_quats"](quats), 1, 2),
        ),
        "Your quaternion is read as (x, y, z, w); here the real part comes first, (w, x, y, z).": (
            "The identity is (1, 0, 0, 0).",
            lambda o, quats: o["rotmats_from_quats"](quats[:, [3, 0, 1, 2]]),
        ),
        "Your quaternion is used as it is given; it must be divided by its length first, since only then is it a"
        " rotation.": (
            "Training moves its four numbers freely, so that its length is anything; unit_quats_from_quats divides.",
            lambda o, quats: rotmats_from_quats(quats),
        ),
    },
    "rotmats_from_quats_vjp": {
        "The division by the length is not walked back: yours is the cotangent of the unit quaternion, not of q.": (
            "End with unit_quats_from_quats_vjp(quats, v_units).",
            _without_length_back,
        ),
        **{
            f"A two is missing from the cotangent of {letter} of the unit quaternion; the other three have it.": (
                "Every entry of R has a two before its products, as in 2 (x y - w z).",
                lambda o, quats, v, k=k: _two_of_one(o, quats, v, half=k),
            )
            for k, letter in enumerate("wxyz")
        },
        "The cotangent is read with its rows and columns exchanged.": (
            "v_rotmats[i, j, k] belongs to row j and column k of the i-th matrix.",
            lambda o, quats, v_rotmats: o["rotmats_from_quats_vjp"](quats, np.swapaxes(v_rotmats, 1, 2)),
        ),
    },
    "covars_from_quats_scales": {
        f"Your rotation is transposed: the covariance is R^T S S R and not R S S R^T. {_TRANSPOSED}": (
            "With M = R diag(s) the covariance is M M^T. M^T M is another matrix.",
            lambda o, quats, scales: o["covars_from_quats_scales"](quats * np.array([1.0, -1.0, -1.0, -1.0]), scales),
        ),
        "Your scales enter once; a covariance holds squares, because scales are standard deviations.": (
            "With M = R diag(s) the covariance is M M^T, in which every scale stands twice.",
            lambda o, quats, scales: o["covars_from_quats_scales"](quats, np.sqrt(scales)),
        ),
        "The rotation has gone from your covariance, diag(s)^2 is left: you multiply M^T M where M M^T is asked"
        " for, or your M scales its rows, diag(s) R.": (
            "M = R diag(s) scales columns, R * s in NumPy; a column of R is an axis of the Gaussian. Then M @ M.T.",
            lambda o, quats, scales: np.stack([np.diag(s * s) for s in scales]),
        ),
        "Your scales enter four times; a covariance holds squares of standard deviations, so each enters twice.": (
            "With M = R diag(s), without a square, the covariance is M M^T.",
            lambda o, quats, scales: o["covars_from_quats_scales"](quats, scales**2),
        ),
    },
    "covars_from_quats_scales_vjp": {
        "The widths are missing from the cotangent of R: a column of M is a column of R times its width.": (
            "M_ij = R_ij s_j, so v_R_ij = v_M_ij s_j, and then rotmats_from_quats_vjp.",
            _covars_back(widths=False),
        ),
        "R is missing from the cotangent of the widths: a width multiplies a column of R.": (
            "M_ij = R_ij s_j, so v_s_j is the sum over i of R_ij v_M_ij.",
            _covars_back(turned=False),
        ),
    },
    "sh_basis": {
        "Two of your harmonics of degree 1 have the wrong sign: they are (-y, z, -x) times a constant.": (
            "The signs are a convention, and every file of splats follows it.",
            _positive_first_harmonics,
        ),
        "Your direction runs from the Gaussian to the camera; it is asked for from the camera to the Gaussian.": (
            "Use (x, y, z) as they are given: the harmonics of degree 1 are (-y, z, -x) times a constant.",
            lambda o, dirs, degree: o["sh_basis"](-dirs, degree),
        ),
        "Your harmonics of degree 1 stand in the order x, y, z; they are (-y, z, -x) times a constant.": (
            "The order is a convention as well as the signs, and every file of splats follows it.",
            *(_first_degree(*signs) for signs in ((1.0, 1.0, 1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, -1.0))),
        ),
        "y and z are exchanged in the basis.": (
            "The three functions of degree 1 are those of -y, z and -x, in this order.",
            lambda o, dirs, *given: o["sh_basis"](dirs[:, [0, 2, 1]], *given),
        ),
    },
    "sh_basis_vjp": {
        "x and z are exchanged in the slopes of the basis.": (
            "The columns of a direction are x, y and z.",
            lambda o, dirs, *given: o["sh_basis_vjp"](dirs[:, ::-1], *given),
        ),
    },
    "colors_from_sh": {
        "The half is missing: a Gaussian whose coefficients are 0 is grey, not black.": (
            "c = max(sum_k Y_k h_k + 0.5, 0).",
            _colors(half=0.0, unit=True),
        ),
        "Your direction is used as it is given; the harmonics ask for one of length 1.": (
            "Divide each direction by its length before sh_basis.",
            _colors(half=0.5, unit=False),
        ),
    },
    "colors_from_sh_vjp": {
        "The division of the direction by its length is not walked back: a longer direction has the same"
        " colour, so that nothing may be left along it.": (
            "v_d = (v_u - u (u . v_u)) / |d|, as for the quaternion of chapter 1b.",
            *map(_colors_back, (True, False)),
        ),
    },
    "camera_center": {
        "Your centre is -t, which is in the camera's frame; it is asked for in the world's.": (
            "The centre is the point that viewmat takes to 0: solve R c + t = 0.",
            lambda o, viewmat: -viewmat[:3, 3],
        ),
        "Your rotation is not transposed: the centre is -R^T t, and yours is -R t.": (
            "Solve R c + t = 0; the inverse of a rotation is its transpose.",
            lambda o, viewmat: -viewmat[:3, :3] @ viewmat[:3, 3],
        ),
        "Your centre is t, which is where the camera sees the world's origin.": (
            "The centre is the point that viewmat takes to 0: solve R c + t = 0, so c = -R^T t.",
            lambda o, viewmat: viewmat[:3, 3].copy(),
        ),
    },
    "view_dirs": {
        "You take t for the camera's centre; t is the world's origin as the camera sees it.": (
            "camera_center(viewmat) has the centre, -R^T t.",
            lambda o, means, viewmat: means - viewmat[:3, 3],
        ),
        "The camera's centre is missing: a direction leads from the camera to the Gaussian.": (
            "means - camera_center(viewmat).",
            lambda o, means, viewmat: means.copy(),
        ),
    },
    "means_cam_from_means": {
        "Your camera's rotation is transposed.": (
            "viewmat takes the world into the camera: p = R mean + t, without a transpose.",
            lambda o, means, viewmat: o["means_cam_from_means"](means, with_turned_rotation(viewmat)),
        ),
        "You add t before it turns; a point is turned first and moved then.": (
            "p = R mean + t.",
            lambda o, means, viewmat: (means + viewmat[:3, 3]) @ viewmat[:3, :3].T,
        ),
        "You turn the points and do not move them: t is missing.": (
            "p = R mean + t, with t = viewmat[:3, 3].",
            lambda o, means, viewmat: means @ viewmat[:3, :3].T,
        ),
        "You take t away; it is added.": (
            "p = R mean + t: viewmat takes the world into the camera.",
            lambda o, means, viewmat: o["means_cam_from_means"](means, viewmat) - 2.0 * viewmat[:3, 3],
        ),
    },
    "means_cam_from_means_vjp": _rotation_left("means_cam_from_means", "v_mean = R^T v_p, in rows v_p @ R"),
    "covars_cam_from_covars": {
        "Your camera's rotation is transposed.": (
            "A linear map A turns a covariance S into A S A^T; here A is R = viewmat[:3, :3].",
            lambda o, covars, viewmat: o["covars_cam_from_covars"](covars, with_turned_rotation(viewmat)),
        ),
        "You turn one side of the covariance only; a matrix of second moments is turned on both.": (
            "A linear map A turns a covariance S into A S A^T; here A is R = viewmat[:3, :3].",
            lambda o, covars, viewmat: viewmat[:3, :3] @ covars,
        ),
        "The second rotation is not transposed.": (
            "A linear map A turns a covariance S into A S A^T; here A is R = viewmat[:3, :3].",
            lambda o, covars, viewmat: viewmat[:3, :3] @ covars @ viewmat[:3, :3],
        ),
    },
    "covars_cam_from_covars_vjp": _rotation_left("covars_cam_from_covars", "v_Sigma = R^T V R"),
    "project_means": {
        "The principal point is missing: you measure from the optical axis, pixels are counted from the corner.": (
            "Add (cx, cy) = (K[0, 2], K[1, 2]).",
            lambda o, means_cam, K, width, height, *profile: (
                o["project_means"](means_cam, K, width, height, *profile) - K[:2, 2]
            ),
        ),
        "You take the picture's middle for the principal point, which need not lie there.": (
            "Add (cx, cy) = (K[0, 2], K[1, 2]).",
            lambda o, means_cam, K, width, height, *profile: (
                o["project_means"](means_cam, K, width, height, *profile) - K[:2, 2] + np.array([width, height]) / 2.0
            ),
        ),
        "The numbers of K for x and for y are exchanged: x goes with fx and cx, y with fy and cy.": (
            "fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2].",
            lambda o, means_cam, K, *given: o["project_means"](means_cam, K[[1, 0, 2]][:, [1, 0, 2]], *given),
        ),
        "The principal point is divided by z: a point is first divided by its depth and then moved by (cx, cy).": (
            "u = fx x / z + cx.",
            _point_over_z,
        ),
        "The focal lengths are exchanged: fx is K[0, 0] and goes with x, fy is K[1, 1] and goes with y.": (
            "u = (fx x / z + cx, fy y / z + cy).",
            lambda o, means_cam, K, *given: (
                means_cam[:, :2] / means_cam[:, 2:] * np.array([K[1, 1], K[0, 0]]) + K[:2, 2]
            ),
        ),
        "You do not divide by the depth: what is twice as far is half as large.": (
            "u = fx x / z + cx and v = fy y / z + cy.",
            lambda o, means_cam, K, *given: means_cam[:, :2] * np.diag(K)[:2] + K[:2, 2],
        ),
    },
    "project_means_vjp": {
        "The focal lengths are missing: u changes by fx / z where x changes by 1.": (
            "v_x = fx / z v_u, and v_z has fx x / z^2 and fy y / z^2.",
            lambda o, means_cam, K, *given: o["project_means_vjp"](means_cam, np.eye(3), *given),
        ),
        "The depth is missing under fx and fy: u changes by fx / z where x changes by 1.": (
            "v_x = fx / z v_u and v_y = fy / z v_v.",
            lambda o, means_cam, *given: (
                o["project_means_vjp"](means_cam, *given) * np.where(np.arange(3) < 2, means_cam[:, 2:], 1.0)
            ),
        ),
    },
    "projection_jacobians": {
        "The column of z lacks one division by the depth: the slope of 1 / z is -1 / z^2.": (
            "The entries of z are -fx tx / z^2 and -fy ty / z^2.",
            lambda o, means_cam, *given: (
                o["projection_jacobians"](means_cam, *given) * np.where(np.arange(3) < 2, 1.0, means_cam[:, None, 2:])
            ),
        ),
    },
    "projection_jacobians_vjp": {
        "Two terms of z are missing: fx / z and fy / z on the Jacobian's diagonal depend on z, too.": (
            "Add -(fx v_xx + fy v_yy) / z^2 to the cotangent of z.",
            _without_z_of_the_diagonal,
        ),
        "A two is missing from the cotangent of z: fx x / z^2 has z under it twice.": (
            "The derivative of -fx x / z^2 by z is 2 fx x / z^3 where x/z is not clamped.",
            _once_by_z,
        ),
    },
    "project_covars": {
        "The covariance is missing between the two Jacobians.": (
            "J S J^T, with the Gaussian's S in the middle.",
            lambda o, covars_cam, jacobians: jacobians @ np.swapaxes(jacobians, 1, 2),
        ),
    },
}
