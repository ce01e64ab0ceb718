"""What the widgets compute and say is what the oracle computes; node runs their code.

Their pure functions run on vectors of the oracle, and their own scripts on as much of a page as they need, at the
values that their prompts suggest.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
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
from pop_ref.pixel import SplatRows, composite_pixel, composite_pixel_vjp, zero_gradients
from pop_ref.polarization import pop_loss_vjp
from pop_ref.records import Camera
from pop_ref.render import render, render_vjp
from pop_ref.training import gaussians_from_params, params_vjp
from pop_ref.walkthrough.widgets import FOLDER, WIDGETS, html, mathematics
from tests.walkthrough.test_splat import toy

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="there is no node here to run JavaScript")

CALLS = """
const calls = JSON.parse(require("fs").readFileSync(0, "utf8"));
const functions = { %s };
console.log(JSON.stringify(calls.map(([name, parameters]) => functions[name](...parameters))));
"""
N = 200


def _run(name: str, parameters: list[list[Any]]) -> list[Any]:
    script = mathematics("splats") + CALLS % name
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


def _one(function: Callable[..., np.ndarray], *fixed: Any) -> Callable[..., Any]:
    """Let a function of N rows take one, whose last arguments are these whatever it is given."""
    return lambda *given: function(*(np.array([each]) for each in given[: len(given) - len(fixed)]), *fixed)[0]


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

    _agree("low_pass", blurred, lambda covar2d, eps: footprint.low_pass(np.array([covar2d]), eps)[0])
    _agree("compensations", blurred, lambda covar2d, eps: footprint.compensations(np.array([covar2d]), eps)[0], 1e-12)
    _agree("conics_from_covars2d", [[each] for each in covars2d], _one(footprint.conics_from_covars2d))
    opacities = rng.choice([0.0, 1 / 256, PAPER.alpha_floor, 0.02, 0.3, 0.99, 1.0], N)
    told = [[covar2d, float(o)] for covar2d, o in zip(covars2d, opacities, strict=True)]
    _agree("radii_from_covars2d", told, _one(footprint.radii_from_covars2d), 0.0)


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


def test_one_pixel_and_the_way_back() -> None:
    rng = np.random.default_rng(2)
    drawn = _pixels(rng)

    def forward(ids: list[int], rows: dict[str, Any], px: float, py: float, background: list[float]) -> list[Any]:
        p = pixel.composite_pixel(ids, pixel.SplatRows(**rows), px, py, background)
        return [p.color, p.T_final, p.ids, p.alphas, p.transmittances, p.weights, p.n_traversed]

    _agree("composite_pixel", drawn, forward)
    found = [pixel.composite_pixel(each[0], pixel.SplatRows(**each[1]), *each[2:]) for each in drawn]
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
        pixel.composite_pixel_vjp(kept, pixel.SplatRows(**rows), *rest, totals)
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

    def rows(*columns: np.ndarray, fixed: tuple[Any, ...] = ()) -> list[list[Any]]:
        return [[*(column[i].tolist() for column in columns), *fixed] for i in range(N)]

    _agree("rotmats_from_quats", rows(quats), _one(covariance.rotmats_from_quats))
    _agree("covars_from_quats_scales", rows(quats, scales), _one(covariance.covars_from_quats_scales))
    view = (viewmat.tolist(),)
    _agree("means_cam_from_means", rows(means_cam, fixed=view), _one(camera.means_cam_from_means, viewmat))
    _agree("covars_cam_from_covars", rows(covars, fixed=view), _one(camera.covars_cam_from_covars, viewmat))
    pinhole = (K.tolist(), 320, 240)
    _agree("project_means", rows(means_cam, fixed=pinhole), _one(projection.project_means, K, 320, 240))
    _agree("projection_jacobians", rows(means_cam, fixed=pinhole), _one(projection.projection_jacobians, K, 320, 240))
    _agree("project_covars", rows(covars, jacobians), _one(projection.project_covars), 1e-12)


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
    _agree("colors_from_sh", drawn, _one(harmonics.colors_from_sh, 3), 1e-12)


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
    (params, camera), background = toy(seed, 60, 24), np.array([0.25, 0.5, 1.0])
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
    params, _ = toy(1, 40, 20)
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


PAGE = Path(__file__).with_name("page_without_browser.js")


def _shown(widget: str, *doings: tuple[str, str, Any]) -> Any:
    """Do things to a widget's sliders, buttons and keys; return what it then shows."""
    script = html(widget).partition("<script>")[2].partition("</script>")[0]
    given = json.dumps({"script": script, "doings": doings})
    done = subprocess.run([NODE or "", str(PAGE)], input=given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def _numbers(text: str) -> list[float]:
    kept = "".join(letter if letter in "0123456789.-−e" else " " for letter in text).replace("−", "-")
    return [float(each) for each in kept.split() if any(digit.isdigit() for digit in each)]


def _covar2d(long: float, short: float, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.array([[c, -s], [s, c]])
    return (R @ np.diag([long**2, short**2]) @ R.T)[None]


AS_IT_OPENS = (0.8, 3.4, 1.5)


@pytest.mark.parametrize(("opacity", "long", "short"), [AS_IT_OPENS, (0.02, 3.4, 1.5), (0.8, 0.1, 0.1)])
def test_a_splat_tells_its_edge_its_extent_and_what_blur_does_to_its_paint(
    opacity: float, long: float, short: float
) -> None:
    assert "opacity down to 0.02" in WIDGETS["splat2d"].prompt
    sliders = ("opacity", "first standard deviation", "second standard deviation")
    wanted = (opacity, long, short)
    doings = [] if wanted == AS_IT_OPENS else [("slide", *each) for each in zip(sliders, wanted, strict=True)]
    page, eps2d = _shown("splat2d", *doings), 0.3
    shown = page["readings"]
    covar2d = _covar2d(long, short, 23)
    blurred = footprint.low_pass(covar2d, eps2d)
    k = np.sqrt(2.0 * np.log(255.0 * opacity))
    assert shown["edge (1/255)"] == f"at {k:.2f} deviations"
    radii = footprint.radii_from_covars2d(blurred, np.array([opacity]))[0]
    assert shown["extent"] == f"{2 * radii[0]} × {2 * radii[1]} px"
    # paint is the integral of alpha: 2 pi o sqrt(det), so a splat of 0.1 px has 31 times as much of it after the blur
    paint = np.sqrt(np.linalg.det(blurred[0]) / np.linalg.det(covar2d[0]))
    assert shown["paint after blur, 1/ρ"] == f"× {paint:.2f}"
    assert shown["ρ, antialiased mode only"] == f"{footprint.compensations(covar2d, eps2d)[0]:.3f}"
    assert (paint > 30.0) == (long == 0.1)
    conic = footprint.conics_from_covars2d(blurred)[0].tolist()
    sigma = 0.5 * np.array([-5.4, -3.1]) @ np.linalg.inv(blurred[0]) @ [-5.4, -3.1]
    assert shown["its exponent σ"] == f"{sigma:.3f}"
    value, skipped = alpha.alpha_from_sigma(sigma, opacity)
    assert shown["its alpha"].endswith(", skipped") == skipped
    assert skipped or shown["its alpha"] == f"{value:.4f}"
    rows = SplatRows([[12.1, 7.4]], [conic], [opacity], [[1.0]])
    lit = sum(len(composite_pixel([0], rows, x + 0.5, y + 0.5, [0.0]).ids) for x in range(24) for y in range(16))
    assert shown["pixels drawn"] == f"{lit} of 384"
    # the canvas leaves the rest of them clear
    canvas = page["canvases"][0]
    assert np.count_nonzero(canvas["data"][3::4]) == lit


def _orbit_truth(distance: float, sideways: float) -> tuple[np.ndarray, np.ndarray]:
    """Project the widget's Gaussian and very many of its points; return the ellipse's half-axes, the points' sides."""
    (ca, sa), (ce, se) = ((np.cos(a), np.sin(a)) for a in (0.6, 0.35))
    viewmat = np.array(
        [[ca, 0, -sa, sideways * distance], [-sa * se, ce, -ca * se, 0], [sa * ce, se, ca * ce, distance], [0, 0, 0, 1]]
    )
    K = np.array([[270.0, 0, 160], [0, 270, 120], [0, 0, 1]])
    covars = covariance.covars_from_quats_scales(np.array([[0.85, 0.3, 0.1, 0.45]]), np.array([[0.9, 0.35, 0.2]]))
    covars_cam = camera.covars_cam_from_covars(covars, viewmat)
    mean_cam = camera.means_cam_from_means(np.zeros((1, 3)), viewmat)
    covar2d = projection.project_covars(covars_cam, projection.projection_jacobians(mean_cam, K, 320, 240))[0]
    points = np.random.default_rng(3).multivariate_normal(mean_cam[0], covars_cam[0], 100_000)
    cloud = projection.project_means(points[points[:, 2] > PAPER.near_plane], K, 320, 240)
    lambdas, directions = np.linalg.eigh(covar2d)
    along = (cloud - projection.project_means(mean_cam, K, 320, 240)[0]) @ directions[:, ::-1]
    return np.sqrt(lambdas[::-1]), np.quantile(along, [0.16, 0.84], axis=0).T


@pytest.mark.parametrize(("distance", "sideways"), [(2.0, 0.0), (4.0, 0.0), (3.0, 0.8)])
def test_the_ellipse_is_as_wide_as_the_points_and_its_sides_are_not_theirs(distance: float, sideways: float) -> None:
    assert "as near as 2 world units" in WIDGETS["orbit"].prompt
    shown = _shown("orbit", ("slide", "distance", distance), ("slide", "sideways, x/z", sideways))
    ewa, ends = _orbit_truth(distance, sideways)
    assert np.allclose(_numbers(shown["readings"]["by EWA"]), ewa, atol=0.06)
    # 1,600 points: their quantiles are good to some percent
    half = (ends[:, 1] - ends[:, 0]) / 2
    assert np.allclose(_numbers(shown["readings"]["of the points"]), half, rtol=0.05)
    told = _numbers(shown["readings"]["to the long axis’ two sides"])
    assert np.allclose(sorted(told), sorted(np.abs(ends[0])), rtol=0.07)
    if distance == 2.0:
        # the answer to the prompt: as wide to a tenth, and far from symmetric
        assert np.all(half / ewa < 1.1)
        assert max(told) / min(told) > 1.5
    assert (shown["readings"]["frustum clamp (B1)"] == "active") == (abs(sideways) * 270 > 160 * 1.3)


def test_the_globe_shows_what_the_cameras_around_it_see() -> None:
    base = np.zeros((1, 16, 3))
    towards = np.array([[-0.35, 0.45, np.sqrt(1 - 0.35**2 - 0.45**2)]])
    fading = np.repeat([1.1, 0.95, 0.7, 0.4], [1, 3, 5, 7])
    base[0] = (fading * harmonics.sh_basis(towards, 3)[0])[:, None] - np.where(np.arange(16) == 0, 0.9, 0.0)[:, None]
    base[0, 0] += [-0.5, 0.1, 1.0]
    shown = _shown("harmonics")
    # the camera in front looks along +z
    assert shown["readings"]["direction d, camera to Gaussian"] == "(0.00, 0.00, 1.00)"
    front = harmonics.colors_from_sh(base, np.array([[0.0, 0.0, 1.0]]), 3)[0]
    assert np.allclose(_numbers(shown["readings"]["colour that it sees, c(d)"]), front, atol=0.006)
    globe = next(each for each in shown["canvases"] if each["width"] == 220)
    pixels = np.reshape(globe["data"], (220, 220, 4)) / 255.0
    for right, down in ((0.0, 0.0), (0.6, 0.0), (0.0, -0.7), (-0.5, 0.4)):
        # a camera to the right of the Gaussian looks to the left
        inwards = np.array([[-right, -down, np.sqrt(1 - right**2 - down**2)]])
        at = pixels[round(110 + 107 * down - 0.5), round(110 + 107 * right - 0.5), :3]
        assert np.allclose(at, np.minimum(harmonics.colors_from_sh(base, inwards, 3)[0], 1.0), atol=0.03), (right, down)
    turned = _shown(
        "harmonics",
        ("key", "globe of the cameras around a Gaussian; drag or use the arrow keys to turn it", "ArrowRight"),
    )
    d = _numbers(turned["readings"]["direction d, camera to Gaussian"])
    # another side came to the front: the camera moved, and looks back at the middle
    assert abs(d[0]) > 0.1
    assert np.isclose(np.linalg.norm(d), 1.0, atol=0.01)


def test_even_harmonics_are_the_same_from_opposite_sides() -> None:
    at = np.random.default_rng(0).standard_normal((20, 3))
    at /= np.linalg.norm(at, axis=1, keepdims=True)
    sign = np.repeat([1.0, -1.0, 1.0, -1.0], [1, 3, 5, 7])
    assert "(even)" in WIDGETS["harmonics"].prompt
    assert np.allclose(harmonics.sh_basis(-at, 3), sign * harmonics.sh_basis(at, 3))


@pytest.mark.parametrize("shifts", [0, 1, 2])
def test_a_stack_tells_weights_and_gradients_with_a_wall_in_the_middle_and_in_front(shifts: int) -> None:
    assert "wall in the middle" in WIDGETS["stack"].prompt
    doings = [("press", "wall in the middle", None)] + [("press", "bring green nearer", None)] * shifts
    shown = _shown("stack", *doings)
    colors = [[0.85, 0.27, 0.2], [0.95, 0.72, 0.2], [0.24, 0.62, 0.38], [0.2, 0.47, 0.85], [0.55, 0.33, 0.75]]
    rows = SplatRows([[0.5, 0.5]] * 5, [[1.0, 0.0, 1.0]] * 5, [0.15, 0.15, 1.0, 0.6, 0.6], colors)
    order = [0, 1, 2, 3, 4]
    order.insert(2 - shifts, order.pop(2))
    background = [0.93, 0.92, 0.9]
    pixel = composite_pixel(order, rows, 0.5, 0.5, background)
    totals = zero_gradients(5, 3)
    # half the squared distance from white
    v_color = [c - 1.0 for c in pixel.color]
    composite_pixel_vjp(pixel, rows, 0.5, 0.5, background, v_color, 0.0, totals)
    for i, (T, weight, slope) in enumerate(shown["numbers"]):
        if i not in pixel.ids:
            assert (T, weight, slope) == ("–", "–", "–")
            continue
        at = pixel.ids.index(i)
        assert np.isclose(_numbers(T)[0], pixel.transmittances[at], rtol=0.06, atol=6e-5)
        assert np.isclose(_numbers(weight)[0], pixel.weights[at], rtol=0.06, atol=6e-5)
        # the wall is over the ceiling, where its opacity has no gradient; the widget shows that of alpha
        if i != 2:
            assert np.isclose(_numbers(slope)[0], totals.v_opacities[i], rtol=0.06, atol=6e-5)
    assert f"L = {0.5 * sum(v * v for v in v_color):.3f}" in shown["texts"]
    assert any("stop: T would" in text for text in shown["texts"]) == (len(pixel.ids) < pixel.n_traversed)


@pytest.mark.slow  # two trainings
def test_a_prior_ten_times_as_heavy_empties_the_middle_and_costs_quality() -> None:
    """Run the widget's worker as its page does, 150 steps with each weight."""
    assert "ten times as heavy" in WIDGETS["train"].prompt
    worker = mathematics(WIDGETS["train"].worker) + (FOLDER / "train_worker.js").read_text(encoding="utf-8")
    page = (FOLDER / "train.js").read_text(encoding="utf-8")
    constants = re.search(r"const RATES = .*?;\n\s*const settings = .*?;\n", page, re.DOTALL)
    assert constants is not None
    script = """let told; globalThis.postMessage = (data) => { told = data; };
    %s
    const STEPS = 600; %s
    const found = [0, 0.1, 1, 10].map((times, run) => {
        const mine = { ...settings, lambda_pop: times * settings.lambda_pop };
        onmessage({ data: { run, seed: 1, steps: 150, settings: mine, angle: 7.5, shape: "the picture" } });
        return [told.psnr, told.n, told.counts];
    });
    console.log(JSON.stringify(found));"""
    done = subprocess.run([NODE or "", "-e", script % (worker, constants[0])], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert all(sum(counts) == n for _, n, counts in found)
    middle = [sum(counts[1:14]) / n for _, n, counts in found]
    assert middle[0] > middle[2] > middle[3]
    assert found[0][0] > found[3][0] + 0.5


def test_a_slider_that_moves_two_learning_rates_shows_both() -> None:
    texts = _shown("train", ("slide", "learning rate of widths and rotations", 1))["texts"]
    assert "learning rate of widths and rotations0.0300 and 0.0200" in texts
