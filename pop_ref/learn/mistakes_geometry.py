"""Mistakes that everyone makes once, from raw parameters to the screen; see `mistakes`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

# of one function, by what is wrong: where to look, and each such mistake, as a change in the oracle's source or as what
# it computes of the oracle's functions by name and the arguments
Known = dict[str, tuple[str, *tuple[str | Callable[..., Any], ...]]]


def with_turned_rotation(viewmat: np.ndarray) -> np.ndarray:
    """Transpose a camera's rotation."""
    turned = viewmat.copy()
    turned[:3, :3] = viewmat[:3, :3].T
    return turned


_TRANSPOSED: Final = (
    "It turns the world into the Gaussian's own frame, and what is wanted turns the Gaussian's axes into the world."
)


def _rotation_left(formula: str, change: str) -> Known:
    return {
        "R stands where R^T is asked for: what the camera turned is turned back.": (
            f"The way forward turns by R, the way back by its transpose: {formula}.",
            change,
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
            "(v_u« - u * (u @ v_u)→»)",
        ),
        "The division by the length is missing: twice as long a q turns half as fast.": (
            "v_q = (v - u (u . v)) / |q|.",
            "(v_u - u * (u @ v_u))« / math.hypot(*quats[i].tolist())→»",
        ),
        "The part along q is taken out with q itself, whose length is not 1; it must be taken out with u = q / |q|.": (
            "v_q = (v - u (u . v)) / |q|: both u have length 1.",
            "v_u - «u→quats[i]» * (u @ v_u)",
        ),
        "The part along q is added where it must be taken away.": (
            "v_q = (v - u (u . v)) / |q|, with a minus.",
            "v_u «-→+» u * (u @ v_u)",
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
            "enumerate(«unit_quats_from_quats(quats)→quats».tolist())",
        ),
    },
    "rotmats_from_quats_vjp": {
        "The division by the length is not walked back: yours is the cotangent of the unit quaternion, not of q.": (
            "End with unit_quats_from_quats_vjp(quats, v_units).",
            "return «unit_quats_from_quats_vjp(quats, v_units)→v_units»",
        ),
        **{
            f"A two is missing from the cotangent of {letter} of the unit quaternion; the other three have it.": (
                "Every entry of R has a two before its products, as in 2 (x y - w z).",
                f"«2.0 * →»({row}",
            )
            for letter, row in zip("wxyz", ("x * (v21", "w * (v21", "w * (v02", "w * (v10"), strict=True)
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
            "v_rotmats[i] = v_M« * s→»",
        ),
        "R is missing from the cotangent of the widths: a width multiplies a column of R.": (
            "M_ij = R_ij s_j, so v_s_j is the sum over i of R_ij v_M_ij.",
            "np.sum(«R * →»v_M, axis=0)",
        ),
    },
    "sh_basis": {
        "Two of your harmonics of degree 1 have the wrong sign: they are (-y, z, -x) times a constant.": (
            "The signs are a convention, and every file of splats follows it.",
            "[:n_sh]«→\n        basis[i, 1:4:2] *= -1.0»",
        ),
        "Your direction runs from the Gaussian to the camera; it is asked for from the camera to the Gaussian.": (
            "Use (x, y, z) as they are given: the harmonics of degree 1 are (-y, z, -x) times a constant.",
            lambda o, dirs, degree: o["sh_basis"](-dirs, degree),
        ),
        "Your harmonics of degree 1 stand in the order x, y, z; they are (-y, z, -x) times a constant.": (
            "The order is a convention as well as the signs, and every file of splats follows it.",
            *(
                f"[:n_sh]«→\n        basis[i, 1:4] = _C1 * np.array([{signs}])[: n_sh - 1]»"
                for signs in ("x, y, z", "-x, y, -z", "-x, -y, -z")
            ),
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
            "sh[i, :n_sh]« + 0.5→»",
        ),
        "Your direction is used as it is given; the harmonics ask for one of length 1.": (
            "Divide each direction by its length before sh_basis.",
            "sh_basis(«_unit(dirs)→dirs», degree)",
        ),
    },
    "colors_from_sh_vjp": {
        "The division of the direction by its length is not walked back: a longer direction has the same"
        " colour, so that nothing may be left along it.": (
            "v_d = (v_u - u (u . v_u)) / |d|, as for the quaternion of chapter 1b.",
            "(v_u« - u * (u @ v_u)→»)",
            "v_dirs[i] = «(v_u - u * (u @ v_u)) / math.hypot(*dirs[i].tolist())→v_u»",
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
    "means_cam_from_means_vjp": _rotation_left("v_mean = R^T v_p, in rows v_p @ R", "R«.T→» @ v_means_cam[i]"),
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
    "covars_cam_from_covars_vjp": _rotation_left("v_Sigma = R^T V R", "R«.T→» @ V @ R«→.T»"),
    "project_means": {
        "The principal point is missing: you measure from the optical axis, pixels are counted from the corner.": (
            "Add (cx, cy) = (K[0, 2], K[1, 2]).",
            "x / z« + cx→», fy * y / z« + cy→»",
        ),
        "You take the picture's middle for the principal point, which need not lie there.": (
            "Add (cx, cy) = (K[0, 2], K[1, 2]).",
            "«_intrinsics(K, width, height, profile)→K[0, 0], K[1, 1], width / 2.0, height / 2.0»",
        ),
        "The numbers of K for x and for y are exchanged: x goes with fx and cx, y with fy and cy.": (
            "fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2].",
            lambda o, means_cam, K, *given: o["project_means"](means_cam, K[[1, 0, 2]][:, [1, 0, 2]], *given),
        ),
        "The principal point is divided by z: a point is first divided by its depth and then moved by (cx, cy).": (
            "u = fx x / z + cx.",
            "+ cx«→ / z», fy * y / z + cy«→ / z»",
        ),
        "The focal lengths are exchanged: fx is K[0, 0] and goes with x, fy is K[1, 1] and goes with y.": (
            "u = (fx x / z + cx, fy y / z + cy).",
            "«fx→fy» * x / z + cx, «fy→fx» * y / z",
        ),
        "You do not divide by the depth: what is twice as far is half as large.": (
            "u = fx x / z + cx and v = fy y / z + cy.",
            "x« / z→» + cx, fy * y« / z→» + cy",
        ),
    },
    "project_means_vjp": {
        "The focal lengths are missing: u changes by fx / z where x changes by 1.": (
            "v_x = fx / z v_u, and v_z has fx x / z^2 and fy y / z^2.",
            lambda o, means_cam, K, *given: o["project_means_vjp"](means_cam, np.eye(3), *given),
        ),
        "The depth is missing under fx and fy: u changes by fx / z where x changes by 1.": (
            "v_x = fx / z v_u and v_y = fy / z v_v.",
            "fx« / z→» * v_x, fy« / z→» * v_y,",
        ),
    },
    "projection_jacobians": {
        "The column of z lacks one division by the depth: the slope of 1 / z is -1 / z^2.": (
            "The entries of z are -fx tx / z^2 and -fy ty / z^2.",
            "-fx * tx / «(z * z)→z»], [0.0, fy / z, -fy * ty / «(z * z)→z»]",
        ),
    },
    "projection_jacobians_vjp": {
        "Two terms of z are missing: fx / z and fy / z on the Jacobian's diagonal depend on z, too.": (
            "Add -(fx v_xx + fy v_yy) / z^2 to the cotangent of z.",
            "v_z_x + v_z_y« - (fx * v_xx + fy * v_yy) / (z * z)→»",
        ),
        "A two is missing from the cotangent of z: fx x / z^2 has z under it twice.": (
            "The derivative of -fx x / z^2 by z is 2 fx x / z^3 where x/z is not clamped.",
            "v_z_x«→ / (2.0 if v_x else 1.0)» + v_z_y«→ / (2.0 if v_y else 1.0)»",
        ),
    },
    "project_covars": {
        "The covariance is missing between the two Jacobians.": (
            "J S J^T, with the Gaussian's S in the middle.",
            lambda o, covars_cam, jacobians: jacobians @ np.swapaxes(jacobians, 1, 2),
        ),
    },
}
