"""Gaussian splatting in one file of plain NumPy: forward, backward, Adam, clone, split, prune.

    python -m pop_ref.learn.splat        # trains in about a minute and writes splat.png as it goes

It needs NumPy alone, so it may also be copied away and run by itself. Names are those of `pop_ref`, which does the same
with every special case; a test holds this file to it. `v_x` is the gradient of the loss with respect to x.
"""

from __future__ import annotations

import struct
import sys
import time
import zlib
from types import SimpleNamespace

import numpy as np

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: colour = SH_C0 * sh0 + 0.5
NEAR_PLANE, FRUSTUM_MARGIN, EPS2D, EXTENT_SIGMAS = 0.01, 0.3, 0.3, 3.33
ALPHA_FLOOR, ALPHA_CEILING, TRANSMITTANCE_STOP = 1 / 255, 0.999, 1e-4
GROW_GRAD2D, GROW_SCALE3D, PRUNE_OPA, SPLIT_SHRINK = 2e-4, 0.01, 0.005, 1.6


# A scene is a dictionary of arrays with one row a Gaussian: "means" [N, 3] and "quats" [N, 4] say where it is and how
# it is turned, "scales" [N, 3] holds logarithms of three standard deviations, "opacities" [N] logits, "sh0" [N, 1, 3]
# its colour. Logarithms and logits may take any value, so the optimizer need not know what a size or an opacity is.
def rotmats_from_quats(units):
    """Write unit quaternions (w, x, y, z) as rotation matrices."""
    w, x, y, z = units.T
    row0 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    row1 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    row2 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return np.array([row0, row1, row2]).transpose(2, 0, 1)


def geometry(params, camera):
    """Follow every Gaussian to the screen: an ellipsoid in the world becomes an ellipse in pixels."""
    viewmat, K, width, height = camera
    s, c, size = SimpleNamespace(R_cam=viewmat[:3, :3], f=K[[0, 1], [0, 1]]), K[:2, 2], np.array([width, height])
    # covars = R diag(scales)^2 R^T: a ball, stretched along its own axes, then turned by its quaternion
    s.norms = np.linalg.norm(params["quats"], axis=1, keepdims=True)
    s.units = params["quats"] / s.norms
    s.R, s.scales = rotmats_from_quats(s.units), np.exp(params["scales"])
    s.M = s.R * s.scales[:, None, :]
    s.covars_cam = s.R_cam @ (s.M @ s.M.swapaxes(1, 2)) @ s.R_cam.T
    # a pinhole sends (x, y, z) to f (x/z, y/z) + c; near one point that is a linear map, its Jacobian J
    means_cam = params["means"] @ s.R_cam.T + viewmat[:3, 3]
    s.depths = means_cam[:, 2]
    in_front = s.depths >= NEAR_PLANE
    s.depth = np.where(in_front, s.depths, 1.0)[:, None]
    s.slopes = means_cam[:, :2] / s.depth
    s.means2d = s.f * s.slopes + c
    # far outside the picture the linear map would explode: there it is taken at the border
    margin = FRUSTUM_MARGIN * size / (2 * s.f)
    s.clamped = np.clip(s.slopes, -c / s.f - margin, (size - c) / s.f + margin)
    s.J = np.zeros((len(s.R), 2, 3))
    s.J[:, 0, 0], s.J[:, 1, 1] = (s.f / s.depth).T
    s.J[:, :, 2] = -s.f * s.clamped / s.depth
    # a little blur, so that no splat falls between two pixels; conics are inverse covariances as (xx, xy, yy)
    covars2d = s.J @ s.covars_cam @ s.J.swapaxes(1, 2) + EPS2D * np.eye(2)
    a, b, d = covars2d[:, 0, 0], covars2d[:, 0, 1], covars2d[:, 1, 1]
    det = a * d - b * b
    s.conics = np.stack([d, -b, a], 1) / np.where(det > 0, det, 1.0)[:, None]
    # half-sides of the rectangle outside which the splat is fainter than one step of an 8-bit picture
    s.opacities = 1 / (1 + np.exp(-params["opacities"]))
    reach = np.minimum(EXTENT_SIGMAS, np.sqrt(2 * np.log(np.maximum(s.opacities / ALPHA_FLOOR, 1.0))))
    s.radii = np.ceil(reach[:, None] * np.sqrt(np.stack([a, d], 1)))
    touches = np.all((s.radii > 0) & (s.means2d + s.radii > 0) & (s.means2d - s.radii < size), axis=1)
    s.visible = in_front & (det > 0) & (s.opacities >= ALPHA_FLOOR) & touches
    colors = SH_C0 * params["sh0"][:, 0] + 0.5
    s.colors, s.lit = np.maximum(colors, 0.0), colors >= 0
    return s


def render(params, camera, background):
    """Paint the splats from front to back: C = sum_i T_i alpha_i c_i + T_final background."""
    s, (width, height) = geometry(params, camera), camera[2:]
    image, T = np.zeros((height, width, 3)), np.ones((height, width))
    alive, best = np.ones((height, width), dtype=bool), np.zeros((height, width))
    dominant_ids = np.full((height, width), -1)
    tape = []  # what the backward pass will need, in the order of painting
    for i in np.argsort(s.depths, kind="stable"):
        if not s.visible[i]:
            continue
        (u, v), (r_x, r_y), (A, B, C) = s.means2d[i], s.radii[i], s.conics[i]
        x0, x1 = max(0, int(np.floor(u - r_x))), min(width, int(np.ceil(u + r_x)))
        y0, y1 = max(0, int(np.floor(v - r_y))), min(height, int(np.ceil(v + r_y)))
        box = slice(y0, y1), slice(x0, x1)
        dx, dy = u - (np.arange(x0, x1) + 0.5), (v - (np.arange(y0, y1) + 0.5))[:, None]
        G = np.exp(-(0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy))
        alpha = np.minimum(ALPHA_CEILING, s.opacities[i] * G)
        # T is the light that is left for this splat; a pixel that would be left with none ends before it
        T_before = T[box].copy()
        reached = alive[box] & (alpha >= ALPHA_FLOOR)
        ends = reached & (T_before * (1 - alpha) <= TRANSMITTANCE_STOP)
        alive[box] &= ~ends
        alpha = np.where(reached & ~ends, alpha, 0.0)
        weight = T_before * alpha
        image[box] += weight[..., None] * s.colors[i]
        T[box] = T_before * (1 - alpha)
        # the splat with the largest weight dominates the pixel: POP asks which Gaussians dominate none
        won = weight > best[box]
        best[box][won], dominant_ids[box][won] = weight[won], i
        tape.append((i, box, dx, dy, G, alpha, T_before))
    image += T[..., None] * background
    counts = np.bincount(dominant_ids[dominant_ids >= 0], minlength=len(s.depths))
    return image, SimpleNamespace(**vars(s), tape=tape, T_final=T, background=background, dominant_counts=counts)


def render_vjp(params, s, v_image):
    """Walk the tape back: from the gradient of the image to that of every parameter."""
    n = len(params["means"])
    v_colors, v_opacities, v_means2d, v_conics = np.zeros((n, 3)), np.zeros(n), np.zeros((n, 2)), np.zeros((n, 3))
    # what the light that passes a splat is worth to the loss; behind all splats it shows the background
    behind = v_image @ s.background
    for i, box, dx, dy, G, alpha, T in reversed(s.tape):
        color_dot_grad = v_image[box] @ s.colors[i]
        v_colors[i] = np.tensordot(T * alpha, v_image[box], axes=2)
        # more alpha shows more of this splat and hides what is behind it: both parts count
        v_alpha = np.where(alpha > 0, T * (color_dot_grad - behind[box]), 0.0)
        behind[box] += alpha * (color_dot_grad - behind[box])
        v_G = np.where(s.opacities[i] * G <= ALPHA_CEILING, v_alpha, 0.0)
        v_opacities[i] = np.sum(G * v_G)
        v_sigma = -s.opacities[i] * G * v_G
        A, B, C = s.conics[i]
        v_means2d[i] = np.sum(v_sigma * (A * dx + B * dy)), np.sum(v_sigma * (B * dx + C * dy))
        v_conics[i] = np.sum(v_sigma * dx * dx) / 2, np.sum(v_sigma * dx * dy), np.sum(v_sigma * dy * dy) / 2
    grads = geometry_vjp(s, v_means2d, v_conics)
    grads["opacities"] = s.opacities * (1 - s.opacities) * v_opacities
    return {**grads, "sh0": (SH_C0 * v_colors * s.lit)[:, None]}, v_means2d


def geometry_vjp(s, v_means2d, v_conics):
    """Retrace `geometry` from its end to its beginning, line by line."""
    # of an inverse: d(X^-1) = -X^-1 dX X^-1; the off-diagonal stands twice in the matrix and once in the conic
    inverse = s.conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    V = (v_conics[:, [0, 1, 1, 2]] * [1, 0.5, 0.5, 1]).reshape(-1, 2, 2)
    v_covars2d = -inverse @ V @ inverse
    # of J S J^T, with both matrices symmetric
    J, f, depth = s.J, s.f, s.depth
    v_covars_cam = J.swapaxes(1, 2) @ v_covars2d @ J
    v_J = 2 * v_covars2d @ J @ s.covars_cam
    # of the pinhole and its Jacobian, both functions of the slopes x/z, y/z and of the depth
    inside = s.slopes == s.clamped
    v_slopes = f * v_means2d - np.where(inside, f / depth * v_J[:, :, 2], 0.0)
    v_depth = -np.sum(s.slopes * v_slopes, axis=1, keepdims=True) / depth
    v_depth += np.sum(f * s.clamped * v_J[:, :, 2], axis=1, keepdims=True) / depth**2
    v_depth -= (f[0] * v_J[:, 0, 0] + f[1] * v_J[:, 1, 1])[:, None] / depth**2
    v_means = np.concatenate([v_slopes / depth, v_depth], axis=1) @ s.R_cam
    # of M M^T with M = R diag(scales)
    v_M = 2 * (s.R_cam.T @ v_covars_cam @ s.R_cam) @ s.M
    v_scales = np.sum(s.R * v_M, axis=1)
    v_R = v_M * s.scales[:, None, :]
    # of the rotation matrix, whose entries are quadratic in the quaternion, and of the division by its norm
    (w, x, y, z), ((r00, r01, r02), (r10, r11, r12), (r20, r21, r22)) = s.units.T, v_R.transpose(1, 2, 0)
    v_w = x * (r21 - r12) + y * (r02 - r20) + z * (r10 - r01)
    v_x = w * (r21 - r12) + y * (r01 + r10) + z * (r02 + r20) - 2 * x * (r11 + r22)
    v_y = w * (r02 - r20) + x * (r01 + r10) + z * (r12 + r21) - 2 * y * (r00 + r22)
    v_z = w * (r10 - r01) + x * (r02 + r20) + y * (r12 + r21) - 2 * z * (r00 + r11)
    v_unit = 2 * np.stack([v_w, v_x, v_y, v_z], 1)
    v_quats = (v_unit - s.units * np.sum(s.units * v_unit, axis=1, keepdims=True)) / s.norms
    return {"means": v_means, "quats": v_quats, "scales": s.scales * v_scales}


def adam_step(params, grads, m, v, step, lr, betas=(0.9, 0.999), eps=1e-15):
    """Move every parameter by about its learning rate: the mean of recent gradients over their typical size."""
    for name, g in grads.items():
        m[name] = m[name] + (1 - betas[0]) * (g - m[name])
        v[name] = betas[1] * v[name] + (1 - betas[1]) * g * g
        size = np.sqrt(v[name]) / np.sqrt(1 - betas[1] ** step) + eps
        params[name] = params[name] - lr[name] / (1 - betas[0] ** step) * m[name] / size


def densify_and_prune(params, m, v, average_grads, scene_scale, normals):
    """Give detail to where the loss pulls hard, and take away what nobody can see."""
    scales = np.exp(params["scales"])
    wanted, small = average_grads > GROW_GRAD2D, np.max(scales, axis=1) <= GROW_SCALE3D * scene_scale
    clone, split = wanted & small, wanted & ~small
    # a small Gaussian is copied; a large one makes way for two smaller ones, drawn from where it was
    copies = {name: x[clone] for name, x in params.items()}
    children = {name: np.concatenate([x[split]] * 2) for name, x in params.items()}
    R = rotmats_from_quats(params["quats"] / np.linalg.norm(params["quats"], axis=1, keepdims=True))
    offsets = R[split] @ (normals(int(np.sum(split))) * scales[split])[..., None]
    children["means"] = children["means"] + np.concatenate(offsets[..., 0])
    children["scales"] = children["scales"] - np.log(SPLIT_SHRINK)
    grown = {name: np.concatenate([x[~split], copies[name], children[name]]) for name, x in params.items()}
    kept = 1 / (1 + np.exp(-grown["opacities"])) >= PRUNE_OPA
    # Adam's moments go with their rows; newcomers start without any
    for moments in (m, v):
        for name, x in moments.items():
            n_new = len(grown[name]) - int(np.sum(~split))
            moments[name] = np.concatenate([x[~split], np.zeros((n_new, *x.shape[1:]))])[kept]
    params.update({name: x[kept] for name, x in grown.items()})


def l2(image, target):
    """Compare two pictures; return the mean square and its gradient."""
    return np.mean((image - target) ** 2), 2 * (image - target) / image.size


def pop_loss_vjp(opacities, dominant_counts):
    """Pull opacities to 1 where a Gaussian dominates a pixel and to 0 where it dominates none."""
    important = dominant_counts > 0
    n_important = int(np.sum(important))
    return np.where(important, -1 / max(n_important, 1), 1 / max(len(opacities) - n_important, 1))


# The toy: three balls on a chequered floor, photographed from all around.
BALLS = np.array([[0.0, -0.5, 0.0], [0.9, -0.3, 0.3], [-0.7, -0.35, 0.6]]), np.array([0.5, 0.3, 0.35])
PAINT = np.array([[0.9, 0.25, 0.2], [0.2, 0.5, 0.9], [0.95, 0.75, 0.2]])


def orbit(angle, size):
    """Stand on a circle and look at the middle: world -> camera, +x right, +y down, +z forward."""
    eye, right = np.array([3.2 * np.cos(angle), -1.6, 3.2 * np.sin(angle)]), [-np.sin(angle), 0.0, np.cos(angle)]
    forward = np.array([0.0, -0.25, 0.0]) - eye
    forward /= np.linalg.norm(forward)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat, np.array([[1.1 * size, 0, size / 2], [0, 1.1 * size, size / 2], [0, 0, 1]]), size, size


def photograph(camera):
    """Trace one ray a pixel: to the floor at y = 0, then to each ball; the nearest hit is seen."""
    viewmat, K, width, height = camera
    px, py = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(px - K[0, 2]) / K[0, 0], (py - K[1, 2]) / K[1, 1], np.ones_like(px)], -1) @ viewmat[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    nearest = np.where(rays[..., 1] > 0, -eye[1] / np.maximum(rays[..., 1], 1e-9), 0.0)
    x, _, z = np.moveaxis(eye + nearest[..., None] * rays, -1, 0)
    on_floor = (nearest > 0) & (abs(x) < 1.5) & (abs(z) < 1.5)
    image = (on_floor * (0.35 + 0.4 * ((np.floor(2 * x) + np.floor(2 * z)) % 2)))[..., None] * np.ones(3)
    nearest[~on_floor] = np.inf
    for centre, radius, paint in zip(*BALLS, PAINT, strict=True):
        along = rays @ (centre - eye)
        inside = along**2 - np.sum((centre - eye) ** 2) + radius**2
        distance = along - np.sqrt(np.maximum(inside, 0.0))
        shade = np.maximum((eye + distance[..., None] * rays - centre) @ [0.4, -0.8, 0.45] / radius, 0.0)
        closer = (inside > 0) & (distance < nearest)
        image[closer], nearest = ((0.25 + 0.75 * shade)[..., None] * paint)[closer], np.where(closer, distance, nearest)
    return image


def start(n, rng):
    """Scatter grey, round, half-transparent Gaussians where the scene is: nothing else is known of it."""
    means = rng.uniform([-1.5, -1.0, -1.5], [1.5, 0.05, 1.5], (n, 3))
    shapes = {"quats": rng.standard_normal((n, 4)), "scales": np.full((n, 3), np.log(0.12))}
    return {"means": means, **shapes, "opacities": np.full(n, -1.0), "sh0": np.zeros((n, 1, 3))}


def write_png(path, image):
    """Write a picture: three chunks, the pixels deflated."""
    rows = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", *rows.shape[1::-1], 8, 2, 0, 0, 0)
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(raw)), (b"IEND", b"")):
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))


def train(steps=500, size=64, n_views=24, n=300, seed=0, lambda_pop=1e-3, out="splat.png"):
    """Fit the toy and return the scene and the PSNR of a view that no step has seen."""
    rng, background, began = np.random.default_rng(seed), np.zeros(3), time.perf_counter()
    cameras = [orbit(2 * np.pi * k / n_views, size) for k in range(n_views)]
    photographs, unseen = [photograph(camera) for camera in cameras], orbit(np.pi / n_views, size)
    target = photograph(unseen)
    lr = {"means": 4e-3, "quats": 1e-2, "scales": 1.5e-2, "opacities": 5e-2, "sh0": 2e-2}
    params, psnr = start(n, rng), 0.0
    m, v = ({name: np.zeros_like(x) for name, x in params.items()} for _ in range(2))
    grad_sum, n_visible = np.zeros((2, n))
    for step in range(1, steps + 1):
        k = int(rng.integers(n_views))
        image, s = render(params, cameras[k], background)
        loss, v_image = l2(image, photographs[k])
        grads, v_means2d = render_vjp(params, s, v_image)
        v_opacities = lambda_pop * pop_loss_vjp(s.opacities, s.dominant_counts)
        grads["opacities"] += s.opacities * (1 - s.opacities) * v_opacities
        adam_step(params, grads, m, v, step, {name: rate * 0.1 ** (step / steps) for name, rate in lr.items()})
        # how hard the loss pulls a splat across the screen, on average over the views that show it
        grad_sum += s.visible * np.linalg.norm(size / 2 * v_means2d, axis=1)
        n_visible += s.visible
        if step % 100 == 0 and step <= steps // 2:
            average_grads = grad_sum / np.maximum(n_visible, 1)
            densify_and_prune(params, m, v, average_grads, 3.0, lambda n: rng.standard_normal((2, n, 3)))
            grad_sum, n_visible = np.zeros((2, len(params["means"])))
        if step % max(1, steps // 10) == 0:
            image, _ = render(params, unseen, background)
            psnr = -10 * np.log10(l2(np.clip(image, 0, 1), target)[0])
            told = f"step {step:4d}   loss {loss:.5f}   unseen view {psnr:.2f} dB   {len(params['means'])} Gaussians"
            print(f"{told}   {time.perf_counter() - began:.0f} s", flush=True)
            write_png(out, np.repeat(np.repeat(np.concatenate([target, image], axis=1), 4, axis=0), 4, axis=1))
    return params, psnr


if __name__ == "__main__":
    train(out=sys.argv[1] if len(sys.argv) > 1 else "splat.png")
