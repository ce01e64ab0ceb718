"""Single kernels against the CPU: rows of harmonics of every width and place in memory, losses, passes over views.

70 Gaussians are two full warps, which read pieces of 16 bytes, and a part of one, which reads floats."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

import cuda_ext
from cuda_ext.arrays import fill, new_state, stream_of
from cuda_ext.training.step_buffers import MARGIN, ResidentViews
from pop_fast.api.rasterize import rasterization as on_cpu
from pop_fast.cuda import rasterization as on_gpu
from pop_fast.density.passes import Passes
from pop_fast.stages import losses
from pop_fast.train.steps import Phase
from pop_ref.constants import PROFILES
from pop_ref.settings import Objective
from tests.cuda.gpu.scene import (
    HEIGHT,
    LR,
    WIDTH,
    TrainingScene,
    assert_gradients_close,
    drawn,
    fused_trainer,
    leaves_of,
    training_scene,
)
from tests.fast.test_passes import HEIGHT as PASS_HEIGHT
from tests.fast.test_passes import WIDTH as PASS_WIDTH
from tests.fast.test_passes import raw_params, views

N = 70
# active degree, bands beyond the first in memory; the last is wider than any degree needs
DEGREES = [(0, 0), (0, 15), (1, 3), (1, 15), (2, 8), (2, 15), (3, 15), (3, 17)]


def _scene(n_rest: int) -> TrainingScene:
    scene = training_scene()
    params = {name: value[:N].clone() for name, value in scene.params.items()}
    params["means"][::5, 2] = -1.0  # behind the camera
    g = torch.Generator().manual_seed(n_rest)
    params["shN"] = torch.randn((N, n_rest, 3), generator=g) * 0.1
    return TrainingScene(params, scene.viewmats, scene.Ks, scene.photographs, scene.order)


def _moved(value: torch.Tensor, floats: int) -> torch.Tensor:
    """Copy a tensor to an address so many floats behind one that is a multiple of 16."""
    place = torch.zeros(value.numel() + 4, dtype=value.dtype, device=value.device)
    moved = place[floats : floats + value.numel()].view(value.shape)
    assert moved.data_ptr() % 16 == 4 * floats
    return moved.copy_(value)


def _moments(scene: TrainingScene, device, degree: int, floats: int = 0, waits: int = 0, **phase: Any):
    """Take a step on the device and return Adam's first moments, a tenth of the gradients, and the parameters.

    Before it, `waits` steps are taken in which the harmonics beyond the first band take no part.
    """
    (params, m, _), trainer = fused_trainer(scene, device, steps=1 + waits, placed=lambda value: _moved(value, floats))
    if waits:
        trainer.run(waits, Phase(0, False, False, False, **phase))
    trainer.run(1 + waits, Phase(degree, False, False, False, **phase))
    return {name: value.cpu() for name, value in m.items()}, {name: value.cpu() for name, value in params.items()}


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-6])
def test_a_first_step_has_the_length_of_the_learning_rate_however_small_the_gradient(gpu, scale):
    # x - lr g / (|g| + eps): with an eps under the root, or of 1e-8, small gradients take small steps
    found, after = _moments(_scene(15), gpu, 3, objective=Objective(pixel_scale=scale, lambda_ssim=0.0))
    smallest = []
    for name, m in found.items():
        g, before = m.double() / 0.1, _scene(15).params[name].double()
        told = g.abs() > 1e-13  # the square of a smaller one is no normal number
        smallest.append(float(g[told].abs().min()))
        expected = before - LR[name] * g / (g.abs() + 1e-15)
        wrong = (after[name].double() - expected).abs() > 1e-6 * before.abs() + 1e-4 * LR[name]
        assert not bool((wrong & told).any()), f"{name}: {g[wrong & told][:3].tolist()}"
        # what has no gradient does not move
        assert torch.equal(after[name][m == 0.0], _scene(15).params[name][m == 0.0])
    assert min(smallest) < 1e-6 * scale, "no gradient was small"


def test_harmonics_that_wait_do_not_move_and_their_counter_goes_on(gpu):
    # degree 0 for two steps, then degree 3: the first step is corrected as the third update
    scene = _scene(15)
    found, after = _moments(scene, gpu, 3, waits=2)
    g = found["shN"].double() / 0.1
    told = g.abs() > 1e-13
    length = (0.1 / (1.0 - 0.9**3)) / ((0.001 / (1.0 - 0.999**3)) ** 0.5)
    expected = scene.params["shN"].double() - LR["shN"] * length * torch.sign(g)
    assert bool(told.any())
    torch.testing.assert_close(after["shN"].double()[told], expected[told], rtol=1e-6, atol=1e-4 * LR["shN"])


@pytest.mark.parametrize(("degree", "n_rest"), DEGREES)
def test_a_steps_gradients_are_the_cpus_at_every_degree(gpu, degree, n_rest):
    scene = _scene(n_rest)
    found, after = _moments(scene, gpu, degree)
    sh = {name: scene.params[name].clone().requires_grad_() for name in ("sh0", "shN")}
    leaves, whole = leaves_of(scene.params, "cpu"), torch.cat((sh["sh0"], sh["shN"]), 1)
    image = drawn(on_cpu, leaves, scene, degree, [0], sh=whole, packed=False)[0][0]
    losses.photometric_pop(image, scene.photographs[scene.order[0]].float() / 255.0).backward()
    for name, leaf in (leaves | sh).items():
        wanted = torch.zeros_like(leaf) if leaf.grad is None else 0.1 * leaf.grad
        largest = float(wanted.abs().max()) if wanted.numel() else 0.0
        torch.testing.assert_close(found[name], wanted, rtol=2e-3, atol=1e-4 * largest)
        assert name == "shN" or bool(wanted.any()), f"{name} has no gradient"
    active = (degree + 1) ** 2 - 1
    assert degree == 0 or bool(found["shN"][:, :active].any())
    assert not bool(found["shN"][:, active:].any())
    assert torch.equal(after["shN"][:, active:], scene.params["shN"][:, active:])


@pytest.mark.parametrize(("degree", "n_rest"), [(1, 15), (3, 15)])
def test_rows_that_begin_anywhere_take_the_same_step(gpu, degree, n_rest):
    scene = _scene(n_rest)
    expected, places = _moments(scene, gpu, degree), range(1, 4)
    for found in (_moments(scene, gpu, degree, floats) for floats in places):
        for one, other in zip(expected, found, strict=True):
            for name, value in one.items():
                torch.testing.assert_close(other[name], value, rtol=1e-6, atol=1e-7 * float(value.abs().max()))


@pytest.mark.parametrize("floats", [0, 1])
@pytest.mark.parametrize(("degree", "n_rest"), DEGREES)
def test_coefficients_of_any_width_and_place_give_the_cpus_image_and_gradient(gpu, degree, n_rest, floats):
    scene = _scene(n_rest)
    whole = torch.cat((scene.params["sh0"], scene.params["shN"]), 1)
    weights = torch.linspace(-1, 1, WIDTH * HEIGHT * 3).reshape(HEIGHT, WIDTH, 3)
    images, grads = [], []
    for function, device in ((on_cpu, "cpu"), (on_gpu, gpu)):
        sh = _moved(whole.to(device), floats).requires_grad_()
        leaves = leaves_of(scene.params, device)
        image = drawn(function, leaves, scene, degree, [0], sh=sh, packed=False)[0][0]
        (image * weights.to(device)).sum().backward()
        images.append(image.detach().cpu())
        grads.append({"sh": sh.grad.cpu()} | {k: v.grad.cpu() for k, v in leaves.items() if v.grad is not None})
    torch.testing.assert_close(images[1], images[0], rtol=1e-4, atol=1e-5)
    assert_gradients_close(grads[1], grads[0])
    assert bool(grads[0]["sh"][:, : (degree + 1) ** 2].any(0).all())


# What the kernels are handed: every pointer takes tensors of its own type alone, and no name is made up.

EVERY_TYPE = ("float32", "float64", "float16", "int64", "int32", "int16", "uint8", "bool")


def structs():
    kernels = cuda_ext.load()
    found = [getattr(kernels, name) for name in dir(kernels)]
    return [kind for kind in found if isinstance(kind, type) and hasattr(kind, "dtypes")]


def test_every_pointer_of_the_kernels_structs_takes_its_own_type_and_no_other(gpu):
    fields = 0
    for kind in structs():
        for name, dtypes in kind.dtypes.items():
            fields += 1
            for dtype in EVERY_TYPE:
                tensor = torch.zeros(4, dtype=getattr(torch, dtype), device=gpu)
                if dtype in dtypes.split():
                    assert getattr(fill(kind(), **{name: tensor}), name) == tensor.data_ptr()
                    continue
                words = f"{name} has dtype {dtype}; the kernels read {dtypes.replace(' ', ' or ')} there"
                with pytest.raises(ValueError, match=re.escape(words)):
                    fill(kind(), **{name: tensor})
            assert getattr(fill(kind(), **{name: None}), name) == 0
    assert fields == pointers_in_the_bindings()


def pointers_in_the_bindings() -> int:
    text = (Path(cuda_ext.__file__).parent / "bindings.cpp").read_text()
    return len(re.findall(r"^ +POINTER\(", text, re.M)) + 2 * len(re.findall(r"^ +pointer_pair\(", text, re.M))


def test_a_field_that_the_kernels_do_not_have_is_refused(gpu):
    kernels = cuda_ext.load()
    with pytest.raises(TypeError, match="View has no field veiwmat; it has K, height, viewmat, width"):
        fill(kernels.View(), veiwmat=torch.zeros(16, device=gpu))
    with pytest.raises(TypeError, match=r"View\.width is a number, not a tensor"):
        fill(kernels.View(), width=torch.zeros(1, device=gpu))


# The loss kernels against float64: sizes around a block's 32 pixels, both borders, masks, both pixelwise terms.

SIZES = [(11, 12), (32, 32), (33, 31), (21, 70), (70, 43)]


def _photographs(height: int, width: int, masked: bool):
    g = torch.Generator().manual_seed(height + width)
    smooth = torch.linspace(0, 9, width)[None, :, None] + torch.linspace(0, 7, height)[:, None, None]
    target = (smooth.sin() * 0.4 + 0.5 + 0.1 * torch.rand((height, width, 3), generator=g)).clamp(0, 1)
    photograph = (255 * target).round().to(torch.uint8)
    # brighter than white and darker than black in places, as renders are
    image = 1.3 * (target + 0.2 * torch.randn((height, width, 3), generator=g)) - 0.1
    mask = torch.rand((height, width), generator=g) < 0.9 if masked else None
    return photograph, image, mask


def _found(device, photograph, image, mask, padding, l1, weights, cache):
    kernels, (height, width) = cuda_ext.load(), photograph.shape[:2]
    masks = None if mask is None else [mask]
    views = ResidentViews([photograph], torch.eye(4)[None], torch.eye(3)[None], masks, padding, device, cache)
    shapes = {"windows": (9, height, width), "v_image": (height, width, 3)}
    shapes |= {"partials": (kernels.loss_blocks(width, height), 3), "values": (kernels.N_VALUES,)}
    made = {name: torch.full(shape, float("nan"), device=device) for name, shape in shapes.items()}
    arrays = fill(kernels.LossArrays(), image=image.to(device), width=width, height=height, **made)
    settings = fill(kernels.LossSettings(), pixelwise_weight=weights[0], ssim_weight=weights[1])
    settings.margin = MARGIN if padding == "valid" else 0
    settings.set_pixelwise(l1)
    state = new_state(device)
    kernels.photometric(views.photographs(), arrays, settings, state.data_ptr(), stream_of(device))
    return made["values"].cpu().double()[:4], made["v_image"].cpu().double()


@pytest.mark.parametrize("cache", [True, False])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("padding", "l1"), [("valid", False), ("same", True)])
@pytest.mark.parametrize("size", SIZES)
def test_values_and_gradient_are_those_of_float64(gpu, size, padding, l1, masked, cache):
    photograph, image, mask = _photographs(*size, masked)
    weights = (0.7, 0.3)
    values, v_image = _found(gpu, photograph, image, mask, padding, l1, weights, cache)
    leaf, target = image.double().requires_grad_(), photograph.double() / 255.0
    pixelwise = (losses.l1 if l1 else losses.l2)(leaf, target, mask)
    ssim = losses.ssim(leaf, target, padding, mask)
    objective = weights[0] * pixelwise + weights[1] * (1.0 - ssim)
    objective.backward()
    square = losses.l2(leaf.detach().clamp(0, 1), target, mask)
    wanted = torch.stack((pixelwise, ssim, objective, square)).detach()
    torch.testing.assert_close(values, wanted, rtol=2e-6, atol=2e-6)
    torch.testing.assert_close(v_image, leaf.grad, rtol=1e-4, atol=1e-5 * float(leaf.grad.abs().max()))


def test_a_mask_that_keeps_nothing_compares_nothing(gpu):
    photograph, image, _ = _photographs(40, 40, False)
    values, v_image = _found(
        gpu, photograph, image, torch.zeros(40, 40, dtype=torch.bool), "valid", False, (1, 1), True
    )
    assert values.tolist() == [0.0, 1.0, 0.0, 0.0]
    assert not bool(v_image.any())


def test_two_runs_give_the_same_bits(gpu):
    photograph, image, mask = _photographs(70, 43, True)
    first, second = (_found(gpu, photograph, image, mask, "valid", False, (1, 1), True) for _ in range(2))
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))


# Passes over views against the CPU's in float64, and their bits from run to run.


def _passes(gpu: Any, profile: str = "paper", n: int = 60, **more: Any) -> tuple[list[Any], list[Any]]:
    """Return passes and parameters, of the CPU in float64 and of the GPU."""
    moved = {name: value.to(gpu) for name, value in raw_params(n, torch.float32).items()}
    cpu = Passes("fast", views(), profile, (0.2, 0.4, 0.1), **more)
    cuda = Passes("cuda", views(torch.float32), profile, (0.2, 0.4, 0.1), device=gpu, **more)
    return [cpu, {name: value.double().cpu() for name, value in moved.items()}], [cuda, moved]


def _apart(expected: torch.Tensor, found: torch.Tensor, columns: bool = False) -> float:
    """Return the largest difference by the largest value, of every column where these have units of their own."""
    expected, found = expected.double(), found.double().cpu()
    size = expected.abs().amax(0) if columns else expected.abs().max()
    assert float(size.min()) > 0.0
    return float(((found - expected).abs() / size).max())


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("index", [0, 1])
def test_contributions_are_the_cpus(gpu: Any, index: int, profile: str, antialiased: bool) -> None:
    pixel_map = torch.rand(PASS_HEIGHT, PASS_WIDTH, generator=torch.Generator().manual_seed(3))
    (cpu, params), (cuda, moved) = _passes(gpu, profile, antialiased=antialiased)
    expected = cpu.contributions(params, index, 3, pixel_map)
    found = cuda.contributions(moved, index, 3, pixel_map.to(gpu))
    for name in ("weight_sum", "map_sum", "distance_sum", "image"):
        assert _apart(getattr(expected, name), getattr(found, name)) < 5e-6, name
    for name in ("n_pixels", "dominant_counts", "radii", "visible"):
        assert torch.equal(getattr(found, name).cpu(), getattr(expected, name)), name
    assert antialiased or not bool(cuda.contributions(moved, index, 0).map_sum.any())


@pytest.mark.parametrize("profile", PROFILES)
def test_sensitivities_moments_and_fisher_blocks_are_the_cpus(gpu: Any, profile: str) -> None:
    (cpu, params), (cuda, moved) = _passes(gpu, profile)
    assert _apart(cpu.sensitivities(params, 1, 2), cuda.sensitivities(moved, 1, 2)) < 5e-6
    of_cpu, of_cuda = (p._open(p._shot(rows, 0, 3)) for p, rows in ((cpu, params), (cuda, moved)))
    assert _apart(of_cpu._moments(), of_cuda._view.screen_moments(), columns=True) < 2e-5
    expected, found = cpu.fisher(params, 0, 3, 2), cuda.fisher(moved, 0, 3, 2).cpu()
    sizes = expected.diagonal(dim1=1, dim2=2).sqrt()
    units = sizes[:, :, None] * sizes[:, None, :]
    assert int((units > 0.0).all(2).all(1).sum()) > 20
    assert float(((found - expected).abs() - 2e-4 * units).max()) <= 0.0


@pytest.mark.parametrize("profile", PROFILES)
def test_dominant_points_are_the_cpus(gpu: Any, profile: str) -> None:
    (cpu, params), (cuda, moved) = _passes(gpu, profile)
    for rows in (params, moved):
        # seen from its edge, so that it lies behind some rays
        rows["means"][2], rows["scales"][2] = torch.tensor([0.1, 0.0, 0.5]), torch.tensor([0.0, 0.0, -4.0])
        rows["quats"][2], rows["opacities"][2] = torch.tensor([0.7, 0.0, 0.7, 0.05]), torch.tensor(0.5)
    (points, ids, T_final), found = cpu.dominant_points(params, 0, 3), cuda.dominant_points(moved, 0, 3)
    assert torch.equal(found[1].cpu(), ids)
    assert _apart(points, found[0]) < 5e-6
    assert _apart(T_final, found[2]) < 5e-6
    drawn_ids = cuda._open(cuda._shot(moved, 0, 3)).seen().dominant_ids.cpu()
    assert int((drawn_ids != ids).sum()) > 100


def test_many_gaussians_have_the_same_sums_twice_and_their_weights_and_the_light_left_are_one(gpu: Any) -> None:
    _, (cuda, moved) = _passes(gpu, n=400)

    def found() -> list[torch.Tensor]:
        view = cuda._open(cuda._shot(moved, 0, 3))
        sums = view.contributions(torch.ones(PASS_HEIGHT, PASS_WIDTH, device=gpu))
        names = ("weight_sum", "n_pixels", "map_sum", "distance_sum")
        return [*(getattr(sums, name) for name in names), view.sensitivities(), view._view.screen_moments()]

    first = found()
    assert all(torch.equal(a, b) for _ in range(2) for a, b in zip(first, found(), strict=True))
    left = cuda.dominant_points(moved, 0, 3)[2].double().sum()
    assert float(first[0].sum() + left) == pytest.approx(PASS_WIDTH * PASS_HEIGHT, rel=1e-6)


def test_nobody_contributes_to_a_view_that_shows_nobody(gpu: Any) -> None:
    _, (cuda, moved) = _passes(gpu)
    moved["means"][:, 2] -= 100.0
    sums = (cuda.contributions(moved, 0, 3).n_pixels, cuda.sensitivities(moved, 0, 3), cuda.fisher(moved, 0, 3))
    points, ids, T_final = cuda.dominant_points(moved, 0, 3)
    assert not any(bool(found.any()) for found in (*sums, points))
    assert bool((ids == -1).all())
    assert bool((T_final == 1.0).all())
