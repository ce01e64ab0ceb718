"""A small scene with photographs of its own, for whole training steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from cuda_ext.training.step_buffers import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.api.backend import get_backend
from pop_fast.api.rasterize import rasterization
from pop_fast.density import POPStrategy
from pop_fast.stages.losses import photometric_pop
from pop_fast.train.schedule import steady_updates
from pop_fast.train.steps import Phase, StepSettings
from pop_ref.conformance.torch_short_training import Trainee

WIDTH, HEIGHT, N, VIEWS, STEPS = 48, 36, 96, 3, 10
LR = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}


@dataclass
class TrainingScene:
    """Raw parameters, cameras and byte photographs, on the CPU.

    Attributes:
        params: by gsplat's keys.
        viewmats: [V, 4, 4]
        Ks: [V, 3, 3]
        photographs: uint8 [H, W, 3] each.
        order: the view of every step.
    """

    params: dict[str, Tensor]
    viewmats: Tensor
    Ks: Tensor
    photographs: list[Tensor]
    order: list[int]


def training_scene() -> TrainingScene:
    """Make the scene, the same at every call."""
    g = torch.Generator().manual_seed(3)
    params = {
        "means": torch.rand((N, 3), generator=g) * torch.tensor([4.0, 3.0, 2.0]) - torch.tensor([2.0, 1.5, -3.0]),
        "scales": torch.randn((N, 3), generator=g) * 0.25 - 1.75,
        "quats": torch.randn((N, 4), generator=g),
        "opacities": torch.randn(N, generator=g),
        "sh0": torch.randn((N, 1, 3), generator=g) * 0.5,
        "shN": torch.randn((N, 15, 3), generator=g) * 0.05,
    }
    viewmats = torch.eye(4).repeat(VIEWS, 1, 1)
    viewmats[:, 0, 3] = torch.tensor([-0.25, 0.0, 0.25])
    K = torch.tensor([[40.0, 0.0, WIDTH / 2], [0.0, 40.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    rows, cols = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    waves = [
        torch.stack([torch.sin((cols + 9 * v) / (4.0 + c)) * torch.cos(rows / 5.0) for c in range(3)], -1)
        for v in range(3)
    ]
    photographs = [((wave * 0.5 + 0.5) * 255).round().to(torch.uint8) for wave in waves]
    return TrainingScene(params, viewmats, K.repeat(VIEWS, 1, 1), photographs, [k % VIEWS for k in range(STEPS)])


def leaves_of(params: dict[str, Tensor], device) -> dict[str, Tensor]:
    """Return copies on a device that ask for gradients."""
    return {name: value.detach().to(device).clone().requires_grad_() for name, value in params.items()}


def drawn(function, params: dict[str, Tensor], scene: TrainingScene, degree: int = 3, views=slice(None), **options):
    """Call a rasterization with raw parameters and some of the scene's cameras, where the parameters lie."""
    device = params["means"].device
    sh = options.pop("sh", None)
    if sh is None:
        sh = torch.cat((params["sh0"], params["shN"]), 1) if degree else params["sh0"]
    rows = (params["means"], params["quats"], params["scales"].exp(), torch.sigmoid(params["opacities"]), sh)
    cameras = (scene.viewmats[views].to(device), scene.Ks[views].to(device))
    return function(*rows, *cameras, WIDTH, HEIGHT, sh_degree=degree, **options)


# Ten steps of training: fused ones on a device, and the same on the CPU by what `pop train` takes there.


class FusedStep(Trainee):
    """Takes steps on a GPU, as an adapter that offers nothing else."""

    name, dtype = "the fused step", np.float32

    def stage(self, name: str) -> Any:
        return getattr(self, name)


def skip_what_is_refused(config: Any) -> None:
    """Skip a test whose settings the fused step does not know; `pop train` refuses them."""
    step = get_backend("cuda").whole_step()
    assert step is not None
    setting = step.unknown_setting(config)
    if setting is not None:
        pytest.skip(f"the fused step has no {setting}; `pop train` refuses it")


# share of the image that a blurred Gaussian dominates
THETA = 0.02


def fused_trainer(scene: TrainingScene, device, masks=None, steps: int = STEPS, placed=torch.clone, **options):
    """Return rows (parameters and moments), each put in its place by `placed`, and the trainer of them."""
    params = {name: placed(value.to(device)) for name, value in scene.params.items()}
    m, v = ({name: placed(torch.zeros_like(value)) for name, value in params.items()} for _ in range(2))
    views = ResidentViews(scene.photographs, scene.viewmats, scene.Ks, masks, "valid", device)
    settings = StepSettings(steady_updates(LR, steps), **options)
    return (params, m, v), FusedTrainer(params, m, v, views, scene.order[:steps], settings)


def fused(scene: TrainingScene, device, window: bool = False, **options):
    """Take the steps of one phase; return objectives, parameters and the trainer."""
    (params, _, _), trainer = fused_trainer(scene, device, **options)
    losses = []
    for step in range(STEPS):
        trainer.run(step + 1, Phase(3, True, True, True, window=window))
        losses.append(float(trainer.values[2]))
    return losses, params, trainer


def on_the_cpu(scene: TrainingScene, **readings):
    """Take the steps with the strategy that `pop train` takes, its statistics collected and nothing grown.

    Returns:
        Losses, POP terms, parameters and the strategy's state.
    """
    strategy = POPStrategy(refine_start_iter=STEPS, blur_start_iter=0, theta_blur=THETA, **readings)
    params = leaves_of(scene.params, "cpu")
    optimizer = torch.optim.Adam([{"params": [params[name]], "lr": LR[name]} for name in params], eps=1e-15)
    state, losses, terms = strategy.initialize_state(), [], []
    for step in range(STEPS):
        view = scene.order[step]
        image, _, meta = drawn(rasterization, params, scene, views=[view], packed=False, dominance=True)
        loss = photometric_pop(image[0], scene.photographs[view].float() / 255.0)
        term = strategy.regularizer(torch.sigmoid(params["opacities"]), state, step, meta)
        assert term is not None
        losses.append(loss.item())
        terms.append(term.item())
        strategy.step_pre_backward(params, {}, state, step, meta)
        (loss + term).backward()
        optimizer.step()
        optimizer.zero_grad()
        strategy.step_post_backward(params, {}, state, step, meta)
    return losses, terms, {name: value.detach() for name, value in params.items()}, state


def apart(found, wanted, name) -> float:
    """Return the share of entries that differ by a tenth of all steps together.

    Where a gradient is rounding, Adam turns its sign into a whole step: what nearly all rows do is compared.
    """
    return float(((found.cpu() - wanted.cpu()).abs() > 0.1 * LR[name] * STEPS).float().mean())


def assert_same_bits(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Assert that all arrays of one name are equal."""
    for name, value in wanted.items():
        assert torch.equal(found[name], value), name


def assert_gradients_close(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Assert that the gradients that there are differ by little of the largest of their name."""
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=1e-4 * float(value.abs().max()))
