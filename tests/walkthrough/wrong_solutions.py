"""Mistakes as students make them: of each function, a piece of the right solution and what stands there instead.

The third entry, where there is one, is what the sentence must say; those of the review's list of kinds have one.
"""

from __future__ import annotations

WRONG: dict[str, list[tuple[str, str] | tuple[str, str, str]]] = {
    "scales_from_log_scales": [
        ("return np.exp(log_scales)", "return np.log(log_scales)"),
        ("return np.exp(log_scales)", "return np.exp(2.0 * log_scales)", "is the square"),
        ("return np.exp(log_scales)", "return np.exp(-log_scales)", "is one over what it should be"),
        ("return np.exp(log_scales)", "return log_scales"),
    ],
    "scales_from_log_scales_vjp": [
        ("return np.exp(log_scales) * v_scales", "return v_scales.copy()"),
        ("return np.exp(log_scales) * v_scales", "return v_scales / np.exp(log_scales)"),
        ("return np.exp(log_scales) * v_scales", "return log_scales * v_scales"),
    ],
    "opacities_from_logits": [
        ("fall = math.exp(-abs(logit))", "fall = math.exp(abs(logit))"),
        (
            "(1.0 if logit >= 0.0 else fall) / (1.0 + fall)",
            "1.0 / (1.0 + math.exp(-logit))",
            "right on plain inputs|OverflowError",
        ),
        ("(1.0 if logit >= 0.0 else fall) / (1.0 + fall)", "(fall if logit >= 0.0 else 1.0) / (1.0 + fall)"),
        ("(1.0 if logit >= 0.0 else fall) / (1.0 + fall)", "1.0 / (1.0 + fall)"),
    ],
    "opacities_from_logits_vjp": [
        (" * opacities_from_logits(-logit_opacities) * v_opacities", " * v_opacities"),
        ("return opacities_from_logits(logit_opacities) * opacities_from_logits(-logit_opacities) *", "return"),
        ("* opacities_from_logits(-logit_opacities) *", "* opacities_from_logits(logit_opacities) *"),
        (
            "return opacities_from_logits(logit_opacities)",
            "return -opacities_from_logits(logit_opacities)",
            "wrong sign",
        ),
    ],
    "unit_quats_from_quats": [
        ("quats[i] / math.hypot(*quats[i].tolist())", "quats[i] / np.sum(quats[i] ** 2)"),
        ("quats[i] / math.hypot(*quats[i].tolist())", "quats[i] / (math.hypot(*quats[i].tolist()) + 1e-4)", "epsilon"),
        ("quats[i] / math.hypot(*quats[i].tolist())", "quats[i] / math.hypot(*quats[0].tolist())", "but the first"),
        ("quats[i] / math.hypot(*quats[i].tolist())", "quats[i] / np.max(np.abs(quats[i]))"),
    ],
    "unit_quats_from_quats_vjp": [
        ("(v_u - u * (u @ v_u)) / math.hypot(*quats[i].tolist())", "v_u / math.hypot(*quats[i].tolist())"),
        ("(v_u - u * (u @ v_u)) / math.hypot(*quats[i].tolist())", "v_u - u * (u @ v_u)"),
        ("(v_u - u * (u @ v_u))", "(v_u + u * (u @ v_u))"),
    ],
    "rotmats_from_quats": [
        ("    return rotmats\n", "    return rotmats.swapaxes(1, 2).copy()\n", "rotation is transposed"),
        ("unit_quats_from_quats(quats).tolist()", "quats.tolist()", "divided by its length"),
        ("for i, (w, x, y, z) in", "for i, (x, y, z, w) in", "the real part comes first"),
        ("2.0 * (y * z + w * x), 1.0", "2.0 * (y * z - w * x), 1.0"),
        ("[1.0 - 2.0 * (y * y + z * z),", "[1.0 - (y * y + z * z),"),
    ],
    "rotmats_from_quats_vjp": [
        ("return unit_quats_from_quats_vjp(quats, v_units)", "return v_units", "length"),
        ("2.0 * (x * (v21 - v12) +", "1.0 * (x * (v21 - v12) +"),
        ("z * (v02 + v20) - 2.0 * x * (v11 + v22)", "z * (v02 + v20)"),
        ("v_rotmats[i].tolist()", "v_rotmats[i].T.tolist()"),
    ],
    "covars_from_quats_scales": [
        ("covars[i] = M @ M.T", "covars[i] = M.T @ M", r"M\^T M"),
        ("M = rotmats[i] * scales[i]", "M = rotmats[i] * np.sqrt(scales[i])", "Your scales enter once"),
        ("M = rotmats[i] * scales[i]", "M = rotmats[i].T * scales[i]", "rotation is transposed"),
        ("M = rotmats[i] * scales[i]", "M = rotmats[i] * scales[i][:, None]", "scales its rows"),
        ("M = rotmats[i] * scales[i]", "M = rotmats[i] * scales[i] ** 2", "scales enter four times"),
    ],
    "covars_from_quats_scales_vjp": [
        ("(v_covars[i] + v_covars[i].T) @ (R * s)", "2.0 * v_covars[i] @ (R * s)", r"V \+ V\^T is not 2 V"),
        ("(v_covars[i] + v_covars[i].T) @ (R * s)", "v_covars[i] @ (R * s)"),
        ("v_rotmats[i] = v_M * s", "v_rotmats[i] = v_M", "quats"),
        ("v_scales[i] = np.sum(R * v_M, axis=0)", "v_scales[i] = np.sum(R * v_M, axis=1)", "scales"),
        ("v_scales[i] = np.sum(R * v_M, axis=0)", "pass", "scales.*always 0"),
    ],
    "sh_basis": [
        ("basis[i] = _basis_one(x, y, z)[:n_sh]", "basis[i] = np.abs(_basis_one(x, y, z)[:n_sh])", "lost its sign"),
        ("_basis_one(x, y, z)[:n_sh]", "_basis_one(x, z, y)[:n_sh]"),
        ("_basis_one(x, y, z)[:n_sh]", "_basis_one(-x, -y, -z)[:n_sh]", "from the Gaussian to the camera"),
        (
            "_basis_one(x, y, z)[:n_sh]",
            "(np.array(_basis_one(x, y, z)) * np.r_[1, -1, 1, -1, [1] * 12])[:n_sh]",
            "degree 1 have the wrong sign",
        ),
    ],
    "sh_basis_vjp": [
        ("v_basis[i] @ np.array(_basis_gradient_one(x, y, z)[: _n_sh(degree)])", "np.zeros(3)", "always 0"),
        ("_basis_gradient_one(x, y, z)", "_basis_gradient_one(z, y, x)"),
        ("v_dirs[i] = v_basis[i] @", "v_dirs[i] = -v_basis[i] @", "wrong sign"),
    ],
    "colors_from_sh": [
        ("@ sh[i, :n_sh] + 0.5, 0.0)", "@ sh[i, :n_sh], 0.0)", "half is missing"),
        ("np.maximum(basis[i] @ sh[i, :n_sh] + 0.5, 0.0)", "basis[i] @ sh[i, :n_sh] + 0.5", "would be negative"),
        (
            "np.maximum(basis[i] @ sh[i, :n_sh] + 0.5, 0.0)",
            "np.clip(basis[i] @ sh[i, :n_sh] * 9 + 0.5, 0.0, 1.0)",
        ),
        ("sh_basis(_unit(dirs), degree)", "sh_basis(dirs, degree)", "asks? for one of length 1"),
    ],
    "colors_from_sh_vjp": [
        ("np.where(unclamped >= 0.0, v_colors[i], 0.0)", "v_colors[i]", "would be negative"),
        ("v_sh[i, :n_sh] = np.outer(basis[i], v_sum)", "v_sh[i, :n_sh] = np.outer(basis[0], v_sum)"),
        (
            "v_dirs[i] = (v_u - u * (u @ v_u)) / math.hypot(*dirs[i].tolist())",
            "v_dirs[i] = v_u - u * (u @ v_u)",
            "not of length 1",
        ),
    ],
    "camera_center": [
        ("return -viewmat[:3, :3].T @ viewmat[:3, 3]", "return -viewmat[:3, 3]", "in the camera's frame"),
        ("return -viewmat[:3, :3].T @ viewmat[:3, 3]", "return viewmat[:3, :3].T @ viewmat[:3, 3]", "wrong sign"),
        ("return -viewmat[:3, :3].T @ viewmat[:3, 3]", "return -viewmat[:3, :3] @ viewmat[:3, 3]", "transposed"),
    ],
    "camera_center_vjp": [
        ("v_viewmat[:3, 3] = -viewmat[:3, :3] @ v_center", "pass"),
        ("-np.outer(viewmat[:3, 3], v_center)", "-np.outer(v_center, viewmat[:3, 3])"),
    ],
    "view_dirs": [
        ("return means - camera_center(viewmat)", "return camera_center(viewmat) - means", "wrong sign"),
        ("return means - camera_center(viewmat)", "return means - viewmat[:3, 3]"),
        ("return means - camera_center(viewmat)", "return means.copy()"),
    ],
    "view_dirs_vjp": [
        ("-np.sum(v_dirs, axis=0)", "np.sum(v_dirs, axis=0)", "viewmat.*wrong sign"),
        ("return v_dirs.copy(),", "return -v_dirs,", "means.*wrong sign"),
        ("-np.sum(v_dirs, axis=0)", "-v_dirs[0]"),
    ],
    "means_cam_from_means": [
        ("R @ means[i] + t", "R.T @ means[i] + t", "rotation is transposed"),
        ("R @ means[i] + t", "R @ means[i]"),
        ("R @ means[i] + t", "R @ (means[i] + t)", "before it turns"),
        ("    return means_cam\n", "    pass\n", "return missing"),
    ],
    "means_cam_from_means_vjp": [
        ("v_means[i] = R.T @ v_means_cam[i]", "v_means[i] = R @ v_means_cam[i]", "means"),
        ("v_viewmat[:3, 3] += v_means_cam[i]", "v_viewmat[:3, 3] = v_means_cam[i]"),
        ("np.outer(v_means_cam[i], means[i])", "np.outer(means[i], v_means_cam[i])", "viewmat"),
    ],
    "covars_cam_from_covars": [
        ("R @ covars[i] @ R.T", "R.T @ covars[i] @ R", "rotation is transposed"),
        ("R @ covars[i] @ R.T", "R @ covars[i]"),
        ("R @ covars[i] @ R.T", "R @ covars[i] @ R"),
    ],
    "covars_cam_from_covars_vjp": [
        ("V @ R @ covars[i].T + V.T @ R @ covars[i]", "2.0 * V @ R @ covars[i]", r"V \+ V\^T is not 2 V"),
        ("R.T @ V @ R", "R @ V @ R.T", "covars"),
        ("V @ R @ covars[i].T + V.T @ R @ covars[i]", "V @ R @ covars[i].T"),
    ],
    "in_front": [
        ("depths >= profile.near_plane", "depths >= 0.0", "near plane"),
        (
            "depths > profile.near_plane if profile.near_inclusive else depths >= profile.near_plane",
            "depths > profile.near_plane",
            "still counts",
        ),
        ("return beyond_near & (depths <= profile.far_plane)", "return beyond_near", "far plane"),
        ("return beyond_near & (depths <= profile.far_plane)", "return ~beyond_near"),
    ],
    "project_means": [
        ("fx * x / z + cx, fy * y / z + cy", "fx * x / z, fy * y / z", "principal point is missing"),
        ("fx * x / z + cx, fy * y / z + cy", "fy * y / z + cy, fx * x / z + cx", "x and y"),
        ("fx * x / z + cx, fy * y / z + cy", "fx * x / z + cx - 0.5, fy * y / z + cy - 0.5", "by half"),
        ("fx * x / z + cx, fy * y / z + cy", "fx * x / z + cx, fx * y / z + cy", "the y only"),
        ("fx * x / z + cx, fy * y / z + cy", "round(fx * x / z + cx), round(fy * y / z + cy)", "rounded"),
        ("fx * x / z + cx, fy * y / z + cy", "fx * x + cx, fy * y + cy"),
    ],
    "project_means_vjp": [
        (
            "-(fx * x * v_x + fy * y * v_y) / (z * z)",
            "(fx * x * v_x + fy * y * v_y) / (z * z)",
            "the z only.*wrong sign",
        ),
        ("-(fx * x * v_x + fy * y * v_y) / (z * z)", "0.0", "the z only.*always 0"),
        ("-(fx * x * v_x + fy * y * v_y) / (z * z)", "-(fx * x * v_x) / (z * z)"),
        ("fx / z * v_x, fy / z * v_y,", "fx * v_x, fy * v_y,"),
    ],
    "projection_jacobians": [
        (
            "-fx * tx / (z * z)], [0.0, fy / z, -fy * ty / (z * z)]",
            "fx * tx / (z * z)], [0.0, fy / z, fy * ty / (z * z)]",
            "column 2.*wrong sign",
        ),
        ("min(max(x / z, limits_x[0]), limits_x[1])", "x / z", "clamped for the Jacobian"),
        ("-fx * tx / (z * z)], [0.0, fy / z, -fy * ty / (z * z)]", "0.0], [0.0, fy / z, 0.0]", "column 2.*always 0"),
        ("-fx * tx / (z * z)]", "-fx * tx / z]"),
    ],
    "projection_jacobians_vjp": [
        ("- (fx * v_xx + fy * v_yy) / (z * z)", "", "the z only"),
        ("v_means_cam[i] = v_x, v_y,", "v_means_cam[i] = v_y, v_x,"),
        (
            "_offset_vjp(x, z, fx, limits_x, v_xz, profile)",
            "_offset_vjp(x, z, fx, (-1e9, 1e9), v_xz, profile)",
            "clamped",
        ),
    ],
    "project_covars": [
        ("jacobians[i] @ covars_cam[i] @ jacobians[i].T", "jacobians[i] @ jacobians[i].T"),
        (
            "jacobians[i] @ covars_cam[i] @ jacobians[i].T",
            "(jacobians[i] @ covars_cam[i] @ jacobians[i].T) / 2",
            "0.5 times",
        ),
        (
            "jacobians[i] @ covars_cam[i] @ jacobians[i].T",
            "jacobians[i] @ covars_cam[i] @ jacobians[i].T + 0.3 * np.eye(2)",
            "the diagonal only",
        ),
    ],
    "project_covars_vjp": [
        ("V @ J @ Sigma.T + V.T @ J @ Sigma", "2.0 * V @ J @ Sigma", r"V \+ V\^T is not 2 V"),
        ("J.T @ V @ J", "J.T @ V.T @ J", "not symmetric"),
        ("V @ J @ Sigma.T + V.T @ J @ Sigma", "V @ J @ Sigma.T", "jacobians.*0.5 times|jacobians"),
    ],
    "low_pass": [
        ("covars2d + eps2d * np.eye(2)", "covars2d + eps2d", "off the diagonal"),
        ("covars2d + eps2d * np.eye(2)", "covars2d + eps2d**2 * np.eye(2)", "the diagonal only"),
        (
            "    return covars2d + eps2d * np.eye(2)",
            "    covars2d += eps2d * np.eye(2)\n    return covars2d",
            "in place",
        ),
        ("covars2d + eps2d * np.eye(2)", "covars2d - eps2d * np.eye(2)"),
    ],
    "low_pass_vjp": [
        ("return v_blurred.copy()", "return np.zeros_like(v_blurred)", "always 0"),
        ("return v_blurred.copy()", "return eps2d * v_blurred"),
    ],
    "conics_from_covars2d": [
        ("inverse[0, 0], inverse[0, 1], inverse[1, 1]", "inverse[0, 0], -inverse[0, 1], inverse[1, 1]", "off-diagonal"),
        ("inverse = _inverse(covars2d[i])", "inverse = covars2d[i]", "its inverse"),
        (
            "inverse[0, 0], inverse[0, 1], inverse[1, 1]",
            "inverse[1, 1], inverse[0, 1], inverse[0, 0]",
            "opposite order",
        ),
        ("if _det(covars2d[i]) > 0.0:", "if True:", "determinant is not positive"),
        (
            "inverse[0, 0], inverse[0, 1], inverse[1, 1]",
            "inverse[0, 0], 2 * inverse[0, 1], inverse[1, 1]",
            "the xy only, which is 2 times",
        ),
    ],
    "conics_from_covars2d_vjp": [
        ("[[v_xx, v_xy / 2.0], [v_xy / 2.0, v_yy]]", "[[v_xx, v_xy], [v_xy, v_yy]]", "counts twice"),
        ("-Q @ V @ Q", "Q @ V @ Q", "wrong sign"),
        ("-Q @ V @ Q", "-V @ Q @ Q"),
        ("if _det(covars2d[i]) > 0.0:", "if True:", "determinant is not positive"),
    ],
    "radii_from_covars2d": [
        (
            "math.ceil(min(_LARGEST_RADIUS, reach_x)), math.ceil(",
            "round(min(_LARGEST_RADIUS, reach_x)), round(",
            "must be rounded up",
        ),
        (
            "math.ceil(min(_LARGEST_RADIUS, reach_x)), math.ceil(",
            "int(min(_LARGEST_RADIUS, reach_x)), int(",
            "must be rounded up|one too small|off by one",
        ),
        ("opacity >= profile.alpha_floor", "True", "1/255|ValueError"),
        ("_reach(covars2d[i], opacity, profile)", "_reach(covars2d[i], 1.0, profile)"),
        ("_reach(covars2d[i], opacity, profile)", "_reach(covars2d[i][::-1, ::-1], opacity, profile)", "x and y"),
    ],
    "on_screen": [
        ("(means2d + radii > 0.0)", "(means2d > 0.0)", "too rarely"),
        (
            "(means2d - radii < [width, height])",
            "(means2d - radii <= [width, height])",
            "exactly at the picture's edge",
        ),
        ("(means2d - radii < [width, height])", "(means2d - radii < [height, width])"),
        ("some & np.all((means2d", "np.all((means2d", "extent is 0"),
        ("np.all((means2d + radii > 0.0)", "np.any((means2d + radii > 0.0)", "too often"),
    ],
    "grid_size": [
        (
            "-(-width // tile_size), -(-height // tile_size)",
            "width // tile_size, height // tile_size",
            "part of a tile",
        ),
        (
            "-(-width // tile_size), -(-height // tile_size)",
            "-(-height // tile_size), -(-width // tile_size)",
            "opposite order|x and y|exchanged",
        ),
        ("-(-width // tile_size), -(-height // tile_size)", "width // tile_size + 1, height // tile_size + 1"),
    ],
    "tile_span": [
        ("last = math.ceil((center + radius) / tile_size)", "last = math.floor((center + radius) / tile_size)"),
        (
            "last = math.ceil((center + radius) / tile_size)",
            "last = math.floor((center + radius) / tile_size) + 1",
            "exactly between",
        ),
        ("first = math.floor((center - radius) / tile_size)", "first = round((center - radius) / tile_size)"),
        (
            "return min(max(first, 0), n_tiles), min(max(last, 0), n_tiles)",
            "return first, last",
            "past the first|outside the grid",
        ),
        ("min(max(last, 0), n_tiles)", "min(max(last, 0), n_tiles - 1)"),
    ],
    "tile_rects": [
        ("rects[i] = x0, y0, x1, y1", "rects[i] = y0, x0, y1, x1", "columns stand for rows"),
        ("rects[i] = x0, y0, x1, y1", "rects[i] = x0, x1, y0, y1", "one axis after the other"),
        ("rects[i] = x0, y0, x1, y1", "rects[i] = x0, y0, x1 - x0, y1 - y0", "number of tiles"),
        ("if r_x > 0 and r_y > 0:", "if True:", "extent is 0"),
    ],
    "tile_lists": [
        ("lists[y * tiles_x + x].append(i)", "lists[x * tiles_y + y].append(i)", "columns stand for rows"),
        ("key=lambda i: (depth_of[i], i)", "key=lambda i: (-depth_of[i], i)", "back to front"),
        ("key=lambda i: (depth_of[i], i)", "key=lambda i: (depth_of[i], -i)", "depths are equal"),
        (
            "for i in sorted(range(len(depth_of)), key=lambda i: (depth_of[i], i)):",
            "for i in range(len(depth_of)):",
            "not sorted by depth",
        ),
        ("for x in range(x0, x1):", "for x in range(x0, min(x1 + 1, tiles_x)):"),
    ],
    "sigma_at_pixel": [
        (
            "0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy",
            "A * dx * dx + C * dy * dy + B * dx * dy",
            "half is missing",
        ),
        (
            "0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy",
            "A * dx * dx + C * dy * dy + 2.0 * B * dx * dy",
            "half is missing",
        ),
        (
            "0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy",
            "0.5 * (A * dx * dx + C * dy * dy + B * dx * dy)",
            "halved once too often",
        ),
        (
            "0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy",
            "0.5 * (A * dx * dx + C * dy * dy)",
            "cross term is missing",
        ),
        ("dx = mean2d[0] - px", "dx = mean2d[0] - px - 0.5", "half a pixel"),
        (
            "    dx = mean2d[0] - px\n    dy = mean2d[1] - py",
            "    dx = mean2d[0] - px + 0.5\n    dy = mean2d[1] - py + 0.5",
            "half a pixel",
        ),
        (
            "    dx = mean2d[0] - px\n    dy = mean2d[1] - py",
            "    dx = mean2d[0] - py\n    dy = mean2d[1] - px",
            "x and y are exchanged",
        ),
    ],
    "sigma_at_pixel_vjp": [
        (
            "v_sigma * 0.5 * dx * dx, v_sigma * dx * dy, v_sigma * 0.5 * dy * dy",
            "v_sigma * dx * dx, v_sigma * dx * dy, v_sigma * dy * dy",
            "conic",
        ),
        (
            "v_sigma * (A * dx + B * dy), v_sigma * (B * dx + C * dy)",
            "-v_sigma * (A * dx + B * dy), -v_sigma * (B * dx + C * dy)",
            "mean2d.*wrong sign",
        ),
        ("v_sigma * (A * dx + B * dy), v_sigma * (B * dx + C * dy)", "v_sigma * A * dx, v_sigma * C * dy", "mean2d"),
    ],
    "falloff": [
        ("math.exp(-sigma)", "math.exp(sigma)", "exponent's sign is missing"),
        ("math.exp(-sigma)", "math.exp(-sigma / 2)", "is the root"),
        ("math.exp(-sigma)", "1.0 - sigma"),
        ("    return math.exp(-sigma)\n", "    return math.exp(-sigma) / 0\n", "ZeroDivisionError"),
    ],
    "falloff_vjp": [
        ("-math.exp(-sigma) * v_falloff", "math.exp(-sigma) * v_falloff", "wrong sign"),
        ("-math.exp(-sigma) * v_falloff", "-math.exp(-sigma)"),
        ("-math.exp(-sigma) * v_falloff", "-sigma * math.exp(-sigma) * v_falloff"),
    ],
    "alpha_from_sigma": [
        (
            "alpha = min(profile.alpha_ceiling, opacity * falloff(sigma))",
            "alpha = opacity * falloff(sigma)",
            "over the ceiling",
        ),
        ("return alpha, alpha < profile.alpha_floor", "return alpha, False", "under the floor"),
        ("    if sigma < 0.0:\n        return 0.0, True\n", "", "sigma is negative"),
        ("opacity * falloff(sigma))", "falloff(sigma))", "opacity is missing"),
    ],
    "alpha_from_sigma_vjp": [
        (
            '    if opacity * falloff(sigma) > profile.alpha_ceiling and profile.ceiling_gradient == "zero":\n        return 0.0, 0.0\n',  # noqa: E501
            "",
            "over the ceiling",
        ),
        ("    if skipped:\n        return 0.0, 0.0\n", "", "under the floor|sigma is negative"),
        ("falloff_vjp(sigma, opacity * v_alpha)", "falloff_vjp(sigma, v_alpha)", "sigma"),
        ("falloff(sigma) * v_alpha", "v_alpha", "opacity"),
    ],
    "stops": [
        ("next_T <= profile.transmittance_stop if", "next_T < profile.transmittance_stop if", "exactly 1e-4"),
        (
            "    return next_T <= profile.transmittance_stop if profile.stop_inclusive else next_T < profile.transmittance_stop",  # noqa: E501
            "    return next_T > profile.transmittance_stop",
            "yes stands for no",
        ),
        (
            "    return next_T <= profile.transmittance_stop if profile.stop_inclusive else next_T < profile.transmittance_stop",  # noqa: E501
            "    return next_T <= 1e-3",
            "too often",
        ),
    ],
    "composite_pixel": [
        ("        color[k] += T * b\n", "        pass\n", "background is missing"),
        ("weight = T * alpha", "weight = alpha", "light that is left"),
        ("if stops(next_T, profile):", "if False:", "stops before the end"),
        ("if stops(next_T, profile):", "if stops(T, profile):", "stops before the end"),
        ("        if skipped:\n            continue\n", "", "under the floor"),
        ("        n_traversed += 1\n", "", "n_traversed"),
        ("next_T = T * (1.0 - alpha)", "next_T = T - alpha", ""),
        ("transmittances.append(T)", "transmittances.append(next_T)", "transmittances"),
        ("    for i in ids:\n        n_traversed", "    for i in reversed(ids):\n        n_traversed", "back to front"),
    ],
    "composite_pixel_vjp": [
        ("v_alpha = T * (color_dot_grad - suffix_dot_grad)", "v_alpha = T * color_dot_grad", "tail is missing"),
        ("        suffix_dot_grad += b * v_color[k]\n", "        pass\n", "background is missing"),
        ("suffix_dot_grad = v_T_final", "suffix_dot_grad = 0.0", "light that is left has a cotangent"),
        ("totals.v_opacities[i] += v_opacity", "totals.v_opacities[i] = v_opacity", "sums of other pixels"),
        (
            "suffix_dot_grad += alpha * (color_dot_grad - suffix_dot_grad)",
            "suffix_dot_grad += color_dot_grad - suffix_dot_grad",
        ),
        ("totals.v_means2d_abs[i] += (abs(v_mean2d[0]), abs(v_mean2d[1]))", "totals.v_means2d_abs[i] += v_mean2d"),
        ("totals.v_colors[i, k] += T * alpha * v_color[k]", "totals.v_colors[i, k] += alpha * v_color[k]"),
        ("v_alpha = T * (color_dot_grad - suffix_dot_grad)", "v_alpha = color_dot_grad - suffix_dot_grad"),
    ],
    "dominant_id": [
        ("if weight > best_weight:", "if weight >= best_weight:", "two weights are equal"),
        ("if weight > best_weight:", "if weight < best_weight:"),
        ("best_id, best_weight = -1, 0.0", "best_id, best_weight = 0, 0.0", "nothing is blended"),
        ("best_id, best_weight = i, weight", "best_id, best_weight = ids.index(i), weight", ""),
    ],
    "dominant_counts": [
        ("        if i >= 0:\n            counts[i] += 1", "        counts[i] += 1", "no winner"),
        ("counts[i] += 1", "counts[i] = 1"),
        ("counts = np.zeros(n, dtype=np.int64)", "counts = np.zeros(n + 1, dtype=np.int64)", "shape"),
    ],
    "l1": [
        ("np.sum(np.abs(difference)) / _n_kept(image, mask)", "np.sum(np.abs(difference)) / image.size", "mask leaves"),
        ("difference = replace_left_out(image, target, mask) - target", "difference = image - target", "mask leaves"),
        ("np.sum(np.abs(difference)) / _n_kept(image, mask)", "np.sum(np.abs(difference))", "a mean is asked for"),
        ("np.abs(difference)", "difference"),
        ("np.abs(difference)", "difference**2", ""),
    ],
    "l1_vjp": [
        ("v_l1 * np.sign(difference)", "v_l1 * difference"),
        ("v_l1 * np.sign(difference) / _n_kept(image, mask)", "v_l1 * np.sign(difference)", "a mean is asked for"),
        ("v_l1 * np.sign(difference)", "-v_l1 * np.sign(difference)", "wrong sign"),
        ("np.sign(difference)", "np.where(difference >= 0, 1.0, -1.0)", "equal"),
    ],
    "l2": [
        (
            "np.sum(difference**2) / _n_kept(image, mask)",
            "0.5 * np.sum(difference**2) / _n_kept(image, mask)",
            "0.5 times",
        ),
        (
            "np.sum(difference**2) / _n_kept(image, mask)",
            "np.sqrt(np.sum(difference**2) / _n_kept(image, mask))",
            "is the root",
        ),
        ("np.sum(difference**2) / _n_kept(image, mask)", "np.mean(difference**2)", "mask leaves"),
    ],
    "l2_vjp": [
        ("v_l2 * 2.0 * difference", "v_l2 * difference", "two is missing"),
        ("v_l2 * 2.0 * difference", "v_l2 * 8.0 * difference", "4 times"),
        ("v_l2 * 2.0 * difference", "2.0 * difference"),
        ("v_l2 * 2.0 * difference / _n_kept(image, mask)", "v_l2 * 2.0 * difference / image.size", "mask leaves"),
    ],
    "importance_mask": [
        ("dominant_counts > 0", "dominant_counts > 1", "too rarely"),
        ("dominant_counts > 0", "dominant_counts >= 0", "too often"),
        ("dominant_counts > 0", "dominant_counts == 0", "yes stands for no"),
    ],
    "pop_loss": [
        ("np.sum(1.0 - opacities[important])", "np.sum(opacities[important])"),
        ("/ max(int(np.sum(other)), 1)", "/ len(opacities)"),
        ("/ max(int(np.sum(other)), 1)", "/ np.sum(other)", "every Gaussian is important"),
        ("_sides(mask, visible)", "_sides(mask, None)", "only the visible"),
        ("float(toward_one + toward_zero)", "float(toward_one)"),
    ],
    "pop_loss_vjp": [
        ("v_opacities[important] = -v_loss /", "v_opacities[important] = v_loss /"),
        ("-v_loss / max(int(np.sum(important)), 1)", "-v_loss / len(opacities)"),
        ("_sides(mask, visible)", "_sides(mask, None)", "only the visible"),
        ("-v_loss / max(int(np.sum(important)), 1)", "-1.0 / max(int(np.sum(important)), 1)"),
    ],
    "adam_step": [
        (
            "new_params[name] = params[name] - lr[name]",
            "new_params[name] = params[name] + lr[name]",
            "up the loss",
        ),
        (" / (1.0 - beta1**t) *", " *", "not divided by 1 - beta1"),
        (
            "np.sqrt(new_v[name]) / np.sqrt(1.0 - beta2**t) + eps",
            "np.sqrt(new_v[name]) + eps",
            "not divided by 1 - beta2",
        ),
        (
            "np.sqrt(new_v[name]) / np.sqrt(1.0 - beta2**t) + eps",
            "np.sqrt(new_v[name] / (1.0 - beta2**t) + eps)",
            "eps decides|another eps",
        ),
        ("(1.0 - beta2) * g * g", "(1.0 - beta2) * g"),
        ("m[name] + (1.0 - beta1) * (g - m[name])", "beta1 * m[name] + g", ""),
        ("        new_v[name] = beta2", "        v[name] = new_v[name] = beta2", "in place"),
    ],
    "clone_rows": [
        ("array[mask] for name", "array[~mask] for name"),
        (
            "    return _keep_and_append(rows, np.ones(len(rows), dtype=bool), copies)",
            "    return _keep_and_append(rows, ~mask, copies)",
        ),
        (
            "    return _keep_and_append(rows, np.ones(len(rows), dtype=bool), copies)",
            "    kinds = (rows.params, rows.m, rows.v)\n    return Rows(*({n: np.concatenate([a, a[mask]]) for n, a in x.items()} for x in kinds))",  # noqa: E501
            "`m` and `v`",
        ),
    ],
    "split_rows": [
        ("rotmats[i] @ (scales[i] * normals[child, i])", "scales[i] * normals[child, i]", "not turned"),
        ("np.log(scales / SPLIT_SHRINK)", "np.log(scales) / SPLIT_SHRINK", "scales"),
        ("np.log(scales / SPLIT_SHRINK)", "np.log(scales)", "scales"),
        (
            "    return _keep_and_append(rows, ~mask, children)",
            "    return _keep_and_append(rows, np.ones(len(rows), dtype=bool), children)",
            "parents stay",
        ),
        ("+= rotmats[i] @", "= rotmats[i] @", "means"),
    ],
    "prune_rows": [
        (
            "return _keep_and_append(rows, ~mask, {name: array[:0]",
            "return _keep_and_append(rows, mask, {name: array[:0]",
            "keep the rows",
        ),
        (
            "    return _keep_and_append(rows, ~mask, {name: array[:0] for name, array in rows.params.items()})",
            "    return Rows({n: a[~mask] for n, a in rows.params.items()}, {n: a[: np.sum(~mask)] for n, a in rows.m.items()}, {n: a[~mask] for n, a in rows.v.items()})",  # noqa: E501
            "`m` in",
        ),
    ],
    "grow_masks": [
        (
            "return (by_grad | by_blur) & small, (by_grad | by_blur) & ~small",
            "return (by_grad | by_blur) & ~small, (by_grad | by_blur) & small",
            "exchanged",
        ),
        (
            "return (by_grad | by_blur) & small, (by_grad | by_blur) & ~small",
            "return by_grad & small, by_grad & ~small",
            "blur set",
        ),
        ("statistics.blurred & blurs_at(step, config)", "statistics.blurred", "outside the blur window"),
        (
            "np.max(scales, axis=1) <= config.grow_scale3d * scene_scale",
            "np.max(scales, axis=1) <= config.grow_scale3d",
        ),
        (
            "np.max(scales, axis=1) <= config.grow_scale3d * scene_scale",
            "np.max(scales, axis=1) < config.grow_scale3d * scene_scale",
            "exactly at its threshold",
        ),
        ("grads = average_grads(statistics, config)", "grads = statistics.grad_sum", ""),
        ("np.max(scales, axis=1)", "np.min(scales, axis=1)"),
    ],
    "prune_mask": [
        (
            "too_faint = opacities < config.prune_opa",
            "too_faint = opacities <= config.prune_opa",
            "exactly at its threshold",
        ),
        ("too_faint = opacities < config.prune_opa", "too_faint = opacities > config.prune_opa"),
        ("too_faint = opacities < config.prune_opa", "too_faint = opacities < 0.05", ""),
        ("        return too_faint\n", "        return too_faint | (np.max(scales, axis=1) > 1.0)\n", "very large"),
    ],
    "gaussians_from_params": [
        ('scales=scales_from_log_scales(params["scales"])', 'scales=np.abs(params["scales"])', "scales"),
        ('for name in ("sh0", "shN") if name in params', 'for name in ("sh0",)', "shN"),
        (
            'opacities=opacities_from_logits(params["opacities"])',
            'opacities=opacities_from_logits(-params["opacities"])',
            "opacities",
        ),
    ],
    "params_vjp": [
        ("gradients.opacities + v_opacities)", "gradients.opacities)", "opacities"),
        ('scales_from_log_scales_vjp(params["scales"], gradients.scales)', "gradients.scales", "scales"),
        (
            '"sh0": gradients.sh[:, :1], "shN": gradients.sh[:, 1:]',
            '"sh0": gradients.sh[:, :1], "shN": gradients.sh[:, :-1]',
            "shN",
        ),
    ],
    "train_step": [
        (
            "params_vjp(rows.params, gradients, v_opacities)",
            "params_vjp(rows.params, gradients, 0.0 * v_opacities)",
            "opacities",
        ),
        (
            "return Training(rows, statistics, step + 1, waiting), loss",
            "return Training(rows, statistics, step, waiting), loss",
            "`step`",
        ),
        (
            "    rows, statistics = control(rows, statistics, scene_scale, step, normals, recipe.density)\n",
            "",
            "densification step",
        ),
        (
            "    rows, waiting = update(rows, grads, state, scene_scale, recipe)\n",
            "    waiting = {}\n",
            "does not move|rows",
        ),
        (
            "    statistics = accumulate(state.statistics, *seen, recipe.density)\n",
            "    statistics = state.statistics\n",
            "statistics",
        ),
    ],
}
