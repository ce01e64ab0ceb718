"""Mistakes that everyone makes once, of the ways back through geometry and colour, and of their forward parts; see
`mistakes`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from pop_ref.learn.mistakes_geometry import Mistake, Oracle


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


def _on_one_side(o: Oracle, covars2d: Any, v: Any) -> Any:
    """Make `conics_from_covars2d_vjp` with both Q on one side of V."""
    A, B, C = o["conics_from_covars2d"](covars2d).T
    Q = np.moveaxis(np.array([[A, B], [B, C]]), 2, 0)
    V = np.moveaxis(np.array([[v[:, 0], v[:, 1] / 2.0], [v[:, 1] / 2.0, v[:, 2]]]), 2, 0)
    return -V @ Q @ Q


def _opacity_left_in(o: Oracle, sigma: float, opacity: float, v_alpha: float, *profile: Any) -> Any:
    v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, opacity, v_alpha, *profile)
    return v_sigma, opacity * v_opacity


def _opacity_left_out(o: Oracle, sigma: float, opacity: float, v_alpha: float, *profile: Any) -> Any:
    v_sigma, v_opacity = o["alpha_from_sigma_vjp"](sigma, opacity, v_alpha, *profile)
    return v_sigma / opacity, v_opacity


def _turned_back(name: str, only: int) -> Callable[..., Any]:
    """Make a camera's vjp whose one result has R where R^T is asked for, or the reverse."""

    def made(o: Oracle, values: Any, viewmat: Any, v: Any) -> Any:
        turned = viewmat.copy()
        turned[:3, :3] = viewmat[:3, :3].T
        right, wrong = (list(o[name](values, each, v)) for each in (viewmat, turned))
        right[only] = wrong[only]
        return tuple(right)

    return made


def _two_of_one(o: Oracle, quats: Any, v_rotmats: Any, *, half: int) -> Any:
    """Make `rotmats_from_quats_vjp` with one number of the unit quaternion's cotangent halved."""
    units = o["unit_quats_from_quats"](quats)
    w, x, y, z = units.T
    g = np.moveaxis(v_rotmats, 0, -1)
    along = [
        -z * g[0, 1] + y * g[0, 2] + z * g[1, 0] - x * g[1, 2] - y * g[2, 0] + x * g[2, 1],
        y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]) - 2 * x * (g[1, 1] + g[2, 2]),
        x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]) - 2 * y * (g[0, 0] + g[2, 2]),
        x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]) - 2 * z * (g[0, 0] + g[1, 1]),
    ]
    v_units = 2.0 * np.stack(along, axis=1)
    v_units[:, half] *= 0.5
    return o["unit_quats_from_quats_vjp"](quats, v_units)


def _conics(by: Callable[..., Any], sign: float = -1.0) -> Callable[..., Any]:
    """Make `conics_from_covars2d` that multiplies by something else than one over the determinant, or whose determinant
    has another sign in it."""

    def made(o: Oracle, covars2d: Any) -> Any:
        a, b, c = covars2d[:, 0, 0], covars2d[:, 0, 1], covars2d[:, 1, 1]
        det = a * c + sign * b * b
        return np.where(det > 0.0, np.stack([c, -b, a]) * by(det), 0.0).T

    return made


def _exchanged_sides(o: Oracle, means2d: Any, radii: Any, width: int, height: int, *profile: Any) -> Any:
    return o["on_screen"](means2d, radii, height, width, *profile)


_UNIT_BACK: Final = "unit_quats_from_quats_vjp"

BACKWARD: Final = (
    Mistake(
        "unit_quats_from_quats_vjp",
        _along_q,
        "The part along q is taken out with q itself, whose length is not 1; it must be taken out with u = q / |q|.",
        "v_q = (v - u (u . v)) / |q|: both u have length 1.",
    ),
    Mistake(
        "covars_from_quats_scales_vjp",
        _covars_back(widths=False),
        "The widths are missing from the cotangent of R: a column of M is a column of R times its width.",
        "M_ij = R_ij s_j, so v_R_ij = v_M_ij s_j, and then rotmats_from_quats_vjp.",
    ),
    Mistake(
        "covars_from_quats_scales_vjp",
        _covars_back(turned=False),
        "R is missing from the cotangent of the widths: a width multiplies a column of R.",
        "M_ij = R_ij s_j, so v_s_j is the sum over i of R_ij v_M_ij.",
    ),
    *(
        Mistake(
            "colors_from_sh_vjp",
            _colors_back(divided),
            "The division of the direction by its length is not walked back: a longer direction has the same colour, so"
            " that nothing may be left along it.",
            "v_d = (v_u - u (u . v_u)) / |d|, as for the quaternion of chapter 1b.",
        )
        for divided in (True, False)
    ),
    *(
        Mistake(
            "sh_basis",
            _first_degree(*signs),
            "Your harmonics of degree 1 stand in the order x, y, z; they are (-y, z, -x) times a constant.",
            "The order is a convention as well as the signs, and every file of splats follows it.",
        )
        for signs in ((1.0, 1.0, 1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, -1.0))
    ),
    Mistake(
        "project_means",
        _point_over_z,
        "The principal point is divided by z: a point is first divided by its depth and then moved by (cx, cy).",
        "u = fx x / z + cx.",
    ),
    Mistake(
        "projection_jacobians_vjp",
        _once_by_z,
        "A two is missing from the cotangent of z: fx x / z^2 has z under it twice.",
        "The derivative of -fx x / z^2 by z is 2 fx x / z^3 where x/z is not clamped.",
    ),
    Mistake(
        "conics_from_covars2d_vjp",
        _on_one_side,
        "The products stand in another order: Q stands on either side of V.",
        "The inverse's small change is -Q dX Q, so the cotangent is -Q V Q.",
    ),
    Mistake(
        "low_pass",
        lambda o, covars2d, eps2d: covars2d + eps2d,
        "The blur is added to all four entries; a round blur has no entries off the diagonal.",
        "covars2d + eps2d * np.eye(2).",
    ),
    Mistake(
        "alpha_from_sigma_vjp",
        _opacity_left_in,
        "The opacity is left in its own derivative: of o exp(-sigma) by o it is exp(-sigma).",
        "v_o = exp(-sigma) v_alpha; only v_sigma has the opacity in it.",
    ),
    Mistake(
        "alpha_from_sigma_vjp",
        _opacity_left_out,
        "The opacity is missing from the cotangent of sigma.",
        "alpha = o exp(-sigma), so v_sigma = -alpha v_alpha.",
    ),
    *(
        Mistake(
            f"{name}_vjp",
            _turned_back(f"{name}_vjp", 0),
            "R stands where R^T is asked for: what the camera turned is turned back.",
            f"The way forward turns by R, the way back by its transpose: {formula}.",
        )
        for name, formula in (
            ("means_cam_from_means", "v_mean = R^T v_p, in rows v_p @ R"),
            ("covars_cam_from_covars", "v_Sigma = R^T V R"),
        )
    ),
    *(
        Mistake(
            "rotmats_from_quats_vjp",
            lambda o, quats, v, k=k: _two_of_one(o, quats, v, half=k),
            f"A two is missing from the cotangent of {letter} of the unit quaternion; the other three have it.",
            "Every entry of R has a two before its products, as in 2 (x y - w z).",
        )
        for k, letter in enumerate("wxyz")
    ),
    Mistake(
        "camera_center",
        lambda o, viewmat: viewmat[:3, 3].copy(),
        "Your centre is t, which is where the camera sees the world's origin.",
        "The centre is the point that viewmat takes to 0: solve R c + t = 0, so c = -R^T t.",
    ),
    Mistake(
        "project_means",
        lambda o, means_cam, K, *given: means_cam[:, :2] / means_cam[:, 2:] * np.array([K[1, 1], K[0, 0]]) + K[:2, 2],
        "The focal lengths are exchanged: fx is K[0, 0] and goes with x, fy is K[1, 1] and goes with y.",
        "u = (fx x / z + cx, fy y / z + cy).",
    ),
    Mistake(
        "unit_quats_from_quats",
        lambda o, quats: quats / np.sum(quats * quats, axis=1, keepdims=True),
        "You divide by the square of the length: the root is missing.",
        "|q| is the root of the sum of the squares.",
    ),
    Mistake(
        "conics_from_covars2d",
        _conics(lambda det: 1.0 / det, sign=1.0),
        "The determinant has the wrong sign in it: it is a c - b b.",
        "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
    ),
    *(
        Mistake(
            "conics_from_covars2d",
            _conics(by),
            "You do not divide by the determinant, as an inverse does.",
            "[[a, b], [b, c]] has the inverse [[c, -b], [-b, a]] / (a c - b b).",
        )
        for by in (lambda det: det, lambda det: 1.0)
    ),
    Mistake(
        "on_screen",
        _exchanged_sides,
        "Width and height are exchanged: x is compared with the width, y with the height.",
        "The columns of means2d are x and y.",
    ),
    Mistake(
        "unit_quats_from_quats_vjp",
        lambda o, quats, v: 2.0 * v / np.linalg.norm(quats, axis=1, keepdims=True) - o[_UNIT_BACK](quats, v),
        "The part along q is added where it must be taken away.",
        "v_q = (v - u (u . v)) / |q|, with a minus.",
    ),
    Mistake(
        "means_cam_from_means",
        lambda o, means, viewmat: o["means_cam_from_means"](means, viewmat) - 2.0 * viewmat[:3, 3],
        "You take t away; it is added.",
        "p = R mean + t: viewmat takes the world into the camera.",
    ),
    Mistake(
        "project_means_vjp",
        lambda o, means_cam, K, *given: o["project_means_vjp"](means_cam, np.eye(3), *given),
        "The focal lengths are missing: u changes by fx / z where x changes by 1.",
        "v_x = fx / z v_u, and v_z has fx x / z^2 and fy y / z^2.",
    ),
    Mistake(
        "view_dirs",
        lambda o, means, viewmat: means - viewmat[:3, 3],
        "You take t for the camera's centre; t is the world's origin as the camera sees it.",
        "camera_center(viewmat) has the centre, -R^T t.",
    ),
    Mistake(
        "view_dirs",
        lambda o, means, viewmat: means.copy(),
        "The camera's centre is missing: a direction leads from the camera to the Gaussian.",
        "means - camera_center(viewmat).",
    ),
    Mistake(
        "project_means",
        lambda o, means_cam, K, *given: means_cam[:, :2] * np.diag(K)[:2] + K[:2, 2],
        "You do not divide by the depth: what is twice as far is half as large.",
        "u = fx x / z + cx and v = fy y / z + cy.",
    ),
    Mistake(
        "project_means_vjp",
        lambda o, means_cam, *given: (
            o["project_means_vjp"](means_cam, *given) * np.where(np.arange(3) < 2, means_cam[:, 2:], 1.0)
        ),
        "The depth is missing under fx and fy: u changes by fx / z where x changes by 1.",
        "v_x = fx / z v_u and v_y = fy / z v_v.",
    ),
    Mistake(
        "projection_jacobians",
        lambda o, means_cam, *given: (
            o["projection_jacobians"](means_cam, *given) * np.where(np.arange(3) < 2, 1.0, means_cam[:, None, 2:])
        ),
        "The column of z lacks one division by the depth: the slope of 1 / z is -1 / z^2.",
        "The entries of z are -fx tx / z^2 and -fy ty / z^2.",
    ),
    Mistake(
        "project_covars",
        lambda o, covars_cam, jacobians: jacobians @ np.swapaxes(jacobians, 1, 2),
        "The covariance is missing between the two Jacobians.",
        "J S J^T, with the Gaussian's S in the middle.",
    ),
    Mistake(
        "covars_cam_from_covars",
        lambda o, covars, viewmat: viewmat[:3, :3] @ covars @ viewmat[:3, :3],
        "The second rotation is not transposed.",
        "A linear map A turns a covariance S into A S A^T; here A is R = viewmat[:3, :3].",
    ),
    Mistake(
        "rotmats_from_quats_vjp",
        lambda o, quats, v_rotmats: o["rotmats_from_quats_vjp"](quats, np.swapaxes(v_rotmats, 1, 2)),
        "The cotangent is read with its rows and columns exchanged.",
        "v_rotmats[i, j, k] belongs to row j and column k of the i-th matrix.",
    ),
    Mistake(
        "sh_basis",
        lambda o, dirs, *given: o["sh_basis"](dirs[:, [0, 2, 1]], *given),
        "y and z are exchanged in the basis.",
        "The three functions of degree 1 are those of -y, z and -x, in this order.",
    ),
    Mistake(
        "sh_basis_vjp",
        lambda o, dirs, *given: o["sh_basis_vjp"](dirs[:, ::-1], *given),
        "x and z are exchanged in the slopes of the basis.",
        "The columns of a direction are x, y and z.",
    ),
    Mistake(
        "scales_from_log_scales",
        lambda o, log_scales: log_scales,
        "The exponential is missing: what is kept is the logarithm of the width.",
        "exp(log_scales), entry by entry.",
    ),
    Mistake(
        "opacities_from_logits",
        lambda o, logits: 1.0 / (1.0 + np.exp(-np.abs(logits))),
        "The logit's sign is lost: no opacity of yours is below a half.",
        "Where the logit is negative the opacity is exp(logit) / (1 + exp(logit)).",
    ),
    Mistake(
        "opacities_from_logits_vjp",
        lambda o, logits, v: o["opacities_from_logits"](logits) ** 2 * v,
        "You multiply o by itself: the slope of the sigmoid is o (1 - o).",
        "1 - o is the sigmoid of -logit.",
    ),
    Mistake(
        "unit_quats_from_quats",
        lambda o, quats: quats / np.max(np.abs(quats), axis=1, keepdims=True),
        "You divide by the largest entry; a unit quaternion has the length 1.",
        "|q| is the root of the sum of the squares.",
    ),
    Mistake(
        "low_pass",
        lambda o, covars2d, eps2d, *given: covars2d - eps2d * np.eye(2),
        "eps2d is taken away from the diagonal; it is added, as blur makes a splat wider.",
        "covars2d + eps2d times the unit matrix.",
    ),
    Mistake(
        "radii_from_covars2d",
        lambda o, covars2d, opacities, *given: (
            o["radii_from_covars2d"](covars2d, np.ones_like(opacities), *given)
            * (o["radii_from_covars2d"](covars2d, opacities, *given) > 0)
        ),
        "Your reach is that of opacity 1 for every splat; a faint one ends sooner.",
        "The reach is min(3.33, sqrt(2 ln(255 o))) standard deviations, with o the splat's own.",
    ),
)
