"""Renders on the GPU against the oracle's, ten steps of training against the CPU's, and the same bits twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cuda_ext.render import lists
from pop_fast.api.rasterize import rasterization as on_cpu
from pop_fast.cuda import rasterization as on_gpu
from pop_fast.train.steps import Phase, StepStats
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render
from pop_ref.settings import Objective
from tests.cuda.gpu.scene import (
    HEIGHT,
    LR,
    STEPS,
    WIDTH,
    apart,
    assert_gradients_close,
    assert_same_bits,
    drawn,
    fused,
    fused_trainer,
    leaves_of,
    on_the_cpu,
    training_scene,
)


@pytest.mark.graph
def test_steps_launched_anew_are_the_replayed_steps(gpu):
    replayed, launched = (fused(training_scene(), gpu, replay=replay)[1] for replay in (True, False))
    assert_same_bits(launched, replayed)


@pytest.mark.graph
@pytest.mark.parametrize(
    "options", [{"backward": "gaussian_parallel"}, {"deterministic": False}, {"antialiased": True}]
)
def test_graphs_of_several_sizes_and_phases_are_replayed_in_turn(gpu, options):
    phases = (
        Phase(3, True, True, True),
        Phase(1, False, False, False, objective=Objective(pixelwise="l1")),
        Phase(3, True, False, False),
    )
    found = []
    for replay in (True, False):
        scene = training_scene()
        scene.photographs = [image[: HEIGHT - 7 * k].contiguous() for k, image in enumerate(scene.photographs)]
        scene.order = [0, 1, 0, 1, 2, 0, 1, 2, 2, 0]
        rows, trainer = fused_trainer(scene, gpu, replay=replay, **options)
        for step in range(STEPS):
            trainer.run(step + 1, phases[0 if step < 6 else step % 2 + 1])
            if step == 4:
                # graphs of the rows before must not be replayed for those after
                rows = tuple({name: value.clone() for name, value in group.items()} for group in rows)
                trainer.rebind(*rows)
        found.append(rows[0])
    if options.get("deterministic", True):
        assert_same_bits(*found)
    # sums in another order
    assert all(apart(value, found[1][name], name) < 0.01 for name, value in found[0].items())


@pytest.mark.graph
def test_buffers_that_overflow_grow_and_nothing_is_lost(gpu, monkeypatch):
    expected = fused(training_scene(), gpu)[1]
    monkeypatch.setattr(lists, "FIRST_GUESS", (0, 1))
    _, small, cramped = fused(training_scene(), gpu)
    assert cramped.grown > 0
    assert_same_bits(small, expected)


@pytest.mark.parametrize("backward", ["pixel_parallel", "gaussian_parallel"])
def test_a_render_is_the_oracles(gpu, backward):
    scene = training_scene()
    p = {name: value.to(gpu) for name, value in scene.params.items()}
    image, alphas, _ = drawn(on_gpu, p, scene, views=[0], backward=backward)
    p |= {"scales": p["scales"].exp(), "opacities": torch.sigmoid(p["opacities"])}
    sh = torch.cat((p["sh0"], p["shN"]), 1)
    rows = [value.cpu().double().numpy() for value in (p["means"], p["quats"], p["scales"], p["opacities"], sh)]
    camera = Camera(scene.viewmats[0].double().numpy(), scene.Ks[0].double().numpy(), WIDTH, HEIGHT)
    expected = render(Gaussians(*rows), camera)
    assert expected.image.std() > 0.1
    np.testing.assert_allclose(image[0].cpu().numpy(), expected.image, atol=2e-4)
    np.testing.assert_allclose(1.0 - alphas[0, ..., 0].cpu().numpy(), expected.T_final, atol=2e-4)


def test_second_derivatives_of_a_render_are_refused(gpu):
    scene = training_scene()
    p = {name: value.to(gpu).requires_grad_() for name, value in scene.params.items()}
    total = drawn(on_gpu, p, scene, views=[0])[0].sum()
    (gradient,) = torch.autograd.grad(total, p["means"], retain_graph=True)
    assert bool((gradient != 0.0).any())
    # its cotangent requires no gradient
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(total, p["means"], create_graph=True)


def test_a_background_may_be_written_to_before_the_way_back(gpu):
    scene = training_scene()

    def gradient(written: bool):
        p = {name: value.to(gpu).requires_grad_() for name, value in scene.params.items()}
        behind = torch.full((1, 3), 0.75, device=gpu)
        image = drawn(on_gpu, p, scene, views=[0], backgrounds=behind)[0]
        if written:
            behind.zero_()
        return torch.autograd.grad(image.square().sum(), p["opacities"])[0]

    assert torch.equal(gradient(True), gradient(False))


def test_fused_steps_launched_one_by_one_give_the_same_bits_twice_and_learn(gpu):
    found = []
    for _ in range(2):
        scene = replace(training_scene(), order=[0] * 4)
        (params, _, _), trainer = fused_trainer(scene, gpu, steps=4, replay=False)
        trainer.run(4, Phase(3, True, True, True))
        losses = [StepStats(*values).objective for values in trainer.step_stats(0, 4)]
        assert losses[-1] < losses[0]
        found.append(params)
    assert_same_bits(*found)


@pytest.mark.parametrize("backward", ["pixel_parallel", "gaussian_parallel"])
def test_ten_fused_steps_are_the_cpus_ten_steps(gpu, backward):
    scene = training_scene()
    losses, params, _ = fused(scene, gpu, backward=backward)
    expected, _, wanted, _ = on_the_cpu(scene)
    assert expected[-1] < expected[0]
    torch.testing.assert_close(torch.tensor(losses), torch.tensor(expected), rtol=1e-4, atol=1e-6)
    for name, value in wanted.items():
        assert apart(params[name], value, name) < 0.01, name


def test_bands_that_the_gaussians_do_not_have_are_not_trained(gpu):
    scene = training_scene()
    few = {**scene.params, "shN": scene.params["shN"][:, :3].contiguous()}
    (params, _, _), trainer = fused_trainer(replace(scene, params=few), gpu)
    trainer.run(1, Phase(1, True, True, True))
    before = {name: value.clone() for name, value in params.items()}
    for _ in range(2):
        with pytest.raises(ValueError, match="sh has 4 coefficients; degree 2 needs 9"):
            trainer.run(2, Phase(2, True, True, True))
    assert_same_bits(params, before)
    trainer.run(2, Phase(1, True, True, True))
    assert trainer.step == 2


@pytest.mark.graph
def test_two_runs_give_the_same_bits(gpu):
    assert_same_bits(*(fused(training_scene(), gpu)[1] for _ in range(2)))


def test_a_trainer_of_ones_own_learns_through_the_autograd_functions(gpu):
    scene = training_scene()
    leaves = leaves_of(scene.params, gpu)
    optimizer = torch.optim.Adam([{"params": [leaves[name]], "lr": 5 * LR[name]} for name in leaves])
    photographs = torch.stack(scene.photographs).to(gpu).float() / 255.0
    losses = []
    for _ in range(STEPS):
        image, alphas, meta = drawn(on_cpu, leaves, scene, packed=False, backend="cuda")
        meta["means2d"].retain_grad()
        loss = (image - photographs).square().mean()
        loss.backward()
        assert bool(meta["means2d"].grad.any())
        assert alphas.shape == (3, HEIGHT, WIDTH, 1)
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
    assert losses[-1] < 0.95 * losses[0]


def test_rasterization_and_its_gradients_give_the_same_bits_twice(gpu):
    scene = training_scene()
    grads = []
    for _ in range(2):
        leaves = leaves_of(scene.params, gpu)
        image, _, _ = drawn(on_gpu, leaves, scene)
        (image * torch.linspace(-1, 1, image.numel(), device=gpu).reshape(image.shape)).sum().backward()
        grads.append({name: leaf.grad for name, leaf in leaves.items()})
    assert all(bool(value.any()) for value in grads[0].values())
    assert_same_bits(*grads)


@pytest.mark.parametrize("backward", ["pixel_parallel", "gaussian_parallel"])
@pytest.mark.parametrize("faint", [1, 44], ids=["one-bucket", "three-buckets"])
def test_gradients_around_an_opaque_splat_keep_their_digits(gpu, backward, faint):
    n = 2 * faint + 1

    def gradient(function, device, dtype, **options):
        def made(values):
            return torch.tensor(values, dtype=dtype, device=device)

        # a thousandth of the light passes the middle splat, which is wider than the image and black
        opacities = [0.5 if faint == 1 else 0.02] * n
        opacities[faint] = 1.0
        means = made([[0.06 + 0.002 * k, 0.06, 1.0 + 0.02 * k] for k in range(n)]).requires_grad_()
        image, _, _ = function(
            means, made([[1.0, 0.0, 0.0, 0.0]] * n), made([[8.0 if k == faint else 0.3] * 3 for k in range(n)]),
            made(opacities), made([[0.0] * 3 if k == faint else [0.75, 0.625, 0.5] for k in range(n)]),
            made([torch.eye(4).tolist()]), made([[[8.0, 0.0, 2.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]]]), 4, 8, **options,
        )  # fmt: skip
        (image[0] * torch.linspace(-1, 1, 96, dtype=dtype, device=device).reshape(8, 4, 3)).sum().backward()
        return means.grad.double().cpu()

    expected = gradient(on_cpu, "cpu", torch.float64)
    found = gradient(on_gpu, gpu, torch.float32, backward=backward)
    assert float((found - expected).abs().max() / expected.abs().max()) < 5e-6


@pytest.mark.parametrize("options", [{"counts": True}, {"profile": "inria"}])
def test_lists_of_the_callers_tiles_go_back_as_the_warps_own_do(gpu, options):
    scene, grads = training_scene(), []
    # 36 px: the last row of 16 px tiles is less than half full, so that a warp's part of it lies outside
    for function, device, backward in (
        (on_cpu, "cpu", {}),
        (on_gpu, gpu, {}),
        (on_gpu, gpu, {"backward": "gaussian_parallel"}),
    ):
        leaves = leaves_of(scene.params, device)
        drawn(function, leaves, scene, 0, **options, **backward)[0].square().sum().backward()
        grads.append({name: leaf.grad.cpu() for name, leaf in leaves.items() if leaf.grad is not None})
    assert len(grads[0]) == 5
    for found in grads[1:]:
        assert_gradients_close(found, grads[0])


@pytest.mark.parametrize("mode", ["D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("packed", [False, True])
def test_every_render_mode_is_the_cpus(gpu, mode, packed):
    scene = training_scene()
    found, expected = (
        drawn(function, {k: v.to(device) for k, v in scene.params.items()}, scene, 0, render_mode=mode, packed=packed)
        for function, device in ((on_gpu, gpu), (on_cpu, "cpu"))
    )
    for k in (0, 1):
        torch.testing.assert_close(found[k].cpu(), expected[k], rtol=1e-4, atol=1e-5)
    for key in ("flatten_ids", "isect_offsets", "tiles_per_gauss"):
        assert torch.equal(found[2][key].cpu(), expected[2][key]), key


@pytest.mark.parametrize(
    ("name", "index", "value", "words"),
    [
        ("means", (7, 1), float("nan"), r"means\[7, 1\] is nan; it must be finite"),
        ("quats", (3, slice(None)), 0.0, r"quats\[3\] is \[0.0, .*\]; it must have a norm > 0"),
        ("scales", (2, 0), -1.0, r"scales\[2, 0\] is -1.0; it must be >= 0"),
        ("opacities", (5,), 1.5, r"opacities\[5\] is 1.5; it must be in \[0, 1\]"),
        ("colors", (4, 0, 2), float("inf"), r"colors\[4, 0, 2\] is inf; it must be finite"),
        ("viewmats", (1, 0, 0), 2.0, r"viewmats\[1\] is .*; it must be rigid"),
        ("viewmats", (2, 3, 0), 0.5, r"viewmats\[2\] is .*; it must end in the row"),
        ("Ks", (0, 0, 1), 0.5, r"Ks\[0\] is .*; skew is not supported"),
    ],
)
def test_a_bad_value_is_named_with_its_index(gpu, name, index, value, words):
    scene = training_scene()
    p = {key: tensor.to(gpu).clone() for key, tensor in scene.params.items()}
    p |= {"scales": p["scales"].exp(), "opacities": torch.sigmoid(p["opacities"]), "colors": p.pop("sh0")}
    p |= {"viewmats": scene.viewmats.to(gpu).clone(), "Ks": scene.Ks.to(gpu).clone()}
    del p["shN"]
    p[name][index] = value
    with pytest.raises(ValueError, match=words):
        on_gpu(**p, width=WIDTH, height=HEIGHT, sh_degree=0)
