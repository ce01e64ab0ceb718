"""What a widget says with its picture is what the oracle computes, at the values that its prompt suggests.

The widgets' own scripts run in node, on as much of a page as they need.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_ref.camera import covars_cam_from_covars, means_cam_from_means
from pop_ref.constants import PAPER
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.footprint import compensations, conics_from_covars2d, low_pass, radii_from_covars2d
from pop_ref.harmonics import colors_from_sh, sh_basis
from pop_ref.pixel import SplatRows, composite_pixel, composite_pixel_vjp, zero_gradients
from pop_ref.projection import project_covars, project_means, projection_jacobians
from pop_ref.walkthrough.widgets import FOLDER, WIDGETS, html, mathematics

NODE = shutil.which("node")
PAGE = Path(__file__).with_name("page_without_browser.js")
pytestmark = pytest.mark.skipif(NODE is None, reason="there is no node here to run JavaScript")


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


@pytest.mark.parametrize(("opacity", "long", "short", "eps2d"), [(0.02, 3.4, 1.5, 0.3), (0.8, 0.1, 0.1, 0.3)])
def test_a_splat_tells_its_edge_its_extent_and_what_blur_does_to_its_paint(
    opacity: float, long: float, short: float, eps2d: float
) -> None:
    assert "opacity down to 0.02" in WIDGETS["splat2d"].prompt
    shown = _shown(
        "splat2d",
        ("slide", "opacity", opacity),
        ("slide", "first standard deviation", long),
        ("slide", "second standard deviation", short),
    )["readings"]
    covar2d = _covar2d(long, short, 23)
    blurred = low_pass(covar2d, eps2d)
    k = np.sqrt(2.0 * np.log(255.0 * opacity))
    assert shown["edge (1/255)"] == f"at {k:.2f} deviations"
    radii = radii_from_covars2d(blurred, np.array([opacity]))[0]
    assert shown["extent"] == f"{2 * radii[0]} × {2 * radii[1]} px"
    # paint is the integral of alpha: 2 pi o sqrt(det), so a splat of 0.1 px has 31 times as much of it after the blur
    paint = np.sqrt(np.linalg.det(blurred[0]) / np.linalg.det(covar2d[0]))
    assert shown["paint after blur, 1/ρ"] == f"× {paint:.2f}"
    assert shown["ρ, antialiased mode only"] == f"{compensations(covar2d, eps2d)[0]:.3f}"
    assert (paint > 30.0) == (long == 0.1)
    conic = conics_from_covars2d(blurred)[0].tolist()
    assert f"{0.5 * np.array([-5.4, -3.1]) @ np.linalg.inv(blurred[0]) @ [-5.4, -3.1]:.3f}" == shown["its exponent σ"]
    rows = SplatRows([[12.1, 7.4]], [conic], [opacity], [[1.0]])
    lit = [composite_pixel([0], rows, x + 0.5, y + 0.5, [0.0]).ids for x in range(24) for y in range(16)]
    assert shown["pixels drawn"] == f"{sum(map(len, lit))} of 384"


def _orbit_truth(distance: float, sideways: float) -> tuple[np.ndarray, np.ndarray]:
    """Project the widget's Gaussian and very many of its points; return the ellipse's half-axes, the points' sides."""
    (ca, sa), (ce, se) = ((np.cos(a), np.sin(a)) for a in (0.6, 0.35))
    viewmat = np.array(
        [
            [ca, 0, -sa, sideways * distance],
            [-sa * se, ce, -ca * se, 0],
            [sa * ce, se, ca * ce, distance],
            [0, 0, 0, 1],
        ]
    )
    K = np.array([[270.0, 0, 160], [0, 270, 120], [0, 0, 1]])
    covars = covars_from_quats_scales(np.array([[0.85, 0.3, 0.1, 0.45]]), np.array([[0.9, 0.35, 0.2]]))
    covars_cam = covars_cam_from_covars(covars, viewmat)
    mean_cam = means_cam_from_means(np.zeros((1, 3)), viewmat)
    covar2d = project_covars(covars_cam, projection_jacobians(mean_cam, K, 320, 240))[0]
    points = np.random.default_rng(3).multivariate_normal(mean_cam[0], covars_cam[0], 100_000)
    cloud = project_means(points[points[:, 2] > PAPER.near_plane], K, 320, 240)
    lambdas, directions = np.linalg.eigh(covar2d)
    along = (cloud - project_means(mean_cam, K, 320, 240)[0]) @ directions[:, ::-1]
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
    base[0] = (fading * sh_basis(towards, 3)[0])[:, None] - np.where(np.arange(16) == 0, 0.9, 0.0)[:, None]
    base[0, 0] += [-0.5, 0.1, 1.0]
    shown = _shown("harmonics")
    # the camera in front looks along +z
    assert shown["readings"]["direction d, camera to Gaussian"] == "(0.00, 0.00, 1.00)"
    front = colors_from_sh(base, np.array([[0.0, 0.0, 1.0]]), 3)[0]
    assert np.allclose(_numbers(shown["readings"]["colour that it sees, c(d)"]), front, atol=0.006)
    globe = next(each for each in shown["canvases"] if each["width"] == 220)
    pixels = np.reshape(globe["data"], (220, 220, 4)) / 255.0
    for right, down in ((0.0, 0.0), (0.6, 0.0), (0.0, -0.7), (-0.5, 0.4)):
        # a camera to the right of the Gaussian looks to the left
        inwards = np.array([[-right, -down, np.sqrt(1 - right**2 - down**2)]])
        at = pixels[round(110 + 107 * down - 0.5), round(110 + 107 * right - 0.5), :3]
        assert np.allclose(at, np.minimum(colors_from_sh(base, inwards, 3)[0], 1.0), atol=0.03), (right, down)
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
    assert np.allclose(sh_basis(-at, 3), sign * sh_basis(at, 3))


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


def test_a_prior_ten_times_as_heavy_empties_the_middle_and_costs_quality() -> None:
    """Run the widget's worker as its page does, 150 steps with each weight."""
    assert "ten times as heavy" in WIDGETS["train"].prompt
    worker = mathematics(*WIDGETS["train"].worker) + (FOLDER / "train_worker.js").read_text(encoding="utf-8")
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
