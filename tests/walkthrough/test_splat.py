"""Splatting in one file, and the formulas that the course states in its own words, give what the oracle does.

Of `splat.py`: images, gradients, a densification step, Adam's steps.

And what a learner is told of names that are nearly right, and of code that does not come to an end.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_ref.activations import opacities_from_logits
from pop_ref.alpha import alpha_from_sigma_vjp
from pop_ref.camera import in_front
from pop_ref.constants import PAPER
from pop_ref.density import DensityConfig, Rows, densify_and_prune, grow_masks, prune_mask, zero_statistics
from pop_ref.density_rows import clone_rows, prune_rows
from pop_ref.footprint import low_pass
from pop_ref.learn import __main__ as alone
from pop_ref.learn import splat, stubs
from pop_ref.learn.course import BY_NAME
from pop_ref.learn.judge import judge, told
from pop_ref.learn.stubs import _FORMULAS
from pop_ref.learn.student import read_work
from pop_ref.optimizer import adam_step
from pop_ref.pixel import BlendGradients, SplatRows, composite_pixel, composite_pixel_vjp
from pop_ref.polarization import pop_loss, pop_loss_vjp
from pop_ref.projection import projection_jacobians_vjp
from pop_ref.records import Camera
from pop_ref.render import render, render_vjp
from pop_ref.tiles import tile_lists, tile_span
from pop_ref.training import gaussians_from_params, params_vjp

SIZE = 24


def _scene(seed: int, n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-1.6, 1.6, (n, 3)),
        "quats": rng.standard_normal((n, 4)),
        # needles, discs, and some that reach past the picture or behind the camera
        "scales": rng.uniform(-4.0, 0.3, (n, 3)),
        # some under the floor, some over the ceiling
        "opacities": rng.uniform(-7.0, 9.0, n),
        # some channels under zero
        "sh0": rng.uniform(-2.5, 2.5, (n, 1, 3)),
    }


def toy(seed: int, n: int, size: int) -> tuple[dict[str, np.ndarray], Camera]:
    """Draw a scene, and a camera so near that the near plane and the frustum's clamp take part."""
    viewmat, *intrinsics = splat.orbit(0.7 * seed, size)
    viewmat[:3, 3] *= 0.45
    return _scene(seed, n), Camera(viewmat, *intrinsics)


@pytest.mark.parametrize("seed", range(4))
def test_images_gradients_and_dominant_counts_are_the_oracles(seed: int) -> None:
    (params, view), background = toy(seed, 60, SIZE), np.array([0.25, 0.5, 1.0])
    camera, gaussians = (view.viewmat, view.K, SIZE, SIZE), gaussians_from_params(params)
    expected = render(gaussians, view, background)
    image, tape = splat.render(params, camera, background)
    assert np.max(np.abs(image - expected.image)) < 1e-12
    assert np.max(np.abs(tape.T_final - expected.T_final)) < 1e-12
    assert np.array_equal(tape.dominant_counts, expected.dominant_counts)
    # what is compared holds every decision: culls, stops, and opacities past both ends
    assert 5 < int(np.sum(expected.splats.visible)) < len(gaussians)
    assert float(np.min(expected.T_final)) < 1e-3

    v_image = np.random.default_rng(seed).standard_normal(image.shape)
    gradients = render_vjp(gaussians, view, v_image, background=background)
    oracles = params_vjp(params, gradients, np.zeros(len(gaussians)))
    grads, v_means2d = splat.render_vjp(params, tape, v_image)
    assert set(grads) == set(oracles) == set(params)
    for name, value in {**oracles, "means2d": gradients.means2d}.items():
        found = v_means2d if name == "means2d" else grads[name]
        assert np.any(value != 0.0), name
        assert np.max(np.abs(found - value)) < 1e-9 * np.max(np.abs(value)), name


def test_a_densification_step_is_the_oracles() -> None:
    rng = np.random.default_rng(3)
    params = _scene(3, 40)
    params["scales"] = rng.uniform(-5.0, -1.0, (40, 3))
    m, v = ({name: rng.uniform(0.5, 1.0, x.shape) for name, x in params.items()} for _ in range(2))
    average_grads, scene_scale = rng.uniform(0.0, 4e-4, 40), 6.0

    def normals(n: int) -> np.ndarray:
        return np.random.default_rng(n).standard_normal((2, n, 3))

    statistics = zero_statistics(40)
    statistics = type(statistics)(average_grads, statistics.n_visible + 1, 1, *list(vars(statistics).values())[3:])
    expected, _ = densify_and_prune(Rows(params, m, v), statistics, scene_scale, 600, normals, DensityConfig())
    new_params, new_m, new_v = dict(params), dict(m), dict(v)
    splat.densify_and_prune(new_params, new_m, new_v, average_grads, scene_scale, normals)
    scales = np.exp(params["scales"]).max(axis=1)
    grown = average_grads > splat.GROW_GRAD2D
    assert np.any(grown & (scales <= 0.01 * scene_scale)), "nobody is cloned"
    assert np.any(grown & (scales > 0.01 * scene_scale)), "nobody is split"
    assert np.any(opacities_from_logits(params["opacities"]) < splat.PRUNE_OPA), "nobody is pruned"
    for found, oracles in ((new_params, expected.params), (new_m, expected.m), (new_v, expected.v)):
        for name, value in oracles.items():
            assert found[name].shape == value.shape
            assert np.allclose(found[name], value, rtol=0.0, atol=1e-12)


def test_adam_and_the_pull_of_pop_are_the_oracles() -> None:
    rng = np.random.default_rng(5)
    params = _scene(5, 6)
    rates = dict.fromkeys(params, 0.01)
    found, m, v = dict(params), *({name: np.zeros_like(x) for name, x in params.items()} for _ in range(2))
    expected = (dict(params), dict(m), dict(v))
    for step in (1, 2, 3):
        grads = {name: rng.standard_normal(x.shape) for name, x in params.items()}
        splat.adam_step(found, grads, m, v, step, rates)
        expected = adam_step(expected[0], grads, expected[1], expected[2], step, rates)
    for name in params:
        assert np.array_equal(found[name], expected[0][name])
    opacities, counts = rng.uniform(0.0, 1.0, 6), np.array([0, 3, 1, 0, 0, 2])
    assert np.array_equal(splat.pop_loss_vjp(opacities, counts), pop_loss_vjp(opacities, counts > 0, 1.0))


def test_its_constants_are_the_papers() -> None:
    named = ("near_plane", "frustum_margin", "eps2d", "extent_sigmas", "alpha_floor", "alpha_ceiling")
    for values, names in (
        (PAPER, (*named, "transmittance_stop")),
        (DensityConfig(), ("grow_grad2d", "grow_scale3d", "prune_opa")),
    ):
        for name in names:
            assert getattr(splat, name.upper()) == getattr(values, name), name


def test_a_short_training_learns_grows_and_writes_its_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "splat.png"
    params, _ = splat.train(steps=200, size=24, n_views=8, n=100, out=str(out))
    told = capsys.readouterr().out
    losses = [float(text) for text in re.findall(r"loss (\S+)", told)]
    psnrs = [float(text) for text in re.findall(r"view (\S+) dB", told)]
    assert len(losses) == 10
    assert sum(losses[-3:]) < 0.7 * sum(losses[:3])
    assert psnrs[-1] > psnrs[0] + 1.0
    assert len(params["means"]) > 100
    assert out.read_bytes().startswith(b"\x89PNG")


def test_it_is_short_and_imports_numpy_and_the_standard_library_only() -> None:
    text = Path(splat.__file__).read_text(encoding="utf-8")
    assert text.count("\n") <= 300
    imported = {
        name.split(".")[0]
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names])
    }
    assert imported == {"__future__", "numpy", "struct", "sys", "time", "types", "zlib"}


_TOKEN = re.compile(r"[0-9.]+|[A-Za-z]\w*|<=|\S")
_FUNCTIONS = {"exp": math.exp, "sqrt": math.sqrt, "floor": math.floor, "ceil": math.ceil}


def value_of(formula: str, **values: Any) -> Any:
    """Evaluate the right side of a formula up to its words: `2 x/z^3`, `-o exp(-sigma) v`; products have no sign."""
    text = re.split(r", both| where ", formula.rpartition(" = ")[2])[0]
    tokens, written = _TOKEN.findall(text), ""
    for before, token in zip(["(", *tokens], tokens, strict=False):
        operand = before not in _FUNCTIONS and re.fullmatch(r"[\w.]+|[)\]]", before)
        written += " * " if operand and re.fullmatch(r"[\w.]+|[(\[]", token) else ""
        written += "**" if token == "^" else token
    if "[[" in written:
        written = re.sub(r"(\[\[.*\]\])", r"array(\1)", written)
    return eval(written, {"__builtins__": {}, "array": np.array, **_FUNCTIONS}, values)


ROWS = Rows(*({"means": np.arange(9.0).reshape(3, 3) + k} for k in (1.0, 20.0, 40.0)))
MASK = np.array([True, False, True])


def test_a_formula_is_read_as_it_is_written() -> None:
    assert value_of("v_z = -(fx/z^2) v + (2 fx x/z^3) w where it is", fx=3.0, z=2.0, v=5.0, x=7.0, w=11.0) == 54.0
    assert value_of("near <= z <= far", near=1.0, z=2.0, far=3.0) is True


def _in_front(kept: str) -> None:
    depths = np.array([PAPER.near_plane, 0.5 * PAPER.near_plane, 3.0, 2.0 * PAPER.far_plane])
    said = [value_of(kept, near=PAPER.near_plane, far=PAPER.far_plane, z=z) for z in depths.tolist()]
    assert in_front(depths).tolist() == said == [True, False, True, False]


def _prune_mask(pruned: str) -> None:
    opacities = np.array([0.004, 0.005, 0.006])
    said = [value_of(pruned, o=o, prune_opa=0.005) for o in opacities.tolist()]
    assert prune_mask(opacities, np.ones((3, 3)), 1.0, 9000).tolist() == said == [True, False, False]


def _alpha_from_sigma_vjp(v_sigma: str, v_o: str) -> None:
    values = {"sigma": 0.3, "o": 0.6, "v_alpha": 1.7}
    assert alpha_from_sigma_vjp(0.3, 0.6, 1.7) == pytest.approx([value_of(v_sigma, **values), value_of(v_o, **values)])
    assert v_o.endswith("both 0 over the ceiling")
    assert alpha_from_sigma_vjp(0.0, 1.0, 1.7) == (0.0, 0.0)


def _low_pass(blurred: str) -> None:
    covars = np.array([[[1.0, 0.5], [0.5, 2.0]]])
    assert np.array_equal(low_pass(covars, 0.3)[0], value_of(blurred, Sigma2d=covars[0], eps2d=0.3))


def _projection_jacobians_vjp(free: str, clamped: str, likewise: str) -> None:
    assert likewise == "y likewise"
    v_x, inside = free.partition(" where ")[0].split(" and ")
    K, width = np.diag([8.0, 8.0, 1.0]), 16
    K[:2, 2] = 8.0
    v = {"v_xx": 1.3, "v_xz": -0.7}
    cotangent = np.array([[[v["v_xx"], 0.0, v["v_xz"]], [0.0, 0.0, 0.0]]])
    found = projection_jacobians_vjp(np.array([[0.5, 0.0, 2.0]]), K, width, width, cotangent)[0]
    values = {"fx": 8.0, "x": 0.5, "z": 2.0, **v}
    assert found == pytest.approx([value_of(v_x, **values), 0.0, value_of(inside, **values)])
    # half the picture and 0.3 of it more: x/z is held at 1.3 where the view's edge is at 1
    found = projection_jacobians_vjp(np.array([[9.0, 0.0, 2.0]]), K, width, width, cotangent)[0]
    tx = 2.0 * (1.0 + PAPER.frustum_margin)
    assert found == pytest.approx([0.0, 0.0, value_of(clamped, **values, tx=tx)])
    # and the other axis is the same with its own entries
    other = np.array([[[0.0, 0.0, 0.0], [0.0, v["v_xx"], v["v_xz"]]]])
    found = projection_jacobians_vjp(np.array([[0.0, 0.5, 2.0]]), K, width, width, other)[0]
    assert found == pytest.approx([0.0, value_of(v_x, **values), value_of(inside, **values)])


def _tile_span(first: str, last: str, held: str) -> None:
    for u, r in ((8.0, 4), (9.5, 3), (-3.0, 1), (40.0, 30)):
        said = (value_of(first, u=u, r=r, t=4), value_of(last, u=u, r=r, t=4))
        assert tile_span(u, r, 5, 4) == tuple(min(max(each, 0), 5) for each in said)
    assert held == "both in 0 to n_tiles"


def _tile_lists(order: str, number: str) -> None:
    means2d, radii = np.array([[1.0, 1.0], [3.0, 1.0], [1.0, 3.0], [1.0, 1.0]]), np.ones((4, 2), dtype=np.int64)
    lists = tile_lists(means2d, radii, np.array([2.0, 1.0, 1.0, 2.0]), 4, 4, 2)
    assert order == "sort by (depth, index)"
    assert number.startswith("tile (x, y) is number ")
    at = [value_of(number.partition("number ")[2], x=x, y=y, tiles_x=2) for x, y in ((0, 0), (1, 0), (0, 1))]
    assert [lists[k] for k in at] == [[0, 3], [1], [2]]


def _pop_loss(said: str) -> None:
    assert said == "mean of 1 - o where the mask is true + mean of o where it is not"
    o, mask = np.array([0.9, 0.2, 0.4]), np.array([True, False, False])
    assert pop_loss(o, mask) == pytest.approx(np.mean(1.0 - o[mask]) + np.mean(o[~mask]))


def _pop_loss_vjp(important: str, other: str) -> None:
    mask = np.array([True, False, False, True, False])
    found = pop_loss_vjp(np.full(5, 0.5), mask, 1.5)
    sides = [value_of(each, v_loss=1.5, N=5, N_imp=2) for each in (important, other)]
    assert found == pytest.approx(np.where(mask, *sides))
    assert important.endswith("where the mask is true")


def _adam_step(m: str, v: str, x: str) -> None:
    arrays: dict[str, Any] = {
        name: {"x": np.array([at])} for name, at in (("x", 1.0), ("g", 0.3), ("m", 0.2), ("v", 0.1))
    }
    found = adam_step(arrays["x"], arrays["g"], arrays["m"], arrays["v"], 3, {"x": 0.01}, (0.8, 0.9), 1e-3)
    values = {"beta1": 0.8, "beta2": 0.9, "g": 0.3, "lr": 0.01, "t": 3, "eps": 1e-3, "x": 1.0}
    now = {"m": value_of(m, m=0.2, **values), "v": value_of(v, v=0.1, **values)}
    assert [each["x"][0] for each in found] == pytest.approx([value_of(x, **values, **now), now["m"], now["v"]])


def _clone_rows(params: str, moments: str) -> None:
    assert (params, moments) == ("params = rows, then copies of rows[mask]", "m, v = rows, then zeros")
    cloned = clone_rows(ROWS, MASK)
    assert np.array_equal(cloned.params["means"], np.concatenate([ROWS.params["means"], ROWS.params["means"][MASK]]))
    for of, kept in ((ROWS.m, cloned.m), (ROWS.v, cloned.v)):
        assert np.array_equal(kept["means"], np.concatenate([of["means"], np.zeros((2, 3))]))


def _prune_rows(left: str) -> None:
    assert left == "params, m, v = rows[~mask]"
    pruned = prune_rows(ROWS, MASK)
    for of, kept in ((ROWS.params, pruned.params), (ROWS.m, pruned.m), (ROWS.v, pruned.v)):
        assert np.array_equal(kept["means"], of["means"][~MASK])


def _grow_masks(small: str) -> None:
    scales = np.array([[0.01, 0.001, 0.02], [0.021, 0.0, 0.0]])
    text = small.replace("max scale", "max_scale")
    said = [value_of(text, max_scale=max(row), grow_scale3d=0.01, scene_scale=2.0) for row in scales.tolist()]
    statistics = replace(zero_statistics(2), grad_sum=np.ones(2), n_visible=np.ones(2, dtype=np.int64))
    clone, split = grow_masks(statistics, scales, 2.0, 600)
    assert clone.tolist() == said == (~split).tolist() == [True, False]


def _composite_pixel_vjp(said: str) -> None:
    assert said == (
        "behind = background . v_color + v_T_final, and from the last splat to the first q = c_i . v_color, v_alpha ="
        " T_i (q - behind), v_c = T_i alpha_i v_color, then behind += alpha_i (q - behind)"
    )
    opacities, colors = [0.6, 0.3], np.array([[0.2, 0.9, 0.4], [0.7, 0.1, 0.5]])
    rows = SplatRows([[2.5, 2.5], [1.5, 3.0]], [[0.5, 0.1, 0.4], [0.3, 0.0, 0.6]], opacities, colors.tolist())
    background, v_color, v_T_final = np.array([0.3, 0.2, 0.8]), np.array([1.1, -0.6, 0.4]), 0.7
    pixel = composite_pixel([0, 1], rows, 2.0, 3.0, background.tolist())
    totals = BlendGradients(*(np.zeros(s) for s in ((2, 2), (2, 3), 2, (2, 3), 3, (2, 2))))
    composite_pixel_vjp(pixel, rows, 2.0, 3.0, background.tolist(), v_color.tolist(), v_T_final, totals)
    behind = background @ v_color + v_T_final
    for i in (1, 0):
        T, alpha, q = pixel.transmittances[i], pixel.alphas[i], colors[i] @ v_color
        sigma = -math.log(alpha / opacities[i])
        v_opacity = alpha_from_sigma_vjp(sigma, opacities[i], T * (q - behind))[1]
        assert totals.v_opacities[i] == pytest.approx(v_opacity)
        assert totals.v_colors[i] == pytest.approx(T * alpha * v_color)
        behind += alpha * (q - behind)


CHECKS: dict[str, Callable[..., None]] = {
    name.removeprefix("_"): check
    for name, check in list(globals().items())
    if name.startswith("_") and name.removeprefix("_") in _FORMULAS
}


@pytest.mark.parametrize("name", sorted(_FORMULAS))
def test_a_formula_of_the_course_gives_what_the_oracle_does(name: str) -> None:
    CHECKS[name](*_FORMULAS[name])


ALPHA = BY_NAME["alpha"]
STUB = 'raise NotImplementedError("{} is yours to write")'


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    stubs.start(tmp_path / "mine")
    return tmp_path / "mine"


def edited(folder: Path, *changes: tuple[str, str]) -> None:
    path = folder / ALPHA.file
    text = path.read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path.write_text(text)


def test_a_function_that_is_named_nearly_right_is_named(mine: Path) -> None:
    edited(mine, ("def falloff(", "def fallof("), (STUB.format("falloff"), "return 1.0"))
    edited(mine, ("def sigma_at_pixel(", "def weighted("), (STUB.format("sigma_at_pixel"), "return 1.0"))
    verdict = judge(read_work(mine), ALPHA)
    assert verdict.misspelt == {"falloff": "fallof"}
    assert verdict.unwritten == ALPHA.names
    assert "alpha.py has fallof: rename it if it is meant as falloff" in told(ALPHA, verdict)


def test_stubs_as_they_were_written_are_alike_to_nothing(mine: Path) -> None:
    work = read_work(mine)
    assert [judge(work, stage).misspelt for stage in BY_NAME.values()] == [{}] * len(BY_NAME)


@pytest.mark.parametrize("every", [False, True])
def test_what_takes_long_is_named_with_the_way_out(
    mine, monkeypatch, capsys: pytest.CaptureFixture[str], every
) -> None:
    monkeypatch.setattr(alone, "_LONG_S", 0.2)
    slow = "import time\n    time.sleep(1.0)\n    return 0.0"
    edited(mine, (STUB.format("sigma_at_pixel"), slow))
    assert alone.main(["check", *(["--all"] if every else ["alpha"]), str(mine)]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "sigma_at_pixel of alpha.py" in line]
    assert lines[0].startswith("pop-learn: judging sigma_at_pixel of alpha.py takes more than 0.2 seconds")
    assert lines[0].endswith("Ctrl-C stops it")


def test_what_ends_soon_is_judged_without_a_word(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edited(mine, (STUB.format("sigma_at_pixel"), "return 0.0"))
    assert alone.main(["check", "alpha", str(mine)]) == 1
    assert capsys.readouterr().err == ""
