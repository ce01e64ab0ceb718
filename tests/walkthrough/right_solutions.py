"""Right solutions in other styles than the oracle's: whole arrays, other names, constants as chapters print them."""

from __future__ import annotations

# stage, and functions that replace the oracle's in its file
RIGHT: dict[str, tuple[str, str]] = {
    "a sigmoid with where, on whole arrays": (
        "activations",
        """
def opacities_from_logits(x):
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1 / (1 + e), e / (1 + e))
""",
    ),
    "the plain sigmoid, whose overflow is harmless in NumPy": (
        "activations",
        """
def opacities_from_logits(x):
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-x))

def opacities_from_logits_vjp(x, v):
    o = opacities_from_logits(x)
    return o * opacities_from_logits(-x) * v
""",
    ),
    "a sigmoid by tanh": (
        "activations",
        """
def scales_from_log_scales_vjp(log_scales, v_scales):
    s = scales_from_log_scales(log_scales)
    return v_scales * s
""",
    ),
    "quaternions divided at once": (
        "activations",
        """
def unit_quats_from_quats(q):
    return q / np.linalg.norm(q, axis=-1, keepdims=True)

def unit_quats_from_quats_vjp(q, v):
    n = np.sqrt((q * q).sum(1))[:, None]
    u = q / n
    return (v - (u * v).sum(1)[:, None] * u) / n
""",
    ),
    "a normalisation by its Jacobian": (
        "activations",
        """
def unit_quats_from_quats_vjp(quats, v_unit_quats):
    found = []
    for q, v in zip(quats, v_unit_quats):
        n = np.linalg.norm(q)
        J = np.eye(4) / n - np.outer(q, q) / n**3
        found.append(J.T @ v)
    return np.array(found).reshape(-1, 4)
""",
    ),
    "rotations on whole arrays": (
        "covariance",
        """
def rotmats_from_quats(quats):
    w, x, y, z = unit_quats_from_quats(quats).T
    R = np.empty((len(quats), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = w*w + x*x - y*y - z*z, 2*(x*y - w*z), 2*(x*z + w*y)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2*(x*y + w*z), w*w - x*x + y*y - z*z, 2*(y*z - w*x)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2*(x*z - w*y), 2*(y*z + w*x), w*w - x*x - y*y + z*z
    return R
""",
    ),
    "a rotation by Rodrigues' formula": (
        "covariance",
        """
def rotmats_from_quats(quats):
    found = np.zeros((len(quats), 3, 3))
    for k, q in enumerate(quats):
        w, *v = q / np.sqrt(q @ q)
        v = np.array(v)
        K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        found[k] = np.eye(3) + 2 * w * K + 2 * K @ K
    return found
""",
    ),
    "covariances as R S S^T R^T": (
        "covariance",
        """
def covars_from_quats_scales(quats, scales):
    R = rotmats_from_quats(quats)
    S = np.array([np.diag(s) for s in scales]).reshape(-1, 3, 3)
    half = R @ S
    return half @ np.swapaxes(half, 1, 2)
""",
    ),
    "a covariance's vjp by einsum": (
        "covariance",
        """
def covars_from_quats_scales_vjp(quats, scales, v_covars):
    R = rotmats_from_quats(quats)
    v_M = np.einsum("nij,njk->nik", v_covars + v_covars.transpose(0, 2, 1), R * scales[:, None, :])
    return rotmats_from_quats_vjp(quats, v_M * scales[:, None, :]), np.einsum("nij,nij->nj", R, v_M)
""",
    ),
    "colours by einsum": (
        "harmonics",
        """
def colors_from_sh(sh, dirs, degree):
    n = (degree + 1) ** 2
    Y = sh_basis(dirs / np.linalg.norm(dirs, axis=1, keepdims=True), degree)
    return np.clip(np.einsum("nk,nkc->nc", Y, sh[:, :n]) + 0.5, 0, None)
""",
    ),
    "harmonics with printed constants": (
        "harmonics",
        """
def sh_basis(dirs, degree):
    x, y, z = dirs.T
    one = np.ones(len(dirs))
    Y = np.stack([
        0.28209479177387814 * one, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y)], axis=1)
    return Y[:, :(degree + 1) ** 2]
""",
    ),
    "the camera by matrix products": (
        "camera",
        """
def camera_center(V):
    return np.linalg.inv(V)[:3, 3]

def means_cam_from_means(means, V):
    h = np.hstack([means, np.ones((len(means), 1))])
    return (h @ V.T)[:, :3]

def covars_cam_from_covars(covars, V):
    R = V[:3, :3]
    return R @ covars @ R.T
""",
    ),
    "the camera's vjps on whole arrays": (
        "camera",
        """
def means_cam_from_means_vjp(means, viewmat, v):
    out = np.zeros((4, 4))
    out[:3, :3] = v.T @ means
    out[:3, 3] = v.sum(0)
    return v @ viewmat[:3, :3], out

def covars_cam_from_covars_vjp(covars, viewmat, V):
    R = viewmat[:3, :3]
    out = np.zeros((4, 4))
    out[:3, :3] = (V @ R @ covars.transpose(0, 2, 1) + V.transpose(0, 2, 1) @ R @ covars).sum(0)
    return R.T @ V @ R, out
""",
    ),
    "planes as chapter 2 prints them, without a profile": (
        "camera",
        """
def in_front(depths):
    return (depths >= 0.01) & (depths <= 1e10)
""",
    ),
    "the pinhole on whole arrays, without a profile": (
        "projection",
        """
def project_means(p, K, width, height):
    uvw = p @ K.T
    return uvw[:, :2] / uvw[:, 2:]

def project_means_vjp(p, K, width, height, v):
    x, y, z = p.T
    fx, fy = K[0, 0], K[1, 1]
    return np.stack([fx / z * v[:, 0], fy / z * v[:, 1], -(fx * x * v[:, 0] + fy * y * v[:, 1]) / z**2], 1)
""",
    ),
    "the Jacobian on whole arrays, with the margin as a number": (
        "projection",
        """
def projection_jacobians(means_cam, K, width, height):
    x, y, z = means_cam.T
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    a = np.clip(x / z, -(cx + 0.15 * width) / fx, (width - cx + 0.15 * width) / fx)
    b = np.clip(y / z, -(cy + 0.15 * height) / fy, (height - cy + 0.15 * height) / fy)
    J = np.zeros((len(z), 2, 3))
    J[:, 0, 0], J[:, 0, 2] = fx / z, -fx * a / z
    J[:, 1, 1], J[:, 1, 2] = fy / z, -fy * b / z
    return J
""",
    ),
    "covariances on the screen at once": (
        "projection",
        """
def project_covars(S, J):
    return J @ S @ np.swapaxes(J, 1, 2)

def project_covars_vjp(S, J, V):
    T = lambda A: np.swapaxes(A, 1, 2)
    return T(J) @ V @ J, V @ J @ T(S) + T(V) @ J @ S
""",
    ),
    "a blur that is looped over": (
        "footprint",
        """
def low_pass(covars2d, eps2d):
    out = covars2d.copy()
    for i in range(len(out)):
        out[i, 0, 0] += eps2d
        out[i, 1, 1] += eps2d
    return out

def low_pass_vjp(covars2d, eps2d, v_blurred):
    return np.array(v_blurred)
""",
    ),
    "conics on whole arrays": (
        "footprint",
        """
def conics_from_covars2d(C):
    a, b, c = C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]
    det = a * c - b * C[:, 1, 0]
    ok = det > 0
    safe = np.where(ok, det, 1.0)
    return np.where(ok[:, None], np.stack([c, -0.5 * (b + C[:, 1, 0]), a], 1) / safe[:, None], 0.0)
""",
    ),
    "extents with 1/255 and 3.33": (
        "footprint",
        """
def radii_from_covars2d(covars2d, opacities):
    out = np.zeros((len(covars2d), 2), dtype=int)
    for i, (C, o) in enumerate(zip(covars2d, opacities)):
        if C[0, 0] * C[1, 1] - C[0, 1] * C[1, 0] <= 0 or o < 1 / 255:
            continue
        k = min(3.33, math.sqrt(2 * math.log(255 * o)))
        for axis in range(2):
            out[i, axis] = math.ceil(min(2**31 - 1, k * math.sqrt(C[axis, axis])))
    return out

def on_screen(means2d, radii, width, height):
    (u, v), (rx, ry) = means2d.T, radii.T
    return (rx > 0) & (ry > 0) & (u + rx > 0) & (u - rx < width) & (v + ry > 0) & (v - ry < height)
""",
    ),
    "tiles by math.ceil and np.clip": (
        "tiles",
        """
def grid_size(width, height, tile_size):
    if tile_size < 1:
        raise ValueError("no tile")
    return math.ceil(width / tile_size), math.ceil(height / tile_size)

def tile_span(center, radius, n_tiles, tile_size):
    first = int(np.clip(np.floor((center - radius) / tile_size), 0, n_tiles))
    last = int(np.clip(np.ceil((center + radius) / tile_size), 0, n_tiles))
    return first, last
""",
    ),
    "lists tile by tile": (
        "tiles",
        """
def tile_lists(means2d, radii, depths, width, height, tile_size, profile=PAPER):
    nx, ny = grid_size(width, height, tile_size)
    rects = tile_rects(means2d, radii, width, height, tile_size)
    order = [int(i) for i in np.argsort(depths, kind="stable")]
    return [[i for i in order if rects[i, 0] <= x < rects[i, 2] and rects[i, 1] <= y < rects[i, 3]]
            for y in range(ny) for x in range(nx)]
""",
    ),
    "alpha as chapter 1 writes it": (
        "alpha",
        """
def alpha_from_sigma(sigma, opacity):
    if sigma < 0:
        return 0.0, True
    alpha = min(0.999, opacity * math.exp(-sigma))
    return alpha, alpha < 1 / 255

def alpha_from_sigma_vjp(sigma, opacity, v_alpha):
    G = math.exp(-sigma) if sigma >= 0 else 0.0
    if sigma < 0 or opacity * G < 1 / 255 or opacity * G > 0.999:
        return 0.0, 0.0
    return -opacity * G * v_alpha, G * v_alpha
""",
    ),
    "the exponent with matrices and other names": (
        "alpha",
        """
def sigma_at_pixel(mu, q, x, y):
    d = np.array([mu[0] - x, mu[1] - y])
    Q = np.array([[q[0], q[1]], [q[1], q[2]]])
    return float(0.5 * d @ Q @ d)

def falloff(s):
    return float(np.exp(-s))
""",
    ),
    "the exponent's vjp by an outer product": (
        "alpha",
        """
def sigma_at_pixel_vjp(mean2d, conic, px, py, v_sigma):
    d = np.array(mean2d) - (px, py)
    Q = np.array([[conic[0], conic[1]], [conic[1], conic[2]]])
    v_Q = 0.5 * v_sigma * np.outer(d, d)
    v_mean = v_sigma * Q @ d
    return (v_mean[0], v_mean[1]), (v_Q[0, 0], v_Q[0, 1] + v_Q[1, 0], v_Q[1, 1])
""",
    ),
    "blending without a profile": (
        "compositing",
        """
def stops(next_T):
    return next_T <= 1e-4

def composite_pixel(ids, rows, px, py, background):
    color, T = np.zeros(len(background)), 1.0
    kept, alphas, lights, looked = [], [], [], 0
    for i in ids:
        looked += 1
        alpha, skip = alpha_from_sigma(sigma_at_pixel(rows.means2d[i], rows.conics[i], px, py), rows.opacities[i])
        if skip:
            continue
        if stops(T * (1 - alpha)):
            break
        color = color + T * alpha * np.array(rows.colors[i])
        kept.append(i), alphas.append(alpha), lights.append(T)
        T = T * (1 - alpha)
    return Pixel((color + T * np.array(background)).tolist(), T, kept, alphas, lights, looked)
""",
    ),
    "the way back by the sum of what lies behind": (
        "compositing",
        """
def composite_pixel_vjp(pixel, rows, px, py, background, v_color, v_T_final, totals, profile=PAPER):
    g = np.array(v_color)
    totals.v_background[:] += pixel.T_final * g
    behind = float(np.dot(background, g)) + v_T_final
    for at in range(len(pixel.ids) - 1, -1, -1):
        i, a, T = pixel.ids[at], pixel.alphas[at], pixel.transmittances[at]
        q = float(np.dot(rows.colors[i], g))
        totals.v_colors[i] += T * a * g
        sigma = sigma_at_pixel(rows.means2d[i], rows.conics[i], px, py)
        v_sigma, v_o = alpha_from_sigma_vjp(sigma, rows.opacities[i], T * (q - behind))
        v_mean, v_conic = sigma_at_pixel_vjp(rows.means2d[i], rows.conics[i], px, py, v_sigma)
        totals.v_opacities[i] += v_o
        totals.v_means2d[i] += v_mean
        totals.v_means2d_abs[i] += np.abs(v_mean)
        totals.v_conics[i] += v_conic
        behind = a * q + (1 - a) * behind
""",
    ),
    "dominance by argmax and bincount": (
        "compositing",
        """
def dominant_id(ids, weights):
    if len(ids) == 0 or max(weights) <= 0:
        return -1
    return ids[int(np.argmax(weights))]

def dominant_counts(dominant_ids, n):
    won = dominant_ids[dominant_ids >= 0]
    return np.bincount(won, minlength=n)[:n]
""",
    ),
    "losses over the kept pixels": (
        "losses",
        """
def _kept(image, mask):
    return np.ones(image.shape[:2], dtype=bool) if mask is None else mask

def l1(image, target, mask=None):
    if image.shape != target.shape:
        raise ValueError("shapes")
    keep = _kept(image, mask)
    return float(np.mean(np.abs(image - target)[keep])) if keep.any() else 0.0

def l2(image, target, mask=None):
    if image.shape != target.shape:
        raise ValueError("shapes")
    keep = _kept(image, mask)
    return float(np.mean((image - target)[keep] ** 2)) if keep.any() else 0.0
""",
    ),
    "the vjps of losses with where": (
        "losses",
        """
def l1_vjp(image, target, v_l1, mask=None):
    keep = np.ones(image.shape[:2], dtype=bool) if mask is None else mask
    n = max(keep.sum() * image.shape[2], 1)
    return np.where(keep[:, :, None], v_l1 * np.sign(image - target) / n, 0.0)

def l2_vjp(image, target, v_l2, mask=None):
    keep = np.ones(image.shape[:2], dtype=bool) if mask is None else mask
    n = max(keep.sum() * image.shape[2], 1)
    return np.where(keep[:, :, None], 2 * v_l2 * (image - target) / n, 0.0)
""",
    ),
    "the prior with where": (
        "losses",
        """
def importance_mask(counts):
    return counts >= 1

def pop_loss(opacities, mask, visible=None):
    some = np.ones(len(mask), dtype=bool) if visible is None else visible
    a, b = opacities[mask & some], opacities[~mask & some]
    return float((np.mean(1 - a) if len(a) else 0.0) + (np.mean(b) if len(b) else 0.0))

def pop_loss_vjp(opacities, mask, v_loss, visible=None):
    some = np.ones(len(mask), dtype=bool) if visible is None else visible
    n, rest = max((mask & some).sum(), 1), max((~mask & some).sum(), 1)
    return np.where(some, np.where(mask, -v_loss / n, v_loss / rest), 0.0)
""",
    ),
    "Adam as the paper of Kingma and Ba has it": (
        "optimizer",
        """
def adam_step(params, grads, m, v, step, lr, betas=(0.9, 0.999), eps=1e-15):
    count = {k: step for k in grads} if isinstance(step, int) else step
    if any(t < 1 for t in [*count.values(), *([step] if isinstance(step, int) else [])]):
        raise ValueError("steps count from 1")
    p2, m2, v2 = dict(params), dict(m), dict(v)
    for k, g in grads.items():
        t = count[k]
        m2[k] = betas[0] * m[k] + (1 - betas[0]) * g
        v2[k] = betas[1] * v[k] + (1 - betas[1]) * g**2
        m_hat, v_hat = m2[k] / (1 - betas[0] ** t), v2[k] / (1 - betas[1] ** t)
        p2[k] = params[k] - lr[k] * m_hat / (np.sqrt(v_hat) + eps)
    return p2, m2, v2
""",
    ),
    "rows by np.delete and np.append": (
        "density",
        """
def prune_rows(rows, mask):
    gone = np.flatnonzero(mask)
    kinds = (rows.params, rows.m, rows.v)
    return Rows(*({name: np.delete(x, gone, axis=0) for name, x in kind.items()} for kind in kinds))

def clone_rows(rows, mask):
    params = {name: np.append(x, x[mask], axis=0) for name, x in rows.params.items()}
    zero = {name: 0 * x[mask] for name, x in rows.params.items()}
    m, v = ({name: np.append(x, zero[name], axis=0) for name, x in kind.items()} for kind in (rows.m, rows.v))
    return Rows(params, m, v)
""",
    ),
    "the masks of chapter 9, with nothing of other methods": (
        "density",
        """
def grow_masks(statistics, scales, scene_scale, step, config=POP):
    average = statistics.grad_sum / np.maximum(statistics.n_visible, 1)
    chosen = average > config.grow_grad2d
    if config.blur_start_iter <= step <= config.blur_stop_iter:
        chosen = chosen | statistics.blurred
    small = scales.max(axis=1) <= config.grow_scale3d * scene_scale
    return chosen & small, chosen & ~small

def prune_mask(opacities, scales, scene_scale, step, config=POP):
    return opacities < config.prune_opa
""",
    ),
    "a split on whole arrays": (
        "density",
        """
def split_rows(rows, mask, normals, revised_opacity=False):
    if normals.shape != (2, int(mask.sum()), 3):
        raise ValueError("two draws a row")
    R = rotmats_from_quats(rows.params["quats"][mask])
    s = np.exp(rows.params["scales"][mask])
    new = {name: np.concatenate([x[mask], x[mask]]) for name, x in rows.params.items()}
    for k in range(2):
        part = slice(k * len(s), (k + 1) * len(s))
        new["means"][part] += np.einsum("nij,nj->ni", R, s * normals[k])
    new["scales"] = new["scales"] - np.log(1.6)
    add = lambda old, extra: {name: np.concatenate([x[~mask], extra[name]]) for name, x in old.items()}
    zero = {name: np.zeros_like(x) for name, x in new.items()}
    return Rows(add(rows.params, new), add(rows.m, zero), add(rows.v, zero))
""",
    ),
    "the loop in a dozen lines": (
        "loop",
        """
def train_step(state, camera, target, scene_scale, normals, recipe=RECIPES["POP"]):
    rows, step = state.rows, state.step
    gaussians = gaussians_from_params(rows.params)
    view = render(gaussians, camera)
    loss, v_image, v_opacities = objective(view, gaussians, target, state, recipe)
    gradients = render_vjp(gaussians, camera, v_image)
    grads = params_vjp(rows.params, gradients, v_opacities)
    rates = learning_rates(step, scene_scale, recipe.max_steps, recipe.lr)
    rows = Rows(*adam_step(rows.params, grads, rows.m, rows.v, step + 1, rates))
    seen = gradients.means2d, view.splats.visible, view.dominant_counts, camera.width, camera.height
    statistics = accumulate(state.statistics, *seen, recipe.density)
    rows, statistics = control(rows, statistics, scene_scale, step, normals, recipe.density)
    return Training(rows, statistics, step + 1), loss
""",
    ),
}
