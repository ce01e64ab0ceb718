"""What the widgets compute is what the oracle computes: their pure functions, run by node, on vectors of the oracle."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pop_ref import alpha, camera, covariance, dominance, footprint, harmonics, losses, pixel, projection
from pop_ref.constants import PAPER
from pop_ref.density import (
    DensityConfig,
    Rows,
    accumulate,
    densify_and_prune,
    grow_masks,
    rows_from_params,
    zero_statistics,
)
from pop_ref.learn import splat
from pop_ref.optimizer import adam_step
from pop_ref.polarization import pop_loss_vjp
from pop_ref.records import Camera
from pop_ref.render import render, render_vjp
from pop_ref.training import gaussians_from_params, params_vjp
from pop_ref.walkthrough.widgets import mathematics

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="there is no node here to run JavaScript")

FILES = ("splats", "projection", "harmonics")
CALLS = """
const calls = JSON.parse(require("fs").readFileSync(0, "utf8"));
const functions = { %s };
console.log(JSON.stringify(calls.map(([name, parameters]) => functions[name](...parameters))));
"""
N = 200


def _run(name: str, parameters: list[list[Any]]) -> list[Any]:
    script = mathematics(*FILES) + CALLS % name
    calls = json.dumps([[name, each] for each in parameters])
    done = subprocess.run([NODE or "", "-e", script], input=calls, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def _flat(value: Any) -> np.ndarray:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return np.concatenate([_flat(each) for each in value]) if len(value) else np.zeros(0)
    return np.asarray(value, dtype=np.float64).ravel()


def _agree(name: str, drawn: list[list[Any]], truth: Callable[..., Any], relative: float = 1e-13) -> None:
    ours = [_flat(each) for each in _run(name, drawn)]
    theirs = [_flat(truth(*each)) for each in drawn]
    # no entry is nothing, and not all are equal: a function that returned a constant would be seen
    assert len({each.tobytes() for each in theirs}) > len(drawn) // 4
    for got, want in zip(ours, theirs, strict=True):
        assert np.allclose(got, want, rtol=relative, atol=relative * np.max(np.abs(want), initial=1e-300))


def _covars2d(rng: np.random.Generator) -> np.ndarray:
    M = rng.standard_normal((N, 2, 2)) * rng.uniform(0.1, 4, (N, 1, 2))
    covars2d = M @ M.swapaxes(1, 2)
    # some without an inverse
    covars2d[::25] = [[1.0, 2.0], [2.0, 1.0]]
    return covars2d


def test_one_splat_at_one_pixel() -> None:
    rng = np.random.default_rng(0)
    conics = footprint.conics_from_covars2d(_covars2d(rng)).tolist()
    means2d = rng.uniform(0, 6, (N, 2)).tolist()
    pixels = (rng.integers(0, 6, (N, 2)) + 0.5).tolist()
    at = [[mean, conic, *p] for mean, conic, p in zip(means2d, conics, pixels, strict=True)]
    _agree("sigma_at_pixel", at, alpha.sigma_at_pixel)
    _agree(
        "sigma_at_pixel_vjp",
        [[*each, g] for each, g in zip(at, rng.standard_normal(N).tolist(), strict=True)],
        alpha.sigma_at_pixel_vjp,
    )
    sigmas = [[float(x)] for x in rng.uniform(0, 8, N)]
    _agree("falloff", sigmas, alpha.falloff)
    _agree("falloff_vjp", [[*each, 2.0] for each in sigmas], alpha.falloff_vjp)
    # from negative exponents to splats over the ceiling and under the floor
    both = [
        [float(s), float(o)]
        for s, o in zip(rng.uniform(-0.2, 6, N), rng.choice([0.003, 0.5, 0.9995, 1.0], N), strict=True)
    ]
    both += [[0.0, 1.0], [0.0, PAPER.alpha_ceiling], [0.0, PAPER.alpha_floor]]
    _agree("alpha_from_sigma", both, alpha.alpha_from_sigma)
    _agree("alpha_from_sigma_vjp", [[*each, 1.5] for each in both], alpha.alpha_from_sigma_vjp)


def test_the_splat_on_the_screen() -> None:
    rng = np.random.default_rng(1)
    covars2d = _covars2d(rng).tolist()
    blurred = [[each, float(eps)] for each, eps in zip(covars2d, rng.uniform(0.05, 2, N), strict=True)]

    def one(function: Callable[..., np.ndarray]) -> Callable[..., Any]:
        return lambda covar2d, *rest: function(np.array([covar2d]), *rest)[0].tolist()

    _agree("low_pass", blurred, one(footprint.low_pass))
    _agree("compensations", blurred, one(footprint.compensations), 1e-12)
    _agree("conics_from_covars2d", [[each] for each in covars2d], one(footprint.conics_from_covars2d))
    opacities = rng.choice([0.0, 1 / 256, PAPER.alpha_floor, 0.02, 0.3, 0.99, 1.0], N)
    told = [[covar2d, float(o)] for covar2d, o in zip(covars2d, opacities, strict=True)]
    _agree(
        "radii_from_covars2d",
        told,
        lambda covar2d, o: footprint.radii_from_covars2d(np.array([covar2d]), np.array([o]))[0].tolist(),
        0.0,
    )


def _pixels(rng: np.random.Generator) -> list[list[Any]]:
    drawn = []
    for _ in range(N):
        n = int(rng.integers(0, 7))
        rows = {
            "means2d": rng.uniform(0, 1, (n, 2)).tolist(),
            "conics": [[1.0, 0.25, 0.5]] * n,
            "opacities": rng.choice([0.002, 0.2, 0.7, 0.9995, 1.0], n).tolist(),
            "colors": rng.uniform(0, 1, (n, 3)).tolist(),
        }
        drawn.append([rng.permutation(n).tolist(), rows, 0.5, 0.5, rng.uniform(0, 1, 3).tolist()])
    return drawn


def _rows(rows: dict[str, Any]) -> pixel.SplatRows:
    return pixel.SplatRows(rows["means2d"], rows["conics"], rows["opacities"], rows["colors"])


def test_one_pixel_and_the_way_back() -> None:
    rng = np.random.default_rng(2)
    drawn = _pixels(rng)

    def forward(ids: list[int], rows: dict[str, Any], px: float, py: float, background: list[float]) -> list[Any]:
        p = pixel.composite_pixel(ids, _rows(rows), px, py, background)
        return [p.color, p.T_final, p.ids, p.alphas, p.transmittances, p.weights, p.n_traversed]

    _agree("composite_pixel", drawn, forward)
    found = [pixel.composite_pixel(each[0], _rows(each[1]), *each[2:]) for each in drawn]
    assert {len(p.ids) < p.n_traversed for p in found} == {True, False}
    # the light of an opaque wall is what rounding left of 1 - alpha
    assert min(p.T_final for p in found) < 2e-3
    back = [
        [
            {**p._asdict(), "weights": p.weights},
            *each[1:],
            rng.standard_normal(3).tolist(),
            float(rng.standard_normal()),
        ]
        for p, each in zip(found, drawn, strict=True)
    ]

    def backward(p: dict[str, Any], rows: dict[str, Any], *rest: Any) -> list[Any]:
        kept = pixel.Pixel(*(p[name] for name in pixel.Pixel._fields))
        totals = pixel.zero_gradients(len(rows["opacities"]), 3)
        pixel.composite_pixel_vjp(kept, _rows(rows), *rest, totals)
        return [totals.v_opacities, totals.v_colors, totals.v_background]

    ours = _run("composite_pixel_vjp", back)
    for got, each in zip(ours, back, strict=True):
        want = _flat(backward(*each))
        assert np.allclose(
            _flat([got["v_opacities"], got["v_colors"], got["v_background"]]), want, rtol=1e-12, atol=1e-14
        )
        # alpha is the opacity times the falloff, so the two gradients differ by that factor where nothing is clamped
        rows = each[1]
        for i in each[0]["ids"]:
            sigma = alpha.sigma_at_pixel(rows["means2d"][i], rows["conics"][i], 0.5, 0.5)
            if rows["opacities"][i] * alpha.falloff(sigma) <= PAPER.alpha_ceiling:
                assert np.isclose(
                    got["v_opacities"][i], got["v_alphas"][i] * alpha.falloff(sigma), rtol=1e-12, atol=1e-15
                )


def test_the_stop_and_the_winner() -> None:
    edges = [[x] for x in (1e-4, np.nextafter(1e-4, 1), np.nextafter(1e-4, 0), 1.0, 0.0)]
    assert _run("stops", edges) == [pixel.stops(*each) for each in edges]
    rng = np.random.default_rng(3)
    drawn = [[list(range(4, 9)), (rng.integers(0, 4, 5) / 4).tolist()] for _ in range(N)] + [[[], []]]
    _agree("dominant_id", [*drawn[:8], *drawn[-1:]], dominance.dominant_id, 0.0)
    assert _run("dominant_id", drawn) == [dominance.dominant_id(*each) for each in drawn]


def test_from_the_world_to_the_screen() -> None:
    rng = np.random.default_rng(4)
    quats, scales = rng.standard_normal((N, 4)), rng.uniform(0, 2, (N, 3))
    covars = covariance.covars_from_quats_scales(quats, scales)
    viewmat = np.eye(4)
    viewmat[:3, :3] = covariance.rotmats_from_quats(rng.standard_normal((1, 4)))[0]
    viewmat[:3, 3] = rng.standard_normal(3)
    K = np.array([[270.0, 0.0, 160.0], [0.0, 260.0, 120.0], [0.0, 0.0, 1.0]])
    # some far outside the image, where the Jacobian is taken at the frustum's border
    means_cam = np.concatenate([rng.uniform(-6, 6, (N, 2)), rng.uniform(0.5, 9, (N, 1))], axis=1)
    jacobians = projection.projection_jacobians(means_cam, K, 320, 240)
    clamped = np.abs(jacobians[:, 0, 2] + 270 * means_cam[:, 0] / means_cam[:, 2] ** 2) > 1e-6
    assert 0.1 < clamped.mean() < 0.9

    def one(function: Callable[..., np.ndarray], *fixed: Any) -> Callable[..., Any]:
        return lambda *given: function(*(np.array([each]) for each in given[: len(given) - len(fixed)]), *fixed)[0]

    def rows(*columns: np.ndarray, fixed: tuple[Any, ...] = ()) -> list[list[Any]]:
        return [[*(column[i].tolist() for column in columns), *fixed] for i in range(N)]

    _agree("rotmats_from_quats", rows(quats), one(covariance.rotmats_from_quats))
    _agree("covars_from_quats_scales", rows(quats, scales), one(covariance.covars_from_quats_scales))
    view = (viewmat.tolist(),)
    _agree("means_cam_from_means", rows(means_cam, fixed=view), one(camera.means_cam_from_means, viewmat))
    _agree("covars_cam_from_covars", rows(covars, fixed=view), one(camera.covars_cam_from_covars, viewmat))
    pinhole = (K.tolist(), 320, 240)
    _agree("project_means", rows(means_cam, fixed=pinhole), one(projection.project_means, K, 320, 240))
    _agree("projection_jacobians", rows(means_cam, fixed=pinhole), one(projection.projection_jacobians, K, 320, 240))
    _agree("project_covars", rows(covars, jacobians), one(projection.project_covars), 1e-12)


def test_harmonics_and_their_colours() -> None:
    rng = np.random.default_rng(5)
    dirs = rng.standard_normal((N, 3))
    units = dirs / np.linalg.norm(dirs, axis=1, keepdims=True)
    for degree in range(4):
        drawn = [[each, degree] for each in units.tolist()]
        # the first harmonic is the same everywhere, so it is not asked to differ
        ours = np.array(_run("sh_basis", drawn))
        assert np.allclose(ours, harmonics.sh_basis(units, degree), rtol=1e-13, atol=1e-15)
    sh = rng.standard_normal((N, 16, 3))
    drawn = [[sh[i].tolist(), dirs[i].tolist(), 3] for i in range(N)]
    _agree(
        "colors_from_sh",
        drawn,
        lambda c, d, degree: harmonics.colors_from_sh(np.array([c]), np.array([d]), degree)[0],
        1e-12,
    )


def _toy(seed: int, n: int, size: int) -> tuple[dict[str, np.ndarray], Camera]:
    """Draw a scene with needles and discs, splats past the picture, behind the camera, under the floor, too opaque."""
    rng = np.random.default_rng(seed)
    params = {
        "means": rng.uniform(-1.6, 1.6, (n, 3)),
        "quats": rng.standard_normal((n, 4)),
        "scales": rng.uniform(-4.0, 0.3, (n, 3)),
        "opacities": rng.uniform(-7.0, 9.0, n),
        "sh0": rng.uniform(-2.5, 2.5, (n, 1, 3)),
    }
    camera = splat.orbit(0.7 * seed, size)
    camera[0][:3, 3] *= 0.45
    return params, Camera(*camera)


def _told(camera: Camera) -> dict[str, Any]:
    R, t = camera.viewmat[:3, :3].ravel().tolist(), camera.viewmat[:3, 3].tolist()
    f, c = camera.K[[0, 1], [0, 1]].tolist(), camera.K[:2, 2].tolist()
    return {"R": R, "t": t, "f": f, "c": c, "size": [camera.width, camera.height]}


def _ran(body: str, **given: Any) -> Any:
    """Run JavaScript on values; arrays come as flat Float64Arrays and go as lists."""
    script = f"""{mathematics("training")}
    const typed = (x) => Object.fromEntries(Object.entries(x).map(([name, y]) => [name, Float64Array.from(y)]));
    const given = JSON.parse(require("fs").readFileSync(0, "utf8"));
    const result = (() => {{ {body} }})();
    console.log(JSON.stringify(result, (_, x) => (ArrayBuffer.isView(x) ? Array.from(x) : x)));"""
    flat = {name: value.ravel().tolist() if isinstance(value, np.ndarray) else value for name, value in given.items()}
    done = subprocess.run([NODE or "", "-e", script], input=json.dumps(flat), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def _lists(params: dict[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: x.ravel().tolist() for name, x in params.items()}


def _close(found: Any, value: np.ndarray, relative: float, name: str = "") -> None:
    assert np.any(value != 0.0), name
    worst = np.max(np.abs(np.reshape(found, value.shape) - value))
    assert worst <= relative * np.max(np.abs(value)), (name, worst)


@pytest.mark.parametrize("seed", range(4))
def test_the_page_that_trains_draws_and_differentiates_as_the_oracle_does(seed: int) -> None:
    (params, camera), background = _toy(seed, 60, 24), np.array([0.25, 0.5, 1.0])
    gaussians = gaussians_from_params(params)
    v_image = np.random.default_rng(seed).standard_normal((24, 24, 3))
    expected = render(gaussians, camera, background)
    gradients = render_vjp(gaussians, camera, v_image, background=background)
    told = _ran(
        """const params = typed(given.params), drawn = render(params, given.camera, given.background);
        const { image, T_final, dominant_counts } = drawn;
        return { image, T_final, dominant_counts, ...render_vjp(params, drawn, given.v_image) };""",
        params=_lists(params),
        camera=_told(camera),
        background=background,
        v_image=v_image,
    )
    assert 5 < int(np.sum(expected.splats.visible)) < len(gaussians)
    assert float(np.min(expected.T_final)) < 1e-3
    _close(told["image"], expected.image, 1e-12)
    _close(told["T_final"], expected.T_final, 1e-12)
    assert told["dominant_counts"] == expected.dominant_counts.tolist()
    _close(told["v_means2d"], gradients.means2d, 1e-9)
    for name, value in params_vjp(params, gradients, np.zeros(len(gaussians))).items():
        _close(told["grads"][name], value, 1e-9, name)


RATES = {"means": 4e-3, "quats": 1e-2, "scales": 1.5e-2, "opacities": 5e-2, "sh0": 2e-2}
TRAINING = {"steps": 12, "lambda_pop": 0.05, "theta_blur": 0.02, "densify_every": 5, "densify_until": 10}


def _oracles_training(
    params: dict[str, np.ndarray],
    cameras: list[Camera],
    photographs: list[np.ndarray],
    config: DensityConfig,
    draw: Callable[[int], np.ndarray],
) -> Rows:
    """Take the steps that `TRAINING` names with the oracle's functions; no rule of density control stays idle."""
    rows, window, n_steps = rows_from_params(params), zero_statistics(len(params["means"])), TRAINING["steps"]
    happened = dict.fromkeys(("clone", "split", "blur", "prune"), 0)
    for step in range(1, round(n_steps) + 1):
        camera, gaussians = cameras[step % 3], gaussians_from_params(rows.params)
        drawn = render(gaussians, camera, np.zeros(3))
        v_image = losses.l2_vjp(drawn.image, photographs[step % 3], 1.0)
        gradients = render_vjp(gaussians, camera, v_image, background=np.zeros(3))
        v_prior = pop_loss_vjp(gaussians.opacities, drawn.dominant_counts > 0, TRAINING["lambda_pop"])
        now = {name: rate * 0.1 ** (step / n_steps) for name, rate in RATES.items()}
        grads = params_vjp(rows.params, gradients, v_prior)
        rows = Rows(*adam_step(rows.params, grads, rows.m, rows.v, step, now))
        size = (camera.width, camera.height)
        window = accumulate(window, gradients.means2d, drawn.splats.visible, drawn.dominant_counts, *size, config)
        if step % TRAINING["densify_every"] == 0 and step <= TRAINING["densify_until"]:
            masks = grow_masks(window, np.exp(rows.params["scales"]), 3.0, step, config)
            n_grown = len(rows) + int(np.sum(masks))
            happened["clone"] += int(np.sum(masks[0]))
            happened["split"] += int(np.sum(masks[1]))
            happened["blur"] += int(np.sum(window.blurred))
            rows, window = densify_and_prune(rows, window, 3.0, step, draw, config)
            happened["prune"] += n_grown - len(rows)
    assert min(happened.values()) > 0, happened
    return rows


def test_a_training_in_the_page_takes_the_oracles_steps() -> None:
    """Twelve steps, two of them densification steps, with every Gaussian's parameters and both moments compared."""
    params, _ = _toy(1, 40, 20)
    rng = np.random.default_rng(8)
    params["scales"] = rng.uniform(-4.2, -1.5, params["scales"].shape)
    params["opacities"] = rng.uniform(-5.6, 2.0, 40)
    cameras = [Camera(*splat.orbit(angle, 20)) for angle in (0.0, 1.0, 2.5)]
    photographs = [splat.photograph((c.viewmat, c.K, 20, 20)) for c in cameras]
    config = DensityConfig(
        theta_blur=TRAINING["theta_blur"], refine_every=1, refine_start_iter=0, blur_start_iter=0, blur_stop_iter=99
    )
    normals, at = rng.standard_normal(3000), 0

    def draw(n: int) -> np.ndarray:
        nonlocal at
        at += 6 * n
        return normals[at - 6 * n : at].reshape(2, n, 3)

    rows = _oracles_training(params, cameras, photographs, config, draw)
    told = _ran(
        """let at = 0;
        const state = new_training(typed(given.params));
        const normals = (n) => { at += n; return given.normals.slice(at - n, at); };
        for (let step = 1; step <= given.settings.steps; step += 1) {
            const view = step % given.cameras.length;
            training_step(state, given.cameras[view], given.photographs[view], given.settings, normals);
        }
        return { ...state, used: at };""",
        params=_lists(params),
        cameras=[_told(c) for c in cameras],
        photographs=[p.ravel().tolist() for p in photographs],
        normals=normals,
        settings={**TRAINING, "rates": RATES, "grow_grad2d": config.grow_grad2d, "prune_opa": config.prune_opa},
    )
    assert told["used"] == at
    for of, expected in (("params", rows.params), ("m", rows.m), ("v", rows.v)):
        for name, value in expected.items():
            _close(told[of][name], value, 1e-7, f"{of} {name}")
