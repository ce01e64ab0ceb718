"""A renderer as somebody would port it: written from what `index.json` says, with json and numpy alone, in float32.

It draws what it can (no square extents, harmonics to degree 1, no gradients) and judges itself by the index.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

Real = np.float32
Arrays = dict[str, np.ndarray]


def rotation(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def splat(a: Arrays, i: int, options: dict) -> tuple | None:
    """Project Gaussian i: (depth, centre, inverse covariance, opacity, colour), None behind the near plane."""
    profile, K = options["profile"], a["K"]
    R, t = a["viewmat"][:3, :3], a["viewmat"][:3, 3]
    x, y, z = p = R @ a["means"][i] + t
    if z < profile["near_plane"]:
        return None
    slopes = []
    for axis, size in ((0, options["width"]), (1, options["height"])):
        f, c, margin = K[axis, axis], K[axis, 2], profile["frustum_margin"] * size / 2
        slopes.append(np.clip(p[axis] / z, (-c - margin) / f, (size - c + margin) / f))
    J = np.array([[K[0, 0], 0, -K[0, 0] * slopes[0]], [0, K[1, 1], -K[1, 1] * slopes[1]]], Real) / z
    half = J @ R @ rotation(a["quats"][i]) * a["scales"][i]
    raw = half @ half.T
    blurred = raw + Real(profile["eps2d"]) * np.eye(2, dtype=Real)
    opacity = a["opacities"][i]
    if options["antialiased"]:
        opacity = opacity * np.sqrt(max(Real(0), np.linalg.det(raw) / np.linalg.det(blurred)))
    direction = a["means"][i] + R.T @ t
    dx, dy, dz = direction / np.linalg.norm(direction)
    basis = 0.4886025119029199 * np.array([-dy, dz, -dx])
    basis = np.array([0.28209479177387814, *basis], Real)[: (options["sh_degree"] + 1) ** 2]
    color = np.maximum(0, Real(0.5) + basis @ a["sh"][i, : len(basis)])
    center = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
    return z, center, np.linalg.inv(blurred), opacity, color, i


def draw(a: Arrays, options: dict, shift: float = 0.5) -> Arrays:
    """Render a vector; `shift` is where in a pixel its centre lies."""
    a = {name: value.astype(Real) if value.dtype == np.float64 else value for name, value in a.items()}
    profile, shape = options["profile"], (options["height"], options["width"])
    splats = [s for i in range(len(a["means"])) if (s := splat(a, i, options)) is not None]
    splats.sort(key=lambda s: (s[0], s[5]))
    image, left = np.zeros((*shape, 3), Real), np.ones(shape, Real)
    ids, counts = np.full(shape, -1), np.zeros(shape, np.int64)
    for y, x in np.ndindex(shape):
        T, best = Real(1), Real(0)
        for _, center, conic, opacity, color, i in splats:
            d = center - np.array([x + shift, y + shift], Real)
            sigma = d @ conic @ d / 2
            alpha = min(Real(profile["alpha_ceiling"]), opacity * np.exp(-sigma))
            if sigma < 0 or alpha < profile["alpha_floor"]:
                continue
            rest = T * (1 - alpha)
            if rest < profile["transmittance_stop"] or (
                profile["stop_inclusive"] and rest == profile["transmittance_stop"]
            ):
                break
            image[y, x] += T * alpha * color
            if T * alpha > best:
                best, ids[y, x] = T * alpha, i
            T, counts[y, x] = rest, counts[y, x] + 1
        image[y, x] += T * a["background"]
        left[y, x] = T
    return {"image": image, "T_final": left, "dominant_ids": ids, "n_blended": counts}


def within_reach(vector: dict) -> bool:
    options = vector["options"]
    return vector["kind"] == "render" and options["profile"]["extent"] == "opacity_aware" and options["sh_degree"] <= 1


def judge(index: dict, wanted: Arrays, name: str, result: np.ndarray) -> bool:
    """Compare one output as the index says."""
    (rule,) = index["kinds"]["render"]["arrays"][name]["compare"]
    mask = wanted[rule["where"]] if rule["where"] else np.array(True)
    mask = mask.reshape(mask.shape + (1,) * (result.ndim - mask.ndim))
    if rule["rule"] == "equal":
        good = result == wanted[name]
    else:
        limit = rule["limit"]["float32"] * wanted[rule["error_bound"]] + index["tiny"]["float32"]
        good = np.abs(result - wanted[name]) <= limit
    return bool(np.all(good | ~mask))


def run(vectors: Path, results: Path, shift: float = 0.5, as_json: bool = False) -> set[tuple[str, str]]:
    """Draw every vector within reach, write the results, and return which arrays of which vectors fail."""
    index = json.loads((vectors / "index.json").read_text())
    results.mkdir()
    failed = set()
    for name, vector in index["vectors"].items():
        if not within_reach(vector):
            continue
        with np.load(vectors / vector["file"]) as stored:
            wanted = {key: stored[key] for key in stored.files}
        inputs = {
            key: value for key, value in wanted.items() if index["kinds"]["render"]["arrays"][key]["role"] == "input"
        }
        drawn = draw(inputs, vector["options"], shift)
        if as_json:
            (results / f"{name}.json").write_text(json.dumps({key: value.tolist() for key, value in drawn.items()}))
        else:
            np.savez(results / f"{name}.npz", **drawn)  # type: ignore[arg-type]
        failed |= {(name, key) for key, value in drawn.items() if not judge(index, wanted, key, value)}
    return failed
