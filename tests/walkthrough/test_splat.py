"""Splatting in one file is the oracle's: images, gradients, a densification step, Adam's steps."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from pop_ref.activations import opacities_from_logits
from pop_ref.constants import PAPER
from pop_ref.density import DensityConfig, Rows, densify_and_prune, zero_statistics
from pop_ref.learn import splat
from pop_ref.optimizer import adam_step
from pop_ref.polarization import pop_loss_vjp
from pop_ref.records import Camera
from pop_ref.render import render, render_vjp
from pop_ref.training import gaussians_from_params, params_vjp

SIZE = 24


def _scene(seed: int, n: int = 60) -> dict[str, np.ndarray]:
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


def _drawn(seed: int):
    params, camera, background = _scene(seed), splat.orbit(0.7 * seed, SIZE), np.array([0.25, 0.5, 1.0])
    # from nearby, so that the near plane and the frustum's clamp take part
    camera[0][:3, 3] *= 0.45
    return params, camera, background


@pytest.mark.parametrize("seed", range(4))
def test_images_gradients_and_dominant_counts_are_the_oracles(seed: int) -> None:
    params, camera, background = _drawn(seed)
    gaussians, view = gaussians_from_params(params), Camera(*camera)
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
